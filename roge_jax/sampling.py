"""Photos and a camera path in, the video along the path out: windows of the model, one after another.

    photos = read_photos(scene, [0, 4, 9], config)
    path = make_path("orbit", photos.cameras, frames=81)
    result = sample(params, config, photos, path, Settings(seed=1))

One window is `config.frames` targets. A path of any other length is padded at its end to whole windows by going on
as it last moved, and the surplus is dropped. All windows share one world frame and one scale. In a path longer than
a window, `chain` gives the later windows frames already made as further contexts (the last one, and those closest to
what comes); `independent` gives every window the photos alone, as the paper does. Windows after the first have equal
shapes, so there are at most two compilations of anything.
"""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from . import cost, model
from .config import RoGeConfig
from .core.params import Tree
from .data.scene import Scene, distinct_views
from .data.scene import prepare as prepare_photos
from .errors import UserError, did_you_mean
from .geometry.cameras import Cameras, Normalisation, camera_vector, concatenate, normalise, to_host
from .geometry.packing import pad_path
from .video import flow, solvers, vae

# The defaults of `python -m roge_jax.sample`: good and fast for the shipped model.
SOLVER, STEPS, SCHEDULE = "unipc_2", 12, "shift"
CHAIN_FRAMES = 2  # frames already made that join as contexts, where the model takes that many
LONG = ("chain", "independent")
SLOTS = ("noised", "clean", "free")

Stage = Callable[[str], AbstractContextManager]


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to sample; all of it goes into run.json."""

    steps: int = STEPS
    solver: str = SOLVER
    schedule: str = SCHEDULE
    seed: int = 0
    slots: model.ContextSlots = "noised"
    long: Literal["chain", "independent"] = "chain"
    scale: float | None = None  # divisor of all positions, in scene units; None: the model's rule

    def __post_init__(self):
        for name, word, allowed in (
            ("solver", self.solver, tuple(solvers.SOLVERS)),
            ("context slots", self.slots, SLOTS),
            ("long", self.long, LONG),
        ):
            if word not in allowed:
                raise UserError(f"Unknown {name} '{word}': {did_you_mean(word, allowed)}")
        flow.schedule(self.schedule, self.steps, solver=self.solver)


class Photos(NamedTuple):
    """Context photos at generation size and, where it differs, at reconstruction size; cameras in the scene's frame."""

    images: np.ndarray  # [m, h, w, 3] float32 in [0, 1]
    recon: np.ndarray | None  # [m, recon_h, recon_w, 3]
    cameras: Cameras  # K in pixels of `images`
    ids: tuple[int, ...]  # views of the scene


@dataclasses.dataclass(frozen=True)
class Result:
    """frames [n, h, w, 3] and preview [n, recon_h, recon_w, 3] float32 in [0, 1]; cameras [n] in the scene's frame."""

    frames: np.ndarray
    preview: np.ndarray
    cameras: Cameras
    normalisation: Normalisation
    evaluations: int  # of the velocity network, all windows together
    windows: tuple[
        dict[str, Any], ...
    ]  # {"frames": [first, last], "photos": [...], "generated": [...]}


def read_photos(scene: Scene, ids: list[int], config: RoGeConfig) -> Photos:
    """The photos `ids` of a scene, the first one being the world frame. Duplicates are dropped with a warning."""
    images, cameras = prepare_photos(scene, ids, config.height, config.width, drop_duplicates=False)
    kept = distinct_views(images, cameras)
    if len(kept) < len(ids):
        prepare_photos(scene, ids, config.height, config.width)  # says which
    ids = [ids[i] for i in kept]
    if len(ids) > config.max_context:
        raise UserError(
            f"{len(ids)} context photos: this model ({config.name}) takes 1 to {config.max_context}."
        )
    recon = None
    size = (config.recon_height, config.recon_width)
    same_shape = config.recon_height * config.width == config.recon_width * config.height
    if (
        size != (config.height, config.width) and same_shape
    ):  # sharper than a resize of the smaller crop
        recon, _ = prepare_photos(scene, ids, *size, drop_duplicates=False)
    return Photos(images[kept], recon, cameras[kept], tuple(ids))


# ---- windows -------------------------------------------------------------------------------------


def windows(frames: int, window: int) -> list[tuple[int, int]]:
    """[start, stop) of every window of a path."""
    return [(start, min(start + window, frames)) for start in range(0, frames, window)]


def chained(m: int, config: RoGeConfig) -> tuple[int, int]:
    """(photos, generated frames) that later windows see, of `m` photos: together at most `config.max_context`."""
    made = min(CHAIN_FRAMES, max(1, config.max_context - m), config.frames, config.max_context - 1)
    return min(m, config.max_context - made), made


def view_distance(a: Cameras, b: Cameras) -> np.ndarray:
    """[a, b]: how far apart views are, in normalised units of travel plus radians of turning."""
    a, b = to_host(a), to_host(b)
    travel = np.linalg.norm(a.centres[:, None] - b.centres[None], axis=-1)
    cosine = (np.einsum("aij,bij->ab", a.c2w[:, :3, :3], b.c2w[:, :3, :3]) - 1.0) / 2.0
    return travel + np.arccos(np.clip(cosine, -1.0, 1.0))


