"""Cameras in the files of other programs: nerfstudio, RealEstate10K, TUM, COLMAP (text and binary).

Each function writes what the format's own programs read; `scenes.readers` reads all of it back.
"""

import json
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError, did_you_mean
from roge_jax.geometry.cameras import Cameras, invert, opencv_to_opengl, quaternion, to_host

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


def write(
    place: str | Path,
    cameras: Cameras,
    height: int,
    width: int,
    *,
    layout: str,
    names: Sequence[str] | None = None,
    fps: float | None = None,
) -> None:
    """Cameras [n] of height x width pictures in another program's layout, one of LAYOUTS.

    place: a file, for COLMAP the folder of the model. names: of the pictures (default 0000.png ..). fps: for the time
    stamps of TUM and RealEstate10K. Raises: UserError for what the layout cannot hold.
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
    LAYOUTS[layout](Path(place), cameras, (height, width), names, fps or FPS)


def _nerfstudio(
    place: Path, cameras: Cameras, size: tuple[int, int], names: list[str], fps: float
) -> None:
    content = transforms(names, cameras, *size, folder="")
    for entry in content["frames"]:
        entry["transform_matrix"] = entry["transform_matrix"].tolist()
    place.write_text(json.dumps(content | {"fps": fps}, indent=1))


def _re10k(
    place: Path, cameras: Cameras, size: tuple[int, int], names: list[str], fps: float
) -> None:
    """An address line, then `microseconds fx fy cx cy 0 0` (divided by width and height) and w2c [3, 4]."""
    height, width = size
    lines = ["roge_jax"]
    for i, (K, w2c) in enumerate(zip(cameras.K, invert(cameras.c2w), strict=True)):
        inner = [K[0, 0] / width, K[1, 1] / height, K[0, 2] / width, K[1, 2] / height, 0.0, 0.0]
        lines.append(" ".join([str(round(1e6 * i / fps)), *_digits([*inner, *w2c[:3].ravel()])]))
    place.write_text("\n".join(lines) + "\n")


def _tum(
    place: Path, cameras: Cameras, size: tuple[int, int], names: list[str], fps: float
) -> None:
    """`timestamp tx ty tz qx qy qz qw`, camera to world; intrinsics have no place there."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    turns = quaternion(cameras.c2w[:, :3, :3])
    for i, (centre, q) in enumerate(zip(cameras.centres, turns, strict=True)):
        lines.append(" ".join(_digits([i / fps, *centre, *q])))
    place.write_text("\n".join(lines) + "\n")


def _digits(numbers: Iterable[float]) -> list[str]:
    return [repr(float(number)) for number in numbers]


def _colmap_parts(cameras: Cameras) -> tuple[list[np.ndarray], list[int], np.ndarray, np.ndarray]:
    """(fx fy cx cy of every different camera, the camera of every image from 1, quaternions w x y z, translations)."""
    inner = [tuple(K[[0, 1, 0, 1], [0, 1, 2, 2]]) for K in cameras.K]
    kinds = list(dict.fromkeys(inner))
    w2c = invert(cameras.c2w)
    q = np.roll(quaternion(w2c[:, :3, :3]), 1, axis=-1)
    return [np.array(kind) for kind in kinds], [kinds.index(k) + 1 for k in inner], q, w2c[:, :3, 3]


def _colmap_text(
    place: Path, cameras: Cameras, size: tuple[int, int], names: list[str], fps: float
) -> None:
    place.mkdir(parents=True, exist_ok=True)
    kinds, ids, q, t = _colmap_parts(cameras)
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for i, kind in enumerate(kinds, 1):
        lines.append(" ".join([str(i), "PINHOLE", str(size[1]), str(size[0]), *_digits(kind)]))
    (place / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then a line of points"]
    for i, (name, camera) in enumerate(zip(names, ids, strict=True)):
        lines += [" ".join([str(i + 1), *_digits([*q[i], *t[i]]), str(camera), name]), ""]
    (place / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (place / "points3D.txt").write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")


def _colmap_binary(
    place: Path, cameras: Cameras, size: tuple[int, int], names: list[str], fps: float
) -> None:
    place.mkdir(parents=True, exist_ok=True)
    kinds, ids, q, t = _colmap_parts(cameras)
    data = struct.pack("<Q", len(kinds))
    for i, kind in enumerate(kinds, 1):
        data += struct.pack("<iiQQ4d", i, PINHOLE, size[1], size[0], *kind)
    (place / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(names))
    for i, (name, camera) in enumerate(zip(names, ids, strict=True)):
        data += struct.pack("<I7dI", i + 1, *q[i], *t[i], camera)
        data += name.encode() + b"\0" + struct.pack("<Q", 0)
    (place / "images.bin").write_bytes(data)
    (place / "points3D.bin").write_bytes(struct.pack("<Q", 0))


LAYOUTS: dict[str, Callable[[Path, Cameras, tuple[int, int], list[str], float], None]] = {
    "nerfstudio": _nerfstudio,
    "realestate10k": _re10k,
    "tum": _tum,
    "colmap": _colmap_text,
    "colmap-binary": _colmap_binary,
}
