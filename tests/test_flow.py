"""The path, training noise levels and sampling grids, against the published tables."""

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
from roge_jax.video import flow

CASE = Path(__file__).parent / "fixtures" / "wan_schedules"
TENSORS = load_file(CASE / "io.safetensors")
CONFIG = json.loads((CASE / "case.json").read_text())["config"]
FLOAT32 = float(np.finfo(np.float32).eps)


def test_path_ends_at_sample_and_noise_and_its_slope_is_the_target():
    x0, noise = jax.random.normal(jax.random.key(0), (2, 3, 4, 5))
    np.testing.assert_array_equal(flow.x_sigma(x0, noise, jnp.zeros(3)), x0)
    np.testing.assert_array_equal(flow.x_sigma(x0, noise, jnp.ones(())), noise)
    sigma = jnp.array([0.1, 0.5, 0.9])
    _, slope = jax.jvp(lambda s: flow.x_sigma(x0, noise, s), (sigma,), (jnp.ones(3),))
    target = flow.velocity_target(x0, noise)
    np.testing.assert_allclose(slope, target, rtol=0, atol=4 * FLOAT32)
    seen = flow.x_sigma(x0, noise, sigma)
    np.testing.assert_allclose(flow.denoised(seen, target, sigma), x0, rtol=0, atol=1e-6)


@pytest.mark.parametrize("steps", CONFIG["n"])
@pytest.mark.parametrize("shift", CONFIG["shift"])
@pytest.mark.parametrize(
    "name, official", [("shift", "euler"), ("unipc", "unipc"), ("dpmpp", "dpmpp")]
)
def test_grids_and_timesteps_equal_the_official_ones(name, official, steps, shift):
    grid = flow.schedule(name, steps, shift=shift)
    want = TENSORS[f"out.{official}.n{steps}_s{shift}.sigmas"]
    assert grid[-1] == 0 and len(grid) == steps + 1
    # the predecessor's grid has no closing 0 and is made in float32: two roundings
    np.testing.assert_allclose(grid[: len(want)], want, rtol=0, atol=2 * FLOAT32)
    times = flow.timesteps(grid[:-1], truncate=official != "euler")
    want = TENSORS[f"out.{official}.n{steps}_s{shift}.timesteps"]
    np.testing.assert_allclose(times, want, rtol=0, atol=0 if official != "euler" else 2e-4)


def test_training_table_equals_the_published_one():
    sigmas, weights = flow.training_table(5.0)
    np.testing.assert_allclose(sigmas, TENSORS["out.train_s5.0.sigmas"], rtol=0, atol=2 * FLOAT32)
    np.testing.assert_allclose(weights, TENSORS["out.train_s5.0.weights"], rtol=0, atol=2e-6)
    np.testing.assert_allclose(weights.mean(), 1.0, rtol=1e-12)
    assert weights[0] == 0  # sigma = 1 carries no signal about the scene
    close = flow.loss_weight(jnp.asarray(sigmas, jnp.float32))
    # float32 exp near 0.6 minus exp(-1/2): an ulp of 0.6, times the scale 1000 / 189.5
    np.testing.assert_allclose(close, weights, rtol=0, atol=5.3 * 2 * FLOAT32)
    np.testing.assert_array_equal(flow.loss_weight(jnp.ones(2), weighting="uniform"), np.ones(2))


def test_rounding_timesteps_to_bfloat16_moves_training_indices_as_published():
    got = flow.bf16_training_index(CONFIG["train_ids"])
    np.testing.assert_array_equal(got, TENSORS["out.train_s5.0.example_index_after_bf16"])
    assert len(np.unique(flow.bf16_training_index(np.arange(1000)))) == 294


def test_noised_examples_equal_the_published_ones():
    index = TENSORS["out.train_s5.0.example_index_after_bf16"]
    sigmas, weights = flow.training_table(5.0)
    clean, noise = TENSORS["in.clean"][0], TENSORS["in.x0"][0]
    many = np.broadcast_to(clean, (len(index), *clean.shape))
    noised = flow.x_sigma(many, np.broadcast_to(noise, many.shape), jnp.asarray(sigmas[index]))
    np.testing.assert_allclose(noised, TENSORS["out.train_s5.0.example_noised"], rtol=0, atol=1e-6)
    want = TENSORS["out.train_s5.0.example_weight"]
    np.testing.assert_allclose(weights[index], want, rtol=0, atol=2e-6)
    np.testing.assert_allclose(
        flow.velocity_target(clean, noise), TENSORS["out.train_target"][0], rtol=0, atol=1e-6
    )


def test_training_sigmas_follow_their_distribution():
    sigmas = np.sort(np.asarray(flow.training_sigma(jax.random.key(0), (20000,))))
    assert sigmas.min() > 0 and sigmas.max() <= 1
    table = np.sort(flow.training_table(5.0)[0].astype(np.float32))
    assert (
        np.abs(table[:, None] - sigmas[None, ::100]).min(0).max() < 2 * FLOAT32
    )  # grid points only
    # Kolmogorov-Smirnov against sigma = shifted(u): 1.95 / sqrt(n) is the 0.1 % point
    u = sigmas / (5 - 4 * sigmas)
    assert np.abs(u - (np.arange(20000) + 0.5) / 20000).max() < 1.95 / np.sqrt(20000) + 1e-3
    normal = flow.training_sigma(jax.random.key(1), (20000,), method="logit_normal", shift=1.0)
    logits = np.log(normal / (1 - normal))
    assert abs(logits.mean()) < 4 / np.sqrt(20000) and abs(logits.std() - 1) < 4 / np.sqrt(40000)


