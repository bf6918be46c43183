"""Specs and trees, leaf layers, attention, rotary tables and LoRA, each against its definition or a second program."""

import functools

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen
from hypothesis import given
from parity import rel_l2

from roge_jax.config import PRESETS, from_dict, preset, to_dict
from roge_jax.core import layers, lora, params, rope
from roge_jax.core.attention import attention, merge_heads, split_heads
from roge_jax.core.params import Spec
from roge_jax.errors import UserError, did_you_mean

FLOAT32 = 1e-6  # relative L2 of two orders of a short float32 sum


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape), jnp.float32)


# Specs and trees.

SPECS = {
    "embed": layers.linear_specs(6, 4, (None, "embed")),
    "blocks": params.stack({"fc": layers.linear_specs(4, 4), "norm": layers.norm_specs(4)}, 3),
    "token": Spec((2, 4), (None, "embed"), params.normal(0.02), jnp.bfloat16),
}


@given(
    st.recursive(
        st.integers(), lambda t: st.dictionaries(st.text("abc", min_size=1), t, min_size=1)
    )
)
def test_flatten_and_unflatten_are_inverse(tree):
    if isinstance(tree, dict):
        assert params.unflatten(params.flatten(tree)) == tree
        assert list(params.flatten(tree)) == sorted(
            params.flatten(tree), key=lambda p: p.split("/")
        )


def test_init_abstract_and_count_follow_the_specs():
    tree, shapes = params.init(jax.random.key(0), SPECS), params.abstract(SPECS)
    flat = params.flatten(tree)
    assert {p: (x.shape, x.dtype) for p, x in flat.items()} == {
        p: (s.shape, s.dtype) for p, s in params.flatten(shapes).items()
    }
    assert flat["token"].dtype == jnp.bfloat16
    assert params.count(tree) == params.count(SPECS) == 6 * 4 + 4 + 3 * (4 * 4 + 4 + 4 + 4) + 8
    assert params.flatten(SPECS)["blocks/fc/kernel"].axes == ("layers", "embed", "mlp")
    params.check(tree, SPECS)


def test_layers_of_a_stack_start_differently_and_with_the_spread_of_one_layer():
    specs = params.stack(layers.linear_specs(64, 64), 5)
    kernel = np.asarray(params.init(jax.random.key(1), specs)["kernel"])
    assert np.unique(kernel[:, 0, 0]).size == 5
    # 4096 normal numbers: the standard deviation is known to 1.1 %; 5 sigma
    np.testing.assert_allclose(kernel.std((1, 2)) * 8, 1.0, atol=0.06)


def test_adding_a_leaf_changes_no_other():
    more = SPECS | {"another": layers.linear_specs(4, 4)}
    one, two = (params.flatten(params.init(jax.random.key(0), s)) for s in (SPECS, more))
    for path, leaf in one.items():
        np.testing.assert_array_equal(
            np.asarray(leaf, np.float32), np.asarray(two[path], np.float32)
        )


def test_no_two_leaves_start_alike():
    """Nor do those of one shape whose names are of one length."""
    specs = {name: layers.linear_specs(8, 8, bias=False) for name in ("q", "k", "v", "o")}
    kernels = params.flatten(params.init(jax.random.key(0), specs)).values()
    other = params.flatten(params.init(jax.random.key(1), specs)).values()
    drawn = np.stack([np.asarray(x).ravel() for x in (*kernels, *other)])
    assert np.abs(np.corrcoef(drawn) - np.eye(8)).max() < 0.6  # of 64 numbers; 5 sigma


def test_check_lists_every_mismatch_in_one_error():
    tree = params.init(jax.random.key(0), SPECS)
    del tree["embed"]["bias"]
    tree["extra"] = jnp.zeros(3)
    tree["token"] = jnp.zeros((2, 5))
    with pytest.raises(UserError) as caught:
        params.check(tree, SPECS, source="file.safetensors")
    text = str(caught.value)
    for part in (
        "file.safetensors",
        "3 mismatches",
        "missing embed/bias",
        "unexpected extra",
        "(2, 5)",
    ):
        assert part in text


def test_cast_leaves_integers_alone():
    tree = params.cast({"x": jnp.ones(2), "n": jnp.ones(2, jnp.int32)}, jnp.bfloat16)
    assert (tree["x"].dtype, tree["n"].dtype) == (jnp.bfloat16, jnp.int32)


