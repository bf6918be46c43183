"""How far from what the model was measured to stand are these photos and this path? Warnings at run time.

Everything that can be seen before sampling is measured here, without the network: how far targets leave the photos,
how much wider or narrower they see, how many photos differ at all, how unlike their exposures are, how blurred and how
noisy they are. The limits are not chosen: `experiments/stability/robustness.py` disturbs held-out scenes, finds by interpolation
where the model's output has lost 1 dB, and writes `assets/limits.json` with what produced it. What a photo shows moves
the last three as well, so their limits lie no further in than where 95 % of the undisturbed scenes are. Models without
an entry (by the name of their configuration) get no warnings. docs/results/robustness.md shows the curves.
"""

import functools
import itertools
import json
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import LimitWarning
from ..geometry.cameras import Cameras, to_host

TABLE = Path(__file__).parents[1] / "assets" / "limits.json"
SAME_PLACE, SAME_ANGLE = 0.01, 1.0  # of the baseline, degrees: photos closer than both are one
LUMA = (0.299, 0.587, 0.114)
GAMMA = 2.2
MEDIAN = 0.6745  # of the magnitude of a standard normal variable


class Beyond(NamedTuple):
    """One thing that lies beyond its limit, with one sentence for people. Goes into run.json as it is."""

    kind: str  # a key of the table's "limits"
    value: float
    limit: float
    message: str


# ---- measuring -----------------------------------------------------------------------------------


def extrapolation(context: Cameras, target: Cameras) -> np.ndarray:
    """Distance of each target's centre from the convex hull of the context centres, [n], in baselines.

    The baseline is the largest distance between two context cameras; NaN where there is none. Exact: by Caratheodory
    the nearest point of the hull lies in the hull of at most four affinely independent centres, and all such sets are
    tried (255 for nine photos).
    """
    seen, asked = to_host(context).centres, to_host(target).centres
    baseline = np.linalg.norm(seen[:, None] - seen[None], axis=-1).max()
    if baseline <= 1e-9 * max(np.abs(asked - seen[0]).max(), 1e-12 * np.abs(seen).max()):
        return np.full(len(asked), np.nan)
    seen, asked = (seen - seen[0]) / baseline, (asked - seen[0]) / baseline
    best = np.linalg.norm(asked[:, None] - seen[None], axis=-1).min(1)
    for size in (2, 3, 4):
        for chosen in itertools.combinations(range(len(seen)), size):
            corner, *others = seen[list(chosen)]
            edges = np.stack(others, 1) - corner[:, None]  # [3, size - 1]
            shares = (asked - corner) @ np.linalg.pinv(edges).T  # [n, size - 1]
            inside = (shares >= 0).all(1) & (shares.sum(1) <= 1)
            gap = np.linalg.norm(asked - corner - shares @ edges.T, axis=1)
            best = np.where(inside, np.minimum(best, gap), best)
    return best


def field_ratio(context: Cameras, target: Cameras) -> np.ndarray:
    """How much wider than the photos each target sees, [n]: the ratio of the tangents, 1 is alike.

    K of both in pixels of images of one size.
    """
    seen, asked = (
        np.sqrt(c.K[:, 0, 0] * c.K[:, 1, 1]) for c in (to_host(context), to_host(target))
    )
    return np.median(seen) / asked


def repeats(context: Cameras) -> dict[int, int]:
    """{photo: earlier photo taken from the same place in the same direction}; what is left are distinct photos."""
    cameras = to_host(context)
    gaps = np.linalg.norm(cameras.centres[:, None] - cameras.centres[None], axis=-1)
    chords = np.linalg.norm(
        cameras.c2w[:, None, :3, :3] - cameras.c2w[None, :, :3, :3], axis=(2, 3)
    )
    angles = 2 * np.degrees(np.arcsin(np.clip(chords / np.sqrt(8.0), 0.0, 1.0)))
    same = (gaps <= SAME_PLACE * gaps.max()) & (angles <= SAME_ANGLE)
    found: dict[int, int] = {}
    for view in range(1, len(cameras)):
        earlier = [i for i in range(view) if i not in found and same[view, i]]
        if earlier:
            found[view] = earlier[0]
    return found


