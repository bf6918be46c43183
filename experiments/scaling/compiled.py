"""What the compiler of GPUs says of programs on GPUs that are not there: memory, FLOPs, kernels, collectives.

    make scaling                                                        installs the compiler (extra `aot`), compiles all of CASES
    .venv-aot/bin/python -m experiments.scaling.compiled --only velocity    those whose name has these words
    .venv-aot/bin/python -m experiments.scaling.compiled --missing          those that the results do not have yet

About an hour and a half on two quiet cores. A case is "preset,size,program,device,data,fsdp,seq". Steps are those of
`training.compiled`: `lora` and `hires` whole (full recomputation, a scene on every group of `seq` GPUs), `transformer step`
that of `hires` on samples encoded once. `prepare`, `velocity` (one forward pass) and `decode` are those of a window with 6
photos. bfloat16 matrices and products, M = 6, 81 frames. Every case compiles in a process of its own, and a row is written
when it is there. Nothing here is a time on a GPU. Writes experiments/results/compiled.json and the tables in
docs/results/scaling.md.
"""

import argparse
import dataclasses
import datetime
import json
import math
import os
import resource
import subprocess
import time
from typing import NamedTuple

from experiments import harness

M = 6
SMALL, LARGE = "192x336", "480x832"
PIECES = ("velocity", "prepare", "decode")
# Of eight GPUs; `seq` has to divide the heads: 40 of `paper`, 12 of `wan1.3b`.
MESHES = {"paper": ("8,1,1", "1,8,1", "2,2,2", "1,1,8"), "wan1.3b": ("8,1,1", "1,8,1", "2,1,4")}
STEP = {SMALL: "lora", LARGE: "hires"}
RESULTS = 30  # the largest results of a module that a row names


class Case(NamedTuple):
    """What is compiled: a program of a preset at a size, and the GPUs."""

    preset: str
    size: str
    program: str
    device: str
    sizes: tuple[int, int, int]  # data, fsdp, seq

    @property
    def name(self) -> str:
        return ",".join((*self[:4], *map(str, self.sizes)))


def case(name: str) -> Case:
    """The case of a name as `Case.name` writes it."""
    preset, size, program, device, data, fsdp, seq = name.split(",")
    return Case(preset, size, program, device, (int(data), int(fsdp), int(seq)))


def every_case() -> list[Case]:
    """One GPU and eight, one size after the other; the card of a desk where it may fit."""
    names = []
    for preset, meshes in MESHES.items():
        for size, step in STEP.items():
            one = f"{preset},{size},{{}},{{}},1,1,1"
            names += [one.format(program, "h100") for program in (*PIECES, step)]
            names += [f"{preset},{size},{step},h100,{mesh}" for mesh in meshes]
            names += [f"{preset},{size},{piece},h100,{meshes[-1]}" for piece in ("velocity",)]
            if preset == "wan1.3b":
                names += [one.format(program, "rtx4090") for program in (*PIECES, step)]
    return list(map(case, names))


CASES = tuple(every_case())