# Leaf layers, against Flax and against loops.


def test_linear_and_norms_equal_flax():
    x = normal(2, 5, 6)
    p = {"kernel": normal(6, 4, seed=1), "bias": normal(4, seed=2)}
    assert rel_l2(layers.linear(p, x), linen.Dense(4).apply({"params": p}, x)) < FLOAT32
    p = {"scale": normal(6, seed=3), "bias": normal(6, seed=4)}
    flax = linen.LayerNorm(epsilon=1e-3).apply({"params": p}, x)
    assert rel_l2(layers.layer_norm(p, x, eps=1e-3), flax) < FLOAT32
    flax = linen.RMSNorm(epsilon=1e-3).apply({"params": {"scale": p["scale"]}}, x)
    assert rel_l2(layers.rms_norm(p, x, eps=1e-3), flax) < FLOAT32


def test_norms_do_not_lose_digits_of_shifted_or_16_bit_input():
    x = normal(3, 256) + 1000.0
    y = np.asarray(layers.layer_norm({}, x, eps=0.0))
    x64 = np.asarray(x, np.float64)
    want = (x64 - x64.mean(-1, keepdims=True)) / x64.std(-1, keepdims=True)
    # The mean is rounded by at most an ulp of 1000, 6e-5, against a spread of 1; as E x^2 - (E x)^2 it would lose 0.06.
    assert rel_l2(y, want) < 6.2e-5
    assert layers.layer_norm({}, x.astype(jnp.bfloat16), eps=1e-5).dtype == jnp.float32


def test_16_bit_kernels_are_accumulated_in_float32():
    x, kernel = normal(4, 512), normal(512, 8, seed=1).astype(jnp.bfloat16)
    want = np.asarray(x.astype(jnp.bfloat16), np.float64) @ np.asarray(kernel, np.float64)
    y = layers.matmul(x, kernel)
    assert y.dtype == jnp.float32
    assert rel_l2(y, want) < 1e-6  # rounding the sum to bfloat16 would cost 2e-3


@pytest.mark.parametrize("lead", [(), (2,), (2, 3)])
def test_patches_there_and_back(lead):
    x = normal(*lead, 6, 9, 4)
    tokens = layers.patchify(x, 3)
    assert tokens.shape == (*lead, 6, 36)
    np.testing.assert_array_equal(layers.unpatchify(tokens, (2, 3), 3), x)
    np.testing.assert_array_equal(tokens[..., 4, :], x[..., 3:6, 3:6, :].reshape(*lead, -1))


def test_a_patch_convolution_equals_the_convolution():
    x, p = normal(2, 8, 12, 5), {"kernel": normal(4, 4, 5, 7, seed=1), "bias": normal(7, seed=2)}
    conv = linen.Conv(7, (4, 4), strides=(4, 4), padding="VALID")
    want = conv.apply({"params": p}, x).reshape(2, 6, 7)
    assert rel_l2(layers.patch_conv(p, x), want) < FLOAT32


# Attention and rotary tables.


@functools.partial(jax.jit, static_argnums=0)
def output_and_gradients(f, *args):
    y, pull = jax.vjp(f, *args)
    return y, pull(jnp.cos(args[0]))


@pytest.mark.parametrize(("lead", "q_len", "kv_len"), [((3,), 4, 9), ((2, 3), 7, 2)])
def test_attention_equals_jax_nn(lead, q_len, kv_len):
    q, k, v = (normal(*lead, n, 2, 8, seed=n) for n in (q_len, kv_len, kv_len))

    def reference(q, k, v):
        flat = [x.reshape(-1, *x.shape[-3:]) for x in (q, k, v)]
        return jax.nn.dot_product_attention(*flat).reshape(q.shape)

    (y, got), (want, ref) = (output_and_gradients(f, q, k, v) for f in (attention, reference))
    assert rel_l2(y, want) < 2 * FLOAT32
    for a, b in zip(got, ref, strict=True):
        assert rel_l2(a, b) < 1e-5  # differences of near-equal terms


LENGTHS = [(6, 8), (7, 8), (6, 9), (7, 9)]


