"""Frames to latent slots: how rays and ray features line up with the VAE's latents (Sec. 3.2 of the paper).

A context is one slot, the first target frame is one slot, and every four target frames after it are
one slot. So the contexts and the first target are repeated four times and every four frames are
stacked along the channels.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras, relative_to, to_host

GROUP = 4  # frames per latent slot: the VAE's temporal compression


def latent_slots(n: int) -> int:
    """Latent slots of n target frames, 1 + (n - 1) / 4. Raises UserError unless n = 1 + 4k."""
    if n < 1 or (n - 1) % GROUP:
        good = padded_frames(n)
        raise UserError(f"{n} frames cannot form latent slots: need 1 + 4k, e.g. {good}.")
    return 1 + (n - 1) // GROUP


def padded_frames(n: int) -> int:
    """The smallest number of frames 1 + 4k that is not below n."""
    return 1 + GROUP * -(-max(n - 1, 0) // GROUP)


def pixel_unshuffle(x: Any, factor: int = 8) -> Any:
    """[..., h, w, c] -> [..., h / factor, w / factor, c * factor^2].

    Output channel = (channel * factor + row in block) * factor + column in block, as torch's
    PixelUnshuffle, so that ray maps of published checkpoints keep their channel order.
    """
    *lead, h, w, c = x.shape
    assert h % factor == 0 and w % factor == 0, f"{h} x {w} is not a multiple of {factor}"
    blocks = x.reshape(*lead, h // factor, factor, w // factor, factor, c)
    first = len(lead)
    order = (*range(first), first, first + 2, first + 4, first + 1, first + 3)
    return blocks.transpose(order).reshape(*lead, h // factor, w // factor, c * factor * factor)


def pixel_shuffle(x: Any, factor: int = 8) -> Any:
    """Inverse of `pixel_unshuffle`: [..., h, w, c factor^2] -> [..., h factor, w factor, c]."""
    *lead, h, w, c = x.shape
    assert c % (factor * factor) == 0, f"{c} channels are not a multiple of {factor}^2"
    blocks = x.reshape(*lead, h, w, c // factor**2, factor, factor)
    first = len(lead)
    order = (*range(first), first, first + 3, first + 1, first + 4, first + 2)
    return blocks.transpose(order).reshape(*lead, h * factor, w * factor, c // factor**2)


def replicate_contexts_and_first(x: Any, m: int) -> Any:
    """[m + n, ...] -> [4 (m + 1) + n - 1, ...]: contexts and first target four times each."""
    assert x.shape[0] > m, f"{x.shape[0]} views leave no target after {m} contexts"
    use = np if isinstance(x, np.ndarray) else jnp
    return use.concatenate([use.repeat(x[: m + 1], GROUP, axis=0), x[m + 1 :]], axis=0)


def pack_groups_of_four(x: Any) -> Any:
    """[4 s, h, w, c] -> [s, h, w, 4 c]: frames side by side, channel = frame * c + channel."""
    frames, h, w, c = x.shape
    assert frames % GROUP == 0, f"{frames} frames are no groups of {GROUP}"
    return (
        x.reshape(frames // GROUP, GROUP, h, w, c)
        .transpose(0, 2, 3, 1, 4)
        .reshape(-1, h, w, GROUP * c)
    )


def pack_views(x: Any, m: int) -> Any:
    """Both steps in one: [m + n, h, w, c] -> [m + latent_slots(n), h, w, 4 c]."""
    latent_slots(x.shape[0] - m)
    return pack_groups_of_four(replicate_contexts_and_first(x, m))


def pad_path(cameras: Cameras, n: int) -> Cameras:
    """The path lengthened to n frames by repeating its last motion (or its only pose).

    The user's cameras are kept as they are: generate n frames, then drop the ones beyond the
    original length.
    """
    cameras = to_host(cameras)
    assert 0 < len(cameras) <= n, f"cannot pad {len(cameras)} cameras to {n}"
    c2w = list(cameras.c2w)
    motion = relative_to(c2w[-2], c2w[-1]) if len(c2w) > 1 else np.eye(4)
    while len(c2w) < n:
        c2w.append(c2w[-1] @ motion)
    K = np.concatenate([cameras.K, np.repeat(cameras.K[-1:], n - len(cameras), axis=0)])
    return Cameras(K, np.stack(c2w))
