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
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import model
from ..config import RoGeConfig
from ..core import sharding
from ..core.params import Tree
from ..errors import UserError
from ..geometry.cameras import Cameras, Normalisation, concatenate, normalise, to_host
from ..geometry.crops import scale_K
from . import limits, programs
from .choices import Choices, Planned, around, spans
from .photos import Photos
from .photos import check_photos as check_photos
from .settings import LONG as LONG
from .settings import SLOTS as SLOTS
from .settings import Settings as Settings
from .settings import noise_levels as noise_levels
from .steps import Bar as Bar
from .steps import integrate as integrate
from .steps import started
from .whole import Whole
from .windows import (
    chain_views,
    chained,
    stretch_noise,
    window_noise,
    window_views,
    windows,
    woven,
)

NOTHING_TO_PLAN = "A reconstruction alone has no generator to spare: sample without a plan."
Stage = Callable[[str], AbstractContextManager]


@dataclasses.dataclass(frozen=True)
class Result:
    """frames and preview [n, H, W, 3] float32 in [0, 1] at the output's size; cameras [n] in the scene's frame, K in
    pixels of the frames. A model without output of its own shows its preview at the reconstruction's size."""

    frames: np.ndarray
    preview: np.ndarray
    cameras: Cameras
    normalisation: Normalisation
    evaluations: int  # of the velocity network, all windows together
    # {"frames": [first, last], "photos": [...], "generated": [...], the frames already made that it saw}, and with a plan
    # {"rgb_head": [[first, last], ...]}, the frames that are not generated
    windows: tuple[dict[str, Any], ...]
    warnings: tuple[limits.Beyond, ...] = ()  # beyond what the model was measured to stand


# ---- compiled pieces -----------------------------------------------------------------------------


def reduced(
    photos: Photos, config: RoGeConfig, settings: Settings, choices: Choices
) -> tuple[Photos, RoGeConfig, Settings]:
    """What `sample` runs with under `choices`; equal to what it was given if they are the full model's."""
    if len(choices.photos) < len(photos.ids):
        photos = photos.keep(choices.photos)
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


def sample(
    params: Tree,
    config: RoGeConfig,
    photos: Photos,
    path: Cameras,
    settings: Settings | None = None,
    *,
    stage: Stage | None = None,
    plan: Planned | None = None,
    progress: bool | Bar = False,
    cache: dict[Any, Any] | None = None,
    known: Collection[str] = (),
) -> Result:
    """The video along `path` (cameras [n] in the scene's frame, K in pixels of config.height x config.width).

    Of a reconstruction alone, or where `settings` do not ask for the generator of a model whose preview is better, it is
    `reconstruction.preview`; of the settings it takes the scale.

    Args:
      stage: called with "compile", "prepare", "sample" and "decode"; a context manager that times (`entry.Clock`).
      plan: what to leave out (`planning.plan`); its steps, solver and schedule replace those of `settings`.
      progress: show a bar over all evaluations of the velocity, or the bar to tell them to.
      cache: a dict that keeps the compiled programs for further calls with these parameters, config and slots.
      known: kinds of `limits` that are no news to the user: they are in the result, and no warning is given.
    Raises: UserError for what cannot be done; `solvers.SamplingError` at the first number that is not finite.
    """
    stage = stage or (lambda name: nullcontext())
    settings = (settings or Settings()).of(config)
    cache = {} if cache is None else cache
    if config.parts != "all" and plan is not None:
        raise UserError(NOTHING_TO_PLAN)
    if config.parts != "all" or not (settings.generate or plan):
        from . import reconstruction  # it imports this module, and refuses a generator alone

        show = functools.partial(
            reconstruction.preview, stage=stage, progress=progress, cache=cache, known=known
        )
        return show(params, config, photos, path, scale=settings.scale)
    given, unplanned = len(photos.ids), config
    check_photos(photos, config)
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
    warned = limits.warn(photos.images, photos.cameras, path, config.name, photos.ids, known)
    grid = noise_levels(settings, config)
    runs = windows(len(path), config.frames)
    made, length = spans(plan, runs, config.frames)
    bar = started(progress, settings, grid, sum(first < last for first, last in made))
    frames: list[np.ndarray] = []
    previews: list[np.ndarray] = []
    told: list[dict[str, Any]] = []
    evaluations = 0
    for number, (window, stretch) in enumerate(zip(runs, made, strict=True)):
        (start, stop), (first, last) = window, stretch
        later = number > 0 and settings.long == "chain"
        own = (photos.images, photos.recon, photos.full)
        seen = _Seen(*own, context, list(range(len(context))), [])
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
        see = functools.partial(
            window_views,
            seen.images,
            seen.recon,
            seen.cameras,
            info=info,
            config=config,
            full=seen.full,
        )
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
                frame, preview = _shown(run.preview(params, *views), len(shown), config)
            frames.append(frame)
            previews.append(preview)
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
            video = np.asarray(run.decode(params, x0, prepared.detail))[: last - first]
            low = np.asarray(prepared.shown)[: last - first]
            frame, preview = _shown((prepared.shown, prepared.full), last - first, config)
            frames.append(at_output(video, low, frame, config))
            previews.append(preview)
            if picture is not None:
                frame, preview = _shown(picture, len(shown), config)
                previews[-1] = woven(previews[-1], preview, first - start)
                frames[-1] = woven(frames[-1], frame, first - start)
        evaluations += count
    bar.close()
    return Result(
        np.concatenate(frames),
        np.concatenate(previews),
        at_frames(to_host(path), config),
        info,
        evaluations,
        tuple(told),
        warned,
    )