@settings(max_examples=60, deadline=None)
@given(
    name=st.sampled_from(["shift", "unipc", "dpmpp", "uniform", "graded"]),
    steps=st.integers(3, 60),
    shift=st.floats(0.5, 16),
    breaks=st.lists(st.floats(0.05, 0.95), max_size=2, unique=True),
)
def test_every_grid_descends_to_zero_and_meets_the_breaks(name, steps, shift, breaks):
    grid = flow.schedule(name, steps, shift=shift, breaks=breaks)
    assert len(grid) == steps + 1 and grid[-1] == 0 and grid[0] <= 1
    assert np.all(np.diff(grid) < 0)
    assert set(breaks) <= set(grid.tolist())


def test_graded_grid_walks_to_sigma_min_and_jumps():
    grid = flow.schedule("graded", 8, power=4, sigma_min=1e-3)
    assert grid[0] == 1 and grid[-2] == pytest.approx(1e-3) and grid[-1] == 0
    assert np.all(np.diff(np.diff(grid[:-1])) > 0)  # steps shrink towards 0


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("shfit", 10), "did you mean 'shift'"),
        (("shift", 0), "whole number >= 1"),
        (("shift", 2.5), "whole number >= 1"),
        (("optimised", 7), "No optimised schedule for solver 'euler' with 7 steps"),
    ],
)
def test_wrong_requests_are_named(arguments, words, tmp_path, monkeypatch):
    monkeypatch.setattr(flow, "OPTIMISED_FILE", tmp_path / "none.json")
    with pytest.raises(UserError, match=words):
        flow.schedule(*arguments)
    with pytest.raises(UserError, match="at least 3 steps"):
        flow.schedule("uniform", 2, breaks=(0.3, 0.6))
    with pytest.raises(UserError, match="Unknown loss weighting"):
        flow.training_table(weighting="bmup")


def test_optimised_schedules_are_read_per_solver_and_step_count(tmp_path, monkeypatch):
    path = tmp_path / "schedules.json"
    path.write_text(json.dumps({"grids": {"heun": {"3": [1.0, 0.6, 0.2, 0.0]}}}))
    monkeypatch.setattr(flow, "OPTIMISED_FILE", path)
    np.testing.assert_array_equal(flow.schedule("optimised", 3, solver="heun"), [1, 0.6, 0.2, 0])
    with pytest.raises(UserError, match="heun: 3"):
        flow.schedule("optimised", 4, solver="heun")


def test_dynamic_programming_finds_the_cheapest_grid():
    # exhaustive search over all grids of a small teacher is the oracle
    import itertools

    rng = np.random.default_rng(0)
    sigmas = np.linspace(1, 0, 9)
    errors = rng.uniform(0.1, 1, size=(9, 9)) * (sigmas[:, None] - sigmas[None]) ** 2
    for steps in (1, 3, 5):
        paths = [(0, *mid, 8) for mid in itertools.combinations(range(1, 8), steps - 1)]
        costs = [sum(errors[a, b] for a, b in itertools.pairwise(p)) for p in paths]
        best = sigmas[list(paths[int(np.argmin(costs))])]
        np.testing.assert_array_equal(flow.optimise_schedule(sigmas, errors, steps), best)
    with pytest.raises(UserError, match=r"allowed 1\.\.8"):
        flow.optimise_schedule(sigmas, errors, 9)


def test_optimised_grid_beats_uniform_and_shift_on_the_flow_it_was_made_for():
    from roge_jax.video.solvers import solve, tabulate
    from roge_jax.video.testbed import random_mixture

    problem = random_mixture(8, 4, 0.1)
    train, held_out = jax.random.normal(jax.random.key(0), (2, 64, 8))
    fine = flow.schedule("uniform", 64)
    run = jax.jit(lambda x, table: solve(table, problem.velocity, x)[0])
    _, info = jax.jit(lambda x: solve("midpoint", problem.velocity, x, fine, keep_states=True))(
        train
    )
    slopes = jax.vmap(problem.velocity)(info.states[:-1], jnp.asarray(fine[:-1], jnp.float32))
    errors = flow.euler_jump_errors(fine, info.states, np.append(slopes, slopes[-1:], axis=0))
    end = {"train": info.states[-1], "held out": run(held_out, tabulate("midpoint", fine))}

    def error(grid, x=train, of="train"):
        # median over samples: single samples flip to another mode on any coarse grid
        gap = run(x, tabulate("euler", grid)) - end[of]
        return float(jnp.median(jnp.linalg.norm(gap, axis=-1)))

    by_jumps = flow.optimise_schedule(fine, errors, 8)
    refined = flow.refine_schedule(error, by_jumps, rounds=2, trials=4)
    assert error(refined) <= error(by_jumps)
    found = {
        name: error(flow.schedule(name, 8), held_out, "held out") for name in ("uniform", "shift")
    }
    assert error(refined, held_out, "held out") < 0.8 * min(found.values())
