"""A training step compiled for accelerators that are not there: what `estimate` plans, said by the compiler."""

from typing import Any

import jax.numpy as jnp

from ..config import RoGeConfig
from ..core import aot, sharding
from . import estimate
from .stages import Stage, stage_specs


def compiled_step(
    config: RoGeConfig,
    stage: Stage,
    *,
    m: int | None = None,
    name: str = "h100",
    sizes: tuple[int, int, int] = (1, 1, 1),
    dtype: Any,
) -> aot.Compiled:
    """One optimiser step with m photos (None: the most there are) on a mesh of `sizes` of targets `name`.

    State, weights and batch lie where `training.loop` puts them.
    """
    m = max(stage.views.contexts) if m is None else m
    specs, frozen_specs = stage_specs(config, stage)
    with aot.compiling(name, sizes) as mesh:
        step, arguments = estimate.abstract_step(
            config, stage, m, scenes=stage.batch, dtype=jnp.dtype(dtype)
        )
        whole = sharding.replicated(mesh)
        where = sharding.state_shardings(arguments[0], specs, mesh)
        places = (
            where,
            sharding.shardings(frozen_specs, mesh),
            sharding.batch_sharding(mesh, stage.batch),
            whole,
        )
        arguments = tuple(map(aot.placed, arguments, places))
        return aot.compiled(step, arguments, donate_argnums=0, out_shardings=(where, whole))
