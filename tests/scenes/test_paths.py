"""Camera paths of other programs: built by their published rules with known answers, read, and written back."""

import json
import warnings
from pathlib import Path

import layout_files as more
import numpy as np
import pytest
import scene_files as files
from camera_cases import looking_at_origin
from scene_files import HEIGHT, WIDTH, truth

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras, CameraWarning, invert, opencv_to_opengl, quaternion
from roge_jax.scenes.paths import load_path, read_path, save_path
from roge_jax.scenes.scene import load_scene

CAMERAS = truth()
SIZE = {"height": HEIGHT, "width": WIDTH}
TURN = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
SHIFT, SCALE = np.array([0.1, 0.2, 0.3]), 0.5


def write(file: Path, content) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))
    return file


# ---- nerfstudio's viewer --------------------------------------------------------------------------


def viewed(cameras: Cameras) -> np.ndarray:
    """The same cameras as the viewer of a training run has them: s T p with T = [TURN | TURN SHIFT], OpenGL axes."""
    gl = opencv_to_opengl(cameras.c2w)
    moved = gl.copy()
    moved[:, :3, :3] = TURN @ gl[:, :3, :3]
    moved[:, :3, 3] = SCALE * (gl[:, :3, 3] + SHIFT) @ TURN.T
    return moved


def transform() -> dict:
    return {"transform": np.hstack([TURN, (TURN @ SHIFT)[:, None]]).tolist(), "scale": SCALE}


def viewer_path(cameras: Cameras, **more) -> dict:
    """A path as the viewer exports it; fov from K, so K comes back."""
    fov = np.degrees(2 * np.arctan(0.5 * HEIGHT / cameras.K[:, 1, 1]))
    entries = [
        {"camera_to_world": pose.ravel().tolist(), "fov": float(f), "aspect": WIDTH / HEIGHT}
        for pose, f in zip(viewed(cameras), fov, strict=True)
    ]
    return {
        "camera_type": "perspective",
        "render_height": float(HEIGHT),
        "render_width": float(WIDTH),
        "fps": 24,
        "seconds": 4,
        "is_cycle": False,
        "smoothness_value": 0.5,
        "keyframes": [],
        "camera_path": entries,
    } | more


PLACES = {
    "beside the path": lambda f: f / "scene" / "camera_paths",
    "in the scene": lambda f: f / "scene",
    "in nerfstudio's outputs": lambda f: f / "outputs" / "scene" / "nerfacto" / "2024-01-01_000000",
    "in outputs of the data's folder": lambda f: f / "scene" / "outputs" / "scene" / "m" / "t",
}


@pytest.mark.parametrize("where", PLACES)
def test_the_viewers_frame_is_found(tmp_path, where):
    scene = files.nerfstudio(tmp_path / "scene", CAMERAS)
    write(PLACES[where](tmp_path) / "dataparser_transforms.json", transform())
    file = write(scene / "camera_paths" / "p.json", viewer_path(CAMERAS))
    path = read_path(file, context=CAMERAS, scene=scene, **SIZE)
    np.testing.assert_allclose(path.cameras.c2w, CAMERAS.c2w, atol=1e-9)
    np.testing.assert_allclose(path.cameras.K[:, 1, 1], CAMERAS.K[:, 1, 1])
    assert path.fps == 24


def test_the_viewers_frame_is_asked_for(tmp_path):
    scene = files.nerfstudio(tmp_path / "scene", CAMERAS)
    file = write(tmp_path / "p.json", viewer_path(CAMERAS))
    with pytest.raises(
        UserError, match=r"normalised frame, and no dataparser_transforms.json .* give --path-frame"
    ):
        load_path(file, context=CAMERAS, scene=scene)
    with pytest.warns(CameraWarning, match="the cameras stay in that frame"):
        load_path(file)
    known = write(tmp_path / "elsewhere" / "run.json", transform())
    for frame in (known, str(known)):
        path = load_path(file, context=CAMERAS, scene=scene, frame=frame)
        np.testing.assert_allclose(path.c2w, CAMERAS.c2w, atol=1e-9)
    left = load_path(file, context=CAMERAS, scene=scene, frame="scene")
    np.testing.assert_allclose(left.centres, viewed(CAMERAS)[:, :3, 3], atol=1e-9)


