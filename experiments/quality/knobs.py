"""The trained model along its other knobs, and its peers along theirs; every point with the default sampler.

Each function returns records {"knob", "value", "method", "metrics", ...}; see `mini.py`.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from experiments.quality.measures import Judge, difference, summary
from experiments.quality.scenes import (
    CONTEXTS,
    DEFAULT_M,
    Sampler,
    Scenes,
    assemble,
    photos,
    preparer,
    timed,
)
from roge_jax import config as configs
from roge_jax import cost, fusion, model, preview
from roge_jax.config import RoGeConfig
from roge_jax.core.params import flatten, unflatten
from roge_jax.metrics import baselines
from roge_jax.procedural.scenes import sample_sequence
from roge_jax.video import dit, flow

Record = dict[str, Any]
PHOTOS = tuple(range(1, CONTEXTS + 1))
SIZES = ((48, 80), (64, 112), (96, 160))
PEER_STEPS = (1, 2, 4, 6, 8, 12, 20, 50)


def default_run(sampler: Sampler):
    own = sampler.config.flow
    return sampler.timed(own.solver, sampler.grid(own.schedule, own.steps, own.solver))


def sampled(params, config: RoGeConfig, scenes: Scenes) -> tuple[Record, dict[str, list[float]]]:
    """Scores and times of the default sampler on a batch."""
    judge = Judge(params, config, scenes)
    run = default_run(Sampler(params, scenes, config))
    scores = judge.scores(judge.frames(run.latents))
    return {"seconds": run.seconds, "evaluations": run.evaluations}, scores


def generation_only(scenes: Scenes, config: RoGeConfig) -> Scenes:
    """The same photos and noise, with neither rays nor ray features: `fusion.unconditioned`."""
    make = functools.partial(fusion.unconditioned, slots=config.slots(scenes.m), config=config)
    bare = jax.vmap(make)(scenes.prepared.context_latents)
    return scenes._replace(prepared=scenes.prepared._replace(condition=bare, detail=None))


def over_photos(
    params, config: RoGeConfig, sequences, known: dict[int, Scenes], peer
) -> list[Record]:
    """M = 1 .. 6: the model, the generation-only model (parameters `peer`), the RGB head and the baselines, on the same
    targets.
    """
    records = []
    for m in PHOTOS:
        prepare = preparer(config)
        scenes = known.get(m) or assemble(params, sequences, config, m)
        one = {name: value[0] for name, value in scenes.views.items()}
        _, prepare_seconds = timed(functools.partial(prepare, params, one))
        judge = Judge(params, config, scenes)
        for method, weights, batch in (
            ("generated", params, scenes),
            ("generation only", peer, generation_only(scenes, config)),
        ):
            more, scores = sampled(weights, config, batch)
            records.append(record("M", m, method, scores, prepare_seconds=prepare_seconds, **more))
        heads = np.asarray(scenes.prepared.shown)
        records.append(record("M", m, "RGB head", judge.scores(heads)))
        for method, frames in simple(scenes).items():
            records.append(record("M", m, method, judge.scores(frames)))
        print("M", m, f"{records[-6]['metrics']['psnr']['mean']:.2f} dB", flush=True)
    return records


def simple(scenes: Scenes) -> dict[str, np.ndarray]:
    """Baselines [s, n, h, w, 3]: nearest photo, mean photo, plane at the target's true median depth."""
    found: dict[str, list] = {"nearest photo": [], "mean photo": [], "plane": []}
    size = scenes.truth.shape[2:4]
    for rgb, K, c2w, depth in zip(scenes.views["context_rgb"], scenes.K, scenes.c2w, scenes.depth):
        m = len(rgb)
        middle = [float(np.median(d)) for d in depth]
        targets = list(zip(K[m:], c2w[m:], middle))
        found["nearest photo"].append(
            [baselines.nearest(rgb, c2w[:m], pose, d) for _, pose, d in targets]
        )
        found["mean photo"].append([baselines.mean_context(rgb)] * len(targets))
        found["plane"].append(
            [baselines.plane(rgb, K[:m], c2w[:m], k, pose, size, d) for k, pose, d in targets]
        )
    return {name: np.asarray(frames, np.float32) for name, frames in found.items()}


def over_steps(peer, config: RoGeConfig, scenes: Scenes) -> list[Record]:
    """The generation-only model along the number of steps."""
    bare = generation_only(scenes, config)
    sampler, judge = Sampler(peer, bare, config), Judge(peer, config, bare)
    records, own = [], config.flow
    for steps in PEER_STEPS:
        schedule = own.schedule if own.schedule != "optimised" or steps == own.steps else "uniform"
        run = sampler.timed(own.solver, sampler.grid(schedule, steps, own.solver))
        scores = judge.scores(judge.frames(run.latents))
        more = {"seconds": run.seconds, "evaluations": run.evaluations, "schedule": schedule}
        records.append(record("steps", steps, "generation only", scores, **more))
    return records


