"""What to look at while both halves train together: do the two losses agree, and at which noise levels does it fail?

A photometric term that is too heavy takes over the reconstruction early on; the norms of the two gradients on what
they share, and the angle between them, show it. The flow loss by noise level shows what a mean over levels hides.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax

from .. import model
from ..config import RoGeConfig
from ..core.lora import attach
from ..core.params import Tree, flatten
from ..video import flow

SHARED = ("encoder/", "renderer/")  # trained by both terms


def gradient_balance(
    trainable: Tree, frozen: Tree, batch: dict, key: jax.Array, *, config: RoGeConfig
) -> dict[str, jax.Array]:
    """Norms of the gradients of the flow term and of lambda times the photometric term, and their cosine.

    All three on the shared leaves (the reconstruction branch) alone; empty when none of them trains.
    """

    def terms(trainable):
        _, terms = model.loss(trainable, frozen, batch, key, config=config)
        return terms["flow"], config.flow.photometric * terms["photometric"]

    (one, two), pull = jax.vjp(terms, trainable)
    grads = [pull((jnp.ones_like(one), jnp.zeros_like(two)))[0]]
    grads += [pull((jnp.zeros_like(one), jnp.ones_like(two)))[0]]
    first, second = (
        [g for path, g in flatten(t).items() if path.startswith(SHARED)] for t in grads
    )
    if not first:
        return {}
    norms = [optax.tree.norm(first), optax.tree.norm(second)]
    dot = sum((a * b).sum() for a, b in zip(first, second, strict=True))
    return {
        "flow_grad_norm": norms[0],
        "photometric_grad_norm": norms[1],
        "grad_cosine": dot / jnp.maximum(norms[0] * norms[1], 1e-30),
    }


def flow_by_sigma(
    params: Tree, batch: dict, key: jax.Array, sigmas: np.ndarray, *, config: RoGeConfig
) -> jax.Array:
    """Unweighted flow-matching error on the targets at each of `sigmas` [k], the mean over the batch: [k]."""

    def scene(views, key):
        m = views["context_rgb"].shape[0]
        tokens = model.reconstruct(params, views, config=config)
        features = model.query_rays(params, tokens, views, config=config)
        known = model.encode_contexts(params, views["context_rgb"], config=config)
        x0 = jnp.concatenate(
            [known, model.encode_targets(params, views["target_rgb"], config=config)]
        )
        cond = model.condition(params, known, features, views, config=config)
        noise = jax.random.normal(key, x0.shape)

        def at(sigma):
            x = flow.x_sigma(x0, noise, sigma)
            v = model.velocity(params, x, sigma, cond, config=config, contexts=m)
            return jnp.square(v - flow.velocity_target(x0, noise))[m:].mean()

        return jax.lax.map(at, jnp.asarray(sigmas, jnp.float32))

    keys = jax.random.split(key, batch["K"].shape[0])
    return jax.vmap(scene)(batch, keys).mean(0)


def joint_diagnose(config: RoGeConfig, *, bins: int = 8) -> Callable:
    """diagnose(trainable, frozen, batch, key) -> {name: float} for the joint objective, for `loop.train`.

    Adds `flow_sigma_0.06` .. at the centres of `bins` equal bins of the noise level.
    """
    sigmas = (np.arange(bins) + 0.5) / bins

    @jax.jit
    def run(trainable, frozen, batch, key):
        by_sigma = flow_by_sigma(attach(frozen, trainable), batch, key, sigmas, config=config)
        return gradient_balance(trainable, frozen, batch, key, config=config), by_sigma

    def diagnose(trainable, frozen, batch, key):
        balance, by_sigma = run(trainable, frozen, batch, key)
        values = {f"flow_sigma_{s:.2f}": float(v) for s, v in zip(sigmas, by_sigma, strict=True)}
        return values | {name: float(value) for name, value in balance.items()}

    return diagnose
