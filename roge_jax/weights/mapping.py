"""Tables between published tensor names and our leaves, used for import and export alike.

A network's map is a list of `Entry`, one per leaf of its spec tree, built from its config:

    [Entry("encoder/conv_in/kernel", ("encoder.conv1.weight",), CONV3D), ...]

An entry with `stacked=True` names one source key per layer; the leaf is their transforms stacked on axis 0, which is
the layout of `core.params.stack`. Transforms are pairs of inverse functions on NumPy arrays that only move or drop
axes, so both directions are exact. `to_ours` and `to_theirs` convert whole trees; `source_shapes` needs no values.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..core.params import Tree, flatten, unflatten
from ..errors import UserError


class Transform(NamedTuple):
    """Two inverse functions on arrays that only move or drop axes."""

    to_ours: Callable[[np.ndarray], np.ndarray]
    to_theirs: Callable[[np.ndarray], np.ndarray]


def bare(tensors: Mapping, prefixes: Sequence[str], ignored: str) -> dict:
    """The tensors without `prefixes` of their names, and without those whose bare name matches `ignored`."""
    found = {}
    for key, value in tensors.items():
        for prefix in prefixes:
            key = key.removeprefix(prefix)
        if not re.search(ignored, key):
            found[key] = value
    return found


def permute(*axes: int) -> Transform:
    """Theirs to ours by `np.transpose(x, axes)`."""
    back = tuple(int(a) for a in np.argsort(axes))
    return Transform(lambda x: np.transpose(x, axes), lambda x: np.transpose(x, back))


def trailing_ones(n: int) -> Transform:
    """Theirs [c, 1, .., 1] with `n` trailing ones, ours [c]."""
    return Transform(lambda x: x.reshape(x.shape[0]), lambda x: x.reshape(x.shape + (1,) * n))


def pointwise(n: int) -> Transform:
    """Theirs a convolution [out, in, 1, .., 1] with `n` axes of length one, ours a linear kernel [in, out]."""
    return Transform(
        lambda x: x.reshape(x.shape[:2]).T, lambda x: x.T.reshape(x.shape[::-1] + (1,) * n)
    )


def leading_ones(n: int) -> Transform:
    """Theirs [1, .., 1, ...] with `n` leading ones, ours without them."""
    return Transform(lambda x: x.reshape(x.shape[n:]), lambda x: x.reshape((1,) * n + x.shape))


IDENTITY = Transform(lambda x: x, lambda x: x)
LINEAR = permute(1, 0)  # [out, in] -> [in, out]
CONV2D = permute(2, 3, 1, 0)  # OIHW -> HWIO
CONV3D = permute(2, 3, 4, 1, 0)  # OIDHW -> DHWIO


class Entry(NamedTuple):
    """One of our leaves and where it comes from."""

    path: str  # ours, "a/b/kernel"
    keys: tuple[str, ...]  # theirs; exactly one unless stacked
    transform: Transform = IDENTITY
    stacked: bool = False  # one key per layer, layers on axis 0 of the leaf


def leaf_from(entry: Entry, source: Mapping[str, np.ndarray]) -> np.ndarray:
    """The value of one leaf; layers are read one at a time into the stacked array."""
    if not entry.stacked:
        (key,) = entry.keys
        return np.ascontiguousarray(entry.transform.to_ours(np.asarray(source[key])))
    first = entry.transform.to_ours(np.asarray(source[entry.keys[0]]))
    leaf = np.empty((len(entry.keys), *first.shape), first.dtype)
    for i, key in enumerate(entry.keys):
        leaf[i] = entry.transform.to_ours(np.asarray(source[key]))
    return leaf


def tensors_from(entry: Entry, leaf) -> dict[str, np.ndarray]:
    """The inverse of `leaf_from`: the source tensors held by one leaf."""
    leaf = np.asarray(leaf)
    parts = list(leaf) if entry.stacked else [leaf]
    assert len(parts) == len(entry.keys), (entry.path, leaf.shape, len(entry.keys))
    return {
        key: np.ascontiguousarray(entry.transform.to_theirs(part))
        for key, part in zip(entry.keys, parts, strict=True)
    }


def to_ours(
    entries: Iterable[Entry], source: Mapping[str, np.ndarray], *, name="checkpoint"
) -> Tree:
    """Our parameter tree (NumPy leaves) from their tensors. Missing and unused keys raise one `UserError`."""
    entries = list(entries)
    wanted = {key for entry in entries for key in entry.keys}
    faults = [f"missing {key}" for key in sorted(wanted - set(source))]
    faults += [f"unexpected {key}" for key in sorted(set(source) - wanted)]
    if faults:
        more = f"; and {len(faults) - 20} more" if len(faults) > 20 else ""
        raise UserError(
            f"{name} does not hold this network ({len(faults)} mismatches): {'; '.join(faults[:20])}{more}. "
            "Check which model the file belongs to and the preset's sizes."
        )
    return unflatten({entry.path: leaf_from(entry, source) for entry in entries})


def to_theirs(entries: Iterable[Entry], tree: Tree) -> dict[str, np.ndarray]:
    """Their tensors from our parameter tree."""
    flat = flatten(tree)
    tensors: dict[str, np.ndarray] = {}
    for entry in entries:
        tensors |= tensors_from(entry, flat[entry.path])
    return tensors


def source_shapes(entries: Iterable[Entry], specs: Tree) -> dict[str, tuple[int, ...]]:
    """{their key: shape} of a spec tree (or abstract tree) without allocating anything."""
    flat = flatten(specs)
    shapes: dict[str, tuple[int, ...]] = {}
    for entry in entries:
        shape = tuple(flat[entry.path].shape)
        shape = shape[1:] if entry.stacked else shape
        theirs = entry.transform.to_theirs(np.broadcast_to(np.float32(0), shape)).shape
        shapes |= dict.fromkeys(entry.keys, tuple(theirs))
    return shapes
