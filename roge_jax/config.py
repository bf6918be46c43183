"""Configurations: frozen dataclasses that hold numbers only, and the presets built from them."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_type_hints

from .errors import UserError, did_you_mean
from .files.fields import described, fits

WAN_LATENT_MEAN = (
    -0.7571, -0.7089, -0.9113, 0.1075, -0.1745, 0.9653, -0.1517, 1.5508,
    0.4134, -0.0715, 0.5517, -0.3632, -0.1922, -0.9497, 0.2503, -0.2921,
)  # fmt: skip
WAN_LATENT_STD = (
    2.8184, 1.4541, 2.3275, 2.6558, 1.2196, 1.7708, 2.6052, 2.0743,
    3.2687, 2.1526, 2.8652, 1.5579, 1.6382, 1.1253, 2.8251, 1.9160,
)  # fmt: skip
Parts = Literal["all", "reconstruction", "generator"]


@dataclass(frozen=True)
class EncoderConfig:
    """Camera-conditioned VGGT: patch encoder, alternating attention, camera MLP."""

    patch: int = 14
    width: int = 1024
    heads: int = 16
    depth: int = 24  # pairs of one frame block and one global block
    dino_heads: int | None = None  # of DINOv2; None: as many as the others
    dino_depth: int = 24  # 0: a linear patch embedding of RGB and rays instead of DINOv2
    position_grid: int = 37  # side of DINOv2's learned position table
    registers: int = 4
    long_side: int | None = (
        518  # images are resized to this inside the encoder; None: used as they are
    )
    relative_cameras: bool = False  # projective relative-camera attention in global blocks


@dataclass(frozen=True)
class RendererConfig:
    """Ray-map encoder, ray-scene blocks and RGB head (LagerNVS)."""

    patch: int = 8
    width: int = 768
    heads: int = 12
    depth: int = 12
    registers: int = 4
    attention: Literal["bidirectional", "cross", "full"] = "bidirectional"
    # Of bidirectional attention: scene tokens refined for every queried view, or once by the contexts' rays.
    refinement: Literal["per_view", "shared"] = "per_view"
    relative_cameras: bool = False  # projective; "full" attention has no such form
    # Cuts along every ray at which it looks into the photos themselves; 0: it sees scene tokens alone.
    lookup: int = 0
    matching: bool = (
        False  # learned features compare the photos, where the picture may be larger than the model
    )
    chunk: int = 8  # views processed at a time
    merge: Literal[1, 2, 4] = 1  # scene tokens of a photo averaged into one: 2 in a row, 2 x 2


@dataclass(frozen=True)
class VAEConfig:
    """Wan2.1 causal video VAE: 8 x 8 in space, 4 in time with the first frame alone."""

    base: int = 96
    latent: int = 16
    multipliers: tuple[int, ...] = (1, 2, 4, 4)
    res_blocks: int = 2
    temporal: tuple[bool, ...] = (False, True, True)  # which down-samplings also halve time
    latent_mean: tuple[float, ...] = WAN_LATENT_MEAN
    latent_std: tuple[float, ...] = WAN_LATENT_STD


@dataclass(frozen=True)
class DiTConfig:
    """Wan2.1 diffusion transformer."""

    width: int = 5120
    heads: int = 40
    depth: int = 40
    ffn: int = 13824
    in_channels: int = 36  # noisy latent 16, mask 4, condition latent 16
    out_channels: int = 16
    patch: int = 2  # in space; time is never patched
    freq_dim: int = 256
    text_dim: int = 4096
    text_len: int = 512  # 0: no cross-attention at all
    clip_dim: int = 1280  # 0: no image branch (T2V)
    clip_rows: int = 257


@dataclass(frozen=True)
class FusionConfig:
    """Geometry adapter between ray features and latent slots (Sec. 3.2)."""

    geometry_channels: int = 384  # C of the geometry adapter; four frames make 4C
    # The targets' appearance: the reconstruction's own frames, encoded, instead of the paper's zeros.
    preview: bool = False
    # Per latent channel: the preview's error on training clips, measured before the generator is trained. With it, the
    # transformer corrects the velocity that a normal error of that size implies; None: it says the velocity itself.
    preview_std: tuple[float, ...] | None = None
    # Per channel of the ray features, measured after the reconstruction was trained; None: features as they are.
    feature_mean: tuple[float, ...] | None = None
    feature_std: tuple[float, ...] | None = None


@dataclass(frozen=True)
class FlowConfig:
    """Flow matching: schedule shift, training noise levels and their weights, the weight of the photometric term
    (Sec. 3.3), and how the model is sampled unless something else is asked for.
    """

    shift: float = 5.0
    weighting: Literal["bump", "uniform"] = "bump"
    sigma_sampling: Literal["uniform_index", "logit_normal"] = "uniform_index"
    photometric: float = 0.1  # lambda of the joint loss
    solver: str = "euler"  # as the published models are sampled
    steps: int = 50
    schedule: str = "shift"
    # Whether a video is generated unless that is asked for: not if the preview is better (docs/results/model_card.md).
    generate: bool = True


@dataclass(frozen=True)
class LoraConfig:
    """Ranks of both halves and which linear layers are adapted: regular expressions for their paths."""

    dit_rank: int = 32
    dit_match: str = r"blocks/.*(self_attn|cross_attn)/(q|k|v|o)$|blocks/.*ffn/(fc1|fc2)$"
    recon_rank: int = 8
    recon_match: str = r"^(?!encoder/patch_encoder/patch_embed$|renderer/lookup/)"  # every linear and the ray convolution


@dataclass(frozen=True)
class RoGeConfig:
    """Everything that fixes the shapes and the maths of one model."""

    name: str = "paper"
    height: int = 192  # of the generated video
    width: int = 336
    recon_height: int = 288  # of the images and rays of the reconstruction branch
    recon_width: int = 504
    # (height, width) of the pictures that are made where the photos' own pixels are read (`renderer.lookup`), if it is
    # not the generated video's; any other can be asked for.
    output: tuple[int, ...] | None = None
    frames: int = 81  # per window, 1 + 4k
    max_context: int = 9
    scale_rule: Literal["lagernvs", "paper"] = "lagernvs"
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    renderer: RendererConfig = field(default_factory=RendererConfig)
    vae: VAEConfig = field(default_factory=VAEConfig)
    dit: DiTConfig = field(default_factory=DiTConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    flow: FlowConfig = field(default_factory=FlowConfig)
    lora: LoraConfig = field(default_factory=LoraConfig)
    # All of the model, or one of its halves as published weights come: a reconstruction makes pictures by itself, a
    # generator needs one.
    parts: Parts = "all"

    def __post_init__(self):
        pixels = self.multiple
        if min(self.height, self.width) < 1 or self.height % pixels or self.width % pixels:
            raise UserError(
                f"Size {self.height}x{self.width} does not fit: height and width must be multiples of "
                f"{pixels}; try {_nearest(self.height, pixels)}x{_nearest(self.width, pixels)}."
            )
        p = self.renderer.patch
        small = min(self.recon_height, self.recon_width) < 1
        if small or self.recon_height % p or self.recon_width % p:
            raise UserError(
                f"Reconstruction size {self.recon_height}x{self.recon_width} does not fit: both must be "
                f"multiples of {p}; try {_nearest(self.recon_height, p)}x{_nearest(self.recon_width, p)}."
            )
        if self.renderer.lookup == 1 or (self.renderer.lookup and p % 4):
            raise UserError(
                f"renderer.lookup {self.renderer.lookup} with patches of {p} pixels does not fit: give 0 or at least 2 "
                "depth hypotheses, and a patch that is a multiple of 4."
            )
        if self.output is not None and (
            len(self.output) != 2
            or self.output[0] < self.recon_height
            or self.output[1] < self.recon_width
        ):
            raise UserError(
                f"Output size {self.output} does not fit: give two numbers, at least {self.recon_height} and "
                f"{self.recon_width}, or null."
            )
        if self.frames < 1 or self.frames % 4 != 1:
            k = max(self.frames - 1, 0) // 4
            raise UserError(
                f"{self.frames} frames cannot form latent slots: need 1 + 4k, e.g. {1 + 4 * k} or {5 + 4 * k}."
            )

    @property
    def multiple(self) -> int:
        """What height and width are multiples of: a patch of latents, or of rays where nothing is generated."""
        return self.renderer.patch if self.parts == "reconstruction" else 8 * self.dit.patch

    @property
    def output_size(self) -> tuple[int, int]:
        """(height, width) of the pictures that are made."""
        if self.output is None or not self.renderer.lookup:
            return self.height, self.width
        return self.output[0], self.output[1]

    def at_size(
        self, height: int, width: int, recon: tuple[int, int] | None = None
    ) -> "RoGeConfig":
        """The model at another size; its pictures grow with it. `recon`: the reconstruction's, by default in proportion."""
        patch = self.renderer.patch
        ratio = height / max(self.height, 1), width / max(self.width, 1)
        if recon is None:
            recon = (
                max(patch, round(self.recon_height * ratio[0] / patch) * patch),
                max(patch, round(self.recon_width * ratio[1] / patch) * patch),
            )
        output = self.output
        if output is not None:
            output = (round(output[0] * ratio[0]), round(output[1] * ratio[1]))
        return dataclasses.replace(
            self,
            height=height,
            width=width,
            recon_height=recon[0],
            recon_width=recon[1],
            output=output,
        )

    def for_pictures(self, height: int, width: int) -> "RoGeConfig":
        """The model for pictures of this size: where colours come from the photos, at about as many pixels as it was made
        for and in the picture's shape; else at the picture's size itself."""
        pixels = self.multiple
        if not self.renderer.lookup or height * width <= self.height * self.width:
            return dataclasses.replace(self, output=None).at_size(height, width)
        side = math.sqrt(self.height * self.width / (height * width))
        small = [min(_nearest(side * x, pixels), x) for x in (height, width)]
        model = dataclasses.replace(self, output=None).at_size(small[0], small[1])
        return dataclasses.replace(model, output=(height, width))

    @property
    def latent_size(self) -> tuple[int, int]:
        """Height and width of the latents: an eighth of the video."""
        return self.height // 8, self.width // 8

    def slots(self, contexts: int) -> int:
        """Latent slots of a window: one per context, one for the first target, one per four more."""
        return contexts + 1 + (self.frames - 1) // 4


