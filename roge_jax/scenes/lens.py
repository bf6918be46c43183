"""Straightening of lens distortion, by the rule of COLMAP's undistorter.

The straightened picture keeps focal lengths and the relative place of the principal point, so pixels stay as square as
they were; its width and height change, each by its own factor, such that no border is blank.
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.geometry.crops import shift_K

LARGEST = 2.0  # a straightened picture is at most that many times as wide or high
SMALLEST = 0.02  # below: no picture is left
TOO_WIDE = 175.0  # degrees: no flat picture
FAR = 1e6  # an ideal coordinate that stands for "never"


@dataclasses.dataclass(frozen=True)
class Lens:
    """Distortion of a lens: model "opencv" (k1 k2 p1 p2 [k3 k4 k5 k6]) or "fisheye" (k1..k4)."""

    model: str
    coefficients: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Straight:
    """The pinhole camera of a straightened picture: K [3, 3], size, the share of the photo it shows, and how many
    times more the photo is enlarged in one place than in another."""

    K: np.ndarray
    size: tuple[int, int]
    share: float
    stretch: float


def straighten(
    K: np.ndarray, lens: Lens, size: tuple[int, int], where: str = "the photo"
) -> Straight:
    """The camera of the straightened picture. Raises UserError where the lens has no flat picture."""
    try:
        return _straighten(tuple(np.asarray(K, np.float64).ravel().tolist()), lens, size)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


@functools.lru_cache(maxsize=256)  # the photos of one camera are straightened alike
def _straighten(entries: tuple[float, ...], lens: Lens, size: tuple[int, int]) -> Straight:
    K = np.array(entries).reshape(3, 3)
    height, width = size
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    rows, columns = np.arange(height) + 0.5, np.arange(width) + 0.5

    def ideal(x: Any, y: Any, axis: int) -> np.ndarray:
        """Pixels of the border where the pinhole camera of the same K shows them, along one axis."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        points = np.stack([(x - cx) / fx, (y - cy) / fy], -1)
        rays = ideal_rays(points, lens)
        if lens.model == "fisheye":  # what lies beside the camera COLMAP leaves at its angle
            radius = np.linalg.norm(points, axis=-1, keepdims=True)
            angle = _fisheye_angle(radius, lens)
            rays = np.where(angle < np.pi / 2, rays, points * angle / np.maximum(radius, 1e-12))
        return rays[:, axis] * (fx, fy)[axis] + (cx, cy)[axis]

    if lens.model == "fisheye":
        middle = np.array([[cx / fx, 0], [(width - cx) / fx, 0], [0, cy / fy], [0, (height - cy) / fy]])  # fmt: skip
        angles = np.degrees(_fisheye_angle(np.linalg.norm(middle, axis=-1), lens))
        seen = max(angles[0] + angles[1], angles[2] + angles[3])
        if not seen < TOO_WIDE:
            raise UserError(
                f"a fisheye view of {min(seen, 360.0):.0f} degrees has no flat picture, which ends below "
                "180: crop the photos, or choose a narrower lens."
            )
    scale_x = _scale(cx, width, ideal(0.5, rows, 0).max(), ideal(width - 0.5, rows, 0).min())
    scale_y = _scale(
        cy, height, ideal(columns, 0.5, 1).max(), ideal(columns, height - 0.5, 1).min()
    )
    if not (scale_x > SMALLEST and scale_y > SMALLEST):
        raise UserError(
            f"lens coefficients {lens.coefficients} leave no usable picture (its sides would change by "
            f"factors of {scale_x:.3g} and {scale_y:.3g}): check them."
        )
    new_width = int(max(1.0, min(scale_x, LARGEST) * width))
    new_height = int(max(1.0, min(scale_y, LARGEST) * height))
    new_K = K.copy()
    new_K[0, 2], new_K[1, 2] = cx * new_width / width, cy * new_height / height
    share, stretch = _what_is_left(K, lens, size, new_K, (new_height, new_width))
    return Straight(new_K, (new_height, new_width), share, stretch)


def _scale(c: float, side: int, low: float, high: float) -> float:
    """COLMAP's factor for one side without blank pixels: the innermost places of the two borders, `low` and `high`."""
    largest = max(c / max(c - low, 1e-9), (side - 0.5 - c) / max(high - c, 1e-9))
    return 1.0 / largest if largest > 0 else FAR


def _what_is_left(
    K: np.ndarray, lens: Lens, size: tuple[int, int], new_K: np.ndarray, new_size: tuple[int, int]
) -> tuple[float, float]:
    """(share of the photo's area inside the straightened picture, largest over smallest enlargement)."""
    n = 41
    x, y = np.meshgrid(np.linspace(0, new_size[1], n), np.linspace(0, new_size[0], n))
    rays = np.stack([(x - new_K[0, 2]) / new_K[0, 0], (y - new_K[1, 2]) / new_K[1, 1]], -1)
    bent = distorted(rays.reshape(-1, 2), lens).reshape(n, n, 2)
    pixels = bent * (K[0, 0], K[1, 1]) + (K[0, 2], K[1, 2])
    across, down = np.diff(pixels, axis=1)[:-1], np.diff(pixels, axis=0)[:, :-1]
    areas = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    cell = new_size[0] * new_size[1] / (n - 1) ** 2
    share = float(min(1.0, areas.sum() / (size[0] * size[1])))
    gains = np.sqrt(areas / cell)
    return share, float(gains.max() / max(gains.min(), 1e-9))


