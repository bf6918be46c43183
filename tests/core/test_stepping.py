"""Stepping through: loops are Python, arrays have values, nothing is compiled ahead; programs by ROGE_DEBUG."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled

import roge_jax as rj
from roge_jax.config import DiTConfig, EncoderConfig, RendererConfig, preset
from roge_jax.core import stepping
from roge_jax.core.params import init
from roge_jax.files import entry
from roge_jax.recon import ray_scene, vggt
from roge_jax.sampling import programs
from roge_jax.video import dit


def seen(monkeypatch, module, name: str) -> list:
    """What the function of a loop's body is given, call by call; it hands on its second argument."""
    values = []

    def body(p, x, *_, **__):
        values.append(x)
        return x

    monkeypatch.setattr(module, name, body)
    return values


def have_values(arrays) -> bool:
    return bool(arrays) and not any(isinstance(x, jax.core.Tracer) for x in arrays)


def test_blocks_of_the_transformer_are_python(monkeypatch):
    cfg = DiTConfig(width=16, heads=2, depth=3, ffn=16, freq_dim=16, text_len=0, clip_dim=0)
    values = seen(monkeypatch, dit, "block")
    x, e0, angles = np.zeros((4, 16)), np.zeros((6, 16)), np.zeros((4, 4))
    blocks = {"blocks": {"w": np.zeros((3, 1))}}
    run = functools.partial(dit.dit_blocks, blocks, x, e0, angles, cfg=cfg, remat="full")
    run()
    assert not have_values(values)
    values.clear()
    with rj.step_through():
        run()
    assert have_values(values) and len(values) == cfg.depth


def test_blocks_of_the_reconstruction_are_python(monkeypatch):
    cfg = EncoderConfig(patch=8, width=16, heads=2, depth=2, dino_depth=0, long_side=None)
    values = seen(monkeypatch, vggt, "block")
    p = init(jax.random.key(0), vggt.encoder_specs(cfg, 16))
    images = np.zeros((1, 8, 8, 3), np.float32)
    with rj.step_through():
        vggt.aggregate(p, images, None, cfg=cfg, plucker=np.zeros((1, 8, 8, 6), np.float32))
    assert have_values(values) and len(values) == 2 * cfg.depth


def test_chunks_of_views_are_python(monkeypatch):
    cfg = RendererConfig(patch=8, width=16, heads=2, depth=1, attention="cross", chunk=1)
    values = []

    def query(p, z, levels, plucker, **_):
        values.append(plucker)
        return jnp.zeros((len(plucker), 1, 16)), None

    monkeypatch.setattr(ray_scene, "_query", query)
    with rj.step_through():
        ray_scene.query_rays({}, np.zeros((1, 1, 16)), np.zeros((2, 8, 8, 6)), cfg=cfg)
    assert have_values(values) and len(values) == 2


def test_a_window_is_not_compiled_ahead(monkeypatch):
    monkeypatch.setattr(jax, "eval_shape", None)
    views = {"context_rgb": np.zeros((1, 8, 8, 3))}
    with rj.step_through():
        run = programs.for_window({}, views, preset("tiny"), "noised")
        shown = programs.for_preview({}, views, preset("tiny"), "noised")
    assert run.velocity.func is programs.velocity and run.decode.func is programs.decode
    assert shown.preview.func is programs.rgb_head


def test_it_ends_with_its_block_and_checkpoints_are_jax_s_outside():
    def f(x):
        return x

    with rj.step_through():
        assert stepping.stepping() and stepping.checkpoint(f) is f
    assert not stepping.stepping() and stepping.checkpoint(f) is not f


@pytest.mark.parametrize(("word", "steps"), [(None, False), ("0", False), ("1", True)])
def test_programs_step_by_an_environment_variable(monkeypatch, word, steps):
    for name in (entry.DEBUG_VARIABLE, "JAX_DISABLE_JIT"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    if word is not None:
        monkeypatch.setenv(entry.DEBUG_VARIABLE, word)
    try:
        assert entry.step_through() is steps
        assert stepping.stepping() is steps
    finally:
        jax.config.update("jax_disable_jit", False)


def test_values_are_those_of_the_compiled_function():
    def total(x):
        return jax.lax.scan(stepping.checkpoint(lambda c, y: (c + y, None)), 0.0, x)[0]

    x = np.arange(4, dtype=np.float32)
    with rj.step_through():
        stepped = float(total(x))
    assert stepped == float(compiled(total)(x)) == 6.0
