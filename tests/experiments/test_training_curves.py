"""Training curves: what is kept of a log, and that the chart of the shipped model is of its stages."""

import json
import sys

import pytest

from experiments import harness
from experiments.quality import training_curves as curves


def test_rows_are_means_and_lose_no_held_out_result(tmp_path):
    log = [{"step": i + 1, "loss": float(i), "skipped": 0} for i in range(120)]
    log[6]["held_loss"] = 0.125
    log[4]["loss"] = None  # a step that was skipped
    folder = tmp_path / "recon"
    folder.mkdir()
    (folder / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in log))
    (run,) = curves.collect([f"first={folder}"])
    assert (run["stage"], run["label"]) == ("recon", "first")
    rows = run["rows"]
    assert len(rows) == 40 and rows[-1]["step"] == 120
    assert rows[0] == {"step": 3, "loss": 1.0}
    assert rows[1]["loss"] == pytest.approx(4.0)  # of 3 and 5
    assert [row["held_loss"] for row in rows if "held_loss" in row] == [0.125]
    curves.draw([run], tmp_path / "chart.png")
    assert (tmp_path / "chart.png").stat().st_size > 5000


def test_runs_are_added_behind_the_stored_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    monkeypatch.setattr(curves, "draw", lambda runs: None)
    folder = tmp_path / "lookup"
    folder.mkdir()
    (folder / "log.jsonl").write_text('{"step": 1, "loss": 0.5}\n')
    for words in (["a"], ["--add", "b"], ["c"]):
        monkeypatch.setattr(sys, "argv", ["curves", *words[:-1], f"{words[-1]}={folder}"])
        curves.main()
        runs = harness.read("training_curves.json")["runs"]
        assert [run["label"] for run in runs] == {"a": ["a"], "b": ["a", "b"], "c": ["c"]}[
            words[-1]
        ]


def test_the_shipped_models_stages_are_there():
    runs = harness.read("training_curves.json")["runs"]
    recipe = harness.read(harness.ROOT / "roge_jax" / "assets" / "mini" / "config.json")
    recipe = recipe["provenance"]["recipe"]
    for run in runs:
        assert run["stage"] in recipe and len(run["rows"]) > 10
        # Stopped early and continued elsewhere, or as long as the recipe says.
        losses = [row["loss"] for row in run["rows"]]
        assert all(0 < loss < 10 for loss in losses)
    assert {run["stage"] for run in runs} >= {"vae_longer", "recon", "generator", "lookup"}
