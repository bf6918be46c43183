"""Depth of every photo, found once a scene: each compared with those nearest to it, coarse to fine.

A photo's own pixels say where its surfaces end, which no camera of a path can: costs of depths are aggregated along them
(`recon.aggregate`). Coarse at the model's size, over all depths that photos share; fine at `FINER` times its sides, between
the coarse answers around a pixel. A depth counts for what other photos' depths say of the same point. None is handed
out: views ask the photos where their surfaces lie (`recon.surfaces`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from ..core.params import Tree
from .aggregate import box, cheapest, envelope, occupied, semi_global, with_belief
from .aligned import aligned, in_common
from .matching import Described, descriptions, evidence
from .rendering import Photos, Pyramid
from .sweep import (
    CELL,
    Motion,
    all_cuts,
    cut_at,
    inverse_depth,
    meet_at,
    motion,
    nearest,
    shared_reach,
    twins,
)

FINER = 2  # times the model's sides, the fine level
LABELS = 16  # depths that the fine level compares
BEYOND = 1.0  # cuts further than the coarse answers that the fine level looks
LEAVING = 0.05  # nats a cut, of leaving the coarse answer
WINDOW, FINE_WINDOW = 2, 1  # pixels about which the evidence of either level is averaged
MOST = 2  # photos that one is compared with: four brought .1 dB from six photos, at twice the time
SAME = 1.5  # cuts: deviation of two photos' depths of one point
FAR = 10.0  # further away than photos are: those from one place
DOUBTED = 0.15  # what a depth counts that no other photo confirms


class Depths(NamedTuple):
    """Of every photo, and the pixels that they are of."""

    inverse: jax.Array  # [m, h, w] inverse depth, z of the photo
    sure: jax.Array  # [m, h, w] from 0, not compared, to 1, said by another photo as well
    step: jax.Array  # [m] of inverse depth: neighbours on one surface differ by less
    photos: Photos  # at the fine level

    def among(self, kept: jax.Array) -> "Depths":
        """Of some of the photos [k]."""
        inverse, sure, step = (x[kept] for x in self[:3])
        return Depths(inverse, sure, step, self.photos.among(kept))

    def rescaled(self, ratio: jax.Array) -> "Depths":
        """As of `Photos.rescaled`."""
        return self._replace(photos=self.photos.rescaled(ratio))

    def at(self, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Inverse depths and `sure` at (x, y) [m, ..] in pixels of the photos."""
        m, h, w = self.inverse.shape
        first = (jnp.arange(m, dtype=jnp.int32) * (h * w)).reshape(m, *(1 for _ in x.shape[1:]))
        rows = jnp.stack([self.inverse, self.sure], -1).reshape(-1, 2)
        found = nearest(rows, x, y, (h, w), first)
        return found[..., 0], found[..., 1]


class About(NamedTuple):
    """What a fine level compares: depths between the coarse answers around a pixel, and a little beyond."""

    inverse: jax.Array  # [LABELS, h, w]
    cost: jax.Array  # [LABELS, h, w] nats, of leaving the coarse answer

    @classmethod
    def of(cls, cut: jax.Array, cuts: int, reach: jax.Array, size: tuple[int, int]) -> "About":
        """About coarse cuts [., .] of `cuts` that divide `reach` of the axis, at a finer `size` (height, width)."""
        far, near = (inverse_depth(cut + beyond, cuts, reach) for beyond in (-BEYOND, BEYOND))
        low, high = envelope(far, near, *size)
        labels = jnp.linspace(0.0, 1.0, LABELS)[:, None, None]
        inverse = low[None] + (high - low)[None] * labels
        away = cut_at(inverse, cuts, reach) - jax.image.resize(cut, size, "linear")[None]
        return cls(inverse, LEAVING * jnp.abs(away))

    def at(self, label: jax.Array) -> jax.Array:
        """The inverse depth [h, w] of labels between 0 and LABELS - 1."""
        low, high = self.inverse[0], self.inverse[-1]
        return low + (high - low) * label / (LABELS - 1)


