"""The rows of `real_size.py`: what each one computes, at which size.

Random weights and inputs; bfloat16 matrices on a GPU, float32 on a CPU.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed.timing import measure, where_and_when
from roge_jax import config as presets
from roge_jax import cost, model
from roge_jax.config import RoGeConfig
from roge_jax.core.params import Tree, fan_in, flatten, init, normal, unflatten, zeros
from roge_jax.fusion import Condition
from roge_jax.recon.vggt import encoder_grid
from roge_jax.sampling import programs
from roge_jax.training import estimate, stages
from roge_jax.training.loop import initial_state
from roge_jax.training.optim import make_optimiser
from roge_jax.video import flow, solvers


class Row(NamedTuple):
    """One line of the table. Floor, "must" and "reach for" are goals for one H100 or H200, in seconds.

    `remat` (of train): this policy alone, None: the first that fits. `unroll` (of dit): blocks per turn of the loop;
    only the plain form has a peer. `part` (of numerics): dit, encoder or rays.
    """

    group: str  # dit, train, vggt, rays, render, vae, sample, numerics
    config: RoGeConfig
    m: int
    floor: float | None = None
    must: float | None = None
    reach: float | None = None
    ladder: bool = False
    remat: str | None = None
    unroll: int = 1
    part: str = "dit"

    @property
    def sides(self) -> tuple[str, ...]:
        return ("ours", "peer") if self.group == "dit" and self.unroll == 1 else ("ours",)


def sized(base: RoGeConfig, **changes) -> RoGeConfig:
    return dataclasses.replace(base, **changes)


def _ladder(width: int, depth: int) -> RoGeConfig:
    mini = presets.preset("mini")
    numbers = {"width": width, "heads": width // 64, "depth": depth, "ffn": 4 * width}
    dit = dataclasses.replace(mini.dit, text_dim=64, text_len=16, **numbers)
    return sized(mini, dit=dit)


def rows() -> dict[str, Row]:
    paper, mini, tiny = (presets.preset(name) for name in ("paper", "mini", "tiny"))
    large = sized(paper, height=480, width=832)
    shallow = sized(paper, dit=dataclasses.replace(paper.dit, depth=2))
    views = {"recon_height": 512, "recon_width": 512, "frames": 9}
    encoder_336x518 = {"recon_height": 344, "recon_width": 528}  # what the encoder resizes them to
    few = sized(paper, frames=9)
    found = {
        "DiT-14B forward, 192x336, M=6, N=81": Row("dit", paper, 6, 0.275, 0.38, 0.31),
        "DiT-14B forward, 480x832, M=6, N=81": Row("dit", large, 6, 3.67, 4.6, 3.85),
        "LoRA joint step, 192x336, batch 1": Row("train", paper, 6, 1.2, 2.9, 1.9),
        "LoRA step, 480x832, reconstruction frozen": Row("train", large, 6, 12.3, 19.0, 15.0),
        "VGGT-1B, 10 views at 336x518": Row(
            "vggt", sized(paper, **encoder_336x518), 10, 0.033, 0.080, 0.055
        ),
        "renderer 512x512, 2 views, per frame": Row(
            "render", sized(paper, **views), 2, 0.0035, 1 / 90, 1 / 150
        ),
        "all 87 ray features, 288x504, M=6": Row("rays", paper, 6, 0.24, 0.50, 0.35),
        "VAE decode, 81 frames, 480x832": Row("vae", large, 6, 0.69, 2.0, 1.0),
        "81 frames, 50 steps, 192x336, everything included": Row("sample", paper, 6, 14.3, 20, 16),
        "bfloat16 against float32: 2 blocks of DiT-14B, 192x336": Row("numerics", shallow, 6),
        "bfloat16 against float32: VGGT-1B, 6 views": Row("numerics", few, 6, part="encoder"),
        "bfloat16 against float32: 15 ray features": Row("numerics", few, 6, part="rays"),
        "DiT-14B, 192x336, 4 blocks per turn": Row("dit", paper, 6, unroll=4),
        "DiT-14B, 192x336, no loop": Row("dit", paper, 6, unroll=paper.dit.depth),
        "LoRA joint step, 192x336, remat dots": Row("train", paper, 6, remat="dots"),
        "LoRA joint step, 192x336, remat attention": Row("train", paper, 6, remat="attention"),
        "LoRA joint step, 192x336, remat full": Row("train", paper, 6, remat="full"),
    }
    small = {
        "ladder: DiT forward, width 128, 4 blocks": Row("dit", _ladder(128, 4), 3),
        "ladder: DiT forward, width 256, 6 blocks": Row("dit", _ladder(256, 6), 3),
        "ladder: DiT forward, width 384, 8 blocks": Row("dit", _ladder(384, 8), 3),
        "ladder: LoRA joint step, tiny": Row("train", tiny, 3),
        "ladder: VGGT, 3 views, mini": Row("vggt", mini, 3),
        "ladder: renderer, 2 views, mini, per frame": Row("render", mini, 2),
        "ladder: all ray features, mini, M=3": Row("rays", mini, 3),
        "ladder: VAE decode, mini": Row("vae", mini, 3),
        "ladder: 50 steps, everything included, tiny": Row("sample", tiny, 3),
        "ladder: bfloat16 against float32, width 128": Row("numerics", _ladder(128, 4), 3),
        "ladder: bfloat16 against float32, encoder of mini": Row(
            "numerics", mini, 3, part="encoder"
        ),
        "ladder: bfloat16 against float32, rays of mini": Row("numerics", mini, 3, part="rays"),
        "ladder: DiT, width 384, 8 blocks, no loop": Row("dit", _ladder(384, 8), 3, unroll=8),
        "ladder: LoRA joint step, tiny, remat full": Row("train", tiny, 3, remat="full"),
    }
    return found | {name: row._replace(ladder=True) for name, row in small.items()}


# ---- weights and inputs --------------------------------------------------------------------------


def weights(specs: Tree, dtype: Any) -> Tree:
    """Random leaves made of one short random vector: no time is spent on drawing billions of numbers.

    Its length is prime, so that no two rows of a matrix are equal; scales of norms lie around 1.
    """
    base = 0.02 * jax.random.normal(jax.random.key(0), (65_521,))

    def fill(shape: tuple[int, ...], kind: Any, mean: float) -> jax.Array:
        n = int(np.prod(shape))
        times = -(-n // base.size)
        values = (base + mean).astype(kind)
        return jnp.broadcast_to(values[None], (times, base.size)).reshape(-1)[:n].reshape(shape)

    make = jax.jit(fill, static_argnums=(0, 1, 2))

    def leaf(path: str, shape: tuple[int, ...]) -> jax.Array:
        kind = jnp.float32 if cost.keeps_float32(path) else dtype
        return make(shape, kind, float(path.endswith(("/scale", "/gamma"))))

    return unflatten({path: leaf(path, spec.shape) for path, spec in flatten(specs).items()})


def initial_weights(specs: Tree) -> Tree:
    """The specs' own initial values, float32, and random ones where they are zero (the head's kernel, the prompt)."""
    drawn = {"kernel": fan_in(), "rows": normal(1.0)}
    flat = flatten(specs)
    for path, spec in flat.items():
        if spec.init is zeros and (other := drawn.get(path.rpartition("/")[2])):
            flat[path] = spec._replace(init=other)
    return init(jax.random.key(0), unflatten(flat))


def cameras(cfg: RoGeConfig, m: int, n: int) -> dict[str, jax.Array]:
    K = jnp.array([[cfg.width, 0, cfg.width / 2], [0, cfg.width, cfg.height / 2], [0, 0, 1.0]])
    c2w = jnp.tile(jnp.eye(4), (m + n, 1, 1)).at[:, 0, 3].set(jnp.arange(m + n) / (m + n))
    return {"K": jnp.tile(K, (m + n, 1, 1)), "c2w": c2w}


def photos(cfg: RoGeConfig, m: int) -> dict[str, jax.Array]:
    first, second, third = jax.random.split(jax.random.key(3), 3)
    return {
        "vectors": jax.random.normal(first, (m, 11)),
        "context_rgb": jax.random.uniform(second, (m, cfg.height, cfg.width, 3)),
        "context_recon": jax.random.uniform(third, (m, cfg.recon_height, cfg.recon_width, 3)),
    }


def random_condition(cfg: RoGeConfig, m: int) -> Condition:
    first, second = jax.random.split(jax.random.key(2))
    tokens = cost.tokens_per_slot(cfg) * cfg.slots(m)
    return Condition(
        jax.random.normal(first, (cfg.slots(m), *cfg.latent_size, 20)),
        jax.random.normal(second, (tokens, cfg.dit.width)),
    )


class Job(NamedTuple):
    """`call()` once does what is timed, and waits for it; `flops` of it; calls make `frames` results."""

    call: Callable[[], Any]
    flops: float
    compile_seconds: float
    frames: int = 1
    notes: dict[str, Any] | None = None


def compiled(function: Callable, *arguments, flops: float, frames: int = 1) -> Job:
    start = time.perf_counter()
    run = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    call = functools.partial(run, *arguments)
    return Job(lambda: jax.block_until_ready(call()), flops, seconds, frames, allocated(run))


def allocated(run: jax.stages.Compiled) -> dict[str, float]:
    """XLA's own analysis of a compiled program: arguments and temporary memory, GB."""
    used = run.memory_analysis()
    if used is None:  # not every backend has one
        return {}
    return {"xla_gb": (used.argument_size_in_bytes + used.temp_size_in_bytes) / 1e9}


