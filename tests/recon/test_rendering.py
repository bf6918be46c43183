"""Image-based rendering at output size: aggregation of the cuts' costs, pyramids of photos, and the picture they make."""

import functools

import jax
import numpy as np
import pytest
from compiled import compiled
from test_lookup import CUTS, RNG, D, H, W, init, side_by_side, textured_plane

from roge_jax.recon import aggregate, lookup, rendering, sweep

aggregate, lookup, rendering, sweep = map(compiled, (aggregate, lookup, rendering, sweep))


def dynamic_programming(cost: np.ndarray) -> float:
    """The least sum of own costs and of steps between neighbours in a row [k, w], by trying everything one by one."""
    total = cost[:, 0].astype(float)
    k = np.arange(len(cost))
    apart = np.abs(k[:, None] - k[None])
    steps = np.where(apart == 0, 0.0, np.where(apart == 1, aggregate.STEP, aggregate.JUMP))
    for own in cost[:, 1:].T:
        total = own + (total[None] + steps).min(1)
    return float(total.min())


def test_semi_global_costs_are_those_of_the_best_path():
    """Along a single row both ways meet: at every pixel the two sums less its own cost are the best path through it."""
    cost = RNG.random((6, 1, 9))
    both = 4.0 * np.asarray(
        aggregate.semi_global(np.asarray(cost))
    )  # up and down see themselves alone
    along = both[:, 0] - 2.0 * cost[:, 0]
    through = along - cost[:, 0]  # each way subtracts the least cost before it
    best = dynamic_programming(cost[:, 0])
    path = through.min(0)
    # The normalisers differ from pixel to pixel; the cut that the best path takes does not.
    for x in range(9):
        kept = cost[:, 0].copy()
        forced = []
        for k in range(6):
            alone = kept.copy()
            alone[np.arange(6) != k, x] += 1e6
            forced.append(dynamic_programming(alone))
        np.testing.assert_allclose(through[:, x] - path[x], np.array(forced) - best, atol=1e-5)


def path_by_path(cost: np.ndarray, directions: list[tuple[int, int]]) -> np.ndarray:
    """Semi-global aggregation as the paper writes it: every pixel asks the one before it, direction by direction."""
    k, h, w = cost.shape
    total = np.zeros_like(cost)
    for dy, dx in directions:
        along = np.zeros_like(cost)
        for y in range(h) if dy >= 0 else reversed(range(h)):
            for x in range(w) if dx >= 0 else reversed(range(w)):
                along[:, y, x] = cost[:, y, x]
                if 0 <= y - dy < h and 0 <= x - dx < w:
                    before = along[:, y - dy, x - dx]
                    near = np.full((2, k), np.inf)
                    near[0, 1:], near[1, :-1] = before[:-1], before[1:]
                    least = before.min()
                    ways = [before, *(near + aggregate.STEP), np.full(k, least + aggregate.JUMP)]
                    along[:, y, x] += np.min(ways, 0) - least
        total += along
    return total / len(directions)


@pytest.mark.parametrize("diagonals", [False, True])
def test_semi_global_is_the_mean_over_its_directions(diagonals):
    cost = 8.0 * RNG.random((5, 6, 9))
    around = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    used = [(y, x) for y, x in around if abs(y) + abs(x) == 1 or (diagonals and y and x)]
    found = aggregate.semi_global(np.asarray(cost), diagonals=diagonals)
    np.testing.assert_allclose(found, path_by_path(cost, used), atol=1e-5)


def test_a_lone_outlier_follows_its_neighbours_and_an_edge_stays():
    cost = np.full((8, 12, 16), 0.2, np.float32)
    truth = np.where(np.arange(16) < 8, 2, 6)[None].repeat(12, 0)
    np.put_along_axis(cost, truth[None], 0.0, 0)
    cost[:, 5, 3] = 0.2
    cost[7, 5, 3] = 0.15  # wrong by itself
    cut = np.asarray(aggregate.cheapest(aggregate.semi_global(np.asarray(cost))))
    np.testing.assert_allclose(cut, truth, atol=0.05)


def test_the_cut_between_cuts_is_a_parabola_s():
    k, least = np.arange(7.0), 3.3
    cost = np.square(k - least)[:, None, None]
    assert float(aggregate.cheapest(np.asarray(cost))[0, 0]) == pytest.approx(least, abs=1e-5)
    for end in (0.0, 6.0):  # no parabola at the ends
        cost = np.abs(k - end)[:, None, None]
        assert float(aggregate.cheapest(np.asarray(cost))[0, 0]) == end


def test_enlarged_cuts_never_lie_between_two_surfaces():
    cut = np.full((6, 8), 3.0)
    cut[:, 4:] = 11.0
    cut[2, 1] = 4.0  # a slope on one surface is interpolated
    big = np.asarray(aggregate.enlarged(np.asarray(cut), 18, 24)).round(4)
    assert big.shape == (18, 24)
    assert np.all((big <= 4.0) | (big == 11.0)) and np.any((big > 3.0) & (big < 4.0))
    assert np.all(big[:, :11] <= 4.0) and np.all(big[:, 13:] == 11.0)
    same = aggregate.enlarged(np.asarray(cut), 6, 8)
    np.testing.assert_allclose(same, cut)


