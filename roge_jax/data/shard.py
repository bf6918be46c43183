"""One shard of a dataset from scenes: runs of consecutive views, at the size of training. `data.pack` makes datasets of them."""

import contextlib
import dataclasses
import io
import json
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from roge_jax.errors import UnsafeFile, UserError
from roge_jax.files.folders import put, write_json
from roge_jax.scenes.scene import Scene, check_aspects, load_scene, prepare, view_gaps

from . import chunks

SHORTER = 0.8  # a walk by names this much shorter than the file's is the one that was walked
ORDERS = ("auto", "file", "name", "path")


@dataclasses.dataclass(frozen=True)
class Settings:
    """What every shard of a dataset has in common."""

    frames: int = 24
    height: int = 64
    width: int = 112
    convention: str | None = None  # axes of the poses of a transforms.json that are not OpenGL
    shortest: int | None = (
        None  # scenes of fewer than `frames` views, but so many, are sequences too
    )
    order: str = "auto"


class Job(NamedTuple):
    """One shard to be written."""

    stem: Path
    scenes: list[str]
    settings: Settings


class Done(NamedTuple):
    """What became of the scenes of a shard: a dict each, lines to print."""

    packed: list[dict[str, Any]]
    failed: list[dict[str, str]]
    notes: list[str]


