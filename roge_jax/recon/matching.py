"""How alike photos are where a cut projects to: learned matching features beside colour and normalised luma.

As in MC-CNN (Zbontar & LeCun 2016) a small network describes every pixel by unit vectors, near and wide, and two photos
show the same point if theirs point the same way. It is trained on rendered scenes with their depth (`training.matching`)
and compares photos only: what a view's depth is follows from the aggregation (`recon.aggregate`).
"""

import jax
import jax.numpy as jnp

from ..core.layers import conv2d, conv2d_specs
from ..core.params import Spec, Tree, ones
from .aggregate import box, with_structure

HIDDEN, VECTOR = 16, 8  # channels of the layers, and of each of the two descriptions of a pixel
STRANGE = -4.0  # evidence for a cut that no two photos see, in units of a logit
COLOUR, MOST = (
    10.0,
    2.0,
)  # scale of a difference of colours; differences of structure above this count no more
VECTORS = 4.0  # what full agreement of two vectors weighs before training


def matching_specs() -> Tree:
    """Leaves of `described` and `evidence`."""
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


def described(p: Tree | None, photos: jax.Array) -> jax.Array:
    """Photos [m, h, w, 3] in [0, 1] with what they are compared by in front: [m, h, w, 2 VECTOR + 4].

    Of a model without these leaves (None) colour and structure alone, [m, h, w, 4].
    """
    photos = with_structure(photos)
    if p is None:
        return photos
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
    return jnp.concatenate([_unit(conv2d(near["conv4"], y)), z, photos], -1)


def _unit(x: jax.Array) -> jax.Array:
    return x * jax.lax.rsqrt(jnp.square(x).sum(-1, keepdims=True) + 1e-4)


def evidence(p: Tree | None, values: jax.Array, seen: jax.Array, alike: jax.Array) -> jax.Array:
    """Logits [k, p] of cuts: values [m, k, p, c] of `described` there, seen [m, k, p].

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


def volume(
    p: Tree | None,
    values: jax.Array,
    seen: jax.Array,
    alike: jax.Array,
    h: int,
    w: int,
    window: int,
):
    """`evidence` of a view's pixels, averaged over windows of 2 `window` + 1: [k, h, w]."""
    return box(evidence(p, values, seen, alike).reshape(-1, h, w), window)
