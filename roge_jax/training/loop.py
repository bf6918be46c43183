"""The training loop: one jitted step, and everything around it that keeps a long run honest.

Steps whose loss or gradient is not finite change nothing and are counted; too many of them, or a loss that leaves its
best level for good, stop the run with the reason. Batch and randomness of step i are functions of (seed, i), so a
resumed run continues bit for bit; checkpoints are written atomically and the last few are kept.
"""

import json
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from ..core.params import Tree
from .optim import OptimConfig, ema_update, make_optimiser


class TrainingStopped(RuntimeError):
    """The run ended early; the message says why and which checkpoint is the last good one."""


@dataclass(frozen=True)
class LoopConfig:
    steps: int = 100
    seed: int = 0
    log_every: int = 10
    save_every: int = 100
    keep: int = 3
    max_skipped: float = 0.01  # stop when more than this share of the steps was skipped (after 100 steps) ...
    max_streak: int = 10  # ... or this many in a row
    patience: int = 200  # stop when the loss stays beyond best + 6 MAD for this many steps


def initial_state(trainable: Tree, optimiser: optax.GradientTransformation, optim: OptimConfig) -> Tree:
    """Everything that a checkpoint must hold to continue exactly."""
    state = {
        "params": trainable,
        "opt": optimiser.init(trainable),
        "step": jnp.zeros((), jnp.int32),
        "skipped": jnp.zeros((), jnp.int32),
        "streak": jnp.zeros((), jnp.int32),
    }
    if optim.ema:
        state["ema"] = jax.tree.map(jnp.copy, trainable)
    return state


def make_step(objective: Callable, optimiser: optax.GradientTransformation, optim: OptimConfig) -> Callable:
    """step(state, frozen, batch, key) -> (state, metrics), to be jitted with the state donated.

    `objective(trainable, frozen, batch, key)` returns (loss, terms). A step with a loss or gradient that is not
    finite leaves parameters, optimiser and averages as they were; only the counters move.
    """

    def step(state, frozen, batch, key):
        (loss, terms), grads = jax.value_and_grad(objective, has_aux=True)(
            state["params"], frozen, batch, key
        )
        norm = optax.global_norm(grads)
        ok = jnp.isfinite(loss) & jnp.isfinite(norm)
        updates, opt = optimiser.update(grads, state["opt"], state["params"])
        new = {"params": optax.apply_updates(state["params"], updates), "opt": opt}
        if optim.ema:
            new["ema"] = ema_update(state["ema"], new["params"], optim.ema, state["step"])
        old = {name: state[name] for name in new}
        new = jax.tree.map(lambda a, b: jnp.where(ok, a, b), new, old)
        bad = (~ok).astype(jnp.int32)
        new["step"] = state["step"] + 1
        new["skipped"] = state["skipped"] + bad
        new["streak"] = (state["streak"] + 1) * bad
        metrics = {"loss": loss, "grad_norm": norm, "skipped": new["skipped"], "streak": new["streak"]}
        return new, metrics | terms

    return step


class DivergenceDetector:
    """Says when a smoothed loss has left its best level for good: > best + 6 MAD for `patience` steps."""

    def __init__(self, patience: int, rate: float = 0.02):
        self.patience, self.rate = patience, rate
        self.average: float | None = None
        self.spread, self.best, self.beyond = 0.0, float("inf"), 0

    def update(self, loss: float) -> bool:
        if not np.isfinite(loss):
            return False  # skipped steps have their own limit
        if self.average is None:
            self.average = loss
        self.spread += self.rate * (abs(loss - self.average) - self.spread)
        self.average += self.rate * (loss - self.average)
        self.best = min(self.best, self.average)
        self.beyond = self.beyond + 1 if self.average > self.best + 6 * self.spread else 0
        return self.beyond >= self.patience


