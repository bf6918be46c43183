"""Many devices compute what one does; every array lies where the table says; mistakes are named."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

from roge_jax import config, model
from roge_jax.checkpoint import Checkpoints
from roge_jax.core import sharding
from roge_jax.core.distributed import global_batch, local_rows
from roge_jax.core.lora import attach
from roge_jax.core.params import Spec, abstract, count, flatten, unflatten
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import UserError
from roge_jax.recon import ray_scene
from roge_jax.training.loop import initial_state
from roge_jax.training.optim import OptimConfig, make_optimiser
from roge_jax.video import dit

SCENES, CONTEXTS = 8, 2


def small() -> config.RoGeConfig:
    """The tiny preset with the smallest VAE: it is frozen and replicated, but takes long to compile."""
    cfg = config.preset("tiny")
    return dataclasses.replace(
        cfg, vae=dataclasses.replace(cfg.vae, res_blocks=1, multipliers=(1, 1, 1, 1))
    )


def drawn(specs, seed: int):
    """Values without compiling anything: every leaf small and not zero, scales around one."""
    rng = np.random.default_rng(seed)
    return unflatten(
        {
            path: (path.endswith("scale") + 0.1 * rng.normal(size=s.shape)).astype(np.float32)
            for path, s in flatten(specs).items()
        }
    )


@pytest.fixture(scope="module")
def problem():
    """LoRA on both halves and the new embeddings, a batch of scenes, and the loss and gradient on one device."""
    cfg = small()
    specs, frozen_specs = model.split(model.specs(cfg), model.NEW_EMBEDDINGS)
    specs = attach(specs, model.adapter_specs(cfg))
    rng, views = np.random.default_rng(0), CONTEXTS + cfg.frames
    c2w = np.tile(np.eye(4, dtype=np.float32), (SCENES, views, 1, 1))
    c2w[:, 1:, :3, 3] = rng.normal(size=(SCENES, views - 1, 3))
    K = np.array([[40, 0, 24], [0, 40, 16], [0, 0, 1]], np.float32)
    batch = {
        "context_rgb": rng.random((SCENES, CONTEXTS, cfg.height, cfg.width, 3), np.float32),
        "target_rgb": rng.random((SCENES, cfg.frames, cfg.height, cfg.width, 3), np.float32),
        "K": np.tile(K, (SCENES, views, 1, 1)),
        "c2w": c2w,
        "vectors": rng.normal(size=(SCENES, CONTEXTS, 11)).astype(np.float32),
    }
    trees = drawn(specs, 1), drawn(frozen_specs, 2)

    def gradient(mesh):
        trainable, frozen = trees
        scenes = batch
        if mesh is not None:
            trainable = sharding.place(trainable, sharding.shardings(specs, mesh))
            frozen = sharding.place(frozen, sharding.shardings(frozen_specs, mesh))
            scenes = global_batch(batch, mesh, SCENES)
        loss = functools.partial(model.loss, config=cfg)
        with sharding.use(mesh):
            step = jax.jit(jax.value_and_grad(loss, has_aux=True))
            (value, _), grads = step(trainable, frozen, scenes, jax.random.key(3))
        return float(value), flatten(sharding.gather(grads))

    return gradient, gradient(None)


def test_transformer_equals_one_device():
    """The flow-matching term alone (the whole loss is among the slow tests): all three axes at work."""
    cfg, mesh = small(), sharding.make_mesh(2, 2, 2)
    specs = {"dit": attach(dit.dit_specs(cfg.dit), model.adapter_specs(cfg)["dit"])}
    specs["prompt"] = model.specs(cfg)["prompt"]
    params, slots = drawn(specs, 1), cfg.slots(CONTEXTS)
    rng = np.random.default_rng(2)
    shape = (SCENES, slots, *cfg.latent_size)
    scenes = {
        "x0": rng.normal(size=(*shape, 16)).astype(np.float32),
        "appearance": rng.normal(size=(*shape, 20)).astype(np.float32),
        "tokens": rng.normal(size=(SCENES, slots * 6, cfg.dit.width)).astype(np.float32),
    }

    def loss(params, scenes):
        def one(x0, appearance, tokens):
            cond = model.Condition(appearance, tokens)
            return model.flow_matching(
                params, x0, cond, jax.random.key(4), config=cfg, contexts=CONTEXTS
            )

        over = jax.vmap(one, spmd_axis_name=sharding.batch_axes(SCENES))
        return over(scenes["x0"], scenes["appearance"], scenes["tokens"]).mean()

    expected, grads = jax.jit(jax.value_and_grad(loss))(params, scenes)
    with sharding.use(mesh):
        placed = sharding.place(params, sharding.shardings(specs, mesh))
        step = jax.jit(jax.value_and_grad(lambda p, s: loss(p, s)))
        found, sharded = step(placed, global_batch(scenes, mesh, SCENES))
    assert abs(float(found) - float(expected)) < 1e-5 * float(expected)
    grads, sharded = flatten(grads), flatten(sharding.gather(sharded))
    norm = np.sqrt(sum(np.square(g).sum() for g in grads.values()))
    wrong = {
        path: error
        for path, g in grads.items()
        if (error := np.linalg.norm(sharded[path] - g)) > 1e-5 * max(np.linalg.norm(g), 1e-2 * norm)
    }
    assert norm > 0.1 and not wrong


@pytest.mark.slow  # about a minute of compiling each
@pytest.mark.parametrize("sizes", [(2, 2, 2), (8, 1, 1), (1, 4, 2), (1, 1, 8)], ids=str)
def test_loss_and_gradient_equal_one_device(problem, sizes):
    gradient, (loss, grads) = problem
    found, sharded = gradient(sharding.make_mesh(*sizes))
    assert abs(found - loss) < 1e-5 * loss
    norm = np.sqrt(sum(np.square(g).sum() for g in grads.values()))
    assert norm > 0.1, "the gradient is there to be compared"
    error = {path: np.linalg.norm(sharded[path] - g) for path, g in grads.items()}
    entry = max(np.abs(sharded[path] - g).max() for path, g in grads.items())
    leaf = max(e / np.linalg.norm(grads[path]) for path, e in error.items() if e)
    print(f"{sizes}: loss {abs(found / loss - 1):.1e}, entry {entry / norm:.1e}, leaf {leaf:.1e}")
    assert np.sqrt(sum(e**2 for e in error.values())) < 1e-5 * norm
    # Leaf by leaf; gradients of queries and keys are differences of nearly equal terms, hence the floor.
    wrong = {
        p: e for p, e in error.items() if e > 1e-5 * max(np.linalg.norm(grads[p]), 1e-2 * norm)
    }
    assert not wrong


class TestMesh:
    def test_shape_and_kind(self):
        mesh = sharding.make_mesh(2, 2, 2)
        assert dict(mesh.shape) == {"data": 2, "fsdp": 2, "seq": 2}
        assert set(mesh.axis_types) == {jax.sharding.AxisType.Auto}
        assert dict(sharding.make_mesh(fsdp=4).shape) == {"data": 2, "fsdp": 4, "seq": 1}
        assert sharding.make_mesh(1, 1, 2, devices=jax.devices()[:2]).size == 2

    @pytest.mark.parametrize(
        ("sizes", "says"),
        [
            ((3, 2, 1), "data=4, fsdp=2, seq=1 does"),
            ((None, 3, 1), "each one of 1, 2, 4, 8"),
            ((2, 0, 1), "fsdp=0"),
        ],
    )
    def test_sizes_that_do_not_fit(self, sizes, says):
        with pytest.raises(UserError, match=says):
            sharding.make_mesh(*sizes)

    def test_parse(self):
        assert sharding.parse_mesh("data=2, seq=4") == {"data": 2, "seq": 4}
        for text, says in (
            ("date=2", "data"),
            ("data=x", "data=NUMBER"),
            ("seq=1,seq=2", "must be one"),
            (" ", "is empty"),
        ):
            with pytest.raises(UserError, match=says):
                sharding.parse_mesh(text)


class TestTable:
    def test_every_leaf_lies_where_the_table_says(self):
        """All leaves of the model and its adapters, on real arrays; large matrices are all split."""
        mesh, cfg = sharding.make_mesh(1, 4, 2), config.preset("tiny")
        specs = attach(model.specs(cfg), model.adapter_specs(cfg))
        placed = flatten(sharding.place(drawn(specs, 0), sharding.shardings(specs, mesh)))
        for path, spec in flatten(specs).items():
            expected = P(*("fsdp" if name == "embed" else None for name in spec.axes))
            assert placed[path].sharding.spec == expected, path
            share = [n // 4 if name == "embed" else n for n, name in zip(spec.shape, spec.axes)]
            assert {s.data.shape for s in placed[path].addressable_shards} == {tuple(share)}, path

    def test_published_sizes_divide(self):
        """On 8 GPUs a device holds an eighth of the transformer; what stays whole there is below half a percent."""
        mesh = sharding.make_mesh(fsdp=8)
        for name in ("wan1.3b", "paper"):
            specs = model.specs(config.preset(name))
            where = flatten(sharding.shardings(specs, mesh))
            held = {
                p: int(np.prod(where[p].shard_shape(s.shape))) for p, s in flatten(specs).items()
            }
            dit_share = sum(n for p, n in held.items() if p.startswith("dit/")) / count(
                specs["dit"]
            )
            assert 0.125 < dit_share < 0.13, name
            assert sum(held.values()) < 0.2 * count(specs), name

    def test_a_size_that_does_not_divide(self):
        specs = {
            "a": {"kernel": Spec((12, 5), ("embed", "mlp"))},
            "b": {"kernel": Spec((4, 20), ("mlp", "embed"))},
        }
        with pytest.raises(UserError) as error:
            sharding.shardings(specs, sharding.make_mesh(fsdp=8))
        for part in (
            "a/kernel",
            "axis 0",
            "'embed'",
            "size 12",
            "fsdp=8",
            "1, 2, 3, 4, 6, 12",
            "1 more",
        ):
            assert part in str(error.value)
        assert str(error.value).endswith("divide every leaf: 1, 2, 4.")

    def test_batch(self):
        mesh = sharding.make_mesh(2, 2, 2)
        assert sharding.batch_sharding(mesh, 8).spec == P(("data", "fsdp"))
        assert sharding.batch_sharding(mesh, 2).spec == P("data"), (
            "fsdp is left out where it does not divide"
        )
        with pytest.raises(UserError, match="sizes that divide it: 1, 3"):
            sharding.batch_sharding(mesh, 3)

    def test_describe(self):
        specs = {"a": {"kernel": Spec((16, 4), ("embed", "mlp")), "bias": Spec((4,), ("mlp",))}}
        lines = sharding.describe(specs, sharding.make_mesh(fsdp=4)).splitlines()
        assert lines[0] == "mesh data=2, fsdp=4, seq=1"
        assert lines[2].split() == ["a/bias", "(4,)", "-", "16"]
        assert lines[3].split() == ["a/kernel", "(16,", "4)", "fsdp,", "-", "64"]
        assert lines[-1] == "80 of 272 bytes on each device"


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_training_state_follows_its_parameters(name):
    specs = {"x": {"kernel": Spec((16, 8), ("embed", "mlp")), "bias": Spec((8,), ("mlp",))}}
    optim, mesh = OptimConfig(name=name, ema=0.9), sharding.make_mesh(fsdp=8)
    make = lambda: initial_state(drawn(specs, 0), make_optimiser(optim, specs, 10), optim)  # noqa: E731
    state = jax.eval_shape(make)
    where = jax.tree_util.tree_leaves_with_path(sharding.state_shardings(state, specs, mesh))
    split = {jax.tree_util.keystr(path) for path, s in where if s.spec == P("fsdp", None)}
    whole = [jax.tree_util.keystr(path) for path, s in where if s.spec != P("fsdp", None)]
    moments = {"adamw": 2, "muon": 1}[name]
    assert len(split) == 2 + moments, "the kernel, its average and its moments"
    assert {"['params']['x']['kernel']", "['ema']['x']['kernel']"} < split
    assert all(where_.endswith("['kernel']") for where_ in split)
    assert "['step']" in whole and "['params']['x']['bias']" in whole


def test_checkpoint_moves_between_meshes(tmp_path):
    specs = {"x": {"kernel": Spec((16, 8), ("embed", "mlp"))}, "y": {"bias": Spec((5,), (None,))}}
    state = drawn(specs, 0)
    meshes = [sharding.make_mesh(*sizes) for sizes in ((2, 2, 2), (1, 8, 1), (8, 1, 1))]
    checkpoints = Checkpoints(tmp_path / "c")
    checkpoints.save(1, sharding.place(state, sharding.shardings(specs, meshes[0])))
    for mesh in meshes[1:]:
        where = sharding.shardings(specs, mesh)
        like = jax.tree.map(
            lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), abstract(specs), where
        )
        found = checkpoints.restore(like)
        assert found["x"]["kernel"].sharding == where["x"]["kernel"]
        for path, x in flatten(found).items():
            np.testing.assert_array_equal(np.asarray(x), flatten(state)[path])
    checkpoints.close()


class TestActivations:
    def test_no_mesh_no_change(self):
        x = jnp.ones((6, 4))
        assert sharding.constrain(x, ("tokens", None)) is x
        assert sharding.by_heads(x, x, x, x.dtype) == (x, x, x)
        assert sharding.batch_axes(8) is None

    def test_tokens_are_split_even_unevenly(self):
        with sharding.use(sharding.make_mesh(seq=8)):
            split = jax.jit(lambda x: sharding.constrain(2 * x, ("tokens", None)))
            where = split(jnp.ones((24, 4))).sharding
            assert where.shard_shape((24, 4)) == (3, 4)
            twice = jax.jit(lambda x: sharding.constrain(2 * x, ("tokens", None)) + 1)
            np.testing.assert_array_equal(twice(jnp.ones((21, 4))), np.full((21, 4), 3.0))

    @pytest.mark.parametrize("seq", [2, 8])  # two heads: split by heads, or queries by token
    def test_attention_over_split_tokens(self, seq):
        cfg = config.preset("tiny").dit
        p = drawn(dit.block_specs(cfg)["self_attn"], 0)
        x = np.random.default_rng(0).normal(size=(24, cfg.width)).astype(np.float32)
        angles = jnp.asarray(dit.rope_angles((0, 0, 1, 2), 2, 3, cfg.width // cfg.heads))
        run = lambda p, x: dit.self_attention(p, x, angles, heads=cfg.heads)  # noqa: E731
        expected = jax.jit(run)(p, x)
        with sharding.use(sharding.make_mesh(seq=seq)):
            program = (
                jax.jit(lambda p, x: run(p, sharding.constrain(x, ("tokens", None))))
                .lower(p, x)
                .compile()
            )
        np.testing.assert_allclose(program(p, x), expected, rtol=1e-5, atol=1e-5)
        by_heads = "all-to-all" in program.as_text()
        assert by_heads == (cfg.heads % seq == 0), (
            "heads divide: all-to-all; otherwise keys are gathered"
        )
        assert by_heads or "all-gather" in program.as_text()

    @pytest.mark.parametrize("seq", [2, 8])
    def test_what_travels_into_attention_is_in_the_type_of_its_products(self, seq):
        x = jax.ShapeDtypeStruct((24, 2, 8), jnp.float32)
        with sharding.use(sharding.make_mesh(seq=seq)):
            traced = jax.make_jaxpr(lambda x: sharding.by_heads(x, x, x, jnp.bfloat16))(x)
        moved = [e for e in traced.eqns if e.primitive.name == "sharding_constraint"]
        assert [str(e.invars[0].aval.dtype) for e in moved] == 3 * ["bfloat16"]

    @pytest.mark.parametrize("attention", ["bidirectional", "cross"])
    def test_devices_share_the_views_of_a_scene(self, attention):
        """Four views on four devices: each queries the rays of about one, and all get what one device gets."""
        cfg = dataclasses.replace(
            config.preset("tiny").renderer, attention=attention, relative_cameras=False, chunk=4
        )
        p = drawn(ray_scene.renderer_specs(cfg), 0)
        rng = np.random.default_rng(0)
        z = rng.normal(size=(2, 24, cfg.width)).astype(np.float32)
        plucker = rng.normal(size=(4, 32, 48, 6)).astype(np.float32)
        programs, found = [], []
        for mesh in (None, sharding.make_mesh(seq=4, devices=jax.devices()[:4])):
            query = functools.partial(ray_scene.query_rays, cfg=cfg, contexts=2)
            with sharding.use(mesh):
                where = {} if mesh is None else {"out_shardings": sharding.replicated(mesh)}
                programs.append(jax.jit(query, **where).lower(p, z, plucker).compile())
            found.append(np.asarray(programs[-1](p, z, plucker)))
        one, four = (program.cost_analysis()["flops"] for program in programs)
        assert four < 0.35 * one
        np.testing.assert_allclose(found[1], found[0], rtol=1e-5, atol=1e-5)


class TestBatches:
    def test_rows_of_this_process(self):
        assert local_rows(None, 3).tolist() == [0, 1, 2]
        assert local_rows(sharding.make_mesh(2, 2, 2), 4).tolist() == [0, 1, 2, 3]

    def test_global_batch(self):
        mesh = sharding.make_mesh(2, 2, 2)
        x = np.arange(24.0).reshape(4, 6)
        found = global_batch({"x": x}, mesh, 4)["x"]
        assert found.sharding.spec == P(("data", "fsdp"))
        np.testing.assert_array_equal(found, x)

    def test_some_rows_are_rows_of_the_whole(self):
        """A process that draws two samples of five gets the ones that everybody else would have drawn there."""
        rng = np.random.default_rng(0)
        sequence = {
            "rgb": rng.integers(0, 256, (12, 16, 16, 3), dtype=np.uint8),
            "K": np.tile(np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), (12, 1, 1)),
            "c2w": np.tile(np.eye(4), (12, 1, 1)),
        }
        sequence["c2w"][:, 0, 3] = np.arange(12)
        draw = functools.partial(
            draw_batch, [sequence], 3, 5, 5, ViewConfig(targets=3), scale_rule="lagernvs"
        )
        whole, part = draw(), draw(rows=np.array([1, 4]))
        for name, x in whole.items():
            np.testing.assert_array_equal(part[name], x[[1, 4]])
        assert not np.array_equal(whole["target_rgb"][0], whole["target_rgb"][1])


class TestOverScenes:
    """`over_scenes` on CPU devices: each goes through its own scenes, as a lone one goes through all."""

    @staticmethod
    def run(mesh, scenes: int):
        """(mean, gradient, the meshes that a scene saw, the compiled program) of a small product of every scene."""
        rng, seen = np.random.default_rng(0), []
        params = {"w": rng.normal(size=(6, 5)).astype(np.float32)}
        batch = {"x": rng.normal(size=(scenes, 7, 6)).astype(np.float32)}
        keys = jax.random.split(jax.random.key(1), scenes)

        def scene(params, views, key):
            seen.append(sharding.current())
            noise = jax.random.normal(key, (7, 5))
            return {"y": jnp.square(jnp.tanh(views["x"] @ params["w"]) - noise).mean()}

        def loss(params, batch, keys):
            return sharding.over_scenes(scene, params, batch, keys)["y"].mean()

        with sharding.use(mesh):
            if mesh is not None and scenes % mesh.shape["data"] == 0:
                batch = global_batch(batch, mesh, scenes)
            program = jax.jit(jax.value_and_grad(loss)).lower(params, batch, keys).compile()
        value, grads = program(params, batch, keys)
        return float(value), np.asarray(grads["w"]), seen, program.as_text()

    @pytest.mark.parametrize("scenes", [8, 24])
    def test_equal_to_one_by_one(self, scenes):
        value, grads, seen, _ = self.run(None, scenes)
        found, split, inside, text = self.run(sharding.make_mesh(data=8), scenes)
        assert abs(found - value) < 1e-6 * value
        np.testing.assert_allclose(split, grads, rtol=1e-5, atol=1e-6 * np.abs(grads).max())
        assert set(seen) == set(inside) == {None}, "a scene on its device is a scene of a lone CPU"
        assert "all-reduce" in text, "the devices' gradients are added"
        assert "all-gather" not in text

    @pytest.mark.parametrize(("sizes", "scenes"), [((4, 2, 1), 8), ((1, 1, 8), 8), ((8, 1, 1), 12)])
    def test_all_at_once_where_more_is_split_or_scenes_are_left_over(self, sizes, scenes):
        mesh = sharding.make_mesh(*sizes)
        value, grads, _, _ = self.run(None, scenes)
        found, split, inside, _ = self.run(mesh, scenes)
        assert abs(found - value) < 1e-6 * value
        np.testing.assert_allclose(split, grads, rtol=1e-5, atol=1e-6 * np.abs(grads).max())
        assert set(inside) == {mesh}
