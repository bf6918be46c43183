"""From posed sequences to training samples: which views are contexts, which are targets, and how they are altered.

A sample is a pure function of (seed, index), so a training run that restarts sees the same data.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..errors import UserError
from ..geometry.cameras import Cameras, camera_vector, normalise
from .faults import captured

ATTEMPTS = 50  # at one sample


@dataclass(frozen=True)
class ViewConfig:
    """How training samples are drawn from a sequence."""

    contexts: tuple[int, ...] = (1, 2, 3, 4)
    context_weights: tuple[float, ...] = (0.1, 0.25, 0.4, 0.25)
    targets: int = 8
    ordered: bool = False  # targets are a contiguous run of frames (video), else any frames
    outside: float = 0.2  # probability that contexts surround the window instead of lying in it
    near: float = 0.4  # probability of drawing all views from a short stretch of the path
    augment: bool = True
    faults: float = 0.0  # probability that photos have those of a capture (`faults.captured`)
    size: tuple[int, int] | None = None  # height, width; None: as stored
    depth: bool = False  # samples carry the depth of all views

    def undisturbed(self) -> "ViewConfig":
        """The same for scoring: views from the whole path, pictures and cameras as they are."""
        return dataclasses.replace(self, augment=False, near=0.0, faults=0.0)


def draw_views(rng: np.random.Generator, frames: int, m: int, cfg: ViewConfig):
    """Indices of `m` contexts (shuffled) and of the targets, in a sequence of `frames` frames."""
    n = cfg.targets
    if not cfg.ordered:
        span = frames
        if rng.random() < cfg.near:
            longest = min(frames, max(frames // 2, m + 3))
            span = int(rng.integers(min(longest, max(m + 2, 5)), longest + 1))
        start = int(rng.integers(0, frames - span + 1))
        contexts = start + rng.choice(span, m, replace=False)
        targets = start + rng.choice(span, n, replace=span < n)
        return contexts, targets
    start = int(rng.integers(0, frames - n + 1))
    window = np.arange(start, start + n)
    around = np.setdiff1d(np.arange(frames), window)
    if rng.random() < cfg.outside and len(around) >= m:
        contexts = rng.choice(around, m, replace=False)
    else:  # stratified over the window, with jitter; whole edges, so that no frame is drawn twice
        edges = np.floor(np.linspace(0, n, m + 1))
        contexts = start + np.floor(rng.uniform(edges[:-1], edges[1:])).astype(int)
        rng.shuffle(contexts)
    return contexts, window if rng.random() < 0.5 else window[::-1]


def alter(
    rng: np.random.Generator,
    rgb: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    depth: np.ndarray | None = None,
):
    """One random mirror, colour permutation, inversion, gamma and saturation for all views of a sample.

    rgb [v, h, w, 3] in [0, 1]. A mirrored scene is a valid scene: pixels flip, cx moves, and the poses are
    conjugated by diag(-1, 1, 1, 1), which keeps det R = +1.
    """
    if rng.random() < 0.5:
        rgb, depth = rgb[:, :, ::-1], None if depth is None else depth[:, :, ::-1]
        flip = np.diag([-1.0, 1.0, 1.0, 1.0])
        c2w, K = flip @ c2w @ flip, K.copy()
        K[:, 0, 2] = rgb.shape[2] - K[:, 0, 2]
    if rng.random() < 0.5:
        rgb = rgb[..., rng.permutation(3)]
    if rng.random() < 0.2:
        rgb = 1.0 - rgb
    grey = rgb.mean(-1, keepdims=True)
    rgb = grey + rng.uniform(0.3, 1.8) * (rgb - grey)
    return np.clip(rgb, 0.0, 1.0) ** rng.uniform(0.7, 1.4), K, c2w, depth


def _depth_of(sequence: dict, views: np.ndarray, size: tuple[int, int] | None, number: int):
    """Depth of views [v, h, w] at `size`, each pixel that of the middle of its block."""
    if "depth" not in sequence:
        raise UserError(
            f"Sequence {number} of the data has no depth, which this stage learns from: render the dataset with --depth."
        )
    depth = np.asarray(sequence["depth"][views], np.float32)
    if size is not None:
        fy, fx = depth.shape[1] // size[0], depth.shape[2] // size[1]
        depth = depth[:, fy // 2 :: fy, fx // 2 :: fx]
    return depth


def average_down(rgb: np.ndarray, K: np.ndarray, size: tuple[int, int] | None):
    """uint8 frames [v, h, w, 3] to float32 in [0, 1] at `size` by averaging whole blocks; K [v, 3, 3] follows."""
    x, K = rgb.astype(np.float32) / 255.0, np.asarray(K, np.float64)
    v, h, w, c = x.shape
    if size is None or size == (h, w):
        return x, K
    fy, fx = h // size[0], w // size[1]
    if (fy * size[0], fx * size[1]) != (h, w):
        raise UserError(
            f"Frames of {h}x{w} cannot be averaged to {size[0]}x{size[1]}: render the dataset at a multiple of it."
        )
    K = K * np.array([1 / fx, 1 / fy, 1.0])[None, :, None]
    return x.reshape(v, size[0], fy, size[1], fx, c).mean((2, 4)), K


def make_sample(
    rgb, K, c2w, m: int, *, scale_rule: str, depth: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Views [m + n] (contexts first) as the arrays the model takes, normalised to the first context.

    Returns context_rgb [m, h, w, 3], target_rgb [n, h, w, 3] float32 in [0, 1], K [m + n, 3, 3] in pixels,
    c2w [m + n, 4, 4], vectors [m, 11]; given z-depth [m + n, h, w] also that, in the normalised unit.
    """
    h, w = rgb.shape[1:3]
    context, target, info = normalise(
        Cameras(K[:m], c2w[:m]), Cameras(K[m:], c2w[m:]), rule=scale_rule
    )
    measured = {} if depth is None else {"depth": (depth / info.divisor).astype(np.float32)}
    return measured | {
        "context_rgb": rgb[:m].astype(np.float32),
        "target_rgb": rgb[m:].astype(np.float32),
        "K": np.concatenate([context.K, target.K]).astype(np.float32),
        "c2w": np.concatenate([context.c2w, target.c2w]).astype(np.float32),
        "vectors": np.asarray(camera_vector(context, h, w, info.camera_scale, info.points_flag)),
    }


