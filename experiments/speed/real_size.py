"""Speed at the published sizes on one accelerator, with PyTorch beside it; a scaled-down ladder where there is none.

    python -m experiments.speed.real_size                  real sizes on a GPU, the ladder on a CPU
    taskset -c 3 python -m experiments.speed.real_size     on a CPU: one core, so that both frameworks use one thread
    python -m experiments.speed.real_size --minutes 60 --only dit,vae    some rows, in a limited time
    python -m experiments.speed.real_size --resume         what has not been measured yet

Every row runs in a process of its own, first ours, then the peer (rows of the transformer): compiled ahead, two calls
to warm up, then the median and quartiles of ten. A row that fails, runs out of memory or of time says so, with the end
of what it printed, and leaves the others; the results are written after every row, so that an interrupted run keeps
them. Rows that a run does not reach keep what the file has of them; every row says its device, time and commit.
No network, photos or video codecs are needed. Goals are for one H100 or H200; the paper states no times.

Writes experiments/results/real_size.json and .png and prints a table. A full run on a GPU takes one to two hours by
estimate (never run on one so far), the ladder on a CPU about 10 minutes.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from experiments import harness

ROW = ["-m", "experiments.speed.real_size"]  # the program of one side of one row
LOG_CHARACTERS = 2000  # kept of what a failed row printed
GROUPS = ("dit", "train", "vggt", "rays", "render", "vae", "sample", "numerics")


def on_gpu() -> bool:
    """Asked in another process: this one must not hold the device's memory."""
    code = "import jax; print(jax.default_backend())"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    return found.stdout.strip().endswith("gpu")


def device() -> dict:
    """Environment of the run, the GPU's name, driver and limits included."""
    code = "import json, jax; jax.devices(); from roge_jax.files.entry import environment; print(json.dumps(environment()))"
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=harness.ROOT
    )
    record = json.loads(found.stdout.splitlines()[-1]) if found.returncode == 0 else {}
    record["command"] = harness.command()
    fields = "name,driver_version,clocks.max.sm,power.limit"
    try:
        query = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader"]
        smi = subprocess.run(query, capture_output=True, text=True, timeout=30)
        record["nvidia_smi"] = dict(zip(fields.split(","), smi.stdout.strip().split(", ")))
    except (OSError, subprocess.TimeoutExpired):
        pass
    return record


