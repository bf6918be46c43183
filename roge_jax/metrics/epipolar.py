"""TSED: do neighbouring frames of a generated video agree with the cameras that were asked for?

Thresholded symmetric epipolar distance (Yu et al. 2023, Photoconsistent-NVS) with the whole curve
over thresholds and a rule for pairs without a baseline. Cameras: K [n, 3, 3] in pixels (centres
at +0.5), c2w [n, 4, 4] OpenCV. float64 NumPy; OpenCV is imported only to find matches.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from roge_jax.errors import UserError, did_you_mean

THRESHOLD_PX, MIN_MATCHES, SIDE = 2.0, 10, 256
CURVE_PX = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
ZERO_BASELINE = 1e-6  # of the path length: below it the epipolar geometry is rounding noise
RATIO, EDGE_THRESHOLD = 0.8, 30

Matches = tuple[np.ndarray, np.ndarray]  # pixels [k, 2] in frame i and in frame i + 1


def fundamental(
    K_i: np.ndarray, c2w_i: np.ndarray, K_j: np.ndarray, c2w_j: np.ndarray
) -> np.ndarray:
    """F [3, 3] with x_j^T F x_i = 0: K_j^-T [t]_x R K_i^-1, (R, t) = c2w_j^-1 c2w_i."""
    motion = np.linalg.inv(np.asarray(c2w_j, np.float64)) @ np.asarray(c2w_i, np.float64)
    tx, ty, tz = motion[:3, 3]
    cross = np.array([[0.0, -tz, ty], [tz, 0.0, -tx], [-ty, tx, 0.0]])
    essential = cross @ motion[:3, :3]
    return np.linalg.inv(np.asarray(K_j, np.float64)).T @ essential @ np.linalg.inv(K_i)


def symmetric_epipolar_distance(x_i: np.ndarray, x_j: np.ndarray, F: np.ndarray) -> np.ndarray:
    """Half the sum of the distances of x_j to F x_i and of x_i to F^T x_j: [k, 2] twice -> [k] px."""
    a, b = _homogeneous(x_i), _homogeneous(x_j)

    def distance(points: np.ndarray, lines: np.ndarray) -> np.ndarray:
        norm = np.linalg.norm(lines[:, :2], axis=1)
        value = np.abs(np.sum(points * lines, axis=1))
        # at the epipole every line will do
        return np.divide(value, norm, out=np.zeros_like(value), where=norm > 0.0)

    return 0.5 * (distance(b, a @ F.T) + distance(a, b @ F))


def rotation_transfer_distance(
    x_i: np.ndarray,
    x_j: np.ndarray,
    K_i: np.ndarray,
    K_j: np.ndarray,
    rotation: np.ndarray,
) -> np.ndarray:
    """Symmetric transfer error [k] px of the homography K_j R K_i^-1, what replaces SED at t = 0."""
    H = np.asarray(K_j, np.float64) @ rotation @ np.linalg.inv(K_i)
    a, b = _homogeneous(x_i), _homogeneous(x_j)

    def distance(points: np.ndarray, mapped: np.ndarray) -> np.ndarray:
        front = mapped[:, 2] > 1e-9
        z = np.where(front, mapped[:, 2], 1.0)
        gap = np.linalg.norm(points[:, :2] - mapped[:, :2] / z[:, None], axis=1)
        return np.where(front, gap, np.inf)

    return 0.5 * (distance(b, a @ H.T) + distance(a, b @ np.linalg.inv(H).T))


def tsed_from_matches(
    matches: Sequence[Matches],
    K: np.ndarray,
    c2w: np.ndarray,
    *,
    threshold: float = THRESHOLD_PX,
    min_matches: int = MIN_MATCHES,
    zero_baseline: str = "rotation",
) -> dict[str, Any]:
    """TSED of n frames from the matches of their n - 1 neighbouring pairs.

    A pair is consistent if it has at least `min_matches` matches and their median SED is below
    (not at) `threshold` pixels. Where two requested centres are closer than 1e-6 of the path length,
    SED is meaningless (any match satisfies F = 0): 'rotation' measures the transfer error of the
    rotation homography instead, 'drop' leaves the pair out.

    Returns `tsed` (NaN if no pair is left), `median_sed` (over pairs with enough matches),
    `curve` {threshold px: share of pairs}, and the counts `pairs`, `too_few_matches`,
    `zero_baseline`, `dropped`, with the settings.
    """
    if zero_baseline not in ("rotation", "drop"):
        raise UserError(
            f"zero_baseline='{zero_baseline}' is unknown: {did_you_mean(zero_baseline, ['rotation', 'drop'])}"
        )
    K, c2w = np.asarray(K, np.float64), np.asarray(c2w, np.float64)
    n = len(matches) + 1
    if K.shape != (n, 3, 3) or c2w.shape != (n, 4, 4):
        raise UserError(
            f"{n - 1} pairs of matches need cameras of {n} frames, not K {K.shape}, c2w {c2w.shape}."
        )
    steps = np.linalg.norm(np.diff(c2w[:, :3, 3], axis=0), axis=1)
    # rounding of the centres themselves also counts as no motion
    floor = max(ZERO_BASELINE * steps.sum(), 1e-12 * np.abs(c2w[:, :3, 3]).max(initial=0.0))
    medians, counts, still, dropped = [], [], 0, 0
    for i, (x_i, x_j) in enumerate(matches):
        if steps[i] <= floor:
            still += 1
            if zero_baseline == "drop":
                dropped += 1
                continue
            rotation = c2w[i + 1, :3, :3].T @ c2w[i, :3, :3]
            distances = rotation_transfer_distance(x_i, x_j, K[i], K[i + 1], rotation)
        else:
            F = fundamental(K[i], c2w[i], K[i + 1], c2w[i + 1])
            distances = symmetric_epipolar_distance(x_i, x_j, F)
        counts.append(len(distances))
        medians.append(np.median(distances) if len(distances) else np.inf)
    median, count = np.array(medians, np.float64), np.array(counts, np.int64)
    enough = count >= min_matches

    def share(limit: float) -> float:
        return float(np.mean(enough & (median < limit))) if len(median) else float("nan")

    return {
        "tsed": share(threshold),
        "median_sed": float(np.median(median[enough])) if enough.any() else float("nan"),
        "curve": {limit: share(limit) for limit in CURVE_PX},
        "pairs": len(median),
        "too_few_matches": int(np.sum(~enough)),
        "zero_baseline": still,
        "dropped": dropped,
        "threshold_px": threshold,
        "min_matches": min_matches,
    }


def sift_matches(image_i: np.ndarray, image_j: np.ndarray, *, ratio: float = RATIO) -> Matches:
    """Mutual SIFT matches that pass the ratio test both ways; images [h, w, 3] in [0, 1].

    OpenCV SIFT with edge threshold 30; pixels [k, 2] with centres at +0.5.
    """
    import cv2

    sift = cv2.SIFT.create(edgeThreshold=EDGE_THRESHOLD)
    found = []
    for image in (image_i, image_j):
        grey = cv2.cvtColor(_bytes(image), cv2.COLOR_RGB2GRAY)
        points, descriptors = sift.detectAndCompute(grey, None)
        # OpenCV puts the centre of the first pixel at 0
        pixels = np.array([p.pt for p in points], np.float64).reshape(-1, 2) + 0.5
        found.append((pixels, descriptors))
    (x_i, d_i), (x_j, d_j) = found
    if len(x_i) < 2 or len(x_j) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)

    def best(a: np.ndarray, b: np.ndarray) -> dict[int, int]:
        pairs = matcher.knnMatch(a, b, k=2)
        return {p.queryIdx: p.trainIdx for p, q in pairs if p.distance < ratio * q.distance}

    forward, backward = best(d_i, d_j), best(d_j, d_i)
    mutual = [(i, j) for i, j in forward.items() if backward.get(j) == i]
    index = np.array(mutual, np.int64).reshape(-1, 2)
    return x_i[index[:, 0]], x_j[index[:, 1]]


def tsed(
    frames: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    *,
    side: int = SIDE,
    threshold: float = THRESHOLD_PX,
    min_matches: int = MIN_MATCHES,
    zero_baseline: str = "rotation",
) -> dict[str, Any]:
    """TSED of generated frames [n, h, w, 3] in [0, 1] against the *requested* cameras.

    Frames (and K) are resized to a short side of `side` pixels first (area down, cubic up): a
    threshold in pixels means nothing without a fixed size. See `tsed_from_matches` for the rest.
    """
    import cv2

    frames, K = np.asarray(frames), np.asarray(K, np.float64)
    if frames.ndim != 4 or frames.shape[-1] != 3 or len(frames) < 2:
        raise UserError(f"tsed takes at least two frames [n, h, w, 3], not {frames.shape}.")
    h, w = frames.shape[1:3]
    scale = side / min(h, w)
    new_h, new_w = round(h * scale), round(w * scale)
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    resized = [
        cv2.resize(np.asarray(f, np.float32), (new_w, new_h), interpolation=how) for f in frames
    ]
    K = np.diag([new_w / w, new_h / h, 1.0]) @ K  # pixel edges stay at 0 and the new width
    matches = [sift_matches(a, b) for a, b in itertools.pairwise(resized)]
    result = tsed_from_matches(
        matches,
        K,
        c2w,
        threshold=threshold,
        min_matches=min_matches,
        zero_baseline=zero_baseline,
    )
    return result | {"short_side": side}


def _homogeneous(x: np.ndarray) -> np.ndarray:
    x = np.asarray(x, np.float64).reshape(-1, 2)
    return np.concatenate([x, np.ones((len(x), 1))], axis=1)


def _bytes(image: np.ndarray) -> np.ndarray:
    return np.rint(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
