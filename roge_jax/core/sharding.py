"""One mesh, one table: on which devices every weight and every activation lives.

The mesh has three axes, slowest first, so that neighbours in `seq` and `fsdp` are neighbours in hardware:

    data   scenes of a batch
    fsdp   shares of every large matrix; these devices split the batch too, as far as it goes
    seq    tokens of one video in the transformer, views of one scene in the ray queries

`TABLE` says which logical axis (of a `Spec`, or named at a block border by `constrain`) is split over which mesh axis.
XLA inserts the communication. Model code names logical axes only; without a mesh it runs as if this file did not exist.
"""

import contextlib
import contextvars
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec

from ..errors import UserError, did_you_mean
from . import target
from .params import Tree, flatten, unflatten

MESH_AXES = ("data", "fsdp", "seq")
AnyMesh = Mesh | AbstractMesh  # shapes and places can be worked out without devices


class Rule(NamedTuple):
    """The mesh axes that a logical axis is split over.

    The first `must` of them have to divide its size; later ones are left out where they do not. `pad`: any size is
    fine, the last devices get less (only for activations).
    """

    mesh_axes: tuple[str, ...] = ()
    must: int = 1
    pad: bool = False


TABLE: dict[str, Rule] = {
    # weights: every large matrix has exactly one "embed" axis
    "embed": Rule(("fsdp",)),
    "mlp": Rule(),
    "heads": Rule(),
    "layers": Rule(),
    # activations
    "batch": Rule(("data", "fsdp")),
    "tokens": Rule(("seq",), pad=True),
    "views": Rule(("seq",), pad=True),
    "attention_heads": Rule(("seq",), must=0),
}


# ---- the mesh ------------------------------------------------------------------------------------


def make_mesh(
    data: int | None = None,
    fsdp: int = 1,
    seq: int = 1,
    devices: Sequence[jax.Device] | None = None,
) -> Mesh:
    """The mesh (data, fsdp, seq) over `devices` (default: all, of all processes); data=None takes what is left.

    Raises UserError, naming sizes that fit, if the product is not the number of devices.
    """
    devices = jax.devices() if devices is None else list(devices)
    return jax.make_mesh(
        mesh_sizes(len(devices), data, fsdp, seq),
        MESH_AXES,
        axis_types=(AxisType.Auto,) * 3,
        devices=devices,
    )


def mesh_sizes(
    n: int, data: int | None = None, fsdp: int = 1, seq: int = 1
) -> tuple[int, int, int]:
    """(data, fsdp, seq) of a mesh of n devices. Raises UserError as `make_mesh` does."""
    for name, size in zip(MESH_AXES, (data, fsdp, seq)):
        if size is not None and size < 1:
            raise UserError(f"Mesh axis {name}={size}: sizes are whole numbers of at least 1.")
    if data is None and n % (fsdp * seq) == 0:
        data = n // (fsdp * seq)
    if data is None or data * fsdp * seq != n:
        given = (
            f"fsdp={fsdp}, seq={seq}" if data is None else f"data={data}, fsdp={fsdp}, seq={seq}"
        )
        raise UserError(f"A mesh of {given} does not make {n} devices: {_fitting(n, fsdp, seq)}.")
    return data, fsdp, seq


def abstract_mesh(data: int = 1, fsdp: int = 1, seq: int = 1) -> AbstractMesh:
    """A mesh of devices that need not be there: enough to work out what would lie where."""
    return AbstractMesh((data, fsdp, seq), MESH_AXES, axis_types=(AxisType.Auto,) * 3)


def _fitting(n: int, fsdp: int, seq: int) -> str:
    if n % (fsdp * seq) == 0:
        return f"data={n // (fsdp * seq)}, fsdp={fsdp}, seq={seq} does"
    return f"sizes whose product is {n} do, each one of {', '.join(map(str, _divisors(n)))}"


def _divisors(n: int) -> list[int]:
    return [d for d in range(1, n + 1) if n % d == 0]


