"""Photos to video through the program itself, on the tiny model with random weights and a scene written here."""

import dataclasses
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene_files import nerfstudio, truth

from roge_jax import checkpoint, model, sample, sampling
from roge_jax.config import preset
from roge_jax.data.views import make_sample
from roge_jax.errors import UserError
from roge_jax.files import entry, video_io
from roge_jax.geometry.cameras import RULES, Cameras, concatenate, normalise
from roge_jax.geometry.trajectories import make_path
from roge_jax.sampling import inputs, programs, video, windows
from roge_jax.sampling import photos as photos_
from roge_jax.scenes.scene import cameras_at, load_scene, open_scene
from roge_jax.video import flow

CONFIG = preset("tiny")
WINDOW = CONFIG.frames  # 5


@pytest.fixture(scope="module")
def weights():
    params = model.init(jax.random.key(0), CONFIG)
    rng = np.random.default_rng(0)

    def fill(leaf):  # the published initialisation is zero here: nothing would depend on anything
        return np.asarray(0.1 * rng.standard_normal(leaf.shape), np.float32)

    params["dit"]["head"]["linear"]["kernel"] = fill(params["dit"]["head"]["linear"]["kernel"])
    params["renderer"]["rgb_head"]["linear"]["kernel"] = fill(
        params["renderer"]["rgb_head"]["linear"]["kernel"]
    )
    for name in ("rays_embed", "geometry_embed"):
        params["fusion"][name]["kernel"] = fill(params["fusion"][name]["kernel"])
    return params


@pytest.fixture(scope="module")
def place(weights, tmp_path_factory):
    """A folder with a model and a scene of four photos."""
    folder = tmp_path_factory.mktemp("sample")
    checkpoint.save_model(folder / "model", weights, CONFIG, dtype=np.float32)
    nerfstudio(folder / "scene", truth(4))
    return folder


def program(place, *arguments, out="out"):
    """The exit code of `python -m roge_jax.sample` with the tiny model and scene unless told otherwise."""
    given = {
        "--checkpoint": place / "model",
        "--scene": place / "scene",
        "--out": place / out,
        "--steps": 2,
    }
    words = [str(word) for word in arguments]
    defaults = [str(x) for name, value in given.items() if name not in words for x in (name, value)]
    return entry.execute(sample.main, sample.parser(), defaults + words)


# ---- the whole program ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def chain(place):
    """Three windows: 12 frames of an orbit, chained."""
    assert program(place, "--frames", 12, "--trajectory", "orbit:degrees=30", out="chain") == 0
    return place / "chain"


def test_all_files_are_there_and_no_other(chain):
    names = sorted(p.name for p in chain.iterdir())
    assert names == [
        "contact_sheet.png",
        "frames",
        "images",
        "preview.mp4",
        "run.json",
        "sparse",
        "transforms.json",
        "video.mp4",
    ]
    assert not list(chain.parent.glob("*.part"))


def test_videos_and_frames_agree(chain):
    from PIL import Image

    frames = np.stack(
        [np.asarray(Image.open(chain / "frames" / f"{i:04d}.png")) for i in range(12)]
    )
    assert len(list((chain / "frames").iterdir())) == 12
    assert frames.shape == (12, CONFIG.height, CONFIG.width, 3)
    for name in ("video.mp4", "preview.mp4"):
        assert video_io.read_video(chain / name).shape == frames.shape
    video = video_io.read_video(chain / "video.mp4")
    # Noise-like pictures lose their colour resolution, but stay nearer to their own frame than to any other.
    gaps = np.abs(video[:, None].astype(int) - frames[None]).mean((2, 3, 4))
    own = np.diag(gaps)
    different = np.abs(frames[:, None].astype(int) - frames[None]).mean((2, 3, 4)) > 10
    assert (gaps > own[:, None])[different].all() and different.any()


def test_transforms_are_the_path_in_the_scenes_own_frame(chain, place):
    made = load_scene(chain)
    assert len(made) == 12 + 4 and set(made.sizes) == {(CONFIG.height, CONFIG.width)}
    scene = load_scene(place / "scene")
    photos = sampling.read_photos(scene, [0, 1, 2, 3], CONFIG)
    path = make_path("orbit", photos.cameras, 12, degrees=30)
    np.testing.assert_allclose(made.cameras.c2w[:12], path.c2w, atol=1e-12)
    np.testing.assert_allclose(made.cameras.K[:12], path.K, atol=1e-10)
    np.testing.assert_allclose(made.cameras.c2w[12:], photos.cameras.c2w, atol=1e-12)


def test_record_says_what_was_made(chain, place):
    run = json.loads((chain / "run.json").read_text())
    assert run["frames"] == 12 and run["size"] == [CONFIG.height, CONFIG.width]
    assert (
        run["scene"]["context"] == [0, 1, 2, 3] and run["scene"]["context_names"][0] == "0000.png"
    )
    assert run["evaluations"] == 3 * 2
    assert run["config"]["name"] == "tiny" and run["settings"]["seed"] == 0
    assert run["versions"]["jax"] == jax.__version__ and run["device"]["backend"] == "cpu"
    scene = load_scene(place / "scene")
    _, _, info = normalise(scene.cameras, scene.cameras)
    assert run["scale"]["divisor"] == pytest.approx(info.divisor)
    assert set(run["stages"]) == {
        "load",
        "match",
        "compile",
        "prepare",
        "sample",
        "decode",
        "write",
        "total",
    }
    assert (
        sum(s["seconds"] for n, s in run["stages"].items() if n != "total")
        <= run["stages"]["total"]["seconds"]
    )
    assert [w["frames"] for w in run["windows"]] == [[0, 4], [5, 9], [10, 11]]
    assert run["windows"][0]["generated"] == [] and run["windows"][1]["generated"][0] == 4
    assert run["windows"][2]["generated"][0] == 9


