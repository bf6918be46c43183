"""Camera-path errors: alignment, APE, RPE, and when a path is too straight to judge rotations.

Poses are camera-to-world [n, 4, 4]; any camera axes will do as long as both paths use the same.
All float64 NumPy. Conventions follow the trajectory-evaluation literature (Umeyama 1991 for the
alignment; Sturm et al. 2012 for APE and RPE) and are spelled out in docs/reference/metrics.md.
"""

from typing import Any, NamedTuple

import numpy as np

from roge_jax.errors import UserError

MIN_COVERAGE = 0.9  # fewer registered frames than this: the scene counts as failed
MAX_AMBIGUITY_DEG = 0.5  # above: APE-R says more about the path's shape than about the rotations
STRAIGHT = 1e-9  # relative: below it the roll about the line is not determined at all


class Alignment(NamedTuple):
    """x -> scale * rotation @ x + translation."""

    scale: float
    rotation: np.ndarray  # [3, 3]
    translation: np.ndarray  # [3]

    def points(self, x: np.ndarray) -> np.ndarray:
        """[n, 3] -> [n, 3]."""
        return self.scale * x @ self.rotation.T + self.translation

    def poses(self, c2w: np.ndarray) -> np.ndarray:
        """[n, 4, 4] -> [n, 4, 4]: centres move by the similarity, orientations only turn."""
        out = np.array(c2w, np.float64)
        out[:, :3, :3] = self.rotation @ out[:, :3, :3]
        out[:, :3, 3] = self.points(out[:, :3, 3])
        return out


def rotation_angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle in degrees between rotations [..., 3, 3]: 2 asin(|a - b|_F / (2 sqrt 2)).

    The chordal form keeps its digits at small angles, where arccos((trace - 1) / 2) returns 0.
    """
    chord = np.linalg.norm(np.asarray(a, np.float64) - np.asarray(b, np.float64), axis=(-2, -1))
    return np.degrees(2.0 * np.arcsin(np.minimum(chord / (2.0 * np.sqrt(2.0)), 1.0)))


def umeyama(estimate: np.ndarray, reference: np.ndarray, *, with_scale: bool = True) -> Alignment:
    """The similarity that takes points `estimate` [n, 3] to `reference` [n, 3], least squares.

    Umeyama 1991, eqs. 40-42: never a reflection. Raises if all estimated points coincide. For
    points on a line the turn about it is arbitrary; `straightness` tells.
    """
    estimate, reference = _points(estimate), _points(reference)
    if estimate.shape != reference.shape:
        raise UserError(
            f"umeyama takes two equally long lists of points [n, 3], not {estimate.shape} and {reference.shape}."
        )
    mean_e, mean_r = estimate.mean(axis=0), reference.mean(axis=0)
    e, r = estimate - mean_e, reference - mean_r
    variance = np.mean(np.sum(e**2, axis=1))
    if variance <= (1e-12 * np.abs(estimate).max(initial=0.0)) ** 2:
        raise UserError(
            "umeyama cannot align points that all coincide; give a path that moves, or compare rotations only."
        )
    rotation, trace = _procrustes(r.T @ e / len(e))
    scale = trace / variance if with_scale else 1.0
    return Alignment(float(scale), rotation, mean_r - scale * rotation @ mean_e)


def align_rotations(estimate: np.ndarray, reference: np.ndarray) -> Alignment:
    """Alignment whose rotation is the chordal mean of R_reference R_estimate^T; poses [n, 4, 4].

    Scale and translation follow by least squares on the centres. Unlike `umeyama` it does not
    depend on the shape of the path: it is exact for straight lines and for pure rotation (where
    the scale, which nothing determines, is 1).
    """
    estimate, reference = _poses("estimate", estimate), _poses("reference", reference)
    rotation, _ = _procrustes(
        np.einsum("nij,nkj->ik", reference[:, :3, :3], estimate[:, :3, :3]) / len(estimate)
    )
    centre_e, centre_r = estimate[:, :3, 3], reference[:, :3, 3]
    mean_e, mean_r = centre_e.mean(axis=0), centre_r.mean(axis=0)
    turned = (centre_e - mean_e) @ rotation.T
    energy = np.sum(turned**2)
    moves = energy > len(turned) * (1e-12 * np.abs(centre_e).max(initial=0.0)) ** 2
    scale = float(np.sum(turned * (centre_r - mean_r)) / energy) if moves else 1.0
    return Alignment(scale, rotation, mean_r - scale * rotation @ mean_e)


def straightness(centres: np.ndarray) -> float:
    """s2 / s1 of the centred camera centres [n, 3]: 0 is a straight line, 1 a circle or a blob.

    0 too if the centres all coincide (no rotation can be recovered from them either).
    """
    s = _spread(_points(centres))
    return float(s[1] / s[0]) if s[0] > 0.0 else 0.0


def alignment_ambiguity(centres: np.ndarray, position_sigma: float) -> float:
    """Expected error in degrees of the turn about the path's main line when aligning by positions.

    sigma_position / (sqrt(n) * r), r the RMS distance of the true centres [n, 3] to their
    principal line; `position_sigma` is the noise of an estimated centre per axis, same unit.
    Capped at 180, the value for a perfectly straight path.
    """
    s = _spread(_points(centres))
    reach = float(np.sqrt(np.sum(s[1:] ** 2)))  # sqrt(n) * r
    if reach <= STRAIGHT * s[0] or s[0] == 0.0:
        return 180.0
    return float(min(np.degrees(position_sigma / reach), 180.0))


def path_length(centres: np.ndarray) -> float:
    """Sum of the distances between consecutive centres [n, 3]."""
    return float(np.sum(np.linalg.norm(np.diff(_points(centres), axis=0), axis=1)))


def relative_pose_errors(
    estimate: np.ndarray, reference: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Translation norms and angles (degrees) of (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), j = i + 1: [n-1] each.

    Q is the reference, P the estimate, both [n, 4, 4]; the estimate must already have the
    reference's scale. No alignment is needed: a rigid motion of either path changes nothing.
    """
    estimate, reference = _poses("estimate", estimate), _poses("reference", reference)
    inverse_e, inverse_r = np.linalg.inv(estimate[:-1]), np.linalg.inv(reference[:-1])
    error = np.linalg.inv(inverse_r @ reference[1:]) @ (inverse_e @ estimate[1:])
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angle(error[:, :3, :3], np.eye(3))


