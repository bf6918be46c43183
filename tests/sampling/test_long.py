"""Long videos and long sequences: nothing is compiled again, nothing piles up, no array grows with the square."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from test_sampling_mesh import cameras
from test_sharding import drawn, small

from roge_jax import config, model, sampling
from roge_jax.core import program, sharding
from roge_jax.core.attention import attention, scores_limit
from roge_jax.core.params import abstract
from roge_jax.sampling import programs
from roge_jax.video.dit import rematerialise


class TestChain:
    def run(self, windows: int):
        """(compilations, bytes of live arrays) after every window of a chained path."""
        cfg = small()
        params = jax.tree.map(jnp.asarray, drawn(model.specs(cfg), 1))
        photos = sampling.Photos(
            np.random.default_rng(0).random((2, cfg.height, cfg.width, 3), np.float32),
            None,
            cameras(2, cfg, 1.0),
            (0, 1),
        )
        compiled, seen = [], []

        def listen(event, *_, **__):
            if event == "/jax/core/compile/backend_compile_duration":
                compiled.append(event)

        @contextlib.contextmanager
        def stage(name):
            if name == "prepare":
                seen.append((len(compiled), sum(x.nbytes for x in jax.live_arrays())))
            yield

        jax.monitoring.register_event_duration_secs_listener(listen)
        try:
            result = sampling.sample(
                params,
                cfg,
                photos,
                cameras(windows * cfg.frames, cfg, 0.02),
                sampling.Settings(steps=1, solver="euler"),
                stage=stage,
            )
        finally:
            jax.monitoring.unregister_event_duration_listener(listen)
        assert len(result.frames) == windows * cfg.frames and np.isfinite(result.frames).all()
        return compiled, seen

    def test_windows_after_the_second_compile_nothing_and_keep_nothing(self):
        compiled, seen = self.run(6)
        assert len(seen) == 6 and len(compiled) >= 8, "two sets of four programs"
        counts, bytes_ = zip(*seen)
        assert counts[0] < counts[1], "the second window sees other photos"
        # What a window needs for the first time (resizing, say) may be compiled in the one after its programs.
        assert counts[3] == counts[-1] == len(compiled)
        assert max(bytes_[2:]) == min(bytes_[2:])


class TestAttention:
    def arrays(self, tokens: int):
        rng = np.random.default_rng(0)
        return [jnp.asarray(rng.normal(size=(1, tokens, 2, 8)).astype(np.float32)) for _ in "qkv"]

    def test_in_pieces_it_is_the_same(self):
        q, k, v = self.arrays(37)  # not a multiple of anything

        def both(q, k, v):
            y = attention(q, k, v)
            return jnp.sum(jnp.sin(y)), y

        run = jax.value_and_grad(both, argnums=(0, 1, 2), has_aux=True)
        (_, expected), grads = jax.jit(run)(q, k, v)
        with scores_limit(4 * 2 * 37 * 10):
            (_, found), pieces = jax.jit(lambda *a: run(*a))(q, k, v)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
        for a, b in zip(pieces, grads):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)

    def test_in_pieces_it_has_both_modes_of_derivatives(self):
        args = self.arrays(37)
        rates = [jnp.cos(x) for x in args]

        def both(q, k, v, dq, dk, dv):
            y, rate = jax.jvp(jax.vmap(attention), (q, k, v), (dq, dk, dv))
            _, pull = jax.vjp(jax.vmap(attention), q, k, v)
            return y, rate, jnp.vdot(jnp.sin(y), rate), pull(jnp.sin(y))

        expected = jax.jit(both)(*args, *rates)
        with scores_limit(4 * 2 * 37 * 10):
            found = jax.jit(lambda *a: both(*a))(*args, *rates)
        along = sum(jnp.vdot(g, d) for g, d in zip(found[3], rates))
        np.testing.assert_allclose(along, found[2], rtol=1e-5)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-6)

    def test_under_dots_scores_are_computed_twice_and_not_kept(self):
        q, k, v = self.arrays(37)
        step = rematerialise(lambda x, _: attention(x, k, v), "dots")

        def loss(q):
            return jnp.sum(jax.lax.scan(lambda x, _: (step(x, None), None), q, None, length=3)[0])

        with scores_limit(4 * 2 * 37 * 10):
            traced = program.trace(jax.grad(loss), q)
        one = 2 * 2 * 37 * 38 * 8  # FLOPs of a product of two heads, 37 queries padded to 38
        assert program.flops(traced)[""] == 3 * 5 * one, "two forward, one again, two backward"
        kept = [v for v in traced.values if getattr(v, "shape", ()) and v.shape[0] == 3]
        assert kept and all(v.size < 3 * 2 * 37**2 for v in kept)

    def test_memory_grows_with_the_length_not_its_square(self):
        def peak(tokens):
            one = jax.ShapeDtypeStruct((1, tokens, 2, 64), jnp.float32)
            return program.peak(program.trace(lambda *a: attention(*a), one, one, one)).bytes

        assert peak(20_000) < 20_000 / 2_000 * peak(2_000) < 4 * 2 * 20_000**2 / 20, "a lone CPU"
        limit = 1e9
        with sharding.use(sharding.abstract_mesh()):
            assert peak(1000) > 4 * 2 * 1000**2
            assert peak(46_800) < 2.5 * limit < 4 * 2 * 46_800**2
            assert peak(4 * 46_800) < 2.5 * limit


def test_nine_photos_81_frames_480x832_has_its_shapes():
    cfg, m = dataclasses.replace(config.preset("paper"), height=480, width=832), 9
    views = {
        "context_rgb": jax.ShapeDtypeStruct((m, 480, 832, 3), jnp.float32),
        "K": jax.ShapeDtypeStruct((m + 81, 3, 3), jnp.float32),
        "c2w": jax.ShapeDtypeStruct((m + 81, 4, 4), jnp.float32),
        "vectors": jax.ShapeDtypeStruct((m, 11), jnp.float32),
    }
    params = abstract(model.specs(cfg))
    ready = jax.eval_shape(lambda p, v: model.prepare(p, v, config=cfg), params, views)
    assert ready.condition.tokens.shape == (46_800, cfg.dit.width)
    x = jax.ShapeDtypeStruct((9 + 21, 60, 104, 16), jnp.float32)
    out = jax.eval_shape(
        lambda p, ready, x: programs.velocity(p, ready, x, x, 0.5, config=cfg, slots="noised"),
        params, ready, x,
    )  # fmt: skip
    assert out.shape == x.shape
    video = jax.eval_shape(
        lambda p, x: programs.decode(p, x, None, config=cfg, contexts=m), params, x
    )
    assert video.shape == (81, 480, 832, 3)
