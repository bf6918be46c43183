"""Work against precision of every sampler: error over evaluations and over wall time, one run.

    OPENBLAS_NUM_THREADS=1 python -m experiments.quality.work_precision     # results/work_precision.{json,png}
    python -m experiments.quality.work_precision --draw                     # the picture alone, from the stored numbers

CPU, one process; about 200 small compilations, one to two minutes on four idle cores. Three flows whose answer is known:

  detail      N(0, I) -> a plane in 16-D with std 0.02 off it (exact map); grid sigma = u^2
  guidance    guided four-part mixture in 8-D, scale 4 within sigma 0.313..0.787, reference: implicit
              collocation, whose self-error is drawn as the floor; uniform grid that meets the switch
  stiff       Prothero-Robinson with rate -500 (exact), uniform grid; explicit methods fail here

Every solver gets the same budgets of evaluations (2 to 128, stiff: 32 to 1024); bosh3 gets tolerances.
Errors: relative L2 per sample to the truth in float64; median, quartiles and worst over 3 seeds x 512
samples (seeds 0, 1, 2; the stiff problem has one start). Time: wall time of all samples of a seed, median and quartiles
of 15 runs after the first; compilation apart (both in the JSON). A run with a non-finite or > 100 % error is a failure, drawn on
the strip on top. Evaluations count velocity calls; with guidance each is two network calls inside the interval.
The published system reports no such chart. Our numbers: docs/results/solvers.md.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from experiments import harness
from roge_jax.video import testbed
from roge_jax.video.flow import schedule
from roge_jax.video.reference import reference_solution
from roge_jax.video.solvers import SOLVERS, solve, tabulate

SEEDS, SAMPLES, REPEATS = (0, 1, 2), 512, 15
BUDGETS = {"stiff": (32, 64, 128, 256, 512, 1024)}
BUDGET = (2, 4, 8, 16, 32, 64, 128)
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
FAILED = 1.0  # relative error from which a run counts as failed
STRIP = 8.0  # height of the strip of failures, on which every solver has a line of its own
ROUNDING = 1e-14  # a self-error below it is that of an exact map: nothing to draw


def problems():
    """(name, title, problem, start states [3, n, dim], truth, self-error, grid of n steps)."""
    rng = [np.random.default_rng(seed) for seed in SEEDS]
    detail = testbed.low_rank(16, 4, 0.02)
    x1 = jnp.asarray(np.stack([r.normal(size=(SAMPLES, 16)) for r in rng]))
    yield ("detail", "plane in 16-D, detail 0.02", detail, x1, detail.exact(x1), 0.0, graded)
    mix = testbed.guided_mixture(4.0, (0.313, 0.787))
    x1 = jnp.asarray(np.stack([r.normal(size=(SAMPLES, 8)) for r in rng]))
    found = reference_solution(
        mix.velocity, x1, breaks=mix.breaks, stepper="picard", tolerance=1e-9, steps=24
    )
    yield ("guidance", "guided mixture in 8-D", mix, x1, found.x0, found.self_error, uniform)
    stiff, start = testbed.prothero_robinson(-500.0)
    x1 = jnp.asarray(start)[None, None]
    yield ("stiff", "stiff relaxation, rate -500", stiff, x1, stiff.exact(x1), 0.0, uniform)


def graded(steps, breaks):
    return schedule("graded", steps, power=2, breaks=breaks)


def uniform(steps, breaks):
    return schedule("uniform", steps, breaks=breaks)


def run_once(call, x1, truth):
    """Errors of every sample, evaluations, seconds (all runs of seed 0), compile seconds."""
    began = time.perf_counter()
    compiled = jax.jit(call).lower(x1[0]).compile()
    compile_seconds = time.perf_counter() - began
    errors, evaluations = [], []
    for start, end in zip(x1, truth, strict=True):
        x0, info = compiled(start)
        gap = jnp.linalg.norm(x0 - end, axis=-1) / jnp.linalg.norm(end, axis=-1)
        errors.append(np.where(bool(info.failed), np.inf, np.asarray(gap)))
        evaluations.append(int(info.evaluations))
    seconds = [harness.timed(lambda: compiled(x1[0])).wall for _ in range(REPEATS)]
    errors = np.nan_to_num(np.concatenate(errors), nan=np.inf)
    return errors, float(np.mean(evaluations)), seconds, compile_seconds


def quartiles(values) -> dict[str, float]:
    """{q25, median, q75}, each one of the values."""
    found = np.quantile(values, [0.25, 0.5, 0.75], method="nearest")
    return dict(zip(("q25", "median", "q75"), map(float, found)))


def measure():
    records, notes = [], {}
    for name, title, problem, x1, truth, self_error, grid in problems():
        notes[name] = {"title": title, "self_error": max(self_error, 1e-15)}
        for solver in SOLVERS:
            adaptive = SOLVERS[solver].method is None
            per_step = SOLVERS[solver].nfe_per_step
            steps = sorted({b // per_step for b in BUDGETS.get(name, BUDGET)} - {0})
            for knob in TOLERANCES if adaptive else steps:
                if adaptive:
                    ends = np.array([1.0, 0.95, *sorted(problem.breaks, reverse=True), 1e-4, 0.0])

                    def call(x, tol=knob, ends=ends, problem=problem):
                        given = {"breaks": problem.breaks, "tolerance": tol}
                        field = problem.velocity
                        return solve("bosh3", field, x, ends, max_evaluations=3000, **given)

                else:
                    if knob <= len(problem.breaks):
                        continue
                    table = tabulate(solver, grid(knob, problem.breaks), breaks=problem.breaks)

                    def call(x, table=table, problem=problem):
                        return solve(table, problem.velocity, x)

                errors, evaluations, seconds, compile_seconds = run_once(call, x1, truth)
                error = quartiles(errors) | {"max": errors.max()}
                mid, worst = error["median"], error["max"]
                failed = not worst < FAILED if name == "stiff" else not mid < FAILED
                records.append(
                    {
                        "problem": name,
                        "solver": solver,
                        "knob": knob,
                        "evaluations": evaluations,
                        "error": error,
                        "seconds": quartiles(seconds),
                        "compile_seconds": compile_seconds,
                        "failed": bool(failed),
                    }
                )
            print(name, solver, f"{records[-1]['error']['median']:.2e}", flush=True)
    return records, notes


def pareto(points):
    """The staircase of (work, error) that nothing beats in both."""
    best, front = np.inf, []
    for work, error in sorted(points):
        if error < best:
            best = error
            front.append((work, error))
    return front


def draw(records, notes):
    plt = harness.pyplot()
    colours = [*plt.get_cmap("tab10").colors, (0, 0, 0)]
    markers = "osD^v<>PhXx"
    fig, axes = plt.subplots(2, 3, figsize=(15, 9.2), sharey="col")
    for column, (name, note) in enumerate(notes.items()):
        mine = [r for r in records if r["problem"] == name]
        good = [r["error"]["median"] for r in mine if not r["failed"]]
        bottom = min(good) / 5
        if note["self_error"] > ROUNDING:  # the floor is drawn, however deep it lies
            bottom = min(bottom, note["self_error"] / 5)
        top = 3.0
        samples = 1 if name == "stiff" else SAMPLES
        time_label = f"milliseconds for {samples} sample{'s' * (samples > 1)}, median and quartiles of {REPEATS}"
        for row, (work, label) in enumerate(
            [
                (lambda r: r["evaluations"], "velocity evaluations"),
                (lambda r: 1e3 * r["seconds"]["median"], time_label),
            ]
        ):
            ax = axes[row, column]
            if note["self_error"] > ROUNDING:
                ax.axhspan(bottom / 10, note["self_error"], color="0.85", zorder=0)
                note_at = {"transform": ax.transAxes, "color": "0.4", "fontsize": 8}
                ax.text(0.02, 0.02, f"reference's self-error, {note['self_error']:.0e}", **note_at)
            ax.axhspan(top, top * STRIP, color="#fbe3e3", zorder=0)
            corner = {"transform": ax.transAxes, "ha": "right", "va": "top"}
            ax.text(0.985, 0.975, "failed", color="#b33", fontsize=9, **corner)
            for k, solver in enumerate(SOLVERS):
                points = [r for r in mine if r["solver"] == solver]
                fine = [r for r in points if not r["failed"]]
                style = {"color": colours[k], "marker": markers[k]}
                x = [work(r) for r in fine]
                low, y, high = ([r["error"][q] for r in fine] for q in ("q25", "median", "q75"))
                ax.plot(x, y, ms=4.5, lw=1.3, label=solver, **style)
                ax.fill_between(x, low, high, color=colours[k], alpha=0.13, lw=0)
                for r in fine if row == 1 else ():
                    ends = [1e3 * r["seconds"][q] for q in ("q25", "q75")]
                    ax.plot(ends, [r["error"]["median"]] * 2, color=colours[k], lw=1.6, alpha=0.45)
                bad = [work(r) for r in points if r["failed"]]
                ax.plot(bad, [top * 1.22 * 1.17**k] * len(bad), ls="", ms=4, **style)
            front = pareto([(work(r), r["error"]["median"]) for r in mine if not r["failed"]])
            ax.step(*zip(*front), where="post", color="k", lw=3.5, alpha=0.22, zorder=1)
            ax.set(xscale="log", yscale="log", ylim=(bottom, top * STRIP), xlabel=label)
            if row == 0:
                ax.set_title(note["title"])
                triangles(ax, bottom, 1.15 * min(r["evaluations"] for r in mine))
            if column == 0:
                ax.set_ylabel("relative L2 error (median, quartiles)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    handles.append(plt.Line2D([], [], color="k", lw=3.5, alpha=0.22))
    fig.legend(handles, [*labels, "Pareto front"], loc="lower center", ncol=12)
    fig.tight_layout(rect=(0, 0.035, 1, 1))
    harness.save(fig, "work_precision.png")


def triangles(ax, bottom, x0):
    """Slopes 1, 2 and 4, in the lower left corner."""
    x1 = 2.3 * x0
    y0 = bottom * 6
    for order in (1, 2, 4):
        ax.plot([x0, x1], [y0 * (x1 / x0) ** order, y0], color="0.35", lw=1)
        grey = {"color": "0.35", "fontsize": 8, "ha": "right", "va": "center"}
        ax.text(x0, y0 * (x1 / x0) ** order, f"{order}", **grey)
    ax.plot([x0, x1], [y0, y0], color="0.35", lw=1)
    ax.plot([x0, x0], [y0, y0 * (x1 / x0) ** 4], color="0.35", lw=1)


def main():
    parser = harness.parser(__doc__)
    parser.add_argument("--draw", action="store_true", help="the picture from the JSON alone")
    if parser.parse_args().draw:
        stored = harness.read("work_precision.json")
        return draw(stored["records"], stored["settings"]["problems"])
    began = time.perf_counter()
    with jax.enable_x64(True):
        records, notes = measure()
    report = {
        "settings": {
            "seeds": SEEDS,
            "samples": SAMPLES,
            "repeats": REPEATS,
            "dtype": "float64",
            "failed_above": FAILED,
            "problems": notes,
        },
        "environment": harness.environment(),
        "seconds": round(time.perf_counter() - began, 1),
        "records": records,
    }
    harness.write("work_precision.json", report, digits=4)
    draw(records, notes)
    print(f"{report['seconds']} s")


if __name__ == "__main__":
    main()
