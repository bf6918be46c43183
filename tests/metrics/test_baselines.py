"""Copies, means and warps: exact on scenes whose geometry is known."""

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.metrics import baselines as bl
from roge_jax.metrics.image import psnr

H, W = 24, 32
K = np.array([[30.0, 0, 15.0], [0, 28.0, 13.0], [0, 0, 1]])


def turn(axis, degrees):
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = np.radians(degrees)
    return np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * cross @ cross


def pose(centre=(0, 0, 0), axis=(0, 1, 0), degrees=0.0):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn(axis, degrees), centre
    return out


def wall_colour(x, y):
    """A smooth texture on the plane z = 2: bilinear reading of it is nearly exact."""
    return 0.5 + 0.25 * np.stack([np.sin(2 * x), np.cos(3 * y), np.sin(2 * x + y)], axis=-1)


def photograph(c2w, k=K, size=(H, W), depth_of_wall=2.0):
    """Ray-casts the wall z = 2 of the world: rgb [h, w, 3] and z-depth [h, w]."""
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(k).T  # camera, z = 1
    world = rays @ c2w[:3, :3].T
    depth = (depth_of_wall - c2w[2, 3]) / world[..., 2]
    hit = c2w[:3, 3] + depth[..., None] * world
    return wall_colour(hit[..., 0], hit[..., 1]), depth


def rig(centres, degrees=None):
    poses = np.stack([pose(c, degrees=d) for c, d in zip(centres, degrees or [0.0] * len(centres))])
    return np.stack([photograph(p)[0] for p in poses]), np.stack([K] * len(poses)), poses


def test_bilinear_is_exact_on_linear_images_and_repeats_the_border():
    y, x = np.mgrid[:5, :7] + 0.5
    ramp = np.stack([x, y, 2 * x - y], axis=-1)
    points = np.array([[0.5, 0.5], [3.25, 2.8], [6.5, 4.5], [1.0, 4.0]])
    expected = np.stack([points[:, 0], points[:, 1], 2 * points[:, 0] - points[:, 1]], axis=-1)
    np.testing.assert_allclose(bl.bilinear(ramp, points), expected, atol=1e-12)
    np.testing.assert_allclose(
        bl.bilinear(ramp, np.array([[-9.0, 99.0]])), ramp[-1:, 0], atol=1e-12
    )
    np.testing.assert_allclose(bl.bilinear(ramp[:1, :1], points), np.tile(ramp[0, :1], (4, 1)))


def test_a_camera_warped_to_itself_is_the_photo():
    rgb, _, poses = rig([(0.3, -0.2, 0.1)])
    depth = np.random.default_rng(0).uniform(1, 9, (H, W))
    out = bl.warp(rgb[0], K, poses[0], K, poses[0], depth)
    assert out.valid.all()
    np.testing.assert_allclose(out.rgb, rgb[0], atol=1e-9)


def test_true_depth_reproduces_the_wall_from_any_pose():
    """Moved, turned and zoomed: where the photo sees the wall, only bilinear smoothing is left."""
    source = pose((0.2, 0.1, 0.0), (0.2, 1, 0.1), 6.0)
    target = pose((-0.1, 0.05, 0.1), (1, 0.3, 0), -5.0)
    zoom = np.diag([1.3, 1.2, 1.0]) @ K
    photo, _ = photograph(source)
    truth, depth = photograph(target, zoom)
    out = bl.warp(photo, K, source, zoom, target, depth)
    assert 0.6 < out.valid.mean() <= 1.0
    # half a border pixel is repeated, not extrapolated: leave it out of the comparison
    error = np.abs(out.rgb - truth)[out.valid]
    # |f''| <= 9 * .25 in the wall's unit, pixels of 2 / 28: error <= 2 * f'' h^2 / 8
    assert np.quantile(error, 0.9) < 2 * 2.25 * (2 / 28) ** 2 / 8
    np.testing.assert_allclose(
        bl.depth_warp(photo[None], K[None], source[None], zoom, target, depth)[out.valid],
        out.rgb[out.valid],
    )


