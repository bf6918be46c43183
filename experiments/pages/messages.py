"""Every sentence that a program can say about a mistake, from the code itself: docs/reference/messages.md.

        python -m experiments.pages.messages

Sentences are built as "what is wrong: what to do", so cause and cure are read from them. What a sentence fills in
stands in angle brackets. Seconds. `make docs` runs it, and a test holds the committed page against it.
"""

import ast
import itertools
import re
from collections.abc import Iterator
from typing import NamedTuple

from experiments import harness

PAGE = harness.DOCS / "reference" / "messages.md"
PACKAGE = harness.ROOT / "roge_jax"
HEAD = """# Messages

Find your message here by a few of its words. What depends on your input stands in ⟨brackets⟩.
A mistake ends a program with exit code 2.
`--debug` adds where in the code it comes from.
This page is written from the code by `python -m experiments.pages.messages`.

Messages are sorted by where they are raised. A *warning* lets the program go on. A *stop* ends a computation that had
begun, with exit code 1.
"""
# What each room is about, in the words of a reader.
ROOMS = {
    "": "Programs, models, configuration",
    "files": "Command lines, files, folders",
    "scenes": "Photos, poses, path files",
    "geometry": "Cameras and preset paths",
    "sampling": "Making a video",
    "planning": "Planning",
    "video": "Samplers and video codecs",
    "data": "Training data",
    "procedural": "Rendered scenes",
    "training": "Training",
    "core": "Devices, memory, parameters",
    "weights": "Published weights",
    "metrics": "Metrics",
}
KINDS = {  # calls that make a sentence: which arguments are what is wrong and what to do
    "UserError": ("error", (0,)),
    "ArgumentTypeError": ("error", (0,)),
    "SamplingError": ("stop", (0,)),
    "TrainingStopped": ("stop", (0,)),
    "ReferenceRejected": ("stop", (0,)),
    "Finding": ("either", (2, 3)),
    "found": ("either", (1, 2)),  # a Finding of `geometry.validation`
    "note": ("warning", (0, 1)),
    "report": ("warning", (2, 3)),
    "entry": ("warning", (3, 4)),
    "Beyond": ("warning", (3,)),
    "warn": ("warning", (0,)),
}
CLOSEST = "the closest allowed word, and all that are allowed"


class Message(NamedTuple):
    kind: str
    cause: str
    cure: str
    file: str


def messages() -> list[Message]:
    """All of the package, without those that only pass another's words on."""
    found: list[Message] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        found += of_a_file(ast.parse(path.read_text()), path.relative_to(PACKAGE).as_posix())
    return sorted(set(found), key=lambda one: (one.file, one.cause.lower(), one.cure))


def of_a_file(tree: ast.Module, file: str) -> Iterator[Message]:
    constants = assignments(tree.body)
    for scope in scopes(tree):
        local, last = assignments(ast.walk(scope)), 0
        for call in sorted(calls(scope), key=lambda call: call.lineno):
            hidden = parameters(scope, call)
            seen = {name: values for name, values in local.items() if name not in hidden}
            yield from sentences(call, constants, seen, last, file)
            last = call.lineno


