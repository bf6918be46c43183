"""Matching of photos: learned features, evidence of other photos, and what teaches the features."""

import functools

import jax
import numpy as np
import optax
import pytest
from compiled import compiled
from test_lookup import CUTS, H, W, init, side_by_side, textured_plane

from roge_jax.recon import matching, sweep
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
def test_one_photo_that_agrees_is_enough_and_strangers_are_not(match, learned):
    """A photo with something in front does not weaken the evidence of the one that agrees."""
    p = match if learned else None
    colour = np.full((3, 4, 1, 3), 0.3)
    colour[:, 1, 0] = [[0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.1, 0.1, 0.9]]  # three strangers
    colour[2, 2] = 0.9  # one agrees, one is occluded
    values = values_of(colour, p)
    seen = np.ones((2, 4, 1), np.float32)
    seen[:, 3] = 0.0  # none
    found = functools.partial(matching.evidence, p, values[0, 0], values[1:])
    level = np.asarray(found(seen))[:, 0]
    assert level[0] > level[2] > level[1] + 2.0
    assert level[0] - level[2] < 1.0  # of two one agrees: a factor of two
    assert level[3] == matching.STRANGE
    np.testing.assert_allclose(found(0.0 * seen), matching.STRANGE)


def test_descriptions_are_unit_vectors_in_front_of_colour_and_structure(match):
    photos = RNG.random((2, 11, 14, 3)).astype(np.float32)  # also of odd sizes
    still = sweep.Motion(np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)), np.zeros((2, 3)))
    where, once = sweep.pixels_of(11, 14, 1), np.ones((1, 11 * 14))

    @compiled
    def values(p, photos, way):
        held = matching.Described.of(matching.descriptions(p, photos))
        return held.at(way, where, once, (11, 14))[0]

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


def test_rays_of_points_that_no_photo_sees_teach_nothing(match):
    views = lesson()
    views["depth"][:2] *= 0.5  # both photos have something in front everywhere
    terms = matching_terms(match, views, jax.random.key(0), cuts=CUTS)
    assert float(terms["loss"]) == 0.0 and float(terms["right"]) == 0.0