def test_same_seed_same_bytes(place):
    def frames(out, seed):
        assert program(place, "--frames", 3, "--seed", seed, out=out) == 0
        return [p.read_bytes() for p in sorted((place / out / "frames").iterdir())]

    first = frames("a", 5)
    assert len(first) == 3
    assert frames("b", 5) == first
    other = frames("a", 6)  # the earlier run in the same folder is replaced
    assert all(x != y for x, y in zip(first, other, strict=True))


# ---- windows -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def photos(place):
    return sampling.read_photos(load_scene(place / "scene"), [0, 1, 2, 3], CONFIG)


SETTINGS = sampling.Settings(steps=2, solver="euler")


def test_a_padded_path_gives_the_frames_of_the_longer_one(weights, photos):
    path = make_path("move-right", photos.cameras, WINDOW)
    cache = {}
    whole = sampling.sample(weights, CONFIG, photos, path, SETTINGS, cache=cache)
    short = sampling.sample(weights, CONFIG, photos, path[:3], SETTINGS, cache=cache)
    assert short.frames.shape == (3, CONFIG.height, CONFIG.width, 3) and len(cache) == 1
    # A straight path goes on as padding does, so that both windows differ by the rounding of poses alone.
    np.testing.assert_allclose(short.frames, whole.frames[:3], atol=1e-3)
    np.testing.assert_allclose(short.preview, whole.preview[:3], atol=1e-3)
    np.testing.assert_array_equal(short.cameras.c2w, path.c2w[:3])


def test_independent_windows_see_the_photos_alone_and_compile_once(weights, photos):
    path = make_path("orbit", photos.cameras, 2 * WINDOW)
    cache = {}
    settings = sampling.Settings(steps=2, solver="euler", long="independent")
    result = sampling.sample(weights, CONFIG, photos, path, settings, cache=cache)
    assert list(cache) == [4]
    assert all(w["generated"] == [] and w["photos"] == [0, 1, 2, 3] for w in result.windows)
    # The preview has no noise: it must be that of the second half alone, in the world of the whole path.
    half = sampling.sample(weights, CONFIG, photos, path[WINDOW:], settings, cache=cache)
    np.testing.assert_allclose(result.preview[WINDOW:], half.preview, atol=1e-5)
    assert (
        np.abs(result.frames[WINDOW:] - half.frames).mean() > 0.01
    )  # windows draw noise of their own


def test_chained_windows_share_one_compilation_and_remember(weights, photos):
    path = make_path("orbit", photos.cameras, 3 * WINDOW)
    cache = {}
    result = sampling.sample(weights, CONFIG, photos, path, SETTINGS, cache=cache)
    assert list(cache) == [4, 4 + windows.CHAIN_FRAMES]
    alone = sampling.Settings(steps=2, solver="euler", long="independent")
    other = sampling.sample(weights, CONFIG, photos, path, alone, cache=cache)
    np.testing.assert_array_equal(result.frames[:WINDOW], other.frames[:WINDOW])
    assert np.abs(result.preview[WINDOW:] - other.preview[WINDOW:]).max() > 1e-4


def numbered(seen):
    """In place of `programs.for_window`: what windows see is added to `seen`, and frame i gets the level i / 100.
    Nothing is compiled."""

    def for_window(params, views, config, slots):
        size = (config.frames, config.height, config.width, 3)
        recon = (config.frames, config.recon_height, config.recon_width, 3)

        def prepare(params, views):
            seen.append({name: np.asarray(x) for name, x in views.items()})
            return SimpleNamespace(shown=np.zeros(recon, np.float32), detail=None, full=None)

        def decode(params, x0, detail):
            levels = (config.frames * (len(seen) - 1) + np.arange(config.frames)) / 100
            return np.broadcast_to(levels[:, None, None, None], size).astype(np.float32)

        return programs.Programs(prepare, lambda p, ready, noise, x, sigma: 0 * x, decode)

    return for_window


@pytest.mark.parametrize(("most", "made_before"), [(4, 1), (6, 2)], ids=["photos go", "all stay"])
def test_pictures_of_chained_windows_keep_their_cameras(place, monkeypatch, most, made_before):
    """Photos and frames already made come with their own pose, lens and picture at both sizes, in one frame and unit."""
    config = dataclasses.replace(CONFIG, max_context=most, recon_height=64, recon_width=96)
    photos = sampling.read_photos(load_scene(place / "scene"), [2, 0, 3, 1], config)
    path = make_path("orbit", photos.cameras, 3 * WINDOW, degrees=25)
    seen = []
    monkeypatch.setattr(programs, "for_window", numbered(seen))
    result = sampling.sample({}, config, photos, path, SETTINGS)
    assert [len(window["generated"]) for window in result.windows] == [0, made_before, made_before]
    assert [len(window["photos"]) for window in result.windows][1:] == [most - made_before] * 2
    for views, window in zip(seen, result.windows, strict=True):
        kept, made = [photos.ids.index(i) for i in window["photos"]], window["generated"]
        first, last = window["frames"]
        assert all(i < first for i in made)
        for name, pictures in (("context_rgb", photos.images), ("context_recon", photos.recon)):
            np.testing.assert_array_equal(views[name][: len(kept)], pictures[kept])
            levels = views[name][len(kept) :].mean((1, 2, 3))
            np.testing.assert_allclose(levels, np.array(made) / 100, atol=1e-6)
        parts = photos.cameras[kept], path[made], path[first : last + 1]
        every = result.normalisation.apply(concatenate(*parts))
        np.testing.assert_allclose(views["c2w"], every.c2w, atol=1e-5)
        np.testing.assert_allclose(views["K"], every.K, rtol=1e-5)
        contexts = len(kept) + len(made)
        np.testing.assert_allclose(views["vectors"][:, :3], every.centres[:contexts], atol=1e-5)


