"""The video VAE: parity with the published network, causality, chunks, weight map, pass-through initial values."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parity import key_listing, load_case, rel_l2, rule_weights

from roge_jax.config import VAEConfig, preset
from roge_jax.core.params import abstract, check, count, flatten, unflatten
from roge_jax.errors import UserError
from roge_jax.training import stages
from roge_jax.video import vae, vae_training
from roge_jax.weights import mapping, wan_vae

SMALL = VAEConfig(base=4, res_blocks=1)  # two of them, as published, in the parity cases
encode = jax.jit(functools.partial(vae.encode, cfg=SMALL))
decode = jax.jit(functools.partial(vae.decode, cfg=SMALL))


def channels_last(x):
    """[1, c, t, h, w] -> [t, h, w, c]."""
    return np.moveaxis(x[0], 0, -1)


def from_official(weights, cfg):
    params = mapping.to_ours(wan_vae.mapping(cfg), weights)
    check(params, vae.vae_specs(cfg))
    return jax.tree.map(jnp.asarray, params)


@pytest.fixture(scope="module")
def small():
    """Random parameters in which no leaf is zero or one, a video and latents."""
    rng = np.random.default_rng(0)

    def leaf(path, spec):
        x = rng.normal(size=spec.shape)
        if len(spec.shape) > 1:
            x = x / np.sqrt(np.prod(spec.shape[:-1]))
        else:
            x = 0.2 * x + path.endswith("scale")
        return jnp.asarray(x, jnp.float32)

    specs = flatten(vae.vae_specs(SMALL))
    params = unflatten({path: leaf(path, spec) for path, spec in specs.items()})
    video = jax.random.uniform(jax.random.key(2), (13, 16, 24, 3), minval=-1.0)
    latents = jax.random.normal(jax.random.key(3), (4, 2, 3, 16))
    return params, video, latents


# ------------------------------------------------------------------------------------------------------------ parity
@pytest.fixture(scope="module")
def tiny_case():
    case = load_case("wan_vae_tiny")
    cfg = VAEConfig(base=case.config["dim"], latent=case.config["z_dim"])
    return case, cfg, from_official(rule_weights(case), cfg)


def assert_parity(case, cfg, params, t, tolerance):
    video = channels_last(case.tensors[f"in.video_T{t}"])
    latents = channels_last(case.tensors[f"out.latent_T{t}"])
    moments = jax.jit(functools.partial(vae.encode_moments, cfg=cfg))(params, video)
    decoded = jax.jit(functools.partial(vae.decode, cfg=cfg))(params, latents)
    assert rel_l2(moments, channels_last(case.tensors[f"mid.moments_T{t}"])) <= tolerance
    assert rel_l2(vae.normalise(moments[..., : cfg.latent], cfg=cfg), latents) <= tolerance
    assert rel_l2(decoded, channels_last(case.tensors[f"out.decoded_unclamped_T{t}"])) <= tolerance


@pytest.mark.parametrize("t", [1, 5, 13])
def test_matches_the_official_network(tiny_case, t):
    assert_parity(*tiny_case, t, 1e-5)


@pytest.mark.slow
def test_matches_the_official_network_at_full_width():
    case = load_case("wan_vae_real")
    cfg = VAEConfig(base=case.config["dim"])
    assert cfg == VAEConfig()
    assert_parity(case, cfg, from_official(rule_weights(case), cfg), 5, 1e-4)


@pytest.mark.parity
def test_matches_diffusers(small):
    torch = pytest.importorskip("torch")
    diffusers = pytest.importorskip("diffusers")
    params, video, _ = small
    theirs = diffusers.AutoencoderKLWan(base_dim=SMALL.base, num_res_blocks=1).eval()
    state = mapping.to_theirs(wan_vae.mapping(SMALL, "diffusers"), params)
    state = {key: torch.tensor(value) for key, value in state.items()}
    assert {k: v.shape for k, v in theirs.state_dict().items()} == {
        k: v.shape for k, v in state.items()
    }
    theirs.load_state_dict(state)

    with torch.no_grad():
        batch = torch.tensor(np.moveaxis(np.asarray(video), -1, 0)[None])
        mean = theirs.encode(batch).latent_dist.mean
        decoded = theirs.decode(mean).sample  # diffusers clamps
    latents = encode(params, video)
    assert rel_l2(vae.denormalise(latents, cfg=SMALL), channels_last(mean.numpy())) <= 1e-5
    ours = jnp.clip(decode(params, latents), -1.0, 1.0)
    assert rel_l2(ours, channels_last(decoded.numpy())) <= 1e-5
    assert float(jnp.mean(jnp.abs(ours) < 1)) > 0.5  # the comparison is not one of clamped values


# -------------------------------------------------------------------------------------------------------------- time
def test_chunks_equal_the_whole(small):
    """Float32 rounding only: the same sums, grouped differently, through about 30 layers."""
    params, video, latents = small
    chunked = jax.jit(functools.partial(vae.encode_chunked, cfg=SMALL))(params, video)
    assert rel_l2(chunked, encode(params, video)) <= 1e-5
    chunked = jax.jit(functools.partial(vae.decode_chunked, cfg=SMALL))(params, latents)
    assert rel_l2(chunked, decode(params, latents)) <= 1e-5


def test_a_clip_goes_in_chunks_as_soon_as_its_largest_map_is_too_large(monkeypatch):
    """The limit counts frames and pixels of the video, whichever way it goes."""
    frames, height, width = 13, 16, 24
    video = jnp.zeros((frames, height, width, 3))
    latents = jnp.zeros((4, height // 8, width // 8, SMALL.latent))
    largest = 4.0 * frames * height * width * SMALL.base  # float32
    for name in ("encode", "encode_chunked", "decode", "decode_chunked"):
        monkeypatch.setattr(vae, name, lambda p, x, *, cfg, name=name: name)
    for limit, ending in ((largest, ""), (largest - 1, "_chunked")):
        monkeypatch.setattr(vae, "SINGLE_PASS_BYTES", limit)
        assert vae.encode_any({}, video, cfg=SMALL) == "encode" + ending
        assert vae.decode_any({}, latents, cfg=SMALL) == "decode" + ending


def test_one_frame_equals_the_first_of_many(small):
    params, video, latents = small
    assert rel_l2(encode(params, video[:1]), encode(params, video)[:1]) <= 1e-5
    assert rel_l2(decode(params, latents[:1]), decode(params, latents)[:1]) <= 1e-5


def test_frames_are_videos_of_one_frame(small):
    params, video, _ = small
    latents = jax.jit(functools.partial(vae.encode_frames, cfg=SMALL))(params, video[:3])
    each = jnp.concatenate([encode(params, video[i : i + 1]) for i in range(3)])
    assert rel_l2(latents, each) <= 1e-5
    frames = jax.jit(functools.partial(vae.decode_frames, cfg=SMALL))(params, latents)
    each = jnp.concatenate([decode(params, latents[i : i + 1]) for i in range(3)])
    assert rel_l2(frames, each) <= 1e-5


@pytest.mark.parametrize("frame", [0, 1, 4, 5, 12])
def test_encoder_is_causal(small, frame):
    """Latent 0 sees frame 0, latent j > 0 sees frames up to 4j."""
    params, video, _ = small
    before, after = (np.asarray(encode(params, v)) for v in (video, video.at[frame].multiply(-1.0)))
    first = -(-frame // 4)
    assert np.array_equal(before[:first], after[:first])
    assert not np.allclose(before[first], after[first])


@pytest.mark.parametrize("slot", [0, 1, 3])
def test_decoder_is_causal(small, slot):
    """Latent j > 0 reaches frames from 4j - 3 on."""
    params, _, latents = small
    changed = latents.at[slot].multiply(-1.0)
    before, after = (np.asarray(decode(params, z)) for z in (latents, changed))
    first = max(4 * slot - 3, 0)
    assert np.array_equal(before[:first], after[:first])
    assert not np.allclose(before[first], after[first])


# -------------------------------------------------------------------------------------------------------------- work
def convolutions(f, *args):
    """Kernel shapes of all convolutions in `f`, including those in nested calls."""

    def visit(jaxpr):
        for eqn in jaxpr.eqns:
            if eqn.primitive.name == "conv_general_dilated":
                yield tuple(eqn.invars[1].aval.shape)
            for value in eqn.params.values():
                inner = getattr(value, "jaxpr", value)
                if hasattr(inner, "eqns"):
                    yield from visit(inner)

    return list(visit(jax.make_jaxpr(f)(*args).jaxpr))


def test_no_convolution_is_wasted():
    """One 2-D convolution per layer for an image; for many frames three per 3x3x3 layer; a batch adds none."""
    params = abstract(vae.vae_specs(SMALL))
    kernels = [v.shape for p, v in flatten(params["encoder"]).items() if p.endswith("kernel")]
    causal = sum(len(shape) == 5 for shape in kernels)
    spatial = sum(len(shape) == 4 for shape in kernels)

    def run(p, x):
        return vae.encode(p, x, cfg=SMALL)

    def video(*shape):
        return jax.ShapeDtypeStruct((*shape, 16, 24, 3), jnp.float32)

    image = convolutions(run, params, video(1))
    assert all(len(shape) == 4 for shape in image)
    assert len(image) == causal + spatial
    many = convolutions(run, params, video(13))
    # the temporal length falls to 4 slots at the end: every layer has all of its three taps
    assert len(many) == 3 * causal + spatial
    assert convolutions(jax.vmap(run, (None, 0)), params, video(2, 13)) == many


def test_up_conv_equals_repetition_then_convolution():
    rng = np.random.default_rng(3)
    x = jnp.asarray(rng.normal(size=(2, 3, 5, 4)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(3, 3, 4, 6)), jnp.float32)
    repeated = jnp.repeat(jnp.repeat(x, 2, 1), 2, 2)
    plain = jax.lax.conv_general_dilated(
        repeated, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    assert rel_l2(vae.up_conv(x, kernel), plain) <= 1e-6


# --------------------------------------------------------------------------------------------------------- weight map
@pytest.mark.parametrize("names", ["official", "diffusers"])
def test_map_is_one_to_one_with_the_published_keys(names):
    cfg = VAEConfig()
    specs = vae.vae_specs(cfg)
    assert count(specs) == 126_892_531
    entries = wan_vae.mapping(cfg, names)
    keys = [key for entry in entries for key in entry.keys]
    assert len(keys) == len(set(keys)) == 194
    assert sorted(entry.path for entry in entries) == list(flatten(specs))
    listing = {row[f"{names} key"]: row["shape"] for row in key_listing("wan21_vae")}
    assert mapping.source_shapes(entries, specs) == listing


def test_both_names_of_a_tensor_lead_to_the_same_leaf():
    """Most layers have a sibling of their shape: only the listing tells which names belong together."""
    pairs = {row["official key"]: row["diffusers key"] for row in key_listing("wan21_vae")}
    official, diffusers = (
        wan_vae.mapping(VAEConfig(), names) for names in ("official", "diffusers")
    )
    for entry, other in zip(official, diffusers, strict=True):
        assert (entry.path, pairs[entry.keys[0]]) == (other.path, other.keys[0])


@pytest.mark.parametrize("names", ["official", "diffusers"])
def test_export_and_import_are_inverse(small, names):
    params = small[0]
    entries = wan_vae.mapping(SMALL, names)
    back = mapping.to_ours(entries, mapping.to_theirs(entries, params))
    for (path, a), (other, b) in zip(flatten(params).items(), flatten(back).items(), strict=True):
        assert path == other
        assert np.array_equal(a, b), path


def test_import_names_every_mismatch(small):
    entries = wan_vae.mapping(SMALL)
    theirs = mapping.to_theirs(entries, small[0])
    theirs["decoder.extra"] = theirs.pop("encoder.conv1.bias")
    with pytest.raises(UserError, match=r"missing encoder.conv1.bias; unexpected decoder.extra"):
        mapping.to_ours(entries, theirs)


def test_stacked_entries_hold_one_layer_per_row():
    rng = np.random.default_rng(0)
    source = {f"l{i}.weight": rng.normal(size=(3, 2)) for i in range(4)}
    entries = [mapping.Entry("blocks/kernel", tuple(source), mapping.LINEAR, stacked=True)]
    tree = mapping.to_ours(entries, source)
    assert tree["blocks"]["kernel"].shape == (4, 2, 3)
    assert np.array_equal(tree["blocks"]["kernel"][2], source["l2.weight"].T)
    back = mapping.to_theirs(entries, tree)
    assert all(np.array_equal(back[key], source[key]) for key in source)
    assert mapping.source_shapes(entries, tree) == dict.fromkeys(source, (3, 2))


# ---------------------------------------------------------------------------------------------------------- training
@pytest.fixture(scope="module")
def passthrough():
    return vae_training.passthrough_init(jax.random.key(5), SMALL)


def test_passthrough_codes_a_video_as_its_images(small, passthrough):
    """With its initial temporal taps, latent j is the image latent of frame 4j; each is decoded to all its frames."""
    _, video, _ = small
    latents = encode(passthrough, video)
    images = jnp.concatenate([encode(passthrough, video[i : i + 1]) for i in (0, 4, 8, 12)])
    assert rel_l2(latents, images) <= 1e-5
    frames = jnp.concatenate([decode(passthrough, latents[i : i + 1]) for i in range(4)])
    repeated = np.asarray(frames)[[0] + [1] * 4 + [2] * 4 + [3] * 4]
    assert rel_l2(decode(passthrough, latents), repeated) <= 1e-5


def test_passthrough_resamples_by_average_and_repetition():
    params = vae_training.passthrough_init(jax.random.key(6), SMALL, noise=0.0)
    x = jax.random.normal(jax.random.key(7), (1, 4, 6, 4))
    halved, _ = vae.down(params["encoder"]["stage0"]["down"], x, None)
    average = x.reshape(1, 2, 2, 3, 2, 4).mean((2, 4))
    assert rel_l2(halved, average) <= 1e-6
    doubled, _ = vae.up(params["decoder"]["stage2"]["up"], jnp.tile(x, 2), None)
    assert doubled.shape == (1, 8, 12, 4)
    assert rel_l2(jnp.repeat(jnp.repeat(doubled[:, ::2, ::2], 2, 1), 2, 2), doubled) <= 1e-6


def test_loss_is_its_definition_and_images_leave_older_taps_alone(small, passthrough):
    _, video, _ = small
    key = jax.random.key(8)
    loss = jax.jit(
        jax.value_and_grad(
            functools.partial(
                vae_training.vae_loss,
                cfg=SMALL,
                kl=0.5,
                l1=0.25,
                colour=(1.0, 3.0, 5.0),
                anchor=0.125,
            ),
            has_aux=True,
        )
    )
    (value, metrics), grads = loss(passthrough, video[:1], key)

    @jax.jit
    def forwards(p, video):
        mu, log_var = jnp.split(vae.encode_moments(p, video, cfg=SMALL), 2, axis=-1)
        z = mu + jnp.exp(log_var / 2) * jax.random.normal(key, mu.shape)
        return mu, log_var, vae.decode_raw(p, z, cfg=SMALL) - video

    mu, log_var, error = (np.asarray(x) for x in forwards(passthrough, video[:1]))
    var = np.exp(log_var)
    kl = np.mean(-0.5 * (1 + log_var - mu**2 - var))
    mse, mae = np.mean(error**2), np.mean(np.abs(error))
    green = (2 * error[..., 1] - error[..., 0] - error[..., 2]) ** 2 / 6
    colour = 3 * error.var(-1)  # both colour axes
    weighted = mse + np.mean(2.0 * colour + 2.0 * green) / 3  # 3 times red-blue, 5 times green
    anchor = np.mean((mu[..., -2:] - vae_training.block_colours(video[:1])) ** 2)
    expected = weighted + 0.25 * mae + 0.5 * kl + 0.125 * anchor
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    np.testing.assert_allclose(metrics["psnr"], 20 * np.log10(2) - 10 * np.log10(mse), rtol=1e-5)

    for path, grad in flatten(grads).items():
        assert np.isfinite(grad).all(), path
        if path.endswith("time/kernel") or path.endswith("time/bias"):
            assert not np.any(grad), path
        elif grad.ndim == 5:
            assert np.any(grad[-1]) and not np.any(grad[:-1]), path


def test_stages_show_the_vae_pictures_between_minus_one_and_one(monkeypatch):
    """Black is -1 and white is 1 where it is trained and where the spread of its latents is measured."""

    def loss(p, video, key, *, cfg):
        return video.mean(), {"low": video.min(), "high": video.max()}

    monkeypatch.setattr(vae_training, "vae_loss", loss)
    config = preset("tiny")
    frames = config.frames
    clips = jnp.concatenate([jnp.zeros((1, frames, 8, 8, 3)), jnp.ones((1, frames, 8, 8, 3))])
    p = {"vae": {"x": jnp.zeros(())}}
    value, terms = stages.vae_objective(
        p, {}, {"target_rgb": clips}, jax.random.key(0), config=config, stage=None
    )
    assert (float(value), float(terms["low"]), float(terms["high"])) == (0.0, 0.0, 0.0)  # -1 and 1

    def moments(p, video, *, cfg):
        return jnp.broadcast_to(video[:1, :1, :1, :1], (1, 1, 1, 2 * cfg.latent))

    def batch(source, stage, config, seed, i):
        return {"target_rgb": clips[i % 2][None]}

    monkeypatch.setattr(vae, "encode_moments", moments)
    monkeypatch.setattr(stages, "stage_batch", batch)
    measured = stages.measure_latents(p, None, config, 0, clips=4).vae
    assert set(measured.latent_mean) == {0.0} and set(measured.latent_std) == {1.0}


def test_block_colours_are_means_over_the_pixels_and_frames_of_a_latent():
    video = np.zeros((5, 16, 8, 3), np.float32)
    video[0, :8] = [0.5, 0.0, -0.5]  # red: the first axis
    video[3, 8:] = [0.4, -0.8, 0.4]  # magenta in one frame of four: the second
    got = np.asarray(vae_training.block_colours(jnp.asarray(video)))
    expected = np.zeros((2, 2, 1, 2))
    expected[0, 0] = [[12 / np.sqrt(2), 0]]
    expected[1, 1] = [[0, 12 * np.sqrt(6) * 0.4 / 4]]
    np.testing.assert_allclose(got, expected, atol=1e-5)


def test_norm_has_a_finite_gradient_at_zero():
    p = {"scale": jnp.ones(4)}
    grad = jax.grad(lambda x: vae.rms_norm(p, x).sum())(jnp.zeros((1, 4)))
    assert np.isfinite(grad).all()


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((6, 16, 16, 3), r"6 frames cannot be encoded.*e.g. 5 or 9"),
        ((4, 16, 16, 3), "4 frames cannot be encoded.*e.g. 1 or 5"),
        ((5, 16, 20, 3), "16x20 cannot be encoded.*16x16"),
    ],
)
def test_sizes_that_do_not_fit_are_named(shape, message):
    params = abstract(vae.vae_specs(SMALL))
    with pytest.raises(UserError, match=message):
        jax.eval_shape(
            functools.partial(vae.encode, cfg=SMALL),
            params,
            jax.ShapeDtypeStruct(shape, jnp.float32),
        )
