"""Losses and held-out results of the stages that made a model, from the logs that `train` wrote, as one small file and chart.

    python -m experiments.quality.training_curves LABEL=runs/x/recon LABEL=runs/x/lookup ...
    python -m experiments.quality.training_curves --add LABEL=runs/y/lookup        those behind the stored ones
    python -m experiments.quality.training_curves --draw        the chart again, from results/training_curves.json

Folders in the order of training, each with the log.jsonl of one stage; panels are the stages, by the folders' names.
Rows are means over a fiftieth of a run. Results: experiments/results/training_curves.{json,png}; the shipped model's
are described in docs/notes/making_mini.md.
"""

import json
import math
from pathlib import Path

from experiments import harness

ROWS = 50  # of a run, at most
KEPT = ("loss", "grad_norm", "psnr", "psnr_photos", "flow", "photometric")


def thinned(log: list[dict]) -> list[dict]:
    """Rows of a log as means over at most `ROWS` equal parts; `step` is the last of a part, held-out results are kept."""
    size = math.ceil(len(log) / ROWS)
    rows = []
    for i in range(0, len(log), size):
        part = log[i : i + size]
        row = {"step": part[-1]["step"]}
        for name in KEPT:
            values = [x[name] for x in part if isinstance(x.get(name), float | int)]
            if values:
                row[name] = sum(values) / len(values)
        for x in part:
            row |= {k: v for k, v in x.items() if k.startswith("held_")}
        rows.append(row)
    return rows


def collect(named: list[str]) -> list[dict]:
    """The runs of LABEL=FOLDER arguments, in their order."""
    runs = []
    for text in named:
        label, _, folder = text.rpartition("=")
        log = Path(folder) / "log.jsonl"
        lines = log.read_text().splitlines()
        rows = thinned([json.loads(line) for line in lines])
        runs.append({"stage": Path(folder).name, "label": label, "rows": rows})
    return runs


def draw(runs: list[dict], file: str | Path = "training_curves.png") -> None:
    plt = harness.pyplot()
    stages = list(dict.fromkeys(run["stage"] for run in runs))
    columns = math.ceil(len(stages) / 2)
    figure, axes = plt.subplots(2, columns, figsize=(3.4 * columns, 5.6), squeeze=False)
    for stage, axis in zip(stages, axes.flat, strict=False):
        begun = 0
        for i, run in enumerate(r for r in runs if r["stage"] == stage):
            steps = [begun + row["step"] for row in run["rows"]]
            colour = f"C{i}"
            losses = [row.get("loss", math.nan) for row in run["rows"]]
            axis.plot(steps, losses, color=colour, lw=1, label=run["label"] or None)
            held = [(s, r["held_loss"]) for s, r in zip(steps, run["rows"]) if "held_loss" in r]
            if held:
                axis.plot(*zip(*held), "o", ms=3.5, color=colour, mec="black", mew=0.5)
            begun = steps[-1]
        axis.set(title=stage, xlabel="steps", yscale="log")
        axis.legend(fontsize=6)
    for axis in axes.flat[len(stages) :]:
        axis.axis("off")
    axes[0, 0].set_ylabel("loss; dots: held out")
    figure.tight_layout()
    harness.save(figure, file, dpi=110)


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("folders", nargs="*", metavar="LABEL=FOLDER")
    p.add_argument("--draw", action="store_true", help="only the chart, from the stored numbers")
    p.add_argument("--add", action="store_true", help="keep the stored runs, and add these")
    args = p.parse_args()
    if args.draw == bool(args.folders) or (args.draw and args.add):
        p.error("give the folders of the stages, or --draw")
    if args.folders:
        before = harness.read("training_curves.json")["runs"] if args.add else []
        runs = before + collect(args.folders)
        harness.write("training_curves.json", {"runs": runs}, digits=4)
    draw(harness.read("training_curves.json")["runs"])


if __name__ == "__main__":
    main()
