"""Which layout a place has, and the reader of it: posed photos and camera paths come through here alike.

As a scene: nerfstudio (`transforms.json`, also DL3DV, instant-ngp, SEVA, ScanNet++, Blender's splits), COLMAP in all its
folders, RealEstate10K / ACID, pixelSplat / LVSM json, CUT3R's processed folders, ScanNet's export, Virtual KITTI 2, LLFF,
TUM, KITTI odometry, FrameCrafter's npz. As a path: all of these, trajectories as text, npz or npy, and the path files of
`formats.json_paths`.
"""

import shlex
from collections.abc import Callable
from pathlib import Path

from roge_jax.errors import UserError, did_you_mean
from roge_jax.files.fields import number, read_json, read_text
from roge_jax.geometry.cameras import CONVENTIONS
from roge_jax.scenes.colmap import find_models, holds_model
from roge_jax.scenes.formats import arrays, colmap, folders, json_paths, nerfstudio, trajectories
from roge_jax.scenes.frames import Frame, Reading
from roge_jax.scenes.pictures import PHOTO_FOLDERS, is_photo, is_picture, visible

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
LAYOUTS = (
    "transforms.json (nerfstudio, DL3DV, instant-ngp, ScanNet++, Blender)",
    "sparse/0/ + images/ (COLMAP)",
    "rgb/ + cam/ (CUT3R)",
    "color/ + pose/ + intrinsic/ (ScanNet)",
    "frames/rgb/Camera_0/ + extrinsic.txt (Virtual KITTI 2)",
    "poses_bounds.npy + images/ (LLFF)",
    "rgb.txt + groundtruth.txt (TUM), image_2/ + calib.txt + poses (KITTI)",
    "scene_data.npz + inputs/ (FrameCrafter)",
    "a RealEstate10K .txt with a folder of frames",
)
INNER = ("nerfstudio", "gaussian_splat", "exported", "dslr", "colmap", "dense")
POSE = "python -m roge_jax.pose {} --out {}"


def read_frames(path: Path, *, convention: str | None = None, camera: int = 0) -> list[Frame]:
    """The posed photos of a scene folder or file, whichever layout it has.

    Args:
      convention: overrides what the layout says about its axes (one of CONVENTIONS); only where the layout leaves them
        open, as `transforms.json` does, whose poses are often written with other axes than it promises.
      camera: which camera of Virtual KITTI 2's stereo pair.
    Raises: UserError naming the file and the field.
    """
    return read_scene(path, convention=convention, camera=camera).frames


def read_scene(path: Path, *, convention: str | None = None, camera: int = 0) -> Reading:
    """`read_frames` with all that is to be said about them. Every frame has a photo.

    What the user supplied and is left out is a note with its count: photos that are missing, photos without a pose,
    masks, other models.
    """
    reading = read_place(path, convention=convention, camera=camera, photos=True)
    total = len(reading.frames)
    reading.frames = [frame for frame in reading.frames if frame.file is not None]
    total = max(total, len(reading.frames) + len(reading.missing))
    if not reading.frames:
        if not reading.missing:
            raise UserError(
                f"{path}: has cameras but no photos: give it as --trajectory, or give the scene's folder."
            )
        raise UserError(
            f"{path}: none of its {total} photos is there, looked for {reading.looked}: restore the files, or correct "
            "the names."
        )
    if reading.missing:
        reading.note(
            f"{len(reading.missing)} of {total} photos are missing and left out, first '{reading.missing[0]}'",
            f"restore the files or remove their frames (looked for {reading.looked})",
        )
    _note_unposed(reading)
    nerfstudio.note_masks_beside(reading)
    if convention is not None and not reading.axes:
        reading.note(
            f"--convention {convention} is not used",
            "this layout says itself which axes its poses have",
        )
    return reading


def _note_unposed(reading: Reading) -> None:
    """Photos beside those that are used, which no frame names."""
    used = {frame.file for frame in reading.frames} | set(reading.dropped)
    places = {frame.file.parent for frame in reading.frames if frame.file is not None}
    more = [f for place in places for f in place.iterdir() if is_photo(f) and f not in used]
    if places == {reading.source.parent if reading.source.is_file() else reading.source}:
        return  # beside everything else: not all pictures there need be photos of the scene
    if more:
        count = len(reading.frames) + len(more)
        reading.note(
            f"{len(reading.frames)} of {count} photos {reading.registered}, {len(more)} are left out, first '{more[0].name}'",
            "pose them as well (more photos in between help), or remove them",
        )