def trajectory_errors(
    estimate: np.ndarray,
    reference: np.ndarray,
    *,
    unit_length: bool = True,
    min_coverage: float = MIN_COVERAGE,
    max_ambiguity_deg: float = MAX_AMBIGUITY_DEG,
) -> dict[str, Any]:
    """All path errors of an estimated path against the true one, both c2w [n, 4, 4].

    Rows of `estimate` that are not finite are frames the estimator could not place. With
    `unit_length` the true path (all of it) is divided by its length first, so translations are
    fractions of the path; otherwise they are in the unit of `reference`.

    Returned: `status` ('ok', 'failed: ...', 'no translation'), `coverage`,
    `ape_t`, `ape_r` (RMSE after Umeyama Sim(3) on positions; degrees), `ape_r_rot` (RMSE degrees
    after the chordal mean of the rotations), `rpe_t`, `rpe_r` (RMSE over consecutive registered
    frames, scale from Umeyama), `straightness`, `ambiguity_deg` (predicted from `ape_t`),
    `ape_r_reliable`, `path_length`. Numbers that do not exist are NaN. A scene whose status is
    'failed' has NaN errors on purpose: count it, do not drop it.
    """
    estimate = np.asarray(estimate, np.float64)
    reference = _poses("reference", reference)
    if estimate.shape != reference.shape or len(reference) < 3:
        raise UserError(
            "trajectory_errors needs two paths [n, 4, 4] of the same n >= 3, "
            f"not {estimate.shape} and {reference.shape}."
        )
    length = path_length(reference[:, :3, 3])
    still = length <= 1e-12 * np.abs(reference[:, :3, 3]).max(initial=0.0)
    if unit_length and not still:
        reference = reference.copy()
        reference[:, :3, 3] /= length
    seen = np.isfinite(estimate).all(axis=(1, 2))
    nan = float("nan")
    result: dict[str, Any] = {
        "status": "ok",
        "coverage": float(seen.mean()),
        **dict.fromkeys(("ape_t", "ape_r", "ape_r_rot", "rpe_t", "rpe_r"), nan),
        "straightness": straightness(reference[:, :3, 3]),
        "ambiguity_deg": nan,
        "ape_r_reliable": False,
        "path_length": length,
        "unit_length": unit_length,
    }
    if result["coverage"] < min_coverage or seen.sum() < 3:
        result["status"] = f"failed: {seen.sum()} of {len(seen)} frames registered"
        return result
    est, ref = _poses("estimate", estimate[seen]), reference[seen]
    result["ape_r_rot"] = _rms(
        rotation_angle(align_rotations(est, ref).poses(est)[:, :3, :3], ref[:, :3, :3])
    )
    consecutive = np.diff(np.flatnonzero(seen)) == 1
    _, angles = relative_pose_errors(est, ref)
    result["rpe_r"] = _rms(angles[consecutive])
    if still:
        result["status"] = "no translation"
        return result
    try:
        alignment = umeyama(est[:, :3, 3], ref[:, :3, 3])
    except UserError:
        result["status"] = "failed: all estimated centres coincide"
        return result
    aligned = alignment.poses(est)
    result["ape_t"] = _rms(np.linalg.norm(aligned[:, :3, 3] - ref[:, :3, 3], axis=1))
    shifts, _ = relative_pose_errors(aligned, ref)
    result["rpe_t"] = _rms(shifts[consecutive])
    # the residual is the noise of three axes
    result["ambiguity_deg"] = alignment_ambiguity(ref[:, :3, 3], result["ape_t"] / np.sqrt(3.0))
    if straightness(ref[:, :3, 3]) > STRAIGHT:
        result["ape_r"] = _rms(rotation_angle(aligned[:, :3, :3], ref[:, :3, :3]))
        result["ape_r_reliable"] = result["ambiguity_deg"] <= max_ambiguity_deg
    return result


