"""Training under stress: does the loop survive bad batches, spikes, a wrong lambda, bfloat16, a tenfold learning rate?

    OPENBLAS_NUM_THREADS=1 python -m experiments.stability.train_stress            # results/train_stress.{json,png}

CPU, one process: a minute or two a trial, most of it compilation. The `tiny` model from random weights, its joint stage (everything but
the VAE trains) and LoRA, AdamW 1e-3, clip 1, 2 scenes of 2 photos and 5 targets a step, 120 steps, seed 0, 8 procedural
training scenes rendered at 32x48. The loop is the package's own with its limits as they are (10 bad steps in a row, 1 %
after step 100), but for a patience of 30 steps instead of 200. A run *survives* if it takes all steps and its median flow
loss over the last 30 steps is within 10 % of its undisturbed run's; it *stops* if the loop ends it, with the reason;
what does neither is *harmed*. The published system reports nothing of the kind. Our numbers: docs/results/training.md.
"""

import dataclasses
import functools
import json
import math
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"

import jax
import jax.numpy as jnp
import numpy as np

from experiments import harness
from roge_jax import model
from roge_jax.config import preset
from roge_jax.core.params import init as init_specs
from roge_jax.data.views import ViewConfig
from roge_jax.errors import UserError
from roge_jax.files import entry
from roge_jax.procedural.scenes import sample_sequence
from roge_jax.training import loop as training
from roge_jax.training import stages
from roge_jax.training.optim import OptimConfig

STEPS, SCENES, SEED, LAST, DIGITS = 120, 8, 0, 30, 4
TINY = preset(
    "tiny"
)  # with cross attention as in `mini`, all views in one chunk: half the compilation
CONFIG = dataclasses.replace(
    TINY, renderer=dataclasses.replace(TINY.renderer, attention="cross", chunk=8)
)
OPTIM = OptimConfig(learning_rate=1e-3, warmup=10)
LOOP = training.LoopConfig(steps=STEPS, seed=SEED, log_every=1, save_every=60, keep=1, patience=30)
VIEWS = ViewConfig(contexts=(2,), context_weights=(1.0,), targets=CONFIG.frames, ordered=True)
JOINT = stages.Stage(
    "joint", "joint", "^(dit|fusion|encoder|renderer)/", STEPS, 2, OPTIM, VIEWS, remat="none"
)
LORA = dataclasses.replace(JOINT, name="lora", trains=model.NEW_EMBEDDINGS, lora=True)

Alter = Callable[[int, dict], dict]  # (step, batch) -> batch


class Trial(NamedTuple):
    title: str
    alter: Alter = lambda i, batch: batch
    rate: float = 1.0  # times the learning rate
    photometric: float = 1.0  # times lambda
    stage: stages.Stage = JOINT
    frozen: Any = jnp.float32
    trained: Any = jnp.float32
    against: str = "plain"


def at(steps, change: Callable[[np.ndarray], np.ndarray]) -> Alter:
    """Photos and targets of these steps changed."""

    def alter(i, batch):
        if i not in steps:
            return batch
        return {k: change(x) if k.endswith("_rgb") else x for k, x in batch.items()}

    return alter


def nan_pixel(x: np.ndarray) -> np.ndarray:
    """One pixel of one picture of the batch."""
    x = x.copy()
    x[0, 0, 3, 5, 1] = np.nan
    return x


TRIALS = {
    "plain": Trial("plain run"),
    "nan_rare": Trial("a NaN pixel in 1 batch of 120", at({60}, nan_pixel)),
    "nan_often": Trial("a NaN pixel in every 30th batch", at(set(range(20, 120, 30)), nan_pixel)),
    "nan_streak": Trial("NaN in every batch from step 50", at(set(range(50, 120)), nan_pixel)),
    "constant": Trial("every 5th batch black", at(set(range(0, 120, 5)), np.zeros_like)),
    "spikes": Trial("5 batches times 1000", at(set(range(15, 110, 20)), lambda x: 1e3 * x)),
    "pose": Trial("one infinite pose in the data"),
    "lambda": Trial("lambda times 100", photometric=100.0),
    "rate": Trial("learning rate times 10", rate=10.0),
    "bf16": Trial("all weights bfloat16, trained ones too", frozen=jnp.bfloat16, trained=jnp.bfloat16),
    "lora": Trial("LoRA on float32 weights", stage=LORA, against="lora"),
    "lora_bf16": Trial("LoRA on bfloat16 weights", stage=LORA, frozen=jnp.bfloat16, against="lora"),
}  # fmt: skip


@functools.cache
def scenes() -> tuple[dict, ...]:
    size = {"height": CONFIG.height, "width": CONFIG.width}
    return tuple(
        sample_sequence(i, frames=12, supersample=1, depth=False, **size) for i in range(SCENES)
    )


