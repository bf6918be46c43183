"""What `plan_ladder.py` measured, in numbers, words and one picture."""

import numpy as np
from plan_runs import RUNGS

CONTROLS = ("fixed", "random", "uniform")
COLOURS = {"planner": "#0072B2", "fixed": "#D55E00", "random": "#999999", "uniform": "#009E73"}
MARKS = {"planner": "o", "fixed": "s", "random": "x", "uniform": "^"}
SLACK = 1.02  # errors within 2 % count as equal


def points(rows: list[dict], method: str, against: str = "full") -> np.ndarray:
    """[scenes, tolerances, 2]: GFLOP and RMS error."""
    return np.array(
        [[[p[method]["flops"] / 1e9, p[method][against]] for p in row["plans"]] for row in rows]
    )


def needed(points: np.ndarray, full: float, error: float) -> float:
    """GFLOP of the cheapest of a scene's points [k, 2] within `error`; the full model's if none is."""
    good = points[points[:, 1] <= error * SLACK]
    return float(min(good[:, 0].min(), full)) if len(good) else full


def spearman(x: np.ndarray, y: np.ndarray) -> float:
    from scipy.stats import spearmanr

    return float(spearmanr(x, y).statistic)


def summarise(rows: list[dict]) -> dict:
    """All that is said about the ladder; ratios above 1 favour the planner."""
    full = np.array([row["full"]["flops"] / 1e9 for row in rows])
    planner = points(rows, "planner")
    tolerances = [p["tolerance"] for p in rows[0]["plans"]]
    predicted = np.array([[p["predicted"] for p in row["plans"]] for row in rows])
    realised = planner[..., 1]
    free = predicted > 0  # the full model itself is no prediction
    rank = [np.argsort(np.argsort(v[free])) for v in (predicted, realised)]
    within = realised <= np.array(tolerances)[None]
    out: dict = {
        "scenes": len(rows),
        "spearman": spearman(predicted[free], realised[free]) if free.sum() > 2 else None,
        "spearman_by_tolerance": {
            str(t): spearman(predicted[:, i], realised[:, i])
            for i, t in enumerate(tolerances)
            if np.ptp(predicted[:, i]) > 0 and np.ptp(realised[:, i]) > 0
        },
        "points": len(rank[0]),
        "realised_over_predicted": np.quantile(
            realised[free] / predicted[free], (0.1, 0.5, 0.9)
        ).tolist(),
        "within_tolerance": {str(t): float(within[:, i].mean()) for i, t in enumerate(tolerances)},
        "worst_violation": float((realised / np.array(tolerances)[None]).max()),
        "compute_saved": {
            str(t): np.quantile(full / planner[:, i, 0], (0.25, 0.5, 0.75)).tolist()
            for i, t in enumerate(tolerances)
        },
    }
    truth = points(rows, "planner", "truth")
    made = np.array([[any(p["planner"]["generate"]) for p in row["plans"]] for row in rows])
    for key, some in (("", np.ones_like(made)), ("_by_generated_video", made)):
        equal = [
            full[i] / needed(truth[i][some[i]], full[i], row["full"]["truth"])
            for i, row in enumerate(rows)
        ]
        out["saved_at_the_full_models_error_to_truth" + key] = {
            "median_scene": float(np.median(equal)),
            "worst_scene": float(np.min(equal)),
        }
    for name in CONTROLS:
        other = points(rows, name)
        ratios = [
            needed(other[i], full[i], realised[i, k]) / planner[i, k, 0]
            for i in range(len(rows))
            for k in range(len(tolerances))
            if planner[i, k, 0] < 0.999 * full[i]
        ]
        if not ratios:
            continue
        worse = [
            float(np.median(other[:, k, 1] / np.maximum(realised[:, k], 1e-9)))
            for k in range(len(tolerances))
            if (planner[:, k, 0] < 0.999 * full).all()
        ]
        out[name] = {
            "compute_for_the_planners_error": np.quantile(ratios, (0.5, 0.25, 0.75)).tolist(),
            "planner_beats_it": float(np.mean(np.array(ratios) > 1 / 0.999)),
            "error_at_equal_cost": worse,
            "error_to_truth_at_equal_cost": float(
                np.median(points(rows, name, "truth")[..., 1] / truth[..., 1])
            ),
        }
    return out


def words(summary: dict) -> str:
    key = "saved_at_the_full_models_error_to_truth"
    saved, made = summary[key], summary[key + "_by_generated_video"]
    low, middle, high = summary["realised_over_predicted"]
    lines = [
        f"{summary['scenes']} scenes. Predicted against realised error: Spearman {summary['spearman']:.2f} over "
        f"{summary['points']} plans, realised / predicted {middle:.2f} [{low:.2f}, {high:.2f}]",
        f"At the full model's error to the truth the median scene takes {saved['median_scene']:.2f} times less compute "
        f"({made['median_scene']:.2f} times if the video must be generated)",
    ]
    told = []
    for name in CONTROLS:
        if name in summary:
            ratio, low, high = summary[name]["compute_for_the_planners_error"]
            verdict = "beaten" if ratio > 1.01 else "NOT beaten"
            told.append(f"{name} {ratio:.2f} [{low:.2f}, {high:.2f}] ({verdict})")
    lines.append(
        "Compute that controls need for the planner's error, times its own: " + ", ".join(told)
    )
    return "\n".join(lines)


