"""Where samplers fail, and that the remedy in the code is what mends it (docs/results/solvers.md)."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solver_walk import walk

from roge_jax.errors import UserError
from roge_jax.video import testbed
from roge_jax.video.flow import schedule
from roge_jax.video.reference import reference_solution
from roge_jax.video.solver_table import Step, Tape, Vector, _lower
from roge_jax.video.solvers import (
    SOLVERS,
    SamplingError,
    guided,
    raise_if_failed,
    solve,
    tabulate,
)

FIXED = [name for name, solver in SOLVERS.items() if solver.method is not None]


def plane(std):
    """A flow from N(0, 1) to N(0, std^2): linear, so the path from 1 ends at the produced std."""

    def field(x, sigma):
        return (sigma - (1 - sigma) * std**2) / ((1 - sigma) ** 2 * std**2 + sigma**2) * x

    return field


def detail(name, grid, std):
    """Produced over true standard deviation."""
    return float(walk(tabulate(name, grid), plane(std), 1.0)) / std


def test_trapezium_at_zero_inflates_detail_and_our_last_step_does_not():
    grid, std = schedule("uniform", 8), 0.001
    # the textbook method: corrector on every step, so the last looks at sigma = 0
    field, x = plane(std), 1.0
    for s0, s1 in itertools.pairwise(grid):
        v = field(x, s0)
        x = x + 0.5 * (s1 - s0) * (v + field(x + (s1 - s0) * v, s1))
    assert x / std > 50
    for name in FIXED:
        assert 0 < detail(name, grid, std) < 1.5, name


@pytest.mark.parametrize("name", ["heun", "rk4", "midpoint"])
def test_uniform_grids_collapse_detail_and_graded_ones_keep_it_to_their_floor(name):
    std = 0.01
    assert detail("euler", schedule("uniform", 8), std) < 0.1
    # walking to sigma_min and jumping by Euler leaves std / sqrt(std^2 + sigma_min^2); a last step
    # that looks inside its interval keeps more
    for sigma_min in (std, 2 * std):
        grid = schedule("graded", 32, power=4, sigma_min=sigma_min)
        floor = std / np.hypot(std, sigma_min)
        kept = detail(name, grid, std)
        if name == "heun":
            assert kept == pytest.approx(floor, rel=0.05)
        else:
            assert floor < kept < 1.05


def test_no_evaluation_at_zero_is_allowed_in_a_table():
    step = Step(0, 0.5, 0.0, True, False, True)
    with pytest.raises(AssertionError, match="sigma = 0"):
        Tape([step], None).velocity(Vector({0: 1.0}), step, 1.0)


def test_forgetting_and_keeping_vectors_is_exact():
    """A contrived method that reuses an early velocity late: registers must not be overwritten."""
    steps = [Step(i, 1 - i / 4, 0.75 - i / 4, i == 0, False, i == 3) for i in range(4)]
    tape = Tape(steps, None)
    x = Vector({0: 1.0})
    slopes = []
    for step in steps:
        slopes.append(tape.velocity(x, step))
        x = tape.keep(x + step.h * (slopes[0] + 0.5 * slopes[-1]))
    end = x + 3.0 * slopes[1] - 1.0 * Vector({0: 1.0})
    begin, mix = _lower(tape, end)
    stored = begin[:, None] * np.array([[2.0]])
    y, v, seen = 2.0, [], []
    for e, s in enumerate(tape.sigma):
        seen.append(stored[0, 0])
        stored = mix[e] @ np.vstack([stored, [[np.sin(stored[0, 0]) + s]]])
        v.append(np.sin(y) + s)
        assert seen[-1] == pytest.approx(y, abs=1e-14)
        y = y - 0.25 * (v[0] + 0.5 * v[-1])
    assert stored[0, 0] == pytest.approx(y + 3 * v[1] - 2.0, abs=1e-14)


# ---- guidance ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def guided_flow():
    with jax.enable_x64(True):
        problem = testbed.guided_mixture(4.0, (0.313, 0.787), dim=2)
        x1 = np.random.default_rng(0).normal(size=(2, 2))
        truth = reference_solution(
            problem.velocity, x1, breaks=problem.breaks, stepper="picard", tolerance=1e-8
        )
        return jax.jit(problem.velocity), problem.breaks, x1, np.asarray(truth.x0)


@pytest.mark.parametrize("name", FIXED)
def test_guidance_on_the_grid_restores_the_order(name, guided_flow):
    field, switches, x1, truth = guided_flow
    order = SOLVERS[name].order
    errors = {True: [], False: []}
    with jax.enable_x64(True):
        for steps in (64, 128):
            for aligned, found in errors.items():
                breaks = switches if aligned else ()
                grid = schedule("uniform", steps, breaks=breaks)
                x0 = walk(tabulate(name, grid, breaks=breaks), field, x1)
                found.append(np.linalg.norm(x0 - truth))
    assert np.log2(errors[True][0] / errors[True][1]) > order - 0.5
    if order >= 2:  # Euler cannot tell: a jump costs it no more than a step does
        assert errors[True][1] < 0.5 * errors[False][1]
    if order == 4:
        assert errors[True][1] < 1e-3 * errors[False][1]


def test_a_break_off_the_grid_is_refused():
    with pytest.raises(UserError, match=r"switches at sigma 0\.3, which is not a grid point"):
        solve("heun", lambda x, s: x, jnp.ones(2), [1.0, 0.5, 0.0], breaks=(0.3,))


def test_unconditional_network_rests_outside_the_interval():
    called = []

    def unconditional(x, sigma):
        jax.debug.callback(lambda s: called.append(float(s)), sigma)
        return -x

    field = guided(lambda x, s: x, unconditional, 3.0, (0.4, 0.8))
    breaks = (0.4, 0.8)
    grid = schedule("uniform", 10, breaks=breaks)
    jax.jit(lambda x: solve("heun", field, x, grid, breaks=breaks)[0])(jnp.ones(2))
    jax.effects_barrier()
    assert len(called) == 8 and min(called) >= 0.4 and max(called) <= 0.8  # two a step, four steps
    value = field(jnp.ones(2), jnp.float32(0.5))
    np.testing.assert_array_equal(value, -1 + 3.0 * 2 * np.ones(2))


# ---- precision, stability, control ---------------------------------------------------------------------


def test_bfloat16_state_gets_worse_with_more_steps_and_float32_state_does_not():
    problem = testbed.gaussian(np.linspace(-1, 1, 64), np.full(64, 0.5))
    x1 = jnp.asarray(np.random.default_rng(0).normal(size=(16, 64)), jnp.float32)
    truth = problem.exact(x1)

    def field(x, sigma):  # a network that computes in bfloat16
        return problem.velocity(x.astype(jnp.float32), sigma).astype(jnp.bfloat16)

    def error(steps, dtype):
        x0, _ = solve("euler", field, x1, schedule("uniform", steps), state_dtype=dtype)
        return float(jnp.sqrt(jnp.mean((x0.astype(jnp.float32) - truth) ** 2)))

    low = [error(n, jnp.bfloat16) for n in (64, 1024)]
    high = [error(n, None) for n in (64, 1024)]
    assert low[1] > 5 * low[0] and low[1] > 0.1
    assert high[0] > 4 * high[1]


@pytest.mark.parametrize(
    "name, limit",
    [
        ("euler", 2.0),
        ("midpoint", 2.0),
        ("heun", 2.0),
        ("rk4", 2.785),
        ("rkc2", 9.5),
        ("rkc2_8", 40.0),
    ],
)
def test_stability_limits(name, limit):
    """Per step h: decaying modes of rate up to limit / h stay bounded, just beyond they grow."""
    grid = 1 - np.arange(41) / 80  # 40 steps of 1/80, ends at 0.5: no special last step

    def grown(rate):
        x0, _ = solve(name, lambda x, s: rate * x, jnp.ones(1), grid)
        return abs(float(x0[0]))

    assert grown(80 * limit * 0.97) <= 1.0
    # the stabilised methods' intervals are known to 10 % only
    assert grown(80 * limit * (1.2 if name.startswith("rkc2") else 1.03)) > 1.0


def test_stiff_relaxation_stops_with_a_name_not_with_garbage():
    problem, start = testbed.prothero_robinson(-1e6)
    _, info = solve(
        "rk4", problem.velocity, jnp.asarray(start, jnp.float32), schedule("uniform", 64)
    )
    with pytest.raises(SamplingError, match=r"not finite at step \d, sigma"):
        raise_if_failed(info)
    # the stabilised method with enough stages' worth of steps follows the slow solution
    problem, start = testbed.prothero_robinson(-500.0)
    grid = schedule("uniform", 64)
    stable, _ = solve("rkc2", problem.velocity, jnp.asarray(start, jnp.float32), grid)
    assert abs(float(stable[0]) - np.cos(1)) < 1e-3
    classical, info = solve("rk4", problem.velocity, jnp.asarray(start, jnp.float32), grid)
    assert bool(info.failed) or abs(float(classical[0])) > 1e3


def test_adaptive_steps_stop_thrashing_when_the_jump_is_named():
    problem = testbed.guided_mixture(8.0, (0.313, 0.787), dim=4)
    x1 = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4)), jnp.float32)
    grid = np.array([1.0, 0.9, 0.01, 0.0])
    blind = jax.jit(lambda x: solve("bosh3", problem.velocity, x, grid, tolerance=1e-4))
    aware_grid = np.array([1.0, 0.9, 0.787, 0.313, 0.01, 0.0])
    aware = jax.jit(
        lambda x: solve(
            "bosh3", problem.velocity, x, aware_grid, breaks=problem.breaks, tolerance=1e-4
        )
    )
    (_, thrash), (_, calm) = blind(x1), aware(x1)
    raise_if_failed(thrash)
    raise_if_failed(calm)
    assert int(thrash.rejected) >= 3 * max(int(calm.rejected), 3)
    assert int(calm.evaluations) < int(thrash.evaluations)


@pytest.mark.parametrize("above", [True, False])
def test_adaptive_steps_look_at_a_named_jump_from_their_own_side(above):
    """Piecewise constant slopes: exact without a rejection, whichever piece the jump itself belongs to."""

    def velocity(x, sigma):
        return jnp.where((sigma > 0.5) | (above & (sigma == 0.5)), 1.0, -3.0) * jnp.ones_like(x)

    grid = [1.0, 0.9, 0.5, 0.1, 0.0]
    x0, info = solve("bosh3", velocity, jnp.zeros(2), grid, breaks=(0.5,), tolerance=1e-4)
    raise_if_failed(info)
    assert int(info.rejected) == 0
    np.testing.assert_allclose(x0, -0.5 * 1.0 + 0.5 * 3.0, atol=1e-5)


def test_adaptive_budget_is_a_named_failure():
    problem = testbed.random_mixture(4, 4, 0.02)
    _, info = solve(
        "bosh3",
        problem.velocity,
        jnp.ones((1, 4)),
        [1.0, 0.9, 1e-3, 0.0],
        tolerance=1e-5,
        max_evaluations=30,
    )
    assert int(info.evaluations) == 30
    with pytest.raises(SamplingError, match="used all its 30 evaluations and stands at step"):
        raise_if_failed(info)
