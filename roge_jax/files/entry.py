"""What every program shares: one sentence for a mistake, a compilation cache, run.json, whole output folders.

    if __name__ == "__main__":
        run(main, parser())         # main(args: argparse.Namespace) -> exit code or anything else for 0

Exit codes: 0 fine, 1 the computation stopped (not finite, out of budget), 2 a mistake in the input, 130 interrupted.
This module imports neither JAX nor NumPy, so that a program can still choose its devices.
"""

import argparse
import contextlib
import datetime
import errno
import hashlib
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ..errors import OutputError, UserError, did_you_mean

_PACKAGE = __package__.partition(".")[0]

CACHE_VARIABLE = "ROGE_CACHE"  # a folder for compiled programs, or "off"
DEBUG_VARIABLE = "ROGE_DEBUG"  # 1: nothing is compiled, and mistakes show where they come from
LESS = "ask for less, e.g. fewer frames or photos or a smaller size (--dry-run tells what a run needs)."
REMEDIES = {
    errno.ENOSPC: "free some space or give another --out",
    errno.EDQUOT: "free some space or give another --out",
    errno.ENOENT: "check the name",
    errno.EACCES: "ask for the right to use it or give another place",
    errno.ENAMETOOLONG: "give a shorter name",
}
PACKAGES = (
    "roge_jax",
    "jax",
    "jaxlib",
    "flax",
    "numpy",
    "av",
    "opencv-contrib-python-headless",
    "pillow",
)


# ---- running a program ---------------------------------------------------------------------------


def run(
    main: Callable[[argparse.Namespace], Any],
    parser: argparse.ArgumentParser,
    arguments: Sequence[str] | None = None,
) -> NoReturn:
    """`execute`, then leave the process with its exit code."""
    sys.exit(execute(main, parser, arguments))


def execute(
    main: Callable[[argparse.Namespace], Any],
    parser: argparse.ArgumentParser,
    arguments: Sequence[str] | None = None,
) -> int:
    """Parse `arguments` (default: the command line), call main, and turn its errors into the exit code.

    Mistakes are one sentence on stderr; `--debug`, if the parser has it, shows the traceback as well. An integer
    that `main` returns is the exit code. Warnings are printed as one line each.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments or step_through()
    for stream in (sys.stdout, sys.stderr):  # a name that the terminal cannot show is escaped
        with contextlib.suppress(AttributeError, ValueError, OSError):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)  # sentences for the user
        warnings.showwarning = _one_line
        try:
            args = parse(parser, arguments)
            enable_cache()
            code = main(args)
            return code if isinstance(code, int) else 0
        except UserError as error:
            return _report(error, 2, debug)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130
        except BrokenPipeError:  # `| head` has read enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except OSError as error:
            if error.errno is None:  # not the system's: a fault of the program
                raise
            return _report(UserError(system_sentence(error)), 2, debug)
        except MemoryError as error:
            return _report(UserError(f"Out of memory ({error}): {LESS}"), 1, debug)
        except OutputError as error:
            return _report(error, 1, debug)
        except RuntimeError as error:
            if "RESOURCE_EXHAUSTED" in str(error) or "Out of memory" in str(error):  # XLA's words
                first = str(error).splitlines()[0]
                return _report(UserError(f"Out of memory ({first}): {LESS}"), 1, debug)
            if (missing := _missing_platform()) is not None:
                return _report(missing, 2, debug)
            if not isinstance(error, _expected_stops()):
                raise
            return _report(error, 1, debug)
        except AssertionError:  # JAX's own, where a platform's plugin finds no device
            if (missing := _missing_platform()) is None:
                raise
            return _report(missing, 2, debug)


def step_through() -> bool:
    """Whether ROGE_DEBUG asks for it; JAX then compiles nothing and runs loops in Python (`core.stepping`)."""
    if os.environ.get(DEBUG_VARIABLE, "0") in ("", "0"):
        return False
    os.environ["JAX_DISABLE_JIT"] = "1"
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_disable_jit", True)
    return True


def _missing_platform() -> UserError | None:
    """What to say if JAX_PLATFORMS (or its older name) asks for a platform that this machine or installation lacks."""
    name = next((n for n in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME") if os.environ.get(n)), None)
    if name is None or "jax" not in sys.modules:
        return None
    try:
        sys.modules["jax"].devices()
    except (RuntimeError, AssertionError):
        return UserError(
            f"{name}={os.environ[name]}: JAX finds no such device here: unset it, or set it to cpu, or install JAX for "
            "that device."
        )
    return None


def system_sentence(error: OSError) -> str:
    """What the operating system refused: a full disk, a missing right, a name too long."""
    name = str(error.filename or "The system")
    name = name if len(name) <= 200 else f"{name[:60]}...{name[-20:]}"
    return f"{name}: {error.strerror}: {REMEDIES.get(error.errno or 0, 'give another place')}."


def parse(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parsed arguments. Raises UserError, with the closest option, where argparse would print its usage and exit."""

    def error(message: str) -> NoReturn:
        raise UserError(f"{message[:1].upper()}{message[1:]}; --help explains all options.")

    parsers = [parser]
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            parsers += action.choices.values()
    for one in parsers:
        one.allow_abbrev = False
        one.error = error  # type: ignore[method-assign]
    args, unknown = parser.parse_known_args(list(arguments))
    if unknown:
        actions = [action for one in parsers for action in one._actions]
        options = [name for action in actions for name in action.option_strings if name[:2] == "--"]
        word = unknown[0].partition("=")[0]
        if word.startswith("-"):
            raise UserError(f"Unknown option '{word}': {did_you_mean(word, options)}")
        raise UserError(f"'{word}' belongs to no option: {did_you_mean('--' + word, options)}")
    return args


