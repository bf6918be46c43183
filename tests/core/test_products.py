"""The rule of products: what they and their gradients read, and that the CPU's compiler keeps to it."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parity import rel_l2

from roge_jax import config
from roge_jax.core import hlo, layers, params, products, program, recompute, target
from roge_jax.core.attention import attention, scores_limit
from roge_jax.errors import UserError
from roge_jax.training import estimate, stages, start
from roge_jax.video import dit

ROUNDED = 4e-3  # an ulp of bfloat16: what a product of two rounded sides is away by, at most, where nothing cancels


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape), jnp.float32)


def in_dtype(dtype, function):
    """`function`, traced anew with products of `dtype`."""

    def run(*arguments):
        with products.use(dtype):
            return function(*arguments)

    return run


def test_products_read_what_is_asked_for_and_else_what_their_kernel_is_kept_in():
    x, kernel = normal(5, 6), normal(6, 4, seed=1)
    half = kernel.astype(jnp.bfloat16)
    assert products.dtype_of(half) == jnp.bfloat16 and products.dtype_of(kernel) == jnp.float32
    exact, whole = x @ kernel, x @ half.astype(jnp.float32)
    assert rel_l2(products.product(x, kernel), exact) < 1e-6
    with products.use("bfloat16"):
        assert products.dtype_of(kernel) == jnp.bfloat16
        found = products.product(x, kernel)
        assert products.use(None)(products.dtype_of)(kernel) == jnp.float32, "a decorator"
        assert found.dtype == jnp.float32
    want = np.asarray(x.astype(jnp.bfloat16), np.float64) @ np.asarray(half, np.float64)
    assert rel_l2(found, want) < 1e-6
    with products.use("float32"):
        assert rel_l2(products.product(x, half), whole) < 1e-6
    assert rel_l2(products.product(x, half), whole) > 1e-4, "x is rounded to its kernel's dtype"


@pytest.mark.parametrize("platform", ["cpu", "v5p"])  # forms of the gradient
@pytest.mark.parametrize("shape", [(7, 6, 40), (7, 40, 6)], ids=["wider", "narrower"])
def test_gradients_are_those_of_float32_to_rounding(shape, platform):
    m, k, n = shape
    x, kernel = normal(2, m, k), normal(k, n, seed=1)

    def loss(x, kernel):
        return jnp.sin(0.1 * layers.matmul(x, kernel)).sum()

    want = jax.grad(loss, (0, 1))(x, kernel)
    with target.use(platform):
        found = jax.grad(in_dtype("bfloat16", loss), (0, 1))(x, kernel)
    for a, b in zip(found, want, strict=True):
        assert a.dtype == jnp.float32 and 1e-4 < rel_l2(a, b) < ROUNDED
    kept = kernel.astype(jnp.bfloat16)
    assert jax.grad(in_dtype("bfloat16", loss), 1)(x, kept).dtype == jnp.bfloat16


def test_nothing_is_multiplied_or_kept_for_a_gradient_that_is_not_asked_for():
    x, kernel = normal(32, 16), normal(16, 8, seed=1)

    def loss(x, kernel):
        return jnp.square(layers.matmul(x, kernel)).sum()

    one = 2 * 32 * 16 * 8
    for asked, count in (((0,), 2), ((1,), 2), ((0, 1), 3)):
        traced = program.trace(jax.grad(in_dtype("bfloat16", loss), asked), x, kernel)
        padding = 2 * 32 * 16 * 8 if 1 in asked else 0  # rows of zeros, of the CPU's form
        assert one * count <= program.flops(traced)[""] <= one * count + 2 * padding
    frozen = jax.make_jaxpr(jax.grad(in_dtype("bfloat16", loss), 0))(x, kernel)
    assert str(frozen).count("dot_general") == 2


@pytest.mark.parametrize("limit", [None, 4 * 2 * 37 * 10], ids=["whole", "in pieces"])
@pytest.mark.parametrize("platform", ["cpu", "v5p"])
def test_gradients_of_attention(platform, limit):
    q, k, v = (normal(37, 2, 8, seed=i) for i in range(3))

    def loss(dtype, q, k, v):
        return jnp.sin(attention(q, k, v, dtype=dtype)).sum()

    want = jax.grad(functools.partial(loss, jnp.float32), (0, 1, 2))(q, k, v)
    rounded = in_dtype("bfloat16", functools.partial(loss, jnp.bfloat16))
    with target.use(platform), scores_limit(limit):
        found = jax.grad(rounded, (0, 1, 2))(q, k, v)
        read = multiplied(program.trace(jax.grad(rounded, (0, 1, 2)), q, k, v))
    assert {dtypes for dtypes, _, _ in read} == {("bfloat16", "bfloat16")}
    for a, b in zip(found, want, strict=True):
        assert a.dtype == jnp.float32 and 1e-4 < rel_l2(a, b) < 3 * ROUNDED


def multiplied(traced, times=1):
    """[(dtypes of the inputs, FLOPs, scope)] of the products of a program."""
    found = []
    for op in traced.ops:
        turns = times * (op.params["length"] if op.name == "scan" else 1)
        for body in op.bodies:
            found += multiplied(body, turns)
        if op.name == "dot_general":
            one = program.Program([op], (), (), traced.values)
            work = times * sum(program.flops(one).values())
            found.append((tuple(str(x.dtype) for x in op.shapes), work, op.scope))
    return found


def transformer_gradient(cfg, remat="dots"):
    """The gradient of the blocks of `cfg` by their weights, and its abstract arguments."""
    specs = {"blocks": params.stack(dit.block_specs(cfg), cfg.depth)}
    tokens = 7 * 8 * 4
    angles = jnp.asarray(dit.rope_angles(range(7), 8, 4, cfg.width // cfg.heads))

    def loss(p, x, e0):
        return jnp.square(dit.dit_blocks(p, x, e0, angles, cfg=cfg, remat=remat)).mean()

    shapes = (tokens, cfg.width), (6, cfg.width)
    arrays = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    # As in a step: the loss alone is traced inside.
    return lambda dtype: jax.grad(in_dtype(dtype, loss)), (params.abstract(specs), *arrays)


needs_units = pytest.mark.skipif(
    not products.cpu_units(), reason=f"this CPU has none of {', '.join(products.UNITS)}"
)


@needs_units
def test_the_cpus_compiler_widens_no_large_product():
    """XLA widens products of a form that its library does not take, and says nothing: seen in its optimised program."""
    cfg = dataclasses.replace(config.preset("mini").dit, depth=1)
    gradient, arguments = transformer_gradient(cfg)

    def flops(dtype):
        lowered = jax.jit(gradient(dtype)).lower(*arguments)
        return hlo.summary(lowered.compile().as_text()).flops

    found = flops("bfloat16")
    assert found["bf16"] > 0.99 * sum(found.values())
    assert flops("float32").keys() == {"f32"}


def test_the_dtype_of_a_run(monkeypatch):
    for able, given, frozen, want in (
        (True, None, None, "float32"),
        (True, "bfloat16", None, "bfloat16"),
        (True, None, "bfloat16", "bfloat16"),
        (False, None, "bfloat16", "float32"),
        (False, "float32", None, "float32"),
    ):
        monkeypatch.setattr(products, "cpu_units", lambda able=able: able)
        assert start.products_dtype(given, frozen) == want, (able, given, frozen)
    with pytest.raises(UserError, match="this CPU has no units for it"):
        start.products_dtype("bfloat16", None)
    with target.use("h100"):
        assert start.products_dtype(None, None) == "bfloat16"
        assert start.products_dtype("bfloat16", None) == "bfloat16"
        assert start.products_dtype(None, "float32") == "float32"


def test_a_stage_asks_for_its_products():
    """All that the transformers multiply in a joint step, forward, again and backward."""
    cfg = config.preset("tiny")
    stage = dataclasses.replace(stages.lora_stage(1, frames=cfg.frames), products="bfloat16")
    step, arguments = estimate.abstract_step(cfg, stage, 2, scenes=1)
    found = multiplied(program.trace(step, *arguments))
    assert {dtypes for dtypes, _, _ in found} == {("float32",) * 2, ("bfloat16",) * 2}
    own = [x for x in found if not re.search("vae|look_up", x[2])]
    wide = sum(work for (dtype, _), work, _ in own if dtype == "float32")
    assert 0 < wide < 0.02 * sum(work for _, work, _ in own), "time and head"


# ---- recomputation from rounded inputs ------------------------------------------------------------


def deep(f, x, stack, shared):
    x, _ = jax.lax.scan(lambda x, w: (f(x, (w, shared)), None), x, stack)
    return jnp.sin(x).sum()


def layer(x, rest):
    (w, b), shared = rest
    return x + jnp.tanh(x @ w + shared[None]) * b[None]


def layers_of(depth=5, width=16):
    stack = normal(depth, width, width, seed=1) / 4, normal(depth, width, seed=2)
    return normal(24, width), stack, normal(width, seed=3)


def test_recomputed_from_rounded_inputs_values_are_the_same_and_gradients_a_rounding_away():
    arguments = layers_of()
    for asked in ((0,), (0, 1, 2)):
        one, other = (
            jax.value_and_grad(functools.partial(deep, f), asked)(*arguments)
            for f in (layer, recompute.from_rounded(layer))
        )
        assert one[0] == other[0]
        for a, b in zip(*map(jax.tree.leaves, (other[1], one[1])), strict=True):
            assert 0 < rel_l2(a, b) < 2 * ROUNDED, asked


def test_it_keeps_inputs_in_two_bytes_and_copies_no_weights():
    x, stack, shared = layers_of(width=8)
    kept = {}
    for name, f in (
        ("float32", jax.checkpoint(layer, prevent_cse=False)),
        ("bfloat16", recompute.from_rounded(layer)),
    ):
        traced = program.trace(jax.grad(functools.partial(deep, f)), x, stack, shared)
        loops = [op for op in traced.ops if op.name == "scan"]
        kept[name] = [traced.values[v] for v in loops[0].writes]
    told = {name: {(v.shape, str(v.dtype)) for v in values} for name, values in kept.items()}
    assert told["float32"] == {((24, 8), "float32"), ((5, 24, 8), "float32")}
    assert told["bfloat16"] == {((24, 8), "float32"), ((5, 24, 8), "bfloat16")}


def test_the_transformer_keeps_them_so_where_products_are_asked_for_in_bfloat16():
    cfg = dataclasses.replace(config.preset("tiny").dit, text_len=0, depth=3)
    gradient, arguments = transformer_gradient(cfg, remat="full")

    def kept(dtype):
        traced = program.trace(gradient(dtype), *arguments)
        assert len({dtypes for dtypes, _, _ in multiplied(traced)}) == 1, "again in the same dtype"
        stacks = [v for v in traced.values if getattr(v, "shape", ())[:2] == (3, 224)]
        return {str(v.dtype) for v in stacks}

    assert kept(None) == {"float32"} and kept("bfloat16") == {"bfloat16"}
