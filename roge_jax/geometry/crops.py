"""Moving pixels and intrinsics together: crop, resize, turn.

Pixel edges lie at 0..W and pixel centres at +0.5 (COLMAP's rule). Under that rule a crop by
`offset` followed by a resize by `factor` is c' = (c - offset) * factor and f' = f * factor on each
axis, with no half-pixel terms.
"""

from typing import Any

import numpy as np

from roge_jax.errors import UserError

Window = tuple[int, int, int, int]


def scale_K(K: Any, source: tuple[int, int], target: tuple[int, int]) -> Any:
    """K [..., 3, 3] after a plain resize from `source` to `target` (height, width)."""
    factors = np.array([target[1] / source[1], target[0] / source[0], 1.0])
    return K * factors.reshape((1,) * (K.ndim - 2) + (3, 1)).astype(K.dtype)


def shift_K(K: Any, top: float, left: float) -> Any:
    """K [..., 3, 3] after cutting `top` rows and `left` columns away (negative: after padding)."""
    moved = np.zeros((3, 3))
    moved[0, 2], moved[1, 2] = -left, -top
    return K + moved.reshape((1,) * (K.ndim - 2) + (3, 3)).astype(K.dtype)


def cover_window(source: tuple[int, int], target: tuple[int, int]) -> Window:
    """(top, left, height, width): the largest centred window with the aspect ratio of `target`.

    Whole pixels, truncated as LagerNVS does (which divides in floating point, and so cuts a row of
    some pictures that have the shape already); the remaining error of the aspect ratio (below one
    source pixel) goes into a per-axis scale of K.
    """
    height, width = source
    keep_height = min(height, max(1, width * target[0] // target[1]))
    keep_width = min(width, max(1, height * target[1] // target[0]))
    return (height - keep_height) // 2, (width - keep_width) // 2, keep_height, keep_width


def crop_resize_K(K: Any, source: tuple[int, int], target: tuple[int, int]) -> Any:
    """What `crop_resize` does to K [..., 3, 3], for cameras that have no image."""
    top, left, keep_height, keep_width = cover_window(source, target)
    return scale_K(shift_K(K, top, left), (keep_height, keep_width), target)


def crop_resize(image: np.ndarray, K: Any, height: int, width: int) -> tuple[np.ndarray, Any]:
    """Fills height x width with the centre of the image; what does not fit is cut away.

    Args:
      image: [h, w, c], uint8 or float; float values are assumed in [0, 1].
      K: [..., 3, 3] in pixels of `image`.
    Returns: float32 [height, width, c] in [0, 1], and K in pixels of that picture.
    """
    if not all(isinstance(side, int | np.integer) and side >= 1 for side in (height, width)):
        raise UserError(
            f"Cannot resize to {width} x {height} pixels: both must be whole numbers, 1 or more."
        )
    source = (image.shape[0], image.shape[1])
    top, left, keep_height, keep_width = cover_window(source, (height, width))
    window = image[top : top + keep_height, left : left + keep_width]
    return resize(window, height, width), crop_resize_K(K, source, (height, width))


def resize(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Antialiased resize of [h, w, c] to float32 [height, width, c]; edges stay edges.

    OpenCV's area filter where the package is present, else a triangle filter in JAX. Both keep a
    linear ramp of intensities where it is, which is what makes `scale_K` right.
    """
    scale = np.float32(255.0 if image.dtype == np.uint8 else 1.0)
    image = np.asarray(image, np.float32) / scale
    if image.shape[:2] == (height, width):
        return image
    try:
        import cv2
    except ImportError:
        import jax

        shape = (height, width, image.shape[2])
        return np.asarray(jax.image.resize(image, shape, "linear", antialias=True))
    shrinks = height < image.shape[0] or width < image.shape[1]
    flag = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    try:
        resized = cv2.resize(np.ascontiguousarray(image), (width, height), interpolation=flag)
    except cv2.error as error:
        raise MemoryError(f"no picture of {width} x {height} pixels could be made") from error
    return resized.reshape(height, width, image.shape[2])


def turn(
    K: np.ndarray, c2w: np.ndarray, quarter_turns: int, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """The camera (K, c2w) after its picture is turned like `np.rot90(image, quarter_turns)`.

    Pixels, K and the camera's roll belong together: the turned camera sees the same rays.
    Args: K [3, 3] without skew and c2w [4, 4] of the stored picture, height x width pixels.
    """
    for _ in range(quarter_turns % 4):
        # (x, y) -> (y, width - x): the new x axis is the old y, the new y axis the old -x.
        swap = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, width], [0.0, 0.0, 1.0]])
        axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        K = swap @ K @ axes.T
        c2w = c2w.copy()
        c2w[:3, :3] = c2w[:3, :3] @ axes.T
        height, width = width, height
    return K, c2w
