"""Ground under every network: parameters and their specs, layers, attention, LoRA, sharding. Knows nothing of RoGe."""

from .lazy import submodules

__getattr__, __dir__ = submodules(__name__)