@pytest.mark.parametrize("long", ["chain", "independent"])
def test_a_scale_of_the_user_divides_all_positions(photos, monkeypatch, long):
    seen, plain = [], []
    path = make_path("orbit", photos.cameras, 2 * WINDOW)
    settings = sampling.Settings(steps=1, solver="euler", long=long)
    for found, scale in ((plain, None), (seen, 7.0)):
        monkeypatch.setattr(programs, "for_window", numbered(found))
        settings = dataclasses.replace(settings, scale=scale)
        result = sampling.sample({}, CONFIG, photos, path, settings)
    assert result.normalisation.divisor == 7.0
    reach = result.normalisation.context_reach
    for views, others in zip(seen, plain, strict=True):
        ratio = RULES[CONFIG.scale_rule] * reach / 7.0
        np.testing.assert_allclose(
            views["c2w"][:, :3, 3], ratio * others["c2w"][:, :3, 3], atol=1e-5
        )
        np.testing.assert_allclose(views["vectors"][:, 9], reach / 7.0, rtol=1e-5)


def test_program_agrees_with_the_model_file(weights, photos):
    """One window of the sampler is `model.prepare`, `generate` and `decode_video` on the same noise."""
    path = make_path("orbit", photos.cameras, WINDOW)
    ours = sampling.sample(weights, CONFIG, photos, path, SETTINGS)
    context, target, info = normalise(photos.cameras, path)
    views = windows.window_views(photos.images, None, context, target, info, CONFIG)
    noise = windows.window_noise(0, 0, 4, CONFIG)
    grid = flow.schedule(SETTINGS.of(CONFIG).schedule, 2)

    @jax.jit
    def plain(params, views, noise):
        prepared = model.prepare(params, views, config=CONFIG)
        latents, _ = model.generate(
            params, prepared, noise, config=CONFIG, solver="euler", sigmas=grid
        )
        return model.decode_video(params, latents, config=CONFIG)

    np.testing.assert_allclose(ours.frames, plain(weights, views, noise), atol=2e-4)


@pytest.mark.parametrize("rule", ["lagernvs", "paper"])
@pytest.mark.parametrize("m", [1, 4])
def test_a_window_is_what_training_shows_the_networks(weights, photos, rule, m, monkeypatch):
    """The same photos and path as a sample of a batch and as the first window of a video: the same arrays."""
    config = dataclasses.replace(CONFIG, scale_rule=rule)
    photos = sampling.Photos(photos.images[:m], None, photos.cameras[:m], photos.ids[:m])
    path = make_path("orbit", photos.cameras, WINDOW)
    seen = []

    def stop(params, views, *rest):
        seen.append(views)
        raise UserError("seen.")

    monkeypatch.setattr(programs, "for_window", stop)
    with pytest.raises(UserError, match="seen"):
        sampling.sample(weights, config, photos, path, SETTINGS)
    rgb = np.concatenate([photos.images, np.zeros((WINDOW, *photos.images.shape[1:]), np.float32)])
    K, c2w = (
        np.concatenate([getattr(cameras, name) for cameras in (photos.cameras, path)])
        for name in ("K", "c2w")
    )
    trained = make_sample(rgb, K, c2w, m, scale_rule=rule)
    assert seen[0].keys() == trained.keys() - {"target_rgb"}
    for name, x in seen[0].items():
        np.testing.assert_allclose(x, trained[name], rtol=1e-6, atol=1e-6, err_msg=name)


def test_what_settings_leave_open_is_the_models_own(weights, photos):
    own = dataclasses.replace(CONFIG.flow, solver="midpoint", steps=3, schedule="graded")
    theirs = dataclasses.replace(CONFIG, flow=own)
    assert sampling.Settings(seed=4).of(theirs) == sampling.Settings(
        3, "midpoint", "graded", 4, generate=True
    )
    assert sampling.Settings(2, "euler", "shift").of(theirs) == sampling.Settings(
        2, "euler", "shift", generate=True
    )
    path = make_path("orbit", photos.cameras, 1)
    for settings, evaluations in ((sampling.Settings(), 6), (sampling.Settings(steps=1), 2)):
        assert sampling.sample(weights, theirs, photos, path, settings).evaluations == evaluations


def test_adaptive_solver(weights, photos):
    """bosh3 has no steps to loop over; it goes where many small steps go."""
    path = make_path("orbit", photos.cameras, WINDOW)
    cache = {}
    ours, fine = (
        sampling.sample(weights, CONFIG, photos, path, settings, cache=cache)
        for settings in (sampling.Settings(64, "bosh3"), sampling.Settings(64, "rk4"))
    )
    coarse = sampling.sample(
        weights, CONFIG, photos, path, sampling.Settings(2, "euler"), cache=cache
    )
    assert 4 < ours.evaluations < 64  # of the grid it takes the first and the last step only
    gap = np.abs(ours.frames - fine.frames).mean()
    assert gap < 0.1 * np.abs(coarse.frames - fine.frames).mean()


