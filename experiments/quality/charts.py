"""Charts and tables of mini_quality.json."""

from typing import Any

from experiments import harness

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
PAIRED = ("latent_error", "psnr_to_euler50")  # differences within a scene
ROWS = (
    ("evaluations", "latent_error", "relative L2 error of the latents\n(grey: reference's self-error, dotted: Euler 50)"),
    ("seconds", "latent_error", "relative L2 error of the latents"),
    ("evaluations", "psnr_to_euler50", "PSNR to the truth minus Euler 50's, dB\n(green: 0.1 and 0.5 dB)"),
    ("seconds", "psnr_to_euler50", "PSNR to the truth minus Euler 50's, dB"),
    ("evaluations", "consistency", "agreement of frames 4 apart, dB\n(dotted: Euler 50; blur raises it)"),
    ("seconds", "consistency", "agreement of frames 4 apart, dB"),
    ("evaluations", "sharpness_ratio", "sharpness ratio to the truth\n(dotted: Euler 50)"),
)  # fmt: skip


def samplers(report: Report, name: str) -> None:
    """Rows: ROWS. Columns: schedules. Shaded: intervals over scenes; horizontal bars: the slowest and fastest run."""
    plt = harness.pyplot()
    seen_in = {r["schedule"] for r in report["records"]}
    schedules = [s for s in SCHEDULES if s in seen_in or s == "optimised"]
    default = report["verdict"]["default"].split()
    floor = report["reference"]["self_error"]["latent_error"]["mean"]
    euler = report["euler50"]["metrics"]
    columns = len(schedules)
    size = (3 + 3 * columns, 1 + 3.2 * len(ROWS))
    fig, axes = plt.subplots(len(ROWS), columns, figsize=size, sharey="row", squeeze=False)
    for column, schedule in enumerate(schedules):
        for solver in COLOURS:
            wanted = ("adaptive",) if solver == "bosh3" else (schedule,)
            mine = [
                r for r in report["records"] if r["solver"] == solver and r["schedule"] in wanted
            ]
            mine.sort(key=lambda r: r["evaluations"])
            if not mine:
                continue
            for ax, (x, metric, _) in zip(axes[:, column], ROWS):
                sampler_curve(ax, mine, x, metric, solver)
                for r in mine:
                    if [r["solver"], r["schedule"], str(r["steps"])] == default:
                        at = (work(r, x), value(r, metric)["mean"])
                        ax.plot(*at, "o", ms=14, mfc="none", mec="k", mew=1.6, zorder=5)
        for ax, (x, metric, label) in zip(axes[:, column], ROWS):
            ax.set_xscale("log")
            if x == "evaluations":
                ticks = [1, 2, 4, 6, 8, 12, 20]
                ax.set_xticks(ticks, [str(t) for t in ticks])
                ax.minorticks_off()
                ax.set_xlim(0.9, 30)
                ax.set_xlabel("velocity evaluations")
            else:
                ax.set_xlabel("seconds a scene (sampling)")
                plain_seconds(ax, [s for r in report["records"] for s in r["seconds"].values()])
            if metric == "psnr_to_euler50":
                for band, alpha in ((0.5, 0.12), (0.1, 0.25)):
                    ax.axhspan(-band, band, color="#7fbf7f", alpha=alpha, lw=0, zorder=0)
                ax.set_ylim(-0.8, 2.0)
            else:
                ax.axhline(euler[metric]["mean"], color="0.35", ls=":", lw=1.2)
            if metric == "latent_error":
                ax.set_yscale("log")
                ax.axhspan(floor / 10, floor, color="0.85", zorder=0)
                ax.set_ylim(floor / 2, 1.0)
            if column == 0:
                ax.set_ylabel(label)
        axes[0, column].set_title(f"schedule: {schedule}")
        if schedule not in seen_in:
            axes[0, column].text(
                0.5, 0.5, "none stored", transform=axes[0, column].transAxes, ha="center"
            )
    seen = {}
    for ax in axes.flat:
        for handle, label in zip(*ax.get_legend_handles_labels()):
            seen.setdefault(label, handle)
    seen["default"] = plt.Line2D([], [], ls="", marker="o", ms=11, mfc="none", mec="k", mew=1.6)
    fig.legend(seen.values(), seen, loc="lower center", ncol=2 * columns)
    fig.tight_layout(rect=(0, 0.6 / size[1], 1, 1))
    harness.save(fig, name)


def work(record: dict, x: str) -> float:
    return record["seconds"]["median"] if x == "seconds" else record[x]


def value(record: dict, metric: str) -> dict[str, float]:
    return record[metric] if metric == "psnr_to_euler50" else record["metrics"][metric]


