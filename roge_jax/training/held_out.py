"""How a stage fares on scenes that it never sees: its own terms, undisturbed."""

import dataclasses

import jax
import numpy as np

from ..config import RoGeConfig
from ..core.params import Tree
from ..data.source import ProceduralSource
from . import encoded, stages


def held_out(
    objective, frozen: Tree, stage: stages.Stage, config: RoGeConfig, scenes: int = 16, encode=None
):
    """evaluate(trainable) -> the stage's own terms on held-out scenes of the kind that is rendered for training, prefixed `held_`.

    `encode`: from the arrays of one sample to those that the objective takes; None: as they are.
    """
    from ..procedural.scenes import HELDOUT_SEED

    frames = max(24, config.frames + 3)
    source = ProceduralSource(config.height, config.width, frames, depth=stage.views.depth)
    pool = [source[HELDOUT_SEED + i] for i in range(scenes)]
    views = stage.views.undisturbed()
    views = dataclasses.replace(views, contexts=(3,), context_weights=(1.0,), size=None)
    fixed = dataclasses.replace(stage, views=views, batch=4)
    batches = [stages.stage_batch(pool, fixed, config, 0, i) for i in range(scenes // 4)]
    if encode is not None:
        batches = [encoded.each(encode, batch) for batch in batches]
    run = jax.jit(objective)

    def evaluate(trainable: Tree) -> dict[str, float]:
        results = [run(trainable, frozen, batch, jax.random.key(0)) for batch in batches]
        row = {"held_loss": float(np.mean([loss for loss, _ in results]))}
        for name in results[0][1]:
            row[f"held_{name}"] = float(np.mean([terms[name] for _, terms in results]))
        return row

    return evaluate
