"""The house plan: who may import whom, what may be imported at all, and that importing the package costs nothing."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "roge_jax"
FILES = sorted(PACKAGE.rglob("*.py"))

# One way only. What a unit (a top-level module or folder) may import of the package, itself apart.
_GROUND = {"errors", "files"}
_BASE = _GROUND | {"core", "geometry", "config"}
_PARTS = _BASE | {"recon", "video", "fusion"}
ALLOWED = {
    "errors": set(),
    "core": {"errors"},  # knows nothing of RoGe
    "files": {"errors", "core"},
    "geometry": _GROUND | {"core"},
    "config": _GROUND,
    "recon": _BASE,  # the three networks do not know one another
    "video": _BASE,
    "fusion": _BASE,
    "preview": _PARTS,
    "leaves": _PARTS,
    "model": _PARTS | {"preview", "leaves"},
    "weights": _PARTS,
    "procedural": _BASE,
    "scenes": _BASE | {"procedural"},
    # Neither networks nor metrics; of weights the reader of PyTorch's files alone.
    "data": _BASE | {"procedural", "scenes", "weights"},
    "posing": _BASE | {"scenes"},
    "metrics": _BASE,
    "checkpoint": _PARTS | {"model", "weights"},
    "cost": _PARTS | {"model"},
    "sampling": _PARTS | {"model", "cost", "checkpoint", "scenes", "procedural"},
    "viewer": _PARTS | {"model", "checkpoint", "scenes", "sampling"},
    "planning": _PARTS | {"model", "cost", "scenes", "sampling"},
    "training": _PARTS
    | {"model", "preview", "weights", "procedural", "data", "metrics", "checkpoint", "cost"},
}
# Programs may import anything but other programs; a room's own program is its `__main__`.
PROGRAMS = {"train", "sample", "evaluate", "convert", "export", "check", "view", "pose"}
LIGHT = {
    "jax",
    "ml_dtypes",
    "numpy",
    "flax",
    "optimistix",
    "optax",
    "safetensors",
    "tqdm",
    "roge_jax",
}


def unit(path: Path) -> str:
    """The folder or module directly under the package that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path) -> list[tuple[str, int, bool]]:
    """(absolute dotted name, line, whether it runs when the module is imported) of every import of a file."""
    tree = ast.parse(path.read_text())
    late = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for node in ast.walk(function)
    }
    package = ["roge_jax", *path.relative_to(PACKAGE).parts[:-1]]
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            lead = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*lead, *([node.module] if node.module else [])])
            whole = base == "roge_jax"  # `from . import model` names modules
            names = [f"{base}.{alias.name}" if whole else base for alias in node.names]
        else:
            continue
        found += [(name, node.lineno, id(node) not in late) for name in names]
    return found


def internal(path: Path):
    """(unit, line) of every import from the package, wherever it stands."""
    for name, line, _ in imports(path):
        first, *rest = name.split(".")
        if first == "roge_jax" and rest:
            yield rest[0], line


def test_imports_point_one_way():
    faults = []
    for path in FILES:
        if path.name == "__main__.py":
            continue
        mine = unit(path)
        for other, line in internal(path):
            bad = other in PROGRAMS or (mine in ALLOWED and other not in ALLOWED[mine])
            if bad and other != mine:
                faults.append(f"{path.relative_to(PACKAGE)}:{line} imports {other}")
    assert not faults, "\n".join(faults)


def test_no_two_units_need_each_other():
    """Every unit comes after those that it may import."""
    placed, left = set(), dict(ALLOWED)
    while ready := [name for name, needs in left.items() if needs <= placed]:
        placed |= {name for name in ready if left.pop(name) is not None}
    assert not left, f"in a circle: {sorted(left)}"


def test_former_names_of_functions_are_found_with_a_warning():
    from roge_jax.data import dataset

    with pytest.warns(DeprecationWarning, match="read_pool is read_dataset now"):
        assert dataset.read_pool is dataset.read_dataset
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = dataset.nothing