def scopes(tree: ast.AST) -> Iterator[ast.AST]:
    """Functions at the top and methods; functions inside them belong to them."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
        elif isinstance(node, ast.ClassDef):
            yield from scopes(node)


def assignments(nodes: object) -> dict[str, list[ast.expr]]:
    """What is assigned to each name."""
    found: dict[str, list[ast.expr]] = {}
    for node in nodes:  # type: ignore[attr-defined]
        if not isinstance(node, ast.Assign):
            continue
        for target in node.targets:
            if isinstance(target, ast.Name):
                found.setdefault(target.id, []).append(node.value)
            elif isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                for one, value in zip(target.elts, node.value.elts, strict=False):
                    if isinstance(one, ast.Name):
                        found.setdefault(one.id, []).append(value)
    return found


def calls(scope: ast.AST) -> Iterator[ast.Call]:
    for node in ast.walk(scope):
        if isinstance(node, ast.Call) and called(node) in KINDS:
            yield node


def parameters(scope: ast.AST, call: ast.Call) -> set[str]:
    """Of the functions inside of `scope` that the call stands in: they hide what is assigned outside."""
    inside = [
        node for node in ast.walk(scope) if isinstance(node, ast.FunctionDef) and node is not scope
    ]
    around = [node for node in inside if any(one is call for one in ast.walk(node))]
    return {arg.arg for node in around for arg in ast.walk(node.args) if isinstance(arg, ast.arg)}


def called(node: ast.Call) -> str:
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


Names = dict[str, list[ast.expr]]


def sentences(
    call: ast.Call, constants: Names, local: Names, last: int, file: str
) -> Iterator[Message]:
    """What one call can say: names stand for what was assigned to them since the call before, in line `last`."""
    kind, places = KINDS[called(call)]
    leading = [one for one in call.args if isinstance(one, ast.Constant) and one.value in SEVERITY]
    severity = [str(one.value) for one in leading]
    kind = SEVERITY[severity[0]] if severity else kind
    given = [call.args[i] for i in places if i < len(call.args)]
    if called(call) == "note" and severity and given[0] in leading:
        given = call.args[1:3]  # note(severity, what, fix)
    if not given:
        return
    before = {
        name: sorted((v for v in values if v.lineno <= call.lineno), key=lambda v: v.lineno)
        for name, values in local.items()
    }
    recent = {
        name: [value for value in values if value.lineno >= last] or values[-1:]
        for name, values in before.items()
        if values
    }
    names = constants | {name: values for name, values in local.items() if len(values) == 1}
    causes = variants(given[0], recent)
    fixes = variants(given[1], recent) if len(given) > 1 else []
    together = (
        zip(causes, fixes)
        if len(causes) == len(fixes)
        else itertools.product(causes, fixes or [None])
    )
    for what, fix in together:
        text = spelled(what, names)
        cause, cure = split(text) if fix is None else (text, spelled(fix, names))
        if words(f"{cause} {cure}"):
            yield Message(kind, cause, cure, file)


SEVERITY = {"error": "error", "warning": "warning", "note": "warning"}


def variants(node: ast.expr, local: Names) -> list[ast.expr]:
    """What a name or a choice may stand for."""
    if isinstance(node, ast.Name) and node.id in local:
        found = [one for value in local[node.id] for one in variants(value, {})]
        texts = [one for one in found if isinstance(one, ast.Constant | ast.JoinedStr | ast.BinOp)]
        return texts or [node]
    if isinstance(node, ast.IfExp):
        return [*variants(node.body, local), *variants(node.orelse, local)]
    return [node]


def spelled(node: ast.expr, constants: Names) -> str:
    """The sentence with what it fills in between brackets."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(
            spelled(part.value, constants)
            if isinstance(part, ast.FormattedValue)
            else spelled(part, constants)
            for part in node.values
        )
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add) and said(node):
        return spelled(node.left, constants) + spelled(node.right, constants)
    if isinstance(node, ast.IfExp) and said(node.body) and said(node.orelse):
        both = [spelled(node.body, constants), spelled(node.orelse, constants)]
        return f"⟨{' or '.join(filter(None, both))}⟩"
    if isinstance(node, ast.Subscript) and said(node.value):  # "s"[: n != 1]
        return f"({spelled(node.value, constants)})"
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult) and said(node.left):
        return f"({spelled(node.left, constants)})"  # "s" * (n != 1)
    if isinstance(node, ast.Name) and len(constants.get(node.id, [])) == 1:
        value = constants[node.id][0]
        text = isinstance(value, ast.Constant) and isinstance(value.value, str | int)
        if text or isinstance(value, ast.JoinedStr) or closest(value):
            return spelled(value, {name: v for name, v in constants.items() if name != node.id})
    if closest(node):
        return f"⟨{CLOSEST}⟩"
    return f"⟨{short(node)}⟩"


def said(node: ast.expr) -> bool:
    """Whether it is text that stands in the code."""
    if isinstance(node, ast.BinOp):
        return said(node.left) or said(node.right)
    text = isinstance(node, ast.Constant) and isinstance(node.value, str)
    return text or isinstance(node, ast.JoinedStr)