@pytest.mark.parametrize("lengths", LENGTHS)
def test_what_the_fused_kernel_is_told_gives_the_same_attention(monkeypatch, lengths):
    """Its arguments, given to the formulation of `jax.nn` that runs anywhere: values and gradients."""
    q, k, v = (normal(2, n, 3, 8, seed=i) for i, n in enumerate((lengths[0], *2 * lengths[1:])))
    want = output_and_gradients(attention, q, k, v)  # on the backend that there is
    library, calls = jax.nn.dot_product_attention, []

    def anywhere(*args, implementation, **options):
        calls.append({"implementation": implementation} | options)
        return library(*args, implementation="xla", **options)

    monkeypatch.setattr(jax.nn, "dot_product_attention", anywhere)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    found = output_and_gradients(functools.partial(attention, dtype=jnp.bfloat16), q, k, v)
    assert [call["implementation"] for call in calls] == ["cudnn"]
    assert ("key_value_seq_lengths" in calls[0]) == any(n % 2 for n in lengths)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        assert a.shape == b.shape and rel_l2(a, b) < 2e-2  # bfloat16


@pytest.mark.parametrize("lengths", LENGTHS)
def test_the_fused_kernel_has_a_gradient_at_any_length(monkeypatch, lengths):
    """Lowered for a GPU that is not there, one prompt for several videos: odd lengths, and keys without their own batch
    axis, are what JAX refuses."""
    fused = pytest.importorskip("jax._src.cudnn.fused_attention_stablehlo")
    monkeypatch.setattr(fused, "check_cudnn_version", lambda: 91200)
    monkeypatch.setattr(fused, "check_compute_capability", lambda *_: True)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    q, k = normal(2, lengths[0], 4, 64), normal(lengths[1], 4, 64)

    def loss(q, k):
        y = jax.vmap(lambda q: attention(q, k, 2 * k, dtype=jnp.bfloat16))(q)
        return y.sum()

    program = jax.jit(jax.grad(loss, (0, 1))).trace(q, k).lower(lowering_platforms=("cuda",))
    assert "__cudnn$fmha" in program.as_text() and "Backward" in program.as_text()


def test_attention_survives_large_logits():
    q, k = 300.0 * normal(1, 4, 1, 8), 300.0 * normal(1, 4, 1, 8, seed=1)
    y = attention(q, k, normal(1, 4, 1, 8, seed=2))
    assert bool(jnp.isfinite(y).all())


def test_heads_split_and_merge():
    x = normal(2, 3, 12)
    np.testing.assert_array_equal(merge_heads(split_heads(x, 4)), x)
    np.testing.assert_array_equal(split_heads(x, 4)[..., 1, :], x[..., 3:6])


@pytest.mark.parametrize("rotate", [rope.rotate_halves, rope.rotate_pairs])
def test_rotations_keep_lengths_and_see_differences_only(rotate):
    q, k = normal(1, 1, 8, seed=1), normal(1, 1, 8, seed=2)
    frequencies = jnp.asarray(rope.frequencies(8, 100.0), jnp.float32)

    def dot(a, b):
        return float((rotate(q, a * frequencies[None]) * rotate(k, b * frequencies[None])).sum())

    np.testing.assert_array_equal(rotate(q, jnp.zeros((1, 4))), q)
    np.testing.assert_allclose(
        jnp.linalg.norm(rotate(q, 3.0 * frequencies[None])), jnp.linalg.norm(q), rtol=1e-6
    )
    np.testing.assert_allclose(dot(3.0, 5.0), dot(10.0, 12.0), rtol=1e-5)
    assert abs(dot(3.0, 5.0) - dot(3.0, 6.0)) > 1e-2


def test_the_two_rotations_pair_different_channels():
    x, angle = jnp.arange(1.0, 5.0)[None, None], jnp.asarray([[jnp.pi / 2, 0.0]])
    np.testing.assert_allclose(rope.rotate_halves(x, angle)[0, 0], [-3, 2, 1, 4], atol=1e-6)
    np.testing.assert_allclose(rope.rotate_pairs(x, angle)[0, 0], [-2, 1, 3, 4], atol=1e-6)


def test_grid_angles_are_positions_times_frequencies():
    angles = rope.grid_angles(2, 3, 8, 100.0, offset=1)
    assert angles.shape == (6, 2, 4) and angles.dtype == np.float32
    np.testing.assert_allclose(
        angles[5], np.outer([2, 3], 100.0 ** (-np.arange(0, 8, 2) / 8)), rtol=1e-7
    )


