"""Every module with the first sentence of its docstring: docs/reference/api.md.

        python -m experiments.pages.modules

On the site each link leads to a page made of the module's docstrings (`experiments/pages/site.py`). Seconds.
`make docs` runs it, and a test holds the committed page against it.
"""

import ast
import re
from pathlib import Path

from experiments import harness

PAGE = harness.DOCS / "reference" / "api.md"
PACKAGE = harness.ROOT / "roge_jax"
HEAD = """# Modules

Every module, with the first sentence of its docstring. On the site each has a page with all its functions.
[In Python](../howto/library.md) says where to begin.
This page is written from the code by `python -m experiments.pages.modules`.
"""


def first_sentence(path: Path) -> str:
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    first = re.sub(r"\s+", " ", text.split("\n\n")[0])
    short = re.split(r"(?<!Sec)\. |: `python -m", first)[0].rstrip(".") + "."
    return short.replace("|", r"\|").replace("<", "&lt;")


def row(path: Path) -> tuple[str, str]:
    file = path.relative_to(harness.ROOT).as_posix()
    name = path.parent.name if path.name == "__init__.py" else path.stem
    return f"[`{name}`](../../{file})", first_sentence(path)


def page() -> str:
    """Modules at the top, then package by package."""
    lines = [HEAD, "## roge_jax", ""]
    lines += harness.table(["module", "what"], map(row, modules(PACKAGE)))
    for folder in sorted({path.parent for path in PACKAGE.rglob("*.py")} - {PACKAGE}):
        name = folder.relative_to(PACKAGE).as_posix().replace("/", ".")
        lines += [
            "",
            f"## {name}",
            "",
            *harness.table(["module", "what"], map(row, modules(folder))),
        ]
    return "\n".join(lines) + "\n"


def modules(folder: Path) -> list[Path]:
    found = sorted(path for path in folder.glob("*.py") if path.name != "__main__.py")
    return sorted(found, key=lambda path: path.name != "__init__.py")


if __name__ == "__main__":
    PAGE.write_text(page())
    print(PAGE.relative_to(harness.ROOT))
