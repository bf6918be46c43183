"""What the generator is told and what it needs of it; and how much rank its adaptation uses."""

import dataclasses
import functools
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from roge_jax import fusion, model, preview
from roge_jax.config import RoGeConfig
from roge_jax.core.lora import attach
from roge_jax.core.params import Tree, count, flatten, unflatten
from roge_jax.core.params import init as init_specs
from roge_jax.geometry.rays import plucker
from roge_jax.training import loop, stages
from roge_jax.training.optim import OptimConfig, make_optimiser
from roge_jax.video import flow

from .common import CONTEXTS, SIGMAS, Clock, heldout

RANKS = (0, 1, 2, 4, 8, 16, 32)
# What the transformer is told, by the names of `encoded`; a model without preview has no such entry.
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


def told(params: Tree, views: model.Views, features: jax.Array, *, config: RoGeConfig) -> dict:
    """What the transformer is told beside the photos' latents: rays at generation size, features, the preview's latents."""
    found = {
        "rays": plucker(views["K"], views["c2w"], config.height, config.width),
        "features": fusion.standardised(features, config),
    }
    shown = model.show(params, features, views, config=config)
    latents = preview.latents(params, shown, config=config)
    return found if latents is None else found | {"preview": latents}


@functools.partial(jax.jit, static_argnames="config")
def encoded(params: Tree, views: model.Views, *, config: RoGeConfig) -> dict[str, jax.Array]:
    """What no noise level changes: latents of all slots, and what the transformer is told."""
    tokens = model.reconstruct(params, views, config=config)
    features = model.query_rays(params, tokens, views, config=config)
    latents = [
        model.encode_contexts(params, views["context_rgb"], config=config),
        model.encode_targets(params, views["target_rgb"], config=config),
    ]
    return {"x0": jnp.concatenate(latents)} | told(params, views, features, config=config)


def encode_all(params: Tree, batches, config: RoGeConfig) -> dict[str, np.ndarray]:
    """`encoded` of many samples, stacked [s, ...], with the photos' latents as `known` and in the slots `seen`."""
    rows = [encoded(params, jax.tree.map(lambda x: x[0], b), config=config) for b in batches]
    clips = {name: np.stack([np.asarray(r[name]) for r in rows]) for name in rows[0]}
    return clips | {"known": clips["x0"][:, :CONTEXTS], "seen": clips["x0"][:, :CONTEXTS]}


def flow_error(params: Tree, clip, noise, sigma, *, config: RoGeConfig, remat="none") -> jax.Array:
    """|v - (noise - x0)|^2 on the target slots of one clip.

    `known` are the context latents of the appearance condition, `seen` those that are noised in the context slots.
    """
    x0, m = clip["x0"], clip["known"].shape[0]
    cond = fusion.condition(
        params["fusion"],
        clip["known"],
        clip["rays"],
        clip["features"],
        clip.get("preview"),
        config.fusion.preview_std,
    )
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


# ---- LoRA: how much rank the update uses ---------------------------------------------------------

FAMILIES = {
    "generator attention": r"^dit/.*attn/",
    "generator MLP": r"^dit/.*ffn/",
    "encoder attention": r"^encoder/.*attn/",
    "encoder MLP": r"^encoder/.*blocks/mlp/",
    "renderer self-attention": r"^renderer/.*self_attn/",
    "renderer cross-attention": r"^renderer/.*(cross|scene)_attn/",
    "renderer MLP": r"^renderer/.*mlp/",
}


