"""Distances between two sets of feature vectors: Frechet, its small-sample floor, KID.

The features come from elsewhere; any network will do. float64 NumPy. Rows are samples.
"""

from typing import NamedTuple

import numpy as np

from roge_jax.errors import UserError


class FrechetDistance(NamedTuple):
    """A distance and what it was computed from."""

    distance: float
    n: tuple[int, int]  # samples in each set: never compare distances of different n
    d: int  # feature width


def frechet_distance(a: np.ndarray, b: np.ndarray) -> FrechetDistance:
    """|mu_a - mu_b|^2 + tr(C_a + C_b - 2 (C_a C_b)^(1/2)) of features a [n, d] and b [k, d].

    Unbiased covariances. With A = (a - mu_a) / sqrt(n - 1) and B likewise, the trace of the
    matrix root is the nuclear norm of A B^T: an n x k SVD instead of a d x d matrix root, exact
    also when the covariances are singular (n <= d). At least two samples each.
    """
    a, b = _features("first", a), _features("second", b)
    if a.shape[1] != b.shape[1]:
        raise UserError(
            f"Both feature sets need the same width, not {a.shape[1]} and {b.shape[1]}."
        )
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    A, B = (a - mean_a) / np.sqrt(len(a) - 1), (b - mean_b) / np.sqrt(len(b) - 1)
    root = np.linalg.svd(_narrow(A, B), compute_uv=False).sum()
    distance = np.sum((mean_a - mean_b) ** 2) + np.sum(A**2) + np.sum(B**2) - 2.0 * root
    # equal sets leave rounding of either sign
    return FrechetDistance(float(max(distance, 0.0)), (len(a), len(b)), a.shape[1])


def self_floor(real: np.ndarray, *, seed: int = 0, repeats: int = 10) -> float:
    """What Frechet distance two sets of n samples show though nothing differs: features [n, d].

    The mean distance between random halves of the real set, extrapolated from n / 2 to n samples
    by the law c / n. Print it beside every Frechet distance: a number near it says nothing. An
    estimate: for n below d the law is shallower and the true floor a little higher.
    """
    real = _features("real", real)
    n = len(real)
    if n < 4:
        raise UserError(
            f"self_floor splits the real set in two halves of at least 2: it needs 4 samples, not {n}."
        )
    rng = np.random.default_rng(seed)
    half = n // 2
    distances = []
    for _ in range(repeats):
        order = rng.permutation(n)
        distances.append(
            frechet_distance(real[order[:half]], real[order[half : 2 * half]]).distance
        )
    return float(np.mean(distances) * half / n)


def frechet_infinity(a: np.ndarray, b: np.ndarray, *, seed: int = 0, points: int = 8) -> float:
    """The Frechet distance extrapolated to infinitely many samples (Chong & Forsyth 2020).

    Distances of random subsets of both sets, of sizes from half to all of the smaller one, fitted
    by a line in 1 / n; the intercept. May be slightly negative where nothing differs.
    """
    a, b = _features("first", a), _features("second", b)
    n = min(len(a), len(b))
    if n < 8:
        raise UserError(
            f"frechet_infinity fits a line over subset sizes: it needs 8 samples each, not {n}."
        )
    rng = np.random.default_rng(seed)
    sizes = np.unique(np.round(1.0 / np.linspace(2.0 / n, 1.0 / n, points)).astype(int))
    distances = [
        frechet_distance(
            a[rng.choice(len(a), size, replace=False)], b[rng.choice(len(b), size, replace=False)]
        ).distance
        for size in sizes
    ]
    return float(np.polyfit(1.0 / sizes, distances, 1)[1])


def kid(
    a: np.ndarray,
    b: np.ndarray,
    *,
    degree: int = 3,
    gamma: float | None = None,
    coef0: float = 1.0,
) -> float:
    """Kernel distance (Binkowski et al. 2018): unbiased squared MMD, k(x, y) = (gamma x.y + c)^degree.

    Features a [n, d], b [k, d]; gamma defaults to 1 / d. Its expectation is 0 for equal
    distributions at every n, so it may be negative: the choice for few samples.
    """
    a, b = _features("first", a), _features("second", b)
    if a.shape[1] != b.shape[1]:
        raise UserError(
            f"Both feature sets need the same width, not {a.shape[1]} and {b.shape[1]}."
        )
    scale = 1.0 / a.shape[1] if gamma is None else gamma

    def kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (scale * x @ y.T + coef0) ** degree

    def off_diagonal_mean(x: np.ndarray) -> float:
        k = kernel(x, x)
        return (k.sum() - np.trace(k)) / (len(x) * (len(x) - 1))

    return float(off_diagonal_mean(a) + off_diagonal_mean(b) - 2.0 * kernel(a, b).mean())


def _narrow(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """A B^T, or a smaller matrix with the same singular values when samples outnumber features."""
    d = A.shape[1]
    # A = Q R leaves the singular values of A B^T = Q (R S^T) P^T unchanged
    A = np.asarray(np.linalg.qr(A, mode="r")) if len(A) > d else A
    B = np.asarray(np.linalg.qr(B, mode="r")) if len(B) > d else B
    return A @ B.T


def _features(name: str, x: np.ndarray) -> np.ndarray:
    x = np.asarray(x, np.float64)
    if x.ndim != 2 or len(x) < 2 or not x.shape[1]:
        raise UserError(
            f"The {name} feature set must be [n, d] with n >= 2 (one sample has no covariance), not {x.shape}."
        )
    if not np.isfinite(x).all():
        raise UserError(
            f"The {name} feature set holds NaN or inf in row {np.argwhere(~np.isfinite(x))[0, 0]}."
        )
    return x
