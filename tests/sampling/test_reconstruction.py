"""The reconstruction alone: a scene encoded once, `sample --preview-only`, and that no generator is loaded for it."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from run_files import PREVIEW_ALONE
from scene_files import HEIGHT, WIDTH, nerfstudio, truth
from test_stretches import photos, weights  # noqa: F401  fixtures: the tiny model, two photos

from roge_jax import checkpoint, cost, model, sample, sampling
from roge_jax.config import preset
from roge_jax.files import entry, video_io
from roge_jax.geometry.cameras import Cameras
from roge_jax.geometry.trajectories import PRESETS, make_path, preset_options
from roge_jax.sampling import reconstruction
from roge_jax.scenes.images import read_image
from roge_jax.scenes.scene import Scene, load_scene

CONFIG = preset("tiny")
INDEPENDENT = sampling.Settings(steps=1, solver="euler", schedule="uniform", long="independent")


def parts(tree):
    return {name: tree[name] for name in reconstruction.PARTS}


def finer(images: np.ndarray, **changes) -> tuple:
    """(config, parameters, photos of `images` [k, 64, 96, 3]) of a model that looks into photos and makes pictures twice its
    own size."""
    renderer = dataclasses.replace(CONFIG.renderer, attention="cross", lookup=6)
    config = dataclasses.replace(CONFIG, renderer=renderer, output=(64, 96), **changes)
    params = model.init(jax.random.key(0), config)
    cameras = truth(len(images))
    stretched = cameras.K * np.array([96 / WIDTH, 64 / HEIGHT, 1.0])[None, :, None]
    names = tuple(f"{i}.png" for i in range(len(images)))
    scene = Scene(list(images), Cameras(stretched, cameras.c2w), names, "made here")
    return config, params, sampling.read_photos(scene, range(len(images)), config)


def test_it_is_the_preview_of_the_whole_sampler(weights, photos):  # noqa: F811
    """Two windows and a part, the generator's parameters not even there."""
    path = make_path("move-right", photos.cameras, 2 * CONFIG.frames + 2)
    whole = sampling.sample(weights, CONFIG, photos, path, INDEPENDENT)
    alone = sampling.preview(parts(weights), CONFIG, photos, path)
    np.testing.assert_allclose(alone.frames, whole.preview, atol=1e-5)
    assert alone.preview is alone.frames and alone.evaluations == 0
    np.testing.assert_array_equal(alone.cameras.c2w, whole.cameras.c2w)
    assert np.ptp(alone.frames.mean((1, 2, 3))) > 1e-4  # another picture from another place


def test_pictures_larger_than_the_model_are_those_of_the_sampler():
    config, params, given = finer(np.random.default_rng(2).random((3, 64, 96, 3), np.float32))
    path = make_path("orbit", given.cameras, 3, degrees=10)
    whole = sampling.sample(params, config, given, path, INDEPENDENT)
    alone = sampling.preview(parts(params), config, given, path)
    assert alone.frames.shape == (3, 64, 96, 3)
    np.testing.assert_allclose(alone.frames, whole.preview, atol=1e-4)


def test_a_scale_of_the_user_is_that_of_the_sampler(weights, photos):  # noqa: F811
    path = make_path("orbit", photos.cameras, 2)
    assert (
        sampling.preview(parts(weights), CONFIG, photos, path, scale=3.0).normalisation.divisor
        == 3.0
    )


@pytest.mark.parametrize("recon", [(32, 48), (16, 24)], ids=["model's size", "half of it"])
def test_from_where_a_photo_was_taken_one_sees_the_photo(recon):
    """Whatever the size at which the reconstruction looks: depth does not matter there, only where pixels lie."""
    y, x = np.mgrid[:64, :96] / 16.0
    photo = np.stack([0.5 + 0.4 * np.sin(x), 0.5 + 0.4 * np.cos(y), 0.5 + 0.3 * np.sin(x + y)], -1)
    sizes = {"recon_height": recon[0], "recon_width": recon[1]}
    config, params, given = finer(photo[None].astype(np.float32), **sizes)
    made = sampling.preview(parts(params), config, given, given.cameras).frames[0]
    assert np.abs(made - photo)[4:-4, 4:-4].max() < 0.03


@pytest.fixture(scope="module")
def place(weights, tmp_path_factory):  # noqa: F811
    folder = tmp_path_factory.mktemp("reconstruction")
    checkpoint.save_model(folder / "model", weights, CONFIG, dtype=np.float32)
    nerfstudio(folder / "scene", truth(4))
    return folder


def program(place, *words):
    given = ["--checkpoint", place / "model", "--scene", place / "scene", "--preview-only", *words]
    return entry.execute(sample.main, sample.parser(), [str(word) for word in given])


