"""The page in a real browser, on the tiny model: looks, roams, edits, makes, downloads, survives a reload and a second viewer.

Needs viser, Playwright and Debian's chromium; skipped without them.
"""

import io
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scene_files import nerfstudio, truth
from test_stretches import weights  # noqa: F401  fixture: the tiny model

from roge_jax import checkpoint, view
from roge_jax.config import preset
from roge_jax.files import entry, video_io
from roge_jax.scenes.paths import read_keys
from roge_jax.scenes.scene import cameras_at, load_scene

CHROMIUM = next((p for p in map(shutil.which, ("chromium", "chromium-browser")) if p), None)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
MOST = 180_000  # milliseconds that anything may take on a busy machine
STATUS = re.compile(r"\d+x\d+ · \d+ ms · photos cover \d+ % of this view")

needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="needs the extra 'viewer'")
needs_browser = pytest.mark.skipif(
    CHROMIUM is None or find_spec("playwright") is None, reason="needs chromium and playwright"
)


# ---- the program ---------------------------------------------------------------------------------


def run(*words):
    return entry.execute(view.main, view.parser(), [str(word) for word in words])


def test_without_viser_it_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert run("motorcycle", "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "pip install 'roge_jax[viewer]'" in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_old_viser_is_refused(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", type(sys)("viser"))
    sys.modules["viser"].__version__ = "0.2.23"
    assert run("motorcycle") == 2
    assert "viser 1.1 or newer, here is 0.2.23" in capsys.readouterr().err


@needs_viser
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nowhere/scene",), "nowhere/scene"),
        (("motorcycle", "--host", "203.0.113.7"), "--host 203.0.113.7"),
        (("motorcycle", "--host", "no such host"), "--host no such host"),
        (("motorcycle", "--trajectory", "spin"), "spin"),
        (("motorcycle", "--out", "/proc/nothing"), "--out /proc/nothing"),
    ],
)
def test_mistakes_are_one_sentence_before_anything_is_served(words, said, capsys, tmp_path):
    given = words if "--out" in words else (*words, "--out", tmp_path)
    assert run(*given) == 2
    assert said in capsys.readouterr().err


def test_it_listens_to_this_machine_alone_unless_told_otherwise():
    assert view.parser().parse_args([]).host == "127.0.0.1"


# ---- the page ------------------------------------------------------------------------------------


