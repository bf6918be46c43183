"""Procedural scenes and camera paths: endless posed training views, a pure function of a seed.

A scene is a room, a walled yard or open ground with 12 primitives, photographic and noise textures
and one point light; `raycast.render` draws it with exact depth. Seeds below `HELDOUT_SEED` are for
training, the others for evaluation with textures never used in training.

    python -m roge_jax.procedural dataset --out DIR --scenes 2000 --processes 4
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roge_jax.errors import UserError
from roge_jax.procedural.layout import Dice, choose_materials, place_objects
from roge_jax.procedural.raycast import (
    CLOSED,
    OBJECTS,
    OPEN,
    SKY_DEPTH,
    SceneParams,
    render,
    render_views,
)
from roge_jax.procedural.textures import load_textures

__all__ = [
    "HELDOUT_SEED",
    "SKY_DEPTH",
    "SceneParams",
    "camera_path",
    "clear_views",
    "handheld_cameras",
    "intrinsics",
    "load_textures",
    "make_scene",
    "render",
    "render_views",
    "sample_sequence",
    "split_of",
    "varied_cameras",
]

HELDOUT_SEED = 1_000_000_000
CLEARANCE = 0.35  # free space around every camera centre
SWEEP = (20.0, 60.0)  # degrees of orbit over a whole path
HEIGHTS, DISTANCES = (0.7, 1.9), (0.72, 1.0)  # of a path's middle, see `camera_path`
VARIED_SWEEP = (12.0, 170.0)  # the same for training, log-uniform
VARIED_FOV = (26.0, 86.0)  # degrees, log-uniform
HANDHELD_SWEEP = (40.0, 360.0)  # degrees of orbit of handheld sequences, log-uniform
_PATH_SAMPLES = 64  # where a path is checked for objects in the way


def split_of(seed: int) -> str:
    """The texture split of a scene seed, "train" or "heldout".

    Raises:
        UserError: the seed is outside 0 .. 2^31 - 1.
    """
    if not 0 <= int(seed) < 2**31:
        raise UserError(f"scene seed {seed} is not allowed: use 0 .. {2**31 - 1}.")
    return "heldout" if seed >= HELDOUT_SEED else "train"


def make_scene(seed: int | Array, *, textures: Array) -> SceneParams:
    """The scene of a seed (int32, traceable: jit and vmap over it).

    Args:
        seed: 0 .. 2^31 - 1.
        textures: a packed set of `load_textures`; vmap with `in_axes=None` and render inside the
            same vmap, so that it is never copied.

    Objects are kept clear of the cameras of `camera_path(seed, n, scene=scene)` for every n.
    """
    dice = Dice(jax.random.key(seed), 4096)
    enclosure = dice.pick((), (0.5, 0.25, 0.25))
    is_open = enclosure == OPEN
    room = dice((3,), jnp.array([2.2, 2.2, 1.25]), jnp.array([3.8, 3.8, 1.8]))
    reach = jnp.where(is_open, 4.0, jnp.minimum(room[0], room[1]))  # where content can stand
    focus = dice((3,), -0.15, 0.15) * reach * jnp.array([1.0, 1.0, 0.0])
    focus = focus.at[2].set(dice((), 0.45, 0.95))
    centre, rotation, half = place_objects(dice, room, reach, focus, is_open)
    room_half = jnp.where(is_open, jnp.array([45.0, 45.0, 20.0]), room)
    room_centre = jnp.array([0.0, 0.0, 1.0]) * room_half
    inside = jnp.array([room[0] - 0.3, room[1] - 0.3, 2.0 * room[2] - 0.4])
    bound = jnp.where(is_open, jnp.array([6.0, 6.0, 4.0]), inside)
    indoor_light = jnp.append(dice((2,), -0.6, 0.6) * room[:2], room[2] * dice((), 1.5, 1.9))
    azimuth = dice((), 0.0, 2 * jnp.pi)
    sun = 15.0 * jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth), dice((), 0.7, 2.0)])
    is_room = enclosure == CLOSED
    warm = dice((), -0.12, 0.12)
    tone = jnp.stack([1.0 + warm, 1.0 + 0.0 * warm, 1.0 - warm])
    fill_azimuth = dice((), 0.0, 2 * jnp.pi)
    below = dice((), 0.12, 0.3)
    above = below + dice((), 0.1, 0.35)
    zenith = jnp.array([0.16, 0.32, 0.62]) * dice((), 0.5, 1.3)
    horizon = dice((), 0.5, 0.85) * (1.0 + dice((3,), -0.08, 0.08))
    strength = dice((), 0.9, 1.6) * jnp.where(is_room, 1.5, 1.2)
    scene = SceneParams(
        centre=jnp.concatenate([centre, room_centre[None]]),
        rotation=jnp.concatenate([rotation, jnp.eye(3)[None]]),
        half=jnp.concatenate([half, room_half[None]]),
        materials=choose_materials(dice, is_open),
        enclosure=enclosure,
        light=jnp.where(is_room, indoor_light, sun),
        light_colour=strength * tone,
        light_reach=jnp.where(is_room, 3.5, 100.0),
        fill=jnp.stack([jnp.cos(fill_azimuth), jnp.sin(fill_azimuth), 0.3]),
        ambient=jnp.stack([below, above])[:, None] * (2.0 - tone)[None],
        sky=jnp.stack([horizon, zenith]),
        haze=jnp.where(is_room, 0.0, dice((), 0.0, 0.025)),
        saturation=dice((), 0.6, 1.0),
        exposure=dice((), 1.1, 2.0),
        camera_low=jnp.append(-bound[:2], 0.35),
        camera_high=bound,
        focus=focus,
        textures=textures,
    )
    path = camera_path(seed, _PATH_SAMPLES, scene=scene)
    return clear_views(scene, path["c2w"])


def camera_path(
    key_or_seed: int | Array,
    n: int,
    *,
    scene: SceneParams,
    sweep: tuple[float, float] = SWEEP,
    samples: Array | None = None,
    heights: tuple[float, float] = HEIGHTS,
    distances: tuple[float, float] = DISTANCES,
    roll: Array | float = 0.0,
) -> dict[str, Array]:
    """A smooth path of n views around the scene's focus: `{"c2w": [n,4,4], "fov": []}`.

    Half of the paths are arcs (`sweep` degrees of orbit in total), the others dollies with little
    orbit, or both at once. `c2w` is OpenCV camera to world, `fov` the horizontal field of view in
    degrees, 45 .. 75, one per path. With other seeds than the scene's own, or another `sweep`,
    call `clear_views` before rendering.

    Args:
        samples: `[n]` positions along the path in [0, 1] instead of n equal steps.
        heights: of the path's middle above the ground.
        distances: of the cameras from the focus, in parts of the space there is.
        roll: `[n]` degrees about the optical axes beside the few that every path has.
    """
    key = jnp.asarray(key_or_seed)
    if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jax.random.fold_in(jax.random.key(key), 7)
    dice = Dice(key, 64)
    s = jnp.linspace(0.0, 1.0, n) if samples is None else samples
    s = s - dice((), -0.5, 0.5) * jnp.sin(2 * jnp.pi * s) / (2 * jnp.pi)
    s = s - 0.5
    kind = dice.pick((), (0.5, 0.2, 0.3))  # arc, dolly, both
    sign = jnp.where(dice() < 0.5, 1.0, -1.0)
    orbit = sign * jnp.deg2rad(dice((), *sweep))
    orbit = orbit * jnp.array([1.0, 0.2, 0.8])[kind]
    dolly = dice((), -1.0, 1.0) * jnp.array([0.2, 0.7, 0.5])[kind]
    azimuth = dice((), 0.0, 2 * jnp.pi) + orbit * s
    span = jnp.minimum(scene.camera_high[0], scene.camera_high[1])
    radius = span * dice((), *distances) * jnp.exp(dolly * s)
    wobble = dice((3,), -1.0, 1.0)
    wave = jnp.sin(2 * jnp.pi * (wobble[0] + dice((), 0.4, 1.0) * s))
    height = dice((), *heights) + 0.5 * wobble[1] * s + 0.08 * wobble[2] * wave
    ring = radius[:, None] * jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth)], -1)
    position = jnp.concatenate([scene.focus[None, :2] + ring, height[:, None]], -1)
    position = _soft_clip(position, scene.camera_low, scene.camera_high)

    aim = scene.focus + 0.3 * dice((3,), -1.0, 1.0) * jnp.array([1.0, 1.0, 0.6])
    drift = 0.4 * dice((3,), -1.0, 1.0) * jnp.array([1.0, 1.0, 0.3])
    aim = aim[None] + drift[None] * s[:, None]
    tilt = dice((2,), -2.0, 2.0)
    tilt = jnp.deg2rad(tilt[0] + tilt[1] * s + roll)
    forward = aim - position
    forward = forward / jnp.linalg.norm(forward, axis=-1, keepdims=True)
    right = jnp.cross(forward, jnp.array([[0.0, 0.0, 1.0]]))
    right = right / jnp.linalg.norm(right, axis=-1, keepdims=True)
    down = jnp.cross(forward, right)
    c, k = jnp.cos(tilt)[:, None], jnp.sin(tilt)[:, None]
    axes = jnp.stack([c * right + k * down, c * down - k * right, forward, position], -1)
    last = jnp.broadcast_to(jnp.array([[[0.0, 0.0, 0.0, 1.0]]]), (n, 1, 4))
    return {
        "c2w": jnp.concatenate([axes, last], 1),
        "fov": dice((), 45.0, 75.0),
    }


def _soft_clip(x: Array, low: Array, high: Array) -> Array:
    """Smoothly keep points `[n,3]` between bounds `[3]`: nearly the identity away from them."""
    middle, half = (low + high)[None] / 2, (high - low)[None] / 2
    y = (x - middle) / half
    return middle + half * y / (1.0 + jnp.abs(y) ** 8) ** (1 / 8)


def clear_views(scene: SceneParams, c2w: Array) -> SceneParams:
    """Shrink objects (towards their lowest point) until each camera has `CLEARANCE` around it.

    Objects are also kept from filling a view: their bounding radius stays below 0.55 of the
    distance to the nearest camera. What would become tiny sinks below the floor.
    """
    centre, half = scene.centre[:OBJECTS], scene.half[:OBJECTS]
    turn = scene.rotation[:OBJECTS]
    drop = jnp.sum(jnp.abs(turn[:, 2]) * half, -1)  # centre to the lowest point of the bounds
    radius = jnp.linalg.norm(half, axis=-1)
    position = c2w[:, None, :3, 3]  # [v, 1, 3]
    # Distance to the segment along which the centre moves while shrinking.
    clamped = jnp.clip(position[..., 2], centre[None, :, 2] - drop[None], centre[None, :, 2])
    nearest = jnp.concatenate(
        [jnp.broadcast_to(centre[None, :, :2], (*clamped.shape, 2)), clamped[..., None]], -1
    )
    distance = jnp.linalg.norm(position - nearest, axis=-1).min(0)
    allowed = jnp.minimum(distance - CLEARANCE, 0.55 * distance)
    factor = jnp.clip(allowed / radius, 0.0, 1.0)
    gone = factor < 0.2
    factor = jnp.where(gone, 0.2, factor)
    height = centre[:, 2] - drop + factor * drop
    height = jnp.where(gone, -2.0 - radius, height)
    return dataclasses.replace(
        scene,
        centre=scene.centre.at[:OBJECTS, 2].set(height),
        half=scene.half.at[:OBJECTS].set(half * factor[:, None]),
    )


def intrinsics(fov: Array | float, height: int, width: int) -> Array:
    """K `[3,3]` in pixels of a centred camera with horizontal field of view `fov` (degrees)."""
    focal = 0.5 * width / jnp.tan(jnp.deg2rad(fov) / 2)
    zero, one = jnp.zeros_like(focal), jnp.ones_like(focal)
    rows = [focal, zero, one * width / 2, zero, focal, one * height / 2, zero, zero, one]
    return jnp.stack(rows).reshape(3, 3)


def varied_cameras(seed: Array, n: int, height: int, width: int) -> tuple[Array, Array]:
    """Orbit in degrees `[]` and K `[n,3,3]` of a training sequence: what a camera may do beyond one fixed lens.

    The lens is constant, zooms smoothly along the path, or differs from view to view, a third each; the principal
    point lies off the centre, by up to a tenth of the image, in half of the sequences.
    """
    dice = Dice(jax.random.fold_in(jax.random.key(seed), 11), n + 16)
    orbit = jnp.exp(dice((), *np.log(VARIED_SWEEP)))
    kind = dice.pick((), (1 / 3, 1 / 3, 1 / 3))
    zoom = dice((), -0.6, 0.6) * jnp.linspace(-1.0, 1.0, n)
    jitter = dice((n,), -0.35, 0.35)
    log_fov = dice((), *np.log(VARIED_FOV)) + jnp.stack([jnp.zeros(n), zoom, jitter])[kind]
    K = jax.vmap(lambda fov: intrinsics(fov, height, width))(jnp.exp(log_fov).clip(*VARIED_FOV))
    shift = dice((2,), -0.1, 0.1) * (dice() < 0.5) * jnp.array([width, height])
    return orbit, K.at[:, :2, 2].add(shift[None])


def handheld_cameras(seed: Array, n: int) -> dict[str, Any]:
    """Options of `camera_path` for photos taken by hand: few, from all around, also from above and close, and rolled.

    Every view is rolled by up to 10 degrees of its own; along a third of the paths the camera turns by up to 120 more.
    """
    dice = Dice(jax.random.fold_in(jax.random.key(seed), 13), n + 16)
    orbit = jnp.exp(dice((), *np.log(HANDHELD_SWEEP)))
    turned = dice((), -120.0, 120.0) * (dice() < 1 / 3)
    roll = dice((n,), -10.0, 10.0) + turned * jnp.linspace(-0.5, 0.5, n)
    return {"sweep": (orbit, orbit), "heights": (0.7, 3.2), "distances": (0.3, 1.0), "roll": roll}


@functools.partial(
    jax.jit,
    static_argnames=(
        *("frames", "height", "width", "supersample", "sweep"),
        *("depth", "varied", "handheld"),
    ),
)
def _sequence(
    seed, textures, *, frames, height, width, supersample, sweep, depth, varied, handheld
):
    options = {"sweep": sweep}
    if varied:
        orbit, K = varied_cameras(seed, frames, height, width)
        options = {"sweep": (orbit, orbit)}
    if handheld:
        options = handheld_cameras(seed, frames)
    scene = make_scene(seed, textures=textures)
    path = camera_path(seed, frames, scene=scene, **options)
    dense = camera_path(seed, _PATH_SAMPLES, scene=scene, **options | {"roll": 0.0})
    scene = clear_views(scene, dense["c2w"])
    if not varied:
        K = jnp.repeat(intrinsics(path["fov"], height, width)[None], frames, 0)

    def one(view):
        K, c2w = view
        drawn = render(scene, K, c2w, height=height, width=width, supersample=supersample)
        rgb = jnp.round(drawn["rgb"] * 255).astype(jnp.uint8)
        return (rgb, drawn["depth"]) if depth else (rgb, jnp.zeros(()))

    return *jax.lax.map(one, (K, path["c2w"])), K, path["c2w"]


def sample_sequence(
    seed: int,
    *,
    frames: int = 24,
    height: int = 64,
    width: int = 112,
    supersample: int = 2,
    sweep: tuple[float, float] = SWEEP,
    depth: bool = True,
    varied: bool = False,
    handheld: bool = False,
    textures: Array | None = None,
) -> dict[str, np.ndarray]:
    """The views of one scene along one smooth path.

    Args:
        sweep: degrees of orbit over the path, drawn uniformly.
        varied: the training distribution: orbits and lenses of `varied_cameras` in place of `sweep` and one
            centred lens of 45 to 75 degrees.
        handheld: the cameras of `handheld_cameras` in place of `sweep`; with `varied` its lenses.
        textures: another set of `load_textures` than the split's own.

    Returns:
        `rgb` uint8 `[f,h,w,3]`, `depth` float32 `[f,h,w]` (z-depth; sky `SKY_DEPTH`; absent with
        `depth=False`), `K` float64 `[f,3,3]` pixels, `c2w` float64 `[f,4,4]` OpenCV.

    Raises:
        UserError: the seed is outside 0 .. 2^31 - 1.
    """
    if textures is None:
        textures = _device_textures(split_of(seed))
    rgb, z, K, c2w = _sequence(
        np.int32(seed),
        textures,
        frames=frames,
        height=height,
        width=width,
        supersample=supersample,
        sweep=tuple(map(float, sweep)),
        depth=depth,
        varied=varied,
        handheld=handheld,
    )
    out = {
        "rgb": np.asarray(rgb),
        "K": np.asarray(K, np.float64),
        "c2w": np.asarray(c2w, np.float64),
    }
    return out | {"depth": np.asarray(z)} if depth else out


@functools.cache
def _device_textures(split: str) -> Array:
    return jnp.asarray(load_textures(split))
