"""Several processes, one program: joining them, and which scenes of a batch each one has to load.

Every process runs the same program on the same arguments. Weights and noise come from seeds, so they agree; only the
scenes of a batch differ: a process loads those that its own devices work on (`local_rows`). What must agree and could
differ is compared (`check_same`): arguments and data at the start, the shapes of every batch.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from ..errors import UserError
from .sharding import batch_sharding

# Address of process 0, number of processes, own number: as set by hand, or by torchrun and its relatives.
_BY_HAND = (
    ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"),
    ("MASTER_ADDR", "WORLD_SIZE", "RANK"),
)
# Launchers that JAX itself understands, by the variable that counts the processes.
_LAUNCHERS = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")


def launch_arguments(environment: Mapping[str, str]) -> dict[str, Any] | None:
    """Arguments of `jax.distributed.initialize` for this environment; None: a single process.

    Read in this order: JAX_COORDINATOR_ADDRESS (host:port), JAX_NUM_PROCESSES, JAX_PROCESS_ID; torchrun's
    MASTER_ADDR, MASTER_PORT, WORLD_SIZE, RANK; a SLURM step or an Open MPI job of more than one task (no arguments
    needed). Raises UserError if a set is incomplete or not made of numbers.
    """
    for names in _BY_HAND:
        # RANK and WORLD_SIZE alone say nothing: other tools set them too.
        if names[0] not in environment:
            continue
        missing = [name for name in names if name not in environment]
        if missing:
            raise UserError(
                f"{names[0]} is set but {' and '.join(missing)} is not: set all of {', '.join(names)}, or none."
            )
        address, count, index = (environment[name] for name in names)
        if not (count.isdecimal() and index.isdecimal() and int(index) < int(count)):
            raise UserError(
                f"{names[1]}={count} and {names[2]}={index}: need a count, and an index below it."
            )
        if int(count) == 1:
            return None
        if ":" not in address:
            port = environment.get("MASTER_PORT", "")
            if not port.isdecimal():
                raise UserError(
                    f"{names[0]}={address} has no port: write host:port, or set MASTER_PORT."
                )
            address = f"{address}:{port}"
        found = {
            "coordinator_address": address,
            "num_processes": int(count),
            "process_id": int(index),
        }
        if names[0] == "MASTER_ADDR" and environment.get("LOCAL_WORLD_SIZE", "1") != "1":
            local = environment.get("LOCAL_RANK", "")
            if not local.isdecimal():
                raise UserError("LOCAL_WORLD_SIZE is set but LOCAL_RANK is no number: set both.")
            found["local_device_ids"] = [int(local)]  # one process per device
        return found
    if any(int(environment.get(name, 1)) > 1 for name in _LAUNCHERS):
        return {}
    return None


def request_devices(count: int) -> None:
    """Have a CPU show `count` devices, before JAX looks for any; other platforms ignore the flag."""
    if count > 1 and not launch_arguments(os.environ):
        flag = f"--xla_force_host_platform_device_count={count}"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}".strip()


def maybe_initialise_distributed() -> int:
    """Join the other processes of this run, if the environment says that there are any; the number of processes.

    Call it before anything asks JAX for devices. A second call does nothing.
    """
    arguments = launch_arguments(os.environ)
    if arguments is None:
        return 1
    if not jax.distributed.is_initialized():
        jax.distributed.initialize(**arguments)
    return jax.process_count()


def is_main() -> bool:
    """Whether this process writes logs and models."""
    return jax.process_index() == 0


def check_same(values: Mapping[str, Any], cure: str) -> None:
    """Raise the same UserError in every process unless all of them hold equal values (compared as text).

    All processes must call it. `cure` ends the sentence, which names the first value that differs.
    """
    if jax.process_count() == 1:
        return
    from jax.experimental.multihost_utils import process_allgather

    text = json.dumps({name: str(value) for name, value in values.items()}).encode()
    digest = np.frombuffer(hashlib.sha256(text).digest(), np.uint8)
    digests = np.asarray(process_allgather(digest))  # [processes, 32]
    other = next((i for i, found in enumerate(digests) if (found != digests[0]).any()), None)
    if other is None:
        return
    longest = np.asarray(process_allgather(np.int32(len(text)))).max()
    texts = np.asarray(process_allgather(np.frombuffer(text.ljust(longest), np.uint8)))
    first, there = (json.loads(texts[i].tobytes()) for i in (0, other))
    name = next(n for n in [*first, *there] if first.get(n) != there.get(n))
    raise UserError(
        f"Process {other} has {name} {there.get(name)}, and process 0 has {first.get(name)}: {cure}."
    )


def meet(where: str) -> None:
    """Return once every process has come to the same place, which has a name."""
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import sync_global_devices

        sync_global_devices(where)


def local_rows(mesh: Mesh | None, batch: int) -> np.ndarray:
    """Sorted indices of the scenes of a batch that this process' devices work on. Processes may share scenes."""
    if mesh is None:
        return np.arange(batch)
    indices = batch_sharding(mesh, batch).addressable_devices_indices_map((batch,))
    rows = [np.arange(batch)[index[0]] for index in indices.values() if index is not None]
    return np.unique(np.concatenate(rows))


def global_batch(local: Mapping[str, np.ndarray], mesh: Mesh, batch: int) -> dict[str, jax.Array]:
    """Arrays [batch, ...] over the mesh from this process' rows [len(local_rows), ...].

    Raises: UserError in every process if they bring scenes of different shapes, which XLA would not notice.
    """
    shapes = {name: f"{np.asarray(x).dtype}{list(np.shape(x)[1:])}" for name, x in local.items()}
    check_same(shapes, "scenes of a batch must have the same number of photos and size everywhere")
    rows, sharding = local_rows(mesh, batch), batch_sharding(mesh, batch)

    def leaf(name: str, x) -> jax.Array:
        x = np.asarray(x)
        assert len(x) == len(rows), (
            f"{name}: {len(x)} rows of this process, expected {len(rows)} of {batch}"
        )

        def share(index):
            own = np.searchsorted(rows, np.arange(batch)[index[0]])
            return x[own][(slice(None), *index[1:])]

        return jax.make_array_from_callback((batch, *x.shape[1:]), sharding, share)

    return {name: leaf(name, x) for name, x in local.items()}
