"""What training meets on bad days, on the real loss of the tiny model and on a linear one."""

import dataclasses
import functools
import os
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_training import OPTIM as LINEAR
from test_training import SPECS, arrays, assert_same, batch_of, log_of, objective, run, start

from roge_jax import checkpoint, model
from roge_jax.checkpoint import CHECKSUMS
from roge_jax.config import preset
from roge_jax.core import params, sharding
from roge_jax.core.lora import attach
from roge_jax.core.params import flatten
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import UserError
from roge_jax.files.folders import keep_settings, output_folder
from roge_jax.training import diagnose, loop, stages
from roge_jax.training.optim import OptimConfig, make_optimiser
from roge_jax.training.start import place_frozen

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
    return made, state, place_frozen(frozen, "bfloat16")


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


def test_frozen_bfloat16_weights_train_as_float32_ones_do():
    """The same four steps: the losses agree to bfloat16's rounding, and the frozen ones differ in nothing else."""
    made, state, frozen = prepared(RECON)
    whole = model.split(model.init(jax.random.key(0), CONFIG), RECON.trains)[1]
    exact = {name: whole[name] for name in frozen}
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (frozen, exact)), strict=True))
    losses = {}
    for name, weights in (("bfloat16", frozen), ("float32", exact)):
        now, losses[name] = state, []
        for i in range(4):
            now, metrics = made(now, weights, draw(i), jax.random.key(i))
            losses[name].append(float(metrics["loss"]))
        assert int(now["skipped"]) == 0
    assert losses["bfloat16"] != losses["float32"]
    np.testing.assert_allclose(losses["bfloat16"], losses["float32"], rtol=0.01)


def test_a_pose_that_is_not_finite_is_refused_with_its_place():
    broken = sequence()
    broken["c2w"][:, 0, 3] = np.inf
    with pytest.raises(UserError, match=r"Sequence 0 of the data, frames \d+, .*NaN or infinite"):
        draw_batch([broken], 0, 4, 1, VIEWS, scale_rule="lagernvs")
    draw_batch([sequence()], 0, 4, 1, VIEWS, scale_rule="lagernvs")


# On a linear model: a wrong lambda, bfloat16, many devices, checkpoints.


def two_terms(trainable, frozen, batch, key, *, config, **options):
    """A `model.loss` of linear maps: the halves share the first, and the terms want different things of it."""
    shared, own = trainable["encoder"]["kernel"], trainable["dit"]["kernel"]
    seen = batch["x"] @ shared
    flow = jnp.square(seen @ own - batch["y"]).mean()
    photometric = jnp.square(seen - batch["z"]).mean()
    return flow + config.flow.photometric * photometric, {"flow": flow, "photometric": photometric}


def run_two_terms(out, monkeypatch, weight, steps=40):
    """(log, diagnosis of the first weights) of the real loop on `two_terms`, with lambda times `weight`."""
    monkeypatch.setattr(model, "loss", two_terms)
    monkeypatch.setattr(diagnose, "flow_by_sigma", lambda p, b, k, sigmas, **_: jnp.asarray(sigmas))
    flow = dataclasses.replace(TINY.flow, photometric=weight * TINY.flow.photometric)
    config = dataclasses.replace(TINY, flow=flow)
    specs = {
        "encoder": {"kernel": params.Spec((3, 3), ("embed", "mlp"))},
        "dit": {"kernel": params.Spec((3, 2), ("embed", "mlp"))},
    }
    turned = np.random.default_rng(2).standard_normal((3, 3)).astype(np.float32)

    def batches(i):
        batch = batch_of(i)
        return batch | {"z": batch["x"] @ turned}

    first, look = params.init(jax.random.key(0), specs), diagnose.joint_diagnose(config, bins=2)
    found = look(first, {}, batches(0), jax.random.key(0))
    state = loop.train(
        functools.partial(stages.joint_objective, config=config, stage=JOINT),
        first,
        {},
        specs,
        batches,
        optim=LINEAR,
        loop=loop.LoopConfig(steps=steps, log_every=1),
        out=out,
        diagnose=look,
        diagnose_every=1,
    )
    assert int(state["skipped"]) == 0
    return log_of(out), found


def test_a_wrong_lambda_is_survived_and_the_diagnosis_tells_which_term_rules(tmp_path, monkeypatch):
    """Photometric weight times 100: nothing is skipped or stops; norms and cosine in the log say what went wrong."""
    right, first = run_two_terms(tmp_path / "right", monkeypatch, 1.0)
    wrong, other = run_two_terms(tmp_path / "wrong", monkeypatch, 100.0)
    for rows in (right, wrong):
        assert len(rows) == 40
        assert all(np.isfinite(value) for row in rows for value in row.values())
        assert all(-1 <= row["grad_cosine"] <= 1 for row in rows)
    assert other["flow_grad_norm"] == pytest.approx(first["flow_grad_norm"], rel=1e-5)
    assert other["grad_cosine"] == pytest.approx(first["grad_cosine"], abs=1e-5)
    assert other["photometric_grad_norm"] == pytest.approx(
        100 * first["photometric_grad_norm"], rel=1e-4
    )
    share = [
        np.median([row["photometric_grad_norm"] / row["flow_grad_norm"] for row in rows])
        for rows in (right, wrong)
    ]
    assert share[0] < 1 < 5 < share[1]  # which term rules
    assert wrong[-1]["photometric"] < right[-1]["photometric"]  # it got what it pulled for


