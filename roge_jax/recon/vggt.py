"""Camera-conditioned VGGT: context photos and their cameras become scene tokens.

Patch encoder (DINOv2 with registers, or a linear embedding of RGB and rays), then alternating attention within and
across views; the last frame-block and global-block outputs side by side are the tokens of a view. Facts on the
published network: VGGT (Wang et al. 2025) as adapted by LagerNVS (Szymanowicz et al. 2026).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from ..config import EncoderConfig
from ..core import products
from ..core.attention import attention, merge_heads, split_heads
from ..core.layers import (
    layer_norm,
    lift,
    linear,
    linear_specs,
    mlp,
    mlp_specs,
    norm_specs,
    patch_conv,
    patch_conv_specs,
)
from ..core.params import Spec, Tree, constant, fan_in, normal, ones, stack
from ..core.rope import grid_angles, rotate_halves
from ..core.stepping import checkpoint
from .relative import Relative, relative_cameras, to_key, to_output, to_query

IMAGE_MEAN, IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DINO_EPS, EPS = 1e-6, 1e-5
SPECIALS = 1  # camera token in front of the registers


# One transformer block, in DINOv2 (no q/k norm, no rotation) and in the alternating stack.


def block_specs(d: int, heads: int, *, qk_norm: bool, depth: int) -> Tree:
    """Pre-norm attention and MLP with layer scale; `depth` scales the initial values of the outputs."""
    out = fan_in((2 * depth) ** -0.5)
    attn = {
        "qkv": linear_specs(d, 3 * d, ("embed", "heads")),
        "proj": linear_specs(d, d, ("heads", "embed"), init=out),
    }
    if qk_norm:
        attn |= {"q_norm": norm_specs(d // heads), "k_norm": norm_specs(d // heads)}
    return {
        "norm1": norm_specs(d),
        "attn": attn,
        "ls1": {"gamma": Spec((d,), (None,), ones)},
        "norm2": norm_specs(d),
        "mlp": mlp_specs(d, 4 * d, init_out=out),
        "ls2": {"gamma": Spec((d,), (None,), ones)},
    }


def block(
    p: Tree, x: jax.Array, heads: int, *, eps: float, rotate=None, relative: Relative | None = None
):
    """x [v, l, d] -> the same shape. `rotate` turns queries and keys [v, l, k, e]; with `relative` the attention is
    over all views at once and their cameras act on queries, keys, values and outputs.
    """
    y = layer_norm(p["norm1"], x, eps=eps)
    x = x + self_attention(p["attn"], y, heads, eps=eps, rotate=rotate, relative=relative) * lift(
        p["ls1"]["gamma"], x.ndim
    )
    y = mlp(p["mlp"], layer_norm(p["norm2"], x, eps=eps), exact=True)
    return x + y * lift(p["ls2"]["gamma"], x.ndim)


def self_attention(p: Tree, x: jax.Array, heads: int, *, eps: float, rotate=None, relative=None):
    """Attention of x [v, l, d] within each view or, with `relative`, over all views at once; the same shape."""
    q, k, v = (split_heads(t, heads) for t in jnp.split(linear(p["qkv"], x), 3, axis=-1))
    if "q_norm" in p:
        q, k = layer_norm(p["q_norm"], q, eps=eps), layer_norm(p["k_norm"], k, eps=eps)
    if relative is not None:
        q, k, v = to_query(relative, q), to_key(relative, k), to_key(relative, v)
    elif rotate is not None:
        q, k = rotate(q), rotate(k)
    dtype = products.dtype_of(p["qkv"]["kernel"])
    if relative is None:
        return linear(p["proj"], merge_heads(attention(q, k, v, dtype=dtype)))
    flat = [t.reshape(1, -1, *t.shape[2:]) for t in (q, k, v)]
    y = attention(*flat, dtype=dtype).reshape(q.shape)
    return linear(p["proj"], merge_heads(to_output(relative, y)))


# DINOv2 ViT with registers.


def dino_heads(cfg: EncoderConfig) -> int:
    """Heads of DINOv2, which need not be those of the alternating blocks."""
    return cfg.dino_heads or cfg.heads


def dino_specs(cfg: EncoderConfig) -> Tree:
    """Leaves of DINOv2 with registers (the `cfg.dino_depth` blocks in front of the alternating stack)."""
    d, tokens = cfg.width, cfg.position_grid**2 + 1
    return {
        "patch_embed": patch_conv_specs(cfg.patch, 3, d),
        "cls_token": Spec((d,), ("embed",), normal(0.02)),
        "pos_embed": Spec((tokens, d), (None, "embed"), normal(0.02)),
        "register_tokens": Spec((cfg.registers, d), (None, "embed"), normal(0.02)),
        "mask_token": Spec((d,), ("embed",), normal(0.02)),  # in the official files, never used
        "blocks": stack(
            block_specs(d, dino_heads(cfg), qk_norm=False, depth=cfg.dino_depth), cfg.dino_depth
        ),
        "norm": norm_specs(d),
    }


def position_table(p: Tree, grid: tuple[int, int]) -> jax.Array:
    """The learned table [1 + g*g, d] resampled to [1 + rows * columns, d] (antialiased bicubic)."""
    table = p["pos_embed"].astype(jnp.float32)
    side = int(np.sqrt(table.shape[0] - 1))
    if grid == (side, side):
        return table
    patches = table[1:].reshape(side, side, -1)
    patches = jax.image.resize(patches, (*grid, patches.shape[-1]), "bicubic", antialias=True)
    return jnp.concatenate([table[:1], patches.reshape(-1, patches.shape[-1])])


def dino(p: Tree, images: jax.Array, *, cfg: EncoderConfig) -> tuple[jax.Array, dict]:
    """ImageNet-normalised images [v, h, w, 3] -> patch tokens [v, l, d] and named intermediates."""
    v, h, w, _ = images.shape
    grid = (h // cfg.patch, w // cfg.patch)
    positions = position_table(p, grid)
    tokens = patch_conv(p["patch_embed"], images) + positions[None, 1:]
    first = p["cls_token"].astype(jnp.float32) + positions[0]
    lead = jnp.concatenate([first[None], p["register_tokens"].astype(jnp.float32)])
    x = jnp.concatenate([jnp.broadcast_to(lead[None], (v, *lead.shape)), tokens], 1)
    out = {"pos_embed": positions, "tokens_in": x}
    step = checkpoint(lambda x, p: (block(p, x, dino_heads(cfg), eps=DINO_EPS), None))
    x, _ = jax.lax.scan(step, x, p["blocks"])
    out["prenorm"] = x
    x = layer_norm(p["norm"], x, eps=DINO_EPS)
    out["specials"] = x[:, : len(lead)]
    return x[:, len(lead) :], out


# The aggregator and the whole encoder.


def encoder_specs(cfg: EncoderConfig, scene_width: int) -> Tree:
    """Leaves of the reconstructor: patch encoder, alternating attention, camera MLP, projection to `scene_width`."""
    d = cfg.width
    patch_encoder = (
        dino_specs(cfg) if cfg.dino_depth else {"patch_embed": patch_conv_specs(cfg.patch, 9, d)}
    )
    blocks = stack(block_specs(d, cfg.heads, qk_norm=True, depth=2 * cfg.depth), cfg.depth)
    return {
        "patch_encoder": patch_encoder,
        "camera_token": Spec((2, d), (None, "embed"), normal(0.02)),
        "register_token": Spec((2, cfg.registers, d), (None, None, "embed"), normal(0.02)),
        "frame_blocks": blocks,
        "global_blocks": blocks,
        "camera_mlp": {
            "fc1": linear_specs(11, d, (None, "embed")),
            "fc2": linear_specs(d, d, ("mlp", "embed")),
        },
        "connector": linear_specs(2 * d, scene_width, ("mlp", "embed")),
        "connector_norm": {"scale": Spec((scene_width,), (None,), constant(1.0))},
    }


def camera_tokens(p: Tree, vectors: jax.Array) -> jax.Array:
    """Camera vectors [m, 11] -> [m, d], added to the camera tokens."""
    return linear(p["fc2"], jax.nn.silu(linear(p["fc1"], vectors)))


def encoder_size(cfg: EncoderConfig, height: int, width: int) -> tuple[int, int]:
    """The size at which the encoder looks at an image: longer side `long_side`, shorter floored to whole patches."""
    if cfg.long_side is None:
        return height, width
    if height > width:
        return cfg.long_side, int(cfg.long_side * width / height) // cfg.patch * cfg.patch
    return int(cfg.long_side * height / width) // cfg.patch * cfg.patch, cfg.long_side


def encoder_grid(cfg: EncoderConfig, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of the patch tokens of an image of height x width."""
    h, w = encoder_size(cfg, height, width)
    return h // cfg.patch, w // cfg.patch