def job(row: Row, dtype: Any) -> Job:
    """A row made ready: weights on the device, program compiled."""
    cfg, m, n = row.config, row.m, row.config.frames
    specs, (lh, lw), slots = model.specs(cfg), cfg.latent_size, cfg.slots(m)
    tokens = cost.tokens_per_slot(cfg) * slots
    size = (cfg.recon_height, cfg.recon_width)
    grid = encoder_grid(cfg.encoder, *size)
    views = cameras(cfg, m, n) | photos(cfg, m)
    noise = jax.random.normal(jax.random.key(1), (slots, lh, lw, 16))

    def pick(*names: str) -> Tree:
        return weights({k: specs[k] for k in names if k in specs}, dtype)

    if row.group == "dit":
        params = pick("dit", "prompt")
        text = jax.jit(functools.partial(model.text_cache, config=cfg))(params)
        cond = random_condition(cfg, m)
        forward = functools.partial(model.velocity, config=cfg, contexts=m, unroll=row.unroll)
        return compiled(
            lambda p, x, cond, text: forward(p, x, jnp.float32(0.5), cond, text=text),
            *(params, noise, cond, text), flops=cost.velocity(cfg.dit, tokens),
        )  # fmt: skip
    if row.group == "vggt":
        flops = cost.encoder(cfg.encoder, *size, m, cfg.renderer.width)
        run = functools.partial(model.reconstruct, config=cfg)
        return compiled(run, pick("encoder"), views, flops=flops)
    z = jax.random.normal(jax.random.key(1), (m, grid[0] * grid[1], cfg.renderer.width))
    if row.group == "rays":
        flops = cost.renderer(cfg.renderer, *size, m * grid[0] * grid[1], m, m + n)
        run = functools.partial(model.query_rays, config=cfg)
        return compiled(run, pick("renderer"), z, views, flops=flops)
    if row.group == "render":
        targets = {"K": views["K"][m:], "c2w": views["c2w"][m:]}

        def pictures(p, z, targets, views):
            features = model.query_rays(p, z, targets, config=cfg, context=views)
            return model.decode_rgb(p, features, targets, config=cfg, context=views)

        inputs = (pick("renderer"), z, targets, views)
        return compiled(pictures, *inputs, flops=render_flops(cfg, m), frames=n)
    if row.group == "vae":
        run = functools.partial(programs.decode, config=cfg, contexts=m)
        flops = cost.vae_decode(cfg.vae, n, cfg.height, cfg.width)
        return compiled(run, pick("vae"), noise, None, flops=flops)
    if row.group == "sample":
        return whole_video(cfg, m, pick(*specs), views, noise)
    assert row.group == "train", row.group
    return training_step(row, dtype)