def test_two_runs_that_differ_are_a_question(tmp_path):
    scene = files.nerfstudio(tmp_path / "scene", CAMERAS)
    runs = tmp_path / "outputs" / "scene" / "nerfacto"
    write(runs / "1" / "dataparser_transforms.json", transform())
    write(runs / "2" / "dataparser_transforms.json", transform())
    file = write(tmp_path / "scene" / "camera_paths" / "p.json", viewer_path(CAMERAS))
    np.testing.assert_allclose(load_path(file, scene=scene).c2w, CAMERAS.c2w, atol=1e-9)
    write(runs / "2" / "dataparser_transforms.json", transform() | {"scale": 0.3})
    with pytest.raises(UserError, match=r"2 training runs .* differ: name one with --path-frame"):
        load_path(file, scene=scene)


@pytest.mark.parametrize("layout", ["nerfstudio", "colmap"])
def test_applied_transform_and_scale(tmp_path, layout):
    """T and s start from the frame before A and a: a point p of it lies at a A p in transforms.json, at s T p in the viewer."""
    A, a = np.eye(4), 2.0
    A[:3] = np.array([[1.0, 0, 0, 0.2], [0, 0, 1, 0.1], [0, -1, 0, 0.3]])
    after = CAMERAS.c2w.copy()
    after[:, :3, :3] = A[:3, :3] @ CAMERAS.c2w[:, :3, :3]
    after[:, :3, 3] = a * (CAMERAS.centres @ A[:3, :3].T + A[:3, 3])
    # The parser's own T', s' act on the frame after; stored are T' A and s' a, as its source has it.
    stored = {
        "transform": (np.hstack([TURN, (TURN @ SHIFT)[:, None]]) @ A).tolist(),
        "scale": SCALE * a,
    }
    file = write(tmp_path / "p.json", viewer_path(Cameras(CAMERAS.K, after)))
    frame = write(tmp_path / "run.json", stored)
    if layout == "nerfstudio":
        scene = files.nerfstudio(tmp_path / "scene", Cameras(CAMERAS.K, after), applied_transform=A[:3].tolist(), applied_scale=a)  # fmt: skip
        expected = after
    else:
        # Without transforms.json nobody says a; with a = 1 it is not needed.
        scene, expected = files.colmap(tmp_path / "scene", CAMERAS, binary=True), CAMERAS.c2w
        moved = after.copy()
        moved[:, :3, 3] /= a
        write(file, viewer_path(Cameras(CAMERAS.K, moved)))
        write(frame, stored | {"scale": SCALE})
    path = load_path(file, context=CAMERAS, scene=scene, frame=frame)
    np.testing.assert_allclose(path.c2w, expected, atol=1e-9)


@pytest.mark.parametrize("version", ["rows", "columns", "text by columns"])
def test_key_frames_alone(tmp_path, version):
    """A file that was saved and never rendered: matrices by columns (as text, too) in the first viewer, by rows now."""
    keys = []
    for pose in viewed(CAMERAS):
        values = (pose if version == "rows" else pose.T).ravel().tolist()
        keys.append({"matrix": json.dumps(values) if "text" in version else values, "fov": 60.0})
    content = {"keyframes": keys, "camera_type": "perspective", "fps": 10, "camera_path": []}
    content |= {"render_height": HEIGHT, "render_width": WIDTH, "default_transition_sec": 2.0}
    keys[1] |= {"override_transition_enabled": True, "override_transition_sec": 1.0}
    frame = write(tmp_path / "run.json", transform())
    path = read_path(write(tmp_path / "p.json", content), frame=frame)
    assert len(path.cameras) == 50 and path.fps == 10  # 1 + 2 + 2 seconds
    path = load_path(tmp_path / "p.json", frame=frame, frames=51)
    np.testing.assert_allclose(path.c2w[[0, 10, 30, 50]], CAMERAS.c2w, atol=1e-9)


