"""Photos and a camera path in, the video along the path out: windows of the model, one after another.

    photos = read_photos(scene, [0, 4, 9], config)
    path = make_path("orbit", photos.cameras, frames=81)
    result = sample(params, config, photos, path, Settings(seed=1))

One window is `config.frames` targets. A path of any other length is padded at its end to whole windows by going on
as it last moved, and the surplus is dropped. All windows share one world frame and one scale. In a path longer than
a window, `chain` gives the later windows frames already made as further contexts (the last one, and those closest to
what comes); `independent` gives every window the photos alone, as the paper does. Windows after the first have equal
shapes, so there are at most two compilations of anything. A plan may leave windows, or all of a window but a stretch of
one length, to the RGB head: for both kinds of window that is one compilation more each.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import model
from ..config import RoGeConfig
from ..core import sharding
from ..core.params import Tree
from ..errors import UserError, did_you_mean
from ..files import fields
from ..geometry.cameras import Cameras, Normalisation, concatenate, normalise, to_host
from ..scenes.coverage import see_path
from ..scenes.overlap import select_overlapping
from ..scenes.scene import Scene, distinct_views, select_context
from ..scenes.scene import prepare as prepare_photos
from ..video import flow, solvers
from . import limits, programs
from .choices import Choices, Planned, around, spans
from .windows import (
    chain_views,
    chained,
    stretch_noise,
    window_noise,
    window_views,
    windows,
    woven,
)

DEFAULT_CONTEXT = 6  # photos, where the scene and the model have that many
LONG = ("chain", "independent")
SLOTS = ("noised", "clean", "free")

Stage = Callable[[str], AbstractContextManager]


@dataclasses.dataclass(frozen=True)
class Settings:
    """How to sample; all of it goes into run.json. Steps 0, no solver, no schedule: the model's own (`of`)."""

    steps: int = 0
    solver: str = ""
    schedule: str = ""
    seed: int = 0
    slots: flow.ContextSlots = "noised"
    long: Literal["chain", "independent"] = "chain"
    scale: float | None = None  # divisor of all positions, in scene units; None: the model's rule

    def __post_init__(self):
        for name, word, allowed in (
            ("solver", self.solver or "euler", tuple(solvers.SOLVERS)),
            ("context slots", self.slots, SLOTS),
            ("long", self.long, LONG),
        ):
            if word not in allowed:
                raise UserError(f"Unknown {name} '{word}': {did_you_mean(word, allowed)}")
        fields.number(self.seed, "Settings", "seed", low=0, whole=True)
        if self.scale is not None:
            fields.number(self.scale, "Settings", "scale", low=1e-30)
        if self.schedule != "optimised":  # those belong to a model, which `sample` knows
            flow.schedule(self.schedule or "uniform", self.steps or 1)

    def of(self, config: RoGeConfig) -> "Settings":
        """These settings with what they leave open as the model's configuration has it."""
        own = config.flow
        return dataclasses.replace(
            self,
            steps=self.steps or own.steps,
            solver=self.solver or own.solver,
            schedule=self.schedule or own.schedule,
        )


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
    # {"frames": [first, last], "photos": [...], "generated": [...], the frames already made that it saw}, and with a plan
    # {"rgb_head": [[first, last], ...]}, the frames that are not generated
    windows: tuple[dict[str, Any], ...]
    warnings: tuple[limits.Beyond, ...] = ()  # beyond what the model was measured to stand


def context_ids(
    text: str | None, scene: Scene, config: RoGeConfig, path: Cameras | None = None
) -> list[int]:
    """The views that --context asks for: how many, or which by number or name; without a word, up to 6.

    Those that it leaves open are chosen for the `path` where that is known before (K in pixels of the model's size).
    """
    most = config.max_context
    if text is None:
        return _chosen(scene, min(len(scene), most, DEFAULT_CONTEXT), config, path)
    words = [word.strip() for word in text.split(",")]
    if any(words) and ("," in text or text in scene.names):
        return [_view(word, scene) for word in words if word]
    if not text.isdecimal() or not 1 <= int(text) <= min(len(scene), most):
        raise UserError(
            f"--context {text}: give 1 to {min(len(scene), most)} (the scene has {len(scene)} photos, the "
            f"model takes {most}), or photos by number or name, separated by commas."
        )
    return _chosen(scene, int(text), config, path)


def _chosen(scene: Scene, count: int, config: RoGeConfig, path: Cameras | None) -> list[int]:
    """So many photos of a scene: those that see most of the path, or that hang together; all where there are no more."""
    if path is not None and count < len(scene):
        return see_path(scene, path, count, config.height, config.width)
    if count in (1, len(scene)):
        return select_context(scene, count)
    return select_overlapping(scene, count, config.height, config.width)


