"""Session, live picture and videos on the tiny model, without a page."""

import dataclasses
import json
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from scene_files import nerfstudio, truth
from test_stretches import weights  # noqa: F401  fixture: the tiny model

from roge_jax import checkpoint, sample, sampling
from roge_jax.config import preset
from roge_jax.errors import UserError
from roge_jax.files import entry, video_io
from roge_jax.geometry.trajectories import PRESETS, make_path
from roge_jax.scenes.paths import load_path
from roge_jax.scenes.scene import load_scene
from roge_jax.viewer import keyframes, route, runs
from roge_jax.viewer.levels import Pace
from roge_jax.viewer.live import Live, View, Worker
from roge_jax.viewer.route import Route
from roge_jax.viewer.session import Given, Session

CONFIG = preset("tiny")
PARTS = ("encoder", "renderer")


@pytest.fixture(scope="module")
def place(weights, tmp_path_factory):  # noqa: F811
    folder = tmp_path_factory.mktemp("session")
    checkpoint.save_model(folder / "model", weights, CONFIG, dtype=np.float32)
    nerfstudio(folder / "scene", truth(4))
    return folder


def session(weights, place, tmp_path):  # noqa: F811
    scene = load_scene(place / "scene")
    photos = sampling.read_photos(scene, [0, 1, 2, 3], CONFIG)
    begin = Route("orbit", {"degrees": 20.0, "swing": None, "ease": False}, 5, (), 8.0)
    path = make_path("orbit", photos.cameras, 5, degrees=20.0)
    asked = []

    def read(parts):
        asked.append(parts)
        return {k: v for k, v in weights.items() if parts is None or k in parts}

    made = Session(Given(CONFIG, scene, photos, path, begin, tmp_path / "out", read))
    made.asked = asked
    return made


@pytest.fixture
def ours(weights, place, tmp_path):  # noqa: F811
    return session(weights, place, tmp_path)


def add(session, number=0):
    pose = session.given.photos.cameras.c2w[number]
    session.change(
        lambda old: Route(None, {}, old.frames, keyframes.added(old.keys, pose, 40.0), old.fps)
    )


# ---- path ----------------------------------------------------------------------------------------


def test_poses_go_to_the_page_and_back(ours):
    for pose in ours.given.photos.cameras.c2w:
        np.testing.assert_allclose(ours.pose_of(*ours.shown_at(pose)), pose, atol=1e-9)
    wxyz, position = ours.shown_at(ours.given.photos.cameras.c2w[0])
    np.testing.assert_allclose(wxyz, [1, 0, 0, 0], atol=1e-9)  # the first photo is the origin
    np.testing.assert_allclose(position, 0, atol=1e-12)


def test_points_of_a_scene_lie_where_cameras_do(ours):
    """On the page; a scene without points has none."""
    assert ours.points() is None
    centres = ours.given.photos.cameras.centres
    cloud = SimpleNamespace(xyz=centres, rgb=None)
    carried = dataclasses.replace(ours.given, scene=SimpleNamespace(points=cloud))
    xyz, rgb = Session(carried).points()
    shown = [ours.shown_at(pose)[1] for pose in ours.given.photos.cameras.c2w]
    np.testing.assert_allclose(xyz, shown, atol=1e-12)
    assert rgb.shape == xyz.shape and rgb.dtype == np.uint8


def test_an_edit_that_gives_no_path_changes_nothing(ours):
    told = []
    ours.watch(told.append)
    before = ours.route
    for wrong in (
        lambda old: route.choose(old, "spin"),
        lambda old: Route("orbit", {"degrees": "many"}, 5, (), 8.0),
        lambda old: Route("orbit", {}, 0, (), 8.0),
    ):
        with pytest.raises(UserError):
            ours.change(wrong)
    assert ours.route is before and told == []


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_can_be_drawn_and_turned_into_key_frames(ours, name):
    ours.change(lambda old: route.choose(old, name))
    assert set(ours.route.options) >= {"ease"} and len(ours.path()) == 5
    assert route.line(ours.path()).shape == (4, 2, 3)
    context, size = ours.given.photos.cameras, ours.size
    ours.change(lambda old: route.as_keys(old, context, size))
    assert ours.route.preset is None and len(ours.route.keys) == 5


def test_a_saved_path_is_what_sample_reads_and_what_is_opened(ours):
    add(ours, 0), add(ours, 2)
    file = ours.save("there")
    size = CONFIG.height, CONFIG.width
    read = load_path(file, height=size[0], width=size[1], context=ours.given.photos.cameras)
    np.testing.assert_allclose(read.c2w, ours.path().c2w, atol=1e-9)
    np.testing.assert_allclose(read.K, ours.path().K, rtol=1e-9)
    kept = ours.route.keys
    add(ours, 1)
    ours.load_saved("there")
    assert len(ours.route.keys) == 2 and ours.saved() == ["there"]
    np.testing.assert_allclose(ours.route.keys[1].c2w, kept[1].c2w, atol=1e-9)


