"""Output folders that are whole or absent, and that one run at a time writes."""

import contextlib
import hashlib
import json
import os
import shlex
import shutil
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import OutputError, UserError
from .entry import system_sentence
from .fields import is_file, read_json

RECORD = "run.json"  # what marks a folder as that of an earlier run
BLOCK_BYTES, BLOCKS = 65536, 16  # what `fingerprint` reads of a large array


@contextlib.contextmanager
def output_folder(out: str | Path, *, keep: str = "") -> Iterator[Path]:
    """A new folder to write into, renamed to `out` when the block ends and removed when it fails.

    A folder of an earlier run (it holds run.json) is replaced only then; any other folder that has files in it is
    left alone. A link to a folder stays a link. keep: the sub-folder of frames: once there are any, a failure leaves all
    that was written as OUT.unfinished. Raises: UserError if `out` cannot be used or another run is writing there, before
    anything is computed; OutputError with how to go on where something was kept.
    """
    given, out = out, _resolved(Path(out))
    part = out.with_name(out.name + ".part")
    try:
        if out.exists() and not out.is_dir():
            raise UserError(f"--out {given} is a file: give a folder.")
        if out.is_dir() and any(out.iterdir()) and not (out / RECORD).exists():
            raise UserError(
                f"--out {given} has files that are not of an earlier run (no {RECORD}): give another folder."
            )
        if out.is_mount():
            raise UserError(
                f"--out {given} is where a disk is mounted, which cannot be replaced: give a folder in it, e.g. {Path(given) / 'video'}."
            )
        if part.exists():  # of a run that was killed, or is one still going?
            with held(part, given):
                shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
    except OSError as error:
        raise UserError(
            f"--out {_shown(given)} cannot be written ({error.strerror}): give another folder."
        ) from None
    with held(part, given):
        try:
            yield part
            put(part, out)
        except BaseException as error:
            kept = _keep(part, out, keep) if keep else None
            shutil.rmtree(part, ignore_errors=True)
            if kept is None:
                raise
            told = f"{_cause(error, given)} {kept}"
            if isinstance(error, OSError | UserError | MemoryError):
                raise OutputError(told) from error
            warnings.warn(kept, stacklevel=3)  # a fault of the program, or an interruption
            raise


def _keep(part: Path, out: Path, frames: str) -> str | None:
    """Move what a failed run has finished to a name of its own, and say where it is; None if there are no frames."""
    finished = [part / frames, part / f"{frames}.part"]
    place = next((one for one in finished if one.is_dir()), None)
    count = 0 if place is None else sum(not file.name.startswith(".") for file in place.iterdir())
    if place is None or not count:
        return None
    if place != finished[0]:
        place.rename(finished[0])
    free = (out.with_name(f"{out.name}.unfinished{i}") for i in ("", *range(2, 1000)))
    kept = next(name for name in free if not name.exists())
    part.rename(kept)
    return (
        f"{count} finished frame{'s are' if count > 1 else ' is'} in {kept / frames}: once that is mended, "
        f"`python -m roge_jax.export {shlex.quote(str(kept))} --video mp4` makes the video of them."
    )


def _cause(error: BaseException, out: object) -> str:
    if isinstance(error, OSError) and error.errno is not None:
        return system_sentence(OSError(error.errno, error.strerror, error.filename or str(out)))
    if isinstance(error, MemoryError):
        return f"Out of memory ({error})."
    return f"{str(error).rstrip('.')}."


def put(temporary: Path, final: Path) -> None:
    """Rename a finished file or folder to its place; what was there is gone only then.

    The contents are on the disk before the name is, and the name is when this returns: a loss of power leaves the old
    or the new, never half of one.
    """
    old = final.with_name(final.name + ".old")
    sync(temporary)
    if temporary.is_dir():
        shutil.rmtree(old, ignore_errors=True)
        if final.exists():
            final.rename(old)
    temporary.replace(final)
    _sync_one(final.parent)
    shutil.rmtree(old, ignore_errors=True)


def share(file: Path) -> None:
    """Give a file the rights of any new one: safetensors writes files that their owner alone may read."""
    probe = file.with_name(file.name + ".rights")
    probe.touch()
    file.chmod(probe.stat().st_mode)
    probe.unlink()


def sync(path: Path) -> None:
    """A file, or a folder and all below it, is on the disk when this returns."""
    for place in [*(path.rglob("*") if path.is_dir() else []), path]:
        if place.is_file() or place.is_dir():
            _sync_one(place)


def _sync_one(path: Path) -> None:
    if os.name == "nt":  # no handle that it could be done with
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        # Some network file systems know it for files alone.
        with contextlib.suppress(OSError) if path.is_dir() else contextlib.nullcontext():
            os.fsync(handle)
    finally:
        os.close(handle)


