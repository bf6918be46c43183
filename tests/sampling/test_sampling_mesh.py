"""One video on many devices is the video of one device; weights go from the file straight to where they lie."""

import dataclasses
import math
import re
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_sharding import drawn, small

from roge_jax import checkpoint, cost, model, sample, sampling
from roge_jax.checkpoint import find_model, load_config, load_model, save_model
from roge_jax.core import memory, params, sharding
from roge_jax.core.params import abstract, flatten
from roge_jax.errors import UserError
from roge_jax.files import entry
from roge_jax.geometry.cameras import Cameras


def cameras(n: int, cfg, step: float) -> Cameras:
    K = np.array([[40.0, 0, cfg.width / 2], [0, 40.0, cfg.height / 2], [0, 0, 1]])
    c2w = np.tile(np.eye(4), (n, 1, 1))
    c2w[:, 0, 3] = step * np.arange(n)
    return Cameras(np.tile(K, (n, 1, 1)), c2w)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    cfg = dataclasses.replace(small(), frames=1)
    folder = tmp_path_factory.mktemp("model") / "m"
    save_model(folder, drawn(model.specs(cfg), 1), cfg, dtype=jnp.float32)
    return folder, cfg


def test_sampling_on_a_mesh_equals_one_device(saved):
    """fsdp=2, seq=2: weights loaded in shares, tokens and views split; frames and preview to rounding."""
    folder, cfg = saved
    photos = sampling.Photos(
        np.random.default_rng(0).random((2, cfg.height, cfg.width, 3), np.float32),
        None,
        cameras(2, cfg, 1.0),
        (0, 1),
    )
    path, settings = cameras(1, cfg, 0.2), sampling.Settings(steps=2, solver="euler")

    def run(mesh):
        where = None if mesh is None else sharding.shardings(model.specs(cfg), mesh)
        weights, _ = load_model(folder, shardings=where)
        with sharding.use(mesh):
            result = sampling.sample(weights, cfg, photos, path, settings)
        return result.frames, result.preview

    one = run(None)
    four = run(sharding.make_mesh(1, 2, 2, devices=jax.devices()[:4]))
    for a, b in zip(one, four):
        assert a.std() > 1e-3, "a picture, not a constant"
        np.testing.assert_allclose(b, a, atol=2e-5)


