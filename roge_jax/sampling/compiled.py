"""The programs of a window compiled for accelerators that are not there: what `cost` plans, said by the compiler."""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from .. import cost, model
from ..config import RoGeConfig
from ..core import aot, sharding
from ..core.params import flatten, unflatten
from . import programs

PIECES = ("prepare", "velocity", "decode")


def compiled_window(
    config: RoGeConfig,
    m: int,
    *,
    name: str = "h100",
    sizes: tuple[int, int, int] = (1, 1, 1),
    dtype: str = "bfloat16",
    pieces: tuple[str, ...] = PIECES,
) -> dict[str, aot.Compiled]:
    """`programs.for_window` of m photos, random weights not even drawn, on a mesh of `sizes` of targets `name`.

    Pictures are those of the model's own size: whole photos, of which larger ones are made, are left out.
    """
    with aot.compiling(name, sizes) as mesh:
        whole = sharding.replicated(mesh)

        def everywhere(tree):
            return aot.placed(tree, whole)

        specs, kept = model.specs(config), cost.kept_as(dtype)
        flat = flatten(specs).items()
        leaves = {path: jax.ShapeDtypeStruct(s.shape, jnp.dtype(kept(path))) for path, s in flat}
        weights = aot.placed(unflatten(leaves), sharding.shardings(specs, mesh))
        views = everywhere(abstract_views(config, m))
        prepare = functools.partial(model.prepare, config=config)
        prepared = everywhere(jax.eval_shape(prepare, weights, views))
        size = (config.slots(m), *config.latent_size, config.vae.latent)
        state, sigma = (everywhere(jax.ShapeDtypeStruct(x, jnp.float32)) for x in (size, ()))
        calls = {
            "prepare": (prepare, (weights, views)),
            "velocity": (
                functools.partial(programs.velocity, config=config, slots="noised"),
                (weights, prepared, state, state, sigma),
            ),
            "decode": (
                functools.partial(programs.decode, config=config, contexts=m),
                (weights, state, prepared.detail),
            ),
        }
        return {piece: aot.compiled(*calls[piece], out_shardings=whole) for piece in pieces}


def abstract_views(config: RoGeConfig, m: int) -> dict[str, Any]:
    """Shapes of what a window is made from: m photos, cameras of all views."""
    views, size = m + config.frames, (config.height, config.width)
    recon = (config.recon_height, config.recon_width)
    shapes = {
        "context_rgb": (m, *size, 3),
        "K": (views, 3, 3),
        "c2w": (views, 4, 4),
        "vectors": (m, 11),
    }
    if recon != size:
        shapes["context_recon"] = (m, *recon, 3)
    return {key: jax.ShapeDtypeStruct(shape, jnp.float32) for key, shape in shapes.items()}
