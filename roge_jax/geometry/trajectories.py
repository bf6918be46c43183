"""Ready-made camera paths around posed photos, all from the context cameras alone.

Every preset starts from one context camera and is sized by the distance at which the scene is (see
`focus_distance`), so a path means the same in any unit. Orientation at the start is the photo's.
"""

import dataclasses
import inspect
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from roge_jax.errors import UserError, did_you_mean
from roge_jax.files.fields import number
from roge_jax.geometry.cameras import Cameras, checked_views, to_host
from roge_jax.geometry.interpolation import interpolate

__all__ = [
    "PRESETS",
    "focus_distance",
    "make_path",
    "parse_options",
    "world_up",
]


MOST = 1e6  # of any option: turns, degrees, lengths in units of the focus


@dataclasses.dataclass(frozen=True)
class Rig:
    """What a preset works with: the start camera, the context, the scene's distance and up."""

    first: int  # the start camera's place in the context
    start: np.ndarray  # c2w [4, 4]
    K: np.ndarray  # [3, 3]
    context: Cameras
    focus: float  # distance of the point to look at, along the start camera's optical axis
    up: np.ndarray  # unit vector in the world, roughly against gravity


Poses = tuple[np.ndarray, np.ndarray]  # c2w [f, 4, 4], K [f, 3, 3]


def make_path(
    name: str,
    context: Cameras,
    frames: int,
    *,
    start: int = 0,
    focus: float | None = None,
    ease: bool = False,
    **options: Any,
) -> Cameras:
    """The cameras [frames] of a preset (float64, in the context's world and unit).

    Args:
      name: one of PRESETS; `load_path` reads files.
      context: the photos' cameras, K in pixels of the pictures to make.
      start: the context view that the path starts from.
      focus: distance of the point to look at in scene units; default `focus_distance`.
      ease: start and stop gently instead of at constant speed.
      options: the preset's own keywords, e.g. orbit's `degrees`.
    Raises: UserError for an unknown name or option, or a start that is no context view.
    """
    if not isinstance(name, str) or name not in PRESETS:
        raise UserError(f"There is no trajectory '{name}': {did_you_mean(name, PRESETS)}")
    where = f"Trajectory '{name}'"
    context = checked_views(context, "context")
    frames, start = (
        number(value, where, word, whole=True)
        for word, value in (("frames", frames), ("start", start))
    )
    if frames < 1:
        raise UserError(f"A path of {frames} frames is empty: ask for 1 or more.")
    if not 0 <= start < len(context):
        raise UserError(f"start={start} is no context view: there are {len(context)}, from 0.")
    preset, defaults = PRESETS[name], preset_options(name)
    for option, value in options.items():
        if option not in defaults:
            hint = did_you_mean(option, [*defaults, "start", "focus", "ease"])
            raise UserError(f"{where} has no option '{option}': {hint}")
        options[option] = _option(value, where, option, defaults[option])
    ease = _option(ease, where, "ease", False)
    given = focus_distance(context, start) if focus is None else focus
    distance = number(given, where, "focus")
    if not 0 < distance < 1e100:
        raise UserError(f"focus={focus} is no distance: give a positive number in scene units.")
    rig = Rig(start, context.c2w[start], context.K[start], context, distance, world_up(context))
    s = np.linspace(0.0, 1.0, frames) if frames > 1 else np.zeros(1)
    s = s * s * (3.0 - 2.0 * s) if ease else s
    c2w, K = preset(rig, s, **options)
    return Cameras(K, c2w)


def preset_options(name: str) -> dict[str, Any]:
    """{option: its default} of a preset, beside the `start`, `focus` and `ease` that all of them have."""
    every = list(inspect.signature(PRESETS[name]).parameters.values())
    return {p.name: p.default for p in every[2:]}


def describe() -> str:
    """Every preset, what it does, and its options with their defaults: what `sample --trajectory list` prints."""
    lines = []
    for name, preset in PRESETS.items():
        options = {k: "auto" if v is None else v for k, v in preset_options(name).items()}
        words = ",".join(f"{k}={str(v).lower()}" for k, v in options.items())
        what = " ".join((inspect.getdoc(preset) or "").split())
        lines += [f"{name}:{words}", f"    {what}"]
    return "\n".join(
        [
            *lines,
            "",
            "Written are the defaults. Lengths are in units of the distance in focus. All take start=PHOTO,",
            "focus=DISTANCE (scene units; found out if not given) and ease=true (start and stop gently).",
        ]
    )


