"""What `train --dry-run` says a LoRA step holds, beside what XLA allocates for it, on the `tiny` and `mini` presets.

    python experiments/memory_check.py         about 5 minutes on one quiet core; nothing is trained, only compiled

XLA's figures are `compiled.memory_analysis()`: arguments and temporary memory, once with operations in one order, as
on a GPU, and once with a CPU's own schedule, which runs independent operations side by side and keeps more alive.
LLVM's optimisation is off (it changes the code of kernels, not the buffers). M = 3 photos, batch 1, float32.
Writes experiments/results/memory_check.json.
"""

import dataclasses
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
RESULT = HERE / "results" / "memory_check.json"
CASES = (("tiny", "dots"), ("mini", "dots"), ("mini", "full"), ("mini", "none"))
SCHEDULES = {"in order": False, "side by side": True}
M = 3


def check(name: str, remat: str) -> dict:
    import jax

    from roge_jax import config
    from roge_jax.training import plan, stages

    cfg = config.preset(name)
    stage = dataclasses.replace(stages.lora_stage(10, frames=cfg.frames), remat=remat)
    start = time.process_time()
    found = plan.plan(cfg, stage, m=M)
    planning = time.process_time() - start
    step, arguments = plan.abstract_step(cfg, stage, M, scenes=1)
    lowered = jax.jit(step, donate_argnums=0, keep_unused=True).lower(*arguments)
    row = {
        "preset": name,
        "remat": remat,
        "planned": found.memory,
        "planning_cpu_seconds": planning,
    }
    for schedule, concurrent in SCHEDULES.items():
        options = {"xla_cpu_enable_concurrency_optimized_scheduler": concurrent}
        used = lowered.compile(compiler_options=options).memory_analysis()
        total = used.argument_size_in_bytes + used.temp_size_in_bytes
        activations = found.memory["activations and gradients"]
        row[schedule] = {
            "arguments": used.argument_size_in_bytes,
            "temporary": used.temp_size_in_bytes,
            "planned_over_xla": {
                "all": found.bytes / total,
                "temporary": activations / used.temp_size_in_bytes,
            },
        }
    return row


def main() -> None:
    from roge_jax.entry import environment

    rows = []
    for name, remat in CASES:
        rows.append(check(name, remat))
        print(json.dumps(rows[-1]), flush=True)
        RESULT.write_text(json.dumps({"environment": environment(), "rows": rows}, indent=1) + "\n")
    print(
        "| preset, remat | schedule | planned, MB | XLA, MB | all | temporary alone |\n|---|---|---|---|---|---|"
    )
    for row in rows:
        for schedule in SCHEDULES:
            x = row[schedule]
            xla, ratio = (x["arguments"] + x["temporary"]) / 1e6, x["planned_over_xla"]
            print(
                f"| {row['preset']}, {row['remat']} | {schedule} | {sum(row['planned'].values()) / 1e6:.1f} | "
                f"{xla:.1f} | {ratio['all']:.2f} | {ratio['temporary']:.2f} |"
            )


if __name__ == "__main__":
    main()
