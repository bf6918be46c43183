"""Points from frames and known cameras: exact tracks give exact points, pictures of a known plane its depth."""

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras, invert
from roge_jax.geometry.rays import project
from roge_jax.scenes import triangulate as found_by

HEIGHT, WIDTH, COUNT = 72, 96, 7
K = np.array([[90.0, 0, 47.0], [0, 92.0, 37.0], [0, 0, 1]])


def sideways(step: float = 0.04) -> Cameras:
    """Cameras that move to the right and turn a little, in a frame far from the origin."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    for i in range(COUNT):
        angle = 0.01 * i
        poses[i, :3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        poses[i, :3, 3] = (100 + step * i, -20, 3)
    return Cameras(np.tile(K, (COUNT, 1, 1)), poses)


def wall(cameras: Cameras, depth: float = 2.0) -> np.ndarray:
    """What they see of a textured plane at z = 3 + depth, uint8 [n, h, w, 3]; red to the left, blue to the right."""
    rng = np.random.default_rng(3)
    centres, sizes = rng.uniform(-3, 3, (400, 2)), rng.uniform(0.03, 0.1, 400)
    heights = rng.uniform(-1, 1, 400)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    frames = []
    for k, pose in zip(cameras.K, cameras.c2w, strict=True):
        local = np.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], np.ones_like(x)], -1)
        ray = local @ pose[:3, :3].T
        t = (3 + depth - pose[2, 3]) / ray[..., 2]
        u, v = (pose[i, 3] + t * ray[..., i] - c for i, c in ((0, 100), (1, -20)))
        value = np.zeros_like(x)
        for (a, b), size, height in zip(centres, sizes, heights, strict=True):
            value += height * np.exp(-((u - a) ** 2 + (v - b) ** 2) / (2 * size**2))
        grey = 0.5 + 0.35 * np.tanh(value)
        frames.append(np.stack([np.where(u < 0, grey, 0.0), grey, np.where(u < 0, 0.0, grey)], -1))
    return np.rint(255 * np.stack(frames)).astype(np.uint8)


def exact_tracks(cameras: Cameras, xyz: np.ndarray) -> np.ndarray:
    pixels = [project(k, pose, xyz)[0] for k, pose in zip(cameras.K, cameras.c2w, strict=True)]
    return np.stack(pixels, 1)


def test_rays_meet_in_their_point():
    """Also where tracks end early, and with noise the point with the least squared distance in pixels."""
    cameras, rng = sideways(), np.random.default_rng(0)
    xyz = np.array([100.0, -20, 3]) + rng.uniform((-0.5, -0.5, 1), (0.7, 0.5, 4), (50, 3))
    tracks = exact_tracks(cameras, xyz)
    tracks[:20, 3:] = np.nan
    poses = invert(cameras.c2w)
    np.testing.assert_allclose(found_by.intersect(tracks, cameras.K, poses), xyz, atol=1e-7)
    noisy = tracks + rng.normal(0, 0.3, tracks.shape)
    best = found_by.intersect(noisy, cameras.K, poses)

    def cost(points):
        off = found_by.distances(points, noisy, cameras.K, poses)
        return np.nansum(off**2, 1)

    for axis in range(3):
        for sign in (-1e-3, 1e-3):
            assert (cost(best + sign * np.eye(3)[axis]) >= cost(best)).all()


def test_points_of_a_wall_lie_on_it():
    cameras = sideways()
    points, quality = found_by.triangulate(wall(cameras), cameras)
    assert quality.points == len(points) > 60 and quality.views == COUNT and quality.error < 0.2
    depth = points.xyz[:, 2] - 3
    assert np.median(np.abs(depth / 2 - 1)) < 0.01 and (np.abs(depth / 2 - 1) < 0.05).mean() > 0.9
    left = points.xyz[:, 0] < 100 - 0.05
    assert (points.rgb[left, 0] > points.rgb[left, 2]).mean() > 0.95
    right = points.xyz[:, 0] > 100.05
    assert (points.rgb[right, 2] > points.rgb[right, 0]).mean() > 0.95
    for view in (0, COUNT - 1):  # pixels are where the points are seen
        pixels, _, _ = project(cameras.K[view], cameras.c2w[view], points.xyz[points.seen[view]])
        assert np.linalg.norm(pixels - points.pixels[view], axis=1).max() <= 2.0


def test_what_the_cameras_contradict_is_left_out():
    """A patch that moves by itself gives no points, the wall behind it does."""
    cameras = sideways()
    frames, own = wall(cameras), np.random.default_rng(5).integers(0, 255, (24, 24, 3), np.uint8)
    own = own.repeat(2, 0).repeat(2, 1)[:30, :30]
    for i in range(COUNT):
        frames[i, 20 + 2 * i : 50 + 2 * i, 30:60] = own  # down, across the epipolar lines
    points, _ = found_by.triangulate(frames, cameras)
    assert (np.abs((points.xyz[:, 2] - 3) / 2 - 1) < 0.1).mean() > 0.9


@pytest.mark.parametrize("kind", ["blank", "still", "wrong poses"])
def test_without_points_it_says_what_is_needed(kind):
    cameras = sideways()
    frames = wall(cameras)
    if kind == "blank":
        frames[:] = 128
    elif kind == "still":
        cameras = Cameras(cameras.K, np.tile(cameras.c2w[:1], (COUNT, 1, 1)))
        frames = np.tile(frames[:1], (COUNT, 1, 1, 1))
    else:
        upwards = cameras.c2w.copy()
        upwards[:, 1, 3] += np.linspace(0, 2.0, COUNT) ** 2
        cameras = Cameras(cameras.K, upwards)
    with pytest.raises(UserError, match="no point that the cameras agree on"):
        found_by.triangulate(frames, cameras)
