"""Wrong poses, wrong focal lengths and JPEG are seen in the photos of a scene, said once, and do not stop a run; other axes do."""

import dataclasses
import json
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
import scene_files as files
from test_robustness import without_network

from experiments.stability import matching as measured
from roge_jax import checkpoint, model, sample
from roge_jax.config import preset
from roge_jax.core.params import abstract
from roge_jax.data import faults
from roge_jax.errors import LimitWarning, UserError
from roge_jax.files import entry
from roge_jax.geometry.cameras import Cameras, crop_resize_K, invert, opencv_to_opengl, scale_focal
from roge_jax.sampling import limits, programs, scene_limits
from roge_jax.scenes import matching
from roge_jax.scenes.images import jpeg_quality
from roge_jax.scenes.scene import Scene, load_scene

HEIGHT, WIDTH, SIZE = 160, 240, (32, 48)  # of the photos, of the pictures of `tiny`
CONFIG = preset("tiny")
ROWS = {
    "poses": {"limit": 0.04, "broke": True},
    "focal": {"limit": 0.6, "broke": True, "moved": True, "gain": 1.3},
    "jpeg": {"limit": 70.0, "broke": True, "by_shrink": [[1, 70.0], [2, 30.0], [4, 0.0]]},
}


def around() -> Cameras:
    """Five cameras around the origin, at different distances and heights, K in pixels of the photos."""
    c2w = np.tile(np.eye(4), (5, 1, 1))
    angles, reach, up = (-0.45, -0.25, 0, 0.25, 0.45), (4, 3.4, 4.2, 3.5, 4.1), (3, -4, 5, -3, 4)
    for pose, angle, r, y in zip(c2w, angles, reach, up, strict=True):
        centre = np.array([r * np.sin(angle), 0.1 * y, -r * np.cos(angle)])
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], 1), centre
    K = np.array([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1.0]])
    return Cameras(np.tile(K, (5, 1, 1)), c2w)


def pictures(cameras: Cameras) -> list[np.ndarray]:
    """What the cameras see of two textured squares at different depths, float32 [HEIGHT, WIDTH, 3]."""
    rng = np.random.default_rng(0)
    noise = rng.uniform(size=(2, 500, 500, 3)).astype(np.float32)
    textures = [np.clip(3 * cv2.GaussianBlur(x, (0, 0), 1.5) - 1, 0, 1) for x in noise]
    centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts pixel centres
    found = []
    for K, w2c in zip(cameras.K, invert(cameras.c2w), strict=True):
        image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
        for texture, half, z in zip(textures, (4.0, 0.8), (1.2, -0.4), strict=True):
            plane = np.array([[half / 250, 0, -half], [0, half / 250, -half], [0, 0, 1]])
            seen = K @ np.stack([w2c[:3, 0], w2c[:3, 1], z * w2c[:3, 2] + w2c[:3, 3]], 1) @ plane
            seen = np.linalg.inv(centre) @ seen @ centre
            here = cv2.warpPerspective(np.ones((500, 500), np.float32), seen, (WIDTH, HEIGHT))
            image *= 1 - here[..., None]
            image += here[..., None] * cv2.warpPerspective(texture, seen, (WIDTH, HEIGHT))
        found.append(image)
    return found


@pytest.fixture(scope="module")
def scene() -> Scene:
    cameras = around()
    return Scene(pictures(cameras), cameras, tuple("abcde"), "made/up")


@pytest.fixture(scope="module")
def matches(scene):
    """Of photos 1, 2 and 3 with their partners."""
    return matching.photo_matches(scene.images, scene.cameras, [1, 2, 3], *SIZE)


def small(cameras: Cameras) -> Cameras:
    return Cameras(crop_resize_K(cameras.K, (HEIGHT, WIDTH), SIZE), cameras.c2w)


def judged(scene, matches, cameras, rows=ROWS):
    return scene_limits.about_cameras(matches, small(cameras), [1, 2, 3], scene, SIZE, rows)


# Matching.


