"""The classic way without learning: depth of the target view by plane sweep and semi-global matching, photos blended.

Collins 1996 (planes of the target view), Hirschmueller 2008 (aggregation along eight directions). What a learned reconstruction
has to beat where photos lie close together. Inputs as in `metrics.baselines`; none sees the target's pixels. Needs OpenCV.
"""

from typing import NamedTuple

import numpy as np

from roge_jax.metrics.baselines import (
    plane,
    plane_sweep,
    view_distances,
    warp,
)

PLANES, MOST_PHOTOS = 64, 5
COLOUR, PATTERN, MIX = (
    0.08,
    1.2,
    0.6,
)  # mean differences that cost 1, and the share of the pattern in the cost
FLOOR = 0.02  # contrast below which luma counts as flat
WINDOW = 5  # over which costs are averaged
UNKNOWN = 0.6  # cost of a plane on which no two photos have the pixel in view
STEP, JUMP = (
    0.2,
    4.0,
)  # what a step of one plane between neighbouring pixels costs, and any larger one
OVERLAP = 0.5  # a plane counts for the range if two photos share this part of the most that they share on any
SURE, TAIL, MARGIN = (
    0.7,
    0.02,
    1.2,
)  # the range: cheapest part of the pixels, what is cut at its ends, what is added
AGREE = 0.08  # difference of colour at which two photos no longer say the same


class View(NamedTuple):
    """The target view as the photos have it, and the geometry behind it."""

    rgb: np.ndarray  # [h, w, 3]
    depth: np.ndarray  # [h, w] z-depth; inf where nothing could be compared


def sweep_view(
    context_rgb: np.ndarray,
    context_K: np.ndarray,
    context_c2w: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    size: tuple[int, int],
    *,
    planes: int = PLANES,
) -> View:
    """One target view of `size` from two or more photos, of which the nearest five are used.

    With one photo, or all cameras in one place, there is no depth to find: the plane at infinity (`baselines.plane`).
    """
    context = [np.asarray(x, np.float64) for x in (context_rgb, context_K, context_c2w)]
    near = np.argsort(view_distances(context[2], c2w), kind="stable")[:MOST_PHOTOS]
    rgb, Ks, poses = (x[near] for x in context)
    guess = plane_sweep(rgb, Ks, poses, K, c2w, size).depth
    if not np.isfinite(guess):
        return View(plane(rgb, Ks, poses, K, c2w, size, np.inf), np.full(size, np.inf))
    inverse = _range(rgb, Ks, poses, K, c2w, size, planes)
    depth = 1.0 / _inverse_depth(rgb, Ks, poses, K, c2w, size, inverse)
    return View(_blend(rgb, Ks, poses, K, c2w, depth), depth)


def _range(rgb, Ks, poses, K, c2w, size, planes) -> np.ndarray:
    """Inverse depths [planes] that cover the scene, uniform: where a sweep of wide range at a third of the size is sure.

    Only planes count on which two photos share much of the view: slivers agree by chance.
    """
    from roge_jax.geometry.crops import resize

    centres = np.concatenate([poses[:, :3, 3], np.asarray(c2w)[None, :3, 3]])
    extent = np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()
    h, w = (max(8, round(side / 3)) for side in size)
    small = np.stack([resize(x, *(max(8, round(n / 3)) for n in x.shape[:2])) for x in rgb])
    photo = np.diag([small.shape[2] / rgb.shape[2], small.shape[1] / rgb.shape[1], 1.0])
    target = np.diag([w / size[1], h / size[0], 1.0])
    wide = 1.0 / (extent * np.geomspace(200.0, 0.3, planes))
    cost = _costs(small, photo @ Ks, poses, target @ K, c2w, (h, w), wide)
    overlap = np.isfinite(cost).mean((0, 1))
    shared = overlap >= OVERLAP * overlap.max()
    wide, cost = wide[shared], cost[..., shared]
    total = _aggregated(np.where(np.isfinite(cost), cost, UNKNOWN))
    best, least = np.argmin(total, axis=-1), total.min(-1)
    found = np.isfinite(np.take_along_axis(cost, best[..., None], -1)[..., 0])
    if not found.any():
        found[:] = True
    sure = found & (least <= np.quantile(least[found], SURE))
    low, high = np.quantile(wide[best[sure]], [TAIL, 1.0 - TAIL])
    return np.linspace(low / MARGIN, high * MARGIN, planes)


def _inverse_depth(rgb, Ks, poses, K, c2w, size, inverse) -> np.ndarray:
    """Inverse depth [h, w] from candidates `inverse` [d]: matching cost, aggregation, best plane and its parabola."""
    import cv2

    cost = _costs(rgb, Ks, poses, K, c2w, size, inverse)
    cost = _aggregated(np.where(np.isfinite(cost), cost, UNKNOWN))
    best = np.argmin(cost, axis=-1)
    inner = np.clip(best, 1, len(inverse) - 2)
    left, middle, right = (
        np.take_along_axis(cost, (inner + i)[..., None], -1)[..., 0] for i in (-1, 0, 1)
    )
    bend = np.maximum(left - 2.0 * middle + right, 1e-6)
    place = np.where(best == inner, inner + np.clip(0.5 * (left - right) / bend, -0.5, 0.5), best)
    found = np.interp(place, np.arange(len(inverse)), inverse)
    return cv2.medianBlur(found.astype(np.float32), 5).astype(np.float64)


