"""The training program on the tiny preset: a few real steps, resume, what it writes, what it refuses."""

import dataclasses
import functools
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_sharding import small

from roge_jax import config, entry, model, train
from roge_jax.checkpoint import load_model, save_model
from roge_jax.core.params import flatten
from roge_jax.data.source import open_source
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import UserError
from roge_jax.training import loop, stages


def run(*arguments) -> None:
    train.main(train.parser().parse_args([str(a) for a in arguments]))


def losses(folder) -> list[float]:
    return [json.loads(line)["loss"] for line in (folder / "log.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def common():
    """Options of a short run, made quick to compile: `tiny` with a smaller VAE, two contexts in every batch."""
    smaller, lora_stage = small(), stages.lora_stage

    def two_contexts(*arguments, **options):
        stage = lora_stage(*arguments, **options)
        views = dataclasses.replace(stage.views, contexts=(2,), context_weights=(1.0,))
        return dataclasses.replace(stage, views=views)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(config.PRESETS, "tiny", lambda: smaller)
        patch.setattr(stages, "lora_stage", two_contexts)
        yield ["tiny", "--devices", 1, "--log-every", 1, "--save-every", 1]


def test_joint_training_resumes_exactly_and_saves_a_model(common, tmp_path):
    run(*common, "--steps", 4, "--out", tmp_path)
    whole = losses(tmp_path / "lora")
    params, config = load_model(tmp_path / "lora/model")
    assert config.name == "tiny" and len(whole) == 4 and all(np.isfinite(whole))
    assert not any("lora" in path for path in flatten(params))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))

    for words in (["--seed", 1], ["--batch", 2], ["--lr", 0.5]):
        with pytest.raises(UserError, match=r"holds a run with .*: continue it with the same"):
            run(*common, "--steps", 4, "--out", tmp_path, "--resume", *words)
    for step in (3, 4):  # as if the run had died after step 2
        shutil.rmtree(tmp_path / "lora/checkpoints" / str(step))
    run(*common, "--steps", 4, "--out", tmp_path, "--resume")
    assert losses(tmp_path / "lora") == whole
    again, _ = load_model(tmp_path / "lora/model")
    assert all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(params), jax.tree.leaves(again))
    )


def test_unknown_stage_and_batch_that_does_not_divide_are_refused(tmp_path):
    with pytest.raises(UserError, match="recon"):
        run("tiny", "--stage", "recom", "--out", tmp_path)
    with pytest.raises(UserError, match="mini"):
        run("minni", "--out", tmp_path)


def test_a_model_without_look_up_has_no_stage_for_it(tmp_path):
    with pytest.raises(UserError, match=r"renderer\.lookup is 0"):
        run("tiny", "--stage", "lookup", "--out", tmp_path)
    args = train.parser().parse_args(["tiny", "--stage", "all"])
    names = {
        name: [stage.name for stage in train.choose(args, config.preset(name))[1]]
        for name in ("tiny", "mini")
    }
    assert names["mini"] == [*names["tiny"][:5], "lookup", *names["tiny"][5:]]


@pytest.mark.parametrize(
    "words",
    [
        ["--steps", "0"], ["--steps", "-1"], ["--batch", "0"], ["--lr", "nan"], ["--lr", "0"], ["--scale", "nan"],
        ["--seed", "-1"], ["--devices", "-1"], ["--save-every", "0"], ["--log-every", "0"], ["--evaluate-every", "-1"],
        ["--context", "0"],
    ],
)  # fmt: skip
def test_numbers_that_mean_nothing_are_refused(words, tmp_path, capsys):
    arguments = ["tiny", "--out", str(tmp_path / "out"), *words]
    assert entry.execute(train.main, train.parser(), arguments) == 2
    assert f"'{words[1]}' is not a " in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_a_stage_gets_what_its_objective_reads():
    """Trained and frozen leaves together are the modules that the objective needs, and `vae_decoder` keeps latents."""
    cfg = config.preset("tiny")
    needs = {"vae": {"vae"}, "recon": {"encoder", "renderer"}}
    for stage in stages.mini_stages(frames=cfg.frames):
        trained, frozen = (flatten(tree) for tree in stages.stage_specs(cfg, stage))
        assert not set(trained) & set(frozen)
        modules = {path.split("/")[0] for path in [*trained, *frozen]}
        assert modules == needs.get(stage.objective, set(model.specs(cfg)))
        assert stages.moves_latents(trained) == (
            stage.objective == "vae" and stage.name != "vae_decoder"
        )
    decoder = stages.find_stage(stages.mini_stages(frames=cfg.frames), "vae_decoder")
    params = model.init(jax.random.key(0), cfg)
    trained, frozen = model.split(params, decoder.trains)
    batch = {"target_rgb": jax.ShapeDtypeStruct((1, 5, 16, 16, 3), np.float32)}
    objective = functools.partial(stages.vae_objective, config=cfg, stage=decoder)
    jax.eval_shape(objective, trained, stages.read(frozen, decoder), batch, jax.random.key(0))


