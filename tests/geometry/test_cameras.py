"""Conventions, normalisation and the camera vector, against published numbers and invariances."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from camera_cases import (
    assert_same_inputs,
    moved,
    network_inputs,
    random_cameras,
    random_rigid,
    random_rotation,
    seeds,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file

from roge_jax.errors import UserError
from roge_jax.geometry import cameras as cams
from roge_jax.geometry.cameras import Cameras, camera_vector, normalise
from roge_jax.geometry.crops import cover_window, crop_resize_K
from roge_jax.geometry.rays import plucker

FIXTURE = Path(__file__).parents[1] / "fixtures" / "lagernvs_camera"
CASE = json.loads((FIXTURE / "case.json").read_text())
SCENARIOS = {scenario["name"]: scenario for scenario in CASE["config"]["scenarios"]}
few = settings(max_examples=25, deadline=None)


def relative(a, b) -> float:
    return float(np.linalg.norm(np.asarray(a, np.float64) - b) / np.linalg.norm(b))


def intrinsics(fxfycxcy: np.ndarray) -> np.ndarray:
    K = np.tile(np.eye(3), (len(fxfycxcy), 1, 1))
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = fxfycxcy.T
    return K


@pytest.mark.parametrize("name", SCENARIOS)
def test_lagernvs_numbers(name):
    """World frame, divisor, camera vector and rays equal the published code's (float32)."""
    data, scenario = load_file(FIXTURE / "io.safetensors"), SCENARIOS[name]
    (height, width), m = scenario["hw"], scenario["M"]
    K, c2w = intrinsics(data[f"in.{name}.fxfycxcy"]), data[f"in.{name}.c2w"]
    every = cams.to_host(Cameras(K, c2w))
    targets = every[m:] if m < len(every) else every
    _, _, info = normalise(every[:m], targets, degenerate="one")
    every = info.apply(every)
    assert relative(every.c2w, data[f"out.{name}.c2w_norm"]) < 1e-6
    np.testing.assert_allclose(info.camera_scale, data[f"out.{name}.camera_scale"], atol=1e-6)
    reach = max(info.context_reach, info.target_reach) / info.divisor
    if m < len(every):
        assert abs(reach - data[f"out.{name}.scene_scale_ratio"]) < 1e-6 * reach

    expected = data[f"out.{name}.cam11"]
    vector = camera_vector(every, height, width, info.camera_scale, info.points_flag)
    assert vector.dtype == np.float32
    rays = np.array(plucker(every.K, every.c2w, height, width))
    if scenario["mode"] == "unposed":  # there the contexts' cameras are hidden from the network
        vector[:m, :9], rays[:m] = 0.0, 0.0
    assert relative(vector, expected) < 1e-6
    traced = camera_vector(
        Cameras(jnp.asarray(every.K), jnp.asarray(every.c2w)), height, width, 0.0, 0.0
    )
    posed = slice(m if scenario["mode"] == "unposed" else 0, None)
    assert relative(traced[posed, :9], expected[posed, :9]) < 1e-6
    moment_first = np.moveaxis(data[f"out.{name}.rays_moment_first"], 1, -1)
    assert relative(np.roll(rays, 3, axis=-1), moment_first) < 1e-6


@pytest.mark.parametrize("size", [(288, 512), (512, 512), (256, 256), (384, 512), (288, 504)])
def test_crops_truncate_as_lagernvs_does(size):
    """Photos of all shapes at its own sizes; 479 pixels to 4:7 keep 273 rows, where rounding keeps 274."""
    assert cover_window((853, 479), (288, 504))[2:] == (273, 479)
    ratio = size[0] / size[1]
    for height in range(90, 1000, 7):
        for width in (480, 500, 640, 641, 720, 853, 960, 1280, 1920):
            wide = ratio <= height / width  # their rule, in their floating point
            want = (int(width * ratio), width) if wide else (height, int(height / ratio))
            assert cover_window((height, width), size)[2:] == want, (height, width)