def parse_options(text: str, where: str) -> dict[str, Any]:
    """ "degrees=90,swing=false" as keywords of `make_path`; `where` is for messages."""
    options: dict[str, Any] = {}
    for word in text.split(","):
        if not word:
            continue
        name, equals, value = word.partition("=")
        if not equals:
            raise UserError(
                f"{where}: '{word}' is no option: write NAME:OPTION=VALUE,OPTION=VALUE."
            )
        if name in options:
            raise UserError(f"{where}: '{name}' is given twice.")
        if name in ("name", "context", "frames"):
            raise UserError(f"{where}: '{name}' is no option of a path.")
        try:
            options[name] = json.loads(value.lower())
        except (ValueError, RecursionError):
            options[name] = value
    return options


def _option(value: Any, where: str, name: str, default: Any) -> Any:
    """The value of a preset's option, which must be of the kind of its default (None: yes or no)."""
    if default is None or isinstance(default, bool):
        if value in (True, False) or (default is None and value is None):
            return value
        raise UserError(f"{where}: '{name}' is {value!r}: give true or false.")
    if isinstance(default, str):
        return value
    found = number(value, where, name)
    if not abs(found) <= MOST:
        raise UserError(f"{where}: '{name}' is {found}: give a number from {-MOST:g} to {MOST:g}.")
    return found


# Where the scene is


def focus_distance(context: Cameras, start: int = 0) -> float:
    """How far in front of a context view the scene is, estimated from the cameras alone.

    The point closest to all optical axes, if they converge in front of the cameras. Otherwise (near
    parallel axes, outward views) the distance at which the frustum of the view overlaps by 90 %
    with one shifted by the median sideways distance to the other cameras. 1 for a single view.
    """
    context = to_host(context)
    centres, axes = context.centres, context.c2w[:, :3, 2]
    here, ahead = centres[start], axes[start]
    offsets = centres - here
    if np.linalg.norm(offsets, axis=-1).max() <= 1e-12 * max(1e-300, np.abs(centres).max()):
        return 1.0
    across = np.eye(3)[None] - axes[:, :, None] * axes[:, None, :]
    normal = across.mean(0)
    # The smallest eigenvalue is the mean squared sine between the axes and their common direction.
    if np.linalg.eigvalsh(normal)[0] > np.sin(np.radians(2.0)) ** 2:
        point = np.linalg.solve(normal, (across @ offsets[..., None])[..., 0].mean(0))
        depths = ((point - offsets) * axes).sum(-1)
        if depths[start] > 0 and (depths > 0).mean() >= 0.75:
            return float(depths[start])
    others = np.delete(offsets, start, axis=0)
    sideways = np.median(np.linalg.norm(others - (others @ ahead)[:, None] * ahead, axis=-1))
    K = context.K[start]
    tangent = K[0, 2] / K[0, 0]  # of half the horizontal field of view
    if sideways > 0.05 * np.median(np.linalg.norm(others, axis=-1)):
        return float(sideways / (0.1 * 2 * tangent))
    return float(3.0 * np.median(np.linalg.norm(others, axis=-1)))  # a walk straight ahead


def world_up(context: Cameras) -> np.ndarray:
    """Up [3]: the direction square to the cameras' x axes (people hold cameras level).

    With too few different headings to tell, the mean of the cameras' own up axes.
    """
    context = to_host(context)
    up = -context.c2w[:, :3, 1].mean(0)
    if np.linalg.norm(up) < 1e-3:
        up = -context.c2w[0, :3, 1]
    up = up / np.linalg.norm(up)
    values, vectors = np.linalg.eigh(context.c2w[:, :3, 0].T @ context.c2w[:, :3, 0])
    spread = np.sqrt(np.maximum(values, 0.0) / len(context))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    # The x axes must span a plane (more than 10 degrees of heading) and leave one direction free.
    clear = spread[1] > np.sin(np.radians(10.0)) and spread[0] < 0.3 * spread[1]
    return level if clear and level @ up > 0.5 else up


# Presets: (rig, progress s in [0, 1], options) -> poses. Lengths are in units of the focus.


