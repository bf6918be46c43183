"""The training loop: one jitted step, and everything around it that keeps a long run honest.

Steps whose loss or gradient is not finite change nothing and are counted; too many of them, or a loss that leaves its
best level for good, stop the run with the reason. Batch and randomness of step i are functions of (seed, i), so a
resumed run continues bit for bit; checkpoints are written atomically and the last few are kept.

A skipped step keeps its place in the order of the data but does not count for the learning-rate schedule, which runs
on applied updates. After a resume the divergence detector starts afresh; everything else continues.
"""

import collections
import concurrent.futures
import contextlib
import itertools
import json
import os
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from ..core import sharding
from ..core.distributed import global_batch, is_main
from ..core.params import Tree
from ..errors import UserError
from ..files.folders import put
from .optim import OptimConfig, ema_update, make_optimiser


class TrainingStopped(RuntimeError):
    """The run ended early; the message says why and which checkpoint is the last good one."""


@dataclass(frozen=True)
class LoopConfig:
    """How long a run is, what it writes how often, and when it gives up."""

    steps: int = 100
    seed: int = 0
    log_every: int = 10
    save_every: int = 100
    keep: int = 3
    max_skipped: float = (
        0.01  # stop when more than this share of the steps was skipped (after 100 steps) ...
    )
    max_streak: int = 10  # ... or this many in a row
    loaders: int = 1  # threads that draw batches
    patience: int = 200  # stop when the loss stays beyond best + 6 MAD for this many steps


def initial_state(
    trainable: Tree, optimiser: optax.GradientTransformation, optim: OptimConfig
) -> Tree:
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


def make_step(
    objective: Callable, optimiser: optax.GradientTransformation, optim: OptimConfig
) -> Callable:
    """step(state, frozen, batch, key) -> (state, metrics), to be jitted with the state donated.

    `objective(trainable, frozen, batch, key)` returns (loss, terms). A step with a loss or gradient that is not
    finite leaves parameters, optimiser and averages as they were; only the counters move.
    """

    def step(state, frozen, batch, key):
        (loss, terms), grads = jax.value_and_grad(objective, has_aux=True)(
            state["params"], frozen, batch, key
        )
        norm = optax.tree.norm(grads)
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
        metrics = {
            "loss": loss,
            "grad_norm": norm,
            "skipped": new["skipped"],
            "streak": new["streak"],
        }
        return new, metrics | terms

    return step


class DivergenceDetector:
    """Says when a smoothed loss has left its best level for good: > best + 6 MAD for `patience` steps.

    The mean absolute deviation is that of single losses when the average was at its best, so that a jump does not
    widen its own limit; nothing is judged while the averages fill.
    """

    def __init__(self, patience: int, rate: float = 0.02):
        self.patience, self.rate = patience, rate
        self.seen, self.average, self.spread = 0, 0.0, 0.0
        self.best, self.best_spread, self.beyond = float("inf"), 0.0, 0

    def update(self, loss: float) -> bool:
        """Take in the loss of a step; whether the run has diverged."""
        if not np.isfinite(loss):
            return False  # skipped steps have their own limit
        self.seen += 1
        rate = max(self.rate, 1.0 / self.seen)
        self.average += rate * (loss - self.average)
        self.spread += rate * (abs(loss - self.average) - self.spread)
        filling = self.seen < 2 / self.rate
        if filling or self.average < self.best:
            self.best, self.best_spread = self.average, self.spread
        self.beyond = self.beyond + 1 if self.average > self.best + 6 * self.best_spread else 0
        return self.beyond >= self.patience


