"""A run that `sample` finished, or that failed after its frames: what else can be made of its folder without a model.

made = read(Path("outputs/sample"))
write_videos(made, ["gif"])
quality = write_points(made)  # points.ply, and the same points in transforms.json and sparse/0
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from ..files import video_io
from ..files.fields import is_file, read_json
from ..files.folders import RECORD, check_disk, write_json
from ..scenes.points import write_ply
from ..scenes.scene import load_scene
from ..scenes.triangulate import Quality, triangulate
from . import outputs
from .inputs import FPS

POINTS = "points.ply"


class Finished(NamedTuple):
    """The folder of a run, the names of its frames in their order, its record ({} where it left none)."""

    folder: Path
    names: tuple[str, ...]
    record: dict[str, Any]

    def frames(self) -> np.ndarray:
        """uint8 [n, h, w, 3]. Raises: UserError for frames of several sizes."""
        from ..scenes.images import read_image

        files = [self.folder / outputs.FRAMES / name for name in self.names]
        frames = [video_io.to_uint8(read_image(file)) for file in files]
        for file, frame in zip(files, frames, strict=True):
            if frame.shape != frames[0].shape:
                raise UserError(
                    f"{file}: is {frame.shape[1]} x {frame.shape[0]} pixels, the first frame {frames[0].shape[1]} x "
                    f"{frames[0].shape[0]}: give the folder as `sample` wrote it."
                )
        return np.stack(frames)

    @property
    def fps(self) -> float:
        """Frames per second of the run."""
        said = self.record.get("arguments", {}).get("fps")
        return float(said) if isinstance(said, int | float) and said > 0 else FPS

    @property
    def about(self) -> str | None:
        """The remark that its files carry (`outputs.remark`)."""
        if "config" not in self.record:
            return None
        version = self.record.get("versions", {}).get("roge_jax")
        return outputs.remark(self.record["config"], self.record.get("settings", {}), version)


def read(folder: Path) -> Finished:
    """The run in a folder. Raises: UserError if it has no frames."""
    place = folder / outputs.FRAMES
    files = sorted(place.glob("[0-9]*.png")) if place.is_dir() else []
    if not files:
        raise UserError(
            f"{folder}: has no frames ({place}/0000.png ..): give a folder that `python -m roge_jax.sample` wrote."
        )
    record = read_json(folder / RECORD, "record") if is_file(folder / RECORD) else {}
    return Finished(
        folder, tuple(f.name for f in files), record if isinstance(record, dict) else {}
    )


def write_videos(made: Finished, kinds: Sequence[str], fps: float | None = None) -> list[Path]:
    """video.KIND of the frames, into the run's folder."""
    if not kinds:
        return []
    frames, fps = made.frames(), fps or made.fps
    check_disk(frames.nbytes / 2, made.folder, "The video")
    return [
        video_io.write_video(made.folder / f"video.{kind}", frames, fps, about=made.about)
        for kind in kinds
    ]


def write_points(made: Finished) -> Quality:
    """Points triangulated from the frames, into the run's folder: points.ply, and into its transforms.json and COLMAP model,
    which 3D Gaussian trainers start from.

    Raises: UserError for a folder without cameras or with other frames than its cameras are for, and if there are none.
    """
    file, count = made.folder / "transforms.json", len(made.names)
    if not is_file(file):
        raise UserError(
            f"{made.folder}: has no transforms.json with the cameras of its frames: give the folder of a finished run."
        )
    scene = load_scene(file)
    if scene.names[:count] != made.names or len(set(scene.sizes)) > 1:
        raise UserError(
            f"{file}: does not begin with the {count} frames of {made.folder / outputs.FRAMES}, all of one size: give the "
            "folder as `sample` wrote it."
        )
    points, quality = triangulate(made.frames(), scene.cameras[:count])
    write_ply(made.folder / POINTS, points, about=made.about)
    others = len(scene) - count  # photos, into which nothing was followed
    seen = [*(points.seen or ()), *[np.zeros(0, int)] * others]
    pixels = [*(points.pixels or ()), *[np.zeros((0, 2))] * others]
    points = dataclasses.replace(points, seen=seen, pixels=pixels)
    given = scene.names, scene.cameras, scene.sizes[0], points
    outputs.write_model(made.folder, *given, about=made.about)
    write_json(file, read_json(file) | {"ply_file_path": POINTS})
    return quality
