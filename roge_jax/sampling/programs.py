"""What runs in a window of a video, compiled for its shapes: preparation, velocity, decoding; or the preview alone.

A window is generated as a whole, or a stretch of it is, or nothing: other frames are the RGB head's picture.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp

from .. import model
from ..config import RoGeConfig
from ..core import sharding
from ..core.params import Tree
from ..core.stepping import stepping
from ..recon.picture import decode_all
from ..video import flow


class Programs(NamedTuple):
    """What runs in a window of given shapes, compiled."""

    prepare: Callable  # (params, views) -> Prepared; with a `rest`: `prepare_stretch`
    velocity: Callable  # (params, prepared, noise, x, sigma) -> velocity
    decode: Callable  # (params, x0, detail) -> frames [n, h, w, 3]


def velocity(
    params,
    prepared: model.Prepared,
    noise,
    x,
    sigma,
    *,
    config: RoGeConfig,
    slots: flow.ContextSlots,
):
    """The network on a state whose context slots are first set as `slots` asks (the solver's own state keeps its own)."""
    field, project = model.sampling_field(params, prepared, noise, config=config, mode=slots)
    return field(x if project is None else project(x, sigma), sigma)


def prepare_stretch(
    params: Tree, views: model.Views, rest: model.Views, *, config: RoGeConfig
) -> tuple[model.Prepared, tuple[jax.Array, jax.Array | None]]:
    """(`model.prepare` of a stretch of a window, `rgb_head` of the targets of `rest`): the photos, the same in both, are
    reconstructed once."""
    tokens = model.reconstruct(params, views, config=config)
    prepared = model.prepare(params, views, config=config, scene_tokens=tokens)
    return prepared, rgb_head(params, rest, config=config, scene_tokens=tokens)


def decode(params, x0, detail, *, config: RoGeConfig, contexts: int):
    """Latents of a whole window [t, lh, lw, 16] -> frames; contexts are dropped. `detail`: of `model.Prepared`."""
    return model.decode_video(params, x0[contexts:], config=config, detail=detail)


def for_window(
    params: Tree,
    views: model.Views,
    config: RoGeConfig,
    slots: flow.ContextSlots,
    rest: model.Views | None = None,
) -> Programs:
    """Compile all pieces for the shapes of `views`, side by side: compiling is what a short run waits for.

    `config.frames` is the number of targets in `views`, all of which are generated; those of `rest` are shown.
    On a mesh (`core.sharding.use`) weights stay where they lie; all else goes in and comes out whole.
    """
    m, whole = views["context_rgb"].shape[0], sharding.everywhere()
    fix, jit = functools.partial, functools.partial(jax.jit, out_shardings=whole)
    plain: dict[str, Callable] = {
        "prepare": fix(model.prepare if rest is None else prepare_stretch, config=config),
        "velocity": fix(velocity, config=config, slots=slots),
        "decode": fix(decode, config=config, contexts=m),
    }
    if stepping():
        return Programs(**plain)
    pieces = {name: jit(piece) for name, piece in plain.items()}
    shapes = sharding.shapes
    weights = shapes(params)
    seen = [shapes(some) for some in (views, rest) if some is not None]
    made = jax.eval_shape(pieces["prepare"], weights, *seen)
    prepared = shapes(made if rest is None else made[0])
    state = jax.ShapeDtypeStruct(
        (config.slots(m), *config.latent_size, config.vae.latent), jnp.float32, sharding=whole
    )
    sigma = jax.ShapeDtypeStruct((), jnp.float32, sharding=whole)
    arguments = {
        "prepare": (weights, *seen),
        "velocity": (weights, prepared, state, state, sigma),
        "decode": (weights, state, prepared.detail),
    }
    # Tracing holds Python's lock, compiling does not.
    lowered = {name: pieces[name].lower(*shape) for name, shape in arguments.items()}
    with ThreadPoolExecutor(len(lowered)) as pool:
        compiled = {name: pool.submit(low.compile) for name, low in lowered.items()}
    return Programs(**{name: work.result() for name, work in compiled.items()})


class PreviewProgram(NamedTuple):
    """What runs in a window that is not generated."""

    preview: Callable  # (params, views) -> `rgb_head`


def rgb_head(
    params: Tree, views: model.Views, *, config: RoGeConfig, scene_tokens: jax.Array | None = None
) -> tuple[jax.Array, jax.Array | None]:
    """The reconstruction's own picture of the targets [n, recon_h, recon_w, 3], and at the output's size [n, H, W, 3]
    where `views` have `full`; the photos' rays are not queried."""
    tokens = scene_tokens
    tokens = model.reconstruct(params, views, config=config) if tokens is None else tokens
    if config.renderer.refinement == "shared":  # its refinement reads the rays of the photos
        features = model.query_rays(params, tokens, views, config=config)
        return model.show_all(params, features, views, config=config, full=True)
    targets = model.only_targets(views)
    features = model.query_rays(params, tokens, targets, config=config, context=views)
    shown = decode_all(params, features, targets, config=config, context=views, full=True)
    return shown.rgb, shown.full


def for_preview(
    params: Tree, views: model.Views, config: RoGeConfig, slots: flow.ContextSlots
) -> PreviewProgram:
    """`for_window`, where the window is not generated."""
    shown = functools.partial(rgb_head, config=config)
    if stepping():
        return PreviewProgram(shown)
    piece = jax.jit(shown)
    return PreviewProgram(piece.lower(params, views).compile())
