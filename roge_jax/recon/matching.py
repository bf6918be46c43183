"""How alike a photo and others are where a cut projects to: learned features beside colour and normalised luma.

As in MC-CNN (Zbontar & LeCun 2016) a small network describes every pixel by unit vectors, near and wide, and two photos
show the same point if theirs point the same way. It is trained on rendered scenes with their depth (`training.matching`)
and compares photos only: what a photo's depth is follows from the aggregation (`recon.depth`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..core.layers import conv2d, conv2d_specs
from ..core.params import Spec, Tree, ones
from .aggregate import with_structure
from .sweep import Motion, Size, Texels, fetch, meet, nearest

HIDDEN, VECTOR = 16, 8  # channels of the layers, and of each of the two descriptions of a pixel
STRANGE = -4.0  # evidence for a cut that no other photo sees, in units of a logit
COLOUR = 10.0  # scale of a difference of colours
MOST = 2.0  # differences of structure above this count no more
VECTORS = 4.0  # what full agreement of two vectors weighs before training


def matching_specs() -> Tree:
    """Leaves of `vectors` and `evidence`."""
    near = (
        ("conv1", 4, HIDDEN),
        ("conv2", HIDDEN, HIDDEN),
        ("conv3", HIDDEN, HIDDEN),
        ("conv4", HIDDEN, VECTOR),
    )
    wide = (("conv1", HIDDEN, HIDDEN), ("conv2", HIDDEN, HIDDEN), ("conv3", HIDDEN, VECTOR))
    weights = Spec(
        (5,), (None,), ones
    )  # near, wide, colour, structure, sharpness of the choice between photos
    return {
        "near": {name: conv2d_specs(a, b, 3) for name, a, b in near},
        "wide": {name: conv2d_specs(a, b, 3) for name, a, b in wide},
        "weights": weights,
    }


class Described(NamedTuple):
    """Photos of one size as they are compared, ready to be read from."""

    plain: Texels  # colour and structure, read between pixels
    vectors: jax.Array | None  # [m h w, 2 VECTOR] read at the nearest pixel; None: not learned

    @classmethod
    def of(cls, descriptions: jax.Array) -> "Described":
        """Of `descriptions` [m, h, w, c]."""
        vectors = descriptions[..., :-4]
        rows = vectors.reshape(-1, 2 * VECTOR) if vectors.shape[-1] else None
        return cls(Texels.of(descriptions[..., -4:]), rows)

    def at(self, way: Motion, pixels: jax.Array, inverse: jax.Array, size: Size):
        """Descriptions [m, k, p, c] where one view's rays meet their cuts, and whether they are seen (`sweep.fetch`)."""
        values, seen = fetch(self.plain, way, pixels, inverse, size)
        if self.vectors is None:
            return values, seen
        x, y, _ = meet(way, pixels, inverse, size)
        h, w = self.plain.size
        first = self.plain.number[:, None, None] * (h * w)
        return jnp.concatenate([nearest(self.vectors, x, y, (h, w), first), values], -1), seen


def descriptions(p: Tree | None, photos: jax.Array) -> jax.Array:
    """What pixels of photos [m, h, w, 3] in [0, 1] are compared by [m, h, w, 2 VECTOR + 4]: two unit vectors, colour and
    structure. Without leaves (None) the latter two alone."""
    photos = with_structure(photos)
    return photos if p is None else jnp.concatenate([vectors(p, photos), photos], -1)


def vectors(p: Tree, photos: jax.Array) -> jax.Array:
    """The two unit vectors of every pixel [m, h, w, 2 VECTOR] of photos with structure [m, h, w, 4]."""
    near, wide = p["near"], p["wide"]
    y = jnp.concatenate([photos[..., :3] - 0.5, photos[..., 3:] / 3.0], -1)
    y = jax.nn.relu(conv2d(near["conv1"], y))
    y = jax.nn.relu(conv2d(near["conv2"], y))
    y = y + jax.nn.relu(conv2d(near["conv3"], y))
    m, h, w, c = y.shape
    z = jax.image.resize(y, (m, -(-h // 2), -(-w // 2), c), "linear", antialias=True)
    z = jax.nn.relu(conv2d(wide["conv1"], z))
    z = z + jax.nn.relu(conv2d(wide["conv2"], z))
    z = jax.image.resize(_unit(conv2d(wide["conv3"], z)), (m, h, w, VECTOR), "linear")
    return jnp.concatenate([_unit(conv2d(near["conv4"], y)), z], -1)


def _unit(x: jax.Array) -> jax.Array:
    return x * jax.lax.rsqrt(jnp.square(x).sum(-1, keepdims=True) + 1e-4)


def evidence(p: Tree | None, own: jax.Array, values: jax.Array, weight: jax.Array) -> jax.Array:
    """Logits [l, p] of cuts of a photo's pixels, of descriptions `own` [p, c], from those of k others there [k, l, p, c].

    weight: [k, l, p] whether another photo sees the cut, and from elsewhere. The best of the photos decides, softly,
    since one may look at something in front.
    """
    agreed = jnp.stack([_agreement(p, own, other) for other in values])
    sharp = 1.0 if p is None else p["weights"][4]
    count = weight.sum(0)
    best = jax.lax.stop_gradient(jnp.where(weight > 0, agreed, -jnp.inf).max(0))
    best = jnp.where(jnp.isfinite(best), best, 0.0)
    mass = (weight * jnp.exp(jnp.minimum(sharp * (agreed - best[None]), 0.0))).sum(0)
    level = best + jnp.log(mass / jnp.maximum(count, 1e-6) + 1e-9) / sharp
    return jnp.where(count > 0.5, level, STRANGE)


def _agreement(p: Tree | None, own: jax.Array, b: jax.Array) -> jax.Array:
    """Of descriptions `own` [p, c] and another photo's [l, p, c]. Sums along a short last axis are written out: they take ten times as long."""
    a = own[None]
    apart = [jnp.abs(a[..., c] - b[..., c]) for c in range(-4, 0)]
    colour = COLOUR / 3.0 * (apart[0] + apart[1] + apart[2])
    structure = jnp.minimum(apart[3], MOST)
    if p is None:
        return -2.0 * colour - structure
    near, wide = (
        sum(a[..., c] * b[..., c] for c in range(first, first + VECTOR)) for first in (0, VECTOR)
    )
    w = p["weights"]
    return VECTORS * (w[0] * near + w[1] * wide) - w[2] * colour - w[3] * structure