def whole_video(cfg: RoGeConfig, m: int, params: Tree, views: model.Views, noise: jax.Array) -> Job:
    """As `python -m roge_jax.sample` does it: reconstruction, rays, encoding, 50 Euler steps, decoding."""
    start = time.perf_counter()
    run = programs.for_window(params, views, cfg, "noised")
    seconds = time.perf_counter() - start
    sigmas = flow.schedule("shift", 50, shift=cfg.flow.shift)

    def call():
        prepared = run.prepare(params, views)
        x = noise
        for _, _, state in solvers.iterate(
            "euler", lambda x, s: run.velocity(params, prepared, noise, x, s), noise, sigmas
        ):
            x = state
        return jax.block_until_ready((run.decode(params, x, prepared.detail), prepared.shown))

    return Job(call, cost.estimate(cfg, m, 50).total_flops, seconds)


def training_step(row: Row, dtype: Any) -> Job:
    """One LoRA step: loss, gradient, AdamW, state donated. With the row's policy, or else with the one that
    recomputes least of those that fit."""
    cfg, m = row.config, row.m
    hires = cfg.height > 192
    stage = stages.lora_stage(100, frames=cfg.frames, hires=hires)
    limit = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit", 64e9)
    needs: dict[str, float] = {}
    failed: list[str] = []
    for remat in (row.remat,) if row.remat else ("none", "dots", "attention", "full"):
        stage = dataclasses.replace(stage, remat=remat)
        found = estimate.estimate(
            cfg, stage, m=m, dtype=dtype, fused_attention=dtype == jnp.bfloat16
        )
        needs[remat] = found.bytes / 1e9
        if found.bytes > 1.1 * limit:  # the estimate may be too high: near misses are tried
            continue
        try:
            done = _step(cfg, stage, m, dtype, found)
            tried = {"failed": failed} if failed else {}
            return done._replace(notes=done.notes | {"planned_gb": needs} | tried)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            failed.append(remat)
    raise MemoryError(
        f"no policy fits {limit / 1e9:.0f} GB; planned GB: {needs}"
        + (f"; tried and failed: {', '.join(failed)}" if failed else "")
    )


