"""Videos that are made while one looks on: how far they are, how long they will take, and where they end up."""

import contextlib
import dataclasses
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .. import sampling
from ..config import RoGeConfig, to_dict
from ..core.params import Tree
from ..errors import UserError
from ..files import video_io
from ..files.entry import Clock
from ..files.folders import RECORD, output_folder, write_json
from ..geometry.cameras import Cameras
from ..sampling import outputs
from ..sampling.photos import Photos
from ..sampling.windows import view_distance
from ..scenes.scene import Scene, prepare

PIECES = ("prepare", "sample", "decode", "preview")  # stages whose time is counted
BESIDE = "side_by_side.mp4"  # nearest photo, preview and video
PATH = "path.json"


class Cancelled(Exception):
    """The user does not want this video any more."""


class Progress:
    """How far a video is, told by `sampling.sample` as its `stage` and its `progress`. `cancel` ends it at the next piece.

    The work is a list of pieces: of every window the preparation, its evaluations and the decoding. What a piece takes is
    known from those that are done, in this video or in an earlier one (`known`).
    """

    def __init__(
        self,
        windows: int,
        steps: int,
        known: dict[str, float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        each = ["prepare", *["sample"] * steps, "decode"] if steps else ["preview"]
        self.left = each * windows
        self.known = dict(known or {})
        self.clock, self.begun = clock, clock()
        self.doing, self.cancelled = "starting", False
        self.total, self._piece, self._before = len(self.left), clock(), 0.0

    # What `sampling.sample` calls.

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._check()
        self.doing, self._piece = name, self.clock()
        yield
        if name in PIECES and name != "sample":  # steps tell of themselves
            self._done(name)

    def reset(self, total: float | None = None) -> None:
        """The number of evaluations, which is known already."""

    def update(self, n: float = 1) -> None:
        self._done("sample")
        self._check()

    def set_description(self, desc: str) -> None:
        """In words, what `stage` says already."""

    def close(self) -> None:
        """Nothing is held."""

    # What the page asks.

    def cancel(self) -> None:
        self.cancelled = True

    @property
    def fraction(self) -> float:
        """Of the pieces, weighed by what they take as far as that is known."""
        if not self.total:
            return 1.0
        left = self.seconds_left()
        if left is None:
            return 1.0 - len(self.left) / self.total
        return min(1.0, self._before / max(self._before + left, 1e-9))

    def seconds_left(self) -> float | None:
        """Estimated; None while some kind of piece never ran. Compilation is not foreseen."""
        if any(piece not in self.known for piece in self.left):
            return None
        return sum(self.known[piece] for piece in self.left)

    def said(self) -> str:
        """One line for the page."""
        left = self.seconds_left()
        text = "compiling, once per shape" if self.doing == "compile" else self.doing
        text += f" · {self.clock() - self.begun:.0f} s"
        return text if left is None else f"{text} · about {left:.0f} s left"

    def _done(self, piece: str) -> None:
        now = self.clock()
        took, self._piece = now - self._piece, now
        self._before += took
        old = self.known.get(piece)
        self.known[piece] = took if old is None else 0.5 * (old + took)
        if piece in self.left:
            self.left.remove(piece)

    def _check(self) -> None:
        if self.cancelled:
            raise Cancelled


def next_folder(out: Path, kind: str) -> Path:
    """OUT/KIND-001 or the first free number after it."""
    used = [
        int(m[1]) for p in out.glob(f"{kind}-*") if (m := re.fullmatch(rf"{kind}-(\d+)", p.name))
    ]
    return out / f"{kind}-{max(used, default=0) + 1:03d}"


def finished(out: Path) -> list[Path]:
    """The videos in OUT, oldest first."""
    found = [p for p in out.glob("*-*") if re.fullmatch(r"(video|preview)-\d+", p.name)]
    return sorted(
        (p for p in found if (p / RECORD).is_file()), key=lambda p: p.name.split("-")[::-1]
    )


def nearest_photos(photos: Cameras, path: Cameras) -> np.ndarray:
    """Which photo lies nearest to each camera of a path: [n]."""
    reach = np.linalg.norm(photos.centres - photos.centres[:1], axis=-1).max() or 1.0

    def scaled(cameras: Cameras) -> Cameras:
        c2w = cameras.c2w.copy()
        c2w[:, :3, 3] = (c2w[:, :3, 3] - photos.centres[0]) / reach
        return Cameras(cameras.K, c2w)

    return view_distance(scaled(photos), scaled(path)).argmin(0)


def side_by_side(*videos: np.ndarray, gap: int = 4) -> np.ndarray:
    """Videos [n, h, w, 3] of one length and height beside one another, white between them."""
    line = np.full((*videos[0].shape[:2], gap, 3), 255, np.uint8)
    parts = [part for video in videos for part in (video_io.to_uint8(video), line)]
    return np.concatenate(parts[:-1], 2)


@dataclasses.dataclass(frozen=True)
class Order:
    """A video to make: along what, and how. `keys` writes the path file of key frames, if there are any."""

    path: Cameras  # K in pixels of config.height x config.width
    fps: float
    settings: sampling.Settings
    write_path: Callable[[Path], None]
    generated: bool = True


def make(
    params: Tree,
    config: RoGeConfig,
    scene: Scene,
    photos: Photos,
    order: Order,
    out: Path,
    progress: Progress,
    *,
    cache: dict[Any, Any] | None = None,
) -> Path:
    """A folder in `out` with the video as `sample` writes it, its path file, and the comparison beside it."""
    clock, kind = Clock(), "video" if order.generated else "preview"
    settings = order.settings.of(config)
    given = params, config, photos, order.path

    @contextlib.contextmanager
    def stage(name: str) -> Iterator[None]:
        with progress.stage(name), clock(name):
            yield

    place = next_folder(out, kind)
    with output_folder(place, keep=outputs.FRAMES) as folder:
        outputs.check_outputs(folder, ("mp4",), len(order.path), config.output_size, order.fps)
        used = dataclasses.asdict(settings) if order.generated else {"scale": settings.scale}
        if order.generated:
            more = {"stage": stage, "progress": progress, "cache": cache}
            result = sampling.sample(*given, settings, **more)
        else:
            result = sampling.preview(*given, scale=settings.scale, stage=stage)
        with stage("write"):
            told: dict[str, Any] = {
                "generated": order.generated,
                "about": outputs.remark(to_dict(config), used),
            }
            outputs.write_outputs(folder, result, scene, photos, order.fps, **told)
            pictures, _ = prepare(scene, photos.ids, *config.output_size, drop_duplicates=False)
            shown = [pictures[nearest_photos(photos.cameras, order.path)], result.preview]
            shown += [result.frames] if order.generated else []
            size = result.frames.shape[1:3]
            shown = [video for video in shown if video.shape[1:3] == size]
            video_io.write_video(folder / BESIDE, side_by_side(*shown), order.fps)
            order.write_path(folder / PATH)
        asked = {"fps": order.fps, "frames": len(order.path)}
        said = outputs.record(
            "roge_jax.view", asked, config, used, scene, photos, result, clock,
            generated=order.generated,
        )  # fmt: skip
        write_json(folder / RECORD, said)
    return place


class Run:
    """One `make` in a thread. `state` is "running", then "done", "cancelled" or "failed", with a sentence in `text`."""

    def __init__(
        self, progress: Progress, work: Callable[[Progress], Path], ended: Callable[["Run"], None]
    ):
        self.progress, self.state, self.text = progress, "running", ""
        self.folder: Path | None = None
        self._work, self._ended = work, ended
        self.thread = threading.Thread(target=self._go, daemon=True)

    def start(self) -> None:
        self.thread.start()

    def _go(self) -> None:
        try:
            self.folder = self._work(self.progress)
            self.state, self.text = "done", f"wrote {self.folder}"
        except Cancelled:
            self.state, self.text = "cancelled", "cancelled; nothing was written"
        except UserError as error:
            self.state, self.text = "failed", str(error)
        except Exception as error:  # shown on the page; the program goes on
            self.state, self.text = "failed", f"{type(error).__name__}: {error}"
        self._ended(self)


def about(folder: Path) -> str:
    """One line on a finished video, from its record."""
    said = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    kind = "generated" if said["generated"] else "preview alone"
    seconds = said["stages"]["total"]["seconds"]
    height, width = said["size"]
    return f"{said['frames']} frames of {height}x{width}, {kind}, {seconds:.0f} s"
