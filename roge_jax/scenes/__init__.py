"""The user's photos and cameras: readers of every layout, camera paths, matching, overlap."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
