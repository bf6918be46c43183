"""Rotary position embeddings. Angle tables are float64 NumPy, then float32: they are constants of the jit."""

import jax
import jax.numpy as jnp
import numpy as np


def frequencies(dim: int, base: float) -> np.ndarray:
    """base^(-2j/dim), j < dim/2, float64 [dim / 2]."""
    return base ** (-np.arange(0, dim, 2, dtype=np.float64) / dim)


def rotate_halves(x: jax.Array, angles: jax.Array) -> jax.Array:
    """Rotate pairs (i, i + e/2) of x [.., l, k, e] by angles [.., l, e/2]."""
    cos, sin = jnp.cos(angles)[..., None, :], jnp.sin(angles)[..., None, :]
    a, b = jnp.split(x, 2, axis=-1)
    cos, sin = (_like(t, a) for t in (cos, sin))
    return jnp.concatenate([a * cos - b * sin, b * cos + a * sin], -1)


def rotate_pairs(x: jax.Array, angles: jax.Array) -> jax.Array:
    """Rotate pairs (2j, 2j + 1) of x [.., l, k, e] by angles [.., l, e/2]."""
    cos, sin = jnp.cos(angles)[..., None, :], jnp.sin(angles)[..., None, :]
    x = x.reshape(*x.shape[:-1], -1, 2)
    a, b = x[..., 0], x[..., 1]
    cos, sin = (_like(t, a) for t in (cos, sin))
    y = jnp.stack([a * cos - b * sin, b * cos + a * sin], -1)
    return y.reshape(*y.shape[:-2], -1)


def _like(table: jax.Array, x: jax.Array) -> jax.Array:
    return table.reshape((1,) * (x.ndim - table.ndim) + table.shape)


def grid_angles(rows: int, columns: int, dim: int, base: float, *, offset: int) -> np.ndarray:
    """Row and column angles of a row-major grid, [rows * columns, 2, dim / 2] float32; positions start at `offset`."""
    r, c = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    positions = np.stack([r.ravel(), c.ravel()], -1) + offset
    return (positions[..., None] * frequencies(dim, base)).astype(np.float32)
