"""Random cameras with knobs, shared by the tests of geometry and scenes."""

import numpy as np
from hypothesis import strategies as st

from roge_jax.geometry.cameras import Cameras, camera_vector, concatenate, normalise, rotation
from roge_jax.geometry.rays import plucker

seeds = st.integers(0, 2**32 - 1)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return rotation(rng.normal(size=4))


def random_rigid(rng: np.random.Generator, reach: float = 3.0) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = random_rotation(rng), rng.normal(size=3) * reach
    return motion


def random_K(rng: np.random.Generator, height: int, width: int, skew: float = 0.0) -> np.ndarray:
    """Unequal focal lengths, principal point in the middle half of the picture."""
    fx, fy = rng.uniform(0.6, 1.6, 2) * width
    cx, cy = rng.uniform(0.25, 0.75, 2) * (width, height)
    return np.array([[fx, skew * fx, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def random_cameras(
    rng: np.random.Generator,
    views: int,
    height: int = 24,
    width: int = 40,
    *,
    baseline: float = 1.0,
    straight: bool = False,
    skew: float = 0.0,
) -> Cameras:
    """Views with any orientation; centres within about `baseline`, on a line if `straight`."""
    c2w = np.tile(np.eye(4), (views, 1, 1))
    c2w[:, :3, :3] = [random_rotation(rng) for _ in range(views)]
    centres = rng.normal(size=(views, 3))
    if straight:
        centres = np.linspace(0.0, 1.0, views)[:, None] * rng.normal(size=3)[None]
    c2w[:, :3, 3] = baseline * centres
    K = np.stack([random_K(rng, height, width, skew) for _ in range(views)])
    return Cameras(K, c2w)


def looking_at_origin(views: int, radius: float = 4.0, height: int = 24, width: int = 40):
    """An inward arc of level cameras (OpenCV axes, world z up) around the origin."""
    angles = np.linspace(-0.6, 0.6, views)
    c2w = np.tile(np.eye(4), (views, 1, 1))
    for pose, angle in zip(c2w, angles, strict=True):
        z = -np.array([np.cos(angle), np.sin(angle), 0.3])
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], -1), -radius * z
    K = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return Cameras(np.repeat(K[None], views, 0), c2w)


def moved(cameras: Cameras, world: np.ndarray | None = None, scale: float = 1.0, offset=0.0):
    """The same cameras after a rigid motion, a change of unit and a shift of the world."""
    c2w = cameras.c2w.copy() if world is None else world @ cameras.c2w
    c2w[:, :3, 3] = c2w[:, :3, 3] * scale + offset
    return Cameras(cameras.K, c2w)


def network_inputs(context: Cameras, target: Cameras, height: int = 24, width: int = 40):
    """(camera vectors [m, 11], ray maps [m + n, h, w, 6], status): all that the networks see."""
    context, target, info = normalise(context, target)
    every = concatenate(context, target)
    vector = camera_vector(context, height, width, info.camera_scale, info.points_flag)
    return vector, np.asarray(plucker(every.K, every.c2w, height, width)), info.status


def assert_same_inputs(a, b, tolerance: float) -> None:
    """Equal up to the sign of a quaternion whose w is 0 within rounding."""
    assert a[2] == b[2]
    vector = a[0].copy()
    signs = np.sign((vector[:, 3:7] * b[0][:, 3:7]).sum(-1))
    assert np.all((signs > 0) | (np.abs(vector[:, 6]) < 1e-6))
    vector[:, 3:7] *= signs[:, None]
    np.testing.assert_allclose(vector, b[0], rtol=0, atol=tolerance)
    scale = max(1.0, np.abs(b[1]).max())
    np.testing.assert_allclose(a[1], b[1], rtol=0, atol=tolerance * scale)
