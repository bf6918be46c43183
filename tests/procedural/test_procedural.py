"""Procedural scenes: exact depth, conventions, determinism, splits, one trace, pools."""

import multiprocessing

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from roge_jax.data.dataset import _missing, read_dataset, write_dataset
from roge_jax.errors import UserError
from roge_jax.procedural import __main__ as program
from roge_jax.procedural import raycast
from roge_jax.procedural import scenes as procedural
from roge_jax.procedural.scenes import (
    HELDOUT_SEED,
    SKY_DEPTH,
    camera_path,
    clear_views,
    intrinsics,
    make_scene,
    render,
    sample_sequence,
    split_of,
)
from roge_jax.procedural.textures import (
    NOISE_SEEDS,
    NOISES,
    PHOTO_NAMES,
    PHOTOS,
    TEXELS,
    folder_pictures,
    load_textures,
)

SMALL = {"frames": 5, "height": 24, "width": 40, "supersample": 1}
SEEDS = range(10)

_scenes = jax.jit(lambda seed, textures: make_scene(seed, textures=textures))
_views = jax.jit(render, static_argnames=("height", "width", "supersample", "rays_per_chunk"))
_trace = jax.jit(raycast._trace)
_paths = jax.jit(lambda seed, scene, n: camera_path(seed, n, scene=scene), static_argnames="n")


@pytest.fixture(scope="module")
def textures():
    return jnp.asarray(load_textures("train"))


def _plain_textures():
    """White everywhere: enough where only geometry matters."""
    return jnp.full((PHOTOS + NOISES, TEXELS), 0xFFFFFF, jnp.uint32)


def test_same_seed_same_scene_and_other_seeds_differ():
    first, again, other = (sample_sequence(seed, **SMALL) for seed in (3, 3, 4))
    for name in first:
        np.testing.assert_array_equal(first[name], again[name])
        assert not np.array_equal(first[name], other[name])


def test_sequence_shapes_and_ranges():
    scene = sample_sequence(1, **SMALL)
    assert scene["rgb"].shape == (5, 24, 40, 3) and scene["rgb"].dtype == np.uint8
    assert scene["depth"].shape == (5, 24, 40) and scene["depth"].dtype == np.float32
    assert scene["K"].shape == (5, 3, 3) and scene["c2w"].shape == (5, 4, 4)
    assert scene["K"].dtype == scene["c2w"].dtype == np.float64
    assert scene["depth"].min() > 0 and scene["depth"].max() <= SKY_DEPTH


def test_pictures_are_exposed_and_rich():
    """No scene is black, burnt out or one flat colour."""
    for seed in SEEDS:
        rgb = sample_sequence(seed, **SMALL)["rgb"] / 255.0
        assert 0.1 < rgb.mean() < 0.9
        assert rgb.std((1, 2)).mean() > 0.06
        assert (rgb > 0.996).mean() < 0.3


def test_frame_count_does_not_change_the_path():
    """The first and last view of a path are the same however many lie between."""
    scene = _scenes(np.int32(2), _plain_textures())
    few, many = (_paths(np.int32(2), scene, n=n) for n in (2, 24))
    np.testing.assert_allclose(few["c2w"], many["c2w"][np.array([0, -1])], atol=1e-5)
    assert few["fov"] == many["fov"]


def _view(seed, index):
    """Scene, K, pose, depth and pixel rays (camera frame, unit z) of one of 24 views, float64."""
    scene = _scenes(np.int32(seed), _plain_textures())
    path = _paths(np.int32(seed), scene, n=24)
    K, c2w = intrinsics(path["fov"], 24, 40), path["c2w"][index]
    depth = _views(scene, K, c2w, height=24, width=40, supersample=1)["depth"]
    K, c2w = np.asarray(K, np.float64), np.asarray(c2w, np.float64)
    y, x = (g.ravel() + 0.5 for g in np.mgrid[:24, :40])
    local = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    return scene, path, K, c2w, np.asarray(depth, np.float64).ravel(), local


