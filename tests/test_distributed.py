"""Real processes over localhost: they train together, one is lost, a restart continues as if nothing had happened."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import distributed_worker
import numpy as np
import pytest
from quick_xla import DEVICES, FLAGS, spelled

from roge_jax.core.distributed import launch_arguments
from roge_jax.errors import UserError

WORKER = Path(distributed_worker.__file__)


def start(
    out: Path,
    count: int,
    data: int,
    fsdp: int,
    *options: str,
    lost: int | None = None,
    after: int = 0,
):
    """`count` processes that share data * fsdp CPU devices; process `lost` vanishes after step `after`."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    processes = []
    for index in range(count):
        environment = os.environ | {
            "JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port}",
            "JAX_NUM_PROCESSES": str(count),
            "JAX_PROCESS_ID": str(index),
            "XLA_FLAGS": spelled(FLAGS | {DEVICES: str(data * fsdp // count)}),
            "PYTHONPATH": str(WORKER.parent.parent),
        }
        command = [sys.executable, str(WORKER), str(out), str(data), str(fsdp), "6", *options]
        command += ["--die-after", str(after)] if index == lost else []
        with (out.parent / f"{out.name}.{index}.txt").open("a") as log:
            processes.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
    return processes


def wait(processes, out: Path, seconds: float = 300.0) -> list[int]:
    """Exit codes; once one process has failed the others are ended, as a launcher does."""
    end = time.monotonic() + seconds
    while any(p.poll() is None for p in processes):
        failed = any(p.poll() for p in processes)
        if failed or time.monotonic() > end:
            time.sleep(1.0)
            for p in processes:
                p.kill()
        time.sleep(0.1)
    return [p.wait() for p in processes]


def losses(out: Path) -> dict[int, float]:
    rows = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return {row["step"]: row["loss"] for row in rows if "loss" in row}


def text(out: Path, count: int) -> str:
    return "\n".join((out.parent / f"{out.name}.{i}.txt").read_text()[-2000:] for i in range(count))


@pytest.mark.parametrize(
    ("count", "data", "fsdp"), [(2, 2, 1), pytest.param(4, 2, 2, marks=pytest.mark.slow)]
)
def test_lost_process(tmp_path, count, data, fsdp):
    distributed_worker.train(tmp_path / "alone", data=1, fsdp=1, steps=6)
    expected = losses(tmp_path / "alone")
    assert sorted(expected) == [1, 2, 3, 4, 5, 6]
    assert len({round(x, 6) for x in expected.values()}) == 6

    out = tmp_path / "together"
    codes = wait(start(out, count, data, fsdp, lost=count - 1, after=4), out)
    assert codes[-1] == 9 and codes[0] != 0, text(out, count)
    assert max(losses(out)) == 4, "four steps are logged, the checkpoint is that of step 3"

    codes = wait(start(out, count, data, fsdp, "--resume"), out)
    assert codes == [0] * count, text(out, count)
    found = losses(out)
    assert sorted(found) == sorted(expected), "no step is missing or logged twice"
    # float32 sums over devices in another order: a few units in the last place per step
    np.testing.assert_allclose([found[i] for i in expected], list(expected.values()), rtol=2e-6)


class TestLaunchArguments:
    def test_alone(self):
        assert launch_arguments({}) is None
        assert launch_arguments({"RANK": "0", "WORLD_SIZE": "4"}) is None
        assert launch_arguments({"SLURM_JOB_ID": "1", "SLURM_NTASKS": "4"}) is None, (
            "sbatch without srun"
        )
        assert launch_arguments({"SLURM_STEP_NUM_TASKS": "1"}) is None

    def test_by_hand(self):
        given = {"JAX_COORDINATOR_ADDRESS": "a:1", "JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "1"}
        expected = {"coordinator_address": "a:1", "num_processes": 2, "process_id": 1}
        assert launch_arguments(given) == expected
        assert launch_arguments(given | {"JAX_NUM_PROCESSES": "1", "JAX_PROCESS_ID": "0"}) is None

    def test_torchrun(self):
        given = {"MASTER_ADDR": "a", "MASTER_PORT": "29500", "WORLD_SIZE": "16", "RANK": "9"}
        expected = {"coordinator_address": "a:29500", "num_processes": 16, "process_id": 9}
        assert launch_arguments(given) == expected
        each = given | {"LOCAL_WORLD_SIZE": "8", "LOCAL_RANK": "1"}
        assert launch_arguments(each) == expected | {"local_device_ids": [1]}

    def test_launchers_known_to_jax(self):
        assert launch_arguments({"SLURM_STEP_NUM_TASKS": "8"}) == {}
        assert launch_arguments({"OMPI_COMM_WORLD_SIZE": "2"}) == {}

    @pytest.mark.parametrize(
        ("given", "named"),
        [
            ({"JAX_COORDINATOR_ADDRESS": "a:1", "JAX_NUM_PROCESSES": "2"}, "JAX_PROCESS_ID is not"),
            (
                {"JAX_COORDINATOR_ADDRESS": "a:1", "JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "2"},
                "index below it",
            ),
            ({"MASTER_ADDR": "a", "WORLD_SIZE": "2", "RANK": "0"}, "MASTER_PORT"),
        ],
    )
    def test_mistakes(self, given, named):
        with pytest.raises(UserError, match=named):
            launch_arguments(given)
