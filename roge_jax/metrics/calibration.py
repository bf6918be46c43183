"""Whether a predicted error is the error: by bins of the prediction, and how much lies within it."""

from typing import NamedTuple

import numpy as np

from roge_jax.errors import UserError


class Bin(NamedTuple):
    """Pixels of about the same predicted error."""

    share: float  # of all pixels
    predicted: float  # RMS of the prediction in the bin
    found: float  # RMS of the true error there
    within: float  # share of these pixels whose true error is at most the predicted one


class Calibration(NamedTuple):
    """A predicted error map held against the true one."""

    bins: tuple[Bin, ...]
    within: float  # share of all pixels; .68 for a Gaussian error and its true deviation
    ratio: float  # RMS of the true error over RMS of the prediction; 1 is right on the whole
    order: float  # rank correlation of prediction and error (Spearman), 1 is perfect


def calibration(predicted: np.ndarray, error: np.ndarray, *, bins: int = 10) -> Calibration:
    """Compare `predicted` with `error`, both [...] of one shape, not negative, in the same unit.

    Of a picture the error of a pixel is the root of the mean squared difference over its channels. Bins hold equal numbers
    of pixels, in order of the prediction. NaN and infinity are refused.
    """
    u, e = np.asarray(predicted, np.float64).ravel(), np.asarray(error, np.float64).ravel()
    if np.shape(predicted) != np.shape(error) or not len(u):
        raise UserError(
            f"calibration compares maps of one shape, not {np.shape(predicted)} and {np.shape(error)}."
        )
    if not (np.isfinite(u).all() and np.isfinite(e).all() and u.min() >= 0.0 and e.min() >= 0.0):
        raise UserError("calibration takes finite errors of at least 0.")
    order = np.argsort(u, kind="stable")
    found = []
    for part in np.array_split(order, min(bins, len(u))):
        said, true = (float(np.sqrt(np.mean(x[part] ** 2))) for x in (u, e))
        found.append(Bin(len(part) / len(u), said, true, float(np.mean(e[part] <= u[part]))))
    scale = float(np.sqrt(np.mean(u**2)))
    ratio = float(np.sqrt(np.mean(e**2))) / scale if scale else float("nan")
    return Calibration(tuple(found), float(np.mean(e <= u)), ratio, _rank_correlation(u, e))


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    from scipy.stats import rankdata

    ranks = [rankdata(x) - (len(x) + 1) / 2 for x in (a, b)]
    norm = np.sqrt(np.sum(ranks[0] ** 2) * np.sum(ranks[1] ** 2))
    return float(np.sum(ranks[0] * ranks[1]) / norm) if norm else float("nan")
