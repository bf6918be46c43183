"""Scene complexity against compute: what the planner spends and loses, beside plans of equal cost that do not look.

    OPENBLAS_NUM_THREADS=1 python experiments/plan_ladder.py --calibrate 12   # roge_jax/assets/planning.json
    OPENBLAS_NUM_THREADS=1 python experiments/plan_ladder.py 4                # results/plan_ladder.{json,png}

CPU. The numbers are scenes (calibration) and scenes per rung; about 15 s of one idle core for each scene of either.
Calibrate again whenever the weights change: the second command predicts with what the first one measured.

The ladder has six rungs: a textured plane, the empty room or ground, 3, 6 and 12 objects, and 12 thin objects crowded
around the focus. A seed has the same cameras and textures on every rung. Six photos and 17 targets of one path, 64x112:
even seeds have their photos evenly spread, odd ones in two bursts of three, as people hold the shutter.
Calibration uses training seeds (rung by rung in turn), the ladder held-out seeds with textures never trained on.

For every tolerance and scene the planner (`roge_jax.planning`) makes a plan; its FLOPs include those of planning.
Beside it, at the planner's cost or the nearest below:
  fixed    one plan for all scenes, the best on average by the same table and budget, photos spread (farthest point)
  random   a plan drawn from all whose cost is within 15 % below, photos drawn too
  uniform  photos and steps cut by one common factor, photos evenly spread, uniform sigma grid; the RGB head alone
           where the budget does not pay for a generated video
Errors are RMS colour differences, to the full model's frames (what the tolerance is about) and to the truth.
The published system has no such chart. Our numbers: docs/planning.md.
"""

import argparse
import json
import subprocess
import time
from pathlib import Path

import jax
import numpy as np
import plan_report
from plan_runs import CONTEXTS, RUNGS, Engine, LadderScene, fit, make, rms, turn_knobs

from roge_jax import checkpoint
from roge_jax.data.procedural import HELDOUT_SEED
from roge_jax.data.scene import select_context
from roge_jax.planning import coverage, options, table
from roge_jax.planning.plan import plan

OUT = Path(__file__).parent / "results" / "plan_ladder.json"
TRAIN_SEED = 500_000  # training seeds that no shipped pool used
TOLERANCES = (0.01, 0.02, 0.03, 0.04, 0.06, 0.08)
CONTROLS = ("fixed", "random", "uniform")


def provenance(command: str, scenes: int) -> dict:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
        check=False,
    )
    found = checkpoint.find_model("mini")
    return {
        "command": command,
        "scenes": scenes,
        "commit": commit.stdout.strip(),
        "weights": sorted(
            f"{f.name} {f.stat().st_size}" for f in Path(found).glob("*.safetensors")
        ),
        "device": f"{jax.default_backend()}, jax {jax.__version__}",
        "date": time.strftime("%Y-%m-%d"),
    }


