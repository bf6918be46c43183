"""Where the surfaces of a view lie: photos, whose own depths are known, vote on the depths of its rays.

As in Penner & Zhang 2017 ("Soft 3D reconstruction") every photo says of a point on a ray that its surface is there, that
it looks through it, or that something in front hides it. Nothing is matched: what that costs is paid once a scene
(`recon.depth`), and what a point looks like does not change with the camera.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from .aggregate import cheapest, occupied, semi_global, with_belief
from .depth import FINER, LABELS, About, Depths
from .sweep import Motion, all_cuts, inverse_depth, meet_at, pixels_of

VOTE, THROUGH = 4.0, 2.0  # evidence, in nats, of a photo that is sure: for a point, and against one
CLEAR = 2.0  # cuts in front of a photo's surface from which it looks through a point
BLOCKED = 0.9  # what a photo loses behind its own surface


class Surfaces(NamedTuple):
    """Of one view."""

    inverse: jax.Array  # [FINER h, FINER w] inverse depth
    step: jax.Array  # [] of inverse depth: neighbours on one surface differ by less


@jax.named_scope("surfaces")
def surfaces(
    depths: Depths, way: Motion, belief: jax.Array, reach: jax.Array, size: tuple[int, int]
) -> Surfaces:
    """`Surfaces` of a view of `size`, the model's.

    Args:
      way: motion from the view to the m photos, in pixels of the model's size.
      belief: [k, ch, cw] the network's logits over the cuts of cells.
      reach: share of the axis that the cuts divide (`sweep.shared_reach`).
    """
    (h, w), cuts = size, len(belief)

    def costs(inverse: jax.Array, h: int, w: int, belief: jax.Array | None) -> jax.Array:
        where = pixels_of(h, w, (size[0] / h, size[1] / w))
        evidence, seen = jax.lax.map(lambda x: _voted(depths, way, where, x), inverse)
        evidence, seen = evidence.reshape(-1, h, w), seen.reshape(-1, h, w)
        return with_belief(evidence, seen, belief)

    coarse = costs(all_cuts(cuts, h * w, reach), h, w, belief)
    cut = cheapest(semi_global(coarse, diagonals=True))
    about = About.of(cut, cuts, reach, (FINER * h, FINER * w))
    fine = costs(about.inverse.reshape(LABELS, -1), FINER * h, FINER * w, None) + about.cost
    steps = occupied(inverse_depth(cut, cuts, reach), cuts)
    found = about.at(cheapest(semi_global(fine, diagonals=True)))
    return Surfaces(found, steps[1] - steps[0])


def blocked(depths: Depths, way: Motion, where: jax.Array, inverse: jax.Array) -> jax.Array:
    """How surely photos [m, p] have something in front of the points at `inverse` [p] on a view's rays `where` [p, 2]."""
    off, sure, _ = _in_photos(depths, way, where, inverse)
    return BLOCKED * sure * jax.nn.sigmoid(-3.0 * (off + CLEAR))


def _voted(
    depths: Depths, way: Motion, where: jax.Array, inverse: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Evidence [p] for points on a view's rays, in nats, and how many photos see them."""
    off, sure, seen = _in_photos(depths, way, where, inverse)
    there = sure * jnp.exp(-0.5 * jnp.square(off))
    through = sure * jax.nn.sigmoid(3.0 * (off - CLEAR))
    return (seen * (VOTE * there - THROUGH * through)).sum(0), seen.sum(0)


def _in_photos(depths: Depths, way: Motion, where: jax.Array, inverse: jax.Array):
    """Of points on a view's rays, each [m, p]: by how many cuts they lie in front of the photos' surfaces, how sure these
    are, and whether the photos see them."""
    photos = depths.photos
    met = meet_at(photos.into(way), where, inverse[None], photos.frames)
    x, y, ratio, seen = (found[:, 0] for found in met)
    surface, sure = depths.at(x, y)
    return (inverse[None] / ratio - surface) / depths.step[:, None], sure, seen
