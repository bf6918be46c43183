"""What a run leaves in its folder: looked at by other tools' readers, and kept when a writer fails. Nothing is computed: the
program gets a video that is made up."""

import errno
import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from scene_files import HEIGHT, WIDTH, nerfstudio, picture, truth

from roge_jax import export, sample, sampling
from roge_jax.config import preset
from roge_jax.errors import UserError
from roge_jax.files import entry, folders, video_io
from roge_jax.geometry.cameras import Cameras, invert, normalise
from roge_jax.sampling import finished, outputs
from roge_jax.scenes.paths import load_path
from roge_jax.scenes.points import Points
from roge_jax.scenes.scene import load_scene

CONFIG = preset("tiny")
COUNT = 6
SIZE = CONFIG.output_size


def made_up(photos, path):
    """A result without a model: noise, which no codec makes small."""
    rng = np.random.default_rng(0)
    frames = rng.random((len(path), *SIZE, 3), np.float32)
    _, _, info = normalise(photos.cameras, path)
    window = {"frames": [0, len(path) - 1], "photos": [0], "generated": []}
    return sampling.video.Result(frames, frames, path, info, 0, (window,))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A scene, and a program whose model is made up; `asked` is what it was called with."""
    nerfstudio(tmp_path / "scene", truth(4))
    asked = SimpleNamespace(root=tmp_path, known=None, loaded=0)

    def preview(params, config, photos, path, *, stage, known=(), **more):
        asked.known = known
        with stage("preview"):
            return made_up(photos, path)

    def load(*_):
        asked.loaded += 1
        return {}, CONFIG

    monkeypatch.setattr(sampling, "preview", preview)
    monkeypatch.setattr(sample, "load_weights", load)
    monkeypatch.setattr(sample, "model_config", lambda args, weights: CONFIG)
    return asked


def run(place, *more, out="out"):
    words = ["--scene", place.root / "scene", "--out", place.root / out, "--preview-only"]
    words += ["--frames", COUNT, "--context", "0,2", *more]
    return entry.execute(sample.main, sample.parser(), [str(word) for word in words])


def test_the_folder_is_a_scene_of_frames_and_photos(place):
    """transforms.json and the COLMAP model give the cameras of the path and of the photos, to 1e-6."""
    assert run(place, "--trajectory", "orbit:degrees=20") == 0
    out, photos = place.root / "out", load_scene(place.root / "scene").cameras
    expected = np.concatenate([load_path(out).c2w, photos.c2w[[0, 2]]])
    for where in (out, out / "sparse" / "0"):
        if where != out:
            (out / "transforms.json").rename(out / "path.json")
        scene = load_scene(out)
        assert len(scene) == COUNT + 2 and set(scene.sizes) == {SIZE}
        np.testing.assert_allclose(scene.cameras.c2w, expected, atol=1e-6)
        K = load_path(out / "path.json" if where != out else out).K
        np.testing.assert_allclose(scene.cameras.K[:COUNT], K, atol=1e-6)
        frame, photo = scene.images[1], scene.images[COUNT]
        stored = load_frame(out / "frames" / "0001.png")
        np.testing.assert_array_equal(video_io.to_uint8(frame), stored)
        assert np.abs(photo.mean((0, 1)) - picture(0).mean((0, 1)) / 255).max() < 0.1


def load_frame(file):
    from PIL import Image

    return np.asarray(Image.open(file))


def test_its_path_is_that_of_the_frames_alone(place):
    assert run(place) == 0
    path = load_path(place.root / "out")
    assert len(path) == COUNT and len(load_scene(place.root / "out")) == COUNT + 2
    assert run(place, "--trajectory", place.root / "out", out="again") == 0
    np.testing.assert_allclose(load_path(place.root / "again").c2w, path.c2w, atol=1e-12)


def test_pycolmap_reads_the_folder(place):
    pycolmap = pytest.importorskip("pycolmap")
    assert run(place) == 0
    out = place.root / "out"
    scene, model = load_scene(out), pycolmap.Reconstruction(str(out / "sparse" / "0"))
    assert sorted(image.name for image in model.images.values()) == list(scene.names)
    for image in model.images.values():
        assert (out / "images" / image.name).is_file()
        view = scene.names.index(image.name)
        w2c = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(w2c, invert(scene.cameras.c2w)[view], atol=1e-9)
        camera = model.cameras[image.camera_id]
        assert (camera.height, camera.width) == SIZE
        np.testing.assert_allclose(camera.calibration_matrix(), scene.cameras.K[view])


@pytest.mark.parametrize("layout", ["colmap", "colmap-binary"])
def test_points_are_written_with_their_tracks(layout, tmp_path):
    """What pycolmap and our own reader see of points, colours, errors and of who sees them."""
    pycolmap = pytest.importorskip("pycolmap")
    from roge_jax.scenes import writers
    from roge_jax.scenes.points import read_points3D

    xyz, rgb = np.array([[0.5, 0, 3], [1, 2, 4]]), np.array([[1, 2, 3], [250, 0, 9]], np.uint8)
    seen = [np.array([0]), np.array([0, 1]), np.array([], int), np.array([1])]
    pixels = [np.full((len(s), 2), 1.5 + i) for i, s in enumerate(seen)]
    points = Points(xyz, rgb, seen, pixels, np.array([0.25, 0.5]))
    names = [f"{i}.png" for i in range(4)]
    writers.write(tmp_path, truth(4), HEIGHT, WIDTH, layout=layout, names=names, points=points)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert [model.points3D[i].error for i in (1, 2)] == [0.25, 0.5]
    tracks = {
        i: {(e.image_id, e.point2D_idx) for e in model.points3D[i].track.elements} for i in (1, 2)
    }
    assert tracks == {1: {(1, 0), (2, 0)}, 2: {(2, 1), (4, 0)}}
    np.testing.assert_allclose(model.images[2].points2D[1].xy, [2.5, 2.5])
    back = read_points3D(tmp_path, names)
    np.testing.assert_allclose(back.xyz, xyz)
    np.testing.assert_array_equal(back.rgb, rgb)
    assert [s.tolist() for s in back.seen] == [s.tolist() for s in seen]


def test_the_points_of_the_scene_come_along(place):
    from roge_jax.scenes.points import write_ply

    points = Points(np.random.default_rng(1).random((30, 3)), np.full((30, 3), 77, np.uint8))
    write_ply(place.root / "scene" / "points.ply", points)
    content = json.loads((place.root / "scene" / "transforms.json").read_text())
    (place.root / "scene" / "transforms.json").write_text(
        json.dumps(content | {"ply_file_path": "points.ply"})
    )
    assert run(place) == 0
    (place.root / "out" / "transforms.json").unlink()
    found = load_scene(place.root / "out").points
    np.testing.assert_allclose(found.xyz, points.xyz, atol=1e-7)
    assert (found.rgb == 77).all()


def test_every_file_says_where_it_came_from(place):
    import av
    from PIL import Image

    assert run(place, "--video", "mp4,webm,webp,gif") == 0
    out = place.root / "out"
    said = []
    for kind in ("mp4", "webm"):
        with av.open(str(out / f"video.{kind}")) as container:
            tags = {name.lower(): value for name, value in container.metadata.items()}
            said.append(tags["comment"])
    with Image.open(out / "video.webp") as opened:
        assert opened.n_frames == COUNT and opened.size == SIZE[::-1]
        said.append(opened.getexif()[video_io.DESCRIPTION])
    with Image.open(out / "video.gif") as opened:
        assert opened.n_frames == COUNT and opened.info["duration"] == 60  # of 62.5 ms
        said.append(opened.info["comment"].decode())
    for name in ("frames/0000.png", "images/photo00.png", "contact_sheet.png"):
        said.append(Image.open(out / name).text["Comment"])
    said.append((out / "sparse" / "0" / "images.txt").read_text().partition("\n")[0][2:])
    said = [json.loads(text) for text in said]
    said.append(json.loads((out / "transforms.json").read_text())["roge_jax"])
    for one in said:
        assert one["roge_jax"] == entry.version() and one["model"] == "tiny"
        assert one["config"]["dit"]["width"] == CONFIG.dit.width and "seed" in one


def test_frames_in_float_have_their_cameras(place):
    """What 8 bits lose is there, and K and pose are those of transforms.json."""
    from roge_jax.files import exr

    assert run(place, "--exr") == 0
    out = place.root / "out"
    assert len(list((out / "exr").iterdir())) == COUNT
    scene, found = load_scene(out), exr.read_exr(out / "exr" / "0003.exr")
    frames = np.random.default_rng(0).random((COUNT, *SIZE, 3), np.float32)
    np.testing.assert_allclose(found.rgb, frames[3], atol=1e-6)
    np.testing.assert_allclose(found.c2w, scene.cameras.c2w[3], atol=1e-12)
    np.testing.assert_allclose(found.K, scene.cameras.K[3], atol=1e-9)
    assert json.loads(found.about)["model"] == "tiny"


def test_a_gif_keeps_its_colours(tmp_path):
    """The palette is that of all frames: colours that only the last one has are there."""
    from PIL import Image

    frames = np.zeros((12, 32, 40, 3), np.uint8)
    frames[:6], frames[6:, :, :20], frames[6:, :, 20:] = (200, 30, 30), (20, 180, 60), (40, 60, 220)
    video_io.write_video(tmp_path / "a.gif", frames, 10)
    with Image.open(tmp_path / "a.gif") as opened:
        assert opened.n_frames == 2  # equal frames are one that stays
        for i in (0, 1):
            opened.seek(i)
            assert np.abs(np.asarray(opened.convert("RGB")).astype(int) - frames[11 * i]).max() < 12


@pytest.mark.parametrize("name", ["a.avi", "a", "a.png"])
def test_other_kinds_of_video_are_named(name, tmp_path):
    with pytest.raises(UserError, match=r"ends in \.mp4, \.webm, \.webp, \.gif"):
        video_io.write_video(tmp_path / name, np.zeros((2, 8, 8, 3)))


def test_an_unknown_kind_is_one_sentence(place, capsys):
    assert run(place, "--video", "mp4,gift") == 2
    assert "unknown kind of video 'gift': did you mean 'gif'?" in capsys.readouterr().err


# ---- before anything is computed -----------------------------------------------------------------


def lacking(*names):
    """A writer that no codec is behind."""

    def refuse(*_):
        raise ValueError(f"there is no {names[0]}")

    return refuse


def test_a_missing_codec_is_told_first_and_replaced(place, monkeypatch, capsys):
    monkeypatch.setattr(video_io, "_write_h264", lacking("H.264"))
    assert run(place) == 0
    shown = capsys.readouterr()
    assert shown.err.count("video.webm (VP9) is written instead of video.mp4") == 1
    assert "preview" in shown.out and "video.webm" in shown.out
    assert (place.root / "out" / "video.webm").is_file()
    assert not list((place.root / "out").glob("*.mp4"))


def test_a_size_that_no_codec_takes_costs_nothing(place, monkeypatch, capsys):
    for name in ("_write_h264", "_write_av_vp9", "_write_vp9", "_write_webp"):
        monkeypatch.setattr(video_io, name, lacking(name))
    assert run(place) == 2
    said = capsys.readouterr().err
    assert f"error: {SIZE[0]}x{SIZE[1]} at 16 frames per second: video.mp4: no video" in said
    assert said.count("\n") == 1 and place.loaded == 0 and place.known is None
    assert [file.name for file in place.root.iterdir()] == ["scene"]


def test_a_disk_without_room_costs_nothing(place, monkeypatch, capsys):
    usage = shutil.disk_usage(place.root)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
    assert run(place) == 2
    said = capsys.readouterr().err
    assert "The video needs" in said and "make room or give another --out" in said
    assert place.loaded == 0 and not (place.root / "out").exists()


def test_where_a_disk_is_mounted_is_refused_first(place, monkeypatch, capsys):
    """The finished folder could not take its place, which is found out only at the end."""
    (place.root / "out").mkdir()
    monkeypatch.setattr(folders.Path, "is_mount", lambda file: file.name == "out")
    assert run(place) == 2
    assert "is where a disk is mounted" in capsys.readouterr().err and place.loaded == 0


# ---- when a writer fails -------------------------------------------------------------------------


def full(*_, **more):
    raise OSError(errno.ENOSPC, "No space left on device")  # as Pillow does, which names no file


def test_frames_stay_where_a_video_fails_and_one_sentence_says_how_to_go_on(
    place, monkeypatch, capsys
):
    assert run(place) == 0
    before = (place.root / "out" / "video.mp4").read_bytes()
    with monkeypatch.context() as broken:
        broken.setattr(video_io, "_write_h264", full)
        broken.setattr(outputs, "check_outputs", lambda *_, **more: ("mp4",))
        capsys.readouterr()
        assert run(place) == 1 and run(place) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(said) == 2
    assert said[0].startswith(
        f"error: {place.root / 'out'}: No space left on device: free some space"
    )
    names = sorted(file.name for file in place.root.iterdir())
    assert names == ["out", "out.unfinished", "out.unfinished2", "scene"]
    assert (place.root / "out" / "video.mp4").read_bytes() == before
    kept = place.root / "out.unfinished"
    assert f"{COUNT} finished frames are in {kept / 'frames'}" in said[0]
    assert f"`python -m roge_jax.export {kept} --video mp4`" in said[0]
    words = said[0].partition("`python -m roge_jax.export ")[2].partition("`")[0].split()
    assert entry.execute(export.main, export.parser(), words) == 0
    assert video_io.read_video(kept / "video.mp4").shape[0] == COUNT
    assert len(load_scene(kept)) == COUNT + 2


def test_frames_stay_where_a_later_frame_fails(place, monkeypatch, capsys):
    write = video_io.write_png

    def until_full(path, *rest, **more):
        return full() if path.name == "0004.png" else write(path, *rest, **more)

    monkeypatch.setattr(video_io, "write_png", until_full)
    assert run(place) == 1
    assert "4 finished frames are in" in capsys.readouterr().err
    kept = finished.read(place.root / "out.unfinished")
    assert kept.names == tuple(f"{i:04d}.png" for i in range(4))
    assert json.loads(kept.about)["model"] == "tiny" and kept.fps == 16


def test_a_file_that_the_system_cuts_off(place, capsys):
    """A real failure in the middle of a file: the system lets none grow beyond 48 KiB."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (48 * 1024, hard))
    try:
        code = run(place, "--frames", 24)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    said = capsys.readouterr().err.splitlines()[-1]
    assert code == 1 and "24 finished frames are in" in said and "File too large" in said
    assert len(list((place.root / "out.unfinished" / "frames").iterdir())) == 24


