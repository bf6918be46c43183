"""The experiment on the trained model: what it measures and how it decides."""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import harness
from experiments.quality import charts, knobs, mini, scenes, work_precision
from experiments.quality.measures import GAP, consistency, same_surface
from experiments.quality.mini import verdict
from experiments.quality.scenes import CONTEXTS, REPEATS, Sampler, Scenes, most_steps, photos
from roge_jax import model
from roge_jax.checkpoint import weights_fingerprint
from roge_jax.config import FlowConfig, preset
from roge_jax.core.params import flatten, unflatten
from roge_jax.video.solvers import nfe

OWN = FlowConfig()


def test_photos_are_spread_and_targets_are_the_same_for_every_number_of_photos():
    _, targets = photos(17, CONTEXTS)
    assert len(targets) == 17
    for m in range(1, CONTEXTS + 1):
        context, same = photos(17, m)
        assert same == targets and len(set(context)) == m and not set(context) & set(targets)
        assert abs(np.mean(context) - 11) <= 2  # around the middle of 23 views


def plane_views(step=0.05, depth=2.0, n=9, h=24, w=32):
    """A textured wall at `depth`, seen by a camera that slides to the right."""
    K = np.tile([[20.0, 0, w / 2], [0, 20.0, h / 2], [0, 0, 1]], (n, 1, 1))
    c2w = np.tile(np.eye(4), (n, 1, 1))
    c2w[:, 0, 3] = step * np.arange(n)
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    X = (x - w / 2) / 20.0 * depth
    Y = (y - h / 2) / 20.0 * depth
    frames = np.stack(
        [np.stack([0.5 + 0.3 * np.sin(2 * (X + c) + 3 * Y)] * 3, -1) for c in c2w[:, 0, 3]]
    )
    return frames, np.full((n, h, w), depth), K, c2w


def test_consistency_is_high_for_the_truth_and_falls_when_frames_do_not_follow_the_cameras():
    frames, depth, K, c2w = plane_views()
    pairs = same_surface(depth, K, c2w)
    assert [(i, j) for i, j, *_ in pairs] == [(0, 4), (4, 8)]
    # the wall slides by 20 * 0.05 * GAP / 2 pixels: that many columns are out of view
    shift = 20.0 * 0.05 * GAP / 2.0
    assert all(abs(mask.mean() - (1 - shift / 32)) < 0.04 for *_, mask in pairs)
    truth = consistency(frames, pairs)
    still = consistency(np.repeat(frames[:1], len(frames), 0), pairs)
    assert truth > 40 and still < 25
    # another surface in one view is not compared
    depth[4, :, :16] = 1.0
    covered = same_surface(depth, K, c2w)
    assert covered[0][3].mean() < 0.6 * pairs[0][3].mean()


def point(solver, evaluations, error, gap, sharpness):
    number = lambda v: {"mean": v, "low": v - 0.01, "high": v + 0.01}  # noqa: E731
    return {
        "solver": solver,
        "schedule": "uniform",
        "steps": evaluations,
        "evaluations": evaluations,
        "seconds": {
            k: c * evaluations for k, c in (("median", 0.1), ("fastest", 0.09), ("slowest", 0.12))
        },
        "psnr_to_euler50": number(gap),
        "metrics": {
            "latent_error": number(error),
            "psnr": number(20.0 + gap),
            "psnr_reference": number(40.0),
            "sharpness_ratio": number(sharpness),
            "gradient_psnr": number(20.0),
            "consistency": number(30.0),
        },
    }


