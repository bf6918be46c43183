"""PyTorch's zip files, without PyTorch and without trust: what is inside from their pickle alone.

Such a file is a pickle, and a pickle can run any program. The reader here knows the handful of names that tensors are
made of and refuses everything else.
"""

import collections
import io
import pickle
import re
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from ..errors import UnsafeFile, UserError
from .stored import DTYPES, Stored, check_content

WRAPPERS = (
    "model",
    "state_dict",
    "model_state_dict",
    "module",
)  # {"model": {key: tensor}, "step": 3}
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


class _Storage(NamedTuple):
    offset: int
    dtype: np.dtype
    elements: int


def read_torch_header(file: Path) -> dict[str, Stored]:
    """{key: place} of a PyTorch file (`torch.save` of version 1.6 or later), without PyTorch and without trust."""
    tensors = _find_tensors(read_torch_content(file))
    if not tensors:
        raise UserError(
            f"{file} holds no tensors by name: give the weights, not the optimiser or a whole module."
        )
    return tensors


def read_torch_content(file: Path) -> Any:
    """What `torch.save` was given, of dicts, lists, numbers and texts, with `Stored` for every tensor.

    Raises: UnsafeFile if the file asks for anything but that; UserError if it is damaged or no such file.
    """
    check_content(file)
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
            with file.open("rb") as stream:
                return _Unpickler(file, archive.read(pickles[0]), places, stream).load()
        except UserError:
            raise
        except Exception as error:  # a damaged pickle can fail in any way
            raise UserError(
                f"{file} cannot be read ({type(error).__name__}: {error}): download it again."
            ) from None


def _find_tensors(content: Any) -> dict[str, Stored]:
    if not isinstance(content, dict):
        return {}
    for name in WRAPPERS:
        if isinstance(content.get(name), dict):
            return _find_tensors(content[name])
    return {key: t for key, t in content.items() if isinstance(key, str) and isinstance(t, Stored)}


class _Unpickler(pickle.Unpickler):
    """Knows how tensors are put together, and nothing else. Names are looked up here, never imported."""

    def __init__(
        self, file: Path, data: bytes, places: Mapping[str, zipfile.ZipInfo], stream: BinaryIO
    ):
        super().__init__(io.BytesIO(data))
        self.file, self.places, self.stream = file, places, stream
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
            raise UnsafeFile(
                f"{self.file} tries to execute code: it asks for '{module}.{name}', which no tensors need; "
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
        # Bytes begin after the local header: the index lacks its length.
        self.stream.seek(info.header_offset)
        local = self.stream.read(30)
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
