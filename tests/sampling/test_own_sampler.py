"""A sampler of one's own and noise levels as an array, through chunks and chaining, on a velocity known in closed form."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene_files import nerfstudio, truth

from roge_jax import sampling
from roge_jax.config import preset
from roge_jax.errors import UserError
from roge_jax.geometry.trajectories import make_path
from roge_jax.planning import options
from roge_jax.sampling import programs
from roge_jax.scenes.scene import load_scene
from roge_jax.video import flow, solvers

CONFIG = preset("tiny")
GRID = (1.0, 0.7, 0.2, 0.0)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own") / "scene"
    nerfstudio(folder, truth(3))
    return sampling.read_photos(load_scene(folder), [0, 1, 2], CONFIG)


def speed(x, sigma):
    """Towards zero, the faster the more noise."""
    return x * (0.5 + sigma)


@pytest.fixture
def decoded(monkeypatch):
    """Latents of every window; nothing is compiled, and the velocity is `speed`."""
    found = []

    def for_window(params, views, config, slots):
        size = (config.frames, config.height, config.width, 3)
        shown = np.zeros((config.frames, config.recon_height, config.recon_width, 3), np.float32)

        def decode(params, x0, detail):
            found.append(np.asarray(x0))
            return np.zeros(size, np.float32)

        prepared = SimpleNamespace(shown=shown, detail=None, full=None)
        return programs.Programs(
            lambda params, views: prepared,
            lambda params, ready, noise, x, sigma: speed(x, sigma),
            decode,
        )

    monkeypatch.setattr(programs, "for_window", for_window)
    monkeypatch.setattr(
        programs, "velocity", lambda p, ready, noise, x, sigma, *, config, slots: speed(x, sigma)
    )
    monkeypatch.setattr(jax, "block_until_ready", lambda x: x)  # the stand-in is no array
    return found


def euler(velocity, x, grid):
    for sigma, following in itertools.pairwise(grid):
        x = x + (following - sigma) * velocity(x, sigma)
    return x


def scanned(velocity, x, grid):
    """The same as one loop of JAX: the velocity is traced."""

    def step(x, pair):
        return x + (pair[1] - pair[0]) * velocity(x, pair[0]), None

    pairs = jnp.stack([jnp.asarray(grid[:-1]), jnp.asarray(grid[1:])], 1).astype(x.dtype)
    return jax.lax.scan(step, x, pairs)[0]


class Bar:
    def __init__(self):
        self.steps, self.total = 0, "none was given"

    def reset(self, total=None):
        self.total = total

    def update(self, n=1):
        self.steps += n

    def set_description(self, desc): ...

    def close(self): ...


def made(photos, decoded, **settings):
    decoded.clear()
    path, bar = make_path("orbit", photos.cameras, 2 * CONFIG.frames + 1), Bar()
    result = sampling.sample({}, CONFIG, photos, path, sampling.Settings(**settings), progress=bar)
    return result, bar, [x.copy() for x in decoded]


@pytest.mark.parametrize("sampler", [euler, scanned])
@pytest.mark.parametrize("long", ["chain", "independent"])
def test_it_makes_every_chunk(photos, decoded, sampler, long):
    _, known, want = made(photos, decoded, solver="euler", schedule=GRID, long=long)
    result, bar, found = made(photos, decoded, solver=sampler, schedule=GRID, long=long)
    assert len(found) == len(want) == 3
    for a, b in zip(found, want, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert result.evaluations == bar.steps == known.steps == 3 * (len(GRID) - 1)
    assert known.total == bar.steps and bar.total is None  # nobody knows how many it will take
    assert bool(result.windows[1]["generated"]) == (long == "chain")


def test_noise_levels_are_those_given(photos, decoded):
    asked = []

    def spy(velocity, x, grid):
        asked.append(grid)
        return x

    made(photos, decoded, solver=spy, schedule=np.array(GRID))
    np.testing.assert_array_equal(asked, [GRID] * 3)
    made(photos, decoded, solver=spy, steps=4, schedule="uniform")
    np.testing.assert_array_equal(asked[-1], flow.schedule("uniform", 4))
    settings = sampling.Settings(schedule=list(GRID)).of(CONFIG)
    assert settings.steps == 3 and settings.schedule == GRID and settings.solver == "euler"


def test_mistakes_are_one_sentence(photos, decoded):
    with pytest.raises(UserError, match="return the latents of all slots"):
        made(photos, decoded, solver=lambda velocity, x, grid: x[1:], schedule=GRID)
    with pytest.raises(UserError, match="steps 2 beside a schedule of 4 noise levels"):
        sampling.Settings(steps=2, schedule=GRID)
    with pytest.raises(UserError, match="descend strictly"):
        sampling.Settings(schedule=[0.0, 1.0])
    for own in ({"solver": euler}, {"schedule": GRID}):
        with pytest.raises(UserError, match="sample with your own without a plan"):
            options.full_choices(photos, CONFIG, photos.cameras, sampling.Settings(**own))


@pytest.mark.parametrize(
    ("sampler", "said"),
    [
        (lambda velocity, x, grid: x * np.nan, "The state is not finite at step 0"),
        (lambda velocity, x, grid: velocity(x * np.inf, 1.0), "The state is not finite at step 0"),
        (lambda velocity, x, grid: velocity(x, np.inf), "velocity .* at step 1"),
    ],
)
def test_numbers_that_are_not_finite_stop_it(photos, decoded, sampler, said):
    with pytest.raises(solvers.SamplingError, match=said):
        made(photos, decoded, solver=sampler, schedule=GRID)


def test_solve_takes_it_and_holds_the_context_slots():
    noise = jnp.asarray(np.random.default_rng(0).standard_normal((3, 2)), jnp.float32)
    known = jnp.ones((1, 2))

    def project(x, sigma):
        return jnp.concatenate([(1 - sigma) * known + sigma * noise[:1], x[1:]])

    def field(x, sigma):
        return speed(x, sigma) + x[:1]  # what the context slots hold counts

    found = []
    for solver in ("euler", euler):
        x0, info = solvers.solve(solver, field, noise, np.array(GRID), project=project)
        solvers.raise_if_failed(info)
        found.append(x0)
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)
    np.testing.assert_allclose(found[1][:1], known)
    assert int(info.evaluations) == -1
    _, info = solvers.solve(lambda v, x, grid: x * jnp.nan, field, noise, np.array(GRID))
    with pytest.raises(solvers.SamplingError, match="state is not finite"):
        solvers.raise_if_failed(info)


def test_views_of_a_chunk_are_those_that_sample_makes(photos, monkeypatch):
    seen = []

    def for_window(params, views, config, slots):
        seen.append(views)
        raise KeyboardInterrupt

    monkeypatch.setattr(programs, "for_window", for_window)
    path = make_path("orbit", photos.cameras, CONFIG.frames - 2)
    with pytest.raises(KeyboardInterrupt):
        sampling.sample({}, CONFIG, photos, path, sampling.Settings(scale=2.0))
    views, info = sampling.make_views(photos, path, CONFIG, scale=2.0)
    assert info.divisor == 2.0 and views.keys() == seen[0].keys()
    for name, array in views.items():
        np.testing.assert_array_equal(array, seen[0][name])


@pytest.mark.parametrize("frames", [0, CONFIG.frames + 1])
def test_a_path_that_is_no_chunk_is_refused(photos, frames):
    every = make_path("orbit", photos.cameras, CONFIG.frames + 1)
    with pytest.raises(UserError, match=r"sampling\.sample, which goes chunk by chunk"):
        sampling.make_views(photos, every[:frames], CONFIG)
