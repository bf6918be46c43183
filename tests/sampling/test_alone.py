"""A reconstruction alone, as LagerNVS's checkpoints are: a model that every program takes. A generator alone: a sentence."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import published_files as made
import pytest
from PIL import Image
from run_files import PREVIEW_ALONE
from scene_files import nerfstudio, truth

import roge_jax as rj
from roge_jax import check, convert, evaluate, model, sample, sampling, train
from roge_jax.checkpoint import load_config, save_model
from roge_jax.config import preset, to_dict
from roge_jax.core import params as trees
from roge_jax.errors import UserError
from roge_jax.files import entry, video_io
from roge_jax.sampling import programs, reconstruction
from roge_jax.weights import catalogue

SIZE = "48x64"  # of pictures here: no multiple of 16 is needed where there are no latents


def run(module, *words):
    return entry.execute(module.main, module.parser(), [str(word) for word in words])


def published(folder: Path, attention="bidirectional", name="model.pt") -> Path:
    """A LagerNVS file of random weights, as PyTorch writes it."""
    renderer = dataclasses.replace(made.CONFIG.renderer, attention=attention)
    tensors = made.recon_tensors(dataclasses.replace(made.CONFIG, renderer=renderer))[1]
    kinds = {key: "BF16" for key, value in tensors.items() if value.dtype != np.float32}
    folder.mkdir(parents=True)
    shapes = {key: value.shape for key, value in tensors.items()}
    return made.save_torch(folder / name, shapes, lambda key, _: tensors[key], "model", kinds)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`lager`: a folder from the general checkpoint's; `wan`: a transformer and its VAE; `scene`: four photos."""
    root = tmp_path_factory.mktemp("alone")
    published(root / "lagernvs_general_512")
    given = ["--lagernvs", root / "lagernvs_general_512", "--dtype", "float32"]
    assert run(convert, *given, "--out", root / "lager") == 0
    made.save_sharded(root / "files", made.dit_tensors()[1])
    made.save(root / "files" / "Wan2.1_VAE.safetensors", made.vae_tensors()[1])
    config = dataclasses.replace(made.CONFIG, name="test")
    (root / "config").mkdir()
    record = {"format": 1, "config": to_dict(config)}
    (root / "config" / "config.json").write_text(json.dumps(record))
    wan = ["--wan", root / "files", "--preset", root / "config", "--out", root / "wan"]
    assert run(convert, *wan) == 0
    nerfstudio(root / "scene", truth(4))
    return root


# ---- converting ----------------------------------------------------------------------------------


def test_the_file_alone_is_a_whole_model(place, capsys):
    tree, config = rj.load(place / "lager")
    assert config.parts == "reconstruction" and config.name == "lagernvs_general_512"
    assert (config.height, config.width) == config.output_size == (288, 512)
    assert (config.recon_height, config.recon_width, config.max_context) == (288, 512, 10)
    want = made.recon_tensors()[0]
    got = trees.flatten(tree)
    assert got.keys() == want.keys()
    for path, value in want.items():
        np.testing.assert_array_equal(got[path], value, err_msg=path)
    record = json.loads((place / "lager" / "config.json").read_text())["provenance"]
    assert record["initialised"] == [] and record["prompt"] == "none"


@pytest.mark.parametrize(
    ("name", "attention", "size", "photos"),
    [
        ("lagernvs_general_512", "bidirectional", (288, 512), 10),
        ("lagernvs_dl3dv_2-6_v_256", "bidirectional", (256, 256), 6),
        ("lagernvs_re10k_2v_256", "full", (256, 256), 2),
        ("mine", "bidirectional", (288, 512), 10),
        ("mine", "full", (256, 256), 2),
    ],
)
def test_a_checkpoint_has_the_size_it_was_trained_for(tmp_path, name, attention, size, photos):
    file = published(tmp_path / name, attention)
    for given in (file, file.parent):
        plan, _ = convert.make_plan(entry.parse(convert.parser(), ["--lagernvs", str(given)]))
        cfg = plan.config
        assert (cfg.height, cfg.width) == (cfg.recon_height, cfg.recon_width) == size
        assert cfg.max_context == photos and cfg.renderer.attention == attention
        assert cfg.name == ("lagernvs" if name == "mine" else name)


