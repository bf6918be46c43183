"""The planner on the tiny model: monotone, deterministic, within budget, and at tolerance 0 the full model itself."""

import dataclasses
import functools
import itertools
import types

import jax
import numpy as np
import pytest
from scene_files import nerfstudio, truth

import roge_jax as rj
from experiments.planning.runs import CONTEXTS, taken
from roge_jax import checkpoint, cost, model, sample, sampling
from roge_jax.config import preset
from roge_jax.errors import UserError
from roge_jax.files import entry
from roge_jax.geometry.cameras import Cameras
from roge_jax.geometry.trajectories import focus_distance, make_path
from roge_jax.planning import proxies, table
from roge_jax.planning.options import full_choices, list_options
from roge_jax.recon.ray_scene import attend, merge_scene
from roge_jax.sampling import programs
from roge_jax.scenes import coverage
from roge_jax.scenes.scene import load_scene, select_context

CONFIG = preset("tiny")
SETTINGS = sampling.Settings(steps=12).of(CONFIG)
# Made-up constants, so that no test depends on how the shipped model was measured.
TABLE = table.parse(
    "tiny",
    {
        "steps": [
            {"solver": "unipc_2", "schedule": "shift", "steps": k, "evaluations": k, "error": e}
            for k, e in ((2, 0.06), (3, 0.04), (4, 0.025), (6, 0.012), (8, 0.006))
        ],
        **{"photos": 0.12, "photos_head": 0.13},
        **{"merge": {2: 0.01, 4: 0.02}, "merge_head": {2: 0.01, 4: 0.02}},
        **{"half": 0.03, "half_head": 0.04, "head": 0.08},
        **{"seen": {"rise": 2.0, "typical": 0.5}, "stretch": {0.25: 0.04, 0.75: 0.02}},
        "knobs": {
            "photos": [{"proxy": "leave_one_out", "typical": 0.1, "power": 1.0}],
            "steps": [
                {"proxy": "richardson", "typical": 0.1, "power": 1.0},
                {"proxy": "detail", "typical": 0.05, "power": 1.0},
            ],
            "merge": [{"proxy": "redundancy", "typical": 0.3, "power": 1.0}],
            "half": [],
            "stretch": [],
            "head": [{"proxy": "detail", "typical": 0.05, "power": 0.5}],
        },
        "provenance": {},
    },
)
TOLERANCES = (0.0, 1e-4, 0.003, 0.01, 0.02, 0.03, 0.05, 0.08, 0.13, 0.2, 0.5)


@pytest.fixture(scope="module")
def weights():
    params = model.init(jax.random.key(0), CONFIG)
    rng = np.random.default_rng(0)

    def fill(leaf):  # the published initialisation is zero here: nothing would depend on anything
        return np.asarray(0.1 * rng.standard_normal(leaf.shape), np.float32)

    params["dit"]["head"]["linear"]["kernel"] = fill(params["dit"]["head"]["linear"]["kernel"])
    head = params["renderer"]["rgb_head"]["linear"]
    head["kernel"] = fill(head["kernel"])
    return params


@pytest.fixture(scope="module")
def folder(weights, tmp_path_factory):
    folder = tmp_path_factory.mktemp("planning")
    checkpoint.save_model(folder / "model", weights, CONFIG, dtype=np.float32)
    nerfstudio(folder / "scene", truth(4))
    return folder


@pytest.fixture(scope="module")
def photos(folder):
    return sampling.read_photos(load_scene(folder / "scene"), [0, 1, 2, 3], CONFIG)


@pytest.fixture(scope="module")
def path(photos):
    return make_path("orbit", photos.cameras, 2 * CONFIG.frames, degrees=20)


@pytest.fixture(scope="module")
def compiled():
    return {}


@pytest.fixture(scope="module")
def make(weights, photos, path, compiled):
    def plan(tolerance, **options):
        options = {"settings": SETTINGS, "compiled": compiled, "table": TABLE} | options
        return rj.plan(
            weights,
            CONFIG,
            options.pop("photos", photos),
            options.pop("path", path),
            tolerance=tolerance,
            **options,
        )

    return plan


