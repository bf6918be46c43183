"""What a stage starts from: where its sequences come from, and whether a run that goes on is still the same one."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from .. import checkpoint
from ..checkpoint import find_model, load_provenance, model_fingerprint
from ..config import RoGeConfig
from ..core import distributed, products, target
from ..core.params import Tree, loaded
from ..cost import kept_as
from ..data.source import MOST_BAD, as_given, open_mixture
from ..errors import UserError
from ..files.folders import fingerprint_files, keep_settings
from . import encoded, stages
from .stages import Stage, stage_config

PUT_BACK = "put it back and continue with --resume, nothing that was trained is lost"


def open_data(
    data, stage: Stage, config: RoGeConfig, *, most: int = MOST_BAD, file: Path | None = None
):
    """The sequences of a stage: of a dataset, of several with weights, or procedural ones (None).

    Up to `most` that cannot be used are passed over and listed in `file`. Raises: UserError if a dataset does not have
    the stage's size or frames.
    """
    working = stage_config(config, stage)
    video = stage.views.ordered or stage.objective == "vae"
    window = working.frames if video else max(stage.views.contexts) + 1
    size = working.height, working.width
    try:
        return open_mixture(as_given(data), *size, window, stage.views.depth, most=most, file=file)
    except UserError as error:
        raise UserError(f"Stage {stage.name}: {error}") from None


def hold_settings(
    out: Path,
    stage: Stage,
    params: Tree,
    config: RoGeConfig,
    *,
    seed: int,
    frozen_dtype: str,
    start: str,
    pool: Any,
    begun: bool,
    resume: bool,
) -> list[str]:
    """Write the settings.json of a stage, or hold a run that goes on (`begun` and `resume`) against it.

    `params` and `pool` count by their contents, wherever they lie; their names are written for people. Returns lines
    to print: what may differ and does, and what could not be compared. Raises: UserError naming what differs.
    """
    settings = {
        "model": config.name,
        "size": f"{config.height}x{config.width}",
        "batch": stage.batch,
        "seed": seed,
        "learning rate": stage.optim.learning_rate,
        "frozen dtype": frozen_dtype,
        "dtype of products": stage.products or frozen_dtype,
        "start contents": model_fingerprint(params, config, "float32"),
        "data contents": "procedural scenes",
        "samples encoded once": stage.stored,
    }
    if pool is not None:
        settings["data contents"] = pool_fingerprint(pool)
    notes = {"start": start, "data": named(pool), "steps": stage.steps}
    before = keep_settings(out, settings, begun=begun, resume=resume, notes=notes)
    told = []
    if before.get("steps", stage.steps) != stage.steps:
        told.append(
            f"{stage.name}: begun for {before['steps']} steps and continued for {stage.steps}: where the learning "
            "rate falls moves with them"
        )
    if lost := [name for name in settings if name not in before]:
        told.append(
            f"{stage.name}: {out / 'settings.json'} does not say with which {', '.join(lost)} the run began: not "
            "compared"
        )
    return told


def samples(
    stage: Stage,
    source,
    params: Tree,
    config: RoGeConfig,
    seed: int,
    rows,
    folder: Path,
    *,
    resume: bool,
) -> tuple[Callable[[int], dict], Callable[[dict], encoded.Clip] | None]:
    """(batch number i, what encodes a sample): of a stage on `stored` samples those in `folder`, encoded now or before;
    of others new samples, and None. `config` is the stage's own; `rows` of a batch are this process'.
    """
    if not stage.stored:
        return lambda i: stages.stage_batch(source, stage, config, seed, i, rows), None
    one = dataclasses.replace(stage, batch=1)
    weights = loaded({part: params[part] for part in encoded.READS})
    encode = functools.partial(
        jax.jit(encoded.encode, static_argnames="config"), weights, config=config
    )
    clips = encoded.Clips(
        folder,
        stage.stored,
        lambda i: stages.stage_batch(source, one, config, seed, i),
        encode,
        resume=resume,
    )
    return lambda i: clips.batch(seed, i, stage.batch), encode


def check_processes(options: Mapping[str, Any], start: str, pool: Any, *, version: str) -> None:
    """Raise UserError in every process of a run that was not started alike everywhere: options, code, model or data."""
    if jax.process_count() == 1:
        return
    if options.get("encode_once"):
        raise UserError(
            f"--encode-once is for one process, and {jax.process_count()} are running: leave it out."
        )
    if options.get("devices"):
        raise UserError(
            f"--devices {options['devices']} is for one process, and {jax.process_count()} are running: leave it out."
        )
    found = {f"--{name.replace('_', '-')}": value for name, value in options.items()}
    found |= {"roge_jax": version, "JAX": jax.__version__}
    distributed.check_same(found, "start every process with the same options and versions")
    contents = {}
    if start != "scratch":
        files = find_model(start)
        contents["a start with contents"] = fingerprint_files(files, "*.safetensors", "config.json")
    if pool is not None:
        contents["data with contents"] = pool_fingerprint(pool)
    distributed.check_same(contents, "every process must see the same files")


def pool_fingerprint(pool: Any) -> str:
    """`folders.fingerprint_files` of a dataset, or of several with their weights."""
    sources = as_given(pool)
    found = [fingerprint_files(one.folder, "shard_*.npz", "shard_*.rgb.npy") for one in sources]
    if len(found) == 1:
        return found[0]
    return ", ".join(f"{one}:{source.weight:g}" for one, source in zip(found, sources, strict=True))


def named(data: Any) -> str:
    """How a record calls the data."""
    return ", ".join(map(str, as_given(data))) or "procedural scenes"


def find_devices(count: int | None) -> list[jax.Device]:
    """The first `count` devices, None: all. Raises UserError if there are fewer."""
    found = jax.devices()
    if count is not None and count > len(found):
        raise UserError(f"--devices {count}: {len(found)} are here; give at most so many.")
    return found[:count]


def kept_dtype(given: str | None) -> str:
    """What frozen matrices are kept in: --frozen-dtype, or what suits the devices."""
    return given or ("float32" if target.platform() == "cpu" else "bfloat16")


def products_dtype(given: str | None, frozen: str | None) -> str:
    """What matrix products read: --products, or what frozen matrices are kept in where the device multiplies it.

    Raises: UserError for bfloat16 on a CPU that only multiplies float32.
    """
    able = target.platform() != "cpu" or products.cpu_units()
    if given == "bfloat16" and not able:
        raise UserError(
            "--products bfloat16: this CPU has no units for it (amx_bf16 or avx512_bf16), and is faster in float32: "
            "leave --products out."
        )
    return given or (kept_dtype(frozen) if able else "float32")


def provenance(start: str) -> dict[str, Any]:
    """Where the model to start from comes from, as its own config.json says; {} for 'scratch'."""
    return {} if start == "scratch" else load_provenance(find_model(start))


def resize(cfg: RoGeConfig, size: str | None, *, hires: bool) -> RoGeConfig:
    """The configuration at another size (None: twice its own); in `hires` the reconstruction keeps its own (Sec. 3.3)."""
    if size is None:
        height, width = 2 * cfg.height, 2 * cfg.width
    else:
        try:
            height, width = (int(x) for x in size.lower().split("x"))
        except ValueError:
            raise UserError(f"--size '{size}' is not HEIGHTxWIDTH: write it like 96x160.") from None
    recon = cfg.recon_height, cfg.recon_width
    if not hires:
        recon = height * recon[0] // cfg.height // 8 * 8, width * recon[1] // cfg.width // 8 * 8
    return cfg.at_size(height, width, recon)


def on_host() -> contextlib.AbstractContextManager:
    """A context in which new arrays are kept in host memory: a whole model may not fit one accelerator."""
    try:
        cpu = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS without cpu
        return contextlib.nullcontext()
    return contextlib.nullcontext() if target.machine() == "cpu" else jax.default_device(cpu)


def place_frozen(frozen: Tree, dtype: str, shardings: Tree | None = None) -> Tree:
    """Frozen weights where they stay and as they are kept, leaf by leaf; without `shardings` in host memory."""
    with on_host():
        return checkpoint.placed(frozen, kept_as(dtype), shardings)


def fingerprint(params: Tree, start: str) -> str:
    """`weights_fingerprint` of the model `start` in float32. Raises: UserError if its files are gone."""
    try:
        return checkpoint.weights_fingerprint(params, dtype="float32")
    except (OSError, ValueError) as error:  # gone, or shorter than it was
        raise UserError(
            f"The model that this run started from, {start}, cannot be read ({error}): {PUT_BACK}."
        ) from None


def check_unchanged(params: Tree, origin: str, start: str) -> None:
    """Raise UserError if `fingerprint` is no longer `origin`: what is saved is the start and what training changed."""
    if fingerprint(params, start) != origin:
        raise UserError(
            f"The model that this run started from, {start}, has changed since: {PUT_BACK}."
        )