def test_matches_are_in_pixels_of_the_models_pictures(scene, matches):
    """True poses fit to a hundredth of a pixel, and what the crop cuts away is left out."""
    assert {view for pair in matches for view in pair} >= {1, 2, 3}
    cameras = small(scene.cameras)
    distances = matching.misfits(matches, cameras)
    assert max(distances.values()) < 0.02
    assert matching.focal_error(matches, cameras)[0] == 0.0
    flat = matching.photo_matches(scene.images, scene.cameras, [1, 2, 3], 8, 48)
    for pair in flat:
        for x in flat[pair]:
            assert (x > 0).all() and (x < (48, 8)).all()
    K = crop_resize_K(scene.cameras.K, (HEIGHT, WIDTH), (8, 48))
    distances = matching.misfits(flat, Cameras(K, scene.cameras.c2w))
    assert max(distances.values()) < 0.02


def test_a_photo_counts_by_the_partner_that_it_fits_best():
    distances = {(0, 1): 3.0, (1, 2): 0.1, (0, 4): 2.0}
    found = matching.photo_misfits(distances, [0, 1, 3])
    np.testing.assert_array_equal(found, [2.0, 0.1, np.nan])


def test_partners_look_alike_and_stand_apart():
    cameras = around()
    c2w = np.concatenate([cameras.c2w, cameras.c2w[2:3], cameras.c2w[2:3]])
    c2w[6, :3, :3] = c2w[6, :3, :3] @ np.diag([-1.0, 1.0, -1.0])  # looks away
    c2w[6, 0, 3] += 0.5
    pairs = matching.partners(Cameras(np.tile(np.eye(3), (7, 1, 1)), c2w), [2], 6)
    assert pairs == [(0, 2), (1, 2), (2, 3), (2, 4)]  # neither its twin nor the one that looks away
    assert len(matching.partners(Cameras(np.tile(np.eye(3), (7, 1, 1)), c2w), [2], 2)) == 2


@pytest.mark.parametrize("factor", [1.02, 1 / 1.02])
def test_wrong_focal_lengths_are_measured(scene, matches, factor):
    wrong = scale_focal(small(scene.cameras), factor)
    error, gain = matching.focal_error(matches, wrong)
    assert gain > 1.4
    assert np.log1p(error) * np.log(factor) < 0  # the cure goes the other way
    assert 0.006 < abs(error) <= 0.021


def test_cameras_that_do_not_turn_contradict_no_focal_length():
    c2w = np.tile(np.eye(4), (3, 1, 1))
    c2w[:, 0, 3] = [0.0, 0.2, 0.4]
    cameras = small(Cameras(around().K[:3], c2w))
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (200, 3))
    seen = [(points - pose[:3, 3]) @ K.T for pose, K in zip(c2w, cameras.K, strict=True)]
    seen = [x[:, :2] / x[:, 2:] for x in seen]
    noise = np.random.default_rng(1).normal(0, 0.02, (3, 200, 2))
    x = [a + b for a, b in zip(seen, noise, strict=True)]
    matches = {(0, 1): (x[0], x[1]), (1, 2): (x[1], x[2])}
    error, gain = matching.focal_error(matches, scale_focal(cameras, 1.3))
    assert error == 0.0 and gain < 1.1


# Warnings.


def test_nothing_is_said_of_good_cameras(scene, matches):
    assert judged(scene, matches, scene.cameras) == []
    assert judged(scene, {}, scale_focal(scene.cameras, 2.0)) == []  # nothing matched


def test_the_photo_with_the_wrong_pose_is_named(scene, matches):
    cameras = scene.cameras
    turned = faults.turn_cameras(cameras[3], 2.0, np.random.default_rng(1))
    wrong = Cameras(cameras.K, np.concatenate([cameras.c2w[:3], turned.c2w, cameras.c2w[4:]]))
    (one,) = judged(scene, matches, wrong)
    assert one.kind == "poses" and one.value > one.limit == 0.04
    for part in ("photo 3 (d)", "32x48", "beyond 0.04", "python -m roge_jax.check made/up"):
        assert part in one.message, one.message
    looser = ROWS | {"poses": {"limit": 1.01 * one.value, "broke": True}}
    assert judged(scene, matches, wrong, looser) == []


def test_all_wrong_poses_are_counted(scene, matches):
    wrong = faults.turn_cameras(scene.cameras, 5.0, np.random.default_rng(0))
    (one,) = judged(scene, matches, wrong)
    assert one.kind == "poses" and "(3 photos lie beyond the limit)" in one.message


