"""Which photos of a large scene to give to a model: far apart, but each with a part in common with another."""

import functools

import numpy as np

from ..errors import UserError
from ..geometry.cameras import to_host
from .matching import Seen, features, matches_inside, shrink
from .scene import Scene, view_gaps

COMMON = 0.25  # of both pictures: the area that their matches must span
CLOSER = 0.75  # the next try's distance, times the last one's


def select_overlapping(scene: Scene, m: int, height: int, width: int) -> list[int]:
    """m views that see much of the scene, each of which shares a quarter of its picture with one chosen before.

    As `select_context`, from the most central view outwards, the farthest one that passes; that two photos share
    something is seen in SIFT features that match in what height x width pictures keep of them. Where none passes the
    nearest view is taken. Ascending; deterministic. Takes a second or a few.
    """
    gaps = view_gaps(to_host(scene.cameras))

    @functools.cache
    def seen(view: int) -> Seen:
        try:
            image = shrink(scene.images[view], np.eye(3))[0]
        except UserError:  # damaged: it is named when it is read
            return None, (1, 1)
        return features(image), image.shape[:2]

    def shared(one: int, other: int) -> bool:
        both = matches_inside(seen(one), seen(other), height, width)
        return both is not None and min(map(_spanned, both)) >= COMMON * height * width

    picked = [int(np.argmin(gaps.sum(0)))]
    while len(picked) < m:
        nearest = gaps[:, picked].min(1)
        left = [i for i in np.argsort(-nearest, kind="stable").tolist() if i not in picked]
        limit = np.inf
        for view in left:
            if nearest[view] > limit and view != left[-1]:
                continue
            if shared(view, picked[int(np.argmin(gaps[view, picked]))]) or view == left[-1]:
                picked.append(view)
                break
            limit = CLOSER * nearest[view]
    return sorted(picked)


def _spanned(pixels: np.ndarray) -> float:
    """Area of the convex hull of pixels [p, 2]."""
    import cv2

    return float(cv2.contourArea(cv2.convexHull(pixels.astype(np.float32))))
