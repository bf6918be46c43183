"""Transformer LoRA trees under the names other tools read, and back.

| style | one factor | read by |
|---|---|---|
| diffusers | transformer.blocks.0.attn1.to_q.lora_A.weight | diffusers `load_lora_adapter`, `load_lora_weights` |
| peft | base_model.model.blocks.0.attn1.to_q.lora_A.weight | peft around a diffusers transformer |
| framecrafter | blocks.0.self_attn.q.lora_A.default.weight | FrameCrafter, DiffSynth-Studio |
| comfyui | diffusion_model.blocks.0.self_attn.q.lora_A.weight | ComfyUI, diffusers' converter |

Theirs are [rank, in] and [out, rank]; ours `lora_a` [depth, in, rank] and `lora_b` [depth, rank, out] beside the
stacked kernels. alpha = rank everywhere, so no scale is stored; `import_lora` folds one that it finds into `lora_b`.
"""

import re
from collections.abc import Mapping
from typing import Literal

import numpy as np

from ..config import DiTConfig
from ..core.params import Tree, flatten, unflatten
from ..errors import UserError, did_you_mean
from ..video.dit import dit_specs
from .wan_dit import Names, source_layer

Style = Literal["diffusers", "peft", "framecrafter", "comfyui"]

_STYLES: dict[str, tuple[str, Names, str]] = {  # prefix, naming of the layers, suffix after lora_A
    "diffusers": ("transformer.", "diffusers", ".weight"),
    "peft": ("base_model.model.", "diffusers", ".weight"),
    "framecrafter": ("", "official", ".default.weight"),
    "comfyui": ("diffusion_model.", "official", ".weight"),
}
_PREFIX = r"^(transformer\.|base_model\.model\.|diffusion_model\.|pipe\.dit\.)+"
_FACTOR = r"\.(lora_A|lora_B|lora_down|lora_up)(?:\.default)?\.weight$"
_SIDE = {"lora_A": "a", "lora_down": "a", "lora_B": "b", "lora_up": "b"}


def export_lora(lora: Tree, *, style: Style = "diffusers") -> dict[str, np.ndarray]:
    """All factors of a transformer's LoRA tree (paths as in `dit_specs`) under the names of `style`."""
    if style not in _STYLES:
        raise UserError(f"Unknown LoRA style '{style}': {did_you_mean(style, _STYLES)}")
    prefix, names, suffix = _STYLES[style]
    tensors = {}
    for path, leaf in flatten(lora).items():
        layer, _, factor = path.rpartition("/")
        template = f"{prefix}{source_layer(layer, names)}.lora_{factor[-1].upper()}{suffix}"
        leaf = np.asarray(leaf)
        for i, part in enumerate(leaf if path.startswith("blocks/") else leaf[None]):
            tensors[template.format(i=i)] = np.ascontiguousarray(part.T)
    return tensors


def import_lora(
    tensors: Mapping[str, np.ndarray], cfg: DiTConfig, *, name: str = "LoRA file"
) -> tuple[Tree, dict[str, np.ndarray]]:
    """The LoRA tree held by `tensors` in any of the styles, and the tensors that are no factors, under bare names.

    FrameCrafter stores a new `patch_embedding` beside its factors: that one comes back in the second value. A layer
    that is adapted in some blocks only gets zero factors in the others.
    """
    factors: dict[str, dict[str, np.ndarray]] = {}
    alphas: dict[str, float] = {}
    rest: dict[str, np.ndarray] = {}
    for key, value in tensors.items():
        bare = re.sub(_PREFIX, "", key)
        if match := re.search(_FACTOR, bare):
            factors.setdefault(bare[: match.start()], {})[_SIDE[match[1]]] = np.asarray(value)
        elif bare.endswith(".alpha"):
            alphas[bare.removesuffix(".alpha")] = float(np.asarray(value).reshape(()))
        else:
            rest[bare] = value

    table = _layers(cfg)
    faults = [f"no adaptable layer {layer}" for layer in sorted(set(factors) - set(table))]
    faults += [
        f"{layer} has only one factor" for layer, f in sorted(factors.items()) if len(f) == 1
    ]
    if faults or not factors:
        more = f"; and {len(faults) - 20} more" if len(faults) > 20 else ""
        raise UserError(
            f"{name} does not hold LoRA factors of this transformer ({cfg.depth} blocks of width {cfg.width}): "
            f"{'; '.join(faults[:20]) or 'no lora_A, lora_B tensors'}{more}. Check which model it was trained for."
        )

    grouped: dict[str, dict[int, tuple[np.ndarray, np.ndarray]]] = {}
    for layer, pair in factors.items():
        path, i = table[layer]
        scale = alphas.get(layer, pair["a"].shape[0]) / pair["a"].shape[0]
        grouped.setdefault(path, {})[i] = (pair["a"].T, scale * pair["b"].T)
    return unflatten(_stacked(grouped, cfg)), rest


def _layers(cfg: DiTConfig) -> dict[str, tuple[str, int]]:
    """{their layer name: (our path, block)} for every linear layer, under both namings."""
    table = {}
    for path in flatten(dit_specs(cfg)):
        layer, _, leaf = path.rpartition("/")
        if leaf == "kernel" and layer != "patch_embed":
            for names in ("official", "diffusers"):
                for i in range(cfg.depth if layer.startswith("blocks/") else 1):
                    table[source_layer(layer, names).format(i=i)] = (layer, i)
    return table


def _stacked(grouped, cfg: DiTConfig) -> dict[str, np.ndarray]:
    flat = {}
    for path, pairs in grouped.items():
        a, b = next(iter(pairs.values()))
        shapes = {(pair[0].shape, pair[1].shape) for pair in pairs.values()}
        if len(shapes) > 1:
            raise UserError(
                f"The blocks of '{path}' have LoRA factors of different shapes {sorted(shapes)}; "
                "they cannot be stacked. Merge this LoRA into the weights instead."
            )
        if path.startswith("blocks/"):
            none = (np.zeros_like(a), np.zeros_like(b))
            layers = [pairs.get(i, none) for i in range(cfg.depth)]
            a, b = (np.stack([layer[side] for layer in layers]) for side in (0, 1))
        flat[f"{path}/lora_a"], flat[f"{path}/lora_b"] = np.asarray(a), np.asarray(b)
    return flat