def _inside(scene, points):
    """How deep points `[p,3]` are in each object, `[p,12]`: a gauge that is 1 on the surface and
    below 1 inside. Written from the definitions of the shapes, without any intersection."""
    objects = slice(0, raycast.OBJECTS)
    offset = points[:, None] - np.asarray(scene.centre, np.float64)[None, objects]
    turn = np.asarray(scene.rotation, np.float64)[objects]
    local = np.einsum("kij,pki->pkj", turn, offset)
    x, y, z = np.moveaxis(local / np.asarray(scene.half, np.float64)[None, objects], -1, 0)
    box = np.max(np.abs([x, y, z]), 0)
    ball = np.sqrt(x**2 + y**2 + z**2)
    tube = np.maximum(np.hypot(x, y), np.abs(z))
    kind = np.repeat([0, 1, 2], [raycast.BOXES, raycast.ELLIPSOIDS, raycast.CYLINDERS])
    return np.choose(kind[None], [box, ball, tube])


@pytest.mark.parametrize("seed", SEEDS)
def test_depth_is_the_first_surface(seed):
    """Every depth ends on the surface of an object or of the enclosure, and the way there is free:
    against the shapes' definitions in float64."""
    scene, _, _, c2w, depth, local = _view(seed, 0)
    world = local @ c2w[:3, :3].T
    end = world * depth[:, None] + c2w[:3, 3]
    low = np.asarray(scene.centre - scene.half, np.float64)[raycast.ROOM]
    high = np.asarray(scene.centre + scene.half, np.float64)[raycast.ROOM]
    wall = np.minimum(np.abs(end - low), np.abs(end - high)).min(-1)
    # Float32 over a few metres (45 on open ground): 1e-6 relative, magnified by small half extents.
    on_object = np.abs(_inside(scene, end) - 1).min(-1) < 1e-3
    sky = depth == SKY_DEPTH
    assert (on_object | (wall < 1e-3) | sky).all()
    assert not (sky & (scene.enclosure == raycast.CLOSED)).any()
    for fraction in np.linspace(0.02, 0.999, 40):
        on_way = world * (np.where(sky, 60.0, depth) * fraction)[:, None] + c2w[:3, 3]
        assert (_inside(scene, on_way) > 1 - 1e-3).all()
        assert ((on_way > low - 1e-3) & (on_way < high + 1e-3)).all(-1)[~sky].all()


@pytest.mark.parametrize("seed", SEEDS)
def test_depth_and_pose_lead_to_the_same_surface(seed):
    """Lift the pixels of a view by exact depth and look at the points from the next view: the ray
    through their (subpixel) images ends there, or on something nearer that covers them."""
    scene, path, K, c2w, depth, local = _view(seed, 0)
    world = (local * depth[:, None]) @ c2w[:3, :3].T + c2w[:3, 3]
    other = np.asarray(path["c2w"][1], np.float64)
    seen = (world - other[:3, 3]) @ other[:3, :3]
    u, v = (K[i, i] * seen[:, i] / seen[:, 2] + K[i, 2] for i in range(2))
    ok = (depth < SKY_DEPTH) & (seen[:, 2] > 0.2) & (u > 0) & (u < 40) & (v > 0) & (v < 24)
    rays = raycast._rays(jnp.asarray(K), path["c2w"][1], jnp.asarray(u), jnp.asarray(v))
    found = np.asarray(_trace(scene, path["c2w"][1, :3, 3], rays)[0], np.float64)
    error = (found / np.where(ok, seen[:, 2], 1.0) - 1)[ok]
    # Float32: 1e-6 relative, magnified by grazing incidence. Nothing may lie behind the point, but
    # for rays that graze an edge.
    assert (error > 1e-3).mean() < 0.01
    # What neighbouring views do not share lies along silhouettes. 12 of them, each as long as a
    # fifth of the 24 rows and covered for about a pixel, are below a tenth of the picture.
    assert (np.abs(error) < 1e-3).mean() > 0.9


