"""What a training step costs before it runs: work and memory of every device, from specs and sizes alone.

The step is traced on abstract arrays (`core.program`); no weight is made or read. Exact for weights, optimiser and
FLOPs; memory of activations comes from the order and fusion rules described there. `docs/results/scaling.md` compares it with
XLA's own analysis.
"""

import dataclasses
import functools
import math
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .. import cost, model
from ..config import RoGeConfig
from ..core import program, sharding, target
from ..core.params import Tree, abstract, count, flatten, unflatten
from ..recon.vggt import encoder_grid
from . import encoded
from .loop import initial_state, make_step
from .optim import make_optimiser
from .stages import Stage, objective_of, stage_config, stage_specs

# Names that `model` gives to its parts, as shown to people.
PARTS = {
    "vae": "VAE",
    "reconstruct": "reconstruct",
    "rays": "query rays",
    "picture": "RGB head",
    "condition": "condition",
    "transformer": "transformer",
}
PASSES = ("forward", "recomputed", "backward")
GB = 1e9


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One training step on one device."""

    tokens: dict[str, int]
    parameters: dict[str, int]  # trained, frozen
    scenes: int  # of the batch, on this device
    work: dict[str, dict[str, float]]  # part -> pass -> FLOPs
    memory: dict[str, float]  # bytes: frozen weights, trained state, batch, activations
    fullest: str  # where activations take the most

    @property
    def bytes(self) -> float:
        """All that one device holds at its fullest."""
        return sum(self.memory.values())

    @property
    def flops(self) -> float:
        """FLOPs of one device and step."""
        return sum(sum(passes.values()) for passes in self.work.values())


def abstract_batch(config: RoGeConfig, stage: Stage, m: int, scenes: int) -> Tree:
    """Shapes of a stage's batch with m photos; `config` is the stage's own (`stage_config`)."""
    n, views = stage.views.targets, m + stage.views.targets

    def array(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((scenes, *shape), jnp.float32)

    if stage.objective == "vae":
        size = (stage.crop, stage.crop) if stage.crop else (config.height, config.width)
        return {"target_rgb": array(n, *size, 3)}
    batch = {
        "context_rgb": array(m, config.height, config.width, 3),
        "target_rgb": array(n, config.height, config.width, 3),
        "K": array(views, 3, 3),
        "c2w": array(views, 4, 4),
        "vectors": array(m, 11),
    }
    if stage.objective != "encoded":
        return batch
    encode = functools.partial(encoded.encode, config=config)
    return jax.eval_shape(jax.vmap(encode, (None, 0)), abstract(model.specs(config)), batch)


def abstract_frozen(specs: Tree, dtype: Any) -> Tree:
    """Frozen leaves: large matrices in `dtype`, the VAE, norms and modulation in float32."""
    flat = flatten(abstract(specs))
    return unflatten(
        {
            path: x if cost.keeps_float32(path) else jax.ShapeDtypeStruct(x.shape, dtype)
            for path, x in flat.items()
        }
    )


def abstract_state(config: RoGeConfig, stage: Stage) -> Tree:
    """Shapes of what a checkpoint of the stage holds."""
    specs, _ = stage_specs(config, stage)
    optimiser = make_optimiser(stage.optim, specs, stage.steps)
    return jax.eval_shape(
        lambda trained: initial_state(trained, optimiser, stage.optim), abstract(specs)
    )


def abstract_step(
    config: RoGeConfig, stage: Stage, m: int, *, scenes: int, dtype: Any = jnp.float32
) -> tuple[Callable, tuple]:
    """(step, abstract arguments) of one optimiser step on `scenes` scenes of m photos; `step` is `make_step`'s."""
    working = stage_config(config, stage)
    specs, frozen_specs = stage_specs(config, stage)
    optimiser = make_optimiser(stage.optim, specs, stage.steps)
    objective = objective_of(working, stage)
    state = abstract_state(config, stage)
    key = jax.eval_shape(lambda: jax.random.key(0))
    batch = abstract_batch(working, stage, m, scenes)
    arguments = (state, abstract_frozen(frozen_specs, dtype), batch, key)
    return make_step(objective, optimiser, stage.optim), arguments


