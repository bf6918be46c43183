"""Procedural scenes in a batch, and any sampler over all of them at once: shared by the experiments on the trained model.

Every scene is one path of FRAMES + CONTEXTS views; CONTEXTS of them, evenly spread, are photos, the others targets.
With fewer photos an even choice of the same ones is used, so that curves over M have the same targets, and the noise
of the target slots is the same for every M. Noise comes from (scene, 0) through NumPy: the same for all samplers.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments import harness
from roge_jax import model
from roge_jax.config import RoGeConfig
from roge_jax.data.views import make_sample
from roge_jax.evaluate import spread
from roge_jax.procedural.scenes import sample_sequence
from roge_jax.video import flow, solvers

CONTEXTS, DEFAULT_M = 6, 3
REPEATS = 3  # timed runs of a point, after one that is not timed
ALL_SOLVERS = tuple(name for name, entry in solvers.SOLVERS.items() if entry.method is not None)


class Scenes(NamedTuple):
    """What one model needs of s scenes with m photos each, and what the results are compared with."""

    prepared: model.Prepared  # leading axis s
    noise: jax.Array  # [s, t, lh, lw, 16]
    views: dict[str, np.ndarray]  # model inputs, leading axis s
    truth: np.ndarray  # [s, n, h, w, 3]
    depth: np.ndarray  # [s, n, h, w], z in the units of c2w
    K: np.ndarray  # [s, m + n, 3, 3] pixels, photos first
    c2w: np.ndarray  # [s, m + n, 4, 4] in the scene's frame

    @property
    def m(self) -> int:
        return self.views["context_rgb"].shape[1]


def render(seeds: Sequence[int], config: RoGeConfig) -> list[dict[str, np.ndarray]]:
    """The views of every scene at the model's size (its own rendering, not a resize)."""
    views = config.frames + CONTEXTS
    size = {"height": config.height, "width": config.width}
    return [sample_sequence(int(seed), frames=views, **size) for seed in seeds]


def photos(frames: int, m: int) -> tuple[list[int], list[int]]:
    """(photos, targets): views of a path of frames + CONTEXTS; m of the CONTEXTS candidates, evenly spread."""
    candidates, targets = spread(frames + CONTEXTS, CONTEXTS, frames)
    return [candidates[int((i + 0.5) * CONTEXTS / m)] for i in range(m)], targets


def assemble(
    params: Any, sequences: Sequence[dict[str, np.ndarray]], config: RoGeConfig, m: int = DEFAULT_M
) -> Scenes:
    """Everything of the rendered `sequences` with m photos each."""
    context, target = photos(config.frames, m)
    order = context + target
    samples = [
        make_sample(
            s["rgb"][order].astype(np.float32) / 255.0,
            s["K"][order],
            s["c2w"][order],
            m,
            scale_rule=config.scale_rule,
        )
        for s in sequences
    ]
    views = {name: np.stack([sample[name] for sample in samples]) for name in samples[0]}
    truth = views.pop("target_rgb")
    each = [
        preparer(config)(params, {k: v[i] for k, v in views.items()}) for i in range(len(truth))
    ]
    shape = (*config.latent_size, config.vae.latent)
    slots = config.slots(m) - m
    noise = [
        np.concatenate(
            [
                np.random.default_rng([i, 1]).standard_normal((m, *shape), np.float32),
                np.random.default_rng([i, 0]).standard_normal((slots, *shape), np.float32),
            ]
        )
        for i in range(len(truth))
    ]
    return Scenes(
        jax.tree.map(lambda *x: jnp.stack(x), *each),
        jnp.asarray(np.stack(noise)),
        views,
        truth,
        np.stack([s["depth"][target] for s in sequences]),
        np.stack([s["K"][order] for s in sequences]),
        np.stack([s["c2w"][order] for s in sequences]),
    )


def timed(call: Callable[[], Any], parts: int = 1) -> tuple[Any, dict[str, float]]:
    """(result of a first call, seconds of REPEATS more, each divided by `parts`: {median, fastest, slowest}).

    The first call compiles what is new to it and is not counted.
    """
    result = jax.block_until_ready(call())
    seconds = [harness.timed(call).wall / parts for _ in range(REPEATS)]
    middle = float(np.median(seconds))
    return result, {"median": middle, "fastest": min(seconds), "slowest": max(seconds)}


