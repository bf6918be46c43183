"""Camera paths: presets do what their names say, in any unit; path files round-trip."""

import json

import numpy as np
import pytest
from camera_cases import looking_at_origin, moved, random_cameras, random_rigid, seeds
from hypothesis import given, settings

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import (
    CONVENTIONS,
    Cameras,
    normalise,
    opencv_to_opengl,
    relative_to,
)
from roge_jax.geometry.interpolation import interpolate
from roge_jax.geometry.rays import project
from roge_jax.geometry.trajectories import (
    PRESETS,
    focus_distance,
    make_path,
    world_up,
)
from roge_jax.scenes.paths import load_path, save_path

few = settings(max_examples=15, deadline=None)
CONTEXT = looking_at_origin(5)
SIZE = {"height": 24, "width": 40}


def in_start(path: Cameras) -> np.ndarray:
    """Poses of the path seen from context view 0."""
    return relative_to(CONTEXT.c2w[0], path.c2w)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_a_path(name):
    """Rotations, finite, of the asked length, moving in small steps, not standing still."""
    path = make_path(name, CONTEXT, 33)
    R = path.c2w[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (33, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-9)
    flat = np.concatenate([path.c2w.reshape(33, -1), path.K.reshape(33, -1) / 40], 1)
    steps = np.abs(np.diff(flat, axis=0)).max(1)
    assert np.isfinite(flat).all() and steps.max() > 1e-3
    assert steps.max() < 1.0
    for short in (1, 2):
        assert len(make_path(name, CONTEXT, short)) == short


@pytest.mark.parametrize("name", sorted(set(PRESETS) - {"interpolate"}))
def test_presets_start_at_the_photo(name):
    path = make_path(name, CONTEXT, 9, start=2)
    np.testing.assert_allclose(path.c2w[0], CONTEXT.c2w[2], atol=1e-9)
    np.testing.assert_allclose(path.K[0], CONTEXT.K[2], atol=1e-9)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_know_no_unit_and_no_world(name):
    """Moving or rescaling the world moves and rescales the path, nothing else."""
    world = random_rigid(np.random.default_rng(0))
    plain = make_path(name, CONTEXT, 9)
    other = make_path(name, moved(CONTEXT, world, scale=1e-3), 9)
    expected = moved(plain, world, scale=1e-3)
    np.testing.assert_allclose(other.c2w[:, :3, :3], expected.c2w[:, :3, :3], atol=1e-7)
    np.testing.assert_allclose(other.centres, expected.centres, atol=1e-9)
    np.testing.assert_allclose(other.K, expected.K, rtol=1e-7)


@pytest.mark.parametrize(
    ("name", "axis", "sign"),
    [
        ("move-left", 0, -1),
        ("move-right", 0, 1),
        ("move-up", 1, -1),
        ("move-down", 1, 1),
        ("move-forward", 2, 1),
        ("move-backward", 2, -1),
        ("dolly-in", 2, 1),
        ("dolly-out", 2, -1),
    ],
)
def test_straight_moves(name, axis, sign):
    """OpenCV axes: right +x, down +y, forward +z, by `distance` of the focus, without turning."""
    poses = in_start(make_path(name, CONTEXT, 5, distance=0.5, focus=2.0))
    expected = np.zeros((5, 3))
    expected[:, axis] = sign * np.linspace(0, 1.0, 5)
    np.testing.assert_allclose(poses[:, :3, 3], expected, atol=1e-9)
    np.testing.assert_allclose(poses[:, :3, :3], np.tile(np.eye(3), (5, 1, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "component", "sign"),
    [("pan-left", 0, -1), ("pan-right", 0, 1), ("tilt-up", 1, -1), ("tilt-down", 1, 1)],
)
def test_turns_on_the_spot(name, component, sign):
    """The view direction swings to the named side of the start picture by the given angle."""
    path = make_path(name, CONTEXT, 9, degrees=10.0)
    poses = in_start(path)
    np.testing.assert_allclose(poses[:, :3, 3], 0.0, atol=1e-9)
    assert sign * poses[-1, component, 2] > 0.1
    angle = np.degrees(np.arccos(poses[-1, 2, 2]))
    assert angle <= 10.0 + 1e-6 and angle > 9.0


def test_roll_keeps_the_view_direction():
    poses = in_start(make_path("roll", CONTEXT, 5, degrees=90.0))
    np.testing.assert_allclose(poses[:, :3, 2], np.tile([0.0, 0.0, 1.0], (5, 1)), atol=1e-9)
    np.testing.assert_allclose(poses[-1, :3, 0], [0.0, 1.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("degrees", [40.0, 360.0])
def test_orbit_keeps_distance_and_aim(degrees):
    """Every camera of an orbit is as far from the point in focus and has it in the same pixel."""
    path = make_path("orbit", CONTEXT, 17, degrees=degrees)
    point = CONTEXT.c2w[0, :3, 3] + focus_distance(CONTEXT) * CONTEXT.c2w[0, :3, 2]
    np.testing.assert_allclose(np.linalg.norm(path.centres - point, axis=-1), 4.0, rtol=1e-6)
    pixels, _, visible = project(path.K, path.c2w, np.tile(point, (17, 1, 1)))
    assert visible.all()
    np.testing.assert_allclose(pixels[:, 0], np.tile([20.0, 12.0], (17, 1)), atol=1e-6)
    heights = path.centres @ world_up(CONTEXT)
    np.testing.assert_allclose(heights, heights[0], atol=1e-6)
    if degrees == 360.0:
        np.testing.assert_allclose(path.c2w[-1], path.c2w[0], atol=1e-9)
    else:  # half of the arc to either side, first to one
        right = (path.centres - path.centres[0]) @ CONTEXT.c2w[0, :3, 0]
        assert abs(right[4] + right[12]) < 1e-6
        ends = path.centres[[4, 12]] - point
        cosine = ends[0] @ ends[1] / np.prod(np.linalg.norm(ends, axis=-1))
        level = 1.0 - (ends[0] @ world_up(CONTEXT) / 4.0) ** 2  # on a cone, unless it is level
        assert np.degrees(np.arccos((cosine - 1.0) / level + 1.0)) == pytest.approx(degrees)


@pytest.mark.parametrize("name", ["spiral", "lemniscate"])
def test_curves_look_at_the_scene_and_close(name):
    path = make_path(name, CONTEXT, 33)
    point = CONTEXT.c2w[0, :3, 3] + focus_distance(CONTEXT) * CONTEXT.c2w[0, :3, 2]
    pixels, _, visible = project(path.K, path.c2w, np.tile(point, (33, 1, 1)))
    assert visible.all()
    np.testing.assert_allclose(pixels[:, 0], np.tile([20.0, 12.0], (33, 1)), atol=1e-6)
    np.testing.assert_allclose(path.c2w[-1], path.c2w[0], atol=1e-9)


def test_zoom_and_dolly_zoom():
    """Zooming changes only the focal length; a dolly zoom keeps the size of what is in focus."""
    zoomed = make_path("zoom-in", CONTEXT, 5, factor=2.0)
    np.testing.assert_allclose(zoomed.K[-1, [0, 1], [0, 1]], 80.0)
    np.testing.assert_allclose(zoomed.K[1:, 0, 0] / zoomed.K[:-1, 0, 0], 2.0**0.25)  # evenly
    np.testing.assert_allclose(zoomed.K[:, :2, 2], np.tile(CONTEXT.K[0, :2, 2], (5, 1)))
    for name in ("dolly-zoom-in", "dolly-zoom-out"):
        path = make_path(name, CONTEXT, 5, focus=3.0)
        pose = CONTEXT.c2w[0]
        edge = pose[:3, 3] + 3.0 * pose[:3, 2] + 0.7 * pose[:3, 0]
        pixels, _, _ = project(path.K, path.c2w, np.tile(edge, (5, 1, 1)))
        np.testing.assert_allclose(pixels[:, 0, 0], pixels[0, 0, 0], atol=1e-9)
        assert not np.allclose(path.c2w[-1], path.c2w[0])


def test_focus_distance():
    """Converging axes give their crossing; parallel ones the distance of 90 % overlap."""
    np.testing.assert_allclose(focus_distance(CONTEXT), 4.0, rtol=1e-9)
    pair = Cameras(CONTEXT.K[:2], np.tile(CONTEXT.c2w[:1], (2, 1, 1)))
    pair.c2w[1, :3, 3] += 0.1 * pair.c2w[0, :3, 0]
    # Half the picture is 20 / 40 wide at distance 1; a shift of 0.1 is a tenth of 2 * 0.5 * d.
    np.testing.assert_allclose(focus_distance(pair), 0.1 / (0.1 * 2 * 0.5), rtol=1e-9)
    assert focus_distance(CONTEXT[0]) == 1.0
    outward = moved(CONTEXT)
    outward.c2w[:, :3, [0, 2]] *= -1  # looking away from the origin: axes cross behind
    assert focus_distance(outward) > 0
    odd = looking_at_origin(6)
    odd.c2w[0, :3, [0, 2]] *= -1  # only the start camera looks away from what the others share
    assert focus_distance(odd) > 0 and focus_distance(odd, 3) == pytest.approx(4.0, rel=1e-6)


def test_world_up():
    np.testing.assert_allclose(world_up(CONTEXT), [0, 0, 1], atol=1e-9)
    single = world_up(CONTEXT[0])
    np.testing.assert_allclose(single, -CONTEXT.c2w[0, :3, 1], atol=1e-12)
    for seed in range(6):  # an eigenvector has no sign of its own
        world = random_rigid(np.random.default_rng(seed))
        np.testing.assert_allclose(world_up(moved(CONTEXT, world)), world[:3, 2], atol=1e-9)


@few
@given(seeds)
def test_interpolation_meets_its_keys(seed):
    """Key times return the key cameras; equal steps of progress are equal steps of motion."""
    keys = random_cameras(np.random.default_rng(seed), 5)
    times = np.array([0.0, 1.0, 2.5, 3.0, 7.0])
    path = interpolate(keys, times / 7.0, times=times)
    np.testing.assert_allclose(path.c2w, keys.c2w, atol=1e-9)
    np.testing.assert_allclose(path.K, keys.K, atol=1e-9)
    even = interpolate(keys, np.linspace(0, 1, 400))
    np.testing.assert_allclose(even.c2w[[0, -1]], keys.c2w[[0, -1]], atol=1e-9)
    nearest = np.abs(even.c2w[:, None] - keys.c2w[None]).max((2, 3)).min(0)
    unit = np.linalg.norm(np.diff(keys.centres, axis=0), axis=-1).mean()
    moves = np.linalg.norm(np.diff(even.centres, axis=0), axis=-1) / unit
    relative = np.swapaxes(even.c2w[:-1, :3, :3], 1, 2) @ even.c2w[1:, :3, :3]
    turns = np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1))
    effort = moves + turns
    assert nearest.max() < 2 * effort.max() * max(1.0, unit)
    assert effort.max() < 1.1 * effort.mean()


def test_unevenly_spaced_keys_make_no_loops():
    """Keys at distances from 1 to 30: the path is on average less than 5 % longer than the straight
    connections (10 % if knots were spaced by distance instead of its root, 12 % if evenly)."""
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(60):
        steps = rng.normal(size=(5, 3))
        steps *= 10 ** rng.uniform(-1.5, 0.0, (5, 1)) / np.linalg.norm(steps, axis=1, keepdims=True)
        c2w = np.tile(np.eye(4), (6, 1, 1))
        c2w[1:, :3, 3] = np.cumsum(steps, 0)
        path = interpolate(Cameras(np.tile(np.eye(3), (6, 1, 1)), c2w), np.linspace(0, 1, 300))
        travelled = np.linalg.norm(np.diff(path.centres, axis=0), axis=1).sum()
        ratios.append(travelled / np.linalg.norm(steps, axis=1).sum())
    assert 1.0 <= np.mean(ratios) < 1.05


def test_interpolate_through_duplicates_and_one_view():
    keys = looking_at_origin(3)[[0, 0, 1, 2, 2]]
    path = interpolate(keys, np.linspace(0, 1, 9))
    np.testing.assert_allclose(path.c2w[[0, 4, 8]], keys.c2w[[0, 2, 3]], atol=1e-6)
    still = make_path("interpolate", CONTEXT[0], 4)
    np.testing.assert_array_equal(still.c2w, np.repeat(CONTEXT.c2w[:1], 4, 0))


@pytest.mark.parametrize("order", ["given", "shortest"])
def test_interpolate_begins_at_the_start(order):
    path = make_path("interpolate", CONTEXT, 400, order=order, start=2)
    np.testing.assert_allclose(path.c2w[0], CONTEXT.c2w[2], atol=1e-9)
    met = [np.abs(path.c2w - pose).max((1, 2)).min() < 0.05 for pose in CONTEXT.c2w]
    assert all(met)


def test_shortest_order():
    """Shuffled views of an arc are visited along the arc."""
    shuffled = CONTEXT[[2, 0, 4, 1, 3]]
    path = make_path("interpolate", shuffled, 40, order="shortest")
    ends = {tuple(np.round(path.c2w[i, :3, 3], 6)) for i in (0, -1)}
    assert ends == {tuple(np.round(CONTEXT.c2w[i, :3, 3], 6)) for i in (0, 4)}


def test_ease_starts_gently():
    plain, eased = (make_path("move-left", CONTEXT, 21, ease=ease) for ease in (False, True))
    np.testing.assert_allclose(eased.c2w[[0, 10, -1]], plain.c2w[[0, 10, -1]], atol=1e-9)
    steps = [np.linalg.norm(p.centres[1] - p.centres[0]) for p in (plain, eased)]
    assert steps[1] < 0.2 * steps[0]


def test_mistakes_are_named():
    with pytest.raises(UserError, match="did you mean 'spiral'"):
        make_path("spirall", CONTEXT, 5)
    with pytest.raises(UserError, match="no option 'degres': did you mean 'degrees'"):
        make_path("orbit", CONTEXT, 5, degres=3)
    with pytest.raises(UserError, match="start=7"):
        make_path("orbit", CONTEXT, 5, start=7)
    with pytest.raises(UserError, match="focus=-1"):
        make_path("orbit", CONTEXT, 5, focus=-1)
    with pytest.raises(UserError, match="0 frames"):
        make_path("orbit", CONTEXT, 0)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("orbit", {"degrees": "wide"}, "'degrees' is 'wide': give a number"),
        ("orbit", {"degrees": float("nan")}, "'degrees' is nan: give a number from"),
        ("orbit", {"degrees": None}, "'degrees' is None"),
        ("orbit", {"swing": "maybe"}, "'swing' is 'maybe': give true or false"),
        ("orbit", {"ease": "no"}, "'ease' is 'no': give true or false"),
        ("orbit", {"focus": "far"}, "'focus' is 'far': give a number"),
        ("orbit", {"focus": 1e300}, "focus=1e\\+300 is no distance"),
        ("orbit", {"start": 0.5}, "'start' is 0.5: give a whole number"),
        ("orbit", {"frames": 2.5}, "'frames' is 2.5: give a whole number"),
        ("spiral", {"radius": [1]}, "'radius' is \\[1\\]: give a number"),
        ("dolly-in", {"distance": 1e9}, "give a number from -1e\\+06 to 1e\\+06"),
        ("zoom-in", {"factor": 0}, "factor=0 is no zoom"),
        ("zoom-out", {"factor": 0}, "factor=0 is no zoom"),
        ("zoom-out", {"factor": -1}, "is no zoom: give 0.01 to 100"),
        ("interpolate", {"order": 3}, "order='3'"),
        (["orbit"], {}, "There is no trajectory"),
        ("ORBIT", {}, "did you mean 'orbit'"),
    ],
)
def test_options_of_the_wrong_kind_are_named(name, options, message):
    with pytest.raises(UserError, match=message):
        make_path(name, CONTEXT, **({"frames": 5} | options))


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ("motorcycle", "context cameras are given as str: give roge_jax.Cameras"),
        (Cameras(np.eye(3), np.eye(4)), r"K of shape \(3, 3\)"),
        (Cameras(CONTEXT.K[:1], CONTEXT.c2w), r"K of shape \(1, 3, 3\) and c2w of shape"),
        (Cameras(CONTEXT.K, CONTEXT.c2w[:, :3]), r"c2w of shape \(., 3, 4\)"),
        (Cameras(CONTEXT.K, CONTEXT.c2w * np.nan), "context view 0 has NaN"),
        (Cameras([["a"]], CONTEXT.c2w), "no arrays of numbers"),
        (CONTEXT[[]], "no context views"),
    ],
)
def test_cameras_given_as_arrays_are_checked(cameras, message):
    with pytest.raises(UserError, match=message):
        make_path("orbit", cameras, 5)
    with pytest.raises(UserError, match=message):
        normalise(cameras, CONTEXT)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_path_file_round_trip(tmp_path, convention):
    path = random_cameras(np.random.default_rng(0), 4)
    save_path(tmp_path / "path.json", path, 24, 40, convention=convention)
    loaded = load_path(tmp_path / "path.json")
    np.testing.assert_allclose(loaded.c2w, path.c2w, atol=1e-12)
    np.testing.assert_allclose(loaded.K, path.K)
    resized = load_path(tmp_path / "path.json", height=48, width=80)
    np.testing.assert_allclose(resized.K[:, :2], 2 * path.K[:, :2])


