"""From photos or a video without poses to a scene. `python -m roge_jax.pose`; docs/howto/pose.md explains it."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