def _nearest(size: float, multiple: int) -> int:
    return max(multiple, round(size / multiple) * multiple)


def _tiny() -> RoGeConfig:
    return RoGeConfig(
        name="tiny",
        height=32,
        width=48,
        recon_height=32,
        recon_width=48,
        frames=5,
        encoder=EncoderConfig(
            patch=8, width=32, heads=2, depth=1, dino_depth=0, long_side=None, relative_cameras=True
        ),
        renderer=RendererConfig(width=32, heads=2, depth=2, relative_cameras=True, chunk=4),
        vae=VAEConfig(base=8),
        dit=DiTConfig(
            width=64, heads=2, depth=2, ffn=128, freq_dim=32, text_dim=16, text_len=4, clip_dim=0
        ),
        fusion=FusionConfig(geometry_channels=16),
        flow=FlowConfig(steps=4),
        lora=LoraConfig(dit_rank=4, recon_rank=2),
    )


def _mini() -> RoGeConfig:
    return RoGeConfig(
        name="mini",
        height=64,
        width=112,
        recon_height=64,
        recon_width=112,
        output=(192, 336),
        frames=17,
        max_context=6,
        encoder=EncoderConfig(
            patch=8,
            width=192,
            heads=4,
            depth=3,
            dino_depth=0,
            long_side=None,
            relative_cameras=True,
        ),
        renderer=RendererConfig(
            width=192,
            heads=4,
            depth=6,
            attention="cross",
            relative_cameras=True,
            lookup=48,
            matching=True,
            chunk=32,
        ),
        vae=VAEConfig(base=16),
        dit=DiTConfig(
            width=256, heads=4, depth=8, ffn=1024, freq_dim=256, text_dim=64, text_len=0, clip_dim=0
        ),
        fusion=FusionConfig(geometry_channels=128, preview=True),
        # What the preview leaves open is small: it is decided at low noise levels, and those must not be rare.
        # Few steps end between the preview and the exact solution, which is less close to the truth (docs/results/solvers.md).
        flow=FlowConfig(
            shift=1.0, weighting="uniform", steps=2, schedule="uniform", generate=False
        ),
        lora=LoraConfig(dit_rank=8, recon_rank=8),
    )


