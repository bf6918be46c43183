"""The recipe of `--stage all` and the paper's two stages at its end, on the tiny preset."""

import dataclasses
import itertools
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from train_runs import run, same, write_dataset

from roge_jax import config, model, train
from roge_jax.checkpoint import load_model, save_model
from roge_jax.core.params import flatten
from roge_jax.data.dataset import write_dataset as procedural_dataset
from roge_jax.errors import UserError
from roge_jax.training import stages


@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_all_stages_run_and_go_on_after_an_interruption(
    real, common, tmp_path, monkeypatch, request
):
    if not real:
        request.getfixturevalue("cheap")
    pool = write_dataset(tmp_path / "pool", (64, 96))
    options = [*common, "--stage", "all", "--data", pool, "--steps", 2, "--batch", 1]
    run(*options, "--out", tmp_path / "whole")
    cfg = config.preset("tiny")
    recipe = [s.name for s in stages.mini_stages() if not s.lookup and s.objective != "match"]
    order = [*recipe, "lora", "hires"]
    assert {p.name for p in (tmp_path / "whole").iterdir()} == set(order)
    whole = {name: load_model(tmp_path / "whole" / name / "model") for name in order}
    assert {c.height for name, (_, c) in whole.items() if name != "hires"} == {cfg.height}
    assert (whole["hires"][1].height, whole["hires"][1].width) == (2 * cfg.height, 2 * cfg.width)
    recon = [(c.recon_height, c.recon_width) for _, c in (whole["lora"], whole["hires"])]
    assert recon[0] == recon[1] == (cfg.recon_height, cfg.recon_width)  # Sec. 3.3
    for before, after in itertools.pairwise(order):  # each goes on from the one before
        assert not same(whole[before][0], whole[after][0])
        held = json.loads((tmp_path / "whole" / after / "settings.json").read_text())
        assert held["start"] == str(tmp_path / "whole" / before / "model")
    adapter = json.loads((tmp_path / "whole/hires/adapter/config.json").read_text())
    assert adapter["provenance"]["base"] == str(tmp_path / "whole/lora/model")

    draw, trained = stages.stage_batch, []

    def interrupted(source, stage, *rest):
        if (stage.name, rest[2]) == ("lora", 1) and not trained.count("again"):
            raise KeyboardInterrupt
        trained.append(stage.name)
        return draw(source, stage, *rest)

    monkeypatch.setattr(stages, "stage_batch", interrupted)
    for name in recipe:
        shutil.copytree(tmp_path / "whole" / name, tmp_path / "again" / name)
    with pytest.raises(KeyboardInterrupt):
        run(*options, "--out", tmp_path / "again", "--resume")
    assert set(trained) == {"lora"} and not (tmp_path / "again/lora/model").exists()
    trained[:] = ["again"]
    run(*options, "--out", tmp_path / "again", "--resume")
    assert trained == [
        "again",
        "lora",
        "hires",
        "hires",
    ]  # the second step of lora, and what follows
    for name in order:
        params, found = load_model(tmp_path / "again" / name / "model")
        assert same(params, whole[name][0]) and found == whole[name][1], name
    with pytest.raises(UserError, match="holds a run with seed 0, and 1 is asked for"):
        run(*options, "--out", tmp_path / "again", "--resume", "--seed", 1)


def test_crops_fit_into_the_pictures():
    sides = {}
    for name, words in (("tiny", []), ("mini", []), ("mini", ["--size", "48x64"])):
        args = train.parser().parse_args([name, "--stage", "all", *words])
        _, chosen = train.choose(args, config.preset(name))
        sides[name, *words] = {stage.crop for stage in chosen if stage.crop}
    assert list(sides.values()) == [{32}, {64}, {48}]


def test_all_refuses_a_pool_that_its_last_stage_cannot_use_before_the_first(common, tmp_path):
    pool = write_dataset(tmp_path / "pool", (32, 48))
    with pytest.raises(UserError, match=r"Stage hires: .* 32x48 and this stage trains at 64x96"):
        run(*common, "--stage", "all", "--data", pool, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_hires_leaves_the_reconstruction_bit_for_bit(common, cheap, tmp_path):
    cfg = config.preset("tiny")
    start = model.init(jax.random.key(0), cfg)
    save_model(tmp_path / "start", start, cfg, dtype=jnp.float32)
    pool = write_dataset(tmp_path / "pool", (64, 96))
    given = ["--init", tmp_path / "start", "--data", pool, "--steps", 1]
    found = {}
    for stage, size in (("lora", []), ("hires", [])):
        run(*common, "--stage", stage, *given, *size, "--out", tmp_path / "out")
        found[stage], _ = load_model(tmp_path / "out" / stage / "model")
    for part in ("encoder", "renderer"):
        assert same(found["hires"], start, part)
        assert not same(found["lora"], start, part)  # which the same objective moves where it may
    assert same(found["hires"], start, "vae")
    for part in ("dit/blocks/self_attn/q", "dit/patch_embed", "fusion"):
        assert not same(found["hires"], start, part)


@pytest.mark.parametrize("name", ["recon", "lora", "hires", "all"])
def test_scale_multiplies_the_steps_of_any_stage(name):
    def steps(*words):
        args = train.parser().parse_args(["tiny", "--stage", name, *words])
        return [stage.steps for stage in train.choose(args, config.preset("tiny"))[1]]

    assert steps("--steps-scale", "0.5") == [n / 2 for n in steps()]
    assert set(steps("--steps-scale", "1e-6")) == {1}
    assert set(steps("--steps-scale", "0.5", "--steps", "7")) == {7}


def test_matching_features_are_trained_on_a_pool_with_depth(tmp_path):
    """The stage changes its own leaves alone, resumes exactly, and says what it needs."""
    cfg = config.preset("tiny")
    renderer = dataclasses.replace(cfg.renderer, lookup=8, matching=True)
    cfg = dataclasses.replace(cfg, renderer=renderer)
    params = model.init(jax.random.key(0), cfg)
    save_model(tmp_path / "start", params, cfg, dtype=np.float32)
    size = (stages.FINER * cfg.height, stages.FINER * cfg.width)
    seeds, options = range(2), {"supersample": 1, "varied": True}
    for name, depth in (("bare", False), ("pool", True)):
        procedural_dataset(tmp_path / name, seeds, 6, *size, depth=depth, **options)
    words = [
        "tiny",
        "--init",
        tmp_path / "start",
        "--stage",
        "match",
        "--devices",
        1,
        "--save-every",
        1,
    ]
    with pytest.raises(UserError, match=r"bare: its scenes have no depth.*--depth"):
        run(*words, "--steps", 1, "--data", tmp_path / "bare", "--out", tmp_path / "out")
    words += ["--data", tmp_path / "pool"]
    run(*words, "--steps", 2, "--out", tmp_path / "whole")
    run(*words, "--steps", 1, "--out", tmp_path / "parts")
    run(*words, "--steps", 2, "--out", tmp_path / "parts", "--resume")
    first, whole, parts = (
        flatten(load_model(tmp_path / name)[0])
        for name in ("start", "whole/match/model", "parts/match/model")
    )
    changed = {path for path in first if not np.array_equal(first[path], whole[path])}
    assert changed and all(path.startswith("renderer/lookup/match/") for path in changed)
    log = [json.loads(x) for x in (tmp_path / "whole/match/log.jsonl").read_text().splitlines()]
    assert np.isfinite(log[-1]["loss"]) and 0.0 <= log[-1]["right"] <= 1.0
    assert set(parts) == set(whole)