def test_the_plane_is_exact_for_a_frontal_wall_and_at_infinity_for_rotation():
    rgb, Ks, poses = rig([(-0.2, 0, 0), (0.15, 0.1, 0)])
    target = pose((0.0, 0.02, 0.0))
    truth, depth = photograph(target)
    np.testing.assert_allclose(depth, 2.0)
    for combine in ("nearest", "blend"):
        out = bl.plane(rgb, Ks, poses, K, target, (H, W), 2.0, combine=combine)
        assert psnr(out[2:-2, 2:-2], truth[2:-2, 2:-2]) > 42
        assert (
            psnr(out, truth)
            > psnr(bl.plane(rgb, Ks, poses, K, target, (H, W), 3.0, combine=combine), truth) + 6
        )
    turned = pose((0.15, 0.1, 0), (0, 1, 0), 4.0)
    out = bl.plane(rgb[1:], Ks[1:], poses[1:], K, turned, (H, W), np.inf)
    valid = bl.warp(rgb[1], K, poses[1], K, turned, np.full((H, W), np.inf)).valid
    assert (
        psnr(
            np.where(valid[..., None], out, 0), np.where(valid[..., None], photograph(turned)[0], 0)
        )
        > 40
    )


def test_each_pixel_comes_from_the_nearest_photo_that_sees_it():
    """Three flat colours seen from left, right and far away tell who painted which pixel."""
    poses = np.stack([pose((-0.5, 0, 0)), pose((0.6, 0, 0)), pose((0, 0, -8.0))])
    rgb = np.stack([np.full((H, W, 3), v) for v in (0.1, 0.5, 0.9)])
    Ks, target = np.stack([K] * 3), pose()
    out = bl.plane(rgb, Ks, poses, K, target, (H, W), 2.0, combine="nearest")
    # the left camera moved by .5 sees the plane 7.5 pixels further right: its last 7.5 columns are missing
    np.testing.assert_allclose(out[:, : W - 8], 0.1)
    np.testing.assert_allclose(out[:, W - 7 :], 0.5)
    blend = bl.plane(rgb, Ks, poses, K, target, (H, W), 2.0)
    assert (blend[:, W - 7 :] > 0.5).all() and (blend[:, :5] < 0.2).all()
    np.testing.assert_allclose(
        blend[:, W - 7 :],
        (0.5 / 0.3**2 + 0.9 / 4.0**2) / (1 / 0.3**2 + 1 / 4.0**2),
    )


def test_pixels_in_no_photo_repeat_the_border_and_points_behind_are_not_seen():
    rgb, Ks, poses = rig([(0, 0, 0)])
    away = pose((0, 0, 0), (0, 1, 0), 180.0)
    out = bl.warp(rgb[0], K, poses[0], K, away, np.full((H, W), 2.0))
    assert not out.valid.any() and np.isfinite(out.rgb).all()
    shifted = bl.plane(rgb, Ks, poses, K, pose((1.0, 0, 0)), (H, W), 2.0)
    np.testing.assert_allclose(shifted[:, -10:], np.repeat(rgb[0][:, -1:], 10, axis=1), atol=1e-9)


def test_shrinking_is_antialiased():
    """A photo of 1-pixel stripes seen from 3 times as far: grey, not stripes of chance."""
    stripes = np.zeros((60, 60, 3))
    stripes[:, ::2] = 1.0
    k = np.array([[60.0, 0, 30], [0, 60, 30], [0, 0, 1]])
    out = bl.warp(stripes, k, pose(), k, pose((0, 0, -2.0)), np.full((60, 60), 3.0))
    assert 0.05 < out.valid.mean() < 0.2
    inner = out.rgb[25:35, 25:35]
    assert np.abs(inner - 0.5).max() < 0.2  # three samples per axis: 1/6 is the worst phase
    plain = bl.bilinear(
        stripes,
        bl.project(bl.pixel_grid(60, 60), np.full((60, 60), 3.0), k, pose(), k, pose((0, 0, -2.0)))[
            0
        ],
    )
    assert np.abs(plain[25:35, 25:35] - 0.5).max() > 0.3


