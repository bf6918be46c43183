"""What is wrong with a scene, where, and how to mend it; or what a model folder can do.

    python -m roge_jax.check SCENE [--json] [--convention opencv] [--no-matching]
    python -m roge_jax.check SCENE --checkpoint weights/lagernvs      for the pictures of that model
    python -m roge_jax.check weights/lagernvs                         the model itself

SCENE is a folder or file in any layout that `scenes.readers` knows, `motorcycle` or
`procedural:SEED`. Exit code 0 if the scene (or the model) can be used, 2 if not.
"""

import argparse
import dataclasses
import json
import sys
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from roge_jax.errors import UserError
from roge_jax.files.entry import execute, number, one_of
from roge_jax.files.folders import plain
from roge_jax.geometry.cameras import (
    CONVENTIONS,
    Cameras,
    field_of_view,
    inspect,
    normalise,
    other_conventions,
    turn,
)
from roge_jax.geometry.crops import cover_window
from roge_jax.geometry.trajectories import focus_distance
from roge_jax.geometry.validation import Finding, axes_votes
from roge_jax.metrics.geometry import straightness
from roge_jax.scenes.matching import pose_agreement
from roge_jax.scenes.scene import Scene, is_nerfstudio, open_scene

SIZE = (192, 336)  # of pictures
BAD_FIT = 3.0  # pixels of median epipolar distance: good poses 0.1 to 1, wrong axes 20 and more
GOOD_FIT = 1.0  # what another convention must reach to be named


@dataclasses.dataclass(frozen=True)
class Config:
    """What `check` looks at; the options of the program (`parser`) explain the fields."""

    scene: str
    json: bool = False
    checkpoint: str | None = None
    convention: str | None = None
    height: int | None = None
    width: int | None = None
    matching: bool = True
    debug: bool = False


@dataclasses.dataclass(frozen=True)
class Report:
    """Everything `check` found: numbers about the scene, and findings from worst to mildest."""

    scene: str
    numbers: dict[str, Any]
    findings: list[Finding]

    @property
    def usable(self) -> bool:
        """Whether the scene can be loaded."""
        return not any(finding.severity == "error" for finding in self.findings)


def check(config: Config) -> Report:
    """Reads the scene without stopping at the first fault and reports all of them."""
    config = sized(config)
    height, width = config.height or SIZE[0], config.width or SIZE[1]
    try:
        scene = open_scene(
            config.scene,
            convention=config.convention,
            frames=8,
            height=height,
            width=width,
            supersample=1,
        )
    except UserError as error:
        finding = Finding("error", "scene", str(error).rstrip("."), "nothing else was looked at")
        return Report(config.scene, {}, [finding])
    heights, widths = zip(*scene.sizes, strict=True)
    cameras, findings = inspect(scene.cameras, heights, widths, scene.names, scene.axes)
    findings = [*scene.notes, *findings]
    broken = any(finding.severity == "error" for finding in findings)
    numbers: dict[str, Any] = {"photos": len(scene), "sizes": _sizes(scene)}
    if not broken:
        numbers |= _numbers(scene, cameras, config)
        findings += _about_poses(scene, cameras)
    findings += _about_photos(scene, config)
    if not broken and config.matching and not any(f.severity == "error" for f in findings):
        agreement, more = _about_agreement(scene, cameras, config)
        numbers |= agreement
        findings += more
    order = ("error", "warning", "note")
    return Report(config.scene, numbers, sorted(findings, key=lambda f: order.index(f.severity)))


def sized(config: Config) -> Config:
    """With the size of the pictures to be made: as given, or the model's. Raises: UserError for a model that makes none."""
    size = SIZE
    if config.checkpoint is not None:
        from roge_jax.checkpoint import find_model, load_config
        from roge_jax.sampling.reconstruction import check_makes_pictures

        made_by = load_config(find_model(config.checkpoint))
        check_makes_pictures(made_by, config.checkpoint)
        size = made_by.output_size
    height, width = config.height or size[0], config.width or size[1]
    return dataclasses.replace(config, height=height, width=width)


def _sizes(scene: Scene) -> dict[str, int]:
    """How many photos have which size, e.g. {"640 x 426": 15}."""
    sizes = [f"{width} x {height}" for height, width in scene.sizes]
    return {size: sizes.count(size) for size in dict.fromkeys(sizes)}