def one_of(options: Iterable[str]) -> Callable[[str], str]:
    """An argparse `type` that takes these words and names the closest one for any other."""
    options = tuple(options)

    def check(word: str) -> str:
        if word not in options:
            raise argparse.ArgumentTypeError(
                f"unknown value '{word}': {did_you_mean(word, options).rstrip('.')}"
            )
        return word

    return check


def number(
    low: float | None = None, high: float | None = None, *, whole: bool = True
) -> Callable[[str], Any]:
    """An argparse `type` for numbers of at least `low` and at most `high`."""

    def check(text: str) -> float:
        kind = "whole number" if whole else "number"
        bound = "" if low is None else f" of at least {low:g}"
        bound += "" if high is None else f"{' and' if bound else ' of'} at most {high:g}"
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            value = None
        if (
            value is None
            or value != value
            or abs(value) == float("inf")
            or (low is not None and value < low)
            or (high is not None and value > high)
        ):
            raise argparse.ArgumentTypeError(f"'{text}' is not a {kind}{bound}")
        return value

    return check


def size_of(text: str) -> tuple[int, int]:
    """An argparse `type` for HEIGHTxWIDTH."""
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise argparse.ArgumentTypeError(
            f"'{text}' is no size: write HEIGHTxWIDTH in pixels, e.g. 192x336"
        )
    return int(height), int(width)


def _expected_stops() -> tuple[type[BaseException], ...]:
    """Errors that mean the computation ended early, not that the program is wrong. Imported only once one is raised."""
    found = []
    for module, name in (
        ("video.solve_info", "SamplingError"),
        ("training.loop", "TrainingStopped"),
    ):
        loaded = sys.modules.get(f"{_PACKAGE}.{module}")
        if loaded is not None:
            found.append(getattr(loaded, name))
    return tuple(found)


