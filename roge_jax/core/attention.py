"""Scaled dot-product attention: the fused kernel on GPU, a form that is fast on CPU elsewhere."""

import contextlib
import contextvars
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from . import products, target
from .sharding import constrain, current

SCORES_BYTES = 1e9  # of scores that are stored at a time, where they are stored at all
CACHE_BYTES = 2.0**23  # ... on a lone CPU
PIECES = "attention_pieces"  # name for `jax.checkpoint` of what the gradient of attention in pieces keeps
_LIMIT: contextvars.ContextVar[float | None] = contextvars.ContextVar("scores", default=None)


def attention(
    q: jax.Array, k: jax.Array, v: jax.Array, *, dtype=jnp.float32, over: str | None = None
) -> jax.Array:
    """softmax(q k^T / sqrt(e)) v for q [.., l, k, e] and k, v [.., s, k, e]; no mask. Returns float32.

    `dtype` is that of the matrix products' inputs (`core.products`); with bfloat16 on a GPU the cuDNN flash kernel runs, which needs
    no memory for the l x s scores. Elsewhere scores above a limit are not stored: queries are taken in pieces, and
    the gradient computes their scores once more. The limit is `SCORES_BYTES`; on a lone CPU it is `CACHE_BYTES` where
    a head has much of that, and every head of every sequence comes by itself: fresh memory for the scores of all
    takes longer there than the products. Heads with few scores share the work of several cores better together.

    `over`: the logical axis that the caller splits over the mesh beside scenes, "attention_heads" or "views" (the first
    of q's leading axes). The fused kernel runs on no device unless q, k and v are split alike.
    """
    scale = q.shape[-1] ** -0.5
    if target.fused(dtype):
        lead = q.shape[:-3]
        q, k, v = (x.astype(dtype).reshape(-1, *x.shape[-3:]) for x in (q, k, v))
        y = _fused(q, k, v, scale, over)
        return y.reshape(*lead, *y.shape[1:]).astype(jnp.float32)
    rounded = products.rounded(dtype)
    one = _rounded if rounded else _recomputed
    q, k, v = (x.astype(jnp.float32 if rounded else dtype) for x in (q * scale, k, v))
    q, k, v = (_heads_first(x, apart=rounded) for x in (q, k, v))
    lone_cpu = target.platform() == "cpu" and current() is None
    large = lone_cpu and 4.0 * q.shape[-2] * k.shape[-2] > CACHE_BYTES / 8
    limit = _LIMIT.get() or (CACHE_BYTES if large else SCORES_BYTES)
    if _scores_bytes(q, k) <= limit:
        y = _rounded(q, k, v) if rounded else _weighted_sum(q, k, v)[0]
    elif lone_cpu:
        # An axis of one stays: products with a batch axis are those that a policy of `jax.checkpoint` can tell apart.
        heads = tuple(x.reshape(-1, 1, *x.shape[-2:]) for x in (q, k, v))
        y = jax.lax.map(lambda head: _in_pieces(one, head[0], head[1], head[2], limit), heads)
        y = y.reshape(*q.shape[:-1], v.shape[-1])
    else:
        y = _in_pieces(one, q, k, v, limit)
    return checkpoint_name(_heads_last(y, apart=rounded), "attention")


def _heads_first(x: jax.Array, *, apart: bool) -> jax.Array:
    """[.., l, k, e] -> [.., k, l, e]; `apart`: on a CPU head by head. XLA folds a transpose into the product that reads
    it, and takes bfloat16 on a CPU in products without one only (`products.transposed`)."""
    if not apart or target.platform() != "cpu":
        return jnp.swapaxes(x, -3, -2)
    return jnp.stack([x[..., head, :] for head in range(x.shape[-2])], -3)


def _heads_last(x: jax.Array, *, apart: bool) -> jax.Array:
    """The inverse of `_heads_first`, whose gradient goes its way."""
    if not apart or target.platform() != "cpu":
        return jnp.swapaxes(x, -3, -2)
    return jnp.stack([x[..., head, :, :] for head in range(x.shape[-3])], -2)