def draw(document: dict, file) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import matplotlib.ticker

    rows, summary = document["rows"], document["summary"]
    rungs = [r for r in RUNGS if any(row["rung"] == r for row in rows)]
    tolerances = [p["tolerance"] for p in rows[0]["plans"]]
    figure, axes = plt.subplots(2, 2, figsize=(12, 9), layout="constrained")
    place = {r: i for i, r in enumerate(rungs)}
    bits = [np.mean([row["bits_per_pixel"] for row in rows if row["rung"] == r]) for r in rungs]
    names = [f"{r}\n{b:.1f} bit/px" for r, b in zip(rungs, bits, strict=True)]

    ax = axes[0, 0]
    shades = plt.get_cmap("viridis")(np.linspace(0.05, 0.85, len(tolerances)))
    for k, tolerance in enumerate(tolerances):
        cost = points(rows, "planner")[:, k, 0]
        _spread(
            ax, rows, place, cost, f"tolerance {tolerance:g}", shades[k], "o", k, len(tolerances)
        )
    full = np.median([row["full"]["flops"] / 1e9 for row in rows])
    ax.axhline(full, color="k", lw=1, ls="--", label="full model")
    ax.axhline(full / 2, color="k", lw=0.8, ls=":", label="half of it")
    ax.set(title="What the planner spends", ylabel="compute with planning, GFLOP", yscale="log")
    low = min(4.0, 0.8 * points(rows, "planner")[..., 0].min())
    ticks = [t for t in (2, 5, 10, 20, 40, 80, 160, 320, 640) if low < t < 1.6 * full]
    ax.set_yticks(ticks, [f"{t}" for t in ticks])
    ax.set_yticks([], minor=True)
    ax.set_ylim(low, 4 * full)

    for ax, against, title in (
        (axes[0, 1], "full", "Error to the full model at equal compute"),
        (axes[1, 0], "truth", "Error to the truth at equal compute"),
    ):
        chosen = _middle(rows, tolerances)
        for j, name in enumerate(("planner", *CONTROLS)):
            error = points(rows, name, against)[:, chosen, 1]
            _spread(ax, rows, place, error, name, COLOURS[name], MARKS[name], j, 4)
        if against == "truth":
            truth = np.array([row["full"]["truth"] for row in rows])
            for r, i in place.items():
                at = np.median(truth[[row["rung"] == r for row in rows]])
                label = "full model" if i == 0 else None
                ax.plot([i - 0.4, i + 0.4], [at, at], "k--", lw=1, label=label)
        else:
            ax.axhline(tolerances[chosen], color="k", lw=1, ls="--", label="tolerance")
        ax.set(ylabel="RMS colour error", title=f"{title} (tolerance {tolerances[chosen]:g})")
        ax.set_ylim(0, 1.3 * ax.get_ylim()[1])

    for ax in (axes[0, 0], axes[0, 1], axes[1, 0]):
        ax.set_xticks(range(len(rungs)), names, fontsize=8)
        ax.set_xlabel("rung (mean complexity of its photos)")
        ax.grid(axis="y", alpha=0.3)
        ax.legend(fontsize=8, ncols=3, loc="upper center")

    ax = axes[1, 1]
    low, high = 1.0, 0.0
    for k, tolerance in enumerate(tolerances):
        x = [row["plans"][k]["predicted"] for row in rows]
        y = [row["plans"][k]["planner"]["full"] for row in rows]
        ax.plot(x, y, "o", ms=5, alpha=0.8, color=shades[k], label=f"tolerance {tolerance:g}")
        low, high = min([low, *[v for v in [*x, *y] if v > 0]]), max([high, *x, *y])
    ax.plot([low, high], [low, high], "k-", lw=1, label="equal")
    ax.plot([low, high], [2 * low, 2 * high], "k:", lw=0.8, label="factor 2")
    ax.plot([low, high], [low / 2, high / 2], "k:", lw=0.8)
    ax.set(xscale="log", yscale="log", xlabel="predicted RMS error", ylabel="realised RMS error")
    ax.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
    ax.set_title(f"Prediction: Spearman {summary['spearman']:.2f} over {summary['points']} plans")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    figure.suptitle(words(summary), fontsize=9)
    figure.savefig(file, dpi=90)
    plt.close(figure)


def _middle(rows, tolerances) -> int:
    """The tolerance whose plans cost nearest to half of the full model: where there is most to choose."""
    full = np.median([row["full"]["flops"] / 1e9 for row in rows])
    cost = np.median(points(rows, "planner")[..., 0], 0)
    return int(np.argmin(np.abs(np.log(cost / (0.5 * full)))))


def _spread(ax, rows, place, values, label, colour, mark, k, count) -> None:
    """Median and range over the scenes of every rung, beside one another."""
    shift = (k - (count - 1) / 2) * 0.7 / count
    for rung, i in place.items():
        mine = values[[row["rung"] == rung for row in rows]]
        name = label if i == 0 else None
        ax.plot(i + shift, np.median(mine), mark, color=colour, ms=5, label=name)
        ax.plot([i + shift] * 2, [mine.min(), mine.max()], "-", color=colour, lw=1.2)
