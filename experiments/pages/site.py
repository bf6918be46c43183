"""What the site adds to docs/: hooks of MkDocs (`make docs`).

Pages link to files of the repository, as a code host wants it. Here README.md becomes the home page, a module of
roge_jax becomes a page made of its docstrings, and every other file that a page links to comes along. In `nav` a folder
stands for its pages: those that `ORDER` names, then the rest by name.
"""

import json
import os
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
HOME, API, COPIES = "index.md", "reference/api", "files"
ORDER = {
    "start": ["first_video", "own_photos", "published_weights"],
    "howto": ["paths", "viewer", "pose", "size_and_length", "cost", "training", "gpus"],
    "explanation": ["method", "conventions", "rendering", "long_paths", "planning"],
    "reference": ["programs", "messages", "warnings", "formats", "samplers", "stages"],
    "results": ["model_card", "speed", "solvers", "training", "robustness"],
}
LINK = re.compile(r"(\[(?:`(?P<name>[\w.]+)`)?[^\]]*\])\((?P<to>[^)\s]+)\)")
FENCED = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
FENCES = {".py": "python", ".json": "json", ".jsonl": "json", ".toml": "toml"}


# ---- where things lie on the site ----------------------------------------------------------------


def place(file: str) -> str:
    """The site's page (or file) for a file of the repository."""
    if file == "README.md":
        return HOME
    if file.startswith("docs/"):
        return file.removeprefix("docs/")
    if file.startswith("roge_jax/") and file.endswith(".py"):
        return api_page(file)
    return f"{COPIES}/{file}" + ("" if Path(file).suffix in (".png", ".webp", ".svg") else ".md")


def api_page(file: str) -> str:
    """Of a module; a package's is the index of its folder."""
    inside = file.removeprefix("roge_jax/").removesuffix(".py")
    return f"{API}/{re.sub(r'__init__$', 'index', inside)}.md"


def module(file: str) -> str:
    return file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def linked(text: str, source: str) -> list[str]:
    """Files of the repository that a page links to."""
    prose = FENCED.sub("", text)
    found = [target(match["to"], source)[0] for match in LINK.finditer(prose)]
    return [file for file in found if file]


def target(link: str, source: str) -> tuple[str, str]:
    """(file of the repository, anchor) of a link; no file if it leaves the repository or stays on the page."""
    path, _, anchor = link.partition("#")
    if not path or "://" in link:
        return "", anchor
    return os.path.normpath(Path(source).parent / path), anchor


def moved(text: str, source: str) -> str:
    """The text with links as the site has them."""
    here = Path(place(source)).parent

    def link(match: re.Match) -> str:
        file, anchor = target(match["to"], source)
        if not file:
            return match[0]
        there = place(file)
        if there.startswith(API) and match["name"] and defines(file, match["name"]):
            anchor = f"{module(file)}.{match['name']}"
        there = os.path.relpath(there, here) + (f"#{anchor}" if anchor else "")
        return f"{match[1]}({there})"

    parts = FENCED.split(text)  # code stays as it is
    return "".join(part if part.startswith("```") else LINK.sub(link, part) for part in parts)


def defines(file: str, name: str) -> bool:
    """Whether a module has this function, class or constant at its top."""
    pattern = rf"^(?:def |class |)({re.escape(name)})\b(?:\(|:| =)"
    return re.search(pattern, (ROOT / file).read_text(), re.MULTILINE) is not None


# ---- pages that are made -------------------------------------------------------------------------


def api_pages() -> dict[str, str]:
    """{page: text} of every module; its docstrings follow from one directive."""
    pages = {}
    for path in sorted((ROOT / "roge_jax").rglob("*.py")):
        file = path.relative_to(ROOT).as_posix()
        pages[api_page(file)] = f"# {module(file)}\n\n::: {module(file)}\n"
    return pages


def copy(file: str) -> str:
    """A text file as a page; a notebook with its pictures."""
    text = (ROOT / file).read_text()
    if file.endswith(".ipynb"):
        return notebook(text)
    if file.endswith(".md"):
        return moved(text, file)
    fence = FENCES.get(Path(file).suffix, "text")
    return f"# {file}\n\n````{fence}\n{text}\n````\n"


def notebook(text: str) -> str:
    """The cells of a notebook with their stored outputs."""
    parts = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                parts.append(f"![output](data:image/png;base64,{data['image/png'].strip()})")
            elif said := "".join(output.get("text", data.get("text/plain", []))):
                parts.append(f"```text\n{said.rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


# ---- hooks ---------------------------------------------------------------------------------------


def on_config(config: Any) -> Any:
    config.nav = [{title: shelf(where) for title, where in one.items()} for one in config.nav]
    return config


def shelf(where: str) -> Any:
    """A page, or the pages of a folder in their order."""
    if not where.endswith("/"):
        return where
    folder = where.rstrip("/")
    names = [page.stem for page in sorted((ROOT / "docs" / folder).glob("*.md"))]
    first = [name for name in ORDER.get(folder, []) if name in names]
    pages: list[Any] = [
        f"{folder}/{name}.md" for name in [*first, *(n for n in names if n not in first)]
    ]
    return [*pages, {"API": api_nav()}] if folder == "reference" else pages


def api_nav() -> list[Any]:
    """The modules by room."""
    rooms: dict[str, list[str]] = {}
    for page in api_pages():
        inside = page.removeprefix(f"{API}/")
        rooms.setdefault(inside.rpartition("/")[0], []).append(page)
    first = sorted(rooms.pop(""), key=lambda page: not page.endswith("index.md"))
    index = lambda page: not page.endswith("index.md")  # noqa: E731
    return [*first, *({room: sorted(pages, key=index)} for room, pages in rooms.items())]


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    made = {HOME: moved((ROOT / "README.md").read_text(), "README.md")} | api_pages()
    sources = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    asked = {
        file
        for page in sources
        for file in linked(page.read_text(), page.relative_to(ROOT).as_posix())
    }
    for file in sorted(asked):
        there = place(file)
        if not there.startswith(f"{COPIES}/") or not (ROOT / file).is_file():
            continue
        if there.endswith(".md"):
            made[there] = copy(file)
        else:
            files.append(File.generated(config, there, abs_src_path=str(ROOT / file)))
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Pages of docs/ lie where they lay; the made ones are ready."""
    own = ROOT / "docs" / page.file.src_uri
    return moved(markdown, f"docs/{page.file.src_uri}") if own.exists() else markdown
