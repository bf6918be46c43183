"""Image metrics that need no weights: PSNR, two SSIMs, and three that look at sharpness.

Every function compares `image` with `reference`, floats in [0, 1], shape [..., h, w, 3], and returns one
number per image, shape [...]. The same code serves both worlds: NumPy arrays are computed in float64,
JAX arrays (also inside jit) in float32. Averages over frames and scenes are the caller's business;
`image_metrics` takes the plain mean over frames, of dB where the metric is in dB.
"""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from roge_jax.errors import UserError

CAP_DB = 100.0  # identical images have infinite PSNR; means need a number
WINDOW, SIGMA = 11, 1.5  # Wang et al. 2004
LUMA = (0.299, 0.587, 0.114)  # Rec. 601
QUANTISATION = (1.0 / 255.0) ** 2 / 12.0  # energy of 8-bit rounding: no detail is measured below it
GMSD_C = 170.0 / 255.0**2  # Xue et al. 2014, moved from [0, 255] to [0, 1]

Array = Any  # np.ndarray or jax.Array; the result is of the same kind as the input


def psnr(image: Array, reference: Array, *, cap: float = CAP_DB) -> Array:
    """-10 log10 of the mean squared error over h, w, c, both images clipped to [0, 1]; dB, higher is better.

    Values above `cap` dB (identical images) are returned as `cap`.
    """
    xp, image, reference = _pair("psnr", image, reference)
    error = xp.mean(
        (xp.clip(image, 0.0, 1.0) - xp.clip(reference, 0.0, 1.0)) ** 2, axis=(-3, -2, -1)
    )
    return _decibel(xp, error, cap)


def ssim(image: Array, reference: Array) -> Array:
    """Structural similarity of Wang et al. 2004, in [-1, 1], higher is better.

    Gaussian window of 11 x 11 with sigma 1.5, population covariance, K1 = 0.01, K2 = 0.03, range 1, only windows
    that lie inside the image, mean over positions and channels. Equals scikit-image with
    `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1`.
    """
    xp, image, reference = _pair("ssim", image, reference)
    _need_side("ssim", image, WINDOW)
    # Variances are E[x^2] - mean^2: moving both images by one colour first keeps the digits in float32.
    centre = xp.mean(reference, axis=(-3, -2), keepdims=True)
    moved, moved_reference = image - centre, reference - centre
    mean_a, mean_b = _blur(xp, moved), _blur(xp, moved_reference)
    centre = xp.broadcast_to(centre, mean_a.shape)
    return _similarity(
        xp,
        (mean_a + centre, mean_b + centre),
        (_blur(xp, moved**2) - mean_a**2, _blur(xp, moved_reference**2) - mean_b**2),
        _blur(xp, moved * moved_reference) - mean_a * mean_b,
    )


