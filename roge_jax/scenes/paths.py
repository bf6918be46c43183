"""Camera paths: any file or scene folder as the cameras of a video, and our own path files (docs/reference/formats.md)."""

import dataclasses
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError, did_you_mean
from roge_jax.files.fields import number
from roge_jax.geometry.cameras import (
    CONVENTIONS,
    Cameras,
    CameraWarning,
    crop_resize_K,
    invert,
    opencv_to_opengl,
    to_host,
    validate,
)
from roge_jax.geometry.interpolation import interpolate
from roge_jax.geometry.validation import Finding
from roge_jax.scenes import world, writers
from roge_jax.scenes.assemble import Posed, pose_frame
from roge_jax.scenes.frames import Frame, Reading
from roge_jax.scenes.readers import read_place
from roge_jax.scenes.writers import transforms

__all__ = [
    "KeyFrames",
    "LoadedPath",
    "interpolate",
    "load_path",
    "read_keys",
    "read_path",
    "save_keys",
    "save_path",
    "transforms",
]

MOST = 1_000_000  # frames that keyframes are interpolated to: more are a slip of the pen
KEY_FRAMES = 81  # of key frames that do not say how many frames they make


@dataclasses.dataclass(frozen=True)
class LoadedPath:
    """A path as it was read: its cameras, its frames per second where it says so, and what is to be said about it."""

    cameras: Cameras
    fps: float | None
    axes: str = ""  # the convention that its poses were read in, where the format leaves it open
    notes: tuple[Finding, ...] = ()


def save_path(
    file: str | Path,
    cameras: Cameras,
    height: int,
    width: int,
    *,
    convention: str = "opencv",
    fps: float | None = None,
    layout: str = "path",
    names: Sequence[str] | None = None,
) -> None:
    """Writes cameras [n] of height x width pictures as a path file, every frame with its K.

    layout: "path" is our own; "nerfstudio", "realestate10k", "tum" (a file each), "colmap" and "colmap-binary" (`file`
    is the folder of the model) are those of other programs, with `names` for the pictures (`writers.write`).
    """
    if layout != "path":
        if convention != "opencv":
            raise UserError(f"{file}: {layout} has axes of its own: leave 'convention' away.")
        return writers.write(file, cameras, height, width, layout=layout, names=names, fps=fps)
    if convention not in CONVENTIONS:
        hint = did_you_mean(convention, CONVENTIONS)
        raise UserError(f"Unknown camera convention '{convention}': {hint}")
    cameras = to_host(cameras)
    poses = cameras.c2w
    poses = opencv_to_opengl(poses) if convention.startswith("opengl") else poses
    poses = invert(poses) if convention.endswith("_w2c") else poses
    entries = [
        {"pose": pose.tolist(), "K": K.tolist()} for pose, K in zip(poses, cameras.K, strict=True)
    ]
    content: dict[str, Any] = {"convention": convention, "width": width, "height": height}
    content |= {"fps": fps} if fps else {}
    Path(file).write_text(json.dumps(content | {"frames": entries}, indent=1), encoding="utf-8")


def load_path(
    file: str | Path,
    *,
    frames: int | None = None,
    height: int | None = None,
    width: int | None = None,
    context: Cameras | None = None,
    convention: str | None = None,
    frame: world.Frame = None,
    scene: str | Path | None = None,
) -> Cameras:
    """Cameras [n] (float64, OpenCV, world units) of a path file, or of a scene's own file or folder.

    Args:
      file: our format, or any of those of `scenes.readers` (docs/reference/formats.md lists them).
      frames: how many frames to make of a file with key frames; others are taken as they are and must have this many.
      height: of the pictures to make; K is moved there from the file's own size by a centred crop and a resize.
        Default: K stays in pixels of the file's size.
      width: likewise.
      context: whose first K (in pixels of height x width) is used if the file has no intrinsics, and whose first pose
        leads a path that is relative to its first camera.
      convention: axes of the poses where the format leaves them open and the file does not say them.
      frame: the coordinates of the path: None to find out, "scene", "first" or "first:SCALE" (starts at the first
        photo), a `dataparser_transforms.json`, or (4x4 that takes the path to the scene, scale of positions before it).
      scene: where the scene was read from, for `dataparser_transforms.json` and its `applied_transform`.
    Raises: UserError naming the file, the frame and the field.
    """
    path = read_path(
        file,
        frames=frames,
        height=height,
        width=width,
        context=context,
        convention=convention,
        frame=frame,
        scene=scene,
    )
    for note in path.notes:
        if note.severity == "warning":
            warnings.warn(str(note), CameraWarning, stacklevel=2)
    return path.cameras


def read_path(
    file: str | Path,
    *,
    frames: int | None = None,
    height: int | None = None,
    width: int | None = None,
    context: Cameras | None = None,
    convention: str | None = None,
    frame: world.Frame = None,
    scene: str | Path | None = None,
) -> LoadedPath:
    """`load_path` with the file's frame rate and its notes."""
    file = Path(file)
    if frames is not None:
        frames = number(frames, str(file), "frames", low=1, whole=True)
    target = (height, width) if height and width else None
    cameras, reading = _as_written(file, target, context, convention, frame, scene)
    notes = tuple(note for note in reading.notes if reading.keys or _concerns_a_path(note))
    if reading.keys:
        count = frames or reading.count or KEY_FRAMES
        if count > MOST:
            raise UserError(f"{file}: {count} frames: give at most {MOST} of them.")
        times = reading.times
        cameras = interpolate(cameras, np.linspace(0.0, 1.0, count), times=times)
    elif frames is not None and frames != len(cameras):
        raise UserError(
            f"{file}: has {len(cameras)} frames but {frames} were asked for: ask for "
            f"{len(cameras)}, or write 'keyframes' to have them interpolated."
        )
    return LoadedPath(cameras, reading.fps, reading.axes, notes)


