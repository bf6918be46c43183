"""What the single frame cannot show: errors that change from frame to frame, and detail that comes and goes.

Inputs: `images` and `references` [n, h, w, 3] in [0, 1], the frames of one path in order. float64 NumPy.
"""

from collections.abc import Sequence

import numpy as np

from roge_jax.errors import UserError
from roge_jax.metrics.image import sharpness_ratio

NEAR, FAR = 1 / 3, 2 / 3  # of the way from a photo to half-way between two


def temporal_ratio(
    images: np.ndarray, references: np.ndarray, places: Sequence[int] | None = None
) -> float:
    """RMS of the change of the error between successive frames, over the RMS of the error of those frames.

    0: the error stands still in the picture. sqrt(2) = 1.41: errors of successive frames are independent, the picture
    boils. 2: the error flips its sign. `places` are the frames' numbers along the path; only frames whose numbers differ by
    one are successive (default: all are). NaN where no two are, or where there is no error.
    """
    images, references = _frames("temporal_ratio", images, references)
    steps = np.ones(len(images) - 1) if places is None else np.diff(np.asarray(places))
    pairs = np.flatnonzero(steps == 1)
    error = np.clip(images, 0.0, 1.0) - np.clip(references, 0.0, 1.0)
    own = sum(np.mean(error[i] ** 2) + np.mean(error[i + 1] ** 2) for i in pairs) / 2.0
    change = sum(np.mean((error[i + 1] - error[i]) ** 2) for i in pairs)
    return float(np.sqrt(change / own)) if own > 0.0 else float("nan")


def pumping_ratio(
    images: np.ndarray, references: np.ndarray, places: Sequence[int], photos: Sequence[int]
) -> float:
    """Fine detail half-way between photos over that at photos; 1 is steady, below 1 the picture pulses.

    `places` are the frames' numbers along the path and `photos` those of the photos on it. Detail is the frame's
    `sharpness_ratio` to its truth, so that a truth of changing detail does not count. Half-way: the middle third of
    the way between two photos. At photos: the sixths beside them. Frames outside the photos are left out. NaN where
    either kind is missing.
    """
    images, references = _frames("pumping_ratio", images, references)
    stops = np.unique(np.asarray(photos, np.float64))
    between = (
        np.interp(places, stops, np.arange(len(stops)), -1.0, -1.0)
        if len(stops) > 1
        else -np.ones(len(places))
    )
    away = 1.0 - np.abs(2.0 * (between % 1.0) - 1.0)  # 0 at a photo, 1 half-way
    half_way, beside = ((between >= 0.0) & where for where in (away >= FAR, away <= NEAR))
    if not half_way.any() or not beside.any():
        return float("nan")
    detail = sharpness_ratio(images, references)
    return float(np.mean(detail[half_way]) / np.mean(detail[beside]))


def _frames(name: str, images: np.ndarray, references: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    images, references = np.asarray(images, np.float64), np.asarray(references, np.float64)
    if images.shape != references.shape or images.ndim != 4 or not len(images):
        raise UserError(
            f"{name} compares frames [n, h, w, 3] of one shape, not {images.shape} and {references.shape}."
        )
    return images, references