def test_enlarged_edges_cut_corners():
    """A slanted edge of cells has a finer one, closer to the line than the cells' own steps."""
    y, x = np.mgrid[:24, :32] + 0.5
    line = np.where(x + 0.6 * y < 22, 2.0, 9.0)
    cells = np.where(x[::4, ::4] + 1.5 + 0.6 * (y[::4, ::4] + 1.5) < 22, 2.0, 9.0)
    big = np.asarray(aggregate.enlarged(np.asarray(cells), 24, 32)).round(4)
    steps = cells.repeat(4, 0).repeat(4, 1)
    assert set(np.unique(big)) == {2.0, 9.0}
    assert (big != line).mean() < (steps != line).mean()


def test_a_pyramid_gives_means_of_what_is_finer():
    photos = RNG.random((2, 16, 24, 3)).astype(np.float32)

    @compiled
    def read_at(photos, x, y, level):
        return rendering.Pyramid.of(photos).read(x, y, level)

    y, x = np.mgrid[2:14, 2:22] + 0.5
    x, y = (np.tile(z.reshape(1, -1), (2, 1)).astype(np.float32) for z in (x, y))
    read = functools.partial(read_at, photos, x, y)
    sharp, half, quarter = (np.asarray(read(np.full(x.shape, k))) for k in (-3.0, 1.0, 9.0))
    np.testing.assert_allclose(sharp, photos[:, 2:14, 2:22].reshape(2, -1, 3), atol=1e-5)
    small = np.asarray(jax.image.resize(photos, (2, 8, 12, 3), "linear", antialias=True))
    np.testing.assert_allclose(
        half[:, [21]],
        small[:, [1], 1] * 0.5625
        + small[:, [1], 2] * 0.1875
        + small[:, [2], 1] * 0.1875
        + small[:, [2], 2] * 0.0625,
        atol=1e-5,
    )
    assert np.std(quarter) < np.std(half) < 0.5 * np.std(sharp)
    between = np.asarray(read(np.full(x.shape, 0.25)))
    np.testing.assert_allclose(between, 0.75 * sharp + 0.25 * half, atol=1e-5)


