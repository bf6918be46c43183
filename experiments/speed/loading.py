"""How fast training data comes, and which share of a step waits for it: the own loader beside grain, on the same samples.

    python -m experiments.speed.loading                          # writes experiments/results/loading.json and its table
    python -m experiments.speed.loading --size 480x832 --frames 81 --batch 1 --steps 10

About 5 minutes on 2 cores. A dataset of noise is written to a temporary folder, at the size of the paper's first stage.
Batches are those of `data.views.draw_batch` with `ViewConfig`'s augmentation. Ways to prepare them: in the loop itself,
by 1, 2 or 4 threads (`train --loaders`), by 1 or 2 processes of grain (`pip install grain`; left out without it).

Throughput is samples a second when nothing else is done. Waiting is the share of the time that a loop spends in asking for
the next batch while each step takes `--step` seconds, in which the host sleeps as it does for a busy GPU.
Other programs on the machine disturb both: the load stands in the record. Files are in the system's cache, so a disk is not measured.
"""

import functools
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from experiments import harness

AHEAD = 6  # batches at most that a way has ready when it is asked for the first
PAGE = harness.DOCS / "results" / "speed.md"


def write_noise(folder: Path, sequences: int, frames: int, height: int, width: int) -> Path:
    """A dataset of sequences that move sideways, as `data.pack` writes it."""
    rng = np.random.default_rng(0)
    for k in range(sequences):
        rgb = rng.integers(0, 256, (1, frames, height, width, 3), np.uint8)
        np.save(folder / f"shard_{k:05d}.rgb.npy", rgb)
        c2w = np.tile(np.eye(4), (1, frames, 1, 1))
        c2w[..., 0, 3] = 0.1 * np.arange(frames)
        K = np.array([[height, 0, width / 2], [0, height, height / 2], [0, 0, 1.0]])
        np.savez(folder / f"shard_{k:05d}.npz", seeds=[k], K=np.tile(K, (1, frames, 1, 1)), c2w=c2w)
    return folder


def batch_of(index: int, folder: str, batch: int, targets: int) -> dict:
    """Batch `index`, in whichever process this is."""
    from roge_jax.data.views import ViewConfig, draw_batch

    views = ViewConfig(targets=targets, ordered=True)
    return draw_batch(_opened(folder), 0, index, batch, views, scale_rule="lagernvs")


@functools.cache
def _opened(folder: str):
    from roge_jax.data.dataset import read_dataset

    return read_dataset(folder)


def with_grain(batches: Callable[[int], dict], count: int, processes: int) -> Iterator[dict]:
    """The same batches from grain's worker processes."""
    import grain
    from absl import flags

    flags.FLAGS.mark_as_parsed()  # grain's workers refuse to start before
    options = grain.MultiprocessingOptions(num_workers=processes, per_worker_buffer_size=1)
    dataset = grain.MapDataset.range(count).map(batches)
    # By default each process has 16 threads and up to 500 batches ready: tens of gigabytes at this size.
    reading = grain.ReadOptions(num_threads=1, prefetch_buffer_size=1)
    return iter(dataset.to_iter_dataset(reading).mp_prefetch(options))


def ways(batches: Callable[[int], dict], count: int) -> dict[str, Callable[[], Iterator[dict]]]:
    from roge_jax.training.loop import prefetched

    found: dict[str, Callable[[], Iterator[dict]]] = {
        "in the loop": lambda: (batches(i) for i in range(count))
    }
    for n in (1, 2, 4):
        found[f"{n} thread{'s' * (n > 1)}"] = lambda n=n: prefetched(batches, 0, count, loaders=n)
    try:
        import grain  # noqa: F401
    except ImportError:
        return found
    for n in (1, 2):
        name = f"grain, {n} process{'es' * (n > 1)}"
        found[name] = lambda n=n: with_grain(batches, count, n)
    return found


def measure(source: Iterator[dict], count: int, step: float) -> dict[str, float]:
    """Batches a second and the share of waiting, once what was prepared ahead is used up."""
    began = time.perf_counter()
    next(source)
    first, waited = time.perf_counter() - began, 0.0
    for _ in range(AHEAD - 1):
        next(source)
    began = time.perf_counter()
    for _ in range(count):
        asked = time.perf_counter()
        next(source)
        waited += time.perf_counter() - asked
        if step:
            time.sleep(step)
    spent = time.perf_counter() - began
    return {"first_s": first, "rate": count / spent, "waiting": waited / spent}


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def run(height: int, width: int, frames: int, batch: int, steps: int, step: float) -> dict:
    with tempfile.TemporaryDirectory() as name:
        # As many frames as `data.pack` is asked for, and contexts around them.
        folder = write_noise(Path(name), 8, frames + 4, height, width)
        batches = functools.partial(batch_of, folder=str(folder), batch=batch, targets=frames)
        reference = [batches(i) for i in range(2)]
        rows = {}
        for name, source in ways(batches, steps + AHEAD).items():
            made = source()
            assert all(same(x, next(made)) for x in reference), f"{name}: other samples"
            getattr(made, "close", lambda: None)()
            fast, real = (measure(source(), steps, seconds) for seconds in (0.0, step))
            rows[name] = {
                "samples_per_s": batch * fast["rate"],
                "first_s": fast["first_s"],
                "waiting": real["waiting"],
                "steps_per_s": real["rate"],
            }
            print(f"{name:22s} {rows[name]['samples_per_s']:7.2f} samples/s", flush=True)
    size = {"height": height, "width": width, "frames": frames, "batch": batch, "steps": steps}
    return {"environment": harness.environment(), "size": size, "step_s": step, "ways": rows}


def text(found: dict) -> str:
    size = found["size"]
    lines = harness.table(
        (
            "prepared",
            "samples a second",
            f"waiting in steps of {found['step_s']:g} s",
            "first batch",
        ),
        [
            (
                name,
                f"{row['samples_per_s']:.2f}",
                f"{row['waiting']:.0%}",
                f"{row['first_s']:.1f} s",
            )
            for name, row in found["ways"].items()
        ],
    )
    environment = found["environment"]
    load = environment["load_average"][0]
    head = (
        f"{size['frames']} frames of {size['height']}x{size['width']}, batches of {size['batch']}, {size['steps']} batches; "
        f"{environment['cores']} cores, load {load:.1f} when it ended."
    )
    return "\n".join([head, "", *lines])


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--size", default="192x336", help="HEIGHTxWIDTH (default: 192x336)")
    p.add_argument("--frames", type=int, default=81, help="of a sample (default: 81)")
    p.add_argument("--batch", type=int, default=1, help="scenes a step (default: 1)")
    p.add_argument("--steps", type=int, default=6, help="batches of each way (default: 6)")
    p.add_argument("--step", type=float, default=1.0, help="seconds of a step (default: 1)")
    p.add_argument("--out", type=Path, default=harness.RESULTS / "loading.json")
    args = p.parse_args()
    height, width = (int(x) for x in args.size.split("x"))
    found = run(height, width, args.frames, args.batch, args.steps, args.step)
    harness.write(args.out, found)
    if args.out == harness.RESULTS / "loading.json":
        harness.put(PAGE, "loading", text(found))
    print(text(found))


if __name__ == "__main__":
    main()
