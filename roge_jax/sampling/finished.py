"""A run that `sample` finished, or that failed after its frames: what else can be made of its folder without a model.

made = read(Path("outputs/sample"))
write_videos(made, ["gif"])
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError
from ..files import video_io
from ..files.fields import is_file, read_json
from ..files.folders import RECORD, check_disk
from . import outputs
from .inputs import FPS


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
    frames, fps = made.frames(), fps or made.fps
    check_disk(frames.nbytes / 2, made.folder, "The video")
    return [
        video_io.write_video(made.folder / f"video.{kind}", frames, fps, about=made.about)
        for kind in kinds
    ]
