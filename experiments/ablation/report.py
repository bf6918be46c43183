"""Tables and the chart of the ablation, from its JSON."""

from pathlib import Path

import numpy as np

from experiments import harness
from experiments.ablation import reconstruction, transformer
from experiments.ablation.common import SIGMAS
from roge_jax.metrics.report import bootstrap

ORDER = (
    *reconstruction.VARIANTS,
    *("look-up", "conditions", "finetune"),
    *transformer.VARIANTS,
    *("lora", "adaptation", "adaptation, rank 8", "adaptation, rank 2"),
)

WHERE = {"lora": "training scenes", "adaptation": "one scene"}  # what LoRA was trained on


def scores(row: dict) -> np.ndarray:
    """One number per held-out scene, higher is better: PSNR, or the flow error over all noise levels, negated."""
    return np.asarray(row["psnr"]) if "psnr" in row else -np.mean(row["errors"], 1)


def difference(rows: dict[str, dict], name: str) -> dict[str, float]:
    """Paired difference of the scores of a variant to its reference, over the held-out scenes.

    Where the reference is the base it is the mean over all its seeds; a second seed of the base is compared with the
    first alone, which shows what a seed is worth.
    """
    row = rows[name]
    reference = scores(rows[row["reference"]])
    if row["question"] != "seed" and rows[row["reference"]]["question"] == "seed":
        reference = np.mean([scores(r) for r in rows.values() if r["question"] == "seed"], 0)
    return bootstrap(scores(row) - reference)


def verdict(d: dict[str, float], noise: float) -> str:
    """What an interval says, given the difference that a mere seed makes."""
    if d["low"] <= 0 <= d["high"] or abs(d["mean"]) <= noise:
        return "undecided"
    return "better" if d["mean"] > 0 else "worse"


def seed_noise(rows: dict[str, dict]) -> float:
    seeds = [n for n, r in rows.items() if r["question"] == "seed" and n != r["reference"]]
    return max((abs(difference(rows, n)["mean"]) for n in seeds), default=0.0)


def ready(rows: dict[str, dict], group: str = "reconstruction") -> dict[str, dict]:
    """The rows of a group of variants whose reference is there."""
    rows = {n: r for n, r in rows.items() if r["group"] == group}
    return {n: r for n, r in rows.items() if r["reference"] in rows}


def judged(rows: dict[str, dict], name: str) -> str:
    """The verdict on one of the `ready` rows."""
    if rows[name]["question"] == "seed":
        return "(reference)"
    return verdict(difference(rows, name), seed_noise(rows))


def _interval(d: dict[str, float], digits: int) -> str:
    return f"{d['mean']:+.{digits}f} [{d['low']:+.{digits}f}, {d['high']:+.{digits}f}]"


def _early(rows: dict[str, dict], name: str) -> float:
    """Difference to the reference halfway, by its mean over the seeds if it has several."""
    reference = rows[rows[name]["reference"]]
    same = [reference]
    if reference["question"] == "seed":
        same = [r for r in rows.values() if r["question"] == "seed"]
    return rows[name]["halfway"] - float(np.mean([r["halfway"] for r in same]))


def _variants_table(rows: dict[str, dict]) -> list[str]:
    lines, recon = [], ready(rows)
    for name, row in recon.items():
        versus = "" if row["reference"] == "base" else f", against {row['reference']}"
        shown = _interval(difference(recon, name), 2) + versus
        cells = [f"{np.mean(row['psnr']):.2f}", shown if name != "base" else ""]
        cells += [f"{_early(recon, name):+.2f}", judged(recon, name)]
        lines.append([name, *_cost(row), *cells])
    columns = ["PSNR", "difference (dB) [95 %]", "halfway", "verdict"]
    return harness.table([*COST, *columns], lines)


COST = ["variant", "parameters (M)", "steps", "core-s"]


def _cost(row: dict) -> list[str]:
    return [f"{row['parameters'] / 1e6:.2f}", row["steps"], f"{row['core_seconds']:.0f}"]


def _look_up_table(row: dict) -> list[str]:
    lines = []
    for m, each in row["psnr"].items():
        gain = bootstrap(np.subtract(each[-1], each[0]))
        lines.append([m, *(f"{np.mean(x):.2f}" for x in each), _interval(gain, 2)])
    return harness.table(["photos", *row["parts"], "both over RGB head [95 %]"], lines)


