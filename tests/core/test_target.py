"""The device that a program is traced for: one answer for all, and fused attention that several GPUs can share."""

import functools
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.custom_partitioning import SdyShardingRule, custom_partitioning
from jax.sharding import NamedSharding, PartitionSpec

from roge_jax import sample, train
from roge_jax.core import attention, layers, sharding, target
from roge_jax.core.params import flatten
from roge_jax.errors import UserError
from roge_jax.recon import ray_scene
from roge_jax.video import dit

PACKAGE = Path(target.__file__).parents[1]


def test_nothing_else_asks_jax_for_the_machines_device():
    asking = [
        str(path.relative_to(PACKAGE))
        for path in sorted(PACKAGE.rglob("*.py"))
        if re.search(r"default_backend\(", path.read_text())
    ]
    assert asking == ["core/target.py"]


def test_the_default_is_this_machine():
    assert target.name() == target.platform() == target.machine() == "cpu"
    assert not target.only_planned() and target.current().memory is None
    with target.use(None):
        assert target.name() == "cpu"


def test_a_target_holds_inside_and_no_longer():
    with target.use("h100"), target.use("v5p"):
        with target.use(None):
            assert target.name() == "v5p"
        assert (target.platform(), target.fused(jnp.bfloat16)) == ("tpu", False)
    assert target.platform() == "cpu"
    for name, one in target.TARGETS.items():
        with target.use(name):
            assert target.current() == one
            assert target.fused("bfloat16") == (one.platform == "gpu")
            assert not target.fused(jnp.float32)
            assert target.only_planned() == (one.platform != "cpu")
        with target.use(name, compiled=True):
            assert not target.only_planned()


@pytest.mark.parametrize("program", [train, sample])
def test_targets_that_are_not_known_or_not_asked_for(program):
    words = ["tiny"] if program is train else []
    arguments = program.parser().parse_args([*words, "--dry-run", "--target", "h10"])
    with pytest.raises(UserError, match="unknown device 'h10': did you mean 'h100'"):
        program.main(arguments)
    for option in (["--target", "h100"], ["--compile"]):
        with pytest.raises(UserError, match="--dry-run"):
            program.main(program.parser().parse_args([*words, *option]))
    with pytest.raises(UserError, match="--compile: nothing is compiled ahead of time for v5p"):
        options = ["--dry-run", "--compile", "--target", "v5p"]
        program.main(program.parser().parse_args([*words, *options]))


# ---- the fused attention of GPUs on several devices ----------------------------------------------


_library = jax.nn.dot_product_attention


def _reference(q, k, v):
    return _library(q, k, v, implementation="xla")


def _gradient(q, k, v, dy):
    return jax.vjp(_reference, q, k, v)[1](dy)


def _opaque(function, results: int):
    """`function` of [b, l, heads, e] arrays under JAX's own rule for cuDNN's kernel: batch and heads may be split, for q, k
    and v alike; XLA places the result like the queries and does not place keys and values."""

    def partition(mesh, arguments, result):
        places = [tuple(x.sharding.spec) + (None,) * (4 - len(x.sharding.spec)) for x in arguments]
        if len(set(places[:3])) > 1:
            raise ValueError(f"Query, key and value should have same sharding: {places}")
        assert places[0][1] is places[0][3] is None, f"lengths are split: {places[0]}"
        where = NamedSharding(mesh, PartitionSpec(*places[0]))
        return mesh, function, where if results == 1 else (where,) * 3, (where,) * len(arguments)

    axes = [tuple(f"{name}{i}" for name in ("b", "l", "heads", "e")) for i in range(4)]
    once, operands = custom_partitioning(function), 3 if results == 1 else 4
    once.def_partition(
        partition=partition,
        sharding_rule=SdyShardingRule(tuple(axes[:operands]), tuple(axes[:results])),
    )

    @jax.custom_batching.custom_vmap
    def kernel(*arguments):
        return once(*arguments)

    @kernel.def_vmap
    def of_a_batch(size, batched, *arguments):
        assert all(batched), "JAX knows no other batches"
        found = kernel(*(x.reshape(-1, *x.shape[2:]) for x in arguments))
        split = jax.tree.map(lambda y: y.reshape(size, -1, *y.shape[1:]), found)
        return split, jax.tree.map(lambda _: True, split)

    return kernel


_forward, _backward = _opaque(_reference, 1), _opaque(_gradient, 3)


@jax.custom_vjp
def _like_cudnn(q, k, v):
    return _forward(q, k, v)


_like_cudnn.defvjp(
    lambda q, k, v: (_forward(q, k, v), (q, k, v)), lambda kept, dy: _backward(*kept, dy)
)