def _procrustes(covariance: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation R that maximises tr(R^T covariance), and that trace."""
    u, d, vt = np.linalg.svd(covariance)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    return (u * sign) @ vt, float(np.sum(d * sign))


def _spread(centres: np.ndarray) -> np.ndarray:
    """Singular values [3] of the centred points; rounding noise of coincident points is 0."""
    centred = centres - centres.mean(axis=0)
    s = np.zeros(3)
    values = np.linalg.svd(centred, compute_uv=False)
    s[: len(values)] = values
    return s if s[0] > 1e-13 * np.sqrt(len(centres)) * np.abs(centres).max(initial=0.0) else 0.0 * s


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else float("nan")


def _points(x: np.ndarray) -> np.ndarray:
    x = np.asarray(x, np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or not len(x) or not np.isfinite(x).all():
        raise UserError(f"Expected finite points [n, 3], got an array of shape {x.shape}.")
    return x


def _poses(name: str, x: np.ndarray) -> np.ndarray:
    x = np.asarray(x, np.float64)
    if x.ndim != 3 or x.shape[1:] != (4, 4) or not len(x):
        raise UserError(f"{name} must be poses [n, 4, 4], not {x.shape}.")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=(1, 2)))
    if len(bad):
        raise UserError(f"{name}: the pose of view {bad[0]} is not finite.")
    gram = np.einsum("nji,njk->nik", x[:, :3, :3], x[:, :3, :3])
    off = np.abs(gram - np.eye(3)).max(axis=(1, 2))
    if off.max() > 1e-3:
        raise UserError(
            f"{name}: the rotation of view {off.argmax()} is off by {off.max():.1e} from orthonormal; "
            "give camera-to-world matrices without scale."
        )
    return x
