"""From published files to a model folder: what fills which leaf, all mismatches at once, then one piece at a time.

A `Plan` is made from headers alone. Its `fills` say which source tensor becomes which (layer of which) leaf; leaves
without a fill are `given` (the prompt) or initialised by their specs. `write` streams: it holds one source tensor and
its converted copy, never a stacked leaf.
"""

import functools
import hashlib
import itertools
import json
import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from ..config import RoGeConfig, VAEConfig, to_dict
from ..core.params import Spec, flatten, init, unflatten
from ..errors import UserError
from ..files.folders import check_disk, put
from ..video.dit import FLOAT32_LEAVES
from ..video.vae_training import passthrough_init
from .mapping import Entry, source_shapes
from .shards import SHARD_BYTES, Layout, Shards, plan_shards
from .sources import DTYPES, Source

READABLE = {DTYPES[name] for name in ("F64", "F32", "F16", "BF16")}
HALF = DTYPES["BF16"]
PLAN, PROGRESS = "plan.json", "progress"
LISTED = 20  # kinds of mismatches of a file that an error names
FLUSH_BYTES = 1_000_000_000  # written between two notes of the progress


class Fill(NamedTuple):
    """One write: a leaf, or one layer of a stacked leaf, made of one source tensor."""

    path: str
    layer: int | None
    source: Source
    key: str
    make: Callable[[np.ndarray], np.ndarray]


class Fault(NamedTuple):
    """One mismatch between a source and the model."""

    file: str
    key: str
    what: str  # "is missing", "is not expected", "has shape ..", "has dtype .."


class Plan(NamedTuple):
    """All that a conversion will do."""

    config: RoGeConfig
    specs: dict[str, Spec]  # by path, in the order of writing
    fills: list[Fill]
    given: Mapping[
        str, np.ndarray | Callable[[], np.ndarray]
    ]  # a function: made when it is written
    half: bool  # frozen matrices in bfloat16
    provenance: dict[str, Any]
    seed: int = 0

    @property
    def initialised(self) -> list[str]:
        """Leaves that no file provides."""
        filled = {fill.path for fill in self.fills} | set(self.given)
        return [path for path in self.specs if path not in filled]

    def dtype(self, path: str) -> np.dtype:
        """What a leaf is stored as."""
        return HALF if self.half and stored_half(path) else DTYPES["F32"]

    def layout(self, shard_bytes: float = SHARD_BYTES) -> Layout:
        """Where every leaf lies in files of at most `shard_bytes`."""
        return plan_shards(
            {p: (s.shape, self.dtype(p)) for p, s in self.specs.items()}, shard_bytes
        )


def stored_half(path: str) -> bool:
    """Whether a leaf may be stored in bfloat16: kernels of the pretrained networks, where matrix products read them.

    Not the VAE, not what trains fully (E1, the fusion embeddings), nothing small, and not those leaves of the
    transformer that the official code computes in float32.
    """
    network, _, rest = path.partition("/")
    if not path.endswith("/kernel") or network not in ("encoder", "renderer", "dit"):
        return False
    return network != "dit" or not (
        rest.startswith("patch_embed/") or re.search(FLOAT32_LEAVES, rest)
    )


# ---- planning ------------------------------------------------------------------------------------


def plan_network(
    network: str,
    entries: Iterable[Entry],
    specs: Mapping[str, Spec],
    source: Source,
    names: Mapping[str, str],
) -> tuple[list[Fill], list[Fault]]:
    """The fills of one network (leaf paths behind `network/`, if given) and what does not fit.

    `specs` has the shapes that the file should have, by the entries' own paths; `names` maps the keys used by the
    entries to those of the file.
    """
    entries, file = list(entries), str(source.path)
    want = source_shapes(entries, unflatten(dict(specs)))
    faults = [Fault(file, key, "is missing") for key in want if key not in names]
    faults += [Fault(file, names[key], "is not expected") for key in names if key not in want]
    for key in want:
        if key in names:
            stored = source.tensors[names[key]]
            if tuple(stored.shape) != want[key]:
                faults.append(
                    Fault(file, names[key], f"has shape {stored.shape} instead of {want[key]}")
                )
            if stored.dtype not in READABLE:
                faults.append(Fault(file, names[key], _wrong_dtype(stored.dtype)))
    prefix = f"{network}/" if network else ""
    fills = [
        Fill(prefix + e.path, i if e.stacked else None, source, names[key], e.transform.to_ours)
        for e in entries
        for i, key in enumerate(e.keys)
        if key in names
    ]
    return fills, faults


