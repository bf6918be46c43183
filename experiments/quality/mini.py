"""Speed against accuracy of the trained model: every sampler on every schedule, then its other knobs and its peers.

    python -m experiments.quality.mini [--scenes 8] [--checkpoint mini]
    python -m experiments.quality.mini --scenes 2 --solvers euler ab2 --budgets 4 8 --reference 16    # a quick look

Writes results/mini_quality.json, mini_quality.png (samplers), mini_knobs.png (photos, size, precision, caches, peers) and the
tables between the markers in docs/results/solvers.md. All points of a run share scenes (held-out split), photos and noise.
Reference: classical Runge-Kutta, 64 graded steps; its self-error is the distance to 32 steps. Budgets are evaluations of
the velocity network; a method takes as many steps as fit. Times: wall time of sampling alone, all scenes in one
batch, divided by their number; median, fastest and slowest of three runs after one that is not counted, for every
method alike. Intervals: bootstrap over scenes, 95 %.

PSNR to the truth alone cannot judge a sampler: the mean of all plausible videos, which one evaluation gives, is
blurred and has the *higher* PSNR. Goals are therefore two-sided and include sharpness (`reaches`), and stand beside
the distance to the reference's own frames. Schedules: run optimise_schedules.py first after any training.
The published system reports no such chart. Our numbers: docs/results/solvers.md. Time on 4 CPU cores: in the JSON.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax

from experiments import harness
from experiments.quality import charts, knobs
from experiments.quality.measures import MEANING, Judge, difference, summary
from experiments.quality.scenes import (
    ALL_SOLVERS,
    DEFAULT_M,
    Sampler,
    assemble,
    most_steps,
    render,
    timed,
)
from roge_jax.checkpoint import load_model, weights_fingerprint
from roge_jax.config import FlowConfig, RoGeConfig
from roge_jax.errors import UserError
from roge_jax.files.entry import enable_cache
from roge_jax.video import flow

SCHEDULES = ("uniform", "shift", "graded", "optimised")
BUDGETS = (1, 2, 4, 6, 8, 12, 20)
TOLERANCES = (0.3, 0.1, 0.03)
GOALS = ((8, 0.1), (4, 0.5))  # evaluations, dB
SAME_SHARPNESS = 0.02  # relative


def points(config: RoGeConfig, names: list[str], budgets: list[int]):
    """(solver, schedule, steps) of the sweep; a shift of 1 leaves the uniform schedule as it is."""
    stored = flow.optimised_grids(config.name)
    for solver in names:
        steps = sorted({n for b in budgets if (n := most_steps(solver, b))})
        for schedule in SCHEDULES:
            if schedule == "shift" and config.flow.shift == 1.0:
                continue
            for n in stored.get(solver, {}) if schedule == "optimised" else steps:
                yield solver, schedule, n


def sweep(sampler: Sampler, judge: Judge, args) -> tuple[list[dict], dict[str, Any]]:
    """(records, what they are compared with)"""
    config = sampler.config
    fine = [flow.schedule("graded", n) for n in (args.reference // 2, args.reference)]
    half, full = (sampler.run("rk4", grid).latents for grid in fine)
    base: dict[str, Any] = {"reference": full, "frames": judge.frames(full)}
    base["self_error"] = judge.against(half, judge.frames(half), full, base["frames"])
    base["self"] = judge.scores(base["frames"])

    def measured(run):
        frames = judge.frames(run.latents)
        return judge.scores(frames) | judge.against(run.latents, frames, full, base["frames"])

    euler = sampler.timed("euler", sampler.grid("uniform", 50, "euler"))
    base["euler50"], base["euler50_run"] = measured(euler), euler
    records = []

    def add(solver, schedule, steps, run):
        scores = measured(run)
        records.append(
            {
                "solver": solver,
                "schedule": schedule,
                "steps": steps,
                "evaluations": run.evaluations,
                "seconds": run.seconds,
                "metrics": summary(scores),
                "psnr_to_euler50": difference(scores["psnr"], base["euler50"]["psnr"]),
            }
        )

    for solver, schedule, steps in points(config, args.solvers, args.budgets):
        add(solver, schedule, steps, sampler.timed(solver, sampler.grid(schedule, steps, solver)))
        print(solver, schedule, steps, f"{records[-1]['metrics']['latent_error']['mean']:.4f}", flush=True)  # fmt: skip
    for tolerance in TOLERANCES:
        add("bosh3", "adaptive", tolerance, sampler.adaptive(tolerance))
    return records, base


def reaches(record: dict, limit: float, sharpness: float) -> bool:
    """Euler 50's quality: PSNR to the truth within `limit` dB of its own either way (mean over scenes, same photos and
    noise), and the sharpness ratio within SAME_SHARPNESS of its `sharpness`: a blurred video may have any PSNR.
    """
    ratio = record["metrics"]["sharpness_ratio"]["mean"] / sharpness
    return abs(record["psnr_to_euler50"]["mean"]) <= limit and abs(ratio - 1.0) <= SAME_SHARPNESS


def verdict(
    records: list[dict], euler50: dict[str, dict[str, float]], own: FlowConfig
) -> dict[str, Any]:
    """Which goals are met, the cheapest point with Euler 50's quality, and the default.

    A goal is met if any sampler within its evaluations `reaches` Euler 50. Named is the one of them that is closest to the
    reference; if there is none, the one with the nearest PSNR. As the best of many on the same scenes it is an
    optimistic choice: the JSON and the page count those that passed, and those that did with their whole interval.
    """
    name = lambda r: f"{r['solver']} {r['schedule']} {r['steps']}"  # noqa: E731
    error = lambda r: r["metrics"]["latent_error"]["mean"]  # noqa: E731
    sharp = euler50["sharpness_ratio"]["mean"]
    found: dict[str, Any] = {"goals": []}
    for evaluations, limit in GOALS:
        fit = [r for r in records if r["evaluations"] <= evaluations]
        passing = [r for r in fit if reaches(r, limit, sharp)]
        sure = [r for r in passing if max(map(abs, r["psnr_to_euler50"].values())) <= limit]
        nearest = lambda r: abs(r["psnr_to_euler50"]["mean"])  # noqa: E731
        best = min(passing, key=error) if passing else min(fit or records, key=nearest)
        found["goals"].append(
            {
                "evaluations": evaluations,
                "limit_db": limit,
                "reached": bool(passing),
                "samplers": len(fit),
                "passing": len(passing),
                "passing_by_interval": len(sure),
                "point": name(best),
                "psnr_to_euler50": best["psnr_to_euler50"],
            }
        )
    close = [r for r in records if reaches(r, GOALS[0][1], sharp)]
    if close:  # the fewest evaluations among those; then the smallest error
        found["fewest_evaluations_within_goal"] = name(
            min(close, key=lambda r: (r["evaluations"], error(r)))
        )
    found["default"] = f"{own.solver} {own.schedule} {own.steps}"
    return found


def main(args: argparse.Namespace) -> None:
    enable_cache()
    began = time.perf_counter()
    params, config = load_model(args.checkpoint)
    seeds = harness.heldout(args.scenes)
    sequences = render(seeds, config)
    scenes = assemble(params, sequences, config)
    sampler, judge = Sampler(params, scenes, config), Judge(params, config, scenes)
    _, decode_seconds = timed(lambda: judge.frames(scenes.noise[:, scenes.m :]), args.scenes)
    records, base = sweep(sampler, judge, args)
    euler50 = summary(base["euler50"])

    run = knobs.default_run(sampler)
    frames = judge.frames(run.latents)
    exact = {
        "scores": judge.scores(frames),
        "more": {"seconds": run.seconds, "evaluations": run.evaluations},
        "reference": base["reference"],
        "frames": base["frames"],
    }
    peer = load_model(args.generation_only)[0] if args.generation_only else params
    others = knobs.over_photos(params, config, sequences, {DEFAULT_M: scenes}, peer)
    others += knobs.over_steps(peer, config, scenes)
    others += knobs.over_sizes(params, config, seeds)
    others += knobs.in_bfloat16(params, config, scenes, exact)
    others += knobs.with_block_cache(sampler, judge, exact)
    others += knobs.refinement()
    others.append(knobs.record("ceiling", "truth", "truth itself", judge.scores(scenes.truth)))
    others.append(knobs.round_trip(params, config, scenes, judge))

    found = table_of_schedules(config.name)
    weights = weights_fingerprint(params, "float32")
    record = harness.environment()
    report = {
        "settings": {
            "checkpoint": args.checkpoint,
            "weights": weights,
            "schedules_found_on": found or "none",
            "schedules_are_of_these_weights": found == weights,
            "command": " ".join(harness.command()),
            "scenes": [seeds[0], seeds[-1]],
            "generation_only": Path(args.generation_only).parent.name
            if args.generation_only
            else "",
            "photos": DEFAULT_M,
            "size": [config.height, config.width, config.frames],
            "reference": f"rk4, {args.reference} graded steps",
            "metrics": MEANING,
        },
        "environment": record,
        "device": f"{jax.devices()[0].device_kind}, {record['cores']} cores",
        "seconds": round(time.perf_counter() - began, 1),
        "decode_seconds": decode_seconds,
        "reference": {"self_error": summary(base["self_error"]), "metrics": summary(base["self"])},
        "euler50": {"metrics": euler50, "seconds": base["euler50_run"].seconds},
        "verdict": verdict(records, euler50, config.flow),
        "records": records,
        "knobs": others,
    }
    harness.write("mini_quality.json", report, digits=4)
    finish()
    print(f"{report['seconds']} s")


def table_of_schedules(model: str) -> str | None:
    """The fingerprint of the weights that the stored schedules were found on."""
    return (
        harness.read(flow.OPTIMISED_FILE, absent={}).get(model, {}).get("found", {}).get("weights")
    )


def finish() -> None:
    """Charts and the tables of the document, from the stored results."""
    report = harness.read("mini_quality.json")
    charts.samplers(report, "mini_quality.png")
    charts.knobs(report, "mini_knobs.png")
    harness.put(harness.DOCS / "results" / "solvers.md", "mini_quality", charts.tables(report))
    if not report["settings"]["schedules_are_of_these_weights"]:
        print(
            "The optimised schedules were found on other weights: run optimise_schedules.py first."
        )


if __name__ == "__main__":
    parser = harness.parser(__doc__)
    parser.add_argument("--checkpoint", default="mini")
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--solvers", nargs="+", default=list(ALL_SOLVERS), choices=ALL_SOLVERS)
    parser.add_argument("--budgets", nargs="+", type=int, default=list(BUDGETS))
    parser.add_argument("--reference", type=int, default=64, help="steps of the reference")
    parser.add_argument(
        "--generation-only",
        metavar="FOLDER",
        help="a model of the stage `prior` as the generation-only peer; without it this model, told of no rays",
    )
    parser.add_argument("--draw", action="store_true", help="charts and tables from the JSON alone")
    chosen = parser.parse_args()
    if chosen.scenes < 2:
        raise UserError(f"--scenes {chosen.scenes}: intervals need at least 2 scenes.")
    finish() if chosen.draw else main(chosen)
