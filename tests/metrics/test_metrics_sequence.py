"""Errors over time, by visibility, and against their prediction: known answers on made-up errors."""

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.metrics import scores, seen, sequence
from roge_jax.metrics.calibration import calibration

RNG = np.random.default_rng(0)
TRUTH = 0.4 + 0.2 * RNG.random((9, 24, 32, 3))


def noise(*shape):
    return 0.05 * np.random.default_rng(1).standard_normal(shape)


def test_temporal_ratio_of_still_boiling_and_flickering_errors():
    still = TRUTH + noise(1, 24, 32, 3)
    assert sequence.temporal_ratio(still, TRUTH) == pytest.approx(0.0, abs=1e-9)
    boiling = TRUTH + noise(9, 24, 32, 3)
    assert sequence.temporal_ratio(boiling, TRUTH) == pytest.approx(np.sqrt(2), rel=0.01)
    signs = np.where(np.arange(9) % 2, 1.0, -1.0)[:, None, None, None]
    flickering = TRUTH + signs * noise(1, 24, 32, 3)
    assert sequence.temporal_ratio(flickering, TRUTH) == pytest.approx(2.0)
    assert np.isnan(sequence.temporal_ratio(TRUTH, TRUTH))


def test_temporal_ratio_leaves_out_gaps_in_the_path():
    """The error jumps where a photo was taken out of the path, and only there."""
    error = np.concatenate([np.full(4, 0.1), np.full(5, -0.1)])[:, None, None, None]
    images, places = TRUTH + error, [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert sequence.temporal_ratio(images, TRUTH, places) == pytest.approx(0.0, abs=1e-9)
    assert sequence.temporal_ratio(images, TRUTH) > 0.5
    assert np.isnan(sequence.temporal_ratio(images[:1], TRUTH[:1]))


def test_pumping_is_detail_lost_half_way():
    photos, places = [0, 10, 20], [i for i in range(-2, 23) if i not in (0, 10, 20)]
    truth = 0.5 + 0.2 * np.random.default_rng(2).standard_normal((len(places), 24, 32, 3))
    grey = truth.mean((1, 2, 3), keepdims=True)

    def kept(share):
        return grey + np.array([share(p) for p in places])[:, None, None, None] * (truth - grey)

    assert sequence.pumping_ratio(kept(lambda p: 0.5), truth, places, photos) == pytest.approx(
        1.0, abs=1e-4
    )  # but for the energy of 8-bit rounding
    # 4, 5, 6 are half-way, 1 and 9 beside; those outside of the photos do not count
    foggy = kept(lambda p: 0.2 if p % 10 in (4, 5, 6) else (0.8 if 0 < p < 20 else 0.01))
    assert sequence.pumping_ratio(foggy, truth, places, photos) == pytest.approx(0.25, rel=0.01)
    assert np.isnan(sequence.pumping_ratio(foggy, truth, places, [0]))
    with pytest.raises(UserError, match="of one shape"):
        sequence.pumping_ratio(foggy, truth[1:], places, photos)


K = np.array([[20.0, 0, 16], [0, 20.0, 12], [0, 0, 1]])


def pose(x):
    out = np.eye(4)
    out[0, 3] = x
    return out


def wall_and_box(x, box=2.0, wall=4.0):
    """Depth of a wall behind a box of half-width .5 at the origin, seen from (x, 0, 0)."""
    u = (np.arange(32) + 0.5 - 16) / 20
    hit = np.abs(x + u * box) < 0.5
    return np.repeat(np.where(hit, box, wall)[None], 24, 0)


def test_seen_by_counts_what_photos_show_and_what_the_box_hides():
    photos = (-1.0, 1.0)
    maps = [wall_and_box(x) for x in photos]
    counts = seen.seen_by(wall_and_box(0.0), K, pose(0.0), maps, [K, K], [pose(x) for x in photos])
    assert (counts == counts[0]).all()  # rows are alike
    u = (np.arange(32) + 0.5 - 16) / 20
    expected = np.zeros(32, int)
    margins = np.full(32, np.inf)  # world distance of the point from any edge of what is seen
    for x in photos:
        z = wall_and_box(0.0)[0]
        point = u * z
        column = (point - x) / z * 20 + 16
        through = x + (point - x) / 2  # where its ray to the photo passes the box's depth
        hidden = (z > 3) & (np.abs(through) < 0.5)
        expected += (column >= 0) & (column <= 32) & ~hidden
        edges = [np.abs(np.abs(through) - 0.5) + 9 * (z < 3), np.abs(column), np.abs(column - 32)]
        margins = np.minimum(margins, np.min(edges, 0))
    sure = margins > 0.15  # one and a half photo pixels on the box
    assert sure.mean() > 0.6 and {1, 2} <= set(expected[sure])
    np.testing.assert_array_equal(counts[0][sure], expected[sure])


def test_unknown_depth_is_left_out_and_infinite_depth_is_seen_by_turning():
    depth = np.array([[0.0, np.nan, np.inf, 4.0]])
    k = np.array([[2.0, 0, 2], [0, 2.0, 0.5], [0, 0, 1]])
    counts = seen.seen_by(depth, k, pose(0), [np.array([[1.0, 1, np.inf, 4]])], [k], [pose(0)])
    np.testing.assert_array_equal(counts, [[-1, -1, 1, 1]])


def test_error_split_adds_up_and_weighs_squares():
    counts = np.zeros((1, 24, 32), int)
    counts[:, :, 8:16], counts[:, :, 16:24], counts[:, :, 24:] = 1, 3, -1
    error = np.where(counts == 0, 0.2, 0.1)[..., None]
    found = seen.error_split(TRUTH[:1] + error, TRUTH[:1], counts)
    assert found == pytest.approx(
        {"error_seen_two": 1 / 6, "error_seen_one": 1 / 6, "error_unseen": 4 / 6}
    )
    assert seen.pixel_split(counts) == pytest.approx(
        {"seen_two": 1 / 3, "seen_one": 1 / 3, "unseen": 1 / 3}
    )
    with pytest.raises(UserError, match="error_split takes"):
        seen.error_split(TRUTH, TRUTH, counts)


def test_calibration_of_a_right_a_small_and_a_meaningless_prediction():
    rng = np.random.default_rng(3)
    u = rng.uniform(0.01, 0.2, 40000)
    error = np.abs(u * rng.standard_normal(u.shape))
    right = calibration(u, error)
    assert right.within == pytest.approx(0.683, abs=0.01) and right.ratio == pytest.approx(
        1, abs=0.02
    )
    for one in right.bins:
        assert one.found == pytest.approx(one.predicted, rel=0.06) and one.share == pytest.approx(
            0.1
        )
    small = calibration(u / 2, error)
    assert small.ratio == pytest.approx(2, abs=0.04) and small.within == pytest.approx(
        0.383, abs=0.01
    )
    assert small.order == pytest.approx(right.order)
    shuffled = calibration(rng.permutation(u), error)
    assert abs(shuffled.order) < 0.02 < 0.3 < right.order
    assert max(b.found for b in shuffled.bins) < 1.15 * min(b.found for b in shuffled.bins)
    with pytest.raises(UserError, match="one shape"):
        calibration(u[1:], error)
    with pytest.raises(UserError, match="finite"):
        calibration(u, np.where(error > 0.1, np.nan, error))


def test_scores_have_the_path_the_visibility_and_the_learned_metrics_where_they_are_given():
    frames = TRUTH + noise(9, 24, 32, 3)
    alone = scores.scores(frames, TRUTH, {})
    assert (
        {"psnr", "ssim", "gmsd", "sharpness_ratio"}
        <= set(alone)
        <= set(scores.SETTINGS) | {"capped"}
    )
    counts = np.zeros(TRUTH.shape[:3], int)
    every = scores.scores(
        frames,
        TRUTH,
        {"lpips_alex": lambda a, b: np.arange(len(a), dtype=float)},
        places=range(1, 10),
        photos=[0, 10],
        counts=counts,
    )
    assert every["lpips_alex"] == 4.0 and every["error_unseen"] == 1.0
    assert every["temporal_ratio"] == pytest.approx(np.sqrt(2), rel=0.01)
    assert every["pumping_ratio"] == pytest.approx(1.0, abs=0.05)
    assert set(every) - set(alone) <= set(scores.SETTINGS)
