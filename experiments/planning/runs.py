"""What `ladder.py` runs on: scenes of known complexity, one engine for all plans, the planner's calibration."""

import dataclasses
import functools
import zlib
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from roge_jax import evaluate, model, preview, sampling
from roge_jax.geometry.cameras import Cameras, normalise
from roge_jax.planning import proxies, stretches
from roge_jax.planning.options import LEAST_LOSS, MERGES, full_choices
from roge_jax.procedural import scenes as procedural
from roge_jax.procedural.raycast import OBJECTS, ROOM, render_views
from roge_jax.sampling import programs
from roge_jax.sampling.windows import stretch_noise, window_noise, window_views
from roge_jax.scenes import coverage
from roge_jax.video import flow, solvers

CONTEXTS = 6
# Of 17 frames: where the planner generates nothing alone, and why.
ELSEWHERE = {"between slots": ((2, 7), (10, 15)), "one frame": ((4, 5), (12, 13))}
RUNGS = ("plane", "empty", "3 objects", "6 objects", "12 objects", "clutter")
KEPT = {"plane": (), "empty": (), "3 objects": (2, 6, 9), "6 objects": (2, 3, 6, 7, 9, 10)}


# ---- scenes ----------------------------------------------------------------------------------------


@dataclasses.dataclass
class LadderScene:
    """Six photos and 17 targets, of one camera path. `truth` [n, h, w, 3]; bits per pixel of the photos."""

    rung: str
    seed: int
    photos: sampling.Photos
    path: Cameras
    truth: np.ndarray
    bits: float
    kept: dict = dataclasses.field(default_factory=dict)  # what the engine need not compute twice


@functools.partial(jax.jit, static_argnames=("frames", "height", "width"))
def _render(seed, textures, keep, plane, gather, *, frames, height, width):
    scene = procedural.make_scene(seed, textures=textures)
    dense = procedural.camera_path(seed, 64, scene=scene)["c2w"]
    path = procedural.camera_path(seed, frames, scene=scene)
    # Clutter: everything around the focus, thinner and taller, so that things hide one another.
    inward = scene.focus[None, :2] + 0.45 * (scene.centre[2:OBJECTS, :2] - scene.focus[None, :2])
    thin = scene.half[2:OBJECTS] * jnp.array([[0.7, 0.7, 1.4]])
    rise = scene.centre[2:OBJECTS, 2] + thin[:, 2] - scene.half[2:OBJECTS, 2]
    moved = jnp.concatenate([inward, rise[:, None]], -1)
    centre = scene.centre.at[2:OBJECTS].set(jnp.where(gather, moved, scene.centre[2:OBJECTS]))
    half = scene.half.at[2:OBJECTS].set(jnp.where(gather, thin, scene.half[2:OBJECTS]))
    scene = procedural.clear_views(dataclasses.replace(scene, centre=centre, half=half), dense)
    centre, half, rotation = scene.centre, scene.half, scene.rotation
    sunk = -2.0 - jnp.linalg.norm(half[:OBJECTS], axis=-1)
    centre = centre.at[:OBJECTS, 2].set(jnp.where(keep, centre[:OBJECTS, 2], sunk))
    # Plane: object 0 becomes a wall behind the focus that fills every view, in a room too large to be seen.
    ahead = (scene.focus - dense[:, :3, 3].mean(0)).at[2].set(0.0)
    ahead = ahead / jnp.linalg.norm(ahead)
    c, s, zero, one = ahead[0], ahead[1], 0.0 * ahead[0], 1.0 + 0.0 * ahead[0]
    turn = jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)
    wall = scene.focus + 0.7 * ahead
    centre = centre.at[0].set(jnp.where(plane, wall, centre[0]))
    half = half.at[0].set(jnp.where(plane, jnp.array([0.02, 15.0, 15.0]), half[0]))
    rotation = rotation.at[0].set(jnp.where(plane, turn, rotation[0]))
    centre = centre.at[ROOM].set(jnp.where(plane, jnp.zeros(3), centre[ROOM]))
    half = half.at[ROOM].set(jnp.where(plane, jnp.full(3, 40.0), half[ROOM]))
    scene = dataclasses.replace(scene, centre=centre, half=half, rotation=rotation)
    K = procedural.intrinsics(path["fov"], height, width)
    Ks = jnp.broadcast_to(K[None], (frames, 3, 3))
    rgb = render_views(scene, Ks, path["c2w"], height=height, width=width, supersample=2)["rgb"]
    return rgb, Ks, path["c2w"]