@pytest.mark.parametrize(("factor", "word"), [(1.02, "shorter"), (1 / 1.02, "longer")])
def test_a_focal_length_that_explains_it_is_named(scene, matches, factor, word):
    (one,) = judged(scene, matches, scale_focal(scene.cameras, factor))
    assert one.kind == "focal" and word in one.message and "python -m roge_jax.check" in one.message
    assert one.value > one.limit == 0.6 and "1 dB or more" in one.message  # the limit was moved
    wrong = scale_focal(scene.cameras, factor)
    for change in ({"limit": 1.01 * one.value}, {"gain": 9.0}):
        assert judged(scene, matches, wrong, ROWS | {"focal": ROWS["focal"] | change}) == []
    tight = ROWS | {
        "poses": {"limit": 1e-3, "broke": True}
    }  # what is left is no matter of focal lengths
    assert [x.kind for x in judged(scene, matches, wrong, tight)] == ["poses"]


class Damaged(list):
    """Photos of which number 0 cannot be read."""

    def __getitem__(self, view):
        if view == 0:
            raise UserError("damaged")
        return super().__getitem__(view)


def test_photos_that_cannot_be_matched_say_nothing(scene):
    wrong = faults.turn_cameras(scene.cameras, 5.0, np.random.default_rng(0))
    rows = {"poses": ROWS["poses"], "focal": ROWS["focal"]}

    def found(images, cameras=wrong):
        made = dataclasses.replace(scene, images=images, cameras=cameras)
        return scene_limits.beyond(made, [1, 2], CONFIG, rows)

    assert len(found(scene.images)) == 1
    assert found([np.zeros_like(x) for x in scene.images]) == []
    few = [cv2.GaussianBlur(x, (0, 0), 12.0) for x in scene.images]
    assert found(few) == []
    tripod = wrong.c2w.copy()
    tripod[:, :3, 3] = tripod[0, :3, 3]
    assert found(scene.images, Cameras(wrong.K, tripod)) == []
    rejected = Damaged(scene.images)
    matches = matching.photo_matches(rejected, scene.cameras, [1, 2], *SIZE)
    assert matches and not any(0 in pair for pair in matches)
    assert scene_limits.beyond(scene, [1, 2], CONFIG) == []  # no limits were measured for `tiny`


# JPEG.


@pytest.mark.parametrize("quality", [1, 10, 49, 50, 71, 92, 100])
def test_quality_is_read_back(tmp_path, quality):
    files.save(tmp_path / "a.jpg", files.picture(0), quality=quality)
    files.save(tmp_path / "a.png", files.picture(0))
    assert jpeg_quality(tmp_path / "a.jpg") == quality
    assert jpeg_quality(tmp_path / "a.png") is None


def write(folder: Path, scene: Scene, cameras: Cameras, names: dict[int, str] | None = None):
    """The scene on disk; `names` maps views to JPEG qualities, the others are PNG."""
    frames = []
    for view, (K, pose) in enumerate(zip(cameras.K, opencv_to_opengl(cameras.c2w), strict=True)):
        quality = (names or {}).get(view)
        name = f"images/{view}.{'png' if quality is None else 'jpg'}"
        pixels = np.rint(255 * scene.images[view]).astype(np.uint8)
        files.save(folder / name, pixels, **({} if quality is None else {"quality": quality}))
        entry = {"file_path": name, "transform_matrix": pose.tolist()}
        frames.append(entry | files.intrinsic_fields(K))
    content = {"camera_model": "PINHOLE", "w": WIDTH, "h": HEIGHT, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_strong_jpeg_is_said_where_the_photo_is_small(tmp_path, scene):
    folder = write(tmp_path, scene, scene.cameras, {1: 20, 2: 10, 3: 60})
    read = load_scene(folder)

    def found(height, ids=(0, 1, 2, 3)):
        config = dataclasses.replace(
            CONFIG, height=height, width=240, recon_height=height, recon_width=240
        )
        return scene_limits.beyond(read, ids, config, {"jpeg": ROWS["jpeg"]})

    (one,) = found(160)
    assert (one.kind, one.value, one.limit) == ("jpeg", 10, 70)
    for part in ("photo 2 (2.jpg)", "quality 10", "below 70", "use the photo as it was"):
        assert part in one.message, one.message
    assert found(160, (0,)) == []  # PNG
    (one,) = found(160, (3,))
    assert one.value == 60
    half = dataclasses.replace(CONFIG, height=80, width=128, recon_height=80, recon_width=128)
    row = {"jpeg": ROWS["jpeg"]}
    assert [x.value for x in scene_limits.beyond(read, (1, 3), half, row)] == [20]  # needs 34
    assert scene_limits.beyond(read, (3,), half, row) == []
    assert scene_limits.beyond(read, (0, 1, 2, 3), CONFIG, row) == []  # 5 times as large
    assert scene_limits.beyond(scene, (0, 1), CONFIG, row) == []  # arrays, no files


# The program.


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights") / "model"
    params = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), abstract(model.specs(CONFIG)))
    checkpoint.save_model(folder, params, CONFIG)
    return folder