def _wrong_dtype(dtype: np.dtype) -> str:
    return f"has dtype {dtype}, where float32, bfloat16 or float16 is needed"


def check_coverage(fills: Iterable[Fill], specs: Mapping[str, Spec]) -> None:
    """Every leaf is filled whole and once, or not at all: an internal invariant."""
    filled: dict[str, list[int | None]] = {}
    for fill in fills:
        filled.setdefault(fill.path, []).append(fill.layer)
    for path, layers in filled.items():
        assert path in specs, f"{path} is no leaf of the model"
        whole = [None] if layers[0] is None else list(range(specs[path].shape[0]))
        assert layers == whole, f"{path} is filled by {layers}"


def report(faults: Iterable[Fault]) -> None:
    """Raise one UserError that lists all faults; equal ones of several blocks are written as one line."""
    faults = list(faults)
    if not faults:
        return
    groups: dict[tuple[str, str, str], list[int]] = {}
    for file, key, what in faults:
        pattern = re.sub(r"(?<=\.)\d+(?=\.)", "{}", key, count=1)
        number = re.search(r"(?<=\.)\d+(?=\.)", key)
        groups.setdefault((file, pattern, what), []).append(int(number[0]) if number else 0)
    files: dict[str, list[str]] = {}
    for (file, pattern, what), numbers in groups.items():
        files.setdefault(file, []).append(f"{pattern.replace('{}', _ranges(numbers))} {what}")
    listed = " | ".join(f"{file}: {_shortened(lines)}" for file, lines in files.items())
    count = "1 tensor does" if len(faults) == 1 else f"{len(faults)} tensors do"
    raise UserError(
        f"{count} not fit this model. {listed}. Check that the files are whole and belong to this model (--preset)."
    )


def _shortened(lines: list[str]) -> str:
    more = f"; and {len(lines) - LISTED} kinds more" if len(lines) > LISTED else ""
    return "; ".join(lines[:LISTED]) + more


def _ranges(numbers: list[int]) -> str:
    """[0, 1, 2, 5] -> "{0..2,5}"; a single number alone."""
    runs = []
    for _, group in itertools.groupby(
        enumerate(sorted(set(numbers))), lambda pair: pair[1] - pair[0]
    ):
        run = [number for _, number in group]
        runs.append(str(run[0]) if len(run) == 1 else f"{run[0]}..{run[-1]}")
    return runs[0] if len(runs) == 1 and ".." not in runs[0] else "{" + ",".join(runs) + "}"


# ---- writing -------------------------------------------------------------------------------------


def initial_leaf(path: str, plan: Plan) -> np.ndarray:
    """The value of a leaf that no file provides: the one that `model.init` gives it."""
    with jax.default_device(jax.devices("cpu")[0]):
        if path.startswith("vae/"):
            return _initial_vae(plan.seed, plan.config.vae)[path]
        tree = init(jax.random.key(plan.seed), unflatten({path: plan.specs[path]}))
        return np.asarray(flatten(tree)[path])


@functools.lru_cache(1)
def _initial_vae(seed: int, cfg: VAEConfig) -> dict[str, np.ndarray]:
    key = jax.random.fold_in(jax.random.key(seed), 1)
    return jax.tree.map(np.asarray, flatten({"vae": passthrough_init(key, cfg)}))


