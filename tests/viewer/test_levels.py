"""Levels of detail: from quick to fine, in the model's own limits, and which of them one moves at."""

import dataclasses

import pytest

from roge_jax.config import PRESETS, preset
from roge_jax.viewer.levels import FLUID, NEAREST, Pace, levels

PHOTO = (1080, 1920)


def test_mini_moves_at_128x224():
    quick, own, fine = levels(preset("mini"), [PHOTO] * 6)
    assert quick.size == (128, 224) and own.size == (192, 336) and fine.size == (384, 672)
    assert (quick.config.recon_height, quick.config.recon_width) == (32, 56)
    assert (quick.photos, own.photos) == (NEAREST, 6)
    assert own.config == preset("mini")


def test_pictures_are_not_made_finer_than_the_photos():
    assert [one.size for one in levels(preset("mini"), [(200, 350)] * 2)] == [
        (128, 224),
        (192, 336),
    ]
    assert len(levels(preset("mini"), [PHOTO, (200, 350)])) == 2  # one coarse photo decides


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("size", [None, (96, 160), (160, 96)])
def test_every_model_has_a_quick_level_that_it_can_run(name, size):
    config = preset(name) if size is None else preset(name).for_pictures(*size)
    found = levels(config, [PHOTO])
    for level in found:
        dataclasses.replace(level.config)  # a configuration checks itself
        assert level.photos == 1
    quick, own = found[0].config, found[1].config
    assert quick.recon_height * quick.recon_width <= own.recon_height * own.recon_width
    assert found[0].size[0] <= found[1].size[0]


def test_one_moves_at_the_finest_level_that_is_known_to_be_fluid():
    pace, ready = Pace((None, None, None)), [True, True, True]
    assert pace.moving(ready) == 0
    pace = pace.after(0, 3 * FLUID)
    assert pace.moving(ready) == 0  # a slow machine has nothing better
    pace = pace.after(1, 0.5 * FLUID)
    assert pace.moving(ready) == 1 and pace.moving([True, False, True]) == 0
    for _ in range(20):
        pace = pace.after(1, 2 * FLUID)  # it has become slow: another program, say
    assert pace.moving(ready) == 0
    assert pace.seconds[2] is None
