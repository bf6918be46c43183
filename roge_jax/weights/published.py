"""Which published checkpoint a file is, and how each of them fills our networks.

| given | fills | leaves to initialisation |
|---|---|---|
| Wan2.1 transformer, official or diffusers names | `dit` (T2V: zeros for the 20 condition channels of E1) | |
| FrameCrafter, on top of a transformer | LoRA merged into `dit`; E1 and `fusion/rays_embed` from its 420 channels | |
| Wan2.1 VAE, official or diffusers names | `vae` | |
| LagerNVS | `encoder`, `renderer` | |
| VGGT-1B | `encoder` without camera MLP and connector | those two, `renderer` |

`fusion` (but for FrameCrafter's rays) is new in RoGe and always initialised.
"""

import dataclasses
import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..config import DiTConfig, EncoderConfig, RendererConfig, RoGeConfig, VAEConfig
from ..core.params import Spec, flatten
from ..errors import UserError
from ..recon.ray_scene import renderer_specs
from ..recon.vggt import encoder_specs
from ..video.dit import dit_specs
from ..video.vae import vae_specs
from . import lagernvs, lora_export, wan_dit, wan_vae
from .catalogue import BY_NAME, how_to_get, locate, name_of
from .importer import Fault, Fill, plan_network
from .sources import INDEX, Source, open_source

# (name, what a user calls it, keys that only it has), most specific first; prefixes of wrappers are allowed for.
FAMILIES = (
    ("lora", "LoRA factors", r"\.lora_(A|down)\b"),
    ("lagernvs", "LagerNVS", r"^renderer\.tgt_embedder\.|^reconstructor\.vggt\."),
    ("vggt", "VGGT", r"^aggregator\.camera_token$"),
    ("dit", "a Wan transformer", r"^patch_embedding\.weight$"),
    ("vae", "a video VAE", r"^(encoder\.conv1|quant_conv)\.weight$"),
    ("t5", "a T5 text encoder", r"^(token_embedding|shared|encoder\.embed_tokens)\.weight$"),
    ("clip", "a CLIP image encoder", r"^(visual\.|vision_model\.|textual\.)"),
)
_WRAPPERS = r"^(module\.|model\.|diffusion_model\.|pipe\.dit\.|base_model\.model\.|transformer\.)+"
RAYS = 6 * 64  # FrameCrafter's ray channels: 8 x 8 pixels of six, for one frame
E1 = "patch_embed/kernel"


class Filled(NamedTuple):
    """What one file does for the model."""

    role: str  # the option that gave it
    source: Source
    layout: str  # "official", "diffusers", ...
    fills: list[Fill]
    faults: list[Fault]
    notes: tuple[str, ...] = ()


def family(source: Source) -> tuple[str, str]:
    """(short name, name for people) of a checkpoint, by its keys."""
    keys = [re.sub(_WRAPPERS, "", key) for key in source.tensors]
    for name, words, marker in FAMILIES:
        if any(re.search(marker, key) for key in keys):
            return name, words
    return "unknown", "something unknown"


def expect(source: Source, allowed: tuple[str, ...], option: str, wanted: str) -> str:
    """The family of `source`. Raises UserError, naming the file, if it is not one of `allowed`."""
    found, words = family(source)
    if found not in allowed:
        example = next(iter(source.tensors), "none")
        raise UserError(
            f"{source.path} holds {words} (its first tensor is '{example}'), but {option} takes {wanted}."
        )
    return found


def find_wan(path: Path) -> tuple[Source, Path | None]:
    """(transformer, place of the VAE if it is beside it) of a file, an official folder or a diffusers folder."""
    path = locate(path)
    inner = path / "transformer" if (path / "transformer").is_dir() else path
    beside = sorted(p.name for p in inner.glob("*.pth")) if inner.is_dir() else []
    if beside and not [*inner.glob("*.safetensors"), *inner.glob(INDEX)]:
        found = BY_NAME.get(name_of(inner) or "")
        cure = how_to_get(found) if found else "download it too"
        raise UserError(
            f"{path} has {' and '.join(beside)}, but no transformer (diffusion_pytorch_model*.safetensors): {cure}."
        )
    source = open_source(inner)
    expect(source, ("dit",), "--wan", "a Wan2.1 transformer (T2V or I2V)")
    folder = path if path.is_dir() else path.parent
    places = [folder / "Wan2.1_VAE.pth", folder / "Wan2.1_VAE.safetensors", folder / "vae"]
    if path.name == "transformer":
        places.append(path.parent / "vae")
    return source, next((p for p in places if p.exists()), None)


# ---- transformer ---------------------------------------------------------------------------------


def dit_names(source: Source) -> dict[str, str]:
    """{bare key: key in the file}, without what no implementation reads."""
    return wan_dit.source({key: key for key in source.tensors})