def check_word(convention: str | None) -> None:
    """Raise UserError for a convention that does not exist."""
    if convention is not None and convention not in CONVENTIONS:
        hint = did_you_mean(convention, CONVENTIONS)
        raise UserError(f"Unknown camera convention '{convention}': {hint}")


def read_place(
    path: Path,
    *,
    convention: str | None = None,
    camera: int = 0,
    photos: bool = True,
    target: tuple[int, int] | None = None,
) -> Reading:
    """What lies at `path`, a folder or a file. `photos`: it is to be a scene; else a path, of pictures of size `target`."""
    check_word(convention)
    if not path.exists():
        what = "there is no such scene folder or file"
        raise UserError(
            f"{path}: {what if photos else 'cannot read the path file (no such file)'}."
        )
    if path.is_file():
        return _read_file(path, convention=convention, photos=photos, target=target)
    found = read_folder(path, convention=convention, camera=camera, photos=photos)
    for name in INNER if found is None else ():
        if (path / name).is_dir():
            found = read_folder(path / name, convention=convention, camera=camera, photos=photos)
            if found is not None:
                return found
    inner = [f for f in visible(path, "*") if f.is_dir()] if found is None else []
    if len(inner) == 1:
        found = read_folder(inner[0], convention=convention, camera=camera, photos=photos)
    if found is None:
        raise UserError(f"{path}: {_what_folder(path)}")
    return found


def transforms_of(path: Path) -> bool:
    """Whether a scene's poses come from a `transforms.json` or its relatives, whose axes have to be believed."""
    if path.is_file():
        return path.suffix.lower() == ".json"
    if not path.is_dir():
        return False
    return any(
        nerfstudio.transforms_files(place) for place in (path, path / "nerfstudio", path / "dslr")
    )


def read_folder(
    folder: Path, *, convention: str | None, camera: int, photos: bool
) -> Reading | None:
    """The reading of a folder in a known layout; None if it has none."""
    if files := nerfstudio.transforms_files(folder):
        return nerfstudio.read(files, convention=convention, photos=photos)
    if (found := colmap.read(folder)) is not None:
        return found
    if (file := folders.metadata_of(folder)) is not None:
        return folders.read_metadata(file)
    if (cameras := folders.cut3r_cameras(folder)) is not None:
        return folders.read_cut3r(folder, cameras)
    if (file := folders.scannet_intrinsics(folder)) is not None:
        return folders.read_scannet(folder, file)
    if (folder / "frames" / "rgb").is_dir():
        return folders.read_vkitti(folder, camera)
    if (folder / "poses_bounds.npy").is_file():
        return folders.read_llff(folder / "poses_bounds.npy")
    if (pair := trajectories.tum_files(folder)) is not None:
        return trajectories.read_tum_folder(folder, pair, convention=convention)
    if (triple := trajectories.kitti_files(folder)) is not None:
        return trajectories.read_kitti(folder, triple, convention=convention)
    if (file := folders.framecrafter_file(folder)) is not None:
        return arrays.read_npz(file, convention=convention)
    texts = [file for file in visible(folder, "*.txt") if _readable_kind(file) == 19]
    if len(texts) == 1:
        return trajectories.read_re10k(texts[0])
    return None


def _readable_kind(file: Path) -> int:
    try:
        return trajectories.kind_of(file)
    except UserError:
        return 0


