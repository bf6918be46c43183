"""Path errors and TSED against closed forms, invariances and synthetic scenes."""

import itertools

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.metrics import epipolar
from roge_jax.metrics import geometry as geo


def axis_rotation(axis, degrees):
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = np.radians(degrees)
    return np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * cross @ cross


def random_rotation(rng):
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def make_path(rng, n=20, bend=0.3):
    """Unit-length-ish arc with random orientations: [n, 4, 4]."""
    s = np.linspace(0, 1, n)
    c2w = np.tile(np.eye(4), (n, 1, 1))
    c2w[:, :3, 3] = np.stack([s, bend * np.sin(np.pi * s), 0.3 * bend * s**2], axis=1)
    c2w[:, :3, :3] = [axis_rotation([0.2, 1, 0.1], 40 * t) for t in s]
    c2w[:, :3, :3] = random_rotation(rng) @ c2w[:, :3, :3]
    return c2w


def disturb(rng, c2w, position=1e-3, degrees=0.3):
    out = c2w.copy()
    out[:, :3, 3] += position * rng.standard_normal((len(c2w), 3))
    for pose in out:
        pose[:3, :3] = axis_rotation(rng.standard_normal(3), degrees) @ pose[:3, :3]
    return out


def similarity(c2w, scale, rotation, shift):
    return geo.Alignment(scale, rotation, shift).poses(c2w)


@pytest.mark.parametrize("degrees", [1e-6, 1e-3, 0.5, 90.0, 179.9])
def test_rotation_angle_is_exact_from_tiny_to_half_turns(degrees):
    a = random_rotation(np.random.default_rng(0))
    b = a @ axis_rotation([1, 2, 3], degrees)
    # one rounding of a matrix entry is 1e-16 rad against the angle
    np.testing.assert_allclose(geo.rotation_angle(a, b), degrees, rtol=1e-6)


def test_umeyama_recovers_a_similarity_and_never_mirrors():
    rng = np.random.default_rng(1)
    points = rng.standard_normal((30, 3))
    rotation, shift = random_rotation(rng), rng.standard_normal(3)
    found = geo.umeyama(points, 2.5 * points @ rotation.T + shift)
    np.testing.assert_allclose(found.scale, 2.5, rtol=1e-12)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, shift, atol=1e-12)
    mirrored = geo.umeyama(points * np.array([1, 1, -1]), points)
    np.testing.assert_allclose(np.linalg.det(mirrored.rotation), 1.0, rtol=1e-12)
    rigid = geo.umeyama(points, 2.5 * points, with_scale=False)
    assert rigid.scale == 1.0


def test_umeyama_is_the_least_squares_optimum():
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal((2, 15, 3))
    best = geo.umeyama(a, b)
    error = np.sum((best.points(a) - b) ** 2)
    for _ in range(50):
        turn = axis_rotation(rng.standard_normal(3), 0.5 * rng.standard_normal())
        other = geo.Alignment(
            best.scale * (1 + 1e-2 * rng.standard_normal()),
            turn @ best.rotation,
            best.translation + 1e-2 * rng.standard_normal(3),
        )
        assert np.sum((other.points(a) - b) ** 2) > error


def test_a_similarity_of_the_truth_has_no_error():
    rng = np.random.default_rng(3)
    truth = make_path(rng)
    moved = similarity(truth, 7.0, random_rotation(rng), 100 * rng.standard_normal(3))
    result = geo.trajectory_errors(moved, truth)
    assert result["status"] == "ok" and result["ape_r_reliable"] and result["coverage"] == 1.0
    for name in ("ape_t", "rpe_t"):
        assert result[name] < 1e-12
    for name in ("ape_r", "ape_r_rot", "rpe_r"):
        assert result[name] < 1e-8


def test_errors_do_not_depend_on_the_frame_of_the_estimate_nor_on_the_units_of_the_truth():
    rng = np.random.default_rng(4)
    truth = make_path(rng)
    estimate = disturb(rng, truth)
    first = geo.trajectory_errors(estimate, truth)
    for scale in (1e-6, 3.0, 1e6):
        turn, shift = random_rotation(rng), scale * rng.standard_normal(3)
        second = geo.trajectory_errors(similarity(estimate, scale, turn, shift), truth)
        third = geo.trajectory_errors(estimate, similarity(truth, scale, turn, shift))
        for other in (second, third):
            for name in ("ape_t", "ape_r", "ape_r_rot", "rpe_t", "rpe_r", "ambiguity_deg"):
                np.testing.assert_allclose(other[name], first[name], rtol=1e-7)
    raw = geo.trajectory_errors(estimate, truth, unit_length=False)
    np.testing.assert_allclose(raw["ape_t"], first["ape_t"] * first["path_length"], rtol=1e-9)


