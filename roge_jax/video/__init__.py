"""The generation half: VAE, diffusion transformer, flow, samplers."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
