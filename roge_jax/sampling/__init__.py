"""Making a video: what a run needs, windows of a path, compiled programs, warnings before a run."""

from ..core.lazy import submodules

__getattr__, __dir__ = submodules(
    __name__,
    choices=("Choices", "Planned"),
    photos=("Photos", "blank_scene", "context_ids", "read_photos"),
    windows=("make_views",),
    reconstruction=("encode", "look", "preview"),
    video=(
        "Result",
        "Settings",
        "integrate",
        "noise_levels",
        "reduced",
        "sample",
    ),
)