class TestChaining:
    def cameras(self, x):
        c2w = np.tile(np.eye(4), (len(x), 1, 1))
        c2w[:, 0, 3] = x
        return Cameras(np.tile(np.diag([50.0, 50.0, 1.0]), (len(x), 1, 1)), c2w)

    def config(self, most):
        import dataclasses

        return dataclasses.replace(CONFIG, max_context=most)

    @pytest.mark.parametrize(
        ("m", "most"), [(m, most) for most in (2, 3, 6) for m in range(1, most + 1)]
    )
    def test_never_more_than_the_model_takes(self, m, most):
        photos, made = windows.chained(m, self.config(most))
        assert 1 <= photos <= m and 1 <= made <= windows.CHAIN_FRAMES and photos + made <= most

    def test_one_context_leaves_no_room(self):
        assert windows.chained(1, self.config(1)) == (1, 0)

    def test_last_frame_and_world_frame_always_stay(self):
        photos, made = self.cameras([100.0, 3.0, 9.0, 1.0]), self.cameras([0.0, 1.0, 2.0, 2.5])
        kept, chosen = windows.chain_views(photos, made, self.cameras([3.0, 4.0]), self.config(4))
        # Three photos fit beside one frame: the first although it is far away, and the two nearest ones.
        assert kept == [0, 1, 3] and chosen == [3]

    def test_a_path_that_returns_sees_what_it_saw_there(self):
        made = self.cameras(np.linspace(0, 10, 11))
        kept, chosen = windows.chain_views(
            self.cameras([50.0]), made, self.cameras([0.1, 0.2, 1.9]), self.config(6)
        )
        assert kept == [0]
        assert chosen[0] == 10 and chosen[1] in (0, 1)

    def test_the_second_frame_shows_what_the_first_one_does_not(self):
        """Most views ahead are by the last frame, which has them already: the other one is for the rest."""
        made = self.cameras(np.linspace(0, 10, 11))
        ahead = self.cameras([10.0, 10.0, 10.0, 0.0])
        _, chosen = windows.chain_views(self.cameras([50.0]), made, ahead, self.config(6))
        assert chosen == [10, 0]

    def test_windows_cover_the_path_once(self):
        for frames in (1, 5, 6, 12, 15):
            runs = windows.windows(frames, 5)
            assert [i for a, b in runs for i in range(a, b)] == list(range(frames))

    def test_turning_counts_as_distance(self):
        a, b = self.cameras([0.0]), self.cameras([0.0])
        angle = 0.3
        b.c2w[0, :3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        assert windows.view_distance(a, b)[0, 0] == pytest.approx(angle)


def test_noise_depends_on_seed_and_window_alone():
    draw = [
        windows.window_noise(seed, window, 2, CONFIG)
        for seed, window in ((0, 0), (0, 1), (1, 0), (0, 0))
    ]
    assert draw[0].dtype == np.float32 and draw[0].shape == (4, 4, 6, 16)
    np.testing.assert_array_equal(draw[0], draw[3])
    assert abs(np.corrcoef(draw[0].ravel(), draw[1].ravel())[0, 1]) < 0.1
    assert abs(np.corrcoef(draw[0].ravel(), draw[2].ravel())[0, 1]) < 0.1


def test_photos_at_reconstruction_size_are_sharper_than_a_resize(place):
    import dataclasses

    scene = load_scene(place / "scene")
    double = dataclasses.replace(CONFIG, recon_height=64, recon_width=96)
    photos = sampling.read_photos(scene, [0, 1], double)
    assert photos.recon.shape == (2, 64, 96, 3)
    # The picture is a ramp: both sizes show the same window of it.
    np.testing.assert_allclose(
        photos.recon.reshape(2, 32, 2, 48, 2, 3).mean((2, 4)), photos.images, atol=0.02
    )
    assert sampling.read_photos(scene, [0], CONFIG).recon is None


@pytest.mark.parametrize("trajectory", ["orbit", "pan"])  # pan: not even the path gives a scale
def test_one_photo_is_enough(trajectory, place):
    photos = sampling.read_photos(load_scene(place / "scene"), [2], CONFIG)
    path = make_path(trajectory, photos.cameras, WINDOW)
    context, target, info = normalise(photos.cameras, path)
    assert info.status == "single_view" and "the photos fix no scale" in info.notes[0]
    views = windows.window_views(photos.images, None, context, target, info, CONFIG)
    assert views["context_rgb"].shape[0] == 1 and views["K"].shape == (1 + WINDOW, 3, 3)
    assert all(np.isfinite(x).all() and x.dtype == np.float32 for x in views.values())
    assert np.abs(views["c2w"]).max() < 2  # positions of order one whatever the scene's unit


def test_identical_photos_count_once(place):
    scene = load_scene(place / "scene")
    with pytest.warns(UserWarning, match="same pose and picture"):
        photos = sampling.read_photos(scene, [1, 0, 1], CONFIG)
    assert photos.ids == (1, 0) and len(photos.images) == len(photos.cameras) == 2


# ---- options -------------------------------------------------------------------------------------


def arguments(*words):
    return entry.parse(sample.parser(), [str(word) for word in words])


def test_defaults_are_the_contract():
    args = arguments()
    assert (args.checkpoint, args.scene, args.trajectory) == ("mini", "motorcycle", None)
    assert (args.long, args.context_slots, args.fps, args.seed) == ("chain", "noised", None, 0)


@pytest.mark.parametrize(
    ("text", "ids"),
    [
        (None, [0, 1, 2, 3]),
        ("4", [0, 1, 2, 3]),
        ("3,1", [3, 1]),
        ("2,", [2]),
        ("0003.png,0", [3, 0]),
    ],
)
def test_context_words(text, ids, place):
    config = dataclasses.replace(CONFIG, max_context=9)
    assert sampling.context_ids(text, load_scene(place / "scene"), config) == ids


def test_the_path_goes_through_the_photos_and_around_a_single_one(photos):
    args = arguments("--frames", 5)
    path = inputs.camera_path(args, photos.cameras, CONFIG)
    assert args.trajectory == inputs.THROUGH  # for run.json
    ends = [np.abs(path.c2w - pose).max((1, 2)).argmin() for pose in photos.cameras.c2w]
    assert {0, 4} <= set(ends) and np.abs(path.c2w[0] - photos.cameras.c2w).max((1, 2)).min() < 1e-9
    args = arguments("--frames", 5)
    path = inputs.camera_path(args, photos.cameras[:1], CONFIG)
    assert args.trajectory == inputs.ALONE
    np.testing.assert_allclose(path.c2w[0], photos.cameras.c2w[0], atol=1e-9)
    assert np.ptp(path.c2w[:, :3, 3], 0).max() > 0


def test_field_of_view_and_size(place, photos):
    args = arguments("--fov", 90, "--frames", 4)
    path = inputs.camera_path(args, photos.cameras, CONFIG)
    np.testing.assert_allclose(path.K[3], [[16, 0, 24], [0, 16, 16], [0, 0, 1]], atol=1e-12)
    config = inputs.model_config(
        arguments("--checkpoint", place / "model", "--size", "48x64"), weights=True
    )
    assert (config.height, config.width, config.recon_height, config.recon_width) == (
        48,
        64,
        48,
        64,
    )


def test_the_reconstruction_keeps_its_share_of_another_size():
    config = inputs.model_config(
        arguments("--checkpoint", "paper", "--size", "96x160"), weights=False
    )
    assert (config.recon_height, config.recon_width) == (144, 240)  # 1.5 times, as the paper's


def test_path_files_are_followed(tmp_path, photos):
    from roge_jax.scenes.paths import save_path

    path = make_path("spiral", photos.cameras, 7)
    save_path(tmp_path / "path.json", path, CONFIG.height, CONFIG.width)
    found = inputs.camera_path(
        arguments("--trajectory", tmp_path / "path.json"), photos.cameras, CONFIG
    )
    np.testing.assert_allclose(found.c2w, path.c2w, atol=1e-12)


def test_photos_are_chosen_for_a_path_that_is_known(tmp_path, place):
    """Of four photos two: those that stand where the path file goes, and not the same for another path."""
    from roge_jax.scenes.paths import save_path

    scene = load_scene(place / "scene")
    settings = SETTINGS.of(CONFIG)
    near = cameras_at(scene, CONFIG.height, CONFIG.width)
    without = inputs.read_inputs(
        arguments("--scene", place / "scene", "--context", 2), CONFIG, settings
    )[1]
    for views in ([0, 1], [2, 3]):
        save_path(tmp_path / "path.json", near[views], CONFIG.height, CONFIG.width)
        words = ["--scene", place / "scene", "--trajectory", tmp_path / "path.json"]
        _, photos, path = inputs.read_inputs(
            arguments(*words, "--context", 2), CONFIG, settings, scene
        )
        assert sorted(photos.ids) == views != sorted(without.ids)
        assert len(path) == 2
        _, photos, _ = inputs.read_inputs(arguments(*words, "--context", "3,0"), CONFIG, settings)
        assert photos.ids == (3, 0)


def test_a_path_without_a_lens_is_judged_by_that_of_the_video(tmp_path, place, monkeypatch):
    """Photos are chosen for what the video will show: in its pixels, not in those of the photos."""
    poses = [{"pose": pose.tolist()} for pose in load_scene(place / "scene").cameras.c2w[:2]]
    (tmp_path / "path.json").write_text(json.dumps({"convention": "opencv", "frames": poses}))
    asked = []
    monkeypatch.setattr(photos_, "context_ids", lambda *a: asked.append(a[-1]) or [0, 1])
    words = ["--scene", place / "scene", "--trajectory", tmp_path / "path.json"]
    path = inputs.read_inputs(arguments(*words), CONFIG, SETTINGS.of(CONFIG))[2]
    np.testing.assert_allclose(asked[0].K, path.K)
    np.testing.assert_allclose(asked[0].c2w, path.c2w)


def test_convention_reaches_the_reader(place, monkeypatch):
    seen = []

    def stop(params, config, photos, *rest, **options):
        seen.append(photos.cameras.c2w)
        raise UserError("seen.")

    monkeypatch.setattr(video, "sample", stop)
    assert program(place, "--context", "0,1", "--convention", "opencv") == 2
    expected, usual = (
        open_scene(place / "scene", convention=name).cameras.c2w[:2] for name in ("opencv", None)
    )
    np.testing.assert_array_equal(seen[0], expected)
    assert not np.allclose(expected, usual)


# ---- dry run -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tiny", "32x48"),
        ("mini", "64x112"),
        ("wan1.3b", "5,796 transformer tokens"),
        ("paper", "1,554 scene tokens"),
    ],
)
def test_dry_run_of_presets_needs_no_weights(name, said, tmp_path, capsys):
    assert (
        entry.execute(
            sample.main,
            sample.parser(),
            [
                *("--checkpoint", name, "--context", "2", "--generate"),
                *("--dry-run", "--out", str(tmp_path / "o")),
            ],
        )
        == 0
    )
    shown = capsys.readouterr().out
    steps = (
        checkpoint.load_config(checkpoint.find_model(name)).flow.steps
        if name == "mini"
        else preset(name).flow.steps
    )
    assert said in shown and f"velocity, each of {steps}" in shown and "peak memory" in shown
    assert not any(tmp_path.iterdir())


