"""Do the photos agree with their poses and focal lengths? Epipolar distances of features matched by OpenCV's SIFT.

`pose_agreement` judges a whole scene in pixels of the photos (`check`). `photo_matches`, `misfits` and `focal_error` judge
the photos that a model is given, in pixels of the pictures it sees of them (`scene_limits`).
"""

from collections.abc import Sequence

import numpy as np

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import (
    Cameras,
    crop_resize_K,
    invert,
    resize,
    scale_focal,
    scale_K,
    to_host,
)
from roge_jax.geometry.crops import cover_window

MIN_MATCHES = 20
LONG_SIDE = 640  # matching happens on pictures of at most this size
PARTNERS = 2  # views that each photo is matched with
LEAST = 1.0  # times the model's size: smaller photos are not matched for it, nothing was measured
SLACK = 1.1  # a focal length fits as well as the best one if distances are at most this much larger
FACTORS = np.exp(0.7 * np.linspace(-1.0, 1.0, 101) ** 3)  # of focal lengths: 0.5 to 2, dense at 1

Pair = tuple[int, int]
Matches = dict[Pair, tuple[np.ndarray, np.ndarray]]  # pixels [p, 2] in the one and the other view


Features = tuple[np.ndarray, np.ndarray]  # pixels [p, 2] (edges at 0), SIFT descriptors [p, 128]


