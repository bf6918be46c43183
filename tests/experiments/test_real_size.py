"""The unattended speed run: what goes wrong in one row stays in that row, and every row of the goals is there."""

import argparse
import dataclasses
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from experiments.speed import peer, timing
from experiments.speed import real_size as experiment
from experiments.speed import rows as parts
from roge_jax import config as presets
from roge_jax import cost

FAKE = """
import argparse, json, os, pathlib, sys, time
p = argparse.ArgumentParser()
for name in ("row", "side", "out", "repeats", "seconds"):
    p.add_argument("--" + name)
args = p.parse_args()
if args.row == "slow":
    time.sleep(60)
if args.row == "crash":
    raise ValueError("not a number")
if args.row == "jitted":
    import jax
    jax.jit(lambda x: jax.numpy.ones(3) + jax.numpy.ones(4))(1.0)
if args.row == "memory":
    sys.exit("XlaRuntimeError: RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes.")
if args.row == "killed":
    os.kill(os.getpid(), 9)
found = {"status": "measured", "seconds": 0.5, "quartiles": [0.4, 0.6], "tflops": 2.0, "side": args.side}
pathlib.Path(args.out).write_text(json.dumps(found))
"""


def test_what_happens_in_a_row_is_said_and_leaves_the_others(monkeypatch, tmp_path):
    (tmp_path / "rows.py").write_text(FAKE)
    monkeypatch.setattr(experiment, "ROW", [str(tmp_path / "rows.py")])
    args = argparse.Namespace(repeats=2)
    expected = {
        "jitted": ("failed", "TypeError: add got incompatible shapes"),
        "slow": ("out of time", "not done after 3 s"),
        "crash": ("failed", "not a number"),
        "memory": ("out of memory", "RESOURCE_EXHAUSTED"),
        "killed": ("out of memory", "exit code -9"),
    }
    for name, (status, why) in expected.items():
        found = experiment.child(name, "ours", args, 3.0 if name == "slow" else 60.0)
        assert found["status"] == status and why in found["why"], found
        assert len(found["log"]) <= experiment.LOG_CHARACTERS
        assert "rows.py" in found["log"] or name not in ("crash", "jitted"), "where it happened"
    good = experiment.child("good", "peer", args, 30.0)
    assert good["status"] == "measured" and good["side"] == "peer" and good["wall_seconds"] > 0


def test_rows_table_and_chart(tmp_path):
    rows = parts.rows()
    goals = {name: row for name, row in rows.items() if row.must}
    assert len(goals) == 9, "every line of the goals"
    assert all(row.floor < row.reach < row.must for row in goals.values())
    assert {row.group for row in rows.values()} == set(experiment.GROUPS)
    assert {row.group for row in rows.values() if row.ladder} == set(experiment.GROUPS)
    first, second, *_ = goals
    measured = {"status": "measured", "seconds": 0.5, "quartiles": [0.4, 0.6], "tflops": 2.0}
    found = {first: measured | {"peer": {"status": "measured", "seconds": 1.0}}}
    found[second] = {"status": "out of memory", "why": ""}
    lines = experiment.table(rows, found).splitlines()
    assert "| 0.5 (0.4 to 0.6) | 2 | 1 | 0.50 |" in lines[2]
    assert "out of memory" in lines[3] and "not measured" in lines[4]
    assert len(lines) == 2 + len(rows)
    json.dumps(found)
    pytest.importorskip("matplotlib")
    experiment.chart(rows, found, tmp_path / "chart.png")
    picture = np.asarray(Image.open(tmp_path / "chart.png").convert("RGB"), int)
    for colour in ((0x40, 0x60, 0xA0), (0xD0, 0x80, 0x30)):  # ours and the peer's bar
        assert (np.abs(picture - colour).max(-1) < 16).sum() > 500


MEASURED = {"status": "measured", "seconds": 0.5, "quartiles": [0.4, 0.6], "tflops": 2.0}


