"""COLMAP models, text and binary: where they lie, their cameras and images (`points` reads the points)."""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.fields import read_text
from roge_jax.geometry.cameras import invert, rotation
from roge_jax.scenes.lens import Lens

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
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
_UNREAD = (
    "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM",
    "EQUIRECTANGULAR",
)  # fmt: skip
_ONE_FOCAL = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_FISHEYE",
)
_FISHEYE = (
    "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE",
)  # fmt: skip

Camera = tuple[np.ndarray, tuple[int, int], Lens | None]


NAMES = ("cameras", "images")
PLACES = ("sparse", "colmap", "dense", "glomap", "distorted", "model", "models", "aligned")
DEEPEST = 4  # folders below a scene


def holds_model(folder: Path) -> bool:
    """Whether a folder is a COLMAP model, binary or text."""
    return any(
        all((folder / f"{part}.{ending}").is_file() for part in NAMES) for ending in ("bin", "txt")
    )


def find_models(folder: Path) -> list[Path]:
    """The COLMAP models of a scene folder: `sparse`, `sparse/N`, `dense/N/sparse`, `colmap/sparse/N` and so on.

    In the order in which they are preferred where they are equally large.
    """
    found: list[Path] = []

    def look(place: Path, depth: int) -> None:
        if holds_model(place):
            found.append(place)
        if depth == DEEPEST or not place.is_dir():
            return
        for below in sorted(place.iterdir(), key=_place):
            if below.is_dir() and (below.name.lower() in PLACES or below.name.isdecimal()):
                look(below, depth + 1)

    look(folder, 0)
    return sorted(found, key=lambda model: (model == folder, "dense" in model.parts))


def _place(folder: Path) -> tuple[int, int, str]:
    name = folder.name.lower()
    order = PLACES.index(name) if name in PLACES else len(PLACES)
    return order, int(name) if name.isdecimal() else -1, name


def model_size(model: Path) -> int:
    """How many photos a model has registered, from the head of its file."""
    file = model / "images.bin"
    if file.is_file() and (model / "cameras.bin").is_file():
        with file.open("rb") as stream:
            head = stream.read(8)
        return int(struct.unpack("<Q", head)[0]) if len(head) == 8 else 0
    return sum(1 for _ in _image_lines(model))


def read_model(model: Path) -> list[tuple[str, Camera, np.ndarray]]:
    """(name, camera, c2w) of the registered photos of a COLMAP model in order of their names.

    cameras and images are .bin or .txt; the binary files win.
    """
    if (model / "images.bin").is_file() and (model / "cameras.bin").is_file():
        cameras, poses = _read_bin(model)
    else:
        cameras, poses = _read_txt(model)
    if not poses:
        raise UserError(
            f"{model}: the COLMAP model has no registered images: run the mapper again."
        )
    found = []
    for name, camera_id, q_wxyz, t in sorted(poses, key=lambda pose: pose[0]):
        if camera_id not in cameras:
            raise UserError(f"{model}: image {name} uses camera {camera_id}, which does not exist.")
        w2c = np.eye(4)
        w2c[:3, :3], w2c[:3, 3] = rotation(np.roll(q_wxyz, -1)), t
        found.append((name, cameras[camera_id], invert(w2c)))
    return found


def image_names(model: Path) -> dict[int, str]:
    """The names of a model's registered photos by COLMAP's numbers."""
    file = model / "images.bin"
    if not (file.is_file() and (model / "cameras.bin").is_file()):
        lines = (text.split(None, 9) for _, text in _image_lines(model))
        return {int(words[0]): words[9] for words in lines}
    return {number: name for number, name, *_ in _images_bin(file)}


def make_camera(model: str, parameters: np.ndarray, width: int, height: int, where: str) -> Camera:
    """(K, (height, width), lens or None) of COLMAP's or nerfstudio's camera parameters."""
    expected = {name: count for name, count in MODELS.values()}
    if model not in expected or model in _UNREAD:
        usable = [name for name in expected if name not in _UNREAD]
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
    for number, line in _lines(model / "cameras.txt"):
        where, words = f"{model / 'cameras.txt'}, line {number}", line.split()
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
    for number, line in _image_lines(model):
        words = line.split()
        try:
            numbers = np.array([float(word) for word in words[1:8]])
            name = line.split(None, 9)[9]
            poses.append((name, int(words[8]), numbers[:4], numbers[4:]))
        except (ValueError, IndexError):
            raise UserError(
                f"{model / 'images.txt'}, line {number}: expected 'id qw qx qy qz tx ty tz camera "
                "name', followed by a line of points (which may be empty)."
            ) from None
    return cameras, poses


def _image_lines(model: Path) -> list[tuple[int, str]]:
    """(number, text) of the lines of images.txt that are images, also where the lines of points between them are missing.

    Two lines per image by the format; the second lists points (x y id) and may be empty. Exporters leave it out.
    """
    lines = _lines(model / "images.txt")
    while lines and not lines[0][1].strip():
        lines.pop(0)
    if any(_is_image(text) for _, text in lines[1::2]):
        return [(n, text) for n, text in lines if text.strip() and not _is_points(text)]
    return [(number, text) for number, text in lines[::2] if text.strip()]


def _is_points(line: str) -> bool:
    """Whether a line is a list of points: numbers, three a point (x y id)."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(float(word) is not None for word in words)
    except ValueError:
        return False


def _is_image(line: str) -> bool:
    """Whether a line is an image: ten words, the last of which is no number as the point's would be."""
    words = line.split(None, 9)
    if len(words) < 10:
        return False
    try:
        int(words[0]), int(words[8])
        norm = sum(float(word) ** 2 for word in words[1:5])
    except ValueError:
        return False
    return abs(norm - 1) < 1e-2 and not _is_points(line)


def _lines(file: Path) -> list[tuple[int, str]]:
    """(number, text) of every line that is not a comment; names may hold any character but a line end."""
    if file.name == "images.txt":  # names may be in any encoding
        data = file.read_bytes() if file.is_file() else b""
        text = data.removeprefix(b"\xef\xbb\xbf").decode("utf-8", "surrogateescape").split("\n")
    else:
        text = read_text(file, "scene file").split("\n")
    return [(i + 1, line.rstrip("\r")) for i, line in enumerate(text) if not line.startswith("#")]


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
        poses += [pose for _, *pose in _images_bin(file)]
    except UserError:
        raise
    except (struct.error, ValueError) as error:
        raise UserError(f"{file}: damaged or truncated COLMAP file ({error}).") from None
    return cameras, poses


def _images_bin(file: Path) -> Iterator[tuple[int, str, int, np.ndarray, np.ndarray]]:
    """(number, name, camera, quaternion w x y z, translation) of every image of an images.bin."""
    data, at = file.read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        image, *numbers, camera_id = struct.unpack_from("<I4d3di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8", "surrogateescape")
        points = struct.unpack_from("<Q", data, end + 1)[0]
        at = end + 9 + 24 * points
        yield image, name, camera_id, np.array(numbers[:4]), np.array(numbers[4:])
