"""Scene complexity against compute: what the planner spends and loses, beside plans of equal cost that do not look.

    OPENBLAS_NUM_THREADS=1 python -m experiments.planning.ladder --calibrate 12   # roge_jax/assets/planning.json
    OPENBLAS_NUM_THREADS=1 python -m experiments.planning.ladder 4                # results/plan_ladder.{json,png}

CPU. The numbers are scenes (calibration) and scenes per rung; about 15 s of one idle core for each scene of either.
Calibrate again whenever the weights change: the second command predicts with what the first one measured.

The ladder has six rungs: a textured plane, the empty room or ground, 3, 6 and 12 objects, and 12 thin objects crowded
around the focus. A seed has the same cameras and textures on every rung. Six photos and 17 targets of one path, 64x112:
even seeds have their photos evenly spread, odd ones in two bursts of three, as people hold the shutter.
Calibration uses training seeds (rung by rung in turn), the ladder held-out seeds with textures never trained on.

For every tolerance and scene the planner (`roge_jax.planning`) makes a plan; its FLOPs include those of planning.
Beside it stand controls that cost no more, never more:
  fixed    one plan for all scenes of a tolerance. Its budget is the mean of what the planner spends on them, planning
           included; within it, the plan whose predicted error (same table, mean over the scenes, each taken as one of
           an average kind) is least. Photos spread (farthest point), generated frames in the middle
  random   a plan drawn for each scene from all whose cost is within 15 % below the planner's, photos and the place of
           the generated frames drawn too
  uniform  for each scene, the most photos that the planner's cost pays for, evenly spread, steps cut by the same
           factor, uniform sigma grid; where that does not pay for a generated video the RGB head alone, where not for
           that either, the head at half size
A control without a plan of that cost is null in the document and left out of the comparison, which counts such pairs.
Errors are RMS colour differences, to the full model's frames (what the tolerance is about) and to the truth.
The published system has no such chart. Our numbers: docs/results/planning.md.
"""

import dataclasses
import json
import time

import jax
import numpy as np

from experiments import harness
from experiments.planning import report
from experiments.planning.runs import RUNGS, Engine, LadderScene, fit, make, rms, turn_knobs
from roge_jax import checkpoint
from roge_jax.files import entry
from roge_jax.planning import options, proxies, stretches, table
from roge_jax.planning.plan import plan
from roge_jax.scenes import coverage
from roge_jax.scenes.scene import select_context
from roge_jax.video import solvers

TRAIN_SEED = 500_000  # training seeds that no shipped pool used
TOLERANCES = (0.01, 0.02, 0.03, 0.04, 0.06, 0.08)


