"""Scene folders become a pool that training reads: pixels, K and poses where they belong."""

import numpy as np
import pytest
from scene_files import HEIGHT, WIDTH, nerfstudio, truth

from roge_jax.data.dataset import read_dataset
from roge_jax.data.pack import main, pack, runs
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import UserError
from roge_jax.scenes.scene import load_scene, prepare


@pytest.fixture
def scene(tmp_path):
    return nerfstudio(tmp_path / "scene", truth(5))


@pytest.mark.parametrize(
    ("views", "frames", "starts"), [(5, 5, [0]), (5, 4, [0, 1]), (24, 8, [0, 4, 8, 12, 16])]
)
def test_runs_cover_all_views(views, frames, starts):
    assert runs(views, frames) == starts


def test_pool_holds_the_views_of_the_scene(scene, tmp_path):
    other = nerfstudio(tmp_path / "other", truth(4))
    height, width = HEIGHT // 2, WIDTH // 2
    assert pack([scene, other], tmp_path / "pool", frames=4, height=height, width=width) == 3
    pool = read_dataset(tmp_path / "pool")
    assert len(pool) == 3
    images, cameras = prepare(load_scene(scene), range(1, 5), height, width)
    np.testing.assert_allclose(pool[1]["rgb"] / 255.0, images, atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(pool[1]["K"], cameras.K)
    np.testing.assert_array_equal(pool[1]["c2w"], cameras.c2w)
    views = ViewConfig(contexts=(2,), context_weights=(1.0,), targets=3, ordered=True)
    batch = draw_batch(pool, 0, 0, 2, views, scale_rule="lagernvs")
    assert batch["context_rgb"].shape == (2, 2, height, width, 3)
    assert batch["target_rgb"].shape == (2, 3, height, width, 3)


def test_mistakes_are_named(scene, tmp_path, capsys):
    with pytest.raises(UserError, match=r"scene: has 5 views, a sequence needs 24"):
        pack([scene], tmp_path / "short")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    assert main([str(scene), "--out", str(tmp_path / "full"), "--frames", "4"]) == 2
    assert "full is not empty: give a new folder." in capsys.readouterr().err


def test_a_scene_that_fails_leaves_nothing(scene, tmp_path, capsys):
    """The first scene is written before the second turns out to be missing."""
    words = [str(scene), str(tmp_path / "gone"), "--out", str(tmp_path / "p"), "--frames", "4"]
    assert main(words) == 2
    assert "gone: there is no such scene" in capsys.readouterr().err
    assert not list(tmp_path.glob("p*"))
    assert main([str(scene), "--out", str(tmp_path / "p"), "--frames", "0"]) == 2
    assert "'0' is not a whole number of at least 1" in capsys.readouterr().err


@pytest.mark.parametrize("shuffled", [True, False])
def test_runs_follow_the_walk(tmp_path, capsys, shuffled):
    """Photos listed in another order than they were taken in: sequences are consecutive all the same, and it is told."""
    import json

    folder = nerfstudio(tmp_path / "scene", truth(12))
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    order = np.random.default_rng(0).permutation(12) if shuffled else np.arange(12)
    content["frames"] = [content["frames"][i] for i in order]
    file.write_text(json.dumps(content))
    assert pack([folder], tmp_path / "pool", frames=12, height=12, width=20) == 1
    pool = read_dataset(tmp_path / "pool")
    np.testing.assert_allclose(pool[0]["c2w"], truth(12).c2w, atol=1e-9)
    walk = load_scene(nerfstudio(tmp_path / "walk", truth(12)))
    images, cameras = prepare(walk, range(12), 12, 20)
    np.testing.assert_allclose(pool[0]["rgb"] / 255.0, images, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(pool[0]["K"], cameras.K)
    assert ("in the order of their names" in capsys.readouterr().out) == shuffled
