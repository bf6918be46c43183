"""Which frames of a path are generated: in each window the stretch that the photos see worst, worst windows first.

All stretches of a plan have one length, since every length is a program to compile. They begin where a latent slot of
the window ends: their slots then hold the window's own frames and noise. Anywhere else a stretch is another sample, as
far from the full model's frames as the RGB head's picture is (docs/results/planning.md).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..config import RoGeConfig
from ..geometry.packing import GROUP
from ..sampling.choices import Span
from ..sampling.windows import windows

COUNTS = 32  # numbers of windows that are tried on long paths


class Cut(NamedTuple):
    """`Choices.generate` and `Choices.frames`."""

    generate: tuple[Span | None, ...]
    frames: int


def lengths(config: RoGeConfig) -> list[int]:
    """Frames that may be generated together: one and a quarter, half, three quarters or all of a window's groups of four.

    Never one alone: it would be as far from the full model's frame as the RGB head's picture is.
    """
    groups = (config.frames - 1) // GROUP
    return sorted({1 + GROUP * min(groups, max(1, round(k * groups / 4))) for k in (1, 2, 3, 4)})


def places(window: Span, length: int) -> list[Span]:
    """Where in a window [start, stop) `length` frames can be generated alone, or fewer at its end."""
    start, stop = window
    firsts = range(start, max(start + 1, stop - length + GROUP), GROUP)
    return [(first, min(first + length, stop)) for first in firsts]


def place(seen: np.ndarray, window: Span, length: int) -> Span:
    """The first of the `places` whose frames are seen worst on average."""
    return min(places(window, length), key=lambda span: mean(seen, span))


def mean(seen: np.ndarray, span: Span) -> float:
    """Coverage of a span of frames; rounded, so that what is equal on paper is."""
    return round(float(seen[slice(*span)].mean()), 9)


def cuts(seen: np.ndarray, config: RoGeConfig) -> Iterator[Cut]:
    """Nothing generated; then stretches of every length in more and more windows, those seen worst first.

    `seen`: coverage of every frame of the path [n]. The last cut is the full model's.
    """
    runs = windows(len(seen), config.frames)
    tried = np.unique(np.linspace(1, len(runs), min(len(runs), COUNTS)).round().astype(int))
    yield Cut((None,) * len(runs), config.frames)
    for length in lengths(config):
        spans = [place(seen, window, length) for window in runs]
        order = np.argsort([mean(seen, span) for span in spans], kind="stable")
        rank = np.argsort(order)
        for count in tried:
            made = (span if r < count else None for span, r in zip(spans, rank, strict=True))
            yield Cut(tuple(made), length)