def ssim_zero_pad(image: Array, reference: Array) -> Array:
    """The SSIM that LagerNVS prints: as `ssim`, but zero padding and the mean over the whole frame.

    Reads 0.016 to 0.023 higher than `ssim` at 192 x 192, more on smaller images: never mix the two in a table.
    """
    xp, image, reference = _pair("ssim_zero_pad", image, reference)
    border = [(0, 0)] * (image.ndim - 3) + [(WINDOW // 2, WINDOW // 2)] * 2 + [(0, 0)]
    a, b = xp.pad(image, border), xp.pad(reference, border)
    mean_a, mean_b = _blur(xp, a), _blur(xp, b)
    return _similarity(
        xp,
        (mean_a, mean_b),
        (_blur(xp, a**2) - mean_a**2, _blur(xp, b**2) - mean_b**2),
        _blur(xp, a * b) - mean_a * mean_b,
    )


def sharpness_ratio(image: Array, reference: Array) -> Array:
    """How much fine detail `image` has, relative to `reference`: 1 is as sharp, below 1 blurred, above 1 noisy.

    The root of the energy of the high-pass band of the luma, x - gauss_1.5(x) (valid region), over the same number
    of the reference; 8-bit rounding energy is added to both so that flat images give 1. It does not compare
    positions: read it beside PSNR, which does, and which blur flatters.
    """
    xp, image, reference = _pair("sharpness_ratio", image, reference)
    _need_side("sharpness_ratio", image, WINDOW)
    energy = [_high_pass_energy(xp, _luma(xp, x)) for x in (image, reference)]
    return xp.sqrt((energy[0] + QUANTISATION) / (energy[1] + QUANTISATION))


def gradient_psnr(image: Array, reference: Array, *, cap: float = CAP_DB) -> Array:
    """PSNR of the image gradients (forward differences in x and y of every channel), dB, higher is better.

    Blind to anything constant over an area (exposure, colour casts), sensitive to edges that are missing, soft
    or in the wrong place. A grey image scores the energy of the reference's gradients.
    """
    xp, image, reference = _pair("gradient_psnr", image, reference)
    _need_side("gradient_psnr", image, 2)
    difference = xp.clip(image, 0.0, 1.0) - xp.clip(reference, 0.0, 1.0)
    dx = difference[..., :, 1:, :] - difference[..., :, :-1, :]
    dy = difference[..., 1:, :, :] - difference[..., :-1, :, :]
    error = (xp.mean(dx**2, axis=(-3, -2, -1)) + xp.mean(dy**2, axis=(-3, -2, -1))) / 2.0
    return _decibel(xp, error, cap)


def gmsd(image: Array, reference: Array) -> Array:
    """Gradient magnitude similarity deviation (Xue et al. 2014), 0 is identical, lower is better.

    Luma, 2 x 2 average and every second pixel, Prewitt magnitudes m, similarity (2 m1 m2 + c) / (m1^2 + m2^2 + c)
    with c = 170 / 255^2, standard deviation over the frame. Valid region only (the original pads with zeros).
    """
    xp, image, reference = _pair("gmsd", image, reference)
    _need_side("gmsd", image, 6)
    a, b = (_prewitt(xp, _halve(_luma(xp, x))) for x in (image, reference))
    # magnitudes enter squared or as a product: one root instead of two
    similarity = (2.0 * xp.sqrt(a * b) + GMSD_C) / (a + b + GMSD_C)
    return xp.std(similarity, axis=(-3, -2, -1))


IMAGE_METRICS = {
    "psnr": psnr,
    "ssim": ssim,
    "ssim_zero_pad": ssim_zero_pad,
    "sharpness_ratio": sharpness_ratio,
    "gradient_psnr": gradient_psnr,
    "gmsd": gmsd,
}

SETTINGS = {
    "psnr": f"dB of the MSE over h, w, c per frame, images clipped to [0, 1], capped at {CAP_DB:g} dB",
    "ssim": "Wang 2004: Gaussian 11x11, sigma 1.5, population covariance, valid region, range 1, RGB mean",
    "ssim_zero_pad": "as ssim, zero padding, mean over the whole frame (LagerNVS)",
    "sharpness_ratio": "root energy ratio of luma - gauss 1.5, valid region; 1 = as sharp as the truth",
    "gradient_psnr": f"dB of the MSE of forward differences, capped at {CAP_DB:g} dB",
    "gmsd": "Xue 2014 on luma, 2x2 average, Prewitt, c = 170/255^2, valid region",
    "mean": "per frame, then the mean over frames, then the mean over scenes",
}


def image_metrics(
    images: np.ndarray,
    references: np.ndarray,
    names: tuple[str, ...] = ("psnr", "ssim", "sharpness_ratio", "gradient_psnr", "gmsd"),
) -> dict[str, float]:
    """Means over frames of the named metrics, computed in float64. `images`, `references`: [n, h, w, 3] in [0, 1].

    Also returns `capped`, the number of frames whose PSNR reached the cap.
    """
    images, references = np.asarray(images), np.asarray(references)
    if images.ndim != 4 or not len(images):
        raise UserError(f"image_metrics takes frames [n, h, w, 3] with n >= 1, not {images.shape}.")
    unknown = [name for name in names if name not in IMAGE_METRICS]
    if unknown:
        raise UserError(
            f"Unknown image metric {unknown[0]!r}; allowed: {', '.join(IMAGE_METRICS)}."
        )
    result = {name: float(np.mean(IMAGE_METRICS[name](images, references))) for name in names}
    result["capped"] = int(np.sum(psnr(images, references) >= CAP_DB))
    return result


def _pair(name: str, image: Array, reference: Array) -> tuple[ModuleType, Array, Array]:
    """The array module to compute in, and both images as floats in it."""
    xp = jnp if isinstance(image, jax.Array) or isinstance(reference, jax.Array) else np
    image, reference = xp.asarray(image), xp.asarray(reference)
    if image.shape != reference.shape or image.ndim < 3 or image.shape[-1] != 3:
        raise UserError(
            f"{name} compares two images [..., h, w, 3] of the same shape, not {image.shape} and {reference.shape}."
        )
    for x in (image, reference):
        if not xp.issubdtype(x.dtype, xp.floating):
            raise UserError(
                f"{name} takes floats in [0, 1], not {x.dtype}; divide 8-bit images by 255."
            )
    # bfloat16 cannot hold the variances of SSIM
    dtype = (
        np.float64
        if xp is np
        else jnp.promote_types(jnp.float32, jnp.result_type(image, reference))
    )
    return xp, image.astype(dtype), reference.astype(dtype)


def _need_side(name: str, image: Array, side: int) -> None:
    if min(image.shape[-3:-1]) < side:
        raise UserError(
            f"{name} needs images of at least {side} x {side} pixels, not {image.shape[-3:-1]}."
        )


def _decibel(xp: ModuleType, error: Array, cap: float) -> Array:
    return -10.0 * xp.log10(xp.maximum(error, 10.0 ** (-cap / 10.0)))


def _blur(xp: ModuleType, x: Array) -> Array:
    """Gaussian of WINDOW taps along h and w, valid region: [..., h, w, c] -> [..., h - 10, w - 10, c]."""
    taps = np.exp(-((np.arange(WINDOW) - WINDOW // 2) ** 2) / (2.0 * SIGMA**2))
    taps /= taps.sum()
    h, w = x.shape[-3] - WINDOW + 1, x.shape[-2] - WINDOW + 1
    x = sum(float(tap) * x[..., k : k + h, :, :] for k, tap in enumerate(taps))
    return sum(float(tap) * x[..., :, k : k + w, :] for k, tap in enumerate(taps))


def _similarity(
    xp: ModuleType, means: tuple[Array, Array], variances: tuple[Array, Array], covariance: Array
) -> Array:
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2.0 * means[0] * means[1] + c1) / (means[0] ** 2 + means[1] ** 2 + c1)
    structure = (2.0 * covariance + c2) / (variances[0] + variances[1] + c2)
    return xp.mean(luminance * structure, axis=(-3, -2, -1))


def _luma(xp: ModuleType, image: Array) -> Array:
    """[..., h, w, 3] -> [..., h, w, 1]."""
    return sum(weight * image[..., i : i + 1] for i, weight in enumerate(LUMA))


def _high_pass_energy(xp: ModuleType, luma: Array) -> Array:
    margin = WINDOW // 2
    detail = luma[..., margin:-margin, margin:-margin, :] - _blur(xp, luma)
    return xp.mean(detail**2, axis=(-3, -2, -1))


def _halve(luma: Array) -> Array:
    """Averages of 2 x 2 pixels; an odd last row or column is dropped."""
    h, w = luma.shape[-3] // 2 * 2, luma.shape[-2] // 2 * 2
    luma = luma[..., :h, :w, :]
    rows = luma[..., 0::2, :, :] + luma[..., 1::2, :, :]
    return (rows[..., :, 0::2, :] + rows[..., :, 1::2, :]) / 4.0


def _prewitt(xp: ModuleType, luma: Array) -> Array:
    """Squared Prewitt gradient magnitude, valid region: [..., h, w, 1] -> [..., h - 2, w - 2, 1]."""
    dx, dy = luma[..., :, 2:, :] - luma[..., :, :-2, :], luma[..., 2:, :, :] - luma[..., :-2, :, :]
    gx = (dx[..., :-2, :, :] + dx[..., 1:-1, :, :] + dx[..., 2:, :, :]) / 3.0
    gy = (dy[..., :, :-2, :] + dy[..., :, 1:-1, :] + dy[..., :, 2:, :]) / 3.0
    return gx**2 + gy**2
