"""Two kinds of files: training checkpoints (Orbax, exact, resumable) and models (safetensors + config.json, to share).

A model is a folder: `config.json` (the whole configuration and where the weights come from), one or more
`model-0000i-of-0000n.safetensors` of at most 15 MB, all written under a temporary name and renamed.
"""

import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import model
from .config import PRESETS, RoGeConfig, from_dict, to_dict
from .core import memory
from .core.lora import merged
from .core.params import Spec, Tree, check, flatten, unflatten
from .errors import UserError, did_you_mean
from .files.fields import exists, is_file, read_json
from .files.folders import fingerprint, put, share, sync

SHARD_BYTES = 15_000_000
PIECE_BYTES = 16_000_000  # of a leaf that are written at a time
ADAPTER = "adapter.safetensors"
CHECKSUMS = "sha256.json"  # in a training checkpoint: what each of its files must hash to
ASSETS = Path(__file__).with_name("assets")
WEIGHTS_VARIABLE = "ROGE_WEIGHTS"  # a folder with further models, looked up by name


class Checkpoints:
    """The last `keep` training states in a folder. A state that was cut off while being written is never seen."""

    def __init__(self, folder: Path, keep: int = 3):
        import orbax.checkpoint as ocp

        self.folder = Path(folder).resolve()
        options = ocp.CheckpointManagerOptions(
            max_to_keep=keep, enable_async_checkpointing=False, cleanup_tmp_directories=True
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)
        self._ocp = ocp

    def latest(self) -> int | None:
        """The last step that was saved whole; None if there is none."""
        return self._manager.latest_step()

    def save(self, step: int, state: Tree) -> None:
        """Write the state after `step` steps, and then the checksums of its files, all of it to the disk.

        All processes must call it.
        """
        self._manager.save(step, args=self._ocp.args.StandardSave(state))
        self._manager.wait_until_finished()
        if jax.process_index() == 0:
            folder = self.folder / str(step)
            sync(folder)
            temporary = folder / f"{CHECKSUMS}.part"
            temporary.write_text(json.dumps(_checksums(folder), indent=1) + "\n", encoding="utf-8")
            put(temporary, folder / CHECKSUMS)

    def verify(self, step: int) -> None:
        """Raise a UserError if a file of the state of `step` has changed or is gone since it was written.

        Orbax notices damage in its tables, not in the numbers. A state without checksums (the process died before
        they were written) passes.
        """
        folder = self.folder / str(step)
        if not (folder / CHECKSUMS).exists():
            return
        try:
            want = json.loads((folder / CHECKSUMS).read_text(encoding="utf-8"))
        except ValueError:
            want = {CHECKSUMS: ""}
        have = _checksums(folder)
        wrong = sorted(name for name, digest in want.items() if have.get(name) != digest)
        if wrong:
            older = [s for s in self._manager.all_steps() if s < step]
            cure = f"continue from step {max(older)}" if older else "start again"
            raise UserError(
                f"The checkpoint of step {step} in {self.folder} is damaged: {wrong[0]} is not what was written "
                f"({len(wrong)} of {len(want)} files). Delete {folder} to {cure}."
            )

    def restore(self, like: Tree, step: int | None = None) -> Tree:
        """The state of `step` (default: the latest) with the structure, dtypes and shardings of `like`."""
        step = self.latest() if step is None else step
        abstract = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=getattr(x, "sharding", None)),
            like,
        )
        try:
            return self._manager.restore(step, args=self._ocp.args.StandardRestore(abstract))
        except ValueError as error:
            first = str(error).splitlines()[0]
            raise UserError(
                f"The checkpoint of step {step} in {self.folder} was written by another model or stage "
                f"({first}). Resume with the same preset and stage, or start in an empty folder."
            ) from error

    def close(self) -> None:
        """Release the folder; nothing can be saved or restored afterwards."""
        self._manager.close()


