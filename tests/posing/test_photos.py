"""Photos that are to be posed: which files, what EXIF says, names in the new scene, pairs to match."""

import numpy as np
import pytest
import scene_files as files
from PIL import Image

from roge_jax.errors import UserError
from roge_jax.posing import pairs, photos
from roge_jax.posing.photos import exif_focal, find_photos, make_copy, read_shot, scene_names

SIZE = (3000, 4000)  # diagonal 5000


@pytest.mark.parametrize(
    ("tags", "pixels"),
    [
        ({photos.FOCAL_35: 26}, 26 / 43.27 * 5000),
        ({photos.FOCAL_35: 26, photos.FOCAL: 4.2}, 26 / 43.27 * 5000),
        # 4.2 mm on a sensor of 4000 pixels over 5.6 mm
        ({photos.FOCAL: 4.2, photos.PLANE_X: 4000 / 5.6 * 25.4, photos.PLANE_UNIT: 2}, 3000.0),
        ({photos.FOCAL: 4.2, photos.PLANE_X: 4000 / 0.56, photos.PLANE_UNIT: 3}, 3000.0),
        # the file was shrunk to half after it was taken
        (
            {photos.FOCAL: 4.2, photos.PLANE_X: 8000 / 5.6 * 25.4, photos.PIXELS_X: 8000},
            3000.0,
        ),
        ({photos.FOCAL: 4.2}, None),
        ({photos.FOCAL_35: 0}, None),
        ({photos.FOCAL_35: 9000}, None),
        ({photos.FOCAL_35: "wide", photos.FOCAL: None}, None),
        ({}, None),
    ],
)
def test_focal_length_from_exif(tags, pixels):
    found = exif_focal(tags, SIZE)
    assert found is None if pixels is None else found == pytest.approx(pixels)


def photo(file, *, orientation=1, focal_35=None, size=(40, 24)):
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif[photos.MODEL] = "phone"
    if focal_35:
        exif.get_ifd(photos.EXIF_IFD)[photos.FOCAL_35] = focal_35
    image = Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8))
    file.parent.mkdir(parents=True, exist_ok=True)
    image.save(file, exif=exif)
    return file


def test_photos_of_one_lens_share_a_camera_turned_ones_do_not(tmp_path):
    level = read_shot(photo(tmp_path / "a.jpg", focal_35=26))
    again = read_shot(photo(tmp_path / "b.jpg", focal_35=26))
    upright = read_shot(photo(tmp_path / "c.jpg", orientation=6, focal_35=26))
    zoomed = read_shot(photo(tmp_path / "d.jpg", focal_35=52))
    assert level.size == (24, 40) and upright.size == (40, 24)
    assert level.camera == again.camera
    assert len({level.camera, upright.camera, zoomed.camera}) == 3
    assert upright.focal == pytest.approx(level.focal) and zoomed.focal == pytest.approx(
        2 * level.focal
    )
    assert read_shot(photo(tmp_path / "e.jpg")).focal is None


def test_copies_are_upright_and_small(tmp_path):
    shot = read_shot(photo(tmp_path / "c.jpg", orientation=6, size=(400, 240)))
    assert make_copy(shot, tmp_path, "copy.jpg", 100) == (100, 60)
    with Image.open(tmp_path / "copy.jpg") as picture:
        assert picture.size == (60, 100)


def test_what_a_place_holds(tmp_path):
    for name in ("IMG_10.jpg", "IMG_9.jpg", "._IMG_9.jpg", "IMG_9_mask.png"):
        files.save(tmp_path / "a" / name, files.picture(0))
    assert [f.name for f in find_photos(tmp_path / "a")[0]] == ["IMG_9.jpg", "IMG_10.jpg"]
    files.save(tmp_path / "b" / "images" / "1.png", files.picture(0))
    assert len(find_photos(tmp_path / "b")[0]) == 1
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "walk.MOV").write_bytes(b"")
    assert find_photos(tmp_path / "c") == ([], tmp_path / "c" / "walk.MOV")
    (tmp_path / "c" / "more.mp4").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("x")
    files.save(tmp_path / "d" / "monday" / "1.png", files.picture(0))
    for name, message in (
        ("nothing", "no such folder of photos, and no such video"),
        ("empty", "has no photos in it: give the folder that holds"),
        ("d", r"has no photos in it \(.*monday has some\)"),
        ("c", "has 2 videos and no photos: give one, e.g."),
        ("a/IMG_9.jpg", "is one photo, which has nothing to be matched with"),
        ("notes.txt", "is neither a folder of photos nor a video"),
    ):
        with pytest.raises(UserError, match=message):
            find_photos(tmp_path / name)


def test_names_in_the_scene_are_different():
    from pathlib import Path

    given = [Path("a/1.jpg"), Path("b/1.png"), Path("c/my photo.heic"), Path("d/1.JPG")]
    names = scene_names(given, [".jpg", ".jpg", ".jpg", ".jpg"])
    assert names == ["1.jpg", "1_2.jpg", "my_photo.jpg", "1_3.jpg"]


# ---- pairs ----------------------------------------------------------------------------------------


def test_few_photos_are_matched_with_all():
    assert pairs.way_for(pairs.ALL, False) == pairs.way_for(20, True) == "exhaustive"
    assert len(pairs.choose_pairs(20, "exhaustive", pytest.fail)) == 190


def test_a_video_is_matched_along_its_way_and_where_it_comes_back():
    assert pairs.way_for(100, True) == "sequential"
    alike = np.zeros((100, 100))
    alike[3, 97] = alike[97, 3] = 1.0
    found = pairs.choose_pairs(100, "sequential", lambda: alike)
    assert {(i, i + 1) for i in range(99)} <= set(found) and (40, 50) in found
    assert (3, 97) in found and (40, 75) not in found
    assert len(found) < 2500 and all(i < j for i, j in found)


def test_many_photos_are_matched_with_those_that_look_like_them():
    assert pairs.way_for(100, False) == "retrieval"
    rng = np.random.default_rng(0)
    scenes = rng.integers(0, 255, (2, 300, 128))
    descriptors = [
        np.clip(scenes[i % 2] + rng.normal(0, 10, (300, 128)), 0, 255).astype(np.uint8)
        for i in range(60)
    ]
    alike = pairs.likeness(descriptors)
    np.testing.assert_allclose(np.diag(alike), 1.0, atol=1e-5)
    same = np.equal.outer(np.arange(60) % 2, np.arange(60) % 2)
    assert alike[same].min() > alike[~same].max()
    np.testing.assert_array_equal(alike, pairs.likeness(descriptors))  # the seed is fixed
    found = pairs.choose_pairs(60, "retrieval", lambda: alike)
    assert np.mean([(i - j) % 2 == 0 for i, j in found]) > 0.85
    assert pairs.likeness([np.zeros((0, 128), np.uint8)] * 3).shape == (3, 3)
