"""Where the curves of `robustness.py` break, what follows for the limits of the package, tables and pictures.

No program of its own: `python -m experiments.stability.robustness --draw` makes all of it again from the stored numbers.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from experiments import harness
from roge_jax.metrics import report
from roge_jax.sampling import limits

METRICS = ("psnr", "ssim", "sharpness_ratio")
MODELS, METHODS = ("rgb_head", "generated"), ("rgb_head", "generated", "nearest", "plane")
LOSS = 1.0  # dB
RESAMPLES = 2000
REACHES = (0.25, 0.5, 1.0, 1.5, 2.0, 2.5)  # baselines


class Knob(NamedTuple):
    title: str
    unit: str
    levels: tuple[float, ...]  # outwards, without the undisturbed one
    still: float = 0.0  # the undisturbed level
    log: bool = False


KNOBS = {
    "rotation": Knob("pose: rotation", "RMS error of the photos, degrees", (0.25, 0.5, 1, 2, 4, 8, 16)),
    "position": Knob("pose: position", "RMS error, fraction of the baseline", (0.0125, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8)),
    "focal": Knob("focal length", "error of the photos, %, either sign", (0.5, 1, 2, 5, 10, 20, 40)),
    "noise": Knob("photo noise", "standard deviation (white = 1)", (0.0125, 0.025, 0.05, 0.1, 0.2, 0.3)),
    "blur": Knob("photo blur", "Gaussian sigma, pixels of 112", (0.25, 0.5, 1, 2, 4)),
    "jpeg": Knob("JPEG", "quality", (90, 75, 50, 20, 10, 5), 100, True),
    "jpeg2": Knob("JPEG, photo twice the size", "quality", (75, 50, 20, 5), 100, True),
    "jpeg4": Knob("JPEG, photo 4 times the size", "quality", (50, 20, 5), 100, True),
    "jpeg8": Knob("JPEG, photo 8 times the size", "quality", (20, 5), 100, True),
    "exposure": Knob("exposure mismatch", "darkest to lightest photo, stops", (0.125, 0.25, 0.5, 1, 1.5, 2)),
    "photos": Knob("fewer photos", "photos, all distinct", (2, 1), 3),
    "more": Knob("more photos", "photos, all distinct", (4, 6), 3),
    "copies": Knob("repeated photos", "distinct photos of 3", (2, 1), 3),
    "padding": Knob("repeated photos", "photos, of which 3 distinct", (6,), 3),
    "crowding": Knob("crowded photos", "spacing of the photos, 1 = even", (0.6, 0.4, 0.2), 1.0),
    "extrapolation": Knob("extrapolation", "targets outside the photos' hull, baselines", REACHES),
    "wider": Knob("wider targets", "field of view over the photos' (tangents)", (1.025, 1.05, 1.1, 1.2, 1.5, 2), 1.0, True),
    "narrower": Knob("narrower targets", "field of view over the photos'", (0.95, 0.9, 0.8, 0.6, 0.4), 1.0, True),
}  # fmt: skip

SHRUNK = {"jpeg": 1, "jpeg2": 2, "jpeg4": 4, "jpeg8": 8}  # times the model's size
# The run-time measure (of `roge_jax.sampling.limits`) that shows a knob, where one does.
SHOWN = {
    "extrapolation": "extrapolation", "wider": "field_ratio", "narrower": "field_ratio",
    "photos": "distinct_photos", "exposure": "exposure_stops", "blur": "sharpness", "noise": "noise",
}  # fmt: skip
ESTIMATED = ("exposure_stops", "sharpness", "noise")  # from photos: what they show counts as well
USUAL = 0.95  # share of the undisturbed scenes that must lie within a limit on an estimate


def by_reach(results: list) -> dict[str, Any]:
    """Per-frame scores of the path that leaves the photos, read off at fixed distances from their hull."""
    levels = [0.0, *REACHES]
    scores = {
        m: {k: np.full((len(levels), len(results)), np.nan) for k in METRICS} for m in METHODS
    }
    for scene, (_, frames, reach) in enumerate(results):
        inside = reach < 0.1
        order = np.argsort(np.where(inside, -1.0, reach))
        for method in METHODS:
            for metric in METRICS:
                y = frames[method][metric]
                scores[method][metric][0, scene] = y[inside].mean()
                read = np.interp(REACHES, reach[order], y[order], right=np.nan)
                scores[method][metric][1:, scene] = read
    listed = {m: {k: v.tolist() for k, v in row.items()} for m, row in scores.items()}
    reached = [[x] * len(results) for x in levels]
    return {"levels": levels, "scores": listed, "seen": {"extrapolation": reached}}


# ---- where it breaks -----------------------------------------------------------------------------


def crossing(levels: np.ndarray, values: np.ndarray, log: bool = False) -> float:
    """The first level at which a piecewise linear curve falls below 0, NaN if never; `values` [levels]."""
    x = np.log(levels) if log else np.asarray(levels, float)
    below = np.flatnonzero(values < 0)
    if not len(below):
        return math.nan
    i = int(below[0])
    if i == 0:
        return float(levels[0])
    share = values[i - 1] / (values[i - 1] - values[i])
    at = x[i - 1] + share * (x[i] - x[i - 1])
    return float(np.exp(at) if log else at)


def with_interval(levels, per_scene: np.ndarray, log: bool) -> dict[str, Any]:
    """`crossing` of the mean over scenes of `per_scene` [levels, scenes], and its 95 % bootstrap interval.

    None means beyond the last level; a resample that does not cross counts as infinitely far.
    """
    draws = np.random.default_rng(0).integers(
        0, per_scene.shape[1], (RESAMPLES, per_scene.shape[1])
    )
    mean, sampled = _mean(per_scene), _mean(per_scene[:, draws])  # [levels], [levels, resamples]
    found = np.array([crossing(levels, column, log) for column in sampled.T])
    outwards = 1.0 if levels[-1] > levels[0] else -1.0
    ordered = np.sort(np.where(np.isnan(found), np.inf, outwards * found))
    low, high = (ordered[int(q * (RESAMPLES - 1))] for q in (0.025, 0.975))
    ends = [outwards * x if np.isfinite(x) else None for x in (low, high)]
    at = crossing(levels, mean, log)
    return {
        "at": None if math.isnan(at) else at,
        "interval": ends,
        "share_crossing": float(np.isfinite(ordered).mean()),
    }


def _mean(x: np.ndarray) -> np.ndarray:
    """Over the last axis, without NaN (a distance that a scene does not reach); NaN if nothing is left."""
    known = np.isfinite(x)
    total = np.where(known, x, 0.0).sum(-1)
    return np.where(known.any(-1), total / np.maximum(known.sum(-1), 1), np.nan)


def breaks(found: dict[str, dict]) -> dict[str, dict[str, Any]]:
    """{knob: {method: {"loses_1_db": .., "loses_3_db": .., "below_nearest": ..}}}."""
    result: dict[str, dict] = {}
    for knob, data in found.items():
        levels, log = np.array(data["levels"]), KNOBS[knob].log
        psnr = {m: np.array(data["scores"][m]["psnr"]) for m in METHODS}
        result[knob] = {}
        for method in ("rgb_head", "generated", "plane"):
            own = psnr[method]
            result[knob][method] = {
                "loses_1_db": with_interval(levels, own - own[:1] + LOSS, log),
                "loses_3_db": with_interval(levels, own - own[:1] + 3 * LOSS, log),
                "below_nearest": with_interval(levels, own - psnr["nearest"], log),
            }
    return result


def limit_rows(
    found: dict, broken: dict, undisturbed: dict[str, list[float]]
) -> dict[str, dict[str, Any]]:
    """The rows of `limits.json`: the earlier 1 dB break of the two outputs in units of the run-time measure.

    A limit on a measure in `undisturbed` ({measure: [scenes]}) lies no further in than their `USUAL` quantile.
    """
    rows = {}
    for knob, measured in SHOWN.items():
        levels, log = np.array(found[knob]["levels"]), KNOBS[knob].log
        outwards = 1.0 if levels[-1] > levels[0] else -1.0
        ends = {m: broken[knob][m]["loses_1_db"] for m in MODELS}
        real = {m: end["at"] for m, end in ends.items() if end["at"] is not None}
        first = min(real, key=lambda m: outwards * real[m]) if real else None
        at = real[first] if first else float(levels[-1])
        per_scene = np.array(found[knob]["seen"][measured])
        x = np.log(levels) if log else levels
        values = np.median(per_scene, 1)
        order = np.argsort(x)
        limit = float(np.interp(np.log(at) if log else at, x[order], values[order]))
        sign = 1.0 if values[-1] > values[0] else -1.0  # warn above or below
        still, measured_limit = per_scene[0], limit
        if measured in undisturbed:
            still = np.array(undisturbed[measured])
            limit = sign * max(sign * limit, float(np.quantile(sign * still, USUAL)))
        rows[knob] = {
            "limit": limit,
            "measured_limit": measured_limit,
            "moved": limit != measured_limit,
            "broke": first is not None,
            "measure": measured,
            "knob": at,
            "interval": ends[first]["interval"] if first else [None, None],
            "output": first,
            "undisturbed_beyond": float((sign * still > sign * limit).mean()),
            "undisturbed_scenes": len(still),
            "last_level_beyond": float((sign * per_scene[-1] >= sign * limit).mean()),
        }
    return rows


def jpeg_row(broken: dict, scenes: int) -> dict[str, dict[str, Any]]:
    """The row `jpeg` of `limits.json`: the quality where 1 dB is lost for photos of the model's size and larger ones.

    0 in `by_shrink` where no quality cost 1 dB.
    """
    ends = {knob: [broken[knob][m]["loses_1_db"] for m in MODELS] for knob in SHRUNK}
    first = {knob: max(end["at"] or 0.0 for end in both) for knob, both in ends.items()}
    earlier = max(MODELS, key=lambda m: broken["jpeg"][m]["loses_1_db"]["at"] or 0.0)
    row = {
        "limit": first["jpeg"],
        "measured_limit": first["jpeg"],
        "moved": False,
        "broke": first["jpeg"] > 0,
        "measure": "quality",
        "knob": first["jpeg"],
        "by_shrink": [[times, first[knob]] for knob, times in SHRUNK.items()],
        "interval": broken["jpeg"][earlier]["loses_1_db"]["interval"],
        "output": earlier,
        "undisturbed_beyond": 0.0,
        "undisturbed_scenes": scenes,
        "last_level_beyond": float(KNOBS["jpeg"].levels[-1] < first["jpeg"]),
    }
    return {"jpeg": row}


# ---- pictures ------------------------------------------------------------------------------------

COLOURS = {"rgb_head": "#1f77b4", "generated": "#d62728", "nearest": "#7f7f7f", "plane": "#2ca02c"}
LABELS = {"rgb_head": "RGB head", "generated": "generated video", "nearest": "nearest photo", "plane": "plane"}  # fmt: skip
AXES = {"psnr": "PSNR, dB", "ssim": "SSIM", "sharpness_ratio": "sharpness (1 = truth)"}
PANELS = (
    ("rotation",), ("position",), ("focal",), ("noise",), ("blur",), ("jpeg",), ("exposure",),
    ("photos", "more"), ("copies",), ("crowding",), ("extrapolation",), ("narrower", "wider"),
)  # fmt: skip


def draw(found: dict, broken: dict, metric: str, scenes: int, name: str) -> None:
    """One panel a knob: mean over scenes, band of the paired change, breaks as dotted lines."""
    plt = harness.pyplot()
    fig, axes = plt.subplots(3, 4, figsize=(16, 10.2), sharey=True)
    for ax, knobs in zip(axes.flat, PANELS, strict=True):
        knob = KNOBS[knobs[-1]]
        for method in METHODS:
            levels, mean, low, high = joined(found, knobs, method, metric)
            colour = COLOURS[method]
            style = "-" if method in MODELS else "--"
            ax.plot(levels, mean, style, color=colour, marker="o", ms=3.5, label=LABELS[method])
            ax.fill_between(levels, low, high, color=colour, alpha=0.15, lw=0)
        for large, times in SHRUNK.items() if knobs == ("jpeg",) else ():
            if times > 1:
                levels, mean, *_ = joined(found, (large,), "rgb_head", metric)
                ax.plot(levels, mean, ":", color=COLOURS["rgb_head"], lw=1)
                end, shift = (levels[0], mean[0]), (14, {2: -11, 4: -3, 8: 5}[times])
                ax.annotate(f"x{times}", end, shift, textcoords="offset points", fontsize=8)
        for knob_name in knobs:
            for method in MODELS if metric == "psnr" else ():
                at = broken[knob_name][method]["loses_1_db"]["at"]
                if at is not None:
                    ax.axvline(at, color=COLOURS[method], ls=":", lw=1.5)
        one_side = found[knobs[0]]["levels"]
        two = len(knobs) > 1
        title = "photos" if knobs == ("photos", "more") else knob.title
        title = "field of view of the targets" if knobs == ("narrower", "wider") else title
        ax.set(title=title, xlabel=knob.unit)
        if knob.log:
            ticks = spaced({x for k in knobs for x in found[k]["levels"]}, knob.still)
            ax.set_xscale("log")
            ax.set_xticks(ticks, [f"{x:g}" for x in ticks])
            ax.minorticks_off()
        elif knob.unit.startswith(("photos", "distinct")):
            ax.set_xticks(sorted({x for k in knobs for x in found[k]["levels"]}))
        if one_side[-1] < one_side[0] and not two:
            ax.invert_xaxis()
    for ax in axes[:, 0]:
        ax.set_ylabel(AXES[metric])
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if metric == "psnr":
        handles.append(plt.Line2D([], [], color="k", ls=":"))
        labels.append("has lost 1 dB (by colour)")
    fig.legend(handles, labels, loc="lower center", ncol=6)
    fig.suptitle(
        f"{AXES[metric].split(',')[0]} under one disturbance at a time: mean over {scenes} held-out scenes, band: "
        "95 % bootstrap of the change from undisturbed"
    )
    fig.tight_layout(rect=(0, 0.035, 1, 1))
    harness.save(fig, name)


def spaced(levels: set[float], first: float) -> list[float]:
    """Levels whose labels do not overlap on a logarithmic axis, the undisturbed one first."""
    gap = 0.09 * math.log(max(levels) / min(levels))
    kept = [first]
    for x in sorted(levels, key=lambda x: -abs(math.log(x / first))):
        if all(abs(math.log(x / y)) > gap for y in kept):
            kept.append(x)
    return sorted(kept)


def joined(found: dict, knobs: tuple[str, ...], method: str, metric: str):
    """(levels, mean, low, high) of one or two knobs that leave the undisturbed point in opposite directions."""
    points = {}
    for knob in knobs:
        values = np.array(found[knob]["scores"][method][metric])
        for level, row in zip(found[knob]["levels"], values, strict=True):
            change = row - values[0]
            change = change[np.isfinite(change)]
            spread = report.bootstrap(change, resamples=RESAMPLES)
            points[level] = (values[0].mean(), spread["mean"], spread["low"], spread["high"])
    levels = sorted(points)
    base, *rows = np.array([points[x] for x in levels]).T
    return levels, *(base + row for row in rows)


def write_limits(document: dict) -> None:
    """The entry of this model in the package's table, with where it comes from."""
    table = harness.read(limits.TABLE, absent={})
    settings = document["settings"]
    table[settings["model"]] = {
        "provenance": {
            "command": " ".join(document["command"]),
            "commit": document["commit"],
            "weights": settings["weights"],
            "seeds": [settings["seeds"][0], settings["seeds"][-1]],
            "scenes": len(settings["seeds"]),
            "again": {k: [" ".join(v["command"]), v["commit"]] for k, v in document.get("again", {}).items()},
            "criterion": f"mean PSNR {settings['loss_db']:g} dB below undisturbed, earlier of {' and '.join(MODELS)}",
        },
        "limits": document["limits"],
    }  # fmt: skip
    harness.write(limits.TABLE, table)


