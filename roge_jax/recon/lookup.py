"""Photo look-up: every ray looks into the photos along its epipolar lines and brings back their own colours.

Not in the paper (`RendererConfig.lookup`, on in `mini`): a renderer trained for hours instead of weeks puts things where
they belong but blurs them, and what it lost is in the photos. As in plane sweeping (Collins 1996; Yao et al. 2018,
"MVSNet") a ray is cut at many inverse depths, but nothing here is told what depth is right: the distribution over the cuts
is an attention, learned from the photometric term alone. A picture larger than the model (`full`) asks the photos' own
depths (`recon.surfaces`), found with features that did learn from depth.

1. Coarse, per cell of 4 x 4 pixels: at each of `RendererConfig.lookup` cuts, how well do features of the photos agree
   where the cut projects to, and how well do their colours agree there, in the region and in the whole view? Together
   with what the ray features say, that gives logits over the cuts. The cuts end where two photos no longer see the same.
2. Fine, per pixel: a few cuts about the coarse answer, and the photos' colours there.
3. Which photo is right (near, agreeing with the others and with the RGB head), and whether any is: a mixture of the
   photos' colours and the RGB head's.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..core import products, target
from ..core.layers import (
    conv2d,
    conv2d_specs,
    layer_norm,
    linear,
    linear_specs,
    norm_specs,
    unpatchify,
)
from ..core.params import Spec, Tree, fan_in, stack, zeros
from ..core.sharding import ways
from ..core.stepping import checkpoint
from .depth import FINER, depths
from .matching import matching_specs
from .rendering import Blend, Photos, render
from .surfaces import blocked, surfaces
from .sweep import (
    CELL,
    EPS,
    SHARED,
    Motion,
    Texels,
    agreement,
    all_cuts,
    cut_at,
    fetch,
    in_pixels_of,
    inverse_depth,
    motion,
    pixels_of,
    shared_reach,
    summed,
    twins,
    witnesses,
)

BLOCKS, WIDTH, MATCHED = 3, 16, 8  # coarse network; channels of the photos' features
FINE = 8  # cuts of the fine level, a quarter of a coarse interval apart
ALONG = 5  # neighbouring cuts that a coarse block sees
REGION = 3.0  # standard deviation of a cell's region, in cells
AGREED = 5  # what a cell is told of the agreement of colours (`_agreement_around`)
UNKNOWN = 0.3  # deviation of colours that no two photos show
UNSEEN = -8.0  # logit of cuts that no photo sees


class Full(NamedTuple):
    """Whole photos finer than the model's, and the size of the picture that is wanted of them."""

    photos: Photos
    height: int
    width: int


class Looked(NamedTuple):
    """What rays found in the photos."""

    rgb: jax.Array  # [v, h, w, 3] the picture
    head: jax.Array  # [v, h, w, 3] the RGB head's
    photos: jax.Array  # [v, h, w, 3] its part from the photos alone
    coarse: jax.Array  # [v, h / 4, w / 4, 3] the photos' colours under the coarse distribution
    full: jax.Array | None = (
        None  # [v, height, width, 3] the picture at another size, see `recon.rendering`
    )