def parse_mesh(text: str) -> dict[str, int]:
    """'data=2,fsdp=2,seq=2' (any part may be missing) as arguments of `make_mesh`."""
    sizes: dict[str, int] = {}
    if not text.strip():
        raise UserError("--mesh is empty: write data=2,fsdp=2,seq=2, or leave it out.")
    for part in text.split(","):
        name, _, value = part.strip().partition("=")
        if name not in MESH_AXES:
            raise UserError(f"--mesh: unknown axis '{name}': {did_you_mean(name, MESH_AXES)}")
        if name in sizes or not value.isdecimal() or int(value) < 1:
            raise UserError(
                f"--mesh: '{part.strip()}' must be one {name}=NUMBER: write data=2,fsdp=2,seq=2."
            )
        sizes[name] = int(value)
    return sizes


# ---- the table applied ---------------------------------------------------------------------------


def partition(
    axes: Sequence[str | None], shape: Sequence[int], mesh: AnyMesh, *, leaf: str = "array"
) -> PartitionSpec:
    """The `PartitionSpec` of an array with logical `axes`, one entry per dimension.

    Raises UserError naming leaf, axis and the sizes that divide where the table insists on a split.
    """
    assert len(axes) == len(shape), f"{leaf}: axes {axes} for shape {shape}"
    entries: list[Any] = []
    for i, (name, size) in enumerate(zip(axes, shape)):
        over = TABLE[name].mesh_axes if name is not None else ()
        if name is not None and not TABLE[name].pad:
            while over and size % _ways(mesh, over):
                if len(over) <= TABLE[name].must:
                    raise UserError(
                        f"{leaf}: axis {i} ('{name}', size {size}) cannot be split over {over[-1]}="
                        f"{mesh.shape[over[-1]]}; sizes that divide it: {', '.join(map(str, _divisors(size)))}."
                    )
                over = over[:-1]
        entries.append(None if not over else over[0] if len(over) == 1 else over)
    used = [a for e in entries if e for a in ((e,) if isinstance(e, str) else e)]
    assert len(used) == len(set(used)), f"{leaf}: {axes} uses a mesh axis twice"
    return PartitionSpec(*entries)


def _ways(mesh: AnyMesh, axes: Sequence[str]) -> int:
    return math.prod(mesh.shape[a] for a in axes)


def shardings(specs: Tree, mesh: AnyMesh) -> Tree:
    """`NamedSharding` of every leaf of a spec tree. All leaves that do not divide are counted in one UserError."""
    found, faults, sizes = {}, [], []
    for path, spec in flatten(specs).items():
        try:
            found[path] = NamedSharding(mesh, partition(spec.axes, spec.shape, mesh, leaf=path))
        except UserError as error:
            faults.append(str(error))
        sizes += [n for name, n in zip(spec.axes, spec.shape) if name == "embed"]
    if faults:
        fit = ", ".join(str(d) for d in _divisors(math.gcd(*sizes)) if d <= mesh.size)
        more = f" {len(faults) - 1} more leaves have this fault." if len(faults) > 1 else ""
        raise UserError(f"{faults[0]}{more} Sizes of fsdp that divide every leaf: {fit}.")
    return unflatten(found)


def replicated(mesh: AnyMesh) -> NamedSharding:
    """Whole on every device of the mesh."""
    return NamedSharding(mesh, PartitionSpec())


def state_shardings(state: Any, specs: Tree, mesh: AnyMesh) -> Any:
    """Shardings of a training state: leaves that mirror a parameter (moments, averages) lie where it lies.

    A leaf mirrors the parameter whose path is the tail of its own, if the shapes agree; all others are replicated.
    """
    where, shapes = flatten(shardings(specs, mesh)), {p: s.shape for p, s in flatten(specs).items()}

    def leaf(path, x):
        names = [k.key for k in path if isinstance(k, jax.tree_util.DictKey)]
        for start in range(len(names)):
            tail = "/".join(map(str, names[start:]))
            if shapes.get(tail) == tuple(x.shape):
                return where[tail]
        return replicated(mesh)

    return jax.tree_util.tree_map_with_path(leaf, state)


