"""Learning to match: the features of `recon.matching`, from rendered scenes and their depth.

The loss is the cross entropy of the cuts of a view's rays against the cut that its depth lies at (Zbontar & LeCun 2016
learn to tell matching patches apart; here all cuts of a ray compete, as they do in `recon.depth`). Rays count whose point
another photo sees. Photos differ in exposure and have noise, as those of a camera.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ..core.lora import attach
from ..core.params import Tree
from ..model import over_scenes
from ..recon.aggregate import box, occupied
from ..recon.aligned import in_common
from ..recon.depth import FINE_WINDOW, Partners
from ..recon.matching import descriptions
from ..recon.rendering import Photos
from ..recon.sweep import Motion, cut_at, inverse_depth, meet_at, motion, twins

SIDE, PATCHES = 16, 4  # pixels of a square patch of rays; patches a view and level
SAME = 0.03  # of the depth: a photo sees a point if its own depth there is no further off
EXPOSURE, WHITE = 0.08, 0.03  # deviations of the logarithms of a photo's gain and of a channel's
NOISE = 0.02  # deviation of a photo's noise at most
FURTHER = 1.2  # cuts reach up to e to this times nearer than the scene does


def objective(trainable, frozen, batch, key, *, config, stage):
    """`matching_terms` of a batch of scenes (`training.stages`)."""
    match = attach(frozen, trainable)["renderer"]["lookup"]["match"]
    keys = jax.random.split(key, batch["K"].shape[0])
    term = functools.partial(matching_terms, cuts=config.renderer.lookup)
    terms = {k: v.mean() for k, v in over_scenes(term, match, batch, keys).items()}
    return terms["loss"], {"right": terms["right"]}


def matching_terms(
    match: Tree, views: dict[str, jax.Array], key: jax.Array, *, cuts: int
) -> dict[str, jax.Array]:
    """{"loss", "right"} of one scene at both levels: cross entropy, and the share of rays whose best cut is within 1.5.

    views: as by `data.views.make_sample` with depth, of one target, which is compared with the photos; their size is that
      of the fine level.
    """
    m = len(views["context_rgb"])
    keys = jax.random.split(key, 3)
    seen_by = jnp.concatenate([views["context_rgb"], views["target_rgb"]])
    *photos, own = _developed(seen_by, keys[0])
    K, c2w = views["K"], views["c2w"]
    way = motion(K[m:], c2w[m:], K[:m], c2w[:m])
    way = Motion(way.turn[0], way.shift[0])
    inverse = 1.0 / jnp.maximum(views["depth"][m], 1e-3)
    nearest = jnp.quantile(inverse, 0.98)
    further = jnp.exp(FURTHER * jax.random.uniform(keys[1]))
    reach = jnp.clip(cut_at(nearest * further, cuts) / (cuts - 1), 0.02, 1.0)
    coarse = inverse_depth(jnp.arange(cuts, dtype=jnp.float32), cuts, reach)
    plane = in_common(way, own.shape[:2], coarse)
    lesson = Lesson(way, plane, 1.0 - twins(c2w)[m, :m], views["depth"][:m], inverse)
    found = [
        _level(match, jnp.stack([*photos, own]), side, at, lesson, jax.random.fold_in(keys[2], i))
        for i, (side, at) in enumerate(((2, coarse), (1, occupied(inverse, cuts))))
    ]
    return jax.tree.map(lambda *x: jnp.stack(x).mean(), *found)


class Lesson(NamedTuple):
    """What both levels of a view and its m photos share; pixels are those of the fine level."""

    way: Motion  # from the view to the photos
    plane: jax.Array  # [m] see `recon.aligned`
    different: jax.Array  # [m] 0 for a photo from the view's own place
    photo_depth: jax.Array  # [m, h, w]
    inverse: jax.Array  # [h, w] the view's true inverse depth


def _developed(photos: jax.Array, key: jax.Array) -> jax.Array:
    """Photos [m, h, w, 3] with exposure, white balance and noise of their own."""
    keys = jax.random.split(key, 4)
    m = len(photos)
    gain = jnp.exp(EXPOSURE * jax.random.normal(keys[0], (m, 1, 1, 1)))
    gain = gain * jnp.exp(WHITE * jax.random.normal(keys[1], (m, 1, 1, 3)))
    noise = NOISE * jax.random.uniform(keys[2], (m, 1, 1, 1))
    return jnp.clip(gain * photos + noise * jax.random.normal(keys[3], photos.shape), 0.0, 1.0)


def _level(
    match: Tree, pictures: jax.Array, side: int, cuts: jax.Array, lesson: Lesson, key: jax.Array
) -> dict[str, Any]:
    """The terms of photos and view [m + 1, h, w, 3], shrunk to pixels of `side` of the fine level's."""
    n, h, w, _ = pictures.shape
    pictures = pictures.reshape(n, h // side, side, w // side, side, 3).mean((2, 4))
    n, h, w, _ = pictures.shape
    k, m = len(cuts), n - 1
    row, column = jax.random.split(key)
    inside = jnp.arange(SIDE)
    top = jax.random.randint(row, (PATCHES, 1, 1), 0, h - SIDE + 1) + inside[None, :, None]
    left = jax.random.randint(column, (PATCHES, 1, 1), 0, w - SIDE + 1) + inside[None, None]
    y, x = (z.reshape(-1) for z in jnp.broadcast_arrays(top, left))
    true = lesson.inverse[side * y + side // 2, side * x + side // 2]
    where = side * jnp.stack([x + 0.5, y + 0.5], -1)
    # Which photos see the point: their own depth where it projects to is the point's.
    px, py, ratio, seen = (
        z[:, 0] for z in meet_at(lesson.way, where, true[None], (side * h, side * w))
    )
    index = [jnp.clip(z, 0, s - 1).astype(jnp.int32) for z, s in ((py, side * h), (px, side * w))]
    theirs = lesson.photo_depth[jnp.arange(m)[:, None], *index]
    there = ratio / true[None]
    seen = seen * lesson.different[:, None] * (jnp.abs(theirs - there) < SAME * there)

    one = jnp.ones((m, 2))
    size = one * jnp.asarray([[h, w]])
    photos = Photos(pictures[:m], pictures[:m], size, one / side, 0.0 * one)
    partners = Partners.of(
        match, photos, lesson.way, lesson.plane, photos.window(0), lesson.different
    )
    own = descriptions(match, pictures[m:])[0, y, x]
    many = jnp.broadcast_to(cuts[:, None], (k, len(true)))
    logits, _ = partners.compared(match, own, where, many)
    logits = logits.reshape(k * PATCHES, SIDE, SIDE)
    logits = jax.nn.log_softmax(box(logits, FINE_WINDOW).reshape(k, -1), 0)
    at = jnp.interp(true, cuts, jnp.arange(k, dtype=jnp.float32))
    low = jnp.clip(jnp.floor(at), 0, k - 2)
    both = [jnp.take_along_axis(logits, (low[None] + i).astype(jnp.int32), 0)[0] for i in (0, 1)]
    entropy = -(both[0] + (at - low) * (both[1] - both[0]))
    counts = (seen.sum(0) > 0.5) & (true > cuts[0]) & (true < cuts[-1])
    right = jnp.abs(jnp.argmax(logits, 0) - at) < 1.5
    share = counts / jnp.maximum(counts.sum(), 1)
    return {"loss": (share * entropy).sum(), "right": (share * right).sum()}
