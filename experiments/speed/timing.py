"""How one call of a row is timed, and on what: the same for ours and for the peer. Imported inside the row's process."""

import subprocess
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from roge_jax.files.entry import environment

CLOCKS = "clocks.sm,clocks.mem,power.draw,temperature.gpu,utilization.gpu"
CLOCKS_SECONDS = 30.0  # at most, for nvidia-smi to answer


def measure(call: Callable[[], Any], repeats: int, seconds: float) -> dict[str, Any]:
    """Seconds per call after two calls to warm up: median and quartiles of `repeats`, fewer if `seconds` are over.

    On a CPU these are CPU seconds: wall time measures the neighbours. On a GPU its clocks at work come along.
    """
    gpu = jax.default_backend() == "gpu"
    clock = time.perf_counter if gpu else time.process_time
    begin, taken = time.perf_counter(), []
    for turn in range(repeats + 2):
        start = clock()
        call()
        if turn >= 2:
            taken.append(clock() - start)
        if taken and time.perf_counter() - begin > seconds:
            break
    low, median, high = np.percentile(taken, [25, 50, 75])
    found = {"seconds": float(median), "quartiles": [float(low), float(high)], "calls": len(taken)}
    return found | ({"busy": busy_clocks(call)} if gpu else {})


def busy_clocks(call: Callable[[], Any]) -> dict[str, str]:
    """What nvidia-smi says while `call` runs again and again (not timed): clocks, power, temperature; {} without it."""
    query = ["nvidia-smi", f"--query-gpu={CLOCKS}", "--format=csv,noheader"]
    try:
        asked = subprocess.Popen(query, stdout=subprocess.PIPE, text=True)
    except OSError:
        return {}
    begin = time.perf_counter()
    call()
    while asked.poll() is None and time.perf_counter() - begin < CLOCKS_SECONDS:
        call()
    if asked.poll() is None:
        asked.kill()
    said = asked.communicate()[0].splitlines()
    return dict(zip(CLOCKS.split(","), said[0].split(", "))) if said else {}


def where_and_when() -> dict[str, Any]:
    """Device, time and JAX of a measurement: a file may hold rows of several commands and machines."""
    found = environment()
    return {
        "device": found["device"]["kind"],
        "time": found["time"],
        "jax": found["versions"]["jax"],
    }
