"""Cameras in the files of other programs: nerfstudio, RealEstate10K, TUM, COLMAP (text and binary).

Each function writes what the format's own programs read; `scenes.readers` reads all of it back.
"""

import json
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from roge_jax.errors import UserError, did_you_mean
from roge_jax.geometry.cameras import Cameras, invert, opencv_to_opengl, quaternion, to_host
from roge_jax.scenes.points import Points

FPS = 16.0  # of time stamps, where nobody says another
PINHOLE = 1  # COLMAP's number of the camera model


def transforms(
    names: Sequence[str], cameras: Cameras, height: int, width: int, *, folder: str = "frames"
) -> dict[str, Any]:
    """nerfstudio's transforms.json of the frames: c2w in OpenGL axes, in the scene's own frame and unit."""
    frames = []
    for name, K, pose in zip(names, cameras.K, opencv_to_opengl(cameras.c2w), strict=True):
        entry = {
            "file_path": f"{folder}/{name}" if folder else name,
            "fl_x": K[0, 0],
            "fl_y": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
        }
        frames.append(entry | {"transform_matrix": pose})
    return {"camera_model": "OPENCV", "w": width, "h": height, "frames": frames}


class Poses(NamedTuple):
    """What a layout is written from: `size` is (height, width); points and remark may be None."""

    cameras: Cameras
    size: tuple[int, int]
    names: list[str]
    fps: float
    points: Points | None
    about: str | None


def write(
    place: str | Path,
    cameras: Cameras,
    height: int,
    width: int,
    *,
    layout: str,
    names: Sequence[str] | None = None,
    fps: float | None = None,
    points: Points | None = None,
    about: str | None = None,
) -> None:
    """Cameras [n] of height x width pictures in another program's layout, one of LAYOUTS.

    place: a file, for COLMAP the folder of the model. names: of the pictures (default 0000.png ..). fps: for the time
    stamps of TUM and RealEstate10K. points: for COLMAP, with tracks where they know their pixels. about: a remark in one
    line, for the layouts in text that have a place for one. Raises: UserError for what the layout cannot hold.
    """
    if layout not in LAYOUTS:
        raise UserError(f"Unknown layout '{layout}': {did_you_mean(layout, LAYOUTS)}")
    cameras = to_host(cameras)
    names = [f"{i:04d}.png" for i in range(len(cameras))] if names is None else list(names)
    if len(names) != len(cameras):
        raise UserError(
            f"{place}: {len(names)} names for {len(cameras)} cameras: give one of each."
        )
    if layout != "tum" and np.abs(cameras.K[:, 0, 1]).max(initial=0.0) > 1e-9:
        raise UserError(f"{place}: {layout} has no place for the skew in K: set it to 0.")
    if layout == "colmap" and any(name.split() != [name] for name in names):
        raise UserError(
            f"{place}: COLMAP's text files cannot hold names with blanks: give layout='colmap-binary'."
        )
    poses = Poses(cameras, (height, width), names, fps or FPS, points, about)
    LAYOUTS[layout](Path(place), poses)


def _nerfstudio(place: Path, poses: Poses) -> None:
    content = transforms(poses.names, poses.cameras, *poses.size, folder="")
    for entry in content["frames"]:
        entry["transform_matrix"] = entry["transform_matrix"].tolist()
    place.write_text(json.dumps(content | {"fps": poses.fps}, indent=1), encoding="utf-8")


def _re10k(place: Path, poses: Poses) -> None:
    """An address line, then `microseconds fx fy cx cy 0 0` (divided by width and height) and w2c [3, 4]."""
    (height, width), cameras = poses.size, poses.cameras
    lines = ["roge_jax"]
    for i, (K, w2c) in enumerate(zip(cameras.K, invert(cameras.c2w), strict=True)):
        inner = [K[0, 0] / width, K[1, 1] / height, K[0, 2] / width, K[1, 2] / height, 0.0, 0.0]
        time = round(1e6 * i / poses.fps)
        lines.append(" ".join([str(time), *_digits([*inner, *w2c[:3].ravel()])]))
    place.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _tum(place: Path, poses: Poses) -> None:
    """`timestamp tx ty tz qx qy qz qw`, camera to world; intrinsics have no place there."""
    lines = [*_remark(poses), "# timestamp tx ty tz qx qy qz qw"]
    turns = quaternion(poses.cameras.c2w[:, :3, :3])
    for i, (centre, q) in enumerate(zip(poses.cameras.centres, turns, strict=True)):
        lines.append(" ".join(_digits([i / poses.fps, *centre, *q])))
    place.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _remark(poses: Poses) -> list[str]:
    return [f"# {poses.about}"] if poses.about else []


def _digits(numbers: Iterable[float]) -> list[str]:
    return [repr(float(number)) for number in numbers]