def test_default_fov_of_key_frames(tmp_path):
    keys = [{"matrix": pose.ravel().tolist()} for pose in viewed(CAMERAS)]
    content = {"keyframes": keys, "default_fov": 90.0, **SIZE}
    path = load_path(write(tmp_path / "p.json", content), frame="scene", frames=4)
    np.testing.assert_allclose(path.K[:, 1, 1], HEIGHT / 2)


def test_fields_that_are_not_used_are_named(tmp_path):
    content = viewer_path(CAMERAS, crop={"crop_scale": [1, 1, 1]})
    content["camera_path"][0]["render_time"] = 0.5
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        load_path(write(tmp_path / "p.json", content), frame="scene")
    text = " ".join(str(one.message) for one in told)
    assert "crop" in text and "render_time" in text and len(told) == 2


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        ("scene", lambda c: c),
        ("first", lambda c: c),
        ("first:2", lambda c: c[:1] + 2 * (c - c[:1])),
        ((np.eye(4), 3.0), lambda c: 3 * c),
        ("1,0,0,1,0,1,0,2,0,0,1,3", lambda c: c + np.array([1, 2, 3])),
        ("1,0,0,1,0,1,0,2,0,0,1,3,2", lambda c: 2 * c + [1, 2, 3]),
        ("2,0,0,0,0,2,0,0,0,0,2,0,0,0,0,1", lambda c: 2 * c),
    ],
)
def test_given_frames(tmp_path, frame, expected):
    save_path(tmp_path / "p.json", CAMERAS, HEIGHT, WIDTH)
    path = load_path(tmp_path / "p.json", context=CAMERAS, frame=frame)
    np.testing.assert_allclose(path.centres, expected(CAMERAS.centres), atol=1e-9)
    np.testing.assert_allclose(path.c2w[:, :3, :3], CAMERAS.c2w[:, :3, :3], atol=1e-9)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ("nowhere.json", "there is no such file: give a dataparser_transforms.json"),
        ("1,2,3", "has 3 numbers: give a 4x4 or 3x4"),
        ("first:far", "'first:SCALE' is 'far'"),
        ((np.diag([1.0, 1, -1, 1]), 1.0), "singular, mirrored"),
    ],
)
def test_frames_that_are_none(tmp_path, frame, message):
    save_path(tmp_path / "p.json", CAMERAS, HEIGHT, WIDTH)
    with pytest.raises(UserError, match=message):
        load_path(tmp_path / "p.json", context=CAMERAS, frame=frame)


# ---- trajectories ---------------------------------------------------------------------------------


def tum_file(folder):
    (folder / "t.tum").write_text("\n".join(["# a comment", *more.tum_lines(CAMERAS)]))
    return folder / "t.tum"


def tum_with_commas(folder):
    (folder / "t.csv").write_text("\n".join(line.replace(" ", ",") for line in more.tum_lines(CAMERAS)))  # fmt: skip
    return folder / "t.csv"


def rows(folder, width):
    lines = [" ".join(map(repr, map(float, p.ravel()[:width]))) for p in CAMERAS.c2w]
    (folder / "k.txt").write_text("\n".join(lines))
    return folder / "k.txt"


def npz(folder, **fields):
    np.savez(folder / "a.npz", **fields)
    return folder / "a.npz"


def npy(folder, values):
    np.save(folder / "a.npy", values)
    return folder / "a.npy"


