"""What programs read and write: command lines, fields with checks, whole output folders, videos."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(__name__)
