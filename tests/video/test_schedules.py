"""Schedules found offline: the search, and the table it is stored in."""

import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.video import flow
from roge_jax.video.solvers import SOLVERS, nfe, solve, tabulate
from roge_jax.video.testbed import random_mixture


def test_stored_schedules_are_read_per_model_solver_and_step_count(tmp_path, monkeypatch):
    path = tmp_path / "schedules.json"
    path.write_text(json.dumps({"small": {"grids": {"heun": {"3": [1.0, 0.6, 0.2, 0.0]}}}}))
    monkeypatch.setattr(flow, "OPTIMISED_FILE", path)
    grid = flow.schedule("optimised", 3, solver="heun", model="small")
    np.testing.assert_array_equal(grid, [1, 0.6, 0.2, 0])
    for arguments, words in (
        ((4, "heun", "small"), "with 4 steps is stored; there is heun 3"),
        ((3, "euler", "small"), "for solver 'euler' with 3 steps is stored; there is heun 3"),
        ((3, "heun", "large"), "of model 'large' .* there is none for this model"),
        ((3, "heun", None), "belongs to a model"),
    ):
        steps, solver, model = arguments
        with pytest.raises(UserError, match=words):
            flow.schedule("optimised", steps, solver=solver, model=model)
    monkeypatch.setattr(flow, "OPTIMISED_FILE", tmp_path / "none.json")
    with pytest.raises(UserError, match="none for this model"):
        flow.schedule("optimised", 3, solver="heun", model="small")


def test_shipped_schedules_are_usable_by_their_solvers():
    table = json.loads(flow.OPTIMISED_FILE.read_text())
    assert table, "the package ships schedules of its trained model"
    for model, entry in table.items():
        assert {"weights", "search_seeds", "teacher", "command"} <= entry["found"].keys()
        for solver, grids in flow.optimised_grids(model).items():
            for steps in grids:
                grid = flow.schedule("optimised", steps, solver=solver, model=model)
                assert len(grid) == steps + 1 and grid[0] == 1 and grid[-1] == 0
                assert SOLVERS[solver].method is not None
                # `tabulate` refuses grids that do not descend
                assert len(tabulate(solver, grid).sigma) == nfe(solver, steps)


def test_dynamic_programming_finds_the_cheapest_grid():
    # exhaustive search over all grids of a small teacher is the oracle
    rng = np.random.default_rng(0)
    sigmas = np.linspace(1, 0, 9)
    gap = sigmas[:, None] - sigmas[None]
    jumps = rng.uniform(0.1, 1, size=(9, 9)) * gap**2
    memory = rng.uniform(0.1, 1, size=(9, 9, 9)) * gap[None] ** 2
    for steps in (1, 2, 3, 5):
        paths = [(0, *mid, 8) for mid in itertools.combinations(range(1, 8), steps - 1)]
        costs = [sum(jumps[a, b] for a, b in itertools.pairwise(p)) for p in paths]
        best = sigmas[list(paths[int(np.argmin(costs))])]
        np.testing.assert_array_equal(flow.optimise_schedule(sigmas, jumps, steps), best)
        # the start counts as its own predecessor
        costs = [sum(memory[a, b, c] for a, b, c in zip((0, *p), p, p[1:])) for p in paths]
        best = sigmas[list(paths[int(np.argmin(costs))])]
        np.testing.assert_array_equal(flow.optimise_schedule(sigmas, memory, steps), best)
    with pytest.raises(UserError, match=r"allowed 1\.\.8"):
        flow.optimise_schedule(sigmas, jumps, 9)
    with pytest.raises(UserError, match="non-finite"):
        flow.optimise_schedule(sigmas, np.full((9, 9), np.nan), 3)


def test_adams_jump_errors_are_those_of_the_two_step_method():
    rng = np.random.default_rng(1)
    sigmas = np.sort(rng.uniform(0.1, 0.9, 5))[::-1]
    states, slopes = rng.normal(size=(2, 5, 7))
    errors = flow.adams_jump_errors(sigmas, states, slopes)
    for p, i, j in itertools.product(range(5), repeat=3):
        if p < i < j:
            # the line through both slopes, integrated
            bend = (slopes[i] - slopes[p]) / (sigmas[i] - sigmas[p])
            h = sigmas[j] - sigmas[i]
            end = states[i] + h * slopes[i] + h**2 / 2 * bend
            np.testing.assert_allclose(errors[p, i, j], np.mean((end - states[j]) ** 2), rtol=1e-10)
        elif not p == i == 0 < j:
            assert np.isinf(errors[p, i, j])
    np.testing.assert_allclose(
        errors[0, 0], flow.euler_jump_errors(sigmas, states, slopes)[0], rtol=1e-12
    )


def test_refinement_finds_the_minimum_of_a_parabola_in_every_point():
    goal = np.array([1.0, 0.83, 0.3, 0.12, 0.0])
    calls = []

    def error(grid):
        calls.append(1)
        assert np.all(np.diff(grid) < 0)
        return float(np.sum((grid - goal) ** 2))

    found = flow.refine_schedule(error, np.array([1.0, 0.8, 0.35, 0.1, 0.0]), rounds=1)
    np.testing.assert_allclose(found, goal, atol=1e-12)
    assert len(calls) <= 1 + 3 * 3
    start = np.array([1.0, 0.5, 0.0])
    np.testing.assert_array_equal(flow.refine_schedule(lambda g: np.nan, start), start)


@pytest.mark.parametrize("solver", ["euler", "ab2"])
def test_optimised_grid_beats_uniform_and_shift_on_the_flow_it_was_made_for(solver):
    problem = random_mixture(8, 4, 0.1)
    train, held_out = jax.random.normal(jax.random.key(0), (2, 64, 8))
    fine = flow.schedule("uniform", 64)
    run = jax.jit(lambda x, table: solve(table, problem.velocity, x)[0])
    _, info = jax.jit(lambda x: solve("midpoint", problem.velocity, x, fine, keep_states=True))(
        train
    )
    slopes = jax.vmap(problem.velocity)(info.states[:-1], jnp.asarray(fine[:-1], jnp.float32))
    slopes = np.append(slopes, slopes[-1:], axis=0)
    jumps = flow.euler_jump_errors if solver == "euler" else flow.adams_jump_errors
    end = {"train": info.states[-1], "held out": run(held_out, tabulate("midpoint", fine))}

    def error(grid, x=train, of="train"):
        # median over samples: single samples flip to another mode on any coarse grid
        gap = run(x, tabulate(solver, grid)) - end[of]
        return float(jnp.median(jnp.linalg.norm(gap, axis=-1)))

    by_jumps = flow.optimise_schedule(fine, jumps(fine, info.states, slopes), 8)
    refined = flow.refine_schedule(error, by_jumps)
    assert error(refined) <= error(by_jumps)
    found = {
        name: error(flow.schedule(name, 8), held_out, "held out") for name in ("uniform", "shift")
    }
    assert error(refined, held_out, "held out") < 0.8 * min(found.values())
