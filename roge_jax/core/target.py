"""The device that a program is traced for: the machine's own, or one that need not be there.

Attention, convolutions, loops over scenes, dtypes and plans differ by device. All of them ask here, at trace time, and
nothing asks JAX: a program is planned (`use`) or compiled (`core.aot`) for a device that is not there by the same
decisions by which it would run on it.
"""

import contextlib
import contextvars
from collections.abc import Iterator
from typing import NamedTuple

from ..errors import UserError, did_you_mean


class Target(NamedTuple):
    """A kind of device."""

    platform: str  # cpu, gpu or tpu, as JAX names them
    title: str
    memory: float | None  # bytes of its own; None: the host's, or not known


TARGETS: dict[str, Target] = {
    "cpu": Target("cpu", "a CPU", None),
    "h100": Target("gpu", "NVIDIA H100 80GB HBM3", 84942979072.0),
    "h200": Target("gpu", "NVIDIA H200 141GB HBM3e", 151397597184.0),
    "a100": Target("gpu", "NVIDIA A100-SXM4-80GB", 85100068864.0),
    "rtx4090": Target("gpu", "NVIDIA GeForce RTX 4090", 25250627584.0),
    "v5p": Target("tpu", "Google TPU v5p", 95e9),
}


class _Chosen(NamedTuple):
    name: str
    compiled: bool


_CHOSEN: contextvars.ContextVar[_Chosen | None] = contextvars.ContextVar("target", default=None)


def machine() -> str:
    """The platform of this machine: cpu, gpu or tpu."""
    import jax

    return jax.default_backend()


def name() -> str:
    """The name that `use` was given; without one this machine's platform."""
    chosen = _CHOSEN.get()
    return machine() if chosen is None else chosen.name


def current() -> Target:
    """The device of `name`."""
    own = Target(machine(), "this machine's own", None)
    return own if _CHOSEN.get() is None else TARGETS[name()]


def platform() -> str:
    """cpu, gpu or tpu: what a program is traced for."""
    return current().platform


def fused(dtype) -> bool:
    """Whether attention whose products read `dtype` is the fused kernel, which stores no scores: cuDNN's, on GPUs."""
    import jax.numpy as jnp

    return jnp.dtype(dtype) == jnp.bfloat16 and platform() == "gpu"


def only_planned() -> bool:
    """Whether what is traced is neither run nor compiled: it is for another kind of device than this machine has."""
    chosen = _CHOSEN.get()
    return chosen is not None and not chosen.compiled and platform() != machine()


@contextlib.contextmanager
def use(target: str | None, *, compiled: bool = False) -> Iterator[None]:
    """What is traced inside is for `target`, one of TARGETS; None: for what is set around it, else this machine.

    `compiled`: it goes to the target's compiler; otherwise kernels that JAX only knows beside a device are stood in for
    by operations of the same shapes. JAX keeps one trace per jitted function and argument shapes and does not see this
    setting: jit a function anew for another target.
    """
    if target is None:
        yield
        return
    token = _CHOSEN.set(_Chosen(check(target), compiled))
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def check(target: str) -> str:
    """`target`, if there is one of that name. Raises UserError otherwise."""
    if target not in TARGETS:
        raise UserError(f"--target: unknown device '{target}': {did_you_mean(target, TARGETS)}")
    return target
