"""Views of a scene at two sizes: the model's, and the one at which pictures are judged.

Both are cut from the same window of the original photos, each directly: a shrunk copy never becomes a large picture.
K is in pixels of the picture it stands beside.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.geometry.crops import cover_window, resize, scale_K, shift_K

Size = tuple[int, int]  # (height, width)
Take = Callable[[list[int], list[int]], dict[str, Any]]
STRETCH = 0.1  # how far the aspect ratios of the two sizes may differ


def check_output(output: Size, size: Size, smallest: int) -> None:
    """Raise UserError unless pictures of a model of `size` can be judged at `output`."""
    text = f"--size {output[0]}x{output[1]}"
    if min(output) < smallest:
        raise UserError(
            f"{text}: pictures are judged at {smallest} x {smallest} pixels or more: give a larger --size."
        )
    if abs(np.log(output[1] * size[0] / (output[0] * size[1]))) > STRETCH:
        raise UserError(
            f"{text} has another shape than this model's pictures, {size[0]}x{size[1]}: give a size of about that shape, "
            f"e.g. {output[0]}x{round(output[0] * size[1] / size[0])}."
        )


def expand(specs: list[str]) -> list[str]:
    """Scene names with procedural:FIRST..LAST written out."""
    names = []
    for spec in specs:
        if spec.startswith("procedural:") and ".." in spec:
            first, _, last = spec.removeprefix("procedural:").partition("..")
            decimal = first.isdecimal() and last.isdecimal()
            if not decimal or not int(first) <= int(last) < 2**31:
                raise UserError(
                    f"'{spec}' is no range of seeds: write procedural:FIRST..LAST, below 2^31."
                )
            names += [f"procedural:{seed}" for seed in range(int(first), int(last) + 1)]
        else:
            names.append(spec)
    return names


def spread(views: int, contexts: int, frames: int) -> tuple[list[int], list[int]]:
    """(context ids, target ids) of a scene: a centred run of views, contexts in the middle of equal parts of it."""
    run = min(views, frames + contexts)
    if run <= contexts:
        raise UserError(
            f"{views} views cannot give {contexts} contexts and a target: use fewer with --context."
        )
    start = (views - run) // 2
    context = [start + int((i + 0.5) * run / contexts) for i in range(contexts)]
    return context, [i for i in range(start, start + run) if i not in context]


def open_views(
    name: str,
    views: int,
    size: Size,
    sweep: tuple[float, float] | None,
    convention: str | None = None,
    output: Size | None = None,
) -> tuple[np.ndarray, Take]:
    """The cameras c2w [v, 4, 4] of a scene (`views` of a procedural one), and what gives some of its views.

    `take(context, target)` is a dict of what was asked for, contexts first: `context`, `target`, c2w (float64); rgb [., h, w, 3],
    K and the targets' depth (or None) at the model's `size`; under `output` the same three at the output size, which is
    the model's if not given, and `photo_depth`, that of the contexts; `photos`, the contexts uncut, each of its own size. A depth map is picked from the nearest pixel,
    never averaged. Procedural scenes are rendered at the larger of the sizes.
    """
    output = output or size
    if name.startswith("procedural:"):
        return _rendered(name, views, size, sweep, output)
    return _photographed(name, size, convention, output)


def _rendered(name: str, views: int, size: Size, sweep: Any, output: Size) -> tuple[Any, Take]:
    from roge_jax.procedural.scenes import SWEEP, sample_sequence
    from roge_jax.scenes.scene import procedural_seed

    large = max(output, size, key=lambda s: s[0] * s[1])
    made = sample_sequence(
        procedural_seed(name),
        frames=views,
        height=large[0],
        width=large[1],
        sweep=SWEEP if sweep is None else (sweep[0], sweep[1]),
    )

    def take(context: list[int], target: list[int]) -> dict[str, Any]:
        order = context + target

        def at(wanted: Size) -> dict[str, Any]:
            rgb, K = zip(*(_cut(made["rgb"][i], made["K"][i], output, wanted) for i in order))
            depth = np.stack([_picked(made["depth"][i], output, wanted) for i in order])
            m = len(context)
            return {"rgb": np.stack(rgb), "K": np.stack(K)} | {
                "depth": depth[m:],
                "photo_depth": depth[:m],
            }

        photos = [made["rgb"][i] for i in context]
        return _both(at, size, output, made["c2w"][order], context, target, photos)

    return made["c2w"], take


def _photographed(
    name: str, size: Size, convention: str | None, output: Size
) -> tuple[np.ndarray, Take]:
    from roge_jax.scenes import scene as scenes

    scene = scenes.load_scene(name, convention=convention)

    def take(context: list[int], target: list[int]) -> dict[str, Any]:
        order = context + target
        # for its checks, and for the picture of one size
        images, cameras = scenes.prepare(scene, order, *output, drop_duplicates=False)

        def at(wanted: Size) -> dict[str, Any]:
            rgb, K = images, np.asarray(cameras.K)
            if wanted != output:
                cut = (_cut(scene.images[i], scene.cameras.K[i], output, wanted) for i in order)
                rgb, K = (np.stack(part) for part in zip(*cut))
            return {"rgb": rgb, "K": K, "depth": None, "photo_depth": None}

        photos = [scene.images[i] for i in context]
        return _both(at, size, output, np.asarray(cameras.c2w), context, target, photos)

    return np.asarray(scene.cameras.c2w, np.float64), take


def _both(
    at: Callable[[Size], dict[str, Any]],
    size: Size,
    output: Size,
    c2w: np.ndarray,
    context: list[int],
    target: list[int],
    photos: list[np.ndarray],
) -> dict[str, Any]:
    large = at(output)
    small = large if output == size else at(size)
    own = {key: small[key] for key in ("rgb", "K", "depth")}
    named = {"c2w": c2w, "context": context, "target": target, "photos": photos}
    return own | named | {"output": large}


def _cut(image: np.ndarray, K: np.ndarray, like: Size, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """The centre of the image with the shape of `like`, at `size`: float32 in [0, 1], and K to match."""
    top, left, height, width = cover_window((image.shape[0], image.shape[1]), like)
    window = image[top : top + height, left : left + width]
    return resize(window, *size), scale_K(shift_K(K, top, left), (height, width), size)


def _picked(depth: np.ndarray, like: Size, size: Size) -> np.ndarray:
    """The depth at the centres of the pixels that `_cut` makes."""
    top, left, height, width = cover_window((depth.shape[0], depth.shape[1]), like)
    rows = top + ((np.arange(size[0]) + 0.5) * height / size[0]).astype(int)
    columns = left + ((np.arange(size[1]) + 0.5) * width / size[1]).astype(int)
    return depth[np.ix_(rows, columns)]