def _wan_1_3b() -> RoGeConfig:
    return RoGeConfig(
        name="wan1.3b",
        dit=DiTConfig(width=1536, heads=12, depth=30, ffn=8960, clip_dim=0),
    )


PRESETS = {"tiny": _tiny, "mini": _mini, "wan1.3b": _wan_1_3b, "paper": RoGeConfig}


def preset(name: str) -> RoGeConfig:
    """The named configuration: tiny, mini, wan1.3b or paper."""
    if name not in PRESETS:
        raise UserError(f"Unknown preset '{name}': {did_you_mean(name, PRESETS)}")
    return PRESETS[name]()


def to_dict(config) -> dict:
    """A configuration as nested dicts, for JSON."""
    return dataclasses.asdict(config)


def from_dict(values: dict, cls=RoGeConfig, *, source: str = "config"):
    """The inverse of `to_dict`; an unknown field or a value of another kind is named in one `UserError`.

    Fields that are missing, because the file is older than they are, take their defaults.
    """
    if not isinstance(values, dict):
        raise UserError(
            f"{source} is {values!r}: give an object with the fields of {cls.__name__}."
        )
    known = {f.name: f for f in dataclasses.fields(cls)}
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise UserError(
            f"{source}: unknown field '{unknown[0]}': {did_you_mean(unknown[0], known)}"
        )
    hints = get_type_hints(cls)
    built: dict[str, Any] = {}
    for name, value in values.items():
        default = known[name].default_factory
        if dataclasses.is_dataclass(default):
            value = from_dict(value, default, source=f"{source}.{name}")
        else:
            value = tuple(value) if isinstance(value, list) else value
            if not fits(value, hints[name]):
                raise UserError(f"{source}: '{name}' is {value!r}: give {described(hints[name])}.")
        built[name] = value
    for name in POSITIVE:
        if name in built and built[name] <= 0:
            raise UserError(f"{source}: '{name}' is {built[name]}: it must be above 0.")
    made = cls(**built)
    width = int(getattr(made, "width", 1))
    for heads in (getattr(made, "heads", None), getattr(made, "dino_heads", None)):
        if heads is not None and (heads < 1 or width % heads):
            raise UserError(
                f"{source}: width {width} is not divisible by {heads} heads: correct one of them."
            )
    if isinstance(made, RoGeConfig):
        return _checked_preview(_checked_features(made, source), source)
    return _checked_vae(made, source) if isinstance(made, VAEConfig) else made


