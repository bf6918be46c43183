"""What a model must beat: copies, means and warps of the context photos. Pure NumPy, no learning.

Inputs everywhere: `context_rgb` [m, h, w, 3] in [0, 1], `context_K` [m, 3, 3], `context_c2w`
[m, 4, 4], one target camera `K` [3, 3], `c2w` [4, 4] and the target's `size` (h, w). K in pixels
with centres at +0.5, c2w with OpenCV axes, depth = z in the target camera in the unit of c2w.
No function sees the target's pixels. docs/reference/metrics.md says how strong each baseline is and why.
"""

from typing import NamedTuple

import numpy as np

from roge_jax.errors import UserError

MAX_SUPERSAMPLING = 4
SWEEP_PLANES, SWEEP_WIDTH, MIN_OVERLAP = 64, 96, 0.5


class Warp(NamedTuple):
    """A photo seen from another camera, and where it says anything."""

    rgb: (
        np.ndarray
    )  # [h, w, 3]; where invalid: the colour of the nearest point of the photo's border
    valid: np.ndarray  # [h, w] bool: the pixel's centre lands inside the photo, in front of it


def warp(
    rgb: np.ndarray,
    K_source: np.ndarray,
    c2w_source: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    depth: np.ndarray,
) -> Warp:
    """The photo `rgb` [h', w', 3] seen from the target camera if its surface has `depth` [h, w].

    A constant depth is the homography of the plane z = depth. Bilinear; where a target pixel
    covers s > 1 photo pixels, it is the mean of ceil(s)^2 (at most 16) samples. Infinite depth is
    allowed (rotation only).
    """
    grid = pixel_grid(*depth.shape)
    xy, z = project(grid, depth, K_source, c2w_source, K, c2w)
    valid = (z > 0.0) & _inside(xy, rgb.shape)
    steps = _supersampling(xy, valid)
    offsets = (np.arange(steps) + 0.5) / steps - 0.5
    total = np.zeros((*depth.shape, 3))
    for dy in offsets:
        for dx in offsets:
            if steps > 1:
                xy, _ = project(grid + np.array([dx, dy]), depth, K_source, c2w_source, K, c2w)
            total += bilinear(rgb, xy)
    return Warp(total / steps**2, valid)


