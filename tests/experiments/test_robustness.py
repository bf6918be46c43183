"""Disturbances do what they say, run-time measures see them, and warnings come beyond measured limits and not within."""

import dataclasses
import json
import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_cases import looking_at_origin
from scene_files import nerfstudio, truth

from experiments.stability import report
from roge_jax import checkpoint, model, sample
from roge_jax.config import preset
from roge_jax.data import faults
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import LimitWarning
from roge_jax.files import entry
from roge_jax.geometry.cameras import Cameras, scale_focal
from roge_jax.sampling import limits, programs


def photos(m=3, height=48, width=64, seed=0):
    """Textured pictures in [0.2, 0.8]."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0.2, 0.8, (m, height // 4, width // 4, 3))
    fine = rng.uniform(-0.1, 0.1, (m, height, width, 3))
    return np.clip(coarse.repeat(4, 1).repeat(4, 2) + fine, 0, 1).astype(np.float32)


def at(centres, focal=50.0):
    """Cameras that look along z from these places."""
    centres = np.asarray(centres, float)
    c2w = np.tile(np.eye(4), (len(centres), 1, 1))
    c2w[:, :3, 3] = centres
    K = np.array([[focal, 0, 32], [0, focal, 24], [0, 0, 1.0]])
    return Cameras(np.tile(K, (len(centres), 1, 1)), c2w)


# Disturbances.


def test_pose_errors_have_the_size_asked_for():
    cameras, rng = looking_at_origin(2000), np.random.default_rng(0)
    turned = faults.turn_cameras(cameras, 3.0, rng)
    relative = np.swapaxes(cameras.c2w[:, :3, :3], 1, 2) @ turned.c2w[:, :3, :3]
    angle = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(3.0, rel=0.05)  # 2000 draws: 1 % spread
    np.testing.assert_array_equal(turned.centres, cameras.centres)
    moved = faults.move_cameras(cameras, 0.2, rng)
    gaps = np.linalg.norm(moved.centres - cameras.centres, axis=1)
    assert np.sqrt(np.mean(gaps**2)) == pytest.approx(0.2, rel=0.05)
    np.testing.assert_array_equal(moved.c2w[:, :3, :3], cameras.c2w[:, :3, :3])


def test_photo_disturbances_have_the_size_asked_for():
    images, rng = 0.5 * np.ones((2, 64, 64, 3), np.float32), np.random.default_rng(0)
    assert (faults.add_noise(images, 0.1, rng) - images).std() == pytest.approx(0.1, rel=0.05)
    light = faults.expose(images, np.array([1.0, -1.0])) ** faults.GAMMA
    ratio = light[0].mean() / light[1].mean()
    assert np.log2(ratio) == pytest.approx(2.0, abs=1e-3)
    point = np.zeros((1, 65, 65, 3), np.float32)
    point[0, 32, 32] = 1.0
    spot = faults.blur(point, 2.0)[0, ..., 0].astype(float)
    x = np.arange(65) - 32
    assert np.sqrt((spot * x[None] ** 2).sum() / spot.sum()) == pytest.approx(2.0, rel=0.02)
    smooth = faults.blur(photos(), 2.0)  # colours are coded at half resolution
    errors = [np.abs(faults.jpeg(smooth, q) - smooth).mean() for q in (95, 50, 10)]
    assert errors == sorted(errors) and errors[0] < 0.01
    focal = scale_focal(at(np.zeros((2, 3))), 1.1).K
    assert focal[0, 0, 0] == pytest.approx(55) and focal[0, 0, 2] == 32


def test_captured_photos_have_every_fault_within_its_dose():
    cameras, images = looking_at_origin(200), np.full((200, 16, 16, 3), 0.5, np.float32)
    baseline = np.linalg.norm(cameras.centres[:, None] - cameras.centres[None], axis=-1).max()
    doses = []
    for seed in range(40):
        shot, found = faults.captured(images, cameras, np.random.default_rng(seed))
        relative = np.swapaxes(cameras.c2w[:, :3, :3], 1, 2) @ found.c2w[:, :3, :3]
        turn = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))
        gaps = np.linalg.norm(found.centres - cameras.centres, axis=1) / baseline
        focal = np.log(found.K[:, 0, 0] / cameras.K[:, 0, 0])
        assert np.ptp(focal) < 1e-9  # one lens
        light = faults.GAMMA * np.log2(shot.mean((1, 2, 3)) / 0.5)  # another exposure for each
        noise = (shot - shot.mean((1, 2, 3), keepdims=True)).std()
        rms = [np.sqrt(np.mean(x**2)) for x in (turn, gaps)]
        doses.append([*rms, abs(focal[0]), np.abs(light).max(), noise])
    largest = [faults.TURN, faults.MOVE, faults.FOCAL, faults.STOPS, faults.NOISE]
    share = np.array(doses) / largest
    assert np.all(share.max(0) < 1.2) and np.all(share.max(0) > 0.8) and np.all(share.min(0) < 0.2)


def test_faults_of_samples_are_those_of_the_photos_alone():
    rng = np.random.default_rng(0)
    cameras = looking_at_origin(8)
    rgb = rng.integers(0, 255, (8, 16, 16, 3), dtype=np.uint8)
    pool = [{"rgb": rgb, "K": cameras.K, "c2w": cameras.c2w}]
    views = ViewConfig(contexts=(3,), context_weights=(1.0,), targets=2, augment=False, faults=1.0)
    faulty, plain = (
        draw_batch(pool, 0, 0, 4, cfg, scale_rule="lagernvs")
        for cfg in (views, dataclasses.replace(views, faults=0.0))
    )
    np.testing.assert_array_equal(faulty["target_rgb"], plain["target_rgb"])
    np.testing.assert_array_equal(faulty["K"][:, 3:], plain["K"][:, 3:])
    assert np.all(np.abs(faulty["context_rgb"] - plain["context_rgb"]).mean((2, 3, 4)) > 1e-3)
    assert np.all(np.abs(faulty["K"] - plain["K"])[:, :3, 0, 0] > 0)
    scored = dataclasses.replace(views, augment=True, near=1.0).undisturbed()
    assert (scored.augment, scored.near, scored.faults) == (False, 0.0, 0.0)
    again = draw_batch(pool, 0, 0, 4, scored, scale_rule="lagernvs")
    some = draw_batch(pool, 0, 0, 4, dataclasses.replace(scored, faults=0.5), scale_rule="lagernvs")
    changed = [np.any(some["context_rgb"][i] != again["context_rgb"][i]) for i in range(4)]
    assert any(changed) and not all(changed)


# Measures.


def test_distance_from_the_hull_in_baselines():
    context = at([[0, 0, 0], [2, 0, 0], [0, 1, 0]])  # baseline: the hypotenuse
    base = np.sqrt(5.0)
    target = at(
        [[0.5, 0.25, 0], [1, 0, 0], [2, 0, 0], [0.5, 0.25, 1], [4, 0, 0], [-1, -1, 0], [2, 2, 0]]
    )
    to_edge = np.hypot(*(np.array([2, 2]) - (np.array([0, 1]) + np.array([2, -1]) * 3 / 5)))
    expected = np.array([0, 0, 0, 1, 2, np.sqrt(2), to_edge]) / base
    np.testing.assert_allclose(limits.extrapolation(context, target), expected, atol=1e-9)


def test_distance_from_the_hull_equals_a_linear_programme():
    """Nine random centres: non-negative least squares with a heavy row for the sum of the shares."""
    from scipy.optimize import nnls

    rng = np.random.default_rng(0)
    seen, asked = rng.normal(size=(9, 3)), 0.7 * rng.normal(size=(20, 3))
    base = np.linalg.norm(seen[:, None] - seen[None], axis=-1).max()
    matrix = np.concatenate([seen.T, 1e4 * np.ones((1, 9))])
    expected = []
    for x in asked:
        shares, _ = nnls(matrix, np.append(x, 1e4))
        expected.append(np.linalg.norm(seen.T @ shares - x) / base)
    found = limits.extrapolation(at(seen), at(asked))
    assert (found > 0.05).sum() > 3 and (found < 1e-6).sum() >= 3
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_measures_know_no_unit_and_no_place(unit):
    """Another unit and a far-away origin change nothing; photos in one place have no baseline."""
    rng = np.random.default_rng(1)
    seen, asked = rng.normal(size=(4, 3)), 2 * rng.normal(size=(6, 3))
    here = limits.extrapolation(at(seen), at(asked))
    there = limits.extrapolation(at(unit * (seen + 50)), at(unit * (asked + 50)))
    np.testing.assert_allclose(there, here, rtol=1e-6, atol=1e-9)
    one = np.tile(seen[:1], (3, 1))
    for few in (one, one[:1]):
        assert np.isnan(limits.extrapolation(at(few), at(asked))).all()
        assert len(limits.repeats(at(few))) == len(few) - 1


def test_other_measures():
    context = at(np.zeros((3, 3)) + np.arange(3)[:, None], focal=60.0)
    np.testing.assert_allclose(limits.field_ratio(context, at(np.zeros((2, 3)), 30.0)), [2, 2])
    twins = context[np.array([0, 1, 0, 2, 1])]
    assert limits.repeats(twins) == {2: 0, 4: 1}
    turned = faults.turn_cameras(twins, 30.0, np.random.default_rng(0))
    assert limits.repeats(turned) == {}  # one place, other directions: not the same photo
    images = photos()
    assert np.ptp(limits.exposures(images)) < 0.1
    stops = limits.exposures(faults.expose(images, np.array([-1.0, 0.0, 0.0])))
    assert stops[1] - stops[0] == pytest.approx(1.0, abs=0.1)
    sharp = limits.sharpness(images)
    for sigma in (1.0, 2.0):
        softer = limits.sharpness(faults.blur(images, sigma))
        assert (softer < 0.8 * sharp).all()
        sharp = softer
    assert np.isnan(limits.sharpness(np.full((1, 32, 32, 3), 0.3))).all()


@pytest.mark.parametrize("sigma", [0.01, 0.03, 0.1])
def test_noise_is_told_from_fine_detail(sigma):
    """A flat photo gives the dose, a textured one as well, and nothing without noise, however fine its detail."""
    rng = np.random.default_rng(1)
    flat = faults.add_noise(np.full((1, 64, 112, 3), 0.5, np.float32), sigma, rng)
    assert limits.noise(flat)[0] == pytest.approx(sigma, rel=0.05)
    gravel = rng.uniform(-0.2, 0.2, (2, 64, 112, 1))  # the finest detail there is, of brightness
    colours = rng.uniform(0.4, 0.6, (2, 4, 7, 3)).repeat(16, 1).repeat(16, 2)
    clean = (colours + gravel).astype(np.float32)
    assert limits.noise(clean).max() < 1e-6
    noisy = faults.add_noise(clean, sigma, rng)
    # Edges of colours hide a little under the median: an eighth of the places here.
    np.testing.assert_allclose(limits.noise(noisy), sigma, rtol=0.3)
    one = np.concatenate([noisy[:1], clean[1:]])
    assert limits.noise(one)[0] > 100 * limits.noise(one)[1]  # photo by photo


# Warnings.

LIMITS = {
    "extrapolation": {"limit": 1.0, "broke": True},
    "wider": {"limit": 1.5, "broke": True},
    "narrower": {"limit": 0.5, "broke": False},
    "photos": {"limit": 2.4, "broke": True},
    "exposure": {"limit": 1.5, "broke": True},
    "blur": {"limit": 0.4, "broke": True},
    "noise": {"limit": 0.1, "broke": True, "moved": True},
}
SEEN = at([[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def sharp_photos(m=3):
    return np.tile(photos(1), (m, 1, 1, 1))


CASES = {
    "extrapolation": (SEEN, at([[1 + x, 0, 0] for x in (0, 1, 2, 3)]), sharp_photos(), "frames 2-3"),
    "wider": (SEEN, at([[0, 0, 0]] * 3, 30.0), sharp_photos(), "frames 0-2"),
    "narrower": (SEEN, at([[0, 0, 0]], 120.0), sharp_photos(), "frame 0"),
    "photos": (SEEN[np.array([0, 1, 0])], at([[0, 0, 0]]), sharp_photos(), "14 repeats 10"),
    "exposure": (SEEN, at([[0, 0, 0]]), faults.expose(sharp_photos(), np.array([-2.0, 0, 0])), "brighter than photo 10"),
    "blur": (SEEN, at([[0, 0, 0]]), np.concatenate([sharp_photos(2), faults.blur(sharp_photos(1), 3.0)]), "photo 14 is blurred"),
    "noise": (SEEN, at([[0, 0, 0]]), np.concatenate([sharp_photos(2), faults.add_noise(sharp_photos(1), 0.2, np.random.default_rng(0))]), "photo 14 is noisy"),
}  # fmt: skip


@pytest.mark.parametrize("kind", CASES)
def test_one_warning_beyond_a_limit_and_none_within(kind):
    context, target, images, said = CASES[kind]
    found = limits.beyond(images, context, target, LIMITS, ids=(10, 12, 14))
    assert [one.kind for one in found] == [kind]
    message = found[0].message
    assert said in message and ": " in message and message.endswith(".") and "\n" not in message
    assert f"{LIMITS[kind]['limit']:.2g}" in message or kind == "photos"
    # The same input is within limits a little beyond it.
    value = found[0].value
    looser = 1.01 * value if value > LIMITS[kind]["limit"] else 0.99 * value
    relaxed = LIMITS | {kind: LIMITS[kind] | {"limit": looser}}
    assert limits.beyond(images, context, target, relaxed) == []
    assert limits.beyond(images, context, target, {}) == []  # a model without measured limits


def test_shipped_limits_say_where_they_come_from():
    row = json.loads(limits.TABLE.read_text())["mini"]
    assert {"command", "commit", "weights", "seeds", "scenes", "criterion"} <= set(
        row["provenance"]
    )
    assert set(limits.table("mini")) == {*LIMITS, "poses", "focal", "jpeg"}
    for kind, one in row["limits"].items():
        assert np.isfinite(one["limit"]) and isinstance(one["broke"], bool), kind
        assert one["undisturbed_beyond"] <= 0.05 and one["last_level_beyond"] >= 0.95, kind
    assert limits.table("tiny") == {}


def without_network(params, views, config, slots):
    """Programs that give grey frames: nothing is compiled."""
    video = np.full((config.frames, config.height, config.width, 3), 0.5, np.float32)
    return programs.Programs(
        prepare=lambda params, views: SimpleNamespace(shown=video, detail=None, full=None),
        velocity=lambda params, prepared, noise, x, sigma: jnp.zeros_like(x),
        decode=lambda params, x0, detail: video,
    )


def test_the_program_warns_once_and_records_it(tmp_path, monkeypatch, capsys):
    config = preset("tiny")
    checkpoint.save_model(tmp_path / "model", model.init(jax.random.key(0), config), config)
    nerfstudio(tmp_path / "scene", truth(3))
    monkeypatch.setattr(programs, "for_window", without_network)

    def run(limit):
        rows = {"extrapolation": {"limit": limit, "broke": True}}
        monkeypatch.setattr(limits, "table", lambda name: rows if name == "tiny" else {})
        words = ["--checkpoint", tmp_path / "model", "--scene", tmp_path / "scene", "--steps", 1]
        words += ["--frames", 7, "--trajectory", "move-right:distance=3", "--out", tmp_path / "out"]
        assert entry.execute(sample.main, sample.parser(), [str(w) for w in words]) == 0
        record = json.loads((tmp_path / "out" / "run.json").read_text())["warnings"]
        said = [x for x in capsys.readouterr().err.splitlines() if "baselines" in x]
        return record, said

    record, said = run(0.5)
    assert len(said) == 1 and [w["kind"] for w in record] == ["extrapolation"]
    assert said[0] == f"warning: {record[0]['message']}"
    assert record[0]["value"] > record[0]["limit"] == 0.5
    assert run(1e3) == ([], [])


def test_photos_from_one_place_are_no_error_but_said(tmp_path, monkeypatch, capsys):
    """A tripod's photos: the program ends well, names what is missing once, and records what it took in its place."""
    config = preset("tiny")
    checkpoint.save_model(tmp_path / "model", model.init(jax.random.key(0), config), config)
    cameras = truth(3)
    cameras.c2w[:, :3, 3] = cameras.c2w[0, :3, 3]
    nerfstudio(tmp_path / "scene", cameras)
    monkeypatch.setattr(programs, "for_window", without_network)
    words = ["--checkpoint", tmp_path / "model", "--scene", tmp_path / "scene", "--steps", 1]
    for path in ("orbit", "pan"):  # pan: the path gives no scale either
        more = ["--trajectory", path, "--frames", 3, "--out", tmp_path / path]
        assert entry.execute(sample.main, sample.parser(), [str(w) for w in words + more]) == 0
        said = [x for x in capsys.readouterr().err.splitlines() if x.startswith("warning: ")]
        assert len(said) == 1 and "fix no scale" in said[0], said
        scale = json.loads((tmp_path / path / "run.json").read_text())["scale"]
        assert scale["status"] == "coincident_centres" and scale["divisor"] > 0


