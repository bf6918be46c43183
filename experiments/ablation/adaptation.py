"""LoRA on both halves: the spectrum of its update, and what each rank of it is worth."""

import dataclasses
import functools
import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments import harness
from experiments.ablation.common import CONTEXTS, SIGMAS, Clock, heldout
from experiments.ablation.generator import clean_latents, errors_by_sigma, told, video_stage
from roge_jax import model
from roge_jax.config import RoGeConfig
from roge_jax.core.lora import attach
from roge_jax.core.params import Tree, count, flatten, unflatten
from roge_jax.core.params import init as init_specs
from roge_jax.procedural.scenes import sample_sequence
from roge_jax.training import loop, stages
from roge_jax.training.optim import OptimConfig, make_optimiser

RANKS = (0, 1, 2, 4, 8, 16, 32)
# Of `one_scene`: its seed, degrees of its path, frames of either half; and frames of a window.
SCENE, SWEEP, FRAMES, WINDOW = harness.heldout(1, 100)[0], (100.0, 130.0), 48, 9
ADAPT = OptimConfig(learning_rate=1e-3, warmup=10, decay=0.5)
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


def with_rank(config: RoGeConfig, rank: int) -> RoGeConfig:
    return dataclasses.replace(
        config, lora=dataclasses.replace(config.lora, dit_rank=rank, recon_rank=rank)
    )


class Learned(NamedTuple):
    """What a run changed: leaves that train fully, LoRA factors, and how many weights both are."""

    full: Tree
    factors: Tree
    trained: int
    clock: Clock


def learn(params: Tree, config: RoGeConfig, stage: stages.Stage, source, steps: int) -> Learned:
    """`steps` of a LoRA stage at the ranks of `config`."""
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
    full = {p: x for p, x in learned.items() if p not in factors}
    return Learned(unflatten(full), unflatten(factors), count(specs), clock)


@functools.partial(jax.jit, static_argnames="config")
def _score(params: Tree, views: model.Views, x0, key, *, config: RoGeConfig):
    """Flow error by noise level, and the error of the reconstruction's picture, of one sample."""
    tokens = model.reconstruct(params, views, config=config)
    features = model.query_rays(params, tokens, views, config=config)
    rgb = model.decode_rgb(params, features, views, config=config)
    clip = {"x0": x0, "known": x0[:CONTEXTS], "seen": x0[:CONTEXTS]}
    clip |= told(params, views, features, config=config, shown=rgb[CONTEXTS:])
    sigmas = jnp.asarray(SIGMAS, jnp.float32)
    photometric = model.photometric(rgb, views, config=config)
    return errors_by_sigma(params, clip, key, sigmas, config=config), photometric


def losses(params: Tree, config: RoGeConfig, learned: Learned, batches, ranks) -> dict[str, Any]:
    """Held-out losses of every sample before, and after with each update cut to `ranks`."""
    samples = [jax.tree.map(lambda x: x[0], b) for b in batches]
    latents = [clean_latents(params, views, config=config) for views in samples]
    nothing = jax.tree.map(np.zeros_like, learned.factors)
    after, found = attach(params, learned.full), {}
    cuts = {str(r): (after, truncated(learned.factors, r)) for r in ranks}
    for name, (base, cut) in ({"before": (params, nothing)} | cuts).items():
        whole = attach(base, cut)
        rows = [
            _score(whole, views, x0, jax.random.key(i), config=config)
            for i, (views, x0) in enumerate(zip(samples, latents))
        ]
        found[name] = {
            "flow": [float(np.mean(f)) for f, _ in rows],
            "photometric": [float(p) for _, p in rows],
        }
    return found


def lora(
    params: Tree, config: RoGeConfig, source, steps: int, *, rank: int = 32, scenes: int = 16
) -> dict:
    """The paper's stage at a high rank for `steps` of one scene, then the update cut to lower ranks."""
    stage = stages.lora_stage(1, frames=config.frames)
    views = dataclasses.replace(stage.views, contexts=(CONTEXTS,), context_weights=(1.0,))
    stage = dataclasses.replace(stage, views=views, draws=4, remat="dots")
    config = with_rank(config, rank)
    learned = learn(params, config, stage, source, steps)
    batches = heldout(video_stage(config), config, scenes)
    return {
        "group": "lora",
        "rank": rank,
        "learning_rate": stage.optim.learning_rate,
        "trained": learned.trained,
        "spectrum": spectrum(learned.factors),
        "losses": losses(params, config, learned, batches, [r for r in RANKS if r <= rank]),
        **learned.clock.record(),
    }


def one_scene(config: RoGeConfig) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """(every other frame to train on, the frames between them to score) of one long, wide path in an unknown room."""
    views = sample_sequence(
        SCENE, frames=2 * FRAMES, height=config.height, width=config.width, sweep=SWEEP, depth=False
    )
    learnt, kept = ({name: x[k::2] for name, x in views.items()} for k in (0, 1))
    return learnt, kept


def adapt(
    params: Tree, config: RoGeConfig, steps: int, *, rank: int, ranks=(), windows: int = 12
) -> dict:
    """The LoRA stage on one scene alone, a window a step; losses on windows of its frames kept back.

    `ranks`: the update is scored cut to these too. `elsewhere` has the losses on as many other scenes.
    """
    config = with_rank(dataclasses.replace(config, frames=WINDOW), rank)
    stage = stages.lora_stage(1, frames=WINDOW)
    views = dataclasses.replace(
        stage.views, contexts=(CONTEXTS,), context_weights=(1.0,), augment=False
    )
    stage = dataclasses.replace(stage, views=views, draws=4, remat="dots", optim=ADAPT)
    learnt, kept = one_scene(config)
    learned = learn(params, config, stage, [learnt], steps)
    fixed = video_stage(config, batch=1)
    fixed = dataclasses.replace(fixed, views=fixed.views.undisturbed())
    batches = [stages.stage_batch([kept], fixed, config, 0, i) for i in range(windows)]
    others = heldout(fixed, config, windows)
    score = functools.partial(losses, params, config, learned)
    return {
        "group": "adaptation",
        "rank": rank,
        "learning_rate": ADAPT.learning_rate,
        "scene": {"seed": SCENE, "sweep": SWEEP, "frames": FRAMES, "window": WINDOW},
        "trained": learned.trained,
        "spectrum": spectrum(learned.factors),
        "losses": score(batches, sorted({*ranks, 0, rank})),
        "elsewhere": score(others, [rank]),
        **learned.clock.record(),
    }
