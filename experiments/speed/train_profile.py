"""Where the time of a training step goes: `make train`'s step (stage `joint` of the shipped model), taken apart.

    python -m experiments.speed.train_profile                    # writes experiments/results/train_profile.json
    taskset -c 0-3 python -m experiments.speed.train_profile --photos 3 --repeats 9 --size 64x112

About 15 minutes on 4 cores, most of it compiling. One scene of `--photos` photos and 17 frames, drawn as the program draws it.
Compiled on their own and timed in turn: the step; loss and gradient; the loss alone; and the loss's parts, each on the
arrays that it gets there. Backward is gradient minus loss, optimiser is step minus gradient. Times are CPU seconds of the process
(medians with lowest and highest), which other programs disturb least; wall seconds stand beside them, and
steps per second are those of the step alone, without drawing and rendering the batch (`batch` in the results). Compiled apart, a
part cannot share work with its neighbours, so the parts need not add up to the loss: the difference is `unattributed`.
"""

import dataclasses
import functools
import time
from pathlib import Path

from experiments import harness
from experiments.harness import summary, timed


def profile(checkpoint: str, size: str, photos: int, repeats: int, seed: int) -> dict:
    import jax

    from roge_jax import model
    from roge_jax.checkpoint import load_model
    from roge_jax.core.lora import attach
    from roge_jax.core.params import count
    from roge_jax.data.source import ProceduralSource
    from roge_jax.training import loop, stages, start
    from roge_jax.training.optim import make_optimiser

    params, config = load_model(checkpoint)
    config = start.resize(config, size, hires=False)
    stage = stages.find_stage(stages.mini_stages(frames=config.frames), "joint")
    working = stages.stage_config(config, stage)
    source = ProceduralSource(working.height, working.width, frames=max(24, working.frames + 3))
    draw = functools.partial(stages.stage_batch, source, stage, working, seed)
    batch = next(b for i in range(1000) if (b := draw(i))["context_rgb"].shape[1] == photos)
    batch_seconds = [timed(lambda i=i: draw(i)) for i in range(1, 4)]

    specs, _ = stages.stage_specs(config, stage)
    trainable, frozen = model.split(params, stage.trains)
    optimiser = make_optimiser(stage.optim, specs, stage.steps)
    objective = functools.partial(stages.joint_objective, config=working, stage=stage)
    key = jax.random.key(seed)
    views = jax.tree.map(lambda x: jax.numpy.asarray(x[0]), batch)

    def encode(p, views):  # joined outside: a concatenation may be fused with its producers
        contexts = model.encode_contexts(p, views["context_rgb"], config=working)
        return contexts, model.encode_targets(p, views["target_rgb"], config=working)

    def transformer(p, x0, features, views, rgb):
        shown = rgb[photos:]
        cond = model.condition(p, x0[:photos], features, views, config=working, shown=shown)
        options = {"config": working, "contexts": photos, "remat": stage.remat}
        return model.flow_matching(p, x0, cond, key, draws=stage.draws, **options)

    compile_seconds, compiled = {}, {}

    def compile_(name, function, *arguments, **options):
        start = time.perf_counter()
        compiled[name] = jax.jit(function, **options).lower(*arguments).compile()
        compile_seconds[name] = time.perf_counter() - start
        return jax.block_until_ready(compiled[name](*arguments))

    whole = jax.jit(attach)(frozen, trainable)
    reconstruct = functools.partial(model.reconstruct, config=working)
    query = functools.partial(model.query_rays, config=working)
    picture = functools.partial(model.decode_rgb, config=working)
    arguments = {"VAE encode": (whole, views), "reconstruction": (whole, views)}
    x0 = jax.numpy.concatenate(compile_("VAE encode", encode, *arguments["VAE encode"]))
    tokens = compile_("reconstruction", reconstruct, *arguments["reconstruction"])
    arguments["ray queries"] = (whole, tokens, views)
    features = compile_("ray queries", query, *arguments["ray queries"])
    arguments["picture"] = (whole, features, views)
    rgb = compile_("picture", picture, *arguments["picture"])
    arguments["transformer"] = (whole, x0, features, views, rgb)
    compile_("transformer", transformer, *arguments["transformer"])
    parts = list(arguments)
    arguments["loss"] = arguments["gradient"] = (trainable, frozen, batch, key)
    compile_("loss", objective, *arguments["loss"])
    compile_("gradient", jax.value_and_grad(objective, has_aux=True), *arguments["gradient"])
    # Not donated, so that the same state can be given again: one copy of what trains more than in the program.
    state = loop.initial_state(trainable, optimiser, stage.optim)
    step = loop.make_step(objective, optimiser, stage.optim)
    arguments["step"] = (state, frozen, batch, key)
    compile_("step", step, *arguments["step"])

    calls = {name: functools.partial(compiled[name], *given) for name, given in arguments.items()}
    seconds = harness.in_turn(calls, repeats)
    cpu, wall = ({name: summary(x) for name, x in clock.items()} for clock in seconds)
    middle = {name: value["median"] for name, value in cpu.items()}
    shares = {name: middle[name] for name in parts}
    shares["unattributed"] = middle["loss"] - sum(shares.values())
    shares["backward"] = middle["gradient"] - middle["loss"]
    shares["optimiser"] = middle["step"] - middle["gradient"]
    return {
        "environment": harness.environment(),
        "size": [working.height, working.width, working.frames],
        "stage": dataclasses.asdict(stage) | {"optim": dataclasses.asdict(stage.optim)},
        "trainable": count(trainable),
        "repeats": repeats,
        "cpu_s": cpu,
        "wall_s": wall,
        "share_of_step": {name: value / middle["step"] for name, value in shares.items()},
        "steps_per_s": 1 / wall["step"]["median"],
        "compile_s": compile_seconds,
        "batch_wall_s": summary([w for _, w in batch_seconds]),
    }


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--checkpoint", default="mini", help="model folder or name")
    p.add_argument("--size", default="96x160", help="HEIGHTxWIDTH (default: 96x160)")
    p.add_argument("--photos", type=int, default=3)
    p.add_argument("--repeats", type=int, default=9)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--out", type=Path, default=harness.RESULTS / "train_profile.json")
    args = p.parse_args()
    found = profile(args.checkpoint, args.size, args.photos, args.repeats, args.seed)
    harness.write(args.out, found)
    print(f"{'part':16s} {'share':>6s}")
    for name, share in found["share_of_step"].items():
        print(f"{name:16s} {share:6.1%}")
    print(
        f"step {found['cpu_s']['step']['median']:.2f} CPU s, {found['steps_per_s']:.2f} steps/s, compiled in "
        f"{found['compile_s']['step']:.0f} s; wrote {args.out}"
    )


if __name__ == "__main__":
    main()
