"""The programs, one line each: `python -m roge_jax`, or `roge` where the package is installed.

roge                           this list
roge sample --scene DIR        the same as python -m roge_jax.sample --scene DIR
"""

import ast
import re
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

from roge_jax.errors import did_you_mean

# In the order in which a user meets them.
PROGRAMS = (
    "sample",
    "pose",
    "check",
    "view",
    "export",
    "evaluate",
    "train",
    "convert",
    "data.pack",
    "procedural",
)
HEAD = """RoGe in JAX: a few posed photos and a camera path in, the video along that path out.

    python -m roge_jax.NAME ...        where the package is installed also: roge NAME ...
"""
FOOT = """
Begin with `python -m roge_jax.sample`, which needs nothing. --help after a name lists its options."""


def summary(name: str) -> str:
    """The first sentence of a program's docstring; nothing is imported for it."""
    place = Path(__file__).parent.joinpath(*name.split("."))
    file = place / "__main__.py" if place.is_dir() else place.with_suffix(".py")
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    first = re.sub(r"\s+", " ", text.split("\n\n")[0])
    return re.split(r"(?<=\.) |: `python", first)[0].rstrip(".")


def listing() -> str:
    """What `python -m roge_jax` prints."""
    width = max(map(len, PROGRAMS))
    return "\n".join([HEAD, *(f"  {name:{width}}  {summary(name)}" for name in PROGRAMS), FOOT])


def main(words: Sequence[str]) -> int:
    """List the programs, or run the one that is named first, exactly as `python -m` does; its exit code leaves."""
    if not words or words[0] in ("-h", "--help", "help"):
        print(listing())
        return 0
    if words[0] == "--version":
        from roge_jax import __version__

        print(f"roge_jax {__version__}")
        return 0
    name = words[0].removeprefix("roge_jax.")
    if name not in PROGRAMS:
        print(f"error: '{words[0]}' is no program: {did_you_mean(name, PROGRAMS)}", file=sys.stderr)
        return 2
    sys.argv[1:] = words[1:]  # argv[0] becomes the program's file
    runpy.run_module(f"roge_jax.{name}", run_name="__main__", alter_sys=True)
    return 0


def cli() -> int:
    """The console script `roge`."""
    return main(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(cli())