def exposures(images: np.ndarray) -> np.ndarray:
    """Brightness of each photo [m, h, w, 3] in stops (log2 of mean linear light); differences are what counts.

    What a photo shows moves it too: `limits.json` says how much it varies between equally exposed photos.
    """
    light = np.asarray(images, np.float64) ** GAMMA
    return np.log2(np.maximum(light.mean((1, 2, 3)), 1e-6))


def sharpness(images: np.ndarray) -> np.ndarray:
    """Finest detail over the next coarser one, [m], of each photo [m, h, w, 3]: about 1 if sharp, towards 0 if blurred.

    Root energy ratio of two bands of the luma, from binomial filters: x - Bx and Bx - B^5 x. NaN for plain colours.
    """
    luma = np.asarray(images, np.float64) @ np.array(LUMA)
    one = _binomial(luma)
    five = functools.reduce(lambda x, _: _binomial(x), range(4), one)
    fine, coarse = (np.square(x).mean((1, 2)) for x in (luma - one, one - five))
    return np.where(coarse > 1e-8, np.sqrt(fine / np.maximum(coarse, 1e-8)), np.nan)


def noise(images: np.ndarray) -> np.ndarray:
    """Standard deviation of the noise of each photo [m, h, w, 3], [m] (white is 1), if that differs between channels.

    Two differences of the channels, orthonormal to grey, are filtered by [1 -2 1] along h and w (Immerkaer 1996); the
    median magnitude is that of noise alone as long as fewer than half of the places have a fine edge between colours.
    Fine detail of things is mostly one of brightness, which does not enter; noise that is grey is not seen either.
    """
    red, green, blue = np.moveaxis(np.asarray(images, np.float64), -1, 0)
    x = np.stack([(red - blue) / np.sqrt(2.0), (red - 2.0 * green + blue) / np.sqrt(6.0)], 1)
    for axis in (2, 3):
        x = np.diff(x, 2, axis=axis)
    gain = 6.0  # of white noise: the root of the sum of squares of the filter
    return (np.median(np.abs(x), (2, 3)) / (MEDIAN * gain)).mean(1)


def _binomial(x: np.ndarray) -> np.ndarray:
    """[1 2 1] / 4 along h and w of [m, h, w], borders repeated."""
    for axis in (1, 2):
        pad = [(1, 1) if i == axis else (0, 0) for i in range(3)]
        y = np.pad(x, pad, mode="edge")
        cut = [np.take(y, range(k, k + x.shape[axis]), axis) for k in range(3)]
        x = 0.25 * cut[0] + 0.5 * cut[1] + 0.25 * cut[2]
    return x


# ---- comparing -----------------------------------------------------------------------------------


@functools.cache
def table(name: str) -> dict[str, Any]:
    """The measured limits of a model, {kind: {"limit": .., "broke": .., ..}}; empty if none were measured."""
    if not TABLE.exists():
        return {}
    return json.loads(TABLE.read_text(encoding="utf-8")).get(name, {}).get("limits", {})