def pool(name: str) -> list[dict]:
    found = list(scenes())
    if name == "pose":
        c2w = found[5]["c2w"].copy()
        c2w[:, 0, 3] = np.inf
        found[5] = found[5] | {"c2w": c2w}
    return found


def parts(trial: Trial):
    """(trainable, frozen, specs of the trainable) from the same random weights in every trial."""
    params = model.init(jax.random.key(SEED), CONFIG)
    trainable, frozen = model.split(params, trial.stage.trains)
    specs, _ = model.split(model.specs(CONFIG), trial.stage.trains)
    if trial.stage.lora:
        from roge_jax.core.lora import attach

        added = stages.new_leaves(CONFIG, trial.stage)
        trainable = attach(trainable, init_specs(jax.random.key(SEED + 1), added))
        specs = attach(specs, added)
    if trial.frozen != jnp.float32:
        from roge_jax.training.start import place_frozen

        frozen = place_frozen(frozen, "bfloat16")
    trainable = jax.tree.map(lambda x: x.astype(trial.trained), trainable)
    return trainable, frozen, specs


def weighed(trainable, frozen, batch, key, *, config, stage):
    """The joint objective with lambda times `batch["heavier"]`: a number of the data, so that trials share a program."""
    views = {k: x for k, x in batch.items() if k != "heavier"}
    total, terms = stages.joint_objective(trainable, frozen, views, key, config=config, stage=stage)
    extra = batch["heavier"].mean() - 1.0
    return total + extra * config.flow.photometric * terms["photometric"], terms


def run(name: str, trial: Trial, folder: Path) -> dict[str, Any]:
    """One trial: the log of every step, and how it ended."""
    config = stages.stage_config(CONFIG, trial.stage)
    optim = dataclasses.replace(OPTIM, learning_rate=trial.rate * OPTIM.learning_rate)
    trainable, frozen, specs = parts(trial)
    data = pool(name)

    def batches(i):
        batch = trial.alter(i, stages.stage_batch(data, trial.stage, config, SEED, i))
        return batch | {"heavier": np.full(trial.stage.batch, trial.photometric, np.float32)}

    objective = functools.partial(weighed, config=config, stage=trial.stage)
    began, reason = time.perf_counter(), None
    try:
        training.train(
            objective, trainable, frozen, specs, batches, optim=optim, loop=LOOP, out=folder / name
        )  # fmt: skip
    except (training.TrainingStopped, UserError) as error:
        reason = str(error).partition(" The last good checkpoint")[0]
    rows = [json.loads(line) for line in (folder / name / "log.jsonl").read_text().splitlines()]
    skipped = np.diff([0, *(row["skipped"] for row in rows)])
    curves = {k: [row[k] for row in rows] for k in ("flow", "photometric", "grad_norm")}
    return {
        "title": trial.title,
        "against": trial.against,
        "steps": len(rows),
        "stopped": reason,
        "skipped_steps": [int(i) for i in np.flatnonzero(skipped)],
        "seconds": round(time.perf_counter() - began, 1),
        "curves": curves,
        "end": {k: tail(v) for k, v in curves.items()},
    }


def tail(values: list) -> float:
    """The median of the last steps that were not skipped: a batch altered among them does not count."""
    finite = [v for v in values[-LAST:] if v is not None and math.isfinite(v)]
    return float(np.median(finite)) if finite else math.nan


def verdict(result: dict, plain: dict) -> str:
    if result["stopped"]:
        return "stops"
    if result is plain:
        return "reference"
    return "survives" if result["end"]["flow"] <= 1.1 * plain["end"]["flow"] else "harmed"


def smooth(values, width: int = 11) -> np.ndarray:
    """The median of the last `width` values that are finite: single spikes do not show in it."""
    values = np.array(values, float)
    out = np.full(len(values), np.nan)
    for i in range(len(values)):
        finite = values[: i + 1][np.isfinite(values[: i + 1])][-width:]
        out[i] = np.median(finite) if len(finite) else np.nan
    return out