POSES = {
    "tum": tum_file,
    "tum with commas": tum_with_commas,
    "kitti": lambda f: rows(f, 12),
    "4x4": lambda f: rows(f, 16),
    "npz c2w": lambda f: npz(f, c2w=CAMERAS.c2w),
    "npz w2c": lambda f: npz(f, w2c_poses=invert(CAMERAS.c2w)),
    "npz extrinsics 3x4": lambda f: npz(f, extrinsics=invert(CAMERAS.c2w)[:, :3]),
    "npy": lambda f: npy(f, CAMERAS.c2w),
    "npy 3x4": lambda f: npy(f, CAMERAS.c2w[:, :3]),
    "neoverse": lambda f: npz(f, frame_matrices=CAMERAS.c2w, frame_indices=np.arange(4)),
}


@pytest.mark.parametrize("form", POSES)
def test_poses_without_intrinsics_take_the_photos(tmp_path, form):
    path = load_path(POSES[form](tmp_path), context=CAMERAS, **SIZE)
    np.testing.assert_allclose(path.c2w, CAMERAS.c2w, atol=1e-9)
    np.testing.assert_allclose(path.K, np.tile(CAMERAS.K[0], (4, 1, 1)))
    with pytest.raises(UserError, match="no intrinsics"):
        load_path(POSES[form](tmp_path))


def test_intrinsics_of_arrays(tmp_path):
    """In pixels of orig_wh; divided by width and height; as fx fy cx cy."""
    fields = {"c2w": CAMERAS.c2w, "intrinsics": CAMERAS.K, "orig_wh": np.array([WIDTH, HEIGHT])}
    path = load_path(npz(tmp_path, **fields), height=48, width=80)
    np.testing.assert_allclose(path.K[:, :2], 2 * CAMERAS.K[:, :2])
    four = CAMERAS.K[:, [0, 1, 0, 1], [0, 1, 2, 2]]
    path = load_path(npz(tmp_path, **(fields | {"intrinsics": four})))
    np.testing.assert_allclose(path.K, CAMERAS.K)
    npy(tmp_path, CAMERAS.c2w)
    square = more.one_K(CAMERAS, centred=True)
    np.save(tmp_path / "intrinsics.npy", square.K / [[[WIDTH], [HEIGHT], [1.0]]])
    path = load_path(tmp_path / "a.npy", height=48, width=80)
    np.testing.assert_allclose(path.K[:, :2], 2 * square.K[:, :2])


@pytest.mark.parametrize("inverse", [False, True])
def test_rows_of_seven_numbers(tmp_path, inverse):
    """tx ty tz qx qy qz qw: which way they go is told; SpatialVID's go the other way, with K divided by the size."""
    poses = invert(CAMERAS.c2w) if inverse else CAMERAS.c2w
    seven = np.hstack([poses[:, :3, 3], quaternion(poses[:, :3, :3])])
    square, file = more.one_K(CAMERAS, centred=True), tmp_path / "trajectory.npy"
    if inverse:
        file = tmp_path / "poses.npy"
        unit = square.K / [[[WIDTH], [HEIGHT], [1.0]]]
        np.save(tmp_path / "intrinsics.npy", unit[:, [0, 1, 0, 1], [0, 1, 2, 2]])
    np.save(file, seven)
    words = "world to camera, as SpatialVID's" if inverse else "are read as camera to world"
    with pytest.warns(CameraWarning, match=words):
        path = load_path(file, context=square, **SIZE)
    np.testing.assert_allclose(path.c2w, CAMERAS.c2w, atol=1e-9)
    np.testing.assert_allclose(path.K, square.K, rtol=2e-3)
    said = "opencv_w2c" if inverse else "opencv"
    np.testing.assert_allclose(load_path(file, context=square, convention=said).c2w, path.c2w)


@pytest.mark.parametrize("form", ["npz", "json", "json that names an npz"])
def test_neoverse_frames_by_number_are_joined(tmp_path, form):
    """Given at frames 0, 5, 10, 15: sixteen frames, the given ones as they are."""
    indices = [0, 5, 10, 15]
    file = npz(tmp_path, frame_matrices=CAMERAS.c2w, frame_indices=np.array(indices))
    if form == "json":
        given = {"frame_indices": indices, "frame_matrices": CAMERAS.c2w.tolist()}
        file = write(tmp_path / "p.json", {"num_frames": 16, "trajectory": given})
    elif form != "npz":
        given = {"file": "/somewhere/else/a.npz"}
        file = write(tmp_path / "p.json", {"num_frames": 16, "trajectory": given})
    path = load_path(file, context=CAMERAS, **SIZE)
    assert len(path) == 16
    np.testing.assert_allclose(path.c2w[::5], CAMERAS.c2w, atol=1e-9)
    np.testing.assert_allclose(path.centres[1], 0.8 * path.centres[0] + 0.2 * path.centres[5])