def prefetched(
    batches: Callable[[int], dict], first: int, last: int, depth: int = 2, loaders: int = 1
) -> Generator[dict, None, None]:
    """batches(first), .., batches(last - 1) in order, prepared by threads while the device works.

    No more than `depth` and one a thread are ready or in work. An error comes through in its turn.
    """
    waiting: collections.deque[concurrent.futures.Future] = collections.deque()
    pool = concurrent.futures.ThreadPoolExecutor(loaders, thread_name_prefix="loader")
    try:
        following = iter(range(first, last))
        for i in itertools.islice(following, depth + loaders):
            waiting.append(pool.submit(batches, i))
        while waiting:
            found = waiting.popleft().result()
            waiting.extend(pool.submit(batches, i) for i in itertools.islice(following, 1))
            yield found
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def train(
    objective: Callable,
    trainable: Tree,
    frozen: Tree,
    specs: Tree,
    batches: Callable[[int], dict],
    *,
    optim: OptimConfig,
    loop: LoopConfig,
    out: str | Path,
    resume: bool = False,
    mesh: jax.sharding.Mesh | None = None,
    frozen_specs: Tree | None = None,
    batch: int | None = None,
    name: str = "train",
    evaluate: Callable[[Tree], dict] | None = None,
    evaluate_every: int = 0,
    diagnose: Callable[[Tree, Tree, dict, jax.Array], dict] | None = None,
    diagnose_every: int = 0,
    writer=None,
) -> Tree:
    """Run `loop.steps` steps; returns the final state. Logs to out/log.jsonl, checkpoints in out/checkpoints.

    `specs` are those of `trainable`. The caller's arrays stay valid, but for those that lie on a `mesh` already. With a
    `mesh` (see `core.sharding`) state and frozen weights lie where its table says (frozen ones on every device without
    `frozen_specs`). In a run of several processes `batches(i)` returns this process' `core.distributed.local_rows` of
    the `batch` scenes; the main process writes the log.

    `evaluate(params)` of the averaged parameters is logged before the first step and every `evaluate_every` steps, and
    stops the run when it is not finite.
    `diagnose(params, frozen, batch, key)` (see `training.diagnose`) is logged every `diagnose_every` steps. `writer`
    has TensorBoard's `add_scalar`.

    Raises `TrainingStopped` when the run cannot go on, `UserError` when `out` holds another run.
    """
    from ..checkpoint import Checkpoints

    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    optimiser = make_optimiser(optim, specs, loop.steps)
    state, frozen, where = _placed(trainable, frozen, optimiser, optim, specs, frozen_specs, mesh)
    checkpoints = Checkpoints(out / "checkpoints", keep=loop.keep)
    log_path = out / "log.jsonl"
    state = _continued(state, checkpoints, log_path, resume)
    step = jax.jit(make_step(objective, optimiser, optim), donate_argnums=0, out_shardings=where)
    key = jax.random.key(loop.seed)
    first, detector = int(state["step"]), DivergenceDetector(loop.patience)
    started, logged, waited, terms = time.perf_counter(), first, 0.0, []
    bar = tqdm(
        total=loop.steps,
        initial=first,
        desc=name,
        dynamic_ncols=True,
        mininterval=1.0,
        disable=not is_main(),
    )
    source = contextlib.closing(prefetched(batches, first, loop.steps, loaders=loop.loaders))

    log_file = log_path if is_main() else Path(os.devnull)
    with (
        log_file.open("a", encoding="utf-8") as log,
        bar,
        contextlib.closing(checkpoints),
        source as ready,
        sharding.use(mesh),
    ):
        if evaluate and evaluate_every and first == 0:
            before = evaluate(state["ema"] if "ema" in state else state["params"])
            log.write(json.dumps({"step": 0} | _finite(before)) + "\n")
        for i in range(first, loop.steps):
            asked = time.perf_counter()
            views = next(ready)
            waited += time.perf_counter() - asked
            if mesh is not None:
                views = global_batch(views, mesh, batch or len(next(iter(views.values()))))
            state, metrics = step(state, frozen, views, jax.random.fold_in(key, i))
            metrics = {k: float(v) for k, v in metrics.items()}
            terms.append(metrics)
            bar.update()
            done = i + 1
            reason = _why_stop(metrics, done, loop, detector)

            def due(every: int, done: int = done) -> bool:
                return every > 0 and (done % every == 0 or done == loop.steps)

            extra = {}
            if evaluate and due(evaluate_every):
                extra = evaluate(state.get("ema", state["params"]))
                wrong = [k for k, v in extra.items() if not np.isfinite(v)]
                reason = reason or (
                    f"the evaluation gave {wrong[0]} = {extra[wrong[0]]}" if wrong else None
                )
            if diagnose and due(diagnose_every):
                extra = extra | diagnose(state["params"], frozen, views, jax.random.fold_in(key, i))
            # A line ends at every checkpoint, so that the log of a resumed run has the same lines.
            if extra or reason or due(loop.log_every) or due(loop.save_every):
                spent = max(time.perf_counter() - started, 1e-9)
                speed = {"steps_per_s": (done - logged) / spent, "waiting": waited / spent}
                row = _mean_row(terms) | {"step": done} | speed | _finite(extra)
                log.write(json.dumps(row) + "\n")
                log.flush()
                if writer is not None:
                    for term, value in row.items():
                        if value is not None:
                            writer.add_scalar(f"{name}/{term}", value, done)
                if row["loss"] is not None:
                    bar.set_postfix(loss=f"{row['loss']:.4g}", refresh=False)
                terms, logged, waited, started = [], done, 0.0, time.perf_counter()
            if reason is not None:
                last = checkpoints.latest()
                good = (
                    f"step {last} in {checkpoints.folder}"
                    if last
                    else "none: it ended before the first"
                )
                raise TrainingStopped(
                    f"Stopped at step {done}: {reason}. The last good checkpoint is {good}."
                )
            suspect = detector.beyond > 0 and done < loop.steps  # do not push good checkpoints out
            if due(loop.save_every) and not suspect:
                checkpoints.save(done, state)
    return state


