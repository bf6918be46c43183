"""Rendered scenes: random layouts, textures, a ray caster with exact depth, smooth camera paths."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
