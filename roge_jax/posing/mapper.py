"""Features, matches and poses by pycolmap, in a process of its own: `python -m roge_jax.posing.mapper FOLDER`.

FOLDER has job.json (`Job`) and copies/ with the small pictures; it gets model/ (a COLMAP model of the straightened photos
in the new world) and found.json. Progress goes to stdout as JSON lines. COLMAP is native code that writes to the terminal,
may abort the process and waits for ever on a full disc: here none of it reaches the program that was called. The process
ends with the one that started it, whose end of stdin closes.
"""

import dataclasses
import json
import os
import sys
import threading
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..files.folders import write_json
from . import models, pairs
from .photos import NO_PRIOR

BATCH = 8  # pictures, or 64 times as many pairs, between two lines of progress
FEATURES, FEATURES_OF_MANY, MANY = 8192, 4096, 30  # a photo has at most
PEAK = 0.004  # contrast of a feature; COLMAP's 0.0067 finds too few in dark and soft photos
UPSCALED = 1000  # pixels of the long side below which features are looked for at twice the size
LEAST_MATCHES = 15  # of a pair, after geometry has spoken; COLMAP's own number
DRIFT = 0.15  # of a focal length away from EXIF's: then it was not seen in the photos
WORSE = 1.15  # times the reprojection error that EXIF's focal length may cost
LENS = "SIMPLE_RADIAL"  # one coefficient: what phones and cameras leave of their distortion


@dataclasses.dataclass(frozen=True)
class Job:
    """What is asked for; lists have one entry per photo, in the order of the walk.

    copies: (height, width) of the pictures in copies/; full: of the photos. cameras: numbers, equal for photos of one
    lens. focals: in pixels of the copy, None where nothing says it. names: in the new scene.
    """

    copies: list[tuple[int, int]]
    full: list[tuple[int, int]]
    cameras: list[int]
    focals: list[float | None]
    names: list[str]
    way: str
    thorough: bool = False
    seed: int = 0
    threads: int = 1

    def copy(self, i: int) -> str:
        """The file of a photo's copy."""
        return copy_name(i)


def copy_name(i: int) -> str:
    """The name of the small picture of photo i."""
    return f"{i:06d}.jpg"


def say(stage: str, done: int, total: int) -> None:
    """One line of progress for the program that is waiting."""
    print(json.dumps({"stage": stage, "done": done, "total": total}), flush=True)