def whole(pictures: np.ndarray) -> rendering.Photos:
    """Photos that show just what the model's H x W ones show."""
    m, h, w, _ = pictures.shape
    ones = np.ones((m, 1), np.float32)
    scale = ones * np.array([h / H, w / W], np.float32)
    coarse = pictures.reshape(m, H, h // H, W, w // W, 3).mean((2, 4))
    size = ones * np.array([h, w], np.float32)
    return rendering.Photos(*map(np.asarray, (pictures, coarse, size, scale, 0.0 * scale)))


def plane(size: int):
    """A view and the two photos beside it of a textured plane: the view's picture at `size` times H x W, photos likewise,
    cameras at H x W, and the blend that knows the depth."""
    K, c2w = side_by_side(3, 0.15)
    order = [1, 0, 2]
    K, c2w = K[order], c2w[order]
    cut = 8
    depth = 1.0 / float(sweep.inverse_depth(np.float32(cut), CUTS))
    scaled = K * np.array([size, size, 1.0], np.float32)[:, None]
    pictures = textured_plane(scaled, c2w, depth, size * H, size * W, 1.0 * size)
    blend = rendering.Blend(
        inverse=np.full((1, H, W), 1.0 / depth),
        step=np.full(1, 0.1),
        share=np.full((1, 2, H, W, 1), 0.5),
        clear=np.ones((1, 2, H, W, 1)),
        gate=np.full((1, H, W, 1), 0.5),
        head=np.full((1, H, W, 3), 0.5),
        rest=np.zeros((1, H, W, 3)),
    )
    way = sweep.motion(K[:1], c2w[:1], K[1:], c2w[1:])
    return pictures, way, blend


@pytest.mark.parametrize("size", [1, 3])
def test_a_known_surface_is_as_sharp_as_its_photos(size):
    pictures, way, blend = plane(size)
    scale = np.ones((1, 2))
    shown = rendering.render(
        whole(pictures[1:]), way, blend, scale, height=size * H, width=size * W
    )
    middle = np.s_[2 * size : -2 * size, 8 * size : -8 * size]
    off = np.abs(np.asarray(shown[0]) - pictures[0])[middle]
    assert off.mean() < 0.02, off.mean()
    if size > 1:  # which a picture of the model's size, enlarged, is not
        small = np.asarray(pictures[0]).reshape(H, size, W, size, 3).mean((1, 3))
        blurred = np.abs(small.repeat(size, 0).repeat(size, 1) - pictures[0])[middle]
        assert off.mean() < 0.5 * blurred.mean()


def test_what_the_model_is_not_shown_of_a_photo_is_read_too():
    """Whole photos with more around the model's window give the same picture, and more of it."""
    pictures, way, blend = plane(1)
    K, c2w = (x[[0]] for x in side_by_side(3, 0.15))
    top, left, extra = 3, 9, 40
    depth = 1.0 / float(sweep.inverse_depth(np.float32(8), CUTS))
    wider = K + np.array([[0, 0, left], [0, 0, top], [0, 0, 0]], np.float32)
    photo = textured_plane(wider, c2w, depth, H + 6, W + extra)
    size, offset, one = (
        np.array([x], np.float32) for x in ((H + 6, W + extra), (top, left), (1, 1))
    )
    more = rendering.Photos(*map(np.asarray, (photo, photo, size, one, offset)))
    way = sweep.Motion(way.turn[:, :1], way.shift[:, :1])
    only = np.ones((1, 1, H, W, 1))
    blend = blend._replace(share=only, clear=only)
    shape = {"height": H, "width": W}
    cut, uncut = (
        np.asarray(rendering.render(x, way, blend, np.ones((1, 1)), **shape))[0]
        for x in (whole(pictures[1:2]), more)
    )
    np.testing.assert_allclose(uncut[:, :-18], cut[:, :-18], atol=0.03)
    off = [np.abs(x - pictures[0])[:, -12:].mean() for x in (cut, uncut)]
    assert off[1] < 0.1 * off[0]  # where the window ends and the photo does not
    np.testing.assert_allclose(more.shrunk().offset, offset)


def test_where_no_photo_sees_anything_the_mixture_stays():
    pictures, way, blend = plane(1)
    away = sweep.Motion(-way.turn, -way.shift)  # everything lies behind the photos
    shown = rendering.render(
        whole(pictures[1:]),
        away,
        blend,
        np.ones((1, 2)),
        height=2 * H,
        width=2 * W,
    )
    np.testing.assert_allclose(np.asarray(shown), 0.5, atol=1e-6)  # no black: nothing is taken


def test_photos_that_disagree_leave_the_picture_to_the_mixture():
    pictures, way, blend = plane(1)
    photos = np.stack([np.zeros_like(pictures[1]), np.ones_like(pictures[2])])
    shown = rendering.render(whole(photos), way, blend, np.ones((1, 2)), height=H, width=W)
    middle = np.asarray(shown)[0, 2:-2, 18:-18]
    np.testing.assert_allclose(middle, 0.5, atol=0.02)


def test_a_photo_with_something_in_front_is_left_out_and_the_better_one_counts_more():
    pictures, way, blend = plane(1)
    photos = whole(np.stack([np.zeros_like(pictures[1]), np.full_like(pictures[2], 0.03)]))
    blend = blend._replace(gate=np.ones_like(blend.gate))  # the photos alone

    def shown(**changed):
        made = rendering.render(
            photos, way, blend._replace(**changed), np.ones((1, 2)), height=H, width=W
        )
        return np.asarray(made)[0, 4:-4, 18:-18]

    def each(a: float, b: float):
        return np.asarray([a, b]).reshape(1, 2, 1, 1, 1) * np.ones((1, 2, H, W, 1))

    np.testing.assert_allclose(shown(clear=each(0.0, 1.0)), 0.03, atol=1e-4)
    even, uneven = shown().mean(), shown(share=each(0.25, 0.75)).mean()
    ratio = 3.0**rendering.CHOICE
    np.testing.assert_allclose(uneven / even, 2 * ratio / (1 + ratio), rtol=1e-3)


def test_look_up_gives_the_picture_at_both_sizes():
    """The larger picture shows what the smaller one shows, and asking for it changes nothing of that."""
    p = init(jax.random.key(1), lookup.lookup_specs(D, 8, CUTS))
    K, c2w = side_by_side(3, 0.15)
    order = [1, 0, 2]
    K, c2w = K[order], c2w[order]
    depth = 1.0 / float(sweep.inverse_depth(np.float32(8), CUTS))
    big = textured_plane(K * np.array([3, 3, 1.0], np.float32)[:, None], c2w, depth, 3 * H, 3 * W)
    photos = big.reshape(3, H, 3, W, 3, 3).mean((2, 4))
    features = RNG.standard_normal((1, H // 8, W // 8, D)).astype(np.float32)
    head = np.full((1, H, W, 3), 0.5)
    given = (p, features, head, np.asarray(photos[1:]), (K[:1], c2w[:1]), (K[1:], c2w[1:]))
    full = lookup.Full(whole(big[1:]), 3 * H, 3 * W)
    both = lookup.look_up(*given, cuts=CUTS, full=full)
    alone = lookup.look_up(*given, cuts=CUTS)
    assert alone.full is None and both.full.shape == (1, 3 * H, 3 * W, 3)
    for a, b in zip(alone[:4], both[:4]):
        np.testing.assert_allclose(a, b, atol=1e-5)
    middle = np.s_[:, 6:-6, 24:-24]
    off = np.abs(np.asarray(both.full[0]) - big[0])[middle[1:]]
    head_off = np.abs(0.5 - big[0])[middle[1:]]
    assert off.mean() < 0.5 * head_off.mean()
