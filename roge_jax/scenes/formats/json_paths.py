"""Camera paths as JSON: our own, nerfstudio's viewer's, GEN3C's, Lyra's and instant-ngp's key frames, ReCamMaster's."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.fields import number
from roge_jax.geometry.cameras import rotation
from roge_jax.scenes import entries
from roge_jax.scenes.formats import neoverse
from roge_jax.scenes.formats.nerfstudio import check_convention, rate
from roge_jax.scenes.frames import Frame, Reading, in_axes

READ = (
    "a path file of ours ('convention' and 'frames' or 'keyframes'), nerfstudio's camera path or transforms.json, "
    "GEN3C's or Lyra's key frames, NeoVerse's moves, ReCamMaster's extrinsics"
)
FULL_HD = (1080, 1920)
# What a file may say that does not move or shape the camera, or that is in the frames already.
SILENT = {
    "convention", "frames", "keyframes", "count", "camera_path", "camera_type", "fps", "seconds", "is_cycle", "K",
    "smoothness_value", "default_fov", "default_transition_sec", "width", "height", "w", "h", "render_height",
    "render_width", "fov", "name", "path", "loop", "time", "duration_seconds", "spline_order", "camera_model",
    "is_fisheye", *entries.NUMBERS, *entries.DISTORTION,
}  # fmt: skip


def read(
    content: Any, file: Path, *, convention: str | None, target: entries.Size | None
) -> Reading:
    """A path of any of these forms. Raises UserError naming the forms if it is none."""
    if not isinstance(content, dict):
        raise UserError(f"{file}: expected an object with 'convention' and 'frames', or {READ}.")
    if _is_recammaster(content):
        return read_recammaster(content, file)
    if isinstance(content.get("path"), list) and "frames" not in content:
        return read_keys(content, file, target)
    if neoverse.is_neoverse(content):
        return neoverse.read(content, file, convention=convention)
    viewer = isinstance(content.get("camera_path"), list)
    keys = content.get("keyframes")
    listed = isinstance(keys, list) and keys and isinstance(keys[0], dict) and "matrix" in keys[0]
    if (viewer and content["camera_path"]) or listed:
        return read_viewer(content, file, convention=convention, target=target)
    if viewer and not keys:
        raise UserError(f"{file}: has no cameras: the list 'camera_path' is empty.")
    return read_own(content, file, convention=convention, target=target)


def _told(content: dict, reading: Reading) -> Reading:
    """The reading, with one note that names the fields nothing was done with."""
    unused = sorted(
        name
        for name, value in content.items()
        if name not in SILENT and value not in (None, [], {})
    )
    if unused:
        reading.note(
            f"fields that are not used: {', '.join(unused[:8])}",
            "docs/reference/formats.md lists those that are",
        )
    return reading


def _rate(content: dict, file: Path, frames: int) -> float | None:
    """Frames per second: as the file says, or so many frames in its `seconds`."""
    found = rate(content, file)
    if found is None and content.get("seconds") is not None:
        seconds = number(content["seconds"], str(file), "seconds", low=0)
        found = rate({"fps": frames / seconds}, file) if seconds else None
    return found


def _entries(content: dict, names: tuple[str, ...], field: str, file: Path) -> list[dict]:
    listed = next((content[name] for name in names if content.get(name) is not None), None)
    if not isinstance(listed, list) or not listed:
        raise UserError(f"{file}: has no cameras: give a list 'frames' or 'keyframes'.")
    for i, entry in enumerate(listed):
        if not isinstance(entry, dict):
            raise UserError(
                f"{file}, frame {i}: is no object with '{field}': give a 4x4 matrix there."
            )
    return listed


def _usable(entry: dict, field: str, where: str) -> np.ndarray:
    """The pose of one entry as [4, 4]."""
    if entry.get(field) is None:
        raise UserError(f"{where}: has no '{field}': give a 4x4 matrix (rows).")
    value = entry[field]
    if isinstance(value, str):  # the matrices of nerfstudio's first viewer are text
        try:
            value = json.loads(value)
        except ValueError:
            raise UserError(f"{where}: '{field}' must be a 4x4 matrix of numbers (rows).") from None
    found = entries.pose(value, f"{where}: '{field}'")
    if not np.isfinite(found).all() or abs(np.linalg.det(found[:3, :3])) < 1e-12:
        raise UserError(f"{where}: '{field}' has NaN, infinite or singular numbers: fix it.")
    return found


def read_own(
    content: dict, file: Path, *, convention: str | None, target: entries.Size | None
) -> Reading:
    """`convention`, intrinsics, and `frames` or `keyframes` with a `pose` each (docs/reference/formats.md)."""
    if "frames" in content and "keyframes" in content:
        raise UserError(f"{file}: has both 'frames' and 'keyframes': give one of the two.")
    listed = _entries(content, ("frames", "keyframes"), "pose", file)
    axes = content.get("convention") or convention or ""
    check_convention(axes, file)
    whole = "keyframes" not in content
    fps = _rate(content, file, len(listed)) if whole else rate(content, file)
    reading = Reading(file, [], axes=axes, fps=fps)
    for i, entry in enumerate(listed):
        where = f"{file}, frame {i}"
        pose = in_axes(_usable(entry, "pose", where), axes)
        K, size, lens = entries.camera(entry, content, where, target=target)
        reading.frames.append(Frame(None, K, pose, size, lens))
    if "keyframes" in content:
        reading.keys, reading.times = True, _times(listed, file)
        count = content.get("count")
        if count is not None:
            reading.count = number(count, str(file), "count", low=1, whole=True)
    return _told(content, reading)


def read_viewer(
    content: dict, file: Path, *, convention: str | None, target: entries.Size | None
) -> Reading:
    """nerfstudio's camera path: `camera_path[].camera_to_world` with `fov`, or only its `keyframes[].matrix`.

    In the normalised frame of its training run (`world.to_scene`), OpenGL axes. A key frame's matrix is by columns in
    the first viewer and by rows in the present one; the last row tells.
    """
    entries.refuse_projections([content], str(file))
    whole = bool(content.get("camera_path"))
    names, field = (("camera_path",), "camera_to_world") if whole else (("keyframes",), "matrix")
    listed = _entries(content, names, field, file)
    axes = content.get("convention") or convention or "opengl"
    check_convention(axes, file)
    fps = _rate(content, file, len(listed)) if whole else rate(content, file)
    reading = Reading(file, [], axes=axes, fps=fps, frame="nerfstudio")
    defaults = {k: v for k, v in content.items() if k not in ("fps", "seconds")}
    if content.get("default_fov") is not None:
        defaults.setdefault("fov", content["default_fov"])
    for i, entry in enumerate(listed):
        where = f"{file}, frame {i}"
        pose = _usable(entry, field, where)
        if not whole and np.abs(pose[3, :3]).max() > 1e-9 and np.abs(pose[:3, 3]).max() < 1e-9:
            pose = pose.T
        own = dict(entry)
        if "aspect" in own and "fov" in own and not whole:
            own.pop("aspect")
        K, size, lens = entries.camera(own, defaults, where, target=target)
        reading.frames.append(Frame(None, K, in_axes(pose, axes), size, lens))
    moving = [i for i, entry in enumerate(listed) if entry.get("render_time") is not None]
    if moving:
        reading.note(f"'render_time' of {len(moving)} frames is not used", "the scene stands still")
    if not whole:
        reading.keys = True
        reading.times, reading.count = _transitions(content, listed, file, reading.fps)
    return _told(content, reading)


def _transitions(
    content: dict, listed: list[dict], file: Path, fps: float | None
) -> tuple[np.ndarray | None, int | None]:
    """(times of key frames in seconds, number of frames) from their transitions, or from `seconds`."""
    default = content.get("default_transition_sec")
    times = None
    if default is not None:
        default = number(default, str(file), "default_transition_sec", low=1e-6)
        steps = [
            number(e.get("override_transition_sec"), str(file), "override_transition_sec", low=1e-6)
            if e.get("override_transition_enabled") and e.get("override_transition_sec") is not None
            else default
            for e in listed[1:]
        ]
        times = np.concatenate([[0.0], np.cumsum(steps)])
    seconds = content.get("seconds")
    length = number(seconds, str(file), "seconds", low=0) if seconds is not None else None
    length = float(times[-1]) if times is not None and len(times) > 1 else length
    return times, None if not length or fps is None else max(1, round(length * fps))


def read_keys(content: dict, file: Path, target: entries.Size | None) -> Reading:
    """Key frames of the editor of instant-ngp, GEN3C and Lyra: `path[]` {R quaternion x y z w, T, fov, timestamp}.

    OpenCV axes, in the editor's own coordinates.
    """
    listed = _entries(content, ("path",), "R", file)
    reading = Reading(file, [], axes="opencv", frame="unknown", keys=True, fps=rate(content, file))
    times = []
    for i, entry in enumerate(listed):
        where = f"{file}, key frame {i}"
        q, t = (np.ravel(np.asarray(entry.get(name, []), dtype=object)) for name in ("R", "T"))
        if len(q) != 4 or len(t) != 3:
            raise UserError(f"{where}: needs 'R' (quaternion, 4 numbers) and 'T' (3 numbers).")
        q = np.array([number(v, where, "R") for v in q])
        pose = np.eye(4)
        if not 0.5 < np.linalg.norm(q) < 2:
            raise UserError(f"{where}: 'R' has length {np.linalg.norm(q):.3g}: give a quaternion.")
        pose[:3, :3] = rotation(q / np.linalg.norm(q))
        pose[:3, 3] = [number(v, where, "T") for v in t]
        fov = {"fov": entry.get("fov")}  # vertical, for pictures of any size
        K, size, lens = entries.camera(fov, {}, where, target=target or FULL_HD)
        reading.frames.append(Frame(None, K, pose, size, lens))
        times.append(number(entry.get("timestamp", 0.0), where, "timestamp"))
    if (np.diff(times) > 0).all() and len(times) > 1:
        reading.times = np.array(times)
    return _told(content, reading)


def _is_recammaster(content: dict) -> bool:
    first = next(iter(content.items()), ("", None))
    return str(first[0]).startswith("frame") and isinstance(first[1], dict) and any(
        str(key).startswith("cam") for key in first[1]
    )  # fmt: skip


def read_recammaster(content: dict, file: Path) -> Reading:
    """ReCamMaster's `frameN: {camNN: "[..] [..] [..] [..]"}`: 4x4 by columns, Unreal's axes, centimetres; the first camera.

    Unreal's camera looks along x with y to the right and z up, in a left-handed world, whose y is turned around.
    """
    numbered = sorted(content, key=lambda key: int("".join(c for c in key if c.isdecimal()) or 0))
    cameras = sorted({name for key in numbered for name in content[key]})
    reading = Reading(file, [], axes="opencv", frame="first")
    for key in numbered:
        text = content[key].get(cameras[0])
        where = f"{file}, {key}, {cameras[0]}"
        try:
            rows = [row.split() for row in str(text).strip().strip("[]").split("] [")]
            found = np.array([[float(word) for word in row] for row in rows])
        except ValueError:
            found = np.zeros(0)
        if found.shape != (4, 4):
            raise UserError(f"{where}: needs a 4x4 matrix as text, '[1 0 0 0] [0 1 0 0] ..'.")
        unreal = found.T
        pose = np.eye(4)
        pose[:3, :3] = np.stack([unreal[:3, 1], -unreal[:3, 2], unreal[:3, 0]], -1)
        pose[:3, 3] = unreal[:3, 3] / 100.0
        pose[1] *= -1.0
        reading.frames.append(Frame(None, None, pose))
    if len(cameras) > 1:
        reading.note(
            f"the first of {len(cameras)} cameras is read, {cameras[0]}",
            f"write a file with the other one alone, of {', '.join(cameras[:4])} ..",
        )
    return reading


def _times(listed: list[dict], file: Path) -> np.ndarray | None:
    """The `time` of every key frame, or None if none has one."""
    if not any("time" in entry for entry in listed):
        return None
    times = np.array(
        [number(e.get("time", np.nan), f"{file}, frame {i}", "time") for i, e in enumerate(listed)]
    )
    if not np.all(np.diff(times) > 0):
        raise UserError(f"{file}: 'time' must be on every key frame, in increasing order.")
    return times