def over_sizes(params, config: RoGeConfig, seeds) -> list[Record]:
    """Photos and frames smaller or larger than in training; all judged at the training size.

    Scenes are rendered once at twice the size and averaged down, cameras with them.
    """
    h, w = config.height, config.width
    large = {"height": 2 * h, "width": 2 * w, "frames": config.frames + CONTEXTS}
    sharp = [sample_sequence(int(seed), **large) for seed in seeds]
    at_size = [_resized(s, h, w) for s in sharp]
    truth = assemble_truth(at_size, config)
    records = []
    for height, width in SIZES:
        other = dataclasses.replace(
            config, height=height, width=width, recon_height=height, recon_width=width
        )
        scenes = assemble(params, [_resized(s, height, width) for s in sharp], other)
        run = default_run(Sampler(params, scenes, other))
        frames = Judge(params, other, scenes).frames(run.latents)
        shown = np.stack([[_to(frame, h, w) for frame in video] for video in frames])
        scores = Judge(params, config, truth).scores(np.clip(shown, 0.0, 1.0))
        more = {"seconds": run.seconds, "evaluations": run.evaluations}
        records.append(record("resolution", f"{height}x{width}", "generated", scores, **more))
    return records


def assemble_truth(sequences, config: RoGeConfig) -> Scenes:
    """Only what `Judge` needs."""
    context, target = photos(config.frames, DEFAULT_M)
    order = context + target
    return Scenes(
        None,
        None,
        {"context_rgb": np.stack([s["rgb"][context] for s in sequences])},
        np.stack([s["rgb"][target] for s in sequences]).astype(np.float32) / 255.0,
        np.stack([s["depth"][target] for s in sequences]),
        np.stack([s["K"][order] for s in sequences]),
        np.stack([s["c2w"][order] for s in sequences]),
    )


def _to(image: np.ndarray, h: int, w: int) -> np.ndarray:
    smaller = image.shape[0] >= h
    how = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    return cv2.resize(image, (w, h), interpolation=how)


def _resized(sequence: dict[str, np.ndarray], h: int, w: int) -> dict[str, np.ndarray]:
    rows, columns = sequence["rgb"].shape[1:3]
    scale = np.array([w / columns, h / rows, 1.0])
    depth = [cv2.resize(d, (w, h), interpolation=cv2.INTER_NEAREST) for d in sequence["depth"]]
    return {
        "rgb": np.stack([_to(frame, h, w) for frame in sequence["rgb"]]),
        "depth": np.stack(depth),
        "K": sequence["K"] * scale[None, :, None],
        "c2w": sequence["c2w"],
    }


def in_bfloat16(params, config: RoGeConfig, scenes: Scenes, exact) -> list[Record]:
    """Large matrices in bfloat16, as `--dtype bfloat16` loads them; conditions are computed anew."""
    flat = {
        path: leaf if cost.keeps_float32(path) else leaf.astype(jnp.bfloat16)
        for path, leaf in flatten(params).items()
    }
    half = unflatten(flat)
    each = [
        preparer(config)(half, {k: v[i] for k, v in scenes.views.items()})
        for i in range(len(scenes.truth))
    ]
    batch = scenes._replace(prepared=jax.tree.map(lambda *x: jnp.stack(x), *each))
    more, scores = sampled(half, config, batch)
    return [
        record("numbers", "float32", "generated", exact["scores"], **exact["more"]),
        record(
            "numbers",
            "bfloat16",
            "generated",
            scores,
            psnr_to_exact=difference(scores["psnr"], exact["scores"]["psnr"]),
            **more,
        ),
    ]


