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
CASE = Path(__file__).parent / "fixtures" / "wan_schedules"
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

    def velocity(x, s):
        return jnp.tanh(jnp.einsum("oc,bc...->bo...", weight, x)) + a * s * x + b * s

    x1 = jnp.asarray(TENSORS["in.x0"])
    _, info = solve(tabulate(name, grid, evaluate_at=told), velocity, x1, keep_states=True)
    want = TENSORS[f"out.{case['name']}.states"]
    got = np.asarray(info.states[:, 0])
    assert np.linalg.norm(got - want) < 1e-6 * np.linalg.norm(want)  # float32 over 50 steps


# ---- orders ----------------------------------------------------------------------------------------


WHOLE, INNER = (1.0, 0.0), (0.98, 0.02)


@pytest.fixture(scope="module")
def two_flows():
    """A 1-D mixture with its exact quantile map beside an 8-D one with the implicit reference."""
    with jax.enable_x64(True):
        line = testbed.mixture([0.3, 0.7], [[-1.0], [0.8]], [0.5, 0.6])
        space = testbed.random_mixture(8, 4, 0.5)
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(16, 9)))
        truth, self_error = {}, {}
        for start, end in (WHOLE, INNER):
            found = reference_solution(
                space.velocity,
                x1[:, 1:],
                sigmas=schedule("graded", 48, power=3) * (start - end) + end,
                stepper="picard",
                tolerance=1e-9,
                steps=48,
                doublings=1,
            )
            exact = line.exact(x1[:, :1], start, end)
            truth[start, end] = np.concatenate([exact, found.x0], 1)
            self_error[start, end] = found.self_error * np.linalg.norm(found.x0)

        @jax.jit
        def velocity(x, sigma):
            parts = (line.velocity(x[:, :1], sigma), space.velocity(x[:, 1:], sigma))
            return jnp.concatenate(parts, -1)

        return velocity, x1, truth, self_error


@pytest.mark.parametrize(
    "name, interval, lost",
    [(name, WHOLE, 0.0) for name in FIXED if name != "dpmpp_2m"]
    # log-SNR is infinite at both ends: DPM-Solver++'s steps in it stay of size 1 there, which adds
    # a factor log N to the error, log2(ln 256 / ln 128) = 0.19 of observed order
    + [("dpmpp_2m", INNER, 0.0), ("dpmpp_2m", WHOLE, 0.2)],
)
def test_observed_order_against_exact_flow_and_reference(name, interval, lost, two_flows):
    velocity, x1, truth, self_error = two_flows
    coarse = {"rk4": 64, "rkc2": 64}.get(name, 128)
    errors = []
    with jax.enable_x64(True):
        for steps in (coarse, 2 * coarse):
            gap = run(name, velocity, x1, np.linspace(*interval, steps + 1)) - truth[interval]
            errors.append([np.linalg.norm(gap[:, :1]), np.linalg.norm(gap[:, 1:])])
    assert errors[1][1] > 10 * self_error[interval]
    observed = np.log2(np.array(errors[0]) / np.array(errors[1]))
    order = SOLVERS[name].order
    print(name, interval, observed)
    assert np.all(observed > order - lost - 0.3) and np.all(observed < order + 0.6), observed


def test_adaptive_error_follows_its_tolerance(two_flows):
    velocity, x1, truth, _ = two_flows
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


def walk(table, field, x1):
    """Run a table in NumPy, float64: the definition, without JAX."""
    stored = table.begin[:, None] * x1
    for sigma, mix in zip(table.sigma, table.mix, strict=True):
        stored = mix @ np.vstack([stored, field(stored[0], sigma)])
    return stored[0]


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
    if name != "rkc2":  # its stages leave the ray
        np.testing.assert_allclose(ends, target, atol=1e-9)


@pytest.mark.parametrize("name", FIXED)
def test_tables_run_as_defined(name):
    problem = testbed.low_rank(4, 2, 0.3)
    table = tabulate(name, schedule("shift", 6, shift=3.0))
    x1 = np.linspace(-1, 1, 4)
    with jax.enable_x64(True):
        want = walk(table, lambda x, s: np.asarray(problem.velocity(jnp.asarray(x), s)), x1)
        x0, info = solve(table, problem.velocity, jnp.asarray(x1))
    np.testing.assert_allclose(x0, want, rtol=0, atol=1e-13)
    assert int(info.evaluations) == len(table.sigma) == nfe(name, 6)
    np.testing.assert_allclose(
        run(table, problem.velocity, jnp.asarray(x1, jnp.float32)), want, rtol=0, atol=2e-5
    )


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


@pytest.mark.parametrize("name", FIXED)
def test_network_is_traced_once_for_all_grids_of_a_length(name):
    traces = []

    @jax.jit
    def compiled(x, table):
        def velocity(x, sigma):
            traces.append(None)
            return -x * sigma

        return solve(table, velocity, x)[0]

    for shift in (1.0, 3.0, 5.0):
        compiled(jnp.ones(3), tabulate(name, schedule("shift", 5, shift=shift)))
    assert compiled._cache_size() == 1
    assert len(traces) <= 2  # abstract evaluation of the branch may look at it a second time


# ---- failures ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(SOLVERS))
def test_non_finite_velocity_stops_the_run_and_is_named(name):
    called = []

    def velocity(x, sigma):
        jax.debug.callback(lambda s: called.append(float(s)), sigma)
        return jnp.where((sigma < 0.55) & (jnp.arange(6) == 2).reshape(2, 3), jnp.nan, 0.1 * x)

    grid = schedule("graded", 8, power=1, sigma_min=0.1)
    _, info = jax.jit(lambda x: solve(name, velocity, x, grid))(jnp.ones((2, 3)))
    jax.effects_barrier()
    assert sum(s < 0.55 for s in called) == 1  # the one that failed; none after it
    assert len(called) == int(info.evaluations)
    with pytest.raises(SamplingError) as caught:
        raise_if_failed(info)
    message = str(caught.value)
    assert "velocity" in message and "1 of 6 numbers" in message
    assert f"sigma {min(called):.6g}" in message and f"step {int(info.step)}" in message
    if name in FIXED:
        step = int(info.step)
        assert grid[step] + 1e-6 >= min(called) >= grid[step + 1] - 1e-6


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


@pytest.mark.parametrize("name", list(SOLVERS))
def test_projection_holds_known_slots_at_every_stage(name):
    x0, noise = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.7])
    first = np.arange(3) == 0

    def project(x, sigma):  # slot 0 is known
        return jnp.where(first, (1 - sigma) * x0 + sigma * noise, x)

    def velocity(x, sigma):  # the others are drawn to it; its own velocity is nonsense
        return jnp.where(first, 7.0, x - x[0])

    def true(x, sigma):
        return np.where(first, noise - x0, x - x[0])

    grid = schedule("graded", 6, sigma_min=0.05)
    with jax.enable_x64(True):
        got, info = solve(name, velocity, jnp.asarray(noise), grid, project=project)
        raise_if_failed(info)
        got = np.asarray(got)
    assert got[0] == x0[0]
    # the known slot's path is straight, so every method follows it by its true velocity
    if name in FIXED:
        np.testing.assert_allclose(got, walk(tabulate(name, grid), true, noise), atol=1e-12)
    else:  # it chose its own steps for tolerance 1e-3
        fine = walk(tabulate("rk4", schedule("uniform", 50)), true, noise)
        np.testing.assert_allclose(got, fine, atol=3e-3)
