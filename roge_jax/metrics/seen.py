"""How much of the error lies where: on what two photos show, what one shows, what none shows. Needs true depth.

Depth is z in its own camera, in the unit of c2w; K in pixels of the picture that the depth belongs to. NumPy.
"""

import numpy as np

from roge_jax.errors import UserError
from roge_jax.metrics.baselines import pixel_grid, project

TOLERANCE = (
    0.02  # of the depth: how far behind the photo's surface a point may seem and still be seen
)
CLASSES = ("seen_two", "seen_one", "unseen")


def seen_by(
    depth: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    photo_depth: np.ndarray,
    photo_K: np.ndarray,
    photo_c2w: np.ndarray,
    *,
    tolerance: float = TOLERANCE,
) -> np.ndarray:
    """How many photos see the surface of each pixel of the target view: [h, w] integers.

    depth [h, w] of the target; photo_depth [m, h', w'], photo_K [m, 3, 3], photo_c2w [m, 4, 4]. A photo sees a point that
    falls into it and is not more than `tolerance` of its depth behind the farthest of the four pixels around it: at an
    edge the benefit of the doubt goes to seen. Unknown depth (0, NaN) in the target gives -1.
    """
    depth = np.asarray(depth, np.float64)
    known = depth > 0.0
    filled = np.where(known, depth, 1.0)
    grid, count = pixel_grid(*depth.shape), np.zeros(depth.shape, np.int64)
    for surface, k, pose in zip(np.asarray(photo_depth, np.float64), photo_K, photo_c2w):
        h, w = surface.shape
        xy, z = project(grid, filled, k, pose, K, c2w)
        inside = (z > 0.0) & (xy >= 0.0).all(-1) & (xy[..., 0] <= w) & (xy[..., 1] <= h)
        x, y = (
            np.clip(np.floor(xy[..., i] - 0.5).astype(int), 0, n - 1) for i, n in enumerate((w, h))
        )
        x1, y1 = np.minimum(x + 1, w - 1), np.minimum(y + 1, h - 1)
        farthest = np.max([surface[y, x], surface[y, x1], surface[y1, x], surface[y1, x1]], axis=0)
        count += inside & (z <= farthest * (1.0 + tolerance))
    return np.where(known, count, -1)


def error_split(images: np.ndarray, references: np.ndarray, seen: np.ndarray) -> dict[str, float]:
    """Shares of the squared error in pixels seen by two or more photos, by one, by none; they add up to 1.

    images, references [n, h, w, 3]; seen [n, h, w] of `seen_by`, where -1 is left out. NaN if there is no error.
    """
    images, references, seen = (np.asarray(x) for x in (images, references, seen))
    if images.shape != references.shape or images.shape[:-1] != seen.shape:
        raise UserError(
            f"error_split takes frames [n, h, w, 3] twice and counts [n, h, w], not {images.shape}, {references.shape} "
            f"and {seen.shape}."
        )
    difference = np.clip(images, 0.0, 1.0) - np.clip(references, 0.0, 1.0)
    squared = np.asarray(np.sum(difference**2, axis=-1, dtype=np.float64))
    total = float(squared[seen >= 0].sum())
    parts = (float(squared[where].sum()) for where in _where(seen))
    return {
        f"error_{name}": part / total if total else float("nan")
        for name, part in zip(CLASSES, parts)
    }


def pixel_split(seen: np.ndarray) -> dict[str, float]:
    """Shares of the pixels of the three classes, to hold `error_split` against."""
    known = max(int((seen >= 0).sum()), 1)
    return {name: float(where.sum()) / known for name, where in zip(CLASSES, _where(seen))}


def _where(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return seen >= 2, seen == 1, seen == 0
