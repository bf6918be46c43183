"""The published checkpoints by name: where they are, which of their files are read, and where a download of them lies.

    locate(Path("lagernvs_general_512"))    # the path itself, or where `hf download` has put the checkpoint of that name

Names, sizes and licences are those of the pages of the repositories, 2026-11.
"""

import os
from pathlib import Path
from typing import NamedTuple

from ..errors import UserError

HUB = "https://huggingface.co"


class Published(NamedTuple):
    """A repository: the files of it that are read, in GB together, and what it takes to get them."""

    repository: str
    files: tuple[str, ...]  # patterns of `hf download --include`
    gigabytes: float
    licence: str
    gated: bool = False  # access is asked for on its page

    @property
    def name(self) -> str:
        """Of the repository, without its owner."""
        return self.repository.rpartition("/")[2]

    @property
    def command(self) -> str:
        """Downloads what is read into a folder of that name; `--include` takes one pattern each time."""
        patterns = " ".join(
            f"--include '{p}'" if "*" in p else f"--include {p}" for p in self.files
        )
        return f"hf download {self.repository} {patterns} --local-dir {self.name}"


class Trained(NamedTuple):
    """What a LagerNVS checkpoint was trained for, which its file does not say."""

    size: tuple[int, int]  # (height, width) of a picture
    views: int  # photos at most


_WAN, _FAIR = "Apache-2.0", "FAIR Noncommercial Research License"
_TEXT, _VAE = "models_t5_umt5-xxl-enc-bf16.pth", "Wan2.1_VAE.pth"
_ONE = ("config.json", "diffusion_pytorch_model.safetensors", _VAE, _TEXT)
_SHARDS = ("config.json", "diffusion_pytorch_model*", _VAE, _TEXT)
_DIFFUSERS = ("transformer/*", "vae/*.safetensors", "text_encoder/model*")

# In the order of docs/start/published_weights.md.
PUBLISHED = (
    Published("facebook/lagernvs_general_512", ("model.pt",), 4.41, _FAIR, gated=True),
    Published("facebook/lagernvs_dl3dv_2-6_v_256", ("model.pt",), 4.41, _FAIR, gated=True),
    Published("facebook/lagernvs_re10k_2v_256", ("model.pt",), 3.99, _FAIR, gated=True),
    Published("facebook/VGGT-1B", ("model.safetensors",), 5.03, "VGGT License"),
    Published("Wan-AI/Wan2.1-T2V-1.3B", _ONE, 17.545, _WAN),
    Published("Wan-AI/Wan2.1-T2V-14B", _SHARDS, 69.02, _WAN),
    Published("Wan-AI/Wan2.1-I2V-14B-480P", _SHARDS, 77.449, _WAN),
    Published("Wan-AI/Wan2.1-I2V-14B-720P", _SHARDS, 77.449, _WAN),
    Published("Wan-AI/Wan2.1-I2V-14B-480P-Diffusers", _DIFFUSERS, 88.81, _WAN),
)
BY_NAME = {one.name: one for one in PUBLISHED}

LAGERNVS = {
    "lagernvs_general_512": Trained((288, 512), 10),
    "lagernvs_dl3dv_2-6_v_256": Trained((256, 256), 6),
    "lagernvs_re10k_2v_256": Trained((256, 256), 2),
}


def name_of(path: Path) -> str | None:
    """The published name of a download: that of its file's folder, or of its place in the cache of `hf download`."""
    parts = [part.rpartition("--")[2] for part in Path(path).absolute().parts]
    return next((part for part in reversed(parts) if part in BY_NAME), None)


def locate(path: Path) -> Path:
    """`path` if it is there; of a published name, its place in the cache of `hf download`.

    Raises: UserError with the command that downloads it, and where access to it is granted.
    """
    path = Path(path)
    found = BY_NAME.get(path.name)
    if path.exists() or found is None or str(path) not in (found.name, found.repository):
        return path
    if (cached := _cached(found)) is not None:
        return cached
    raise UserError(f"{path} is not here: {how_to_get(found)}.")


def how_to_get(found: Published) -> str:
    """What to do to have a checkpoint, as part of a sentence."""
    told = f"download it with `{found.command}` ({found.gigabytes:.1f} GB)"
    if found.gated:
        return (
            f"ask for access on {HUB}/{found.repository}, log in with `hf auth login`, then {told}"
        )
    return told


def _cached(found: Published) -> Path | None:
    """The newest snapshot in the cache of Hugging Face's tools, which have the same variables."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "huggingface"
    home = Path(os.environ.get("HF_HOME") or home)
    try:
        cache = Path(os.environ.get("HF_HUB_CACHE") or home / "hub").expanduser()
    except RuntimeError:  # a user without a home
        return None
    snapshots = cache / f"models--{found.repository.replace('/', '--')}" / "snapshots"
    newest = sorted(snapshots.glob("*/"), key=lambda folder: folder.stat().st_mtime)
    return newest[-1] if newest else None
