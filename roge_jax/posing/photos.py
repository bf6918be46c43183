"""The photos to pose: which files, what their EXIF says about the lens, and the small copies that are matched."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..files.video_io import to_uint8
from ..geometry.crops import resize
from ..scenes.images import read_header, read_image
from ..scenes.pictures import PHOTO_FOLDERS, is_photo, pictures
from ..scenes.readers import VIDEOS

EXIF_IFD = 0x8769
MAKE, MODEL, FOCAL, FOCAL_35, LENS = 0x010F, 0x0110, 0x920A, 0xA405, 0xA434
PLANE_X, PLANE_UNIT, PIXELS_X = 0xA20E, 0xA210, 0xA002
DIAGONAL_35 = 43.27  # mm of the film that "35 mm equivalent" counts in
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # of EXIF's resolution units
NO_PRIOR = 1.2  # focal length over the long side, where nothing says it: 45 degrees across
SANE = (0.3, 20.0)  # focal lengths over the long side; what lies outside is no lens's


@dataclasses.dataclass(frozen=True)
class Shot:
    """One photo. size: (height, width) upright. focal: in its pixels, None if EXIF does not say it.

    camera: equal for photos that one lens at one zoom took, as far as the files say.
    """

    file: Path
    size: tuple[int, int]
    focal: float | None
    camera: tuple


def find_photos(place: Path) -> tuple[list[Path], Path | None]:
    """(photos, None) of a folder, or ([], video). Raises: UserError for a place that has neither."""
    if not place.exists():
        raise UserError(f"{place}: there is no such folder of photos, and no such video.")
    if place.is_file():
        if place.suffix.lower() in VIDEOS:
            return [], place
        if is_photo(place):
            raise UserError(
                f"{place}: is one photo, which has nothing to be matched with: give the folder of 20 or more photos."
            )
        raise UserError(
            f"{place}: is neither a folder of photos nor a video ({', '.join(VIDEOS)}): give one of them."
        )
    for folder in (place, *(place / name for name in PHOTO_FOLDERS)):
        if folder.is_dir() and (found := [f for f in pictures(folder) if is_photo(f)]):
            return found, None
    videos = sorted(f for f in place.iterdir() if f.suffix.lower() in VIDEOS)
    if len(videos) == 1:
        return [], videos[0]
    if videos:
        raise UserError(
            f"{place}: has {len(videos)} videos and no photos: give one, e.g. {videos[0]}."
        )
    below = [f for f in place.glob("*/*") if is_photo(f)]
    more = f" ({below[0].parent} has some)" if below else ""
    raise UserError(
        f"{place}: has no photos in it{more}: give the folder that holds the JPEG, PNG, HEIC or TIFF files, or a video."
    )


def read_shot(file: Path) -> Shot:
    """What the head of a photo's file says. Raises: UserError if it is no picture that can be read."""
    header = read_header(file)
    tags = _exif(file)
    size = header.displayed
    focal = exif_focal(tags, size)
    of_lens = tuple(str(tags.get(tag, "")) for tag in (MAKE, MODEL, LENS, FOCAL, FOCAL_35))
    return Shot(file, size, focal, (size, of_lens))


def _exif(file: Path) -> dict[int, Any]:
    """EXIF tags of a picture, those of the camera among them; {} if there are none or they are broken."""
    from PIL import Image

    try:
        with Image.open(file) as picture:
            exif = picture.getexif()
            return {**dict(exif), **dict(exif.get_ifd(EXIF_IFD))}
    except Exception:  # broken EXIF is no reason against a photo
        return {}


def exif_focal(tags: dict[int, Any], size: tuple[int, int]) -> float | None:
    """Focal length in pixels of the picture of `size` (height, width), from EXIF tags; None if they do not say it.

    The 35 mm equivalent if there is one, which compares diagonals; else the length in mm and the sensor's resolution.
    """
    long, diagonal = max(size), float(np.hypot(*size))
    guesses = []
    if equivalent := _positive(tags.get(FOCAL_35)):
        guesses.append(equivalent * diagonal / DIAGONAL_35)
    focal, density = _positive(tags.get(FOCAL)), _positive(tags.get(PLANE_X))
    unit = UNIT_MM.get(int(_positive(tags.get(PLANE_UNIT)) or 2))
    if focal and density and unit:
        shrunk = long / (_positive(tags.get(PIXELS_X)) or long)
        guesses.append(focal * density / unit * min(shrunk, 1.0))
    return next((f for f in guesses if SANE[0] < f / long < SANE[1]), None)


def _positive(value: Any) -> float | None:
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return found if np.isfinite(found) and found > 0 else None


def make_copy(shot: Shot, folder: Path, name: str, long_side: int) -> tuple[int, int]:
    """The photo upright at no more than `long_side` pixels, as `folder/name`; its size (height, width)."""
    from PIL import Image

    image = read_image(shot.file)
    factor = min(1.0, long_side / max(image.shape[:2]))
    size = (max(1, round(image.shape[0] * factor)), max(1, round(image.shape[1] * factor)))
    small = image if factor == 1.0 else resize(image, *size)
    Image.fromarray(to_uint8(small)).save(folder / name, quality=97, subsampling=0)
    return size


def scene_names(files: list[Path], endings: list[str]) -> list[str]:
    """Names of photos in the new scene: their own stems, numbered where two are the same."""
    taken: set[str] = set()
    names = []
    for file, ending in zip(files, endings, strict=True):
        stem, k = file.stem.strip().replace(" ", "_") or "photo", 1
        name = f"{stem}{ending}"
        while name.casefold() in taken:
            k += 1
            name = f"{stem}_{k}{ending}"
        taken.add(name.casefold())
        names.append(name)
    return names
