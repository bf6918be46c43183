"""One test for every way in which cameras and photos can be odd: what is found, what happens."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_cases import (
    assert_same_inputs,
    looking_at_origin,
    moved,
    network_inputs,
    random_cameras,
    random_K,
    random_rigid,
    random_rotation,
    seeds,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_files import HEIGHT, WIDTH, picture

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import (
    Cameras,
    CameraWarning,
    inspect,
    normalise,
    opencv_to_opengl,
    to_opencv,
    validate,
)
from roge_jax.geometry.crops import crop_resize, crop_resize_K
from roge_jax.geometry.packing import pack_views
from roge_jax.geometry.rays import plucker, project, ray_distance, triangulate
from roge_jax.geometry.validation import nearest_rotation
from roge_jax.metrics.geometry import straightness
from roge_jax.scenes.scene import Scene, prepare

few = settings(max_examples=25, deadline=None)


def some(views: int = 4, seed: int = 0) -> Cameras:
    return random_cameras(np.random.default_rng(seed), views, HEIGHT, WIDTH)


def check_cameras(cameras: Cameras):
    return validate(cameras, HEIGHT, WIDTH, [f"v{i}.png" for i in range(len(cameras))])


# Scale and counts


@pytest.mark.parametrize("baseline", [0.0, 1e-7])
def test_coincident_centres(baseline):
    """No division by a distance that is zero or only hand-shake: the targets give the scale."""
    every = some(5)
    every.c2w[:3, :3, 3] = [1.0, 2.0, 3.0]
    every.c2w[1, 0, 3] += baseline
    context, target, info = normalise(every[:3], every[3:])
    assert info.status == "coincident_centres" and "fix no scale" in info.notes[0]
    assert (info.camera_scale, info.points_flag) == (0.0, 1.0)
    np.testing.assert_allclose(np.linalg.norm(target.centres, axis=-1).max(), 1 / 1.35)
    assert np.isfinite(context.c2w).all() and np.abs(context.centres).max() < 1e-6


def test_single_context():
    """The scale comes from the targets, or stays as it is where LagerNVS's rule is asked for."""
    every = some(3)
    _, target, info = normalise(every[:1], every[1:])
    assert (info.status, info.camera_scale, info.points_flag) == ("single_view", 0.0, 1.0)
    np.testing.assert_allclose(np.linalg.norm(target.centres, axis=-1).max(), 1 / 1.35)
    _, _, lager = normalise(every[:1], every[1:], degenerate="one")
    assert (lager.divisor, lager.camera_scale, lager.points_flag) == (1.0, 0.0, 1.0)


def test_no_views():
    every = some(2)
    with pytest.raises(UserError, match="no context views"):
        normalise(every[:0], every)
    with pytest.raises(UserError, match="no target views"):
        normalise(every, every[:0])


def test_duplicate_views():
    """A photo given twice counts once; the same pose with another picture is kept."""
    images = [picture(v).astype(np.float32) / 255 for v in (0, 1, 0, 3)]
    cameras = some(4)
    cameras.c2w[2:], cameras.K[2:] = cameras.c2w[[0, 0]], cameras.K[[0, 0]]
    scene = Scene(images, cameras, ("a", "b", "c", "d"), "test")
    with pytest.warns(CameraWarning, match="same pose and picture as another view: c"):
        pictures, kept = prepare(scene, [0, 1, 2, 3], 16, 16)
    expected, single = prepare(scene, [0, 1, 3], 16, 16)
    np.testing.assert_array_equal(pictures, expected)
    np.testing.assert_array_equal(kept.c2w, single.c2w)
    assert prepare(scene, [0, 1, 2], 16, 16, drop_duplicates=False)[0].shape[0] == 3


def test_collinear_centres():
    """Fine for rays; the number that flags it is small."""
    line = random_cameras(np.random.default_rng(0), 6, straight=True)
    assert straightness(line.centres) < 1e-2 < straightness(some(6).centres)
    _, rays, status = network_inputs(line[:3], line[3:])
    assert np.isfinite(rays).all() and status == "ok"


