"""Datasets: many rendered sequences on disk.

A dataset is a folder of shards. Shard k is `shard_00000.rgb.npy` (uint8 `[scenes,f,h,w,3]`),
`shard_00000.depth.npy` (float16, optional) and `shard_00000.npz` (`seeds [scenes]`, `K` and `c2w`
float64 `[scenes,f,...]`; `lengths [scenes]` where some have fewer than f frames, and zeros behind them).
The .npz is renamed into place last, so a shard with one is complete.
"""

import concurrent.futures
import contextlib
import dataclasses
import fcntl
import json
import multiprocessing
import os
import time
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.core.lazy import renamed
from roge_jax.errors import UserError
from roge_jax.files.fields import read_json
from roge_jax.files.folders import put

__getattr__ = renamed(
    __name__, Pool="Dataset", read_pool="read_dataset", write_pool="write_dataset"
)


@dataclasses.dataclass(frozen=True)
class Dataset:
    """The finished shards of a dataset; `dataset[i]` is one scene, its frames still on disk.

    `seeds [n]`, `lengths [n]`, `K [n,f,3,3]`, `c2w [n,f,4,4]` (OpenCV, float64) are in memory; `rgb` and `depth`
    are one memory map per shard.
    """

    rgb: list[np.ndarray]
    depth: list[np.ndarray]
    seeds: np.ndarray
    K: np.ndarray
    c2w: np.ndarray
    starts: np.ndarray
    lengths: np.ndarray

    def __len__(self) -> int:
        return len(self.seeds)

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        """`rgb [f,h,w,3]` uint8, `depth [f,h,w]` float16 if written, `K`, `c2w`, `seed`."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        shard = int(np.searchsorted(self.starts, index, side="right")) - 1
        row = index - int(self.starts[shard])
        f = int(self.lengths[index])
        scene = {
            "rgb": self.rgb[shard][row, :f],
            "K": self.K[index, :f],
            "c2w": self.c2w[index, :f],
        }
        scene["seed"] = self.seeds[index]
        return scene | {"depth": self.depth[shard][row, :f]} if self.depth else scene


def write_dataset(
    path: str | Path,
    seeds: Sequence[int],
    frames: int,
    height: int,
    width: int,
    processes: int = 1,
    *,
    supersample: int = 2,
    scenes_per_shard: int = 100,
    depth: bool = False,
    varied: bool = False,
    handheld: bool = False,
    textures: Path | None = None,
) -> None:
    """Render `sample_sequence` of every seed into a dataset with one-thread worker processes.

    With `textures`, a folder of pictures, every shard has a set of its own (`load_textures`). Finished shards are kept, so an interrupted call is resumed by repeating it.

    Raises:
        UserError: no seeds, seeds of both splits, a folder that holds a dataset with other settings
            or that another process is writing.
    """
    from roge_jax.procedural.scenes import HELDOUT_SEED, split_of
    from roge_jax.procedural.textures import folder_pictures

    path = Path(path)
    wanted = np.asarray(seeds, np.int64)
    if not len(wanted):
        raise UserError(f"{path}: no seeds were given; a dataset needs at least one scene.")
    if len({split_of(seed) for seed in wanted}) > 1:
        raise UserError(
            f"{path}: seeds {wanted.min()} .. {wanted.max()} mix training and held-out scenes; "
            f"write seeds from {HELDOUT_SEED} on into a dataset of their own."
        )
    settings: dict[str, Any] = {
        "frames": frames,
        "height": height,
        "width": width,
        "supersample": supersample,
    }
    settings |= {"scenes_per_shard": scenes_per_shard, "depth": depth, "varied": varied}
    settings |= {"first_seed": int(wanted[0])} | ({"handheld": True} if handheld else {})
    if textures is not None:
        folder_pictures(textures, split_of(int(wanted[0])))  # says what is wrong with the folder
        settings["textures"] = str(textures)
    path.mkdir(parents=True, exist_ok=True)
    with sole_writer(path):
        _write_missing(path, wanted, settings, processes)


@contextlib.contextmanager
def sole_writer(path: Path) -> Iterator[None]:
    """Hold the folder's lock: two writers would truncate each other's unfinished shards.

    The system drops the lock when its process ends, however it ends.
    """
    with (path / ".lock").open("w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(
                f"{path} is being written by another process; wait for it or write elsewhere."
            ) from None
        yield


def _write_missing(path: Path, seeds: np.ndarray, settings: dict, processes: int) -> None:
    record = path / "pool.json"
    old = read_json(record, "record of a dataset") if record.exists() else settings
    if not isinstance(old, dict):
        raise UserError(f"{record} is no record of a dataset: write into another folder.")
    if old != settings:
        wrong = ", ".join(
            f"{k} {old.get(k)} (asked: {v})" for k, v in settings.items() if old.get(k) != v
        )
        raise UserError(f"{record} holds a dataset with {wrong}; write into another folder.")
    record.write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")
    jobs = _missing(path, seeds, settings)
    with one_thread_workers(min(processes, len(jobs))) as workers:
        for done in concurrent.futures.as_completed(workers.submit(_write_shard, j) for j in jobs):
            name, seconds = done.result()
            print(f"{name}: {seconds:.0f} s", flush=True)


@contextlib.contextmanager
def one_thread_workers(processes: int) -> Iterator[concurrent.futures.ProcessPoolExecutor]:
    """Processes of one thread each, on the CPU. Threads lose on rendering and decoding, such processes scale."""
    # Workers read these when JAX starts.
    old = {name: os.environ.get(name) for name in _WORKER_ENVIRONMENT}
    flags = f"{os.environ.get('XLA_FLAGS', '')} {_WORKER_ENVIRONMENT['XLA_FLAGS']}".strip()
    os.environ.update(_WORKER_ENVIRONMENT | {"XLA_FLAGS": flags})  # the caller's flags stay
    try:
        # An executor and not a multiprocessing.Pool: a worker that dies raises, it never hangs.
        with concurrent.futures.ProcessPoolExecutor(
            max(1, processes), mp_context=multiprocessing.get_context("spawn")
        ) as workers:
            yield workers
    finally:
        for name, value in old.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


_WORKER_ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "NPROC": "1",  # size of XLA's thread pool
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "OPENBLAS_NUM_THREADS": "1",
}


def _missing(path: Path, seeds: np.ndarray, settings: dict) -> list[tuple[Path, np.ndarray, dict]]:
    """The shards still to be rendered, as arguments of `_write_shard`."""
    size = settings["scenes_per_shard"]
    shards = [seeds[i : i + size] for i in range(0, len(seeds), size)]
    stems = [path / f"shard_{k:05d}" for k in range(len(shards))]
    return [
        (stem, shard, settings)
        for stem, shard in zip(stems, shards, strict=True)
        if not _is_complete(stem, shard)
    ]


def _is_complete(stem: Path, seeds: np.ndarray) -> bool:
    cameras = stem.with_suffix(".npz")
    if not cameras.exists():
        return False
    try:
        with cameras.open("rb") as file, np.load(file) as stored:
            return np.array_equal(stored["seeds"], seeds)
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        return False  # damaged: rendered again


def _write_shard(job: tuple[Path, np.ndarray, dict]) -> tuple[str, float]:
    import jax.numpy as jnp

    from roge_jax.procedural.scenes import sample_sequence, split_of
    from roge_jax.procedural.textures import load_textures

    stem, seeds, settings = job
    began = time.perf_counter()
    textures = None
    if "textures" in settings:  # another draw for every shard
        folder, draw = Path(settings["textures"]), 1 + int(stem.name.rpartition("_")[2])
        textures = jnp.asarray(load_textures(split_of(int(seeds[0])), folder, draw))
    f, h, w = (settings[name] for name in ("frames", "height", "width"))
    depth = settings["depth"]
    kinds = {"rgb": (np.uint8, (f, h, w, 3))} | (
        {"depth": (np.float16, (f, h, w))} if depth else {}
    )
    maps = {
        name: np.lib.format.open_memmap(
            stem.with_suffix(f".{name}.npy.part"), "w+", dtype, (len(seeds), *shape)
        )
        for name, (dtype, shape) in kinds.items()
    }
    cameras: dict[str, list] = {"K": [], "c2w": []}
    for row, seed in enumerate(seeds):
        views = sample_sequence(
            int(seed),
            frames=f,
            height=h,
            width=w,
            supersample=settings["supersample"],
            depth=depth,
            varied=settings["varied"],
            handheld=settings.get("handheld", False),
            textures=textures,
        )
        for name, store in maps.items():
            store[row] = views[name]
        for name, values in cameras.items():
            values.append(views[name])
    for name, store in maps.items():
        store.flush()
        part = stem.with_suffix(f".{name}.npy.part")
        put(part, part.with_suffix(""))
    part = stem.with_suffix(".npz.part")
    with part.open("wb") as file:
        np.savez(file, seeds=seeds, K=np.stack(cameras["K"]), c2w=np.stack(cameras["c2w"]))
    put(part, part.with_suffix(""))
    return stem.name, time.perf_counter() - began


def read_dataset(path: str | Path) -> Dataset:
    """The finished shards of a dataset written by `write_dataset` (also while it is being written).

    Raises:
        UserError: the folder has no finished shard.
    """
    path = Path(path)
    stems = sorted(p.with_suffix("") for p in path.glob("shard_*.npz"))
    if not stems:
        raise UserError(
            f"{path} holds no finished shard_*.npz; write one with "
            f"`python -m roge_jax.data.pack SCENES --out {path}` or `python -m roge_jax.procedural dataset --out {path}`."
        )
    cameras: list[dict[str, np.ndarray]] = []
    pixels: dict[str, list[np.ndarray]] = {"rgb": [], "depth": []}
    for stem in stems:
        try:
            with stem.with_suffix(".npz").open("rb") as file, np.load(file) as stored:
                cameras.append({name: stored[name] for name in ("seeds", "K", "c2w")})
                whole = np.full(len(cameras[-1]["K"]), cameras[-1]["K"].shape[1])
                cameras[-1]["lengths"] = stored.get("lengths", whole)
            for name, maps in pixels.items():
                array = stem.with_suffix(f".{name}.npy")
                if name == "rgb" or array.exists():
                    maps.append(np.load(array, mmap_mode="r"))
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise UserError(
                f"{stem}: this shard is damaged or incomplete ({error}): remove its files and write the dataset again."
            ) from None
        rgb, shape = pixels["rgb"][-1], cameras[-1]["K"].shape
        if rgb.ndim != 5 or rgb.dtype != np.uint8 or rgb.shape[:2] != shape[:2]:
            raise UserError(
                f"{stem}: its pictures are {rgb.dtype} {rgb.shape}, its K {shape}: remove its files and write the "
                "dataset again."
            )
    lengths = [len(entry["seeds"]) for entry in cameras]
    return Dataset(
        rgb=pixels["rgb"],
        depth=pixels["depth"],
        starts=np.cumsum([0, *lengths[:-1]]),
        **{name: np.concatenate([entry[name] for entry in cameras]) for name in cameras[0]},
    )