def runs(views: int, frames: int) -> list[int]:
    """First views of the runs of `frames` views: half a run apart, the last one ending at the last view."""
    return sorted({*range(0, views - frames, max(1, frames // 2)), views - frames})


def walk_order(scene: Scene, order: str = "auto") -> list[int]:
    """The views in the order in which the camera walked.

    "file": the reader's; "name": that of the names; "auto": the one of the two with the shorter way, because COLMAP and
    nerfstudio write photos as they were registered; "path": from one end on always the nearest view that is left, for
    photos whose names say nothing.
    """
    given = list(range(len(scene)))
    if order == "path":
        return _nearest_first(scene)
    named = sorted(given, key=lambda i: _natural(scene.names[i]))

    def way(views: list[int]) -> float:
        steps = np.diff(scene.cameras.centres[views], axis=0)
        return float(np.linalg.norm(steps, axis=-1).sum())

    if order == "auto":
        return named if way(named) < SHORTER * way(given) else given
    return named if order == "name" else given


def _nearest_first(scene: Scene) -> list[int]:
    gaps = view_gaps(scene.cameras)
    order = [int(np.unravel_index(np.argmax(gaps), gaps.shape)[0])]
    left = set(range(len(scene))) - set(order)
    while left:
        order.append(min(left, key=lambda i: (gaps[order[-1], i], i)))
        left.remove(order[-1])
    return order


def _natural(name: str) -> list[tuple[int, int, str]]:
    """A name with its numbers as numbers, for sorting."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(p), "") if p.isascii() and p.isdecimal() else (1, 0, p) for p in parts]


def sequences(scene: Scene, settings: Settings) -> Iterator[dict[str, np.ndarray]]:
    """The runs of a scene: rgb uint8 [n, h, w, 3], K [n, 3, 3], c2w [n, 4, 4]. A picture is decoded once.

    Raises: UserError if the scene has too few views, or a picture that cannot be read.
    """
    least = settings.shortest or settings.frames
    if len(scene) < least:
        option = "--shortest" if settings.shortest else "--frames"
        raise UserError(
            f"{scene.source}: has {len(scene)} views, a sequence needs {least}: add views, or give {option} "
            f"{len(scene)} (stages that make videos need the model's chunk, which is 17 for mini)."
        )
    frames, order = min(settings.frames, len(scene)), walk_order(scene, settings.order)
    made: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for start in runs(len(scene), frames):
        ids = order[start : start + frames]
        check_aspects(scene, ids)
        made = {i: made[i] for i in ids if i in made}
        for i in ids:
            if i not in made:
                image, camera = prepare(scene, [i], settings.height, settings.width)
                made[i] = np.round(image[0] * 255.0).astype(np.uint8), np.asarray(camera.K[0])
        rgb, K = (np.stack(part) for part in zip(*(made[i] for i in ids), strict=True))
        yield {"rgb": rgb, "K": K, "c2w": np.asarray(scene.cameras.c2w[ids], np.float64)}


# ---- one shard -----------------------------------------------------------------------------------


class _Rows:
    """Sequences appended to a .npy file of which the number is known at the end; `cut` takes the last ones back."""

    def __init__(self, file: Path, row: tuple[int, ...]):
        self.row, self.count = row, 0
        self.stream = file.open("w+b")
        self._head()
        self.begin = self.stream.tell()

    def _head(self) -> None:
        head = {"descr": "|u1", "fortran_order": False, "shape": (self.count, *self.row)}
        text = io.BytesIO()
        np.lib.format.write_array_header_1_0(text, head)  # pads for a first axis that grows
        self.stream.write(text.getvalue())

    def append(self, rgb: np.ndarray) -> None:
        self.stream.write(np.ascontiguousarray(rgb).data)
        self.count += 1
        if len(rgb) < self.row[0]:  # a hole in the file: takes no disk
            self.cut(self.count)

    def cut(self, count: int) -> None:
        """Keep `count` sequences."""
        self.count = count
        end = self.begin + count * int(np.prod(self.row))
        self.stream.truncate(end)
        self.stream.seek(end)

    def close(self) -> None:
        self.stream.seek(0)
        self._head()
        assert self.stream.tell() == self.begin
        self.stream.close()


def pack_shard(job: Job) -> Done:
    """Write the runs of all scenes of a shard that can be read, and JOB.failed.json of the others."""
    stem, scenes, settings = job
    done = Done([], [], [])
    part = stem.with_suffix(".rgb.npy.part")
    rows = _Rows(part, (settings.frames, settings.height, settings.width, 3))
    kept: dict[str, list] = {"K": [], "c2w": [], "lengths": []}
    with contextlib.closing(rows):
        for name, open_one in _opened(scenes, settings, done):
            before = rows.count
            try:
                with warnings.catch_warnings(record=True) as told:
                    warnings.simplefilter("always")
                    scene = open_one()
                    for one in sequences(scene, settings):
                        rows.append(one["rgb"])
                        kept["lengths"].append(len(one["K"]))
                        for key in ("K", "c2w"):
                            kept[key].append(_filled(one[key], settings.frames))
            except UnsafeFile:
                raise
            except Exception as error:  # one bad scene never costs the others
                rows.cut(before)
                for values in kept.values():
                    del values[before:]
                done.failed.append({"scene": name, "reason": _reason(error)})
                continue
            count = rows.count - before
            done.packed.append({"scene": name, "views": len(scene), "sequences": count})
            done.notes.extend(
                f"note: {name}: {w.message}" for w in told if w.category is not DeprecationWarning
            )
            if settings.order == "auto" and walk_order(scene) != list(range(len(scene))):
                done.notes.append(
                    f"note: {name}: views are taken in the order of their names, not of the file"
                )
    record = stem.with_suffix(".failed.json")
    if done.failed:
        write_json(record, {"packed": len(done.packed), "failed": done.failed})
    else:
        record.unlink(missing_ok=True)
    if rows.count:
        put(part, part.with_suffix(""))
        _write_cameras(stem, kept, settings.frames, done.packed)
    else:
        part.unlink()
    return done


def packed_in(stem: Path) -> list[dict[str, Any]] | None:
    """What a finished shard says of its scenes; None if it is not there or damaged."""
    try:
        with stem.with_suffix(".npz").open("rb") as file, np.load(file) as stored:
            rows = len(stored["seeds"])
            packed = json.loads(str(stored["packed"]))
        pictures = np.load(stem.with_suffix(".rgb.npy"), mmap_mode="r")
        return packed if len(pictures) == rows else None
    except Exception:  # damaged in any way: written again
        return None


def _opened(scenes: Sequence[str], settings: Settings, done: Done) -> Iterator[tuple[str, Any]]:
    """(name, what opens it) of every scene; a chunk that cannot be read at all is noted as failed."""
    for place in scenes:
        if not place.endswith(chunks.SUFFIX):
            yield place, lambda place=place: load_scene(place, convention=settings.convention)
            continue
        file = Path(place)
        try:
            content = chunks.read_chunk(file)
        except UnsafeFile:
            raise
        except Exception as error:
            done.failed.append({"scene": place, "reason": _reason(error)})
            continue
        for i, entry in enumerate(content):
            name = chunks.name_of(file, i, entry)
            yield name, lambda entry=entry, name=name: chunks.scene_of(entry, name)


def _reason(error: Exception) -> str:
    text = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())


def _filled(values: np.ndarray, frames: int) -> np.ndarray:
    whole = np.zeros((frames, *values.shape[1:]))
    whole[: len(values)] = values
    return whole


def _write_cameras(stem: Path, kept: dict[str, list], frames: int, packed: list[dict]) -> None:
    lengths = np.array(kept["lengths"])
    arrays: dict[str, Any] = {
        "seeds": np.arange(len(lengths)),
        "K": np.stack(kept["K"]),
        "c2w": np.stack(kept["c2w"]),
    }
    if (lengths < frames).any():
        arrays["lengths"] = lengths
    part = stem.with_suffix(".npz.part")
    with part.open("wb") as file:
        np.savez(file, **arrays, packed=np.array(json.dumps(packed)))
    put(part, part.with_suffix(""))
