"""Wan2.1's causal video VAE: video to latents 8 x 8 smaller in space and 4 smaller in time, first frame alone.

All functions work on one clip, video [t, h, w, 3] in [-1, 1] and latents [t', h/8, w/8, 16] with t = 1 + 4 (t' - 1).
Everything stays in float32.

Time. Each 3x3x3 convolution sees its own frame and the two before it. A clip can be processed in one pass (`encode`,
`decode`) or in chunks (`encode_chunked`, `decode_chunked`), which is mathematically the same: every causal operation
takes the last frames of its earlier input, `past`, and returns those that the next chunk needs. `past=None` marks the
first chunk, where three rules hold: convolutions see zeros before frame 0; frame 0 skips the convolutions that halve
or double time; and when time is doubled, frame 0 is invisible to the frames after it.

Convolutions. A causal 3x3x3 convolution is the sum of three 2-D convolutions, one per temporal tap, each over the
frames it really has: no zero frame is ever multiplied. A single image thus costs one 2-D convolution per layer.
"""

import jax
import jax.numpy as jnp
import numpy as np

from ..config import VAEConfig
from ..core import products
from ..core.attention import attention
from ..core.layers import convolve, lift, linear, linear_specs, norm_specs
from ..core.params import Spec, Tree, fan_in, zeros
from ..errors import UserError

SPACE, TIME = 8, 4  # compression
SINGLE_PASS_BYTES = 2e9  # a clip whose largest feature map is above this goes through in chunks
Past = (
    dict | None
)  # what earlier chunks leave behind, shaped like the network; None: there are none


# ------------------------------------------------------------------------------------------------ causal operations
def _of(past, name: str):
    return None if past is None else past[name]


def _last(x: jax.Array, past: jax.Array | None, n: int = 2) -> jax.Array:
    """The last `n` frames of [past, x], after zero frames where there are fewer."""
    frames = x if past is None or x.shape[0] >= n else jnp.concatenate([past, x])
    frames = frames[max(frames.shape[0] - n, 0) :]
    return jnp.pad(frames, ((n - frames.shape[0], 0),) + ((0, 0),) * (x.ndim - 1))


def _causal(tap, kernel: jax.Array, x: jax.Array, past: jax.Array | None) -> jax.Array:
    """y_j = sum over lags of tap(x_{j - lag}, kernel[-1 - lag]), over the frames that exist (in `past` or `x`)."""
    t = x.shape[0]
    frames = x if past is None else jnp.concatenate([past, x])
    n = frames.shape[0] - t
    y = tap(x, kernel[-1])
    for lag in range(1, kernel.shape[0]):
        start = max(lag - n, 0)  # the first output that this lag reaches
        if start < t:
            part = tap(frames[n - lag + start : n - lag + t], kernel[-1 - lag])
            y = y + jnp.pad(part, ((start, 0),) + ((0, 0),) * (y.ndim - 1))
    return y


def _bias(p: Tree, y: jax.Array) -> jax.Array:
    return y + lift(p["bias"], y.ndim)


def conv_specs(c_in: int, c_out: int, taps: tuple[int, ...]) -> Tree:
    """Kernel [*taps, c_in, c_out] and bias of a convolution."""
    kernel = Spec((*taps, c_in, c_out), (None,) * (len(taps) + 2), fan_in())
    return {"kernel": kernel, "bias": Spec((c_out,), (None,), zeros)}


