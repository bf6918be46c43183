"""Image metrics against scikit-image, SciPy and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.metrics import image as im


def photo_pair(seed=0, h=48, w=56, n=None):
    """A smooth colourful image with an edge, and a blurred noisy copy: [h, w, 3] or [n, h, w, 3]."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(seed)
    truth = gaussian_filter(rng.random((n or 1, h, w, 3)), (0, 1.5, 1.5, 0))
    truth = (truth - truth.min()) / (truth.max() - truth.min())
    truth[:, :, w // 2 :] = 1.0 - truth[:, :, w // 2 :]
    other = gaussian_filter(truth, (0, 1.2, 1.2, 0)) + 0.02 * rng.standard_normal(truth.shape)
    other = other.clip(0.0, 1.0)
    return (other, truth) if n else (other[0], truth[0])


def test_psnr_of_a_constant_offset_is_closed_form():
    truth = np.full((8, 9, 3), 0.25)
    for offset in (0.5, 0.1, 1e-3):
        np.testing.assert_allclose(
            im.psnr(truth + offset, truth), -20 * np.log10(offset), rtol=1e-12
        )


def test_psnr_equals_skimage_clips_and_caps():
    from skimage.metrics import peak_signal_noise_ratio

    a, b = photo_pair()
    np.testing.assert_allclose(
        im.psnr(a, b), peak_signal_noise_ratio(b, a, data_range=1.0), rtol=1e-12
    )
    assert im.psnr(b, b) == im.CAP_DB and im.psnr(b, b, cap=60.0) == 60.0
    np.testing.assert_allclose(im.psnr(np.full_like(b, 7.0), np.ones_like(b)), im.CAP_DB)


def test_psnr_is_averaged_in_decibels():
    truth = np.zeros((2, 12, 12, 3))
    frames = np.stack([truth[0] + 10 ** (-20 / 20), truth[1] + 10 ** (-40 / 20)])
    result = im.image_metrics(frames, truth)
    np.testing.assert_allclose(
        result["psnr"], 30.0, rtol=1e-12
    )  # 22.97 dB if the errors were averaged
    assert result["capped"] == 0 and im.image_metrics(truth, truth)["capped"] == 2


@pytest.mark.parametrize("seed", range(3))
def test_ssim_equals_skimage(seed):
    from skimage.metrics import structural_similarity

    a, b = photo_pair(seed)
    expected = structural_similarity(
        a,
        b,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
    )
    np.testing.assert_allclose(im.ssim(a, b), expected, rtol=0, atol=1e-7)


def test_ssim_zero_pad_equals_scipy():
    from scipy.ndimage import correlate1d

    a, b = photo_pair(4)
    taps = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    taps /= taps.sum()

    def blur(x):
        return correlate1d(
            correlate1d(x, taps, axis=0, mode="constant"), taps, axis=1, mode="constant"
        )

    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    grid = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    np.testing.assert_allclose(im.ssim_zero_pad(a, b), grid.mean(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["ssim", "ssim_zero_pad"])
def test_ssim_properties(name):
    metric = im.IMAGE_METRICS[name]
    a, b = photo_pair(5)
    np.testing.assert_allclose(metric(b, b), 1.0, rtol=1e-12)
    np.testing.assert_allclose(metric(a, b), metric(b, a), rtol=1e-12)
    np.testing.assert_allclose(metric(a, b), metric(a[..., ::-1], b[..., ::-1]), rtol=1e-12)
    assert -1.0 <= metric(1.0 - b, b) < metric(a, b) < 1.0


def test_padding_flatters_a_small_image_more():
    a, b = photo_pair(6, 64, 64)
    whole = im.ssim_zero_pad(a, b) - im.ssim(a, b)
    part = im.ssim_zero_pad(a[:24, :24], b[:24, :24]) - im.ssim(a[:24, :24], b[:24, :24])
    assert 0.0 < whole < part


@pytest.mark.parametrize("name", sorted(im.IMAGE_METRICS))
def test_jit_in_float32_equals_numpy_in_float64(name):
    metric = im.IMAGE_METRICS[name]
    a, b = (x.astype(np.float32) for x in photo_pair(7, n=3))
    exact = metric(a, b)
    assert isinstance(exact, np.ndarray) and exact.shape == (3,) and exact.dtype == np.float64
    fast = jax.jit(metric)(jnp.asarray(a), jnp.asarray(b))
    assert fast.shape == (3,) and fast.dtype == jnp.float32
    np.testing.assert_allclose(fast, exact, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose([metric(a[i], b[i]) for i in range(3)], exact, rtol=1e-12)


def test_ssim_of_a_bright_flat_image_survives_float32():
    rng = np.random.default_rng(0)
    b = np.full((32, 32, 3), 0.97) + 1e-3 * rng.standard_normal((32, 32, 3))
    a = b + 1e-3 * rng.standard_normal(b.shape)
    a, b = a.astype(np.float32), b.astype(np.float32)
    # uncentred float32 variances would be off by about 6e-8 / 9e-4
    np.testing.assert_allclose(
        im.ssim(jnp.asarray(a), jnp.asarray(b)), im.ssim(a, b), rtol=0, atol=3e-6
    )


def test_bfloat16_images_are_compared_in_float32():
    a, b = photo_pair(8)
    result = im.ssim(jnp.asarray(a, jnp.bfloat16), jnp.asarray(b, jnp.bfloat16))
    assert result.dtype == jnp.float32
    np.testing.assert_allclose(result, im.ssim(a, b), atol=0.02)


def test_sharpness_ratio_sees_the_blur_that_psnr_likes():
    """A shifted sharp image has lower PSNR than a blurred one, yet the sharpness ratio tells them apart."""
    from scipy.ndimage import gaussian_filter

    _, truth = photo_pair(9, 64, 64)
    blurred = gaussian_filter(truth, (4.0, 4.0, 0))
    shifted = np.roll(truth, 4, axis=1)
    assert im.psnr(blurred, truth) > im.psnr(shifted, truth)
    assert im.sharpness_ratio(blurred, truth) < 0.3
    np.testing.assert_allclose(im.sharpness_ratio(shifted, truth), 1.0, atol=0.05)
    noisy = truth + 0.2 * np.random.default_rng(0).standard_normal(truth.shape)
    assert im.sharpness_ratio(noisy, truth) > 1.2


def test_sharpness_ratio_scales_with_contrast_and_is_one_for_flat_images():
    rng = np.random.default_rng(1)
    truth = rng.random((40, 40, 3))
    half = 0.5 + 0.5 * (truth - 0.5)
    np.testing.assert_allclose(
        im.sharpness_ratio(half, truth), 0.5, rtol=1e-4
    )  # rounding energy: 1e-5
    flat = np.full((20, 20, 3), 0.3)
    assert im.sharpness_ratio(flat, flat + 0.4) == 1.0
    # only rounding energy is left in the flat image
    energy = im.QUANTISATION / (im._high_pass_energy(np, im._luma(np, truth)) + im.QUANTISATION)
    np.testing.assert_allclose(
        im.sharpness_ratio(np.full_like(truth, 0.5), truth), np.sqrt(energy), rtol=1e-9
    )


def test_gradient_psnr_is_closed_form_on_a_ramp_and_ignores_exposure():
    truth = np.broadcast_to(
        np.linspace(0.2, 0.6, 41)[None, :, None], (30, 41, 3)
    )  # slope 0.01 in x, 0 in y
    flat = np.full(truth.shape, 0.5)
    np.testing.assert_allclose(
        im.gradient_psnr(flat, truth), -10 * np.log10(0.01**2 / 2), rtol=1e-9
    )
    # what lies outside [0, 1] is not shown: no gradient there
    np.testing.assert_allclose(
        im.gradient_psnr(flat + 0.9 * (truth > 0.4), truth),
        im.gradient_psnr(np.where(truth > 0.4, 1.0, 0.5), truth),
        rtol=1e-9,
    )
    # an offset changes PSNR (14 dB) but leaves no gradient but rounding
    assert im.gradient_psnr(truth + 0.2, truth) == im.CAP_DB
    np.testing.assert_allclose(im.psnr(truth + 0.2, truth), -20 * np.log10(0.2), rtol=1e-9)


def test_gmsd_equals_a_plain_convolution_and_grows_with_blur():
    from scipy.ndimage import gaussian_filter
    from scipy.signal import convolve2d

    a, b = photo_pair(10, 40, 44)

    def magnitude(image):
        luma = image @ np.array(im.LUMA)
        half = convolve2d(luma, np.full((2, 2), 0.25), mode="valid")[::2, ::2]
        kernel = np.array([[1, 0, -1]] * 3) / 3.0
        gx, gy = (convolve2d(half, k, mode="valid") for k in (kernel, kernel.T))
        return np.hypot(gx, gy)

    ma, mb = magnitude(a), magnitude(b)
    c = 170 / 255**2
    np.testing.assert_allclose(
        im.gmsd(a, b), np.std((2 * ma * mb + c) / (ma**2 + mb**2 + c)), rtol=1e-10
    )
    assert im.gmsd(b, b) == 0.0
    scores = [im.gmsd(gaussian_filter(b, (s, s, 0)), b) for s in (0.5, 1.0, 2.0)]
    assert scores[0] < scores[1] < scores[2]


def test_wrong_input_is_named():
    a, b = photo_pair()
    with pytest.raises(UserError, match="uint8; divide 8-bit images by 255"):
        im.psnr((a * 255).astype(np.uint8), b)
    with pytest.raises(UserError, match=r"same shape, not \(48, 56, 3\) and \(48, 55, 3\)"):
        im.ssim(a, b[:, 1:])
    with pytest.raises(UserError, match="at least 11 x 11"):
        im.ssim(a[:10], b[:10])
    with pytest.raises(UserError, match="Unknown image metric 'lpips'"):
        im.image_metrics(a[None], b[None], names=("lpips",))
