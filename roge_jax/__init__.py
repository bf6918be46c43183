"""RoGe in JAX: a few posed photos and a camera path in, the video along that path out.

    import roge_jax as rj
    params, config = rj.load("mini")

docs/howto/library.md shows the rest. Modules are imported on first use, so that `import roge_jax` costs nothing.
"""

import importlib
import sys

from .core.lazy import Moved

__version__ = "0.1.0"

_PUBLIC = {
    "load": ("checkpoint", "load_model"),
    "save": ("checkpoint", "save_model"),
    "preset": ("config", "preset"),
    "RoGeConfig": ("config", "RoGeConfig"),
    "Cameras": ("geometry.cameras", "Cameras"),
    "Scene": ("scenes.scene", "Scene"),
    "load_scene": ("scenes.scene", "load_scene"),
    "make_path": ("geometry.trajectories", "make_path"),
    "load_path": ("scenes.paths", "load_path"),
    "save_path": ("scenes.paths", "save_path"),
    "plan": ("planning.plan", "plan"),
    "step_through": ("core.stepping", "step_through"),
    "UserError": ("errors", "UserError"),
}
_MODULES = (
    "model",
    "config",
    "checkpoint",
    "sampling",
    "fusion",
    "preview",
    "cost",
    "core",
    "geometry",
    "recon",
    "video",
    "scenes",
    "procedural",
    "data",
    "files",
    "metrics",
    "planning",
    "posing",
    "training",
    "weights",
)

sys.meta_path.append(Moved())

__all__ = ["__version__", *_MODULES, *_PUBLIC]


def __getattr__(name: str):
    if name in _PUBLIC:
        module, attribute = _PUBLIC[name]
        return getattr(importlib.import_module(f".{module}", __name__), attribute)
    if name in _MODULES:
        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module 'roge_jax' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
