"""Models of the Hugging Face hub: `hub:USER/NAME`, or `hub:USER/NAME@REVISION`.

They come into that site's own cache, once, by its own client (extra `hub`), which knows of logins, proxies and being
offline. The prefix is what asks for a download: without it no name goes to the network.
"""

import functools
import re
from pathlib import Path

from ..errors import UserError

PREFIX = "hub:"
_NAME = re.compile(r"(?P<repository>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?")
INSTALL = "pip install 'roge_jax[hub]'"


def asks_hub(name: str | Path) -> bool:
    """Whether a model is asked for by its name on the hub."""
    return str(name).startswith(PREFIX)


def like_hub(name: str | Path) -> bool:
    """Whether a name could be one on the hub, without the prefix."""
    return _NAME.fullmatch(str(name)) is not None


@functools.cache
def fetch(name: str, patterns: tuple[str, ...]) -> Path:
    """The folder with the files of a model that match `patterns`; what is there already is not fetched again.

    Raises: UserError for a name that is none, a model that is not there or not granted, no network, no client.
    """
    found = _NAME.fullmatch(str(name).removeprefix(PREFIX))
    if found is None:
        raise UserError(
            f"'{name}' is no model of the Hugging Face hub: write {PREFIX}USER/NAME, or {PREFIX}USER/NAME@REVISION."
        )
    try:
        import huggingface_hub
        from huggingface_hub import errors
    except ImportError:
        raise UserError(
            f"{name}: the client of the Hugging Face hub is not installed: {INSTALL}, or download the folder by other "
            "means and give its path."
        ) from None
    repository, revision = found["repository"], found["revision"]
    try:
        folder = huggingface_hub.snapshot_download(
            repository, revision=revision, allow_patterns=list(patterns)
        )
    except errors.GatedRepoError as error:  # a kind of RepositoryNotFoundError
        raise UserError(
            f"{name}: access has to be granted: ask for it on https://huggingface.co/{repository}, then log in with "
            "`hf auth login`."
        ) from error
    except errors.RepositoryNotFoundError as error:
        raise UserError(
            f"{name}: the hub has no such model, or it is private: check the name, or log in with `hf auth login`."
        ) from error
    except errors.RevisionNotFoundError as error:
        raise UserError(
            f"{name}: the model has no revision '{revision}': give a branch, tag or commit of it."
        ) from error
    except (errors.LocalEntryNotFoundError, errors.HfHubHTTPError, OSError) as error:
        said = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(
            f"{name} cannot be fetched ({said}): check the network, or give the path of a downloaded folder."
        ) from error
    return Path(folder)