def _shown(made, count: int, config: RoGeConfig) -> tuple[np.ndarray, np.ndarray]:
    """(frames, preview) of `count` targets from the reconstruction's picture alone: (its own size, the output's or None).

    Copies: on a CPU a view would keep the device's array alive.
    """
    if made[1] is not None:
        full = np.array(made[1])[:count]
        return full, full
    shown = np.array(made[0])[:count]
    return _enlarged(shown, *config.output_size), shown


def at_output(
    video: np.ndarray, low: np.ndarray, full: np.ndarray, config: RoGeConfig
) -> np.ndarray:
    """A generated video [n, h, w, 3] at the output's size: what the generator changed of the reconstruction's picture
    `low`, added to that at the output's size `full`."""
    if config.output_size == video.shape[1:3]:
        return np.array(video)
    change = _enlarged(video - _enlarged(low, *video.shape[1:3]), *config.output_size)
    return np.clip(full + change, 0.0, 1.0)


def at_frames(path: Cameras, config: RoGeConfig) -> Cameras:
    """Cameras with K in pixels of the frames instead of the model's."""
    return Cameras(scale_K(path.K, (config.height, config.width), config.output_size), path.c2w)


class _Seen(NamedTuple):
    """What a window sees: images, the same at reconstruction size and whole or None, their cameras in the normalised
    frame, and which photos and which frames already made they are."""

    images: np.ndarray
    recon: np.ndarray | None
    full: Whole | None
    cameras: Cameras
    photos: list[int]
    made: list[int]


def _seen_later(
    seen: _Seen, target: Cameras, frames: list[np.ndarray], window: tuple[int, int], config
) -> _Seen:
    """What a window after the first one sees, of the photos and of the `frames` of the windows before it."""
    start, stop = window
    kept, chosen = chain_views(seen.cameras, target[:start], target[start:stop], config)
    images = seen.images
    found = [frames[i // config.frames][i % config.frames] for i in chosen]
    old = np.reshape(found, (-1, *config.output_size, 3)).astype(images.dtype)

    def joined(own: np.ndarray) -> np.ndarray:
        return np.concatenate([own[kept], _enlarged(old, *own.shape[1:3])])

    return _Seen(
        joined(images),
        None if seen.recon is None else joined(seen.recon),
        None if seen.full is None else seen.full.keep(kept).joined(old),
        concatenate(seen.cameras[kept], target[np.array(chosen, int)]),
        kept,
        chosen,
    )


def _enlarged(images: np.ndarray, height: int, width: int) -> np.ndarray:
    return np.asarray(model.resized(jnp.asarray(images), height, width))
