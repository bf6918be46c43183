"""What a sampler reports about its run, and the error it becomes."""

from dataclasses import replace

import jax.numpy as jnp
from flax import struct
from jax import Array

FINE, BAD_VELOCITY, BAD_STATE, OUT_OF_BUDGET = range(4)


class SamplingError(RuntimeError):
    """The sampler stopped early; the message says at which step, noise level and tensor."""


@struct.dataclass
class SolveInfo:
    """What happened on the way; all scalars but `states`."""

    evaluations: Array  # velocity evaluations made, int32
    rejected: Array  # evaluations thrown away by step control, int32 (0 on a fixed grid)
    cause: Array  # FINE, BAD_VELOCITY, BAD_STATE or OUT_OF_BUDGET, int32
    step: Array  # step of the failure, int32, -1 if fine
    sigma: Array  # noise level of the failure
    bad: Array  # non-finite numbers found there, int32
    size: Array  # numbers in the state, int32
    states: Array | None = None  # [n + 1, ...] the state at each grid point, if asked for

    @property
    def failed(self) -> Array:
        """Whether the run stopped early, bool []."""
        return self.cause != FINE


def raise_if_failed(info: SolveInfo) -> None:
    """Raise SamplingError naming step, sigma and tensor. Call it outside jit."""
    cause = int(info.cause)
    if cause == FINE:
        return
    where = f"step {int(info.step)}, sigma {float(info.sigma):.6g}"
    if cause == OUT_OF_BUDGET:
        raise SamplingError(
            f"The adaptive solver used all its {int(info.evaluations)} evaluations and stands at {where} "
            f"({int(info.rejected)} rejected). Allow more, loosen the tolerance, or name the noise "
            "levels where the field jumps in `breaks`."
        )
    tensor = "velocity (the network's output)" if cause == BAD_VELOCITY else "state"
    raise SamplingError(
        f"The {tensor} is not finite at {where}: {int(info.bad)} of {int(info.size)} numbers. Sampling "
        f"stopped after {int(info.evaluations)} evaluations."
    )


def fresh_info(size: int, dtype) -> SolveInfo:
    """A run that has not begun, of a state with `size` numbers of `dtype`."""
    zero = jnp.int32(0)
    sigma = jnp.zeros((), jnp.promote_types(dtype, jnp.float32))
    return SolveInfo(zero, zero, jnp.int32(FINE), jnp.int32(-1), sigma, zero, jnp.int32(size))


def note(info: SolveInfo, x: Array, cause: int, step, sigma: Array) -> SolveInfo:
    """Record the first failure: `x` holds numbers that are not finite."""
    bad = jnp.sum(~jnp.isfinite(x), dtype=jnp.int32)
    new = (bad > 0) & (info.cause == FINE)
    pick = lambda now, old: jnp.where(new, jnp.asarray(now, old.dtype), old)  # noqa: E731
    return replace(
        info,
        cause=pick(cause, info.cause),
        step=pick(step, info.step),
        sigma=pick(sigma, info.sigma),
        bad=pick(bad, info.bad),
    )
