"""The site: links of the pages become links of the site, and all of it builds without a warning (slow: `make docs`)."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.pages import site

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("README.md", "index.md"),
        ("docs/start/own_photos.md", "start/own_photos.md"),
        ("roge_jax/model.py", "reference/api/model.md"),
        ("roge_jax/core/__init__.py", "reference/api/core/index.md"),
        ("experiments/results/ablation.png", "files/experiments/results/ablation.png"),
        ("notebooks/from_rays_to_video.ipynb", "files/notebooks/from_rays_to_video.ipynb.md"),
    ],
)
def test_every_file_has_its_place(file, expected):
    assert (ROOT / file).exists() and site.place(file) == expected


def test_links_are_those_of_the_site():
    """Relative ones move; pages, anchors, other sites and code stay."""
    text = (
        "[a](../../README.md) [`loss`](../../roge_jax/model.py) [`model.py`](../../roge_jax/model.py)\n"
        "[b](own_photos.md#1-take-photos) [c](#here) [d](https://x.org/y.md) ![e](../media/axes.svg)\n"
        "```python\nx[0](../../README.md)\n```\n"
    )
    assert site.moved(text, "docs/start/first_video.md") == (
        "[a](../index.md) [`loss`](../reference/api/model.md#roge_jax.model.loss) "
        "[`model.py`](../reference/api/model.md)\n"
        "[b](own_photos.md#1-take-photos) [c](#here) [d](https://x.org/y.md) ![e](../media/axes.svg)\n"
        "```python\nx[0](../../README.md)\n```\n"
    )
    assert site.moved("[x](docs/howto/cost.md)", "README.md") == "[x](howto/cost.md)"
    assert site.linked(text, "docs/start/first_video.md") == [
        "README.md",
        "roge_jax/model.py",
        "roge_jax/model.py",
        "docs/start/own_photos.md",
        "docs/media/axes.svg",
    ]


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda p: p.stem)
def test_functions_that_pages_name_are_there(page):
    """A link to a module whose text is a name leads to that name."""
    for name, link in re.findall(r"\[`(\w+)`\]\(([^)#]+\.py)\)", page.read_text()):
        file = (page.parent / link).resolve()
        module = name in (file.stem, file.parent.name)
        assert module or site.defines(file.relative_to(ROOT).as_posix(), name), f"{link}: {name}"


def test_modules_that_pages_link_to_have_a_page():
    """Programs of packages (`__main__.py`) too."""
    made = site.api_pages()
    linked = {
        file
        for page in (ROOT / "docs").rglob("*.md")
        for file in site.linked(page.read_text(), page.relative_to(ROOT).as_posix())
        if file.startswith("roge_jax/") and file.endswith(".py")
    }
    missing = sorted(file for file in linked if site.api_page(file) not in made)
    assert len(linked) > 50 and not missing, missing


def test_a_folder_in_the_navigation_is_its_pages_in_order():
    start = site.shelf("start/")
    assert start[:3] == [f"start/{name}.md" for name in site.ORDER["start"]]
    for folder in (path for path in (ROOT / "docs").iterdir() if any(path.glob("*.md"))):
        listed = [page for page in site.shelf(f"{folder.name}/") if isinstance(page, str)]
        assert sorted(listed) == sorted(f"{folder.name}/{p.name}" for p in folder.glob("*.md"))
    assert site.shelf("index.md") == "index.md"
    assert sum(len(room) if isinstance(room, list) else 1 for room in site.api_nav()) > 10


def test_notebooks_become_pages_with_their_pictures():
    cells = [
        {"cell_type": "markdown", "source": ["# A\n", "b"]},
        {
            "cell_type": "code",
            "source": ["print(1)"],
            "outputs": [{"text": ["1\n"]}, {"data": {"image/png": "AAAA\n"}}],
        },
    ]
    text = site.notebook(json.dumps({"cells": cells}))
    parts = ["# A\nb", "```python\nprint(1)\n```", "```text\n1\n```"]
    assert text == "\n\n".join([*parts, "![output](data:image/png;base64,AAAA)"]) + "\n"


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    wanted = ("mkdocs", "material", "mkdocstrings")
    if any(importlib.util.find_spec(name) is None for name in wanted):
        pytest.skip("needs the extra 'docs'")
    out = tmp_path / "site"
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    for page in (ROOT / "docs").rglob("*.md"):
        assert (out / page.relative_to(ROOT / "docs").with_suffix(".html")).exists(), page
    home = (out / "index.html").read_text()
    assert "media/hero.webp" in home and "start/first_video.html" in home
    assert 'id="roge_jax.model.loss"' in (out / "reference/api/model.html").read_text()
    method = (out / "explanation/method.html").read_text()
    assert "../reference/api/model.html#roge_jax.model.loss" in method
    loaded = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?://[^"]+)"', home)
    assert not loaded, loaded  # nothing comes from elsewhere
