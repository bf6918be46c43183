"""One process of the run in test_distributed.py: a linear model trained by the package's own loop.

    python distributed_worker.py OUT DATA_WAYS FSDP_WAYS STEPS [--resume] [--die-after STEP]
    python distributed_worker.py OUT DATA_WAYS FSDP_WAYS disagree

Joins the others through the environment, as any launcher would have it.
"""

import functools
import os
import sys
from pathlib import Path

import numpy as np

BATCH = 8


def batches(rows):
    """Sample j of batch i is a function of (i, j) alone."""

    def draw(i: int) -> dict:
        rngs = [np.random.default_rng([7, i, j]) for j in rows]
        x = np.stack([rng.normal(size=16) for rng in rngs]).astype(np.float32)
        return {"x": x, "y": np.sin(x[:, :4])}

    return draw


def train(
    out: Path,
    data: int,
    fsdp: int,
    steps: int,
    *,
    resume: bool = False,
    die_after: int | None = None,
):
    import jax
    import jax.numpy as jnp

    from roge_jax.core import sharding
    from roge_jax.core.distributed import local_rows
    from roge_jax.core.params import Spec, init
    from roge_jax.training.loop import LoopConfig
    from roge_jax.training.loop import train as train_loop
    from roge_jax.training.optim import OptimConfig

    mesh = sharding.make_mesh(data, fsdp, devices=jax.devices()[: data * fsdp])
    specs = {"out": {"kernel": Spec((16, 4), ("embed", "mlp")), "bias": Spec((4,), ("mlp",))}}
    frozen_specs = {"base": {"kernel": Spec((16, 16), ("embed", "mlp"))}}

    def objective(trainable, frozen, batch, key):
        x = batch["x"] + 0.1 * jax.random.normal(key, batch["x"].shape)
        y = jnp.tanh(x @ frozen["base"]["kernel"]) @ trainable["out"]["kernel"]
        loss = jnp.square(y + trainable["out"]["bias"][None] - batch["y"]).mean()
        return loss, {}

    done = -1  # the first evaluation comes before the first step

    def evaluate(params):
        nonlocal done
        done += 1
        if done == die_after:
            os._exit(9)  # no good-bye to anybody, as when a machine is lost
        return {}

    return train_loop(
        objective,
        init(jax.random.key(0), specs),
        init(jax.random.key(1), frozen_specs),
        specs,
        batches(local_rows(mesh, BATCH)),
        optim=OptimConfig(learning_rate=0.01, ema=0.9, warmup=1),
        loop=LoopConfig(steps=steps, log_every=1, save_every=3),
        out=out,
        resume=resume,
        mesh=mesh,
        frozen_specs=frozen_specs,
        batch=BATCH,
        evaluate=evaluate,
        evaluate_every=1,
    )


def disagree(out: Path, data: int, fsdp: int) -> None:
    """Print what is said where processes differ, and fail where they agree and something is said."""
    import jax

    from roge_jax.core import distributed, sharding
    from roge_jax.errors import UserError
    from roge_jax.training.start import check_processes

    mesh, own = sharding.make_mesh(data, fsdp), jax.process_index()
    rows = distributed.local_rows(mesh, BATCH)

    def batch(photos: int):
        views = {"views": np.ones((len(rows), photos, 2), np.float32)}
        return distributed.global_batch(views, mesh, BATCH)["views"]

    assert batch(3).shape == (BATCH, 3, 2)
    # Nobody holds all scenes of a batch, and everybody gets them, in their order.
    numbered = distributed.global_batch({"number": 10.0 * rows}, mesh, BATCH)
    assert not numbered["number"].is_fully_addressable and len(rows) < BATCH
    np.testing.assert_array_equal(sharding.gather(numbered)["number"], 10.0 * np.arange(BATCH))
    check = functools.partial(check_processes, version="1")
    for name in ("shared", f"own{own}"):  # what a process sees under one name on its own disk
        (out / name).mkdir(parents=True, exist_ok=True)
        for file in ("config.json", "shard_00000.npz"):
            (out / name / file).write_text(f"{file} of {name}")
    distributed.meet("files")
    shared, mine = out / "shared", out / f"own{own}"
    check({"seed": 0, "devices": None, "encode_once": None}, "mini", None)
    check({"seed": 0}, str(shared), shared)
    for wrong in (
        lambda: check({"seed": 0}, str(mine), shared),
        lambda: check({"seed": 0}, str(shared), mine),
        lambda: check({"seed": 0, "encode_once": 4}, "scratch", None),
        lambda: batch(3 + own),
        lambda: check({"seed": 0, "out": f"runs/{own}"}, "scratch", None),
        lambda: check({"seed": 0, "devices": 1}, "scratch", None),
    ):
        try:
            wrong()
        except UserError as error:
            print(error, flush=True)
        else:
            raise AssertionError("nothing was said")


if __name__ == "__main__":
    from roge_jax.core.distributed import maybe_initialise_distributed

    out, data, fsdp, steps = sys.argv[1:5]
    options = sys.argv[5:]
    maybe_initialise_distributed()
    if steps == "disagree":
        disagree(Path(out), int(data), int(fsdp))
    else:
        train(
            Path(out),
            int(data),
            int(fsdp),
            int(steps),
            resume="--resume" in options,
            die_after=int(options[-1]) if "--die-after" in options else None,
        )
