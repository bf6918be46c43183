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
from .core.lora import attach
from .core.params import Tree
from .core.params import split as split
from .core.sharding import over_scenes
from .fusion import Condition
from .geometry.rays import plucker
from .leaves import NEW_EMBEDDINGS as NEW_EMBEDDINGS
from .leaves import RECONSTRUCTION as RECONSTRUCTION
from .leaves import adapter_specs as adapter_specs
from .leaves import init as init
from .leaves import specs as specs
from .recon import ray_scene, vggt
from .recon.picture import decode_rgb as decode_rgb
from .recon.picture import only_targets as only_targets
from .recon.picture import recon_cameras, recon_photos, show, show_all
from .recon.relative import Relative, relative_cameras
from .video import dit, flow, solvers, vae

Views = dict[str, Any]

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


def noised(
    params: Tree,
    x0: jax.Array,
    cond: Condition,
    key: jax.Array,
    *,
    config: RoGeConfig,
    contexts: int,
    remat: dit.Remat = "full",
    part: tuple[jax.Array | int, int] | None = None,
) -> flow.Noised:
    """Latents of all slots x0 [t, lh, lw, 16] at one random noise level, and their velocity.

    `part`: which part of the noise levels, see `flow.training_sigma`.
    """
    key_sigma, key_noise = jax.random.split(key)
    cfg = config.flow
    sigma = flow.training_sigma(key_sigma, method=cfg.sigma_sampling, shift=cfg.shift, part=part)
    noise = jax.random.normal(key_noise, x0.shape)
    x = flow.x_sigma(x0, noise, sigma)
    v = velocity(params, x, sigma, cond, config=config, contexts=contexts, remat=remat)
    return flow.Noised(sigma, noise, x, v, flow.denoised(x, v, sigma))


def noised_draws(params: Tree, x0, cond: Condition, key, *, draws: int, **options) -> flow.Noised:
    """`noised` at `draws` levels, one from each of as many equally likely parts: all arrays have that leading axis."""
    keys = jax.random.split(key, draws)
    if draws == 1:
        return jax.tree.map(lambda x: x[None], noised(params, x0, cond, keys[0], **options))

    def draw(key_and_part):
        key, part = key_and_part
        return noised(params, x0, cond, key, part=(part, draws), **options)

    return jax.lax.map(draw, (keys, jnp.arange(draws)))


def flow_error(
    draws: flow.Noised, x0: jax.Array, *, config: RoGeConfig, contexts: int
) -> jax.Array:
    """The flow term of what `noised_draws` gives: w(sigma) |M_t (V - (noise - x0))|^2, the mean over the levels."""
    cfg = config.flow
    one = functools.partial(flow.error, contexts=contexts, weighting=cfg.weighting, shift=cfg.shift)
    return jax.vmap(one, in_axes=(0, None))(draws, x0).mean()


def flow_matching(
    params: Tree, x0, cond: Condition, key, *, config, contexts: int, draws: int = 1, **options
) -> jax.Array:
    """The flow term of latents x0 [t, lh, lw, 16] under a condition; `options` are those of `noised`."""
    common = {"config": config, "contexts": contexts}
    found = noised_draws(params, x0, cond, key, draws=draws, **common, **options)
    return flow_error(found, x0, **common)


class Intermediates(NamedTuple):
    """Every named quantity of one training sample: m contexts, n targets, t = m + 1 + (n - 1) / 4 latent slots.

    The last five have a leading axis of noise levels, [1] unless `draws` asks for more. Contexts come first.
    """

    scene_tokens: jax.Array  # [m, l, d]
    features: jax.Array  # [m + n, gh, gw, d]
    rgb: jax.Array  # [m + n, recon_height, recon_width, 3], the reconstruction's picture
    x0: jax.Array  # [t, lh, lw, 16]
    condition: Condition
    sigma: jax.Array  # [draws]
    noise: jax.Array  # [draws, t, lh, lw, 16], and so are the next
    x_sigma: jax.Array
    velocity: jax.Array  # the network's; to be learned: noise - x0
    predicted_x0: jax.Array  # x_sigma - sigma velocity

    @property
    def noised(self) -> flow.Noised:
        """The part that belongs to noise levels."""
        return flow.Noised(*(getattr(self, name) for name in flow.Noised._fields))


def intermediates(
    params: Tree,
    views: Views,
    key: jax.Array,
    *,
    config: RoGeConfig,
    draws: int = 1,
    remat: dit.Remat = "full",
) -> Intermediates:
    """What the loss of one scene is made of. What is not used costs nothing under `jax.jit`.

    `draws` noise levels share one reconstruction and one encoding of the scene.
    """
    m = views["context_rgb"].shape[0]
    tokens = reconstruct(params, views, config=config)
    features = query_rays(params, tokens, views, config=config)
    known = encode_contexts(params, views["context_rgb"], config=config)
    made = encode_targets(params, views["target_rgb"], config=config)
    x0 = jnp.concatenate([known, made])
    rgb = decode_rgb(params, features, views, config=config)
    cond = condition(params, x0[:m], features, views, config=config, shown=rgb[m:])
    options = {"config": config, "contexts": m, "remat": remat}
    found = noised_draws(params, x0, cond, key, draws=draws, **options)
    return Intermediates(tokens, features, rgb, x0, cond, *found)


Term = Callable[[Intermediates, Views], dict[str, jax.Array]]


def scene_loss(
    params: Tree,
    views: Views,
    key: jax.Array,
    *,
    config: RoGeConfig,
    more: Term | None = None,
    **options,
) -> dict[str, jax.Array]:
    """Both terms of the joint loss for one scene, and those of `more`; `options` are those of `intermediates`."""
    found = intermediates(params, views, key, config=config, **options)
    m = views["context_rgb"].shape[0]
    terms = {
        "flow": flow_error(found.noised, found.x0, config=config, contexts=m),
        "photometric": photometric(found.rgb, views, config=config),
    }
    return terms if more is None else terms | more(found, views)


def loss(
    trainable: Tree,
    frozen: Tree,
    batch: Views,
    key: jax.Array,
    *,
    config: RoGeConfig,
    draws: int = 1,
    remat: dit.Remat = "full",
    more: Term | None = None,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """L = L_FM + lambda L_photometric, the mean over a batch of scenes (leading axis of every array), and its terms.

    `trainable` and `frozen` are sparse trees that together make the model; LoRA factors are leaves of `trainable`
    beside the frozen kernels they adapt. What trains is therefore an argument. `more(intermediates, views)`: further
    terms of one scene by name, which are added as they are; one of the two names takes that term's place.
    """
    params = attach(frozen, trainable)
    scenes = batch["K"].shape[0]
    term = functools.partial(scene_loss, config=config, draws=draws, remat=remat, more=more)
    terms = over_scenes(term, params, batch, jax.random.split(key, scenes))
    terms = {name: value.mean() for name, value in terms.items()}
    added = sum(value for name, value in terms.items() if name not in ("flow", "photometric"))
    return terms["flow"] + config.flow.photometric * terms["photometric"] + added, terms


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
    solver: "str | solvers.Table | solvers.Sampler" = "euler",
    sigmas: np.ndarray | None = None,
    mode: flow.ContextSlots = "noised",
) -> tuple[jax.Array, solvers.SolveInfo]:
    """Integrate from noise to the target latents [t, lh, lw, 16]; context slots are dropped. Jit-able."""
    field, project = sampling_field(params, prepared, noise, config=config, mode=mode)
    x0, info = solvers.solve(solver, field, noise, sigmas, project=project)
    return x0[prepared.context_latents.shape[0] :], info
