"""Limits on what only the photos of the scene themselves show: wrong poses, wrong focal lengths, JPEG. Seconds, not milliseconds.

    scene_limits.warn(scene, photos.ids, config)         # photos of sampling.read_photos

`limits` measures the small pictures that the model is given, too small to be matched, and long past their JPEG blocks.
Here the chosen photos are matched with others of the scene (`scenes.matching.photo_matches`, at no more than 640 pixels):
how many pixels of the model's picture features lie from where the poses put them, and whether other focal lengths would
fit better. Of JPEG files the quality is read. What cannot be matched says nothing. `python -m roge_jax.sample` does this
in a thread (`Beside`) while it compiles, and refuses poses of a `transforms.json` that are plainly in other axes than they
are read in. docs/notes/robustness.md says how the limits were measured.
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from roge_jax.geometry.cameras import scale_focal

from ..config import RoGeConfig
from ..errors import LimitWarning, UserError
from ..geometry.cameras import Cameras, crop_resize_K, other_conventions
from ..geometry.crops import cover_window
from ..scenes import matching
from ..scenes.images import Photos, jpeg_quality
from ..scenes.scene import Scene, is_nerfstudio
from . import limits
from .limits import Beyond, entry

Stage = Callable[[str], AbstractContextManager]

AXES_GAIN = 3.0  # other axes fit if features lie that many times nearer to where they put them


def beyond(
    scene: Scene,
    ids: Sequence[int],
    config: RoGeConfig,
    rows: dict[str, Any] | None = None,
    convention: str | None = None,
) -> list[Beyond]:
    """What lies beyond the limits `rows` (of `limits.table`; the model's own if None) in the photos `ids` of a scene.

    convention: the one that a `transforms.json` was read with, OpenGL if None.
    """
    rows = limits.table(config.name) if rows is None else rows
    found = []
    if "poses" in rows:
        size = (config.height, config.width)
        matches = matching.photo_matches(scene.images, scene.cameras, ids, *size)
        pairs = zip(scene.cameras.K, scene.sizes, strict=True)
        K = np.stack([crop_resize_K(k, photo, size) for k, photo in pairs])
        cameras = Cameras(K, scene.cameras.c2w)
        if matches and is_nerfstudio(scene.source):
            read_as = convention or "opengl"
            found += about_axes(matches, cameras, ids, scene, size, rows["poses"], read_as)
        found = found or about_cameras(matches, cameras, ids, scene, size, rows)
    return found + (about_files(scene, ids, config, rows["jpeg"]) if "jpeg" in rows else [])


def about_axes(
    matches: matching.Matches,
    cameras: Cameras,
    ids: Sequence[int],
    scene: Scene,
    size: tuple[int, int],
    row: dict[str, Any],
    convention: str,
) -> list[Beyond]:
    """Axes of another convention than `convention`, if poses read as it are beyond the limit and read otherwise within
    it, by a factor of `AXES_GAIN`; [] or one entry. Arguments as of `about_cameras`.
    """

    def worst(cameras: Cameras) -> float:
        return float(
            np.nanmax(matching.photo_misfits(matching.misfits(matches, cameras), ids), initial=0)
        )

    now = worst(cameras)
    if now <= row["limit"]:
        return []
    candidates = other_conventions(cameras, convention)
    left = {name: worst(candidate) for name, candidate in candidates.items()}
    best = min(left, key=lambda name: left[name])
    if left[best] > min(row["limit"], now / AXES_GAIN):
        return []
    message = (
        f"{scene.source}: its poses are not '{convention}': read so, matched features lie {now:.2g} pixels of "
        f"{size[0]}x{size[1]} from where they should, read as '{best}' {left[best]:.2g}: give --convention {best} "
        f"(or --convention {convention} to keep them)."
    )
    return [Beyond("axes", now, float(row["limit"]), message)]


def about_cameras(
    matches: matching.Matches,
    cameras: Cameras,
    ids: Sequence[int],
    scene: Scene,
    size: tuple[int, int],
    rows: dict[str, Any],
) -> list[Beyond]:
    """Wrong focal lengths if others explain what is seen, else wrong poses; [] or one entry.

    They do if they fit better by more than the row's `gain`, what errors of poses alone reach in 5 % of the scenes, and
    bring all photos within the limit on poses. cameras: of the whole scene, K in pixels of the model's pictures of `size`, as `matches` are.
    """
    if not matches:
        return []
    cure = f"run python -m roge_jax.check {scene.source} and mend"
    error, gain = matching.focal_error(matches, cameras)
    row, focal = rows["poses"], rows["focal"]
    if 100 * abs(error) > focal["limit"] and gain > focal["gain"]:
        mended = scale_focal(cameras, 1 + error)
        left = matching.photo_misfits(matching.misfits(matches, mended), ids)
        if np.nanmax(left) <= row["limit"]:
            which = "longer" if error > 0 else "shorter"
            text = f"matched photos fit focal lengths at least {100 * abs(error):.2g} % {which} than given"
            fix = f"{cure} the focal lengths, or the poses"
            return [entry("focal", 100 * abs(error), focal, text, fix, " %")]
    off = matching.photo_misfits(matching.misfits(matches, cameras), ids)
    wrong = int((off > row["limit"]).sum())
    if not wrong:
        return []
    worst = int(np.nanargmax(off))
    more = f" ({wrong} photos lie beyond the limit)" if wrong > 1 else ""
    text = (
        f"features of photo {ids[worst]} ({scene.names[ids[worst]]}) lie {off[worst]:.2g} pixels of {size[0]}x{size[1]} "
        f"from where the poses put them{more}"
    )
    return [entry("poses", off[worst], row, text, f"{cure} its pose and lens")]


def about_files(
    scene: Scene, ids: Sequence[int], config: RoGeConfig, row: dict[str, Any]
) -> list[Beyond]:
    """The JPEG file that is furthest below the quality that its size needs; [] or one entry.

    The row's `by_shrink` lists [photo over picture, quality], 0 where no quality was too low; between them the quality is
    interpolated over the logarithm, outside it is that of the ends.
    """
    if not isinstance(scene.images, Photos):
        return []
    shrinks, qualities = np.array(row["by_shrink"]).T
    found = []
    for view in ids:
        photo = scene.images.photos[view]
        quality = jpeg_quality(photo.file)
        if quality is None:
            continue
        shrink = cover_window(photo.size, (config.height, config.width))[2] / config.height
        needed = float(np.interp(np.log(shrink), np.log(shrinks), qualities))
        found.append((quality - needed, quality, needed, view, shrink))
    if not found or min(found)[0] >= 0:
        return []
    _, quality, needed, view, shrink = min(found)
    message = (
        f"photo {view} ({scene.names[view]}) is a JPEG of quality {quality}, {shrink:.2g} times as large as the model's "
        f"picture; below {needed:.0f} the model loses 1 dB: use the photo as it was before, or larger."
    )
    return [Beyond("jpeg", float(quality), needed, message)]


def warn(scene: Scene, ids: Sequence[int], config: RoGeConfig) -> tuple[Beyond, ...]:
    """`beyond`, each also a `LimitWarning`."""
    found = tuple(beyond(scene, ids, config))
    for one in found:
        warnings.warn(one.message, LimitWarning, stacklevel=2)
    return found


class Beside:
    """`beyond` in a thread beside other work, for programs: `tell` waits for it and warns.

    convention: the axes that the user gave; if None, poses that are plainly in others are refused.
    """

    def __init__(
        self,
        scene: Scene,
        ids: Sequence[int],
        config: RoGeConfig,
        convention: str | None = None,
    ):
        pool = ThreadPoolExecutor(1)
        self.job = pool.submit(beyond, scene, ids, config, convention=convention)
        pool.shutdown(wait=False)
        self.told = False
        self.insisted = convention is not None

    def tell(self) -> tuple[Beyond, ...]:
        """What was found, each also a `LimitWarning` the first time; a check that failed is one that says so."""
        error = self.job.exception()
        found = () if error else tuple(self.job.result())
        for one in found:
            if one.kind == "axes" and not self.insisted:
                raise UserError(one.message)
        said = [one.message for one in found]
        if error:
            said.append(f"poses and photos were not compared ({type(error).__name__}: {error})")
        if not self.told and said:
            from tqdm import tqdm

            with tqdm.external_write_mode(sys.stderr):  # not into a bar that is shown
                for message in said:
                    warnings.warn(message, LimitWarning, stacklevel=2)
        self.told = True
        return found

    def before_work(self, stage: Stage) -> Stage:
        """A `stage` of `sampling.sample` that tells, in a stage "match", when compilation is over."""

        def entered(name: str) -> AbstractContextManager:
            if name != "compile" and not self.told:
                with stage("match"):
                    self.tell()
            return stage(name)

        return entered