def taken(views: int, seed: int) -> list[int]:
    """Which of a path's views are photos: evenly spread ones, or, for odd seeds, two bursts of three."""
    if seed % 2 == 0:
        return evaluate.spread(views, CONTEXTS, views - CONTEXTS)[0]
    length, middle = CONTEXTS // 2, views // 2
    rng = np.random.default_rng(seed)
    first = int(rng.integers(0, middle - length + 1)), int(rng.integers(middle, views - length + 1))
    return [start + k for start in first for k in range(length)]


def make(rung: str, seed: int, config) -> LadderScene:
    """One scene of the ladder: the same seed has the same cameras and textures on every rung."""
    textures = procedural._device_textures(procedural.split_of(seed))
    keep = np.isin(np.arange(OBJECTS), KEPT.get(rung, range(OBJECTS)))
    rgb, K, c2w = _render(
        np.int32(seed),
        textures,
        keep,
        rung == "plane",
        rung == "clutter",
        frames=config.frames + CONTEXTS,
        height=config.height,
        width=config.width,
    )
    rgb = np.round(np.asarray(rgb) * 255).astype(np.uint8)
    K, c2w = np.asarray(K, np.float64), np.asarray(c2w, np.float64)
    context = taken(len(rgb), seed)
    target = [i for i in range(len(rgb)) if i not in context]
    steps = np.diff(rgb[context].astype(np.int16), axis=2).astype(np.int8)  # lossless, along rows
    bits = 8 * len(zlib.compress(steps.tobytes(), 9)) / (steps.size / 3)
    photos = sampling.Photos(
        rgb[context].astype(np.float32) / 255.0,
        None,
        Cameras(K[context], c2w[context]),
        tuple(range(CONTEXTS)),
    )
    truth = rgb[target].astype(np.float32) / 255.0
    return LadderScene(rung, seed, photos, Cameras(K[target], c2w[target]), truth, bits)


# ---- runs ------------------------------------------------------------------------------------------


