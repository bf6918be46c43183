"""The measured constants that turn a knob into a predicted error: `assets/planning.json`.

`experiments/plan_ladder.py --calibrate` measures them on procedural training scenes, one knob turned at a time, and
writes them with what produced them. Models without an entry get those of `mini` and say so.
"""

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import UserError

FILE = Path(__file__).parent.parent / "assets" / "planning.json"
DEFAULT = "mini"


@dataclass(frozen=True)
class Knob:
    """How far a knob's error follows a proxy from scene to scene: error = average * (proxy / typical)^power."""

    proxy: str
    typical: float
    power: float
    r: float = 1.0  # correlation of the logarithms over the scenes measured


def scale(knobs: tuple[Knob, ...], measured: dict[str, float]) -> float:
    """The factor of one scene, by the first of the knobs whose proxy was measured; 1 if none was."""
    for knob in knobs:
        if measured.get(knob.proxy, 0.0) > 0:
            return float((measured[knob.proxy] / knob.typical) ** knob.power)
    return 1.0


@dataclass(frozen=True)
class Step:
    """A way to sample and its RMS error against the full model's."""

    solver: str
    schedule: str
    steps: int
    evaluations: int
    error: float


@dataclass(frozen=True)
class Table:
    """RMS errors of single knobs, in colours from 0 to 1, averages (root mean square) over scenes.

    `photos`: error per square root of the share of coverage lost (a pixel is seen well or not: squares add). `merge`,
    `half`: fewer scene tokens, reconstruction at half size. `head`: frames of the RGB head in place of generated ones.
    The `_head` values hold for frames of the RGB head.
    """

    name: str
    steps: tuple[Step, ...]
    photos: float
    photos_head: float
    merge: dict[int, float]
    merge_head: dict[int, float]
    half: float
    half_head: float
    head: float
    knobs: dict[str, tuple[Knob, ...]]
    provenance: dict[str, Any]


def parse(name: str, values: dict[str, Any]) -> Table:
    """A table from its JSON form."""
    plain = dict(values)
    plain["steps"] = tuple(Step(**row) for row in values["steps"])
    plain["knobs"] = {
        knob: tuple(Knob(**row) for row in rows) for knob, rows in values["knobs"].items()
    }
    for field in ("merge", "merge_head"):
        plain[field] = {int(k): float(v) for k, v in values[field].items()}
    return Table(name=name, **plain)


@functools.cache
def load(name: str) -> Table:
    """The table of a model, by the name of its configuration; that of `mini` for models without one."""
    if not FILE.exists():
        raise UserError(
            f"{FILE}: the planner's constants are missing: run experiments/plan_ladder.py --calibrate."
        )
    tables = json.loads(FILE.read_text())
    name = name if name in tables else DEFAULT
    return parse(name, tables[name])
