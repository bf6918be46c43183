"""Whole photos beside what the model is shown of them: nothing of a photo is cut away for the pictures that are made."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..geometry.crops import cover_window, resize
from ..recon.rendering import Photos as WholePhotos

PIXELS = 2_000_000  # of all photos together, that are kept finer than the pictures made of them
FINER = 2.0  # times the picture's sides: what a path that comes closer can still use


@dataclasses.dataclass(frozen=True)
class Whole:
    """Photos [., ., 3] float32 in [0, 1], each of a size of its own, and the window of each that the model is shown."""

    images: tuple[np.ndarray, ...]
    windows: tuple[
        tuple[float, float, float, float], ...
    ]  # top, left, height, width in pixels of the image
    model: tuple[int, int]  # (height, width) of the model's photos

    def keep(self, kept: Sequence[int]) -> "Whole":
        """Some of them."""
        images, windows = [self.images[i] for i in kept], [self.windows[i] for i in kept]
        return dataclasses.replace(self, images=tuple(images), windows=tuple(windows))

    def joined(self, frames: np.ndarray) -> "Whole":
        """With `frames` [k, h, w, 3] after them, all of which the model is shown."""
        h, w = frames.shape[1:3]
        windows = self.windows + ((0.0, 0.0, float(h), float(w)),) * len(frames)
        return dataclasses.replace(self, images=(*self.images, *frames), windows=windows)

    def arrays(self) -> WholePhotos:
        """As the model takes them: on canvases of one size, borders repeated."""
        height = max(image.shape[0] for image in self.images)
        width = max(image.shape[1] for image in self.images)
        rgb = np.stack([_padded(image, height, width) for image in self.images])
        size = np.array([image.shape[:2] for image in self.images], np.float32)
        windows = np.array(self.windows, np.float32)
        scale = windows[:, 2:] / np.array(self.model, np.float32)
        down, across = scale.max(0)  # the finest photo decides
        coarse = (max(2, round(height / down)), max(2, round(width / across)))
        shrunk = np.stack([resize(image, *coarse) for image in rgb])
        return WholePhotos(rgb, shrunk, size, scale, windows[:, :2])


def _padded(image: np.ndarray, height: int, width: int) -> np.ndarray:
    h, w = image.shape[:2]
    pad = ((0, height - h), (0, width - w), (0, 0))
    return np.pad(np.asarray(image, np.float32), pad, mode="edge")


def whole(images: Sequence[np.ndarray], output: tuple[int, int], model: tuple[int, int]) -> Whole:
    """Photos (uint8 or float, any sizes) for pictures of size `output`: as fine as they are, but no finer than helps or
    fits in memory. The window is the largest centred one of the picture's shape (`crops.cover_window`)."""
    cuts = [cover_window(image.shape[:2], output) for image in images]
    area = sum(i.shape[0] * i.shape[1] / (c[2] * c[3]) for i, c in zip(images, cuts, strict=True))
    room = (PIXELS / (area * output[0] * output[1])) ** 0.5
    kept, windows = [], []
    for image, (top, left, rows, columns) in zip(images, cuts, strict=True):
        finest = max(min(FINER, max(1.0, room)) * output[0], model[0])
        factor = min(1.0, finest / rows)
        size = [max(1, round(factor * side)) for side in image.shape[:2]]
        down, across = size[0] / image.shape[0], size[1] / image.shape[1]
        kept.append(resize(image, *size))
        windows.append((top * down, left * across, rows * down, columns * across))
    return Whole(tuple(kept), tuple(windows), model)
