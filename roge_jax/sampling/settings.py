"""How a video is sampled: steps, sampler, noise levels, seed, and what becomes of long paths."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ..config import RoGeConfig
from ..errors import UserError, did_you_mean
from ..files import fields
from ..video import flow, solvers

LONG = ("chain", "independent")
SLOTS = ("noised", "clean", "free")


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to sample; all of it goes into run.json. Steps 0, no solver, no schedule: the model's own (`of`).

    A solver is a name or a function of one's own, `solvers.Sampler`. A schedule is a name or the noise levels
    themselves, [steps + 1] from 1 down to 0. A model may leave its video to the reconstruction (`FlowConfig.generate`):
    then `generate`, or steps, a solver or a schedule, ask for the generator.
    """

    steps: int = 0
    solver: str | solvers.Sampler = ""
    schedule: str | Sequence[float] | np.ndarray = ""
    seed: int = 0
    slots: flow.ContextSlots = "noised"
    long: Literal["chain", "independent"] = "chain"
    scale: float | None = None  # divisor of all positions, in scene units; None: the model's rule
    generate: bool | None = None  # False: the reconstruction's picture; None: as the model has it

    def __post_init__(self):
        named: list[tuple[str, Any, tuple[str, ...]]] = [
            ("context slots", self.slots, SLOTS),
            ("long", self.long, LONG),
        ]
        if not callable(self.solver):
            named.append(("solver", self.solver or "euler", tuple(solvers.SOLVERS)))
        for name, word, allowed in named:
            if word not in allowed:
                raise UserError(f"Unknown {name} '{word}': {did_you_mean(str(word), allowed)}")
        fields.number(self.seed, "Settings", "seed", low=0, whole=True)
        if self.scale is not None:
            fields.number(self.scale, "Settings", "scale", low=1e-30)
        if not isinstance(self.schedule, str):
            steps = len(solvers.check_grid(np.asarray(self.schedule))) - 1
            if self.steps not in (0, steps):
                raise UserError(
                    f"Settings: steps {self.steps} beside a schedule of {steps + 1} noise levels, which is {steps} steps: "
                    "leave steps away."
                )
        elif self.schedule != "optimised":  # those belong to a model, which `sample` knows
            flow.schedule(self.schedule or "uniform", self.steps or 1)

    def of(self, config: RoGeConfig) -> "Settings":
        """These settings with what they leave open as the model's configuration has it."""
        own, generate = config.flow, self.generate
        if generate is None:
            named = isinstance(self.schedule, str) and not self.schedule
            generate = own.generate or bool(self.steps or self.solver) or not named
        if isinstance(self.schedule, str):
            schedule: Any = self.schedule or own.schedule
            steps = self.steps or own.steps
        else:
            schedule = tuple(float(sigma) for sigma in self.schedule)
            steps = len(schedule) - 1
        return dataclasses.replace(
            self,
            steps=steps,
            solver=self.solver or own.solver,
            schedule=schedule,
            generate=generate,
        )

    def names(self) -> tuple[str, str]:
        """(solver, schedule). Raises: UserError unless both are names: what a plan knows the errors of."""
        if isinstance(self.solver, str) and isinstance(self.schedule, str):
            return self.solver, self.schedule
        raise UserError(
            "A plan knows the errors of named samplers and schedules alone: sample with your own without a plan, or name "
            "a solver and a schedule."
        )


def noise_levels(settings: Settings, config: RoGeConfig) -> np.ndarray:
    """The noise levels [steps + 1] of settings that leave nothing open (`Settings.of`)."""
    if not isinstance(settings.schedule, str):
        return solvers.check_grid(np.asarray(settings.schedule))
    return flow.schedule(
        settings.schedule,
        settings.steps,
        shift=config.flow.shift,
        solver=settings.solver if isinstance(settings.solver, str) else config.flow.solver,
        model=config.name,
    )