def sampler_curve(ax: Any, records: list[dict], x: str, metric: str, solver: str) -> None:
    """One solver over `x`. Intervals where they say how sure a curve is: those of measures to the truth are about how
    scenes differ, the same for every solver, and would cover the picture.
    """
    colour = COLOURS[solver]
    found = [value(r, metric) for r in records]
    at, mean = [work(r, x) for r in records], [v["mean"] for v in found]
    label = "bosh3 (own steps: the same in every column)" if solver == "bosh3" else solver
    ax.plot(at, mean, color=colour, marker=MARKERS[solver], ms=4.5, lw=1.2, label=label)
    if metric in PAIRED:
        low, high = ([v[k] for v in found] for k in ("low", "high"))
        ax.fill_between(at, low, high, color=colour, alpha=0.08, lw=0)
    if x == "seconds":
        ends = ([r["seconds"][k] for r in records] for k in ("fastest", "slowest"))
        ax.hlines(mean, *ends, color=colour, lw=1, alpha=0.6)


def plain_seconds(ax, seconds: list[float]) -> None:
    """1, 2 and 5 as tick labels instead of powers, over all of `seconds`."""
    low, high = 0.8 * min(seconds), 1.25 * max(seconds)
    ticks = [d * 10.0**e for e in range(-4, 4) for d in (1, 2, 5) if low <= d * 10.0**e <= high]
    ax.set_xscale("log")
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.set_xlim(low, high)


def knobs(report: Report, name: str) -> None:
    """Photos, steps of the peers, size, precision, caches and refinement."""
    plt = harness.pyplot()
    records = report["knobs"]
    fig, axes = plt.subplots(2, 4, figsize=(20, 9))

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
    axes[0, 2].legend(loc="best")

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
    ax.legend()

    def point(ax, r, metric, colour, marker="o", text="", below=False):
        v, s = r["metrics"][metric], r["seconds"]
        across = [[s["median"] - s["fastest"]], [s["slowest"] - s["median"]]]
        up = [[v["mean"] - v["low"]], [v["high"] - v["mean"]]]
        ax.errorbar(s["median"], v["mean"], up, across, fmt=marker, color=colour, capsize=3)
        ax.annotate(text, (s["median"], v["mean"]), xytext=(7, -5 if below else 5), textcoords="offset points", va="top" if below else "bottom", fontsize=8)  # fmt: skip

    ax = axes[1, 1]
    sizes = [r for r in records if r["knob"] == "resolution"]
    for r in sizes:
        sharpness = r["metrics"]["sharpness_ratio"]["mean"]
        point(ax, r, "psnr", "#d62728", text=f"{r['value']}\nsharpness {sharpness:.2f}", below=True)
    ax.set(ylabel="PSNR at the training size, dB", title="size of photos and frames, default sampler")  # fmt: skip
    plain_seconds(ax, spread_of(sizes, 2))

    ax = axes[0, 3]
    numbers = [r for r in records if r["knob"] == "numbers"]
    for r in numbers:
        sharpness = r["metrics"]["sharpness_ratio"]["mean"]
        kind = "s" if r["value"] == "bfloat16" else "o"
        gap = f"\n{r['psnr_to_exact']['mean']:+.3f} dB" if "psnr_to_exact" in r else ""
        text = f"{r['value']}\nsharpness {sharpness:.3f}{gap}"
        point(ax, r, "psnr", "#d62728", kind, text, below=kind == "s")
    ax.set(ylabel="PSNR to the truth, dB", title="numbers of the weights, default sampler")
    plain_seconds(ax, spread_of(numbers, 2))

    ax = axes[1, 2]
    cached = [r for r in records if r["knob"] == "cache"]
    for r in cached:
        exact = r["value"].endswith(", exact")
        style = ("k", "o") if exact else ("#ff7f0e", "s")
        point(ax, r, "latent_error", *style, r["value"], below=not exact)
    at = [work(r, "seconds") for r in full]
    ax.plot(at, [r["metrics"]["latent_error"]["mean"] for r in full], color="#d62728", lw=1, marker=".", label=f"{solver} {schedule}, other step counts")  # fmt: skip
    ax.set(yscale="log", ylabel="relative L2 error of the latents", title="block cache (squares) against exact (dots)")  # fmt: skip
    plain_seconds(ax, spread_of([*full, *cached], 25))
    ax.legend()

    ax = axes[1, 3]
    toys = [r for r in records if r["knob"] == "refinement"]
    for r in toys:
        s = r["seconds"]
        across = [[s["median"] - s["fastest"]], [s["slowest"] - s["median"]]]
        gap = r["relative_difference_of_features"]
        ax.errorbar(s["median"], gap, None, across, fmt="o", color="k", capsize=3)
        kind = {"per_view": "exact (per view)"}.get(r["value"], r["value"])
        ax.annotate(f"{kind}\ndiffers by {gap:.3f}", (s["median"], gap), xytext=(7, 8), textcoords="offset points", fontsize=8)  # fmt: skip
    top = max((r["relative_difference_of_features"] for r in toys), default=0.0)
    ax.set(ylim=(-0.1 * top, 1.3 * top or 1.0), ylabel="relative L2 difference of ray features", title="refinement of scene tokens, random toy")  # fmt: skip
    plain_seconds(ax, spread_of(toys, 2))
    ax.set_xlabel("seconds, all views (ray features)")
    for ax in (axes[0, 3], axes[1, 1], axes[1, 2]):
        ax.set_xlabel("seconds a scene (sampling)")
    fig.tight_layout()
    harness.save(fig, name)


