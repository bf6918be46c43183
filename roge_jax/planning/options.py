"""Every combination of the knobs, its price and its predicted error; and which of them to buy.

Errors of different knobs are taken as independent: their squares add. `table` holds what each does on average,
`proxies` and `coverage` say how this scene differs from the average.
"""

import dataclasses
import itertools
from typing import Any, Literal, NamedTuple

import numpy as np

from .. import cost
from ..config import RoGeConfig
from ..errors import UserError
from ..geometry.cameras import Cameras
from ..sampling import Choices, Photos, Settings
from ..video import flow, solvers
from ..windows import chained, windows
from . import coverage, proxies
from .table import Table
from .table import scale as factor

LEAST_LOSS = 0.002  # of coverage: no change of photos is free
MERGES: tuple[Literal[1, 2, 4], ...] = (1, 2, 4)


class Option(NamedTuple):
    """Choices, their predicted RMS error against the full model's frames, and the FLOPs of the run."""

    choices: Choices
    error: float
    flops: float


def full_choices(photos: Photos, config: RoGeConfig, path: Cameras, settings: Settings) -> Choices:
    """Nothing left out."""
    settings = settings.of(config)
    return Choices(
        photos=tuple(range(len(photos.ids))),
        steps=settings.steps,
        solver=settings.solver,
        schedule=settings.schedule,
        recon=(config.recon_height, config.recon_width),
        merge=config.renderer.merge,
        generate=(True,) * len(windows(len(path), config.frames)),
    )


def list_options(
    photos: Photos,
    config: RoGeConfig,
    path: Cameras,
    settings: Settings,
    table: Table,
    measured: dict[str, float],
    worth: np.ndarray | None,
) -> list[Option]:
    """All combinations of the knobs with predicted errors and FLOPs; the full model alone if `worth` is None."""
    settings = settings.of(config)
    full = full_choices(photos, config, path, settings)
    parts = windows(len(path), config.frames)
    spans = np.array([stop - start for start, stop in parts]) / len(path)
    evaluations = _evaluations(settings)
    price = Prices(photos, config, settings, len(spans))
    options = [Option(full, 0.0, price(full, evaluations))]
    if worth is None:
        return options
    scale = {name: factor(knobs, measured) for name, knobs in table.knobs.items()}
    stored = flow.optimised_grids(config.name)
    steps = [
        (s.solver, s.schedule, s.steps, s.evaluations, s.error)
        for s in table.steps
        if s.schedule != "optimised" or s.steps in stored.get(s.solver, {})
    ]
    steps = [s for s in steps if s[3] < evaluations]
    steps.append((full.solver, full.schedule, full.steps, evaluations, 0.0))
    sizes: list[tuple[tuple[int, int], float, float]] = [(full.recon, 0.0, 0.0)]
    small = proxies.half_size(config)
    if small is not None:
        sizes.append(((small.recon_height, small.recon_width), table.half, table.half_head))
    merges = [(m, table.merge.get(m, 0.0), table.merge_head.get(m, 0.0)) for m in MERGES]
    if full.merge != 1:
        merges = [(full.merge, 0.0, 0.0)]
    # Where little is seen there is most to make up: those windows are generated first.
    first = np.argsort([seen(photos, path[a:b], config) for a, b in parts], kind="stable")
    rank = np.argsort(first)
    for (kept, lost), (merge, *e_merge), (size, *e_size) in itertools.product(
        _photo_sets(worth), merges, sizes
    ):
        share = 0.0 if lost is None else np.sqrt(max(lost, LEAST_LOSS))
        e_photos = (table.photos * share, table.photos_head * share)
        loss, head = (
            np.sqrt(
                (scale["photos"] * e_photos[k]) ** 2
                + (scale["merge"] * e_merge[k]) ** 2
                + (scale["half"] * e_size[k]) ** 2
            )
            for k in (0, 1)
        )
        head = float(np.hypot(head, scale["head"] * table.head))
        for solver, schedule, count, cost_steps, e_steps in steps:
            made = float(np.hypot(loss, scale["steps"] * e_steps))
            for generated in range(len(spans) + 1):
                if generated == 0 and count != full.steps:
                    continue  # no steps are taken: one entry is enough
                squares = np.where(rank < generated, made**2, head**2)
                choices = Choices(
                    kept,
                    count,
                    solver,
                    schedule,
                    size,
                    merge,
                    tuple(bool(r < generated) for r in rank),
                )
                error = float(np.sqrt((squares * spans).sum()))
                if choices != full:
                    options.append(Option(choices, error, price(choices, cost_steps)))
    return options