def test_the_features_of_a_trained_reconstruction_are_measured(common):
    cfg = config.preset("tiny")
    params = model.init(jax.random.key(0), cfg)
    source = open_source(None, cfg.height, cfg.width, 12)
    moved, found = stages.measure_features(params, source, cfg, seed=3, clips=2)
    mean, std = (np.asarray(x) for x in (found.fusion.feature_mean, found.fusion.feature_std))
    assert mean.shape == std.shape == (cfg.renderer.width,) and np.all(std > 0)
    assert dataclasses.replace(found, fusion=cfg.fusion) == cfg
    same = {path for path, x in flatten(params).items() if flatten(moved)[path] is x}
    assert set(flatten(params)) - same == {
        "fusion/geometry_adapter/kernel",
        "fusion/geometry_adapter/bias",
    }
    kernel = params["fusion"]["geometry_adapter"]["kernel"]
    np.testing.assert_allclose(
        moved["fusion"]["geometry_adapter"]["kernel"], std[:, None] * kernel, rtol=1e-5
    )
    stats = config.from_dict(config.to_dict(found))
    assert stats == found


def test_the_error_of_the_preview_is_measured_and_the_head_starts_again(common):
    cfg = config.preset("tiny")
    cfg = dataclasses.replace(cfg, fusion=dataclasses.replace(cfg.fusion, preview=True))
    params = model.init(jax.random.key(0), cfg)
    params["dit"]["head"]["linear"]["kernel"] += 1.0
    source = open_source(None, cfg.height, cfg.width, 12)
    moved, found = stages.measure_preview(params, source, cfg, seed=3, clips=1)
    assert config.from_dict(config.to_dict(found)) == found
    assert dataclasses.replace(found, fusion=cfg.fusion) == cfg
    before, after = flatten(params), flatten(moved)
    changed = {path for path, x in before.items() if after[path] is not x}
    assert changed == {"dit/head/linear/kernel", "dit/head/linear/bias"}
    assert not any(np.any(after[path]) for path in changed)
    # A transformer that says nothing about noise at sigma = 1 is off by preview_std, by definition.
    views = ViewConfig(
        contexts=(3,), context_weights=(1.0,), targets=cfg.frames, ordered=True, size=(32, 48)
    )
    batch = draw_batch(source, 4, 0, 1, views, scale_rule=cfg.scale_rule)
    views = {name: jnp.asarray(x[0]) for name, x in batch.items()}
    prepared = jax.jit(functools.partial(model.prepare, config=found))(moved, views)
    noise = model.draw_noise(jax.random.key(1), 3, config=found)
    velocity = model.velocity(
        moved, noise, jnp.float32(1.0), prepared.condition, config=found, contexts=3
    )
    target = model.encode_targets(moved, views["target_rgb"], config=found)
    error = np.asarray((noise - velocity)[3:] - target).reshape(-1, cfg.vae.latent)
    np.testing.assert_allclose(
        np.sqrt(np.square(error).mean(0)), found.fusion.preview_std, rtol=2e-3
    )