def _fused(q: jax.Array, k: jax.Array, v: jax.Array, scale: float, over: str | None) -> jax.Array:
    """The cuDNN kernel on q [b, l, k, e] and k, v [b, s, k, e].

    JAX refuses odd lengths as soon as a gradient is asked for: such a length is padded by one that the kernel is told
    to leave out.
    """
    lengths, batch = (q.shape[1], k.shape[1]), q.shape[:1]
    # Always x, with the batch axes that `jax.vmap` gave q alone: JAX 0.10 knows no other batches, and XLA gives them no
    # place on the mesh.
    k, v = (jnp.where(True, x, q[:, :1]) for x in (k, v))
    views = "views" if over == "views" and len(q) > 1 else None
    place = (views, None, over if over == "attention_heads" else None, None)
    q, k, v = (constrain(x, place) for x in (q, k, v))
    told: dict[str, Any] = {}
    if any(n % 2 for n in lengths):
        q, k, v = (jnp.pad(x, ((0, 0), (0, x.shape[1] % 2), (0, 0), (0, 0))) for x in (q, k, v))
        own = q[:, 0, 0, 0].astype(jnp.int32)
        both = (jnp.where(True, jnp.full(batch, n, jnp.int32), own) for n in lengths)
        queries, keys = (constrain(x, (views,)) for x in both)
        told = {"query_seq_lengths": queries, "key_value_seq_lengths": keys}
    if target.only_planned():
        y = _kernel(q, k, v)
    else:
        y = jax.nn.dot_product_attention(q, k, v, scale=scale, implementation="cudnn", **told)
    return y[:, : lengths[0]]


@jax.custom_vjp
def _kernel(q: jax.Array, k: jax.Array, v: jax.Array) -> jax.Array:
    """The shapes of the cuDNN kernel, for a trace that is never run: one operation, and one for its gradient, which
    keeps q, k, v, the result and the logarithm of the softmax's sums.
    """
    return _kernel_forward(q, k, v)[0]


def _kernel_forward(q, k, v):
    sums = jax.ShapeDtypeStruct((q.shape[0], q.shape[2], q.shape[1]), jnp.float32)
    made = (jax.ShapeDtypeStruct(q.shape, q.dtype), sums)
    call = jax.ffi.ffi_call("dot_product_attention_fwd", made, vmap_method="broadcast_all")
    y, total = call(q, k, v)
    return y, (q, k, v, y, total)


def _kernel_backward(kept, dy):
    made = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in kept[:3])
    call = jax.ffi.ffi_call("dot_product_attention_bwd", made, vmap_method="broadcast_all")
    return tuple(call(*kept, dy))


_kernel.defvjp(_kernel_forward, _kernel_backward)


def _scores_bytes(q: jax.Array, k: jax.Array) -> float:
    return 4.0 * math.prod(q.shape[:-1]) * k.shape[-2]