def _costs(rgb, Ks, poses, K, c2w, size, inverse) -> np.ndarray:
    """Matching cost [h, w, d], 0 to 1: difference of colour and pattern over pairs of photos, the worse half dropped.

    Infinite where no two photos have the pixel in view.
    """
    import cv2

    features = [np.dstack([x / COLOUR, _pattern(x) / PATTERN]).astype(np.float32) for x in rgb]
    pairs = [(i, j) for j in range(len(rgb)) for i in range(j)]
    costs = np.empty((*size, len(inverse)), np.float32)
    for d, value in enumerate(inverse):
        seen, valid = [], []
        for x, k, pose in zip(features, Ks, poses):
            motion = np.linalg.inv(pose) @ c2w
            # the plane z = 1 / value; OpenCV counts pixel centres as whole numbers
            sheet = motion[:3, :3] + np.outer(motion[:3, 3], [0.0, 0.0, value])
            half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
            homography = np.linalg.inv(half) @ k @ sheet @ np.linalg.inv(K) @ half
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            args = (homography, size[::-1])
            seen.append(cv2.warpPerspective(x, *args, flags=flags, borderMode=cv2.BORDER_REPLICATE))
            one = np.ones(x.shape[:2], np.float32)
            valid.append(cv2.warpPerspective(one, *args, flags=flags) > 0.5)
        differences = []
        for i, j in pairs:
            apart = np.abs(seen[i] - seen[j])
            colour, pattern = apart[..., :3].mean(-1), apart[..., 3]
            mixed = (1.0 - MIX) * np.minimum(colour, 1.0) + MIX * np.minimum(pattern, 1.0)
            differences.append(np.where(valid[i] & valid[j], mixed, np.inf))
        ordered = np.sort(np.stack(differences), axis=0)
        kept = (np.isfinite(ordered).sum(0) + 1) // 2
        take = np.arange(len(pairs))[:, None, None] < kept[None]
        known = (kept > 0).astype(np.float32)
        total = np.where(take, ordered, 0.0).sum(0) / np.maximum(kept, 1)
        weight = np.maximum(cv2.blur(known, (WINDOW, WINDOW)), 1e-6)
        total = cv2.blur(total.astype(np.float32), (WINDOW, WINDOW)) / weight
        costs[..., d] = np.where(known > 0.0, total, np.inf)
    return costs


def _pattern(rgb: np.ndarray) -> np.ndarray:
    """Luma of zero mean and unit variance in windows of 7 pixels, flat parts near 0: [h, w]."""
    import cv2

    luma = rgb @ np.array([0.299, 0.587, 0.114])
    mean, square = (cv2.blur(x, (7, 7)) for x in (luma, luma**2))
    return (luma - mean) / np.sqrt(np.maximum(square - mean**2, 0.0) + FLOOR**2)


def _aggregated(cost: np.ndarray) -> np.ndarray:
    """Sum over eight directions of the cheapest path to each pixel and plane (Hirschmueller 2008, eq. 13): [h, w, d]."""
    total = np.zeros_like(cost)
    for turned in (False, True):
        c, t = (x.swapaxes(0, 1) if turned else x for x in (cost, total))
        for back in (False, True):
            rows = range(len(c) - 1, -1, -1) if back else range(len(c))
            for slope in (-1, 0, 1) if not turned else (0,):
                before = None
                for y in rows:
                    here = c[y].copy()
                    if before is not None:
                        last = np.roll(before, slope, 0)
                        if slope:  # a path begins at the border
                            last[0 if slope > 0 else -1] = 0.0
                        least = last.min(-1, keepdims=True)
                        way = np.minimum(last, least + JUMP)
                        np.minimum(way[:, 1:], last[:, :-1] + STEP, out=way[:, 1:])
                        np.minimum(way[:, :-1], last[:, 1:] + STEP, out=way[:, :-1])
                        here += way - least
                    t[y] += here
                    before = here
    return total


def _blend(rgb, Ks, poses, K, c2w, depth) -> np.ndarray:
    """Photos at the depth found, weighted by nearness and by how far they agree: [h, w, 3]."""
    near = 1.0 / np.maximum(view_distances(poses, c2w, float(np.median(depth))), 1e-3) ** 2
    warps = [warp(x, k, pose, K, c2w, depth) for x, k, pose in zip(rgb, Ks, poses)]
    colours = np.stack([one.rgb for one in warps])
    shares = np.stack([n * one.valid for n, one in zip(near, warps)])
    lost = shares.sum(0) <= 0.0
    shares[:, lost] = near[:, None]
    apart = ((colours[:, None] - colours[None]) ** 2).mean(-1)
    support = (np.exp(-apart / (2 * AGREE**2)) * shares[None]).sum(1)
    shares = shares * support**2
    return (shares[..., None] * colours).sum(0) / shares.sum(0)[..., None]
