"""Stepping through the model with a debugger: nothing is compiled, loops run as Python, arrays have values.

    with rj.step_through():
        rj.model.loss(trainable, frozen, batch, key, config=config)      # breakpoint() anywhere in it

It is JAX's own switch, `jax.disable_jit`: `lax.scan`, `lax.map` and `lax.cond` become Python. What JAX traces all the same
gives way here: `checkpoint`, and programs that are compiled ahead of a run. Under `jax.grad` and `jax.vmap` arrays are
still tracers, which hold their value. Choose a small size: every operation runs by itself.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import jax


def step_through() -> AbstractContextManager:
    """Within it nothing is compiled and loops are unrolled. Programs do so with ROGE_DEBUG=1."""
    return jax.disable_jit()


def stepping() -> bool:
    """Whether that is asked for, here or by JAX_DISABLE_JIT."""
    return bool(jax.config.jax_disable_jit)  # type: ignore[attr-defined]


def checkpoint(f: Callable, **options: Any) -> Callable:
    """`jax.checkpoint`; while stepping the function itself, which `jax.checkpoint` would trace."""
    return f if stepping() else jax.checkpoint(f, **options)
