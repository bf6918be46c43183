"""`python -m roge_jax.pose`: mistakes are one sentence and leave nothing behind; photos of a room become its cameras."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scene_files as files
import textured_room
from PIL import Image

from roge_jax import pose
from roge_jax.files.video_io import write_video
from roge_jax.metrics.geometry import rotation_angle, umeyama
from roge_jax.posing import child, mapper
from roge_jax.scenes.scene import load_scene

needs_pycolmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="needs the extra `pose` (pycolmap)"
)
HEIGHT, WIDTH, VIEWS = 288, 384, 10


@pytest.fixture
def said(monkeypatch, capsys, tmp_path):
    """Runs the program in a folder of its own: (exit code, what it said, what lies there afterwards but for inputs)."""
    monkeypatch.setattr(child, "check_pycolmap", lambda: "4.2.1")

    def run(*words):
        before = set(tmp_path.rglob("*"))
        code = pose.cli([str(word) for word in words])
        printed = capsys.readouterr()
        return code, printed.err + printed.out, set(tmp_path.rglob("*")) - before

    return run


def pictures(folder: Path, count: int) -> Path:
    for i in range(count):
        files.save(folder / f"{i}.jpg", files.picture(i))
    return folder


def test_mistakes_are_one_sentence_and_nothing_is_written(said, tmp_path):
    photos = pictures(tmp_path / "photos", 3)
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    pictures(tmp_path / "one", 1)
    pictures(tmp_path / "torn", 3)
    torn = tmp_path / "torn" / "1.jpg"
    torn.write_bytes(torn.read_bytes()[:300])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    out = tmp_path / "scene"
    for words, message in (
        ((tmp_path / "nothing", "--out", out), "there is no such folder of photos"),
        ((tmp_path / "empty", "--out", out), "has no photos in it"),
        ((tmp_path / "bad.mp4", "--out", out), "cannot be read as a video"),
        ((tmp_path / "one", "--out", out), "has one photo, 0.jpg"),
        ((tmp_path / "torn", "--out", out), "1.jpg: "),
        ((photos, "--out", tmp_path / "full"), "give another folder"),
        ((photos, "--out", photos), "is where the photos are"),
        ((photos, "--out", tmp_path), "is where the photos are"),
        ((photos, "--out", tmp_path / "empty" / "x", "--frames", "9"), "--frames 9 is for videos"),
        ((photos, "--out", out, "--match", "exhaustiv"), "did you mean 'exhaustive'"),
        ((photos, "--out", out, "--size", "3"), "at least 200"),
        ((photos,), "--out"),
    ):
        code, text, new = said(*words)
        errors = [line for line in text.splitlines() if line.startswith("error: ")]
        assert code == 2 and message in text and len(errors) == 1, (words, text)
        assert "Traceback" not in text and not new, (words, text, new)


def test_heic_without_its_reader(said, tmp_path, monkeypatch):
    pictures(tmp_path / "photos", 2)
    (tmp_path / "photos" / "IMG_1.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    code, text, new = said(tmp_path / "photos", "--out", tmp_path / "scene")
    assert code == 2 and "IMG_1.heic: HEIC needs" in text and "roge_jax[heic]" in text and not new


@pytest.mark.parametrize(
    ("version", "message"),
    [
        (None, r"is not installed: pip install 'roge_jax\[pose\]'"),
        ("3.11.1", "4.2 or newer is needed"),
    ],
)
def test_without_pycolmap(monkeypatch, capsys, tmp_path, version, message):
    import re

    found = None if version is None else object()
    monkeypatch.setattr(child.importlib.util, "find_spec", lambda name: found)
    monkeypatch.setattr(child.importlib.metadata, "version", lambda name: version)
    photos = pictures(tmp_path / "photos", 3)
    assert pose.cli([str(photos), "--out", str(tmp_path / "scene")]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "scene").exists()


def test_a_disc_without_room_is_told_before_the_work(said, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=1e6))
    photos = pictures(tmp_path / "photos", 3)
    code, text, new = said(photos, "--out", tmp_path / "scene")
    assert code == 2 and "make room or give another --out" in text and not new


def test_a_disc_that_gets_full_ends_the_work(said, tmp_path, monkeypatch):
    """COLMAP would wait for ever: its process is ended, and everything written is taken away."""
    waits = "import time; print(flush=True); time.sleep(600)"
    real, started = subprocess.Popen, []

    def popen(command, **options):
        process = real([sys.executable, "-c", waits], **options)
        started.append(process)
        return process

    monkeypatch.setattr(child.subprocess, "Popen", popen)
    free = [1e12]
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=free[0]))
    room = child._check_room

    def later(folder):
        free[0] = 1e6
        room(folder)

    monkeypatch.setattr(child, "_check_room", later)
    code, text, new = said(pictures(tmp_path / "photos", 3), "--out", tmp_path / "scene")
    assert (
        code == 2
        and "only 1 MB are left" in text
        and not new - set((tmp_path / "photos").rglob("*"))
    )
    assert started[0].poll() is not None


def test_a_full_disc_while_photos_are_written(said, tmp_path, monkeypatch):
    import errno

    from roge_jax.posing import write

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device", "images/0.jpg")

    found = {"registered": [0, 1, 2], "cameras": {"1": {"photos": [0, 1, 2]}}, "turned_only": 0.0}
    found |= {"pairs_matched": 3, "features": [900] * 3, "partners": [2] * 3, "models": []}
    found |= {"mapper": "incremental", "reprojection_error": 0.5}
    monkeypatch.setattr(child, "solve", lambda *_: found)
    monkeypatch.setattr(write, "write_photo", full)
    photos = pictures(tmp_path / "photos", 3)
    code, text, new = said(photos, "--out", tmp_path / "scene")
    assert code == 2 and "No space left on device: free some space" in text and not new


def test_a_process_that_breaks_is_a_sentence(tmp_path, monkeypatch):
    real = subprocess.Popen
    breaks = (
        "import os, sys; sys.stderr.write('F0101 no such thing\\n'); sys.stderr.flush(); os.abort()"
    )
    monkeypatch.setattr(
        child.subprocess, "Popen", lambda command, **o: real([sys.executable, "-c", breaks], **o)
    )
    job = mapper.Job([(9, 9)], [(9, 9)], [0], [None], ["a.jpg"], "exhaustive")
    with pytest.raises(child.UserError, match=r"pycolmap stopped .*no such thing.*fewer photos"):
        child.solve(tmp_path, job, lambda *_: None)


# ---- with pycolmap --------------------------------------------------------------------------------


def pose_errors(scene, truth, ids):
    """(degrees, part of the extent) of the worst camera, after the similarity that fits best."""
    fit = umeyama(scene.cameras.centres, truth.centres[ids]).poses(scene.cameras.c2w)
    extent = np.linalg.norm(truth.centres[:, None] - truth.centres[None], axis=-1).max()
    turned = rotation_angle(fit[:, :3, :3], truth.c2w[ids, :3, :3])
    moved = np.linalg.norm(fit[:, :3, 3] - truth.centres[ids], axis=-1) / extent
    return turned.max(), moved.max()


@needs_pycolmap
def test_photos_of_a_room(tmp_path, capsys):
    """From ten rendered photos to the cameras that took them, and to a scene that the readers take."""
    truth = textured_room.walk(VIEWS, HEIGHT, WIDTH)
    photos = tmp_path / "photos"
    for i, picture in enumerate(textured_room.render(truth, HEIGHT, WIDTH)):
        files.save(photos / f"IMG_{i}.jpg", picture, quality=95)
    out = tmp_path / "scene"
    assert pose.cli([str(photos), "--out", str(out)]) == 0, capsys.readouterr().err
    printed = capsys.readouterr().out
    assert f"registered {VIEWS} of {VIEWS} photos" in printed and "sample --scene" in printed
    assert sorted(f.name for f in out.iterdir()) == sorted(
        ["cameras.png", "images", "points.ply", "pose.json", "sparse", "transforms.json"]
    )
    scene = load_scene(out)
    assert scene.names == tuple(f"IMG_{i}.jpg" for i in range(VIEWS))
    degrees, moved = pose_errors(scene, truth, list(range(VIEWS)))
    assert degrees < 0.5 and moved < 0.01
    np.testing.assert_allclose(scene.cameras.K[0, 0, 0], truth.K[0, 0, 0], rtol=0.02)
    assert (scene.cameras.c2w[:, 2, 1] < -0.5).all()  # the photos' down is the world's
    unit = np.linalg.norm(np.ptp(scene.cameras.centres, 0)) / np.linalg.norm(
        np.ptp(truth.centres, 0)
    )
    assert scene.depth(0) == pytest.approx(1.0, rel=0.5)
    assert scene.depth(0) / unit == pytest.approx(3.5, rel=0.4)
    record = json.loads((out / "pose.json").read_text())
    assert record["registered"] == VIEWS and record["reprojection_error"] < 1
    model = load_scene(out / "sparse" / "0")
    np.testing.assert_allclose(model.cameras.c2w, scene.cameras.c2w, atol=1e-9)
    assert len(model.points) == len(scene.points) > 200


@needs_pycolmap
def test_photos_from_one_place_and_photos_of_nothing(tmp_path, capsys):
    still = textured_room.walk(1, HEIGHT, WIDTH)
    from scipy.spatial.transform import Rotation

    turned = np.repeat(still.c2w, 5, 0)
    for i in range(5):
        turned[i, :3, :3] = (
            turned[i, :3, :3] @ Rotation.from_euler("y", 5 * i, degrees=True).as_matrix()
        )
    cameras = still.replace(K=np.repeat(still.K, 5, 0), c2w=turned)
    for i, picture in enumerate(textured_room.render(cameras, HEIGHT, WIDTH)):
        files.save(tmp_path / "tripod" / f"{i}.jpg", picture, quality=95)
    assert pose.cli([str(tmp_path / "tripod"), "--out", str(tmp_path / "scene")]) == 2
    assert "all photos are from one place" in capsys.readouterr().err
    plain = Image.fromarray(np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    (tmp_path / "plain").mkdir()
    for i in range(4):
        plain.save(tmp_path / "plain" / f"{i}.jpg")
    assert pose.cli([str(tmp_path / "plain"), "--out", str(tmp_path / "scene")]) == 2
    assert "4 of 4 photos show almost nothing" in capsys.readouterr().err
    assert not list(tmp_path.glob("scene*"))


@needs_pycolmap
@pytest.mark.slow
def test_a_video_of_a_room(tmp_path, capsys):
    truth = textured_room.walk(60, HEIGHT, WIDTH, spread=50)
    film = np.stack(textured_room.render(truth, HEIGHT, WIDTH))
    video = write_video(tmp_path / "walk.mp4", film, fps=10)
    assert pose.cli([str(video), "--out", str(tmp_path / "scene")]) == 0
    scene = load_scene(tmp_path / "scene")
    ids = [int(name.removesuffix(".jpg")) for name in scene.names]
    assert len(ids) >= 10
    degrees, moved = pose_errors(scene, truth, ids)
    assert degrees < 1.0 and moved < 0.02
