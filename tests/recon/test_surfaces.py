"""Depths of photos, found once, and what views make of them: surfaces, and which photo has something in front."""

import jax
import numpy as np
import pytest
from compiled import compiled
from test_lookup import CUTS, H, W, init, side_by_side, textured_plane, way_of
from test_rendering import whole

from roge_jax.recon import depth, matching, rendering, surfaces, sweep

depth, matching, rendering, surfaces, sweep = map(
    compiled, (depth, matching, rendering, surfaces, sweep)
)
TRUE = float(sweep.inverse_depth(np.float32(8.4), CUTS))
STEP = float(sweep.inverse_depth(np.float32(9.4), CUTS)) - TRUE  # of one cut
INNER = np.s_[:, 12:-12, 40:-40]


@pytest.fixture(scope="module")
def match():
    return init(jax.random.key(5), matching.matching_specs())


def cameras() -> tuple[np.ndarray, np.ndarray]:
    """A view between two photos, which comes first."""
    K, c2w = side_by_side(3, 0.06)
    order = [1, 0, 2]
    return K[order], c2w[order]


def plane_photos(K, c2w) -> rendering.Photos:
    """Of a textured plane, three times as fine as the model."""
    big = K * np.array([3, 3, 1.0], np.float32)[:, None]
    return whole(textured_plane(big, c2w, 1 / TRUE, 3 * H, 3 * W))


def find(match, photos, K, c2w):
    return depth.depths(match, photos, K, c2w, size=(H, W), cuts=CUTS)


@pytest.mark.parametrize("learned", [False, True])
def test_depths_lie_where_the_photos_agree(match, learned):
    """A textured plane: its inverse depth, finer than the distance between coarse cuts."""
    K, c2w = cameras()
    found = find(match if learned else None, plane_photos(K[1:], c2w[1:]), K[1:], c2w[1:])
    assert found.inverse.shape == found.sure.shape == (2, depth.FINER * H, depth.FINER * W)
    middle = np.asarray(found.inverse)[INNER]
    assert np.median(np.abs(middle - TRUE)) < 0.25 * STEP
    assert np.median(np.asarray(found.sure)[INNER]) > 0.9
    assert np.all(np.asarray(found.step) > 0)


def test_a_lone_photo_says_nothing(match):
    K, c2w = cameras()
    found = find(match, plane_photos(K[1:2], c2w[1:2]), K[1:2], c2w[1:2])
    np.testing.assert_array_equal(found.sure, 0.0)


def test_photos_from_one_place_are_not_compared(match):
    """Two photos that differ by a turn agree at every depth: neither confirms the other."""
    K, c2w = cameras()
    c2w[2] = c2w[1]
    found = find(match, plane_photos(K[1:], c2w[1:]), K[1:], c2w[1:])
    np.testing.assert_array_equal(found.sure, 0.0)


def known(K, c2w, inverse: np.ndarray, sure: float = 1.0) -> depth.Depths:
    """`Depths` of photos that have `inverse` [h, w]."""
    m = len(K)
    photos = plane_photos(K, c2w).shrunk(depth.FINER)
    same = np.broadcast_to(np.asarray(inverse, np.float32), (m, depth.FINER * H, depth.FINER * W))
    return depth.Depths(same, np.full(same.shape, sure), np.full(m, STEP), photos)


def towards(K, c2w) -> sweep.Motion:
    return way_of((K[1:], c2w[1:]), (K[:1], c2w[:1]))


def test_a_view_takes_the_surface_that_photos_have(match):
    K, c2w = cameras()
    belief = np.zeros((CUTS, H // 4, W // 4))
    belief[3] = 2.0  # elsewhere
    look = compiled(
        lambda d: surfaces.surfaces(d, towards(K, c2w), belief, np.float32(1.0), (H, W))
    )
    inverse, step = look(known(K[1:], c2w[1:], TRUE))
    assert inverse.shape == (depth.FINER * H, depth.FINER * W) and float(step) > 0.0
    assert np.median(np.abs(np.asarray(inverse) - TRUE)) < 0.1 * STEP
    inverse, _ = look(known(K[1:], c2w[1:], TRUE, sure=0.0))  # who knows nothing has no vote
    believed = float(sweep.inverse_depth(np.float32(3.0), CUTS))
    assert np.median(np.abs(np.asarray(inverse) - believed)) < 0.5 * STEP


def test_what_lies_behind_a_photo_s_surface_is_blocked_for_it():
    K, c2w = cameras()
    found, way = known(K[1:], c2w[1:], TRUE), towards(K, c2w)
    where = np.asarray([[W / 2, H / 2]])

    def behind(cuts: float) -> np.ndarray:
        inverse = np.asarray([TRUE - cuts * STEP])
        return np.asarray(surfaces.blocked(found, way, where, inverse))[:, 0]

    np.testing.assert_allclose(behind(4.0), surfaces.BLOCKED, atol=0.01)
    np.testing.assert_allclose(behind(0.0), 0.0, atol=0.01)
    np.testing.assert_allclose(behind(-4.0), 0.0, atol=0.01)