def test_a_goal_is_reached_by_any_sampler_with_the_psnr_and_the_sharpness_of_euler_50():
    euler = {"sharpness_ratio": {"mean": 0.5}}
    blurred = point("euler", 2, 0.4, 0.0, 0.35)  # the right PSNR by blur
    sharper = point("heun", 2, 0.4, 0.0, 0.52)  # noise is no detail either
    coarse = point("ab2", 4, 0.05, -0.3, 0.495)
    fine = point("ab2", 8, 0.02, 0.05, 0.5)
    exact = point("rk4", 8, 0.001, -0.2, 0.5)  # the solution itself, which Euler 50 is not
    found = verdict([blurred, sharper, coarse, fine, exact], euler, OWN)
    assert [g["point"] for g in found["goals"]] == ["ab2 uniform 8", "ab2 uniform 4"]
    assert [g["reached"] for g in found["goals"]] == [True, True]
    assert [(g["samplers"], g["passing"]) for g in found["goals"]] == [(5, 1), (3, 1)]
    assert found["fewest_evaluations_within_goal"] == "ab2 uniform 8"
    for wrong in ([blurred], [sharper], [exact], [point("ab2", 8, 0.1, 0.11, 0.5)]):
        alone = verdict(wrong, euler, OWN)
        assert not alone["goals"][0]["reached"] and "fewest_evaluations_within_goal" not in alone
        assert "**not reached** by 0 of 1 samplers" in charts.goals(alone)[2]
    costly = verdict([point("ab2", 12, 0.01, 0.0, 0.5)], euler, OWN)
    assert not any(g["reached"] or g["samplers"] for g in costly["goals"])
    edge = verdict([point("ab2", 4, 0.05, 0.495, 0.5)], euler, OWN)["goals"][1]
    assert edge["reached"] and edge["passing_by_interval"] == 0


def test_the_page_states_the_goals_as_the_rule_judges_the_stored_records():
    report = harness.read("mini_quality.json")
    found = verdict(report["records"], report["euler50"]["metrics"], preset("mini").flow)
    page = (harness.DOCS / "results" / "solvers.md").read_text()
    assert "\n".join(charts.goals(found)) in page


def test_tables_have_the_best_of_each_budget():
    euler = point("euler", 50, 0.02, 0.0, 0.5)
    records = [point("ab2", 4, 0.05, 0.3, 0.48), point("ab2", 8, 0.01, 0.05, 0.5)]
    report = {
        "settings": {
            "command": "python -m experiments.quality.mini",
            "scenes": [5, 6],
            "photos": 3,
            "weights": "abc",
            "schedules_found_on": "abc",
            "reference": "rk4",
        },
        "device": "cpu",
        "seconds": 1.0,
        "reference": {"self_error": euler["metrics"], "metrics": euler["metrics"]},
        "euler50": {"metrics": euler["metrics"], "seconds": euler["seconds"]},
        "records": records,
        "verdict": verdict(records, euler["metrics"], OWN),
        "knobs": [],
    }
    assert "| 8 | uniform | `ab2`, 8 | 0.0100 |" in charts.tables(report)


def test_a_budget_is_never_overdrawn():
    assert most_steps("rkc2", 2) == 0 and most_steps("heun", 3) == 2
    for solver in ("euler", "heun", "midpoint", "ab3", "rk4"):
        for budget in (4, 8, 12):
            steps = most_steps(solver, budget)
            assert nfe(solver, steps) <= budget < nfe(solver, steps + 1)


def test_seconds_leave_out_the_first_call_and_are_median_and_ends(monkeypatch):
    clock, lasts = [0.0], iter([100.0, 3.0, 1.0, 2.0])
    monkeypatch.setattr(harness.time, "perf_counter", lambda: clock[0])

    def call():
        clock[0] += next(lasts)
        return clock[0]

    first, seconds = scenes.timed(call, 2)
    assert REPEATS == 3 and next(lasts, None) is None
    assert first == 100.0 and seconds == {"median": 1.0, "fastest": 0.5, "slowest": 1.5}


def sampler_of(shape):
    """A sampler over noise [s, t, h, w, c]; the photos are one slot."""
    noise = jnp.ones(shape)
    views = {"context_rgb": np.zeros((shape[0], 1, 8, 8, 3))}
    return Sampler(None, Scenes(None, noise, views, None, None, None, None), None)


def test_nothing_compiles_while_a_sampler_is_timed(monkeypatch, caplog):
    """For a method and a shape that no other test has; also for another velocity than the model's."""
    seen = []

    def clock():
        seen.append(sum("Finished XLA compilation" in r.getMessage() for r in caplog.records))
        return float(len(seen))

    monkeypatch.setattr(harness.time, "perf_counter", clock)
    sampler, made = sampler_of((2, 3, 5, 7, 11)), []

    def start():
        made.append(jax.jit(lambda x, sigma: -x) if not made else made[0])
        return made[0]

    with jax.log_compiles():
        run = sampler.timed("ab3", np.linspace(1, 0, 4), start)
    assert seen[0] > 0 and set(seen) == {seen[0]}
    assert len(seen) == 2 * REPEATS and len(made) == 1 + REPEATS
    assert run.evaluations == 4 and run.latents.shape == (2, 2, 5, 7, 11)
    assert run.seconds == {"median": 0.5, "fastest": 0.5, "slowest": 0.5}  # of one of two scenes


