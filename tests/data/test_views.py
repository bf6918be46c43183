"""Samples for training: which views are drawn, and that altered or smaller pictures keep cameras that fit them."""

import numpy as np
import pytest
from camera_cases import looking_at_origin, random_cameras

from roge_jax.data.views import ViewConfig, alter, average_down, draw_batch, draw_views
from roge_jax.errors import UserError
from roge_jax.geometry.cameras import relative_to
from roge_jax.geometry.rays import project

HEIGHT, WIDTH, FRAMES = 24, 40, 20


def test_mirrored_samples_are_views_of_the_mirrored_scene():
    """Points of the mirrored world land where the mirrored pixels are; without a mirror nothing moves."""
    cameras = random_cameras(np.random.default_rng(0), 3, HEIGHT, WIDTH)
    points = np.random.default_rng(1).normal(size=(30, 3)) * 3
    before = [project(K, c2w, points) for K, c2w in zip(cameras.K, cameras.c2w, strict=True)]
    line = 7  # a column that differs from all others says where pixels went
    picture = np.full((3, HEIGHT, WIDTH, 3), 0.3)
    picture[:, :, line] = 0.6
    seen = set()
    for seed in range(12):
        rgb, K, c2w, _ = alter(np.random.default_rng(seed), picture, cameras.K, cameras.c2w)
        row = np.abs(rgb - np.median(rgb, (1, 2), keepdims=True)).sum((0, 1, 3))
        mirrored = int(np.argmax(row)) == WIDTH - 1 - line
        assert mirrored or np.argmax(row) == line
        np.testing.assert_allclose(np.linalg.det(c2w[:, :3, :3]), 1.0, atol=1e-9)
        world = points * np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])[None]
        for view, (pixels, depth, visible) in enumerate(before):
            after, depth_after, _ = project(K[view], c2w[view], world)
            expected = pixels * [-1.0, 1.0] + [WIDTH, 0.0] if mirrored else pixels
            np.testing.assert_allclose(after[visible], expected[visible], atol=1e-6)
            np.testing.assert_allclose(depth_after, depth, atol=1e-9)
        seen.add(mirrored)
    assert seen == {False, True}
    assert picture[0, 0, line, 0] == 0.6  # what was given is left as it is


def test_all_views_of_a_sample_are_recoloured_alike_and_stay_in_range():
    """Equal pixels of different views stay equal; colours do change, and none leaves [0, 1]."""
    rng = np.random.default_rng(0)
    rgb = np.repeat(rng.random((1, 4, 6, 3)), 3, 0)
    K, c2w = np.tile(np.eye(3), (3, 1, 1)), np.tile(np.eye(4), (3, 1, 1))
    inverted = 0
    for seed in range(40):
        found, *_ = alter(np.random.default_rng(seed), rgb, K, c2w)
        np.testing.assert_array_equal(found[0], found[2])
        assert found.min() >= 0.0 and found.max() <= 1.0 and not np.array_equal(found, rgb)
        grey, was = (np.sort(x[0].mean(-1).ravel()) for x in (found, rgb))
        straight, turned = (np.corrcoef(grey, x)[0, 1] for x in (was, (1.0 - was)[::-1]))
        order = np.corrcoef(found[0].mean(-1).ravel(), rgb[0].mean(-1).ravel())[0, 1]
        mirror = np.corrcoef(found[0].mean(-1)[:, ::-1].ravel(), rgb[0].mean(-1).ravel())[0, 1]
        assert max(straight, turned) > 0.9
        inverted += min(order, mirror) < -0.8
    assert 2 <= inverted <= 20  # a fifth of them