def short(node: ast.expr) -> str:
    """A name for a value: the last word of the expression that makes it."""
    if isinstance(node, ast.Name):
        return node.id.strip("_")
    if isinstance(node, ast.Attribute):
        return {"strerror": "reason"}.get(node.attr, node.attr.strip("_"))
    if isinstance(node, ast.Subscript):
        key = node.slice
        if isinstance(key, ast.Constant) and isinstance(key.value, str):
            return key.value
        return short(node.value)
    if isinstance(node, ast.Call):
        own = called(node)
        if own in (
            "join",
            "map",
            "min",
            "max",
            "sorted",
            "str",
            "list",
            "repr",
            "float",
            "rstrip",
            "abs",
        ):
            inner = [
                *node.args,
                *([node.func.value] if isinstance(node.func, ast.Attribute) else []),
            ]
            names = [short(one) for one in inner if not isinstance(one, ast.Constant)]
            return next((name for name in names if name not in ("", "...", "str")), "...")
        if own == "getattr" and isinstance(node.args[1], ast.Constant):
            return str(node.args[1].value)
        if own in ("len", "sum", "count"):
            return "number"
        if own == "type":
            return "type"
        return own.strip("_") or "..."
    if isinstance(node, ast.BinOp):
        return next((n for n in (short(node.left), short(node.right)) if n != "..."), "...")
    if isinstance(node, ast.GeneratorExp | ast.ListComp):
        return short(node.elt)
    if isinstance(node, ast.BoolOp):
        return short(node.values[0])
    if isinstance(node, ast.IfExp):
        return short(node.body) if not isinstance(node.body, ast.Constant) else short(node.orelse)
    if isinstance(node, ast.UnaryOp | ast.Starred):
        return short(node.operand if isinstance(node, ast.UnaryOp) else node.value)
    return "..."


def closest(node: ast.expr) -> bool:
    return isinstance(node, ast.Call) and any(
        isinstance(one, ast.Call) and called(one) == "did_you_mean" for one in ast.walk(node)
    )


def split(text: str) -> tuple[str, str]:
    """(what is wrong, what to do): at the last colon or semicolon, or where a second sentence begins."""
    for mark in (r": ", r"; ", r"(?<!e\.g)\. (?=[A-Z⟨])"):
        for place in reversed(list(re.finditer(mark, text))):
            head, tail = text[: place.start()], text[place.end() :]
            whole = all(tail.count(a) == tail.count(b) for a, b in ("()", "[]", "{}", "⟨⟩"))
            if words(head) and whole and tail.count("'") % 2 == 0 and len(tail) > 3:
                return head, tail.rstrip(".")
    return text.rstrip("."), ""


def words(text: str) -> int:
    """How many are said, without what is filled in."""
    return len(re.findall(r"[a-z]{2,}", re.sub(r"⟨[^⟩]*⟩", "", text)))


def room(file: str) -> str:
    return file.partition("/")[0] if "/" in file else ""


def cell(text: str) -> str:
    text = re.sub(r"\s+", " ", text).strip()
    return text.replace("|", r"\|").replace("<", "&lt;").replace("*", r"\*").replace("] [", r"] \[")


def page() -> str:
    found, lines = messages(), [HEAD]
    known = [*ROOMS, *sorted({room(one.file) for one in found} - set(ROOMS))]
    for name in known:
        rows = [one for one in found if room(one.file) == name]
        if not rows:
            continue
        title = ROOMS.get(name, name.capitalize())
        where = [
            f"[`{file}`](../../roge_jax/{file})" for file in sorted({one.file for one in rows})
        ]
        mark = {"error": "", "either": "*warning or error* "} | {
            kind: f"*{kind}* " for kind in ("warning", "stop")
        }
        table = ((f"{mark[one.kind]}{cell(one.cause)}", cell(one.cure)) for one in rows)
        lines += [
            f"## {title}",
            "",
            f"From {', '.join(where)}.",
            "",
            *harness.table(["message", "what to do"], table),
            "",
        ]
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
    print(PAGE.relative_to(harness.ROOT), len(messages()))
