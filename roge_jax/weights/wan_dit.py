"""Wan2.1 diffusion transformer: our leaves, the official tensor names and those of diffusers.

    entries = dit_entries(cfg)                      # official names; dit_entries(cfg, names="diffusers")
    params = to_ours(entries, source(tensors))      # mapping.to_ours

Files of FrameCrafter carry the official names with 420 input channels; files for ComfyUI the official names behind
`model.diffusion_model.`.
"""

import re
from collections.abc import Iterable, Mapping
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from ..config import DiTConfig
from ..core.params import Tree, flatten
from ..errors import UserError
from ..video.dit import dit_specs
from .mapping import IDENTITY, LINEAR, Entry, Transform, bare, leading_ones

Names = Literal["official", "diffusers"]

PREFIXES = ("model.diffusion_model.", "diffusion_model.")
IGNORED = r"\.attn2\.norm_added_q\.weight$"  # in diffusers' I2V files, read by nobody

# A convolution over (time 1, row, column) patches [out, c, 1, ph, pw]; ours is [ph, pw, c, out].
PATCH = Transform(
    lambda x: np.transpose(x[:, :, 0], (2, 3, 1, 0)),
    lambda x: np.transpose(x, (3, 2, 0, 1))[:, :, None],
)

_ROOT = {
    "patch_embed": "patch_embedding",
    "text_embed/fc1": "text_embedding.0",
    "text_embed/fc2": "text_embedding.2",
    "time_embed/fc1": "time_embedding.0",
    "time_embed/fc2": "time_embedding.2",
    "time_embed/proj": "time_projection.1",
    "clip_embed/norm1": "img_emb.proj.0",
    "clip_embed/fc1": "img_emb.proj.1",
    "clip_embed/fc2": "img_emb.proj.3",
    "clip_embed/norm2": "img_emb.proj.4",
    "head/linear": "head.head",
}
_BLOCK = {
    "cross_norm": "norm3",
    "ffn/fc1": "ffn.0",
    "ffn/fc2": "ffn.2",
}  # the rest: dots for slashes
_LEAF = {"kernel": "weight", "scale": "weight", "bias": "bias"}

# Official to diffusers, layer by layer. The norms before cross-attention and feed-forward are swapped there.
_DIFFUSERS_ROOT = {
    "text_embedding.0": "condition_embedder.text_embedder.linear_1",
    "text_embedding.2": "condition_embedder.text_embedder.linear_2",
    "time_embedding.0": "condition_embedder.time_embedder.linear_1",
    "time_embedding.2": "condition_embedder.time_embedder.linear_2",
    "time_projection.1": "condition_embedder.time_proj",
    "img_emb.proj.0": "condition_embedder.image_embedder.norm1",
    "img_emb.proj.1": "condition_embedder.image_embedder.ff.net.0.proj",
    "img_emb.proj.3": "condition_embedder.image_embedder.ff.net.2",
    "img_emb.proj.4": "condition_embedder.image_embedder.norm2",
    "head.head": "proj_out",
    "head.modulation": "scale_shift_table",
}
_DIFFUSERS_BLOCK = {
    "modulation": "scale_shift_table",
    "norm3": "norm2",
    "ffn.0": "ffn.net.0.proj",
    "ffn.2": "ffn.net.2",
    "q": "to_q",
    "k": "to_k",
    "v": "to_v",
    "o": "to_out.0",
    "k_img": "add_k_proj",
    "v_img": "add_v_proj",
    "norm_k_img": "norm_added_k",
    "self_attn": "attn1",
    "cross_attn": "attn2",
}


def official_layer(path: str) -> str:
    """Our layer path, `blocks/self_attn/q`, as the official name, `blocks.{i}.self_attn.q` with a literal {i}."""
    if path.startswith("blocks/"):
        inner = path.removeprefix("blocks/")
        return "blocks.{i}." + _BLOCK.get(inner, inner.replace("/", "."))
    return _ROOT.get(path, path.replace("/", "."))