def beyond(
    images: np.ndarray,
    context: Cameras,
    target: Cameras,
    limits: dict[str, Any],
    ids: Sequence[int] | None = None,
) -> list[Beyond]:
    """What lies beyond `limits` (of `table`), at most one entry per kind.

    Args:
      images: photos [m, h, w, 3] in [0, 1].
      context: cameras of the photos [m], K in pixels of one size.
      target: cameras of the path [n] in the same frame and pixels.
      ids: the photos' numbers for the messages; default 0 .. m - 1.
    """
    ids = list(range(len(context))) if ids is None else list(ids)
    found = []

    def report(kind: str, value: float, text: str, cure: str) -> None:
        found.append(entry(kind, value, limits[kind], text, cure))

    def frames(outside: np.ndarray) -> str:
        which = np.flatnonzero(outside)
        return f"{'frames' if len(which) > 1 else 'frame'} {spans(which)}"

    if "extrapolation" in limits:
        far = extrapolation(context, target)
        outside = far > limits["extrapolation"]["limit"]
        if outside.any():
            worst = float(np.nanmax(far))
            text = f"{frames(outside)} leave the photos by up to {worst:.2g} baselines"
            report("extrapolation", worst, text, "shorten the path or add photos there")
    ratio = field_ratio(context, target)
    if "wider" in limits and (ratio > limits["wider"]["limit"]).any():
        outside = ratio > limits["wider"]["limit"]
        text = f"{frames(outside)} see {ratio.max():.2g} times as wide as the photos"
        report("wider", ratio.max(), text, "narrow the path's field of view or add wider photos")
    if "narrower" in limits and (ratio < limits["narrower"]["limit"]).any():
        outside = ratio < limits["narrower"]["limit"]
        text = f"{frames(outside)} see {ratio.min():.2g} times as wide as the photos"
        cure = "widen the path's field of view or add closer photos"
        report("narrower", ratio.min(), text, cure)
    same = repeats(context)
    if "photos" in limits and len(context) - len(same) < limits["photos"]["limit"]:
        left = len(context) - len(same)
        text = f"there {'are' if left > 1 else 'is'} {left} distinct photo{'s' * (left > 1)}"
        if same:
            twins = ", ".join(f"{ids[a]} repeats {ids[b]}" for a, b in same.items())
            text += f" (photo {twins})"
        row = limits["photos"]
        message = (
            f"{text}; with fewer than {np.ceil(row['limit']):.0f} the model loses 1 dB: "
            "add photos from other places."
        )
        found.append(Beyond("photos", left, row["limit"], message))
    if "exposure" in limits and len(images) > 1:
        stops = exposures(images)
        if np.ptp(stops) > limits["exposure"]["limit"]:
            dark, light = ids[int(stops.argmin())], ids[int(stops.argmax())]
            text = f"photo {light} is {np.ptp(stops):.2g} stops brighter than photo {dark}"
            report("exposure", np.ptp(stops), text, "match their exposure or leave one out")
    if "blur" in limits:
        sharp = sharpness(images)
        soft = np.flatnonzero(sharp < limits["blur"]["limit"])
        if len(soft):
            which = f"photo{'s' * (len(soft) > 1)} {', '.join(str(ids[i]) for i in soft)}"
            worst = float(np.nanmin(sharp))
            text = f"{which} {'are' if len(soft) > 1 else 'is'} blurred (sharpness {worst:.2g})"
            report("blur", worst, text, "take sharper photos or leave them out")
    if "noise" in limits:
        amount = noise(images)
        grainy = np.flatnonzero(amount > limits["noise"]["limit"])
        if len(grainy):
            which = f"photo{'s' * (len(grainy) > 1)} {', '.join(str(ids[i]) for i in grainy)}"
            text = f"{which} {'are' if len(grainy) > 1 else 'is'} noisy (deviation {amount.max():.2g}, white being 1)"
            report("noise", amount.max(), text, "take photos in more light or leave them out")
    return found


def entry(
    kind: str, value: float, row: dict[str, Any], text: str, cure: str, unit: str = ""
) -> Beyond:
    """What lies beyond the limit of a `row` of the table, said in one sentence."""
    edge = "the model loses 1 dB" if row["broke"] else "nothing was measured"
    edge += " or more" if row.get("moved") else ""
    message = f"{text}; beyond {row['limit']:.2g}{unit} {edge}: {cure}."
    return Beyond(kind, float(value), float(row["limit"]), message)


def warn(
    images: np.ndarray,
    context: Cameras,
    target: Cameras,
    name: str,
    ids: Sequence[int],
    known: Collection[str] = (),
) -> tuple[Beyond, ...]:
    """`beyond` the measured limits of the model called `name`, each also a `LimitWarning` unless its kind is `known`."""
    found = tuple(beyond(images, context, target, table(name), ids))
    for one in found:
        if one.kind not in known:
            warnings.warn(one.message, LimitWarning, stacklevel=3)
    return found


def spans(numbers: Sequence[int] | np.ndarray) -> str:
    """Ascending whole numbers as text: 0, 3-5, 9."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(int(number))
        else:
            parts.append([int(number)])
    return ", ".join(str(p[0]) if len(p) == 1 else f"{p[0]}-{p[-1]}" for p in parts)