class Work:
    """The database and the mappers of one job."""

    def __init__(self, folder: Path, job: Job):
        import pycolmap

        pycolmap.logging.minloglevel = 2
        pycolmap.set_random_seed(job.seed)
        self.colmap, self.folder, self.job = pycolmap, folder, job
        self.database, self.pictures = folder / "database.db", folder / "copies"
        self.ids: list[int] = []  # COLMAP's number of each photo

    # Features and matches

    def features(self) -> list[int]:
        """SIFT features of all copies into the database; how many each has."""
        colmap, job = self.colmap, self.job
        options = colmap.FeatureExtractionOptions()
        options.num_threads = job.threads
        sift = options.sift
        sift.max_num_features = FEATURES if len(job.copies) <= MANY else FEATURES_OF_MANY
        sift.peak_threshold = PEAK
        sift.first_octave = -1 if max(max(size) for size in job.copies) < UPSCALED else 0
        sift.estimate_affine_shape = sift.domain_size_pooling = job.thorough
        groups: dict[int, list[int]] = {}
        for i, camera in enumerate(job.cameras):
            groups.setdefault(camera, []).append(i)
        with self._open() as database:
            numbers = {c: database.write_camera(self._camera(g)) for c, g in groups.items()}
        done = 0
        for camera, group in groups.items():
            reader = colmap.ImageReaderOptions()
            reader.existing_camera_id = numbers[camera]
            for batch in _batches(group, BATCH):
                names = [job.copy(i) for i in batch]
                colmap.extract_features(
                    self.database,
                    self.pictures,
                    names,
                    colmap.CameraMode.AUTO,
                    reader,
                    options,
                    colmap.Device.cpu,
                )
                done += len(batch)
                say("features", done, len(job.copies))
        with self._open() as database:
            known = {image.name: image.image_id for image in database.read_all_images()}
            self.ids = [known[job.copy(i)] for i in range(len(job.copies))]
            return [database.num_keypoints_for_image(i) for i in self.ids]

    def _camera(self, group: Sequence[int]) -> Any:
        """The camera that photos share, as it is before anything is known of it but EXIF's focal length."""
        height, width = self.job.copies[group[0]]
        focal = self.job.focals[group[0]]
        prior = focal or NO_PRIOR * max(height, width)
        # A second coefficient bends the first small models of long lenses beyond repair.
        camera = self.colmap.Camera.create_from_model_name(0, LENS, prior, width, height)
        camera.has_prior_focal_length = focal is not None
        return camera

    def match(self) -> int:
        """Matches of the chosen pairs into the database; how many pairs were tried."""
        colmap, job = self.colmap, self.job

        def alike() -> np.ndarray:
            with self._open() as database:
                found = [np.asarray(database.read_descriptors(i).data) for i in self.ids]
            return pairs.likeness(found, job.seed)

        chosen = pairs.choose_pairs(len(self.ids), job.way, alike)
        options = colmap.FeatureMatchingOptions()
        options.num_threads = job.threads
        geometry = colmap.TwoViewGeometryOptions()
        geometry.ransac.random_seed = job.seed
        pairing, done = colmap.ImportedPairingOptions(), 0
        pairing.match_list_path = self.folder / "pairs.txt"
        for batch in _batches(chosen, 8 * BATCH):
            lines = [f"{job.copy(i)} {job.copy(j)}\n" for i, j in batch]
            Path(pairing.match_list_path).write_text("".join(lines), encoding="utf-8")
            colmap.match_image_pairs(self.database, options, pairing, geometry, colmap.Device.cpu)
            done += len(batch)
            say("matches", done, len(chosen))
        return len(chosen)

    def verified(self) -> list[tuple[int, int, Any]]:
        """(photo, photo, two-view geometry) of the pairs whose matches agree with some motion."""
        at = {image: i for i, image in enumerate(self.ids)}
        with self._open() as database:
            found = zip(*database.read_two_view_geometries(), strict=True)
        pair_of = self.colmap.pair_id_to_image_pair
        return [
            (at[a], at[b], geometry)
            for number, geometry in found
            for a, b in [pair_of(number)]
            if len(geometry.inlier_matches) >= LEAST_MATCHES
        ]

    def _open(self) -> Any:
        return self.colmap.Database.open(str(self.database))

    # Poses

    def incremental(self, start: Path | None = None, *, hold_focal: bool = False) -> list[Any]:
        """COLMAP's incremental mapper, more patient than its defaults; `start` is a model to continue."""
        options = self.colmap.IncrementalPipelineOptions()
        options.num_threads = self.job.threads
        options.random_seed = options.mapper.random_seed = self.job.seed
        options.triangulation.random_seed = self.job.seed
        options.min_model_size = min(3, len(self.ids))
        options.multiple_models = start is None
        options.mapper.abs_pose_min_num_inliers = LEAST_MATCHES
        options.mapper.init_min_num_inliers = 50
        options.mapper.init_min_tri_angle = 8.0
        options.mapper.max_reg_trials = 10
        options.ba_refine_focal_length = not hold_focal
        options.mapper.abs_pose_refine_focal_length = not hold_focal
        out = self._new("incremental")
        found = self.colmap.incremental_mapping(
            self.database, self.pictures, out, options, "" if start is None else start
        )
        return list(found.values())

    def global_(self) -> list[Any]:
        """COLMAP's global mapper (GLOMAP), which finds all poses at once."""
        options = self.colmap.GlobalPipelineOptions()
        options.num_threads = self.job.threads
        options.random_seed = options.mapper.random_seed = self.job.seed
        self.colmap.calibrate_view_graph(self.database)
        found = self.colmap.global_mapping(
            self.database, self.pictures, self._new("global"), options
        )
        return list(found.values())

    def _new(self, name: str) -> Path:
        count = len(list(self.folder.glob(f"{name}*")))
        folder = self.folder / f"{name}{count}"
        folder.mkdir()
        return folder

    def save(self, model: Any) -> Path:
        """A model in a folder, to be continued."""
        folder = self._new("start")
        model.write(folder)
        return folder


