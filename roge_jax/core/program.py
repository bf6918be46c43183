"""What a traced program multiplies, and what it holds at once: found on its jaxpr, nothing is compiled or allocated.

    program = trace(step, *abstract_arguments)
    flops(program)          matrix products and convolutions, loops by their turns
    peak(program).bytes     temporary memory, beside arguments and results

`peak` walks the operations in order and keeps book of buffers the way XLA does: cheap operations are fused into what
reads them and have no buffer of their own; matrix products, loops and whatever those read have one, from where it is
made to its last reader; a loop uses the same buffers every turn. `docs/results/scaling.md` says how close that comes to XLA.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

# The same numbers in the same order: no buffer of their own.
ALIASES = {
    "reshape", "squeeze", "expand_dims", "copy", "optimization_barrier", "sharding_constraint",
    "stop_gradient", "bitcast_convert_type", "reduce_precision", "name",
}  # fmt: skip
# Computed again in every reader rather than stored ...
CHEAP = {
    "add", "add_any", "sub", "mul", "neg", "max", "min", "and", "or", "not", "xor", "eq", "ne",
    "lt", "le", "gt", "ge", "abs", "sign", "floor", "ceil", "round", "clamp", "select_n",
    "convert_element_type", "broadcast_in_dim", "iota", "slice", "dynamic_slice",
    "rev", "pad", "is_finite", "integer_pow", "square", "shift_right_logical", "shift_left",
    "split", "one_minus_square", "polynomial",
}  # fmt: skip
# ... and these only if there is one reader.
DEAR = {
    "exp", "exp2", "log", "log1p", "expm1", "tanh", "logistic", "erf", "erf_inv", "rsqrt",
    "transpose", "sqrt", "cbrt", "pow", "div", "rem", "sin", "cos", "tan", "atan2", "acos", "asin",
}  # fmt: skip
# Those whose numbers change place, so that they cannot overwrite what they read.
MOVES = {
    "broadcast_in_dim", "iota", "slice", "dynamic_slice", "transpose", "rev", "pad", "split",
}  # fmt: skip
CONTROL = ("scan", "while", "cond")


class Op(NamedTuple):
    """One operation on numbered values."""

    name: str
    reads: tuple[int, ...]
    writes: tuple[int, ...]
    params: dict[str, Any]
    shapes: tuple[Any, ...]  # abstract values of all operands, constants included
    scope: str  # names of `jax.named_scope` and of transformations, outermost first
    bodies: tuple["Program", ...] = ()  # of a loop or of branches


class Program(NamedTuple):
    """A jaxpr without calls and without operations that nothing reads."""

    ops: list[Op]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    values: list[Any]  # the abstract value of every number


def trace(function: Callable, *arguments: Any) -> Program:
    """The program of `function` on (abstract) arguments."""
    return read(jax.make_jaxpr(function)(*arguments).jaxpr)


def read(jaxpr, scope: str = "") -> Program:
    """A jaxpr with every call, and every loop of one turn, written out."""
    values: list[Any] = []
    ops: list[Op] = []

    def new(aval) -> int:
        values.append(aval)
        return len(values) - 1

    def number(env, atom) -> int:
        return new(atom.aval) if hasattr(atom, "val") else env[atom]

    def inline(inner, reads: Sequence[int], scope: str) -> list[int]:
        env = {var: new(var.aval) for var in inner.constvars}
        env |= dict(zip(inner.invars, reads))
        walk(inner, env, scope)
        return [number(env, atom) for atom in inner.outvars]

    def alias(value: int, aval, scope: str) -> int:
        ops.append(Op("reshape", (value,), (new(aval),), {}, (values[value],), scope))
        return ops[-1].writes[0]

    def walk(jaxpr, env, scope: str) -> None:
        for eqn in jaxpr.eqns:
            params = eqn.params
            name = params.get("target_name", eqn.primitive.name)  # of a foreign function, its own
            here = f"{scope}/{eqn.source_info.name_stack}"
            reads = [number(env, atom) for atom in eqn.invars]
            inner = None
            if name not in CONTROL:
                calls = [params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in params]
                inner = calls[0] if calls else None
            if inner is not None:
                found = inline(getattr(inner, "jaxpr", inner), reads, here)
            elif name == "scan" and params["length"] == 1:
                body, (kept, carried) = params["jaxpr"].jaxpr, _scan_ends(params)
                xs = [alias(v, a.aval, here) for v, a in zip(reads[kept:], body.invars[kept:])]
                found = inline(body, reads[:kept] + xs, here)
                ys = zip(found[carried:], eqn.outvars[carried:])
                found = found[:carried] + [alias(v, var.aval, here) for v, var in ys]
            else:
                found = [new(var.aval) for var in eqn.outvars]
                shapes = tuple(atom.aval for atom in eqn.invars)
                bodies = tuple(read(body, here) for body in _bodies(name, params))
                ops.append(Op(name, tuple(reads), tuple(found), params, shapes, here, bodies))
            env.update(zip(eqn.outvars, found))

    env = {var: new(var.aval) for var in [*jaxpr.invars, *jaxpr.constvars]}
    inputs = tuple(env.values())
    walk(jaxpr, env, scope)
    outputs = tuple(number(env, atom) for atom in jaxpr.outvars)
    wanted, kept = set(outputs), []
    for op in reversed(ops):
        if wanted.intersection(op.writes):
            kept.append(op)
            wanted.update(op.reads)
    return Program(kept[::-1], inputs, outputs, values)


# ---- work ----------------------------------------------------------------------------------------


def flops(program: Program, label: Callable[[str], str] = lambda scope: "") -> dict[str, float]:
    """FLOPs (2 per multiply-add) of matrix products and convolutions, summed by `label(scope)`."""
    total: dict[str, float] = {}
    for op in program.ops:
        if op.name in CONTROL:
            turns = op.params["length"] if op.name == "scan" else 1
            for body in op.bodies:
                for name, value in flops(body, label).items():
                    total[name] = total.get(name, 0.0) + turns * value
            continue
        value = _flops(op, program.values[op.writes[0]])
        if value:
            name = label(op.scope)
            total[name] = total.get(name, 0.0) + value
    return total


def _flops(op: Op, out: Any) -> float:
    if op.name == "dot_general":
        (contracted, _), _ = op.params["dimension_numbers"]
        terms = math.prod(op.shapes[0].shape[i] for i in contracted)
        return 2.0 * math.prod(out.shape) * terms
    if op.name == "conv_general_dilated":
        kernel = op.shapes[1].shape
        terms = math.prod(kernel) / kernel[op.params["dimension_numbers"].rhs_spec[0]]
        return 2.0 * math.prod(out.shape) * terms
    if "dot_product_attention" in op.name:  # the fused kernel: two products, five of its gradient
        products = 5 if "bwd" in op.name else 2
        return 2.0 * products * math.prod(op.shapes[0].shape) * op.shapes[1].shape[-3]
    return 0.0


def _bodies(name: str, params: dict[str, Any]) -> list[Any]:
    if name == "cond":
        return [branch.jaxpr for branch in params["branches"]]
    key = {"scan": "jaxpr", "while": "body_jaxpr"}.get(name)
    return [params[key].jaxpr] if key else []


# ---- memory --------------------------------------------------------------------------------------


class Held(NamedTuple):
    """A buffer that is alive at the fullest moment."""

    bytes: float
    operation: str
    shape: str
    scope: str


class Peak(NamedTuple):
    """The fullest moment of a program: its bytes and the buffers that are alive then."""

    bytes: float
    held: list[Held]


def size(aval, scope: str = "") -> float:
    """Bytes of an array."""
    try:
        return float(math.prod(aval.shape) * jnp.dtype(aval.dtype).itemsize)
    except (AttributeError, TypeError):  # tokens; random keys, of 8 bytes
        return 8.0 * math.prod(getattr(aval, "shape", ()))


def peak(
    program: Program,
    weigh: Callable[[Any, str], float] = size,
    *,
    elsewhere: Iterable[int] | None = None,
) -> Peak:
    """The most memory that temporary values take at one moment, and what they are.

    `weigh(abstract value, scope)` says what a buffer takes. Values `elsewhere` (by default arguments and results)
    are not counted.
    """
    root = list(range(len(program.values)))
    work = []
    for op in program.ops:
        if _is_alias(op):
            for made, source in zip(op.writes, op.reads):
                root[made] = root[source]
        else:
            work.append(op)
    outputs = {root[v] for v in program.outputs}
    if elsewhere is None:
        elsewhere = (*program.inputs, *program.outputs)
    free = {root[v] for v in elsewhere}
    readers: dict[int, list[int]] = {}
    for i, op in enumerate(work):
        for v in {root[v] for v in op.reads}:
            readers.setdefault(v, []).append(i)
    maker = {v: i for i, op in enumerate(work) for v in op.writes}
    # From the last value to the first: which operations read it in the end, through fused ones; whether it is stored.
    sites: dict[int, set[int]] = {}
    stored: dict[int, bool] = {}
    for v in sorted(maker, key=maker.__getitem__, reverse=True):
        sites[v] = set()
        for i in readers.get(v, ()):
            fused = [w for w in work[i].writes if not stored[w]]
            sites[v].update(*(sites[w] for w in fused)) if fused else sites[v].add(i)
        direct = [work[i] for i in readers.get(v, ())]
        stored[v] = v in outputs or _is_stored(work[maker[v]], direct, len(sites[v]))
    end = len(work)
    last = {v: end if v in outputs else max(sites[v], default=i) for v, i in maker.items()}

    weight = {v: weigh(program.values[v], work[i].scope) for v, i in maker.items()}
    counted = [v for v in maker if stored[v] and v not in free and weight[v]]
    ends: dict[int, list[int]] = {}
    for v in counted:
        ends.setdefault(last[v], []).append(v)
    live: set[int] = set()
    total, best, held = 0.0, 0.0, []  # type: float, float, list[Held]
    for i, op in enumerate(work):
        inside = _inside(op, weigh) if op.name in CONTROL else Peak(0.0, [])
        leaving = [v for v in ends.get(i, ()) if v in live]
        for v in op.writes:
            if not stored[v] or v in free or not weight[v]:
                continue
            live.add(v)
            total += weight[v]
            if _reuses(op):  # the buffer of an operand that nothing reads afterwards
                same = next((old for old in leaving if weight[old] == weight[v]), None)
                if same is not None:
                    leaving.remove(same)
                    live.remove(same)
                    total -= weight[same]
        if total + inside.bytes > best:
            best = total + inside.bytes
            held = [_held(weight[v], work[maker[v]], program.values[v]) for v in live]
            held += inside.held
        for v in ends.get(i, ()):
            if v in live:
                live.remove(v)
                total -= weight[v]
    return Peak(best, held)


def _is_alias(op: Op) -> bool:
    if not op.reads or not op.shapes:
        return False
    shape = op.shapes[0].shape
    if op.name == "transpose":  # of axes of length 1
        moved = [axis for axis in op.params["permutation"] if shape[axis] != 1]
        return moved == sorted(moved)
    if op.name == "broadcast_in_dim":
        return math.prod(shape) == math.prod(op.params["shape"])
    if op.name == "convert_element_type":
        return op.shapes[0].dtype == op.params["new_dtype"]
    return op.name in ALIASES


def _is_fusible(op: Op) -> bool:
    return op.name in CHEAP or op.name in DEAR


def _absorbs(op: Op) -> bool:
    """Whether an operation can compute its operands itself."""
    if op.name in ("concatenate", "dynamic_update_slice"):
        return True
    return _is_fusible(op) or op.name.startswith(("reduce_", "arg"))


def _is_stored(op: Op, readers: list[Op], sites: int) -> bool:
    if not _is_fusible(op) or not all(_absorbs(reader) for reader in readers):
        return True
    spread = any(reader.name == "broadcast_in_dim" for reader in readers)
    return op.name in DEAR and (sites > 1 or spread)


def _reuses(op: Op) -> bool:
    if op.name in MOVES:
        return False
    return _is_fusible(op) or op.name in ("scan", "while", "dynamic_update_slice")


def _held(weight: float, op: Op, aval) -> Held:
    return Held(weight, op.name, f"{getattr(aval, 'dtype', '')}{list(aval.shape)}", op.scope)


def _scan_ends(params: dict) -> tuple[int, int]:
    """Where a scan's inputs become those it walks over, and where its outputs become those it collects."""
    if "ft_in" in params:  # JAX 0.12: a tree of constants, carried values and what is walked over
        constants, carried = (len(part) for part in params["ft_in"].unpack()[:2])
    else:
        constants, carried = params["num_consts"], params["num_carry"]
    return constants + carried, carried


