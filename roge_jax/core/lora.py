"""Low-rank adaptation as a sparse second tree with the paths of the first.

`attach` puts the two factors beside the kernel they adapt, and `layers.linear` adds the branch x @ a @ b; a path that
is absent costs nothing. Training differentiates the LoRA tree alone, so frozen kernels never get a weight gradient.
"""

import re

import jax.numpy as jnp
import numpy as np

from .params import Spec, Tree, flatten, unflatten, uniform, zeros


def _kaiming_uniform(rng, shape, dtype):
    return uniform(1.0 / np.sqrt(shape[-2]))(rng, shape, dtype)


def lora_specs(specs, rank: int, match: str) -> Tree:
    """LoRA leaves `lora_a` [.., d_in, rank] and `lora_b` [.., rank, d_out] for every kernel whose path matches.

    `match` is a regular expression for the path of the linear layer, without `/kernel`. Convolution kernels
    [kh, kw, c_in, c_out] are adapted as linear maps of their unfolded patches. alpha = rank, so the scale is 1.
    """
    lora = {}
    for path, spec in flatten(specs).items():
        layer, _, leaf = path.rpartition("/")
        if leaf != "kernel" or not re.search(match, layer):
            continue
        lead = 1 if spec.axes[0] == "layers" else 0
        *ins, d_out = spec.shape[lead:]
        axes, head, head_axes = spec.axes, spec.shape[:lead], spec.axes[:lead]
        in_axis = axes[lead] if len(ins) == 1 else None
        lora[f"{layer}/lora_a"] = Spec(
            (*head, int(np.prod(ins)), rank), (*head_axes, in_axis, None), _kaiming_uniform
        )
        lora[f"{layer}/lora_b"] = Spec((*head, rank, d_out), (*head_axes, None, axes[-1]), zeros)
    return unflatten(lora)


def attach(params, lora) -> Tree:
    """`params` with the factors of `lora` beside the kernels they adapt."""
    return unflatten(flatten(params) | flatten(lora or {}))


def merge(params, lora) -> Tree:
    """`params` with every adapted kernel replaced by kernel + a @ b (for inference)."""
    flat, factors = flatten(params), flatten(lora or {})
    for path in factors:
        layer, _, leaf = path.rpartition("/")
        if leaf == "lora_a":
            a, b = factors[path], factors[f"{layer}/lora_b"]
            flat[f"{layer}/kernel"] = merged(flat[f"{layer}/kernel"], a, b)
    return unflatten(flat)


def merged(kernel, a, b):
    """kernel + a @ b of one layer, or of a stack of them, in the type of the kernel."""
    delta = jnp.matmul(a, b, precision="highest").reshape(kernel.shape)
    return (kernel.astype(jnp.float32) + delta).astype(kernel.dtype)
