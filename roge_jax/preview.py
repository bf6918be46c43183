"""The preview: the reconstruction's own frames of the targets, and what they spare a small video transformer.

Not in the paper (`FusionConfig.preview`, on in `mini`). A large pretrained transformer can learn to turn ray features
into latents; a small one spends its training on becoming a second encoder, and its VAE blurs all that passes. So the
frames of the RGB head, encoded, stand where the condition has zeros; once their error was measured the transformer
says only how the velocity differs from what they imply; and generated frames get back what the VAE loses of them.
"""

import jax
import jax.numpy as jnp

from .config import RoGeConfig
from .core.layers import resized
from .core.params import Tree
from .fusion import MASK_CHANNELS, Condition
from .recon import ray_scene
from .video import flow, vae


def frames(params: Tree, features: jax.Array, *, config: RoGeConfig) -> jax.Array:
    """The RGB head's picture of ray features [n, gh, gw, d] at the video's size [n, h, w, 3]."""
    rgb = ray_scene.decode_rgb(params["renderer"]["rgb_head"], features, cfg=config.renderer)
    return resized(rgb, config.height, config.width)


def latents(params: Tree, features: jax.Array, *, config: RoGeConfig) -> jax.Array | None:
    """`frames` of the targets' ray features, encoded [1 + (n - 1) / 4, lh, lw, 16]; None for a model without preview.

    No gradient passes: the features learn through G and the photometric term.
    """
    if not config.fusion.preview:
        return None
    video = 2.0 * frames(params, jax.lax.stop_gradient(features), config=config) - 1.0
    return jax.lax.stop_gradient(vae.encode_any(params["vae"], video, cfg=config.vae))


def velocity(
    output: jax.Array, x: jax.Array, sigma: jax.Array, cond: Condition, contexts: int
) -> jax.Array:
    """The velocity that the transformer's `output` [t, lh, lw, 16] stands for at x [t, lh, lw, 16].

    Targets with a preview of known error: mean + deviation * output (`flow.velocity_about`), as Karras et al. (2022)
    precondition a denoiser about 0. Everything else is the velocity itself.
    """
    if cond.spread is None:
        return output
    guess = cond.appearance[contexts:, ..., MASK_CHANNELS:]
    mean, deviation = flow.velocity_about(guess, cond.spread, x[contexts:], sigma)
    return jnp.concatenate([output[:contexts], mean + deviation * output[contexts:]])


def lost_detail(
    params: Tree, features: jax.Array, cond: Condition, *, config: RoGeConfig
) -> jax.Array | None:
    """What the VAE loses of the preview [n, h, w, 3]: `frames` less `latents` decoded; None without a preview.

    `features` and `cond` are those of a whole window. Where the transformer leaves the preview's latents as they are,
    decoding them and adding this gives the reconstruction's own picture.
    """
    if not config.fusion.preview:
        return None
    shown = frames(params, features[-config.frames :], config=config)
    guess = cond.appearance[-config.slots(0) :, ..., MASK_CHANNELS:]
    return shown - (0.5 + 0.5 * vae.decode_any(params["vae"], guess, cfg=config.vae))
