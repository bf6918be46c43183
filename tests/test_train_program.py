"""The training program on the tiny preset: a few real steps, resume, what it writes, what it refuses."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
from test_sharding import small

from roge_jax import config, train
from roge_jax.checkpoint import load_model
from roge_jax.core.params import flatten
from roge_jax.errors import UserError
from roge_jax.training import stages


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
