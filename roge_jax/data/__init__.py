"""Photos and training data: scene readers, procedural scenes, training samples."""

from ..lazy import submodules

__getattr__, __dir__ = submodules(__name__)
