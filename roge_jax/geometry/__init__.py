"""Cameras, rays, crops, camera paths and how frames become latent slots. No parameters."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
