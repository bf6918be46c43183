"""What the options of `python -m roge_jax.sample` mean: configuration, scene, photos, path, devices and weights."""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np

from ..errors import UserError
from ..files.fields import exists, is_file

SCENE, MOST_FRAMES = "motorcycle", 10000  # frames/0000.png to 9999.png, in memory at once
MOST_PIXELS = 2**24  # of a picture
RENDERED = 32  # views of a procedural scene
THROUGH = "interpolate:order=shortest"  # the path of several photos
ALONE = "orbit:degrees=12"  # and of one
FPS = 16.0  # frames per second where neither --fps nor a path file says another
UNSEEN = 1e-3  # coverage by the photos below which a path looks at nothing they see
LARGE = 1e9  # parameters from which `auto` means bfloat16 on an accelerator


def model_config(args: argparse.Namespace, *, weights: bool):
    """The configuration of --checkpoint at --size; a preset without weights is enough for a dry run."""
    from ..checkpoint import find_model, load_config
    from ..config import PRESETS, preset
    from .reconstruction import check_makes_pictures

    try:
        config = load_config(find_model(args.checkpoint))
    except UserError:
        if weights or args.checkpoint not in PRESETS:
            raise
        config = preset(args.checkpoint)
    check_makes_pictures(config, args.checkpoint)
    if args.size is None:
        return config
    try:
        height, width = (int(side) for side in args.size.lower().split("x"))
    except ValueError:
        raise UserError(
            f"--size '{args.size}' is not HEIGHTxWIDTH: write it like {config.output_size[0]}x{config.output_size[1]}."
        ) from None
    if height > 0 and width > 0 and height * width > MOST_PIXELS:
        raise UserError(
            f"--size {args.size}: give at most {MOST_PIXELS} pixels, e.g. 4096x4096; this model was made for "
            f"{config.height}x{config.width}."
        )
    return config.for_pictures(height, width)


def camera_path(
    args: argparse.Namespace, context, config, *, quiet: bool = False, start=None, depth=None
):
    """The cameras [n] of --trajectory in the scene's frame, K in pixels of the video; --fps where only the file says it.

    quiet: what is to be said about the file has been said. start: the pose [4, 4] of the photo at which a path starts
    that is relative to its first camera; the first of `context` if None. depth: how far away what a photo of `context`
    sees is, by its number, or None; a preset takes it for its focus where the user gives none.
    """
    from ..geometry.cameras import Cameras
    from ..geometry.trajectories import PRESETS, make_path, parse_options
    from ..scenes.paths import read_path

    _check_length(args.frames or 0, f"--frames {args.frames}")
    if args.trajectory is None:
        args.trajectory = THROUGH if len(context) > 1 else ALONE
    name, _, words = args.trajectory.partition(":")
    if is_path_file(args.trajectory):
        if args.start:
            raise UserError(
                f"--start {args.start} is for presets: a path file starts where it says; leave it away."
            )
        size = {"height": config.height, "width": config.width}
        place = None if args.scene == SCENE or args.scene.startswith("procedural:") else args.scene
        axes = {"convention": args.convention, "frame": getattr(args, "path_frame", None)}
        if start is not None:
            leader = Cameras(context.K[:1], start[None])
        read = read_path(
            args.trajectory,
            frames=args.frames,
            context=context if start is None else leader,
            scene=place,
            **axes,
            **size,
        )
        path = read.cameras
        _check_length(len(path), args.trajectory)
        args.fps = args.fps or read.fps
        if not quiet:
            _tell(args, read)
    elif name not in PRESETS and ("/" in name or "." in name):
        raise UserError(f"--trajectory {args.trajectory}: there is no such path file.")
    else:
        options = parse_options(words, f"--trajectory {args.trajectory}")
        if args.start and "start" in options:
            raise UserError(
                f"--trajectory {args.trajectory}: 'start' is given twice, with --start {args.start}."
            )
        if getattr(args, "path_frame", None):
            raise UserError(
                f"--path-frame {args.path_frame} is for path files: a preset is in the scene's coordinates; leave it away."
            )
        options = {"start": args.start} | options
        if depth is not None and "focus" not in options and options["start"] in range(len(context)):
            options["focus"] = depth(options["start"])
        path = make_path(name, context, args.frames or config.frames, **options)
    if args.fov is not None:
        if not args.fov < 180:
            raise UserError(
                f"--fov {args.fov:g}: the full vertical angle must lie between 0 and 180 degrees."
            )
        focal = 0.5 * config.height / np.tan(np.radians(args.fov) / 2)
        K = np.array([[focal, 0, config.width / 2], [0, focal, config.height / 2], [0, 0, 1.0]])
        path = Cameras(np.repeat(K[None], len(path), 0), path.c2w)
    args.fps = args.fps or FPS
    return path


def _tell(args: argparse.Namespace, read) -> None:
    """What a path file has to say: how --convention was understood, what of it is not used."""
    from ..geometry.cameras import CameraWarning

    for note in read.notes:
        if note.severity == "warning":
            warnings.warn(str(note), CameraWarning, stacklevel=3)
    if args.convention and read.axes == args.convention:
        note = f"its poses are read as {read.axes}, as --convention says"
    else:
        note = "--convention is not used, the file says itself which axes its poses have"
    if args.convention:
        print(f"note: {args.trajectory}: {note}", file=sys.stderr)


def is_path_file(trajectory: str | None) -> bool:
    """Whether a --trajectory is a file (or a scene's folder) of cameras, which are known before any photo is."""
    if trajectory is None:
        return False
    from ..geometry.trajectories import PRESETS

    folder = trajectory.partition(":")[0] not in PRESETS and exists(Path(trajectory))
    return trajectory.lower().endswith(".json") or is_file(Path(trajectory)) or folder