def test_an_interrupted_run_continues_side_by_side(monkeypatch, tmp_path):
    one, two, three, unrolled = (
        name for name, row in parts.rows().items() if row.ladder and row.group == "dit"
    )
    large = next(name for name, row in parts.rows().items() if not row.ladder)
    here, there = MEASURED | {"device": "here"}, MEASURED | {"device": "there"}
    stored = {
        one: here,  # cut off before its peer
        two: there | {"peer": {"status": "out of time", "why": ""}},  # on another machine
        three: here | {"peer": there},
        large: there,
        "a row of the past": here,
    }
    out, called, limits = tmp_path / "out.json", [], []
    environment = {"device": {"kind": "here"}, "commit": "abc"}

    def child(name, side, args, limit):
        called.append((name, side))
        limits.append(limit)
        return here | {"seconds": 1.0}

    monkeypatch.setattr(experiment, "child", child)
    monkeypatch.setattr(experiment, "on_gpu", lambda: False)
    monkeypatch.setattr(experiment, "device", lambda: environment)
    monkeypatch.setattr(experiment, "chart", lambda *_: None)

    def run(*options):
        out.write_text(json.dumps({"environment": {}, "rows": stored}))
        monkeypatch.setattr(sys, "argv", ["real_size.py", "--out", str(out), *options])
        called.clear()
        experiment.main()
        return json.loads(out.read_text())["rows"]

    found = run("--only", "dit", "--resume")
    assert called == [(one, "peer"), (two, "ours"), (two, "peer"), (unrolled, "ours")]
    assert found[one] == here | {"peer": here | {"seconds": 1.0, "commit": "abc"}}
    assert found[three] == stored[three] and found[large] == there
    assert "a row of the past" not in found
    others = {name: x for name, x in found.items() if name not in stored and name != unrolled}
    assert others and all(x == {"status": "not measured"} for x in others.values())
    assert max(limits) == 12 * 60.0
    limits.clear()
    run("--only", "dit", "--minutes", "2")
    assert 100 < max(limits) <= 120, "no row beyond the time for everything"
    found = run("--only", "dit", "--minutes", "0.3")
    assert {name: x for name, x in found.items() if name in stored} == {
        name: x for name, x in stored.items() if name in found
    }
    assert found[unrolled] == {"status": "not measured"}
    assert not called, "no time for a row"
    found = run("--only", "dit")
    assert len(called) == 7, "without --resume every row of the group again"
    assert found[large] == there, "rows that a run does not reach stay"
    table = experiment.table(
        parts.rows(), {one: here | {"peer": here}, two: here | {"peer": there}}
    )
    ratios = {line.split(" | ")[0][2:]: line.split(" | ")[4] for line in table.splitlines()[2:]}
    assert ratios[one] == "1.00" and ratios[two] == "", "no ratio of two devices"


def toy(group: str, **changes):
    """A row of `tiny`, small enough to compile in about a second."""
    tiny = dataclasses.replace(presets.preset("tiny"), recon_height=48, recon_width=64)
    return parts.Row(group, tiny, 2, ladder=True, **changes)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("group", ["dit", "vggt", "rays", "render", "vae"])
def test_rows_run(monkeypatch, group, dtype):
    """Both types of large matrices: a GPU takes the one that a CPU does not."""
    row = toy(group)
    work = parts.job(row, dtype)
    assert all(np.isfinite(x).all() and np.std(x) > 0 for x in jax.tree.leaves(work.call()))
    n = row.config.frames
    shape = {
        "dit": (row.config.slots(2), *row.config.latent_size, 16),
        "render": (n, row.config.recon_height, row.config.recon_width, 3),
        "vae": (n, row.config.height, row.config.width, 3),
    }
    assert group not in shape or work.call().shape == shape[group]
    assert work.frames == (n if group == "render" else 1)
    monkeypatch.setattr(parts, "job", lambda *_: work)
    found = parts.ours(row, 2, 20.0, dtype)
    assert found["calls"] == 2 and found["xla_gb"] > 0
    assert found["flops"] == work.flops / work.frames
    stages = {"dit": "velocity", "vggt": "reconstruct", "rays": "query rays", "vae": "decode"}
    if group in stages:
        assert work.flops == cost.estimate(row.config, 2, 1).flops[stages[group]]
    else:
        assert work.flops == parts.render_flops(row.config, 2)
    assert found["quartiles"][0] <= found["seconds"] <= found["quartiles"][1]
    assert found["tflops"] == pytest.approx(found["flops"] / found["seconds"] / 1e12)


def test_a_whole_video_has_the_work_of_all_its_steps(monkeypatch):
    row, evaluations = toy("sample"), []

    def velocity(params, prepared, noise, x, sigma):
        evaluations.append(float(sigma))
        return jnp.zeros_like(x)

    fake = argparse.Namespace(
        prepare=lambda *_: argparse.Namespace(detail=None, shown=jnp.zeros(1)),
        velocity=velocity,
        decode=lambda params, x, detail: x,
    )
    monkeypatch.setattr(parts.programs, "for_window", lambda *_: fake)
    work = parts.whole_video(row.config, row.m, {}, {}, jnp.ones(3))
    np.testing.assert_array_equal(work.call()[0], np.ones(3))
    assert len(evaluations) == 50
    assert work.flops == cost.estimate(row.config, row.m, len(evaluations)).total_flops


