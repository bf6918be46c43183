"""Flows whose answer is known: the problems every sampler is tested and charted on.

A problem is a velocity field with, where one exists, the exact map from one noise level to another
(by default from sigma = 1 to 0).

  gaussian      N(0, I) -> N(mean, std^2): x(0) = mean + std x(1). A small std is a near-delta: a
                boundary layer of width ~std at sigma = 0 whose Jacobian peaks at 1 / (2 std)
  delta         std = 0: straight rays; the field is 0/0 at sigma = 0
  low_rank      std 1 on some axes and tiny on the rest: images on a manifold
  mixture       Gaussian mixture; exact in one dimension, where the flow keeps every quantile
  empirical     mixture of near-deltas at data points: the memorising limit
  conditional   linear-Gaussian posterior of x0 given y = H x0 + noise
  guided_mixture   classifier-free guidance between two mixtures within a noise interval

and initial-value problems for general integrator health, in time t = 1 - sigma:
dahlquist, prothero_robinson, van_der_pol, hires.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roge_jax.video.solvers import guided


@dataclass(frozen=True)
class Problem:
    """`velocity(x, sigma)` on states [..., dim]; `exact(x, start=1, end=0)` the flow, if known."""

    name: str
    dim: int
    velocity: Callable[[Array, Array], Array]
    exact: Callable[..., Array] | None = None
    breaks: tuple[float, ...] = ()


def _along(x: Array, vector) -> Array:
    """`vector` [dim] shaped to meet `x` [..., dim]."""
    v = jnp.asarray(vector, x.dtype)
    return v.reshape((1,) * (x.ndim - 1) + v.shape)


def gaussian(mean, std, name: str = "gaussian") -> Problem:
    """Target N(mean, diag(std^2)), both [dim]."""
    mean, std = np.broadcast_arrays(np.atleast_1d(mean).astype(float), np.atleast_1d(std))

    def velocity(x: Array, sigma: Array) -> Array:
        m, s2 = _along(x, mean), _along(x, std**2)
        variance = (1 - sigma) ** 2 * s2 + sigma**2
        return -m + (sigma - (1 - sigma) * s2) / variance * (x - (1 - sigma) * m)

    def exact(x: Array, start: float = 1.0, end: float = 0.0) -> Array:
        m, s2 = _along(x, mean), _along(x, std**2)
        growth = ((1 - end) ** 2 * s2 + end**2) / ((1 - start) ** 2 * s2 + start**2)
        return (1 - end) * m + jnp.sqrt(growth) * (x - (1 - start) * m)

    return Problem(name, len(mean), velocity, exact)


def delta(mean) -> Problem:
    """All mass at `mean` [dim]; exact for any method that never looks at sigma = 0."""
    mean = np.atleast_1d(mean).astype(float)

    def velocity(x: Array, sigma: Array) -> Array:
        m = _along(x, mean)
        return -m + (x - (1 - sigma) * m) / sigma

    def exact(x: Array, start: float = 1.0, end: float = 0.0) -> Array:
        m = _along(x, mean)
        return (1 - end) * m + (end / start) * (x - (1 - start) * m)

    return Problem("delta", len(mean), velocity, exact)


def low_rank(dim: int, rank: int, std: float, seed: int = 0) -> Problem:
    """std 1 on `rank` axes, `std` on the others."""
    mean = np.random.default_rng(seed).normal(size=dim)
    return gaussian(mean, np.where(np.arange(dim) < rank, 1.0, std), name="low_rank")


def mixture(weights, means, stds, name: str = "mixture") -> Problem:
    """Mixture of isotropic Gaussians: weights [k], means [k, dim], stds [k]."""
    weights, means, stds = (np.asarray(a, float) for a in (weights, means, stds))
    dim = means.shape[1]

    def velocity(x: Array, sigma: Array) -> Array:
        w, m, s2 = (jnp.asarray(a, x.dtype) for a in (weights, means, stds**2))
        lead = (1,) * (x.ndim - 1)
        variance = (1 - sigma) ** 2 * s2 + sigma**2  # [k]
        offset = x[..., None, :] - (1 - sigma) * m.reshape((*lead, *m.shape))  # [..., k, dim]
        logits = jnp.log(w) - 0.5 * dim * jnp.log(variance)
        distance = 0.5 * jnp.sum(offset**2, -1) / variance.reshape((*lead, -1))
        logits = logits.reshape((*lead, -1)) - distance
        gamma = jax.nn.softmax(logits, axis=-1)[..., None]
        gain = ((sigma - (1 - sigma) * s2) / variance).reshape((*lead, -1, 1))
        return jnp.sum(gamma * (gain * offset - m.reshape((*lead, *m.shape))), axis=-2)

    exact = _quantile_map(weights, means[:, 0], stds) if dim == 1 else None
    return Problem(name, dim, velocity, exact)


def _quantile_map(weights: np.ndarray, means: np.ndarray, stds: np.ndarray):
    """In one dimension paths cannot cross: x keeps its quantile from one noise level to another."""

    def below(x: np.ndarray, sigma: float) -> np.ndarray:
        from scipy.special import ndtr

        spread = np.sqrt((1 - sigma) ** 2 * stds**2 + sigma**2)
        return (ndtr((x[..., None] - (1 - sigma) * means) / spread) * weights).sum(-1)

    def exact(x: Array, start: float = 1.0, end: float = 0.0) -> Array:
        level = below(np.asarray(x, np.float64)[..., 0], start)
        low = np.full(level.shape, means.min() - 12 * max(stds.max(), 1.0))
        high = np.full(level.shape, means.max() + 12 * max(stds.max(), 1.0))
        for _ in range(200):
            mid = 0.5 * (low + high)
            left = below(mid, end) < level
            low, high = np.where(left, mid, low), np.where(left, high, mid)
        return jnp.asarray(0.5 * (low + high))[..., None]

    return exact


def random_mixture(dim: int, parts: int, std: float, seed: int = 0, spread: float = 1.5) -> Problem:
    """`parts` equal Gaussians of width `std` at random means."""
    means = np.random.default_rng(seed).normal(size=(parts, dim)) * spread
    return mixture(np.full(parts, 1 / parts), means, np.full(parts, std))


def empirical(points, std: float) -> Problem:
    """The data set `points` [k, dim] itself, each point blurred by `std`."""
    k = len(points)
    return mixture(np.full(k, 1 / k), points, np.full(k, std), name="empirical")


def conditional(matrix, observed, noise: float) -> Problem:
    """x0 ~ N(0, I) given `observed` [j] = matrix [j, dim] x0 + noise n: a rotated Gaussian."""
    matrix, observed = np.asarray(matrix, float), np.asarray(observed, float)
    precision = np.eye(matrix.shape[1]) + matrix.T @ matrix / noise**2
    values, basis = np.linalg.eigh(precision)
    mean = np.linalg.solve(precision, matrix.T @ observed / noise**2)
    inner = gaussian(basis.T @ mean, values**-0.5)

    def turned(f):
        def g(x: Array, *rest) -> Array:
            q = jnp.asarray(basis, x.dtype)
            return f(x @ q, *rest) @ q.T

        return g

    return Problem("conditional", len(mean), turned(inner.velocity), turned(inner.exact))


@functools.cache  # one object, so that solvers compiled for its field are found again
def guided_mixture(
    scale: float, interval: tuple[float, float] = (0.0, 1.0), dim: int = 8, seed: int = 0
) -> Problem:
    """Guidance from a four-part mixture (unconditional) to two of its parts (conditional)."""
    means = np.random.default_rng(seed).normal(size=(4, dim)) * 1.5
    full = mixture(np.full(4, 0.25), means, np.full(4, 0.5))
    part = mixture(np.full(2, 0.5), means[:2], np.full(2, 0.5))
    field = guided(part.velocity, full.velocity, scale, interval)
    inner = tuple(s for s in interval if 0 < s < 1)
    return Problem("guided_mixture", dim, field, None, inner)


# ---- initial-value problems y' = f(t, y) over t in [0, duration], t = duration (1 - sigma) ----------


def initial_value(name: str, f, start, duration: float, exact=None) -> tuple[Problem, np.ndarray]:
    """The problem as a flow in sigma, and its start state [dim]."""

    def velocity(y: Array, sigma: Array) -> Array:
        return -duration * f(duration * (1 - sigma), y)

    start = np.asarray(start, float)
    return Problem(name, len(start), velocity, exact), start


def dahlquist(rate: float) -> tuple[Problem, np.ndarray]:
    """y' = rate y, y(0) = 1: the stability function of a method at rate / steps."""
    return initial_value(
        "dahlquist",
        lambda t, y: rate * y,
        [1.0],
        1.0,
        lambda y, start=1.0, end=0.0: y * float(np.exp(rate * (start - end))),
    )


