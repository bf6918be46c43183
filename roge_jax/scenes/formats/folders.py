"""Folders of data sets: CUT3R's, ScanNet, Virtual KITTI 2, LLFF, FrameCrafter."""

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.fields import is_file, matrix, read_text
from roge_jax.geometry.cameras import invert
from roge_jax.scenes import entries
from roge_jax.scenes.frames import Frame, Reading
from roge_jax.scenes.pictures import Finder, is_photo, pictures, visible, with_ending

SCENE = "scene file"
PHOTO_PLACES = ("rgb", "color", "images", "vga_wide", "image")


def load_npz(file: Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file. Raises UserError if it is damaged or holds objects."""
    try:
        with file.open("rb") as stream, zipfile.ZipFile(stream):  # np.load also takes other files
            content = np.load(file)
        with content:
            return {name: content[name] for name in content.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{file}: damaged npz file ({error}): copy it again.") from None


def cut3r_cameras(folder: Path) -> tuple[list[Path], str, Path] | None:
    """(camera files, what follows a photo's name in theirs, folder of the photos) of CUT3R's processed data."""
    for place in (folder, folder / "dense"):
        if (place / "cam").is_dir():
            for name in PHOTO_PLACES:
                if (place / name).is_dir():
                    return visible(place / "cam", "*.npz"), "", place / name
    if files := visible(folder, "*_cam.npz"):
        return files, "_cam", folder
    if (folder / "images").is_dir() and (files := visible(folder / "images", "*.npz")):
        return files, "", folder / "images"
    return None


def read_cut3r(folder: Path, cameras: tuple[list[Path], str, Path]) -> Reading:
    """`rgb/NAME.png` (or color/, images/) with `cam/NAME.npz`, `NAME_rgb.jpg` with `NAME_cam.npz`, `images/NAME.npz`.

    The npz holds K, 3x3 or 4x4, under one of three names (they differ between data sets) and `pose`, a
    camera-to-world with OpenCV axes.
    """
    files, ending, photos = cameras
    reading, finder = Reading(folder, []), Finder(photos)
    for file in files:
        stem = file.stem.removesuffix(ending) + ("_rgb" if ending else "")
        picture = with_ending(photos / f"{stem}") or finder.find(stem)
        if picture is None:
            reading.missing.append(stem)
        fields = load_npz(file)
        K = next(
            (fields[n] for n in ("intrinsics", "intrinsic", "camera_intrinsics") if n in fields),
            None,
        )
        pose = next((fields[n] for n in ("pose", "camera_pose") if n in fields), None)
        if K is None or pose is None:
            raise UserError(
                f"{file}: needs 'intrinsics' and 'pose', has {', '.join(fields) or 'nothing'}."
            )
        reading.frames.append(
            Frame(picture, _square(K, str(file)), entries.pose(pose, f"{file}: 'pose'"), name=stem)
        )
    if not reading.frames:
        raise UserError(f"{folder}: there are no cameras: need cam/NAME.npz for rgb/NAME.png.")
    reading.looked = f"{photos / reading.missing[0]}" if reading.missing else ""
    return reading


def _square(K: Any, where: str) -> np.ndarray:
    """K [3, 3] of a 3x3 or 4x4 matrix, or of fx, fy, cx, cy."""
    if np.shape(K) == (4, 4):
        return matrix(K, (4, 4), where, "intrinsics")[:3, :3]
    if np.shape(K) == (4,):
        return entries.intrinsics(*matrix(K, (4,), where, "intrinsics"))
    return matrix(K, (3, 3), where, "intrinsics")


def metadata_of(folder: Path) -> Path | None:
    """DUSt3R's and CUT3R's one file of cameras for a scene, if it lies there."""
    return next(
        (folder / f"{new}scene_metadata.npz" for new in ("", "new_") if is_file(folder / f"{new}scene_metadata.npz")),
        None,
    )  # fmt: skip


def read_metadata(file: Path) -> Reading:
    """`scene_metadata.npz`: `images` (names), `trajectories` (c2w) and `intrinsics` (3x3, or ARKit's w h fx fy cx cy)."""
    fields = load_npz(file)
    lacks = [name for name in ("images", "trajectories", "intrinsics") if name not in fields]
    if lacks:
        raise UserError(f"{file}: has no '{lacks[0]}': needs images, trajectories and intrinsics.")
    folder = file.parent
    finder = Finder(folder, [f for name in PHOTO_PLACES if (f := folder / name).is_dir()])
    reading = Reading(folder, [])
    rows = zip(fields["images"], fields["trajectories"], fields["intrinsics"], strict=True)
    for name, pose, K in rows:
        size = None
        if np.shape(K) == (6,):
            size = (int(K[1]), int(K[0]))
            K = K[2:]
        picture = finder.find(str(name))
        if picture is None:
            reading.missing.append(str(name))
        where = f"{file}, '{name}'"
        c2w = entries.pose(pose, f"{where}: 'trajectories'")
        reading.frames.append(Frame(picture, _square(K, where), c2w, size, name=str(name)))
    reading.looked = f"'{reading.missing[0]}' in {folder}" if reading.missing else ""
    return reading


def scannet_intrinsics(folder: Path) -> Path | None:
    """The file of K of a ScanNet folder, if it is one."""
    if not ((folder / "color").is_dir() and (folder / "pose").is_dir()):
        return None
    names = (
        "intrinsic/intrinsic_color.txt",
        "intrinsic_color.txt",
        "intrinsics_color.txt",
        "intrinsics.txt",
    )
    return next((folder / n for n in names if is_file(folder / n)), folder / names[0])


def read_scannet(folder: Path, file: Path) -> Reading:
    """ScanNet's export: `color/I.jpg`, `pose/I.txt` (c2w), `intrinsic/intrinsic_color.txt`.

    Frames that the tracker lost (-inf in the pose) are left out, with a note.
    """
    numbers = read_numbers(file, (16, 9))
    side = 4 if numbers.size == 16 else 3
    K = numbers.reshape(side, side)[:3, :3]
    reading = Reading(folder, [])
    photos = pictures(folder / "color")
    lost = unposed = 0
    for picture in photos:
        place = folder / "pose" / f"{picture.stem}.txt"
        if not place.is_file():
            unposed += 1
            continue
        pose = read_numbers(place, (16,)).reshape(4, 4)
        if np.isfinite(pose).all():
            reading.frames.append(Frame(picture, K, pose, name=picture.name))
        else:
            lost += 1
            reading.dropped.append(picture)
    if not reading.frames:
        raise UserError(f"{folder}: no frame in color/ has a usable pose.")
    if lost:
        reading.note(
            f"{lost} of {len(photos)} frames are left out, the tracker lost them (-inf in pose/)",
            "give them a pose, or remove them",
        )
    return reading


def read_vkitti(folder: Path, camera: int = 0) -> Reading:
    """One variant of Virtual KITTI 2 (`Scene01/clone`), in metres; `camera` 0 or 1 of the pair.

    extrinsic.txt: `frame cameraID` and a 4x4 world-to-camera; intrinsic.txt: `frame cameraID fx fy
    cx cy`; both with a header line, rows of the two cameras interleaved.
    """
    poses = dict(_vkitti_rows(folder / "extrinsic.txt", camera, 16))
    intrinsics = dict(_vkitti_rows(folder / "intrinsic.txt", camera, 4))
    place = folder / "frames" / "rgb" / f"Camera_{camera}"
    if not place.is_dir():
        raise UserError(f"{place}: there is no such folder.")
    reading = Reading(folder, [])
    for picture in pictures(place):
        digits = picture.stem.removeprefix("rgb_")
        if not digits.isdecimal():
            raise UserError(f"{picture}: is not named rgb_NUMBER: move it out of this folder.")
        index = int(digits)
        if index not in poses or index not in intrinsics:
            raise UserError(f"{picture}: frame {index} of camera {camera} has no row of numbers.")
        K = entries.intrinsics(*intrinsics[index])
        reading.frames.append(
            Frame(picture, K, invert(poses[index].reshape(4, 4)), name=picture.name)
        )
    if not reading.frames:
        raise UserError(f"{folder}: no pictures of Camera_{camera} in frames/rgb.")
    others = [f for f in visible(place.parent, "Camera_*") if f.is_dir() and f != place]
    if others:
        reading.note(
            f"camera {camera} is read, {', '.join(o.name for o in others)} is not",
            "in Python load_scene(folder, camera=1) reads the other",
            "note",
        )
    return reading


def _vkitti_rows(file: Path, camera: int, count: int) -> Iterator[tuple[int, np.ndarray]]:
    for line_number, line in enumerate(read_text(file, SCENE).splitlines()[1:], 2):
        words = line.split()
        if words and len(words) != 2 + count:
            raise UserError(
                f"{file}, line {line_number}: has {len(words)} numbers, not {2 + count}."
            )
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            raise UserError(f"{file}, line {line_number}: not all of it is numbers.") from None
        if words and numbers[1] == camera:
            yield int(numbers[0]), np.array(numbers[2:])


def read_numbers(file: Path, counts: tuple[int, ...]) -> np.ndarray:
    """All numbers of a text file, as many as one of `counts`."""
    text = read_text(file, SCENE)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        raise UserError(f"{file}: not all of it is numbers.") from None
    if numbers.size not in counts:
        raise UserError(f"{file}: has {numbers.size} numbers, expected {counts[0]}.")
    return numbers


def read_llff(file: Path) -> Reading:
    """LLFF's `poses_bounds.npy`: a row of 17 a photo, 3x5 [R t (height, width, focal)], then near and far depth.

    Columns of R are down, right, backward; photos are those of `images/` (or `images_4` ..) in order of their names.
    """
    try:
        rows = np.load(file)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{file}: damaged npy file ({error}): copy it again.") from None
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise UserError(f"{file}: has shape {rows.shape}: LLFF's is photos x 17.")
    folder = file.parent
    places = [folder / "images", *visible(folder, "images_*"), folder]
    photos: list[Path] = []
    for place in places:
        found = (
            sorted((f for f in place.iterdir() if is_photo(f)), key=lambda f: f.name)
            if place.is_dir()
            else []
        )
        if len(found) == len(rows) or not photos:
            photos = found
        if len(found) == len(rows):
            break
    if photos and len(photos) != len(rows):
        raise UserError(
            f"{file}: has {len(rows)} poses for {len(photos)} photos in {photos[0].parent}: they belong together by "
            "their order, so give as many of one as of the other."
        )
    reading = Reading(folder, [])
    for i, row in enumerate(np.asarray(rows, np.float64)):
        R, t, (height, width, focal) = row[:15].reshape(3, 5)[:, :3], row[:15].reshape(3, 5)[:, 3], row[:15].reshape(3, 5)[:, 4]  # fmt: skip
        c2w = np.eye(4)
        c2w[:3, :3] = np.stack([R[:, 1], R[:, 0], -R[:, 2]], -1)  # right, down, forward
        c2w[:3, 3] = t
        picture = photos[i] if photos else None
        if picture is None:
            reading.missing.append(f"photo {i}")
        K = entries.intrinsics(focal, focal, width / 2, height / 2)
        size = (round(height), round(width))
        name = picture.name if picture else ""
        reading.frames.append(
            Frame(picture, K, c2w, size, name=name, cure="correct poses_bounds.npy")
        )
    reading.looked = f"photos in {folder / 'images'}" if reading.missing else ""
    return reading


def framecrafter_file(folder: Path) -> Path | None:
    """FrameCrafter's npz of a folder, if there is one."""
    if is_file(folder / "scene_data.npz"):
        return folder / "scene_data.npz"
    files = visible(folder, "*.npz")
    if len(files) == 1 and (folder / "inputs").is_dir():
        return files[0]
    return None
