"""Held-out samples, the cost of an optimiser and the clock of the ablation."""

import dataclasses
import functools
import math
import time
from typing import Any

import jax
import numpy as np

from experiments import harness
from roge_jax.config import RoGeConfig
from roge_jax.core.params import Tree, count, flatten
from roge_jax.procedural.scenes import sample_sequence
from roge_jax.training import stages
from roge_jax.training.optim import muon_dimensions

SIGMAS = (0.2, 0.4, 0.6, 0.8, 0.95, 1.0)
CONTEXTS, SCENES = 3, 32  # photos of a sample; held-out scenes for reconstruction


@functools.cache
def heldout_sequences(n: int, height: int, width: int) -> list[dict]:
    size = {"height": height, "width": width}
    return [sample_sequence(seed, **size, depth=False) for seed in harness.heldout(n)]


def heldout(stage: stages.Stage, config: RoGeConfig, scenes: int) -> list[dict[str, np.ndarray]]:
    """One unaltered sample of `CONTEXTS` photos from each held-out scene, with a leading axis of one."""
    views = dataclasses.replace(stage.views.undisturbed(), outside=0.0)
    fixed = dataclasses.replace(stage, views=views, batch=1)
    sequences = heldout_sequences(scenes, config.height, config.width)
    return [stages.stage_batch([s], fixed, config, 0, i) for i, s in enumerate(sequences)]


def muon_flops(specs: Tree) -> float:
    """Of Muon's five Newton-Schulz iterations on all matrices of a step."""
    flat, total = flatten(specs), 0.0
    for path, rule in flatten(muon_dimensions(specs)).items():
        if rule is not None:
            *ins, d_out = (n for n, a in zip(flat[path].shape, flat[path].axes) if a != "layers")
            small, large = sorted((math.prod(ins), d_out))
            layers = math.prod(flat[path].shape) // (small * large)
            total += 5 * layers * (4.0 * small**2 * large + 2.0 * small**3)
    return total


def trained(group: str, variant: Any, specs: Tree, flops: float, clock: "Clock", **more) -> dict:
    """The row of a variant trained from nothing; `flops` of all its steps, `more` is what it has reached."""
    return {
        "group": group,
        "question": variant.question,
        "reference": variant.reference,
        "seed": variant.seed,
        "parameters": count(specs),
        "tera_flop": flops / 1e12,
        **more,
        **clock.record(),
    }


class Clock:
    """CPU time of the process in steps, data and evaluation apart; the first step compiles and is kept apart."""

    def __init__(self):
        self.steps: list[float] = []

    def run(self, step, *args):
        began = time.process_time()
        result = jax.block_until_ready(step(*args))
        self.steps.append(time.process_time() - began)
        return result

    def record(self) -> dict[str, float]:
        return {
            "steps": len(self.steps),
            "core_seconds": float(np.mean(self.steps[1:]) * len(self.steps)),
            "step_core_seconds": np.quantile(self.steps[1:], (0.1, 0.5, 0.9)).tolist(),
            "first_step_core_seconds": self.steps[0],
        }
