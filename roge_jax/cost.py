"""What a run costs before it runs: tokens, FLOPs and memory of every stage, from the configuration alone.

A multiply-add counts as 2 FLOPs. Norms, activations, rotations and resizing are left out (below 1 % at any size that
matters). Formulas follow the published networks: VGGT and the LagerNVS renderer, Wan2.1's transformer and VAE.
`tests/test_cost.py` holds them against published counts.
"""

import dataclasses
import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from . import model
from .config import DiTConfig, EncoderConfig, RendererConfig, RoGeConfig, VAEConfig
from .core import sharding, target
from .core.attention import SCORES_BYTES
from .core.params import flatten
from .recon import rendering
from .recon.lookup import AGREED, ALONG, BLOCKS, CELL, FINE, MATCHED, WIDTH
from .recon.ray_scene import MERGES
from .recon.vggt import SPECIALS, encoder_grid
from .video.dit import FLOAT32_LEAVES
from .video.vae import SINGLE_PASS_BYTES, largest_map


def attention(queries: int, keys: int, width: int) -> float:
    """Scores and weighted sum of all heads together."""
    return 4.0 * queries * keys * width


# ---- reconstruction ------------------------------------------------------------------------------


def encoder(cfg: EncoderConfig, height: int, width: int, m: int, scene_width: int) -> float:
    """Scene tokens of m photos of height x width pixels (before the encoder's own resize)."""
    rows, columns = encoder_grid(cfg, height, width)
    patches, d = rows * columns, cfg.width
    tokens = patches + SPECIALS + cfg.registers

    def block(tokens: int) -> float:
        return 24.0 * d * d * tokens + attention(tokens, tokens, d)

    embed = 2.0 * patches * cfg.patch**2 * (3 if cfg.dino_depth else 9) * d
    per_view = (
        embed + (cfg.dino_depth + cfg.depth) * block(tokens) + 4.0 * d * scene_width * patches
    )
    return m * per_view + cfg.depth * block(m * tokens)


