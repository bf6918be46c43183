"""The reconstruction alone: a scene is encoded once and asked for its own picture from any camera. Nothing is generated.

    known, info = encode(params, config, photos, path)
    pictures = jax.jit(functools.partial(look, config=config))(params, known, *normalised cameras)

Of the parameters it reads those of `PARTS` alone: the generator need not be loaded. `preview` is `sampling.sample` without
a generator; `roge_jax.viewer` asks for one camera at a time.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import cost, model
from ..config import RoGeConfig
from ..core import sharding, target
from ..core.params import Tree
from ..core.stepping import stepping
from ..errors import UserError
from ..geometry.cameras import Cameras, Normalisation, normalise, to_host
from ..geometry.packing import pad_path
from ..recon import depth
from . import limits, programs
from .photos import Photos
from .video import Bar, Result, Stage, at_frames, check_photos
from .windows import window_views, windows

PARTS = model.RECONSTRUCTION
STAGES = ("reconstruct", "query rays", "look into photos")  # of `cost.estimate`


def check_makes_pictures(config: RoGeConfig, name: str) -> None:
    """Raise UserError for a generator alone, which says what it is for."""
    if config.parts == "generator":
        raise UserError(
            f"{name} holds a video generator alone, which sees neither photos nor cameras and makes no picture of a scene "
            "by itself: convert its files again together with a reconstruction (`python -m roge_jax.convert --wan ... "
            "--lagernvs ...`), or call its transformer and VAE in Python (roge_jax.video)."
        )


def at_once(config: RoGeConfig, frames: int) -> int:
    """How many views a program makes, of so many: a chunk of the renderer, so that memory does not grow with the path.

    On a CPU one, where views share nothing: less memory, no slower, and one sees it go on.
    """
    shares = config.renderer.attention == "cross" or config.renderer.lookup or sharding.current()
    most = 1 if target.platform() == "cpu" and not shares else config.renderer.chunk
    most = min(most, config.frames, frames)
    return -(-frames // -(-frames // most))  # alike in all windows, the last one nearly full


class Known(NamedTuple):
    """A scene once it is encoded: all that a picture of it needs, on the devices."""

    tokens: jax.Array  # [m, l, d]
    views: model.Views  # of the photos alone, without targets


def encode(
    params: Tree,
    config: RoGeConfig,
    photos: Photos,
    near: Cameras,
    *,
    scale: float | None = None,
    stage: Stage | None = None,
    cache: dict[Any, Any] | None = None,
) -> tuple[Known, Normalisation]:
    """Photos to scene tokens; `Normalisation.apply` brings cameras into their frame.

    near: cameras about where pictures will be asked for, K in pixels of config.height x config.width. They decide the
      scale only where the photos do not, as of a single one. scale: a divisor of all positions instead. cache: keeps
      the compiled program for further calls with these parameters and config.
    """
    stage = stage or (lambda name: nullcontext())
    cache = {} if cache is None else cache
    views, info = of_photos(config, photos, near, scale=scale)
    key = "encode", _shapes(views)
    if key not in cache:
        with stage("compile"):
            cache[key] = encoder(params, views, config)
    with stage("prepare"):
        return jax.block_until_ready(cache[key](params, views)), info


def _shapes(tree: Any) -> tuple[tuple[int, ...], ...]:
    return tuple(x.shape for x in jax.tree.leaves(tree))


def of_photos(
    config: RoGeConfig, photos: Photos, near: Cameras, *, scale: float | None = None
) -> tuple[model.Views, Normalisation]:
    """(the views of the photos alone, the frame that they are in); arguments as of `encode`."""
    check_makes_pictures(config, f"The model '{config.name}'")
    check_photos(photos, config)
    context, targets, info = normalise(photos.cameras, near, rule=config.scale_rule, scale=scale)
    seen = photos.images, photos.recon, context
    views = window_views(*seen, targets[:1], info, config, frames=1, full=photos.full)
    views |= {"K": views["K"][:-1], "c2w": views["c2w"][:-1]}
    return jax.device_put(views, sharding.everywhere()), info


def encoder(params: Tree, views: model.Views, config: RoGeConfig) -> Callable:
    """(params, views) -> `Known`, compiled for these shapes."""
    return _compiled(_encoding(params, views, config))[0]


def both(
    params: Tree, views: model.Views, count: int, config: RoGeConfig, photos: int | None = None
) -> list[Callable]:
    """[`encoder`, `compiled`] side by side: what the first picture waits for is their compilation."""
    known = jax.eval_shape(functools.partial(_known, config=config), params, views)
    looking = _looking(params, known, count, config, photos)
    return _compiled(_encoding(params, views, config), looking)


class _Program(NamedTuple):
    """A jitted function and the shapes that it is to be compiled for."""

    function: Any
    shapes: tuple[Any, ...]


def _compiled(*programs: _Program) -> list[Callable]:
    """Compiled side by side. Tracing holds Python's lock, compiling does not."""
    if stepping():
        return [program.function for program in programs]
    lowered = [program.function.lower(*program.shapes) for program in programs]
    with ThreadPoolExecutor(len(lowered)) as pool:
        return list(pool.map(lambda low: low.compile(), lowered))


