"""A room of three textured planes, rendered by homographies: photos with true poses that features can be matched in."""

import numpy as np

from roge_jax.geometry.cameras import Cameras, invert

TEXELS = 640  # of a plane, on either side
# Corner, and the two edges of each plane, in a world whose z is up.
PLANES = (
    ((-2.0, -2.0, 0.0), (4.0, 0.0, 0.0), (0.0, 4.0, 0.0)),  # floor
    ((-2.0, 2.0, 0.0), (4.0, 0.0, 0.0), (0.0, 0.0, 3.0)),  # wall ahead
    ((-2.0, -2.0, 0.0), (0.0, 4.0, 0.0), (0.0, 0.0, 3.0)),  # wall on the left
    ((-0.4, 0.2, 0.5), (0.8, 0.0, 0.0), (0.0, 0.8, 0.0)),  # a table
)


def texture(rng: np.random.Generator) -> np.ndarray:
    """uint8 [TEXELS, TEXELS, 3]: blotches of many sizes."""
    import cv2

    total = np.zeros((TEXELS, TEXELS, 3), np.float32)
    for cells in (8, 24, 72, 200):
        noise = rng.random((cells, cells, 3), np.float32)
        total += cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
    total = (total - total.min()) / (total.max() - total.min())
    return (255 * np.clip(1.8 * total - 0.4, 0, 1)).astype(np.uint8)


def walk(count: int, height: int, width: int, *, spread: float = 60.0) -> Cameras:
    """Cameras on an arc of `spread` degrees that look at the table, at changing heights."""
    focal = 0.9 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    poses = []
    for i, angle in enumerate(np.radians(np.linspace(-spread / 2, spread / 2, count))):
        centre = np.array(
            [2.6 * np.sin(angle) + 0.3, 0.5 - 2.6 * np.cos(angle), 1.3 + 0.15 * (i % 3)]
        )
        ahead = np.array([0.0, 0.5, 0.6]) - centre
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], 1)
        pose[:3, 3] = centre
        poses.append(pose)
    return Cameras(np.tile(K, (count, 1, 1)), np.stack(poses))


def render(cameras: Cameras, height: int, width: int, seed: int = 0) -> list[np.ndarray]:
    """uint8 [h, w, 3] of every camera; planes are painted from the farthest to the nearest, none cuts another."""
    import cv2

    rng = np.random.default_rng(seed)
    textures = [texture(rng) for _ in PLANES]
    pictures = []
    for K, pose in zip(cameras.K, cameras.c2w, strict=True):
        picture = np.full((height, width, 3), 200, np.uint8)
        for (corner, u, v), paint in zip(PLANES, textures, strict=True):
            plane = np.eye(4)[:, :3]
            plane[:3] = np.stack([np.array(u) / TEXELS, np.array(v) / TEXELS, corner], 1)
            plane[3] = (0, 0, 1)
            H = K @ (invert(pose) @ plane)[:3]
            halves = np.eye(3)  # arrays count centres as whole numbers
            halves[:2, 2] = 0.5
            H = np.linalg.inv(halves) @ H @ halves
            drawn = _drawn(H, paint, height, width)
            picture[drawn[1]] = drawn[0][drawn[1]]
        pictures.append(cv2.GaussianBlur(picture, (0, 0), 0.6))
    return pictures


def _drawn(
    H: np.ndarray, paint: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """(pixels, where the plane is) of one plane: every pixel's ray is followed to it."""
    import cv2

    y, x = np.mgrid[:height, :width]
    at = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(H).T
    front = at[..., 2] > 0  # H keeps the depth as its third number: its inverse has one over it
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = at[..., 0] / at[..., 2], at[..., 1] / at[..., 2]
    inside = front & (s > -0.5) & (s < TEXELS - 0.5) & (t > -0.5) & (t < TEXELS - 0.5)
    pixels = cv2.remap(
        paint,
        s.astype(np.float32),
        t.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return pixels, inside