def _conditions_table(row: dict) -> list[str]:
    found = {n: np.asarray(e) for n, e in row["errors"].items()}
    whole, cells = found["all conditions"], []
    for name, e in found.items():
        rise = _interval(bootstrap((e - whole).mean(1)), 3) if name != "all conditions" else ""
        cells.append([name, *(f"{x:.3f}" for x in e.mean(0)), rise])
    columns = ["condition", *(f"{s:g}" for s in SIGMAS), "mean rise [95 %]"]
    lines = harness.table(columns, cells)
    itself = row.get("preview_itself")
    if itself:  # at sigma 1 a flow error is that of a guess of x0
        lines += ["", f"The preview's own latents, taken for x0: {np.mean(itself):.3f}."]
    return lines


def _finetune_table(row: dict) -> list[str]:
    whole, lines = np.asarray(row["after"]["all conditions"]), []
    for name in row["after"]:
        before, after = (np.asarray(row[k][name]) for k in ("before", "after"))
        more = _interval(bootstrap((after - whole).mean(1)), 3) if name != "all conditions" else ""
        cells = [f"{before.mean():.3f}", f"{after.mean():.3f}", more]
        lines.append([name, *cells, f"{row['clocks'][name]['core_seconds']:.0f}"])
    columns = ["trained on", "flow error before", "after", "after, against all [95 %]", "core-s"]
    return harness.table(columns, lines)


def _transformer_table(rows: dict[str, dict]) -> list[str]:
    """Differences are of errors, so below zero is better; `scores` has them the other way."""
    lines = []
    for name, row in rows.items():
        d = difference(rows, name)
        d = {"mean": -d["mean"], "low": -d["high"], "high": -d["low"]}
        shown = _interval(d, 4) if name != row["reference"] else ""
        cells = [f"{np.mean(row['errors']):.4f}", shown, f"{_early(rows, name):+.4f}"]
        lines.append([name, *_cost(row), *cells, judged(rows, name)])
    columns = ["flow error", "difference [95 %]", "halfway", "verdict"]
    untrained = next(iter(rows.values()))["untrained"]
    return [
        *harness.table([*COST, *columns], lines),
        "",
        f"Flow error of the preview alone, before any step: {np.mean(untrained):.4f}.",
    ]


def _spectrum_table(row: dict) -> list[str]:
    ranks = ("stable_rank", "rank_90", "rank_99")
    lines = [
        [family, s["matrices"], *(f"{s[rank]:.1f}" for rank in ranks)]
        for family, s in row["spectrum"].items()
    ]
    columns = ["layers", "matrices", "stable rank", "rank of 90 %", "of 99 % of the energy"]
    return harness.table(columns, lines)


def _ranks_table(row: dict, outright: dict[str, dict]) -> list[str]:
    """`outright`: rows of runs at lower ranks."""
    whole, cells = str(row["rank"]), []
    labels = {"before": "untrained", "0": "0 (E1 and new embeddings alone)"}
    found = {labels.get(name, name): loss for name, loss in row["losses"].items()}
    for other in outright.values():
        label = f"{other['rank']}, trained at {other['rank']}"
        found[label] = other["losses"][str(other["rank"])]
    for label, loss in found.items():
        apart = np.subtract(loss["flow"], row["losses"][whole]["flow"])
        change = _interval(bootstrap(apart), 4) if label != whole else ""
        picture = f"{1000 * np.mean(loss['photometric']):.3f}"
        cells.append([label, f"{np.mean(loss['flow']):.4f}", change, picture])
    columns = ["rank kept", "flow error", "change to the full update [95 %]"]
    lines = harness.table([*columns, "RGB head, MSE x 1000"], cells)
    if "elsewhere" in row:
        before, after = (row["elsewhere"][name]["flow"] for name in ("before", whole))
        change = _interval(bootstrap(np.subtract(after, before)), 4)
        told = f"flow error {np.mean(before):.4f} before, {np.mean(after):.4f} after, {change}"
        lines += ["", f"On {len(before)} other scenes, the same update: {told}."]
    return lines


def lower_ranks(rows: dict[str, dict]) -> dict[str, dict]:
    """The adaptations that were trained at a lower rank than the one that is cut."""
    return {n: r for n, r in rows.items() if r["group"] == "adaptation" and n != "adaptation"}


