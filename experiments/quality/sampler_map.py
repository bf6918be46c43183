"""Where samplers fail: detail lost or invented, guidance off the grid, bfloat16, stability, step control.

    OPENBLAS_NUM_THREADS=1 python -m experiments.quality.sampler_map        # results/sampler_map.{json,png}

CPU, half a minute on four idle cores. Seed 0 throughout. Panels (n = what is averaged):

  top      heat maps, solver x true detail: produced over true standard deviation on a flow from N(0, 1) to
           N(0, s^2), which is linear, so one path gives it exactly (n = 1). Blue < 1: collapse (smoothing),
           red > 1: inflation (noise). 8 steps uniform, 32 steps uniform, 32 steps graded to sigma_min = s.
           "heun, textbook" evaluates at sigma = 0; the library's Heun does not.
  guidance error over steps with the guidance switches on and off the grid (16 samples, 8-D mixture)
  bf16     Euler with a bfloat16 state, a bfloat16 network with float32 state, all float32 (n = 4096 numbers)
  stability  growth of one step over the stiffness h |rate|: explicit limits
  control  what the adaptive method spends: smooth, switch not named, switch named, tiny detail, NaN

The JSON also holds errors by schedule (uniform, shift 5, graded) on an 8-D mixture.
The published system reports no such map. Our numbers and the remedies: docs/results/solvers.md.
"""

import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np

from experiments import harness
from roge_jax.video import testbed
from roge_jax.video.flow import schedule
from roge_jax.video.reference import reference_solution
from roge_jax.video.solvers import SOLVERS, solve, tabulate

FIXED = [name for name, solver in SOLVERS.items() if solver.method is not None]
DETAIL = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)


def walk(table, field, x):
    """Run a table in NumPy (float64)."""
    stored = table.begin.reshape((-1,) + (1,) * x.ndim) * x[None]
    for e, sigma in enumerate(table.sigma):
        side = table.side[e]
        sigma = np.nextafter(sigma, sigma + side) if side else sigma
        vectors = np.concatenate([stored, np.asarray(field(stored[0], sigma))[None]])
        stored = np.tensordot(table.mix[e], vectors, axes=1)
    return stored[0]


def linear_field(s):
    def field(x, sigma):
        return (sigma - (1 - sigma) * s**2) / ((1 - sigma) ** 2 * s**2 + sigma**2) * x

    return field


def textbook_heun(field, x, grid):
    for s0, s1 in itertools.pairwise(grid):
        v = field(x, s0)
        x = x + 0.5 * (s1 - s0) * (v + field(x + (s1 - s0) * v, s1))
    return x


def detail_maps():
    """{map: {solver: [ratio for each s]}}"""

    def grid(kind, s):
        if kind == "graded":
            return schedule("graded", 32, power=4, sigma_min=min(s, 0.5))
        return schedule("uniform", kind)

    maps = {}
    for label, kind in (
        ("8 steps, uniform", 8),
        ("32 steps, uniform", 32),
        ("32 steps, graded to s", "graded"),
    ):
        rows = {
            name: [
                float(walk(tabulate(name, grid(kind, s)), linear_field(s), np.ones(1))[0] / s)
                for s in DETAIL
            ]
            for name in FIXED
        }
        rows["heun, textbook"] = [
            float(textbook_heun(linear_field(s), 1.0, grid(kind, s)) / s) for s in DETAIL
        ]
        maps[label] = rows
    return maps


def guidance_curves():
    """{solver: {"on": errors, "off": errors}} over steps; evaluations counted in steps."""
    steps = [4, 8, 16, 32, 64, 128, 256]
    with jax.enable_x64(True):
        problem = testbed.guided_mixture(4.0, (0.313, 0.787))
        x1 = np.random.default_rng(0).normal(size=(16, 8))
        found = reference_solution(
            problem.velocity,
            jnp.asarray(x1),
            breaks=problem.breaks,
            stepper="picard",
            tolerance=1e-9,
            steps=24,
        )
        field, truth, curves = jax.jit(problem.velocity), np.asarray(found.x0), {}
        for name in ("euler", "heun", "ab2", "rk4"):
            curves[name] = {}
            for where, breaks in (("on", problem.breaks), ("off", ())):
                tables = [
                    tabulate(name, schedule("uniform", n, breaks=breaks), breaks=breaks)
                    for n in steps
                ]
                ends = [walk(table, field, x1) for table in tables]
                curves[name][where] = [
                    float(np.linalg.norm(x - truth) / np.linalg.norm(truth)) for x in ends
                ]
    return {"steps": steps, "self_error": found.self_error, "curves": curves}


