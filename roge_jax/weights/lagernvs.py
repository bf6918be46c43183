"""LagerNVS and VGGT-1B: our encoder and renderer leaves, and the published tensor names.

    encoder, renderer = lagernvs_config(shapes)               # sizes from {key: shape}
    tree = to_ours(lagernvs_entries(encoder, renderer), source(tensors))    # {"encoder": .., "renderer": ..}
    part = to_ours(vggt_entries(encoder), source(tensors))    # {"encoder": ..} without camera MLP and connector

Files of VGGT hold the aggregator, which LagerNVS keeps under `reconstructor.vggt.`, and four heads that nothing here
reads. LagerNVS gives rays as [o x d, d], this code as [d, o x d]: the input channels of the ray convolution trade
places here and nowhere else.
"""

import re
from collections.abc import Mapping
from typing import Literal

import numpy as np

from ..config import EncoderConfig, RendererConfig
from ..core.params import Tree, flatten
from ..errors import UserError
from ..recon.ray_scene import renderer_specs
from ..recon.vggt import dino_specs, encoder_specs
from .mapping import CONV2D, IDENTITY, LINEAR, Entry, Transform, bare, leading_ones, to_theirs

VGGT = "reconstructor.vggt."  # in front of VGGT's own names inside LagerNVS
PREFIXES = ("module.", "model.")  # left by data-parallel wrappers and training programs
IGNORED = r"^(camera_head|depth_head|point_head|track_head)\."  # VGGT's heads; LagerNVS has none
BFLOAT16 = (
    "renderer.per_view_register_tokens",
)  # every other tensor of the released file is float32
HEAD_DIM = 64  # of every attention in the released networks; `weights.heads` knows of others

_SWAP = [3, 4, 5, 0, 1, 2]
RAY_CONV = Transform(  # OIHW -> HWIO, and [moment, direction] -> [direction, moment]
    lambda x: CONV2D.to_ours(x[:, _SWAP]), lambda x: CONV2D.to_theirs(x)[:, _SWAP]
)
CAMERA_TOKEN = Transform(lambda x: x[0, :, 0], lambda x: x[None, :, None])  # [1, 2, 1, d] -> [2, d]
CLASS_TOKEN = Transform(lambda x: x[0, 0], lambda x: x[None, None])  # [1, 1, d] -> [d]

_LEAF = {"kernel": "weight", "scale": "weight", "bias": "bias", "gamma": "gamma"}

# Parameters of a module itself, with leading axes of one there.
_TOKENS = {
    "patch_encoder/cls_token": ("patch_embed.cls_token", CLASS_TOKEN),
    "patch_encoder/pos_embed": ("patch_embed.pos_embed", leading_ones(1)),
    "patch_encoder/register_tokens": ("patch_embed.register_tokens", leading_ones(1)),
    "patch_encoder/mask_token": ("patch_embed.mask_token", leading_ones(1)),
    "camera_token": ("camera_token", CAMERA_TOKEN),
    "register_token": ("register_token", leading_ones(1)),
}
_ADAPTER = {  # what LagerNVS adds to VGGT
    "camera_mlp/fc1": "camera_mlp.0",
    "camera_mlp/fc2": "camera_mlp.2",
    "connector": "geo_feature_connector",
    "connector_norm": "geo_feature_norm",
}
_RENDERER = {
    "ray_embed": "tgt_embedder.proj",
    "ray_norm": "tgt_norm",
    "rgb_head/norm": "final_layer.norm_final",
    "rgb_head/linear": "final_layer.linear",
}
_BLOCK = {  # first parts of layer names inside a block of each kind; the rest is alike
    "bidirectional": {
        "norm_self": "norm1_x",
        "norm_cross": "norm2_x",
        "norm_mlp": "norm3_x",
        "norm_scene": "norm1_rec",
        "norm_scene_mlp": "norm2_rec",
        "cross_attn": "cross_attn_x",
        "scene_attn": "cross_attn_rec",
        "mlp": "mlp_x",
        "scene_mlp": "mlp_rec",
    },
    "cross": {
        "norm_self": "norm1",
        "norm_cross": "norm2",
        "norm_mlp": "norm_ffn",
        "norm_scene": "norm2_kv",
    },
    "full": {"norm_self": "norm1", "norm_mlp": "norm2", "self_attn": "attn"},
}
_PROJECTION = {"q": "q_proj", "k": "k_proj", "v": "v_proj"}


