"""Every layout, once as a scene and once as a path: one ground truth, the same cameras, every omission told."""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import layout_files as more
import numpy as np
import pytest
import scene_files as files
from scene_files import HEIGHT, WIDTH, picture, save, truth

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import Cameras, CameraWarning, opencv_to_opengl
from roge_jax.scenes.paths import load_path, read_path
from roge_jax.scenes.scene import cameras_at, find_view, load_scene, open_scene

CAMERAS = truth()
ONE, CENTRED = more.one_K(CAMERAS), more.one_K(CAMERAS, centred=True)
# layout: (how it is written, its cameras, how its views are to be ordered)
LAYOUTS = {
    "nerfstudio": (lambda f: files.nerfstudio(f, CAMERAS), CAMERAS),
    "nerfstudio file": (lambda f: files.nerfstudio(f, CAMERAS) / "transforms.json", CAMERAS),
    "colmap text": (lambda f: files.colmap(f, CAMERAS, binary=False), CAMERAS),
    "colmap binary": (lambda f: files.colmap(f, CAMERAS, binary=True), CAMERAS),
    "colmap model": (lambda f: files.colmap(f, CAMERAS, binary=True) / "sparse" / "0", CAMERAS),
    "colmap images.txt": (
        lambda f: files.colmap(f, CAMERAS, binary=False) / "sparse" / "0" / "images.txt",
        CAMERAS,
    ),
    "colmap dense": (lambda f: more.colmap_dense(f, CAMERAS), CAMERAS),
    "colmap input": (lambda f: more.colmap_input(f, CAMERAS), CAMERAS),
    "colmap rig": (lambda f: more.colmap_rig(f, CAMERAS), CAMERAS),
    "realestate10k": (lambda f: files.re10k(f, CAMERAS), CAMERAS),
    "realestate10k folder": (lambda f: files.re10k(f, CAMERAS).parent, CAMERAS),
    "lvsm": (lambda f: files.lvsm(f, CAMERAS), CAMERAS),
    "cut3r": (lambda f: files.cut3r(f, CAMERAS), CAMERAS),
    "cut3r dense": (lambda f: files.cut3r(f / "dense", CAMERAS).parent, CAMERAS),
    "cut3r vkitti": (lambda f: files.cut3r(f, CAMERAS, beside=True), CAMERAS),
    "cut3r scannet": (lambda f: more.cut3r_color(f, CAMERAS), CAMERAS),
    "cut3r co3d": (lambda f: more.cut3r_co3d(f, CAMERAS), CAMERAS),
    "cut3r metadata": (lambda f: more.cut3r_metadata(f, CAMERAS), CAMERAS),
    "vkitti": (lambda f: files.vkitti(f, CAMERAS), CAMERAS),
    "llff": (lambda f: more.llff(f, CENTRED), CENTRED),
    "tum": (lambda f: more.tum(f, ONE), ONE),
    "kitti": (lambda f: more.kitti(f, ONE), ONE),
    "blender": (lambda f: more.blender(f, CENTRED), CENTRED),
    "framecrafter": (lambda f: more.framecrafter(f, CAMERAS, 4), CAMERAS),
    "framecrafter npz": (
        lambda f: more.framecrafter(f, CAMERAS, 4) / "scene_data.npz",
        CAMERAS,
    ),
    "dl3dv": (lambda f: more.nested(f, CAMERAS), CAMERAS),
    "one folder down": (lambda f: more.nested(f, CAMERAS, "anything"), CAMERAS),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_scene_and_its_own_path_have_the_same_cameras(tmp_path, layout):
    """Read as a scene it is the truth; read as a path it is the scene's own cameras, whatever the size of the video."""
    write, cameras = LAYOUTS[layout]
    place = write(tmp_path)
    scene = load_scene(place)
    assert len(scene) == 4 and scene.sizes == [(HEIGHT, WIDTH)] * 4
    np.testing.assert_allclose(scene.cameras.c2w, cameras.c2w, atol=1e-9)
    np.testing.assert_allclose(scene.cameras.K, cameras.K, rtol=1e-9)
    for view in range(4):
        np.testing.assert_allclose(scene.images[view] * 255, picture(view), atol=1e-4)
    path = load_path(place)
    np.testing.assert_allclose(path.c2w, scene.cameras.c2w, atol=1e-9)
    np.testing.assert_allclose(path.K, scene.cameras.K, rtol=1e-9)
    sized = load_path(place, height=64, width=112, context=scene.cameras, scene=place)
    np.testing.assert_allclose(sized.c2w, scene.cameras.c2w, atol=1e-9)
    np.testing.assert_allclose(sized.K, cameras_at(scene, 64, 112).K, rtol=1e-9)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_hidden_files_are_in_nobodys_way(tmp_path, layout):
    """A Mac writes ._NAME beside every file that it touches."""
    write, cameras = LAYOUTS[layout]
    place = write(tmp_path)
    for file in [f for f in tmp_path.rglob("*") if f.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7" + bytes(60))
    scene = load_scene(place)
    np.testing.assert_allclose(scene.cameras.c2w, cameras.c2w, atol=1e-9)


def edit(folder: Path, change) -> Path:
    """transforms.json of a folder, changed."""
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    return file


def per_frame(content):
    for entry in content["frames"]:
        entry |= {"w": content["w"], "h": content["h"]}
    content |= {"w": 10, "h": 10, "fl_x": 1.0, "fl_y": 2.0, "cx": 3.0, "cy": 4.0}


def angles(content):
    for entry in content["frames"]:
        angle = 2 * np.arctan(0.5 * WIDTH / entry.pop("fl_x"))
        del entry["fl_y"], entry["cx"], entry["cy"]
        entry["camera_angle_x"] = angle
    content |= {"fl_x": 1.0, "fl_y": 2.0, "cx": 3.0, "cy": 4.0}


def both_angles(content):
    for entry in content["frames"]:
        across, down = entry.pop("fl_x"), entry.pop("fl_y")
        entry["camera_angle_x"] = 2 * np.arctan(0.5 * WIDTH / across)
        entry["camera_angle_y"] = 2 * np.arctan(0.5 * HEIGHT / down)


def lens(content):
    content |= {"camera_model": "OPENCV", "k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.003}


def frame_lens(content):
    lens(content)
    content["k1"] = 9.0
    for entry in content["frames"]:
        entry |= {"k1": -0.1}


def fisheye(content):
    content |= {"camera_model": "OPENCV_FISHEYE", "k1": -0.05, "k2": 0.01}


def other_axes(content):
    for entry in content["frames"]:
        pose = np.array(entry["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
        entry["transform_matrix"] = pose.tolist()


def shrunk(content):
    content |= {"w": 4 * WIDTH, "h": 4 * HEIGHT}
    for entry in content["frames"]:
        entry |= {name: 4 * entry[name] for name in ("fl_x", "fl_y", "cx", "cy")}


def own_principal_point(content):
    """Only the principal point is the frame's own, as after crops of one camera's photos."""
    content |= {"fl_x": content["frames"][0]["fl_x"], "fl_y": content["frames"][0]["fl_y"], "cx": 1}
    for entry in content["frames"]:
        del entry["fl_x"], entry["fl_y"]


RULES = {
    "sizes and K on every frame": (per_frame, {}, CAMERAS),
    "angles on every frame": (angles, {}, None),
    "two angles on every frame": (both_angles, {}, CAMERAS),
    "lens": (lens, {}, None),
    "lens of the frame": (frame_lens, {}, None),
    "fisheye": (fisheye, {}, None),
    "axes": (other_axes, {"convention": "opencv"}, CAMERAS),
    "photos smaller than the file says": (shrunk, {}, CAMERAS),
    "principal point of the frame": (own_principal_point, {}, None),
}


@pytest.mark.parametrize("rule", RULES)
def test_every_rule_holds_for_photos_and_paths(tmp_path, rule):
    change, options, expected = RULES[rule]
    folder = files.nerfstudio(tmp_path, CAMERAS)
    file = edit(folder, change)
    scene = load_scene(folder, **options)
    for place in (folder, file):
        path = load_path(place, height=32, width=40, context=scene.cameras, **options)
        np.testing.assert_allclose(path.c2w, scene.cameras.c2w, atol=1e-9)
        np.testing.assert_allclose(path.K, cameras_at(scene, 32, 40).K, rtol=1e-9)
    if expected is not None:
        np.testing.assert_allclose(scene.cameras.K, expected.K, rtol=1e-9)
        np.testing.assert_allclose(scene.cameras.c2w, expected.c2w, atol=1e-9)


def test_a_frames_own_intrinsics_win_as_a_whole(tmp_path):
    """camera_angle_x of the frame over fl_x of the file; its fl_x is not joined with the file's fl_y, cx and cy."""
    folder = files.nerfstudio(tmp_path, CAMERAS)
    file = edit(folder, angles)
    K = load_scene(folder).cameras.K
    np.testing.assert_allclose(K[:, 0, 0], CAMERAS.K[:, 0, 0])
    np.testing.assert_allclose(K[:, 1, 1], CAMERAS.K[:, 0, 0])  # square, centred
    np.testing.assert_allclose(K[:, :2, 2], [[WIDTH / 2, HEIGHT / 2]] * 4)
    content = json.loads(file.read_text())
    for entry in content["frames"]:
        entry.pop("camera_angle_x")
        entry["fl_x"] = 30.0
    file.write_text(json.dumps(content))
    for K in (load_scene(folder).cameras.K, load_path(file).K):
        np.testing.assert_allclose(K, [[[30, 0, WIDTH / 2], [0, 30, HEIGHT / 2], [0, 0, 1]]] * 4)
    content["frames"][1] = {k: v for k, v in content["frames"][1].items() if k != "fl_x"} | {
        "fl_y": 3
    }
    file.write_text(json.dumps(content))
    for read in (load_scene, load_path):
        with pytest.raises(UserError, match=r"frame 1 .*has 'fl_y' alone"):
            read(file)


def test_principal_point_of_the_frame_alone(tmp_path):
    folder = files.nerfstudio(tmp_path, CAMERAS)
    edit(folder, own_principal_point)
    K = load_scene(folder).cameras.K
    np.testing.assert_allclose(K[:, :2, 2], CAMERAS.K[:, :2, 2])
    np.testing.assert_allclose(K[:, [0, 1], [0, 1]], [CAMERAS.K[0, [0, 1], [0, 1]]] * 4)


@pytest.mark.parametrize("orientation", [6, 8])
def test_a_path_turns_with_its_photos(tmp_path, orientation):
    """K and poses of the stored grid: the path films the upright pictures, as the scene shows them."""
    from PIL import Image

    from roge_jax.geometry.crops import turn

    turns = {6: 1, 8: 3}[orientation]
    turned = [turn(K, c, turns, HEIGHT, WIDTH) for K, c in zip(CAMERAS.K, CAMERAS.c2w, strict=True)]
    stored = Cameras(np.stack([K for K, _ in turned]), np.stack([c for _, c in turned]))
    folder = files.nerfstudio(tmp_path, stored, w=HEIGHT, h=WIDTH)
    for view in range(4):
        exif = Image.Exif()
        exif[0x0112] = orientation
        grid = np.ascontiguousarray(np.rot90(picture(view), turns))
        save(folder / "images" / f"{view:04d}.png", grid, exif=exif)
    scene = load_scene(folder)
    np.testing.assert_allclose(scene.cameras.c2w, CAMERAS.c2w, atol=1e-9)
    path = load_path(folder / "transforms.json", height=48, width=80, context=scene.cameras)
    np.testing.assert_allclose(path.c2w, CAMERAS.c2w, atol=1e-9)
    np.testing.assert_allclose(path.K[:, :2], 2 * CAMERAS.K[:, :2], rtol=1e-9)


@pytest.mark.parametrize("kind", ["fisheye", "equirectangular", "omnidirectional", "vr180"])
def test_cameras_that_are_no_pinholes_are_refused_by_name(tmp_path, kind):
    folder = files.nerfstudio(tmp_path, CAMERAS, camera_type=kind)
    entries = [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 60.0}]
    viewer = {"camera_path": entries, "render_height": 24, "render_width": 40, "camera_type": kind}
    (tmp_path / "path.json").write_text(json.dumps(viewer))
    for call in (
        lambda: load_scene(folder),
        lambda: load_path(folder / "transforms.json"),
        lambda: load_path(tmp_path / "path.json", frame="scene"),
    ):
        with pytest.raises(UserError, match=f"camera_type {kind} is not supported"):
            call()


# ---- names ----------------------------------------------------------------------------------------


def renamed(content, rename):
    for entry in content["frames"]:
        entry["file_path"] = rename(entry["file_path"])


ELSEWHERE = {
    "backslashes": lambda name: name.replace("/", "\\"),
    "a drive": lambda name: "C:\\Users\\me\\scan\\" + name.replace("/", "\\"),
    "another machine": lambda name: "/home/somebody/data/scan/" + name,
    "the folder above": lambda name: "../scan/" + name,
    "another folder of photos": lambda name: "/data/scan/" + name.removeprefix("images/"),
    "capitals": lambda name: name.replace(".png", ".PNG"),
    "no ending": lambda name: name.removesuffix(".png"),
    "a dot": lambda name: "./" + name,
}


@pytest.mark.parametrize("how", ELSEWHERE)
def test_names_of_other_machines_are_found(tmp_path, how):
    folder = files.nerfstudio(tmp_path, CAMERAS)
    edit(folder, lambda content: renamed(content, ELSEWHERE[how]))
    for view in range(4):  # masks of the same names do not confuse it
        save(folder / "masks" / f"{view:04d}.png", picture(9))
    with pytest.warns(CameraWarning, match="4 masks"):
        scene = load_scene(folder)
    assert [scene.images.photos[i].file.name for i in range(4)] == [
        f"{i:04d}.png" for i in range(4)
    ]
    np.testing.assert_allclose(scene.images[2] * 255, picture(2), atol=1e-4)


def test_accents_are_found_in_a_locale_that_has_none(tmp_path):
    """There Python shows the names on the disk with the bytes of their accents, a file's own with the accents."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "é 0.png").touch()
    code = (
        "import sys; from pathlib import Path; from roge_jax.scenes.pictures import Finder;"
        "found = Finder(Path(sys.argv[1])).find('images/\\xe9 0.png');"
        "assert sys.getfilesystemencoding() == 'ascii' and found is not None and found.is_file()"
    )
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    call = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(call, env=os.environ | ascii_only, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC")])
def test_accents_are_found_however_they_are_composed(tmp_path, forms):
    import unicodedata

    folder = files.nerfstudio(tmp_path, CAMERAS)
    name = unicodedata.normalize(forms[1], "images/Café 0.png")
    (folder / "images" / "0000.png").rename(folder / name)
    accented = unicodedata.normalize(forms[0], name)
    edit(folder, lambda content: content["frames"][0].update(file_path=accented))
    np.testing.assert_allclose(load_scene(folder).images[0] * 255, picture(0), atol=1e-4)


def test_a_photo_of_another_split_is_not_taken(tmp_path):
    """test/r_0.png is not train/r_0.png."""
    folder = more.blender(tmp_path, CENTRED)
    (folder / "train" / "r_0.png").unlink()
    with pytest.warns(CameraWarning, match=r"1 of 4 photos are missing .* './train/r_0'"):
        scene = load_scene(folder)
    assert scene.names == ("train/r_1", "val/r_0", "test/r_0")


@pytest.mark.parametrize(
    "name",
    ["a  b.png", "caf\udce9.png", "a\u0085b.png", "a,b.png", "7", "IMG.JPG", "\u5199\u771f.png"],
)
def test_unusual_names_in_colmap_text(tmp_path, name):
    """White space, line separators of Unicode, commas: the name as it is written."""
    folder = files.colmap(tmp_path, CAMERAS, binary=False)
    file = folder / "sparse" / "0" / "images.txt"
    file.write_text(file.read_text().replace("0002.png", name), "utf-8", "surrogateescape")
    there = {"7": "7.png", "IMG.JPG": "img.jpg"}.get(name, name)
    (folder / "images" / "0002.png").rename(folder / "images" / there)
    scene = load_scene(folder)
    assert len(scene) == 4 and there in scene.names
    np.testing.assert_allclose(
        scene.cameras.c2w[scene.names.index(there)], CAMERAS.c2w[2], atol=1e-9
    )


def test_equal_names_are_addressed_by_their_folder(tmp_path):
    scene = load_scene(more.colmap_rig(tmp_path, CAMERAS))
    assert scene.names == ("left/0.png", "left/1.png", "right/0.png", "right/1.png")
    assert find_view(scene, "right/0.png") == 2 and find_view(scene, "images/right/0.png") == 2
    assert find_view(scene, "right\\0.png") == 2 and find_view(scene, "none.png") is None
    with pytest.raises(UserError, match=r"'0.png' could be 2 photos: .* left/0.png, right/0.png"):
        find_view(scene, "0.png")


def test_short_names_are_taken_while_they_are_unique(tmp_path):
    """One camera of the rig has a photo of its own name."""
    folder = more.colmap_rig(tmp_path, CAMERAS)
    text = folder / "sparse" / "0" / "images.txt"
    text.write_text(text.read_text().replace("right/1.png", "right/only.png"))
    (folder / "images/right/1.png").rename(folder / "images/right/only.png")
    scene = load_scene(folder)
    assert find_view(scene, "only.png") == 3 and find_view(scene, "1.png") == 1


# ---- what is left out -----------------------------------------------------------------------------


def told(place, **options) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_scene(place, **options)
    return [str(one.message) for one in caught]


def without_a_pose(folder):
    files.nerfstudio(folder, CAMERAS)
    save(folder / "images" / "x.png", picture(0))
    return folder


def named_masks(folder):
    files.nerfstudio(folder, CAMERAS)
    edit(folder, lambda c: [e.update(mask_path=f"m/{i}.png") for i, e in enumerate(c["frames"])])
    return folder


def masks_beside(folder):
    files.colmap(folder, CAMERAS, binary=False)
    for view in range(4):
        save(folder / "masks" / f"{view:04d}.png.png", picture(0))
    return folder


def smaller_model(folder):
    files.colmap(folder, CAMERAS, binary=True)
    other = files.colmap(folder / "made", CAMERAS[:2], binary=False)
    (other / "sparse" / "0").rename(folder / "sparse" / "1")
    return folder


def far_times(folder):
    more.tum(folder, ONE)
    text = (folder / "rgb.txt").read_text().replace("1305031102.304000", "1305031102.334000", 1)
    (folder / "rgb.txt").write_text(text)
    return folder


def missing(writer, name):
    def write(folder):
        place = writer(folder)
        next(f for f in folder.rglob(name)).unlink()
        return place

    return write


LEFT_OUT = {
    "a photo without a pose": (without_a_pose, "4 of 5 photos have a pose, 1 are left out"),
    "masks of the file": (named_masks, "4 masks lie there and are not used"),
    "masks beside": (masks_beside, "4 masks lie there and are not used"),
    "another model": (smaller_model, r"largest of 2 COLMAP models .* not sparse/1 \(2 photos\)"),
    "a bad frame": (lambda f: more.scannetpp(f, CAMERAS), "1 of 5 frames are marked 'is_bad'"),
    "a lost frame": (lambda f: files.scannet(f, CAMERAS), "1 of 5 frames are left out, the tracker"),
    "a photo too late": (far_times, "1 of 4 photos are left out, no pose lies within 20 ms"),
    "nerfstudio": (missing(lambda f: files.nerfstudio(f, CAMERAS), "0001.png"), "1 of 4 photos are missing"),
    "colmap": (missing(lambda f: files.colmap(f, CAMERAS, True), "0001.png"), "1 of 4 photos are missing"),
    "lvsm": (missing(lambda f: files.lvsm(f, CAMERAS), "00001.png"), "1 of 4 photos are missing"),
    "cut3r": (missing(lambda f: files.cut3r(f, CAMERAS), "900.png"), "1 of 4 photos are missing"),
    "realestate10k": (missing(lambda f: files.re10k(f, CAMERAS), "900.png"), "1 of 4 photos are missing"),
    "metadata": (missing(lambda f: more.cut3r_metadata(f, CAMERAS), "DSC00001.png"), "1 of 4 photos are missing"),
    "framecrafter": (missing(lambda f: more.framecrafter(f, CAMERAS, 4), "1.png"), "1 of 4 photos are missing"),
    "an option": (lambda f: files.colmap(f, CAMERAS, binary=True), "--convention opengl is not used"),
}  # fmt: skip


@pytest.mark.parametrize("what", LEFT_OUT)
def test_what_is_left_out_is_one_note_with_a_count(tmp_path, what):
    import re

    write, note = LEFT_OUT[what]
    options = {"convention": "opengl"} if what == "an option" else {}
    notes = told(write(tmp_path), **options)
    assert len(notes) == 1 and re.search(note, notes[0]), notes
    assert "; " in notes[0]  # and how to change it


def test_seva_targets_without_photos_are_a_path(tmp_path):
    """Context photos lie there, targets do not: the scene is the photos, the path is all of it."""
    folder = files.nerfstudio(tmp_path, CAMERAS)
    for view in (1, 3):
        (folder / "images" / f"{view:04d}.png").unlink()
    with pytest.warns(CameraWarning, match="2 of 4 photos are missing"):
        scene = load_scene(folder)
    np.testing.assert_allclose(scene.cameras.c2w, CAMERAS.c2w[[0, 2]], atol=1e-9)
    path = load_path(folder / "transforms.json")
    np.testing.assert_allclose(path.c2w, CAMERAS.c2w, atol=1e-9)
    np.testing.assert_allclose(path.K, CAMERAS.K)


def test_framecrafter_targets_have_no_photos(tmp_path):
    folder = more.framecrafter(tmp_path, CAMERAS, 2)
    assert len(load_scene(folder)) == 2
    np.testing.assert_allclose(load_path(folder / "scene_data.npz").c2w, CAMERAS.c2w, atol=1e-9)


def test_colmap_without_lines_of_points(tmp_path):
    folder = files.colmap(tmp_path, CAMERAS, binary=False)
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().split("\n")
    file.write_text("\n".join([lines[0], *lines[1:9:2]]) + "\n")
    scene = load_scene(folder)
    np.testing.assert_allclose(scene.cameras.c2w, CAMERAS.c2w, atol=1e-9)


def test_a_chosen_model_is_read(tmp_path):
    folder = smaller_model(tmp_path)
    notes = told(folder / "sparse" / "1")
    assert len(notes) == 1 and "2 of 4 photos are registered" in notes[0]


def test_colmap_of_square_pictures(tmp_path):
    folder = files.colmap(tmp_path, CAMERAS, binary=False)
    file = folder / "sparse" / "0" / "cameras.txt"
    file.write_text(file.read_text().replace(" 40 24 ", " 518 518 "))
    with pytest.raises(UserError, match=r"cameras.txt .* square pictures, to which VGGT") as error:
        load_scene(folder)
    assert "'w'" not in str(error.value)


@pytest.mark.parametrize("number", ["518 0 0 20", "40000 100 20 30"])
def test_realestate10k_in_pixels_is_said(tmp_path, number):
    file = files.re10k(tmp_path, CAMERAS)
    lines = file.read_text().splitlines()
    words = lines[1].split()
    lines[1] = " ".join([words[0], *number.split(), *words[5:]])
    file.write_text("\n".join(lines))
    with pytest.raises(UserError, match=r"intrinsics are in pixels, .* divide"):
        load_scene(file)


def test_realestate10k_with_padded_times(tmp_path):
    file = files.re10k(tmp_path, CAMERAS)
    for photo in (tmp_path / "abc").iterdir():
        photo.rename(photo.with_name(f"{int(photo.stem):012d}.png"))
    np.testing.assert_allclose(load_scene(file).cameras.c2w, CAMERAS.c2w, atol=1e-9)
    for photo in (tmp_path / "abc").iterdir():
        photo.unlink()
    with pytest.raises(UserError, match=r"looked for 900.png \(or .jpg\) in"):
        load_scene(file)
    path = load_path(file, height=48, width=80)  # it is a path all the same
    np.testing.assert_allclose(path.c2w, CAMERAS.c2w, atol=1e-9)


# ---- what a thing is ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.jpg", b"\xff\xd8\xff", r"is one photo; a scene is a folder .* roge_jax.pose"),
        (
            "a.mp4",
            b"\0\0\0\x18ftypmp42",
            r"is a video.*roge_jax.pose \S*a.mp4 --out a_scene makes one of it",
        ),
        ("a.torch", b"PK\x03\x04\0", "is a PyTorch file"),
        ("a.zip", b"PK\x03\x04\0", "is an archive: unpack it"),
        ("a.dat", b"\0\1\2", "is a binary file of no known kind"),
        ("README.txt", b"some words\n", "holds no poses that are known"),
    ],
)
def test_files_that_are_no_scenes_are_called_what_they_are(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    for read in (load_scene, load_path):
        with pytest.raises(UserError, match=message):
            read(tmp_path / name)


def test_folders_that_are_no_scenes(tmp_path):
    save(tmp_path / "mine" / "IMG_1.jpg", picture(0))
    (tmp_path / "mine" / "README.txt").write_text("my photos\n")
    with pytest.raises(
        UserError,
        match=r"1 photo without poses: python -m roge_jax.pose \S+mine --out mine_scene finds them",
    ):
        load_scene(tmp_path / "mine")
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "walk.mov").write_bytes(b"")
    with pytest.raises(
        UserError, match=r"a video: python -m roge_jax.pose \S+walk.mov --out walk_scene makes"
    ):
        load_scene(tmp_path / "films")
    path = tmp_path / "p.json"
    path.write_text(json.dumps({"convention": "opencv", "frames": [{"pose": np.eye(4).tolist()}]}))
    with pytest.raises(UserError, match="is a camera path, it has no photos"):
        load_scene(path)
    (tmp_path / "t.txt").write_text("\n".join(more.tum_lines(CAMERAS)))
    with pytest.raises(UserError, match="has cameras but no photos: give it as --trajectory"):
        load_scene(tmp_path / "t.txt")


def test_notes_are_in_the_report(tmp_path):
    """`check` shows what `load_scene` warns of."""
    from roge_jax.check import Config, check

    report = check(Config(str(masks_beside(tmp_path)), matching=False))
    assert report.usable and any("4 masks" in finding.what for finding in report.findings)
    assert any("4 masks" in note.what for note in open_scene(tmp_path).notes)


def test_the_axes_that_were_read_are_named(tmp_path):
    folder = files.nerfstudio(tmp_path, CAMERAS)
    edit(folder, other_axes)  # OpenCV axes, read as OpenGL
    with pytest.warns(CameraWarning, match=r"may be OpenCV, not 'opengl' .* convention='opencv'"):
        load_path(folder / "transforms.json")
    gl = opencv_to_opengl(CAMERAS.c2w)
    np.savez(tmp_path / "poses.npz", poses=gl, intrinsics=CAMERAS.K, height=24, width=40)
    with pytest.warns(CameraWarning, match=r"may be OpenGL, not 'opencv'"):
        load_path(tmp_path / "poses.npz")
    path = read_path(tmp_path / "poses.npz", convention="opengl")
    assert path.axes == "opengl"
    np.testing.assert_allclose(path.cameras.c2w, CAMERAS.c2w, atol=1e-9)


def test_a_torn_line_between_images_is_named(tmp_path):
    """Lines that are neither images nor points are not passed over, with or without lines of points."""
    folder = files.colmap(tmp_path, CAMERAS, binary=False)
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().split("\n")
    for kept in (lines[:9], [lines[0], *lines[1:9:2]]):
        torn = [line.replace(" 3 0002.png", "") for line in kept]
        file.write_text("\n".join(torn) + "\n")
        with pytest.raises(UserError, match=r"images.txt, line \d+: expected 'id qw"):
            load_scene(folder)


def test_masks_among_the_photos(tmp_path):
    """instant-ngp's dynamic_mask_NAME.png lie beside the photos: no photos without a pose, but masks."""
    files.nerfstudio(tmp_path, CAMERAS)
    for view in range(4):
        save(tmp_path / "images" / f"dynamic_mask_{view:04d}.png", picture(0))
    notes = told(tmp_path)
    assert len(notes) == 1 and "4 masks" in notes[0]


def test_photos_of_colmap_in_shrunk_folders(tmp_path):
    """An empty images/, images_10 before images_4 by alphabet, a folder of masks: the largest one that has the photos."""
    folder = files.colmap(tmp_path, CAMERAS, binary=True)
    for view in range(4):
        (folder / "images" / f"{view:04d}.png").unlink()
        for factor in (2, 4):
            small = picture(view, HEIGHT // factor, WIDTH // factor)
            save(folder / f"images_{2 * factor + (factor == 4) * 2}" / f"{view:04d}.png", small)
        save(folder / "images_1x_masks" / f"{view:04d}.png", picture(9))
    with pytest.warns(CameraWarning, match="4 masks"):
        scene = load_scene(folder)  # images_4 (half the size) and images_10 (a quarter)
    assert scene.sizes == [(HEIGHT // 2, WIDTH // 2)] * 4
    np.testing.assert_allclose(scene.cameras.K[:, :2], CAMERAS.K[:, :2] / 2)


def test_axes_of_scenes_are_named_as_they_were_read(tmp_path):
    folder = files.nerfstudio(tmp_path, CAMERAS)
    edit(folder, other_axes)
    with pytest.warns(CameraWarning, match=r"may be OpenCV, not 'opengl' .* convention='opencv'"):
        load_scene(folder)


def test_text_of_another_kind_is_no_json(tmp_path):
    (tmp_path / "scene.ply").write_text("ply\nformat ascii 1.0\n")
    with pytest.raises(UserError, match="holds no poses that are known"):
        load_scene(tmp_path / "scene.ply")


@pytest.mark.parametrize(
    ("content", "rate"), [({"seconds": 2}, 2.0), ({"seconds": 2, "fps": 9}, 9)]
)
def test_frame_rate_from_seconds(tmp_path, content, rate):
    frames = [{"pose": pose.tolist(), "fov": 50.0} for pose in CAMERAS.c2w]
    own = {"convention": "opencv", "width": WIDTH, "height": HEIGHT, "frames": frames}
    (tmp_path / "p.json").write_text(json.dumps(own | content))
    assert read_path(tmp_path / "p.json").fps == rate
