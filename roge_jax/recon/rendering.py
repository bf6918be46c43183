"""Image-based rendering at any size: the photos' own pixels at the cut that a view's rays agree on.

Blending weights and trust are found at the model's size (`recon.lookup`), depths at that and at twice of it
(`recon.surfaces`); colours are read here, from photos as fine as they are given, so a picture is as sharp as they are.
Where photos are finer than the picture they are read from a level of a pyramid that is not (Williams 1983).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .aggregate import TOGETHER, enlarged
from .sweep import EPS, Motion, bilinear, meet_at, moved_into, pixels_of, summed, texels

Array = Any  # of JAX, or of NumPy before a program takes it
LEVELS = 3  # of the pyramid: photos up to four times finer than the picture do not alias
DISAGREED = 0.1  # difference of the photos' colours at which half of the picture is not theirs
CHOICE = 2.0  # exponent of the photos' shares: means of many photos are blurred
FADE = 0.1  # weight of all photos below which they fade out


class Photos(NamedTuple):
    """Whole photos: the model's own show a window of these."""

    rgb: Array  # [m, ph, pw, 3] in [0, 1]; beyond a photo's own size its border goes on
    coarse: Array  # [m, ., ., 3] the same, about as fine as the model's photos
    size: Array  # [m, 2] height and width of each in pixels of `rgb`
    scale: Array  # [m, 2] pixels of `rgb` in one of the model's, down and across
    offset: Array  # [m, 2] where the window begins in `rgb`
    # What is made of them, where it was made before (`depth.prepared`): a pyramid of `rgb`, and `depth.Depths`.
    pyramid: "Pyramid | None" = None
    depths: Any = None

    def among(self, kept: jax.Array) -> "Photos":
        """Some of the photos [k], prepared as all of them are."""
        rgb, coarse, size, scale, offset = (x[kept] for x in self[:5])
        pyramid, depths = self.pyramid, self.depths
        if pyramid is not None:
            pyramid = pyramid._replace(first=pyramid.first[:, kept])
        if depths is not None:
            depths = depths.among(kept)
        return Photos(rgb, coarse, size, scale, offset, pyramid, depths)

    def rescaled(self, ratio: Array) -> "Photos":
        """For another size of the model, whose pixels are `ratio` [1, 2] of those now (down, across)."""
        depths = None if self.depths is None else self.depths.rescaled(ratio)
        return self._replace(scale=self.scale * ratio, depths=depths)

    def shrunk(self, times: int = 1) -> "Photos":
        """The coarse ones in place of `rgb`; `times` as fine, of `rgb`."""
        m, h, w, _ = self.coarse.shape
        size = (times * h, times * w)
        rgb = self.coarse
        if times > 1:
            rgb = jax.image.resize(self.rgb, (m, *size, 3), "linear", antialias=True)
        sides = zip(size, self.rgb.shape[1:3], strict=True)
        factor = jnp.asarray([[small / large for small, large in sides]])
        moved = (factor * x for x in (self.size, self.scale, self.offset))
        return Photos(rgb, self.coarse, *moved)

    def into(self, way: Motion) -> Motion:
        """`way`, in pixels of the model's photos, in pixels of these."""
        return moved_into(way, self.scale, self.offset)

    @property
    def frames(self) -> tuple[Array, Array]:
        """(heights, widths) [m] of the photos."""
        return self.size[:, 0], self.size[:, 1]

    def window(self, i: Array) -> tuple[Array, Array]:
        """`scale` and `offset` of one."""
        return self.scale[i], self.offset[i]

    def pixels(self, i: Array) -> Array:
        """Centres [h w, 2] = (x, y) of the pixels of one, in pixels of the model's size."""
        scale, offset = self.window(i)
        h, w = self.rgb.shape[1:3]
        return (pixels_of(h, w, 1) - offset[None, ::-1]) / scale[None, ::-1]


class Blend(NamedTuple):
    """What a view takes from the photos; at the model's size, apart from the depths."""

    inverse: jax.Array  # [v, ., .] inverse depth, at the model's size or larger
    step: jax.Array  # [v] between the inverse depths that were compared
    share: jax.Array  # [v, m, h, w, 1] of each photo
    clear: (
        jax.Array
    )  # [v, m, ., ., 1] how much of each photo nothing in front hides, of the depths' size
    gate: jax.Array  # [v, h, w, 1] how much of the photos the mixture takes
    head: jax.Array  # [v, h, w, 3] the RGB head's picture
    rest: jax.Array  # [v, h, w, 3] what the mixture adds to both


