"""The Wan2.1 diffusion transformer: noisy latents and their conditions to a velocity.

One scene, no batch axis (`jax.vmap` adds it). Token order is slot, row, column. The residual stream, the norms, the
modulation and the rotations are float32; matrix products and attention between them read what `core.products` says.
The depth is stacked leaves under `blocks`, walked by one `lax.scan`.
"""

from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from ..config import DiTConfig
from ..core import products
from ..core.attention import PIECES, attention, is_attention, merge_heads, split_heads
from ..core.layers import (
    gelu,
    layer_norm,
    lift,
    linear,
    linear_specs,
    mlp,
    norm_specs,
    patch_conv,
    patch_conv_specs,
    rms_norm,
    unpatchify,
)  # fmt: skip
from ..core.params import Spec, Tree, normal, stack, uniform, zeros
from ..core.recompute import from_rounded
from ..core.rope import frequencies, rotate_pairs
from ..core.sharding import by_heads, constrain
from ..core.stepping import checkpoint

Split = Literal["image_first", "text_last"]
Remat = Literal["none", "dots", "attention", "full"]

EPS = 1e-6  # every norm of the blocks and of the head
CLIP_EPS = 1e-5  # the two norms of the CLIP embedding

# Leaves that stay float32 when the frozen weights are cast to bfloat16 (the official autocast computes them so).
FLOAT32_LEAVES = r"(^|/)(modulation|scale)$|norm\w*/bias$|^time_embed/|^head/"


def _xavier(rng, shape, dtype):
    return uniform(np.sqrt(6.0 / (np.prod(shape[:-1]) + shape[-1])))(rng, shape, dtype)


def dit_specs(cfg: DiTConfig) -> Tree:
    """Leaves of the whole transformer, initialised as the official code does; the head's kernel is zero."""
    assert cfg.text_len or not cfg.clip_dim, "an image branch needs the cross-attention of text"
    d = cfg.width
    embed = patch_conv_specs(cfg.patch, cfg.in_channels, d, init=_xavier)
    bound = (cfg.patch**2 * cfg.in_channels) ** -0.5
    specs: Tree = {
        "patch_embed": embed | {"bias": embed["bias"]._replace(init=uniform(bound))},
        "time_embed": {
            "fc1": linear_specs(cfg.freq_dim, d, (None, "embed"), init=normal(0.02)),
            "fc2": linear_specs(d, d, ("embed", "mlp"), init=normal(0.02)),
            "proj": linear_specs(d, 6 * d, ("embed", "mlp"), init=_xavier),
        },
        "blocks": stack(block_specs(cfg), cfg.depth),
        "head": {
            "modulation": Spec((2, d), (None, "embed"), normal(d**-0.5)),
            "linear": linear_specs(d, cfg.patch**2 * cfg.out_channels, ("embed", None), init=zeros),
        },
    }
    if cfg.text_len:
        specs["text_embed"] = {
            "fc1": linear_specs(cfg.text_dim, d, (None, "embed"), init=normal(0.02)),
            "fc2": linear_specs(d, d, ("embed", "mlp"), init=normal(0.02)),
        }
    if cfg.clip_dim:
        specs["clip_embed"] = {
            "norm1": norm_specs(cfg.clip_dim),
            "fc1": linear_specs(cfg.clip_dim, cfg.clip_dim, (None, None), init=_xavier),
            "fc2": linear_specs(cfg.clip_dim, d, (None, "embed"), init=_xavier),
            "norm2": norm_specs(d),
        }
    return specs


def patch_embed(p: Tree, x: jax.Array) -> jax.Array:
    """Latents [t, lh, lw, c] -> tokens [t * lh/2 * lw/2, d]: the first patch embedding, of [x_sigma; mask; Y]."""
    return patch_conv(p["patch_embed"], x).reshape(-1, p["patch_embed"]["bias"].shape[0])


STEP = 32  # whole timesteps are a * STEP + b, with a, b < STEP


