"""Frechet distance, its floor and KID against closed forms, SciPy and brute force."""

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.metrics import distribution as dist


def whitened(rng, n, d):
    """Exactly zero mean and identity covariance."""
    x = rng.standard_normal((n, d))
    x -= x.mean(axis=0)
    u, _, vt = np.linalg.svd(x, full_matrices=False)
    return np.sqrt(n - 1) * u @ vt


def test_closed_form_of_two_gaussians_with_commuting_covariances():
    rng = np.random.default_rng(0)
    x = whitened(rng, 60, 5)
    sa, sb = np.array([1.0, 2, 3, 4, 5]), np.array([2.0, 2, 1, 0.5, 0])
    shift = np.array([0.0, 1, -2, 0, 3])
    found = dist.frechet_distance(x * sa, x * sb + shift)
    np.testing.assert_allclose(
        found.distance, np.sum((sa - sb) ** 2) + np.sum(shift**2), rtol=1e-12
    )
    assert found.n == (60, 60) and found.d == 5


@pytest.mark.parametrize(("n", "k", "d"), [(40, 50, 6), (40, 9, 6), (30, 30, 30)])
def test_equals_the_matrix_root(n, k, d):
    from scipy.linalg import eigvals

    rng = np.random.default_rng(1)
    a = rng.standard_normal((n, d)) @ rng.standard_normal((d, d))
    b = rng.standard_normal((k, d)) @ rng.standard_normal((d, d)) + 1.0
    ca, cb = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    root = np.sqrt(np.maximum(eigvals(ca @ cb).real, 0)).sum()
    expected = np.sum((a.mean(0) - b.mean(0)) ** 2) + np.trace(ca) + np.trace(cb) - 2 * root
    # rank-deficient products lose half the digits in the eigenvalues, not in the nuclear norm
    np.testing.assert_allclose(dist.frechet_distance(a, b).distance, expected, rtol=1e-6)


def test_more_features_than_samples_has_no_special_case():
    """Few samples in a subspace: the distance must not change when zero features are appended."""
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal((12, 5)), rng.standard_normal((15, 5)) + 0.5
    turn, _ = np.linalg.qr(rng.standard_normal((40, 40)))
    wide = [np.pad(x, ((0, 0), (0, 35))) @ turn for x in (a, b)]
    np.testing.assert_allclose(
        dist.frechet_distance(*wide).distance, dist.frechet_distance(a, b).distance, rtol=1e-10
    )


def test_symmetric_zero_for_equal_sets_and_moved_by_the_mean():
    rng = np.random.default_rng(3)
    a, b = rng.standard_normal((20, 7)), rng.standard_normal((25, 7))
    np.testing.assert_allclose(
        dist.frechet_distance(a, b).distance, dist.frechet_distance(b, a).distance, rtol=1e-10
    )
    assert dist.frechet_distance(a, a[::-1]).distance < 1e-12
    np.testing.assert_allclose(dist.frechet_distance(a, a + 2.0).distance, 7 * 4.0, rtol=1e-10)


def test_self_floor_predicts_the_distance_of_two_equal_populations():
    rng = np.random.default_rng(4)
    n, d = 400, 10
    real = rng.standard_normal((n, d))
    fresh = [
        dist.frechet_distance(rng.standard_normal((n, d)), rng.standard_normal((n, d))).distance
        for _ in range(10)
    ]
    np.testing.assert_allclose(dist.self_floor(real), np.mean(fresh), rtol=0.25)
    assert dist.self_floor(real, seed=1) == dist.self_floor(real, seed=1)


def test_extrapolation_removes_most_of_the_bias():
    rng = np.random.default_rng(5)
    a, b = rng.standard_normal((300, 20)), rng.standard_normal((300, 20)) + 0.1
    true = 20 * 0.01
    biased = dist.frechet_distance(a, b).distance
    assert abs(dist.frechet_infinity(a, b) - true) < 0.5 * (biased - true)


def test_kid_equals_brute_force_and_is_unbiased():
    rng = np.random.default_rng(6)
    a, b = rng.standard_normal((6, 4)), rng.standard_normal((5, 4)) + 0.3

    def k(x, y):
        return (x @ y / 4 + 1) ** 3

    aa = np.mean([k(a[i], a[j]) for i in range(6) for j in range(6) if i != j])
    bb = np.mean([k(b[i], b[j]) for i in range(5) for j in range(5) if i != j])
    ab = np.mean([k(x, y) for x in a for y in b])
    np.testing.assert_allclose(dist.kid(a, b), aa + bb - 2 * ab, rtol=1e-10)
    draws = [
        dist.kid(rng.standard_normal((10, 4)), rng.standard_normal((10, 4))) for _ in range(400)
    ]
    assert abs(np.mean(draws)) < 4 * np.std(draws) / np.sqrt(400) and min(draws) < 0
    assert dist.kid(rng.standard_normal((200, 4)), rng.standard_normal((200, 4)) + 1.0) > 1.0


def test_too_few_or_broken_samples_are_refused():
    x = np.zeros((5, 3))
    for metric in (dist.frechet_distance, dist.kid):
        with pytest.raises(UserError, match=r"n >= 2 .*not \(1, 3\)"):
            metric(x[:1], x)
        with pytest.raises(UserError, match="same width, not 3 and 2"):
            metric(x, x[:, :2])
        with pytest.raises(UserError, match="second feature set holds NaN or inf in row 4"):
            metric(x, np.where(np.arange(5)[:, None] == 4, np.nan, x))
    with pytest.raises(UserError, match="needs 4 samples"):
        dist.self_floor(x[:3])
    with pytest.raises(UserError, match="needs 8 samples"):
        dist.frechet_infinity(x, x)