def bilinear(rgb: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Colours [..., c] of `rgb` [h, w, c] at pixels `xy` [..., 2] (centres at +0.5), border repeated."""
    h, w = rgb.shape[:2]
    x = np.clip(xy[..., 0] - 0.5, 0.0, w - 1.0)
    y = np.clip(xy[..., 1] - 0.5, 0.0, h - 1.0)
    x0 = np.minimum(x.astype(np.int64), max(w - 2, 0))
    y0 = np.minimum(y.astype(np.int64), max(h - 2, 0))
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    top = rgb[y0, x0] * (1.0 - fx) + rgb[y0, x1] * fx
    bottom = rgb[y1, x0] * (1.0 - fx) + rgb[y1, x1] * fx
    return top * (1.0 - fy) + bottom * fy


def view_distances(
    context_c2w: np.ndarray, c2w: np.ndarray, depth: float | None = None
) -> np.ndarray:
    """How far each context view is from the target view, [m], no unit: what 'nearest' means here.

    Distance of the centres over `depth` (roughly the parallax angle), plus the angle between the
    orientations as a chord (2 sin(angle / 2)). Without a depth, the largest distance between any
    two of the cameras takes its place.
    """
    context_c2w, c2w = np.asarray(context_c2w, np.float64), np.asarray(c2w, np.float64)
    centres = np.concatenate([context_c2w[:, :3, 3], c2w[None, :3, 3]])
    offsets = np.linalg.norm(centres[:-1] - centres[-1], axis=1)
    scale = depth if depth is not None else _extent(centres)
    chord = np.linalg.norm(context_c2w[:, :3, :3] - c2w[None, :3, :3], axis=(1, 2)) / np.sqrt(2.0)
    # all cameras at one place (and no depth): only the angle is left
    return chord + (offsets / scale if scale > 0.0 else 0.0)


def nearest(
    context_rgb: np.ndarray,
    context_c2w: np.ndarray,
    c2w: np.ndarray,
    depth: float | None = None,
) -> np.ndarray:
    """A copy of the photo whose camera is nearest (`view_distances`): [h, w, 3]."""
    return np.asarray(context_rgb)[np.argmin(view_distances(context_c2w, c2w, depth))]


def mean_context(context_rgb: np.ndarray) -> np.ndarray:
    """The mean of the photos, [h, w, 3]: what blur alone earns."""
    return np.mean(np.asarray(context_rgb, np.float64), axis=0)


def depth_warp(
    context_rgb: np.ndarray,
    context_K: np.ndarray,
    context_c2w: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    depth: np.ndarray,
) -> np.ndarray:
    """Reference with the *true* depth map [h, w] of the target: each pixel from the nearest photo
    that has it in view, without any test for occlusion. [h, w, 3].

    Pixels with infinite depth (sky) are fetched by rotation alone.
    """
    context_rgb, depth = np.asarray(context_rgb, np.float64), np.asarray(depth, np.float64)
    _check(context_rgb, context_K, context_c2w, K, c2w, depth)
    warps = [
        warp(rgb, k, pose, K, c2w, depth)
        for rgb, k, pose in zip(context_rgb, context_K, context_c2w)
    ]
    order = np.argsort(view_distances(context_c2w, c2w, _median_depth(depth)), kind="stable")
    return _nearest_valid(warps, order)


def plane(
    context_rgb: np.ndarray,
    context_K: np.ndarray,
    context_c2w: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    size: tuple[int, int],
    depth: float,
    *,
    combine: str = "blend",
) -> np.ndarray:
    """The photos warped by the homographies of the plane z = `depth` of the target view: [h, w, 3].

    combine 'nearest' takes each pixel from the nearest photo that has it in view; 'blend' (the
    default, the stronger one) averages the photos that have it in view, weighted by 1 / squared
    view distance. Pixels in no photo repeat the border of the nearest one.
    """
    context_rgb = np.asarray(context_rgb, np.float64)
    if not depth > 0.0:
        raise UserError(f"The plane's depth must be positive, not {depth}.")
    depths = np.full(size, float(depth))
    _check(context_rgb, context_K, context_c2w, K, c2w, depths)
    warps = [
        warp(rgb, k, pose, K, c2w, depths)
        for rgb, k, pose in zip(context_rgb, context_K, context_c2w)
    ]
    distances = view_distances(context_c2w, c2w, depth)
    base = _nearest_valid(warps, np.argsort(distances, kind="stable"))
    if combine == "nearest":
        return base
    if combine != "blend":
        raise UserError(f"combine must be 'blend' or 'nearest', not '{combine}'.")
    # a photo taken from the target camera itself gets all the weight
    weights = 1.0 / np.maximum(distances / max(distances.max(), 1e-12), 1e-6) ** 2
    shares = np.stack([w * one.valid for w, one in zip(weights, warps)])[..., None]
    total = shares.sum(axis=0)
    mixed = sum(share * one.rgb for share, one in zip(shares, warps)) / np.where(
        total > 0.0, total, 1.0
    )
    return np.where(total > 0.0, mixed, base)


class Sweep(NamedTuple):
    """The plane on which the photos agree best, and how far to trust it."""

    depth: float  # inf if nothing can be compared: rotation only
    overlap: float  # share of the target's pixels that at least two photos see on that plane
    disagreement: float  # RMS colour difference there; NaN if nothing can be compared


def plane_sweep(
    context_rgb: np.ndarray,
    context_K: np.ndarray,
    context_c2w: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    size: tuple[int, int],
    depths: np.ndarray | None = None,
    *,
    min_overlap: float = MIN_OVERLAP,
) -> Sweep:
    """The depth of the plane on which the context photos agree best, for scenes without depth.

    Each candidate plane z = d of the target view is scored by the mean variance of the warped
    photos over the pixels that two or more of them see. Planes where that overlap is below
    `min_overlap` of the frame are not eligible (a sliver agrees by chance and makes an absurd, too
    easy baseline); if none has that much, the planes with at least 3/4 of the best overlap are.
    Works on photos shrunk to about 96 pixels. With one photo, or no baseline between the
    photos and the target, depth is inf.

    depths: candidates; default 64 from 0.3 to 200 times the largest distance between the cameras,
    uniform in log depth.
    """
    context_rgb = np.asarray(context_rgb, np.float64)
    _check(context_rgb, context_K, context_c2w, K, c2w, np.empty(size))
    centres = np.concatenate([np.asarray(context_c2w)[:, :3, 3], np.asarray(c2w)[None, :3, 3]])
    extent = _extent(centres.astype(np.float64))
    if len(context_rgb) < 2 or extent <= 1e-12 * np.abs(centres).max(initial=0.0):
        return Sweep(float("inf"), float("nan"), float("nan"))
    if depths is None:
        depths = extent * np.geomspace(0.3, 200.0, SWEEP_PLANES)
    factor = max(1, min(size) // SWEEP_WIDTH, context_rgb.shape[2] // SWEEP_WIDTH)
    small = _shrink(context_rgb, factor)
    shrink = np.diag([1.0 / factor, 1.0 / factor, 1.0])
    grid = pixel_grid(max(1, size[0] // factor), max(1, size[1] // factor))
    found = []
    for d in np.asarray(depths, np.float64):
        depth = np.full(grid.shape[:2], d)
        count = np.zeros(grid.shape[:2])
        total, squares = np.zeros((*grid.shape[:2], 3)), np.zeros((*grid.shape[:2], 3))
        for rgb, k, pose in zip(small, context_K, context_c2w):
            xy, z = project(grid, depth, shrink @ k, pose, shrink @ np.asarray(K), c2w)
            valid = (z > 0.0) & _inside(xy, rgb.shape)
            colour = bilinear(rgb, xy) * valid[..., None]
            count += valid
            total += colour
            squares += colour**2
        shared = count >= 2
        if not shared.any():
            continue
        # unbiased, so that pixels seen by two and by three photos count alike
        n = count[shared][:, None]
        variance = np.maximum(squares[shared] - total[shared] ** 2 / n, 0.0) / (n - 1.0)
        found.append((float(d), float(shared.mean()), float(np.mean(variance))))
    if not found:
        return Sweep(float("inf"), 0.0, float("nan"))
    best_overlap = max(overlap for _, overlap, _ in found)
    limit = min_overlap if best_overlap >= min_overlap else 0.75 * best_overlap
    best = min((one for one in found if one[1] >= limit), key=lambda candidate: candidate[2])
    return Sweep(best[0], best[1], float(np.sqrt(2.0 * best[2])))


def baselines(
    context_rgb: np.ndarray,
    context_K: np.ndarray,
    context_c2w: np.ndarray,
    target_K: np.ndarray,
    target_c2w: np.ndarray,
    size: tuple[int, int],
    target_depth: np.ndarray | None = None,
) -> tuple[dict[str, np.ndarray], list[float]]:
    """All baselines for n target views: {method: [n, h, w, 3] float64}, and the planes' depths [n].

    target_K [n, 3, 3], target_c2w [n, 4, 4], target_depth [n, h, w] or None; in a depth map, 0
    and NaN mean unknown. With depth the plane lies at the true median of each target view and
    `depth_warp` is added where every pixel is known; without, `plane_sweep` finds the plane.
    """
    frames: dict[str, list[np.ndarray]] = {"nearest": [], "mean_context": [], "plane": []}
    whole = target_depth is not None and bool(np.all(np.asarray(target_depth) > 0.0))
    if whole:
        frames["depth_warp"] = []
    mean = mean_context(context_rgb)
    depths = []
    for i, (K, c2w) in enumerate(zip(target_K, target_c2w)):
        context = (context_rgb, context_K, context_c2w, K, c2w)
        if target_depth is not None:
            depth = _median_depth(np.asarray(target_depth[i], np.float64))
        else:
            depth = plane_sweep(*context, size).depth
        known = depth if np.isfinite(depth) else None
        frames["nearest"].append(nearest(context_rgb, context_c2w, c2w, known))
        frames["mean_context"].append(mean)
        frames["plane"].append(plane(*context, size, depth))
        if whole and target_depth is not None:
            frames["depth_warp"].append(depth_warp(*context, target_depth[i]))
        depths.append(depth)
    return {name: np.stack(images) for name, images in frames.items()}, depths


def project(
    grid: np.ndarray,
    depth: np.ndarray,
    K_source: np.ndarray,
    c2w_source: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Source pixels [h, w, 2] of the target's pixels `grid` at `depth`, and their z-depth there [h, w].

    Points at infinity have infinite z, points that are not in front of the source lie far outside of every picture.
    """
    motion = np.linalg.inv(np.asarray(c2w_source, np.float64)) @ np.asarray(c2w, np.float64)
    pixels = np.concatenate([grid, np.ones((*grid.shape[:2], 1))], axis=-1)
    rays = pixels @ np.linalg.inv(np.asarray(K, np.float64)).T
    # divided by depth: a plane at infinity is as good as any
    points = rays @ motion[:3, :3].T + motion[:3, 3] / depth[..., None]
    pixels = points @ np.asarray(K_source, np.float64).T
    front = points[..., 2] > 1e-6
    z = np.where(front, points[..., 2], 1.0)[..., None]
    xy = np.where(front[..., None], pixels[..., :2] / z, -1e6)
    return xy, np.where(front, points[..., 2], -1.0) * depth


def pixel_grid(h: int, w: int) -> np.ndarray:
    """Pixel centres [h, w, 2] as (x, y)."""
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    return np.stack([x, y], axis=-1)


def _inside(xy: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A touch of slack: a camera compared with itself must not lose its border to rounding."""
    x, y = xy[..., 0], xy[..., 1]
    slack = 1e-6
    return (x >= -slack) & (y >= -slack) & (x <= shape[1] + slack) & (y <= shape[0] + slack)


def _supersampling(xy: np.ndarray, valid: np.ndarray) -> int:
    """Samples per pixel and axis: how many photo pixels a typical target pixel spans."""
    spans = []
    for axis in (0, 1):
        both = np.minimum(
            *(np.moveaxis(valid, axis, 0)[part] for part in (slice(1, None), slice(-1)))
        )
        step = np.linalg.norm(np.diff(np.moveaxis(xy, axis, 0), axis=0), axis=-1)
        if both.any():
            # the median: depth edges make single steps huge
            spans.append(np.median(step[both]))
    span = max(spans, default=1.0)
    return int(np.clip(np.ceil(span - 0.05), 1, MAX_SUPERSAMPLING))


def _nearest_valid(warps: list[Warp], order: np.ndarray) -> np.ndarray:
    """Each pixel from the first of `warps[order]` that has it; in none: the first one's border."""
    out = warps[order[0]].rgb.copy()
    done = warps[order[0]].valid.copy()
    for i in order[1:]:
        take = warps[i].valid & ~done
        out[take] = warps[i].rgb[take]
        done |= take
    return out


def _shrink(rgb: np.ndarray, factor: int) -> np.ndarray:
    """Means of factor x factor pixels: [m, h, w, 3] -> [m, h // factor, w // factor, 3]."""
    m, h, w = (rgb.shape[0], rgb.shape[1] // factor, rgb.shape[2] // factor)
    rgb = rgb[:, : h * factor, : w * factor]
    return rgb.reshape(m, h, factor, w, factor, 3).mean(axis=(2, 4))


def _median_depth(depth: np.ndarray) -> float:
    """Median over known pixels; sky (inf) counts as far."""
    known = depth[depth > 0.0]
    if not known.size:
        raise UserError("The depth map of a target view has no positive value; leave depth out.")
    return float(np.median(known))


def _extent(centres: np.ndarray) -> float:
    return float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())


def _check(
    context_rgb: np.ndarray,
    context_K: np.ndarray,
    context_c2w: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
    depth: np.ndarray,
) -> None:
    m = len(context_rgb)
    given = tuple(np.shape(x) for x in (context_K, context_c2w, K, c2w))
    wanted = ((m, 3, 3), (m, 4, 4), (3, 3), (4, 4))
    if context_rgb.ndim != 4 or not m or given != wanted or depth.ndim != 2:
        raise UserError(
            "Baselines take context_rgb [m, h, w, 3], context_K [m, 3, 3], context_c2w [m, 4, 4], K [3, 3], "
            f"c2w [4, 4] and a size or depth [h, w], not {context_rgb.shape}, {', '.join(map(str, given))}, "
            f"{depth.shape}."
        )