def tables(rows: dict[str, dict]) -> str:
    """The results as markdown."""
    parts = [_variants_table(rows)]
    for name, table in (
        ("look-up", _look_up_table),
        ("conditions", _conditions_table),
        ("finetune", _finetune_table),
    ):
        if name in rows:
            parts.append(table(rows[name]))
    transformers = ready(rows, "transformer")
    if transformers:
        parts.append(_transformer_table(transformers))
    for name, where in WHERE.items():
        if name in rows:
            row = rows[name]
            count = len(row["losses"]["0"]["flow"])
            parts.append([f"LoRA on {where}, {row['steps']} steps, {count} held-out samples:"])
            parts.append(_spectrum_table(row))
            parts.append(_ranks_table(row, lower_ranks(rows) if name == "adaptation" else {}))
    missing = [n for n in ORDER if n not in rows]
    if missing:
        parts.append([f"Not run yet: {', '.join(missing)}."])
    return "\n\n".join("\n".join(lines) for lines in parts)


COLOURS = {"better": "C2", "worse": "C3", "undecided": "0.55", "(reference)": "k"}


def draw(rows: dict[str, dict], path: str | Path) -> None:
    fig = harness.pyplot().figure(figsize=(16.5, 14))
    outer = fig.add_gridspec(
        1, 2, width_ratios=[1, 1.45], left=0.165, right=0.985, top=0.965, bottom=0.05, wspace=0.17
    )
    recon, trained = ready(rows), ready(rows, "transformer")
    heights = [max(len(recon), 2), max(len(trained), 2)]
    left = outer[0].subgridspec(2, 1, height_ratios=heights, hspace=0.16)
    if recon:
        ax = fig.add_subplot(left[0])
        _variants(ax, recon, 1.0, "dB")
        ax.set_xlabel(
            "held-out PSNR above that of the base (dB), mean and 95 % interval over scenes"
        )
        ax.set_title(_budget(recon["base"]) + f", {np.mean(recon['base']['psnr']):.2f} dB")
    if trained:
        ax, base = fig.add_subplot(left[1]), trained["transformer"]
        _variants(ax, trained, 100 / np.mean(base["errors"]), "%")
        ax.set_xlabel("held-out flow error below that of the base (%), mean and 95 % interval")
        title = f"transformer: {_budget(base)}, error {np.mean(base['errors']):.4f}"
        ax.set_title(title)
    right = outer[1].subgridspec(3, 2, hspace=0.27, wspace=0.3)
    panels = (
        ("conditions", _conditions, right[0, 0]),
        ("finetune", _finetune, right[0, 1]),
        ("lora", _spectrum, right[1, 0]),
        ("adaptation", _spectrum, right[2, 0]),
    )
    for name, panel, cell in panels:
        if name in rows:
            panel(fig.add_subplot(cell), rows[name])
    if "lora" in rows:
        _ranks(fig.add_subplot(right[1, 1]), rows["lora"], {})
    if "adaptation" in rows:
        _ranks(fig.add_subplot(right[2, 1]), rows["adaptation"], lower_ranks(rows))
    harness.save(fig, path)


def _budget(base: dict) -> str:
    return f"{base['tera_flop']:.1f} TFLOP each; base: {base['steps']} steps, n = {len(scores(base))} scenes"


def _variants(ax, rows: dict[str, dict], unit: float, word: str) -> None:
    """Differences of the `scores` times `unit`, with the seeds' difference as a band."""
    noise = unit * seed_noise(rows)
    names = [n for n, r in rows.items() if n != r["reference"]][::-1]
    ax.axvspan(-noise, noise, color="0.9", zorder=0, label=f"seed of the base: {noise:.2g} {word}")
    ax.axvline(0, color="k", lw=0.8)
    labels = []
    for y, name in enumerate(names):
        mean, low, high = (unit * difference(rows, name)[key] for key in ("mean", "low", "high"))
        colour = COLOURS[judged(rows, name)]
        ax.errorbar(
            mean, y, xerr=[[mean - low], [high - mean]], fmt="o", color=colour, capsize=3, ms=6
        )
        versus = rows[name]["reference"]
        more = "" if rows[versus]["question"] == "seed" else f"\nagainst {versus}"
        labels.append(f"{name} ({rows[name]['steps']} steps){more}")
    for verdict_, colour in COLOURS.items():
        ax.plot([], [], "o", color=colour, label=verdict_.strip("()"))
    ax.set_yticks(range(len(names)), labels, fontsize=9)
    ax.set_ylim(-0.7, len(names) + 0.4)  # room for the legend
    ax.legend(fontsize=7, ncols=3, loc="upper center", columnspacing=0.8)


CONDITIONS = {
    "all conditions": "k",
    "rays": "C0",
    "ray features": "C1",
    "preview": "C2",
    "ray features and preview": "C3",
    "context latents": "C4",
}


