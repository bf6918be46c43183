"""What wrong poses and focal lengths show at run time: pixels between matched features and where the poses put them.

No program of its own: `python -m experiments.stability.robustness --limits` calls it, after the curves. No network. Every scene is
what a user would have: the 49 photos of a held-out path, three of which the model is given (`robustness.spread`); each is
matched with its partners (`scenes.matching.partners`), and all cameras are disturbed. Depth is known, so *exact* matches
give what a disturbance does by itself; photos rendered at `SCALES` times the model's size and matched by SIFT give what
matching adds, and how often the warning comes.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from experiments import harness
from experiments.stability.report import KNOBS, MODELS, USUAL
from roge_jax.data import faults
from roge_jax.geometry.cameras import Cameras, invert, scale_focal, scale_K
from roge_jax.scenes import matching

SCENES = 40
STEP = 4  # pixels between exact matches
SCALES = (1, 2, 4)  # of the photos that are matched, over the model's size
DOSES = (0.5, 1, 2, 3)  # times that at which the model has lost 1 dB
POSES = ("rotation", "position", "focal")
OCCLUDED = 0.01  # relative difference of depths


def exact_matches(depth: np.ndarray, cameras: Cameras, pairs: list[matching.Pair]):
    """Pixels of the one view that the other sees too, every fourth, as `matching.Matches`; depth [v, h, w] along z."""
    height, width = depth.shape[1:]
    y, x = np.mgrid[:height:STEP, :width:STEP].reshape(2, -1)
    here = np.stack([x, y], 1) + 0.5
    found = {}
    for i, j in pairs:
        rays = np.concatenate([here, np.ones((len(here), 1))], 1) @ np.linalg.inv(cameras.K[i]).T
        points = rays * depth[i][y, x, None].astype(np.float64)
        motion = invert(cameras.c2w[j]) @ cameras.c2w[i]
        points = points @ motion[:3, :3].T + motion[:3, 3]
        ahead = points[:, 2] > 1e-6
        there = points @ cameras.K[j].T
        there = there[:, :2] / np.where(ahead, there[:, 2], 1.0)[:, None]
        column, row = np.floor(there).astype(int).T
        inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        shown = np.where(inside, depth[j][np.where(inside, row, 0), np.where(inside, column, 0)], 0)
        kept = inside & (np.abs(shown - points[:, 2]) < OCCLUDED * points[:, 2])
        if kept.sum() >= matching.MIN_MATCHES:
            found[i, j] = (here[kept], there[kept])
    return found


def wrong(cameras: Cameras, ids: list[int], knob: str, level: float, seed: int) -> Cameras:
    """All cameras of a scene with the fault that `robustness.disturbed` gives the photos."""
    rng = np.random.default_rng([seed, POSES.index(knob)])
    if knob == "rotation":
        return faults.turn_cameras(cameras, level, rng)
    if knob == "position":
        centres = cameras.centres[ids]
        baseline = np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()
        return faults.move_cameras(cameras, level * baseline, rng)
    return scale_focal(cameras, (1 + level / 100) ** (1.0 if seed % 2 else -1.0))


def seen(matches: matching.Matches, cameras: Cameras, ids: list[int]) -> list[float]:
    """What the run-time check measures: pixels of the worst photo, focal error in %, pixels once it is mended, gain."""
    if not matches:
        return [np.nan] * 4
    error, gain = matching.focal_error(matches, cameras)
    mended = scale_focal(cameras, 1 + error)
    pixels = [
        float(np.nanmax(matching.photo_misfits(matching.misfits(matches, c), ids)))
        for c in (cameras, mended)
    ]
    return [pixels[0], 100 * abs(error), pixels[1], gain]


def measure(
    place: Callable[[int], Any], ids: list[int], breaks: dict[str, dict], workers: int
) -> dict[str, Any]:
    """{"exact" | "matched": {knob: {"levels": [..], "seen": [levels, scenes, 4]}}, "undisturbed": {scale: [scenes, 4]}}.

    place: a scene by its seed (`robustness.Place`). Levels are DOSES times the dose at which the model has lost 1 dB, and
    the last one of the knob; `matched` is at the largest of SCALES.
    """
    levels = {k: [x * dose(breaks, k) for x in DOSES] + [KNOBS[k].levels[-1]] for k in POSES}

    def work(seed: int):
        here = place(seed)
        cameras, size = Cameras(here.K, here.c2w), here.size
        pairs = matching.partners(cameras, ids, matching.PARTNERS)
        views = sorted({view for pair in pairs for view in pair})
        found = {"exact": exact_matches(here.depth, cameras, pairs)}
        still = {}
        for scale in SCALES:
            large = (scale * size[0], scale * size[1])
            rgb, _ = here.render(scale_K(here.K[views], size, large), here.c2w[views], large)
            photos: list[Any] = [None] * len(cameras)
            for view, image in zip(views, rgb, strict=True):
                photos[view] = image
            found["matched"] = matching.photo_matches(photos, cameras, ids, *size)
            still[scale] = seen(found["matched"], cameras, ids)
        turned = {
            (kind, knob): [seen(m, wrong(cameras, ids, knob, x, seed), ids) for x in levels[knob]]
            for kind, m in found.items()
            for knob in POSES
        }
        return turned, still

    seeds = harness.heldout(SCENES)
    with ThreadPoolExecutor(workers) as pool:
        done = list(pool.map(work, seeds))
    return {
        "seeds": [seeds[0], seeds[-1]],
        "scenes": SCENES,
        "doses": DOSES,
        **{
            kind: {
                knob: {
                    "levels": levels[knob],
                    "seen": np.swapaxes([turned[kind, knob] for turned, _ in done], 0, 1).tolist(),
                }
                for knob in POSES
            }
            for kind in ("exact", "matched")
        },
        "undisturbed": {str(scale): [still[scale] for _, still in done] for scale in SCALES},
    }


def dose(breaks: dict[str, dict], knob: str) -> float:
    """The level at which the earlier of the two outputs has lost 1 dB."""
    return min(breaks[knob][m]["loses_1_db"]["at"] for m in MODELS)


def rows(breaks: dict[str, dict], found: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The rows `poses` and `focal` of `limits.json`.

    `poses`: the median over scenes of the exact pixels where 1 dB is lost, the smaller of turned and moved cameras.
    `focal`: the error itself; `gain` is what wrong poses at that dose stay within in USUAL of the scenes. Neither lies further in than USUAL of the undisturbed scenes, at the worst of SCALES.
    """
    at_break = list(found["doses"]).index(1)
    pixels = {
        knob: float(np.nanmedian(np.array(found["exact"][knob]["seen"], float)[at_break, :, 0]))
        for knob in ("rotation", "position")
    }
    smaller = min(pixels, key=lambda k: pixels[k])
    still = np.array(list(found["undisturbed"].values()), float)  # [scales, scenes, 4]
    made = {}
    for kind, knob, limit, column in (
        ("poses", smaller, pixels[smaller], 0),
        ("focal", "focal", dose(breaks, "focal"), 1),
    ):
        usual = float(np.nanquantile(still[..., column], USUAL, axis=1).max())
        output = min(MODELS, key=lambda m: breaks[knob][m]["loses_1_db"]["at"])
        last = np.array(found["exact"][knob]["seen"], float)[-1, :, column]
        made[kind] = {
            "limit": max(limit, usual),
            "measured_limit": limit,
            "moved": usual > limit,
            "broke": True,
            "measure": ("misfit", "focal_error")[column],
            "knob": dose(breaks, knob),
            "of": knob,
            "interval": breaks[knob][output]["loses_1_db"]["interval"],
            "output": output,
            "undisturbed_beyond": float(
                np.nanmean(still[..., column] > max(limit, usual), 1).max()
            ),
            "undisturbed_scenes": int(np.isfinite(still[..., column]).sum(1).min()),
            "last_level_beyond": float((last > max(limit, usual)).mean()),
        }
    poses = [np.array(found["matched"][k]["seen"], float)[at_break, :, 3] for k in pixels]
    made["focal"]["gain"] = float(np.nanquantile(poses, USUAL))
    return made


