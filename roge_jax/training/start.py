"""What a stage starts from: where its sequences come from, and whether a run that goes on is still the same one."""

from pathlib import Path

from ..checkpoint import model_fingerprint
from ..config import RoGeConfig
from ..core.params import Tree
from ..data.source import open_source
from ..errors import UserError
from ..folders import fingerprint_files, keep_settings
from .stages import Stage, stage_config


def open_data(pool: Path | None, stage: Stage, config: RoGeConfig):
    """The sequences of a stage. Raises: UserError if the pool does not have its size or frames."""
    working = stage_config(config, stage)
    window = working.frames if stage.views.ordered or stage.objective == "vae" else 1
    try:
        return open_source(pool, working.height, working.width, window)
    except UserError as error:
        raise UserError(f"Stage {stage.name}: {error}") from None


def hold_settings(
    out: Path,
    stage: Stage,
    params: Tree,
    config: RoGeConfig,
    *,
    seed: int,
    frozen_dtype: str,
    start: str,
    pool: Path | None,
    begun: bool,
    resume: bool,
) -> list[str]:
    """Write the settings.json of a stage, or hold a run that goes on (`begun` and `resume`) against it.

    `params` and `pool` count by their contents, wherever they lie; their names are written for people. Returns lines
    to print: what may differ and does, and what could not be compared. Raises: UserError naming what differs.
    """
    settings = {
        "model": config.name,
        "size": f"{config.height}x{config.width}",
        "batch": stage.batch,
        "seed": seed,
        "learning rate": stage.optim.learning_rate,
        "frozen dtype": frozen_dtype,
        "start contents": model_fingerprint(params, config),
        "data contents": "procedural scenes",
    }
    if pool is not None:
        settings["data contents"] = fingerprint_files(pool, "shard_*.npz", "shard_*.rgb.npy")
    notes = {"start": start, "data": str(pool or "procedural scenes"), "steps": stage.steps}
    before = keep_settings(out, settings, begun=begun, resume=resume, notes=notes)
    told = []
    if before.get("steps", stage.steps) != stage.steps:
        told.append(
            f"{stage.name}: begun for {before['steps']} steps and continued for {stage.steps}: where the learning "
            "rate falls moves with them"
        )
    if lost := [name for name in settings if name not in before]:
        told.append(
            f"{stage.name}: {out / 'settings.json'} does not say with which {', '.join(lost)} the run began: not "
            "compared"
        )
    return told
