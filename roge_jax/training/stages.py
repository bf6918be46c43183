"""The stages of training: what each one trains, on which samples, with which loss.

A stage's objective is `objective(trainable, frozen, batch, key, config=..., stage=...) -> (loss, terms)`, differentiated
in its first argument. `vae`, `recon` and `prior` make the networks that RoGe takes as pretrained; `joint` is the
paper's end-to-end step; `hires` is its second stage, at higher resolution with the reconstruction frozen.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from .. import fusion, model, preview
from ..config import RoGeConfig
from ..core import products
from ..core.lora import attach
from ..core.params import Tree, loaded
from ..data.views import ViewConfig, draw_batch
from ..errors import UserError, did_you_mean
from ..recon.depth import FINER
from ..recon.picture import decode_all
from ..video import dit, vae, vae_training
from . import encoded, matching
from .optim import OptimConfig


@dataclass(frozen=True)
class Stage:
    name: str
    objective: str  # vae | recon | match | prior | joint | encoded
    trains: str  # regular expression for parameter paths
    steps: int
    batch: int
    optim: OptimConfig
    views: ViewConfig = field(default_factory=ViewConfig)
    draws: int = 1  # noise levels per scene and step
    lora: bool = False  # add LoRA factors to what trains
    remat: dit.Remat = "dots"  # what the transformer's backward pass recomputes
    products: str | None = (
        None  # what matrix products read (`core.products`); None: the dtype in which weights are kept
    )
    crop: int | None = None  # side of random square crops (VAE stages)
    recon_shrink: int = 1  # divides the size at which the reconstruction works
    lookup: bool = False  # train the photo look-up on a finished reconstruction
    about_preview: bool = False  # measure the preview first, if nobody has: `measure_preview`
    stored: int = 0  # samples that were encoded once (`once_encoded`); 0: every sample is new


def vae_objective(trainable, frozen, batch, key, *, config, stage):
    """Reconstruction and KL of clips [b, t, h, w, 3] in [0, 1]."""
    p = attach(frozen, trainable)["vae"]
    keys = jax.random.split(key, batch["target_rgb"].shape[0])
    losses, terms = jax.vmap(
        lambda clip, key: vae_training.vae_loss(p, 2.0 * clip - 1.0, key, cfg=config.vae)
    )(batch["target_rgb"], keys)
    return losses.mean(), {name: value.mean() for name, value in terms.items()}


def recon_objective(trainable, frozen, batch, key, *, config, stage):
    """Photometric loss of the RGB head on the targets; of the photo look-up and its two levels in its own stage."""
    params = attach(frozen, trainable)
    if not stage.lookup:
        config = dataclasses.replace(
            config, renderer=dataclasses.replace(config.renderer, lookup=0)
        )

    def scene(params, views):
        tokens = model.reconstruct(params, views, config=config)
        targets = model.only_targets(views)
        features = model.query_rays(params, tokens, targets, config=config, context=views)
        shown = decode_all(params, features, targets, config=config, context=views)

        def error(rgb):
            return jnp.square(rgb - model.resized(views["target_rgb"], *rgb.shape[1:3])).mean()

        return {part: error(getattr(shown, part)) for part in ("rgb", "photos", "coarse")}

    terms = {name: value.mean() for name, value in model.over_scenes(scene, params, batch).items()}
    told = {"psnr": -10 * jnp.log10(terms["rgb"])}
    if not stage.lookup:
        return terms["rgb"], told
    loss = terms["rgb"] + LEVELS * (terms["photos"] + terms["coarse"])
    return loss, told | {"psnr_photos": -10 * jnp.log10(terms["photos"])}


def prior_objective(trainable, frozen, batch, key, *, config, stage):
    """Flow matching without rays or geometry: photos to video, the generator that RoGe starts from."""
    params = attach(frozen, trainable)

    def scene(params, views, key):
        m = views["context_rgb"].shape[0]
        latents = [
            model.encode_contexts(params, views["context_rgb"], config=config),
            model.encode_targets(params, views["target_rgb"], config=config),
        ]
        x0 = jax.lax.stop_gradient(jnp.concatenate(latents))
        cond = fusion.unconditioned(x0[:m], x0.shape[0], config)
        options = {"config": config, "contexts": m, "remat": stage.remat}
        return model.flow_matching(params, x0, cond, key, draws=stage.draws, **options)

    keys = jax.random.split(key, batch["K"].shape[0])
    loss = model.over_scenes(scene, params, batch, keys).mean()
    return loss, {"flow": loss}


def joint_objective(trainable, frozen, batch, key, *, config, stage):
    return model.loss(
        trainable, frozen, batch, key, config=config, draws=stage.draws, remat=stage.remat
    )


def encoded_objective(trainable, frozen, batch, key, *, config, stage):
    """The flow term of `joint_objective` on samples that were encoded before (`training.encoded`)."""
    params = attach(frozen, trainable)
    options = {"config": config, "draws": stage.draws, "remat": stage.remat}
    keys = jax.random.split(key, batch["K"].shape[0])
    term = functools.partial(encoded.flow_term, **options)
    loss = model.over_scenes(term, params, batch, keys).mean()
    return loss, {"flow": loss}


def objective_of(config: RoGeConfig, stage: Stage) -> Callable:
    """objective(trainable, frozen, batch, key) -> (loss, terms) of a stage; `config` is its own (`stage_config`)."""
    return functools.partial(_objective, config=config, stage=stage)


def _objective(trainable, frozen, batch, key, *, config, stage):
    with products.use(stage.products):
        objective = OBJECTIVES[stage.objective]
        return objective(trainable, frozen, batch, key, config=config, stage=stage)


LEVELS = 0.3  # weight of the look-up's levels beside its picture

# Other objectives read the whole model.
READS = {
    "vae": "^vae/",
    "recon": "^(encoder|renderer)/",
    "match": "^renderer/lookup/match/",
    "encoded": "^(dit|fusion|prompt)/",
}

OBJECTIVES = {
    "vae": vae_objective,
    "recon": recon_objective,
    "match": matching.objective,
    "prior": prior_objective,
    "joint": joint_objective,
    "encoded": encoded_objective,
}

_SCRATCH = OptimConfig(
    name="muon", learning_rate=2e-3, warmup=60, decay=0.5, weight_decay=0.0, ema=0.998
)

_GENTLE = dataclasses.replace(_SCRATCH, learning_rate=1e-3)

# One scene a step on a trained model: steps of twice the rate undo more than they learn (docs/notes/making_mini.md).
_FINE = dataclasses.replace(_SCRATCH, learning_rate=2e-4, warmup=10, betas=(0.9, 0.98), ema=0.99)
# Small convolutions, many with one output: Muon was not tried.
_SMALL = dataclasses.replace(_SCRATCH, name="adamw", warmup=30, betas=(0.9, 0.98))

RECON = "^(encoder|renderer/(?!lookup/))"  # all of the reconstruction but the look-up
LOOKUP = (
    "^renderer/lookup/(?!match/)"  # what has a stage of its own is told by depth, not by pictures
)
JOINT = "^(dit|fusion|encoder|renderer/(?!lookup/match/))"


def mini_stages(
    scale: float = 1.0, *, frames: int = 17, size: tuple[int, int] = (64, 112)
) -> list[Stage]:
    """The recipe of the shipped small model, in order; `scale` multiplies steps, crops fit into pictures of `size`."""
    crop, fine = min(64, *size), (FINER * size[0], FINER * size[1])
    video = ViewConfig(targets=frames, ordered=True)
    images = ViewConfig(targets=1)
    short = ViewConfig(targets=5, ordered=True)
    views = ViewConfig(targets=8, near=0.5)
    few = ViewConfig(targets=4, near=0.5, faults=0.3, context_weights=(0.05, 0.35, 0.4, 0.2))
    two, often = (2, 3, 4), (0.4, 0.35, 0.25)
    pairs = ViewConfig(two, often, targets=1, near=0.5, size=fine, depth=True)
    stages = [
        Stage("vae_images", "vae", "^vae/", 1000, 6, _SCRATCH, images),
        Stage("vae_clips", "vae", "^vae/", 500, 2, _SCRATCH, short, crop=crop),
        # Whole windows: after short clips alone, frames from the sixth on lose up to 6 dB.
        Stage("vae_longer", "vae", "^vae/", 1500, 1, _GENTLE, video, crop=crop),
        Stage("recon_low", "recon", RECON, 3000, 16, _SCRATCH, views, recon_shrink=2),
        Stage("recon", "recon", RECON, 3000, 8, _SCRATCH, ViewConfig(targets=6)),
        Stage("lookup", "recon", LOOKUP, 3000, 3, _SMALL, few, lookup=True),
        Stage("match", "match", "^renderer/lookup/match/", 1500, 1, _SMALL, pairs),
        Stage("prior", "prior", "^dit/", 400, 4, _SCRATCH, video, draws=4),
        Stage(
            "generator",
            "joint",
            "^(dit|fusion)/",
            3000,
            3,
            _SCRATCH,
            video,
            draws=12,
            about_preview=True,
        ),
        # The latents stay as the generator knows them: only their decoding still improves.
        Stage(
            "vae_decoder", "vae", "^vae/(decoder|post_quant)/", 800, 1, _GENTLE, video, crop=crop
        ),
        Stage("joint", "joint", JOINT, 100, 1, _FINE, video, draws=6),
    ]
    return [dataclasses.replace(s, steps=max(1, round(s.steps * scale))) for s in stages]


def lora_stage(steps: int, *, frames: int = 17, hires: bool = False) -> Stage:
    """The paper's recipe (Sec. 3.3): LoRA on both halves, E1 and the new embeddings fully, AdamW.

    `hires` is its second stage: the reconstruction stays as it is.
    """
    views = ViewConfig(targets=frames, ordered=True)
    name = "hires" if hires else "lora"
    optim = OptimConfig(ema=0.0)
    return Stage(name, "joint", model.NEW_EMBEDDINGS, steps, 1, optim, views, lora=True)


def for_one_scene(stage: Stage) -> Stage:
    """A LoRA stage whose steps see one scene instead of the paper's 192: less noise per step, and smaller steps.

    Drawn once per step at the rate of large batches, the gradients of a small model are mostly noise: its held-out
    loss rises from the first step on. Muon brings the shares of the wide embeddings (`optim.adam_shares`),
    whose steps of one size per weight are too large under AdamW.
    """
    optim = dataclasses.replace(
        stage.optim, name="muon", learning_rate=1e-4, weight_decay=0.0, decay=0.5, ema=0.98
    )
    return dataclasses.replace(stage, draws=8, optim=optim)


def can_store(stage: Stage, config: RoGeConfig) -> bool:
    """Whether a stage may train on samples encoded once: those of the joint objective that train the transformer alone."""
    trained, _ = stage_specs(config, stage)
    return stage.objective == "joint" and set(trained) <= {"dit", "fusion"}


def once_encoded(stage: Stage, config: RoGeConfig, samples: int) -> Stage:
    """The stage on `samples` that are encoded once (`training.encoded`). Raises: UserError if it trains what encodes."""
    if can_store(stage, config):
        return dataclasses.replace(stage, objective="encoded", stored=samples)
    raise UserError(
        f"--encode-once keeps what the networks in front of the transformer say of a sample, and stage {stage.name} "
        "does without them or trains them: give it to generator or hires."
    )


def all_once_encoded(recipe: list[Stage], config: RoGeConfig, samples: int) -> list[Stage]:
    """`once_encoded` for a stage by itself, and for those of a longer recipe that can."""
    alone = len(recipe) == 1
    return [
        once_encoded(stage, config, samples) if alone or can_store(stage, config) else stage
        for stage in recipe
    ]


def find_stage(stages: list[Stage], name: str) -> Stage:
    for stage in stages:
        if stage.name == name:
            return stage
    raise UserError(f"Unknown stage '{name}': {did_you_mean(name, [s.name for s in stages])}")


def stage_config(config: RoGeConfig, stage: Stage) -> RoGeConfig:
    """The model's configuration at the stage's resolution and clip length."""
    size = stage.views.size or (config.height, config.width)
    shrink = stage.recon_shrink
    frames = (
        stage.views.targets if stage.objective in ("joint", "prior", "encoded") else config.frames
    )
    recon = (
        size[0] * config.recon_height // (shrink * config.height),
        size[1] * config.recon_width // (shrink * config.width),
    )
    return dataclasses.replace(config.at_size(*size, recon), frames=frames)


def stage_batch(
    pool, stage: Stage, config: RoGeConfig, seed: int, index: int, rows=None
) -> dict[str, np.ndarray]:
    """Batch number `index` of a stage, or some rows of it; a pure function of its arguments."""
    batch = draw_batch(
        pool, seed, index, stage.batch, stage.views, scale_rule=config.scale_rule, rows=rows
    )
    if stage.objective != "vae":
        return batch
    clips = batch["target_rgb"]
    if stage.crop is None:
        return {"target_rgb": clips}
    rng = np.random.default_rng([seed, index, 1])
    top, left = (int(rng.integers(0, side - stage.crop + 1)) for side in clips.shape[2:4])
    return {"target_rgb": clips[:, :, top : top + stage.crop, left : left + stage.crop]}


def new_leaves(config: RoGeConfig, stage: Stage) -> Tree:
    """Specs of the LoRA factors that a stage adds to the model."""
    adapters = model.adapter_specs(config)
    return {"dit": adapters["dit"]} if stage.name == "hires" else adapters


def stage_specs(config: RoGeConfig, stage: Stage) -> tuple[Tree, Tree]:
    """Specs of the leaves that a stage trains, LoRA factors included, and of those that its objective reads as well."""
    trained, frozen = model.split(model.specs(config), stage.trains)
    if stage.lora:
        trained = attach(trained, new_leaves(config, stage))
    return trained, read(frozen, stage)


def read(frozen: Tree, stage: Stage) -> Tree:
    """Those of the frozen leaves that the stage's objective reads."""
    return model.split(frozen, READS.get(stage.objective, ""))[0]


