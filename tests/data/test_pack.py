"""Scene folders become a pool that training reads: pixels, K and poses where they belong."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scene_files import HEIGHT, WIDTH, nerfstudio, picture, save, truth

from roge_jax.data.collect import collect, divide
from roge_jax.data.dataset import read_dataset
from roge_jax.data.pack import main, pack
from roge_jax.data.shard import runs, walk_order
from roge_jax.data.source import open_source
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras
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


def test_a_scene_that_fails_costs_no_other(scene, tmp_path, capsys):
    """Missing, too short, or with a photo that ends early: named with its reason and counted."""
    short, torn = nerfstudio(tmp_path / "short", truth(3)), nerfstudio(tmp_path / "torn", truth(4))
    photo = torn / "images" / "0002.png"
    photo.write_bytes(photo.read_bytes()[: photo.stat().st_size // 2])
    out = tmp_path / "p"
    words = [str(tmp_path / "gone"), str(torn), str(short), str(scene), "--out", str(out)]
    words += ["--frames", "4", "--processes", "1"]
    assert main(words) == 0
    said = capsys.readouterr()
    assert "2 sequences of 1 scenes; 3 left out" in said.out
    for reason in ("gone: there is no such scene", "0002.png: damaged", "has 3 views, a sequence"):
        assert sum(reason in line for line in said.err.splitlines()) == 1
    assert len(json.loads((out / "pool.json").read_text())["failed"]) == 3
    np.testing.assert_allclose(read_dataset(out)[0]["c2w"], truth(5).c2w[:4], atol=1e-9)
    assert main([*words, "--strict"]) == 2
    assert "3 of 4 scenes could not be packed" in capsys.readouterr().err
    save(photo, picture(2))
    assert main(words) == 0 and len(read_dataset(out)) == 2  # those that failed are not tried
    assert main([*words, "--retry"]) == 0 and len(read_dataset(out)) == 3


def test_nothing_packed_is_an_error_and_leaves_nothing(scene, tmp_path, capsys):
    words = [str(tmp_path / "gone"), str(tmp_path / "lost"), "--out", str(tmp_path / "p")]
    assert main([*words, "--processes", "1"]) == 2
    assert "None of 2 scenes could be packed, the first because: " in capsys.readouterr().err
    assert not list(tmp_path.glob("p*"))
    assert main([str(scene), "--out", str(tmp_path / "p"), "--frames", "0"]) == 2
    assert "'0' is not a whole number of at least 1" in capsys.readouterr().err


def test_a_repeated_call_goes_on(scene, tmp_path, capsys):
    """What is finished is not touched, what is missing or damaged is written, new scenes are added."""
    scenes = [scene, *(nerfstudio(tmp_path / f"s{i}", truth(4)) for i in range(3))]
    out, size = tmp_path / "pool", {"frames": 4, "height": 12, "width": 20}
    assert pack(scenes[:3], out, **size) == 4
    times = {file.name: file.stat().st_mtime_ns for file in out.glob("shard_*")}
    whole = {file.name: file.read_bytes() for file in out.glob("shard_*")}
    (out / "shard_00001.npz").write_bytes(b"torn")
    (out / "shard_00002.npz").unlink()
    assert pack(scenes, out, **size) == 5
    assert "1 of 4 shards are there and stay" in capsys.readouterr().out
    assert (out / "shard_00000.npz").stat().st_mtime_ns == times["shard_00000.npz"]
    for name, content in whole.items():
        if name.endswith(".npy"):
            assert (out / name).read_bytes() == content
    assert len(read_dataset(out)) == 5
    with pytest.raises(UserError, match=r"holds a dataset with frames 4 \(asked: 3\)"):
        pack(scenes, out, frames=3, height=12, width=20)


def test_processes_write_the_same(scene, tmp_path):
    scenes = [scene, nerfstudio(tmp_path / "other", truth(4)), tmp_path / "gone"]
    size = {"frames": 4, "height": 12, "width": 20}
    assert pack(scenes, tmp_path / "one", **size) == 3
    assert pack(scenes, tmp_path / "two", **size, processes=2) == 3
    for file in (tmp_path / "one").glob("shard_*.npy"):
        assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes()


def test_shorter_scenes_keep_their_length(scene, tmp_path):
    """Stages that train on single views draw from them, those that make videos do not."""
    short = nerfstudio(tmp_path / "short", truth(3))
    out = tmp_path / "pool"
    assert pack([short, scene], out, frames=5, height=12, width=20, shortest=3) == 2
    assert [len(read_dataset(out)[i]["rgb"]) for i in range(2)] == [3, 5]
    np.testing.assert_allclose(read_dataset(out)[0]["c2w"], truth(3).c2w, atol=1e-9)
    assert len(open_source(out, 12, 20, 3)) == 2
    found = open_source(out, 12, 20, 4)
    assert len(found) == 1 and len(found[0]["K"]) == 5
    with pytest.raises(UserError, match="have 5 frames and this stage trains on chunks of 6"):
        open_source(out, 12, 20, 6)


def test_order_by_name_file_and_path(tmp_path):
    """A shuffled walk with names that say nothing is found again from the poses alone."""
    walk = load_scene(nerfstudio(tmp_path / "walk", truth(12)))
    c2w = np.tile(np.eye(4), (12, 1, 1))
    c2w[:, 0, 3] = np.arange(12)
    order = np.random.default_rng(0).permutation(12)
    mixed = dataclasses.replace(
        walk,
        cameras=Cameras(walk.cameras.K, c2w[order]),
        names=tuple("cdeabfghiklm"),
        images=[picture(i) for i in range(12)],
    )
    way = c2w[order][walk_order(mixed, "path"), 0, 3]
    assert list(way) in (list(range(12)), list(range(11, -1, -1)))
    assert walk_order(mixed, "file") == list(range(12))
    assert walk_order(mixed, "name") == [3, 4, 0, 1, 2, *range(5, 12)]


def test_folders_of_scenes_stand_for_all_of_them(tmp_path):
    """DL3DV's batches, RealEstate10K's texts beside frames, CUT3R's folders, chunks."""
    places = [
        "dl3dv/1K/aa/transforms.json",
        "dl3dv/1K/bb/transforms.json",
        "dl3dv/2K/cc/transforms.json",
    ]
    places += [
        "cut3r/one/cam/0.npz",
        "cut3r/two/cam/0.npz",
        "chunks/000001.torch",
        "chunks/000000.torch",
    ]
    for place in places:
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).touch()
    for name in ("a", "b"):
        (tmp_path / "re10k").mkdir(exist_ok=True)
        (tmp_path / "re10k" / f"{name}.txt").write_text("http\n" + f"{'1 ' * 19}\n" * 3)
    given = [tmp_path / name for name in ("dl3dv", "cut3r", "chunks", "re10k", "gone")]
    found = [str(Path(name).relative_to(tmp_path)) for name in collect(given)]
    assert found == [
        *("dl3dv/1K/aa", "dl3dv/1K/bb", "dl3dv/2K/cc", "cut3r/one", "cut3r/two"),
        *("chunks/000000.torch", "chunks/000001.torch", "re10k/a.txt", "re10k/b.txt", "gone"),
    ]
    many = [f"s{i}" for i in range(5000)]
    shards = divide(["a.torch", *many])
    assert [name for names in shards for name in names] == ["a.torch", *many]
    assert len(shards) <= 2001 and shards[0] == ["a.torch"]


@pytest.mark.parametrize("shuffled", [True, False])
def test_runs_follow_the_walk(tmp_path, capsys, shuffled):
    """Photos listed in another order than they were taken in: sequences are consecutive all the same, and it is told."""
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