def test_smaller_frames_are_means_of_blocks_and_their_K_follows():
    """Each axis by its own factor; a point lands in the block of the pixel where it was."""
    cameras = random_cameras(np.random.default_rng(2), 2, HEIGHT, WIDTH)
    rgb = np.random.default_rng(3).integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    small, K = average_down(rgb, cameras.K, (8, 20))
    blocks = [[rgb[1, 3 * i : 3 * i + 3, 2 * j : 2 * j + 2] for j in range(20)] for i in range(8)]
    expected = np.array([[block.mean((0, 1)) for block in row] for row in blocks]) / 255.0
    np.testing.assert_allclose(small[1], expected, atol=1e-6)
    points = np.random.default_rng(4).normal(size=(20, 3)) * 3
    before, _, visible = project(cameras.K[0], cameras.c2w[0], points)
    after, _, _ = project(K[0], cameras.c2w[0], points)
    np.testing.assert_allclose((after * [2.0, 3.0])[visible], before[visible], atol=1e-9)
    same, kept = average_down(rgb, cameras.K, None)
    np.testing.assert_allclose(same, rgb / 255.0, atol=1e-6)
    np.testing.assert_array_equal(kept, cameras.K)
    with pytest.raises(UserError, match=r"Frames of 24x40 cannot be averaged to 16x20"):
        average_down(rgb, cameras.K, (16, 20))


def test_ordered_targets_are_a_run_of_frames_in_either_direction():
    """Contexts lie in the window, one in each of its parts, or all of them around it, as often as asked for."""
    cfg = ViewConfig(targets=8, ordered=True, outside=0.3)
    forward, around, first = [], [], []
    for seed in range(300):
        contexts, targets = draw_views(np.random.default_rng(seed), FRAMES, 3, cfg)
        steps = np.diff(targets)
        assert len(targets) == 8 and len(set(steps)) == 1 and abs(steps[0]) == 1
        assert len(set(contexts)) == 3 and min(contexts) >= 0 and max(contexts) < FRAMES
        assert targets.min() >= 0 and targets.max() < FRAMES
        inside = np.isin(contexts, targets)
        assert inside.all() or not inside.any()
        if inside.all():
            parts = (np.sort(contexts) + 0.5 - targets.min()) * 3 / 8
            assert np.abs(parts - [0.5, 1.5, 2.5]).max() < 0.75
            first.append(contexts[0] == contexts.min())
        forward.append(steps[0] == 1)
        around.append(not inside.any())
    assert 0.4 < np.mean(forward) < 0.6 and 0.2 < np.mean(around) < 0.4
    assert np.mean(first) < 0.5  # the world frame is any of the contexts


@pytest.mark.parametrize("frames", [4, 5, 6, 7])
def test_a_short_stretch_of_few_frames_is_all_of_them_at_most(frames):
    for seed in range(50):
        contexts, targets = draw_views(
            np.random.default_rng(seed), frames, 4, ViewConfig(targets=1, near=1.0)
        )
        assert len(set(contexts)) == 4 and min(contexts) >= 0 and max(contexts) < frames
        assert 0 <= targets[0] < frames


def test_unordered_views_may_come_from_a_short_stretch():
    cfg = ViewConfig(targets=6, near=1.0)
    spans = []
    for seed in range(100):
        contexts, targets = draw_views(np.random.default_rng(seed), FRAMES, 3, cfg)
        every = np.concatenate([contexts, targets])
        assert len(set(contexts)) == 3 and every.min() >= 0 and every.max() < FRAMES
        spans.append(np.ptp(every) + 1)
    assert max(spans) <= FRAMES // 2 and max(spans) - min(spans) >= 3
    whole = [
        np.ptp(draw_views(np.random.default_rng(s), FRAMES, 3, cfg.undisturbed())[1])
        for s in range(50)
    ]
    assert np.median(whole) > FRAMES // 2


