"""Wan2.1 VAE: our leaves and the published tensor names, official (Wan2.1_VAE.pth) and diffusers."""

from typing import Literal

from ..config import VAEConfig
from .mapping import CONV2D, CONV3D, IDENTITY, Entry, Transform, pointwise, trailing_ones

Names = Literal["official", "diffusers"]

TIME_CONV = Transform(  # [out, in, 3, 1, 1] -> [3, in, out]
    lambda x: x[..., 0, 0].transpose(2, 1, 0), lambda x: x.transpose(2, 1, 0)[..., None, None]
)

# Inside one module: our name, official, diffusers, layout of the kernel.
_RES = (
    ("norm1", "residual.0", "norm1", None),
    ("conv1", "residual.2", "conv1", CONV3D),
    ("norm2", "residual.3", "norm2", None),
    ("conv2", "residual.6", "conv2", CONV3D),
)
_SHORTCUT = ("shortcut", "shortcut", "conv_shortcut", pointwise(3))
_ATTN = (("qkv", "to_qkv", "to_qkv", pointwise(2)), ("proj", "proj", "proj", pointwise(2)))
_CONV = ("conv", "resample.1", "resample.1", CONV2D)
_TIME = ("time", "time_conv", "time_conv", TIME_CONV)


def mapping(cfg: VAEConfig, names: Names = "official") -> list[Entry]:
    """One entry per leaf of `vae_specs(cfg)`."""
    entries: list[Entry] = []

    def pair(ours: str, official: str, diffusers: str, kernel: Transform) -> None:
        theirs = official if names == "official" else diffusers
        entries.append(Entry(f"{ours}/kernel", (f"{theirs}.weight",), kernel))
        entries.append(Entry(f"{ours}/bias", (f"{theirs}.bias",), IDENTITY))

    def norm(ours: str, official: str, diffusers: str, axes: int = 3) -> None:
        theirs = official if names == "official" else diffusers
        entries.append(Entry(f"{ours}/scale", (f"{theirs}.gamma",), trailing_ones(axes)))

    def module(rows, ours: str, official: str, diffusers: str) -> None:
        for name, a, b, kernel in rows:
            where = f"{ours}/{name}", f"{official}.{a}", f"{diffusers}.{b}"
            norm(*where) if kernel is None else pair(*where, kernel)

    def ends(part: str) -> None:
        """First and last layers and the middle, alike in encoder and decoder."""
        pair(f"{part}/conv_in", f"{part}.conv1", f"{part}.conv_in", CONV3D)
        for i in (0, 1):
            where = f"{part}/mid/res{i}", f"{part}.middle.{2 * i}", f"{part}.mid_block.resnets.{i}"
            module(_RES, *where)
        where = f"{part}/mid/attn", f"{part}.middle.1", f"{part}.mid_block.attentions.0"
        norm(f"{where[0]}/norm", f"{where[1]}.norm", f"{where[2]}.norm", 2)
        module(_ATTN, *where)
        norm(f"{part}/norm_out", f"{part}.head.0", f"{part}.norm_out")
        pair(f"{part}/conv_out", f"{part}.head.2", f"{part}.conv_out", CONV3D)

    pair("quant", "conv1", "quant_conv", pointwise(3))
    pair("post_quant", "conv2", "post_quant_conv", pointwise(3))
    ends("encoder")
    ends("decoder")

    m, n = (
        cfg.multipliers,
        0,
    )  # n: the official index, which counts blocks and samplers of all stages
    for i, multiplier in enumerate(m):
        for j in range(cfg.res_blocks):
            where = (
                f"encoder/stage{i}/res{j}",
                f"encoder.downsamples.{n}",
                f"encoder.down_blocks.{n}",
            )
            widens = j == 0 and multiplier != m[max(i - 1, 0)]
            module(_RES + (_SHORTCUT,) * widens, *where)
            n += 1
        if i < len(cfg.temporal):
            where = f"encoder/stage{i}/down", f"encoder.downsamples.{n}", f"encoder.down_blocks.{n}"
            module((_CONV,) + (_TIME,) * cfg.temporal[i], *where)
            n += 1

    m, temporal, n = m[::-1], cfg.temporal[::-1], 0
    for i, multiplier in enumerate(m):
        ours, official, diffusers = (
            f"decoder/stage{i}",
            "decoder.upsamples",
            f"decoder.up_blocks.{i}",
        )
        for j in range(cfg.res_blocks + 1):
            widens = i > 0 and j == 0 and cfg.base * multiplier != cfg.base * m[i - 1] // 2
            rows = _RES + (_SHORTCUT,) * widens
            module(rows, f"{ours}/res{j}", f"{official}.{n}", f"{diffusers}.resnets.{j}")
            n += 1
        if i < len(temporal):
            rows = (_CONV,) + (_TIME,) * temporal[i]
            module(rows, f"{ours}/up", f"{official}.{n}", f"{diffusers}.upsamplers.0")
            n += 1
    return entries
