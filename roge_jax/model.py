"""RoGe, top down: photos and rays to scene tokens, ray features, conditions, velocity, loss and video.

Every function takes the parameter tree first and works on one scene (`jax.vmap` adds a batch axis; `loss` does so
itself). A scene's `views` are a dict of arrays, contexts first:

    context_rgb [m, h, w, 3] in [0, 1]      the photos at generation size
    K           [m + n, 3, 3]               intrinsics in pixels of that size
    c2w         [m + n, 4, 4]               camera-to-world, OpenCV, normalised (`geometry.cameras.normalise`)
    vectors     [m, 11]                     `geometry.cameras.camera_vector` of the contexts
    target_rgb  [n, h, w, 3] in [0, 1]      training only
    context_recon, target_recon             optional: the same views at reconstruction size
    full  recon.rendering.Photos            optional: the contexts whole and finer; sampling reads colours from them
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from . import fusion, preview
from .config import RoGeConfig
from .core.layers import resized
from .core.lora import attach, lora_specs
from .core.params import Spec, Tree, zeros
from .core.params import init as init_specs
from .core.params import split as split
from .core.sharding import over_scenes
from .fusion import Condition
from .geometry.rays import plucker
from .recon import ray_scene, vggt
from .recon.picture import decode_rgb as decode_rgb
from .recon.picture import only_targets as only_targets
from .recon.picture import recon_cameras, recon_photos, show, show_all
from .recon.relative import Relative, relative_cameras
from .video import dit, flow, solvers, vae, vae_training

Views = dict[str, Any]

# What trains when pretrained networks are adapted (Sec. 3.3): the new embeddings and E1 fully, the rest by LoRA.
NEW_EMBEDDINGS = r"^fusion/|^dit/patch_embed/"


# The half that makes pictures by itself: its parts of the parameter tree.
RECONSTRUCTION = ("encoder", "renderer")


def specs(config: RoGeConfig) -> Tree:
    """Every leaf of the model, or of the half that `config.parts` names."""
    tree = {
        "encoder": vggt.encoder_specs(config.encoder, config.renderer.width),
        "renderer": ray_scene.renderer_specs(config.renderer),
        "vae": vae.vae_specs(config.vae),
        "dit": dit.dit_specs(config.dit),
        "fusion": fusion.fusion_specs(config),
    }
    if (
        config.dit.text_len
    ):  # the prompt's text embedding, zero-padded: text encoders are not needed afterwards
        shape = (config.dit.text_len, config.dit.text_dim)
        tree["prompt"] = {"rows": Spec(shape, (None, None), zeros)}
    if config.parts == "all":
        return tree
    half = config.parts == "reconstruction"
    return {name: part for name, part in tree.items() if (name in RECONSTRUCTION) == half}


def init(key: jax.Array, config: RoGeConfig, *, make: Callable = init_specs) -> Tree:
    """Random parameters (the VAE from its pass-through initialisation). With `make=params.drawn` all others are drawn
    when they are asked for.
    """
    want = specs(config)
    tree = make(key, {k: s for k, s in want.items() if k != "vae"})
    if "vae" not in want:
        return tree
    return tree | {"vae": vae_training.passthrough_init(jax.random.fold_in(key, 1), config.vae)}


def adapter_specs(config: RoGeConfig) -> Tree:
    """The sparse tree of LoRA factors of both halves."""
    tree, lora = specs(config), config.lora
    recon = lora_specs(
        {k: tree[k] for k in ("encoder", "renderer")}, lora.recon_rank, lora.recon_match
    )
    return {**recon, "dit": lora_specs(tree["dit"], lora.dit_rank, lora.dit_match)}


# Reconstruction (Sec. 3.1).


@jax.named_scope("reconstruct")
def reconstruct(params: Tree, views: Views, *, config: RoGeConfig) -> jax.Array:
    """The implicit scene: tokens Z [m, l, d] of the context photos."""
    size = (config.recon_height, config.recon_width)
    images = recon_photos(views, config)
    m = images.shape[0]
    K, c2w = recon_cameras(views, config)
    rays = plucker(K[:m], c2w[:m], *size)
    return vggt.encode_scene(
        params["encoder"], images, views["vectors"], rays, K[:m], c2w[:m], cfg=config.encoder
    )


@jax.named_scope("rays")
def query_rays(
    params: Tree,
    scene_tokens: jax.Array,
    views: Views,
    *,
    config: RoGeConfig,
    context: Views | None = None,
) -> jax.Array:
    """Ray features Phi [v, gh, gw, d] of all views in `views`: contexts and targets, contexts first.

    To ask for other views than those (targets alone, say), give them as `views` and the ones that the scene tokens
    were made of as `context`; a shared refinement, which needs the rays of the contexts, cannot do that.
    """
    assert context is None or config.renderer.refinement == "per_view"
    cfg, size = config.renderer, (config.recon_height, config.recon_width)
    K, c2w = recon_cameras(views, config)
    rays: Relative | None = None
    cameras: Relative | None = None
    m = scene_tokens.shape[0]
    encoded = vggt.encoder_grid(config.encoder, *size)
    if cfg.relative_cameras:
        head_dim = cfg.width // cfg.heads
        grid = (size[0] // cfg.patch, size[1] // cfg.patch)
        rays = relative_cameras(K, c2w, size, grid=grid, specials=cfg.registers, head_dim=head_dim)
        seen_K, seen_c2w = recon_cameras(context or views, config)
        cameras = relative_cameras(
            seen_K[:m],
            seen_c2w[:m],
            size,
            grid=encoded,
            specials=0,
            head_dim=head_dim,
        )
    if cfg.merge > 1:
        scene_tokens, cameras = ray_scene.merge_scene(scene_tokens, cameras, encoded, cfg.merge)
    return ray_scene.query_rays(
        params["renderer"],
        scene_tokens,
        plucker(K, c2w, *size),
        cfg=cfg,
        rays=rays,
        cameras=cameras,
        contexts=m,
    )


# Generation (Sec. 3.2).


def encode_contexts(params: Tree, context_rgb: jax.Array, *, config: RoGeConfig) -> jax.Array:
    """X^S [m, lh, lw, 16]: every photo encoded alone, as a video of one frame."""
    return vae.encode_frames(params["vae"], 2.0 * context_rgb - 1.0, cfg=config.vae)


def encode_targets(params: Tree, target_rgb: jax.Array, *, config: RoGeConfig) -> jax.Array:
    """X^T [1 + (n - 1) / 4, lh, lw, 16]: the target video through the causal VAE, in chunks of time if it is large."""
    return vae.encode_any(params["vae"], 2.0 * target_rgb - 1.0, cfg=config.vae)


def decode_video(
    params: Tree, latents: jax.Array, *, config: RoGeConfig, detail: jax.Array | None = None
) -> jax.Array:
    """Target latents [t, lh, lw, 16] -> video [n, h, w, 3] in [0, 1], in chunks of time if it is large.

    `detail` [n, h, w, 3] is added: what the VAE loses of the preview (`preview.lost_detail`).
    """
    video = 0.5 + 0.5 * vae.decode_any(params["vae"], latents, cfg=config.vae)
    return jnp.clip(video if detail is None else video + detail, 0.0, 1.0)


@jax.named_scope("condition")
def condition(
    params: Tree,
    context_latents: jax.Array,
    features: jax.Array,
    views: Views,
    *,
    config: RoGeConfig,
    shown: jax.Array | None = None,
) -> Condition:
    """C = {Y, P, G} from context latents [m, lh, lw, 16] and ray features of all views, contexts first.

    `shown`: the reconstruction's picture of the targets (`show`), which a model with a preview encodes; made here if it
    is not given.
    """
    if shown is None and config.fusion.preview:
        shown = show(params, features, views, config=config)
    guess = None if shown is None else preview.latents(params, shown, config=config)
    rays = plucker(views["K"], views["c2w"], config.height, config.width)
    features = fusion.standardised(features, config)
    return fusion.condition(
        params["fusion"], context_latents, rays, features, guess, config.fusion.preview_std
    )


@jax.named_scope("transformer")
def velocity(
    params: Tree,
    x: jax.Array,
    sigma: jax.Array,
    cond: Condition,
    *,
    config: RoGeConfig,
    contexts: int,
    text: Tree | None = None,
    remat: dit.Remat = "none",
    unroll: int = 1,
) -> jax.Array:
    """V(x, sigma; C) [t, lh, lw, 16], noise - x0. `text` caches `text_cache` over sampling steps; `unroll`
    blocks make a turn of the loop over them."""
    cfg = config.dit
    t, lh, lw, _ = x.shape
    angles = dit.rope_angles(
        fusion.time_index(contexts, t), lh // cfg.patch, lw // cfg.patch, cfg.width // cfg.heads
    )
    rows = None
    if cfg.text_len and text is None:
        rows = dit.context_rows(params["dit"], params["prompt"]["rows"], cfg=cfg)
    output = dit.dit(
        params["dit"],
        jnp.concatenate([x, cond.appearance], -1),
        1000.0 * sigma,
        jnp.asarray(angles),
        cfg=cfg,
        rows=rows,
        kv=text,
        extra_tokens=cond.tokens,
        remat=remat,
        unroll=unroll,
    )
    return preview.velocity(output, x, sigma, cond, contexts)


def text_cache(params: Tree, *, config: RoGeConfig) -> Tree | None:
    """Cross-attention keys and values of the prompt, the same at every sampling step; None without text."""
    if not config.dit.text_len:
        return None
    rows = dit.context_rows(params["dit"], params["prompt"]["rows"], cfg=config.dit)
    return dit.precompute_context(params["dit"], rows, cfg=config.dit)


# Training (Sec. 3.3).


def photometric(rgb: jax.Array, views: Views, *, config: RoGeConfig) -> jax.Array:
    """Mean squared error of the reconstruction's picture [m + n, recon_height, recon_width, 3] of all views."""
    size = (config.recon_height, config.recon_width)
    truth = [
        resized(views[f"{kind}_rgb"], *size)
        if views.get(f"{kind}_recon") is None
        else views[f"{kind}_recon"]
        for kind in ("context", "target")
    ]
    return jnp.square(rgb - jnp.concatenate(truth)).mean()