def test_warnings_have_their_own_category():
    context, target, images, _ = CASES["wider"]
    with (
        pytest.warns(LimitWarning, match="1.7 times as wide"),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(limits, "table", lambda name: LIMITS)
        limits.warn(images, context, target, "any", (0, 1, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", LimitWarning)
        assert limits.warn(images, context, target, "tiny", (0, 1, 2)) == ()


# Where curves break.


def test_crossing_is_interpolated():
    levels = np.array([0.0, 1.0, 2.0])
    assert report.crossing(levels, np.array([1.0, 0.5, -0.5])) == pytest.approx(1.5)
    assert np.isnan(report.crossing(levels, np.array([1.0, 0.5, 0.1])))
    assert report.crossing(levels, np.array([-1.0, 0.5, 0.1])) == 0.0
    falling = np.array([100.0, 10.0, 1.0])
    assert report.crossing(falling, np.array([1.0, 1.0, -1.0]), True) == pytest.approx(10**0.5)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_break_of_a_known_curve_and_its_interval(direction):
    """Scenes that lose `slope` dB a level: the mean breaks at 1 / mean slope, the interval holds it."""
    slopes = np.random.default_rng(0).uniform(0.3, 0.7, 12)
    steps = np.arange(6.0)
    found = report.with_interval(direction * steps, 1.0 - steps[:, None] * slopes[None], False)
    assert direction * found["at"] == pytest.approx(1 / slopes.mean(), rel=1e-6)
    low, high = sorted(direction * x for x in found["interval"])
    assert low < 1 / slopes.mean() < high and found["share_crossing"] == 1.0
    never = report.with_interval(direction * steps, np.ones((6, 12)), False)
    assert never["at"] is None and never["interval"] == [None, None]


def test_limits_on_estimates_lie_outside_the_undisturbed_scenes():
    """A break that 5 % of the undisturbed scenes pass moves to their 95 % quantile, above as below; others stay."""
    found, broken = {}, {}
    for kind, measured in report.SHOWN.items():
        levels = [report.KNOBS[kind].still, *report.KNOBS[kind].levels]
        values = [1.0 - 0.1 * i if measured == "sharpness" else 0.1 * i for i in range(len(levels))]
        found[kind] = {"levels": levels, "seen": {measured: [[x] * 4 for x in values]}}
        end = {"at": levels[1], "interval": [None, None]}
        broken[kind] = {method: {"loses_1_db": end} for method in report.MODELS}
    usual = np.linspace(0.0, 0.2, 101)  # 95 % within 0.19; the breaks are at 0.1 and 0.9
    still = {"exposure_stops": usual, "sharpness": 1.0 - usual, "noise": 0.1 * usual}
    rows = report.limit_rows(found, broken, still)
    moved = {kind: row["limit"] for kind, row in rows.items() if row["moved"]}
    assert moved == {"exposure": pytest.approx(0.19), "blur": pytest.approx(0.81)}
    for kind, row in rows.items():
        assert row["undisturbed_beyond"] <= 0.05, kind
        expected = 0.9 if kind == "blur" else 0.1
        assert row["measured_limit"] == pytest.approx(expected), kind
    assert rows["noise"]["limit"] == rows["noise"]["measured_limit"]
