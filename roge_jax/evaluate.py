"""Compare a model with the truth and with baselines: `python -m roge_jax.evaluate --scenes procedural:1000000000..1000000049 DIR ... --out results.json`.

Per scene, `context` photos are spread over a run of up to frames + context consecutive views and the others are
generated as one video. The model (`generated`, `rgb_head`) stands beside what needs no learning (`nearest`,
`mean_context`, `plane` at the true median depth or, without depth, swept; `plane_sweep`, depth by semi-global matching;
`depth_warp` where depth is complete) and
beside its own ceiling (`vae_round_trip`: the truth encoded and decoded). Means carry bootstrap intervals over scenes.
All is compared at `--size`, whatever the model's own; frames that the model makes smaller are enlarged.
A run that was stopped goes on, given the same words, with the scenes that it has in OUT.part.
With `--close N` N views of every scene are shown instead, each by itself from the `context` photos nearest to it.
A model that is a reconstruction alone (LagerNVS) has its own picture, `rgb_head`, and no `generated`; it is made at `--size`.
"""

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .data.two_sizes import Size, check_output, expand, open_views
from .data.two_sizes import spread as spread
from .errors import UserError
from .files.entry import number, one_of, size_of
from .files.folders import fingerprint_files, output_file, write_json
from .files.parts import Item, load_item, parts, save_item

OWN = ("solver", "steps", "schedule")  # of a generator
SMALLEST = 32  # pixels on a side that LPIPS needs
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
    p.add_argument(
        "--context", type=number(1), default=3, help="how many photos per scene (default: 3)"
    )
    p.add_argument(
        "--close",
        type=number(1),
        metavar="N",
        help="N views of each scene, every one from the --context photos nearest to it",
    )
    p.add_argument(
        "--size",
        type=size_of,
        metavar="HEIGHTxWIDTH",
        help="at which truth, photos and pictures are compared; smaller pictures are enlarged\n(default: that of the pictures that the model makes)",
    )
    p.add_argument(
        "--lpips",
        type=one_of(("alex", "vgg", "both", "none")),
        help="trunk of LPIPS: alex, vgg, both, none (default: alex where its weights are installed)",
    )
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


def neighbours(c2w: np.ndarray, contexts: int, count: int) -> list[tuple[list[int], list[int]]]:
    """(context ids, the target alone) of up to `count` views, evenly over all: the views nearest to each, nearest first.

    c2w [v, 4, 4]; near as `metrics.baselines.view_distances` has it.
    """
    from .metrics.baselines import view_distances

    if len(c2w) <= contexts:
        raise UserError(
            f"{len(c2w)} views cannot give {contexts} contexts and a target: use fewer with --context."
        )
    found = []
    for i in np.linspace(0, len(c2w) - 1, min(count, len(c2w))).round().astype(int).tolist():
        others = [j for j in range(len(c2w)) if j != i]
        order = np.argsort(view_distances(c2w[others], c2w[i]), kind="stable")
        found.append(([others[j] for j in order[:contexts]], [i]))
    return found