def test_names_find_downloads(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    name, snapshots = "lagernvs_re10k_2v_256", "models--facebook--lagernvs_re10k_2v_256/snapshots"
    with pytest.raises(UserError) as caught:
        catalogue.locate(Path(name))
    said = str(caught.value)
    assert "ask for access on https://huggingface.co/facebook/lagernvs_re10k_2v_256" in said
    assert f"hf download facebook/{name} --include model.pt --local-dir {name}" in said
    published(tmp_path / "hub" / snapshots / "1234", "full")
    for given in (name, f"facebook/{name}"):
        plan, _ = convert.make_plan(entry.parse(convert.parser(), ["--lagernvs", given]))
        assert plan.config.name == name
    published(tmp_path / name)  # beside: an ordinary path, which has precedence
    plan, _ = convert.make_plan(entry.parse(convert.parser(), ["--lagernvs", name]))
    assert plan.config.renderer.attention == "bidirectional"
    assert catalogue.locate(Path("nowhere/model.pt")) == Path("nowhere/model.pt")


def fails(match, module, *words):
    """Exit code 2 and one line that matches; nothing is written."""
    with pytest.raises(UserError, match=match) as caught:
        module.main(entry.parse(module.parser(), [str(word) for word in words]))
    assert "\n" not in str(caught.value)


def test_halves_that_cannot_be(place, tmp_path):
    out = ["--out", tmp_path / "m"]
    fails("No file to convert: give --lagernvs", convert, *out)
    fails("No file to convert", convert, "--random", "encoder", "renderer", *out)
    tensors = made.vggt_tensors()[1]
    vggt = made.save(tmp_path / "model.safetensors", tensors)
    fails("VGGT-1B alone makes no pictures", convert, "--vggt", vggt, *out)
    file = place / "files" / "diffusion_pytorch_model.safetensors.index.json"
    wan = made.save(tmp_path / "bare" / "wan.safetensors", made.dit_tensors()[1])
    fails("Nothing fills vae: give --wan-vae", convert, "--wan", wan, *out)
    np.save(tmp_path / "rows.npy", np.ones((1, 8), np.float32))
    lager = ["--lagernvs", place / "lagernvs_general_512", *out]
    fails("reads no text", convert, *lager, "--prompt-embedding", tmp_path / "rows.npy")
    fails("Nothing fills dit: give --wan", convert, *lager, "--random", "vae")
    assert file.exists() and not (tmp_path / "m").exists()


# ---- pictures ------------------------------------------------------------------------------------


def test_sample_makes_the_picture_and_says_so(place, capsys):
    out = place / "out"
    words = ["--checkpoint", place / "lager", "--scene", place / "scene", "--size", SIZE]
    assert run(sample, *words, "--trajectory", "orbit", "--frames", 3, "--out", out) == 0
    assert sorted(p.name for p in out.iterdir()) == PREVIEW_ALONE
    record = json.loads((out / "run.json").read_text())
    assert record["generated"] is False and record["size"] == [48, 64]
    assert record["seconds_per_frame"] == pytest.approx(
        record["stages"]["preview"]["seconds"] / 3, abs=1e-3
    )
    assert "s a frame" in capsys.readouterr().out
    frames = np.stack([np.asarray(Image.open(p)) for p in sorted((out / "frames").iterdir())])
    # In Python, by the notebook's calls.
    tree, config = rj.load(place / "lager")
    config = config.for_pictures(48, 64)
    scene = rj.load_scene(str(place / "scene"))
    photos = sampling.read_photos(scene, record["scene"]["context"], config)
    path = rj.make_path("orbit", photos.cameras, frames=3)
    result = sampling.sample(tree, config, photos, path)
    np.testing.assert_array_equal(video_io.to_uint8(result.frames), frames)
    assert result.evaluations == 0 and np.ptp(result.frames) > 0.05
    # It is what the networks say, one view after the other.
    known, info = reconstruction.encode(tree, config, photos, path)
    targets = info.apply(path)
    K, c2w = (np.asarray(x, np.float32) for x in (targets.K, targets.c2w))
    views = {n: np.concatenate([known.views[n], x]) for n, x in (("K", K), ("c2w", c2w))}
    rgb, _ = jax.jit(lambda p: programs.rgb_head(p, known.views | views, config=config))(tree)
    np.testing.assert_allclose(result.frames, rgb, atol=2e-5)


def test_views_are_made_a_chunk_at_a_time(place):
    """Memory does not grow with the path; the chunks are alike, the last one nearly full."""
    config = load_config(place / "lager")
    many = dataclasses.replace(config, renderer=dataclasses.replace(config.renderer, chunk=8))
    assert reconstruction.at_once(many, 81) == 1  # on a CPU, where views share nothing
    cross = dataclasses.replace(many.renderer, attention="cross")
    cross = dataclasses.replace(many, renderer=cross)
    assert [reconstruction.at_once(cross, n) for n in (1, 8, 9, 20, 81)] == [1, 8, 5, 7, 8]
    with reconstruction.target.use("h100"):
        assert reconstruction.at_once(many, 81) == 8
    tree, _ = rj.load(place / "lager")
    small = config.for_pictures(32, 48)
    photos = sampling.blank_scene("x", 2, small)
    photos = sampling.read_photos(
        dataclasses.replace(
            photos, images=[np.full((32, 48, 3), 40 * i, np.uint8) for i in (1, 3)]
        ),
        [0, 1],
        small,
    )
    path = rj.make_path("orbit", photos.cameras, frames=5)
    one = sampling.sample(tree, small, photos, path).frames
    three = dataclasses.replace(small, renderer=dataclasses.replace(small.renderer, chunk=3))
    with reconstruction.target.use("h100"):
        assert reconstruction.at_once(three, 5) == 3
    whole = sampling.sample(tree, three, photos, path[:4]).frames
    np.testing.assert_allclose(one[:4], whole, atol=1e-5)


@pytest.mark.parametrize(
    "words", [("--steps", 3), ("--seed", 1), ("--tolerance", 0.1), ("--solver", "euler")]
)
def test_options_of_a_generator_are_refused(place, words):
    given = ["--checkpoint", place / "lager", "--scene", place / "scene", "--out", place / "never"]
    for more in ([], ["--dry-run"]):
        fails(
            f"{words[0]} {words[1]} is for the generator, and .*lager is a reconstruction alone",
            sample,
            *given,
            *words,
            *more,
        )
    assert not (place / "never").exists()


def test_a_dry_run_counts_the_reconstruction(place, capsys):
    assert (
        run(sample, "--checkpoint", place / "lager", "--scene", place / "scene", "--dry-run") == 0
    )
    said = capsys.readouterr().out
    assert "its reconstruction alone" in said and "81 frames of 288x512" in said
    assert "velocity" not in said and "VAE" not in said


def test_more_photos_than_it_was_trained_for_are_refused(place, tmp_path):
    published(tmp_path / "lagernvs_re10k_2v_256", "full")
    given = ["--lagernvs", tmp_path / "lagernvs_re10k_2v_256", "--out", tmp_path / "two"]
    assert run(convert, *given) == 0
    words = ["--checkpoint", tmp_path / "two", "--scene", place / "scene", "--context", 3]
    fails("--context 3: give 1 to 2", sample, *words, "--out", tmp_path / "o")


def test_there_is_nothing_to_plan(place):
    tree, config = rj.load(place / "lager")
    config = config.for_pictures(48, 64)
    photos = sampling.read_photos(rj.load_scene(str(place / "scene")), [0, 1], config)
    path = rj.make_path("orbit", photos.cameras, frames=2)
    with pytest.raises(UserError, match="no generator to spare"):
        rj.plan(tree, config, photos, path, tolerance=0.1)
    whole = preset("tiny")
    tiny = rj.model.init(jax.random.key(0), whole)
    small = sampling.read_photos(rj.load_scene(str(place / "scene")), [0, 1], whole)
    plan = rj.plan(tiny, whole, small, rj.make_path("orbit", small.cameras, frames=2), tolerance=0)
    with pytest.raises(UserError, match="no generator to spare"):
        sampling.sample(tree, config, photos, path, plan=plan)


# ---- the other programs --------------------------------------------------------------------------


def test_evaluate_judges_the_rgb_head(place, capsys):
    out = place / "results.json"
    words = ["--checkpoint", place / "lager", "--scenes", place / "scene", "--context", 2]
    words += ["--size", "32x48", "--lpips", "none"]
    assert run(evaluate, *words, "--out", out, "--sheet", place / "sheet.png") == 0
    results = json.loads(out.read_text())
    assert "rgb_head" in results["means"] and "nearest" in results["means"]
    assert not {"generated", "vae_round_trip"} & set(results["means"])
    assert results["settings"]["model_size"] == results["settings"]["size"] == [32, 48]
    assert not {"solver", "steps", "schedule"} & set(results["settings"])
    assert set(results["differences"]) == {"rgb_head"}
    assert run(evaluate, *words, "--close", 2, "--out", place / "close.json") == 0
    fails("--steps 3 is for the generator", evaluate, *words, "--steps", 3, "--out", out)


def test_evaluate_shows_what_sample_shows(place):
    evaluator = evaluate.Evaluator(str(place / "lager"))
    evaluator.config = config = evaluator.config.for_pictures(32, 48)
    _, take = evaluate.open_views(str(place / "scene"), 4, (32, 48), None)
    ((name, frames),) = evaluator.videos(take([0, 2], [1, 3])).items()
    photos = sampling.read_photos(rj.load_scene(str(place / "scene")), [0, 2], config)
    others = sampling.read_photos(rj.load_scene(str(place / "scene")), [1, 3], config).cameras
    want = sampling.sample(evaluator.params, config, photos, others).frames
    assert name == "rgb_head"
    np.testing.assert_allclose(frames, want, atol=1e-5)


def test_check_says_what_a_model_can_do(place, capsys):
    assert check.cli([str(place / "lager")]) == 0
    said = capsys.readouterr().out
    assert "288x512, of 1 to 10 photos" in said and "is a reconstruction alone" in said
    assert check.cli([str(place / "scene"), "--checkpoint", str(place / "lager"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["usable"]
    config = check.sized(check.Config("x", checkpoint=str(place / "lager")))
    assert (config.height, config.width) == (288, 512)
    assert check.sized(check.Config("x", height=64)).height == 64
    tiny = preset("tiny")
    save_model(place / "whole", model.init(jax.random.key(0), tiny), tiny)
    assert check.cli([str(place / "whole")]) == 0
    assert "is a reconstruction alone" not in capsys.readouterr().out
    (place / "cut").mkdir()
    (place / "cut" / "config.json").write_text((place / "lager" / "config.json").read_text())
    assert check.cli([str(place / "cut")]) == 2
    said = capsys.readouterr().out
    assert "is incomplete" in said and "makes no pictures" in said


def test_training_needs_both_halves(place, tmp_path):
    words = ["wan1.3b", "--init", place / "lager", "--out", tmp_path / "t"]
    for more in ([], ["--dry-run"]):
        fails("is a reconstruction alone, and training needs both halves", train, *words, *more)


def test_a_generator_alone_says_what_it_is_for(place, tmp_path, capsys):
    tree, config = rj.load(place / "wan")
    assert config.parts == "generator" and set(tree) == {"dit", "vae", "fusion", "prompt"}
    why = (
        "wan holds a video generator alone.*convert its files again together with a reconstruction"
    )
    words = ["--checkpoint", place / "wan"]
    fails(why, sample, *words, "--scene", place / "scene", "--out", tmp_path / "o")
    fails(why, sample, *words, "--scene", place / "scene", "--dry-run")
    fails(why, evaluate, *words, "--scenes", place / "scene", "--out", tmp_path / "r.json")
    assert check.cli([str(place / "wan")]) == 2
    assert "a video generator alone" in capsys.readouterr().out
    fails("is a generator alone, and training needs", train, "wan1.3b", "--init", place / "wan")
    whole = preset("tiny")
    photos = sampling.read_photos(rj.load_scene(str(place / "scene")), [0, 1], whole)
    with pytest.raises(UserError, match="a video generator alone"):
        sampling.preview(
            tree, dataclasses.replace(whole, parts="generator"), photos, photos.cameras
        )
    with pytest.raises(UserError, match="a video generator alone"):
        sampling.sample(tree, dataclasses.replace(whole, parts="generator"), photos, photos.cameras)
    assert not list(tmp_path.iterdir())