class TestLoading:
    def test_every_leaf_arrives_where_it_belongs(self, saved):
        folder, cfg = saved
        mesh, specs = sharding.make_mesh(1, 4, 2), model.specs(cfg)
        where = flatten(sharding.shardings(specs, mesh))
        whole, _ = load_model(folder)
        shared, _ = load_model(folder, shardings=sharding.shardings(specs, mesh))
        written = flatten(drawn(specs, 1))
        assert any(not s.is_fully_replicated for s in where.values())
        for name, x in flatten(shared).items():
            assert x.sharding == where[name], name
            np.testing.assert_array_equal(np.asarray(x), written[name], err_msg=name)
            np.testing.assert_array_equal(flatten(whole)[name], written[name], err_msg=name)

    def test_types(self, saved):
        folder, cfg = saved
        half, _ = load_model(folder, dtype=lambda p: "float32" if "norm" in p else "bfloat16")
        written = flatten(drawn(model.specs(cfg), 1))
        for name, x in flatten(half).items():
            assert x.dtype == (jnp.float32 if "norm" in name else jnp.bfloat16), name
            np.testing.assert_array_equal(
                np.asarray(x), written[name].astype(x.dtype), err_msg=name
            )
        assert {x.dtype for x in jax.tree.leaves(load_model(folder, dtype=None)[0])} == {
            np.dtype(np.float32)
        }

    def test_host_memory_holds_one_leaf(self):
        """NumPy's memory beside the arrays themselves (a CPU takes them over) while the shipped model loads."""
        mesh, config = sharding.make_mesh(1, 4, 2), load_config(find_model("mini"))
        where = sharding.shardings(model.specs(config), mesh)
        sizes = [4 * x.size for x in jax.tree.leaves(abstract(model.specs(config)))]
        tracemalloc.start()
        loaded, _ = load_model("mini", shardings=where)
        kept, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(jax.tree.leaves(loaded)) == len(sizes)
        assert peak - kept < max(sizes) + 2e6 < sum(sizes) / 4

    def test_weights_that_memory_does_not_hold_are_refused_before_one_is_read(
        self, saved, monkeypatch
    ):
        folder, cfg = saved
        mesh = sharding.make_mesh(1, 2, 2, devices=jax.devices()[:4])
        specs = model.specs(cfg)
        where = sharding.shardings(specs, mesh)
        whole = 4.0 * sum(math.prod(s.shape) for s in flatten(specs).values())
        share = cost.held_weights(cfg, mesh, "float32")
        assert share < 0.9 * whole
        read = []
        monkeypatch.setattr(checkpoint, "_placed", lambda *_: read.append(1))
        half = {"dtype": lambda path: "bfloat16" if path.startswith("dit/") else "float32"}
        saved_by_half = 2.0 * params.count(specs["dit"])
        # A host holds all of them once, a device with memory of its own its share.
        for name, least, given, cure in (
            ("memory_available", whole - saved_by_half, half, "close other programs"),
            ("memory_available", whole, {}, "close other programs"),
            ("memory_available", whole, {"shardings": where}, "close other programs"),
            ("own_memory", whole, {}, "fsdp=N"),
            ("own_memory", share, {"shardings": where}, "fsdp=N"),
        ):
            for room, fits in ((least, True), (least - 1.0, False)):
                with monkeypatch.context() as patched:
                    patched.setattr(memory, name, lambda *_, room=room: room)
                    if fits:
                        load_model(folder, **given)
                        assert read
                    else:
                        with pytest.raises(UserError, match=f"GB, for weights alone: .*{cure}"):
                            load_model(folder, **given)
                        assert not read
                read.clear()

    def test_a_misshapen_model_is_refused_before_it_is_read(self, saved, tmp_path):
        _, cfg = saved
        wrong = drawn(model.specs(cfg), 1)
        wrong["dit"]["patch_embed"]["bias"] = np.zeros(3, np.float32)
        save_model(tmp_path / "w", wrong, cfg)
        with pytest.raises(UserError, match="patch_embed/bias has shape"):
            load_model(tmp_path / "w")


class TestFlags:
    def mesh(self, *words):
        return sample.sampling_mesh(sample.parser().parse_args(list(words)))

    def test_meshes(self):
        assert self.mesh() is None
        assert dict(self.mesh("--mesh", "fsdp=2,seq=2").shape) == {"data": 1, "fsdp": 2, "seq": 2}
        assert dict(self.mesh("--devices", "4").shape) == {"data": 1, "fsdp": 1, "seq": 4}

    def test_mistakes(self):
        with pytest.raises(UserError, match="no scenes to split over data"):
            self.mesh("--mesh", "data=2,seq=2")
        with pytest.raises(UserError, match="does not make 4 devices"):
            self.mesh("--mesh", "fsdp=3", "--devices", "4")

    def test_the_dry_run_tells_what_each_device_holds(self, capsys):
        def note(*words):
            arguments = ["--generate", "--dry-run", "--dtype", "bfloat16", *words]
            assert entry.execute(sample.main, sample.parser(), arguments) in (0, None)
            found = re.search(r"each device holds ([0-9.]+) MB", capsys.readouterr().out)
            return float(found[1])

        cfg = load_config(find_model("mini"))
        for words, ways in (("fsdp=2,seq=2", 2), ("seq=2", 1)):
            held = 0.0
            for path, spec in flatten(model.specs(cfg)).items():
                item = 4 if cost.keeps_float32(path) else 2
                held += math.prod(spec.shape) * item / (ways if "embed" in spec.axes else 1)
            assert note("--mesh", words) == pytest.approx(held / 1e6, rel=0.01)
        words = ["--dry-run", "--checkpoint", "paper", "--target", "h100", "--mesh", "seq=3"]
        assert entry.execute(sample.main, sample.parser(), words) == 2
        assert "seq=3 does not divide 40 attention heads" in capsys.readouterr().err

    def test_a_gpu_refuses_heads_that_do_not_divide_before_it_loads(self, monkeypatch):
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        monkeypatch.setattr(checkpoint, "load_model", None)
        with pytest.raises(UserError, match="seq=3 does not divide 4 attention heads"):
            arguments = sample.parser().parse_args(["--checkpoint", "mini"])
            sample.load_weights(arguments, sharding.abstract_mesh(seq=3))