# Sizes without which there is no network; other counts may be 0, which leaves something out.
POSITIVE = (
    "patch",
    "width",
    "heads",
    "base",
    "latent",
    "chunk",
    "max_context",
    "in_channels",
    "shift",
    "steps",
)


def _checked_vae(cfg: VAEConfig, source: str) -> VAEConfig:
    for name in ("latent_mean", "latent_std"):
        if len(getattr(cfg, name)) != cfg.latent:
            raise UserError(
                f"{source}: '{name}' has {len(getattr(cfg, name))} values for {cfg.latent} channels."
            )
    if not all(x > 0 for x in cfg.latent_std):
        raise UserError(f"{source}: 'latent_std' must be positive in every channel.")
    return cfg


def _checked_features(cfg: RoGeConfig, source: str) -> RoGeConfig:
    width, found = cfg.renderer.width, (cfg.fusion.feature_mean, cfg.fusion.feature_std)
    if found == (None, None):
        return cfg
    if any(x is None or len(x) != width for x in found):
        raise UserError(
            f"{source}.fusion: 'feature_mean' and 'feature_std' need {width} values each, the renderer's width."
        )
    if not all(x > 0 for x in found[1] or ()):
        raise UserError(f"{source}.fusion: 'feature_std' must be positive in every channel.")
    return cfg


def _checked_preview(cfg: RoGeConfig, source: str) -> RoGeConfig:
    std, channels = cfg.fusion.preview_std, cfg.vae.latent
    if std is None:
        return cfg
    if not cfg.fusion.preview or len(std) != channels or not all(x > 0 for x in std):
        raise UserError(
            f"{source}.fusion: 'preview_std' needs 'preview' and {channels} positive values, one per latent channel."
        )
    return cfg
