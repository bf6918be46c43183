"""Which photos see what a path will look at: points along the target rays, projected into the photos.

Only cameras enter, so it costs next to nothing. Depth is unknown: points stand at several multiples of the distance
in focus, and nothing hides anything. Coverage is the mean over points of the best photo's view of each; adding a
photo never lowers it and gains less the more photos there are, so greedy choices are within 1 - 1/e of the best set;
exchanging photos one for one (`selections`) closes most of what is left.
"""

from collections.abc import Sequence

import numpy as np

from ..geometry.cameras import Cameras, to_host
from ..geometry.rays import plucker_float64, project
from ..geometry.trajectories import focus_distance
from .scene import Scene, cameras_at

FRAMES, GRID = 9, (4, 7)  # target views and rays of each that are looked at
DEPTHS = (0.5, 0.8, 1.25, 2.0, 4.0)  # in distances in focus
FALL = np.radians(25.0)  # between two rays to a point: one then stands in for the other 1/e as well
NOTHING = 1e-9  # a photo that adds less is not worth its place


def coverage(
    photos: Cameras, path: Cameras, height: int, width: int, *, frames: int = FRAMES
) -> np.ndarray:
    """How well each photo sees each point that the path looks at: [m, points] from 0 (not at all) to 1.

    Points of up to `frames` views of the path, evenly spread, one after another.
    Cameras in one frame, any unit; K in pixels of height x width images. Inside its picture a photo is worth
    exp(-angle / FALL), the angle being between its ray and the target's, times min(1, (its distance is
    to the target's as 1 to x)), because what is far away is seen coarsely.
    """
    photos, path = to_host(photos), to_host(path)
    looked = np.linspace(0, len(path) - 1, min(frames, len(path))).round().astype(int)
    path = path[looked]
    shrink = np.array([GRID[1] / width, GRID[0] / height, 1.0])[None, :, None]
    rays = plucker_float64(path.K * shrink, path.c2w, *GRID)[..., :3].reshape(len(path), -1, 3)
    focus = focus_distance(photos) if len(photos) > 1 else _reach(photos, path)
    depths = focus * np.array(DEPTHS)
    origin = path.centres[:, None, None]
    points = (origin + rays[:, :, None] * depths[None, None, :, None]).reshape(-1, 3)
    back = np.broadcast_to(origin, (*rays.shape[:2], len(depths), 3)).reshape(-1, 3)
    toward, distance = _directions(points, back)
    worth = []
    for K, c2w in zip(photos.K, photos.c2w, strict=True):
        pixels, _, front = project(K, c2w, points)
        inside = front & (pixels >= 0).all(-1) & (pixels <= np.array([[width, height]])).all(-1)
        ray, away = _directions(points, c2w[None, :3, 3])
        angle = np.arccos(np.clip((ray * toward).sum(-1), -1.0, 1.0))
        worth.append(
            np.where(inside, np.exp(-angle / FALL) * np.minimum(1.0, distance / away), 0.0)
        )
    return np.stack(worth)


def by_frame(photos: Cameras, path: Cameras, height: int, width: int) -> np.ndarray:
    """Coverage of every frame of the path by all photos together, 0 to 1: [n]."""
    worth = coverage(photos, path, height, width, frames=len(path))
    return worth.max(0).reshape(len(path), -1).mean(1)


def _directions(points: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    offset = points - origin
    length = np.maximum(np.linalg.norm(offset, axis=-1), 1e-300)
    return offset / length[:, None], length


def _reach(photos: Cameras, path: Cameras) -> float:
    """A distance for a single photo: three times as far as the path goes from it; 1 if it stays there."""
    reach = np.linalg.norm(path.centres - photos.centres[:1], axis=-1).max()
    return 3.0 * float(reach) if reach > 0 else 1.0


def see_path(scene: Scene, path: Cameras, m: int, height: int, width: int) -> list[int]:
    """Up to m views of a scene that together see most of what the path looks at, best first.

    For scenes of many photos, before they are read: `read_photos(scene, see_path(scene, path, 6, ...), config)`. Fewer
    than m if further photos would add nothing. The path's K is in pixels of height x width.
    """
    worth = coverage(cameras_at(scene, height, width), path, height, width)
    chosen = selections(worth, m)[-1]
    return [chosen[i] for i, _ in greedy(worth[list(chosen)])]


def covered(worth: np.ndarray, chosen: tuple[int, ...]) -> float:
    """Coverage by the `chosen` rows of `coverage`, 0 to 1."""
    return float(worth[list(chosen)].max(0).mean()) if chosen else 0.0


def selections(worth: np.ndarray, most: int | None = None) -> list[tuple[int, ...]]:
    """Sets of 1, 2, ... photos, each of them sorted, until another photo adds nothing or there are `most`.

    Each set is the one before and the photo that adds most; then a photo is exchanged for another as long as that
    raises the coverage. (Greedy sets alone start in the middle of the path and never leave it: of two photos they
    keep one that a better pair would not have.) Coverage never falls along the list. Deterministic.
    """
    sets: list[tuple[int, ...]] = []
    kept: tuple[int, ...] = ()
    while len(kept) < min(len(worth), len(worth) if most is None else most):
        grown = _best(worth, [kept], covered(worth, kept) + NOTHING)
        if not grown and kept:
            break
        kept = grown or (0,)
        while True:
            others = [tuple(i for i in kept if i != out) for out in kept]
            exchanged = _best(worth, others, covered(worth, kept) + NOTHING)
            if not exchanged:
                break
            kept = exchanged
        sets.append(kept)
    return sets


def _best(worth: np.ndarray, sets: Sequence[tuple[int, ...]], above: float) -> tuple[int, ...]:
    """Of all sets with one photo more, the one with the largest coverage, if that is `above`; else ()."""
    found: tuple[int, ...] = ()
    for some in sets:
        for photo in range(len(worth)):
            trial = tuple(sorted((*some, photo)))
            value = covered(worth, trial) if photo not in some else -1.0
            if value > above:
                found, above = trial, value
    return found


def greedy(worth: np.ndarray) -> list[tuple[int, float]]:
    """(photo, marginal gain) in the order of buying; photos that add nothing (duplicates) are left out.

    Deterministic: of equal photos the first.
    """
    best = np.zeros(worth.shape[1])
    order: list[tuple[int, float]] = []
    for _ in range(len(worth)):
        gains = (np.maximum(worth, best[None]) - best[None]).mean(1)
        gains[[i for i, _ in order]] = -1.0
        photo = int(np.argmax(gains))
        if gains[photo] <= NOTHING and order:
            break
        order.append((photo, float(gains[photo])))
        best = np.maximum(best, worth[photo])
    return order