def dino_entries(cfg: EncoderConfig, *, ours: str = "", theirs: str = "") -> list[Entry]:
    """The patch encoder alone: paths of `vggt.dino_specs` behind `ours`, keys behind `theirs`."""
    return [
        _aggregator_entry(f"patch_encoder/{path}", cfg, ours, theirs, drop="patch_embed.")._replace(
            path=f"{ours}{path}"
        )
        for path in flatten(dino_specs(cfg))
    ]


def aggregator_entries(cfg: EncoderConfig, *, ours: str = "", theirs: str = "") -> list[Entry]:
    """VGGT's aggregator: all leaves of the encoder that LagerNVS did not add."""
    assert cfg.dino_depth, "the linear patch embedding has no published weights"
    return [
        _aggregator_entry(path, cfg, ours, theirs)
        for path in flatten(encoder_specs(cfg, 1))
        if path.rpartition("/")[0] not in _ADAPTER
    ]


def renderer_entries(cfg: RendererConfig, *, ours: str = "", theirs: str = "") -> list[Entry]:
    """The ray-scene transformer and its RGB head."""
    return [_renderer_entry(path, cfg, ours, theirs) for path in flatten(renderer_specs(cfg))]


def vggt_entries(cfg: EncoderConfig) -> list[Entry]:
    """What a VGGT-1B file fills: the encoder without camera MLP and connector."""
    return aggregator_entries(cfg, ours="encoder/", theirs="aggregator.")


def lagernvs_entries(encoder: EncoderConfig, renderer: RendererConfig) -> list[Entry]:
    """The table of all leaves of both halves, under `encoder/` and `renderer/`."""
    entries = aggregator_entries(encoder, ours="encoder/", theirs=f"{VGGT}aggregator.")
    for path in flatten(encoder_specs(encoder, renderer.width)):
        layer, _, leaf = path.rpartition("/")
        if layer in _ADAPTER:
            key = f"reconstructor.{_ADAPTER[layer]}.{_LEAF[leaf]}"
            entries.append(Entry(f"encoder/{path}", (key,), _layout(leaf)))
    return entries + renderer_entries(renderer, ours="renderer/", theirs="renderer.")


def _layout(leaf: str) -> Transform:
    return LINEAR if leaf == "kernel" else IDENTITY


def _aggregator_entry(
    path: str, cfg: EncoderConfig, ours: str, theirs: str, drop: str = ""
) -> Entry:
    """`drop` is taken off the front of their name, for networks stored without it."""
    if path in _TOKENS:
        key, transform = _TOKENS[path]
        return Entry(ours + path, (theirs + key.removeprefix(drop),), transform)
    layer, _, leaf = path.rpartition("/")
    layer = layer.replace("patch_encoder", "patch_embed", 1)
    if layer == "patch_embed/patch_embed":
        transform = CONV2D if leaf == "kernel" else IDENTITY
        key = f"patch_embed.patch_embed.proj.{_LEAF[leaf]}".removeprefix(drop)
        return Entry(ours + path, (theirs + key,), transform)
    stack, found, inner = layer.partition("blocks/")
    depth = cfg.dino_depth if stack.startswith("patch_embed") else cfg.depth
    name = f"{stack}blocks/{{i}}/{inner}" if found else layer
    key = theirs + f"{name.replace('/', '.')}.{_LEAF[leaf]}".removeprefix(drop)
    if not found:
        return Entry(ours + path, (key,), _layout(leaf))
    keys = tuple(key.format(i=i) for i in range(depth))
    return Entry(ours + path, keys, _layout(leaf), stacked=True)


