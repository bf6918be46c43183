"""What training meets on bad days, on the real loss of the tiny model and on a linear one."""

import dataclasses
import functools
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_training import OPTIM as LINEAR
from test_training import SPECS, arrays, assert_same, batch_of, objective, run, start

from roge_jax import model, train
from roge_jax.checkpoint import CHECKSUMS
from roge_jax.config import preset
from roge_jax.core import params, sharding
from roge_jax.core.lora import attach
from roge_jax.core.params import flatten
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import UserError
from roge_jax.training import loop, stages
from roge_jax.training.optim import OptimConfig, make_optimiser

# LoRA over frozen bfloat16 weights, as in the paper's stage: on the reconstruction with its loss, and (slow to compile)
# on both halves with the joint loss. Cross attention as in `mini`, all views in one chunk.

TINY = preset("tiny")
CONFIG = dataclasses.replace(
    TINY, renderer=dataclasses.replace(TINY.renderer, attention="cross", chunk=8)
)
VIEWS = ViewConfig(contexts=(2,), context_weights=(1.0,), targets=CONFIG.frames, ordered=True)
JOINT = dataclasses.replace(stages.lora_stage(100, frames=CONFIG.frames), views=VIEWS)
RECON = dataclasses.replace(JOINT, name="recon", objective="recon", trains="^renderer/rgb_head/")
OPTIM = OptimConfig(learning_rate=1e-3, warmup=1, clip=1.0)
both = pytest.mark.parametrize(
    "stage", [RECON, pytest.param(JOINT, marks=pytest.mark.slow)], ids=lambda stage: stage.objective
)


def sequence(seed=0, frames=12):
    """Posed pictures of noise; the loss needs no meaning."""
    rng = np.random.default_rng(seed)
    c2w = np.tile(np.eye(4), (frames, 1, 1))
    c2w[:, 0, 3] = 0.1 * np.arange(frames)
    K = np.array([[40.0, 0, 24], [0, 40.0, 16], [0, 0, 1]])
    rgb = rng.integers(0, 256, (frames, CONFIG.height, CONFIG.width, 3)).astype(np.uint8)
    return {"rgb": rgb, "K": np.tile(K, (frames, 1, 1)), "c2w": c2w}


def draw(i):
    return stages.stage_batch([sequence()], JOINT, CONFIG, 0, i)


@functools.cache
def prepared(stage):
    """(one jitted optimiser step, a fresh state, frozen weights with their large matrices in bfloat16)."""
    whole = model.init(jax.random.key(0), CONFIG)
    trainable, frozen = model.split(whole, stage.trains)
    specs, _ = model.split(model.specs(CONFIG), stage.trains)
    added = stages.new_leaves(CONFIG, stage)
    if stage.objective == "recon":
        added = {name: added[name] for name in ("encoder", "renderer")}
        frozen = {name: frozen[name] for name in ("encoder", "renderer")}
    trainable = attach(trainable, params.init(jax.random.key(1), added))
    optimiser = make_optimiser(OPTIM, attach(specs, added), 100)
    goal = functools.partial(stages.OBJECTIVES[stage.objective], config=CONFIG, stage=stage)
    made = jax.jit(loop.make_step(goal, optimiser, OPTIM))
    state = loop.initial_state(trainable, optimiser, OPTIM)
    return made, state, train.in_precision(frozen, "bfloat16")


def taken(stage, batch):
    """(state before, state after, metrics) of one step on `batch`."""
    made, state, frozen = prepared(stage)
    return state, *made(state, frozen, batch, jax.random.key(0))


def changed(batch, change):
    return {k: change(v) if k.endswith("_rgb") else v for k, v in batch.items()}


@both
def test_a_plain_step_moves_and_everything_that_trains_is_float32(stage):
    before, after, metrics = taken(stage, draw(0))
    assert np.isfinite(metrics["loss"]) and int(after["skipped"]) == 0
    moved = [
        k for k, x in flatten(after["params"]).items() if np.any(x != flatten(before["params"])[k])
    ]
    assert any("lora_b" in k for k in moved) and any("lora" not in k for k in moved)
    # Masters and moments keep what bfloat16 would lose, though the frozen matrices are bfloat16.
    kept = {x.dtype for x in jax.tree.leaves(after) if jnp.issubdtype(x.dtype, jnp.floating)}
    assert kept == {jnp.dtype("float32")}
    assert any(x.dtype == jnp.bfloat16 for x in jax.tree.leaves(prepared(stage)[2]))


