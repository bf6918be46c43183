"""Speed against accuracy of the trained model: every sampler on every schedule, then its other knobs and its peers.

    python experiments/mini_quality.py [--scenes 8] [--checkpoint mini]
    python experiments/mini_quality.py --scenes 2 --solvers euler ab2 --budgets 4 8 --reference 16    # a quick look

Writes results/mini_quality.json, mini_quality.png (samplers), mini_knobs.png (photos, size, precision, caches, peers) and the
tables between the markers in docs/solvers.md. All points of a run share scenes (held-out split), photos and noise.
Reference: classical Runge-Kutta, 64 graded steps; its self-error is the distance to 32 steps. Budgets are evaluations of
the velocity network; a method takes as many steps as fit. Times: wall time of sampling alone, all scenes in one
batch, divided by their number, one run each after compilation. Intervals: bootstrap over scenes, 95 %.

PSNR to the truth alone cannot judge a sampler: the mean of all plausible videos, which one evaluation gives, is
blurred and has the *higher* PSNR. Goals are therefore two-sided (|difference| to Euler with 50 steps) and stand beside sharpness
and the distance to the reference's own frames. Schedules: run optimise_schedules.py first after any training.
The published system reports no such chart. Our numbers: docs/solvers.md. Time on 4 CPU cores: in the JSON.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from quality import charts, knobs
from quality.measures import MEANING, Judge, difference, summary
from quality.scenes import (
    ALL_SOLVERS,
    DEFAULT_M,
    Sampler,
    assemble,
    fingerprint,
    most_steps,
    render,
)

from roge_jax.checkpoint import load_model
from roge_jax.config import FlowConfig, RoGeConfig
from roge_jax.data.procedural import HELDOUT_SEED
from roge_jax.entry import enable_cache
from roge_jax.errors import UserError
from roge_jax.video import flow

OUT = Path(__file__).parent / "results"
DOCUMENT = Path(__file__).parent.parent / "docs" / "solvers.md"
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

    euler = sampler.run("euler", sampler.grid("uniform", 50, "euler"))
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
        add(solver, schedule, steps, sampler.run(solver, sampler.grid(schedule, steps, solver)))
        print(solver, schedule, steps, f"{records[-1]['metrics']['latent_error']['mean']:.4f}", flush=True)  # fmt: skip
    for tolerance in TOLERANCES:
        add("bosh3", "adaptive", tolerance, sampler.adaptive(tolerance))
    return records, base


def verdict(
    records: list[dict], euler50: dict[str, dict[str, float]], own: FlowConfig
) -> dict[str, Any]:
    """Which goals are met, by the point closest to the reference within the evaluations; the default and its rival."""
    name = lambda r: f"{r['solver']} {r['schedule']} {r['steps']}"  # noqa: E731
    found: dict[str, Any] = {"goals": []}
    for evaluations, limit in GOALS:
        fit = [r for r in records if r["evaluations"] <= evaluations]
        best = min(fit, key=lambda r: r["metrics"]["latent_error"]["mean"])
        gap = best["psnr_to_euler50"]
        found["goals"].append(
            {
                "evaluations": evaluations,
                "limit_db": limit,
                "point": name(best),
                "psnr_to_euler50": gap,
                "reached": abs(gap["mean"]) <= limit,
                "reached_by_interval": max(abs(gap["low"]), abs(gap["high"])) <= limit,
            }
        )
    sharp = euler50["sharpness_ratio"]["mean"]
    close = [
        r
        for r in records
        if abs(r["psnr_to_euler50"]["mean"]) <= GOALS[0][1]
        and abs(r["metrics"]["sharpness_ratio"]["mean"] / sharp - 1.0) <= SAME_SHARPNESS
    ]
    if close:  # the fewest evaluations among those; then the smallest error
        best = min(close, key=lambda r: (r["evaluations"], r["metrics"]["latent_error"]["mean"]))
        found["fewest_evaluations_within_goal"] = name(best)
    found["default"] = f"{own.solver} {own.schedule} {own.steps}"
    return found


def main(args: argparse.Namespace) -> None:
    enable_cache()
    began = time.perf_counter()
    params, config = load_model(args.checkpoint)
    seeds = range(HELDOUT_SEED, HELDOUT_SEED + args.scenes)
    sequences = render(seeds, config)
    scenes = assemble(params, sequences, config)
    sampler, judge = Sampler(params, scenes, config), Judge(params, config, scenes)
    sampler.velocity(scenes.noise, 1.0).block_until_ready()  # compiles
    judge.frames(scenes.noise[:, scenes.m :])
    clock = time.perf_counter()
    judge.frames(scenes.noise[:, scenes.m :])
    decode_seconds = (time.perf_counter() - clock) / args.scenes
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
    others += knobs.with_block_cache(params, config, scenes, judge, exact)
    others += knobs.refinement()
    others.append(knobs.record("ceiling", "truth", "truth itself", judge.scores(scenes.truth)))
    others.append(knobs.round_trip(params, config, scenes, judge))

    found = table_of_schedules(config.name)
    weights = fingerprint(params)
    git = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
    )
    report = {
        "settings": {
            "checkpoint": args.checkpoint,
            "weights": weights,
            "schedules_found_on": found or "none",
            "schedules_are_of_these_weights": found == weights,
            "command": " ".join(["python experiments/mini_quality.py", *sys.argv[1:]]),
            "scenes": [seeds[0], seeds[-1]],
            "generation_only": Path(args.generation_only).parent.name
            if args.generation_only
            else "",
            "photos": DEFAULT_M,
            "size": [config.height, config.width, config.frames],
            "reference": f"rk4, {args.reference} graded steps",
            "metrics": MEANING,
        },
        "device": f"{jax.devices()[0].device_kind}, {len(os.sched_getaffinity(0))} cores",
        "versions": {"jax": jax.__version__, "numpy": np.__version__},
        "commit": git.stdout.strip(),
        "seconds": round(time.perf_counter() - began, 1),
        "decode_seconds": decode_seconds,
        "reference": {"self_error": summary(base["self_error"]), "metrics": summary(base["self"])},
        "euler50": {"metrics": euler50, "seconds": base["euler50_run"].seconds},
        "verdict": verdict(records, euler50, config.flow),
        "records": records,
        "knobs": others,
    }
    OUT.mkdir(exist_ok=True)
    short = json.loads(json.dumps(report), parse_float=lambda text: float(f"{float(text):.4g}"))
    (OUT / "mini_quality.json").write_text(json.dumps(short, separators=(",", ":")) + "\n")
    finish()
    print(f"{report['seconds']} s")


def table_of_schedules(model: str) -> str | None:
    """The fingerprint of the weights that the stored schedules were found on."""
    if not flow.OPTIMISED_FILE.exists():
        return None
    return (
        json.loads(flow.OPTIMISED_FILE.read_text()).get(model, {}).get("found", {}).get("weights")
    )


def finish() -> None:
    """Charts and the tables of the document, from the stored results."""
    report = json.loads((OUT / "mini_quality.json").read_text())
    charts.samplers(report, OUT / "mini_quality.png")
    charts.knobs(report, OUT / "mini_knobs.png")
    DOCUMENT.write_text(charts.with_tables(DOCUMENT.read_text(), report))
    if not report["settings"]["schedules_are_of_these_weights"]:
        print(
            "The optimised schedules were found on other weights: run optimise_schedules.py first."
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
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
