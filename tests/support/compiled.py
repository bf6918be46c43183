"""Functions under test as one compiled program each.

Called as they are, every small operation of theirs is compiled by itself, some 20 ms and 1.5 MB each: a test of ten
lines waits for a hundred programs.
"""

import inspect
from types import ModuleType
from typing import Any

import jax
import numpy as np


def compiled(what: Any) -> Any:
    """A function whose arrays are traced and whose other arguments are fixed; or a module, with all its functions so.

    What comes back are NumPy arrays, so that the test's own arithmetic compiles nothing either. Calls alike in all but the arrays' values share a program. Without arrays, or inside a trace, the function is called
    as it is.
    """
    return _Module(what) if isinstance(what, ModuleType) else _compiled(what)


class _Module:
    def __init__(self, module: ModuleType):
        self._module, self._functions = module, {}

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._module, name)
        if not inspect.isfunction(found):
            return found
        if self._functions.get(name, (None,))[0] is not found:  # not a monkeypatched one's
            self._functions[name] = found, _compiled(found)
        return self._functions[name][1]


def _compiled(function):
    programs: dict[Any, Any] = {}

    def run(*args: Any, **options: Any) -> Any:
        leaves, tree = jax.tree.flatten((args, options))
        if any(isinstance(x, jax.core.Tracer) for x in leaves):
            return function(*args, **options)
        traced = [isinstance(x, np.ndarray | np.floating | jax.Array) for x in leaves]
        if not any(traced):
            return function(*args, **options)
        fixed = tuple(None if is_array else x for x, is_array in zip(leaves, traced))
        key = tree, tuple(traced), fixed
        if key not in programs:

            def whole(arrays):
                given = iter(arrays)
                both = [next(given) if is_array else x for x, is_array in zip(fixed, traced)]
                args, options = jax.tree.unflatten(tree, both)
                return function(*args, **options)

            programs[key] = jax.jit(whole)
        found = programs[key]([x for x, is_array in zip(leaves, traced) if is_array])
        return jax.device_get(found)

    return run
