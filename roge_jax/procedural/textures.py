"""Textures of the procedural scenes: photographs shipped with scikit-image, and seeded noise.

A texture set is one `uint32` array `[textures, TEXELS]`: every row is a 256 x 256 image followed by
its mip levels (128 x 128, ... 1 x 1), every texel packed as `r | g << 8 | b << 16`. The first
`PHOTOS` rows come from photographs, the other `NOISES` rows from noise. Training and held-out sets
share neither photographs nor noise seeds.
"""

import functools
import itertools
from pathlib import Path

import numpy as np

SIDE = 256
LEVELS = 9  # 256, 128, ... 1
TEXELS = sum((SIDE >> level) ** 2 for level in range(LEVELS))
PHOTOS, NOISES = 112, 80

# Only images inside the scikit-image wheel (the others would be downloaded). The motorcycle pair is
# the built-in real scene and therefore never a texture. A name listed twice is drawn twice as often.
PHOTO_NAMES = {
    "train": (
        *("astronaut", "astronaut", "astronaut", "rocket", "rocket", "camera", "camera", "retina"),
        *("immunohistochemistry", "immunohistochemistry", "moon", "brick", "grass", "gravel"),
        *("hubble_deep_field", "page", "text"),
    ),
    "heldout": ("chelsea", "coffee", "coins"),
}
NOISE_SEEDS = {"train": 1, "heldout": 1_000_001}
PICTURES = (".jpg", ".jpeg", ".png", ".webp")
OF_FOLDER = 100  # pictures of a folder in one set, beside the photographs


@functools.cache
def load_textures(split: str = "train", folder: Path | None = None, draw: int = 0) -> np.ndarray:
    """The packed texture set of a split, `uint32 [PHOTOS + NOISES, TEXELS]`; cached, read-only.

    Args:
        split: "train" or "heldout".
        folder: pictures of any kind and size that most photographic textures are cut from instead
            (`folder_pictures`).
        draw: which of endlessly many such sets.

    Raises:
        UserError: the split is neither, or the folder has no picture for it.
    """
    from roge_jax.errors import UserError, did_you_mean

    if split not in PHOTO_NAMES:
        raise UserError(f"texture split '{split}' is unknown: {did_you_mean(split, PHOTO_NAMES)}")
    rng = np.random.default_rng([NOISE_SEEDS[split], draw] if draw else NOISE_SEEDS[split])
    photos = _photographs(PHOTO_NAMES[split])
    if folder is not None:
        found = folder_pictures(folder, split)
        chosen = rng.choice(len(found), min(len(found), OF_FOLDER), replace=False)
        photos += [_read_picture(found[i]) for i in chosen]
    rows = [_photo_texture(rng, photos) for _ in range(PHOTOS)]
    rows += [_noise_texture(rng, kind=i % len(_KINDS)) for i in range(NOISES)]
    packed = np.stack([_pack(_mip_levels(row)) for row in rows])
    packed.setflags(write=False)
    return packed


def folder_pictures(folder: Path, split: str) -> list[Path]:
    """The pictures in a folder and its folders that a split may use: a tenth of the kinds is held out.

    Pictures are of one kind if their names agree up to the last `_`: `Bricks_000.jpg`, `Bricks_001.jpg`.
    """
    from roge_jax.errors import UserError

    files = [p for p in sorted(Path(folder).rglob("*")) if p.suffix.lower() in PICTURES]
    kinds = sorted({_kind(path) for path in files})
    heldout = set(kinds[9::10])
    chosen = [path for path in files if (_kind(path) in heldout) == (split == "heldout")]
    if not chosen:
        raise UserError(
            f"{folder}: no picture for the {split} textures: give a folder of {', '.join(PICTURES)} files, of ten kinds "
            "or more for held-out scenes."
        )
    return chosen


def _kind(path: Path) -> str:
    return path.stem.rpartition("_")[0] or path.stem


def _read_picture(path: Path) -> np.ndarray:
    """A picture as float32 `[h, w, 3]` in [0, 1], small ones mirrored at their borders up to `SIDE` pixels."""
    from PIL import Image, UnidentifiedImageError

    from roge_jax.errors import UserError

    try:
        with Image.open(path) as opened:
            opened.thumbnail((4 * SIDE, 4 * SIDE))
            image = np.asarray(opened.convert("RGB"), np.float32) / 255
    except (OSError, UnidentifiedImageError) as error:
        raise UserError(f"{path} cannot be read as a picture ({error}): remove it.") from error
    missing = [(0, max(0, SIDE - side)) for side in image.shape[:2]]
    return np.pad(image, [*missing, (0, 0)], mode="symmetric")


