"""Parts of the photo look-up whose networks say nothing, or one known thing: each by its closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled

from roge_jax.core.params import init
from roge_jax.recon import lookup, sweep

lookup, sweep = compiled(lookup), compiled(sweep)
H, W, CUTS, D = 16, 24, 12, 8
RNG = np.random.default_rng(0)
# All leaves at zero: every network returns its bias, which is zero too.
SILENT = jax.tree.map(np.zeros_like, init(jax.random.key(0), lookup.lookup_specs(D, 8, CUTS)))
ALONE = np.eye(3, dtype=np.float32)  # photos from places far apart


def softmax(x, axis):
    e = np.exp(x - x.max(axis, keepdims=True))
    return e / e.sum(axis, keepdims=True)


def own_camera() -> sweep.Motion:
    """From a view to one photo from the same camera: every cut of a ray is seen in the ray's own pixel."""
    K = np.asarray([[[20.0, 0, W / 2], [0, 20.0, H / 2], [0, 0, 1]]])
    way = sweep.motion(K, np.eye(4)[None], K, np.eye(4)[None])
    return sweep.Motion(way.turn[0], way.shift[0])


def test_agreement_is_the_sample_deviation_of_those_who_see():
    """Divided by one less than their number: two photos that differ as three do agree as badly."""
    values = RNG.random((3, 5, 2)).astype(np.float32)
    weight = np.ones((3, 5), np.float32)
    weight[2, 3], weight[1:, 4] = 0.0, 0.0  # two see the fourth cut, one the last
    mean, deviation, n = sweep.agreement(jnp.asarray(values), jnp.asarray(weight))
    np.testing.assert_array_equal(n[:, 0], [3, 3, 3, 2, 1])
    for cut, seen in ((0, 3), (1, 3), (2, 3), (3, 2)):
        np.testing.assert_allclose(mean[cut], values[:seen, cut].mean(0), atol=1e-6)
        variance = values[:seen, cut].var(0, ddof=1)
        np.testing.assert_allclose(deviation[cut], np.sqrt(variance + 1e-4), atol=1e-5)
    np.testing.assert_allclose(mean[4], values[0, 4], atol=1e-6)
    np.testing.assert_allclose(deviation[4], np.sqrt(sweep.STRANGE), rtol=1e-3)


def test_the_choice_of_a_photo_starts_from_one_over_its_distance_squared():
    found = RNG.random((3, H, W, 3))
    far = RNG.uniform(0.1, 2.0, (3, H, W, 1))
    seen = np.ones((3, H, W, 1))
    seen[0, :4] = 0.0  # the first photo does not see the upper rows
    looked, some, about, weights = lookup._chosen(
        SILENT["choose"], *map(jnp.asarray, (found, seen)), ALONE, far, np.full((H, W, 3), 0.5)
    )
    share = seen / far**2 / (seen / far**2).sum(0)
    np.testing.assert_allclose(weights, share, atol=0.02)
    np.testing.assert_allclose(looked, (share * found).sum(0), atol=0.02)
    np.testing.assert_allclose(some, 1.0, atol=0.02)
    spread = (share * np.square(found - (share * found).sum(0))).sum(0).mean(-1)
    np.testing.assert_allclose(about[..., 0], np.sqrt(spread), atol=0.02)
    np.testing.assert_allclose(about[..., 1], (share * far).sum(0)[..., 0], atol=0.03)


def test_photos_enter_the_picture_as_far_as_they_see():
    """Half and half with the RGB head where all of it is seen, its share of that where some is."""
    head, looked = RNG.random((2, H, W, 3))
    some = RNG.random((H, W, 1))
    mixed, gate, rest = lookup._merged(
        SILENT["merge"], *map(jnp.asarray, (head, looked, some, RNG.random((H, W, 3))))
    )
    np.testing.assert_allclose(mixed, head + 0.5 * some * (looked - head), atol=1e-6)
    np.testing.assert_allclose(gate, 0.5 * some, atol=1e-6)
    assert not np.any(rest)


