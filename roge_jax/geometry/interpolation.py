"""Smooth camera paths through key cameras."""

import numpy as np

from .cameras import Cameras, to_host


def interpolate(
    keys: Cameras, s: np.ndarray, *, times: np.ndarray | None = None, unit: float | None = None
) -> Cameras:
    """A smooth path through key cameras [k], taken at progress s [f], 0 the first and 1 the last.

    Positions follow a cubic spline, orientations a spline with continuous angular velocity (scipy's
    RotationSpline), K is interpolated linearly between keys. Without `times` the speed is constant,
    counting one radian of turning as much as `unit` of travel (default: the mean distance between
    keys); with `times` [k], increasing, progress is time. The ends are exact.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    keys = to_host(keys)
    if times is None:
        keys = keys[_distinct(keys)]
    if len(keys) == 1:
        return Cameras(np.repeat(keys.K, len(s), 0), np.repeat(keys.c2w, len(s), 0))
    travel = np.linalg.norm(np.diff(keys.centres, axis=0), axis=-1)
    unit = unit or travel.mean() or 1.0
    turns = Rotation.from_matrix(keys.c2w[:, :3, :3])
    if times is None:
        # Centripetal knots: a cubic through them does not loop where keys are unevenly spaced.
        effort = travel / unit + (turns[:-1].inv() * turns[1:]).magnitude()
        knots = np.concatenate([[0.0], np.cumsum(np.sqrt(effort))])
    else:
        knots = np.asarray(times, np.float64)
    positions = CubicSpline(knots, keys.centres, bc_type="natural")
    orientations = RotationSpline(knots, turns)
    u = knots[0] + s * (knots[-1] - knots[0])
    if times is None:
        fine = np.linspace(knots[0], knots[-1], 64 * len(keys))
        where, facing = positions(fine), orientations(fine)
        effort = np.linalg.norm(np.diff(where, axis=0), axis=-1) / unit
        effort = effort + (facing[:-1].inv() * facing[1:]).magnitude()
        travelled = np.concatenate([[0.0], np.cumsum(effort)])
        u = np.interp(s * travelled[-1], travelled, fine)
    c2w = np.tile(np.eye(4), (len(s), 1, 1))
    c2w[:, :3, :3] = orientations(u).as_matrix()
    c2w[:, :3, 3] = positions(u)
    flat = keys.K.reshape(-1, 9)
    K = np.stack([np.interp(u, knots, flat[:, i]) for i in range(9)], -1).reshape(-1, 3, 3)
    return Cameras(K, c2w)


def _distinct(cameras: Cameras) -> np.ndarray:
    """Indices of views that differ in pose from the view kept before them."""
    extent = np.linalg.norm(np.ptp(cameras.centres, axis=0))
    kept = [0]
    for view in range(1, len(cameras)):
        change = cameras.c2w[view] - cameras.c2w[kept[-1]]
        moved = np.linalg.norm(change[:3, 3]) > 1e-9 * extent
        if moved or np.abs(change[:3, :3]).max() > 1e-9:
            kept.append(view)
    return np.array(kept)
