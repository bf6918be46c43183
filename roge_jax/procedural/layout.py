"""Where things stand in a procedural scene and what they wear: random layouts and materials."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roge_jax.procedural.raycast import (
    BOXES,
    CYLINDERS,
    ELLIPSOIDS,
    FACES,
    MATERIALS,
    OBJECTS,
    ROOM,
    SKY_MATERIAL,
    Materials,
)
from roge_jax.procedural.textures import NOISES, PHOTOS


class Dice:
    """Uniform numbers in the order they are asked for: one draw, which compiles in no time."""

    def __init__(self, key: Array, count: int):
        self._rest = jax.random.uniform(key, (count,))

    def __call__(self, shape: tuple[int, ...] = (), low=0.0, high=1.0) -> Array:
        count = int(np.prod(shape))
        assert count <= len(self._rest)
        draw, self._rest = self._rest[:count].reshape(shape), self._rest[count:]
        return low + (high - low) * draw

    def index(self, shape: tuple[int, ...], low: int, high: int) -> Array:
        """Integers low .. high - 1."""
        return low + jnp.minimum((self(shape) * (high - low)).astype(jnp.int32), high - low - 1)

    def pick(self, shape: tuple[int, ...], weights: tuple[float, ...]) -> Array:
        """Indices into `weights`, which sum to 1."""
        limits = jnp.cumsum(jnp.array(weights))[:-1].reshape(-1, *(1 for _ in shape))
        return jnp.sum(self(shape)[None] >= limits, 0)

    def turns(self, count: int) -> Array:
        """Uniform rotations `[count,3,3]`, from unit quaternions."""
        u = self((3, count))
        a, b = jnp.sqrt(1 - u[0]), jnp.sqrt(u[0])
        t, r = 2 * jnp.pi * u[1], 2 * jnp.pi * u[2]
        x, y, z, w = a * jnp.sin(t), a * jnp.cos(t), b * jnp.sin(r), b * jnp.cos(r)
        rows = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
        rows += [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
        rows += [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
        return jnp.stack(rows, -1).reshape(-1, 3, 3)


def _spin(angle: Array) -> Array:
    """Rotations about z, `[k] -> [k,3,3]`."""
    c, s, o = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
    return jnp.stack([c, -s, o, s, c, o, o, o, o + 1.0], -1).reshape(-1, 3, 3)


def place_objects(dice: Dice, room: Array, reach: Array, focus: Array, is_open: Array):
    """Centres `[12,3]`, rotations `[12,3,3]` and half extents `[12,3]` of the movable primitives.

    Boxes 0-1 hang on the walls (buildings on open ground), 2 is tall, the others are furniture;
    some ellipsoids and cylinders stand on furniture, some float or lie.
    """
    wide = jnp.exp(dice((OBJECTS, 3), jnp.log(0.16), jnp.log(0.6)))
    ball = jnp.exp(dice((ELLIPSOIDS, 1), jnp.log(0.18), jnp.log(0.5)))
    ball = ball * dice((ELLIPSOIDS, 3), 0.7, 1.15)
    tube = jnp.exp(dice((CYLINDERS,), jnp.log(0.1), jnp.log(0.38)))
    tall = jnp.exp(dice((CYLINDERS,), jnp.log(0.15), jnp.log(0.9)))
    half = wide.at[BOXES : BOXES + ELLIPSOIDS].set(ball)
    half = half.at[BOXES + ELLIPSOIDS :].set(jnp.stack([tube, tube, tall], -1))
    half = half.at[2, 2].set(dice((), 0.6, 1.2))
    # Furniture and the rest: spread over a disc around the focus, standing on the floor.
    angle = dice((), 0, 2 * jnp.pi) + 2.4 * jnp.arange(OBJECTS)  # golden angle
    angle = angle + dice((OBJECTS,), -0.5, 0.5)
    radius = reach * dice((OBJECTS,), 0.05, 0.72)
    flat = focus[None, :2] + radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    centre = jnp.concatenate([flat, half[:, 2:]], -1)
    rotation = _spin(dice((OBJECTS,), 0, 2 * jnp.pi))
    # Some round things stand on a piece of furniture, some float, some cylinders lie.
    base = dice.index((OBJECTS,), 2, BOXES)
    style = dice.pick((OBJECTS,), (0.45, 0.35, 0.2))  # floor, furniture, floating
    is_round = jnp.arange(OBJECTS) >= BOXES
    top = centre[base].at[:, 2].set(2 * half[base, 2] + half[:, 2])
    nudge = jnp.append(dice((2,), -0.1, 0.1), 0.0)
    centre = jnp.where((is_round & (style == 1))[:, None], top + nudge[None], centre)
    floating = (jnp.arange(OBJECTS) >= 3) & (style == 2) & (jnp.arange(OBJECTS) % 2 == 1)
    lift = jnp.where(floating, dice((OBJECTS,), 0.2, 1.1), 0.0)
    tilt = dice.turns(OBJECTS)
    lying = (jnp.arange(OBJECTS) >= BOXES + ELLIPSOIDS) & (style == 0)
    lying = lying & (half[:, 2] < 0.5)
    down = rotation @ jnp.array([[[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]])
    rotation = jnp.where(floating[:, None, None], tilt, rotation)
    rotation = jnp.where(lying[:, None, None], down, rotation)
    centre = centre.at[:, 2].add(lift)
    centre = centre.at[:, 2].set(jnp.where(lying, half[:, 0], centre[:, 2]))
    return _hang_panels(dice, centre, rotation, half, room, is_open)


def _hang_panels(dice, centre, rotation, half, room, is_open):
    """Boxes 0 and 1 become panels on walls; on open ground, buildings around the content."""
    wall = dice.index((2,), 0, 4) + jnp.array([0, 1])
    normal = jnp.stack([jnp.cos(wall * jnp.pi / 2), jnp.sin(wall * jnp.pi / 2)], -1).round()
    size = dice((2, 3), jnp.array([[0.02, 0.4, 0.3]]), jnp.array([[0.2, 1.1, 0.9]]))
    along = dice((2, 1), -0.6, 0.6)
    side = jnp.stack([-normal[:, 1], normal[:, 0]], -1)
    flat = normal * (room[None, :2] - size[:, :1]) + side * along * room[None, :2]
    rise = dice((2, 1), 0.0, 1.0)
    rise = size[:, 2:] + rise * jnp.maximum(2 * room[2] - 2 * size[:, 2:], 0.0)
    house = dice((2, 3), jnp.array([[0.5, 1.0, 0.7]]), jnp.array([[1.5, 2.5, 2.0]]))
    far = normal * dice((2, 1), 6.5, 9.0) + side * along * 8.0
    size = jnp.where(is_open, house, size)
    place = jnp.where(
        is_open, jnp.concatenate([far, house[:, 2:]], -1), jnp.concatenate([flat, rise], -1)
    )
    turn = _spin(wall * (jnp.pi / 2) + jnp.where(is_open, along[:, 0], 0.0))
    return centre.at[:2].set(place), rotation.at[:2].set(turn), half.at[:2].set(size)


def choose_materials(dice: Dice, is_open: Array) -> Materials:
    """A texture, placement, tint and gloss for every face; objects share theirs between faces."""
    owner = jnp.arange(MATERIALS) // FACES
    face = jnp.arange(MATERIALS) % FACES
    photo = dice.index((MATERIALS,), 0, PHOTOS)
    noise = dice.index((MATERIALS,), PHOTOS, PHOTOS + NOISES)
    likely = jnp.where(owner < OBJECTS, 0.65, 0.55)
    texture = jnp.where(dice((MATERIALS,)) < likely, photo, noise)
    # Half of the objects wear one texture on all faces; rooms have one wallpaper half of the time.
    uniform_look = dice((OBJECTS + 2,)) < 0.5
    shared = uniform_look[owner] & ((owner < OBJECTS) | (face < 4))
    texture = jnp.where(shared, texture[owner * FACES], texture)
    texture = texture.at[SKY_MATERIAL].set(noise[SKY_MATERIAL] // 8 * 8)  # fractal clouds
    # World size of one texture: objects small, walls and floors large.
    spread = dice((MATERIALS,), 0.0, 1.0)
    small, large = jnp.exp(jnp.log(0.35) + 1.5 * spread), jnp.exp(jnp.log(0.9) + 1.5 * spread)
    size = jnp.where(owner == ROOM, jnp.where(is_open, 1.6 * large, large), small)
    size = size.at[SKY_MATERIAL].set(4.0)
    angle = dice.index((MATERIALS,), 0, 4) * (jnp.pi / 2)
    skew = dice((MATERIALS,), 0, 2 * jnp.pi)
    free = dice((MATERIALS,)) < 0.25
    angle = jnp.where(free, skew, angle)
    c, s = jnp.cos(angle), jnp.sin(angle)
    tint = dice((MATERIALS, 1), 0.75, 1.1)
    tint = tint * (1.0 + dice((MATERIALS, 3), -0.12, 0.12))
    shiny = dice((OBJECTS + 2,)) < 0.4
    gloss = jnp.where(shiny, dice((OBJECTS + 2,), 0.1, 0.5), 0.0)
    return Materials(
        texture=texture,
        uv=jnp.stack([c, -s, s, c], -1).reshape(-1, 2, 2) / size[:, None, None],
        offset=dice((MATERIALS, 2), 0.0, 2.0),
        tint=tint,
        gloss=jnp.where(owner < OBJECTS, gloss[owner], 0.3 * gloss[owner]),
    )
