"""The scene folder: straightened photos, transforms.json, a COLMAP model, points.ply and cameras.png."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..files.folders import plain
from ..files.video_io import to_uint8, write_png
from ..geometry.cameras import Cameras
from ..scenes.colmap import read_model
from ..scenes.images import Photo, read_header
from ..scenes.lens import Lens
from ..scenes.points import read_points3D, write_ply
from ..scenes.writers import transforms
from .photos import Shot, scene_names
from .picture import draw_cameras

KEPT_AS_THEY_ARE = (".jpg", ".jpeg", ".png")  # what every program reads
QUALITY = 95  # of JPEGs that are written anew
ROOM = 1.5  # bytes a pixel of such a JPEG, at most


def as_it_is(shot: Shot) -> bool:
    """Whether a photo's file can be copied if its lens needs no straightening: upright, opaque, read by every program."""
    header = read_header(shot.file)
    plain_mode = header.mode in ("RGB", "L") and not header.alpha
    return shot.file.suffix.lower() in KEPT_AS_THEY_ARE and header.orientation == 1 and plain_mode


def names_for(shots: Sequence[Shot]) -> list[str]:
    """The photos' names in the scene. One that is a JPEG or PNG keeps its ending, also when it is written anew."""
    keeps = (".jpg", ".png")
    endings = [s.file.suffix.lower() if s.file.suffix.lower() in keeps else ".jpg" for s in shots]
    return scene_names([shot.file for shot in shots], endings)


def write_scene(
    folder: Path,
    work: Path,
    shots: Sequence[Shot],
    names: Sequence[str],
    found: dict[str, Any],
    progress: Callable[[str, int, int], None],
) -> None:
    """Everything of the scene but pose.json into `folder`; `work` has the model that `mapper` made."""
    (folder / "images").mkdir()
    done, total = 0, len(found["registered"])
    for camera in found["cameras"].values():
        for i in camera["photos"]:
            write_photo(folder / "images" / names[i], shots[i], camera)
            done += 1
            progress("photos", done, total)
    shutil.copytree(work / "model", folder / "sparse" / "0")
    model = read_model(folder / "sparse" / "0")
    order = [name for name, _, _ in model]
    cameras = Cameras(np.stack([c[0] for _, c, _ in model]), np.stack([p for _, _, p in model]))
    points = read_points3D(folder / "sparse" / "0", order)
    write_transforms(folder, order, cameras, [camera[1] for _, camera, _ in model])
    write_ply(folder / "points.ply", points)
    walk = np.argsort([names.index(name) for name in order])
    write_png(folder / "cameras.png", draw_cameras(cameras[walk], points.xyz, points.rgb))


def write_photo(place: Path, shot: Shot, camera: dict[str, Any]) -> None:
    """One photo upright and straightened; its own bytes where nothing has to be done."""
    from PIL import Image

    lens = None if camera["lens"] is None else Lens("opencv", tuple(camera["lens"]))
    if lens is None and as_it_is(shot):
        shutil.copyfile(shot.file, place)
        return
    size = tuple(camera["new_size"])
    K, new_K = np.array(camera["K"]), np.array(camera["new_K"])
    photo = Photo(shot.file, size, lens=lens, K=K, new_K=new_K, straight=size)
    more: dict[str, Any] = {} if place.suffix == ".png" else {"quality": QUALITY, "subsampling": 0}
    Image.fromarray(to_uint8(photo.read())).save(place, **more)


def write_transforms(
    folder: Path, names: Sequence[str], cameras: Cameras, sizes: Sequence[tuple[int, int]]
) -> None:
    """transforms.json in nerfstudio's form, with each photo's own size and where the points are."""
    content = transforms(names, cameras, *sizes[0], folder="images")
    for frame, (height, width) in zip(content["frames"], sizes, strict=True):
        frame |= {"w": width, "h": height}
    content["ply_file_path"] = "points.ply"
    text = json.dumps(plain(content), indent=1, allow_nan=False)
    (folder / "transforms.json").write_text(text + "\n", encoding="utf-8")


def room_for(shots: Sequence[Shot], copies: int, pairs: int) -> float:
    """Bytes that a run needs: small pictures of `copies` pixels each, features, matches, and the scene's photos."""
    written = sum(max(ROOM * s.size[0] * s.size[1], s.file.stat().st_size) for s in shots)
    return written + len(shots) * (copies + 8192 * 160) + pairs * 16e3