def warned(measured: Any, limits: dict[str, dict[str, Any]]) -> tuple[float, float]:
    """Shares of scenes [scenes, 4] with a warning of poses and of focal lengths, as `scene_limits.about_cameras` decides."""
    pixels, error, mended, gain = np.array(measured, float).T
    focal = (error > limits["focal"]["limit"]) & (gain > limits["focal"]["gain"])
    focal &= mended <= limits["poses"]["limit"]
    return float((~focal & (pixels > limits["poses"]["limit"])).mean()), float(focal.mean())


def table(found: dict[str, Any], limits: dict[str, dict[str, Any]]) -> str:
    """Doses, pixels and how often the warning comes, in markdown."""
    lines = [
        f"Matching, {found['scenes']} scenes; photos {SCALES[-1]} times the model's size where nothing else is said.",
        "",
    ]

    def line(name: str, exact: Any, matched: Any) -> list[str]:
        quantiles = np.nanquantile(np.array(matched, float)[:, 0], [0.05, 0.5, 0.95])
        shares = [f"{x:.0%}" for x in warned(matched, limits)]
        middle = "" if exact is None else f"{np.nanmedian(np.array(exact, float)[:, 0]):.3f}"
        return [name, middle, ", ".join(f"{x:.3f}" for x in quantiles), *shares]

    rows = []
    for scale, measured in found["undisturbed"].items():
        rows.append(line(f"none, photos {scale} times the size", None, measured))
    for knob in POSES:
        exact, matched = found["exact"][knob], found["matched"][knob]
        for i, level in enumerate(exact["levels"]):
            times = f" ({found['doses'][i]:g} times the dose)" if i < len(found["doses"]) else ""
            name = f"{KNOBS[knob].title} {level:.3g}{times}"
            rows.append(line(name, exact["seen"][i], matched["seen"][i]))
    columns = ["fault", "pixels, exact (median)", "pixels, matched (5 %, median, 95 %)"]
    columns += ["warned of poses", "of focal lengths"]
    return "\n".join([*lines, *harness.table(columns, rows)])