def _in_pieces(one: Callable, q: jax.Array, k: jax.Array, v: jax.Array, limit: float) -> jax.Array:
    """`one` of q [.., l, e], as many queries at a time as `limit` bytes of scores allow."""
    *outer, length, width = q.shape
    pieces = math.ceil(_scores_bytes(q, k) / limit)
    if pieces == 1:
        return one(q, k, v)
    size = -(-length // pieces)
    q = jnp.pad(q, [(0, 0)] * len(outer) + [(0, size * pieces - length), (0, 0)])
    q = jnp.moveaxis(q.reshape(*outer, pieces, size, width), -3, 0)
    y = jnp.moveaxis(jax.lax.map(lambda q: one(q, k, v), q), 0, -3)
    return y.reshape(*outer, pieces * size, v.shape[-1])[..., :length, :]


@jax.named_scope("scores")
def _weighted_sum(q: jax.Array, k: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    """softmax(q k^T) v and the logarithm of the softmax's sums, [.., l, e] and [.., l, 1] float32.

    The row maximum is not differentiated (its gradient is zero) and the division comes after the product with v:
    fewer passes over the scores.
    """
    s = _product("...qe,...se->...qs", q, k)
    top = jax.lax.stop_gradient(s.max(-1, keepdims=True))
    s = jnp.exp(s - top)
    total = s.sum(-1, keepdims=True)
    return _product("...qs,...se->...qe", s, v) / total, top + jnp.log(total)


@jax.custom_jvp
def _recomputed(q: jax.Array, k: jax.Array, v: jax.Array) -> jax.Array:
    """softmax(q k^T) v whose gradient keeps the result and the softmax's sums, and computes the scores again."""
    return _weighted_sum(q, k, v)[0]


@_recomputed.defjvp
def _recomputed_jvp(primals, tangents):
    y, log_total = (checkpoint_name(x, PIECES) for x in _weighted_sum(*primals))
    return y, _tangent(*primals, y, log_total, *tangents)


@functools.partial(jax.checkpoint, prevent_cse=False)
@jax.named_scope("scores")
def _tangent(q, k, v, y, log_total, dq, dk, dv):
    p = jnp.exp(_product("...qe,...se->...qs", q, k) - log_total)
    ds = _product("...qe,...se->...qs", dq, k) + _product("...qe,...se->...qs", q, dk)
    dp = p * ds
    dy = _product("...qs,...se->...qe", p, dv) + _product("...qs,...se->...qe", dp, v)
    return dy - dp.sum(-1, keepdims=True) * y


@jax.custom_vjp
def _rounded(q: jax.Array, k: jax.Array, v: jax.Array) -> jax.Array:
    """softmax(q k^T) v with products of bfloat16, those of the gradient too; it keeps what `_recomputed` keeps."""
    return _rounded_forward(q, k, v)[0]


def _rounded_forward(q, k, v):
    q, k, v = (x.astype(jnp.bfloat16) for x in (q, k, v))
    y, log_total = (checkpoint_name(x, PIECES) for x in _weighted_sum(q, k, v))
    return y, (q, k, v, y, log_total)


@jax.named_scope("scores")
def _rounded_backward(kept, dy):
    q, k, v, y, log_total = kept
    along = (dy * y).sum(-1, keepdims=True)
    dy = dy.astype(jnp.bfloat16)
    p = jnp.exp(_product("...qe,...se->...qs", q, k) - log_total)
    ds = p * (_product("...qe,...se->...qs", dy, v) - along)
    p, ds = p.astype(jnp.bfloat16), ds.astype(jnp.bfloat16)
    dq = _product("...qs,...se->...qe", ds, k)
    return dq, products.transposed(ds, q), products.transposed(p, dy)


_rounded.defvjp(_rounded_forward, _rounded_backward)


def _product(axes: str, a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.einsum(axes, a.astype(b.dtype), b, preferred_element_type=jnp.float32)


@contextlib.contextmanager
def scores_limit(limit: float | None) -> Iterator[None]:
    """Another limit of the bytes of scores at a time, for what is traced inside; None: the device's own."""
    token = _LIMIT.set(limit)
    try:
        yield
    finally:
        _LIMIT.reset(token)


def is_attention(primitive, *_, **params) -> bool:
    """A policy of `jax.checkpoint` that keeps what attention returns (in pieces and of the fused kernel also row sums)."""
    if primitive.name == "name":
        return params["name"] in ("attention", PIECES)
    return "dot_product_attention_fwd" in params.get("target_name", primitive.name)


def split_heads(x: jax.Array, heads: int) -> jax.Array:
    """[.., l, d] -> [.., l, heads, d / heads]."""
    return x.reshape(*x.shape[:-1], heads, x.shape[-1] // heads)


def merge_heads(x: jax.Array) -> jax.Array:
    """[.., l, heads, e] -> [.., l, heads * e]."""
    return x.reshape(*x.shape[:-2], -1)
