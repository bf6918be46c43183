"""What all experiments share: seeds, timing in turns, the record of a run, JSON, tables in pages, the style of charts.

JAX is imported when something needs it: a program may still choose its devices and XLA's flags.
"""

import argparse
import io
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from roge_jax.files import entry
from roge_jax.files.folders import plain

ROOT = Path(__file__).resolve().parents[1]
RESULTS, DOCS = ROOT / "experiments" / "results", ROOT / "docs"


def parser(description: str | None) -> argparse.ArgumentParser:
    """With the head of the program's file as its help."""
    name, layout = " ".join(command()[:3]), argparse.RawTextHelpFormatter
    return argparse.ArgumentParser(name, description=description, formatter_class=layout)


def heldout(scenes: int, first: int = 0) -> range:
    """Seeds of procedural scenes that no training sees."""
    from roge_jax.procedural.scenes import HELDOUT_SEED

    return range(HELDOUT_SEED + first, HELDOUT_SEED + first + scenes)


# ---- timing --------------------------------------------------------------------------------------


class Seconds(NamedTuple):
    """Of the processor, which other programs disturb least, and of the clock on the wall."""

    cpu: Any
    wall: Any


def timed(call: Callable[[], Any]) -> Seconds:
    """One call, until its result is there."""
    import jax

    cpu, wall = time.process_time(), time.perf_counter()
    jax.block_until_ready(call())
    return Seconds(time.process_time() - cpu, time.perf_counter() - wall)


def in_turn(calls: Mapping[str, Callable[[], Any]], rounds: int) -> Seconds:
    """{name: [rounds]} of either clock: every call once a round, so that drifts of a shared machine hit all of them.

    Every second round goes backwards. Nothing may compile any more: call each of them before.
    """
    found: Seconds = Seconds({name: [] for name in calls}, {name: [] for name in calls})
    for i in range(rounds):
        for name in calls if i % 2 == 0 else reversed(calls):
            for clock, value in zip(found, timed(calls[name]), strict=True):
                clock[name].append(value)
    return found


def compare(calls: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, dict]:
    """Processor seconds of calls in turn, and their ratios within a round to the first of them: medians, quartiles."""
    for call in calls.values():
        call()
    seconds = in_turn(calls, rounds).cpu
    reference, found = np.array(seconds[next(iter(calls))]), {}
    for name, values in seconds.items():
        (low, median, high), ratio = quartiles(values, 4), quartiles(values / reference, 3)
        found[name] = {
            "seconds": median,
            "quartiles": [low, high],
            "minimum": round(min(values), 4),
            "ratio": ratio[1],
            "ratio_quartiles": [ratio[0], ratio[2]],
        }
        print(f"  {name:36s} {median:8.4f} s   x{ratio[1]:.2f}", flush=True)
    return found


def quartiles(values: Any, decimals: int) -> list[float]:
    return [round(float(x), decimals) for x in np.percentile(values, [25, 50, 75])]


def summary(values: Sequence[float]) -> dict[str, float]:
    return {"median": float(np.median(values)), "low": min(values), "high": max(values)}


# ---- the record of a run -------------------------------------------------------------------------


def command() -> list[str]:
    """How this program was called."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    program = ["python", "-m", spec.name.removesuffix(".__main__")] if spec else [sys.argv[0]]
    return [*program, *sys.argv[1:]]


def processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def environment() -> dict[str, Any]:
    """Time, command, versions, commit and device, what the processor is, how many cores and how busy they are."""
    import jax  # noqa: F401  the record names its devices

    return entry.environment() | {
        "command": command(),
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "load_average": os.getloadavg(),
    }


def child(module: str, *words: str, **settings: str) -> dict[str, Any]:
    """What a program of this folder prints as its last line, JSON, in a process of its own with these variables."""
    said = subprocess.run(
        [sys.executable, "-m", module, *words],
        env=os.environ | settings,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(said.stdout.splitlines()[-1])


# ---- results -------------------------------------------------------------------------------------


def place(name: str | Path) -> Path:
    """Words name a file of the results, a path is taken as it is."""
    return RESULTS / name if isinstance(name, str) else name


def read(name: str | Path, absent: Any = None) -> Any:
    """A JSON file; what stands for a missing one, if something may."""
    file = place(name)
    return absent if absent is not None and not file.exists() else json.loads(file.read_text())


def rounded(value: Any, digits: int) -> Any:
    """As JSON has it (NaN is null), floats to so many digits: more than the noise is worth nothing."""
    short = lambda text: float(f"{float(text):.{digits}g}")  # noqa: E731
    return json.loads(json.dumps(plain(value)), parse_float=short)


def write(name: str | Path, content: Any, digits: int | None = None) -> None:
    """A JSON file, whole or absent: others may read it meanwhile.

    With `digits` numbers are rounded, and nothing is indented: for files of many numbers.
    """
    file = place(name)
    file.parent.mkdir(parents=True, exist_ok=True)
    content = plain(content) if digits is None else rounded(content, digits)
    layout: dict[str, Any] = {"indent": 1} if digits is None else {"separators": (",", ":")}
    part = file.with_suffix(".part")
    part.write_text(json.dumps(content, allow_nan=False, **layout) + "\n")
    part.replace(file)


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    """The lines of a Markdown table."""
    head, *lines = ("| " + " | ".join(map(str, row)) + " |" for row in (columns, *rows))
    return [head, "|---" * len(columns) + "|", *lines]


def put(page: Path, name: str, text: str) -> None:
    """Write what stands between the marks of an experiment in a page."""
    begin, end = f"<!-- {name}: written by the experiment -->", f"<!-- /{name} -->"
    head, found, rest = page.read_text().partition(begin)
    _, closed, tail = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page}: needs the lines {begin} and {end}.")
    page.write_text(f"{head}{begin}\n\n{text}\n\n{end}{tail}")


# ---- charts --------------------------------------------------------------------------------------

STYLE = {
    "axes.grid": True,
    "axes.titlesize": 10,
    "grid.alpha": 0.25,
    "legend.edgecolor": "none",
    "legend.fontsize": 8,
}


def pyplot() -> Any:
    """matplotlib's, without a screen and in the style of all charts."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update(STYLE)
    return plt


def save(figure: Any, name: str | Path, dpi: int = 80) -> None:
    """The end of a figure, as a PNG of 256 colours: half the size, the same picture."""
    from PIL import Image

    raw = io.BytesIO()
    figure.savefig(raw, dpi=dpi)
    Image.open(raw).convert("RGB").quantize(256).save(place(name), optimize=True)
    pyplot().close(figure)
