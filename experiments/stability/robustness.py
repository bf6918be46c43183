"""What the trained model stands: quality against every disturbance of photos, cameras and path, and where it breaks.

    OPENBLAS_NUM_THREADS=1 python -m experiments.stability.robustness 8              # results/robustness*.{json,md,png}
    OPENBLAS_NUM_THREADS=1 python -m experiments.stability.robustness 8 --limits     # and roge_jax/assets/limits.json

CPU, 4 cores: about one minute a scene after two minutes of compilation. Scenes: held-out procedural seeds from
1000000000 on. Each is one camera path of 49 views; 3 photos in the middle of thirds of its inner two thirds, 17 targets
between and around them, unless the knob says otherwise. One knob is turned at a time, seeded by scene; the truth is
rendered, never disturbed. Methods: RGB head and generated video of the shipped model with the sampler's defaults, and
under the same disturbance `nearest` (copy of the nearest photo) and `plane` (blend of the photos over the plane at the
true median depth: it knows more than the model).

Curves: mean over scenes; bands: 95 % bootstrap of the *change* from the undisturbed value over scenes, so that the
scenes' own difficulty cancels. A method *breaks* where its mean PSNR has lost 1 dB, by linear interpolation between
levels, with a bootstrap interval; a second break is where it falls below `nearest` under the same disturbance.
With --limits the earlier 1 dB break of the two outputs, in units of what can be seen at run time (`roge_jax.sampling.limits`),
becomes the limit of the warning; where a limit is an estimate from the photos and more than 5 % of 200 undisturbed
scenes lie beyond it, it moves outwards to their 95 % quantile. What wrong poses and focal lengths show in matched photos
is measured without the network (`matching.py`). `--only` measures some of it again and keeps the rest. The published system reports no such curves. Our numbers: docs/results/robustness.md.
"""

import functools
import json
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments import harness
from experiments.stability import matching
from experiments.stability.report import (
    ESTIMATED,
    KNOBS,
    LOSS,
    METHODS,
    METRICS,
    RESAMPLES,
    SHOWN,
    SHRUNK,
    breaks,
    by_reach,
    draw,
    jpeg_row,
    limit_rows,
    summary,
    write_limits,
)
from roge_jax import checkpoint, sampling
from roge_jax.data import faults
from roge_jax.errors import LimitWarning
from roge_jax.files import entry
from roge_jax.geometry.cameras import Cameras, scale_focal
from roge_jax.geometry.crops import resize, scale_K
from roge_jax.metrics import baselines, image, report
from roge_jax.procedural.raycast import render_views
from roge_jax.procedural.scenes import camera_path, intrinsics, load_textures, make_scene
from roge_jax.sampling import limits, programs

STILL = 200  # scenes that say how the estimates from photos vary by themselves
VIEWS, FIRST, LAST = 49, 8, 40  # views of a path; the targets' part of it
TARGETS = np.arange(FIRST, LAST + 1, 2)  # 17; photos take odd views
LEFT, LEFT_TARGETS = (1, 7, 13), np.arange(0, VIEWS, 3)  # photos at one end of the path


# ---- scenes and disturbances ---------------------------------------------------------------------


class Case(NamedTuple):
    """One job: what the model is given, and what is true."""

    images: np.ndarray  # [m, h, w, 3]
    context: Cameras  # as told to the methods
    target: Cameras
    truth: np.ndarray  # [n, h, w, 3]
    depth: np.ndarray  # [n, h, w]


