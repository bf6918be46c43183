"""Who gets the next picture: no threads, no clock, no pictures."""

import pytest

from roge_jax.viewer.desk import SETTLED, WINDOW, Desk

ALL = [True, True, True]


def made(desk, task, now):
    assert task is not None
    return desk.made(task, now)


def test_the_newest_pose_wins():
    desk = Desk()
    for i in range(5):
        desk.ask("a", f"pose {i}", 0.1 * i)
    task = desk.next(0, ALL, 0.5)
    assert (task.camera, task.level) == ("pose 4", 0)
    made(desk, task, 0.5)
    assert desk.next(0, ALL, 0.5) is None  # the four before it are never made


def test_a_picture_of_an_old_pose_does_not_count_for_the_new_one():
    desk = Desk()
    desk.ask("a", "old", 0.0)
    task = desk.next(0, ALL, 0.0)
    desk.ask("a", "new", 0.05)  # while the old one is being made
    made(desk, task, 0.1)
    again = desk.next(0, ALL, 0.1)
    assert (again.camera, again.level) == ("new", 0)


def test_who_stands_still_is_shown_finer_pictures_one_after_another():
    desk = Desk()
    desk.ask("a", "pose", 0.0)
    made(desk, desk.next(0, ALL, 0.0), 0.05)
    assert desk.next(0, ALL, SETTLED[1] - 0.01) is None
    finer = desk.next(0, ALL, SETTLED[1])
    assert finer.level == 1
    made(desk, finer, 0.3)
    assert desk.next(0, ALL, SETTLED[2] - 0.01) is None
    finest = desk.next(0, ALL, SETTLED[2])
    assert finest.level == 2
    made(desk, finest, 1.0)
    assert desk.next(0, ALL, 100.0) is None
    desk.ask("a", "elsewhere", 100.0)
    assert desk.next(0, ALL, 100.0).level == 0  # coarse again while it moves


def test_with_a_fast_machine_one_moves_at_a_finer_level():
    desk = Desk()
    desk.ask("a", "pose", 0.0)
    task = desk.next(1, ALL, 0.0)
    assert task.level == 1
    made(desk, task, 0.01)
    assert desk.next(1, ALL, SETTLED[1]).level == 2


def test_a_level_that_is_not_ready_is_wanted_and_not_made():
    desk = Desk()
    desk.ask("a", "pose", 0.0)
    ready = [True, False, True]
    assert desk.wanted(0, ready, 1.0) is None  # not even the coarse one was shown
    made(desk, desk.next(0, ready, 0.0), 0.0)
    assert desk.wanted(0, ready, SETTLED[1] / 2) is None
    assert desk.next(0, ready, 1.0) is None and desk.wanted(0, ready, 1.0) == 1
    assert desk.next(0, ALL, 1.0).level == 1 and desk.wanted(0, ALL, 1.0) is None


def test_movers_come_before_those_who_stand_and_wait_in_turn():
    desk = Desk()
    desk.ask("still", "pose", 0.0)
    made(desk, desk.next(0, ALL, 0.0), 0.0)
    served = []
    for i in range(6):
        now = 1.0 + 0.1 * i
        desk.ask("b", i, now)
        desk.ask("c", i, now)
        task = desk.next(0, ALL, now)
        served.append(task.who)
        made(desk, task, now)
    assert served == ["b", "c"] * 3 or served == ["c", "b"] * 3


def test_who_has_left_is_not_served():
    desk = Desk()
    desk.ask("a", "pose", 0.0)
    task = desk.next(0, ALL, 0.0)
    desk.leave("a")
    assert not desk.made(task, 0.1) and desk.next(0, ALL, 9.0) is None
    assert desk.rate("a", 0.1) == 0.0


def test_the_rate_is_that_of_the_last_seconds():
    desk = Desk()
    for i in range(40):
        desk.ask("a", i, 0.1 * i)
        made(desk, desk.next(0, ALL, 0.1 * i), 0.1 * i)
    assert desk.rate("a", 3.9) == pytest.approx(10.0, rel=0.06)
    assert desk.rate("a", 3.9 + 2 * WINDOW) == 0.0
