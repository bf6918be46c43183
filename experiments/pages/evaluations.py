"""The tables of docs/results/model_card.md and of the README, from what `roge_jax.evaluate` wrote into experiments/results.

        python -m experiments.pages.evaluations

Seconds. Run it after an evaluation. `make docs` runs it, and a test holds the committed page against the files.
"""

from typing import Any

from experiments import harness

PAGE = harness.DOCS / "results" / "model_card.md"
METHODS = {
    "generated": "generated video",
    "rgb_head": "reconstruction's own picture (preview)",
    "vae_round_trip": "*truth through the VAE*",
    "nearest": "copy of the nearest photo",
    "mean_context": "mean of the photos",
    "plane": "plane",
    "plane_sweep": "plane sweep, semi-global matching",
    "depth_warp": "warp by the true depth",
}
METRICS = {  # name: (title, digits, which is better)
    "psnr": ("PSNR", 2, max),
    "ssim": ("SSIM", 3, max),
    "lpips_alex": ("LPIPS", 3, min),
    "sharpness_ratio": ("sharpness (1 = truth)", 2, None),
    "temporal_ratio": ("temporal ratio", 2, min),
}
CEILINGS = ("vae_round_trip", "depth_warp")  # they know the truth: never the best
PAIRS = [
    ("rgb_head", "plane"),
    ("rgb_head", "plane_sweep"),
    ("rgb_head", "depth_warp"),
    ("generated", "rgb_head"),
    ("generated", "plane"),
    ("generated", "plane_sweep"),
]
# Marks in the page: file, whether scene by scene.
TABLES = {
    "narrow": ("mini_procedural.json", False),
    "wide": ("mini_wide.json", False),
    "apart": ("mini_real.json", True),
    "close": ("mini_close.json", True),
    "apart large": ("mini_real_192x336.json", True),
    "close large": ("mini_close_192x336.json", True),
}
README = harness.ROOT / "README.md"
FEW = ("generated", "rgb_head", "plane_sweep", "plane", "nearest")  # what the README compares
TWO = ("mini_close_192x336.json", "mini_real_192x336.json")  # there, side by side


def means(record: dict[str, Any]) -> list[str]:
    """Every method by every metric that the run has, PSNR with its interval; the best is bold."""
    found = record["means"]
    metrics = [name for name in METRICS if name in found["generated"]]
    rows = []
    for method, title in METHODS.items():
        if method not in found:
            continue
        cells = []
        for metric in metrics:
            _, digits, better = METRICS[metric]
            values = {
                m: row[metric] for m, row in found.items() if m not in CEILINGS and metric in row
            }
            text = f"{found[method][metric]:.{digits}f}" if metric in found[method] else ""
            if text and better and method in values and values[method] == better(values.values()):
                text = f"**{text}**"
            if metric == "psnr":
                interval = record["intervals"][method][metric]
                text += f" [{interval['low']:.2f}, {interval['high']:.2f}]"
            cells.append(text)
        rows.append([title, *cells])
    return harness.table(["", *(METRICS[name][0] for name in metrics)], rows)


def shown_by_scene(record: dict[str, Any]) -> list[str]:
    """The metrics of `by_scene`."""
    learned = [
        name for name in ("ssim", "lpips_alex") if "lpips_alex" in record["means"]["nearest"]
    ]
    return ["psnr", *learned]


def by_scene(record: dict[str, Any]) -> list[str]:
    """PSNR of every scene, with SSIM and LPIPS where that was measured, and the mean; the best by the last is bold."""
    methods = [method for method in METHODS if method in record["means"]]
    metrics = shown_by_scene(record)
    if len(metrics) > 1:
        methods = [method for method in methods if method in FEW]
    judge, rows = METRICS[metrics[-1]][2], []
    for entry in [*record["scenes"], {"scene": "mean", **record["means"]}]:
        values = {m: entry[m][metrics[-1]] for m in methods if m not in CEILINGS}
        best = judge(values, key=values.__getitem__)
        cells = [
            " / ".join(f"{entry[m][k]:.{METRICS[k][1]}f}".removeprefix("0") for k in metrics)
            for m in methods
        ]
        rows.append(
            [
                entry["scene"],
                *(f"**{c}**" if m == best else c for m, c in zip(methods, cells, strict=True)),
            ]
        )
    return harness.table(["scene", *(METHODS[method] for method in methods)], rows)


def paired(record: dict[str, Any]) -> list[str]:
    """Differences within scenes, with their intervals and the share of scenes that gain."""
    rows = []
    for one, other in PAIRS:
        found = record["differences"].get(one, {}).get(other, {})
        if "psnr" in found:
            cells = [
                f"{found[m]['mean']:+.{d}f} [{found[m]['low']:+.{d}f}, {found[m]['high']:+.{d}f}]"
                for m, d in (("psnr", 2), ("sharpness_ratio", 3))
            ]
            rows.append(
                [f"{METHODS[one]} minus {METHODS[other]}", *cells, f"{found['psnr']['wins']:.0%}"]
            )
    return harness.table(["paired by scene", "PSNR", "sharpness", "ahead in PSNR"], rows)


def side_by_side() -> list[str]:
    """The table of the README: `FEW` methods, photos close together and far apart; the best of a column is bold."""
    metrics = ("psnr", "ssim", "lpips_alex")
    columns = [(harness.read(file)["means"], metric) for file in TWO for metric in metrics]
    rows = []
    for method in FEW:
        cells = []
        for found, metric in columns:
            _, digits, better = METRICS[metric]
            text = f"{found[method][metric]:.{digits}f}".removeprefix("0")
            best = better(found[name][metric] for name in FEW)
            cells.append(f"**{text}**" if found[method][metric] == best else text)
        rows.append([METHODS[method], *cells[:3], "", *cells[3:]])
    titles = [METRICS[metric][0] for metric in metrics]
    return harness.table(["", *titles, "", *titles], rows)


def described(record: dict[str, Any]) -> str:
    """What was measured, in a line."""
    settings = record["settings"]
    height, width = settings["size"]
    views = (
        f"{settings['close']} views of each"
        if settings["close"]
        else f"{settings['frames']} frames"
    )
    scenes = f"{len(record['scenes'])} scenes"
    sampler = f"{settings['steps']} {settings['schedule']} steps of {settings['solver']}"
    return f"{scenes}, {settings['context']} photos, {views}, {height}x{width}, {sampler}, seed {settings['seed']}."


def tables() -> dict[str, str]:
    """{mark: text} of the page."""
    found = {}
    for mark, (file, scene_by_scene) in TABLES.items():
        record = harness.read(file)
        lines = [described(record), "", *means(record), "", *paired(record)]
        if scene_by_scene:
            names = " / ".join(METRICS[name][0] for name in shown_by_scene(record))
            lines += ["", f"{names} by scene:", "", *by_scene(record)]
        found[mark] = "\n".join(lines)
    return found


if __name__ == "__main__":
    for mark, text in tables().items():
        harness.put(PAGE, mark, text)
    harness.put(README, "scores", "\n".join(side_by_side()))
    print(PAGE.relative_to(harness.ROOT), *TABLES)