def test_known_errors_are_returned():
    """Every pose turned by 0.7 degrees about its own axes: APE-R and RPE-R in closed form."""
    rng = np.random.default_rng(5)
    truth = make_path(rng)
    # a constant turn of the cameras in their own axes stays: positions alone align the paths
    constant = truth.copy()
    constant[:, :3, :3] = truth[:, :3, :3] @ axis_rotation([0, 0, 1], 0.7)
    result = geo.trajectory_errors(constant, truth)
    np.testing.assert_allclose(result["ape_r"], 0.7, rtol=1e-9)
    # one wrong pose out of n: APE-R = angle / sqrt(n); RPE-R sees it in two of n - 1 steps
    one = truth.copy()
    one[7, :3, :3] = truth[7, :3, :3] @ axis_rotation([1, 1, 0], 5.0)
    result = geo.trajectory_errors(one, truth)
    np.testing.assert_allclose(result["ape_r"], 5.0 / np.sqrt(20), rtol=1e-9)
    np.testing.assert_allclose(result["rpe_r"], 5.0 * np.sqrt(2 / 19), rtol=1e-9)
    # a constant left turn of all orientations: RPE-R and rotation-aligned APE-R are blind to it
    left = truth.copy()
    left[:, :3, :3] = axis_rotation([1, 0, 0], 3.0) @ truth[:, :3, :3]
    result = geo.trajectory_errors(left, truth)
    np.testing.assert_allclose(result["ape_r"], 3.0, rtol=1e-9)
    assert result["rpe_r"] < 1e-8 and result["ape_r_rot"] < 1e-8


def test_doubling_the_position_errors_doubles_ape_and_rpe():
    rng = np.random.default_rng(6)
    truth = make_path(rng)
    error = 1e-6 * rng.standard_normal((len(truth), 3))
    scores = []
    for k in (1.0, 2.0):
        estimate = truth.copy()
        estimate[:, :3, 3] += k * error
        scores.append(geo.trajectory_errors(estimate, truth))
    np.testing.assert_allclose(scores[1]["ape_t"] / scores[0]["ape_t"], 2.0, rtol=1e-4)
    np.testing.assert_allclose(scores[1]["rpe_t"] / scores[0]["rpe_t"], 2.0, rtol=1e-4)


def test_a_mirrored_path_is_a_large_error():
    rng = np.random.default_rng(7)
    truth = make_path(rng, bend=1.0)
    truth[:, 2, 3] += 0.5 * np.cos(np.linspace(0, 9, len(truth)))
    mirrored = truth.copy()
    mirrored[:, 2, 3] *= -1
    assert geo.trajectory_errors(mirrored, truth)["ape_t"] > 0.02


@pytest.mark.parametrize("bend", [1e-3, 1e-2, 1e-1])
def test_the_predicted_ambiguity_matches_the_measured_one(bend):
    """Exact rotations, noisy positions: all of APE-R is ambiguity. 81 poses as in a video."""
    rng = np.random.default_rng(8)
    truth = make_path(rng, 81, bend)
    sigma = 1e-5
    angles, predictions = [], []
    for _ in range(60):
        estimate = truth.copy()
        estimate[:, :3, 3] += sigma * rng.standard_normal((81, 3))
        result = geo.trajectory_errors(estimate, truth, unit_length=False)
        angles.append(result["ape_r"])
        predictions.append(result["ambiguity_deg"])
        assert result["rpe_r"] < 1e-6 and result["ape_r_rot"] < 1e-6
    np.testing.assert_allclose(
        np.median(predictions), geo.alignment_ambiguity(truth[:, :3, 3], sigma), rtol=0.05
    )
    # the turn about the line is one normal number: its RMS over 60 draws has a relative error of 1/sqrt(120)
    measured = np.sqrt(np.mean(np.square(angles)))
    np.testing.assert_allclose(measured, np.median(predictions), rtol=0.3)


