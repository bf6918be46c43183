"""The preview: the reconstruction's own frames of the targets, and what they spare a small video transformer.

Not in the paper (`FusionConfig.preview`, on in `mini`). A large pretrained transformer can learn to turn ray features
into latents; a small one spends its training on becoming a second encoder, and its VAE blurs all that passes. So the
reconstruction's own frames, encoded, stand where the condition has zeros; once their error was measured the transformer
says only how the velocity differs from what they imply; and generated frames get back what the VAE loses of them.
"""

import jax
import jax.numpy as jnp

from .config import RoGeConfig
from .core.layers import resized
from .core.params import Tree
from .fusion import MASK_CHANNELS, Condition
from .video import flow, vae


def latents(params: Tree, shown: jax.Array, *, config: RoGeConfig) -> jax.Array | None:
    """The reconstruction's picture of the targets `shown` [n, h, w, 3] (`model.show`), encoded
    [1 + (n - 1) / 4, lh, lw, 16]; None for a model without preview.

    No gradient passes: the reconstruction learns through G and the photometric term.
    """
    if not config.fusion.preview:
        return None
    video = 2.0 * resized(jax.lax.stop_gradient(shown), config.height, config.width) - 1.0
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
    params: Tree, shown: jax.Array, cond: Condition, *, config: RoGeConfig
) -> jax.Array | None:
    """What the VAE loses of the preview [n, h, w, 3]: `shown` less `latents` decoded; None without a preview.

    `cond` is that of a whole window. Where the transformer leaves the preview's latents as they are, decoding them and
    adding this gives the reconstruction's own picture.
    """
    if not config.fusion.preview:
        return None
    guess = cond.appearance[-config.slots(0) :, ..., MASK_CHANNELS:]
    blurred = 0.5 + 0.5 * vae.decode_any(params["vae"], guess, cfg=config.vae)
    return resized(shown, config.height, config.width) - blurred
