"""Looking at a scene in a browser: levels of detail, who gets the next picture, key frames, runs; `page` alone knows viser."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