def test_straight_paths_are_named_not_scored():
    rng = np.random.default_rng(9)
    truth = make_path(rng, 30, bend=0.0)
    result = geo.trajectory_errors(disturb(rng, truth, 1e-3, 0.3), truth)
    assert result["straightness"] < 1e-9 and result["ambiguity_deg"] == 180.0
    assert np.isnan(result["ape_r"]) and not result["ape_r_reliable"]
    assert result["ape_t"] < 3e-3
    np.testing.assert_allclose(result["ape_r_rot"], 0.3, atol=0.05)
    nearly = make_path(rng, 30, bend=1e-3)
    result = geo.trajectory_errors(disturb(rng, nearly, 1e-3, 0.3), nearly)
    assert result["ape_r"] > 1.0 and not result["ape_r_reliable"] and result["ape_r_rot"] < 0.4


def test_straightness_of_a_line_a_circle_and_a_point():
    t = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    np.testing.assert_allclose(geo.straightness(circle), 1.0, rtol=1e-12)
    np.testing.assert_allclose(geo.straightness(circle * np.array([1, 0.1, 0])), 0.1, rtol=1e-12)
    assert geo.straightness(np.outer(t, [1, 2, 3])) < 1e-12
    assert geo.straightness(np.full((5, 3), 0.1)) == 0.0


def test_pure_rotation_has_rotation_errors_only():
    rng = np.random.default_rng(10)
    truth = make_path(rng)
    truth[:, :3, 3] = [1.0, 2.0, 3.0]
    result = geo.trajectory_errors(disturb(rng, truth, 0.0, 0.4), truth)
    assert result["status"] == "no translation" and np.isnan(result["ape_t"])
    assert 0.3 < result["ape_r_rot"] <= 0.4 + 1e-9 and result["rpe_r"] > 0.3


def test_partial_registration_is_reported_and_fails_below_ninety_percent():
    rng = np.random.default_rng(11)
    truth = make_path(rng)
    estimate = disturb(rng, truth)
    estimate[[4, 5]] = np.nan
    result = geo.trajectory_errors(estimate, truth)
    assert result["status"] == "ok" and result["coverage"] == 0.9 and np.isfinite(result["ape_t"])
    # the step from frame 3 to frame 6 is not a step of the path: it must not enter RPE
    kept = np.isfinite(estimate).all(axis=(1, 2))
    _, angles = geo.relative_pose_errors(estimate[kept], truth[kept])
    assert len(angles) == 17
    np.testing.assert_allclose(
        result["rpe_r"], np.sqrt(np.mean(np.delete(angles, 3) ** 2)), rtol=1e-9
    )
    # the unit is the length of the whole path, missing frames included
    length = geo.path_length(truth[:, :3, 3])
    np.testing.assert_allclose(result["path_length"], length, rtol=1e-12)
    aligned = geo.umeyama(estimate[kept, :3, 3], truth[kept, :3, 3]).poses(estimate[kept])
    shifts, _ = geo.relative_pose_errors(aligned, truth[kept])
    np.testing.assert_allclose(
        result["rpe_t"], np.sqrt(np.mean(np.delete(shifts, 3) ** 2)) / length, rtol=1e-9
    )
    estimate[6] = np.nan
    result = geo.trajectory_errors(estimate, truth)
    assert result["status"] == "failed: 17 of 20 frames registered" and np.isnan(result["ape_t"])


def test_bad_paths_are_named():
    rng = np.random.default_rng(12)
    truth = make_path(rng)
    scaled = truth.copy()
    scaled[3, :3, :3] *= 1.1
    with pytest.raises(UserError, match="rotation of view 3"):
        geo.trajectory_errors(scaled, truth)
    with pytest.raises(UserError, match="same n >= 3"):
        geo.trajectory_errors(truth[:-1], truth)
    with pytest.raises(UserError, match="all coincide"):
        geo.umeyama(np.ones((4, 3)), truth[:4, :3, 3])
    frozen = truth.copy()
    frozen[:, :3, 3] = 0.5
    assert (
        geo.trajectory_errors(frozen, truth)["status"] == "failed: all estimated centres coincide"
    )


# TSED


