"""Memory, communication and growth of LoRA training at the paper's size, on 1, 8 and 192 GPUs.

    python -m experiments.scaling          seconds, any machine: nothing is allocated or measured

All numbers are arithmetic on the parameter specs, the sharding table and the formulas of `roge_jax.cost`; assumptions
stand in `docs/scaling.md`, whose tables this program rewrites. The paper trains on 192 H20 GPUs at batch 1 each and
states neither memory nor time per step. Writes experiments/results/scaling.json.
"""

import dataclasses
import json
import math
from pathlib import Path

import jax
from jax.sharding import AbstractMesh, AxisType

from roge_jax import config, cost, model
from roge_jax.core import sharding
from roge_jax.core.lora import attach
from roge_jax.core.params import count, flatten
from roge_jax.recon.vggt import SPECIALS, encoder_grid

HERE = Path(__file__).parent
RESULT = HERE / "results" / "scaling.json"
PAGE = HERE.parent / "docs" / "scaling.md"
GB = 1e9

LAYOUTS = {  # GPUs: meshes (data, fsdp, seq); one scene on each group of seq GPUs
    1: [(1, 1, 1)],
    8: [(8, 1, 1), (1, 8, 1), (2, 2, 2), (1, 1, 8)],
    192: [(192, 1, 1), (24, 8, 1), (24, 1, 8), (24, 2, 4)],
}


def abstract_mesh(sizes: tuple[int, int, int]) -> AbstractMesh:
    return AbstractMesh(sizes, sharding.MESH_AXES, axis_types=(AxisType.Auto,) * 3)


def held(specs: dict, mesh: AbstractMesh, item) -> float:
    """Bytes of a spec tree on one device; `item(path)` is the size of one number."""
    total = 0.0
    for path, spec in flatten(specs).items():
        split = sharding.partition(spec.axes, spec.shape, mesh, leaf=path)
        over = [
            a for entry in split if entry for a in ((entry,) if isinstance(entry, str) else entry)
        ]
        total += math.prod(spec.shape) / math.prod([mesh.shape[a] for a in over]) * item(path)
    return total


def frozen_item(path: str) -> int:
    """Frozen matrices are bfloat16; the VAE, norms and the like float32."""
    return 4 if cost.keeps_float32(path) else 2


def sized(height: int, width: int, frames: int = 81) -> config.RoGeConfig:
    """The paper's model for videos of this size; reconstruction at 1.5 times the first stage's size, as there."""
    return dataclasses.replace(config.preset("paper"), height=height, width=width, frames=frames)


def shares(cfg: config.RoGeConfig, m: int, *, recon_trains: bool) -> dict[str, float]:
    """Counts of one scene: tokens, views, and FLOPs of one training step with full rematerialisation."""
    tokens = cost.tokens_per_slot(cfg) * cfg.slots(m)
    size, v = (cfg.recon_height, cfg.recon_width), m + cfg.frames
    rows, columns = encoder_grid(cfg.encoder, *size)
    scene = m * rows * columns
    d = cfg.dit
    forward = cost.velocity(d, tokens)
    attend = d.depth * (
        cost.attention(tokens, tokens, d.width) + cost.attention(tokens, d.text_len, d.width)
    )
    recon = cost.encoder(cfg.encoder, *size, m, cfg.renderer.width)
    recon += cost.renderer(cfg.renderer, *size, scene, m, v)
    vae = m * cost.vae_encode(cfg.vae, 1, cfg.height, cfg.width)
    vae += cost.vae_encode(cfg.vae, cfg.frames, cfg.height, cfg.width)
    # Frozen matrices need no gradient of their own: backward is one forward of the linears and 2.5 of attention.
    dit_step = forward + (forward - attend) + 2.5 * attend + forward
    recon_step = 3.3 * recon if recon_trains else recon
    return {
        "tokens": tokens,
        "scene_tokens": scene,
        "views": v,
        "forward": forward,
        "attention": attend,
        "recon": recon,
        "dit_step": dit_step,
        "recon_step": recon_step,
        "step": dit_step + recon_step + vae + cost.fusion(cfg, v, cfg.slots(m)),
    }


