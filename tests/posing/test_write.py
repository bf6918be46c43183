"""The scene folder that is written, without pycolmap: read back by the project's own reader."""

import json
import struct

import numpy as np
import pytest
import scene_files as files
from PIL import Image

from roge_jax.geometry.cameras import Cameras
from roge_jax.posing import photos, write
from roge_jax.posing.picture import draw_cameras
from roge_jax.scenes import writers
from roge_jax.scenes.lens import Lens, straighten
from roge_jax.scenes.scene import load_scene

COUNT = 40
TRUTH = files.truth()


def model_of(folder, names, cameras, size):
    """A COLMAP model with points, as `mapper` leaves it."""
    writers.write(folder, cameras, *size, layout="colmap-binary", names=names)
    rng = np.random.default_rng(0)
    data = struct.pack("<Q", COUNT)
    for i in range(COUNT):
        data += struct.pack("<Q3d3BdQ", i + 1, *rng.uniform(-0.3, 0.3, 3), 9, 8, 7, 0.5, 2)
        data += struct.pack("<4I", 1, 0, 2, 0)
    (folder / "points3D.bin").write_bytes(data)


def written(tmp_path, lens):
    """Four photos, one of them lying on its side and one unregistered, through `write_scene`."""
    size = (files.HEIGHT, files.WIDTH)
    K = np.array([[50.0, 0, 20], [0, 50.0, 12], [0, 0, 1]])
    (tmp_path / "photos").mkdir()
    shots = []
    for i, name in enumerate(("a.jpg", "b.png", "c.jpg", "d d.jpg")):
        file = tmp_path / "photos" / name
        pixels = files.picture(i)
        if i == 2:  # stored turned, shown upright
            exif = Image.Exif()
            exif[0x0112] = 6
            Image.fromarray(np.rot90(pixels)).save(file, exif=exif, quality=95)
        else:
            Image.fromarray(pixels).save(file)
        shots.append(photos.read_shot(file))
    assert {shot.size for shot in shots} == {size}
    names = write.names_for(shots)
    new_K, new_size = K, size
    if lens is not None:
        straight = straighten(K, Lens("opencv", lens), size)
        new_K, new_size = straight.K, straight.size
    registered = [0, 2, 3]
    cameras = Cameras(np.tile(new_K, (3, 1, 1)), TRUTH.c2w[registered])
    (tmp_path / "work" / "model").mkdir(parents=True)
    model_of(tmp_path / "work" / "model", [names[i] for i in registered], cameras, new_size)
    camera = {"K": K, "size": size, "lens": lens, "new_K": new_K, "new_size": new_size}
    found = {"registered": registered, "cameras": {"1": camera | {"photos": registered}}}
    said = []
    folder = tmp_path / "scene"
    folder.mkdir()
    write.write_scene(folder, tmp_path / "work", shots, names, found, lambda *a: said.append(a))
    assert said[-1] == ("photos", 3, 3)
    return folder, shots, cameras, new_size


@pytest.mark.parametrize("lens", [None, (0.3, 0.0, 0.0, 0.0)])
def test_a_scene_is_what_its_readers_expect(tmp_path, lens):
    folder, shots, cameras, size = written(tmp_path, lens)
    assert sorted(f.name for f in (folder / "images").iterdir()) == ["a.jpg", "c.jpg", "d_d.jpg"]
    scene = load_scene(folder)
    assert scene.names == ("a.jpg", "c.jpg", "d_d.jpg") and scene.sizes == [size] * 3
    np.testing.assert_allclose(scene.cameras.K, cameras.K, atol=1e-9)
    np.testing.assert_allclose(scene.cameras.c2w, cameras.c2w, atol=1e-9)
    assert scene.notes == () and len(scene.points) == COUNT
    content = json.loads((folder / "transforms.json").read_text())
    assert content["ply_file_path"] == "points.ply" and content["frames"][0]["w"] == size[1]
    model = load_scene(
        folder / "sparse" / "0"
    )  # what 3D Gaussian trainers take, beside the same photos
    np.testing.assert_allclose(model.cameras.c2w, cameras.c2w, atol=1e-9)
    assert model.points.seen is not None
    own = (folder / "images" / "a.jpg").read_bytes() == shots[0].file.read_bytes()
    assert own == (lens is None)  # bytes are kept where nothing is to be done
    with Image.open(folder / "images" / "c.jpg") as picture:
        assert picture.getexif().get(0x0112) is None
    with Image.open(folder / "cameras.png") as picture:
        assert picture.width > 1000


def test_straightened_photos_are_what_a_pinhole_camera_sees(tmp_path):
    """Straightening while posing and straightening while reading give one picture."""
    lens = (0.3, 0.0, 0.0, 0.0)
    folder, shots, _, size = written(tmp_path, lens)
    K = np.array([[50.0, 0, 20], [0, 50.0, 12], [0, 0, 1]])
    straight = straighten(K, Lens("opencv", lens), (files.HEIGHT, files.WIDTH))
    from roge_jax.scenes.images import Photo

    want = Photo(
        shots[3].file, size, lens=Lens("opencv", lens), K=K, new_K=straight.K, straight=size
    ).read()
    found = load_scene(folder).images[2]
    assert np.abs(found - want).mean() < 0.02  # of JPEG
    assert np.abs(found - want).mean() < np.abs(found[:, ::-1] - want).mean() / 5


def test_the_room_that_a_run_needs_grows_with_the_photos(tmp_path):
    Image.fromarray(files.picture(0)).save(tmp_path / "a.jpg")
    shot = photos.read_shot(tmp_path / "a.jpg")
    assert write.room_for([shot] * 20, 1600**2, 190) > 10 * write.room_for([shot], 1600**2, 0)


def test_the_picture_of_cameras_shows_them_where_they_are():
    """Cameras that look at the origin from a ring: red first, blue last, and points in their own colour."""
    xyz = np.tile([[0.0, 0.0, 0.0]], (50, 1))
    rgb = np.tile(np.array([[10, 200, 30]], np.uint8), (50, 1))
    sheet = draw_cameras(TRUTH, xyz, rgb)
    red = np.argwhere((sheet == (214, 69, 65)).all(-1))
    green = np.argwhere((sheet == (10, 200, 30)).all(-1))
    assert len(red) > 20 and len(green) in range(4, 17)
    above, side = green[green[:, 1] < sheet.shape[1] / 2], green[green[:, 1] >= sheet.shape[1] / 2]
    assert len(above) and len(side)
    # The first camera lies, seen from the points, where its centre says.
    centre = TRUTH.centres[0]
    where = red[red[:, 1] < sheet.shape[1] / 2].mean(0) - above.mean(0)
    assert np.sign(where[1]) == np.sign(centre[0]) and np.sign(-where[0]) == np.sign(centre[1])
    assert draw_cameras(TRUTH, np.zeros((0, 3)), None).shape == sheet.shape
