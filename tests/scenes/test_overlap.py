"""Photos of a large scene: far apart, but connected; what is unreadable or shares nothing does not stop the choice."""

import numpy as np
import pytest

from roge_jax import sampling
from roge_jax.config import preset
from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras
from roge_jax.procedural.scenes import sample_sequence
from roge_jax.scenes import overlap
from roge_jax.scenes.overlap import select_overlapping
from roge_jax.scenes.scene import Scene, select_context

SIZE = (128, 224)


@pytest.fixture(scope="module")
def rooms():
    """Two rooms of 6 photos each, side by side in one frame: views 0 to 5 and 6 to 11 share nothing."""
    images, K, c2w = [], [], []
    for i, seed in enumerate((1000000020, 1000000024)):
        made = sample_sequence(seed, frames=6, height=SIZE[0], width=SIZE[1], sweep=(20.0, 25.0))
        images += [rgb / np.float32(255) for rgb in made["rgb"]]
        moved = made["c2w"].copy()
        moved[:, 0, 3] += 40.0 * i
        K.append(made["K"])
        c2w.append(moved)
    cameras = Cameras(np.concatenate(K), np.concatenate(c2w))
    return Scene(images, cameras, tuple(f"{i}.png" for i in range(12)), "rooms")


def test_photos_hang_together(rooms):
    config = preset("mini")
    far = select_context(rooms, 3)
    assert len({i // 6 for i in far}) == 2  # the farthest ones lie in both rooms
    near = select_overlapping(rooms, 3, config.height, config.width)
    assert len(set(near)) == 3 and len({i // 6 for i in near}) == 1 and near == sorted(near)
    assert max(near) - min(near) >= 3  # far apart as long as they share something
    assert sampling.context_ids("3", rooms, config) == near
    assert len(sampling.context_ids(None, rooms, config)) == 6


@pytest.fixture
def row(monkeypatch):
    """choose(m, areas): from 7 views a step apart in a row, where `areas(i, j)` are the shares of both pictures that the
    matches of views i and j span; (the views, the pairs that were looked at)."""
    side = 100

    def square(area):
        return np.sqrt(area) * side * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])

    def choose(m, areas):
        asked = []

        def matches(one, other, height, width):
            asked.append((one[0], other[0]))
            return tuple(square(area) for area in areas(one[0], other[0]))

        monkeypatch.setattr(overlap, "matches_inside", matches)
        return select_overlapping(scene, m, side, side), asked

    monkeypatch.setattr(overlap, "shrink", lambda image, K: (image, K))
    monkeypatch.setattr(overlap, "features", lambda image: round(10 * float(image.mean())))
    images = [np.full((4, 4, 3), i / 10) for i in range(7)]
    c2w = np.tile(np.eye(4), (7, 1, 1))
    c2w[:, 0, 3] = np.arange(7)
    cameras = Cameras(np.tile(np.eye(3), (7, 1, 1)), c2w)
    scene = Scene(images, cameras, tuple("abcdefg"), "row")
    return choose


def test_a_photo_is_held_against_the_nearest_of_those_chosen(row):
    """Views two steps apart share enough: from the middle outwards, each hangs on its neighbour, not on the first."""
    found, asked = row(4, lambda i, j: (0.3, 0.3) if abs(i - j) <= 2 else (0.2, 0.2))
    assert found == [0, 1, 3, 5]
    assert (0, 3) in asked and (
        0,
        1,
    ) in asked  # too far from the first, and near enough to the second


def test_what_is_shared_must_be_a_quarter_of_both_pictures(row):
    """Views three steps apart fill one picture and a corner of the other: only closer ones share something."""
    for areas in ((0.9, 0.2), (0.2, 0.9)):
        found, _ = row(2, lambda i, j, areas=areas: (0.3, 0.3) if abs(i - j) == 1 else areas)
        assert found in ([2, 3], [3, 4])


def test_after_a_miss_the_next_try_is_a_quarter_closer(row):
    found, asked = row(2, lambda i, j: (0.1, 0.1))
    assert [abs(i - j) for i, j in asked] == [
        3,
        2,
        1,
        1,
    ]  # in the end the nearest, whatever it shares
    assert found == [3, 4]


def test_where_nothing_is_shared_the_nearest_is_taken(rooms):
    blank = [np.full_like(image, 0.5) for image in rooms.images]
    scene = Scene(blank, rooms.cameras, rooms.names, "blank")
    found = select_overlapping(scene, 4, 64, 112)
    assert len(set(found)) == 4 and len({i // 6 for i in found}) == 1


def test_damaged_photos_do_not_stop_the_choice(rooms):
    class Some(list):
        def __getitem__(self, i):
            if i in (1, 4, 8):
                raise UserError("cannot be read.")
            return super().__getitem__(i)

    scene = Scene(Some(rooms.images), rooms.cameras, rooms.names, "some")
    found = select_overlapping(scene, 3, 64, 112)
    assert len(set(found)) == 3 and not {1, 4, 8} & set(found)
