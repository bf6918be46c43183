"""The training loop on a linear model: what must hold for a long run to be trusted, one test for each."""

import dataclasses
import functools
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from roge_jax import model
from roge_jax.config import preset
from roge_jax.core import params, sharding
from roge_jax.core.layers import linear, linear_specs
from roge_jax.core.params import flatten
from roge_jax.errors import UserError
from roge_jax.training import loop as training
from roge_jax.training import stages
from roge_jax.training.loop import DivergenceDetector, LoopConfig, TrainingStopped
from roge_jax.training.optim import (
    OptimConfig,
    adam_shares,
    ema_update,
    learning_rate,
    make_optimiser,
    muon_dimensions,
)

SPECS = {"layer": linear_specs(3, 2)}
OPTIM = OptimConfig(learning_rate=1e-2, warmup=2, ema=0.9)
TRUTH = np.random.default_rng(0).standard_normal((3, 2)).astype(np.float32)


def objective(trainable, frozen, batch, key):
    """Noisy least squares; `bad` makes the loss, or only its gradient, not finite; `level` is added to the loss."""
    y = linear(trainable["layer"], batch["x"]) + 0.1 * jax.random.normal(key, batch["y"].shape)
    loss = jnp.square(y - batch["y"]).mean() + batch["level"][0]
    flat = jnp.sum(jnp.square(trainable["layer"]["kernel"]))
    loss = loss + jnp.where(batch["bad"][0] == 1, jnp.nan, 0.0)
    loss = (
        loss + jnp.sqrt(jnp.where(batch["bad"][0] == 2, 0.0, 1.0) * flat) * 0
    )  # 0 * d sqrt(0) is nan
    return loss, {"error": jnp.abs(y - batch["y"]).mean()}


def batch_of(i, bad=(), kind=1, level=lambda i: 0.0):
    x = np.random.default_rng([1, i]).standard_normal((8, 3)).astype(np.float32)
    return {
        "x": x,
        "y": x @ TRUTH,
        "bad": np.full(8, kind if i in bad else 0),
        "level": np.full(8, level(i), np.float32),
    }


def start(seed=0):
    return params.init(jax.random.key(seed), SPECS)


def run(out, steps, *, batches=batch_of, optim=OPTIM, resume=False, **more):
    settings = {"log_every": 1, "save_every": 10} | {
        k: more.pop(k) for k in list(more) if k in LoopConfig.__dataclass_fields__
    }
    return training.train(
        objective,
        start(),
        {},
        SPECS,
        batches,
        optim=optim,
        loop=LoopConfig(steps=steps, **settings),
        out=Path(out),
        resume=resume,
        **more,
    )


