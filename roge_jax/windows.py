"""How a long path is cut into windows of the model, and which views each of them sees."""

import numpy as np

from . import model
from .config import RoGeConfig
from .geometry.cameras import Cameras, Normalisation, camera_vector, concatenate, to_host
from .geometry.packing import pad_path

CHAIN_FRAMES = 2  # frames already made that join as contexts, where the model takes that many


def windows(frames: int, window: int) -> list[tuple[int, int]]:
    """[start, stop) of every window of a path."""
    return [(start, min(start + window, frames)) for start in range(0, frames, window)]


def chained(m: int, config: RoGeConfig) -> tuple[int, int]:
    """(photos, generated frames) that later windows see, of `m` photos: together at most `config.max_context`."""
    made = min(CHAIN_FRAMES, max(1, config.max_context - m), config.frames, config.max_context - 1)
    return min(m, config.max_context - made), made


def view_distance(a: Cameras, b: Cameras) -> np.ndarray:
    """[a, b]: how far apart views are, in normalised units of travel plus radians of turning."""
    a, b = to_host(a), to_host(b)
    travel = np.linalg.norm(a.centres[:, None] - b.centres[None], axis=-1)
    cosine = (np.einsum("aij,bij->ab", a.c2w[:, :3, :3], b.c2w[:, :3, :3]) - 1.0) / 2.0
    return travel + np.arccos(np.clip(cosine, -1.0, 1.0))


def chain_views(
    photos: Cameras, made: Cameras, ahead: Cameras, config: RoGeConfig
) -> tuple[list[int], list[int]]:
    """Which photos and which frames already made a later window sees (counts as in `chained`).

    The first photo stays: it is the world frame. Other photos stay if they are close to the window `ahead`. The last
    frame made is always in; the others are chosen one by one to bring the views ahead closest to what is seen.
    """
    keep, add = chained(len(photos), config)
    closeness = view_distance(photos, ahead).min(1)
    closeness[0] = -1.0
    kept = sorted(np.argsort(closeness, kind="stable")[:keep].tolist())
    gaps = view_distance(made, ahead)
    seen = view_distance(photos[kept], ahead).min(0)
    chosen: list[int] = []
    for _ in range(add):
        gain = np.minimum(gaps, seen[None]).mean(1)
        gain[chosen] = np.inf
        best = int(np.argmin(gain)) if chosen else len(made) - 1
        chosen.append(best)
        seen = np.minimum(seen, gaps[best])
    return kept, chosen


def window_views(
    images: np.ndarray,
    recon: np.ndarray | None,
    contexts: Cameras,
    targets: Cameras,
    info: Normalisation,
    config: RoGeConfig,
) -> model.Views:
    """The arrays that the model takes for one window; cameras are normalised, the path is padded to the window."""
    targets = pad_path(targets, config.frames)
    cameras = concatenate(contexts, targets)
    vectors = camera_vector(
        contexts, config.height, config.width, info.camera_scale, info.points_flag
    )
    views = {
        "context_rgb": images.astype(np.float32),
        "K": cameras.K.astype(np.float32),
        "c2w": cameras.c2w.astype(np.float32),
        "vectors": np.asarray(vectors, np.float32),
    }
    return views if recon is None else views | {"context_recon": recon.astype(np.float32)}