def flow_matching(
    params: Tree,
    x0: jax.Array,
    cond: Condition,
    key: jax.Array,
    *,
    config: RoGeConfig,
    contexts: int,
    remat: dit.Remat = "full",
    part: tuple[jax.Array | int, int] | None = None,
) -> jax.Array:
    """w(sigma) |M_t (V - (noise - x0))|^2, the mean over target latents, at one random noise level.

    `part`: which part of the noise levels, see `flow.training_sigma`.
    """
    key_sigma, key_noise = jax.random.split(key)
    cfg = config.flow
    sigma = flow.training_sigma(key_sigma, method=cfg.sigma_sampling, shift=cfg.shift, part=part)
    noise = jax.random.normal(key_noise, x0.shape)
    x = flow.x_sigma(x0, noise, sigma)
    v = velocity(params, x, sigma, cond, config=config, contexts=contexts, remat=remat)
    error = (v - flow.velocity_target(x0, noise))[contexts:]
    return (
        flow.loss_weight(sigma, weighting=cfg.weighting, shift=cfg.shift) * jnp.square(error).mean()
    )


def mean_flow_matching(
    params: Tree, x0: jax.Array, cond: Condition, key: jax.Array, *, draws: int, **options
) -> jax.Array:
    """The mean of `flow_matching` over `draws` noise levels, one from each of as many equally likely parts."""
    if draws == 1:
        return flow_matching(params, x0, cond, jax.random.split(key, 1)[0], **options)

    def draw(key_and_part):
        key, part = key_and_part
        return flow_matching(params, x0, cond, key, part=(part, draws), **options)

    return jax.lax.map(draw, (jax.random.split(key, draws), jnp.arange(draws))).mean()


