"""Frames that are not generated: which ones, what is shown for them, what that costs; on the tiny model, windows of nine."""

import dataclasses
import functools
import itertools
import types

import jax
import numpy as np
import pytest
from test_cost import multiplied
from test_planning import TABLE

import roge_jax as rj
from roge_jax import cost, model, sampling
from roge_jax.config import preset
from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras, normalise
from roge_jax.geometry.trajectories import make_path
from roge_jax.planning import stretches
from roge_jax.planning.options import Prices, full_choices, list_options
from roge_jax.sampling import programs, video, windows
from roge_jax.scenes import coverage

CONFIG = dataclasses.replace(preset("tiny"), frames=9)
SHORT = dataclasses.replace(CONFIG, frames=5)
SETTINGS = sampling.Settings(steps=2, solver="euler", schedule="uniform")
SIZE = (CONFIG.height, CONFIG.width)


@pytest.fixture(scope="module")
def weights():
    params = model.init(jax.random.key(0), CONFIG)
    rng = np.random.default_rng(0)
    for head in (params["dit"]["head"]["linear"], params["renderer"]["rgb_head"]["linear"]):
        head["kernel"] = np.asarray(0.1 * rng.standard_normal(head["kernel"].shape), np.float32)
    return params


@pytest.fixture(scope="module")
def photos():
    """Two, side by side."""
    c2w = np.tile(np.eye(4), (2, 1, 1))
    c2w[1, 0, 3] = 0.2
    w, h = CONFIG.width, CONFIG.height
    K = np.tile(np.array([[w, 0, w / 2], [0, w, h / 2], [0, 0, 1.0]]), (2, 1, 1))
    images = np.random.default_rng(1).random((2, h, w, 3), np.float32)
    return sampling.Photos(images, None, Cameras(K, c2w), (0, 1))


