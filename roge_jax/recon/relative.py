"""Relative cameras in attention: logits and values that depend only on how two views see each other.

Half of every head is multiplied by 4x4 projective matrices of the views, so that a query of view a meets a key of
view b through P_a P_b^-1; the other half is rotated by the token's row and column. Both act on values too. This is
the projective form of "Cameras as Relative Positional Encoding" (Li et al. 2025); the published RoGe networks do not
have it, and it is off in their presets.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..core.rope import grid_angles, rotate_halves


class Relative(NamedTuple):
    """Per view: `project` P [v, 4, 4] and its inverse; per token: `angles` [l, 2, e / 8] (zeros: special tokens)."""

    project: jax.Array | None  # None: identity (attention inside one view)
    unproject: jax.Array | None
    angles: jax.Array


def relative_cameras(
    K, c2w, size: tuple[int, int], *, grid: tuple[int, int], specials: int, head_dim: int
):
    """`Relative` for views K [v, 3, 3] (pixels of `size` = height, width), c2w [v, 4, 4].

    The tokens of a view are `specials` position-free ones, then a row-major `grid`.
    """
    K, c2w = jnp.asarray(K), jnp.asarray(c2w)
    height, width = size
    v = K.shape[0]
    fx, fy = K[:, 0, 0] / width, K[:, 1, 1] / height
    cx, cy = K[:, 0, 2] / width - 0.5, K[:, 1, 2] / height - 0.5
    zero, one = jnp.zeros(v), jnp.ones(v)
    lift = jnp.stack(
        [fx, zero, cx, zero, zero, fy, cy, zero, zero, zero, one, zero, zero, zero, zero, one], -1
    )
    unlift = jnp.stack(
        [
            1 / fx,
            zero,
            -cx / fx,
            zero,
            zero,
            1 / fy,
            -cy / fy,
            zero,
            zero,
            zero,
            one,
            zero,
            zero,
            zero,
            zero,
            one,
        ],
        -1,
    )
    rotation, origin = c2w[:, :3, :3], c2w[:, :3, 3]
    back = jnp.swapaxes(rotation, 1, 2)
    w2c = c2w.at[:, :3, :3].set(back).at[:, :3, 3].set(-jnp.einsum("vij,vj->vi", back, origin))
    with jax.default_matmul_precision("highest"):
        project = lift.reshape(v, 4, 4) @ w2c
        unproject = c2w @ unlift.reshape(v, 4, 4)
    angles = jnp.asarray(grid_angles(*grid, head_dim // 4, 100.0, offset=1))
    angles = jnp.concatenate([jnp.zeros((specials, *angles.shape[1:])), angles])
    return Relative(project, unproject, angles)


def inside(r: Relative) -> Relative:
    """The same tokens attending inside their own view, where the projective parts cancel."""
    return Relative(None, None, r.angles)


def _apply(matrices: jax.Array | None, angles: jax.Array, x: jax.Array) -> jax.Array:
    """x [v, l, k, e]: the first e/2 in blocks of 4 through `matrices` [v, 4, 4], the rest rotated."""
    v, l, k, e = x.shape
    head, tail = jnp.split(x, 2, axis=-1)
    if matrices is not None:
        blocks = head.reshape(v, l, k, e // 8, 4)
        head = jnp.einsum("vij,vlknj->vlkni", matrices, blocks).reshape(head.shape)
    row, column = jnp.split(tail, 2, axis=-1)
    row, column = rotate_halves(row, angles[:, 0]), rotate_halves(column, angles[:, 1])
    return jnp.concatenate([head, row, column], -1)


def to_query(r: Relative, q: jax.Array) -> jax.Array:
    """Queries q [v, l, k, e]: P_a^T and the token's rotation, so that q . k depends on P_a P_b^-1 alone."""
    turned = None if r.project is None else jnp.swapaxes(r.project, 1, 2)
    return _apply(turned, r.angles, q)


def to_key(r: Relative, k: jax.Array) -> jax.Array:
    """Keys and values k [v, l, k, e]: P_b^-1 and the token's rotation."""
    return _apply(r.unproject, r.angles, k)


def to_output(r: Relative, y: jax.Array) -> jax.Array:
    """Attention's sums of values y [v, l, k, e] into the querying view: P_a and the rotation undone."""
    return _apply(r.project, -r.angles, y)
