"""Layouts of posed photographs on disk. Each reader returns `Frame`s with OpenCV camera-to-world.

nerfstudio (`transforms.json`, also DL3DV and instant-ngp), COLMAP, RealEstate10K / ACID text files,
pixelSplat / LVSM json, CUT3R's processed folders, ScanNet's export, Virtual KITTI 2.
"""

import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from roge_jax.errors import UserError, did_you_mean
from roge_jax.files.fields import is_file, matrix, number, read_json, read_text
from roge_jax.geometry.cameras import CONVENTIONS, CameraWarning, invert, to_opencv
from roge_jax.scenes.colmap import find_model, make_camera, read_colmap
from roge_jax.scenes.images import Frame, Lens

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".hdr")
SCENE = "scene file"
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
LAYOUTS = (
    "transforms.json (nerfstudio, DL3DV)",
    "sparse/0/ + images/ (COLMAP)",
    "rgb/ + cam/ (CUT3R)",
    "color/ + pose/ + intrinsic/ (ScanNet)",
    "frames/rgb/Camera_0/ + extrinsic.txt (Virtual KITTI 2)",
    "a RealEstate10K .txt with a folder of frames",
)


def read_frames(path: Path, *, convention: str | None = None, camera: int = 0) -> list[Frame]:
    """The posed photos of a scene folder or file, whichever layout it has.

    Args:
      convention: overrides what the layout says about its axes (one of CONVENTIONS); only for
        `transforms.json`, whose poses are often written with other axes than it promises.
      camera: which camera of Virtual KITTI 2's stereo pair.
    Raises: UserError naming the file and the field.
    """
    if convention is not None and convention not in CONVENTIONS:
        hint = did_you_mean(convention, CONVENTIONS)
        raise UserError(f"Unknown camera convention '{convention}': {hint}")
    if not path.exists():
        raise UserError(f"{path}: there is no such scene folder or file.")
    if path.is_file():
        if path.suffix == ".txt":
            return read_re10k(path)
        content = read_json(path, SCENE)
        frames = content.get("frames") if isinstance(content, dict) else None
        if frames and isinstance(frames[0], dict) and "w2c" in frames[0]:
            return read_lvsm(path)
        return read_nerfstudio(path, convention=convention)
    if (path / "transforms.json").is_file():
        return read_nerfstudio(path / "transforms.json", convention=convention)
    model = find_model(path)
    if model is not None:
        folders = (path / "images", *sorted(path.glob("images_*")), path)
        images = next(folder for folder in folders if folder.is_dir())
        return read_colmap(path, model, images)
    for folder in (path, path / "dense"):
        if (folder / "rgb").is_dir() and (folder / "cam").is_dir():
            return read_cut3r(folder)
    if any(path.glob("*_cam.npz")):
        return read_cut3r(path)
    if (path / "color").is_dir() and (path / "pose").is_dir():
        return read_scannet(path)
    if (path / "frames" / "rgb").is_dir():
        return read_vkitti(path, camera)
    texts = sorted(path.glob("*.txt"))
    if len(texts) == 1:
        return read_re10k(texts[0])
    raise UserError(f"{path}: no known layout in this folder: need one of {'; '.join(LAYOUTS)}.")


def read_nerfstudio(file: Path, *, convention: str | None = None) -> list[Frame]:
    """nerfstudio's `transforms.json`: OpenGL camera-to-world, K and distortion global or per frame.

    Photos are matched by the name in `file_path`. A photo that lies in `images_2`, `images_4` or
    `images_8` instead is taken from there; K follows from the picture size.
    """
    content = read_json(file, SCENE)
    entries = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{file}: has no frames: 'frames' must be a list with one entry per photo.")
    frames, missing = [], []
    for i, entry in enumerate(entries):
        where = f"{file}, frame {i}"
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
            raise UserError(f"{where}: has no 'file_path': name the photo.")
        where = f"{where} ({entry['file_path']})"
        picture = _find_picture(file.parent, entry["file_path"])
        if picture is None:
            missing.append(entry["file_path"])
            continue
        pose = _pose(entry.get("transform_matrix"), f"{where}: 'transform_matrix'")
        K, size, lens = _nerfstudio_camera({**content, **entry}, where, picture)
        # An unusable pose goes through as it is: validation names it together with the others.
        usable = np.isfinite(pose).all() and abs(np.linalg.det(pose)) > 1e-12
        c2w = to_opencv(pose, convention or "opengl") if usable else pose
        frames.append(Frame(picture, K, c2w, size, lens))
    if missing:
        raise UserError(
            f"{file}: {len(missing)} of {len(entries)} photos are missing, first '{missing[0]}': "
            "restore the files or remove their frames."
        )
    return frames


