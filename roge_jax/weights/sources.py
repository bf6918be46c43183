"""Published weight files, read lazily: what is inside from the headers alone, values one tensor at a time.

    source = open_source(Path("Wan2.1-T2V-1.3B"))       # a file or a folder, safetensors or PyTorch's zip format
    source.tensors["head.head.weight"].shape, .dtype    # nothing has been read but headers
    value = source.read("head.head.weight")             # NumPy view of a memory-mapped piece of the file

Both formats keep every tensor as plain bytes at some place of a file, so one reader serves both: `Stored` is that
place. A mapping lives as long as the array that `read` returned, so memory holds one tensor, not the file.

PyTorch files are pickles, and a pickle can run any program. The reader here knows the handful of names that tensors
are made of and refuses everything else; it does not need PyTorch.
"""

import collections
import io
import json
import math
import operator
import pickle
import re
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import ml_dtypes  # comes with JAX
import numpy as np

from ..errors import UserError

SAFETENSORS = (".safetensors",)
TORCH = (".pth", ".pt", ".bin", ".ckpt")
INDEX = "*.safetensors.index.json"
HEADER_LIMIT = 100_000_000  # bytes, as in the safetensors library
WRAPPERS = (
    "model",
    "state_dict",
    "model_state_dict",
    "module",
)  # {"model": {key: tensor}, "step": 3}

DTYPES = {
    "F64": np.dtype(np.float64),
    "F32": np.dtype(np.float32),
    "F16": np.dtype(np.float16),
    "BF16": np.dtype(ml_dtypes.bfloat16),
    "I64": np.dtype(np.int64),
    "I32": np.dtype(np.int32),
    "I16": np.dtype(np.int16),
    "I8": np.dtype(np.int8),
    "U64": np.dtype(np.uint64),
    "U32": np.dtype(np.uint32),
    "U16": np.dtype(np.uint16),
    "U8": np.dtype(np.uint8),
    "BOOL": np.dtype(np.bool_),
    "F8_E4M3": np.dtype(ml_dtypes.float8_e4m3fn),
    "F8_E5M2": np.dtype(ml_dtypes.float8_e5m2),
}
_TORCH_STORAGES = {
    "DoubleStorage": "F64",
    "FloatStorage": "F32",
    "HalfStorage": "F16",
    "BFloat16Storage": "BF16",
    "LongStorage": "I64",
    "IntStorage": "I32",
    "ShortStorage": "I16",
    "CharStorage": "I8",
    "ByteStorage": "U8",
    "BoolStorage": "BOOL",
    "UntypedStorage": "U8",
}
_TORCH_DTYPES = {
    "uint16": "U16",
    "uint32": "U32",
    "uint64": "U64",
    "float8_e4m3fn": "F8_E4M3",
    "float8_e5m2": "F8_E5M2",
}
# Kinds of numbers that no weights here are of: complex, quantised, other floats of 8 bits.
_OTHER_KINDS = re.compile(r"([A-Z]\w+)Storage|((?:complex|float|bits|quint|qint)\d+\w*)")