def test_unrolled_blocks_give_the_same():
    looped, unrolled = (parts.job(toy("dit", unroll=n), jnp.float32).call() for n in (1, 2))
    np.testing.assert_allclose(looped, unrolled, atol=1e-5)


def test_the_look_up_is_counted():
    mini = presets.preset("mini")
    assert mini.renderer.lookup
    with_it, without = (
        parts.render_flops(cfg, 2)
        for cfg in (mini, parts.sized(mini, renderer=parts.sized(mini.renderer, lookup=0)))
    )
    size = (mini.recon_height, mini.recon_width)
    assert with_it - without == pytest.approx(
        cost.lookup(mini.renderer, *size, 2, mini.frames), rel=1e-9
    )


def test_the_difference_of_bfloat16_sees_attention(monkeypatch):
    """An attention that is wrong in the fast path alone has to show in every part, as it would not if scores were 0."""
    from roge_jax.recon import ray_scene, vggt
    from roge_jax.video import dit

    def uniform(q, k, v, *, dtype, **options):
        if dtype == jnp.bfloat16:
            q = jnp.zeros_like(q)
        return attention(q, k, v, dtype=dtype, **options)

    attention = dit.attention
    for part, module in (("dit", dit), ("encoder", vggt), ("rays", ray_scene)):
        row = toy("numerics", part=part)
        right = parts.ours(row, 1, 1.0)["relative_error"]
        assert 1e-5 < right < 0.02, part
        monkeypatch.setattr(module, "attention", uniform)
        assert parts.ours(row, 1, 1.0)["relative_error"] > 3 * right, part


def test_a_training_row_takes_the_first_policy_that_fits(monkeypatch):
    tried = []
    gigabytes = {
        "none": 300,
        "dots": 65,
        "attention": 50,
        "full": 40,
    }  # 64 fit, where no device says

    def planned(cfg, stage, **_):
        return argparse.Namespace(bytes=1e9 * gigabytes[stage.remat])

    def step(cfg, stage, m, dtype, found):
        tried.append(stage.remat)
        if stage.remat == "dots":
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")
        return parts.Job(lambda: None, 1.0, 1.0, notes={"remat": stage.remat, "xla_gb": 1.0})

    monkeypatch.setattr(parts, "_step", step)
    monkeypatch.setattr(parts.estimate, "estimate", planned)
    found = parts.ours(toy("train"), 1, 1.0)
    assert tried == ["dots", "attention"] and found["failed"] == ["dots"], "near misses are tried"
    assert found["remat"] == "attention" and found["planned_gb"]["none"] == 300
    device = argparse.Namespace(
        memory_stats=lambda: {"bytes_limit": 64e9, "peak_bytes_in_use": 5e9}
    )
    with monkeypatch.context() as patched:
        patched.setattr(jax, "local_devices", lambda: [device])
        assert "peak_gb" not in parts.ours(toy("train"), 1, 1.0), "that of the one that failed"
        assert parts.ours(toy("train", remat="full"), 1, 1.0)["peak_gb"] == 5
    tried.clear()
    assert parts.ours(toy("train", remat="full"), 1, 1.0)["remat"] == "full" and tried == ["full"]
    with pytest.raises(MemoryError, match="no policy fits 64 GB"):
        parts.ours(toy("train", remat="none"), 1, 1.0)


def test_clocks_are_read_at_work(monkeypatch, tmp_path):
    calls = []
    monkeypatch.setenv("PATH", str(tmp_path))
    assert timing.busy_clocks(lambda: calls.append(1)) == {} and not calls
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\necho '1980 MHz, 2619 MHz, 640.10 W, 61, 100 %'\n")
    tool.chmod(0o755)
    found = timing.busy_clocks(lambda: calls.append(1))
    assert found["clocks.sm"] == "1980 MHz" and found["utilization.gpu"] == "100 %" and calls


def test_the_peer_runs_whatever_is_wrong_with_diffusers(monkeypatch):
    pytest.importorskip("torch")
    monkeypatch.setattr(peer, "diffusers_network", broken)
    found = peer.run(toy("dit"), 1, 5.0)
    assert found["network"] == "plain PyTorch blocks" and found["seconds"] > 0
    assert found["why_not_diffusers"] == "Failed to import diffusers.models"


def broken(row, gpu):
    raise RuntimeError("Failed to import diffusers.models")
