"""The comparison of found poses with held-back ones: errors of cameras that are known to be wrong, the page's table."""

import json

import numpy as np
import pytest
import scene_files as files

from experiments import harness
from experiments.quality import pose
from roge_jax.data import faults
from roge_jax.geometry.cameras import Cameras
from roge_jax.scenes.scene import load_scene

TRUTH = files.truth()


def test_errors_do_not_depend_on_the_world_and_see_what_is_wrong(tmp_path):
    truth = load_scene(files.nerfstudio(tmp_path / "a", TRUTH))
    moved = TRUTH.c2w.copy()
    moved[:, :3, 3] *= 7.0  # another unit
    found = load_scene(files.nerfstudio(tmp_path / "b", Cameras(TRUTH.K, moved)))
    none = pose.errors(found, truth)
    assert none["rotation_degrees"]["worst"] < 1e-5 and none["translation"]["worst"] < 1e-7
    assert none["focal_ratio"] == pytest.approx(1.0)
    turned = faults.turn_cameras(TRUTH, 2.0, np.random.default_rng(0))
    found = load_scene(files.nerfstudio(tmp_path / "c", turned))
    wrong = pose.errors(found, truth)
    assert 1.0 < wrong["rotation_degrees"]["worst"] < 6.0 and wrong["translation"]["worst"] < 1e-7


def test_photos_are_copied_without_their_poses(tmp_path):
    truth = load_scene(files.nerfstudio(tmp_path / "a", TRUTH))
    assert pose.copy_photos(truth, tmp_path / "photos", 3) == [0, 2, 3]
    assert sorted(f.name for f in (tmp_path / "photos").iterdir()) == [
        "0000.png",
        "0002.png",
        "0003.png",
    ]


def test_the_page_has_the_stored_numbers():
    stored = harness.read(pose.RESULT)
    assert pose.table(stored) in pose.PAGE.read_text()
    assert "/root" not in json.dumps(stored) and "/work" not in json.dumps(stored)
    rows = pose.table({"scenes": {"a": {"scene": "a", "photos": 9, "registered": 0}}}).splitlines()
    assert rows[-1].startswith("| a | 9 | 0 |") and rows[-1].count("|") == rows[0].count("|")
