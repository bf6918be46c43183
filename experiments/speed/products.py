"""What `train --products bfloat16` is worth on a CPU: seconds of a generator step, and how well it learns, beside float32.

    taskset -c 0 python -m experiments.speed.products          results/products.json; about 20 minutes on one quiet core

The video transformer of the shipped `mini` from new weights, on samples encoded once (`--encode-once`), 3 photos and 17 frames.
Runs of both dtypes and of several seeds take their steps in turn, so that every step is timed beside the others; the
steps are smaller than the stage's own (`--batch`, `--draws`). Processor seconds, medians with quartiles. Held-out losses
are computed in float32 for all. Differences count against those of float32 between its seeds.
"""

import dataclasses
import functools

import numpy as np

from experiments import harness

HELD = 8  # samples, with as many noise levels each
DTYPES = ("float32", "bfloat16")


def measure(steps: int, every: int, seeds: int, samples: int, batch: int, draws: int) -> dict:
    import jax

    from roge_jax import model
    from roge_jax.checkpoint import load_model
    from roge_jax.core import products
    from roge_jax.core.params import count
    from roge_jax.data.source import ProceduralSource
    from roge_jax.training import encoded, loop, stages
    from roge_jax.training.optim import make_optimiser

    if not products.cpu_units():
        raise SystemExit(f"this CPU has none of {', '.join(products.UNITS)}: nothing to compare")
    params, config = load_model("mini")
    stage = stages.find_stage(stages.mini_stages(frames=config.frames), "generator")
    views = dataclasses.replace(stage.views, contexts=(3,), context_weights=(1.0,))
    stage = dataclasses.replace(stage, views=views, steps=steps, batch=batch, draws=draws)
    stage = stages.once_encoded(stage, config, samples)
    source = ProceduralSource(config.height, config.width, frames=config.frames + 7)
    encode = jax.jit(functools.partial(encoded.encode, params, config=config))

    def clips(seed: int, count: int) -> list[dict]:
        one = dataclasses.replace(stage, batch=1)
        drawn = (stages.stage_batch(source, one, config, seed, i) for i in range(count))
        return [encoded.each(encode, sample) for sample in drawn]

    def joined(found: list[dict]) -> dict:
        return {name: np.concatenate([clip[name] for clip in found]) for name in found[0]}

    pool, held = clips(0, samples), joined(clips(1, HELD))
    specs, _ = stages.stage_specs(config, stage)
    _, frozen = model.split(params, stage.trains)
    frozen = stages.read(frozen, stage)
    optimiser = make_optimiser(stage.optim, specs, steps)
    levels = dataclasses.replace(stage, draws=HELD)
    evaluate = jax.jit(stages.objective_of(config, levels))
    runs = {}
    for seed in range(seeds):
        fresh, _ = model.split(model.init(jax.random.key(seed), config), stage.trains)
        for dtype in DTYPES:
            runs[dtype, seed] = loop.initial_state(fresh, optimiser, stage.optim)
    step = {}
    for dtype in DTYPES:
        objective = stages.objective_of(config, dataclasses.replace(stage, products=dtype))
        step[dtype] = jax.jit(loop.make_step(objective, optimiser, stage.optim))
    seconds: dict = {dtype: [] for dtype in DTYPES}
    losses: dict = {f"{dtype}, seed {seed}": [] for dtype, seed in runs}
    for i in range(steps):
        for dtype, seed in sorted(runs, reverse=i % 2 == 0):
            chosen = np.random.default_rng([seed, i]).choice(samples, batch, replace=False)
            data = joined([pool[j] for j in chosen])
            key = jax.random.fold_in(jax.random.key(seed), i)
            arguments = runs[dtype, seed], frozen, data, key
            found = {}

            def call(step=step[dtype], arguments=arguments, found=found):
                found["state"], metrics = step(*arguments)
                return metrics

            took = harness.timed(call)
            runs[dtype, seed] = found["state"]
            if i:  # the first compiles
                seconds[dtype].append(took.cpu)
        if (i + 1) % every == 0:
            for (dtype, seed), state in runs.items():
                weights = state.get("ema", state["params"])
                loss, _ = evaluate(weights, frozen, held, jax.random.key(0))
                losses[f"{dtype}, seed {seed}"].append([i + 1, float(loss)])
            print(i + 1, {name: round(rows[-1][1], 5) for name, rows in losses.items()}, flush=True)
            print({k: harness.quartiles(v, 3) for k, v in seconds.items()}, flush=True)
    ratios = np.array(seconds["bfloat16"]) / np.array(seconds["float32"])
    return {
        "environment": harness.environment(),
        "batch": [batch, draws],
        "samples": samples,
        "trained": count(specs),
        "cpu_s": {dtype: harness.quartiles(x, 3) for dtype, x in seconds.items()},
        "ratio": harness.quartiles(ratios, 3),
        "held_loss": losses,
    }


def main() -> None:
    p = harness.parser(__doc__)
    for name, default in (("steps", 150), ("every", 50), ("seeds", 2), ("samples", 32)):
        p.add_argument(f"--{name}", type=int, default=default)
    p.add_argument("--batch", type=int, default=2)
    p.add_argument("--draws", type=int, default=4)
    found = measure(**vars(p.parse_args()))
    harness.write("products.json", found)
    for dtype, (low, middle, high) in found["cpu_s"].items():
        print(f"{dtype:10s} {middle:.3f} s ({low:.3f} to {high:.3f})")
    print(f"bfloat16 / float32 {found['ratio'][1]:.3f}, {found['held_loss']}")


if __name__ == "__main__":
    main()
