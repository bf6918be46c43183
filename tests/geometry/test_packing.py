"""Frames to latent slots, and the published ray-map packing."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from camera_cases import random_cameras, seeds
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file

from roge_jax.errors import UserError
from roge_jax.geometry import packing
from roge_jax.geometry.cameras import Cameras, invert, relative_to
from roge_jax.geometry.rays import plucker

FIXTURE = Path(__file__).parents[1] / "fixtures" / "framecrafter_raymap"
few = settings(max_examples=25, deadline=None)


def test_framecrafter_ray_map():
    """Normalised poses, rays [d, o x d] and their pixel-unshuffle equal FrameCrafter's."""
    data = load_file(FIXTURE / "io.safetensors")
    height, width = json.loads((FIXTURE / "case.json").read_text())["config"]["hw"]
    c2w = invert(data["in.w2c"].astype(np.float64))
    c2w = relative_to(c2w[-1], c2w)  # its rule: last camera, mean distance
    scale = np.linalg.norm(c2w[:, :3, 3], axis=-1).mean()
    np.testing.assert_allclose(scale, data["mid.scale"], rtol=1e-6)
    c2w[:, :3, 3] /= scale
    np.testing.assert_allclose(c2w, data["mid.c2w_norm"], atol=1e-6)
    rays = plucker(data["in.intrinsics"], c2w, height, width)
    ours = np.moveaxis(np.asarray(packing.pixel_unshuffle(rays, 8)), -1, 1)
    expected = data["out.raymap"]
    assert np.linalg.norm(ours - expected) / np.linalg.norm(expected) < 1e-6


@few
@given(st.integers(0, 200))
def test_slots(k):
    assert packing.latent_slots(1 + 4 * k) == 1 + k
    for rest in (2, 3, 4):
        assert packing.padded_frames(rest + 4 * k) == 5 + 4 * k


def test_slots_refuse_other_lengths():
    message = "96 frames cannot form latent slots: need 1 + 4k, e.g. 97."
    with pytest.raises(UserError) as error:
        packing.latent_slots(96)
    assert str(error.value) == message
    with pytest.raises(UserError, match=r"0 frames .* e\.g\. 1\."):
        packing.latent_slots(0)


@few
@given(seeds, st.sampled_from([2, 4, 8]), st.lists(st.integers(1, 3), max_size=2))
def test_unshuffle_and_shuffle_are_inverse(seed, factor, lead):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(*lead, 2 * factor, 3 * factor, 5))
    packed = packing.pixel_unshuffle(x, factor)
    assert packed.shape == (*lead, 2, 3, 5 * factor**2)
    np.testing.assert_array_equal(packing.pixel_shuffle(packed, factor), x)


def test_unshuffle_order():
    """Channel first, then row, then column of the 8 x 8 block."""
    x = np.zeros((16, 16, 3))
    x[8 + 2, 0 + 5, 1] = 1.0
    packed = packing.pixel_unshuffle(x, 8)
    assert np.argwhere(packed).tolist() == [[1, 0, 64 + 2 * 8 + 5]]


@pytest.mark.parametrize(("m", "n"), [(1, 1), (3, 5), (2, 9)])
def test_views_fill_slots(m, n):
    """Contexts and the first target appear four times; later targets once each, in order."""
    frames = np.arange(m + n, dtype=np.float32).reshape(-1, 1, 1, 1) + np.zeros((1, 2, 2, 2))
    repeated = packing.replicate_contexts_and_first(frames, m)
    assert repeated.shape[0] == 4 * (m + 1) + n - 1
    slots = packing.pack_views(jnp.asarray(frames), m)
    assert slots.shape == (m + packing.latent_slots(n), 2, 2, 8)
    by_slot = np.asarray(slots)[:, 0, 0, ::2].tolist()
    assert by_slot[: m + 1] == [[i] * 4 for i in range(m + 1)]
    later = [list(range(m + 1 + 4 * k, m + 5 + 4 * k)) for k in range((n - 1) // 4)]
    assert by_slot[m + 1 :] == later


def test_contexts_permute_with_their_slots():
    x = np.random.default_rng(0).normal(size=(3 + 5, 2, 2, 2))
    order = [2, 0, 1]
    swapped = np.concatenate([x[:3][order], x[3:]])
    slots, after = packing.pack_views(x, 3), packing.pack_views(swapped, 3)
    np.testing.assert_array_equal(after, np.concatenate([slots[:3][order], slots[3:]]))


def test_pad_path_goes_on_as_before():
    """Constant motion stays constant; the user's cameras are kept to the bit."""
    step = random_cameras(np.random.default_rng(1), 1).c2w[0]
    poses = [np.eye(4)]
    for _ in range(7):
        poses.append(poses[-1] @ step)
    K = np.repeat(np.eye(3)[None] * [[[90.0], [80.0], [1.0]]], 8, 0)
    padded = packing.pad_path(Cameras(K[:6], np.stack(poses[:6])), 8)
    np.testing.assert_allclose(padded.c2w, np.stack(poses), atol=1e-12)
    np.testing.assert_array_equal(padded.c2w[:6], np.stack(poses[:6]))
    np.testing.assert_array_equal(padded.K, K)
    single = packing.pad_path(Cameras(K[:1], np.stack(poses[1:2])), 5)
    np.testing.assert_array_equal(single.c2w, np.repeat(poses[1][None], 5, 0))