def test_a_fault_of_the_program_keeps_the_frames_too(place, monkeypatch, capsys):
    monkeypatch.setattr(video_io, "contact_sheet", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(place)
    assert "6 finished frames are in" in capsys.readouterr().err
    assert (place.root / "out.unfinished" / "video.mp4").is_file()


def test_a_run_without_frames_leaves_nothing(place, monkeypatch):
    monkeypatch.setattr(video_io, "write_frames", full)
    assert run(place) == 2
    assert [file.name for file in place.root.iterdir()] == ["scene"]


# ---- a finished run ------------------------------------------------------------------------------


def test_more_kinds_of_video_of_a_finished_run(place, capsys):
    assert run(place, "--fps", 8) == 0
    out, before = place.root / "out", capsys.readouterr()
    words = [str(out), "--video", "gif,webm"]
    assert entry.execute(export.main, export.parser(), words) == 0
    assert f"{out}/video.gif: written, {COUNT} frames" in capsys.readouterr().out and before
    import av

    with av.open(str(out / "video.webm")) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == 8 and stream.codec_context.name == "vp9"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["scene", "--video", "gif"], "has no frames"),
        (["scene"], "Give --video or --points"),
        (["scene", "--video", "gif", "--merge", "mini"], "Give --video or --points"),
        (["scene", "--merge", "mini"], "No --out given"),
    ],
)
def test_what_cannot_be_exported_is_one_sentence(place, words, said, capsys):
    words = [str(place.root / words[0]), *words[1:]]
    assert entry.execute(export.main, export.parser(), words) == 2
    shown = capsys.readouterr().err
    assert said in shown and shown.count("\n") == 1


