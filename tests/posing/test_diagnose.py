"""What a run's numbers mean, and what of a model is believed."""

from types import SimpleNamespace

import numpy as np
import pytest
from camera_cases import looking_at_origin

from roge_jax.geometry.cameras import invert
from roge_jax.posing import diagnose, models

NAMES = [f"IMG_{i}.jpg" for i in range(10)]
SHARP = [0.9] * 10
FOUND = {
    "features": [3000] * 10,
    "partners": [4] * 10,
    "pairs_tried": 45,
    "pairs_matched": 30,
    "matches": 80.0,
    "turned_only": 0.1,
}
SOLVED = FOUND | {
    "registered": list(range(10)),
    "models": [["incremental", 10]],
    "mapper": "incremental",
    "reprojection_error": 0.5,
}


@pytest.mark.parametrize(
    ("change", "sharpness", "said"),
    [
        ({}, [0.2] * 8 + [0.9] * 2, "8 of 10 photos are blurred: hold the camera still"),
        ({"features": [20] * 7 + [900] * 3}, SHARP, "7 of 10 photos show almost nothing"),
        ({"turned_only": 0.95}, SHARP, "all photos are from one place .* 95% .* Walk"),
        (
            {"pairs_matched": 2, "matches": 18.0},
            SHARP,
            "too little in common .2 of 45 pairs of 10 photos match, with a median of 18 matches",
        ),
        ({"pairs_matched": 0, "matches": 0.0}, SHARP, "too little in common .0 of 45"),
        ({}, SHARP, "still no poses fit them: the camera moved too little"),
    ],
)
def test_why_there_are_no_poses(change, sharpness, said):
    import re

    assert re.search(said, diagnose.why_nothing(FOUND | change, sharpness))


def test_a_solution_without_faults_has_no_notes():
    assert diagnose.notes(SOLVED, NAMES, SHARP, thorough=False) == []


def test_photos_that_are_left_out_are_named_with_the_reason():
    found = SOLVED | {
        "registered": [0, 1, 2, 3, 4],
        "features": [3000] * 8 + [50, 3000],
        "partners": [4] * 7 + [0, 4, 4],
        "models": [["incremental", 5], ["incremental", 3], ["global", 4]],
    }
    said = diagnose.notes(found, NAMES, [*SHARP[:9], 0.1], thorough=False)
    assert said[0].startswith("5 of 10 photos have no pose and are left out: IMG_5.jpg, IMG_6.jpg")
    assert "and 1 more" in said[0]
    text = "\n".join(said)
    assert "1 of these are blurred: take them again (IMG_9.jpg)" in text
    assert "(IMG_8.jpg)" in text and "show almost nothing" in text
    assert "1 of these match no other photo: take more in between (IMG_7.jpg)" in text
    assert "fall apart into parts of 5, 3" in text and "--thorough" in text
    assert "--thorough" not in "\n".join(diagnose.notes(found, NAMES, SHARP, thorough=True))


def test_doubtful_solutions_are_told():
    text = "\n".join(
        diagnose.notes(
            SOLVED | {"reprojection_error": 3.2, "focal_held": True}, NAMES, SHARP, thorough=False
        )
    )
    assert "3.2 pixels" in text and "focal length is EXIF's" in text


# ---- models: stand-ins for pycolmap's reconstructions ----------------------------------------------


class Pose:
    def __init__(self, w2c):
        self.w2c = w2c

    def matrix(self):
        return self.w2c[:3]


class Camera:
    """A pinhole camera of 640 x 480."""

    width, height = 640, 480
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])

    def calibration_matrix(self):
        return self.K

    def cam_from_img(self, pixels):
        return (pixels - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]


def reconstruction(c2w, xyz, seen):
    """A model in which image i sees the points seen[i], exactly, and is registered at c2w[i]."""
    images = {}
    for i, pose in enumerate(c2w):
        local = (xyz[seen[i]] - pose[:3, 3]) @ pose[:3, :3]
        pixels = local[:, :2] / local[:, 2:] * 500.0 + (320, 240)
        points = [
            SimpleNamespace(xy=xy, point3D_id=int(p), has_point3D=lambda: True)
            for xy, p in zip(pixels, seen[i], strict=True)
        ]
        images[i + 1] = SimpleNamespace(
            points2D=points, camera=Camera(), has_pose=True, frame_id=i + 1, pose=pose
        )
    for image in images.values():
        image.cam_from_world = lambda image=image: Pose(invert(image.pose))

    def drop(frame):
        images[frame].has_pose = False

    return SimpleNamespace(
        image=images.__getitem__, exists_image=images.__contains__, deregister_frame=drop
    )


def scene_of_two_parts():
    """8 cameras; 0..4 and 5..7 share points within and, few matches, with each other."""
    c2w = looking_at_origin(8, height=480, width=640).c2w
    xyz = np.random.default_rng(0).uniform(-0.5, 0.5, (80, 3))
    seen = [np.arange(80)] * 8
    geometry = SimpleNamespace(inlier_matches=np.stack([np.arange(80)] * 2, 1))
    pairs = [(a, b, geometry) for a in range(8) for b in range(a)]
    return c2w, xyz, seen, pairs


def test_right_models_stay_whole():
    c2w, xyz, seen, pairs = scene_of_two_parts()
    model = models.hanging_together(reconstruction(c2w, xyz, seen), range(1, 9), pairs)
    assert models.posed(model, range(1, 9)) == list(range(8))


def test_parts_that_are_wrongly_placed_are_cut_off():
    """Every feature lies where its own part puts it; between the parts matches contradict the poses."""
    c2w, xyz, seen, pairs = scene_of_two_parts()
    moved = np.eye(4)
    moved[:3, 3] = (1.5, -0.7, 0.4)
    model = reconstruction(c2w, xyz, seen)
    for i in (5, 6, 7):
        model.image(i + 1).pose = moved @ c2w[i]
    model = models.hanging_together(model, range(1, 9), pairs)
    assert models.posed(model, range(1, 9)) == [0, 1, 2, 3, 4]


def test_a_photo_that_shares_no_points_is_left_out():
    c2w, xyz, seen, pairs = scene_of_two_parts()
    model = reconstruction(c2w, xyz, [*seen[:7], np.arange(5)])
    kept = models.hanging_together(model, range(1, 9), pairs[:21])
    assert models.posed(kept, range(1, 9)) == list(range(7))


def test_groups():
    assert models.groups(6, [(0, 1), (4, 5), (1, 2)]) == [[0, 1, 2], [4, 5], [3]]
    assert models.groups(2, []) == [[0], [1]]


def test_pairs_that_only_turn_are_told_from_planes():
    """The homography of a turning camera is K R K^-1; that of a plane is not."""
    from scipy.spatial.transform import Rotation

    K = np.array([[700.0, 0, 320], [0, 700, 320], [0, 0, 1]])
    R = Rotation.from_euler("xyz", (8, -15, 3), degrees=True).as_matrix()
    turn = K @ R @ np.linalg.inv(K)
    plane = K @ (R + np.outer([0.3, 0.1, 0.2], [0, 0, 1.0])) @ np.linalg.inv(K)

    def pair(H, name):
        return (0, 1, SimpleNamespace(H=2.5 * H, config=SimpleNamespace(name=name)))

    flat = "PLANAR_OR_PANORAMIC"
    assert models.turned_only([pair(turn, flat)], [640]) == 1.0
    assert models.turned_only([pair(plane, flat)], [640]) == 0.0
    assert models.turned_only([pair(turn, "CALIBRATED")], [640]) == 0.0
    assert models.turned_only([], []) == 0.0
