"""What will be filmed: a ready-made path with its options, or key frames of one's own."""

import dataclasses
from typing import Any

import numpy as np

from ..errors import UserError
from ..geometry.cameras import Cameras
from ..geometry.trajectories import make_path, preset_options
from ..sampling.inputs import MOST_FRAMES
from . import keyframes
from .keyframes import Keys

EASE = "ease"  # an option of every preset


@dataclasses.dataclass(frozen=True)
class Route:
    """`preset` None: the path goes through `keys`; else `options` and `frames` are those of the preset."""

    preset: str | None
    options: dict[str, Any]
    frames: int
    keys: Keys
    fps: float


def choose(route: Route, preset: str | None) -> Route:
    """With another preset, its options at their defaults; None for the key frames."""
    return dataclasses.replace(route, preset=preset, options=options_of(preset))


def options_of(preset: str | None) -> dict[str, Any]:
    """The options that the page shows for a preset, with their defaults."""
    return {} if preset is None else {**preset_options(preset), EASE: False}


def cameras(route: Route, context: Cameras, size: tuple[int, int]) -> Cameras:
    """The path, K in pixels of pictures of `size`, as are those of the photos `context`. Raises: UserError."""
    if route.preset is None:
        return keyframes.path(route.keys, size, route.fps)
    if not 1 <= route.frames <= MOST_FRAMES:
        raise UserError(f"A path of {route.frames} frames: give 1 to {MOST_FRAMES}.")
    return make_path(route.preset, context, route.frames, **route.options)


def as_keys(route: Route, context: Cameras, size: tuple[int, int]) -> Route:
    """The same path, roughly, as key frames that can be edited."""
    if route.preset is None:
        return route
    path = cameras(route, context, size)
    keys = keyframes.thinned(path, size[0], route.fps)
    return dataclasses.replace(route, preset=None, options={}, keys=keys)


def length(route: Route) -> tuple[int, float]:
    """(frames, seconds) of the path; none without key frames."""
    if route.preset is None:
        frames = keyframes.count(route.keys, route.fps) if route.keys else 0
    else:
        frames = route.frames
    return frames, frames / route.fps


def line(path: Cameras, most: int = 400) -> np.ndarray:
    """The centres of a path as line segments [k, 2, 3] to draw."""
    kept = np.unique(np.linspace(0, len(path) - 1, min(most, len(path))).round().astype(int))
    points = path.centres[kept]
    return np.stack([points[:-1], points[1:]], 1) if len(points) > 1 else np.zeros((0, 2, 3))
