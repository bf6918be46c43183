"""Every combination of the knobs, its price and its predicted error; and which of them to buy.

Errors of different knobs are taken as independent: their squares add. `table` holds what each does on average,
`proxies` and `coverage` say how this scene differs from the average.
"""

import dataclasses
import itertools
from collections import Counter
from typing import Any, Literal, NamedTuple

import numpy as np

from .. import cost
from ..config import RoGeConfig
from ..errors import UserError
from ..geometry.cameras import Cameras
from ..sampling.choices import Choices, around
from ..sampling.photos import Photos
from ..sampling.video import Settings
from ..sampling.windows import chained, windows
from ..scenes import coverage
from ..video import flow, solvers
from . import proxies, stretches
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
    solver, schedule = settings.names()
    return Choices(
        photos=tuple(range(len(photos.ids))),
        steps=settings.steps,
        solver=solver,
        schedule=schedule,
        recon=(config.recon_height, config.recon_width),
        merge=config.renderer.merge,
        generate=tuple(windows(len(path), config.frames)),
        frames=config.frames,
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
    evaluations = _evaluations(settings)
    price = Prices(config, settings, len(path))
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
    seen = coverage.by_frame(photos.cameras, path, config.height, config.width)
    cuts = [
        (cut, *_shares(cut, np.square(table.of_head(seen)))) for cut in stretches.cuts(seen, config)
    ]
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
        for solver, schedule, count, cost_steps, e_steps in steps:
            made = float(np.hypot(loss, scale["steps"] * e_steps))
            for cut, share, left in cuts:
                if share == 0 and count != full.steps:
                    continue  # no steps are taken: one entry is enough
                apart = scale["stretch"] * table.of_stretch(cut.frames, config.frames)
                squares = share * (made**2 + apart**2) + (1 - share) * head**2
                error = float(np.sqrt(squares + scale["head"] ** 2 * left))
                choices = Choices(kept, count, solver, schedule, size, merge, *cut)
                if choices != full:
                    options.append(Option(choices, error, price(choices, cost_steps)))
    return options


def _shares(cut: stretches.Cut, heads: np.ndarray) -> tuple[float, float]:
    """(share of the frames that are generated; sum of the others' `heads` [n], divided by n)."""
    made = np.zeros(len(heads), bool)
    for span in cut.generate:
        made[slice(*(span or (0, 0)))] = True
    return float(made.mean()), float(heads[~made].sum() / len(heads))


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
    solver, _ = settings.names()
    if solvers.SOLVERS[solver].method is None:
        return 3 * settings.steps
    return solvers.nfe(solver, settings.steps)


class Prices:
    """FLOPs of a run under choices, along a path of so many `frames`: what runs in each window, added up."""

    def __init__(self, config: RoGeConfig, settings: Settings, frames: int):
        self.config, self.settings = config, settings
        self.windows = windows(frames, config.frames)
        self.known: dict[Any, tuple[float, float]] = {}
        self.kinds: dict[Any, Counter] = {}

    def window(self, config: RoGeConfig, m: int, made: int, rest: bool) -> tuple[float, float]:
        """FLOPs of a window of m contexts without evaluations, and of one evaluation: `made` frames are generated
        together, and others shown beside them if there is a `rest`."""
        key = (config.recon_height, config.renderer.merge, m, made, rest)
        if key not in self.known:
            if not made:
                self.known[key] = cost.preview(config, m), 0.0
            else:
                parts = cost.estimate(dataclasses.replace(config, frames=made), m, 0)
                beside = cost.shown(config, m, config.frames - made) if rest else 0.0
                self.known[key] = parts.total_flops + beside, parts.flops["velocity"]
        return self.known[key]

    def count(self, choices: Choices) -> Counter:
        """How many windows of each kind (a later one, frames generated together, whether others are shown) there are."""
        key = (choices.generate, choices.frames)
        if key not in self.kinds:
            self.kinds[key] = Counter(
                (bool(number), choices.frames if span else 0, bool(around(window, span or window)))
                for number, (window, span) in enumerate(
                    zip(self.windows, choices.generate, strict=True)
                )
            )
        return self.kinds[key]

    def __call__(self, choices: Choices, evaluations: int) -> float:
        renderer = dataclasses.replace(self.config.renderer, merge=choices.merge)
        height, width = choices.recon
        config = dataclasses.replace(
            self.config, recon_height=height, recon_width=width, renderer=renderer
        )
        total, m = 0.0, len(choices.photos)
        for (later, made, rest), times in self.count(choices).items():
            chain = later and self.settings.long == "chain"
            contexts = sum(chained(m, config)) if chain else m
            fixed, once = self.window(config, contexts, made, rest)
            total += times * (fixed + evaluations * once)
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
