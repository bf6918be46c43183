"""Ray casting of a procedural scene in plain JAX: exact depth, shadows, mip-mapped textures.

Written for XLA on CPU: ray components are separate `[p]` arrays, primitives run through `lax.scan`,
and `optimization_barrier` keeps fusions from recomputing their producers (19 times slower without).
World frame: z up, floor at z = 0, metres in spirit. Cameras are OpenCV (x right, y down, z forward).
"""

import functools

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from roge_jax.procedural.textures import LEVELS, SIDE, TEXELS

BOXES, ELLIPSOIDS, CYLINDERS = 6, 3, 3
OBJECTS = BOXES + ELLIPSOIDS + CYLINDERS
ROOM = OBJECTS  # the enclosure is the last primitive: a box seen from inside
FACES = 6  # -x, +x, -y, +y, -z, +z; curved sides are face 0
SKY_MATERIAL = (OBJECTS + 1) * FACES
MATERIALS = SKY_MATERIAL + 1
CLOSED, YARD, OPEN = 0, 1, 2  # room with ceiling; walls under the sky; open ground
SKY_DEPTH = 1000.0  # z-depth of sky pixels: finite, so that warping by it stays well defined
RAYS_PER_CHUNK = 8192  # larger arrays fall out of the CPU caches


@struct.dataclass
class Materials:
    """One row per face: `texture [k]` int32, `uv [k,2,2]` (repeats per unit), `offset [k,2]`,
    `tint [k,3]`, `gloss [k]`."""

    texture: Array
    uv: Array
    offset: Array
    tint: Array
    gloss: Array


@struct.dataclass
class SceneParams:
    """A scene: 12 primitives and the enclosure (last row), materials, light, sky, colour grade.

    `centre [13,3]`, `rotation [13,3,3]` (local to world), `half [13,3]` half extents; `enclosure`
    is CLOSED, YARD or OPEN; `light [3]` a point; `fill [3]` the direction of an unshadowed light;
    `camera_low/high [3]` bounds of camera centres; `focus [3]` the middle of the content.
    """

    centre: Array
    rotation: Array
    half: Array
    materials: Materials
    enclosure: Array
    light: Array
    light_colour: Array
    light_reach: Array
    fill: Array
    ambient: Array  # [2,3]: from below, from above
    sky: Array  # [2,3]: horizon, zenith
    haze: Array
    saturation: Array
    exposure: Array
    camera_low: Array
    camera_high: Array
    focus: Array
    textures: Array


def _fence(*arrays):
    return jax.lax.optimization_barrier(arrays)


def _safe(x: Array) -> Array:
    """x with zeros replaced by a tiny number, for divisions."""
    return jnp.where(jnp.abs(x) < 1e-9, 1e-9, x)


def _slab(o: Array, d: Array) -> tuple[Array, Array]:
    """Ray parameters entering and leaving |x| <= 1."""
    inverse = 1.0 / _safe(d)
    near, far = (-1.0 - o) * inverse, (1.0 - o) * inverse
    return jnp.minimum(near, far), jnp.maximum(near, far)


