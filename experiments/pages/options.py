"""Every option of every program, from the parsers themselves: docs/reference/programs.md. And of every preset path:
the table of docs/howto/paths.md.

        python -m experiments.pages.options

Seconds. `make docs` runs it, and a test holds the committed page against it.
"""

import argparse
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from contextlib import ExitStack
from types import ModuleType
from unittest import mock

import roge_jax
from experiments import harness

PAGE, PATHS = harness.DOCS / "reference" / "programs.md", harness.DOCS / "howto" / "paths.md"
HEAD = """# Programs and their options

Every program is a module: `python -m roge_jax.NAME`, or `roge NAME` where the package is installed. `python -m roge_jax` lists them.
Give `--help` for the same options on a terminal.
This page is written from the programs by `python -m experiments.pages.options`.

A mistake is one sentence, and the exit code is 2. [All sentences](messages.md) have a page of their own.
Code 0 means done. Code 1 means that the computation stopped, and 130 that you stopped it.
"""
DEFAULT = re.compile(r"\s*\((?:default: )((?:[^()]|\([^()]*\))*)\)")
BLOCK = re.compile(r"(?:^    \S.*\n?)+", re.MULTILINE)


def programs() -> Iterator[ModuleType]:
    """Modules that people run: those whose last lines say so, and that take options."""
    for found in pkgutil.walk_packages(roge_jax.__path__, "roge_jax."):
        spec = importlib.util.find_spec(found.name)
        if spec is None or not (spec.origin or "").endswith(".py"):
            continue
        source = spec.loader.get_source(found.name)  # type: ignore[union-attr]
        if re.search(r'^if __name__ == "__main__":$', source, re.MULTILINE):
            module = importlib.import_module(found.name)
            if hasattr(module, "parser") or hasattr(module, "execute"):
                yield module


def parser(module: ModuleType) -> argparse.ArgumentParser:
    """The options of a program, also of one that makes its parser on the way."""
    if hasattr(module, "parser"):
        return module.parser()
    found: list[argparse.ArgumentParser] = []
    with ExitStack() as stack:
        keep = lambda main, parser, arguments=None: found.append(parser) or 0  # noqa: E731
        stack.enter_context(mock.patch.object(module, "execute", keep))
        module.main([])
    return found[0]


def name(module: ModuleType) -> str:
    return module.__name__.removeprefix("roge_jax.").removesuffix(".__main__")


def row(action: argparse.Action) -> tuple[str, str, str]:
    """(option, default, meaning) of one option."""
    help = re.sub(r"\s+", " ", action.help or "").strip()
    told = DEFAULT.search(help)
    help = DEFAULT.sub("", help)
    if told:
        default = told[1]
    elif action.required:
        default = "required"
    elif action.nargs == 0 or action.default in (None, "", 0, argparse.SUPPRESS):
        default = "" if action.default != 0 or action.nargs == 0 else "0"
    else:
        default = (
            " ".join(map(str, action.default))
            if isinstance(action.default, tuple | list)
            else str(action.default)
        )
    if action.choices and not isinstance(action, argparse._SubParsersAction):
        missing = [str(choice) for choice in action.choices if str(choice) not in help]
        help += f": {', '.join(map(str, action.choices))}" if missing else ""
    words = ", ".join(f"`{word}`" for word in action.option_strings) or f"`{action.dest}`"
    return words, escaped(default), escaped(help)


def escaped(text: str) -> str:
    return text.replace("|", r"\|").replace("<", "&lt;")


def options(parser: argparse.ArgumentParser) -> list[str]:
    """The table of one parser."""
    shown = [
        action
        for action in parser._actions
        if not isinstance(action, argparse._HelpAction | argparse._SubParsersAction)
    ]
    return harness.table(["option", "default", "meaning"], map(row, shown))


def section(module: ModuleType) -> list[str]:
    """A program: its first sentence, its examples, its options."""
    found, called = parser(module), f"python -m roge_jax.{name(module)}"
    text = inspect.getdoc(module) or ""
    lines = [f"## {name(module)}", "", sentence(text), ""]
    if examples := [
        block.group().rstrip() for block in BLOCK.finditer(text) if called in block.group()
    ]:
        lines += ["```text", inspect.cleandoc("\n".join(examples)), "```", ""]
    for action in found._actions:
        if isinstance(action, argparse._SubParsersAction):
            helps = {choice.dest: choice.help for choice in action._choices_actions}
            for command, one in action.choices.items():
                lines += [
                    f"### {name(module)} {command}",
                    "",
                    sentence(str(helps.get(command))).capitalize(),
                    "",
                    *options(one),
                    "",
                ]
            return lines
    return [*lines, *options(found), ""]


def sentence(text: str) -> str:
    """The first sentence, without the call that follows it."""
    first = re.sub(r"\s+", " ", text.split("\n\n")[0])
    return re.split(r"(?<=\.) |: `python", first)[0].rstrip(".") + "."


def page() -> str:
    found = sorted(programs(), key=lambda module: ("." in name(module), name(module)))
    index = ", ".join(f"[{name(one)}](#{name(one).replace('.', '')})" for one in found)
    return (
        "\n".join(
            [HEAD, f"Programs: {index}.", "", *(line for one in found for line in section(one))]
        ).rstrip()
        + "\n"
    )


def presets() -> str:
    """The table of preset paths: options with their defaults, and what the camera does."""
    from roge_jax.geometry.trajectories import PRESETS

    rows = []
    for name, preset in PRESETS.items():
        given = list(inspect.signature(preset).parameters.values())[2:]
        shown = ", ".join(f"`{one.name}={_spelled(one.default)}`" for one in given)
        rows.append(
            (f"`{name}`", shown, inspect.getdoc(preset).replace("\n\n", " ").replace("\n", " "))
        )  # type: ignore[union-attr]
    return "\n".join(harness.table(["preset", "options", "the camera moves"], rows))


def _spelled(value: object) -> str:
    """As the command line has it; None is a choice that depends on the rest."""
    return (
        "true or false"
        if value is None
        else f"{value:g}"
        if isinstance(value, float)
        else str(value)
    )


if __name__ == "__main__":
    harness.put(PATHS, "presets", presets())
    PAGE.write_text(page())
    print(PAGE.relative_to(harness.ROOT))
