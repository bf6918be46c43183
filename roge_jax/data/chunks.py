"""RealEstate10K in `.torch` chunks, as pixelSplat, MVSplat and their relatives have it: a list of scenes in one file.

A scene is {key, url, timestamps, cameras [n, 18], images: n uint8 tensors, the bytes of a JPEG each}. A row of cameras is
fx fy cx cy (divided by width and height), 0 0, and the 3x4 world-to-camera matrix by rows. PyTorch is not needed, and
no code of the file runs.
"""

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras, invert, scale_K, validate
from roge_jax.scenes.entries import intrinsics
from roge_jax.scenes.images import Photos
from roge_jax.scenes.scene import Scene
from roge_jax.weights.pytorch import read_torch_content
from roge_jax.weights.stored import Stored

SUFFIX = ".torch"
WIDTH = 18  # numbers of a camera
CURE = "download the chunk again, or leave it out"


@dataclasses.dataclass(frozen=True)
class PackedPhoto:
    """A JPEG inside a chunk, decoded when it is asked for."""

    data: Stored
    where: str
    size: tuple[int, int]

    def read(self) -> np.ndarray:
        """float32 [h, w, 3] in [0, 1]."""
        try:
            with opened(self.data) as picture:
                return np.asarray(picture.convert("RGB"), np.float32) / np.float32(255)
        except Exception as error:  # a damaged picture can fail in any way
            raise UserError(f"{self.where}: damaged picture ({error}): {CURE}.") from None


def opened(data: Stored) -> Any:
    """Pillow's picture of these bytes."""
    from PIL import Image

    return Image.open(io.BytesIO(np.asarray(data).tobytes()))


def read_chunk(file: Path) -> list[dict]:
    """The scenes of a chunk, their tensors still in the file.

    Raises: UnsafeFile if it tries to execute code; UserError if it is damaged or no chunk.
    """
    content = read_torch_content(file)
    if not isinstance(content, list) or not all(isinstance(one, dict) for one in content):
        raise UserError(
            f"{file} is no chunk of scenes: give pixelSplat's .torch files, a list of scenes with 'key', 'cameras' and "
            "'images'."
        )
    return content


def name_of(file: Path, number: int, entry: dict) -> str:
    """How messages call a scene of a chunk."""
    return f"{file}:{entry['key'] if isinstance(entry.get('key'), str) else number}"


def scene_of(entry: dict, name: str) -> Scene:
    """One scene of a chunk, its cameras validated. Raises: UserError naming the field."""
    cameras, images = entry.get("cameras"), entry.get("images")
    if not isinstance(cameras, Stored) or len(cameras.shape) != 2 or cameras.shape[1] != WIDTH:
        shape = list(cameras.shape) if isinstance(cameras, Stored) else type(cameras).__name__
        raise UserError(
            f"{name}: 'cameras' is {shape}, a chunk has {WIDTH} numbers a view: {CURE}."
        )
    if not isinstance(images, list) or len(images) != cameras.shape[0] or not images:
        count = len(images) if isinstance(images, list) else "no list of"
        raise UserError(
            f"{name}: has {count} 'images' and {cameras.shape[0]} cameras, there must be one of each per view: {CURE}."
        )
    rows = np.asarray(cameras, np.float64)
    photos, Ks, c2ws = [], [], []
    for view, (row, data) in enumerate(zip(rows, images, strict=True)):
        where = f"{name}, view {view}"
        if not isinstance(data, Stored) or data.dtype != np.uint8 or len(data.shape) != 1:
            raise UserError(f"{where}: its picture is no tensor of bytes: {CURE}.")
        try:
            with opened(data) as picture:
                size = (picture.height, picture.width)
        except Exception as error:
            raise UserError(f"{where}: not a readable picture ({error}): {CURE}.") from None
        if not np.isfinite(row).all():
            raise UserError(f"{where}: 'cameras' has a number that is not finite: {CURE}.")
        photos.append(PackedPhoto(data, where, size))
        Ks.append(scale_K(intrinsics(*row[:4]), (1, 1), size))
        c2ws.append(invert(np.vstack([row[6:].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])))
    names = tuple(f"{view:05d}" for view in range(len(photos)))
    heights, widths = zip(*(photo.size for photo in photos), strict=True)
    try:
        checked = validate(Cameras(np.stack(Ks), np.stack(c2ws)), heights, widths, names)
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    return Scene(Photos(photos), checked, names, name)  # type: ignore[arg-type]