class Pyramid(NamedTuple):
    """Photos of one size at several levels, as rows to read from."""

    rows: jax.Array  # [all levels' texels, 12], see `sweep.texels`
    height: jax.Array  # [levels] float32
    width: jax.Array  # [levels]
    first: jax.Array  # [levels, m] row of each photo

    @classmethod
    def of(cls, photos: jax.Array) -> "Pyramid":
        """The pyramid of photos [m, h, w, 3], each level half as large as the one before."""
        m, h, w, _ = photos.shape
        sizes, rows, first, total = [], [], [], 0
        for level in range(LEVELS):
            size = (max(2, h >> level), max(2, w >> level))
            small = jax.image.resize(photos, (m, *size, 3), "linear", antialias=True)
            rows.append(texels(small))
            count = (size[0] - 1) * (size[1] - 1)
            first.append([total + i * count for i in range(m)])
            total += m * count
            sizes.append(size)
        height, width = (jnp.asarray(side, jnp.float32) for side in zip(*sizes, strict=True))
        return cls(jnp.concatenate(rows), height, width, jnp.asarray(first, jnp.int32))

    def read(self, x: jax.Array, y: jax.Array, level: jax.Array) -> jax.Array:
        """Colours [m, p, 3] at (x, y) [m, p] in pixels of level 0, between the two levels about `level`."""
        photo = jnp.broadcast_to(jnp.arange(self.first.shape[1])[:, None], level.shape)
        low = jnp.clip(jnp.floor(level), 0, LEVELS - 1)
        found = []
        for k in (low, jnp.minimum(low + 1, LEVELS - 1)):
            k = k.astype(jnp.int32)
            h, w = self.height[k], self.width[k]
            at = x * w / self.width[0], y * h / self.height[0]
            found.append(bilinear(self.rows, *at, (h, w), self.first[k, photo]))
        share = jnp.clip(level - low, 0.0, 1.0)[..., None]
        return found[0] + share * (found[1] - found[0])


def working_bytes(photos: int, height: int, width: int, views: int) -> int:
    """Bytes that `render` needs beside `views` pictures that are kept: the photos' rows, and one view's samples."""
    pixels = height * width
    rows = 2 * photos * pixels * 12 * 4  # as fine as twice as many pixels, and coarser levels
    return 4 * (3 * views * pixels + rows // 4 + photos * pixels * (2 * 12 + 12))


@jax.named_scope("render")
def render(
    photos: Photos,
    way: Motion,
    blend: Blend,
    scale: jax.Array,
    *,
    height: int,
    width: int,
) -> jax.Array:
    """Pictures [v, height, width, 3] in [0, 1] of v views.

    Args:
      photos: of any size.
      way: motion from the views to the photos in pixels of the model's size.
      blend: at the model's size h x w, with leading axis v.
      scale: [v, m] focal length of the photo over that of the view, in pixels of the model's size.
    """
    pyramid = Pyramid.of(photos.rgb) if photos.pyramid is None else photos.pyramid

    def one(view):
        return _render(pyramid, photos, *view, height, width)

    return jax.lax.map(one, (way, blend, scale))


def _render(pyramid: Pyramid, whole: Photos, way: Motion, blend: Blend, scale, height, width):
    h, w = blend.head.shape[:2]
    where = pixels_of(height, width, (h / height, w / width))
    inverse = enlarged(blend.inverse, height, width, TOGETHER * blend.step).reshape(1, -1)
    met = meet_at(whole.into(way), where, inverse, whole.frames)
    x, y, depth, seen = (found[:, 0] for found in met)
    finer = (
        whole.scale[:, 1] * w / width * scale
    )  # their pixels in one of the picture's, at equal depth
    finer = finer[:, None] / depth
    colours = pyramid.read(x, y, jnp.log2(jnp.maximum(finer, 1e-6)))
    m = len(colours)
    colours, seen = colours.reshape(m, height, width, 3), seen.reshape(m, height, width, 1)

    share = jnp.maximum(_resized(blend.share, height, width), 0.0) ** CHOICE
    share = share / jnp.maximum(summed(share), EPS)[None]
    share = share * _resized(blend.clear, height, width) * seen
    weight = summed(share)
    photos = summed(share * colours) / jnp.maximum(weight, EPS)  # [height, width, 3]
    head, rest, gate = (_resized(x, height, width) for x in (blend.head, blend.rest, blend.gate))
    found = jnp.clip(weight / FADE, 0.0, 1.0)
    mixed = head + rest + found * gate * (photos - head)
    # The mixture is cautious. Where the photos agree with one another they are taken as they are.
    apart = summed(share * jnp.abs(colours - photos[None]))
    apart = (apart[..., :1] + apart[..., 1:2] + apart[..., 2:]) / 3.0
    apart = _resized(_resized(apart / jnp.maximum(weight, EPS), h, w), height, width)
    trust = jax.nn.sigmoid(4.0 - 4.0 * apart / DISAGREED) * found
    return jnp.clip(mixed + trust * (photos - mixed), 0.0, 1.0)


def _resized(x: jax.Array, height: int, width: int) -> jax.Array:
    return jax.image.resize(x, (*x.shape[:-3], height, width, x.shape[-1]), "linear")
