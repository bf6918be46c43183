"""One camera entry of a file, whoever wrote it: intrinsics, picture size, lens and pose.

Photos and paths come through here, so that the same fields mean the same for both. An entry lies over the defaults of
its file. What an entry says itself wins, and as a whole: focal lengths come from the first of the two that names one,
with that one's principal point; so do the size, the camera model and the coefficients of the lens.
"""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.fields import matrix, number
from roge_jax.scenes.lens import Lens

Size = tuple[int, int]
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
SIZES = (("height", "width"), ("h", "w"), ("render_height", "render_width"))
FOCAL = ("K", "fl_x", "fl_y", "fov", "camera_angle_x", "camera_angle_y")
NUMBERS = ("fl_x", "fl_y", "cx", "cy", "fov", "camera_angle_x", "camera_angle_y")
PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYES = ("OPENCV_FISHEYE", "FISHEYE")


def camera(
    entry: dict,
    defaults: dict,
    where: str,
    *,
    picture: Callable[[], Size] | None = None,
    target: Size | None = None,
) -> tuple[np.ndarray | None, Size | None, Lens | None]:
    """(K [3, 3], the size (height, width) that it is for, lens) of an entry; K None if neither says anything.

    Args:
      entry: the fields of one camera.
      defaults: the fields of the whole file; those of the entry win.
      where: what messages call the entry.
      picture: tells the size of the entry's photo, where the fields need one and do not say it.
      target: the size of the pictures to make, which an angle alone is for.
    Raises: UserError naming `where` and the field.
    """
    sources = [{k: v for k, v in s.items() if v is not None} for s in (entry, defaults)]
    refuse_projections(sources, where)
    lens = _lens(sources, where)
    holder = next((i for i, s in enumerate(sources) if any(k in s for k in FOCAL)), None)
    order = sources if holder != 1 else sources[::-1]
    size = next((found for s in order if (found := read_size(s, where)) is not None), None)
    if holder is None:
        return None, size, lens
    source = dict(sources[holder])
    if holder == 1 and {"cx", "cy"} & set(
        sources[0]
    ):  # the entry's own principal point, as a whole
        source = {k: v for k, v in source.items() if k not in ("cx", "cy")}
        source |= {k: sources[0][k] for k in ("cx", "cy") if k in sources[0]}
    value = {name: number(source[name], where, name) for name in NUMBERS if name in source}
    if "K" in source:
        rows = source["K"]
        shape = (4, 4) if isinstance(rows, list) and len(rows) == 4 else (3, 3)
        return matrix(rows, shape, where, "K")[:3, :3], size, lens
    if "fl_x" not in value and "fl_y" in value and not ANGLES & set(value):
        raise UserError(
            f"{where}: no focal length: has 'fl_y' alone: give 'fl_x' (pixels) as well."
        )
    if size is None and not {"fl_x", "cx", "cy"} <= set(value):
        size = picture() if picture is not None else size
        size = size or (target if "fl_x" not in value else None)
    fx, fy = _focal(value, size, where)
    if size is None and not {"cx", "cy"} <= set(value):
        raise UserError(
            f"{where}: K needs the picture size it is for: give 'height' and 'width', or 'cx' and 'cy'."
        )
    height, width = size or (0, 0)
    cx, cy = value.get("cx", 0.5 * width), value.get("cy", 0.5 * height)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), size, lens


ANGLES = {"fov", "camera_angle_x", "camera_angle_y"}


def _focal(value: dict[str, float], size: Size | None, where: str) -> tuple[float, float]:
    """(fx, fy) in pixels of pictures of `size`."""
    if "fl_x" in value:
        return value["fl_x"], value.get("fl_y", value["fl_x"])
    name = next(n for n in ("fov", "camera_angle_x", "camera_angle_y") if n in value)
    if size is None:
        raise UserError(f"{where}: '{name}' needs the picture size: give 'height' and 'width'.")

    def focal(name: str, side: int) -> float:
        angle = value[name]
        if name == "fov":
            if not 0 < angle < 180:
                raise UserError(
                    f"{where}: fov {angle:g} is the full vertical angle: 0 to 180 degrees."
                )
            angle = np.radians(angle)
        elif not 0 < angle < np.pi:
            across = "horizontal" if name == "camera_angle_x" else "vertical"
            raise UserError(
                f"{where}: '{name}' is {angle:g}: give the full {across} angle, 0 to 3.14 radians."
            )
        return float(0.5 * side / np.tan(angle / 2))

    if name == "fov":
        return (focal(name, size[0]),) * 2
    across = focal("camera_angle_x", size[1]) if "camera_angle_x" in value else None
    down = focal("camera_angle_y", size[0]) if "camera_angle_y" in value else None
    if across is None:
        assert down is not None
        return down, down
    return across, across if down is None else down