def test_grids_of_one_length_are_timed_once_and_sampled_each():
    sampler, calls = sampler_of((2, 3, 2, 2, 1)), []

    def velocity(x, sigma):
        calls.append(float(sigma))
        return x

    sampler.velocity = velocity
    first = sampler.timed("euler", np.array([1.0, 0.5, 0.0]))
    assert len(calls) == 2 * (1 + REPEATS)
    second = sampler.timed("euler", np.array([1.0, 0.2, 0.0]))
    assert len(calls) == 2 * (2 + REPEATS) and second.seconds == first.seconds
    assert not np.allclose(first.latents, second.latents)
    sampler.timed("euler", np.array([1.0, 0.7, 0.3, 0.0]))
    sampler.timed("heun", np.array([1.0, 0.5, 0.0]))
    assert len(calls) == 2 * (2 + REPEATS) + (3 + 3) * (1 + REPEATS)


def test_the_fingerprint_covers_every_leaf_of_every_part():
    flat = flatten(model.init(jax.random.key(0), preset("tiny")))
    assert {path.split("/")[0] for path in flat} >= {"dit", "fusion", "renderer", "encoder", "vae"}
    whole = weights_fingerprint(unflatten(flat), "float32")
    assert whole == weights_fingerprint(unflatten(flat), "float32") and len(whole) == 12
    last = {path.split("/")[0]: path for path in flat}  # of each part
    for path in last.values():
        changed = flat | {path: flat[path].at[(-1,) * flat[path].ndim].add(1e-3)}
        assert weights_fingerprint(unflatten(changed), "float32") != whole, path
    named = flat | {"dit/other": flat[last["dit"]]}
    named.pop(last["dit"])
    assert weights_fingerprint(unflatten(named), "float32") != whole


def report_of(records):
    euler = point("euler", 50, 0.02, 0.0, 0.5)
    return {
        "records": records,
        "verdict": {"default": "ab2 uniform 8"},
        "reference": {"self_error": euler["metrics"]},
        "euler50": {"metrics": euler["metrics"]},
    }


def test_samplers_are_drawn_against_evaluations_and_seconds(monkeypatch):
    """Error, PSNR and consistency against both, for every solver; slowest and fastest runs as bars."""
    records = [point(s, n, 0.5 / n, 0.8 / n, 0.5) for s in ("euler", "ab2") for n in (4, 8)]
    drawn = []
    monkeypatch.setattr(harness, "save", lambda figure, path: drawn.append(figure))
    charts.samplers(report_of(records), "unused")
    (figure,) = drawn
    column = [ax for ax in figure.axes if ax.get_subplotspec().colspan.start == 0]
    wanted = {
        ("evaluations", "latent_error"): (lambda r: r["metrics"]["latent_error"]["mean"]),
        ("seconds", "latent_error"): (lambda r: r["metrics"]["latent_error"]["mean"]),
        ("evaluations", "psnr_to_euler50"): (lambda r: r["psnr_to_euler50"]["mean"]),
        ("seconds", "psnr_to_euler50"): (lambda r: r["psnr_to_euler50"]["mean"]),
        ("evaluations", "consistency"): (lambda r: r["metrics"]["consistency"]["mean"]),
        ("seconds", "consistency"): (lambda r: r["metrics"]["consistency"]["mean"]),
    }
    panels = {(x, metric): ax for ax, (x, metric, _) in zip(column, charts.ROWS, strict=True)}
    for (x, metric), measure in wanted.items():
        ax = panels[x, metric]
        for solver in ("euler", "ab2"):
            (line,) = (line for line in ax.lines if line.get_label() == solver)
            mine = [r for r in records if r["solver"] == solver]
            at = [r["seconds"]["median"] if x == "seconds" else r["evaluations"] for r in mine]
            np.testing.assert_allclose(line.get_xdata(), at)
            np.testing.assert_allclose(line.get_ydata(), [measure(r) for r in mine])
    bars = [
        c for c in panels["seconds", "psnr_to_euler50"].collections if hasattr(c, "get_segments")
    ]
    ends = {tuple(np.round(s[:, 0], 6)) for c in bars for s in c.get_segments()}
    assert ends == {(0.36, 0.48), (0.72, 0.96)}


