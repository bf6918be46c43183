"""A scene: posed photographs, from a folder or built in, ready for the model."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError, did_you_mean
from roge_jax.files.fields import exists, number
from roge_jax.geometry.cameras import (
    Cameras,
    CameraWarning,
    crop_resize,
    crop_resize_K,
    to_host,
    validate,
)
from roge_jax.geometry.validation import Finding
from roge_jax.scenes.assemble import pose_frame
from roge_jax.scenes.frames import Reading
from roge_jax.scenes.images import Photos
from roge_jax.scenes.points import Points, depth_of
from roge_jax.scenes.readers import read_scene, transforms_of

__all__ = [
    "Scene",
    "cameras_at",
    "distinct_views",
    "load_scene",
    "open_scene",
    "prepare",
    "select_context",
    "view_gaps",
]


@dataclasses.dataclass(frozen=True)
class Scene:
    """Posed photos. Cameras are float64 NumPy, OpenCV camera-to-world, K in pixels of its photo.

    images: a sequence of float32 RGB [h, w, 3] in [0, 1], decoded on access when they are files;
      sizes may differ. depths: z-depth [h, w] per view in the scene's unit where it is known, NaN
      where it is not. notes: what reading changed, assumed or left out, as findings. axes: the convention the poses were
      read in where the layout leaves it open. cloud: what reads the sparse points that lie beside the poses; `points`
      are these, in the scene's frame and unit.
    """

    images: Sequence[np.ndarray]
    cameras: Cameras
    names: tuple[str, ...]
    source: str
    depths: Sequence[np.ndarray] | None = None
    notes: tuple[Finding, ...] = ()
    axes: str = ""
    cloud: Callable[[], Points] | None = None

    def __len__(self) -> int:
        return len(self.names)

    @functools.cached_property
    def points(self) -> Points | None:
        """The sparse points, read on first use; None where there are none, or (with a warning) none that can be read."""
        try:
            return None if self.cloud is None else self.cloud()
        except (UserError, OSError) as error:
            told = f"the sparse points are not used: {error}"
            warnings.warn(told, CameraWarning, stacklevel=2)
            return None

    def depth(self, view: int) -> float | None:
        """The median distance along its axis of the points that a view sees; None where too few are known."""
        if self.points is None:
            return None
        return depth_of(self.points, to_host(self.cameras), view, self.sizes[view])

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(height, width) of every photo, without decoding files."""
        if isinstance(self.images, Photos):
            return self.images.sizes
        return [(image.shape[0], image.shape[1]) for image in self.images]


def load_scene(spec: str | Path, **options: Any) -> Scene:
    """A scene whose cameras have passed `validate`.

    Args:
      spec: a folder or file in one of the layouts of `scenes.readers`; "motorcycle" (a real stereo
        pair that ships with scikit-image); "procedural:SEED" (rendered).
      options: see `open_scene`.
    Raises: UserError naming the file, the view and the field.
    """
    scene = open_scene(spec, **options)
    for note in scene.notes:
        if note.severity == "warning":
            warnings.warn(str(note), CameraWarning, stacklevel=2)
    heights, widths = zip(*scene.sizes, strict=True)
    try:
        cameras = validate(scene.cameras, heights, widths, scene.names, read_as=scene.axes)
    except UserError as error:
        raise UserError(f"{scene.source}: {error}") from None
    return dataclasses.replace(scene, cameras=cameras)


