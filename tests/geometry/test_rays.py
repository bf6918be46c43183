"""Rays: Pluecker invariances, exact cases, and the way back from rays to pixels."""

import jax
import jax.numpy as jnp
import numpy as np
from camera_cases import random_cameras, random_rigid, seeds
from hypothesis import given, settings
from hypothesis import strategies as st

from roge_jax.geometry.cameras import Cameras
from roge_jax.geometry.rays import (
    plucker,
    plucker_float64,
    project,
    ray_distance,
    triangulate,
)

few = settings(max_examples=25, deadline=None)
HEIGHT, WIDTH = 6, 10


def cast(seed: int, views: int = 2) -> tuple[Cameras, np.ndarray]:
    rng = np.random.default_rng(seed)
    cameras = random_cameras(rng, views, HEIGHT, WIDTH, skew=rng.uniform(-0.2, 0.2))
    return cameras, plucker_float64(cameras.K, cameras.c2w, HEIGHT, WIDTH)


@few
@given(seeds)
def test_lines(seed):
    """d has length 1, the moment is square to it, and the camera centre lies on every ray."""
    cameras, rays = cast(seed)
    d, m = rays[..., :3], rays[..., 3:]
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1.0, atol=1e-14)
    np.testing.assert_allclose((d * m).sum(-1), 0.0, atol=1e-13)
    centre = np.broadcast_to(cameras.centres[:, None, None], d.shape)
    np.testing.assert_allclose(np.cross(centre, d), m, atol=1e-13)


@few
@given(seeds)
def test_float32_follows_float64(seed):
    """Normalised cameras lose nothing but rounding in float32."""
    cameras, rays = cast(seed)
    assert plucker(cameras.K, cameras.c2w, HEIGHT, WIDTH).dtype == jnp.float32
    ours = plucker(cameras.K, cameras.c2w, HEIGHT, WIDTH)
    np.testing.assert_allclose(ours, rays, atol=2e-6 * max(1.0, np.abs(rays).max()))


@few
@given(seeds)
def test_rays_invert_to_pixels(seed):
    """A point anywhere on the ray of a pixel projects to that pixel's centre (x + 0.5, y + 0.5)."""
    rng = np.random.default_rng(seed)
    cameras, rays = cast(seed)
    d = rays[..., :3].reshape(2, -1, 3)
    points = cameras.centres[:, None] + rng.uniform(0.1, 100.0, d.shape[:2])[..., None] * d
    pixels, depth, visible = project(cameras.K, cameras.c2w, points)
    assert visible.all() and (depth > 0).all()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    centres = np.stack([x + 0.5, y + 0.5], -1).reshape(1, -1, 2)
    np.testing.assert_allclose(pixels, np.broadcast_to(centres, pixels.shape), atol=1e-9)


@few
@given(seeds)
def test_K_maps_rays_to_pixels(seed):
    """K R^T d is proportional to (x + 0.5, y + 0.5, 1), with skew and any principal point."""
    cameras, _ = cast(seed)
    ours = np.asarray(plucker(cameras.K, cameras.c2w, HEIGHT, WIDTH), np.float64)
    local = np.einsum("vji,vhwj->vhwi", cameras.c2w[:, :3, :3], ours[..., :3])
    pixels = np.einsum("vij,vhwj->vhwi", cameras.K, local)
    pixels = pixels[..., :2] / pixels[..., 2:]
    np.testing.assert_allclose(pixels[:, 2, 3], [[3.5, 2.5]] * 2, atol=1e-6 * WIDTH * 2)
    np.testing.assert_allclose(pixels[:, 5, 9], [[9.5, 5.5]] * 2, atol=1e-6 * WIDTH * 2)


@few
@given(seeds)
def test_rigid_motion_of_lines(seed):
    """d -> R d, m -> R m + t x R d."""
    cameras, rays = cast(seed)
    world = random_rigid(np.random.default_rng(seed + 1))
    after = plucker_float64(cameras.K, world @ cameras.c2w, HEIGHT, WIDTH)
    d = rays[..., :3] @ world[:3, :3].T
    m = rays[..., 3:] @ world[:3, :3].T + np.cross(np.broadcast_to(world[:3, 3], d.shape), d)
    np.testing.assert_allclose(after, np.concatenate([d, m], -1), atol=1e-12)


@few
@given(seeds, st.floats(0.1, 50.0))
def test_sliding_along_a_ray_changes_nothing(seed, distance):
    """A line has no preferred point: moving the camera along one ray keeps that ray."""
    cameras, rays = cast(seed)
    c2w = cameras.c2w.copy()
    c2w[:, :3, 3] += distance * rays[:, 1, 4, :3]
    after = plucker_float64(cameras.K, c2w, HEIGHT, WIDTH)
    np.testing.assert_allclose(after[:, 1, 4], rays[:, 1, 4], atol=1e-12)
    assert np.abs(after[:, 0, 0] - rays[:, 0, 0]).max() > 1e-3 * distance  # other rays do move


@few
@given(seeds)
def test_distance_and_triangulation(seed):
    """Two rays through one point: distance 0, and the point comes back; a shift is measured."""
    rng = np.random.default_rng(seed)
    point, a, b = rng.normal(size=(3, 3)) * 2
    lines = []
    for centre in (a, b):
        d = (point - centre) / np.linalg.norm(point - centre)
        lines.append(np.concatenate([d, np.cross(centre, d)]))
    angle = np.degrees(np.arccos(np.clip(lines[0][:3] @ lines[1][:3], -1, 1)))
    found, finite = triangulate(*lines)
    assert finite == (np.sin(np.radians(angle)) >= np.sin(np.radians(1.0)))
    if finite:
        np.testing.assert_allclose(found, point, atol=1e-9)
        normal = np.cross(lines[0][:3], lines[1][:3])
        normal /= np.linalg.norm(normal)
        shifted = lines[1].copy()
        shifted[3:] += np.cross(0.3 * normal, shifted[:3])
        np.testing.assert_allclose(ray_distance(lines[0], shifted), 0.3, atol=1e-9)
        np.testing.assert_allclose(ray_distance(*lines), 0.0, atol=1e-9)


def test_batches_and_jit():
    """A leading batch axis and jit give the rays of each view alone."""
    cameras = random_cameras(np.random.default_rng(0), 6, HEIGHT, WIDTH)
    K, c2w = cameras.K.reshape(2, 3, 3, 3), cameras.c2w.reshape(2, 3, 4, 4)
    batched = jax.jit(plucker, static_argnums=(2, 3))(K, c2w, HEIGHT, WIDTH)
    alone = plucker(cameras.K, cameras.c2w, HEIGHT, WIDTH)
    assert batched.shape == (2, 3, HEIGHT, WIDTH, 6)
    np.testing.assert_allclose(batched.reshape(alone.shape), alone, atol=1e-6)
