"""What is to be believed of a COLMAP model, and its last form: the straightened photos' cameras in an upright world.

Models are pycolmap's reconstructions, pairs are (photo, photo, its two-view geometry) with photos as numbers of the walk.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..geometry.cameras import Cameras, invert
from ..geometry.crops import scale_K
from ..geometry.trajectories import world_up
from ..scenes.colmap import make_camera
from ..scenes.lens import Lens, distorted, straighten
from ..scenes.matching import epipolar_distances

FITS = (
    3.0,
    0.003,
)  # pixels, and part of the long side: a pair's median distance from its epipolar lines
SHARED = 15  # points that two photos both see, for one to hold the other
SAMPLE = 300  # matches of a pair that are looked at
BENT = 0.5  # pixels in the corner: less distortion than that is none
TURNED = 0.05  # how far from a rotation a homography may be

Geometry = tuple[int, int, Any]


def groups(count: int, edges: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Photos that are connected by pairs, the largest group first; photos without a pair stand alone."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = np.array(edges, int).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(a)), (a, b)), (count, count))
    _, label = connected_components(graph, directed=False)
    found = [np.flatnonzero(label == k).tolist() for k in np.unique(label)]
    return sorted(found, key=lambda group: (-len(group), group))


def posed(model: Any, ids: Sequence[int]) -> list[int]:
    """The photos that a model has a pose for; ids: COLMAP's numbers of all photos."""
    return [i for i, n in enumerate(ids) if model.exists_image(n) and model.image(n).has_pose]


def c2w_of(image: Any) -> np.ndarray:
    """Camera to world [4, 4] of a registered image."""
    w2c = np.eye(4)
    w2c[:3] = image.cam_from_world().matrix()
    return invert(w2c)