def _view(word: str, scene: Scene) -> int:
    if word in scene.names:
        return scene.names.index(word)
    if word.isdecimal() and int(word) < len(scene):
        return int(word)
    if word.isdecimal():
        raise UserError(
            f"--context: there is no photo {word}: {scene.source} has {len(scene)}, from 0."
        )
    raise UserError(
        f"--context: {scene.source} has no photo '{word}': {did_you_mean(word, scene.names)}"
    )


def read_photos(scene: Scene, ids: Sequence[int], config: RoGeConfig) -> Photos:
    """The photos `ids` of a scene, the first one being the world frame. Duplicates are dropped with a warning."""
    ids = list(ids)
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


def blank_scene(source: str, views: int, config: RoGeConfig) -> Scene:
    """Black photos of the model's size from cameras side by side: what a run costs does not depend on more."""
    w, h = config.width, config.height
    K = np.array([[w, 0.0, w / 2], [0.0, w, h / 2], [0.0, 0.0, 1.0]])
    c2w = np.tile(np.eye(4), (views, 1, 1))
    c2w[:, 0, 3] = 0.1 * np.arange(views)
    images = [np.zeros((h, w, 3), np.uint8)] * views
    names = tuple(f"{i:04d}" for i in range(views))
    return Scene(images, Cameras(np.tile(K, (views, 1, 1)), c2w), names, source)


def _check_photos(photos: Photos, config: RoGeConfig) -> None:
    wanted = (len(photos.ids), config.height, config.width, 3)
    if np.shape(photos.images) != wanted or len(photos.cameras) != wanted[0]:
        raise UserError(
            f"Photos of shape {np.shape(photos.images)} with {len(photos.cameras)} cameras for {wanted[0]} ids do not "
            f"fit a model of {config.height}x{config.width} ({config.name}): make them with sampling.read_photos."
        )


# ---- compiled pieces -----------------------------------------------------------------------------


def reduced(
    photos: Photos, config: RoGeConfig, settings: Settings, choices: Choices
) -> tuple[Photos, RoGeConfig, Settings]:
    """What `sample` runs with under `choices`; equal to what it was given if they are the full model's."""
    if len(choices.photos) < len(photos.ids):
        kept = list(choices.photos)
        recon = None if photos.recon is None else photos.recon[kept]
        ids = tuple(photos.ids[i] for i in kept)
        photos = Photos(photos.images[kept], recon, photos.cameras[kept], ids)
    size = (config.recon_height, config.recon_width)
    if choices.recon != size:
        recon = photos.images if photos.recon is None else photos.recon
        photos = photos._replace(
            recon=np.asarray(model.resized(jnp.asarray(recon), *choices.recon))
        )
    config = dataclasses.replace(
        config,
        recon_height=choices.recon[0],
        recon_width=choices.recon[1],
        renderer=dataclasses.replace(config.renderer, merge=choices.merge),
    )
    settings = dataclasses.replace(
        settings, steps=choices.steps, solver=choices.solver, schedule=choices.schedule
    )
    return photos, config, settings


def noise_levels(settings: Settings, config: RoGeConfig) -> np.ndarray:
    """The noise levels [steps + 1] of settings that leave nothing open (`Settings.of`)."""
    return flow.schedule(
        settings.schedule,
        settings.steps,
        shift=config.flow.shift,
        solver=settings.solver,
        model=config.name,
    )