def test_pure_rotation():
    """A tripod scene: the rays are those of the rotations alone."""
    every = some(4)
    every.c2w[:, :3, 3] = 5.0
    still = Cameras(every.K, every.c2w.copy())
    still.c2w[:, :3, 3] = 0.0
    _, rays, status = network_inputs(every[:2], every[2:])
    _, expected, _ = network_inputs(still[:2], still[2:])
    assert status == "coincident_centres"
    np.testing.assert_allclose(rays, expected, atol=1e-6)
    np.testing.assert_allclose(rays[..., 3:], 0.0, atol=1e-6)


# Poses


@few
@given(seeds, st.integers(0, 2))
def test_mirrored_axes(seed, column):
    """Flipping any one axis turns a rotation into a mirror: refused, with a hint."""
    cameras = some(3, seed)
    cameras.c2w[1, :3, column] *= -1
    with pytest.raises(UserError, match=r"view 1 \(v1.png\), c2w: mirrored.*left-handed"):
        check_cameras(cameras)


def test_opengl_read_as_opencv():
    """Inward cameras whose axes are reversed meet behind themselves: a warning names the cure."""
    good = looking_at_origin(5)
    assert not inspect(good, HEIGHT, WIDTH)[1]
    wrong = Cameras(good.K, opencv_to_opengl(good.c2w))
    with pytest.warns(CameraWarning, match="convention='opengl'"):
        check_cameras(wrong)
    np.testing.assert_allclose(to_opencv(wrong.c2w, "opengl"), good.c2w)
    stairs = looking_at_origin(
        6
    )  # looking outward at every height: axes pass far behind each other
    angles = np.radians(50.0 * np.arange(6))
    z = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    down = np.tile([0.0, 0.0, -1.0], (6, 1))
    stairs.c2w[:, :3, :3] = np.stack([np.cross(down, z), down, z], -1)
    stairs.c2w[:, :3, 3] = z - 1.5 * np.arange(6)[:, None] * down
    assert not inspect(stairs, HEIGHT, WIDTH)[1]


@pytest.mark.parametrize("size", [1e-7, 1e-6, 1e-4, 1e-3, 0.03, 0.3])
def test_rotations_that_are_none(size):
    """Three bands of |R^T R - I|: as it is, nearest rotation with a warning, refused."""
    cameras = some(3)
    R = cameras.c2w[1, :3, :3].copy()
    shear = np.eye(3)
    shear[0, 1] = size / np.sqrt(2)  # |R^T R - I| = size to first order
    cameras.c2w[1, :3, :3] = R @ shear
    if size < 1e-5:
        np.testing.assert_array_equal(check_cameras(cameras).c2w, cameras.c2w)
    elif size < 1e-2:
        with pytest.warns(CameraWarning, match=r"not orthonormal.*degrees"):
            mended = check_cameras(cameras).c2w[1, :3, :3]
        np.testing.assert_allclose(mended.T @ mended, np.eye(3), atol=1e-12)
        assert np.linalg.norm(mended - R) < size
    else:
        with pytest.raises(UserError, match="R is no rotation"):
            check_cameras(cameras)


def test_scaled_rotations():
    """A similarity instead of a rigid pose: refused, and the factor is told."""
    cameras = some(3)
    cameras.c2w[2, :3, :3] *= 2.5
    with pytest.raises(UserError, match=r"view 2 .* scale of 2\.5; divide"):
        check_cameras(cameras)


@few
@given(seeds)
def test_nearest_rotation_is_nearest(seed):
    rng = np.random.default_rng(seed)
    R = random_rotation(rng)
    noisy = R + 1e-3 * rng.normal(size=(3, 3))
    best = nearest_rotation(noisy)
    gap = np.linalg.norm(best - noisy)
    for _ in range(5):
        turn_by = random_rigid(rng)[:3, :3] if rng.random() < 0.2 else np.eye(3)
        small = nearest_rotation(np.eye(3) + 1e-3 * rng.normal(size=(3, 3)))
        assert np.linalg.norm(best @ small @ turn_by - noisy) >= gap - 1e-12


