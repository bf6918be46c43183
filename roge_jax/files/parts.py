"""What a long run has computed so far, item by item, beside the file that it will write in the end.

FILE.part/ holds the run's settings and a file for every finished item. A run with the same settings goes on with them;
when it ends the folder goes. Every file is whole or absent.
"""

import contextlib
import hashlib
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from .fields import is_file, read_json
from .folders import held, keep_settings, put, write_json


class Item(NamedTuple):
    """One finished item: numbers as JSON has them, and pictures with their labels."""

    row: dict[str, Any]
    pictures: list[np.ndarray]  # float in [0, 1]; as 8 bits on the disk
    labels: list[str]


@contextlib.contextmanager
def parts(file: Path, settings: dict[str, Any]) -> Iterator[Path]:
    """The folder of finished items of `file`, removed when the block ends well and kept when it fails.

    Raises: UserError if it is of a run with other settings, naming the first that differs, or if another run is at it.
    """
    folder = file.with_name(file.name + ".part")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder} cannot be written ({error.strerror}): give another --out."
        ) from None
    with held(folder, file):
        begun = is_file(folder / "settings.json")
        keep_settings(folder, settings, begun=begun, resume=True)
        yield folder
        shutil.rmtree(folder)


def load_item(folder: Path, name: str, *, pictures: bool) -> Item | None:
    """The finished item `name`; None if there is none, or none with pictures where these are wanted."""
    file, images = _places(folder, name)
    if not is_file(file) or (pictures and not is_file(images)):
        return None
    row = read_json(file, "part of a run")
    if not pictures:
        return Item(row, [], [])
    try:
        with np.load(images) as found:
            labels = [str(label) for label in found["labels"]]
            return Item(row, [found[f"p{i}"] / 255.0 for i in range(len(labels))], labels)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None


def save_item(folder: Path, name: str, item: Item, *, pictures: bool) -> None:
    """Keep a finished item; its numbers are written last, and mark it as finished."""
    file, images = _places(folder, name)
    if pictures:
        temporary = images.with_name(images.name + ".tmp")
        arrays = {
            f"p{i}": np.rint(255.0 * np.clip(x, 0.0, 1.0)).astype(np.uint8)
            for i, x in enumerate(item.pictures)
        }
        with temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, labels=np.array(item.labels), **arrays)
        put(temporary, images)
    write_json(file, item.row)


def _places(folder: Path, name: str) -> tuple[Path, Path]:
    stem = hashlib.sha256(name.encode()).hexdigest()[:16]  # names may be whole paths
    return folder / f"{stem}.json", folder / f"{stem}.npz"
