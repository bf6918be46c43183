"""Photos as another one would have taken them: turned and enlarged alike, so that what a small network says of a pixel
does not depend on how a camera was held.

A homography of a plane that faces the other photo, at the depth where both look at the same: what lies there comes out
where the other photo has it, and all else near it. Photos that differ little keep their own pixels.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from .rendering import Photos
from .sweep import Motion, bilinear, pixels_of, texels

MARGIN = (
    0.25  # of either side, about what the other photo shows: what lies off the plane is found there
)
TURNED = 0.25  # difference of two photos' scale and rotation, as a matrix, below which they stay as they are
FRONT = 1e-3  # homogeneous depths below this are behind a photo


class Aligned(NamedTuple):
    """k photos as one other would have them."""

    rgb: jax.Array  # [k, h, w, 3]
    way: Motion  # from the other one's pixels at the model's size to those of `rgb`, of k photos


def aligned(photos: Photos, way: Motion, plane: jax.Array, window: tuple) -> Aligned:
    """`Aligned` photos.

    Args:
      photos: k of them.
      way: motion from the reference to the k photos, in pixels of the model's size.
      plane: [k] inverse depth in the reference that comes out in place (`in_common`).
      window: (scale [2], offset [2]) of the reference, as of `Photos`; its size is that of `photos`.
    """
    k, h, w, _ = photos.rgb.shape
    down, across = int(MARGIN * h), int(MARGIN * w)
    height, width = h + 2 * down, w + 2 * across
    scale, (top, left) = window[0][::-1], window[1]
    middle = jnp.stack([left + across, top + down])
    # From pixels of the result to the reference's at the model's size.
    own = jnp.eye(3).at[(0, 1), (0, 1)].set(1.0 / scale).at[:2, 2].set(-middle / scale)
    into = photos.into(way)
    flat = plane[:, None, None] * into.shift[:, :, None] * jnp.asarray([[[0.0, 0.0, 1.0]]])
    like = jnp.einsum("kij,jl->kil", into.turn + flat, own)
    kept = jnp.eye(3).at[:2, 2].set(jnp.asarray([-float(across), -float(down)]))
    change = _linear(like, (height, width)) - jnp.eye(2)[None]
    unlike = jnp.linalg.norm(change, axis=(1, 2)) > TURNED
    like = jnp.where(unlike[:, None, None], like, kept[None])

    where = pixels_of(height, width, 1)
    where = jnp.concatenate([where, jnp.ones((len(where), 1))], -1)
    x, y, z = jnp.moveaxis(jnp.einsum("kij,pj->kpi", like, where), -1, 0)
    x, y = (jnp.where(z > FRONT, a / jnp.maximum(z, FRONT), -1.0) for a in (x, y))
    first = jnp.arange(k, dtype=jnp.int32)[:, None] * ((h - 1) * (w - 1))
    rgb = bilinear(texels(photos.rgb), x, y, (h, w), first).reshape(k, height, width, 3)
    back = jnp.linalg.inv(like)
    shift = jnp.einsum("kij,kj->ki", back, into.shift)
    return Aligned(rgb, Motion(back @ into.turn, shift))


def _linear(like: jax.Array, size: tuple[int, int]) -> jax.Array:
    """The derivatives [k, 2, 2] of homographies [k, 3, 3] in the middle of a picture of `size`."""
    at = like @ jnp.asarray([size[1] / 2, size[0] / 2, 1.0])
    z = at[:, 2, None, None]
    return (like[:, :2, :2] * z - at[:, :2, None] * like[:, 2:, :2]) / jnp.square(z)


def in_common(way: Motion, size: tuple[int, int], inverse: jax.Array) -> jax.Array:
    """The inverse depth [k], of those given, whose point in the middle of a view comes nearest to the middle of a photo.

    way: from the view to k photos, in pixels of the model's `size`.
    """
    middle = jnp.asarray([size[1] / 2, size[0] / 2, 1.0])
    at = (way.turn @ middle)[:, None] + inverse[None, :, None] * way.shift[:, None]
    z = at[..., 2]
    x, y = (at[..., i] / jnp.maximum(z, FRONT) - middle[i] for i in (0, 1))
    off = jnp.where(z > FRONT, jnp.square(x) + jnp.square(y), jnp.inf)
    return inverse[jnp.argmin(off, -1)]
