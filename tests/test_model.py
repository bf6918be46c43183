"""The model file on the tiny preset: what the joint loss is, what it ignores, what trains, and what step 0 equals."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from parity import rel_l2

from roge_jax import fusion, model
from roge_jax.config import VAEConfig, preset
from roge_jax.core import params
from roge_jax.core.lora import attach
from roge_jax.core.params import flatten, unflatten
from roge_jax.data.views import make_sample
from roge_jax.training import diagnose
from roge_jax.video import dit, flow, vae

at_once = compiled(model)
# The gradient of the whole model takes long to compile. The VAE only encodes here and chunks of views only bound
# memory; both have tests of their own.
_TINY = preset("tiny")
CONFIG = dataclasses.replace(
    _TINY,
    vae=VAEConfig(base=4, res_blocks=1, multipliers=(1, 1, 1, 1)),
    renderer=dataclasses.replace(_TINY.renderer, chunk=8),
)
M, N = 2, CONFIG.frames
SLOTS = CONFIG.slots(M)
TRAINS = r"^(dit|fusion|encoder|renderer)/"
ROUNDING = 1e-5  # relative L2: two float32 programs for the same formula, a few blocks deep


def made_up(specs, seed=0):
    """Random values for every leaf, also those that start at zero or one."""
    rng = np.random.default_rng(seed)

    def leaf(path, spec):
        noise = rng.standard_normal(spec.shape, np.float32)
        if path.endswith(("kernel", "lora_a", "lora_b")):
            lead = int(spec.axes[0] == "layers")
            return jnp.asarray(noise / np.sqrt(np.prod(spec.shape[lead:-1])))
        return jnp.asarray(0.2 * noise + path.endswith(("scale", "gamma")))

    return unflatten({path: leaf(path, spec) for path, spec in flatten(specs).items()})


@functools.cache
def whole():
    """All parameters with random values; the VAE as it is initialised."""
    specs = {name: s for name, s in model.specs(CONFIG).items() if name != "vae"}
    return made_up(specs) | {"vae": model.init(jax.random.key(0), CONFIG)["vae"]}


def sample(seed, contexts=M):
    """One made-up scene as the model takes it."""
    rng = np.random.default_rng(seed)
    v = contexts + N
    c2w = np.broadcast_to(np.eye(4), (v, 4, 4)).copy()
    c2w[:, :3, 3] = rng.uniform(-0.5, 0.5, (v, 3))
    angle = rng.uniform(-0.2, 0.2, v)
    c2w[:, 0, 0] = c2w[:, 2, 2] = np.cos(angle)
    c2w[:, 0, 2], c2w[:, 2, 0] = np.sin(angle), -np.sin(angle)
    K = np.broadcast_to([[50.0, 0, 24.3], [0, 49.0, 15.8], [0, 0, 1]], (v, 3, 3))
    rgb = rng.uniform(size=(v, CONFIG.height, CONFIG.width, 3))
    return make_sample(rgb, K, c2w, contexts, scale_rule=CONFIG.scale_rule)


def batch(*seeds):
    samples = [sample(seed) for seed in seeds]
    return {name: jnp.asarray(np.stack([s[name] for s in samples])) for name in samples[0]}


# The joint loss and its gradient.

TRACES = itertools.count()


@functools.partial(jax.jit, static_argnames="photometric")
def loss_and_gradient(trainable, frozen, batch, key, photometric=CONFIG.flow.photometric):
    next(TRACES)
    return jax.value_and_grad(model.loss, has_aux=True)(
        trainable, frozen, batch, key, config=CONFIG, remat="none"
    )


@functools.cache
def parts():
    """(trainable, frozen): every network but the VAE, and LoRA factors, with nothing at zero."""
    trainable, frozen = model.split(whole(), TRAINS)
    return attach(trainable, made_up(model.adapter_specs(CONFIG), seed=1)), frozen


@functools.cache
def evaluated():
    return loss_and_gradient(*parts(), batch(0, 1), jax.random.key(0))


def test_the_joint_loss_is_flow_matching_plus_lambda_times_photometric():
    (loss, terms), _ = evaluated()
    assert CONFIG.flow.photometric == 0.1
    np.testing.assert_allclose(loss, terms["flow"] + 0.1 * terms["photometric"], rtol=1e-6)
    assert terms["flow"] > 0 and terms["photometric"] > 0


def test_the_photometric_term_is_the_error_of_the_rgb_head_on_all_views():
    views = jax.tree.map(lambda x: x[0], batch(0))
    rng = np.random.default_rng(0)
    grid = (CONFIG.recon_height // 8, CONFIG.recon_width // 8)
    features = jnp.asarray(rng.standard_normal((M + N, *grid, CONFIG.renderer.width)), jnp.float32)
    rgb = at_once.decode_rgb(whole(), features, views, config=CONFIG)
    truth = np.concatenate([views["context_rgb"], views["target_rgb"]])
    want = np.square(np.asarray(rgb, np.float64) - truth).mean()
    got = at_once.photometric(rgb, views, config=CONFIG)
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_every_trainable_leaf_gets_a_gradient_and_nothing_else_does():
    trainable, frozen = parts()
    _, grads = evaluated()
    flat = flatten(grads)
    assert flat.keys() == flatten(trainable).keys()
    assert not flat.keys() & flatten(frozen).keys()
    assert {path.split("/")[0] for path in flatten(frozen)} == {"vae", "prompt"}
    without = [path for path, g in flat.items() if not np.any(np.asarray(g))]
    assert without == []
    assert all(np.isfinite(np.asarray(g)).all() for g in flat.values())


def test_many_batches_are_traced_once():
    evaluated()
    before = next(TRACES)
    trainable, frozen = parts()
    losses = {
        float(loss_and_gradient(trainable, frozen, batch(i, i + 1), jax.random.key(i))[0][0])
        for i in (2, 4, 6)
    }
    assert len(losses) == 3
    assert next(TRACES) == before + 1


def test_what_the_paper_trains():
    """LoRA on both halves, the first patch embedding and the new ones; nothing of the VAE or the prompt."""
    full, _ = model.split(model.specs(CONFIG), model.NEW_EMBEDDINGS)
    layers = {path.rpartition("/")[0] for path in flatten(full)}
    assert layers == {
        "dit/patch_embed",
        "fusion/geometry_adapter",
        "fusion/rays_embed",
        "fusion/geometry_embed",
    }
    adapted = {path.rpartition("/")[0] for path in flatten(model.adapter_specs(CONFIG))}
    assert {path.split("/")[0] for path in adapted} == {"dit", "encoder", "renderer"}
    assert {"renderer/ray_embed", "renderer/rgb_head/linear", "encoder/connector"} <= adapted
    assert not adapted & layers
    assert not [path for path in adapted if "_img" in path]


def test_pictures_reach_the_vae_between_minus_one_and_one():
    """Photos one by one, videos as a whole, and back: black is -1, white is 1."""
    rgb = jnp.asarray(np.random.default_rng(2).random((5, 16, 24, 3)), jnp.float32)
    p, cfg, codec = whole(), CONFIG.vae, compiled(vae)
    video = at_once.encode_targets(p, rgb, config=CONFIG)
    np.testing.assert_allclose(video, codec.encode(p["vae"], 2 * rgb - 1, cfg=cfg), atol=1e-5)
    photos = at_once.encode_contexts(p, rgb, config=CONFIG)
    np.testing.assert_allclose(
        photos, codec.encode_frames(p["vae"], 2 * rgb - 1, cfg=cfg), atol=1e-5
    )
    shown = at_once.decode_video(p, video, config=CONFIG)
    raw = np.asarray(codec.decode(p["vae"], video, cfg=cfg))
    np.testing.assert_allclose(shown, np.clip((raw + 1) / 2, 0, 1), atol=1e-5)
    # A first frame is coded as a photo of it.
    np.testing.assert_allclose(video[0], photos[0], atol=1e-5)


def test_the_reconstruction_does_not_know_the_size_of_the_video():
    """Pictures and cameras at its own size: the same tokens, rays and picture whatever size is generated."""
    small = dataclasses.replace(CONFIG, recon_height=16, recon_width=32)
    alone = dataclasses.replace(small, height=16, width=32)
    views = {k: jnp.asarray(v) for k, v in sample(5).items() if k != "target_rgb"}
    views["context_recon"] = model.resized(views["context_rgb"], 16, 32)
    scale = jnp.asarray([32 / CONFIG.width, 16 / CONFIG.height, 1.0])[None, :, None]
    own = views | {"context_rgb": views["context_recon"], "K": views["K"] * scale}

    @functools.partial(jax.jit, static_argnames="config")
    def seen(p, views, config):
        tokens = model.reconstruct(p, views, config=config)
        return tokens, model.query_rays(p, tokens, views, config=config)

    for got, want in zip(seen(whole(), views, small), seen(whole(), own, alone)):
        assert rel_l2(got, want) < ROUNDING
    del views["context_recon"]  # resized where nothing sharper is given
    want = seen(whole(), own, alone)[0]
    assert rel_l2(seen(whole(), views, small)[0], want) < ROUNDING
    assert rel_l2(seen(whole(), own | {"K": views["K"]}, alone)[0], want) > 1e-2


# What the flow term ignores.


def with_constant_velocity():
    """Weights under which the velocity is the head's bias, whatever goes in."""
    p = whole()
    head = p["dit"]["head"] | {
        "linear": p["dit"]["head"]["linear"]
        | {"kernel": jnp.zeros_like(p["dit"]["head"]["linear"]["kernel"])}
    }
    return p | {"dit": p["dit"] | {"head": head}}


