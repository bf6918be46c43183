"""Matching of photos: learned features, evidence of pairs, surfaces coarse to fine, and what teaches the features."""

import functools

import jax
import numpy as np
import optax
import pytest
from compiled import compiled
from test_lookup import CUTS, H, W, init, side_by_side, textured_plane
from test_rendering import whole

from roge_jax.recon import depth, matching, sweep
from roge_jax.training.matching import matching_terms

matching, sweep, matching_terms = map(compiled, (matching, sweep, matching_terms))
RNG = np.random.default_rng(3)
CHANNELS = 2 * matching.VECTOR + 4


@pytest.fixture(scope="module")
def match():
    return init(jax.random.key(5), matching.matching_specs())


def values_of(colour: np.ndarray, match) -> np.ndarray:
    """Colours [m, k, p, 3] as values of `described`: unit vectors that point along the colour."""
    m, k, p, _ = colour.shape
    values = np.zeros((m, k, p, CHANNELS if match is not None else 4), np.float32)
    values[..., -4:-1] = colour
    if match is not None:
        unit = colour / np.linalg.norm(colour, axis=-1, keepdims=True)
        values[..., :3] = values[..., matching.VECTOR : matching.VECTOR + 3] = unit
    return values


@pytest.mark.parametrize("learned", [False, True])
def test_one_pair_that_agrees_is_enough_and_strangers_are_not(match, learned):
    """A photo with something in front does not weaken the evidence that the two others agree on."""
    p = match if learned else None
    colour = np.full((3, 4, 1, 3), 0.3)
    colour[:, 1, 0] = [[0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.1, 0.1, 0.9]]  # three strangers
    colour[2, 2] = 0.9  # two agree, one is occluded
    seen = np.ones((3, 4, 1), np.float32)
    seen[1:, 3] = 0.0  # one alone
    found = functools.partial(matching.evidence, p, values_of(colour, p), seen)
    alone, apart = np.asarray(found(np.ones((3, 3))))[:, 0], np.asarray(found(np.eye(3)))[:, 0]
    assert apart[0] > apart[2] > apart[1] + 2.0
    assert apart[0] - apart[2] < 1.5  # of three pairs one agrees: a factor of three
    assert apart[3] == matching.STRANGE
    np.testing.assert_allclose(alone, matching.STRANGE)  # from one place they are no witnesses


def test_a_single_photo_gives_no_evidence(match):
    values = values_of(np.full((1, 4, 2, 3), 0.3), match)
    found = matching.evidence(match, values, np.ones((1, 4, 2)), np.eye(1))
    np.testing.assert_allclose(found, matching.STRANGE)


def test_descriptions_are_unit_vectors_in_front_of_colour_and_structure(match):
    photos = RNG.random((2, 11, 14, 3)).astype(np.float32)  # also of odd sizes
    still = sweep.Motion(np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)), np.zeros((2, 3)))
    where, once = sweep.pixels_of(11, 14, 1), np.ones((1, 11 * 14))

    @compiled
    def values(p, photos, way):
        return matching.described(p, photos).at(way, where, once, (11, 14))[0]

    read = [values(p, photos, still) for p in (match, None)]
    found, plain = (np.asarray(x).reshape(2, 11, 14, -1) for x in read)
    assert found.shape == (2, 11, 14, CHANNELS) and plain.shape == (2, 11, 14, 4)
    vectors = found[..., : 2 * matching.VECTOR].reshape(2, 11, 14, 2, matching.VECTOR)
    lengths = np.linalg.norm(vectors, axis=-1)
    assert np.all(lengths <= 1.0 + 1e-5) and np.median(lengths[..., 0]) > 0.99
    np.testing.assert_allclose(found[..., -4:], plain, atol=1e-6)
    np.testing.assert_allclose(plain[..., :3], photos, atol=1e-2)  # the border's is half a pixel in
    inner = np.s_[:, 1:-1, 1:-1]
    np.testing.assert_allclose(plain[..., :3][inner], photos[inner], atol=1e-4)
    # A pixel's vectors are its own, wherever in it they are read.
    turn = still.turn.copy()
    turn[:, 0, 2] = 0.4
    again = values(match, photos, sweep.Motion(turn, still.shift))
    again = np.asarray(again).reshape(2, 11, 14, -1)[..., : 2 * matching.VECTOR]
    np.testing.assert_array_equal(again, found[..., : 2 * matching.VECTOR])


