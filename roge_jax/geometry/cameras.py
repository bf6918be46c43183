"""Cameras: the struct, conventions, the world frame and scale that the networks expect.

Conventions (docs/explanation/conventions.md): `c2w` is camera-to-world with OpenCV axes (x right, y down, z
forward), `K` is in pixels of its own image, pixel edges lie at 0..W and pixel centres at +0.5.
Everything here is float64 NumPy until a scene has been re-centred by `normalise`: in float32 a
scene at UTM coordinates loses its rays altogether.
"""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from roge_jax.errors import UserError, did_you_mean
from roge_jax.files.fields import number
from roge_jax.geometry.crops import crop_resize, crop_resize_K, resize, scale_K, shift_K, turn
from roge_jax.geometry.validation import FARTHEST, Finding, inspect_arrays

__all__ = [
    "CONVENTIONS",
    "CameraWarning",
    "Cameras",
    "Normalisation",
    "camera_vector",
    "concatenate",
    "crop_resize",
    "crop_resize_K",
    "field_of_view",
    "inspect",
    "invert",
    "normalise",
    "opencv_to_opengl",
    "opengl_to_opencv",
    "quaternion",
    "relative_to",
    "resize",
    "rotation",
    "scale_K",
    "shift_K",
    "to_host",
    "to_opencv",
    "turn",
    "validate",
]

CONVENTIONS = ("opencv", "opencv_w2c", "opengl", "opengl_w2c")
MOST_WARNINGS = 5  # of one scene
RULES = {"lagernvs": 1.35, "paper": 1.0}
_FLIP = np.array([1.0, -1.0, -1.0, 1.0])  # OpenGL and OpenCV axes differ by the signs of y and z


class CameraWarning(UserWarning):
    """Something about the cameras that the user should know, but that does not stop the run."""


@struct.dataclass
class Cameras:
    """Pinhole cameras: K [..., v, 3, 3] in pixels, c2w [..., v, 4, 4] camera-to-world, OpenCV axes.

    NumPy or JAX arrays; all functions of this module that need float64 convert to it.
    """

    K: Any
    c2w: Any

    def __len__(self) -> int:
        return self.c2w.shape[-3]

    def __getitem__(self, index: Any) -> "Cameras":
        """A subset of [v] cameras: a slice, a list or an array of views; an int keeps one view."""
        if isinstance(index, (int, np.integer)):
            index = [int(index)]
        elif not isinstance(index, slice):
            index = np.asarray(index) if len(index) else slice(0)
        return Cameras(self.K[index], self.c2w[index])

    @property
    def centres(self) -> Any:
        """Camera centres [..., v, 3] in world units."""
        return self.c2w[..., :3, 3]


def to_host(cameras: Cameras) -> Cameras:
    """The same cameras as float64 NumPy."""
    return Cameras(np.asarray(cameras.K, np.float64), np.asarray(cameras.c2w, np.float64))


def checked_views(cameras: Cameras, name: str) -> Cameras:
    """`to_host` of cameras [v]. Raises UserError unless there is one finite K and c2w for each of one or more views."""
    if not isinstance(cameras, Cameras):
        raise UserError(
            f"The {name} cameras are given as {type(cameras).__name__}: give roge_jax.Cameras(K, c2w)."
        )
    try:
        cameras = to_host(cameras)
    except (TypeError, ValueError) as error:
        raise UserError(f"The {name} cameras are no arrays of numbers ({error}).") from None
    K, c2w = cameras.K.shape, cameras.c2w.shape
    if len(K) != 3 or len(c2w) != 3 or K[1:] != (3, 3) or c2w[1:] != (4, 4) or K[0] != c2w[0]:
        raise UserError(
            f"The {name} cameras have K of shape {K} and c2w of shape {c2w}: give [views, 3, 3] and [views, 4, 4]."
        )
    if not len(cameras):
        raise UserError(f"There are no {name} views: give at least one {name} camera.")
    bad = ~np.isfinite(cameras.c2w).all((1, 2)) | ~np.isfinite(cameras.K).all((1, 2))
    if bad.any():
        view = int(np.argmax(bad))
        raise UserError(f"{name} view {view} has NaN or infinite numbers in K or c2w: fix it.")
    if np.abs(cameras.c2w).max() > FARTHEST:
        view = int(np.argmax(np.abs(cameras.c2w).max((1, 2))))
        raise UserError(
            f"{name} view {view} is {np.abs(cameras.c2w[view]).max():.3g} away: fix its c2w."
        )
    return cameras