def _numbers(scene: Scene, cameras: Cameras, config: Config) -> dict[str, Any]:
    _, _, info = normalise(cameras, cameras)
    fov = [
        np.degrees(field_of_view(K[None], *size)).ravel()
        for K, size in zip(cameras.K, scene.sizes, strict=True)
    ]
    steps = np.linalg.norm(np.diff(cameras.centres, axis=0), axis=-1)
    front, behind = axes_votes(cameras.c2w[:: max(1, len(cameras) // 40)])
    size = (config.height or SIZE[0], config.width or SIZE[1])
    windows = [cover_window(source, size) for source in scene.sizes]
    kept = [w[2] * w[3] / (s[0] * s[1]) for w, s in zip(windows, scene.sizes, strict=True)]
    return {
        "vertical_fov_degrees": [float(min(f[0] for f in fov)), float(max(f[0] for f in fov))],
        "horizontal_fov_degrees": [float(min(f[1] for f in fov)), float(max(f[1] for f in fov))],
        "baseline_max": info.context_reach,
        "baseline_neighbours": float(np.median(steps)) if len(steps) else 0.0,
        "focus_distance": focus_distance(cameras),
        **_about_points(scene),
        "status": info.status,
        "divisor": info.divisor,
        "straightness": straightness(cameras.centres),
        "axes_meet_in_front": front,
        "axes_meet_behind": behind,
        "offset": float(np.abs(cameras.centres).max()),
        "crop_keeps": float(min(kept)),
    }


def _about_points(scene: Scene) -> dict[str, Any]:
    """How many sparse points lie beside the poses, and how far away the photos see them (median)."""
    if not scene.points:
        return {}
    depths = [d for view in range(len(scene)) if (d := scene.depth(view)) is not None]
    return {"points": len(scene.points), "points_distance": float(np.median(depths or [np.nan]))}


def _about_poses(scene: Scene, cameras: Cameras) -> list[Finding]:
    """Duplicate poses, one place, far from the origin."""
    findings = []
    seen: dict[bytes, str] = {}
    for name, pose in zip(scene.names, cameras.c2w, strict=True):
        twin = seen.setdefault(pose.tobytes(), name)
        if twin != name:
            fix = "keep one if it is the same photo, else correct its pose"
            findings.append(Finding("warning", f"view {name}", f"has the pose of {twin}", fix))
    _, _, info = normalise(cameras, cameras)
    if info.status != "ok":
        what = f"the photos fix no scale ({info.status.replace('_', ' ')})"
        fix = "paths are measured in units of the distance to what is in focus; give a scale"
        findings.append(Finding("note", "cameras", what, fix))
    offset = np.abs(cameras.centres).max()
    if info.context_reach > 0 and offset > 1e3 * info.context_reach:
        what = f"positions up to {offset:.3g} in a scene of size {info.context_reach:.3g}"
        fix = "fine here (float64 until re-centred), but other programs will lose precision"
        findings.append(Finding("note", "cameras", what, fix))
    flat = straightness(cameras.centres)
    if len(cameras) > 2 and info.context_reach > 0 and flat < 1e-2:
        what = f"camera positions lie on a line (straightness {flat:.1e})"
        fix = "fine for rays; rotation errors after alignment mean nothing, use relative ones"
        findings.append(Finding("note", "cameras", what, fix))
    return findings


def _about_photos(scene: Scene, config: Config) -> list[Finding]:
    """Damaged, blank or badly cropped photos."""
    findings = []
    aspects = [width / height for height, width in scene.sizes]
    for view, name in enumerate(scene.names):
        try:
            image = scene.images[view]
        except UserError as error:
            what = str(error).rstrip(".")
            findings.append(Finding("error", f"view {view}", what, "replace the file"))
            continue
        if image.std() < 0.004:
            fix = "remove the view or replace the photo"
            findings.append(Finding("warning", f"view {view} ({name})", "is of one colour", fix))
    if max(aspects) > 2 * min(aspects):
        what = f"aspect ratios from {min(aspects):.2f} to {max(aspects):.2f}"
        findings.append(Finding("warning", "photos", what, "use only alike ones together"))
    height, width = config.height or SIZE[0], config.width or SIZE[1]
    gap = max(width / height / a for a in aspects)
    gap = max(gap, max(a * height / width for a in aspects))
    if gap > 2:
        what = f"{width} x {height} pictures keep only {1 / gap:.0%} of a photo"
        findings.append(Finding("warning", "photos", what, "choose a height and width like theirs"))
    return findings


def _about_agreement(
    scene: Scene, cameras: Cameras, config: Config
) -> tuple[dict[str, Any], list[Finding]]:
    """Whether matched features fit the poses, and if not, whether another convention would."""
    now = config.convention or ("opengl" if is_nerfstudio(scene.source) else "opencv")
    others = other_conventions(cameras, now)
    causes = other_causes(scene, cameras)
    candidates = {now: cameras} | others | {name: one for name, (one, _) in causes.items()}
    try:
        distances, pairs = pose_agreement(scene.images, candidates)
    except ImportError:
        return {}, [Finding("note", "poses", "not compared with the photos", "install OpenCV")]
    if pairs == 0:
        what = "no two photos could be matched, so the poses are untested"
        return {}, [Finding("note", "poses", what, "more overlap or texture would help")]
    numbers = {"epipolar_pixels": distances[now], "epipolar_pairs": pairs}
    best = min(others, key=lambda c: distances[c])
    if distances[now] <= BAD_FIT:
        return numbers, []
    what = f"matched features lie {distances[now]:.1f} pixels from where the poses put them"
    cause = min(causes, key=lambda c: distances[c])
    if distances[cause] < min(distances[best], GOOD_FIT, distances[now] / 3):
        fix = f"{causes[cause][1]}; so read it is {distances[cause]:.2f}"
        return numbers, [Finding("error", "poses", what, fix)]
    if distances[best] < min(GOOD_FIT, distances[now] / 3):
        fix = f"read as '{best}' it is {distances[best]:.2f}: give --convention {best}"
        fix += f" (in Python convention='{best}')"
        return numbers, [Finding("error", "poses", what, fix)]
    fix = "check intrinsics, picture order and poses (moving things also do this)"
    return numbers, [Finding("warning", "poses", what, fix)]


def other_causes(scene: Scene, cameras: Cameras) -> dict[str, tuple[Cameras, str]]:
    """What else than axes makes right poses fit badly: {name: (cameras that would fit then, what to do)}."""
    turned = [
        turn(K, pose, 2, *size)
        for K, pose, size in zip(cameras.K, cameras.c2w, scene.sizes, strict=True)
    ]
    upside = Cameras(np.stack([K for K, _ in turned]), np.stack([pose for _, pose in turned]))
    shift = "the photos have the poses of their neighbours: correct the names or the order"
    return {
        "upside down": (upside, "the photos are upside down: turn them, or correct their EXIF tag"),
        "the next": (Cameras(cameras.K, np.roll(cameras.c2w, -1, 0)), shift),
        "the one before": (Cameras(cameras.K, np.roll(cameras.c2w, 1, 0)), shift),
    }


def render(report: Report) -> str:
    """The report for people."""
    n = report.numbers
    if "parts" in n:
        from roge_jax.sampling.abilities import render_model

        return render_model(report.scene, n, report.findings)
    lines = [f"scene     {report.scene}"]
    if n:
        sizes = ", ".join(f"{count} of {size}" for size, count in n["sizes"].items())
        lines.append(f"photos    {n['photos']}: {sizes}")
    if "divisor" in n:
        (v0, v1), (h0, h1) = n["vertical_fov_degrees"], n["horizontal_fov_degrees"]
        lines += [
            f"view      {_span(h0, h1)} x {_span(v0, v1)} degrees; crops keep {n['crop_keeps']:.0%}",
            f"baseline  {n['baseline_max']:.4g} at most, {n['baseline_neighbours']:.4g} between "
            f"neighbours; the scene is about {n['focus_distance']:.4g} away",
            f"scale     divisor {n['divisor']:.6g} ({n['status']}); straightness "
            f"{n['straightness']:.3g}; coordinates up to {n['offset']:.4g}",
            f"axes      meet in front of the cameras in {n['axes_meet_in_front']} pairs, behind in "
            f"{n['axes_meet_behind']}",
        ]
    if "points" in n:
        lines.append(
            f"points    {n['points']} sparse ones, {n['points_distance']:.4g} away (median)"
        )
    if "epipolar_pixels" in n:
        lines.append(
            f"poses     matched features fit them to {n['epipolar_pixels']:.2f} pixels "
            f"(median of {n['epipolar_pairs']} pairs)"
        )
    lines += [f"{finding.severity:9s} {finding}" for finding in report.findings]
    lines.append("result    " + ("can be used" if report.usable else "cannot be used as it is"))
    return "\n".join(lines)


def _span(low: float, high: float) -> str:
    return f"{low:.1f}" if high - low < 0.05 else f"{low:.1f}-{high:.1f}"


def main(config: Config) -> int:
    """Prints the report; the exit code."""
    from roge_jax.sampling.abilities import inspect_model, is_model

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # all of it is in the report
        if is_model(config.scene):
            report = Report(config.scene, *inspect_model(config.scene))
        else:
            report = check(config)
    if config.json:
        content = dataclasses.asdict(report) | {"usable": report.usable}
        print(json.dumps(plain(content), indent=1, allow_nan=False))
    else:
        print(render(report))
    return 0 if report.usable else 2


def parser() -> argparse.ArgumentParser:
    """The options of `python -m roge_jax.check`."""
    p = argparse.ArgumentParser(
        prog="python -m roge_jax.check",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    p.add_argument(
        "scene", help="a scene folder or file, motorcycle or procedural:SEED; or a model folder"
    )
    p.add_argument("--json", action="store_true", help="print the report as JSON")
    p.add_argument(
        "--convention",
        type=one_of(CONVENTIONS),
        help=f"axes of the poses of a transforms.json: {', '.join(CONVENTIONS)}",
    )
    size = "of the pictures to be made, to say how much of a photo the crop keeps (default: {} or the model's)"
    p.add_argument("--height", type=number(1), help=size.format(SIZE[0]))
    p.add_argument("--width", type=number(1), help=size.format(SIZE[1]))
    p.add_argument("--checkpoint", help="the model that is to make them: its size counts")
    p.add_argument(
        "--matching",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="compare the poses with matched features of the photos (a few seconds)",
    )
    p.add_argument("--debug", action="store_true", help="show where an error comes from")
    return p


def cli(arguments: Sequence[str] | None = None) -> int:
    """The command line: exit code 2 and one sentence for mistakes."""
    return execute(lambda args: main(Config(**vars(args))), parser(), arguments)


if __name__ == "__main__":
    sys.exit(cli())