@pytest.fixture(scope="module")
def path(photos):
    """Five views between the photos, then four turned away from all that they show."""
    c2w = np.tile(np.eye(4), (9, 1, 1))
    c2w[:, 0, 3] = np.linspace(0.0, 0.2, 9)
    c2w[5:, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    return Cameras(np.repeat(photos.cameras.K[:1], 9, 0), c2w)


@pytest.fixture(scope="module")
def cache():
    return {}


@pytest.fixture(scope="module")
def run(weights, photos, cache):
    def sample(path, generate, frames, **settings):
        choices = full_choices(photos, CONFIG, path, SETTINGS)
        choices = dataclasses.replace(choices, generate=generate, frames=frames)
        plan = types.SimpleNamespace(choices=choices, ids=photos.ids)
        own = dataclasses.replace(SETTINGS, **settings)
        return sampling.sample(weights, CONFIG, photos, path, own, plan=plan, cache=cache)

    return sample


# ---- which frames ----------------------------------------------------------------------------------


def test_a_partly_seen_path_has_its_unseen_frames_generated(weights, photos, path):
    seen = coverage.by_frame(photos.cameras, path, *SIZE)
    assert seen[:5].min() > 0.5 > 0.1 > seen[5:].max()
    average = photos._replace(images=np.zeros_like(photos.images))  # no detail to say otherwise
    more = {"settings": SETTINGS, "table": TABLE, "probe": 0.0}
    strict, partly, loose = (
        rj.plan(weights, CONFIG, average, path, tolerance=tolerance, **more)
        for tolerance in (0.03, 0.07, 0.2)
    )
    assert partly.choices.generate == ((4, 9),) and partly.choices.frames == 5
    assert partly.predicted_cost < 0.6 * strict.predicted_cost
    assert "; 5 of 9 frames are generated (4 to 8)" in partly.explain()
    assert "; every frame of 9 is generated" in strict.explain()
    assert "; no frame of 9 is generated" in loose.explain()
    assert "frames generated 0 -> 5" in partly.explain()


def test_stretches_begin_where_slots_end_and_have_one_length():
    config = dataclasses.replace(CONFIG, frames=17)
    assert stretches.lengths(config) == [5, 9, 13, 17]
    assert stretches.lengths(dataclasses.replace(CONFIG, frames=81)) == [21, 41, 61, 81]
    assert stretches.places((17, 34), 9) == [(17, 26), (21, 30), (25, 34)]
    assert stretches.places((34, 40), 5) == [(34, 39), (38, 40)]
    assert stretches.places((34, 37), 5) == [(34, 37)] == stretches.places((34, 37), 17)
    assert stretches.places((17, 34), 17) == [(17, 34)]
    seen = np.full(40, 0.9)
    seen[20:24] = 0.1  # of the second window
    seen[39] = 0.5
    assert stretches.place(seen, (17, 34), 5) == (21, 26)
    first, *more = stretches.cuts(seen, config)
    assert first == ((None, None, None), 17) and more[-1] == (((0, 17), (17, 34), (34, 40)), 17)
    made = [[span is not None for span in cut.generate] for cut in more[:3]]  # worst windows first
    assert made == [[False, True, False], [False, True, True], [True, True, True]]
    assert {cut.frames for cut in more[:3]} == {5} and len(more) == 4 * 3
    assert more[0].generate == (None, (21, 26), None)
    many = list(stretches.cuts(np.ones(17 * 500), config))
    assert len(many) == 1 + 4 * stretches.COUNTS and None not in many[-1].generate


def test_the_error_of_a_frame_follows_what_is_seen_of_it():
    seen = np.array([0.0, 0.5, 1.0])
    np.testing.assert_allclose(TABLE.of_head(seen), TABLE.head * np.array([1.5, 1.0, 0.5]))
    shares = [TABLE.of_stretch(frames, 17) for frames in (5, 9, 13, 17)]
    assert shares == pytest.approx([0.04, 0.03, 0.02, 0.0])


def test_errors_of_single_frames_add_up(photos, path):
    """Of nothing but the place of the stretch: all photos, all steps."""
    worth = coverage.coverage(photos.cameras, path, *SIZE)
    full = full_choices(photos, CONFIG, path, SETTINGS)
    listed = {
        option.choices: option.error
        for option in list_options(photos, CONFIG, path, SETTINGS, TABLE, {}, worth)
    }
    head = TABLE.of_head(coverage.by_frame(photos.cameras, path, *SIZE))
    part = dataclasses.replace(full, generate=((4, 9),), frames=5)
    expected = np.sqrt((np.square(head[:4]).sum() + 5 * TABLE.of_stretch(5, 9) ** 2) / 9)
    assert listed[part] == pytest.approx(expected)
    none = dataclasses.replace(full, generate=(None,))
    assert listed[none] == pytest.approx(np.sqrt(np.square(head).mean()))
    assert listed[full] == 0.0


# ---- what is shown ---------------------------------------------------------------------------------


def test_frames_outside_a_stretch_are_the_rgb_heads_bit_for_bit(run, path):
    """The picture itself is rounded as its program's shapes have it: with fewer frames beside it, by 1e-7."""
    part, head = run(path, ((4, 9),), 5), run(path, (None,), 9)
    picture = model.resized(jax.numpy.asarray(part.preview), *SIZE)
    np.testing.assert_array_equal(part.frames[:4], np.asarray(picture)[:4])
    np.testing.assert_allclose(part.frames[:4], head.frames[:4], atol=1e-6)
    np.testing.assert_allclose(part.preview, head.preview, atol=1e-5)
    assert np.abs(part.frames[4:] - head.frames[4:]).mean() > 0.01
    assert part.windows[0]["rgb_head"] == [[0, 3]] and head.windows[0]["rgb_head"] == [[0, 8]]
    assert part.evaluations == 2 and head.evaluations == 0
    middle = run(path[:7], ((0, 5),), 5)
    np.testing.assert_allclose(middle.preview, head.preview[:7], atol=1e-5)
    assert middle.windows[0]["rgb_head"] == [[5, 6]] and len(middle.frames) == 7
    end = run(path[:7], ((4, 7),), 5)  # padded to five
    assert end.windows[0]["rgb_head"] == [[0, 3]] and len(end.frames) == 7


def test_frames_inside_equal_sampling_the_stretch_alone(weights, run, photos, path, monkeypatch):
    part = run(path, ((4, 9),), 5)
    noise = windows.window_noise(0, 0, 2, CONFIG)
    its = windows.stretch_noise(noise, 2, 4, SHORT)
    np.testing.assert_array_equal(its, noise[[0, 1, 3, 4]])  # photos, and the slots of 4 and 5 to 8
    monkeypatch.setattr(video, "window_noise", lambda *_: its)
    _, _, info = normalise(photos.cameras, path, rule=CONFIG.scale_rule)
    own = dataclasses.replace(SETTINGS, scale=info.divisor)
    alone = sampling.sample(weights, SHORT, photos, path[4:], own)
    np.testing.assert_allclose(part.frames[4:], alone.frames, atol=1e-5)
    np.testing.assert_allclose(part.preview[4:], alone.preview, atol=1e-5)


def test_windows_are_chained_through_generated_and_other_frames(run, photos, weights, cache):
    path = make_path("orbit", photos.cameras, 23, degrees=20)
    generate = ((4, 9), None, (18, 23))
    result = run(path, generate, 5)
    first = run(path[:9], ((4, 9),), 5, scale=result.normalisation.divisor)
    np.testing.assert_array_equal(result.frames[:9], first.frames)
    assert len(result.frames) == len(result.preview) == 23 and result.evaluations == 2 * 2
    assert [w.get("rgb_head") for w in result.windows] == [[[0, 3]], [[9, 17]], None]
    assert all(
        8 in window["generated"] or 17 in window["generated"] for window in result.windows[1:]
    )
    later = sum(windows.chained(2, CONFIG))
    kinds = {key[:3] for key in cache if isinstance(key, tuple)}
    assert {(2, True, True), (later, False, True), (later, True, False)} <= kinds
    # The last window sees frames of both kinds: what it makes depends on the stretch of the first.
    head = run(path, (None, None, (18, 23)), 5)
    assert np.abs(result.frames[18:] - head.frames[18:]).max() > 1e-3


def test_plans_for_other_paths_are_refused(run, path):
    for generate, frames in ((((0, 9),), 9), (((4, 9),), 5), (((1, 6),), 5), (((0, 3),), 5)):
        with pytest.raises(UserError, match="plan again for this path") as error:
            run(path[:7], generate, frames)
        assert "\n" not in str(error.value)


# ---- what it costs ---------------------------------------------------------------------------------


def test_the_price_of_a_part_is_that_of_what_runs(weights, photos, path):
    full = full_choices(photos, CONFIG, path, SETTINGS)
    price = Prices(CONFIG, SETTINGS, len(path))
    part = price(dataclasses.replace(full, generate=((4, 9),), frames=5), 2)
    made = cost.estimate(SHORT, 2, 2)
    assert part == pytest.approx(made.total_flops + cost.shown(CONFIG, 2, 4))
    assert price(dataclasses.replace(full, generate=(None,)), 2) == cost.preview(CONFIG, 2)
    head = cost.preview(CONFIG, 2) - cost.shown(CONFIG, 2, 9)
    assert head == pytest.approx(made.flops["reconstruct"])  # which is not paid twice
    # And what is priced is what the programs multiply.
    context, target, info = normalise(photos.cameras, path)
    see = functools.partial(
        windows.window_views, photos.images, None, context, info=info, config=CONFIG
    )
    views, rest = see(target[4:], frames=5), see(target[:4], frames=4)
    both = multiplied(
        functools.partial(programs.prepare_stretch, config=SHORT), weights, views, rest
    )
    alone = multiplied(functools.partial(model.prepare, config=SHORT), weights, views)
    assert both - alone == pytest.approx(cost.shown(CONFIG, 2, 4), rel=0.1)


def test_the_price_of_a_path_is_that_of_its_windows(photos):
    path = make_path("orbit", photos.cameras, 23, degrees=20)
    full = full_choices(photos, CONFIG, path, SETTINGS)
    later = sum(windows.chained(2, CONFIG))
    costs = {
        ((4, 9), None, (18, 23)): cost.estimate(SHORT, 2, 2).total_flops
        + cost.shown(CONFIG, 2, 4)
        + cost.preview(CONFIG, later)
        + cost.estimate(SHORT, later, 2).total_flops,
        (None, (9, 14), None): cost.preview(CONFIG, 2)
        + cost.estimate(SHORT, later, 2).total_flops
        + cost.shown(CONFIG, later, 4)
        + cost.preview(CONFIG, later),
    }
    for generate, flops in costs.items():
        choices = dataclasses.replace(full, generate=generate, frames=5)
        assert Prices(CONFIG, SETTINGS, 23)(choices, 2) == pytest.approx(flops)


def test_longer_stretches_cost_more_and_promise_more(photos, path):
    worth = coverage.coverage(photos.cameras, path, *SIZE)
    full = full_choices(photos, CONFIG, path, SETTINGS)
    options = list_options(photos, CONFIG, path, SETTINGS, TABLE, {}, worth)
    same = [
        o
        for o in options
        if dataclasses.replace(o.choices, generate=full.generate, frames=9) == full
    ]
    same = sorted(same, key=lambda option: option.choices.generated)
    assert [o.choices.generated for o in same] == [0, 5, 9]
    for a, b in itertools.pairwise(same):
        assert a.flops < b.flops and a.error > b.error
