"""What the options say about photos and path: names, frame rate, axes and coordinates of a path file."""

import json
import warnings

import layout_files as more
import numpy as np
import pytest
import scene_files as files
from scene_files import HEIGHT, WIDTH, truth

from roge_jax import sample
from roge_jax.config import preset
from roge_jax.errors import UserError
from roge_jax.files.entry import parse
from roge_jax.geometry.cameras import Cameras, CameraWarning
from roge_jax.sampling import Settings, inputs
from roge_jax.scenes.paths import save_path
from roge_jax.scenes.scene import load_scene

CONFIG = preset("tiny")
CAMERAS = truth()


def arguments(*words):
    return parse(sample.parser(), [str(word) for word in words])


def read(*words):
    args = arguments(*words)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CameraWarning)
        found = inputs.read_inputs(args, CONFIG, Settings().of(CONFIG))
    return args, *found


@pytest.mark.parametrize(("words", "rate"), [([], 30.0), (["--fps", "12"], 12.0)])
def test_frame_rate_of_a_path_file(tmp_path, words, rate):
    folder = files.nerfstudio(tmp_path / "s", CAMERAS)
    save_path(tmp_path / "p.json", CAMERAS, HEIGHT, WIDTH, fps=30)
    args, *_ = read("--scene", folder, "--trajectory", tmp_path / "p.json", *words)
    assert args.fps == rate
    args, *_ = read("--scene", folder, *words)  # a preset says none
    assert args.fps == (rate if words else 16.0)


def test_convention_reaches_the_path_and_is_told(tmp_path, capsys):
    folder = files.nerfstudio(tmp_path, CAMERAS)
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    for entry, pose in zip(content["frames"], CAMERAS.c2w, strict=True):
        entry["transform_matrix"] = pose.tolist()
    file.write_text(json.dumps(content))
    words = ("--scene", folder, "--convention", "opencv", "--trajectory")
    for place in (file, folder):
        _, scene, _, path = read(*words, place)
        np.testing.assert_allclose(path.c2w, scene.cameras.c2w, atol=1e-9)
        assert capsys.readouterr().err.count("its poses are read as opencv") == 1
    save_path(tmp_path / "own.json", CAMERAS, HEIGHT, WIDTH)
    _, _, _, path = read(*words, tmp_path / "own.json")
    np.testing.assert_allclose(path.c2w, CAMERAS.c2w, atol=1e-9)
    assert "own.json: --convention is not used" not in capsys.readouterr().err


def test_a_path_that_sees_nothing_is_a_question(tmp_path):
    """In other axes, far away: refused with the cure; taken as it is if the user insists."""
    folder = files.nerfstudio(tmp_path / "s", CAMERAS)
    away = Cameras(CAMERAS.K, CAMERAS.c2w @ np.diag([1.0, -1, -1, 1]))
    far = Cameras(CAMERAS.K, CAMERAS.c2w.copy())
    far.c2w[:, :3, 3] = 1e4 + 100 * far.c2w[:, :3, 3]
    for cameras in (away, far):
        save_path(tmp_path / "p.json", cameras, HEIGHT, WIDTH)
        words = ("--scene", folder, "--trajectory", tmp_path / "p.json")
        with pytest.raises(UserError, match=r"looks at nothing that the photos see.*--path-frame"):
            read(*words)
        assert len(read(*words, "--path-frame", "scene")[3]) == 4
    save_path(tmp_path / "p.json", CAMERAS, HEIGHT, WIDTH)
    assert len(read(*words)[3]) == 4


def test_a_relative_path_starts_at_the_photo_that_leads(tmp_path):
    folder = files.nerfstudio(tmp_path / "s", CAMERAS)
    save_path(tmp_path / "p.json", CAMERAS, HEIGHT, WIDTH)
    words = ("--scene", folder, "--trajectory", tmp_path / "p.json", "--path-frame", "first")
    for context, leader in ((None, 0), ("2", 0), ("0002.png,0001.png", 2), ("3,1", 3)):
        more_words = [] if context is None else ["--context", context]
        _, _, photos, path = read(*words, *more_words)
        np.testing.assert_allclose(path.c2w[0], CAMERAS.c2w[leader], atol=1e-9)
        if context is not None and "," in context:
            assert photos.ids[0] == leader
    with pytest.raises(UserError, match="--path-frame first is for path files"):
        read("--scene", folder, "--path-frame", "first")


@pytest.mark.parametrize(
    ("context", "ids"),
    [
        ("right/0.png,left/1.png", (2, 1)),
        ("images/right/1.png,0", (3, 0)),
        ("right/1.png", (3,)),
        ("1,2", (1, 2)),
    ],
)
def test_photos_of_a_rig_are_addressed_by_their_folder(tmp_path, context, ids):
    folder = more.colmap_rig(tmp_path, CAMERAS)
    assert read("--scene", folder, "--context", context)[2].ids == ids
    with pytest.raises(UserError, match=r"'0.png' could be 2 photos"):
        read("--scene", folder, "--context", "0.png,1.png")


def test_names_with_commas(tmp_path):
    folder = files.nerfstudio(tmp_path, CAMERAS)
    file = folder / "transforms.json"
    file.write_text(file.read_text().replace("0001.png", "a, b.png").replace("0002.png", "a"))
    (folder / "images" / "0001.png").rename(folder / "images" / "a, b.png")
    (folder / "images" / "0002.png").rename(folder / "images" / "a.png")
    scene = load_scene(folder)
    assert inputs.addressed("a, b.png,0003.png", scene) == "1,0003.png"
    assert inputs.addressed("a, b.png", scene) == "1," and inputs.addressed("2,", scene) == "2,"
    assert inputs.addressed("0000.png,a.png", scene) == "0000.png,a.png"
    assert inputs.addressed("4", scene) == "4" and inputs.addressed(None, scene) is None
