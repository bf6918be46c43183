"""Photo look-up: projections against the NumPy warp, exact copies, order, gradients, cost; and its training."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from test_cost import abstract, array, multiplied

from roge_jax import cost, model
from roge_jax.config import RoGeConfig, preset, to_dict
from roge_jax.core.layers import conv2d, convolve
from roge_jax.core.params import flatten, init
from roge_jax.data.views import ViewConfig
from roge_jax.errors import UserError
from roge_jax.metrics import baselines
from roge_jax.procedural.scenes import sample_sequence
from roge_jax.recon import lookup, sweep
from roge_jax.recon import picture as pictures_of
from roge_jax.sampling import programs
from roge_jax.training import stages

lookup, sweep = compiled(lookup), compiled(sweep)
CUTS, H, W, D = 12, 32, 48, 32
TINY = preset("tiny")
CONFIG = dataclasses.replace(TINY, renderer=dataclasses.replace(TINY.renderer, lookup=CUTS))
RNG = np.random.default_rng(0)


@functools.cache
def weights(fill: float = 0.0):
    """Initial leaves; `fill` adds noise to all of them, those that start from zero included."""
    p = init(jax.random.key(0), lookup.lookup_specs(D, 8, CUTS))
    rng = np.random.default_rng(1)
    return jax.tree.map(
        lambda x: np.asarray(x) + np.float32(fill * rng.standard_normal(x.shape)), p
    )


def cameras(n: int, spread: float = 0.3, seed: int = 0):
    """K and c2w of n cameras near the origin that look along +z, a little turned."""
    rng = np.random.default_rng(seed)
    K = np.tile(
        np.array([[40.0, 0, W / 2 + 1], [0, 42.0, H / 2], [0, 0, 1]], np.float32), (n, 1, 1)
    )
    c2w = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    c2w[:, :3, 3] = rng.uniform(-spread, spread, (n, 3))
    for pose, angle in zip(c2w, rng.uniform(-0.2, 0.2, n)):
        s, c = np.sin(angle), np.cos(angle)
        pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    return K, c2w


def textured_plane(K, c2w, depth: float, h: int = H, w: int = W, fine: float = 1.0) -> np.ndarray:
    """Pictures [n, h, w, 3] of a smooth texture, as `fine` as that, on the plane z = depth of the world."""
    y, x = np.mgrid[:h, :w] + 0.5
    pixels = np.stack([x, y, np.ones_like(x)], -1)
    pictures = []
    for k, pose in zip(K.astype(np.float64), c2w.astype(np.float64)):
        rays = pixels @ np.linalg.inv(k).T @ pose[:3, :3].T
        point = pose[:3, 3] + rays * ((depth - pose[2, 3]) / rays[..., 2])[..., None]
        u, v = (4.0 * fine * point[..., i] / depth for i in (0, 1))
        waves = [np.sin(5 * u + 2 * v), np.cos(4 * v - u), np.sin(3 * u) * np.cos(5 * v)]
        pictures.append(0.5 + 0.4 * np.stack(waves, -1))
    return np.stack(pictures).astype(np.float32)


def look(p, photos, seen_by, of, *, features=None, head=None):
    v = len(of[0])
    head = np.full((v, H, W, 3), 0.5, np.float32) if head is None else head
    features = np.zeros((v, H // 8, W // 8, D), np.float32) if features is None else features
    return lookup.look_up(p, features, head, photos, of, seen_by, cuts=CUTS)


@pytest.mark.parametrize("depth", [0.7, 3.0, np.inf])
def test_rays_meet_the_photos_where_the_homography_of_their_depth_says(depth):
    photos = RNG.random((2, H, W, 3)).astype(np.float32)
    seen_by, of = cameras(2, seed=3), cameras(1, seed=4)
    way = sweep.motion(*of, *seen_by)
    way = sweep.Motion(way.turn[0], way.shift[0])
    inverse = np.full((1, H * W), 1 / depth)
    found, seen = sweep.fetch(photos, way, sweep.pixels_of(H, W, 1), inverse)
    for i in range(2):
        want = baselines.warp(
            photos[i], seen_by[0][i], seen_by[1][i], of[0][0], of[1][0], np.full((H, W), depth)
        )
        valid = np.asarray(seen[i, 0]).reshape(H, W) > 0
        assert 0.2 < valid.mean() < 1.0 or depth == 3.0
        assert np.mean(valid != want.valid) < 0.002  # rounding at the frame
        inside = valid & want.valid
        got = np.asarray(found[i, 0]).reshape(H, W, 3)
        # The warp takes several samples per pixel where it shrinks: here it does not.
        np.testing.assert_allclose(got[inside], want.rgb[inside], atol=2e-3)


def test_the_photos_agree_at_the_true_depth_and_nowhere_else():
    K, c2w = cameras(3, spread=0.08, seed=5)
    c2w[:, :3, :3] = np.eye(3)  # parallel: the plane has one depth in every view
    c2w[:, 2, 3] = 0.0
    cut = 8
    depth = 1.0 / float(sweep.inverse_depth(np.float32(cut), CUTS))
    photos = textured_plane(K, c2w, depth)
    way = sweep.motion(K[:1], c2w[:1], K[1:], c2w[1:])
    way = sweep.Motion(way.turn[0], way.shift[0])
    inverse = np.broadcast_to(
        sweep.inverse_depth(np.arange(CUTS, dtype=np.float32), CUTS)[:, None], (CUTS, H * W)
    )
    values, seen = sweep.fetch(photos[1:], way, sweep.pixels_of(H, W, 1), inverse)
    mean, deviation, n = sweep.agreement(values, seen)
    both = np.asarray(n[cut, :, 0]) == 2
    assert both.mean() > 0.3
    assert np.mean(np.asarray(deviation.mean(-1)).argmin(0)[both] == cut) > 0.95
    off = np.abs(mean[cut] - photos[0].reshape(-1, 3))[both]
    assert off.mean() < 0.01 and np.quantile(off, 0.99) < 0.03  # bilinear; borders repeat
    assert np.all(deviation[:, ~np.asarray(n[..., 0] >= 2).any(0)] > 0.3)  # strangers


def side_by_side(n: int, apart: float):
    """K and c2w of n parallel cameras in a row."""
    K = np.tile(np.array([[40.0, 0, W / 2], [0, 40.0, H / 2], [0, 0, 1]], np.float32), (n, 1, 1))
    c2w = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    c2w[:, 0, 3] = apart * np.arange(n)
    return K, c2w


def way_of(seen_by, of) -> sweep.Motion:
    """From the one view `of` to the photos."""
    way = sweep.motion(*of, *seen_by)
    return sweep.Motion(way.turn[0], way.shift[0])


def reach_of(seen_by, of, cuts: int = 48) -> float:
    size = (H // lookup.CELL, W // lookup.CELL)
    alike = sweep.twins(seen_by[1])
    return float(sweep.shared_reach(way_of(seen_by, of), alike, size, lookup.CELL, cuts))


def test_the_cuts_end_where_two_photos_no_longer_see_the_same():
    def nearest(apart):
        K, c2w = side_by_side(3, apart)
        photos, view = (K[::2], c2w[::2]), (K[1:2], c2w[1:2])
        return 1.0 / float(sweep.inverse_depth(np.float32(47), 48, reach_of(photos, view)))

    # Of parallel photos 2 b apart, both see a tenth of the view between them up to z = 40 b / (0.45 * 48).
    for apart in (0.4, 0.8, 1.6):
        bound = 40.0 * apart / (0.45 * W)
        assert 0.7 * bound < nearest(apart) <= bound * (1 + 1e-6)
    K, c2w = side_by_side(3, 0.4)
    view = K[1:2], c2w[1:2]
    whole = pytest.approx(1.0, abs=1e-6)  # a program divides by multiplying
    assert reach_of((K[:1], c2w[:1]), view) == whole  # one photo
    twice = np.repeat(c2w[:1], 2, 0)
    assert reach_of((K[:2], twice), view) == whole  # two from one place
    # Both behind the view, both looking ahead: as near as there are cuts.
    behind = c2w[::2] * np.float32(1.0)
    behind[:, :3, 3] = [[-0.05, 0, -0.6], [0.05, 0, -0.6]]
    assert reach_of((K[:2], behind), view) == whole


def test_a_shorter_axis_asks_the_rays_about_its_own_depths():
    """One cut that the rays favour is the answer at its depth, however the axis is divided."""
    p = jax.tree.map(np.zeros_like, init(jax.random.key(0), lookup.lookup_specs(D, 8, CUTS)))
    ch, cw, favoured = H // 4, W // 4, 5
    prior = np.zeros((ch, cw, CUTS), np.float32)
    prior[..., favoured] = 9.0
    nothing = np.zeros((ch, cw, lookup.WIDTH)), np.zeros((ch, cw, 3))
    around = np.zeros((CUTS, ch, cw, lookup.AGREED))
    maps = np.zeros((2, ch, cw, lookup.MATCHED + 3))
    K, c2w = side_by_side(3, 0.0)
    way = way_of((K[::2], c2w[::2]), (K[1:2], c2w[1:2]))
    found = {}
    for reach in (1.0, 0.6):
        out = lookup._coarse(
            p, maps, np.eye(2), way, np.float32(reach), prior, nothing[0], nothing[1], around
        )
        found[reach] = np.asarray(sweep.inverse_depth(out[2], CUTS, reach))
    want = float(sweep.inverse_depth(np.float32(favoured), CUTS))
    np.testing.assert_allclose(found[1.0], want, rtol=1e-3)
    np.testing.assert_allclose(found[0.6], want, rtol=0.05)


def test_cells_learn_from_their_surroundings_and_the_view_where_photos_agree():
    K, c2w = side_by_side(3, 0.3)
    depth = 2.0
    photos = textured_plane(K, c2w, depth)
    photos[:, :12, :16] = 0.4  # a corner without texture
    way = way_of((K[::2], c2w[::2]), (K[1:2], c2w[1:2]))
    halves, cuts, reach = lookup._cells(photos[::2], 2), 48, 0.5
    told = np.asarray(lookup._agreement_around(halves, np.eye(2), way, np.float32(reach), cuts))
    assert told.shape == (cuts, H // 4, W // 4, lookup.AGREED) and np.isfinite(told).all()
    inverse = np.asarray(sweep.inverse_depth(np.arange(cuts, dtype=np.float32), cuts, reach))
    right = int(np.abs(inverse - 1 / depth).argmin())
    near = {right - 1, right, right + 1}
    own, region, _, view, view_seen = np.moveaxis(told, -1, 0)
    assert own[:, 5, 6].argmin() in near and region[:, 5, 6].argmin() in near
    # The corner itself cannot tell; the view can.
    flat = own[:, 1, 1][own[:, 1, 1] < 0.3]  # where two photos see it
    assert len(flat) > 8 and np.ptp(flat) < 0.02
    assert view[:, 1, 1].argmin() in near and np.all(view == view[:, :1, :1])
    assert np.all((region >= 0) & (view >= 0)) and 0 <= view_seen.min() <= view_seen.max() <= 1


def test_the_camera_of_a_photo_gets_that_photo():
    # Any weights: wherever a ray is cut, it is the same pixel.
    photos = RNG.random((1, H, W, 3)).astype(np.float32)
    K, c2w = cameras(1, seed=6)
    found = look(weights(0.1), photos, (K, c2w), (K, c2w))
    np.testing.assert_allclose(found.photos, photos, atol=2e-3)
    blocks = photos.reshape(1, H // 4, 4, W // 4, 4, 3).mean((2, 4))
    np.testing.assert_allclose(found.coarse, blocks, atol=2e-3)
    # Of several photos it takes the one from the same place.
    more = np.concatenate([RNG.random((2, H, W, 3)).astype(np.float32), photos])
    K3, c2w3 = cameras(3, seed=7)
    c2w3[2] = c2w[0]
    found = look(weights(), more, (K3, c2w3), (K, c2w))
    assert np.abs(found.photos - photos).mean() < 0.02 < np.abs(more[:1] - photos).mean()


def test_the_order_of_the_photos_does_not_matter():
    photos = RNG.random((3, H, W, 3)).astype(np.float32)
    (K, c2w), of = cameras(3, seed=8), cameras(2, seed=9)
    order = np.array([2, 0, 1])
    one = look(weights(0.1), photos, (K, c2w), of)
    other = look(weights(0.1), photos[order], (K[order], c2w[order]), of)
    for a, b in zip(one[:4], other[:4]):
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_repeated_photos_change_nothing():
    """A photo agrees with its copy at every depth: counted twice it would drown what the others say."""
    photos = RNG.random((3, H, W, 3)).astype(np.float32)
    (K, c2w), of = cameras(3, seed=8), cameras(2, seed=9)
    once = look(weights(0.1), photos, (K, c2w), of)
    for more in ([0, 1, 2, 0, 1, 2], [0, 0, 0, 1, 2]):
        again = look(weights(0.1), photos[more], (K[more], c2w[more]), of)
        for a, b in zip(once[:4], again[:4]):
            np.testing.assert_allclose(a, b, atol=1e-3)
    two = look(weights(0.1), photos[:2], (K[:2], c2w[:2]), of)
    assert np.abs(once.rgb - two.rgb).max() > 0.05


def test_photos_become_witnesses_of_their_own_as_they_part():
    c2w = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    c2w[:, 0, 3] = 0.0, 0.5 * sweep.APART, 2.0
    alike = sweep.twins(c2w)
    np.testing.assert_allclose(alike, [[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]], atol=1e-6)
    seen = np.asarray([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 1.0]])  # three cuts
    found = sweep.witnesses(seen, alike)
    np.testing.assert_allclose(found, [[2 / 3, 1, 0], [2 / 3, 0, 0], [1, 1, 1]], rtol=1e-6)


def test_where_no_photo_sees_anything_the_rgb_head_stays():
    photos = RNG.random((2, H, W, 3)).astype(np.float32)
    seen_by, (K, c2w) = cameras(2, seed=8), cameras(1, seed=9)
    c2w[:, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # looks the other way
    head = RNG.random((1, H, W, 3)).astype(np.float32)
    found = look(weights(), photos, seen_by, (K, c2w), head=head)
    np.testing.assert_allclose(found.rgb, head, atol=1e-6)
    assert all(np.all(np.isfinite(x)) for x in found[:4])


def test_without_it_the_picture_is_the_rgb_heads():
    params = model.init(jax.random.key(0), TINY)
    assert "lookup" not in params["renderer"]
    views = {
        "context_rgb": np.zeros((1, H, W, 3)),
        "K": np.ones((1, 3, 3)),
        "c2w": np.ones((1, 4, 4)),
    }
    features = RNG.standard_normal((1, 4, 6, 32)).astype(np.float32)
    shown = pictures_of.decode_all(params, features, views, config=TINY, context=views)
    assert shown.rgb is shown.head is shown.photos is shown.coarse
    assert shown.rgb.shape == (1, H, W, 3)


def test_a_window_that_is_not_generated_looks_into_its_photos_where_they_were_taken():
    """Targets alone, as programs ask for them, get the picture that all views together give them."""
    m, n = 2, 3
    K, c2w = cameras(m + n, seed=5)
    views = {
        "context_rgb": textured_plane(K[:m], c2w[:m], 3.0),
        "K": K,
        "c2w": c2w,
        "vectors": RNG.standard_normal((m, 11)).astype(np.float32),
    }
    params = model.init(jax.random.key(0), CONFIG)
    params["renderer"]["lookup"] = weights(0.1)

    shape = jax.eval_shape(lambda p, v: model.reconstruct(p, v, config=CONFIG), params, views).shape
    tokens = RNG.standard_normal(shape).astype(np.float32)

    @jax.jit
    def pictures(params, tokens, views):
        features = model.query_rays(params, tokens, views, config=CONFIG)
        alone = model.only_targets(views)  # as if the targets' cameras were those of the photos
        wrong = model.decode_rgb(params, features[m:], alone, config=CONFIG)
        found, _ = programs.rgb_head(params, views, config=CONFIG, scene_tokens=tokens)
        return found, model.show(params, features, views, config=CONFIG), wrong

    found, want, wrong = pictures(params, tokens, views)
    np.testing.assert_allclose(found, want, atol=1e-5)
    assert np.abs(wrong - want).max() > 1e-2


@pytest.mark.parametrize(
    "renderer", [{"lookup": 1}, {"lookup": 8, "patch": 2}], ids=["one cut", "small patch"]
)
def test_cuts_that_do_not_fit(renderer):
    with pytest.raises(UserError, match=r"renderer\.lookup"):
        dataclasses.replace(TINY, renderer=dataclasses.replace(TINY.renderer, **renderer))


def test_it_is_adapted_by_no_lora_and_off_in_the_published_sizes():
    adapted = flatten(model.adapter_specs(CONFIG))
    assert adapted and not [path for path in adapted if "lookup" in path]
    for name in ("paper", "wan1.3b"):
        assert preset(name).renderer.lookup == 0
    old = to_dict(RoGeConfig())
    del old["renderer"]["lookup"]  # a file from before it existed
    from roge_jax.config import from_dict

    assert from_dict(old).renderer.lookup == 0


def test_cost():
    m, v = 2, 3
    run = functools.partial(lookup.look_up, cuts=CUTS)
    K, c2w = (lambda n: array(n, 3, 3)), (lambda n: array(n, 4, 4))
    p = abstract(lookup.lookup_specs(D, 8, CUTS))
    cfg = dataclasses.replace(CONFIG.renderer, width=D)
    real, formula = {}, {}
    for photos in (m, m + 1):
        real[photos] = multiplied(
            run,
            p,
            array(v, H // 8, W // 8, D),
            array(v, H, W, 3),
            array(photos, H, W, 3),
            (K(v), c2w(v)),
            (K(photos), c2w(photos)),
        )
        formula[photos] = cost.lookup(cfg, H, W, photos, v)
    assert formula[m] <= real[m] <= 1.01 * formula[m]  # projections are not in the formula
    one = formula[m + 1] - formula[m]  # what one more photo costs
    assert one <= real[m + 1] - real[m] <= 1.06 * one
    assert cost.lookup(TINY.renderer, H, W, m, v) == 0.0
    less, more = (cost.preview(c, 3) for c in (TINY, CONFIG))
    assert more - less == pytest.approx(cost.lookup(CONFIG.renderer, H, W, 3, TINY.frames))


@pytest.mark.parametrize("loop", [False, True], ids=["outside loops", "in a loop"])
def test_gradients_of_convolutions(loop):
    x = jnp.asarray(RNG.standard_normal((3, 2, 6, 7, 5)), jnp.float32)
    p = {
        "kernel": jnp.asarray(RNG.standard_normal((3, 3, 5, 4)), jnp.float32),
        "bias": jnp.asarray(RNG.standard_normal(4), jnp.float32),
    }

    def total(f):
        def run(p, x):
            each = lambda x: jnp.square(f(p, x)).sum()  # noqa: E731
            return jax.lax.map(each, x).sum() if loop else sum(each(one) for one in x)

        return jax.jit(jax.value_and_grad(run, argnums=(0, 1)))(p, x)

    plain = lambda p, x: convolve(x, p["kernel"]) + p["bias"].reshape(1, 1, 1, -1)  # noqa: E731
    (a, da), (b, db) = total(conv2d), total(plain)
    np.testing.assert_allclose(a, b, rtol=1e-6)
    for got, want in zip(jax.tree.leaves(da), jax.tree.leaves(db)):
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-3)


def stage(**changes) -> stages.Stage:
    found = stages.find_stage(stages.mini_stages(), "lookup")
    return dataclasses.replace(found, batch=1, views=ViewConfig(targets=2), **changes)


@functools.cache
def one_batch():
    pool = [sample_sequence(3, frames=8, height=H, width=W, supersample=1)]
    return jax.tree.map(jnp.asarray, stages.stage_batch(pool, stage(), CONFIG, 0, 0))


def test_its_stage_trains_all_of_it_and_nothing_else():
    params = model.init(jax.random.key(0), CONFIG)
    params["renderer"]["lookup"] = weights(0.1)
    trainable, frozen = model.split(params, stage().trains)
    assert set(flatten(trainable)) == {f"renderer/lookup/{k}" for k in flatten(weights())}
    objective = functools.partial(stages.recon_objective, config=CONFIG, stage=stage())
    value = jax.value_and_grad(objective, has_aux=True)
    (loss, told), grads = jax.jit(value)(trainable, frozen, one_batch(), jax.random.key(0))
    assert loss > 0 and {"psnr", "psnr_photos"} == set(told)
    for path, g in flatten(grads).items():
        assert np.any(g) and np.all(np.isfinite(g)), path


def test_targets_alone_are_shown_as_among_all_views():
    """What a window shows that is not generated: no rays of the photos, but their pictures from their own places."""
    params = model.init(jax.random.key(0), CONFIG)
    params["renderer"]["lookup"] = weights(0.1)
    kernel = params["renderer"]["rgb_head"]["linear"]["kernel"]
    params["renderer"]["rgb_head"]["linear"]["kernel"] = np.asarray(kernel) + np.float32(0.1)
    views = {name: x[0] for name, x in one_batch().items() if name != "target_rgb"}

    @jax.jit
    def among_all(params, views):
        tokens = model.reconstruct(params, views, config=CONFIG)
        features = model.query_rays(params, tokens, views, config=CONFIG)
        return model.show(params, features, views, config=CONFIG)

    alone, _ = jax.jit(functools.partial(programs.rgb_head, config=CONFIG))(params, views)
    want = among_all(params, views)
    np.testing.assert_allclose(alone, want, atol=1e-4)
    moved = views | {"c2w": views["c2w"].at[0, 0, 3].add(0.5)}  # where the photos stand counts
    assert np.abs(among_all(params, moved) - want).mean() > 1e-3


def test_its_loss_is_that_of_the_picture_and_less_of_its_levels(monkeypatch):
    """Mean squares: all of the picture's, three tenths of what the photos alone and the coarse level miss."""
    target = np.full((1, 2, H, W, 3), 0.4, np.float32)
    views = {
        "target_rgb": target,
        "context_rgb": np.zeros((1, 1, H, W, 3)),
        "K": np.ones((1, 3, 3, 3)),
        "c2w": np.ones((1, 3, 4, 4)),
    }
    small = np.full((2, H // 4, W // 4, 3), 0.4, np.float32)
    shown = lookup.Looked(target[0] + 0.1, target[0] - 0.4, target[0] - 0.2, small + 0.3)
    monkeypatch.setattr(model, "reconstruct", lambda *_, **__: None)
    monkeypatch.setattr(model, "query_rays", lambda *_, **__: None)
    monkeypatch.setattr(stages, "decode_all", lambda *_, **__: shown)
    for lookup_too, want in ((True, 0.01 + 0.3 * (0.04 + 0.09)), (False, 0.01)):
        objective = compiled(stages.recon_objective)
        loss, told = objective(
            {}, {}, views, jax.random.key(0), config=CONFIG, stage=stage(lookup=lookup_too)
        )
        np.testing.assert_allclose(loss, want, rtol=1e-5)
        np.testing.assert_allclose(told["psnr"], 20.0, rtol=1e-5)
        if lookup_too:
            np.testing.assert_allclose(told["psnr_photos"], -10 * np.log10(0.04), rtol=1e-5)


def test_other_reconstruction_stages_leave_it_out():
    for one in stages.mini_stages():
        if one.name in ("recon_low", "recon"):
            trained, _ = stages.stage_specs(CONFIG, one)
            assert not [path for path in flatten(trained) if "lookup" in path]
    plain = dataclasses.replace(stage(lookup=False), trains=stages.RECON)
    results = []
    for fill in (0.0, 0.1):
        params = model.init(jax.random.key(0), CONFIG)
        params["renderer"]["lookup"] = weights(fill)
        trainable, frozen = model.split(params, plain.trains)
        objective = functools.partial(stages.recon_objective, config=CONFIG, stage=plain)
        results.append(jax.jit(objective)(trainable, frozen, one_batch(), jax.random.key(0))[0])
    assert results[0] == results[1]