class Engine:
    """`sampling.sample` for one window, in pieces: what two plans of a scene share is computed and compiled once.

    FLOPs are counted by `roge_jax.cost` for each plan as if it ran alone.
    """

    def __init__(self, params, config):
        self.params, self.config = params, config
        self.settings = sampling.Settings(generate=True).of(config)
        self.programs: dict = {}
        self.velocity = functools.partial(programs.velocity, slots="noised")
        self.decode = functools.partial(programs.decode, contexts=0)
        self.encode = jax.jit(functools.partial(model.encode_contexts, config=config))

    def program(self, f, config):
        return self.programs.setdefault((f, config), jax.jit(functools.partial(f, config=config)))

    def choices(self, scene: LadderScene, **changes) -> sampling.Choices:
        full = full_choices(scene.photos, self.config, scene.path, self.settings)
        return dataclasses.replace(full, **changes)

    def features(self, scene: LadderScene, choices):
        """(views, ray features, picture) under choices of photos, size and tokens."""
        photos, config, _ = sampling.reduced(scene.photos, self.config, self.settings, choices)
        seen = ("views", choices.photos)
        if seen not in scene.kept:
            context, target, info = normalise(
                photos.cameras, scene.path, rule=config.scale_rule, scale=None
            )
            scene.kept[seen] = window_views(photos.images, None, context, target, info, config)
        views = scene.kept[seen]
        plain = dataclasses.replace(config, renderer=dataclasses.replace(config.renderer, merge=1))
        tokens, rays = (seen[1], choices.recon), (seen[1], choices.recon, choices.merge)
        if tokens not in scene.kept:
            scene.kept[tokens] = self.program(model.reconstruct, plain)(self.params, views)
        if rays not in scene.kept:
            query, show = self.program(model.query_rays, config), self.program(model.show, config)
            found = query(self.params, scene.kept[tokens], views)
            scene.kept[rays] = found, show(self.params, found, views)
        return views, *scene.kept[rays]

    def run(self, scene: LadderScene, choices) -> np.ndarray:
        """The frames [n, h, w, 3] under `choices`."""
        if choices in scene.kept:
            return scene.kept[choices]
        views, features, shown = self.features(scene, choices)
        frames = np.array(model.resized(shown, self.config.height, self.config.width))
        if choices.generate[0] is not None:
            first, last = choices.generate[0]
            config = dataclasses.replace(self.config, frames=choices.frames)
            made = self.latents(scene, choices, views, features, shown)
            frames[first:last] = self.program(self.decode, config)(self.params, *made)
        scene.kept[choices] = frames
        return frames

    def latents(self, scene, choices, views, features, shown) -> tuple[jax.Array, jax.Array | None]:
        """Those of the targets that are generated, and what is added to them when they are decoded."""
        m, (first, last) = len(choices.photos), choices.generate[0]
        config = dataclasses.replace(self.config, frames=choices.frames)
        rows = np.array([*range(m), *range(m + first, m + last)])
        views, features = views | {k: views[k][rows] for k in ("K", "c2w")}, features[rows]
        shown = shown[first:last]
        if "latents" not in scene.kept:
            scene.kept["latents"] = self.encode(self.params, scene.photos.images)
        known = scene.kept["latents"][np.array(choices.photos)]
        condition = self.program(model.condition, config)
        cond = condition(self.params, known, features, views, shown=shown)
        lost = self.program(preview.lost_detail, config)(self.params, shown, cond)
        prepared = model.Prepared(known, features, shown, cond, None, lost)
        noise = window_noise(0, 0, CONTEXTS, self.config)[-self.config.slots(m) :]
        noise = stretch_noise(noise, m, first, config)
        settings = dataclasses.replace(
            self.settings, steps=choices.steps, solver=choices.solver, schedule=choices.schedule
        )
        grid = flow.schedule(
            settings.schedule,
            settings.steps,
            shift=self.config.flow.shift,
            solver=settings.solver,
            model=self.config.name,
        )
        run = SimpleNamespace(velocity=self.program(self.velocity, config))
        bar = SimpleNamespace(update=lambda n: None)
        x0, _ = sampling.integrate(
            run, self.params, prepared, jnp.asarray(noise), grid, settings, config, bar
        )
        return x0[m:], lost


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.square(a - b).mean(dtype=np.float64)))


# ---- calibration -----------------------------------------------------------------------------------


def ways(engine: Engine) -> list[tuple[str, str, int]]:
    """(solver, schedule, steps) with fewer evaluations than the full model, and at most 6."""
    own = engine.settings
    found = [(own.solver, own.schedule, k) for k in range(1, own.steps)]
    found += [("unipc_2", "uniform", k) for k in range(1, own.steps)]
    stored = flow.optimised_grids(engine.config.name)
    found += [(solver, "optimised", k) for solver, grids in stored.items() for k in grids]
    most = min(6, solvers.nfe(own.solver, own.steps) - 1)
    return [way for way in found if solvers.nfe(way[0], way[2]) <= most]


