"""Make a video of a scene along a camera path: `python -m roge_jax.sample`, all options have defaults.

    python -m roge_jax.sample                                      two real photos, a path between them, the shipped model
    python -m roge_jax.sample --scene DIR --trajectory spiral --frames 49 --seed 1
    python -m roge_jax.sample --scene DIR --context 0,7,12 --trajectory orbit:degrees=90,swing=false
    python -m roge_jax.sample --scene DIR --trajectory path.json
    python -m roge_jax.sample --trajectory list                    every ready-made path with its options
    python -m roge_jax.sample --scene DIR --preview-only           the reconstruction's own picture, nothing generated
    python -m roge_jax.sample --checkpoint paper --context 6 --dry-run     shapes, FLOPs, memory; no weights needed

OUT gets video.mp4, preview.mp4 (the reconstruction's own picture), frames/0000.png .., contact_sheet.png and run.json. It is
also a scene of frames and photos, for nerfstudio and 3D Gaussian trainers: images/, transforms.json and sparse/0 (COLMAP).
docs/start/first_video.md explains everything.
A model that is a reconstruction alone, such as LagerNVS, makes its own picture; nothing is generated, and preview.mp4 is left out.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from .files.entry import Clock, number, one_of, run
from .files.folders import RECORD, output_folder, write_json
from .files.video_io import video_kinds
from .sampling.inputs import (
    ALONE,
    FPS,
    MOST_FRAMES,
    SCENE,
    THROUGH,
    large_dtype,
    load_weights,
    model_config,
    read_inputs,
    sampling_mesh,
    stand_in,
)

DTYPES = ("auto", "float32", "bfloat16")


def parser() -> argparse.ArgumentParser:
    """The options of `python -m roge_jax.sample`."""
    from .core.target import TARGETS
    from .geometry.cameras import CONVENTIONS
    from .geometry.trajectories import PRESETS
    from .sampling.photos import DEFAULT_CONTEXT
    from .sampling.video import LONG, SLOTS
    from .video.flow import SCHEDULES
    from .video.solver_table import SOLVERS

    p = argparse.ArgumentParser(
        prog="python -m roge_jax.sample",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )

    def option(name: str, help: str, default: Any = None, **more: Any) -> None:
        shown = "" if default is None else f" (default: {default})"
        p.add_argument(name, default=default, help=help + shown, **more)

    real, own = number(1e-30, whole=False), "; the model's own if not given"
    option("--checkpoint", "model folder, or the name of a shipped one", "mini")
    option("--scene", "scene folder, motorcycle (two real photos) or procedural:SEED", SCENE)
    paths = ", ".join(sorted(PRESETS))
    path_help = (
        f"a path file or a scene's own file or folder, or {paths}; options after a colon: orbit:degrees=90,swing=false; "
        f"'list' prints all of them with their options (default: {THROUGH}; of a single photo {ALONE})"
    )
    option("--trajectory", path_help, metavar="NAME|FILE")
    frames_help = f"length of the path, up to {MOST_FRAMES}; the model's window, or the file's own"
    option("--frames", frames_help, type=number(1))
    option("--steps", f"sampling steps{own}", type=number(1))
    option("--solver", f"{', '.join(SOLVERS)}{own}", type=one_of(SOLVERS))
    option("--schedule", f"{', '.join(SCHEDULES)}{own}", type=one_of(SCHEDULES))
    option("--seed", "seed of the noise: same seed, same frames", 0, type=number(0))
    option("--out", "output folder", Path("outputs/sample"), type=Path)
    ids_help = (
        "how many photos, chosen to see as much as possible, of a path file if there is one; or which, by number or "
        f"name, with commas ('4,' is photo 4 alone), the first being the world frame; up to {DEFAULT_CONTEXT} if not given"
    )
    option("--context", ids_help, metavar="M|IDS")
    axes_help = f"axes of the poses of a transforms.json that are not OpenGL, of the path too: {', '.join(CONVENTIONS)}"
    option("--convention", axes_help, type=one_of(CONVENTIONS))
    frame_help = (
        "coordinates of a path file: scene, first (starts at the first photo; first:SCALE), nerfstudio's "
        "dataparser_transforms.json, or a 3x4 or 4x4 matrix by rows and a scale, with commas; found out if not given"
    )
    option("--path-frame", frame_help, metavar="WHERE")
    preview_help = "the reconstruction's own picture alone: no generator runs or is loaded, video and frames are the preview"
    p.add_argument("--preview-only", action="store_true", help=preview_help)
    generate_help = (
        "run the generator, also of a model whose preview is better than what it generates (mini); any option of the "
        "generator asks for it too"
    )
    p.add_argument("--generate", action="store_true", help=generate_help)
    option("--start", "the context photo a preset path starts from", 0, type=number(0))
    option("--fov", "vertical field of view in degrees; the photos' if not given", type=real)
    option("--size", "HEIGHTxWIDTH of the pictures; the model's own if not given")
    scale_help = "divisor of all positions, in units of the scene; the model's rule if not given"
    option("--scale", scale_help, type=number(1e-30, whole=False))
    slots_help = "latents of photos while sampling: noised to the current level, clean, or free"
    option("--context-slots", slots_help, "noised", type=one_of(SLOTS))
    long_help = "long paths: chain (later windows see frames already made) or independent"
    option("--long", long_help, "chain", type=one_of(LONG))
    tolerance_help = (
        "spend no more than this needs: expected RMS colour difference (0 to 1) to the full model's frames, e.g. 0.02; "
        "chooses among the photos, steps and more (docs/howto/cost.md)"
    )
    option("--tolerance", tolerance_help, type=number(0, whole=False))
    option("--max-cost", "with or without --tolerance: the most FLOPs to spend", type=real)
    fps_help = f"frames per second; the path file's own, else {FPS:g}"
    option("--fps", fps_help, type=number(1e-3, 1000, whole=False))
    video_help = "kinds of video, with commas: mp4, webm, webp, gif (default: mp4)"
    exr_help = (
        "also write exr/0000.exr ..: the frames in float and linear light, with their cameras"
    )
    p.add_argument("--exr", action="store_true", help=exr_help)
    p.add_argument("--video", default=("mp4",), type=video_kinds, metavar="KINDS", help=video_help)
    option("--dtype", "of large matrices: auto, float32, bfloat16", "auto", type=one_of(DTYPES))
    mesh_help = "how to split the work over devices, e.g. fsdp=2,seq=2: weights; tokens and views (one device if not given)"
    option("--mesh", mesh_help)
    option("--devices", "how many devices to use; those of --mesh", type=number(1))
    p.add_argument(
        "--dry-run", action="store_true", help="print tokens, FLOPs and memory, and stop"
    )
    target_help = f"the device that --dry-run counts for, here or not: {', '.join(TARGETS)}; this machine's if not given"
    option("--target", target_help, metavar="DEVICE")
    compile_help = (
        "with --dry-run: also compile the first window for the GPU of --target, here or not, and print what its compiler "
        "says (extra 'aot'; minutes)"
    )
    p.add_argument("--compile", action="store_true", help=compile_help)
    p.add_argument("--debug", action="store_true", help="show where an error comes from")
    return p


# ---- the program ---------------------------------------------------------------------------------


def main(args: argparse.Namespace) -> None:
    """Make the video and write OUT."""
    import warnings

    from . import sampling
    from .config import to_dict
    from .core import sharding, target
    from .errors import UserError
    from .sampling import outputs, reconstruction
    from .sampling.scene_limits import Beside

    if args.trajectory == "list":
        from .geometry.trajectories import describe

        return print(describe())
    if args.preview_only:
        refuse_options(args, "--preview-only runs none")
    settings = sampling.Settings(
        steps=args.steps or 0,
        solver=args.solver or "",
        schedule=args.schedule or "",
        seed=args.seed,
        slots=args.context_slots,
        long=args.long,
        scale=args.scale,
        generate=True if args.generate or generator_option(args) else None,
    )
    if args.dry_run:
        with target.use(args.target):
            return print(dry_run(args, settings))
    if args.target or args.compile:
        raise UserError("--target and --compile belong to --dry-run: add it, or leave them out.")
    clock = Clock()
    config, mesh = model_config(args, weights=True), sampling_mesh(args)
    settings = settings.of(config)
    only = previews(args, config, settings)
    with output_folder(args.out, keep=outputs.FRAMES) as folder, sharding.use(mesh):
        with clock("load"):
            scene, photos, path = read_inputs(args, config, settings)
            size = config.output_size
            kinds = outputs.check_outputs(
                folder, args.video, len(path), size, args.fps, exr=args.exr
            )
            params, _ = load_weights(args, mesh, reconstruction.PARTS if only else None)
        beside = Beside(scene, photos.ids, config, args.convention)
        print(begun(args, scene, config, photos, path, only=only))
        plan = None
        if args.tolerance is not None or args.max_cost is not None:
            from .planning.plan import plan as make_plan

            with clock("plan"):
                plan = make_plan(
                    params,
                    config,
                    photos,
                    path,
                    tolerance=args.tolerance or 0.0,
                    max_cost=args.max_cost,
                    settings=settings,
                )
            print(plan.explain())
        stage = beside.before_work(clock)
        given, more = (params, config, photos, path), {"stage": stage, "progress": True}
        # The built-in scene has no third photo: that it has two is in run.json, and no mistake of the user's.
        more["known"] = ("photos",) if args.scene == SCENE and len(photos.ids) == len(scene) else ()
        if only:
            result = sampling.preview(*given, scale=args.scale, **more)
        else:
            result = sampling.sample(*given, settings, plan=plan, **more)
        result = dataclasses.replace(result, warnings=(*result.warnings, *beside.tell()))
        for note in result.normalisation.notes:
            warnings.warn(note, stacklevel=2)
        used = {"scale": args.scale} if only else dataclasses.asdict(settings)
        made = config, used, scene, photos, result

        def record() -> dict[str, Any]:
            said = outputs.record("roge_jax.sample", vars(args), *made, clock, generated=not only)
            return said | ({} if plan is None else {"plan": dataclasses.asdict(plan)})

        with clock("write"):
            write_json(folder / RECORD, record())  # also beside frames whose video fails
            told: dict[str, Any] = {
                "kinds": kinds,
                "exr": args.exr,
                "generated": not only,
                "about": outputs.remark(to_dict(config), used),
            }
            outputs.write_outputs(folder, result, scene, photos, args.fps, **told)
        content = record()
        write_json(folder / RECORD, content)
    stages = ", ".join(
        f"{name} {stage['seconds']:.1f} s" for name, stage in content["stages"].items()
    )
    print(
        f"{stages}; peak memory {content['stages']['total'].get('peak_memory_gb', float('nan')):.2f} GB"
    )
    if only:
        print(f"{content['seconds_per_frame']:.3f} s a frame")
    videos = [f"video.{kind}" for kind in kinds]
    videos += ["the preview"] if only else [f"preview.{kind}" for kind in kinds]
    rest = "frames, contact_sheet.png, run.json; images, transforms.json, sparse: as a scene"
    print(f"wrote {args.out}/ ({', '.join(videos)}, {rest})")


def begun(args: argparse.Namespace, scene, config, photos, path, *, only: bool) -> str:
    """The first line of a run: what of which scene; `only`: nothing is generated."""
    count, (height, width) = len(photos.ids), config.output_size
    own = ", the built-in scene (--scene takes yours)" if args.scene == SCENE else ""
    many = "photo" if count == 1 else "photos"
    how = ": the reconstruction's own picture" if only else ", generated"
    if only and not (args.preview_only or config.parts == "reconstruction"):
        how += ", which is better than what it generates (--generate)"
    return f"{count} {many} of {scene.source}{own}, {len(path)} frames of {height}x{width}, {config.name}{how}"


def previews(args: argparse.Namespace, config, settings) -> bool:
    """Whether nothing is generated: that was asked for, there is nothing to generate with, or the preview is better."""
    if config.parts == "reconstruction":
        refuse_options(args, f"{args.checkpoint} is a reconstruction alone")
    return args.preview_only or config.parts == "reconstruction" or not settings.generate


def refuse_options(args: argparse.Namespace, why: str) -> None:
    """Raise UserError for an option of the generator, which does not run, and say `why`."""
    from .errors import UserError

    if option := generator_option(args):
        raise UserError(f"{option} is for the generator, and {why}: leave that option away.")


def generator_option(args: argparse.Namespace) -> str | None:
    """The first option given that only a generator has a use for, as it was written; None if there is none."""
    unused = parser()
    names = (
        "steps",
        "solver",
        "schedule",
        "seed",
        "context_slots",
        "long",
        "tolerance",
        "max_cost",
        "generate",
        "compile",
    )
    for name in names:
        value = getattr(args, name)
        if value != unused.get_default(name):
            return f"--{name.replace('_', '-')}" + (f" {value}" if value is not True else "")
    return None


def dry_run(args: argparse.Namespace, settings) -> str:
    """Shapes, tokens, FLOPs and memory as text, after the run's own checks of all but weights and OUT."""
    from . import cost
    from .core import aot, sharding, target
    from .sampling import reconstruction
    from .sampling.windows import chained
    from .video import solvers

    if args.compile:
        aot.by_the_cpu()
        aot.check(target.name())
    config, mesh = model_config(args, weights=False), sampling_mesh(args)
    settings, notes = settings.of(config), []
    only = previews(args, config, settings)
    dtype = large_dtype(args, sum(cost.weight_bytes(config).values()) / 4)
    if mesh is not None:
        if target.fused(dtype) and not only:
            sharding.check_heads(config.dit.heads, mesh)
        held = reconstruction.held_weights if only else cost.held_weights
        kept = held(config, mesh, dtype)
        notes.append(
            f"note: each device holds {cost.scaled(kept, 'B')} of weights; FLOPs and working memory are those of all "
            f"{mesh.size} devices together"
        )
    scene = stand_in(args, config)
    _, photos, path = read_inputs(args, config, settings, scene)
    if scene is not None:
        notes.append("note: for any scene with so many photos; none was read")
    m = len(photos.ids)
    if only:
        text = reconstruction.report(config, m, frames=len(path), half=dtype == "bfloat16")
        return "\n".join([text, *notes])
    if args.tolerance is not None or args.max_cost is not None:
        from .planning.plan import plan as make_plan

        limits = {"tolerance": args.tolerance or 0.0, "max_cost": args.max_cost}
        plan = make_plan({}, config, photos, path, settings=settings, probe=0.0, **limits)
        notes.append(
            f"the above is the full model's cost, the most that a plan can take\n{plan.explain()}"
        )
        notes.append(
            "  note: for an average scene; the run measures this one first, with the weights"
        )
    adaptive = solvers.SOLVERS[settings.solver].method is None
    count = 3 * settings.steps if adaptive else solvers.nfe(settings.solver, settings.steps)
    guess = " (a guess: it chooses its own steps)" if adaptive else ""
    text = cost.report(
        config,
        m,
        count,
        frames=len(path),
        later=sum(chained(m, config)) if settings.long == "chain" else m,
        half=dtype == "bfloat16",
        solver=f"{settings.solver}, {settings.steps} steps: {count} evaluations a window{guess}",
    )
    if args.compile:
        from .sampling.compiled import compiled_window

        data, fsdp, seq = (1, 1, 1) if mesh is None else mesh.shape.values()
        sizes = (data, fsdp, seq)
        said = compiled_window(config, m, name=target.name(), sizes=sizes, dtype=dtype)
        notes.append(aot.report(said, target.name()))
    return "\n".join([text, *notes])


if __name__ == "__main__":
    run(main, parser())
