"""Trajectories as text: RealEstate10K / ACID, TUM, KITTI; as scenes where photos lie beside them."""

import re
from pathlib import Path

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.fields import is_file, read_text
from roge_jax.geometry.cameras import invert, rotation
from roge_jax.scenes import entries
from roge_jax.scenes.frames import NORMALISED, Frame, Reading, in_axes
from roge_jax.scenes.pictures import PICTURES, Finder, is_picture, pictures, visible

SCENE = "scene file"
WIDTHS = {19: "RealEstate10K", 8: "TUM", 12: "KITTI", 16: "4x4 matrices"}
CLOSE = 0.02  # seconds between a photo and its pose in TUM's files, as its own tools take them
# fx fy cx cy of TUM's three cameras, as its page publishes them (whole-numbered pixel centres).
FREIBURG = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
}
TUM_SIZE = (480, 640)


def rows_of(file: Path) -> list[tuple[int, list[str]]]:
    """(number, words) of the lines that are neither empty nor comments."""
    lines = read_text(file, SCENE).splitlines()
    return [(i, re.split(r"[\s,]+", s)) for i, line in enumerate(lines, 1) if (s := line.strip()) and s[0] != "#"]  # fmt: skip


def kind_of(file: Path) -> int:
    """How many words the rows of a text have, by most of them: 19, 8, 12 or 16; 0 for anything else."""
    counts = [len(words) for _, words in rows_of(file)]
    best = max(set(counts), key=counts.count, default=0)
    return best if best in WIDTHS else 0


def _table(file: Path, width: int, *, header: bool = False) -> tuple[list[str], np.ndarray]:
    """(first words, all numbers [n, width]) of a text file whose rows have so many words."""
    names, table = [], []
    for row, (number, words) in enumerate(rows_of(file)):
        if len(words) != width:
            if header and row == 0:
                continue  # the address of the video
            raise UserError(f"{file}, line {number}: has {len(words)} numbers, expected {width}.")
        try:
            table.append([float(word) for word in words])
        except ValueError:
            if header and row == 0:
                continue
            raise UserError(f"{file}, line {number}: not all of it is numbers.") from None
        names.append(words[0])
    if not table:
        raise UserError(f"{file}: has no poses, expected lines of {width} numbers.")
    return names, np.array(table)


