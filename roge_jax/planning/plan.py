"""One tolerance in, one `Plan` out: which photos, tokens, steps, resolution and frames a run pays for.

    plan = rj.plan(params, config, photos, path, tolerance=0.02)
    print(plan.explain())
    result = sampling.sample(params, config, photos, path, plan=plan)

The tolerance is the expected root-mean-square difference, in colours from 0 to 1, between the frames made under the
plan and those of the full model (all photos given, the settings' own steps). Zero is the full model itself. Every
combination of the knobs has a price (`cost`) and a predicted error; starting from the cheapest, that change of plan is
bought which lowers the error most per FLOP, until the tolerance is met; the last purchase is the cheapest that meets it.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .. import cost
from ..config import RoGeConfig
from ..core.params import Tree
from ..errors import UserError
from ..geometry.cameras import Cameras
from ..sampling.choices import Choices
from ..sampling.photos import Photos, read_photos
from ..sampling.video import NOTHING_TO_PLAN, Settings
from ..scenes import coverage
from ..scenes.scene import Scene
from . import proxies
from .options import Option, choose, full_choices, list_options, next_best, trail
from .table import Table, load

TOLERANCE = 0.02
PROBE = 0.01
NAMED = 4  # stretches that `explain` names


class Purchase(NamedTuple):
    """One change of plan: what, by how much it lowers the predicted error, what it costs, and why."""

    what: str
    gain: float
    flops: float
    reason: str


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a run uses and what that is expected to cost and to lose. Give it to `sampling.sample`.

    `predicted_error`: RMS in colours from 0 to 1 against the full model. FLOPs: `predicted_cost` of the run,
    `full_cost` of the full model's, `planning_cost` of measuring the scene beforehand.
    """

    choices: Choices
    ids: tuple[int, ...]  # views of the scene, all that the full model sees
    frames: int  # of the path
    tolerance: float
    max_cost: float | None
    predicted_error: float
    predicted_cost: float
    full_cost: float
    planning_cost: float
    measured: dict[str, float]
    bought: tuple[Purchase, ...]
    refused: Purchase | None
    notes: tuple[str, ...] = ()

    def explain(self) -> str:
        """The plan as text: what was bought, in order, with its price, and what would have been next."""
        part = self.predicted_cost / self.full_cost
        lines = [
            f"plan for tolerance {self.tolerance:g}: predicted error {self.predicted_error:.4f} (RMS colour against the "
            f"full model), {cost.scaled(self.predicted_cost, 'FLOP')} of {cost.scaled(self.full_cost, 'FLOP')} "
            f"({100 * part:.0f} %), {cost.scaled(self.planning_cost, 'FLOP')} for planning",
            f"  {_named(self.choices)}; {_generated(self.choices, self.frames)}",
        ]
        if self.ids != tuple(range(len(self.ids))):
            lines.append(f"  photos are numbered among views {list(self.ids)} of the scene")
        lines += [f"  {'bought' if i else 'start '}  {_line(p)}" for i, p in enumerate(self.bought)]
        if self.refused is not None:
            lines.append(f"  refused {_line(self.refused)}")
        if self.measured:
            values = ", ".join(f"{name} {value:.3g}" for name, value in self.measured.items())
            lines.append(f"  measured: {values}")
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def _line(p: Purchase) -> str:
    return f"{cost.scaled(p.flops, 'FLOP'):>11s}  {-p.gain:+.4f}  {p.what}: {p.reason}"