@contextmanager
def served(folder: Path):
    """The address of the program, run on the scene and the model in `folder`."""
    command = [sys.executable, "-m", "roge_jax.view", folder / "scene"]
    command += ["--checkpoint", folder / "model", "--out", folder / "out", "--port", "0"]
    log = (folder / "log").open("w+")
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    words = [str(word) for word in command]
    process = subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, env=environment)
    try:
        found, waited = None, threading.Event()
        for _ in range(MOST // 200):
            found = re.search(r"look at (http://127\.0\.0\.1:\d+)", (folder / "log").read_text())
            if found or process.poll() is not None:
                break
            waited.wait(0.2)
        assert found, (folder / "log").read_text()
        yield found[1]
        assert process.poll() is None, (folder / "log").read_text()
    finally:
        process.terminate()
        process.wait(60)
        log.close()


@pytest.fixture(scope="module")
def folder(weights, tmp_path_factory):  # noqa: F811
    place = tmp_path_factory.mktemp("page")
    checkpoint.save_model(place / "model", weights, preset("tiny"), dtype=np.float32)
    nerfstudio(place / "scene", truth(4))
    return place


def pixels(page) -> np.ndarray:
    """What the picture's part of the window shows."""
    from PIL import Image

    shot = page.screenshot(clip={"x": 0, "y": 200, "width": 800, "height": 500}, timeout=MOST)
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def shown(page, wanted, what: str) -> np.ndarray:
    """`pixels` once they are as `wanted` and stay as they are: pictures come when they come, and the page fades in."""
    before = pixels(page)
    for _ in range(MOST // 500):
        page.wait_for_timeout(500)
        found = pixels(page)
        if wanted(found) and np.abs(found - before).mean() < 0.2:
            return found
        before = found
    raise AssertionError(f"{what}: {found.mean():.1f} +- {found.std():.1f}")


def box(page, label: str):
    """The input beside a label."""
    return page.get_by_label(label, exact=True)


def saved(page, press) -> tuple[str, bytes]:
    """(name, content) of what the browser downloads after a press."""
    with page.expect_download(timeout=MOST) as found:
        press()
    return found.value.suggested_filename, Path(found.value.path()).read_bytes()


@needs_viser
@needs_browser
def test_one_looks_roams_edits_makes_and_downloads(folder, tmp_path):
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=MOST)
    with served(folder) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch_persistent_context(
            tmp_path / "profile",
            executable_path=CHROMIUM,
            args=list(FLAGS),
            viewport={"width": 1280, "height": 720},
            accept_downloads=True,
        )
        page = browser.new_page()
        page.set_default_timeout(MOST)
        page.goto(address)

        # It shows a picture.
        status = page.get_by_text(STATUS)
        expect(status).to_be_visible()

        # Another from elsewhere; without the photos, which move as well.
        box(page, "Cameras").uncheck()
        at_first = shown(page, lambda found: found.std() > 6, "an empty page is white")
        before = status.inner_text()
        page.mouse.move(400, 400)
        page.mouse.down()
        for i in range(8):
            page.mouse.move(400 + 8 * i, 400)
            page.wait_for_timeout(50)
        page.mouse.up()
        expect(status).not_to_have_text(before)
        shown(page, lambda found: np.abs(found - at_first).mean() > 2, "the same picture")

        # Key frames: two, then other times and another angle.
        press = page.get_by_role("button", name="Add key frame here")
        press.click()
        expect(page.get_by_text("1 frames, 0.06 s")).to_be_visible()
        box(page, "Stand at photo").click()
        page.get_by_role("option", name="0002.png").click()
        page.wait_for_timeout(500)
        press.click()
        expect(page.get_by_text("17 frames, 1.06 s")).to_be_visible()
        box(page, "Seconds to it").fill("0.25")
        expect(page.get_by_text("5 frames, 0.31 s")).to_be_visible()
        box(page, "Its field of view").fill("50")
        page.wait_for_timeout(500)

        # The path as a file.
        name, content = saved(page, page.get_by_role("button", name="download").first.click)
        assert name == "path.json"
        (tmp_path / "path.json").write_bytes(content)
        scene = load_scene(folder / "scene")
        context = cameras_at(scene, 32, 48)
        keys = read_keys(tmp_path / "path.json", height=32, width=48, context=context)
        assert len(keys.cameras) == 2 and keys.times.tolist() == [0.0, 0.25]
        np.testing.assert_allclose(keys.cameras.c2w[1], scene.cameras.c2w[2], atol=1e-5)
        angle = 2 * np.degrees(np.arctan(16 / keys.cameras.K[1, 1, 1]))
        assert angle == pytest.approx(50.0)

        # A video of it.
        page.get_by_role("button", name="generate").click()
        expect(page.get_by_text("done: video-001")).to_be_visible()
        said = json.loads((folder / "out" / "video-001" / "run.json").read_text())
        assert said["frames"] == 5 and said["generated"] is True
        name, content = saved(page, page.get_by_role("button", name="download").last.click)
        assert name == "video-001.mp4"
        assert content == (folder / "out" / "video-001" / "video.mp4").read_bytes()
        page.get_by_role("button", name="play").click()
        played = page.locator("video")
        page.wait_for_function("() => document.querySelector('video')?.readyState >= 2")
        assert played.evaluate("v => v.videoWidth") >= 3 * 48
        page.get_by_role("button", name="Close").click()
        expect(played).to_have_count(0)

        # A reload keeps it, a second viewer shares it, and both are shown pictures.
        page.reload()
        expect(page.get_by_text("5 frames, 0.31 s")).to_be_visible()
        expect(status).to_be_visible()
        other = browser.new_page()
        other.set_default_timeout(MOST)
        other.goto(address)
        expect(other.get_by_text(STATUS)).to_be_visible()
        expect(other.get_by_text("5 frames, 0.31 s")).to_be_visible()
        box(other, "Seconds to it").fill("0.5")
        expect(page.get_by_text("9 frames, 0.56 s")).to_be_visible()
        other.close()
        before = status.inner_text()
        box(page, "Stand at photo").click()
        page.get_by_role("option", name="0003.png").click()
        expect(status).not_to_have_text(before)
        browser.close()
    beside = video_io.read_video(folder / "out" / "video-001" / "side_by_side.mp4")
    assert len(beside) == 5
    assert sorted(p.name for p in folder.iterdir()) == ["log", "model", "out", "scene"]
    assert sorted(p.name for p in (folder / "out").iterdir()) == ["paths", "video-001"]