def draw_batch(
    pool, seed: int, index: int, batch: int, cfg: ViewConfig, *, scale_rule: str, rows=None
) -> dict:
    """Batch number `index`: arrays of `make_sample` with a leading batch axis; one M for the whole batch.

    M is a function of (seed, index), sample j of (seed, index, j): whoever draws only some `rows` of the batch (the
    processes of a run on many machines) gets the same samples, and the same M.

    `pool[i]` is a sequence: `rgb` [f, h, w, 3] uint8, `K` [f, 3, 3], `c2w` [f, 4, 4]; frames are averaged down to
    `cfg.size`, of which their size must be a multiple.
    """
    rng = np.random.default_rng([seed, index])
    weights = np.asarray(cfg.context_weights) / sum(cfg.context_weights)
    m = int(rng.choice(cfg.contexts, p=weights))
    samples = [
        _usable(pool, [seed, index, 2 + int(j)], m, cfg, scale_rule)  # [.., 0] would repeat M's
        for j in (range(batch) if rows is None else rows)
    ]
    return {name: np.stack([s[name] for s in samples]) for name in samples[0]}


def _usable(pool, entropy: list[int], m: int, cfg: ViewConfig, scale_rule: str) -> dict:
    """The sample of these random bits. Where the pool counts what cannot be used (`source.Mixture`), the next that can."""
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng(entropy + [attempt] * bool(attempt))
        draw = getattr(pool, "draw", None)
        number = draw(rng) if draw else int(rng.integers(len(pool)))
        try:
            return _sample(pool, number, rng, m, cfg, scale_rule)
        except (ValueError, OSError) as error:  # a UserError is a ValueError
            if draw is None:
                raise
            pool.pass_over(number, error)
            last = error
    raise UserError(
        f"{ATTEMPTS} sequences in a row cannot be used, the last because: {last}"
    ) from last


def _sample(pool, number: int, rng, m: int, cfg: ViewConfig, scale_rule: str) -> dict:
    sequence = pool[number]
    contexts, targets = draw_views(rng, len(sequence["K"]), m, cfg)
    views = np.concatenate([contexts, targets])
    finite = [np.isfinite(sequence[name][views]).all((1, 2)) for name in ("K", "c2w")]
    if not np.all(finite):
        bad = ", ".join(str(view) for view in np.unique(views[~np.logical_and(*finite)]))
        raise UserError(
            f"Sequence {number} of the data, frames {bad}: their cameras have NaN or infinite numbers: pack the scene again."
        )
    rgb, K = average_down(sequence["rgb"][views], sequence["K"][views], cfg.size)
    c2w = np.asarray(sequence["c2w"][views], np.float64)
    depth = _depth_of(sequence, views, cfg.size, number) if cfg.depth else None
    if cfg.augment:
        rgb, K, c2w, depth = alter(rng, rgb, K, c2w, depth)
    if cfg.faults and rng.random() < cfg.faults:
        photos, cameras = captured(rgb[:m].astype(np.float32), Cameras(K[:m], c2w[:m]), rng)
        rgb, K = np.concatenate([photos, rgb[m:]]), np.concatenate([cameras.K, K[m:]])
        c2w = np.concatenate([cameras.c2w, c2w[m:]])
    try:
        return make_sample(rgb, K, c2w, m, scale_rule=scale_rule, depth=depth)
    except UserError as error:
        chosen = ", ".join(str(view) for view in views)
        raise UserError(f"Sequence {number} of the data, frames {chosen}: {error}") from error