def spread_of(records: list[dict], room: float) -> list[float]:
    """All seconds of `records`, and `room` times the largest for what is written beside it."""
    seconds = [s for r in records for s in r["seconds"].values()]
    return [*seconds, room * max(seconds)]


def goals(verdict: dict[str, Any]) -> list[str]:
    """The rule of `mini_quality.verdict` and what it found, as Markdown."""
    lines = [
        "Goals. Reached: some sampler within the evaluations has Euler 50's PSNR within the limit, either way (mean over scenes, "
        "same photos and noise), and its sharpness within 2 %. Named: of those, the closest to the reference.",
        "",
    ]
    number = lambda v: f"{v['mean']:.2f} ({v['low']:.2f} .. {v['high']:.2f})"  # noqa: E731
    for goal in verdict["goals"]:
        state = "reached" if goal["reached"] else "**not reached**"
        lines.append(
            f"* at most {goal['evaluations']} evaluations within {goal['limit_db']} dB of Euler 50: {state} by {goal['passing']} of "
            f"{goal['samplers']} samplers, {goal['passing_by_interval']} with their whole interval "
            f"(`{goal['point']}`: {number(goal['psnr_to_euler50'])} dB)."
        )
    fewest = verdict.get("fewest_evaluations_within_goal", "none")
    return [
        *lines,
        f"* fewest evaluations within 0.1 dB and 2 % of sharpness of Euler 50: `{fewest}`; the default is `{verdict['default']}`.",
    ]


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
        f"sharpness {number(euler['metrics']['sharpness_ratio'])}, {euler['seconds']['median']:.2f} s a scene. "
        "Seconds: median of three runs after an uncounted one (fastest and slowest in the JSON and the charts).",
        "",
        "Closest to the reference within each number of evaluations, on each schedule:",
        "",
    ]
    rows: list[list] = []
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
            row = [r["evaluations"], schedule, f"`{r['solver']}`, {r['steps']}"]
            row += [f"{m['latent_error']['mean']:.4f}", number(r["psnr_to_euler50"])]
            row += [f"{m['sharpness_ratio']['mean']:.3f}", f"{m['psnr_reference']['mean']:.1f}"]
            rows.append([*row, f"{r['seconds']['median']:.2f}"])
    columns = [
        "evaluations",
        "schedule",
        "solver, steps",
        "latent error",
        "PSNR minus Euler 50's, dB",
    ]
    columns += ["sharpness", "dB to the reference's frames", "s a scene"]
    lines += harness.table(columns, rows)
    solver, schedule, _ = report["verdict"]["default"].split()
    own = [r for r in report["records"] if r["solver"] == solver and r["schedule"] == schedule]
    columns = ["evaluations", "latent error to the reference", "PSNR, dB", "sharpness"]
    columns += ["PSNR of gradients, dB", "agreement of frames, dB", "s a scene"]
    rows = []
    for r in sorted(own, key=lambda r: r["evaluations"]):
        v = r["metrics"]
        row = [r["evaluations"], f"{v['latent_error']['mean']:.3f}", number(v["psnr"])]
        row += [f"{v['sharpness_ratio']['mean']:.3f}", f"{v['gradient_psnr']['mean']:.2f}"]
        rows.append([*row, f"{v['consistency']['mean']:.1f}", f"{r['seconds']['median']:.2f}"])
    lines += [
        "",
        f"`{solver}`, `{schedule}`, against the truth:",
        "",
        *harness.table(columns, rows),
    ]
    lines += ["", *goals(report["verdict"]), "", "Other knobs, default sampler:", ""]
    columns = ["knob", "value", "method", "PSNR, dB", "sharpness", "agreement, dB", "s a scene"]
    rows = []
    for r in report["knobs"]:
        if "metrics" not in r:
            continue
        m = r["metrics"]
        seconds = f"{r['seconds']['median']:.2f}" if "seconds" in r else ""
        row = [r["knob"], r["value"], r["method"], number(m["psnr"])]
        row += [f"{m['sharpness_ratio']['mean']:.3f}", f"{m['consistency']['mean']:.1f}", seconds]
        rows.append(row)
    for r in report["knobs"]:
        if r["knob"] == "refinement":
            gap = f"differs by {r['relative_difference_of_features']:.3f}"
            row = ["refinement", r["value"], r["method"], gap, "", ""]
            rows.append([*row, f"{r['seconds']['median']:.3f}"])
    return "\n".join([*lines, *harness.table(columns, rows)])
