"""How many heads an attention has: what its checkpoint tells, what was given, or what all released ones have.

A file of LagerNVS or VGGT tells it by its norms of queries, which are as wide as a head; DINOv2 inside has no such norms.
Wan's transformer norms all heads together, and has it in the `config.json` beside its file.
"""

import dataclasses
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..config import RoGeConfig
from ..errors import UserError, did_you_mean
from ..files.fields import is_file, read_json
from .sources import Source

WIDTHS = {
    "dit": 128,
    "encoder": 64,
    "dino": 64,
    "renderer": 64,
}  # of a head in the released networks
CALLED = {
    "dit": "transformer",
    "encoder": "alternating blocks",
    "dino": "DINOv2",
    "renderer": "renderer",
}
_NORMS = {
    "encoder": r"aggregator\.frame_blocks\.0\.attn\.q_norm\.weight$",
    "renderer": r"renderer_blocks\.0\.(self_)?attn\.q_norm\.weight$",
}


def parse(words: Iterable[str]) -> dict[str, int]:
    """{network: heads} of NETWORK=N. Raises: UserError."""
    found: dict[str, int] = {}
    for word in words:
        name, _, count = word.partition("=")
        if name not in WIDTHS:
            raise UserError(f"--heads {word}: {did_you_mean(name, WIDTHS)}")
        if not count.isdecimal() or not int(count):
            raise UserError(f"--heads {word}: give a number of heads, e.g. {name}=16.")
        found[name] = int(count)
    return found


def told(source: Source) -> dict[str, int]:
    """{network: heads}, as far as a checkpoint says it. Raises: UserError for a config.json that cannot be read."""
    found = {}
    widths = [t.shape[-1] for key, t in source.tensors.items() if key.endswith("camera_token")]
    rays = [t.shape[0] for key, t in source.tensors.items() if key.endswith("tgt_norm.weight")]
    for network, width in (("encoder", widths), ("renderer", rays)):
        norms = [t.shape for key, t in source.tensors.items() if re.search(_NORMS[network], key)]
        if width and norms and norms[0] and width[0] % norms[0][0] == 0:
            found[network] = width[0] // norms[0][0]
    folder = source.path if source.path.is_dir() else source.path.parent
    if not found and (record := _record(folder / "config.json")):
        count = record.get("num_heads", record.get("num_attention_heads"))
        if isinstance(count, int) and count > 0:
            found["dit"] = count
    return found


def _record(file: Path) -> dict[str, Any]:
    """What a config.json says, if it is that of a Wan transformer."""
    content = read_json(file, "transformer config") if is_file(file) else {}
    ours = isinstance(content, dict) and str(content.get("_class_name", "")).startswith("Wan")
    return content if ours else {}


def of(config: RoGeConfig) -> dict[str, int]:
    """{network: heads} of a configuration."""
    encoder = config.encoder
    return {
        "dit": config.dit.heads,
        "encoder": encoder.heads,
        "dino": encoder.dino_heads or encoder.heads,
        "renderer": config.renderer.heads,
    }


def put(config: RoGeConfig, counts: Mapping[str, int]) -> RoGeConfig:
    """The configuration with these heads; other networks keep theirs."""
    n = of(config) | dict(counts)
    dino = None if n["dino"] == n["encoder"] else n["dino"]
    return dataclasses.replace(
        config,
        dit=dataclasses.replace(config.dit, heads=n["dit"]),
        encoder=dataclasses.replace(config.encoder, heads=n["encoder"], dino_heads=dino),
        renderer=dataclasses.replace(config.renderer, heads=n["renderer"]),
    )


def settle(
    config: RoGeConfig, sources: Mapping[str, Source], given: Mapping[str, int], *, asked: bool
) -> RoGeConfig:
    """The configuration with the heads of its files; `sources`: the file that fills each network.

    What a file tells has the last word. asked: the configuration was asked for, and another number there is a mistake; if
    not, a network of which nothing is known has heads of the released width.
    Raises: UserError where two of them differ, nothing is known, or heads do not divide the width.
    """
    for name in given:
        if name not in sources:
            raise UserError(
                f"--heads {name}={given[name]}: no file fills that network: leave it away."
            )
    widths = {
        "dit": config.dit.width,
        "encoder": config.encoder.width,
        "dino": config.encoder.width,
        "renderer": config.renderer.width,
    }
    counts, own = {}, of(config)
    for name, source in sources.items():
        said, wanted, width = told(source).get(name), given.get(name), widths[name]
        if said and wanted not in (None, said):
            raise UserError(
                f"--heads {name}={wanted}, but {source.path} has {said} heads in its {CALLED[name]}: leave it away."
            )
        if said and asked and own[name] != said:
            raise UserError(
                f"{source.path} has {said} heads in its {CALLED[name]}, and preset '{config.name}' has {own[name]}: give no "
                "--preset to take those of the file."
            )
        count = said or wanted or (own[name] if asked else width // WIDTHS[name])
        if not asked and not (said or wanted) and width % WIDTHS[name]:
            raise UserError(
                f"{source.path} does not say how many heads its {CALLED[name]} of width {width} has: give --heads {name}=N."
            )
        if width % count:
            raise UserError(
                f"{count} heads do not divide the width {width} of the {CALLED[name]} in {source.path}: correct --heads "
                f"{name} or the config.json beside it."
            )
        counts[name] = count
    return put(config, counts)