@pytest.mark.parametrize("learned", [False, True])
def test_surfaces_lie_where_the_photos_agree(match, learned):
    """A textured plane, seen by two photos: its inverse depth, finer than the distance between coarse cuts."""
    p = match if learned else None
    K, c2w = side_by_side(3, 0.15)
    order = [1, 0, 2]
    K, c2w = K[order], c2w[order]
    true = float(sweep.inverse_depth(np.float32(8.4), CUTS))
    big = textured_plane(
        K * np.array([3, 3, 1.0], np.float32)[:, None], c2w, 1 / true, 3 * H, 3 * W
    )
    photos = whole(big[1:])
    way = jax.tree.map(lambda x: x[0], sweep.motion(K[:1], c2w[:1], K[1:], c2w[1:]))
    belief = np.zeros((CUTS, H // 4, W // 4))

    @jax.jit
    def find(photos):
        levels = [depth.Level.of(p, photos.shrunk(times)) for times in (1, depth.FINER)]
        alike = sweep.twins(c2w[1:])
        return depth.surfaces(p, tuple(levels), way, belief, 1.0, alike, (H, W))

    inverse, step = find(photos)
    assert inverse.shape == (depth.FINER * H, depth.FINER * W)
    middle = np.asarray(inverse)[12:-12, 40:-40]
    one = float(sweep.inverse_depth(np.float32(9.4), CUTS)) - true
    assert np.median(np.abs(middle - true)) < 0.25 * one
    assert float(step) > 0.0


def lesson(seed: int = 0):
    """A textured plane at a slant of known depth with two photos beside the target, as `data.views` gives it."""
    K, c2w = side_by_side(3, 0.15)
    order = [0, 2, 1]
    K, c2w = K[order], c2w[order]
    true = 1.0 / float(sweep.inverse_depth(np.float32(8 + seed % 3), CUTS))
    rgb = textured_plane(K, c2w, true, H, W)
    views = {"context_rgb": rgb[:2], "target_rgb": rgb[2:], "K": K, "c2w": c2w}
    return views | {"depth": np.full((3, H, W), true, np.float32)}


def test_the_loss_of_matching_is_that_of_guessing_for_strangers_and_falls_when_trained(match):
    terms = functools.partial(matching_terms, cuts=CUTS)
    views = jax.device_put(lesson())
    key = jax.random.key(0)
    blind = jax.tree.map(np.zeros_like, match)  # no weight on anything: all cuts are alike
    blind["weights"][4] = 1.0
    assert float(terms(blind, views, key)["loss"]) == pytest.approx(np.log(CUTS), rel=0.1)

    tx = optax.adam(3e-3)

    @jax.jit
    def step(p, state, key):
        grad = jax.grad(lambda p: matching_terms(p, views, key, cuts=CUTS)["loss"])(p)
        change, state = tx.update(grad, state)
        return optax.apply_updates(p, change), state

    p, state = match, tx.init(match)
    for i in range(30):
        p, state = step(p, state, jax.random.key(i + 1))
    before, after = (terms(x, views, key) for x in (match, p))
    assert float(after["loss"]) < 0.8 * float(before["loss"])
    assert float(after["right"]) >= float(before["right"])


def test_rays_of_points_that_one_photo_sees_teach_nothing(match):
    views = lesson()
    views["depth"][1] *= 0.5  # the second photo has something in front everywhere
    terms = matching_terms(match, views, jax.random.key(0), cuts=CUTS)
    assert float(terms["loss"]) == 0.0 and float(terms["right"]) == 0.0
