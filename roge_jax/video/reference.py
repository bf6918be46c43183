"""Reference solutions: implicit collocation on optimistix, accepted only when three of them agree.

One step of an s-stage collocation method from x with step h is a root find for the stage increments
Z [s, ...]:

    Z - h A v(x + Z, sigma + c h) = 0,        x+ = x + h sum_i b_i v(x + Z_i, sigma + c_i h).

Gauss nodes give order 2s (A-stable), Radau IIA nodes order 2s - 1 (L-stable). Not a sampler: each
step costs several Jacobians (Newton), Jacobian products (Newton-Krylov) or sweeps (Picard).
Solutions in float64 need x64 enabled around the call (`jax.enable_x64`).
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from roge_jax.errors import UserError, did_you_mean
from roge_jax.video.flow import schedule
from roge_jax.video.solve_info import SamplingError
from roge_jax.video.solver_table import check_grid

FAMILIES = ("gauss", "radau")
STEPPERS = ("newton", "newton_krylov", "picard")


class ReferenceRejected(SamplingError):
    """The candidate references disagree, or a step of one did not converge."""


def nodes(family: str, stages: int) -> np.ndarray:
    """Collocation nodes in (0, 1], ascending: zeros of P_s (Gauss) or of P_s - P_{s-1} (Radau)."""
    if family not in FAMILIES:
        raise UserError(f"Unknown collocation family '{family}'; {did_you_mean(family, FAMILIES)}")
    if stages < 1:
        raise UserError(f"A collocation method needs at least 1 stage; {stages} given.")
    legendre = np.polynomial.Legendre.basis(stages)
    if family == "radau":
        legendre = legendre - np.polynomial.Legendre.basis(stages - 1)
    c = (np.sort(legendre.roots().real) + 1) / 2
    if family == "radau":
        c[-1] = 1.0
    return c


def tableau(family: str, stages: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Butcher tableau (A [s, s], b [s], c [s]) from the nodes alone.

    A_ij = integral of the j-th Lagrange polynomial from 0 to c_i, b_j to 1: the collocation
    conditions C(s) and B(s), solved in the Legendre basis to stay accurate for many stages.
    """
    c = nodes(family, stages)
    basis = [np.polynomial.Legendre.basis(k, domain=[0, 1]) for k in range(stages)]
    values = np.array([p(c) for p in basis])  # [k, s]
    integrals = np.array([p.integ(lbnd=0)(np.append(c, 1.0)) for p in basis])  # [k, s + 1]
    weights = np.linalg.solve(values, integrals).T  # [s + 1, s]
    return weights[:-1], weights[-1], c


def integrate(
    velocity: Callable[[Array, Array], Array],
    x1: Array,
    sigmas: np.ndarray,
    *,
    family: str = "radau",
    stages: int = 3,
    stepper: str = "newton",
    tolerance: float | None = None,
    max_iterations: int = 100,
    end_inside: bool = True,
) -> tuple[Array, dict[str, Array]]:
    """Fixed steps over the grid; returns x at sigmas[-1] and {"failed": steps whose solve did not
    converge, "first": the first of them or -1, "iterations": of all steps together}.

    `end_inside`: where the last step ends at sigma = 0, Gauss nodes replace Radau's in that step;
    they are interior, so the field is not evaluated at 0. "newton" builds dense Jacobians (up to
    some hundred unknowns), "newton_krylov" needs only products (GMRES), "picard" none (non-stiff
    steps). `tolerance` is relative to the state, in iterate and residual; default 200 roundings.
    The residual is measured against h |J|, below whose rounding no iteration can get.
    """
    walk = _walker(velocity, stepper, tolerance, max_iterations)
    sigmas = check_grid(sigmas)
    inside = end_inside and sigmas[-1] == 0.0
    return walk(x1, *_plan(sigmas, family, stages, inside))


def _plan(sigmas: np.ndarray, family: str, stages: int, inside: bool):
    """Grid, padded so that many lengths share a compilation, its steps, and the tableaux of the
    steps and of the last one."""
    capacity = max(512, 1 << (len(sigmas) - 2).bit_length())
    padded = np.append(sigmas, np.full(capacity + 1 - len(sigmas), sigmas[-1]))
    main, last = tableau(family, stages), tableau("gauss" if inside else family, stages)
    return padded, len(sigmas) - 1, main, last


@functools.lru_cache(maxsize=8)
def _walker(velocity, stepper: str, tolerance: float | None, max_iterations: int):
    """One jitted walk over a padded grid: families and step counts share its compilation."""
    if stepper not in STEPPERS:
        raise UserError(f"Unknown stepper '{stepper}'; {did_you_mean(stepper, STEPPERS)}")

    @jax.jit
    def walk(x1, grid, count, main, last):
        dtype = jnp.promote_types(x1.dtype, jnp.float32)
        tol = 200 * float(jnp.finfo(dtype).eps) if tolerance is None else tolerance
        grid, main, last = jax.tree.map(lambda t: jnp.asarray(t, dtype), (grid, main, last))

        def body(i, carry):
            x, report = carry
            table = jax.tree.map(lambda m, e: jnp.where(i == count - 1, e, m), main, last)
            x, ok, iterations = _step(
                velocity, x, grid[i], grid[i + 1], table, stepper, tol, max_iterations
            )
            first = jnp.where(ok | (report["first"] >= 0), report["first"], i)
            report = {
                "failed": report["failed"] + (~ok).astype(jnp.int32),
                "first": first.astype(jnp.int32),
                "iterations": report["iterations"] + iterations.astype(jnp.int32),
            }
            return x, report

        report = {"failed": jnp.int32(0), "first": jnp.int32(-1), "iterations": jnp.int32(0)}
        return jax.lax.fori_loop(0, count, body, (jnp.asarray(x1, dtype), report))

    return walk