MOVES = {
    "pan_right": ({"angle": 90}, [0, 0, 0], [1, 0, 0]),
    "pan_left": ({"angle": 90}, [0, 0, 0], [-1, 0, 0]),
    "tilt_up": ({"angle": 90}, [0, 0, 0], [0, -1, 0]),
    "tilt_down": ({"angle": 90}, [0, 0, 0], [0, 1, 0]),
    "move_right": ({"distance": 2}, [2, 0, 0], [0, 0, 1]),
    "move_left": ({"distance": 2}, [-2, 0, 0], [0, 0, 1]),
    "boom_up": ({"distance": 2}, [0, -2, 0], [0, 0, 1]),
    "boom_down": ({"distance": 2}, [0, 2, 0], [0, 0, 1]),
    "push_in": ({}, [0, 0, 0.1], [0, 0, 1]),
    "pull_out": ({}, [0, 0, -0.1], [0, 0, 1]),
    "orbit_right": ({"angle": 90, "orbit_radius": 3}, [3, 0, 3], [-1, 0, 0]),
    "orbit_left": ({"angle": 90, "orbit_radius": 3}, [-3, 0, 3], [1, 0, 0]),
    "static": ({}, [0, 0, 0], [0, 0, 1]),
}


@pytest.mark.parametrize("move", MOVES)
def test_neoverses_named_moves(tmp_path, move):
    """Where each move ends, in the first camera's axes (x right, y down, z ahead), from the photo that leads."""
    options, place, looks = MOVES[move]
    keys = [{"0": [{"static": {}}]}, {"8": [{move: options}]}]
    file = write(tmp_path / "p.json", {"num_frames": 9, "keyframes": keys, "mode": "relative"})
    path = load_path(file, context=CAMERAS, **SIZE)
    assert len(path) == 9
    local = np.linalg.inv(CAMERAS.c2w[0]) @ path.c2w
    np.testing.assert_allclose(local[0], np.eye(4), atol=1e-9)
    np.testing.assert_allclose(local[8, :3, 3], place, atol=1e-9)
    np.testing.assert_allclose(local[8, :3, 2], looks, atol=1e-9)
    np.testing.assert_allclose(local[4, :3, 3], 0.5 * np.array(place), atol=1e-9)


def test_neoverses_mistakes_are_named(tmp_path):
    def load(**content):
        load_path(write(tmp_path / "p.json", {"num_frames": 5} | content), context=CAMERAS)

    with pytest.raises(UserError, match="there is no move 'pan_lefft': did you mean 'pan_left'"):
        load(keyframes=[{"0": [{"pan_lefft": {}}]}])
    with pytest.raises(UserError, match="frame numbers of 'keyframes' must increase"):
        load(keyframes=[{"4": [{"static": {}}]}, {"0": [{"static": {}}]}])
    with pytest.raises(UserError, match="'mode' is 'world'"):
        load(keyframes=[{"0": [{"static": {}}]}], mode="world")
    with pytest.raises(UserError, match="in the coordinates of the editor"):
        load(keyframes=[{"0": [{"static": {}}]}], mode="global")
    with pytest.warns(CameraWarning, match="'zoom_ratio' is not used"):
        load(keyframes=[{"0": [{"static": {}}]}], zoom_ratio=2.0)