def test_samples_are_the_frames_drawn_in_the_frame_of_the_first_context():
    """Every picture, K and pose of a batch belongs to one frame; contexts come first and set frame and unit."""
    cameras = looking_at_origin(FRAMES)
    levels = np.arange(FRAMES, dtype=np.uint8)[:, None, None, None] * 10
    rgb = np.broadcast_to(levels, (FRAMES, HEIGHT, WIDTH, 3))
    K = cameras.K + 0.01 * np.arange(FRAMES)[:, None, None] * np.diag([1.0, 1.0, 0.0])[None]
    pool = [{"rgb": rgb, "K": K, "c2w": cameras.c2w}]
    cfg = ViewConfig((3,), (1.0,), targets=4, augment=False)
    batch = draw_batch(pool, 5, 2, 4, cfg, scale_rule="paper")
    for i in range(4):
        pictures = np.concatenate([batch["context_rgb"][i], batch["target_rgb"][i]])
        ids = np.rint(pictures[:, 0, 0, 0] * 25.5).astype(int)
        np.testing.assert_allclose(batch["K"][i], K[ids], rtol=1e-6)
        poses = relative_to(cameras.c2w[ids[0]], cameras.c2w[ids])
        poses[:, :3, 3] /= np.linalg.norm(poses[:3, :3, 3], axis=-1).max()
        np.testing.assert_allclose(batch["c2w"][i], poses, atol=1e-5)
        np.testing.assert_allclose(batch["vectors"][i, :, :3], poses[:3, :3, 3], atol=1e-5)


@pytest.mark.parametrize("size", [None, (12, 10)])
def test_depth_of_samples_is_that_of_their_pixels_in_their_unit(size):
    """Wherever a picture is mirrored, shrunk or put into another unit, its depth is as well."""
    cameras = looking_at_origin(FRAMES)
    depth = np.tile(np.linspace(1.0, 3.0, WIDTH, dtype=np.float32), (FRAMES, HEIGHT, 1))
    rgb = np.repeat(np.round(80 * depth)[..., None], 3, -1).astype(np.uint8)
    pool = [{"rgb": rgb, "K": cameras.K, "c2w": cameras.c2w, "depth": depth}]
    mirrored = set()
    for augment, indices in ((False, range(1)), (True, range(8))):
        cfg = ViewConfig((2,), (1.0,), targets=1, augment=augment, size=size, depth=True)
        for index in indices:
            batch = draw_batch(pool, 1, index, 1, cfg, scale_rule="paper")
            found = batch["depth"][0]
            assert found.shape == (3, *batch["target_rgb"].shape[2:4])
            row, picture = found[2, 3], batch["target_rgb"][0, 0, 3].mean(-1)
            rising = abs(np.corrcoef(row, picture)[0, 1])  # colours may be inverted
            assert rising > 0.98
            unit = np.sort(row)[[0, -1]]
            assert unit[1] / unit[0] == pytest.approx(3.0, rel=0.15)
            mirrored.add(bool(row[0] > row[-1]))
    assert mirrored == {False, True}
    bare = [{"rgb": rgb, "K": cameras.K, "c2w": cameras.c2w}]
    with pytest.raises(UserError, match=r"no depth.*--depth"):
        draw_batch(bare, 1, 0, 1, cfg, scale_rule="paper")


def test_depth_of_a_sample_is_divided_by_what_its_positions_are():
    cameras = looking_at_origin(FRAMES)
    depth = np.full((FRAMES, HEIGHT, WIDTH), 5.0, np.float32)
    rgb = np.zeros((FRAMES, HEIGHT, WIDTH, 3), np.uint8)
    pool = [{"rgb": rgb, "K": cameras.K, "c2w": cameras.c2w, "depth": depth}]
    cfg = ViewConfig((2,), (1.0,), targets=1, augment=False, depth=True)
    batch = draw_batch(pool, 1, 0, 1, cfg, scale_rule="paper")
    apart = np.linalg.norm(batch["c2w"][0, 1, :3, 3])
    ratios = [np.linalg.norm(a[:3, 3] - b[:3, 3]) / apart for a in cameras.c2w for b in cameras.c2w]
    assert np.min(np.abs(5.0 / batch["depth"][0, 0, 0, 0] - ratios)) < 1e-4