def test_dry_run_counts_windows(place, capsys):
    assert program(place, "--dry-run", "--frames", 12, "--context", 3, out="dry") == 0
    shown = capsys.readouterr().out
    assert "chunks of 5: 3" in shown and "3, then 5 with frames already made" in shown
    assert not (place / "dry").exists()


# ---- bad input -----------------------------------------------------------------------------------


def broken_scene(place, name, change):
    return nerfstudio(place / name, truth(2), change={1: change})


BAD = {
    "unknown trajectory": (["--trajectory", "orbti"], "did you mean 'orbit'?"),
    "unknown trajectory option": (["--trajectory", "orbit:degres=3"], "did you mean 'degrees'?"),
    "malformed trajectory option": (["--trajectory", "orbit:30"], "'30' is no option"),
    "missing path file": (["--trajectory", "gone.json"], "gone.json: cannot read the path file"),
    "unknown checkpoint": (["--checkpoint", "mnii"], "Unknown checkpoint 'mnii'"),
    "preset without weights": (
        ["--checkpoint", "wan1.3b"],
        "No trained weights of preset 'wan1.3b'",
    ),
    "unknown scene": (["--scene", "motorcicle"], "did you mean 'motorcycle'?"),
    "missing scene": (["--scene", "no/such/folder"], "no/such/folder"),
    "too many photos": (["--context", "5"], "--context 5: give 1 to 4"),
    "no photos": (["--context", "0"], "--context 0: give 1 to 4"),
    "unknown photo": (["--context", "0,7"], "there is no photo 7"),
    "unknown photo name": (["--context", "0,0001.pgn"], "did you mean '0001.png'?"),
    "no frames": (["--frames", "0"], "'0' is not a whole number of at least 1"),
    "no steps": (["--steps", "0"], "'0' is not a whole number of at least 1"),
    "unknown solver": (["--solver", "eulr"], "did you mean 'euler'?"),
    "unknown schedule": (["--schedule", "shfit"], "did you mean 'shift'?"),
    "unknown way to chain": (["--long", "chained"], "did you mean 'chain'?"),
    "unknown option": (["--trajectry", "orbit"], "did you mean '--trajectory'?"),
    "size that does not fit": (["--size", "30x48"], "must be multiples of 16"),
    "size beyond any memory": (["--size", "4096x4112"], "at most 16777216 pixels"),
    "size that is none": (["--size", "large"], "'large' is not HEIGHTxWIDTH"),
    "impossible field of view": (["--fov", "180"], "between 0 and 180"),
    "start that is no photo": (["--start", "4"], "start=4 is no context view"),
    "size of nothing": (["--size", "0x0"], "must be multiples of 16"),
    "size below nothing": (["--size=-16x-16"], "must be multiples of 16"),
    "superscript for a photo": (["--context", "²,"], "no photo '²'"),
    "superscript for a number": (["--context", "²"], "--context ²: give 1 to 4"),
    "commas alone": (["--context", ",,"], "--context ,,: give 1 to 4"),
    "too many pictures a second": (["--fps", "1e9"], "and at most 1000"),
    "word for degrees": (["--trajectory", "orbit:degrees=wide"], "'degrees' is 'wide'"),
    "word for yes": (["--trajectory", "orbit:swing=maybe"], "give true or false"),
    "option given twice": (["--trajectory", "orbit:degrees=3,degrees=4"], "is given twice"),
    "start given twice": (["--trajectory", "orbit:start=1", "--start", "2"], "is given twice"),
    "frames as an option": (["--trajectory", "orbit:frames=3"], "'frames' is no option of a path"),
    "start of a path file": (["--trajectory", "gone.json", "--start", "2"], "is for presets"),
    "endless name of a path": (["--trajectory", "x" * 300], "There is no trajectory"),
    "endless name of a scene": (["--scene", "x" * 300], "There is no scene"),
    "endless name of a model": (["--checkpoint", "x" * 300], "Unknown checkpoint"),
    "no optimised schedule": (
        ["--schedule", "optimised", "--steps", "777"],
        "No optimised schedule",
    ),
    "too many frames": (["--frames", "10001"], "--frames 10001: give a path of at most 10000"),
    "unknown axis of a mesh": (["--mesh", "nonsense=3"], "unknown axis 'nonsense'"),
    "mesh over scenes": (["--mesh", "data=2"], "one video has no scenes to split"),
    "mesh that does not divide": (["--mesh", "fsdp=3"], "cannot be split over fsdp=3"),
    "mesh of other devices": (["--mesh", "fsdp=2", "--devices", "3"], "does not make 3 devices"),
    "budget below any plan": (["--max-cost", "1"], "max_cost 1 FLOPs is less than the cheapest"),
    "negative tolerance": (["--tolerance=-1"], "'-1' is not a number of at least 0"),
}


