"""The pages keep up with the code: links and anchors lead somewhere, commands and options exist, charts are listed."""

import argparse
import inspect
import json
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from roge_jax import check, convert, evaluate, export, pose, sample, train
from roge_jax.data import pack
from roge_jax.files import entry
from roge_jax.procedural import __main__ as procedural_program
from roge_jax.procedural import scenes as procedural

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "howto").glob("*.md")),
]
PARSERS = {
    "check": check,
    "sample": sample,
    "train": train,
    "evaluate": evaluate,
    "convert": convert,
    "export": export,
    "pose": pose,
}


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as code hosts make them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def commands(text: str) -> list[tuple[str, list[str]]]:
    """(program, words) of every `python -m roge_jax.PROGRAM ...`, up to the end of its line or code span."""
    found = re.findall(r"python -m roge_jax\.(\w+)((?: [^`\n#;]*)?)", text)
    return [(name, shlex.split(re.split(r"\s{3,}", rest, maxsplit=1)[0])) for name, rest in found]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_named_in_the_text_exist(page):
    pattern = r"(?:experiments|tests|notebooks|roge_jax)/[\w/]+\.(?:py|jsonl?|ipynb|md|png)"
    faults = [name for name in re.findall(pattern, page.read_text()) if not (ROOT / name).exists()]
    expected = {"experiments/results/train_profile.json"}  # written by a command
    assert not set(faults) - expected, faults


def parser_of(module, monkeypatch) -> argparse.ArgumentParser:
    """The options of a program, also of one that makes its parser on the way."""
    if hasattr(module, "parser"):
        return module.parser()
    found = []
    monkeypatch.setattr(module, "execute", lambda run, parser, arguments: found.append(parser) or 0)
    assert module.main([]) == 0
    return found[0]


def options(parser: argparse.ArgumentParser) -> list[str]:
    """The longest name of every option, those of subcommands too."""
    found = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found += [name for one in action.choices.values() for name in options(one)]
        elif action.option_strings and "--help" not in action.option_strings:
            found.append(action.option_strings[-1])
    return found


@pytest.mark.parametrize(
    ("module", "pages"),
    [
        (sample, ["sampling"]),
        (train, ["training", "scaling"]),
        (evaluate, ["metrics"]),
        (convert, ["weights"]),
        (export, ["weights"]),
        (check, ["own_photos"]),
        (pose, ["howto/pose"]),
        (pack, ["own_photos"]),
        (procedural_program, ["figures"]),  # python -m roge_jax.procedural
    ],
    ids=lambda x: x.__name__.rpartition(".")[2] if inspect.ismodule(x) else "",
)
def test_every_option_is_explained(module, pages, monkeypatch):
    text = "".join((ROOT / "docs" / f"{page}.md").read_text() for page in pages)
    names = options(parser_of(module, monkeypatch))
    missing = [name for name in names if f"`{name}`" not in text]
    assert len(names) > 4 and not missing, missing


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
    text = (ROOT / "docs" / "figures.md").read_text()
    assert "roge_jax.procedural bench" in text
    assert [name for name in printed if f"`{name}`" not in text] == []


def test_every_chart_and_experiment_can_be_made_again():
    text = (ROOT / "docs" / "figures.md").read_text()
    charts = [*(ROOT / "docs").glob("*.png"), *(ROOT / "experiments" / "results").glob("*.png")]
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
        page.name
        for page in PAGES[1:]
        if page.parent.name == "docs" and f"docs/{page.name}" not in text
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
    with pytest.raises(Exception, match="nothing"):
        entry.parse(sample.parser(), ["--nothing"])