def distorted(rays: np.ndarray, lens: Lens) -> np.ndarray:
    """Where a lens shows rays (x/z, y/z) [n, 2], in focal lengths."""
    radius = np.linalg.norm(rays, axis=-1)
    if lens.model == "fisheye":
        angle = np.arctan(radius)
        k = np.pad(lens.coefficients, (0, 4))[:4]
        square = angle**2
        bent = angle * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))
        return rays * np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)[:, None]
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(lens.coefficients, (0, 8))[:8]
    square = radius**2
    top = 1 + square * (k1 + square * (k2 + square * k3))
    factor = top / (1 + square * (k4 + square * (k5 + square * k6)))
    x, y = rays[:, 0], rays[:, 1]
    more = np.stack(
        [2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y], -1
    )
    return rays * factor[:, None] + more


def ideal_rays(points: np.ndarray, lens: Lens) -> np.ndarray:
    """The inverse of `distorted`: rays [n, 2] of points; `FAR` out where no ray arrives there."""
    radius = np.linalg.norm(points, axis=-1)
    unit = points / np.maximum(radius, 1e-12)[:, None]
    if lens.model == "fisheye":
        angle = _fisheye_angle(radius, lens)
        away = np.where(angle < np.pi / 2 - 1e-6, np.tan(np.minimum(angle, np.pi / 2 - 1e-6)), FAR)
        return unit * away[:, None]
    reach = _reach(lens)
    low, high = np.zeros_like(radius), np.full_like(radius, reach)

    def bend(r: np.ndarray) -> np.ndarray:
        radial = Lens("opencv", _radial(lens))
        return distorted(np.stack([r, 0 * r], -1), radial)[:, 0]

    out = bend(high) < radius  # beyond what the coefficients describe
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = bend(middle) < radius
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    rays = unit * np.where(out, reach, 0.5 * (low + high))[:, None]
    if any(np.pad(lens.coefficients, (0, 4))[2:4]):
        rays = _with_tangential(rays, points, lens, out)
    return rays


def _with_tangential(
    rays: np.ndarray, points: np.ndarray, lens: Lens, out: np.ndarray
) -> np.ndarray:
    """Newton's steps for the tangential part, from the radial solution; steps that lead away are not taken."""
    h = 1e-6
    for _ in range(20):
        off = distorted(rays, lens) - points
        columns = [(distorted(rays + h * d, lens) - distorted(rays - h * d, lens)) / (2 * h) for d in np.eye(2)]  # fmt: skip
        (a, c), (b, d) = columns[0].T, columns[1].T
        det = a * d - b * c
        det = np.where(np.abs(det) < 1e-9, np.inf, det)
        step = np.stack([d * off[:, 0] - b * off[:, 1], a * off[:, 1] - c * off[:, 0]], -1)
        new = rays - step / det[:, None]
        better = np.linalg.norm(new - rays, axis=-1) < 1.0
        better &= np.linalg.norm(distorted(new, lens) - points, axis=-1) < np.linalg.norm(off, axis=-1)  # fmt: skip
        rays = np.where((better & ~out)[:, None], new, rays)
    return rays


def _radial(lens: Lens) -> tuple[float, ...]:
    k = np.pad(lens.coefficients, (0, 8))[:8]
    k[2:4] = 0.0
    return tuple(k)


def _reach(lens: Lens) -> float:
    """The largest radius (tangent of the angle) up to which what a lens shows moves outwards."""
    r = np.concatenate(
        [np.geomspace(1e-5, 0.05, 400, endpoint=False), np.geomspace(0.05, 50.0, 4000)]
    )
    bent = distorted(np.stack([r, 0 * r], -1), Lens("opencv", _radial(lens)))[:, 0]
    falls = np.flatnonzero(np.diff(bent) <= 0)
    return float(r[falls[0]]) if len(falls) else float(r[-1])


def _fisheye_angle(radius: np.ndarray, lens: Lens) -> np.ndarray:
    """The angle from the axis of what a fisheye shows at `radius`; pi where nothing is shown so far out."""
    k = np.pad(lens.coefficients, (0, 4))[:4]
    angles = np.linspace(0.0, np.pi, 20001)
    square = angles**2
    shown = angles * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))
    falls = np.flatnonzero(np.diff(shown) <= 0)
    last = falls[0] + 1 if len(falls) else len(angles)
    return np.interp(radius, shown[:last], angles[:last], right=np.pi)


def undistort(
    image: np.ndarray,
    K: np.ndarray,
    lens: Lens,
    new_K: np.ndarray,
    size: tuple[int, int] | None = None,
) -> np.ndarray:
    """The picture [h, w, 3], of `size` (the image's own if None), that a pinhole camera with `new_K` would have taken."""
    cv2 = _opencv_for_lens()
    height, width = size or image.shape[:2]
    old, new = shift_K(K, 0.5, 0.5), shift_K(new_K, 0.5, 0.5)  # its pixel centres are whole numbers
    k = np.array(lens.coefficients, np.float64)
    make = cv2.initUndistortRectifyMap
    if lens.model == "fisheye":
        make, k = cv2.fisheye.initUndistortRectifyMap, k[:4]
    across, down = make(old, k, np.eye(3), new, (width, height), cv2.CV_32FC1)
    return cv2.remap(image, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _opencv_for_lens() -> Any:
    try:
        import cv2
    except ImportError:
        raise UserError(
            "Lens distortion needs OpenCV: pip install opencv-python, or give undistorted photos."
        ) from None
    return cv2