class Evaluator:
    """The model's jitted pieces, compiled once for all scenes of a size. Of a reconstruction alone there is one picture."""

    def __init__(
        self, checkpoint: str, solver: str = "", steps: int = 0, seed: int = 0, schedule: str = ""
    ):
        """Solver, steps and schedule are the model's own if not given (`sampling.Settings`)."""
        import functools

        import jax

        from . import model, sampling
        from .checkpoint import find_model, load_config, load_model
        from .sampling.reconstruction import check_makes_pictures
        from .sampling.windows import window_noise
        from .video import flow, solvers, vae

        config = load_config(find_model(checkpoint))
        check_makes_pictures(config, checkpoint)
        self.alone = config.parts == "reconstruction"
        self._prepare: dict[Size, Any] = {}
        self._programs: dict[Any, Any] = {}
        self.params, self.config = load_model(checkpoint)
        self.settings = s = sampling.Settings(steps, solver, schedule).of(config)
        if self.alone:
            return
        grid = flow.schedule(
            s.schedule, s.steps, shift=config.flow.shift, solver=s.solver, model=config.name
        )
        table = solvers.tabulate(s.solver, grid)
        self.generate = jax.jit(functools.partial(model.generate, config=config, solver=table))
        self.decode = jax.jit(functools.partial(model.decode_video, config=config))
        self.encode = jax.jit(functools.partial(vae.encode, cfg=config.vae))
        self.noise = functools.partial(window_noise, seed, 0, config=config)
        self.raise_if_failed = solvers.raise_if_failed

    def prepare(self, size: Size):
        """`model.prepare`, jitted, with the reconstruction's picture also at `size` if the model can make it so large."""
        import functools

        import jax

        from . import model

        if size not in self._prepare:
            config = self.config
            own = (config.height, config.width)
            least = (config.recon_height, config.recon_width)
            larger = size != own and size[0] >= least[0] and size[1] >= least[1]
            config = dataclasses.replace(config, output=size if larger else None)
            self._prepare[size] = jax.jit(functools.partial(model.prepare, config=config)), config
        return self._prepare[size]

    def videos(self, scene: dict[str, Any]) -> dict[str, np.ndarray]:
        """{"generated", "rgb_head", "vae_round_trip"}: [n, h, w, 3] for the targets of one `take`, at the model's size or,
        of models that read colours from the photos, at the output size, from the whole photos.
        """
        if self.alone:
            return {"rgb_head": self.preview(scene)}
        from .data.views import make_sample
        from .geometry.cameras import Cameras
        from .geometry.packing import pad_path
        from .sampling.video import at_output
        from .sampling.whole import whole

        m, n, frames = len(scene["context"]), len(scene["target"]), self.config.frames
        path = pad_path(Cameras(scene["K"][m:], scene["c2w"][m:]), frames)
        K, c2w = (
            np.concatenate([scene["K"][:m], path.K]),
            np.concatenate([scene["c2w"][:m], path.c2w]),
        )
        rgb = np.concatenate([scene["rgb"], np.repeat(scene["rgb"][-1:], frames - n, 0)])
        views: dict[str, Any] = make_sample(rgb, K, c2w, m, scale_rule=self.config.scale_rule)
        truth = views.pop("target_rgb")
        prepare, config = self.prepare(scene["output"]["rgb"].shape[1:3])
        if config.output_size != (config.height, config.width):
            model_size = (config.height, config.width)
            views["full"] = whole(scene["photos"], config.output_size, model_size).arrays()
        prepared = prepare(self.params, views)
        latents, info = self.generate(self.params, prepared, self.noise(m))
        self.raise_if_failed(info)
        video = np.asarray(self.decode(self.params, latents, detail=prepared.detail))[:n]
        shown = np.asarray(prepared.shown)[:n]
        full = None if prepared.full is None else np.asarray(prepared.full)[:n]
        encoded = self.encode(self.params["vae"], 2.0 * truth - 1.0)
        return {
            "generated": video if full is None else at_output(video, shown, full, config),
            "rgb_head": shown if full is None else full,
            "vae_round_trip": np.asarray(self.decode(self.params, encoded))[:n],
        }

    def preview(self, scene: dict[str, Any]) -> np.ndarray:
        """What a reconstruction alone makes of one `take` [n, h, w, 3], as `sample` does."""
        from .geometry.cameras import Cameras
        from .sampling import Photos, preview
        from .sampling.whole import whole

        m, config = len(scene["context"]), self.config
        size, full = (config.height, config.width), None
        if config.output_size != size:
            full = whole(scene["photos"], config.output_size, size)
        K, c2w = scene["K"], scene["c2w"]
        photos = Photos(scene["rgb"][:m], None, Cameras(K[:m], c2w[:m]), tuple(range(m)), full)
        path = Cameras(K[m:], c2w[m:])
        return preview(self.params, config, photos, path, cache=self._programs).frames


def samples(
    args: argparse.Namespace, name: str, frames: int, size: Size, output: Size
) -> Iterator[dict[str, Any]]:
    """What is to be shown of one scene, as `take` of `open_views` gives it: one run, or with `close` many single views."""
    c2w, take = open_views(name, frames + args.context, size, args.sweep, args.convention, output)
    if args.close is None:
        yield take(*spread(len(c2w), args.context, frames))
    else:
        for context, target in neighbours(c2w, args.context, args.close):
            yield take(context, target)