def _checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder, by relative path, without the list itself."""
    found = {}
    for file in sorted(p for p in folder.rglob("*") if p.is_file()):
        if not file.name.startswith(CHECKSUMS):
            with file.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            found[file.relative_to(folder).as_posix()] = digest
    return found


def save_model(
    folder: Path,
    params: Tree,
    config: RoGeConfig,
    *,
    dtype=jnp.bfloat16,
    provenance: dict | None = None,
    lora: Tree | None = None,
) -> None:
    """Write a model folder. Floating leaves are stored in `dtype`; an existing model there is replaced whole.

    Leaves may lie in the files of another model (`open_model`), and are copied from there in pieces. Factors of `lora`
    are merged into their kernels on the way, one layer of a stack at a time.
    """
    from .weights.shards import plan_shards

    folder = Path(folder)
    temporary = folder.with_name(folder.name + ".part")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    leaves, factors = flatten(params), flatten(lora or {})
    kinds = {path: (tuple(x.shape), _kind(x, dtype)) for path, x in leaves.items()}
    layout = plan_shards(kinds, SHARD_BYTES, signed=False)
    for shard, header in enumerate(layout.headers):
        with (temporary / layout.name(shard)).open("wb") as file:
            file.write(header)
            for path in (path for path, place in layout.places.items() if place.shard == shard):
                layer = path.removesuffix("/kernel")
                a, b = (factors.get(f"{layer}/lora_{side}") for side in "ab")
                for piece in _pieces(leaves[path], a, b):
                    piece = np.ascontiguousarray(piece, kinds[path][1])
                    file.write(piece.reshape(-1).view(np.uint8).data)
    record = {"format": 1, "config": to_dict(config), "provenance": provenance or {}}
    (temporary / "config.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    put(temporary, folder)


def _kind(leaf: Any, dtype: Any) -> np.dtype:
    """`dtype` for a leaf of floating numbers; its own for any other, and if `dtype` is None."""
    kept = dtype is None or not jnp.issubdtype(leaf.dtype, jnp.floating)
    return np.dtype(leaf.dtype if kept else dtype)


def _pieces(leaf: Any, a: Any = None, b: Any = None) -> Iterator[np.ndarray]:
    """The numbers of a leaf, some at a time; with the factors a and b of kernel + a @ b, layer by layer in float32."""
    value = np.asarray(leaf)
    if a is None:
        value, n = value.reshape(-1), PIECE_BYTES // value.itemsize
        yield from (value[i : i + n] for i in range(0, value.size, n))
        return
    stack = zip(value, a, b, strict=True) if np.ndim(a) == 3 else [(value, a, b)]
    for kernel, left, right in stack:
        yield np.asarray(merged(kernel.astype(np.float32), left, right))


def model_fingerprint(params: Tree, config: RoGeConfig, dtype: Any = None) -> str:
    """Twelve hex digits that tell this model from another, by weights and configuration alone (`folders.fingerprint`)."""
    leaves = ((path, np.asarray(leaf)) for path, leaf in flatten(params).items())
    return fingerprint(leaves, json.dumps(to_dict(config), sort_keys=True), dtype=dtype)


def weights_fingerprint(params: Tree, dtype: Any = None) -> str:
    """`folders.fingerprint` of the weights alone, whatever the size of the video; leaves may be in files, mapped."""
    leaves = flatten(params).items()
    return fingerprint(((path, np.asarray(leaf)) for path, leaf in leaves), dtype=dtype)


def find_model(name: str | Path) -> Path:
    """The folder of a model: a path, the name of a shipped one, or `hub:USER/NAME`, which is fetched (`weights.hub`)."""
    from .weights import hub

    if hub.asks_hub(name):
        load_config(hub.fetch(str(name), ("config.json",)))  # before gigabytes come
        return hub.fetch(str(name), ("config.json", "*.safetensors"))
    folder = Path(name)
    if is_file(folder / "config.json"):
        return folder
    places = [ASSETS] + (
        [Path(os.environ[WEIGHTS_VARIABLE])] if WEIGHTS_VARIABLE in os.environ else []
    )
    for place in places:
        if is_file(place / str(name) / "config.json"):
            return place / str(name)
    known = [p.parent.name for place in places for p in place.glob("*/config.json")]
    if exists(folder):
        raise UserError(
            f"{folder} has no config.json: give a folder written by roge_jax.convert or train."
        )
    if str(name) in PRESETS:
        raise UserError(
            f"No trained weights of preset '{name}' are here: convert the official ones with "
            f"`python -m roge_jax.convert`, or set {WEIGHTS_VARIABLE} to a folder that has '{name}/config.json'."
        )
    there = f" A model of the Hugging Face hub is {hub.PREFIX}{name}." if hub.like_hub(name) else ""
    raise UserError(
        f"Unknown checkpoint '{name}', neither a model folder nor a name: {did_you_mean(str(name), known)}{there}"
    )


def load_model(
    name: str | Path,
    *,
    dtype: Any | Callable[[str], Any] = jnp.float32,
    shardings: Tree | None = None,
    parts: Collection[str] | None = None,
) -> tuple[Tree, RoGeConfig]:
    """(params, config) of a model folder or shipped model, checked against the config before a value is read.

    Floating leaves come in `dtype`, which may be a function of the path; None: as they are stored. With `shardings`
    (a tree as of `core.sharding.shardings`) every device gets its share of a leaf straight from the file; without,
    leaves are whole. `parts`: what of the tree's top level is wanted, all if None. Host memory beside the arrays themselves holds one leaf at a time. Raises: UserError if they
    are more than the memory has room for, before one is read.
    """
    tree, config = open_model(name)
    tree = {part: x for part, x in tree.items() if parts is None or part in parts}
    wanted = dtype if callable(dtype) and not isinstance(dtype, type) else lambda path: dtype
    _check_memory(str(name), tree, wanted, shardings)
    return placed(tree, wanted, shardings), config


def open_model(name: str | Path) -> tuple[Tree, RoGeConfig]:
    """(params, config) of a model folder or shipped model whose leaves stay in the files (`sources.Stored`).

    Only headers are read, and checked against the config. `np.asarray(leaf)` maps a leaf as it is stored, for as long
    as the array lives.
    """
    from .weights.sources import read_safetensors_header

    folder = find_model(name)
    config = load_config(folder)
    if (folder / ADAPTER).exists():
        raise UserError(
            f"{folder} is an adapter: `python -m roge_jax.export {folder} --merge BASE` makes a model of it."
        )
    files = sorted(folder.glob("model-*.safetensors"))
    odd = [file.name for file in files if not file.stem.rsplit("-", 1)[1].isdecimal()]
    if odd:
        raise UserError(
            f"{folder / odd[0]} is not named like model-00001-of-00001.safetensors: give it its name back."
        )
    expected = int(files[0].stem.rsplit("-", 1)[1]) if files else 1
    if len(files) != expected:
        have = {f.name for f in files}
        lost = [f"model-{i:05d}-of-{expected:05d}.safetensors" for i in range(1, expected + 1)]
        lost = [f for f in lost if f not in have] or ["model-*.safetensors"]
        raise UserError(
            f"{folder} is incomplete: {', '.join(lost)} missing. Copy the whole folder again."
        )
    flat: dict[str, Any] = {}
    for file in files:
        flat |= read_safetensors_header(file)
    tree = unflatten(flat)
    check(tree, model.specs(config), source=str(folder))
    return tree, config


def placed(tree: Tree, dtype: Callable[[str], Any], shardings: Tree | None = None) -> Tree:
    """The leaves of `tree` in `dtype(path)` on their devices, one after the other from wherever they lie."""
    where = {} if shardings is None else flatten(shardings)
    flat = flatten(tree)
    return unflatten(
        {path: _placed(path, x, dtype(path), where.get(path)) for path, x in flat.items()}
    )


def _check_memory(
    name: str, tree: Tree, dtype: Callable[[str], Any], shardings: Tree | None
) -> None:
    """Raise UserError if the leaves do not fit: their shares each device, or all of them a host whose memory it is."""
    where = {} if shardings is None else flatten(shardings)
    devices = {d for one in where.values() for d in one.addressable_devices} or {jax.devices()[0]}
    room = memory.own_memory(sorted(devices, key=lambda d: d.id))
    needed = 0
    for path, leaf in flatten(tree).items():
        shape, whole = leaf.shape, room is None or path not in where
        shape = shape if whole else where[path].shard_shape(shape)
        needed += math.prod(shape) * _kind(leaf, dtype(path)).itemsize
    smaller = "or take a smaller model"
    if room is not None:
        cure = f"split them over more devices, --mesh fsdp=N, {smaller}"
        memory.refuse(name, needed, memory.DEVICE, room, "weights", cure)
    else:
        cure = f"close other programs, {smaller}"
        memory.refuse(name, needed, memory.HOST, memory.memory_available(), "weights", cure)


def _placed(path: str, leaf: Any, dtype: Any, sharding: jax.sharding.Sharding | None) -> jax.Array:
    """A copy of a leaf on its devices. Conversion is NumPy's: JAX would compile one for every shape.

    Raises: UserError naming file and leaf if a number that is read is NaN or infinite.
    """
    from .weights.shards import finite

    value, wanted = np.asarray(leaf), _kind(leaf, dtype)
    shares: dict[str, np.ndarray] = {}  # devices that repeat one another read the same copy

    def share(index) -> np.ndarray:
        key = str(index)
        if key not in shares:  # a copy, because the file may change while the array lives
            share = np.array(value[index], wanted)
            if jnp.issubdtype(wanted, jnp.floating) and not finite(share):
                raise UserError(
                    f"{getattr(leaf, 'file', 'the model')}: '{path}' has NaN or infinite numbers in {wanted}: "
                    "copy or make the file again."
                )
            shares[key] = share
        return shares[key]

    if sharding is None:
        return jnp.asarray(share(...))
    return jax.make_array_from_callback(value.shape, sharding, share)


def save_adapter(
    folder: Path, tree: Tree, config: RoGeConfig, provenance: dict | None = None
) -> None:
    """Write what training on top of a model changed: LoRA factors and the leaves that trained fully, in float32.

    `tree` is the sparse tree that trained. The folder gets `adapter.safetensors`, `config.json` and a model card,
    README.md, made of `provenance` (`weights.model_card` says which entries it reads). An adapter there is replaced.
    """
    from safetensors.flax import save_file

    from .weights.model_card import adapter_card

    folder = Path(folder)
    temporary = folder.with_name(folder.name + ".part")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    leaves = {
        path: jnp.asarray(x, jnp.float32) for path, x in flatten(jax.device_get(tree)).items()
    }
    check_adapter(unflatten(leaves), config, source="the adapter")
    save_file(leaves, temporary / ADAPTER)
    share(temporary / ADAPTER)
    record = {
        "format": 1,
        "kind": "adapter",
        "config": to_dict(config),
        "provenance": provenance or {},
    }
    (temporary / "config.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    card = adapter_card(
        leaves, config, provenance or {}
    )  # with names of files, which may be no text
    (temporary / "README.md").write_text(card, encoding="utf-8", errors="backslashreplace")
    put(temporary, folder)


def load_adapter(folder: str | Path) -> tuple[Tree, RoGeConfig]:
    """(sparse tree, config) of an adapter folder. `core.lora.attach(params, tree)` applies it to its base."""
    from safetensors import SafetensorError
    from safetensors.flax import load_file

    folder = Path(folder)
    if not (folder / ADAPTER).exists():
        raise UserError(f"{folder} holds no {ADAPTER}: give a folder written by `save_adapter`.")
    config = load_config(folder)
    try:
        tree = unflatten(load_file(folder / ADAPTER))
    except SafetensorError as error:
        raise UserError(
            f"{folder / ADAPTER} is truncated or damaged ({error}): copy it again."
        ) from error
    check_adapter(tree, config, source=str(folder / ADAPTER))
    return tree, config


def check_adapter(tree: Tree, config: RoGeConfig, *, source: str) -> None:
    """Raise one UserError that lists every leaf of a sparse tree that does not belong to the model or does not fit."""
    want = flatten(model.specs(config))
    have = {path: tuple(x.shape) for path, x in flatten(tree).items()}
    faults = []
    for path, shape in have.items():
        layer, _, leaf = path.rpartition("/")
        if leaf in ("lora_a", "lora_b"):
            kernel = want.get(f"{layer}/kernel")
            other = have.get(f"{layer}/{'lora_b' if leaf == 'lora_a' else 'lora_a'}")
            if kernel is None or other is None or not _factor_fits(leaf, shape, other, kernel):
                faults.append(f"{path} {shape}")
        elif path not in want or shape != want[path].shape:
            faults.append(f"{path} {shape}")
    if faults or not have:
        more = f"; and {len(faults) - 20} more" if len(faults) > 20 else ""
        raise UserError(
            f"{source} does not fit preset '{config.name}' ({len(faults)} mismatches): "
            f"{'; '.join(faults[:20]) or 'it is empty'}{more}. Use it with the model it was trained on."
        )


def _factor_fits(leaf: str, shape: tuple, other: tuple, kernel: Spec) -> bool:
    lead = 1 if kernel.axes[0] == "layers" else 0
    *ins, d_out = kernel.shape[lead:]
    a, b = (shape, other) if leaf == "lora_a" else (other, shape)
    head, rank = kernel.shape[:lead], a[-1]
    return a == (*head, int(np.prod(ins)), rank) and b == (*head, rank, d_out)


def load_provenance(folder: Path) -> dict[str, Any]:
    """What the config.json of a model or adapter folder says of its origin; {} if nothing."""
    record = read_json(Path(folder) / "config.json", "model config")
    found = record.get("provenance") if isinstance(record, dict) else None
    return found if isinstance(found, dict) else {}


def load_config(folder: Path) -> RoGeConfig:
    """The configuration of a model or adapter folder. Raises: UserError if its config.json is damaged or of
    another kind.
    """
    file = Path(folder) / "config.json"
    record = read_json(file, "model config")
    if not isinstance(record, dict) or "config" not in record:
        raise UserError(f"{file} is not a roge_jax model config: copy the folder again.")
    if record.get("format", 1) != 1:
        raise UserError(
            f"{file}: 'format' is {record['format']!r}, of a newer version: update roge_jax, which reads format 1."
        )
    return from_dict(record["config"], source=str(file))