def chain_views(
    photos: Cameras, made: Cameras, ahead: Cameras, config: RoGeConfig
) -> tuple[list[int], list[int]]:
    """Which photos and which frames already made a later window sees (counts as in `chained`).

    The first photo stays: it is the world frame. Other photos stay if they are close to the window `ahead`. The last
    frame made is always in; the others are chosen one by one to bring the views ahead closest to what is seen.
    """
    keep, add = chained(len(photos), config)
    closeness = view_distance(photos, ahead).min(1)
    closeness[0] = -1.0
    kept = sorted(np.argsort(closeness, kind="stable")[:keep].tolist())
    gaps = view_distance(made, ahead)
    seen = view_distance(photos[kept], ahead).min(0)
    chosen: list[int] = []
    for _ in range(add):
        gain = np.minimum(gaps, seen[None]).mean(1)
        gain[chosen] = np.inf
        best = int(np.argmin(gain)) if chosen else len(made) - 1
        chosen.append(best)
        seen = np.minimum(seen, gaps[best])
    return kept, chosen


def window_views(
    images: np.ndarray,
    recon: np.ndarray | None,
    contexts: Cameras,
    targets: Cameras,
    info: Normalisation,
    config: RoGeConfig,
) -> model.Views:
    """The arrays that the model takes for one window; cameras are normalised, the path is padded to the window."""
    targets = pad_path(targets, config.frames)
    cameras = concatenate(contexts, targets)
    vectors = camera_vector(
        contexts, config.height, config.width, info.camera_scale, info.points_flag
    )
    views = {
        "context_rgb": images.astype(np.float32),
        "K": cameras.K.astype(np.float32),
        "c2w": cameras.c2w.astype(np.float32),
        "vectors": np.asarray(vectors, np.float32),
    }
    return views if recon is None else views | {"context_recon": recon.astype(np.float32)}


# ---- compiled pieces -----------------------------------------------------------------------------


class Programs(NamedTuple):
    """What runs in a window of given shapes, compiled."""

    prepare: Callable  # (params, views) -> Prepared
    velocity: Callable  # (params, prepared, noise, x, sigma) -> velocity
    decode: Callable  # (params, x0) -> frames [n, h, w, 3]
    preview: Callable  # (params, features) -> [n, recon_h, recon_w, 3]


def velocity(
    params,
    prepared: model.Prepared,
    noise,
    x,
    sigma,
    *,
    config: RoGeConfig,
    slots: model.ContextSlots,
):
    """The network on a state whose context slots are first set as `slots` asks (the solver's own state keeps its own)."""
    field, project = model.sampling_field(params, prepared, noise, config=config, mode=slots)
    return field(x if project is None else project(x, sigma), sigma)


def decode(params, x0, *, config: RoGeConfig, contexts: int):
    """Latents of a whole window [t, lh, lw, 16] -> frames; contexts are dropped. Chunked in time if it is large."""
    latents = x0[contexts:]
    if cost.decoder_tensor_bytes(config) <= cost.SINGLE_PASS_BYTES:
        return model.decode_video(params, latents, config=config)
    video = vae.decode_chunked(params["vae"], latents, cfg=config.vae)
    return jnp.clip(0.5 + 0.5 * video, 0.0, 1.0)


def draw_noise(seed: int, window: int, contexts: int, config: RoGeConfig) -> np.ndarray:
    """The noise of a window [t, lh, lw, 16] from seed and number alone, the same on every device.

    NumPy, because compiling JAX's generator takes longer than a short video's sampling.
    """
    shape = (config.slots(contexts), *config.latent_size, config.vae.latent)
    return np.random.default_rng([seed, window]).standard_normal(shape, np.float32)


def programs(
    params: Tree, views: model.Views, config: RoGeConfig, slots: model.ContextSlots
) -> Programs:
    """Compile all pieces for the shapes of `views`, side by side: compiling is what a short run waits for."""
    m = views["context_rgb"].shape[0]
    fix = functools.partial
    pieces = {
        "prepare": jax.jit(fix(model.prepare, config=config)),
        "velocity": jax.jit(fix(velocity, config=config, slots=slots)),
        "decode": jax.jit(fix(decode, config=config, contexts=m)),
        "preview": jax.jit(lambda p, features: model.decode_rgb(p, features[m:], config=config)),
    }

    def shapes(tree):
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)

    weights, seen = shapes(params), shapes(views)
    prepared = jax.eval_shape(pieces["prepare"], weights, seen)
    state = shapes(draw_noise(0, 0, m, config))
    sigma = jax.ShapeDtypeStruct((), jnp.float32)
    arguments = {
        "prepare": (weights, seen),
        "velocity": (weights, prepared, state, state, sigma),
        "decode": (weights, state),
        "preview": (weights, prepared.features),
    }
    # Tracing holds Python's lock, compiling does not.
    lowered = {name: pieces[name].lower(*shape) for name, shape in arguments.items()}
    with ThreadPoolExecutor(len(lowered)) as pool:
        compiled = {name: pool.submit(low.compile) for name, low in lowered.items()}
    return Programs(**{name: work.result() for name, work in compiled.items()})


