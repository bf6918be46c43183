"""Learning to match: the features of `recon.matching`, from rendered scenes and their depth.

The loss is the cross entropy of the cuts of a target view's rays against the cut that its depth lies at (Zbontar & LeCun
2016 learn to tell matching patches apart; here all cuts of a ray compete, as they do when a picture is made). Rays
count whose point two photos see. Photos differ in exposure and have noise, as those of a camera.
"""

from typing import Any

import jax
import jax.numpy as jnp

from ..core.params import Tree
from ..recon.aggregate import box, occupied
from ..recon.depth import FINE_WINDOW
from ..recon.matching import described, evidence
from ..recon.sweep import (
    Motion,
    Texels,
    cut_at,
    fetch,
    in_pixels_of,
    inverse_depth,
    meet_at,
    motion,
    twins,
)

SIDE, PATCHES = 16, 4  # pixels of a square patch of rays; patches a view and level
SAME = 0.03  # of the depth: a photo sees a point if its own depth there is no further off
EXPOSURE, WHITE, NOISE = (
    0.08,
    0.03,
    0.02,
)  # deviations of a photo's gain, of a channel's, and of its noise at most
FURTHER = 1.2  # cuts reach up to e to this times nearer than the scene does


def matching_terms(
    match: Tree, views: dict[str, jax.Array], key: jax.Array, *, cuts: int
) -> dict[str, jax.Array]:
    """{"loss", "right"} of one scene at both levels: cross entropy, and the share of rays whose best cut is within 1.5.

    views: as by `data.views.make_sample` with depth, of one target; their size is that of the fine level.
    """
    m = len(views["context_rgb"])
    keys = jax.random.split(key, 3)
    photos = _developed(views["context_rgb"], keys[0])
    way = motion(views["K"][m:], views["c2w"][m:], views["K"][:m], views["c2w"][:m])
    way = Motion(way.turn[0], way.shift[0])
    depth = views["depth"]
    inverse = 1.0 / jnp.maximum(depth[m], 1e-3)
    nearest = jnp.quantile(inverse, 0.98)
    further = jnp.exp(FURTHER * jax.random.uniform(keys[1]))
    reach = jnp.clip(cut_at(nearest * further, cuts) / (cuts - 1), 0.02, 1.0)
    coarse = inverse_depth(jnp.arange(cuts, dtype=jnp.float32), cuts, reach)
    half = photos.reshape(m, photos.shape[1] // 2, 2, photos.shape[2] // 2, 2, 3).mean((2, 4))
    shared = (match, way, depth[:m], inverse, twins(views["c2w"][:m]))
    found = [
        _level(half, 2, coarse, *shared, jax.random.fold_in(keys[2], 0)),
        _level(photos, 1, occupied(inverse, cuts), *shared, jax.random.fold_in(keys[2], 1)),
    ]
    return jax.tree.map(lambda *x: jnp.stack(x).mean(), *found)


def _developed(photos: jax.Array, key: jax.Array) -> jax.Array:
    """Photos [m, h, w, 3] with exposure, white balance and noise of their own."""
    keys = jax.random.split(key, 4)
    m = len(photos)
    gain = jnp.exp(EXPOSURE * jax.random.normal(keys[0], (m, 1, 1, 1)))
    gain = gain * jnp.exp(WHITE * jax.random.normal(keys[1], (m, 1, 1, 3)))
    noise = NOISE * jax.random.uniform(keys[2], (m, 1, 1, 1))
    return jnp.clip(gain * photos + noise * jax.random.normal(keys[3], photos.shape), 0.0, 1.0)


def _level(photos, side: int, cuts, match, way, photo_depth, inverse, alike, key) -> dict[str, Any]:
    """The terms at photos [m, h, w, 3] whose pixels are `side` of those of the depths [m, H, W] and [H, W]."""
    _, h, w, _ = photos.shape
    k = len(cuts)
    row, column = jax.random.split(key)
    top = (
        jax.random.randint(row, (PATCHES, 1, 1), 0, h - SIDE + 1) + jnp.arange(SIDE)[None, :, None]
    )
    left = (
        jax.random.randint(column, (PATCHES, 1, 1), 0, w - SIDE + 1) + jnp.arange(SIDE)[None, None]
    )
    y, x = (z.reshape(-1) for z in jnp.broadcast_arrays(top, left))
    true = inverse[side * y + side // 2, side * x + side // 2]
    where = jnp.stack([x + 0.5, y + 0.5], -1)
    own = in_pixels_of(way, side)
    # Which photos see the point: their own depth where it projects to is the point's.
    px, py, ratio, seen = (z[:, 0] for z in meet_at(own, where, true[None], (h, w)))
    index = [
        jnp.clip(side * z, 0, n - 1).astype(jnp.int32) for z, n in ((py, side * h), (px, side * w))
    ]
    theirs = photo_depth[jnp.arange(len(photos))[:, None], *index]
    there = ratio / true[None]
    seen = seen * (jnp.abs(theirs - there) < SAME * there)

    values, inside = fetch(
        Texels.of(described(match, photos)),
        own,
        where,
        jnp.broadcast_to(cuts[:, None], (k, len(true))),
    )
    logits = evidence(match, values, inside, alike).reshape(k * PATCHES, SIDE, SIDE)
    logits = jax.nn.log_softmax(box(logits, FINE_WINDOW).reshape(k, -1), 0)
    at = jnp.interp(true, cuts, jnp.arange(k, dtype=jnp.float32))
    low = jnp.clip(jnp.floor(at), 0, k - 2)
    both = [jnp.take_along_axis(logits, (low[None] + i).astype(jnp.int32), 0)[0] for i in (0, 1)]
    entropy = -(both[0] + (at - low) * (both[1] - both[0]))
    counts = (seen.sum(0) > 1.5) & (true > cuts[0]) & (true < cuts[-1])
    right = jnp.abs(jnp.argmax(logits, 0) - at) < 1.5
    share = counts / jnp.maximum(counts.sum(), 1)
    return {"loss": (share * entropy).sum(), "right": (share * right).sum()}