def _encoding(params: Tree, views: model.Views, config: RoGeConfig) -> _Program:
    known = functools.partial(_known, config=config)
    return _Program(jax.jit(known), tuple(sharding.shapes((params, views))))


def _known(params: Tree, views: model.Views, *, config: RoGeConfig) -> Known:
    full = views.get("full")
    tokens = model.reconstruct(params, views, config=config)
    if full is None:
        return Known(tokens, views)
    match, size = params["renderer"]["lookup"].get("match"), (config.height, config.width)
    cameras = views["K"], views["c2w"]
    full = depth.prepared(match, full, *cameras, size=size, cuts=config.renderer.lookup)
    return Known(tokens, views | {"full": full})


def among(known: Known, kept: jax.Array) -> Known:
    """Some of the photos [k] of a scene: what is known of the others is not looked at."""
    views = {name: x[kept] for name, x in known.views.items() if name != "full"}
    if (full := known.views.get("full")) is not None:
        views["full"] = full.among(kept)
    return Known(known.tokens[kept], views)


def look(
    params: Tree,
    known: Known,
    K: jax.Array,
    c2w: jax.Array,
    kept: jax.Array | None = None,
    *,
    config: RoGeConfig,
) -> jax.Array:
    """The picture [n, H, W, 3] at the output's size of cameras K [n, 3, 3] in pixels of config.height x config.width, c2w
    [n, 4, 4] normalised. `kept`: of some of the photos alone (`among`)."""
    known = known if kept is None else among(known, kept)
    views = {name: jnp.concatenate([known.views[name], x]) for name, x in (("K", K), ("c2w", c2w))}
    shown, full = programs.rgb_head(
        params, known.views | views, config=config, scene_tokens=known.tokens
    )
    return model.resized(shown, *config.output_size) if full is None else full


def compiled(
    params: Tree, known: Known, count: int, config: RoGeConfig, photos: int | None = None
) -> Callable:
    """`look` for `count` cameras: (params, known, K, c2w) -> pictures; with `photos`, how many, their numbers come last."""
    return _compiled(_looking(params, known, count, config, photos))[0]


def _looking(
    params: Tree, known: Known, count: int, config: RoGeConfig, photos: int | None
) -> _Program:
    shapes: list[Any] = [((count, n, n), jnp.float32) for n in (3, 4)]
    shapes += [] if photos is None else [((photos,), jnp.int32)]
    where = sharding.everywhere()
    cameras = (jax.ShapeDtypeStruct(shape, kind, sharding=where) for shape, kind in shapes)
    program = jax.jit(functools.partial(look, config=config), out_shardings=where)
    return _Program(program, (*sharding.shapes((params, known)), *cameras))


