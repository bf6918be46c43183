"""Videos and pictures in and out. Every file is written under a temporary name and renamed when it is whole.

Frames are [n, h, w, 3], RGB, uint8 or float in [0, 1].
"""

import argparse
import errno
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import UserError, did_you_mean
from .folders import put

FPS = 16  # of Wan2.1
KINDS = (".mp4", ".webm", ".webp", ".gif")
DESCRIPTION = 0x010E  # EXIF's ImageDescription
DISK = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.EACCES,
    errno.ENOENT,
    errno.EROFS,
)
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
    path: str | Path,
    frames: np.ndarray,
    fps: float = FPS,
    *,
    quality: int = 16,
    about: str | None = None,
) -> Path:
    """Writes a video of the kind that the name of `path` says, one of KINDS; returns the file written.

    .mp4 is H.264 (yuv420p, index in front) that browsers play, .webm VP9, .webp and .gif are endless animations.
    `quality` is x264's constant rate factor, 0 lossless to 51; the others have one of their own. Where this PyAV has no
    encoder (H.264: builds without GPL parts), or none is installed, .mp4 becomes a .webm of the same name, and at last an
    animated .webp, with a warning: a missing codec never costs the frames. `about`: a remark that the file carries.
    Raises: UserError for no frames, another shape, or another ending.
    """
    path, frames = Path(path), to_uint8(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.size == 0:
        raise UserError(f"{path}: a video needs frames [n, h, w, 3], given shape {frames.shape}.")
    if not fps > 0:
        raise UserError(f"{path}: {fps} frames per second: give a number above 0.")
    reasons: list[str] = []
    for name, ending, write in _writers(path):
        target = path.with_suffix(ending)
        try:
            with _whole(target) as temporary:
                write(temporary, frames, fps, Written(quality, about))
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
        f"{path}: no video could be written ({'; '.join(reasons)}): install PyAV (pip install av), or ask for a .webp."
    )


class Written(NamedTuple):
    """How a video is written: x264's rate factor, and a remark that the file carries."""

    quality: int
    about: str | None


def video_kinds(text: str) -> tuple[str, ...]:
    """The kinds of video that an option asks for, "mp4,gif"; an argparse `type`."""
    kinds = tuple(dict.fromkeys(word.strip().lower().lstrip(".") for word in text.split(",")))
    for kind in kinds:
        if f".{kind}" not in KINDS:
            known = did_you_mean(kind, [one[1:] for one in KINDS]).rstrip(".")
            raise argparse.ArgumentTypeError(f"unknown kind of video '{kind}': {known}")
    return kinds


def usable_kinds(
    folder: Path, kinds: Sequence[str], height: int, width: int, fps: float = FPS
) -> tuple[str, ...]:
    """The kinds of video that this machine can write of pictures of this size instead of `kinds`, found out with two blank
    frames in `folder`. A missing codec is a warning, and a size that no codec takes a UserError, before anything is made."""
    blank = np.zeros((2, height, width, 3), np.uint8)
    found = []
    with tempfile.TemporaryDirectory(dir=folder, prefix=".codec") as place:
        for kind in kinds:
            try:
                found.append(write_video(Path(place) / f"video.{kind}", blank, fps).suffix[1:])
            except UserError as error:
                said = str(error).removeprefix(f"{place}{os.sep}")
                raise UserError(f"{height}x{width} at {fps:g} frames per second: {said}") from None
    return tuple(dict.fromkeys(found))


def _write_h264(file: Path, frames: np.ndarray, fps: float, how: Written) -> None:
    _write_av(file, frames, fps, "libx264", {"crf": str(how.quality), "preset": "medium"}, how)


def _write_av_vp9(file: Path, frames: np.ndarray, fps: float, how: Written) -> None:
    # Its factor is on another scale: 24 looks like x264's 16.
    crf = str(min(63, how.quality + 8)) if how.quality else "0"
    options = {"crf": crf, "b": "0", "cpu-used": "2", "row-mt": "1"}
    _write_av(file, frames, fps, "libvpx-vp9", options, how)


def _write_webp(file: Path, frames: np.ndarray, fps: float, how: Written) -> None:
    write_webp(file, frames, fps, about=how.about)