def expect_refusal(code, said, place, capsys, out="bad"):
    shown = capsys.readouterr().err
    assert code == 2, shown
    assert said in shown
    assert shown.startswith("error: ") and shown.count("\n") == 1 and "Traceback" not in shown
    assert not (place / out).exists() and not (place / f"{out}.part").exists()


@pytest.mark.parametrize("case", BAD)
def test_bad_options_are_refused_in_one_sentence(case, place, capsys):
    words, said = BAD[case]
    expect_refusal(program(place, *words, out="bad"), said, place, capsys)


@pytest.mark.parametrize("case", sorted(BAD.keys() - {"preset without weights"}))
def test_dry_runs_refuse_the_same(case, place, capsys):
    """With the same words as the run, all that needs no weights."""
    words, said = BAD[case]
    code = program(place, *words, out="bad")
    expected = capsys.readouterr().err
    assert (program(place, "--dry-run", *words, out="bad"), code) == (2, 2)
    assert capsys.readouterr().err == expected and said in expected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--scene", "procedural:abc"], "whole number"),
        (["--scene", "procedural:-3"], "seed -3"),
        (["--scene", "procedural:3", "--context", "0,40"], "there is no photo 40"),
        (["--scene", "motorcycle", "--context", "10"], "--context 10: give 1 to 2"),
    ],
)
def test_dry_runs_refuse_what_built_in_scenes_do_not_have(words, said, place, capsys):
    expect_refusal(program(place, "--dry-run", *words, out="bad"), said, place, capsys)


def test_dry_runs_check_photos_and_weights_alone_are_not_read(place, capsys, tmp_path):
    import shutil

    scene = nerfstudio(tmp_path / "scene", truth(2))
    file = scene / "images" / "0001.png"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    expect_refusal(program(place, "--dry-run", "--scene", scene), "0001.png", place, capsys)
    file.write_bytes(whole)
    shutil.copytree(place / "model", tmp_path / "model")
    next((tmp_path / "model").glob("*.safetensors")).write_bytes(b"torn")
    words = ["--checkpoint", tmp_path / "model", "--scene", scene]
    assert program(place, "--dry-run", *words) == 0


