"""Which parts of the small model earn their keep: every part removed or resized, at equal compute.

    OPENBLAS_NUM_THREADS=1 NPROC=1 XLA_FLAGS=--xla_cpu_multi_thread_eigen=false taskset -c 0 \\
        python -m experiments.ablation --data runs/pool         # results/ablation.{json,png}, docs/results/ablation.md

CPU, about two hours on one core that is idle otherwise. Finished rows are in the JSON and are not run again, unless their
settings or the shipped weights that they measure have changed; several processes may share the work, each on its core
with its own `--only`. Without `--data` scenes are rendered as they are needed. Seeds 0 and 1. Seven groups:

  reconstruction  `recon_low` from nothing (32x56, 8 scenes x 4 targets, 3 photos), every variant for the FLOPs of 80
                  steps of the base; PSNR of the RGB head on 32 held-out scenes, paired with the base
  look-up         the shipped reconstruction: PSNR of the RGB head, of what the rays find in the photos, and of both
  conditions      the shipped generator: held-out flow error by noise level with a condition zeroed or taken from
                  another scene, the same noise for all
  finetune        the shipped generator trained on for equal steps while a condition is absent: what it can replace
  transformer     `generator` from nothing on the shipped reconstruction, every size of the transformer for the FLOPs
                  of 60 steps of the base (2 clips x 4 noise levels); held-out flow error, paired with the base
  lora            the LoRA stage at rank 32 on the shipped model: singular values of the update, and the held-out loss
                  with the update cut to lower ranks
  adaptation      the same on one scene, scored on frames kept back; and trained at lower ranks outright

The published system reports no such ablation. Our numbers and what they are worth: docs/results/ablation.md.
"""

import argparse
import dataclasses
import hashlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments import harness
from experiments.ablation import adaptation, generator, reconstruction, report, transformer
from roge_jax import checkpoint, model
from roge_jax.config import preset
from roge_jax.core.params import Tree, flatten
from roge_jax.data.dataset import read_dataset
from roge_jax.data.source import ProceduralSource
from roge_jax.files import entry


def fingerprint(params: Tree, *settings: object) -> str:
    """Changes with any weight, and with the settings."""
    digest = hashlib.sha256()
    for path, x in flatten(params).items():
        digest.update(path.encode() + np.asarray(x).tobytes())
    for value in settings:
        digest.update(repr(value).encode())
    return digest.hexdigest()[:12]


class Job(NamedTuple):
    group: str
    settings: dict  # a row measured with other settings is measured again
    measure: Callable[[], dict]


def jobs(args: argparse.Namespace) -> dict[str, Job]:
    """Everything to measure, in the order of the run."""
    source = read_dataset(args.data) if args.data else ProceduralSource(64, 112, 24)
    mini, (params, config) = preset("mini"), checkpoint.load_model("mini")
    plain = dataclasses.replace(mini, renderer=dataclasses.replace(mini.renderer, lookup=0))
    weights = {"weights": checkpoint.weights_fingerprint(params, "float32"), "clips": args.clips}
    found = {
        name: Job(
            "reconstruction",
            {"steps": args.steps},
            lambda v=variant: reconstruction.train(v, plain, source, args.steps),
        )
        for name, variant in reconstruction.VARIANTS.items()
    }
    frozen = transformer.Frozen(params, config, source, scenes=args.clips)
    about = {
        "frozen": fingerprint(model.split(params, transformer.TRAINS)[1], config.fusion),
        "clips": args.clips,
        "steps": args.transformer_steps,
    }
    found |= {
        name: Job(
            "transformer",
            about,
            lambda v=variant: transformer.train(v, frozen, args.transformer_steps),
        )
        for name, variant in transformer.VARIANTS.items()
    }
    found |= {
        name: Job(
            "adaptation",
            {"weights": weights["weights"], "steps": args.adapt_steps},
            lambda rank=rank, ranks=ranks: adaptation.adapt(
                params, config, args.adapt_steps, rank=rank, ranks=ranks
            ),
        )
        for name, rank, ranks in (
            ("adaptation", 32, adaptation.RANKS),
            ("adaptation, rank 8", 8, ()),
            ("adaptation, rank 2", 2, ()),
        )
    }
    return found | {
        "look-up": Job(
            "look-up",
            {"weights": weights["weights"]},
            lambda: reconstruction.look_up(params, config),
        ),
        "conditions": Job(
            "conditions", weights, lambda: generator.conditions(params, config, args.clips)
        ),
        "lora": Job(
            "lora",
            weights | {"steps": args.lora_steps},
            lambda: adaptation.lora(params, config, source, args.lora_steps, scenes=args.clips),
        ),
        "finetune": Job(
            "finetune",
            weights | {"steps": args.finetune_steps},
            lambda: generator.finetune(
                params, config, source, args.finetune_steps, scenes=args.clips
            ),
        ),
    }


def measured(job: Job) -> dict:
    """The row of a job, with what produced it."""
    cpu, wall = time.process_time(), time.perf_counter()
    return job.measure() | {
        "settings": job.settings,
        "all_core_seconds": time.process_time() - cpu,
        "wall_seconds": time.perf_counter() - wall,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "commit": entry.git_commit(),
    }


def stored(path: Path) -> dict[str, dict]:
    """The finished rows, in the order in which they are shown."""
    rows = harness.read(path, absent={"rows": {}})["rows"]
    return dict(sorted(rows.items(), key=lambda item: report.ORDER.index(item[0])))


def main() -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--data", type=Path, help="pool of training scenes (default: render)")
    parser.add_argument("--steps", type=int, default=80, help="of the base reconstruction")
    parser.add_argument("--clips", type=int, default=16, help="held-out, for the generator")
    parser.add_argument("--lora-steps", type=int, default=60)
    parser.add_argument("--finetune-steps", type=int, default=40)
    parser.add_argument("--transformer-steps", type=int, default=60, help="of the base transformer")
    parser.add_argument("--adapt-steps", type=int, default=40)
    parser.add_argument("--only", nargs="+", help="names or groups, such as conditions lora")
    parser.add_argument("--redraw", action="store_true", help="only tables and chart")
    parser.add_argument(
        "--out", type=Path, default=harness.RESULTS, help="folder of ablation.{json,png}"
    )
    args = parser.parse_args()
    path = args.out / "ablation.json"
    for name, job in {} if args.redraw else jobs(args).items():
        if args.only and not {name, job.group} & set(args.only):
            continue
        if stored(path).get(name, {}).get("settings") == job.settings:
            print(f"{name}: done before", flush=True)
            continue
        row = measured(job)
        rows = stored(path) | {name: row}  # read again: others may have written meanwhile
        harness.write(path, {"rows": rows}, digits=5)
        print(
            f"{name}: {row['all_core_seconds']:.0f} core-s, {row['wall_seconds']:.0f} s", flush=True
        )
        jax.clear_caches()
    rows = stored(path)
    report.draw(rows, args.out / "ablation.png")
    if args.out == harness.RESULTS:
        harness.put(harness.DOCS / "results" / "ablation.md", "ablation", report.tables(rows))


if __name__ == "__main__":
    main()