def prefetched(batches: Callable[[int], dict], first: int, last: int, depth: int = 2) -> Iterator[dict]:
    """batches(first), .., batches(last - 1), prepared by a thread while the device works."""
    ready: queue.Queue = queue.Queue(maxsize=depth)
    stop = threading.Event()

    def put(item) -> None:
        while not stop.is_set():
            try:
                return ready.put(item, timeout=0.2)
            except queue.Full:
                continue

    def work() -> None:
        try:
            for i in range(first, last):
                if stop.is_set():
                    return
                put(batches(i))
        except BaseException as error:
            put(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        for _ in range(first, last):
            item = ready.get()
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stop.set()
        thread.join()


def train(
    objective: Callable,
    trainable: Tree,
    frozen: Tree,
    specs: Tree,
    batches: Callable[[int], dict],
    *,
    optim: OptimConfig,
    loop: LoopConfig,
    out: Path,
    resume: bool = False,
    mesh: jax.sharding.Mesh | None = None,
    name: str = "train",
    evaluate: Callable[[Tree], dict] | None = None,
    evaluate_every: int = 0,
    writer=None,
) -> Tree:
    """Run `loop.steps` steps; returns the final state. Logs to out/log.jsonl, checkpoints in out/checkpoints.

    `specs` are those of `trainable`. With a `mesh` the batch is split over its `data` axis. `evaluate(params)` of the
    averaged parameters is logged every `evaluate_every` steps. `writer` has TensorBoard's `add_scalar`.
    """
    from ..checkpoint import Checkpoints

    out.mkdir(parents=True, exist_ok=True)
    optimiser = make_optimiser(optim, specs, loop.steps)
    state = initial_state(trainable, optimiser, optim)
    batch_sharding = None
    if mesh is not None:
        everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
        batch_sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("data"))
        state, frozen = jax.device_put(state, everywhere), jax.device_put(frozen, everywhere)
    checkpoints = Checkpoints(out / "checkpoints", keep=loop.keep)
    log_path = out / "log.jsonl"
    if resume and checkpoints.latest() is not None:
        state = checkpoints.restore(state)
        _cut_log(log_path, int(state["step"]))
    elif log_path.exists():
        log_path.unlink()
    step = jax.jit(make_step(objective, optimiser, optim), donate_argnums=0)
    key = jax.random.key(loop.seed)
    first, detector = int(state["step"]), DivergenceDetector(loop.patience)
    started, logged, terms = time.perf_counter(), first, []
    bar = tqdm(total=loop.steps, initial=first, desc=name, dynamic_ncols=True, mininterval=1.0)
    with log_path.open("a") as log, bar:
        for i, batch in enumerate(prefetched(batches, first, loop.steps), first):
            if batch_sharding is not None:
                batch = jax.device_put(batch, batch_sharding)
            state, metrics = step(state, frozen, batch, jax.random.fold_in(key, i))
            metrics = {k: float(v) for k, v in metrics.items()}
            terms.append(metrics)
            bar.update()
            done = i + 1
            if done % loop.log_every == 0 or done == loop.steps:
                rate = (done - logged) / max(time.perf_counter() - started, 1e-9)
                row = _mean_row(terms) | {"step": done, "steps_per_s": rate}
                if evaluate and evaluate_every and (done % evaluate_every == 0 or done == loop.steps):
                    row |= evaluate(state.get("ema", state["params"]))
                log.write(json.dumps(row) + "\n")
                log.flush()
                if writer is not None:
                    for term, value in row.items():
                        writer.add_scalar(f"{name}/{term}", value, done)
                bar.set_postfix(loss=f"{row['loss']:.4g}", refresh=False)
                terms, logged, started = [], done, time.perf_counter()
            reason = _why_stop(metrics, done, loop, detector)
            if reason is None and (done % loop.save_every == 0 or done == loop.steps):
                checkpoints.save(done, state)
            if reason is not None:
                checkpoints.close()
                raise TrainingStopped(
                    f"Stopped at step {done}: {reason}. The last good checkpoint is step "
                    f"{checkpoints.latest()} in {checkpoints.folder}."
                )
    checkpoints.close()
    return state


def _mean_row(terms: list[dict]) -> dict:
    """Means over the finite values of each term; counters keep their last value."""
    row = {}
    for name in terms[-1]:
        values = [t[name] for t in terms if np.isfinite(t[name])]
        row[name] = float(np.mean(values)) if values else None
    return row | {name: int(terms[-1][name]) for name in ("skipped", "streak")}


def _why_stop(metrics: dict, done: int, loop: LoopConfig, detector: DivergenceDetector) -> str | None:
    if metrics["streak"] >= loop.max_streak:
        return f"{int(metrics['streak'])} steps in a row had a loss or gradient that was not finite"
    if done >= 100 and metrics["skipped"] > loop.max_skipped * done:
        return f"{int(metrics['skipped'])} of {done} steps had a loss or gradient that was not finite"
    if detector.update(metrics["loss"]):
        return (
            f"the loss (average {detector.average:.4g}) has been far above its best level "
            f"({detector.best:.4g}) for {loop.patience} steps"
        )
    return None


def _cut_log(path: Path, step: int) -> None:
    """Drop log lines written after the checkpoint that is being resumed."""
    if path.exists():
        lines = [line for line in path.read_text().splitlines() if json.loads(line)["step"] <= step]
        temporary = path.with_suffix(".part")
        temporary.write_text("".join(f"{line}\n" for line in lines))
        temporary.replace(path)