def solve(work: Work) -> tuple[Any, dict[str, Any]]:
    """(the best model or None, what is to be said about it).

    The incremental mapper first; where it leaves photos out the global one, which joins what hangs together by few
    matches, but may place parts wrongly. Of any model counts the largest part whose photos hang together by points and
    whose matches fit the poses (`models.hanging_together`). The incremental mapper then adds what it can.
    """
    geometries = work.verified()
    best, how, sizes = None, "", []
    say("poses", 0, len(work.ids))
    for name, mapper in (("incremental", work.incremental), ("global", work.global_)):
        if best is not None and best.num_reg_images() == len(work.ids):
            break
        found = [models.hanging_together(m, work.ids, geometries) for m in mapper()]
        sizes += [[name, m.num_reg_images()] for m in found]
        better = max(found, key=_worth, default=None)
        if better is not None and 1 < better.num_reg_images() < len(work.ids):
            more = work.incremental(work.save(better))
            found = [models.hanging_together(m, work.ids, geometries) for m in more]
            better = max([better, *found], key=_worth)
        if better is not None and better.num_reg_images() > 1 and _worth(better) > _worth(best):
            best, how = better, name
        say("poses", 0 if best is None else best.num_reg_images(), len(work.ids))
    held = _drifted(work, best)
    if held and best is not None:
        found = [
            models.hanging_together(m, work.ids, geometries)
            for m in work.incremental(hold_focal=True)
        ]
        fixed = max(found, key=_worth, default=None)
        held = fixed is not None and (
            fixed.num_reg_images() >= best.num_reg_images()
            and fixed.compute_mean_reprojection_error()
            <= WORSE * best.compute_mean_reprojection_error()
        )
        best = fixed if held else best
    return best, {"mapper": how, "models": sizes, "focal_held": held}


def _worth(model: Any) -> tuple[int, int]:
    return (0, 0) if model is None else (model.num_reg_images(), model.compute_num_observations())


def _drifted(work: Work, model: Any) -> bool:
    """Whether a camera's focal length ended far from EXIF's, as it does over flat ground seen from straight above."""
    if model is None:
        return False
    for i, image in enumerate(work.ids):
        prior = work.job.focals[i]
        if prior is None or not model.exists_image(image) or not model.image(image).has_pose:
            continue
        if abs(np.log(model.image(image).camera.mean_focal_length() / prior)) > np.log(1 + DRIFT):
            return True
    return False


def run(folder: Path) -> None:
    """The whole job."""
    work = Work(folder, Job(**json.loads((folder / "job.json").read_text(encoding="utf-8"))))
    features = work.features()
    tried = work.match()
    geometries = work.verified()
    partners = Counter(i for a, b, _ in geometries for i in (a, b))
    sides = [max(size) for size in work.job.copies]
    found: dict[str, Any] = {
        "features": features,
        "pairs_tried": tried,
        "pairs_matched": len(geometries),
        "partners": [partners[i] for i in range(len(features))],
        "matches": float(np.median([len(g.inlier_matches) for _, _, g in geometries] or [0])),
        "turned_only": models.turned_only(geometries, sides),
        "groups": models.groups(len(features), [(a, b) for a, b, _ in geometries]),
    }
    best, more = solve(work) if geometries else (None, {})
    found |= more
    if best is not None:
        found |= models.describe(best, work.ids)
        straight = models.finish(best, work.ids, work.job)
        (folder / "model").mkdir()
        best.write(folder / "model")
        found["cameras"] = straight
    write_json(folder / "found.json", found)


def _batches(items: Sequence[Any], size: int) -> Iterable[Sequence[Any]]:
    return (items[i : i + size] for i in range(0, len(items), size))


def _end_with_parent() -> None:
    while os.read(0, 64):  # not through a buffer, whose lock the end of the process would need
        pass
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    run(Path(sys.argv[1]))
