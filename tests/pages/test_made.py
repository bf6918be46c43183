"""Pages, tables and drawings that are made from the code or from stored numbers are as the code makes them; what makes
them reads the code as it should."""

import argparse
import ast

import pytest

from experiments import harness
from experiments.pages import diagrams, evaluations, messages, modules, options

WRITTEN = "<!-- {}: written by the experiment -->"


@pytest.mark.parametrize("made", [options, messages, modules], ids=lambda made: made.__name__)
def test_pages_are_up_to_date(made):
    assert made.PAGE.read_text() == made.page(), f"run python -m {made.__name__}"


def test_presets_are_up_to_date():
    assert f"{WRITTEN.format('presets')}\n\n{options.presets()}\n" in options.PATHS.read_text()


@pytest.mark.parametrize("name", diagrams.DRAWINGS)
def test_drawings_are_up_to_date(name):
    stored = (diagrams.MEDIA / f"{name}.svg").read_text()
    assert stored == diagrams.DRAWINGS[name]().svg(), "run python -m experiments.pages.diagrams"


@pytest.mark.parametrize("mark", evaluations.TABLES)
def test_tables_are_those_of_the_stored_evaluations(mark):
    text = f"{WRITTEN.format(mark)}\n\n{evaluations.tables()[mark]}\n"
    assert text in evaluations.PAGE.read_text(), "run python -m experiments.pages.evaluations"


def test_the_table_of_the_readme_is_that_of_the_stored_evaluations():
    text = f"{WRITTEN.format('scores')}\n\n" + "\n".join(evaluations.side_by_side()) + "\n"
    assert text in evaluations.README.read_text(), "run python -m experiments.pages.evaluations"


def test_no_other_drawings_lie_there():
    assert {file.stem for file in diagrams.MEDIA.glob("*.svg")} == set(diagrams.DRAWINGS)


def test_an_option_is_a_row():
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", default="192x336", help="of the\n pictures | frames")
    parser.add_argument("--steps", type=int, help="how many (default: the model's own)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--kind", choices=("a", "b"), help="which", required=True)
    parser.add_argument("--debug", action="store_true", help="more")
    assert options.options(parser)[2:] == [
        r"| `--size` | 192x336 | of the pictures \| frames |",
        "| `--steps` | the model's own | how many |",
        "| `--seed` | 0 | of the noise |",
        "| `--kind` | required | which: a, b |",
        "| `--debug` |  | more |",
    ]


CODE = """
LIMIT = 5
def f(path, n):
    hint = did_you_mean(path, LIMIT)
    if n:
        raise UserError(f"{path}: has {n} frames: give at most {LIMIT}.")
    what = f"{len(path)} are left"
    note("warning", what, "restore them")
    raise UserError(f"{path.name}: unknown '{n}': {hint}")
    what = "another"
    def found(what):
        return Finding("error", "here", what, "mend it now")
    warnings.warn(str(n))
"""


def test_messages_are_read_from_code():
    """Values stand in brackets, cause and cure are told apart, names stand for what was assigned to them last."""
    tree = ast.parse(CODE)
    found = messages.of_a_file(tree, "scenes/x.py")
    assert sorted((one.kind, one.cause, one.cure) for one in found) == [
        ("error", "⟨name⟩: unknown '⟨n⟩'", f"⟨{messages.CLOSEST}⟩"),
        ("error", "⟨path⟩: has ⟨n⟩ frames", "give at most 5"),
        ("error", "⟨what⟩", "mend it now"),
        ("warning", "⟨number⟩ are left", "restore them"),
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a.png: damaged: copy it again.", ("a.png: damaged", "copy it again")),
        ("⟨file⟩: not valid", ("⟨file⟩: not valid", "")),
        ("Needs more. Give less.", ("Needs more", "Give less")),
        ("the seed is odd, e.g. 7: write 8", ("the seed is odd, e.g. 7", "write 8")),
        ("a move is {'pan': 2}, not that", ("a move is {'pan': 2}, not that", "")),
    ],
)
def test_cause_and_cure(text, expected):
    assert messages.split(text) == expected


def test_all_kinds_of_sentences_are_in_the_page():
    """Every `UserError` of the package that says something of its own has its row."""
    text = messages.PAGE.read_text()
    assert len(messages.messages()) > 450
    for words in (
        "| No --out given | name the model folder to write",
        "*warning* photos are transparent",
        "*stop* ",
        "features of photo",
        "principal point",
    ):
        assert words in text, words


def test_the_best_is_bold_but_never_a_ceiling():
    record = harness.read("mini_procedural.json")
    lines = evaluations.means(record)
    by_method = {line.split(" | ")[0].strip("| "): line for line in lines[2:]}
    assert "**" not in by_method["*truth through the VAE*"] + by_method["warp by the true depth"]
    assert sum(line.count("**") for line in lines) == 4  # one of PSNR, one of SSIM
