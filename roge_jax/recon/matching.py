"""How alike photos are where a cut projects to: learned matching features beside colour and normalised luma.

As in MC-CNN (Zbontar & LeCun 2016) a small network describes every pixel by unit vectors, near and wide, and two photos
show the same point if theirs point the same way. It is trained on rendered scenes with their depth (`training.matching`)
and compares photos only: what a view's depth is follows from the aggregation (`recon.aggregate`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..core.layers import conv2d, conv2d_specs
from ..core.params import Spec, Tree, ones
from .aggregate import with_structure
from .sweep import Motion, Size, Texels, fetch, meet, nearest

HIDDEN, VECTOR = 16, 8  # channels of the layers, and of each of the two descriptions of a pixel
STRANGE = -4.0  # evidence for a cut that no two photos see, in units of a logit
COLOUR, MOST = (
    10.0,
    2.0,
)  # scale of a difference of colours; differences of structure above this count no more
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
    )  # near, wide, colour, structure, sharpness of the choice between pairs
    return {
        "near": {name: conv2d_specs(a, b, 3) for name, a, b in near},
        "wide": {name: conv2d_specs(a, b, 3) for name, a, b in wide},
        "weights": weights,
    }


class Described(NamedTuple):
    """Photos of one size as they are compared, ready to be read from."""

    plain: Texels  # colour and structure, read between pixels
    vectors: (
        jax.Array | None
    )  # [m h w, 2 VECTOR] unit vectors, read at the nearest pixel; None: not learned

    def at(self, way: Motion, pixels: jax.Array, inverse: jax.Array, size: Size):
        """Values [m, k, p, 2 VECTOR + 4] where one view's rays meet their cuts, and whether they are seen (`sweep.fetch`)."""
        values, seen = fetch(self.plain, way, pixels, inverse, size)
        if self.vectors is None:
            return values, seen
        x, y, _ = meet(way, pixels, inverse, size)
        h, w = self.plain.size
        first = self.plain.number[:, None, None] * (h * w)
        return jnp.concatenate([nearest(self.vectors, x, y, (h, w), first), values], -1), seen

    def among(self, kept: jax.Array) -> "Described":
        """Some of the photos [k]."""
        return self._replace(plain=self.plain._replace(number=self.plain.number[kept]))


def described(p: Tree | None, photos: jax.Array) -> Described:
    """Photos [m, h, w, 3] in [0, 1] as they are compared. Without leaves (None) by colour and structure alone."""
    photos = with_structure(photos)
    if p is None:
        return Described(Texels.of(photos), None)
    return Described(Texels.of(photos), vectors(p, photos).reshape(-1, 2 * VECTOR))


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


def evidence(p: Tree | None, values: jax.Array, seen: jax.Array, alike: jax.Array) -> jax.Array:
    """Logits [k, p] of cuts: values [m, k, p, c] and seen [m, k, p] by `Described.at`.

    The best of the pairs of photos from different places (`alike`: `sweep.twins`) decides, softly, since one of a pair
    may look at something in front.
    """
    pairs, counts = [], []
    for i in range(len(values)):
        for j in range(i):
            pairs.append(_agreement(p, values[i], values[j]))
            counts.append(seen[i] * seen[j] * (1.0 - alike[i, j]))
    if not pairs:
        return jnp.full(seen.shape[1:], STRANGE)
    agreed, both = jnp.stack(pairs), jnp.stack(counts)
    sharp = 1.0 if p is None else p["weights"][4]
    count = both.sum(0)
    best = jax.lax.stop_gradient(jnp.where(both > 0, agreed, -jnp.inf).max(0))
    best = jnp.where(jnp.isfinite(best), best, 0.0)
    mass = (both * jnp.exp(jnp.minimum(sharp * (agreed - best[None]), 0.0))).sum(0)
    level = best + jnp.log(mass / jnp.maximum(count, 1e-6) + 1e-9) / sharp
    return jnp.where(count > 0.5, level, STRANGE)


def _agreement(p: Tree | None, a: jax.Array, b: jax.Array) -> jax.Array:
    """Of two photos' values [k, p, c]. Sums along a short last axis are written out: they take ten times as long."""
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
