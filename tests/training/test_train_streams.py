"""Training takes leaves one by one from the files: what it holds, what it never reads, what it writes."""

import dataclasses
import tracemalloc
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from train_runs import run, same, write_dataset

from roge_jax import checkpoint, config, cost, model
from roge_jax.checkpoint import load_model, open_model, save_model
from roge_jax.core import lora
from roge_jax.core.params import Drawn, count, drawn, flatten, init, unflatten
from roge_jax.errors import UserError
from roge_jax.training import loop, stages
from roge_jax.weights.sources import Stored


@pytest.fixture
def start(common, tmp_path):
    """The model that `tiny` is here, random, in bfloat16; with the pool in `tmp_path / "pool"`."""
    cfg = config.preset("tiny")
    write_dataset(tmp_path / "pool", (32, 48))
    save_model(tmp_path / "start", model.init(jax.random.key(3), cfg), cfg)
    return tmp_path / "start"


def options(common, start):
    words = [*common, "--init", start, "--data", start.parent / "pool", "--batch", 1]
    return [*words, "--steps", 1, "--frozen-dtype", "bfloat16"]


def stage_of(name: str):
    frames = config.preset("tiny").frames
    recipe = [*stages.mini_stages(frames=frames), stages.lora_stage(1, frames=frames)]
    return stages.find_stage(recipe, name)


@pytest.mark.parametrize("name", ["vae_decoder", "recon_low", "lora"])
def test_a_step_begins_with_what_the_stage_trains_and_reads(
    name, common, cheap, start, tmp_path, monkeypatch
):
    """All arrays that are alive are what trains, in float32, and what the objective reads, in its final type; nothing
    else was read but the blocks that the fingerprint is made of."""
    cfg, begin = config.preset("tiny"), loop.train
    trained, frozen = stages.stage_specs(cfg, stage_of(name))
    kept = [
        s.shape and (4 if cost.keeps_float32(p) else 2) * count({p: s})
        for p, s in flatten(frozen).items()
    ]
    placed, seen = Counter(), []
    place, before = checkpoint._placed, {id(x) for x in jax.live_arrays()}

    def spied_place(path, leaf, *rest):
        placed[leaf] += 1
        return place(path, leaf, *rest)

    def spied_train(*arguments, **more):
        seen.append(sum(x.nbytes for x in jax.live_arrays() if id(x) not in before))
        return begin(*arguments, **more)

    monkeypatch.setattr(checkpoint, "_placed", spied_place)
    monkeypatch.setattr(loop, "train", spied_train)
    run(*options(common, start), "--stage", name, "--out", tmp_path / "out")
    assert seen == [4 * count(trained) + sum(kept)]
    found = flatten(open_model(start)[0])
    read = [path for path in (*flatten(trained), *flatten(frozen)) if path in found]
    assert placed == Counter(found[path] for path in read)
    assert seen[0] < 0.9 * 4 * count(model.specs(cfg)), "less than the model in float32"
    saved, _ = load_model(tmp_path / "out" / name / "model")
    untouched = flatten(model.specs(cfg)).keys() - flatten(trained).keys()
    untouched = {p for p in untouched if p.replace("/kernel", "/lora_a") not in flatten(trained)}
    for path, leaf in flatten(load_model(start)[0]).items():
        assert np.array_equal(flatten(saved)[path], leaf) == (path in untouched), path


def test_a_start_that_changes_under_a_run_is_not_mixed_into_its_model(
    common, cheap, start, tmp_path, monkeypatch
):
    cfg, begin = config.preset("tiny"), loop.train
    before = load_model(start)[0]

    def meanwhile(change):
        def train(*arguments, **more):
            state = begin(*arguments, **more)
            change()
            return state

        monkeypatch.setattr(loop, "train", train)

    def other():
        save_model(start, model.init(jax.random.key(4), cfg), cfg)

    given = [*options(common, start), "--out", tmp_path / "out"]
    meanwhile(other)
    with pytest.raises(
        UserError, match="has changed since: put it back and continue with --resume"
    ):
        run(*given)
    save_model(start, before, cfg)
    meanwhile(lambda: start.rename(tmp_path / "away"))
    with pytest.raises(UserError, match=r"cannot be read .*: put it back and continue"):
        run(*given, "--resume")
    (tmp_path / "away").rename(start)
    meanwhile(lambda: None)
    run(*given, "--resume")
    run(*given[:-1], tmp_path / "undisturbed")
    a, b = (load_model(tmp_path / name / "lora/model")[0] for name in ("out", "undisturbed"))
    assert same(a, b)