def sample(
    params: Tree,
    config: RoGeConfig,
    photos: Photos,
    path: Cameras,
    settings: Settings = Settings(),
    *,
    stage: Stage | None = None,
    plan: Planned | None = None,
    progress: bool = False,
    cache: dict[Any, Any] | None = None,
) -> Result:
    """The video along `path` (cameras [n] in the scene's frame, K in pixels of config.height x config.width).

    Args:
      stage: called with "compile", "prepare", "sample" and "decode"; a context manager that times (`entry.Clock`).
      plan: what to leave out (`planning.plan`); its steps, solver and schedule replace those of `settings`.
      progress: show a bar over all evaluations of the velocity.
      cache: a dict that keeps the compiled programs for further calls with these parameters, config and slots.
    Raises: UserError for what cannot be done; `solvers.SamplingError` at the first number that is not finite.
    """
    stage = stage or (lambda name: nullcontext())
    cache = {} if cache is None else cache
    given, unplanned, settings = len(photos.ids), config, settings.of(config)
    _check_photos(photos, config)
    if plan is not None:
        if tuple(plan.ids) != tuple(photos.ids):
            raise UserError(
                f"The plan was made for views {list(plan.ids)} of the scene and the photos are views {list(photos.ids)}: "
                "give read_photos(scene, plan.ids, config), or plan again for these photos."
            )
        if max(plan.choices.photos, default=0) >= given:
            raise UserError(
                f"The plan takes photo {max(plan.choices.photos)} of {given}, from 0: plan again for these photos."
            )
        photos, config, settings = reduced(photos, config, settings, plan.choices)
    context, target, info = normalise(
        photos.cameras, path, rule=config.scale_rule, scale=settings.scale
    )
    warned = limits.warn(photos.images, photos.cameras, path, config.name, photos.ids)
    grid = noise_levels(settings, config)
    runs = windows(len(path), config.frames)
    made, length = spans(plan, runs, config.frames)
    bar = _bar(progress, settings, grid, sum(first < last for first, last in made))
    frames: list[np.ndarray] = []
    previews: list[np.ndarray] = []
    told: list[dict[str, Any]] = []
    evaluations = 0
    for number, (window, stretch) in enumerate(zip(runs, made, strict=True)):
        (start, stop), (first, last) = window, stretch
        later = number > 0 and settings.long == "chain"
        seen = _Seen(photos.images, photos.recon, context, list(range(len(context))), [])
        if later:
            seen = _seen_later(seen, target, frames, window, config)
        m, rest = len(seen.cameras), around(window, stretch)
        shown = [i for a, b in rest for i in range(a, b)]  # by the RGB head
        told.append(
            {
                "frames": [start, stop - 1],
                "photos": [photos.ids[i] for i in seen.photos],
                "generated": seen.made,
            }
        )
        if rest:
            told[-1]["rgb_head"] = [[a, b - 1] for a, b in rest]
        see = functools.partial(window_views, *seen[:3], info=info, config=config)
        if first == last:
            part, views = config, [see(target[start:stop])]
        else:
            part = dataclasses.replace(config, frames=length)
            views = [see(target[first:last], frames=length)]
            if shown:
                views.append(see(target[np.array(shown)], frames=config.frames - length))
        usual = first < last and not shown and part == unplanned
        key = m if usual else (m, first < last, bool(shown), part)
        if key not in cache:
            bar.set_description("compiling")
            with stage("compile"):
                make = programs.for_window if first < last else programs.for_preview
                cache[key] = make(params, views[0], part, settings.slots, *views[1:])
        run = cache[key]
        if first == last:
            with stage("preview"):
                previews.append(np.array(run.preview(params, *views))[: len(shown)])
            frames.append(_enlarged(previews[-1], photos.images))
            continue
        bar.set_description("sampling")
        # With fewer photos than given, the targets keep the noise that they have with all of them.
        full = sum(chained(given, config)) if later else given
        with stage("prepare"):
            ready = jax.block_until_ready(run.prepare(params, *views))
            prepared, picture = ready if shown else (ready, None)
            noise = window_noise(settings.seed, number, max(full, m), config)[-config.slots(m) :]
            noise = stretch_noise(noise, m, first - start, part)
            noise = jax.device_put(noise, sharding.everywhere())
        with stage("sample"):
            x0, count = integrate(run, params, prepared, noise, grid, settings, part, bar)
        with stage("decode"):
            # Copies: on a CPU a view would keep the device's array alive.
            frames.append(np.array(run.decode(params, x0, prepared.detail))[: last - first])
            previews.append(np.array(prepared.shown)[: last - first])
            if picture is not None:
                others = np.array(picture)[: len(shown)]
                previews[-1] = woven(previews[-1], others, first - start)
                frames[-1] = woven(frames[-1], _enlarged(others, photos.images), first - start)
        evaluations += count
    bar.close()
    return Result(
        np.concatenate(frames),
        np.concatenate(previews),
        to_host(path),
        info,
        evaluations,
        tuple(told),
        warned,
    )


class _Seen(NamedTuple):
    """What a window sees: images, the same at reconstruction size or None, their cameras in the normalised frame, and
    which photos and which frames already made they are."""

    images: np.ndarray
    recon: np.ndarray | None
    cameras: Cameras
    photos: list[int]
    made: list[int]


def _seen_later(
    seen: _Seen, target: Cameras, frames: list[np.ndarray], window: tuple[int, int], config
) -> _Seen:
    """What a window after the first one sees, of the photos and of the `frames` of the windows before it."""
    start, stop = window
    kept, chosen = chain_views(seen.cameras, target[:start], target[start:stop], config)
    images, recon = seen.images[kept], seen.recon
    found = [frames[i // config.frames][i % config.frames] for i in chosen]
    old = np.reshape(found, (-1, *images.shape[1:])).astype(images.dtype)
    if recon is not None:
        recon = np.concatenate([recon[kept], _enlarged(old, recon)])
    cameras = concatenate(seen.cameras[kept], target[np.array(chosen, int)])
    return _Seen(np.concatenate([images, old]), recon, cameras, kept, chosen)


def integrate(
    run: programs.Programs,
    params,
    prepared,
    noise,
    grid,
    settings: Settings,
    config: RoGeConfig,
    bar,
):
    """(latents of all slots, evaluations): noise to sample, one evaluation per step of the bar."""
    if solvers.SOLVERS[settings.solver].method is None:  # adaptive: one program, no steps to show

        @jax.jit
        def whole(params, prepared, noise):
            def field(x, sigma):
                return programs.velocity(
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