def schedule_errors():
    """{steps: {solver: {schedule: median relative error}}} on an 8-D mixture, 64 samples; in the JSON only."""
    with jax.enable_x64(True):
        problem = testbed.random_mixture(8, 4, 0.5)
        x1 = np.random.default_rng(0).normal(size=(64, 8))
        found = reference_solution(
            problem.velocity, jnp.asarray(x1), stepper="picard", tolerance=1e-9, steps=24
        )
        field, truth, errors = jax.jit(problem.velocity), np.asarray(found.x0), {}
        for steps, name in itertools.product((8, 32, 128), ("euler", "unipc_2", "midpoint", "rk4")):
            row = errors.setdefault(str(steps), {}).setdefault(name, {})
            for kind in ("uniform", "shift", "graded"):
                gap = walk(tabulate(name, schedule(kind, steps)), field, x1) - truth
                relative = np.linalg.norm(gap, axis=-1) / np.linalg.norm(truth, axis=-1)
                row[kind] = float(np.median(relative))
    return errors


def bfloat16_curves():
    steps = [8, 16, 32, 64, 128, 256, 512, 1024]
    problem = testbed.gaussian(np.linspace(-1, 1, 64), np.full(64, 0.5))
    x1 = jnp.asarray(np.random.default_rng(0).normal(size=(64, 64)), jnp.float32)
    truth = problem.exact(x1)

    def low(x, sigma):
        return problem.velocity(x.astype(jnp.float32), sigma).astype(jnp.bfloat16)

    curves = {}
    for label, field, dtype in (
        ("bfloat16 state", low, jnp.bfloat16),
        ("bfloat16 network, float32 state", low, None),
        ("all float32", problem.velocity, None),
    ):
        errors = []
        for n in steps:
            x0, _ = solve("euler", field, x1, schedule("uniform", n), state_dtype=dtype)
            errors.append(float(jnp.sqrt(jnp.mean((x0.astype(jnp.float32) - truth) ** 2))))
        curves[label] = errors
    return {"steps": steps, "curves": curves}


def stability_curves():
    """Largest growth of a decaying mode in one step (one-step methods) at stiffness z = h |rate|."""
    z = np.geomspace(0.1, 80, 300)
    curves = {}
    for name in ("euler", "midpoint", "heun", "rk4", "rkc2", "rkc2_8"):
        table = tabulate(name, np.array([1.0, 0.9]))  # does not end at 0: no special last step
        growth = [abs(float(walk(table, lambda x, s, r=r: r * x, np.ones(1))[0])) for r in z / 0.1]
        limit = float(z[np.argmax(np.array(growth) > 1 + 1e-9)])
        curves[name] = {"growth": growth, "limit": limit}
    return {"z": z.tolist(), "curves": curves}


def control_costs():
    """{situation: [accepted work, rejected work, wanted]} in evaluations at tolerance 1e-4."""
    x1 = jnp.asarray(np.random.default_rng(0).normal(size=(8, 8)), jnp.float32)
    smooth, tiny = testbed.random_mixture(8, 4, 0.5), testbed.random_mixture(8, 4, 0.003)
    switched = testbed.guided_mixture(8.0, (0.313, 0.787))

    def broken(x, sigma):
        return jnp.where(sigma < 0.5, jnp.nan, smooth.velocity(x, sigma))

    cases = {
        "smooth": (smooth.velocity, ()),
        "detail\n0.003": (tiny.velocity, ()),
        "switch\nnot named": (switched.velocity, ()),
        "switch\nnamed": (switched.velocity, switched.breaks),
        "NaN below\n0.5": (broken, ()),
    }
    costs = {}
    for label, (field, breaks) in cases.items():
        grid = np.array([1.0, 0.95, *sorted(breaks, reverse=True), 1e-3, 0.0])
        _, info = solve("bosh3", field, x1, grid, breaks=breaks, tolerance=1e-4)
        rejected = int(info.rejected)
        costs[label] = {
            "kept": int(info.evaluations) - rejected,
            "rejected": rejected,
            "failed": bool(info.failed),
        }
    return costs