def test_a_generator_is_trained_about_the_preview_once(common, tmp_path, monkeypatch):
    cfg = config.preset("tiny")
    cfg = dataclasses.replace(cfg, fusion=dataclasses.replace(cfg.fusion, preview=True))
    save_model(tmp_path / "start", model.init(jax.random.key(0), cfg), cfg)
    seen = []

    def measure(params, source, cfg, seed):
        std = (0.5,) * cfg.vae.latent
        return params, dataclasses.replace(
            cfg, fusion=dataclasses.replace(cfg.fusion, preview_std=std)
        )

    def train_nothing(objective, trainable, *rest, **options):
        seen.append(objective.keywords["config"].fusion.preview_std)
        (options["out"] / "log.jsonl").touch()
        return {"params": trainable, "step": 0, "skipped": 0}

    monkeypatch.setattr(stages, "measure_preview", measure)
    monkeypatch.setattr(loop, "train", train_nothing)
    start = tmp_path / "start"
    for k in (1, 2):
        run(*common, "--stage", "generator", "--init", start, "--out", tmp_path / f"{k}")
        start = tmp_path / f"{k}" / "generator" / "model"
        assert load_model(start)[1].fusion.preview_std == (0.5,) * 16
        monkeypatch.setattr(stages, "measure_preview", None)  # the second run has no need of it
    assert seen == [(0.5,) * 16] * 2  # and the objective knows


def test_a_look_up_makes_the_preview_better_and_its_error_is_measured_again(
    common, tmp_path, monkeypatch
):
    cfg = config.preset("tiny")
    fusion = dataclasses.replace(cfg.fusion, preview=True, preview_std=(0.5,) * cfg.vae.latent)
    renderer = dataclasses.replace(cfg.renderer, lookup=8)
    cfg = dataclasses.replace(cfg, fusion=fusion, renderer=renderer)
    start = model.init(jax.random.key(0), cfg)
    start["dit"]["head"]["linear"]["kernel"] += 1.0
    save_model(tmp_path / "start", start, cfg)

    def train_nothing(objective, trainable, *rest, **options):
        assert set(flatten(trainable)) == {
            p for p in flatten(model.specs(cfg)) if p.startswith("renderer/lookup/")
        }
        (options["out"] / "log.jsonl").touch()
        return {"params": trainable, "step": 0, "skipped": 0}

    def measure(params, source, cfg, seed):
        better = dataclasses.replace(cfg.fusion, preview_std=(0.25,) * cfg.vae.latent)
        return dataclasses.replace(cfg, fusion=better)

    monkeypatch.setattr(stages, "measure_spread", measure)
    monkeypatch.setattr(stages, "measure_features", None)  # the features did not move
    monkeypatch.setattr(loop, "train", train_nothing)
    run(*common, "--stage", "lookup", "--init", tmp_path / "start", "--out", tmp_path / "out")
    params, found = load_model(tmp_path / "out/lookup/model")
    assert found.fusion.preview_std == (0.25,) * 16
    assert np.all(
        params["dit"]["head"]["linear"]["kernel"] == 1.0
    )  # and the transformer stays as it is


def test_a_pool_must_have_the_frames_that_the_stage_trains_on(tmp_path):
    rgb = np.zeros((1, 6, 32, 64, 3), np.uint8)
    np.save(tmp_path / "shard_00000.rgb.npy", rgb)
    poses = np.broadcast_to(np.eye(4), (1, 6, 4, 4))
    np.savez(tmp_path / "shard_00000.npz", seeds=[0], K=poses[..., :3, :3], c2w=poses)
    assert len(open_source(tmp_path, 32, 64, 6)) == len(open_source(tmp_path, 16, 32, 1)) == 1
    for size in ((32, 48), (64, 128), (16, 64)):
        with pytest.raises(UserError, match=f"32x64 and this stage trains at {size[0]}x{size[1]}"):
            open_source(tmp_path, *size, 6)
    with pytest.raises(UserError, match=r"6 frames .* windows of 7"):
        open_source(tmp_path, 32, 64, 7)


def test_the_preset_must_be_that_of_the_model(tmp_path):
    with pytest.raises(UserError, match="'mini' model and the preset is 'tiny'"):
        run("tiny", "--init", "mini", "--devices", 1, "--out", tmp_path)
    with pytest.raises(UserError, match="'mini' model and the preset is 'tiny'"):
        run("tiny", "--init", "mini", "--dry-run")
