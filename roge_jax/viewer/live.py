"""The live picture: a scene encoded once, a program for each level of detail, and the thread that serves viewers."""

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from ..config import RoGeConfig
from ..core.params import Tree
from ..files.video_io import to_uint8
from ..geometry.cameras import Cameras
from ..sampling import reconstruction
from ..sampling.photos import read_photos
from ..sampling.windows import view_distance
from ..scenes import coverage
from ..scenes.scene import Scene
from .desk import Desk
from .levels import Level, Pace, levels, recon_size

PATIENCE = 5.0  # seconds that an ended thread is waited for
REST = 0.05  # seconds between two looks for something to do


class View(NamedTuple):
    """A viewer's camera: pose c2w [4, 4] in the scene's frame, vertical field of view in degrees, width over height."""

    c2w: np.ndarray
    fov: float
    aspect: float

    def cameras(self, height: int, width: int) -> Cameras:
        """As one camera of height x width pictures, whose pixels are as wide as the window makes them."""
        tangent = np.tan(np.radians(self.fov) / 2)
        fx, fy = 0.5 * width / (tangent * self.aspect), 0.5 * height / tangent
        K = np.array([[fx, 0.0, width / 2], [0.0, fy, height / 2], [0.0, 0.0, 1.0]])
        return Cameras(K[None], np.asarray(self.c2w, np.float64)[None])


class Live:
    """The reconstruction's picture of a scene at several levels of detail. `build` a level before its `picture`."""

    def __init__(
        self,
        params: Tree,
        config: RoGeConfig,
        scene: Scene,
        ids: tuple[int, ...],
        near: Cameras,
        scale: float | None = None,
    ):
        self.params, self.config, self.scene, self.ids = params, config, scene, ids
        self.near, self.scale = near, scale
        self.photos = read_photos(scene, ids, config)
        self.levels: tuple[Level, ...] = levels(config, [scene.sizes[i] for i in self.photos.ids])
        self.pace = Pace((None,) * len(self.levels))
        self.ready = [False] * len(self.levels)
        self._known: dict[tuple[int, int], tuple] = {}
        self._run: dict[int, Callable] = {}

    def build(self, level: int) -> None:
        """Encode the scene for a level, where no other has, and compile its program."""
        config, params = self.levels[level].config, self.params
        key = recon_size(config)
        if key in self._known:
            known, _ = self._known[key]
            self._run[level] = reconstruction.compiled(params, known, 1, config, self._few(level))
        else:
            self._build_both(level, key)
        self.ready[level] = True

    def _build_both(self, level: int, key: tuple[int, int]) -> None:
        """Encode the scene and compile the level's program."""
        config, params = self.levels[level].config, self.params
        whole = key == recon_size(self.config)
        photos = self.photos if whole else read_photos(self.scene, self.ids, config)
        views, info = reconstruction.of_photos(config, photos, self.near, scale=self.scale)
        encoding, self._run[level] = reconstruction.both(params, views, 1, config, self._few(level))
        self._known[key] = jax.block_until_ready(encoding(params, views)), info

    def picture(self, level: int, view: View) -> np.ndarray:
        """What a viewer sees, uint8 [h, w, 3]; the time it took is kept in `pace`."""
        begun = time.perf_counter()
        config, few = self.levels[level].config, self._few(level)
        known, info = self._known[recon_size(config)]
        camera = info.apply(view.cameras(config.height, config.width))
        K, c2w = (np.asarray(x, np.float32) for x in (camera.K, camera.c2w))
        given = [self.params, known, K, c2w]
        if few is not None:
            gaps = view_distance(info.apply(self.photos.cameras), camera)[:, 0]
            given.append(np.sort(np.argsort(gaps, kind="stable")[:few]).astype(np.int32))
        made = to_uint8(np.asarray(self._run[level](*given))[0])
        self.pace = self.pace.after(level, time.perf_counter() - begun)
        return made

    def seen(self, view: View) -> float:
        """How well the photos see what a viewer looks at, 0 to 1 (`scenes.coverage`)."""
        size = self.config.height, self.config.width
        return float(coverage.by_frame(self.photos.cameras, view.cameras(*size), *size)[0])

    def _few(self, level: int) -> int | None:
        count = self.levels[level].photos
        return count if count < len(self.photos.ids) else None


class Shown(NamedTuple):
    """A picture for a viewer, and what is to be said about it."""

    picture: np.ndarray
    view: View
    seconds: float
    rate: float  # pictures a second, lately
    moving: bool  # at the level that is for moving
    finest: bool  # no finer one will come
    seen: float


class Worker:
    """A thread that makes pictures for viewers one after another, and one that compiles finer levels beside it.

    `show(who, Shown)` and `fail(sentence)` are called from these threads.
    """

    def __init__(self, live: Live, show: Callable[[Any, Shown], None], fail: Callable[[str], None]):
        self.live, self.show, self.fail = live, show, fail
        self.desk, self.changed, self.stopped = Desk(), threading.Condition(), False
        self.building: int | None = None
        self.threads: list[threading.Thread] = []

    def start(self) -> None:
        """Build the coarsest level, then serve."""
        self._begin(self._serve)

    def ask(self, who: Any, view: View) -> None:
        """A viewer looks from here now."""
        with self.changed:
            self.desk.ask(who, view, time.monotonic())
            self.changed.notify()

    def leave(self, who: Any) -> None:
        """A viewer is gone."""
        with self.changed:
            self.desk.leave(who)

    def stop(self) -> None:
        """End the threads; a picture that is under way is finished first, a compilation is not waited for."""
        with self.changed:
            self.stopped = True
            self.changed.notify_all()
        for thread in self.threads:
            thread.join(PATIENCE)

    def _begin(self, target: Callable[..., None], *args: Any) -> None:
        thread = threading.Thread(target=target, args=args, daemon=True)
        self.threads.append(thread)
        thread.start()

    def _serve(self) -> None:
        try:
            self.live.build(0)
            while not self.stopped:
                self._serve_one()
        except Exception as error:  # a thread that dies in silence looks like a slow machine
            self.fail(f"No live picture: {type(error).__name__}: {error}")

    def _serve_one(self) -> None:
        live = self.live
        with self.changed:
            now, moving = time.monotonic(), live.pace.moving(live.ready)
            task = self.desk.next(moving, live.ready, now)
            wanted = self.desk.wanted(moving, live.ready, now)
            if wanted is not None and self.building is None:
                self.building = wanted
                self._begin(self._build, wanted)
            if task is None:
                self.changed.wait(REST)
                return
        begun = time.perf_counter()
        picture = live.picture(task.level, task.camera)
        seconds, seen = time.perf_counter() - begun, live.seen(task.camera)
        with self.changed:
            now = time.monotonic()
            there = self.desk.made(task, now)
            rate = self.desk.rate(task.who, now)
        if there:
            finest = task.level == len(live.levels) - 1
            made = Shown(picture, task.camera, seconds, rate, task.level == moving, finest, seen)
            self.show(task.who, made)

    def _build(self, level: int) -> None:
        """A level that cannot be built stays missing, and is not tried again: `building` is kept."""
        try:
            self.live.build(level)
            self.building = None
        except Exception as error:
            self.fail(f"Pictures stay coarse: {type(error).__name__}: {error}")