def test_bfloat16_and_shared_refinement_are_drawn_among_the_knobs(monkeypatch):
    records = [point("ab2", n, 0.5 / n, 0.8 / n, 0.5) for n in (4, 8)]
    some = point("ab2", 8, 0.1, 0.0, 0.5)
    knob = lambda name, value, **more: some | {"knob": name, "value": value} | more  # noqa: E731
    gaps = {"per_view": 0.0, "shared": 0.06}
    points = [
        *(knob("M", m, method=method) for m in (2, 3) for method in charts.METHODS),
        knob("steps", 2, method="generation only"),
        *(knob("ceiling", name) for name in ("truth", "VAE round trip")),
        knob("resolution", "48x80"),
        knob("numbers", "float32"),
        knob("numbers", "bfloat16", psnr_to_exact={"mean": -0.012}),
        *(knob("cache", f"ab2 uniform 8, {kind}") for kind in ("exact", "cached")),
        *(knob("refinement", k, relative_difference_of_features=gap) for k, gap in gaps.items()),
    ]
    drawn = []
    monkeypatch.setattr(harness, "save", lambda figure, path: drawn.append(figure))
    report = report_of(records) | {"knobs": points, "settings": {}}
    charts.knobs(report, "unused")
    panels = {ax.get_title(): [t.get_text() for t in ax.texts] for ax in drawn[0].axes}
    numbers = "\n".join(panels["numbers of the weights, default sampler"])
    assert "float32" in numbers and "bfloat16" in numbers and "-0.012 dB" in numbers
    refinement = panels["refinement of scene tokens, random toy"]
    assert refinement == ["exact (per view)\ndiffers by 0.000", "shared\ndiffers by 0.060"]


def test_quartiles_of_the_work_precision_chart():
    assert work_precision.quartiles([5.0, 1.0, 4.0, 2.0, 3.0]) == {"q25": 2, "median": 3, "q75": 4}


@pytest.mark.slow
def test_the_experiment_runs_from_weights_to_document(tmp_path, monkeypatch):
    """A few points of every part, on the shipped model."""
    document = tmp_path / "results" / "solvers.md"
    document.parent.mkdir()
    document.write_text((harness.DOCS / "results" / "solvers.md").read_text())
    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    monkeypatch.setattr(harness, "DOCS", tmp_path)
    monkeypatch.setattr(mini, "TOLERANCES", (0.3,))
    monkeypatch.setattr(knobs, "PHOTOS", (3,))
    monkeypatch.setattr(knobs, "SIZES", ((48, 80),))
    monkeypatch.setattr(knobs, "PEER_STEPS", (2,))
    args = {
        "checkpoint": "mini",
        "scenes": 2,
        "solvers": ["euler"],
        "budgets": [4, 8],
        "generation_only": None,
    }
    mini.main(argparse.Namespace(**args, reference=8))
    report = harness.read("mini_quality.json")
    assert {r["evaluations"] for r in report["records"] if r["solver"] == "euler"} == {4, 8}
    wanted = {"M", "steps", "resolution", "numbers", "cache", "refinement", "ceiling"}
    assert {r["knob"] for r in report["knobs"]} == wanted
    error = {(r["schedule"], r["steps"]): r["metrics"]["latent_error"]["mean"] for r in report["records"]}  # fmt: skip
    assert error["uniform", 8] < error["uniform", 4]
    times = [r["seconds"] for r in [*report["records"], *report["knobs"]] if "seconds" in r]
    assert len(times) > 12 and all(t["fastest"] <= t["median"] <= t["slowest"] for t in times)
    assert report["settings"]["weights"] in document.read_text()
    for name in ("mini_quality.png", "mini_knobs.png"):
        assert 10_000 < (tmp_path / name).stat().st_size < 300_000