def test_last_row():
    """3x4 is completed; any other last row is refused, a transposed matrix recognised."""
    cameras = some(2)
    short = Cameras(cameras.K, cameras.c2w[:, :3])
    np.testing.assert_array_equal(check_cameras(short).c2w, cameras.c2w)
    wrong = Cameras(cameras.K, cameras.c2w.copy())
    wrong.c2w[1, 3] = [0, 0, 0, 2]
    with pytest.raises(UserError, match=r"view 1 .*last row"):
        check_cameras(wrong)
    wrong.c2w[1] = cameras.c2w[1].T
    with pytest.raises(UserError, match="looks transposed"):
        check_cameras(wrong)
    with pytest.raises(UserError, match="4x4 or 3x4"):
        check_cameras(Cameras(cameras.K, cameras.c2w[:, :2]))


@few
@given(st.integers(0, 2), st.integers(0, 24), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_numbers_that_are_none(view, entry, value):
    """NaN or infinity anywhere: refused, naming the view and the field; also by `normalise`."""
    cameras = some(3)
    K, c2w = cameras.K.copy(), cameras.c2w.copy()
    if entry < 16:
        c2w[view].flat[entry] = value
    else:
        K[view].flat[entry - 16] = value
    field = "c2w" if entry < 16 else "K"
    with pytest.raises(UserError, match=rf"view {view} \(v{view}.png\), {field}: entry \["):
        check_cameras(Cameras(K, c2w))
    with pytest.raises(UserError, match=f"context view {view} has NaN"):
        normalise(Cameras(K, c2w), cameras)


# Intrinsics


def with_K(**entries: float) -> Cameras:
    cameras = looking_at_origin(2)
    places = {"fx": (0, 0), "skew": (0, 1), "cx": (0, 2), "fy": (1, 1), "cy": (1, 2)}
    K = cameras.K.copy()
    for name, value in entries.items():
        K[1][places[name]] = value
    return Cameras(K, cameras.c2w)


@pytest.mark.parametrize(
    ("entries", "severity", "words"),
    [
        ({"fx": 0.0}, "error", "focal length fx = 0"),
        ({"fy": -40.0}, "error", "must be positive"),
        ({"fx": 1.5, "fy": 41.0}, "error", "give it in pixels"),
        ({"fx": 1.9, "fy": 1.9, "cx": 20.0}, "error", "give it in pixels"),
        ({"fx": 41.0 * 60, "fy": 41.0 * 60}, "warning", "times the width"),
        ({"fx": 40.0, "fy": 15.0}, "warning", "far from square"),
    ],
)
def test_focal_lengths(entries, severity, words):
    _, findings = inspect(with_K(**entries), HEIGHT, WIDTH)
    assert [f.severity for f in findings] == [severity]
    assert words in str(findings[0]) and "view 1" in findings[0].where


@pytest.mark.parametrize(
    ("entries", "severity", "words"),
    [
        ({"fx": 0.9, "fy": 1.1, "cx": 0.5, "cy": 0.5}, "error", "looks normalised"),
        ({"cx": 80.0, "cy": 48.0}, "error", "for about 160 x 96"),
        ({"cx": -3.0}, "error", "outside"),
        ({"cx": 10.0, "cy": 6.0}, "warning", "for a picture of 20 x 12"),
    ],
)
def test_intrinsics_for_another_picture(entries, severity, words):
    _, findings = inspect(with_K(**entries), HEIGHT, WIDTH)
    assert [f.severity for f in findings] == [severity] and words in str(findings[0])
    if severity == "error":
        with pytest.raises(UserError, match="view 1"):
            check_cameras(with_K(**entries))


def test_wide_views():
    """Pinhole rays stay valid below 180 degrees; above 120 there is a warning."""
    cameras = with_K(fx=8.0, fy=8.0)
    with pytest.warns(CameraWarning, match="field of view 136"):
        check_cameras(cameras)
    with pytest.warns(CameraWarning, match="field of view 116 x 123"):  # across and down
        check_cameras(with_K(fx=12.5, fy=6.5))
    rays = np.asarray(plucker(cameras.K, cameras.c2w, HEIGHT, WIDTH))
    np.testing.assert_allclose(np.linalg.norm(rays[..., :3], axis=-1), 1.0, atol=1e-6)


@few
@given(seeds)
def test_skewed_and_off_centre_intrinsics(seed):
    """The full inverse of K: K d is proportional to the pixel to 1e-6."""
    rng = np.random.default_rng(seed)
    K = random_K(rng, HEIGHT, WIDTH, skew=rng.uniform(-0.5, 0.5))[None]
    d = np.asarray(plucker(K, np.eye(4)[None], HEIGHT, WIDTH), np.float64)[0, ..., :3]
    pixels = d @ K[0].T
    pixels = pixels[..., :2] / pixels[..., 2:]
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    np.testing.assert_allclose(pixels / WIDTH, np.stack([x, y], -1) / WIDTH, atol=2e-6)
    inspected = inspect(Cameras(K, np.eye(4)[None]), HEIGHT, WIDTH)[1]
    assert not [f for f in inspected if f.severity == "error"]


@few
@given(seeds, st.sampled_from([(16, 16), (48, 80), (7, 31), (24, 11)]))
def test_cropping_commutes_with_projection(seed, size):
    """Points projected with the new K are the old pixels, cropped and scaled (1e-9)."""
    rng = np.random.default_rng(seed)
    cameras = random_cameras(rng, 1, HEIGHT, WIDTH, skew=0.1)
    points = rng.normal(size=(20, 3)) * 3
    before, _, visible = project(cameras.K[0], cameras.c2w[0], points)
    K = crop_resize_K(cameras.K[0], (HEIGHT, WIDTH), size)
    after, _, _ = project(K, cameras.c2w[0], points)
    corners = np.array([[0.0, 0.0], [1.0, 1.0]])
    inverse = np.linalg.inv(K @ np.linalg.inv(cameras.K[0]))
    window = corners * size[::-1] @ inverse[:2, :2].T + inverse[:2, 2]
    wide = window[1] - window[0]
    expected = (before - window[0]) / wide * size[::-1]
    np.testing.assert_allclose(after[visible], expected[visible], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(wide[0] / wide[1], size[1] / size[0], rtol=0.1)
    assert (window[0] >= -1e-9).all() and (window[1] <= np.array([WIDTH, HEIGHT]) + 1e-9).all()


@pytest.mark.parametrize("filter_of", ["opencv", "jax"])
@pytest.mark.parametrize("size", [(16, 28), (12, 16), (48, 60)])
def test_pixels_move_as_intrinsics_say(monkeypatch, filter_of, size):
    """A picture of its own coordinates, cropped and resized: every colour is the coordinate that
    the new intrinsics assign to that pixel, with either filter."""
    if filter_of == "jax":
        monkeypatch.setitem(sys.modules, "cv2", None)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image = np.stack([x / WIDTH, y / WIDTH, 0 * x], -1).astype(np.float32)
    small, K = crop_resize(image, np.eye(3), *size)
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    expected = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]], -1) / WIDTH
    inner = (slice(2, -2), slice(2, -2))
    assert small.shape == (*size, 3) and small.dtype == np.float32
    error = (small[..., :2] - expected)[inner] * WIDTH
    # Cut pixels of a box filter count at their centre: up to 1/8 pixel, in both directions.
    assert np.abs(error).max() < 0.126 and np.abs(error.mean((0, 1))).max() < 0.02


