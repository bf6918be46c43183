"""How a long path is cut into windows of the model, which views each of them sees, and which of its frames are generated.

A window may be generated in part: a stretch of 1 + 4k frames, as a shorter window of its own, since the VAE is causal in
time and starts afresh at any frame. The other frames are the RGB head's picture.
"""

import numpy as np

from .. import model
from ..config import RoGeConfig
from ..errors import UserError
from ..geometry.cameras import (
    Cameras,
    Normalisation,
    camera_vector,
    concatenate,
    normalise,
    to_host,
)
from ..geometry.packing import GROUP, pad_path
from .photos import Photos, check_photos
from .whole import Whole

CHAIN_FRAMES = 2  # frames already made that join as contexts, where the model takes that many


def windows(frames: int, window: int) -> list[tuple[int, int]]:
    """[start, stop) of every window of a path."""
    return [(start, min(start + window, frames)) for start in range(0, frames, window)]


def chained(m: int, config: RoGeConfig) -> tuple[int, int]:
    """(photos, generated frames) that later windows see, of `m` photos: together at most `config.max_context`."""
    made = min(CHAIN_FRAMES, max(1, config.max_context - m), config.frames, config.max_context - 1)
    return min(m, config.max_context - made), made


def view_distance(a: Cameras, b: Cameras) -> np.ndarray:
    """[a, b]: how far apart views are, in normalised units of travel plus radians of turning."""
    a, b = to_host(a), to_host(b)
    travel = np.linalg.norm(a.centres[:, None] - b.centres[None], axis=-1)
    cosine = (np.einsum("aij,bij->ab", a.c2w[:, :3, :3], b.c2w[:, :3, :3]) - 1.0) / 2.0
    return travel + np.arccos(np.clip(cosine, -1.0, 1.0))


def chain_views(
    photos: Cameras, made: Cameras, ahead: Cameras, config: RoGeConfig
) -> tuple[list[int], list[int]]:
    """Which photos and which frames already made a later window sees (counts as in `chained`).

    The first photo stays: it is the world frame. Other photos stay if they are close to the window `ahead`. The last
    frame made is always in; the others are chosen one by one to bring the views ahead closest to what is seen.
    """
    keep, add = chained(len(photos), config)
    closeness = view_distance(photos, ahead).min(1)
    closeness[0] = -1.0
    kept = sorted(np.argsort(closeness, kind="stable")[:keep].tolist())
    gaps = view_distance(made, ahead)
    seen = view_distance(photos[kept], ahead).min(0)
    chosen: list[int] = []
    for _ in range(add):
        gain = np.minimum(gaps, seen[None]).mean(1)
        gain[chosen] = np.inf
        best = int(np.argmin(gain)) if chosen else len(made) - 1
        chosen.append(best)
        seen = np.minimum(seen, gaps[best])
    return kept, chosen


def window_views(
    images: np.ndarray,
    recon: np.ndarray | None,
    contexts: Cameras,
    targets: Cameras,
    info: Normalisation,
    config: RoGeConfig,
    *,
    frames: int | None = None,
    full: Whole | None = None,
) -> model.Views:
    """The arrays that the model takes for one window; cameras are normalised, the path is padded to the window, or to
    `frames`. `recon` and `full`: the images at the reconstruction's size, and whole, where there are any."""
    targets = pad_path(targets, config.frames if frames is None else frames)
    cameras = concatenate(contexts, targets)
    vectors = camera_vector(
        contexts, config.height, config.width, info.camera_scale, info.points_flag
    )
    views = {
        "context_rgb": images.astype(np.float32),
        "K": cameras.K.astype(np.float32),
        "c2w": cameras.c2w.astype(np.float32),
        "vectors": np.asarray(vectors, np.float32),
    }
    if recon is not None:
        views["context_recon"] = recon.astype(np.float32)
    if full is not None:
        views["full"] = full.arrays()
    return views


def make_views(
    photos: Photos,
    path: Cameras,
    config: RoGeConfig,
    *,
    scale: float | None = None,
    full: bool = False,
) -> tuple[model.Views, Normalisation]:
    """Photos and a path to what every function of `model` takes: (views, the frame that they are in).

    photos: of `read_photos`. path: cameras [n] in the scene's frame, K in pixels of config.height x config.width, at most
    a chunk; a shorter one is padded to `config.frames`. scale: a divisor of all positions; the model's rule if None.
    full: the photos whole besides, for pictures larger than the model's (`config.output`).
    Contexts come first; `Normalisation.apply` brings further cameras into the frame.
    Raises: UserError for a path that is longer or empty, photos of another size, or cameras that are none.
    """
    check_photos(photos, config)
    if not 1 <= len(path) <= config.frames:
        raise UserError(
            f"A path of {len(path)} frames is no single chunk of {config.frames}: give a part of it, or make the video with "
            "sampling.sample, which goes chunk by chunk."
        )
    context, target, info = normalise(photos.cameras, path, rule=config.scale_rule, scale=scale)
    seen, whole = (photos.images, photos.recon, context), photos.full if full else None
    return window_views(*seen, target, info, config, full=whole), info


def window_noise(seed: int, window: int, contexts: int, config: RoGeConfig) -> np.ndarray:
    """The noise of a window [t, lh, lw, 16] from seed and number alone, the same on every device.

    NumPy, because compiling JAX's generator takes longer than a short video's sampling.
    """
    shape = (config.slots(contexts), *config.latent_size, config.vae.latent)
    return np.random.default_rng([seed, window]).standard_normal(shape, np.float32)


def stretch_noise(noise: np.ndarray, contexts: int, offset: int, config: RoGeConfig) -> np.ndarray:
    """What a stretch of `config.frames`, `offset` frames into a window, has of the window's noise [t, lh, lw, 16]: that
    of the contexts and of the slots that its frames have there (`offset` is a multiple of four)."""
    first = contexts + offset // GROUP
    return np.concatenate([noise[:contexts], noise[first : first + config.slots(0)]])


def woven(made: np.ndarray, rest: np.ndarray, at: int) -> np.ndarray:
    """Frames of a window in their order: those `made` come after the first `at` of the `rest`."""
    return np.concatenate([rest[:at], made, rest[at:]])