def renderer_view(cfg: RendererConfig, height: int, width: int, scene_tokens: int) -> float:
    """Ray features and picture of one view, with a scene refined for this view alone."""
    rays, d, z = (height // cfg.patch) * (width // cfg.patch), cfg.width, scene_tokens
    x = rays + cfg.registers
    cross = d * d * (28.0 * x + 4.0 * z) + attention(x, x + z, d)
    both = d * d * (32.0 * x + 24.0 * z) + attention(x, x + 2 * z, d)
    ends = 2.0 * rays * cfg.patch**2 * (6 + 3) * d
    if cfg.attention == "full":
        return ends + cfg.depth * (24.0 * d * d * (x + z) + attention(x + z, x + z, d))
    if cfg.attention == "cross":
        return ends + cfg.depth * cross
    return ends + (cfg.depth - 1) * both + cross


def renderer(
    cfg: RendererConfig, height: int, width: int, scene_tokens: int, m: int, views: int
) -> float:
    """Ray features of all views as this program computes them.

    Where the scene is refined once (`shared`) or never (`cross`), its keys and values serve every view of a chunk.
    """
    per_view = renderer_view(cfg, height, width, scene_tokens)
    shared = cfg.attention == "bidirectional" and cfg.refinement == "shared"
    if cfg.attention == "full" or (cfg.attention == "bidirectional" and not shared):
        return views * per_view
    keys = 4.0 * cfg.width**2 * scene_tokens * cfg.depth
    reading = (
        renderer_view(dataclasses.replace(cfg, attention="cross"), height, width, scene_tokens)
        - keys
    )
    chunks = -(-views // cfg.chunk)
    total = views * reading + chunks * keys
    return total + m * per_view if shared else total


def lookup(cfg: RendererConfig, height: int, width: int, m: int, views: int) -> float:
    """Matrix products and convolutions of `recon.lookup` at the model's size; fetching from the photos is not counted."""
    if not cfg.lookup:
        return 0.0
    pixels, c, fine = height * width, WIDTH, FINE
    cells = pixels // CELL**2
    rays = pixels // cfg.patch**2
    coarse = (MATCHED + 6 + c + AGREED) * c + BLOCKS * (9 + ALONG) * c * c + c
    around = cfg.lookup + 2 * (height + width) // CELL  # the rays' word between cuts; regions
    per_view = (
        rays * cfg.width * (cfg.patch // CELL) ** 2 * (cfg.lookup + c)
        + cells * (cfg.lookup * (coarse + around) + 2 * c * 9 * CELL**2)
        + pixels * 9 * (8 * fine * c + c * c + c * fine)
        + pixels * 9 * (14 * c + c * c + 4 * c)
        + m * pixels * 9 * (11 * c + c)
    )
    per_photo = 9 * (pixels // 4 * 3 * 16 + cells * (16 * 16 + 16 * MATCHED))
    return 2.0 * (views * per_view + m * per_photo)


def scene_tokens_read(config: RoGeConfig, m: int) -> int:
    """Scene tokens of m photos that the rays attend to, after `RendererConfig.merge`."""
    grid = encoder_grid(config.encoder, config.recon_height, config.recon_width)
    rows, columns = (-(-side // cell) for side, cell in zip(grid, MERGES[config.renderer.merge]))
    return m * rows * columns


def preview(config: RoGeConfig, m: int) -> float:
    """A window that is not generated: photos to scene tokens, and all its frames `shown`."""
    size = (config.recon_height, config.recon_width)
    return encoder(config.encoder, *size, m, config.renderer.width) + shown(
        config, m, config.frames
    )


def shown(config: RoGeConfig, m: int, frames: int) -> float:
    """Frames that are not generated, from scene tokens at hand: their rays, the RGB head, the photo look-up."""
    size, tokens = (config.recon_height, config.recon_width), scene_tokens_read(config, m)
    views = frames + (m if config.renderer.refinement == "shared" else 0)
    rays = renderer(config.renderer, *size, tokens, m, views)
    return rays + lookup(config.renderer, *size, m, frames)


# ---- generation ----------------------------------------------------------------------------------


def text(cfg: DiTConfig, rows: int | None = None) -> float:
    """Text embedding and the keys and values of cross-attention: once per video."""
    rows = cfg.text_len if rows is None else rows
    if not rows:
        return 0.0
    d = cfg.width
    clip = 2.0 * cfg.clip_rows * (cfg.clip_dim**2 + cfg.clip_dim * d) * (rows > cfg.text_len)
    return 2.0 * cfg.text_len * (cfg.text_dim * d + d * d) + clip + cfg.depth * 4.0 * d * d * rows


def velocity(cfg: DiTConfig, tokens: int, rows: int | None = None) -> float:
    """One evaluation of the transformer on `tokens`, with `rows` of text whose keys and values are cached."""
    rows = cfg.text_len if rows is None else rows
    d, f = cfg.width, cfg.ffn
    linear = tokens * ((12.0 if rows else 8.0) * d * d + 4.0 * d * f)
    blocks = cfg.depth * (linear + attention(tokens, tokens, d) + attention(tokens, rows, d))
    ends = 2.0 * tokens * cfg.patch**2 * (cfg.in_channels + cfg.out_channels) * d
    time = 2.0 * (cfg.freq_dim * d + d * d + 6 * d * d)
    return blocks + ends + time


def fusion(config: RoGeConfig, views: int, slots: int) -> float:
    """Geometry adapter and the patch embeddings of rays and geometry: once per window."""
    grid = (config.recon_height // config.renderer.patch) * (
        config.recon_width // config.renderer.patch
    )
    c, d, patch = config.fusion.geometry_channels, config.dit.width, config.dit.patch
    adapter = 2.0 * views * grid * config.renderer.width * c
    return adapter + 2.0 * tokens_per_slot(config) * slots * patch**2 * (6 * 4 * 64 + 4 * c) * d


# ---- VAE -----------------------------------------------------------------------------------------


class _Clip(NamedTuple):
    """Size of a feature map on its way through the VAE."""

    frames: int
    height: int
    width: int

    def conv(self, c_in: int, c_out: int, *, dense: bool, time: int = 3, space: int = 9) -> float:
        """A causal convolution; not `dense`: frames before the first are not multiplied, as this program does it."""
        taps = time * self.frames if dense else sum(min(t + 1, time) for t in range(self.frames))
        return 2.0 * taps * space * self.height * self.width * c_in * c_out

    def res(self, c_in: int, c_out: int, *, dense: bool) -> float:
        short = 0.0 if c_in == c_out else self.conv(c_in, c_out, dense=dense, time=1, space=1)
        return self.conv(c_in, c_out, dense=dense) + self.conv(c_out, c_out, dense=dense) + short

    def mid(self, c: int, *, dense: bool) -> float:
        pixels = self.height * self.width
        attend = self.frames * (8.0 * c * c * pixels + attention(pixels, pixels, c))
        return 2 * self.res(c, c, dense=dense) + attend


def _widths(cfg: VAEConfig) -> list[int]:
    return [cfg.base * k for k in cfg.multipliers]


def vae_encode(
    cfg: VAEConfig, frames: int, height: int, width: int, *, dense: bool = False
) -> float:
    """Video (frames = 1 + 4k) to latents."""
    widths, clip = _widths(cfg), _Clip(frames, height, width)
    total = clip.conv(3, widths[0], dense=dense)
    c_in = widths[0]
    for i, c in enumerate(widths):
        total += clip.res(c_in, c, dense=dense) + (cfg.res_blocks - 1) * clip.res(c, c, dense=dense)
        c_in = c
        if i < len(cfg.temporal):
            clip = clip._replace(height=clip.height // 2, width=clip.width // 2)
            total += clip.conv(c, c, dense=dense, time=1)
            if cfg.temporal[i] and clip.frames > 1:
                clip = clip._replace(frames=(clip.frames + 1) // 2)
                total += clip._replace(frames=clip.frames - 1).conv(c, c, dense=True, space=1)
    z = 2 * cfg.latent
    total += clip.mid(c_in, dense=dense) + clip.conv(c_in, z, dense=dense)
    return total + clip.conv(z, z, dense=dense, time=1, space=1)


def vae_decode(
    cfg: VAEConfig, frames: int, height: int, width: int, *, dense: bool = False
) -> float:
    """Latents to a video of frames = 1 + 4k."""
    widths, temporal = _widths(cfg)[::-1], cfg.temporal[::-1]
    scale = 2 ** len(temporal)
    clip = _Clip(1 + (frames - 1) // 2 ** sum(temporal), height // scale, width // scale)
    total = clip.conv(cfg.latent, cfg.latent, dense=dense, time=1, space=1)
    total += clip.conv(cfg.latent, widths[0], dense=dense) + clip.mid(widths[0], dense=dense)
    for i, c in enumerate(widths):
        c_in = c if i == 0 else widths[i - 1] // 2
        total += clip.res(c_in, c, dense=dense) + cfg.res_blocks * clip.res(c, c, dense=dense)
        if i < len(temporal):
            if temporal[i] and clip.frames > 1:
                total += clip._replace(frames=clip.frames - 1).conv(c, 2 * c, dense=dense, space=1)
                clip = clip._replace(frames=2 * clip.frames - 1)
            clip = clip._replace(height=2 * clip.height, width=2 * clip.width)
            total += clip.conv(
                c, c // 2, dense=dense, time=1, space=9 if dense else 4
            )  # see `vae.up_conv`
    return total + clip.conv(widths[-1], 3, dense=dense)


def decoder_tensor_bytes(config: RoGeConfig, frames: int | None = None) -> float:
    """The decoder's largest tensor, float32: a feature map of the last stage, at full size."""
    shape = (frames or config.frames, config.height, config.width)
    return largest_map(shape, config.vae)


# Maps of full size alive at once in a residual block: its input, that activated, and of the convolution the sum over
# past taps, the tap at work, its padded copy and the new sum.
MAPS = 6


# ---- a whole run ---------------------------------------------------------------------------------


def tokens_per_slot(config: RoGeConfig) -> int:
    """Transformer tokens of one latent slot."""
    lh, lw = config.latent_size
    return (lh // config.dit.patch) * (lw // config.dit.patch)


def keeps_float32(path: str) -> bool:
    """Whether a leaf stays float32 when the large matrices are bfloat16: the VAE, norms, modulation, time, head."""
    return path.startswith("vae/") or bool(re.search(FLOAT32_LEAVES, path.removeprefix("dit/")))


def weight_bytes(config: RoGeConfig, dtype: Any = jnp.float32) -> dict[str, float]:
    """Bytes of each part's weights when large matrices are `dtype`; the VAE and small leaves stay float32."""
    sizes: dict[str, float] = {}
    for path, spec in flatten(model.specs(config)).items():
        part = path.partition("/")[0]
        size = 4 if keeps_float32(path) else jnp.dtype(dtype).itemsize
        sizes.setdefault(part, 0.0)
        sizes[part] += math.prod(spec.shape) * size
    return sizes


def held_weights(config: RoGeConfig, mesh: sharding.AnyMesh, dtype: str) -> int:
    """Bytes of weights on each device of a mesh. Raises UserError if it does not divide them."""
    return sharding.held(model.specs(config), mesh, kept_as(dtype))


def kept_as(dtype: str) -> Callable[[str], str]:
    """What a leaf is kept in, by its path: large matrices in `dtype`, those that `keeps_float32` names in float32."""
    return lambda path: "float32" if keeps_float32(path) else dtype


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Costs of one window of a run. `flops` and `working_bytes` per stage; the velocity's are per evaluation."""

    tokens: dict[str, int]
    flops: dict[str, float]
    evaluations: int
    weights: dict[str, float]
    working_bytes: dict[str, float]

    @property
    def total_flops(self) -> float:
        """All of one window: the velocity counts `evaluations` times."""
        return sum(
            f * (self.evaluations if name == "velocity" else 1) for name, f in self.flops.items()
        )

    @property
    def peak_bytes(self) -> float:
        """Weights, and the hungriest stage on top. The runtime's own 0.3 to 0.6 GB are not in it."""
        return sum(self.weights.values()) + max(self.working_bytes.values())


def estimate(
    config: RoGeConfig,
    m: int,
    evaluations: int,
    *,
    dtype: Any = jnp.float32,
) -> Estimate:
    """A window with m photos, on the device of `core.target`: a GPU stores no scores of attention in bfloat16.

    Working memory counts the tensors that live at the same time: attention scores, a block's queries,
    keys, values and hidden layer, the full-size maps of the VAE. XLA allocates within a factor of two of it on CPU,
    less where heads come by themselves there (`core.attention`).
    """
    n, slots = config.frames, config.slots(m)
    size = (config.recon_height, config.recon_width)
    rows, columns = encoder_grid(config.encoder, *size)
    seen = m * (rows * columns + SPECIALS + config.encoder.registers)
    scene_tokens = scene_tokens_read(config, m)
    rays = (size[0] // config.renderer.patch) * (size[1] // config.renderer.patch)
    tokens = tokens_per_slot(config) * slots
    video_decode = vae_decode(config.vae, n, config.height, config.width)
    both_ways = vae_encode(config.vae, n, config.height, config.width) + video_decode
    flops = {
        "encode photos (VAE)": m * vae_encode(config.vae, 1, config.height, config.width),
        "reconstruct": encoder(config.encoder, *size, m, config.renderer.width),
        "query rays": renderer(config.renderer, *size, scene_tokens, m, m + n),
        **(
            {"look into photos": lookup(config.renderer, *size, m, n)}
            if config.renderer.lookup
            else {}
        ),
        "condition": fusion(config, m + n, slots) + text(config.dit),
        **({"preview (VAE, both ways)": both_ways} if config.fusion.preview else {}),
        "velocity": velocity(config.dit, tokens),
        "decode": video_decode,
    }

    def scores(queries: float, keys: float, heads: int) -> float:
        return 0.0 if target.fused(dtype) else min(4.0 * queries * keys * heads, SCORES_BYTES)

    e, r, d = config.encoder, config.renderer, config.dit
    chunk = min(r.chunk, m + n)
    ray_tokens = rays + r.registers
    refined = r.attention != "cross" and (r.refinement == "per_view" or r.attention == "full")
    features = 4.0 * (m + n) * rays * r.width
    chunked = decoder_tensor_bytes(config) > SINGLE_PASS_BYTES
    maps = MAPS * decoder_tensor_bytes(config, 4 if chunked else n)
    # Four neighbours of every sample, their mixture and its square: of three levels, the largest one.
    pixels = size[0] * size[1]
    levels = r.lookup * (MATCHED + 3) / CELL**2, r.lookup * 3 * 4 / CELL**2, 3 * FINE
    fetched = 24.0 * n * m * pixels * max(levels)
    working = {
        "encode photos (VAE)": MAPS * decoder_tensor_bytes(config, m),
        "reconstruct": scores(seen, seen, e.heads) + 4.0 * seen * 10 * e.width,
        "query rays": features
        + scores(chunk * ray_tokens, scene_tokens, r.heads)
        + 4.0 * chunk * (ray_tokens + refined * scene_tokens) * 10 * r.width,
        **({"look into photos": features + fetched} if r.lookup else {}),
        "condition": 4.0 * tokens * d.patch**2 * (6 * 4 * 64 + 4 * config.fusion.geometry_channels),
        **({"preview (VAE, both ways)": features + maps} if config.fusion.preview else {}),
        "velocity": features
        + scores(tokens, tokens, d.heads)
        + 4.0 * tokens * (6 * d.width + d.ffn),
        "decode": maps,
    }
    counts = {
        "scene tokens": scene_tokens,
        "ray tokens per view": ray_tokens,
        "views": m + n,
        "latent slots": slots,
        "transformer tokens": tokens,
    }
    return Estimate(counts, flops, evaluations, weight_bytes(config, dtype), working)


def report(
    config: RoGeConfig,
    m: int,
    evaluations: int,
    *,
    frames: int,
    later: int,
    half: bool,
    solver: str,
) -> str:
    """What `--dry-run` prints: a video of `frames` frames from m photos, `later` contexts in windows after the first;
    `half`: bfloat16; `solver`: a line on it."""
    runs = -(-frames // config.frames)
    later = later if runs > 1 else m
    dtype = jnp.bfloat16 if half else jnp.float32
    first, next_ = (estimate(config, k, evaluations, dtype=dtype) for k in (m, later))
    total = first.total_flops + (runs - 1) * next_.total_flops
    peak = max(first.peak_bytes, next_.peak_bytes)
    size, pictures = config.output_size, ""
    if size != (config.height, config.width):
        pictures = f" for pictures of {size[0]}x{size[1]}"
        peak += rendering.working_bytes(max(m, later), *size, config.frames + 2 * frames)
    latents = (config.slots(m), *config.latent_size, config.vae.latent)
    lines = [
        f"model     {config.name}: {sum(weight_bytes(config).values()) / 4e6:,.1f} M parameters, "
        f"{sum(first.weights.values()) / 1e9:,.2f} GB in {'bfloat16' if half else 'float32'}",
        f"video     {frames} frames of {config.height}x{config.width}{pictures} (reconstruction at "
        f"{config.recon_height}x{config.recon_width}), chunks of {config.frames}: {runs}",
        f"photos    {m}" + (f", then {later} with frames already made" if later != m else ""),
        "tokens    " + ", ".join(f"{n:,} {name}" for name, n in first.tokens.items()),
        f"latents   {' x '.join(map(str, latents))}",
        f"solver    {solver}",
        "",
        f"{'stage (first chunk)':24s}{'FLOPs':>16s}{'working memory':>18s}",
    ]
    for name, flops in first.flops.items():
        times = f", each of {evaluations}" if name == "velocity" else ""
        work = scaled(first.working_bytes[name], "B")
        lines.append(f"{name + times:24s}{scaled(flops, 'FLOP'):>16s}{work:>18s}")
    return "\n".join(
        [
            *lines,
            f"{'all chunks':24s}{scaled(total, 'FLOP'):>16s}",
            "",
            f"peak memory about {scaled(peak, 'B')}: weights and the hungriest stage, beside the "
            "runtime's own 0.3 to 0.6 GB",
        ]
    )


def scaled(value: float, unit: str) -> str:
    """1.23e10 FLOP -> "12.3 GFLOP"."""
    for prefix, size in (("P", 1e15), ("T", 1e12), ("G", 1e9), ("M", 1e6)):
        if value >= size:
            return f"{value / size:,.3g} {prefix}{unit}"
    return f"{value / 1e3:,.3g} k{unit}"