def diffusers_layer(official: str) -> str:
    """The official layer name (with a number or {i} for the block) as diffusers has it."""
    match = re.fullmatch(r"blocks\.([^.]+)\.(.+)", official)
    if not match:
        return _DIFFUSERS_ROOT.get(official, official)
    index, inner = match.groups()
    if inner in _DIFFUSERS_BLOCK:
        return f"blocks.{index}.{_DIFFUSERS_BLOCK[inner]}"
    return f"blocks.{index}." + ".".join(_DIFFUSERS_BLOCK.get(s, s) for s in inner.split("."))


def source_layer(path: str, names: Names = "official") -> str:
    """Our layer path under the given naming, with {i} where the number of the block goes."""
    official = official_layer(path)
    return diffusers_layer(official) if names == "diffusers" else official


def dit_entries(cfg: DiTConfig, *, names: Names = "official") -> list[Entry]:
    """The table of all leaves of `dit_specs(cfg)`."""
    return [_entry(path, cfg, names) for path in flatten(dit_specs(cfg))]


def _entry(path: str, cfg: DiTConfig, names: Names) -> Entry:
    layer, _, leaf = path.rpartition("/")
    if (
        leaf == "modulation"
    ):  # a parameter of the block or the head itself, with a leading axis of one
        key, transform = source_layer(path, names), leading_ones(1)
    else:
        key = f"{source_layer(layer, names)}.{_LEAF[leaf]}"
        kernel = PATCH if layer == "patch_embed" else LINEAR
        transform = kernel if leaf == "kernel" else IDENTITY
    if not path.startswith("blocks/"):
        return Entry(path, (key,), transform)
    return Entry(path, tuple(key.format(i=i) for i in range(cfg.depth)), transform, stacked=True)


def naming(keys: Iterable[str]) -> Names:
    """Which naming the keys of a file follow."""
    return "diffusers" if any("condition_embedder." in key for key in keys) else "official"


def source(tensors: Mapping) -> dict:
    """The tensors under bare names: known prefixes stripped, keys that no implementation reads left out."""
    return bare(tensors, PREFIXES, IGNORED)


def dit_config(shapes: Mapping[str, tuple[int, ...]]) -> DiTConfig:
    """The configuration of a released transformer from its bare official or diffusers names and shapes.

    Every released size has heads of 128 channels, 512 text rows and 2 x 2 patches, which shapes do not tell.
    """
    probe = DiTConfig(depth=1)
    keys = {e.path: e.keys[0] for e in dit_entries(probe, names=naming(shapes))}

    def shape(path: str) -> tuple[int, ...]:
        if keys[path] not in shapes:
            raise UserError(
                f"No tensor '{keys[path]}': this is not a Wan2.1 transformer. "
                "Give the safetensors file or folder of its DiT (T2V or I2V)."
            )
        return tuple(shapes[keys[path]])

    width, channels = shape("patch_embed/kernel")[:2]
    depth = 1 + max(int(m[1]) for m in (re.match(r"blocks\.(\d+)\.", key) for key in shapes) if m)
    clip = keys["clip_embed/fc1/kernel"] in shapes
    return DiTConfig(
        width=width,
        heads=width // 128,
        depth=depth,
        ffn=shape("blocks/ffn/fc1/kernel")[0],
        in_channels=channels,
        out_channels=shape("head/linear/kernel")[0] // probe.patch**2,
        freq_dim=shape("time_embed/fc1/kernel")[1],
        text_dim=shape("text_embed/fc1/kernel")[1],
        clip_dim=shape("clip_embed/fc1/kernel")[1] if clip else 0,
    )


def widen(params: Tree, in_channels: int) -> Tree:
    """The transformer with zero kernels for further input channels, so that it computes what it did before.

    Text-to-video weights read the 16 noisy channels only; mask and condition latents come after them.
    """
    kernel = params["patch_embed"]["kernel"]
    more = in_channels - kernel.shape[2]
    if more < 0:
        raise UserError(
            f"The transformer reads {kernel.shape[2]} channels and cannot be narrowed to {in_channels}. "
            "Use a preset with as many input channels as the weights, or more."
        )
    backend = jnp if isinstance(kernel, jax.Array) else np
    kernel = backend.pad(kernel, ((0, 0), (0, 0), (0, more), (0, 0)))
    return params | {"patch_embed": params["patch_embed"] | {"kernel": kernel}}
