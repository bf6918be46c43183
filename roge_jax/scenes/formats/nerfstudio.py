"""`transforms.json` and its relatives: nerfstudio, instant-ngp, Blender, DL3DV, SEVA, ScanNet++, pixelSplat / LVSM."""

from pathlib import Path
from typing import Any

from roge_jax.errors import UserError
from roge_jax.files.fields import is_file, matrix, number, read_json
from roge_jax.geometry.cameras import invert
from roge_jax.scenes import entries
from roge_jax.scenes.frames import Frame, Reading, in_axes
from roge_jax.scenes.images import read_header
from roge_jax.scenes.pictures import Finder, masks_beside
from roge_jax.scenes.points import read_ply

BLENDER = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
# Where ScanNet++ keeps its files, the undistorted ones first, and the folder that its names are relative to.
SCANNETPP = (
    ("dslr/nerfstudio/transforms_undistorted.json", "resized_undistorted_images"),
    ("dslr/nerfstudio/transforms.json", "resized_images"),
    ("iphone/nerfstudio/transforms.json", "rgb"),
)
KNOWN = {"file_path", "transform_matrix", "mask_path", "depth_file_path", "is_bad", "colmap_im_id"}


def transforms_files(folder: Path) -> list[Path]:
    """The files of this family that make up a scene folder: one, the splits of a Blender scene, or none."""
    if is_file(folder / "transforms.json"):
        return [folder / "transforms.json"]
    splits = [folder / name for name in BLENDER if is_file(folder / name)]
    if splits:
        return splits
    for name, _ in SCANNETPP:
        for place in (folder / name, folder / name.removeprefix("dslr/")):
            if is_file(place):
                return [place]
    if is_file(folder / "nerfstudio" / "transforms_undistorted.json"):
        return [folder / "nerfstudio" / "transforms_undistorted.json"]
    return []


def read(files: list[Path], *, convention: str | None, photos: bool) -> Reading:
    """Files of one scene: OpenGL camera-to-world unless `convention` says otherwise.

    Photos are matched by the name in `file_path` (`pictures.Finder`); `photos` False takes frames that name none.
    """
    whole = Reading(files[0] if len(files) == 1 else files[0].parent, [])
    for file in files:
        content = read_json(file, "scene file")
        part = from_content(content, file, convention=convention, photos=photos)
        whole.frames += part.frames
        whole.missing += part.missing
        whole.notes += part.notes
        whole.dropped += part.dropped
        whole.fps, whole.looked, whole.axes = part.fps, part.looked, part.axes
        whole.points = whole.points or part.points
    return whole


def from_content(content: Any, file: Path, *, convention: str | None, photos: bool) -> Reading:
    """One file's content, as `read`."""
    listed = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(listed, list) or not listed:
        raise UserError(f"{file}: has no frames: 'frames' must be a list with one entry per photo.")
    more = content.get("test_frames")
    listed = listed + more if isinstance(more, list) else listed
    ours = content.get("roge_jax")
    if not photos and isinstance(ours, dict):  # a video's own: the photos follow its frames
        listed = listed[
            : number(
                ours.get("path_frames", len(listed)), str(file), "path_frames", low=1, whole=True
            )
        ]
    axes = content.get("convention") or convention or "opengl"
    check_convention(axes, file)
    reading = Reading(file, [], axes=axes, fps=rate(content, file))
    finder = _finder(file)
    bad = masks = 0
    for i, entry in enumerate(listed):
        where = f"{file}, frame {i}"
        if not isinstance(entry, dict):
            raise UserError(
                f"{where}: is no object with 'file_path' and 'transform_matrix': give one."
            )
        name = entry.get("file_path")
        if not isinstance(name, str) and (photos or name is not None):
            raise UserError(f"{where}: has no 'file_path': name the photo.")
        where = f"{where} ({name})" if name else where
        picture = finder.find(name) if name else None
        if entry.get("is_bad"):
            bad += 1
            reading.dropped += [picture] if picture else []
            continue
        masks += bool(entry.get("mask_path"))
        pose = entries.pose(entry.get("transform_matrix"), f"{where}: 'transform_matrix'")
        if picture is None and name is not None:
            reading.missing.append(name)
            if photos:
                continue
        size_of = (lambda p=picture: read_header(p).displayed) if picture else None
        K, size, lens = entries.camera(entry, content, where, picture=size_of)
        if K is None and photos:
            raise UserError(
                f"{where}: no focal length: give 'fl_x' (pixels) or 'camera_angle_x' (radians)."
            )
        reading.frames.append(
            Frame(picture, K, in_axes(pose, axes), size, lens, name=_address(name))
        )
    reading.looked = f"'{reading.missing[0]}' in {file.parent}" if reading.missing else ""
    cloud = content.get("ply_file_path") if isinstance(content, dict) else None
    if isinstance(cloud, str) and is_file(file.parent / cloud):
        reading.points = lambda _: read_ply(file.parent / cloud)
    if bad:
        reading.note(
            f"{bad} of {len(listed)} frames are marked 'is_bad' and left out",
            "remove the mark to use them",
        )
    if masks:
        note_masks(reading, masks)
    return reading


