"""How right are the points that are triangulated from generated frames? Held-out rendered scenes, whose depth is known.

        python -m experiments.quality.points                 5 scenes, CPU, about 5 minutes on 2 free cores
        python -m experiments.quality.points --scenes 1 --size 64x112

Of each scene VIEWS views are rendered along its own path. The model gets three of them, and makes frames for the cameras
of all. Points are triangulated from the rendered views, from the generated frames and from the preview, and their depth
is compared with the rendered one in every view that sees them. Writes experiments/results/points.json and the table of
docs/howto/other_tools.md.
"""

import sys

import numpy as np

from experiments import harness

VIEWS, GIVEN = 17, (0, 8, 16)
RESULT, PAGE = "points.json", harness.DOCS / "howto" / "other_tools.md"
KINDS = {
    "rendered": "the rendered views",
    "generated": "generated frames",
    "preview": "the preview",
}


def depth_errors(points, cameras, depths) -> np.ndarray:
    """Relative errors of depth, one for each view that sees a point; cameras and depths [n, h, w] of the same views."""
    found = []
    for view, (seen, pixels) in enumerate(zip(points.seen, points.pixels, strict=True)):
        height, width = depths[view].shape
        column = pixels[:, 0].astype(int).clip(0, width - 1)
        row = pixels[:, 1].astype(int).clip(0, height - 1)
        truth = depths[view][row, column]
        pose = cameras.c2w[view]
        depth = (points.xyz[seen] - pose[None, :3, 3]) @ pose[:3, 2]
        error = np.abs(depth / truth - 1.0)
        found.append(error[np.isfinite(error)])
    return np.concatenate(found)


def measure(seed: int, size: tuple[int, int], params, config, cache: dict) -> dict:
    """{kind: numbers} of one scene."""
    from roge_jax import sampling
    from roge_jax.errors import UserError
    from roge_jax.geometry.cameras import Cameras
    from roge_jax.geometry.crops import scale_K
    from roge_jax.scenes.scene import load_scene
    from roge_jax.scenes.triangulate import triangulate

    scene = load_scene(f"procedural:{seed}", frames=VIEWS, height=size[0], width=size[1])
    photos = sampling.read_photos(scene, GIVEN, config)
    K = scale_K(scene.cameras.K, size, (config.height, config.width))
    path = Cameras(K, scene.cameras.c2w)
    settings = sampling.Settings(generate=True)
    result = sampling.sample(params, config, photos, path, settings, cache=cache)
    rendered = np.stack([np.asarray(image) for image in scene.images])
    made = {"rendered": rendered, "generated": result.frames, "preview": result.preview}
    found = {}
    for kind, frames in made.items():
        try:
            points, said = triangulate(frames, scene.cameras)
        except UserError as error:
            found[kind] = {"points": 0, "said": str(error)}
            continue
        errors = depth_errors(points, scene.cameras, scene.depths)
        found[kind] = {
            **said._asdict(),
            "depth_error_median": float(np.median(errors)),
            "depth_within_5_percent": float(np.mean(errors < 0.05)),
        }
    return found


def draw(record: dict) -> None:
    """The table of the page."""
    rows = []
    for kind, name in KINDS.items():
        some = [one[kind] for one in record["scenes"].values() if one[kind]["points"]]
        mean = {key: np.mean([one[key] for one in some]) for key in some[0]}
        low, high = (f([100 * one["depth_error_median"] for one in some]) for f in (min, max))
        rows.append(
            (
                name,
                f"{mean['points']:.0f}",
                f"{mean['views']:.1f}",
                f"{mean['error']:.2f}",
                f"{100 * mean['depth_error_median']:.1f} ({low:.1f} to {high:.1f})",
                f"{100 * mean['depth_within_5_percent']:.0f}",
            )
        )
    head = [
        "triangulated from",
        "points",
        "frames a point",
        "error, px",
        "depth error, %",
        "within 5 %",
    ]
    harness.put(PAGE, "points", "\n".join(harness.table(head, rows)))


def main(arguments: list[str]) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--scenes", type=int, default=5)
    parser.add_argument("--size", default="192x336")
    parser.add_argument("--draw", action="store_true", help="the table again, of what is stored")
    args = parser.parse_args(arguments)
    if args.draw:
        return draw(harness.read(RESULT))
    from roge_jax.checkpoint import load_model

    height, width = (int(side) for side in args.size.split("x"))
    params, config = load_model("mini")
    config = config.for_pictures(height, width)
    found, cache = {}, {}
    for seed in harness.heldout(args.scenes):
        found[str(seed)] = measure(seed, (height, width), params, config, cache)
        print(seed, found[str(seed)], flush=True)
        record = {"size": [height, width], "views": VIEWS, "given": GIVEN, "scenes": found}
        harness.write(RESULT, record)  # what there is, if the rest is cut off
    draw(record)


if __name__ == "__main__":
    main(sys.argv[1:])
