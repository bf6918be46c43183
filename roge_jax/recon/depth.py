"""Where the surfaces of a view lie, coarse to fine: photos compared at many cuts of its rays, aggregated over the view.

Coarse at the model's size, over all depths that photos share. Fine at twice its sides, between the coarse answers around
a pixel, which moves borders to where the photos have them. No depth is handed out: it says where a picture's colours are
read (`recon.rendering`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..core.params import Tree
from .aggregate import box, cheapest, envelope, occupied, semi_global, with_belief
from .matching import Described, described, evidence
from .rendering import Photos, Pyramid
from .sweep import Motion, all_cuts, inverse_depth, pixels_of

FINER = 2  # times the model's sides, the fine level
LABELS = 16  # depths that the fine level compares
BEYOND = 1.0  # cuts further than the coarse answers that the fine level looks
WINDOW, FINE_WINDOW = 2, 1  # pixels about which the evidence of either level is averaged


class Level(NamedTuple):
    """Photos of one fineness, and what they are compared by."""

    described: Described
    photos: Photos

    @classmethod
    def of(cls, match: Tree | None, photos: Photos) -> "Level":
        return cls(described(match, photos.rgb), photos)

    def among(self, kept: jax.Array) -> "Level":
        """Some of the photos [k]."""
        return Level(self.described.among(kept), self.photos.among(kept))


def levels_of(match: Tree | None, photos: Photos) -> tuple[Level, Level]:
    """The coarse level and the fine one."""
    if photos.levels is not None:
        return photos.levels
    return Level.of(match, photos.shrunk()), Level.of(match, photos.shrunk(FINER))


def prepared(match: Tree | None, photos: Photos) -> Photos:
    """Photos with all that is made of them, for those who look again and again."""
    return photos._replace(pyramid=Pyramid.of(photos.rgb), levels=levels_of(match, photos))


class Surfaces(NamedTuple):
    """Of one view."""

    inverse: jax.Array  # [FINER h, FINER w] inverse depth
    step: jax.Array  # [] of inverse depth: neighbours on one surface differ by less


def surfaces(
    match: Tree | None,
    levels: tuple[Level, Level],
    way: Motion,
    belief: jax.Array,
    reach: jax.Array,
    alike: jax.Array,
    size: tuple[int, int],
) -> Surfaces:
    """`Surfaces` of a view of `size`, the model's.

    Args:
      match: leaves of `recon.matching`.
      levels: photos about as fine as the model's, and `FINER` times that.
      way: motion from the view to the photos, in pixels of the model's size.
      belief: [k, ch, cw] the network's logits over the cuts of cells.
      reach: share of the axis that the cuts divide (`sweep.shared_reach`).
      alike: [m, m] (`sweep.twins`).
    """
    h, w = size
    cuts = len(belief)

    def matched(
        level: Level, inverse: jax.Array, h: int, w: int, window: int
    ) -> tuple[jax.Array, jax.Array]:
        """Evidence [k, h, w] for inverse depths [k, h w], and how many photos see them."""
        where = pixels_of(h, w, (size[0] / h, size[1] / w))
        photos = level.photos
        frames = (photos.size[:, 0], photos.size[:, 1])
        into = photos.into(way)

        def one(inverse):  # a cut at a time stays in the caches
            values, seen = level.described.at(into, where, inverse[None], frames)
            return evidence(match, values, seen, alike)[0], seen.sum(0)[0]

        found, seen = jax.lax.map(one, inverse)
        return box(found.reshape(-1, h, w), window), seen.reshape(-1, h, w)

    every = all_cuts(cuts, h * w, reach)
    cut = cheapest(semi_global(with_belief(*matched(levels[0], every, h, w, WINDOW), belief)))
    near, far = (inverse_depth(cut + beyond, cuts, reach) for beyond in (BEYOND, -BEYOND))
    low, high = envelope(far, near, FINER * h, FINER * w)
    labels = jnp.linspace(0.0, 1.0, LABELS)[:, None, None]
    inverse = (low[None] + (high - low)[None] * labels).reshape(LABELS, -1)
    found = matched(levels[1], inverse, FINER * h, FINER * w, FINE_WINDOW)
    label = cheapest(semi_global(with_belief(*found)))
    steps = occupied(inverse_depth(cut, cuts, reach), cuts)
    return Surfaces(low + (high - low) * label / (LABELS - 1), steps[1] - steps[0])
