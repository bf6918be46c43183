"""One table of all samplers; every property that should hold for each is tested over it."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file
from solver_walk import walk

from roge_jax.errors import UserError
from roge_jax.video import testbed
from roge_jax.video.flow import schedule, timesteps
from roge_jax.video.reference import reference_solution
from roge_jax.video.solvers import (
    SOLVERS,
    SamplingError,
    check_grid,
    guided,
    iterate,
    nfe,
    raise_if_failed,
    solve,
    tabulate,
)

FIXED = [name for name, solver in SOLVERS.items() if solver.method is not None]
CASE = Path(__file__).parents[1] / "fixtures" / "wan_schedules"
TENSORS = load_file(CASE / "io.safetensors")
CONFIG = json.loads((CASE / "case.json").read_text())["config"]


def run(solver, velocity, x1, grid=None):
    """Step by step with a velocity compiled once: many grids without compiling each."""
    *_, (_, _, x0) = iterate(solver, velocity, x1, grid)
    return np.asarray(x0)


# ---- equal to the official samplers --------------------------------------------------------------


@pytest.mark.parametrize("case", CONFIG["trajectories"], ids=lambda case: case["name"])
def test_trajectories_equal_the_official_samplers(case):
    name = {"unipc": "unipc_2", "dpmpp": "dpmpp_2m", "euler": "euler"}[case["solver"]]
    kind = {"euler": "shift"}.get(case["solver"], case["solver"])
    grid = schedule(kind, case["n"], shift=case["shift"])
    told = None
    if case["velocity_argument"] != "sigma":  # the official code tells the network whole timesteps
        told = timesteps(grid[:-1], truncate=case["solver"] != "euler") / 1000
    a, b, weight = CONFIG["toy"]["a"], CONFIG["toy"]["b"], TENSORS["in.W"]

    @jax.jit
    def velocity(x, s):
        return jnp.tanh(jnp.einsum("oc,bc...->bo...", weight, x)) + a * s * x + b * s

    x1, table = jnp.asarray(TENSORS["in.x0"]), tabulate(name, grid, evaluate_at=told)
    states = [x1, *(x for _, _, x in iterate(table, velocity, x1))]
    got = np.stack(states)[:, 0]
    want = TENSORS[f"out.{case['name']}.states"]
    assert np.linalg.norm(got - want) < 1e-6 * np.linalg.norm(want)  # float32 over 50 steps


def test_states_kept_by_solve_are_those_of_each_step():
    grid = schedule("shift", 5)
    x1 = jnp.linspace(-1, 1, 4)
    # the last step, 0.56 wide, is of third order; the others are of fourth
    x0, info = solve("rk4", lambda x, s: x * s, x1, grid, keep_states=True)
    assert info.states.shape == (6, 4)
    np.testing.assert_array_equal(info.states[0], x1)
    np.testing.assert_array_equal(info.states[-1], x0)
    # x(sigma) = x1 exp((sigma^2 - 1) / 2)
    exact = x1[None] * np.exp((grid**2 - 1) / 2)[:, None]
    np.testing.assert_allclose(info.states[:-1], exact[:-1], rtol=0, atol=2e-5)
    np.testing.assert_allclose(info.states[-1], exact[-1], rtol=0, atol=2e-3)


# ---- orders ----------------------------------------------------------------------------------------


WHOLE, INNER = (1.0, 0.0), (0.98, 0.02)
PARTS = (slice(0, 1), slice(1, 4), slice(4, 12), slice(12, 14))  # coordinates of each flow


@pytest.fixture(scope="module")
def flows():
    """A 1-D mixture and a linear-Gaussian posterior with their exact maps, an 8-D mixture and a data set in the plane with
    the implicit reference, side by side: (velocity, x1 [16, 14], {interval: truth}, {interval: self-error}).
    """
    with jax.enable_x64(True):
        problems = (
            testbed.mixture([0.3, 0.7], [[-1.0], [0.8]], [0.5, 0.6]),
            testbed.conditional([[1.0, 0.5, 0.0], [0.0, -1.0, 0.7]], [0.8, -0.3], 0.5),
            testbed.random_mixture(8, 4, 0.5),
            testbed.empirical(np.array([[1.0, 0.2], [-0.8, 0.9], [-0.1, -1.1]]), 0.5),
        )
        assert [p.dim for p in problems] == [part.stop - part.start for part in PARTS]

        def beside(problems):
            ends = np.cumsum([p.dim for p in problems])[:-1]

            def velocity(x, sigma):
                parts = jnp.split(x, ends, axis=-1)
                return jnp.concatenate([p.velocity(y, sigma) for p, y in zip(problems, parts)], -1)

            return velocity

        known = PARTS[2].start
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(16, PARTS[-1].stop)))
        truth, self_error = {}, {}
        for start, end in (WHOLE, INNER):
            exact = [p.exact(x1[:, part], start, end) for p, part in zip(problems[:2], PARTS)]
            found = reference_solution(
                beside(problems[2:]),
                x1[:, known:],
                sigmas=schedule("graded", 48, power=3) * (start - end) + end,
                stepper="picard",
                tolerance=1e-9,
                steps=48,
                doublings=1,
            )
            truth[start, end] = np.concatenate([*exact, found.x0], 1)
            self_error[start, end] = found.self_error * np.linalg.norm(found.x0)
        return jax.jit(beside(problems)), x1, truth, self_error


@pytest.mark.parametrize(
    "name, interval, lost",
    [(name, WHOLE, 0.0) for name in FIXED if name != "dpmpp_2m"]
    # log-SNR is infinite at both ends: DPM-Solver++'s steps in it stay of size 1 there, which adds
    # a factor log N to the error, log2(ln 256 / ln 128) = 0.19 of observed order
    + [("dpmpp_2m", INNER, 0.0), ("dpmpp_2m", WHOLE, 0.2)],
)
def test_observed_order_against_exact_flow_and_reference(name, interval, lost, flows):
    velocity, x1, truth, self_error = flows
    coarse = {"rk4": 64, "rkc2": 64, "rkc2_8": 64}.get(name, 128)
    errors = []
    with jax.enable_x64(True):
        for steps in (coarse, 2 * coarse):
            gap = run(name, velocity, x1, np.linspace(*interval, steps + 1)) - truth[interval]
            errors.append([np.linalg.norm(gap[:, part]) for part in PARTS])
    assert min(errors[1][2:]) > 10 * self_error[interval]
    observed = np.log2(np.array(errors[0]) / np.array(errors[1]))
    order = np.full(len(PARTS), SOLVERS[name].order)
    if (
        name == "midpoint"
    ):  # on a Gaussian r'' ~ r^-3 along x = r(sigma): its r'''/24 + (r'/r) r''/8 is zero
        order[1] += 1
    print(name, interval, observed)
    assert np.all(observed > order - lost - 0.3) and np.all(observed < order + 0.6), observed


def test_adaptive_error_follows_its_tolerance(flows):
    velocity, x1, truth, _ = flows
    grid = np.array([1.0, 0.9, 1e-4, 0.0])
    with jax.enable_x64(True):
        adapt = jax.jit(
            lambda x, tol: solve("bosh3", velocity, x, grid, tolerance=tol, max_evaluations=3000)
        )
        errors, costs = [], []
        for tolerance in (1e-2, 1e-4, 1e-6):
            x0, info = adapt(x1, tolerance)
            raise_if_failed(info)
            errors.append(np.linalg.norm((x0 - truth[WHOLE])[:, :1]) / 4)
            costs.append(int(info.evaluations))
    assert errors[0] < 1e-1 and errors[1] < 1e-3 and errors[2] < 1e-5
    # third order: 100 times less error for 100^(1/3) = 4.6 times the work
    assert 3 < costs[2] / costs[1] < 6


# ---- properties of every table ------------------------------------------------------------------------


grids = st.lists(st.floats(0.02, 0.98), min_size=1, max_size=7, unique=True).filter(
    lambda inner: np.diff(np.sort([0, *inner, 1])).min() > 0.01
)


@settings(max_examples=25, deadline=None)
@given(inner=grids)
@pytest.mark.parametrize("name", FIXED)
def test_every_method_is_exact_on_straight_lines_and_stays_inside(name, inner):
    grid = np.array([1.0, *sorted(inner, reverse=True), 0.0])
    table = tabulate(name, grid)
    assert table.sigma.min() > 0 and table.sigma.max() <= 1
    assert np.isfinite(table.mix).all()
    x1 = np.array([0.3, -2.0])
    np.testing.assert_allclose(walk(table, lambda x, s: np.array([1.0, -0.5]), x1), [-0.7, -1.5])
    # rays to one point: the field of exactly one training image, 0/0 at sigma = 0
    target = np.array([4.0, 5.0])
    ends = walk(table, lambda x, s: (x - target) / s, x1)
    if not name.startswith("rkc2"):  # its stages leave the ray
        np.testing.assert_allclose(ends, target, atol=1e-9)


def test_cost_of_a_step_is_as_stated():
    counts = {name: nfe(name, 10) for name in FIXED}
    ends = {"heun": 19, "rk4": 39, "ab3": 11}  # cheaper last step, costlier first
    for name in FIXED:
        assert counts[name] == ends.get(name, 10 * SOLVERS[name].nfe_per_step)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_state_is_float32_whatever_the_network_returns(name):
    grid = schedule("graded", 4, sigma_min=0.1)
    seen = set()

    def velocity(x, sigma):
        seen.add((x.dtype, sigma.dtype))
        return (-0.5 * x).astype(jnp.bfloat16)

    start = jax.ShapeDtypeStruct((2, 3), jnp.bfloat16)
    x0, _ = jax.eval_shape(lambda x: solve(name, velocity, x, grid), start)
    assert x0.dtype == jnp.float32 and x0.shape == (2, 3)
    assert seen == {(jnp.dtype("float32"), jnp.dtype("float32"))}


# ---- failures ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FIXED)
def test_compiled_loop_follows_the_table_is_traced_once_and_stops_at_a_nan(name):
    problem, called, traces = testbed.low_rank(4, 2, 0.3), [], []

    @jax.jit
    def compiled(x, table, poisoned_below):
        def velocity(x, sigma):
            traces.append(None)
            jax.debug.callback(lambda s: called.append(float(s)), sigma)
            bad = (sigma < poisoned_below) & (jnp.arange(4) == 2)
            return jnp.where(bad, jnp.nan, problem.velocity(x, sigma))

        return solve(table, velocity, x)

    x1 = np.linspace(-1, 1, 4)
    for shift in (1.0, 3.0, 5.0):
        table = tabulate(name, schedule("shift", 6, shift=shift))
        x0, info = compiled(jnp.asarray(x1, jnp.float32), table, -1.0)
        raise_if_failed(info)
        with jax.enable_x64(True):
            want = walk(table, lambda x, s: problem.velocity(jnp.asarray(x), s), x1)
        np.testing.assert_allclose(x0, want, rtol=0, atol=2e-5)
        assert int(info.evaluations) == len(table.sigma) == nfe(name, 6)
    assert compiled._cache_size() == 1
    assert len(traces) <= 2  # abstract evaluation of the branch may look at it a second time

    jax.effects_barrier()
    called.clear()
    _, info = compiled(jnp.asarray(x1, jnp.float32), table, 0.8)
    jax.effects_barrier()
    check_named_failure(info, called, 0.8, 4)
    step = int(info.step)
    assert table.grid[step] + 1e-6 >= min(called) >= table.grid[step + 1] - 1e-6


def check_named_failure(info, called, poisoned_below, size):
    assert sum(s < poisoned_below for s in called) == 1  # the one that failed, and none after it
    assert len(called) == int(info.evaluations)
    with pytest.raises(SamplingError) as caught:
        raise_if_failed(info)
    message = str(caught.value)
    assert "velocity" in message and f"1 of {size} numbers" in message
    assert f"sigma {min(called):.6g}" in message and f"step {int(info.step)}" in message


def test_adaptive_loop_stops_at_a_nan():
    called = []

    def velocity(x, sigma):
        jax.debug.callback(lambda s: called.append(float(s)), sigma)
        return jnp.where((sigma < 0.55) & (jnp.arange(6) == 2).reshape(2, 3), jnp.nan, 0.1 * x)

    grid = np.array([1.0, 0.9, 0.1, 0.0])
    _, info = jax.jit(lambda x: solve("bosh3", velocity, x, grid))(jnp.ones((2, 3)))
    jax.effects_barrier()
    check_named_failure(info, called, 0.55, 6)
    # with two levels there is the closing Euler step alone
    _, info = solve("bosh3", lambda x, sigma: x * jnp.nan, jnp.ones((2, 3)), [1.0, 0.0])
    with pytest.raises(SamplingError, match=r"velocity .* not finite at step 0, sigma 1: 6 of 6"):
        raise_if_failed(info)


def test_overflowing_state_is_named():
    _, info = solve("euler", lambda x, s: -1e30 * x, jnp.ones(4), schedule("uniform", 8))
    with pytest.raises(SamplingError, match="not finite at step"):
        raise_if_failed(info)
    _, info = solve("euler", lambda x, s: jnp.full_like(x, 3e38), -3e38 * jnp.ones(4), [1.0, 0.0])
    with pytest.raises(SamplingError, match="The state is not finite at step 1, sigma 0"):
        raise_if_failed(info)


def test_iterate_raises_at_once():
    calls = []

    def velocity(x, sigma):
        calls.append(float(sigma))
        return x * (jnp.nan if len(calls) == 3 else 1.0)

    with pytest.raises(SamplingError, match=r"velocity .* step 1, sigma 0.5"):
        list(iterate("midpoint", velocity, jnp.ones(2), schedule("uniform", 2)))
    assert len(calls) == 3


@pytest.mark.parametrize(
    "grid, words",
    [
        ([1.0, 0.5, 0.5, 0.0], "entries 1 and 2 are 0.5 and 0.5"),
        ([0.0, 0.5, 1.0], "descend strictly"),
        ([1.0, 0.5, 0.5 - 1e-9, 0.0], "descend strictly"),
        ([1.2, 0.0], r"lie in \[0, 1\]"),
        ([1.0, np.nan, 0.0], "finite"),
        ([1.0], "2 or more"),
    ],
)
def test_bad_grids_are_rejected(grid, words):
    with pytest.raises(UserError, match=words):
        check_grid(grid)
    for name in SOLVERS:
        with pytest.raises(UserError, match=words):
            solve(name, lambda x, s: x, jnp.ones(2), grid)


def test_unknown_names_are_answered():
    with pytest.raises(UserError, match="did you mean 'heun'"):
        solve("huen", lambda x, s: x, jnp.ones(2), [1.0, 0.0])
    with pytest.raises(UserError, match="needs a sigma grid"):
        solve("heun", lambda x, s: x, jnp.ones(2))
    with pytest.raises(UserError, match="guidance interval"):
        guided(lambda x, s: x, lambda x, s: x, 2.0, (0.8, 0.2))


# ---- holding a part of the state ---------------------------------------------------------------------


KNOWN, NOISE, FIRST = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.7]), np.arange(3) == 0


def hold_first(x, sigma):
    return jnp.where(FIRST, (1 - sigma) * KNOWN + sigma * NOISE, x)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_projection_holds_known_slots_at_every_stage(name):
    @jax.jit
    def velocity(x, sigma):  # the others are drawn to slot 0, whose own velocity is nonsense
        return jnp.where(FIRST, 7.0, x - x[0])

    def true(x, sigma):  # slot 0 moves on a straight line, which every method follows exactly
        return np.where(FIRST, NOISE - KNOWN, x - x[0])

    grid = schedule("graded", 6, sigma_min=0.05)
    with jax.enable_x64(True):
        if name in FIXED:
            *_, (_, _, x0) = iterate(name, velocity, jnp.asarray(NOISE), grid, project=hold_first)
            want, allowed = walk(tabulate(name, grid), true, NOISE), 1e-12
        else:  # it chooses its own steps for tolerance 1e-3
            x0, info = solve(name, velocity, jnp.asarray(NOISE), grid, project=hold_first)
            raise_if_failed(info)
            want, allowed = walk(tabulate("rk4", schedule("uniform", 50)), true, NOISE), 3e-3
        got = np.asarray(x0)
    assert got[0] == KNOWN[0]
    np.testing.assert_allclose(got, want, atol=allowed)


def test_known_slots_have_no_say_in_the_adaptive_steps():
    """The network's velocity there is nonsense, however large: it must not shorten a step."""
    grid = schedule("graded", 6, sigma_min=0.05)

    def run(nonsense):
        def velocity(x, sigma):
            return jnp.where(FIRST, nonsense * jnp.cos(9.0 * sigma), x - x[0])

        with jax.enable_x64(True):
            x1 = jnp.asarray(NOISE)
            x0, info = solve("bosh3", velocity, x1, grid, project=hold_first)
            return np.asarray(x0), int(info.evaluations), int(info.rejected)

    (small, *cost), (large, *same) = run(1.0), run(1e3)
    assert cost == same
    np.testing.assert_array_equal(small, large)


def test_projection_in_the_compiled_loop_equals_the_python_loop():
    grid = schedule("graded", 6, sigma_min=0.05)

    def velocity(x, sigma):
        return jnp.where(FIRST, 7.0, x - x[0])

    with jax.enable_x64(True):
        x0, _ = solve("heun", velocity, jnp.asarray(NOISE), grid, project=hold_first)
        *_, (_, _, want) = iterate("heun", velocity, jnp.asarray(NOISE), grid, project=hold_first)
        np.testing.assert_allclose(x0, want, rtol=0, atol=1e-14)