class Place:
    """A scene: any view of its path, at any field of view, rendered once."""

    def __init__(self, seed: int, height: int, width: int):
        self.seed, self.size = seed, (height, width)
        self.K, self.c2w = (
            np.asarray(x, np.float64) for x in _cameras(np.int32(seed), textures(), *self.size)
        )
        self.rgb, self.depth = self.render(self.K, self.c2w)

    def render(
        self, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        found = _render(
            np.int32(self.seed),
            textures(),
            K.astype(np.float32),
            c2w.astype(np.float32),
            *(size or self.size),
        )
        rgb, depth = (np.asarray(x) for x in found)
        return np.round(255 * rgb).astype(np.float32) / 255.0, depth

    def case(self, photos, targets=TARGETS) -> Case:
        photos, targets = np.asarray(photos), np.asarray(targets)
        context, target = (Cameras(self.K[i], self.c2w[i]) for i in (photos, targets))
        return Case(self.rgb[photos], context, target, self.rgb[targets], self.depth[targets])

    @functools.cache  # noqa: B019 (places live as long as the program)
    def large(self, times: int) -> np.ndarray:
        """The photos at `times` the model's size, [3, times h, times w, 3]."""
        size = times * self.size[0], times * self.size[1]
        K, c2w = scale_K(self.K, self.size, size)[spread(3)], self.c2w[spread(3)]
        return self.render(K, c2w, size)[0]

    def zoomed(self, ratio: float) -> Case:
        case = self.case(spread(3))
        target = scale_focal(case.target, 1.0 / ratio)
        truth, depth = self.render(target.K, target.c2w)
        return case._replace(target=target, truth=truth, depth=depth)


@functools.cache
def textures() -> jax.Array:
    return jax.numpy.asarray(load_textures("heldout"))


@functools.partial(jax.jit, static_argnums=(2, 3))
def _cameras(seed, texels, height, width):
    path = camera_path(seed, VIEWS, scene=make_scene(seed, textures=texels))
    K = intrinsics(path["fov"], height, width)
    return jax.numpy.repeat(K[None], VIEWS, 0), path["c2w"]


@functools.partial(jax.jit, static_argnums=(4, 5))
def _render(seed, texels, K, c2w, height, width):
    views = render_views(make_scene(seed, textures=texels), K, c2w, height=height, width=width)
    return views["rgb"], views["depth"]


def spread(m: int, share: float = 1.0) -> list[int]:
    """m odd views in the middle of equal parts of the targets' stretch, or of its middle `share`."""
    middle, length = (FIRST + LAST) / 2, share * (LAST - FIRST)
    exact = middle + length * ((np.arange(m) + 0.5) / m - 0.5)
    return [2 * round((x - 1) / 2) + 1 for x in exact]


def disturbed(place: Place, knob: str, level: float) -> Case:
    """The case of a scene with one knob turned; the same random numbers at every level of a knob."""
    rng = np.random.default_rng([place.seed, list(KNOBS).index(knob)])
    base = place.case(spread(3))
    centres = base.context.centres
    baseline = np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()
    if knob == "rotation":
        return base._replace(context=faults.turn_cameras(base.context, level, rng))
    if knob == "position":
        return base._replace(context=faults.move_cameras(base.context, level * baseline, rng))
    if knob == "focal":
        sign = 1.0 if place.seed % 2 else -1.0
        factor = (1 + level / 100) ** sign
        return base._replace(context=scale_focal(base.context, factor))
    if knob == "noise":
        return base._replace(images=faults.add_noise(base.images, level, rng))
    if knob == "blur":
        return base._replace(images=faults.blur(base.images, level))
    if knob in SHRUNK:
        large = place.large(SHRUNK[knob]) if SHRUNK[knob] > 1 else base.images
        coded = large if level == KNOBS[knob].still else faults.jpeg(large, int(level))
        return base._replace(images=np.stack([resize(x, *place.size) for x in coded]))
    if knob == "exposure":
        stops = level * rng.permutation([-0.5, 0.0, 0.5])
        return base._replace(images=faults.expose(base.images, stops))
    if knob in ("photos", "more"):
        return place.case(spread(int(level)))
    if knob == "copies":
        return place.case(np.array(spread(3))[[1, 0, 1] if level == 2 else [1, 1, 1]])
    if knob == "padding":
        return place.case(spread(3) * 2)
    if knob == "crowding":
        return place.case(spread(3, level))
    if knob in ("wider", "narrower"):
        return place.zoomed(level)
    assert knob == "extrapolation", knob
    return place.case(LEFT, LEFT_TARGETS)


# ---- running -------------------------------------------------------------------------------------


class Runner:
    """All methods on one case."""

    def __init__(self, name: str):
        self.params, self.config = checkpoint.load_model(name)
        self.programs: dict[int, programs.Programs] = {}
        self.settings = sampling.Settings(generate=True).of(self.config)

    def videos(self, case: Case) -> dict[str, np.ndarray]:
        size = (self.config.height, self.config.width)
        photos = sampling.Photos(case.images, None, case.context, tuple(range(len(case.images))))
        made = sampling.sample(
            self.params, self.config, photos, case.target, self.settings, cache=self.programs
        )
        head = made.preview
        if head.shape[1:3] != size:
            head = np.stack([resize(x, *size) for x in head])
        depths = [float(np.median(d)) for d in case.depth]
        poses = case.context.c2w
        shared = (case.images, case.context.K, poses)
        cameras = list(zip(case.target.K, case.target.c2w, depths, strict=True))
        return {
            "rgb_head": head,
            "generated": made.frames,
            "nearest": np.stack(
                [baselines.nearest(case.images, poses, c, d) for _, c, d in cameras]
            ),
            "plane": np.stack([baselines.plane(*shared, K, c, size, d) for K, c, d in cameras]),
        }

    def scores(self, case: Case) -> dict[str, dict[str, np.ndarray]]:
        """{method: {metric: [n]}}, per frame."""
        found = {}
        for method, frames in self.videos(case).items():
            pair = np.clip(frames, 0.0, 1.0).astype(np.float64), case.truth.astype(np.float64)
            found[method] = {name: image.IMAGE_METRICS[name](*pair) for name in METRICS}
        return found


def seen(case: Case) -> dict[str, float]:
    """What the run-time check measures of a case."""
    far = limits.extrapolation(case.context, case.target)
    ratio = limits.field_ratio(case.context, case.target)
    return {
        "extrapolation": float(far.max()),
        "field_ratio": float(ratio[np.argmax(np.abs(np.log(ratio)))]),
        "distinct_photos": float(len(case.images) - len(limits.repeats(case.context))),
        "exposure_stops": float(np.ptp(limits.exposures(case.images))),
        "sharpness": float(np.nanmin(limits.sharpness(case.images))),
        "noise": float(limits.noise(case.images).max()),
    }


def undisturbed(height: int, width: int) -> dict[str, list[float]]:
    """{measure: [scenes]} of what the run-time check estimates from photos, on `STILL` scenes as they are; no network."""
    found: dict[str, list[float]] = {name: [] for name in ESTIMATED}
    for seed in harness.heldout(STILL):
        K, c2w = _cameras(np.int32(seed), textures(), height, width)
        cameras = Cameras(np.asarray(K, np.float64), np.asarray(c2w, np.float64))[spread(3)]
        rgb, _ = _render(
            np.int32(seed),
            textures(),
            cameras.K.astype(np.float32),
            cameras.c2w.astype(np.float32),
            height,
            width,
        )
        images = np.round(255 * np.asarray(rgb)).astype(np.float32) / 255.0
        measured = seen(Case(images, cameras, cameras, images, images[..., 0]))
        for name in ESTIMATED:
            found[name].append(measured[name])
    return found


def measure(
    runner: Runner, seeds: list[int], workers: int, knobs: list[str]
) -> dict[str, dict[str, Any]]:
    """{knob: {"levels": [..], "scores": {method: {metric: [levels, scenes]}}, "seen": {..}}}, undisturbed first."""
    size = (runner.config.height, runner.config.width)
    places = [Place(seed, *size) for seed in seeds]
    turned = [name for name in knobs if name != "extrapolation"]
    # Photos that are shrunk are not those rendered at the model's size: they have an undisturbed case of their own.
    first = {
        knob: (knob, KNOBS[knob].still) if SHRUNK.get(knob, 1) > 1 else ("still", 0.0)
        for knob in turned
    }
    jobs = [("extrapolation", 0.0)] * ("extrapolation" in knobs) + list(
        dict.fromkeys(first.values())
    )
    jobs += [(knob, level) for knob in turned for level in KNOBS[knob].levels]

    def work(job):
        (knob, level), place = job
        case = place.case(spread(3)) if knob == "still" else disturbed(place, knob, level)
        return case, runner.scores(case)

    began = time.perf_counter()
    used = {len(disturbed(places[0], *job).images) for job in jobs if job[0] != "still"}
    for m in sorted(used | {3}):  # compile one by one: threads share what is compiled
        runner.videos(places[0].case(spread(m)))
    print(f"compiled in {time.perf_counter() - began:.0f} s", flush=True)
    results: dict[tuple, list] = {}
    with ThreadPoolExecutor(workers) as pool:
        for job in jobs:
            done = list(pool.map(work, [(job, place) for place in places]))
            results[job] = [
                (seen(case), scores, limits.extrapolation(case.context, case.target))
                for case, scores in done
            ]
            psnr = [np.mean([s[m]["psnr"].mean() for _, s, _ in results[job]]) for m in METHODS]
            shown = ", ".join(f"{m} {x:.2f}" for m, x in zip(METHODS, psnr, strict=True))
            print(f"{time.perf_counter() - began:4.0f} s  {job[0]} {job[1]:g}: {shown}", flush=True)

    def collect(keys) -> dict[str, Any]:
        return {
            "scores": {
                method: {
                    metric: [[float(s[method][metric].mean()) for _, s, _ in results[k]] for k in keys]
                    for metric in METRICS
                }
                for method in METHODS
            },
            "seen": {name: [[w[name] for w, _, _ in results[k]] for k in keys] for name in SHOWN.values()},
        }  # fmt: skip

    found = {}
    for knob in turned:
        levels = [KNOBS[knob].still, *KNOBS[knob].levels]
        found[knob] = {"levels": levels} | collect([first[knob], *((knob, x) for x in levels[1:])])
    if "extrapolation" in knobs:
        found["extrapolation"] = by_reach(results["extrapolation", 0.0])
    return found


# ---- the program ---------------------------------------------------------------------------------


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("scenes", type=int, nargs="?", default=8, help="held-out scenes (default: 8)")
    p.add_argument("--checkpoint", default="mini")
    p.add_argument("--limits", action="store_true", help=f"also write {limits.TABLE.name}")
    p.add_argument("--workers", type=int, default=4, help="cases at a time (default: 4)")
    p.add_argument("--draw", action="store_true", help="only draw the stored results again")
    again = f"measure only these again, with commas: {', '.join(KNOBS)}, matching (no network); the rest is kept"
    p.add_argument("--only", help=again, metavar="KNOBS")
    args = p.parse_args()
    warnings.simplefilter("ignore", LimitWarning)
    names = [*KNOBS, "matching"] if args.only is None else args.only.split(",")
    if unknown := set(names) - {*KNOBS, "matching"}:
        p.error(f"--only {args.only}: there is no {', '.join(sorted(unknown))}")
    stored = harness.read("robustness.json") if args.draw or args.only else {}
    if args.draw:
        show(stored)
        return
    entry.enable_cache()
    began = time.perf_counter()
    document, found = stored, numbers(stored.get("knobs", {}))
    if any(name in KNOBS for name in names):
        seeds = list(harness.heldout(args.scenes))
        runner = Runner(args.checkpoint)
        settings = {
            "checkpoint": args.checkpoint,
            "weights": checkpoint.weights_fingerprint(runner.params, "float32"),
            "model": runner.config.name,
            "size": [runner.config.height, runner.config.width],
            "seeds": seeds,
            "sampler": vars(runner.settings),
            "loss_db": LOSS,
            "bootstrap": {"resamples": RESAMPLES, "level": report.LEVEL, "over": "scenes"},
            "metrics": {name: image.SETTINGS[name] for name in METRICS},
        }
        if stored and any(stored["settings"][k] != settings[k] for k in ("weights", "seeds")):
            p.error("--only: robustness.json has other weights or scenes: measure everything again")
        found |= measure(runner, seeds, args.workers, [name for name in names if name in KNOBS])
        found = {name: found[name] for name in KNOBS}
        size = (runner.config.height, runner.config.width)
        if not stored:
            document = {"settings": settings, "undisturbed": undisturbed(*size)}
    document["breaks"] = breaks(found)
    if "matching" in names:
        size = document["settings"]["size"]
        document["matching"] = matching.measure(
            lambda seed: Place(seed, *size), spread(3), document["breaks"], args.workers
        )
    made = harness.environment() | {"seconds": round(time.perf_counter() - began, 1)}
    if stored:
        document["again"] = document.get("again", {}) | {name: made for name in names}
    else:
        document |= made
    document["knobs"] = found
    document["limits"] = limit_rows(found, document["breaks"], document["undisturbed"])
    document["limits"] |= jpeg_row(document["breaks"], len(document["settings"]["seeds"]))
    if "matching" in document:
        document["limits"] |= matching.rows(document["breaks"], document["matching"])
    harness.write("robustness.json", document, digits=5)
    document = harness.read("robustness.json")
    show(document)
    if args.limits:
        write_limits(document)
        print(f"wrote {limits.TABLE}")


def show(document: dict) -> None:
    """Pictures and tables of a stored document; nothing is computed again, so that they agree with `limits.json`."""
    found = numbers(document["knobs"])
    for metric, suffix in (("psnr", ""), ("ssim", "_ssim"), ("sharpness_ratio", "_sharpness")):
        count = len(document["settings"]["seeds"])
        draw(found, document["breaks"], metric, count, f"robustness{suffix}.png")
    text = summary(document)
    if "matching" in document:
        text += "\n\n" + matching.table(document["matching"], document["limits"])
    (harness.RESULTS / "robustness.md").write_text(text + "\n")
    print(text)


def numbers(found: dict) -> dict:
    """null of JSON as NaN again."""
    return json.loads(json.dumps(found).replace("null", "NaN"))


if __name__ == "__main__":
    main()
