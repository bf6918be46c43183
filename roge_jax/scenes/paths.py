"""Camera path files, read and written (docs/cameras.md)."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError, did_you_mean
from roge_jax.files.fields import matrix, number, read_json
from roge_jax.geometry.cameras import (
    CONVENTIONS,
    Cameras,
    crop_resize_K,
    invert,
    opencv_to_opengl,
    to_host,
    to_opencv,
    validate,
)
from roge_jax.geometry.interpolation import interpolate

MOST = 1_000_000  # frames that keyframes are interpolated to: more are a slip of the pen


def save_path(
    file: str | Path,
    cameras: Cameras,
    height: int,
    width: int,
    *,
    convention: str = "opencv",
    fps: float | None = None,
) -> None:
    """Writes cameras [n] of height x width pictures as a path file, every frame with its K."""
    if convention not in CONVENTIONS:
        hint = did_you_mean(convention, CONVENTIONS)
        raise UserError(f"Unknown camera convention '{convention}': {hint}")
    cameras = to_host(cameras)
    poses = cameras.c2w
    poses = opencv_to_opengl(poses) if convention.startswith("opengl") else poses
    poses = invert(poses) if convention.endswith("_w2c") else poses
    entries = [
        {"pose": pose.tolist(), "K": K.tolist()} for pose, K in zip(poses, cameras.K, strict=True)
    ]
    content: dict[str, Any] = {"convention": convention, "width": width, "height": height}
    content |= {"fps": fps} if fps else {}
    Path(file).write_text(json.dumps(content | {"frames": entries}, indent=1))


def transforms(names: Sequence[str], cameras: Cameras, height: int, width: int) -> dict[str, Any]:
    """nerfstudio's transforms.json of the frames: c2w in OpenGL axes, in the scene's own frame and unit."""
    frames = []
    for name, K, pose in zip(names, cameras.K, opencv_to_opengl(cameras.c2w), strict=True):
        entry = {
            "file_path": f"frames/{name}",
            "fl_x": K[0, 0],
            "fl_y": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
        }
        frames.append(entry | {"transform_matrix": pose})
    return {"camera_model": "OPENCV", "w": width, "h": height, "frames": frames}


def load_path(
    file: str | Path,
    *,
    frames: int | None = None,
    height: int | None = None,
    width: int | None = None,
    context: Cameras | None = None,
) -> Cameras:
    """Cameras [n] (float64, OpenCV, world units) of a path file.

    Args:
      file: our format, a nerfstudio camera path (`camera_path`) or a `transforms.json`.
      frames: how many frames to make of a file with `keyframes`; a file with `frames` is taken as
        it is and must have this many.
      height, width: the pictures to make; K is moved there from the file's own size by a centred
        crop and a resize. Default: K stays in pixels of the file's size.
      context: whose first K (in pixels of height x width) is used if the file has no intrinsics.
    Raises: UserError naming the file, the frame and the field.
    """
    file = Path(file)
    if frames is not None:
        frames = number(frames, str(file), "frames", low=1, whole=True)
    content = read_json(file, "path file")
    if not isinstance(content, dict):
        raise UserError(f"{file}: expected an object with 'convention' and 'frames'.")
    entries, field, convention = _entries(content, file)
    matrices = [_matrix(entry, field, f"{file}, frame {i}") for i, entry in enumerate(entries)]
    poses = to_opencv(np.stack(matrices), convention)
    size = _size(content, str(file))
    target = (height, width) if height and width else size
    K = [
        _intrinsics(entry, content, size, target, context, f"{file}, frame {i}")
        for i, entry in enumerate(entries)
    ]
    cameras = Cameras(np.stack(K), poses)
    names = [f"{file.name} frame {i}" for i in range(len(entries))]
    middle = np.nan_to_num(np.abs(K[0][[1, 0], 2]), posinf=1.0).clip(1.0, 1e6)
    guess = (int(2 * middle[0]), int(2 * middle[1]))
    cameras = validate(cameras, *(target or guess), names)
    if "keyframes" in content and "camera_path" not in content:
        times = _times(entries, file)
        count = content.get("count")
        count = 81 if count is None else number(count, str(file), "count", low=1, whole=True)
        if (frames or count) > MOST:
            raise UserError(f"{file}: {frames or count} frames: give at most {MOST} of them.")
        s = np.linspace(0.0, 1.0, frames or count)
        return interpolate(cameras, s, times=times)
    if frames is not None and frames != len(cameras):
        raise UserError(
            f"{file}: has {len(cameras)} frames but {frames} were asked for: ask for "
            f"{len(cameras)}, or write 'keyframes' to have them interpolated."
        )
    return cameras


def _entries(content: dict, file: Path) -> tuple[list[dict], str, str]:
    """(frames or key frames, name of their matrix, convention)."""
    if isinstance(content.get("camera_path"), list):
        entries, field, default = content["camera_path"], "camera_to_world", "opengl"
    else:
        entries = content.get("frames", content.get("keyframes"))
        foreign = isinstance(entries, list) and any(
            isinstance(entry, dict) and "transform_matrix" in entry for entry in entries[:1]
        )
        field, default = ("transform_matrix", "opengl") if foreign else ("pose", "")
        if "frames" in content and "keyframes" in content:
            raise UserError(f"{file}: has both 'frames' and 'keyframes': give one of the two.")
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{file}: has no cameras: give a list 'frames' or 'keyframes'.")
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise UserError(
                f"{file}, frame {i}: is no object with '{field}': give a 4x4 matrix there."
            )
    convention = content.get("convention") or default
    if convention not in CONVENTIONS:
        given = f"convention '{convention}'" if convention else "no 'convention'"
        hint = did_you_mean(str(convention), CONVENTIONS)
        raise UserError(f"{file}: {given}, so its axes are unknown: {hint}")
    return entries, field, convention


def _matrix(entry: dict, field: str, where: str) -> np.ndarray:
    """The pose of one entry as [4, 4]."""
    if field not in entry:
        raise UserError(f"{where}: has no '{field}': give a 4x4 matrix (rows).")
    try:
        matrix = np.asarray(entry[field], np.float64)
        matrix = matrix.reshape(-1, 4) if matrix.size in (12, 16) else matrix
        if matrix.shape == (3, 4):
            matrix = np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
        if matrix.shape != (4, 4):
            raise ValueError
    except (ValueError, TypeError):
        raise UserError(f"{where}: '{field}' must be a 4x4 matrix of numbers (rows).") from None
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
        raise UserError(f"{where}: '{field}' has NaN, infinite or singular numbers: fix it.")
    return matrix


_NUMBERS = ("fl_x", "fl_y", "cx", "cy", "fov", "camera_angle_x")


def _size(content: dict, where: str) -> tuple[int, int] | None:
    """(height, width) of the pictures that the file's intrinsics are for."""
    for names in (("height", "width"), ("h", "w"), ("render_height", "render_width")):
        given = [name for name in names if content.get(name) is not None]
        if len(given) == 1:
            raise UserError(
                f"{where}: has '{given[0]}' alone: give both '{names[0]}' and '{names[1]}'."
            )
        if given:
            height, width = (number(content[n], where, n, low=1, whole=True) for n in names)
            return height, width
    return None