def write(
    plan: Plan,
    out: Path,
    *,
    resume: bool = False,
    shard_bytes: float = SHARD_BYTES,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the model folder `out`; `progress(bytes written, bytes in all)` is called after every piece.

    Everything goes to `out.part`, which becomes `out` at the end. A process that is killed leaves `out.part`, and
    `resume` continues from there if sources and options are the same; otherwise it starts over. A mistake found on
    the way (a full disk) removes it.
    Raises: UserError before anything is written if `out` exists or the disk is too small.
    """
    part = check_output(out)
    layout = plan.layout(shard_bytes)
    plan = plan._replace(given={p: v() if callable(v) else v for p, v in plan.given.items()})
    record = _record(plan, layout)
    done = _resumable(part, record) if resume else 0
    if not done:
        shutil.rmtree(part, ignore_errors=True)
    check_disk(sum(layout.sizes), part, held=[part])
    part.mkdir(parents=True, exist_ok=True)
    if not done:
        (part / PLAN).write_text(json.dumps(record), encoding="utf-8")
    try:
        _write_pieces(plan, part, layout, done, progress)
    except UserError:
        shutil.rmtree(part, ignore_errors=True)
        raise
    config = {"format": 1, "config": to_dict(plan.config), "provenance": plan.provenance}
    (part / "config.json").write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")
    (part / PLAN).unlink()
    (part / PROGRESS).unlink(missing_ok=True)
    put(part, out)


def _pieces(plan: Plan) -> list[tuple[str, int | None, Callable[[], np.ndarray], str]]:
    """(leaf, layer, its value, where that is from) in the order of writing, the same in every run."""

    def filled(fill: Fill):
        return lambda: fill.make(fill.source.read(fill.key))

    pieces = [
        (fill.path, fill.layer, filled(fill), f"{fill.source.path}: {fill.key}")
        for fill in plan.fills
    ]
    pieces += [(path, None, lambda v=value: v, path) for path, value in plan.given.items()]
    return pieces + [(p, None, lambda p=p: initial_leaf(p, plan), p) for p in plan.initialised]


def _write_pieces(plan: Plan, part: Path, layout: Layout, done: int, progress) -> None:
    shards = Shards(part, layout, fresh=not done)
    written = pending = i = 0
    total = sum(layout.sizes)
    try:
        for i, (path, layer, value, origin) in enumerate(_pieces(plan)):
            shape = plan.specs[path].shape if layer is None else plan.specs[path].shape[1:]
            size = int(np.prod(shape)) * plan.dtype(path).itemsize
            written += size
            if i >= done:
                try:
                    shards.write(path, value(), layer)
                except FloatingPointError:
                    raise UserError(
                        f"{origin} holds NaN or infinity, or values beyond {plan.dtype(path)}: get the file again."
                    ) from None
                pending += size
                if pending >= FLUSH_BYTES:
                    _note(part, shards, i + 1)
                    pending = 0
            progress(written, total)
        shards.flush()
    except KeyboardInterrupt:
        _note(part, shards, max(i, done))
        raise
    finally:
        shards.close()


def _note(part: Path, shards: Shards, pieces: int) -> None:
    """Remember that so many pieces are on the disk."""
    shards.flush()
    new = part / f"{PROGRESS}.new"
    new.write_text(str(pieces), encoding="utf-8")
    new.replace(part / PROGRESS)


def _record(plan: Plan, layout: Layout) -> dict:
    """What two runs must share for one to continue the other."""
    files = {file for fill in plan.fills for file in fill.source.files}
    return {
        "files": [
            [str(f.resolve()), f.stat().st_size, f.stat().st_mtime_ns] for f in sorted(files)
        ],
        "config": json.loads(json.dumps(to_dict(plan.config))),
        "pieces": [[fill.path, fill.layer, fill.key] for fill in plan.fills],
        "given": {
            p: hashlib.sha256(np.asarray(v).tobytes()).hexdigest() for p, v in plan.given.items()
        },
        "dtype": "bfloat16" if plan.half else "float32",
        "seed": plan.seed,
        "sizes": layout.sizes,
    }


def _resumable(part: Path, record: dict) -> int:
    """How many pieces an earlier run with the same record has finished."""
    try:
        before = json.loads((part / PLAN).read_text(encoding="utf-8"))
        done = int((part / PROGRESS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return 0
    changed = [name for name in record if before.get(name) != record[name]]
    if changed:
        raise UserError(
            f"{part} was begun with another '{changed[0]}': run without --resume to start over, "
            "or with the same files and options as before."
        )
    return done


def check_output(out: Path) -> Path:
    """The temporary folder for `out`. Raises UserError if `out` has files in it."""
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"--out {out} exists already: give a new folder, or remove that one first.")
    return out.with_name(out.name + ".part")