def test_realestate10k_without_pictures_is_a_path(tmp_path):
    file = files.re10k(tmp_path, CAMERAS)
    expected = load_path(file, height=48, width=80)
    for photo in (tmp_path / "abc").iterdir():
        photo.unlink()
    square = more.one_K(CAMERAS, centred=True)
    files.re10k(tmp_path / "square", square)
    bare = tmp_path / "bare.txt"
    (tmp_path / "square" / "abc.txt").rename(bare)
    np.testing.assert_allclose(expected.c2w, load_path(file, height=48, width=80).c2w)
    path = load_path(bare, height=48, width=80)
    np.testing.assert_allclose(path.K[:, :2], 2 * square.K[:, :2], rtol=2e-3)


# ---- editors --------------------------------------------------------------------------------------


def test_key_frames_of_instant_ngp_and_gen3c(tmp_path):
    """R is x y z w of the camera (OpenCV axes), fov the vertical angle; the coordinates are the editor's own."""
    q = quaternion(CAMERAS.c2w[:, :3, :3])
    keys = [
        {"R": r.tolist(), "T": t.tolist(), "fov": 60.0, "timestamp": 1.0 + i}
        for i, (r, t) in enumerate(zip(q, CAMERAS.centres, strict=True))
    ]
    file = write(tmp_path / "base_cam.json", {"path": keys, "loop": False, "spline_order": 3})
    with pytest.raises(UserError, match="in the coordinates of the editor that wrote it"):
        load_path(file, context=CAMERAS, **SIZE)
    path = load_path(file, context=CAMERAS, frame="scene", frames=7, **SIZE)
    np.testing.assert_allclose(path.c2w[::2], CAMERAS.c2w, atol=1e-9)
    np.testing.assert_allclose(path.K[:, 1, 1], 0.5 * HEIGHT / np.tan(np.radians(30)))


def test_recammaster(tmp_path):
    """4x4 as text by columns, Unreal's axes (x forward, y right, z up, left-handed), centimetres: here 1 m to the right,
    2 m ahead, then turned to the right by 90 degrees."""
    still = "[1 0 0 0] [0 1 0 0] [0 0 1 0] [3390 1380 240 1] "
    right = "[1 0 0 0] [0 1 0 0] [0 0 1 0] [3390 1480 240 1] "
    ahead = "[1 0 0 0] [0 1 0 0] [0 0 1 0] [3590 1380 240 1] "
    turned = "[0 1 0 0] [-1 0 0 0] [0 0 1 0] [3390 1380 240 1] "
    texts = {f"frame{i}": {"cam01": t} for i, t in enumerate((still, right, ahead, turned))}
    path = load_path(write(tmp_path / "p.json", texts), context=looking_at_origin(1), **SIZE)
    start = looking_at_origin(1).c2w[0]
    local = np.linalg.inv(start) @ path.c2w
    np.testing.assert_allclose(local[:3, :3, 3], [[0, 0, 0], [1, 0, 0], [0, 0, 2]], atol=1e-9)
    np.testing.assert_allclose(local[3, :3, 2], [1, 0, 0], atol=1e-9)  # looks to the right
    texts["frame0"]["cam02"] = still
    with pytest.warns(CameraWarning, match="the first of 2 cameras is read, cam01"):
        load_path(write(tmp_path / "p.json", texts), context=CAMERAS)


def test_forms_that_are_not_known_are_listed(tmp_path):
    for content in ([], 3, [[1, 2]]):
        with pytest.raises(UserError, match=r"nerfstudio's camera path or transforms\.json, GEN3C"):
            load_path(write(tmp_path / "p.json", content))
    with pytest.raises(UserError, match="has no poses: needs 'c2w' or 'w2c_poses'"):
        load_path(npz(tmp_path, depth=np.zeros(3)))
    (tmp_path / "broken.npz").write_bytes(b"PK\3\4nothing")
    with pytest.raises(UserError, match="damaged npz"):
        load_path(tmp_path / "broken.npz")
    (tmp_path / "t.txt").write_text("1 2 3 4 0 0 0 0\n")
    with pytest.raises(UserError, match="the quaternion at time 1 has length 0"):
        load_path(tmp_path / "t.txt")
    with pytest.raises(UserError, match="'fps' is -1: give a number"):
        load_path(write(tmp_path / "p.json", viewer_path(CAMERAS, fps=-1)), frame="scene")


