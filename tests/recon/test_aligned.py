"""Photos as another one would have taken them."""

import numpy as np
import pytest
from compiled import compiled
from test_lookup import CUTS, H, W, side_by_side, textured_plane, way_of
from test_rendering import whole

from roge_jax.recon import aligned, sweep

aligned, sweep = map(compiled, (aligned, sweep))
TRUE = float(sweep.inverse_depth(np.float32(8), CUTS))


def pair(roll: float, closer: float) -> tuple[np.ndarray, np.ndarray]:
    """A reference and a photo beside it that is rolled by degrees and taken from nearer to the plane at 1 / TRUE."""
    K, c2w = side_by_side(2, 0.03)
    a = np.radians(roll)
    turn = np.eye(4, dtype=np.float32)
    turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    c2w[1] = c2w[1] @ turn
    c2w[1, 2, 3] += closer / TRUE
    return K, c2w


def taken(K, c2w) -> tuple[np.ndarray, aligned.Aligned]:
    """The reference's picture, and the photo as the reference would have it."""
    pictures = textured_plane(K, c2w, 1 / TRUE, H, W)
    photos = whole(pictures[1:])
    way = way_of((K[1:], c2w[1:]), (K[:1], c2w[:1]))
    return pictures[0], aligned.aligned(photos, way, np.asarray([TRUE]), photos.window(0))


def in_frame(found: aligned.Aligned) -> np.ndarray:
    """Of the larger picture, what lies in the reference's frame."""
    h, w = found.rgb.shape[1:3]
    top, left = (h - H) // 2, (w - W) // 2
    return np.asarray(found.rgb)[0, top : top + H, left : left + W]


@pytest.mark.parametrize("roll, closer", [(50.0, 0.0), (0.0, 0.35), (-30.0, 0.2)])
def test_a_photo_held_otherwise_comes_out_as_the_reference(roll, closer):
    own, found = taken(*pair(roll, closer))
    middle = np.s_[10:-10, 16:-16]
    assert np.abs(in_frame(found) - own)[middle].mean() < 0.03
    photo = textured_plane(*(x[1:] for x in pair(roll, closer)), 1 / TRUE, H, W)[0]
    assert np.abs(photo - own)[middle].mean() > 0.1


def test_the_way_leads_to_the_same_place():
    """A point at any depth is found in the aligned photo where it shows what the photo shows there."""
    K, c2w = pair(40.0, 0.1)
    _, found = taken(K, c2w)
    photo = textured_plane(K[1:], c2w[1:], 1 / TRUE, H, W)
    way = way_of((K[1:], c2w[1:]), (K[:1], c2w[:1]))
    where = np.asarray([[W / 2 + 3.0, H / 2 - 2.0], [W / 2 - 5.0, H / 2 + 4.0]])
    for nearer in (0.8, 1.0, 1.2):
        inverse = np.full((1, 2), nearer * TRUE)
        there, _ = sweep.fetch(np.asarray(photo), way, where, inverse)
        here, seen = sweep.fetch(found.rgb, found.way, where, inverse)
        assert np.all(np.asarray(seen) == 1.0)
        np.testing.assert_allclose(here, there, atol=0.06)


def test_photos_that_differ_little_keep_their_pixels():
    K, c2w = pair(3.0, 0.02)
    _, found = taken(K, c2w)
    photo = textured_plane(K[1:], c2w[1:], 1 / TRUE, H, W)[0]
    np.testing.assert_allclose(in_frame(found)[1:-1, 1:-1], photo[1:-1, 1:-1], atol=1e-5)


def test_the_plane_in_common_is_where_both_look():
    K, c2w = side_by_side(2, 0.3)
    depth = 1.0 / TRUE
    for sign, view in zip((1.0, -1.0), c2w):  # towards one point at that depth
        a = sign * np.arctan2(0.15, depth)
        view[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    way = way_of((K[1:], c2w[1:]), (K[:1], c2w[:1]))
    inverse = sweep.inverse_depth(np.arange(CUTS, dtype=np.float32), CUTS)
    found = aligned.in_common(way, (H, W), inverse)
    at = float(sweep.cut_at(found, CUTS)[0])
    assert abs(at - 8.0) <= 1.0
