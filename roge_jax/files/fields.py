"""What people write in files, read with checks: every mistake is one sentence that names the file and the field."""

import json
import math
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np

from ..errors import UserError


def read_text(file: Path, what: str = "file") -> str:
    """A text file in UTF-8, with or without the mark that Windows programs put in front."""
    try:
        return Path(file).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UserError(f"{file}: cannot read the {what} ({error.strerror}).") from None
    except ValueError as error:  # other encodings; a name with a NUL in it
        raise UserError(
            f"{file}: cannot read the {what}, it is no UTF-8 text ({error}): save it as UTF-8."
        ) from None


def read_json(file: Path, what: str = "file") -> Any:
    """The content of a JSON file."""
    text = read_text(file, what)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{file}: not valid JSON ({error}): write the {what} again.") from None


def is_file(place: Path) -> bool:
    """Whether there is such a file; False, too, for names that no file can have."""
    try:
        return place.is_file()
    except (OSError, ValueError):
        return False


def exists(place: Path) -> bool:
    """Whether there is such a file or folder; False, too, for names that nothing can have."""
    try:
        return place.exists()
    except (OSError, ValueError):
        return False


def number(
    value: Any, where: str, name: str, *, low: float | None = None, whole: bool = False
) -> Any:
    """`value` as a float, or as an int if `whole`. Without `low` and `whole`, NaN and infinity pass.

    Raises: UserError "WHERE: 'NAME' is VALUE: give ..".
    """
    try:
        found = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    given = isinstance(value, float) and math.isnan(value)
    bad = math.isnan(found) and not given
    if low is not None or whole:
        bad = not math.isfinite(found) or (low is not None and found < low)
    if bad or (whole and found != int(found)):
        kind = "a whole number" if whole else "a number"
        bound = "" if low is None else f" of at least {low:g}"
        raise UserError(f"{where}: '{name}' is {_short(value)}: give {kind}{bound}.")
    return int(found) if whole else found


def matrix(value: Any, shape: tuple[int, ...], where: str, name: str) -> np.ndarray:
    """`value` (nested lists or an array of numbers) as float64 of `shape`; NaN and infinity pass."""
    try:
        found = np.asarray(value)
        if found.dtype.kind not in "iufU":
            raise TypeError
        found = found.astype(np.float64)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape != shape:
        size = "x".join(map(str, shape)) + " matrix" if len(shape) > 1 else f"list of {shape[0]}"
        form = f" of shape {found.shape}" if found.size else ""
        raise UserError(
            f"{where}: '{name}' is {_short(value)}{form}: give a {size}{'' if len(shape) > 1 else ' numbers'}."
        )
    return found


def _short(value: Any) -> str:
    text = repr(value).replace("\n", " ")
    return text if len(text) <= 60 else f"{text[:57]}..."


def fits(value, hint) -> bool:
    """Whether a value read from JSON is of the kind that a field's type hint asks for; whole numbers are not negative."""
    kind, arguments = get_origin(hint), get_args(hint)
    if kind is Literal:
        return value in arguments and not isinstance(value, bool)
    if kind is tuple:
        return (
            isinstance(value, tuple)
            and len(value) > 0
            and all(fits(x, arguments[0]) for x in value)
        )
    if kind is not None:  # a union
        return any(fits(value, option) for option in arguments)
    if hint is float:
        return (
            isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        )
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool) and value >= 0
    return isinstance(value, hint)


def described(hint) -> str:
    """What a type hint asks for, in words."""
    kind, arguments = get_origin(hint), get_args(hint)
    if kind is Literal:
        return "one of " + ", ".join(map(str, arguments))
    if kind is tuple:
        return f"a list, of each {described(arguments[0])}"
    if kind is not None:
        return " or ".join(described(option) for option in arguments)
    words = {
        int: "a whole number of at least 0",
        float: "a number",
        bool: "true or false",
        str: "a word",
    }
    return words.get(hint, "null")
