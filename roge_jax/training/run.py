"""One stage of training, from the model it starts from to the model that it saves."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import checkpoint, model
from ..config import RoGeConfig
from ..core import distributed, sharding
from ..core.lora import attach
from ..core.params import Tree, count, flatten, unflatten
from ..core.params import init as init_specs
from ..cost import kept_as
from ..data.source import MOST_BAD
from . import loop, stages, start
from .diagnose import joint_diagnose
from .held_out import held_out
from .stages import Stage


@dataclasses.dataclass(frozen=True)
class Options:
    """What all stages of a run have in common; the names are those of the command line (docs/reference/programs.md)."""

    out: Path
    data: Any = None  # a dataset or a list of them (`data.source.Given`); None: rendered as we go
    most_bad: int = MOST_BAD  # sequences of the data that may be unusable
    loaders: int = 1  # threads that draw batches
    seed: int = 0
    resume: bool = False
    skip_done: bool = False  # with `resume`: a stage whose model is there is not run again
    frozen_dtype: str | None = None
    show_mesh: bool = False
    save_every: int = 100
    log_every: int = 10
    evaluate_every: int = 0  # 0: never
    diagnose_every: int = 0
    tensorboard: bool = False


class Parts(NamedTuple):
    """A model in two: what trains, in float32 on the host, and what does not, where it stays; and their specs."""

    trainable: Tree
    frozen: Tree
    specs: Tree
    frozen_specs: Tree


def run_stage(
    stage: Stage, params: Tree, config: RoGeConfig, options: Options, *, mesh, base: str
) -> tuple[Tree, RoGeConfig]:
    """Train one stage on the model named `base` and save its model; returns (params, config) for the next.

    The leaves of `params` may lie in files (`checkpoint.open_model`), as those do that are returned. Read are those that
    train, into float32 on the host, and those that the objective reads, each straight to where it stays.
    Raises: UserError for a folder, data or a start that do not belong to this run; `loop.TrainingStopped`.
    """
    out = options.out / stage.name
    before, origin, opened = start.provenance(base), start.fingerprint(params, base), params
    dtype = start.kept_dtype(options.frozen_dtype)
    if _trained_before(out, stage, params, config, options, base=base, dtype=dtype):
        return checkpoint.open_model(out / "model")
    listed = out / "passed_over.jsonl"
    source = start.open_data(options.data, stage, config, most=options.most_bad, file=listed)
    if stage.about_preview and config.fusion.preview and config.fusion.preview_std is None:
        params, config = stages.measure_preview(params, source, config, options.seed)
    parts = _divided(params, stage, config, options.seed, mesh, dtype)
    _tell(parts, params, stage, config, mesh, dtype, show_mesh=options.show_mesh)
    state = _fit(out, stage, params, config, options, source, parts, mesh)
    learned = sharding.gather(state.get("ema", state["params"]))
    start.check_unchanged(opened, origin, base)
    params, config, lora = _measured(params, learned, stage, config, source, options.seed)
    provenance = {
        "stage": stage.name,
        "steps": int(state["step"]),
        "skipped": int(state["skipped"]),
        "products": stage.products or dtype,
        "base": base,
        "base_provenance": before,
    }
    if distributed.is_main():
        with start.on_host():
            checkpoint.save_model(
                out / "model",
                params,
                config,
                dtype=jax.numpy.float32,
                provenance=provenance,
                lora=lora,
            )
        if stage.lora:
            data = start.named(options.data)
            provenance |= {"data": data, "base_weights": origin}
            checkpoint.save_adapter(out / "adapter", learned, config, provenance)
        change = loop.held_out_change(out / "log.jsonl")  # which only the main process writes
        print(f"{stage.name}: saved {out / 'model'}{change}")
    distributed.meet(f"{stage.name} is saved")
    return checkpoint.open_model(out / "model")


def _trained_before(
    out: Path, stage: Stage, params: Tree, config, options: Options, *, base: str, dtype: str
) -> bool:
    """Whether the stage's model is there and stays; holds a run that goes on against its settings either way."""
    done = options.resume and options.skip_done and (out / "model" / "config.json").exists()
    if not distributed.is_main():
        return done
    begun = done or any(any((out / d).glob("*[0-9]*")) for d in ("checkpoints", "encoded"))
    told = start.hold_settings(
        out,
        stage,
        params,
        config,
        seed=options.seed,
        frozen_dtype=dtype,
        start=base,
        pool=options.data,
        begun=begun,
        resume=options.resume,
    )
    for line in [f"{stage.name}: already trained, {out / 'model'}"] if done else told:
        print(line)
    return done