def read_re10k(file: Path) -> Reading:
    """RealEstate10K / ACID: a line `timestamp fx fy cx cy 0 0 r11 .. t3` per frame, after the URL.

    Intrinsics are normalised by width and height, the 3x4 matrix is world-to-camera. Pictures are `<timestamp>.png`
    (or .jpg; zeros in front do not matter) in a folder named like the file, in `frames/`, or beside the file.
    """
    candidates = [file.with_suffix(""), file.parent / "frames" / file.stem, file.parent / "frames"]
    candidates += [file.parent.parent / "frames" / file.stem, file.parent]
    padded: dict[int, Path] = {}
    for folder in reversed([f for f in candidates if f.is_dir()]):
        padded |= {int(p.stem): p for p in folder.iterdir() if is_picture(p) and p.stem.isdecimal()}
    reading = Reading(file, [])
    times, numbers = _table(file, 19, header=True)
    if (np.abs(numbers[:, 1:5]) > 20).any():
        raise UserError(
            f"{file}: its intrinsics are in pixels, RealEstate10K's are divided by width and height: divide fx and cx "
            "by the width, fy and cy by the height."
        )
    for time, row in zip(times, numbers, strict=True):
        places = (folder / f"{time}{ending}" for folder in candidates for ending in PICTURES)
        picture = next((place for place in places if is_file(place)), None)
        picture = picture or padded.get(int(row[0]))
        if picture is None:
            reading.missing.append(time)
        w2c = np.vstack([row[7:].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        K = entries.intrinsics(*row[1:5])
        name = picture.name if picture else time
        cure = "its fx, fy, cx, cy must be divided by width and height"
        reading.frames.append(Frame(picture, K, invert(w2c), NORMALISED, name=name, cure=cure))
    if reading.missing:
        there = ", ".join(dict.fromkeys(str(folder) for folder in candidates if folder.is_dir()))
        reading.looked = f"{reading.missing[0]}.png (or .jpg) in {there}"
    return reading


def read_tum(file: Path, *, convention: str | None = None) -> Reading:
    """A TUM trajectory: `timestamp tx ty tz qx qy qz qw`, camera to world, OpenCV axes unless told otherwise."""
    axes = convention or "opencv"
    _, table = _table(file, 8)
    reading = Reading(file, [], axes=axes)
    for row in table:
        reading.frames.append(Frame(None, None, in_axes(_tum_pose(row, file), axes)))
    return reading


def _tum_pose(row: np.ndarray, file: Path) -> np.ndarray:
    length = np.linalg.norm(row[4:])
    if not 0.5 < length < 2:
        raise UserError(
            f"{file}: the quaternion at time {row[0]:g} has length {length:.3g}, not 1: a row is "
            "'timestamp tx ty tz qx qy qz qw'."
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(row[4:] / length), row[1:4]
    return pose


def read_matrices(file: Path, width: int, *, convention: str | None = None) -> Reading:
    """KITTI's poses, 12 numbers a line (3x4 by rows), or 16 (4x4): camera to world, OpenCV axes unless told otherwise."""
    axes = convention or "opencv"
    _, table = _table(file, width)
    reading = Reading(file, [], axes=axes)
    for row in table:
        reading.frames.append(Frame(None, None, in_axes(entries.pose(row, str(file)), axes)))
    return reading


def tum_files(folder: Path) -> tuple[Path, Path] | None:
    """(rgb.txt, groundtruth.txt) of a folder of the TUM benchmark."""
    files = folder / "rgb.txt", folder / "groundtruth.txt"
    return files if all(is_file(file) for file in files) else None


def read_tum_folder(folder: Path, files: tuple[Path, Path], *, convention: str | None) -> Reading:
    """TUM's benchmark: the photos of rgb.txt with the poses of groundtruth.txt nearest in time, within 20 ms."""
    axes = convention or "opencv"
    listed, poses = rows_of(files[0]), _table(files[1], 8)[1]
    poses = poses[np.argsort(poses[:, 0])]
    K, size = _tum_intrinsics(folder)
    finder, reading = Finder(folder), Reading(folder, [], axes=axes)
    late = 0
    for number, words in listed:
        if len(words) < 2:
            raise UserError(f"{files[0]}, line {number}: expected 'timestamp filename'.")
        name = " ".join(words[1:])
        try:
            gaps = np.abs(poses[:, 0] - float(words[0]))
        except ValueError:
            raise UserError(f"{files[0]}, line {number}: '{words[0]}' is no time.") from None
        picture, nearest = finder.find(name), int(np.argmin(gaps))
        if gaps[nearest] > CLOSE:
            late += 1
            reading.dropped += [picture] if picture else []
            continue
        if picture is None:
            reading.missing.append(name)
        c2w = in_axes(_tum_pose(poses[nearest], files[1]), axes)
        reading.frames.append(Frame(picture, K, c2w, size, name=name))
    if late:
        reading.note(
            f"{late} of {len(listed)} photos are left out, no pose lies within {CLOSE * 1000:.0f} ms of them",
            f"correct the times in {files[0].name} or {files[1].name}",
        )
    if not reading.frames:
        raise UserError(
            f"{folder}: no photo of rgb.txt has a pose in groundtruth.txt within 20 ms."
        )
    reading.looked = f"'{reading.missing[0]}' in {folder}" if reading.missing else ""
    return reading


def _tum_intrinsics(folder: Path) -> tuple[np.ndarray, tuple[int, int] | None]:
    for name in ("calibration.txt", "camera.txt", "intrinsics.txt", "K.txt", "calib.txt"):
        if is_file(folder / name):
            words = [word for _, row in rows_of(folder / name) for word in row]
            try:
                numbers = [float(word) for word in words]
            except ValueError:
                numbers = []
            if len(numbers) == 9:
                return np.array(numbers).reshape(3, 3), None
            if len(numbers) >= 4:
                return entries.intrinsics(*numbers[:4]), None
            raise UserError(f"{folder / name}: expected 'fx fy cx cy' or a 3x3 matrix, in pixels.")
    found = re.search(r"freiburg([123])", folder.name)
    if found is None:
        raise UserError(
            f"{folder}: TUM's folders do not say the intrinsics: write 'fx fy cx cy' (pixels) into "
            f"{folder / 'calibration.txt'}."
        )
    fx, fy, cx, cy = FREIBURG[found.group(1)]
    return entries.intrinsics(fx, fy, cx + 0.5, cy + 0.5), TUM_SIZE


def kitti_files(folder: Path) -> tuple[Path, Path, str] | None:
    """(poses, photos, calibration key) of a sequence of KITTI's odometry benchmark."""
    if not is_file(folder / "calib.txt"):
        return None
    number = folder.name
    places = [
        folder / "poses.txt",
        folder / f"{number}.txt",
        folder.parent / "poses" / f"{number}.txt",
    ]
    places += [folder.parent.parent / "poses" / f"{number}.txt"]
    poses = next((place for place in places if is_file(place)), None)
    photos = next((f for i in "2031" if (f := folder / f"image_{i}").is_dir()), None)
    return None if poses is None or photos is None else (poses, photos, f"P{photos.name[-1]}")


def read_kitti(folder: Path, files: tuple[Path, Path, str], *, convention: str | None) -> Reading:
    """KITTI odometry: poses of the first camera, `calib.txt` with P = K [I | t] of the one whose photos are read."""
    poses, place, key = files
    found = {w[0].rstrip(":"): w[1:] for _, w in rows_of(folder / "calib.txt")}
    try:
        P = np.array([float(word) for word in found[key]]).reshape(3, 4)
    except (KeyError, ValueError):
        raise UserError(f"{folder / 'calib.txt'}: has no '{key}:' with 12 numbers.") from None
    offset = np.eye(4)
    offset[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
    path = read_matrices(poses, 12, convention=convention)
    photos = pictures(place)
    reading = Reading(folder, [], axes=path.axes)
    for i, frame in enumerate(path.frames):
        picture = photos[i] if i < len(photos) else None
        if picture is None:
            reading.missing.append(f"{i:06d}.png")
        name = picture.name if picture else f"{i:06d}.png"
        reading.frames.append(Frame(picture, P[:, :3] / P[2, 2], frame.c2w @ offset, name=name))
    reading.looked = f"'{reading.missing[0]}' in {place}" if reading.missing else ""
    others = [f.name for f in visible(folder, "image_*") if f.is_dir() and f != place]
    if others:
        reading.note(
            f"{place.name} is read, {', '.join(others)} is not",
            "remove the folder that is not meant",
            "note",
        )
    return reading