def scene_loss(
    params: Tree,
    views: Views,
    key: jax.Array,
    *,
    config: RoGeConfig,
    draws: int = 1,
    remat: dit.Remat = "full",
) -> dict[str, jax.Array]:
    """Both terms of the joint loss for one scene.

    `draws` noise levels share one reconstruction and one encoding of the scene: the flow term is their mean.
    """
    m = views["context_rgb"].shape[0]
    features = query_rays(params, reconstruct(params, views, config=config), views, config=config)
    x0 = jnp.concatenate(
        [
            encode_contexts(params, views["context_rgb"], config=config),
            encode_targets(params, views["target_rgb"], config=config),
        ]
    )
    rgb = decode_rgb(params, features, views, config=config)
    cond = condition(params, x0[:m], features, views, config=config, shown=rgb[m:])
    return {
        "flow": mean_flow_matching(
            params, x0, cond, key, draws=draws, config=config, contexts=m, remat=remat
        ),
        "photometric": photometric(rgb, views, config=config),
    }


def loss(
    trainable: Tree,
    frozen: Tree,
    batch: Views,
    key: jax.Array,
    *,
    config: RoGeConfig,
    draws: int = 1,
    remat: dit.Remat = "full",
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """L = L_FM + lambda L_photometric, the mean over a batch of scenes (leading axis of every array), and its terms.

    `trainable` and `frozen` are sparse trees that together make the model; LoRA factors are leaves of `trainable`
    beside the frozen kernels they adapt. What trains is therefore an argument.
    """
    params = attach(frozen, trainable)
    scenes = batch["K"].shape[0]
    term = functools.partial(scene_loss, config=config, draws=draws, remat=remat)
    terms = over_scenes(term, params, batch, jax.random.split(key, scenes))
    terms = {name: value.mean() for name, value in terms.items()}
    return terms["flow"] + config.flow.photometric * terms["photometric"], terms


# Sampling.


class Prepared(NamedTuple):
    """All that sampling needs and that no noise level changes; computed once per window."""

    context_latents: jax.Array  # [m, lh, lw, 16]
    features: jax.Array  # [m + n, gh, gw, d]
    shown: jax.Array  # [n, recon_height, recon_width, 3], see `show`
    condition: Condition
    text: Tree | None
    detail: jax.Array | None  # [n, h, w, 3], see `preview.lost_detail`
    full: jax.Array | None = (
        None  # [n, H, W, 3]: `shown` at the output's size, where views have `full`
    )


def prepare(
    params: Tree, views: Views, *, config: RoGeConfig, scene_tokens: jax.Array | None = None
) -> Prepared:
    """Reconstruct, query the rays of all views, encode the photos. `scene_tokens`: reuse those of the same photos."""
    if scene_tokens is None:
        scene_tokens = reconstruct(params, views, config=config)
    features = query_rays(params, scene_tokens, views, config=config)
    latents = encode_contexts(params, views["context_rgb"], config=config)
    shown, full = show_all(params, features, views, config=config, full=True)
    cond = condition(params, latents, features, views, config=config, shown=shown)
    detail = preview.lost_detail(params, shown, cond, config=config)
    text = text_cache(params, config=config)
    return Prepared(latents, features, shown, cond, text, detail, full)


def draw_noise(key: jax.Array, contexts: int, *, config: RoGeConfig) -> jax.Array:
    """Gaussian noise for all latent slots of a window [m + 1 + (n - 1) / 4, lh, lw, 16]."""
    return jax.random.normal(key, (config.slots(contexts), *config.latent_size, config.vae.latent))


def sampling_field(
    params: Tree,
    prepared: Prepared,
    noise: jax.Array,
    *,
    config: RoGeConfig,
    mode: flow.ContextSlots = "noised",
) -> tuple[Callable, Callable | None]:
    """(velocity(x, sigma), project(x, sigma) or None) for the functions of `video.solvers`."""
    m = prepared.context_latents.shape[0]

    def field(x, sigma):
        return velocity(
            params, x, sigma, prepared.condition, config=config, contexts=m, text=prepared.text
        )

    return field, flow.context_projection(prepared.context_latents, noise, mode)


def generate(
    params: Tree,
    prepared: Prepared,
    noise: jax.Array,
    *,
    config: RoGeConfig,
    solver: "str | solvers.Table" = "euler",
    sigmas: np.ndarray | None = None,
    mode: flow.ContextSlots = "noised",
) -> tuple[jax.Array, solvers.SolveInfo]:
    """Integrate from noise to the target latents [t, lh, lw, 16]; context slots are dropped. Jit-able."""
    field, project = sampling_field(params, prepared, noise, config=config, mode=mode)
    x0, info = solvers.solve(solver, field, noise, sigmas, project=project)
    return x0[prepared.context_latents.shape[0] :], info
