"""How much memory there is, and the sentence for what cannot fit."""

from collections.abc import Sequence
from pathlib import Path

import jax

from ..errors import UserError

HOST = "of memory, of which there are"  # what `refuse` says of the host and ...
DEVICE = "on each device, which has"  # ... of a device with memory of its own


def memory_available() -> float | None:
    """Bytes that programs can still get on this machine; None where /proc does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        return next(1024.0 * int(x.split()[1]) for x in lines if x.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None


def own_memory(devices: Sequence[jax.Device]) -> float | None:
    """The smallest memory of the devices in bytes; None where they do not tell, as those of a CPU."""
    stats = [device.memory_stats() or {} for device in devices]
    limits = [float(found["bytes_limit"]) for found in stats if "bytes_limit" in found]
    return min(limits, default=None)


def refuse(name: str, least: float, where: str, most: float | None, what: str, cure: str) -> None:
    """Raise UserError if `least` bytes, for `what` alone, are more than the `most` that there are `where`."""
    if most is not None and least > most:
        raise UserError(
            f"{name} needs {least / 1e9:,.3g} GB {where} {most / 1e9:,.3g} GB, for {what} alone: {cure}."
        )
