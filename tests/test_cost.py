"""FLOPs against published counts of the real networks, and against what the traced programs really multiply."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import pytest

from roge_jax import cost, fusion, model
from roge_jax.config import preset
from roge_jax.core import target
from roge_jax.core.attention import SCORES_BYTES, scores_limit
from roge_jax.core.params import abstract, count
from roge_jax.recon import ray_scene, vggt
from roge_jax.sampling import programs
from roge_jax.video import dit, vae

PAPER, T = preset("paper"), 1e12
RECON = (288, 504)


def near(value, published, digits):
    """Equal to a number that was published with so many decimal digits."""
    assert abs(value - published) <= 0.51 * 10.0**-digits, (value, published)


class TestPublishedCounts:
    """Counts (TFLOP) by PyTorch's FLOP counter and by formula for the official networks, dense 3-D taps in the VAE."""

    @pytest.mark.parametrize(("m", "tera"), [(2, 3.32), (3, 5.16), (6, 11.41), (9, 18.73)])
    def test_encoder(self, m, tera):
        near(cost.encoder(PAPER.encoder, *RECON, m, 768) / T, tera, 2)

    @pytest.mark.parametrize(
        ("attention", "tera"),
        [
            ("bidirectional", (1.197, 1.444, 2.187, 2.930)),
            ("full", (1.192, 1.565, 2.952, 4.740)),
            ("cross", (0.817, 0.904, 1.165, 1.426)),
        ],
    )
    def test_renderer_of_one_view(self, attention, tera):
        cfg = dataclasses.replace(PAPER.renderer, attention=attention)
        for m, published in zip((2, 3, 6, 9), tera, strict=True):
            near(cost.renderer_view(cfg, *RECON, 777 * m) / T, published, 3)

    def test_renderer_of_all_views(self):
        scene = 777 * 6
        near(cost.renderer(PAPER.renderer, *RECON, scene, 6, 87) / T, 190.3, 1)
        shared = dataclasses.replace(PAPER.renderer, refinement="shared")
        cheaper = cost.renderer(shared, *RECON, scene, 6, 87)
        assert cheaper < 0.65 * cost.renderer(PAPER.renderer, *RECON, scene, 6, 87)

    @pytest.mark.parametrize(
        ("slots", "height", "width", "tera", "digits"),
        [
            (27, 192, 336, 208.2, 1),
            (21, 192, 336, 156.1, 1),
            (7, 192, 336, 49.1, 1),
            (27, 480, 832, 2490, 0),
        ],
    )
    def test_transformer_of_14b(self, slots, height, width, tera, digits):
        tokens = slots * (height // 16) * (width // 16)
        rows = 512 + 257
        near(
            (cost.velocity(PAPER.dit, tokens, rows) + cost.text(PAPER.dit, rows)) / T, tera, digits
        )

    def test_transformer_of_1_3b(self):
        cfg = preset("wan1.3b").dit
        near((cost.velocity(cfg, 6804) + cost.text(cfg)) / T, 26.3, 1)

    @pytest.mark.parametrize(
        ("size", "frames", "encode", "decode"),
        [
            ((192, 336), 1, 0.431, 0.695),
            ((192, 336), 81, 26.3, 44.3),
            ((480, 832), 81, 163.7, 275.4),
        ],
    )
    def test_vae(self, size, frames, encode, decode):
        digits = 3 if frames == 1 else 1
        near(cost.vae_encode(PAPER.vae, frames, *size, dense=True) / T, encode, digits)
        near(cost.vae_decode(PAPER.vae, frames, *size, dense=True) / T, decode, digits)

    def test_weights(self):
        sizes = cost.weight_bytes(PAPER)
        assert sum(sizes.values()) == 4 * count(model.specs(PAPER))
        assert sizes["vae"] == 4 * 126_892_531
        half = cost.weight_bytes(PAPER, jnp.bfloat16)
        assert half["vae"] == sizes["vae"]
        # 32.79 GB if all were bfloat16; the time embedding (183.5 M) and a few M more are not.
        assert 32.79e9 + 2 * 183.5e6 < half["dit"] < 33.2e9


# ---- what a traced program multiplies ------------------------------------------------------------


def multiplied(function, *arguments) -> float:
    """FLOPs of all matrix products and convolutions in the trace of a function; loops count every turn."""
    with scores_limit(math.inf):  # pieces are padded to one size
        return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(jaxpr) -> float:
    total = 0.0
    for equation in jaxpr.eqns:
        name, p = equation.primitive.name, equation.params
        if name == "dot_general":
            (contract, _), _ = p["dimension_numbers"]
            inner = math.prod(equation.invars[0].aval.shape[i] for i in contract)
            total += 2.0 * inner * math.prod(equation.outvars[0].aval.shape)
        elif name == "conv_general_dilated":
            kernel = equation.invars[1].aval.shape
            out = p["dimension_numbers"].rhs_spec[0]
            total += (
                2.0 * math.prod(equation.outvars[0].aval.shape) * math.prod(kernel) / kernel[out]
            )
        else:
            turns = p["length"] if name == "scan" else 1
            for value in p.values():
                for inner in value if isinstance(value, tuple | list) else (value,):
                    inner = getattr(inner, "jaxpr", inner)
                    total += turns * _count(inner) if hasattr(inner, "eqns") else 0.0
    return total


def array(*shape):
    return jax.ShapeDtypeStruct(shape, jnp.float32)


@pytest.mark.parametrize("name", ["tiny", "mini", "paper"])
class TestTracedPrograms:
    def test_velocity(self, name):
        config = preset(name)
        cfg, m = config.dit, 2
        lh, lw = config.latent_size
        slots = config.slots(m)
        tokens = slots * cost.tokens_per_slot(config)
        p = abstract(dit.dit_specs(cfg))
        kv = None
        if cfg.text_len:
            rows = array(cfg.text_len, cfg.width)
            kv = jax.eval_shape(lambda p, rows: dit.precompute_context(p, rows, cfg=cfg), p, rows)

        def run(p, x, angles, kv):
            return dit.dit(p, x, 500.0, angles, cfg=cfg, kv=kv)

        x = array(slots, lh, lw, cfg.in_channels)
        real = multiplied(run, p, x, array(tokens, cfg.width // cfg.heads // 2), kv)
        assert real == pytest.approx(cost.velocity(cfg, tokens), rel=1e-9)

    def test_text(self, name):
        """Embedding of text and CLIP rows, and the keys and values of all blocks: once per video."""
        cfg = preset(name).dit
        assert (cfg.text_len == 0) == (name == "mini")
        if not cfg.text_len:
            assert cost.text(cfg) == 0.0
            return
        p = abstract(dit.dit_specs(cfg))

        def run(p, text, clip):
            rows = dit.context_rows(p, text, clip, cfg=cfg)
            return dit.precompute_context(p, rows, cfg=cfg)

        text = array(cfg.text_len, cfg.text_dim)
        assert multiplied(run, p, text, None) == pytest.approx(cost.text(cfg), rel=1e-9)
        if cfg.clip_dim:
            rows = cfg.text_len + cfg.clip_rows
            real = multiplied(run, p, text, array(cfg.clip_rows, cfg.clip_dim))
            assert real == pytest.approx(cost.text(cfg, rows), rel=1e-9)

    def test_fusion(self, name):
        plain, m = preset(name), 2
        # Ray features on the grid of the latents: resizing them, by matrices, is not in the formula.
        config = dataclasses.replace(plain, recon_height=plain.height, recon_width=plain.width)
        views, (lh, lw) = m + config.frames, config.latent_size
        arguments = (
            abstract(fusion.fusion_specs(config)),
            array(m, lh, lw, 16),
            array(views, config.height, config.width, 6),
            array(views, lh, lw, config.renderer.width),
        )
        real = multiplied(fusion.condition, *arguments)
        assert real == pytest.approx(cost.fusion(config, views, config.slots(m)), rel=1e-9)

    def test_vae(self, name):
        cfg, frames, size = preset(name).vae, 9, (32, 48)
        p = abstract(vae.vae_specs(cfg))
        real = multiplied(lambda p, x: vae.encode(p, x, cfg=cfg), p, array(frames, *size, 3))
        assert real == pytest.approx(cost.vae_encode(cfg, frames, *size), rel=1e-9)
        real = multiplied(lambda p, z: vae.decode(p, z, cfg=cfg), p, array(3, 4, 6, cfg.latent))
        assert real == pytest.approx(cost.vae_decode(cfg, frames, *size), rel=1e-9)

    def test_encoder(self, name):
        config, m = preset(name), 3
        cfg = dataclasses.replace(
            config.encoder, relative_cameras=False
        )  # their 4x4 matrices are not counted
        size = (config.recon_height, config.recon_width)
        p = abstract(vggt.encoder_specs(cfg, config.renderer.width))

        def run(p, images, vectors, plucker):
            return vggt.encode_scene(p, images, vectors, plucker, None, None, cfg=cfg)

        real = multiplied(run, p, array(m, *size, 3), array(m, 11), array(m, *size, 6))
        formula = cost.encoder(cfg, *size, m, config.renderer.width)
        # Beyond the formula: camera MLP and the resizing of images and positions, by matrices.
        assert formula <= real <= (1.05 if name == "tiny" else 1.01) * formula

    @pytest.mark.parametrize("attention", ["bidirectional", "cross", "full", "shared"])
    def test_renderer(self, name, attention):
        config, m, views, scene = preset(name), 2, 7, 24
        kind = (
            {"attention": "bidirectional", "refinement": "shared"}
            if attention == "shared"
            else {"attention": attention}
        )
        cfg = dataclasses.replace(config.renderer, relative_cameras=False, chunk=7, **kind)
        p = abstract(ray_scene.renderer_specs(cfg))

        def run(p, z, plucker):
            features = ray_scene.query_rays(p, z, plucker, cfg=cfg, contexts=m)
            return ray_scene.decode_rgb(p["rgb_head"], features, cfg=cfg)

        real = multiplied(run, p, array(m, scene // m, cfg.width), array(views, 32, 48, 6))
        formula = cost.renderer(cfg, 32, 48, scene, m, views)
        if attention == "shared":  # refining stops before the last block, and makes no pictures
            assert 0.8 * formula < real <= formula
        else:
            assert real == pytest.approx(formula, rel=1e-9)


class TestEstimate:
    def test_totals(self):
        e = cost.estimate(PAPER, 6, 50)
        assert e.tokens == {
            "scene tokens": 6 * 777,
            "ray tokens per view": 2272,
            "views": 87,
            "latent slots": 27,
            "transformer tokens": 6804,
        }
        near(e.flops["velocity"] / T, 203.5, 1)  # the 3.2 of the text are paid once
        assert e.total_flops == pytest.approx(sum(e.flops.values()) + 49 * e.flops["velocity"])
        assert e.peak_bytes > sum(e.weights.values())

    def test_fused_attention_needs_less(self):
        def working(name, dtype):
            with target.use(name):
                return cost.estimate(PAPER, 6, 1, dtype=dtype).working_bytes["velocity"]

        plain, fused = (working(name, jnp.bfloat16) for name in ("cpu", "h100"))
        assert SCORES_BYTES < 4 * 6804**2 * 40, "queries in pieces"
        assert plain - fused == SCORES_BYTES
        assert working("h100", jnp.float32) == working("v5p", jnp.bfloat16) == plain

    def test_numbers_have_the_unit_that_keeps_them_short(self):
        for value, said in (
            (1.234e15, "1.23 PB"),
            (2e12, "2 TB"),
            (9.99e11, "999 GB"),
            (1e9, "1 GB"),
            (4.5e6, "4.5 MB"),
            (300.0, "0.3 kB"),
        ):
            assert cost.scaled(value, "B") == said

    def test_a_report_adds_up_the_windows(self):
        """Three windows: the first sees two photos, the others four with frames that were made."""
        config = preset("tiny")
        first, other = cost.estimate(config, 2, 8), cost.estimate(config, 4, 8)
        text = cost.report(config, 2, 8, frames=3 * config.frames, later=4, half=False, solver="x")
        total = cost.scaled(first.total_flops + 2 * other.total_flops, "FLOP")
        peak = cost.scaled(max(first.peak_bytes, other.peak_bytes), "B")
        assert f"chunks of {config.frames}: 3" in text
        assert f"\n{'all chunks':24s}{total:>16s}\n" in text and f"about {peak}: weights" in text
        alone = cost.report(config, 2, 8, frames=config.frames, later=4, half=False, solver="x")
        total = cost.scaled(first.total_flops, "FLOP")
        assert f"\n{'all chunks':24s}{total:>16s}\n" in alone and "photos    2\n" in alone

    def test_a_preview_costs_one_more_encoding_and_decoding(self):
        plain = preset("tiny")
        config = dataclasses.replace(plain, fusion=dataclasses.replace(plain.fusion, preview=True))
        with_, without = cost.estimate(config, 2, 8), cost.estimate(plain, 2, 8)
        clip = plain.vae, plain.frames, plain.height, plain.width
        more = cost.vae_encode(*clip) + cost.vae_decode(*clip)
        assert with_.total_flops == pytest.approx(without.total_flops + more)
        assert with_.working_bytes.keys() == with_.flops.keys()

    def test_working_memory_is_what_xla_allocates_within_a_factor_of_two(self):
        """Of the two stages that decide the peak, at a size where the named tensors outweigh small buffers."""
        size = {"height": 96, "width": 160, "recon_height": 96, "recon_width": 160}
        config = dataclasses.replace(preset("tiny"), frames=9, **size)
        e, slots = cost.estimate(config, 1, 1), config.slots(1)
        p, state = abstract(model.specs(config)), array(slots, *config.latent_size, 16)
        views = {
            "context_rgb": array(1, 96, 160, 3),
            "K": array(10, 3, 3),
            "c2w": array(10, 4, 4),
            "vectors": array(1, 11),
        }
        prepared = jax.eval_shape(lambda p, views: model.prepare(p, views, config=config), p, views)

        def step(p, prepared, x):
            return programs.velocity(
                p, prepared, x, x, jnp.float32(0.5), config=config, slots="noised"
            )

        def decode(p, x):
            return programs.decode(p, x, None, config=config, contexts=1)

        for name, function, arguments in (
            ("decode", decode, (p, state)),
            ("velocity", step, (p, prepared, state)),
        ):
            used = (
                jax.jit(function).lower(*arguments).compile().memory_analysis().temp_size_in_bytes
            )
            assert 0.5 < e.working_bytes[name] / used < 2, name

    def test_reconstruction_takes_the_scores_of_all_heads(self):
        """Three photos, whose scores are most of it, against XLA: of half the heads it would be two thirds."""
        size = {"height": 96, "width": 160, "recon_height": 96, "recon_width": 160}
        config, m = dataclasses.replace(preset("tiny"), frames=9, **size), 3
        views = {"context_rgb": array(m, 96, 160, 3), "K": array(m, 3, 3), "c2w": array(m, 4, 4)}
        views["vectors"] = array(m, 11)
        p = abstract({"encoder": model.specs(config)["encoder"]})
        run = jax.jit(lambda p, views: model.reconstruct(p, views, config=config))
        used = run.lower(p, views).compile().memory_analysis().temp_size_in_bytes
        assert 0.8 < cost.estimate(config, m, 1).working_bytes["reconstruct"] / used < 1.25