def test_a_run_with_everything_in_bfloat16_goes_on_and_is_resumed(tmp_path, monkeypatch):
    """Weights, moments, averages and batches: the loop asks for no dtype and changes none."""
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), start())
    monkeypatch.setitem(run.__globals__, "start", lambda: half)

    def batches(i):
        return {k: jnp.asarray(v, jnp.bfloat16) for k, v in batch_of(i).items()}

    state = run(tmp_path / "whole", 40, batches=batches)
    dtypes = {x.dtype for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)}
    assert dtypes == {jnp.dtype("bfloat16")} and int(state["skipped"]) == 0
    rows = log_of(tmp_path / "whole")
    losses = [row["loss"] for row in rows]
    assert np.all(np.isfinite(losses)) and np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])
    run(tmp_path / "parts", 20, batches=batches)
    run(tmp_path / "parts", 40, batches=batches, resume=True)
    assert log_of(tmp_path / "parts") == rows


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


def flip(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


@pytest.mark.parametrize("damage", [flip, Path.unlink], ids=["one flipped bit", "one lost file"])
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_continues(tmp_path, damage):
    """The largest file; deleting what the message names resumes from the checkpoint before."""
    run(tmp_path, 20)
    last = tmp_path / "checkpoints" / "20"
    assert (last / CHECKSUMS).exists()
    victim = max(
        (p for p in (last / "default").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size
    )
    damage(victim)
    with pytest.raises(
        UserError, match=rf"step 20 .* is damaged: .*{victim.name} .*continue from step 10"
    ):
        run(tmp_path, 25, resume=True)
    shutil.rmtree(last)
    assert int(run(tmp_path, 25, resume=True)["step"]) == 25
    (tmp_path / "checkpoints" / "25" / CHECKSUMS).write_text("{")  # cut off on its way
    with pytest.raises(UserError, match=rf"step 25 .* is damaged: {CHECKSUMS} is not what"):
        run(tmp_path, 26, resume=True)
    (tmp_path / "checkpoints" / "25" / CHECKSUMS).unlink()  # killed before they were written
    run(tmp_path, 26, resume=True)


# What is renamed into place is on the disk first.


@pytest.fixture
def order(monkeypatch):
    """[("sync", path) or ("name", from, to), ..] in the order in which the system was asked."""
    done, sync = [], os.fsync

    def fsync(handle):
        done.append(("sync", Path(f"/proc/self/fd/{handle}").resolve()))
        return sync(handle)

    def naming(rename):
        def named(old, new, **more):
            done.append(("name", Path(old).resolve(), Path(new).resolve()))
            return rename(old, new, **more)

        return named

    monkeypatch.setattr(os, "fsync", fsync)
    for name in ("rename", "replace"):
        monkeypatch.setattr(os, name, naming(getattr(os, name)))
    return done


def check_order(order, final, contents):
    """Files and folder were synced under the temporary name, then renamed, then the folder that holds the name."""
    at, old = next(
        (i, e[1]) for i, e in enumerate(order) if e[0] == "name" and e[-1] == final.resolve()
    )
    before = {e[1] for e in order[:at] if e[0] == "sync"}
    assert before >= {old} | {old / name for name in contents}
    assert ("sync", final.parent.resolve()) in order[at + 1 :]


def test_models_adapters_and_settings_are_on_the_disk_before_they_have_their_names(tmp_path, order):
    weights = model.init(jax.random.key(0), TINY)
    checkpoint.save_model(tmp_path / "model", weights, TINY)
    check_order(order, tmp_path / "model", [p.name for p in (tmp_path / "model").iterdir()])
    order.clear()
    checkpoint.save_model(tmp_path / "model", weights, TINY)  # in place of another
    check_order(order, tmp_path / "model", [p.name for p in (tmp_path / "model").iterdir()])
    assert {p.name for p in tmp_path.iterdir()} == {"model"}
    trained = model.split(weights, JOINT.trains)[0]
    checkpoint.save_adapter(tmp_path / "adapter", trained, TINY)
    check_order(order, tmp_path / "adapter", [p.name for p in (tmp_path / "adapter").iterdir()])
    keep_settings(tmp_path / "run", {"seed": 1}, begun=False, resume=False)
    check_order(order, tmp_path / "run/settings.json", [])
    with output_folder(tmp_path / "out") as part:
        (part / "frames").mkdir()
        (part / "frames/0.png").write_bytes(b"picture")
    check_order(order, tmp_path / "out", ["frames", "frames/0.png"])


def test_a_checkpoint_is_on_the_disk_before_its_checksums_and_a_cut_log_before_its_name(
    tmp_path, order
):
    run(tmp_path, 10)
    last = tmp_path / "checkpoints/10"
    check_order(order, last / CHECKSUMS, [])
    at = next(i for i, e in enumerate(order) if e[-1] == (last / CHECKSUMS).resolve())
    synced = {e[1] for e in order[:at] if e[0] == "sync"}
    files = {p.resolve() for p in last.rglob("*") if p.name != CHECKSUMS}
    assert len(files) > 3 and files <= synced
    order.clear()
    run(tmp_path, 20, resume=True)
    check_order(order, tmp_path / "log.jsonl", [])
