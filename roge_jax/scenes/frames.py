"""What a reader finds: posed frames, with or without a photo, and what it has to say about them."""

import dataclasses
from pathlib import Path

import numpy as np

from roge_jax.geometry.cameras import to_opencv
from roge_jax.geometry.validation import Finding
from roge_jax.scenes.lens import Lens
from roge_jax.scenes.points import Source

NORMALISED = (1, 1)  # the size of a K that is divided by width and height


@dataclasses.dataclass(frozen=True)
class Frame:
    """One posed camera as a reader found it, with the photo it took if there is one.

    K [3, 3] is in pixels of a picture of `size` (height, width); size None: of the photo as it is, `NORMALISED`:
    divided by width and height. K None: the file says nothing about it. c2w [4, 4] has OpenCV axes.
    name: as users address it, relative to the folder of the photos. cure: how to mend a K for another picture.
    """

    file: Path | None
    K: np.ndarray | None
    c2w: np.ndarray
    size: tuple[int, int] | None = None
    lens: Lens | None = None
    name: str = ""
    cure: str = "correct 'w' and 'h', or do not crop the photo"

    def address(self) -> str:
        """The name to show."""
        return self.name or (self.file.name if self.file else "")


@dataclasses.dataclass
class Reading:
    """Everything that was read from one place.

    frames: those that can be used, in the file's order. missing: names of frames whose photo is not there (they are
    frames too, without a file). notes: what was left out or assumed, one finding each with its count.
    frame: whose coordinates these are: "scene", "nerfstudio" (the normalised ones of its viewer), "first" (relative to
    the first camera) or "unknown". times: of key frames to be joined; count: how many frames they make.
    axes: the convention the poses were read in where the layout leaves it open, else "".
    points: what reads the sparse points that lie beside the poses, if there are any.
    """

    source: Path
    frames: list[Frame]
    missing: list[str] = dataclasses.field(default_factory=list)
    notes: list[Finding] = dataclasses.field(default_factory=list)
    looked: str = ""
    frame: str = "scene"
    fps: float | None = None
    keys: bool = False
    times: np.ndarray | None = None
    count: int | None = None
    axes: str = ""
    dropped: list[Path] = dataclasses.field(default_factory=list)  # photos left out with a note
    registered: str = "have a pose"
    points: Source | None = None

    def note(self, what: str, fix: str, severity: str = "warning") -> None:
        """One finding about this place."""
        self.notes.append(Finding(severity, str(self.source), what, fix))


def in_axes(pose: np.ndarray, convention: str) -> np.ndarray:
    """A pose in OpenCV axes; an unusable one as it is: validation names it together with the others."""
    usable = np.isfinite(pose).all() and abs(np.linalg.det(pose)) > 1e-12
    return to_opencv(pose, convention) if usable else pose
