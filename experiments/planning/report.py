"""What `ladder.py` measured, in numbers, words, a table and one picture.

A control is compared with the planner in two ways, pair by pair of scene and tolerance, where it has a plan that costs
no more than the planner's (`affordable`); all other pairs are left out and counted.
  error    control minus planner, RMS colour difference to the full model, in parts of the tolerance
  compute  control minus planner, FLOPs to be within the tolerance (those of the plan; where it misses, those of the
           full model), in parts of the full model's
Above 0 the planner is better. It *beats* a control where the 95 % bootstrap interval of the mean over scenes is above 0;
fewer than `FEWEST` scenes decide nothing.
"""

import numpy as np

from experiments import harness
from experiments.planning.runs import RUNGS
from roge_jax.metrics import report

CONTROLS = ("fixed", "random", "uniform")
COLOURS = {"planner": "#0072B2", "fixed": "#D55E00", "random": "#999999", "uniform": "#009E73"}
MARKS = {"planner": "o", "fixed": "s", "random": "x", "uniform": "^"}
SLACK = 1.02  # errors to the truth within 2 % count as equal
FEWEST = 5  # scenes that an interval needs to decide anything
ROUNDING = 1 + 1e-9  # of sums of FLOPs
MARGINS = {"error": "error at no more compute", "compute": "compute within the tolerance"}
VERDICTS = {
    "planner": "beaten",
    "control": "**control better**",
    "neither": "**not beaten**",
    "too few": "too few scenes",
}


def points(rows: list[dict], method: str, against: str = "full") -> np.ndarray:
    """[scenes, tolerances, 2]: GFLOP and RMS error; NaN where the method has no plan."""
    plans = [[p[method] or {} for p in row["plans"]] for row in rows]
    return np.array(
        [[[p.get("flops", np.nan) / 1e9, p.get(against, np.nan)] for p in row] for row in plans]
    )


def affordable(rows: list[dict], name: str) -> np.ndarray:
    """[scenes, tolerances]: where a control costs no more than the planner; a fixed plan, in the mean over all scenes."""
    planner, own = points(rows, "planner")[..., 0], points(rows, name)[..., 0]
    if name == "fixed":
        return np.tile(own.mean(0) <= planner.mean(0) * ROUNDING, (len(rows), 1))
    return own <= planner * ROUNDING


def needed(points: np.ndarray, full: float, error: float) -> float:
    """GFLOP of the cheapest of a scene's points [k, 2] within `error`; the full model's if none is."""
    good = points[points[:, 1] <= error * SLACK]
    return float(min(good[:, 0].min(), full)) if len(good) else full


def spearman(x: np.ndarray, y: np.ndarray, fewest: int = 3) -> float | None:
    """None of fewer than `fewest` pairs, or where one side is constant."""
    from scipy.stats import spearmanr

    known = len(x) >= fewest and min(np.ptp(x), np.ptp(y)) > 0
    return float(spearmanr(x, y).statistic) if known else None


def judge(differences: np.ndarray) -> dict:
    """Mean over scenes with its interval (None: none), and who wins: planner, control, neither or too few."""
    found: dict = report.bootstrap(differences)
    low, high = found["low"], found["high"]
    found["wins"] = "planner" if low > 0 else "control" if high < 0 else "neither"
    if len(differences) < FEWEST:
        found["wins"] = "too few"
    return {k: None if v != v else v for k, v in found.items()}


def summarise(rows: list[dict]) -> dict:
    """All that is said about the ladder."""
    full = np.array([row["full"]["flops"] / 1e9 for row in rows])
    tolerances = np.array([p["tolerance"] for p in rows[0]["plans"]])
    predicted = np.array([[p["predicted"] for p in row["plans"]] for row in rows])
    realised = points(rows, "planner")[..., 1]
    free = predicted > 0  # the full model itself is no prediction
    out: dict = {
        "scenes": len(rows),
        "spearman": spearman(predicted[free], realised[free]),
        "spearman_by_tolerance": {
            f"{t:g}": spearman(predicted[some, i], realised[some, i], fewest=FEWEST)
            for i, (t, some) in enumerate(zip(tolerances, free.T, strict=True))
        },
        "points": int(free.sum()),
        "realised_over_predicted": np.quantile(
            realised[free] / predicted[free], (0.1, 0.5, 0.9)
        ).tolist(),
        "worst_violation": float((realised / tolerances[None]).max()),
    }
    truth = points(rows, "planner", "truth")
    made = np.array([[p["planner"]["generated"] == 1 for p in row["plans"]] for row in rows])
    for key, some in (("", np.ones_like(made)), ("_by_generated_video", made)):
        equal = [
            full[i] / needed(truth[i][some[i]], full[i], row["full"]["truth"])
            for i, row in enumerate(rows)
        ]
        out["saved_at_the_full_models_error_to_truth" + key] = {
            "median_scene": float(np.median(equal)),
            "worst_scene": float(np.min(equal)),
        }
    return out | _methods(rows, full, tolerances)


