"""Find few-step grids for a trained model and store them for `--schedule optimised`.

    python experiments/optimise_schedules.py [--checkpoint mini] [--solvers euler unipc_2] [--steps 4 6 8]

Writes roge_jax/video/schedules.json (grids; read by `flow.schedule("optimised", ...)`) and
results/optimise_schedules.json (errors of shift, uniform and optimised grids on scenes not used in the search).
For each training-split scene: teacher = midpoint with 48 steps on the graded grid; a first grid by dynamic programming
over the teacher's Euler jump errors; then each point is moved where the sampler's own end error (relative L2 of
the target latents to the teacher's, mean over scenes) is least. 4 + 2 scenes with 3 photos, seeds in the JSON.
CPU: about 2000 network evaluations per solver and step count. Our numbers: see the JSON, if it is there.
"""

import argparse
import functools
import json
from pathlib import Path

import numpy as np

OUT = Path(__file__).parent / "results"
SEARCH, CHECK = (11, 12, 13, 14), (21, 22)
TEACHER_STEPS, CONTEXTS = 48, 3


def problems(params, config, seeds):
    """[(prepared, noise)]: what the sampler needs of each scene."""
    import jax

    from roge_jax import model
    from roge_jax.data.views import make_sample
    from roge_jax.evaluate import read

    prepare = jax.jit(functools.partial(model.prepare, config=config))
    found = []
    for seed in seeds:
        scene = read(
            f"procedural:{seed}", CONTEXTS, config.frames, (config.height, config.width), None
        )
        views = make_sample(
            scene["rgb"], scene["K"], scene["c2w"], CONTEXTS, scale_rule=config.scale_rule
        )
        views.pop("target_rgb")
        noise = model.draw_noise(jax.random.key(seed), CONTEXTS, config=config)
        found.append((prepare(params, views), noise))
    return found


def search(params, config, cases, held_out, solver_names, step_counts):
    """({solver: {steps: grid}}, [record])"""
    import jax
    import jax.numpy as jnp

    from roge_jax import model
    from roge_jax.video import flow
    from roge_jax.video.solvers import solve, tabulate

    contexts = CONTEXTS

    @jax.jit
    def end(prepared, noise, table):
        return model.generate(params, prepared, noise, config=config, solver=table)[0]

    @jax.jit
    def teacher(prepared, noise, table):
        field, project = model.sampling_field(params, prepared, noise, config=config)
        x0, info = solve(table, field, noise, project=project, keep_states=True)
        return x0[contexts:], info.states

    @jax.jit
    def slopes(prepared, noise, states, sigmas):
        field, project = model.sampling_field(params, prepared, noise, config=config)
        looked = lambda x, s: field(project(x, s), s)[contexts:]  # noqa: E731
        return jax.lax.map(lambda row: looked(*row), (states, sigmas))

    fine = flow.schedule("graded", TEACHER_STEPS, power=1.5)
    table = tabulate("midpoint", fine)
    ends, errors = {}, 0.0
    for which, group in (("search", cases), ("check", held_out)):
        ends[which] = []
        for prepared, noise in group:
            x0, states = teacher(prepared, noise, table)
            ends[which].append(x0)
            if which == "search":
                v = slopes(prepared, noise, states[:-1], jnp.asarray(fine[:-1], jnp.float32))
                v = np.append(v, v[-1:], axis=0)
                errors = errors + flow.euler_jump_errors(fine, states[:, contexts:], v)

    def error(grid, solver, which="search"):
        group = cases if which == "search" else held_out
        made = tabulate(solver, grid)
        gaps = [
            float(jnp.linalg.norm(end(*case, made) - x0) / jnp.linalg.norm(x0))
            for case, x0 in zip(group, ends[which], strict=True)
        ]
        return float(np.mean(gaps))

    grids, records = {}, []
    for solver in solver_names:
        grids[solver] = {}
        for steps in step_counts:
            first = flow.optimise_schedule(fine, errors, steps)
            known = {
                k: flow.schedule(k, steps, shift=config.flow.shift)
                for k in ("shift", "uniform", "graded")
            }
            start = min([first, *known.values()], key=lambda grid: error(grid, solver))
            best = flow.refine_schedule(
                lambda grid, s=solver: error(grid, s), start, rounds=2, trials=4
            )
            grids[solver][str(steps)] = [round(float(s), 5) for s in best]
            known |= {"jumps": first, "optimised": best}
            record = {name: error(grid, solver, "check") for name, grid in known.items()}
            records.append({"solver": solver, "steps": steps, "error_on_other_scenes": record})
            print(json.dumps(records[-1]), flush=True)
    return grids, records


def main(args):
    from roge_jax.checkpoint import load_model
    from roge_jax.video.flow import OPTIMISED_FILE

    params, config = load_model(args.checkpoint)
    cases, held_out = (problems(params, config, seeds) for seeds in (SEARCH, CHECK))
    grids, records = search(params, config, cases, held_out, args.solvers, args.steps)
    settings = {
        "checkpoint": args.checkpoint,
        "search_seeds": SEARCH,
        "check_seeds": CHECK,
        "teacher": f"midpoint, {TEACHER_STEPS} graded steps",
    }
    OPTIMISED_FILE.write_text(json.dumps({"settings": settings, "grids": grids}, indent=1) + "\n")
    OUT.mkdir(exist_ok=True)
    report = {"settings": settings, "records": records}
    (OUT / "optimise_schedules.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", default="mini")
    parser.add_argument("--solvers", nargs="+", default=["euler", "unipc_2"])
    parser.add_argument("--steps", nargs="+", type=int, default=[4, 6, 8])
    main(parser.parse_args())
