"""Tables and the chart of the ablation, from its JSON."""

from pathlib import Path

import numpy as np

from roge_jax.metrics.report import bootstrap

from .common import SIGMAS
from .reconstruction import VARIANTS


def difference(rows: dict[str, dict], name: str) -> dict[str, float]:
    """Paired difference in dB of a variant to its reference, over the held-out scenes.

    The reference is the mean over all seeds of the base where it is the base; a second seed of the base is compared
    with the first alone, which shows what a seed is worth.
    """
    row = rows[name]
    base = [r["psnr"] for r in rows.values() if r["question"] == "seed"]
    reference = rows[row["reference"]]["psnr"] if row["reference"] != "base" else np.mean(base, 0)
    if row["question"] == "seed":
        reference = rows["base"]["psnr"]
    return bootstrap(np.asarray(row["psnr"]) - np.asarray(reference))


def verdict(d: dict[str, float], noise: float) -> str:
    """What an interval says, given the difference that a mere seed makes."""
    if d["low"] <= 0 <= d["high"] or abs(d["mean"]) <= noise:
        return "undecided"
    return "better" if d["mean"] > 0 else "worse"


def seed_noise(recon: dict[str, dict]) -> float:
    seeds = [n for n, r in recon.items() if r["question"] == "seed" and n != "base"]
    return max((abs(difference(recon, n)["mean"]) for n in seeds), default=0.0)


def ready(recon: dict[str, dict]) -> dict[str, dict]:
    """The rows whose reference is there."""
    return {n: r for n, r in recon.items() if r["reference"] in recon and "base" in recon}


