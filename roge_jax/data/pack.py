"""Your own posed sequences as training data: scenes into the dataset that `train --data` reads.

    python -m roge_jax.data.pack SCENE .. --out runs/mine --frames 24 --height 64 --width 112
    python -m roge_jax.data.pack RealEstate10K/train --out runs/re10k --frames 81 --height 192 --width 336

A scene is any layout of `scenes.readers`, or a `.torch` chunk of pixelSplat's RealEstate10K. A folder of scenes or chunks stands
for all of them. A scene is cut into runs of consecutive views; those of longer scenes overlap by half. Every photo fills the
picture and is cropped at the centre, K moves along; poses stay in the scene's own frame and unit, since training
normalises every sample by itself.

A scene that cannot be read is named, counted and left out. The same call again goes on: finished shards are kept.
Each shard is written under temporary names; its .npz comes last.
"""

import argparse
import concurrent.futures
import contextlib
import dataclasses
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from roge_jax.errors import UnsafeFile, UserError
from roge_jax.files.entry import execute, number
from roge_jax.files.fields import read_json
from roge_jax.files.folders import write_json

from . import chunks
from .collect import collect, divide
from .dataset import one_thread_workers, sole_writer
from .shard import ORDERS, Job, Settings, pack_shard, packed_in

RECORD = "pool.json"


def pack(
    scenes: Sequence[str | Path],
    out: str | Path,
    *,
    frames: int = 24,
    height: int = 64,
    width: int = 112,
    convention: str | None = None,
    shortest: int | None = None,
    order: str = "auto",
    processes: int = 1,
    strict: bool = False,
    retry: bool = False,
) -> int:
    """Write scenes, chunks and folders of them into the dataset `out`, or go on with it; the number of its sequences.

    `dataset.read_dataset` reads it: sequences of `frames` views, `rgb` uint8 [f, height, width, 3], `K` and `c2w` float64.

    Args:
      scenes: as `load_scene` takes them, `.torch` chunks, or folders of either.
      out: a new folder, or one of an earlier call with the same settings: what is finished there stays.
      frames: views of a sequence.
      height: of the pictures.
      width: likewise.
      convention: axes of the poses of a transforms.json that are not OpenGL.
      shortest: scenes of fewer than `frames` views, but so many, become sequences of their own length.
      order: see `walk_order`.
      processes: how many work at a time.
      strict: a scene that cannot be packed is an error at the end.
      retry: also those that could not be packed before.
    Raises: UnsafeFile for a chunk that tries to execute code, before anything is written; UserError if nothing could be packed,
      or if `out` holds something else.
    """
    out = Path(out)
    if min(frames, height, width, shortest or 1) < 1:
        raise UserError(f"{frames} frames of {height}x{width} are nothing: give numbers above 0.")
    if shortest is not None and shortest > frames:
        raise UserError(
            f"--shortest {shortest} is more than --frames {frames}: give at most as many views."
        )
    settings = Settings(frames, height, width, convention, shortest, order)
    wanted = collect(scenes)
    record = out / RECORD
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not record.exists())):
        raise UserError(f"{out} is not empty: give a new folder.")
    plan = _plan(record, settings, wanted)
    new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    try:
        with sole_writer(out):
            jobs = [Job(out / f"shard_{k:05d}", names, settings) for k, names in enumerate(plan)]
            left = [job for job in jobs if not _finished(job, retry)]
            if len(left) < len(jobs):
                print(f"{out}: {len(jobs) - len(left)} of {len(jobs)} shards are there and stay")
            with _workers(min(processes, len(left))) as each:
                _check_chunks(left, each)
                write_json(record, dataclasses.asdict(settings) | {"jobs": plan})
                for done in each(pack_shard, left):
                    for one in done.packed:
                        print(f"{one['scene']}: {one['views']} views, {one['sequences']} sequences")
                    for line in done.notes:
                        print(line)
                    for one in done.failed:
                        print(f"left out: {one['reason']}", file=sys.stderr, flush=True)
            return _conclude(out, jobs, settings, plan, strict)
    finally:
        if new and not any(out.glob("shard_*.npz")):  # nothing came of it
            shutil.rmtree(out, ignore_errors=True)


def _plan(record: Path, settings: Settings, wanted: list[str]) -> list[list[str]]:
    """Which scenes each shard has: as an earlier call divided them, then those that are new."""
    plan: list[list[str]] = []
    if record.exists():
        before = read_json(record, "record of a dataset")
        if not isinstance(before, dict) or "jobs" not in before:
            raise UserError(f"{record.parent} is not empty: give a new folder.")
        wrong = [
            f"{name} {before.get(name)} (asked: {value})"
            for name, value in dataclasses.asdict(settings).items()
            if before.get(name) != value
        ]
        if wrong:
            raise UserError(
                f"{record} holds a dataset with {', '.join(wrong)}; write into another folder."
            )
        plan = before["jobs"]
    known = {name for names in plan for name in names}
    return plan + divide([name for name in wanted if name not in known])


