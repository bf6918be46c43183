"""Long videos, long sequences and large files at reduced width: what grows, and what does not.

    python -m experiments.quality.long_sequences            a few minutes on one core, each part in a process of its own

forward   480x832, M = 9, N = 81: prepare's shapes and one evaluation of a narrow transformer on all 46,800 tokens
chain     chained paths of 25, 100 and 305 frames (5, 20 and 61 windows), `tiny` preset, random weights, one step each:
          compilations, bytes of live device arrays and resident memory after every window
load      a random model of 1.41 GB on disk: memory while it is loaded whole, and into shares on four devices
train     the same in bfloat16: memory of a training program that takes one step, of a stage that reads the whole model
          and of one that reads the reconstruction alone; beside that of `tiny` itself, which is compiled as long

Writes experiments/results/long_sequences.json.
"""

import argparse
import contextlib
import dataclasses
import json
import os
import resource
import tempfile
import time
from pathlib import Path

from experiments import harness


def resident() -> float:
    """Bytes of this process in memory now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def peak() -> float:
    """The most this program had in memory. (`ru_maxrss` would start from that of the process that started it.)"""
    status = Path("/proc/self/status").read_text().splitlines()
    return 1024.0 * int(next(line for line in status if line.startswith("VmHWM")).split()[1])


def random_weights(specs):
    import numpy as np

    from roge_jax.core.params import flatten, unflatten

    rng = np.random.default_rng(0)
    flat = {
        path: (path.endswith("scale") + 0.05 * rng.standard_normal(s.shape, np.float32))
        for path, s in flatten(specs).items()
    }
    return unflatten(flat)


def cameras(n: int, cfg, step: float):
    import numpy as np

    from roge_jax.geometry.cameras import Cameras

    K = np.array([[cfg.width, 0, cfg.width / 2], [0, cfg.width, cfg.height / 2], [0, 0, 1.0]])
    c2w = np.tile(np.eye(4), (n, 1, 1))
    c2w[:, 0, 3] = step * np.arange(n)
    return Cameras(np.tile(K, (n, 1, 1)), c2w)


def forward() -> dict:
    import jax
    import jax.numpy as jnp
    import numpy as np

    from roge_jax import config, cost, model
    from roge_jax.fusion import Condition

    tiny, paper = config.preset("tiny"), config.preset("paper")
    cfg = dataclasses.replace(
        paper, height=480, width=832, dit=dataclasses.replace(tiny.dit, depth=1), vae=tiny.vae
    )
    m, tokens = 9, cost.tokens_per_slot(cfg) * cfg.slots(9)
    specs = {k: v for k, v in model.specs(cfg).items() if k in ("dit", "prompt")}
    shape = (cfg.slots(m), *cfg.latent_size)
    cond = Condition(jnp.zeros((*shape, 20)), jnp.zeros((tokens, cfg.dit.width)))
    x = jax.random.normal(jax.random.key(0), (*shape, 16))
    run = jax.jit(lambda p, x, cond: model.velocity(p, x, 0.5, cond, config=cfg, contexts=m))
    compiled = run.lower(random_weights(specs), x, cond).compile()
    start = time.process_time()
    out = np.asarray(compiled(random_weights(specs), x, cond))
    scores = 4.0 * tokens**2 * cfg.dit.heads
    return {
        "tokens": tokens,
        "finite": bool(np.isfinite(out).all()),
        "cpu_seconds": time.process_time() - start,
        "bytes_of_all_scores": scores,
        "xla_temporary_bytes": compiled.memory_analysis().temp_size_in_bytes,
        "peak_resident_bytes": peak(),
    }


def chain() -> dict:
    import jax
    import jax.numpy as jnp
    import numpy as np

    from roge_jax import config, model, sampling

    cfg = config.preset("tiny")
    params = jax.tree.map(jnp.asarray, random_weights(model.specs(cfg)))
    images = np.random.default_rng(0).random((3, cfg.height, cfg.width, 3), np.float32)
    photos = sampling.Photos(images, None, cameras(3, cfg, 1.0), (0, 1, 2))
    compiled: list = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
    )
    found = {}
    for windows in (5, 20, 61):
        seen: list = []

        @contextlib.contextmanager
        def stage(name, seen=seen):
            if name == "prepare":
                live = sum(x.nbytes for x in jax.live_arrays())
                seen.append((len(compiled), live, resident()))
            yield

        frames = windows * cfg.frames
        result = sampling.sample(
            params, cfg, photos, cameras(frames, cfg, 0.01),
            sampling.Settings(steps=1, solver="euler"), stage=stage,
        )  # fmt: skip
        assert len(result.frames) == frames
        found[str(windows)] = {
            "frames": frames,
            "compilations_after_window": [s[0] - seen[0][0] for s in seen],
            "live_bytes_after_window": [s[1] for s in seen],
            "resident_bytes_after_window": [s[2] for s in seen],
            "bytes_of_the_result": result.frames.nbytes + result.preview.nbytes,
        }
    return found


def wide():
    """`tiny` with a transformer of 0.35e9 parameters."""
    from roge_jax import config

    tiny = config.preset("tiny")
    transformer = dataclasses.replace(tiny.dit, width=1024, heads=16, depth=20, ffn=4096)
    return dataclasses.replace(tiny, dit=transformer)


def load(kind: str = "") -> dict:
    """Without `kind`: writes the file and starts a process for each way of loading it."""
    import jax

    from roge_jax import checkpoint, model
    from roge_jax.core import sharding
    from roge_jax.core.params import abstract, flatten

    if not kind:
        cfg = wide()
        sizes = [4 * x.size for x in jax.tree.leaves(abstract(model.specs(cfg)))]
        found = {"bytes": sum(sizes), "largest_leaf": max(sizes), "leaves": len(sizes)}
        with tempfile.TemporaryDirectory() as folder:
            checkpoint.save_model(
                Path(folder) / "m", random_weights(model.specs(cfg)), cfg, dtype=jax.numpy.float32
            )
            for way in ("whole", "shares"):
                found[way] = child("load", f"{way}:{folder}/m", devices=4)
        return found
    way, _, folder = kind.partition(":")
    where = None
    if way == "shares":
        specs = model.specs(checkpoint.load_config(Path(folder)))
        where = sharding.shardings(specs, sharding.make_mesh(1, 4, 1))
    jax.numpy.zeros(3).block_until_ready()
    before, start = resident(), time.perf_counter()
    params, _ = checkpoint.load_model(folder, dtype=None, shardings=where)
    jax.block_until_ready(params)
    return {
        "arrays": sum(x.nbytes for x in flatten(params).values()),
        "peak_above_start": peak() - before,
        "seconds": time.perf_counter() - start,
    }


def train(kind: str = "") -> dict:
    """Without `kind`: writes the models and starts a process for each stage of each."""
    from roge_jax import checkpoint, config, model
    from roge_jax import train as program
    from roge_jax.training import loop

    begin, found = loop.train, {}

    def watched(*arguments, **options):
        found["peak_before_the_first_step"] = peak()
        return begin(*arguments, **options)

    if kind:
        loop.train = watched
        stage, _, folder = kind.partition(":")
        words = ["tiny", "--stage", stage, "--steps", "1", "--batch", "1", "--devices", "1"]
        words += ["--frozen-dtype", "bfloat16", "--init", folder, "--out", f"{folder}-{stage}"]
        program.main(program.parser().parse_args(words))
        return found | {"peak": peak()}
    with tempfile.TemporaryDirectory() as folder:
        for name, cfg in (("tiny", config.preset("tiny")), ("wide", wide())):
            weights = random_weights(model.specs(cfg))
            checkpoint.save_model(Path(folder) / name, weights, cfg)
            del weights
            for stage in ("lora", "recon_low"):
                found[f"{name}, {stage}"] = child("train", f"{stage}:{folder}/{name}")
    return found


def child(part: str, kind: str = "", devices: int = 1) -> dict:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    words = ["--part", part, "--kind", kind, "--child"]
    return harness.child("experiments.quality.long_sequences", *words, XLA_FLAGS=flags)


PARTS = {"forward": forward, "chain": chain, "load": load, "train": train}


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--part", choices=PARTS, help="one part only")
    p.add_argument("--kind", default="", help=argparse.SUPPRESS)
    p.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = p.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    if args.child:
        return print(json.dumps(PARTS[args.part](*[args.kind] * bool(args.kind))))
    for part in (args.part,) if args.part else PARTS:
        found = child(part)
        print(part, json.dumps(found)[:2000], flush=True)
        record = harness.read("long_sequences.json", absent={})
        record[part] = found | {"environment": harness.environment()}
        harness.write("long_sequences.json", record)


if __name__ == "__main__":
    main()
