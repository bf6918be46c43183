"""Which frames of a video become photos: sharp ones, equally far apart in what they show.

A video is decoded twice, first small, for how sharp its frames are and how far the picture moves between them (`measure`),
then for the chosen ones alone (`extract`). Time plays no part: where the camera rests no frames are taken.
"""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError

STEP = 0.07  # of the picture's width: how far the picture moves between two photos
FEWEST, MOST = 12, 120  # photos of a video, if the motion is there
LEAST_MOTION = 0.15  # picture widths in the whole video: less is a camera that stands still
RATE = 10.0  # frames a second that are looked at
SMALL = 320  # pixels of the long side while looking
LOST = 0.15  # picture widths, where a frame has too little in common with the one before to tell
INNER = 0.35  # of the distance between photos: how far from its even place a sharper frame is looked for


@dataclasses.dataclass(frozen=True)
class Looked:
    """What `measure` found: numbers [f] of the frames looked at, their sharpness, and motion since the one before."""

    index: np.ndarray
    sharpness: np.ndarray
    motion: np.ndarray  # in picture widths; the first is 0


@contextlib.contextmanager
def _frames(video: Path) -> Iterator[Any]:
    """PyAV's frames of a video, one after another. Raises: UserError if it cannot be opened or decoded."""
    try:
        import av
    except ImportError:
        raise UserError(f"{video}: videos are read by PyAV: pip install av.") from None
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise UserError(f"{video}: has no pictures in it: give a video, or photos.")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            rate = float(stream.average_rate or 30.0)
            yield rate, container.decode(stream)
    except (av.error.FFmpegError, IndexError) as error:
        raise UserError(
            f"{video}: cannot be read as a video ({error}): copy it again, or convert it to MP4."
        ) from None


def measure(video: Path, rate: float = RATE) -> Looked:
    """Sharpness and motion of the frames of a video, about `rate` of them a second."""
    import cv2

    index, sharp, motion = [], [], []
    before = None
    with _frames(video) as (fps, frames):
        every = max(1, round(fps / rate))
        for i, frame in enumerate(frames):
            if i % every:
                continue
            factor = min(1.0, SMALL / max(frame.width, frame.height))
            size = (max(2, round(frame.width * factor)), max(2, round(frame.height * factor)))
            middle = frame.reformat(
                width=min(frame.width, 2 * size[0]),
                height=min(frame.height, 2 * size[1]),
                format="gray",
            )
            grey = middle.to_ndarray()
            sharp.append(float(cv2.Laplacian(grey, cv2.CV_64F).var()))
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
            motion.append(0.0 if before is None else _moved(before, grey))
            index.append(i)
            before = grey
    if not index:
        raise UserError(f"{video}: has no frames: copy it again, or give photos.")
    return Looked(np.array(index), np.array(sharp), np.array(motion))


def _moved(before: np.ndarray, after: np.ndarray) -> float:
    """How far corners move from one small grey picture to the next, in picture widths (median)."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 7)
    if corners is None or len(corners) < 10:
        return 0.0 if np.abs(before.astype(int) - after).mean() < 1.0 else LOST
    found, there, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
    there = there.ravel().astype(bool)
    if there.sum() < 10:
        return LOST
    return float(np.median(np.linalg.norm((found - corners)[there], axis=-1)) / before.shape[1])


def choose(looked: Looked, count: int | None = None) -> list[int]:
    """Numbers of the frames to take, ascending: evenly spread over the motion, each the sharpest around its place.

    count: how many; None leaves it to the motion, from FEWEST to MOST. Raises: UserError for a camera that stands still.
    """
    way = np.cumsum(looked.motion)
    if way[-1] < LEAST_MOTION:
        raise UserError(
            f"the camera of this video hardly moves ({way[-1]:.0%} of a picture's width in {len(way)} frames): film "
            "while walking around the thing, or give photos from several places."
        )
    if count is None:
        count = int(np.clip(round(way[-1] / STEP) + 1, FEWEST, MOST))
    count = min(count, len(way))
    if count < 2:
        return [int(looked.index[int(np.argmax(looked.sharpness))])]
    gap = way[-1] / (count - 1)
    taken: list[int] = []
    for place in np.linspace(0.0, way[-1], count):
        near = np.flatnonzero(np.abs(way - place) <= INNER * gap)
        near = near[near > taken[-1]] if taken else near
        if len(near):
            taken.append(int(near[np.argmax(looked.sharpness[near])]))
    return [int(looked.index[i]) for i in taken]


def extract(video: Path, chosen: list[int], folder: Path, quality: int = 97) -> list[Path]:
    """The chosen frames as JPEGs in `folder`, upright, named by their numbers; nearly lossless."""
    from PIL import Image

    wanted, written = set(chosen), []
    with _frames(video) as (_, frames):
        for i, frame in enumerate(frames):
            if i not in wanted:
                continue
            pixels = frame.to_ndarray(format="rgb24")
            turns = round(getattr(frame, "rotation", 0) / 90) % 4  # counter-clockwise, as NumPy's
            file = folder / f"{i:06d}.jpg"
            Image.fromarray(np.ascontiguousarray(np.rot90(pixels, turns))).save(
                file, quality=quality, subsampling=0
            )
            written.append(file)
            if len(written) == len(wanted):
                break
    return written
