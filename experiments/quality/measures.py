"""What a batch of generated videos is judged by: against the truth, the reference solution, and the cameras."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.quality.scenes import Scenes
from roge_jax import model
from roge_jax.config import RoGeConfig
from roge_jax.metrics import image, report
from roge_jax.metrics.baselines import bilinear

IMAGE = ("psnr", "sharpness_ratio", "gradient_psnr")
GAP = 4  # frames between the two views that are compared with one another
SAME_SURFACE = 0.03  # relative difference in depth

MEANING = {
    "latent_error": "relative L2 of the target latents to the reference solution's",
    "psnr": "dB to the truth, mean over frames",
    "psnr_reference": "dB to the frames of the reference solution, mean over frames",
    "sharpness_ratio": image.SETTINGS["sharpness_ratio"],
    "gradient_psnr": image.SETTINGS["gradient_psnr"],
    "consistency": f"dB between frames {GAP} apart, one moved onto the other by true depth and cameras, where both see the same surface; blur raises it",
}


class Judge:
    """Decodes latents of one batch of scenes and scores frames."""

    def __init__(self, params: Any, config: RoGeConfig, scenes: Scenes):
        self.params, self.scenes = params, scenes
        self._decode = _decoder(config)
        self.pairs = [
            same_surface(depth, K[scenes.m :], c2w[scenes.m :])
            for depth, K, c2w in zip(scenes.depth, scenes.K, scenes.c2w)
        ]

    def frames(self, latents: jax.Array, *, generated: bool = True) -> np.ndarray:
        """[s, t, lh, lw, 16] -> [s, n, h, w, 3] in [0, 1]; what is not `generated` gets no detail of the preview."""
        detail = self.scenes.prepared.detail if generated else None
        return np.asarray(self._decode(self.params, latents, detail))

    def scores(self, frames: np.ndarray) -> dict[str, list[float]]:
        """{metric: one number a scene}"""
        found: dict[str, list[float]] = {name: [] for name in (*IMAGE, "consistency")}
        for video, truth, pairs in zip(frames, self.scenes.truth, self.pairs):
            values = image.image_metrics(video, truth, IMAGE)
            for name in IMAGE:
                found[name].append(values[name])
            found["consistency"].append(consistency(video, pairs))
        return found

    def against(self, latents, frames, reference, reference_frames) -> dict[str, list[float]]:
        """Closeness to the reference solution."""
        axes = tuple(range(1, latents.ndim))
        gap = jnp.sqrt(jnp.sum((latents - reference) ** 2, axes) / jnp.sum(reference**2, axes))
        close = [
            float(np.mean(image.psnr(a.astype(np.float64), b.astype(np.float64))))
            for a, b in zip(frames, reference_frames)
        ]
        return {"latent_error": gap.tolist(), "psnr_reference": close}


@functools.cache
def _decoder(config: RoGeConfig):
    def decode(params, latents, detail):
        return model.decode_video(params, latents, config=config, detail=detail)

    return jax.jit(jax.vmap(decode, in_axes=(None, 0, 0)))


def same_surface(depth: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> list[tuple]:
    """[(i, j, pixels [h, w, 2] of view j, mask [h, w])] of views GAP apart: where a pixel of i lies in j, if seen there.

    depth [n, h, w] z, K [n, 3, 3], c2w [n, 4, 4]. A pixel counts if the depth that view j has there agrees to 3 %.
    """
    n, h, w = depth.shape
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], -1)
    found = []
    for i in range(0, n - GAP, GAP):
        j = i + GAP
        points = (pixels @ np.linalg.inv(K[i]).T) * depth[i][..., None]
        motion = np.linalg.inv(c2w[j]) @ c2w[i]
        points = points @ motion[:3, :3].T + motion[:3, 3]
        z = points[..., 2]
        seen = points @ K[j].T
        xy = seen[..., :2] / np.where(z > 1e-6, z, 1.0)[..., None]
        inside = (z > 1e-6) & (xy >= 0).all(-1) & (xy[..., 0] <= w) & (xy[..., 1] <= h)
        there = bilinear(depth[j][..., None], xy)[..., 0]
        found.append((i, j, xy, inside & (np.abs(there - z) < SAME_SURFACE * z)))
    return found


def consistency(frames: np.ndarray, pairs: list[tuple]) -> float:
    """-10 log10 of the mean squared colour difference on the same surface, dB."""
    errors, count = 0.0, 0
    for i, j, xy, mask in pairs:
        moved = bilinear(frames[j].astype(np.float64), xy[mask])
        errors += float(np.sum((frames[i][mask] - moved) ** 2))
        count += 3 * int(mask.sum())
    return float(-10.0 * np.log10(max(errors / max(count, 1), 1e-10)))


def summary(scores: dict[str, list[float]]) -> dict[str, dict[str, float]]:
    """{metric: {mean, low, high}}: bootstrap over scenes, 95 %."""
    out = {}
    for name, values in scores.items():
        found = report.bootstrap(values, resamples=2000)
        out[name] = {k: found[k] for k in ("mean", "low", "high")}
    return out


def difference(a: list[float], b: list[float]) -> dict[str, float]:
    """a - b, paired over scenes: {mean, low, high}."""
    found = report.bootstrap(np.subtract(a, b), resamples=2000)
    return {k: found[k] for k in ("mean", "low", "high")}