def test_ray_through_the_principal_point():
    """It is the third column of R, to the bit."""
    cameras = some(3)
    K = np.repeat(np.array([[[55.0, 7.0, 20.5], [0, 44.0, 9.5], [0, 0, 1]]]), 3, 0)
    rays = np.asarray(plucker(K, cameras.c2w, HEIGHT, WIDTH))
    expected = cameras.c2w[:, :3, 2].astype(np.float32)
    np.testing.assert_array_equal(rays[:, 9, 20, :3], expected)


# Projection and triangulation


def test_points_behind_the_camera():
    """Marked, never divided by their depth, and without gradients that are not numbers."""
    K, c2w = jnp.asarray(with_K().K[0]), jnp.eye(4)
    points = jnp.array([[0.0, 0.0, 0.0], [1.0, 1.0, -2.0], [1.0, 1.0, 0.0], [0.1, 0.2, 2.0]])

    def loss(points):
        pixels, _, visible = project(K, c2w, points)
        return jnp.sum(pixels**2), visible

    (value, visible), gradient = jax.value_and_grad(loss, has_aux=True)(points)
    assert visible.tolist() == [False, False, False, True]
    assert np.isfinite(value) and np.isfinite(gradient).all()
    assert not np.any(gradient[:3]) and np.any(gradient[3])


