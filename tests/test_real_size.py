"""The unattended speed run: what goes wrong in one row stays in that row, and every row of the goals is there."""

import argparse
import importlib.util
import json
import sys
from pathlib import Path

import pytest

EXPERIMENT = Path(__file__).parent.parent / "experiments" / "real_size.py"
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
if args.row == "memory":
    sys.exit("XlaRuntimeError: RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes.")
if args.row == "killed":
    os.kill(os.getpid(), 9)
found = {"status": "measured", "seconds": 0.5, "quartiles": [0.4, 0.6], "tflops": 2.0, "side": args.side}
pathlib.Path(args.out).write_text(json.dumps(found))
"""


@pytest.fixture(scope="module")
def experiment():
    spec = importlib.util.spec_from_file_location("real_size", EXPERIMENT)
    module = importlib.util.module_from_spec(spec)
    before = list(sys.path)
    spec.loader.exec_module(module)
    yield module
    sys.path[:] = before


def test_what_happens_in_a_row_is_said_and_leaves_the_others(experiment, monkeypatch, tmp_path):
    (tmp_path / "rows.py").write_text(FAKE)
    monkeypatch.setattr(experiment, "PARTS", tmp_path)
    args = argparse.Namespace(repeats=2)
    expected = {
        "slow": ("out of time", "not done after 3 s"),
        "crash": ("failed", "not a number"),
        "memory": ("out of memory", "RESOURCE_EXHAUSTED"),
        "killed": ("out of memory", "exit code -9"),
    }
    for name, (status, why) in expected.items():
        found = experiment.child(name, "ours", args, 3.0)
        assert found["status"] == status and why in found["why"], found
    good = experiment.child("good", "peer", args, 30.0)
    assert good["status"] == "measured" and good["side"] == "peer" and good["wall_seconds"] > 0


def test_rows_table_and_chart(experiment, tmp_path):
    import rows as parts

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
    assert (tmp_path / "chart.png").stat().st_size > 5000
