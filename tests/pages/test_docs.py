"""The pages keep up with the code: links and anchors lead somewhere, commands and options exist, charts are listed."""

import argparse
import inspect
import json
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.pages import options as made_options
from roge_jax import check, convert, evaluate, export, pose, sample, train
from roge_jax.files import entry
from roge_jax.procedural import __main__ as procedural_program
from roge_jax.procedural import scenes as procedural

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FIGURES = ROOT / "docs" / "development" / "figures.md"
PARSERS = {
    "check": check,
    "sample": sample,
    "train": train,
    "evaluate": evaluate,
    "convert": convert,
    "export": export,
    "pose": pose,
}


def called(page: Path) -> str:
    return page.relative_to(ROOT).with_suffix("").as_posix()


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as code hosts make them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def commands(text: str) -> list[tuple[str, list[str]]]:
    """(program, words) of every `python -m roge_jax.PROGRAM ...`, up to the end of its line or code span."""
    found = re.findall(r"python -m roge_jax\.(\w+)((?: [^`\n#;]*)?)", text)
    return [(name, shlex.split(re.split(r"\s{3,}", rest, maxsplit=1)[0])) for name, rest in found]


@pytest.mark.parametrize("page", PAGES, ids=called)
def test_links_lead_somewhere(page):
    faults = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists():
            faults.append(link)
        elif anchor and anchor not in anchors(target):
            faults.append(f"{link}: there is {sorted(anchors(target))}")
    assert not faults, faults


@pytest.mark.parametrize("page", PAGES, ids=called)
def test_options_exist(page):
    known = {
        name: {word for action in module.parser()._actions for word in action.option_strings}
        for name, module in PARSERS.items()
    }
    faults = [
        f"{name} {word}"
        for name, words in commands(page.read_text())
        for word in words
        if name in known and word.startswith("--") and word.partition("=")[0] not in known[name]
    ]
    assert not faults, faults