def fingerprint(parts: Iterable[tuple[str, np.ndarray]], more: str = "", dtype: Any = None) -> str:
    """Twelve hex digits that tell contents apart: of names, shapes, dtypes and bytes of arrays, and of a text.

    Of an array above 1 MiB 16 blocks are read, evenly spaced from the first byte to the last: gigabytes of trained
    weights take a second, and a change of a few numbers alone may be missed. With `dtype` it is that of the arrays as
    they would be in it, of which no more than the blocks are made.
    """
    digest = hashlib.sha256(more.encode())
    for name, x in parts:
        kind = np.dtype(x.dtype if dtype is None else dtype)
        digest.update(f"\n{name} {x.shape} {kind}\n".encode())
        flat, item = np.ascontiguousarray(x).reshape(-1), kind.itemsize
        size = flat.size * item
        starts = [0]
        if size > BLOCKS * BLOCK_BYTES:
            starts = np.linspace(0, size - BLOCK_BYTES, BLOCKS).astype(np.int64).tolist()
        for start in starts:
            stop = size if len(starts) == 1 else start + BLOCK_BYTES
            piece = flat[start // item : -(-stop // item)].astype(kind, copy=False).view(np.uint8)
            digest.update(piece[start % item :][: stop - start].data)
    return digest.hexdigest()[:12]


def fingerprint_files(folder: Path, *patterns: str) -> str:
    """`fingerprint` of the files in a folder, by their names there: the same wherever the folder lies."""
    files = sorted({file for pattern in patterns for file in folder.glob(pattern)})
    return fingerprint((f.name, np.memmap(f, np.uint8, "r")) for f in files if f.stat().st_size)


def output_file(file: Path, option: str, *suffixes: str) -> Path:
    """`file`, whose folder now exists. Raises UserError if it cannot become a file, before anything is computed."""
    file = Path(file)
    if suffixes and file.suffix.lower() not in suffixes:
        raise UserError(
            f"{option} {_shown(file)}: give a name that ends in {' or '.join(suffixes)}."
        )
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        problem = "it is a folder" if file.is_dir() else ""
        if not problem and not os.access(file if file.exists() else file.parent, os.W_OK):
            problem = "it is not writable"
    except (OSError, ValueError) as error:
        problem = getattr(error, "strerror", None) or str(error)
    if problem:
        raise UserError(
            f"{option} {_shown(file)} cannot be written ({problem}): give another file."
        )
    return file


def check_disk(
    needed: float, folder: Path, what: str = "The model", held: Iterable[Path] = ()
) -> None:
    """Raise UserError unless the disk of `folder` has room for `needed` bytes beside those that `held` have taken."""
    place = Path(folder)
    while not place.exists():
        place = place.parent
    files = (file for one in held for file in one.rglob("*") if file.is_file())
    have = sum(512 * getattr(f.stat(), "st_blocks", 0) for f in files)
    free = shutil.disk_usage(place).free
    if needed - have > free:
        raise UserError(
            f"{what} needs {needed / 1e9:.2f} GB at {place.resolve()}, where {free / 1e9:.2f} GB are free: "
            "make room or give another --out."
        )


def keep_settings(
    folder: Path,
    settings: dict[str, Any],
    *,
    begun: bool,
    resume: bool,
    notes: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Write what a run in `folder` was started with, or hold a run that continues it (`resume`) against that.

    `begun`: whether the folder has something to continue. `notes` are written beside the settings and may differ.
    Returns what the run was started with. Raises: UserError naming the setting that differs. Settings that the file
    (settings.json) does not hold pass.
    """
    file = Path(folder) / "settings.json"
    whole = settings | (notes or {})
    if begun:
        before = read_json(file, "settings of the run") if resume and is_file(file) else whole
        if not isinstance(before, dict):
            raise UserError(
                f"{file} holds no settings of a run: delete it to continue without this check."
            )
        for name, value in settings.items():
            if name in before and before[name] != value:
                raise UserError(
                    f"{folder} holds a run with {name} {before[name]}, and {value} is asked for: continue it with the "
                    "same, or choose another --out."
                )
        return before
    write_json(file, whole)
    return whole


def write_json(file: str | Path, content: Any) -> None:
    """Strict JSON, whole or absent: NaN and infinity become null, arrays lists, folders are made."""
    file = Path(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{file.name}.{os.getpid()}.part")
    try:
        temporary.write_text(
            json.dumps(plain(content), indent=1, allow_nan=False) + "\n", encoding="utf-8"
        )
        put(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def plain(value: Any) -> Any:
    """A value as JSON has it: arrays and tuples as lists, paths as text, NaN and infinity as null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    return (
        None
        if isinstance(value, float) and (value != value or abs(value) == float("inf"))
        else value
    )


def _resolved(out: Path) -> Path:
    try:
        resolved = out.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise UserError(
            f"--out {_shown(out)} is no usable name ({error}): give a folder."
        ) from None
    if not resolved.name:
        raise UserError(f"--out {out} is the root of the file system: give a folder.")
    return resolved


def _shown(name: object) -> str:
    text = str(name)
    return text if len(text) <= 200 else f"{text[:60]}..."


@contextlib.contextmanager
def held(folder: Path, given: object) -> Iterator[None]:
    """Hold a folder's lock, which the system drops when its process ends, however it ends."""
    try:
        import fcntl
    except ImportError:  # Windows: two runs at once are not noticed
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise UserError(
            f"--out {given} is being written by another run: wait for it or give another folder."
        ) from None
    try:
        yield
    finally:
        os.close(handle)
