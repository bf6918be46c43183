"""Training: optimisers, the stages and their losses, the loop that survives bad steps and restarts."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
