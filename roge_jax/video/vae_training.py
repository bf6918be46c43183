"""How a VAE is trained from nothing: initial values that already pass pictures through, and the loss."""

import jax
import jax.numpy as jnp
import numpy as np

from ..config import VAEConfig
from ..core.params import Tree, flatten, unflatten
from .vae import SPACE, TIME, decode_raw, encode_moments, vae_specs

OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])  # colour axes


def passthrough_init(key: jax.Array, cfg: VAEConfig, *, noise: float = 0.1) -> Tree:
    """Initial values from which a small VAE trains well, first on images, then on video.

    Older temporal taps are zero, halving time keeps the newest frame and doubling it repeats: until these train, a
    video is coded as its frames 0, 4, 8, .., each by the image VAE, so what was learned on images carries over
    exactly. Down-sampling starts as a 2x2 average and up-sampling as repetition followed by an orthogonal
    projection, plus `noise` times a random kernel; residual branches start at `noise` times their usual scale.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))  # NumPy: nothing to compile
    tree = {}
    for path, spec in flatten(vae_specs(cfg)).items():
        module, leaf = path.rsplit("/", 1)
        if leaf == "kernel":
            kernel = rng.standard_normal(spec.shape) / np.sqrt(np.prod(spec.shape[:-1]))
            tree[path] = jnp.asarray(_passthrough(module, kernel, noise), spec.dtype)
        else:
            tree[path] = jnp.asarray(spec.init(rng, spec.shape, spec.dtype))  # zeros and ones
    return unflatten(tree)


def _passthrough(module: str, kernel: np.ndarray, noise: float) -> np.ndarray:
    c_in, c_out = kernel.shape[-2:]
    if module.endswith(("down/time", "up/time")):  # the newest frame, once or twice
        kernel = np.zeros_like(kernel)
        kernel[-1] = np.tile(np.eye(c_in), c_out // c_in)
    elif module.endswith("down/conv"):
        kernel = noise * kernel
        kernel[:2, :2] += np.eye(c_in) / 4
    elif module.endswith("up/conv"):
        centre, _ = np.linalg.qr(kernel[1, 1])
        kernel = noise * kernel
        kernel[1, 1] = centre
    elif module.endswith("shortcut"):
        q, _ = np.linalg.qr(kernel.T if c_in < c_out else kernel)
        kernel = q.T if c_in < c_out else q
    elif kernel.ndim == 5:  # a third of the inputs count
        newest = np.sqrt(3.0) * (noise if module.endswith("conv2") else 1.0) * kernel[-1]
        kernel = np.zeros_like(kernel)
        kernel[-1] = newest
    return kernel


def block_colours(video: jax.Array) -> jax.Array:
    """Mean colour of each latent's pixels [t', h/8, w/8, 2] along red-blue and green-magenta, at a spread near 1."""
    t, h, w, _ = video.shape
    blocks = (video @ (12.0 * OPPONENT[1:].T)).reshape(t, h // SPACE, SPACE, w // SPACE, SPACE, 2)
    frames = blocks.mean((2, 4))
    later = frames[1:].reshape(-1, TIME, *frames.shape[1:]).mean(1)
    return jnp.concatenate([frames[:1], later])


def vae_loss(
    p: Tree,
    video: jax.Array,
    key: jax.Array,
    *,
    cfg: VAEConfig,
    kl: float = 5e-5,
    l1: float = 0.1,
    colour: tuple[float, float, float] = (1.0, 8.0, 8.0),
    anchor: float = 0.05,
) -> tuple[jax.Array, dict]:
    """Reconstruction of video [t, h, w, 3] from sampled latents: error + l1 * mae + kl * KL, means over elements.

    `colour` weighs the squared error along the orthonormal axes grey, red against blue and green against magenta. The
    last two hold one and two hundredths of the variance of brightness; unweighted, a small VAE stays grey for
    thousands of steps, and weighted it finds one of them and loses the other: neither half gains by passing on what
    the other ignores. `anchor` therefore draws the last two latent channels towards `block_colours` of the video.

    Also returns {"mse", "mae", "kl", "psnr"}; the PSNR (dB, range 2) is that of the sampled reconstruction.
    """
    moments = encode_moments(p, video, cfg=cfg)
    mu, log_var = jnp.split(moments, 2, axis=-1)
    log_var = jnp.clip(log_var, -30.0, 20.0)
    z = mu + jnp.exp(0.5 * log_var) * jax.random.normal(key, mu.shape)
    error = decode_raw(p, z, cfg=cfg) - video
    mse, mae = jnp.square(error).mean(), jnp.abs(error).mean()
    weighted = jnp.square(error @ (OPPONENT.T * np.sqrt(colour)[None, :])).mean()
    divergence = 0.5 * (jnp.square(mu) + jnp.exp(log_var) - 1 - log_var).mean()
    psnr = 10 * jnp.log10(4 / jnp.maximum(mse, 1e-12))
    metrics = {"mse": mse, "mae": mae, "kl": divergence, "psnr": psnr}
    anchored = jnp.square(mu[..., -2:] - block_colours(video)).mean()
    return weighted + l1 * mae + kl * divergence + anchor * anchored, metrics
