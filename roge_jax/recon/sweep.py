"""What photos show along the rays of a view: cuts of the rays, where they meet the photos, and whether photos agree there.

As in plane sweeping (Collins 1996) a ray is cut at inverse depths; depth is z of the view. `recon.lookup` says what is
made of it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

CELL = 4  # pixels of a cell, along both axes
NEAREST = 0.25  # depth of the last cut in the normalised scene; the first is at infinity
SPACING = 1.5  # exponent: cuts are denser towards infinity
SHARED = 0.1  # of a view's cells: cuts that two photos see in fewer of them are not looked at
BEHIND = 1e-3  # depths in a photo below this are behind it
APART = 0.05  # distance in the normalised scene from which photos are witnesses of their own
STRANGE = 0.1  # variance between photos of different things
EPS = 1e-5


class Motion(NamedTuple):
    """From a view's homogeneous pixel x at inverse depth w to a photo's: turn @ x + w * shift."""

    turn: jax.Array  # [v, m, 3, 3]
    shift: jax.Array  # [v, m, 3]


def motion(K: jax.Array, c2w: jax.Array, photo_K: jax.Array, photo_c2w: jax.Array) -> Motion:
    """`Motion` from v views to m photos: K [., 3, 3] in pixels, c2w [., 4, 4]; depth is z of the view."""
    with jax.default_matmul_precision("highest"):
        inverse = jnp.swapaxes(photo_c2w[:, :3, :3], 1, 2)
        turn = jnp.einsum("mij,vjk->vmik", inverse, c2w[:, :3, :3])
        apart = c2w[:, None, :3, 3] - photo_c2w[None, :, :3, 3]
        turn = jnp.einsum("mij,vmjk,vkl->vmil", photo_K, turn, jnp.linalg.inv(K))
        return Motion(turn, jnp.einsum("mij,mjk,vmk->vmi", photo_K, inverse, apart))


def inverse_depth(cut: jax.Array, cuts: int, reach: jax.Array | float = 1.0) -> jax.Array:
    """1 / depth of a cut, a number between 0 and `cuts` - 1 that need not be whole.

    The cuts divide the share `reach` of an axis that begins at infinity and ends at `NEAREST`.
    """
    return (jnp.maximum(reach * cut, 0.0) / (cuts - 1)) ** SPACING / NEAREST


def cut_at(inverse: jax.Array, cuts: int, reach: jax.Array | float = 1.0) -> jax.Array:
    """The cut of an inverse depth: `inverse_depth` backwards."""
    return (inverse * NEAREST) ** (1.0 / SPACING) * (cuts - 1) / reach


def all_cuts(cuts: int, pixels: int, reach: jax.Array | float = 1.0) -> jax.Array:
    """Inverse depths [cuts, pixels] of whole cuts, the same for every pixel."""
    inverse = inverse_depth(jnp.arange(cuts, dtype=jnp.float32), cuts, reach)
    return jnp.broadcast_to(inverse[:, None], (cuts, pixels))


def shared_reach(
    way: Motion, alike: jax.Array, size: tuple[int, int], side: int, cuts: int
) -> jax.Array:
    """The share (0, 1] of the axis of `inverse_depth` on which photos from two places see what one view sees.

    Judged by cells of `side` pixels, `size` of them in a view or photo; `alike`: `twins`. Photos close together, against
    the depth of the scene, have all of it within a few cuts of a whole axis. 1 where no two photos see the same.
    """
    where = pixels_of(*size, side)
    _, _, seen = meet(in_pixels_of(way, side), where, all_cuts(cuts, len(where)), size)
    shared = (witnesses(seen, alike).sum(0) > 1.5).mean(-1) > SHARED
    last = jnp.max(jnp.where(shared, jnp.arange(cuts, dtype=jnp.float32), -1.0))
    reach = jnp.minimum(last + 2.0, cuts - 1.0) / (cuts - 1.0)
    return jax.lax.stop_gradient(jnp.where(last < 0.0, 1.0, reach))


Size = (
    tuple[int, int] | tuple[jax.Array, jax.Array]
)  # (height, width) of all photos, or [m] of each


def meet(way: Motion, pixels: jax.Array, inverse: jax.Array, size: Size):
    """Where one view's rays meet their cuts in m images of `size`: (x, y, seen), each [m, k, p].

    `way`: the view's motion in pixels of the images; pixels [p, 2] (centres at +0.5), inverse depths [k, p]. A cut is
    seen (1, else 0) if it lies in front of the photo and inside its frame.
    """
    x, y, _, seen = meet_at(way, pixels, inverse, size)
    return x, y, seen


def meet_at(way: Motion, pixels: jax.Array, inverse: jax.Array, size: Size):
    """`meet` with how deep a cut lies in the photos: (x, y, depth there / depth in the view, seen)."""
    h, w = (jnp.broadcast_to(jnp.asarray(x), len(way.turn))[:, None, None] for x in size)
    ones = jnp.ones((len(pixels), 1))
    start = jnp.einsum("mij,pj->mpi", way.turn, jnp.concatenate([pixels, ones], -1))
    q = start[:, None] + inverse[None, :, :, None] * way.shift[:, None, None]
    front = q[..., 2] > BEHIND
    z = jnp.where(front, q[..., 2], 1.0)
    x, y = (jnp.where(front, q[..., i] / z, -1.0) for i in (0, 1))
    seen = front & (x >= 0) & (y >= 0) & (x <= w) & (y <= h)
    return x, y, z, seen.astype(jnp.float32)


class Texels(NamedTuple):
    """Images of one size, as rows to read from: made once for many reads."""

    rows: jax.Array  # see `texels`
    size: tuple[int, int]  # (height, width)
    number: jax.Array  # [m] which of the images in `rows` each is

    @classmethod
    def of(cls, images: jax.Array) -> "Texels":
        m, h, w, _ = images.shape
        return cls(texels(images), (h, w), jnp.arange(m, dtype=jnp.int32))


def fetch(
    images: jax.Array | Texels,
    way: Motion,
    pixels: jax.Array,
    inverse: jax.Array,
    size: Size | None = None,
):
    """Values of m images [m, h, w, c] where one view's rays meet their cuts: ([m, k, p, c], seen [m, k, p]), as by `meet`.

    Bilinear, border repeated. `size`: of the photos, if the images are larger than them.
    """
    held = images if isinstance(images, Texels) else Texels.of(images)
    h, w = held.size
    x, y, seen = meet(way, pixels, inverse, held.size if size is None else size)
    first = held.number[:, None, None] * ((h - 1) * (w - 1))
    return bilinear(held.rows, x, y, (h, w), first), seen


def texels(images: jax.Array) -> jax.Array:
    """Images [m, h, w, c] -> rows [m (h - 1) (w - 1), 4 c] that hold the four neighbours of a sample: one gather instead of
    four."""
    m, h, w, c = images.shape
    corners = [images[:, i : h - 1 + i, j : w - 1 + j] for i in (0, 1) for j in (0, 1)]
    return jnp.concatenate(corners, -1).reshape(m * (h - 1) * (w - 1), 4 * c)


def bilinear(rows: jax.Array, x, y, size, first) -> jax.Array:
    """Values [.., c] at (x, y) in pixels of images of `size` (h, w), whose `texels` begin at row `first`; border
    repeated. Sizes and first rows may differ from sample to sample."""
    h, w = size
    x, y = jnp.clip(x - 0.5, 0.0, w - 1.001), jnp.clip(y - 0.5, 0.0, h - 1.001)
    left, top = jnp.floor(x), jnp.floor(y)
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    index = (top * (w - 1) + left).astype(jnp.int32) + first
    a, b, c, d = jnp.split(rows.at[index].get(mode="promise_in_bounds"), 4, -1)
    upper, lower = a + fx * (b - a), c + fx * (d - c)
    return upper + fy * (lower - upper)


def nearest(rows: jax.Array, x, y, size: tuple[int, int], first) -> jax.Array:
    """Values [.., c] of the pixels that (x, y) lie in, of images of `size` (h, w) whose `rows` [m h w, c] begin at row
    `first`: a fifth of the time of `bilinear`."""
    h, w = size
    column, row = jnp.clip(jnp.floor(x), 0, w - 1), jnp.clip(jnp.floor(y), 0, h - 1)
    return rows.at[(row * w + column).astype(jnp.int32) + first].get(mode="promise_in_bounds")


def twins(photo_c2w: jax.Array) -> jax.Array:
    """How much two photos were taken from one place [m, m]: 1 there, 0 from `APART` on.

    Photos from one place agree at every depth, so that together they are worth one (`witnesses`).
    """
    centres = jax.lax.stop_gradient(photo_c2w[:, :3, 3])
    apart = jnp.sqrt(jnp.square(centres[:, None] - centres[None]).sum(-1))
    return jnp.clip(1.0 - apart / APART, 0.0, 1.0)


def witnesses(seen: jax.Array, alike: jax.Array) -> jax.Array:
    """`seen` [m, ..] between 0 and 1, shared among those that see the same from the same place (`twins`)."""
    return jnp.square(seen) / jnp.maximum(jnp.tensordot(alike, seen, 1), EPS)


def summed(x: jax.Array) -> jax.Array:
    """`x.sum(0)` over photos, written out: with a short last axis a CPU's compiler makes the reduction twenty times as slow."""
    total = x[0]
    for one in x[1:]:
        total = total + one
    return total