def test_upsampled_cells_are_means_of_their_neighbours():
    """A flat map stays flat to its borders, whatever the weights; equal weights are a mean over nine cells."""
    ch, cw = 4, 6
    weights = jnp.asarray(RNG.standard_normal((ch, cw, 9 * lookup.CELL**2)))
    np.testing.assert_allclose(lookup._upsampled(weights, np.full((ch, cw), 7.0)), 7.0, rtol=1e-6)
    x = RNG.random((ch, cw))
    big = lookup._upsampled(np.zeros_like(weights), jnp.asarray(x))
    assert big.shape == (ch * lookup.CELL, cw * lookup.CELL)
    for row, column in ((1, 1), (2, 4)):
        nine = x[row - 1 : row + 2, column - 1 : column + 2].mean()
        pixels = big[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        np.testing.assert_allclose(pixels, nine, rtol=1e-5)


@pytest.mark.parametrize("n", [1, 7])
def test_weights_of_a_region_are_those_of_a_mean(n):
    weights = lookup._region(n)
    np.testing.assert_allclose(weights.sum(1), 1.0, rtol=1e-6)
    apart = np.log(weights[0] / weights[0, 0])
    np.testing.assert_allclose(apart, -0.5 * (np.arange(n) / lookup.REGION) ** 2, atol=1e-5)


def test_the_coarse_answer_is_the_peak_and_its_neighbours():
    """Of a distribution that the ray features alone decide: two cuts to either side of the peak count, by their mass."""
    ch, cw = H // lookup.CELL, W // lookup.CELL
    maps = RNG.random((1, ch, cw, lookup.MATCHED + 3)).astype(np.float32)
    prior = 3.0 * RNG.standard_normal((ch, cw, CUTS)).astype(np.float32)
    logits, colours, cut, mass, _ = lookup._coarse(
        SILENT,
        jnp.asarray(maps),
        np.eye(1),
        own_camera(),
        1.0,
        jnp.asarray(prior),
        np.zeros((ch, cw, lookup.WIDTH)),
        np.zeros((ch, cw, 3)),
        np.zeros((CUTS, ch, cw, lookup.AGREED)),
    )
    share, numbers = softmax(prior.astype(np.float64), -1), np.arange(CUTS)
    about = share * (np.abs(numbers - prior.argmax(-1)[..., None]) <= 2)
    np.testing.assert_allclose(np.moveaxis(logits, 0, -1), prior, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(mass, about.sum(-1), rtol=1e-4)
    np.testing.assert_allclose(cut, (about * numbers).sum(-1) / about.sum(-1), rtol=1e-4)
    np.testing.assert_allclose(colours, maps[0, ..., lookup.MATCHED :], atol=2e-3)


@pytest.mark.parametrize("reach", [1.0, 0.5])
def test_fine_cuts_stand_a_quarter_apart_about_the_coarse_one(reach):
    """What the fine network favours moves the cut by its offset, and the colours are those found at its depth."""
    apart, focal = 0.1, 20.0
    K = np.asarray([[[focal, 0, W / 2], [0, focal, H / 2], [0, 0, 1]]])
    beside = np.eye(4)[None]
    beside[:, 0, 3] = apart
    way = sweep.motion(K, np.eye(4)[None], K, beside)
    ramp = np.broadcast_to((np.arange(W) + 0.5)[None, None, :, None], (1, H, W, 3))
    cut = jnp.asarray(RNG.uniform(2.0, 9.0, (H, W)), jnp.float32)
    for place, moves in ((0, -0.875), (5, 0.375)):
        bias = np.zeros(lookup.FINE, np.float32)
        bias[place] = 50.0
        p = SILENT["fine"] | {"conv3": SILENT["fine"]["conv3"] | {"bias": bias}}
        way_of_one = sweep.Motion(way.turn[0], way.shift[0])
        found, seen, refined = lookup._fine(
            p,
            jnp.asarray(ramp, jnp.float32),
            np.eye(1),
            CUTS,
            way_of_one,
            reach,
            cut,
            np.zeros((H, W, 3)),
        )
        np.testing.assert_allclose(refined, cut + moves, rtol=1e-5)
        inverse = (reach * np.asarray(cut + moves) / (CUTS - 1)) ** sweep.SPACING / sweep.NEAREST
        want = ramp[0, ..., 0] - focal * apart * inverse
        inside = (want > 0.5) & (want < W - 0.5)
        assert inside.mean() > 0.5 and np.all(np.asarray(seen)[0, ..., 0][inside] == 1.0)
        np.testing.assert_allclose(np.asarray(found)[0, ..., 0][inside], want[inside], atol=5e-3)


@pytest.mark.parametrize(("favoured", "near"), [(2, False), (7, True)])
def test_a_photo_from_aside_is_far_from_near_things_and_close_to_distant_ones(favoured, near):
    """Of a photo from the view's own place, turned a little, and one from beside it: parallax is distance over depth."""
    p = init(jax.random.key(0), lookup.lookup_specs(D, 8, CUTS))
    p = jax.tree.map(np.zeros_like, p)
    likely = np.zeros(CUTS + lookup.WIDTH, np.float32)
    likely[favoured] = 30.0
    p["prior"]["bias"] = np.tile(likely, 4)
    K = np.tile(np.asarray([[[20.0, 0, W / 2], [0, 20.0, H / 2], [0, 0, 1]]]), (2, 1, 1))
    s, c = np.sin(0.2), np.cos(0.2)
    turned = np.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    seen_by = np.tile(np.eye(4), (2, 1, 1))
    seen_by[0, :3, :3], seen_by[1, 0, 3] = turned, 0.2
    photos = np.broadcast_to(np.asarray([0.2, 0.8])[:, None, None, None], (2, H, W, 3))
    features, head = np.zeros((1, H // 8, W // 8, D)), np.full((1, H, W, 3), 0.5)
    of = K[:1], np.eye(4)[None]
    found = lookup.look_up(p, features, head, photos, of, (K, seen_by), cuts=CUTS)
    distances = np.array([2 * np.sin(0.1), 0.2 * sweep.inverse_depth(jnp.float32(favoured), CUTS)])
    share = distances**-2.0 / (distances**-2.0).sum()
    assert (share[0] > 0.75) if near else (share[0] < 0.25)
    np.testing.assert_allclose(np.median(found.photos), share @ [0.2, 0.8], atol=0.03)