def moves_latents(trained) -> bool:
    """Whether any of these parameter paths changes the latents of a video."""
    return any(path.startswith(("vae/encoder/", "vae/quant/")) for path in trained)


def measure_latents(
    params: Tree, source, config: RoGeConfig, seed: int, clips: int = 32
) -> RoGeConfig:
    """`config` with the mean and standard deviation per latent channel that this VAE has on training clips."""
    size = config.height, config.width
    views = ViewConfig(targets=config.frames, ordered=True, size=size)
    stage = Stage("", "vae", "", 1, 1, OptimConfig(), views)
    encode = jax.jit(functools.partial(vae.encode_moments, cfg=config.vae))
    weights, found = loaded(params["vae"]), []
    for i in range(clips):
        clip = stage_batch(source, stage, config, seed + 1, i)["target_rgb"][0]
        moments = np.asarray(encode(weights, 2.0 * clip - 1.0))
        found.append(moments[..., : config.vae.latent].reshape(-1, config.vae.latent))
    values = np.concatenate(found).astype(np.float64)
    latents = dataclasses.replace(
        config.vae,
        latent_mean=tuple(float(x) for x in values.mean(0).round(4)),
        latent_std=tuple(float(x) for x in values.std(0).round(4)),
    )
    return dataclasses.replace(config, vae=latents)