def batch_sharding(mesh: AnyMesh, batch: int) -> NamedSharding:
    """Of arrays with a leading axis of `batch` scenes. Raises UserError if `data` does not divide it."""
    return NamedSharding(mesh, partition(("batch",), (batch,), mesh, leaf="The batch of scenes"))


def place(tree: Any, where: Any) -> Any:
    """`tree` with the shardings `where` (one, or a tree of them). In a run of several processes every process must
    hold the same values; each keeps its own shares.
    """

    def leaf(x, sharding):
        if isinstance(x, jax.Array) and x.sharding.is_equivalent_to(sharding, x.ndim):
            return x
        if sharding.is_fully_addressable:
            return jax.device_put(x, sharding)
        host = np.asarray(x)
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

    if isinstance(where, NamedSharding):
        return jax.tree.map(lambda x: leaf(x, where), tree)
    return jax.tree.map(leaf, tree, where)


def gather(tree: Any) -> Any:
    """Whole arrays in host memory, also of leaves that no single process holds. All processes must call it."""

    def whole(x):
        if not isinstance(x, jax.Array) or x.is_fully_addressable or x.is_fully_replicated:
            return np.asarray(x)
        everywhere = replicated(x.sharding.mesh)
        return np.asarray(jax.jit(lambda x: x, out_shardings=everywhere)(x))

    return jax.tree.map(whole, tree)


def held(specs: Tree, mesh: AnyMesh, dtype: Callable[[str], Any] | None = None) -> int:
    """Bytes of a spec tree on each device, every leaf in `dtype(path)` or its spec's own."""
    where = flatten(shardings(specs, mesh))
    return sum(
        math.prod(where[path].shard_shape(spec.shape))
        * jnp.dtype(spec.dtype if dtype is None else dtype(path)).itemsize
        for path, spec in flatten(specs).items()
    )


def describe(specs: Tree, mesh: AnyMesh, dtype: Callable[[str], Any] | None = None) -> str:
    """A table, one line per leaf: path, shape, PartitionSpec, bytes on each device; then the sums.

    `dtype(path)` says what a leaf is kept in, if that is not its spec's own.
    """
    rows, here, whole = [("leaf", "shape", "split over", "bytes per device")], 0, 0
    where = flatten(shardings(specs, mesh))
    for path, spec in flatten(specs).items():
        item = jnp.dtype(spec.dtype if dtype is None else dtype(path)).itemsize
        share = math.prod(where[path].shard_shape(spec.shape)) * item
        split = ", ".join("-" if e is None else str(e) for e in where[path].spec) or "-"
        rows.append((path, str(tuple(spec.shape)), split, f"{share:,}"))
        here, whole = here + share, whole + math.prod(spec.shape) * item
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    lines = [
        f"{a:{widths[0]}}  {b:{widths[1]}}  {c:{widths[2]}}  {d:>{widths[3]}}".rstrip()
        for a, b, c, d in rows
    ]
    sizes = ", ".join(f"{name}={size}" for name, size in mesh.shape.items())
    return "\n".join([f"mesh {sizes}", *lines, f"{here:,} of {whole:,} bytes on each device"])


# ---- activations ---------------------------------------------------------------------------------

_MESH: contextvars.ContextVar[AnyMesh | None] = contextvars.ContextVar(
    "roge_jax_mesh", default=None
)


@contextlib.contextmanager
def use(mesh: AnyMesh | None) -> Iterator[AnyMesh | None]:
    """The mesh that `constrain` means while functions are traced.

    JAX keeps one trace per jitted function and argument shapes and does not see this setting: jit a function anew
    for another mesh.
    """
    token = _MESH.set(mesh)
    try:
        yield mesh
    finally:
        _MESH.reset(token)


def current() -> AnyMesh | None:
    """The mesh set by `use`; None without one."""
    return _MESH.get()


def ways(axis: str) -> int:
    """Over how many devices the current mesh splits along `axis`; 1 without a mesh."""
    mesh = current()
    return 1 if mesh is None else mesh.shape[axis]