# ---- written --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "layout", ["nerfstudio", "realestate10k", "tum", "colmap", "colmap-binary"]
)
def test_written_files_are_read_back(tmp_path, layout):
    place = tmp_path / {"nerfstudio": "t.json", "realestate10k": "t.txt", "tum": "t.tum"}.get(layout, "model")  # fmt: skip
    save_path(place, CAMERAS, HEIGHT, WIDTH, layout=layout, fps=10)
    path = load_path(place, context=CAMERAS, **SIZE)
    np.testing.assert_allclose(path.c2w, CAMERAS.c2w, atol=1e-9)
    expected = more.one_K(CAMERAS).K if layout == "tum" else CAMERAS.K
    if layout == "realestate10k":  # it does not say the size: a picture of square pixels is drawn
        lines = [line.split() for line in place.read_text().splitlines()[1:]]
        inner = np.array(lines, float)[:, 1:5] * [WIDTH, HEIGHT, WIDTH, HEIGHT]
        np.testing.assert_allclose(inner, CAMERAS.K[:, [0, 1, 0, 1], [0, 1, 2, 2]])
        assert [line[0] for line in lines] == ["0", "100000", "200000", "300000"]
    else:
        np.testing.assert_allclose(path.K, expected)
    with pytest.raises(UserError, match="did you mean 'colmap'"):
        save_path(place, CAMERAS, HEIGHT, WIDTH, layout="colmapp")
    skewed = Cameras(CAMERAS.K + 0.1 * np.eye(3, k=1), CAMERAS.c2w)
    if layout != "tum":
        with pytest.raises(UserError, match="no place for the skew"):
            save_path(place, skewed, HEIGHT, WIDTH, layout=layout)


@pytest.mark.parametrize("layout", ["colmap", "colmap-binary"])
def test_pycolmap_reads_what_is_written(tmp_path, layout):
    pycolmap = pytest.importorskip("pycolmap")
    names = ["a/0.png", "a/1.png", "b c.png", "d.png"]
    if layout == "colmap":  # its own reader ends a name at a blank
        with pytest.raises(UserError, match="cannot hold names with blanks"):
            save_path(tmp_path / "m", CAMERAS, HEIGHT, WIDTH, layout=layout, names=names)
        names[2] = "b.png"
    save_path(tmp_path / "m", CAMERAS, HEIGHT, WIDTH, layout=layout, names=names)
    model = pycolmap.Reconstruction(str(tmp_path / "m"))
    assert model.num_images() == 4
    for image in model.images.values():
        view = names.index(image.name)
        w2c = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(w2c, invert(CAMERAS.c2w)[view], atol=1e-9)
        np.testing.assert_allclose(
            model.cameras[image.camera_id].calibration_matrix(), CAMERAS.K[view]
        )


def test_written_nerfstudio_files_are_scenes(tmp_path):
    files.nerfstudio(tmp_path, CAMERAS)
    names = [f"images/{i:04d}.png" for i in range(4)]
    save_path(
        tmp_path / "transforms.json", CAMERAS, HEIGHT, WIDTH, layout="nerfstudio", names=names
    )
    np.testing.assert_allclose(load_scene(tmp_path).cameras.K, CAMERAS.K)


def test_a_path_without_photos_is_scaled_exactly(tmp_path):
    """80x60 to 112x64 cuts 14.29 rows: square pixels stay square, no picture is there to be cut at whole ones."""
    K = np.array([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]])
    save_path(tmp_path / "p.json", Cameras(np.tile(K, (4, 1, 1)), CAMERAS.c2w), 60, 80)
    path = load_path(tmp_path / "p.json", height=64, width=112)
    np.testing.assert_allclose(path.K, [[[98, 0, 56], [0, 98, 32], [0, 0, 1]]] * 4)
