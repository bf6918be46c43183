"""Which cut of a ray is right, from all of a view's rays together: semi-global aggregation of what photos and network say.

The look-up decides cell by cell (`recon.lookup`), and where neighbours disagree its cuts jump from pixel to pixel. Here
every pixel has a cost for each cut, from how well the photos match there (`recon.matching`) and what the network
believes, and cuts of neighbours that differ cost as well (Hirschmueller 2008, four or eight directions). Nothing in here is
trained.
"""

import jax
import jax.numpy as jnp
import numpy as np

RADIUS = 3  # pixels about which luma is normalised
BELIEF = 1.0  # weight of the network's logarithmic probability beside the evidence
LEAST = -12.0  # it is not taken for less
HIDDEN = 20.0  # further cost of cuts that no photo sees
STEP, JUMP = 1.2, 10.0  # cost of a neighbour one cut, and more than one cut, away
EDGE = 0.06  # difference of neighbours' colours at which a jump costs half
AROUND = 2  # pixels: a finer level looks between the coarse answers of these
TAIL, MARGIN = 0.02, 1.2  # of inverse depths: left out at either end, and added again
TOGETHER = 1.5  # cuts by which neighbours on one surface differ at most


def with_structure(photos: jax.Array) -> jax.Array:
    """Photos [m, h, w, 3] with a fourth channel: luma less its mean around, over its deviation there."""
    luma = photos @ jnp.asarray([0.299, 0.587, 0.114])
    mean = box(luma, RADIUS)
    deviation = jnp.sqrt(jnp.maximum(box(jnp.square(luma), RADIUS) - jnp.square(mean), 0.0) + 1e-4)
    return jnp.concatenate([photos, ((luma - mean) / deviation)[..., None]], -1)


def box(x: jax.Array, radius: int) -> jax.Array:
    """Means over windows of 2 radius + 1 pixels a side along the last two axes, border repeated."""
    side = 2 * radius + 1
    x = jnp.pad(x, [(0, 0)] * (x.ndim - 2) + [(radius, radius)] * 2, mode="edge")
    for axis in (x.ndim - 2, x.ndim - 1):
        n = x.shape[axis] - side + 1
        parts = [jax.lax.slice_in_dim(x, i, i + n, axis=axis) for i in range(side)]
        x = jnp.stack(parts).mean(0)
    return x


def semi_global(
    cost: jax.Array, guide: jax.Array | None = None, *, diagonals: bool = False
) -> jax.Array:
    """Costs [k, h, w] of cuts with those of the neighbours along both axes, both ways.

    guide: [h, w, 3] the picture that they are of; where its colours change, cuts may jump for less. diagonals: along those
    as well, for twice the time: without a guide what nothing is known of has rectangular borders otherwise.
    """

    def along(cost: jax.Array, jump: jax.Array, reverse: bool) -> jax.Array:
        def step(before, given):
            own, jump = given
            least = before.min(0, keepdims=True)
            far = jnp.full_like(least, 1e9)
            near = jnp.minimum(
                jnp.concatenate([before[1:], far]), jnp.concatenate([far, before[:-1]])
            )
            total = own + jnp.minimum(jnp.minimum(before, near + STEP), least + jump[None]) - least
            return total, total

        rows = jnp.moveaxis(cost, -1, 0), jump.T
        _, total = jax.lax.scan(step, jnp.zeros_like(rows[0][0]), rows, reverse=reverse)
        return jnp.moveaxis(total, 0, -1)

    def both_ways(cost: jax.Array, guide: jax.Array | None) -> jax.Array:
        jump = jnp.full(cost.shape[1:], JUMP)
        first = last = jump
        if guide is not None:
            apart = jnp.abs(guide[:, 1:] - guide[:, :-1]).mean(-1)
            cheaper = jnp.maximum(JUMP / (1.0 + apart / EDGE), STEP)
            first, last = jump.at[:, 1:].set(cheaper), jump.at[:, :-1].set(cheaper)
        return along(cost, first, False) + along(cost, last, True)

    def down(cost: jax.Array, guide: jax.Array | None) -> jax.Array:
        turned = None if guide is None else jnp.swapaxes(guide, 0, 1)
        return jnp.swapaxes(both_ways(jnp.swapaxes(cost, 1, 2), turned), 1, 2)

    total = both_ways(cost, guide) + down(cost, guide)
    if not diagonals:
        return total / 4
    assert guide is None, "a guide is not skewed"
    w = cost.shape[2]
    falling = skewed(cost[..., ::-1])  # its columns are the diagonals of the mirrored pixels
    total = total + straightened(down(skewed(cost), None), w)
    return (total + straightened(down(falling, None), w)[..., ::-1]) / 8


