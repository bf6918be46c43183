"""The pictures of a folder, and which of them a file means that was written elsewhere.

Names come from other machines: with backslashes, with folders that are not here, with accents composed otherwise, with
another case of the ending. `Finder` finds what is meant, and nothing where more than one picture could be.
"""

import contextlib
import os
import unicodedata
from collections.abc import Iterable
from pathlib import Path

from roge_jax.files.fields import is_file

PICTURES = (
    ".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".exr", ".hdr",
)  # fmt: skip
NO_PHOTOS = ("mask", "depth", "normal", "semantic", "label", "confidence", "disparit", "flow")
PHOTO_FOLDERS = ("images", "input", "rgb", "color", "photos", "frames", "image")
DEEPEST, MOST_FILES = 5, 200_000  # of a search below a scene


def is_picture(file: Path) -> bool:
    """Whether a name is that of a picture; hidden files (a Mac's ._0.jpg) are none."""
    return file.suffix.lower() in PICTURES and not file.name.startswith(".")


def is_photo(file: Path) -> bool:
    """Whether a picture's name is that of a photo, not of its mask, depth or normals."""
    return is_picture(file) and not any(word in file.stem.lower() for word in NO_PHOTOS)


def pictures(folder: Path) -> list[Path]:
    """The pictures of a folder that exists, names that are numbers as numbers."""
    return sorted((file for file in folder.iterdir() if is_picture(file)), key=by_number)


def visible(folder: Path, pattern: str) -> list[Path]:
    """Files of a pattern but for hidden ones, names that are numbers as numbers."""
    found = (file for file in folder.glob(pattern) if not file.name.startswith("."))
    return sorted(found, key=by_number)


def by_number(file: Path) -> tuple[int, str]:
    """Names that are numbers sort as numbers (RealEstate10K's timestamps have no fixed length)."""
    digits = "".join(letter for letter in file.stem if letter.isdecimal() and letter.isascii())
    return (int(digits) if digits else -1, file.name)


def shrunk_folders(folder: Path) -> list[Path]:
    """`images_2`, `images_4` .. beside `images`, the least shrunk first, those of masks left out."""
    found = [f for f in visible(folder, "images_*") if f.is_dir()]
    return [f for f in found if not any(word in f.name.lower() for word in NO_PHOTOS)]


def with_ending(place: Path) -> Path | None:
    """The picture at `place`, or at `place` with an ending added (names may have dots of their own)."""
    if is_file(place):
        return place
    if place.suffix.lower() in PICTURES or not place.name:
        return None
    return next((p for e in PICTURES if is_file(p := place.with_name(place.name + e))), None)


class Finder:
    """Pictures by the names that a scene's file gives them, looked for in `folders`, then anywhere below `root`."""

    def __init__(self, root: Path, folders: Iterable[Path] = ()):
        self.root, self.folders = root, [*folders] or [root]
        self.index: dict[str, list[tuple[str, ...]]] | None = None

    def find(self, name: str) -> Path | None:
        """The picture called `name`; None if there is none, or if it could be several."""
        spellings = [name]
        if "\\" in name:
            spellings.append(name.replace("\\", "/"))
        for spelling in spellings:
            if not Path(spelling).name:
                return None
            for folder in self.folders:
                found = with_ending(folder / spelling) or self._shrunk(folder, Path(spelling))
                if found is not None:
                    return found
        return self._anywhere(spellings[-1])

    def _shrunk(self, folder: Path, name: Path) -> Path | None:
        """From `images_2` .. where the name says `images`, or the folder is not named; .png for .jpg as DL3DV has it."""
        if name.parent.name and not name.parent.name.startswith("images"):
            return None
        above = folder / name.parent.parent
        places = [above / "images", *shrunk_folders(above)]
        for place in places:
            found = with_ending(place / name.name)
            if found is not None:
                return found
        for place in places:
            for ending in PICTURES:
                if is_file((place / name.name).with_suffix(ending)):
                    return (place / name.name).with_suffix(ending)
        return None

    def _anywhere(self, name: str) -> Path | None:
        """A file below the root whose path the name ends with, or the other way round."""
        if self.index is None:
            self.index = self._listed()
        elsewhere = name.startswith(("/", "~", "..")) or ":" in name[:3]
        wanted = [part for part in _plain(name).split("/") if part not in ("", ".", "..")]
        if not wanted:
            return None
        last = wanted[-1]
        keys = [last]
        if Path(last).suffix not in PICTURES:
            keys += [last + ending for ending in PICTURES]
        found = []
        for key in keys:
            for parts in self.index.get(key, []):
                plain = [_plain(part) for part in parts[:-1]]
                given = wanted[:-1]
                alike = _ends_with(given, plain) or _ends_with(plain, given)
                if elsewhere and plain and plain[0].split("_")[0] in PHOTO_FOLDERS:
                    alike = alike or _ends_with(given, plain[1:])
                if alike:
                    found.append(parts)
        if len(found) > 1:
            photos = [f for f in found if f[0].lower() in PHOTO_FOLDERS or len(f) == 1]
            exact = [f for f in found if "/".join(f) == name]
            found = exact or photos or found
        return self.root.joinpath(*found[0]) if len(found) == 1 else None

    def _listed(self) -> dict[str, list[tuple[str, ...]]]:
        """Pictures below the root by their plain names; masks, depths and hidden files left out."""
        index: dict[str, list[tuple[str, ...]]] = {}
        count = 0
        for place, folders, files in os.walk(self.root):
            parts = Path(place).relative_to(self.root).parts
            folders[:] = [
                folder
                for folder in sorted(folders)
                if not folder.startswith(".")
                and not any(word in folder.lower() for word in NO_PHOTOS)
                and len(parts) < DEEPEST
            ]
            for file in sorted(files):
                if is_picture(Path(file)):
                    index.setdefault(_plain(file), []).append((*parts, file))
            count += len(files)
            if count > MOST_FILES:
                break
        return index


def _plain(text: str) -> str:
    """A name without what differs between systems: the locale's idea of its bytes, composition of accents, case."""
    with contextlib.suppress(UnicodeError):  # UTF-8 on the disk, read in a locale that is not
        text = os.fsencode(text).decode("utf-8")
    return unicodedata.normalize("NFC", text).casefold()


def _ends_with(long: list[str], short: list[str]) -> bool:
    return not short or long[-len(short) :] == short


def masks_beside(folder: Path) -> int:
    """How many masks lie where other tools put them for the photos of `folder`."""
    count = sum("mask" in file.stem.lower() for file in folder.iterdir() if is_picture(file))
    for place in {folder.parent, folder}:
        for sub in place.iterdir() if place.is_dir() else ():
            if "mask" in sub.name.lower() and sub.is_dir() and not sub.name.startswith("."):
                count += sum(is_picture(file) for file in sub.iterdir())
    return count