@pytest.fixture
def program(weights, tmp_path, monkeypatch, capsys):
    """Runs `sample` on a scene folder; what it said of matching and what run.json has."""
    monkeypatch.setattr(programs, "for_window", without_network)
    monkeypatch.setattr(limits, "table", lambda name: ROWS if name == "tiny" else {})

    def run(folder, *more):
        words = ["--checkpoint", weights, "--scene", folder, "--steps", 1, *more]
        words += ["--frames", 3, "--context", "1,2,3", "--out", tmp_path / "out"]
        if code := entry.execute(sample.main, sample.parser(), [str(w) for w in words]):
            return code, capsys.readouterr().err
        record = json.loads((tmp_path / "out" / "run.json").read_text())
        assert record["stages"]["match"]["seconds"] >= 0
        said = [x for x in capsys.readouterr().err.splitlines() if x.startswith("warning: ")]
        return record["warnings"], said

    return run


def test_the_program_says_once_that_a_focal_length_is_wrong(tmp_path, program, scene):
    good = write(tmp_path / "good", scene, scene.cameras)
    assert program(good) == ([], [])
    bad = write(tmp_path / "bad", scene, scale_focal(scene.cameras, 1.02), {3: 60})
    record, said = program(bad)
    assert [one["kind"] for one in record] == ["focal"]
    assert said == [f"warning: {record[0]['message']}"] and str(bad) in said[0]


@pytest.mark.parametrize("axes", ["opencv", "opencv_w2c", "opengl_w2c"])
def test_the_program_refuses_other_axes_and_names_them(tmp_path, program, scene, axes):
    bad = write(tmp_path / "bad", scene, scene.cameras)
    file = bad / "transforms.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        c2w = np.array(frame["transform_matrix"])
        c2w = c2w @ np.diag([1.0, -1.0, -1.0, 1.0]) if axes.startswith("opencv") else c2w
        frame["transform_matrix"] = (np.linalg.inv(c2w) if "w2c" in axes else c2w).tolist()
    file.write_text(json.dumps(content))
    code, said = program(bad)
    assert code == 2
    assert f"error: {bad}: its poses are not 'opengl'" in said
    assert f"give --convention {axes} (or --convention opengl to keep them)" in said
    assert not list(tmp_path.glob("out*"))
    assert program(bad, "--convention", axes) == ([], [])
    record, said = program(bad, "--convention", "opengl")  # insists
    assert [one["kind"] for one in record] == ["axes"] and "its poses are not 'opengl'" in said[-1]


def test_poses_that_other_axes_explain_no_better_are_not_called_so(scene, matches):
    """A turned camera is a wrong pose, under any axes; and poses within the limit are right."""
    turned = scene.cameras.c2w.copy()
    turned[2, :3, :3] = turned[2, :3, :3] @ cv2.Rodrigues(np.radians([2.0, 3.0, 0.0]))[0]

    def about(c2w):
        cameras = small(Cameras(scene.cameras.K, c2w))
        return scene_limits.about_axes(
            matches, cameras, [1, 2, 3], scene, SIZE, ROWS["poses"], "opengl"
        )

    assert about(turned) == about(scene.cameras.c2w) == []
    assert judged(scene, matches, Cameras(scene.cameras.K, turned))[0].kind == "poses"
    mixed = opencv_to_opengl(scene.cameras.c2w)
    assert [one.kind for one in about(mixed)] == ["axes"]


