"""Do the photos agree with their poses? Epipolar distances of features matched by OpenCV's SIFT."""

from collections.abc import Sequence

import numpy as np

from roge_jax.geometry.cameras import Cameras, invert, resize, scale_K, to_host

MIN_MATCHES = 20
LONG_SIDE = 640  # matching happens on pictures of at most this size; errors are in its pixels


def matched_pixels(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Matched pixels [p, 2] of two pictures [h, w, 3] in [0, 1], or None if fewer than 20 agree.

    Ratio test, mutual matches, then outliers are removed by a fundamental matrix estimated from the
    matches alone (a homography if they lie on a plane), so the result does not depend on any given
    pose. Pixel edges lie at 0.
    """
    import cv2

    sift = cv2.SIFT_create(2000)  # type: ignore[attr-defined]
    found = []
    for image in (a, b):
        grey = cv2.cvtColor((image * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        keys, descriptors = sift.detectAndCompute(grey, None)
        if descriptors is None or len(keys) < MIN_MATCHES:
            return None
        # OpenCV counts pixel centres as whole numbers.
        found.append((np.array([key.pt for key in keys]) + 0.5, descriptors))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    one_way = []
    for first, second in ((0, 1), (1, 0)):
        pairs = matcher.knnMatch(found[first][1], found[second][1], k=2)
        good = (p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.75 * p[1].distance)
        one_way.append({match.queryIdx: match.trainIdx for match in good})
    mutual = [(i, j) for i, j in one_way[0].items() if one_way[1].get(j) == i]
    if len(mutual) < MIN_MATCHES:
        return None
    i, j = np.array(mutual).T
    x, y = found[0][0][i], found[1][0][j]
    try:
        _, inliers = cv2.findFundamentalMat(x, y, cv2.USAC_MAGSAC, 1.5, 0.999, 10000)
    except cv2.error:  # points on a plane leave F undetermined
        _, inliers = cv2.findHomography(x, y, cv2.USAC_MAGSAC, 3.0)
    if inliers is None or inliers.sum() < MIN_MATCHES:
        return None
    keep = inliers.ravel().astype(bool)
    return x[keep], y[keep]


def epipolar_distances(x: np.ndarray, y: np.ndarray, a: Cameras, b: Cameras) -> np.ndarray:
    """Mean distance in pixels [p] of matches x, y [p, 2] from each other's epipolar lines.

    a, b: one camera each. Infinite where the two centres coincide (there are no epipolar lines).
    """
    relative = invert(b.c2w[0]) @ a.c2w[0]
    tx, ty, tz = relative[:3, 3]
    cross = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]])
    F = np.linalg.inv(b.K[0]).T @ cross @ relative[:3, :3] @ np.linalg.inv(a.K[0])
    ones = np.ones((len(x), 1))
    x, y = np.hstack([x, ones]), np.hstack([y, ones])
    in_b, in_a = x @ F.T, y @ F
    value = np.abs((y * in_b).sum(-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        each = [value / np.linalg.norm(line[:, :2], axis=-1) for line in (in_a, in_b)]
    return np.nan_to_num(0.5 * (each[0] + each[1]), nan=np.inf)


def neighbour_pairs(cameras: Cameras, count: int) -> list[tuple[int, int]]:
    """Up to `count` pairs of views spread over the scene that look alike but do not coincide."""
    cameras = to_host(cameras)
    apart = np.linalg.norm(cameras.centres[:, None] - cameras.centres[None], axis=-1)
    traces = np.einsum("aij,bij->ab", cameras.c2w[:, :3, :3], cameras.c2w[:, :3, :3])
    angles = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    extent = apart.max()
    if extent <= 1e-12 * np.abs(cameras.centres).max():
        return []
    # A baseline of a tenth of the scene's extent is asked for: shorter ones leave poses untested.
    cost = np.abs(apart / extent - 0.1) + angles
    cost[(apart < 1e-3 * extent) | (angles > np.radians(50))] = np.inf
    pairs = set()
    for view in np.unique(np.linspace(0, len(cameras) - 1, count).round().astype(int)):
        other = int(np.argmin(cost[view]))
        if np.isfinite(cost[view, other]):
            pairs.add((min(int(view), other), max(int(view), other)))
    return sorted(pairs)


def shrink(image: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A picture [h, w, 3] and its K at no more than LONG_SIDE pixels."""
    size = image.shape[:2]
    factor = min(1.0, LONG_SIDE / max(size))
    smaller = (round(size[0] * factor), round(size[1] * factor))
    return resize(image, *smaller), scale_K(K, size, smaller)


def pose_agreement(
    images: Sequence[np.ndarray], candidates: dict[str, Cameras], count: int = 8
) -> tuple[dict[str, float], int]:
    """Median epipolar distance in pixels under each set of candidate cameras, and the pairs used.

    The first candidate chooses the pairs. Distances are NaN if no pair could be matched.
    """
    first = next(iter(candidates.values()))
    medians: dict[str, list[float]] = {name: [] for name in candidates}
    for i, j in neighbour_pairs(first, count):
        image_i, K_i = shrink(images[i], first.K[i])
        image_j, K_j = shrink(images[j], first.K[j])
        matches = matched_pixels(image_i, image_j)
        if matches is None:
            continue
        for name, cameras in candidates.items():
            a = Cameras(K_i[None], cameras.c2w[i : i + 1])
            b = Cameras(K_j[None], cameras.c2w[j : j + 1])
            medians[name].append(float(np.median(epipolar_distances(*matches, a, b))))
    used = len(next(iter(medians.values())))
    return {n: float(np.median(v)) if v else float("nan") for n, v in medians.items()}, used
