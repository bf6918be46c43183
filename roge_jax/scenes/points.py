"""The sparse points of a scene: COLMAP's points3D and PLY files, read and written, and how far away they are.

Points are in the frame and unit of the poses they lie beside.
"""

import dataclasses
import struct
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.fields import read_text
from roge_jax.geometry.cameras import Cameras
from roge_jax.geometry.rays import project
from roge_jax.scenes.colmap import image_names

LEAST = 20  # points that a view must see to say how far away the scene is
PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


@dataclasses.dataclass(frozen=True)
class Points:
    """xyz [p, 3] float64, rgb [p, 3] uint8 or None. seen: of every view the points that it sees, None if nobody knows;
    pixels: of every view where it sees them [s, 2], edges at 0. error: mean distance in pixels of their images [p]."""

    xyz: np.ndarray
    rgb: np.ndarray | None = None
    seen: Sequence[np.ndarray] | None = None
    pixels: Sequence[np.ndarray] | None = None
    error: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.xyz)


Source = Callable[[Sequence[str]], Points]  # of the addresses of a scene's photos


def depth_of(points: Points, cameras: Cameras, view: int, size: tuple[int, int]) -> float | None:
    """The median depth of the points that a view sees; None if there are fewer than LEAST.

    Which ones it sees COLMAP's files say; of others all count that lie in its picture of `size` (height, width).
    """
    pose, xyz = cameras.c2w[view], points.xyz
    if points.seen is not None:
        xyz = xyz[points.seen[view]]
    elif len(xyz):
        pixels, _, front = project(cameras.K[view], pose, xyz)
        inside = (pixels >= 0).all(-1) & (pixels <= np.array([[size[1], size[0]]])).all(-1)
        xyz = xyz[front & inside]
    depths = (xyz - pose[None, :3, 3]) @ pose[:3, 2]
    depths = depths[depths > 0]
    return float(np.median(depths)) if len(depths) >= LEAST else None


# COLMAP


def points_file(model: Path) -> Path | None:
    """Where a COLMAP model has its points, in the form that its images have; None if it has none."""
    ending = "bin" if (model / "images.bin").is_file() else "txt"
    file = model / f"points3D.{ending}"
    return file if file.is_file() else None


def read_points3D(model: Path, addresses: Sequence[str]) -> Points:
    """The points of a COLMAP model, and which of them the photos called `addresses` see."""
    file = points_file(model)
    assert file is not None
    names = image_names(model)
    view_of = {name: view for view, name in enumerate(addresses)}
    views = {image: view_of[name] for image, name in names.items() if name in view_of}
    xyz, rgb, point, image = [], [], [], []
    for i, (place, colour, track) in enumerate(
        _binary(file) if file.suffix == ".bin" else _text(file)
    ):
        xyz.append(place)
        rgb.append(colour)
        point += [i] * len(track)
        image += track
    # One pass over all observations, sorted by view.
    view = np.array([views.get(number, -1) for number in image], int)
    order = np.argsort(view, kind="stable")
    edges = np.searchsorted(view[order], np.arange(len(addresses) + 1))
    by_view = np.array(point, int)[order]
    seen = [np.unique(by_view[a:b]) for a, b in pairwise(edges)]
    return Points(
        np.array(xyz, np.float64).reshape(-1, 3), np.array(rgb, np.uint8).reshape(-1, 3), seen
    )


def _binary(file: Path) -> Iterator[tuple[Any, Any, list[int]]]:
    data, at = file.read_bytes(), 8
    try:
        for _ in range(struct.unpack_from("<Q", data)[0]):
            *numbers, _, length = struct.unpack_from("<3d3BdQ", data, at + 8)
            track = np.frombuffer(data, "<u4", 2 * length, at + 51)
            yield numbers[:3], numbers[3:], track[::2].tolist()
            at += 51 + 8 * length
    except (struct.error, ValueError) as error:
        raise UserError(f"{file}: damaged or truncated COLMAP file ({error}).") from None


def _text(file: Path) -> Iterator[tuple[Any, Any, list[int]]]:
    for number, line in enumerate(read_text(file, "points").splitlines(), 1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        try:
            place, colour = [float(w) for w in words[1:4]], [int(w) for w in words[4:7]]
            track = [int(w) for w in words[8::2]]
        except ValueError:
            place = []
        if len(place) != 3 or len(colour) != 3:
            raise UserError(
                f"{file}, line {number}: expected 'id X Y Z R G B error (image point) ..'."
            )
        yield place, colour, track


# PLY


def read_ply(file: Path) -> Points:
    """The vertices of a PLY file, text or binary. Raises: UserError if it has none or is damaged."""
    data = file.read_bytes()
    end = data.find(b"end_header")
    head = data[: max(end, 0)].decode("ascii", "replace").split("\n")
    words = [line.split() for line in head]
    kind = next((w[1] for w in words if w[:1] == ["format"] and len(w) > 1), "")
    elements = [w for w in words if w[:1] == ["element"]]
    if end < 0 or not elements or elements[0][1:2] != ["vertex"]:
        raise UserError(f"{file}: is no PLY file of points: write it again.")
    first, count = words.index(elements[0]), int(elements[0][2])
    after = next((i for i, w in enumerate(words) if i > first and w[:1] == ["element"]), len(words))
    fields = [w for w in words[first:after] if w[:1] == ["property"]]
    order = ">" if kind == "binary_big_endian" else "<"
    try:
        layout = np.dtype([(w[2], order + PLY_TYPES[w[1]]) for w in fields])
        body = data.index(b"\n", end) + 1
        if kind == "ascii":
            rows = data[body:].decode("ascii").split("\n")[:count]
            table = np.array([tuple(float(x) for x in row.split()) for row in rows])
            columns = {name: table[:, i] for i, name in enumerate(layout.names or ())}
        else:
            table = np.frombuffer(data, layout, count, body)
            columns = {name: table[name] for name in layout.names or ()}
        xyz = np.stack([columns[c] for c in "xyz"], -1).astype(np.float64)
    except (KeyError, ValueError, IndexError) as error:
        raise UserError(f"{file}: damaged PLY file ({error}): write it again.") from None
    colours = [columns[c] for c in ("red", "green", "blue") if c in columns]
    return Points(xyz, np.stack(colours, -1).astype(np.uint8) if len(colours) == 3 else None)


def write_ply(file: Path, points: Points, *, about: str | None = None) -> None:
    """Points with their colours, binary, as 3D Gaussian trainers and viewers read them. about: a remark in one line."""
    fields: list[tuple[str, str]] = [(c, "<f4") for c in "xyz"]
    fields += [(c, "u1") for c in ("red", "green", "blue")]
    table = np.zeros(len(points), fields)
    for i, axis in enumerate("xyz"):
        table[axis] = points.xyz[:, i]
    for i, colour in enumerate(("red", "green", "blue")):
        table[colour] = 128 if points.rgb is None else points.rgb[:, i]
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {about.encode('ascii', 'backslashreplace').decode()}"] if about else []
    lines += [f"element vertex {len(points)}"]
    lines += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    file.write_bytes(("\n".join([*lines, "end_header"]) + "\n").encode() + table.tobytes())