def test_a_dry_run_prints_the_plan_and_the_full_cost(place, capsys):
    def shown(*words):
        assert program(place, "--dry-run", "--frames", 12, *words, out="dry") == 0
        return capsys.readouterr().out

    full = shown()
    assert "plan for" not in full
    for words in (("--tolerance", 0.5), ("--max-cost", 1e15)):
        text = shown(*words)
        assert text.startswith(full.rstrip()) and "the full model's cost, the most" in text
        assert "for an average scene" in text and "0 kFLOP for planning" in text
    assert "(100 %)" not in shown("--tolerance", 0.5) and "(100 %)" in shown("--tolerance", 0)
    assert not (place / "dry").exists()


def test_a_dry_run_counts_all_devices_of_a_mesh(place, capsys):
    assert program(place, "--dry-run", "--mesh", "fsdp=2,seq=2") == 0
    assert "all 4 devices together" in capsys.readouterr().out


def test_a_dry_run_of_more_photos_than_the_built_in_scene_has_says_so(place, capsys):
    assert program(place, "--dry-run", "--scene", "motorcycle", "--context", 4) == 0
    shown = capsys.readouterr().out
    assert "photos    4" in shown and "none was read" in shown
    assert program(place, "--dry-run", "--scene", "motorcycle", "--context", 2) == 0
    assert "none was read" not in capsys.readouterr().out


def test_no_path_is_built_that_is_too_long(place, capsys, tmp_path, monkeypatch):
    """A count that would fill the memory is refused before anything of that length exists."""
    from roge_jax.geometry import trajectories

    monkeypatch.setattr(trajectories, "make_path", lambda *a, **k: pytest.fail("a path was built"))
    for words in ([], ["--dry-run"]):
        code = program(place, *words, "--frames", 100_000_000, out="bad")
        expect_refusal(code, "at most 10000 frames", place, capsys)
    monkeypatch.undo()
    pose = np.eye(4).tolist()
    keys = {"convention": "opencv", "keyframes": [{"pose": pose}, {"pose": pose}], "count": 10001}
    (tmp_path / "long.json").write_text(json.dumps(keys))
    code = program(place, "--trajectory", tmp_path / "long.json", out="bad")
    expect_refusal(code, "long.json: give a path of at most 10000", place, capsys)
    (tmp_path / "long.json").write_text(json.dumps(keys | {"count": 10**15}))
    code = program(place, "--trajectory", tmp_path / "long.json", out="bad")
    expect_refusal(code, "long.json: 1000000000000000 frames: give at most 1000000", place, capsys)


def test_a_dry_run_counts_the_frames_of_a_path_file(place, photos, capsys, tmp_path):
    from roge_jax.scenes.paths import save_path

    path = make_path("spiral", photos.cameras, 7)
    save_path(tmp_path / "p.json", path, CONFIG.height, CONFIG.width)
    assert program(place, "--dry-run", "--trajectory", tmp_path / "p.json", out="dry") == 0
    assert "7 frames of" in capsys.readouterr().out


def _in(name, value):
    def change(record):
        *parents, last = name.split(".")
        values = record["config"]
        for parent in parents:
            values = values[parent]
        values[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (b"", "not valid JSON"),
        (b"\xff\xfe", "no UTF-8 text"),
        (b"[" * 100000, "not valid JSON"),
        (b"[]", "is not a roge_jax model config"),
        (b'{"config": []}', r"is \[\]: give an object with the fields of RoGeConfig"),
        (lambda record: record.update(format=99), "'format' is 99, of a newer version"),
        (_in("dit", None), r"config.json.dit is None: give an object"),
        (_in("dit.width", "wide"), "'width' is 'wide': give a whole number"),
        (_in("dit.width", 64.5), "'width' is 64.5: give a whole number"),
        (_in("dit.width", 0), "'width' is 0: it must be above 0"),
        (_in("dit.heads", 7), "width 64 is not divisible by 7 heads"),
        (_in("height", None), "'height' is None: give a whole number"),
        (_in("height", 0), "must be multiples of 16"),
        (_in("frames", True), "'frames' is True: give a whole number"),
        (_in("renderer.attention", "x"), "give one of bidirectional, cross, full"),
        (_in("renderer.merge", 3), "give one of 1, 2, 4"),
        (_in("vae.multipliers", 3), "give a list, of each a whole number"),
        (_in("vae.latent_mean", [1.0]), "'latent_mean' has 1 values for 16 channels"),
        (_in("vae.latent_std", [0.0] * 16), "'latent_std' must be positive"),
        (_in("fusion.feature_std", [1.0] * 32), "need 32 values each"),
        (_in("fusion.feature_std", [1.0] * 5), "need 32 values each"),
        (_in("fusion.preview_std", [1.0] * 5), "needs 'preview' and 16 positive values"),
        (_in("flow.shift", -1.0), "'shift' is -1.0: it must be above 0"),
        (_in("max_context", 0), "'max_context' is 0"),
    ],
)
def test_damaged_configurations_are_named(change, said, place, tmp_path):
    content = (place / "model" / "config.json").read_bytes()
    if not isinstance(change, bytes):
        record = json.loads(content)
        change(record)
        content = json.dumps(record).encode()
    (tmp_path / "config.json").write_bytes(content if not isinstance(change, bytes) else change)
    with pytest.raises(UserError, match=said):
        checkpoint.load_config(tmp_path)