def dit_config(source: Source) -> DiTConfig:
    """The configuration of a transformer file, input channels as in the file."""
    names = dit_names(source)
    try:
        return wan_dit.dit_config({bare: source.tensors[key].shape for bare, key in names.items()})
    except (UserError, ValueError, IndexError) as error:
        raise UserError(f"{source.path} is no complete Wan2.1 transformer: {error}") from None


def fill_dit(cfg: DiTConfig, source: Source, framecrafter: Source | None = None) -> list[Filled]:
    """Fill `dit` from a transformer, with what FrameCrafter trained on top of it if given."""
    names = dit_names(source)
    naming = wan_dit.naming(names)
    stored = source.tensors.get(names.get("patch_embedding.weight", ""))
    channels = stored.shape[1] if stored is not None and len(stored.shape) == 5 else cfg.in_channels
    specs = flatten(dit_specs(dataclasses.replace(cfg, in_channels=channels)))
    entries = wan_dit.dit_entries(cfg, names=naming)
    fills, faults = plan_network("dit", entries, specs, source, names)
    notes: tuple[str, ...] = ()
    merged: list[Filled] = []
    if framecrafter is not None:
        adapter = _Adapter(framecrafter, cfg)
        merged = [adapter.filled()]
        replaced = ("dit/patch_embed/kernel", "dit/patch_embed/bias")
        fills = [adapter.merged(f, cfg) for f in fills if f.path not in replaced]
        notes = ("its patch embedding is replaced by FrameCrafter's",)
    else:
        fills, rays = widened(fills, channels, cfg.in_channels)
        fills += rays
        if channels < cfg.in_channels:
            notes = (f"E1 widened from {channels} to {cfg.in_channels} channels with zeros",)
        elif rays:
            notes = (_RAYS_NOTE,)
        elif channels > cfg.in_channels:
            what = f"has {channels} input channels, where {cfg.in_channels} or fewer are needed"
            faults.append(Fault(str(source.path), names["patch_embedding.weight"], what))
    return [Filled("--wan", source, naming, fills, faults, notes), *merged]


_RAYS_NOTE = "E1 from its first 36 input channels, fusion/rays_embed from the other 384 (see docs/reference/weights.md)"


def widened(fills: list[Fill], channels: int, wanted: int) -> tuple[list[Fill], list[Fill]]:
    """The fills with E1 brought to `wanted` input channels, and the fill of the rays embedding if E1 holds one.

    Zeros are appended, since mask and condition latents come after the noisy ones. 420 channels are FrameCrafter's:
    our 36, then the rays of a single frame. Our ray slots hold four frames side by side, so each of the four gets a
    quarter: a slot of one repeated photo sees what FrameCrafter saw, a slot of four frames their mean.
    """
    more = wanted - channels

    def pad(make, x):
        return np.pad(make(x), ((0, 0), (0, 0), (0, more), (0, 0)))

    def first(make, x):
        return make(x)[:, :, :wanted]

    def rays(make, x):
        return np.tile(make(x)[:, :, wanted:] / np.asarray(4, x.dtype), (1, 1, 4, 1))

    extra, result = [], []
    for fill in fills:
        if fill.path == f"dit/{E1}" and more > 0:
            fill = fill._replace(make=functools.partial(pad, fill.make))
        elif fill.path == f"dit/{E1}" and -more == RAYS:
            extra.append(
                fill._replace(
                    path="fusion/rays_embed/kernel", make=functools.partial(rays, fill.make)
                )
            )
            fill = fill._replace(make=functools.partial(first, fill.make))
        result.append(fill)
    return result, extra


