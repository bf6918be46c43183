"""Which scenes a list of places means: scenes themselves, chunks, and folders full of either."""

from collections.abc import Sequence
from pathlib import Path

from roge_jax.scenes.formats.trajectories import kind_of
from roge_jax.scenes.pictures import visible

from .chunks import SUFFIX

# What a scene folder has, by the layouts of `scenes.readers`.
MARKS = (
    *("transforms.json", "transforms_train.json", "poses_bounds.npy", "scene_data.npz"),
    *("sparse", "colmap", "images.txt", "images.bin", "nerfstudio", "gaussian_splat", "dslr"),
    *("cam", "dense", "exported", "pose", "calib.txt", "groundtruth.txt", "extrinsic.txt"),
)
DEEPEST = 3  # folders below the given one: DL3DV/1K/HASH
SHARDS = 2000  # about as many files a dataset should have: every one is open while it is read
RE10K = 19  # words of a line


def collect(places: Sequence[str | Path]) -> list[str]:
    """The scenes and chunks at these places, in order: a folder without a scene of its own stands for those below it."""
    found = [one for place in places for one in _below(str(place), DEEPEST) or [str(place)]]
    return list(dict.fromkeys(found))


def _below(place: str, depth: int) -> list[str]:
    folder = Path(place)
    if not folder.is_dir() or any((folder / mark).exists() for mark in MARKS):
        return [place]
    if chunks := visible(folder, f"*{SUFFIX}"):
        return [str(file) for file in chunks]
    texts = visible(folder, "*.txt")
    if texts and kind_of(texts[0]) == RE10K:  # a single one is the scene of its folder
        return [place] if len(texts) == 1 else [str(file) for file in texts]
    inner = [one for one in visible(folder, "*") if one.is_dir()] if depth else []
    # Only what is a scene for certain: folders of photos lie beside poses as well.
    found = [name for one in inner for name in _below(str(one), depth - 1)]
    return [name for name in found if _certain(Path(name))]


def _certain(place: Path) -> bool:
    return (
        place.is_file()
        or any((place / mark).exists() for mark in MARKS)
        or len(visible(place, "*.txt")) == 1
    )


def divide(scenes: Sequence[str]) -> list[list[str]]:
    """The scenes by shards: a chunk is one, and so are few enough others that there are about `SHARDS`."""
    size = max(1, -(-len(scenes) // SHARDS))
    found: list[list[str]] = []
    for scene in scenes:
        alone = scene.endswith(SUFFIX)
        room = found and len(found[-1]) < size and not found[-1][-1].endswith(SUFFIX)
        if alone or not room:
            found.append([scene])
        else:
            found[-1].append(scene)
    return found