def _inside(op: Op, weigh: Callable[[Any, str], float]) -> Peak:
    """The peak within one turn of a loop or one branch, beside what goes in and comes out."""
    found = []
    for inner in op.bodies:
        if op.name != "scan":
            found.append(peak(inner, weigh, elsewhere=inner.inputs))
            continue
        kept, count = _scan_ends(op.params)
        carried, ys = inner.outputs[:count], inner.outputs[count:]
        ops = _with_slices(inner.ops, inner.inputs[kept:], op.scope)
        ops += [Op("dynamic_update_slice", (v,), (), {}, (), op.scope) for v in dict.fromkeys(ys)]
        inner = inner._replace(ops=_sooner(ops), outputs=carried)
        found.append(peak(inner, weigh, elsewhere=inner.inputs[:kept]))
    return max(found, key=lambda one: one.bytes)


def _with_slices(ops: list[Op], scanned: Sequence[int], scope: str) -> list[Op]:
    """A turn's share of what a scan walks over is cut out where it is first read."""
    waiting, out = set(scanned), []
    for op in ops:
        for v in op.reads:
            if v in waiting:
                waiting.remove(v)
                out.append(Op("dynamic_slice", (), (v,), {}, (), scope))
        out.append(op)
    return out


def _sooner(ops: list[Op]) -> list[Op]:
    """Writes of a scan's results directly after what they write."""
    writers = {op.reads[0]: op for op in ops if not op.writes}
    out = []
    for op in ops:
        if op.writes:
            out.append(op)
            out += [writers.pop(v) for v in op.writes if v in writers]
    return out + list(writers.values())