# ---- what is promised ----------------------------------------------------------------------------


def test_a_smaller_tolerance_never_costs_less(make):
    plans = [make(tolerance) for tolerance in TOLERANCES]
    costs = [plan.predicted_cost for plan in plans]
    assert costs == sorted(costs, reverse=True)
    assert len(set(costs)) >= 4 and costs[-1] < 0.5 * costs[0]  # the knobs are real
    for tolerance, plan in zip(TOLERANCES, plans, strict=True):
        assert plan.predicted_error <= tolerance
        assert plan.full_cost == costs[0]


def test_tolerance_zero_leaves_nothing_out_and_measures_nothing(make, photos, path):
    plan = make(0.0)
    assert plan.choices == full_choices(photos, CONFIG, path, SETTINGS)
    assert plan.predicted_error == 0.0 and plan.planning_cost == 0.0
    assert plan.predicted_cost == plan.full_cost and plan.refused is None


def test_tolerance_zero_is_the_full_model_bit_for_bit(weights, photos, path, make):
    cache = {}
    settings = dataclasses.replace(SETTINGS, steps=2)
    path = path[: CONFIG.frames]
    whole = sampling.sample(weights, CONFIG, photos, path, settings, cache=cache)
    programs = list(cache)
    plan = make(0.0, settings=settings, path=path)
    again = sampling.sample(weights, CONFIG, photos, path, settings, plan=plan, cache=cache)
    assert list(cache) == programs  # the same compiled programs
    assert again.frames.tobytes() == whole.frames.tobytes()
    assert again.preview.tobytes() == whole.preview.tobytes()


def test_plans_are_deterministic(make):
    assert make(0.05) == make(0.05)
    assert make(0.05).explain() == make(0.05).explain()


def test_a_plan_stays_within_max_cost_or_says_what_is_needed(make):
    full = make(0.0).full_cost
    least = make(10.0, probe=0.0)
    bottom = least.predicted_cost
    for share in (0.1, 0.3, 0.6, 1.0, 1.5):
        budget = bottom + share * full
        plan = make(0.003, max_cost=budget)
        assert plan.predicted_cost + plan.planning_cost <= budget
        assert plan.predicted_error <= 0.003 or "does not buy" in plan.explain()
    assert make(10.0, max_cost=bottom, probe=0.0).choices == least.choices
    with pytest.raises(
        UserError, match="less than the cheapest plan needs: give at least"
    ) as error:
        make(0.02, max_cost=0.99 * bottom, probe=0.0)
    needed = float(str(error.value).split("at least ")[1].split(",")[0])
    assert needed == pytest.approx(bottom, rel=1e-3)