def _nerfstudio_camera(
    fields: dict, where: str, picture: Path
) -> tuple[np.ndarray, tuple[int, int] | None, Lens | None]:
    """K, the size it is for and the lens, from a frame's fields laid over the file's."""
    size = _size(fields, where)
    model = str(fields.get("camera_model", "OPENCV")).upper()
    if fields.get("is_fisheye"):  # instant-ngp's word for it
        if model not in ("OPENCV_FISHEYE", "OPENCV"):
            raise UserError(
                f"{where}: 'is_fisheye' with camera_model {model}: give one of the two."
            )
        model = "OPENCV_FISHEYE"
    numbers = {
        name: number(fields[name], where, name)
        for name in ("fl_x", "fl_y", "cx", "cy", "camera_angle_x", *DISTORTION)
        if fields.get(name) is not None
    }
    for name in DISTORTION:
        if not np.isfinite(numbers.get(name, 0.0)):
            raise UserError(
                f"{where}: '{name}' is {numbers[name]}: give a number, or leave it out."
            )
    if "fl_x" not in numbers and "camera_angle_x" not in numbers:
        raise UserError(f"{where}: no focal length: give 'fl_x' (pixels) or 'camera_angle_x'.")
    if size is None and not {"fl_x", "cx", "cy"} <= set(numbers):
        from roge_jax.scenes.images import read_header

        size = read_header(picture).displayed
    if "fl_x" in numbers:
        fx = numbers["fl_x"]
    else:
        assert size is not None
        angle = numbers["camera_angle_x"]
        if not 0 < angle < np.pi:
            raise UserError(
                f"{where}: 'camera_angle_x' is {angle:g}: give the full horizontal angle in radians, "
                "between 0 and 3.14."
            )
        fx = 0.5 * size[1] / np.tan(0.5 * numbers["camera_angle_x"])
    fy = numbers.get("fl_y", fx)
    cx = numbers["cx"] if "cx" in numbers else 0.5 * size[1]  # type: ignore[index]
    cy = numbers["cy"] if "cy" in numbers else 0.5 * size[0]  # type: ignore[index]
    k1, k2, k3, k4, p1, p2 = (numbers.get(n, 0.0) for n in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE":
        model, rest = "OPENCV_FISHEYE", [k1, k2, k3, k4]
    elif model in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"):
        more = [name for name in ("k4", "k5", "k6") if numbers.get(name)]
        if more:
            raise UserError(
                f"{where}: {more[0]} = {numbers[more[0]]} with a {model} camera: undistort the photos first."
            )
        model, rest = "FULL_OPENCV", [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    else:
        raise UserError(
            f"{where}: camera_model {model} is not supported: need PINHOLE, OPENCV or "
            "OPENCV_FISHEYE, undistort the photos first."
        )
    height, width = size or (0, 0)
    K, _, lens = make_camera(model, np.array([fx, fy, cx, cy, *rest]), width, height, where)
    return K, size, lens


def _size(fields: dict, where: str) -> tuple[int, int] | None:
    """(height, width) that the intrinsics are for, if the file says."""
    given = [name for name in ("h", "w") if fields.get(name) is not None]
    if len(given) == 1:
        raise UserError(
            f"{where}: has '{given[0]}' alone: give both 'w' and 'h' (pixels), or neither."
        )
    if not given:
        return None
    height, width = (number(fields[name], where, name, low=1, whole=True) for name in given)
    return height, width


def _find_picture(folder: Path, name: str) -> Path | None:
    """The photo called `name` in `folder`, in its downsampled siblings, or with an ending added."""
    given = Path(name)
    if not given.name:
        return None
    places = [folder / given]
    if given.parent.name.startswith("images") or not given.parent.name:
        folders = ("images", "images_2", "images_4", "images_8")
        places += [folder / given.parent.parent / other / given.name for other in folders]
    for place in places:
        if is_file(place):
            return place
        for ending in PICTURES:  # the name may have dots of its own
            added = place.with_name(place.name + ending)
            if place.suffix.lower() not in PICTURES and is_file(added):
                return added
    for place in places[1:]:  # DL3DV: the same name as .png where the json says .jpg
        for ending in PICTURES:
            if is_file(place.with_suffix(ending)):
                return place.with_suffix(ending)
    return None


def read_re10k(file: Path) -> list[Frame]:
    """RealEstate10K / ACID: a line `timestamp fx fy cx cy 0 0 r11 .. t3` per frame, after the URL.

    Intrinsics are normalised by width and height, the 3x4 matrix is world-to-camera. Pictures are
    `<timestamp>.png` (or .jpg) in a folder named like the file, in `frames/`, or beside the file.
    """
    candidates = [file.with_suffix(""), file.parent / "frames" / file.stem, file.parent / "frames"]
    candidates += [file.parent.parent / "frames" / file.stem, file.parent]
    frames, missing = [], []
    for row, line in enumerate(read_text(file, SCENE).splitlines(), 1):
        words = line.split()
        if len(words) != 19:
            if row == 1 or not words:
                continue  # the address of the video
            raise UserError(f"{file}, line {row}: has {len(words)} numbers, expected 19.")
        try:
            numbers = np.array([float(word) for word in words[1:]])
        except ValueError:
            raise UserError(f"{file}, line {row}: not all of it is numbers.") from None
        names = [f"{words[0]}{ending}" for ending in PICTURES]
        places = (folder / name for folder in candidates for name in names)
        picture = next((place for place in places if place.is_file()), None)
        if picture is None:
            missing.append(words[0])
            continue
        fx, fy, cx, cy = numbers[:4]
        w2c = np.vstack([numbers[6:].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        frames.append(Frame(picture, K, invert(w2c), (1, 1)))
    if not frames:
        looked = ", ".join(dict.fromkeys(str(folder) for folder in candidates))
        raise UserError(f"{file}: found none of its {len(missing)} frames in {looked}.")
    if missing:
        message = f"{file}: {len(missing)} of {len(frames) + len(missing)} frames have no picture and are left out."
        warnings.warn(message, CameraWarning, stacklevel=2)
    return frames


def read_lvsm(file: Path) -> list[Frame]:
    """pixelSplat / LVSM metadata: frames with `image_path`, `fxfycxcy` (pixels) and `w2c`."""
    frames = []
    for i, entry in enumerate(read_json(file, SCENE)["frames"]):
        where = f"{file}, frame {i}"
        if not isinstance(entry, dict):
            raise UserError(f"{where}: is no object with 'image_path', 'fxfycxcy' and 'w2c'.")
        for field in ("fxfycxcy", "w2c"):
            if field not in entry:
                raise UserError(f"{where}: has no '{field}'.")
        name = Path(str(entry.get("image_path", f"{i:05d}.png")))
        folder = file.parent.parent / "images" / file.stem
        places = (folder / name.name, file.parent / name, name)
        picture = next((place for place in places if is_file(place)), None)
        if picture is None:
            raise UserError(f"{where}: photo {places[0]} is missing.")
        fx, fy, cx, cy = matrix(entry["fxfycxcy"], (4,), where, "fxfycxcy")
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        frames.append(Frame(picture, K, invert(_pose(entry["w2c"], f"{where}: 'w2c'"))))
    return frames


def read_cut3r(folder: Path) -> list[Frame]:
    """CUT3R's processed data: `rgb/NAME.png` + `cam/NAME.npz`, or `NAME_rgb.jpg` + `NAME_cam.npz`.

    The npz holds K under one of three names (they differ between data sets) and `pose`, a
    camera-to-world with OpenCV axes.
    """
    beside = not (folder / "cam").is_dir()
    cameras = folder.glob("*_cam.npz") if beside else (folder / "cam").glob("*.npz")
    frames = []
    for file in sorted(cameras, key=_by_number):
        stem = file.stem.removesuffix("_cam") + ("_rgb" if beside else "")
        parent = folder if beside else folder / "rgb"
        places = (parent / f"{stem}{ending}" for ending in PICTURES)
        picture = next((place for place in places if place.is_file()), None)
        if picture is None:
            raise UserError(f"{file}: its photo {parent / stem} is missing.")
        try:
            with (
                file.open("rb") as stream,
                zipfile.ZipFile(stream),
            ):  # np.load also takes other files
                content = np.load(file)
            with content:
                fields = {name: content[name] for name in content.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise UserError(f"{file}: damaged npz file ({error}): copy it again.") from None
        K = next(
            (fields[n] for n in ("intrinsics", "intrinsic", "camera_intrinsics") if n in fields),
            None,
        )
        pose = next((fields[n] for n in ("pose", "camera_pose") if n in fields), None)
        if K is None or pose is None:
            raise UserError(
                f"{file}: needs 'intrinsics' and 'pose', has {', '.join(fields) or 'nothing'}."
            )
        K = matrix(K, (3, 3), str(file), "intrinsics")
        frames.append(Frame(picture, K, _pose(pose, f"{file}: 'pose'")))
    if not frames:
        raise UserError(f"{folder}: there are no cameras: need cam/NAME.npz for rgb/NAME.png.")
    return frames


def read_scannet(folder: Path) -> list[Frame]:
    """ScanNet's export: `color/I.jpg`, `pose/I.txt` (c2w), `intrinsic/intrinsic_color.txt`.

    Frames that the tracker lost (-inf in the pose) are left out.
    """
    file = folder / "intrinsic" / "intrinsic_color.txt"
    K = _numbers(file, 16).reshape(4, 4)[:3, :3]
    frames = []
    for picture in _pictures(folder / "color"):
        pose = _numbers(folder / "pose" / f"{picture.stem}.txt", 16).reshape(4, 4)
        if np.isfinite(pose).all():
            frames.append(Frame(picture, K, pose))
    if not frames:
        raise UserError(f"{folder}: no frame in color/ has a usable pose.")
    return frames


def read_vkitti(folder: Path, camera: int = 0) -> list[Frame]:
    """One variant of Virtual KITTI 2 (`Scene01/clone`), in metres; `camera` 0 or 1 of the pair.

    extrinsic.txt: `frame cameraID` and a 4x4 world-to-camera; intrinsic.txt: `frame cameraID fx fy
    cx cy`; both with a header line, rows of the two cameras interleaved.
    """
    poses = dict(_vkitti_rows(folder / "extrinsic.txt", camera, 16))
    intrinsics = dict(_vkitti_rows(folder / "intrinsic.txt", camera, 4))
    frames = []
    for picture in _pictures(folder / "frames" / "rgb" / f"Camera_{camera}"):
        digits = picture.stem.removeprefix("rgb_")
        if not digits.isdecimal():
            raise UserError(f"{picture}: is not named rgb_NUMBER: move it out of this folder.")
        index = int(digits)
        if index not in poses or index not in intrinsics:
            raise UserError(f"{picture}: frame {index} of camera {camera} has no row of numbers.")
        fx, fy, cx, cy = intrinsics[index]
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        frames.append(Frame(picture, K, invert(poses[index].reshape(4, 4))))
    if not frames:
        raise UserError(f"{folder}: no pictures of Camera_{camera} in frames/rgb.")
    return frames


def read_split(folder: Path, context: int) -> tuple[list[int], list[int]]:
    """SEVA's `train_test_split_<M>.json`: (context, target) indices into the photos by name."""
    file = folder / f"train_test_split_{context}.json"
    content = read_json(file)
    if not isinstance(content, dict) or not {"train_ids", "test_ids"} <= set(content):
        raise UserError(f"{file}: needs an object with 'train_ids' and 'test_ids'.")
    found = []
    for name in ("train_ids", "test_ids"):
        if not isinstance(content[name], list):
            raise UserError(f"{file}: '{name}' is {content[name]!r}: give a list of photo numbers.")
        found.append([number(i, str(file), name, low=0, whole=True) for i in content[name]])
    return found[0], found[1]


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


def _numbers(file: Path, count: int) -> np.ndarray:
    text = read_text(file, SCENE)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        raise UserError(f"{file}: not all of it is numbers.") from None
    if numbers.size != count:
        raise UserError(f"{file}: has {numbers.size} numbers, expected {count}.")
    return numbers


def _pose(value, where: str) -> np.ndarray:
    """A 4x4 or 3x4 matrix of a file as [4, 4]."""
    try:
        pose = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
    if pose.shape != (4, 4):
        raise UserError(f"{where} must be a 4x4 matrix of numbers.")
    return pose


def _pictures(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such folder.")
    found = (file for file in folder.iterdir() if file.suffix.lower() in PICTURES)
    return sorted(found, key=_by_number)


def _by_number(file: Path) -> tuple[int, str]:
    """Names that are numbers sort as numbers (RealEstate10K's timestamps have no fixed length)."""
    digits = "".join(letter for letter in file.stem if letter.isdigit())
    return (int(digits) if digits else -1, file.name)