def calibrate(engine: Engine, scenes: int) -> None:
    rows = []
    for i in range(scenes):
        began = time.process_time()
        rows.append(turn_knobs(engine, make(RUNGS[i % len(RUNGS)], TRAIN_SEED + i, engine.config)))
        row = {k: v for k, v in rows[-1].items() if k not in ("photos", "steps")}
        print(f"{time.process_time() - began:.0f} s {json.dumps(row)}", flush=True)
    origin = provenance(f"python experiments/plan_ladder.py --calibrate {scenes}", scenes)
    origin |= {
        "seeds": [TRAIN_SEED, TRAIN_SEED + scenes - 1],
        "model": "the shipped mini",
        "full": [engine.settings.solver, engine.settings.schedule, engine.settings.steps],
        "full_to_truth": float(np.mean([row["full_to_truth"] for row in rows])),
        "head_to_truth": float(np.mean([row["head_to_truth"] for row in rows])),
    }
    document = json.loads(table.FILE.read_text()) if table.FILE.exists() else {}
    document[engine.config.name] = fit(rows, origin)
    table.FILE.write_text(json.dumps(document, indent=1) + "\n")
    (OUT.parent / "plan_calibration.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(f"wrote {table.FILE}")


# ---- the ladder ------------------------------------------------------------------------------------


def every_option(engine: Engine, scene: LadderScene, measured: dict, constants) -> list:
    size = (engine.config.height, engine.config.width)
    worth = coverage.coverage(scene.photos.cameras, scene.path, *size)
    return options.list_options(
        scene.photos, engine.config, scene.path, engine.settings, constants, measured, worth
    )


def shape(choices) -> tuple:
    """Choices without saying which photos: what a plan for all scenes can fix."""
    return (len(choices.photos), *(getattr(choices, f) for f in FIELDS))


FIELDS = ("steps", "solver", "schedule", "recon", "merge", "generate")


def fixed_plan(listed: list[list], budget: float):
    """The shape within `budget` whose predicted error, the mean over scenes of an average kind, is least."""
    errors: dict[tuple, list[float]] = {}
    for scene_options in listed:
        for o in scene_options:
            if o.flops <= budget:
                errors.setdefault(shape(o.choices), []).append(o.error)
    full = {k: v for k, v in errors.items() if len(v) == len(listed)}
    best = min(full, key=lambda k: (np.mean(full[k]), k[:2]))
    return next(o.choices for o in listed[0] if shape(o.choices) == best)


def uniform_plan(engine: Engine, scene: LadderScene, listed: list, budget: float):
    """Photos and steps cut by one factor; without generation where that costs too much."""
    price = options.Prices(scene.photos, engine.config, engine.settings, 1)
    found = []
    for steps in range(1, engine.settings.steps + 1):
        m = max(1, round(steps * CONTEXTS / engine.settings.steps))
        spread = tuple(int((i + 0.5) * CONTEXTS / m) for i in range(m))
        made = engine.choices(scene, photos=spread, steps=steps, schedule="uniform")
        found += [(steps + 100, price(made, steps), made)]
        head = engine.choices(scene, photos=spread, generate=(False,))
        found += [(steps, price(head, 0), head)]
    affordable = [f for f in found if f[1] <= budget] or [min(found, key=lambda f: f[1])]
    return max(affordable, key=lambda f: f[0])[1:]


def climb(engine: Engine, scenes_per_rung: int, rungs=RUNGS) -> dict:
    """All plans of all scenes, with predicted and realised errors."""
    constants = table.load(engine.config.name)
    scenes = [
        make(rung, HELDOUT_SEED + i, engine.config)
        for i in range(scenes_per_rung)
        for rung in rungs
    ]
    rows = []
    plans = {}
    for number, scene in enumerate(scenes):
        for tolerance in TOLERANCES:
            plans[number, tolerance] = plan(
                engine.params,
                engine.config,
                scene.photos,
                scene.path,
                tolerance=tolerance,
                compiled=engine.programs,
            )
    average = [every_option(engine, scene, {}, constants) for scene in scenes]
    fixed = {
        t: fixed_plan(average, np.mean([spent(plans[n, t]) for n in range(len(scenes))]) * 1.02)
        for t in TOLERANCES
    }
    for number, scene in enumerate(scenes):
        began = time.process_time()
        listed = average[number]
        price = {o.choices: o.flops for o in listed}
        full = engine.choices(scene)
        reference = engine.run(scene, full)
        head = engine.choices(scene, generate=(False,))
        rng = np.random.default_rng(scene.seed)
        row = {
            "rung": scene.rung,
            "seed": scene.seed,
            "bits_per_pixel": scene.bits,
            "full": {"flops": price[full], "truth": rms(reference, scene.truth)},
            "head": {
                "flops": price[head],
                "full": rms(engine.run(scene, head), reference),
                "truth": rms(engine.run(scene, head), scene.truth),
            },
            "plans": [],
        }
        for tolerance in TOLERANCES:
            made = plans[number, tolerance]
            budget = spent(made)
            some = fixed[tolerance]
            photos = tuple(select_context(scene.photos.cameras, len(some.photos)))
            near = [o for o in listed if 0.85 * budget <= o.flops <= budget] or [
                max((o for o in listed if o.flops <= budget), key=lambda o: o.flops, default=None)
                or min(listed, key=lambda o: o.flops)
            ]
            drawn = near[rng.integers(len(near))]
            any_photos = rng.permutation(CONTEXTS)[: len(drawn.choices.photos)].tolist()
            even_cost, even = uniform_plan(engine, scene, listed, budget)
            runs = {
                "planner": (made.choices, budget),
                "fixed": (
                    engine.choices(scene, photos=photos, **fields(some)),
                    cost_of(price, some),
                ),
                "random": (
                    engine.choices(
                        scene, photos=tuple(sorted(any_photos)), **fields(drawn.choices)
                    ),
                    drawn.flops,
                ),
                "uniform": (even, even_cost),
            }
            entry = {"tolerance": tolerance, "predicted": made.predicted_error}
            entry["planning_flops"] = made.planning_cost
            for name, (choices, flops) in runs.items():
                frames = engine.run(scene, choices)
                entry[name] = {
                    "flops": flops,
                    "full": rms(frames, reference),
                    "truth": rms(frames, scene.truth),
                    "photos": list(choices.photos),
                    **{f: getattr(choices, f) for f in FIELDS},
                }
            row["plans"].append(entry)
        scene.kept.clear()
        rows.append(row)
        print(f"{time.process_time() - began:.0f} s {scene.rung} {scene.seed}", flush=True)
    return {"rows": rows}


def spent(made) -> float:
    return made.predicted_cost + made.planning_cost


def fields(choices) -> dict:
    return {f: getattr(choices, f) for f in FIELDS}


def cost_of(price: dict, choices) -> float:
    """FLOPs of choices by their shape."""
    return next(flops for known, flops in price.items() if shape(known) == shape(choices))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("scenes", nargs="?", type=int, default=4, help="scenes per rung")
    parser.add_argument("--calibrate", type=int, metavar="SCENES", help="measure the table instead")
    parser.add_argument("--draw", action="store_true", help="only draw the stored results again")
    args = parser.parse_args()
    if not args.draw:
        engine = Engine(*checkpoint.load_model("mini"))
        if args.calibrate:
            return calibrate(engine, args.calibrate)
        document = climb(engine, args.scenes)
        command = f"python experiments/plan_ladder.py {args.scenes}"
        document["provenance"] = provenance(command, len(document["rows"]))
        document["provenance"]["table"] = table.load("mini").provenance
        document["summary"] = plan_report.summarise(document["rows"])
        OUT.write_text(json.dumps(document, indent=1) + "\n")
        print(f"wrote {OUT}")
    document = json.loads(OUT.read_text())
    plan_report.draw(document, OUT.with_suffix(".png"))
    print(plan_report.words(document["summary"]))


if __name__ == "__main__":
    main()
