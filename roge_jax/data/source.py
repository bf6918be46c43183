"""Where training sequences come from: datasets on disk, or procedural scenes rendered when they are asked for."""

import json
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from .dataset import read_dataset

MOST_BAD = 100  # unusable sequences that a run passes over
TOLD = 10  # of which a line is printed


class Given(NamedTuple):
    """A dataset as --data names it, and how often it is drawn from beside the others."""

    folder: Path
    weight: float = 1.0

    def __str__(self) -> str:
        return str(self.folder) if self.weight == 1 else f"{self.folder}:{self.weight:g}"


def given(word: str | Path) -> Given:
    """DIR or DIR:WEIGHT. Raises: UserError for a weight that is none."""
    folder, colon, weight = str(word).rpartition(":")
    if not colon or Path(word).exists():
        return Given(Path(word))
    try:
        value = float(weight)
    except ValueError:
        return Given(Path(word))
    if not 0 < value < 1e6:
        raise UserError(f"--data {word}: the weight {weight} must be a number above 0.")
    return Given(Path(folder), value)


def as_given(data: str | Path | Sequence[Any] | None) -> list[Given]:
    """One dataset or several, however they are named; none: procedural scenes."""
    several = [] if data is None else [data] if isinstance(data, str | Path | Given) else list(data)
    return [one if isinstance(one, Given) else given(one) for one in several]


class Mixture:
    """Sequences of datasets that are drawn from by their weights; those that cannot be used are passed over.

    A draw is a function of its generator alone, so batch i is the same in every process and after every resume. Bad
    sequences are told once and written to `file`; more than `most` of them end the run.
    """

    def __init__(
        self,
        parts: Sequence[Any],
        sources: Sequence[Given],
        *,
        most: int = MOST_BAD,
        file: Path | None = None,
    ):
        self.parts, self.sources, self.most, self.file = list(parts), list(sources), most, file
        self.ends = np.cumsum([len(part) for part in parts])
        weights = np.array([one.weight for one in sources])
        self.shares = weights / weights.sum()
        self.lock, self.bad = threading.Lock(), _listed(file)

    def __len__(self) -> int:
        return int(self.ends[-1])

    def _place(self, index: int) -> tuple[int, int]:
        """(dataset, sequence in it)."""
        part = int(np.searchsorted(self.ends, index, side="right"))
        return part, index - (int(self.ends[part - 1]) if part else 0)

    def __getitem__(self, index: int) -> dict:
        part, number = self._place(index)
        return self.parts[part][number]

    def draw(self, rng: np.random.Generator) -> int:
        """The number of a sequence; of a single dataset what `rng.integers` says."""
        if len(self.parts) == 1:
            return int(rng.integers(len(self)))
        part = int(rng.choice(len(self.parts), p=self.shares))
        return int(self.ends[part]) - 1 - int(rng.integers(len(self.parts[part])))

    def pass_over(self, index: int, error: Exception) -> None:
        """Count a sequence that cannot be used. Raises: UserError when there are too many."""
        part, number = self._place(index)
        folder = str(self.sources[part].folder)
        with self.lock:
            if (folder, number) in self.bad:
                return
            self.bad.add((folder, number))
            count, reason = len(self.bad), " ".join(str(error).split())
            if self.file is not None:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                row = {"data": folder, "sequence": number, "reason": reason}
                with self.file.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
        if count > self.most:
            where = f", listed in {self.file}" if self.file is not None else ""
            raise UserError(
                f"{count} sequences of the data cannot be used{where}, the last in {folder}: {reason.rstrip('.')}: mend or "
                "remove them, or give a larger --most-bad."
            )
        if count <= TOLD:
            more = "; further ones are only listed" if count == TOLD else ""
            print(f"passed over: {folder}, sequence {number}: {reason}{more}", file=sys.stderr)


def _listed(file: Path | None) -> set[tuple[str, int]]:
    """What an earlier part of the run has passed over."""
    if file is None or not file.exists():
        return set()
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {(row["data"], row["sequence"]) for row in rows}


def open_mixture(
    sources: Sequence[Given],
    height: int,
    width: int,
    window: int,
    depth: bool = False,
    *,
    most: int = MOST_BAD,
    file: Path | None = None,
):
    """`open_source` of every dataset, to be drawn from by their weights; procedural scenes if there are none."""
    if not sources:
        return open_source(None, height, width, window, depth)
    parts = [open_source(one.folder, height, width, window, depth) for one in sources]
    return Mixture(parts, sources, most=most, file=file)


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
