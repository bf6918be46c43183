"""Depth by sweep and semi-global matching, and the picture from it, on scenes whose depth is known."""

import numpy as np
import pytest

from roge_jax.metrics import baselines as bl
from roge_jax.metrics import plane_sweep as ps
from roge_jax.metrics.image import psnr, ssim
from roge_jax.metrics.seen import seen_by
from roge_jax.procedural.scenes import sample_sequence

SIZE = (96, 168)


@pytest.fixture(scope="module")
def views():
    """Three neighbouring views of a rendered room; the middle one is the target."""
    return sample_sequence(1000000004, frames=16, height=SIZE[0], width=SIZE[1])


def inputs(views, photos, target):
    rgb = views["rgb"].astype(np.float64) / 255
    return (
        rgb[photos], views["K"][photos], views["c2w"][photos], views["K"][target], views["c2w"][target], SIZE
    )  # fmt: skip


def test_it_finds_the_depth_within_a_plane_and_beats_the_plane(views):
    photos, target = [6, 8], 7
    given = inputs(views, photos, target)
    found = ps.sweep_view(*given)
    truth, true = views["rgb"][target] / 255.0, views["depth"][target]
    seen = seen_by(true, given[3], given[4], views["depth"][photos], given[1], given[2]) == 2
    gradient = np.hypot(*np.gradient(truth.mean(-1)))
    textured = seen & (gradient > np.median(gradient))
    inverse = 1.0 / found.depth
    plane = (
        ps.MARGIN**2 * np.ptp(1.0 / true[seen])
    ) / ps.PLANES  # at least as far apart as planes are
    near = np.abs(inverse - 1.0 / true)[textured] < plane
    assert textured.mean() > 0.3 and near.mean() > 0.8
    # against a prediction of one depth everywhere, the test can fail
    assert (np.abs(np.median(1.0 / true) - 1.0 / true)[textured] < plane).mean() < 0.2
    best = bl.plane(*given, float(np.median(true)))  # which knows the true median depth
    assert psnr(found.rgb, truth) > psnr(best, truth) + 3
    assert 1 - ssim(found.rgb, truth) < 0.5 * (1 - ssim(best, truth))


def test_three_photos_are_better_than_the_two_outer_ones(views):
    truth = views["rgb"][7] / 255.0
    outer = ps.sweep_view(*inputs(views, [3, 11], 7))
    more = ps.sweep_view(*inputs(views, [3, 6, 11], 7))
    assert psnr(more.rgb, truth) > psnr(outer.rgb, truth) + 1


def test_aggregation_fills_what_a_pixel_alone_cannot_tell():
    """A row of pixels sees plane 2, one of them sees nothing and one is mistaken: both get what their neighbours have."""
    cost = np.full((9, 12, 5), 1.0, np.float32)
    cost[..., 2] = 0.0
    cost[4, 6] = 0.5
    cost[2, 3] = [0.0, 1.0, 0.8, 1.0, 1.0]
    assert (np.argmin(cost, -1) == 2).sum() == 9 * 12 - 2
    total = ps._aggregated(cost)
    assert (np.argmin(total, -1) == 2).all()
    # turned and mirrored inputs give turned and mirrored outputs: no direction is missing
    for turn in (lambda x: x[::-1], lambda x: x[:, ::-1], lambda x: x.swapaxes(0, 1)):
        np.testing.assert_allclose(ps._aggregated(turn(cost).copy()), turn(total), rtol=1e-5)


def test_a_step_between_two_surfaces_stays_sharp():
    cost = np.full((16, 16, 8), 1.0, np.float32)
    cost[:, :8, 1] = cost[:, 8:, 6] = 0.0
    best = np.argmin(ps._aggregated(cost), -1)
    assert (best[:, :8] == 1).all() and (best[:, 8:] == 6).all()


def test_without_parallax_it_is_the_plane_at_infinity(views):
    one = inputs(views, [6], 7)
    found = ps.sweep_view(*one)
    assert np.isinf(found.depth).all()
    np.testing.assert_array_equal(found.rgb, bl.plane(*one, np.inf))


def test_photos_that_do_not_see_the_view_give_a_picture_all_the_same(views):
    away = inputs(views, [6, 8], 7)
    turned = away[4].copy()
    turned[:3, :3] = turned[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    found = ps.sweep_view(*away[:4], turned, SIZE)
    assert np.isfinite(found.rgb).all() and found.rgb.shape == (*SIZE, 3)
