"""The notebooks run from the first cell to the last in time, their two forms are the same, and they store their pictures."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import quick_xla

# "In under a minute" is for a machine of one's own. Machines for tests have one or two slow cores, shared with other tests.
MOST_SECONDS = 180
NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))


LOAD = 'params, config = rj.load("mini")\n'
TINY = 'config = rj.preset("tiny")\nparams = rj.model.init(jax.random.key(0), config)\n'


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs_on_a_tiny_model(source, tmp_path, monkeypatch, capsys):
    """Every cell as it is, but for the model, whose programs compile in a fraction of the time."""
    import matplotlib.pyplot as plt

    code = source.read_text()
    assert code.count(LOAD) == 1
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    exec(compile(code.replace(LOAD, TINY), str(source), "exec"), found)
    plt.close("all")
    config = found["config"]
    assert config.name == "tiny" and "evaluations" in capsys.readouterr().out
    assert found["video"].shape == (config.frames, config.height, config.width, 3)


@pytest.mark.slow  # a minute on two cores, most of it compiling
@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(source, tmp_path):
    environment = os.environ | {"XLA_FLAGS": quick_xla.spelled()}
    done = subprocess.run(
        [sys.executable, str(source)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=MOST_SECONDS,
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda p: p.stem)
def test_paired_notebook_has_the_same_cells(source):
    jupytext = pytest.importorskip("jupytext")
    script = jupytext.read(source)
    paired = jupytext.read(source.with_suffix(".ipynb"))
    assert [c.source for c in script.cells] == [c.source for c in paired.cells]


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda p: p.stem)
def test_paired_notebook_stores_what_it_shows(source):
    """`make notebook` ran all of it: every cell that prints has its output, none failed, and there is a picture."""
    file = source.with_suffix(".ipynb")
    cells = [c for c in json.loads(file.read_text())["cells"] if c["cell_type"] == "code"]
    assert file.stat().st_size < 1_500_000
    counts = [cell["execution_count"] for cell in cells]
    assert counts == sorted(counts) and None not in counts
    assert all(cell["outputs"] for cell in cells if "print(" in "".join(cell["source"]))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert any("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda p: p.stem)
def test_the_first_code_installs_only_where_nothing_is_installed(source, monkeypatch):
    """As on Colab. In a checkout, and where the package is installed, nothing is called."""
    jupytext = pytest.importorskip("jupytext")
    first = next(c.source for c in jupytext.read(source).cells if c.cell_type == "code")
    called = []
    monkeypatch.setattr(subprocess, "run", lambda words, **options: called.append(words))
    exec(first, {})
    assert not called
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    exec(first, {})
    assert called[0][1:4] == ["-m", "pip", "install"] and "roge_jax" in first