def time_wave(timestep: jax.Array, channels: int) -> jax.Array:
    """[channels]: cosines, then sines of timestep * 10000^(-j / half), as if the angles were float64; 0 <= timestep < 1024.

    In float32 an angle of 1000 is off by 3e-5. So the timestep is cut into a multiple of 32, ones and a rest, all exact:
    waves of the first two come from tables that float64 made, the angle of the rest is small, and turns multiply.
    """
    half = channels // 2
    omega = 10000.0 ** (-np.arange(half) / half)
    t = jnp.asarray(timestep, jnp.float32)
    whole = jnp.clip(jnp.floor(t), 0, STEP**2 - 1)
    ones, angles = whole.astype(jnp.int32), np.arange(STEP)[:, None] * omega
    rest = (t - whole) * omega.astype(np.float32)
    c, s = jnp.cos(rest), jnp.sin(rest)
    for index, table in ((ones % STEP, angles), (ones // STEP, STEP * angles)):
        cosine = jnp.asarray(np.cos(table).astype(np.float32))[index]
        sine = jnp.asarray(np.sin(table).astype(np.float32))[index]
        c, s = c * cosine - s * sine, c * sine + s * cosine
    return jnp.concatenate([c, s])


@products.use(None)
def time_embed(p: Tree, timestep: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Timestep 1000 * sigma, a scalar -> e [d] (modulates the head) and e0 [6, d] (modulates every block)."""
    p = p["time_embed"]
    wave = time_wave(timestep, p["fc1"]["kernel"].shape[0])
    e = linear(p["fc2"], jax.nn.silu(linear(p["fc1"], wave)))
    return e, linear(p["proj"], jax.nn.silu(e)).reshape(6, -1)


def text_embed(p: Tree, text: jax.Array, *, text_len: int) -> jax.Array:
    """Text encoder rows [r, text_dim] -> [text_len, d]. Rows are zero-padded first: padding is attended, unmasked."""
    text = jnp.pad(text, ((0, text_len - text.shape[0]), (0, 0)))
    return mlp(p["text_embed"], text, exact=False)


def clip_embed(p: Tree, clip: jax.Array) -> jax.Array:
    """CLIP rows [clip_rows, clip_dim] -> [clip_rows, d]."""
    p = p["clip_embed"]
    x = linear(p["fc1"], layer_norm(p["norm1"], clip, eps=CLIP_EPS))
    return layer_norm(p["norm2"], linear(p["fc2"], gelu(x, exact=True)), eps=CLIP_EPS)


def context_rows(
    p: Tree, text: jax.Array, clip: jax.Array | None = None, *, cfg: DiTConfig
) -> jax.Array:
    """What cross-attention reads, [s, d]: CLIP rows first if there are any, then the text rows."""
    rows = text_embed(p, text, text_len=cfg.text_len)
    return rows if clip is None else jnp.concatenate([clip_embed(p, clip), rows])


def image_rows(cfg: DiTConfig, rows: int, split: Split) -> int:
    """How many leading context rows go through k_img and v_img.

    `text_last` (official): all but the last `text_len`. `image_first` (FrameCrafter): the first 257, whatever they
    are, so that without CLIP rows half of the text goes there. The two agree when CLIP rows are present.
    """
    if not cfg.clip_dim:
        return 0
    n = cfg.clip_rows if split == "image_first" else rows - cfg.text_len
    assert 0 <= n < rows, f"{n} image rows of {rows} context rows"
    return n


def rope_angles(
    time_index: Sequence[int] | np.ndarray, rows: int, columns: int, head_dim: int
) -> np.ndarray:
    """Rotary angles [slots * rows * columns, head_dim / 2] in radians, float32 computed in float64: a constant.

    `time_index` gives every latent slot its position in time; 0 leaves time unrotated (context slots, and all slots
    of FrameCrafter). Rows and columns are those of the token grid. Of a head's pairs, time takes those that rows
    and columns leave: 22 | 21 | 21 of 64; each axis' frequencies use its own share of the head as denominator.
    """
    space = 2 * (head_dim // 6)
    shares = (head_dim - 2 * space, space, space)
    positions = (np.asarray(time_index), np.arange(rows), np.arange(columns))
    tables = [p[:, None] * frequencies(n, 10000.0) for p, n in zip(positions, shares, strict=True)]
    t, h, w = (len(table) for table in tables)
    full = [
        np.broadcast_to(tables[0][:, None, None], (t, h, w, shares[0] // 2)),
        np.broadcast_to(tables[1][None, :, None], (t, h, w, space // 2)),
        np.broadcast_to(tables[2][None, None, :], (t, h, w, space // 2)),
    ]
    return np.concatenate(full, -1).reshape(t * h * w, head_dim // 2).astype(np.float32)


def _attention_specs(cfg: DiTConfig, *, image: bool = False) -> Tree:
    d, into, out = cfg.width, ("embed", "mlp"), ("mlp", "embed")
    specs = {name: linear_specs(d, d, into, init=_xavier) for name in ("q", "k", "v")}
    specs |= {"o": linear_specs(d, d, out, init=_xavier)}
    specs |= {"norm_q": norm_specs(d, bias=False), "norm_k": norm_specs(d, bias=False)}
    if image:
        specs |= {name: linear_specs(d, d, into, init=_xavier) for name in ("k_img", "v_img")}
        specs |= {"norm_k_img": norm_specs(d, bias=False)}
    return specs


def block_specs(cfg: DiTConfig) -> Tree:
    """Leaves of one block; without text there is no cross-attention, without CLIP no image branch in it."""
    specs = {
        "modulation": Spec((6, cfg.width), (None, "embed"), normal(cfg.width**-0.5)),
        "self_attn": _attention_specs(cfg),
        "ffn": {
            "fc1": linear_specs(cfg.width, cfg.ffn, ("embed", "mlp"), init=_xavier),
            "fc2": linear_specs(cfg.ffn, cfg.width, ("mlp", "embed"), init=_xavier),
        },
    }
    if cfg.text_len:
        specs["cross_norm"] = norm_specs(cfg.width)
        specs["cross_attn"] = _attention_specs(cfg, image=bool(cfg.clip_dim))
    return specs


def cross_kv(p: Tree, rows: jax.Array, *, cfg: DiTConfig, split: Split = "image_first") -> Tree:
    """Keys and values [s, heads, e] of one block's cross-attention, image rows apart, in the kernels' dtype."""
    p, n = p["cross_attn"], image_rows(cfg, rows.shape[0], split)
    kv = {
        "k": rms_norm(p["norm_k"], linear(p["k"], rows[n:]), eps=EPS),
        "v": linear(p["v"], rows[n:]),
    }
    if n:
        kv["k_img"] = rms_norm(p["norm_k_img"], linear(p["k_img"], rows[:n]), eps=EPS)
        kv["v_img"] = linear(p["v_img"], rows[:n])
    dtype = products.dtype_of(
        p["q"]["kernel"]
    )  # attention's own input dtype, so a cache loses nothing
    return {name: split_heads(x, cfg.heads).astype(dtype) for name, x in kv.items()}


def precompute_context(
    p: Tree, rows: jax.Array, *, cfg: DiTConfig, split: Split = "image_first"
) -> Tree:
    """`cross_kv` of every block, stacked [depth, s, heads, e]: the same at all sampling steps."""
    return jax.lax.map(lambda block: cross_kv(block, rows, cfg=cfg, split=split), p["blocks"])


def _modulate(x: jax.Array, shift: jax.Array, scale: jax.Array) -> jax.Array:
    return layer_norm({}, x, eps=EPS) * lift(1.0 + scale, x.ndim) + lift(shift, x.ndim)


def by_tokens(x: jax.Array) -> jax.Array:
    """Tokens [l, d] before they turn into heads. Left to itself XLA sends whole tokens to the products, and their
    gradient back in float32."""
    return constrain(x, ("tokens", None))


def self_attention(p: Tree, x: jax.Array, angles: jax.Array, *, heads: int) -> jax.Array:
    """Attention of tokens [l, d] over themselves; q and k are normalised over the full width, then rotated."""
    q = rms_norm(p["norm_q"], linear(p["q"], x), eps=EPS)
    k = rms_norm(p["norm_k"], linear(p["k"], x), eps=EPS)
    q, k, v = (split_heads(by_tokens(y), heads) for y in (q, k, linear(p["v"], x)))
    dtype = products.dtype_of(p["q"]["kernel"])
    q, k, v = by_heads(rotate_pairs(q, angles), rotate_pairs(k, angles), v, dtype)
    y = merge_heads(attention(q, k, v, dtype=dtype, over="attention_heads"))
    return linear(p["o"], constrain(y, ("tokens", None)))


def cross_attention(p: Tree, x: jax.Array, kv: Tree, *, heads: int) -> jax.Array:
    """Tokens [l, d] read text and image rows through two softmaxes with the same q, added before `o`."""
    dtype = products.dtype_of(p["q"]["kernel"])
    q = by_tokens(rms_norm(p["norm_q"], linear(p["q"], x), eps=EPS))
    q = split_heads(q, heads)

    def read(k, v):
        return attention(*by_heads(q, k, v, dtype), dtype=dtype, over="attention_heads")

    y = read(kv["k"], kv["v"])
    if "k_img" in kv:
        y = y + read(kv["k_img"], kv["v_img"])
    return linear(p["o"], constrain(merge_heads(y), ("tokens", None)))


def block(
    p: Tree, x: jax.Array, e0: jax.Array, angles: jax.Array, kv: Tree | None, *, heads: int
) -> jax.Array:
    """One transformer block on tokens x [l, d] float32; `kv` is that of `cross_kv`, None without text."""
    shift_a, scale_a, gate_a, shift_f, scale_f, gate_f = p["modulation"].astype(jnp.float32) + e0
    y = self_attention(p["self_attn"], _modulate(x, shift_a, scale_a), angles, heads=heads)
    x = x + y * lift(gate_a, x.ndim)
    if kv is not None:
        y = layer_norm(p["cross_norm"], x, eps=EPS)
        x = x + cross_attention(p["cross_attn"], y, kv, heads=heads)
    y = mlp(p["ffn"], _modulate(x, shift_f, scale_f), exact=False)
    return x + y * lift(gate_f, x.ndim)


POLICIES: dict[Remat, Any] = {
    "full": None,
    "attention": is_attention,
    "dots": jax.checkpoint_policies.save_from_both_policies(
        jax.checkpoint_policies.dots_with_no_batch_dims_saveable,
        jax.checkpoint_policies.save_only_these_names(PIECES),
    ),
}


def rematerialise(f, remat: Remat):
    """f(x, rest) -> y as a loop's body whose backward pass recomputes everything (full), all but what attention returns
    (attention), all but products with weights and attention in pieces (dots), or nothing (none).

    `full` keeps x in bfloat16 where products are asked for in it.
    """
    if remat == "none":
        return f
    if remat == "full" and products.rounded(products.BF16):
        return from_rounded(f)
    return checkpoint(f, policy=POLICIES[remat], prevent_cse=False)


def dit_blocks(
    p: Tree,
    x: jax.Array,
    e0: jax.Array,
    angles: jax.Array,
    *,
    cfg: DiTConfig,
    rows: jax.Array | None = None,
    kv: Tree | None = None,
    split: Split = "image_first",
    remat: Remat = "none",
    unroll: int = 1,
) -> jax.Array:
    """All blocks on tokens x [l, d]. Cross-attention reads `kv` (precomputed) or computes it from `rows` in each block."""
    assert angles.shape == (x.shape[0], cfg.width // cfg.heads // 2), (angles.shape, x.shape)
    assert (rows is None) or (kv is None), "context rows or their keys and values, not both"
    assert bool(cfg.text_len) == (rows is not None or kv is not None), "context iff text_len > 0"

    def one(x, rest):
        (p, kv), (e0, angles, rows) = rest
        if rows is not None:
            kv = cross_kv(p, rows, cfg=cfg, split=split)
        return constrain(block(p, x, e0, angles, kv, heads=cfg.heads), ("tokens", None))

    shared, step = (e0, angles, rows), rematerialise(one, remat)
    x = constrain(x, ("tokens", None))
    layers = p["blocks"], kv
    x, _ = jax.lax.scan(lambda x, layer: (step(x, (layer, shared)), None), x, layers, unroll=unroll)
    return x


@products.use(None)
def head(p: Tree, x: jax.Array, e: jax.Array, *, grid: tuple[int, int, int], patch: int):
    """Tokens [l, d] of a (slots, rows, columns) grid -> velocity [t, lh, lw, c], modulated by e [d] (not e0)."""
    t, rows, columns = grid
    shift, scale = p["head"]["modulation"].astype(jnp.float32) + e[None, :]
    y = linear(p["head"]["linear"], _modulate(x, shift, scale))
    return unpatchify(y.reshape(t, rows * columns, -1), (rows, columns), patch)


def dit(
    p: Tree,
    x: jax.Array,
    timestep: jax.Array,
    angles: jax.Array,
    *,
    cfg: DiTConfig,
    rows: jax.Array | None = None,
    kv: Tree | None = None,
    extra_tokens: jax.Array | None = None,
    split: Split = "image_first",
    remat: Remat = "none",
    unroll: int = 1,
) -> jax.Array:
    """Velocity (noise - x0) [t, lh, lw, 16], float32.

    x [t, lh, lw, in_channels] is [noisy latent; mask; condition latent]; `timestep` = 1000 * sigma; `angles` as from
    `rope_angles`; `rows` as from `context_rows`, or `kv` as from `precompute_context`. `extra_tokens` [l, d] joins
    after the patch embedding: RoGe's embeddings of rays and geometry. `remat` says what the backward pass recomputes.
    """
    t, lh, lw, c = x.shape
    assert c == cfg.in_channels, f"{c} channels, expected {cfg.in_channels}"
    tokens = patch_embed(p, x)
    if extra_tokens is not None:
        tokens = tokens + extra_tokens
    e, e0 = time_embed(p, timestep)
    tokens = dit_blocks(
        p, tokens, e0, angles, cfg=cfg, rows=rows, kv=kv, split=split, remat=remat, unroll=unroll
    )
    return head(p, tokens, e, grid=(t, lh // cfg.patch, lw // cfg.patch), patch=cfg.patch)
