"""The adaptive sampler: Bogacki-Shampine 3(2) with a PI step controller.

The loop runs one *evaluation* at a time (a state machine over the four stages), so the network
appears once in the compiled program and a non-finite velocity stops the run at once, instead of the
controller shrinking its step until the budget is gone.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roge_jax.video.solve_info import (
    BAD_STATE,
    BAD_VELOCITY,
    FINE,
    OUT_OF_BUDGET,
    SolveInfo,
    fresh_info,
    note,
)

# Bogacki and Shampine 1989: stage s looks at y + h sum_j A[s, j] k_j; the last row is the step
A = np.array([[0, 0, 0, 0], [1 / 2, 0, 0, 0], [0, 3 / 4, 0, 0], [2 / 9, 1 / 3, 4 / 9, 0]])
C = np.array([0, 1 / 2, 3 / 4, 1])
ERROR = np.array([2 / 9 - 7 / 24, 1 / 3 - 1 / 4, 4 / 9 - 1 / 3, -1 / 8])
SAFETY, SHRINK, GROW = 0.9, 0.2, 5.0
# PI exponents for an error of order 3 (Hairer, Norsett and Wanner, section II.4 and IV.2)
ALPHA, BETA = 0.7 / 3, 0.4 / 3


class _State(NamedTuple):
    x: Array  # [...] accepted state
    slopes: Array  # [4, ...]
    sigma: Array  # noise level of x
    h: Array  # trial step, negative
    stage: Array  # next stage to evaluate
    piece: Array  # index of the target the step must not jump over
    fresh: Array  # the first slope lies just below a break
    error: Array  # last accepted error
    taken: Array  # accepted steps
    info: SolveInfo


def solve_bosh3(
    velocity: Callable[[Array, Array], Array],
    x1: Array,
    sigmas: np.ndarray,
    *,
    breaks: Sequence[float] = (),
    project: Callable[[Array, Array], Array] | None = None,
    tolerance: float = 1e-3,
    max_evaluations: int = 1000,
) -> tuple[Array, SolveInfo]:
    """Integrate from sigmas[0] to sigmas[-1] with steps chosen for `tolerance`; see `solve`.

    The error of a step is the root mean square over the whole state (so a batch shares its steps)
    of the embedded difference over tolerance (1 + |x|). If the grid ends at 0 the controller stops
    at its last positive level and one Euler step does the rest: that level is the detail floor.
    """
    dtype = x1.dtype
    project = project or (lambda x, sigma: x)
    to_zero = sigmas[-1] == 0.0
    low = float(sigmas[-2] if to_zero else sigmas[-1])
    # with only (start, 0) there is nothing to control: the Euler step is all
    inner = sorted({float(b) for b in breaks if low < b < sigmas[0]}, reverse=True)
    targets = jnp.asarray([*inner, low], dtype)
    a, c, err_weights = (jnp.asarray(t, dtype) for t in (A, C, ERROR))
    start = jnp.asarray(sigmas[0], dtype)

    def running(s: _State) -> Array:
        return (s.info.cause == FINE) & (s.piece < len(inner) + 1)

    def body(s: _State) -> _State:
        target = targets[s.piece]
        h = jnp.maximum(s.h, target - s.sigma)  # never beyond the target
        lands = h <= (target - s.sigma) * (1 - 1e-6)
        h = jnp.where(lands, target - s.sigma, h)
        row = a[s.stage].reshape((4,) + (1,) * s.x.ndim)
        x = s.x + h * jnp.sum(row * s.slopes, axis=0)
        sigma = s.sigma + c[s.stage] * h
        # at a break look just inside the own step
        below, above = jnp.nextafter(sigma, sigma - 1), jnp.nextafter(sigma, sigma + 1)
        at_end = (s.stage == 3) & lands & (s.piece < len(inner))
        looked = jnp.where((s.stage == 0) & s.fresh, below, jnp.where(at_end, above, sigma))
        x = project(x, looked).astype(dtype)
        info = note(s.info, x, BAD_STATE, s.taken, looked)
        info = replace(info, evaluations=info.evaluations + 1)
        v = velocity(x, looked).astype(dtype)
        info = note(info, v, BAD_VELOCITY, s.taken, looked)
        slopes = jax.lax.dynamic_update_index_in_dim(s.slopes, v, s.stage, 0)

        weights = err_weights.reshape((4,) + (1,) * s.x.ndim)
        other = project(x - h * jnp.sum(weights * slopes, axis=0), looked)
        scale = tolerance * (1 + jnp.maximum(jnp.abs(s.x), jnp.abs(x)))
        error = jnp.sqrt(jnp.mean(((x - other) / scale) ** 2)) + 1e-10
        done = s.stage == 3
        accept = done & (error <= 1)
        reject = done & ~accept
        factor = SAFETY * error**-ALPHA * s.error**BETA
        factor = jnp.where(accept, factor, SAFETY * error ** (-1 / 3))
        next_h = h * jnp.clip(factor, SHRINK, jnp.where(accept, GROW, 1.0))
        crossed = accept & lands
        # first-same-as-last: an accepted step hands its last slope on, unless the field jumps there
        slopes = jnp.where(accept, slopes.at[0].set(v), slopes)
        info = replace(info, rejected=info.rejected + jnp.where(reject, 3, 0).astype(jnp.int32))
        spent = (info.evaluations >= max_evaluations) & ~(crossed & (s.piece == len(inner)))
        out = spent & (info.cause == FINE)
        info = replace(
            info,
            cause=jnp.where(out, OUT_OF_BUDGET, info.cause).astype(jnp.int32),
            step=jnp.where(out, s.taken, info.step).astype(jnp.int32),
            sigma=jnp.where(out, s.sigma, info.sigma),
        )
        return _State(
            x=jnp.where(accept, x, s.x),
            slopes=slopes,
            sigma=jnp.where(accept, s.sigma + h, s.sigma),
            h=jnp.where(done, next_h, s.h),
            stage=jnp.where(done, jnp.where(crossed, 0, 1), s.stage + 1).astype(jnp.int32),
            piece=(s.piece + crossed).astype(jnp.int32),
            fresh=jnp.where(done, crossed, s.fresh),
            error=jnp.where(accept, jnp.maximum(error, 1e-4), s.error),
            taken=(s.taken + accept).astype(jnp.int32),
            info=info,
        )

    zero = jnp.int32(0)
    state = _State(
        x=x1,
        slopes=jnp.zeros((4, *x1.shape), dtype),
        sigma=start,
        h=jnp.asarray(sigmas[1] - sigmas[0], dtype),
        stage=zero,
        piece=zero if low < sigmas[0] else jnp.int32(len(inner) + 1),
        fresh=jnp.asarray(False),
        error=jnp.ones((), dtype),
        taken=zero,
        info=fresh_info(x1.size, dtype),
    )
    end = jax.lax.while_loop(running, body, state)
    if not to_zero:
        return project(end.x, end.sigma).astype(dtype), end.info

    x = project(end.x, end.sigma).astype(dtype)

    def last() -> tuple[Array, SolveInfo]:
        v = velocity(x, end.sigma).astype(dtype)
        info = replace(end.info, evaluations=end.info.evaluations + 1)
        info = note(info, v, BAD_VELOCITY, end.taken, end.sigma)
        return jnp.where(info.failed, x, x - end.sigma * v), info

    x0, info = jax.lax.cond(end.info.failed, lambda: (x, end.info), last)
    x0 = project(x0, jnp.zeros((), dtype)).astype(dtype)
    return x0, note(info, x0, BAD_STATE, info.step, jnp.zeros((), dtype))