# ---- sampling ------------------------------------------------------------------------------------


def sample(
    params: Tree,
    config: RoGeConfig,
    photos: Photos,
    path: Cameras,
    settings: Settings = Settings(),
    *,
    stage: Stage | None = None,
    progress: bool = False,
    cache: dict[int, Programs] | None = None,
) -> Result:
    """The video along `path` (cameras [n] in the scene's frame, K in pixels of config.height x config.width).

    Args:
      stage: called with "compile", "prepare", "sample" and "decode"; a context manager that times (`entry.Clock`).
      progress: show a bar over all evaluations of the velocity.
      cache: a dict that keeps the compiled programs for further calls with these parameters, config and slots.
    Raises: UserError for what cannot be done; `solvers.SamplingError` at the first number that is not finite.
    """
    stage = stage or (lambda name: nullcontext())
    cache = {} if cache is None else cache
    context, target, info = normalise(
        photos.cameras, path, rule=config.scale_rule, scale=settings.scale
    )
    grid = flow.schedule(
        settings.schedule, settings.steps, shift=config.flow.shift, solver=settings.solver
    )
    runs = windows(len(path), config.frames)
    bar = _bar(progress, settings, grid, len(runs))
    frames: list[np.ndarray] = []
    previews: list[np.ndarray] = []
    told: list[dict[str, Any]] = []
    evaluations = 0
    for number, (start, stop) in enumerate(runs):
        kept: list[int] = list(range(len(context)))
        chosen: list[int] = []
        images, recon, contexts = photos.images, photos.recon, context
        if number and settings.long == "chain":
            made = np.concatenate(frames)
            kept, chosen = chain_views(context, target[:start], target[start:stop], config)
            images = np.concatenate([images[kept], made[chosen]])
            contexts = concatenate(context[kept], target[np.array(chosen, int)])
            recon = (
                None
                if recon is None
                else np.concatenate([recon[kept], _enlarged(made[chosen], recon)])
            )
        views = window_views(images, recon, contexts, target[start:stop], info, config)
        m = len(contexts)
        if m not in cache:
            bar.set_description("compiling")
            with stage("compile"):
                cache[m] = programs(params, views, config, settings.slots)
        run = cache[m]
        bar.set_description("sampling")
        with stage("prepare"):
            prepared = jax.block_until_ready(run.prepare(params, views))
            noise = jnp.asarray(draw_noise(settings.seed, number, m, config))
        with stage("sample"):
            x0, count = integrate(run, params, prepared, noise, grid, settings, config, bar)
        with stage("decode"):
            n = stop - start
            frames.append(np.asarray(run.decode(params, x0))[:n])
            previews.append(np.asarray(run.preview(params, prepared.features))[:n])
        evaluations += count
        told.append(
            {
                "frames": [start, stop - 1],
                "photos": [photos.ids[i] for i in kept],
                "generated": chosen,
            }
        )
    bar.close()
    return Result(
        np.concatenate(frames),
        np.concatenate(previews),
        to_host(path),
        info,
        evaluations,
        tuple(told),
    )


def integrate(
    run: Programs, params, prepared, noise, grid, settings: Settings, config: RoGeConfig, bar
):
    """(latents of all slots, evaluations): noise to sample, one evaluation per step of the bar."""
    if solvers.SOLVERS[settings.solver].method is None:  # adaptive: one program, no steps to show

        @jax.jit
        def whole(params, prepared, noise):
            def field(x, sigma):
                return velocity(
                    params, prepared, noise, x, sigma, config=config, slots=settings.slots
                )

            return solvers.solve(settings.solver, field, noise, grid)

        x0, info = whole(params, prepared, noise)
        solvers.raise_if_failed(info)
        bar.update(int(info.evaluations))
        return x0, int(info.evaluations)

    def field(x, sigma):
        return run.velocity(params, prepared, noise, x, sigma)

    done, x = 0, noise
    for count, _, state in solvers.iterate(settings.solver, field, noise, grid):
        bar.update(1)
        done, x = count, state
    return jax.block_until_ready(x), done


def _enlarged(images: np.ndarray, like: np.ndarray) -> np.ndarray:
    return np.asarray(model.resized(jnp.asarray(images), *like.shape[1:3]))


def _bar(progress: bool, settings: Settings, grid: np.ndarray, runs: int):
    from tqdm import tqdm

    fixed = solvers.SOLVERS[settings.solver].method is not None
    total = runs * len(solvers.tabulate(settings.solver, grid).sigma) if fixed else None
    return tqdm(total=total, desc="sampling", unit="step", disable=not progress, dynamic_ncols=True)
