"""Charts and tables of mini_quality.json."""

from pathlib import Path
from typing import Any

Report = dict[str, Any]
COLOURS = {
    "euler": "#888888", "midpoint": "#1f77b4", "heun": "#17becf", "rk4": "#9467bd", "ab2": "#d62728",
    "ab3": "#ff7f0e", "dpmpp_2m": "#2ca02c", "unipc_2": "#000000", "rkc2": "#bcbd22", "rkc2_8": "#8c564b",
    "bosh3": "#e377c2",
}  # fmt: skip
MARKERS = dict(zip(COLOURS, "osD^v<>PhXx"))
METHODS = {
    "generated": ("#d62728", "o"),
    "generation only": ("#ff9896", "v"),
    "RGB head": ("#1f77b4", "s"),
    "plane": ("#2ca02c", "D"),
    "nearest photo": ("#888888", "x"),
    "mean photo": ("#bbbbbb", "+"),
}

SCHEDULES = ("uniform", "shift", "graded", "optimised")


def samplers(report: Report, path: Path) -> None:
    """Rows: error over evaluations, PSNR and sharpness beside Euler's, error over seconds. Columns: schedules."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    seen_in = {r["schedule"] for r in report["records"]}
    schedules = [s for s in SCHEDULES if s in seen_in or s == "optimised"]
    default = report["verdict"]["default"].split()
    floor = report["reference"]["self_error"]["latent_error"]["mean"]
    euler = report["euler50"]["metrics"]
    columns = len(schedules)
    fig, axes = plt.subplots(4, columns, figsize=(3 + 3 * columns, 14), sharey="row", squeeze=False)
    for column, schedule in enumerate(schedules):
        for solver in COLOURS:
            wanted = ("adaptive",) if solver == "bosh3" else (schedule,)
            mine = [
                r for r in report["records"] if r["solver"] == solver and r["schedule"] in wanted
            ]
            mine.sort(key=lambda r: r["evaluations"])
            if not mine:
                continue
            style = {"color": COLOURS[solver], "marker": MARKERS[solver], "ms": 4.5, "lw": 1.2}
            for row, (x, value) in enumerate(ROWS):
                ax = axes[row, column]
                found = [value(r) for r in mine]
                ax.plot([r[x] for r in mine], [v["mean"] for v in found], label=solver, **style)
                low, high = ([v[k] for v in found] for k in ("low", "high"))
                ax.fill_between(
                    [r[x] for r in mine], low, high, color=COLOURS[solver], alpha=0.08, lw=0
                )
                for r, v in zip(mine, found):
                    if [r["solver"], r["schedule"], str(r["steps"])] == default:
                        ax.plot(r[x], v["mean"], "o", ms=14, mfc="none", mec="k", mew=1.6, zorder=5)
        for row, (x, _) in enumerate(ROWS):
            ax = axes[row, column]
            ax.set_xscale("log")
            ax.grid(True, which="major", alpha=0.25)
            if x == "evaluations":
                ticks = [1, 2, 4, 6, 8, 12, 20]
                ax.set_xticks(ticks, [str(t) for t in ticks])
                ax.minorticks_off()
                ax.set_xlim(0.9, 30)
                ax.set_xlabel("velocity evaluations")
            else:
                ax.set_xlabel("seconds a scene (sampling)")
                plain_seconds(ax, [r["seconds"] for r in report["records"]])
        for row in (0, 3):
            ax = axes[row, column]
            ax.set_yscale("log")
            ax.axhspan(floor / 10, floor, color="0.85", zorder=0)
            ax.axhline(euler["latent_error"]["mean"], color="0.35", ls=":", lw=1.2)
            ax.set_ylim(floor / 2, 1.0)
        axes[0, column].set_title(f"schedule: {schedule}")
        for band, alpha in ((0.5, 0.12), (0.1, 0.25)):
            axes[1, column].axhspan(-band, band, color="#7fbf7f", alpha=alpha, lw=0, zorder=0)
        axes[1, column].set_ylim(-0.8, 2.0)
        axes[2, column].axhline(euler["sharpness_ratio"]["mean"], color="0.35", ls=":", lw=1.2)
        if schedule == "optimised" and not any(
            r["schedule"] == schedule for r in report["records"]
        ):
            axes[0, column].text(
                0.5, 0.5, "none stored", transform=axes[0, column].transAxes, ha="center"
            )
    labels = (
        "relative L2 error of the latents\n(grey: reference's self-error, dotted: Euler 50)",
        "PSNR to the truth minus Euler 50's, dB\n(green: 0.1 and 0.5 dB)",
        "sharpness ratio to the truth\n(dotted: Euler 50)",
        "relative L2 error of the latents",
    )
    for row, label in enumerate(labels):
        axes[row, 0].set_ylabel(label)
    seen = {}
    for ax in axes.flat:
        for handle, label in zip(*ax.get_legend_handles_labels()):
            seen.setdefault(label, handle)
    seen["default"] = plt.Line2D([], [], ls="", marker="o", ms=11, mfc="none", mec="k", mew=1.6)
    fig.legend(seen.values(), seen, loc="lower center", ncol=3 * columns, frameon=False)
    fig.tight_layout(rect=(0, 0.035, 1, 1))
    fig.savefig(path, dpi=75)
    plt.close(fig)


def plain_seconds(ax, seconds: list[float]) -> None:
    """1, 2 and 5 as tick labels instead of powers, over all of `seconds`."""
    low, high = 0.8 * min(seconds), 1.25 * max(seconds)
    ticks = [d * 10.0**e for e in range(-4, 4) for d in (1, 2, 5) if low <= d * 10.0**e <= high]
    ax.set_xscale("log")
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.set_xlim(low, high)


ROWS = (
    ("evaluations", lambda r: r["metrics"]["latent_error"]),
    ("evaluations", lambda r: r["psnr_to_euler50"]),
    ("evaluations", lambda r: r["metrics"]["sharpness_ratio"]),
    ("seconds", lambda r: r["metrics"]["latent_error"]),
)


def knobs(report: Report, path: Path) -> None:
    """Photos, steps of the peers, size, caches and precision."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    records = report["knobs"]
    fig, axes = plt.subplots(2, 3, figsize=(15, 9))

    def curve(ax, rows, metric, x, method, label=None):
        colour, marker = METHODS[method]
        if method == "generation only":
            trained = report["settings"].get("generation_only")
            label = f"generation only ({f'stage {trained}' if trained else 'no rays, no features'})"
        values = [r["metrics"][metric] for r in rows]
        ax.plot([x(r) for r in rows], [v["mean"] for v in values], color=colour, marker=marker, ms=5, label=label or method)  # fmt: skip
        ax.fill_between([x(r) for r in rows], [v["low"] for v in values], [v["high"] for v in values], color=colour, alpha=0.1, lw=0)  # fmt: skip

    ceiling = {r["value"]: r["metrics"] for r in records if r["knob"] == "ceiling"}
    for ax, metric, label in (
        (axes[0, 0], "psnr", "PSNR to the truth, dB"),
        (axes[0, 1], "sharpness_ratio", "sharpness ratio to the truth"),
        (axes[0, 2], "consistency", "agreement of frames 4 apart, dB"),
    ):
        for method in METHODS:
            rows = [r for r in records if r["knob"] == "M" and r["method"] == method]
            curve(ax, rows, metric, lambda r: r["value"], method)
        ax.axhline(ceiling["VAE round trip"][metric]["mean"], color="k", ls="--", lw=1, label="VAE round trip of the truth")  # fmt: skip
        if metric == "consistency":
            ax.axhline(ceiling["truth"][metric]["mean"], color="k", ls=":", lw=1, label="the truth itself")  # fmt: skip
            ax.set_ylim(top=ceiling["truth"][metric]["mean"] + 8)  # one photo for all frames
        ax.set(
            xlabel="photos M",
            ylabel=label,
            xticks=sorted({r["value"] for r in records if r["knob"] == "M"}),
        )
    axes[0, 2].legend(fontsize=8, loc="best")

    ax = axes[1, 0]
    solver, schedule, _ = report["verdict"]["default"].split()
    full = [r for r in report["records"] if r["solver"] == solver and r["schedule"] == schedule]
    full.sort(key=lambda r: r["evaluations"])
    curve(ax, full, "psnr", lambda r: r["evaluations"], "generated", f"generated ({solver} {schedule})")  # fmt: skip
    bare = [r for r in records if r["knob"] == "steps"]
    curve(ax, bare, "psnr", lambda r: r["evaluations"], "generation only")
    for method in ("RGB head", "plane"):
        rows = [
            r for r in records if r["knob"] == "M" and r["method"] == method and r["value"] == 3
        ]
        ax.axhline(rows[0]["metrics"]["psnr"]["mean"], color=METHODS[method][0], ls="--", lw=1, label=f"{method} (no steps)")  # fmt: skip
    ticks = [1, 2, 4, 6, 8, 12, 20, 50]
    ax.set_xscale("log")
    ax.set_xticks(ticks, [str(t) for t in ticks])
    ax.minorticks_off()
    ax.set(xlabel="velocity evaluations (3 photos)", ylabel="PSNR to the truth, dB")
    ax.legend(fontsize=8)

    ax = axes[1, 1]
    for r in (r for r in records if r["knob"] == "resolution"):
        v = r["metrics"]["psnr"]
        ax.errorbar(r["seconds"], v["mean"], [[v["mean"] - v["low"]], [v["high"] - v["mean"]]], fmt="o", color="#d62728", capsize=3)  # fmt: skip
        ax.annotate(f"{r['value']}\nsharpness {r['metrics']['sharpness_ratio']['mean']:.2f}", (r["seconds"], v["mean"]), xytext=(7, 5), textcoords="offset points", fontsize=8)  # fmt: skip
    ax.set(xlabel="seconds a scene (sampling)", ylabel="PSNR at the training size, dB", title="size of photos and frames, default sampler")  # fmt: skip
    seconds = [r["seconds"] for r in records if r["knob"] == "resolution"]
    plain_seconds(ax, [min(seconds), 2 * max(seconds)])

    ax = axes[1, 2]
    cached = [r for r in records if r["knob"] == "cache"]
    for r in cached:
        kind = r["value"].split(", ")[1]
        v = r["metrics"]["latent_error"]
        ax.errorbar(r["seconds"], v["mean"], [[v["mean"] - v["low"]], [v["high"] - v["mean"]]], fmt="o" if kind == "exact" else "s", color="k" if kind == "exact" else "#ff7f0e", capsize=3)  # fmt: skip
        ax.annotate(r["value"], (r["seconds"], v["mean"]), xytext=(7, 8 if kind == "exact" else -12), textcoords="offset points", fontsize=8)  # fmt: skip
    ax.plot([r["seconds"] for r in full], [r["metrics"]["latent_error"]["mean"] for r in full], color="#d62728", lw=1, marker=".", label=f"{solver} {schedule}, other step counts")  # fmt: skip
    ax.set(yscale="log", xlabel="seconds a scene (sampling)", ylabel="relative L2 error of the latents", title="block cache (squares) against exact (dots)")  # fmt: skip
    seconds = [r["seconds"] for r in [*full, *cached]]
    plain_seconds(ax, [min(seconds), 3 * max(seconds)])
    ax.legend(fontsize=8)
    for ax in axes.flat:
        ax.grid(True, alpha=0.25)
    fig.tight_layout()
    fig.savefig(path, dpi=75)
    plt.close(fig)