def _conditions(ax, row: dict) -> None:
    whole = np.mean(row["errors"]["all conditions"], 0)
    words = [n for n in row["errors"] if n.endswith(": zero")]
    styles = {n: (CONDITIONS[n.removesuffix(": zero")], "-") for n in words}
    styles |= {n.replace("zero", "another scene's"): (c, "--") for n, (c, _) in styles.items()}
    for name, (colour, line) in styles.items():
        rise = 100 * (np.mean(row["errors"][name], 0) / whole - 1)
        label = name.removesuffix(": zero") if line == "-" else None
        ax.plot(row["sigmas"], rise, color=colour, ls=line, marker="o", ms=3, label=label)
    ax.plot([], [], color="0.4", ls="-", label="solid: zeroed")
    ax.plot([], [], color="0.4", ls="--", label="dashed: of another scene")
    ax.set_yscale("symlog", linthresh=0.1)
    ax.set(xlabel="noise level sigma", ylabel="rise of the held-out flow error (%)")
    count = len(row["errors"]["all conditions"])
    ax.set_title(f"a condition taken away at test time (n = {count})")
    ax.set_ylim(top=2e6)  # room for the legend
    ax.set_yticks([-1, -0.1, 0, 0.1, 1, 10, 100, 1000, 10000])
    ax.legend(fontsize=6, ncols=2, loc="upper center", columnspacing=0.8)


def _finetune(ax, row: dict) -> None:
    for name in row["after"]:
        colour = CONDITIONS[name.removeprefix("without ")]
        for when, line in (("before", ":"), ("after", "-")):
            errors = np.mean(row[when][name], 0)
            ax.plot(row["sigmas"], errors, color=colour, ls=line, marker="o", ms=3,
                    label=name if when == "after" else None)  # fmt: skip
    ax.plot([], [], color="0.4", ls=":", label="dotted: before")
    steps = row["clocks"]["all conditions"]["steps"]
    ax.set(xlabel="noise level sigma", ylabel="held-out flow error")
    ax.set_title(f"trained on for {steps} steps without it")
    ax.set_ylim(top=1.5 * ax.get_ylim()[1])
    ax.legend(fontsize=6, ncols=2, loc="upper center", columnspacing=0.8)


def _spectrum(ax, row: dict) -> None:
    for family, s in row["spectrum"].items():
        if family != "others":
            ax.plot(range(1, 1 + len(s["relative"])), s["relative"], "o-", ms=3, label=family)
    ax.set(xscale="log", yscale="log", xlabel="singular value", ylabel="size over the largest")
    ax.set_ylim(bottom=1e-3)
    ax.set_title(f"LoRA update of rank {row['rank']}, mean of the layers; {WHERE[row['group']]}")
    ax.set_xticks([1, 2, 4, 8, 16, 32], ["1", "2", "4", "8", "16", "32"])
    ax.minorticks_off()
    ax.legend(fontsize=7)


def _ranks(ax, row: dict, outright: dict[str, dict]) -> None:
    last = {k: np.asarray(v) for k, v in row["losses"][str(row["rank"])].items()}
    names = list(row["losses"])
    for k, (term, label) in enumerate((("flow", "flow error"), ("photometric", "RGB head, MSE"))):

        def gap(losses, term=term):
            return bootstrap(100 * (np.asarray(losses[term]) / last[term] - 1))

        def bars(gaps, where, style, **words):
            mean, low, high = (np.array([g[key] for g in gaps]) for key in ("mean", "low", "high"))
            ax.errorbar(where, mean, [mean - low, high - mean], fmt=style, ms=4, capsize=3, **words)

        bars([gap(row["losses"][n]) for n in names], range(len(names)), f"C{k}o-", label=label)
        if outright:
            found = [gap(r["losses"][str(r["rank"])]) for r in outright.values()]
            where = [names.index(str(r["rank"])) + 0.2 for r in outright.values()]
            bars(found, where, f"C{k}s", mfc="none", label=f"{label}, trained at that rank")
    ax.axhline(0, color="k", lw=0.8)
    ax.set_xticks(range(len(names)), ["un-\ntrained" if n == "before" else n for n in names])
    ax.set(xlabel="rank kept", ylabel="held-out loss above the full update (%)")
    ax.set_title(f"the update cut to lower rank; {WHERE[row['group']]}")
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.2 * (high - low) * (1 + bool(outright)))  # room for the legend
    ax.legend(fontsize=7, loc="upper right")