def test_supersampling_counts_the_photo_pixels_under_one_target_pixel():
    for factor, steps in ((0.5, 1), (1.0, 1), (1.5, 2), (2.0, 2), (3.2, 4), (9.0, 4)):
        xy = bl.pixel_grid(8, 9) * factor
        assert bl._supersampling(xy, np.ones((8, 9), bool)) == steps
    assert bl._supersampling(xy, np.zeros((8, 9), bool)) == 1


def test_nearest_weighs_parallax_and_direction():
    rgb, _, poses = rig([(0.5, 0, 0), (-0.1, 0, 0), (0, 0, 0)], [0.0, 0.0, 60.0])
    target = pose()
    np.testing.assert_allclose(
        bl.view_distances(poses, target, 2.0), [0.25, 0.05, 2 * np.sin(np.radians(30))]
    )
    np.testing.assert_array_equal(bl.nearest(rgb, poses, target, 2.0), rgb[1])
    assert np.argmin(bl.view_distances(poses, target)) == 1
    # nothing but rotation: no division by zero
    still = np.stack([pose(degrees=20.0), pose(degrees=-5.0)])
    np.testing.assert_allclose(bl.view_distances(still, target), 2 * np.sin(np.radians([10, 2.5])))
    # scale-free without a depth
    large = poses.copy()
    large[:, :3, 3] *= 1e5
    np.testing.assert_allclose(bl.view_distances(large, target), bl.view_distances(poses, target))


def test_mean_context_is_the_mean():
    rgb, _, _ = rig([(0, 0, 0), (1, 0, 0)])
    np.testing.assert_allclose(bl.mean_context(rgb), (rgb[0] + rgb[1]) / 2)


def test_the_sweep_finds_the_wall_in_any_unit():
    for unit in (1.0, 1e-4, 1e5):
        rgb, Ks, poses = rig([(-0.25, 0, 0), (0.2, 0.1, 0), (0.0, -0.15, 0)])
        poses, target = poses.copy(), pose((0.05, 0.02, 0.0))
        poses[:, :3, 3] *= unit
        target[:3, 3] *= unit
        found = bl.plane_sweep(rgb, Ks, poses, K, target, (H, W))
        # neighbouring candidates differ by a factor of (200 / .3)^(1/63) = 1.11
        assert abs(np.log(found.depth / (2.0 * unit))) < np.log(1.11)
        assert found.overlap > 0.8 and found.disagreement < 0.02


def test_the_sweep_refuses_planes_that_barely_overlap():
    """Photos that agree only on a sliver (one flat strip): the sliver's plane must not win."""
    rng = np.random.default_rng(1)
    rgb = rng.random((2, H, W, 3))
    rgb[0, :, :3], rgb[1, :, -3:] = 0.5, 0.5
    # the flat strips meet when the left photo is moved by nearly a whole frame
    poses = np.stack([pose((0.5, 0, 0)), pose((-0.5, 0, 0))])
    args = (rgb, np.stack([K, K]), poses, K, pose(), (H, W))
    greedy = bl.plane_sweep(*args, min_overlap=0.0)
    assert greedy.overlap < 0.2
    fair = bl.plane_sweep(*args)
    assert fair.overlap >= 0.5 and fair.depth > greedy.depth
    none = bl.plane_sweep(*args, depths=np.array([1.05, 1.15]))
    assert 0.0 < none.overlap < 0.5  # nothing overlaps enough: the best there is
    assert bl.plane_sweep(*args, depths=np.array([greedy.depth, 1.6])).depth == 1.6


@pytest.mark.parametrize(("levels", "apart"), [((0.4, 0.6), 0.2), ((0.4, 0.5, 0.6), 0.02**0.5)])
def test_disagreement_is_the_root_mean_square_difference_of_two_photos(levels, apart):
    """However many photos there are: of flat ones the root of the mean square over pairs."""
    rgb = np.stack([np.full((H, W, 3), level) for level in levels])
    n = len(levels)
    poses = np.stack([pose((0.01 * i, 0, 0)) for i in range(n)])
    found = bl.plane_sweep(rgb, np.stack([K] * n), poses, K, pose(), (H, W), np.array([10.0]))
    np.testing.assert_allclose(found.disagreement, apart, rtol=1e-6)