class _Adapter:
    """FrameCrafter's file: LoRA factors of the transformer and its new patch embedding."""

    def __init__(self, source: Source, cfg: DiTConfig):
        self.source, self.cfg = source, cfg
        zeros = {
            key: np.broadcast_to(np.zeros((), np.float32), t.shape)
            for key, t in source.tensors.items()
        }
        self.lora, rest = self._factors(zeros)
        self.rest = {bare: key for bare, key in self._bare().items() if bare in rest}

    def _factors(self, tensors: Mapping[str, np.ndarray]):
        tree, rest = lora_export.import_lora(tensors, self.cfg, name=str(self.source.path))
        return flatten(tree), rest

    def _bare(self) -> dict[str, str]:
        return {re.sub(_WRAPPERS, "", key): key for key in self.source.tensors}

    @functools.cached_property
    def values(self) -> dict[str, np.ndarray]:
        """All factors; 0.3 GB for the 14B transformer at rank 32 in bfloat16."""
        return self._factors({key: self.source.read(key) for key in self.source.tensors})[0]

    def filled(self) -> Filled:
        specs = flatten(dit_specs(self.cfg))
        file = str(self.source.path)
        faults = [
            Fault(
                file,
                path.replace("/", "."),
                f"has shape {tuple(x.shape)}, which does not fit {specs[kernel].shape}",
            )
            for path, x in self.lora.items()
            for kernel in [path.rpartition("/")[0] + "/kernel"]
            if x.shape[0] != specs[kernel].shape[0]
            or x.shape[-2 if path.endswith("a") else -1]
            != specs[kernel].shape[-2 if path.endswith("a") else -1]
        ]
        embed = dataclasses.replace(self.cfg, in_channels=self.cfg.in_channels + RAYS)
        part = {p: s for p, s in flatten(dit_specs(embed)).items() if p.startswith("patch_embed/")}
        entries = [e for e in wan_dit.dit_entries(self.cfg) if e.path in part]
        fills, more = plan_network("dit", entries, part, self.source, self.rest)
        fills, rays = widened(fills, self.cfg.in_channels + RAYS, self.cfg.in_channels)
        rank = next(x.shape[-1] for path, x in self.lora.items() if path.endswith("lora_a"))
        note = f"LoRA of rank {rank} merged into {len(self.lora) // 2} kernels"
        return Filled(
            "--framecrafter", self.source, "LoRA", fills + rays, faults + more, (note, _RAYS_NOTE)
        )

    def merged(self, fill: Fill, cfg: DiTConfig) -> Fill:
        """The fill with kernel + a @ b (in float32) where this file adapts the kernel."""
        layer, _, leaf = fill.path.removeprefix("dit/").rpartition("/")
        if leaf != "kernel" or f"{layer}/lora_a" not in self.lora:
            return fill

        def make(x):
            pair = (self.values[f"{layer}/lora_{side}"] for side in "ab")
            a, b = (
                np.asarray(f if fill.layer is None else f[fill.layer], np.float32) for f in pair
            )
            kernel = a @ b
            kernel += fill.make(x)
            return kernel

        return fill._replace(make=make)


# ---- VAE -----------------------------------------------------------------------------------------


def fill_vae(cfg: VAEConfig, source: Source, role: str = "--wan-vae") -> Filled:
    """Fill `vae` from a Wan2.1 VAE, official or diffusers names."""
    expect(source, ("vae",), role, "the Wan2.1 VAE")
    names = {key: key for key in source.tensors}
    naming: wan_vae.Names = "diffusers" if "quant_conv.weight" in names else "official"
    entries = wan_vae.mapping(cfg, naming)
    fills, faults = plan_network("vae", entries, flatten(vae_specs(cfg)), source, names)
    return Filled(role, source, naming, fills, faults)


# ---- reconstruction ------------------------------------------------------------------------------


def recon_config(source: Source) -> tuple[EncoderConfig, RendererConfig | None]:
    """Sizes of encoder and renderer (None in a VGGT file) from a LagerNVS or VGGT file."""
    names = lagernvs.source({key: key for key in source.tensors})
    shapes = {bare: source.tensors[key].shape for bare, key in names.items()}
    try:
        if family(source)[0] == "vggt":
            return lagernvs.vggt_config(shapes), None
        return lagernvs.lagernvs_config(shapes)
    except (UserError, ValueError, IndexError) as error:
        raise UserError(f"{source.path} is incomplete: {error}") from None


def fill_recon(config: RoGeConfig, source: Source, role: str) -> Filled:
    """Fill `encoder` and `renderer` from LagerNVS, or the aggregator of `encoder` from VGGT-1B."""
    kind = "lagernvs" if role == "--lagernvs" else "vggt"
    wanted = "a LagerNVS checkpoint" if kind == "lagernvs" else "VGGT-1B"
    expect(source, (kind,), role, wanted)
    if not config.encoder.dino_depth:
        raise UserError(
            f"Preset '{config.name}' has no DINOv2 patch encoder, so {source.path} cannot fill it: "
            "use --preset paper or wan1.3b."
        )
    names = lagernvs.source({key: key for key in source.tensors})
    tree = {"encoder": encoder_specs(config.encoder, config.renderer.width)}
    if kind == "vggt":
        entries = lagernvs.vggt_entries(config.encoder)
        notes: tuple[str, ...] = ("its camera, depth, point and track heads are not used",)
    else:
        entries = lagernvs.lagernvs_entries(config.encoder, config.renderer)
        tree["renderer"] = renderer_specs(config.renderer)
        notes = ("ray channels reordered from [o x d, d] to [d, o x d]",)
    paths = {entry.path for entry in entries}
    specs: dict[str, Spec] = {path: spec for path, spec in flatten(tree).items() if path in paths}
    fills, faults = plan_network("", entries, specs, source, names)
    return Filled(role, source, "official", fills, faults, notes)
