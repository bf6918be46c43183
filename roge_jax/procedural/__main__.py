"""Rendered scenes from the command line.

python -m roge_jax.procedural dataset --out DIR --scenes 2000 --processes 4
python -m roge_jax.procedural sheet --out docs/media/procedural.png
python -m roge_jax.procedural bench
"""

import argparse
import json
import os
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..data.dataset import write_dataset
from ..files.entry import execute, number
from ..files.folders import output_file


def _sheet(
    out: Path, seeds: Sequence[int], *, views: int, height: int, width: int, **cameras: Any
) -> None:
    """A contact sheet: one row of views per scene."""
    from PIL import Image

    from .scenes import sample_sequence

    output_file(out, "--out", ".png")
    rows = []
    for seed in seeds:
        scene = sample_sequence(
            seed, frames=views, height=height, width=width, supersample=3, **cameras
        )
        rows.append(np.concatenate(list(scene["rgb"]), 1))
    half = (len(rows) + 1) // 2  # two scenes beside each other
    rows += [np.zeros_like(rows[0])] * (2 * half - len(rows))
    sheet = np.concatenate([np.concatenate(rows[:half]), np.concatenate(rows[half:])], 1)
    out.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(sheet).quantize(255, kmeans=2, dither=Image.Dither.NONE)
    image.save(out, optimize=True)
    print(f"{out}: {sheet.shape[1]} x {sheet.shape[0]}, {out.stat().st_size} bytes")


def _bench(height: int, width: int, frames: int, supersample: int) -> dict:
    """Frames per second of this process, compilation excluded."""
    import jax

    from .scenes import sample_sequence

    options: dict[str, Any] = {"frames": frames, "height": height, "width": width}
    options |= {"supersample": supersample, "depth": False}
    began = time.perf_counter()
    sample_sequence(0, **options)
    compiled, cpu = time.perf_counter(), time.process_time()
    count = 0
    while time.perf_counter() - compiled < 5:
        count += 1
        sample_sequence(count, **options)
    seconds = time.perf_counter() - compiled
    return {
        **{k: options[k] for k in ("height", "width", "supersample")},
        "device": jax.devices()[0].device_kind,
        "first_call_seconds": round(compiled - began, 2),
        "frames_per_second": round(count * frames / seconds, 1),
        "frames_per_cpu_second": round(count * frames / (time.process_time() - cpu), 1),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m roge_jax.procedural {dataset,sheet,bench}`."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["pool"]:
        warnings.warn("`procedural pool` is `procedural dataset` now.", FutureWarning, stacklevel=2)
        words[0] = "dataset"
    parser = argparse.ArgumentParser(prog="python -m roge_jax.procedural")
    commands = parser.add_subparsers(dest="command", required=True)
    seeds = "seed of the first scene; from 1000000000 on they are held out"
    dataset = commands.add_parser("dataset", help="render many sequences into a folder")
    dataset.add_argument("--out", type=Path, required=True, help="folder to write")
    dataset.add_argument("--scenes", type=number(1, 10**7), default=2000, help="how many")
    dataset.add_argument("--first-seed", type=number(), default=0, help=seeds)
    cores = os.cpu_count() or 1
    at_once = "how many render at a time (default: all cores)"
    dataset.add_argument("--processes", type=number(1), default=cores, help=at_once)
    dataset.add_argument(
        "--scenes-per-shard", type=number(1), default=100, help="scenes in one file"
    )
    dataset.add_argument(
        "--textures",
        type=Path,
        help="a folder of pictures to cut textures from, beside the built-in ones; a tenth of their kinds (names up to the "
        "last _) is held out",
    )
    dataset.add_argument("--depth", action="store_true", help="also write float16 z-depth")
    dataset.add_argument(
        "--varied",
        action=argparse.BooleanOptionalAction,
        help="many orbits and lenses (default: for training seeds, not for held-out ones)",
    )
    sheet = commands.add_parser("sheet", help="draw a contact sheet")
    sheet.add_argument("--out", type=Path, required=True, help="picture to write (PNG)")
    sheet.add_argument("--scenes", type=number(1, 10**7), default=8, help="how many")
    sheet.add_argument("--first-seed", type=number(), default=0, help=seeds)
    sheet.add_argument("--varied", action="store_true", help="as in training: many orbits, lenses")
    for command in (dataset, sheet):
        command.add_argument(
            "--handheld", action="store_true", help="photos from all around, from above, and rolled"
        )
    bench = commands.add_parser("bench", help="measure frames per second; prints JSON")
    for command, frames in ((dataset, 24), (sheet, 4), (bench, 24)):
        command.add_argument("--frames", type=number(1), default=frames, help="views of a scene")
        command.add_argument("--height", type=number(1), default=64, help="of the views")
        command.add_argument("--width", type=number(1), default=112, help="of the views")
    for command in (dataset, bench):
        rays = "rays per pixel and side"
        command.add_argument("--supersample", type=number(1), default=2, help=rays)
    for command in (dataset, sheet, bench):
        command.add_argument("--debug", action="store_true", help="show tracebacks")
    return execute(_run, parser, words)


def _run(args: argparse.Namespace) -> None:
    from .scenes import HELDOUT_SEED

    if args.command == "dataset":
        training = args.first_seed < HELDOUT_SEED
        write_dataset(
            args.out,
            range(args.first_seed, args.first_seed + args.scenes),
            args.frames,
            args.height,
            args.width,
            args.processes,
            supersample=args.supersample,
            scenes_per_shard=args.scenes_per_shard,
            depth=args.depth,
            varied=training if args.varied is None else args.varied,
            handheld=args.handheld,
            textures=args.textures,
        )
    elif args.command == "sheet":
        seeds = range(args.first_seed, args.first_seed + args.scenes)
        options = {name: getattr(args, name) for name in ("height", "width", "varied", "handheld")}
        _sheet(args.out, seeds, views=args.frames, **options)
    else:
        print(json.dumps(_bench(args.height, args.width, args.frames, args.supersample)))


if __name__ == "__main__":
    raise SystemExit(main())
