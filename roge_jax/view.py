"""Look at a scene in the browser before paying for a video: `python -m roge_jax.view SCENE` (extra `viewer`).

    python -m roge_jax.view                                        the built-in scene, at http://127.0.0.1:8080
    python -m roge_jax.view DIR --context 4 --out outputs/mine
    python -m roge_jax.view DIR --trajectory path.json             begin with a path

The page shows photos and cameras, the reconstruction's own picture from wherever you stand, and the path; it makes key
frames and videos. Paths and videos go to OUT; nothing else is written. docs/howto/viewer.md explains the page.
"""

import argparse
import socket
from pathlib import Path
from typing import Any

from .errors import UserError
from .files.entry import number, one_of, run
from .sampling.inputs import SCENE

EXTRA = "pip install 'roge_jax[viewer]'"
OLDEST = (1, 1)  # of viser
LOCAL = "127.0.0.1"


def parser() -> argparse.ArgumentParser:
    """The options of `python -m roge_jax.view`."""
    from .geometry.cameras import CONVENTIONS

    p = argparse.ArgumentParser(
        prog="python -m roge_jax.view",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )

    def option(name: str, help: str, default: Any = None, **more: Any) -> None:
        shown = "" if default is None else f" (default: {default})"
        p.add_argument(name, default=default, help=help + shown, **more)

    scene_help = "scene folder, motorcycle (two real photos) or procedural:SEED"
    p.add_argument("scene", nargs="?", default=SCENE, help=f"{scene_help} (default: {SCENE})")
    option("--checkpoint", "model folder, or the name of a shipped one", "mini")
    option("--out", "folder for paths and videos", Path("outputs/view"), type=Path)
    option("--host", "address to listen at; 0.0.0.0 lets other machines in", LOCAL)
    option("--port", "the first port to try", 8080, type=number(0, 65535))
    same = "as of python -m roge_jax.sample"
    option("--context", f"how many photos, or which, {same}", metavar="M|IDS")
    option("--convention", f"axes of the poses, {same}", type=one_of(CONVENTIONS))
    option("--trajectory", f"the path to begin with, {same}", metavar="NAME|FILE")
    option("--path-frame", f"coordinates of a path file, {same}", metavar="WHERE")
    option("--frames", "length of ready-made paths; the model's chunk", type=number(1))
    option(
        "--fps",
        "frames per second; the path file's own, else 16",
        type=number(1e-3, 1000, whole=False),
    )
    option("--size", "HEIGHTxWIDTH of the videos; the model's own if not given")
    scale_help = "divisor of all positions, in units of the scene; the model's rule if not given"
    option("--scale", scale_help, type=number(1e-30, whole=False))
    option(
        "--dtype",
        "of large matrices: auto, float32, bfloat16",
        "auto",
        type=one_of(("auto", "float32", "bfloat16")),
    )
    p.add_argument("--debug", action="store_true", help="show where an error comes from")
    return p


def main(args: argparse.Namespace) -> None:
    """Serve the page until interrupted."""
    import time

    import_viser()
    check_address(args.host, args.port)
    check_out(args.out)
    from .viewer.page import Page
    from .viewer.session import Session

    session = Session(read(args))
    page = Page(session, args.host, args.port)
    print(
        f"{len(session.given.photos.ids)} photos of {session.given.scene.source}; look at {page.address}",
        flush=True,
    )
    try:
        while True:
            time.sleep(3600)
    finally:
        page.stop()


def import_viser():
    """The module. Raises: UserError if it is missing or too old."""
    try:
        import viser
    except ImportError as error:
        raise UserError(f"The viewer needs viser ({error}): {EXTRA}.") from None
    version = tuple(int(word) for word in viser.__version__.split(".")[:2])
    if version < OLDEST:
        raise UserError(
            f"The viewer needs viser {'.'.join(map(str, OLDEST))} or newer, here is {viser.__version__}: {EXTRA}."
        )
    return viser


def check_address(host: str, port: int) -> None:
    """Raise UserError for an address that this machine cannot listen at. A port in use is no mistake: the next is tried."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind((host, 0))
    except (OSError, UnicodeError) as error:
        raise UserError(
            f"--host {host}: this machine cannot listen there ({error}): give one of its own addresses, e.g. {LOCAL}."
        ) from None


def check_out(out: Path) -> None:
    """Raise UserError unless OUT is a folder that can be written, or can be made."""
    import os

    try:
        out.mkdir(parents=True, exist_ok=True)
        fine = os.access(out, os.W_OK)
    except OSError:
        fine = False
    if not fine:
        raise UserError(f"--out {out} cannot be written: give another folder.")


def read(args: argparse.Namespace):
    """`viewer.session.Given` of the options: scene, photos and path, and how to get the weights."""
    from . import sampling
    from .geometry.trajectories import parse_options
    from .sampling.inputs import is_path_file, load_weights, model_config, read_inputs
    from .viewer import keyframes, route
    from .viewer.session import Given

    args.start, args.fov = 0, None  # of `sample`; the page has them
    config = model_config(args, weights=True)
    settings = sampling.Settings(scale=args.scale).of(config)
    scene, photos, path = read_inputs(args, config, settings)
    if is_path_file(args.trajectory):
        size, file = (config.height, config.width), Path(args.trajectory)
        whose = {"convention": args.convention, "frame": args.path_frame}
        keys, _ = keyframes.read(file, size, photos.cameras, scene.source, **whose)
        begin = route.Route(None, {}, len(path), keys, args.fps)
    else:
        name, _, words = args.trajectory.partition(":")
        options = route.options_of(name) | parse_options(words, f"--trajectory {args.trajectory}")
        begin = route.Route(name, options, len(path), (), args.fps)
    return Given(
        config,
        scene,
        photos,
        path,
        begin,
        args.out,
        lambda parts: load_weights(args, parts=parts)[0],
        args.scale,
    )


if __name__ == "__main__":
    run(main, parser())