@jax.custom_batching.custom_vmap
def _unplaced(y):
    return jnp.zeros(y.shape, y.dtype)


@_unplaced.def_vmap
def _unplaced_batch(size, batched, y):
    return jnp.zeros(y.shape, y.dtype), True


@pytest.fixture
def fussy(monkeypatch):
    """Attention as on a GPU whose kernel refuses what cuDNN's does, run on the CPU.

    The compiler of GPUs drops the side of `where(True, x, y)` that is never taken before it places arrays.
    """
    where = jnp.where

    def kernel(q, k, v, *, scale, implementation):
        assert implementation == "cudnn" and scale == pytest.approx(q.shape[-1] ** -0.5)
        return _like_cudnn(q, k, v)

    monkeypatch.setattr(attention.jax.nn, "dot_product_attention", kernel)
    monkeypatch.setattr(
        attention.jnp, "where", lambda c, x, y: where(c, x, _unplaced(y) if c is True else y)
    )
    with target.use("h100", compiled=True):
        yield


def normal(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def gradient(loss, mesh, weights, scenes):
    """Loss and gradient of `loss(weights, scene)`, the mean over scenes."""

    def mean(weights, scenes):
        over = sharding.batch_axes(len(scenes))
        return jax.vmap(functools.partial(loss, weights), spmd_axis_name=over)(scenes).mean()

    with sharding.use(mesh):
        if mesh is not None:
            weights = sharding.place(weights, sharding.replicated(mesh))
            scenes = sharding.place(scenes, sharding.batch_sharding(mesh, len(scenes)))
        return jax.jit(jax.value_and_grad(mean))(weights, scenes)


MESHES = [(8, 1, 1), (2, 2, 2), (1, 1, 8)]  # data, fsdp, seq


def compare(loss, weights, scenes, sizes):
    expected = gradient(loss, None, weights, scenes)
    found = gradient(loss, sharding.make_mesh(*sizes), weights, scenes)
    assert abs(float(expected[0])) > 1e-3
    np.testing.assert_allclose(found[0], expected[0], rtol=2e-3)  # products of bfloat16
    for path, want in flatten(expected[1]).items():
        got = np.asarray(flatten(found[1])[path])
        assert np.linalg.norm(got - want) < 2e-2 * np.linalg.norm(want), path


@pytest.mark.parametrize("sizes", MESHES, ids=str)
def test_the_prompt_of_all_scenes_is_read_on_every_mesh(fussy, sizes):
    """Tokens of 8 scenes, split over all axes, read one prompt and themselves; keys of the prompt know no scenes."""
    heads, width, length, rows = 8, 64, 16, 6
    weights = {
        part: {name: 0.2 * normal(ord(name) + seed, width, width) for name in "qkvo"}
        for seed, part in enumerate(("cross", "own"))
    }
    prompt = normal(1, rows, width)
    angles = normal(2, length, width // heads // 2)

    def loss(weights, x):
        def leaves(kernel):
            return {"kernel": kernel.astype(jnp.bfloat16), "bias": jnp.zeros(width)}

        norms = {f"norm_{name}": {"scale": jnp.ones(width)} for name in "qk"}
        p = {part: norms | {k: leaves(w) for k, w in x.items()} for part, x in weights.items()}
        x = sharding.constrain(x, ("tokens", None))
        x = x + dit.self_attention(p["own"], x, angles, heads=heads)
        kv = {
            name: attention.split_heads(layers.linear(p["cross"][name], prompt), heads)
            for name in "kv"
        }
        return jnp.square(dit.cross_attention(p["cross"], x, kv, heads=heads)).mean()

    compare(loss, weights, normal(3, 8, length, width), sizes)


@pytest.mark.parametrize("sizes", MESHES, ids=str)
def test_the_views_of_a_scene_share_its_tokens_on_every_mesh(fussy, sizes):
    """Ray queries: views of a scene, split over `seq`, read the same scene tokens."""
    heads, width, views = 2, 16, 8
    names = ("q", "k", "v", "proj")
    weights = {name: 0.3 * normal(i, width, width) for i, name in enumerate(names)}

    def loss(weights, scene):
        p = {name: {"kernel": weights[name].astype(jnp.bfloat16)} for name in names}
        p |= {f"{name}_norm": {"scale": jnp.ones(width // heads)} for name in "qk"}
        x = sharding.constrain(scene[:views], ("views", None, None))
        y = ray_scene.attend(p, x, scene[views:].reshape(1, -1, width), heads)
        return jnp.square(sharding.constrain(y, ("views", None, None))).mean()

    compare(loss, weights, normal(5, 8, views + 2, 6, width), sizes)