class Partners(NamedTuple):
    """k photos that one other, the reference, is compared with, as that would have taken them (`recon.aligned`)."""

    described: Described
    into: Motion  # from the reference, in pixels at the model's size, to `described`
    photos: Photos  # as they were taken
    way: Motion  # to those, in pixels at the model's size
    different: jax.Array  # [k] 0 if taken from the reference's place, 1 from elsewhere

    @classmethod
    def of(cls, match, photos: Photos, way: Motion, plane, window, different) -> "Partners":
        """Arguments as of `aligned`."""
        found = aligned(photos, way, plane, window)
        held = Described.of(descriptions(match, found.rgb))
        return cls(held, found.way, photos, way, different)

    def compared(
        self, match: Tree | None, own: jax.Array, where: jax.Array, inverse: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Evidence [l, p] for inverse depths [l, p] of the reference's pixels `where` [p, 2], at the model's size, whose
        descriptions are `own` [p, c]; and how many photos see them."""
        size = self.described.plain.size
        into = self.photos.into(self.way)

        def one(inverse: jax.Array) -> tuple[jax.Array, jax.Array]:  # a cut stays in the caches
            values, inside = self.described.at(self.into, where, inverse[None], size)
            _, _, _, seen = meet_at(into, where, inverse[None], self.photos.frames)
            weight = inside * seen * self.different[:, None, None]
            return evidence(match, own, values, weight)[0], weight.sum(0)[0]

        return jax.lax.map(one, inverse)


def prepared(match: Tree | None, photos: Photos, K, c2w, *, size, cuts: int) -> Photos:
    """Photos with all that is made of them, for those who look again and again; arguments as of `depths`."""
    found = depths(match, photos, K, c2w, size=size, cuts=cuts)
    return photos._replace(pyramid=Pyramid.of(photos.rgb), depths=found)


@jax.named_scope("depths")
def depths(
    match: Tree | None,
    photos: Photos,
    K: jax.Array,
    c2w: jax.Array,
    *,
    size: tuple[int, int],
    cuts: int,
) -> Depths:
    """`Depths` of m photos.

    Args:
      match: leaves of `recon.matching`; None compares colours alone.
      K: [m, 3, 3] in pixels of the model's size.
      c2w: [m, 4, 4] normalised.
      size: (height, width) of the model's photos.
      cuts: inverse depths that the coarse level compares.
    """
    if photos.depths is not None:
        return photos.depths
    coarse, fine = photos.shrunk(), photos.shrunk(FINER)
    m, h, w, _ = fine.rgb.shape
    if m == 1:  # nothing to compare it with
        none = jnp.zeros((1, h, w))
        return Depths(none, none, jnp.ones(1), fine)
    alike = twins(c2w)
    every = motion(K, c2w, K, c2w)

    def one(i: jax.Array) -> tuple[jax.Array, jax.Array]:
        way = Motion(every.turn[i], every.shift[i])
        reach = shared_reach(way, alike, (size[0] // CELL, size[1] // CELL), CELL, cuts)
        near = _nearest(c2w, alike, i)
        way = Motion(way.turn[near], way.shift[near])
        axis = inverse_depth(jnp.arange(cuts, dtype=jnp.float32), cuts, reach)
        plane = in_common(way, size, axis)

        def costs(
            level: Photos, inverse: jax.Array, window: int, more: jax.Array | float
        ) -> jax.Array:
            rgb, (h, w) = level.rgb[i], level.rgb.shape[1:3]
            partners = Partners.of(
                match, level.among(near), way, plane, level.window(i), 1.0 - alike[i, near]
            )
            own = descriptions(match, rgb[None]).reshape(h * w, -1)
            logits, seen = partners.compared(match, own, level.pixels(i), inverse)
            logits = box(logits.reshape(-1, h, w), window)
            return semi_global(with_belief(logits, seen.reshape(-1, h, w)) + more, rgb)

        low = coarse.rgb.shape[1] * coarse.rgb.shape[2]
        cut = cheapest(costs(coarse, all_cuts(cuts, low, reach), WINDOW, 0.0))
        about = About.of(cut, cuts, reach, (h, w))
        found = about.at(
            cheapest(costs(fine, about.inverse.reshape(LABELS, -1), FINE_WINDOW, about.cost))
        )
        steps = occupied(inverse_depth(cut, cuts, reach), cuts)
        return found, steps[1] - steps[0]

    inverse, step = jax.lax.map(one, jnp.arange(m))
    found = Depths(inverse, jnp.zeros_like(inverse), step, fine)
    sure = jax.lax.map(lambda i: _confirmed(found, i, every, alike), jnp.arange(m))
    return found._replace(sure=sure)


def _nearest(c2w: jax.Array, alike: jax.Array, i: jax.Array) -> jax.Array:
    """Numbers [k] of the photos to compare photo `i` with: from near it, but not from its place."""
    change = c2w - c2w[i][None]
    apart = jnp.linalg.norm(change[:, :3, 3], axis=-1)
    turned = jnp.linalg.norm(change[:, :3, :3], axis=(1, 2)) / 2**0.5
    order = jnp.argsort(apart + turned + FAR * alike[i])  # itself comes last
    return order[: min(MOST, len(c2w) - 1)]


def _confirmed(found: Depths, i: jax.Array, every: Motion, alike: jax.Array) -> jax.Array:
    """`Depths.sure` [h, w] of photo `i`, from what the other photos' depths are where its points lie in them."""
    photos, (h, w) = found.photos, found.inverse.shape[1:]
    way = photos.into(Motion(every.turn[i], every.shift[i]))
    inverse = found.inverse[i].reshape(1, -1)
    x, y, ratio, seen = meet_at(way, photos.pixels(i), inverse, photos.frames)
    there, _ = found.at(x, y)
    off = (there - inverse[None] / ratio) / (SAME * found.step[:, None, None])
    seen = seen * (1.0 - alike[i])[:, None, None]
    same = (seen * jnp.exp(-0.5 * jnp.square(off))).max(0)
    return (seen.max(0) * DOUBTED + (1.0 - DOUBTED) * same).reshape(h, w)