def open_scene(
    spec: str | Path,
    *,
    convention: str | None = None,
    exif: str = "auto",
    background: float = 1.0,
    camera: int = 0,
    frames: int = 32,
    height: int = 192,
    width: int = 336,
    supersample: int = 2,
) -> Scene:
    """A scene as it is, its cameras unchecked (`check` uses this to report all that is wrong).

    Args:
      convention: axes of the poses of a `transforms.json` if they are not OpenGL (of TUM, KITTI and npz: not OpenCV).
      exif: "auto" turns photos upright as their EXIF tag says (poses and K too, if K is plainly for
        the stored grid), "ignore" takes the stored grid.
      background: what transparent pixels show, 1 is white.
      camera: which of Virtual KITTI 2's two cameras.
      frames: of procedural scenes, as are the next three.
      height: of the rendered views.
      width: likewise.
      supersample: rays per pixel and side.
    """
    name = str(spec)
    if name == "motorcycle":
        return _motorcycle()
    if name.startswith("procedural:"):
        return _procedural(name, frames, height, width, supersample)
    if exif not in ("auto", "ignore"):
        raise UserError(f"exif='{exif}': {did_you_mean(exif, ('auto', 'ignore'))}")
    if not 0 <= background <= 1:
        raise UserError(f"background={background}: give a grey from 0 (black) to 1 (white).")
    if not name or (not exists(Path(spec)) and "/" not in name and "." not in name):
        hint = did_you_mean(name, ("motorcycle", "procedural:SEED"))
        raise UserError(f"There is no scene '{name}', neither a folder nor built in: {hint}")
    found = read_scene(Path(spec), convention=convention, camera=camera)
    return _assemble(found, name, exif, background)


def is_nerfstudio(source: str) -> bool:
    """Whether a scene was read from a `transforms.json`, the only layout whose axes have to be believed."""
    return transforms_of(Path(source))


def _assemble(reading: Reading, source: str, exif: str, background: float) -> Scene:
    """A reading as a scene. Pixels are not decoded yet."""
    notes: dict[str, Finding] = {}
    posed = [pose_frame(f, source, exif=exif, background=background) for f in reading.frames]
    for note in (note for one in posed for note in one.notes):
        notes.setdefault(note.what, note)
    cameras = Cameras(np.stack([one.K for one in posed]), np.stack([one.c2w for one in posed]))
    photos = Photos([one.photo for one in posed if one.photo is not None])
    addresses = [frame.address() for frame in reading.frames]
    names = _names(addresses, [f.file for f in reading.frames])
    told = [dataclasses.replace(note, where=source) for note in reading.notes]
    everything = (*told, *notes.values())
    cloud = None if reading.points is None else functools.partial(reading.points, addresses)
    return Scene(photos, cameras, names, source, notes=everything, axes=reading.axes, cloud=cloud)


def _names(addresses: list[str], files: list[Path | None]) -> tuple[str, ...]:
    """The files' own names, or where these are not unique those relative to the folder of the photos."""
    short = [file.name if file else name for name, file in zip(addresses, files, strict=True)]
    if len(set(short)) == len(short):
        return tuple(short)
    return tuple(addresses)


def find_view(scene: Scene, word: str) -> int | None:
    """The view that a user means by a name: the scene's own, or the end of one while that is unique.

    `000.png` for `cam1/000.png` where no other camera has one, `images/000.png` for `000.png`; None if there is none.
    Raises: UserError with the candidates where there are several.
    """
    plain = word.replace("\\", "/").removeprefix("./")
    for spelling in (word, plain):
        if spelling in scene.names:
            return scene.names.index(spelling)
    files = (
        [photo.file.as_posix() for photo in scene.images.photos]
        if isinstance(scene.images, Photos)
        else []
    )
    for names in (scene.names, files):
        ends = [i for i, name in enumerate(names) if f"/{name}".endswith(f"/{plain}")]
        if len(ends) == 1:
            return ends[0]
        if ends:
            some = ", ".join(scene.names[i] for i in ends[:4])
            raise UserError(
                f"{scene.source}: '{word}' could be {len(ends)} photos: give the longer name, of {some}."
            )
    return None


def _motorcycle() -> Scene:
    """Middlebury 2014 "Motorcycle", quarter size: two photos 193.001 mm apart, world in metres.

    Calibration from scikit-image's documentation. Middlebury counts pixel centres as whole numbers
    at full size, so the principal point moves by (0.5 px) / 4. The right camera's principal point
    lies 31.086 px further right; z-depth = focal * baseline / (disparity + 31.086).
    """
    from skimage import data

    left, right, disparity = data.stereo_motorcycle()
    focal, cx, cy, dx, baseline = 994.978, 311.193, 254.877, 31.086, 0.193001
    K = np.array([[focal, 0.0, cx + 0.125], [0.0, focal, cy + 0.125], [0.0, 0.0, 1.0]])
    second = K.copy()
    second[0, 2] += dx
    c2w = np.tile(np.eye(4), (2, 1, 1))
    c2w[1, 0, 3] = baseline
    disparity = np.where(np.isfinite(disparity), disparity, np.nan).astype(np.float64)
    depth = (focal * baseline / (disparity + dx)).astype(np.float32)
    images = [np.asarray(image, np.float32) / np.float32(255) for image in (left, right)]
    unknown = np.full_like(depth, np.nan)
    cameras = Cameras(np.stack([K, second]), c2w)
    return Scene(images, cameras, ("left", "right"), "motorcycle", depths=[depth, unknown])