def summary(document: dict) -> str:
    """Breaks and limits as tables in markdown."""

    def cell(end: dict) -> str:
        if end["at"] is None:
            return f"no ({100 * end['share_crossing']:.0f} %)" if end["share_crossing"] else "no"
        low, high = ("-" if x is None else f"{x:.3g}" for x in end["interval"])
        return f"{end['at']:.3g} [{low}, {high}]"

    settings = document["settings"]
    base = document["knobs"]["rotation"]["scores"]
    undisturbed = ", ".join(f"{LABELS[m]} {np.mean(base[m]['psnr'][0]):.2f}" for m in METHODS)
    lines = [
        f"{len(settings['seeds'])} held-out scenes from seed {settings['seeds'][0]}, weights {settings['weights']}, commit "
        f"{document['commit']}. Undisturbed PSNR, dB: {undisturbed}.",
        "",
    ]
    rows = []
    for name, row in document["breaks"].items():
        knob = KNOBS[name]
        kinds = ("loses_1_db", "loses_3_db", "below_nearest")
        cells = [cell(row[m][k]) for k in kinds for m in MODELS]
        rows.append([f"{knob.title}: {knob.unit} ({knob.still:g})", *cells])
    columns = ["knob, unit (undisturbed)", "RGB head -1 dB", "video -1 dB", "RGB head -3 dB"]
    columns += ["video -3 dB", "RGB head below nearest", "video below nearest"]
    lines += [*harness.table(columns, rows), ""]
    rows = []
    for kind, row in document["limits"].items():
        limit = f"{row['limit']:.3g}" + ("" if row["broke"] else " (end of the range)")
        if row["moved"]:
            limit += (
                f" (measured {row['measured_limit']:.3g}, moved to the undisturbed {USUAL:.0%})"
            )
        shares = [f"{row['undisturbed_beyond']:.0%}", f"{row['last_level_beyond']:.0%}"]
        rows.append([f"{kind}: {row['measure']}", limit, *shares])
    columns = ["warning", "limit", "undisturbed scenes beyond it"]
    columns += ["scenes beyond it at the last level"]
    return "\n".join([*lines, *harness.table(columns, rows)])
