"""The reconstruction half: camera-conditioned VGGT and the ray-scene transformer."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