def _step(
    cfg: RoGeConfig, stage: stages.Stage, m: int, dtype: Any, found: estimate.Estimate
) -> Job:
    start = time.perf_counter()
    specs, frozen_specs = stages.stage_specs(cfg, stage)
    step, shapes = estimate.abstract_step(cfg, stage, m, scenes=1, dtype=dtype)
    # Weights that a step does not read (the VAE's decoder) still lie on the device, and are planned for.
    run = jax.jit(step, donate_argnums=0, keep_unused=True).lower(*shapes).compile()
    seconds = time.perf_counter() - start
    frozen = weights(frozen_specs, dtype)
    optimiser = make_optimiser(stage.optim, specs, stage.steps)
    state = [initial_state(weights(specs, jnp.float32), optimiser, stage.optim)]
    batch = {n: jax.random.uniform(jax.random.key(3), x.shape) for n, x in shapes[2].items()}
    batch |= {k: v[None] for k, v in cameras(cfg, m, cfg.frames).items()}

    def call():
        state[0], metrics = run(state[0], frozen, batch, jax.random.key(2))
        return float(metrics["loss"])

    call()  # the first allocation of everything: whether it fits shows here
    return Job(call, found.flops, seconds, notes={"remat": stage.remat, **allocated(run)})


# ---- measuring -----------------------------------------------------------------------------------