def project(points, K, c2w):
    camera = (points - c2w[:3, 3]) @ c2w[:3, :3]
    pixels = camera @ K.T
    return pixels[:, :2] / pixels[:, 2:]


def epipolar_scene(rng, n=5, k=40, step=0.2):
    K = np.tile(np.array([[200.0, 0, 120], [0, 210, 130], [0, 0, 1]]), (n, 1, 1))
    c2w = np.tile(np.eye(4), (n, 1, 1))
    c2w[:, 0, 3] = step * np.arange(n)
    c2w[:, 2, 3] = 0.3 * step * np.arange(n) ** 1.5
    c2w[:, :3, :3] = [axis_rotation([0, 1, 0.2], -3 * i) for i in range(n)]
    points = rng.uniform([-2, -2, 4], [2, 2, 8], (k, 3))
    pixels = [project(points, K[i], c2w[i]) for i in range(n)]
    return K, c2w, points, list(itertools.pairwise(pixels))


def test_projections_of_true_points_have_no_epipolar_distance():
    K, c2w, _, matches = epipolar_scene(np.random.default_rng(0))
    result = epipolar.tsed_from_matches(matches, K, c2w)
    assert result["tsed"] == 1.0 and result["median_sed"] < 1e-9 and result["pairs"] == 4
    assert set(result["curve"].values()) == {1.0} and result["zero_baseline"] == 0


def test_moving_points_across_their_lines_gives_that_distance():
    """Sideways motion, equal cameras: lines are rows, so a shift in y by d is d from both lines."""
    K = np.tile(np.diag([100.0, 100, 1]), (2, 1, 1))
    c2w = np.tile(np.eye(4), (2, 1, 1))
    c2w[1, 0, 3] = 1.0
    x = np.random.default_rng(1).uniform(0, 100, (12, 2))
    y = x + np.array([5.0, 1.75])
    F = epipolar.fundamental(K[0], c2w[0], K[1], c2w[1])
    np.testing.assert_allclose(epipolar.symmetric_epipolar_distance(x, y, F), 1.75, rtol=1e-12)
    curve = epipolar.tsed_from_matches([(x, y)], K, c2w)["curve"]
    assert curve[1.5] == 0.0 and curve[2.0] == 1.0
    # A second camera of twice the focal length: as far from the lines there, half as far from those of the first.
    K[1] = np.diag([200.0, 200, 1])
    F = epipolar.fundamental(K[0], c2w[0], K[1], c2w[1])
    far = epipolar.symmetric_epipolar_distance(x, 2 * x + np.array([5.0, 1.6]), F)
    np.testing.assert_allclose(far, (1.6 + 0.8) / 2, rtol=1e-12)


def test_the_thresholds_are_strict_in_pixels_and_inclusive_in_matches():
    K = np.tile(np.eye(3), (2, 1, 1))
    c2w = np.tile(np.eye(4), (2, 1, 1))
    c2w[1, 0, 3] = 1.0
    x = np.zeros((10, 2))
    at, below = x + np.array([3.0, 2.0]), x + np.array([3.0, 2.0 - 1e-9])

    def score(x, y):
        return epipolar.tsed_from_matches([(x, y)], K, c2w)["tsed"]

    assert score(x, at) == 0.0 and score(x, below) == 1.0
    assert score(x[:9], below[:9]) == 0.0
    none = epipolar.tsed_from_matches([(x[:0], at[:0])], K, c2w)
    assert none["tsed"] == 0.0 and none["too_few_matches"] == 1 and np.isnan(none["median_sed"])


def test_pairs_without_a_baseline_are_judged_by_rotation_or_dropped():
    rng = np.random.default_rng(2)
    K, c2w, points, _ = epipolar_scene(rng, n=4)
    c2w[2, :3, 3] = c2w[1, :3, 3] + 1e-9  # frames 1 and 2 share their centre
    pixels = [project(points, K[i], c2w[i]) for i in range(4)]
    good = list(itertools.pairwise(pixels))
    result = epipolar.tsed_from_matches(good, K, c2w)
    assert result["tsed"] == 1.0 and result["zero_baseline"] == 1 and result["dropped"] == 0
    # a frozen frame where the cameras turn by 3 degrees (about 10 pixels) is not consistent
    frozen = [good[0], (pixels[1], pixels[1]), good[2]]
    np.testing.assert_allclose(epipolar.tsed_from_matches(frozen, K, c2w)["tsed"], 2 / 3)
    dropped = epipolar.tsed_from_matches(frozen, K, c2w, zero_baseline="drop")
    assert dropped["tsed"] == 1.0 and dropped["pairs"] == 2 and dropped["dropped"] == 1
    still = np.tile(c2w[:1], (4, 1, 1))
    alone = epipolar.tsed_from_matches([(pixels[0], pixels[0])] * 3, K, still, zero_baseline="drop")
    assert np.isnan(alone["tsed"]) and alone["dropped"] == 3
    with pytest.raises(UserError, match="did you mean 'rotation'"):
        epipolar.tsed_from_matches(good, K, c2w, zero_baseline="rotations")


