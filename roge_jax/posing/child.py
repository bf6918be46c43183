"""Runs `posing.mapper` in a process of its own, and turns whatever becomes of it into a result or one sentence."""

import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..files.folders import write_json
from .mapper import Job

LEAST = (4, 2)  # of pycolmap: its first version with the global mapper
LOW = 64e6  # bytes that must stay free: COLMAP waits for ever on a full disc
CURE = "pip install 'roge_jax[pose]'"

Progress = Callable[[str, int, int], None]


def check_pycolmap() -> str:
    """The version of pycolmap. Raises: UserError if it is missing or too old."""
    if importlib.util.find_spec("pycolmap") is None:
        raise UserError(f"Poses are found by pycolmap, which is not installed: {CURE}")
    version = importlib.metadata.version("pycolmap")
    if tuple(int(part) for part in version.split(".")[:2] if part.isdecimal()) < LEAST:
        raise UserError(
            f"pycolmap {version} is installed, {'.'.join(map(str, LEAST))} or newer is needed: {CURE} --upgrade"
        )
    return version


def threads() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def solve(folder: Path, job: Job, progress: Progress) -> dict[str, Any]:
    """What `mapper.run` found in `folder`, which has copies/ and gets model/ if there is a solution.

    Raises: UserError if the disc gets full or the process ends before its time.
    """
    write_json(folder / "job.json", dataclasses.asdict(job))
    lines: queue.Queue[str | None] = queue.Queue()
    package = Path(__file__).resolve().parents[2]
    paths = os.pathsep.join(filter(None, [str(package), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-P", "-m", f"{__package__}.mapper", str(folder)]
    with (
        (folder / "log.txt").open("wb") as log,
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env=os.environ | {"PYTHONPATH": paths},
            start_new_session=True,  # Ctrl-C is this process's business
        ) as process,
    ):

        def listen() -> None:
            assert process.stdout is not None
            for line in process.stdout:
                lines.put(line)
            lines.put(None)

        listener = threading.Thread(target=listen, daemon=True)
        listener.start()
        try:
            _follow(lines, folder, progress)
            code = process.wait()
        finally:
            process.kill()
            listener.join()
    if code:
        _check_room(folder)
        said = _last_words(folder / "log.txt", code)
        raise UserError(f"pycolmap stopped ({said}): try fewer photos or a smaller --size.")
    return json.loads((folder / "found.json").read_text(encoding="utf-8"))


def _follow(lines: "queue.Queue[str | None]", folder: Path, progress: Progress) -> None:
    """Pass progress on until the process has nothing more to say, and look at the disc meanwhile."""
    while True:
        try:
            line = lines.get(timeout=0.5)
        except queue.Empty:
            _check_room(folder)
            continue
        if line is None:
            return
        if line.startswith("{"):
            told = json.loads(line)
            progress(told["stage"], told["done"], told["total"])


def _check_room(folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if free < LOW:
        raise UserError(
            f"--out: only {free / 1e6:.0f} MB are left on its disc while photos are matched: free some space, give "
            "another --out, or a smaller --size."
        )


def _last_words(log: Path, code: int) -> str:
    """The last line of what native code or Python said, or how the process ended."""
    text = log.read_text(encoding="utf-8", errors="replace")
    said = [line for line in text.splitlines() if line.strip()]
    plain = [line for line in said if not line.lstrip().startswith(("@", "***", "File", "PC:"))]
    return plain[-1].strip()[:200] if plain else f"exit code {code}"