def procedural_seed(name: str) -> int:
    """The seed of "procedural:SEED"."""
    digits = name.removeprefix("procedural:")
    if not digits.removeprefix("-").isdecimal():
        raise UserError(f"'{name}': the seed must be a whole number, e.g. procedural:7.")
    return int(digits)


def _procedural(name: str, frames: int, height: int, width: int, supersample: int) -> Scene:
    from roge_jax.procedural import scenes as procedural

    seed = procedural_seed(name)
    made = procedural.sample_sequence(
        seed, frames=frames, height=height, width=width, supersample=supersample
    )
    images = [np.asarray(image, np.float32) / np.float32(255) for image in np.asarray(made["rgb"])]
    names = tuple(f"{i:04d}" for i in range(len(images)))
    cameras = to_host(Cameras(made["K"], made["c2w"]))
    return Scene(images, cameras, names, name, depths=list(np.asarray(made["depth"])))


def cameras_at(scene: Scene, height: int, width: int) -> Cameras:
    """The cameras of all views as `prepare` returns them, without reading a photo."""
    sizes = zip(scene.cameras.K, scene.sizes, strict=True)
    K = [crop_resize_K(K, size, (height, width)) for K, size in sizes]
    return Cameras(np.stack(K), scene.cameras.c2w)


def prepare(
    scene: Scene,
    ids: Sequence[int],
    height: int,
    width: int,
    *,
    drop_duplicates: bool = True,
) -> tuple[np.ndarray, Cameras]:
    """Views of a scene at one size: images float32 [k, height, width, 3], cameras with K to match.

    Every photo fills the picture and is cropped at the centre; K moves along. A view given twice
    (same pose and pixels) is kept once, with a CameraWarning.
    Raises: UserError for views that do not exist, and for photos whose aspect ratios differ by more
      than a factor of two (one crop would show what the other lacks).
    """
    ids = [number(i, scene.source, "view", whole=True) for i in ids]
    if not len(scene.images) == len(scene.cameras) == len(scene):
        raise UserError(
            f"{scene.source}: {len(scene.images)} images, {len(scene.cameras)} cameras and {len(scene)} names: "
            "give one of each per view."
        )
    for i in ids:
        if not 0 <= i < len(scene):
            raise UserError(f"{scene.source}: there is no view {i}: it has {len(scene)}, from 0.")
    if not ids:
        raise UserError(f"{scene.source}: no views were chosen: give at least one.")
    if not isinstance(scene.images, Photos):
        for i in ids:
            _check_pixels(scene.images[i], f"{scene.source}, view {i} ({scene.names[i]})")
    check_aspects(scene, ids)
    images, Ks = [], []
    for i in ids:
        image, K = crop_resize(scene.images[i], scene.cameras.K[i], height, width)
        images.append(image)
        Ks.append(K)
    pictures, cameras = np.stack(images), Cameras(np.stack(Ks), scene.cameras.c2w[ids])
    if drop_duplicates:
        kept = distinct_views(pictures, cameras)
        if len(kept) < len(ids):
            gone = [scene.names[ids[i]] for i in range(len(ids)) if i not in kept]
            message = f"{scene.source}: same pose and picture as another view: {', '.join(gone)}."
            warnings.warn(message, CameraWarning, stacklevel=2)
            pictures, cameras = pictures[kept], cameras[kept]
    return pictures, cameras


