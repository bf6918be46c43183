"""Relative cameras in attention: what the matrices are, what acts on values is undone, and tokens know their place."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parity import rel_l2
from test_recon import ENCODER, ROUNDING, SIZE, M, cameras, made_up, query, renderer_of, scene

from roge_jax.geometry.rays import plucker, project
from roge_jax.recon import ray_scene, vggt
from roge_jax.recon.relative import inside, relative_cameras, to_key, to_output, to_query

GRID, SPECIALS, HEAD = (2, 3), 2, 16


def some(views=3, seed=5):
    K, c2w = cameras(views, SIZE, seed)
    options = {"grid": GRID, "specials": SPECIALS, "head_dim": HEAD}
    return K, c2w, relative_cameras(K, c2w, SIZE, **options)


def test_the_matrix_of_a_view_projects_into_its_picture():
    """A point of the world becomes (x z, y z, z, 1): x and y across the picture from -1/2 to 1/2, depth z."""
    K, c2w, r = some()
    points = np.random.default_rng(0).normal(size=(20, 3)) + np.array([[0.0, 0.0, 6.0]])
    for view in range(3):
        pixels, depth, visible = project(
            *(np.asarray(x[view], np.float64) for x in (K, c2w)), points
        )
        assert visible.all()
        found = np.concatenate([points, np.ones((20, 1))], 1) @ np.asarray(r.project[view]).T
        place = pixels / SIZE[::-1] - 0.5
        expected = np.concatenate([place * depth[:, None], depth[:, None], np.ones((20, 1))], 1)
        np.testing.assert_allclose(found, expected, atol=2e-4)
        np.testing.assert_allclose(r.project[view] @ r.unproject[view], np.eye(4), atol=1e-4)


def test_a_token_that_reads_itself_gets_its_value_as_it_was():
    """What a key's camera and place do to a value, those of the same query undo; logits are plain products there."""
    _, _, r = some()
    rng = np.random.default_rng(1)
    shape = (3, SPECIALS + GRID[0] * GRID[1], 2, HEAD)
    q, k = (jnp.asarray(rng.standard_normal(shape), jnp.float32) for _ in range(2))
    for one in (r, inside(r)):
        np.testing.assert_allclose(to_output(one, to_key(one, k)), k, atol=2e-4)
        logits = (to_query(one, q) * to_key(one, k)).sum(-1)
        np.testing.assert_allclose(logits, (q * k).sum(-1), atol=2e-3)
    # and tokens of one view at different places meet otherwise than at the same
    turned = to_output(r, jnp.roll(to_key(r, k), 1, 1))
    assert rel_l2(turned[:, SPECIALS + 1 :], jnp.roll(k, 1, 1)[:, SPECIALS + 1 :]) > 1e-2


@pytest.mark.parametrize("relative", [True, False])
def test_rays_of_a_view_know_their_place_among_each_other(relative):
    """Without the scene, shuffled rays give shuffled features only where tokens have no place of their own."""
    cfg = dataclasses.replace(renderer_of("cross"), relative_cameras=relative)
    p = made_up(ray_scene.renderer_specs(cfg))
    for name in ("q", "k"):
        p["blocks"]["self_attn"][name]["kernel"] *= 3.0  # attention that chooses
    p["blocks"]["cross_attn"]["proj"]["kernel"] *= 0.0
    K, c2w, z, _, _ = scene()
    rays = plucker(K, c2w, *SIZE)
    patches = rays.reshape(len(rays), GRID[0], 8, GRID[1], 8, 6)
    turned = patches[:, ::-1, :, ::-1].reshape(rays.shape)
    plain, other = (query(p, z, K, c2w, K[:M], c2w[:M], x, cfg=cfg) for x in (rays, turned))
    change = rel_l2(other, plain[:, ::-1, ::-1])
    assert (change > 1e-2) if relative else (change < ROUNDING)


def test_the_encoder_reads_K_in_pixels_of_the_photos_it_is_given(monkeypatch):
    """Also where it looks at them at a size of its own."""
    cfg = dataclasses.replace(ENCODER, long_side=48)
    K, c2w, _, images, vectors = scene()
    asked = []

    def spied(K, c2w, size, *, grid, **options):
        asked.append((size, grid))
        return relative_cameras(K, c2w, size, grid=grid, **options)

    monkeypatch.setattr(vggt, "relative_cameras", spied)
    p = made_up(vggt.encoder_specs(cfg, 32))
    encode = functools.partial(vggt.encode_scene, cfg=cfg)
    rays = plucker(K[:M], c2w[:M], *SIZE)
    tokens = jax.eval_shape(encode, p, images, vectors, rays, K[:M], c2w[:M])
    assert asked == [(SIZE, (4, 6))] and tokens.shape[1] == 24
