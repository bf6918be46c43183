"""Variants of the reconstruction branch, each trained from nothing for the same FLOPs."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.ablation.common import CONTEXTS, SCENES, Clock, heldout, muon_flops, trained
from roge_jax import cost, model
from roge_jax.config import RoGeConfig, to_dict
from roge_jax.core.params import Tree, flatten, unflatten
from roge_jax.core.params import init as init_specs
from roge_jax.data.views import ViewConfig
from roge_jax.recon.picture import decode_all
from roge_jax.recon.vggt import encoder_grid
from roge_jax.training import loop, stages
from roge_jax.training.optim import make_optimiser

PHOTOS = (1, 2, 3, 4, 6)


@dataclass(frozen=True)
class Variant:
    """A change of the base: fields of the encoder, the renderer and the optimiser, or an input that is hidden."""

    question: str
    encoder: dict[str, Any] = field(default_factory=dict)
    renderer: dict[str, Any] = field(default_factory=dict)
    optim: dict[str, Any] = field(default_factory=dict)
    hide: str | None = None  # "rays": the encoder sees photos and camera tokens, but no ray maps
    seed: int = 0
    reference: str = "base"  # what it is compared with


def _width(d: int) -> dict[str, Any]:
    return {"encoder": {"width": d}, "renderer": {"width": d}}


_NO_RELATIVE = {"relative_cameras": False}
VARIANTS = {
    "base": Variant("seed"),
    "base, seed 1": Variant("seed", seed=1),
    "encoder depth 2": Variant("depth", encoder={"depth": 2}),
    "encoder depth 4": Variant("depth", encoder={"depth": 4}),
    "renderer depth 3": Variant("depth", renderer={"depth": 3}),
    "renderer depth 8": Variant("depth", renderer={"depth": 8}),
    "width 128": Variant("width", **_width(128)),
    "width 256": Variant("width", **_width(256)),
    "no registers": Variant("registers", encoder={"registers": 0}, renderer={"registers": 0}),
    "bidirectional": Variant("refinement", renderer={"attention": "bidirectional"}),
    "renderer cameras absolute": Variant("cameras", renderer=_NO_RELATIVE),
    "full attention": Variant(  # which has no relative form: compared with a base without it
        "refinement",
        renderer={"attention": "full"} | _NO_RELATIVE,
        reference="renderer cameras absolute",
    ),
    "all cameras absolute": Variant("cameras", encoder=_NO_RELATIVE, renderer=_NO_RELATIVE),
    "no rays in the encoder": Variant("cameras", hide="rays"),
    "AdamW 1e-3": Variant("optimiser", optim={"name": "adamw", "learning_rate": 1e-3}),
    "AdamW 3e-4": Variant("optimiser", optim={"name": "adamw", "learning_rate": 3e-4}),
}


def varied(config: RoGeConfig, variant: Variant) -> RoGeConfig:
    return dataclasses.replace(
        config,
        encoder=dataclasses.replace(config.encoder, **variant.encoder),
        renderer=dataclasses.replace(config.renderer, **variant.renderer),
    )


def recon_stage(variant: Variant, *, batch: int = 8) -> stages.Stage:
    base = stages.find_stage(stages.mini_stages(), "recon_low")
    optim = dataclasses.replace(base.optim, **variant.optim)
    views = ViewConfig(contexts=(CONTEXTS,), context_weights=(1.0,), targets=4, near=0.5)
    return dataclasses.replace(base, optim=optim, views=views, batch=batch)


def blind(params: Tree, hide: str | None) -> Tree:
    """`params` with the kernel of a hidden input zero, so that neither it nor its gradient exists."""
    if hide is None:
        return params
    flat = flatten(params)
    path = "encoder/patch_encoder/patch_embed/kernel"  # [p, p, 3 of RGB and 6 of the ray, d]
    flat[path] = flat[path].at[:, :, 3:].set(0.0)
    return unflatten(flat)


def step_flops(variant: Variant, config: RoGeConfig) -> float:
    """Of one training step: forward, its recomputation and twice as much backward, and Muon's iterations."""
    stage = recon_stage(variant)
    config = stages.stage_config(varied(config, variant), stage)
    e, r, size = config.encoder, config.renderer, (config.recon_height, config.recon_width)
    rows, columns = encoder_grid(e, *size)
    forward = cost.encoder(e, *size, CONTEXTS, r.width)
    seen = CONTEXTS * rows * columns
    forward += cost.renderer(r, *size, seen, CONTEXTS, stage.views.targets)
    update = 0.0
    if stage.optim.name == "muon":
        update = muon_flops(model.split(model.specs(config), stage.trains)[0])
    return 4.0 * stage.batch * forward + update


