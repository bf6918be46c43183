"""What a compiled module does, read from its text: products, kernels of libraries, collectives, large results.

Loops count as often as they turn (the compiler of GPUs writes how often). FLOPs are those of `dot`, of convolutions,
and of products and attention that libraries do; bytes of a collective are those of its larger side on one device.
"""

import collections
import dataclasses
import math
import re
from collections.abc import Iterator
from typing import NamedTuple

BYTES = {
    **dict.fromkeys(("pred", "s4", "u4", "s8", "u8", "f8e4m3fn", "f8e5m2"), 1),
    **dict.fromkeys(("bf16", "f16", "s16", "u16"), 2),
    **dict.fromkeys(("f32", "s32", "u32"), 4),
    **dict.fromkeys(("f64", "s64", "u64", "c64"), 8),
}
COLLECTIVES = (
    "all-gather",
    "all-reduce",
    "reduce-scatter",
    "all-to-all",
    "collective-permute",
)
_ARRAY = re.compile(rf"\b({'|'.join(BYTES)})\[([0-9,]*)\]")
_INSTRUCTION = re.compile(r"^(?:ROOT )?%?([\w.\-]+) = (\(.*?\)|[^ ]+) ([\w\-]+)\((.*)$")
_HEAD = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .* \{$")
# Instructions that make no array of their own.
_NAMES = ("parameter", "get-tuple-element", "tuple", "while", "bitcast", "conditional", "call")


class Array(NamedTuple):
    dtype: str
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        return BYTES[self.dtype] * math.prod(self.shape)


class Instruction(NamedTuple):
    name: str
    results: tuple[Array, ...]
    op: str
    operands: tuple[str, ...]
    line: str


@dataclasses.dataclass
class Summary:
    """Of one run on one device."""

    flops: dict[str, float]  # by the dtype of the inputs
    kernels: dict[str, int]  # calls of libraries by name
    collectives: dict[str, float]  # bytes by kind
    largest_gather: int  # bytes that one all-gather makes
    results: dict[Array, int]  # how often an array of this kind is written to memory
    unknown_loops: list[str]  # loops without a known number of turns: counted once

    @property
    def all_flops(self) -> float:
        return sum(self.flops.values())


def arrays(text: str) -> tuple[Array, ...]:
    """The arrays that a shape names: one, or those of a tuple."""
    found = _ARRAY.findall(text)
    return tuple(Array(kind, tuple(int(x) for x in d.split(",") if x)) for kind, d in found)


def computations(text: str) -> tuple[dict[str, list[Instruction]], str]:
    """({name: instructions}, the name of the entry) of a module."""
    found: dict[str, list[str]] = {}
    lines: list[str] | None = None
    entry = ""
    for line in text.splitlines():
        if head := _HEAD.match(line):
            lines = found.setdefault(head[2], [])
            entry = head[2] if head[1] else entry
        elif line.rstrip() == "}":
            lines = None
        elif lines is not None and line.startswith(" "):
            lines.append(line.strip())
        elif lines:  # attributes that go over several lines
            lines[-1] += " " + line.strip()
    return {name: list(map(_instruction, filter(_INSTRUCTION.match, x))) for name, x in found.items()}, entry  # fmt: skip


def _instruction(line: str) -> Instruction:
    match = _INSTRUCTION.match(line)
    assert match is not None
    name, shape, op, rest = match.groups()
    depth = end = 0
    for end, c in enumerate(rest):  # noqa: B007
        depth += (c == "(") - (c == ")")
        if depth < 0:
            break
    operands = tuple(re.findall(r"%([\w.\-]+)", rest[:end]))
    return Instruction(name, arrays(shape), op, operands, line)


def summary(text: str) -> Summary:
    """Sums over a module of one device."""
    bodies, entry = computations(text)
    flops: collections.Counter = collections.Counter()
    kernels: collections.Counter = collections.Counter()
    moved: collections.Counter = collections.Counter()
    results: collections.Counter = collections.Counter()
    unknown, gathered = [], 0
    for times, inside, one, others, turns in _walk(bodies, entry):
        if one.op == "while" and turns is None:
            unknown.append(one.name)
        kind = one.op.removesuffix("-start")
        dtype, work = _work(one, others)
        flops[dtype] += times * work
        if inside:
            continue
        if kind in COLLECTIVES:
            # A start returns its input beside its result.
            halves = [sum(x.bytes for x in one.results), *(_bytes(n, others) for n in one.operands)]
            size = max(x.bytes for x in one.results) if kind != one.op else max(halves)
            moved[kind] += times * size
            if kind == "all-gather":
                gathered = max(gathered, size)
        if called := _library(one):
            kernels[called] += times
        if one.op not in _NAMES:
            for x in one.results:
                results[x] += times
    del flops[""]
    return Summary(dict(flops), dict(kernels), dict(moved), gathered, dict(results), unknown)


def _walk(bodies, entry, times=1, inside=False) -> Iterator[tuple]:
    """(how often it runs, whether inside a fusion, instruction, its neighbours by name, turns of a loop)."""
    others = {one.name: one for one in bodies.get(entry, ())}
    for one in others.values():
        turns: int | None = 1
        if one.op == "while":
            known = re.search(r"known_trip_count[^0-9]*(\d+)", one.line)
            turns = int(known[1]) if known else None
        yield times, inside, one, others, turns
        if one.op == "while":
            yield from _walk(bodies, _named("body", one.line), times * (turns or 1), inside)
        elif one.op == "fusion":
            yield from _walk(bodies, _named("calls", one.line), times, True)
        elif one.op in ("call", "async-start"):
            for key in ("to_apply", "calls", "called_computation"):
                if name := _named(key, one.line):
                    yield from _walk(bodies, name, times, inside)
        elif one.op == "conditional":
            branches = re.search(r"branch_computations=\{([^}]*)\}", one.line)
            names = (
                branches[1].split(",")[:1] if branches else [_named("true_computation", one.line)]
            )
            for name in names:  # one of them runs
                yield from _walk(bodies, name.strip().lstrip("%"), times, inside)


def _named(key: str, line: str) -> str:
    found = re.search(rf"\b{key}=%?([\w.\-]+)", line)
    return found[1] if found else ""


def _bytes(name: str, others) -> int:
    return sum(x.bytes for x in others[name].results) if name in others else 0


def _library(one: Instruction) -> str:
    found = re.search(r'custom_call_target="([^"]*)"', one.line)
    return found[1] if found and one.op == "custom-call" else ""


def _work(one: Instruction, others) -> tuple[str, float]:
    """(dtype of the inputs, FLOPs) of a product, a convolution or an attention; ('', 0) of anything else."""
    first = [
        others[name].results[0] for name in one.operands if name in others and others[name].results
    ]
    if one.op == "dot" and first:
        axes = re.search(r"lhs_contracting_dims=\{([0-9,]*)\}", one.line)
        summed = math.prod(first[0].shape[int(i)] for i in axes[1].split(",") if i) if axes else 1
        return first[0].dtype, 2.0 * math.prod(one.results[0].shape) * summed
    called = _library(one)
    if called.startswith("__cublas") and first:
        axis = re.search(r'lhs_contracting_dimensions":\s*\["?(\d+)', one.line)
        summed = first[0].shape[int(axis[1])] if axis else 1
        return first[0].dtype, 2.0 * math.prod(
            one.results[0].shape
        ) * summed  # beside it: workspace
    if "fmha" in called and first:
        scores = re.search(r'"dimensions":\s*\[([^\]]*)\]', one.line)
        size = math.prod(int(x) for x in re.findall(r"\d+", scores[1])) if scores else 0
        products = 5 if "Backward" in called else 2
        return first[0].dtype, 2.0 * products * size * first[0].shape[-1]
    labels = re.search(r"dim_labels=(\w+)_(\w+)->(\w+)", one.line)
    if labels and len(first) > 1 and (one.op == "convolution" or "conv" in called):
        kernel = first[1]
        summed = math.prod(kernel.shape) / kernel.shape[labels[2].index("o")]
        return first[0].dtype, 2.0 * math.prod(one.results[0].shape) * summed
    return "", 0.0
