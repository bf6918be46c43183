"""What all experiments share: turns, files, tables and marks."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

from experiments import harness


def test_calls_take_turns_and_every_second_round_goes_backwards():
    seen = []
    calls = {name: lambda name=name: seen.append(name) for name in "abc"}
    seconds = harness.in_turn(calls, 3)
    assert "".join(seen) == "abccbaabc"
    for clock in seconds:
        assert {name: len(values) for name, values in clock.items()} == dict.fromkeys("abc", 3)


def test_ratios_are_those_within_a_round(monkeypatch):
    """Both calls grow slower together; the first call of each is not counted."""
    clock, lasts = [0.0], {"first": iter([99.0, 1.0, 2.0, 4.0]), "second": iter([99.0, 3.0, 6.0, 12.0])}  # fmt: skip
    monkeypatch.setattr(harness.time, "process_time", lambda: clock[0])

    def call(name):
        clock[0] += next(lasts[name])

    found = harness.compare({name: lambda name=name: call(name) for name in lasts}, 3)
    assert found["second"] == {
        "seconds": 6.0,
        "quartiles": [4.5, 9.0],
        "minimum": 3.0,
        "ratio": 3.0,
        "ratio_quartiles": [3.0, 3.0],
    }
    assert found["first"]["ratio"] == 1.0


def test_files_are_strict_json_with_as_many_digits_as_asked(tmp_path, monkeypatch):
    monkeypatch.setattr(harness, "RESULTS", tmp_path / "new")
    content = {"a": [1.23456789, math.nan, np.float32(0.5)], "n": 123456789, "t": "1.23456789"}
    harness.write("x.json", content, digits=3)
    assert harness.read("x.json") == {"a": [1.23, None, 0.5], "n": 123456789, "t": "1.23456789"}
    assert "\n" not in (tmp_path / "new" / "x.json").read_text().rstrip("\n")
    harness.write(tmp_path / "y.json", {"a": [1.23456789]})
    assert harness.read(tmp_path / "y.json") == {"a": [1.23456789]}
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["x.json"]
    assert harness.read("z.json", absent={}) == {}
    with pytest.raises(FileNotFoundError):
        harness.read("z.json")


def test_only_what_lies_between_the_marks_is_replaced(tmp_path):
    page, marks = tmp_path / "page.md", "<!-- x: written by the experiment -->{}<!-- /x -->"
    page.write_text(f"before\n{marks.format('old')}\nafter\n")
    lines = harness.table(["a", ""], [[1, "b"], ["", 2.5]])
    assert lines == ["| a |  |", "|---|---|", "| 1 | b |", "|  | 2.5 |"]
    for _ in range(2):
        harness.put(page, "x", "\n".join(lines))
        text = "\n\n" + "\n".join(lines) + "\n\n"
        assert page.read_text() == f"before\n{marks.format(text)}\nafter\n"
    with pytest.raises(ValueError, match="needs the lines <!-- y"):
        harness.put(page, "y", "")


@pytest.mark.parametrize(
    ("page", "name"),
    [("solvers", "mini_quality"), ("planning", "plan_ladder"), ("ablation", "ablation"), ("scaling", "scaling")],
)  # fmt: skip
def test_the_pages_have_the_marks(page, name, tmp_path):
    copy = tmp_path / "page.md"
    copy.write_text((harness.DOCS / "results" / f"{page}.md").read_text())
    harness.put(copy, name, "all new")
    assert "all new" in copy.read_text()


def test_a_program_says_how_it_was_called_and_answers_its_parent(tmp_path):
    code = "import json; from experiments import harness; print('noise'); print(json.dumps(harness.command()))"
    (tmp_path / "asked.py").write_text(code)
    expected = ["python", "-m", "asked", "--word"]
    words = {"env": {"PYTHONPATH": f"{harness.ROOT}:{tmp_path}"}, "capture_output": True, "text": True}  # fmt: skip
    said = subprocess.run([sys.executable, "-m", "asked", "--word"], check=True, **words)
    assert json.loads(said.stdout.splitlines()[-1]) == expected
    assert harness.child("asked", "--word", PYTHONPATH=str(tmp_path)) == expected


def test_a_chart_is_a_small_picture(tmp_path):
    plt = harness.pyplot()
    open_before = plt.get_fignums()  # of other tests
    figure, axes = plt.subplots()
    axes.plot([0, 1])
    harness.save(figure, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").read_bytes()[1:4] == b"PNG"
    assert plt.get_fignums() == open_before
