"""Packages whose modules are imported on first use, and names that have moved.

`rj.metrics.image` works and `import roge_jax` stays free. Modules at their names of version 0.1.0 are still found, with
a DeprecationWarning; they go with the next release.
"""

import importlib
import importlib.abc
import importlib.machinery
import pkgutil
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any

MOVED = {
    "choices": "sampling.choices",
    "data.colmap": "scenes.colmap",
    "data.coverage": "scenes.coverage",
    "data.images": "scenes.images",
    "data.layout": "procedural.layout",
    "data.matching": "scenes.matching",
    "data.overlap": "scenes.overlap",
    "data.perturb": "data.faults",
    "data.pool": "data.dataset",
    "data.procedural": "procedural.scenes",
    "data.raycast": "procedural.raycast",
    "data.readers": "scenes.readers",
    "data.scene": "scenes.scene",
    "data.textures": "procedural.textures",
    "entry": "files.entry",
    "fields": "files.fields",
    "folders": "files.folders",
    "geometry.paths": "scenes.paths",
    "inputs": "sampling.inputs",
    "lazy": "core.lazy",
    "limits": "sampling.limits",
    "programs": "sampling.programs",
    "scene_limits": "sampling.scene_limits",
    "video_io": "files.video_io",
    "windows": "sampling.windows",
}
_ROOT = __name__.split(".")[0]


def submodules(
    package: str, **public: Sequence[str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package: its modules are attributes of it, and so are `public` names of them.

    __getattr__, __dir__ = submodules(__name__, video=("sample",))
    """
    home = {name: module for module, names in public.items() for name in names}

    def load(name: str) -> Any:
        if name in home:
            return getattr(importlib.import_module(f"{package}.{home[name]}"), name)
        if name in modules() or f"{package}.{name}".removeprefix(f"{_ROOT}.") in MOVED:
            return importlib.import_module(f"{package}.{name}")
        raise AttributeError(f"module '{package}' has no attribute '{name}'")

    def modules() -> list[str]:
        return [module.name for module in pkgutil.iter_modules(sys.modules[package].__path__)]

    return load, lambda: sorted([*modules(), *home])


def renamed(module: str, **names: str) -> Callable[[str], Any]:
    """`__getattr__` of a module that still finds names by what they were called before, with a DeprecationWarning.

    __getattr__ = renamed(__name__, read_pool="read_dataset")
    """

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module '{module}' has no attribute '{name}'")
        said = f"{module}.{name} is {names[name]} now."
        warnings.warn(said, DeprecationWarning, stacklevel=2)
        return getattr(sys.modules[module], names[name])

    return find


class Moved(importlib.abc.MetaPathFinder, importlib.abc.InspectLoader):
    """Finds modules at their former names: `roge_jax.data.scene` is `roge_jax.scenes.scene`, one and the same module."""

    def find_spec(self, fullname, path=None, target=None):
        if fullname.removeprefix(f"{_ROOT}.") not in MOVED:
            return None
        return importlib.machinery.ModuleSpec(fullname, self)

    def create_module(self, spec):
        module = importlib.import_module(_moved(spec.name))
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module):
        """It ran where it lives; the import system has only put the alias into its `__spec__`."""
        module.__spec__ = module.__spec__.loader_state

    def get_source(self, fullname):
        """`python -m` with a former name runs the program of the room that the module lives in."""
        room = _moved(fullname).rpartition(".")[0]
        return f"import runpy\nrunpy.run_module({room!r}, run_name='__main__', alter_sys=True)\n"


def _moved(name: str) -> str:
    new = f"{_ROOT}.{MOVED[name.removeprefix(f'{_ROOT}.')]}"
    warnings.warn(f"{name} is {new} now.", DeprecationWarning, stacklevel=2)
    return new
