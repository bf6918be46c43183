"""Your own posed sequences as training data: scene folders into the dataset that `train --data` reads.

    python -m roge_jax.data.pack SCENE .. --out runs/mine --frames 24 --height 64 --width 112

A scene (any layout of `scenes.readers`) is cut into runs of consecutive views, in the reader's order or that of their names,
whichever walk is shorter: a video's frames or photos taken while walking. Runs of scenes that have more views than one run overlap by half. Every photo fills the
picture and is cropped at the centre, K moves along; poses stay in the scene's own frame and unit, since training
normalises every sample by itself. Each scene is one shard, written under temporary names; its .npz comes last.
"""

import argparse
import json
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.entry import execute, number
from roge_jax.files.folders import put
from roge_jax.scenes.scene import Scene, load_scene, prepare

SHORTER = 0.8  # a walk by names this much shorter than the file's is the one that was walked


def runs(views: int, frames: int) -> list[int]:
    """First views of the runs of `frames` views: half a run apart, the last one ending at the last view."""
    return sorted({*range(0, views - frames, max(1, frames // 2)), views - frames})


def walk_order(scene: Scene) -> list[int]:
    """The views in the order in which the camera walked: the reader's, or that of the names where its way is shorter.

    COLMAP and nerfstudio write photos in the order in which they were registered; the names are those of the walk.
    """
    given = list(range(len(scene)))
    named = sorted(given, key=lambda i: _natural(scene.names[i]))

    def way(order: list[int]) -> float:
        steps = np.diff(scene.cameras.centres[order], axis=0)
        return float(np.linalg.norm(steps, axis=-1).sum())

    return named if way(named) < SHORTER * way(given) else given


def _natural(name: str) -> list[tuple[int, int, str]]:
    """A name with its numbers as numbers, for sorting."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(p), "") if p.isascii() and p.isdecimal() else (1, 0, p) for p in parts]


def pack_scene(scene: Scene, stem: Path, *, frames: int, height: int, width: int) -> int:
    """Write the runs of one scene as the shard `stem`; how many there are.

    Raises: UserError if the scene has fewer than `frames` views.
    """
    if len(scene) < frames:
        raise UserError(
            f"{scene.source}: has {len(scene)} views, a sequence needs {frames}: add views, or give --frames "
            f"{len(scene)} (at least the model's chunk, which is 17 for mini)."
        )
    starts, order = runs(len(scene), frames), walk_order(scene)
    if order != list(range(len(scene))):
        print(f"note: {scene.source}: views are taken in the order of their names, not of the file")
    part = stem.with_suffix(".rgb.npy.part")
    rgb = np.lib.format.open_memmap(part, "w+", np.uint8, (len(starts), frames, height, width, 3))
    K = np.zeros((len(starts), frames, 3, 3))
    for row, start in enumerate(starts):
        ids = order[start : start + frames]
        images, cameras = prepare(scene, ids, height, width, drop_duplicates=False)
        rgb[row], K[row] = np.round(images * 255.0), cameras.K
    rgb.flush()
    put(part, part.with_suffix(""))
    c2w = np.stack([scene.cameras.c2w[order[start : start + frames]] for start in starts])
    part = stem.with_suffix(".npz.part")
    with part.open("wb") as file:
        np.savez(file, seeds=np.arange(len(starts)), K=K, c2w=c2w)
    put(part, part.with_suffix(""))
    return len(starts)


def pack(
    scenes: Sequence[str | Path],
    out: str | Path,
    *,
    frames: int = 24,
    height: int = 64,
    width: int = 112,
    convention: str | None = None,
) -> int:
    """Write scenes (as `load_scene` takes them) into the new dataset `out`; the number of sequences.

    `dataset.read_dataset` reads it: sequences of `frames` views, `rgb` uint8 [f, height, width, 3], `K` and `c2w` float64.
    `convention`: axes of the poses of a transforms.json that are not OpenGL.
    Raises: UserError naming the scene and what it lacks, or if `out` holds something already.
    """
    out = Path(out)
    if min(frames, height, width) < 1:
        raise UserError(f"{frames} frames of {height}x{width} are nothing: give numbers above 0.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} is not empty: give a new folder.")
    part = out.with_name(out.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        total = _pack_into(part, scenes, frames, height, width, convention)
    except BaseException:  # one scene that cannot be read: nothing half-written stays
        shutil.rmtree(part, ignore_errors=True)
        raise
    put(part, out)
    return total


def _pack_into(
    out: Path,
    scenes: Sequence[str | Path],
    frames: int,
    height: int,
    width: int,
    convention: str | None,
) -> int:
    size = {"frames": frames, "height": height, "width": width}
    found, total = [], 0
    for index, spec in enumerate(scenes):
        scene = load_scene(spec, convention=convention)
        count = pack_scene(scene, out / f"shard_{index:05d}", **size)
        total += count
        found.append({"scene": str(spec), "views": len(scene), "sequences": count})
        print(f"{spec}: {len(scene)} views, {count} sequences", flush=True)
    (out / "pool.json").write_text(
        json.dumps(size | {"scenes": found}, indent=1) + "\n", encoding="utf-8"
    )
    return total


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m roge_jax.data.pack`; exit code 2 and one sentence for mistakes."""
    p = argparse.ArgumentParser(
        prog="python -m roge_jax.data.pack",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("scenes", nargs="+", help="scene folders or files")
    p.add_argument("--out", type=Path, required=True, help="new folder, for train --data")
    p.add_argument("--frames", type=number(1), default=24, help="views of a sequence (default: 24)")
    p.add_argument(
        "--height", type=number(1), default=64, help="of the model to train (default: 64)"
    )
    p.add_argument(
        "--width", type=number(1), default=112, help="of the model to train (default: 112)"
    )
    p.add_argument("--convention", help="axes of a transforms.json that are not OpenGL")
    p.add_argument("--debug", action="store_true", help="show tracebacks")

    def run(args: argparse.Namespace) -> None:
        options = dict(vars(args))
        options.pop("debug")
        pack(**options)

    return execute(run, p, arguments)


if __name__ == "__main__":
    sys.exit(main())
