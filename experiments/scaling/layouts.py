"""Memory, communication and growth of LoRA training at the paper's size, on 1, 8 and 192 GPUs.

    python -m experiments.scaling.layouts          minutes, any machine: nothing is allocated or measured

Memory and work are those of `roge_jax.training.estimate` (the step traced on abstract arrays), volumes are arithmetic on
specs and the sharding table; assumptions stand in `docs/results/scaling.md`, whose tables this program rewrites. The paper trains on 192 H20 GPUs at batch 1 each and
states neither memory nor time per step. Writes experiments/results/scaling.json.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp

from experiments import harness
from roge_jax import config, cost
from roge_jax.core import sharding, target
from roge_jax.core.params import flatten
from roge_jax.training import estimate, stages

GB = 1e9

# Meshes (data, fsdp, seq); one scene on each group of seq GPUs.
LAYOUTS = [
    (1, 1, 1),
    *((8, 1, 1), (1, 8, 1), (2, 2, 2), (1, 1, 8)),
    *((192, 1, 1), (24, 8, 1), (24, 1, 8), (24, 2, 4)),
]


def sized(height: int, width: int, frames: int = 81) -> config.RoGeConfig:
    """The paper's model for videos of this size; reconstruction at 1.5 times the first stage's size, as there."""
    return dataclasses.replace(config.preset("paper"), height=height, width=width, frames=frames)


def stage(cfg: config.RoGeConfig, remat: str, scenes: int, *, recon_trains: bool) -> stages.Stage:
    found = stages.lora_stage(100, frames=cfg.frames, hires=not recon_trains)
    return dataclasses.replace(found, remat=remat, batch=scenes, products="bfloat16")


def planned(cfg, m: int, remat: str, sizes, *, recon_trains: bool) -> estimate.Estimate:
    """The step on one device of the mesh: one scene on each group of `seq` GPUs, bfloat16, fused attention."""
    data, fsdp, _ = sizes
    with target.use("h100"):
        return estimate.estimate(
            cfg,
            stage(cfg, remat, data * fsdp, recon_trains=recon_trains),
            m=m,
            mesh=sharding.abstract_mesh(*sizes),
            dtype=jnp.bfloat16,
        )


def communication(
    cfg: config.RoGeConfig, found: estimate.Estimate, sizes, *, recon_trains: bool
) -> dict:
    """Bytes that one device receives in one step with full rematerialisation."""
    data, fsdp, seq = sizes
    passes = 2  # forward; backward, which recomputes with the same gathered block
    _, frozen = stages.stage_specs(cfg, stage(cfg, "full", 1, recon_trains=recon_trains))
    whole = sum(
        math.prod(s.shape) * (4 if cost.keeps_float32(p) else 2) for p, s in flatten(frozen).items()
    )
    d, n = cfg.dit, found.tokens
    each = n["transformer tokens"] / seq * d.width * (seq - 1) / seq
    # q, k, v in bfloat16 and the result in float32 of self-attention; q and the result of cross-attention
    layer = each * (3 * 2 + 4) + each * (2 + 4)
    replicas, trained = data * seq, 4.0 * found.parameters["trained"]
    rays = n["views"] * (cfg.recon_height // 8) * (cfg.recon_width // 8)
    return {
        "gather frozen weights": passes * (whole - found.memory["frozen weights"]),
        # Over fsdp: gather what trains twice, scatter its gradient once; over the rest: all-reduce of the share.
        "gradients": trained * (3 * (fsdp - 1) / fsdp + 2 * (replicas - 1) / replicas / fsdp),
        "tokens": 3 * d.depth * layer,  # forward, recomputed, backward
        "views": (2 if recon_trains else 1) * 4.0 * rays * cfg.renderer.width * (seq - 1) / seq,
    }


def layout(cfg: config.RoGeConfig, m: int, sizes, policies, *, recon_trains: bool) -> dict:
    found = {p: planned(cfg, m, p, sizes, recon_trains=recon_trains) for p in policies}
    full = found["full"]
    return {
        "mesh": dict(zip(sharding.MESH_AXES, sizes)),
        "batch": sizes[0] * sizes[1],
        "memory": {p: x.memory for p, x in found.items()},
        "total": {p: x.bytes for p, x in found.items()},
        "fullest": {p: x.fullest for p, x in found.items()},
        "received": communication(cfg, full, sizes, recon_trains=recon_trains),
        "flops": {p: x.flops for p, x in found.items()},
    }


def layout_table(title: str, rows: list[dict], policies) -> list[str]:
    names, lines = " / ".join(policies), []
    for x in rows:
        got, first = x["received"], x["memory"][policies[0]]
        cells = [
            str(math.prod(x["mesh"].values())),
            ", ".join(map(str, x["mesh"].values())),
            str(x["batch"]),
            f"{first['frozen weights'] / GB:.1f}",
            f"{first['trained weights and optimiser'] / GB:.1f}",
            " / ".join(f"{x['memory'][p]['activations and gradients'] / GB:.0f}" for p in policies),
            " / ".join(f"{x['total'][p] / GB:.0f}" for p in policies),
            f"{got['gather frozen weights'] / GB:.1f}",
            f"{got['gradients'] / GB:.1f}",
            f"{(got['tokens'] + got['views']) / GB:.1f}",
            " / ".join(f"{x['flops'][p] / 1e12:.0f}" for p in policies),
        ]
        lines.append(cells)
    columns = ["GPUs", "data, fsdp, seq", "scenes per step", "frozen weights", "trained + Adam"]
    columns += [f"activations, {names}", f"all, {names}", "weights gathered", "gradients"]
    columns += ["tokens + views", f"TFLOP, {names}"]
    return [f"**{title}**", "", *harness.table(columns, lines), ""]


def growth() -> tuple[list[dict], list[str]]:
    """FLOPs and bytes of one scene against M, N and resolution, one device, relative to the first row of each group."""
    cases = {
        "photos M, 81 frames at 192x336": [((192, 336, 81), m) for m in (3, 6, 9)],
        "photos M, 81 frames at 480x832 (reconstruction frozen)": [
            ((480, 832, 81), m) for m in (3, 6, 9)
        ],
        "frames N, M = 6 at 192x336": [((192, 336, n), 6) for n in (81, 121, 161)],
        "size, M = 6, 81 frames": [
            ((h, w, 81), 6) for h, w in ((192, 336), (288, 512), (384, 672))
        ],
    }
    rows: list[dict] = []
    lines: list[list] = []
    for title, group in cases.items():
        first = 0.0
        for size, m in group:
            x = planned(sized(*size), m, "full", (1, 1, 1), recon_trains="frozen" not in title)
            start = not first
            first = first or x.flops
            height, width, frames = size
            label = {"p": f"M = {m}", "f": f"N = {frames}", "s": f"{height}x{width}"}[title[0]]
            held = x.memory["activations and gradients"]
            rows.append(
                {
                    "group": title,
                    "case": label,
                    "memory": x.memory,
                    "work": x.work,
                    "tokens": x.tokens,
                }
            )
            cells = [title if start else "", label, f"{x.tokens['transformer tokens']:,}"]
            cells += [f"{x.flops / 1e15:.2f}", f"x{x.flops / first:.2f}"]
            lines.append([*cells, f"{held / GB:.1f}", f"{x.bytes / GB:.0f}"])
    columns = ["", "", "transformer tokens", "step, PFLOP", "step, relative"]
    return rows, harness.table([*columns, "activations, full, GB", "all, GB"], lines)


def work_table(title: str, x: estimate.Estimate) -> list[str]:
    rows = [
        [name, *(f"{passes[p] / 1e12:.1f}" for p in estimate.PASSES)]
        for name, passes in x.work.items()
    ]
    columns = ["TFLOP", "forward", "recomputed", "backward"]
    return [f"**{title}**", "", *harness.table(columns, rows), ""]


def main() -> None:
    jax.config.update("jax_platforms", "cpu")
    first, second = sized(192, 336), sized(480, 832)
    results = {
        "source": "traced programs, attention as the fused kernel of GPUs, and parameter specs; nothing in this file was measured",
        "layouts": {},
    }
    lines = []
    for title, cfg, trains in (
        ("First stage: 192x336, 81 frames, M = 6, LoRA on both halves; GB per GPU, per step", first, True),
        ("Second stage: 480x832, 81 frames, M = 6, reconstruction frozen; GB per GPU, per step", second, False),
    ):  # fmt: skip
        policies = ("full", "attention", "dots")
        found = []
        for sizes in LAYOUTS:  # one policy after the other, so that each is traced once
            print(title, sizes, flush=True)
            found.append(layout(cfg, 6, sizes, policies, recon_trains=trains))
        results["layouts"][title] = found
        lines += layout_table(title, found, policies)
    one = planned(first, 6, "full", (1, 1, 1), recon_trains=True)
    lines += work_table("Where the work of the first stage is, one scene, recomputation: full", one)
    results["work"], results["parameters"] = one.work, one.parameters
    results["growth"], table = growth()
    lines += ["**Growth of one scene** (one GPU)", "", *table]
    harness.write("scaling.json", results)
    harness.put(harness.DOCS / "results" / "scaling.md", "scaling", "\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
