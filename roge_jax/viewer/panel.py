"""The controls beside the picture: view, path, videos. Every control calls one function of the session or the page."""

import base64
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import UserError
from ..geometry.trajectories import PRESETS
from . import keyframes, route, runs

if TYPE_CHECKING:
    from .page import Page

OWN = "key frames"
REFRESH = 0.5  # seconds between two looks at a run


class Panel:
    """The controls, and how they follow what they control."""

    def __init__(self, page: "Page"):
        self.page, self.session, self.gui = page, page.session, page.server.gui
        self.options: dict[str, Any] = {}
        self._view()
        self._path()
        self._videos()

    # Controls.

    def _view(self) -> None:
        with self.gui.add_folder("View"):
            names = [self.session.given.scene.names[i] for i in self.session.given.photos.ids]
            photo = self.gui.add_dropdown("Stand at photo", ["-", *names], initial_value="-")
            fov = round(self.page._fov(0), 1)
            self.fov = self.gui.add_slider("Field of view", 5.0, 120.0, 0.5, fov)
            frusta = self.gui.add_checkbox("Cameras", True)

        @self.on(photo)
        def _(event):
            if photo.value != "-":
                self.page.stand_at_photo(event.client, names.index(photo.value))
                photo.value = "-"

        @self.on(self.fov)
        def _(event):
            event.client.camera.fov = float(np.radians(self.fov.value))
            self.page._looks(event.client)

        @self.on(frusta)
        def _(event):
            self.page.show_cameras(event.client, frusta.value)

    def _path(self) -> None:
        gui, start = self.gui, self.session.route
        with gui.add_folder("Path") as self.folder:
            self.kind = gui.add_dropdown(
                "Along", [OWN, *PRESETS], initial_value=start.preset or OWN
            )
            self.told = gui.add_markdown("")
            self.frames = gui.add_number("Frames", start.frames, min=1, step=1)
            self.fps = gui.add_number("Frames per second", float(start.fps), min=0.1, step=0.1)
            to_keys = gui.add_button("Turn into key frames")
            add = gui.add_button("Add key frame here")
            self.key = gui.add_dropdown("Key frame", ["-"], initial_value="-")
            self.wait = gui.add_number("Seconds to it", 1.0, min=keyframes.LEAST, step=0.01)
            self.angle = gui.add_number("Its field of view", 40.0, min=1.0, max=179.0, step=0.1)
            self.own = gui.add_button_group("It", ["go there", "move here", "delete"])
            fly = gui.add_button("Fly along")
            name = gui.add_text("Name", "path")
            self.store = gui.add_button_group("Path file", ["save", "open saved", "download"])
            upload = gui.add_upload_button(
                "Open a path file", mime_type=".json,.txt,.npz,.npy,.tum"
            )

        @self.on(self.kind)
        def _(event):
            chosen = None if self.kind.value == OWN else self.kind.value
            self.session.change(lambda old: route.choose(old, chosen))

        @self.on(self.frames)
        def _(event):
            self.session.change(lambda old: dataclasses.replace(old, frames=int(self.frames.value)))

        @self.on(self.fps)
        def _(event):
            self.session.change(lambda old: dataclasses.replace(old, fps=float(self.fps.value)))

        @self.on(to_keys)
        def _(event):
            context, size = self.session.given.photos.cameras, self.session.size
            self.session.change(lambda old: route.as_keys(old, context, size))

        @self.on(add)
        def _(event):
            view, after = self.page.view(event.client), self.page.chosen

            def edit(old):
                keys = keyframes.added(old.keys, view.c2w, view.fov, after)
                return dataclasses.replace(old, preset=None, options={}, keys=keys)

            self.session.change(edit)
            self.page.choose(len(self.session.route.keys) - 1 if after is None else after + 1)

        @self.on(self.key)
        def _(event):
            self.page.choose(None if self.key.value == "-" else int(self.key.value) - 1)

        @self.on(self.wait)
        def _(event):
            self._of_key(lambda keys, i: keyframes.changed(keys, i, seconds=float(self.wait.value)))

        @self.on(self.angle)
        def _(event):
            self._of_key(lambda keys, i: keyframes.changed(keys, i, fov=float(self.angle.value)))

        @self.on(self.own)
        def _(event):
            word, number = self.own.value, self.page.chosen
            if number is None:
                raise UserError("Choose a key frame first: click on it, or on its number.")
            if word == "delete":
                self._of_key(keyframes.removed)
            elif word == "move here":
                view = self.page.view(event.client)
                self._of_key(lambda keys, i: keyframes.changed(keys, i, c2w=view.c2w))
            else:
                key = self.session.route.keys[number]
                self.page.stand(event.client, key.c2w, key.fov)

        @self.on(fly)
        def _(event):
            self.page.fly(event.client)

        @self.on(self.store)
        def _(event):
            if self.store.value == "open saved":
                self.session.load_saved(name.value)
                return
            file = self.session.save(name.value)
            if self.store.value == "download":
                event.client.send_file_download(file.name, file.read_bytes(), save_immediately=True)
            else:
                self.page.tell(event.client, f"sample --trajectory {file}", "Saved")

        @self.on(upload)
        def _(event):
            self.session.load(upload.value.name, upload.value.content)

    def _videos(self) -> None:
        gui, config = self.gui, self.session.given.config
        with gui.add_folder("Video"):
            self.steps = gui.add_number("Steps", config.flow.steps, min=1, step=1)
            self.seed = gui.add_number("Seed", 0, min=0, step=1)
            make = gui.add_button_group("Make", ["preview", "generate", "cancel"])
            self.bar = gui.add_progress_bar(0.0, visible=False)
            self.said = gui.add_markdown("")
            self.video = gui.add_dropdown("Finished", ["-"], initial_value="-")
            what = gui.add_button_group("It", ["play", "download"])
            self.about = gui.add_markdown("")

        @self.on(make)
        def _(event):
            if make.value == "cancel":
                self.session.cancel()
                return
            steps, seed = int(self.steps.value), int(self.seed.value)
            generated = make.value == "generate"
            run = self.session.start(generated=generated, steps=steps, seed=seed)
            self._follow(run)

        @self.on(what)
        def _(event):
            folder = self._folder()
            if what.value == "play":
                self._play(event.client, folder)
            else:
                content = (folder / "video.mp4").read_bytes()
                event.client.send_file_download(
                    f"{folder.name}.mp4", content, save_immediately=True
                )

        @self.on(self.video)
        def _(event):
            self.refresh("run")

    # What controls have in common.

    def on(self, control: Any) -> Callable[[Callable[[Any], None]], None]:
        """Call a function when somebody uses a control; a mistake is told to them in one sentence."""

        def register(act: Callable[[Any], None]) -> None:
            def guarded(event: Any) -> None:
                if event.client is None:  # the program itself set the value
                    return
                try:
                    act(event)
                except UserError as error:
                    self.page.tell(event.client, str(error), "That does not work")
                    self.refresh("path")

            names = ("on_click", "on_upload", "on_update")
            next(getattr(control, name) for name in names if hasattr(control, name))(guarded)

        return register

    def _of_key(self, change: Callable[[keyframes.Keys, int], keyframes.Keys]) -> None:
        number = self.page.chosen
        if number is not None:
            self.page.edit(lambda keys: change(keys, number))

    def _folder(self) -> Any:
        folders = {folder.name: folder for folder in self.session.videos()}
        if self.video.value not in folders:
            raise UserError("There is no finished video: make one first.")
        return folders[self.video.value]

    # Following.

    def refresh(self, what: str) -> None:
        """Show what is the case now."""
        if what == "path":
            self._refresh_path()
        else:
            self._refresh_videos()

    def _refresh_path(self) -> None:
        now, chosen = self.session.route, self.page.chosen
        self.kind.value = now.preset or OWN
        self.frames.value, self.fps.value = now.frames, float(now.fps)
        self.frames.visible = now.preset is not None
        frames, seconds = route.length(now)
        if frames:
            self.told.content = f"{frames} frames, {seconds:.2f} s"
        else:
            self.told.content = "no key frames yet: go somewhere and add one"
        self.key.options = ["-", *(str(i + 1) for i in range(len(now.keys)))]
        self.key.value = "-" if chosen is None else str(chosen + 1)
        for control in (self.key, self.wait, self.angle, self.own):
            control.visible = now.preset is None and bool(now.keys)
        if now.preset is None and chosen is not None:
            self.wait.value = float(now.keys[chosen].seconds)
            self.angle.value = float(now.keys[chosen].fov)
        self._refresh_options(now)

    def _refresh_options(self, now: route.Route) -> None:
        """A control for every option of the preset; those of another one go."""
        shown = {
            name: now.options.get(name, value)
            for name, value in route.options_of(now.preset).items()
        }
        if list(shown) != list(self.options):
            for control in self.options.values():
                control.remove()
            with self.folder:
                self.options = {
                    name: self._option(name, value, self.kind.order + 1e-3 * (i + 1))
                    for i, (name, value) in enumerate(shown.items())
                }
            return
        for name, value in shown.items():
            self.options[name].value = _word(value) if _choices(name, value) else value

    def _option(self, name: str, value: Any, order: float) -> Any:
        if choices := _choices(name, value):
            control = self.gui.add_dropdown(name, choices, initial_value=_word(value), order=order)
        elif isinstance(value, bool):
            control = self.gui.add_checkbox(name, value, order=order)
        else:
            control = self.gui.add_number(name, float(value), step=0.01, order=order)

        @self.on(control)
        def _(event):
            given = {"auto": None, "yes": True, "no": False}.get(control.value, control.value)
            if isinstance(control.value, bool):
                given = control.value
            self.session.change(
                lambda old: dataclasses.replace(old, options={**old.options, name: given})
            )

        return control

    def _refresh_videos(self) -> None:
        run, names = self.session.run, [folder.name for folder in self.session.videos()]
        self.video.options = names[::-1] or ["-"]
        if run is not None and run.folder is not None and run.state == "done":
            self.said.content = f"done: {run.folder.name}"
        elif run is not None:
            self.said.content = run.text
        if self.video.value in names:
            self.about.content = runs.about(self._folder())

    def _follow(self, run: runs.Run) -> None:
        """Show how far a run is until it ends; called from a thread of its own."""
        self.bar.visible = True
        while run.thread.is_alive():
            self.bar.value = 100 * run.progress.fraction
            self.said.content = run.progress.said()
            run.thread.join(REFRESH)
        self.bar.visible = False
        self._refresh_videos()
        if run.folder is not None and run.state == "done":
            self.video.value = run.folder.name
            self.about.content = runs.about(run.folder)

    def _play(self, client: Any, folder: Any) -> None:
        """The comparison in a window of its own, which the browser plays."""
        content = base64.b64encode((folder / runs.BESIDE).read_bytes()).decode()
        names = ["nearest photo", "preview", "video"][
            : 3 if (folder / "preview.mp4").exists() else 2
        ]
        heads = "".join(f"<span style='flex:1;text-align:center'>{name}</span>" for name in names)
        with client.gui.add_modal(folder.name) as modal:
            client.gui.add_html(
                f"<div style='display:flex'>{heads}</div><video controls autoplay loop muted style='width:100%' "
                f"src='data:video/mp4;base64,{content}'></video>"
            )
            client.gui.add_button("Close").on_click(lambda _: modal.close())


def _choices(name: str, value: Any) -> list[str]:
    """The words that an option can be, if it is no number and no yes or no."""
    if value is None or name == "swing":
        return ["auto", "yes", "no"]
    return ["given", "shortest"] if isinstance(value, str) else []


def _word(value: Any) -> str:
    return {None: "auto", True: "yes", False: "no"}.get(value, value)
