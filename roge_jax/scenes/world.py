"""Paths in other coordinates than the scene's: found, or asked for, never assumed.

nerfstudio turns, centres and scales the cameras of a scene before it trains, and its viewer writes paths in that frame.
`dataparser_transforms.json` of the training run holds T [3, 4] and s: a point p of the frame that the scene's poses had
before `applied_transform` A and `applied_scale` a went into transforms.json lies at s T p. In the frame of
transforms.json, A p a, that is T' = T A^-1 and s' = s / a (and A = 1, a = 1 where the file says nothing).
"""

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.fields import is_file, matrix, number, read_json
from roge_jax.geometry.cameras import CameraWarning, relative_to
from roge_jax.scenes import entries

FILE = "dataparser_transforms.json"
WORDS = ("scene", "first")
CURE = (
    "give --path-frame (in Python frame=) FILE with the transform, 'scene' if it is in the scene's own coordinates, or "
    "'first' to start it at the first photo"
)

Frame = str | Path | tuple[Any, float] | None


def to_scene(
    c2w: np.ndarray,
    frame: Frame,
    kind: str,
    path: Path,
    scene: Path | None,
    first: np.ndarray | None,
) -> np.ndarray:
    """Poses [n, 4, 4] of a path in the scene's coordinates.

    Args:
      c2w: the poses as they are written.
      frame: as the user says it (`load_path`).
      kind: whose coordinates the path's format is in (`Reading.frame`).
      path: its file.
      scene: the folder or file of the scene.
      first: the c2w of the photo that leads.
    Raises: UserError where nobody says how the two belong together.
    """
    if frame is None and kind == "scene":
        return c2w
    if frame is None and kind == "nerfstudio":
        found = _found(path, scene)
        if found is not None:
            return _from_viewer(c2w, *_read_transform(found), scene or path.parent)
        if scene is None and first is None:
            warnings.warn(
                f"{path}: nerfstudio's viewer writes paths in its own normalised frame, and no {FILE} lies near: the "
                "cameras stay in that frame.",
                CameraWarning,
                stacklevel=3,
            )
            return c2w
        raise UserError(
            f"{path}: nerfstudio's viewer writes paths in its own normalised frame, and no {FILE} of the training run "
            f"lies near it or the scene: give --path-frame (in Python frame=) that file, it is in nerfstudio's outputs "
            "folder, or 'scene' if the run had orientation, centring and scaling off."
        )
    if frame is None and kind == "unknown" and scene is None and first is None:
        return c2w
    if frame is None and kind == "unknown":
        raise UserError(
            f"{path}: its cameras are in the coordinates of the editor that wrote it: {CURE}."
        )
    if frame is None:  # relative to its first camera
        return c2w if first is None else first @ relative_to(c2w[0], c2w)
    if isinstance(frame, str) and frame == "scene":
        return c2w
    if isinstance(frame, str) and frame.partition(":")[0] == "first":
        if first is None:
            raise UserError(f"{path}: 'first' needs photos: give context=.")
        given = frame.partition(":")[2]
        moved = relative_to(c2w[0], c2w)
        moved[:, :3, 3] *= number(given, "--path-frame", "first:SCALE", low=1e-30) if given else 1.0
        return first @ moved
    if isinstance(frame, tuple):
        return _moved(c2w, entries.pose(frame[0], "frame: the matrix"), float(frame[1]))
    text = str(frame)
    if not is_file(Path(text)) and "," in text:
        values = text.split(",")
        if len(values) not in (12, 13, 16, 17):
            raise UserError(
                f"--path-frame {text}: has {len(values)} numbers: give a 4x4 or 3x4 matrix by rows, and a scale or none."
            )
        numbers = [number(v, "--path-frame", v) for v in values]
        scale = numbers.pop() if len(numbers) % 4 else 1.0
        return _moved(c2w, entries.pose(numbers, "--path-frame: the matrix"), scale)
    if not is_file(Path(text)):
        raise UserError(
            f"--path-frame {text}: there is no such file: give a {FILE}, 'scene', 'first', or 12 or 16 numbers."
        )
    content = read_json(Path(text), "transform")
    if isinstance(content, dict) and "path_to_scene" in content:
        pose = entries.pose(content["path_to_scene"], f"{text}: 'path_to_scene'")
        return _moved(c2w, pose, number(content.get("scale", 1.0), text, "scale", low=1e-30))
    return _from_viewer(c2w, *_read_transform(Path(text)), scene or path.parent)


