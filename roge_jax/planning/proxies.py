"""What can be measured of a scene before a video of it is made, without its truth. Each has a price in FLOPs.

detail          energy of fine detail in the photos; free
leave_one_out   RMS error of photos predicted from all others by the RGB head, at half size where that is possible
redundancy      how unlike neighbouring scene tokens are; comes with the one above
richardson      RMS difference of the first window's latents between 2 and 4 steps, reconstruction at half size
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import cost, model
from ..config import RoGeConfig
from ..core.params import Tree
from ..geometry.cameras import Cameras, normalise
from ..recon.ray_scene import merge_scene
from ..recon.vggt import encoder_grid
from ..sampling import programs
from ..sampling.photos import Photos
from ..sampling.video import Settings
from ..sampling.windows import window_noise, window_views
from ..video import flow, solvers

PROBE_STEPS = 2  # and twice as many
LEFT_OUT = 2  # photos, evenly spread: more say little more and cost as much again


@dataclasses.dataclass(frozen=True)
class Measured:
    """values: {proxy: number}, absent where it could not be measured. flops: what measuring took."""

    values: dict[str, float]
    flops: float


def measure(
    params: Tree,
    config: RoGeConfig,
    photos: Photos,
    path: Cameras,
    settings: Settings,
    most: float,
    compiled: dict[Any, Any],
) -> Measured:
    """All proxies that take at most `most` FLOPs each. `compiled` keeps programs for further scenes."""
    found = Measured({"detail": detail(photos.images)}, 0.0)
    m = len(photos.ids)
    price = leave_one_out_price(config, m)
    if m > 1 and price <= most:
        values = leave_one_out(params, config, photos, compiled)
        found = Measured(found.values | values, found.flops + price)
    price = richardson_price(config, m)
    if price <= most:
        value = richardson(params, config, photos, path, settings, compiled)
        found = Measured(found.values | {"richardson": value}, found.flops + price)
    return found


def half_size(config: RoGeConfig) -> RoGeConfig | None:
    """The model with its reconstruction at half size; None where that is no whole number of patches."""
    patch = config.renderer.patch
    if config.encoder.long_side is None:
        patch = int(np.lcm(patch, config.encoder.patch))
    height, width = config.recon_height // 2, config.recon_width // 2
    if height % patch or width % patch or 2 * height != config.recon_height:
        return None
    return dataclasses.replace(config, recon_height=height, recon_width=width)


def detail(images: np.ndarray) -> float:
    """Root mean square of photos [m, h, w, 3] minus their 3 x 3 means: what blur takes away."""
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    h, w = images.shape[1:3]
    mean = sum(padded[:, i : i + h, j : j + w] for i in range(3) for j in range(3)) / 9.0
    return float(np.sqrt(np.square(images - mean).mean(dtype=np.float64)))


def leave_one_out_price(config: RoGeConfig, m: int) -> float:
    """FLOPs of `leave_one_out` with m photos: previews of one view."""
    alone = dataclasses.replace(half_size(config) or config, frames=1)
    return len(left_out(m)) * cost.preview(alone, m - 1) if m > 1 else 0.0


def left_out(m: int) -> list[int]:
    """Which of m photos are left out, one after another."""
    k = min(m, LEFT_OUT)
    return [int((i + 0.5) * m / k) for i in range(k)]


def leave_one_out(
    params: Tree, config: RoGeConfig, photos: Photos, compiled: dict[Any, Any]
) -> dict[str, float]:
    """The proxies leave_one_out, over the photos left out together, and redundancy: the share of the scene tokens'
    energy that averaging 2 x 2 neighbours takes away (0: neighbours are equal). Two photos or more."""
    m = len(photos.ids)
    small = half_size(config) or config
    alone = dataclasses.replace(config, frames=1)
    runs = []
    for i in left_out(m):
        rest = [j for j in range(m) if j != i]
        context, target, info = normalise(
            photos.cameras[rest], photos.cameras[i], rule=config.scale_rule
        )
        runs.append(window_views(photos.images[rest], None, context, target, info, alone))
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *runs)
    key = ("leave_one_out", m, small)
    if key not in compiled:
        compiled[key] = jax.jit(functools.partial(_predict, config=small))
    pictures, apart = jax.device_get(compiled[key](params, batch))
    left = jnp.asarray(photos.images[left_out(m)])
    truth = np.asarray(model.resized(left, *pictures.shape[1:3]))
    errors = np.square(pictures - truth).mean(dtype=np.float64)
    return {"leave_one_out": float(np.sqrt(errors)), "redundancy": float(apart.mean())}


def _predict(params, batch, *, config: RoGeConfig):
    """([k, h, w, 3] the views left out, [k] how unlike neighbouring tokens are), one after another."""
    grid = encoder_grid(config.encoder, config.recon_height, config.recon_width)

    def one(views):
        tokens = model.reconstruct(params, views, config=config)
        picture, _ = programs.rgb_head(params, views, config=config, scene_tokens=tokens)
        cell = jnp.square(tokens).mean() - jnp.square(merge_scene(tokens, None, grid, 4)[0]).mean()
        return picture[0], cell / jnp.square(tokens).mean()

    return jax.lax.map(one, batch)


def richardson_price(config: RoGeConfig, m: int) -> float:
    """FLOPs of `richardson` with m photos."""
    price = cost.estimate(half_size(config) or config, m, 3 * PROBE_STEPS)
    return price.total_flops - price.flops["decode"]


def richardson(
    params: Tree,
    config: RoGeConfig,
    photos: Photos,
    path: Cameras,
    settings: Settings,
    compiled: dict[Any, Any],
) -> float:
    """How far two steps are from four, in latents."""
    small = half_size(config) or config
    context, target, info = normalise(
        photos.cameras, path, rule=config.scale_rule, scale=settings.scale
    )
    views = window_views(photos.images, None, context, target[: config.frames], info, config)
    m = len(photos.ids)
    noise = jnp.asarray(window_noise(settings.seed, 0, m, config))
    key = ("richardson", m, small, settings.slots)
    if key not in compiled:
        compiled[key] = jax.jit(functools.partial(_two_runs, config=small, slots=settings.slots))
    return float(compiled[key](params, views, noise))


def _two_runs(params, views, noise, *, config: RoGeConfig, slots):
    prepared = model.prepare(params, views, config=config)
    ends = []
    for steps in (PROBE_STEPS, 2 * PROBE_STEPS):
        grid = flow.schedule("shift", steps, shift=config.flow.shift, solver="unipc_2")
        x0, _ = model.generate(
            params,
            prepared,
            noise,
            config=config,
            solver=solvers.tabulate("unipc_2", grid),
            mode=slots,
        )
        ends.append(x0)
    return jnp.sqrt(jnp.square(ends[0] - ends[1]).mean())