def _placed(trainable: Tree, frozen: Tree, optimiser, optim, specs, frozen_specs, mesh):
    """(initial state, frozen weights, shardings of what a step returns or None), all where they stay.

    The step donates its state: without a mesh the state has arrays of its own, and the caller keeps `trainable`.
    """
    if mesh is None:
        trainable = jax.tree.map(lambda x: jax.device_put(x, may_alias=False), trainable)
        state = initial_state(trainable, optimiser, optim)
        # Where a restored state lies: one that lies nowhere would be another program to XLA.
        return jax.device_put(state, jax.local_devices()[0]), frozen, None
    state = initial_state(trainable, optimiser, optim)
    everywhere = sharding.replicated(mesh)
    where = sharding.state_shardings(state, specs, mesh), everywhere
    kept = everywhere if frozen_specs is None else sharding.shardings(frozen_specs, mesh)
    return sharding.place(state, where[0]), sharding.place(frozen, kept), where


def _continued(state: Tree, checkpoints, log: Path, resume: bool) -> Tree:
    """The state to go on from: that of the last checkpoint if there is one and `resume`, with the log cut to its step.

    Raises: UserError if there is one and the run is to begin.
    """
    latest = checkpoints.latest()
    if latest is None:
        if is_main():
            log.unlink(missing_ok=True)
        return state
    if not resume:
        raise UserError(
            f"{log.parent} holds a run at step {latest}: continue it with --resume, or choose another folder."
        )
    checkpoints.verify(latest)
    _check_fits(checkpoints.folder, latest, state)
    state = checkpoints.restore(state, latest)
    if is_main():
        _cut_log(log, int(state["step"]))
    return state


def check_batch(batch: int, mesh: sharding.AnyMesh) -> None:
    """Raise `UserError` if the mesh cannot split a batch of this size."""
    data = mesh.shape["data"]
    if batch % data:
        raise UserError(
            f"A batch of {batch} cannot be split over data={data}: use --batch {max(data, batch // data * data)}, or "
            f"--mesh with a data that divides {batch}."
        )


def held_out_change(log: Path) -> str:
    """What a run's log says of the held-out loss, as the end of a sentence; empty without evaluations."""
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    found = [(row["step"], row["held_loss"]) for row in rows if row.get("held_loss") is not None]
    if len(found) < 2:
        return ""
    (first, before), (last, after) = found[0], found[-1]
    return f"; held-out loss {before:.5g} at step {first}, {after:.5g} at step {last}"


def _check_fits(folder: Path, step: int, state: Tree) -> None:
    """Raise `UserError` unless the checkpoint has the leaves of `state`.

    Before any value is read: a restore that fails halfway leaves threads of Orbax behind that complain later.
    """
    import orbax.checkpoint as ocp

    def shapes(tree) -> dict[str, tuple[int, ...]]:
        leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
        return {
            jax.tree_util.keystr(path, simple=True, separator="/"): tuple(x.shape)
            for path, x in leaves
        }

    want = shapes(state)
    have = shapes(ocp.StandardCheckpointHandler().metadata(folder / str(step) / "default").tree)
    wrong = sorted(path for path in have.keys() | want.keys() if have.get(path) != want.get(path))
    if wrong:
        raise UserError(
            f"The checkpoint of step {step} in {folder} was written by another model or stage: {len(wrong)} of "
            f"{len(want)} leaves differ, such as {wrong[0]} (there {have.get(wrong[0], 'missing')}, here "
            f"{want.get(wrong[0], 'missing')}). Resume with the same preset and stage, or start in an empty folder."
        )


def _finite(values: dict) -> dict:
    """JSON has no NaN: what is not finite becomes null."""
    return {name: float(v) if np.isfinite(v) else None for name, v in values.items()}


def _mean_row(terms: list[dict]) -> dict:
    """Means over the finite values of each term; counters keep their last value."""
    row = {}
    for name in terms[-1]:
        values = [t[name] for t in terms if np.isfinite(t[name])]
        row[name] = float(np.mean(values)) if values else None
    return row | {name: int(terms[-1][name]) for name in ("skipped", "streak")}


def _why_stop(
    metrics: dict, done: int, loop: LoopConfig, detector: DivergenceDetector
) -> str | None:
    if metrics["streak"] >= loop.max_streak:
        return f"{int(metrics['streak'])} steps in a row had a loss or gradient that was not finite"
    if done >= 100 and metrics["skipped"] > loop.max_skipped * done:
        return (
            f"{int(metrics['skipped'])} of {done} steps had a loss or gradient that was not finite"
        )
    if detector.update(metrics["loss"]):
        return (
            f"the loss (average {detector.average:.4g}) has been far above its best level "
            f"({detector.best:.4g}) for {loop.patience} steps"
        )
    return None


def _cut_log(path: Path, step: int) -> None:
    """Drop log lines written after the checkpoint that is being resumed, and a line cut off while being written."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            if json.loads(line)["step"] <= step:
                kept.append(line)
    temporary = path.with_suffix(".part")
    temporary.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
    put(temporary, path)
