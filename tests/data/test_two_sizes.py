"""Views at the model's and the output size: the same rays, each cut from the original."""

import numpy as np
import pytest
from PIL import Image
from scene_files import nerfstudio, truth

from roge_jax.data import two_sizes
from roge_jax.errors import UserError
from roge_jax.geometry.crops import resize
from roge_jax.scenes.scene import load_scene, prepare

SMALL, LARGE = (16, 28), (48, 84)


def rays(K, size, u, v):
    """Camera rays at the shares (u, v) of the picture."""
    return np.linalg.inv(K) @ np.array([u * size[1], v * size[0], 1.0])


def photographed(tmp_path):
    nerfstudio(tmp_path / "room", truth())
    for i, file in enumerate(sorted((tmp_path / "room").rglob("*.png"))):
        height, width = np.asarray(Image.open(file)).shape[:2]
        noise = np.random.default_rng(i).integers(0, 255, (height, width, 3), np.uint8)
        Image.fromarray(noise).save(file)
    return str(tmp_path / "room")


@pytest.mark.parametrize("kind", ["photos", "procedural"])
def test_both_sizes_show_the_same_rays(kind, tmp_path):
    name = photographed(tmp_path) if kind == "photos" else "procedural:1000000003"
    c2w, take = two_sizes.open_views(name, 3, SMALL, None, output=LARGE)
    scene = take([0], [2, 1])
    large = scene["output"]
    assert scene["rgb"].shape == (3, *SMALL, 3) and large["rgb"].shape == (3, *LARGE, 3)
    np.testing.assert_array_equal(scene["c2w"], c2w[[0, 2, 1]])
    for small_K, large_K in zip(scene["K"], large["K"]):
        for u, v in ((0, 0), (1, 0), (0.5, 1), (0.3, 0.7)):
            np.testing.assert_allclose(
                rays(small_K, SMALL, u, v), rays(large_K, LARGE, u, v), rtol=1e-12, atol=1e-12
            )


def test_photos_are_cut_from_the_originals_at_both_sizes(tmp_path):
    name = photographed(tmp_path)
    _, take = two_sizes.open_views(name, 3, SMALL, None, output=LARGE)
    scene = take([0], [1])
    for size, found in ((SMALL, scene), (LARGE, scene["output"])):
        images, cameras = prepare(load_scene(name), [0, 1], *size)
        np.testing.assert_array_equal(found["rgb"], images)
        np.testing.assert_allclose(found["K"], cameras.K, rtol=1e-12)
    # noise: of a shrunk copy, nothing but blur would be left at the output size
    enlarged = np.stack([resize(image, *LARGE) for image in scene["rgb"]])
    assert np.std(scene["output"]["rgb"]) > 1.5 * np.std(enlarged)


def test_rendered_views_are_averaged_down_and_depth_is_picked():
    _, take = two_sizes.open_views("procedural:1000000003", 3, SMALL, None, output=LARGE)
    scene = take([0, 1], [2])
    large = scene["output"]
    means = large["rgb"].reshape(3, 16, 3, 28, 3, 3).mean((2, 4))
    np.testing.assert_allclose(scene["rgb"], means, atol=1e-6)
    np.testing.assert_array_equal(scene["depth"], large["depth"][:, 1::3, 1::3])
    assert large["depth"].shape == (1, *LARGE) and large["photo_depth"].shape == (2, *LARGE)


def test_one_size_is_the_same_arrays():
    _, take = two_sizes.open_views("procedural:1000000003", 2, SMALL, None)
    scene = take([0], [1])
    assert scene["rgb"] is scene["output"]["rgb"] and scene["depth"] is scene["output"]["depth"]


def test_sizes_that_cannot_be_compared_are_refused():
    two_sizes.check_output((192, 336), (96, 160), 32)
    with pytest.raises(UserError, match=r"give a size of about that shape, e\.g\. 192x336"):
        two_sizes.check_output((192, 192), (64, 112), 32)
    with pytest.raises(UserError, match="32 x 32 pixels or more"):
        two_sizes.check_output((16, 28), (64, 112), 32)
