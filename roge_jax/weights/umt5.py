"""umT5's rows of the empty prompt, from the published encoder: one token, no tokenizer, one matrix in memory at a time.

    source = open_source("Wan2.1-T2V-1.3B/models_t5_umt5-xxl-enc-bf16.pth")
    check(source, cfg)                  # names and shapes, from headers
    rows = end_token(source, cfg)       # [1, text_dim], float32

The empty prompt is the end token alone. Attention over a single token returns its value, whatever queries, keys and position
biases say, so a layer is x + O V n(x), then x + W2 (gelu(Wg n(x)) * W1 n(x)), with n a norm by the root mean square.
"""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..config import DiTConfig
from ..errors import UserError
from .importer import READABLE, Fault, report
from .sources import Source

FILE = "models_t5_umt5-xxl-enc-bf16.pth"  # beside the official transformers
END = 1  # token that ends every prompt
EPS = 1e-6
ROWS = 1024  # of a matrix that are in float32 at a time

# What a layer is made of: official names, those of transformers, and the axes of the tensor.
LAYER = {
    "norm1.weight": ("layer.0.layer_norm.weight", "d"),
    "attn.q.weight": ("layer.0.SelfAttention.q.weight", "ad"),
    "attn.k.weight": ("layer.0.SelfAttention.k.weight", "ad"),
    "attn.v.weight": ("layer.0.SelfAttention.v.weight", "ad"),
    "attn.o.weight": ("layer.0.SelfAttention.o.weight", "da"),
    "pos_embedding.embedding.weight": (
        "layer.0.SelfAttention.relative_attention_bias.weight",
        "bh",
    ),
    "norm2.weight": ("layer.1.layer_norm.weight", "d"),
    "ffn.gate.0.weight": ("layer.1.DenseReluDense.wi_0.weight", "fd"),
    "ffn.fc1.weight": ("layer.1.DenseReluDense.wi_1.weight", "fd"),
    "ffn.fc2.weight": ("layer.1.DenseReluDense.wo.weight", "df"),
}
ENDS = {
    "token_embedding.weight": ("shared.weight", "td"),
    "norm.weight": ("encoder.final_layer_norm.weight", "d"),
}
COPY = "encoder.embed_tokens.weight"  # the embedding again, in some files of transformers


def names(source: Source) -> dict[str, str]:
    """{official name: name in the file}, as many layers as there are."""
    theirs = any(key.startswith("encoder.") for key in source.tensors)
    pattern = r"encoder\.block\.(\d+)\." if theirs else r"blocks\.(\d+)\."
    found = [re.match(pattern, key) for key in source.tensors]
    depth = 1 + max((int(match[1]) for match in found if match), default=-1)
    named = {name: there if theirs else name for name, (there, _) in ENDS.items()}
    if theirs and "shared.weight" not in source.tensors:
        named["token_embedding.weight"] = COPY
    for i in range(depth):
        for name, (there, _) in LAYER.items():
            named[f"blocks.{i}.{name}"] = (
                f"encoder.block.{i}.{there}" if theirs else f"blocks.{i}.{name}"
            )
    return named


def check(source: Source, cfg: DiTConfig) -> None:
    """Raise one UserError that lists what is missing, too much or misshapen, from headers alone."""
    named, file = names(source), str(source.path)
    sizes: dict[str, int] = {"d": cfg.text_dim}
    faults = []
    for name, key in named.items():
        if key not in source.tensors:
            faults.append(Fault(file, key, "is missing"))
            continue
        stored = source.tensors[key]
        _, axes = ENDS.get(name) or LAYER[name.split(".", 2)[2]]
        new = {axis: size for axis, size in zip(axes, stored.shape) if axis not in sizes}
        want = tuple((sizes | new)[axis] for axis in axes if axis in sizes | new)
        if tuple(stored.shape) != want:
            faults.append(Fault(file, key, f"has shape {tuple(stored.shape)} instead of {want}"))
        elif stored.dtype not in READABLE:
            faults.append(Fault(file, key, f"has dtype {stored.dtype}"))
        else:
            sizes |= new
    known = {*named.values(), COPY, "shared.weight"}
    faults += [Fault(file, key, "is not expected") for key in source.tensors if key not in known]
    if "blocks.0.norm1.weight" not in named:
        raise UserError(
            f"{file} holds no umT5 encoder: give {FILE}, or the folder `text_encoder` of a diffusers model."
        )
    report(faults)


def end_token(
    source: Source,
    cfg: DiTConfig,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> np.ndarray:
    """The last hidden state [1, text_dim] of the end token alone, in float32; `progress(layers done, layers)`.

    The official code computes it in bfloat16. Raises: UserError at the first number that is not finite.
    """
    check(source, cfg)
    named = names(source)
    depth = (len(named) - len(ENDS)) // len(LAYER)

    def vector(name: str) -> np.ndarray:
        return np.asarray(source.read(named[name]), np.float32)

    def times(name: str, x: np.ndarray) -> np.ndarray:
        matrix = source.read(named[name])
        parts = (matrix[i : i + ROWS].astype(np.float32) @ x for i in range(0, len(matrix), ROWS))
        return np.concatenate(list(parts))

    x = np.array(source.read(named["token_embedding.weight"])[END], np.float32)
    for i in range(depth):
        layer = f"blocks.{i}."
        h = normed(x, vector(f"{layer}norm1.weight"))
        x = x + times(f"{layer}attn.o.weight", times(f"{layer}attn.v.weight", h))
        h = normed(x, vector(f"{layer}norm2.weight"))
        gate = gelu(times(f"{layer}ffn.gate.0.weight", h))
        x = x + times(f"{layer}ffn.fc2.weight", gate * times(f"{layer}ffn.fc1.weight", h))
        if not np.isfinite(x).all():
            raise UserError(f"{source.path}: layer {i} holds NaN or infinity: get the file again.")
        progress(i + 1, depth)
    return normed(x, vector("norm.weight"))[None]


def normed(x: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """x over its root mean square, times the gain."""
    return x / np.sqrt(np.square(x).mean() + np.float32(EPS)) * gain


def gelu(x: np.ndarray) -> np.ndarray:
    """GELU in its form with tanh, as the published encoder has it."""
    inner = np.float32(np.sqrt(2.0 / np.pi)) * (x + np.float32(0.044715) * x**3)
    return np.float32(0.5) * x * (1.0 + np.tanh(inner))


def find(path: Path) -> Path | None:
    """The encoder that lies beside a transformer: the official file, or `text_encoder` of a diffusers folder."""
    folder = path if path.is_dir() else path.parent
    root = folder.parent if folder.name == "transformer" else folder
    for place in (folder / FILE, root / "text_encoder"):
        if place.is_file() or (place.is_dir() and any(place.glob("*.safetensors"))):
            return place
    return None