@pytest.mark.parametrize("index", range(3))
def test_lagernvs_crops(index):
    """Size of the centre crop and the intrinsics after it."""
    data, crop = load_file(FIXTURE / "io.safetensors"), CASE["config"]["crops"][index]
    source, target = tuple(crop["orig_hw"]), tuple(crop["tgt_hw"])
    assert cover_window(source, target)[2:] == tuple(data[f"out.crop{index}.crop_hw"])
    K = crop_resize_K(intrinsics(np.array([crop["fxfycxcy"]]))[0], source, target)
    ours = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    np.testing.assert_allclose(ours, data[f"out.crop{index}.fxfycxcy"], rtol=1e-6)


@few
@given(seeds)
def test_quaternion_inverts_rotation(seed):
    R = random_rotation(np.random.default_rng(seed))
    q = cams.quaternion(R)
    assert q[3] >= 0
    np.testing.assert_allclose(np.linalg.norm(q), 1.0, atol=1e-14)
    np.testing.assert_allclose(cams.rotation(q), R, atol=1e-14)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle", [0.0, 1e-9, np.pi - 1e-9, np.pi])
def test_quaternion_near_its_branches(axis, angle):
    """Turns by nearly 0 and nearly 180 degrees, where one formula alone loses all digits."""
    q = np.zeros(4)
    q[axis], q[3] = np.sin(angle / 2), np.cos(angle / 2)
    R = cams.rotation(q)
    np.testing.assert_allclose(cams.rotation(cams.quaternion(R)), R, atol=1e-14)


@few
@given(seeds)
def test_invert_and_relative(seed):
    rng = np.random.default_rng(seed)
    poses = random_cameras(rng, 3).c2w
    np.testing.assert_allclose(cams.invert(poses), np.linalg.inv(poses), atol=1e-12)
    origin = random_rigid(rng)
    expected = np.linalg.inv(origin) @ poses
    np.testing.assert_allclose(cams.relative_to(origin, poses), expected, atol=1e-12)


@pytest.mark.parametrize("convention", cams.CONVENTIONS)
def test_conventions_round_trip(convention):
    """The same photo written in four conventions is one camera."""
    c2w = random_cameras(np.random.default_rng(0), 4).c2w
    written = c2w @ np.diag([1.0, -1.0, -1.0, 1.0]) if convention.startswith("opengl") else c2w
    written = np.linalg.inv(written) if convention.endswith("w2c") else written
    np.testing.assert_allclose(cams.to_opencv(written, convention), c2w, atol=1e-12)
    np.testing.assert_allclose(cams.opengl_to_opencv(cams.opencv_to_opengl(c2w)), c2w)


def test_opengl_camera_looks_along_minus_z():
    """An OpenGL identity camera looks along -z with y up: OpenCV's z axis is the world's -z."""
    c2w = cams.to_opencv(np.eye(4), "opengl")
    np.testing.assert_array_equal(c2w[:3, 2], [0, 0, -1])
    np.testing.assert_array_equal(c2w[:3, 1], [0, -1, 0])


def test_unknown_words_are_met_with_a_hint():
    context = random_cameras(np.random.default_rng(0), 2)
    with pytest.raises(UserError, match="did you mean 'lagernvs'"):
        normalise(context, context, rule="lagernv")
    with pytest.raises(UserError, match="did you mean 'opencv'"):
        cams.to_opencv(np.eye(4), "opencvv")
    with pytest.raises(UserError, match="divisor"):
        normalise(context, context, scale=0.0)


@pytest.mark.parametrize(("rule", "factor"), [("lagernvs", 1.35), ("paper", 1.0)])
def test_rules(rule, factor):
    """The farthest context lies at 1 / factor; the first is the world."""
    every = random_cameras(np.random.default_rng(3), 6)
    context, target, info = normalise(every[:4], every[4:], rule=rule)
    np.testing.assert_allclose(context.c2w[0], np.eye(4), atol=1e-12)
    distances = np.linalg.norm(context.centres, axis=-1)
    np.testing.assert_allclose(distances.max(), 1 / factor, rtol=1e-12)
    np.testing.assert_allclose(info.camera_scale, 1 / factor, rtol=1e-12)
    assert info.points_flag == 0.0 and info.status == "ok"
    back = info.undo(cams.concatenate(context, target))
    np.testing.assert_allclose(back.c2w, every.c2w, atol=1e-12)
    np.testing.assert_allclose(info.apply(every[4:]).c2w, target.c2w, atol=1e-12)