def measure_features(
    params: Tree, source, config: RoGeConfig, seed: int, clips: int = 16
) -> tuple[Tree, RoGeConfig]:
    """(params, config) with the mean and deviation of every channel of the ray features on training clips.

    The fusion is rewritten for them and does what it did before.
    """

    def features(params, views):
        tokens = model.reconstruct(params, views, config=config)
        return model.query_rays(params, tokens, views, config=config)

    values = _on_clips(features, params, source, config, seed, clips)
    measured = dataclasses.replace(
        config.fusion,
        feature_mean=tuple(float(f"{x:.5g}") for x in values.mean(0)),
        feature_std=tuple(float(f"{max(x, 1e-3):.5g}") for x in values.std(0)),
    )
    adapter = {"geometry_adapter": loaded(params["fusion"]["geometry_adapter"])}
    moved = fusion.restandardised(params["fusion"] | adapter, config.fusion, measured)
    return params | {"fusion": moved}, dataclasses.replace(config, fusion=measured)


def measure_spread(
    params: Tree, source, config: RoGeConfig, seed: int, clips: int = 32
) -> RoGeConfig:
    """`config` with the preview's root mean square error per latent channel on training clips.

    The unit of what the transformer says: one trained about a worse preview goes on to correct a better one.
    """

    def error(params, views):
        tokens = model.reconstruct(params, views, config=config)
        features = model.query_rays(params, tokens, views, config=config)
        shown = model.show(params, features, views, config=config)
        guess = preview.latents(params, shown, config=config)
        return model.encode_targets(params, views["target_rgb"], config=config) - guess

    values = _on_clips(error, params, source, config, seed, clips)
    rms = np.sqrt(np.square(values).mean(0))
    measured = dataclasses.replace(
        config.fusion, preview_std=tuple(float(f"{max(x, 1e-3):.4g}") for x in rms)
    )
    return dataclasses.replace(config, fusion=measured)