def orbit(rig: Rig, s: np.ndarray, degrees: float = 40.0, swing: bool | None = None) -> Poses:
    """Around the point in focus: out and back on both sides (`swing`), or one way.

    `degrees` is the whole arc; from 360 up the default is one way round.
    """
    swing = abs(degrees) < 360 if swing is None else swing
    angles = np.radians(degrees) * (0.5 * np.sin(2 * np.pi * s) if swing else s)
    return _turned(rig, rig.up, angles, _focus_point(rig)), _still(rig, s)


def spiral(rig: Rig, s: np.ndarray, radius: float = 0.15, turns: float = 2.0) -> Poses:
    """A widening and narrowing helix that looks at the point in focus; starts and ends at rest."""
    reach, angle = radius * np.sin(np.pi * s), 2 * np.pi * turns * s
    offsets = np.stack([reach * np.cos(angle), reach * np.sin(angle), reach * np.sin(angle / 2)], 1)
    return _looking(rig, offsets), _still(rig, s)


def lemniscate(rig: Rig, s: np.ndarray, radius: float = 0.2) -> Poses:
    """A lying figure of eight that looks at the point in focus; closed."""
    angle = 2 * np.pi * s
    sideways = radius * np.sin(angle)
    offsets = np.stack([sideways, 0.5 * sideways * np.cos(angle), np.zeros_like(s)], 1)
    return _looking(rig, offsets), _still(rig, s)


def interpolated(rig: Rig, s: np.ndarray, order: str = "given") -> Poses:
    """Through all context views, in the given order or along a short route (`shortest`), which begins where it is
    shortest or at a start other than 0.
    """
    if order not in ("given", "shortest"):
        raise UserError(f"order='{order}': {did_you_mean(order, ('given', 'shortest'))}")
    order_of = np.roll(np.arange(len(rig.context)), -rig.first)
    if order == "shortest":
        order_of = _route(rig.context, rig.first or None)
    path = interpolate(rig.context[order_of], s, unit=rig.focus)
    return path.c2w, path.K


def _moving(
    where: str, direction: tuple[float, float, float], default: float = 0.3
) -> Callable[..., Poses]:
    def move(rig: Rig, s: np.ndarray, distance: float = default) -> Poses:
        poses = np.repeat(rig.start[None], len(s), 0)
        step = rig.start[:3, :3] @ np.array(direction) * distance * rig.focus
        poses[:, :3, 3] += s[:, None] * step[None]
        return poses, _still(rig, s)

    move.__doc__ = f"Straight {where} by `distance`, without turning."
    return move


def _rotating(where: str, axis: str, sign: float, default: float) -> Callable[..., Poses]:
    def rotate(rig: Rig, s: np.ndarray, degrees: float = default) -> Poses:
        vector = {"up": rig.up, "right": rig.start[:3, 0], "ahead": rig.start[:3, 2]}[axis]
        angles = sign * np.radians(degrees) * s
        return _turned(rig, vector, angles, rig.start[:3, 3]), _still(rig, s)

    rotate.__doc__ = f"On the spot, {where} by `degrees`."
    return rotate


def pan(rig: Rig, s: np.ndarray, degrees: float = 30.0) -> Poses:
    """On the spot to the left and to the right, `degrees` in all, back to the start."""
    angles = 0.5 * np.radians(degrees) * np.sin(2 * np.pi * s)
    return _turned(rig, rig.up, angles, rig.start[:3, 3]), _still(rig, s)


def zoom_in(rig: Rig, s: np.ndarray, factor: float = 1.5) -> Poses:
    """The focal length grows to `factor` times; the camera stands still."""
    if not 0.01 <= factor <= 100:
        raise UserError(f"factor={factor:g} is no zoom: give 0.01 to 100, 1 changes nothing.")
    return np.repeat(rig.start[None], len(s), 0), _zoomed(rig, factor**s)


def zoom_out(rig: Rig, s: np.ndarray, factor: float = 1.5) -> Poses:
    """The focal length shrinks to 1 / `factor`; the camera stands still."""
    return zoom_in(rig, s, 1.0 / factor if factor else factor)