class Stored(NamedTuple):
    """Where one tensor is: `shape` elements of `dtype` from byte `offset` of `file`, `strides` elements apart.

    NumPy takes it for an array: `np.asarray(stored)` is `stored.read()`.
    """

    file: Path
    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype
    strides: tuple[int, ...] | None = None  # None: contiguous, last axis fastest

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor."""
        return math.prod(self.shape) * self.dtype.itemsize

    def read(self) -> np.ndarray:
        """The tensor as it is stored, read-only: its pages come from the file when they are touched."""
        if not math.prod(self.shape):
            return np.zeros(self.shape, self.dtype)
        if self.strides is None:
            return np.asarray(np.memmap(self.file, self.dtype, "r", self.offset, self.shape))
        extent = 1 + sum((n - 1) * s for n, s in zip(self.shape, self.strides, strict=True))
        flat = np.asarray(np.memmap(self.file, self.dtype, "r", self.offset, (extent,)))
        steps = tuple(s * self.dtype.itemsize for s in self.strides)
        return np.lib.stride_tricks.as_strided(flat, self.shape, steps, writeable=False)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.read(), dtype, copy=copy)


class Source(NamedTuple):
    """All tensors of one checkpoint, which may span files."""

    path: Path
    tensors: dict[str, Stored]

    @property
    def files(self) -> list[Path]:
        """The files that hold the tensors."""
        return sorted({t.file for t in self.tensors.values()})

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """{key: shape}."""
        return {key: t.shape for key, t in self.tensors.items()}

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return sum(t.nbytes for t in self.tensors.values())

    def read(self, key: str) -> np.ndarray:
        """`Stored.read` of a tensor."""
        return self.tensors[key].read()


def open_source(path: str | Path) -> Source:
    """Read the headers of a checkpoint: a safetensors or PyTorch file, or a folder of (sharded) safetensors.

    Raises: UserError, in one sentence, for anything missing, truncated or not a checkpoint.
    """
    path = Path(path)
    if path.is_dir():
        return Source(path, _folder(path))
    if not path.exists():
        raise UserError(
            f"{path} does not exist: give a checkpoint file or the folder it was downloaded to."
        )
    if path.name.endswith(".index.json"):
        return Source(path, _indexed(path))
    if path.suffix in SAFETENSORS:
        return Source(path, read_safetensors_header(path))
    if path.suffix in TORCH:
        return Source(path, read_torch_header(path))
    allowed = ", ".join(SAFETENSORS + TORCH)
    raise UserError(f"{path} is no weight file by its name: give one of {allowed}, or a folder.")


# ---- safetensors ---------------------------------------------------------------------------------


def read_safetensors_header(file: Path) -> dict[str, Stored]:
    """{key: place} of a safetensors file, checked against the size of the file."""
    try:
        size, stream = file.stat().st_size, file.open("rb")
    except OSError as error:
        raise UserError(f"{file} cannot be read ({error.strerror}): copy it again.") from None
    with stream as f:
        start = f.read(8)
        length = int.from_bytes(start, "little") if len(start) == 8 else HEADER_LIMIT + 1
        if length > HEADER_LIMIT:
            raise UserError(
                f"{file} is not a safetensors file (or only its beginning): download it again."
            )
        if size < 8 + length:
            raise UserError(
                f"{file} is truncated ({size} bytes, its header alone needs {8 + length}): copy it again."
            )
        try:
            header = json.loads(f.read(length))
            header.pop("__metadata__", None)
            tensors = {key: _stored(file, 8 + length, key, entry) for key, entry in header.items()}
        except (ValueError, AttributeError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, UserError):
                raise
            raise UserError(
                f"{file} has no readable safetensors header ({error}): download it again."
            ) from None
    end = max((t.offset + t.nbytes for t in tensors.values()), default=8 + length)
    if size > end:
        raise UserError(
            f"{file} has {size - end} bytes behind its last tensor: it is not what its header says; download it again."
        )
    if size < end:
        raise UserError(
            f"{file} is truncated: {size} bytes of {end}, and {_first_beyond(tensors, size)} is cut off; copy it again."
        )
    return tensors


def _first_beyond(tensors: Mapping[str, Stored], size: int) -> str:
    beyond = [key for key, t in tensors.items() if t.offset + t.nbytes > size]
    return f"tensor '{min(beyond, key=lambda key: tensors[key].offset)}'"


def _stored(file: Path, base: int, key: str, entry: dict) -> Stored:
    if entry["dtype"] not in DTYPES:
        raise UserError(f"{file}: tensor '{key}' has dtype {entry['dtype']}, which cannot be read.")
    begin, end = entry["data_offsets"]
    stored = Stored(
        file, base + begin, tuple(map(operator.index, entry["shape"])), DTYPES[entry["dtype"]]
    )
    if begin < 0 or min(stored.shape, default=0) < 0 or end - begin != stored.nbytes:
        raise UserError(
            f"{file}: tensor '{key}' of shape {stored.shape} does not fill its {end - begin} bytes."
        )
    return stored


def _folder(folder: Path) -> dict[str, Stored]:
    indexes = sorted(folder.glob(INDEX))
    if len(indexes) == 1:
        return _indexed(indexes[0])
    files = sorted(folder.glob("*.safetensors"))
    kinds = {re.sub(r"-\d+-of-(\d+)$", r"/\1", f.stem) for f in files}
    if len(kinds) == 1 and not indexes and "/" in (kind := kinds.pop()):
        return _shards(folder, files, int(kind.rpartition("/")[2]))
    if len(indexes) > 1 or len(files) > 1:
        names = ", ".join(f.name for f in indexes or files)
        raise UserError(
            f"{folder} holds more than one checkpoint ({names}): give one of these files."
        )
    if files:
        return read_safetensors_header(files[0])
    torch = sorted(f for f in folder.iterdir() if f.suffix in TORCH)
    if len(torch) == 1:
        return read_torch_header(torch[0])
    found = ", ".join(f.name for f in torch) or "none"
    raise UserError(
        f"{folder} holds no safetensors (PyTorch files there: {found}): give the weight file itself."
    )


def _shards(folder: Path, files: list[Path], count: int) -> dict[str, Stored]:
    """Shards named -00001-of-0000n without an index."""
    have = {int(f.stem.rpartition("-of-")[0].rpartition("-")[2]) for f in files}
    lost = sorted(set(range(1, count + 1)) - have)
    if lost:
        raise UserError(
            f"{folder} is incomplete: shard {lost[0]} of {count} is missing ({len(lost)} in all)."
        )
    tensors: dict[str, Stored] = {}
    for file in files:
        tensors |= read_safetensors_header(file)
    return tensors


def _indexed(index: Path) -> dict[str, Stored]:
    try:
        files: dict[str, str] = json.loads(index.read_text())["weight_map"]
        names = sorted(set(files.values()))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{index} is not an index of safetensors shards ({error!r}): download it again."
        ) from None
    unsafe = [name for name in names if Path(name).name != name]
    if unsafe:
        raise UserError(
            f"{index} points outside its own folder ('{unsafe[0]}'): download it again."
        )
    lost = [name for name in names if not (index.parent / name).exists()]
    if lost:
        raise UserError(
            f"{index.parent} is incomplete: {', '.join(lost)} missing ({index.name} lists them)."
        )
    tensors: dict[str, Stored] = {}
    for name in names:
        shard = read_safetensors_header(index.parent / name)
        absent = [key for key, file in files.items() if file == name and key not in shard]
        if absent:
            raise UserError(
                f"{index.parent / name} lacks tensor '{absent[0]}', which {index.name} says it holds."
            )
        # Of a tensor in several shards the index says which; one that it does not list is somebody's mistake to report.
        tensors |= {key: place for key, place in shard.items() if files.get(key, name) == name}
    return tensors


# ---- PyTorch's zip format ------------------------------------------------------------------------


class _Storage(NamedTuple):
    offset: int
    dtype: np.dtype
    elements: int


def read_torch_header(file: Path) -> dict[str, Stored]:
    """{key: place} of a PyTorch file (`torch.save` of version 1.6 or later), without PyTorch and without trust."""
    try:
        archive = zipfile.ZipFile(file)
    except zipfile.BadZipFile:
        with file.open("rb") as f:
            cut = f.read(2) == b"PK"
        what = "is not a PyTorch zip file (saved before version 1.6, or damaged)"
        what = "is truncated" if cut else what
        raise UserError(f"{file} {what}: download it again, or save it as safetensors.") from None
    with archive:
        names = archive.namelist()
        pickles = [name for name in names if name.endswith("/data.pkl") and name.count("/") == 1]
        if len(pickles) != 1:
            raise UserError(f"{file} is a zip file, but no PyTorch checkpoint: it has no data.pkl.")
        root = pickles[0].removesuffix("data.pkl")
        places = {i.filename.removeprefix(root + "data/"): i for i in archive.infolist()}
        order = f"{root}byteorder"
        if order in names and archive.read(order) != b"little":
            raise UserError(
                f"{file} was written on a big-endian machine: save it again on a usual one."
            )
        try:
            content = _Unpickler(file, archive.read(pickles[0]), places).load()
        except UserError:
            raise
        except Exception as error:  # a damaged pickle can fail in any way
            raise UserError(
                f"{file} cannot be read ({type(error).__name__}: {error}): download it again."
            ) from None
    tensors = _find_tensors(content)
    if not tensors:
        raise UserError(
            f"{file} holds no tensors by name: give the weights, not the optimiser or a whole module."
        )
    return tensors


def _find_tensors(content: Any) -> dict[str, Stored]:
    if not isinstance(content, dict):
        return {}
    for name in WRAPPERS:
        if isinstance(content.get(name), dict):
            return _find_tensors(content[name])
    return {key: t for key, t in content.items() if isinstance(key, str) and isinstance(t, Stored)}


class _Unpickler(pickle.Unpickler):
    """Knows how tensors are put together, and nothing else. Names are looked up here, never imported."""

    def __init__(self, file: Path, data: bytes, places: Mapping[str, zipfile.ZipInfo]):
        super().__init__(io.BytesIO(data))
        self.file, self.places = file, places
        self.opened: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        if module in ("torch", "torch.storage") and name in _TORCH_STORAGES:
            return _TORCH_STORAGES[name]
        if module == "torch" and name in _TORCH_DTYPES:
            return _TORCH_DTYPES[name]
        known = {
            ("collections", "OrderedDict"): collections.OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): lambda *args: self._tensor(*args[:4]),
            ("torch._utils", "_rebuild_tensor_v3"): lambda *args: self._typed(
                args[0], args[1], args[2], args[3], args[6]
            ),
            ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
            ("torch", "Size"): lambda sizes=(): tuple(sizes),
        }
        if module in ("torch", "torch.storage") and (kind := _OTHER_KINDS.fullmatch(name)):
            raise UserError(
                f"{self.file} has tensors of type {kind[1] or kind[2]}, which cannot be read: save them as float32, bfloat16 or float16."
            )
        if (module, name) not in known:
            raise UserError(
                f"{self.file} tries to execute code: it asks for '{module}.{name}', which no weights need; "
                "do not load it anywhere, and take the file from its publisher."
            )
        return known[module, name]

    def persistent_load(self, pid: Any) -> _Storage:
        kind, dtype, key, _, count = pid
        if kind != "storage" or dtype not in DTYPES:
            raise ValueError(f"storage {pid!r}")
        if key not in self.opened:
            self.opened[key] = self._storage(str(key), DTYPES[dtype], int(count))
        return self.opened[key]

    def _storage(self, key: str, dtype: np.dtype, count: int) -> _Storage:
        if key not in self.places:
            raise UserError(
                f"{self.file} is incomplete: its storage '{key}' is missing; download it again."
            )
        info = self.places[key]
        if info.compress_type != zipfile.ZIP_STORED:
            raise UserError(
                f"{self.file} is compressed, unlike PyTorch's own files: unpack and save it again."
            )
        if count * dtype.itemsize > info.file_size:
            raise UserError(
                f"{self.file} is damaged: storage '{key}' is shorter than its {count} elements."
            )
        with self.file.open(
            "rb"
        ) as f:  # bytes begin after the local header: the index lacks its length
            f.seek(info.header_offset)
            local = f.read(30)
        if local[:4] != b"PK\x03\x04":
            raise UserError(
                f"{self.file} is damaged: storage '{key}' is not where its index says; download it again."
            )
        name, extra = struct.unpack("<HH", local[26:30])
        return _Storage(info.header_offset + 30 + name + extra, dtype, count)

    def _typed(self, storage: _Storage, start: int, shape, strides, dtype: str) -> Stored:
        """Kinds of numbers younger than PyTorch's typed storages: their storage counts bytes."""
        kind = DTYPES[dtype]
        elements = storage.elements * storage.dtype.itemsize // kind.itemsize
        return self._tensor(_Storage(storage.offset, kind, elements), start, shape, strides)

    def _tensor(
        self, storage: _Storage, start: int, shape: tuple[int, ...], strides: tuple[int, ...]
    ) -> Stored:
        shape, strides = tuple(map(int, shape)), tuple(map(int, strides))
        last = sum((n - 1) * s for n, s in zip(shape, strides, strict=True))
        inside = start >= 0 and min((*shape, *strides), default=0) >= 0
        if not inside or (0 not in shape and start + last >= storage.elements):
            raise UserError(
                f"{self.file} is damaged: a tensor of shape {shape} reaches outside its storage."
            )
        contiguous = [1]  # from the last axis on; Python's integers do not overflow
        for n in shape[:0:-1]:
            contiguous.insert(0, n * contiguous[0])
        plain = all(n == 1 or s == c for n, s, c in zip(shape, strides, contiguous))
        offset = storage.offset + start * storage.dtype.itemsize
        return Stored(self.file, offset, shape, storage.dtype, None if plain else strides)
