"""Writing a model folder piece by piece: headers first, then every layer of every leaf at its place.

    layout = plan_shards({"dit/head/linear/kernel": ((64, 16), bfloat16), ..}, shard_bytes=4e9)
    shards = Shards(folder, layout)          # files of final size, space reserved
    shards.write("dit/blocks/ffn/fc1/kernel", layer_7, layer=7)

The files are ordinary safetensors, the ones `checkpoint.load_model` reads.
"""

import contextlib
import errno
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import UserError
from .sources import DTYPES

NAMES = {dtype: name for name, dtype in DTYPES.items()}
SHARD_BYTES = 4_000_000_000
BLOCK_BYTES = 64_000_000  # converted at a time
TILE = 256  # rows and columns copied at a time when transposing


class Place(NamedTuple):
    """Where a leaf lies."""

    shard: int
    offset: int  # in the file
    shape: tuple[int, ...]
    dtype: np.dtype


class Layout(NamedTuple):
    """The files of a model folder before they are written: headers, sizes, and the place of every leaf."""

    headers: list[bytes]
    sizes: list[int]  # bytes of each file
    places: dict[str, Place]

    def name(self, shard: int) -> str:
        """File name of shard number `shard`, from 0."""
        return f"model-{shard + 1:05d}-of-{len(self.sizes):05d}.safetensors"


def plan_shards(
    leaves: Mapping[str, tuple[tuple[int, ...], np.dtype]],
    shard_bytes: float = SHARD_BYTES,
    *,
    signed: bool = True,
) -> Layout:
    """Distribute leaves over files of at most `shard_bytes`; a leaf larger than that has a file of its own.

    The places are in the order in which the bytes lie. `signed`: headers name this package.
    """
    groups: list[list[str]] = [[]]
    room = shard_bytes
    for path, (shape, dtype) in leaves.items():
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if groups[-1] and size > room:
            groups.append([])
            room = shard_bytes
        groups[-1].append(path)
        room -= size
    headers, sizes, places = [], [], {}
    for shard, paths in enumerate(groups):
        # Wide types first: every tensor then starts at a multiple of its element.
        paths = sorted(paths, key=lambda path: (-np.dtype(leaves[path][1]).itemsize, path))
        entries: dict[str, dict] = {}
        end = 0
        for path in paths:
            shape, dtype = leaves[path]
            begin, end = end, end + math.prod(shape) * np.dtype(dtype).itemsize
            entries[path] = {
                "dtype": NAMES[np.dtype(dtype)],
                "shape": list(shape),
                "data_offsets": [begin, end],
            }
        name = {"__metadata__": {"format": "roge_jax"}} if signed else {}
        text = json.dumps(name | entries, separators=(",", ":"))
        header = text.encode() + b" " * (-len(text.encode()) % 8)
        headers.append(len(header).to_bytes(8, "little") + header)
        sizes.append(len(headers[-1]) + end)
        for path in paths:
            offset = len(headers[-1]) + entries[path]["data_offsets"][0]
            places[path] = Place(shard, offset, tuple(leaves[path][0]), np.dtype(leaves[path][1]))
    return Layout(headers, sizes, places)


class Shards:
    """The files of a layout, open for writing. Opening them again (`fresh=False`) keeps what they hold."""

    def __init__(self, folder: Path, layout: Layout, *, fresh: bool = True):
        self.layout = layout
        self.files = []
        try:
            for i, (header, size) in enumerate(zip(layout.headers, layout.sizes, strict=True)):
                self.files.append(
                    (folder / layout.name(i)).open("wb" if fresh else "r+b", buffering=0)
                )
                if fresh:
                    self.files[i].truncate(size)
                    if hasattr(os, "posix_fallocate"):
                        os.posix_fallocate(self.files[i].fileno(), 0, size)
                    _write_all(self.files[i], header)
        except OSError as error:
            self.close()
            _disk(error, folder)

    def write(self, path: str, value: np.ndarray, layer: int | None = None) -> None:
        """Write a whole leaf, or one layer of a stacked one, in the leaf's dtype (rounded to nearest even).

        Raises: FloatingPointError at the first block with NaN or infinity.
        """
        place = self.layout.places[path]
        shape = place.shape if layer is None else place.shape[1:]
        assert value.shape == shape, (path, value.shape, shape)
        file = self.files[place.shard]
        size = math.prod(shape) * place.dtype.itemsize
        rows = max(1, BLOCK_BYTES * shape[0] // max(size, 1))
        try:
            file.seek(place.offset + (layer or 0) * size)
            for i in range(0, shape[0], rows):
                # First cast in the order of the source, then transpose: both copies are of one block alone.
                block = value[i : i + rows].astype(place.dtype, order="K", copy=False)
                block = _contiguous(block)
                if not finite(block):
                    raise FloatingPointError(path)
                _write_all(file, block.reshape(-1).view(np.uint8))
        except OSError as error:
            _disk(error, Path(file.name))

    def flush(self) -> None:
        """Everything written so far is on the disk when this returns."""
        for file in self.files:
            os.fsync(file.fileno())

    def close(self) -> None:
        """Close all files; what was written stays."""
        for file in self.files:
            with contextlib.suppress(OSError):
                file.close()


def _contiguous(x: np.ndarray) -> np.ndarray:
    """`np.ascontiguousarray`, several times as fast for large transposed matrices: tile by tile stays in the cache."""
    if x.ndim != 2 or x.flags.c_contiguous or x.size < TILE**2:
        return np.ascontiguousarray(x)
    y = np.empty(x.shape, x.dtype)
    for i in range(0, x.shape[0], TILE):
        for j in range(0, x.shape[1], TILE):
            y[i : i + TILE, j : j + TILE] = x[i : i + TILE, j : j + TILE]
    return y


def finite(x: np.ndarray) -> bool:
    """Whether no number is NaN or infinite."""
    if x.dtype.itemsize == 2 and x.dtype != np.float16:  # bfloat16, whose own test is slow
        return not x.size or bool((x.view(np.uint16) & 0x7F80).max() < 0x7F80)
    return bool(np.isfinite(x).all())


def _write_all(file, data) -> None:
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def _disk(error: OSError, place: Path) -> None:
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        raise UserError(
            f"The disk is full at {place}: free some space or give another --out."
        ) from None
    raise error