def seen(photos: Photos, path: Cameras, config: RoGeConfig) -> float:
    """Coverage of a part of the path by all photos."""
    worth = coverage.coverage(photos.cameras, path, config.height, config.width)
    return coverage.covered(worth, tuple(range(len(worth))))


def _photo_sets(worth: np.ndarray) -> list[tuple[tuple[int, ...], float | None]]:
    """(photos, coverage lost) of the best sets of each size; None: all photos, nothing changes."""
    everything = tuple(range(len(worth)))
    best = coverage.covered(worth, everything)
    sets: list[tuple[tuple[int, ...], float | None]] = [(everything, None)]
    for kept in coverage.selections(worth):
        if kept != everything:
            sets.append((kept, 1.0 - coverage.covered(worth, kept) / max(best, 1e-12)))
    return sets


def _evaluations(settings: Settings) -> int:
    """Of the network, per window; three per step is a guess for solvers that choose their own."""
    if solvers.SOLVERS[settings.solver].method is None:
        return 3 * settings.steps
    return solvers.nfe(settings.solver, settings.steps)


class Prices:
    """FLOPs of a run under choices."""

    def __init__(self, photos: Photos, config: RoGeConfig, settings: Settings, windows: int):
        self.config, self.settings, self.windows = config, settings, windows
        self.photos = photos
        self.known: dict[Any, tuple[float, float, float]] = {}

    def window(self, config: RoGeConfig, m: int) -> tuple[float, float, float]:
        """FLOPs of a window of m contexts: generated without evaluations, one evaluation, RGB head alone."""
        key = (config.recon_height, config.renderer.merge, m)
        if key not in self.known:
            parts = cost.estimate(config, m, 0)
            self.known[key] = parts.total_flops, parts.flops["velocity"], cost.preview(config, m)
        return self.known[key]

    def __call__(self, choices: Choices, evaluations: int) -> float:
        renderer = dataclasses.replace(self.config.renderer, merge=choices.merge)
        height, width = choices.recon
        config = dataclasses.replace(
            self.config, recon_height=height, recon_width=width, renderer=renderer
        )
        m, total = len(choices.photos), 0.0
        for number, generated in enumerate(choices.generate):
            later = number and self.settings.long == "chain"
            fixed, once, head = self.window(config, sum(chained(m, config)) if later else m)
            total += fixed + evaluations * once if generated else head
        return total


# ---- buying -----------------------------------------------------------------------------------------


def choose(
    options: list[Option], tolerance: float, budget: float, max_cost: float | None
) -> Option:
    """The cheapest option within `tolerance` and `budget`; if there is none, the best within `budget`."""
    affordable = [o for o in options if o.flops <= budget]
    if not affordable:
        least = min(o.flops for o in options)
        raise UserError(
            f"max_cost {max_cost:.4g} FLOPs is less than the cheapest plan needs: give at least "
            f"{least + (max_cost or 0.0) - budget:.4g}, or a shorter path."
        )
    good = [o for o in affordable if o.error <= tolerance]
    if good:
        return min(good, key=lambda o: (o.flops, o.error))
    return min(affordable, key=lambda o: (o.error, o.flops))


def trail(options: list[Option], chosen: Option) -> list[Option]:
    """From the cheapest option to the `chosen` one, at every step by the largest gain per FLOP."""
    now = min(options, key=lambda o: (o.flops, o.error))
    path = [now]
    while now != chosen:
        ahead = [
            o
            for o in options
            if now.flops < o.flops <= chosen.flops and chosen.error <= o.error < now.error
        ]
        now = max(ahead, key=lambda o: _slope(now, o)) if ahead else chosen
        path.append(now)
    return path


def next_best(options: list[Option], chosen: Option) -> Option | None:
    """The purchase that would come next."""
    ahead = [o for o in options if o.flops > chosen.flops and o.error < chosen.error]
    return max(ahead, key=lambda o: _slope(chosen, o)) if ahead else None


def _slope(a: Option, b: Option) -> float:
    return (a.error - b.error) / (b.flops - a.flops)
