"""Evaluate: `python -m roge_jax.evaluate --scenes procedural:1000000000..1000000049 DIR ... --out results.json`.

Per scene, `context` photos are spread over a run of up to frames + context consecutive views and the others are
generated as one video. The model (`generated`, `rgb_head`) stands beside what needs no learning (`nearest`,
`mean_context`, `plane` at the true median depth or, without depth, swept; `depth_warp` where depth is complete) and
beside its own ceiling (`vae_round_trip`: the truth encoded and decoded). Means carry bootstrap intervals over scenes.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from .entry import number, one_of
from .errors import UserError
from .folders import output_file, write_json

HELD_OUT = "procedural:1000000000..1000000049"


def parser() -> argparse.ArgumentParser:
    """The options of `python -m roge_jax.evaluate`."""
    from .geometry.cameras import CONVENTIONS

    p = argparse.ArgumentParser(
        prog="python -m roge_jax.evaluate",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    p.add_argument("--checkpoint", default="mini", help="model folder or name (default: mini)")
    p.add_argument(
        "--scenes",
        nargs="+",
        default=[HELD_OUT],
        help=f"scene folders, 'motorcycle', procedural:SEED or procedural:FIRST..LAST\n(default: {HELD_OUT})",
    )
    p.add_argument("--context", type=number(1), default=3, help="photos per scene (default: 3)")
    p.add_argument("--steps", type=number(1), help="sampling steps (default: the model's own)")
    p.add_argument("--solver", help="sampler (default: the model's own)")
    p.add_argument("--schedule", help="noise levels of the steps (default: the model's own)")
    p.add_argument(
        "--convention",
        type=one_of(CONVENTIONS),
        help=f"axes of the poses of a transforms.json that are not OpenGL: {', '.join(CONVENTIONS)}",
    )
    p.add_argument("--seed", type=number(0), default=0, help="seed of the noise")
    p.add_argument(
        "--sweep",
        type=number(-720, 720, whole=False),
        nargs=2,
        help="degrees that procedural paths turn, LOW HIGH",
    )
    p.add_argument(
        "--out",
        type=Path,
        default=Path("results.json"),
        help="results file (default: results.json)",
    )
    p.add_argument("--sheet", type=Path, help="also write a contact sheet of the scenes (PNG)")
    p.add_argument("--debug", action="store_true", help="show tracebacks")
    return p


def expand(specs: list[str]) -> list[str]:
    """Scene names with procedural:FIRST..LAST written out."""
    names = []
    for spec in specs:
        if spec.startswith("procedural:") and ".." in spec:
            first, _, last = spec.removeprefix("procedural:").partition("..")
            decimal = first.isdecimal() and last.isdecimal()
            if not decimal or not int(first) <= int(last) < 2**31:
                raise UserError(
                    f"'{spec}' is no range of seeds: write procedural:FIRST..LAST, below 2^31."
                )
            names += [f"procedural:{seed}" for seed in range(int(first), int(last) + 1)]
        else:
            names.append(spec)
    return names


def spread(views: int, contexts: int, frames: int) -> tuple[list[int], list[int]]:
    """(context ids, target ids) of a scene: a centred run of views, contexts in the middle of equal parts of it."""
    run = min(views, frames + contexts)
    if run <= contexts:
        raise UserError(
            f"{views} views cannot give {contexts} contexts and a target: use fewer with --context."
        )
    start = (views - run) // 2
    context = [start + int((i + 0.5) * run / contexts) for i in range(contexts)]
    return context, [i for i in range(start, start + run) if i not in context]


def read(
    name: str,
    contexts: int,
    frames: int,
    size: tuple[int, int],
    sweep,
    convention: str | None = None,
) -> dict[str, Any]:
    """One scene at generation size: rgb [v, h, w, 3], K, c2w (float64), contexts first, and depth or None."""
    from .data import scene as scenes

    if name.startswith("procedural:"):
        from .data.procedural import SWEEP, sample_sequence

        made = sample_sequence(
            scenes.procedural_seed(name),
            frames=frames + contexts,
            height=size[0],
            width=size[1],
            sweep=SWEEP if sweep is None else tuple(sweep),
        )
        context, target = spread(frames + contexts, contexts, frames)
        order = context + target
        return {
            "rgb": made["rgb"][order].astype(np.float32) / 255.0,
            "K": made["K"][order],
            "c2w": made["c2w"][order],
            "depth": made["depth"][target],
            "context": context,
            "target": target,
        }
    scene = scenes.load_scene(name, convention=convention)
    context, target = spread(len(scene), contexts, frames)
    images, cameras = scenes.prepare(scene, context + target, *size, drop_duplicates=False)
    return {
        "rgb": images,
        "K": np.asarray(cameras.K),
        "c2w": np.asarray(cameras.c2w),
        "depth": None,
        "context": context,
        "target": target,
    }


class Evaluator:
    """The model's jitted pieces, compiled once for all scenes of a size."""

    def __init__(
        self, checkpoint: str, solver: str = "", steps: int = 0, seed: int = 0, schedule: str = ""
    ):
        """Solver, steps and schedule are the model's own if not given (`sampling.Settings`)."""
        import functools

        import jax

        from . import model, sampling
        from .checkpoint import load_model
        from .video import flow, solvers, vae

        self.params, self.config = load_model(checkpoint)
        config = self.config
        self.settings = s = sampling.Settings(steps, solver, schedule).of(config)
        grid = flow.schedule(
            s.schedule, s.steps, shift=config.flow.shift, solver=s.solver, model=config.name
        )
        table = solvers.tabulate(s.solver, grid)
        self.prepare = jax.jit(functools.partial(model.prepare, config=config))
        self.generate = jax.jit(functools.partial(model.generate, config=config, solver=table))
        self.decode = jax.jit(functools.partial(model.decode_video, config=config))
        self.encode = jax.jit(functools.partial(vae.encode, cfg=config.vae))
        self.noise = functools.partial(sampling.window_noise, seed, 0, config=config)
        self.raise_if_failed = solvers.raise_if_failed

    def videos(self, scene: dict[str, Any]) -> dict[str, np.ndarray]:
        """{"generated", "rgb_head", "vae_round_trip"}: [n, h, w, 3] for the scene's targets."""
        from .data.views import make_sample
        from .geometry.cameras import Cameras
        from .geometry.crops import resize
        from .geometry.packing import pad_path

        m, n, frames = len(scene["context"]), len(scene["target"]), self.config.frames
        path = pad_path(Cameras(scene["K"][m:], scene["c2w"][m:]), frames)
        K, c2w = (
            np.concatenate([scene["K"][:m], path.K]),
            np.concatenate([scene["c2w"][:m], path.c2w]),
        )
        rgb = np.concatenate([scene["rgb"], np.repeat(scene["rgb"][-1:], frames - n, 0)])
        views = make_sample(rgb, K, c2w, m, scale_rule=self.config.scale_rule)
        truth = views.pop("target_rgb")
        prepared = self.prepare(self.params, views)
        latents, info = self.generate(self.params, prepared, self.noise(m))
        self.raise_if_failed(info)
        h, w = truth.shape[1:3]
        head = np.asarray(prepared.shown)
        return {
            "generated": np.asarray(self.decode(self.params, latents, detail=prepared.detail))[:n],
            "rgb_head": np.stack([resize(image, h, w) for image in head[:n]]),
            "vae_round_trip": np.asarray(
                self.decode(self.params, self.encode(self.params["vae"], 2.0 * truth - 1.0))
            )[:n],
        }


