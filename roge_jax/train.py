"""Train a model: `python -m roge_jax.train PRESET`, by default the paper's recipe on top of the shipped weights.

    python -m roge_jax.train mini                          LoRA + new embeddings, end to end, from the shipped model
    python -m roge_jax.train mini --stage all --init scratch --out runs/mini     the recipe of the shipped model
    python -m roge_jax.train mini --stage recon --init runs/mini/recon_low/model  one stage from any model folder
    python -m roge_jax.train tiny --steps 20               seconds, random weights

Each stage writes OUT/STAGE: log.jsonl, settings.json, checkpoints/ (resumable with --resume) and model/ (weights and
config to load); lora and hires also adapter/ (what they changed, with a model card: see roge_jax.export).
"""

import argparse
import dataclasses
import math
from pathlib import Path

from .files.entry import number


def parser() -> argparse.ArgumentParser:
    from .core.products import DTYPES
    from .core.target import TARGETS

    p = argparse.ArgumentParser(
        prog="python -m roge_jax.train",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    p.add_argument("preset", help="tiny, mini, wan1.3b or paper")
    p.add_argument(
        "--stage",
        default="lora",
        help="lora (default): LoRA on both halves + new embeddings, the paper's joint training;\n"
        "hires: the same with the reconstruction frozen, at --size;\n"
        "vae_images, vae_clips, vae_longer, recon_low, recon, lookup, match, prior, generator, vae_decoder, joint: one stage\n"
        "of the recipe that makes a small model from nothing; all: these in order, then lora, then hires",
    )
    p.add_argument(
        "--init",
        help="model folder or name to start from, or 'scratch' (default: the preset's own)",
    )
    p.add_argument(
        "--data",
        action="append",
        metavar="DIR[:WEIGHT]",
        help="dataset, a folder written by roge_jax.procedural or data.pack (default: render as we go); may be given\n"
        "several times, and is then drawn from as often as its weight says (1 without)",
    )
    p.add_argument(
        "--most-bad",
        type=number(0),
        default=100,
        help="sequences of the data that may be unusable before the run stops; they are passed over and listed in\n"
        "OUT/STAGE/passed_over.jsonl (default: 100)",
    )
    p.add_argument(
        "--loaders", type=number(1), default=1, help="threads that draw batches (default: 1)"
    )
    p.add_argument(
        "--out", type=Path, default=Path("runs/train"), help="output folder (default: runs/train)"
    )
    p.add_argument("--steps", type=number(1), help="optimiser steps (default: the stage's own)")
    p.add_argument(
        "--steps-scale",
        type=number(1e-6, 1e6, whole=False),
        default=1.0,
        help="multiplies the stage's own number of steps, of every stage of 'all'",
    )
    p.add_argument("--batch", type=number(1), help="scenes per step (default: the stage's own)")
    p.add_argument(
        "--lr",
        type=number(1e-12, 1e3, whole=False),
        help="learning rate (default: the stage's own)",
    )
    p.add_argument(
        "--size",
        help="HEIGHTxWIDTH (default: the model's own, for stage hires twice that); in 'all' that of the stages\n"
        "before hires, which doubles it",
    )
    p.add_argument("--seed", type=number(0), default=0, help="of weights, data and noise")
    p.add_argument("--resume", action="store_true", help="continue from the last checkpoint in OUT")
    p.add_argument(
        "--devices", type=number(1), help="devices to use, on one machine (default: all)"
    )
    p.add_argument(
        "--mesh",
        help="how to split the work, e.g. data=2,fsdp=2,seq=2: scenes, weights, tokens and views of a\n"
        "scene (default: all devices on data); see docs/howto/gpus.md, also for several machines",
    )
    p.add_argument(
        "--frozen-dtype",
        choices=DTYPES,
        help="of weights that do not train (default: bfloat16 on accelerators, float32 on a CPU)",
    )
    p.add_argument(
        "--products",
        choices=DTYPES,
        help="what matrix products of the transformers and their gradients read; sums are float32 (default: as\n"
        "--frozen-dtype)",
    )
    p.add_argument(
        "--remat",
        choices=("none", "dots", "attention", "full"),
        help="what the backward pass keeps of the transformer: everything, matrix products, what\n"
        "attention returns, or the input of each block (default: dots; full from 1e9 parameters)",
    )
    p.add_argument(
        "--show-mesh", action="store_true", help="print where every leaf lies, then train"
    )
    p.add_argument(
        "--dry-run",
        action="store_true",
        help="print tokens, FLOPs and bytes of a step on each device of --mesh, and stop; no weights are needed",
    )
    p.add_argument(
        "--target",
        metavar="DEVICE",
        help=f"the device that --dry-run counts for, here or not: {', '.join(TARGETS)}\n"
        "(default: this machine's; of a model above 1e9 parameters h100 if this machine has a CPU alone)",
    )
    p.add_argument(
        "--compile",
        action="store_true",
        help="with --dry-run: also compile the step for the GPU of --target, here or not, and print what its compiler\n"
        "says (extra 'aot'; minutes)",
    )
    p.add_argument(
        "--context",
        type=number(1),
        help="how many photos a scene has that --dry-run counts (default: the most)",
    )
    p.add_argument(
        "--encode-once",
        type=number(1),
        metavar="N",
        help="stages whose reconstruction and VAE stay as they are (generator, hires): draw N samples, encode\n"
        "them once into OUT/STAGE/encoded, and train on those (default: every sample is new)",
    )
    p.add_argument("--save-every", type=number(1), default=100, help="steps between checkpoints")
    p.add_argument("--log-every", type=number(1), default=10, help="steps between log lines")
    p.add_argument(
        "--diagnose-every",
        type=number(0),
        default=0,
        help="steps between gradient norms of the two loss terms, their cosine, and the flow loss by\n"
        "noise level (joint stages)",
    )
    p.add_argument(
        "--evaluate-every",
        type=number(0),
        default=0,
        help="steps between evaluations on 16 held-out scenes; also one before the first step",
    )
    p.add_argument(
        "--tensorboard", action="store_true", help="also write TensorBoard events (extra 'log')"
    )
    p.add_argument("--debug", action="store_true", help="show tracebacks")
    return p


def main(args: argparse.Namespace) -> None:
    from .core import distributed, sharding
    from .errors import UserError

    if args.dry_run:
        return print(dry_run(args))
    if args.target or args.compile:
        raise UserError("--target and --compile belong to --dry-run: add it, or leave them out.")
    sizes = {} if args.mesh is None else sharding.parse_mesh(args.mesh)
    distributed.request_devices(args.devices or math.prod(sizes.values()))
    import jax

    from . import __version__, checkpoint, config, model
    from .core.params import drawn

    distributed.maybe_initialise_distributed()
    from .training import run, start

    preset, init = config.preset(args.preset), starting_point(args)
    start.check_processes(vars(args), init, args.data, version=__version__)
    devices = start.find_devices(args.devices)
    plain = len(devices) == 1 and not sizes and devices[0].platform == "cpu"
    mesh = None if plain else sharding.make_mesh(**sizes, devices=devices)

    cfg = preset if init == "scratch" else checkpoint.load_config(checkpoint.find_model(init))
    check_preset(preset, cfg, init)
    cfg, chosen = choose(args, cfg)
    check(args, cfg, chosen, mesh)  # now, not after hours
    with start.on_host():
        if init == "scratch":
            params = model.init(jax.random.key(args.seed), preset, make=drawn)
        else:
            params, _ = checkpoint.open_model(init)
    given = [field.name for field in dataclasses.fields(run.Options) if field.name != "skip_done"]
    options = run.Options(
        **{name: getattr(args, name) for name in given}, skip_done=args.stage == "all"
    )
    for stage in chosen:
        sized = stage_size(args, stage, cfg)
        params, cfg = run.run_stage(stage, params, sized, options, mesh=mesh, base=init)
        init = str(args.out / stage.name / "model")


def check(args: argparse.Namespace, cfg, chosen, mesh) -> None:
    """Raise UserError if a stage does not fit data, mesh, memory or disk; print a line where memory may be short."""
    from .core import distributed
    from .training import room, start

    dtype = start.kept_dtype(args.frozen_dtype)
    recipe = [(stage, stage_size(args, stage, cfg)) for stage in chosen]
    for stage, sized in recipe:
        if args.data:
            start.open_data(args.data, stage, sized)
        room.check_layout(sized, stage, mesh, dtype=dtype)
    room.check_space(args.out, recipe, save_every=args.save_every)
    for line in [room.check_room(stage, sized, mesh, dtype=dtype) for stage, sized in recipe]:
        if line and distributed.is_main():
            print(line)


def starting_point(args: argparse.Namespace) -> str:
    return args.init or ("mini" if args.preset == "mini" and args.stage != "all" else "scratch")


def check_preset(preset, cfg, init: str) -> None:
    """Raise UserError if the model to start from is half a model, or that of another preset: its sizes would silently win."""
    from .config import PRESETS
    from .errors import UserError

    if cfg.parts != "all":
        other = "--wan" if cfg.parts == "reconstruction" else "--lagernvs"
        raise UserError(
            f"--init {init} is a {cfg.parts} alone, and training needs both halves: convert its files again with {other} as "
            "well (or --random, to start the other half from nothing)."
        )
    if cfg.name != preset.name and cfg.name in PRESETS:
        raise UserError(
            f"--init {init} is a '{cfg.name}' model and the preset is '{preset.name}': the model's own sizes count, so "
            f"write `train {cfg.name} --init {init}`."
        )


def choose(args: argparse.Namespace, cfg):
    """(the configuration at --size, the stages that --stage means with everything that the flags change)."""
    from . import model
    from .core.params import count
    from .errors import UserError
    from .training import estimate, start
    from .training import stages as stages_

    if args.stage == "hires" or args.size:
        cfg = start.resize(cfg, args.size, hires=args.stage == "hires")
    size = (cfg.height, cfg.width)
    recipe = stages_.mini_stages(args.steps_scale, frames=cfg.frames, size=size)
    for hires in (False, True):
        steps = max(1, round(200 * args.steps_scale))
        stage = stages_.lora_stage(steps, frames=cfg.frames, hires=hires)
        small = count(model.specs(cfg)) < estimate.LARGE
        recipe.append(stages_.for_one_scene(stage) if small else stage)
    if not cfg.renderer.lookup:
        if args.stage == "lookup":
            raise UserError(
                f"--stage lookup trains image-based rendering, and this model of '{cfg.name}' has none (renderer.lookup is "
                "0): start from one that has, such as --init mini, or from scratch."
            )
        recipe = [stage for stage in recipe if not stage.lookup]
    if not (cfg.renderer.lookup and cfg.renderer.matching):
        if args.stage == "match":
            raise UserError(
                f"--stage match trains the features that photos are matched by, and this model of '{cfg.name}' has none "
                "(renderer.matching is false): start from one that has, such as --init mini, or from scratch."
            )
        recipe = [stage for stage in recipe if stage.objective != "match"]
    chosen = recipe if args.stage == "all" else [stages_.find_stage(recipe, args.stage)]
    changes = {"steps": args.steps, "batch": args.batch}
    changes = {k: v for k, v in changes.items() if v}
    changes["remat"] = args.remat or estimate.default_remat(cfg)
    changes["products"] = start.products_dtype(args.products, args.frozen_dtype)
    chosen = [dataclasses.replace(stage, **changes) for stage in chosen]
    if args.encode_once:
        chosen = stages_.all_once_encoded(chosen, cfg, args.encode_once)
    if args.lr:
        chosen = [
            dataclasses.replace(s, optim=dataclasses.replace(s.optim, learning_rate=args.lr))
            for s in chosen
        ]
    return cfg, chosen


def dry_run(args: argparse.Namespace) -> str:
    """What a step of every chosen stage costs, as text. Devices need not be there, weights are not read."""
    from . import checkpoint, config, model
    from .core import aot, target
    from .core.params import count
    from .training import estimate

    init = starting_point(args)
    cfg = config.preset(args.preset)
    if init != "scratch":
        preset, cfg = cfg, checkpoint.load_config(checkpoint.find_model(init))
        check_preset(preset, cfg, init)
    large = count(model.specs(cfg)) > estimate.LARGE
    if args.compile:
        aot.by_the_cpu()
    with target.use(args.target or ("h100" if large and target.machine() == "cpu" else None)):
        if args.compile:
            aot.check(target.name())
        cfg, chosen = choose(args, cfg)
        return "\n\n".join(planned(args, cfg, stage) for stage in chosen)


def planned(args: argparse.Namespace, cfg, stage) -> str:
    """What a step of one stage costs on the device of `core.target`."""
    from .core import sharding
    from .errors import UserError
    from .training import estimate, room, start

    dtype = start.kept_dtype(args.frozen_dtype)
    sizes = {} if args.mesh is None else sharding.parse_mesh(args.mesh)
    mesh = sharding.abstract_mesh(**sizes) if sizes else None
    if args.devices:
        mesh = sharding.abstract_mesh(*sharding.mesh_sizes(args.devices, **sizes))
    m = max(stage.views.contexts) if args.context is None else args.context
    if not 1 <= m <= cfg.max_context:
        raise UserError(
            f"--context {m}: this model ({cfg.name}) takes 1 to {cfg.max_context} photos."
        )
    sized = stage_size(args, stage, cfg)
    room.check_layout(sized, stage, mesh, dtype=dtype)
    found = estimate.estimate(sized, stage, m=m, mesh=mesh, dtype=dtype)
    text = estimate.report(found, sized, stage, m=m, mesh=mesh, dtype=dtype)
    if not args.compile:
        return text
    from .core import aot, target
    from .training.compiled import compiled_step

    name = target.name()
    data, fsdp, seq = (1, 1, 1) if mesh is None else mesh.shape.values()
    said = compiled_step(sized, stage, m=m, name=name, sizes=(data, fsdp, seq), dtype=dtype)
    return f"{text}\n\n{aot.report({'step': said}, name)}"


def stage_size(args: argparse.Namespace, stage, cfg):
    """The configuration in a stage: `hires` doubles the size within 'all'; alone, `choose` has set it."""
    from .training.start import resize

    again = args.stage == "all" and stage.name == "hires"
    return resize(cfg, None, hires=True) if again else cfg


if __name__ == "__main__":
    from .files.entry import run

    run(main, parser())
