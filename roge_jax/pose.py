"""Photos or a video without poses into a scene that every program here reads: `python -m roge_jax.pose`.

    python -m roge_jax.pose PHOTOS --out myscene             a folder of photos
    python -m roge_jax.pose walk.mp4 --out myscene           a video: sharp, well spread frames are taken
    python -m roge_jax.sample --scene myscene                then the video along a path

OUT gets images/ (lens distortion removed), transforms.json, points.ply, sparse/0 (a COLMAP model of images/), cameras.png
and pose.json (numbers of the run). It needs the extra `pose`: pip install 'roge_jax[pose]'. docs/howto/pose.md says what to do when it fails.
"""

import argparse
import shutil
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .errors import UserError
from .files.entry import Clock, environment, execute, number, one_of
from .files.folders import check_disk, output_folder, write_json
from .posing.pairs import WAYS

LARGEST = 1600  # pixels of the long side at which photos are matched


def parser() -> argparse.ArgumentParser:
    """The options of `python -m roge_jax.pose`."""
    p = argparse.ArgumentParser(
        prog="python -m roge_jax.pose",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("photos", help="a folder of photos, or a video")
    p.add_argument("--out", required=True, help="the new scene folder")
    p.add_argument(
        "--frames", type=number(3, 2000), help="photos taken from a video (default: by its motion)"
    )
    p.add_argument(
        "--match",
        type=one_of(WAYS),
        default="auto",
        help=f"which photos are compared, of {', '.join(WAYS)} (default: by their number)",
    )
    p.add_argument(
        "--size",
        type=number(200, 8000),
        default=LARGEST,
        help=f"long side at which photos are matched, pixels (default: {LARGEST}); the scene keeps the full size",
    )
    p.add_argument(
        "--thorough",
        action="store_true",
        help="features that also match photos from different directions; several times as long",
    )
    p.add_argument("--seed", type=number(0), default=0, help="of all random choices (default: 0)")
    p.add_argument("--debug", action="store_true", help="show where an error comes from")
    return p


def main(args: argparse.Namespace) -> None:
    """Pose the photos and write OUT."""
    from .posing import child

    version = child.check_pycolmap()
    place = Path(args.photos)
    clock = Clock()
    from .posing.photos import find_photos

    files, video = find_photos(place)
    if args.frames and video is None:
        raise UserError(f"--frames {args.frames} is for videos, {place} has photos: leave it away.")
    _check_apart(place, Path(args.out))
    with output_folder(args.out) as folder:
        work = folder / "work"
        work.mkdir()
        if video is not None:
            with clock("frames"):
                files = _frames(video, args.frames, work / "frames")
        shots, scene = _pose(args, files, video, work, clock)
        names, found = scene["names"], scene["found"]
        with clock("write"):
            from .posing.write import write_scene

            with Bar() as bar:
                write_scene(folder, work, shots, names, found, bar)
        shutil.rmtree(work)
        write_json(folder / "pose.json", _record(args, version, shots, names, found, clock))
    print(_summary(found, len(shots)))
    for note in scene["notes"]:
        warnings.warn(note, stacklevel=2)
    stages = ", ".join(f"{k} {v['seconds']:.0f} s" for k, v in clock.record().items())
    print(stages)
    print(
        f"wrote {args.out}/ (images, transforms.json, points.ply, sparse/0, cameras.png, pose.json)"
    )
    print(f"next: python -m roge_jax.sample --scene {args.out} --out outputs/{Path(args.out).name}")


def _check_apart(place: Path, out: Path) -> None:
    """OUT may be replaced as a whole, so the photos must not lie in it."""
    here, there = place.resolve(), out.resolve()
    if here == there or there in here.parents:
        raise UserError(
            f"--out {out} is where the photos are, and would be replaced: give a new folder."
        )


def _frames(video: Path, count: int | None, folder: Path) -> list[Path]:
    """The photos that a video becomes."""
    from .posing import frames

    folder.mkdir()
    looked = frames.measure(video)
    try:
        chosen = frames.choose(looked, count)
    except UserError as error:
        raise UserError(f"{video}: {error}") from None
    files = frames.extract(video, chosen, folder)
    print(f"{len(files)} frames of {video}, of {len(looked.index)} that were looked at")
    return files


def _pose(
    args: argparse.Namespace, files: Sequence[Path], video: Path | None, work: Path, clock: Clock
) -> tuple[list, dict[str, Any]]:
    """(the photos, {"names", "found", "notes"}). Raises: UserError that says why there are no poses."""
    from .posing import child, diagnose, mapper, pairs, photos, write

    where = args.photos
    if len(files) < 2:
        raise UserError(
            f"{where}: has one photo, {Path(files[0]).name}, which has nothing to be matched with: take 20 or more "
            "around the thing."
        )
    shots = [photos.read_shot(file) for file in files]
    way = pairs.way_for(len(shots), video is not None) if args.match == "auto" else args.match
    count = len(shots) * min(len(shots), 40) // 2
    check_disk(write.room_for(shots, args.size**2, count), work, "The scene and the work on it")
    kinds = list(dict.fromkeys(shot.camera for shot in shots))
    told = sum(shot.focal is not None for shot in shots)
    print(
        f"{len(shots)} photos of {len(kinds)} camera{'s'[: len(kinds) != 1]}, {told} with a focal length in EXIF; "
        f"{way} matching on {child.threads()} cores"
    )
    with clock("copies"), Bar() as bar:
        sizes, sharpness = _copies(shots, work / "copies", args.size, bar)
    names = write.names_for(shots)
    job = mapper.Job(
        copies=sizes,
        full=[shot.size for shot in shots],
        cameras=[kinds.index(shot.camera) for shot in shots],
        focals=[
            None if shot.focal is None else shot.focal * size[1] / shot.size[1]
            for shot, size in zip(shots, sizes, strict=True)
        ],
        names=names,
        way=way,
        thorough=args.thorough,
        seed=args.seed,
        threads=child.threads(),
    )
    with clock("poses"), Bar() as bar:
        found = child.solve(work, job, bar)
    found |= {"way": way, "sharpness": sharpness}
    least = min(3, len(shots))
    if len(found.get("registered", ())) < least or diagnose.from_one_place(found):
        raise UserError(f"{where}: no poses: {diagnose.why_nothing(found, sharpness)}")
    own = [Path(shot.file).name for shot in shots]
    notes = diagnose.notes(found, own, sharpness, thorough=args.thorough)
    return shots, {"names": names, "found": found, "notes": notes}


def _copies(shots, folder: Path, size: int, progress) -> tuple[list[tuple[int, int]], list[float]]:
    """(sizes of the small pictures that are made, how sharp each is)."""
    from .geometry.crops import resize
    from .posing import mapper, photos
    from .sampling.limits import sharpness
    from .scenes.images import read_image
    from .scenes.matching import LONG_SIDE

    folder.mkdir()
    sizes, sharp = [], []
    for i, shot in enumerate(shots):
        sizes.append(photos.make_copy(shot, folder, mapper.copy_name(i), size))
        small = read_image(folder / mapper.copy_name(i))
        factor = min(1.0, LONG_SIDE / max(sizes[-1]))
        small = resize(small, *(max(2, round(side * factor)) for side in sizes[-1]))
        sharp.append(float(sharpness(small[None])[0]))
        progress("copies", i + 1, len(shots))
    return sizes, sharp


def _summary(found: dict[str, Any], count: int) -> str:
    """One line of numbers, as people compare them."""
    return (
        f"registered {len(found['registered'])} of {count} photos; {found['points']} points, each seen by "
        f"{found['track_length']:.1f} photos, {found['reprojection_error']:.2f} pixels mean reprojection error "
        f"({found['mapper']} mapper)"
    )


def _record(args, version: str, shots, names, found, clock: Clock) -> dict[str, Any]:
    kept = set(found["registered"])
    photos = [
        {
            "file": str(shot.file),
            "name": names[i] if i in kept else None,
            "focal_exif": shot.focal,
            "sharpness": found["sharpness"][i],
            "features": found["features"][i],
            "partners": found["partners"][i],
        }
        for i, shot in enumerate(shots)
    ]
    settings = {k: v for k, v in vars(args).items() if k != "debug"}
    numbers = {
        k: v
        for k, v in found.items()
        if k not in ("features", "partners", "groups", "sharpness", "registered")
    }
    return {
        **environment(),
        "pycolmap": version,
        "settings": settings,
        "registered": len(kept),
        "photos": len(shots),
        **numbers,
        "by_photo": photos,
        "stages": clock.record(),
    }


class Bar:
    """Progress of several stages, one bar each, where somebody looks."""

    def __init__(self):
        self.bar, self.stage = None, ""

    def __enter__(self) -> "Bar":
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def __call__(self, stage: str, done: int, total: int) -> None:
        from tqdm import tqdm

        if stage != self.stage:
            self.__exit__()
            self.bar = tqdm(total=total, desc=stage, leave=False, disable=None)
            self.stage = stage
        assert self.bar is not None
        self.bar.update(done - self.bar.n)


def cli(arguments: Sequence[str] | None = None) -> int:
    """The command line: exit code 2 and one sentence for mistakes."""
    return execute(main, parser(), arguments)


if __name__ == "__main__":
    sys.exit(cli())