def log_of(out, without=("steps_per_s", "waiting")):
    rows = [json.loads(line) for line in (Path(out) / "log.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if k not in without} for row in rows]


def assert_same(a, b):
    a, b = flatten(a), flatten(b)
    assert a.keys() == b.keys()
    for path in a:
        np.testing.assert_array_equal(np.asarray(a[path]), np.asarray(b[path]), err_msg=path)


def arrays(state):
    """A state as nested dicts of arrays (the optimiser's part is a tree of tuples)."""
    return {str(i): x for i, x in enumerate(jax.tree.leaves(state))}


# It trains.


def test_the_loss_falls_to_the_noise(tmp_path):
    optim = dataclasses.replace(OPTIM, learning_rate=5e-2)
    run(tmp_path, 200, optim=optim, log_every=20, save_every=200)
    losses = [row["loss"] for row in log_of(tmp_path)]
    assert losses[0] > 0.1 and 0.005 < losses[-1] < 0.015  # the noise alone is 0.01


def test_many_steps_are_traced_once(tmp_path):
    traces = itertools.count()

    def counted(*args):
        next(traces)
        return objective(*args)

    loop = LoopConfig(steps=12, log_every=5, save_every=100)
    training.train(counted, start(), {}, SPECS, batch_of, optim=OPTIM, loop=loop, out=tmp_path)
    assert next(traces) == 1


def test_eight_devices_equal_one(tmp_path):
    mesh = sharding.make_mesh(data=8, devices=jax.devices()[:8])
    one, eight = run(tmp_path / "1", 10), run(tmp_path / "8", 10, mesh=mesh)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(eight), strict=True):
        # Another order of the mean over 8 samples.
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


def test_a_run_may_be_resumed_on_another_number_of_devices(tmp_path):
    one, many = (run(tmp_path / name, 10) for name in ("one", "many"))
    mesh = sharding.make_mesh(data=8, devices=jax.devices()[:8])
    one = run(tmp_path / "one", 20, resume=True)
    many = run(tmp_path / "many", 20, resume=True, mesh=mesh)
    assert len(many["params"]["layer"]["kernel"].sharding.device_set) == 8
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


def test_state_and_frozen_weights_lie_in_shares_while_they_train(tmp_path):
    """As the table says, in every step and at the end; results alone would not show copies on every device."""
    specs = {"layer": linear_specs(16, 2)}
    frozen_specs = {"base": linear_specs(32, 4, bias=False)}
    mesh, seen = sharding.make_mesh(2, 4, devices=jax.devices()[:8]), []

    def linear_objective(trainable, frozen, batch, key):
        kernel = trainable["layer"]["kernel"]
        return jnp.square(batch["x"] @ kernel[:3] - batch["y"]).mean(), {
            "base": frozen["base"]["kernel"].sum()
        }

    def look(trainable, frozen, batch, key):
        leaves = trainable["layer"]["kernel"], frozen["base"]["kernel"], batch["x"]
        seen.append([leaf.sharding.shard_shape(leaf.shape) for leaf in leaves])
        return {}

    state = training.train(
        linear_objective,
        params.init(jax.random.key(0), specs),
        params.init(jax.random.key(1), frozen_specs),
        specs,
        batch_of,
        optim=OPTIM,
        loop=LoopConfig(steps=2, log_every=1),
        out=tmp_path,
        mesh=mesh,
        frozen_specs=frozen_specs,
        diagnose=look,
        diagnose_every=1,
    )
    assert seen == 2 * [[(4, 2), (8, 4), (1, 3)]]
    kernels = [x for x in jax.tree.leaves(state) if x.shape == (16, 2)]
    assert len(kernels) == 4, "parameters, their average and two moments"
    assert {x.sharding.shard_shape(x.shape) for x in kernels} == {(4, 2)}


# Steps that are not finite.


@pytest.mark.parametrize("kind", [1, 2])  # the loss, its gradient alone
def test_a_step_that_is_not_finite_changes_nothing_and_is_counted(kind):
    optimiser = make_optimiser(OPTIM, SPECS, 10)
    step = jax.jit(training.make_step(objective, optimiser, OPTIM))
    key = jax.random.key(0)
    good, _ = step(training.initial_state(start(), optimiser, OPTIM), {}, batch_of(0), key)
    bad, metrics = step(good, {}, batch_of(1, bad=(1,), kind=kind), key)
    finite = [bool(jnp.isfinite(metrics[name])) for name in ("loss", "grad_norm")]
    assert finite == [kind == 2, kind == 1]  # each alone is enough
    for name in ("params", "opt", "ema"):
        assert_same(arrays(good[name]), arrays(bad[name]))
    assert [int(bad[name]) for name in ("step", "skipped", "streak")] == [2, 1, 1]
    after, _ = step(bad, {}, batch_of(2), key)
    assert [int(after[name]) for name in ("step", "skipped", "streak")] == [3, 1, 0]
    assert np.any(
        np.asarray(after["params"]["layer"]["kernel"])
        != np.asarray(bad["params"]["layer"]["kernel"])
    )


def test_a_skipped_step_keeps_its_place_in_the_data_and_not_in_the_schedule():
    """The steps after it see the batches and noise they would have seen, at the rate of the applied updates."""
    optimiser = make_optimiser(OPTIM, SPECS, 10)
    step = jax.jit(training.make_step(objective, optimiser, OPTIM))
    states = []
    for order in ((0, 1, 2), (0, 2)):
        state = training.initial_state(start(), optimiser, dataclasses.replace(OPTIM, ema=0.0))
        for i in order:
            state, _ = step(
                state | {"ema": state["params"]}, {}, batch_of(i, bad=(1,)), jax.random.key(i)
            )
        states.append(state)
    for name in ("params", "opt"):
        assert_same(arrays(states[0][name]), arrays(states[1][name]))


def test_a_streak_of_bad_steps_stops_the_run(tmp_path):
    with pytest.raises(
        TrainingStopped, match=r"step 17: 4 steps in a row .* checkpoint is step 10 "
    ):
        run(tmp_path, 50, batches=functools.partial(batch_of, bad=range(13, 99)), max_streak=4)
    last = log_of(tmp_path)[-1]
    assert [last[k] for k in ("step", "loss", "skipped", "streak")] == [17, None, 4, 4]


def test_more_than_one_percent_of_bad_steps_stops_the_run(tmp_path):
    with pytest.raises(TrainingStopped, match="2 of 100 steps"):
        run(
            tmp_path / "two", 120, batches=functools.partial(batch_of, bad=(20, 60)), save_every=200
        )
    state = run(
        tmp_path / "one", 120, batches=functools.partial(batch_of, bad=(20,)), save_every=200
    )
    assert int(state["skipped"]) == 1


# Clipping.


def test_the_norm_before_clipping_is_logged(tmp_path):
    run(tmp_path, 1, optim=dataclasses.replace(OPTIM, clip=1e-3))
    key = jax.random.fold_in(jax.random.key(0), 0)
    grads = jax.grad(objective, has_aux=True)(start(), {}, batch_of(0), key)[0]
    norm = np.sqrt(sum(float(jnp.sum(jnp.square(g))) for g in flatten(grads).values()))
    assert norm > 0.1
    assert log_of(tmp_path)[0]["grad_norm"] == pytest.approx(norm, rel=1e-5)


@pytest.mark.parametrize("clip", [1.0, 0.0])
def test_gradients_beyond_the_clip_act_alike(clip):
    """Adam's own normalisation hides one scaled gradient; the ratio to the next gradient shows it."""
    optimiser = make_optimiser(dataclasses.replace(OPTIM, clip=clip), SPECS, 100)
    p = start()

    @jax.jit
    def second_update(scale):
        state = optimiser.init(p)
        _, state = optimiser.update(jax.tree.map(lambda x: scale * jnp.ones_like(x), p), state, p)
        return optimiser.update(jax.tree.map(lambda x: 0.01 * jnp.ones_like(x), p), state, p)[0]

    one, other = (second_update(scale)["layer"]["bias"] for scale in (10.0, 1000.0))
    same = np.allclose(one, other, rtol=1e-4, atol=0)
    assert same == (clip > 0)


# Divergence.


def feed(detector, losses):
    """The number of the update at which the detector speaks, or None."""
    return next((i for i, loss in enumerate(losses) if detector.update(loss)), None)


def noisy(n, level=1.0, seed=0):
    return level + 0.2 * np.random.default_rng(seed).standard_normal(n)


def test_noise_spikes_and_slow_improvement_are_no_divergence():
    spikes = noisy(3000)
    spikes[::100] += 5.0
    for losses in (noisy(3000), spikes, noisy(3000) + np.linspace(2, 0, 3000)):
        assert feed(DivergenceDetector(200), losses) is None


@pytest.mark.parametrize("patience", [50, 200])
def test_a_loss_that_leaves_its_best_level_for_good_is_divergence(patience):
    losses = np.concatenate([noisy(1000), noisy(1000, level=4.0, seed=1)])
    found = feed(DivergenceDetector(patience), losses)
    assert 1000 + patience <= found < 1000 + patience + 100  # the average needs some steps to leave


def test_a_skipped_loss_does_not_move_the_detector():
    detector = DivergenceDetector(10)
    feed(detector, noisy(100))
    before = vars(detector).copy()
    assert not detector.update(float("nan")) and vars(detector) == before


def test_a_diverging_run_stops_and_keeps_its_good_checkpoints(tmp_path):
    def level(i):
        return 0.0 if i < 150 else 50.0

    with pytest.raises(
        TrainingStopped, match=r"far above its best level .* for 30 steps\. .* is step 150 "
    ):
        run(tmp_path, 300, batches=functools.partial(batch_of, level=level), patience=30, keep=2)
    assert sorted(int(p.name) for p in (tmp_path / "checkpoints").iterdir()) == [140, 150]


def test_an_evaluation_that_is_not_finite_stops_the_run(tmp_path):
    def evaluate(p):
        return {"held_loss": float("nan") if next(calls) == 2 else 1.0}

    calls = itertools.count()
    with pytest.raises(TrainingStopped, match="step 20: the evaluation gave held_loss = nan"):
        run(tmp_path, 30, evaluate=evaluate, evaluate_every=10)
    rows = log_of(tmp_path)
    found = {row["step"]: row["held_loss"] for row in rows if "held_loss" in row}
    assert found == {0: 1.0, 10: 1.0, 20: None}  # before the first step, too
    assert sorted(int(p.name) for p in (tmp_path / "checkpoints").iterdir()) == [10]


@pytest.mark.parametrize("ema", [0.9, 0.0])
def test_what_is_evaluated_is_what_is_saved(tmp_path, ema):
    """The average where there is one, as the model that comes out of the run."""
    seen = []

    def evaluate(p):
        seen.append(jax.tree.map(np.array, p))
        return {"held_loss": 1.0}

    optim = dataclasses.replace(OPTIM, ema=ema)
    state = run(tmp_path, 20, optim=optim, evaluate=evaluate, evaluate_every=10)
    assert len(seen) == 3
    assert_same(seen[-1], state["ema" if ema else "params"])
    assert np.any(
        seen[-1]["layer"]["kernel"] != np.asarray(state["params"]["layer"]["kernel"])
    ) == bool(ema)


def test_the_held_out_loss_is_told_from_the_first_to_the_last(tmp_path):
    rows = [{"step": 0, "held_loss": 2.0}, {"step": 5, "loss": 9.0}, {"step": 10, "held_loss": 1.5}]
    rows += [{"step": 20, "held_loss": 1.25}, {"step": 30, "held_loss": None}]
    log = tmp_path / "log.jsonl"
    log.write_text("".join(json.dumps(row) + "\n" for row in rows))
    told = "; held-out loss 2 at step 0, 1.25 at step 20"
    assert training.held_out_change(log) == told
    log.write_text(json.dumps(rows[0]) + "\n")
    assert training.held_out_change(log) == ""


# Checkpoints and resuming.


class PowerCut(Exception):
    pass


def cut_at(step):
    def batches(i):
        if i == step:
            raise PowerCut
        return batch_of(i)

    return batches


@pytest.mark.parametrize(
    "optim",
    [
        dataclasses.replace(OPTIM, accumulate=2, decay=0.5),
        dataclasses.replace(OPTIM, name="muon", decay=0.5),
    ],
    ids=["adamw-accumulated", "muon"],
)
def test_a_resumed_run_continues_bit_for_bit(tmp_path, optim):
    """Losses, gradient norms and counters of every step, then parameters, optimiser and averages."""
    bad = functools.partial(batch_of, bad=(4,))
    whole = run(tmp_path / "whole", 30, batches=bad, optim=optim)

    def until(i):
        return cut_at(25)(i) if i == 25 else bad(i)

    with pytest.raises(PowerCut):
        run(tmp_path / "cut", 30, batches=until, optim=optim)
    assert (
        log_of(tmp_path / "cut")[-1]["step"] > 20
    )  # five more steps than the checkpoint, to be done again
    resumed = run(tmp_path / "cut", 30, batches=bad, optim=optim, resume=True)
    assert log_of(tmp_path / "cut") == log_of(tmp_path / "whole")
    assert [row["step"] for row in log_of(tmp_path / "cut")] == list(range(1, 31))
    assert_same(arrays(resumed), arrays(whole))
    assert int(resumed["skipped"]) == 1


def test_a_resumed_run_lowers_to_the_same_program(tmp_path, monkeypatch):
    """So that the compilation cache knows it, and going on starts at once."""
    jit, programs = jax.jit, []

    def reading(f, **options):
        step = jit(f, **options)

        def call(*args):
            programs.append(step.lower(*args).as_text())
            return step(*args)

        return call

    monkeypatch.setattr(jax, "jit", reading)
    with pytest.raises(PowerCut):
        run(tmp_path, 3, batches=cut_at(2), save_every=1)
    run(tmp_path, 3, save_every=1, resume=True)
    assert len(programs) == 3 and len(set(programs)) == 1


def test_log_lines_of_a_resumed_run_average_the_same_steps(tmp_path):
    """Also when checkpoints and log lines do not coincide."""
    settings = {"log_every": 4, "save_every": 5}
    run(tmp_path / "whole", 14, **settings)
    with pytest.raises(PowerCut):
        run(tmp_path / "cut", 14, batches=cut_at(12), **settings)
    run(tmp_path / "cut", 14, resume=True, **settings)
    assert log_of(tmp_path / "cut") == log_of(tmp_path / "whole")


def test_the_last_k_checkpoints_are_kept(tmp_path):
    run(tmp_path, 30, save_every=5, keep=2)
    assert sorted(int(p.name) for p in (tmp_path / "checkpoints").iterdir()) == [25, 30]


def test_resuming_a_finished_run_changes_nothing(tmp_path):
    first = run(tmp_path, 10)
    log = (tmp_path / "log.jsonl").read_text()
    assert_same(arrays(run(tmp_path, 10, resume=True)), arrays(first))
    assert (tmp_path / "log.jsonl").read_text() == log


def test_resume_without_a_checkpoint_starts(tmp_path):
    with pytest.raises(PowerCut):
        run(tmp_path, 10, batches=cut_at(5))
    assert int(run(tmp_path, 10, resume=True)["step"]) == 10
    assert len(log_of(tmp_path)) == 10


def test_a_new_run_does_not_overwrite_another(tmp_path):
    run(tmp_path, 10)
    with pytest.raises(UserError, match=r"holds a run at step 10: continue it with --resume"):
        run(tmp_path, 10)


@pytest.mark.parametrize("d_in", [4, 3])
def test_a_checkpoint_of_another_model_is_named(tmp_path, d_in):
    run(tmp_path, 10)
    specs = {"layer": linear_specs(d_in, 2)} | ({"more": linear_specs(2, 2)} if d_in == 3 else {})
    with pytest.raises(UserError) as caught:
        training.train(
            objective,
            params.init(jax.random.key(0), specs),
            {},
            specs,
            batch_of,
            optim=OPTIM,
            loop=LoopConfig(steps=20),
            out=tmp_path,
            resume=True,
        )
    assert str(tmp_path) in str(caught.value) and "another model or stage" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_log_line_cut_off_while_being_written_is_dropped(tmp_path):
    with pytest.raises(PowerCut):
        run(tmp_path, 20, batches=cut_at(13))
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"loss": 0.1, "st')
    run(tmp_path, 20, resume=True)
    assert [row["step"] for row in log_of(tmp_path)] == list(range(1, 21))


KILLED_STEPS = 60


def train_slowly(out):
    """What the killed processes run: a checkpoint every other step, so that most moments are inside one."""

    def batches(i):
        time.sleep(0.02)
        return batch_of(i)

    run(out, KILLED_STEPS, batches=batches, save_every=2, resume=True)


def kill_soon_after_a_checkpoint(out, rng):
    """Start training in another process and kill -9 it at a random moment after it has saved something new."""
    folder = Path(out) / "checkpoints"

    def saved():
        return {int(p.name) for p in folder.glob("*") if p.name.isdigit()}

    before = max(saved(), default=0)
    code = f"import test_training; test_training.train_slowly({str(out)!r})"
    with subprocess.Popen(
        [sys.executable, "-c", "import conftest; " + code],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stderr=subprocess.PIPE,
    ) as process:
        deadline = time.monotonic() + 300
        while max(saved(), default=0) <= before and process.poll() is None:
            assert time.monotonic() < deadline, "no checkpoint was written in five minutes"
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.5))
        process.send_signal(signal.SIGKILL)
        _, error = process.communicate()
    assert process.returncode in (-signal.SIGKILL, 0), error.decode()[-2000:]
    return max(saved())


