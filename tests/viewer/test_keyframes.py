"""Key frames as pure functions, and that a file of them is the same path for `sample --trajectory`."""

import numpy as np
import pytest
from camera_cases import looking_at_origin

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras
from roge_jax.scenes.paths import load_path, save_path
from roge_jax.viewer import keyframes
from roge_jax.viewer.keyframes import LEAST, added, changed, count, removed, times

SIZE = (192, 336)
CONTEXT = looking_at_origin(3, height=192, width=336)


@pytest.fixture
def keys():
    found = ()
    for i, c2w in enumerate(looking_at_origin(4, height=192, width=336).c2w):
        found = added(found, c2w, 30.0 + 5 * i)
    return found


def test_key_frames_are_added_in_place(keys):
    new = np.eye(4)
    assert len(added((), new, 40.0)) == 1
    assert np.array_equal(added(keys, new, 40.0)[-1].c2w, new)
    between = added(keys, new, 40.0, after=1)
    assert np.array_equal(between[2].c2w, new) and between[3] is keys[2] and len(keys) == 4


def test_taking_one_away_leaves_the_time_of_the_others(keys):
    keys = changed(changed(keys, 1, seconds=2.0), 2, seconds=0.5)
    before = times(keys)
    np.testing.assert_allclose(times(removed(keys, 1)), before[[0, 2, 3]])
    np.testing.assert_allclose(times(removed(keys, 3)), before[:3])
    np.testing.assert_allclose(times(removed(keys, 0)), before[1:] - before[1])
    assert removed(keys[:1], 0) == ()


def test_what_cannot_be_is_refused(keys):
    for wrong in ({"fov": 180.0}, {"fov": 0.0}, {"seconds": 0.0}, {"seconds": float("nan")}):
        with pytest.raises(UserError):
            changed(keys, 1, **wrong)
    with pytest.raises(UserError, match="no key frames"):
        keyframes.path((), SIZE, 16.0)
    with pytest.raises(UserError, match="at most"):
        keyframes.path(changed(keys, 1, seconds=1e5), SIZE, 16.0)


def test_the_path_passes_through_the_key_frames_at_their_times(keys):
    keys = changed(changed(keys, 1, seconds=0.5), 3, seconds=2.0)
    path = keyframes.path(keys, SIZE, 10.0)
    assert len(path) == count(keys, 10.0) == 36
    at = np.rint(10 * times(keys)).astype(int)
    np.testing.assert_allclose(path.c2w[at], np.stack([key.c2w for key in keys]), atol=1e-9)
    angles = 2 * np.degrees(np.arctan(0.5 * 192 / path.K[at, 1, 1]))
    np.testing.assert_allclose(angles, [key.fov for key in keys], atol=1e-9)


def test_one_key_frame_is_one_picture_and_two_alike_stand_still(keys):
    assert len(keyframes.path(keys[:1], SIZE, 16.0)) == 1
    still = keyframes.path(added(keys[:1], keys[0].c2w, keys[0].fov), SIZE, 16.0)
    assert len(still) == 17 and np.ptp(still.c2w, axis=0).max() < 1e-12


def test_a_file_is_the_same_path_for_sample(keys, tmp_path):
    """Also at another size: K goes along."""
    keys, file = changed(keys, 2, seconds=0.3), tmp_path / "path.json"
    keyframes.write(file, keys, SIZE, 12.0)
    read = load_path(file, height=64, width=112, context=CONTEXT)
    ours = keyframes.path(keys, (64, 112), 12.0)
    np.testing.assert_allclose(read.c2w, ours.c2w, atol=1e-9)
    np.testing.assert_allclose(read.K, ours.K, rtol=1e-9)


def test_what_is_written_is_read_again(keys, tmp_path):
    keys, file = changed(keys, 3, seconds=4.0), tmp_path / "path.json"
    keyframes.write(file, keys, SIZE, 12.0)
    again, fps = keyframes.read(file, SIZE, CONTEXT, None)
    assert fps == 12.0 and len(again) == 4
    for a, b in zip(again, keys, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-9)
        assert a.fov == pytest.approx(b.fov)
    np.testing.assert_allclose(times(again), times(keys))


def test_a_path_of_frames_becomes_a_few_key_frames(keys, tmp_path):
    path, file = keyframes.path(keys, SIZE, 16.0), tmp_path / "frames.json"
    save_path(file, path, *SIZE, fps=16.0)
    found, fps = keyframes.read(file, SIZE, CONTEXT, None)
    assert len(found) == keyframes.THINNED and fps == 16.0
    again = keyframes.path(found, SIZE, 16.0)
    assert len(again) == len(path)
    assert np.abs(again.centres - path.centres).max() < 0.02 * np.ptp(path.centres, axis=0).max()


def test_a_single_frame_is_one_key_frame(tmp_path):
    save_path(tmp_path / "one.json", Cameras(CONTEXT.K[:1], CONTEXT.c2w[:1]), *SIZE)
    found, _ = keyframes.read(tmp_path / "one.json", SIZE, CONTEXT, None)
    assert len(found) == 1 and found[0].seconds >= LEAST
