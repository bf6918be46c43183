"""Packages whose modules are imported on first use: `rj.metrics.image` works, `import roge_jax` stays free."""

import importlib
import pkgutil
import sys
from collections.abc import Callable
from types import ModuleType


def submodules(package: str) -> tuple[Callable[[str], ModuleType], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package: its modules are attributes of it.

    __getattr__, __dir__ = submodules(__name__)
    """

    def load(name: str) -> ModuleType:
        if name in names():
            return importlib.import_module(f"{package}.{name}")
        raise AttributeError(f"module '{package}' has no attribute '{name}'")

    def names() -> list[str]:
        return [module.name for module in pkgutil.iter_modules(sys.modules[package].__path__)]

    return load, names
