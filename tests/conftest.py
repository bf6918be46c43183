"""Test-suite settings. The environment is set before JAX is imported; settings made outside win.

What runs: the fast suite by default; `-m slow`, `-m parity` (or a test named by its node id) selects the rest. Tests on
developer data look for `ROGE_DEV_DATA`, a folder with `parity/`, `scenes/` and `weights/`, and skip with that reason without it.
"""

import os
import sys
from pathlib import Path

import pytest
import quick_xla

ROOT = Path(__file__).parent.parent

HOST_DEVICES = 8

assert "jax" not in sys.modules, "a pytest plugin imported jax before its settings were made"

_SETTINGS = {
    "JAX_PLATFORMS": "cpu",
    "JAX_NUMPY_RANK_PROMOTION": "raise",  # broadcasting is written out in this code base
    "JAX_DEFAULT_MATMUL_PRECISION": "highest",
    "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".jax_cache" / "tests"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    "OPENBLAS_NUM_THREADS": "1",
    "MPLBACKEND": "Agg",
}
_XLA_FLAGS = quick_xla.FLAGS | {quick_xla.DEVICES: str(HOST_DEVICES)}

for name, value in _SETTINGS.items():
    os.environ.setdefault(name, value)
given = os.environ.get("XLA_FLAGS", "")
missing = {flag: value for flag, value in _XLA_FLAGS.items() if flag not in given}
os.environ["XLA_FLAGS"] = f"{given} {quick_xla.spelled(missing)}".strip()


def pytest_configure(config):
    from hypothesis import settings

    # The first example compiles, so times of single examples say nothing.
    settings.register_profile("roge", deadline=None, database=None, derandomize=True)
    settings.load_profile("roge")


def pytest_collection_modifyitems(config, items):
    """Leave out `slow` and `parity` tests unless a mark expression or a node id asks for them."""
    if config.option.markexpr or any("::" in str(arg) for arg in config.invocation_params.args):
        return
    chosen, left = [], []
    for item in items:
        extra = item.get_closest_marker("slow") or item.get_closest_marker("parity")
        (left if extra else chosen).append(item)
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = chosen


@pytest.fixture(scope="session")
def dev_data() -> Path:
    """The optional developer data; skips the test without it."""
    from parity import dev_data as given

    if (root := given()) is None:
        pytest.skip(
            "needs developer data (too large for the repository): set ROGE_DEV_DATA to its folder"
        )
    return root


@pytest.fixture(scope="module", autouse=True)
def _programs_of_one_file():
    """What a file compiled goes when it ends: programs of all files together take gigabytes in every process."""
    yield
    if "jax" in sys.modules:
        import jax

        jax.clear_caches()


@pytest.fixture(scope="module")
def common():
    """Options of a short training run of `tiny`, see `train_runs.quick_tiny`."""
    from train_runs import quick_tiny

    with quick_tiny() as options:
        yield options


@pytest.fixture
def cheap(monkeypatch):
    """Training runs compile next to nothing, see `train_runs.make_cheap`."""
    from train_runs import make_cheap

    make_cheap(monkeypatch)