def _methods(rows: list[dict], full: np.ndarray, tolerances: np.ndarray) -> dict:
    """What every method spends and loses, and every control beside the planner."""
    by_tolerance: dict = {f"{t:g}": {} for t in tolerances}
    controls: dict = {}
    planner, own_truth = points(rows, "planner"), points(rows, "planner", "truth")[..., 1]
    for name in ("planner", *CONTROLS):
        own = points(rows, name)
        pairs = np.ones(own.shape[:2], bool) if name == "planner" else affordable(rows, name)
        # In parts of the tolerance and of the full model, so that tolerances and scenes can be averaged.
        margins = {
            "error": (own - planner)[..., 1] / tolerances[None],
            "compute": (_within(own, full, tolerances) - _within(planner, full, tolerances))
            / full[:, None],
        }
        for k, t in enumerate(tolerances):
            some = pairs[:, k]
            found = {"compared": int(some.sum()), "left_out": int((~some).sum())}
            if some.any():
                found |= {
                    "mean_gflop": float(own[some, k, 0].mean()),
                    "median_gflop": float(np.median(own[some, k, 0])),
                    "saved": float(np.median(full[some] / own[some, k, 0])),
                    "mean_error": float(own[some, k, 1].mean()),
                    "within": int((own[some, k, 1] <= t).sum()),
                }
                if name != "planner":
                    found["planners_mean_gflop"] = float(planner[some, k, 0].mean())
                    found |= {m: judge(v[some, k]) for m, v in margins.items()}
            by_tolerance[f"{t:g}"][name] = found
        if name == "planner":
            continue
        controls[name] = {"compared": int(pairs.sum()), "left_out": int((~pairs).sum())}
        if pairs.any():  # scenes are resampled: the tolerances of one are not independent
            scenes = [i for i in range(len(rows)) if pairs[i].any()]
            controls[name] |= {
                m: judge(np.array([v[i, pairs[i]].mean() for i in scenes]))
                for m, v in margins.items()
            }
            ratios = points(rows, name, "truth")[..., 1] / own_truth
            controls[name]["error_to_truth_over_the_planners"] = float(np.median(ratios[pairs]))
    return {"by_tolerance": by_tolerance, "controls": controls}


def _within(points: np.ndarray, full: np.ndarray, tolerances: np.ndarray) -> np.ndarray:
    """[scenes, tolerances]: GFLOP of a plan that is within the tolerance, the full model's of one that is not."""
    return np.where(points[..., 1] <= tolerances[None], points[..., 0], full[:, None])


# ---- words and tables ------------------------------------------------------------------------------


def words(summary: dict) -> str:
    key = "saved_at_the_full_models_error_to_truth"
    saved, made = summary[key], summary[key + "_by_generated_video"]
    low, middle, high = summary["realised_over_predicted"]
    lines = [
        f"{summary['scenes']} scenes. Predicted against realised error: {_rank(summary)}, "
        f"realised / predicted {middle:.2f} [{low:.2f}, {high:.2f}]",
        f"At the full model's error to the truth the median scene takes {saved['median_scene']:.2f} times less compute "
        f"({made['median_scene']:.2f} times if every frame must be generated)",
    ]
    return "\n".join([*lines, *(_told(summary, name) for name in CONTROLS)])


def _rank(summary: dict) -> str:
    known = summary["spearman"]
    return f"Spearman {'-' if known is None else f'{known:.2f}'} over {summary['points']} plans"


def _told(summary: dict, name: str) -> str:
    """At which tolerances the planner beats a control, and at which it does not."""
    by_tolerance = {t: methods[name] for t, methods in summary["by_tolerance"].items()}
    why = {"neither": "", "control": " (the control is better)", "too few": " (too few scenes)"}
    parts = []
    for margin, label in MARGINS.items():
        found = {t: m[margin]["wins"] for t, m in by_tolerance.items() if m["compared"]}
        beaten = ", ".join(t for t, wins in found.items() if wins == "planner")
        others = ", ".join(t + why[wins] for t, wins in found.items() if wins != "planner")
        told = [f"beaten at {beaten}"] if beaten else []
        parts.append(f"{label}: " + ", ".join(told + [f"NOT beaten at {others}"] * bool(others)))
    gone = summary["controls"][name]["left_out"]
    total = gone + summary["controls"][name]["compared"]
    if gone == total:
        return f"{name}: no plan of that cost"
    left = [f"no plan of that cost in {gone} of {total} pairs"] if gone else []
    return f"{name}: " + "; ".join(parts + left)