@functools.partial(jax.jit, static_argnames="contexts")
def flow_term(p, x0, cond, key, contexts=M):
    return model.flow_matching(p, x0, cond, key, config=CONFIG, contexts=contexts, remat="none")


def test_the_loss_ignores_context_slots():
    """With a velocity that does not look at its input, only the latents and noise of target slots count."""
    p, key = with_constant_velocity(), jax.random.key(3)
    rng = np.random.default_rng(0)
    x0 = jnp.asarray(rng.standard_normal((SLOTS, *CONFIG.latent_size, 16)), jnp.float32)
    cond = fusion.unconditioned(x0[:M], SLOTS, CONFIG)
    got = flow_term(p, x0, cond, key)
    assert float(flow_term(p, x0.at[:M].add(7.0), cond, key)) == float(got)
    assert float(flow_term(p, x0.at[M:].add(7.0), cond, key)) != float(got)

    # The same number from the definition, with the draws of the same key.
    key_sigma, key_noise = jax.random.split(jax.random.split(key, 1)[0])
    sigma = flow.training_sigma(
        key_sigma, method=CONFIG.flow.sigma_sampling, shift=CONFIG.flow.shift
    )
    noise = np.asarray(jax.random.normal(key_noise, x0.shape), np.float64)
    bias = np.asarray(p["dit"]["head"]["linear"]["bias"], np.float64).reshape(2, 2, 16)
    v = np.tile(bias, (CONFIG.latent_size[0] // 2, CONFIG.latent_size[1] // 2, 1))
    error = np.square(v[None] - (noise - np.asarray(x0, np.float64)))[M:].mean()
    weight = flow.loss_weight(sigma, weighting=CONFIG.flow.weighting, shift=CONFIG.flow.shift)
    np.testing.assert_allclose(got, float(weight) * error, rtol=1e-5)


def test_the_noise_levels_of_a_step_are_one_from_each_part(monkeypatch):
    """The mean over 40 levels hardly varies between keys; that of 40 free draws would by 0.04."""

    def level(params, x0, cond, key, *, config, contexts, part=None):
        sigma = flow.training_sigma(key, shift=config.flow.shift, part=part)
        return flow.Noised(sigma, x0, x0, x0, x0)

    monkeypatch.setattr(model, "noised", level)
    options = {"config": CONFIG, "contexts": M}

    def mean(i, draws):
        found = model.noised_draws(
            {}, jnp.zeros(()), None, jax.random.key(i), draws=draws, **options
        )
        assert found.sigma.shape == (draws,)
        return float(found.sigma.mean())

    means = [mean(i, 40) for i in range(8)]
    assert 0.0 < np.std(means) < 0.01
    assert np.std([mean(i, 1) for i in range(8)]) > 0.05


# Every named quantity of a training sample.


def distance(found, views):
    """Another term, in five lines: how far the latents that the velocity implies are from the true ones."""
    m = len(views["context_rgb"])
    return {"x0": 0.1 * jnp.abs(found.predicted_x0 - found.x0[None])[:, m:].mean()}


@functools.cache
def looked_at(draws=2):
    trainable, frozen = parts()
    views = jax.tree.map(lambda x: x[0], batch(0))

    @jax.jit
    def run(trainable, frozen, views, key):
        params = attach(frozen, trainable)
        options = {"config": CONFIG, "draws": draws, "remat": "none"}
        found = model.intermediates(params, views, key, **options)
        return found, model.scene_loss(params, views, key, more=distance, **options)

    return views, *run(trainable, frozen, views, jax.random.key(5))


def test_intermediates_are_what_their_names_say():
    views, found, _ = looked_at()
    v, latents = M + N, (SLOTS, *CONFIG.latent_size, CONFIG.vae.latent)
    assert found.scene_tokens.shape[0] == M and found.features.shape[0] == v
    assert found.rgb.shape == (v, CONFIG.recon_height, CONFIG.recon_width, 3)
    assert found.x0.shape == latents and found.sigma.shape == (2,)
    assert {x.shape for x in found[-4:]} == {(2, *latents)}
    sigma = np.asarray(found.sigma)[:, None, None, None, None]
    assert (sigma > 0).all() and sigma[0] != sigma[1]
    x0, noise, x, velocity = (np.asarray(a) for a in (found.x0, *found[-4:-1]))
    np.testing.assert_allclose(x, (1 - sigma) * x0 + sigma * noise, atol=1e-5)
    np.testing.assert_allclose(found.predicted_x0, x - sigma * velocity, atol=1e-5)
    known = at_once.encode_contexts(whole(), views["context_rgb"], config=CONFIG)
    np.testing.assert_allclose(x0[:M], known, atol=1e-5)


def test_the_terms_are_made_of_the_intermediates_and_another_one_is_added():
    views, found, terms = looked_at()
    off = np.square(np.asarray(found.velocity) - (np.asarray(found.noise) - np.asarray(found.x0)))
    cfg = CONFIG.flow
    weight = flow.loss_weight(found.sigma, weighting=cfg.weighting, shift=cfg.shift)
    want = (np.asarray(weight) * off[:, M:].mean((1, 2, 3, 4))).mean()
    np.testing.assert_allclose(terms["flow"], want, rtol=1e-5)
    photometric = at_once.photometric(found.rgb, views, config=CONFIG)
    np.testing.assert_allclose(terms["photometric"], photometric, rtol=1e-5)
    np.testing.assert_allclose(terms["x0"], distance(found, views)["x0"], rtol=1e-5)
    assert terms["x0"] > 0


def test_another_term_is_added_to_the_loss(monkeypatch):
    given = {"flow": jnp.float32(2.0), "photometric": jnp.float32(10.0)}
    monkeypatch.setattr(
        model,
        "scene_loss",
        lambda *_, more, **__: given | ({} if more is None else more(None, None)),
    )
    one = {"K": jnp.zeros((1, 3, 3))}
    total = {
        more: model.loss({}, {}, one, jax.random.key(0), config=CONFIG, more=more)[0]
        for more in (None, lambda found, views: {"mine": jnp.float32(0.5)})
    }
    np.testing.assert_allclose(list(total.values()), [3.0, 3.5])


# Symmetry of the context slots.


@jax.jit
def velocity(p, x, cond):
    return model.velocity(p, x, jnp.asarray(0.7), cond, config=CONFIG, contexts=3)


def test_permuting_context_slots_permutes_their_outputs_and_leaves_the_targets():
    rng = np.random.default_rng(1)
    m, slots = 3, CONFIG.slots(3)
    lh, lw = CONFIG.latent_size
    x = jnp.asarray(rng.standard_normal((slots, lh, lw, 16)), jnp.float32)
    known = jnp.asarray(rng.standard_normal((slots, lh, lw, 20)), jnp.float32)
    tokens = jnp.asarray(rng.standard_normal((slots, lh * lw // 4, CONFIG.dit.width)), jnp.float32)

    def run(order):
        cond = fusion.Condition(known[order], tokens[order].reshape(-1, CONFIG.dit.width))
        return velocity(whole(), x[order], cond)

    plain = run(jnp.arange(slots))
    order = jnp.asarray([2, 0, 1, *range(m, slots)])
    assert rel_l2(run(order), plain[order]) < ROUNDING
    assert rel_l2(plain[order][:m], plain[:m]) > 1e-2  # the contexts do differ
    targets = jnp.asarray([*range(m), slots - 1, *range(m, slots - 1)])
    assert rel_l2(run(targets), plain[targets]) > 1e-2  # targets have an order


# A model that shows its transformer what the reconstruction alone would have shown.
PREVIEW = dataclasses.replace(CONFIG, fusion=dataclasses.replace(CONFIG.fusion, preview=True))


@pytest.mark.parametrize("config", [CONFIG, PREVIEW], ids=["zeros", "preview"])
def test_permuting_context_views_permutes_their_conditions(config):
    rng = np.random.default_rng(2)
    order = np.asarray([1, 0, *range(M, M + N)])
    slots = np.asarray([1, 0, *range(M, SLOTS)])
    views = {k: jnp.asarray(v) for k, v in sample(3).items()}
    grid = (CONFIG.recon_height // 8, CONFIG.recon_width // 8)
    features = jnp.asarray(rng.standard_normal((M + N, *grid, CONFIG.renderer.width)), jnp.float32)
    known = jnp.asarray(rng.standard_normal((M, *CONFIG.latent_size, 16)), jnp.float32)

    def run(order):
        turned = views | {k: views[k][order] for k in ("K", "c2w")}
        return at_once.condition(whole(), known[order[:M]], features[order], turned, config=config)

    plain, turned = run(np.arange(M + N)), run(order)
    np.testing.assert_array_equal(turned.appearance, plain.appearance[slots])
    tokens = plain.tokens.reshape(SLOTS, -1, CONFIG.dit.width)
    assert rel_l2(turned.tokens.reshape(tokens.shape), tokens[slots]) < ROUNDING


def made_condition(config):
    """(known latents, ray features, views) of a scene, random."""
    rng = np.random.default_rng(4)
    grid = (config.recon_height // 8, config.recon_width // 8)
    features = rng.standard_normal((M + N, *grid, config.renderer.width))
    known = rng.standard_normal((M, *config.latent_size, 16))
    views = {k: jnp.asarray(v) for k, v in sample(4).items()}
    return jnp.asarray(known, jnp.float32), jnp.asarray(features, jnp.float32), views


def measured(config, mean, std):
    stats = {"feature_mean": tuple(map(float, mean)), "feature_std": tuple(map(float, std))}
    return dataclasses.replace(config, fusion=dataclasses.replace(config.fusion, **stats))


def test_features_are_standardised_by_their_statistics():
    rng = np.random.default_rng(7)
    x = rng.normal(3.0, 5.0, (50, 4, 6, CONFIG.renderer.width)).astype(np.float32)
    config = measured(CONFIG, x.mean((0, 1, 2)), x.std((0, 1, 2)))
    y = np.asarray(fusion.standardised(jnp.asarray(x), config))
    np.testing.assert_allclose(y.mean((0, 1, 2)), 0.0, atol=1e-5)
    np.testing.assert_allclose(y.std((0, 1, 2)), 1.0, atol=1e-5)
    assert fusion.standardised(x, CONFIG) is x


def test_other_statistics_do_not_change_what_a_fusion_does():
    rng = np.random.default_rng(8)
    known, features, views = made_condition(CONFIG)
    width = CONFIG.renderer.width
    p, config = whole(), CONFIG
    want = at_once.condition(p, known, features, views, config=config).tokens
    for _ in range(2):  # from none, and from one to another
        new = measured(config, rng.normal(0, 3, width), rng.uniform(0.1, 9, width))
        p = p | {"fusion": fusion.restandardised(p["fusion"], config.fusion, new.fusion)}
        config = new
        got = at_once.condition(p, known, features, views, config=config).tokens
        assert rel_l2(got, want) < ROUNDING
    assert rel_l2(at_once.condition(p, known, features, views, config=CONFIG).tokens, want) > 0.1


# Step 0.


def test_new_embeddings_and_lora_start_without_any_effect():
    """A fresh RoGe computes, bit for bit, what the pretrained transformer computes from the appearance alone."""
    fresh = fusion.fusion_specs(CONFIG)
    p = whole() | {"fusion": params.init(jax.random.key(1), fresh)}
    views = {k: jnp.asarray(v) for k, v in sample(4).items()}
    rng = np.random.default_rng(4)
    grid = (CONFIG.recon_height // 8, CONFIG.recon_width // 8)
    features = jnp.asarray(rng.standard_normal((M + N, *grid, CONFIG.renderer.width)), jnp.float32)
    known = jnp.asarray(rng.standard_normal((M, *CONFIG.latent_size, 16)), jnp.float32)
    x = jnp.asarray(rng.standard_normal((SLOTS, *CONFIG.latent_size, 16)), jnp.float32)
    sigma, cfg = jnp.asarray(0.6), CONFIG.dit

    @jax.jit
    def roge(p):
        cond = model.condition(p, known, features, views, config=CONFIG)
        return model.velocity(p, x, sigma, cond, config=CONFIG, contexts=M)

    @jax.jit
    def pretrained(p):
        times = fusion.time_index(M, SLOTS)
        lh, lw = CONFIG.latent_size
        angles = dit.rope_angles(times, lh // 2, lw // 2, cfg.width // cfg.heads)
        seen = jnp.concatenate([x, fusion.appearance(known, SLOTS)], -1)
        rows = dit.context_rows(p["dit"], p["prompt"]["rows"], cfg=cfg)
        return dit.dit(p["dit"], seen, 1000.0 * sigma, jnp.asarray(angles), cfg=cfg, rows=rows)

    want = pretrained(p)
    np.testing.assert_array_equal(roge(p), want)
    factors = params.init(jax.random.key(2), model.adapter_specs(CONFIG))
    np.testing.assert_array_equal(roge(attach(p, factors)), want)
    assert rel_l2(roge(whole()), want) > 1e-2  # with trained embeddings it is another function


def test_step_0_can_learn():
    """The zero embeddings get a gradient at once, because what they multiply is not zero."""
    fresh = params.init(jax.random.key(1), fusion.fusion_specs(CONFIG))
    rng = np.random.default_rng(5)
    views = {k: jnp.asarray(v) for k, v in sample(5).items()}
    grid = (CONFIG.recon_height // 8, CONFIG.recon_width // 8)
    features = jnp.asarray(rng.standard_normal((M + N, *grid, CONFIG.renderer.width)), jnp.float32)
    known = jnp.zeros((M, *CONFIG.latent_size, 16))

    @jax.jit
    @jax.grad
    def gradient(p):
        cond = model.condition({"fusion": p}, known, features, views, config=CONFIG)
        return (
            cond.tokens * jnp.cos(jnp.arange(cond.tokens.size)).reshape(cond.tokens.shape)
        ).sum()

    first = gradient(fresh)
    for name in ("rays_embed", "geometry_embed"):
        assert np.any(first[name]["kernel"]), name
    assert not np.any(first["geometry_adapter"]["kernel"])  # behind a zero: moves from step 1 on
    moved = jax.tree.map(lambda p, g: p - 1e-3 * g, fresh, first)
    assert np.any(gradient(moved)["geometry_adapter"]["kernel"])


# Sampling.


def test_the_three_modes_of_context_slots():
    rng = np.random.default_rng(6)
    x0, x, noise = (jnp.asarray(rng.standard_normal((s, 2, 2, 16)), jnp.float32) for s in (M, 5, 5))
    sigma = jnp.asarray(0.25)
    assert flow.context_projection(x0, noise, "free") is None
    noised = flow.context_projection(x0, noise, "noised")(x, sigma)
    np.testing.assert_allclose(noised[:M], 0.75 * x0 + 0.25 * noise[:M], rtol=1e-6)
    clean = flow.context_projection(x0, noise, "clean")(x, sigma)
    np.testing.assert_array_equal(clean[:M], x0)
    for y in (noised, clean):
        np.testing.assert_array_equal(y[M:], x[M:])


# Diagnostics of joint training.


@pytest.mark.slow  # compiles the whole model forwards and twice backwards
def test_diagnostics_agree_with_the_gradient_of_the_loss():
    trainable, frozen = parts()
    run = diagnose.joint_diagnose(CONFIG, bins=4)
    found = run(trainable, frozen, batch(0, 1), jax.random.key(0))
    shared = [g for path, g in flatten(evaluated()[1]).items() if path.startswith(diagnose.SHARED)]
    total = sum(float(jnp.sum(jnp.square(g))) for g in shared)
    one, two, cosine = (
        found[k] for k in ("flow_grad_norm", "photometric_grad_norm", "grad_cosine")
    )
    assert one > 0 and two > 0 and -1 <= cosine <= 1
    # |a + b|^2 = |a|^2 + |b|^2 + 2 cos |a| |b|
    np.testing.assert_allclose(one**2 + two**2 + 2 * cosine * one * two, total, rtol=1e-3)
    names = [f"flow_sigma_{s:.2f}" for s in (0.125, 0.375, 0.625, 0.875)]
    assert [n for n in found if n.startswith("flow_sigma")] == names
    # A velocity that does not look at its input errs alike at every level.
    constant = with_constant_velocity()
    p = attach(trainable, {"dit": {"head": constant["dit"]["head"]}})
    alike = run(p, frozen, batch(0, 1), jax.random.key(0))
    values = [alike[n] for n in names]
    np.testing.assert_allclose(values, values[0], rtol=1e-5)
    assert max(found[n] for n in names) > 1.01 * min(found[n] for n in names)


# The published sizes.


def test_the_paper_has_the_official_parameter_counts():
    cfg = preset("paper")
    specs = model.specs(cfg)
    assert params.count({k: specs[k] for k in ("encoder", "renderer")}) == 1_103_348_352
    assert params.count(specs["dit"]) == 16_394_878_784
    assert params.count(specs["vae"]) == 126_892_531
    assert params.count(model.adapter_specs(cfg)["dit"]) == 153_354_240
    for leaf in flatten(params.abstract(specs)).values():
        assert isinstance(leaf, jax.ShapeDtypeStruct)


def test_wan_1_3b_is_the_official_one_with_twenty_more_input_channels():
    specs = model.specs(preset("wan1.3b"))
    assert params.count(specs["dit"]) == 1_418_996_800 + 4 * 20 * 1536
    assert params.count(specs["vae"]) == 126_892_531
    assert params.count({k: specs[k] for k in ("encoder", "renderer")}) == 1_103_348_352


@pytest.mark.parametrize("name", ["wan1.3b", "paper"])
def test_the_published_sizes_trace_from_photos_to_velocity(name):
    """Shapes only: every stage of a whole window at the paper's resolutions, without a single array."""
    cfg, m = preset(name), 3
    v, (lh, lw) = m + cfg.frames, cfg.latent_size

    def shape(*dims):
        return jax.ShapeDtypeStruct(dims, jnp.float32)

    views = {
        "context_rgb": shape(m, cfg.height, cfg.width, 3),
        "context_recon": shape(m, cfg.recon_height, cfg.recon_width, 3),
        "K": shape(v, 3, 3),
        "c2w": shape(v, 4, 4),
        "vectors": shape(m, 11),
    }

    def run(p, views, x):
        prepared = model.prepare(p, views, config=cfg)
        v = model.velocity(
            p, x, jnp.asarray(0.5), prepared.condition, config=cfg, contexts=m, text=prepared.text
        )
        return prepared, v

    x = shape(m + 21, lh, lw, 16)
    prepared, v = jax.eval_shape(run, params.abstract(model.specs(cfg)), views, x)
    assert v.shape == x.shape == (24, 24, 42, 16)
    assert prepared.features.shape == (84, 36, 63, 768)
    assert prepared.condition.appearance.shape == (24, 24, 42, 20)
    assert prepared.condition.tokens.shape == (24 * 12 * 21, cfg.dit.width)


def test_scenes_one_by_one_equal_all_at_once():
    def scene(factor, views, key):
        return {"sum": factor * (views["a"] @ views["a"].T).sum() + jax.random.normal(key)}

    batch = {"a": jax.random.normal(jax.random.key(0), (3, 4, 5))}
    keys = jax.random.split(jax.random.key(1), 3)
    together = jax.vmap(scene, (None, 0, 0))(2.0, batch, keys)["sum"]
    found = model.over_scenes(scene, 2.0, batch, keys)["sum"]
    np.testing.assert_allclose(found, together, rtol=1e-6)
