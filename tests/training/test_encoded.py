"""Samples encoded once: the same loss as the samples themselves, files that are whole, runs that go on, refusals."""

import dataclasses

import jax
import numpy as np
import pytest
from test_sharding import small
from train_runs import losses, run

from roge_jax import model
from roge_jax.config import preset
from roge_jax.core.params import count, flatten
from roge_jax.data.views import make_sample
from roge_jax.errors import UserError
from roge_jax.procedural.scenes import sample_sequence
from roge_jax.training import encoded, estimate, loop, room, stages


def with_preview():
    tiny = small()
    deviation = tuple(np.linspace(0.2, 0.6, tiny.vae.latent))
    d = tiny.renderer.width
    shown = dataclasses.replace(
        tiny.fusion,
        preview=True,
        preview_std=deviation,
        feature_mean=(0.1,) * d,
        feature_std=tuple(np.linspace(0.5, 2.0, d)),
    )
    return dataclasses.replace(tiny, fusion=shown)


def views_of(config, m: int = 2):
    n = m + config.frames
    scene = sample_sequence(3, frames=n, height=config.height, width=config.width)
    return make_sample(scene["rgb"] / 255.0, scene["K"], scene["c2w"], m, scale_rule="lagernvs")


def test_an_encoded_sample_has_the_flow_loss_of_the_sample():
    config = with_preview()
    params = model.init(jax.random.key(0), config)
    # E2, E3 and the head start from zero: what they are told would not count.
    params = jax.tree.map(
        lambda x: x + 0.05 * jax.random.normal(jax.random.key(x.size), x.shape, x.dtype), params
    )
    views, key = views_of(config), jax.random.key(1)
    options = {"config": config, "draws": 2, "remat": "none"}
    whole = jax.jit(lambda p, v: model.scene_loss(p, v, key, **options)["flow"])(params, views)

    @jax.jit
    def encode(params, views):
        photos = model.encode_contexts(params, views["context_rgb"], config=config)
        return encoded.encode(params, views, config=config), photos

    clip, photos = encode(params, views)
    term = jax.jit(lambda p, c: encoded.flow_term(p, c, key, **options))
    np.testing.assert_allclose(term(params, clip), whole, rtol=2e-4)  # features are float16
    assert "preview" in clip
    found = encoded.condition(params, clip, config=config)
    np.testing.assert_allclose(found.appearance[:2, ..., 4:], photos, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(found.appearance[2:, ..., 4:], clip["preview"])
    for name in clip:  # all of it counts
        moved = clip | {name: clip[name] * 2.0}
        assert abs(float(term(params, moved)) - float(whole)) > 1e-3 * float(whole), name


def test_a_stage_trains_on_encoded_samples_and_goes_on(common, cheap, monkeypatch, tmp_path):
    def encode(params, views, *, config):
        level = views["target_rgb"].mean() + params["vae"]["quant"]["kernel"].mean()
        return {"target_rgb": level[None], "K": views["K"]}

    monkeypatch.setattr(encoded, "encode", encode)
    words = [*common, "--stage", "generator", "--encode-once", 6, "--batch", 2]
    before, held, train = {id(x) for x in jax.live_arrays()}, [], loop.train

    def spied(*arguments, **more):
        held.append(sum(x.nbytes for x in jax.live_arrays() if id(x) not in before))
        return train(*arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "train", spied)
        run(*words, "--steps", 4, "--out", tmp_path / "whole")
    config = preset("tiny")
    stage = stages.find_stage(stages.mini_stages(frames=config.frames), "generator")
    read = stages.stage_specs(config, stages.once_encoded(stage, config, 6))
    # The networks that encode are gone, but for the VAE of a random start, which is drawn whole.
    assert held == [4 * (sum(map(count, read)) + count(model.specs(config)["vae"]))]
    files = sorted((tmp_path / "whole/generator/encoded").iterdir())
    assert len(files) == 6 and all(f.suffix == ".npz" for f in files)
    run(*words, "--steps", 4, "--out", tmp_path / "cut")
    # Killed in the midst of encoding and training: what is gone is made again, bit for bit.
    cut = tmp_path / "cut/generator"
    gone = sorted((cut / "encoded").iterdir())[2]
    before = gone.read_bytes()
    gone.unlink()
    for last in ("3", "4"):
        for file in sorted((cut / "checkpoints" / last).rglob("*"), reverse=True):
            file.rmdir() if file.is_dir() else file.unlink()
        (cut / "checkpoints" / last).rmdir()
    run(*words, "--steps", 4, "--out", tmp_path / "cut", "--resume")
    assert gone.read_bytes() == before
    assert losses(cut) == losses(tmp_path / "whole/generator") and len(losses(cut)) == 4


@pytest.fixture
def clips(tmp_path):
    def draw(i):
        m = 1 + i % 2
        return {"context_rgb": np.zeros((1, m, 2, 2, 3)), "K": np.full((1, m + 1, 3, 3), float(i))}

    return lambda count, **more: encoded.Clips(tmp_path, count, draw, lambda views: views, **more)


def test_batches_are_functions_of_seed_and_number(clips):
    found = clips(8)
    one, again, other = found.batch(0, 3, 2), found.batch(0, 3, 2), found.batch(0, 4, 2)
    np.testing.assert_array_equal(one["K"], again["K"])
    assert one["K"].shape != other["K"].shape or np.any(one["K"] != other["K"])
    seen = {float(x) for i in range(60) for x in found.batch(1, i, 2)["K"][:, 0, 0, 0]}
    assert seen == set(map(float, range(8)))
    for i in range(20):  # of one number of photos, none twice
        rows = found.batch(2, i, 3)["K"][:, 0, 0, 0]
        assert len(set(rows)) == 3 and len({r % 2 for r in rows}) == 1


def test_every_sample_is_drawn_as_often_as_any_other(tmp_path):
    """Whatever its number of photos: of eight, two have more than the others."""

    def draw(i):
        m = 2 if i < 2 else 1
        return {"context_rgb": np.zeros((1, m, 2, 2, 3)), "K": np.full((1, 2, 3, 3), float(i))}

    found = encoded.Clips(tmp_path, 8, draw, lambda views: views)
    drawn = [int(found.batch(0, i, 1)["K"][0, 0, 0, 0]) for i in range(800)]
    counts = np.bincount(drawn, minlength=8)
    assert np.abs(counts - 100).max() < 45  # binomial: 9.4 is one sigma


def test_samples_of_another_run_are_left_alone_and_damage_is_named(clips, tmp_path):
    clips(4)
    with pytest.raises(UserError, match="--resume"):
        clips(4)
    found = clips(4, resume=True)
    for file in tmp_path.glob("*.npz"):
        file.write_bytes(file.read_bytes()[:-30])
    with pytest.raises(UserError, match=r"damaged.*--resume encodes it again"):
        found.batch(0, 0, 2)
    with pytest.raises(UserError, match=r"at most 2 samples .* a step draws 3"):
        found.batch(0, 0, 3)


@pytest.mark.parametrize("stage", ["lora", "joint", "recon", "prior"])
def test_a_stage_that_trains_what_encodes_is_refused(stage, tmp_path, capsys):
    with pytest.raises(UserError, match=rf"stage {stage} .* give it to generator or hires"):
        run("tiny", "--stage", stage, "--encode-once", 4, "--out", tmp_path)
    assert not list(tmp_path.iterdir())
    config = small()
    recipe = stages.mini_stages(frames=config.frames)
    recipe += [stages.lora_stage(1, frames=config.frames, hires=hires) for hires in (False, True)]
    able = [s.name for s in recipe if stages.can_store(s, config)]
    assert able == ["generator", "hires"]
    stored = stages.all_once_encoded(recipe, config, 4)
    assert [s.name for s in stored if s.stored == 4] == able and len(stored) == len(recipe)


def test_features_that_nobody_measured_keep_their_range():
    for config, dtype in ((small(), "float32"), (with_preview(), "float16")):
        stage = stages.find_stage(stages.mini_stages(frames=config.frames), "generator")
        stage = stages.once_encoded(stage, config, 4)
        batch = estimate.abstract_batch(stages.stage_config(config, stage), stage, 2, 1)
        assert batch["features"].dtype == dtype


def test_an_encoded_stage_reads_the_transformer_alone():
    config = small()
    stage = stages.find_stage(stages.mini_stages(frames=config.frames), "generator")
    trained, frozen = stages.stage_specs(config, stages.once_encoded(stage, config, 4))
    assert {path.split("/")[0] for path in flatten(trained)} == {"dit", "fusion"}
    assert not any(path.startswith(("vae/", "encoder/", "renderer/")) for path in flatten(frozen))


def test_the_disk_must_hold_the_samples(tmp_path, monkeypatch):
    config = small()
    stage = stages.find_stage(stages.mini_stages(frames=config.frames), "generator")
    found = []
    monkeypatch.setattr(room, "check_disk", lambda needed, *rest, **more: found.append(needed))
    for one in (stage, stages.once_encoded(stage, config, 10)):
        room.check_space(tmp_path, [(one, config)], save_every=100)
    scene = sample_sequence(3, frames=4 + config.frames, height=config.height, width=config.width)
    views = make_sample(scene["rgb"] / 255.0, scene["K"], scene["c2w"], 4, scale_rule="lagernvs")
    params = model.init(jax.random.key(0), config)
    clip = jax.eval_shape(lambda p, v: encoded.encode(p, v, config=config), params, views)
    assert found[1] - found[0] == 10 * sum(x.size * x.dtype.itemsize for x in clip.values())