def test_former_names_are_found_with_a_warning():
    """Modules that have moved are the same modules, as imports, attributes and programs."""
    from roge_jax.core.lazy import MOVED

    code = (
        "import importlib, warnings; warnings.simplefilter('always')\n"
        f"for old, new in {MOVED!r}.items():\n"
        "    with warnings.catch_warnings(record=True) as said:\n"
        "        module = importlib.import_module(f'roge_jax.{old}')\n"
        "    assert module is importlib.import_module(f'roge_jax.{new}') and module.__spec__.name.endswith(new)\n"
        "    assert f'{new} now' in str(said[0].message), old\n"
        "import roge_jax as rj; assert rj.data.perturb is rj.data.faults\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    command = [sys.executable, "-m", "roge_jax.data.procedural", "sheet", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "roge_jax.procedural sheet" in done.stdout, done.stderr


def test_the_plan_names_every_unit():
    """A new module has to be placed: below in the table, or among the programs and their helpers."""
    units = {unit(path) for path in FILES} - {"__init__", "__main__", "assets"}
    assert units <= set(ALLOWED) | PROGRAMS
    assert set(ALLOWED) <= units


def test_heavy_packages_are_imported_where_they_are_used():
    faults = []
    for path in FILES:
        for name, line, at_import in imports(path):
            first = name.split(".")[0]
            if at_import and first not in LIGHT and first not in sys.stdlib_module_names:
                faults.append(f"{path.relative_to(PACKAGE)}:{line} imports {name} at its top")
    assert not faults, "\n".join(faults)


def test_the_rules_see_what_they_should(tmp_path, monkeypatch):
    """Against a test that cannot fail: a made-up package that breaks each rule."""
    package = tmp_path / "roge_jax"
    (package / "core").mkdir(parents=True)
    file = package / "core" / "bad.py"
    file.write_text(
        "from ..model import loss\nfrom . import params\nfrom .. import video\nimport cv2\n\n\n"
        "def f():\n    import scipy\n    from roge_jax.train import main\n"
    )
    monkeypatch.setitem(globals(), "PACKAGE", package)
    assert set(internal(file)) == {("model", 1), ("core", 2), ("video", 3), ("train", 9)}
    assert [(name, top) for name, _, top in imports(file)][3:] == [
        ("cv2", True),
        ("scipy", False),
        ("roge_jax.train", False),
    ]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_keep_to_one_subject(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 440, "split it: a file this long has two subjects"
    assert "from __future__ import annotations" not in text
    assert path.name != "utils.py"


def test_importing_the_package_is_free():
    code = (
        "import sys, time; t = time.process_time(); import roge_jax; t = time.process_time() - t; "
        "assert t < 1.0, t; assert 'jax' not in sys.modules; print(sorted(dir(roge_jax)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "load" in done.stdout


def test_the_public_names_exist():
    import roge_jax

    for name in roge_jax.__all__:
        assert getattr(roge_jax, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = roge_jax.nothing


def test_modules_of_packages_are_there_without_importing_them():
    code = (
        "import roge_jax as rj; assert 'image' in dir(rj.metrics); rj.metrics.image.psnr; rj.data.faults.blur; "
        "rj.video.testbed.delta; assert not hasattr(rj.metrics, 'nothing')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_text_is_utf8_whatever_the_locale():
    """A name with accents in a file that is written at the end of a run must not depend on LC_ALL."""
    faults = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            first = (
                node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else ""
            )
            text = node.func.attr in ("read_text", "write_text") or (
                node.func.attr == "open" and first in ("r", "w", "a", "x")
            )
            said = any(word.arg == "encoding" for word in node.keywords)
            by_place = node.func.attr == "read_text" and node.args  # ours, of `files.fields`
            if text and not said and not by_place:
                faults.append(f"{path.relative_to(PACKAGE)}:{node.lineno}")
    assert not faults, faults
