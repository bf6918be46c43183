"""From what a file says about a camera to the camera of the picture that is shown: size, orientation, scale of K, lens.

Photos and paths come through here alike, so that a path that is the scene's own file films the scene's own cameras.
"""

import dataclasses

import numpy as np

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import scale_K, turn
from roge_jax.geometry.validation import Finding
from roge_jax.scenes.frames import NORMALISED, Frame
from roge_jax.scenes.images import QUARTER_TURNS, Header, Photo, read_header
from roge_jax.scenes.lens import straighten

LITTLE_LEFT = 0.75  # share of a photo that straightening keeps, below which it is told
STRETCHED = 3.0  # enlargement within one photo that no lens but a fisheye needs
DRAWN_HEIGHT = 1080  # of pictures of normalised intrinsics, of which nobody says the size


@dataclasses.dataclass(frozen=True)
class Posed:
    """The camera of one shown picture: K [3, 3] in pixels of `size` (None: unknown), c2w [4, 4], its photo if any."""

    K: np.ndarray
    c2w: np.ndarray
    size: tuple[int, int] | None
    photo: Photo | None
    notes: tuple[Finding, ...] = ()


def pose_frame(frame: Frame, source: str, *, exif: str = "auto", background: float = 1.0) -> Posed:
    """What `frame` shows once its photo is turned upright and straightened. K must be known.

    Raises: UserError naming the photo.
    """
    notes: list[Finding] = []

    def note(severity: str, what: str, fix: str) -> None:
        notes.append(Finding(severity, source, what, fix))

    assert frame.K is not None
    if frame.file is None:
        return _without_photo(frame, source)
    header = read_header(frame.file)
    use_tag, turns = _orientation(header, frame, exif)
    size = header.displayed if use_tag else header.stored
    K, c2w = _fit_K(frame, size), frame.c2w
    photo = Photo(frame.file, size, use_tag, turns, background=background)
    if frame.size not in (None, size, NORMALISED):
        assert frame.size is not None
        what = f"intrinsics are for {frame.size[1]} x {frame.size[0]} pixels"
        note("note", what, f"they are scaled to the photos, {size[1]} x {size[0]}")
    if frame.lens is not None and np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0:
        straight = straighten(K, frame.lens, size, str(frame.file))
        notes += _about_lens(frame, straight, source)
        photo = dataclasses.replace(
            photo, lens=frame.lens, K=K, new_K=straight.K, straight=straight.size
        )
        K, size = straight.K, straight.size
    photo = dataclasses.replace(photo, size=size)
    if turns:
        K, c2w = turn(K, c2w, turns, *size)
        size = size[::-1] if turns % 2 else size
        photo = dataclasses.replace(photo, size=size)
    if header.alpha:
        note("warning", "photos are transparent", f"they show background {background:g} there")
    if header.orientation != 1:
        note(
            "note",
            "photos carry an EXIF orientation",
            "see docs/reference/formats.md if they lie down",
        )
    return Posed(K, c2w, size, photo, tuple(notes))


def _about_lens(frame: Frame, straight, source: str) -> list[Finding]:
    assert frame.lens is not None
    notes = [
        Finding("note", source, f"photos have {frame.lens.model} lens distortion", "it is removed")
    ]
    share = f"{straight.share:.0%} of the photo is left"
    if frame.lens.model == "fisheye" and straight.share < LITTLE_LEFT:
        what = f"so wide a lens has no flat picture without loss, {share}"
        notes.append(Finding("warning", source, what, "crop the photos, or choose a narrower lens"))
    elif frame.lens.model != "fisheye" and (
        straight.share < LITTLE_LEFT or straight.stretch > STRETCHED
    ):
        what = f"lens coefficients {frame.lens.coefficients} are beyond those of lenses: {share}"
        what += f", enlarged {straight.stretch:.1f} times more in one place than in another"
        notes.append(
            Finding("warning", source, what, "calibrate again, or leave the coefficients out")
        )
    return notes


def _without_photo(frame: Frame, source: str) -> Posed:
    """A camera of a path: the straightened one of its lens, in pixels of a picture of the size that its K is for."""
    K, size = frame.K, frame.size
    assert K is not None
    if size == NORMALISED:
        aspect = K[1, 1] / K[0, 0] if K[0, 0] > 0 else 1.0  # square pixels
        size = (DRAWN_HEIGHT, max(1, round(DRAWN_HEIGHT * aspect)))
        K = scale_K(K, NORMALISED, size)
    if frame.lens is not None and size is not None and np.isfinite(K).all() and K[0, 0] > 0:
        straight = straighten(K, frame.lens, size, source)
        K, size = straight.K, straight.size
    return Posed(K, frame.c2w, size, None)


def _orientation(header: Header, frame: Frame, exif: str) -> tuple[bool, int]:
    """(apply the EXIF tag while decoding, quarter turns of picture and camera afterwards).

    K is taken to be for the upright picture unless its size fits only the stored grid; then the
    poses belong to that grid too, and picture, K and pose are turned together.
    """
    if exif == "ignore":
        return False, 0
    if frame.size in (None, NORMALISED) or header.orientation < 5:
        return True, 0
    assert frame.size is not None
    height, width = frame.size
    for_stored = _aspect_gap((height, width), header.stored) < 0.02
    for_upright = _aspect_gap((height, width), header.displayed) < 0.02
    if for_upright or not for_stored:
        return True, 0
    # A mirrored picture (5, 7) is no camera's picture: it stays on its grid.
    return False, QUARTER_TURNS.get(header.orientation, 0)


def _aspect_gap(a: tuple[int, int], b: tuple[int, int]) -> float:
    return abs((a[1] / a[0]) / (b[1] / b[0]) - 1.0)


def _fit_K(frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """K in pixels of the picture of this size, whatever size the file says it is for."""
    assert frame.K is not None
    if frame.size is None or frame.size == size:
        return frame.K
    if frame.size != NORMALISED and _aspect_gap(frame.size, size) > 0.02:
        raise UserError(
            f"{frame.file}: is {size[1]} x {size[0]} pixels but its intrinsics are for "
            f"{frame.size[1]} x {frame.size[0]}: {frame.cure}."
        )
    return scale_K(frame.K, frame.size, size)