def _write_gif(file: Path, frames: np.ndarray, fps: float, how: Written) -> None:
    write_gif(file, frames, fps, about=how.about)


def _write_av(
    file: Path,
    frames: np.ndarray,
    fps: float,
    codec: str,
    options: dict[str, str],
    how: Written,
) -> None:
    """One encoder of PyAV's. Raises: what PyAV raises, an OSError or ValueError, if it lacks the codec or the codec refuses."""
    import av

    frames = even(frames)
    form, more = ("mp4", {"movflags": "+faststart"}) if file.suffix == ".mp4" else ("webm", {})
    with av.open(str(file), "w", format=form, options=more) as container:
        if how.about:
            container.metadata["comment"] = how.about
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


def _write_vp9(file: Path, frames: np.ndarray, fps: float, how: Written) -> None:
    import cv2

    frames = even(frames)
    h, w = frames.shape[1:3]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"VP90"), fps, (w, h))
    if not writer.isOpened():
        raise UserError(
            f"{file}: this OpenCV cannot write VP9 either: install PyAV (pip install av)."
        )
    for pixels in frames:
        writer.write(np.ascontiguousarray(pixels[..., ::-1]))
    writer.release()


Writer = Callable[[Path, np.ndarray, float, Written], None]


def _writers(path: Path) -> Sequence[tuple[str, str, Writer]]:
    """What is tried, in order: (name, ending, writer). Raises: UserError for an ending that is none of KINDS."""
    if path.suffix.lower() == ".gif":
        return [("GIF", path.suffix, _write_gif)]
    tried = [
        ("H.264", ".mp4", _write_h264),
        ("VP9", ".webm", _write_av_vp9),
        ("VP9", ".webm", _write_vp9),
        ("WebP", ".webp", _write_webp),
    ]
    for first, (_, ending, _) in enumerate(tried):
        if path.suffix.lower() == ending:
            return tried[first:]
    raise UserError(f"{path}: give a name that ends in {', '.join(KINDS)}.")


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
    path: str | Path,
    frames: np.ndarray,
    fps: float = FPS,
    *,
    quality: int = 80,
    about: str | None = None,
) -> Path:
    """An endless animated WebP: a seventh of a GIF's size, shown by every browser and code host."""
    from PIL import Image

    path, exif = Path(path), Image.Exif()
    if about:
        exif[DESCRIPTION] = about
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
            exif=exif,
        )
    return path


def write_gif(
    path: str | Path, frames: np.ndarray, fps: float = FPS, *, about: str | None = None
) -> Path:
    """An endless GIF: 256 colours that all frames share, no dither, which would flicker. Its clock ticks in 10 ms, and
    browsers slow down what is faster than 50 frames per second."""
    from PIL import Image

    path, frames = Path(path), to_uint8(frames)
    some = frames[np.linspace(0, len(frames) - 1, min(8, len(frames))).round().astype(int)]
    sheet = Image.fromarray(np.concatenate(some))
    palette = sheet.quantize(256, method=Image.Quantize.MEDIANCUT, kmeans=1)
    first, *rest = (
        Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE)
        for pixels in frames
    )
    with _whole(path) as temporary:
        first.save(
            temporary,
            save_all=True,
            append_images=rest,
            duration=10 * max(2, round(100 / fps)),
            loop=0,
            comment=(about or "").encode(),
        )
    return path


def write_png(path: str | Path, pixels: np.ndarray, *, about: str | None = None) -> Path:
    """One picture [h, w, 3], lossless; equal pixels (and remarks) give equal bytes."""
    from PIL import Image, PngImagePlugin

    path, remarks = Path(path), PngImagePlugin.PngInfo()
    if about:
        remarks.add_text("Comment", about)
    with _whole(path) as temporary:
        Image.fromarray(to_uint8(pixels)).save(temporary, compress_level=6, pnginfo=remarks)
    return path


def write_frames(folder: str | Path, frames: np.ndarray, *, about: str | None = None) -> list[str]:
    """0000.png, 0001.png .. in a folder that is replaced whole; returns the file names."""
    folder = Path(folder)
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    names = [
        write_png(part / f"{i:04d}.png", pixels, about=about).name
        for i, pixels in enumerate(to_uint8(frames))
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
