"""What can be wrong with a camera, where, and how to mend it. Plain arrays, all findings."""

import dataclasses
from collections.abc import Sequence

import numpy as np

# ||R^T R - I||_F: below the first a rotation is taken as it is, below the second it is moved to the
# nearest rotation (0.5 degrees of ray error at most), above it the matrix is something else and
# guessing would hide a mistake.
ACCEPT, PROJECT = 1e-5, 1e-2
FOCAL_RANGE = (0.05, 50.0)  # focal length / image width: views of 168 down to 1.1 degrees
FARTHEST = 1e100  # squares of positions must not overflow
WIDE_FOV = 120.0  # degrees


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that is wrong (`error`), doubtful (`warning`) or worth knowing (`note`)."""

    severity: str
    where: str
    what: str
    fix: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}; {self.fix}."


def nearest_rotation(R: np.ndarray) -> np.ndarray:
    """The rotation closest to R [3, 3] in the Frobenius norm (polar factor by SVD)."""
    u, _, vt = np.linalg.svd(R)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def inspect_pose(pose: np.ndarray, where: str) -> tuple[np.ndarray, list[Finding]]:
    """One c2w [4, 4] or [3, 4]: as [4, 4], mended where that is safe, and what was found."""

    def found(severity, what, fix):
        return Finding(severity, f"{where}, c2w", what, fix)

    if pose.shape not in ((4, 4), (3, 4)):
        return pose, [found("error", f"shape {pose.shape}", "give a 4x4 or 3x4 matrix")]
    if not np.isfinite(pose).all():
        row, column = np.argwhere(~np.isfinite(pose))[0]
        what = f"entry [{row}, {column}] is {pose[row, column]}"
        return pose, [found("error", what, "remove or fix this view")]
    if np.abs(pose).max() > FARTHEST:
        what = f"an entry is {pose.flat[np.abs(pose).argmax()]:.3g}"
        return pose, [found("error", what, "no position is that far away, correct it")]
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
    if not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
        transposed = np.allclose(pose[:, 3], [0, 0, 0, 1], rtol=0, atol=1e-6)
        fix = "it looks transposed, transpose it" if transposed else "it must be 0 0 0 1"
        return pose, [found("error", f"last row is {_numbers(pose[3])}", fix)]
    R = pose[:3, :3]
    determinant = np.linalg.det(R)
    size = np.cbrt(abs(determinant))
    if size == 0.0 or np.linalg.cond(R) > 1e6:
        return pose, [found("error", "the rotation part is singular", "give a rotation matrix")]
    if determinant < 0:
        fix = "left-handed axes: flip one axis of the source, or check its convention"
        return pose, [found("error", f"mirrored, det R = {determinant:.3g}", fix)]
    deviation = np.linalg.norm(R.T @ R - np.eye(3))
    if deviation < ACCEPT:
        return pose, []
    if deviation < PROJECT:
        mended = pose.copy()
        mended[:3, :3] = nearest_rotation(R)
        angle = np.degrees(np.linalg.norm(R - mended[:3, :3], 2))
        what = f"R is not orthonormal, |R^T R - I| = {deviation:.1e}, the nearest rotation is used"
        fix = f"rays move by at most {angle:.2g} degrees; write more digits"
        return mended, [found("warning", what, fix)]
    if np.linalg.norm(R.T @ R / size**2 - np.eye(3)) < PROJECT:
        fix = f"divide the rotation part by {size:.6g} and keep the translation"
        return pose, [found("error", f"R carries a scale of {size:.4g}", fix)]
    what = f"R is no rotation, |R^T R - I| = {deviation:.2g}"
    return pose, [found("error", what, "remove shear and scale")]


def inspect_intrinsics(K: np.ndarray, height: int, width: int, where: str) -> list[Finding]:
    """One K [3, 3] in pixels of its height x width image."""

    def found(severity, what, fix):
        return Finding(severity, f"{where}, K", what, fix)

    if K.shape != (3, 3):
        return [found("error", f"shape {K.shape}", "give a 3x3 matrix")]
    if not np.isfinite(K).all():
        row, column = np.argwhere(~np.isfinite(K))[0]
        what = f"entry [{row}, {column}] is {K[row, column]}"
        return [found("error", what, "remove or fix this view")]
    tolerance = 1e-6 * max(1.0, np.abs(K).max())
    if abs(K[1, 0]) > tolerance or not np.allclose(K[2], [0, 0, 1], rtol=0, atol=1e-6):
        upper = np.allclose(np.tril(K.T, -1), 0, atol=tolerance)
        fix = "it must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
        fix = f"it looks transposed, {fix}" if upper else fix
        return [found("error", f"not upper triangular, rows {_numbers(K.ravel())}", fix)]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if fx <= 0 or fy <= 0:
        fix = "it must be positive; a negative one usually means OpenGL axes, flip the pose instead"
        return [found("error", f"focal length fx = {fx:.6g}, fy = {fy:.6g}", fix)]
    if max(fx, fy) < 10 and -1 < cx < 2 and -1 < cy < 2 and min(height, width) > 4:
        fix = f"it looks normalised, multiply row 1 by {width} and row 2 by {height}"
        what = f"fx = {fx:.4g}, cx = {cx:.4g} in a picture {width} pixels wide"
        return [found("error", what, fix)]
    if min(fx, fy) < 2:
        what = f"focal length fx = {fx:.4g}, fy = {fy:.4g} pixels"
        return [found("error", what, "give it in pixels")]
    if not (0 < cx < width and 0 < cy < height):
        what = f"principal point ({cx:.1f}, {cy:.1f}) outside the {width} x {height} picture"
        fix = f"if K is for about {2 * cx:.0f} x {2 * cy:.0f}, scale it to the picture"
        return [found("error", what, fix)]
    findings = []
    if not FOCAL_RANGE[0] <= fx / width <= FOCAL_RANGE[1]:
        fix = f"{FOCAL_RANGE[0]} to {FOCAL_RANGE[1]} times the width is usual, check the units"
        findings.append(found("warning", f"focal length fx = {fx:.6g} for a width of {width}", fix))
    horizontal = np.degrees(np.arctan(cx / fx) + np.arctan((width - cx) / fx))
    vertical = np.degrees(np.arctan(cy / fy) + np.arctan((height - cy) / fy))
    if max(horizontal, vertical) > WIDE_FOV:
        what = f"field of view {horizontal:.0f} x {vertical:.0f} degrees"
        fix = "so wide a view has no flat picture without loss: crop it, or choose a narrower lens"
        findings.append(found("warning", what, fix))
    if not 0.5 < fx / fy < 2:
        what = f"fx / fy = {fx / fy:.3g}"
        fix = "the pixels are far from square, check which picture size K is for"
        findings.append(found("warning", what, fix))
    off_x, off_y = 2 * cx / width, 2 * cy / height
    if abs(off_x - 1) > 0.3 and abs(off_x / off_y - 1) < 0.1:
        what = f"principal point ({cx:.1f}, {cy:.1f}) in a {width} x {height} picture"
        fix = f"check that K is not for a picture of {2 * cx:.0f} x {2 * cy:.0f}"
        findings.append(found("warning", what, fix))
    return findings


def inspect_arrays(
    K: np.ndarray,
    c2w: np.ndarray,
    height: int | Sequence[int],
    width: int | Sequence[int],
    names: Sequence[str],
    read_as: str = "",
) -> tuple[np.ndarray, np.ndarray, list[Finding]]:
    """All views, K [v, 3, 3] and c2w [v, 4, 4] or [v, 3, 4]: in float64, mended where safe."""
    if len(K) != len(c2w):
        what = f"{len(K)} intrinsics for {len(c2w)} poses"
        return K, c2w, [Finding("error", "cameras", what, "give one K per view")]
    if K.ndim != 3 or c2w.ndim != 3 or K.dtype.kind not in "iuf" or c2w.dtype.kind not in "iuf":
        what = f"K is {K.dtype} {K.shape} and c2w {c2w.dtype} {c2w.shape}"
        fix = "give numbers, K [views, 3, 3] and c2w [views, 4, 4]"
        return K, c2w, [Finding("error", "cameras", what, fix)]
    if len(names) != len(c2w) or any(np.size(n) not in (1, len(c2w)) for n in (height, width)):
        what = (
            f"{len(names)} names or {np.size(height)} x {np.size(width)} sizes for {len(c2w)} poses"
        )
        return K, c2w, [Finding("error", "cameras", what, "give one per view")]
    heights = np.broadcast_to(np.asarray(height), (len(c2w),))
    widths = np.broadcast_to(np.asarray(width), (len(c2w),))
    poses, findings = [], []
    for view, (pose, name) in enumerate(zip(c2w, names, strict=True)):
        where = f"view {view} ({name})"
        pose, about_pose = inspect_pose(np.asarray(pose, np.float64), where)
        poses.append(pose)
        findings += about_pose
        findings += inspect_intrinsics(
            np.asarray(K[view], np.float64), int(heights[view]), int(widths[view]), where
        )
    if not any(f.severity == "error" for f in findings):
        c2w = np.stack(poses) if poses else np.zeros((0, 4, 4))
        findings += inspect_axes(c2w, read_as)
    return np.asarray(K, np.float64), np.asarray(c2w, np.float64), findings


def axes_votes(c2w: np.ndarray) -> tuple[int, int]:
    """(front, behind): pairs of views whose optical axes meet in front of both, or behind both.

    Photos of one thing look at it, so their axes meet in front. Under a wrong convention (OpenGL
    read as OpenCV) every axis is reversed and they meet behind. Pairs whose axes differ by less
    than 5 degrees say nothing.
    """
    centres, axes = c2w[:, :3, 3], c2w[:, :3, 2]
    front = behind = 0
    for i in range(len(c2w)):
        for j in range(i + 1, len(c2w)):
            cosine = axes[i] @ axes[j]
            determinant = 1.0 - cosine**2
            if determinant < np.sin(np.radians(5.0)) ** 2:
                continue
            between = centres[j] - centres[i]
            along_i = (between @ axes[i] - cosine * (between @ axes[j])) / determinant
            along_j = (cosine * (between @ axes[i]) - between @ axes[j]) / determinant
            nearest = centres[i] + along_i * axes[i] - centres[j] - along_j * axes[j]
            if np.linalg.norm(nearest) > 0.5 * np.linalg.norm(between):
                continue  # the axes pass far from each other: these two look at different things
            front += int(along_i > 0 and along_j > 0)
            behind += int(along_i < 0 and along_j < 0)
    return front, behind


def inspect_axes(c2w: np.ndarray, read_as: str = "") -> list[Finding]:
    """A warning if the cameras seem to look away from what they should share (see `axes_votes`).

    read_as: the convention that they were read in, if the user may choose another.
    """
    c2w = c2w[:: max(1, len(c2w) // 40)]
    front, behind = axes_votes(c2w)
    if behind < 2 or behind < 4 * front:
        return []
    what = f"the optical axes meet behind the cameras in {behind} of {front + behind} pairs"
    other = "opencv" if read_as.startswith("opengl") else "opengl"
    name = {"opencv": "OpenCV", "opengl": "OpenGL"}[other]
    read = f", not '{read_as}' as they were read" if read_as else ""
    fix = (
        f"unless it is an outward panorama, its axes may be {name}{read}: try convention='{other}'"
    )
    return [Finding("warning", "cameras", what, fix)]


def _numbers(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