@dataclasses.dataclass(frozen=True)
class KeyFrames:
    """Key cameras [k] of a path as a file has them, not interpolated; `times` [k] in seconds, None for constant speed.

    `whole`: the file has frames and no key frames; these are all of them.
    """

    cameras: Cameras
    times: np.ndarray | None = None
    count: int | None = None
    fps: float | None = None
    whole: bool = False


def read_keys(
    file: str | Path,
    *,
    height: int,
    width: int,
    context: Cameras,
    convention: str | None = None,
    frame: world.Frame = None,
    scene: str | Path | None = None,
) -> KeyFrames:
    """The key frames of a path file, for editing; arguments as of `load_path`."""
    file = Path(file)
    cameras, reading = _as_written(file, (height, width), context, convention, frame, scene)
    return KeyFrames(cameras, reading.times, reading.count, reading.fps, not reading.keys)


def save_keys(file: str | Path, keys: KeyFrames, height: int, width: int) -> None:
    """Writes key cameras of height x width pictures as a path file of our own, which `load_path` interpolates."""
    cameras = to_host(keys.cameras)
    entries = [
        {"pose": pose.tolist(), "K": K.tolist()}
        for pose, K in zip(cameras.c2w, cameras.K, strict=True)
    ]
    if keys.times is not None:
        entries = [entry | {"time": float(t)} for entry, t in zip(entries, keys.times, strict=True)]
    content: dict[str, Any] = {"convention": "opencv", "width": width, "height": height}
    content |= {k: v for k, v in (("fps", keys.fps), ("count", keys.count)) if v is not None}
    Path(file).write_text(json.dumps(content | {"keyframes": entries}, indent=1), encoding="utf-8")


def _as_written(
    file: Path,
    target: tuple[int, int] | None,
    context: Cameras | None,
    convention: str | None,
    frame: world.Frame,
    scene: str | Path | None,
) -> tuple[Cameras, Reading]:
    """The cameras that a path file lists, frames or key frames, in the scene's coordinates."""
    reading = read_place(file, convention=convention, photos=False, target=target)
    if not reading.frames:
        raise UserError(f"{file}: has no cameras: give a list 'frames' or 'keyframes'.")
    posed = _posed(reading, file)
    K, sizes = _intrinsics(reading, posed, target, context, file)
    poses = np.stack([one.c2w for one in posed])
    place = Path(scene) if scene is not None and Path(scene).exists() else None
    first = None if context is None else to_host(context).c2w[0]
    poses = world.to_scene(poses, frame, reading.frame, file, place, first)
    names = [f"{file.name} frame {i}" for i in range(len(poses))]
    heights, widths = zip(*sizes, strict=True)
    return validate(
        Cameras(np.stack(K), poses), heights, widths, names, read_as=reading.axes
    ), reading


def _concerns_a_path(note: Finding) -> bool:
    """Notes about masks and photos say nothing about cameras."""
    return not any(word in note.what for word in ("masks", "photos"))


def _posed(reading: Reading, file: Path) -> list[Posed]:
    """The cameras of the shown pictures; those without intrinsics with the pose alone."""
    blank = np.eye(3)
    return [
        pose_frame(
            one if one.K is not None else dataclasses.replace(one, file=None, K=blank, lens=None),
            str(file),
        )
        for one in reading.frames
    ]


def _intrinsics(
    reading: Reading,
    views: list[Posed],
    target: tuple[int, int] | None,
    context: Cameras | None,
    file: Path,
) -> tuple[list[np.ndarray], list[tuple[int, int]]]:
    """K of every frame in pixels of `target` (or of its own picture), and the sizes of those pictures."""
    found, sizes = [], []
    for i, (one, posed) in enumerate(zip(reading.frames, views, strict=True)):
        where = f"{file}, frame {i}"
        if one.K is None:
            if context is None:
                raise UserError(
                    f"{where}: no intrinsics: give 'K' (3x3, pixels) or 'fov' (degrees)."
                )
            found.append(to_host(context).K[0])
            sizes.append(target or _guess(found[-1]))
            continue
        if target is None or posed.size == target:
            found.append(posed.K)
            sizes.append(posed.size or target or _guess(posed.K))
            continue
        if posed.size is None:
            raise UserError(
                f"{where}: K needs the picture size it is for: give 'height' and 'width'."
            )
        found.append(_moved(posed.K, posed.size, target, one))
        sizes.append(target)
    return found, sizes


def _moved(K: np.ndarray, size: tuple[int, int], target: tuple[int, int], one: Frame) -> np.ndarray:
    """K after a centred crop and a resize: to whole pixels where there is a photo to be cropped, else exactly."""
    if one.file is not None:
        return crop_resize_K(K, size, target)
    factor = max(target[0] / size[0], target[1] / size[1])
    moved = K.copy()
    moved[:2] *= factor
    moved[0, 2] -= 0.5 * (size[1] * factor - target[1])
    moved[1, 2] -= 0.5 * (size[0] * factor - target[0])
    return moved


def _guess(K: np.ndarray) -> tuple[int, int]:
    """A picture size from the principal point, where nobody says one."""
    middle = np.nan_to_num(np.abs(K[[1, 0], 2]), posinf=1.0).clip(1.0, 1e6)
    return int(2 * middle[0]), int(2 * middle[1])