@both
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_one_bad_pixel_skips_the_step_and_changes_nothing(stage, value):
    batch = draw(0)
    batch["context_rgb"] = batch["context_rgb"].copy()
    batch["context_rgb"][0, 0, 3, 5, 1] = value
    before, after, metrics = taken(stage, batch)
    assert not np.isfinite(metrics["loss"]) and int(after["skipped"]) == 1
    for name in ("params", "opt"):
        assert_same(arrays(before[name]), arrays(after[name]))


@both
@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_pictures_of_one_colour_are_no_trouble(stage, level):
    """No variance anywhere: norms and their gradients must not divide by it."""
    _, after, metrics = taken(stage, changed(draw(0), lambda x: np.full_like(x, level)))
    assert np.isfinite(metrics["loss"]) and np.isfinite(metrics["grad_norm"])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after["params"]))
    assert int(after["skipped"]) == 0


@both
def test_a_spike_moves_no_parameter_further_than_any_other_step(stage):
    """Pictures times 1000: the norm before clipping tells, the clipped update is bounded by Adam's own step."""
    before, after, metrics = taken(stage, changed(draw(0), lambda x: 1e3 * x))
    _, _, plain = taken(stage, draw(0))
    assert metrics["loss"] > 1e3 * plain["loss"] and metrics["grad_norm"] > 100 * plain["grad_norm"]
    assert int(after["skipped"]) == 0
    for path, x in flatten(after["params"]).items():
        step_size = np.abs(np.asarray(x) - np.asarray(flatten(before["params"])[path])).max()
        # Adam's first step is at most the rate on every number; decay adds 1 % of the number times the rate.
        decay = 0.01 * np.abs(np.asarray(x)).max()
        assert step_size <= OPTIM.learning_rate * (1.0 + decay) * 1.001 + 1e-7, path


def test_a_pose_that_is_not_finite_is_refused_with_its_place():
    broken = sequence()
    broken["c2w"][:, 0, 3] = np.inf
    with pytest.raises(UserError, match=r"Sequence 0 of the data, frames \d+, .*NaN or infinite"):
        draw_batch([broken], 0, 4, 1, VIEWS, scale_rule="lagernvs")
    draw_batch([sequence()], 0, 4, 1, VIEWS, scale_rule="lagernvs")


# On a linear model: many devices, checkpoints.


def test_a_bad_row_on_one_device_is_skipped_on_all():
    """Sample 5 of 8, on the sixth of eight devices, is NaN: all of them keep the state bit for bit."""
    mesh = sharding.make_mesh(data=8, devices=jax.devices()[:8])
    optimiser = make_optimiser(LINEAR, SPECS, 10)
    state = loop.initial_state(start(), optimiser, LINEAR)
    where = sharding.state_shardings(state, SPECS, mesh), sharding.replicated(mesh)
    made = jax.jit(loop.make_step(objective, optimiser, LINEAR), out_shardings=where)
    batch = batch_of(0)
    batch["x"][5] = np.nan
    from roge_jax.core.distributed import global_batch

    with sharding.use(mesh):
        placed = sharding.place(state, where[0])
        after, metrics = made(placed, {}, global_batch(batch, mesh, 8), jax.random.key(0))
    assert int(after["skipped"]) == 1 and not np.isfinite(metrics["loss"])
    for name in ("params", "opt", "ema"):
        for old, new in zip(
            jax.tree.leaves(state[name]), jax.tree.leaves(after[name]), strict=True
        ):
            assert len(new.addressable_shards) == 8
            if new.sharding.is_fully_replicated:
                for shard in new.addressable_shards:
                    np.testing.assert_array_equal(shard.data, old)


def test_a_damaged_checkpoint_is_named_and_the_one_before_it_continues(tmp_path):
    """One flipped bit in the largest file; deleting what the message names resumes from the checkpoint before."""
    run(tmp_path, 20)
    last = tmp_path / "checkpoints" / "20"
    assert (last / CHECKSUMS).exists()
    victim = max(
        (p for p in (last / "default").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size
    )
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)
    with pytest.raises(
        UserError, match=rf"step 20 .* is damaged: .*{victim.name} .*continue from step 10"
    ):
        run(tmp_path, 25, resume=True)
    shutil.rmtree(last)
    assert int(run(tmp_path, 25, resume=True)["step"]) == 25
    (tmp_path / "checkpoints" / "25" / CHECKSUMS).unlink()  # killed before they were written
    run(tmp_path, 26, resume=True)