def everywhere() -> NamedSharding | None:
    """Whole on every device of the current mesh; None without a mesh."""
    mesh = current()
    return None if mesh is None else replicated(mesh)


def shapes(tree: Any) -> Any:
    """Abstract arrays of `tree`. On a mesh they lie where the arrays do, and whole everywhere if those lie on none."""

    def leaf(x):
        where = getattr(x, "sharding", None)
        where = where if isinstance(where, NamedSharding) else everywhere()
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where)

    return jax.tree.map(leaf, tree)


def constrain(x: jax.Array, names: Sequence[str | None]) -> jax.Array:
    """x, laid out as the table says for logical axes `names`; None: whole on every device. No-op without a mesh.

    Under `jax.vmap` the names are those of one scene; the batch axis stays as it is (see `batch_axes`).
    """
    mesh = current()
    if mesh is None:
        return x
    return jax.lax.with_sharding_constraint(x, NamedSharding(mesh, partition(names, x.shape, mesh)))


def batch_axes(batch: int) -> tuple[str, ...] | None:
    """`spmd_axis_name` of a `jax.vmap` over a batch of scenes: the mesh axes that it is split over, None for none."""
    mesh = current()
    if mesh is None:
        return None
    over = TABLE["batch"].mesh_axes
    while over and batch % _ways(mesh, over):
        over = over[:-1]
    return over or None


def by_heads(
    q: jax.Array, k: jax.Array, v: jax.Array, dtype
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The border into attention over all tokens: q [l, heads, e], k and v [s, heads, e] of one scene.

    If `seq` divides the heads, each device takes all tokens of some heads: XLA makes all-to-alls of it, a quarter of
    the volume of gathering keys and values at seq=8, and the fused GPU kernel accepts no other layout. Otherwise
    queries stay split by token, and keys and values are gathered. `dtype` is that of attention's matrix products,
    so that no wider numbers travel.
    """
    if ways("seq") == 1:
        return q, k, v
    q, k, v = (x.astype(dtype) for x in (q, k, v))
    if q.shape[-2] % ways("seq"):
        if target.platform() == "gpu":
            check_heads(q.shape[-2], current())
        whole = (None, None, None)
        return constrain(q, ("tokens", None, None)), constrain(k, whole), constrain(v, whole)
    split = (None, "attention_heads", None)
    return constrain(q, split), constrain(k, split), constrain(v, split)


def check_heads(heads: int, mesh: AnyMesh | None) -> None:
    """Raise UserError unless `seq` divides the attention heads, as the fused attention of GPUs needs it."""
    if mesh is not None and heads % mesh.shape["seq"]:
        fit = ", ".join(map(str, _divisors(heads)))
        raise UserError(
            f"seq={mesh.shape['seq']} does not divide {heads} attention heads: use one of {fit}."
        )


def over_scenes(f: Callable, params: Tree, *batch):
    """f(params, *scene) of every scene of a batch (leading axis of every array).

    All at once, but one by one on a CPU: one scene's matrix products fill it, and the gradients of batched products
    are slow there (see `matmul`). Where CPU devices split nothing but the batch, each goes through its own scenes.
    """

    def one_by_one(params, batch):
        with use(None):
            return jax.lax.map(lambda scene: f(params, *scene), batch)

    mesh, scenes = current(), jax.tree.leaves(batch)[0].shape[0]
    if target.platform() == "cpu":
        if mesh is None:
            return one_by_one(params, batch)
        if isinstance(mesh, Mesh) and mesh.size == mesh.shape["data"] and scenes % mesh.size == 0:
            split, whole = PartitionSpec("data"), PartitionSpec()
            run = jax.shard_map(
                one_by_one,
                mesh=mesh,
                in_specs=(whole, split),
                out_specs=split,
                check_vma=False,  # loops over scenes start from constants, which lie everywhere
            )
            return run(params, batch)
    return jax.vmap(functools.partial(f, params), spmd_axis_name=batch_axes(scenes))(*batch)