def compile_case(wanted: Case) -> dict:
    """What the compiler says of one program, beside what the project plans for it."""
    from roge_jax import config
    from roge_jax.sampling import compiled as sampling
    from roge_jax.training import start

    cfg = config.preset(wanted.preset)
    cfg = start.resize(cfg, LARGE, hires=True) if wanted.size == LARGE else cfg
    begun = time.perf_counter()
    if wanted.program in PIECES:
        piece = (wanted.program,)
        options = {"name": wanted.device, "sizes": wanted.sizes, "pieces": piece}
        said = sampling.compiled_window(cfg, M, **options)[wanted.program]
        more = {"planned": planned_piece(cfg, wanted)}
    else:
        said, more = compiled_step(cfg, wanted)
    module = said.module
    largest = sorted(module.results.items(), key=lambda item: -item[0].bytes)[:RESULTS]
    return more | {
        "date": datetime.date.today().isoformat(),
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
        "host_bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    }


def planned_piece(cfg, wanted: Case) -> dict:
    """What `sample --dry-run` counts for a program of a window on one device; {} for more, of which it says nothing."""
    from roge_jax import cost
    from roge_jax.core import target

    if math.prod(wanted.sizes) > 1:
        return {}
    with target.use(wanted.device):
        found = cost.estimate(cfg, M, 1, dtype="bfloat16")
    own = [wanted.program]
    if wanted.program == "prepare":
        own = [name for name in found.flops if name not in ("velocity", "decode")]
    return {
        "temporary": max(found.working_bytes[name] for name in own),
        "flops": sum(found.flops[name] for name in own),
    }


def compiled_step(cfg, wanted: Case) -> tuple:
    """(what the compiler says of a training step, what `train --dry-run` does)."""
    from roge_jax.core import sharding, target
    from roge_jax.core.params import flatten
    from roge_jax.training import compiled as training
    from roge_jax.training import estimate, stages

    stage = stages.lora_stage(100, frames=cfg.frames, hires=wanted.program != "lora")
    if wanted.program == "transformer step":
        stage = stages.once_encoded(stage, cfg, 8)
    batch = wanted.sizes[0] * wanted.sizes[1]
    stage = dataclasses.replace(stage, remat="full", products="bfloat16", batch=batch)
    options = {"m": M, "dtype": "bfloat16"}
    said = training.compiled_step(cfg, stage, name=wanted.device, sizes=wanted.sizes, **options)
    specs = flatten(stages.stage_specs(cfg, stage)[1])
    blocks = [s for path, s in specs.items() if path.startswith("dit/blocks/")]
    more: dict = {"block": sum(2 * math.prod(s.shape[1:]) for s in blocks)}
    if wanted.program != "transformer step":
        with target.use(wanted.device):
            mesh = sharding.abstract_mesh(*wanted.sizes)
            plan = estimate.estimate(cfg, stage, mesh=mesh, **options)
        more["planned"] = {"all": plan.bytes, "flops": plan.flops, **plan.memory}
    return said, more


def child(name: str) -> dict:
    """`compile_case` in a process of its own."""
    settings = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "", "TF_CPP_MIN_LOG_LEVEL": "3"}
    settings["JAX_DEFAULT_MATMUL_PRECISION"] = "default"
    settings["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    return harness.child("experiments.scaling.compiled", "--case", name, **settings)


def held(row: dict) -> float:
    """Bytes of one device: arguments, temporary memory and results that do not lie where arguments lay."""
    return row["arguments"] + row["temporary"] + row["output"] - row["alias"]


def table(rows: dict[str, dict]) -> list[str]:
    """What a device holds, does and moves."""
    lines = []
    for name, row in rows.items():
        one = case(name)
        head = [
            one.preset,
            one.size,
            f"{one.program}, {one.device}",
            ", ".join(name.split(",")[4:]),
        ]
        if "error" in row:
            lines.append([*head, *[""] * 12, row["error"]])
            continue
        flops, moved, planned = row["flops"], row["collectives"], row.get("planned", {})
        total = sum(flops.values())
        reduced = moved.get("all-reduce", 0.0) + moved.get("reduce-scatter", 0.0)
        dtype, shape, _ = row["results"][0]
        lines.append(
            [
                *head,
                f"{row['arguments'] / 1e9:.1f}",
                _beside(row["temporary"], planned.get("temporary"), 1e9, ".1f"),
                _beside(held(row), planned.get("all"), 1e9, ".1f"),
                _beside(total, planned.get("flops"), 1e12, ",.0f"),
                f"{flops.get('f32', 0.0) / total:.1%}" if total else "",
                str(sum(n for kernel, n in row["kernels"].items() if "fmha" in kernel) or ""),
                *(
                    f"{x / 1e9:.1f}" if x else ""
                    for x in (moved.get("all-gather"), moved.get("all-to-all"), reduced)
                ),
                f"{dtype}[{','.join(map(str, shape))}]",
                f"{row['compile_seconds']['cpu']:.0f}",
                f"{row['host_bytes'] / 1e9:.1f}" if "host_bytes" in row else "",
                row.get("note") or ("no Triton products" if row["options"] else ""),
            ]
        )
    columns = ["preset", "size", "program, device", "data, fsdp, seq", "arguments"]
    columns += ["temporary / planned", "all / planned", "TFLOP / counted", "float32", "cuDNN calls"]
    columns += ["all-gather", "all-to-all", "reduced", "largest result", "compiled in, CPU s"]
    return harness.table([*columns, "host, GB", ""], lines)


def _beside(said: float, planned: float | None, unit: float, form: str) -> str:
    cell = f"{said / unit:{form}}"
    return cell if planned is None else f"{cell} / {planned / unit:{form}}"


def changes(rows: dict[str, dict], before: dict[str, dict]) -> list[str]:
    """The steps that were compiled before products had a rule of their own, and what they are now."""
    lines = []
    for name, old in before.items():
        one, cells = case(name), []
        for row in (old, rows.get(name, {})):
            if "flops" not in row:
                cells += ["", ""]
                continue
            total, wide = sum(row["flops"].values()), row["flops"].get("f32", 0.0)
            cells += [f"{wide / 1e12:.0f} ({wide / total:.1%})", f"{held(row) / 1e9:.1f}"]
        mesh = ", ".join(map(str, one.sizes))
        lines.append([f"{one.program}, {one.size}, {one.device}", mesh, *cells])
    columns = ["step of `paper`", "data, fsdp, seq", "float32 TFLOP, before", "all, before"]
    return harness.table([*columns, "float32 TFLOP, now", "all, now"], lines)


def write(rows: dict[str, dict], before: dict[str, dict]) -> list[str]:
    """The tables of the page, from the results."""
    made = table(rows)
    page = harness.DOCS / "results" / "scaling.md"
    harness.put(page, "compiled", "\n".join(made))
    harness.put(page, "products", "\n".join(changes(rows, before)))
    return made


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--case", help=argparse.SUPPRESS)
    p.add_argument("--only", default="", help="compile the cases whose name has these words")
    p.add_argument("--missing", action="store_true", help="... that the results do not have")
    p.add_argument("--draw", action="store_true", help="compile none: the tables again")
    args = p.parse_args()
    if args.case:
        return print(json.dumps(compile_case(case(args.case))))
    from importlib.metadata import version

    from roge_jax.core import aot

    stored = harness.read("compiled.json", {"rows": {}})
    rows, before = stored["rows"], stored.get("before", {})
    names = [one.name for one in CASES if args.only in one.name]
    if args.missing:
        names = [name for name in names if name not in rows]
    if args.draw:
        names = []
    elif why := aot.missing("h100"):
        raise SystemExit(f"{why}: see the head of this program")
    for name in names:
        print(name, flush=True)
        try:
            rows[name] = child(name)
        except subprocess.CalledProcessError:
            rows[name] = {"error": "does not compile"}
        order = [one.name for one in CASES if one.name in rows]
        rows = {name: rows[name] for name in order}
        plugin = {name: version(name) for name in ("jax", "jaxlib", "jax-cuda12-pjrt")}
        found = {"versions": plugin, "rows": rows, "before": before}
        harness.write("compiled.json", found)
    print("\n".join(write(rows, before)))


if __name__ == "__main__":
    main()
