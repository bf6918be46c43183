"""From numbers per scene to results.json, a table with intervals, and a contact sheet.

A scene's entry is `{"scene": name, "context": [...], "target": [...], METHOD: {METRIC: value}}`. The
results are `{"settings", "means": {METHOD: {METRIC: value}}, "scenes": [...]}` plus `intervals`,
`differences` and `missing`, which say how far to trust the means.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from roge_jax.errors import UserError

RESAMPLES, LEVEL = 10_000, 0.95
LOWER_IS_BETTER = (
    "gmsd",
    "lpips_vgg",
    "lpips_alex",
    "ape_t",
    "ape_r",
    "ape_r_rot",
    "rpe_t",
    "rpe_r",
    "temporal_ratio",
)
BEST_AT_ONE = ("sharpness_ratio", "pumping_ratio")
NEITHER = ("error_seen_two", "error_seen_one", "error_unseen", "capped")  # say where, not how much
COLUMNS = (
    *("psnr", "ssim", "lpips_alex", "lpips_vgg"),
    *("gmsd", "sharpness_ratio", "temporal_ratio"),
)  # of the table, as far as they are there; results.json has all
BESIDE_PSNR = ("ssim", "lpips_alex", "lpips_vgg")  # blur has a good PSNR: no table shows it alone
_NOT_METHODS = ("scene", "context", "target", "pixels")


def bootstrap(
    values: Sequence[float], *, seed: int = 0, resamples: int = RESAMPLES, level: float = LEVEL
) -> dict[str, float]:
    """Mean over scenes and its percentile bootstrap interval: {mean, low, high, n}.

    Scenes are resampled, not frames: frames of one scene are not independent. With one scene there
    is no interval (NaN).
    """
    x = np.asarray(values, np.float64)
    if not len(x):
        return {"mean": math.nan, "low": math.nan, "high": math.nan, "n": 0}
    if len(x) == 1:
        return {"mean": float(x[0]), "low": math.nan, "high": math.nan, "n": 1}
    draws = np.random.default_rng(seed).integers(0, len(x), (resamples, len(x)))
    low, high = np.quantile(x[draws].mean(axis=1), [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return {"mean": float(x.mean()), "low": float(low), "high": float(high), "n": len(x)}


def goodness(metric: str, value: float) -> float:
    """A number that is higher for better values: ratios of detail are best at 1, errors at 0; NaN where neither is better."""
    if metric in NEITHER:
        return math.nan
    if metric in BEST_AT_ONE:
        return -abs(math.log(max(value, 1e-9)))
    return -value if metric in LOWER_IS_BETTER else value


def values(scenes: Sequence[dict[str, Any]], method: str, metric: str) -> dict[str, float]:
    """{scene name: value} of the scenes where `method` has a finite `metric`."""
    found = {}
    for scene in scenes:
        value = scene.get(method, {}).get(metric)
        if value is not None and math.isfinite(value):
            found[scene["scene"]] = float(value)
    return found


def paired_difference(
    scenes: Sequence[dict[str, Any]],
    method: str,
    baseline: str,
    metric: str,
    *,
    seed: int = 0,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
) -> dict[str, float]:
    """`bootstrap` of method - baseline over the scenes that have both, and `wins`.

    `wins` is the share of those scenes where the method is better (see `goodness`). The scenes' own difficulty cancels: this interval, not the overlap of two
    intervals of means, says whether one method beats the other.
    """
    a, b = values(scenes, method, metric), values(scenes, baseline, metric)
    both = [name for name in a if name in b]
    difference = [a[name] - b[name] for name in both]
    result = bootstrap(difference, seed=seed, resamples=resamples, level=level)
    won = [goodness(metric, a[name]) > goodness(metric, b[name]) for name in both]
    result["wins"] = float(np.mean(won)) if won and metric not in NEITHER else math.nan
    return result


def build(
    settings: dict[str, Any],
    scenes: Sequence[dict[str, Any]],
    *,
    models: Sequence[str] = ("generated", "rgb_head"),
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> dict[str, Any]:
    """The results document. `models` are compared with every other method, metric by metric.

    `intervals[METHOD][METRIC]` is {mean, low, high, n}; `differences[MODEL][METHOD][METRIC]` is
    the paired difference; `missing` lists "scene: method metric" for numbers that are absent or
    not finite in one scene but present in another: a mean over fewer scenes is never silent.
    """
    names = [scene["scene"] for scene in scenes]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(
            f"Scene {twice!r} occurs twice in the results; give every scene its own name."
        )
    methods = _ordered(key for scene in scenes for key in scene if key not in _NOT_METHODS)
    methods = [m for m in methods if any(isinstance(scene.get(m), dict) for scene in scenes)]
    metrics = {
        m: _ordered(metric for scene in scenes for metric in scene.get(m, {})) for m in methods
    }
    intervals: dict[str, dict[str, dict[str, float]]] = {m: {} for m in methods}
    missing = []
    for m in methods:
        for metric in metrics[m]:
            found = values(scenes, m, metric)
            intervals[m][metric] = bootstrap(list(found.values()), seed=seed, resamples=resamples)
            missing += [f"{name}: {m} {metric}" for name in names if name not in found]
    differences = {
        model: {
            other: {
                metric: paired_difference(
                    scenes, model, other, metric, seed=seed, resamples=resamples
                )
                for metric in metrics[model]
                if metric in metrics[other]
            }
            for other in methods
            if other != model
        }
        for model in models
        if model in methods
    }
    bootstrap_settings = {"seed": seed, "resamples": resamples, "level": LEVEL, "over": "scenes"}
    return {
        "settings": settings | {"bootstrap": bootstrap_settings},
        "means": {m: {k: v["mean"] for k, v in intervals[m].items()} for m in methods},
        "intervals": intervals,
        "differences": differences,
        "missing": missing,
        "scenes": list(scenes),
    }


def table(results: dict[str, Any], metrics: Sequence[str] | None = None) -> str:
    """Readable text: a row per method, a column per metric (mean [low, high]), then the differences.

    metrics: the columns, by default those of `COLUMNS`; SSIM and LPIPS stand beside PSNR wherever they were measured. Best mean of each column marked *; n is in the title, or in the cell where it differs.
    """
    intervals = results["intervals"]
    measured = _ordered(k for m in intervals.values() for k in m)
    columns = list(metrics or [m for m in COLUMNS if m in measured] or measured)
    if "psnr" in columns:
        place = columns.index("psnr") + 1
        columns[place:place] = [m for m in BESIDE_PSNR if m in measured and m not in columns]
    scenes = len(results["scenes"])
    rows = [["method", *columns]]
    best = {}
    for metric in columns:
        means = {
            m: v[metric]["mean"]
            for m, v in intervals.items()
            if metric in v and math.isfinite(v[metric]["mean"]) and metric not in NEITHER
        }
        best[metric] = max(means, key=lambda m: goodness(metric, means[m]), default=None)
    for m, found in intervals.items():
        cells = [
            _cell(found.get(metric), scenes) + ("*" if best[metric] == m else " ")
            for metric in columns
        ]
        rows.append([m, *cells])
    text = [f"mean over n = {scenes} scenes [95 % bootstrap interval], * best", *_aligned(rows)]
    for model, others in results["differences"].items():
        rows = [[f"{model} minus", *columns]]
        for other, found in others.items():
            cells = []
            for metric in columns:
                one = found.get(metric)
                told = one is not None and one["n"] and math.isfinite(one["wins"])
                wins = f" wins {100 * one['wins']:.0f} %" if told else ""
                cells.append(_cell(one, scenes, signed=True) + wins)
            rows.append([other, *cells])
        text += ["", *_aligned(rows)]
    if results["missing"]:
        shown = results["missing"][:5]
        more = len(results["missing"]) - len(shown)
        text += ["", f"missing: {'; '.join(shown)}" + (f"; and {more} more" if more else "")]
    return "\n".join(text)


def contact_sheet(
    rows: Sequence[Sequence[np.ndarray | None]],
    labels: Sequence[str],
    *,
    row_labels: Sequence[str] | None = None,
    pad: int = 2,
    scale: int = 1,
) -> np.ndarray:
    """Images in a labelled grid: uint8 [H, W, 3].

    rows: rows of images [h, w, 3], float in [0, 1] or uint8; None leaves a cell empty; rows may be
    shorter than the others. labels: one per column, on top; row_labels: one per row, on the left.
    scale: enlarges every image by whole pixels, so that small ones can be judged. Images of unequal
    size sit in the top left corner of equal cells; nothing is resampled.
    """
    from PIL import Image, ImageDraw, ImageFont

    count = max((len(row) for row in rows), default=0)
    if not count:
        raise UserError("A contact sheet needs at least one row with one image.")
    if len(labels) != count or (row_labels is not None and len(row_labels) != len(rows)):
        raise UserError(
            f"A contact sheet of {len(rows)} rows and {count} columns got {len(labels)} labels and "
            f"{len(rows) if row_labels is None else len(row_labels)} row labels."
        )
    grid = [[None if x is None else _pixels(x, scale) for x in row] for row in rows]
    images = [x for row in grid for x in row if x is not None]
    cell_h = max((x.shape[0] for x in images), default=1)
    cell_w = max((x.shape[1] for x in images), default=1)
    font = ImageFont.load_default(size=11)
    top = 16 if any(labels) else 0
    left = 0
    if row_labels is not None:
        left = max(math.ceil(font.getlength(text)) for text in row_labels) + 6
    height = top + len(grid) * (cell_h + pad) + pad
    width = left + count * (cell_w + pad) + pad
    sheet = np.full((height, width, 3), 255, np.uint8)
    for i, row in enumerate(grid):
        for j, image in enumerate(row):
            if image is not None:
                y, x = top + pad + i * (cell_h + pad), left + pad + j * (cell_w + pad)
                sheet[y : y + image.shape[0], x : x + image.shape[1]] = image
    canvas = Image.fromarray(sheet)
    draw = ImageDraw.Draw(canvas)
    for j, text in enumerate(labels):
        shown = _fit(text, font, cell_w)
        draw.text((left + pad + j * (cell_w + pad), 1), shown, fill=(0, 0, 0), font=font)
    for i, text in enumerate(row_labels or ()):
        y = top + pad + i * (cell_h + pad) + cell_h // 2
        draw.text((3, y), text, fill=(0, 0, 0), font=font, anchor="lm")
    return np.asarray(canvas)


def _ordered(names: Any) -> list[str]:
    return list(dict.fromkeys(names))


def _cell(one: dict[str, float] | None, scenes: int, signed: bool = False) -> str:
    if one is None or not one["n"]:
        return "-"
    form = "{:+.3f}" if signed else "{:.3f}"
    text = form.format(one["mean"])
    if math.isfinite(one["low"]):
        text += f" [{form.format(one['low'])}, {form.format(one['high'])}]"
    return text if one["n"] == scenes else f"{text} (n={one['n']})"


def _aligned(rows: list[list[str]]) -> list[str]:
    widths = [max(len(row[j]) for row in rows) for j in range(len(rows[0]))]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths)).rstrip() for row in rows]


def _pixels(image: np.ndarray, scale: int) -> np.ndarray:
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3:
        raise UserError(f"A contact sheet takes images [h, w, 3], not {image.shape}.")
    if image.dtype != np.uint8:
        image = np.rint(255.0 * np.clip(np.nan_to_num(image), 0.0, 1.0)).astype(np.uint8)
    return image.repeat(scale, axis=0).repeat(scale, axis=1)


def _fit(text: str, font: Any, width: int) -> str:
    while text and font.getlength(text) > width:
        text = text[:-1]
    return text
