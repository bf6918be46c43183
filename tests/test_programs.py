"""The list of programs, and running one by its name alone."""

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from experiments.pages import options
from roge_jax import __main__ as programs


def test_every_program_is_listed_and_no_other():
    assert sorted(programs.PROGRAMS) == sorted(options.name(one) for one in options.programs())
    for name in programs.PROGRAMS:
        line = next(x for x in programs.listing().splitlines() if x.startswith(f"  {name} "))
        assert len(line.split(maxsplit=1)[1]) > 12 and len(line) < 120


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"]])
def test_without_a_name_the_list_is_shown(words, capsys):
    assert programs.main(words) == 0
    shown = capsys.readouterr()
    assert shown.out == programs.listing() + "\n" and not shown.err


def test_the_list_imports_nothing_heavy():
    code = (
        "import sys; from roge_jax import __main__ as m; m.main([]);"
        "assert not {'jax', 'numpy', 'roge_jax.sample'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_an_unknown_name_is_one_sentence(capsys):
    assert programs.main(["smaple", "--steps", "3"]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("error: 'smaple' is no program: did you mean 'sample'? Allowed: check,")
    assert shown.count("\n") == 1


def test_a_named_program_is_that_of_its_module(tmp_path):
    """The same words give the same output and exit code."""

    def run(*call):
        words = [*call, str(tmp_path), "--no-matching"]
        done = subprocess.run([sys.executable, "-m", *words], capture_output=True, text=True)
        return done.returncode, done.stdout, done.stderr

    code, said, error = run("roge_jax.check")
    assert run("roge_jax", "check") == (code, said, error) and code == 2 and said + error


def test_the_console_script_is_there():
    settings = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())
    module, _, function = settings["project"]["scripts"]["roge"].partition(":")
    assert getattr(importlib.import_module(module), function) is programs.cli