def test_a_budget_never_buys_a_worse_plan_when_it_grows(make):
    full = make(0.0).full_cost
    errors = [make(1e-4, max_cost=share * full).predicted_error for share in (0.4, 0.6, 0.8, 1.2)]
    assert errors == sorted(errors, reverse=True) and errors[0] > errors[-1]


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_bad_tolerances_take_one_sentence(make, value):
    with pytest.raises(UserError, match=r"^tolerance .*: give a root-mean-square") as error:
        make(value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_bad_budgets_take_one_sentence(make, value):
    with pytest.raises(UserError, match=r"^max_cost .*: give a positive number of FLOPs"):
        make(0.02, max_cost=value)


# ---- how it buys ---------------------------------------------------------------------------------


def test_every_purchase_lowers_the_error_and_the_best_rate_comes_first(make):
    plan = make(0.003)
    start, *bought = plan.bought
    assert bought and all(p.gain > 0 and p.flops > 0 for p in bought)
    assert start.flops + sum(p.flops for p in bought) == pytest.approx(plan.predicted_cost)
    assert -start.gain - sum(p.gain for p in bought) == pytest.approx(plan.predicted_error)
    rates = [p.gain / p.flops for p in bought[:-1]]  # the last one is the cheapest that suffices
    assert rates == sorted(rates, reverse=True)


def test_every_knob_enters_the_prediction_with_its_measured_error(photos, path):
    """Alone each knob predicts its constant; with a proxy twice the typical one, twice that. Together squares add."""
    path = path[: CONFIG.frames]
    worth = coverage.coverage(photos.cameras, path, CONFIG.height, CONFIG.width)
    full = full_choices(photos, CONFIG, path, SETTINGS)
    small = proxies.half_size(CONFIG)
    half = {"recon": (small.recon_height, small.recon_width)}
    steps = {"solver": "unipc_2", "schedule": "shift", "steps": 3}
    kept = coverage.selections(worth)[1]
    lost = 1.0 - coverage.covered(worth, kept) / coverage.covered(worth, full.photos)
    shown = {"generate": (None,), "frames": CONFIG.frames}
    head = np.sqrt(np.square(TABLE.of_head(coverage.by_frame(photos.cameras, path, CONFIG.height, CONFIG.width))).mean())  # fmt: skip
    alone = {  # what differs from the full model: its error, and the proxy that scales it
        "merge": ({"merge": 2}, 0.01, "redundancy", 0.6),
        "half": (half, 0.03, None, 0.0),
        "steps": (steps, 0.04, "richardson", 0.2),
        "photos": ({"photos": kept}, 0.12 * np.sqrt(lost), "leave_one_out", 0.2),
        "head": (shown, head, "detail", 0.2),  # to the power of a half
    }

    def error(measured, **changes):
        listed = list_options(photos, CONFIG, path, SETTINGS, TABLE, measured, worth)
        wanted = dataclasses.replace(full, **changes)
        (found,) = (o.error for o in listed if o.choices == wanted)
        return found

    for name, (changes, expected, proxy, double) in alone.items():
        assert error({}, **changes) == pytest.approx(expected, rel=1e-6), name
        if proxy is not None:
            assert error({proxy: double}, **changes) == pytest.approx(2 * expected, rel=1e-6), name
    together = error({}, merge=2, **half, **steps, photos=kept)
    four = (alone[name][1] for name in ("merge", "half", "steps", "photos"))
    assert together == pytest.approx(np.sqrt(sum(e**2 for e in four)), rel=1e-6)


def test_explain_tells_what_was_bought_and_what_was_not(make):
    plan = make(0.05)
    text = plan.explain()
    assert text.count("bought") == len(plan.bought) - 1 and "start" in text
    assert ("refused" in text) == (plan.refused is not None)
    assert f"predicted error {plan.predicted_error:.4f}" in text
    assert "not for 'tiny'" not in text
    assert "for 'mini', not for 'tiny'" in make(0.05, table=None, probe=0.0).explain()
    other = dataclasses.replace(TABLE, provenance={"full": ["euler", "shift", 50]})
    assert "against 50 steps of euler (shift)" in make(0.05, table=other, probe=0.0).explain()


def test_prices_are_those_of_the_cost_model(make):
    plan = make(0.0)
    windows = [cost.estimate(CONFIG, m, 12).total_flops for m in (4, 6)]  # chained: two frames more
    assert plan.full_cost == pytest.approx(sum(windows))


# ---- photos --------------------------------------------------------------------------------------


def test_redundant_photos_are_not_bought_twice(make, photos):
    """Photos from the same place add no coverage, whatever noise tells them apart."""
    twice = [0, 1, 2, 3, 0, 1]
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, photos.images.shape)
    images = np.clip(np.concatenate([photos.images, (photos.images + noise)[:2]]), 0.0, 1.0)
    doubled = sampling.Photos(
        images.astype(np.float32), None, photos.cameras[twice], tuple(range(6))
    )
    for tolerance in TOLERANCES[1:]:
        kept = make(tolerance, photos=doubled, probe=0.0).choices.photos
        places = [twice[i] for i in kept]
        assert len(set(places)) == len(places) or len(kept) == 6
    worth = coverage.coverage(doubled.cameras, doubled.cameras, CONFIG.height, CONFIG.width)
    assert sorted(photo for photo, _ in coverage.greedy(worth)) == [0, 1, 2, 3]


