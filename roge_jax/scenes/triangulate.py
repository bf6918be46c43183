"""Coloured points from views whose cameras are known, e.g. the frames of a generated video.

    points = triangulate(frames, cameras)           # frames [n, h, w, 3], cameras [n] with K in their pixels

Corners are followed from frame to frame by pyramidal Lucas-Kanade flow (there and back), the rays of each track meet in
the point with the least squared distance in pixels (DLT, then Gauss-Newton), and tracks that the cameras contradict are
left out. Nothing here is learned, and no depth is used: what remains is what the frames agree on.
"""

from typing import Any, NamedTuple

import numpy as np

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras, invert, to_host
from roge_jax.scenes.points import Points

CORNERS, APART, LEAST_QUALITY = (
    4000,
    3.0,
    0.002,
)  # of a frame: how many, pixels between them, of the best one's score
SEEDS = 8  # frames in which corners are looked for, spread over the video
THERE_AND_BACK = 0.5  # pixels by which the flow there and back may miss
WINDOW, LEVELS = 11, 3  # of the flow: pixels a side, halvings
VIEWS = 3  # that a point needs: with two, nothing contradicts a wrong match along the epipolar line
STEPS = 6  # of Gauss-Newton


class Quality(NamedTuple):
    """What the points are worth. Medians over points, but for `error`, over all their images."""

    tracks: int  # followed over VIEWS frames or more
    points: int  # of which the cameras agree
    error: float  # pixels between an image of a point and where it was followed to
    views: float  # that see a point
    most_views: int
    angle: float  # degrees between the outermost rays of a point

    def __str__(self) -> str:
        return (
            f"{self.points} points of {self.tracks} tracks; reprojection error {self.error:.2f} px, seen by "
            f"{self.views:.0f} frames (at most {self.most_views}), angle {self.angle:.1f} degrees (medians)"
        )


def triangulate(
    frames: np.ndarray, cameras: Cameras, *, limit: float = 1.0, least_angle: float = 0.5
) -> tuple[Points, Quality]:
    """Points in the cameras' frame and unit, with the pixels of every frame that sees them, and what they are worth.

    Args:
      frames: [n, h, w, 3], uint8 or float in [0, 1], in the order of the walk.
      cameras: [n], K in pixels of the frames.
      limit: pixels; a point goes if its images miss by more on average, and an image of it that misses by twice that.
      least_angle: degrees between its outermost rays, below which a point's depth is a guess.
    Raises: UserError if no point is left, saying how many were followed.
    """
    cameras, pixels8 = to_host(cameras), _bytes(frames)
    tracks = follow(pixels8)
    poses, K = invert(cameras.c2w), cameras.K
    seen = np.isfinite(tracks[..., 0])
    xyz = intersect(tracks, K, poses)
    off = distances(xyz, tracks, K, poses)
    seen &= np.nan_to_num(off, nan=np.inf) <= 2.0 * limit
    kept = seen.sum(1) >= VIEWS
    tracks, seen, followed = tracks[kept], seen[kept], len(tracks)
    tracks = np.where(seen[..., None], tracks, np.nan)
    xyz = intersect(tracks, K, poses)
    off = distances(xyz, tracks, K, poses)
    error = np.nanmean(off, 1) if len(off) else np.zeros(0)
    angles = spread(xyz, cameras.centres, seen)
    kept = (error <= limit) & (angles >= least_angle) & np.isfinite(xyz).all(1)
    if not kept.any():
        raise UserError(
            f"{followed} tracks of corners over {VIEWS} frames or more, and no point that the cameras agree on: the frames "
            "need texture, a camera that moves sideways, and poses that are right."
        )
    xyz, tracks, seen, error = xyz[kept], tracks[kept], seen[kept], error[kept]
    count = seen.sum(1)
    said = Quality(
        followed,
        len(xyz),
        float(np.nanmedian(off[kept])),
        float(np.median(count)),
        int(count.max()),
        float(np.median(angles[kept])),
    )
    views = [np.flatnonzero(seen[:, i]) for i in range(len(cameras))]
    images = [tracks[which, i] for i, which in enumerate(views)]
    return Points(xyz, colours(pixels8, tracks), views, images, error), said


def _bytes(frames: np.ndarray) -> np.ndarray:
    frames = np.asarray(frames)
    if frames.dtype == np.uint8:
        return frames
    return np.rint(255.0 * np.clip(frames, 0.0, 1.0)).astype(np.uint8)


# ---- following corners ---------------------------------------------------------------------------


def follow(frames: np.ndarray) -> np.ndarray:
    """Corners of uint8 frames [n, h, w, 3] through the others: pixels [p, n, 2] (edges at 0), NaN where a track has ended.

    Corners are looked for in SEEDS frames, where no earlier track is near; each is followed to both ends of the video.
    Tracks over fewer than VIEWS frames are left out.
    """
    import cv2

    n, (h, w) = len(frames), frames.shape[1:3]
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    seeds = np.unique(np.linspace(0, n - 1, min(n, SEEDS)).round().astype(int))
    found = np.zeros((0, n, 2), np.float32)
    for seed in seeds:
        free = np.full((h, w), 255, np.uint8)
        live = found[:, seed][np.isfinite(found[:, seed, 0])]
        for x, y in live.round().astype(int).tolist():
            cv2.circle(free, (x, y), int(APART), 0, -1)
        corners = cv2.goodFeaturesToTrack(
            grey[seed], CORNERS, LEAST_QUALITY, APART, mask=free, blockSize=5
        )
        if corners is None:
            continue
        tracks = np.full((len(corners), n, 2), np.nan, np.float32)
        tracks[:, seed] = corners[:, 0]
        for step in (1, -1):
            last = n if step > 0 else -1
            for i in range(seed + step, last, step):
                going = np.flatnonzero(np.isfinite(tracks[:, i - step, 0]))
                if not len(going):
                    break
                tracks[going, i] = _next(grey[i - step], grey[i], tracks[going, i - step])
        long = np.isfinite(tracks[..., 0]).sum(1) >= min(VIEWS, n)
        found = np.concatenate([found, tracks[long]])
    return found.astype(np.float64) + 0.5  # OpenCV counts pixel centres as whole numbers


