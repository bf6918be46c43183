"""What it gains to give every core of a CPU scenes of its own: `train --devices N --batch N` beside one device.

    python -m experiments.speed.cpu_devices                      # writes experiments/results/cpu_devices.json
    python -m experiments.speed.cpu_devices --devices 2 --size 96x160 --repeats 3

The end-to-end step (stage `joint` of the shipped model, 3 photos, 17 frames, 6 noise levels) on N scenes: one device that
goes through them one after the other with all cores, and N devices with one scene each. Both in one process, in turn; wall and
processor seconds, medians with lowest and highest. About 5 minutes on 4 cores, most of it compiling.
"""

import dataclasses
import functools
import os

from experiments import harness
from experiments.harness import summary


def measure(devices: int, size: str | None, repeats: int, seed: int) -> dict:
    import jax
    import jax.numpy as jnp

    from roge_jax import model
    from roge_jax.checkpoint import load_model
    from roge_jax.core import sharding
    from roge_jax.core.distributed import global_batch
    from roge_jax.data.source import ProceduralSource
    from roge_jax.training import loop, stages, start
    from roge_jax.training.optim import make_optimiser

    params, config = load_model("mini")
    if size:
        config = start.resize(config, size, hires=False)
    stage = stages.find_stage(stages.mini_stages(frames=config.frames), "joint")
    views = dataclasses.replace(
        stage.views, contexts=(3,), context_weights=(1.0,), size=(config.height, config.width)
    )
    stage = dataclasses.replace(stage, views=views, batch=devices)
    source = ProceduralSource(config.height, config.width, frames=max(24, config.frames + 3))
    batch = stages.stage_batch(source, stage, config, seed, 0)
    specs, frozen_specs = stages.stage_specs(config, stage)
    trainable, frozen = model.split(params, stage.trains)
    optimiser = make_optimiser(stage.optim, specs, 100)
    objective = functools.partial(stages.joint_objective, config=config, stage=stage)

    def runner(mesh):
        state = loop.initial_state(jax.tree.map(jnp.array, trainable), optimiser, stage.optim)
        kept, scenes = frozen, batch
        if mesh is not None:
            state = sharding.place(state, sharding.state_shardings(state, specs, mesh))
            kept = sharding.place(kept, sharding.shardings(frozen_specs, mesh))
            scenes = global_batch(batch, mesh, devices)
        # A function of its own: traces do not see the mesh (`sharding.use`).
        step = jax.jit(lambda *given: loop.make_step(objective, optimiser, stage.optim)(*given))

        def run() -> float:
            with sharding.use(mesh):
                return float(step(state, kept, scenes, jax.random.key(seed))[1]["loss"])

        return run

    mesh = sharding.make_mesh(devices=jax.devices()[:devices])
    runs = {"one device": runner(None), f"{devices} devices": runner(mesh)}
    losses = {name: run() for name, run in runs.items()}  # compiles
    seconds = harness.in_turn(runs, repeats)
    one, many = seconds.wall.values()
    return {
        "size": [config.height, config.width],
        "scenes": devices,
        "seed": seed,
        "repeats": repeats,
        "loss": losses,
        "wall_s": {name: summary(values) for name, values in seconds.wall.items()},
        "cpu_s": {name: summary(values) for name, values in seconds.cpu.items()},
        "gain": summary([a / b for a, b in zip(one, many)]),
        "environment": harness.environment(),
    }


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--devices", type=int, default=4)
    p.add_argument("--size", help="HEIGHTxWIDTH (default: the model's)")
    p.add_argument("--repeats", type=int, default=5)
    p.add_argument("--seed", type=int, default=0)
    args = p.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from roge_jax.core.distributed import request_devices

    request_devices(args.devices)
    found = measure(args.devices, args.size, args.repeats, args.seed)
    harness.write("cpu_devices.json", found)
    for name, seconds in found["wall_s"].items():
        print(
            f"{name}: {seconds['median']:.2f} s wall ({seconds['low']:.2f} to {seconds['high']:.2f}), "
            f"{found['cpu_s'][name]['median']:.1f} CPU s, loss {found['loss'][name]:.6f}"
        )
    gain = found["gain"]
    print(f"gain {gain['median']:.2f} ({gain['low']:.2f} to {gain['high']:.2f})")


if __name__ == "__main__":
    main()