def activations(
    cfg: config.RoGeConfig, m: int, seq: int, *, recon_trains: bool
) -> dict[str, float]:
    """Bytes on one device for one scene shared by `seq` devices, float32 between the matrix products.

    The stages follow one another: the peak is the largest, not the sum, plus `kept`, which lives through the step.
    """
    n = shares(cfg, m, recon_trains=recon_trains)
    d, r, e = cfg.dit, cfg.renderer, cfg.encoder
    tokens = math.ceil(n["tokens"] / seq)
    block = (
        tokens * 4.0 * (12 * d.width + 3 * d.ffn)
    )  # forward and backward of one block, recomputed
    rays = (cfg.recon_height // r.patch) * (cfg.recon_width // r.patch)
    chunk = math.ceil(r.chunk / seq)
    carry = 4.0 * chunk * (rays + r.registers + n["scene_tokens"]) * r.width
    seen = n["scene_tokens"] + m * (SPECIALS + e.registers)
    encoder = 4.0 * seen * e.width * (2 * e.depth + e.dino_depth + 20)
    return {
        "kept": 4.0 * n["views"] * rays * r.width
        + 4.0 * n["tokens"] * d.patch**2 * (24 * 64 + 4 * 384),
        "dit_full": d.depth * tokens * 4.0 * d.width + block,
        "dit_dots": d.depth * tokens * 4.0 * (7 * d.width + d.ffn) + block,
        "renderer": carry * (r.depth + 12 if recon_trains else 12),
        "encoder": encoder,
        "vae": 2 * 4.0 * cfg.frames * cfg.height * cfg.width * cfg.vae.base,
    }


def communication(cfg: config.RoGeConfig, m: int, sizes, *, recon_trains: bool) -> dict[str, float]:
    """Bytes that one device receives in one step with full rematerialisation."""
    data, fsdp, seq = sizes
    n, mesh = shares(cfg, m, recon_trains=recon_trains), abstract_mesh(sizes)
    trains, frozen = parameters(cfg, recon_trains)
    whole = held(frozen, abstract_mesh((1, 1, 1)), frozen_item)
    passes = 2  # forward; backward, which recomputes with the same gathered block
    d = cfg.dit
    each = n["tokens"] / seq * d.width * (seq - 1) / seq
    layer = each * (3 * 2 + 4) + each * (
        2 + 4
    )  # q, k, v and the result of self-attention; q and result of cross
    replicas, trained = data * seq, 4.0 * count(trains)
    rays = n["views"] * (cfg.recon_height // 8) * (cfg.recon_width // 8)
    return {
        "gather frozen weights": passes * (whole - held(frozen, mesh, frozen_item)),
        # Over fsdp: gather what trains twice, scatter its gradient once; over the rest: all-reduce of the share.
        "gradients": trained * (3 * (fsdp - 1) / fsdp + 2 * (replicas - 1) / replicas / fsdp),
        "tokens": 3 * d.depth * layer,  # forward, recomputed, backward
        "views": (2 if recon_trains else 1) * 4.0 * rays * cfg.renderer.width * (seq - 1) / seq,
    }


def parameters(cfg: config.RoGeConfig, recon_trains: bool) -> tuple[dict, dict]:
    trains, frozen = model.split(model.specs(cfg), model.NEW_EMBEDDINGS)
    adapters = model.adapter_specs(cfg)
    return attach(trains, adapters if recon_trains else {"dit": adapters["dit"]}), frozen


def layout(cfg: config.RoGeConfig, m: int, sizes, *, recon_trains: bool) -> dict:
    mesh, (trains, frozen) = abstract_mesh(sizes), parameters(cfg, recon_trains)
    live = activations(cfg, m, sizes[2], recon_trains=recon_trains)
    weights = held(frozen, mesh, frozen_item)
    gathered = 0.0 if sizes[1] == 1 else 2.0 * 2 * count(frozen["dit"]["blocks"]) / cfg.dit.depth
    state = held(trains, mesh, lambda path: 16)  # float32 weights, gradients and Adam's two moments
    rest = max(live["renderer"], live["encoder"], live["vae"])
    received = communication(cfg, m, sizes, recon_trains=recon_trains)
    return {
        "mesh": dict(zip(sharding.MESH_AXES, sizes)),
        "batch": sizes[0] * sizes[1],
        "weights": weights,
        "gathered_blocks": gathered,
        "state": state,
        "activations": live,
        "total_full": weights + gathered + state + live["kept"] + max(live["dit_full"], rest),
        "total_dots": weights + gathered + state + live["kept"] + max(live["dit_dots"], rest),
        "received": received,
        "flops": shares(cfg, m, recon_trains=recon_trains)["step"] / sizes[2],
    }


def layout_table(title: str, rows: dict[int, list[dict]]) -> list[str]:
    out = [
        f"**{title}**",
        "",
        "| GPUs | data, fsdp, seq | scenes per step | frozen weights | trained + Adam | activations, full / dots | "
        "peak, full / dots | weights gathered | gradients | tokens + views | TFLOP |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for gpus, found in rows.items():
        for x in found:
            live, got = x["activations"], x["received"]
            moved = got["tokens"] + got["views"]
            rest = max(live["renderer"], live["encoder"], live["vae"])
            kept = [live["kept"] + max(live[f"dit_{p}"], rest) for p in ("full", "dots")]
            cells = [
                str(gpus),
                ", ".join(map(str, x["mesh"].values())),
                str(x["batch"]),
                f"{x['weights'] / GB:.1f}"
                + (f" + {x['gathered_blocks'] / GB:.1f}" if x["gathered_blocks"] else ""),
                f"{x['state'] / GB:.1f}",
                f"{kept[0] / GB:.0f} / {kept[1] / GB:.0f}",
                f"{x['total_full'] / GB:.0f} / {x['total_dots'] / GB:.0f}",
                f"{got['gather frozen weights'] / GB:.1f}",
                f"{got['gradients'] / GB:.1f}",
                f"{moved / GB:.1f}",
                f"{x['flops'] / 1e12:.0f}",
            ]
            out.append("| " + " | ".join(cells) + " |")
    return [*out, ""]


def growth() -> tuple[list[dict], list[str]]:
    """FLOPs and bytes of one scene against M, N and resolution, one device, relative to the first row of each group."""
    cases = {
        "photos M, 81 frames at 192x336": [((192, 336, 81), m) for m in (3, 4, 5, 6, 7, 8, 9)],
        "photos M, 81 frames at 480x832 (reconstruction frozen)": [
            ((480, 832, 81), m) for m in (3, 6, 9)
        ],
        "frames N, M = 6 at 192x336": [((192, 336, n), 6) for n in (81, 101, 121, 141, 161)],
        "size, M = 6, 81 frames": [
            ((h, w, 81), 6) for h, w in ((192, 336), (288, 512), (384, 672), (480, 832))
        ],
    }
    rows = []
    lines = [
        "| | | transformer tokens | forward, TFLOP | step, TFLOP | step, relative | activations, full, GB |",
        "|---|---|---|---|---|---|---|",
    ]
    for title, group in cases.items():
        first = None
        for size, m in group:
            cfg, trains = sized(*size), "frozen" not in title
            n = shares(cfg, m, recon_trains=trains)
            live = activations(cfg, m, 1, recon_trains=trains)
            peak = live["kept"] + max(
                live["dit_full"], live["renderer"], live["encoder"], live["vae"]
            )
            first = first or n["step"]
            label = (
                f"M = {m}"
                if "photos" in title
                else f"N = {size[2]}"
                if "frames N" in title
                else f"{size[0]}x{size[1]}"
            )
            rows.append({"group": title, "case": label, "activations": peak} | n)
            forward = (n["forward"] + n["recon"]) / 1e12
            lines.append(
                f"| {title if first == n['step'] else ''} | {label} | {n['tokens']:,} | {forward:.0f} | "
                f"{n['step'] / 1e12:.0f} | x{n['step'] / first:.2f} | {peak / GB:.1f} |"
            )
    return rows, [*lines, ""]


def main() -> None:
    jax.config.update("jax_platforms", "cpu")
    first, second = sized(192, 336), sized(480, 832)
    results = {
        "source": "arithmetic from the parameter specs; nothing in this file was measured",
        "layouts": {},
    }
    lines = []
    for title, cfg, trains in (
        (
            "First stage: 192x336, 81 frames, M = 6, LoRA on both halves; GB per GPU, per step",
            first,
            True,
        ),
        (
            "Second stage: 480x832, 81 frames, M = 6, reconstruction frozen; GB per GPU, per step",
            second,
            False,
        ),
    ):
        found = {
            gpus: [layout(cfg, 6, sizes, recon_trains=trains) for sizes in meshes]
            for gpus, meshes in LAYOUTS.items()
        }
        results["layouts"][title] = found
        lines += layout_table(title, found)
    results["growth"], table = growth()
    trains, frozen = parameters(first, True)
    results["parameters"] = {"trained": count(trains), "frozen": count(frozen)}
    RESULT.write_text(json.dumps(results, indent=1) + "\n")
    begin, end = "<!-- tables: experiments/scaling.py -->", "<!-- end of tables -->"
    page = PAGE.read_text()
    head, tail = page.split(begin)[0], page.split(end)[1]
    middle = "\n".join(["", *lines, "**Growth of one scene** (one GPU)", "", *table])
    PAGE.write_text(f"{head}{begin}\n{middle}\n{end}{tail}")
    print("\n".join([*lines, *table]))


if __name__ == "__main__":
    main()
