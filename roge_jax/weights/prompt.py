"""The prompt's text embedding, computed once: text encoders are not needed afterwards.

Rows are those of umT5's last hidden state, cut to the true length of the prompt; the model stores them zero-padded.
"""

import functools
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..config import DiTConfig
from ..core import memory
from ..errors import UserError
from ..files.fields import is_file, read_json
from . import umt5
from .sources import Source, open_source

Rows = np.ndarray | Callable[[], np.ndarray]
WEIGHTS = ("model.safetensors", "model.safetensors.index.json")  # whole, or in shards
EXTRA = "pip install -e '.[convert]' in the project's folder"


def choose_rows(
    cfg: DiTConfig,
    text: str,
    *,
    embedding: Path | None,
    encoder: Path | None,
    beside: Path | None,
) -> tuple[str, Rows | None]:
    """(a word on where they come from, the rows [text_len, text_dim] or what makes them) of a prompt; None: zeros.

    embedding: a file with the finished rows. encoder: umT5, as given. beside: the one found with the transformer, which is
    asked for the empty prompt. Encoders are opened and checked here; nothing but headers is read.
    """
    if embedding:
        return f"read from {embedding.name}", read_prompt(embedding, cfg)
    if text and encoder:
        if encoder.is_file():
            raise UserError(
                f"--prompt '{text}' needs umT5's tokenizer beside the encoder: give --t5 a diffusers folder (text_encoder, "
                f"tokenizer); {encoder.name} alone gives the empty prompt."
            )
        check_encoder(encoder)
        return f"umT5 of '{text}'", functools.partial(encode_prompt, encoder, text, cfg)
    place = encoder or beside
    if place is None:
        return "none: all rows are zero", None
    weights = _weights_of(place)
    if weights is None:  # no safetensors: pickles, which transformers reads
        check_encoder(place)
        return "umT5 of ''", functools.partial(encode_prompt, place, "", cfg)
    source = open_source(weights)
    umt5.check(source, cfg)
    return f"umT5 of '', from {weights.name}", functools.partial(empty_prompt, source, cfg)


def _weights_of(path: Path) -> Path | None:
    """The file or folder of an encoder's weights that `umt5` can read; None if there are no such in a folder."""
    if not path.is_dir():
        return path
    if is_file(path / umt5.FILE):
        return path / umt5.FILE
    inner = _places(path)[0]
    return inner if any(inner.glob("*.safetensors")) else None


def empty_prompt(source: Source, cfg: DiTConfig) -> np.ndarray:
    """[text_len, text_dim] of the empty prompt, with a bar over the encoder's layers."""
    from tqdm import tqdm

    with tqdm(desc="empty prompt", unit="layer", disable=not sys.stderr.isatty()) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return padded(umt5.end_token(source, cfg, progress=progress), cfg, str(source.path))


def padded(rows: np.ndarray, cfg: DiTConfig, source: str) -> np.ndarray:
    """Rows [r, text_dim] (or [1, r, text_dim]) as float32 [text_len, text_dim], zeros behind them."""
    rows = np.asarray(rows, np.float32)
    rows = rows[0] if rows.ndim == 3 and rows.shape[0] == 1 else rows
    if rows.ndim != 2 or rows.shape[1] != cfg.text_dim or not 0 < rows.shape[0] <= cfg.text_len:
        raise UserError(
            f"{source}: a prompt embedding of shape {rows.shape} does not fit; needed is [rows, {cfg.text_dim}] "
            f"with 1 to {cfg.text_len} rows."
        )
    if not np.isfinite(rows).all():
        raise UserError(
            f"{source}: the prompt embedding is not finite: compute it in bfloat16 or float32."
        )
    return np.pad(rows, ((0, cfg.text_len - rows.shape[0]), (0, 0)))


