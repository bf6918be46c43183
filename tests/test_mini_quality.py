"""The experiment on the trained model: what it measures and how it decides."""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import mini_quality
from mini_quality import verdict
from quality import charts, knobs
from quality.measures import GAP, consistency, same_surface
from quality.scenes import CONTEXTS, most_steps, photos

from roge_jax.config import FlowConfig
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
        "seconds": 0.1 * evaluations,
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


def test_goals_are_two_sided_and_a_blurred_point_never_wins():
    euler = {"sharpness_ratio": {"mean": 0.5}}
    blurred = point("euler", 2, 0.4, 1.2, 0.35)  # more PSNR by blur
    coarse = point("ab2", 4, 0.05, 0.3, 0.48)
    fine = point("ab2", 8, 0.01, 0.05, 0.5)
    found = verdict([blurred, coarse, fine], euler, OWN)
    assert [g["point"] for g in found["goals"]] == ["ab2 uniform 8", "ab2 uniform 4"]
    assert [g["reached"] for g in found["goals"]] == [True, True]
    assert found["fewest_evaluations_within_goal"] == "ab2 uniform 8"
    alone = verdict([blurred], euler, OWN)
    assert not any(g["reached"] for g in alone["goals"])
    assert "fewest_evaluations_within_goal" not in alone
    edge = verdict([point("ab2", 4, 0.05, 0.495, 0.5)], euler, OWN)["goals"][1]
    assert edge["reached"] and not edge["reached_by_interval"]


def test_tables_replace_only_what_lies_between_the_markers():
    euler = point("euler", 50, 0.02, 0.0, 0.5)
    records = [point("ab2", 4, 0.05, 0.3, 0.48), point("ab2", 8, 0.01, 0.05, 0.5)]
    report = {
        "settings": {
            "command": "python experiments/mini_quality.py",
            "scenes": [5, 6],
            "photos": 3,
            "weights": "abc",
            "schedules_found_on": "abc",
            "reference": "rk4",
        },
        "device": "cpu",
        "seconds": 1.0,
        "reference": {"self_error": euler["metrics"], "metrics": euler["metrics"]},
        "euler50": {"metrics": euler["metrics"], "seconds": 1.0},
        "records": records,
        "verdict": verdict(records, euler["metrics"], OWN),
        "knobs": [],
    }
    text = "before\n<!-- mini_quality: written by the experiment -->\nold\n<!-- /mini_quality -->\nafter\n"
    once = charts.with_tables(text, report)
    assert once.startswith("before\n") and once.endswith("\nafter\n") and "old" not in once
    assert "| 8 | uniform | `ab2`, 8 | 0.0100 |" in once
    assert charts.with_tables(once, report) == once
    document = Path(__file__).parents[1] / "docs" / "solvers.md"
    assert "<!-- mini_quality: written by the experiment -->" in document.read_text()


def test_a_budget_is_never_overdrawn():
    assert most_steps("rkc2", 2) == 0 and most_steps("heun", 3) == 2
    for solver in ("euler", "heun", "midpoint", "ab3", "rk4"):
        for budget in (4, 8, 12):
            steps = most_steps(solver, budget)
            assert nfe(solver, steps) <= budget < nfe(solver, steps + 1)


@pytest.mark.slow
def test_the_experiment_runs_from_weights_to_document(tmp_path, monkeypatch):
    """A few points of every part, on the shipped model."""
    document = tmp_path / "solvers.md"
    document.write_text((Path(__file__).parents[1] / "docs" / "solvers.md").read_text())
    monkeypatch.setattr(mini_quality, "OUT", tmp_path)
    monkeypatch.setattr(mini_quality, "DOCUMENT", document)
    monkeypatch.setattr(mini_quality, "TOLERANCES", (0.3,))
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
    mini_quality.main(argparse.Namespace(**args, reference=8))
    report = json.loads((tmp_path / "mini_quality.json").read_text())
    assert {r["evaluations"] for r in report["records"] if r["solver"] == "euler"} == {4, 8}
    wanted = {"M", "steps", "resolution", "numbers", "cache", "refinement", "ceiling"}
    assert {r["knob"] for r in report["knobs"]} == wanted
    error = {(r["schedule"], r["steps"]): r["metrics"]["latent_error"]["mean"] for r in report["records"]}  # fmt: skip
    assert error["uniform", 8] < error["uniform", 4]
    assert report["settings"]["weights"] in document.read_text()
    for name in ("mini_quality.png", "mini_knobs.png"):
        assert 10_000 < (tmp_path / name).stat().st_size < 300_000
