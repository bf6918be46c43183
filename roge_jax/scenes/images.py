"""Photographs from disk: decoding without surprises.

Every picture comes out as float32 RGB [h, w, 3] in [0, 1], sRGB. What cannot be read that way (HDR,
CMYK without a profile, damaged files) is refused with the file's name, never guessed.
"""

import contextlib
import dataclasses
import struct
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.scenes.lens import Lens, undistort

HEIC = (".heic", ".heif")  # an iPhone's own; pillow-heif turns them upright itself
HDR = (".exr", ".hdr", ".pfm")
MEND = "copy or export the photo again, or leave it out of the scene"
EXIF_ORIENTATION = 0x0112
# EXIF orientation -> quarter turns counter-clockwise from the stored to the displayed picture.
QUARTER_TURNS = {1: 0, 3: 2, 6: 3, 8: 1}
# The luminance table of ITU-T T.81, annex K, which encoders scale by a quality from 1 to 100 as libjpeg does.
JPEG_TABLE = np.array([
    *(16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55),
    *(14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51, 87, 80, 62),
    *(18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92),
    *(49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99),
])  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Header:
    """What a file says before its pixels are decoded; sizes are (height, width)."""

    stored: tuple[int, int]
    orientation: int
    alpha: bool
    mode: str

    @property
    def displayed(self) -> tuple[int, int]:
        """The size after the EXIF orientation is applied."""
        return self.stored[::-1] if self.orientation >= 5 else self.stored


def read_header(file: Path) -> Header:
    """Size, orientation and mode of a picture. Raises UserError if the file is missing or alien."""
    from PIL import Image

    if file.suffix.lower() in HDR:
        raise UserError(
            f"{file}: HDR pictures have no fixed white: tone-map it to an 8 or 16 bit PNG first."
        )
    try:
        with _opened(file) as picture:
            orientation = _orientation_tag(picture)
            bands = picture.getbands()
            mode = picture.mode
            transparent = mode != "LAB" and ("A" in bands or "a" in bands)
            alpha = transparent or "transparency" in picture.info
            size = (picture.height, picture.width)
            if picture.format == "TIFF":  # Pillow says the size after turning
                size = (int(picture.tag_v2[257]), int(picture.tag_v2[256]))
    except UserError:
        raise
    except FileNotFoundError:
        raise UserError(f"{file}: there is no such picture.") from None
    except Image.DecompressionBombError:
        raise UserError(
            f"{file}: has more than {2 * (Image.MAX_IMAGE_PIXELS or 0):,} pixels: make it smaller."
        ) from None
    except Exception as error:
        raise UserError(f"{file}: not a readable picture ({error}): {MEND}.") from None
    return Header(size, orientation if 1 <= orientation <= 8 else 1, alpha, mode)