def _colmap_parts(cameras: Cameras) -> tuple[list[np.ndarray], list[int], np.ndarray, np.ndarray]:
    """(fx fy cx cy of every different camera, the camera of every image from 1, quaternions w x y z, translations)."""
    inner = [tuple(K[[0, 1, 0, 1], [0, 1, 2, 2]]) for K in cameras.K]
    kinds = list(dict.fromkeys(inner))
    w2c = invert(cameras.c2w)
    q = np.roll(quaternion(w2c[:, :3, :3]), 1, axis=-1)
    return [np.array(kind) for kind in kinds], [kinds.index(k) + 1 for k in inner], q, w2c[:, :3, 3]


class Track(NamedTuple):
    """A point of a COLMAP model: where, its colour, its error in pixels, and (image from 1, number of its pixel) of all
    views that see it."""

    xyz: np.ndarray
    rgb: np.ndarray
    error: float
    seen: list[tuple[int, int]]


def _observations(poses: Poses) -> tuple[list[Track], list[list[tuple[float, float, int]]]]:
    """(points, of every image its pixels x, y with the number of their point, from 1); no pixels where nobody knows them."""
    images: list[list[tuple[float, float, int]]] = [[] for _ in poses.names]
    points = poses.points
    if points is None:
        return [], images
    rgb = np.full((len(points), 3), 128, np.uint8) if points.rgb is None else points.rgb
    errors = np.zeros(len(points)) if points.error is None else points.error
    tracks = [Track(*one, []) for one in zip(points.xyz, rgb, errors.tolist(), strict=True)]
    for image, (seen, pixels) in enumerate(zip(points.seen or (), points.pixels or ())):
        for point, (x, y) in zip(seen.tolist(), pixels.tolist(), strict=True):
            tracks[point].seen.append((image + 1, len(images[image])))
            images[image].append((x, y, point + 1))
    return tracks, images


def _colmap_text(place: Path, poses: Poses) -> None:
    place.mkdir(parents=True, exist_ok=True)
    kinds, ids, q, t = _colmap_parts(poses.cameras)
    tracks, pixels = _observations(poses)
    (height, width), remark = poses.size, _remark(poses)
    lines = [*remark, "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for i, kind in enumerate(kinds, 1):
        lines.append(" ".join([str(i), "PINHOLE", str(width), str(height), *_digits(kind)]))
    (place / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    lines = [*remark, "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    lines.append("# then a line of X, Y, POINT3D_ID")
    for i, (name, camera) in enumerate(zip(poses.names, ids, strict=True)):
        lines.append(" ".join([str(i + 1), *_digits([*q[i], *t[i]]), str(camera), name]))
        lines.append(" ".join(f"{x!r} {y!r} {point}" for x, y, point in pixels[i]))
    (place / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    lines = [*remark, "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for i, point in enumerate(tracks, 1):
        words = [str(i), *_digits(point.xyz), *map(str, point.rgb.tolist()), repr(point.error)]
        lines.append(" ".join(words + [f"{image} {pixel}" for image, pixel in point.seen]))
    (place / "points3D.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _colmap_binary(place: Path, poses: Poses) -> None:
    place.mkdir(parents=True, exist_ok=True)
    kinds, ids, q, t = _colmap_parts(poses.cameras)
    tracks, pixels = _observations(poses)
    height, width = poses.size
    data = [struct.pack("<Q", len(kinds))]
    for i, kind in enumerate(kinds, 1):
        data.append(struct.pack("<iiQQ4d", i, PINHOLE, width, height, *kind))
    (place / "cameras.bin").write_bytes(b"".join(data))
    data = [struct.pack("<Q", len(poses.names))]
    for i, (name, camera) in enumerate(zip(poses.names, ids, strict=True)):
        data.append(struct.pack("<I7dI", i + 1, *q[i], *t[i], camera) + name.encode() + b"\0")
        data.append(struct.pack("<Q", len(pixels[i])))
        data += [struct.pack("<ddQ", *one) for one in pixels[i]]
    (place / "images.bin").write_bytes(b"".join(data))
    data = [struct.pack("<Q", len(tracks))]
    for i, point in enumerate(tracks, 1):
        data.append(
            struct.pack("<Q3d3BdQ", i, *point.xyz, *point.rgb, point.error, len(point.seen))
        )
        data += [struct.pack("<II", *one) for one in point.seen]
    (place / "points3D.bin").write_bytes(b"".join(data))


LAYOUTS: dict[str, Callable[[Path, Poses], None]] = {
    "nerfstudio": _nerfstudio,
    "realestate10k": _re10k,
    "tum": _tum,
    "colmap": _colmap_text,
    "colmap-binary": _colmap_binary,
}