def test_a_check_that_fails_is_said_and_the_run_goes_on(tmp_path, program, scene, monkeypatch):
    def broken(*args):
        raise RuntimeError("no memory")

    monkeypatch.setattr(matching, "photo_matches", broken)
    record, said = program(write(tmp_path / "scene", scene, scene.cameras))
    assert record == []
    assert said == ["warning: poses and photos were not compared (RuntimeError: no memory)"]


def test_python_users_get_the_same(scene, monkeypatch):
    monkeypatch.setattr(limits, "table", lambda name: ROWS)
    wrong = dataclasses.replace(scene, cameras=scale_focal(scene.cameras, 1.02))
    with pytest.warns(LimitWarning, match="fit focal lengths"):
        (one,) = scene_limits.warn(wrong, [1, 2, 3], CONFIG)
    assert scene_limits.warn(scene, [1, 2, 3], CONFIG) == ()
    beside = scene_limits.Beside(wrong, [1, 2, 3], CONFIG)
    with pytest.warns(LimitWarning) as said:
        assert beside.tell() == beside.tell() == (one,)
    assert len(said) == 1


# How the limits are measured.


def test_exact_matches_show_what_a_wrong_pose_does_and_no_more():
    """A wall at z = 5: seen from all sides of it, without hidden parts; one camera sees none of it."""
    cameras = small(around())
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(cameras.K[0]).T
    towards = np.einsum("hwi,vi->vhw", rays, cameras.c2w[:, 2, :3])  # along z of the world
    depth = (5.0 - cameras.c2w[:, 2, 3])[:, None, None] / towards
    depth[4] = 0.3
    found = measured.exact_matches(depth, cameras, [(0, 1), (1, 2), (1, 4)])
    assert set(found) == {(0, 1), (1, 2)}
    assert max(matching.misfits(found, cameras).values()) < 1e-9
    pixels, error, *_ = measured.seen(found, cameras, [1])
    assert pixels < 1e-9 and error == 0
    pixels = [
        measured.seen(found, measured.wrong(cameras, [0, 1, 2], "rotation", level, 0), [1])[0]
        for level in (0.1, 0.2)
    ]
    assert pixels[1] == pytest.approx(2 * pixels[0], rel=0.05) and pixels[0] > 0.005


def test_limits_on_poses_are_the_smaller_pixels_and_lie_outside_the_noise():
    ends = {"rotation": 0.2, "position": 0.01, "focal": 0.6}
    breaks = {
        knob: {
            m: {"loses_1_db": {"at": at * (1 + i), "interval": [at, at]}}
            for i, m in enumerate(measured.MODELS)
        }
        for knob, at in ends.items()
    }
    pixels = {"rotation": 0.3, "position": 0.2, "focal": 0.001}
    found = {
        "doses": [0.5, 1],
        "exact": {
            knob: {"seen": [[[x * p, 0.6 * x, 0.0, 1 + x]] * 5 for x in (0.5, 1, 9)]}
            for knob, p in pixels.items()
        },
        "undisturbed": {"1": [[0.1, 0.0, 0.1, 1.0]] * 5, "2": [[0.05, 0.9, 0.05, 1.0]] * 5},
    }
    found["matched"] = found["exact"]
    rows = measured.rows(breaks, found)
    assert rows["poses"]["limit"] == 0.2 and rows["poses"]["of"] == "position"
    assert rows["poses"]["knob"] == 0.01 and not rows["poses"]["moved"]
    assert rows["focal"]["limit"] == pytest.approx(0.9) and rows["focal"]["moved"]  # 95 % of them
    assert rows["focal"]["measured_limit"] == 0.6
    assert rows["focal"]["gain"] == pytest.approx(2.0)  # of wrong poses, at the dose
    shown = [[0.3, 0.0, 0.3, 3.0], [0.3, 1.0, 0.1, 3.0], [0.1, 1.0, 0.1, 3.0], [0.3, 1.0, 0.3, 3.0]]
    shown += [[0.1, 1.0, 0.1, 1.9], [0.3, 1.0, 0.1, 1.9]]
    assert measured.warned(shown, rows) == (0.5, pytest.approx(1 / 3))