def main(args: argparse.Namespace) -> dict[str, Any]:
    """Evaluate all scenes, write OUT and return the document (`metrics.report.build`)."""
    from tqdm import tqdm

    from .metrics import image, report
    from .metrics.baselines import baselines

    output_file(args.out, "--out")
    if args.sheet:
        output_file(args.sheet, "--sheet", ".png")
    names = expand(args.scenes)
    twice = {name for name in names if names.count(name) > 1} if len(names) < 10000 else set()
    if twice:
        raise UserError(f"--scenes names '{min(twice)}' twice: give every scene once.")
    if args.sweep and not args.sweep[0] <= args.sweep[1]:
        raise UserError(f"--sweep {args.sweep[0]:g} {args.sweep[1]:g}: give LOW, then HIGH.")
    evaluator = Evaluator(
        args.checkpoint, args.solver or "", args.steps or 0, args.seed, args.schedule or ""
    )
    config = evaluator.config
    size = (config.height, config.width)
    results, rows, methods = [], [], []
    if args.context > config.max_context:
        raise UserError(
            f"--context {args.context}: this model ({config.name}) takes 1 to {config.max_context} photos."
        )
    for name in tqdm(names, desc="evaluate", dynamic_ncols=True):
        scene = read(name, args.context, config.frames, size, args.sweep, args.convention)
        m = len(scene["context"])
        truth = scene["rgb"][m:]
        videos = evaluator.videos(scene)
        simple, _ = baselines(
            scene["rgb"][:m],
            scene["K"][:m],
            scene["c2w"][:m],
            scene["K"][m:],
            scene["c2w"][m:],
            size,
            scene["depth"],
        )
        row = {
            "scene": Path(name).name or name,
            "context": scene["context"],
            "target": scene["target"],
        }
        for method, frames in (videos | simple).items():
            row[method] = image.image_metrics(np.clip(frames, 0.0, 1.0), truth)
        results.append(row)
        middle = len(truth) // 2
        shown = videos | simple
        methods += [method for method in shown if method not in methods]
        rows.append([*scene["rgb"][:m], truth[middle], *(shown[k][middle] for k in shown)])
    settings = {
        "checkpoint": str(args.checkpoint),
        "model": config.name,
        "size": list(size),
        "context": args.context,
        "frames": config.frames,
        "solver": evaluator.settings.solver,
        "steps": evaluator.settings.steps,
        "schedule": evaluator.settings.schedule,
        "seed": args.seed,
        "sweep": args.sweep,
        "metrics": image.SETTINGS,
    }
    document = report.build(settings, results, models=("generated", "rgb_head"))
    write_json(args.out, document)
    print(report.table(document))
    print(f"wrote {args.out}")
    if args.sheet:
        from PIL import Image

        labels = [*(f"photo {i}" for i in range(args.context)), "truth", *methods]
        sheet = report.contact_sheet(
            rows[:12], labels, row_labels=[r["scene"] for r in results[:12]]
        )
        few = Image.fromarray(sheet).quantize(255, kmeans=2, dither=Image.Dither.NONE)  # a third
        few.save(args.sheet, optimize=True)
        print(f"wrote {args.sheet}")
    return document


if __name__ == "__main__":
    from .entry import run

    run(main, parser())
