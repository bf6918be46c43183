"""The shipped weights: their reconstruction is ahead of what needs no learning, on photos far apart and close together."""

import functools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from roge_jax import checkpoint, evaluate, model, train
from roge_jax.data.views import make_sample
from roge_jax.metrics.baselines import baselines
from roge_jax.metrics.image import image_metrics


@functools.cache
def shipped():
    params, config = checkpoint.load_model("mini")

    @jax.jit
    def picture(params, views):
        tokens = model.reconstruct(params, views, config=config)
        features = model.query_rays(params, tokens, views, config=config)
        return model.show(params, features, views, config=config)

    return params, config, picture


def gains(samples) -> tuple[float, float]:
    """(dB above the plane at the true median depth, sharpness where the truth has 1), means over the samples."""
    params, config, picture = shipped()
    rows = []
    for scene in samples:
        m, (K, c2w) = len(scene["context"]), (scene["K"], scene["c2w"])
        views = make_sample(scene["rgb"], K, c2w, m, scale_rule=config.scale_rule)
        truth = views.pop("target_rgb")
        shown = image_metrics(np.asarray(picture(params, views)), truth)
        simple, _ = baselines(
            scene["rgb"][:m], K[:m], c2w[:m], K[m:], c2w[m:], truth.shape[1:3], scene["depth"]
        )
        plane = image_metrics(np.clip(simple["plane"], 0.0, 1.0), truth)
        rows.append((shown["psnr"] - plane["psnr"], shown["sharpness_ratio"]))
    return tuple(np.mean(rows, 0))


@pytest.mark.parametrize("close", [False, True])
def test_the_reconstruction_is_ahead_of_the_plane(close):
    size, samples = (64, 112), []
    for seed in (1000000010, 1000000011):
        c2w, take = evaluate.open_views(f"procedural:{seed}", 20, size, None)
        if close:
            samples += [take(*one) for one in evaluate.neighbours(c2w, 2, 3)]
        else:
            context, target = evaluate.spread(20, 3, 17)
            samples.append(take(context, target[::4]))
    above, sharpness = gains(samples)
    assert above > (1.2 if close else 2.5) and sharpness > 0.5


@pytest.mark.slow  # half a minute of compiling; test_sample.py and test_evaluate.py generate with a tiny model
def test_the_generated_video_is_near_the_reconstructions_picture():
    """As the program samples: within a dB of it against the truth, and no greyer."""
    evaluator = evaluate.Evaluator("mini")
    size = (evaluator.config.height, evaluator.config.width)
    _, take = evaluate.open_views("procedural:1000000011", 20, size, None)
    scene = take(*evaluate.spread(20, 3, evaluator.config.frames))
    made, truth = evaluator.videos(scene), scene["rgb"][3:]
    generated, head = (
        image_metrics(np.clip(made[name], 0.0, 1.0), truth) for name in ("generated", "rgb_head")
    )
    assert generated["psnr"] > head["psnr"] - 1.0
    assert generated["sharpness_ratio"] > 0.9 * head["sharpness_ratio"]


def test_the_shipped_files_are_small():
    files = list(checkpoint.find_model("mini").glob("*.safetensors"))
    sizes = [file.stat().st_size for file in files]
    assert files and sum(sizes) <= 64e6 and max(sizes) <= 16e6


def make_train(*more) -> list[str]:
    """The words of `make train` behind the program, but for its folder."""
    makefile = (Path(__file__).parents[1] / "Makefile").read_text()
    words = re.search(r"-m roge_jax\.train (mini .*) --out", makefile).group(1)
    return [*words.split(), *map(str, more)]


def test_make_train_goes_on_end_to_end_at_a_larger_size():
    args = train.parser().parse_args(make_train())
    config, [stage] = train.choose(args, checkpoint.load_config(checkpoint.find_model("mini")))
    assert (config.height, config.width) == (config.recon_height, config.recon_width) == (96, 160)
    trained = {part for part, _ in model.split(model.specs(config), stage.trains)[0].items()}
    assert stage.objective == "joint" and trained == {"dit", "fusion", "encoder", "renderer"}
    assert train.starting_point(args) == "mini" and 0 < args.evaluate_every < stage.steps


@pytest.mark.slow  # six minutes, half of them compiling
def test_make_train_lowers_the_held_out_loss(tmp_path):
    words = make_train("--steps", 12, "--evaluate-every", 12, "--out", tmp_path)
    # Without the suite's XLA flags: its programs compile quickly and run slowly.
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("XLA_", "JAX_"))}
    subprocess.run([sys.executable, "-m", "roge_jax.train", *words], check=True, env=plain)
    rows = [json.loads(line) for line in (tmp_path / "joint/log.jsonl").read_text().splitlines()]
    before, after = [row for row in rows if "held_loss" in row]
    for term in ("held_loss", "held_flow", "held_photometric"):
        assert after[term] < before[term], term
    assert checkpoint.load_config(tmp_path / "joint/model").width == 160
