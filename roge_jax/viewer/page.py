"""The page in the browser: photos, path and live picture, as viser shows them. What they mean is said elsewhere.

The page is in the normalised frame of the model, so that sizes suit any scene. Everything on it is shared by all who look
at it, but for where each of them stands.
"""

import dataclasses
import sys
import threading
import time
from typing import Any

import numpy as np

from ..errors import UserError
from ..geometry.crops import resize
from ..scenes.scene import prepare
from . import keyframes, route
from .live import Live, Shown, View, Worker
from .panel import Panel
from .session import Session

PHOTO, KEY, CHOSEN, LINE = (40, 90, 200), (200, 90, 30), (240, 40, 40), (240, 150, 40)
FRUSTUM = 0.12  # length of a frustum, in the distance of the scene
THUMBNAIL = 96  # pixels, height
QUALITY = 85  # of the live picture's JPEG


@dataclasses.dataclass
class _Viewer:
    """One who looks: what is on that page alone."""

    client: Any
    status: Any
    photos: list[Any]
    cameras: bool = True  # photos are shown


class Page:
    """A server and what it shows. `stop` ends it."""

    def __init__(self, session: Session, host: str, port: int):
        import viser

        self.session, self.lock = session, threading.RLock()
        self.viewers: dict[int, _Viewer] = {}
        self.chosen: int | None = None  # key frame
        self.flying: set[int] = set()
        self.server = viser.ViserServer(host, port, label="roge_jax", verbose=False)
        self.address = f"http://{host}:{self.server.get_port()}"
        self.server.gui.configure_theme(
            control_width="large", show_logo=False, show_share_button=False
        )
        self.server.gui.main_panel.dock_right()
        self._place_cameras()
        self.worker: Worker | None = None
        self.panel = Panel(self)
        session.watch(self._changed)
        self._changed("path")
        self.server.on_client_connect(self._came)
        self.server.on_client_disconnect(self._went)
        threading.Thread(target=self._begin, daemon=True).start()

    def stop(self) -> None:
        """End the threads and the server."""
        self.session.cancel()
        if self.worker is not None:
            self.worker.stop()
        self.server.stop()

    # The scene.

    def _place_cameras(self) -> None:
        session, server = self.session, self.server
        given, cameras = session.given, session.given.photos.cameras
        server.scene.set_up_direction(session.up)
        height, width = session.size
        pictures, _ = prepare(given.scene, given.photos.ids, height, width, drop_duplicates=False)
        small = (resize(p, THUMBNAIL, round(THUMBNAIL * width / height)) for p in pictures)
        self.thumbnails = [np.asarray(255 * picture, np.uint8) for picture in small]
        _, position = session.shown_at(cameras.c2w[0])
        first = server.initial_camera
        first.position = position
        first.look_at = position + session.focus * self._axis(cameras.c2w[0])
        first.up, first.fov = session.up, float(np.radians(self._fov(0)))
        first.near = 0.001

    def _axis(self, c2w: np.ndarray) -> np.ndarray:
        """Where a pose of the scene looks, on the page."""
        return self.session.world.origin[:3, :3].T @ c2w[:3, 2]

    def _fov(self, photo: int) -> float:
        K = self.session.given.photos.cameras.K[photo]
        return float(2 * np.degrees(np.arctan(0.5 * self.session.size[0] / K[1, 1])))

    def _frustum(
        self, scene: Any, name: str, c2w: np.ndarray, fov: float, color: tuple[int, int, int]
    ) -> Any:
        height, width = self.session.size
        wxyz, position = self.session.shown_at(c2w)
        return scene.add_camera_frustum(
            name,
            float(np.radians(fov)),
            width / height,
            scale=FRUSTUM * self.session.focus,
            thickness=1.5,
            thickness_units="screen",
            color=color,
            wxyz=wxyz,
            position=position,
        )

    def show_cameras(self, client: Any, visible: bool) -> None:
        """The photos on or off, for one of those who look."""
        viewer = self.viewers[client.client_id]
        viewer.cameras = visible
        self._clear_sight(viewer)

    def _clear_sight(self, viewer: "_Viewer") -> None:
        """Photos that one stands at are not shown: they would hide what is behind them."""
        position, near = viewer.client.camera.position, 2.0 * FRUSTUM * self.session.focus
        for photo in viewer.photos:
            visible = viewer.cameras and np.linalg.norm(photo.position - position) > near
            if photo.visible != visible:
                photo.visible = visible

    # The path.

    def _changed(self, what: str) -> None:
        if what == "path":
            self._draw_path()
        self.panel.refresh(what)

    def _draw_path(self) -> None:
        scene, session = self.server.scene, self.session
        with self.lock, self.server.atomic():
            keys = session.route.keys if session.route.preset is None else ()
            if self.chosen is not None and self.chosen >= len(keys):
                self.chosen = len(keys) - 1 if keys else None
            try:
                segments = route.line(session.world.apply(session.path()))
            except UserError:
                segments = np.zeros((0, 2, 3))
            scene.remove_by_name("/path")
            if len(segments):
                style = {"thickness": 3.0, "thickness_units": "screen"}
                scene.add_line_segments("/path/line", segments.astype(np.float32), LINE, **style)
            for i, key in enumerate(keys):
                color = CHOSEN if i == self.chosen else KEY
                handle = self._frustum(scene, f"/path/{i}", key.c2w, key.fov, color)
                handle.on_click(lambda event, i=i: self.choose(i))
            self._draw_handle(keys)

    def _draw_handle(self, keys: keyframes.Keys) -> None:
        """What the chosen key frame is dragged by. It is kept while it is dragged, and moved only by others."""
        scene = self.server.scene
        held = scene.get_handle_by_name("/handle")
        if self.chosen is None:
            if held is not None:
                held.remove()
            return
        wxyz, position = self.session.shown_at(keys[self.chosen].c2w)
        if held is not None:
            if np.abs(held.position - position).max() > 1e-6 or abs(held.wxyz @ wxyz) < 1 - 1e-9:
                held.wxyz, held.position = wxyz, position
            return
        scale = 1.5 * FRUSTUM * self.session.focus
        handle = scene.add_transform_controls(
            "/handle", scale=scale, wxyz=wxyz, position=position, depth_test=False, opacity=0.7
        )
        handle.on_update(lambda event: self._dragged(event.target))

    def _dragged(self, handle: Any) -> None:
        with self.lock:
            if self.chosen is None:
                return
            pose, number = self.session.pose_of(handle.wxyz, handle.position), self.chosen
            self.edit(lambda keys: keyframes.changed(keys, number, c2w=pose))

    def choose(self, number: int | None) -> None:
        """A key frame to work on."""
        with self.lock:
            self.chosen = number
            self._changed("path")

    def edit(self, change: Any) -> None:
        """The key frames after a change (a function of them)."""
        self.session.change(lambda old: dataclasses.replace(old, keys=change(old.keys)))

    # Those who look.

    def _begin(self) -> None:
        """Weights, then the live picture; the page is there before."""
        try:
            given = self.session.given
            live = Live(
                self.session.weights(),
                given.config,
                given.scene,
                given.photos.ids,
                given.path,
                given.scale,
            )
        except Exception as error:  # in a thread: told on the page and the terminal
            return self.say(f"No live picture: {type(error).__name__}: {error}")
        worker = Worker(live, self._show, self.say)
        self.worker = worker
        for client in self.server.get_clients().values():
            worker.ask(client.client_id, self.view(client))
        worker.start()

    def _came(self, client: Any) -> None:
        status = client.gui.add_markdown("*the first picture is being made ...*", order=-1.0)
        photos = []
        for i, picture in enumerate(self.thumbnails):
            c2w = self.session.given.photos.cameras.c2w[i]
            photo = self._frustum(client.scene, f"/photos/{i}", c2w, self._fov(i), PHOTO)
            photo.image = picture
            photo.on_click(lambda event, i=i: self.stand_at_photo(client, i))
            photos.append(photo)
        self.viewers[client.client_id] = _Viewer(client, status, photos)
        client.camera.on_update(lambda camera: self._looks(client))
        self._looks(client)

    def _looks(self, client: Any) -> None:
        viewer = self.viewers.get(client.client_id)
        if viewer is not None:
            self._clear_sight(viewer)
        if self.worker is not None:
            self.worker.ask(client.client_id, self.view(client))

    def _went(self, client: Any) -> None:
        self.viewers.pop(client.client_id, None)
        self.flying.discard(client.client_id)
        if self.worker is not None:
            self.worker.leave(client.client_id)

    def view(self, client: Any) -> View:
        """Where somebody stands."""
        camera = client.camera
        pose = self.session.pose_of(camera.wxyz, camera.position)
        return View(pose, float(np.degrees(camera.fov)), max(camera.aspect, 1e-3))

    def _show(self, who: int, shown: Shown) -> None:
        viewer = self.viewers.get(who)
        if viewer is None:
            return
        viewer.client.scene.set_background_image(shown.picture, format="jpeg", jpeg_quality=QUALITY)
        height, width = shown.picture.shape[:2]
        rate = f"**{shown.rate:.1f}** pictures/s · " if shown.rate >= 1 else ""
        viewer.status.content = (
            f"{rate}{height}x{width} · {1000 * shown.seconds:.0f} ms · "
            f"photos cover **{100 * shown.seen:.0f} %** of this view"
        )

    def say(self, sentence: str) -> None:
        """Something that everybody should know."""
        print(f"warning: {sentence}", file=sys.stderr)
        for client in self.server.get_clients().values():
            self.tell(client, sentence)

    def tell(self, client: Any, sentence: str, title: str = "") -> None:
        """Something for one of them."""
        if client is not None:
            client.add_notification(title or "roge_jax", sentence, auto_close_seconds=8.0)

    def stand(self, client: Any, c2w: np.ndarray, fov: float) -> None:
        """Put somebody at a pose of the scene."""
        _, position = self.session.shown_at(c2w)
        with client.atomic():
            client.camera.position = position
            client.camera.up_direction = self.session.world.origin[:3, :3].T @ -c2w[:3, 1]
            client.camera.look_at = position + self.session.focus * self._axis(c2w)
            client.camera.fov = float(np.radians(fov))

    def stand_at_photo(self, client: Any, photo: int) -> None:
        """Put somebody where a photo was taken."""
        self.stand(client, self.session.given.photos.cameras.c2w[photo], self._fov(photo))

    def fly(self, client: Any) -> None:
        """Move somebody along the path in its own time; once more while on the way ends it."""
        if client.client_id in self.flying:
            self.flying.discard(client.client_id)
            return
        path, fps = self.session.path(), self.session.route.fps
        angles = 2 * np.degrees(np.arctan(0.5 * self.session.size[0] / path.K[:, 1, 1]))
        self.flying.add(client.client_id)
        begun = time.monotonic()
        while client.client_id in self.flying:
            frame = int((time.monotonic() - begun) * fps)
            at = min(frame, len(path) - 1)
            self.stand(client, path.c2w[at], float(angles[at]))
            if frame >= len(path) - 1:
                break
            time.sleep(max(0.02, 1 / fps))
        self.flying.discard(client.client_id)