@pytest.mark.parametrize("name", ["../away", "a/b", "", "a.json", "x" * 61, "..", "/etc/passwd"])
def test_names_lead_nowhere_else(ours, name):
    with pytest.raises(UserError, match="no name"):
        ours.save(name)
    with pytest.raises(UserError, match="no path"):
        ours.load_saved(name)
    assert not ours.given.out.exists()


def test_a_file_that_is_no_path_says_so_by_its_own_name(ours):
    before = ours.route
    with pytest.raises(UserError, match=r"holiday\.json"):
        ours.load("holiday.json", b"{]")
    with pytest.raises(UserError):
        ours.load("../../x", b"\x00\x01")
    assert ours.route is before


def test_an_opened_file_makes_nobody_open_others(ours, place, monkeypatch):
    """A transforms.json names photos, here and anywhere; as a path it is cameras alone."""
    from roge_jax.scenes import assemble, images, pictures

    content = json.loads((place / "scene" / "transforms.json").read_text())
    content["frames"][1]["file_path"] = "/etc/passwd"
    content["frames"][2]["file_path"] = str(place / "scene" / "images" / "0002.png")
    opened = []
    for module in (assemble, images, pictures):
        monkeypatch.setattr(module, "is_file", opened.append, raising=False)
    monkeypatch.setattr("PIL.Image.open", opened.append)
    ours.load("transforms.json", json.dumps(content).encode())
    assert opened == [] and len(ours.route.keys) == 4
    cameras = ours.given.photos.cameras
    np.testing.assert_allclose([k.c2w for k in ours.route.keys], cameras.c2w, atol=1e-9)


# ---- live picture --------------------------------------------------------------------------------


def view_of(session, number, fov=45.0):
    return View(session.given.photos.cameras.c2w[number], fov, CONFIG.width / CONFIG.height)


@pytest.fixture(scope="module")
def live(weights, place, tmp_path_factory):  # noqa: F811
    given = session(weights, place, tmp_path_factory.mktemp("live")).given
    params = {name: weights[name] for name in PARTS}
    return Live(params, CONFIG, given.scene, given.photos.ids, given.path)


def test_the_live_picture_is_that_of_the_sampler(live, ours):
    """At the model's own level, from a camera of the path."""
    live.build(1)
    path = ours.path()[2:3]
    whole = sampling.preview(live.params, CONFIG, ours.given.photos, ours.path()).frames[2]
    fov = float(2 * np.degrees(np.arctan(0.5 * CONFIG.height / path.K[0, 1, 1])))
    aspect = (CONFIG.width / path.K[0, 0, 0]) / (CONFIG.height / path.K[0, 1, 1])
    seen = View(path.c2w[0], fov, aspect)
    # The live camera has its principal point in the middle of the window.
    K = seen.cameras(CONFIG.height, CONFIG.width).K[0]
    if np.abs(K - path.K[0]).max() > 1e-6:
        path = path.replace(K=K[None])
        whole = sampling.preview(live.params, CONFIG, ours.given.photos, path).frames[0]
        assert np.abs(ours.world.divisor - live._known[32, 48][1].divisor) < 1e-9
    np.testing.assert_allclose(live.picture(1, seen), video_io.to_uint8(whole), atol=1)


def test_the_quick_level_looks_at_the_nearest_photos(live):
    live.build(0)
    assert live.levels[0].photos == 3 and len(live.photos.ids) == 4
    given = []
    run = live._run[0]
    live._run[0] = lambda *a: given.append(a[-1]) or run(*a)
    c2w = live.photos.cameras.c2w
    picture = live.picture(0, View(c2w[2], 45.0, 1.5))
    live._run[0] = run
    gaps = np.linalg.norm(c2w[:, :3, 3] - c2w[2, :3, 3], axis=-1)
    assert 2 in given[0] and len(given[0]) == 3 and int(np.argmax(gaps)) not in given[0]
    assert picture.dtype == np.uint8 and picture.shape == (*live.levels[0].size, 3)
    assert live.pace.seconds[0] is not None


