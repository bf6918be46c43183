"""All that the page shows and changes, without a page: the scene, its live picture, the path, the videos."""

import dataclasses
import json
import re
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .. import sampling
from ..config import RoGeConfig
from ..core.params import Tree
from ..errors import UserError
from ..geometry.cameras import Cameras, Normalisation, normalise, quaternion, rotation
from ..geometry.trajectories import focus_distance, world_up
from ..sampling import reconstruction
from ..sampling.photos import Photos
from ..sampling.video import noise_levels
from ..sampling.windows import windows
from ..scenes.paths import save_path
from ..scenes.scene import Scene
from ..video import solvers
from . import keyframes, route, runs
from .route import Route

MOST_POINTS = 100_000  # that are shown


@dataclasses.dataclass(frozen=True)
class Given:
    """What a session begins with. `weights(parts)` reads those parts of the parameter tree, all if None."""

    config: RoGeConfig
    scene: Scene
    photos: Photos
    path: Cameras  # the one that `preset` makes, or that a file has; K in pixels of config.height x config.width
    route: Route
    out: Path
    weights: Callable[[tuple[str, ...] | None], Tree]
    scale: float | None = None


class Session:
    """One scene and its path, for all who look at it. `watch(f)`: f is called with "path" or "run" when that changed."""

    def __init__(self, given: Given):
        self.given, self.route = given, given.route
        self.lock, self._reading = threading.RLock(), threading.Lock()
        self.run: runs.Run | None = None
        self._watchers: list[Callable[[str], None]] = []
        self._weights: Tree = {}
        self._programs: dict[Any, Any] = {}
        self._times: dict[bool, dict[str, float]] = {True: {}, False: {}}
        cameras, rule = given.photos.cameras, given.config.scale_rule
        self.world: Normalisation = normalise(cameras, given.path, rule=rule, scale=given.scale)[2]

    # The scene.

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) that the photos' and the path's K are for."""
        return self.given.config.height, self.given.config.width

    def weights(self, *, everything: bool = False) -> Tree:
        """The parameters of the reconstruction, or of the generator too; each read once."""
        with self._reading:
            if not self._weights:
                self._weights = self.given.weights(reconstruction.PARTS)
            if everything and set(self._weights) == set(reconstruction.PARTS):
                self._weights = self.given.weights(None)
            return self._weights

    def shown_at(self, c2w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(quaternion w x y z, position) on the page of a pose [4, 4] of the scene: the page is in the normalised frame."""
        moved = self.world.apply(Cameras(np.eye(3)[None], np.asarray(c2w)[None])).c2w[0]
        return np.roll(quaternion(moved[:3, :3]), 1), moved[:3, 3]

    def pose_of(self, wxyz: np.ndarray, position: np.ndarray) -> np.ndarray:
        """The pose [4, 4] of the scene that `shown_at` shows there."""
        c2w = np.eye(4)
        c2w[:3, :3] = rotation(np.roll(np.asarray(wxyz, np.float64), -1))
        c2w[:3, 3] = position
        return self.world.undo(Cameras(np.eye(3)[None], c2w[None])).c2w[0]

    def points(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The sparse points of a scene that carries some: (xyz [p, 3] on the page, rgb [p, 3] uint8)."""
        found = getattr(self.given.scene, "points", None)
        if found is None or not len(found.xyz):
            return None
        kept = slice(None, None, 1 + len(found.xyz) // MOST_POINTS)
        xyz = (found.xyz[kept] - self.world.origin[:3, 3]) @ self.world.origin[:3, :3]
        rgb = np.full(xyz.shape, 128, np.uint8) if found.rgb is None else found.rgb[kept]
        return xyz / self.world.divisor, rgb

    @property
    def up(self) -> np.ndarray:
        """Up in the normalised frame."""
        return self.world.origin[:3, :3].T @ world_up(self.given.photos.cameras)

    @property
    def focus(self) -> float:
        """Distance of the scene in the normalised frame."""
        return focus_distance(self.given.photos.cameras) / self.world.divisor

    # The path.

    def watch(self, watcher: Callable[[str], None]) -> None:
        self._watchers.append(watcher)

    def tell(self, what: str) -> None:
        for watcher in self._watchers:
            watcher(what)

    def change(self, edit: Callable[[Route], Route]) -> None:
        """The path after an edit, if there is such a path; else it stays as it was. Raises: UserError."""
        with self.lock:
            edited = edit(self.route)
            if edited.preset is not None or edited.keys:
                self._cameras(edited)
            self.route = edited
        self.tell("path")

    def path(self) -> Cameras:
        """The cameras of the path. Raises: UserError if there are none."""
        return self._cameras(self.route)

    def _cameras(self, of: Route) -> Cameras:
        return route.cameras(of, self.given.photos.cameras, self.size)

    def write_path(self, file: Path) -> None:
        """The path as a file that `sample --trajectory` reads, for pictures of the output's size."""
        self._writer(self.route, self.path())(file)

    def _writer(self, of: Route, path: Cameras) -> Callable[[Path], None]:
        size = self.given.config.output_size
        if of.preset is None:
            return lambda file: keyframes.write(file, of.keys, size, of.fps)
        factor = np.array([size[1] / self.size[1], size[0] / self.size[0], 1.0])
        scaled = Cameras(path.K * factor[None, :, None], path.c2w)
        return lambda file: save_path(file, scaled, *size, fps=of.fps)

    def save(self, name: str) -> Path:
        """The path in OUT/paths, under a name of letters, digits, - and _. Raises: UserError."""
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,60}", name):
            raise UserError(f"'{name}' is no name for a path: use letters, digits, - and _.")
        file = self.given.out / "paths" / f"{name}.json"
        with self.lock:
            self.path()  # a path that is none writes nothing
            file.parent.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(".part")
            self.write_path(part)
            part.replace(file)
        return file

    def saved(self) -> list[str]:
        """Names of the paths in OUT/paths."""
        return sorted(file.stem for file in (self.given.out / "paths").glob("*.json"))

    def load(self, name: str, content: bytes) -> None:
        """A path file's content as key frames. `name` says what kind of file it is. Raises: UserError."""
        ending = Path(name).suffix.lower()
        with tempfile.TemporaryDirectory() as folder:
            file = (
                Path(folder)
                / f"path{ending if re.fullmatch(r'[.][a-z0-9]{1,5}', ending) else '.json'}"
            )
            file.write_bytes(_of_cameras(content))
            context, source = self.given.photos.cameras, self.given.scene.source
            try:
                found, fps = keyframes.read(file, self.size, context, source)
            except UserError as error:
                raise UserError(str(error).replace(str(file), name)) from None
        self.change(
            lambda old: dataclasses.replace(
                old, preset=None, options={}, keys=found, fps=fps or old.fps
            )
        )

    def load_saved(self, name: str) -> None:
        """`load` of a path in OUT/paths."""
        if name not in self.saved():
            raise UserError(f"There is no path '{name}' in {self.given.out / 'paths'}.")
        file = self.given.out / "paths" / f"{name}.json"
        self.load(file.name, file.read_bytes())

    # Videos.

    def start(self, *, generated: bool, steps: int = 0, seed: int = 0) -> runs.Run:
        """Make a video of the path as it is now, in a thread. Raises: UserError if one is being made, or for the path."""
        with self.lock:
            if self.run is not None and self.run.state == "running":
                raise UserError("A video is being made: wait for it, or cancel it.")
            given = self.given
            if generated and given.config.parts == "reconstruction":
                raise UserError("This model is a reconstruction alone: make a preview.")
            settings = sampling.Settings(
                steps=steps, seed=seed, scale=given.scale, generate=generated
            ).of(given.config)
            path, of = self.path(), self.route
            count = 0
            if generated:
                grid = noise_levels(settings, given.config)
                fixed = solvers.SOLVERS[settings.solver].method is not None
                count = len(solvers.tabulate(settings.solver, grid).sigma) if fixed else 1
            order = runs.Order(path, of.fps, settings, self._writer(of, path), generated)
            known = self._times[generated]
            progress = runs.Progress(len(windows(len(path), given.config.frames)), count, known)
            self.run = runs.Run(progress, lambda p: self._make(order, p), self._ended)
            self.run.start()
            run = self.run
        self.tell("run")
        return run

    def cancel(self) -> None:
        """End the video that is being made, at its next piece."""
        if self.run is not None:
            self.run.progress.cancel()

    def videos(self) -> list[Path]:
        """Finished ones, oldest first."""
        return runs.finished(self.given.out)

    def _make(self, order: runs.Order, progress: runs.Progress) -> Path:
        given = self.given
        with progress.stage("load"):
            params = self.weights(everything=order.generated)
        scene = given.config, given.scene, given.photos
        made = runs.make(params, *scene, order, given.out, progress, cache=self._programs)
        self._times[order.generated] = progress.known
        return made

    def _ended(self, run: runs.Run) -> None:
        self.tell("run")


def _of_cameras(content: bytes) -> bytes:
    """A path file without the names of files in it: what comes through the page must not make the program open them."""

    def stripped(value: Any) -> Any:
        if isinstance(value, list):
            return [stripped(item) for item in value]
        if not isinstance(value, dict):
            return value
        kept = {k: v for k, v in value.items() if not (k.endswith("path") and isinstance(v, str))}
        return {k: stripped(v) for k, v in kept.items()}

    try:
        return json.dumps(stripped(json.loads(content))).encode()
    except (ValueError, RecursionError):  # no JSON: other kinds of paths name no files
        return content
