"""Scaled dot-product attention: the fused kernel on GPU, a form that is fast on CPU elsewhere."""

import contextlib
import contextvars
import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

SCORES_BYTES = 1e9  # of scores that are stored at a time, where they are stored at all
_LIMIT: contextvars.ContextVar[float] = contextvars.ContextVar("scores", default=SCORES_BYTES)


def attention(q: jax.Array, k: jax.Array, v: jax.Array, *, dtype=jnp.float32) -> jax.Array:
    """softmax(q k^T / sqrt(e)) v for q [.., l, k, e] and k, v [.., s, k, e]; no mask. Returns float32.

    `dtype` is that of the matrix products' inputs; with bfloat16 on a GPU the cuDNN flash kernel runs, which needs
    no memory for the l x s scores. Elsewhere queries are taken in pieces if the scores are above `SCORES_BYTES`:
    memory grows with l + s, at the price of computing the scores once more for the gradient. On CPU the scale goes
    into q, the row maximum is not differentiated (its gradient is zero) and the division comes after the product
    with v: fewer passes over the scores.
    """
    scale = q.shape[-1] ** -0.5
    if jax.default_backend() == "gpu" and dtype == jnp.bfloat16:
        lead = q.shape[:-3]
        q, k, v = (x.astype(dtype).reshape(-1, *x.shape[-3:]) for x in (q, k, v))
        y = _fused(q, k, v, scale)
        return y.reshape(*lead, *y.shape[1:]).astype(jnp.float32)
    q = jnp.swapaxes(q * scale, -3, -2).astype(dtype)
    k, v = (jnp.swapaxes(x, -3, -2).astype(dtype) for x in (k, v))

    def some(q: jax.Array) -> jax.Array:
        with jax.named_scope("scores"):
            s = jnp.einsum("...qe,...se->...qs", q, k, preferred_element_type=jnp.float32)
            s = jnp.exp(s - jax.lax.stop_gradient(s.max(-1, keepdims=True)))
            y = jnp.einsum(
                "...qs,...se->...qe", s.astype(dtype), v, preferred_element_type=jnp.float32
            )
            return y / s.sum(-1, keepdims=True)

    *outer, length, width = q.shape
    pieces = max(1, math.ceil(4.0 * math.prod(q.shape[:-1]) * k.shape[-2] / _LIMIT.get()))
    if pieces == 1:
        y = some(q)
    else:
        size = -(-length // pieces)
        q = jnp.pad(q, [(0, 0)] * len(outer) + [(0, size * pieces - length), (0, 0)])
        q = jnp.moveaxis(q.reshape(*outer, pieces, size, width), -3, 0)
        y = jnp.moveaxis(jax.lax.map(jax.checkpoint(some), q), 0, -3)
        y = y.reshape(*outer, pieces * size, v.shape[-1])[..., :length, :]
    return checkpoint_name(jnp.swapaxes(y, -3, -2), "attention")


def _fused(q: jax.Array, k: jax.Array, v: jax.Array, scale: float) -> jax.Array:
    """The cuDNN kernel on q [b, l, k, e] and k, v [b, s, k, e].

    JAX refuses odd lengths as soon as a gradient is asked for: such a length is padded by one that the kernel is told
    to leave out.
    """
    lengths, batch = (q.shape[1], k.shape[1]), q.shape[:1]
    # Always x, with the batch axes that `jax.vmap` gave q alone: JAX 0.10 knows no other batches.
    k, v = (jnp.where(True, x, q[:, :1]) for x in (k, v))
    told: dict[str, Any] = {}
    if any(n % 2 for n in lengths):
        q, k, v = (jnp.pad(x, ((0, 0), (0, x.shape[1] % 2), (0, 0), (0, 0))) for x in (q, k, v))
        own = q[:, 0, 0, 0].astype(jnp.int32)
        queries, keys = (jnp.where(True, jnp.full(batch, n, jnp.int32), own) for n in lengths)
        told = {"query_seq_lengths": queries, "key_value_seq_lengths": keys}
    y = jax.nn.dot_product_attention(q, k, v, scale=scale, implementation="cudnn", **told)
    return y[:, : lengths[0]]


@contextlib.contextmanager
def scores_limit(limit: float) -> Iterator[None]:
    """Another limit of the bytes of scores at a time, for what is traced inside."""
    token = _LIMIT.set(limit)
    try:
        yield
    finally:
        _LIMIT.reset(token)


def is_attention(primitive, *_, **params) -> bool:
    """A policy of `jax.checkpoint` that keeps what attention returns (of the fused kernel also its row sums)."""
    if primitive.name == "name":
        return params["name"] == "attention"
    return "dot_product_attention_fwd" in primitive.name


def split_heads(x: jax.Array, heads: int) -> jax.Array:
    """[.., l, d] -> [.., l, heads, d / heads]."""
    return x.reshape(*x.shape[:-1], heads, x.shape[-1] // heads)


def merge_heads(x: jax.Array) -> jax.Array:
    """[.., l, heads, e] -> [.., l, heads * e]."""
    return x.reshape(*x.shape[:-2], -1)
