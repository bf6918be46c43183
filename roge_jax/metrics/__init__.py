"""What is measured and what it is compared with. docs/reference/metrics.md defines every number."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
