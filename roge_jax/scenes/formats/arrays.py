"""Cameras in npz and npy files: FrameCrafter, NeoVerse, and plain arrays of poses."""

from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import rotation
from roge_jax.scenes import entries
from roge_jax.scenes.formats import neoverse
from roge_jax.scenes.formats.folders import load_npz
from roge_jax.scenes.frames import NORMALISED, Frame, Reading, in_axes
from roge_jax.scenes.pictures import Finder

POSES = ("c2w", "c2ws", "poses", "pose", "camera_poses", "cam2world", "trajectory", "trajectories")
INVERSE = ("w2c_poses", "w2c", "w2cs", "extrinsics", "extrinsic", "world_to_camera")
KS = ("intrinsics", "intrinsic", "K", "Ks", "camera_intrinsics")


def read_npz(file: Path, *, convention: str | None) -> Reading:
    """An npz of poses [n, 4, 4] (camera to world, or `w2c_poses`) with or without `intrinsics`; OpenCV axes."""
    fields = load_npz(file)
    if "frame_matrices" in fields:  # NeoVerse
        return neoverse.from_matrices(fields, str(file), file, convention, None)
    name = next((n for n in (*INVERSE, *POSES) if n in fields), None)
    if name is None:
        raise UserError(
            f"{file}: has no poses: needs 'c2w' or 'w2c_poses' [n, 4, 4], has {', '.join(fields) or 'nothing'}."
        )
    axes = convention or ("opencv_w2c" if name in INVERSE else "opencv")
    poses = _stack(fields[name], f"{file}: '{name}'")
    K = next((fields[n] for n in KS if n in fields), None)
    Ks = [None] * len(poses) if K is None else _intrinsics(K, len(poses), str(file))
    size = _size(fields, str(file))
    count = int(np.ravel(fields["num_context"])[0]) if "num_context" in fields else 0
    reading = Reading(file, [], axes=axes)
    folders = [f for n in ("inputs", "images", ".") if (f := file.parent / n).is_dir()]
    finder = Finder(file.parent, folders)
    for i, (pose, k) in enumerate(zip(poses, Ks, strict=True)):
        picture = finder.find(str(i)) if i < count else None
        if i < count and picture is None:
            reading.missing.append(f"{i}.png")
        unit = NORMALISED if k is not None and size is None and np.abs(k).max() < 20 else size
        shown = picture.name if picture else ""
        cure = "correct 'orig_wh', or give the photos that the intrinsics are for"
        reading.frames.append(Frame(picture, k, in_axes(pose, axes), unit, name=shown, cure=cure))
    reading.looked = f"'{reading.missing[0]}' in {folders[0]}" if reading.missing else ""
    return reading


def read_npy(file: Path, *, convention: str | None) -> Reading:
    """An npy of poses: [n, 4, 4], [n, 3, 4], [n, 16], [n, 12], or [n, 7] as tx ty tz qx qy qz qw; OpenCV axes.

    Camera to world, but SpatialVID's `poses.npy` (seven numbers, beside `intrinsics.npy`) is world to camera.
    """
    try:
        values = np.load(file)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{file}: damaged npy file ({error}): copy it again.") from None
    seven = values.ndim == 2 and values.shape[1] == 7
    spatial = seven and file.name == "poses.npy" and file.with_name("intrinsics.npy").is_file()
    axes = convention or ("opencv_w2c" if spatial else "opencv")
    if seven:
        lengths = np.linalg.norm(values[:, 3:], axis=-1)
        if not ((lengths > 0.5) & (lengths < 2)).all():
            raise UserError(f"{file}: its rows of 7 are no 'tx ty tz qx qy qz qw'.")
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3, :3] = [rotation(q / n) for q, n in zip(values[:, 3:], lengths, strict=True)]
        poses[:, :3, 3] = values[:, :3]
    else:
        poses = _stack(values, f"{file}")
    beside = file.with_name("intrinsics.npy")
    Ks: list[Any] = [None] * len(poses)
    if beside.is_file() and beside != file:
        Ks = _intrinsics(np.load(beside), len(poses), str(beside))
    frames = [
        Frame(None, k, in_axes(pose, axes), NORMALISED if k is not None and np.abs(k).max() < 20 else None)
        for pose, k in zip(poses, Ks, strict=True)
    ]  # fmt: skip
    reading = Reading(file, frames, axes=axes)
    if seven and convention is None:
        way = "world to camera, as SpatialVID's" if spatial else "camera to world"
        reading.note(
            f"rows of seven numbers are read as {way}",
            "--convention opencv (camera to world) or opencv_w2c says which they are",
        )
    return reading


def _stack(values: Any, where: str) -> np.ndarray:
    found = np.asarray(values)
    if found.ndim < 2 or found.dtype.kind not in "iuf" or not len(found):
        raise UserError(f"{where} has shape {found.shape}: give poses [n, 4, 4].")
    if found.ndim == 2 and found.shape == (4, 4):
        found = found[None]
    return np.stack([entries.pose(pose, where) for pose in found])


def _intrinsics(values: Any, count: int, where: str) -> list[np.ndarray]:
    found = np.asarray(values)
    square = found.shape == (4, 4) and np.allclose(found[3], [0, 0, 0, 1])
    if found.ndim and found.shape[-1] == 4 and found.ndim <= 2 and not square:
        found = np.stack([entries.intrinsics(*row) for row in found.reshape(-1, 4).astype(float)])
    if found.ndim == 2:
        found = found[None]
    if found.ndim != 3 or found.shape[1] < 3 or found.shape[2] < 3 or len(found) not in (1, count):
        raise UserError(f"{where}: intrinsics of shape {np.shape(values)}: give [{count}, 3, 3].")
    found = np.broadcast_to(found[:, :3, :3], (count, 3, 3))
    return [np.asarray(K, np.float64) for K in found]


def _size(fields: dict[str, np.ndarray], where: str) -> tuple[int, int] | None:
    """(height, width) of `orig_wh` or of `height` and `width`."""
    if "orig_wh" in fields:
        wh = np.ravel(fields["orig_wh"])[:2]
        if len(wh) != 2 or not (wh >= 1).all():
            raise UserError(f"{where}: 'orig_wh' is {wh}: give width and height in pixels.")
        return int(wh[1]), int(wh[0])
    return entries.read_size({n: fields[n].item() for n in ("height", "width") if n in fields and fields[n].size == 1}, where)  # fmt: skip