def factor_svd(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """U [.., d_in, k], s [.., k] descending, Vt [.., k, d_out] of a @ b, which is never formed; k <= rank."""
    qa, ra = np.linalg.qr(np.asarray(a, np.float64))
    qb, rb = np.linalg.qr(np.swapaxes(np.asarray(b, np.float64), -1, -2))
    u, s, vt = np.linalg.svd(ra @ np.swapaxes(rb, -1, -2), full_matrices=False)
    return qa @ u, s, vt @ np.swapaxes(qb, -1, -2)


def truncated(lora: Tree, rank: int) -> Tree:
    """The best approximation of every update by `rank`, in factors of the same shapes."""
    flat = flatten(lora)
    for path in [p for p in flat if p.endswith("lora_a")]:
        other = path.removesuffix("a") + "b"
        u, s, vt = factor_svd(flat[path], flat[other])
        root = np.sqrt(s * (np.arange(s.shape[-1]) < rank))
        for name, x in ((path, u * root[..., None, :]), (other, root[..., :, None] * vt)):
            padded = np.zeros(flat[name].shape)  # a narrow layer has fewer than `rank` directions
            padded[tuple(slice(0, n) for n in x.shape)] = x
            flat[name] = jnp.asarray(padded, jnp.float32)
    return unflatten(flat)


def spectrum(lora: Tree) -> dict[str, dict]:
    """Per family of layers: mean singular values over the largest, effective ranks, matrices."""
    flat = flatten(lora)
    found: dict[str, list[np.ndarray]] = {}
    for path in [p for p in flat if p.endswith("lora_a")]:
        s = factor_svd(flat[path], flat[path.removesuffix("a") + "b"])[1]
        family = next((f for f, rule in FAMILIES.items() if re.search(rule, path)), "others")
        found.setdefault(family, []).extend(s.reshape(-1, s.shape[-1]))
    rows = {}
    for family, values in found.items():
        values = [s for s in values if s[0] > 0]
        if not values:
            continue
        energy = [np.cumsum(s**2) / np.sum(s**2) for s in values]
        longest = max(map(len, values))
        relative = [np.pad(s / s[0], (0, longest - len(s))) for s in values]
        rows[family] = {
            "matrices": len(values),
            "relative": np.mean(relative, 0).tolist(),
            "stable_rank": float(np.mean([np.sum(s**2) / s[0] ** 2 for s in values])),
            "rank_90": float(np.mean([1 + np.sum(e < 0.9) for e in energy])),
            "rank_99": float(np.mean([1 + np.sum(e < 0.99) for e in energy])),
        }
    return rows


def lora(
    params: Tree, config: RoGeConfig, source, steps: int, *, rank: int = 32, scenes: int = 16
) -> dict:
    """The paper's stage at a high rank for `steps` of one scene, then the update cut to lower ranks."""
    stage = stages.lora_stage(1, frames=config.frames)
    views = dataclasses.replace(stage.views, contexts=(CONTEXTS,), context_weights=(1.0,))
    stage = dataclasses.replace(stage, views=views, draws=4, remat="dots")
    config = dataclasses.replace(config, lora=dataclasses.replace(config.lora, dit_rank=rank, recon_rank=rank))  # fmt: skip
    trainable, frozen = model.split(params, stage.trains)
    added = model.adapter_specs(config)
    specs = attach(model.split(model.specs(config), stage.trains)[0], added)
    trainable = attach(trainable, init_specs(jax.random.key(1), added))
    optimiser = make_optimiser(stage.optim, specs, steps)
    objective = functools.partial(stages.joint_objective, config=config, stage=stage)
    step = jax.jit(loop.make_step(objective, optimiser, stage.optim), donate_argnums=0)
    copied = jax.tree.map(jnp.copy, trainable)  # the step donates its state
    state, clock = loop.initial_state(copied, optimiser, stage.optim), Clock()
    for i in range(steps):
        batch = stages.stage_batch(source, stage, config, 0, i)
        state, _ = clock.run(step, state, frozen, batch, jax.random.key(i))
    learned = flatten(jax.device_get(state["params"]))
    factors = {p: x for p, x in learned.items() if "lora_" in p}
    full = unflatten({p: x for p, x in learned.items() if p not in factors})
    batches = heldout(video_stage(config), config, scenes)

    @jax.jit
    def score(params, views, x0, key):
        """Flow error by noise level, and that of the RGB head, of one scene."""
        tokens = model.reconstruct(params, views, config=config)
        features = model.query_rays(params, tokens, views, config=config)
        clip = {"x0": x0, "known": x0[:CONTEXTS], "seen": x0[:CONTEXTS]}
        clip |= told(params, views, features, config=config)
        sigmas = jnp.asarray(SIGMAS, jnp.float32)
        rgb = model.decode_rgb(params, features, views, config=config)
        photometric = model.photometric(rgb, views, config=config)
        return errors_by_sigma(params, clip, key, sigmas, config=config), photometric

    latents = encode_all(params, batches, config)["x0"]
    nothing = {p: np.zeros_like(x) for p, x in factors.items()}
    losses: dict[str, Any] = {}
    for name, base, cut in (
        ("before", params, unflatten(nothing)),
        *((str(r), attach(params, full), truncated(unflatten(factors), r)) for r in RANKS if r <= rank),
    ):  # fmt: skip
        whole = attach(base, cut)
        rows = [
            score(whole, jax.tree.map(lambda x: x[0], b), x0, jax.random.key(i))
            for i, (b, x0) in enumerate(zip(batches, latents))
        ]
        losses[name] = {
            "flow": [float(np.mean(f)) for f, _ in rows],
            "photometric": [float(p) for _, p in rows],
        }
    return {
        "group": "lora",
        "rank": rank,
        "learning_rate": stage.optim.learning_rate,
        "trained": count(specs),
        "spectrum": spectrum(unflatten(factors)),
        "losses": losses,
        **clock.record(),
    }