def test_varied_lenses_are_those_of_the_pictures():
    """Many lenses and orbits, and the depth of each view is exact through its own K."""
    cameras = jax.jit(procedural.varied_cameras, static_argnums=(1, 2, 3))
    found = [cameras(np.int32(seed), 5, 24, 40) for seed in range(60)]
    orbit = np.array([orbit for orbit, _ in found])
    K = np.stack([K for _, K in found]).astype(np.float64)
    fov = 2 * np.rad2deg(np.arctan(20 / K[:, :, 0, 0]))
    low, high = procedural.VARIED_FOV
    assert low - 1e-3 <= fov.min() < 30 and 80 < fov.max() <= high + 1e-3
    assert procedural.VARIED_SWEEP[0] <= orbit.min() < 20 and 130 < orbit.max() <= 170 + 1e-3
    constant = np.ptp(fov, axis=1) < 1e-3
    smooth = (np.abs(np.diff(np.log(fov), 2, axis=1)) < 1e-3).all(1) & ~constant
    assert 10 <= constant.sum() <= 32 and 8 <= smooth.sum() <= 32
    off = np.abs(K[:, 0, :2, 2] / [40, 24] - 0.5)
    assert 18 <= (off > 1e-4).all(1).sum() <= 42 and off.max() <= 0.1 + 1e-6

    seed = int(np.flatnonzero(~constant & ~smooth & (off > 0.03).any(1))[0])
    views = sample_sequence(seed, **SMALL, varied=True)
    np.testing.assert_allclose(views["K"], K[seed], rtol=1e-6)
    scene = _scenes(np.int32(seed), _plain_textures())
    sweep = (orbit[seed], orbit[seed])
    dense = camera_path(seed, procedural._PATH_SAMPLES, scene=scene, sweep=sweep)
    scene = clear_views(scene, dense["c2w"])
    room, half = (np.asarray(x)[None, raycast.ROOM] for x in (scene.centre, scene.half))
    y, x = (grid.ravel() + 0.5 for grid in np.mgrid[:24, :40])
    for i in (0, 4):
        local = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K[seed, i]).T
        c2w, depth = views["c2w"][i], views["depth"][i].ravel()
        end = (local * depth[:, None]) @ c2w[:3, :3].T + c2w[:3, 3]
        wall = np.abs(np.abs(end - room) - half).min(-1)
        on_object = np.abs(_inside(scene, end) - 1).min(-1) < 1e-3
        assert (on_object | (wall < 1e-3) | (depth == SKY_DEPTH)).mean() > 0.99


def test_handheld_cameras_turn_roll_and_look_from_above():
    options = jax.jit(procedural.handheld_cameras, static_argnums=1)
    scenes = [_scenes(np.int32(seed), _plain_textures()) for seed in range(24)]
    path = jax.jit(lambda seed, scene, how: camera_path(seed, 6, scene=scene, **how)["c2w"])
    rolled, down, orbit = [], [], []
    for seed, scene in enumerate(scenes):
        how = options(np.int32(seed), 6)
        with_roll = np.asarray(path(np.int32(seed), scene, how), np.float64)
        without = np.asarray(
            path(np.int32(seed), scene, how | {"roll": np.zeros(6, np.float32)}), np.float64
        )
        np.testing.assert_allclose(with_roll[:, :3, 2:], without[:, :3, 2:], atol=1e-6)
        turn = np.swapaxes(without[:, :3, :3], 1, 2) @ with_roll[:, :3, :3]
        angle = np.degrees(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))
        np.testing.assert_allclose(angle, how["roll"], atol=0.05)
        rolled.append(np.abs(angle).max())
        down.append(np.degrees(np.arcsin(-without[:, 2, 2])).max())
        orbit.append(float(how["sweep"][0]))
    assert 2 < np.sum(np.array(rolled) > 12) < 16 and max(rolled) <= 70
    assert max(down) > 45  # most paths elsewhere stay below 30
    low, high = procedural.HANDHELD_SWEEP
    assert low <= min(orbit) < 60 and 250 < max(orbit) <= high + 1e-3
    views = sample_sequence(3, **SMALL, varied=True, handheld=True)
    scene = scenes[3]
    want = camera_path(3, 5, scene=scene, **options(np.int32(3), 5))["c2w"]
    np.testing.assert_allclose(views["c2w"], want, atol=1e-5)