def _read_file(
    file: Path, *, convention: str | None, photos: bool, target: tuple[int, int] | None
) -> Reading:
    """A single file as a scene or path, by its ending and content."""
    ending = file.suffix.lower()
    if (
        ending in (".txt", ".bin")
        and file.stem in ("images", "cameras")
        and holds_model(file.parent)
    ):
        found = colmap.read(file.parent)
        assert found is not None
        return found
    readers: dict[str, Callable[[], Reading]] = {
        ".npz": lambda: arrays.read_npz(file, convention=convention),
        ".npy": lambda: (
            folders.read_llff(file)
            if file.name == "poses_bounds.npy"
            else arrays.read_npy(file, convention=convention)
        ),
    }
    if ending in readers:
        if file.name.endswith("scene_metadata.npz"):
            return folders.read_metadata(file)
        return readers[ending]()
    if what := _binary(file):
        raise UserError(f"{file}: {what}")
    if ending in (".txt", ".tum", ".kitti", ".csv") or (
        ending != ".json" and not read_text(file, "scene file").lstrip().startswith(("{", "["))
    ):
        return _read_text_file(file, convention)
    content = read_json(file, "scene file" if photos else "path file")
    if nerfstudio.is_lvsm(content):
        return nerfstudio.read_lvsm(content, file)
    listed = content.get("frames") if isinstance(content, dict) else None
    first = listed[0] if isinstance(listed, list) and listed else None
    if isinstance(first, dict) and "transform_matrix" in first and "pose" not in first:
        return nerfstudio.from_content(content, file, convention=convention, photos=photos)
    if not photos:
        return json_paths.read(content, file, convention=convention, target=target)
    if isinstance(content, dict) and ({"camera_path", "keyframes", "convention"} & set(content)):
        raise UserError(
            f"{file}: is a camera path, it has no photos: give it as --trajectory, and the scene's folder as --scene."
        )
    return nerfstudio.from_content(content, file, convention=convention, photos=photos)


def _read_text_file(file: Path, convention: str | None) -> Reading:
    width = trajectories.kind_of(file)
    if width == 19:
        return trajectories.read_re10k(file)
    if width == 8:
        return trajectories.read_tum(file, convention=convention)
    if width in (12, 16):
        return trajectories.read_matrices(file, width, convention=convention)
    raise UserError(
        f"{file}: holds no poses that are known: lines have 19 numbers in RealEstate10K's files, 8 in TUM's, 12 in "
        f"KITTI's, 16 for 4x4 matrices, not these. Scenes are {'; '.join(LAYOUTS)}; paths are {json_paths.READ}."
    )


def _binary(file: Path) -> str:
    """What a file is that is no text, and what to do; "" for text."""
    ending = file.suffix.lower()
    if is_picture(file):
        return f"is one photo; a scene is a folder of them with poses, which {pose_command(file.parent)} finds."
    if ending in VIDEOS:
        return f"is a video, a scene has photos with poses: {pose_command(file)} makes one of it."
    with file.open("rb") as stream:
        start = stream.read(4096)
    if ending in (".torch", ".pt", ".pth", ".ckpt"):
        return "is a PyTorch file: `python -m roge_jax.data.pack` makes training data of pixelSplat's chunks, and a scene needs frames and a RealEstate10K .txt."
    if start.startswith(b"PK\x03\x04") or ending in (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar"):
        return "is an archive: unpack it and give the folder."
    if b"\0" in start or start.startswith((b"\xff\xd8", b"\x89PNG", b"II*", b"MM")):
        return f"is a binary file of no known kind: a scene is a folder, {'; '.join(LAYOUTS)}."
    return ""


def pose_command(place: Path) -> str:
    """What finds the poses of a folder of photos or of a video, as a shell takes it."""
    scene = place.resolve().with_suffix("") if place.is_file() else place.resolve()
    scene = scene.parent if scene.name in PHOTO_FOLDERS and len(scene.parts) > 2 else scene
    return POSE.format(shlex.quote(str(place)), shlex.quote(f"{scene.name}_scene"))


def _what_folder(folder: Path) -> str:
    """What lies in a folder that is no scene, and what to do."""
    needs = f"has one of {'; '.join(LAYOUTS)}"
    here = [f for f in visible(folder, "*") if is_photo(f)]
    below = [f for f in visible(folder, "*/*") if is_photo(f)]
    if here or below:
        where = folder if here else below[0].parent
        photos = sum(f.parent == where for f in (here or below))
        one = "1 photo" if photos == 1 else f"{photos} photos"
        beside = "" if where == folder else f" in {where}"
        above = folder.resolve().parent
        if transforms_of(above) or find_models(above):
            return f"{one} without poses, which lie beside this folder: give {above}."
        return f"{one} without poses{beside}: {pose_command(where)} finds them. A scene with poses {needs}."
    if videos := [f for f in visible(folder, "*") if f.suffix.lower() in VIDEOS]:
        return f"no photos in this folder, but a video: {pose_command(videos[0])} makes a scene of it. A scene {needs}."
    return f"no known layout in this folder: a scene {needs}."


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