def tables(rows: dict[str, dict]) -> str:
    """The results as markdown."""
    recon = {n: r for n, r in rows.items() if r["group"] == "reconstruction"}
    noise, lines = seed_noise(recon), []
    lines += [
        "| variant | parameters (M) | steps | core-s | PSNR | difference (dB) [95 %] | halfway | verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, row in ready(recon).items():
        d = difference(recon, name)
        base = np.mean([r["halfway"] for r in recon.values() if r["question"] == "seed"])
        if row["reference"] != "base":
            base = recon[row["reference"]]["halfway"]
        early = row["halfway"] - base
        word = "(reference)" if row["question"] == "seed" else verdict(d, noise)
        versus = "" if row["reference"] == "base" else f", against {row['reference']}"
        shown = f"{d['mean']:+.2f} [{d['low']:+.2f}, {d['high']:+.2f}]{versus}"
        lines.append(
            f"| {name} | {row['parameters'] / 1e6:.2f} | {row['steps']} | {row['core_seconds']:.0f} | "
            f"{np.mean(row['psnr']):.2f} | {shown if name != 'base' else ''} | {early:+.2f} | {word} |"
        )
    if "look-up" in rows:
        row = rows["look-up"]
        lines += ["", "| photos | " + " | ".join(row["parts"]) + " | both over RGB head [95 %] |"]
        lines += ["|---" * (len(row["parts"]) + 2) + "|"]
        for m, each in row["psnr"].items():
            d = bootstrap(np.subtract(each[-1], each[0]))
            cells = " | ".join(f"{np.mean(x):.2f}" for x in each)
            lines.append(
                f"| {m} | {cells} | {d['mean']:+.2f} [{d['low']:+.2f}, {d['high']:+.2f}] |"
            )
    if "conditions" in rows:
        found = {n: np.asarray(e) for n, e in rows["conditions"]["errors"].items()}
        whole = found["all conditions"]
        lines += [
            "",
            "| condition | " + " | ".join(f"{s:g}" for s in SIGMAS) + " | mean rise [95 %] |",
        ]
        lines += ["|---" * (len(SIGMAS) + 2) + "|"]
        for name, e in found.items():
            d = bootstrap((e - whole).mean(1))
            rise = f"{d['mean']:+.3f} [{d['low']:+.3f}, {d['high']:+.3f}]"
            cells = " | ".join(f"{x:.3f}" for x in e.mean(0))
            lines.append(f"| {name} | {cells} | {rise if name != 'all conditions' else ''} |")
        itself = rows["conditions"].get("preview_itself")
        if itself:  # at sigma 1 a flow error is that of a guess of x0
            lines += ["", f"The preview's own latents, taken for x0: {np.mean(itself):.3f}."]
    if "finetune" in rows:
        row = rows["finetune"]
        whole = np.asarray(row["after"]["all conditions"])
        lines += [
            "",
            "| trained on | flow error before | after | after, against all [95 %] | core-s |",
        ]
        lines += ["|---|---|---|---|---|"]
        for name in row["after"]:
            before, after = (np.asarray(row[k][name]) for k in ("before", "after"))
            d = bootstrap((after - whole).mean(1))
            more = f"{d['mean']:+.3f} [{d['low']:+.3f}, {d['high']:+.3f}]"
            lines.append(
                f"| {name} | {before.mean():.3f} | {after.mean():.3f} | "
                f"{more if name != 'all conditions' else ''} | {row['clocks'][name]['core_seconds']:.0f} |"
            )
    if "lora" in rows:
        row = rows["lora"]
        lines += ["", f"LoRA, {row['steps']} steps, {len(row['losses']['0']['flow'])} scenes:"]
        lines += ["", "| layers | matrices | stable rank | rank of 90 % | of 99 % of the energy |"]
        lines += ["|---|---|---|---|---|"]
        for family, s in row["spectrum"].items():
            lines.append(
                f"| {family} | {s['matrices']} | {s['stable_rank']:.1f} | {s['rank_90']:.1f} | {s['rank_99']:.1f} |"
            )
        lines += [
            "",
            "| rank kept | flow error | change to the full update [95 %] | RGB head, MSE x 1000 |",
        ]
        lines += ["|---|---|---|---|"]
        last = np.asarray(row["losses"][str(row["rank"])]["flow"])
        for name, loss in row["losses"].items():
            d = bootstrap(np.asarray(loss["flow"]) - last)
            change = f"{d['mean']:+.4f} [{d['low']:+.4f}, {d['high']:+.4f}]"
            label = {"before": "untrained", "0": "0 (E1 and new embeddings alone)"}.get(name, name)
            lines.append(
                f"| {label} | {np.mean(loss['flow']):.4f} | {change if name != str(row['rank']) else ''} | "
                f"{1000 * np.mean(loss['photometric']):.3f} |"
            )
    missing = [n for n in (*VARIANTS, "look-up", "conditions", "finetune", "lora") if n not in rows]
    if missing:
        lines += ["", f"Not run yet: {', '.join(missing)}."]
    return "\n".join(lines)


def write_tables(rows: dict[str, dict], doc: Path) -> None:
    """Replace what stands between the markers of the document."""
    if not doc.exists():
        return
    head, _, rest = doc.read_text().partition("<!-- tables -->\n")
    tail = rest.partition("<!-- end -->")[2]
    doc.write_text(f"{head}<!-- tables -->\n\n{tables(rows)}\n\n<!-- end -->{tail}")


COLOURS = {"better": "C2", "worse": "C3", "undecided": "0.55", "(reference)": "k"}


def draw(rows: dict[str, dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig = plt.figure(figsize=(16.5, 9.5))
    outer = fig.add_gridspec(
        1, 2, width_ratios=[1, 1.45], left=0.165, right=0.985, top=0.95, bottom=0.075, wspace=0.17
    )
    _variants(fig.add_subplot(outer[0]), rows)
    right = outer[1].subgridspec(2, 2, hspace=0.27, wspace=0.3)
    panels = {"conditions": _conditions, "finetune": _finetune, "lora": _spectrum}
    cells = (right[0, 0], right[0, 1], right[1, 0])
    for (name, panel), cell in zip(panels.items(), cells):
        if name in rows:
            panel(fig.add_subplot(cell), rows[name])
    if "lora" in rows:
        _ranks(fig.add_subplot(right[1, 1]), rows["lora"])
    fig.savefig(path, dpi=80)
    plt.close(fig)


def _variants(ax, rows: dict[str, dict]) -> None:
    recon = ready({n: r for n, r in rows.items() if r["group"] == "reconstruction"})
    noise = seed_noise(recon)
    names = [n for n in recon if n != "base"][::-1]
    if not names:
        return
    ax.axvspan(-noise, noise, color="0.9", zorder=0, label=f"seed of the base: {noise:.2f} dB")
    ax.axvline(0, color="k", lw=0.8)
    for y, name in enumerate(names):
        d, row = difference(recon, name), recon[name]
        word = "(reference)" if row["question"] == "seed" else verdict(d, noise)
        bar = [[d["mean"] - d["low"]], [d["high"] - d["mean"]]]
        ax.errorbar(d["mean"], y, xerr=bar, fmt="o", color=COLOURS[word], capsize=3, ms=6)
    for word, colour in COLOURS.items():
        ax.plot([], [], "o", color=colour, label=word.strip("()"))
    labels = []
    for name in names:
        versus = recon[name]["reference"]
        more = "" if versus == "base" else f"\nagainst {versus}"
        labels.append(f"{name} ({recon[name]['steps']} steps){more}")
    ax.set_yticks(range(len(names)), labels, fontsize=9)
    ax.set_xlabel("held-out PSNR less that of the base (dB), mean and 95 % interval over scenes")
    base = recon["base"]
    ax.set_title(
        f"{base['tera_flop']:.1f} TFLOP each; base: {base['steps']} steps, {np.mean(base['psnr']):.2f} dB, "
        f"n = {len(base['psnr'])} scenes",
        fontsize=10,
    )
    ax.grid(True, axis="x", alpha=0.3)
    ax.legend(fontsize=8, loc="best")


def _conditions(ax, row: dict) -> None:
    whole = np.mean(row["errors"]["all conditions"], 0)
    words = [n for n in row["errors"] if n.endswith(": zero")]
    styles = {n: (f"C{k}", "-") for k, n in enumerate(words)}
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
    ax.set_title(f"a condition taken away at test time (n = {count})", fontsize=10)
    ax.grid(True, alpha=0.3)
    ax.set_ylim(top=1e5)  # room for the legend
    ax.legend(fontsize=6, ncols=2, loc="upper center", columnspacing=0.8)


def _finetune(ax, row: dict) -> None:
    for k, name in enumerate(row["after"]):
        for when, line in (("before", ":"), ("after", "-")):
            errors = np.mean(row[when][name], 0)
            ax.plot(row["sigmas"], errors, color=f"C{k}", ls=line, marker="o", ms=3,
                    label=name if when == "after" else None)  # fmt: skip
    ax.plot([], [], color="0.4", ls=":", label="dotted: before")
    steps = row["clocks"]["all conditions"]["steps"]
    ax.set(xlabel="noise level sigma", ylabel="held-out flow error")
    ax.set_title(f"trained on for {steps} steps without it", fontsize=10)
    ax.grid(True, alpha=0.3)
    ax.set_ylim(top=1.5 * ax.get_ylim()[1])
    ax.legend(fontsize=6, ncols=2, loc="upper center", columnspacing=0.8)


def _spectrum(ax, row: dict) -> None:
    for family, s in row["spectrum"].items():
        if family != "others":
            ax.plot(range(1, 1 + len(s["relative"])), s["relative"], "o-", ms=3, label=family)
    ax.set(xscale="log", yscale="log", xlabel="singular value", ylabel="size over the largest")
    ax.set_ylim(bottom=1e-3)
    ax.set_title(f"LoRA update of rank {row['rank']}, mean of the layers", fontsize=10)
    ax.set_xticks([1, 2, 4, 8, 16, 32], ["1", "2", "4", "8", "16", "32"])
    ax.minorticks_off()
    ax.grid(True, alpha=0.3)
    ax.legend(fontsize=7)


def _ranks(ax, row: dict) -> None:
    last = {k: np.asarray(v) for k, v in row["losses"][str(row["rank"])].items()}
    for k, (term, label) in enumerate((("flow", "flow error"), ("photometric", "RGB head, MSE"))):
        gaps = []
        for loss in row["losses"].values():
            d = np.asarray(loss[term]) / last[term]
            gaps.append(bootstrap(100 * (d - 1)))
        mean, low, high = (np.array([g[key] for g in gaps]) for key in ("mean", "low", "high"))
        ax.errorbar(range(len(gaps)), mean, [mean - low, high - mean], fmt=f"C{k}o-", ms=4,
                    capsize=3, label=label)  # fmt: skip
    ax.axhline(0, color="k", lw=0.8)
    names = ["un-\ntrained" if n == "before" else n for n in row["losses"]]
    ax.set_xticks(range(len(names)), names)
    ax.set(xlabel="rank kept", ylabel="held-out loss above the full update (%)")
    ax.set_title("the update cut to lower rank", fontsize=10)
    ax.grid(True, alpha=0.3)
    ax.legend(fontsize=8)
