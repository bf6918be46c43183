"""OpenEXR: pictures in float with linear light, z-depth, and the camera that they were seen by.

Channels R, G, B (linear, from sRGB) and, where depth is given, Z (distance along the camera's axis, NaN where unknown).
The header has `K` (pixels, 3x3) and `cameraToWorld` (4x4, OpenCV axes), both by rows, and in `comments` a remark.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError


class Picture(NamedTuple):
    """rgb [h, w, 3] float32, sRGB, 1 is white; depth [h, w] or None; K [3, 3], c2w [4, 4] or None; remark or None."""

    rgb: np.ndarray
    depth: np.ndarray | None = None
    K: np.ndarray | None = None
    c2w: np.ndarray | None = None
    about: str | None = None


def linear(srgb: np.ndarray) -> np.ndarray:
    """sRGB to linear light, float32; nothing is cut off."""
    x = np.asarray(srgb, np.float32)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0.0) + 0.055) / 1.055) ** 2.4)


def encoded(light: np.ndarray) -> np.ndarray:
    """Linear light to sRGB, float32: the inverse of `linear`."""
    x = np.asarray(light, np.float32)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0) ** (1 / 2.4) - 0.055)


def write_exr(file: str | Path, picture: Picture) -> None:
    """One picture, 32 bits a channel, losslessly compressed; whole or absent."""
    import OpenEXR

    file = Path(file)
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if picture.K is not None:
        header["K"] = np.asarray(picture.K, np.float64)
    if picture.c2w is not None:
        header["cameraToWorld"] = np.asarray(picture.c2w, np.float64)
    if picture.about:
        header["comments"] = picture.about
    light = linear(picture.rgb).astype(np.float32)
    channels = {name: np.ascontiguousarray(light[..., i]) for i, name in enumerate("RGB")}
    if picture.depth is not None:
        channels["Z"] = np.ascontiguousarray(picture.depth, np.float32)
    part = file.with_name(f".{file.stem}.part{file.suffix}")
    try:
        OpenEXR.File(header, channels).write(str(part))
        part.replace(file)
    except RuntimeError as error:  # OpenEXR's own, also for a full disk
        raise UserError(f"{file}: cannot be written ({error}): give another place.") from None
    finally:
        part.unlink(missing_ok=True)


def read_exr(file: str | Path) -> Picture:
    """What `write_exr` wrote. Raises: UserError for other files."""
    import OpenEXR

    try:
        with OpenEXR.File(str(file), separate_channels=True) as opened:
            header, channels = dict(opened.header()), opened.channels()
            rgb = encoded(np.stack([channels[name].pixels for name in "RGB"], -1))
            depth = channels["Z"].pixels.copy() if "Z" in channels else None
    except (RuntimeError, KeyError) as error:
        raise UserError(f"{file}: is no picture in OpenEXR with R, G and B ({error}).") from None
    return Picture(rgb, depth, header.get("K"), header.get("cameraToWorld"), header.get("comments"))
