"""Straightening: COLMAP's undistorter as oracle, properties for every lens, and what no lens can be."""

import json

import numpy as np
import pytest
import scene_files as files
from scene_files import HEIGHT, WIDTH, truth

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import CameraWarning
from roge_jax.scenes.lens import Lens, distorted, ideal_rays, straighten
from roge_jax.scenes.scene import load_scene

# COLMAP's model, its parameters without fx fy cx cy, and our lens.
LENSES = {
    "slight": ("OPENCV", (-0.02, 0.003, 0.0, 0.0), Lens("opencv", (-0.02, 0.003, 0.0, 0.0))),
    "action camera": ("OPENCV", (-0.25, 0.07, 0.001, -0.002), Lens("opencv", (-0.25, 0.07, 0.001, -0.002))),
    "strong": ("OPENCV", (-0.4, 0.12, 0.0, 0.0), Lens("opencv", (-0.4, 0.12, 0.0, 0.0))),
    "pincushion": ("OPENCV", (0.1, 0.02, 0.0, 0.0), Lens("opencv", (0.1, 0.02, 0.0, 0.0))),
    "fisheye": ("OPENCV_FISHEYE", (0.02, -0.01, 0.001, 0.0), Lens("fisheye", (0.02, -0.01, 0.001, 0.0))),
    "bare fisheye": ("OPENCV_FISHEYE", (0.0,) * 4, Lens("fisheye", (0.0,) * 4)),
}  # fmt: skip
SIZES = {"wide": (480, 640), "tall": (600, 400)}


def camera(focal: float, size: tuple[int, int]) -> np.ndarray:
    height, width = size
    return np.array([[focal, 0, 0.48 * width], [0, 1.02 * focal, 0.53 * height], [0, 0, 1.0]])


@pytest.mark.parametrize("focal", [450.0, 300.0, 260.0, 240.0])
@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("name", LENSES)
def test_colmaps_undistorter_is_the_oracle(name, shape, focal):
    """The same pinhole camera, size and all, also of wide lenses."""
    pycolmap = pytest.importorskip("pycolmap")
    model, more, lens = LENSES[name]
    size = SIZES[shape]
    K = camera(focal, size)
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *more]
    given = pycolmap.Camera(model=model, width=size[1], height=size[0], params=parameters)
    expected = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), given)
    straight = straighten(K, lens, size)
    assert straight.size == (expected.height, expected.width)
    np.testing.assert_allclose(straight.K, expected.calibration_matrix(), rtol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_pixels_stay_as_square_as_they_were(name):
    """Focal lengths, and the relative place of the principal point, are those of the photo; nothing lies outside it."""
    _, _, lens = LENSES[name]
    size = SIZES["wide"]
    K = camera(420.0, size)
    straight = straighten(K, lens, size)
    np.testing.assert_array_equal(straight.K[[0, 1], [0, 1]], K[[0, 1], [0, 1]])
    relative = straight.K[:2, 2] / straight.size[::-1]
    np.testing.assert_allclose(relative, K[:2, 2] / size[::-1])
    y, x = np.mgrid[: straight.size[0], : straight.size[1]] + 0.5
    rays = np.stack([(x - straight.K[0, 2]) / K[0, 0], (y - straight.K[1, 2]) / K[1, 1]], -1)
    seen = distorted(rays.reshape(-1, 2), lens) * K[[0, 1], [0, 1]] + K[:2, 2]
    assert (seen > -0.5).all() and (seen < np.array(size[::-1]) + 0.5).all()  # no blank pixels
    assert 0.5 < straight.share <= 1.0


@pytest.mark.parametrize("name", LENSES)
def test_rays_come_back(name):
    _, _, lens = LENSES[name]
    rng = np.random.default_rng(0)
    rays = rng.uniform(-0.7, 0.7, (200, 2))
    np.testing.assert_allclose(ideal_rays(distorted(rays, lens), lens), rays, atol=1e-6)


def lensed(tmp_path, **fields):
    folder = files.nerfstudio(tmp_path, truth())
    content = json.loads((folder / "transforms.json").read_text())
    for entry in content["frames"]:
        for field in ("fl_x", "fl_y", "cx", "cy"):
            entry.pop(field)
    content |= fields
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("degrees", [179.0, 190.0, 200.0, 240.0])
@pytest.mark.parametrize("k1", [0.0, 0.02])
def test_too_wide_for_a_flat_picture(tmp_path, degrees, k1):
    half = np.radians(degrees / 2)
    focal = 0.5 * WIDTH / (half * (1 + k1 * half**2))
    folder = lensed(tmp_path, camera_model="OPENCV_FISHEYE", fl_x=focal, k1=k1)
    with pytest.raises(UserError, match=r"a fisheye view of \d+ degrees has no flat picture"):
        load_scene(folder)


@pytest.mark.parametrize("degrees", [141.0, 160.0])
def test_a_wide_fisheye_says_what_is_lost(tmp_path, degrees):
    focal = 0.5 * WIDTH / np.radians(degrees / 2)
    folder = lensed(tmp_path, camera_model="OPENCV_FISHEYE", fl_x=focal)
    with pytest.warns(CameraWarning, match="no flat picture without loss") as told:
        scene = load_scene(folder)
    assert not any("coefficients" in str(one.message) for one in told)
    np.testing.assert_allclose(scene.cameras.K[:, 0, 0], scene.cameras.K[:, 1, 1])


GARBAGE = {
    "a failed calibration": {"fl_x": 160.0, "k1": -43.2, "k2": 988.0},
    "opposite signs": {"fl_x": 25.0, "k1": 3.0, "k2": -9.0},
    "one large coefficient": {"fl_x": 60.0, "k1": -6.0},
    "tangential": {"fl_x": 40.0, "p1": 0.25, "p2": -0.2},
}


@pytest.mark.parametrize("what", GARBAGE)
def test_coefficients_of_no_lens_are_told_with_what_they_leave(tmp_path, what):
    folder = lensed(tmp_path, camera_model="OPENCV", **GARBAGE[what])
    with pytest.warns(CameraWarning, match=r"beyond those of lenses: \d+% of the photo is left"):
        load_scene(folder)


def test_ordinary_lenses_are_a_note_only(tmp_path):
    folder = lensed(tmp_path, camera_model="OPENCV", fl_x=28.0, k1=-0.25, k2=0.07)
    scene = load_scene(folder)  # a warning would be an error here
    assert [note.severity for note in scene.notes] == ["note"]
    assert scene.sizes[0] == scene.images[0].shape[:2] != (HEIGHT, WIDTH)