# LoRA.

LORA_BASE = {
    "conv": layers.patch_conv_specs(2, 3, 8),
    "blocks": params.stack({"q": layers.linear_specs(8, 8), "mlp": layers.mlp_specs(8, 16)}, 2),
    "norm": layers.norm_specs(8),
}


def adapted(rank=2):
    base = params.init(jax.random.key(0), LORA_BASE)
    specs = lora.lora_specs(LORA_BASE, rank, r"conv|/q$|fc1")
    return base, specs, params.init(jax.random.key(1), specs)


def run(p, x):
    x = layers.patch_conv(p["conv"], x)

    def step(x, p):
        return x + layers.mlp(p["mlp"], layers.linear(p["q"], x), exact=True), None

    return jax.lax.scan(step, x, p["blocks"])[0]


def test_lora_adapts_exactly_the_matching_kernels():
    _, specs, factors = adapted()
    shapes = {path: s.shape for path, s in params.flatten(specs).items()}
    assert shapes == {
        "conv/lora_a": (12, 2),
        "conv/lora_b": (2, 8),
        "blocks/q/lora_a": (2, 8, 2),
        "blocks/q/lora_b": (2, 2, 8),
        "blocks/mlp/fc1/lora_a": (2, 8, 2),
        "blocks/mlp/fc1/lora_b": (2, 2, 16),
    }
    # They are split like the sides of the kernels that they stand beside.
    assert {path: s.axes for path, s in params.flatten(specs).items()} == {
        "conv/lora_a": (None, None),
        "conv/lora_b": (None, "embed"),
        "blocks/q/lora_a": ("layers", "embed", None),
        "blocks/q/lora_b": ("layers", None, "mlp"),
        "blocks/mlp/fc1/lora_a": ("layers", "embed", None),
        "blocks/mlp/fc1/lora_b": ("layers", None, "mlp"),
    }
    wide = lora.lora_specs({"fc": layers.linear_specs(400, 4)}, 16, "fc")["fc"]["lora_a"]
    a = np.asarray(params.init(jax.random.key(0), {"a": wide})["a"])
    assert 0.99 / 20 < np.abs(a).max() <= 1 / 20  # uniform within 1 / sqrt(d_in), as peft has it
    assert not any(
        np.any(x) for path, x in params.flatten(factors).items() if path.endswith("lora_b")
    )
    assert all(np.any(x) for path, x in params.flatten(factors).items() if path.endswith("lora_a"))


def test_fresh_lora_changes_nothing_bit_for_bit():
    base, _, factors = adapted()
    x = normal(2, 4, 6, 3)
    np.testing.assert_array_equal(
        jax.jit(run)(lora.attach(base, factors), x), jax.jit(run)(base, x)
    )
    for path, leaf in params.flatten(lora.merge(base, factors)).items():
        np.testing.assert_array_equal(leaf, params.flatten(base)[path])


def test_merged_lora_equals_the_branch():
    base, _, factors = adapted()
    factors = jax.tree.map(lambda x: x + 0.1 * normal(*x.shape, seed=x.size), factors)
    x = normal(2, 4, 6, 3)
    branch, merged = run(lora.attach(base, factors), x), run(lora.merge(base, factors), x)
    assert rel_l2(merged, branch) < 5 * FLOAT32
    assert rel_l2(branch, run(base, x)) > 1e-2
    assert params.flatten(lora.merge(base, factors)).keys() == params.flatten(base).keys()


# Configurations.


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_survive_a_round_trip(name):
    assert from_dict(to_dict(preset(name))) == preset(name)


def test_wrong_names_are_answered_with_a_suggestion():
    with pytest.raises(UserError, match=r"Unknown preset 'min'.*mini"):
        preset("min")
    with pytest.raises(UserError, match=r"unknown field 'widht'.*width"):
        from_dict({"widht": 3})
    assert "tiny" in did_you_mean("tyni", PRESETS)


@pytest.mark.parametrize(
    ("field", "value", "advice"),
    [("frames", 16, "13 or 17"), ("height", 100, "96x336"), ("recon_width", 500, "288x496")],
)
def test_sizes_that_do_not_fit_name_the_nearest_that_do(field, value, advice):
    with pytest.raises(UserError, match=advice):
        from_dict({field: value})