def measure_preview(
    params: Tree, source, config: RoGeConfig, seed: int, clips: int = 32
) -> tuple[Tree, RoGeConfig]:
    """(params, config) with `measure_spread` and a transformer whose head starts from zero.

    What it says means another thing from here on (`preview.velocity`): until it is trained it generates the preview and
    noise of that size.
    """
    config = measure_spread(params, source, config, seed, clips)
    head = jax.tree.map(jnp.zeros_like, loaded(params["dit"]["head"]["linear"]))
    transformer = params["dit"] | {"head": params["dit"]["head"] | {"linear": head}}
    return params | {"dit": transformer}, config


def _on_clips(function, params: Tree, source, config: RoGeConfig, seed: int, clips: int):
    """Rows [.., channels] float64 of `function(params, views)` on training clips with three photos each.

    The function gets the reconstruction and the VAE, in float32.
    """
    size = config.height, config.width
    views = ViewConfig(
        contexts=(3,), context_weights=(1.0,), targets=config.frames, ordered=True, size=size
    )
    stage = Stage("", "joint", "", 1, 1, OptimConfig(), views)
    weights = loaded({part: params[part] for part in encoded.READS})
    run, found = jax.jit(function), []
    for i in range(clips):
        batch = stage_batch(source, stage, config, seed + 1, i)
        one = np.asarray(run(weights, {name: x[0] for name, x in batch.items()}), np.float64)
        found.append(one.reshape(-1, one.shape[-1]))
    return np.concatenate(found)