def provenance(scenes: int, params) -> dict:
    return {
        "command": " ".join(harness.command()),
        "scenes": scenes,
        "commit": entry.git_commit(),
        "weights": checkpoint.weights_fingerprint(params, "float32"),
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
    origin = provenance(scenes, engine.params) | {
        "seeds": [TRAIN_SEED, TRAIN_SEED + scenes - 1],
        "model": "the shipped mini",
        "full": [engine.settings.solver, engine.settings.schedule, engine.settings.steps],
        "full_to_truth": float(np.mean([row["full_to_truth"] for row in rows])),
        "head_to_truth": float(np.mean([row["head_to_truth"] for row in rows])),
    }
    document = harness.read(table.FILE, absent={})
    harness.write(table.FILE, document | {engine.config.name: fit(rows, origin)})
    harness.write("plan_calibration.json", rows)
    print(f"wrote {table.FILE}")


# ---- the ladder ------------------------------------------------------------------------------------


def every_option(engine: Engine, scene: LadderScene, measured: dict, constants) -> list:
    size = (engine.config.height, engine.config.width)
    worth = coverage.coverage(scene.photos.cameras, scene.path, *size)
    return options.list_options(
        scene.photos, engine.config, scene.path, engine.settings, constants, measured, worth
    )


def shape(choices) -> tuple:
    """Choices without saying which photos and which frames: what a plan for all scenes can fix."""
    return (len(choices.photos), choices.generated, *(getattr(choices, f) for f in FIELDS))


FIELDS = ("steps", "solver", "schedule", "recon", "merge", "frames")


def placed(engine: Engine, choices, rng=None) -> tuple:
    """`Choices.generate` with a stretch as long as that of `choices` in the middle of the window, or anywhere."""
    if not choices.generated:
        return (None,)
    places = stretches.places((0, engine.config.frames), choices.generated)
    return (places[len(places) // 2 if rng is None else rng.integers(len(places))],)


def fixed_plan(listed: list[list], budget: float):
    """The shape within `budget` whose predicted error, the mean over scenes of an average kind, is least; or None."""
    errors: dict[tuple, list[float]] = {}
    for scene_options in listed:
        for o in scene_options:
            if o.flops <= budget * report.ROUNDING:
                errors.setdefault(shape(o.choices), []).append(o.error)
    full = {k: v for k, v in errors.items() if len(v) == len(listed)}
    if not full:
        return None
    best = min(full, key=lambda k: (np.mean(full[k]), k[0], k[2]))
    return next(o.choices for o in listed[0] if shape(o.choices) == best)


def random_plan(engine: Engine, scene: LadderScene, listed: list, budget: float, rng):
    """A plan drawn from those within 15 % below the budget, or the nearest below; its photos and frames drawn too."""
    within = [o for o in listed if o.flops <= budget * report.ROUNDING]
    if not within:
        return None
    near = [o for o in within if o.flops >= 0.85 * budget] or [max(within, key=lambda o: o.flops)]
    drawn = near[rng.integers(len(near))]
    photos = rng.permutation(len(scene.photos.ids))[: len(drawn.choices.photos)].tolist()
    generate = placed(engine, drawn.choices, rng)
    return drawn.flops, dataclasses.replace(
        drawn.choices, photos=tuple(sorted(photos)), generate=generate
    )


def uniform_plans(engine: Engine, scene: LadderScene) -> list:
    """(FLOPs, choices), best first: photos and steps cut by one factor; then the RGB head, then at half size too."""
    price = options.Prices(engine.config, engine.settings, engine.config.frames)
    everything, steps = len(scene.photos.ids), engine.settings.steps
    counts = range(everything, 0, -1)
    spread = {m: tuple(int((i + 0.5) * everything / m) for i in range(m)) for m in counts}
    made = [
        engine.choices(
            scene, photos=spread[m], steps=max(1, round(steps * m / everything)), schedule="uniform"
        )
        for m in counts
    ]
    small = proxies.half_size(engine.config)
    sizes = [{}] + [{"recon": (small.recon_height, small.recon_width)}] * bool(small)
    made += [
        engine.choices(scene, photos=spread[m], generate=(None,), **size)
        for size in sizes
        for m in counts
    ]
    return [(price(c, solvers.nfe(c.solver, c.steps)), c) for c in made]


def best_within(plans: list, budget: float):
    """The first of (FLOPs, choices) that costs no more than `budget`, or None."""
    return next((p for p in plans if p[0] <= budget * report.ROUNDING), None)


def climb(engine: Engine, scenes: list[LadderScene]) -> dict:
    """All plans of all scenes, with predicted and realised errors."""
    constants = table.load(engine.config.name)
    plans = [
        [
            plan(
                engine.params,
                engine.config,
                scene.photos,
                scene.path,
                tolerance=tolerance,
                compiled=engine.programs,
            )
            for tolerance in TOLERANCES
        ]
        for scene in scenes
    ]
    average = [every_option(engine, scene, {}, constants) for scene in scenes]
    fixed = [
        fixed_plan(average, float(np.mean([spent(made) for made in column])))
        for column in zip(*plans, strict=True)
    ]
    rows = []
    for scene, listed, made in zip(scenes, average, plans, strict=True):
        began = time.process_time()
        rows.append(run_scene(engine, scene, listed, made, fixed))
        scene.kept.clear()
        print(f"{time.process_time() - began:.0f} s {scene.rung} {scene.seed}", flush=True)
    return {"rows": rows}


def run_scene(engine: Engine, scene: LadderScene, listed: list, made: list, fixed: list) -> dict:
    """The planner's plans of one scene and the controls beside each: a row of the document."""
    price = {shape(o.choices): o.flops for o in listed}
    full = engine.choices(scene)
    reference = engine.run(scene, full)
    head = engine.choices(scene, generate=(None,))
    rng = np.random.default_rng(scene.seed)
    uniform = uniform_plans(engine, scene)

    def measured(found) -> dict | None:
        if found is None:
            return None
        flops, choices = found
        frames = engine.run(scene, choices)
        return {
            "flops": flops,
            "full": rms(frames, reference),
            "truth": rms(frames, scene.truth),
            "photos": list(choices.photos),
            "generate": list(choices.generate),
            "generated": choices.generated / len(scene.path),
            **fields(choices),
        }

    plans = []
    for own, some in zip(made, fixed, strict=True):
        budget = spent(own)
        one = None
        if some is not None:
            photos = tuple(select_context(scene.photos.cameras, len(some.photos)))
            where = placed(engine, some)
            one = engine.choices(scene, photos=photos, generate=where, **fields(some))
            one = price[shape(some)], one
        entry = {"tolerance": own.tolerance, "predicted": own.predicted_error}
        entry["planning_flops"] = own.planning_cost
        entry["planner"] = measured((budget, own.choices))
        entry["fixed"] = measured(one)
        entry["random"] = measured(random_plan(engine, scene, listed, budget, rng))
        entry["uniform"] = measured(best_within(uniform, budget))
        plans.append(entry)
    return {
        "rung": scene.rung,
        "seed": scene.seed,
        "bits_per_pixel": scene.bits,
        "full": {"flops": price[shape(full)], "truth": rms(reference, scene.truth)},
        "head": {
            "flops": price[shape(head)],
            "full": rms(engine.run(scene, head), reference),
            "truth": rms(engine.run(scene, head), scene.truth),
        },
        "plans": plans,
    }


def spent(made) -> float:
    return made.predicted_cost + made.planning_cost


def fields(choices) -> dict:
    return {f: getattr(choices, f) for f in FIELDS}


def main() -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("scenes", nargs="?", type=int, default=4, help="scenes per rung")
    parser.add_argument("--calibrate", type=int, metavar="SCENES", help="measure the table instead")
    parser.add_argument(
        "--draw", action="store_true", help="summary, picture and table of stored rows"
    )
    args = parser.parse_args()
    if not args.draw:
        engine = Engine(*checkpoint.load_model("mini"))
        if args.calibrate:
            return calibrate(engine, args.calibrate)
        seeds = harness.heldout(args.scenes)
        document = climb(engine, [make(r, seed, engine.config) for seed in seeds for r in RUNGS])
        document["provenance"] = provenance(len(document["rows"]), engine.params)
        document["provenance"]["table"] = table.load("mini").provenance
    else:
        document = harness.read("plan_ladder.json")
    document["summary"] = report.summarise(document["rows"])
    harness.write("plan_ladder.json", document)
    report.draw(document, "plan_ladder.png")
    page = harness.DOCS / "results" / "planning.md"
    harness.put(page, "plan_ladder", report.table(document["summary"]))
    print(f"wrote plan_ladder.json, its picture and the table of {page}")
    print(report.words(document["summary"]))


if __name__ == "__main__":
    main()
