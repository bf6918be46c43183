"""What the numbers of a run mean, in sentences with a cure: why nothing was found, and why photos were left out.

`found` is what `mapper.run` wrote: features, pairs and poses by the numbers of the photos, in the order of the walk.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

BLURRED = 0.45  # `limits.sharpness` at 640 pixels: sharp photos have 0.7 to 1.1
FEW_FEATURES = 200  # of a photo: it is blurred, dark, or shows plain walls
TURNED = 0.8  # of the pairs: the camera only turned
RETAKE = "take the photos again: walk around the thing, each photo sharing two thirds with the one before"
NAMED = 4  # photos named in a sentence


def why_nothing(found: dict[str, Any], sharpness: Sequence[float]) -> str:
    """Why there are no poses at all, and what to do."""
    count = len(found["features"])
    poor = sum(n < FEW_FEATURES for n in found["features"])
    soft = int((np.asarray(sharpness) < BLURRED).sum())
    counts = (
        f"{found['pairs_matched']} of {found['pairs_tried']} pairs of {count} photos match, with a median of "
        f"{found['matches']:.0f} matches"
    )
    if soft > count / 2:
        return f"{soft} of {count} photos are blurred: hold the camera still, with more light, and take them again."
    if poor > count / 2:
        return (
            f"{poor} of {count} photos show almost nothing that can be recognised (fewer than {FEW_FEATURES} features): "
            "plain walls, darkness, or blur. Take in things with texture, or give larger photos."
        )
    if found["pairs_matched"] and found["turned_only"] > TURNED:
        return (
            f"all photos are from one place ({counts}, and only turning explains {found['turned_only']:.0%} of them): "
            "depth shows only when the camera moves sideways. Walk, do not turn on the spot."
        )
    if found["pairs_matched"] < max(1, count // 2):
        return f"the photos have too little in common ({counts}): {RETAKE}."
    return (
        f"the photos match ({counts}) and still no poses fit them: the camera moved too little, or things in front of it "
        f"moved. {RETAKE[:1].upper()}{RETAKE[1:]}."
    )


def from_one_place(found: dict[str, Any]) -> bool:
    """Whether the photos show no depth, whatever a mapper made of them."""
    return bool(found["pairs_matched"]) and found["turned_only"] > TURNED


def notes(
    found: dict[str, Any], names: Sequence[str], sharpness: Sequence[float], *, thorough: bool
) -> list[str]:
    """What is to be said about a solution: who was left out and why, and what is doubtful."""
    count, kept = len(names), set(found["registered"])
    out = [i for i in range(count) if i not in kept]
    said = []
    if out:
        said.append(
            f"{len(out)} of {count} photos have no pose and are left out: {_named(out, names)}"
        )
    soft = [i for i in out if sharpness[i] < BLURRED]
    plain = [i for i in out if i not in soft and found["features"][i] < FEW_FEATURES]
    alone = [i for i in out if i not in soft + plain and not found["partners"][i]]
    parts = other_parts(found)
    for some, why in (
        (soft, "are blurred: take them again"),
        (plain, "show almost nothing that can be recognised: take in things with texture"),
        (alone, "match no other photo: take more in between"),
    ):
        if some:
            said.append(f"{len(some)} of these {why} ({_named(some, names)})")
    if parts:
        said.append(
            f"the photos fall apart into parts of {', '.join(map(str, [len(kept), *parts]))}, and the largest is "
            "written: take photos in between that show both sides, or pose the parts one by one"
        )
    if out and not thorough:
        said.append(
            "--thorough looks for more features, several times as long, and may join what is left out"
        )
    if found.get("focal_held"):
        said.append(
            "the focal length is EXIF's: the photos alone do not show it (a flat scene, seen from one direction)"
        )
    if found["reprojection_error"] > 2.0:
        said.append(
            f"features lie {found['reprojection_error']:.1f} pixels from where the poses put them, good is below 1: did "
            "things move, or was the zoom changed?"
        )
    return said


def other_parts(found: dict[str, Any]) -> list[int]:
    """Sizes of the further parts of three photos and more that the mapper which won has posed, the largest first."""
    sizes = sorted((n for how, n in found["models"] if how == found["mapper"]), reverse=True)
    left = len(found["features"]) - len(found["registered"])
    return [n for n in sizes[1:] if 3 <= n <= left]


def _named(which: Sequence[int], names: Sequence[str]) -> str:
    more = f" and {len(which) - NAMED} more" if len(which) > NAMED else ""
    return ", ".join(names[i] for i in which[:NAMED]) + more
