"""Matrix products: in which dtype their inputs are read, and what their gradients multiply.

A product reads its inputs in the dtype of its kernel, unless `use` asks for another. Asked for in bfloat16 its gradient is
two products of bfloat16 as well: what comes from above is rounded to it, and sums are float32 throughout. Left to JAX
the gradient keeps float32 from above, and every weight is widened for it. Reverse mode alone knows these gradients:
what needs `jax.jvp` stays outside `use`.
"""

import contextlib
import contextvars
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from . import target

DTYPES = ("float32", "bfloat16")
BF16 = jnp.bfloat16
UNITS = ("amx_bf16", "avx512_bf16")  # as Linux names what a CPU multiplies bfloat16 with
_ASKED: contextvars.ContextVar[str | None] = contextvars.ContextVar("products", default=None)


@contextlib.contextmanager
def use(dtype: str | None) -> Iterator[None]:
    """Products traced inside read `dtype`, one of DTYPES; None: the dtype of their kernels, with JAX's own gradients.

    Also a decorator, of what keeps to its kernels whatever is asked around it. JAX keeps one trace per jitted function
    and does not see this setting.
    """
    token = _ASKED.set(dtype)
    try:
        yield
    finally:
        _ASKED.reset(token)


def dtype_of(kernel: jax.Array) -> Any:
    """What a product with `kernel` reads, and attention between such products."""
    return jnp.dtype(_ASKED.get() or kernel.dtype)


def rounded(dtype: Any) -> bool:
    """Whether products of `dtype` are to have gradients of the same dtype."""
    return _ASKED.get() == "bfloat16" and jnp.dtype(dtype) == BF16


@functools.lru_cache(maxsize=1)
def cpu_units() -> bool:
    """Whether this machine's CPU multiplies bfloat16; without, XLA widens what it is given, which costs more than float32."""
    try:
        words = Path("/proc/cpuinfo").read_text(encoding="utf-8").split()
    except OSError:
        return False
    return any(unit in words for unit in UNITS)


def product(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """x [m, k] @ kernel [k, n], accumulated in float32 and returned so."""
    dtype = dtype_of(kernel)
    if rounded(dtype):
        return _rounded((x.dtype, kernel.dtype), x, kernel)
    return _dot(x.astype(dtype), kernel.astype(dtype), (1, 0))


def transposed(x: jax.Array, y: jax.Array) -> jax.Array:
    """x^T y of x [.., m, k] and y [.., m, n] in bfloat16, as the device does it in bfloat16.

    XLA's CPU compiler does so only where the left side is not a transpose, into which it also turns what is merely
    computed as one: rows of zeros below keep it from that. The narrower side is transposed.
    """
    if target.platform() != "cpu":
        return _dot(x, y, (0, 0))
    if y.shape[-1] < x.shape[-1]:
        return jnp.swapaxes(transposed(y, x), -1, -2)
    turned = jnp.swapaxes(x, -1, -2)
    below = jnp.zeros((*turned.shape[:-2], 16, turned.shape[-1]), x.dtype)
    return _dot(jnp.concatenate([turned, below], -2), y, (1, 0))[..., : x.shape[-1], :]


def _dot(a: jax.Array, b: jax.Array, contract: tuple[int, int]) -> jax.Array:
    """The product of matrices, of which all axes before the last two are a batch."""
    batch = tuple(range(a.ndim - 2))
    over, along = (len(batch) + axis for axis in contract)
    dims = (((over,), (along,)), (batch, batch))
    return jax.lax.dot_general(a, b, dims, preferred_element_type=jnp.float32)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _rounded(dtypes: tuple[Any, Any], x: jax.Array, kernel: jax.Array) -> jax.Array:
    """`product` in bfloat16; `dtypes`: of x and the kernel, and so of their gradients."""
    return _dot(x.astype(BF16), kernel.astype(BF16), (1, 0))


def _rounded_forward(dtypes, x, kernel):
    a, b = x.value.astype(BF16), kernel.value.astype(BF16)
    return _dot(a, b, (1, 0)), (a if kernel.perturbed else None, b if x.perturbed else None)


def _rounded_backward(dtypes, kept, dy):
    a, b = kept  # None: the other's gradient is not asked for
    if isinstance(dy, jax.custom_derivatives.SymbolicZero):
        return None, None
    dy = dy.astype(BF16)
    dx = None if b is None else _dot(dy, b, (1, 1)).astype(dtypes[0])
    return dx, None if a is None else transposed(a, dy).astype(dtypes[1])


_rounded.defvjp(_rounded_forward, _rounded_backward, symbolic_zeros=True)
