"""The preview: what stands where the paper has zeros, whose velocity is corrected, and what its detail gives back."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from test_model import CONFIG, PREVIEW, SLOTS, M, N, made_condition, sample, whole

from roge_jax import fusion, model, preview
from roge_jax.video import flow, solvers

model, preview = compiled(model), compiled(preview)


def shrunk(config, factor):
    """The same model with smaller reconstruction images, in whole patches."""
    height, width = config.recon_height // factor, -(-config.recon_width // factor // 8) * 8
    return dataclasses.replace(config, recon_height=height, recon_width=width)


@pytest.mark.parametrize("shrink", [1, 2], ids=["same size", "half size"])
def test_the_preview_stands_where_the_targets_have_zeros(shrink):
    config = shrunk(PREVIEW, shrink)
    known, features, views = made_condition(config)
    cond = model.condition(whole(), known, features, views, config=config)
    frames = model.decode_rgb(whole(), features, views, config=config)[M:]
    if shrink > 1:
        frames = jax.image.resize(frames, (N, config.height, config.width, 3), "bilinear")
    latents = model.encode_targets(whole(), frames, config=config)
    assert np.any(latents)
    np.testing.assert_allclose(cond.appearance[M:, ..., 4:], latents, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(cond.appearance[:M, ..., 4:], known)
    seen = np.broadcast_to(
        np.arange(SLOTS)[:, None, None, None] < M, (SLOTS, *config.latent_size, 4)
    )
    np.testing.assert_array_equal(cond.appearance[..., :4], seen)
    plain = dataclasses.replace(config, fusion=CONFIG.fusion)
    without = model.condition(whole(), known, features, views, config=plain)
    assert not np.any(without.appearance[M:])
    np.testing.assert_allclose(cond.tokens, without.tokens, rtol=1e-5, atol=1e-6)


def test_no_gradient_passes_through_the_preview():
    known, features, views = made_condition(PREVIEW)

    def shown(p, features):
        return jnp.square(
            model.condition(p, known, features, views, config=PREVIEW).appearance
        ).sum()

    for leaf in jax.tree.leaves(jax.jit(jax.grad(shown, argnums=(0, 1)))(whole(), features)):
        assert not np.any(leaf)


SPREAD = tuple(float(f"{x:.3g}") for x in np.geomspace(0.1, 0.6, 16))
ABOUT = dataclasses.replace(PREVIEW, fusion=dataclasses.replace(PREVIEW.fusion, preview_std=SPREAD))


def silent(p):
    """The same parameters, with a transformer that says 0."""
    return p | {"dit": p["dit"] | {"head": jax.tree.map(np.zeros_like, p["dit"]["head"])}}


def test_a_transformer_that_says_nothing_generates_the_preview_and_its_error():
    """The exact flow of a normal distribution: noise arrives at preview + spread * noise."""
    rng = np.random.default_rng(5)
    known, guess, noise = (
        jnp.asarray(rng.standard_normal((n, *CONFIG.latent_size, 16)), jnp.float32)
        for n in (M, SLOTS - M, SLOTS)
    )
    cond = fusion.Condition(
        fusion.appearance(known, SLOTS, guess), jnp.zeros(()), jnp.asarray(SPREAD)
    )

    def nothing(x, sigma):
        return preview.velocity(jnp.zeros_like(x), x, sigma, cond, M)

    found, _ = solvers.solve("rk4", nothing, noise, flow.schedule("graded", 40))
    want = guess + np.asarray(SPREAD)[None, None, None] * noise[M:]
    np.testing.assert_allclose(found[M:], want, atol=2e-4)
    coarse, _ = solvers.solve("euler", nothing, noise, flow.schedule("graded", 4))
    assert np.abs(coarse[M:] - want).max() > 0.05, "steps matter"


def test_about_a_preview_the_transformer_corrects_in_units_of_its_error():
    velocity = model.velocity
    known, features, views = made_condition(ABOUT)
    x = model.draw_noise(jax.random.key(6), M, config=ABOUT)
    said, quiet, plain = (
        velocity(
            p,
            x,
            jnp.float32(1.0),
            model.condition(p, known, features, views, config=config),
            config=config,
            contexts=M,
        )
        for p, config in ((whole(), ABOUT), (silent(whole()), ABOUT), (whole(), PREVIEW))
    )
    np.testing.assert_allclose(
        (said - quiet)[M:], np.asarray(SPREAD)[None, None, None] * plain[M:], rtol=1e-4, atol=1e-5
    )
    np.testing.assert_array_equal(said[:M], plain[:M])  # contexts: the velocity itself
    alone = fusion.unconditioned(known, SLOTS, ABOUT)  # and wherever no preview is shown
    np.testing.assert_array_equal(
        velocity(whole(), x, jnp.float32(0.5), alone, config=ABOUT, contexts=M),
        velocity(whole(), x, jnp.float32(0.5), alone, config=CONFIG, contexts=M),
    )


@pytest.mark.parametrize("shrink", [1, 2], ids=["same size", "half size"])
def test_latents_left_as_they_are_come_out_as_the_reconstructions_own_picture(shrink):
    config = shrunk(ABOUT, shrink)
    known, features, views = made_condition(config)
    cond = model.condition(whole(), known, features, views, config=config)
    shown = model.show(whole(), features, views, config=config)
    detail = preview.lost_detail(whole(), shown, cond, config=config)
    shown = model.resized(shown, config.height, config.width)
    left = cond.appearance[M:, ..., 4:]
    decode = functools.partial(model.decode_video, whole(), config=config)
    blurred = decode(left)
    assert np.abs(blurred - shown).max() > 0.05
    np.testing.assert_allclose(decode(left, detail=detail), shown, atol=2e-5)
    # Another latent changes the picture by what the VAE makes of the difference.
    noise = np.random.default_rng(2).standard_normal(left.shape, np.float32)
    other = left + np.float32(0.002) * noise
    change = decode(other, detail=detail) - decode(left, detail=detail)
    middle = [(x > 0.2) & (x < 0.8) for x in (shown, blurred)]
    inside = middle[0] & middle[1]
    assert inside.any()
    np.testing.assert_allclose(change[inside], (decode(other) - blurred)[inside], atol=2e-5)


def test_what_is_prepared_holds_the_detail_where_there_is_a_preview():
    views = {k: jnp.asarray(v) for k, v in sample(4).items() if k != "target_rgb"}
    ready = jax.jit(functools.partial(model.prepare, config=ABOUT))(whole(), views)
    want = preview.lost_detail(whole(), ready.shown, ready.condition, config=ABOUT)
    np.testing.assert_allclose(ready.detail, want, atol=1e-5)
    assert ready.detail.shape == (N, CONFIG.height, CONFIG.width, 3)
    plain = functools.partial(model.prepare, config=CONFIG)
    assert jax.eval_shape(plain, whole(), views).detail is None