def blocks(text: str) -> list[tuple[str, list[str]]]:
    """Commands of the programs in blocks of code, whole: (program, words)."""
    fences = re.findall(r"^```(?:bash|text)?\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    indented = re.findall(r"^    (.*)$", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M), re.M)
    lines = [line for fence in fences for line in fence.splitlines()] + indented
    found = []
    for line in lines:
        start = re.match(r"\s*(?:taskset -c \d+ )?python -m roge_jax\.([\w.]+)(.*)", line)
        if start and not re.search(r"\[-|\.\.\.| \.\. |SCENE|NAME|MODEL", start[2]):
            words = re.split(r"\s{2,}", start[2], maxsplit=1)[0]  # a remark may follow
            found.append((start[1], shlex.split(words, comments=True)))
    return found


@pytest.mark.parametrize("page", PAGES, ids=called)
def test_commands_are_understood(page):
    """Options, their values and what must be given: every program takes the words as they are printed."""
    programs = {made_options.name(module): module for module in made_options.programs()}
    for name, words in blocks(page.read_text()):
        entry.parse(made_options.parser(programs[name]), words)


def test_many_commands_are_found():
    assert sum(len(blocks(page.read_text())) for page in PAGES) > 40


@pytest.mark.parametrize("page", PAGES, ids=called)
def test_files_named_in_the_text_exist(page):
    pattern = r"(?:experiments|tests|notebooks|roge_jax)/[\w/]+\.(?:py|jsonl?|ipynb|md|png)"
    faults = [name for name in re.findall(pattern, page.read_text()) if not (ROOT / name).exists()]
    expected = {"experiments/results/train_profile.json"}  # written by a command
    assert not set(faults) - expected, faults


def options(parser: argparse.ArgumentParser) -> list[str]:
    """The longest name of every option, those of subcommands too."""
    found = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found += [name for one in action.choices.values() for name in options(one)]
        elif action.option_strings and "--help" not in action.option_strings:
            found.append(action.option_strings[-1])
    return found


@pytest.mark.parametrize("module", list(made_options.programs()), ids=made_options.name)
def test_every_option_is_explained(module):
    """In the section of its program, with words beside it."""
    sections = made_options.PAGE.read_text().split("\n## ")
    text = next(one for one in sections if one.startswith(f"{made_options.name(module)}\n"))
    names = options(made_options.parser(module))
    missing = [name for name in names if not re.search(rf"`{name}`[^|]*\|[^|]*\| \w", text)]
    assert len(names) > 4 and not missing, missing


def test_all_programs_are_found():
    """Those of the tests of this folder, and the two that make their parser on the way."""
    found = {made_options.name(module) for module in made_options.programs()}
    assert {*PARSERS, "data.pack", "procedural"} <= found


def test_the_renderers_benchmark_prints_what_its_page_says(monkeypatch, capsys):
    """24 frames each half a second for five seconds; the first call, which compiles, does not count."""
    clock, cpu, seeds = [0.0], [0.0], []
    real = inspect.signature(procedural.sample_sequence)

    def render(*seed, **options):
        assert real.bind(*seed, **options).arguments["frames"] == 24
        clock[0] += 0.5 if seeds else 60.0
        cpu[0] += 0.25 if seeds else 50.0
        seeds.extend(seed)

    monkeypatch.setattr(procedural, "sample_sequence", render)
    fake = SimpleNamespace(perf_counter=lambda: clock[0], process_time=lambda: cpu[0])
    monkeypatch.setattr(procedural_program, "time", fake)
    assert procedural_program.main(["bench"]) == 0
    printed = json.loads(capsys.readouterr().out)
    rates = printed["first_call_seconds"], printed["frames_per_second"]
    assert rates == (60.0, 48.0) and printed["frames_per_cpu_second"] == 96.0
    text = FIGURES.read_text()
    assert "roge_jax.procedural bench" in text
    assert [name for name in printed if f"`{name}`" not in text] == []


def test_every_chart_and_experiment_can_be_made_again():
    text = FIGURES.read_text()
    charts = [
        *(ROOT / "docs").rglob("*.png"),
        *(ROOT / "docs").rglob("*.svg"),
        *(ROOT / "experiments" / "results").glob("*.png"),
    ]
    programs = [
        f"python -m {'.'.join(file.relative_to(ROOT).with_suffix('').parts)}"
        for file in (ROOT / "experiments").rglob("*.py")
        if '__name__ == "__main__"' in file.read_text()
    ]
    assert len(charts) > 10 and len(programs) > 10
    wanted = [*(chart.name for chart in charts), *programs]
    missing = [name for name in wanted if name.removesuffix(".__main__") not in text]
    assert not missing, missing


def test_every_page_is_listed_in_the_readme():
    text = (ROOT / "README.md").read_text()
    missing = [
        called(page) for page in PAGES[1:] if f"({page.relative_to(ROOT).as_posix()})" not in text
    ]
    assert not missing, missing


def test_every_setting_from_the_environment_is_explained():
    used = set()
    for file in (ROOT / "roge_jax").rglob("*.py"):
        used |= set(re.findall(r'"(ROGE_[A-Z]+)"', file.read_text()))
    text = "".join(page.read_text() for page in PAGES)
    assert used and all(name in text for name in used), used


def test_the_checks_see_faults(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A title: one\n\n`python -m roge_jax.sample --nothing` and more --other\n")
    assert anchors(page) == {"a-title-one"}
    assert commands(page.read_text()) == [("sample", ["--nothing"])]
    page.write_text(
        "```bash\npython -m roge_jax.sample --seed 1 # x\n```\n\n    python -m roge_jax.check a   b\n"
    )
    assert blocks(page.read_text()) == [("sample", ["--seed", "1"]), ("check", ["a"])]
    with pytest.raises(Exception, match="nothing"):
        entry.parse(sample.parser(), ["--nothing"])


# How the help of a shared option begins, in every program that has it.
MEANINGS = {
    "--context": "how many photos",
    "--scale": "divisor of all positions, in units of the scene",
    "--tolerance": "spend no more than this needs",
}


@pytest.mark.parametrize("option", MEANINGS)
def test_an_option_means_the_same_in_every_program(option):
    from roge_jax import view

    helps = {
        name: action.help
        for name, module in (PARSERS | {"view": view}).items()
        for action in module.parser()._actions
        if option in action.option_strings
    }
    assert helps and all(said.startswith(MEANINGS[option]) for said in helps.values()), helps
