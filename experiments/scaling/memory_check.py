"""What `train --dry-run` says a LoRA step holds, beside what XLA allocates for it, on the `tiny` and `mini` presets.

    python -m experiments.scaling.memory_check         about 6 minutes on one quiet core; nothing is trained, only compiled

XLA's figures are `compiled.memory_analysis()`, arguments and temporary memory, under three schedules:

    in-order        one order of operations, fused by XLA alone, as on a GPU
    library         the same, but sums over axes go to a CPU library (YNN), as CPUs do by default. XLA stores what such a call
                    reads: maps of the VAE's biases and scales, which two encodings share, live from one to the other
    side-by-side    a CPU's own: the library, and independent operations at once, which keeps more alive

LLVM's optimisation is off (it changes the code of kernels, not the buffers). M = 3 photos, batch 1, float32. Every
case compiles in a process of its own. Writes experiments/results/memory_check.json.
"""

import argparse
import dataclasses
import json

from experiments import harness

CASES = (
    "tiny,dots,in-order",
    "mini,dots,in-order",
    "mini,full,in-order",
    "mini,dots,library",
    "tiny,dots,side-by-side",
    "mini,dots,side-by-side",
)
M = 3


def check(name: str, remat: str) -> dict:
    import jax

    from roge_jax import config
    from roge_jax.training import estimate, stages

    cfg = config.preset(name)
    stage = dataclasses.replace(stages.lora_stage(10, frames=cfg.frames), remat=remat)
    found = estimate.estimate(cfg, stage, m=M)
    step, arguments = estimate.abstract_step(cfg, stage, M, scenes=1)
    # Weights that a step does not read (the VAE's decoder) still lie on the device.
    lowered = jax.jit(step, donate_argnums=0, keep_unused=True).lower(*arguments)
    used = lowered.compile().memory_analysis()
    total = used.argument_size_in_bytes + used.temp_size_in_bytes
    activations = found.memory["activations and gradients"]
    return {
        "planned": found.memory,
        "arguments": used.argument_size_in_bytes,
        "temporary": used.temp_size_in_bytes,
        "planned_over_xla": {
            "all": found.bytes / total,
            "temporary": activations / used.temp_size_in_bytes,
        },
    }


def child(case: str) -> dict:
    """`check` in a process whose XLA follows the schedule of the case."""
    flags = ["--xla_backend_optimization_level=0"]
    if not case.endswith("side-by-side"):
        flags += ["--xla_cpu_enable_concurrency_optimized_scheduler=false"]
    if case.endswith("in-order"):
        flags += ["--xla_cpu_experimental_ynn_fusion_type=-LIBRARY_FUSION_TYPE_REDUCE"]
    settings = {"XLA_FLAGS": " ".join(flags), "JAX_PLATFORMS": "cpu"}
    return harness.child("experiments.scaling.memory_check", "--case", case, **settings)


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--case", choices=CASES, help=argparse.SUPPRESS)
    args = p.parse_args()
    if args.case:
        return print(json.dumps(check(*args.case.split(",")[:2])))
    rows, lines = {case: child(case) for case in CASES}, []
    for case, x in rows.items():
        sizes = sum(x["planned"].values()) / 1e6, (x["arguments"] + x["temporary"]) / 1e6
        ratios = (f"{ratio:.2f}" for ratio in x["planned_over_xla"].values())
        lines.append([case.replace(",", ", "), *(f"{size:.1f}" for size in sizes), *ratios])
    harness.write("memory_check.json", {"environment": harness.environment(), "rows": rows})
    columns = ["case", "planned, MB", "XLA, MB", "all", "temporary alone"]
    print("\n".join(harness.table(columns, lines)))


if __name__ == "__main__":
    main()
