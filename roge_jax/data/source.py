"""Where training sequences come from: a dataset on disk, or procedural scenes rendered when they are asked for."""

from pathlib import Path

import numpy as np

from ..errors import UserError
from .dataset import read_dataset


class Chosen:
    """Some sequences of a dataset: item i is its item rows[i]."""

    def __init__(self, dataset, rows):
        self.dataset, self.rows = dataset, rows

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> dict:
        return self.dataset[int(self.rows[index])]


class ProceduralSource:
    """Endless sequences of `frames` varied views [height, width]; item i is scene seed i of the training split."""

    def __init__(self, height: int, width: int, frames: int, depth: bool = False):
        self.height, self.width, self.frames, self.depth = height, width, frames, depth

    def __len__(self) -> int:
        return 10**9  # held-out seeds begin here

    def __getitem__(self, index: int) -> dict:
        from ..procedural.scenes import sample_sequence

        return sample_sequence(
            index,
            height=self.height,
            width=self.width,
            frames=self.frames,
            depth=self.depth,
            varied=True,
        )


def open_source(folder: Path | None, height: int, width: int, window: int, depth: bool = False):
    """Sequences to draw training samples of `window` targets at height x width from: the dataset in `folder`, or
    procedural ones.

    With `depth`, sequences have it. Those shorter than the window are not drawn.

    Raises:
        UserError: the dataset has no depth, or its frames are not that size or a whole multiple of it, or are fewer than the window.
    """
    if folder is None:
        return ProceduralSource(height, width, frames=max(24, window + 3), depth=depth)
    found = read_dataset(folder)
    if depth and not found.depth:
        raise UserError(
            f"{folder}: its scenes have no depth, which this stage learns from: render the dataset with --depth."
        )
    h, w = found[0]["rgb"].shape[1:3]
    frames = int(found.lengths.max())
    if h % height or w % width or h // height != w // width:
        raise UserError(
            f"{folder}: its frames are {h}x{w} and this stage trains at {height}x{width}: give a dataset of that size or "
            f"of a whole multiple of it, or another --size."
        )
    if frames < window:
        raise UserError(
            f"{folder}: its sequences have {frames} frames and this stage trains on chunks of {window}: render or "
            f"pack longer ones with --frames."
        )
    rows = np.flatnonzero(found.lengths >= window)
    return found if len(rows) == len(found) else Chosen(found, rows)