def skewed(x: jax.Array) -> jax.Array:
    """[.., h, w] -> [.., h, w + h - 1], row y moved right by y, zeros beside it: columns are diagonals."""
    h, w = x.shape[-2:]
    x = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, h)]).reshape(*x.shape[:-2], h * (w + h))
    return x[..., : h * (w + h - 1)].reshape(*x.shape[:-1], h, w + h - 1)


def straightened(x: jax.Array, w: int) -> jax.Array:
    """The inverse of `skewed`: [.., h, w + h - 1] -> [.., h, w]."""
    h = x.shape[-2]
    x = x.reshape(*x.shape[:-2], -1)
    x = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, h)])
    return x.reshape(*x.shape[:-1], h, w + h)[..., :w]


def cheapest(cost: jax.Array) -> jax.Array:
    """The cut [h, w] of least cost [k, h, w], between cuts by a parabola."""
    k, most = jnp.argmin(cost, 0), len(cost) - 1

    def at(step: int) -> jax.Array:
        return jnp.take_along_axis(cost, jnp.clip(k + step, 0, most)[None], 0)[0]

    before, own, after = at(-1), at(0), at(1)
    bend = before - 2.0 * own + after
    step = jnp.clip(0.5 * (before - after) / jnp.maximum(bend, 1e-6), -0.5, 0.5)
    return k + jnp.where((k > 0) & (k < most) & (bend > 1e-6), step, 0.0)


def with_belief(evidence: jax.Array, seen: jax.Array, belief: jax.Array | None = None) -> jax.Array:
    """Costs [k, h, w] of cuts from evidence [k, h, w] (logits), the number of photos that see them [k, h, w], and the
    network's logits over the cuts of cells `belief` [k, ch, cw]."""
    cost = HIDDEN * (seen <= 0) - evidence
    if belief is None:
        return cost
    believed = jax.image.resize(jax.nn.log_softmax(belief, 0), cost.shape, "linear")
    return cost - BELIEF * jnp.maximum(believed, LEAST)


def envelope(
    low: jax.Array, high: jax.Array, height: int, width: int
) -> tuple[jax.Array, jax.Array]:
    """Bounds [height, width] of the inverse depth of a pixel from those of a coarser level [h, w]: the least and the
    largest of the pixels `AROUND`. Both vary smoothly, so that labels of neighbours can be compared."""
    side = 2 * AROUND + 1
    window, ones = (side, side), (1, 1)
    low = jax.lax.reduce_window(low, jnp.inf, jax.lax.min, window, ones, "SAME")
    high = jax.lax.reduce_window(high, -jnp.inf, jax.lax.max, window, ones, "SAME")
    low, high = jax.image.resize(box(jnp.stack([low, high]), 1), (2, height, width), "linear")
    return low, high


def occupied(inverse: jax.Array, count: int) -> jax.Array:
    """`count` inverse depths, evenly spaced, over those that most of a view's pixels have [h, w]."""
    low, high = jnp.quantile(inverse, jnp.asarray([TAIL, 1.0 - TAIL]))
    low, high = low / MARGIN, jnp.maximum(high * MARGIN, low / MARGIN + 1e-3)
    return low + (high - low) * jnp.arange(count) / (count - 1)


def enlarged(
    cut: jax.Array, height: int, width: int, together: jax.Array | float = TOGETHER
) -> jax.Array:
    """Cuts [h, w] at [height, width]: bilinear on a surface, where neighbours differ by less than `together`, and from one
    of its sides at an edge, never between."""
    h, w = cut.shape
    places, shares = [], []
    for size, small in ((height, h), (width, w)):
        at = np.clip((np.arange(size) + 0.5) * small / size - 0.5, 0.0, small - 1.0)
        low = np.minimum(at.astype(int), max(small - 2, 0))
        places.append((low, np.minimum(low + 1, small - 1)))
        shares.append((1.0 - (at - low), at - low))
    four = [(i, j) for i in (0, 1) for j in (0, 1)]
    parts = [shares[0][i][:, None] * shares[1][j][None] for i, j in four]
    share = jnp.asarray(np.stack(parts), jnp.float32)
    values = jnp.stack([cut[places[0][i]][:, places[1][j]] for i, j in four])
    # The side of an edge with the larger share, which cuts corners where the nearest neighbour makes steps.
    own, most = values[0], jnp.zeros((height, width))
    for i in range(4):
        agreed = (share * (jnp.abs(values - values[i : i + 1]) < together)).sum(0) + 1e-3 * share[i]
        own, most = jnp.where(agreed > most, values[i], own), jnp.maximum(agreed, most)
    share = share * (jnp.abs(values - own[None]) < together)
    return (share * values).sum(0) / share.sum(0)
