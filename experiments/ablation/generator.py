"""What the generator is told and what it needs of it."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.ablation.common import CONTEXTS, SIGMAS, Clock, heldout
from roge_jax import fusion, model, preview
from roge_jax.config import RoGeConfig
from roge_jax.core.lora import attach
from roge_jax.core.params import Tree
from roge_jax.geometry.rays import plucker
from roge_jax.training import encoded, loop, stages
from roge_jax.training.optim import OptimConfig, make_optimiser
from roge_jax.video import flow

# What the transformer is told, by the names of `clip_of`; a model without preview has no such entry.
TOLD = {
    "rays": ("rays",),
    "ray features": ("features",),
    "preview": ("preview",),
    "ray features and preview": ("features", "preview"),
    "context latents": ("known", "seen"),
}
FINETUNES = {  # what is zero while the transformer trains on
    "all conditions": (),
    "without rays": TOLD["rays"],
    "without ray features": TOLD["ray features"],
    "without preview": TOLD["preview"],
    "without ray features and preview": TOLD["ray features and preview"],
}


def video_stage(config: RoGeConfig, **changes) -> stages.Stage:
    """Samples of the generator: an ordered window, three photos."""
    base = stages.find_stage(stages.mini_stages(frames=config.frames), "generator")
    views = dataclasses.replace(base.views, contexts=(CONTEXTS,), context_weights=(1.0,))
    return dataclasses.replace(base, views=views, **changes)


def told(
    params: Tree,
    views: model.Views,
    features: jax.Array,
    *,
    config: RoGeConfig,
    shown: jax.Array | None = None,
) -> dict:
    """What the transformer is told beside the photos' latents: rays at generation size, features, the preview's latents.

    `shown`: the picture of the targets, if it was made before (`model.show`).
    """
    found = {
        "rays": plucker(views["K"], views["c2w"], config.height, config.width),
        "features": fusion.standardised(features, config),
    }
    if shown is None:
        shown = model.show(params, features, views, config=config)
    latents = preview.latents(params, shown, config=config)
    return found if latents is None else found | {"preview": latents}


@functools.partial(jax.jit, static_argnames="config")
def clean_latents(params: Tree, views: model.Views, *, config: RoGeConfig) -> jax.Array:
    """x0 of all slots, contexts first."""
    latents = [
        model.encode_contexts(params, views["context_rgb"], config=config),
        model.encode_targets(params, views["target_rgb"], config=config),
    ]
    return jnp.concatenate(latents)


@functools.partial(jax.jit, static_argnames="config")
def clip_of(params: Tree, views: model.Views, *, config: RoGeConfig) -> dict[str, jax.Array]:
    """An encoded sample with the rays in place of the cameras, so that they can be hidden."""
    clip = encoded.encode(params, views, config=config)
    rays = plucker(clip.pop("K"), clip.pop("c2w"), config.height, config.width)
    return clip | {"rays": rays}


def encode_all(params: Tree, batches, config: RoGeConfig) -> dict[str, np.ndarray]:
    """`clip_of` of many samples, stacked [s, ...], with the photos' latents as `known` and in the slots `seen`."""
    rows = [clip_of(params, jax.tree.map(lambda x: x[0], b), config=config) for b in batches]
    clips = {name: np.stack([np.asarray(r[name]) for r in rows]) for name in rows[0]}
    return clips | {"known": clips["x0"][:, :CONTEXTS], "seen": clips["x0"][:, :CONTEXTS]}


def condition(params: Tree, clip, config: RoGeConfig) -> fusion.Condition:
    """What the transformer is told of one encoded clip."""
    return fusion.condition(
        params["fusion"],
        clip["known"],
        clip["rays"],
        jnp.asarray(clip["features"], jnp.float32),
        clip.get("preview"),
        config.fusion.preview_std,
    )


def flow_error(params: Tree, clip, noise, sigma, *, config: RoGeConfig, remat="none") -> jax.Array:
    """|v - (noise - x0)|^2 on the target slots of one clip.

    `known` are the context latents of the appearance condition, `seen` those that are noised in the context slots.
    """
    x0, m = clip["x0"], clip["known"].shape[0]
    cond = condition(params, clip, config)
    x = flow.x_sigma(jnp.concatenate([clip["seen"], x0[m:]]), noise, sigma)
    v = model.velocity(params, x, sigma, cond, config=config, contexts=m, remat=remat)
    return jnp.square(v - flow.velocity_target(x0, noise))[m:].mean()


