"""Poses found by `python -m roge_jax.pose` against held-back ones, and the way from 20 photos to the first video.

    OPENBLAS_NUM_THREADS=1 python -m experiments.quality.pose SCENES
    OPENBLAS_NUM_THREADS=1 python -m experiments.quality.pose SCENES --only fox banana
    python -m experiments.quality.pose --draw                  the page's table from the stored numbers

SCENES is a folder of posed scenes (each a folder that `load_scene` reads). Of each only the photos' files are given to the
program. Found cameras are laid over the true ones by the similarity that fits their centres best; turns are in degrees,
shifts are parts of the largest distance between two true cameras. `--first-video SCENE` times both commands from 20 photos
of one scene to a video. Seconds are those of the clock and of the processor: on a shared machine only the latter say much.
"""

import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from experiments import harness
from roge_jax.metrics.geometry import rotation_angle, umeyama
from roge_jax.scenes.images import Photos
from roge_jax.scenes.scene import Scene, load_scene

RESULT, PAGE = "pose.json", harness.DOCS / "howto" / "pose.md"
PHOTOS = 20  # of the way to the first video
DIGITS = 4


def call(*words: str) -> dict[str, Any]:
    """A program of the package: its exit code, last words, seconds of the clock and of the processor."""
    wall, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", *words],
        cwd=harness.ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    said = [line for line in done.stderr.splitlines() if line.startswith(("error", "warning"))]
    seconds = {"wall": time.perf_counter() - wall, "cpu": cpu}
    return {"code": done.returncode, "said": said, "seconds": seconds}


def copy_photos(scene: Scene, place: Path, count: int | None) -> list[int]:
    """The files of `count` evenly spread photos (all if None) without their poses; which these are."""
    assert isinstance(scene.images, Photos)
    total = len(scene)
    ids = range(total) if count is None else np.linspace(0, total - 1, count).round().astype(int)
    place.mkdir()
    for i in ids:
        shutil.copy(scene.images.photos[i].file, place)
    return [int(i) for i in ids]


def errors(found: Scene, truth: Scene) -> dict[str, Any]:
    """Turns and shifts of the found cameras, medians and worst, and their focal length over the true one."""
    ids = [truth.names.index(name) for name in found.names]
    true = truth.cameras[np.array(ids)]
    fit = umeyama(found.cameras.centres, true.centres).poses(found.cameras.c2w)
    turned = rotation_angle(fit[:, :3, :3], true.c2w[:, :3, :3])
    every = truth.cameras.centres
    extent = np.linalg.norm(every[:, None] - every[None], axis=-1).max()
    moved = np.linalg.norm(fit[:, :3, 3] - true.centres, axis=-1) / extent
    focal = np.median(found.cameras.K[:, 0, 0] / true.K[:, 0, 0])
    return {
        "rotation_degrees": {"median": np.median(turned), "worst": turned.max()},
        "translation": {"median": np.median(moved), "worst": moved.max()},
        "focal_ratio": focal,
    }


def measure(folder: Path, name: str, more: list[str], count: int | None = None) -> dict[str, Any]:
    """One scene."""
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        truth = load_scene(folder / name)
        ids = copy_photos(truth, Path(place) / "photos", count)
        out = Path(place) / "scene"
        row = call("roge_jax.pose", f"{place}/photos", "--out", str(out), *more)
        row["said"] = [line.replace(place, "") for line in row["said"]]
        row |= {"scene": name, "photos": len(ids), "options": more, "registered": 0}
        if row["code"] == 0:
            record = json.loads((out / "pose.json").read_text())
            names = ("registered", "points", "reprojection_error", "track_length", "mapper", "way")
            row |= {key: record[key] for key in names}
            row |= errors(load_scene(out), truth)
    print(json.dumps(harness.rounded(row, DIGITS)), flush=True)
    return row


def first_video(folder: Path, name: str) -> dict[str, Any]:
    """From PHOTOS photos to a video, with every program's seconds and the number of commands."""
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        copy_photos(load_scene(folder / name), Path(place) / "photos", PHOTOS)
        scene, out = f"{place}/scene", f"{place}/video"
        steps = {
            "pose": call("roge_jax.pose", f"{place}/photos", "--out", scene),
            "sample": call("roge_jax.sample", "--scene", scene, "--out", out),
        }
        made = (Path(out) / "video.mp4").is_file()
    wall = sum(step["seconds"]["wall"] for step in steps.values())
    cpu = sum(step["seconds"]["cpu"] for step in steps.values())
    row = {"scene": name, "photos": PHOTOS, "commands": len(steps), "video": made}
    row |= {"minutes": {"wall": wall / 60, "cpu": cpu / 60}, "steps": steps}
    for step in steps.values():
        step["said"] = [line.replace(place, "") for line in step["said"]]
    print(json.dumps(harness.rounded(row, DIGITS)), flush=True)
    return row


def table(found: dict[str, Any]) -> str:
    """The page's table."""
    columns = [
        "scene", "photos", "registered", "turn, median (worst)", "shift, median (worst)",
        "focal length", "reprojection", "mapper",
    ]  # fmt: skip
    rows = []
    for row in found["scenes"].values():
        words = [row["scene"], row["photos"], row["registered"]]
        if row["registered"]:
            turn, shift = row["rotation_degrees"], row["translation"]
            words += [
                f"{turn['median']:.2f}° ({turn['worst']:.2f}°)",
                f"{shift['median']:.2%} ({shift['worst']:.2%})",
                f"{row['focal_ratio'] - 1:+.1%}",
                f"{row['reprojection_error']:.2f} px",
                row["mapper"],
            ]
        rows.append([*words, *[""] * (len(columns) - len(words))])
    return "\n".join(harness.table(columns, rows))


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("scenes", type=Path, nargs="?", help="folder of posed scenes")
    p.add_argument("--only", nargs="+", help="names of scenes")
    p.add_argument("--options", default="", help="more options of the program, one text")
    p.add_argument("--first-video", metavar="SCENE", help="time the way to a video from its photos")
    p.add_argument("--draw", action="store_true", help="the table from the stored numbers")
    args = p.parse_args()
    found = harness.read(RESULT, absent={"scenes": {}, "first_video": {}})
    if not args.draw:
        if args.scenes is None:
            p.error("give the folder of the scenes, or --draw")
        found["environment"] = environment()
        if args.first_video:
            found["first_video"] = first_video(args.scenes, args.first_video)
        else:
            every = sorted(f.name for f in args.scenes.iterdir() if f.is_dir())
            for name in args.only or every:
                row = measure(args.scenes, name, args.options.split())
                key = f"{name} {args.options}".strip()
                found["scenes"][key] = row
                harness.write(RESULT, harness.rounded(found, DIGITS))
        harness.write(RESULT, harness.rounded(found, DIGITS))
    harness.put(PAGE, "pose", table(found))


def environment() -> dict[str, Any]:
    """The record of the run, without the folder of the scenes."""
    found = harness.environment()
    found["command"] = ["python", "-m", "experiments.quality.pose", "SCENES"]
    return found


if __name__ == "__main__":
    main()
