"""Videos and pictures in and out. Every file is written under a temporary name and renamed when it is whole.

Frames are [n, h, w, 3], RGB, uint8 or float in [0, 1].
"""

import errno
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from .folders import put

FPS = 16  # of Wan2.1
DISK = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.ENOENT, errno.EROFS)
BT709 = 1  # the number of this colour standard in H.264 and in FFmpeg


def to_uint8(frames: np.ndarray) -> np.ndarray:
    """Frames as uint8: float values are clipped to [0, 1] and rounded."""
    frames = np.asarray(frames)
    if frames.dtype == np.uint8:
        return frames
    return np.rint(np.clip(frames, 0.0, 1.0) * 255.0).astype(np.uint8)


def even(frames: np.ndarray) -> np.ndarray:
    """Frames with even height and width, which 4:2:0 video needs: the last row or column is repeated."""
    h, w = frames.shape[1:3]
    return np.pad(frames, ((0, 0), (0, h % 2), (0, w % 2), (0, 0)), mode="edge")


@contextmanager
def _whole(file: Path) -> Iterator[Path]:
    """A temporary path beside `file` with its suffix; becomes `file` if the block succeeds."""
    temporary = file.with_name(f".{file.stem}.part{file.suffix}")
    try:
        yield temporary
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)


def write_video(
    path: str | Path, frames: np.ndarray, fps: float = FPS, *, quality: int = 16
) -> Path:
    """Writes H.264 (yuv420p, index in front) that browsers play; returns the file written.

    `quality` is x264's constant rate factor, 0 lossless to 51. Where this PyAV has no encoder for H.264 (builds without
    GPL parts), or none is installed, it is VP9 in a .webm of the same name, and at last an animated .webp, with a
    warning: a missing codec never costs the frames. Raises: UserError for no frames or another shape.
    """
    path, frames = Path(path), to_uint8(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.size == 0:
        raise UserError(f"{path}: a video needs frames [n, h, w, 3], given shape {frames.shape}.")
    if not fps > 0:
        raise UserError(f"{path}: {fps} frames per second: give a number above 0.")
    frames, reasons = even(frames), []
    for name, ending, write in _writers():
        target = path if ending is None else path.with_suffix(ending)
        try:
            with _whole(target) as temporary:
                write(temporary, frames, fps, quality)
        except OSError as error:  # PyAV's are such, too: those of the disk are no matter of codecs
            if type(error).__module__ == "builtins" or error.errno in DISK:
                raise
            reasons.append(f"{name}: {error}")
        except (ImportError, UserError, ValueError, RuntimeError) as error:
            reasons.append(
                "PyAV is not installed" if isinstance(error, ImportError) else f"{name}: {error}"
            )
        else:
            if reasons:
                told = f"{target.name} ({name}) is written instead of {path.name}"
                warnings.warn(f"{reasons[0]}: {told}", stacklevel=2)
            return target
    raise UserError(
        f"{path}: no video could be written ({'; '.join(reasons)}): install PyAV (pip install av)."
    )


def _write_h264(file: Path, frames: np.ndarray, fps: float, quality: int) -> None:
    _write_av(file, frames, fps, "libx264", {"crf": str(quality), "preset": "medium"})


def _write_av_vp9(file: Path, frames: np.ndarray, fps: float, quality: int) -> None:
    _write_av(file, frames, fps, "libvpx-vp9", {"crf": str(quality), "b": "0"})


def _write_webp(file: Path, frames: np.ndarray, fps: float, quality: int) -> None:
    write_webp(file, frames, fps)


def _write_av(
    file: Path, frames: np.ndarray, fps: float, codec: str, options: dict[str, str]
) -> None:
    """One encoder of PyAV's. Raises: what PyAV raises, an OSError or ValueError, if it lacks the codec or the codec refuses."""
    import av

    form, more = ("mp4", {"movflags": "+faststart"}) if file.suffix == ".mp4" else ("webm", {})
    with av.open(str(file), "w", format=form, options=more) as container:
        stream: Any = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        stream.options = options
        context = stream.codec_context
        # Untagged colours are guessed from the size, and differently by every player.
        context.color_primaries = context.color_trc = context.colorspace = BT709
        context.color_range = 1  # limited
        for i, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=BT709)
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _write_vp9(file: Path, frames: np.ndarray, fps: float, quality: int) -> None:
    import cv2

    h, w = frames.shape[1:3]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"VP90"), fps, (w, h))
    if not writer.isOpened():
        raise UserError(
            f"{file}: this OpenCV cannot write VP9 either: install PyAV (pip install av)."
        )
    for pixels in frames:
        writer.write(np.ascontiguousarray(pixels[..., ::-1]))
    writer.release()