def causal_conv(p: Tree, x: jax.Array, past: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """Causal 3x3x3 convolution of x [t, h, w, c]; returns the output and the frames to remember."""
    return _bias(p, _causal(convolve, p["kernel"], x, past)), _last(x, past)


def rms_norm(p: Tree, x: jax.Array) -> jax.Array:
    """x / max(|x|, 1e-12) * sqrt(c) * scale over channels. The square is bounded, so the gradient at 0 is finite."""
    square = jnp.square(x).sum(-1, keepdims=True)
    gain = p["scale"] * np.float32(np.sqrt(x.shape[-1]))
    return x * jax.lax.rsqrt(jnp.maximum(square, 1e-24)) * lift(gain, x.ndim)


# ----------------------------------------------------------------------------------------------------------- blocks
def res_specs(c_in: int, c_out: int) -> Tree:
    """Two causal convolutions with norms, and a linear shortcut if the channels change."""
    specs = {
        "norm1": norm_specs(c_in, bias=False),
        "conv1": conv_specs(c_in, c_out, (3, 3, 3)),
        "norm2": norm_specs(c_out, bias=False),
        "conv2": conv_specs(c_out, c_out, (3, 3, 3)),
    }
    if c_in != c_out:
        specs["shortcut"] = linear_specs(c_in, c_out, (None, None))
    return specs


def res_block(p: Tree, x: jax.Array, past: Past) -> tuple[jax.Array, dict]:
    """x [t, h, w, c] -> [t, h, w, c_out] and what the next chunk needs."""
    new = {}
    y = jax.nn.silu(rms_norm(p["norm1"], x))
    y, new["conv1"] = causal_conv(p["conv1"], y, _of(past, "conv1"))
    y = jax.nn.silu(rms_norm(p["norm2"], y))
    y, new["conv2"] = causal_conv(p["conv2"], y, _of(past, "conv2"))
    return y + (linear(p["shortcut"], x) if "shortcut" in p else x), new


def attn_specs(c: int) -> Tree:
    """Leaves of `attn_block`."""
    return {
        "norm": norm_specs(c, bias=False),
        "qkv": linear_specs(c, 3 * c, (None, None)),
        "proj": linear_specs(c, c, (None, None)),
    }


def attn_block(p: Tree, x: jax.Array) -> jax.Array:
    """Self-attention over the pixels of each frame, one head."""
    t, h, w, c = x.shape
    qkv = linear(p["qkv"], rms_norm(p["norm"], x)).reshape(t, h * w, 1, 3 * c)
    y = attention(*jnp.split(qkv, 3, axis=-1))
    return x + linear(p["proj"], y.reshape(t, h, w, c))


def mid_specs(c: int) -> Tree:
    """Residual block, attention, residual block."""
    return {"res0": res_specs(c, c), "attn": attn_specs(c), "res1": res_specs(c, c)}


def mid_block(p: Tree, x: jax.Array, past: Past) -> tuple[jax.Array, dict]:
    """x [t, h, w, c] -> the same shape, and what the next chunk needs."""
    new = {}
    x, new["res0"] = res_block(p["res0"], x, _of(past, "res0"))
    x = attn_block(p["attn"], x)
    x, new["res1"] = res_block(p["res1"], x, _of(past, "res1"))
    return x, new


def down_specs(c: int, temporal: bool) -> Tree:
    """A strided convolution in space and, if `temporal`, one in time."""
    specs = {"conv": conv_specs(c, c, (3, 3))}
    return specs | ({"time": conv_specs(c, c, (3,))} if temporal else {})


def down(p: Tree, x: jax.Array, past: Past) -> tuple[jax.Array, dict]:
    """Halve height and width (zeros on the right and below) and, if `p` has "time", the frames after the first."""
    x = _bias(p["conv"], convolve(x, p["conv"]["kernel"], stride=2, padding=((0, 1), (0, 1))))
    if "time" not in p:
        return x, {}
    frames = x if past is None else jnp.concatenate([past["time"], x])
    new = {"time": frames[-1:]}
    y = x[:1]  # frame 0 of the clip skips the convolution in time
    if past is not None or x.shape[0] > 1:
        taps = jnp.concatenate([frames[:-2:2], frames[1:-1:2], frames[2::2]], axis=-1)
        kernel = p["time"]["kernel"]
        later = _bias(p["time"], taps @ kernel.reshape(-1, kernel.shape[-1]))
        y = later if past is not None else jnp.concatenate([y, later])
    return y, new


def up_specs(c: int, temporal: bool) -> Tree:
    """A convolution in space that halves the channels and, if `temporal`, one that doubles time."""
    specs = {"conv": conv_specs(c, c // 2, (3, 3))}
    return specs | ({"time": conv_specs(c, 2 * c, (3,))} if temporal else {})


def up(p: Tree, x: jax.Array, past: Past) -> tuple[jax.Array, dict]:
    """Double height and width by repetition and, if `p` has "time", the frames after the first."""
    new = {}
    if "time" in p:
        later = (
            x[1:] if past is None else x
        )  # frame 0 skips the convolution in time and is unknown to it
        new["time"] = _last(later, _of(past, "time"))
        if later.shape[0]:
            y = _causal(jnp.matmul, p["time"]["kernel"], later, _of(past, "time"))
            t, h, w, c = later.shape
            y = _bias(p["time"], y).reshape(t, h, w, 2, c)
            y = jnp.moveaxis(y, 3, 1).reshape(2 * t, h, w, c)
            x = y if past is not None else jnp.concatenate([x[:1], y])
    return _bias(p["conv"], up_conv(x, p["conv"]["kernel"])), new


def up_conv(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Repeat every pixel 2x2, then convolve by 3x3, as four 2x2 convolutions of the small images.

    Taps on copies of one pixel are added first: 16 products instead of 36, and the repeated images, which would be
    the largest array of the whole decoder, never exist.
    """

    def fold(k, axis, phase):
        a, b, c = jnp.split(k, 3, axis)
        return jnp.concatenate([a + b, c] if phase else [a, b + c], axis)

    def part(i, j):
        return convolve(x, fold(fold(kernel, 0, i), 1, j), padding=((1 - i, i), (1 - j, j)))

    t, h, w, _ = x.shape
    rows = [jnp.stack([part(i, 0), part(i, 1)], 3) for i in (0, 1)]
    return jnp.stack(rows, 2).reshape(t, 2 * h, 2 * w, -1)


# ---------------------------------------------------------------------------------------------- encoder and decoder
def _widths(cfg: VAEConfig) -> list[int]:
    return [cfg.base * m for m in cfg.multipliers]


def encoder_specs(cfg: VAEConfig) -> Tree:
    """Leaves of `encoder`: `cfg.multipliers` stages, middle, head of mean and log-variance."""
    widths = _widths(cfg)
    specs = {"conv_in": conv_specs(3, widths[0], (3, 3, 3))}
    for i, (c_in, c) in enumerate(zip([widths[0], *widths], widths, strict=False)):
        stage = {f"res{j}": res_specs(c_in if j == 0 else c, c) for j in range(cfg.res_blocks)}
        if i < len(cfg.temporal):
            stage["down"] = down_specs(c, cfg.temporal[i])
        specs[f"stage{i}"] = stage
    c = widths[-1]
    specs |= {"mid": mid_specs(c), "norm_out": norm_specs(c, bias=False)}
    return specs | {"conv_out": conv_specs(c, 2 * cfg.latent, (3, 3, 3))}


def encoder(p: Tree, x: jax.Array, past: Past, *, cfg: VAEConfig) -> tuple[jax.Array, dict]:
    """Frames [t, h, w, 3] -> [t', h/8, w/8, 2c]."""
    new: dict = {}
    x, new["conv_in"] = causal_conv(p["conv_in"], x, _of(past, "conv_in"))
    x, new["stages"] = _stages(p, x, _of(past, "stages"), down, "down", cfg.res_blocks)
    x, new["mid"] = mid_block(p["mid"], x, _of(past, "mid"))
    x = jax.nn.silu(rms_norm(p["norm_out"], x))
    x, new["conv_out"] = causal_conv(p["conv_out"], x, _of(past, "conv_out"))
    return x, new


def decoder_specs(cfg: VAEConfig) -> Tree:
    """Leaves of `decoder`: the encoder's stages backwards, with one residual block more each."""
    widths, temporal = _widths(cfg)[::-1], cfg.temporal[::-1]
    specs = {"conv_in": conv_specs(cfg.latent, widths[0], (3, 3, 3)), "mid": mid_specs(widths[0])}
    for i, c in enumerate(widths):
        c_in = c if i == 0 else widths[i - 1] // 2  # each up-sampling halves the channels
        blocks = range(cfg.res_blocks + 1)
        stage = {f"res{j}": res_specs(c_in if j == 0 else c, c) for j in blocks}
        if i < len(temporal):
            stage["up"] = up_specs(c, temporal[i])
        specs[f"stage{i}"] = stage
    specs["norm_out"] = norm_specs(widths[-1], bias=False)
    return specs | {"conv_out": conv_specs(widths[-1], 3, (3, 3, 3))}


def decoder(p: Tree, x: jax.Array, past: Past, *, cfg: VAEConfig) -> tuple[jax.Array, dict]:
    """Latents [t', lh, lw, c] -> frames [t, 8 lh, 8 lw, 3]."""
    new: dict = {}
    x, new["conv_in"] = causal_conv(p["conv_in"], x, _of(past, "conv_in"))
    x, new["mid"] = mid_block(p["mid"], x, _of(past, "mid"))
    x, new["stages"] = _stages(p, x, _of(past, "stages"), up, "up", cfg.res_blocks + 1)
    x = jax.nn.silu(rms_norm(p["norm_out"], x))
    x, new["conv_out"] = causal_conv(p["conv_out"], x, _of(past, "conv_out"))
    return x, new


def _stages(p: Tree, x: jax.Array, past: Past, resample, name: str, blocks: int):
    new: dict = {}
    for i in range(sum(key.startswith("stage") for key in p)):
        stage, old, kept = p[f"stage{i}"], _of(past, f"stage{i}"), {}
        for j in range(blocks):
            x, kept[f"res{j}"] = res_block(stage[f"res{j}"], x, _of(old, f"res{j}"))
        if name in stage:
            x, kept[name] = resample(stage[name], x, _of(old, name))
        new[f"stage{i}"] = kept
    return x, new


def vae_specs(cfg: VAEConfig) -> Tree:
    """Leaves of the whole VAE."""
    return {
        "encoder": encoder_specs(cfg),
        "quant": linear_specs(2 * cfg.latent, 2 * cfg.latent, (None, None)),
        "post_quant": linear_specs(cfg.latent, cfg.latent, (None, None)),
        "decoder": decoder_specs(cfg),
    }


# -------------------------------------------------------------------------------------------------------- interface
def _mean_std(cfg: VAEConfig, ndim: int) -> tuple[jax.Array, jax.Array]:
    mean, std = (lift(jnp.asarray(v, jnp.float32), ndim) for v in (cfg.latent_mean, cfg.latent_std))
    return mean, std


def normalise(mu: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """(mu - mean) / std per channel: the latents that the diffusion model sees."""
    mean, std = _mean_std(cfg, mu.ndim)
    return (mu - mean) / std


def denormalise(latents: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """The inverse of `normalise`."""
    mean, std = _mean_std(cfg, latents.ndim)
    return latents * std + mean


def _check_video(video: jax.Array) -> None:
    t, h, w, _ = video.shape
    if t % TIME != 1:
        raise UserError(
            f"A video of {t} frames cannot be encoded: need 1 + 4k frames, "
            f"e.g. {1 + TIME * ((t - 1) // TIME)} or {1 + TIME * ((t + 2) // TIME)}."
        )
    if h % SPACE or w % SPACE:
        raise UserError(
            f"A video of {h}x{w} cannot be encoded: height and width must be multiples of {SPACE}; "
            f"crop or resize it to {h - h % SPACE}x{w - w % SPACE}."
        )


def encode_moments(p: Tree, video: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """Video [t, h, w, 3] in [-1, 1] -> [t', h/8, w/8, 2c]: mean and log-variance, before normalisation."""
    _check_video(video)
    return linear(p["quant"], encoder(p["encoder"], video, None, cfg=cfg)[0])


@jax.named_scope("vae")
@products.use(None)
def encode(p: Tree, video: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """Video [t, h, w, 3] in [-1, 1] -> normalised latents [t', h/8, w/8, c] (the mean, no sampling)."""
    return normalise(encode_moments(p, video, cfg=cfg)[..., : cfg.latent], cfg=cfg)


@jax.named_scope("vae")
@products.use(None)
def decode(p: Tree, latents: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """Normalised latents [t', lh, lw, c] -> video [t, 8 lh, 8 lw, 3], not clamped to [-1, 1]."""
    return decode_raw(p, denormalise(latents, cfg=cfg), cfg=cfg)


def decode_raw(p: Tree, z: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """`decode` of latents on the scale of `encode_moments`."""
    return decoder(p["decoder"], linear(p["post_quant"], z), None, cfg=cfg)[0]


def encode_frames(p: Tree, frames: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """Unrelated images [n, h, w, 3] -> latents [n, h/8, w/8, c], each encoded as a video of one frame."""
    return jax.vmap(lambda x: encode(p, x[None], cfg=cfg)[0])(frames)


def decode_frames(p: Tree, latents: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """Latents of unrelated images [n, lh, lw, c] -> images [n, 8 lh, 8 lw, 3]."""
    return jax.vmap(lambda z: decode(p, z[None], cfg=cfg)[0])(latents)


def largest_map(shape: tuple[int, ...], cfg: VAEConfig) -> float:
    """Bytes of the largest feature map of a clip [t, h, w, 3]; several of them live at once."""
    return 4.0 * float(np.prod(shape[:3])) * cfg.base


@jax.named_scope("vae")
@products.use(None)
def encode_chunked(p: Tree, video: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """`encode` one latent frame at a time: the same latents in memory that does not grow with the clip."""
    if video.shape[0] == 1:
        return encode(p, video, cfg=cfg)
    _check_video(video)
    first, past = encoder(p["encoder"], video[:1], None, cfg=cfg)

    def step(past, chunk):
        y, past = encoder(p["encoder"], chunk, past, cfg=cfg)
        return past, y

    _, rest = jax.lax.scan(step, past, video[1:].reshape(-1, TIME, *video.shape[1:]))
    moments = linear(p["quant"], jnp.concatenate([first, rest.reshape(-1, *first.shape[1:])]))
    return normalise(moments[..., : cfg.latent], cfg=cfg)


def encode_any(p: Tree, video: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """`encode`, or `encode_chunked` where a single pass would take too much memory."""
    large = largest_map(video.shape, cfg) > SINGLE_PASS_BYTES
    return (encode_chunked if large else encode)(p, video, cfg=cfg)


@jax.named_scope("vae")
@products.use(None)
def decode_chunked(p: Tree, latents: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """`decode` one latent frame at a time."""
    if latents.shape[0] == 1:
        return decode(p, latents, cfg=cfg)
    z = linear(p["post_quant"], denormalise(latents, cfg=cfg))
    first, past = decoder(p["decoder"], z[:1], None, cfg=cfg)

    def step(past, chunk):
        y, past = decoder(p["decoder"], chunk, past, cfg=cfg)
        return past, y

    _, rest = jax.lax.scan(step, past, z[1:, None])
    return jnp.concatenate([first, rest.reshape(-1, *first.shape[1:])])


def decode_any(p: Tree, latents: jax.Array, *, cfg: VAEConfig) -> jax.Array:
    """`decode`, or `decode_chunked` where a single pass would take too much memory."""
    t, lh, lw, _ = latents.shape
    large = largest_map((1 + 4 * (t - 1), 8 * lh, 8 * lw), cfg) > SINGLE_PASS_BYTES
    return (decode_chunked if large else decode)(p, latents, cfg=cfg)
