"""The path, training noise levels and sampling grids, against the published tables."""

import functools
import itertools
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

CASE = Path(__file__).parents[1] / "fixtures" / "wan_schedules"
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


@pytest.mark.parametrize("spread", [0.05, 0.34, 1.0])
@pytest.mark.parametrize("sigma", [0.0, 0.03, 0.3, 0.8, 1.0])
def test_the_velocity_about_a_guess_is_the_conditional_distribution(sigma, spread):
    """The moments of (noise - x0, x) are known in float64; conditioning them is two lines of linear algebra."""
    guess, rng = 0.7, np.random.default_rng(3)
    rows = np.array([[-1.0, 1.0], [1.0 - sigma, sigma]])  # (noise - x0, x) of (x0, noise)
    covariance = rows @ np.diag([spread**2, 1.0]) @ rows.T
    slope = covariance[0, 1] / covariance[1, 1]
    x = rng.normal(0, 2, (3, 5, 4))
    want = -guess + slope * (x - (1 - sigma) * guess)
    deviation = np.sqrt(np.linalg.det(covariance) / covariance[1, 1])
    mean, std = flow.velocity_about(
        jnp.full(x.shape, guess, jnp.float32),
        jnp.full(4, spread),
        jnp.asarray(x, jnp.float32),
        jnp.float32(sigma),
    )
    np.testing.assert_allclose(mean, want, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(std, np.full_like(x, deviation), rtol=1e-4)


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
    for shift in (1.0, 3.0, 12.0):  # the loss keeps its scale whatever the shift
        weight = flow.loss_weight(flow.training_table(shift)[0], shift=shift)
        np.testing.assert_allclose(weight.mean(), 1.0, rtol=1e-5)


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


@pytest.mark.parametrize("method", ["uniform_index", "logit_normal"])
def test_stratified_sigmas_take_one_from_each_part_and_keep_the_distribution(method):
    draw = functools.partial(flow.training_sigma, method=method, mean=0.4, std=1.7, shift=3.0)
    parts = [np.asarray(draw(jax.random.key(j), (2000,), part=(j, 4))) for j in range(4)]
    for lower, upper in itertools.pairwise(parts):
        assert lower.max() <= upper.min()
    free = np.sort(draw(jax.random.key(9), (8000,)))
    together = np.sort(np.concatenate(parts))
    both = np.concatenate([free, together])
    gap = np.searchsorted(free, both, "right") - np.searchsorted(together, both, "right")
    assert np.abs(gap).max() / 8000 < 1.95 * np.sqrt(2 / 8000)  # Kolmogorov-Smirnov, 0.1 %


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
        (("optimised", 7), "give model="),
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