# ---- the first lines -----------------------------------------------------------------------------


def test_the_built_in_scene_is_no_reason_to_warn(place, capsys):
    """Two photos are few, and all that the demo has: that is the user's matter with scenes of his own alone."""
    scene = ["--scene", "motorcycle"]
    for words, known in ((scene, ("photos",)), ([*scene, "--context", "1"], ()), ([], ())):
        given = ["--context", "2", *words] if "--context" not in words else words
        assert run(place, *given) == 0
        assert place.known == known
    first = capsys.readouterr().out.splitlines()[0]
    assert (
        first
        == "2 photos of motorcycle, the built-in scene (--scene takes yours), 6 frames of "
        + (f"{SIZE[0]}x{SIZE[1]}, tiny: the reconstruction's own picture")
    )


def test_what_is_known_is_no_warning_but_in_the_result(recwarn):
    from roge_jax.sampling import limits

    two = truth(2)
    images = np.zeros((2, HEIGHT, WIDTH, 3))
    told = limits.warn(images, two, two, "mini", (0, 1), known=("photos",))
    assert [one.kind for one in told if "distinct" in one.message] == ["photos"]
    assert not [one for one in recwarn if "distinct" in str(one.message)]
    limits.warn(images, two, two, "mini", (0, 1))
    assert [one for one in recwarn if "distinct" in str(one.message)]


