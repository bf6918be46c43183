"""Leaf layers: pairs of `x_specs(sizes)` and `x(p, inputs)`. Channels last, leaf names as in Flax."""

import jax
import jax.numpy as jnp

from . import target
from .params import Spec, Tree, fan_in, ones, zeros
from .products import product


def lift(v: jax.Array, ndim: int) -> jax.Array:
    """A vector [d] as [1, .., 1, d] (implicit rank promotion is an error in this code base)."""
    return v.reshape((1,) * (ndim - 1) + v.shape)


def matmul(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """x [.., d_in] @ kernel [d_in, d_out], accumulated in float32; `core.products` says what it reads.

    The product is one of two matrices: XLA's CPU compiler transposes whole activations where the gradient of the
    kernel sums over several axes.
    """
    y = product(x.reshape(-1, x.shape[-1]), kernel)
    return y.reshape(*x.shape[:-1], y.shape[-1])


def linear_specs(d_in: int, d_out: int, axes=("embed", "mlp"), *, bias=True, init=None) -> Tree:
    """Kernel [d_in, d_out] with logical `axes`, and bias [d_out]."""
    specs = {"kernel": Spec((d_in, d_out), axes, init or fan_in())}
    return specs | ({"bias": Spec((d_out,), axes[1:], zeros)} if bias else {})


def linear(p: Tree, x: jax.Array) -> jax.Array:
    """x [.., d_in] -> float32 [.., d_out]; adds the low-rank branch if `p` carries one (see `core.lora`)."""
    y = matmul(x, p["kernel"])
    if "lora_a" in p:
        y = y + matmul(matmul(x, p["lora_a"]), p["lora_b"])
    return y + lift(p["bias"], y.ndim).astype(y.dtype) if "bias" in p else y


def norm_specs(d: int, *, bias=True) -> Tree:
    """Scale [d] and bias [d] of `layer_norm`; without bias, of `rms_norm`."""
    return {"scale": Spec((d,), (None,), ones)} | (
        {"bias": Spec((d,), (None,), zeros)} if bias else {}
    )


def layer_norm(p: Tree, x: jax.Array, *, eps: float) -> jax.Array:
    """LayerNorm over the last axis in float32; `p` may lack `bias`, or be empty (no affine part)."""
    x = x.astype(jnp.float32)
    mean = x.mean(-1, keepdims=True)
    x = x - mean
    y = x * jax.lax.rsqrt(jnp.square(x).mean(-1, keepdims=True) + eps)
    if "scale" in p:
        y = y * lift(p["scale"], y.ndim).astype(jnp.float32)
    return y + lift(p["bias"], y.ndim).astype(jnp.float32) if "bias" in p else y


def rms_norm(p: Tree, x: jax.Array, *, eps: float) -> jax.Array:
    """x / sqrt(mean x^2 + eps) * scale over the last axis, in float32."""
    x = x.astype(jnp.float32)
    y = x * jax.lax.rsqrt(jnp.square(x).mean(-1, keepdims=True) + eps)
    return y * lift(p["scale"], y.ndim).astype(jnp.float32)


def gelu(x: jax.Array, *, exact: bool) -> jax.Array:
    """x Phi(x): by erf if `exact`, else the tanh approximation."""
    if exact:  # erf and not JAX's erfc form, whose gradient costs twice as much on a CPU
        return x * (0.5 * (1.0 + jax.lax.erf(x * 0.5**0.5)))
    return jax.nn.gelu(x, approximate=True)


def mlp_specs(d: int, hidden: int, *, bias=True, init_out=None) -> Tree:
    """Two linears, d -> hidden -> d."""
    return {
        "fc1": linear_specs(d, hidden, ("embed", "mlp"), bias=bias),
        "fc2": linear_specs(hidden, d, ("mlp", "embed"), bias=bias, init=init_out),
    }


def mlp(p: Tree, x: jax.Array, *, exact: bool) -> jax.Array:
    """Two linears with a GELU between: the erf form if `exact`, else the tanh form."""
    rows = x.reshape(-1, x.shape[-1])
    y = linear(p["fc2"], gelu(linear(p["fc1"], rows), exact=exact))
    return y.reshape(*x.shape[:-1], y.shape[-1])


def patchify(x: jax.Array, patch: int) -> jax.Array:
    """Images [.., h, w, c] to flattened patches [.., h/p * w/p, p*p*c], (row, column, channel) order."""
    *lead, h, w, c = x.shape
    x = x.reshape(*lead, h // patch, patch, w // patch, patch, c)
    x = jnp.swapaxes(x, -4, -3)
    return x.reshape(*lead, (h // patch) * (w // patch), patch * patch * c)


def unpatchify(x: jax.Array, grid: tuple[int, int], patch: int) -> jax.Array:
    """The inverse of `patchify`: [.., gh*gw, p*p*c] to [.., gh*p, gw*p, c]."""
    *lead, _, f = x.shape
    gh, gw = grid
    x = x.reshape(*lead, gh, gw, patch, patch, f // patch**2)
    return jnp.swapaxes(x, -4, -3).reshape(*lead, gh * patch, gw * patch, f // patch**2)


def patch_conv_specs(patch: int, c_in: int, d: int, *, bias=True, init=None) -> Tree:
    """A convolution whose stride equals its kernel, kept in convolution layout [p, p, c_in, d]."""
    specs = {"kernel": Spec((patch, patch, c_in, d), (None, None, None, "embed"), init or fan_in())}
    return specs | ({"bias": Spec((d,), ("embed",), zeros)} if bias else {})


def patch_conv(p: Tree, x: jax.Array) -> jax.Array:
    """Images [.., h, w, c] -> tokens [.., h/p * w/p, d], as one matrix product over patches."""
    patch, d = p["kernel"].shape[0], p["kernel"].shape[-1]
    return linear(p | {"kernel": p["kernel"].reshape(-1, d)}, patchify(x, patch))


def conv2d_specs(c_in: int, c_out: int, side: int, *, init=None) -> Tree:
    """Kernel [side, side, c_in, c_out] and bias [c_out] of `conv2d`."""
    kernel = Spec((side, side, c_in, c_out), (None,) * 4, init or fan_in())
    return {"kernel": kernel, "bias": Spec((c_out,), (None,), zeros)}


def conv2d(p: Tree, x: jax.Array, *, stride: int = 1) -> jax.Array:
    """Convolution of images [n, h, w, c_in] in float32 -> [n, h / stride, w / stride, c_out]; zeros beyond the border.

    Odd kernels; reverse-mode gradients only.
    """
    kernel = p["kernel"].astype(jnp.float32)
    plain = stride > 1 or target.platform() != "cpu"
    y = convolve(x, kernel, stride=stride) if plain else _cpu_conv2d(x, kernel)
    return y + lift(p["bias"].astype(jnp.float32), y.ndim)


def convolve(x: jax.Array, kernel: jax.Array, *, stride: int = 1, padding="SAME") -> jax.Array:
    """2-D convolution of images [n, h, w, c] with kernel [kh, kw, c, d]; padding as XLA takes it."""
    return jax.lax.conv_general_dilated(
        x, kernel, (stride, stride), padding, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


# XLA's CPU gradients of a convolution take 25 times as long inside a loop (`lax.map` over scenes) as outside it. As a
# convolution with the mirrored kernel and a product of matrices they take 0.7 to 2.5 times as long as those outside.
@jax.custom_vjp
def _cpu_conv2d(x: jax.Array, kernel: jax.Array) -> jax.Array:
    return convolve(x, kernel)


def _cpu_conv2d_forward(x, kernel):
    return convolve(x, kernel), (x, kernel)


def _cpu_conv2d_backward(kept, dy):
    x, kernel = kept
    side = kernel.shape[0]
    h, w = x.shape[1:3]
    around = jnp.pad(x, ((0, 0), (side // 2,) * 2, (side // 2,) * 2, (0, 0)))
    taps = [around[:, i : i + h, j : j + w] for i in range(side) for j in range(side)]
    rows = jnp.concatenate(taps, -1).reshape(-1, kernel.shape[2] * side**2)
    d_kernel = (rows.T @ dy.reshape(-1, kernel.shape[3])).reshape(kernel.shape)
    return convolve(dy, jnp.swapaxes(kernel[::-1, ::-1], 2, 3)), d_kernel


_cpu_conv2d.defvjp(_cpu_conv2d_forward, _cpu_conv2d_backward)


def resized(images: jax.Array, height: int, width: int) -> jax.Array:
    """Images [v, h, w, 3] at another size: bilinear, antialiased."""
    if images.shape[1:3] == (height, width):
        return images
    return jax.image.resize(images, (images.shape[0], height, width, 3), "bilinear", antialias=True)
