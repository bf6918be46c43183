"""Reconstruction-generation fusion (Sec. 3.2 of the paper): hybrid latents, appearance, rays and geometry.

Latent slots are ordered contexts first: one slot per context photo, then those of the target video.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .config import FusionConfig, RoGeConfig
from .core.layers import linear, linear_specs, patch_conv, patch_conv_specs
from .core.params import Tree, zeros
from .geometry.packing import pack_views, pixel_unshuffle

MASK_CHANNELS = 4


class Condition(NamedTuple):
    """What the transformer knows besides the noisy latents: the same at every noise level.

    appearance: [t, lh, lw, 20] = [mask 4, context latents or, on targets, zeros or those of a preview 16];
    tokens: [l, d], the sum of the embedded rays and ray features;
    spread: [16], the deviation of clean target latents from the preview, if there is one and it was measured.
    """

    appearance: jax.Array
    tokens: jax.Array
    spread: jax.Array | None = None


def fusion_specs(config: RoGeConfig) -> Tree:
    """The geometry adapter (random) and the two new patch embeddings (zero: step 0 is the pretrained model)."""
    c, d, patch = config.fusion.geometry_channels, config.dit.width, config.dit.patch
    return {
        "geometry_adapter": linear_specs(config.renderer.width, c, ("embed", None)),
        "rays_embed": patch_conv_specs(patch, 6 * 4 * 64, d, init=zeros),
        "geometry_embed": patch_conv_specs(patch, 4 * c, d, init=zeros),
    }


def standardised(features: jax.Array, config: RoGeConfig) -> jax.Array:
    """Ray features [.., d] with mean 0 and deviation 1 per channel, if their statistics were measured.

    A few channels of a residual stream carry nearly all of its energy and little of what it says; gradients of the
    geometry adapter would be about those alone.
    """
    mean, std = config.fusion.feature_mean, config.fusion.feature_std
    if mean is None or std is None:
        return features
    lead = (None,) * (features.ndim - 1)
    return (features - np.asarray(mean, np.float32)[lead]) / np.asarray(std, np.float32)[lead]


def restandardised(p: Tree, old: FusionConfig, new: FusionConfig) -> Tree:
    """Parameters of the fusion that do with the statistics `new` what `p` did with `old`."""
    adapter = p["geometry_adapter"]
    width = adapter["kernel"].shape[0]
    (m0, s0), (m1, s1) = (
        (np.zeros(width), np.ones(width))
        if c.feature_mean is None or c.feature_std is None
        else (np.asarray(c.feature_mean), np.asarray(c.feature_std))
        for c in (old, new)
    )
    kernel = np.asarray(adapter["kernel"], np.float64)
    bias = np.asarray(adapter["bias"], np.float64) + ((m1 - m0) / s0) @ kernel
    moved = {"kernel": (s1 / s0)[:, None] * kernel, "bias": bias}
    moved = {name: jnp.asarray(x, adapter[name].dtype) for name, x in moved.items()}
    return p | {"geometry_adapter": moved}


def appearance(
    context_latents: jax.Array, slots: int, preview: jax.Array | None = None
) -> jax.Array:
    """Y = [B; [X^S, 0^T]]: context latents [m, lh, lw, 16] -> [slots, lh, lw, 20], mask channels first.

    `preview` [slots - m, lh, lw, 16]: latents that stand in place of 0^T. The mask B is 0 there all the same: they are
    a guess, photos are the truth.
    """
    m, lh, lw, c = context_latents.shape
    guess = jnp.zeros((slots - m, lh, lw, c)) if preview is None else preview
    mask = jnp.arange(slots)[:, None, None, None] < m
    mask = jnp.broadcast_to(mask, (slots, lh, lw, MASK_CHANNELS)).astype(context_latents.dtype)
    return jnp.concatenate([mask, jnp.concatenate([context_latents, guess])], -1)


def ray_condition(plucker: jax.Array, contexts: int) -> jax.Array:
    """P: Plücker maps [m + n, h, w, 6] -> [slots, h/8, w/8, 1536], no ray is lost.

    Channel = (frame of four, Plücker channel, row in block, column in block), slowest first.
    """
    return pack_views(pixel_unshuffle(plucker, 8), contexts)


def geometry_condition(p: Tree, features: jax.Array, latent_size: tuple[int, int], contexts: int):
    """G: ray features [m + n, gh, gw, d] -> [slots, lh, lw, 4C], projected, resampled, four frames to a slot."""
    x = linear(p["geometry_adapter"], features)
    if (
        x.shape[1:3] != latent_size
    ):  # bilinear, half-pixel centres, no antialiasing (as torch's interpolate)
        x = jax.image.resize(
            x, (x.shape[0], *latent_size, x.shape[-1]), "bilinear", antialias=False
        )
    return pack_views(x, contexts)


def condition(
    p: Tree,
    context_latents: jax.Array,
    plucker: jax.Array,
    features: jax.Array,
    preview: jax.Array | None = None,
    preview_std: tuple[float, ...] | None = None,
) -> Condition:
    """All of C = {Y, P, G}; plucker [m + n, h, w, 6] at generation size, features [m + n, gh, gw, d], `preview` as in
    `appearance`, its deviation per channel if it was measured.
    """
    contexts = context_latents.shape[0]
    rays = ray_condition(plucker, contexts)
    lh, lw = rays.shape[1:3]
    geometry = geometry_condition(p, features, (lh, lw), contexts)
    tokens = patch_conv(p["rays_embed"], rays) + patch_conv(p["geometry_embed"], geometry)
    spread = None
    if preview is not None and preview_std is not None:
        spread = jnp.asarray(preview_std, jnp.float32)
    known = appearance(context_latents, rays.shape[0], preview)
    return Condition(known, tokens.reshape(-1, tokens.shape[-1]), spread)


def unconditioned(context_latents: jax.Array, slots: int, config: RoGeConfig) -> Condition:
    """The condition of the generation-only model: appearance, but neither rays nor geometry nor a preview."""
    lh, lw = config.latent_size
    tokens = slots * (lh // config.dit.patch) * (lw // config.dit.patch)
    return Condition(appearance(context_latents, slots), jnp.zeros((tokens, config.dit.width)))


def time_index(contexts: int, slots: int) -> np.ndarray:
    """Temporal position of every slot: 0 (no rotation) on contexts, 0..T-1 along the target trajectory."""
    return np.concatenate([np.zeros(contexts, int), np.arange(slots - contexts)])
