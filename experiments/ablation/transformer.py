"""Variants of the video transformer, each trained from nothing on the shipped reconstruction for the same FLOPs."""

import dataclasses
import functools
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.ablation.common import CONTEXTS, SIGMAS, Clock, heldout, muon_flops, trained
from experiments.ablation.generator import TOLD, condition, encode_all, flow_errors, video_stage
from roge_jax import cost, fusion, model
from roge_jax.config import RoGeConfig, to_dict
from roge_jax.core.lora import attach
from roge_jax.core.params import Tree
from roge_jax.core.params import init as init_specs
from roge_jax.training import loop, stages
from roge_jax.training.optim import make_optimiser

TRAINS = r"^(dit|fusion)/"
SCENES, DRAWS = 2, 4  # of a step: clips, and noise levels of each


@dataclass(frozen=True)
class Variant:
    """A change of the base: fields of the transformer, or a condition that is zero in training and in scoring."""

    question: str
    dit: dict[str, Any] = field(default_factory=dict)
    hide: str | None = None  # a name of `generator.TOLD`
    seed: int = 0
    reference: str = "transformer"  # what it is compared with


def _width(d: int) -> dict[str, int]:
    """Heads of 64 and a hidden layer of four times the width, as in the base."""
    return {"width": d, "heads": d // 64, "ffn": 4 * d}


VARIANTS = {
    "transformer": Variant("seed"),
    "transformer, seed 1": Variant("seed", seed=1),
    "transformer depth 4": Variant("depth", {"depth": 4}),
    "transformer depth 12": Variant("depth", {"depth": 12}),
    "transformer width 128": Variant("width", _width(128)),
    "transformer width 384": Variant("width", _width(384)),
    "transformer without rays": Variant("rays", hide="rays"),
}


def varied(config: RoGeConfig, variant: Variant) -> RoGeConfig:
    return dataclasses.replace(config, dit=dataclasses.replace(config.dit, **variant.dit))


def trained_specs(config: RoGeConfig, variant: Variant) -> Tree:
    """Leaves of the transformer and the fusion; without those that a hidden condition leaves without a gradient."""
    specs, _ = model.split(model.specs(varied(config, variant)), TRAINS)
    if variant.hide == "rays":
        kept = {k: v for k, v in specs["fusion"].items() if k != "rays_embed"}
        return specs | {"fusion": kept}
    return specs


def step_flops(variant: Variant, config: RoGeConfig) -> float:
    """Of one training step: forward and twice as much backward, nothing recomputed, and Muon's iterations."""
    config, slots = varied(config, variant), config.slots(CONTEXTS)
    tokens = cost.tokens_per_slot(config) * slots
    forward = cost.fusion(config, CONTEXTS + config.frames, slots)
    if variant.hide == "rays":
        forward -= 2.0 * tokens * config.dit.patch**2 * (6 * 4 * 64) * config.dit.width
    forward += DRAWS * cost.velocity(config.dit, tokens)
    return 3.0 * SCENES * forward + muon_flops(trained_specs(config, variant))


def without(clips: dict[str, np.ndarray], hide: str | None) -> dict[str, np.ndarray]:
    return clips | {n: np.zeros_like(clips[n]) for n in (TOLD[hide] if hide else ())}


class Frozen:
    """What no variant changes, encoded once: training clips and held-out ones."""

    def __init__(self, params: Tree, config: RoGeConfig, source, clips: int = 64, scenes: int = 16):
        self.params, self.config, self.source = params, config, source
        self.clips, self.scenes = clips, scenes

    @functools.cached_property
    def training(self) -> dict[str, np.ndarray]:
        stage = video_stage(self.config, batch=1)
        batches = [
            stages.stage_batch(self.source, stage, self.config, 0, i) for i in range(self.clips)
        ]
        return encode_all(self.params, batches, self.config)

    @functools.cached_property
    def heldout(self) -> dict[str, np.ndarray]:
        batches = heldout(video_stage(self.config), self.config, self.scenes)
        return encode_all(self.params, batches, self.config)


def clip_loss(params: Tree, clip, key, *, config: RoGeConfig) -> jax.Array:
    """The stage's flow-matching loss of one encoded clip: `DRAWS` noise levels share one condition."""
    cond = condition(params, clip, config)
    options = {"config": config, "contexts": CONTEXTS, "remat": "none"}
    return model.flow_matching(params, clip["x0"], cond, key, draws=DRAWS, **options)


def train(variant: Variant, frozen: Frozen, steps: int) -> dict[str, Any]:
    """Train one variant for the FLOPs of `steps` steps of the base; score it halfway and at the end."""
    config, per_step = varied(frozen.config, variant), step_flops(variant, frozen.config)
    steps = max(2, round(steps * step_flops(VARIANTS["transformer"], frozen.config) / per_step))
    stage = stages.find_stage(stages.mini_stages(frames=config.frames), "generator")
    specs = trained_specs(frozen.config, variant)
    fixed = {} if variant.hide != "rays" else {"fusion": {"rays_embed": _zero_rays(config)}}
    optimiser = make_optimiser(stage.optim, specs, steps)

    def objective(trainable, fixed, batch, key):
        params = attach(fixed, trainable)
        keys = jax.random.split(key, SCENES)
        one = functools.partial(clip_loss, params, config=config)
        return jax.lax.map(lambda a: one(*a), (batch, keys)).mean(), {}

    step = jax.jit(loop.make_step(objective, optimiser, stage.optim), donate_argnums=0)
    train_on, test_on = (without(c, variant.hide) for c in (frozen.training, frozen.heldout))

    def errors(trainable):
        return flow_errors(attach(fixed, trainable), test_on, config)

    key = jax.random.key(variant.seed)
    trainable = init_specs(key, specs)
    untrained = errors(trainable).mean(1)
    state, clock = loop.initial_state(trainable, optimiser, stage.optim), Clock()
    rng = np.random.default_rng(variant.seed)
    for i in range(steps):
        rows = rng.choice(frozen.clips, SCENES, replace=False)
        batch = {name: x[rows] for name, x in train_on.items()}
        state, metrics = clock.run(step, state, fixed, batch, jax.random.fold_in(key, i))
        if i + 1 == steps // 2:
            halfway = errors(state["ema"]).mean(1)
    reached = {
        "skipped": int(metrics["skipped"]),
        "sigmas": SIGMAS,
        "errors": errors(state["ema"]).tolist(),
        "untrained": untrained.tolist(),
        "halfway": float(halfway.mean()),
        "clips": frozen.clips,
        "batch": [SCENES, DRAWS],
        "config": to_dict(config)["dit"],
    }
    return trained("transformer", variant, specs, steps * per_step, clock, **reached)


def _zero_rays(config: RoGeConfig) -> Tree:
    specs = fusion.fusion_specs(config)["rays_embed"]
    return jax.tree.map(jnp.zeros_like, init_specs(jax.random.key(0), specs))
