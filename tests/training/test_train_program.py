"""The training program on the tiny preset: a few real steps, resume, what it writes, what it refuses."""

import dataclasses
import functools
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from train_runs import losses, run, write_dataset

from roge_jax import config, model, train
from roge_jax.checkpoint import load_model, model_fingerprint, save_model
from roge_jax.core.params import flatten, unflatten
from roge_jax.data.source import open_source
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import UserError
from roge_jax.files import entry
from roge_jax.files.folders import BLOCK_BYTES, BLOCKS, fingerprint
from roge_jax.procedural import scenes as procedural
from roge_jax.training import diagnose, loop, stages
from roge_jax.training import run as training_run
from roge_jax.training.held_out import held_out
from roge_jax.training.start import hold_settings


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
    assert names["mini"] == [*names["tiny"][:5], "lookup", "match", *names["tiny"][5:]]
    with pytest.raises(UserError, match=r"renderer\.matching is false"):
        run("tiny", "--stage", "match", "--out", tmp_path)


@pytest.mark.parametrize(
    "words",
    [
        ["--steps", "0"], ["--steps", "-1"], ["--batch", "0"], ["--lr", "nan"], ["--lr", "0"], ["--steps-scale", "nan"],
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
    matching = dataclasses.replace(cfg.renderer, lookup=8, matching=True)
    cfg = dataclasses.replace(cfg, renderer=matching)
    needs = {"vae": {"vae"}, "recon": {"encoder", "renderer"}, "match": {"renderer"}}
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


def test_the_model_that_is_saved_is_the_average(common, cheap, tmp_path, monkeypatch):
    kept, train = {}, loop.train

    def averaged(*arguments, **more):
        state = train(*arguments, **more)
        kept.update(flatten(jax.tree.map(lambda x: np.asarray(x) + 0.25, state["params"])))
        return state | {"ema": unflatten(kept)}

    monkeypatch.setattr(loop, "train", averaged)
    run(*common, "--stage", "prior", "--steps", 1, "--batch", 1, "--out", tmp_path)
    found = flatten(load_model(tmp_path / "prior/model")[0])
    assert kept
    for path, leaf in kept.items():
        np.testing.assert_array_equal(found[path], leaf, err_msg=path)


def test_a_preview_is_measured_again_once_the_latents_moved(monkeypatch):
    """Its error is one of latents: a VAE that encodes otherwise forgets it, one that decodes otherwise does not."""
    cfg = config.preset("tiny")
    spread = tuple(np.linspace(0.1, 0.4, cfg.vae.latent))
    cfg = dataclasses.replace(
        cfg, fusion=dataclasses.replace(cfg.fusion, preview=True, preview_std=spread)
    )
    monkeypatch.setattr(stages, "measure_latents", lambda params, source, config, seed: config)
    found = {}
    for name, leaf in (("vae_longer", "vae/encoder/x"), ("vae_decoder", "vae/decoder/x")):
        stage = stages.find_stage(stages.mini_stages(), name)
        tree = unflatten({leaf: jnp.zeros(())})
        _, measured, _ = training_run._measured(tree, tree, stage, cfg, None, 0)
        found[name] = measured.fusion.preview_std
    assert found == {"vae_longer": None, "vae_decoder": spread}


def drawn_sequence(seed, *, frames, height, width, depth, varied):
    """In place of a rendered scene: `procedural.scenes.sample_sequence`."""
    assert seed >= procedural.HELDOUT_SEED and varied  # of the kind that training draws
    rng = np.random.default_rng(seed)
    c2w = np.tile(np.eye(4), (frames, 1, 1))
    c2w[:, :3, 3] = rng.standard_normal((frames, 3))
    K = np.tile(np.diag([40.0, 40.0, 1.0]), (frames, 1, 1))
    rgb = rng.integers(0, 256, (frames, height, width, 3), dtype=np.uint8)
    further = {"depth": np.ones((frames, height, width), np.float16)} if depth else {}
    return {"rgb": rgb, "K": K, "c2w": c2w, **further}


def test_held_out_scenes_have_depth_where_the_stage_learns_from_it(monkeypatch):
    monkeypatch.setattr(procedural, "sample_sequence", drawn_sequence)
    cfg = config.preset("tiny")
    stage = stages.find_stage(stages.mini_stages(size=(cfg.height, cfg.width)), "match")
    at = stages.stage_config(cfg, stage)

    def objective(trainable, frozen, batch, key):
        return batch["depth"].mean(), {}

    assert held_out(objective, {}, stage, at, scenes=4)({})["held_loss"] > 0.0


def test_held_out_scenes_are_scored_undisturbed(monkeypatch):
    """However a stage draws and alters its samples: the same views, pictures and cameras are scored."""

    def objective(trainable, frozen, batch, key):
        told = {name: x.mean() + x.std() for name, x in batch.items()}
        return told["context_rgb"], told

    monkeypatch.setattr(procedural, "sample_sequence", drawn_sequence)
    cfg = config.preset("tiny")
    stage = stages.find_stage(stages.mini_stages(frames=cfg.frames), "lookup")
    scores = []
    for change in (
        {"augment": True, "near": 1.0, "faults": 1.0},
        {"augment": False, "near": 0.0, "faults": 0.0},
    ):
        views = dataclasses.replace(stage.views, **change)
        one = dataclasses.replace(stage, views=views, batch=2)
        scores.append(held_out(objective, {}, one, cfg, scenes=4)({}))
    assert scores[0] == scores[1]
    assert set(scores[0]) >= {"held_loss", "held_K", "held_c2w", "held_target_rgb"}


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
    with pytest.raises(UserError, match=r"6 frames .* chunks of 7"):
        open_source(tmp_path, 32, 64, 7)


def test_the_preset_must_be_that_of_the_model(tmp_path):
    with pytest.raises(UserError, match="'mini' model and the preset is 'tiny'"):
        run("tiny", "--init", "mini", "--devices", 1, "--out", tmp_path)
    with pytest.raises(UserError, match="'mini' model and the preset is 'tiny'"):
        run("tiny", "--init", "mini", "--dry-run")


@pytest.mark.parametrize("path", ["dit/head/linear/kernel", "vae/decoder/conv_out/bias"])
def test_a_start_that_is_not_finite_is_refused_before_it_trains(tmp_path, path, capsys):
    """Whether its leaf trains or not."""
    cfg = config.preset("tiny")
    flat = flatten(jax.tree.map(np.array, model.init(jax.random.key(0), cfg)))
    flat[path][...] = np.inf
    save_model(tmp_path / "model", unflatten(flat), cfg)
    words = ["tiny", "--init", tmp_path / "model", "--stage", "joint", "--devices", 1]
    words = [str(word) for word in [*words, "--out", tmp_path / "out"]]
    assert entry.execute(train.main, train.parser(), words) == 2
    assert f"'{path}' has NaN or infinite numbers" in capsys.readouterr().err
    assert not list((tmp_path / "out" / "joint").glob("*/*"))  # neither checkpoint nor model


# What a run is held to when it goes on.


def test_another_start_or_pool_of_the_same_name_is_refused(common, cheap, tmp_path, capsys):
    cfg = config.preset("tiny")
    for name, seed in (("a", 0), ("b", 1)):
        save_model(tmp_path / name / "model", model.init(jax.random.key(seed), cfg), cfg)
        write_dataset(tmp_path / name / "pool", (32, 48), seed)

    def go(start, pool, *more):
        given = ["--init", tmp_path / start / "model", "--data", tmp_path / pool / "pool"]
        run(*common, "--out", tmp_path / "out", *given, *more)
        return capsys.readouterr().out

    assert "begun" not in go("a", "a", "--steps", 1)
    with pytest.raises(UserError, match="holds a run with start contents"):
        go("b", "a", "--steps", 2, "--resume")
    with pytest.raises(UserError, match="holds a run with data contents"):
        go("a", "b", "--steps", 2, "--resume")
    with pytest.raises(UserError, match="frozen dtype float32, and bfloat16 is asked"):
        go("a", "a", "--steps", 2, "--resume", "--frozen-dtype", "bfloat16")
    (tmp_path / "a").rename(tmp_path / "moved")
    said = go("moved", "moved", "--steps", 2, "--resume", "--remat", "full")
    assert said.count("begun for 1 steps and continued for 2") == 1
    assert len(losses(tmp_path / "out/lora")) == 2
    file = tmp_path / "out/lora/settings.json"  # as runs wrote it that did not look at contents
    held = json.loads(file.read_text())
    lost = ("start contents", "data contents", "frozen dtype", "steps")
    held = {name: value for name, value in held.items() if name not in lost}
    file.write_text(json.dumps(held | {"start": "model", "data": "pool"}))
    said = go("b", "b", "--steps", 2, "--resume")
    assert "does not say with which frozen dtype, start contents, data contents" in said
    with pytest.raises(UserError, match="holds a run with seed 0, and 1 is asked for"):
        go("moved", "moved", "--steps", 2, "--resume", "--seed", 1)


def test_every_setting_that_changes_what_is_trained_is_held(tmp_path):
    cfg = config.preset("tiny")
    stage = stages.lora_stage(10, frames=cfg.frames)
    pool = write_dataset(tmp_path / "pool", (32, 48))

    def hold(begun=True, stage=stage, config=cfg, params=0.0, **changes):
        given = {"seed": 0, "frozen_dtype": "float32", "start": "a", "pool": pool} | changes
        weights = {"x": np.full(3, params, np.float32)}
        return hold_settings(tmp_path, stage, weights, config, begun=begun, resume=True, **given)

    hold(begun=False)
    assert hold(start="of another name") == []
    (said,) = hold(stage=dataclasses.replace(stage, steps=20))
    assert "begun for 10 steps and continued for 20" in said
    faster = dataclasses.replace(stage.optim, learning_rate=1e-3)
    for name, changes in (
        ("model", {"config": dataclasses.replace(cfg, name="other")}),
        ("size", {"config": dataclasses.replace(cfg, height=64)}),
        ("batch", {"stage": dataclasses.replace(stage, batch=5)}),
        ("seed", {"seed": 1}),
        ("learning rate", {"stage": dataclasses.replace(stage, optim=faster)}),
        ("frozen dtype", {"frozen_dtype": "bfloat16"}),
        ("dtype of products", {"stage": dataclasses.replace(stage, products="bfloat16")}),
        ("start contents", {"params": 1.0}),
        ("data contents", {"pool": None}),
        ("samples encoded once", {"stage": dataclasses.replace(stage, stored=7)}),
    ):
        with pytest.raises(UserError, match=f"holds a run with {name} "):
            hold(**changes)
    colours = np.load(pool / "shard_00000.rgb.npy")
    colours[-1, -1, -1, -1] += 1
    np.save(pool / "shard_00000.rgb.npy", colours)
    with pytest.raises(UserError, match="holds a run with data contents "):
        hold()


def test_a_fingerprint_tells_contents_and_nothing_else(tmp_path):
    cfg = config.preset("tiny")
    params = model.init(jax.random.key(0), cfg)
    found = model_fingerprint(params, cfg)
    for name in ("one", "two/renamed"):
        save_model(tmp_path / name, params, cfg, dtype=jnp.float32)
        assert model_fingerprint(*load_model(tmp_path / name)) == found
    other = jax.tree.map(lambda x: x, params)
    kernel = other["fusion"]["geometry_adapter"]["kernel"]
    other["fusion"]["geometry_adapter"]["kernel"] = kernel.at[3, 1].add(1e-6)
    flow = dataclasses.replace(cfg.flow, photometric=2 * cfg.flow.photometric)
    others = [(other, cfg), (params, dataclasses.replace(cfg, flow=flow))]
    assert len({found, *(model_fingerprint(*other) for other in others)}) == 3

    large = np.zeros(3 * BLOCKS * BLOCK_BYTES, np.uint8)  # read in blocks
    seen = {
        fingerprint([("x", large)]),
        fingerprint([("y", large)]),
        fingerprint([("x", large[1:])]),
    }
    for place in (0, -1):
        large[place] = 1
        seen.add(fingerprint([("x", large)]))
    assert len(seen) == 5


# Options that only look, or save memory.


def test_what_is_looked_at_reaches_log_events_and_terminal(common, tmp_path, monkeypatch, capsys):
    """The program and the diagnosis are real; the two terms are small functions of the leaves both halves share."""

    def loss(trainable, frozen, batch, key, *, config, draws=1, remat="full"):
        kept = flatten(frozen)
        assert kept["dit/blocks/self_attn/q/kernel"].dtype == jnp.bfloat16
        assert {x.dtype for p, x in kept.items() if p.startswith("vae/")} == {jnp.dtype("float32")}
        leaves = jax.tree.leaves(trainable)
        terms = {
            "flow": sum(jnp.square(x - 1.0).mean() for x in leaves),
            "photometric": sum(jnp.square(x - 2.0).mean() for x in leaves),
        }
        return terms["flow"] + config.flow.photometric * terms["photometric"], terms

    monkeypatch.setattr(model, "loss", loss)
    monkeypatch.setattr(diagnose, "flow_by_sigma", lambda p, b, k, sigmas, **_: jnp.asarray(sigmas))
    pool = write_dataset(tmp_path / "pool", (32, 48))
    given = ["--data", pool, "--out", tmp_path, "--steps", 3, "--frozen-dtype", "bfloat16"]
    run(*common, *given, "--diagnose-every", 2, "--tensorboard", "--show-mesh")
    rows = [json.loads(line) for line in (tmp_path / "lora/log.jsonl").read_text().splitlines()]
    shown = {"flow_grad_norm", "photometric_grad_norm", "grad_cosine", "flow_sigma_0.06"}
    assert [shown <= row.keys() for row in rows] == [False, True, True]  # and after the last step
    assert rows[1]["flow_grad_norm"] > rows[1]["photometric_grad_norm"] > 0
    assert 0.9 < rows[1]["grad_cosine"] <= 1.0 + 1e-6
    events = list((tmp_path / "lora/tensorboard").glob("events.out.tfevents.*"))
    written = b"".join(file.read_bytes() for file in events)
    assert b"lora/loss" in written and b"lora/grad_cosine" in written
    said = capsys.readouterr().out
    assert said.count("mesh data=1, fsdp=1, seq=1") == 2  # of what trains and of what is frozen
    stage = stages.lora_stage(1, frames=config.preset("tiny").frames)
    for tree in stages.stage_specs(config.preset("tiny"), stage):
        assert all(f"{path} " in said for path in flatten(tree))