def table(summary: dict) -> str:
    """Markdown: one row for every tolerance and method."""
    rows = []
    for tolerance, methods in summary["by_tolerance"].items():
        for name, m in methods.items():
            pairs = f"{m['compared']} ({m['left_out']})"
            if not m["compared"]:
                cells = ["no plan of that cost", "", "", pairs, "", ""]
            else:
                cells = [
                    f"{m['mean_gflop']:.1f} / {m['median_gflop']:.1f}",
                    f"{m['saved']:.3g}",
                    f"{m['within']} of {m['compared']}",
                    *(
                        ["", "", ""]
                        if name == "planner"
                        else [pairs, _margin(m["error"], 1), _margin(m["compute"], 100)]
                    ),
                ]
            rows.append([tolerance, name, *cells])
    for name, m in summary["controls"].items():
        if m["compared"]:
            ends = [_margin(m["error"], 1), _margin(m["compute"], 100)]
            pairs = f"{m['compared']} ({m['left_out']})"
            rows.append(["all", name, "", "", "", pairs, *ends])
    columns = ["tolerance", "plans", "GFLOP, mean / median", "full model / it, median"]
    columns += ["within tolerance", "pairs compared (left out)"]
    columns += ["error at no more compute, in tolerances"]
    columns += ["compute within the tolerance, % of the full model"]
    return "\n".join(harness.table(columns, rows))


def _margin(found: dict, unit: float) -> str:
    digits = 2 if unit == 1 else 0
    if found["wins"] == "too few":
        return f"{unit * found['mean']:+.{digits}f}, {VERDICTS['too few']}"
    mean, low, high = (f"{unit * found[k]:+.{digits}f}" for k in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}] {VERDICTS[found['wins']]}"


# ---- picture ---------------------------------------------------------------------------------------


def draw(document: dict, file) -> None:
    plt = harness.pyplot()
    rows, summary = document["rows"], document["summary"]
    rungs = [r for r in RUNGS if any(row["rung"] == r for row in rows)]
    tolerances = [p["tolerance"] for p in rows[0]["plans"]]
    figure, axes = plt.subplots(2, 3, figsize=(18, 10), layout="constrained")
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
        (axes[0, 1], "full", "Error to the full model at no more compute"),
        (axes[0, 2], "truth", "Error to the truth at no more compute"),
    ):
        chosen = _middle(rows, tolerances)
        for j, name in enumerate(("planner", *CONTROLS)):
            error = points(rows, name, against)[:, chosen, 1]
            if name in CONTROLS:
                error = np.where(affordable(rows, name)[:, chosen], error, np.nan)
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

    for ax in axes[0]:
        ax.set_xticks(range(len(rungs)), names, fontsize=8)
        ax.set_xlabel("rung (mean complexity of its photos)")
        ax.legend(ncols=3, loc="upper center")

    for ax, margin in zip(axes[1, :2], MARGINS, strict=True):
        _margins(ax, summary, margin)

    ax = axes[1, 2]
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
    ax.minorticks_off()
    ax.set_title(f"Prediction: {_rank(summary)}")
    ax.legend()
    figure.suptitle(words(summary), fontsize=9)
    harness.save(figure, file)


def _middle(rows, tolerances) -> int:
    """The tolerance whose plans cost nearest to half of the full model: where there is most to choose."""
    full = np.median([row["full"]["flops"] / 1e9 for row in rows])
    cost = np.median(points(rows, "planner")[..., 0], 0)
    return int(np.argmin(np.abs(np.log(cost / (0.5 * full)))))


def _spread(ax, rows, place, values, label, colour, mark, k, count) -> None:
    """Median and range over the scenes of every rung, beside one another; NaN is left out."""
    shift = (k - (count - 1) / 2) * 0.7 / count
    for rung, i in place.items():
        mine = values[[row["rung"] == rung for row in rows]]
        mine = mine[np.isfinite(mine)]
        if not len(mine):
            continue
        name, label = label, None
        ax.plot(i + shift, np.median(mine), mark, color=colour, ms=5, label=name)
        ax.plot([i + shift] * 2, [mine.min(), mine.max()], "-", color=colour, lw=1.2)


def _margins(ax, summary, margin) -> None:
    """Every control beside the planner, with intervals; filled where the planner beats it."""
    for j, name in enumerate(CONTROLS):
        for i, methods in enumerate(summary["by_tolerance"].values()):
            if not methods[name]["compared"]:
                continue
            found, x = methods[name][margin], i + (j - 1) * 0.2
            low, high = (found["mean"] if found[k] is None else found[k] for k in ("low", "high"))
            ax.plot([x, x], [low, high], "-", color=COLOURS[name], lw=1.2)
            fill = COLOURS[name] if found["wins"] == "planner" else "white"
            ax.plot(x, found["mean"], MARKS[name].replace("x", "D"), color=COLOURS[name], mfc=fill)
        ax.plot([], [], MARKS[name].replace("x", "D"), color=COLOURS[name], label=name)
    ax.axhline(0, color="k", lw=1)
    ax.set_xticks(range(len(summary["by_tolerance"])), list(summary["by_tolerance"]))
    unit = {"error": "tolerances", "compute": "parts of the full model's"}[margin]
    ax.set(xlabel="tolerance", ylabel=f"control minus planner, {unit}")
    ax.set_title(f"{MARGINS[margin].capitalize()}\n(hollow: NOT beaten by the planner)")
    ax.legend()