def _intrinsics(
    entry: dict,
    content: dict,
    size: tuple[int, int] | None,
    target: tuple[int, int] | None,
    context: Cameras | None,
    where: str,
) -> np.ndarray:
    """K [3, 3] of one entry in pixels of `target`: its own, else the file's, else the context's."""
    known = ("K", "fl_x", "fl_y", "fov", "camera_angle_x")
    sources = ({k: v for k, v in s.items() if v is not None} for s in (entry, content))
    source = next((s for s in sources if any(k in s for k in known)), None)
    if source is None:
        if context is None:
            raise UserError(f"{where}: no intrinsics: give 'K' (3x3, pixels) or 'fov' (degrees).")
        return to_host(context).K[0]
    value = {name: number(source[name], where, name) for name in _NUMBERS if name in source}
    if "K" in source:
        K = matrix(source["K"], (3, 3), where, "K")
    elif "fl_x" in value:
        middle = (0.0, 0.0) if size is None else (size[1] / 2, size[0] / 2)
        cx, cy = value.get("cx", middle[0]), value.get("cy", middle[1])
        K = np.array(
            [[value["fl_x"], 0, cx], [0, value.get("fl_y", value["fl_x"]), cy], [0, 0, 1.0]]
        )
    elif "fl_y" in value:
        raise UserError(f"{where}: has 'fl_y' alone: give 'fl_x' (pixels) as well.")
    else:
        size = size or target
        name = "fov" if "fov" in value else "camera_angle_x"
        if size is None:
            raise UserError(f"{where}: '{name}' needs the picture size: give 'height' and 'width'.")
        angle, side = value[name], size[0]
        if name == "fov" and not 0 < angle < 180:
            raise UserError(f"{where}: fov {angle} is the full vertical angle: 0 to 180 degrees.")
        if name == "camera_angle_x":
            if not 0 < angle < np.pi:
                raise UserError(
                    f"{where}: camera_angle_x {angle} is the full horizontal angle: 0 to 3.14 radians."
                )
            angle, side = np.degrees(angle), size[1]
        focal = 0.5 * side / np.tan(np.radians(angle) / 2)
        K = np.array([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1.0]])
    if target is None:
        return K
    if size is None:
        raise UserError(f"{where}: K needs the picture size it is for: give 'height' and 'width'.")
    return K if size == target else crop_resize_K(K, size, target)


def _times(entries: list[dict], file: Path) -> np.ndarray | None:
    """The `time` of every key frame, or None if none has one."""
    if not any("time" in entry for entry in entries):
        return None
    times = np.array(
        [number(e.get("time", np.nan), f"{file}, frame {i}", "time") for i, e in enumerate(entries)]
    )
    if not np.all(np.diff(times) > 0):
        raise UserError(f"{file}: 'time' must be on every key frame, in increasing order.")
    return times