def _divided(params: Tree, stage: Stage, config, seed: int, mesh, dtype: str) -> Parts:
    trainable, frozen = model.split(params, stage.trains)
    specs, frozen_specs = stages.stage_specs(config, stage)
    with start.on_host():
        trainable = checkpoint.placed(trainable, lambda path: np.float32)
        if stage.lora:
            added = stages.new_leaves(config, stage)
            trainable = attach(trainable, init_specs(jax.random.key(seed + 1), added))
    where = None if mesh is None else sharding.shardings(frozen_specs, mesh)
    frozen = start.place_frozen(stages.read(frozen, stage), dtype, where)
    return Parts(trainable, frozen, specs, frozen_specs)


def _tell(parts: Parts, params: Tree, stage: Stage, config, mesh, dtype: str, *, show_mesh: bool):
    """Print what trains, and where every leaf lies if that is asked for."""
    if not distributed.is_main():
        return
    if show_mesh:
        shown = sharding.abstract_mesh() if mesh is None else mesh
        kept = sharding.describe(parts.frozen_specs, shown, kept_as(dtype))
        print(f"trains: {sharding.describe(parts.specs, shown)}\nfrozen: {kept}")
    layout = "1 device" if mesh is None else ", ".join(f"{k}={v}" for k, v in mesh.shape.items())
    working = stages.stage_config(config, stage)
    print(
        f"{stage.name}: {count(parts.trainable):,} of {count(params):,} parameters train, {stage.steps} steps of "
        f"{stage.batch} scene{'s' * (stage.batch > 1)} at {working.height}x{working.width}, {layout} ({jax.devices()[0].device_kind})"
    )


def _fit(
    out: Path, stage: Stage, params: Tree, config, options: Options, source, parts: Parts, mesh
) -> dict[str, Any]:
    """The state after the stage's last step."""
    working = stages.stage_config(config, stage)
    views = dataclasses.replace(stage.views, size=(working.height, working.width))
    stage = dataclasses.replace(stage, views=views)
    objective = stages.objective_of(working, stage)
    rows = distributed.local_rows(mesh, stage.batch)
    batches, encode = start.samples(
        stage, source, params, working, options.seed, rows, out / "encoded", resume=options.resume
    )
    evaluate = diagnose = writer = None
    if options.evaluate_every:
        evaluate = held_out(objective, parts.frozen, stage, working, encode=encode)
    del encode  # and with it the networks that encode
    if options.diagnose_every and stage.objective == "joint":
        diagnose = joint_diagnose(working)
    if options.tensorboard and distributed.is_main():
        from tensorboardX import SummaryWriter

        writer = SummaryWriter(str(out / "tensorboard"))
    with contextlib.closing(writer) if writer else contextlib.nullcontext():
        return loop.train(
            objective,
            parts.trainable,
            parts.frozen,
            parts.specs,
            batches,
            optim=stage.optim,
            loop=loop.LoopConfig(
                steps=stage.steps,
                seed=options.seed,
                log_every=options.log_every,
                save_every=options.save_every,
                loaders=options.loaders,
            ),
            out=out,
            resume=options.resume,
            mesh=mesh,
            frozen_specs=parts.frozen_specs,
            batch=stage.batch,
            name=stage.name,
            evaluate=evaluate,
            evaluate_every=options.evaluate_every,
            diagnose=diagnose,
            diagnose_every=options.diagnose_every,
            writer=writer,
        )


def _measured(params: Tree, learned: Tree, stage: Stage, config, source, seed: int):
    """(the model with what it learned, its configuration with what that changes of the measured statistics, the LoRA)."""
    leaves = flatten(learned)
    lora = {path: x for path, x in leaves.items() if path.endswith(("lora_a", "lora_b"))}
    full = {path: x for path, x in leaves.items() if path not in lora}
    params = attach(params, unflatten(full))
    if stages.moves_latents(full):
        config = stages.measure_latents(params, source, config, seed)
        fusion = dataclasses.replace(config.fusion, preview_std=None)
        config = dataclasses.replace(config, fusion=fusion)
    if stage.objective == "recon" and not stage.lookup:
        params, config = stages.measure_features(params, source, config, seed)
    if stage.lookup and config.fusion.preview_std is not None:
        config = stages.measure_spread(params, source, config, seed)
    return params, config, unflatten(lora)