def estimate(
    config: RoGeConfig,
    stage: Stage,
    *,
    m: int | None = None,
    mesh: sharding.AnyMesh | None = None,
    dtype: Any = jnp.float32,
) -> Estimate:
    """What one device of `mesh` (None: a single one) does and holds in a step with m photos (None: the most there are).

    `dtype`: of frozen matrices. The device is that of `core.target`. On a GPU, where they are bfloat16, attention is the
    fused kernel: one operation that stores no scores, and keeps its inputs, its result and the softmax's sums for its
    gradient.
    Raises UserError if the mesh does not divide the batch or a leaf.
    """
    m = max(stage.views.contexts) if m is None else m
    working = stage_config(config, stage)
    specs, frozen_specs = stage_specs(config, stage)
    sizes = dict(mesh.shape) if mesh is not None else dict.fromkeys(sharding.MESH_AXES, 1)
    scenes = stage.batch
    if mesh is not None:
        scenes = sharding.batch_sharding(mesh, stage.batch).shard_shape((stage.batch,))[0]
    # Traced with this device's share of the scenes, but all of their tokens.
    lone_cpu = mesh is None and target.platform() == "cpu"
    whole = None if lone_cpu else sharding.abstract_mesh()
    part_of = dataclasses.replace(stage, batch=scenes)
    traced, arguments = _traced(config, part_of, m, scenes, jnp.dtype(dtype), target.name(), whole)

    tokens = sequence_lengths(working, m)
    split = split_axes(working, tokens, scenes)
    shares = {tuple(s.shape) for s in flatten(specs).values() if "embed" in s.axes}

    def weigh(value: Any, scope: str) -> float:
        size, shape = program.size(value), tuple(getattr(value, "shape", ()))
        if shape in shares:  # a gradient lies where its parameter does
            return size / sizes["fsdp"]
        whole, axes = split.get(part(scope), (1, set()))
        return size / whole * math.ceil(whole / sizes["seq"]) if axes.intersection(shape) else size

    peak = program.peak(traced, weigh)
    work: dict[str, dict[str, float]] = {}
    for label, value in program.flops(traced, lambda s: f"{part(s)} {which_pass(s)}").items():
        name, _, kind = label.partition(" ")
        share = sizes["seq"] if name in split else 1  # its devices repeat what it does not split
        row = work.setdefault(PARTS.get(name, "the rest"), dict.fromkeys(PASSES, 0.0))
        row[kind] += value / share
    order = [*PARTS.values(), "the rest"]
    by_part: dict[str, float] = {}
    for held in peak.held:
        name = f"{PARTS.get(part(held.scope), 'the rest')}, {which_pass(held.scope)}"
        by_part[name] = by_part.get(name, 0.0) + held.bytes
    batch = arguments[2]
    return Estimate(
        tokens=tokens,
        parameters={"trained": count(specs), "frozen": count(frozen_specs) if frozen_specs else 0},
        scenes=scenes,
        work={name: work[name] for name in order if name in work},
        memory={
            **_held_all(config, stage, mesh, dtype),
            "batch": _tree_bytes(batch),
            "activations and gradients": peak.bytes,
        },
        fullest=max(by_part, key=by_part.__getitem__, default="nowhere"),
    )


def lasting(
    config: RoGeConfig, stage: Stage, *, mesh: sharding.AnyMesh | None = None, dtype: Any
) -> dict[str, float]:
    """Bytes on one device of what every step needs, nothing traced: weights, optimiser and gradients."""
    specs, _ = stage_specs(config, stage)
    return _held_all(config, stage, mesh, dtype) | {
        "gradients": _held(abstract(specs), specs, mesh)
    }


def largest_frozen(config: RoGeConfig, stage: Stage, *, dtype: Any) -> float:
    """Bytes of the largest frozen leaf that the stage reads, whole."""
    frozen = abstract_frozen(stage_specs(config, stage)[1], dtype)
    return max((program.size(x) for x in jax.tree.leaves(frozen)), default=0.0)


def state_bytes(config: RoGeConfig, stage: Stage) -> float:
    """Bytes of one checkpoint, which holds whole arrays."""
    return _tree_bytes(abstract_state(config, stage))


def stored_bytes(config: RoGeConfig, stage: Stage) -> float:
    """Bytes of the samples that a stage keeps encoded, those with the most photos; 0 if it keeps none."""
    if not stage.stored:
        return 0.0
    most = max(stage.views.contexts)
    return stage.stored * _tree_bytes(abstract_batch(stage_config(config, stage), stage, most, 1))


def _held_all(config, stage, mesh, dtype) -> dict[str, float]:
    specs, frozen_specs = stage_specs(config, stage)
    state, frozen = abstract_state(config, stage), abstract_frozen(frozen_specs, dtype)
    return {
        "frozen weights": _held(frozen, frozen_specs, mesh),
        "trained weights and optimiser": _held(state, specs, mesh, state=True),
    }


@functools.lru_cache(maxsize=4)
def _traced(config, stage, m, scenes, dtype, name, mesh) -> tuple[program.Program, tuple]:
    """`name`: of the target that is set, for the cache."""
    step, arguments = abstract_step(config, stage, m, scenes=scenes, dtype=dtype)
    with sharding.use(mesh):
        return program.trace(step, *arguments), arguments


def part(scope: str) -> str:
    """The part of the model that an operation belongs to; '' for none."""
    found = re.search(rf"\b({'|'.join(PARTS)})\b", scope)
    return found[1] if found else ""