def _step(velocity, x, s0, s1, table, stepper, tolerance, max_iterations):
    a, b, c = table
    h = s1 - s0
    # a node on the border looks just inside: the field may jump there (guidance switching)
    levels = jnp.clip(s0 + c * h, jnp.nextafter(s1, s0), jnp.nextafter(s0, s1))
    shape = (-1,) + (1,) * x.ndim

    def slopes(z: Array) -> Array:  # [s, ...]
        return jax.vmap(velocity)(x[None] + z, levels).astype(x.dtype)

    def image(z: Array) -> Array:  # h A v(x + Z)
        return h * jnp.tensordot(a, slopes(z), axes=1, precision="highest")

    # unknowns in units of the state, residual in units of what h J can resolve
    probe = jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape)
    value, push = jax.jvp(lambda y: velocity(y, levels[0]).astype(x.dtype), (x,), (probe,))
    scale = jnp.max(jnp.abs(x)) + jnp.max(jnp.abs(h * value)) + 1e-30
    stiff = 1 + jnp.abs(h) * jnp.max(jnp.abs(push))
    start = jnp.zeros((len(c), *x.shape), x.dtype)
    if stepper == "picard":
        found = optx.fixed_point(
            lambda w, _: image(w * scale) / scale,
            optx.FixedPointIteration(rtol=tolerance, atol=tolerance),
            start,
            max_steps=max_iterations,
            throw=False,
        )
    else:
        kwargs = {}
        if stepper == "newton_krylov":
            import lineax as lx  # optimistix brings it; only this variant names it

            inner = 0.1 * tolerance
            kwargs["linear_solver"] = lx.GMRES(rtol=inner, atol=inner, restart=40, max_steps=400)
        found = optx.root_find(
            lambda w, _: (w - image(w * scale) / scale) / stiff,
            optx.Newton(rtol=tolerance, atol=tolerance, **kwargs),
            start,
            max_steps=max_iterations,
            throw=False,
        )
    end = x + h * jnp.sum(b.reshape(shape) * slopes(found.value * scale), axis=0)
    ok = (found.result == optx.RESULTS.successful) & jnp.isfinite(end).all()
    return end, ok, found.stats["num_steps"]


@dataclass(frozen=True)
class Reference:
    """An accepted reference: its value, and how far the other candidates are from it."""

    x0: Array
    self_error: float  # largest relative difference to another candidate
    differences: dict[str, float]  # "halved step", "higher order", "other family"
    steps: int


def reference_solution(
    velocity: Callable[[Array, Array], Array],
    x1: Array,
    *,
    sigmas: np.ndarray | None = None,
    breaks: Sequence[float] = (),
    steps: int = 12,
    power: float = 3.0,
    stages: int = 4,
    stepper: str = "newton",
    tolerance: float = 1e-8,
    doublings: int = 4,
) -> Reference:
    """The flow from `x1` at sigma = 1 (or sigmas[0]) to the end, trusted to `tolerance`.

    On a grid graded towards 0 (sigma = u^power) that keeps `breaks`, four candidates are made: Radau
    IIA with n and 2n steps, with one stage more, and Gauss, the last two at 2n. All must agree with
    the higher-order one to `tolerance` (relative L2), with every step's status successful; n doubles
    up to `doublings` times until they do. Raises ReferenceRejected otherwise.
    """
    walk = _walker(velocity, stepper, None, 100)
    grids = [_grid(sigmas, steps * 2**k, power, breaks) for k in range(doublings + 2)]
    differences: dict[str, float] = {}
    failed: list[str] = []
    previous: Array | None = None
    for coarse, fine in itertools.pairwise(grids):
        failed = []

        def run(label: str, grid: np.ndarray, family: str, s: int, failed=failed) -> Array:
            plan = _plan(grid, family, s, grid[-1] == 0.0)
            x0, report = walk(x1, *plan)
            if int(report["failed"]):
                i = int(report["first"])
                failed.append(
                    f"{label}: {int(report['failed'])} of {len(grid) - 1} steps did not converge, "
                    f"the first from sigma {grid[i]:.4g} to {grid[i + 1]:.4g}"
                )
            return x0

        base = run("coarse", coarse, "radau", stages) if previous is None else previous
        halved = run("halved step", fine, "radau", stages)
        higher = run("higher order", fine, "radau", stages + 1)
        gauss = run("other family", fine, "gauss", stages)
        norm = float(jnp.linalg.norm(higher.ravel())) + 1e-30
        labels = {"halved step": base - halved, "higher order": halved - higher}
        labels["other family"] = gauss - higher
        differences = {name: float(jnp.linalg.norm(d.ravel())) / norm for name, d in labels.items()}
        worst = max(differences.values())
        if not failed and worst <= tolerance:
            return Reference(higher, worst, differences, len(fine) - 1)
        previous = halved
    report = ", ".join(f"{name} {value:.2e}" for name, value in differences.items())
    raise ReferenceRejected(
        f"No reference solution: with {len(grids[-1]) - 1} steps the candidates differ by {report} "
        f"(allowed {tolerance:.1e}){'; ' + '; '.join(failed) if failed else ''}. Use float64, more "
        "steps, or name the noise levels where the field jumps in `breaks`."
    )


def _grid(sigmas, steps: int, power: float, breaks: Sequence[float]) -> np.ndarray:
    """The graded grid, or a given one with every interval cut into steps / n equal parts."""
    if sigmas is None:
        return schedule("graded", steps, power=power, breaks=breaks)
    n = len(sigmas) - 1
    parts = max(1, round(steps / n))
    where = np.arange(n * parts + 1) / parts
    return np.interp(where, np.arange(n + 1), np.asarray(sigmas, np.float64))