def features(image: np.ndarray) -> Features | None:
    """SIFT features of a picture [h, w, 3] in [0, 1], None if there are fewer than 20."""
    import cv2

    sift = cv2.SIFT_create(2000)  # type: ignore[attr-defined]
    grey = cv2.cvtColor((image * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    keys, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None or len(keys) < MIN_MATCHES:
        return None
    # OpenCV counts pixel centres as whole numbers.
    return np.array([key.pt for key in keys]) + 0.5, descriptors


def matched_features(
    a: Features | None, b: Features | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Matched pixels [p, 2] of two pictures, or None if fewer than 20 agree.

    Ratio test, mutual matches, then outliers are removed by a fundamental matrix estimated from the
    matches alone (a homography if they lie on a plane), so the result does not depend on any given
    pose.
    """
    import cv2

    if a is None or b is None:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    one_way = []
    for first, second in ((a, b), (b, a)):
        pairs = matcher.knnMatch(first[1], second[1], k=2)
        good = (p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.75 * p[1].distance)
        one_way.append({match.queryIdx: match.trainIdx for match in good})
    mutual = [(i, j) for i, j in one_way[0].items() if one_way[1].get(j) == i]
    if len(mutual) < MIN_MATCHES:
        return None
    i, j = np.array(mutual).T
    x, y = a[0][i], b[0][j]
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


def in_front(x: np.ndarray, y: np.ndarray, a: Cameras, b: Cameras) -> float:
    """The share of matches x, y [p, 2] whose rays come closest to each other in front of both cameras."""
    rays = []
    for pixels, camera in ((x, a), (y, b)):
        local = np.hstack([pixels, np.ones((len(pixels), 1))]) @ np.linalg.inv(camera.K[0]).T
        rays.append(local @ camera.c2w[0, :3, :3].T)
    between = b.centres[0] - a.centres[0]
    aa, bb, ab = (rays[0] ** 2).sum(1), (rays[1] ** 2).sum(1), (rays[0] * rays[1]).sum(1)
    det = np.maximum(aa * bb - ab**2, 1e-300)
    first = (bb * (rays[0] @ between) - ab * (rays[1] @ between)) / det
    second = (ab * (rays[0] @ between) - aa * (rays[1] @ between)) / det
    return float(np.mean((first > 0) & (second > 0)))


def neighbour_pairs(cameras: Cameras, count: int) -> list[tuple[int, int]]:
    """Up to `count` pairs of views spread over the scene that look alike but do not coincide."""
    views = np.unique(np.linspace(0, len(cameras) - 1, count).round().astype(int))
    return partners(cameras, views, 1)


def partners(cameras: Cameras, views: Sequence[int] | np.ndarray, count: int) -> list[Pair]:
    """The pairs (i, j), i < j, of each of `views` with the `count` views of the scene that suit it best.

    A baseline of a tenth of the scene's extent is asked for, since shorter ones leave poses untested, and a like
    direction; views in one place or turned by more than 50 degrees make no pair.
    """
    cameras = to_host(cameras)
    views = np.asarray(views)
    apart = np.linalg.norm(cameras.centres[views, None] - cameras.centres[None], axis=-1)
    turned = cameras.c2w[:, :3, :3]
    traces = np.einsum("aij,bij->ab", turned[views], turned)
    angles = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    extent = apart.max()
    if extent <= 1e-12 * np.abs(cameras.centres).max():
        return []
    cost = np.abs(apart / extent - 0.1) + angles
    cost[(apart < 1e-3 * extent) | (angles > np.radians(50))] = np.inf
    pairs = set()
    for view, row in zip(views, cost, strict=True):
        for other in np.argsort(row, kind="stable")[:count]:
            if np.isfinite(row[other]):
                pairs.add((min(int(view), int(other)), max(int(view), int(other))))
    return sorted(pairs)


def shrink(image: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A picture [h, w, 3] and its K at no more than LONG_SIDE pixels."""
    size = image.shape[:2]
    factor = min(1.0, LONG_SIDE / max(size))
    smaller = (round(size[0] * factor), round(size[1] * factor))
    return resize(image, *smaller), scale_K(K, size, smaller)


def photo_matches(
    images: Sequence[np.ndarray], cameras: Cameras, views: Sequence[int], height: int, width: int
) -> Matches:
    """Matches of each of `views` with its partners in a scene, in pixels of the height x width pictures of them.

    Those are what `crop_resize` makes of the photos; matching happens on the photos before, at no more than LONG_SIDE
    pixels, and what the crop cuts away is left out. No entry for pairs with fewer than 20 matches, photos that cannot
    be read, or that are smaller than LEAST times the picture. cameras: one for each of `images`, K in its pixels.
    """
    pairs = partners(cameras, views, PARTNERS)

    def seen(view: int) -> tuple[Features | None, tuple[int, int]]:
        try:
            image = images[view]
        except UserError:  # damaged; not this check's business
            return None, (1, 1)
        image, _ = shrink(image, np.eye(3))
        size = (image.shape[0], image.shape[1])
        large = cover_window(size, (height, width))[2] >= LEAST * height
        return (features(image) if large else None), size

    found = {view: seen(view) for view in sorted({view for pair in pairs for view in pair})}
    matches: Matches = {}
    for i, j in pairs:
        both = matches_inside(found[i], found[j], height, width)
        if both is not None:
            matches[i, j] = both
    return matches


Seen = tuple[Features | None, tuple[int, int]]  # of a picture, and its size


def matches_inside(
    one: Seen, other: Seen, height: int, width: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Matched pixels [p, 2] of the height x width pictures that `crop_resize` makes of two photos, or None if fewer than
    20 lie inside both.
    """
    both = matched_features(one[0], other[0])
    if both is None:
        return None
    moved = [_cropped(x, seen[1], height, width) for x, seen in zip(both, (one, other))]
    inside = [((x > 0) & (x < (width, height))).all(1) for x in moved]
    keep = inside[0] & inside[1]
    return (moved[0][keep], moved[1][keep]) if keep.sum() >= MIN_MATCHES else None


def _cropped(x: np.ndarray, source: tuple[int, int], height: int, width: int) -> np.ndarray:
    """Pixels [p, 2] of a picture of size `source` as pixels of what `crop_resize` makes of it."""
    K = crop_resize_K(np.eye(3), source, (height, width))
    return x * K[[0, 1], [0, 1]] + K[:2, 2]


def misfits(matches: Matches, cameras: Cameras) -> dict[Pair, float]:
    """Median epipolar distance of every pair in pixels; `cameras` of the whole scene, K in those pixels."""
    return {
        (i, j): float(np.median(epipolar_distances(*both, cameras[i], cameras[j])))
        for (i, j), both in matches.items()
    }


def photo_misfits(distances: dict[Pair, float], views: Sequence[int]) -> np.ndarray:
    """Of each of `views` the `misfits` to the partner that it fits best, [m]; NaN where it has none.

    The best, since a photo with a wrong pose fits none of its partners, and one with a wrong partner fits the other.
    """
    own = [[d for pair, d in distances.items() if view in pair] for view in views]
    return np.array([min(d) if d else np.nan for d in own])


def focal_error(matches: Matches, cameras: Cameras) -> tuple[float, float]:
    """(by how much at least the focal lengths are wrong, how much better others fit).

    All focal lengths are multiplied by FACTORS; what is compared is the mean over pairs of the median distance. The first
    number is the factor nearest to 1 within SLACK of the best, minus 1; the second what is given over the best. Errors of
    poses make some other focal length fit a little better, too: the first means something only where the second is large.
    (0, about 1) for cameras that move without turning: there a wrong focal length is another depth, no contradiction.
    """
    cost = np.array(
        [
            np.mean(list(misfits(matches, scale_focal(cameras, factor)).values()))
            for factor in FACTORS
        ]
    )
    given = cost[np.argmin(np.abs(FACTORS - 1.0))]
    near = min(FACTORS[cost <= SLACK * cost.min()], key=lambda factor: abs(np.log(factor)))
    return float(near - 1.0), float(given / max(cost.min(), 1e-12))


def pose_agreement(
    images: Sequence[np.ndarray], candidates: dict[str, Cameras], count: int = 8
) -> tuple[dict[str, float], int]:
    """Median epipolar distance in pixels under each set of candidate cameras, and the pairs used.

    The first candidate chooses the pairs. Another one under which most points would lie behind the cameras is infinitely
    far: lines alone cannot tell mirrored photos from turned axes. Distances are NaN if no pair could be matched.
    """
    first_name, first = next(iter(candidates.items()))
    medians: dict[str, list[float]] = {name: [] for name in candidates}
    for i, j in neighbour_pairs(first, count):
        image_i, _ = shrink(images[i], first.K[i])
        image_j, _ = shrink(images[j], first.K[j])
        matches = matched_features(features(image_i), features(image_j))
        if matches is None:
            continue
        for name, cameras in candidates.items():
            a = Cameras(_at(cameras.K[i], images[i], image_i)[None], cameras.c2w[i : i + 1])
            b = Cameras(_at(cameras.K[j], images[j], image_j)[None], cameras.c2w[j : j + 1])
            off = float(np.median(epipolar_distances(*matches, a, b)))
            behind = name != first_name and in_front(*matches, a, b) < 0.5
            medians[name].append(np.inf if behind else off)
    used = len(next(iter(medians.values())))
    return {n: float(np.median(v)) if v else float("nan") for n, v in medians.items()}, used


def _at(K: np.ndarray, image: np.ndarray, smaller: np.ndarray) -> np.ndarray:
    """K of a photo in pixels of its smaller copy."""
    return scale_K(K, (image.shape[0], image.shape[1]), (smaller.shape[0], smaller.shape[1]))
