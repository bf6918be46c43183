"""The commands and the Python of the README run as they are printed, with fewer steps and scenes.

Of `sample`, `evaluate` and `train`, which compile the shipped model, the fast tests read the options alone: test_sample.py,
test_evaluate.py and test_train_program.py run them on a tiny model. The slow tests run all of them.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import quick_xla
from scene_files import nerfstudio, truth

from roge_jax import evaluate, sample, train
from roge_jax.files import entry

README = (Path(__file__).parents[2] / "README.md").read_text()
SHORTER = {  # later options win
    "roge_jax.sample": ["--steps", "2", "--frames", "9"],
    "roge_jax.evaluate": ["--steps", "2", "--scenes", "procedural:1000000000"],
    "roge_jax.train": ["--steps", "1", "--out", "runs/readme"],
}
LONG = {"roge_jax.sample": sample, "roge_jax.evaluate": evaluate, "roge_jax.train": train}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands() -> list[str]:
    lines = [line for block in blocks("bash") for line in block.splitlines()]
    return [line for line in lines if line.startswith("python -m")]


def run(arguments, folder) -> subprocess.CompletedProcess:
    environment = os.environ | {"XLA_FLAGS": quick_xla.spelled()}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("readme")
    nerfstudio(folder / "path/to/scene", truth())
    return folder


def test_the_readme_has_commands():
    assert len(commands()) >= 4 and len(blocks("python")) == 1


def takes_long(line: str) -> bool:
    return line.split()[2] in LONG


@pytest.mark.parametrize(
    "line", list(filter(takes_long, commands())), ids=lambda line: line.split()[2]
)
def test_options_are_understood(line):
    _, _, module, *rest = shlex.split(line)
    entry.parse(LONG[module].parser(), rest)


@pytest.mark.parametrize(
    "line",
    [pytest.param(line, marks=[pytest.mark.slow] * takes_long(line)) for line in commands()],
    ids=[line.split()[2] for line in commands()],
)
def test_command_runs(line, folder):
    _, _, module, *rest = shlex.split(line)
    done = run(["-m", module, *rest, *SHORTER.get(module, [])], folder)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-2000:]


def test_python_runs(folder):
    done = run(["-c", blocks("python")[0]], folder)
    assert done.returncode == 0, done.stderr[-2000:]


def test_make_targets_exist():
    makefile = (Path(__file__).parents[2] / "Makefile").read_text()
    for target in set(re.findall(r"^    make (\w+)", README, re.MULTILINE)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