def with_block_cache(sampler: Sampler, judge: Judge, exact) -> Iterator[Record]:
    """Every second evaluation computes the first and the last block only, and adds the others' last change again.

    The approximation of step caches (the network's middle changes slowly along the path). What sampling itself keeps
    between evaluations, scene tokens, ray features, photo latents and prompt, loses nothing: no noise level enters it.
    """
    params, config, scenes = sampler.params, sampler.config, sampler.scenes
    cfg = config.dit

    def field(params, prepared, noise, x, sigma, change, *, fresh):
        def one(prepared, noise, x, change):
            latents, cond = prepared.context_latents, prepared.condition
            m = latents.shape[0]
            x = flow.context_projection(latents, noise, "noised")(x, sigma)
            t, lh, lw, _ = x.shape
            rows, columns = lh // cfg.patch, lw // cfg.patch
            angles = jnp.asarray(
                dit.rope_angles(fusion.time_index(m, t), rows, columns, cfg.width // cfg.heads)
            )
            p = params["dit"]
            tokens = dit.patch_embed(p, jnp.concatenate([x, cond.appearance], -1)) + cond.tokens
            e, e0 = dit.time_embed(p, 1000.0 * sigma)

            def blocks(tokens, some):
                part = p | {"blocks": jax.tree.map(lambda leaf: leaf[some], p["blocks"])}
                return dit.dit_blocks(part, tokens, e0, angles, cfg=cfg)

            first = blocks(tokens, slice(0, 1))
            if fresh:
                change = blocks(first, slice(1, -1)) - first
            last = blocks(first + change, slice(-1, None))
            output = dit.head(p, last, e, grid=(t, rows, columns), patch=cfg.patch)
            return preview.velocity(output, x, sigma, cond, m), change

        return jax.vmap(one)(prepared, noise, x, change)

    fields = {fresh: jax.jit(functools.partial(field, fresh=fresh)) for fresh in (True, False)}
    own = config.flow

    def start():
        kept = {"calls": 0, "change": scenes.prepared.condition.tokens}

        def velocity(x, sigma):
            fresh = kept["calls"] % 2 == 0
            kept["calls"] += 1
            sigma = jnp.asarray(sigma, jnp.float32)
            arguments = (params, scenes.prepared, scenes.noise, x, sigma, kept["change"])
            v, kept["change"] = fields[fresh](*arguments)
            return v

        return velocity

    for solver, schedule, steps in (
        ("euler", "uniform", 50),
        (own.solver, own.schedule, own.steps),
    ):
        grid = sampler.grid(schedule, steps, solver)
        full, run = sampler.timed(solver, grid), sampler.timed(solver, grid, start)
        for name, one in (("exact", full), ("cached", run)):
            frames = judge.frames(one.latents)
            close = judge.against(one.latents, frames, exact["reference"], exact["frames"])
            yield record(
                "cache",
                f"{solver} {schedule} {steps}, {name}",
                "generated",
                judge.scores(frames) | close,
                seconds=one.seconds,
                evaluations=one.evaluations,
            )


def refinement(views: int = 12) -> list[Record]:
    """Shared against exact scene-token refinement. `mini` has none (`cross`): random weights of a bidirectional toy."""
    base = configs.preset("tiny")
    records = []
    exact = None
    for kind in ("per_view", "shared"):
        renderer = dataclasses.replace(
            base.renderer, width=128, heads=4, depth=6, refinement=kind, chunk=32
        )
        config = dataclasses.replace(base, renderer=renderer, frames=9)
        params = model.init(jax.random.key(0), config)
        rng = np.random.default_rng(0)
        m = 3
        angle = np.linspace(-0.3, 0.3, views)
        c2w = np.tile(np.eye(4), (views, 1, 1))
        c2w[:, 0, 0] = c2w[:, 2, 2] = np.cos(angle)
        c2w[:, 0, 2], c2w[:, 2, 0] = np.sin(angle), -np.sin(angle)
        c2w[:, 0, 3] = -np.sin(angle)
        K = np.tile(
            np.array([[40.0, 0, config.width / 2], [0, 40.0, config.height / 2], [0, 0, 1]]),
            (views, 1, 1),
        )
        seen = {
            "context_rgb": rng.uniform(size=(m, config.height, config.width, 3)),
            "K": K,
            "c2w": c2w,
            "vectors": rng.normal(size=(m, 11)),
        }
        seen = {name: jnp.asarray(value, jnp.float32) for name, value in seen.items()}
        tokens = model.reconstruct(params, seen, config=config)
        query = jax.jit(functools.partial(model.query_rays, config=config))
        features, seconds = timed(functools.partial(query, params, tokens, seen))
        exact = features if exact is None else exact
        gap = float(jnp.linalg.norm(features - exact) / jnp.linalg.norm(exact))
        records.append(
            {
                "knob": "refinement",
                "value": kind,
                "method": f"random bidirectional toy, {m} photos, {views} views",
                "seconds": seconds,
                "relative_difference_of_features": gap,
            }
        )
    return records


def record(knob: str, value: Any, method: str, scores: dict[str, list[float]], **more) -> Record:
    return {"knob": knob, "value": value, "method": method, "metrics": summary(scores), **more}


def round_trip(params, config: RoGeConfig, scenes: Scenes, judge: Judge) -> Record:
    """The truth through the VAE and back: what no sampler can beat."""
    encode = jax.jit(functools.partial(model.encode_targets, config=config))
    latents = jnp.stack([encode(params, truth) for truth in scenes.truth])
    return record(
        "ceiling", "VAE round trip", "truth", judge.scores(judge.frames(latents, generated=False))
    )