def _report(error: BaseException, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exception(error)
    else:
        print(f"error: {error}", file=sys.stderr)
    return code


def _one_line(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"warning: {message}", file=sys.stderr)


# ---- compiled programs are kept ------------------------------------------------------------------


def cache_folder() -> Path | None:
    """Where compiled programs are kept: ROGE_CACHE, or the user's cache folder; None if ROGE_CACHE is "off" or there is no home.

    One folder per kind of processor: a program compiled for one may not run on another that shares the disk.
    """
    given = os.environ.get(CACHE_VARIABLE, "")
    if given.lower() in ("off", "0", "no"):
        return None
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    except RuntimeError:  # a user without a home and without an entry among the users
        if not given:
            return None
        cache = Path()
    base = Path(given) if given else cache / "roge_jax"
    return base / f"programs-{_processor()}"


def _processor() -> str:
    text = platform.machine() + platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        said = cpuinfo.read_text(encoding="utf-8")
        text += "".join(re.findall(r"^(?:model name|flags)\s*:.*$", said, re.M)[:2])
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def enable_cache() -> Path | None:
    """Keep every compiled program on disk, so that the next run starts faster. JAX's own setting has precedence."""
    folder = cache_folder()
    if folder is None or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError
    except OSError:
        warnings.warn(
            f"compiled programs are not kept: cannot write to {folder} (set {CACHE_VARIABLE})",
            stacklevel=2,
        )
        return None
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    if "jax" in sys.modules:
        for name, value in settings.items():
            sys.modules["jax"].config.update(name, value)
    else:
        os.environ |= {name.upper(): str(value) for name, value in settings.items()}
    return folder


# ---- what a run was ------------------------------------------------------------------------------


class Clock:
    """Seconds and peak memory of the stages of a run.

        with clock("load"): ...
        clock.record()      {"load": {"seconds": 1.2, "peak_memory_gb": 0.8}, ..}

    Memory is the process's peak so far (host) and that of the first accelerator; a stage entered twice adds up.
    """

    def __init__(self):
        self.start = time.perf_counter()
        self.stages: dict[str, dict[str, float]] = {}

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            stage = self.stages.setdefault(name, {"seconds": 0.0})
            stage["seconds"] += time.perf_counter() - begin
            stage |= peak_memory()

    def record(self) -> dict[str, Any]:
        """{stage: {"seconds", "peak_memory_gb", ..}}, and `total` since the clock was made."""
        total = {"seconds": time.perf_counter() - self.start} | peak_memory()
        stages = {**self.stages, "total": total}
        return {name: {k: round(v, 3) for k, v in stage.items()} for name, stage in stages.items()}


def peak_memory() -> dict[str, float]:
    """Peak memory in GB (1e9 bytes): of this process, and of the first device where JAX reports it."""
    found = {}
    status = Path("/proc/self/status")
    if (
        status.exists()
    ):  # Linux; its ru_maxrss starts from that of the program that started this one
        line = next(
            x for x in status.read_text(encoding="utf-8").splitlines() if x.startswith("VmHWM")
        )
        found["peak_memory_gb"] = int(line.split()[1]) * 1024 / 1e9
    else:
        with contextlib.suppress(ImportError):  # no such module on Windows
            import resource

            unit = 1 if sys.platform == "darwin" else 1024
            usage = resource.getrusage(resource.RUSAGE_SELF)
            found["peak_memory_gb"] = usage.ru_maxrss * unit / 1e9
    if "jax" in sys.modules:
        stats = sys.modules["jax"].local_devices()[0].memory_stats() or {}
        if "peak_bytes_in_use" in stats:
            found["device_peak_memory_gb"] = stats["peak_bytes_in_use"] / 1e9
    return found


def version() -> str:
    """The package's own, of the code that runs, installed or not."""
    return sys.modules[_PACKAGE].__version__


def environment() -> dict[str, Any]:
    """Versions, devices, git commit and command: the part of run.json that is the same for every program."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    found: dict[str, Any] = {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": versions,
        "platform": platform.platform(),
        "commit": git_commit(),
    }
    if "jax" in sys.modules:
        devices = sys.modules["jax"].devices()
        found["device"] = {
            "backend": devices[0].platform,
            "kind": devices[0].device_kind,
            "count": len(devices),
        }
    return found


def git_commit(folder: Path | None = None) -> str | None:
    """The commit of the package's own checkout ("-dirty" if tracked files differ), None for an installed package."""
    folder = folder or Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None
    try:
        call = [
            "git",
            "-C",
            str(folder),
            "describe",
            "--always",
            "--dirty",
            "--abbrev=12",
            "--exclude=*",
        ]
        return subprocess.run(
            call, capture_output=True, text=True, timeout=5, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