@pytest.mark.parametrize("kills", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_kill_9_loses_at_most_the_steps_since_the_last_checkpoint(tmp_path, kills):
    rng = random.Random(time.time_ns())
    reached = [kill_soon_after_a_checkpoint(tmp_path / "killed", rng) for _ in range(kills)]
    assert reached == sorted(reached)
    final = run(tmp_path / "killed", KILLED_STEPS, save_every=2, resume=True)
    whole = run(tmp_path / "whole", KILLED_STEPS, save_every=100)
    assert_same(arrays(final), arrays(whole))
    assert log_of(tmp_path / "killed") == log_of(tmp_path / "whole")
    names = sorted(p.name for p in (tmp_path / "killed" / "checkpoints").iterdir())
    assert names == ["56", "58", "60"]  # and no temporary folders are left


# Batches prepared ahead.


def test_prefetched_batches_come_in_order_and_errors_come_through():
    assert list(training.prefetched(lambda i: {"i": i}, 3, 9)) == [{"i": i} for i in range(3, 9)]
    source = training.prefetched(cut_at(2), 0, 9)
    assert len([next(source), next(source)]) == 2
    with pytest.raises(PowerCut):
        next(source)


def test_leaving_early_ends_the_thread():
    threads = threading.active_count()
    source = training.prefetched(batch_of, 0, 10**9)
    next(source)
    assert threading.active_count() == threads + 1
    source.close()
    assert threading.active_count() == threads


# Optimisers.


def test_the_learning_rate_warms_up_stays_and_falls():
    rate = learning_rate(OptimConfig(learning_rate=1.0, warmup=10, decay=0.5, floor=0.03), 100)
    got = [float(rate(i)) for i in (0, 5, 10, 49, 50, 75, 100, 150)]
    np.testing.assert_allclose(got, [0.1, 0.55, 1, 1, 1, 0.515, 0.03, 0.03], rtol=1e-6)
    short = learning_rate(
        OptimConfig(learning_rate=1.0, warmup=100), 8
    )  # at most a quarter warms up
    np.testing.assert_allclose([float(short(i)) for i in (0, 2, 7)], [0.5, 1, 1], rtol=1e-6)


def test_weight_decay_acts_on_matrices_only():
    cfg = OptimConfig(learning_rate=0.1, warmup=1, weight_decay=0.5, clip=0.0)
    optimiser = make_optimiser(cfg, SPECS, 10)
    p = jax.tree.map(jnp.ones_like, start())
    updates, _ = optimiser.update(jax.tree.map(jnp.zeros_like, p), optimiser.init(p), p)
    np.testing.assert_allclose(updates["layer"]["kernel"], -0.05, rtol=1e-6)
    np.testing.assert_array_equal(updates["layer"]["bias"], 0.0)


def test_accumulated_steps_equal_one_step_on_the_mean_gradient():
    p, key = start(), np.random.default_rng(3)
    grads = [
        jax.tree.map(lambda x: jnp.asarray(key.standard_normal(x.shape), x.dtype), p)
        for _ in range(3)
    ]
    cfg = OptimConfig(learning_rate=0.1, warmup=1)
    many, one = (make_optimiser(dataclasses.replace(cfg, accumulate=n), SPECS, 30) for n in (3, 1))
    state = many.init(p)
    for i, g in enumerate(grads):
        updates, state = many.update(g, state, p)
        assert any(np.any(u) for u in flatten(updates).values()) == (i == 2)
    mean = jax.tree.map(lambda *g: sum(g) / 3, *grads)
    want, _ = make_optimiser(cfg, SPECS, 30).update(mean, one.init(p), p)
    for path, value in flatten(updates).items():
        np.testing.assert_allclose(value, flatten(want)[path], rtol=1e-5)


def test_the_rate_of_accumulated_steps_falls_as_the_updates_end():
    """20 steps of two that make 10 updates: the sizes of 10 steps, warm-up and decay included."""
    p = start()
    g = jax.tree.map(jnp.ones_like, p)

    def sizes(accumulate):
        cfg = OptimConfig(
            learning_rate=0.1, warmup=2, decay=0.5, weight_decay=0.0, accumulate=accumulate
        )
        optimiser = make_optimiser(cfg, SPECS, 10 * accumulate)
        state, found = optimiser.init(p), []
        for _ in range(10 * accumulate):
            updates, state = optimiser.update(g, state, p)
            found.append(abs(float(updates["layer"]["bias"][0])))
        return [size for size in found if size > 0]

    plain = sizes(1)
    assert len(plain) == 10 and plain[-1] < 0.3 * max(plain)
    np.testing.assert_allclose(sizes(2), plain, rtol=1e-4)


def test_the_average_starts_fast_and_slows_down():
    average, p = {"x": jnp.zeros(())}, {"x": jnp.ones(())}
    assert float(ema_update(average, p, 0.99, jnp.asarray(0))["x"]) == pytest.approx(0.9)
    assert float(ema_update(average, p, 0.99, jnp.asarray(10**6))["x"]) == pytest.approx(
        0.01, rel=1e-4
    )


def test_the_average_is_over_the_parameters_after_each_step():
    optimiser = make_optimiser(OPTIM, SPECS, 10)
    step = jax.jit(training.make_step(objective, optimiser, OPTIM))
    state = training.initial_state(start(), optimiser, OPTIM)
    average = np.asarray(state["params"]["layer"]["kernel"])
    for i in range(3):
        state, _ = step(state, {}, batch_of(i), jax.random.key(i))
        rate = min(OPTIM.ema, (1 + i) / (10 + i))
        average = rate * average + (1 - rate) * np.asarray(state["params"]["layer"]["kernel"])
        np.testing.assert_allclose(state["ema"]["layer"]["kernel"], average, rtol=1e-6)


def test_muon_takes_the_hidden_matrices_and_nothing_else():
    """Kernels at the border of the network keep Adam: pixels, rays, latents, noise levels, words, camera vectors."""
    specs = model.specs(preset("tiny"))
    found = flatten(muon_dimensions(specs))
    border = {
        "dit/patch_embed", "dit/head/linear", "dit/text_embed/fc1", "dit/text_embed/fc2",
        "dit/time_embed/fc1", "dit/time_embed/fc2", "dit/time_embed/proj",
        "encoder/camera_mlp/fc1", "encoder/patch_encoder/patch_embed",
        "fusion/geometry_embed", "fusion/rays_embed",
        "renderer/ray_embed", "renderer/rgb_head/linear",
        "vae/decoder/conv_in", "vae/decoder/conv_out", "vae/encoder/conv_in", "vae/encoder/conv_out",
    }  # fmt: skip
    kernels = {path.removesuffix("/kernel") for path in found if path.endswith("/kernel")}
    assert {
        path.removesuffix("/kernel") for path, d in found.items() if d is not None
    } == kernels - border
    assert border <= kernels
    for path, dims in found.items():
        if dims is not None:
            spec = flatten(specs)[path]
            stacked = spec.axes[0] == "layers"  # a matrix per layer, never across layers
            assert dims.reduction_axis == tuple(range(stacked, len(spec.shape) - 1)), path
            assert dims.output_axis == len(spec.shape) - 1, path


def test_wide_embeddings_take_smaller_steps_of_adam():
    specs = model.specs(preset("mini"))
    shares = flatten(adam_shares(specs))
    small = {path: x for path, x in shares.items() if x != 1.0}
    assert small == {
        "fusion/rays_embed/kernel": 256 / (2 * 2 * 1536),
        "fusion/geometry_embed/kernel": 256 / (2 * 2 * 512),
    }
    some = {"fusion": {name: spec for name, spec in specs["fusion"].items() if "embed" in name}}
    optimiser = make_optimiser(
        OptimConfig(name="muon", learning_rate=1.0, warmup=1, clip=0.0, weight_decay=0.0), some, 10
    )
    p = jax.tree.map(lambda spec: jnp.zeros(spec.shape), some, is_leaf=lambda x: hasattr(x, "axes"))
    updates, _ = optimiser.update(jax.tree.map(jnp.ones_like, p), optimiser.init(p), p)
    flat = flatten(updates)
    step = flat["fusion/rays_embed/bias"][0]  # Adam's first step is the same for every weight
    assert len(flat) > len(small)
    for path, moved in flat.items():
        np.testing.assert_allclose(moved, shares[path] * step, rtol=1e-5)


@pytest.mark.parametrize(("small", "share"), [(True, 256 / (2 * 2 * 1536)), (False, 1.0)])
def test_lora_of_a_small_model_steps_wide_embeddings_by_their_share(small, share):
    stage = stages.lora_stage(10)
    stage = stages.for_one_scene(stage) if small else stage
    found = flatten(stages.stage_specs(preset("mini"), stage)[0])
    wide, factor = "fusion/rays_embed/kernel", "dit/blocks/self_attn/q/lora_b"
    specs = params.unflatten({path: found[path] for path in (wide, factor)})
    optim = dataclasses.replace(stage.optim, warmup=1, clip=0.0, weight_decay=0.0)
    zeros = jax.tree.map(lambda s: jnp.zeros(s.shape), specs, is_leaf=lambda x: hasattr(x, "axes"))
    optimiser = make_optimiser(optim, specs, 10)
    updates, _ = optimiser.update(jax.tree.map(jnp.ones_like, zeros), optimiser.init(zeros), zeros)
    moved = {path: np.abs(x).mean() for path, x in flatten(updates).items()}
    assert moved[factor] > 0
    np.testing.assert_allclose(moved[wide], share * moved[factor], rtol=1e-5)


def test_a_muon_update_moves_every_direction_of_every_layer_alike():
    specs = {"blocks": params.stack({"fc": linear_specs(16, 8)}, 3)}
    p = params.init(jax.random.key(0), specs)
    optimiser = make_optimiser(
        OptimConfig(name="muon", learning_rate=1.0, warmup=1, clip=0.0), specs, 10
    )
    # Gradients whose layers and directions differ a lot in size.
    size = jnp.asarray([1e-3, 1.0, 1e3])[:, None, None] * jnp.logspace(-1, 1, 8)[None, None]
    noise = jax.random.normal(jax.random.key(1), (3, 16, 8))
    grads = {"blocks": {"fc": {"kernel": size * noise, "bias": jnp.ones((3, 8))}}}
    updates, _ = jax.jit(optimiser.update)(grads, optimiser.init(p), p)
    values = np.linalg.svd(np.asarray(updates["blocks"]["fc"]["kernel"]), compute_uv=False)
    # Five Newton-Schulz steps bring singular values to 0.7 .. 1.2 of each other's level; RMS 0.2 by `consistent_rms`.
    assert values.max() / values.min() < 2.0
    rms = np.sqrt(np.square(updates["blocks"]["fc"]["kernel"]).mean((1, 2)))
    np.testing.assert_allclose(rms, 0.2, rtol=0.3)
    assert isinstance(optimiser, optax.GradientTransformation)