@functools.partial(jax.jit, static_argnames="config")
def errors_by_sigma(params: Tree, clip, key, sigmas, *, config: RoGeConfig) -> jax.Array:
    noise = jax.random.normal(key, clip["x0"].shape)
    return jax.lax.map(lambda s: flow_error(params, clip, noise, s, config=config), sigmas)


def flow_errors(params: Tree, clips: dict[str, np.ndarray], config: RoGeConfig) -> np.ndarray:
    """[scenes, sigmas], scene i always with the noise of key i."""
    sigmas = jnp.asarray(SIGMAS, jnp.float32)
    rows = [
        errors_by_sigma(params, {k: v[i] for k, v in clips.items()}, jax.random.key(i), sigmas, config=config)
        for i in range(len(clips["x0"]))
    ]  # fmt: skip
    return np.stack([np.asarray(row) for row in rows])


def altered(clips: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """The clips with one condition zeroed, or taken from the next scene."""
    cases = {"all conditions": {}}
    for label, names in TOLD.items():
        if not clips.keys() >= set(names):
            continue
        cases[f"{label}: zero"] = {n: np.zeros_like(clips[n]) for n in names}
        cases[f"{label}: another scene's"] = {n: np.roll(clips[n], 1, 0) for n in names}
    return {label: clips | change for label, change in cases.items()}


def conditions(params: Tree, config: RoGeConfig, scenes: int = 16) -> dict:
    clips = encode_all(params, heldout(video_stage(config), config, scenes), config)
    found = {name: flow_errors(params, case, config) for name, case in altered(clips).items()}
    row = {
        "group": "conditions",
        "sigmas": SIGMAS,
        "errors": {name: e.tolist() for name, e in found.items()},
    }
    if "preview" in clips:
        apart = clips["preview"] - clips["x0"][:, CONTEXTS:]
        row["preview_itself"] = np.square(apart).mean((1, 2, 3, 4)).tolist()
    return row


def finetune(
    params: Tree, config: RoGeConfig, source, steps: int, *, clips: int = 32, scenes: int = 16
) -> dict:
    """The transformer and the fusion trained on, each time with other conditions gated away."""
    stage = video_stage(config, batch=1)
    optim = OptimConfig(learning_rate=3e-4, warmup=10, ema=0.99, weight_decay=0.0)
    data = encode_all(
        params, [stages.stage_batch(source, stage, config, 0, i) for i in range(clips)], config
    )
    test = encode_all(params, heldout(video_stage(config), config, scenes), config)
    trainable, frozen = model.split(params, r"^(dit|fusion)/")
    specs, _ = model.split(model.specs(config), r"^(dit|fusion)/")
    optimiser = make_optimiser(optim, specs, 10**6)

    def objective(trainable, frozen, batch, key):
        def one(clip, key):
            key_sigma, key_noise = jax.random.split(key)
            sigma = flow.training_sigma(
                key_sigma, method=config.flow.sigma_sampling, shift=config.flow.shift
            )
            noise = jax.random.normal(key_noise, clip["x0"].shape)
            whole = attach(frozen, trainable)
            return flow_error(whole, clip, noise, sigma, config=config, remat="dots")

        n = batch["x0"].shape[0]
        return jax.lax.map(lambda a: one(*a), (batch, jax.random.split(key, n))).mean(), {}

    step = jax.jit(loop.make_step(objective, optimiser, optim), donate_argnums=0)

    def without(arrays, names):
        return arrays | {n: np.zeros_like(arrays[n]) for n in names}

    result: dict[str, Any] = {"before": {}, "after": {}, "clocks": {}}
    for name, absent in FINETUNES.items():
        if not data.keys() >= set(absent):
            continue
        state = loop.initial_state(jax.tree.map(jnp.copy, trainable), optimiser, optim)
        rng, clock = np.random.default_rng(0), Clock()
        for i in range(steps):
            rows = rng.choice(clips, 4, replace=False)
            batch = without({k: v[rows] for k, v in data.items()}, absent)
            state, _ = clock.run(step, state, frozen, batch, jax.random.key(i))
        seen = without(test, absent)
        result["before"][name] = flow_errors(params, seen, config).tolist()
        learned = attach(frozen, state["ema"])
        result["after"][name] = flow_errors(learned, seen, config).tolist()
        result["clocks"][name] = clock.record()
    return {"group": "finetune", "sigmas": SIGMAS, "clips": clips, "batch": 4, **result}