def with_tables(text: str, report: Report) -> str:
    """The document with everything between the markers written anew."""
    begin, end = "<!-- mini_quality: written by the experiment -->", "<!-- /mini_quality -->"
    head, _, rest = text.partition(begin)
    assert rest, f"docs/solvers.md lacks the marker {begin}"
    _, _, tail = rest.partition(end)
    return f"{head}{begin}\n{tables(report)}\n{end}{tail}"


def tables(report: Report) -> str:
    """The measured numbers as Markdown."""
    s, euler = report["settings"], report["euler50"]
    number = lambda v, d=2: f"{v['mean']:.{d}f} ({v['low']:.{d}f} .. {v['high']:.{d}f})"  # noqa: E731
    lines = [
        f"`{s['command']}`: held-out procedural scenes {s['scenes'][0]} .. {s['scenes'][1]}, "
        f"{s['photos']} photos, weights {s['weights']}, schedules found on {s['schedules_found_on']}, "
        f"{report['device']}, {report['seconds']:.0f} s in all. Mean (95 % bootstrap interval over scenes).",
        "",
        f"Reference: {s['reference']}, self-error {report['reference']['self_error']['latent_error']['mean']:.1e}, "
        f"PSNR {number(report['reference']['metrics']['psnr'])} dB, sharpness {number(report['reference']['metrics']['sharpness_ratio'])}. "
        f"Euler, 50 uniform steps: latent error {euler['metrics']['latent_error']['mean']:.3f}, PSNR {number(euler['metrics']['psnr'])} dB, "
        f"sharpness {number(euler['metrics']['sharpness_ratio'])}, {euler['seconds']:.2f} s a scene.",
        "",
        "Closest to the reference within each number of evaluations, on each schedule:",
        "",
        "| evaluations | schedule | solver, steps | latent error | PSNR minus Euler 50's, dB | sharpness | dB to the reference's frames | s a scene |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for budget in (2, 4, 6, 8, 12, 20):
        for schedule in SCHEDULES:
            fit = [
                r
                for r in report["records"]
                if r["schedule"] == schedule and budget - 1 <= r["evaluations"] <= budget
            ]
            if not fit:
                continue
            r = min(fit, key=lambda r: r["metrics"]["latent_error"]["mean"])
            m = r["metrics"]
            lines.append(
                f"| {r['evaluations']} | {schedule} | `{r['solver']}`, {r['steps']} | {m['latent_error']['mean']:.4f} | "
                f"{number(r['psnr_to_euler50'])} | {m['sharpness_ratio']['mean']:.3f} | {m['psnr_reference']['mean']:.1f} | {r['seconds']:.2f} |"
            )
    solver, schedule, _ = report["verdict"]["default"].split()
    own = [r for r in report["records"] if r["solver"] == solver and r["schedule"] == schedule]
    lines += [
        "",
        f"`{solver}`, `{schedule}`, against the truth:",
        "",
        "| evaluations | latent error to the reference | PSNR, dB | sharpness | PSNR of gradients, dB | agreement of frames, dB | s a scene |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in sorted(own, key=lambda r: r["evaluations"]):
        v = r["metrics"]
        lines.append(
            f"| {r['evaluations']} | {v['latent_error']['mean']:.3f} | {number(v['psnr'])} | {v['sharpness_ratio']['mean']:.3f} | "
            f"{v['gradient_psnr']['mean']:.2f} | {v['consistency']['mean']:.1f} | {r['seconds']:.2f} |"
        )
    lines += ["", "Goals (two-sided, by the point closest to the reference):", ""]
    for goal in report["verdict"]["goals"]:
        state = "reached" if goal["reached"] else "**not reached**"
        sure = "" if goal["reached_by_interval"] else ", not by the whole interval"
        lines.append(
            f"* at most {goal['evaluations']} evaluations within {goal['limit_db']} dB of Euler 50: {state}{sure} "
            f"(`{goal['point']}`: {number(goal['psnr_to_euler50'])} dB)."
        )
    fewest = report["verdict"].get("fewest_evaluations_within_goal", "none")
    lines += [
        f"* fewest evaluations within 0.1 dB and 2 % of sharpness of Euler 50: `{fewest}`; "
        f"the default is `{report['verdict']['default']}`.",
        "",
        "Other knobs, default sampler:",
        "",
        "| knob | value | method | PSNR, dB | sharpness | agreement, dB | s a scene |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in report["knobs"]:
        if "metrics" not in r:
            continue
        m = r["metrics"]
        seconds = f"{r['seconds']:.2f}" if "seconds" in r else ""
        lines.append(
            f"| {r['knob']} | {r['value']} | {r['method']} | {number(m['psnr'])} | {m['sharpness_ratio']['mean']:.3f} | "
            f"{m['consistency']['mean']:.1f} | {seconds} |"
        )
    for r in report["knobs"]:
        if r["knob"] == "refinement":
            lines.append(
                f"| refinement | {r['value']} | {r['method']} | differs by {r['relative_difference_of_features']:.3f} | | | {r['seconds']:.3f} |"
            )
    return "\n".join(lines)