def _quadratic(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Roots of a t^2 + 2 b t + c; an empty interval if there are none."""
    a = jnp.maximum(a, 1e-12)
    disc = b * b - a * c
    root = jnp.sqrt(jnp.maximum(disc, 0.0))
    hit = disc > 0
    return jnp.where(hit, (-b - root) / a, jnp.inf), jnp.where(hit, (root - b) / a, -jnp.inf)


def _box(ox, oy, oz, dx, dy, dz):
    (x0, x1), (y0, y1), (z0, z1) = _slab(ox, dx), _slab(oy, dy), _slab(oz, dz)
    return jnp.maximum(jnp.maximum(x0, y0), z0), jnp.minimum(jnp.minimum(x1, y1), z1)


def _ellipsoid(ox, oy, oz, dx, dy, dz):
    a, b = dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz
    return _quadratic(a, b, ox * ox + oy * oy + oz * oz - 1.0)


def _cylinder(ox, oy, oz, dx, dy, dz):
    r0, r1 = _quadratic(dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - 1.0)
    z0, z1 = _slab(oz, dz)
    return jnp.maximum(r0, z0), jnp.minimum(r1, z1)


def _first_hit(scene: SceneParams, origin: Array, rays, start: float) -> tuple[Array, Array]:
    """Nearest entry `t > start` into an object along `origin + t rays`: (t [p], object index [p])."""
    dx, dy, dz = rays
    # Local frame: R^T (o - c) / half, and the same for directions.
    to_local = scene.rotation.swapaxes(1, 2) / scene.half[:, :, None]
    local_origin = jnp.einsum("kij,kj->ki", to_local, origin[None] - scene.centre)
    best = (jnp.full_like(dx, jnp.inf), jnp.full(dx.shape, ROOM))
    first = 0
    for intersect, count in ((_box, BOXES), (_ellipsoid, ELLIPSOIDS), (_cylinder, CYLINDERS)):

        def step(best, inputs, intersect=intersect):
            m, o, index = inputs
            local = [m[i, 0] * dx + m[i, 1] * dy + m[i, 2] * dz for i in range(3)]
            near, far = intersect(o[0], o[1], o[2], *local)
            closer = (near < far) & (near > start) & (near < best[0])
            return (jnp.where(closer, near, best[0]), jnp.where(closer, index, best[1])), None

        rows = slice(first, first + count)
        indices = jnp.arange(first, first + count)
        best, _ = jax.lax.scan(step, best, (to_local[rows], local_origin[rows], indices))
        first += count
    return best


def _leave_room(scene: SceneParams, origin: Array, rays) -> tuple[Array, Array]:
    """Where rays leave the enclosure: (t [p], True where that is sky [p])."""
    half, o = scene.half[ROOM], origin - scene.centre[ROOM]
    exits = [_slab(o[i] / half[i], rays[i] / half[i])[1] for i in range(3)]
    t = jnp.minimum(jnp.minimum(exits[0], exits[1]), exits[2])
    vertical = exits[2] <= t
    ceiling = vertical & (rays[2] > 0)
    sky = (scene.enclosure >= YARD) & ceiling | (scene.enclosure == OPEN) & ~vertical
    return t, sky


def _trace(scene: SceneParams, origin: Array, rays):
    """First surface along the rays: (t, primitive index, sky)."""
    t, index = _first_hit(scene, origin, rays, 1e-3)
    wall, sky = _leave_room(scene, origin, rays)
    t, index, wall, sky = _fence(t, index, wall, sky)
    sky = sky & (index == ROOM)
    t = jnp.where(sky, SKY_DEPTH, jnp.minimum(t, wall))
    return _fence(t, index, sky)


def _surface(scene: SceneParams, index: Array, point):
    """World normal (3 x [p]), face [p] and surface coordinates in world units (2 x [p])."""
    centre, half = scene.centre.T[:, index], scene.half.T[:, index]
    turn = scene.rotation.transpose(1, 2, 0)[:, :, index]
    offset = [point[i] - centre[i] for i in range(3)]
    metric = [sum(turn[i, k] * offset[i] for i in range(3)) for k in range(3)]
    metric = _fence(*metric)
    x, y, z = (metric[k] / half[k] for k in range(3))
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    ball = (index >= BOXES) & (index < BOXES + ELLIPSOIDS)
    tube = (index >= BOXES + ELLIPSOIDS) & (index < ROOM)
    on_z = jnp.where(tube, az * az >= x * x + y * y, (az >= ax) & (az >= ay)) & ~ball
    on_y = ~on_z & (ay > ax)
    curved = ball | (tube & ~on_z)
    sign_x, sign_y, sign_z = jnp.sign(x), jnp.sign(y), jnp.sign(z)
    nx = jnp.where(curved, x / half[0], jnp.where(on_z | on_y, 0.0, sign_x))
    ny = jnp.where(curved, y / half[1], jnp.where(on_y, sign_y, 0.0))
    nz = jnp.where(curved, jnp.where(ball, z / half[2], 0.0), jnp.where(on_z, sign_z, 0.0))
    inward = jnp.where(index == ROOM, -1.0, 1.0)
    scale = inward * jax.lax.rsqrt(jnp.maximum(nx * nx + ny * ny + nz * nz, 1e-12))
    local = (nx * scale, ny * scale, nz * scale)
    normal = [sum(turn[i, k] * local[k] for k in range(3)) for i in range(3)]
    axis = jnp.where(on_z, 2, jnp.where(on_y, 1, 0))
    positive = jnp.where(on_z, z, jnp.where(on_y, y, x)) > 0
    face = jnp.where(curved, 0, 2 * axis + positive)
    around = jnp.arctan2(y, x) * jnp.maximum(half[0], half[1])
    height = jnp.where(ball, jnp.arcsin(jnp.clip(z, -1.0, 1.0)) * half[2], metric[2])
    u = jnp.where(curved, around, jnp.where(on_z | ~on_y, metric[1], metric[0]))
    u = jnp.where(on_z, metric[0], u)
    v = jnp.where(curved, height, jnp.where(on_z, metric[1], metric[2]))
    return _fence(*normal), face, (u, v)


def _texture(scene: SceneParams, material: Array, u: Array, v: Array, footprint: Array):
    """Albedo (3 x [p], sRGB-like) of mirrored-repeat textures at the mip level of the footprint."""
    m = scene.materials
    uv = m.uv.reshape(-1, 4).T[:, material]
    s = uv[0] * u + uv[1] * v + m.offset[:, 0][material]
    t = uv[2] * u + uv[3] * v + m.offset[:, 1][material]
    repeats = jnp.sqrt(jnp.abs(uv[0] * uv[3] - uv[1] * uv[2]))
    texels = jnp.maximum(footprint * repeats * SIDE, 1.0)
    level = jnp.clip(jnp.round(jnp.log2(texels)), 0, LEVELS - 1).astype(jnp.int32)
    side = SIDE >> level
    # Texels before a level: SIDE^2 (1 - 4^-level) / (1 - 1/4).
    base = m.texture[material] * TEXELS + (4 * SIDE * SIDE - 4 * side * side) // 3
    size = side.astype(jnp.float32)
    x, y = (jnp.abs((c * 0.5 - jnp.floor(c * 0.5)) * 2.0 - 1.0) * size - 0.5 for c in (s, t))
    x, y = jnp.clip(x, 0.0, size - 1.0), jnp.clip(y, 0.0, size - 1.0)
    x0, y0 = x.astype(jnp.int32), y.astype(jnp.int32)
    x1, y1 = jnp.minimum(x0 + 1, side - 1), jnp.minimum(y0 + 1, side - 1)
    fx, fy = x - x0, y - y0
    base, side, x0, x1, y0, y1, fx, fy = _fence(base, side, x0, x1, y0, y1, fx, fy)
    flat = scene.textures.reshape(-1)
    corners = [base + row * side + column for row in (y0, y1) for column in (x0, x1)]
    taps = _fence(*(flat.at[corner].get(mode="promise_in_bounds") for corner in corners))
    weights = ((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy)
    rgb = []
    for shift in (0, 8, 16):
        channel = [((tap >> shift) & 255).astype(jnp.float32) for tap in taps]
        mixed = sum(w * c for w, c in zip(weights, channel, strict=True)) / 255.0
        rgb.append(mixed * m.tint[:, shift // 8][material])
    return _fence(*rgb)


def _shade(scene: SceneParams, origin: Array, rays, pixel: Array):
    """Linear colour (3 x [p]) along rays; `pixel` is the pixel size at unit depth."""
    t, index, sky = _trace(scene, origin, rays)
    dx, dy, dz = rays
    point = [origin[i] + t * rays[i] for i in range(3)]
    normal, face, (u, v) = _surface(scene, index, point)
    length = jnp.sqrt(dx * dx + dy * dy + dz * dz)
    facing = -(normal[0] * dx + normal[1] * dy + normal[2] * dz) / length
    # Clouds: the sky's texture on a plane overhead.
    lift = jnp.maximum(dz / length, 0.0) + 0.15
    u = jnp.where(sky, dx / length / lift, u)
    v = jnp.where(sky, dy / length / lift, v)
    footprint = jnp.where(sky, 1.0 / lift, t * length / jnp.sqrt(jnp.maximum(facing, 0.04))) * pixel
    material = jnp.where(sky, SKY_MATERIAL, index * FACES + face)
    material, u, v, footprint, facing = _fence(material, u, v, footprint, facing)
    albedo = _texture(scene, material, u, v, footprint)

    # Shadow rays run from the light to the point, so that they share one origin.
    beam = [point[i] - scene.light[i] for i in range(3)]
    distance = jnp.sqrt(beam[0] ** 2 + beam[1] ** 2 + beam[2] ** 2)
    blocked, _ = _first_hit(scene, scene.light, beam, 1e-3)
    lit = jnp.where(blocked > 0.997, 1.0, 0.0)
    lit, distance = _fence(lit, distance)
    toward = [-b / distance for b in beam]
    lambert = jnp.maximum(sum(n * b for n, b in zip(normal, toward, strict=True)), 0.0)
    reach = scene.light_reach**2
    strength = lit * reach / (reach + distance * distance)
    half = [toward[i] - rays[i] / length for i in range(3)]
    norm = jnp.sqrt(jnp.maximum(half[0] ** 2 + half[1] ** 2 + half[2] ** 2, 1e-12))
    glint = jnp.maximum(sum(n * h for n, h in zip(normal, half, strict=True)) / norm, 0.0) ** 24
    glint = scene.materials.gloss[material] * glint
    fill = jnp.maximum(sum(normal[i] * scene.fill[i] for i in range(3)), 0.0)
    above = 0.5 + 0.5 * normal[2]
    # Corners darken towards the floor: a cheap stand-in for ambient occlusion.
    ground = 1.0 - 0.35 * jnp.exp(-jnp.maximum(point[2], 0.0) * 5.0) * (1.0 - above)
    strength, lambert, glint, fill, above = _fence(strength, lambert, glint, fill * ground, above)
    horizon = jnp.clip(dz / length * 1.6, 0.0, 1.0)
    clouds = (albedo[0] + albedo[1] + albedo[2]) / 3.0
    clouds = jnp.clip(clouds * 1.6 - 0.5, 0.0, 1.0) * (0.15 + 0.85 * horizon)
    fog = 1.0 - jnp.exp(-scene.haze * t * length)
    colour = []
    for i in range(3):
        ambient = scene.ambient[0, i] + (scene.ambient[1, i] - scene.ambient[0, i]) * above
        light = scene.light_colour[i] * strength
        shade = albedo[i] ** 2 * (ambient * ground + light * lambert + 0.25 * fill) + light * glint
        air = scene.sky[0, i] + (scene.sky[1, i] - scene.sky[0, i]) * horizon
        solid = shade + (scene.sky[0, i] - shade) * fog
        colour.append(jnp.where(sky, air + (0.9 - air) * clouds, solid))
    return _fence(*colour)


def _develop(scene: SceneParams, linear):
    """Linear (3 x [p]) to display values in [0, 1]: exposure, shoulder, gamma 2, saturation."""
    display = []
    for channel in linear:
        x = channel * scene.exposure
        display.append(jnp.sqrt(jnp.clip(x * (1.0 + x / 4.0) / (1.0 + x), 0.0, 1.0)))
    display = _fence(*display)
    grey = sum(display) / 3.0
    return _fence(*(jnp.clip(grey + (x - grey) * scene.saturation, 0.0, 1.0) for x in display))


def _rays(K: Array, c2w: Array, x: Array, y: Array):
    """World directions (3 x [p]) of pixel positions with unit depth: t along them is z-depth."""
    px, py = (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]
    return [c2w[i, 0] * px + c2w[i, 1] * py + c2w[i, 2] for i in range(3)]


def render(
    scene: SceneParams,
    K: Array,
    c2w: Array,
    *,
    height: int,
    width: int,
    supersample: int = 2,
    rays_per_chunk: int = RAYS_PER_CHUNK,
) -> dict[str, Array]:
    """One view: `{"rgb": [h,w,3] in [0,1], "depth": [h,w]}`, float32; trace it inside jit.

    Args:
        K: [3,3] pixels, without skew, pixel centres at +0.5, image edges at 0 and `width`.
        c2w: [4,4] camera to world, OpenCV axes.
        supersample: samples per pixel and axis, averaged; depth is exact at the pixel centre.
            Sky pixels have depth `SKY_DEPTH`.
    """
    rows = max(1, min(height, rays_per_chunk // width))
    strips = -(-height // rows)  # the last strip may repeat rows beyond the image; cut off below
    origin, pixel = c2w[:3, 3], 1.0 / (supersample * K[0, 0])
    column, row = jnp.meshgrid(jnp.arange(width), jnp.arange(rows))
    column, row = column.reshape(-1).astype(jnp.float32), row.reshape(-1).astype(jnp.float32)
    steps = (jnp.arange(supersample) + 0.5) / supersample
    offsets = jnp.stack(jnp.meshgrid(steps, steps), -1).reshape(-1, 2)

    def strip(top):
        def sample(total, offset):
            rays = _fence(*_rays(K, c2w, column + offset[0], row + top + offset[1]))
            colour = _develop(scene, _shade(scene, origin, rays, pixel))
            return tuple(t + c for t, c in zip(total, colour, strict=True)), None

        total, _ = jax.lax.scan(sample, 3 * (jnp.zeros(rows * width),), offsets)
        rays = _fence(*_rays(K, c2w, column + 0.5, row + top + 0.5))
        return total, _trace(scene, origin, rays)[0]

    # Channels are added up: a concatenation would be fused with its producers and compute every one
    # of them again for every element (with one strip and one sample 20 times slower, unoptimised 600).
    total, depth = jax.lax.map(strip, jnp.arange(strips) * float(rows))
    parts = zip(total, jnp.eye(3), strict=True)
    rgb = sum(x[..., None] * unit[None, None] for x, unit in parts) / supersample**2
    return {
        "rgb": rgb.reshape(strips * rows, width, 3)[:height],
        "depth": depth.reshape(strips * rows, width)[:height],
    }


@functools.partial(jax.jit, static_argnames=("height", "width", "supersample"))
def render_views(
    scene: SceneParams, K: Array, c2w: Array, *, height: int, width: int, supersample: int = 2
) -> dict[str, Array]:
    """`render` over views `K [v,3,3]`, `c2w [v,4,4]`: `{"rgb": [v,h,w,3], "depth": [v,h,w]}`."""

    def one(view):
        return render(scene, *view, height=height, width=width, supersample=supersample)

    return jax.lax.map(one, (K, c2w))