def child(name: str, side: str, args: argparse.Namespace, limit: float) -> dict:
    """One side of one row in a process of its own, at most `limit` seconds long. Never raises for what happens there."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "row.json"
        command = [sys.executable, *ROW, "--row", name, "--side", side]
        command += ["--out", str(out), "--repeats", str(args.repeats)]
        command += ["--seconds", f"{0.4 * limit:.0f}"]
        settings = dict(os.environ)
        if side == "ours":
            settings.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.92")
        else:  # PyTorch needs the memory that JAX would reserve
            settings["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
        cache = harness.ROOT / ".jax_cache" / "real_size"
        settings.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
        with (Path(folder) / "log").open("w+") as log:
            try:
                code = subprocess.run(
                    command,
                    env=settings,
                    cwd=harness.ROOT,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    timeout=limit,
                ).returncode
            except subprocess.TimeoutExpired:
                code = None
            log.seek(0)
            said = log.read()
        end = {"log": said[-LOG_CHARACTERS:]}
        if code is None:
            return {"status": "out of time", "why": f"not done after {limit:.0f} s"} | end
        if code == 0 and out.exists():
            return json.loads(out.read_text()) | {"wall_seconds": time.perf_counter() - start}
        lowered = said[-8000:].lower()
        short = any(word in lowered for word in ("resource_exhausted", "out of memory"))
        status = "out of memory" if short or code in (-9, 137) else "failed"
        why = f"exit code {code}: {reason(said)}"
        return {"status": status, "why": why} | end


def reason(said: str) -> str:
    """Of what a process printed, the last line that names an error; the last line if none does.

    JAX prints a note on the frames that it hides after the error.
    """
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    named = [line for line in lines if re.match(r"[\w.]*(Error|Exception)\b", line)]
    return (named or lines or [""])[-1][:300]


def sides_to_run(row: Any, found: dict, here: str | None, resume: bool) -> list[str]:
    """The sides of a row that are still to be measured; `here`: the device's name.

    Both again if the row is half done and the other half is of another device: a ratio of two devices says nothing.
    """
    halves = {"ours": found, "peer": found.get("peer", {})}
    done = {s for s in row.sides if halves[s].get("status") == "measured"} if resume else set()
    if len(done) < len(row.sides):
        done = {side for side in done if halves[side].get("device") == here}
    return [side for side in row.sides if side not in done]


def table(rows: dict, found: dict) -> str:
    lines = []
    for name, row in rows.items():
        x = found.get(name, {"status": "not measured"})
        goals = ["" if g is None else f"{g:.3g}" for g in (row.floor, row.must, row.reach)]
        cells = [name, x["status"], "", "", ""]
        if "relative_error" in x:
            cells[1] = f"relative error {x['relative_error']:.2e}"
        elif x["status"] == "measured":
            cells[1] = f"{x['seconds']:.4g} ({x['quartiles'][0]:.4g} to {x['quartiles'][1]:.4g})"
            cells[1] += f", remat {x['remat']}" if "remat" in x else ""
            cells[2] = f"{x['tflops']:.3g}"
        other = x.get("peer", {})
        if other.get("status") == "measured":
            cells[3] = f"{other['seconds']:.4g}"
            if "seconds" in x and x.get("device") == other.get("device"):
                cells[4] = f"{x['seconds'] / other['seconds']:.2f}"
        elif other:
            cells[3] = other["status"]
        sizes = (x.get("planned_gb", {}).get(x.get("remat")), x.get("xla_gb"), x.get("peak_gb"))
        memory = " / ".join("-" if size is None else f"{size:.3g}" for size in sizes)
        lines.append([*cells, *goals, memory if any(sizes) else "", x.get("device", "")])
    columns = ["", "seconds (quartiles)", "TFLOP/s", "PyTorch, seconds", "ours / PyTorch", "floor"]
    columns += ["must", "reach for", "GB: planned, XLA's, peak", "device"]
    return "\n".join(harness.table(columns, lines))


def chart(rows: dict, found: dict, target: Path) -> None:
    """Seconds per row, ours and the peer's, with the goals where there are any; nothing without matplotlib.

    The ladder is drawn only where no row of the published sizes is measured.
    """
    try:
        plt = harness.pyplot()
    except ImportError:
        return
    names = [n for n in rows if "seconds" in found.get(n, {})]
    names = [n for n in names if not rows[n].ladder] or names
    if not names:
        return
    figure, axes = plt.subplots(figsize=(9, 0.55 * len(names) + 1.6), layout="constrained")
    for i, name in enumerate(names):
        x, label = found[name], {"label": "roge_jax"} if i == 0 else {}
        axes.barh(i - 0.18, x["seconds"], 0.34, color="#4060a0", **label)
        low, high = x["quartiles"]
        axes.plot([low, high], [i - 0.18] * 2, color="black", lw=1)
        if x.get("peer", {}).get("status") == "measured":
            axes.barh(i + 0.18, x["peer"]["seconds"], 0.34, color="#d08030")
        for goal, style in ((rows[name].must, "|"), (rows[name].reach, "x")):
            if goal:
                axes.plot(goal, i - 0.18, style, color="crimson", ms=9)
    handles = [plt.Rectangle((0, 0), 1, 1, color=c) for c in ("#4060a0", "#d08030")]
    words = ["roge_jax (line: quartiles)", "PyTorch"]
    if any(rows[n].must for n in names):
        handles += [plt.Line2D([], [], color="crimson", ls="", marker=m) for m in "|x"]
        words += ["must", "reach for"]
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("seconds per call" + (" (CPU seconds)" if rows[names[0]].ladder else ""))
    figure.legend(handles, words, loc="outside upper center", ncols=len(words))
    harness.save(figure, target)


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--only", help=f"groups, comma-separated: {', '.join(GROUPS)}")
    p.add_argument("--repeats", type=int, default=10)
    p.add_argument("--minutes", type=float, default=120.0, help="for everything (default: 120)")
    p.add_argument("--row-minutes", type=float, default=12.0, help="for each side of a row")
    p.add_argument("--small", action="store_true", help="the ladder also on a GPU")
    p.add_argument("--resume", action="store_true", help="keep the rows that are measured already")
    p.add_argument("--out", type=Path, default=harness.RESULTS / "real_size.json")
    for word in ("--row", "--side", "--seconds"):  # of the process of one row
        p.add_argument(word, help=argparse.SUPPRESS)
    args = p.parse_args()
    from experiments.speed import rows as parts

    if args.row:
        found = parts.run(args.row, args.side, args.repeats, float(args.seconds))
        return harness.write(args.out, found)
    begin, gpu = time.perf_counter(), on_gpu()
    groups = set(args.only.split(",")) if args.only else set(GROUPS)
    if groups - set(GROUPS):
        raise SystemExit(f"--only {args.only}: the groups are {', '.join(GROUPS)}.")
    rows, environment = parts.rows(), device()
    kept = harness.read(args.out, absent={"rows": {}})["rows"]
    found = {name: kept.get(name, {"status": "not measured"}) for name in rows}
    here = environment.get("device", {}).get("kind")

    def limit() -> float:
        left = 60 * args.minutes - (time.perf_counter() - begin)
        return min(60 * args.row_minutes, left)

    def save() -> None:
        harness.write(args.out, {"environment": environment, "rows": found})

    for name, row in rows.items():
        wanted = row.ladder != gpu or (row.ladder and args.small)
        if row.group not in groups or not wanted:
            continue
        todo = sides_to_run(row, found[name], here, args.resume)
        for side in todo:
            if limit() < 20:
                print(f"{name}: no time left", flush=True)
                break
            # The commit at the start: the results, written after every row, are part of it.
            result = child(name, side, args, limit()) | {"commit": environment.get("commit")}
            if side == "ours":
                other = {} if "peer" in todo else {"peer": found[name].get("peer")}
                found[name] = result | {k: v for k, v in other.items() if v}
            else:
                found[name]["peer"] = result
            shown = {k: v for k, v in result.items() if k not in ("quartiles", "log")}
            print(f"{name}, {side}: {shown}", flush=True)
            save()
    save()
    chart(rows, found, args.out.with_suffix(".png"))
    print(table(rows, found))


if __name__ == "__main__":
    main()
