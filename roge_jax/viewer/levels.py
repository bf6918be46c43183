"""Levels of detail of the live picture: the coarsest is quick enough to move with, the finest is for standing still."""

import dataclasses
from collections.abc import Sequence

from ..config import RoGeConfig

NEAREST = 3  # photos that the quickest level looks at
QUICK = 2 / 3  # of the picture's sides: 128x224 where the model makes 192x336
FLUID = 0.1  # seconds that a picture may take while the camera moves
SMOOTHED = 0.3  # weight of the newest time in the mean


@dataclasses.dataclass(frozen=True)
class Level:
    """A configuration of the same weights, and how many photos, the nearest ones, the picture is made from."""

    config: RoGeConfig
    photos: int

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of its pictures."""
        config = self.config
        return config.output_size if config.renderer.lookup else recon_size(config)


def recon_size(config: RoGeConfig) -> tuple[int, int]:
    """(height, width) at which the reconstruction sees photos and rays."""
    return config.recon_height, config.recon_width


def levels(config: RoGeConfig, photo_sizes: Sequence[tuple[int, int]]) -> tuple[Level, ...]:
    """From quick to fine, for photos of these sizes (height, width).

    Quick: half of the reconstruction's sides, whose cost is mostly per pixel, and the nearest photos. Then the model as it
    is. Where colours come from the photos and these are finer than the picture: twice its sides.
    """
    patch, count = config.renderer.patch, len(photo_sizes)
    half = [max(patch, side // 2 // patch * patch) for side in recon_size(config)]
    quick = dataclasses.replace(config, recon_height=half[0], recon_width=half[1])
    if not config.renderer.lookup:
        return Level(quick, min(NEAREST, count)), Level(config, count)
    height, width = config.output_size
    small = tuple(
        max(low, round(QUICK * side)) for low, side in zip(half, (height, width), strict=True)
    )
    quick = dataclasses.replace(quick, output=small)
    found = [Level(quick, min(NEAREST, count)), Level(config, count)]
    if min(min(h / height, w / width) for h, w in photo_sizes) > 1.2:
        fine = dataclasses.replace(config, output=(2 * height, 2 * width))
        found.append(Level(fine, count))
    return tuple(found)


@dataclasses.dataclass(frozen=True)
class Pace:
    """Seconds that a picture of each level takes, as far as they are known: None for a level that never ran."""

    seconds: tuple[float | None, ...]

    def after(self, level: int, seconds: float) -> "Pace":
        """With one more time of a level."""
        old = self.seconds[level]
        mean = seconds if old is None else old + SMOOTHED * (seconds - old)
        return Pace((*self.seconds[:level], mean, *self.seconds[level + 1 :]))

    def moving(self, ready: Sequence[bool]) -> int:
        """The level to move with: the finest known to be fluid, or the coarsest."""
        fluid = [
            i
            for i, seconds in enumerate(self.seconds)
            if ready[i] and seconds is not None and seconds <= FLUID
        ]
        return max(fluid, default=0)