def which_pass(scope: str) -> str:
    """forward, recomputed or backward: the pass that an operation belongs to."""
    if "rematted_computation" in scope:
        return "recomputed"
    return "backward" if "transpose(" in scope else "forward"


def sequence_lengths(config: RoGeConfig, m: int) -> dict[str, int]:
    """How long the sequences of one scene are."""
    rows, columns = encoder_grid(config.encoder, config.recon_height, config.recon_width)
    rays = config.recon_height * config.recon_width // config.renderer.patch**2
    return {
        "scene tokens": m * rows * columns,
        "rays per view": rays,
        "views": m + config.frames,
        "transformer tokens": cost.tokens_per_slot(config) * config.slots(m),
    }


def split_axes(
    config: RoGeConfig, tokens: dict[str, int], scenes: int
) -> dict[str, tuple[int, set[int]]]:
    """What `seq` splits in a part: how many of them there are, and the lengths of axes that run over them."""
    chunk, rays = min(tokens["views"], config.renderer.chunk), tokens["rays per view"]
    per_view = (1, rays, rays + config.renderer.registers, tokens["scene tokens"])
    whole = tokens["transformer tokens"]
    lengths = {
        "transformer": (whole, {whole, whole * scenes}),
        "rays": (chunk, {n * chunk * t for n in (1, scenes) for t in per_view}),
    }
    # The fused kernel of GPUs takes even lengths only.
    return {name: (n, axes | {t + t % 2 for t in axes}) for name, (n, axes) in lengths.items()}


def _tree_bytes(tree: Any) -> float:
    return sum(program.size(x) for x in jax.tree.leaves(tree))


def _held(tree: Any, specs: Tree, mesh, *, state: bool = False) -> float:
    """Bytes on one device of arrays that lie where the table says."""
    if mesh is None or not specs:
        return _tree_bytes(tree)
    where = (
        sharding.state_shardings(tree, specs, mesh) if state else sharding.shardings(specs, mesh)
    )
    held = jax.tree.map(lambda x, s: _share(x, s), tree, where)
    return sum(jax.tree.leaves(held))


def _share(x: Any, where: jax.sharding.NamedSharding) -> float:
    return program.size(jax.ShapeDtypeStruct(where.shard_shape(x.shape), x.dtype))


# ---- how much to recompute -----------------------------------------------------------------------

LARGE = 1e9  # transformer parameters from which a step recomputes its blocks: see docs/results/scaling.md


def default_remat(config: RoGeConfig) -> str:
    """What the transformer's backward pass recomputes unless the user says otherwise: enough for 80 GB."""
    from ..video.dit import dit_specs

    return "full" if count(dit_specs(config.dit)) > LARGE else "dots"


def report(
    found: Estimate,
    config: RoGeConfig,
    stage: Stage,
    *,
    m: int,
    mesh: sharding.AnyMesh | None,
    dtype: str,
) -> str:
    """What `train --dry-run` prints."""
    working = stage_config(config, stage)
    layout = "1 device" if mesh is None else ", ".join(f"{k}={v}" for k, v in mesh.shape.items())
    counts, device = found.parameters, target.current()
    kind = f" of {device.title}" if target.name() in target.TARGETS else ""
    lines = [
        f"stage     {stage.name} of {config.name}: {counts['trained'] / 1e6:,.1f} M parameters train, "
        f"{counts['frozen'] / 1e6:,.1f} M are frozen ({dtype}); products read {stage.products or dtype}",
        f"step      {stage.batch} scenes of {m} photos and {stage.views.targets} targets at "
        f"{working.height}x{working.width} (reconstruction at {working.recon_height}x{working.recon_width})"
        + (f", {stage.draws} noise levels each" if stage.draws > 1 else ""),
        f"devices   {layout}{kind}: {found.scenes} scenes each; the transformer recomputes: {stage.remat}",
        "tokens    " + ", ".join(f"{n:,} {name}" for name, n in found.tokens.items()),
        "",
        f"{'FLOPs of one device, one step':30s}" + "".join(f"{name:>14s}" for name in PASSES),
    ]
    for name, passes in found.work.items():
        cells = (cost.scaled(passes[kind], "") if passes[kind] else "" for kind in PASSES)
        lines.append(f"{name:30s}" + "".join(f"{cell:>14s}" for cell in cells))
    lines += [f"{'all':30s}{cost.scaled(found.flops, 'FLOP'):>14s}", "", "bytes of one device"]
    lines += [f"{name:30s}{cost.scaled(n, 'B'):>14s}" for name, n in found.memory.items()]
    has = f", of {cost.scaled(device.memory, 'B')} that it has" if device.memory else ""
    lines.append(f"{'all':30s}{cost.scaled(found.bytes, 'B'):>14s}{has}")
    lines.append(
        f"activations take the most in: {found.fullest}; XLA's scratch space is not counted, allow 10 %"
    )
    return "\n".join(lines)