def refuse_projections(sources: Iterable[dict], where: str) -> None:
    """Raise UserError for a `camera_type` that is no pinhole camera: it would be filmed as one."""
    for source in sources:
        kind = source.get("camera_type")
        if kind is None:
            continue
        if str(kind).lower() not in ("perspective", "pinhole", "simple_pinhole"):
            raise UserError(
                f"{where}: camera_type {kind} is not supported: need perspective, undistort or export it so."
            )
        return


def read_size(fields: dict, where: str) -> Size | None:
    """(height, width) that intrinsics are for, if these fields say."""
    for names in SIZES:
        given = [name for name in names if fields.get(name) is not None]
        if len(given) == 1:
            raise UserError(
                f"{where}: has '{given[0]}' alone: give both '{names[0]}' and '{names[1]}' (pixels), or neither."
            )
        if given:
            values = [fields[name] for name in names]
            if names[0] == "render_height":  # nerfstudio's viewer writes floats
                values = [
                    round(v) if isinstance(v, float) and v == v and abs(v) < 1e9 else v
                    for v in values
                ]
            height, width = (
                number(value, where, name, low=1, whole=True)
                for name, value in zip(names, values, strict=True)
            )
            return height, width
    return None


def _lens(sources: list[dict], where: str) -> Lens | None:
    """What the fields say about the lens: the model of the first that names one, the first one's coefficients.

    An entry with a model of its own takes nothing from the file.
    """
    modelled = next((s for s in sources if "camera_model" in s or "is_fisheye" in s), {})
    candidates = sources[:1] if modelled is sources[0] and modelled else sources
    fields = next((found for s in candidates if (found := _numbers(s))), {})
    numbers = {name: number(value, where, name) for name, value in fields.items()}
    for name, value in numbers.items():
        if not np.isfinite(value):
            raise UserError(f"{where}: '{name}' is {value}: give a number, or leave it out.")
    model = str(modelled.get("camera_model", "OPENCV")).upper()
    if modelled.get("is_fisheye"):  # instant-ngp's word for it
        if model not in ("OPENCV_FISHEYE", "OPENCV"):
            raise UserError(
                f"{where}: 'is_fisheye' with camera_model {model}: give one of the two."
            )
        model = "OPENCV_FISHEYE"
    k1, k2, k3, k4, p1, p2 = (numbers.get(n, 0.0) for n in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model in FISHEYES:
        return Lens("fisheye", (k1, k2, k3, k4))
    if model not in PINHOLES:
        raise UserError(
            f"{where}: camera_model {model} is not supported: need PINHOLE, OPENCV or "
            "OPENCV_FISHEYE, undistort the photos first."
        )
    more = [name for name in ("k4", "k5", "k6") if numbers.get(name)]
    if more:
        raise UserError(
            f"{where}: {more[0]} = {numbers[more[0]]} with a {model} camera: undistort the photos first."
        )
    bent = (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return Lens("opencv", bent) if any(bent) else None


def _numbers(source: dict) -> dict[str, Any]:
    return {name: source[name] for name in DISTORTION if name in source}


def pose(value: Any, where: str) -> np.ndarray:
    """A 4x4 or 3x4 matrix of a file, by rows, nested or flat, as [4, 4]; NaN passes."""
    try:
        found = np.asarray(value, np.float64)
        found = found.reshape(-1, 4) if found.size in (12, 16) else found
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape == (3, 4):
        found = np.vstack([found, [0.0, 0.0, 0.0, 1.0]])
    if found.shape != (4, 4):
        raise UserError(f"{where} must be a 4x4 matrix of numbers (rows).")
    return found


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """K [3, 3] of four numbers."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