def draw(report):
    fig = harness.pyplot().figure(figsize=(16, 10.5))
    outer = fig.add_gridspec(
        2, 1, height_ratios=[1.05, 1], hspace=0.3, left=0.095, right=0.955, top=0.95, bottom=0.06
    )
    top = outer[0].subgridspec(1, 4, width_ratios=[1, 1, 1, 0.035], wspace=0.08)
    for column, (label, rows) in enumerate(report["detail"].items()):
        ax = fig.add_subplot(top[column])
        values = np.array(list(rows.values()))
        shown = np.log10(np.clip(np.nan_to_num(np.abs(values), nan=1e3, posinf=1e3), 1e-2, 1e2))
        image = ax.imshow(shown, cmap="RdBu_r", vmin=-2, vmax=2, aspect="auto")
        for (i, j), value in np.ndenumerate(values):
            text = "inf" if not np.isfinite(value) else f"{value:.2g}"
            colour = "w" if abs(shown[i, j]) > 1.2 else "k"
            ax.text(j, i, text, ha="center", va="center", fontsize=8, color=colour)
        ax.set(title=label)
        ax.grid(False)
        ax.set_xticks(range(len(DETAIL)), [f"{s:g}" for s in DETAIL])
        ax.set_yticks(range(len(rows)), list(rows) if column == 0 else [])
        ax.set_xlabel("true detail s (standard deviation)")
    bar = fig.colorbar(image, cax=fig.add_subplot(top[3]), ticks=[-2, -1, 0, 1, 2])
    bar.ax.set_yticklabels(["0.01", "0.1", "1", "10", "100"])
    bar.set_label("produced / true detail:  collapse < 1 < inflation")
    low = outer[1].subgridspec(1, 4, wspace=0.38)

    ax, guidance = fig.add_subplot(low[0]), report["guidance"]
    for k, (name, curve) in enumerate(guidance["curves"].items()):
        ax.plot(guidance["steps"], curve["on"], f"C{k}o-", ms=4, label=name)
        ax.plot(guidance["steps"], curve["off"], f"C{k}x--", ms=5, lw=1)
    ax.plot([], [], "k--x", lw=1, label="switch off the grid")
    ax.set(xscale="log", yscale="log", xlabel="steps", ylabel="relative L2 error")
    ax.set_title("guidance switched on / off the grid")

    ax, low_precision = fig.add_subplot(low[1]), report["bfloat16"]
    for k, (name, errors) in enumerate(low_precision["curves"].items()):
        ax.plot(low_precision["steps"], errors, ["C3s-", "C0o-", "k.--"][k], ms=5, label=name)
    ax.set(xscale="log", yscale="log", xlabel="Euler steps", ylabel="RMS error")
    ax.set_title("a bfloat16 state gets worse with steps")

    ax, stability = fig.add_subplot(low[2]), report["stability"]
    for k, (name, curve) in enumerate(stability["curves"].items()):
        style = {"heun": (0, (1, 2)), "midpoint": (0, (4, 3))}.get(name, "-")
        label = f"{name}: to {curve['limit']:.1f}"
        ax.plot(stability["z"], curve["growth"], color=f"C{k}", ls=style, lw=1.6, label=label)
    ax.axhspan(1, 10, color="#fbe3e3", zorder=0)
    ax.set(xscale="log", ylim=(0, 3), xlabel="stiffness of a step, h |rate|")
    ax.set_ylabel("growth of a decaying mode")
    ax.set_title("explicit stability limits")

    for axis in fig.axes[-3:]:
        axis.legend()

    ax, control = fig.add_subplot(low[3]), report["control"]
    names = list(control)[::-1]
    kept, rejected = ([control[n][k] for n in names] for k in ("kept", "rejected"))
    ax.barh(names, kept, color="C0", label="kept")
    ax.barh(names, rejected, left=kept, color="C3", label="rejected")
    for i, name in enumerate(names):
        total = kept[i] + rejected[i]
        text = f"{total}" + (", stopped" if control[name]["failed"] else "")
        ax.text(total + 3, i, text, va="center", fontsize=8)
    longest = max(k + r for k, r in zip(kept, rejected))
    ax.set(xlabel="evaluations at tolerance 1e-4", xlim=(0, 1.3 * longest))
    ax.set_title("adaptive step control")
    ax.tick_params(axis="y", labelsize=8)
    ax.legend()
    harness.save(fig, "sampler_map.png")


def main():
    began = time.perf_counter()
    report = {
        "detail": detail_maps(),
        "guidance": guidance_curves(),
        "schedules": schedule_errors(),
        "bfloat16": bfloat16_curves(),
        "stability": stability_curves(),
        "control": control_costs(),
    }
    report["settings"] = {"seed": 0, "detail": DETAIL}
    report["environment"] = harness.environment()
    report["seconds"] = time.perf_counter() - began
    harness.write("sampler_map.json", report, digits=4)
    draw(report)
    print(f"{report['seconds']:.1f} s")


if __name__ == "__main__":
    main()