def preview(
    params: Tree,
    config: RoGeConfig,
    photos: Photos,
    path: Cameras,
    *,
    scale: float | None = None,
    stage: Stage | None = None,
    progress: bool | Bar = False,
    cache: dict[Any, Any] | None = None,
    known: Collection[str] = (),
) -> Result:
    """The reconstruction's picture along `path`, as `frames` and `preview` of a result without evaluations.

    As `sampling.sample`, whose windows all see the photos alone here. `scale`: as of `encode`. `known`: as there. The scene is encoded once;
    its pictures come `at_once` and wait for no others.
    """
    from tqdm import tqdm

    stage = stage or (lambda name: nullcontext())
    cache = {} if cache is None else cache
    warned = limits.warn(photos.images, photos.cameras, path, config.name, photos.ids, known)
    views, info = of_photos(config, photos, path, scale=scale)
    targets = info.apply(path)
    length = at_once(config, len(path))
    key = "preview", length, _shapes(views)
    if key not in cache:
        with stage("compile"):
            cache[key] = both(params, views, length, config)
    encoding, run = cache[key]
    with stage("prepare"):
        encoded = jax.block_until_ready(encoding(params, views))
    frames = []
    bar: Any = progress
    if isinstance(progress, bool):
        bar = tqdm(desc="preview", unit="frame", disable=not progress, dynamic_ncols=True)
    bar.reset(len(path))
    for start, stop in windows(len(path), length):
        some = pad_path(targets[start:stop], length)
        K, c2w = (np.asarray(x, np.float32) for x in (some.K, some.c2w))
        with stage("preview"):
            frames.append(np.array(run(params, encoded, K, c2w))[: stop - start])
        bar.update(stop - start)
    bar.close()
    made = np.concatenate(frames)
    whole, used = [0, len(path) - 1], list(photos.ids)
    told = {"frames": whole, "photos": used, "generated": [], "rgb_head": [whole]}
    return Result(made, made, at_frames(to_host(path), config), info, 0, (told,), warned)


def held_weights(config: RoGeConfig, mesh: sharding.AnyMesh, dtype: str) -> int:
    """`cost.held_weights` of the reconstruction alone."""
    specs = model.specs(config)
    return sharding.held({part: specs[part] for part in PARTS}, mesh, cost.kept_as(dtype))


def report(config: RoGeConfig, m: int, *, frames: int, half: bool) -> str:
    """What `--preview-only --dry-run` prints: the parts of `cost.report` that run."""
    dtype, size = jnp.bfloat16 if half else jnp.float32, (config.recon_height, config.recon_width)
    together = at_once(config, frames)
    chunk = dataclasses.replace(config.renderer, chunk=together)
    whole = cost.estimate(dataclasses.replace(config, renderer=chunk), m, 0, dtype=dtype)
    rays = frames + (m if config.renderer.refinement == "shared" else 0)
    flops = {
        "reconstruct": cost.encoder(config.encoder, *size, m, config.renderer.width),
        "query rays": cost.renderer(
            config.renderer, *size, cost.scene_tokens_read(config, m), m, rays
        ),
        "look into photos": cost.lookup(config.renderer, *size, m, frames),
    }
    working = {name: whole.working_bytes[name] for name in STAGES if name in whole.working_bytes}
    # Ray features of a program's views alone are there at a time, and not those of the photos.
    waiting = m + config.frames - together
    rays_each = whole.tokens["ray tokens per view"] - config.renderer.registers
    working["query rays"] -= 4.0 * waiting * rays_each * config.renderer.width
    weights, output = sum(whole.weights[part] for part in PARTS), config.output_size
    count = sum(cost.weight_bytes(config)[part] for part in PARTS) / 4e6
    peak = weights + max(working.values())
    if config.renderer.lookup and output != size:
        peak += cost.rendering.working_bytes(m, *output, config.frames + 2 * frames)
    lines = [
        f"model     {config.name}, its reconstruction alone: {count:,.1f} M parameters, {weights / 1e9:,.2f} GB in "
        f"{'bfloat16' if half else 'float32'}",
        f"preview   {frames} frames of {output[0]}x{output[1]} (reconstruction at {size[0]}x{size[1]}); nothing is "
        "generated",
        f"photos    {m}, {whole.tokens['scene tokens']:,} scene tokens",
        "",
        f"{'stage':24s}{'FLOPs':>16s}{'working memory':>18s}",
    ]
    for name in working:
        work, flop = cost.scaled(working[name], "B"), cost.scaled(flops[name], "FLOP")
        lines.append(f"{name:24s}{flop:>16s}{work:>18s}")
    total = cost.scaled(sum(flops[name] for name in working), "FLOP")
    lines += [f"{'all frames':24s}{total:>16s}", ""]
    lines.append(
        f"peak memory about {cost.scaled(peak, 'B')}: weights and the hungriest stage, beside the runtime's own 0.3 to "
        "0.6 GB"
    )
    return "\n".join(lines)