def _finished(job: Job, retry: bool) -> bool:
    """Whether a shard is whole, or (without `retry`) was found to have nothing that can be packed."""
    failed = job.stem.with_suffix(".failed.json")
    if failed.exists():
        return not retry and (packed_in(job.stem) is not None or read_json(failed)["packed"] == 0)
    return packed_in(job.stem) is not None


@contextlib.contextmanager
def _workers(processes: int) -> Iterator[Any]:
    """each(function, jobs): results as they come, of processes or of this one."""
    if processes <= 1:
        yield map
        return
    with one_thread_workers(processes) as pool:

        def each(function, jobs):
            futures = [pool.submit(function, job) for job in jobs]
            try:
                for one in concurrent.futures.as_completed(futures):
                    yield one.result()
            except concurrent.futures.process.BrokenProcessPool:
                raise UserError(
                    "A process was ended by the system, most likely for want of memory: repeat the call with fewer "
                    "--processes, what is finished stays."
                ) from None
            finally:
                for one in futures:
                    one.cancel()

        yield each


def _check_chunks(jobs: Sequence[Job], each: Any) -> None:
    """Raise UnsafeFile if a chunk of these jobs tries to execute code: before long work. Damaged ones come later."""
    files = [name for job in jobs for name in job.scenes if name.endswith(chunks.SUFFIX)]
    for _ in each(_look_into, files):
        pass


def _look_into(name: str) -> None:
    try:
        chunks.read_chunk(Path(name))
    except UnsafeFile:
        raise
    except Exception:
        return


def _conclude(
    out: Path, jobs: Sequence[Job], settings: Settings, plan: list[list[str]], strict: bool
) -> int:
    """Write the record of the finished dataset and say what came of it."""
    packed = [one for job in jobs for one in packed_in(job.stem) or []]
    records = [job.stem.with_suffix(".failed.json") for job in jobs]
    failed = [one for file in records if file.exists() for one in read_json(file)["failed"]]
    if not packed:
        first = failed[0]["reason"] if failed else f"{out}: no scenes were found."
        if len(failed) < 2:
            raise UserError(first)
        raise UserError(f"None of {len(failed)} scenes could be packed, the first because: {first}")
    write_json(
        out / RECORD,
        dataclasses.asdict(settings) | {"jobs": plan, "scenes": packed, "failed": failed},
    )
    total = sum(one["sequences"] for one in packed)
    print(f"{out}: {total} sequences of {len(packed)} scenes", end="")
    print(f"; {len(failed)} left out, listed in {out / RECORD}" if failed else "")
    if failed and strict:
        raise UserError(
            f"{len(failed)} of {len(failed) + len(packed)} scenes could not be packed, the first because: "
            f"{failed[0]['reason'].rstrip('.')}: mend them and repeat the call with --retry, or leave out --strict."
        )
    return total


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog="python -m roge_jax.data.pack",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("scenes", nargs="+", help="scenes, .torch chunks, or folders of either")
    p.add_argument(
        "--out",
        type=Path,
        required=True,
        help="folder for train --data, new or of an earlier call that is to go on",
    )
    p.add_argument("--frames", type=number(1), default=24, help="views of a sequence (default: 24)")
    p.add_argument(
        "--height", type=number(1), default=64, help="of the model to train (default: 64)"
    )
    p.add_argument(
        "--width", type=number(1), default=112, help="of the model to train (default: 112)"
    )
    p.add_argument("--convention", help="axes of a transforms.json that are not OpenGL")
    p.add_argument(
        "--shortest",
        type=number(1),
        help="also take scenes of fewer views than --frames, down to so many; only stages that train on single views, "
        "not on videos, draw from them (default: --frames)",
    )
    p.add_argument(
        "--order",
        choices=ORDERS,
        default="auto",
        help="of the views: the file's, that of their names, auto (the shorter way of these two), or path (always the "
        "nearest view that is left, for photos without an order)",
    )
    p.add_argument(
        "--processes",
        type=number(1),
        default=None,
        help="how many work at a time (default: one a core)",
    )
    p.add_argument("--strict", action="store_true", help="exit code 2 if any scene is left out")
    p.add_argument(
        "--retry", action="store_true", help="try scenes again that an earlier call left out"
    )
    p.add_argument("--debug", action="store_true", help="show tracebacks")
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """`python -m roge_jax.data.pack`; exit code 2 and one sentence for mistakes."""

    def run(args: argparse.Namespace) -> None:
        options = dict(vars(args))
        options.pop("debug")
        options["processes"] = options["processes"] or len(os.sched_getaffinity(0))
        pack(**options)

    return execute(run, parser(), arguments)


if __name__ == "__main__":
    sys.exit(main())