def turn_knobs(engine: Engine, scene: LadderScene) -> dict:
    """Errors of one knob at a time on one scene, and its proxies."""
    full = engine.choices(scene)
    reference = engine.run(scene, full)
    # Where photos, tokens and size are compared: their effect, not that of steps.
    base = dataclasses.replace(full, steps=max(1, full.steps // 2))
    head = dataclasses.replace(full, generate=(None,))
    small = proxies.half_size(engine.config)

    def both(**changes):
        return [
            rms(engine.run(scene, dataclasses.replace(a, **changes)), engine.run(scene, a))
            for a in (base, head)
        ]

    row = {"rung": scene.rung, "seed": scene.seed, "bits": scene.bits}
    row["full_to_truth"] = rms(reference, scene.truth)
    row["head_to_truth"] = rms(engine.run(scene, head), scene.truth)
    row["head"] = rms(engine.run(scene, head), reference)
    row["steps"] = [
        [*way, rms(engine.run(scene, dataclasses.replace(full, solver=way[0], schedule=way[1], steps=way[2])), reference)]
        for way in ways(engine)
    ]  # fmt: skip
    row["merge"] = {merge: both(merge=merge) for merge in MERGES[1:]}
    window = (0, engine.config.frames)
    row["stretch"] = {
        length: [_alone(engine, scene, full, place) for place in stretches.places(window, length)]
        for length in stretches.lengths(engine.config)[:-1]
    }
    row["elsewhere"] = {
        name: [_alone(engine, scene, full, place) for place in places]
        for name, places in ELSEWHERE.items()
    }
    row["half"] = both(recon=(small.recon_height, small.recon_width))
    size = (engine.config.height, engine.config.width)
    worth = coverage.coverage(scene.photos.cameras, scene.path, *size)
    best = coverage.covered(worth, full.photos)
    rng = np.random.default_rng(scene.seed)
    chosen = coverage.selections(worth)  # of bursts, three or four photos see all there is
    sets = [list(chosen[min(k, len(chosen)) - 1]) for k in (1, 2, 4)] + [
        rng.permutation(CONTEXTS)[:k].tolist() for k in (1, 2)
    ]
    row["photos"] = [
        [sorted(kept), 1 - coverage.covered(worth, tuple(kept)) / best, *both(photos=tuple(sorted(kept)))]
        for kept in sets
    ]  # fmt: skip
    row["frames"] = [
        _by_frame(engine, scene, dataclasses.replace(full, photos=tuple(sorted(kept))))
        for kept in [full.photos, sets[0], sets[-1]]
    ]
    measured = {"detail": proxies.detail(scene.photos.images)}
    measured |= proxies.leave_one_out(engine.params, engine.config, scene.photos, engine.programs)
    measured["richardson"] = proxies.richardson(
        engine.params, engine.config, scene.photos, scene.path, engine.settings, engine.programs
    )
    return row | {"proxies": measured}


def _alone(engine: Engine, scene: LadderScene, full, place) -> float:
    """How far a stretch generated alone is from the same frames of the whole window."""
    first, last = place
    alone = dataclasses.replace(full, generate=(place,), frames=last - first)
    return rms(engine.run(scene, alone)[first:last], engine.run(scene, full)[first:last])


def _by_frame(engine: Engine, scene: LadderScene, choices) -> dict:
    """Of every frame: how much these photos see of it, and how far the RGB head's is from the generated one."""
    photos = scene.photos.cameras[list(choices.photos)]
    head = engine.run(scene, dataclasses.replace(choices, generate=(None,)))
    pairs = zip(engine.run(scene, choices), head, strict=True)
    seen = coverage.by_frame(photos, scene.path, engine.config.height, engine.config.width)
    return {"seen": seen.tolist(), "head": [rms(a, b) for a, b in pairs]}


# Which proxies may speak for a knob, so that few scenes do not make chance a law.
SPEAK = {
    "steps": ("richardson", "detail"),
    "photos": ("leave_one_out", "detail"),
    "merge": ("redundancy", "leave_one_out", "detail"),
    "half": ("redundancy", "leave_one_out", "detail"),
    "head": ("leave_one_out", "redundancy", "detail"),
    "stretch": ("richardson", "detail"),
}


def follow(knob: str, errors: np.ndarray, rows: list[dict]) -> list[dict]:
    """How a knob's error follows each proxy from scene to scene: power laws, the best correlated first.

    The power is the slope in logarithms times the adjusted r^2, so that a proxy that says little is little believed.
    """
    found = []
    for proxy in SPEAK[knob]:
        x = np.log([max(row["proxies"][proxy], 1e-9) for row in rows])
        y, n = np.log(np.maximum(errors, 1e-9)), len(rows)
        if n < 4 or x.std() < 1e-6 or y.std() < 1e-6:
            continue
        r = float(np.corrcoef(x, y)[0, 1])
        trust = 1.0 - (1.0 - r * r) * (n - 1) / (n - 2)
        power = min(float(np.polyfit(x, y, 1)[0]) * trust, 1.5)
        if r > 0 and trust > 0.05:
            known = {"proxy": proxy, "typical": float(np.exp(x.mean())), "power": power, "r": r}
            found.append((r, known))
    return [known for _, known in sorted(found, key=lambda pair: -pair[0])]


def seen_less(rows: list[dict]) -> tuple[dict, np.ndarray]:
    """(how the RGB head's error of a frame grows where the photos see less, every scene's error at full coverage).

    In each scene log error = level + log(1 + rise (1 - coverage)), with all photos and with few; the rise that leaves
    least. The level holds for all photos, which are first in `row["frames"]`.
    """
    seen = [np.concatenate([some["seen"] for some in row["frames"]]) for row in rows]
    errors = [np.log(np.concatenate([some["head"] for some in row["frames"]])) for row in rows]

    def centred(rise: float) -> tuple[np.ndarray, np.ndarray]:
        growth = [np.log1p(rise * (1.0 - s)) for s in seen]
        pairs = ([v - v.mean() for v in values] for values in (errors, growth))
        return tuple(np.concatenate(parts) for parts in pairs)

    def left(rise: float) -> float:
        error, growth = centred(rise)
        return float(np.square(error - growth).mean())

    rise = float(min(np.linspace(0.0, 10.0, 201), key=left))
    own = [1.0 + rise * (1.0 - np.array(row["frames"][0]["seen"])) for row in rows]
    levels = np.array(
        [row["head"] / np.sqrt(np.square(f).mean()) for row, f in zip(rows, own, strict=True)]
    )
    average = np.sqrt(np.mean([row["head"] ** 2 for row in rows]) / np.square(levels).mean())
    found = {"rise": rise, "typical": float(1.0 - (average - 1.0) / rise) if rise else 1.0}
    if rise:
        found["r"] = float(np.corrcoef(*centred(rise))[0, 1])
    return found, levels


def fit(rows: list[dict], provenance: dict) -> dict:
    """The planner's table from the rows of `turn_knobs`: averages are root mean squares over scenes."""

    def mean(values):
        return float(np.sqrt(np.square(np.asarray(values, float)).mean()))

    seen, levels = seen_less(rows)
    steps = np.array([[way[3] for way in row["steps"]] for row in rows])
    ways = [way[:3] for way in rows[0]["steps"]]
    # [scenes, sets, (share lost, error generated, error of the RGB head)]
    photos = np.array([[p[1:] for p in row["photos"]] for row in rows])
    rate = photos[..., 1:] / np.sqrt(np.maximum(photos[..., :1], LEAST_LOSS))
    merge = {k: np.array([row["merge"][k] for row in rows]) for k in MERGES[1:]}
    half = np.array([row["half"] for row in rows])
    by_scene = {
        "steps": np.exp(np.log(steps / np.sqrt(np.square(steps).mean(0))[None]).mean(1)),
        "photos": np.sqrt(np.square(rate[..., 0]).mean(1)),
        "merge": merge[4][:, 0],
        "half": half[:, 0],
        "head": levels,
        "stretch": np.array([mean([mean(e) for e in row["stretch"].values()]) for row in rows]),
    }
    window = max(len(row["frames"][0]["seen"]) for row in rows) - 1
    lengths = sorted(rows[0]["stretch"])
    return {
        "steps": [
            {
                **{"solver": s, "schedule": g, "steps": k},
                **{"evaluations": solvers.nfe(s, k), "error": mean(steps[:, i])},
            }
            for i, (s, g, k) in enumerate(ways)
        ],
        "photos": mean(rate[..., 0]),
        "photos_head": mean(rate[..., 1]),
        "merge": {str(k): mean(v[:, 0]) for k, v in merge.items()},
        "merge_head": {str(k): mean(v[:, 1]) for k, v in merge.items()},
        "half": mean(half[:, 0]),
        "half_head": mean(half[:, 1]),
        "head": mean([row["head"] for row in rows]),
        "seen": seen,
        "stretch": {
            f"{(length - 1) / window:g}": mean([mean(row["stretch"][length]) for row in rows])
            for length in lengths
        },
        "knobs": {name: follow(name, errors, rows) for name, errors in by_scene.items()},
        "provenance": provenance,
    }
