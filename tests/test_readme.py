"""The commands and the Python of the README run as they are printed, with fewer steps and scenes."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from scene_files import nerfstudio, truth

README = (Path(__file__).parents[1] / "README.md").read_text()
SHORTER = {  # later options win
    "roge_jax.sample": ["--steps", "2", "--frames", "9"],
    "roge_jax.evaluate": ["--steps", "2", "--scenes", "procedural:1000000000"],
    "roge_jax.train": ["--steps", "1", "--out", "runs/readme"],
}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands() -> list[str]:
    lines = [line for block in blocks("bash") for line in block.splitlines()]
    return [line for line in lines if line.startswith("python -m")]


def run(arguments, folder) -> subprocess.CompletedProcess:
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
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


@pytest.mark.parametrize("line", commands(), ids=lambda line: line.split()[2])
def test_command_runs(line, folder):
    _, _, module, *rest = shlex.split(line)
    done = run(["-m", module, *rest, *SHORTER.get(module, [])], folder)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-2000:]


def test_python_runs(folder):
    done = run(["-c", blocks("python")[0]], folder)
    assert done.returncode == 0, done.stderr[-2000:]


def test_make_targets_exist():
    makefile = (Path(__file__).parents[1] / "Makefile").read_text()
    for target in set(re.findall(r"^    make (\w+)", README, re.MULTILINE)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
