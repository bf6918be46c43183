"""COLMAP scenes: which of several models, and where its photos and points lie."""

import functools
from pathlib import Path

from roge_jax.scenes.colmap import find_models, holds_model, model_size, read_model
from roge_jax.scenes.frames import Frame, Reading
from roge_jax.scenes.pictures import PHOTO_FOLDERS, Finder, shrunk_folders
from roge_jax.scenes.points import points_file, read_points3D

ABOVE = 4  # folders between a model and the folder of its scene, at most


def read(folder: Path) -> Reading | None:
    """The largest model of a scene folder (or the folder that is a model), with the photos that lie beside it."""
    models = find_models(folder)
    if not models:
        return None
    sizes = [model_size(model) for model in models]
    best = max(range(len(models)), key=lambda i: sizes[i])
    model = models[best]
    registered = read_model(model)
    finder, pictures = _photos(folder, model, [name for name, _, _ in registered])
    reading = Reading(folder, [])
    where = model if model == folder else model.relative_to(folder)
    for name, (K, size, lens), c2w in registered:
        picture = finder.find(name)
        if picture is None:
            reading.missing.append(name)
        cure = (
            f"{where}/cameras.txt or .bin must be for these photos: take the pictures the COLMAP model was made from "
            "(undistorted or cropped ones lie beside it), or run it on these"
        )
        if size[0] == size[1]:
            cure = (
                f"{where}/cameras.txt or .bin is for square pictures, to which VGGT and its like pad or crop: export the "
                "COLMAP model for the photos as they are, or give the square ones"
            )
        reading.frames.append(Frame(picture, K, c2w, size, lens, name=name, cure=cure))
    reading.looked = f"'{reading.missing[0]}' in {pictures}" if reading.missing else ""
    reading.registered = "are registered, have a pose"
    if points_file(model) is not None:
        reading.points = functools.partial(read_points3D, model)
    others = [
        f"{m.relative_to(folder).as_posix()} ({n} photos)"
        for m, n in zip(models, sizes, strict=True)
        if m != model and m != folder
    ]
    if others:
        reading.note(
            f"the largest of {len(models)} COLMAP models is read, {where.as_posix()} with {sizes[best]} photos, not "
            + ", ".join(others),
            "give another model's folder as the scene, or take more photos in between to join them",
        )
    return reading


def _photos(folder: Path, model: Path, names: list[str]) -> tuple[Finder, Path]:
    """(where the photos of a model are found, the folder that has most of them)."""
    places: list[Path] = []
    place = model
    for _ in range(ABOVE):
        places += [place / name for name in PHOTO_FOLDERS] + shrunk_folders(place)
        if place == folder and not holds_model(place) and folder != model:
            break
        place = place.parent
        if place == place.parent:
            break
    places += [folder, model]
    some = names[:: max(1, len(names) // 20)]
    folders = [place for place in dict.fromkeys(places) if place.is_dir()]
    counts = [sum((place / name).is_file() for name in some) for place in folders]
    best = max(range(len(folders)), key=lambda i: counts[i])
    if counts[best]:
        return Finder(folder, [folders[best]]), folders[best]
    there = next((p for p in folders if p.name in PHOTO_FOLDERS), folder)
    root = folder if model != folder else there
    return Finder(root, [there]), there
