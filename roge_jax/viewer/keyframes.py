"""Key frames of a path: added, moved, timed and taken away, as pure functions of a tuple; read and written as path files."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..geometry.cameras import Cameras, to_host
from ..geometry.interpolation import interpolate
from ..sampling.inputs import MOST_FRAMES
from ..scenes.paths import KeyFrames, read_keys, save_keys

SECONDS = 1.0  # from one key frame to the next, where nobody says
LEAST = 0.01
THINNED = 9  # key frames that a path of many frames is turned into


@dataclasses.dataclass(frozen=True)
class Key:
    """A camera on a path: c2w [4, 4] in the scene's frame, vertical field of view in degrees, seconds since the key frame
    before (of the first one they do not count)."""

    c2w: np.ndarray
    fov: float
    seconds: float = SECONDS


Keys = tuple[Key, ...]


def added(keys: Keys, c2w: np.ndarray, fov: float, after: int | None = None) -> Keys:
    """With a new key frame after the one of that number, or at the end."""
    at = len(keys) if after is None else after + 1
    return (*keys[:at], Key(np.array(c2w, np.float64), fov), *keys[at:])


def removed(keys: Keys, number: int) -> Keys:
    """Without one key frame; that after it takes the time of both, so that the rest keeps its timing."""
    rest = list(keys[:number] + keys[number + 1 :])
    if 0 < number < len(rest):
        both = keys[number].seconds + keys[number + 1].seconds
        rest[number] = dataclasses.replace(rest[number], seconds=both)
    return tuple(rest)


def changed(
    keys: Keys,
    number: int,
    *,
    c2w: np.ndarray | None = None,
    fov: float | None = None,
    seconds: float | None = None,
) -> Keys:
    """With another pose, field of view or time since the key frame before. Raises: UserError for one that cannot be."""
    if fov is not None and not 0 < fov < 180:
        raise UserError(
            f"A field of view of {fov:g} degrees: give 0 to 180, the full vertical angle."
        )
    if seconds is not None and not LEAST <= seconds < 1e6:
        raise UserError(f"{seconds:g} s from one key frame to the next: give at least {LEAST:g}.")
    given = {"c2w": c2w, "fov": fov, "seconds": seconds}
    new = {name: value for name, value in given.items() if value is not None}
    return (*keys[:number], dataclasses.replace(keys[number], **new), *keys[number + 1 :])


def times(keys: Keys) -> np.ndarray:
    """Seconds of each key frame from the start of the path: [k]."""
    return np.concatenate([[0.0], np.cumsum([key.seconds for key in keys[1:]])])


def count(keys: Keys, fps: float) -> int:
    """How many frames the path has, its first and its last key frame among them."""
    return round(float(times(keys)[-1]) * fps) + 1


def path(keys: Keys, size: tuple[int, int], fps: float) -> Cameras:
    """The cameras of the path, K in pixels of pictures of `size` (height, width): what `sample --trajectory` makes of the
    file. Raises: UserError without key frames, or for more frames than a video may have."""
    if not keys:
        raise UserError("The path has no key frames: add one where you stand.")
    frames = count(keys, fps)
    if frames > MOST_FRAMES:
        raise UserError(f"A path of {frames} frames: at most {MOST_FRAMES} make a video.")
    s = np.linspace(0.0, 1.0, frames)
    return interpolate(key_cameras(keys, size), s, times=times(keys) if len(keys) > 1 else None)


def key_cameras(keys: Keys, size: tuple[int, int]) -> Cameras:
    """The key frames alone as cameras."""
    height, width = size
    K = np.zeros((len(keys), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = [0.5 * height / np.tan(np.radians(key.fov) / 2) for key in keys]
    K[:, :, 2] = width / 2, height / 2, 1.0
    return Cameras(K, np.stack([key.c2w for key in keys]))


def from_cameras(cameras: Cameras, height: int, seconds: Iterable[float] | None = None) -> Keys:
    """Key frames of cameras of pictures of that height; `seconds` since the one before, for each."""
    cameras = to_host(cameras)
    waits = [SECONDS] * len(cameras) if seconds is None else [float(s) for s in seconds]
    angles = 2 * np.degrees(np.arctan(0.5 * height / cameras.K[:, 1, 1]))
    return tuple(
        Key(c2w, float(fov), wait)
        for c2w, fov, wait in zip(cameras.c2w, angles, waits, strict=True)
    )


def thinned(cameras: Cameras, height: int, fps: float) -> Keys:
    """A path of many frames as a few key frames: first, last, and evenly between."""
    at = np.linspace(0, len(cameras) - 1, min(THINNED, len(cameras))).round().astype(int)
    waits = np.diff(at, prepend=at[0]) / fps
    return from_cameras(cameras[at], height, np.maximum(waits, LEAST))


def write(file: Path, keys: Keys, size: tuple[int, int], fps: float) -> None:
    """A path file that `sample --trajectory` and `read` take."""
    if not keys:
        raise UserError("The path has no key frames: add one where you stand.")
    timing = times(keys) if len(keys) > 1 else None
    cameras = key_cameras(keys, size)
    save_keys(file, KeyFrames(cameras, timing, count(keys, fps), fps), *size)


def read(
    file: Path, size: tuple[int, int], context: Cameras, scene: str | None, **whose: Any
) -> tuple[Keys, float | None]:
    """(key frames of a path file, its frames per second). A file of frames becomes a few key frames.

    context: the photos' cameras, K in pixels of pictures of `size`; scene: where it was read from; `whose`: the
      `convention` and the coordinates (`frame`) of the path, as of `scenes.paths.load_path`.
    """
    height, width = size
    found = read_keys(file, height=height, width=width, context=context, scene=scene, **whose)
    if found.whole:
        return thinned(found.cameras, height, found.fps or 16.0), found.fps
    if found.times is not None:
        waits = np.diff(found.times, prepend=found.times[0])
        return from_cameras(found.cameras, height, np.maximum(waits, LEAST)), found.fps
    waits = None
    if (
        found.count and found.fps and len(found.cameras) > 1
    ):  # evenly, in the time that the file says
        waits = [(found.count - 1) / found.fps / (len(found.cameras) - 1)] * len(found.cameras)
    return from_cameras(found.cameras, height, waits), found.fps
