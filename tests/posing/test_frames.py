"""Which frames of a video become photos."""

import struct

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.files.video_io import write_video
from roge_jax.posing import frames
from roge_jax.posing.frames import Looked, choose, extract, measure
from roge_jax.scenes.images import read_image


def looked(motion, sharpness=None) -> Looked:
    motion = np.array(motion, float)
    sharpness = np.ones(len(motion)) if sharpness is None else np.array(sharpness, float)
    return Looked(3 * np.arange(len(motion)), sharpness, motion)


def test_photos_are_spread_over_the_motion_not_over_time():
    """A camera that rests for half of the video: no more photos there than anywhere else."""
    motion = [0.0] + [0.02] * 50 + [0.0] * 100 + [0.02] * 50
    chosen = np.array(choose(looked(motion), 11)) // 3
    assert len(chosen) == 11 and chosen[0] <= 5 and chosen[-1] >= 190
    way = np.cumsum(motion)[chosen]
    assert np.diff(way).min() > 0.05 and np.diff(way).max() < 0.35
    assert ((chosen > 55) & (chosen < 145)).sum() <= 1


def test_the_sharpest_frame_around_each_place_is_taken():
    sharpness = np.tile([1.0, 9.0, 1.0, 2.0], 30)
    chosen = np.array(choose(looked([0.01] * 120, sharpness), 12)) // 3
    assert (sharpness[chosen] == 9.0).all()
    assert (np.diff(chosen) > 0).all()


def test_the_number_follows_the_motion_within_bounds():
    assert len(choose(looked([0.0] + [0.01] * 99))) == round(0.99 / frames.STEP) + 1
    assert len(choose(looked([0.0] + [0.005] * 40))) == frames.FEWEST
    assert len(choose(looked([0.0] + [0.05] * 2000))) == frames.MOST


def test_a_camera_that_stands_still_has_no_poses():
    with pytest.raises(UserError, match=r"hardly moves.*walking around"):
        choose(looked([0.0] + [0.0005] * 100))


def film(blurred=()) -> np.ndarray:
    """30 frames of a camera that passes a wall, some of them blurred."""
    import cv2

    noise = np.random.default_rng(0).integers(0, 255, (60, 190, 3), np.uint8)
    wall = cv2.resize(noise, (760, 240), interpolation=cv2.INTER_CUBIC)
    made = [wall[:192, 14 * i : 14 * i + 256] for i in range(30)]
    return np.stack(
        [cv2.GaussianBlur(f, (0, 0), 4) if i in blurred else f for i, f in enumerate(made)]
    )


def test_a_video_is_measured_and_its_frames_are_written(tmp_path):
    blurred = (4, 5, 11, 20, 21)
    video = write_video(tmp_path / "walk.mp4", film(blurred), fps=10)
    found = measure(video)
    assert found.index.tolist() == list(range(30)) and found.motion[0] == 0
    moved = np.median(found.motion[1:])
    np.testing.assert_allclose(moved, 14 / 256, rtol=0.1)
    order = np.argsort(found.sharpness)
    assert set(order[: len(blurred)]) == set(blurred)
    chosen = choose(found, 8)
    assert not set(chosen) & set(blurred)
    files = extract(video, chosen, tmp_path)
    assert [int(file.stem) for file in files] == chosen
    pixels = 255.0 * read_image(files[3])
    assert np.abs(pixels - film()).mean((1, 2, 3)).argmin() == chosen[3]


def test_a_phone_held_upright_gives_upright_photos(tmp_path):
    """Phones store upright videos lying down, with a matrix in the track's header that turns them clockwise."""
    video = write_video(tmp_path / "walk.mp4", film()[:3], fps=10)
    data = bytearray(video.read_bytes())
    matrix = data.index(b"tkhd") + 44
    assert struct.unpack_from(">9i", data, matrix) == (1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, matrix, 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    (file := tmp_path / "turned.mp4").write_bytes(data)
    (tmp_path / "out").mkdir()
    turned, lying = (read_image(extract(v, [1], tmp_path / "out")[0]) for v in (file, video))
    np.testing.assert_allclose(turned, np.rot90(lying, -1), atol=0.1)


def test_files_that_are_no_videos_are_named(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    with pytest.raises(UserError, match=r"a.mp4: cannot be read as a video .* convert it to MP4"):
        measure(tmp_path / "a.mp4")
