"""The generation half: VAE, diffusion transformer, flow, samplers."""

from ..lazy import submodules

__getattr__, __dir__ = submodules(__name__)
