"""NeoVerse's trajectories: named moves by frame number, or matrices at some frames, in JSON or npz.

Camera to world, OpenCV axes, relative to the first camera unless `mode` is "global". Between the given frames rotations
turn evenly and positions move evenly, as NeoVerse has it.
"""

from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError, did_you_mean
from roge_jax.files.fields import is_file, number
from roge_jax.scenes import entries
from roge_jax.scenes.frames import Frame, Reading, in_axes

FRAMES = 81  # where the file does not say how many
# Of each move: the axis that a positive angle turns about (OpenCV axes), or the direction of a positive distance.
TURNS = {"pan_right": (1, 1.0), "pan_left": (1, -1.0), "tilt_up": (0, 1.0), "tilt_down": (0, -1.0)}
MOVES = {
    "move_right": (0, 1.0), "move_left": (0, -1.0), "boom_down": (1, 1.0), "boom_up": (1, -1.0),
    "push_in": (2, 1.0), "pull_out": (2, -1.0),
}  # fmt: skip
ORBITS = {"orbit_right": 1.0, "orbit_left": -1.0}
ALL = (*TURNS, *MOVES, *ORBITS, "static")


def is_neoverse(content: Any) -> bool:
    """Whether a JSON's content is a trajectory of NeoVerse's."""
    if not isinstance(content, dict):
        return False
    keys = content.get("keyframes")
    if isinstance(keys, list) and keys and isinstance(keys[0], dict) and len(keys[0]) == 1:
        return str(next(iter(keys[0]))).isdecimal()
    return isinstance(content.get("trajectory"), dict)


def read(content: dict, file: Path, *, convention: str | None) -> Reading:
    """The path of a JSON with `keyframes` (moves) or `trajectory` (matrices, or the npz that holds them)."""
    count = number(content.get("num_frames", FRAMES), str(file), "num_frames", low=1, whole=True)
    if "keyframes" in content:
        times, poses = _moves(content["keyframes"], file)
        reading = _reading(times, poses, file, "opencv", count)
    else:
        given, where = content["trajectory"], f"{file}: 'trajectory'"
        if isinstance(given.get("file"), str):
            from roge_jax.scenes.formats.folders import load_npz

            other = Path(given["file"])
            other = other if is_file(other) else file.parent / other.name
            if not is_file(other):
                raise UserError(f"{where}: there is no file '{given['file']}': correct the name.")
            given = load_npz(other)
        reading = from_matrices(given, where, file, convention, count)
    mode = content.get("mode", "relative")
    if mode not in ("relative", "global"):
        raise UserError(f"{file}: 'mode' is {mode!r}: give relative or global.")
    reading.frame = "first" if mode == "relative" else "unknown"
    if content.get("zoom_ratio", 1.0) != 1.0:
        reading.note(
            "'zoom_ratio' is not used", "give --fov, or write the path with its own intrinsics"
        )
    return reading


def from_matrices(
    fields: Any, where: str, file: Path, convention: str | None, count: int | None
) -> Reading:
    """`frame_matrices` [n, 4, 4] at `frame_indices` (all frames if not given); `count` frames, up to the last index if None."""
    matrices = fields.get("frame_matrices")
    if matrices is None or not len(matrices):
        raise UserError(f"{where} has no 'frame_matrices': give 4x4 matrices there.")
    poses = np.stack([entries.pose(m, f"{where}: 'frame_matrices'") for m in matrices])
    listed = fields.get("frame_indices")
    times = np.arange(len(poses)) if listed is None else np.ravel(np.asarray(listed, np.float64))
    if len(times) != len(poses) or not (np.diff(times) > 0).all():
        raise UserError(
            f"{where}: 'frame_indices' must have one number a matrix, in increasing order."
        )
    frames = int(times[-1] - times[0]) + 1 if count is None else count
    return _reading(times, poses, file, convention or "opencv", frames)


def _reading(times: np.ndarray, poses: np.ndarray, file: Path, axes: str, count: int) -> Reading:
    poses = np.stack([in_axes(pose, axes) for pose in poses])
    if count != len(poses):
        poses = _joined(times, poses, count)
    reading = Reading(file, [Frame(None, None, pose) for pose in poses], axes=axes)
    reading.frame = "first"
    return reading


def _joined(times: np.ndarray, poses: np.ndarray, count: int) -> np.ndarray:
    """`count` poses, evenly spread in time: rotations by slerp, positions on straight lines."""
    from scipy.spatial.transform import Rotation, Slerp

    if len(poses) == 1:
        return np.repeat(poses, count, 0)
    at = np.linspace(times[0], times[-1], count)
    made = np.tile(np.eye(4), (count, 1, 1))
    made[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    for axis in range(3):
        made[:, axis, 3] = np.interp(at, times, poses[:, axis, 3])
    return made


def _moves(keys: list, file: Path) -> tuple[np.ndarray, np.ndarray]:
    """(frame numbers, poses): every key frame goes on from the one before by its moves, one after another."""
    times, poses, pose = [], [], np.eye(4)
    for i, key in enumerate(keys):
        where = f"{file}, key frame {i}"
        if not isinstance(key, dict) or len(key) != 1:
            raise UserError(f"{where}: is no object with one frame number: give {{'20': [moves]}}.")
        frame, moves = next(iter(key.items()))
        times.append(number(frame, where, "frame number", low=0, whole=True))
        for move in moves if isinstance(moves, list) else [moves]:
            if not isinstance(move, dict) or len(move) != 1:
                raise UserError(
                    f"{where}: a move is {{'pan_left': {{'angle': 20}}}}, not {move!r}."
                )
            name, options = next(iter(move.items()))
            if name not in ALL:
                raise UserError(
                    f"{where}: there is no move '{name}': {did_you_mean(str(name), ALL)}"
                )
            pose = pose @ _move(name, options if isinstance(options, dict) else {}, where)
        poses.append(pose)
    if not (np.diff(times) > 0).all():
        raise UserError(f"{file}: the frame numbers of 'keyframes' must increase.")
    return np.array(times, np.float64), np.stack(poses)


def _move(name: str, options: dict, where: str) -> np.ndarray:
    """The pose [4, 4] after one move, relative to the camera before it; NeoVerse's defaults for what is not given."""
    angle = np.radians(number(options.get("angle", 30), where, "angle"))
    distance = number(options.get("distance", 0.1), where, "distance")
    radius = number(options.get("orbit_radius", 0.5), where, "orbit_radius")
    pose = np.eye(4)
    if name in MOVES:
        axis, sign = MOVES[name]
        pose[axis, 3] = sign * distance
    elif name in TURNS:
        axis, sign = TURNS[name]
        pose[:3, :3] = _about(axis, sign * angle)
    elif name in ORBITS:  # around a point `radius` ahead, which stays in the middle
        angle *= ORBITS[name]
        pose[:3, :3] = _about(1, -angle)
        pose[:3, 3] = radius * np.array([np.sin(angle), 0.0, 1.0 - np.cos(angle)])
    return pose


def _about(axis: int, angle: float) -> np.ndarray:
    """A rotation about x (0) or y (1) by the right-hand rule: +x turns z up (towards -y), +y turns z to the right."""
    c, s = np.cos(angle), np.sin(angle)
    if axis == 0:
        return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])
