"""What `train --encode-once` saves: a step of the stage `generator` on new samples and on encoded ones, in turn.

    taskset -c 0 python -m experiments.speed.encoded          results/encoded_speed.json; about 6 minutes

Shipped weights, 17 frames, the stage's own batch and noise levels, `--photos` photos; drawing and reading samples is not in
the steps. Processor seconds of loss, gradient and optimiser, medians with lowest and highest; beside them those of encoding one
sample, and what it takes on the disk.
"""

import functools

import numpy as np

from experiments import harness


def measure(photos: int, repeats: int) -> dict:
    import jax

    from roge_jax import model
    from roge_jax.checkpoint import load_model
    from roge_jax.data.source import ProceduralSource
    from roge_jax.training import encoded, loop, stages
    from roge_jax.training.optim import make_optimiser

    params, config = load_model("mini")
    new = stages.find_stage(stages.mini_stages(frames=config.frames), "generator")
    source = ProceduralSource(config.height, config.width, frames=config.frames + 7)
    draw = functools.partial(stages.stage_batch, source, new, config, 0)
    batch = next(b for i in range(1000) if (b := draw(i))["context_rgb"].shape[1] == photos)
    encode = jax.jit(functools.partial(encoded.encode, config=config))
    one = functools.partial(encode, params, {name: x[0] for name, x in batch.items()})
    clip = one()
    stored = stages.once_encoded(new, config, new.batch)
    batches = {
        "new samples": batch,
        "encoded": encoded.each(functools.partial(encode, params), batch),
    }
    steps = {}
    for (name, data), stage in zip(batches.items(), (new, stored), strict=True):
        trainable, frozen = model.split(params, stage.trains)
        optimiser = make_optimiser(stage.optim, stages.stage_specs(config, stage)[0], stage.steps)
        objective = functools.partial(
            stages.OBJECTIVES[stage.objective], config=config, stage=stage
        )
        step = jax.jit(loop.make_step(objective, optimiser, stage.optim))
        state = loop.initial_state(trainable, optimiser, stage.optim)
        arguments = state, stages.read(frozen, stage), data, jax.random.key(0)
        steps[name] = functools.partial(step.lower(*arguments).compile(), *arguments)
        jax.block_until_ready(steps[name]())
    seconds = harness.in_turn({**steps, "encoding one sample": one}, repeats).cpu
    cpu = {name: harness.summary(values) for name, values in seconds.items()}
    return {
        "environment": harness.environment(),
        "batch": [new.batch, new.draws],
        "photos": photos,
        "repeats": repeats,
        "cpu_s": cpu,
        "ratio": cpu["encoded"]["median"] / cpu["new samples"]["median"],
        "bytes_of_a_sample": sum(np.asarray(x).nbytes for x in clip.values()),
    }


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--photos", type=int, default=3)
    p.add_argument("--repeats", type=int, default=3)
    args = p.parse_args()
    found = measure(args.photos, args.repeats)
    harness.write("encoded_speed.json", found)
    for name, value in found["cpu_s"].items():
        print(f"{name:20s} {value['median']:8.2f} s ({value['low']:.2f} to {value['high']:.2f})")
    print(f"encoded / new {found['ratio']:.2f}, {found['bytes_of_a_sample'] / 1e6:.2f} MB a sample")


if __name__ == "__main__":
    main()
