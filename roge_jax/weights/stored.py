"""Where a tensor lies in a file, and reading it from there: what the readers of all formats have in common."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import ml_dtypes  # comes with JAX
import numpy as np

from ..errors import UserError

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


def check_content(file: Path) -> None:
    """Raise UserError for what stands in the place of weights that were not downloaded: a pointer to them, a web page."""
    with file.open("rb") as stream:
        start = stream.read(64)
    if start.startswith(b"version https://git-lfs"):
        raise UserError(
            f"{file} is a Git LFS pointer and not the weights that it stands for: run `git lfs pull` in its folder, or "
            "download the file with `hf download`."
        )
    if start.lstrip()[:9].lower().startswith((b"<!doctype", b"<html")):
        raise UserError(
            f"{file} is a web page and no weights, as comes where access was not granted: ask for it on the page of the "
            "model, log in with `hf auth login` and download the file again."
        )