def test_coverage_is_high_at_a_photo_and_nothing_behind_it(live, ours):
    assert live.seen(view_of(ours, 1, fov=10.0)) > 0.9  # within what the photo shows
    behind = ours.given.photos.cameras.c2w[1].copy()
    behind[:3, :3] = behind[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    assert live.seen(View(behind, 45.0, 1.5)) < 0.1


def test_the_thread_serves_two_viewers_and_ends(live, ours):
    shown, failed = [], []
    live.pace = Pace((None,) * len(live.levels))  # or one moves at the finest level at once
    worker = Worker(live, lambda who, what: shown.append((who, what)), failed.append)
    worker.ask("a", view_of(ours, 0))
    worker.ask("b", view_of(ours, 1))
    worker.start()
    try:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and len([w for w in shown if w[1].finest]) < 2:
            time.sleep(0.05)
    finally:
        worker.stop()
    assert failed == []
    for who in "ab":
        own = [what for name, what in shown if name == who]
        assert own[-1].finest and own[0].seconds > 0  # a fast machine may begin with it
    assert not any(thread.is_alive() for thread in worker.threads)


def test_a_live_picture_that_fails_says_so(live):
    failed = []
    worker = Worker(live, lambda *a: None, failed.append)
    picture = live.picture
    live.picture = lambda *a: 1 / 0
    worker.ask("a", None)
    worker.start()
    worker.threads[0].join(120)
    live.picture = picture
    assert len(failed) == 1 and "division by zero" in failed[0]


# ---- videos --------------------------------------------------------------------------------------


def finish(session, **options):
    run = session.start(**options)
    run.thread.join(300)
    return run


def test_a_generated_video_is_that_of_sample(ours, place):
    add(ours, 0), add(ours, 1)
    ours.change(lambda old: Route(None, {}, 0, keyframes.changed(old.keys, 1, seconds=0.75), 8.0))
    run = finish(ours, generated=True, steps=1, seed=3)
    assert (run.state, run.progress.fraction) == ("done", 1.0), run.text
    assert run.folder == ours.given.out / "video-001" and ours.videos() == [run.folder]
    said = json.loads((run.folder / "run.json").read_text())
    assert said["program"] == "roge_jax.view" and said["generated"] is True and said["frames"] == 7
    assert ours.asked == [PARTS, None]
    out = ours.given.out / "sample"
    words = ["--checkpoint", place / "model", "--scene", place / "scene", "--steps", 1, "--seed", 3]
    words += ["--trajectory", run.folder / "path.json", "--context", "0,1,2,3", "--out", out]
    assert entry.execute(sample.main, sample.parser(), [str(word) for word in words]) == 0
    for made in sorted((out / "frames").iterdir()):
        assert made.read_bytes() == (run.folder / "frames" / made.name).read_bytes()
    beside = video_io.read_video(run.folder / runs.BESIDE)
    assert beside.shape[:2] == (7, 32) and beside.shape[2] >= 3 * 48


def test_a_preview_loads_no_generator(ours):
    run = finish(ours, generated=False)
    assert run.state == "done", run.text
    assert ours.asked == [PARTS]
    assert json.loads((run.folder / "run.json").read_text())["generated"] is False
    assert run.folder.name == "preview-001" and "preview alone" in runs.about(run.folder)
    again = finish(ours, generated=False)
    assert again.folder.name == "preview-002" and ours.videos() == [run.folder, again.folder]


def test_a_reconstruction_alone_makes_previews(ours):
    given = ours.given
    alone = dataclasses.replace(given.config, parts="reconstruction")
    session = Session(dataclasses.replace(given, config=alone))
    with pytest.raises(UserError, match="make a preview"):
        session.start(generated=True)
    assert finish(session, generated=False).state == "done"


def test_a_cancelled_video_leaves_nothing(ours, monkeypatch):
    reached, on = threading.Event(), threading.Event()
    real = runs.sampling.sample

    def slow(*given, **more):
        reached.set()
        assert on.wait(60)
        return real(*given, **more)

    monkeypatch.setattr(runs.sampling, "sample", slow)
    run = ours.start(generated=True, steps=2)
    assert reached.wait(60)
    with pytest.raises(UserError, match="being made"):
        ours.start(generated=True)
    ours.cancel()
    on.set()
    run.thread.join(120)
    assert run.state == "cancelled" and list(ours.given.out.iterdir()) == []


def test_a_video_that_fails_says_why_and_the_next_one_works(ours, monkeypatch):
    def broken(*given, **more):
        raise RuntimeError("RESOURCE_EXHAUSTED: too large")

    monkeypatch.setattr(runs.sampling, "preview", broken)
    run = finish(ours, generated=False)
    assert run.state == "failed" and "too large" in run.text
    monkeypatch.undo()
    assert finish(ours, generated=False).state == "done"


# ---- progress ------------------------------------------------------------------------------------


def test_the_time_left_is_what_the_pieces_took():
    now = [0.0]
    progress = runs.Progress(windows=2, steps=2, clock=lambda: now[0])

    def piece(name, seconds):
        with progress.stage(name):
            now[0] += seconds

    piece("compile", 30.0)
    assert progress.seconds_left() is None and progress.fraction == 0.0
    piece("prepare", 4.0)
    with progress.stage("sample"):
        for _ in range(2):
            now[0] += 1.0
            progress.update(1)
    assert progress.seconds_left() is None  # nothing was decoded yet
    piece("decode", 2.0)
    assert progress.seconds_left() == pytest.approx(4 + 2 * 1 + 2)
    assert progress.fraction == pytest.approx(0.5)
    assert "about 8 s left" in progress.said()
    later = runs.Progress(1, 2, progress.known, clock=lambda: now[0])
    assert later.seconds_left() == pytest.approx(8.0) and later.fraction == 0.0


def test_cancelling_ends_at_the_next_piece():
    progress = runs.Progress(1, 2)
    progress.update(1)
    progress.cancel()
    with pytest.raises(runs.Cancelled), progress.stage("decode"):
        raise AssertionError("not reached")
    with pytest.raises(runs.Cancelled):
        progress.update(1)
