"""The photos that a run is given: which views of a scene, and their pixels at the sizes that the model reads."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..config import RoGeConfig
from ..errors import UserError, did_you_mean
from ..geometry.cameras import Cameras
from ..geometry.crops import resize, scale_K
from ..scenes.coverage import see_path
from ..scenes.overlap import select_overlapping
from ..scenes.scene import Scene, distinct_views, prepare, select_context
from .whole import Whole, whole

DEFAULT_CONTEXT = 6  # photos, where the scene and the model have that many


class Photos(NamedTuple):
    """Context photos at generation size and, where it differs, at reconstruction size; cameras in the scene's frame."""

    images: np.ndarray  # [m, h, w, 3] float32 in [0, 1]
    recon: np.ndarray | None  # [m, recon_h, recon_w, 3]
    cameras: Cameras  # K in pixels of `images`
    ids: tuple[int, ...]  # views of the scene
    full: Whole | None = None  # uncut and finer, where pictures are larger than the model

    def keep(self, kept: Sequence[int]) -> "Photos":
        """Some of them."""
        kept = list(kept)
        recon = None if self.recon is None else self.recon[kept]
        full = None if self.full is None else self.full.keep(kept)
        ids = tuple(self.ids[i] for i in kept)
        return Photos(self.images[kept], recon, self.cameras[kept], ids, full)


def check_photos(photos: Photos, config: RoGeConfig) -> None:
    """Raise UserError for photos of another size than the model's."""
    wanted = (len(photos.ids), config.height, config.width, 3)
    if np.shape(photos.images) != wanted or len(photos.cameras) != wanted[0]:
        raise UserError(
            f"Photos of shape {np.shape(photos.images)} with {len(photos.cameras)} cameras for {wanted[0]} ids do not "
            f"fit a model of {config.height}x{config.width} ({config.name}): make them with sampling.read_photos."
        )


def context_ids(
    text: str | None, scene: Scene, config: RoGeConfig, path: Cameras | None = None
) -> list[int]:
    """The views that --context asks for: how many, or which by number or name; without a word, up to 6.

    Those that it leaves open are chosen for the `path` where that is known before (K in pixels of the model's size).
    """
    most = config.max_context
    if text is None:
        return _chosen(scene, min(len(scene), most, DEFAULT_CONTEXT), config, path)
    words = [word.strip() for word in text.split(",")]
    if any(words) and ("," in text or text in scene.names):
        return [_view(word, scene) for word in words if word]
    if not text.isdecimal() or not 1 <= int(text) <= min(len(scene), most):
        raise UserError(
            f"--context {text}: give 1 to {min(len(scene), most)} (the scene has {len(scene)} photos, the "
            f"model takes {most}), or photos by number or name, separated by commas."
        )
    return _chosen(scene, int(text), config, path)


def _chosen(scene: Scene, count: int, config: RoGeConfig, path: Cameras | None) -> list[int]:
    """So many photos of a scene: those that see most of the path, or that overlap; all where there are no more."""
    if path is not None and count < len(scene):
        return see_path(scene, path, count, config.height, config.width)
    if count in (1, len(scene)):
        return select_context(scene, count)
    return select_overlapping(scene, count, config.height, config.width)


def _view(word: str, scene: Scene) -> int:
    if word in scene.names:
        return scene.names.index(word)
    if word.isdecimal() and int(word) < len(scene):
        return int(word)
    if word.isdecimal():
        raise UserError(
            f"--context: there is no photo {word}: {scene.source} has {len(scene)}, from 0."
        )
    raise UserError(
        f"--context: {scene.source} has no photo '{word}': {did_you_mean(word, scene.names)}"
    )


def read_photos(scene: Scene, ids: Sequence[int], config: RoGeConfig) -> Photos:
    """The photos `ids` of a scene, the first one being the world frame. Duplicates are dropped with a warning.

    Where pictures are larger than the model (`config.output`), every photo is cut as the picture is and shrunk for the
    model, and kept whole besides.
    """
    ids = list(ids)
    size, output = (config.height, config.width), config.output_size
    images, cameras = prepare(scene, ids, *output, drop_duplicates=False)
    kept = distinct_views(images, cameras)
    if len(kept) < len(ids):
        prepare(scene, ids, *size)  # says which
    ids, images, cameras = [ids[i] for i in kept], images[kept], cameras[kept]
    if len(ids) > config.max_context:
        raise UserError(
            f"{len(ids)} context photos: this model ({config.name}) takes 1 to {config.max_context}."
        )
    recon, wanted = None, (config.recon_height, config.recon_width)
    if wanted != size and output != size:
        recon = np.stack([resize(image, *wanted) for image in images])
    elif wanted != size and wanted[0] * size[1] == wanted[1] * size[0]:  # sharper than a resize
        recon, _ = prepare(scene, ids, *wanted, drop_duplicates=False)
    if output == size:
        return Photos(images, recon, cameras, tuple(ids))
    images = np.stack([resize(image, *size) for image in images])
    cameras = Cameras(scale_K(cameras.K, output, size), cameras.c2w)
    full = whole([scene.images[i] for i in ids], output, size)
    return Photos(images, recon, cameras, tuple(ids), full)


def blank_scene(source: str, views: int, config: RoGeConfig) -> Scene:
    """Black photos of the model's size from cameras side by side: what a run costs does not depend on more."""
    w, h = config.width, config.height
    K = np.array([[w, 0.0, w / 2], [0.0, w, h / 2], [0.0, 0.0, 1.0]])
    c2w = np.tile(np.eye(4), (views, 1, 1))
    c2w[:, 0, 3] = 0.1 * np.arange(views)
    images = [np.zeros((h, w, 3), np.uint8)] * views
    names = tuple(f"{i:04d}" for i in range(views))
    return Scene(images, Cameras(np.tile(K, (views, 1, 1)), c2w), names, source)