def _check_length(frames: int, where: str) -> None:
    if frames > MOST_FRAMES:
        raise UserError(
            f"{where}: give a path of at most {MOST_FRAMES} frames, since all are in memory until they are written."
        )


def large_dtype(args: argparse.Namespace, parameters: float) -> str:
    """The dtype of large matrices that --dtype means for a model of so many parameters."""
    from ..core import target

    if args.dtype != "auto":
        return args.dtype
    return "bfloat16" if parameters > LARGE and target.platform() != "cpu" else "float32"


def sampling_mesh(args: argparse.Namespace):
    """The mesh of --mesh and --devices, None for one device. Call it before anything asks JAX for devices."""
    from ..core import distributed, sharding

    sizes = {} if args.mesh is None else sharding.parse_mesh(args.mesh)
    if sizes.get("data", 1) > 1:
        raise UserError(
            f"--mesh {args.mesh}: one video has no scenes to split over data: use fsdp (weights) and seq (tokens)."
        )
    count = args.devices or sizes.get("fsdp", 1) * sizes.get("seq", 1)
    if count == 1:
        return None
    distributed.request_devices(count)
    import jax

    devices = jax.devices()[:count]
    sizes = sizes or {"seq": len(devices)}
    return sharding.make_mesh(**{"data": 1} | sizes, devices=devices)


def load_weights(args: argparse.Namespace, mesh=None, parts=None):
    """(params, config of the file), of the `parts` of the tree that are wanted. Large models are bfloat16 on accelerators,
    apart from what must not be.
    """
    from .. import checkpoint, cost, model
    from ..core import sharding, target
    from ..core.params import count

    config = checkpoint.load_config(checkpoint.find_model(args.checkpoint))
    specs = model.specs(config)
    if target.platform() == "gpu" and parts is None and config.parts == "all":
        sharding.check_heads(config.dit.heads, mesh)
    dtype = large_dtype(args, count(specs))
    return checkpoint.load_model(
        args.checkpoint,
        dtype=cost.kept_as(dtype),
        shardings=None if mesh is None else sharding.shardings(specs, mesh),
        parts=parts,
    )


def read_inputs(args: argparse.Namespace, config, settings, scene=None):
    """(scene, photos, path), after all checks that need no weights; `settings` are those of the model.

    Of a path file photos are chosen that see what it looks at; a preset starts from photos that are chosen before it.
    """
    from ..geometry.cameras import normalise
    from ..scenes.scene import cameras_at, load_scene
    from .photos import context_ids, read_photos
    from .video import noise_levels

    scene = scene or load_scene(args.scene, convention=args.convention)
    known, start, chosen = None, None, addressed(args.context, scene)
    if is_path_file(args.trajectory):
        every = cameras_at(scene, config.height, config.width)
        named = chosen is not None and ("," in chosen or chosen in scene.names)
        start = every.c2w[context_ids(chosen, scene, config)[0] if named else 0]
        known = camera_path(args, every, config, start=start)
        check_sees(args, every, known, config)
    photos = read_photos(scene, context_ids(chosen, scene, config, known), config)
    path = camera_path(
        args,
        photos.cameras,
        config,
        quiet=known is not None,
        start=start,
        depth=lambda place: scene.depth(photos.ids[place]),
    )
    normalise(photos.cameras, path, rule=config.scale_rule, scale=settings.scale)
    noise_levels(settings, config)
    return scene, photos, path


def addressed(context: str | None, scene) -> str | None:
    """--context with every name that is no view's own replaced by its number; names may hold commas.

    Raises: UserError for names that could be several photos.
    """
    from ..scenes.scene import find_view

    if context is None or (context in scene.names and "," not in context):
        return context
    words, at = context.split(","), 0
    found: list[str] = []
    view: str | None
    while at < len(words):
        for end in range(len(words), at, -1):  # the longest name that starts here
            word = ",".join(words[at:end]).strip()
            if word.lstrip("-").isdecimal() or (word in scene.names and "," not in word):
                view = word
            else:
                number = find_view(scene, word) if word else None
                view = None if number is None else str(number)
            if view is not None:
                found.append(view)
                at = end
                break
        else:
            found.append(words[at])
            at += 1
    if len(found) == 1 and found[0] != context:
        return f"{found[0]},"  # a number alone is a count
    return ",".join(found)


def check_sees(args: argparse.Namespace, photos, path, config) -> None:
    """Raise UserError for a path file that looks at nothing the photos see, unless --path-frame says where it belongs."""
    from ..scenes.coverage import by_frame

    if getattr(args, "path_frame", None) is not None:
        return
    thinned = path[:: max(1, len(path) // 50)]
    if by_frame(photos, thinned, config.height, config.width).max() >= UNSEEN:
        return
    read = f" (poses were read as {args.convention})" if args.convention else ""
    raise UserError(
        f"--trajectory {args.trajectory}: the path looks at nothing that the photos see{read}: is it in other axes (give "
        "--convention), or in other coordinates than the scene (give --path-frame FILE with the transform, or "
        "--path-frame first to start it at the first photo)? --path-frame scene takes it as it is."
    )


def stand_in(args: argparse.Namespace, config):
    """A blank scene where the one asked for takes a minute to render (procedural), or none was chosen and the built-in
    one has fewer photos than --context asks for; else None."""
    from ..procedural.scenes import split_of
    from ..scenes.scene import procedural_seed
    from .photos import blank_scene

    if args.scene.startswith("procedural:"):
        split_of(procedural_seed(args.scene))  # raises for a seed out of range
        return blank_scene(args.scene, RENDERED, config)
    count = int(args.context) if (args.context or "").isdecimal() else 0
    asked = args.scene == SCENE and 2 < count <= config.max_context
    return blank_scene(SCENE, count, config) if asked else None
