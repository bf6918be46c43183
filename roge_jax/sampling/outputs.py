"""What a finished video leaves in its folder: frames, videos, the same as a scene for other tools, and the record of the run.

frames/                                  the frames, written first: what fails after them leaves them there
images/, transforms.json, sparse/0/      frames and photos with their cameras, for nerfstudio and 3D Gaussian trainers
video.mp4, preview.mp4, contact_sheet.png, run.json
"""

import contextlib
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..config import RoGeConfig, to_dict
from ..files import video_io
from ..files.entry import Clock, environment, version
from ..files.folders import check_disk, plain, write_json
from ..geometry.cameras import Cameras, concatenate
from ..scenes import writers
from ..scenes.paths import transforms
from ..scenes.scene import Scene, prepare
from .photos import Photos
from .video import Result

FRAMES, IMAGES, MODEL = "frames", "images", "sparse/0"
ROOM = (
    1.5  # bytes on the disk for each byte of the frames, at most: the frames, two videos, the sheet
)


def remark(config: dict[str, Any], settings: dict[str, Any], release: str | None = None) -> str:
    """What every file that has a place for it says of its origin: version, seed and configuration, as one line of JSON.

    Arguments as in run.json.
    """
    said = {
        "roge_jax": release or version(),
        "model": config.get("name"),
        "seed": settings.get("seed"),
    }
    return json.dumps(plain(said | {"config": config}), separators=(",", ":"))


def check_outputs(
    folder: Path,
    kinds: Sequence[str],
    frames: int,
    size: tuple[int, int],
    fps: float,
    *,
    exr: bool = False,
) -> tuple[str, ...]:
    """The kinds of video that can be written here in place of `kinds`, before anything is computed.

    Raises: UserError for pictures that no codec takes, and for a disk that has no room for them.
    """
    each = 3 * ROOM + (3 * 4 if exr else 0)  # bytes a pixel
    check_disk(each * frames * size[0] * size[1] + 1e6, folder, "The video")
    return video_io.usable_kinds(folder, kinds, *size, fps)


def write_outputs(
    folder: Path,
    result: Result,
    scene: Scene,
    photos: Photos,
    fps: float,
    *,
    kinds: Sequence[str] = ("mp4",),
    generated: bool = True,
    about: str | None = None,
    exr: bool = False,
) -> None:
    """All files but run.json. Where nothing is generated the frames are the preview, which is not written twice."""
    names = video_io.write_frames(folder / FRAMES, result.frames, about=about)
    given = write_scene(folder, names, result, scene, photos, about=about, fps=fps)
    if exr:
        write_floats(folder / "exr", result, about=about)
    for kind in kinds:
        video_io.write_video(folder / f"video.{kind}", result.frames, fps, about=about)
    rows: dict[str, Any] = {"photos": given}
    if generated:
        for kind in kinds:
            video_io.write_video(folder / f"preview.{kind}", result.preview, fps, about=about)
        rows["generated"] = result.frames
    rows["preview (reconstruction)" if generated else "video (reconstruction)"] = result.preview
    sheet = video_io.contact_sheet(rows)
    video_io.write_png(folder / "contact_sheet.png", sheet, about=about)


def write_floats(folder: Path, result: Result, *, about: str | None) -> None:
    """exr/0000.exr ..: the frames before they are rounded to 8 bits, each with its camera (`files.exr`)."""
    from ..files import exr

    folder.mkdir()
    cameras = result.cameras
    for i, (frame, K, c2w) in enumerate(zip(result.frames, cameras.K, cameras.c2w, strict=True)):
        exr.write_exr(folder / f"{i:04d}.exr", exr.Picture(frame, None, K, c2w, about))


def write_scene(
    folder: Path,
    names: Sequence[str],
    result: Result,
    scene: Scene,
    photos: Photos,
    *,
    about: str | None,
    fps: float,
) -> np.ndarray:
    """Frames and photos as one scene: images/, transforms.json (nerfstudio), sparse/0 (COLMAP, with the scene's points).

    The photos come last, cut as the frames are: [m, H, W, 3], which are returned. A path file made of it is the frames'
    alone (`path_frames`).
    """
    (height, width), names = result.frames.shape[1:3], list(names)
    (folder / IMAGES).mkdir()
    for name in names:
        link_or_copy(folder / FRAMES / name, folder / IMAGES / name)
    pictures, cameras = prepare(scene, photos.ids, height, width, drop_duplicates=False)
    for i, picture in enumerate(pictures):
        names.append(f"photo{i:02d}.png")
        video_io.write_png(folder / IMAGES / names[-1], picture, about=about)
    every = concatenate(result.cameras, cameras)
    write_model(folder, names, every, (height, width), scene.points, about=about)
    content = transforms(names, every, height, width, folder=IMAGES)
    said = json.loads(about) if about else {}
    content |= {"fps": fps, "roge_jax": {**said, "path_frames": len(result.frames)}}
    write_json(folder / "transforms.json", content)
    return pictures


def write_model(
    folder: Path,
    names: Sequence[str],
    cameras: Cameras,
    size: tuple[int, int],
    points,
    *,
    about: str | None,
) -> None:
    """The COLMAP model of a folder, as text: it has a place for remarks, and every tool reads it."""
    more: dict[str, Any] = {"names": names, "points": points, "about": about}
    writers.write(folder / MODEL, cameras, *size, layout="colmap", **more)


def link_or_copy(file: Path, to: Path) -> None:
    """The same file under a second name, or a copy where the disk knows no such thing."""
    with contextlib.suppress(OSError):
        return os.link(file, to)
    shutil.copyfile(file, to)


def record(
    program: str,
    arguments: dict[str, Any],
    config: RoGeConfig,
    settings: dict[str, Any],
    scene: Scene,
    photos: Photos,
    result: Result,
    clock: Clock,
    *,
    generated: bool = True,
) -> dict[str, Any]:
    """run.json: everything needed to know what was made and to make it again."""
    info, stages = result.normalisation, clock.record()
    pace = (
        {}
        if generated
        else {"seconds_per_frame": stages["preview"]["seconds"] / len(result.frames)}
    )
    return {
        "program": program,
        **environment(),
        "arguments": arguments,
        "generated": generated,
        "settings": settings,
        "scene": {
            "source": scene.source,
            "photos": len(scene),
            "context": list(photos.ids),
            "context_names": [scene.names[i] for i in photos.ids],
        },
        "scale": {
            "divisor": info.divisor,
            "status": info.status,
            "rule": info.rule,
            "context_reach": info.context_reach,
            "target_reach": info.target_reach,
        },
        "frames": len(result.frames),
        "size": list(result.frames.shape[1:3]),
        "evaluations": result.evaluations,
        "windows": list(result.windows),
        "warnings": [one._asdict() for one in result.warnings],
        "stages": stages,
        **pace,
        "config": to_dict(config),
    }