def check_scenes(args: argparse.Namespace, names: list[str]) -> None:
    """All that can be said of the scenes before hours are spent on others; procedural ones are right by construction."""
    import warnings

    from .scenes.scene import load_scene, procedural_seed

    for name in names:
        if name.startswith("procedural:"):
            procedural_seed(name)
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # said when its turn comes
            views = len(load_scene(name, convention=args.convention))
        if views <= args.context:
            raise UserError(
                f"{name}: {views} views cannot give --context {args.context} and a target: use at most {views - 1}."
                if views > 1
                else f"{name}: has one view, which leaves none to compare with: give a scene of two or more."
            )


def methods_of(evaluator: Evaluator, scene: dict[str, Any]) -> dict[str, np.ndarray]:
    """{method: [n, h, w, 3]} of the targets of one `take` at its output size: the model's frames, enlarged where they come
    smaller, and what needs no learning.
    """
    from .geometry.crops import resize
    from .metrics.baselines import baselines
    from .metrics.plane_sweep import sweep_view

    m, c2w, judged = len(scene["context"]), scene["c2w"], scene["output"]
    rgb, K = judged["rgb"], judged["K"]
    size = rgb.shape[1:3]
    simple, _ = baselines(rgb[:m], K[:m], c2w[:m], K[m:], c2w[m:], size, judged["depth"])
    if m > 1:
        swept = (
            sweep_view(rgb[:m], K[:m], c2w[:m], *view, size).rgb for view in zip(K[m:], c2w[m:])
        )
        simple["plane_sweep"] = np.stack(list(swept))
    made = evaluator.videos(scene)
    return {
        name: np.stack([resize(np.clip(frame, 0.0, 1.0), *size) for frame in frames])
        for name, frames in made.items()
    } | simple


def seen_in(scene: dict[str, Any]) -> np.ndarray | None:
    """`metrics.seen.seen_by` of the targets of one `take`, [n, h, w]; None without true depth everywhere."""
    from .metrics.seen import seen_by

    judged, m, c2w = scene["output"], len(scene["context"]), scene["c2w"]
    if judged["depth"] is None or judged["photo_depth"] is None:
        return None
    photos = (judged["photo_depth"], judged["K"][:m], c2w[:m])
    targets = zip(judged["depth"], judged["K"][m:], c2w[m:])
    return np.stack([seen_by(depth, K, pose, *photos) for depth, K, pose in targets])


def evaluate_scene(
    evaluator: Evaluator,
    views: list[dict[str, Any]],
    learned: dict[str, Any],
    close: bool,
) -> Item:
    """The numbers of one scene, and of its middle view the pictures and their names: photos, truth, methods."""
    from .metrics.scores import scores
    from .metrics.seen import pixel_split

    row: dict[str, Any] = {}
    for key in ("context", "target"):
        row[key] = [part[key] for part in views] if close else views[0][key]
    found: dict[str, list[dict[str, float]]] = {}
    counted = []
    for index, part in enumerate(views):
        photos, truth = np.split(part["output"]["rgb"], [len(part["context"])])
        made, counts = methods_of(evaluator, part), seen_in(part)
        order = {} if close else {"places": part["target"], "photos": part["context"]}
        for method, frames in made.items():
            numbers = scores(frames, truth, learned, counts=counts, **order)
            found.setdefault(method, []).append(numbers)
        if counts is not None:
            counted.append(counts)
        if index == len(views) // 2:
            middle = len(truth) // 2
            pictures = [*photos, truth[middle], *(x[middle] for x in made.values())]
            labels = [*(f"photo {i}" for i in range(len(photos))), "truth", *made]
    if counted:
        row["pixels"] = pixel_split(np.concatenate(counted))
    for method, many in found.items():
        row[method] = {k: float(np.mean([one[k] for one in many])) for k in many[0]}
    return Item(row, pictures, labels)