def test_principal_ray_and_pixel_centres():
    """Depth of a frontal floor seen from above is the camera height at every pixel (z-depth), and
    the pixel at column 0 looks along (0.5 - cx) / fx."""
    scene = _scenes(np.int32(0), _plain_textures())
    sunk = scene.centre.at[: raycast.OBJECTS, 2].set(-9.0)
    scene = scene.replace(
        centre=sunk.at[raycast.ROOM].set(jnp.array([0.0, 0.0, 20.0])),
        half=scene.half.at[raycast.ROOM].set(jnp.array([45.0, 45.0, 20.0])),
    )
    K = np.array([[30.0, 0, 13.0], [0, 25.0, 9.0], [0, 0, 1]], np.float32)
    # x right = world x, y down = world -y, z forward = world -z, 3 above the floor.
    c2w = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)
    c2w[:3, 3] = 0.2, -0.1, 3.0
    depth = _views(scene, K, c2w, height=20, width=28, supersample=1)["depth"]
    np.testing.assert_allclose(depth, 3.0, rtol=1e-6)
    # A ball whose silhouette is known: pixels whose centre ray passes within its radius see it.
    ball = raycast.BOXES
    middle, radius = np.array([0.5, 0.3, 1.2]), 0.4
    scene = scene.replace(
        centre=scene.centre.at[ball].set(middle), half=scene.half.at[ball].set(radius)
    )
    depth = np.asarray(_views(scene, K, c2w, height=20, width=28, supersample=1)["depth"])
    y, x = (g + 0.5 for g in np.mgrid[:20, :28])
    ray = np.stack([(x - 13) / 30, -(y - 9) / 25, -np.ones_like(x)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    miss = np.linalg.norm(np.cross(ray, middle - c2w[:3, 3]), axis=-1)
    clear = np.abs(miss - radius) > 1e-4
    assert clear.all() and (miss < radius).sum() > 20
    np.testing.assert_array_equal(depth < 2.9, miss < radius)
    # A camera's principal ray is its z axis.
    principal = raycast._rays(jnp.asarray(K), jnp.asarray(c2w), jnp.array([13.0]), jnp.array([9.0]))
    np.testing.assert_allclose(np.stack(principal)[:, 0], c2w[:3, 2], atol=1e-7)


def test_strips_do_not_change_the_picture(textures):
    scene = _scenes(np.int32(1), textures)
    path = _paths(np.int32(1), scene, n=24)
    K = intrinsics(path["fov"], 24, 40)
    size = {"height": 24, "width": 40, "supersample": 2}
    whole = _views(scene, K, path["c2w"][2], **size)
    strips = _views(scene, K, path["c2w"][2], rays_per_chunk=7 * 40, **size)  # 24 = 3 * 7 + 3
    np.testing.assert_allclose(whole["depth"], strips["depth"], rtol=1e-4)
    assert (np.abs(whole["rgb"] - strips["rgb"]) > 1e-3).mean() < 0.01
    assert whole["rgb"].min() >= 0 and whole["rgb"].max() <= 1


@pytest.mark.slow
def test_supersampling_converges(textures):
    """More samples per pixel come closer to many samples."""
    scene = _scenes(np.int32(6), textures)
    path = _paths(np.int32(6), scene, n=24)
    K = intrinsics(path["fov"], 24, 40)
    one, two, many = (
        _views(scene, K, path["c2w"][0], height=24, width=40, supersample=s)["rgb"]
        for s in (1, 2, 6)
    )
    assert jnp.mean((two - many) ** 2) < 0.5 * jnp.mean((one - many) ** 2)


def test_cameras_are_posed_smooth_and_free():
    for seed in SEEDS:
        scene = _scenes(np.int32(seed), _plain_textures())
        path = _paths(np.int32(seed), scene, n=24)
        c2w = np.asarray(path["c2w"], np.float64)
        turn = c2w[:, :3, :3]
        np.testing.assert_allclose(
            turn @ turn.swapaxes(1, 2), np.eye(3)[None].repeat(24, 0), atol=1e-6
        )
        assert (np.linalg.det(turn) > 0.99).all()
        assert (turn[:, 2, 1] < 0).all()  # the image's y axis points down, the world's z axis up
        assert 45 <= path["fov"] <= 75
        centre = c2w[:, :3, 3]
        assert (centre >= np.asarray(scene.camera_low)).all()
        assert (centre <= np.asarray(scene.camera_high)).all()
        step = np.linalg.norm(np.diff(centre, axis=0), axis=-1)
        assert step.max() < 0.5 and step.sum() > 0.1
        assert np.linalg.norm(np.diff(centre, 2, axis=0), axis=-1).max() < 0.1  # no jerks
        cosine = np.einsum("fi,fi->f", turn[1:, :, 2], turn[:-1, :, 2])
        assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max() < 8
        # Signed distance to the oriented bounds of every object.
        objects = slice(0, raycast.OBJECTS)
        offset = centre[:, None] - np.asarray(scene.centre)[None, objects]
        local = np.einsum("kij,fki->fkj", np.asarray(scene.rotation)[objects], offset)
        outside = np.maximum(np.abs(local) - np.asarray(scene.half)[None, objects], 0)
        assert np.linalg.norm(outside, axis=-1).min() > procedural.CLEARANCE - 1e-3


def test_clear_views_frees_a_camera_inside_an_object():
    scene = _scenes(np.int32(5), _plain_textures())
    inside = jnp.eye(4).at[:3, 3].set(scene.centre[3])[None]
    cleared = clear_views(scene, inside)
    assert cleared.centre[3, 2] < -1  # sunk below the floor
    distance = jnp.linalg.norm(cleared.centre[: raycast.OBJECTS] - inside[:, :3, 3], axis=-1)
    radius = jnp.linalg.norm(cleared.half[: raycast.OBJECTS], axis=-1)
    assert (distance - radius).min() >= procedural.CLEARANCE - 1e-3


def test_one_trace_for_all_seeds_and_both_splits():
    traced = procedural._sequence._cache_size
    sample_sequence(0, **SMALL)
    before = traced()
    for seed in (11, 12, HELDOUT_SEED, HELDOUT_SEED + 1):
        sample_sequence(seed, **SMALL)
    assert traced() == before


@pytest.mark.slow
def test_vmap_over_seeds_equals_one_by_one(textures):
    def one(seed):
        scene = make_scene(seed, textures=textures)
        path = camera_path(seed, 24, scene=scene)
        K = intrinsics(path["fov"], 24, 40)
        return render(scene, K, path["c2w"][0], height=24, width=40, supersample=1)

    seeds = jnp.array([1, 2], jnp.int32)
    together = jax.jit(jax.vmap(one))(seeds)
    for i, seed in enumerate(seeds):
        scene = _scenes(seed, textures)
        path = _paths(seed, scene, n=24)
        K = intrinsics(path["fov"], 24, 40)
        single = _views(scene, K, path["c2w"][0], height=24, width=40, supersample=1)
        # The two programs round differently: samples on an edge may fall on its other side.
        for name, limit in (("depth", 1e-3), ("rgb", 1e-2)):
            assert (np.abs(together[name][i] / single[name] - 1) > limit).mean() < 0.02


def test_splits_share_neither_photographs_nor_noise():
    assert not set(PHOTO_NAMES["train"]) & set(PHOTO_NAMES["heldout"])
    assert "motorcycle" not in str(PHOTO_NAMES)  # it is the built-in real scene
    assert NOISE_SEEDS["train"] != NOISE_SEEDS["heldout"]
    train, heldout = load_textures("train"), load_textures("heldout")
    assert train.shape == heldout.shape == (PHOTOS + NOISES, TEXELS)
    assert not {row.tobytes() for row in train} & {row.tobytes() for row in heldout}
    assert split_of(HELDOUT_SEED - 1) == "train" and split_of(HELDOUT_SEED) == "heldout"


def test_mip_levels_average_their_parents(textures):
    row = np.asarray(textures[0])
    assert row.dtype == np.uint32
    levels = [row[: 256 * 256].reshape(256, 256), row[256 * 256 :][: 128 * 128].reshape(128, 128)]
    red = [(level & 255).astype(float) for level in levels]
    expected = red[0].reshape(128, 2, 128, 2).mean((1, 3))
    assert np.abs(red[1] - expected).max() <= 1.0  # rounding to 8 bits, of parents and child


def test_bad_requests_name_what_is_allowed(tmp_path):
    with pytest.raises(UserError, match="seed -1"):
        sample_sequence(-1, **SMALL)
    with pytest.raises(UserError, match="heldout"):
        load_textures("held-out")
    with pytest.raises(UserError, match="at least one"):
        write_dataset(tmp_path, [], 2, 8, 12)
    with pytest.raises(UserError, match="mix"):
        write_dataset(tmp_path, [1, HELDOUT_SEED], 2, 8, 12)
    with pytest.raises(UserError, match=r"no finished shard"):
        read_dataset(tmp_path)


def test_pool_round_trip_resume_and_guards(tmp_path):
    size = {name: SMALL[name] for name in ("frames", "height", "width")}  # compiled already
    options = {"supersample": 1, "scenes_per_shard": 2, "depth": True}
    write_dataset(tmp_path, range(3), **size, processes=1, **options)
    pool = read_dataset(tmp_path)
    assert len(pool) == 3 and list(pool.seeds) == [0, 1, 2]
    assert not list(tmp_path.glob("*.part"))
    for index in range(3):
        scene = sample_sequence(index, supersample=1, **size)
        stored = pool[index]
        # Workers compile on their own, so float32 rounding may differ: a few times 1e-7 of poses
        # and focal lengths (below 8 and 40 here), and samples on an edge may change sides. Half
        # floats store depth to 2^-11.
        np.testing.assert_allclose(stored["c2w"], scene["c2w"], rtol=0, atol=1e-5)
        np.testing.assert_allclose(stored["K"], scene["K"], rtol=1e-5)
        assert (np.abs(stored["rgb"].astype(int) - scene["rgb"]) > 2).mean() < 0.02
        assert (np.abs(stored["depth"] / scene["depth"] - 1) > 1e-3).mean() < 0.02
    with pytest.raises(IndexError):
        pool[3]

    stamps = {p: p.stat().st_mtime_ns for p in tmp_path.glob("shard*")}
    write_dataset(tmp_path, range(3), **size, **options)  # nothing is missing: nothing is rendered
    assert stamps == {p: p.stat().st_mtime_ns for p in tmp_path.glob("shard*")}
    with pytest.raises(UserError, match="frames 5"):
        write_dataset(tmp_path, range(3), **size | {"frames": 4}, **options)
    (tmp_path / "shard_00000.npz").unlink()  # as if the writer had died before the last rename
    missing = _missing(tmp_path, np.arange(3), {"scenes_per_shard": 2})
    assert [stem.name for stem, _, _ in missing] == ["shard_00000"]
    assert list(read_dataset(tmp_path).seeds) == [2]


def _hold(path, ready, release):
    from roge_jax.data.dataset import sole_writer

    with sole_writer(path):
        ready.set()
        release.wait(60)


def test_two_writers_cannot_share_a_pool(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready, release = context.Event(), context.Event()
    holder = context.Process(target=_hold, args=(tmp_path, ready, release))
    holder.start()
    try:
        assert ready.wait(60)
        with pytest.raises(UserError, match="another process"):
            write_dataset(tmp_path, [0], 2, 8, 12)
        assert not list(tmp_path.glob("shard*"))
    finally:
        release.set()
        holder.join(60)


def test_training_pools_are_varied_and_held_out_ones_are_not(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(program, "write_dataset", lambda *a, **options: asked.append(options))
    command = ["dataset", "--out", str(tmp_path), "--scenes", "1", "--first-seed"]
    program.main([*command, "0"])
    program.main([*command, "0", "--no-varied"])
    program.main([*command, str(HELDOUT_SEED)])
    program.main([*command, "0", "--handheld"])
    assert [options["varied"] for options in asked] == [True, False, False, True]
    assert [options["handheld"] for options in asked] == [False, False, False, True]


def test_the_former_name_of_the_command_still_works(tmp_path, capsys):
    with pytest.warns(FutureWarning, match="`procedural dataset` now"):
        assert program.main(["pool", "--out", str(tmp_path), "--scenes", "0"]) == 2
    assert "'0' is not a whole number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["dataset"], "required: --out"),
        (["pol"], "invalid choice"),
        (["dataset", "--out", "{}/p", "--scenes", "0"], "'0' is not a whole number of at least 1"),
        (["dataset", "--out", "{}/p", "--height", "wide"], "'wide' is not a whole number"),
        (["dataset", "--out", "{}/p", "--hight", "8"], "did you mean '--height'"),
        (["dataset", "--out", "{}/s", "--first-seed", "-3"], "seed -3"),
        (["dataset", "--out", "{}/torn"], "pool.json: not valid JSON"),
        (["dataset", "--out", "{}/file"], "File exists"),
        (["sheet", "--out", "{}/x.txt"], "ends in .png"),
        (["bench", "--frames", "-1"], "'-1' is not a whole number"),
    ],
)
def test_mistakes_on_the_command_line_are_one_sentence(words, said, tmp_path, capsys):
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "pool.json").write_text("{")
    (tmp_path / "file").write_text("")
    assert program.main([word.format(tmp_path) for word in words]) == 2
    shown = capsys.readouterr().err
    assert said in shown and shown.startswith("error: ") and shown.count("\n") == 1


def _shard(folder):
    np.save(folder / "shard_00000.rgb.npy", np.zeros((2, 6, 8, 8, 3), np.uint8))
    views = {"K": np.zeros((2, 6, 3, 3)), "c2w": np.zeros((2, 6, 4, 4))}
    np.savez(folder / "shard_00000.npz", seeds=np.arange(2), **views)
    return folder / "shard_00000.rgb.npy", folder / "shard_00000.npz"


@pytest.mark.parametrize("damage", ["no pictures", "cut", "junk", "floats", "cut cameras", "no K"])
def test_damaged_shards_are_named(damage, tmp_path):
    rgb, cameras = _shard(tmp_path)
    assert len(read_dataset(tmp_path)) == 2
    changes = {
        "no pictures": rgb.unlink,
        "cut": lambda: rgb.write_bytes(rgb.read_bytes()[:500]),
        "junk": lambda: rgb.write_bytes(b"x"),
        "floats": lambda: np.save(rgb, np.zeros((2, 6, 8, 8, 3))),
        "cut cameras": lambda: cameras.write_bytes(cameras.read_bytes()[:99]),
        "no K": lambda: np.savez(cameras, seeds=np.arange(2)),
    }
    changes[damage]()
    with pytest.raises(UserError, match=r"shard_00000: .*write the dataset again"):
        read_dataset(tmp_path)


def pictures(folder, kinds: int):
    """Two pictures of every kind, one of them small, of a colour of their own."""
    from PIL import Image

    (folder / "deeper").mkdir(parents=True)
    for i in range(kinds):
        for k, side in enumerate((40, 300)):
            colour = (i * 255 // kinds, 90, 255 - i * 255 // kinds)
            Image.new("RGB", (side, side), colour).save(folder / f"deeper/Kind{i}_{k:03d}.png")
    return folder


def test_textures_of_a_folder_keep_a_tenth_of_the_kinds_apart(tmp_path):
    folder = pictures(tmp_path / "pictures", 20)
    train, heldout = (folder_pictures(folder, split) for split in ("train", "heldout"))
    kinds = [{p.stem.partition("_")[0] for p in part} for part in (train, heldout)]
    assert len(kinds[1]) == 2 and not kinds[0] & kinds[1] and len(train) + len(heldout) == 40
    plain, one, again, other = (
        load_textures("train", *more) for more in ((), (folder, 1), (folder, 1), (folder, 2))
    )
    assert plain.shape == one.shape and not np.array_equal(plain, one)
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
    with pytest.raises(UserError, match="no picture for the train textures"):
        folder_pictures(tmp_path / "nothing", "train")
    with pytest.raises(UserError, match=r"heldout textures: .* of ten kinds"):
        folder_pictures(pictures(tmp_path / "few", 3), "heldout")
    (folder / "broken_1.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"broken_1.png cannot be read as a picture .*: remove it"):
        for draw in range(3, 30):
            load_textures("train", folder, draw)


def test_a_pool_with_textures_of_a_folder_differs_and_says_so(tmp_path):
    folder = pictures(tmp_path / "pictures", 12)
    size = {"frames": 2, "height": 16, "width": 24, "supersample": 1}
    plain = sample_sequence(7, **size, varied=True)
    write_dataset(tmp_path / "pool", [7], 2, 16, 24, supersample=1, varied=True, textures=folder)
    made = read_dataset(tmp_path / "pool")[0]
    np.testing.assert_allclose(made["c2w"], plain["c2w"])
    assert not np.array_equal(made["rgb"], plain["rgb"])
    with pytest.raises(UserError, match="holds a dataset with textures"):
        write_dataset(
            tmp_path / "pool", [7], 2, 16, 24, supersample=1, varied=True, textures=tmp_path
        )