def prothero_robinson(rate: float) -> tuple[Problem, np.ndarray]:
    """y' = rate (y - cos t) - sin t with solution cos t: order reduction when |rate| is large."""
    return initial_value(
        "prothero_robinson",
        lambda t, y: rate * (y - jnp.cos(t)) - jnp.sin(t),
        [1.0],
        1.0,
        lambda y, start=1.0, end=0.0: jnp.full_like(y, float(np.cos(1.0 - end))),
    )


def van_der_pol(mu: float, duration: float = 2.0) -> tuple[Problem, np.ndarray]:
    """x'' = mu (1 - x^2) x' - x from (2, 0); no closed form."""

    def f(t, y):
        return jnp.stack([y[..., 1], mu * (1 - y[..., 0] ** 2) * y[..., 1] - y[..., 0]], -1)

    return initial_value("van_der_pol", f, [2.0, 0.0], duration)


def hires(duration: float = 321.8122) -> tuple[Problem, np.ndarray]:
    """High irradiance response (Schaefer 1975), 8 equations, stiff; no closed form."""

    def f(t, y):
        a, b, c, d, e, g, h, i = (y[..., k] for k in range(8))
        fast = 280.0 * g * i
        return jnp.stack(
            [
                -1.71 * a + 0.43 * b + 8.32 * c + 0.0007,
                1.71 * a - 8.75 * b,
                -10.03 * c + 0.43 * d + 0.035 * e,
                8.32 * b + 1.71 * c - 1.12 * d,
                -1.745 * e + 0.43 * g + 0.43 * h,
                -fast + 0.69 * d + 1.71 * e - 0.43 * g + 0.69 * h,
                fast - 1.81 * h,
                -fast + 1.81 * h,
            ],
            -1,
        )

    return initial_value("hires", f, [1.0, 0, 0, 0, 0, 0, 0, 0.0057], duration)
