"""Optimisers: AdamW (the paper's branch of fine-tuning) and Muon (training small models from scratch)."""

import math
import operator
import re
from dataclasses import dataclass
from typing import Literal

import jax
import optax

from ..core.params import Spec, flatten, unflatten

# Kernels between the outside (pixels, rays, noise levels, words) and the hidden width keep Adam; Muon is for hidden
# matrices, where every direction should move alike.
ADAM_ONLY = (
    r"patch_embed|rays?_embed|geometry_embed|time_embed|text_embed|clip_embed|camera_mlp/fc1"
    r"|head/|conv_in|conv_out"
)
WIDE = r"(^|/)(rays|geometry)_embed/"


@dataclass(frozen=True)
class OptimConfig:
    """AdamW or Muon, learning rate and its schedule, clipping, accumulation, average of the weights."""

    name: Literal["adamw", "muon"] = "adamw"
    learning_rate: float = 1e-4
    warmup: int = 100
    decay: float = 0.0  # last fraction of the steps over which the rate falls linearly ...
    floor: float = 0.03  # ... to this fraction of it
    weight_decay: float = 0.01  # on matrices only
    betas: tuple[float, float] = (0.9, 0.97)
    clip: float = 1.0  # global gradient norm; 0: none
    accumulate: int = 1
    ema: float = 0.0  # 0: none


def learning_rate(cfg: OptimConfig, steps: int) -> optax.Schedule:
    """Linear warm-up, constant, linear decay over the last `cfg.decay` of `steps`."""
    warmup = min(cfg.warmup, max(steps // 4, 1))
    decay = int(steps * cfg.decay)
    return optax.join_schedules(
        [
            optax.linear_schedule(cfg.learning_rate / warmup, cfg.learning_rate, warmup),
            optax.constant_schedule(cfg.learning_rate),
            optax.linear_schedule(cfg.learning_rate, cfg.floor * cfg.learning_rate, max(decay, 1)),
        ],
        [warmup, steps - decay],
    )


def _is_matrix(path: str, spec: Spec) -> bool:
    return path.endswith(("/kernel", "/lora_a", "/lora_b"))


def muon_dimensions(specs):
    """Which axes Muon treats as a matrix: all but the last against the last, per layer of a stack; None: Adam."""

    def leaf(path: str, spec: Spec):
        if not path.endswith("/kernel") or re.search(ADAM_ONLY, path):
            return None
        lead = 1 if spec.axes[0] == "layers" else 0
        last = len(spec.shape) - 1
        return optax.contrib.MuonDimensionNumbers(tuple(range(lead, last)), last)

    return unflatten({path: leaf(path, spec) for path, spec in flatten(specs).items()})


def adam_shares(specs):
    """What each leaf takes of the learning rate beside Muon: 1, but for embeddings of thousands of inputs.

    Adam's steps have one size per weight, so an output moves by the rate times the number of inputs: at the rate of the
    others these two would change by a tenth of themselves in every step.
    """

    def share(path: str, spec: Spec) -> float:
        wide = re.search(WIDE, path) and path.endswith("/kernel")
        return min(1.0, 256.0 / math.prod(spec.shape[:-1])) if wide else 1.0

    return unflatten({path: share(path, spec) for path, spec in flatten(specs).items()})


def make_optimiser(cfg: OptimConfig, specs, steps: int) -> optax.GradientTransformation:
    """The transformation for trainable leaves declared by `specs`, with clipping and accumulation."""
    rate = learning_rate(cfg, steps // max(cfg.accumulate, 1))
    matrices = unflatten({path: _is_matrix(path, s) for path, s in flatten(specs).items()})
    b1, b2 = cfg.betas
    if cfg.name == "muon":
        core = optax.contrib.muon(
            rate,
            weight_decay=cfg.weight_decay,
            consistent_rms=0.2,
            adam_b1=b1,
            adam_b2=b2,
            muon_weight_dimension_numbers=muon_dimensions(specs),
        )
        shares = adam_shares(specs)
        scale = optax.stateless(lambda updates, _: jax.tree.map(operator.mul, updates, shares))
        core = optax.chain(core, scale)
    else:
        core = optax.adamw(rate, b1, b2, weight_decay=cfg.weight_decay, mask=matrices)
    chain = optax.chain(optax.clip_by_global_norm(cfg.clip), core) if cfg.clip else core
    if cfg.accumulate > 1:
        return optax.MultiSteps(chain, cfg.accumulate).gradient_transformation()
    return chain


def ema_update(average, params, decay: float, step: jax.Array):
    """Exponential moving average with the usual (1 + t) / (10 + t) ramp."""
    rate = jax.numpy.minimum(decay, (1.0 + step) / (10.0 + step))
    return jax.tree.map(lambda a, p: rate * a + (1 - rate) * p, average, params)