def read_prompt(file: Path, cfg: DiTConfig) -> np.ndarray:
    """[text_len, text_dim] from a .npy file, or the only tensor of a safetensors or PyTorch file."""
    file = Path(file)
    if file.suffix == ".npy":
        try:
            return padded(np.load(file, allow_pickle=False), cfg, str(file))
        except (OSError, ValueError) as error:
            if isinstance(error, UserError):
                raise
            raise UserError(
                f"{file} cannot be read as .npy ({error}): save the rows with numpy.save."
            ) from None
    source = open_source(file)
    if len(source.tensors) != 1:
        raise UserError(
            f"{file} holds {len(source.tensors)} tensors: give a file with the embedding alone."
        )
    (key,) = source.tensors
    return padded(source.read(key), cfg, str(file))


def check_encoder(folder: Path) -> None:
    """Raise UserError unless `folder` looks like what `encode_prompt` takes and memory holds it; no weight is read."""
    encoder, tokens = _places(folder)
    problem, kind = "", None
    if is_file(encoder / "config.json"):
        record = read_json(encoder / "config.json", "encoder config")
        kind = record.get("model_type") if isinstance(record, dict) else None
    if not is_file(encoder / "config.json"):
        problem = f"no {encoder / 'config.json'}"
    elif kind != "umt5":
        problem = f"{encoder / 'config.json'} is of model type {kind}"
    elif not [*encoder.glob("*.safetensors"), *encoder.glob("*.bin")]:
        problem = f"no weights in {encoder}"
    elif not any(is_file(tokens / name) for name in ("tokenizer.json", "spiece.model")):
        problem = f"no tokenizer in {tokens}"
    if problem:
        raise UserError(f"--t5 {folder}: no umT5 encoder and tokenizer there ({problem}).")
    stored = [encoder / name for name in WEIGHTS if is_file(encoder / name)]
    if not stored:  # .bin files, which are pickles: transformers reads them
        return
    # In bfloat16, whatever type it is stored in.
    needed = 2 * sum(math.prod(shape) for shape in open_source(stored[0]).shapes.values())
    cure = "close other programs, or give finished rows with --prompt-embedding"
    memory.refuse(
        f"--t5 {folder}", needed, memory.HOST, memory.memory_available(), "the text encoder", cure
    )


def _places(folder: Path) -> tuple[Path, Path]:
    """(encoder, tokenizer) of a Hugging Face folder."""
    encoder, tokens = (Path(folder) / name for name in ("text_encoder", "tokenizer"))
    return (encoder if encoder.is_dir() else folder), (tokens if tokens.is_dir() else folder)


def encode_prompt(folder: Path, text: str, cfg: DiTConfig) -> np.ndarray:
    """[text_len, text_dim] of `text` by the umT5 encoder in `folder`, in bfloat16 on the CPU.

    `folder` is a Hugging Face one: config, weights and tokenizer in it, or the subfolders `text_encoder` and
    `tokenizer` of a diffusers model. Needs transformers and torch (extra `convert`), and memory for the encoder.
    """
    try:
        import torch
        from transformers import AutoTokenizer, UMT5EncoderModel
    except ImportError as error:
        raise UserError(f"--t5 needs transformers and torch ({error}): {EXTRA}.") from None
    encoder, tokens = _places(folder)
    try:
        tokenizer = AutoTokenizer.from_pretrained(str(tokens), local_files_only=True)
        model = UMT5EncoderModel.from_pretrained(
            str(encoder), dtype=torch.bfloat16, local_files_only=True
        )
    except (OSError, ValueError, ImportError) as error:
        raise UserError(
            f"--t5 {folder}: no umT5 encoder and tokenizer there ({_first_line(error)})."
        ) from None
    ids = tokenizer(cleaned(text), truncation=True, max_length=cfg.text_len, return_tensors="pt")
    with torch.no_grad():
        rows = model.eval()(input_ids=ids["input_ids"], attention_mask=ids["attention_mask"])
    return padded(rows.last_hidden_state[0].float().numpy(), cfg, f"--t5 {folder}")


def cleaned(text: str) -> str:
    """The text as Wan cleans it: mojibake mended (if ftfy is there), HTML entities twice, white space collapsed."""
    import html

    try:
        import ftfy

        text = ftfy.fix_text(text)
    except ImportError:
        pass
    return " ".join(html.unescape(html.unescape(text)).split())


def _first_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
