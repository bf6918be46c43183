"""What a model folder holds and what it can do, as `python -m roge_jax.check FOLDER` says it. Weights are not read."""

from pathlib import Path
from typing import Any

from ..checkpoint import load_provenance, open_model
from ..config import RoGeConfig
from ..core.params import count
from ..errors import UserError
from ..files.fields import is_file, read_json
from ..geometry.validation import Finding
from .reconstruction import check_makes_pictures

ALONE = "is a reconstruction alone: sample, evaluate and view show its own picture, and nothing is generated"


def is_model(name: str) -> bool:
    """Whether it is a model folder, as `convert` and `train` write them, and no scene."""
    record = Path(name) / "config.json"
    if not is_file(record):
        return False
    try:
        found = read_json(record, "model config")
    except UserError:
        return False
    return isinstance(found, dict) and isinstance(found.get("config"), dict)


def inspect_model(folder: str) -> tuple[dict[str, Any], list[Finding]]:
    """(numbers, findings): the parts with their parameters, photos and size of pictures; why it makes none."""
    try:
        params, config = open_model(folder)
    except UserError as error:
        return {"model": "cannot be read", "parts": {}}, [_error(error)]
    numbers = {
        "model": config.name,
        "parts": {name: count(part) for name, part in params.items()},
        "photos": config.max_context,
        "size": list(config.output_size),
    }
    try:
        check_makes_pictures(config, folder)
    except UserError as error:
        return numbers, [_error(error)]
    return numbers, _what_it_makes(config, load_provenance(Path(folder)))


def _error(error: UserError) -> Finding:
    what, _, fix = str(error).rstrip(".").rpartition(": ")
    return Finding("error", "model", what or fix, fix if what else "copy or convert it again")


def _what_it_makes(config: RoGeConfig, provenance: dict[str, Any]) -> list[Finding]:
    if config.parts == "reconstruction":
        fix = "for a generator to train, convert it together with --wan"
        return [Finding("note", "model", ALONE, fix)]
    new = sorted({path.partition("/")[0] for path in provenance.get("initialised", ())})
    if not new or "stage" in provenance:
        return []
    what = f"was converted and never trained ({', '.join(new)} as initialised): its video means nothing yet"
    fix = "train it with --stage lora; sample --preview-only shows the reconstruction's picture at once"
    return [Finding("warning", "model", what, fix)]


def render_model(folder: str, numbers: dict[str, Any], findings: list[Finding]) -> str:
    """The report for people."""
    usable = not any(finding.severity == "error" for finding in findings)
    lines = [f"model     {folder}: {numbers['model']}"]
    if numbers["parts"]:
        held = (f"{name} {size / 1e6:,.1f} M" for name, size in numbers["parts"].items())
        lines.append(f"holds     {', '.join(held)} parameters")
    if usable:
        height, width = numbers["size"]
        lines.append(f"pictures  {height}x{width}, of 1 to {numbers['photos']} photos")
    lines += [f"{finding.severity:9s} {finding}" for finding in findings]
    lines.append("result    " + ("can be used" if usable else "makes no pictures"))
    return "\n".join(lines)
