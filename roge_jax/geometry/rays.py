"""Rays: pixels to Pluecker coordinates and back; float32 JAX on re-centred cameras."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def plucker(K: Any, c2w: Any, height: int, width: int) -> jnp.ndarray:
    """Pluecker ray maps p = [d, o x d] (paper, section 3.1): float32 [..., v, h, w, 6].

    Args:
      K: [..., v, 3, 3] in pixels of a height x width image, any skew and principal point.
      c2w: [..., v, 4, 4] camera-to-world, OpenCV axes, already normalised (float32 cannot hold raw
        coordinates).
    The ray passes through the pixel centre (column + 0.5, row + 0.5); d has length 1, o is the
    camera centre.
    """
    return _plucker_jax(jnp.asarray(K, jnp.float32), jnp.asarray(c2w, jnp.float32), height, width)


def plucker_float64(K: np.ndarray, c2w: np.ndarray, height: int, width: int) -> np.ndarray:
    """`plucker` in float64 NumPy, the reference of the tests and of metrics."""
    return _plucker(np.asarray(K, np.float64), np.asarray(c2w, np.float64), height, width, np)


def directions(K: Any, height: int, width: int, use: Any = jnp) -> Any:
    """Unit ray directions in camera axes [..., h, w, 3]: K^-1 [u, v, 1], normalised.

    K is upper triangular, so K^-1 is back substitution, which makes the ray through the principal
    point exactly (0, 0, 1) and keeps skew and unequal focal lengths.
    """
    columns = use.arange(width, dtype=K.dtype) + 0.5
    rows = use.arange(height, dtype=K.dtype) + 0.5
    lead = (1,) * (K.ndim - 2)
    u, v = columns.reshape((*lead, 1, width)), rows.reshape((*lead, height, 1))
    fx, skew, cx, fy, cy = (
        K[..., i, j, None, None] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2))
    )
    y = (v - cy) / fy
    x = (u - cx - skew * y) / fx
    y = use.broadcast_to(y, x.shape)
    rays = use.stack([x, y, use.ones_like(x)], -1)
    return rays / use.sqrt(1.0 + x * x + y * y)[..., None]


def _plucker(K: Any, c2w: Any, height: int, width: int, use: Any) -> Any:
    local = directions(K, height, width, use)
    R = c2w[..., None, None, :3, :3]
    # Written out instead of a matmul, so that it stays float32 on devices that round matmuls.
    d = R[..., 0] * local[..., 0:1] + R[..., 1] * local[..., 1:2] + R[..., 2] * local[..., 2:3]
    o = use.broadcast_to(c2w[..., None, None, :3, 3], d.shape)
    return use.concatenate([d, use.cross(o, d)], -1)


@functools.partial(jax.jit, static_argnums=(2, 3))
def _plucker_jax(K: jnp.ndarray, c2w: jnp.ndarray, height: int, width: int) -> jnp.ndarray:
    return _plucker(K, c2w, height, width, jnp)


def project(K: Any, c2w: Any, points: Any, near: float = 1e-6) -> tuple[Any, Any, Any]:
    """World points [..., p, 3] into cameras K [..., 3, 3], c2w [..., 4, 4].

    Returns: pixels [..., p, 2], depth [..., p] along the optical axis, visible [..., p].
    `visible` is False where depth <= near; there the pixel is 0 and its gradient is 0 (the
    division is never taken). NumPy in, NumPy float64 out; otherwise JAX.
    """
    use = np if all(isinstance(a, np.ndarray) for a in (K, c2w, points)) else jnp
    offset = points - c2w[..., None, :3, 3]
    R = c2w[..., None, :3, :3]
    x, y, depth = (use.sum(offset * R[..., i], -1) for i in range(3))
    visible = depth > near
    safe = use.where(visible, depth, 1.0)
    x, y = use.where(visible, x, 0.0) / safe, use.where(visible, y, 0.0) / safe
    u = K[..., None, 0, 0] * x + K[..., None, 0, 1] * y + K[..., None, 0, 2]
    v = K[..., None, 1, 1] * y + K[..., None, 1, 2]
    pixels = use.where(visible[..., None], use.stack([u, v], -1), 0.0)
    return pixels, depth, visible


def ray_distance(a: Any, b: Any, parallel_degrees: float = 1e-3) -> Any:
    """The distance [...] between lines in Pluecker form [d, m], a and b [..., 6] with unit d.

    Skew lines: |d_a . m_b + d_b . m_a| / |d_a x d_b|. (Nearly) parallel ones, with d_b turned to
    agree with d_a: |d_a x (m_a - m_b)|, so that nothing is divided by an angle that is rounding.
    """
    use = np if isinstance(a, np.ndarray) and isinstance(b, np.ndarray) else jnp
    (d_a, m_a), (d_b, m_b) = (a[..., :3], a[..., 3:]), (b[..., :3], b[..., 3:])
    normal = use.cross(d_a, d_b)
    sine2 = use.sum(normal * normal, -1)
    parallel = sine2 < np.sin(np.radians(parallel_degrees)) ** 2
    moment = use.abs(use.sum(d_a * m_b, -1) + use.sum(d_b * m_a, -1))
    sign = use.where(use.sum(d_a * d_b, -1, keepdims=True) < 0, -1.0, 1.0)
    apart = use.cross(d_a, m_a - sign * m_b)
    apart2 = use.where(parallel, use.sum(apart * apart, -1), 1.0)
    return use.where(parallel, use.sqrt(apart2), moment / use.sqrt(use.where(parallel, 1.0, sine2)))


def triangulate(a: Any, b: Any, min_degrees: float = 1.0) -> tuple[Any, Any]:
    """The points [..., 3] midway between rays [..., 6], which are [d, m], and where they are `finite`.

    `finite` is False where the rays meet at less than `min_degrees`: the point is at infinity and 0
    is returned.
    """
    use = np if isinstance(a, np.ndarray) and isinstance(b, np.ndarray) else jnp
    (d_a, m_a), (d_b, m_b) = (a[..., :3], a[..., 3:]), (b[..., :3], b[..., 3:])
    # d x m is the point of the line closest to the world's origin.
    p_a, p_b = use.cross(d_a, m_a), use.cross(d_b, m_b)
    cosine = use.sum(d_a * d_b, -1)
    normal = use.cross(d_a, d_b)
    sine2 = use.sum(normal * normal, -1)
    finite = sine2 >= np.sin(np.radians(min_degrees)) ** 2
    safe = use.where(finite, sine2, 1.0)
    between = p_b - p_a
    along_a = (use.sum(between * d_a, -1) - cosine * use.sum(between * d_b, -1)) / safe
    along_b = (cosine * use.sum(between * d_a, -1) - use.sum(between * d_b, -1)) / safe
    middle = 0.5 * (p_a + along_a[..., None] * d_a + p_b + along_b[..., None] * d_b)
    return use.where(finite[..., None], middle, 0.0), finite
