"""Samplers: integrate dx/dsigma = v(x, sigma) from noise (sigma = 1) to the clean sample (0).

    grid = schedule("shift", 20, shift=5.0)
    x0, info = solve("unipc_2", velocity, noise, grid)
    raise_if_failed(info)

`velocity(x, sigma)` takes the state and a scalar noise level (a network multiplies it by 1000). The
state is float32 whatever the velocity's dtype: a bfloat16 state gets *worse* with more steps once
the steps fall below its rounding (tests/video/test_solvers.py). The first non-finite number stops the
network from being called again; `info` says where. Everything here may be jitted; a `Table` passed
as an argument makes one compilation serve every grid of its length.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roge_jax.errors import UserError
from roge_jax.video.adaptive import solve_bosh3
from roge_jax.video.solve_info import (
    BAD_STATE,
    BAD_VELOCITY,
    SamplingError,
    SolveInfo,
    fresh_info,
    note,
    raise_if_failed,
)
from roge_jax.video.solver_table import SOLVERS, Table, check_grid, nfe, tabulate

__all__ = [
    "SOLVERS",
    "Sampler",
    "SamplingError",
    "SolveInfo",
    "Table",
    "check_grid",
    "guided",
    "iterate",
    "nfe",
    "raise_if_failed",
    "solve",
    "tabulate",
]

Velocity = Callable[[Array, Array], Array]
Project = Callable[[Array, Array], Array]
# A sampler of one's own: (velocity(x, sigma), x at grid[0], grid [steps + 1]) -> x at grid[-1].
Sampler = Callable[[Velocity, Array, np.ndarray], Array]


def guided(
    conditional: Velocity,
    unconditional: Velocity,
    scale: float,
    interval: tuple[float, float] = (0.0, 1.0),
) -> Velocity:
    """Guidance v = v_u + scale (v_c - v_u) for sigma in `interval` (low, high), v_c elsewhere.

    Outside the interval the unconditional network is not called. Give the interval as `breaks` to
    `schedule` and `solve`: a switch inside a step costs every method its order.
    """
    low, high = interval
    if not 0 <= low < high <= 1:
        raise UserError(
            f"The guidance interval is {interval}; it must be (low, high) within [0, 1]."
        )

    def velocity(x: Array, sigma: Array) -> Array:
        v_c = conditional(x, sigma)

        def both() -> Array:
            v_u = unconditional(x, sigma)
            return (v_u + scale * (v_c - v_u)).astype(v_c.dtype)

        return jax.lax.cond((sigma >= low) & (sigma <= high), both, lambda: v_c)

    return velocity


def solve(
    solver: str | Table | Sampler,
    velocity: Velocity,
    x1: Array,
    sigmas: np.ndarray | None = None,
    *,
    breaks: Sequence[float] = (),
    project: Project | None = None,
    keep_states: bool = False,
    state_dtype: jnp.dtype | None = None,
    tolerance: float = 1e-3,
    max_evaluations: int = 1000,
) -> tuple[Array, SolveInfo]:
    """Integrate from `x1` at sigmas[0] to sigmas[-1]; returns (x0, info).

    `solver`: a name of SOLVERS with a grid `sigmas` [n + 1], a Table (which holds its grid), or a function of one's own,
    a `Sampler`, with a grid; `info.evaluations` is then -1: nobody counts them.
    `breaks`: noise levels where the field jumps (guidance ends); grid points, see `schedule`.
    `project(x, sigma)`: applied to the state before each evaluation at that evaluation's sigma,
    and to the result; RoGe holds context slots at the known latents with it.
    `tolerance`, `max_evaluations` are for "bosh3", which takes from the grid only its two ends,
    the first step and the last (one Euler step from the last positive sigma to 0).

    x1 any shape [...]; x0 has its shape in the state's dtype (float32, or float64 if x1 is).
    Under vmap a stopped sample still pays for the network; batch inside the state instead.
    """
    dtype = jnp.promote_types(x1.dtype, jnp.float32) if state_dtype is None else state_dtype
    if isinstance(solver, str) and solver in SOLVERS and SOLVERS[solver].method is None:
        assert sigmas is not None and not keep_states
        x, info = solve_bosh3(
            velocity,
            x1.astype(dtype),
            check_grid(sigmas, breaks),
            breaks=breaks,
            project=project,
            tolerance=tolerance,
            max_evaluations=max_evaluations,
        )
        return x, info
    if not isinstance(solver, str | Table):
        assert sigmas is not None and not keep_states
        return _by_own(solver, velocity, x1.astype(dtype), check_grid(sigmas, breaks), project)
    table = _table(solver, sigmas, breaks)
    stored = _start(table, x1.astype(dtype))

    def body(carry, row):
        stored, info = carry
        x, sigma, info = _look_up(stored, info, row, project)

        def call():  # after a failure nothing moves and the network is not called
            return _take_in(stored, info, row, velocity(x, sigma), sigma)

        carry = jax.lax.cond(info.failed, lambda: (stored, info), call)
        return carry, (x if keep_states else None)

    start = (stored, fresh_info(x1.size, dtype))
    (stored, info), seen = jax.lax.scan(body, start, _rows(table))
    x0, info = _finish(table, stored, info, project)
    if keep_states:
        info = replace(info, states=jnp.concatenate([seen[table.first], x0[None]]))
    return x0, info


def iterate(
    solver: str | Table,
    velocity: Velocity,
    x1: Array,
    sigmas: np.ndarray | None = None,
    *,
    breaks: Sequence[float] = (),
    project: Project | None = None,
) -> Iterator[tuple[int, int, Array]]:
    """`solve` as a Python loop for progress bars: yields (evaluations done, all, current x).

    The last x is the result. `velocity` is called from Python: jit it once and reuse it. Raises
    SamplingError at the first non-finite number, so nothing needs to be checked afterwards.
    """
    table = _table(solver, sigmas, breaks)
    dtype = jnp.promote_types(x1.dtype, jnp.float32)
    stored, info = _start(table, x1.astype(dtype)), fresh_info(x1.size, dtype)
    count = len(table.sigma)
    for e in range(count):
        row = {name: np.asarray(leaf)[e] for name, leaf in _rows(table).items()}
        x, sigma, info = _before(stored, info, row, project)
        raise_if_failed(info)
        stored, info = _after(stored, info, row, velocity(x, sigma), sigma)
        raise_if_failed(info)
        if e + 1 < count:
            yield e + 1, count, stored[0]
    x0, info = _finish(table, stored, info, project)
    raise_if_failed(info)
    yield count, count, x0


def _by_own(sampler: Sampler, velocity: Velocity, x1: Array, grid: np.ndarray, project):
    """`solve` by a function that knows nothing of `project`."""

    def held(x: Array, sigma) -> Array:
        return x if project is None else project(x, sigma).astype(x1.dtype)

    def field(x: Array, sigma) -> Array:
        sigma = jnp.asarray(sigma, jnp.float32)
        return velocity(held(x, sigma), sigma)

    end = jnp.float32(grid[-1])
    x0 = held(sampler(field, x1, grid), end)
    info = replace(fresh_info(x1.size, x1.dtype), evaluations=jnp.int32(-1))
    return x0, note(info, x0, BAD_STATE, len(grid) - 1, end)


# ---- one evaluation ------------------------------------------------------------------------------


def _table(solver: str | Table, sigmas, breaks: Sequence[float]) -> Table:
    if isinstance(solver, Table):
        assert sigmas is None and not breaks, "a Table holds its grid and its breaks"
        return solver
    if sigmas is None:
        raise UserError(f"solve('{solver}', ...) needs a sigma grid; make one with schedule().")
    return tabulate(solver, sigmas, breaks=breaks)


def _start(table: Table, x1: Array) -> Array:
    """[R, ...] the stored vectors before the first evaluation; all are multiples of x1."""
    begin = jnp.asarray(table.begin, x1.dtype).reshape((-1,) + (1,) * x1.ndim)
    return begin * x1[None]


def _rows(table: Table) -> dict[str, np.ndarray]:
    return {"sigma": table.sigma, "side": table.side, "step": table.step, "mix": table.mix}


def _look(x: Array, project: Project | None, row: dict[str, Array]) -> tuple[Array, Array]:
    """The state and noise level of an evaluation; just inside its step where the field jumps."""
    sigma = row["sigma"].astype(jnp.promote_types(x.dtype, jnp.float32))
    inside = jnp.nextafter(sigma, sigma + row["side"].astype(sigma.dtype))
    sigma = jnp.where(row["side"] == 0, sigma, inside)
    return (x if project is None else project(x, sigma).astype(x.dtype)), sigma


def _mix(mix: Array, stored: Array, v: Array) -> Array:
    """New stored vectors [R, ...]. Sums, not a matmul: accelerators round matmul inputs."""
    work = jnp.promote_types(stored.dtype, jnp.float32)
    vectors = [*stored.astype(work), v.astype(work)]
    mix = mix.astype(work)
    rows = []
    for r in range(len(stored)):
        total = mix[r, 0] * vectors[0]
        for k in range(1, len(vectors)):
            total = total + mix[r, k] * vectors[k]
        rows.append(total)
    return jnp.stack(rows).astype(stored.dtype)


def _look_up(stored: Array, info: SolveInfo, row, project: Project | None):
    """State and noise level of a row's evaluation, checked."""
    x, sigma = _look(stored[0], project, row)
    return x, sigma, note(info, x, BAD_STATE, row["step"], sigma)


def _take_in(stored: Array, info: SolveInfo, row, v: Array, sigma: Array):
    """Check the velocity of a row and mix it in; a failed run stays where it is."""
    info = replace(info, evaluations=info.evaluations + 1)
    info = note(info, v, BAD_VELOCITY, row["step"], sigma)
    return jnp.where(info.failed, stored, _mix(row["mix"], stored, v)), info


def _finish(table: Table, stored: Array, info: SolveInfo, project: Project | None):
    end = jnp.asarray(table.grid, jnp.promote_types(stored.dtype, jnp.float32))[-1]
    x0 = stored[0] if project is None else project(stored[0], end).astype(stored.dtype)
    return x0, note(info, x0, BAD_STATE, len(table.grid) - 1, end)


_before = jax.jit(_look_up, static_argnames="project")
_after = jax.jit(_take_in)