def test_greedy_gains_fall_and_first_comes_who_sees_most(photos):
    """The path is the third photo's own view: that photo sees all of it, exactly."""
    own = photos.cameras[[2]]
    worth = coverage.coverage(photos.cameras, own, CONFIG.height, CONFIG.width)
    order = coverage.greedy(worth)
    assert order[0][0] == 2 and order[0][1] == pytest.approx(1.0)
    worth = coverage.coverage(photos.cameras, photos.cameras, CONFIG.height, CONFIG.width)
    gains = [gain for _, gain in coverage.greedy(worth)]
    assert gains == sorted(gains, reverse=True)
    assert sum(gains) == pytest.approx(coverage.covered(worth, (0, 1, 2, 3)))


def test_selections_are_the_best_sets_where_greedy_ones_are_not():
    """Three photos beside one another; the middle one sees most, the outer two together see everything."""
    worth = np.array([[1.0, 1, 1, 0, 0, 0], [0, 0.9, 0.9, 0.9, 0.9, 0], [0, 0, 0, 1, 1, 1]])
    assert coverage.greedy(worth)[0][0] == 1
    assert coverage.selections(worth) == [(1,), (0, 2)]
    rng = np.random.default_rng(0)
    for photos in (3, 5, 7):
        worth = rng.random((photos, 40)) ** 3
        sets = coverage.selections(worth)
        assert [len(s) for s in sets] == list(range(1, len(sets) + 1))
        reached = [coverage.covered(worth, s) for s in sets]
        assert reached == sorted(reached)
        order = [photo for photo, _ in coverage.greedy(worth)]
        for k, value in enumerate(reached, 1):
            every = itertools.combinations(range(photos), k)
            best = max(coverage.covered(worth, some) for some in every)
            assert coverage.covered(worth, tuple(order[:k])) <= value + 1e-12 <= best + 2e-12
            assert value > 0.97 * best
    assert coverage.selections(np.zeros((3, 4))) == [(0,)]


def test_photos_of_a_large_scene_are_chosen_by_what_the_path_sees(folder, photos):
    scene = load_scene(folder / "scene")
    size = (CONFIG.height, CONFIG.width)
    assert coverage.see_path(scene, photos.cameras[[3]], 1, *size) == [3]
    both = coverage.see_path(scene, photos.cameras[[0, 2]], 2, *size)
    assert sorted(both) == [0, 2]
    assert len(coverage.see_path(scene, photos.cameras, 9, *size)) == 4


def test_a_scene_is_planned_with_the_photos_that_see_the_path(weights, folder, photos):
    """Two of four: those whose views the path repeats, not those that lie farthest apart. A run with others is refused."""
    scene, config = load_scene(folder / "scene"), dataclasses.replace(CONFIG, max_context=2)
    path = photos.cameras[[2, 3, 3, 2, 2]]
    assert set(select_context(scene, 2)) != {2, 3}
    plan = rj.plan(weights, config, scene, path, tolerance=0.0, settings=SETTINGS, table=TABLE)
    assert set(plan.ids) == {2, 3} and plan.choices.photos == (0, 1)
    assert f"among views {list(plan.ids)} of the scene" in plan.explain()
    own = sampling.read_photos(scene, plan.ids, config)
    settings = dataclasses.replace(SETTINGS, steps=2)
    plan = rj.plan(weights, config, own, path, tolerance=0.0, settings=settings, table=TABLE)
    run = functools.partial(sampling.sample, weights, config, path=path, settings=settings)
    assert run(own, plan=plan).windows[0]["photos"] == list(plan.ids)
    other = sampling.read_photos(scene, [0, 1], config)
    with pytest.raises(
        UserError, match=r"made for views \[\d, \d\] of the scene and the photos are views \[0, 1\]"
    ):
        run(other, plan=plan)
    chosen = rj.plan(weights, config, scene, path, tolerance=0.0, context=[1, 0], table=TABLE)
    assert chosen.ids == (1, 0)