def test_nearly_parallel_rays():
    """Below one degree a point is at infinity; distances stay exact for parallel lines."""
    centres = np.array([[0.4, -0.3, 0.2], [1.4, -0.3, 0.2]])
    for angle, expected in ((0.0, False), (0.5, False), (2.0, True)):
        tilt = np.radians(angle)
        d = np.array([[0.0, 0.0, 1.0], [-np.sin(tilt), 0.0, np.cos(tilt)]])
        lines = np.concatenate([d, np.cross(centres, d)], -1)
        point, finite = triangulate(lines[0], lines[1])
        assert finite == expected and np.isfinite(point).all()
    parallel = np.concatenate([d[:1], np.cross(centres[1:], d[:1])], -1)[0]
    np.testing.assert_allclose(ray_distance(lines[0], parallel), 1.0, atol=1e-12)
    opposite = np.concatenate([-parallel[:3], -parallel[3:]])
    np.testing.assert_allclose(ray_distance(lines[0], opposite), 1.0, atol=1e-12)


# Gauge


def test_map_coordinates():
    """5,000,000 m from the origin: the same rays to 1e-5, where float32 poses would be 0.1 off."""
    every = some(5)
    far = moved(every, offset=5e6)
    assert_same_inputs(
        network_inputs(far[:3], far[3:]), network_inputs(every[:3], every[3:]), tolerance=1e-5
    )
    rounded = Cameras(far.K, far.c2w.astype(np.float32))
    gap = network_inputs(rounded[:3], rounded[3:])[1] - network_inputs(every[:3], every[3:])[1]
    assert np.abs(gap).max() > 0.05  # the test can see what it guards against


@few
@given(seeds, st.floats(-6.0, 6.0))
def test_unit_of_the_scene(seed, power):
    every = some(5, seed)
    other = moved(every, scale=10.0**power)
    assert_same_inputs(
        network_inputs(other[:3], other[3:]), network_inputs(every[:3], every[3:]), tolerance=2e-6
    )


@few
@given(seeds)
def test_world_frame_of_the_scene(seed):
    every = some(5, seed)
    other = moved(every, random_rigid(np.random.default_rng(seed + 1)))
    assert_same_inputs(
        network_inputs(other[:3], other[3:]), network_inputs(every[:3], every[3:]), tolerance=2e-6
    )


@few
@given(seeds, st.permutations([1, 2, 3, 4]))
def test_order_of_contexts(seed, rest):
    """With the first view fixed contexts 2..M permute: same divisor, permuted rays and slots, targets bit for bit."""
    every = some(7, seed)
    order = [0, *rest]
    swapped = every[[*order, 5, 6]]
    vector, rays, status = network_inputs(every[:5], every[5:])
    other_vector, other_rays, other_status = network_inputs(swapped[:5], swapped[5:])
    assert status == other_status == "ok"
    np.testing.assert_array_equal(other_vector, vector[order])
    np.testing.assert_array_equal(other_rays[:5], rays[:5][order])
    np.testing.assert_array_equal(other_rays[5:], rays[5:])
    slots, other_slots = pack_views(rays[:6], 5), pack_views(other_rays[:6], 5)
    np.testing.assert_array_equal(other_slots[:5], slots[:5][order])
    np.testing.assert_array_equal(other_slots[5], slots[5])
    assert np.abs(rays[1] - rays[2]).max() > 1e-3  # the views differ: an order can be seen


@few
@given(seeds, st.integers(1, 4))
def test_another_first_context(seed, first):
    """It moves the world by one rigid motion and keeps the divisor's rule: its own largest distance to a context."""
    every = some(7, seed)
    order = [first, *(i for i in range(5) if i != first)]
    _, target, info = normalise(every[:5], every[5:])
    _, other, moved_info = normalise(every[order], every[5:])
    relative = other.c2w @ np.linalg.inv(target.c2w)
    ratio = info.divisor / moved_info.divisor
    for motion in relative:
        np.testing.assert_allclose(motion[:3, :3], relative[0, :3, :3], atol=1e-6)
    steps = [np.diff(c.centres, axis=0) for c in (target, other)]
    expected = ratio * steps[0] @ relative[0, :3, :3].T
    np.testing.assert_allclose(steps[1], expected, atol=1e-5)