def write(tmp_path, content) -> str:
    file = tmp_path / "p.json"
    file.write_text(json.dumps(content))
    return file


def test_key_frames_are_interpolated(tmp_path):
    poses = [pose.tolist() for pose in CONTEXT.c2w]
    keys = [{"pose": pose, "time": 2.0 * i} for i, pose in enumerate(poses)]
    content = {"convention": "opencv", "keyframes": keys, "fov": 60.0, **SIZE}
    path = load_path(write(tmp_path, content), frames=9)
    np.testing.assert_allclose(path.c2w[::2], CONTEXT.c2w, atol=1e-9)
    np.testing.assert_allclose(path.K[:, 1, 1], 12 / np.tan(np.radians(30)))
    for count in ("many", -1, 2.5):
        with pytest.raises(UserError, match=f"'count' is .*{count}.*: give a whole number"):
            load_path(write(tmp_path, content | {"count": count}))
    keys[1]["time"] = "soon"
    with pytest.raises(UserError, match="frame 1: 'time' is 'soon': give a number"):
        load_path(write(tmp_path, content))
    keys[1]["time"] = 2.0
    keys[2]["time"] = 0.5
    with pytest.raises(UserError, match="increasing"):
        load_path(write(tmp_path, content))


def test_nerfstudio_paths(tmp_path):
    """Both of nerfstudio's files: OpenGL axes, vertical field of view, K by name."""
    gl = opencv_to_opengl(CONTEXT.c2w)
    entries = [{"camera_to_world": p.ravel().tolist(), "fov": 90.0, "aspect": 1.6} for p in gl]
    content = {"camera_path": entries, "render_height": 24, "render_width": 40, "keyframes": []}
    path = load_path(write(tmp_path, content), frame="scene")
    np.testing.assert_allclose(path.c2w, CONTEXT.c2w, atol=1e-12)
    np.testing.assert_allclose(path.K[0], [[12, 0, 20], [0, 12, 12], [0, 0, 1]], atol=1e-9)
    frames = [{"transform_matrix": p.tolist()} for p in gl]
    content = {"fl_x": 40.0, "cx": 20.0, "cy": 12.0, "w": 40, "h": 24, "frames": frames}
    path = load_path(write(tmp_path, content))
    np.testing.assert_allclose(path.c2w, CONTEXT.c2w, atol=1e-12)
    np.testing.assert_allclose(path.K, CONTEXT.K)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"convention": None}, "no 'convention'"),
        ({"convention": "opengll"}, "did you mean 'opengl'"),
        ({"frames": []}, "no cameras"),
        ({"frames": [{"matrix": 1}]}, "frame 0: has no 'pose'"),
        ({"frames": [{"pose": [[1, 2], [3, 4]]}]}, "frame 0: 'pose' must be a 4x4"),
        ({"frames": [{"pose": np.zeros((4, 4)).tolist()}]}, "singular"),
        ({"frames": [{"pose": np.diag([1.0, 1, -1, 1]).tolist()}]}, "mirrored"),
        ({"fov": 190.0}, "fov 190"),
        ({"fov": None}, "no intrinsics"),
        ({"fov": "wide"}, "frame 0: 'fov' is 'wide': give a number"),
        ({"fov": None, "K": "wide"}, "frame 0: 'K' is 'wide': give a 3x3 matrix"),
        ({"fov": None, "K": [[1, 2, 3], [4]]}, "frame 0: 'K' is .*: give a 3x3 matrix"),
        ({"fov": None, "K": [[float("nan")] * 3] * 3}, r"K: entry \[0, 0\] is nan"),
        ({"fov": None, "fl_x": [1]}, r"'fl_x' is \[1\]: give a number"),
        ({"fov": None, "fl_x": 40, "cx": "middle"}, "'cx' is 'middle': give a number"),
        ({"fov": None, "fl_y": 40}, "has 'fl_y' alone"),
        ({"fov": None, "camera_angle_x": 50}, "0 to 3.14 radians"),
        ({"width": float("nan")}, "'width' is nan: give a whole number of at least 1"),
        ({"height": -24}, "'height' is -24: give a whole number"),
        ({"width": None}, "has 'height' alone"),
        ({"frames": [3]}, "frame 0: is no object with 'pose'"),
        ({"frames": [{"pose": np.eye(4).tolist()}, None]}, "frame 1: is no object"),
        ({"camera_path": [3]}, "frame 0: is no object with 'camera_to_world'"),
        ({"keyframes": [{"pose": np.eye(4).tolist()}]}, "both 'frames' and 'keyframes'"),
        ({"frames": [{"pose": [[1, 0, 0, 1e300], *np.eye(4)[1:].tolist()]}]}, "1e\\+300"),
    ],
)
def test_path_file_mistakes(tmp_path, change, message):
    content = {"convention": "opencv", "fov": 60.0, "frames": [{"pose": np.eye(4).tolist()}]}
    content = {k: v for k, v in (content | SIZE | change).items() if v is not None}
    with pytest.raises(UserError, match=message):
        load_path(write(tmp_path, content))


