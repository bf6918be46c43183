"""Recomputation from rounded inputs: what `jax.checkpoint` does, keeping half as much."""

import contextvars
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def from_rounded(f: Callable[[jax.Array, Any], jax.Array]) -> Callable[[jax.Array, Any], jax.Array]:
    """f(x, rest) -> y, for x and y float32 and `rest` a tree of arrays: all that is differentiated is given, none closed over.

    Values are f's own. The backward pass keeps x in bfloat16 beside `rest` and computes f again from it, so gradients are
    f's one rounding of x away (relative 2^-9). In reverse mode alone; nothing is computed for arrays that do not train.
    """

    def run(x: jax.Array, rest: Any) -> jax.Array:
        leaves, shape = jax.tree.flatten(rest)
        around = contextvars.copy_context()  # what is set here holds when f is traced again, later

        def inside(x, leaves):
            return around.copy().run(f, x, jax.tree.unflatten(shape, leaves))

        return _run(inside, x, leaves)

    return run


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _run(f, x, leaves):
    return f(x, leaves)


def _forward(f, x, leaves):
    y = f(x.value, [leaf.value for leaf in leaves])
    trains = [leaf.value if leaf.perturbed else None for leaf in leaves]
    stays = [None if leaf.perturbed else leaf.value for leaf in leaves]
    return y, (x.value.astype(jnp.bfloat16), trains, stays)


def _backward(f, kept, dy):
    x, trains, stays = kept
    if isinstance(dy, jax.custom_derivatives.SymbolicZero):
        return None, None

    def again(x, trains):
        return f(x, [b if a is None else a for a, b in zip(trains, stays, strict=True)])

    _, pull = jax.vjp(again, x.astype(jnp.float32), trains)
    return pull(dy)


_run.defvjp(_forward, _backward, symbolic_zeros=True)
