"""COLMAP models, text and binary: cameras and images, without the points."""

import struct
from pathlib import Path

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.fields import read_text
from roge_jax.geometry.cameras import invert, rotation
from roge_jax.scenes.images import Frame, Lens

# Model name and number of parameters by COLMAP's id.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
_ONE_FOCAL = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")

Camera = tuple[np.ndarray, tuple[int, int], Lens | None]


def find_model(folder: Path) -> Path | None:
    """The folder below `folder` that holds a COLMAP model, if any."""
    for place in ("sparse/0", "sparse", "colmap/sparse/0", "dense/sparse", "."):
        for ending in ("bin", "txt"):
            if all(
                (folder / place / f"{part}.{ending}").is_file() for part in ("cameras", "images")
            ):
                return folder / place
    return None


def read_colmap(folder: Path, model: Path, images: Path) -> list[Frame]:
    """The registered photos of a COLMAP model in order of their names.

    Args: `folder` of the scene (for messages), `model` with cameras and images as .bin or .txt (the
      binary files win), `images` the folder that the image names are relative to.
    """
    if (model / "images.bin").is_file() and (model / "cameras.bin").is_file():
        cameras, poses = _read_bin(model)
    else:
        cameras, poses = _read_txt(model)
    if not poses:
        raise UserError(
            f"{folder}: the COLMAP model has no registered images: run the mapper again."
        )
    frames = []
    for name, camera_id, q_wxyz, t in sorted(poses, key=lambda pose: pose[0]):
        if camera_id not in cameras:
            raise UserError(f"{model}: image {name} uses camera {camera_id}, which does not exist.")
        w2c = np.eye(4)
        w2c[:3, :3], w2c[:3, 3] = rotation(np.roll(q_wxyz, -1)), t
        K, size, lens = cameras[camera_id]
        frames.append(Frame(images / name, K, invert(w2c), size, lens))
    return frames


def make_camera(model: str, parameters: np.ndarray, width: int, height: int, where: str) -> Camera:
    """(K, (height, width), lens or None) of COLMAP's or nerfstudio's camera parameters."""
    expected = {name: count for name, count in MODELS.values()}
    if model not in expected or model in ("FOV", "THIN_PRISM_FISHEYE"):
        usable = [name for name in expected if name not in ("FOV", "THIN_PRISM_FISHEYE")]
        raise UserError(
            f"{where}: camera model {model} is not supported (of {', '.join(usable)}): "
            "undistort the photos with COLMAP's image_undistorter."
        )
    if len(parameters) != expected[model]:
        count = expected[model]
        raise UserError(f"{where}: {model} has {count} parameters, found {len(parameters)}.")
    focals = 1 if model in _ONE_FOCAL else 2
    (fx, fy), (cx, cy) = parameters[[0, focals - 1]], parameters[focals : focals + 2]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    rest = parameters[focals + 2 :]
    if not np.any(rest):
        # A fisheye without coefficients is still no pinhole camera.
        lens = Lens("fisheye", (0.0,) * 4) if model in _FISHEYE else None
    elif model in _FISHEYE:
        lens = Lens("fisheye", tuple(np.pad(rest, (0, 4 - len(rest))).tolist()))
    else:
        lens = Lens("opencv", tuple(np.pad(rest, (0, max(0, 4 - len(rest)))).tolist()))
    return K, (int(height), int(width)), lens


def _sized_camera(
    model: str, parameters: np.ndarray, width: int, height: int, where: str
) -> Camera:
    if min(width, height) < 1:
        raise UserError(
            f"{where}: the camera's pictures are {width} x {height} pixels: both must be 1 or more."
        )
    return make_camera(model, parameters, width, height, where)


def _read_txt(model: Path) -> tuple[dict[int, Camera], list]:
    cameras = {}
    for number, words in _lines(model / "cameras.txt"):
        where = f"{model / 'cameras.txt'}, line {number}"
        if not words:
            continue
        try:
            numbers = np.array([float(word) for word in words[2:]])
            width, height = int(numbers[0]), int(numbers[1])
            cameras[int(words[0])] = _sized_camera(words[1], numbers[2:], width, height, where)
        except (ValueError, IndexError, OverflowError) as error:
            raise (
                error
                if isinstance(error, UserError)
                else UserError(f"{where}: expected 'id MODEL width height parameters'.")
            ) from None
    poses = []
    lines = list(_lines(model / "images.txt"))
    while lines and not lines[0][1]:
        lines.pop(0)
    # Two lines per image; the second lists its points and may be empty, so blank lines count.
    for number, words in lines[::2]:
        if not words:
            continue
        try:
            numbers = np.array([float(word) for word in words[1:8]])
            poses.append((" ".join(words[9:]), int(words[8]), numbers[:4], numbers[4:]))
        except (ValueError, IndexError):
            raise UserError(
                f"{model / 'images.txt'}, line {number}: expected 'id qw qx qy qz tx ty tz camera "
                "name', followed by a line of points (which may be empty)."
            ) from None
    return cameras, poses


def _lines(file: Path) -> list[tuple[int, list[str]]]:
    """(number, words) of every line that is not a comment."""
    text = read_text(file, "scene file").splitlines()
    return [(i + 1, line.split()) for i, line in enumerate(text) if not line.startswith("#")]


def _read_bin(model: Path) -> tuple[dict[int, Camera], list]:
    cameras, poses = {}, []
    file = model / "cameras.bin"
    try:
        data, at = file.read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, at)
            name, count = MODELS.get(model_id, (f"number {model_id}", 0))
            parameters = np.frombuffer(data, "<f8", count, at + 24)
            cameras[camera_id] = _sized_camera(name, parameters, width, height, str(file))
            at += 24 + 8 * count
        file = model / "images.bin"
        data, at = file.read_bytes(), 8
        for _ in range(struct.unpack_from("<Q", data)[0]):
            *numbers, camera_id = struct.unpack_from("<4d3di", data, at + 4)
            end = data.index(b"\0", at + 64)
            name = data[at + 64 : end].decode("utf-8")
            points = struct.unpack_from("<Q", data, end + 1)[0]
            at = end + 9 + 24 * points
            poses.append((name, camera_id, np.array(numbers[:4]), np.array(numbers[4:])))
    except UserError:
        raise
    except (struct.error, ValueError) as error:
        raise UserError(f"{file}: damaged or truncated COLMAP file ({error}).") from None
    return cameras, poses