def _moved(c2w: np.ndarray, pose: np.ndarray, scale: float) -> np.ndarray:
    """A given transform: positions times `scale`, then the matrix takes path to scene."""
    size = np.cbrt(np.linalg.det(pose[:3, :3]))
    if not (np.isfinite(pose).all() and size > 0 and np.isfinite(scale) and scale > 0):
        raise UserError(
            "The transform of the path is singular, mirrored or not positive: give a rigid one and a scale."
        )
    moved = c2w.copy()
    turned = pose[:3, :3] / size  # a scale in the matrix moves positions, axes stay of length 1
    moved[:, :3, :3] = turned @ c2w[:, :3, :3]
    moved[:, :3, 3] = scale * c2w[:, :3, 3] @ pose[:3, :3].T + pose[:3, 3]
    return moved


def _from_viewer(c2w: np.ndarray, T: np.ndarray, scale: float, scene: Path) -> np.ndarray:
    """Poses of the normalised frame in the frame of the scene's poses (see the module)."""
    A, a = _applied(scene)
    T_here, scale_here = T @ np.linalg.inv(A), scale / a
    back = np.linalg.inv(T_here[:3, :3])
    moved = c2w.copy()
    moved[:, :3, :3] = back @ c2w[:, :3, :3]
    moved[:, :3, 3] = (c2w[:, :3, 3] / scale_here - T_here[:3, 3]) @ back.T
    if _written_by_colmap(scene):  # the frame before A and a
        undo = np.linalg.inv(A)
        moved[:, :3, 3] = (moved[:, :3, 3] / a) @ undo[:3, :3].T + undo[:3, 3]
        moved[:, :3, :3] = undo[:3, :3] @ moved[:, :3, :3]
    return moved


def _applied(scene: Path) -> tuple[np.ndarray, float]:
    """(A [4, 4], a) of the scene's transforms.json; the identity where it says nothing."""
    from roge_jax.scenes.formats.nerfstudio import transforms_files

    files = (
        [scene] if scene.suffix == ".json" else transforms_files(scene) if scene.is_dir() else []
    )
    content = read_json(files[0], "scene file") if files and is_file(files[0]) else {}
    content = content if isinstance(content, dict) else {}
    A = content.get("applied_transform")
    a = number(
        content.get("applied_scale", 1.0),
        str(files[0]) if files else "",
        "applied_scale",
        low=1e-30,
    )
    return np.eye(4) if A is None else entries.pose(A, f"{files[0]}: 'applied_transform'"), a


def _written_by_colmap(scene: Path) -> bool:
    from roge_jax.scenes.colmap import find_models
    from roge_jax.scenes.formats.nerfstudio import transforms_files

    return scene.is_dir() and not transforms_files(scene) and bool(find_models(scene))


def _read_transform(file: Path) -> tuple[np.ndarray, float]:
    """(T [4, 4], s) of a `dataparser_transforms.json`."""
    content = read_json(file, "transform")
    if not isinstance(content, dict) or "transform" not in content:
        raise UserError(
            f"{file}: has no 'transform': nerfstudio's {FILE} has 'transform' (3x4) and 'scale'."
        )
    T = entries.pose(content["transform"], f"{file}: 'transform'")
    scale = number(content.get("scale", 1.0), str(file), "scale", low=1e-30)
    if not np.isfinite(T).all() or abs(np.linalg.det(T[:3, :3])) < 1e-12:
        raise UserError(f"{file}: 'transform' is singular or not finite: copy it again.")
    return matrix(T.tolist(), (4, 4), str(file), "transform"), scale


def _found(path: Path, scene: Path | None) -> Path | None:
    """The transform of the training run: beside the path, in the scene, or in nerfstudio's `outputs/NAME/METHOD/TIME`.

    Raises: UserError if several runs say different things.
    """
    data = scene if scene is None or scene.is_dir() else scene.parent
    here = path.resolve().parent
    near = [here, here.parent, *([data.resolve()] if data else [])]
    for folder in near:
        if is_file(folder / FILE):
            return folder / FILE
    names: Sequence[Path] = [
        f.resolve() for f in (data, here.parent if here.name == "camera_paths" else here) if f
    ]
    found: list[Path] = []
    for one in dict.fromkeys(names):
        for base in (one, one.parent, one.parent.parent, Path.cwd()):
            found += sorted((base / "outputs" / one.name).glob(f"*/*/{FILE}"))
            found += sorted((base / "outputs" / one.name).glob(f"*/{FILE}"))
    found = list(dict.fromkeys(found))
    contents = {json.dumps(read_json(file), sort_keys=True) for file in found}
    if len(contents) > 1:
        raise UserError(
            f"{path}: {len(found)} training runs of nerfstudio have a {FILE}, and they differ: name one with "
            f"--path-frame (in Python frame=), e.g. {found[-1]}."
        )
    return found[0] if found else None