def _photographs(names: tuple[str, ...]) -> list[np.ndarray]:
    """Images as float32 `[h, w, 3]` in [0, 1]."""
    import skimage.data

    images = {}
    for name in dict.fromkeys(names):
        image = np.asarray(getattr(skimage.data, name)(), np.float32) / 255
        image = image[..., None].repeat(3, -1) if image.ndim == 2 else image[..., :3]
        if min(image.shape[:2]) > 800:  # halve the largest so that a resize does not alias
            h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
            image = image[:h, :w].reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3))
        if name in ("retina", "hubble_deep_field"):  # drop the black surround
            h, w = image.shape[0] // 6, image.shape[1] // 6
            image = image[h:-h, w:-w]
        images[name] = image
    return [images[name] for name in names]


def _resize(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear resize with pixel centres at +0.5."""

    def axis(x, size, dim):
        at = np.clip((np.arange(size) + 0.5) * x.shape[dim] / size - 0.5, 0, x.shape[dim] - 1)
        low = np.minimum(at.astype(int), x.shape[dim] - 2) if x.shape[dim] > 1 else at.astype(int)
        high = np.minimum(low + 1, x.shape[dim] - 1)
        shape = [1, 1, 1]
        shape[dim] = size
        frac = (at - low).astype(np.float32).reshape(shape)
        return x.take(low, dim) * (1 - frac) + x.take(high, dim) * frac

    return axis(axis(image, height, 0), width, 1)


def _crop(rng, photos, height: int, width: int) -> np.ndarray:
    """A random crop of a random photograph, mirrored or turned, with its colours varied."""
    image = photos[rng.integers(len(photos))]
    side = min(image.shape[:2])
    size = int(side * rng.uniform(0.3, 1.0))
    top, left = rng.integers(image.shape[0] - size + 1), rng.integers(image.shape[1] - size + 1)
    crop = image[top : top + size, left : left + size]
    grey = bool((crop[..., 0] == crop[..., 1]).all())
    crop = np.rot90(crop, rng.integers(4) if rng.random() < 0.3 else 0)
    crop = crop[:, ::-1] if rng.random() < 0.5 else crop
    crop = _resize(np.ascontiguousarray(crop), height, width)
    crop = crop ** rng.uniform(0.6, 1.3)
    if grey:
        dark, light = _palette(rng, 2)
        dark, light = dark * 0.4, 0.5 + light / 2
        crop = dark + (light - dark) * crop
    else:
        crop = crop[..., rng.permutation(3)] if rng.random() < 0.4 else crop
        saturation = rng.uniform(0.3, 0.9)
        crop = crop * saturation + crop.mean(-1, keepdims=True) * (1 - saturation)
    return crop


def _photo_texture(rng, photos) -> np.ndarray:
    """One crop, or (one in four) a collage of several: shelves, posters, tiles."""
    if rng.random() < 0.75:
        return _crop(rng, photos, SIDE, SIDE)
    rows, columns = rng.integers(1, 5), rng.integers(2, 5)
    out = np.empty((SIDE, SIDE, 3), np.float32)
    out[:] = _palette(rng, 1)[0]
    border = int(rng.integers(0, 7))
    ys, xs = (np.linspace(0, SIDE, n + 1).astype(int) for n in (rows, columns))
    for y0, y1 in itertools.pairwise(ys):
        for x0, x1 in itertools.pairwise(xs):
            box = (slice(y0 + border, y1 - border), slice(x0 + border, x1 - border))
            out[box] = _crop(rng, photos, y1 - y0 - 2 * border, x1 - x0 - 2 * border)
    return out


def _palette(rng, count: int) -> np.ndarray:
    """Muted colours `[count, 3]`: a random hue at low to moderate saturation."""
    hue = rng.uniform(0, 1) + rng.normal(0, 0.12, (count, 1))
    value = rng.uniform(0.15, 0.95, (count, 1))
    wave = 0.5 + 0.5 * np.cos(2 * np.pi * (hue + np.array([[0, 1 / 3, 2 / 3]])))
    saturation = rng.uniform(0.05, 0.6, (count, 1))
    return (value * (1 - saturation * (1 - wave))).astype(np.float32)


def _cloud(rng, slope: float, stretch: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    """Tileable fractal noise `[SIDE, SIDE]` in [0, 1]: amplitude falls as frequency ** -slope."""
    fy, fx = np.meshgrid(np.fft.fftfreq(SIDE) * SIDE, np.fft.rfftfreq(SIDE) * SIDE, indexing="ij")
    radius = np.sqrt((fy * stretch[0]) ** 2 + (fx * stretch[1]) ** 2 + 1.0)
    spectrum = np.fft.rfft2(rng.standard_normal((SIDE, SIDE))) * radius**-slope
    spectrum[0, 0] = 0
    noise = np.fft.irfft2(spectrum, s=(SIDE, SIDE))
    return np.clip(0.5 + noise / (4 * noise.std()), 0, 1).astype(np.float32)


def _ramp(value: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Colours of `value` in [0, 1] along a palette `[k, 3]`."""
    at = value * (len(palette) - 1)
    low = np.minimum(at.astype(int), len(palette) - 2)
    frac = (at - low)[..., None]
    return palette[low] * (1 - frac) + palette[low + 1] * frac


def _grain(rng, image: np.ndarray, amount: float) -> np.ndarray:
    return image * (1 - amount + 2 * amount * _cloud(rng, rng.uniform(0.4, 1.4)))[..., None]


def _fractal(rng):
    return _ramp(_cloud(rng, rng.uniform(0.9, 1.8)), _palette(rng, 4))


def _plaster(rng):
    return _grain(rng, np.broadcast_to(_palette(rng, 1)[0], (SIDE, SIDE, 3)), 0.25)


def _wood(rng):
    rings = _cloud(rng, 1.6, (0.15, 1.0)) * rng.uniform(3, 9) + 0.4 * _cloud(rng, 1.0, (0.1, 1.0))
    return _grain(rng, _ramp(0.5 + 0.5 * np.sin(2 * np.pi * rings), _palette(rng, 3)), 0.2)


def _stripes(rng):
    edges = np.sort(rng.choice(np.arange(4, SIDE - 4), rng.integers(6, 24), replace=False))
    strip = np.searchsorted(edges, np.arange(SIDE) + 0.5)
    bend = (_cloud(rng, 2.0) * rng.choice([0, 0, 40])).astype(int)
    return _grain(rng, _palette(rng, len(edges) + 1)[strip[(np.arange(SIDE) + bend) % SIDE]], 0.25)


def _cells(rng):
    from scipy.spatial import KDTree

    points = rng.uniform(0, SIDE, (rng.integers(12, 90), 2))
    grid = np.stack(np.mgrid[:SIDE, :SIDE], -1).astype(float)
    distance, owner = KDTree(points, boxsize=SIDE).query(grid, k=2)
    joint = np.clip((distance[..., 1] - distance[..., 0]) / 4, 0.35, 1)[..., None]
    return _grain(rng, _palette(rng, len(points))[owner[..., 0]] * joint, 0.3)


def _bricks(rng):
    rows, columns = int(rng.integers(4, 14)), int(rng.integers(2, 8))
    y, x = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE
    row = np.floor(y * rows).astype(int)
    along = x * columns + rng.choice([0, 0.5]) * (row % 2)
    column = np.floor(along).astype(int) % columns
    joint = (np.abs(y * rows - row - 0.5) < 0.45) & (np.abs(along % 1 - 0.5) < 0.46)
    palette = _palette(rng, 3)
    tone = rng.uniform(0, 1, (rows, columns))[row, column]
    return _grain(rng, np.where(joint[..., None], _ramp(tone, palette[:2]), palette[2]), 0.3)


def _checks(rng):
    count = int(rng.integers(2, 10))
    y, x = np.mgrid[:SIDE, :SIDE] * count // SIDE
    return _grain(rng, _palette(rng, 2)[(y + x) % 2], 0.3)


def _blots(rng):
    level = _cloud(rng, rng.uniform(1.2, 2.0))
    mask = np.clip((level - rng.uniform(0.4, 0.6)) * 20 + 0.5, 0, 1)
    return _grain(rng, _ramp(mask, _palette(rng, 2)), 0.3)


_KINDS = (_fractal, _plaster, _wood, _stripes, _cells, _bricks, _checks, _blots)


def _noise_texture(rng, *, kind: int) -> np.ndarray:
    image = _KINDS[kind](rng)
    return np.rot90(image, rng.integers(2)).astype(np.float32)


def _mip_levels(image: np.ndarray) -> list[np.ndarray]:
    levels = [np.clip(image, 0, 1)]
    for _ in range(LEVELS - 1):
        side = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(side, 2, side, 2, 3).mean((1, 3)))
    return levels


def _pack(levels: list[np.ndarray]) -> np.ndarray:
    texels = np.concatenate([level.reshape(-1, 3) for level in levels])
    r, g, b = np.round(texels * 255).astype(np.uint32).T
    return r | g << 8 | b << 16
