"""What the compiler of GPUs says of the paper's programs, on GPUs that are not there: memory, FLOPs, kernels, collectives.

    make test-accelerators                                              installs the compiler (extra `aot`) and tests with it
    .venv-aot/bin/python -m experiments.scaling.compiled                about 40 minutes on two cores: all of CASES
    .venv-aot/bin/python -m experiments.scaling.compiled --only velocity    those whose name has these words

A case is "program,device,data,fsdp,seq". Steps are those of `training.compiled`: `lora` and `hires` whole (full
recomputation, a scene on every group of `seq` GPUs), `transformer step` that of `hires` on samples encoded once.
`prepare`, `velocity` and `decode` are those of a window with 6 photos. bfloat16 matrices, M = 6, preset `paper`. Every
case compiles in a process of its own. Nothing here is a time on a GPU. Writes experiments/results/compiled.json and
the table in docs/results/scaling.md.
"""

import argparse
import dataclasses
import datetime
import json
import math
import os
import time

from experiments import harness

M = 6
MESHES = ("8,1,1", "1,8,1", "2,2,2", "1,1,8")
CASES = (
    "velocity,h100,1,1,1",
    "prepare,h100,1,1,1",
    "decode,h100,1,1,1",
    *(f"{stage},h100,{mesh}" for stage in ("lora", "hires") for mesh in MESHES),
    "lora,h100,1,1,1",
    "hires,h200,1,1,1",
)
LARGE = 30  # the largest results of a module that a row names


def compile_case(program: str, device: str, sizes: tuple[int, int, int]) -> dict:
    """What the compiler says of one program, beside what the project plans for it."""
    from roge_jax import config, cost
    from roge_jax.core import sharding, target
    from roge_jax.core.params import flatten
    from roge_jax.sampling import compiled as sampling
    from roge_jax.training import compiled as training
    from roge_jax.training import estimate, stages, start

    cfg = config.preset("paper")
    begun, more = time.perf_counter(), {}
    if program in sampling.PIECES:
        found = sampling.compiled_window(cfg, M, name=device, sizes=sizes, pieces=(program,))
        said = found[program]
        with target.use(device):
            planned = cost.estimate(cfg, M, 1, dtype="bfloat16").working_bytes
        if program in planned:
            more["planned"] = {"temporary": planned[program]}
    else:
        hires = program != "lora"
        cfg = start.resize(cfg, "480x832", hires=True) if program == "hires" else cfg
        stage = stages.lora_stage(100, frames=cfg.frames, hires=hires)
        if program == "transformer step":
            stage = stages.once_encoded(stage, cfg, 8)
        stage = dataclasses.replace(
            stage, remat="full", products="bfloat16", batch=sizes[0] * sizes[1]
        )
        said = training.compiled_step(cfg, stage, m=M, name=device, sizes=sizes, dtype="bfloat16")
        if program != "transformer step":
            with target.use(device):
                mesh = sharding.abstract_mesh(*sizes)
                plan = estimate.estimate(cfg, stage, m=M, mesh=mesh, dtype="bfloat16")
            more["planned"] = {"all": plan.bytes, "flops": plan.flops, **plan.memory}
        specs = flatten(stages.stage_specs(cfg, stage)[1])
        blocks = [s for path, s in specs.items() if path.startswith("dit/blocks/")]
        more["block"] = sum(2 * math.prod(s.shape[1:]) for s in blocks)
    module = said.module
    largest = sorted(module.results.items(), key=lambda item: -item[0].bytes)[:LARGE]
    return more | {
        "arguments": said.arguments,
        "temporary": said.temporary,
        "output": said.output,
        "alias": said.alias,
        "peak": said.peak,
        "options": said.options,
        "flops": module.flops,
        "kernels": module.kernels,
        "collectives": module.collectives,
        "largest_gather": module.largest_gather,
        "unknown_loops": module.unknown_loops,
        "results": [(x.dtype, x.shape, times) for x, times in largest],
        "compile_seconds": {"wall": time.perf_counter() - begun, "cpu": sum(os.times()[:2])},
    }


def child(case: str) -> dict:
    """`compile_case` in a process of its own."""
    settings = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "", "TF_CPP_MIN_LOG_LEVEL": "3"}
    settings["JAX_DEFAULT_MATMUL_PRECISION"] = "default"
    settings["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    return harness.child("experiments.scaling.compiled", "--case", case, **settings)


def held(row: dict) -> float:
    """Bytes of one device: arguments, temporary memory and results that do not lie where arguments lay."""
    return row["arguments"] + row["temporary"] + row["output"] - row["alias"]


def table(rows: dict[str, dict]) -> list[str]:
    lines = []
    for case, row in rows.items():
        program, device, *sizes = case.split(",")
        flops, moved = row["flops"], row["collectives"]
        planned, total = row.get("planned", {}), sum(flops.values())
        bytes_planned = planned.get("all")
        lines.append(
            [
                f"{program}, {device}",
                ", ".join(sizes),
                f"{row['arguments'] / 1e9:.1f}",
                f"{row['temporary'] / 1e9:.1f}",
                f"{held(row) / 1e9:.1f}",
                "" if bytes_planned is None else f"{bytes_planned / 1e9:.1f}",
                f"{total / 1e12:.0f}",
                f"{planned['flops'] / 1e12:.0f}" if "flops" in planned else "",
                f"{flops.get('f32', 0.0) / total:.0%}" if total else "",
                *(
                    f"{moved.get(kind, 0.0) / 1e9:.1f}"
                    for kind in ("all-gather", "all-to-all", "all-reduce", "reduce-scatter")
                ),
                "no Triton products" if row["options"] else "",
            ]
        )
    columns = [
        "program, device",
        "data, fsdp, seq",
        "arguments",
        "temporary",
        "all",
        "planned",
        "TFLOP",
        "planned",
        "float32",
        "all-gather",
        "all-to-all",
        "all-reduce",
        "reduce-scatter",
        "",
    ]
    return harness.table(columns, lines)


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--case", help=argparse.SUPPRESS)
    p.add_argument("--only", default="", help="compile the cases whose name has these words")
    args = p.parse_args()
    if args.case:
        program, device, *sizes = args.case.split(",")
        data, fsdp, seq = map(int, sizes)
        return print(json.dumps(compile_case(program, device, (data, fsdp, seq))))
    from importlib.metadata import version

    from roge_jax.core import aot

    if why := aot.missing("h100"):
        raise SystemExit(f"{why}: see the head of this program")
    before = harness.read("compiled.json", {"rows": {}})["rows"]
    rows = {case: before[case] for case in CASES if case in before}
    for case in (case for case in CASES if args.only in case):
        print(case, flush=True)
        rows[case] = child(case)
        rows = {case: rows[case] for case in CASES if case in rows}
        plugin = {name: version(name) for name in ("jax", "jaxlib", "jax-cuda12-pjrt")}
        today = datetime.date.today().isoformat()
        harness.write("compiled.json", {"date": today, "versions": plugin, "rows": rows})
    lines = table(rows)
    harness.put(harness.DOCS / "results" / "scaling.md", "compiled", "\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
