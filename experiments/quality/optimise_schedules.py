"""Find few-step grids for a trained model and store them for `--schedule optimised`.

    python -m experiments.quality.optimise_schedules [--checkpoint mini] [--solvers ab2 euler ...] [--scenes 4]

Repeat it after any training, of the reconstruction too: the grids belong to the weights they were found on, all of them. Writes the
entry of the model in roge_jax/video/schedules.json (grids and where they come from; read by
`flow.schedule("optimised", ...)`) and results/optimise_schedules.json (errors on scenes that the search did not see).
Teacher: midpoint, 48 steps, graded towards 0, on training-split scenes with 3 photos. A first grid by dynamic programming
over the teacher's jump errors (Euler's, and the two-step method's); the better one, or shift, uniform or graded if
they are better still, is then refined point by point on the sampler's own end error: the relative L2 distance of the target
latents to the teacher's, mean over scenes. Budgets are 4, 6, 8 and 12 evaluations. About 8000 evaluations of
the network on the whole batch for all solvers. Our numbers and times: the JSON.
"""

import argparse
import functools
import json
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments import harness
from experiments.quality.scenes import DEFAULT_M, Sampler, assemble, most_steps, render
from roge_jax.checkpoint import load_model, weights_fingerprint
from roge_jax.files.entry import enable_cache
from roge_jax.video import flow, solvers

SEARCH, CHECK = 11, 21  # first training-split seeds of the scenes for search and check
TEACHER_STEPS = 48
BUDGETS = (4, 6, 8, 12)
SOLVERS = ("euler", "ab2", "unipc_2", "dpmpp_2m", "midpoint", "heun")


class Problem:
    """A batch of scenes with its teacher's result."""

    def __init__(self, params: Any, config: Any, first: int, count: int):
        sequences = render(range(first, first + count), config)
        self.sampler = Sampler(params, assemble(params, sequences, config), config)
        self.fine = flow.schedule("graded", TEACHER_STEPS, power=1.5)
        self.teacher = self.sampler.run("midpoint", self.fine).latents

    def jump_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Jump errors along the teacher's path, of Euler [k, k] and of the two-step method [k, k, k]."""
        scenes, states, slopes = self.sampler.scenes, [], []

        def seen(x, sigma):
            v = self.sampler.velocity(x, sigma)
            states.append(np.asarray(x)[:, scenes.m :])
            slopes.append(np.asarray(v)[:, scenes.m :])
            return v

        for _ in solvers.iterate("midpoint", seen, scenes.noise, self.fine):
            pass
        # a step's first evaluation is at its start
        x = np.stack([*states[::2], self.teacher])
        v = np.stack([*slopes[::2], slopes[-1]])
        return flow.euler_jump_errors(self.fine, x, v), flow.adams_jump_errors(self.fine, x, v)

    def error(self, solver: str, grid: np.ndarray) -> float:
        gap = jnp.linalg.norm((self.sampler.run(solver, grid).latents - self.teacher).reshape(len(self.teacher), -1), axis=1)  # fmt: skip
        return float(
            jnp.mean(gap / jnp.linalg.norm(self.teacher.reshape(len(self.teacher), -1), axis=1))
        )


def search(problem: Problem, check: Problem, names: list[str], shift: float):
    """({solver: {steps: grid}}, [record])"""
    jumps, memory = problem.jump_errors()
    grids: dict[str, dict[str, list[float]]] = {}
    records = []
    for solver in names:
        grids[solver] = {}
        for budget in BUDGETS:
            steps = most_steps(solver, budget)
            known = {
                k: flow.schedule(k, steps, shift=shift) for k in ("shift", "uniform", "graded")
            }
            if steps > 1:
                known["jumps"] = flow.optimise_schedule(problem.fine, jumps, steps)
                known["jumps_memory"] = flow.optimise_schedule(problem.fine, memory, steps)
            errors = {name: problem.error(solver, grid) for name, grid in known.items()}
            start = min(errors, key=errors.__getitem__)
            best = flow.refine_schedule(functools.partial(problem.error, solver), known[start])
            known["optimised"] = best = np.round(best, 5)
            grids[solver][str(steps)] = best.tolist()
            record = {
                "solver": solver,
                "steps": steps,
                "evaluations": solvers.nfe(solver, steps),
                "started_from": start,
                "searched": errors | {"optimised": problem.error(solver, best)},
                "other_scenes": {name: check.error(solver, grid) for name, grid in known.items()},
            }
            records.append(record)
            print(solver, steps, start, {k: round(e, 4) for k, e in record["other_scenes"].items()}, flush=True)  # fmt: skip
    return grids, records


def main(args: argparse.Namespace) -> None:
    enable_cache()
    began = time.perf_counter()
    params, config = load_model(args.checkpoint)
    problem, check = (Problem(params, config, first, args.scenes) for first in (SEARCH, CHECK))
    grids, records = search(problem, check, args.solvers, config.flow.shift)
    found = {
        "command": " ".join(harness.command()),
        "weights": weights_fingerprint(params, "float32"),
        "search_seeds": list(range(SEARCH, SEARCH + args.scenes)),
        "check_seeds": list(range(CHECK, CHECK + args.scenes)),
        "photos": DEFAULT_M,
        "teacher": f"midpoint, {TEACHER_STEPS} graded steps",
        "error": "relative L2 of the target latents, mean over scenes",
    }
    table = harness.read(flow.OPTIMISED_FILE, absent={})
    table[config.name] = {"found": found, "grids": grids}
    flow.OPTIMISED_FILE.write_text(written(table))
    report = {
        "settings": found,
        "environment": harness.environment(),
        "seconds": round(time.perf_counter() - began, 1),
        "records": records,
    }
    harness.write("optimise_schedules.json", report, digits=4)
    print(f"{report['seconds']} s")


def written(table: dict[str, Any]) -> str:
    """JSON with one grid a line: a table that people read."""
    text = json.dumps(table, indent=1)
    for entry in table.values():
        for some in entry["grids"].values():
            for grid in some.values():
                long = json.dumps(grid, indent=1).replace("\n", "\n" + " " * 4)
                text = text.replace(long, json.dumps(grid))
    return text + "\n"


if __name__ == "__main__":
    parser = harness.parser(__doc__)
    parser.add_argument("--checkpoint", default="mini")
    parser.add_argument("--solvers", nargs="+", default=list(SOLVERS), choices=list(SOLVERS))
    parser.add_argument("--scenes", type=int, default=4, help="of the search, and of the check")
    main(parser.parse_args())
