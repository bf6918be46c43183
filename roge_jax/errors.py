"""Errors meant for users: one sentence that says what was given, what is allowed, what to do."""

import difflib
from collections.abc import Iterable


class UserError(ValueError):
    """A mistake in the input. Entry points print its one sentence and exit with code 2."""


class UnsafeFile(UserError):
    """A file that tries to execute code. A whole run stops for it: whoever made it may have made the others."""


class OutputError(RuntimeError):
    """What was computed could not be written whole. Its one sentence says what stays, where, and how to go on; exit code 1."""


class LimitWarning(UserWarning):
    """Photos or a path lie beyond what the model was measured to stand (`limits`); the result may be poor."""


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """A sentence fragment listing `options`, led by the closest one to `word` if any is close."""
    options = sorted(options)
    by_lower = {option.lower(): option for option in reversed(options)}
    close = difflib.get_close_matches(str(word).lower(), by_lower, n=1, cutoff=0.5)
    hint = f"did you mean '{by_lower[close[0]]}'? " if close else ""
    return f"{hint}Allowed: {', '.join(options)}."
