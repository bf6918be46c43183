"""Making a video: what a run needs, windows of a path, compiled programs, warnings before a run."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(
    __name__,
    choices=("Choices", "Planned"),
    video=(
        "Photos",
        "Result",
        "Settings",
        "blank_scene",
        "context_ids",
        "integrate",
        "noise_levels",
        "read_photos",
        "reduced",
        "sample",
    ),
)