def test_the_program_loads_and_runs_no_generator(place, monkeypatch):
    seen = []
    preview = reconstruction.preview

    def watched(params, *given, **more):
        seen.append(set(params))
        return preview(params, *given, **more)

    monkeypatch.setattr(reconstruction, "preview", watched)
    out = place / "out"
    assert program(place, "--trajectory", "orbit", "--frames", 7, "--out", out) == 0
    assert seen == [{"encoder", "renderer"}]
    assert sorted(p.name for p in out.iterdir()) == PREVIEW_ALONE
    assert len(video_io.read_video(out / "video.mp4")) == 7
    run = json.loads((out / "run.json").read_text())
    assert run["generated"] is False and run["evaluations"] == 0
    assert run["settings"] == {"scale": None}
    assert run["windows"][0]["rgb_head"] == [[0, 6]]
    # The sheet shows the photos as large as the frames.
    photo = read_image(out / "images" / "photo00.png")
    sheet = read_image(out / "contact_sheet.png")
    times = -(-96 // len(photo))
    photo = photo.repeat(times, 0).repeat(times, 1)
    np.testing.assert_array_equal(sheet[24:][: photo.shape[0], 4:][:, : photo.shape[1]], photo)


@pytest.mark.parametrize(
    "words", [("--steps", 3), ("--seed", 1), ("--tolerance", 0.1), ("--long", "independent")]
)
def test_options_of_the_generator_are_refused(place, capsys, words):
    assert program(place, *words, "--out", place / "never") == 2
    said = capsys.readouterr().err
    assert f"{words[0]} {words[1]}" in said and "--preview-only" in said
    assert not (place / "never").exists()


# ---- models whose preview is better than what they generate ---------------------------------------


@pytest.fixture(scope="module")
def cautious(place, weights):  # noqa: F811
    """`place` with a model of the same weights that generates only if asked."""
    own = dataclasses.replace(CONFIG, flow=dataclasses.replace(CONFIG.flow, generate=False))
    checkpoint.save_model(place / "cautious", weights, own, dtype=np.float32)
    return own


@pytest.mark.parametrize(
    ("words", "generated"),
    [
        ((), False),
        (("--scale", 2.0), False),
        (("--generate",), True),
        (("--steps", 2), True),
        (("--seed", 1), True),
        (("--preview-only",), False),
    ],
)
def test_generates_only_if_asked(place, cautious, capsys, words, generated):
    """`--generate` or any option of the generator asks; the dry run counts the same."""
    given = ["--checkpoint", place / "cautious", "--scene", place / "scene", *words, "--dry-run"]
    assert entry.execute(sample.main, sample.parser(), [str(word) for word in given]) == 0
    assert ("velocity" in capsys.readouterr().out) is generated


def test_the_video_of_a_cautious_model_is_its_preview(place, cautious, weights, capsys):  # noqa: F811
    given = ["--checkpoint", place / "cautious", "--scene", place / "scene", "--frames", 5]
    given += ["--out", place / "own"]
    assert entry.execute(sample.main, sample.parser(), [str(word) for word in given]) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[0].endswith("better than what it generates (--generate)")
    assert json.loads((place / "own" / "run.json").read_text())["generated"] is False

    two = sampling.read_photos(load_scene(place / "scene"), [0, 1], cautious)
    path = make_path("orbit", two.cameras, 5)
    shown = sampling.preview(weights, cautious, two, path)
    made = sampling.sample(weights, cautious, two, path, sampling.Settings(seed=3))
    assert made.evaluations == 0
    np.testing.assert_array_equal(made.frames, shown.frames)
    for settings in (sampling.Settings(steps=1), sampling.Settings(generate=True)):
        made = sampling.sample(weights, cautious, two, path, settings)
        assert made.evaluations == settings.of(cautious).steps
        assert np.abs(made.frames - shown.frames).max() > 1e-3
    none = sampling.Settings(steps=1, generate=False)
    assert sampling.sample(weights, cautious, two, path, none).evaluations == 0


def test_a_dry_run_counts_what_runs(place, capsys):
    assert program(place, "--frames", 11, "--dry-run") == 0
    said = capsys.readouterr().out
    size = (CONFIG.recon_height, CONFIG.recon_width)
    total = cost.encoder(CONFIG.encoder, *size, 4, CONFIG.renderer.width)
    total += cost.shown(CONFIG, 4, 11)
    assert f"all frames{cost.scaled(total, 'FLOP'):>30s}" in said
    held = cost.weight_bytes(CONFIG)
    count = (held["encoder"] + held["renderer"]) / 4e6
    assert f"{count:.1f} M parameters" in said
    assert "velocity" not in said and "VAE" not in said


def test_a_list_of_paths_names_every_preset_and_option(capsys):
    assert entry.execute(sample.main, sample.parser(), ["--trajectory", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name in PRESETS:
        line = next(line for line in lines if line.startswith(f"{name}:"))
        assert all(f"{option}=" in line for option in preset_options(name))
        what = lines[lines.index(line) + 1].strip()
        assert len(what) > 10 and what.endswith(".")
