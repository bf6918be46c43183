"""Runs of the training program that tests share: `tiny` made quick to compile, cheap objectives, a pool of noise.

The fixtures `common` and `cheap` are made of these in conftest.py.
"""

import contextlib
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_sharding import small

from roge_jax import config, train
from roge_jax.core.params import flatten
from roge_jax.training import loop, stages


def run(*arguments) -> None:
    train.main(train.parser().parse_args([str(a) for a in arguments]))


def losses(folder) -> list[float]:
    return [json.loads(line)["loss"] for line in (folder / "log.jsonl").read_text().splitlines()]


@contextlib.contextmanager
def quick_tiny():
    """Options of a short run, made quick to compile: `tiny` with a smaller VAE, two contexts in every batch."""
    smaller, lora_stage = small(), stages.lora_stage

    def two_contexts(*arguments, **options):
        stage = lora_stage(*arguments, **options)
        views = dataclasses.replace(stage.views, contexts=(2,), context_weights=(1.0,))
        return dataclasses.replace(stage, views=views)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(config.PRESETS, "tiny", lambda: smaller)
        patch.setattr(stages, "lora_stage", two_contexts)
        yield ["tiny", "--devices", 1, "--log-every", 1, "--save-every", 1]


def make_cheap(monkeypatch) -> None:
    """Objectives that move every leaf by what the batch shows, plain steps, no measuring: quick to compile, and the
    program, the loop and the checkpoints around them are real.
    """

    def objective(trainable, frozen, batch, key, *, config, stage):
        level = batch["target_rgb"].mean() + 0.1 * jax.random.uniform(key)
        loss = sum(jnp.square(x - level).sum() for x in jax.tree.leaves(trainable))
        return loss, {"flow": loss}

    monkeypatch.setattr(loop, "make_optimiser", lambda optim, specs, steps: optax.sgd(1e-3))
    for name in stages.OBJECTIVES:
        monkeypatch.setitem(stages.OBJECTIVES, name, objective)
    monkeypatch.setattr(stages, "measure_latents", lambda params, source, cfg, seed: cfg)
    monkeypatch.setattr(stages, "measure_features", lambda params, source, cfg, seed: (params, cfg))


def write_dataset(folder, size, seed=0, frames=12):
    """Two sequences of noise [frames, height, width] that move sideways."""
    rng, (height, width) = np.random.default_rng(seed), size
    folder.mkdir(parents=True)
    rgb = rng.integers(0, 256, (2, frames, height, width, 3), np.uint8)
    np.save(folder / "shard_00000.rgb.npy", rgb)
    c2w = np.tile(np.eye(4), (2, frames, 1, 1))
    c2w[..., 0, 3] = 0.1 * np.arange(frames)
    K = np.tile([[height, 0, width / 2], [0, height, height / 2], [0, 0, 1.0]], (2, frames, 1, 1))
    np.savez(folder / "shard_00000.npz", seeds=np.arange(2), K=K, c2w=c2w)
    return folder


def same(a, b, prefix="") -> bool:
    """Whether two models have the same leaves, bit for bit; of those whose path starts with `prefix`."""
    a, b = ({p: x for p, x in flatten(t).items() if p.startswith(prefix)} for t in (a, b))
    assert a.keys() == b.keys() and a
    return all(np.array_equal(a[path], b[path]) for path in a)
