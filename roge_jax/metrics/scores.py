"""All numbers of one method on one scene, as the evaluation program writes them."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from roge_jax.metrics import image, seen, sequence
from roge_jax.metrics.learned import Metric

SETTINGS = image.SETTINGS | {
    "lpips_alex": "LPIPS v0.1, AlexNet, per frame at the size of the truth",
    "lpips_vgg": "LPIPS v0.1, VGG16, per frame at the size of the truth",
    "temporal_ratio": "RMS change of the error between successive frames / RMS error; independent errors: 1.41",
    "pumping_ratio": "sharpness half-way between photos / beside photos",
    "error_seen_two": "share of the squared error in pixels that two or more photos see (true depth, 2 %)",
    "error_seen_one": "the same, one photo",
    "error_unseen": "the same, no photo",
}


def scores(
    frames: np.ndarray,
    truth: np.ndarray,
    learned: Mapping[str, Metric],
    *,
    places: Sequence[int] | None = None,
    photos: Sequence[int] = (),
    counts: np.ndarray | None = None,
) -> dict[str, float]:
    """{metric: value} of frames [n, h, w, 3] against the truth; values are clipped to [0, 1] first.

    learned: metrics like those of `learned.lpips_metrics`. places: the frames' numbers along one path, None if each stands by
    itself; photos: the numbers of the photos on it. counts: [n, h, w] of `seen.seen_by` where true depth is known.
    """
    frames = np.clip(frames, 0.0, 1.0)
    found: dict[str, Any] = dict(image.image_metrics(frames, truth))
    for name, metric in learned.items():
        found[name] = float(np.mean(metric(jnp.float32(frames), jnp.float32(truth))))
    if places is not None:
        found["temporal_ratio"] = sequence.temporal_ratio(frames, truth, places)
        found["pumping_ratio"] = sequence.pumping_ratio(frames, truth, places, photos)
    if counts is not None:
        found |= seen.error_split(frames, truth, counts)
    return found
