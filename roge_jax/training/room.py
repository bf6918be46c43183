"""Whether a run fits its mesh, its memory and its disk: asked before weights are loaded.

Refused is what cannot fit: weights, optimiser and gradients, exactly as many bytes as their shapes say. Activations are
estimated (`training.estimate`) for models that are large for their device, and where only they are too many a line
warns.
"""

from collections.abc import Sequence
from pathlib import Path

import jax

from .. import model
from ..config import RoGeConfig
from ..core import sharding, target
from ..core.memory import DEVICE, HOST, memory_available, own_memory, refuse
from ..core.params import count
from ..files.folders import check_disk
from . import estimate, loop
from .stages import Stage, stage_specs

GB = 1e9
# Estimating activations takes seconds to minutes: not done for a model that takes less than this share of the memory.
SMALL = 0.05
_LASTING, _SMALLER = "weights, optimiser and gradients", "or train a smaller model"


def check_layout(
    config: RoGeConfig, stage: Stage, mesh: sharding.AnyMesh | None, *, dtype: str
) -> None:
    """Raise UserError unless the mesh divides batch, leaves and, for the fused attention of GPUs, heads."""
    if mesh is None:
        return
    loop.check_batch(stage.batch, mesh)
    for specs in stage_specs(config, stage):
        sharding.shardings(specs, mesh)
    if target.fused(stage.products or dtype) and stage.objective in ("prior", "joint", "encoded"):
        sharding.check_heads(config.dit.heads, mesh)


def check_room(
    stage: Stage, config: RoGeConfig, mesh: jax.sharding.Mesh | None, *, dtype: str
) -> str:
    """A line to print if a step may not fit the memory, else ''. Raises: UserError if it cannot.

    Devices with memory of their own are held against it, and the host against what it holds beside them: what trains,
    as it was loaded, and one frozen leaf on its way. CPU devices share the memory of the host with that.
    """
    devices = [d for d in (jax.devices() if mesh is None else mesh.devices.flat) if _here(d)]
    count_here = 1 if mesh is None else len(devices)
    lasting = estimate.lasting(config, stage, mesh=mesh, dtype=dtype)
    name = f"Stage {stage.name} of '{config.name}'"
    loaded = 4.0 * count(stage_specs(config, stage)[0])
    needed, room, own = sum(lasting.values()), own_memory(devices), True
    if room is not None:
        cure = f"split the weights, --mesh fsdp=N, {_SMALLER}"
        refuse(name, needed, DEVICE, room, _LASTING, cure)
        loaded += estimate.largest_frozen(config, stage, dtype=dtype)
        refuse(
            name, loaded, HOST, memory_available(), "loading", f"close other programs, {_SMALLER}"
        )
    else:
        own, room = False, memory_available()
        needed = count_here * needed + loaded
        refuse(name, needed, HOST, room, _LASTING, f"close other programs, {_SMALLER}")
    if room is None or needed < SMALL * room:
        return ""
    found = estimate.estimate(config, stage, mesh=mesh, dtype=dtype)
    taken = found.bytes if own else needed + count_here * (found.bytes - sum(lasting.values()))
    if taken <= room:
        return ""
    where = DEVICE if own else HOST
    return (
        f"{name} is estimated to take {taken / GB:,.3g} GB {where} {room / GB:,.3g} GB, most activations in "
        f"{found.fullest}: if it fails, use more devices, --remat full or a smaller --batch (see --dry-run)"
    )


def check_space(
    out: Path, recipe: Sequence[tuple[Stage, RoGeConfig]], *, save_every: int, keep: int = 3
) -> None:
    """Raise UserError unless the disk has room for checkpoints and models of every stage (beside what is there)."""
    kept = most = 0.0
    for stage, config in recipe:
        specs, _ = stage_specs(config, stage)
        state, saves = estimate.state_bytes(config, stage), -(-stage.steps // save_every)
        kept += min(keep, saves) * state + estimate.stored_bytes(config, stage)
        most = max(most, kept + state * (saves > keep))  # the oldest goes when the new one is whole
        kept += 4.0 * count(model.specs(config)) + (4.0 * count(specs) if stage.lora else 0.0)
    what = "What the run keeps (checkpoints, models, encoded samples)"
    check_disk(max(most, kept), out, what, held=[out / stage.name for stage, _ in recipe])


def _here(device: jax.Device) -> bool:
    return device.process_index == jax.process_index()