def lookup_specs(d: int, patch: int, cuts: int, matching: bool = False) -> Tree:
    """Leaves for ray features of width `d`, `patch` pixels a side; with those of `recon.matching` or without."""
    cells, linears = (patch // CELL) ** 2, (None, None)
    along = {
        "kernel": Spec((ALONG, WIDTH, WIDTH), (None,) * 3, fan_in(0.5)),
        "bias": Spec((WIDTH,), (None,), zeros),
    }
    return {
        "features": {
            "conv1": conv2d_specs(3, 16, 3),
            "conv2": conv2d_specs(16, 16, 3),
            "conv3": conv2d_specs(16, MATCHED, 3),
        },
        "norm": norm_specs(d, bias=False),
        "prior": linear_specs(d, cells * (cuts + WIDTH), linears, init=zeros),
        "enter": linear_specs(MATCHED + 3 + 2 + 1 + WIDTH + AGREED, WIDTH, linears),
        "blocks": stack({"space": conv2d_specs(WIDTH, WIDTH, 3), "along": along}, BLOCKS),
        "score": linear_specs(WIDTH, 1, linears),
        "upsample": linear_specs(2 * WIDTH, 9 * CELL**2, linears, init=zeros),
        "fine": {
            "conv1": conv2d_specs(8 * FINE, WIDTH, 3),
            "conv2": conv2d_specs(WIDTH, WIDTH, 3),
            "conv3": conv2d_specs(WIDTH, FINE, 3),
        },
        "choose": {"conv1": conv2d_specs(11, WIDTH, 3), "conv2": conv2d_specs(WIDTH, 1, 3)},
        "merge": {
            "conv1": conv2d_specs(14, WIDTH, 3),
            "conv2": conv2d_specs(WIDTH, WIDTH, 3),
            "conv3": conv2d_specs(WIDTH, 4, 3, init=zeros),
        },
        **({"match": matching_specs()} if matching else {}),
    }


def _counts(n: jax.Array) -> list[jax.Array]:
    """Whether a photo sees it, and whether two from different places do."""
    return [(n > 0.5).astype(jnp.float32), (n > 1.5).astype(jnp.float32)]


def _cells(images: jax.Array, side: int = CELL) -> jax.Array:
    """Means of cells: [v, h, w, c] -> [v, h / side, w / side, c]."""
    v, h, w, c = images.shape
    return images.reshape(v, h // side, side, w // side, side, c).mean((2, 4))


@jax.named_scope("look_up")
@products.use(None)
def look_up(
    p: Tree,
    features: jax.Array,
    head: jax.Array,
    photos: jax.Array,
    cameras: tuple[jax.Array, jax.Array],
    photo_cameras: tuple[jax.Array, jax.Array],
    *,
    cuts: int,
    full: Full | None = None,
) -> Looked:
    """Ray features [v, gh, gw, d] and the RGB head's picture of them [v, h, w, 3] -> `Looked`.

    photos [m, h, w, 3] in [0, 1]; cameras (K, c2w) of the v views and of the m photos, in the normalised frame. With
    `full` also the picture at its size; no gradient passes through that.
    """
    v, gh, gw, d = features.shape
    ch = photos.shape[1] // CELL
    way = motion(*cameras, *photo_cameras)
    maps = jnp.concatenate([_features(p["features"], photos), _cells(photos)], -1)
    halves = _cells(photos, CELL // 2)
    tokens = layer_norm(p["norm"], features.reshape(v, gh * gw, d), eps=EPS)
    tokens = unpatchify(linear(p["prior"], tokens), (gh, gw), ch // gh)
    prior, context = tokens[..., :cuts], tokens[..., cuts:]

    alike = twins(photo_cameras[1])
    if full is not None:
        size = (photos.shape[1], photos.shape[2])
        photo_depths = depths(p.get("match"), full.photos, *photo_cameras, size=size, cuts=cuts)
        wide = full.photos.shrunk()
        colours = Texels.of(wide.rgb)

    @checkpoint
    def one(way, prior, context, head, far):
        reach = shared_reach(way, alike, maps.shape[1:3], CELL, cuts)
        around = _agreement_around(halves, alike, way, reach, cuts)
        belief, coarse, cut, sure, hidden = _coarse(
            p, maps, alike, way, reach, prior, context, _cells(head[None])[0], around
        )
        weights = linear(p["upsample"], jnp.concatenate([hidden, context], -1))
        cut, sure = (_upsampled(weights, x) for x in (cut, sure))

        def choose(cut, found, seen):
            apart, chord = (x[:, None, None, None] for x in far)
            away = apart * inverse_depth(cut, cuts, reach)[None, ..., None] + chord
            looked, some, scene, share = _chosen(p["choose"], found, seen, alike, away, head)
            about = jnp.concatenate([scene, sure[..., None]], -1)
            return looked, share, _merged(p["merge"], head, looked, some, about)

        found, seen, cut = _fine(p["fine"], photos, alike, cuts, way, reach, cut, head)
        looked, _, (mixed, _, _) = choose(cut, found, seen)
        own = Looked(mixed, head, looked, coarse)
        if full is None:
            return own, None
        h, w = size
        inverse, step = surfaces(photo_depths, way, belief, reach, size)
        where = pixels_of(FINER * h, FINER * w, 1.0 / FINER)
        clear = 1.0 - blocked(photo_depths, way, where, inverse.reshape(-1))
        clear = clear.reshape(-1, FINER * h, FINER * w, 1)
        near = inverse[FINER // 2 :: FINER, FINER // 2 :: FINER]
        where = pixels_of(h, w, 1)
        values, seen = fetch(colours, wide.into(way), where, near.reshape(1, -1), wide.frames)
        found, seen = values.reshape(-1, h, w, 3), seen.reshape(-1, h, w, 1)
        seen = seen * clear[:, FINER // 2 :: FINER, FINER // 2 :: FINER]
        _, share, (_, gate, rest) = choose(cut_at(near, cuts, reach), found, seen)
        return own, Blend(inverse, step, share, clear, gate, head, rest)

    views = way, prior, context, head, _distances(cameras[1], photo_cameras[1])
    # Of a lone CPU's caches and memory one view at a time makes the most.
    alone = target.platform() == "cpu" and ways("seq") == 1
    looked, blend = jax.lax.map(lambda view: one(*view), views) if alone else jax.vmap(one)(*views)
    if full is None:
        return looked
    scale = photo_cameras[0][None, :, 0, 0] / cameras[0][:, None, 0, 0]
    wanted = {"height": full.height, "width": full.width}
    return looked._replace(full=render(full.photos, way, blend, scale, **wanted))


def _features(p: Tree, photos: jax.Array) -> jax.Array:
    """Photos [m, h, w, 3] -> what is compared [m, h / 4, w / 4, c]."""
    y = jax.nn.relu(conv2d(p["conv1"], photos - 0.5, stride=2))
    y = jax.nn.relu(conv2d(p["conv2"], y, stride=2))
    return conv2d(p["conv3"], y)


def _agreement_around(halves: jax.Array, alike, way: Motion, reach, cuts: int) -> jax.Array:
    """How well the colours of photos at half their size [m, 2 ch, 2 cw, 3] agree at one view's cuts [k, ch, cw, 5].

    The deviation in the cell; for its region and for the whole view, the logarithm of the deviation above that of the
    best cut, and how much of it two photos see. A cell that no two photos see, or without texture, learns from these
    where its surroundings lie.
    """
    _, h, w, _ = halves.shape
    way, where = in_pixels_of(way, CELL // 2), pixels_of(h, w, CELL // 2)
    values, seen = fetch(halves, way, where, all_cuts(cuts, h * w, reach))
    _, deviation, n = agreement(values, witnesses(seen, alike))
    both = (n > 1.5).astype(jnp.float32)
    sums = jnp.concatenate([deviation.mean(-1, keepdims=True) * both, both], -1)
    # Of a cell: the deviation where two photos see it, and how much of it they see.
    sums = _cells(sums.reshape(cuts, h, w, 2), 2)
    own = sums[..., 0] / jnp.maximum(sums[..., 1], EPS)
    told = [jnp.where(sums[..., 1] > 0, own, UNKNOWN)]
    rows, columns = _region(h // 2), _region(w // 2)
    region = jnp.einsum("ij,kjlc,ml->kimc", rows, sums, columns)
    whole = jnp.broadcast_to(sums.mean((1, 2), keepdims=True), sums.shape)
    for around in (region, whole):
        known = around[..., 1] > SHARED / 4
        level = jnp.log(around[..., 0] / jnp.maximum(around[..., 1], EPS) + 0.01)
        best = jnp.min(jnp.where(known, level, jnp.inf), 0, keepdims=True)
        best = jnp.where(jnp.isfinite(best), best, 0.0)
        told += [jnp.where(known, level - best, 1.0), around[..., 1]]
    return jnp.stack(told, -1)


def _region(n: int) -> np.ndarray:
    """Weights [n, n] of the cells around each of `n` in a row."""
    apart = np.arange(n)[:, None] - np.arange(n)[None]
    weights = np.exp(-0.5 * np.square(apart / REGION))
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def _coarse(p: Tree, maps, alike, way: Motion, reach, prior, context, head, around):
    """One view's distribution over the cuts of a cell, from prior [ch, cw, k], context [ch, cw, c] and the agreement of
    colours around it [k, ch, cw, 5].

    Returns its logits [k, ch, cw], the photos' mean colour under it [ch, cw, 3], the cut at its peak, the mass there
    [ch, cw], and the hidden state [ch, cw, c].
    """
    ch, cw, cuts = prior.shape
    numbers = jnp.arange(cuts, dtype=jnp.float32)
    way, where = in_pixels_of(way, CELL), pixels_of(ch, cw, CELL)
    values, seen = fetch(maps, way, where, all_cuts(cuts, ch * cw, reach))
    agreed = agreement(values, witnesses(seen, alike))
    mean, deviation, n = (x.reshape(cuts, ch, cw, -1) for x in agreed)
    # The rays speak of the cuts of the whole axis: between two of them, in proportion.
    between = jnp.maximum(1.0 - jnp.abs(reach * numbers[:, None] - numbers[None]), 0.0)
    prior = jnp.einsum("jk,yxk->jyx", between, prior)
    colour = mean[..., MATCHED:]
    evidence = [
        deviation[..., :MATCHED],
        jnp.abs(colour - head[None]),
        *_counts(n),
        prior[..., None],
        jnp.broadcast_to(context[None], (cuts, *context.shape)),
        jax.lax.stop_gradient(around),
    ]
    y = linear(p["enter"], jnp.concatenate(evidence, -1))
    for i in range(BLOCKS):
        block = jax.tree.map(lambda leaf, i=i: leaf[i], p["blocks"])
        y = y + conv2d(block["space"], jax.nn.relu(y))
        near = jnp.pad(jax.nn.relu(y), ((ALONG // 2,) * 2, (0, 0), (0, 0), (0, 0)))
        near = jnp.concatenate([near[j : j + cuts] for j in range(ALONG)], -1)
        along = block["along"] | {"kernel": block["along"]["kernel"].reshape(-1, WIDTH)}
        y = y + linear(along, near)
    logits = linear(p["score"], jax.nn.relu(y))[..., 0] + prior + UNSEEN * (n[..., 0] < 0.5)
    share = jax.nn.softmax(logits, 0)
    colours = (share[..., None] * jnp.where(n > 0, colour, head[None])).sum(0)
    # The mean over all cuts lies between two surfaces and on neither: only the peak and its neighbours count.
    peak = jax.lax.stop_gradient(jnp.argmax(logits, 0))
    about = share * (jnp.abs(numbers[:, None, None] - peak[None]) <= 2)
    mass = about.sum(0)
    cut = (about * numbers[:, None, None]).sum(0) / mass
    return logits, colours, cut, mass, (share[..., None] * y).sum(0)


def _fine(p: Tree, photos, alike, cuts: int, way: Motion, reach, cut, head):
    """One view's colours in every photo [m, h, w, 3] about the cut [h, w], how much of them is seen [m, h, w, 1], and the
    cut itself, refined.
    """
    h, w = cut.shape
    offsets = jnp.asarray((np.arange(FINE) - (FINE - 1) / 2) / 4, jnp.float32)
    inverse = inverse_depth(offsets[:, None] + cut.reshape(1, -1), cuts, reach)
    values, seen = fetch(photos, way, pixels_of(h, w, 1), inverse)
    agreed = agreement(values, witnesses(seen, alike))
    mean, deviation, n = (x.reshape(FINE, h, w, -1) for x in agreed)
    y = jnp.concatenate([deviation, jnp.abs(mean - head[None]), *_counts(n)], -1)
    y = jnp.moveaxis(y, 0, 2).reshape(1, h, w, -1)
    y = jax.nn.relu(conv2d(p["conv1"], y))
    y = y + jax.nn.relu(conv2d(p["conv2"], y))
    logits = jnp.moveaxis(conv2d(p["conv3"], y)[0], -1, 0) + UNSEEN * (n[..., 0] < 0.5)
    share = jax.nn.softmax(logits, 0)
    refined = cut + (share * offsets[:, None, None]).sum(0)
    share = share.reshape(FINE, 1, h * w, 1)
    m = len(photos)
    found = summed(share * jnp.swapaxes(values, 0, 1)).reshape(m, h, w, 3)
    seen = summed(share * jnp.swapaxes(seen[..., None], 0, 1)).reshape(m, h, w, 1)
    return found, seen, refined


def _upsampled(weights, x) -> jax.Array:
    """[ch, cw] -> [4 ch, 4 cw], every pixel a mean of the nine cells around it by weights [ch, cw, 16 * 9]."""
    ch, cw = x.shape
    weights = jax.nn.softmax(weights.reshape(ch, cw, CELL**2, 9), -1)
    x = jnp.pad(x, 1, mode="edge")
    nine = jnp.stack([x[i : i + ch, j : j + cw] for i in range(3) for j in range(3)], -1)
    x = (weights * nine[:, :, None]).sum(-1)
    return unpatchify(x.reshape(1, ch * cw, CELL**2), (ch, cw), CELL)[0, ..., 0]


def _distances(c2w, photo_c2w) -> tuple[jax.Array, jax.Array]:
    """How far photos are from views as `metrics.baselines.view_distances` says it: distance of the centres, to be divided
    by the depth, and the angle between the cameras as a chord, each [v, m].
    """
    centres = c2w[:, None, :3, 3] - photo_c2w[None, :, :3, 3]
    turns = c2w[:, None, :3, :3] - photo_c2w[None, :, :3, :3]
    apart = jnp.sqrt(jnp.square(centres).sum(-1))
    return apart, jnp.sqrt(jnp.square(turns).sum((-1, -2)) / 2)


def _chosen(p: Tree, found, seen, alike, far, head):
    """The photos' colours [m, h, w, 3] weighed, from how much of them is seen and how far they are [m, h, w, 1]: (colour
    [h, w, 3], how much of it is seen [h, w, 1], two numbers per pixel about the choice [h, w, 2], the weights [m, h, w, 1]).

    The choice starts from 1 / distance^2 among photos that see the cut.
    """
    weight = witnesses(seen, alike)
    mean = summed(found * weight) / jnp.maximum(summed(weight), EPS)
    nearest = far.min(0, keepdims=True)
    change = found - mean[None]
    odd = jnp.abs(change).mean(-1, keepdims=True)
    ratio = nearest / (far + 1e-3)
    known = [found - head[None], change, odd, seen, far, far - nearest, ratio]
    y = jax.nn.relu(conv2d(p["conv1"], jnp.concatenate(known, -1)))
    y = conv2d(p["conv2"], y)
    near = -2.0 * jnp.log(far / (nearest + 1e-3) + 1e-2)
    share = jax.nn.softmax(y + jnp.log(witnesses(seen + 1e-4, alike)) + near, 0)
    looked = summed(share * found)
    spread = summed(share * jnp.square(found - looked[None])).mean(-1, keepdims=True)
    about = jnp.concatenate([jnp.sqrt(spread + 1e-6), summed(share * far)], -1)
    return looked, summed(share * seen), about, share


def _merged(p: Tree, head, looked, some, about) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The RGB head's picture of a view and the photos' colours, mixed and corrected: (the mixture [h, w, 3], the photos'
    part in it [h, w, 1], the correction [h, w, 3])."""
    change = looked - head
    odd = jnp.abs(change).mean(-1, keepdims=True)
    y = jnp.concatenate([head - 0.5, looked - 0.5, change, odd, some, about], -1)
    y = jax.nn.relu(conv2d(p["conv1"], y[None]))
    y = y + jax.nn.relu(conv2d(p["conv2"], y))
    y = conv2d(p["conv3"], y)[0]
    gate, rest = jax.nn.sigmoid(y[..., :1]) * some, y[..., 1:]
    return jnp.clip(head + gate * change + rest, 0.0, 1.0), gate, rest