def test_points_of_a_finished_run(tmp_path, capsys):
    """points.ply, the COLMAP model with tracks, and transforms.json name the same points."""
    pycolmap = pytest.importorskip("pycolmap")
    from test_triangulate import HEIGHT as H
    from test_triangulate import WIDTH as W
    from test_triangulate import sideways, wall

    from roge_jax.scenes.paths import transforms
    from roge_jax.scenes.points import read_ply

    cameras = sideways()
    names = video_io.write_frames(tmp_path / "frames", wall(cameras))
    shutil.copytree(tmp_path / "frames", tmp_path / "images")
    shutil.copyfile(tmp_path / "images" / "0000.png", tmp_path / "images" / "photo00.png")
    every = Cameras(cameras.K[[*range(7), 0]], cameras.c2w[[*range(7), 0]])
    content = transforms([*names, "photo00.png"], every, H, W, folder="images")
    folders.write_json(tmp_path / "transforms.json", content | {"roge_jax": {"path_frames": 7}})
    assert entry.execute(export.main, export.parser(), [str(tmp_path), "--points"]) == 0
    said = capsys.readouterr().out
    points = read_ply(tmp_path / "points.ply")
    assert f"points.ply: {len(points)} points of " in said and "reprojection error 0." in said
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert model.num_points3D() == len(points) > 60 and model.num_images() == 8
    assert model.compute_mean_track_length() > 4
    stored = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    assert (
        model.compute_mean_reprojection_error() == pytest.approx(stored, abs=1e-3) and stored < 0.3
    )
    np.testing.assert_allclose(load_scene(tmp_path).points.xyz, points.xyz)


def test_points_need_cameras(tmp_path, capsys):
    video_io.write_frames(tmp_path / "frames", np.zeros((3, 24, 32, 3)))
    assert entry.execute(export.main, export.parser(), [str(tmp_path), "--points"]) == 2
    assert "has no transforms.json" in capsys.readouterr().err