def hanging_together(model: Any, ids: Sequence[int], geometries: Sequence[Geometry]) -> Any:
    """The model without what its own matches contradict: the largest group of photos, each with a partner with which it
    shares points and whose matches lie on their epipolar lines. Changes the model.

    Mappers return models whose parts are each right and wrongly placed to each other, with small reprojection errors.
    """
    registered = posed(model, ids)
    images = {i: model.image(ids[i]) for i in registered}
    points = {
        i: {p.point3D_id for p in image.points2D if p.has_point3D()} for i, image in images.items()
    }
    cameras = {
        i: Cameras(image.camera.calibration_matrix()[None], c2w_of(image)[None])
        for i, image in images.items()
    }
    edges = []
    for a, b, geometry in geometries:
        if a not in images or b not in images or len(points[a] & points[b]) < SHARED:
            continue
        matches = geometry.inlier_matches
        matches = matches[:: max(1, len(matches) // SAMPLE)]
        x, y = (
            _ideal(images[i], matches[:, side], cameras[i].K[0]) for side, i in enumerate((a, b))
        )
        camera = images[a].camera
        limit = max(FITS[0], FITS[1] * max(camera.width, camera.height))
        if np.median(epipolar_distances(x, y, cameras[a], cameras[b])) < limit:
            edges.append((a, b))
    kept = set(groups(len(ids), edges)[0]) if edges else set()
    if len(registered) > 1:
        for i in set(registered) - kept:
            model.deregister_frame(images[i].frame_id)
    return model


def _ideal(image: Any, which: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Where features of an image would lie without distortion, [p, 2]."""
    pixels = np.array([image.points2D[int(i)].xy for i in which])
    rays = np.asarray(image.camera.cam_from_img(pixels))
    return rays * K[[0, 1], [0, 1]] + K[:2, 2]


def turned_only(geometries: Sequence[Geometry], sides: Sequence[int]) -> float:
    """The share of pairs between which the camera only turned, or did not move at all: no depth can be seen there.

    A homography K R K^-1 explains their matches, for some focal length. sides: the long side of each photo's picture.
    """
    counted = found = 0
    for a, _, geometry in geometries:
        counted += 1
        name = getattr(geometry.config, "name", None) or _names()[int(geometry.config)]
        if "PANORAMIC" not in name or geometry.H is None:
            continue
        if name == "PANORAMIC" or _is_turn(np.asarray(geometry.H), geometry, sides[a]):
            found += 1
    return found / counted if counted else 0.0


def _names() -> dict[int, str]:
    import pycolmap

    kinds = pycolmap.TwoViewGeometryConfiguration.__members__
    return {int(kind): name for name, kind in kinds.items()}


def _is_turn(H: np.ndarray, geometry: Any, side: int) -> bool:
    """Whether a homography of pictures is that of a turning camera. The principal point is taken at half the long side."""
    best = np.inf
    for focal in side * np.geomspace(0.4, 4.0, 40):
        K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]])
        R = np.linalg.inv(K) @ H @ K
        R = R / np.cbrt(np.linalg.det(R))
        best = min(best, float(np.abs(R @ R.T - np.eye(3)).max()))
    return best < TURNED


def describe(model: Any, ids: Sequence[int]) -> dict[str, Any]:
    """Numbers about a model, in pixels of the small pictures."""
    registered = posed(model, ids)
    model.update_point_3d_errors()
    return {
        "registered": registered,
        "points": model.num_points3D(),
        "reprojection_error": model.compute_mean_reprojection_error(),
        "track_length": model.compute_mean_track_length(),
        "points_a_photo": model.compute_mean_observations_per_reg_image(),
    }


def finish(model: Any, ids: Sequence[int], job: Any) -> dict[str, dict[str, Any]]:
    """Turn the model upright and make its cameras those of the straightened photos at full size; changes it.

    Returns by the number of a camera: K and size of the full photo, lens or None, K and size of the straightened one.
    """
    registered = posed(model, ids)
    _stand_up(model, [model.image(ids[i]) for i in registered])
    cameras: dict[str, dict[str, Any]] = {}
    for i in registered:
        image = model.image(ids[i])
        key = str(image.camera_id)
        if key not in cameras:
            cameras[key] = _straight_camera(model.camera(image.camera_id), job.full[i])
        cameras[key].setdefault("photos", []).append(i)
        _move_features(image, cameras[key], job.copies[i])
        image.name = job.names[i]
    for key, found in cameras.items():
        camera, K = model.camera(int(key)), np.array(found["new_K"])
        camera.model = type(camera.model).PINHOLE
        camera.params = K[[0, 1, 0, 1], [0, 1, 2, 2]]
        camera.height, camera.width = found["new_size"]
    for number in list(model.images):  # what has no pose is no image of the scene
        if not model.image(number).has_pose:
            model.image(number).name = f"left out/{model.image(number).name}"
    return cameras


def _straight_camera(camera: Any, full: tuple[int, int]) -> dict[str, Any]:
    """The full photo's camera and the straightened one's, from that of the small picture."""
    parameters, full = np.array(camera.params), (int(full[0]), int(full[1]))
    K, size, lens = make_camera(
        camera.model.name, parameters, camera.width, camera.height, "the camera found"
    )
    K = scale_K(K, size, full)
    found: dict[str, Any] = {"K": K, "size": full, "lens": None, "new_K": K, "new_size": full}
    if lens is None or _bend(K, lens, full) < BENT:
        return found
    straight = straighten(K, lens, full)
    kept = {"lens": lens.coefficients, "new_K": straight.K, "new_size": straight.size}
    return found | kept | {"share": straight.share}


def _bend(K: np.ndarray, lens: Lens, size: tuple[int, int]) -> float:
    """How many pixels a lens moves the corners."""
    corners = np.array([[0, 0], [size[1], 0], [0, size[0]], size[::-1]], float)
    rays = (corners - K[:2, 2]) / K[[0, 1], [0, 1]]
    return float(np.linalg.norm((distorted(rays, lens) - rays) * K[[0, 1], [0, 1]], axis=1).max())


def _move_features(image: Any, found: dict[str, Any], copy: tuple[int, int]) -> None:
    """The features of a small picture to where they are in the straightened photo."""
    pixels = np.array([p.xy for p in image.points2D]).reshape(-1, 2)
    if not len(pixels):
        return
    full, new_K = found["size"], np.array(found["new_K"])
    if found["lens"] is None:
        moved = pixels * (full[1] / copy[1], full[0] / copy[0])
    else:
        rays = np.asarray(image.camera.cam_from_img(pixels))
        moved = rays * new_K[[0, 1], [0, 1]] + new_K[:2, 2]
    for point, xy in zip(image.points2D, moved, strict=True):
        point.xy = xy


def _stand_up(model: Any, images: Sequence[Any]) -> None:
    """The world of a scene: up is +z, the middle of the points is the origin, the typical depth of a point is 1."""
    import pycolmap

    c2w = np.stack([c2w_of(image) for image in images])
    up = world_up(Cameras(np.tile(np.eye(3), (len(c2w), 1, 1)), c2w))
    across = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    across /= np.linalg.norm(across)
    R = np.stack([across, np.cross(up, across), up])
    depths, points = [], [np.zeros(3)]
    for image, pose in zip(images, c2w, strict=True):
        seen = [model.point3D(p.point3D_id).xyz for p in image.points2D if p.has_point3D()]
        if seen:
            depths += ((np.array(seen) - pose[:3, 3]) @ pose[:3, 2]).tolist()
    if model.num_points3D():
        points = [point.xyz for point in model.points3D.values()]
    unit = 1.0 / max(float(np.median(depths or [1.0])), 1e-12)
    middle = np.median(np.array(points), axis=0)
    turn = pycolmap.Rotation3d(R)
    model.transform(pycolmap.Sim3d(unit, turn, -unit * R @ middle))