def plan(
    params: Tree,
    config: RoGeConfig,
    scene: Scene | Photos,
    path: Cameras,
    *,
    tolerance: float = TOLERANCE,
    max_cost: float | None = None,
    settings: Settings | None = None,
    context: Sequence[int] | None = None,
    probe: float = PROBE,
    table: Table | None = None,
    compiled: dict[Any, Any] | None = None,
) -> Plan:
    """The cheapest plan that is expected to stay within `tolerance`, or the best one within `max_cost`.

    Args:
      scene: `Photos`, all of which the full model sees, or a scene: its views `context`, by default as many as the
        model takes and those that see most of the path (`coverage.see_path`). The plan's `ids` are these views and its
        photos positions among them: `read_photos(scene, plan.ids, config)` makes what `sample` takes.
      path: the cameras to be rendered, as for `sample`.
      tolerance: RMS difference to the full model's frames, colours from 0 to 1; 0 is the full model, bit for bit.
      max_cost: FLOPs of planning and run together; beyond it the tolerance is given up, which `notes` says.
      probe: what measuring a proxy on the scene may take, as a share of the full run (or of `max_cost`, if less); 0:
        nothing is measured, the predictions are those of an average scene and planning is free.
      table: the measured constants; those of the model's name by default.
      compiled: a dict that keeps compiled programs for further plans.
    Raises: UserError for values that make no sense and for a `max_cost` below the cheapest plan.
    """
    _check(tolerance, max_cost)
    if config.parts != "all":
        raise UserError(NOTHING_TO_PLAN)
    settings = (Settings() if settings is None else settings).of(config)
    photos = scene if isinstance(scene, Photos) else photos_of(scene, config, context, path)
    full = full_choices(photos, config, path, settings)
    table = load(config.name) if table is None else table
    measured, worth = proxies.Measured({}, 0.0), None
    if tolerance > 0 or max_cost is not None:
        worth = coverage.coverage(photos.cameras, path, config.height, config.width)
        (whole,) = list_options(photos, config, path, settings, table, {}, None)
        most = probe * min(whole.flops, np.inf if max_cost is None else max_cost)
        measured = proxies.measure(
            params, config, photos, path, settings, most, {} if compiled is None else compiled
        )
    options = list_options(photos, config, path, settings, table, measured.values, worth)
    budget = np.inf if max_cost is None else max_cost - measured.flops
    chosen = choose(options, tolerance, budget, max_cost)
    start, *steps = trail(options, chosen)
    bought = [_purchase(None, start)]
    bought += [_purchase(a, b) for a, b in zip([start, *steps], steps)]
    after = next_best(options, chosen)
    notes = []
    if chosen.error > tolerance:
        notes.append(
            f"max_cost {max_cost:.4g} FLOPs does not buy tolerance {tolerance:g}; this is the best within it."
        )
    against = table.provenance.get("full")
    if against and against != [settings.solver, settings.schedule, settings.steps]:
        notes.append(
            f"errors of fewer steps were measured against {against[2]} steps of {against[0]} ({against[1]}), not against "
            "these settings."
        )
    if table.name != config.name:
        notes.append(
            f"errors were measured for '{table.name}', not for '{config.name}': read them as a guess."
        )
    return Plan(
        choices=chosen.choices,
        ids=tuple(photos.ids),
        frames=len(path),
        tolerance=float(tolerance),
        max_cost=None if max_cost is None else float(max_cost),
        predicted_error=chosen.error,
        predicted_cost=chosen.flops,
        full_cost=next(o.flops for o in options if o.choices == full),
        planning_cost=measured.flops,
        measured=measured.values,
        bought=tuple(bought),
        refused=None if after is None else _purchase(chosen, after),
        notes=tuple(notes),
    )


def _check(tolerance: float, max_cost: float | None) -> None:
    if not (np.isfinite(tolerance) and tolerance >= 0):
        raise UserError(
            f"tolerance {tolerance}: give a root-mean-square colour difference from 0 (the full model) up, e.g. 0.02."
        )
    if max_cost is not None and not max_cost > 0:
        raise UserError(f"max_cost {max_cost}: give a positive number of FLOPs, e.g. 5e10.")


def photos_of(
    scene: Scene, config: RoGeConfig, context: Sequence[int] | None, path: Cameras
) -> Photos:
    """The photos of the full model: the views `context`, or those that see most of the path, best first."""
    if context is None:
        most = min(len(scene), config.max_context)
        context = coverage.see_path(scene, path, most, config.height, config.width)
    return read_photos(scene, context, config)


def _named(c: Choices) -> str:
    tokens = {1: "all scene tokens", 2: "half the scene tokens", 4: "a quarter of the scene tokens"}
    steps = f"{c.steps} steps of {c.solver} ({c.schedule})" if c.generated else "no steps"
    return (
        f"{len(c.photos)} photos {list(c.photos)}, {tokens[c.merge]}, reconstruction at "
        f"{c.recon[0]}x{c.recon[1]}, {steps}"
    )


def _generated(c: Choices, frames: int) -> str:
    """Which of so many frames are generated."""
    if c.generated in (0, frames):
        return f"{'no' if c.generated == 0 else 'every'} frame of {frames} is generated"
    spans = [f"{a} to {b - 1}" for a, b in filter(None, c.generate)]
    more = f" and {len(spans) - NAMED} more stretches" if len(spans) > NAMED else ""
    return f"{c.generated} of {frames} frames are generated ({', '.join(spans[:NAMED])}{more})"


def _purchase(before: Option | None, after: Option) -> Purchase:
    if before is None:
        return Purchase(
            _named(after.choices), -after.error, after.flops, "the cheapest plan there is"
        )
    a, b = before.choices, after.choices
    changes = []
    if a.photos != b.photos:
        changes.append(f"photos {list(a.photos)} -> {list(b.photos)}")
    if a.recon != b.recon:
        changes.append(f"reconstruction {a.recon[0]}x{a.recon[1]} -> {b.recon[0]}x{b.recon[1]}")
    if a.merge != b.merge:
        changes.append(f"scene tokens 1/{a.merge} -> 1/{b.merge}")
    if a.generate != b.generate:
        changes.append(f"frames generated {a.generated} -> {b.generated}")
    if b.generated and (a.steps, a.solver, a.schedule) != (b.steps, b.solver, b.schedule):
        old = f"{a.steps} {a.solver} ({a.schedule}) -> " if a.generated else ""
        changes.append(f"steps {old}{b.steps} {b.solver} ({b.schedule})")
    gain, extra = before.error - after.error, after.flops - before.flops
    return Purchase(
        ", ".join(changes), gain, extra, f"{1e12 * gain / extra:.2f} of error less per TFLOP"
    )
