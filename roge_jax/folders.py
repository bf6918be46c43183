"""Output folders that are whole or absent, and that one run at a time writes."""

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .errors import UserError
from .fields import is_file, read_json

RECORD = "run.json"  # what marks a folder as that of an earlier run


@contextlib.contextmanager
def output_folder(out: str | Path) -> Iterator[Path]:
    """A new folder to write into, renamed to `out` when the block ends and removed when it fails.

    A folder of an earlier run (it holds run.json) is replaced only then; any other folder that has files in it is
    left alone. A link to a folder stays a link. Raises: UserError if `out` cannot be used or another run is writing
    there, before anything is computed.
    """
    given, out = out, _resolved(Path(out))
    part, old = (out.with_name(out.name + suffix) for suffix in (".part", ".old"))
    try:
        if out.exists() and not out.is_dir():
            raise UserError(f"--out {given} is a file: give a folder.")
        if out.is_dir() and any(out.iterdir()) and not (out / RECORD).exists():
            raise UserError(
                f"--out {given} has files that are not of an earlier run (no {RECORD}): give another folder."
            )
        if part.exists():  # of a run that was killed, or is one still going?
            with _held(part, given):
                shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
    except OSError as error:
        raise UserError(
            f"--out {_shown(given)} cannot be written ({error.strerror}): give another folder."
        ) from None
    with _held(part, given):
        try:
            yield part
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        shutil.rmtree(old, ignore_errors=True)
        if out.exists():
            out.rename(old)
        part.rename(out)
        shutil.rmtree(old, ignore_errors=True)


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


def keep_settings(folder: Path, settings: dict[str, Any], *, begun: bool, resume: bool) -> None:
    """Write what a run in `folder` was started with, or hold a run that continues it (`resume`) against that.

    `begun`: whether the folder has something to continue. Raises: UserError naming the setting that differs. Runs
    without the file (settings.json) pass.
    """
    file = Path(folder) / "settings.json"
    if begun:
        before = read_json(file, "settings of the run") if resume and is_file(file) else settings
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
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_suffix(".json.part")
    temporary.write_text(json.dumps(settings, indent=1) + "\n")
    temporary.replace(file)


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
def _held(folder: Path, given: object) -> Iterator[None]:
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