def learned_metrics(choice: str | None) -> dict[str, Any]:
    """LPIPS by `--lpips`; if nothing was asked for, that of AlexNet or, without its weights, none and a note."""
    from .metrics.learned import lpips_metrics

    if choice == "none":
        return {}
    try:
        return lpips_metrics(("alex", "vgg") if choice == "both" else (choice or "alex",))
    except UserError as error:
        if choice is not None:
            raise
        print(f"note: no LPIPS column. {error}")
        return {}


def check_alone(args: argparse.Namespace) -> None:
    """Raise UserError for options of a generator, which a reconstruction alone has not."""
    for name in OWN:
        if (value := getattr(args, name)) is not None:
            raise UserError(
                f"--{name} {value} is for the generator, and {args.checkpoint} is a reconstruction alone: leave it away."
            )


def main(args: argparse.Namespace) -> dict[str, Any]:
    """Evaluate all scenes, write OUT and return the document (`metrics.report.build`)."""
    from tqdm import tqdm

    from .checkpoint import find_model, load_config
    from .metrics import report
    from .metrics.scores import SETTINGS

    output_file(args.out, "--out")
    if args.sheet:
        output_file(args.sheet, "--sheet", ".png")
    names = expand(args.scenes)
    twice = {name for name in names if names.count(name) > 1} if len(names) < 10000 else set()
    if twice:
        raise UserError(f"--scenes names '{min(twice)}' twice: give every scene once.")
    if args.sweep and not args.sweep[0] <= args.sweep[1]:
        raise UserError(f"--sweep {args.sweep[0]:g} {args.sweep[1]:g}: give LOW, then HIGH.")
    check_scenes(args, names)
    if load_config(find_model(args.checkpoint)).parts == "reconstruction":
        check_alone(args)
    learned = learned_metrics(args.lpips)
    evaluator = Evaluator(
        args.checkpoint, args.solver or "", args.steps or 0, args.seed, args.schedule or ""
    )
    if evaluator.alone:
        evaluator.config = evaluator.config.for_pictures(
            *(args.size or evaluator.config.output_size)
        )
    config = evaluator.config
    size = (config.height, config.width)
    output = args.size or config.output_size
    if args.size or learned:
        check_output(output, size, SMALLEST)
    if args.context > config.max_context:
        raise UserError(
            f"--context {args.context}: this model ({config.name}) takes 1 to {config.max_context} photos."
        )
    settings = {
        "checkpoint": str(args.checkpoint),
        "weights": fingerprint_files(find_model(args.checkpoint), "config.json", "*.safetensors"),
        "model": config.name,
        "size": list(output),
        "model_size": list(size),
        "context": args.context,
        "close": args.close,
        "frames": config.frames,
        **({} if evaluator.alone else {name: getattr(evaluator.settings, name) for name in OWN}),
        "seed": args.seed,
        "sweep": args.sweep,
        "convention": args.convention,
        "lpips": list(learned),
    }
    items = []
    with parts(args.out, settings) as folder:
        for name in tqdm(names, desc="evaluate", dynamic_ncols=True):
            item = load_item(folder, name, pictures=bool(args.sheet))
            if item is None:
                views = list(samples(args, name, config.frames, size, output))
                item = evaluate_scene(evaluator, views, learned, args.close is not None)
                save_item(folder, name, item, pictures=bool(args.sheet))
            items.append(item)
        results = [
            {"scene": Path(name).name or name} | item.row for name, item in zip(names, items)
        ]
        document = report.build(
            settings | {"metrics": SETTINGS}, results, models=("generated", "rgb_head")
        )
        write_json(args.out, document)
    print(report.table(document))
    print(f"wrote {args.out}")
    if args.sheet:
        from PIL import Image

        sheet = report.contact_sheet(
            [item.pictures for item in items[:12]],
            items[0].labels,
            row_labels=[r["scene"] for r in results[:12]],
        )
        few = Image.fromarray(sheet).quantize(255, kmeans=2, dither=Image.Dither.NONE)  # a third
        few.save(args.sheet, optimize=True)
        print(f"wrote {args.sheet}")
    return document


if __name__ == "__main__":
    from .files.entry import run

    run(main, parser())
