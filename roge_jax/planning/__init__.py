"""No more model than a scene needs: what a run may leave out for a tolerance. docs/explanation/planning.md explains it."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