def test_scale_of_the_user():
    every = random_cameras(np.random.default_rng(4), 4)
    context, _, info = normalise(every[:3], every[3:], scale=7.5)
    assert info.divisor == 7.5
    np.testing.assert_allclose(
        np.linalg.norm(context.centres, axis=-1).max(), info.context_reach / 7.5, rtol=1e-12
    )
    np.testing.assert_allclose(info.camera_scale, info.context_reach / 7.5, rtol=1e-12)


def test_targets_do_not_set_the_scale():
    every = random_cameras(np.random.default_rng(5), 6)
    far = moved(every[4:], scale=50.0)
    first, second = (normalise(every[:4], target)[2] for target in (every[4:], far))
    assert first.divisor == second.divisor
    assert not first.notes and "times as far" in second.notes[0]


def test_rounding_of_map_coordinates_is_no_baseline():
    """A tripod whose centres differ in the last digits, targets included: nothing is blown up to unit size."""
    every = random_cameras(np.random.default_rng(6), 5)
    every.c2w[:, :3, 3] = 5e6 + 1e-9 * np.arange(15).reshape(5, 3)
    context, target, info = normalise(every[:3], every[3:])
    assert info.status == "coincident_centres" and info.divisor == 1.0
    assert np.abs(context.centres).max() < 1e-7 and np.abs(target.centres).max() < 1e-7


@few
@given(seeds, st.integers(1, 4), st.sampled_from(["spread", "straight", "tripod", "far target"]))
def test_world_frame_is_free(seed, m, kind):
    """A rigid motion of the world leaves everything the networks see unchanged."""
    rng = np.random.default_rng(seed)
    every = random_cameras(rng, m + 2, straight=kind == "straight")
    if kind == "tripod":
        every.c2w[:m, :3, 3] = every.c2w[0, :3, 3]
    if kind == "far target":
        every.c2w[-1, :3, 3] *= 30.0
    other = moved(every, random_rigid(rng))
    inputs = [network_inputs(c[:m], c[m:]) for c in (every, other)]
    assert_same_inputs(*inputs, tolerance=2e-6)


@few
@given(seeds, st.integers(1, 4), st.floats(-6.0, 6.0), st.booleans())
def test_unit_is_free(seed, m, power, tripod):
    """Millimetres or kilometres: the same inputs, the same status."""
    every = random_cameras(np.random.default_rng(seed), m + 2)
    if tripod:
        every.c2w[:m, :3, 3] = every.c2w[0, :3, 3]
    other = moved(every, scale=10.0**power)
    inputs = [network_inputs(c[:m], c[m:]) for c in (every, other)]
    assert_same_inputs(*inputs, tolerance=2e-6)


@few
@given(seeds, st.sampled_from([5e6, -5e6]))
def test_offsets_of_map_coordinates(seed, offset):
    """Northings of 5,000,000 m: the same rays to 1e-5."""
    every = random_cameras(np.random.default_rng(seed), 5)
    inputs = [network_inputs(c[:3], c[3:]) for c in (every, moved(every, offset=offset))]
    assert_same_inputs(*inputs, tolerance=1e-5)


def test_subsets():
    every = random_cameras(np.random.default_rng(0), 5)
    assert len(every[2]) == 1 and len(every[1:]) == 4 and len(every[[0, 3]]) == 2
    np.testing.assert_array_equal(every[[0, 3]].c2w, every.c2w[[0, 3]])
    np.testing.assert_array_equal(every[2].K[0], every.K[2])