def test_the_sweep_with_one_photo_or_no_baseline_means_rotation_only():
    rgb, Ks, poses = rig([(0, 0, 0), (0, 0, 0)], [0.0, 5.0])
    assert bl.plane_sweep(rgb[:1], Ks[:1], poses[:1], K, pose((1, 0, 0)), (H, W)).depth == np.inf
    assert bl.plane_sweep(rgb, Ks, poses, K, pose(degrees=2.0), (H, W)).depth == np.inf


def test_the_sweep_shrinks_large_photos_without_moving_the_plane():
    k = np.diag([8.0, 8.0, 1.0]) @ K
    size = (8 * H, 8 * W)
    poses = np.stack([pose((-0.25, 0, 0)), pose((0.2, 0.1, 0)), pose((0.0, -0.15, 0))])
    rgb = np.stack([photograph(p, k, size)[0] for p in poses])
    found = bl.plane_sweep(rgb, np.stack([k] * 3), poses, k, pose((0.05, 0.02, 0)), size)
    assert abs(np.log(found.depth / 2.0)) < np.log(1.11)


def test_baselines_of_a_scene_in_order_of_strength():
    # everybody looks at the wall at about 30 degrees: its depth varies by a factor of two
    rgb, Ks, poses = rig([(-0.4, 0, 0), (0.3, 0.1, 0), (0.0, -0.2, 0)], [34.0, 27.0, 30.0])
    targets = np.stack([pose((-0.2, 0.05, 0), degrees=32.0), pose((0.15, 0, 0.1), degrees=29.0)])
    truth, depth = (np.stack(x) for x in zip(*(photograph(t) for t in targets)))
    frames, depths = bl.baselines(rgb, Ks, poses, np.stack([K] * 2), targets, (H, W), depth)
    assert set(frames) == {"nearest", "mean_context", "plane", "depth_warp"}
    assert all(x.shape == (2, H, W, 3) for x in frames.values())
    np.testing.assert_allclose(depths, np.median(depth, axis=(1, 2)))
    score = {name: psnr(x, truth).mean() for name, x in frames.items()}
    assert score["depth_warp"] > score["plane"] > max(score["nearest"], score["mean_context"])
    # without depth: no depth_warp, and the sweep's plane is about as good as the true one
    frames, depths = bl.baselines(rgb, Ks, poses, np.stack([K] * 2), targets, (H, W))
    assert set(frames) == {"nearest", "mean_context", "plane"}
    assert psnr(frames["plane"], truth).mean() > score["plane"] - 1.5
    # holes in the depth: the median of the known pixels, no depth_warp
    holes = depth.copy()
    holes[:, :5], holes[:, 5:7] = 0.0, np.nan
    frames, depths = bl.baselines(rgb, Ks, poses, np.stack([K] * 2), targets, (H, W), holes)
    assert "depth_warp" not in frames
    np.testing.assert_allclose(depths, np.median(depth[:, 7:], axis=(1, 2)))


def test_wrong_input_is_named():
    rgb, Ks, poses = rig([(0, 0, 0)])
    with pytest.raises(UserError, match="depth must be positive, not -1"):
        bl.plane(rgb, Ks, poses, K, pose(), (H, W), -1.0)
    with pytest.raises(UserError, match="context_K"):
        bl.plane(rgb, Ks[0], poses, K, pose(), (H, W), 1.0)
    with pytest.raises(UserError, match="no positive value"):
        bl.baselines(rgb, Ks, poses, K[None], pose()[None], (H, W), np.zeros((1, H, W)))
    with pytest.raises(UserError, match="'blend' or 'nearest', not 'best'"):
        bl.plane(rgb, Ks, poses, K, pose(), (H, W), 1.0, combine="best")
