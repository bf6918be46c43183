"""Frozen networks once: samples stored as what the video transformer is told of them.

Where only the transformer and the fusion train (stages `generator`, `hires`), reconstruction, ray queries, the picture
of the targets and the VAE say the same of a sample every time they meet it, and take most of a step. With
`--encode-once N` N samples are drawn as any others, encoded, and kept on disk; the stage then draws from them, each time
with noise of its own. The transformer's part of the loss is that of the joint objective; the photometric term, which no
trained leaf moves, is left out.
"""

import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .. import fusion, model, preview
from ..config import RoGeConfig
from ..core.params import Tree
from ..errors import UserError
from ..files.folders import put
from ..geometry.rays import plucker

Clip = dict[str, jax.Array]
READS = ("encoder", "renderer", "vae")  # what encoding needs of a model
_NAME = re.compile(r"m(\d+)_(\d+)\.npz")


def encode(params: Tree, views: model.Views, *, config: RoGeConfig) -> Clip:
    """What no noise level and no weight of the transformer changes of one sample (arrays of `data.views.make_sample`).

    Returns the latents of all slots x0 [m + s, lh, lw, 16], contexts first; standardised ray features [m + n, gh, gw, d]
    in float16, or as they are if nobody has measured them (a few channels may then be beyond its range); K and c2w of all
    views; and, for a model with one, the latents of the preview [s, lh, lw, 16].
    """
    latents = [
        model.encode_contexts(params, views["context_rgb"], config=config),
        model.encode_targets(params, views["target_rgb"], config=config),
    ]
    tokens = model.reconstruct(params, views, config=config)
    features = model.query_rays(params, tokens, views, config=config)
    kept = features.dtype if config.fusion.feature_std is None else jnp.float16
    shown = model.show(params, features, views, config=config)
    guess = preview.latents(params, shown, config=config)
    clip = {
        "x0": jnp.concatenate(latents),
        "features": fusion.standardised(features, config).astype(kept),
        "K": views["K"],
        "c2w": views["c2w"],
    }
    return clip if guess is None else clip | {"preview": guess}


def condition(params: Tree, clip: Clip, *, config: RoGeConfig) -> fusion.Condition:
    """C = {Y, P, G} of an encoded sample, as `model.condition` makes it of the sample itself."""
    slots = config.slots(0)
    rays = plucker(clip["K"], clip["c2w"], config.height, config.width)
    return fusion.condition(
        params["fusion"],
        clip["x0"][:-slots],
        rays,
        clip["features"].astype(jnp.float32),
        clip.get("preview"),
        config.fusion.preview_std,
    )


def flow_term(
    params: Tree, clip: Clip, key: jax.Array, *, config: RoGeConfig, **options
) -> jax.Array:
    """`model.flow_matching` of an encoded sample; `options` are its draws and remat."""
    contexts = len(clip["x0"]) - config.slots(0)
    with jax.named_scope("condition"):
        cond = condition(params, clip, config=config)
    return model.flow_matching(
        params, clip["x0"], cond, key, config=config, contexts=contexts, **options
    )


def each(encode: Callable[[dict], Clip], batch: dict) -> dict[str, np.ndarray]:
    """`encode` of every sample of a batch, stacked again."""
    clips = [encode({name: x[i] for name, x in batch.items()}) for i in range(len(batch["K"]))]
    return {name: np.stack([np.asarray(clip[name]) for clip in clips]) for name in clips[0]}


class Clips:
    """The first `count` samples of a stage, encoded: one file each in `folder`, where a file that is there is whole.

    `draw(i)`: sample i as a batch of one; `encode`: from its arrays, without that axis, to a `Clip`. Raises: UserError
    if there are samples already and it is not their run that goes on (`resume`).
    """

    def __init__(
        self,
        folder: Path,
        count: int,
        draw: Callable[[int], dict],
        encode: Callable[[dict], Clip],
        *,
        resume: bool = False,
    ):
        folder.mkdir(parents=True, exist_ok=True)
        found = {i for _, i in _numbers(folder)}
        if found and not resume:
            raise UserError(
                f"{folder} holds samples of an earlier run: continue it with --resume, or choose another --out."
            )
        for i in tqdm([i for i in range(count) if i not in found], "encoding", unit="sample"):
            batch = draw(i)
            clip = {name: x[0] for name, x in each(encode, batch).items()}
            part = folder / "next.part"
            with part.open("wb") as stream:
                np.savez(stream, allow_pickle=False, **clip)
            put(part, folder / f"m{batch['context_rgb'].shape[1]}_{i:06d}.npz")
        self.files: dict[int, list[Path]] = {}
        for (m, i), file in _numbers(folder).items():
            if i < count:
                self.files.setdefault(m, []).append(file)

    def batch(self, seed: int, index: int, size: int) -> dict[str, np.ndarray]:
        """Batch number `index`, a pure function of its arguments: `size` samples of one number of photos."""
        rng = np.random.default_rng([seed, index, 1])
        numbers = sorted(m for m, files in self.files.items() if len(files) >= size)
        if not numbers:
            most = max(map(len, self.files.values()))
            raise UserError(
                f"--encode-once gave at most {most} samples of one number of photos, and a step draws {size}: encode "
                "more, or give a smaller --batch."
            )
        weights = np.array([len(self.files[m]) for m in numbers], np.float64)
        files = self.files[int(rng.choice(numbers, p=weights / weights.sum()))]
        clips = [_read(files[row]) for row in rng.choice(len(files), size, replace=False)]
        return {name: np.stack([clip[name] for clip in clips]) for name in clips[0]}


def _numbers(folder: Path) -> dict[tuple[int, int], Path]:
    """{(photos, number of the sample): its file}."""
    named = [(_NAME.fullmatch(file.name), file) for file in sorted(folder.iterdir())]
    return {(int(name[1]), int(name[2])): file for name, file in named if name}


def _read(file: Path) -> dict[str, np.ndarray]:
    try:
        with file.open("rb") as stream, np.load(stream) as stored:
            return dict(stored)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise UserError(
            f"{file} is damaged ({error}): delete it, and --resume encodes it again."
        ) from None
