"""Published weights: the only place that knows the names of other code. docs/reference/weights.md explains it."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