def test_reversed_frames_and_wrong_poses_are_inconsistent():
    rng = np.random.default_rng(3)
    K, c2w, _, matches = epipolar_scene(rng)
    wrong = c2w.copy()
    for pose in wrong:
        pose[:3, :3] = pose[:3, :3] @ axis_rotation(rng.standard_normal(3), 4.0)
    assert epipolar.tsed_from_matches(matches, K, wrong)["tsed"] < 0.5


def textured_pan(n=4, shift=6):
    """Frames cut from one texture: a camera translating in front of a fronto-parallel plane."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(4)
    wall = gaussian_filter(rng.random((128, 200, 3)), (1.5, 1.5, 0))
    wall = (wall - wall.min()) / (wall.max() - wall.min())
    frames = np.stack([wall[:, i * shift : i * shift + 160] for i in range(n)])
    K = np.tile(np.array([[160.0, 0, 80], [0, 160, 64], [0, 0, 1]]), (n, 1, 1))
    c2w = np.tile(np.eye(4), (n, 1, 1))
    c2w[:, 0, 3] = np.arange(n) * shift / 160.0  # plane at depth 1
    return frames, K, c2w


def test_sift_matches_follow_the_pixel_convention():
    frames, _, _ = textured_pan()
    x, y = epipolar.sift_matches(frames[0], frames[1])
    assert len(x) > 50
    np.testing.assert_allclose(np.median(x - y, axis=0), [6.0, 0.0], atol=0.05)


def test_sift_matches_are_the_same_either_way():
    """Both pictures choose each other: what one of them finds and the other would not is no match."""
    frames, _, _ = textured_pan()
    noise = 0.05 * np.random.default_rng(5).standard_normal(frames[0].shape)
    one, other = frames[0], np.clip(frames[3, ::-1] * 0.3 + frames[3] * 0.7 + noise, 0.0, 1.0)
    there, back = epipolar.sift_matches(one, other), epipolar.sift_matches(other, one)
    pairs = {tuple(pair) for pair in np.concatenate(there, axis=1)}
    assert pairs == {tuple(pair) for pair in np.concatenate(back[::-1], axis=1)}
    assert len(pairs) > 5


def test_tsed_scales_the_cameras_with_the_frames(monkeypatch):
    """Exact matches in frames of half the size are exact for cameras of half the size, each axis by its own factor."""
    K, c2w, _, matches = epipolar_scene(np.random.default_rng(0))
    frames = np.zeros((5, 262, 241, 3))
    scale = np.array([120 / 241, 130 / 262])
    small = iter([(x * scale, y * scale) for x, y in matches])
    monkeypatch.setattr(epipolar, "sift_matches", lambda a, b: next(small))
    result = epipolar.tsed(frames, K, c2w, side=120)
    assert result["tsed"] == 1.0 and result["median_sed"] < 1e-9


def test_tsed_of_frames_right_reversed_and_grey():
    frames, K, c2w = textured_pan()
    right = epipolar.tsed(frames, K, c2w, side=128)
    assert right["tsed"] == 1.0 and right["median_sed"] < 0.3 and right["short_side"] == 128
    # cameras that move up while the picture pans sideways
    up = c2w.copy()
    up[:, [0, 1], 3] = up[:, [1, 0], 3]
    assert epipolar.tsed(frames, K, up, side=128)["tsed"] == 0.0
    grey = epipolar.tsed(np.full_like(frames, 0.5), K, c2w)
    assert grey["tsed"] == 0.0 and grey["too_few_matches"] == 3 and grey["short_side"] == 256