def program(variant: Variant, config: RoGeConfig, steps: int):
    """(stage, its configuration, specs of what trains, objective, optimiser) of a variant."""
    stage = recon_stage(variant)
    config = stages.stage_config(varied(config, variant), stage)
    specs, _ = model.split(model.specs(config), stage.trains)

    def objective(trainable, frozen, batch, key):
        hidden = blind(trainable, variant.hide)
        return stages.recon_objective(hidden, frozen, batch, key, config=config, stage=stage)

    return stage, config, specs, objective, make_optimiser(stage.optim, specs, steps)


def look_up(params: Tree, config: RoGeConfig, scenes: int = SCENES) -> dict[str, Any]:
    """PSNR per held-out scene of the RGB head, of the photos' colours alone and of both, for 1 to 6 photos."""

    @jax.jit
    def score(params, views):
        tokens = model.reconstruct(params, views, config=config)
        targets = model.only_targets(views)
        features = model.query_rays(params, tokens, targets, config=config, context=views)
        shown = decode_all(params, features, targets, config=config, context=views)
        truth = views["target_rgb"]
        return [jnp.square(x - truth).mean() for x in (shown.head, shown.photos, shown.rgb)]

    base = stages.find_stage(stages.mini_stages(), "lookup")
    found = {}
    for m in PHOTOS:
        views = dataclasses.replace(base.views, contexts=(m,), context_weights=(1.0,), targets=8)
        batches = heldout(dataclasses.replace(base, views=views), config, scenes)
        errors = [score(params, {k: x[0] for k, x in batch.items()}) for batch in batches]
        found[m] = (-10 * np.log10(np.array(errors).T)).tolist()
    return {"group": "look-up", "parts": ["RGB head", "photos alone", "both"], "psnr": found}


def train(
    variant: Variant, config: RoGeConfig, source, steps: int, scenes: int = SCENES
) -> dict[str, Any]:
    """Train one variant for the FLOPs of `steps` steps of the base; score it halfway and at the end."""
    per_step = step_flops(variant, config)
    steps = max(2, round(steps * step_flops(VARIANTS["base"], config) / per_step))
    stage, config, specs, objective, optimiser = program(variant, config, steps)
    step = jax.jit(loop.make_step(objective, optimiser, stage.optim), donate_argnums=0)
    score = jax.jit(objective)
    views = dataclasses.replace(stage.views, targets=8)
    batches = heldout(dataclasses.replace(stage, views=views), config, scenes)

    def psnr(params):
        return [float(score(params, {}, b, jax.random.key(0))[1]["psnr"]) for b in batches]

    trainable = init_specs(jax.random.key(variant.seed), specs)
    state = loop.initial_state(trainable, optimiser, stage.optim)
    clock, halfway = Clock(), float("nan")
    for i in range(steps):
        batch = stages.stage_batch(source, stage, config, variant.seed, i)
        state, metrics = clock.run(step, state, {}, batch, jax.random.key(i))
        if i + 1 == steps // 2:
            halfway = float(np.mean(psnr(state["ema"])))
    reached = {
        "skipped": int(metrics["skipped"]),
        "psnr": psnr(state["ema"]),
        "halfway": halfway,
        "batch": stage.batch,
        "config": {name: to_dict(config)[name] for name in ("encoder", "renderer")},
    }
    return trained("reconstruction", variant, specs, steps * per_step, clock, **reached)