def aggregate(
    p: Tree,
    images: jax.Array,
    camera_add: jax.Array | None,
    *,
    cfg: EncoderConfig,
    plucker: jax.Array | None = None,
    relative: Relative | None = None,
    collect: bool = False,
) -> tuple[jax.Array, dict]:
    """Images [m, h, w, 3] in [0, 1] -> tokens [m, 1 + registers + l, 2d], special tokens first; intermediates.

    `camera_add` [m, d] is the output of the camera MLP (None: unconditioned). `plucker` [m, h, w, 6] enters only the
    linear patch embedding. With `collect` the intermediates hold every block's output [depth, m, l, d].
    """
    m, h, w, _ = images.shape
    x = (images - lift(jnp.asarray(IMAGE_MEAN), 4)) / lift(jnp.asarray(IMAGE_STD), 4)
    if cfg.dino_depth:
        patches, _ = dino(p["patch_encoder"], x, cfg=cfg)
    else:
        assert plucker is not None, "the linear patch embedding reads rays"
        patches = patch_conv(p["patch_encoder"]["patch_embed"], jnp.concatenate([x, plucker], -1))
    out = {"patch_tokens": patches}
    slot = np.minimum(np.arange(m), 1)  # view 0 is the reference and has tokens of its own
    camera = p["camera_token"].astype(jnp.float32)[slot]
    camera = camera if camera_add is None else camera + camera_add
    registers = p["register_token"].astype(jnp.float32)[slot]
    x = jnp.concatenate([camera[:, None], registers, patches], 1)

    grid = (h // cfg.patch, w // cfg.patch)
    table = grid_angles(*grid, cfg.width // cfg.heads // 2, 100.0, offset=1)
    specials = SPECIALS + cfg.registers
    angles = jnp.concatenate([jnp.zeros((specials, *table.shape[1:])), jnp.asarray(table)])

    def rotate(t, angles):
        row, column = jnp.split(t, 2, axis=-1)
        return jnp.concatenate(
            [rotate_halves(row, angles[:, 0]), rotate_halves(column, angles[:, 1])], -1
        )

    def across_views(p, x):
        if relative is not None:
            return block(p, x, cfg.heads, eps=EPS, relative=relative)
        turn = functools.partial(rotate, angles=jnp.tile(angles, (m, 1, 1)))
        return block(p, x.reshape(1, -1, x.shape[-1]), cfg.heads, eps=EPS, rotate=turn).reshape(
            x.shape
        )

    @checkpoint
    def pair(carry, p):
        frame, overall = p
        x = block(
            frame, carry[1], cfg.heads, eps=EPS, rotate=functools.partial(rotate, angles=angles)
        )
        carry = (x, across_views(overall, x))
        return carry, carry if collect else None

    last, collected = jax.lax.scan(pair, (x, x), (p["frame_blocks"], p["global_blocks"]))
    if collect:
        out["frame_blocks"], out["global_blocks"] = collected
    return jnp.concatenate(last, -1), out


def encode_scene(
    p: Tree,
    images: jax.Array,
    vectors: jax.Array,
    plucker: jax.Array,
    K: jax.Array,
    c2w: jax.Array,
    *,
    cfg: EncoderConfig,
) -> jax.Array:
    """Context photos -> scene tokens Z [m, l, scene_width] (Sec. 3.1 of the paper, projected and normalised).

    images [m, h, w, 3] in [0, 1]; vectors [m, 11] of `geometry.cameras.camera_vector`; plucker [m, h, w, 6]; K in
    pixels of the images and c2w normalised (both used only by relative-camera attention).
    """
    m, h, w, _ = images.shape
    size = encoder_size(cfg, h, w)
    relative = None
    if cfg.relative_cameras:
        relative = relative_cameras(
            K,
            c2w,
            (h, w),
            grid=encoder_grid(cfg, h, w),
            specials=SPECIALS + cfg.registers,
            head_dim=cfg.width // cfg.heads,
        )
    if size != (h, w):
        images = jax.image.resize(images, (m, *size, 3), "bilinear", antialias=True)
        plucker = jax.image.resize(plucker, (m, *size, 6), "bilinear", antialias=True)
    tokens, _ = aggregate(
        p,
        images,
        camera_tokens(p["camera_mlp"], vectors),
        cfg=cfg,
        plucker=plucker,
        relative=relative,
    )
    z = linear(p["connector"], tokens[:, SPECIALS + cfg.registers :])
    return layer_norm(p["connector_norm"], z, eps=EPS)