class TestWriting:
    def wide(self):
        cfg = config.preset("tiny")
        transformer = dataclasses.replace(cfg.dit, width=256, heads=4, depth=8, ffn=1024)
        return dataclasses.replace(cfg, dit=transformer)

    def test_files_are_those_of_the_safetensors_library(self, tmp_path, monkeypatch):
        from safetensors.flax import save

        cfg = config.preset("tiny")
        params = model.init(jax.random.key(1), cfg)
        monkeypatch.setattr(checkpoint, "SHARD_BYTES", 300_000)
        monkeypatch.setattr(checkpoint, "PIECE_BYTES", 1000)
        for dtype in (jnp.bfloat16, jnp.float32):
            save_model(tmp_path / "m", params, cfg, dtype=dtype)
            shards, size = [{}], 0
            for path, leaf in flatten(params).items():
                leaf = leaf.astype(dtype)
                if size and size + leaf.nbytes > 300_000:
                    shards.append({})
                    size = 0
                shards[-1][path] = leaf
                size += leaf.nbytes
            files = sorted((tmp_path / "m").glob("*.safetensors"))
            assert len(files) == len(shards) > 3
            for file, shard in zip(files, shards, strict=True):
                assert file.read_bytes() == save(shard), file.name

    def test_lora_is_merged_on_the_way_as_in_memory(self, tmp_path):
        cfg = config.preset("tiny")
        params = model.init(jax.random.key(1), cfg)
        save_model(tmp_path / "base", params, cfg)
        base, _ = load_model(tmp_path / "base")
        factors = model.adapter_specs(cfg)
        rng = np.random.default_rng(0)
        factors = {p: rng.standard_normal(s.shape, np.float32) for p, s in flatten(factors).items()}
        assert {x.ndim for x in factors.values()} == {2, 3}, "single layers and stacks"
        want = lora.merge(base, unflatten(factors))
        opened, _ = open_model(tmp_path / "base")
        options = {"dtype": jnp.float32, "lora": unflatten(factors)}
        save_model(tmp_path / "merged", opened, cfg, **options)
        assert same(load_model(tmp_path / "merged")[0], want)
        assert not same(base, want, "dit")

    def test_memory_holds_a_layer_not_the_model(self, tmp_path, monkeypatch):
        """From file to file, with factors, in NumPy's own memory."""
        cfg = self.wide()
        specs = flatten(model.specs(cfg))
        save_model(tmp_path / "base", drawn(jax.random.key(0), model.specs(cfg)), cfg)
        opened, _ = open_model(tmp_path / "base")
        factors = init(jax.random.key(1), model.adapter_specs(cfg))
        monkeypatch.setattr(checkpoint, "PIECE_BYTES", 1_000_000)
        tracemalloc.start()
        save_model(tmp_path / "copy", opened, cfg, dtype=jnp.float32, lora=factors)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        layer = max(
            4 * count({p: s}) // s.shape[0] for p, s in specs.items() if p.startswith("dit/blocks")
        )
        assert peak < 3e6 + 3 * layer < 4 * count(specs) / 5


def test_initial_values_are_drawn_when_they_are_asked_for():
    cfg, key = config.preset("tiny"), jax.random.key(5)
    lazy = flatten(model.init(key, cfg, make=drawn))
    assert {type(x) for p, x in lazy.items() if not p.startswith("vae/")} == {Drawn}
    for path, leaf in flatten(model.init(key, cfg)).items():
        assert lazy[path].shape == leaf.shape and lazy[path].dtype == leaf.dtype
        np.testing.assert_array_equal(np.asarray(lazy[path]), leaf)


def test_a_stored_tensor_is_an_array_to_numpy(tmp_path):
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    values.tofile(tmp_path / "x")
    for strides, want in ((None, values), ((1, 2), values.reshape(3, 2).T)):
        stored = Stored(tmp_path / "x", 0, (2, 3), np.dtype(np.float32), strides)
        np.testing.assert_array_equal(np.asarray(stored), want)
        assert not np.asarray(stored).flags.writeable
        assert np.asarray(stored, np.float16).dtype == np.float16
        assert np.array(stored).flags.writeable