class Run(NamedTuple):
    latents: jax.Array  # [s, t, lh, lw, 16] of the targets
    evaluations: int
    seconds: dict[str, float] | None = None  # sampling alone, a scene; of a `timed` run


class Sampler:
    """All solvers over one batch of scenes; the network is compiled once, whatever the grid."""

    def __init__(self, params: Any, scenes: Scenes, config: RoGeConfig):
        self.params, self.scenes, self.config = params, scenes, config
        self._velocity = _compiled(config)
        self._seconds: dict[tuple[str, int], dict[str, float]] = {}

    def velocity(self, x: jax.Array, sigma: jax.Array) -> jax.Array:
        """[s, t, lh, lw, 16] of all scenes at one noise level."""
        s = self.scenes
        return self._velocity(self.params, s.prepared, s.noise, x, jnp.asarray(sigma, jnp.float32))

    def grid(self, schedule: str, steps: int, solver: str) -> np.ndarray:
        return flow.schedule(
            schedule, steps, shift=self.config.flow.shift, solver=solver, model=self.config.name
        )

    def run(self, solver: str, grid: np.ndarray, velocity: Any = None) -> Run:
        """One fixed-step sampler, of another `velocity(x, sigma)` than the model's if one is given; not timed."""
        count, end = 0, self.scenes.noise
        for done, _, x in solvers.iterate(solver, velocity or self.velocity, end, grid):
            count, end = done, x
        return Run(end[:, self.scenes.m :], count)

    def timed(self, solver: str, grid: np.ndarray, start: Callable[[], Any] | None = None) -> Run:
        """`run` with its seconds; `start()` makes the velocity of a run if it is another than the model's.

        The numbers in a grid do not change the work: grids of one length are timed once.
        """
        if start is not None:
            run, seconds = timed(lambda: self.run(solver, grid, start()), len(self.scenes.noise))
            return run._replace(seconds=seconds)
        known = (solver, len(grid))
        if known in self._seconds:
            return self.run(solver, grid)._replace(seconds=self._seconds[known])
        run, self._seconds[known] = timed(lambda: self.run(solver, grid), len(self.scenes.noise))
        return run._replace(seconds=self._seconds[known])

    def adaptive(self, tolerance: float) -> Run:
        """bosh3, timed; the batch shares its steps."""
        if not hasattr(self, "_adaptive"):

            @jax.jit
            def whole(params, prepared, noise, tolerance):
                def velocity(x, sigma):
                    return _field(params, prepared, noise, x, sigma, config=self.config)

                ends = np.array([1.0, 0.95, 1e-2, 0.0])
                return solvers.solve("bosh3", velocity, noise, ends, tolerance=tolerance)

            self._adaptive = whole
        s = self.scenes
        arguments = (self.params, s.prepared, s.noise, jnp.float32(tolerance))
        (x, info), seconds = timed(lambda: self._adaptive(*arguments), len(s.noise))
        solvers.raise_if_failed(info)
        return Run(x[:, s.m :], int(info.evaluations), seconds)


def _field(params, prepared, noise, x, sigma, *, config):
    def one(prepared, noise, x):
        field, project = model.sampling_field(params, prepared, noise, config=config)
        return field(project(x, sigma), sigma)

    return jax.vmap(one)(prepared, noise, x)


@functools.cache
def preparer(config: RoGeConfig):
    """`model.prepare` of one scene, jitted once a config."""
    return jax.jit(functools.partial(model.prepare, config=config))


@functools.cache
def _compiled(config: RoGeConfig):
    """One jitted function a config: batches of equal shape share a compilation."""
    return jax.jit(functools.partial(_field, config=config))


def most_steps(solver: str, budget: int) -> int:
    """The most steps within a budget of evaluations, 0 if none."""
    return max((n for n in range(1, budget + 1) if solvers.nfe(solver, n) <= budget), default=0)
