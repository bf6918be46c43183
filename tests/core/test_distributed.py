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


def joined(index: int, count: int, port: int, devices: int) -> dict[str, str]:
    """The environment of process `index` of `count`."""
    return os.environ | {
        "JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port}",
        "JAX_NUM_PROCESSES": str(count),
        "JAX_PROCESS_ID": str(index),
        "XLA_FLAGS": spelled(FLAGS | {DEVICES: str(devices)}),
        "PYTHONPATH": str(WORKER.parent.parent),
    }


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def start(
    out: Path,
    count: int,
    data: int,
    fsdp: int,
    *options: str,
    lost: int | None = None,
    after: int = 0,
    steps: str = "6",
):
    """`count` processes that share data * fsdp CPU devices; process `lost` vanishes after step `after`."""
    port, processes = free_port(), []
    for index in range(count):
        environment = joined(index, count, port, data * fsdp // count)
        command = [sys.executable, str(WORKER), str(out), str(data), str(fsdp), steps, *options]
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
    found = {row["step"]: row["loss"] for row in rows if "loss" in row}
    assert len(found) == sum("loss" in row for row in rows), "a step is logged twice"
    return found


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
    assert sorted(found) == sorted(expected), "no step is missing"
    # float32 sums over devices in another order: a few units in the last place per step
    np.testing.assert_allclose([found[i] for i in expected], list(expected.values()), rtol=2e-6)


def test_processes_that_differ_say_so_instead_of_computing(tmp_path):
    """And of what they share each gets the whole."""
    out = tmp_path / "differ"
    assert wait(start(out, 2, 2, 1, steps="disagree"), out) == [0, 0], text(out, 2)
    for index in range(2):
        said = (tmp_path / f"differ.{index}.txt").read_text()
        for words in (
            "Process 1 has views float32[4, 2], and process 0 has float32[3, 2]",
            "Process 1 has --out runs/1, and process 0 has runs/0: start every process with the same",
            "--devices 1 is for one process, and 2 are running",
            "--encode-once is for one process, and 2 are running",
            "Process 1 has a start with contents",
            "Process 1 has data with contents",
        ):
            assert words in said, said


@pytest.mark.slow  # each process compiles a step of `tiny`
def test_the_program_in_two_processes(tmp_path):
    """`python -m roge_jax.train` as launchers start it: the losses of one process, and exit code 2 where they differ."""

    def run(out: Path, count: int, *odd: str) -> list[int]:
        port, processes = free_port(), []
        for index in range(count):
            words = ["tiny", "--steps", "2", "--batch", "2", "--log-every", "1", "--out", str(out)]
            words += odd if index == 1 else []
            with (tmp_path / f"{out.name}.{index}.txt").open("w") as log:
                command = [sys.executable, "-m", "roge_jax.train", *words]
                environment = joined(index, count, port, 1)
                processes.append(subprocess.Popen(command, env=environment, stdout=log, stderr=log))
        return wait(processes, out, 900.0)

    assert run(tmp_path / "one", 1) == [0], text(tmp_path / "one", 1)
    assert run(tmp_path / "two", 2) == [0, 0], text(tmp_path / "two", 2)
    one, two = (losses(tmp_path / name / "lora") for name in ("one", "two"))
    assert sorted(one) == [1, 2]
    np.testing.assert_allclose([two[i] for i in one], list(one.values()), rtol=1e-5)
    assert (tmp_path / "two/lora/adapter/README.md").exists()
    assert run(tmp_path / "odd", 2, "--seed", "1") == [2, 2], text(tmp_path / "odd", 2)
    assert "Process 1 has --seed 1, and process 0 has 0" in text(tmp_path / "odd", 2)
    assert not (tmp_path / "odd").exists()


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
            (
                {"MASTER_ADDR": "a:1", "WORLD_SIZE": "2", "RANK": "0", "LOCAL_WORLD_SIZE": "2"},
                "LOCAL_RANK is no number",
            ),
        ],
    )
    def test_mistakes(self, given, named):
        with pytest.raises(UserError, match=named):
            launch_arguments(given)
