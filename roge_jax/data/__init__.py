"""Training data: datasets of sequences, their readers, samples of views, faults that photos have."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
