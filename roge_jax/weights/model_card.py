"""The README.md of an adapter: what it is, how to use it, what it was made from and under which licences.

Entries of `provenance` that are read, all optional: `base` (name of the model it was trained on),
`base_provenance` (that model's own provenance, as `roge_jax.convert`, `train` or `export` wrote it), `stage`, `steps`, `data` (one sentence
on the training data) and `data_license`.
"""

from collections.abc import Iterator, Mapping

from ..config import RoGeConfig

FREE = "Apache-2.0"

# By the option of roge_jax.convert that read the file: (what it is, licence, where its text is).
LICENCES = {
    "--lagernvs": (
        "LagerNVS",
        "FAIR Noncommercial Research License: research only, no commercial use",
        "https://huggingface.co/facebook/lagernvs_general_512",
    ),
    "--vggt": ("VGGT-1B", "the VGGT license", "https://huggingface.co/facebook/VGGT-1B"),
    "--wan": ("Wan2.1", FREE, "https://huggingface.co/Wan-AI"),
    "--wan-vae": ("Wan2.1 VAE", FREE, "https://huggingface.co/Wan-AI"),
    "--framecrafter": ("FrameCrafter", "ask its authors", "https://github.com/szqwu/FrameCrafter"),
}


def adapter_card(leaves: Mapping[str, object], config: RoGeConfig, provenance: Mapping) -> str:
    """The text of the card; `leaves` are the adapter's arrays by path."""
    factors = {p: x for p, x in leaves.items() if p.endswith("lora_a")}
    full = [p for p in leaves if not p.endswith(("lora_a", "lora_b"))]
    ranks: dict[str, set[int]] = {}
    for path, x in factors.items():
        ranks.setdefault(path.partition("/")[0], set()).add(x.shape[-1])  # type: ignore[attr-defined]
    base = provenance.get("base", "not recorded")
    sources = _sources(provenance)
    restricted = any(licence != FREE for licence, _ in sources)
    count = sum(x.size for x in leaves.values())  # type: ignore[attr-defined]
    lines = [
        "---",
        f"license: {'other' if restricted else 'apache-2.0'}",
        "library_name: roge_jax",
        "tags: [novel-view-synthesis, lora, jax]",
        "---",
        f"# RoGe adapter for `{config.name}`",
        "",
        f"LoRA factors and new embeddings, {count:,} parameters in float32, trained on top of `{base}`.",
        "",
        "| part | contents |",
        "|---|---|",
    ]
    for network, found in sorted(ranks.items()):
        layers = sum(path.startswith(f"{network}/") for path in factors)
        lines.append(
            f"| `{network}` | LoRA of rank {', '.join(map(str, sorted(found)))} on {layers} kernels |"
        )
    if full:
        lines.append(f"| trained fully | {', '.join(f'`{p}`' for p in sorted(full))} |")
    lines += [
        "",
        "## Use",
        "```",
        "python -m roge_jax.export THIS_FOLDER --merge BASE --out MODEL     # a standalone model folder",
        "python -m roge_jax.export THIS_FOLDER --style diffusers --out LORA  # the transformer's LoRA for diffusers",
        "```",
        f"Video {config.height}x{config.width}, {config.frames} frames per window, up to {config.max_context} photos.",
        "",
        "## Training",
        f"Stage: {provenance.get('stage', 'not recorded')}. Steps: {provenance.get('steps', 'not recorded')}.",
        f"Data: {provenance.get('data', 'not recorded; name it here before sharing')}.",
        f"Licence of the data: {provenance.get('data_license', 'not recorded; check it before sharing')}.",
        "",
        "## Licences",
        "An adapter is made from the weights below; their terms go on holding for it and for merged models.",
        *(f"- {text}" for _, text in sources),
        "",
    ]
    return "\n".join(lines)


def _records(provenance: Mapping) -> Iterator[Mapping]:
    """A provenance and those of everything that the model was made from."""
    yield provenance
    for name in ("base_provenance", "merged", "base"):  # `base` is a name where training wrote it
        if isinstance(provenance.get(name), Mapping):
            yield from _records(provenance[name])


def _sources(provenance: Mapping) -> list[tuple[str, str]]:
    """(licence, line of the card) of everything with terms of its own that went into the base."""
    records = list(_records(provenance))
    parts = [part for record in records for part in record.get("converted", [])]
    read = dict.fromkeys(part["option"] for part in parts if part.get("tensors", 1))
    found = []
    for option in read:
        name, licence, place = LICENCES.get(option, (option, "not recorded", "ask its authors"))
        found.append((licence, f"{name}: {licence} ({place})"))
    for licence in dict.fromkeys(r["license"] for r in records if "license" in r):
        found.append((licence, f"The model that training began with: {licence}"))
    if not found and any(record.get("base") == "scratch" for record in records):
        found = [(FREE, f"Trained from random weights with code under {FREE}.")]
    return found or [("", "The base's own licence, which is not recorded in its config.json.")]