def check_aspects(scene: Scene, ids: Sequence[int]) -> None:
    """Raise UserError if photos differ so much in shape that one crop would show what the other lacks."""
    sizes = scene.sizes
    aspects = [sizes[i][1] / sizes[i][0] for i in ids]
    if max(aspects) > 2 * min(aspects):
        wide, tall = ids[int(np.argmax(aspects))], ids[int(np.argmin(aspects))]
        raise UserError(
            f"{scene.source}: photos {scene.names[wide]} and {scene.names[tall]} differ by more "
            "than a factor of two in aspect ratio: crop them alike, or choose other views."
        )


def _check_pixels(image: Any, where: str) -> None:
    """Raise UserError unless an image given as an array is [h, w, 3], uint8 or float in [0, 1]."""
    shape, dtype = getattr(image, "shape", None), np.dtype(getattr(image, "dtype", object))
    if shape is None or len(shape) != 3 or shape[-1] != 3 or 0 in shape:
        given = type(image).__name__ if shape is None else f"shape {tuple(shape)}"
        raise UserError(f"{where}: the image is given as {given}: give an RGB array [h, w, 3].")
    if dtype == np.uint8:
        return
    low, high = (float(np.min(image)), float(np.max(image))) if dtype.kind == "f" else (0.0, np.inf)
    if not (low >= -1e-3 and high <= 1.001):  # NaN fails too
        span = f" from {low:.4g} to {high:.4g}" if dtype.kind == "f" else ""
        raise UserError(
            f"{where}: the image has {dtype} values{span}: give uint8, or floats from 0 to 1."
        )


def distinct_views(images: Sequence[np.ndarray] | np.ndarray, cameras: Cameras) -> list[int]:
    """Indices of the views left when of views with equal pose, K and pixels the first is kept."""
    cameras = to_host(cameras)
    kept: list[int] = []
    for view in range(len(cameras)):
        same = (
            other
            for other in kept
            if np.array_equal(cameras.c2w[view], cameras.c2w[other])
            and np.array_equal(cameras.K[view], cameras.K[other])
            and np.array_equal(images[view], images[other])
        )
        if next(same, None) is None:
            kept.append(view)
    return kept


def view_gaps(cameras: Cameras) -> np.ndarray:
    """How different what two views see is, [v, v], for `select_context`: their distance over the largest one and their
    angle over the largest one, added in squares.
    """
    apart = np.linalg.norm(cameras.centres[:, None] - cameras.centres[None], axis=-1)
    rotations = cameras.c2w[:, :3, :3]
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    angles = np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0))
    # What is only rounding (of positions, and of arccos near 1) must not be scaled up to 1.
    limits = (1e-12 * np.abs(cameras.centres).max(), 1e-6)
    return np.sqrt(
        sum(
            (gap / gap.max()) ** 2 if gap.max() > limit else 0.0 * gap
            for gap, limit in zip((apart, angles), limits, strict=True)
        )
    )


def select_context(
    scene: Scene | Cameras, m: int, *, first: int | None = None, among: Sequence[int] | None = None
) -> list[int]:
    """m views that see as much of the scene as possible: farthest-point sampling, deterministic.

    How far apart views are says `view_gaps`, in no unit. The first view is the most central one
    unless `first` is given. `among` limits the choice. Returns indices in ascending order, except
    that `first` leads (it becomes the world frame).
    """
    cameras = to_host(scene.cameras if isinstance(scene, Scene) else scene)
    pool = list(range(len(cameras))) if among is None else [int(i) for i in among]
    for i in pool:
        if not 0 <= i < len(cameras):
            raise UserError(f"Cannot choose among view {i}: there are {len(cameras)}, from 0.")
    if not isinstance(m, int | np.integer) or not 1 <= m <= len(pool):
        raise UserError(f"Cannot choose {m} context views: the scene offers 1 to {len(pool)}.")
    if first is not None and first not in pool:
        raise UserError(f"View {first} cannot be the first context: it is not among the choices.")
    distances = view_gaps(cameras[pool])
    start = int(np.argmin(distances.sum(0))) if first is None else pool.index(first)
    picked = [start]
    while len(picked) < m:
        nearest = distances[:, picked].min(1)
        nearest[picked] = -1.0
        picked.append(int(np.argmax(nearest)))
    ids = sorted(pool[i] for i in picked)
    return ids if first is None else [first, *(i for i in ids if i != first)]