def _next(before: np.ndarray, after: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Where `pixels` [k, 2] of one picture are in the next, NaN where the way back leads elsewhere or out of it."""
    import cv2

    options = {"winSize": (WINDOW, WINDOW), "maxLevel": LEVELS}
    flow: Any = cv2.calcOpticalFlowPyrLK  # its stubs do not know that the first guess may be None
    there, ok, _ = flow(before, after, pixels, None, **options)
    back, ok_back, _ = flow(after, before, there, None, **options)
    missed = np.linalg.norm(back - pixels, axis=1)
    h, w = after.shape
    inside = (there >= 0).all(1) & (there <= (w - 1, h - 1)).all(1)
    good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (missed <= THERE_AND_BACK) & inside
    return np.where(good[:, None], there, np.nan)


# ---- where rays meet -----------------------------------------------------------------------------


def intersect(tracks: np.ndarray, K: np.ndarray, w2c: np.ndarray) -> np.ndarray:
    """Points [p, 3] of tracks [p, n, 2] (NaN: not seen): the DLT solution, then Gauss-Newton on the distances in pixels."""
    seen = np.isfinite(tracks[..., 0])
    x = np.where(seen[..., None], tracks, 0.0)
    P = K @ w2c[:, :3]  # [n, 3, 4]
    # u P_3 - P_1 = 0 and v P_3 - P_2 = 0, in calibrated units so that rows weigh alike.
    rows = x[..., None] * P[None, :, 2:3] - P[None, :, :2]  # [p, n, 2, 4]
    rows = rows / K[None, :, [0, 1], [0, 1]][..., None] * seen[..., None, None]
    normal = np.einsum("pnij,pnik->pjk", rows, rows)
    homogeneous = np.linalg.eigh(normal)[1][:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        xyz = homogeneous[:, :3] / homogeneous[:, 3:]
    for _ in range(STEPS):
        with np.errstate(divide="ignore", invalid="ignore"):
            ahead = np.einsum("nij,pj->pni", P[:, :, :3], xyz) + P[None, :, :, 3]
            depth = ahead[..., 2:]
            residual = ahead[..., :2] / depth - x  # [p, n, 2]
            slope = P[None, :, :2, :3] - (residual + x)[..., None] * P[None, :, 2:3, :3]
            slope = slope / depth[..., None]  # [p, n, 2, 3]
        used = (seen & np.isfinite(residual).all(-1))[..., None]
        residual, slope = np.where(used, residual, 0.0), np.where(used[..., None], slope, 0.0)
        A = np.einsum("pnij,pnik->pjk", slope, slope)
        b = np.einsum("pnij,pni->pj", slope, residual)
        A += (
            1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(3)[None]
            + 1e-30 * np.eye(3)[None]
        )
        step = np.linalg.solve(A, b[..., None])[..., 0]
        xyz = xyz - np.where(np.isfinite(step), step, 0.0)
    return xyz


def distances(xyz: np.ndarray, tracks: np.ndarray, K: np.ndarray, w2c: np.ndarray) -> np.ndarray:
    """Pixels [p, n] between the images of points [p, 3] and their tracks [p, n, 2]; infinite behind a camera."""
    local = np.einsum("nij,pj->pni", w2c[:, :3, :3], xyz) + w2c[None, :, :3, 3]
    ahead = np.einsum("nij,pnj->pni", K, local)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(ahead[..., :2] / ahead[..., 2:] - tracks, axis=-1)
    return np.where(np.isfinite(tracks[..., 0]) & ~(local[..., 2] > 0), np.inf, off)


def spread(xyz: np.ndarray, centres: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Degrees [p] of the largest angle at a point between a ray of the first camera that sees it and any other."""
    rays = centres[None] - xyz[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    if not len(xyz):
        return np.zeros(0)
    first = rays[np.arange(len(xyz)), seen.argmax(1)]
    cosine = np.einsum("pj,pnj->pn", first, rays)
    angle = np.degrees(np.arccos(np.clip(np.nan_to_num(cosine, nan=1.0), -1.0, 1.0)))
    return np.where(seen, angle, 0.0).max(1)


def colours(frames: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    """uint8 [p, 3]: the median over the frames [n, h, w, 3] that see a point, of the pixel it falls into."""
    h, w = frames.shape[1:3]
    column = np.nan_to_num(tracks[..., 0]).astype(int).clip(0, w - 1)
    row = np.nan_to_num(tracks[..., 1]).astype(int).clip(0, h - 1)
    found = frames[np.arange(len(frames))[None], row, column].astype(np.float32)  # [p, n, 3]
    found[~np.isfinite(tracks[..., 0])] = np.nan
    return np.rint(np.nanmedian(found, 1)).astype(np.uint8)
