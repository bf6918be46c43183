"""The diffusion transformer: equal to the published one on stored cases, and properties that must hold."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parity import load_case, rel_l2, rule_weights

from roge_jax.config import DiTConfig
from roge_jax.core import lora, params
from roge_jax.core.layers import patch_conv, patchify
from roge_jax.video import dit as net
from roge_jax.weights import mapping, wan_dit

TOLERANCE = 1e-5  # relative L2, float32; see parity.py
CASES = [
    "wan_dit_t2v_tiny",
    "wan_dit_i2v_tiny",
    "wan_dit_i2v_eps_tiny",
    "wan_dit_framecrafter_tiny",
]

SMALL = DiTConfig(
    width=48,
    heads=2,
    depth=3,
    ffn=64,
    freq_dim=16,
    text_dim=8,
    text_len=6,
    clip_dim=12,
    clip_rows=4,
)
TIMES = (0, 0, 0, 1, 2)  # two context slots, three targets: the first target is at time 0 too
GRID = (5, 2, 3)


def stored_case(name):
    """Everything a case needs: config, our parameters, inputs, and the rows of the embeddings it stored."""
    case = load_case(name)
    t, crafter = case.tensors, "framecrafter" in name
    cfg = wan_dit.dit_config({k: tuple(s) for k, s, _ in case.info["state_dict_keys"]})
    assert (cfg.heads, cfg.depth) == (case.config["num_heads"], case.config["num_layers"])
    p = mapping.to_ours(wan_dit.dit_entries(cfg), rule_weights(case))
    parts = [t[key][0] for key in ("in.latent", "in.y", "in.raymap") if key in t]
    x = np.moveaxis(np.concatenate(parts), 0, -1)  # [t, lh, lw, c]
    slots, lh, lw, _ = x.shape
    grid = (slots, lh // 2, lw // 2)
    times = np.zeros(slots, int) if crafter else np.arange(slots)
    angles = net.rope_angles(times, *grid[1:], cfg.width // cfg.heads)
    text = t["in.text"][0] if crafter else t["in.text0"]
    clip = t["in.clip"][0] if "in.clip" in t else None
    step = {"wan_dit_i2v_tiny": 4}.get(name, 1)
    kept = [0, 1, 2, 256, 257, 511] if crafter else range(0, case.config["text_rows"][0] + 1, step)
    return case, cfg, p, x, grid, angles, text, clip, np.asarray(kept)


@pytest.mark.parametrize("name", CASES)
def test_equals_the_published_network(name):
    case, cfg, p, x, grid, angles, text, clip, kept = stored_case(name)
    params.check(p, net.dit_specs(cfg))
    split = "image_first" if "framecrafter" in name else "text_last"
    timestep = case.tensors["in.t"][0]

    @jax.jit
    def trace(p, x, timestep, text, clip):
        tokens = net.patch_embed(p, x)
        e, e0 = net.time_embed(p, timestep)
        text_tokens = net.text_embed(p, text, text_len=cfg.text_len)
        found = {"mid.patch_tokens": tokens, "mid.e": e, "mid.e0": e0}
        found["mid.text_tokens_sub"] = text_tokens[kept]
        found["mid.text_tokens_last_row"] = text_tokens[-1]
        if clip is not None:
            found["mid.clip_tokens_sub"] = net.clip_embed(p, clip)[::16]
        rows = net.context_rows(p, text, clip, cfg=cfg)

        def step(x, layer):
            kv = net.cross_kv(layer, rows, cfg=cfg, split=split)
            x = net.block(layer, x, e0, angles, kv, heads=cfg.heads)
            return x, x

        out, outs = jax.lax.scan(step, tokens, p["blocks"])
        found |= {f"mid.block{i}_out": outs[i] for i in range(cfg.depth)}
        features = patchify(net.head(p, out, e, grid=grid, patch=cfg.patch), cfg.patch)
        found["mid.head_out"] = features.reshape(-1, features.shape[-1])
        velocity = net.dit(p, x, timestep, angles, cfg=cfg, rows=rows, split=split)
        return found | {"out.velocity": jnp.moveaxis(velocity, -1, 0)}

    with jax.default_matmul_precision("highest"):
        found = trace(p, x, timestep, text, clip)
    expected = {key: value[0] for key, value in case.tensors.items() if not key.startswith("in.")}
    errors = {key: rel_l2(found[key], value) for key, value in expected.items()}
    print(name, {key: f"{value:.1e}" for key, value in errors.items()})
    assert all(value <= TOLERANCE for value in errors.values()), errors
    assert errors["mid.e"] < 2e-6 and errors["mid.e0"] < 2e-6  # angles in float32 give 6e-6


def test_angles_of_the_timestep_are_those_of_float64():
    """At every whole timestep and between them; float32 alone would be off by 6e-5. The slope is that of the wave."""
    t = np.concatenate([np.arange(1001), 1000 * np.random.default_rng(0).random(500)])
    t = t.astype(np.float32)
    omega = 10000.0 ** (-np.arange(128) / 128)
    angle = t.astype(np.float64)[:, None] * omega
    want = np.concatenate([np.cos(angle), np.sin(angle)], 1)
    made = jax.jit(jax.vmap(lambda t: net.time_wave(t, 256)))(t)
    assert np.abs(made - want).max() < 3e-7
    slope = jax.jit(jax.vmap(jax.grad(lambda t: net.time_wave(t, 256)[3])))(t[-9:])
    np.testing.assert_allclose(slope, -omega[3] * np.sin(angle[-9:, 3]), atol=1e-6)


def random_params(cfg, seed=0):
    """Made-up weights for every leaf (also the head, whose kernel starts at zero): nothing is trivially equal."""
    rng = np.random.default_rng(seed)

    def leaf(path, shape):
        noise = rng.standard_normal(shape, np.float32)
        if path.endswith("kernel"):
            return jnp.asarray(noise / np.sqrt(np.prod(shape[path.startswith("blocks/") : -1])))
        return jnp.asarray(0.2 * noise + path.endswith("scale"))

    flat = params.flatten(net.dit_specs(cfg))
    return params.unflatten({path: leaf(path, spec.shape) for path, spec in flat.items()})


def inputs(cfg, seed=2):
    (t, gh, gw), rng = GRID, np.random.default_rng(seed)
    x = jnp.asarray(rng.standard_normal((t, 2 * gh, 2 * gw, cfg.in_channels), np.float32))
    text = jnp.asarray(rng.standard_normal((3, cfg.text_dim), np.float32))
    clip = jnp.asarray(rng.standard_normal((cfg.clip_rows, cfg.clip_dim), np.float32))
    return x, text if cfg.text_len else None, clip if cfg.clip_dim else None


def angles_for(cfg, times=TIMES):
    return net.rope_angles(times, *GRID[1:], cfg.width // cfg.heads)


@functools.partial(jax.jit, static_argnames=("cfg", "split", "remat", "unroll"))
def run(p, x, timestep, angles, text, clip, cfg, split="image_first", remat="none", unroll=1):
    rows = None if text is None else net.context_rows(p, text, clip, cfg=cfg)
    return net.dit(
        p, x, timestep, angles, cfg=cfg, rows=rows, split=split, remat=remat, unroll=unroll
    )


@pytest.fixture(scope="module")
def small():
    p = random_params(SMALL)
    x, text, clip = inputs(SMALL)
    return p, x, text, clip, np.asarray(run(p, x, 400.0, angles_for(SMALL), text, clip, SMALL))


def test_new_weights_give_zero_velocity_and_follow_the_official_init():
    cfg = dataclasses.replace(SMALL, width=192, depth=2)
    p = params.init(jax.random.key(0), net.dit_specs(cfg))
    x, text, clip = inputs(cfg)
    assert not np.any(run(p, x, 400.0, angles_for(cfg), text, clip, cfg))
    q = np.asarray(p["blocks"]["self_attn"]["q"]["kernel"])
    assert 0.99 * np.sqrt(6 / 384) < np.abs(q).max() <= np.sqrt(6 / 384)  # Xavier, both layers
    assert not np.array_equal(q[0], q[1])
    std = {
        "blocks/modulation": 192**-0.5,
        "text_embed/fc2/kernel": 0.02,
        "time_embed/fc1/kernel": 0.02,
    }
    flat = params.flatten(p)
    for path, value in std.items():
        n = flat[path].size
        assert abs(np.std(flat[path]) / value - 1) < 4 / np.sqrt(2 * n), path


def test_context_slots_are_exchangeable_and_targets_are_not(small):
    p, x, text, clip, base = small
    angles = angles_for(SMALL)
    swapped = np.asarray(run(p, x[jnp.array([1, 0, 2, 3, 4])], 400.0, angles, text, clip, SMALL))
    np.testing.assert_allclose(swapped[[1, 0, 2, 3, 4]], base, rtol=0, atol=1e-5 * base.std())
    turned = np.asarray(run(p, x[jnp.array([0, 1, 2, 4, 3])], 400.0, angles, text, clip, SMALL))
    assert rel_l2(turned[[0, 1, 2, 4, 3]], base) > 1e-3


def test_only_differences_of_time_matter(small):
    p, x, text, clip, base = small
    later = angles_for(SMALL, np.asarray(TIMES) + 40)
    assert rel_l2(run(p, x, 400.0, later, text, clip, SMALL), base) < 2e-5
    other = angles_for(SMALL, np.arange(5))
    assert rel_l2(run(p, x, 400.0, other, text, clip, SMALL), base) > 1e-3


def test_rope_angles_by_hand():
    angles = net.rope_angles((0, 7), 3, 5, 128).reshape(2, 3, 5, 64)
    np.testing.assert_array_equal(angles[0, :, :, :22], 0)
    np.testing.assert_allclose(angles[1, 2, 4, [0, 21]], [7, 7 * 10000 ** (-42 / 44)], rtol=1e-6)
    np.testing.assert_allclose(angles[1, 2, 4, [22, 42]], [2, 2 * 10000 ** (-40 / 42)], rtol=1e-6)
    np.testing.assert_allclose(angles[1, 2, 4, [43, 63]], [4, 4 * 10000 ** (-40 / 42)], rtol=1e-6)


def test_zero_lora_changes_no_bit_and_merging_equals_the_branch(small):
    p, x, text, clip, base = small
    specs = lora.lora_specs(net.dit_specs(SMALL), 2, r"blocks/.*(attn|ffn)/|patch_embed$")
    factors = params.init(jax.random.key(5), specs)
    args = (x, 400.0, angles_for(SMALL), text, clip, SMALL)
    with jax.disable_jit():  # operation by operation: a compiler may round what it fuses otherwise
        exact = [run(tree, *args) for tree in (lora.attach(p, factors), p)]
    np.testing.assert_array_equal(*exact)
    factors = jax.tree.map(
        lambda leaf: 0.1 * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), factors
    )
    branch, merged = run(lora.attach(p, factors), *args), run(lora.merge(p, factors), *args)
    assert rel_l2(branch, merged) < TOLERANCE
    assert rel_l2(branch, base) > 1e-2


def test_cached_context_equals_recomputed_context(small):
    p, x, text, clip, base = small

    @jax.jit
    def cache(p, text, clip):
        rows = net.context_rows(p, text, clip, cfg=SMALL)
        return net.precompute_context(p, rows, cfg=SMALL)

    kv = cache(p, text, clip)
    assert kv["k_img"].shape == (SMALL.depth, SMALL.clip_rows, SMALL.heads, 24)
    assert kv["v"].shape == (SMALL.depth, SMALL.text_len, SMALL.heads, 24)
    cached = jax.jit(functools.partial(net.dit, cfg=SMALL))(p, x, 400.0, angles_for(SMALL), kv=kv)
    assert rel_l2(cached, base) < 1e-6


def test_split_rules_agree_with_clip_rows_and_differ_without(small):
    p, x, text, _, _ = small
    args = (p, x, 400.0, angles_for(SMALL), text, None, SMALL)
    assert rel_l2(run(*args, split="text_last"), run(*args, split="image_first")) > 1e-3
    assert net.image_rows(DiTConfig(), 512, "image_first") == 257
    assert net.image_rows(DiTConfig(), 512, "text_last") == 0
    assert net.image_rows(DiTConfig(), 769, "text_last") == 257


def test_scan_equals_unrolled_and_a_python_loop(small):
    p, x, text, clip, base = small
    angles = angles_for(SMALL)
    assert rel_l2(run(p, x, 400.0, angles, text, clip, SMALL, unroll=SMALL.depth), base) < 1e-6

    @jax.jit
    def loop(p, x, text, clip):
        tokens, (e, e0) = net.patch_embed(p, x), net.time_embed(p, 400.0)
        rows = net.context_rows(p, text, clip, cfg=SMALL)
        for i in range(SMALL.depth):
            layer = jax.tree.map(lambda leaf, i=i: leaf[i], p["blocks"])
            kv = net.cross_kv(layer, rows, cfg=SMALL)
            tokens = net.block(layer, tokens, e0, angles, kv, heads=SMALL.heads)
        return net.head(p, tokens, e, grid=GRID, patch=2)

    assert rel_l2(loop(p, x, text, clip), base) < 1e-6


def test_recomputation_policies_give_one_gradient():
    cfg = dataclasses.replace(SMALL, clip_dim=0)
    p, (x, text, _), angles = random_params(cfg), inputs(cfg), angles_for(cfg)

    def gradient(remat):
        def loss(p):
            return jnp.sum(jnp.sin(run(p, x, 400.0, angles, text, None, cfg, remat=remat)))

        grad = params.flatten(jax.jit(jax.grad(loss))(p))
        return {path: np.asarray(leaf, np.float64) for path, leaf in grad.items()}

    reference = gradient("none")
    assert all(np.any(leaf) for leaf in reference.values())
    whole = np.sqrt(sum(np.sum(leaf**2) for leaf in reference.values()))
    for remat in ("full", "attention", "dots"):
        for path, leaf in gradient(remat).items():
            # Key biases nearly cancel in the softmax: what is left of them is rounding at the scale of the whole.
            scale = max(np.linalg.norm(reference[path]), 1e-2 * whole)
            assert np.linalg.norm(leaf - reference[path]) < TOLERANCE * scale, (remat, path)


def test_one_trace_serves_all_noise_levels(small):
    p, x, text, clip, _ = small
    traces = []

    @jax.jit
    def counted(p, x, timestep):
        traces.append(1)
        rows = net.context_rows(p, text, clip, cfg=SMALL)
        return net.dit(p, x, timestep, angles_for(SMALL), cfg=SMALL, rows=rows)

    outs = [counted(p, x + i, jnp.float32(100.0 * i)) for i in range(3)]
    assert len(traces) == 1
    assert rel_l2(outs[1], outs[2]) > 1e-3


def test_a_batch_is_a_vmap(small):
    p, x, text, clip, base = small
    steps = jnp.array([400.0, 900.0])
    pair = jax.vmap(lambda x, s: run(p, x, s, angles_for(SMALL), text, clip, SMALL))(
        jnp.stack([x, x[::-1]]), steps
    )
    alone = run(p, x[::-1], 900.0, angles_for(SMALL), text, clip, SMALL)
    assert rel_l2(pair[0], base) < 1e-6
    assert rel_l2(pair[1], alone) < 1e-6


def test_extra_tokens_are_a_patch_embedding_of_more_channels(small):
    """Embedding conditions apart and adding them equals one wider patch embedding (paper: E1 + E2 + E3)."""
    p, x, text, clip, _ = small
    more = jax.random.normal(jax.random.key(8), (*x.shape[:3], 5))
    kernel = 0.1 * jax.random.normal(jax.random.key(9), (2, 2, 5, SMALL.width))
    wide = p | {"patch_embed": dict(p["patch_embed"])}
    wide["patch_embed"]["kernel"] = jnp.concatenate([p["patch_embed"]["kernel"], kernel], 2)
    angles, cfg = angles_for(SMALL), dataclasses.replace(SMALL, in_channels=41)
    together = run(wide, jnp.concatenate([x, more], -1), 400.0, angles, text, clip, cfg)

    @jax.jit
    def apart(p, kernel):
        extra = patch_conv({"kernel": kernel}, more).reshape(-1, SMALL.width)
        rows = net.context_rows(p, text, clip, cfg=SMALL)
        return net.dit(p, x, 400.0, angles, cfg=SMALL, rows=rows, extra_tokens=extra)

    assert rel_l2(apart(p, kernel), together) < TOLERANCE


def test_widened_weights_ignore_the_new_channels():
    narrow = dataclasses.replace(SMALL, in_channels=16, clip_dim=0)
    p, (x, text, _) = random_params(narrow), inputs(SMALL)
    angles = angles_for(SMALL)
    before = run(p, x[..., :16], 400.0, angles, text, None, narrow)
    cfg = dataclasses.replace(narrow, in_channels=36)
    wide = wan_dit.widen(p, 36)
    params.check(wide, net.dit_specs(cfg))
    assert rel_l2(run(wide, x, 400.0, angles, text, None, cfg), before) < 1e-6


def test_without_text_there_is_no_cross_attention():
    cfg = dataclasses.replace(SMALL, text_len=0, clip_dim=0)
    specs = params.flatten(net.dit_specs(cfg))
    assert not [path for path in specs if re.search("cross|text|clip", path)]
    p, (x, _, _) = random_params(cfg), inputs(cfg)
    out = run(p, x, 400.0, angles_for(cfg), None, None, cfg)
    assert out.shape == (*x.shape[:3], 16) and np.all(np.isfinite(out)) and np.std(out) > 0.1


def test_sixteen_bit_kernels_keep_a_float32_stream(small):
    p, x, text, clip, base = small
    half = params.unflatten(
        {
            path: leaf if re.search(net.FLOAT32_LEAVES, path) else leaf.astype(jnp.bfloat16)
            for path, leaf in params.flatten(p).items()
        }
    )
    kept = {path for path, leaf in params.flatten(half).items() if leaf.dtype == jnp.float32}
    assert {"blocks/modulation", "blocks/cross_norm/bias", "head/linear/kernel"} <= kept
    assert not [
        path
        for path in kept
        if re.search(r"(attn/\w+|fc\d|patch_embed)/kernel", path) and "time" not in path
    ]
    out = run(half, x, 400.0, angles_for(SMALL), text, clip, SMALL)
    assert out.dtype == jnp.float32
    # Every weight and every matmul input is rounded to 8 bits: 2^-9 each, a few dozen of them, added at random.
    assert 1e-4 < rel_l2(out, base) < 40**0.5 * 2**-8