def jpeg_quality(file: Path) -> int | None:
    """The quality, 1 to 100, at which a JPEG file was written last; None for other files.

    That of the libjpeg table whose steps add up to those of the file's luminance table: exact for what libjpeg wrote,
    as coarse as that for tables of an encoder's own.
    """
    with _opened(file) as picture:
        tables = getattr(picture, "quantization", None)
    if not tables:
        return None
    qualities = np.arange(1, 101)
    scales = np.where(qualities < 50, 5000 // qualities, 200 - 2 * qualities)
    steps = np.clip((JPEG_TABLE * scales[:, None] + 50) // 100, 1, 255).sum(1)
    return int(qualities[np.argmin(np.abs(steps - sum(tables[min(tables)])))])


def without_orientation(data: bytes) -> bytes:
    """The bytes of a TIFF file with its orientation tag set to 1, so that no decoder turns the pixels; others as given.

    Decoders disagree about who turns a TIFF (some turn 8 bits and not 16), so here it is nobody but `_upright`.
    """
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None:
        return data
    version = struct.unpack_from(order + "H", data, 2)[0]
    big = version == 43
    head, count, entry = ("Q", "Q", 20) if big else ("I", "H", 12)
    patched = bytearray(data)
    try:
        at = struct.unpack_from(order + head, data, 8 if big else 4)[0]
        number = struct.unpack_from(order + count, data, at)[0]
        at += struct.calcsize(count)
        for i in range(number):
            tag, kind = struct.unpack_from(order + "HH", data, at + i * entry)
            if tag == EXIF_ORIENTATION:
                value = at + i * entry + (12 if big else 8)
                struct.pack_into(order + ("I" if kind == 4 else "H"), patched, value, 1)
    except struct.error:
        return data
    return bytes(patched)


@contextlib.contextmanager
def _decodable(file: Path) -> Iterator[Any]:
    """Pillow's picture on its stored grid: a TIFF's orientation is left to `_upright`."""
    from PIL import Image

    if file.suffix.lower() not in (".tif", ".tiff"):
        with _opened(file) as picture:
            yield picture
        return
    import io

    with Image.open(io.BytesIO(without_orientation(file.read_bytes()))) as picture:
        yield picture


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """Pillow's picture. Large ones are fine: Pillow warns of them for the sake of web servers."""
    from PIL import Image

    if file.suffix.lower() in HEIC:
        try:
            import pillow_heif
        except ImportError:
            raise UserError(
                f"{file}: HEIC needs the package pillow-heif: pip install 'roge_jax[heic]', or export JPEG."
            ) from None
        pillow_heif.register_heif_opener()
    # Not within `catch_warnings`, which two threads must not enter at a time.
    warnings.simplefilter("ignore", Image.DecompressionBombWarning)
    with Image.open(file) as picture:
        yield picture


def read_image(file: Path, *, background: float = 1.0, exif: bool = True) -> np.ndarray:
    """A photo as float32 RGB [h, w, 3] in [0, 1].

    Args:
      file: 8 or 16 bit PNG, JPEG, WebP, TIFF ... 16 bits are divided by 65535.
      background: what transparent pixels show (white as in comparable projects).
      exif: turn the picture as its EXIF orientation says; False keeps the stored grid.
    Raises: UserError for missing, damaged, HDR, floating point or profile-less CMYK files.
    """
    header = read_header(file)
    try:
        if header.mode not in ("CMYK", "LAB") and _is_deep(file):
            pixels = _read_deep(file)
        else:
            with _decodable(file) as picture:
                picture.load()
                pixels = np.asarray(_to_rgb(picture, file), np.float32) / np.float32(255)
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{file}: damaged or truncated picture ({error}): {MEND}.") from None
    pixels = _upright(pixels, header.orientation) if exif else pixels
    if pixels.shape[-1] == 4:
        alpha = pixels[..., 3:]
        pixels = pixels[..., :3] * alpha + np.float32(background) * (1 - alpha)
    return np.ascontiguousarray(pixels, np.float32)


def _orientation_tag(picture: Any) -> int:
    """The EXIF orientation from the header. Pillow would decode a whole PNG to look behind it."""
    from PIL import Image

    if picture.format != "PNG":
        return int(picture.getexif().get(EXIF_ORIENTATION, 1))
    exif = Image.Exif()
    exif.load(picture.info.get("exif", b""))
    return int(exif.get(EXIF_ORIENTATION, 1))


def _is_deep(file: Path) -> bool:
    """Whether Pillow would cut the file to 8 bits: 16 bit PNG, or TIFF."""
    if file.suffix.lower() in (".tif", ".tiff"):
        return True
    with file.open("rb") as stream:
        start = stream.read(25)
    return start.startswith(b"\x89PNG") and len(start) == 25 and start[24] == 16


def _read_deep(file: Path) -> np.ndarray:
    """8 or 16 bits per channel to float32 [h, w, 3 or 4]."""
    try:
        import cv2
    except ImportError:
        raise UserError(f"{file}: needs OpenCV to be read: pip install opencv-python.") from None
    data = without_orientation(file.read_bytes())
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise UserError(f"{file}: damaged or truncated picture: {MEND}.")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise UserError(f"{file}: {pixels.dtype} pixels: convert it to an 8 or 16 bit PNG first.")
    white = np.float32(255 if pixels.dtype == np.uint8 else 65535)
    pixels = np.asarray(pixels, np.float32) / white
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if pixels.shape[-1] == 1:
        return np.repeat(pixels, 3, -1)
    return pixels[..., [2, 1, 0, *range(3, pixels.shape[-1])]]


def _to_rgb(picture: Any, file: Path) -> Any:
    """An 8 bit Pillow picture of any mode as RGB or (straight alpha) RGBA in sRGB."""
    import io

    from PIL import ImageCms

    profile = picture.info.get("icc_profile")
    if picture.mode == "CMYK" and not profile:
        raise UserError(f"{file}: CMYK without a colour profile: convert it to sRGB first.")
    if picture.mode in ("F", "I", "I;16", "I;16B", "I;16L", "LAB"):
        raise UserError(f"{file}: pixel mode {picture.mode}: convert it to an 8 or 16 bit PNG.")
    if profile and picture.mode in ("RGB", "CMYK"):
        try:
            source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            if "srgb" in ImageCms.getProfileDescription(source).lower():
                return picture.convert("RGB")  # the conversion would only add rounding
            return ImageCms.profileToProfile(
                picture, source, ImageCms.createProfile("sRGB"), outputMode="RGB"
            )
        except ImageCms.PyCMSError:
            if picture.mode == "CMYK":
                raise UserError(f"{file}: its colour profile is broken: convert it.") from None
    if picture.mode in ("LA", "La", "PA", "RGBa", "RGBA") or "transparency" in picture.info:
        return picture.convert("RGBa" if picture.mode == "La" else "RGBA").convert("RGBA")
    return picture.convert("RGB")


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Stored [h, w, c] to displayed, for the EXIF orientations 1..8."""
    mirrored = {2: (0, True), 4: (2, True), 5: (1, True), 7: (3, True)}
    turns, flip = mirrored.get(orientation, (QUARTER_TURNS.get(orientation, 0), False))
    return np.rot90(pixels[:, ::-1] if flip else pixels, turns)


@dataclasses.dataclass(frozen=True)
class Photo:
    """How one file becomes the picture that its camera describes."""

    file: Path
    size: tuple[int, int]  # of the result
    exif: bool = True
    quarter_turns: int = 0  # after decoding and straightening
    lens: Lens | None = None
    K: np.ndarray | None = None  # of the decoded picture, for the lens
    new_K: np.ndarray | None = None
    straight: tuple[int, int] | None = None  # size after straightening
    background: float = 1.0

    def read(self) -> np.ndarray:
        """float32 [h, w, 3] in [0, 1]."""
        image = read_image(self.file, background=self.background, exif=self.exif)
        if self.lens is not None:
            assert self.K is not None and self.new_K is not None
            image = np.clip(
                undistort(image, self.K, self.lens, self.new_K, self.straight), 0.0, 1.0
            )
        return np.ascontiguousarray(np.rot90(image, self.quarter_turns))


class Photos(Sequence):
    """The photos of a scene, decoded when they are asked for."""

    def __init__(self, photos: Sequence[Photo]):
        self.photos = list(photos)

    def __len__(self) -> int:
        return len(self.photos)

    def __getitem__(self, index: Any) -> Any:
        """float32 [h, w, 3] for a number; a slice of `Photos` for a slice."""
        if isinstance(index, slice):
            return Photos(self.photos[index])
        return self.photos[index].read()

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(height, width) of every photo, without decoding."""
        return [photo.size for photo in self.photos]
