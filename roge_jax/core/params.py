"""Parameters as nested dicts of arrays, declared once as `Spec`s.

A *spec tree* has a `Spec` at every leaf. Initial values, abstract shapes, shardings, checkpoint checks and weight
conversion are all derived from it, so a leaf's shape is written down in exactly one place.
"""

import re
import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..errors import UserError

Tree = dict[str, Any]
# NumPy draws initial values: eager JAX would compile a program for every shape, seconds for a tiny model.
Initialiser = Callable[[np.random.Generator, tuple[int, ...], Any], np.ndarray]


def fan_in(scale: float = 1.0) -> Initialiser:
    """Normal with standard deviation scale / sqrt(product of all axes but the last)."""

    return lambda rng, shape, dtype: normal(scale / np.sqrt(np.prod(shape[:-1])))(rng, shape, dtype)


def normal(std: float) -> Initialiser:
    """Normal with mean 0 and standard deviation `std`."""
    return lambda rng, shape, dtype: (
        np.float32(std) * rng.standard_normal(shape, np.float32)
    ).astype(dtype)


def uniform(bound: float) -> Initialiser:
    """Uniform between -bound and bound."""

    def init(rng, shape, dtype):
        return (np.float32(bound) * (2 * rng.random(shape, np.float32) - 1)).astype(dtype)

    return init


def constant(value: float) -> Initialiser:
    """`value` everywhere."""
    return lambda rng, shape, dtype: np.full(shape, value, dtype)


def zeros(rng, shape, dtype):
    """0 everywhere."""
    return np.zeros(shape, dtype)


def ones(rng, shape, dtype):
    """1 everywhere."""
    return np.ones(shape, dtype)


class Spec(NamedTuple):
    """One leaf: shape, a logical axis name per dimension (None: never sharded), initialiser, dtype."""

    shape: tuple[int, ...]
    axes: tuple[str | None, ...]
    init: Initialiser = fan_in()
    dtype: Any = jnp.float32


def is_spec(x) -> bool:
    """Whether x is a leaf of a spec tree."""
    return isinstance(x, Spec)


def map_specs(f: Callable[[Spec], Any], specs):
    """The tree with `f` of every spec."""
    return jax.tree.map(f, specs, is_leaf=is_spec)


def flatten(tree, prefix: str = "") -> dict[str, Any]:
    """Nested dicts to {"a/b/c": leaf}, in sorted order."""
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    flat: dict[str, Any] = {}
    for name in sorted(tree):
        flat |= flatten(tree[name], f"{prefix}/{name}" if prefix else name)
    return flat


def unflatten(flat: Mapping[str, Any]) -> Tree:
    """The inverse of `flatten`."""
    tree: Tree = {}
    for path, leaf in flat.items():
        *parents, name = path.split("/")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[name] = leaf
    return tree


def split(params: Tree, pattern: str) -> tuple[Tree, Tree]:
    """(leaves whose path matches `pattern`, the others): what trains and what is frozen."""
    flat = flatten(params)
    chosen = {path for path in flat if re.search(pattern, path)}
    return (
        unflatten({path: flat[path] for path in chosen}),
        unflatten({path: leaf for path, leaf in flat.items() if path not in chosen}),
    )


class Drawn(NamedTuple):
    """An initial value that is drawn when NumPy asks for it (`np.asarray`), and is the same every time."""

    spec: Spec
    seed: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.spec.shape

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(self.spec.dtype)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        value = self.spec.init(np.random.default_rng(self.seed), self.shape, self.dtype)
        return np.array(value, dtype, copy=copy)


def drawn(key: jax.Array, specs) -> Tree:
    """Initial values, none of them in memory. A leaf's seed is `key` and its path: adding a leaf changes no other."""
    seed = np.asarray(jax.random.key_data(key)).tolist()
    flat = flatten(specs)
    return unflatten({p: Drawn(s, (*seed, zlib.crc32(p.encode()))) for p, s in flat.items()})


def init(key: jax.Array, specs) -> Tree:
    """`drawn` (not under jit)."""
    flat = flatten(drawn(key, specs))
    return unflatten({path: jnp.asarray(np.asarray(x)) for path, x in flat.items()})


def abstract(specs) -> Tree:
    """The same tree as `jax.ShapeDtypeStruct`s: nothing is allocated."""
    return map_specs(lambda s: jax.ShapeDtypeStruct(s.shape, s.dtype), specs)


def count(tree) -> int:
    """Number of parameters of a tree of specs or arrays."""
    return sum(int(np.prod(leaf.shape)) for leaf in flatten(tree).values())


def stack(specs, n: int):
    """Specs of `n` equal blocks, stacked along a new leading axis for `lax.scan`."""

    def leaf(s: Spec) -> Spec:
        def stacked(rng, shape, dtype):
            return np.stack([s.init(rng, s.shape, dtype) for _ in range(n)])

        return Spec((n, *s.shape), ("layers", *s.axes), stacked, s.dtype)

    return map_specs(leaf, specs)


def cast(tree, dtype) -> Tree:
    """Floating leaves of `tree` in `dtype`."""
    return jax.tree.map(
        lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


def loaded(tree) -> Tree:
    """Every leaf of `tree`, wherever it lies, copied to a float32 array in memory."""
    flat = flatten(tree)
    return unflatten({path: jnp.asarray(np.array(x, np.float32)) for path, x in flat.items()})


def check(params, specs, *, source: str = "parameters") -> None:
    """Raise one `UserError` that lists every missing, unexpected or misshapen leaf of `params`."""
    have, want = flatten(params), flatten(specs)
    faults = [f"missing {path} {want[path].shape}" for path in want if path not in have]
    faults += [f"unexpected {path} {have[path].shape}" for path in have if path not in want]
    faults += [
        f"{path} has shape {tuple(have[path].shape)}, expected {want[path].shape}"
        for path in want
        if path in have and tuple(have[path].shape) != tuple(want[path].shape)
    ]
    if faults:
        shown = "; ".join(faults[:20]) + (
            f"; and {len(faults) - 20} more" if len(faults) > 20 else ""
        )
        raise UserError(
            f"{source} does not fit this model ({len(faults)} mismatches): {shown}. "
            "Use the checkpoint's own config, or convert it for this preset."
        )
