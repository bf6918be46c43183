"""The reconstruction's own picture of ray features: the RGB head's, and what the rays find in the photos."""

from typing import Any

import jax
import jax.numpy as jnp

from ..config import RoGeConfig
from ..core.layers import resized
from ..core.params import Tree
from . import lookup, ray_scene

Views = dict[str, Any]  # arrays, see `roge_jax.model`


def recon_cameras(views: Views, config: RoGeConfig) -> tuple[jax.Array, jax.Array]:
    """K of all views in pixels of the reconstruction images (a plain resize of the generation crop), and c2w."""
    scale = jnp.asarray(
        [config.recon_width / config.width, config.recon_height / config.height, 1.0]
    )
    return views["K"] * scale[None, :, None], views["c2w"]


def recon_photos(views: Views, config: RoGeConfig) -> jax.Array:
    """The photos at the reconstruction's size [m, recon_height, recon_width, 3]."""
    images = views.get("context_recon")
    if images is not None:
        return images
    return resized(views["context_rgb"], config.recon_height, config.recon_width)


def only_targets(views: Views) -> Views:
    """The cameras of the targets alone; their `context` is `views`."""
    m = views["context_rgb"].shape[0]
    return views | {"K": views["K"][m:], "c2w": views["c2w"][m:]}


def decode_rgb(
    params: Tree,
    features: jax.Array,
    views: Views,
    *,
    config: RoGeConfig,
    context: Views | None = None,
) -> jax.Array:
    """The reconstruction's own picture [v, recon_height, recon_width, 3] of ray features of all cameras in `views`.

    `context`: the views that the photos belong to, if `views` are the targets alone (as for `model.query_rays`).
    """
    return decode_all(params, features, views, config=config, context=context or views).rgb


def show(params: Tree, features: jax.Array, views: Views, *, config: RoGeConfig) -> jax.Array:
    """`decode_rgb` of the targets alone [n, recon_height, recon_width, 3], from the ray features of all views."""
    return show_all(params, features, views, config=config)[0]


def show_all(
    params: Tree, features: jax.Array, views: Views, *, config: RoGeConfig, full: bool = False
) -> tuple[jax.Array, jax.Array | None]:
    """`show`, and with `full` the same at the output's size [n, H, W, 3] where there is one (`decode_all`)."""
    m, targets = views["context_rgb"].shape[0], only_targets(views)
    shown = decode_all(params, features[m:], targets, config=config, context=views, full=full)
    return shown.rgb, shown.full


def decode_all(
    params: Tree,
    features: jax.Array,
    views: Views,
    *,
    config: RoGeConfig,
    context: Views,
    full: bool = False,
) -> lookup.Looked:
    """`decode_rgb` with the parts it is made of, which training looks at too; without look-up all are the RGB head's.

    `full`: also the picture at the output's size, if `context` has the photos for it (`full`).
    """
    cfg = config.renderer
    finer = context.get("full") if full else None
    head = ray_scene.decode_rgb(params["renderer"]["rgb_head"], features, cfg=cfg)
    if not cfg.lookup:
        return lookup.Looked(head, head, head, head)
    if (
        finer is not None
    ):  # its windows are in pixels of the model's size, rays in the reconstruction's
        ratio = config.height / config.recon_height, config.width / config.recon_width
        finer = finer.rescaled(jnp.asarray([ratio]))
    photos = recon_photos(context, config)
    K, c2w = recon_cameras(context, config)
    return lookup.look_up(
        params["renderer"]["lookup"],
        features,
        head,
        photos,
        recon_cameras(views, config),
        (K[: len(photos)], c2w[: len(photos)]),
        cuts=cfg.lookup,
        full=None if finer is None else lookup.Full(finer, *config.output_size),
    )