def test_path_files_are_not_resampled(tmp_path):
    content = {"convention": "opencv", "fov": 60.0, "frames": [{"pose": np.eye(4).tolist()}] * 3}
    with pytest.raises(UserError, match="has 3 frames but 5 were asked for"):
        load_path(write(tmp_path, content | SIZE), frames=5)
    with pytest.raises(UserError, match="needs the picture size"):
        load_path(write(tmp_path, content))
    for damage in (b"{", b"[" * 100000):
        (tmp_path / "p.json").write_bytes(damage)
        with pytest.raises(UserError, match="not valid JSON"):
            load_path(tmp_path / "p.json")
    marked = json.dumps(content | SIZE).replace(", ", ",\r\n").encode("utf-8-sig")
    (tmp_path / "p.json").write_bytes(marked)
    assert len(load_path(tmp_path / "p.json")) == 3
    with pytest.raises(UserError, match="cannot read"):
        load_path(tmp_path / "none.json")


def test_intrinsics_of_the_context_are_the_default(tmp_path):
    file = write(tmp_path, {"convention": "opencv", "frames": [{"pose": np.eye(4).tolist()}]})
    path = load_path(file, context=CONTEXT, **SIZE)
    np.testing.assert_array_equal(path.K[0], CONTEXT.K[0])