def agreement(values: jax.Array, weight: jax.Array):
    """Mean and standard deviation over the photos that see a cut, and their number: values [m, .., c], weight [m, ..]
    as by `witnesses`.

    Fewer than two photos agree on nothing: their deviation is that of strangers.
    """
    n = summed(weight)[..., None]
    share = weight[..., None] / jnp.maximum(n, EPS)[None]
    mean = summed(values * share)
    variance = summed(jnp.square(values - mean[None]) * share) * n / jnp.maximum(n - 1.0, 1.0)
    return mean, jnp.sqrt(jnp.where(n > 1.5, variance, STRANGE) + 1e-4), n


def pixels_of(h: int, w: int, step: float | tuple[float, float]) -> jax.Array:
    """Centres [h * w, 2] = (x, y) of cells of `step` pixels (down, across)."""
    down, across = step if isinstance(step, tuple) else (step, step)
    y, x = np.mgrid[:h, :w] + 0.5
    return jnp.asarray(np.stack([across * x, down * y], -1).reshape(-1, 2), jnp.float32)


def moved_into(way: Motion, scale: jax.Array, offset: jax.Array) -> Motion:
    """`way` in pixels of which `scale` [m, 2] make one and whose origin lies `offset` [m, 2] before it (down, across)."""

    def moved(rows: jax.Array, last: jax.Array) -> jax.Array:
        extra = (1,) * (rows.ndim - 2)
        factor, start = (x[:, ::-1].reshape(-1, 2, *extra) for x in (scale, offset))
        return jnp.concatenate([factor * rows + start * last, last], 1)

    return Motion(
        moved(way.turn[:, :2], way.turn[:, 2:]), moved(way.shift[:, :2], way.shift[:, 2:])
    )


def in_pixels_of(way: Motion, side: float | tuple[float, float]) -> Motion:
    """`way` in pixels of images that are `side` times smaller (down, across)."""
    down, across = side if isinstance(side, tuple) else (side, side)
    shrink = jnp.asarray([1 / across, 1 / down, 1.0])
    return Motion(shrink[None, :, None] * way.turn, shrink[None] * way.shift)
