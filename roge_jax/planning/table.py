"""The measured constants that turn a knob into a predicted error: `assets/planning.json`.

`python -m experiments.planning.ladder --calibrate` measures them on procedural training scenes, one knob turned at a time, and
writes them with what produced them. Models without an entry get those of `mini` and say so.
"""

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

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
class Seen:
    """How the RGB head's error of a frame grows as the photos see less of it: as 1 + rise * (1 - coverage)."""

    rise: float
    typical: float  # coverage of a frame whose error is the average
    r: float = 1.0  # correlation of the logarithms over the frames measured, within scenes


@dataclass(frozen=True)
class Table:
    """RMS errors of single knobs, in colours from 0 to 1, averages (root mean square) over scenes.

    `photos`: error per square root of the share of coverage lost (a pixel is seen well or not: squares add). `merge`,
    `half`: fewer scene tokens, reconstruction at half size. `head`: frames of the RGB head in place of generated ones,
    where the photos see as much as there (`seen`). `stretch`: a stretch generated alone in place of the same
    frames of a whole window, by its share of the window's slots after the first.
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
    seen: Seen
    stretch: dict[float, float]
    knobs: dict[str, tuple[Knob, ...]]
    provenance: dict[str, Any]

    def of_head(self, seen: np.ndarray) -> np.ndarray:
        """Errors of frames of the RGB head that the photos cover as `seen` says, 0 to 1, of any shape."""
        rise, typical = self.seen.rise, self.seen.typical
        return self.head * (1.0 + rise * (1.0 - seen)) / (1.0 + rise * (1.0 - typical))

    def of_stretch(self, frames: int, window: int) -> float:
        """Error of `frames` generated alone that belong to a window of so many; none for all of it."""
        if frames == window:
            return 0.0
        shares, errors = zip(*sorted(self.stretch.items()), strict=True)
        return float(np.interp((frames - 1) / (window - 1), shares, errors))


def parse(name: str, values: dict[str, Any]) -> Table:
    """A table from its JSON form."""
    plain = dict(values)
    plain["steps"] = tuple(Step(**row) for row in values["steps"])
    plain["knobs"] = {
        knob: tuple(Knob(**row) for row in rows) for knob, rows in values["knobs"].items()
    }
    plain["seen"] = Seen(**values["seen"])
    plain["stretch"] = {float(k): float(v) for k, v in values["stretch"].items()}
    for field in ("merge", "merge_head"):
        plain[field] = {int(k): float(v) for k, v in values[field].items()}
    return Table(name=name, **plain)


@functools.cache
def load(name: str) -> Table:
    """The table of a model, by the name of its configuration; that of `mini` for models without one."""
    if not FILE.exists():
        raise UserError(
            f"{FILE}: the planner's constants are missing: run python -m experiments.planning.ladder --calibrate."
        )
    tables = json.loads(FILE.read_text(encoding="utf-8"))
    name = name if name in tables else DEFAULT
    return parse(name, tables[name])