def note_masks(reading: Reading, count: int) -> None:
    """One policy for masks of any tool: they are counted, not used."""
    reading.note(
        f"{count} masks lie there and are not used, the model sees what they hide",
        "paint it out, or leave those photos out with --context",
    )


def note_masks_beside(reading: Reading) -> None:
    """Masks in the folders where tools put them, unless the frames named theirs."""
    if any("masks" in note.what for note in reading.notes):
        return
    folders = {frame.file.parent for frame in reading.frames if frame.file}
    count = max((masks_beside(folder) for folder in folders), default=0)
    if count:
        note_masks(reading, count)


def _finder(file: Path) -> Finder:
    folders = [file.parent]
    for name, pictures in SCANNETPP:
        if file.as_posix().endswith(name.partition("/")[2]):
            folders.append(file.parent.parent / pictures)
    if file.parent.name in ("nerfstudio", "gaussian_splat") and len(folders) == 1:
        folders.append(file.parent.parent)
    return Finder(file.parent if len(folders) == 1 else file.parent.parent, folders)


def _address(name: str | None) -> str:
    return "" if not name else name.replace("\\", "/").lstrip("./")


def check_convention(convention: Any, file: Path) -> None:
    """Raise UserError unless a file's word for its axes is known."""
    from roge_jax.errors import did_you_mean
    from roge_jax.geometry.cameras import CONVENTIONS

    if convention not in CONVENTIONS:
        given = f"convention '{convention}'" if convention else "no 'convention'"
        hint = did_you_mean(str(convention), CONVENTIONS)
        raise UserError(f"{file}: {given}, so its axes are unknown: {hint}")


def rate(content: dict, file: Path) -> float | None:
    """Frames per second, if a file says."""
    value = content.get("fps")
    if value is None:
        return None
    found = number(value, str(file), "fps", low=0)
    if not 1e-3 <= found <= 1000:
        raise UserError(f"{file}: 'fps' is {found:g}: give frames per second, 0.001 to 1000.")
    return float(found)


def is_lvsm(content: Any) -> bool:
    """Whether a file's content is pixelSplat's or LVSM's."""
    frames = content.get("frames") if isinstance(content, dict) else None
    return (
        bool(frames)
        and isinstance(frames, list)
        and isinstance(frames[0], dict)
        and "w2c" in frames[0]
    )


def read_lvsm(content: dict, file: Path) -> Reading:
    """pixelSplat / LVSM metadata: frames with `image_path`, `fxfycxcy` (pixels) and `w2c`."""
    reading = Reading(file, [])
    folder = file.parent.parent / "images" / file.stem
    finder = Finder(folder if folder.is_dir() else file.parent, [folder, file.parent])
    for i, entry in enumerate(content["frames"]):
        where = f"{file}, frame {i}"
        if not isinstance(entry, dict):
            raise UserError(f"{where}: is no object with 'image_path', 'fxfycxcy' and 'w2c'.")
        for field in ("fxfycxcy", "w2c"):
            if field not in entry:
                raise UserError(f"{where}: has no '{field}'.")
        name = str(entry.get("image_path", f"{i:05d}.png"))
        last = name.replace("\\", "/").rpartition("/")[2]
        picture = finder.find(last) or finder.find(name)
        if picture is None:
            reading.missing.append(last)
        K = entries.intrinsics(*matrix(entry["fxfycxcy"], (4,), where, "fxfycxcy"))
        c2w = invert(entries.pose(entry["w2c"], f"{where}: 'w2c'"))
        reading.frames.append(
            Frame(picture, K, c2w, name=last, cure="correct 'fxfycxcy', or do not crop the photo")
        )
    reading.looked = f"{folder / reading.missing[0]}" if reading.missing else ""
    return reading