def _renderer_entry(path: str, cfg: RendererConfig, ours: str, theirs: str) -> Entry:
    if path == "registers":
        return Entry(ours + path, (f"{theirs}per_view_register_tokens",), leading_ones(1))
    layer, _, leaf = path.rpartition("/")
    if layer in _RENDERER:
        transform = RAY_CONV if path == "ray_embed/kernel" else _layout(leaf)
        return Entry(ours + path, (f"{theirs}{_RENDERER[layer]}.{_LEAF[leaf]}",), transform)
    stack, _, inner = layer.partition("/")
    kind = "cross" if stack == "last_block" else cfg.attention
    first, *rest = inner.split("/")
    name = [_BLOCK[kind].get(first, first), *(_PROJECTION.get(part, part) for part in rest)]
    key = f"{theirs}renderer_core.renderer_blocks.{{i}}.{'.'.join(name)}.{_LEAF[leaf]}"
    if stack == "last_block":
        return Entry(ours + path, (key.format(i=cfg.depth - 1),), _layout(leaf))
    depth = cfg.depth - 1 if kind == "bidirectional" else cfg.depth
    keys = tuple(key.format(i=i) for i in range(depth))
    return Entry(ours + path, keys, _layout(leaf), stacked=True)


def source(tensors: Mapping) -> dict:
    """The tensors under bare names: known prefixes stripped, VGGT's heads left out."""
    return bare(tensors, PREFIXES, IGNORED)


def published(
    tree: Tree, encoder: EncoderConfig, renderer: RendererConfig
) -> dict[str, np.ndarray]:
    """The released file's tensors, its one bfloat16 tensor included, from {"encoder": .., "renderer": ..}."""
    import ml_dtypes  # NumPy has no bfloat16; comes with JAX

    tensors = to_theirs(lagernvs_entries(encoder, renderer), tree)
    for key in BFLOAT16:
        tensors[key] = tensors[key].astype(ml_dtypes.bfloat16)
    return tensors


def vggt_config(
    shapes: Mapping[str, tuple[int, ...]], prefix: str = "aggregator."
) -> EncoderConfig:
    """The encoder's sizes from the names and shapes of a VGGT file (or of one inside LagerNVS: `prefix`)."""

    def shape(key: str) -> tuple[int, ...]:
        return _shape(shapes, prefix + key, "VGGT aggregator")

    width = shape("camera_token")[-1]
    return EncoderConfig(
        patch=shape("patch_embed.patch_embed.proj.weight")[-1],
        width=width,
        heads=width // HEAD_DIM,
        depth=_depth(shapes, f"{prefix}frame_blocks."),
        dino_depth=_depth(shapes, f"{prefix}patch_embed.blocks."),
        position_grid=round((shape("patch_embed.pos_embed")[1] - 1) ** 0.5),
        registers=shape("register_token")[2],
    )


def renderer_config(
    shapes: Mapping[str, tuple[int, ...]], prefix: str = "renderer."
) -> RendererConfig:
    """The renderer's sizes and variant from names and shapes."""
    width, _, patch, _ = _shape(shapes, f"{prefix}tgt_embedder.proj.weight", "LagerNVS renderer")
    blocks = f"{prefix}renderer_core.renderer_blocks."
    variant: Literal["bidirectional", "cross", "full"] = "cross"
    if f"{blocks}0.norm1_x.weight" in shapes:
        variant = "bidirectional"
    elif f"{blocks}0.attn.proj.weight" in shapes:
        variant = "full"
    return RendererConfig(
        patch=patch,
        width=width,
        heads=width // HEAD_DIM,
        depth=_depth(shapes, blocks),
        registers=_shape(shapes, f"{prefix}per_view_register_tokens", "LagerNVS renderer")[1],
        attention=variant,
    )


def lagernvs_config(
    shapes: Mapping[str, tuple[int, ...]],
) -> tuple[EncoderConfig, RendererConfig]:
    """The sizes of both halves of a LagerNVS checkpoint."""
    return vggt_config(shapes, f"{VGGT}aggregator."), renderer_config(shapes)


def _shape(shapes: Mapping[str, tuple[int, ...]], key: str, network: str) -> tuple[int, ...]:
    if key not in shapes:
        raise UserError(
            f"No tensor '{key}': this is not a {network}. "
            "Give the LagerNVS file (model.pt or safetensors), or VGGT-1B's for the encoder alone."
        )
    return tuple(shapes[key])


def _depth(shapes: Mapping[str, tuple[int, ...]], prefix: str) -> int:
    found = [re.match(re.escape(prefix) + r"(\d+)\.", key) for key in shapes]
    return 1 + max((int(m[1]) for m in found if m), default=-1)