def ours(row: Row, repeats: int, seconds: float, dtype: Any = None) -> dict[str, Any]:
    """The measured row: seconds, compile seconds, TFLOP/s, memory. `dtype` of large matrices: None is the device's."""
    if row.group == "numerics":
        return numerics(row)
    if dtype is None:
        dtype = jnp.bfloat16 if jax.default_backend() == "gpu" else jnp.float32
    work = job(row, dtype)
    found = measure(work.call, repeats, seconds)
    found["seconds"] /= work.frames
    found["quartiles"] = [x / work.frames for x in found["quartiles"]]
    notes = work.notes or {}
    found |= {"flops": work.flops / work.frames, "compile_seconds": work.compile_seconds} | notes
    found["tflops"] = found["flops"] / found["seconds"] / 1e12
    stats = jax.local_devices()[0].memory_stats() or {}
    # Of this process, which ran nothing else; what a policy that did not fit has taken would hide the one that did.
    if "peak_bytes_in_use" in stats and not notes.get("failed"):
        found["peak_gb"] = stats["peak_bytes_in_use"] / 1e9
    return found


def numerics(row: Row) -> dict[str, Any]:
    """Relative L2 difference of the fast path (bfloat16 matrices, fused attention) from float32 throughout.

    On the specs' own initial values: scales of norms are 1, so that the softmax of attention is far from uniform.
    """
    cfg, m = row.config, row.m
    noise = jax.random.normal(jax.random.key(1), (cfg.slots(m), *cfg.latent_size, 16))
    views, cond = cameras(cfg, m, cfg.frames) | photos(cfg, m), random_condition(cfg, m)
    grid = encoder_grid(cfg.encoder, cfg.recon_height, cfg.recon_width)
    z = jax.random.normal(jax.random.key(4), (m, grid[0] * grid[1], cfg.renderer.width))
    velocity = functools.partial(model.velocity, config=cfg, contexts=m)
    names, run, inputs = {
        "dit": (("dit", "prompt"), velocity, (noise, jnp.float32(0.5), cond)),
        "encoder": (("encoder",), functools.partial(model.reconstruct, config=cfg), (views,)),
        "rays": (("renderer",), functools.partial(model.query_rays, config=cfg), (z, views)),
    }[row.part]
    whole = flatten(initial_weights({k: s for k, s in model.specs(cfg).items() if k in names}))
    results = []
    for dtype in (jnp.float32, jnp.bfloat16):
        kept = {p: x if cost.keeps_float32(p) else x.astype(dtype) for p, x in whole.items()}
        with jax.default_matmul_precision("highest" if dtype == jnp.float32 else "default"):
            out = jax.jit(run)(unflatten(kept), *inputs)
        results.append(np.asarray(out, np.float64))
    exact, fast = results
    return {"relative_error": float(np.linalg.norm(fast - exact) / np.linalg.norm(exact))}


def render_flops(cfg: RoGeConfig, m: int) -> float:
    """Of the pictures of all targets: ray features, RGB head and, where there is one, the look-up in m photos."""
    size = (cfg.recon_height, cfg.recon_width)
    per_view = cost.renderer_view(cfg.renderer, *size, cost.scene_tokens_read(cfg, m))
    return cfg.frames * per_view + cost.lookup(cfg.renderer, *size, m, cfg.frames)


def forward_flops(row: Row) -> float:
    """Of the transformer, for the peer."""
    tokens = cost.tokens_per_slot(row.config) * row.config.slots(row.m)
    return cost.velocity(row.config.dit, tokens)


def run(name: str, side: str, repeats: int, seconds: float) -> dict[str, Any]:
    """One side of one row, in this process."""
    row = rows()[name]
    try:
        if side == "ours":
            found = ours(row, repeats, seconds)
        else:
            from experiments.speed import peer

            found = peer.run(row, repeats, seconds)
        found = {"status": "measured"} | found
    except MemoryError as error:
        found = {"status": "out of memory", "why": str(error)}
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        found = {"status": "out of memory", "why": str(error).splitlines()[0][:300]}
    return found | where_and_when()