def draw(results: dict[str, dict]) -> None:
    plt = harness.pyplot()
    shown = [name for name in results if name not in ("plain", "lora")]
    columns = 4
    rows = -(-len(shown) // columns)
    fig, axes = plt.subplots(rows, columns, figsize=(16, 3.5 * rows + 0.6), sharex=True)
    terms = {"flow": "#1f77b4", "photometric": "#ff7f0e"}
    for ax, name in zip(axes.flat, shown, strict=False):
        result = results[name]
        plain = results[result["against"]]
        for term, colour in terms.items():
            steps = np.arange(1, STEPS + 1)
            ax.plot(
                steps[: plain["steps"]], smooth(plain["curves"][term]), "--", color="0.45", lw=1
            )
            mine = np.array(result["curves"][term], float)  # None becomes NaN
            ax.plot(steps[: len(mine)], mine, color=colour, alpha=0.3, lw=0.8)
            ax.plot(steps[: len(mine)], smooth(mine), color=colour, lw=1.6)
        for step in result["skipped_steps"]:
            ax.axvline(step + 1, color="#d62728", lw=1, alpha=0.6, zorder=0)
        word = result["verdict"]
        if result["stopped"]:
            ax.axvspan(result["steps"], STEPS, color="0.88", zorder=0)
        colour = {"survives": "#2ca02c", "stops": "#d62728", "harmed": "#b8860b"}[word]
        ax.text(
            0.97, 0.95, f"{word}" + (f" at step {result['steps']}" if result["stopped"] else ""),
            transform=ax.transAxes, ha="right", va="top", color=colour, fontsize=10,
            bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none"},
        )  # fmt: skip
        ax.set(title=TRIALS[name].title, yscale="log", xlim=(0, STEPS))
    for ax in axes.flat[len(shown) :]:
        ax.axis("off")
    for i, ax in enumerate(axes.flat[: len(shown)]):
        if i + columns >= len(shown):
            ax.set_xlabel("step")
            ax.xaxis.set_tick_params(labelbottom=True)
        if i % columns == 0:
            ax.set_ylabel("loss term")
    handles = [plt.Line2D([], [], color=c, lw=2) for c in terms.values()]
    handles += [plt.Line2D([], [], color="0.45", ls="--"), plt.Line2D([], [], color="#d62728")]
    names = [
        "flow (pale: every step, else median of 11)",
        "photometric",
        "undisturbed run",
        "skipped step",
    ]
    fig.legend(handles, names, loc="lower center", ncol=4)
    fig.tight_layout(rect=(0, 0.22 / fig.get_figheight() + 0.02, 1, 1))
    harness.save(fig, "train_stress.png")


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument(
        "--only",
        nargs="+",
        choices=TRIALS,
        default=list(TRIALS),
        help="these trials and their references; of the others the stored ones stay, if the references are as they were",
    )
    p.add_argument("--draw", action="store_true", help="only draw the stored results again")
    args = p.parse_args()
    if args.draw:
        stored = harness.read("train_stress.json")
        for name, one in stored["trials"].items():
            one["title"] = TRIALS[name].title
            one["end"] = {k: tail(v) for k, v in one["curves"].items()}
            one["verdict"] = verdict(one, stored["trials"][one["against"]])
            print(f"{name}: {one['verdict']}, {one['end']}, {one['stopped']}")
        harness.write("train_stress.json", stored, digits=DIGITS)
        return draw(stored["trials"])
    chosen = ["plain", *args.only]
    chosen += ["lora"] if "lora_bf16" in chosen else []
    entry.enable_cache()
    began = time.perf_counter()
    results: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in (name for name in TRIALS if name in chosen):
            results[name] = one = run(name, TRIALS[name], Path(folder))
            one["verdict"] = verdict(one, results[one["against"]])
            one["commit"] = entry.git_commit()
            print(
                f"{name}: {one['verdict']}, flow {one['end']['flow']:.3g}, photometric "
                f"{one['end']['photometric']:.3g}, {one['seconds']} s. {one['stopped'] or ''}",
                flush=True,
            )
            write(with_stored(results), time.perf_counter() - began)
    print(f"{time.perf_counter() - began:.0f} s")


def with_stored(results: dict[str, dict]) -> dict[str, dict]:
    """The trials and those of earlier runs whose reference ended within 1 % of where it ends now, in their order."""
    stored = harness.read("train_stress.json", absent={"trials": {}})["trials"]

    def comparable(one: dict) -> bool:
        then, now = stored.get(one["against"]), results.get(one["against"])
        if then is None or now is None:
            return False
        return abs(then["end"]["flow"] / now["end"]["flow"] - 1.0) < 0.01

    kept = {name: one for name, one in stored.items() if name not in results and comparable(one)}
    return {name: (results | kept)[name] for name in TRIALS if name in results | kept}


def write(results: dict[str, dict], seconds: float) -> None:
    """The trials so far, as JSON and PNG."""
    document = {
        **harness.environment(),
        "settings": {
            "model": CONFIG.name,
            "steps": STEPS,
            "seed": SEED,
            "loop": dataclasses.asdict(LOOP),
            "optim": dataclasses.asdict(OPTIM),
            "scenes": SCENES,
            "batch": JOINT.batch,
        },
        "seconds_of_last_run": round(seconds, 1),
        "trials": results,
    }
    harness.write("train_stress.json", document, digits=DIGITS)
    if len(results) > 1:
        draw(results)


if __name__ == "__main__":
    main()
