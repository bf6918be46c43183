"""Published weight files, read lazily: what is inside from the headers alone, values one tensor at a time.

    source = open_source(Path("Wan2.1-T2V-1.3B"))       # a file or a folder, safetensors or PyTorch's zip format
    source.tensors["head.head.weight"].shape, .dtype    # nothing has been read but headers
    value = source.read("head.head.weight")             # NumPy view of a memory-mapped piece of the file

Both formats keep every tensor as plain bytes at some place of a file, so one reader serves both: `Stored` is that
place. A mapping lives as long as the array that `read` returned, so memory holds one tensor, not the file.

PyTorch files are pickles, which can run any program; `weights.pytorch` reads tensors of them and refuses everything else.
"""

import json
import operator
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import UserError
from .catalogue import BY_NAME, how_to_get, name_of
from .pytorch import read_torch_header
from .stored import DTYPES as DTYPES
from .stored import Stored as Stored
from .stored import check_content

SAFETENSORS = (".safetensors",)
TORCH = (".pth", ".pt", ".bin", ".ckpt")
INDEX = "*.safetensors.index.json"
HEADER_LIMIT = 100_000_000  # bytes, as in the safetensors library


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
        check_content(file)
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
    if not torch:
        what, cure = _instead(folder)
        raise UserError(f"{folder} holds no weights ({what}): {cure}.")
    found = ", ".join(f.name for f in torch)
    raise UserError(
        f"{folder} holds no safetensors (PyTorch files there: {found}): give the weight file itself."
    )


def _instead(folder: Path) -> tuple[str, str]:
    """What a folder has in place of weights, and what to do."""
    known = BY_NAME.get(name_of(folder) or "")
    unfinished = (".cache/huggingface/download", "../../blobs")
    if any(any((folder / place).glob("**/*.incomplete")) for place in unfinished):
        again = f"`{known.command}`" if known else "the same `hf download` command"
        return "their download was not finished", f"go on with it by {again}"
    cure = how_to_get(known) if known else "give the folder that the weights were downloaded to"
    names = sorted(f.name for f in folder.iterdir() if not f.name.startswith("."))
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"only {shown}" if names else "it is empty", cure


def _shards(folder: Path, files: list[Path], count: int) -> dict[str, Stored]:
    """Shards named -00001-of-0000n without an index."""
    have = {int(f.stem.rpartition("-of-")[0].rpartition("-")[2]) for f in files}
    lost = sorted(set(range(1, count + 1)) - have)
    if lost:
        raise UserError(
            f"{folder} is incomplete: shard {lost[0]} of {count} is missing ({len(lost)} in all): download the rest."
        )
    tensors: dict[str, Stored] = {}
    for file in files:
        tensors |= read_safetensors_header(file)
    return tensors


def _indexed(index: Path) -> dict[str, Stored]:
    try:
        files: dict[str, str] = json.loads(index.read_text(encoding="utf-8"))["weight_map"]
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
            f"{index.parent} is incomplete: {', '.join(lost)} missing ({index.name} lists them): download the rest."
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