def test_shards_that_are_none_are_named(place, tmp_path):
    import shutil

    shutil.copytree(place / "model", tmp_path / "m")
    file = next((tmp_path / "m").glob("*.safetensors"))
    file.rename(tmp_path / "m" / "model-weights.safetensors")
    with pytest.raises(UserError, match=r"model-weights.safetensors is not named like"):
        checkpoint.load_model(tmp_path / "m")
    (tmp_path / "m" / "model-weights.safetensors").unlink()
    file.mkdir()
    with pytest.raises(UserError, match="cannot be read"):
        checkpoint.load_model(tmp_path / "m")
    file.rmdir()
    file.write_bytes((100000).to_bytes(8, "little") + b"[" * 100000)
    with pytest.raises(UserError, match="no readable safetensors header"):
        checkpoint.load_model(tmp_path / "m")


def test_wrong_arguments_from_python_are_named(weights, photos):
    path = make_path("orbit", photos.cameras, WINDOW)
    for settings, said in (({"seed": -1}, "'seed' is -1"), ({"scale": "2x"}, "'scale' is '2x'")):
        with pytest.raises(UserError, match=said):
            sampling.Settings(**settings)
    small = photos._replace(images=photos.images[:, :16])
    with pytest.raises(UserError, match=r"make them with sampling\.read_photos"):
        sampling.sample(weights, CONFIG, small, path, SETTINGS)
    size = (CONFIG.recon_height, CONFIG.recon_width)
    for kept, generate, said in (
        ((0,), ((0, WINDOW), (WINDOW, 2 * WINDOW)), "2 chunks"),
        ((7,), ((0, WINDOW),), "photo 7 of 4"),
    ):
        choices = sampling.Choices(kept, 2, "euler", "uniform", size, 1, generate, WINDOW)
        with pytest.raises(UserError, match=said):
            plan = type("P", (), {"choices": choices, "ids": photos.ids})
            sampling.sample(weights, CONFIG, photos, path, SETTINGS, plan=plan)


NAN_POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, float("nan")], [0, 0, 0, 1]]
SHEARED = [[1, 0.3, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
SCALED = [[2.5, 0, 0, 1], [0, 2.5, 0, 0], [0, 0, 2.5, 0], [0, 0, 0, 1]]
MIRROR = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"transform_matrix": NAN_POSE}, "0001"),
        ({"transform_matrix": MIRROR}, "mirror"),
        ({"transform_matrix": SHEARED}, "R is no rotation"),
        ({"transform_matrix": SCALED}, "scale of 2.5; divide"),
        ({"fl_x": -5.0}, "0001"),
        ({"w": 80, "h": 24}, "intrinsics are for"),
    ],
)
def test_bad_scenes_are_refused_in_one_sentence(change, said, place, capsys, tmp_path):
    scene = broken_scene(tmp_path, "scene", change)
    expect_refusal(program(place, "--scene", scene, out="bad"), said, place, capsys)


def test_torn_photo_is_named(place, capsys, tmp_path):
    scene = nerfstudio(tmp_path / "scene", truth(2))
    file = scene / "images" / "0001.png"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    expect_refusal(program(place, "--scene", scene, out="bad"), "0001.png", place, capsys)


def test_torn_and_foreign_checkpoints_are_named(place, capsys, tmp_path):
    import shutil

    torn = tmp_path / "torn"
    shutil.copytree(place / "model", torn)
    file = next(torn.glob("*.safetensors"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    expect_refusal(program(place, "--checkpoint", torn, out="bad"), "truncated", place, capsys)
    file.unlink()
    expect_refusal(program(place, "--checkpoint", torn, out="bad"), "incomplete", place, capsys)
    other = tmp_path / "other"
    shutil.copytree(place / "model", other)
    record = json.loads((other / "config.json").read_text())
    record["config"]["dit"]["width"] = 128
    (other / "config.json").write_text(json.dumps(record))
    expect_refusal(program(place, "--checkpoint", other, out="bad"), "does not fit", place, capsys)


def test_foreign_folders_are_not_overwritten(place, capsys):
    (place / "mine").mkdir()
    (place / "mine" / "thesis.tex").write_text("precious")
    assert program(place, out="mine") == 2
    assert "not of an earlier run" in capsys.readouterr().err
    assert (place / "mine" / "thesis.tex").read_text() == "precious"


def test_a_network_that_breaks_stops_with_the_step_and_leaves_nothing(
    place, weights, capsys, tmp_path
):
    broken = jax.tree.map(np.asarray, weights)
    linear = broken["dit"]["head"]["linear"]
    linear["kernel"] = np.full_like(linear["kernel"], 3e38)  # finite, its products are not
    checkpoint.save_model(tmp_path / "huge", broken, CONFIG, dtype=np.float32)
    code = program(place, "--checkpoint", tmp_path / "huge", "--frames", 3, out="bad")
    shown = capsys.readouterr().err
    assert (
        code == 1 and "error: The velocity (the network's output) is not finite at step 0" in shown
    )
    assert not (place / "bad").exists() and not (place / "bad.part").exists()


@pytest.mark.parametrize("value", [np.nan, -np.inf])
@pytest.mark.parametrize("dtype", [np.float32, jnp.bfloat16])
def test_weights_that_are_not_finite_are_named(place, weights, capsys, tmp_path, value, dtype):
    """Also where no noise level would show them: in the VAE's decoder."""
    broken = jax.tree.map(lambda x: np.array(x), weights)
    broken["vae"]["decoder"]["conv_out"]["bias"][1] = value
    checkpoint.save_model(tmp_path / "bad", broken, CONFIG, dtype=dtype)
    assert program(place, "--checkpoint", tmp_path / "bad", "--frames", 3, out="bad") == 2
    shown = capsys.readouterr().err
    assert "model-00001-of-00001.safetensors: 'vae/decoder/conv_out/bias' has NaN" in shown
    assert not (place / "bad").exists() and not (place / "bad.part").exists()


def test_settings_name_the_closest_word():
    with pytest.raises(UserError, match="did you mean 'clean'"):
        sampling.Settings(slots="claen")