def concatenate(*cameras: Cameras) -> Cameras:
    """All views in order, e.g. contexts then targets."""
    use = jnp if any(isinstance(c.c2w, jax.Array) for c in cameras) else np
    return Cameras(
        use.concatenate([c.K for c in cameras], axis=-3),
        use.concatenate([c.c2w for c in cameras], axis=-3),
    )


def invert(pose: np.ndarray) -> np.ndarray:
    """The inverse of rigid poses [..., 4, 4] by transposing R: c2w <-> w2c."""
    turned = np.swapaxes(pose[..., :3, :3], -1, -2)
    inverse = np.zeros_like(pose)
    inverse[..., :3, :3] = turned
    inverse[..., :3, 3] = -(turned @ pose[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def relative_to(origin: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """inv(origin) @ poses; positions are subtracted before rotating, so huge offsets cancel."""
    turned = origin[:3, :3].T
    relative = np.zeros_like(poses)
    relative[..., :3, :3] = turned @ poses[..., :3, :3]
    relative[..., :3, 3] = (poses[..., :3, 3] - origin[:3, 3]) @ turned.T
    relative[..., 3, 3] = 1.0
    return relative


def opengl_to_opencv(c2w: np.ndarray) -> np.ndarray:
    """c2w [..., 4, 4] from OpenGL camera axes (y up, view along -z) to OpenCV. Its own inverse."""
    return c2w * _FLIP.reshape((1,) * (c2w.ndim - 1) + (4,))


opencv_to_opengl = opengl_to_opencv


def to_opencv(poses: np.ndarray, convention: str) -> np.ndarray:
    """Poses [..., 4, 4] written in `convention` (one of CONVENTIONS) as OpenCV camera-to-world."""
    if convention not in CONVENTIONS:
        raise UserError(
            f"Unknown camera convention '{convention}': {did_you_mean(convention, CONVENTIONS)}"
        )
    poses = np.asarray(poses, np.float64)
    if convention.endswith("_w2c"):
        poses = np.linalg.inv(poses)
    return opengl_to_opencv(poses) if convention.startswith("opengl") else poses


def other_conventions(cameras: "Cameras", convention: str) -> "dict[str, Cameras]":
    """{convention: cameras} of the same written poses, had they been read as each convention but `convention`."""
    written = opencv_to_opengl(cameras.c2w) if convention.startswith("opengl") else cameras.c2w
    written = np.linalg.inv(written) if convention.endswith("_w2c") else written
    others = (other for other in CONVENTIONS if other != convention)
    return {other: Cameras(cameras.K, to_opencv(written, other)) for other in others}


def rotation(quaternion_xyzw: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (scalar last, any length but zero)."""
    x, y, z, w = np.moveaxis(
        quaternion_xyzw / np.linalg.norm(quaternion_xyzw, axis=-1, keepdims=True), -1, 0
    )
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternion(R: Any) -> Any:
    """Quaternions [..., 4] as (x, y, z, w) with w >= 0 of rotations [..., 3, 3]. NumPy or JAX.

    Of the four formulas (one per component under the root) the one with the largest component is
    used, so that the division is never by less than 1/2 for a rotation.
    """
    use = jnp if isinstance(R, jax.Array) else np
    r = [[R[..., i, j] for j in range(3)] for i in range(3)]
    wx, wy, wz = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    xy, xz, yz = r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]
    # Four times the square of each component, in the order x, y, z, w.
    squares = use.stack(
        [
            1 + r[0][0] - r[1][1] - r[2][2],
            1 - r[0][0] + r[1][1] - r[2][2],
            1 - r[0][0] - r[1][1] + r[2][2],
            1 + r[0][0] + r[1][1] + r[2][2],
        ],
        -1,
    )
    rows = [
        [squares[..., 0], xy, xz, wx],
        [xy, squares[..., 1], yz, wy],
        [xz, yz, squares[..., 2], wz],
        [wx, wy, wz, squares[..., 3]],
    ]
    candidates = use.stack([use.stack(row, -1) for row in rows], -2)
    best = use.argmax(squares, -1)[..., None]
    picked = use.take_along_axis(candidates, best[..., None], -2)[..., 0, :]
    q = picked / (2.0 * use.sqrt(use.take_along_axis(squares, best, -1)))
    return use.where(q[..., 3:] < 0, -q, q)


def field_of_view(K: Any, height: int, width: int) -> tuple[Any, Any]:
    """(vertical, horizontal) angles in radians, as LagerNVS: the principal point is ignored."""
    use = jnp if isinstance(K, jax.Array) else np
    return 2 * use.arctan(0.5 * height / K[..., 1, 1]), 2 * use.arctan(0.5 * width / K[..., 0, 0])


def camera_vector(
    cameras: Cameras, height: int, width: int, camera_scale: float, points_flag: float
) -> Any:
    """What the encoder is told about a camera: LagerNVS's 11 numbers, float32 [..., v, 11].

    [t (3, camera centre), q (4, x y z w of c2w, w >= 0), fov_h, fov_w (radians), camera_scale,
    points_flag]. `cameras` are normalised, K in pixels of a height x width image.
    """
    use = jnp if isinstance(cameras.c2w, jax.Array) else np
    fov_h, fov_w = field_of_view(cameras.K, height, width)
    scale = use.broadcast_to(use.asarray(camera_scale, fov_h.dtype), fov_h.shape)
    flag = use.broadcast_to(use.asarray(points_flag, fov_h.dtype), fov_h.shape)
    numbers = use.stack([fov_h, fov_w, scale, flag], -1)
    vector = use.concatenate([cameras.centres, quaternion(cameras.c2w[..., :3, :3]), numbers], -1)
    return vector.astype(use.float32)


@dataclasses.dataclass(frozen=True)
class Normalisation:
    """How `normalise` moved a scene: x_normalised = R0^T (x - t0) / divisor, origin = [R0, t0].

    status: "ok", "single_view" (one context) or "coincident_centres" (contexts that differ only in
      rotation); in the last two the photos do not fix a scale.
    camera_scale, points_flag: the two scale numbers of the camera vector.
    context_reach, target_reach: largest distances from the first context, in scene units.
    """

    origin: np.ndarray
    divisor: float
    status: str
    rule: str
    camera_scale: float
    points_flag: float
    context_reach: float
    target_reach: float
    notes: tuple[str, ...] = ()

    def apply(self, cameras: Cameras) -> Cameras:
        """Other cameras of the same scene in the same normalised frame (float64)."""
        cameras = to_host(cameras)
        c2w = relative_to(self.origin, cameras.c2w)
        c2w[..., :3, 3] /= self.divisor
        return Cameras(cameras.K, c2w)

    def undo(self, cameras: Cameras) -> Cameras:
        """Cameras of the normalised frame back in the scene's own frame and unit (float64)."""
        cameras = to_host(cameras)
        c2w = cameras.c2w.copy()
        c2w[..., :3, 3] *= self.divisor
        return Cameras(cameras.K, self.origin @ c2w)


def normalise(
    context: Cameras,
    target: Cameras,
    *,
    rule: str = "lagernvs",
    scale: float | None = None,
    degenerate: str = "targets",
) -> tuple[Cameras, Cameras, Normalisation]:
    """First context = world frame; one divisor brings positions to the scale the networks know.

    Args:
      context: cameras of the photos [m] in the scene's frame and unit.
      target: cameras of the path [n], likewise.
      rule: "lagernvs" divides by 1.35 * the largest distance of a context from the first (what the
        LagerNVS weights were trained on), "paper" by 1.0 * that distance.
      scale: a divisor chosen by the user, in scene units; overrides the rule.
      degenerate: with one context, or contexts in one place, that distance is 0. "targets" takes
        the targets' largest distance instead (1 if that is 0 too); "one" keeps the scene's unit, as
        LagerNVS does for a single view.
    Returns: (context, target, info), float64 NumPy.

    Whether centres coincide is decided relative to the targets' reach and to the rounding of the
    input, so the result does not depend on the scene's unit.
    """
    context, target = checked_views(context, "context"), checked_views(target, "target")
    if rule not in RULES:
        raise UserError(f"Unknown scale rule '{rule}': {did_you_mean(rule, RULES)}")
    if degenerate not in ("targets", "one"):
        raise UserError(
            f"degenerate='{degenerate}' is unknown: {did_you_mean(degenerate, ('targets', 'one'))}"
        )
    if scale is not None and not 0 < number(scale, "The scene", "scale") < np.inf:
        raise UserError(
            f"The scene scale {scale} cannot be a divisor: give a positive number in scene units."
        )

    origin = context.c2w[0]
    moved_context, moved_target = relative_to(origin, context.c2w), relative_to(origin, target.c2w)
    reach = float(np.linalg.norm(moved_context[:, :3, 3], axis=-1).max())
    target_reach = float(np.linalg.norm(moved_target[:, :3, 3], axis=-1).max())
    # Positions of size x carry about 1e-16 x of rounding each; a thousand times that is still
    # nothing but rounding.
    rounding = 1e-13 * max(np.abs(context.centres).max(), np.abs(target.centres).max())
    status = "ok"
    if len(context) == 1:
        status = "single_view"
    elif reach <= max(1e-6 * target_reach, rounding):
        status = "coincident_centres"

    notes = []
    if scale is not None:
        divisor = float(scale)
    elif status == "ok":
        divisor = RULES[rule] * reach
    else:
        usable = degenerate == "targets" and target_reach > rounding
        divisor = RULES[rule] * target_reach if usable else 1.0
        why = {"single_view": "one context view"}.get(status, "contexts that share one centre")
        source = "taken from the targets" if usable else "left as it is"
        notes.append(f"{why}: the photos fix no scale, it is {source} (divisor {divisor:.6g})")
    if status == "ok" and target_reach > 10 * reach:
        ratio = target_reach / reach
        notes.append(
            f"the targets reach {ratio:.0f} times as far as the contexts: much is invented"
        )
    c2w = [moved_context.copy(), moved_target.copy()]
    for poses in c2w:
        poses[:, :3, 3] /= divisor
    info = Normalisation(
        origin=origin,
        divisor=divisor,
        status=status,
        rule=rule,
        camera_scale=reach / divisor if status == "ok" else 0.0,
        points_flag=0.0 if status == "ok" else 1.0,
        context_reach=reach,
        target_reach=target_reach,
        notes=tuple(notes),
    )
    return Cameras(context.K, c2w[0]), Cameras(target.K, c2w[1]), info


def inspect(
    cameras: Cameras,
    height: int | Sequence[int],
    width: int | Sequence[int],
    names: Sequence[str] | None = None,
    read_as: str = "",
) -> tuple[Cameras, list[Finding]]:
    """All that is wrong with cameras, without raising: (cameras mended where safe, findings)."""
    names = names or [f"{view}" for view in range(len(cameras.c2w))]
    K, c2w, findings = inspect_arrays(
        np.asarray(cameras.K), np.asarray(cameras.c2w), height, width, names, read_as
    )
    return Cameras(K, c2w), findings


def validate(
    cameras: Cameras,
    height: int | Sequence[int],
    width: int | Sequence[int],
    names: Sequence[str] | None = None,
    read_as: str = "",
) -> Cameras:
    """The cameras in float64 if they can be used; slight skew is mended with a CameraWarning.

    Args:
      cameras: K in pixels of images of `height` x `width`.
      height: of the images, one number or one per view.
      width: likewise.
      names: of the views, for messages.
      read_as: the convention that the poses were read in, if the user may choose another.
    Raises: UserError naming the view and the field: NaN, mirrored, scaled or sheared rotation,
      wrong last row, focal length that is no focal length in pixels, principal point outside the
      picture.
    """
    cameras, findings = inspect(cameras, height, width, names, read_as)
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        more = f" {len(errors) - 1} more: run python -m roge_jax.check." if len(errors) > 1 else ""
        raise UserError(f"{errors[0]}{more}")
    for finding in findings[:MOST_WARNINGS]:
        warnings.warn(str(finding), CameraWarning, stacklevel=2)
    if len(findings) > MOST_WARNINGS:
        more = f"{len(findings) - MOST_WARNINGS} more like these: run python -m roge_jax.check."
        warnings.warn(more, CameraWarning, stacklevel=2)
    return cameras


def scale_focal(cameras: Cameras, factor: float) -> Cameras:
    """Both focal lengths (and skew) times `factor`; the principal point stays."""
    cameras = to_host(cameras)
    K = cameras.K.copy()
    K[:, :2, :2] *= factor
    return Cameras(K, cameras.c2w)
