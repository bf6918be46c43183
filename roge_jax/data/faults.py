"""What goes wrong with posed photos, in measured doses: poses, focal lengths, noise, blur, JPEG, exposure; and a little of
all that matters at once, as training draws it.

Every function returns changed copies; random ones take a NumPy generator. Photos are float32 [m, h, w, 3] in [0, 1],
doses are those that reach the model: a photo of 12 megapixels that is shrunk to 64 x 112 loses most of its own noise.
"""

import numpy as np

from roge_jax.geometry.cameras import Cameras, scale_focal, to_host

GAMMA = 2.2  # of the photos, for what happens to light
# Largest doses of `captured`: degrees, parts of the baseline, log focal length, stops, deviation of noise.
TURN, MOVE, FOCAL, STOPS, NOISE = 0.6, 0.03, 0.02, 0.4, 0.03


def turn_cameras(cameras: Cameras, degrees: float, rng: np.random.Generator) -> Cameras:
    """Every camera turned on the spot about a random axis; the root mean square of the angles is `degrees`."""
    from scipy.spatial.transform import Rotation

    cameras = to_host(cameras)
    turns = np.radians(degrees) / np.sqrt(3.0) * rng.standard_normal((len(cameras), 3))
    c2w = cameras.c2w.copy()
    c2w[:, :3, :3] = c2w[:, :3, :3] @ Rotation.from_rotvec(turns).as_matrix()
    return Cameras(cameras.K, c2w)


def move_cameras(cameras: Cameras, distance: float, rng: np.random.Generator) -> Cameras:
    """Every camera moved in a random direction; the root mean square of the distances is `distance` (scene units)."""
    cameras = to_host(cameras)
    c2w = cameras.c2w.copy()
    c2w[:, :3, 3] += distance / np.sqrt(3.0) * rng.standard_normal((len(cameras), 3))
    return Cameras(cameras.K, c2w)


def add_noise(images: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Gaussian noise of standard deviation `sigma` (1 is white) on every pixel and channel, clipped to [0, 1]."""
    noise = rng.standard_normal(images.shape).astype(np.float32)
    return np.clip(images + np.float32(sigma) * noise, 0.0, 1.0)


def blur(images: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur of standard deviation `sigma` pixels, borders mirrored."""
    import cv2

    return np.stack(
        [cv2.GaussianBlur(x, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101) for x in images]
    )


def jpeg(images: np.ndarray, quality: int) -> np.ndarray:
    """Coded and decoded as JPEG (libjpeg's quality 1 to 100, colours at half resolution)."""
    import cv2

    settings = [
        *(cv2.IMWRITE_JPEG_QUALITY, int(quality)),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
    ]
    found = []
    for image in images:
        pixels = np.rint(255.0 * image[..., ::-1]).astype(np.uint8)
        _, data = cv2.imencode(".jpg", pixels, settings)
        found.append(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1])
    return np.stack(found).astype(np.float32) / 255.0


def expose(images: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Each photo with its light doubled `stops` [m] times (negative: halved), clipped to [0, 1]."""
    gain = (2.0 ** (np.asarray(stops, np.float64) / GAMMA)).astype(np.float32)
    return np.clip(images * gain[:, None, None, None], 0.0, 1.0)


def captured(images: np.ndarray, cameras: Cameras, rng: np.random.Generator):
    """Photos and their cameras as a capture would give them: every fault in a dose of its own, drawn from zero to the
    largest. The same focal error for all photos (one lens), another exposure for each.
    """
    turn, move, focal, stops, noise = rng.random(5) * [TURN, MOVE, FOCAL, STOPS, NOISE]
    centres = cameras.centres
    baseline = np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()
    cameras = move_cameras(turn_cameras(cameras, turn, rng), move * baseline, rng)
    cameras = scale_focal(cameras, float(np.exp(focal * rng.choice([-1.0, 1.0]))))
    images = expose(images, stops * rng.uniform(-1.0, 1.0, len(images)))
    return add_noise(images, noise, rng), cameras