def _writers() -> list[tuple[str, str | None, Callable[[Path, np.ndarray, float, int], None]]]:
    """What is tried, in order: (name, ending or None for the given one, writer)."""
    return [
        ("H.264", None, _write_h264),
        ("VP9", ".webm", _write_av_vp9),
        ("VP9", ".webm", _write_vp9),
        ("WebP", ".webp", _write_webp),
    ]


def read_video(path: str | Path) -> np.ndarray:
    """All frames of a video, uint8 [n, h, w, 3]. Raises: UserError if it is missing or no video."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: there is no such video file.")
    try:
        import av
    except ImportError:
        frames = _read_cv2(path)
    else:
        try:
            with av.open(str(path)) as container:
                frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        except (av.error.FFmpegError, IndexError) as error:
            raise UserError(f"{path}: cannot be read as a video ({error}).") from None
    if not frames:
        raise UserError(f"{path}: cannot be read as a video (no frames).")
    return np.stack(frames)


def _read_cv2(path: Path) -> list[np.ndarray]:
    import cv2

    capture = cv2.VideoCapture(str(path))
    frames: list[np.ndarray] = []
    while True:
        there, pixels = capture.read()
        if not there:
            return frames
        frames.append(pixels[..., ::-1])


def write_webp(
    path: str | Path, frames: np.ndarray, fps: float = FPS, *, quality: int = 80
) -> Path:
    """An endless animated WebP: a seventh of a GIF's size, shown by every browser and code host."""
    from PIL import Image

    path = Path(path)
    first, *rest = (Image.fromarray(pixels) for pixels in to_uint8(frames))
    with _whole(path) as temporary:
        first.save(
            temporary,
            save_all=True,
            append_images=rest,
            duration=round(1000 / fps),
            loop=0,
            quality=quality,
            method=4,
        )
    return path


def write_png(path: str | Path, pixels: np.ndarray) -> Path:
    """One picture [h, w, 3], lossless; equal pixels give equal bytes."""
    from PIL import Image

    path = Path(path)
    with _whole(path) as temporary:
        Image.fromarray(to_uint8(pixels)).save(temporary, compress_level=6)
    return path


def write_frames(folder: str | Path, frames: np.ndarray) -> list[str]:
    """0000.png, 0001.png .. in a folder that is replaced whole; returns the file names."""
    folder = Path(folder)
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    names = [
        write_png(part / f"{i:04d}.png", pixels).name for i, pixels in enumerate(to_uint8(frames))
    ]
    put(part, folder)
    return names


def contact_sheet(
    rows: dict[str, Sequence[np.ndarray] | np.ndarray],
    *,
    columns: int = 8,
    gap: int = 4,
    min_height: int = 96,
) -> np.ndarray:
    """Rows of pictures on white, the name of each row above it; uint8 [H, W, 3].

    A row longer than `columns` is thinned out evenly, first and last kept. Small pictures are enlarged by a whole
    factor, without smoothing, to at least `min_height`.
    """
    from PIL import Image, ImageDraw, ImageFont

    thinned = {}
    for label, pictures in rows.items():
        pick = np.linspace(0, len(pictures) - 1, min(columns, len(pictures))).round().astype(int)
        thinned[label] = [to_uint8(pictures[i]) for i in pick]
    height = max(picture.shape[0] for row in thinned.values() for picture in row)
    factor = max(1, -(-min_height // height))
    cells = {k: [p.repeat(factor, 0).repeat(factor, 1) for p in row] for k, row in thinned.items()}
    font = ImageFont.load_default(size=14)
    line = 20
    width = max(sum(p.shape[1] + gap for p in row) for row in cells.values()) + gap
    tall = sum(line + max(p.shape[0] for p in row) + gap for row in cells.values()) + gap
    sheet = Image.new("RGB", (width, tall), "white")
    draw, top = ImageDraw.Draw(sheet), gap
    for label, row in cells.items():
        draw.text((gap, top), label, fill="black", font=font)
        left = gap
        for picture in row:
            sheet.paste(Image.fromarray(picture), (left, top + line))
            left += picture.shape[1] + gap
        top += line + max(p.shape[0] for p in row) + gap
    return np.asarray(sheet)