def test_coverage_knows_no_unit_and_no_frame(photos, path):
    def moved(cameras):
        pose = np.eye(4)
        pose[:3, :3] = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
        pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
        pose[:3, 3] = [30.0, -5.0, 12.0]
        c2w = pose[None] @ cameras.c2w
        c2w[:, :3, 3] *= 1e-3
        return Cameras(cameras.K, c2w)

    size = (CONFIG.height, CONFIG.width)
    here = coverage.coverage(photos.cameras, path, *size)
    there = coverage.coverage(moved(photos.cameras), moved(path), *size)
    assert (
        np.mean(np.abs(here - there) > 1e-6) < 0.002
    )  # points on a picture's border may fall either way
    assert here.min() >= 0 and here.max() <= 1 and here.mean() > 0.05


def test_photos_from_further_away_are_worth_less_and_from_closer_no_more():
    """Along one line of sight a photo is worth the target's distance over its own, at most 1."""
    K = np.array([[1e5, 0, 32], [0, 1e5, 18], [0, 0, 1]])  # a pencil of rays: no angle between them
    c2w = np.tile(np.eye(4), (3, 1, 1))
    c2w[:, 2, 3] = 0.0, -1.0, 0.5
    photos = Cameras(np.tile(K, (3, 1, 1)), c2w)
    worth = coverage.coverage(photos, photos[:1], 36, 64)
    depths = focus_distance(photos) * np.array(coverage.DEPTHS)
    assert depths[0] > 0.5  # all in front of every photo
    expected = np.tile(depths / (depths + 1.0), worth.shape[1] // len(depths))
    np.testing.assert_allclose(worth[1], expected, rtol=1e-3)
    np.testing.assert_allclose(worth[[0]], 1.0, rtol=1e-3)
    np.testing.assert_allclose(worth[2][worth[2] > 0], 1.0, rtol=2e-2)


def test_the_window_that_is_seen_best_is_the_one_not_generated(photos):
    """The photos' own views against views turned away from all that they show."""
    away = photos.cameras.c2w.copy()
    away[:, :3, :3] = away[:, :3, :3] @ np.diag([-1.0, 1.0, -1.0])
    order = [0, 1, 2, 3, 3]
    for turned, parts in enumerate(((away, photos.cameras.c2w), (photos.cameras.c2w, away))):
        path = Cameras(photos.cameras.K[order * 2], np.concatenate([p[order] for p in parts]))
        worth = coverage.coverage(photos.cameras, path, CONFIG.height, CONFIG.width)
        listed = list_options(photos, CONFIG, path, SETTINGS, TABLE, {}, worth)
        mixed = [o.choices.generate for o in listed if o.choices.generate.count(None) == 1]
        assert mixed and all(generate[turned] for generate in mixed)


def test_one_photo_can_be_planned_for(make, photos):
    alone = sampling.Photos(photos.images[:1], None, photos.cameras[:1], (0,))
    path = make_path("orbit", alone.cameras, 3)
    plan = make(0.05, photos=alone, path=path)
    assert plan.choices.photos == (0,) and plan.planning_cost == 0.0


# ---- what a reduced run computes ------------------------------------------------------------------


@pytest.mark.parametrize("long", ["chain", "independent"])
def test_targets_keep_their_noise_when_photos_are_dropped(photos, path, monkeypatch, long):
    """In every window: what is generated differs by what is seen, not by another draw."""
    drawn = []

    def without_network(params, views, config, slots):
        video = np.full((config.frames, config.height, config.width, 3), 0.5, np.float32)

        def velocity(params, prepared, noise, x, sigma):
            drawn.append((np.asarray(noise), config.slots(0)))
            return 0 * x

        shown = types.SimpleNamespace(shown=video, detail=None, full=None)
        return programs.Programs(lambda *_: shown, velocity, lambda *_: video)

    monkeypatch.setattr(programs, "for_window", without_network)
    full = full_choices(photos, CONFIG, path, SETTINGS)
    found = []
    for kept in ((0, 1, 2, 3), (1, 3)):
        drawn.clear()
        choices = dataclasses.replace(full, photos=kept, steps=1)
        run({}, photos, path, choices, {}, long=long)
        found.append([noise[-slots:] for noise, slots in drawn])
    assert len(found[0]) == len(found[1]) == 2
    np.testing.assert_array_equal(*found)
    assert np.any(found[0][0] != found[0][1])


def test_every_knob_changes_the_run_as_it_says(weights, photos, path):
    full = full_choices(photos, CONFIG, path[:5], SETTINGS)
    half = (CONFIG.recon_height // 2, CONFIG.recon_width // 2)
    choices = dataclasses.replace(full, photos=(1, 3), steps=2, recon=half, merge=4)
    cache = {}
    result = run(weights, photos, path[:5], choices, cache)
    assert result.evaluations == 2 and len(result.frames) == 5
    assert result.preview.shape[1:3] == half and result.windows[0]["photos"] == [1, 3]
    assert np.isfinite(result.frames).all()
    ((count, generated, shown, config),) = cache
    assert (count, generated, shown, config.renderer.merge) == (2, True, False, 4)


def test_windows_that_are_not_generated_show_the_rgb_head(weights, photos, path):
    full = full_choices(photos, CONFIG, path, SETTINGS)
    half = (CONFIG.recon_height // 2, CONFIG.recon_width // 2)
    choices = dataclasses.replace(full, photos=(2,), recon=half, generate=(None, None))
    result = run(weights, photos, path, choices, {}, long="independent")
    assert result.evaluations == 0 and all(window["rgb_head"] for window in result.windows)
    shown = model.resized(jax.numpy.asarray(result.preview), CONFIG.height, CONFIG.width)
    np.testing.assert_array_equal(result.frames, np.asarray(shown))
    assert np.abs(result.frames[0] - result.frames[4]).max() > 1e-3


def run(weights, photos, path, choices, cache, **settings):
    plan = types.SimpleNamespace(choices=choices, ids=photos.ids)
    settings = dataclasses.replace(SETTINGS, **settings)
    return sampling.sample(weights, CONFIG, photos, path, settings, plan=plan, cache=cache)


def test_merged_tokens_are_means_of_neighbours():
    grid = (3, 5)
    x = np.arange(15, dtype=np.float32).reshape(1, 15, 1)
    merged, _ = merge_scene(x, None, grid, 4)
    assert merged.shape == (1, 2 * 3, 1)
    cells = x.reshape(3, 5)
    expected = [cells[a : a + 2, b : b + 2].mean() for a in (0, 2) for b in (0, 2, 4)]
    np.testing.assert_allclose(np.asarray(merged)[0, :, 0], expected, rtol=1e-6)
    pairs, _ = merge_scene(x, None, grid, 2)
    np.testing.assert_allclose(np.asarray(pairs)[0, :3, 0], [0.5, 2.5, 4.0], rtol=1e-6)


def test_merging_alike_tokens_changes_nothing(weights):
    """Without positions, tokens that are all alike are worth no more than a quarter of them."""
    p = jax.tree.map(lambda leaf: leaf[0], weights["renderer"]["blocks"]["cross_attn"])
    rng, width = np.random.default_rng(0), CONFIG.renderer.width
    rays, noise = (rng.standard_normal((1, 24, width)).astype(np.float32) for _ in range(2))
    alike = np.repeat(noise[:, :1], 24, 1)

    def read(tokens):
        few, _ = merge_scene(tokens, None, (4, 6), 4)
        assert few.shape[1] == 6
        whole = attend(p, rays, tokens, CONFIG.renderer.heads)
        return np.abs(attend(p, rays, few, CONFIG.renderer.heads) - whole).max()

    assert read(alike) < 1e-6 < 1e-3 < read(noise)


def test_leave_one_out_finds_what_a_perfect_head_would_not_miss(
    weights, photos, compiled, monkeypatch
):
    """A head that paints them exactly has none."""
    measured = proxies.leave_one_out(weights, CONFIG, photos, compiled)
    assert measured["leave_one_out"] > 0.05 and 0 < measured["redundancy"] < 1
    small = proxies.half_size(CONFIG)
    left = jax.numpy.asarray(photos.images[proxies.left_out(4)])
    truth = model.resized(left, small.recon_height, small.recon_width)
    key = next(k for k in compiled if k[0] == "leave_one_out" and k[1] == 4)
    known = {key: lambda params, batch: (truth, np.zeros(2))}
    assert proxies.leave_one_out(weights, CONFIG, photos, known)["leave_one_out"] < 1e-6


def test_richardson_is_the_distance_of_two_steps_from_four(photos, path, monkeypatch):
    """A sampler whose every number is the count of its evaluations; and it is measured where it may cost that much."""
    seen = []

    def generate(params, prepared, noise, *, config, solver, mode):
        seen.append((len(solver.sigma), config.recon_height, mode))
        return jax.numpy.full_like(noise, len(solver.sigma)), None

    monkeypatch.setattr(proxies.model, "prepare", lambda params, views, config: views)
    monkeypatch.setattr(proxies.model, "generate", generate)
    assert proxies.richardson({}, CONFIG, photos, path, SETTINGS, {}) == pytest.approx(2.0)
    assert seen == [(2, CONFIG.recon_height // 2, SETTINGS.slots), (4, *seen[0][1:])]
    price = proxies.richardson_price(CONFIG, 4)
    for most, measured in ((0.999 * price, False), (1.001 * price, True)):
        monkeypatch.setattr(proxies, "leave_one_out_price", lambda config, m: np.inf)
        found = proxies.measure({}, CONFIG, photos, path, SETTINGS, most, {})
        assert ("richardson" in found.values) == measured
        assert found.flops == (price if measured else 0.0)


def test_what_costs_more_than_its_share_is_not_measured(make):
    price = proxies.leave_one_out_price(CONFIG, 4)
    full = make(0.0).full_cost
    bought = make(0.05, probe=1.001 * price / full)
    assert bought.planning_cost == price and "leave_one_out" in bought.measured
    free = make(0.05, probe=0.999 * price / full)
    assert free.planning_cost == 0.0 and list(free.measured) == ["detail"]


def test_photos_of_the_ladder_are_spread_or_bursts():
    for seed in range(40):
        photos = taken(23, seed)
        gaps = np.diff(photos)
        assert len(photos) == CONTEXTS and photos[0] >= 0 and photos[-1] < 23 and np.all(gaps > 0)
        assert (seed % 2 == 1) == (sorted(gaps)[:4] == [1, 1, 1, 1])
    assert len({tuple(taken(23, seed)) for seed in range(1, 40, 2)}) > 10


def test_the_shipped_table_says_where_it_comes_from():
    constants = table.load("mini")
    assert constants.provenance["scenes"] and constants.provenance["command"]
    assert all(step.error > 0 for step in constants.steps)
    assert table.load("no such model").name == table.DEFAULT


# ---- the program ---------------------------------------------------------------------------------


def test_the_program_plans_and_says_so(folder, capsys):
    words = ["--checkpoint", folder / "model", "--scene", folder / "scene", "--out", folder / "out"]
    words = [str(w) for w in [*words, "--tolerance", 0.3, "--steps", 4]]
    assert entry.execute(sample.main, sample.parser(), words) == 0
    assert "plan for tolerance 0.3" in capsys.readouterr().out
    run = (folder / "out" / "run.json").read_text()
    assert '"predicted_error"' in run and '"choices"' in run
    assert entry.execute(sample.main, sample.parser(), [*words, "--max-cost", "1"]) == 2
    assert "cheapest plan" in capsys.readouterr().err