def dolly_zoom_in(rig: Rig, s: np.ndarray, distance: float = 0.3) -> Poses:
    """Forward while zooming out, so that what is in focus keeps its size."""
    if distance >= 1:
        raise UserError(f"distance={distance} passes the point in focus: give less than 1.")
    poses, _ = _moving(*FORWARD)(rig, s, distance)
    return poses, _zoomed(rig, 1.0 - distance * s)


def dolly_zoom_out(rig: Rig, s: np.ndarray, distance: float = 0.3) -> Poses:
    """Backward while zooming in, so that what is in focus keeps its size."""
    return dolly_zoom_in(rig, s, -distance)


FORWARD, BACKWARD = ("forward", (0.0, 0.0, 1.0)), ("backward", (0.0, 0.0, -1.0))
PRESETS: dict[str, Callable[..., Poses]] = {
    "dolly-in": _moving(*FORWARD),
    "dolly-out": _moving(*BACKWARD),
    "dolly-zoom-in": dolly_zoom_in,
    "dolly-zoom-out": dolly_zoom_out,
    "interpolate": interpolated,
    "lemniscate": lemniscate,
    "move-backward": _moving(*BACKWARD),
    "move-down": _moving("down", (0.0, 1.0, 0.0), 0.2),
    "move-forward": _moving(*FORWARD),
    "move-left": _moving("to the left", (-1.0, 0.0, 0.0), 0.2),
    "move-right": _moving("to the right", (1.0, 0.0, 0.0), 0.2),
    "move-up": _moving("up", (0.0, -1.0, 0.0), 0.2),
    "orbit": orbit,
    "pan": pan,
    "pan-left": _rotating("to the left", "up", 1.0, 20.0),
    "pan-right": _rotating("to the right", "up", -1.0, 20.0),
    "roll": _rotating("about the optical axis", "ahead", 1.0, 360.0),
    "spiral": spiral,
    "tilt-down": _rotating("down", "right", -1.0, 15.0),
    "tilt-up": _rotating("up", "right", 1.0, 15.0),
    "zoom-in": zoom_in,
    "zoom-out": zoom_out,
}


def _still(rig: Rig, s: np.ndarray) -> np.ndarray:
    return np.repeat(rig.K[None], len(s), 0)


def _zoomed(rig: Rig, factors: np.ndarray) -> np.ndarray:
    """K with its focal lengths (and skew) times factors [f]; the principal point stays."""
    K = _still(rig, factors)
    K[:, :2, :2] *= factors[:, None, None]
    return K


def _focus_point(rig: Rig) -> np.ndarray:
    return rig.start[:3, 3] + rig.focus * rig.start[:3, 2]


def _turned(rig: Rig, axis: np.ndarray, angles: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """The start camera turned by angles [f] (radians) about an axis [3] through a pivot [3]."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(angles[:, None] * axis[None]).as_matrix()
    poses = np.repeat(rig.start[None], len(angles), 0)
    poses[:, :3, :3] = turns @ rig.start[:3, :3]
    poses[:, :3, 3] = turns @ (rig.start[:3, 3] - pivot) + pivot[None]
    return poses


def _looking(rig: Rig, offsets: np.ndarray) -> np.ndarray:
    """The start camera moved by offsets [f, 3] (camera axes, units of the focus), looking at it."""
    ahead = np.array([0.0, 0.0, 1.0])[None] - offsets
    z = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
    x = np.cross(np.array([0.0, 1.0, 0.0])[None], z)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    local = np.tile(np.eye(4), (len(offsets), 1, 1))
    local[:, :3, :3] = np.stack([x, np.cross(z, x), z], -1)
    local[:, :3, 3] = offsets * rig.focus
    return rig.start[None] @ local


def _route(context: Cameras, start: int | None = None) -> np.ndarray:
    """A short open route through all centres: the nearest-neighbour route from `start`, or the best of all of them."""
    gaps = np.linalg.norm(context.centres[:, None] - context.centres[None], axis=-1)
    best, shortest = np.arange(len(gaps)), np.inf
    for first in range(len(gaps)) if start is None else [start]:
        route, left = [first], set(range(len(gaps))) - {first}
        while left:
            route.append(min(sorted(left), key=lambda view: gaps[route[-1], view]))
            left.remove(route[-1])
        length = gaps[route[:-1], route[1:]].sum()
        if length < shortest:
            best, shortest = np.array(route), length
    return best if start is not None or best[0] <= best[-1] else best[::-1]
