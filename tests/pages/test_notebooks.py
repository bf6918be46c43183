"""The notebooks run from the first cell to the last in time, and their two forms are the same."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import quick_xla

# "In under a minute" is for a machine of one's own. Machines for tests have one or two slow cores, shared with other tests.
MOST_SECONDS = 180
NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))


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
def test_paired_notebook_has_the_same_cells_and_no_outputs(source):
    jupytext = pytest.importorskip("jupytext")
    script = jupytext.read(source)
    paired = jupytext.read(source.with_suffix(".ipynb"))
    assert [c.source for c in script.cells] == [c.source for c in paired.cells]
    assert all(not c.get("outputs") for c in paired.cells)
