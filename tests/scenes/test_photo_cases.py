"""One test for every way in which photos can be odd: size, orientation, colour, damage."""

import io
import json
import struct
import sys

import numpy as np
import pytest
import scene_files as files
from camera_cases import (
    looking_at_origin,
)
from scene_files import HEIGHT, WIDTH, picture

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import (
    Cameras,
    CameraWarning,
    inspect,
)
from roge_jax.geometry.crops import crop_resize_K, resize, scale_K, turn
from roge_jax.geometry.rays import plucker_float64
from roge_jax.scenes.images import _upright, read_header, read_image
from roge_jax.scenes.scene import Scene, load_scene, prepare


def with_K(**entries: float) -> Cameras:
    cameras = looking_at_origin(2)
    places = {"fx": (0, 0), "skew": (0, 1), "cx": (0, 2), "fy": (1, 1), "cy": (1, 2)}
    K = cameras.K.copy()
    for name, value in entries.items():
        K[1][places[name]] = value
    return Cameras(K, cameras.c2w)


def test_photos_of_different_size():
    """Each K follows its own photo to the common size; wildly different shapes are refused."""
    images = [np.zeros((24, 40, 3), np.float32), np.zeros((60, 80, 3), np.float32)]
    K = with_K().K
    K[1] = scale_K(K[0], (24, 40), (60, 80))
    scene = Scene(images, Cameras(K, looking_at_origin(2).c2w), ("a", "b"), "test")
    pictures, cameras = prepare(scene, [0, 1], 12, 16)
    assert pictures.shape == (2, 12, 16, 3)
    for view in range(2):
        expected = crop_resize_K(K[view], images[view].shape[:2], (12, 16))
        np.testing.assert_array_equal(cameras.K[view], expected)
    tall = Scene([images[0], np.zeros((80, 40, 3))], scene.cameras, ("a", "b"), "test")
    with pytest.raises(UserError, match=r"photos a and b differ by more than a factor of two"):
        prepare(tall, [0, 1], 12, 16)


def stored_with_tag(upright: np.ndarray, orientation: int) -> tuple[np.ndarray, object]:
    """The grid on which a camera with this EXIF orientation stores an upright picture."""
    from PIL import Image

    back = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}[orientation]
    stored = np.rot90(upright, back)
    stored = stored[:, ::-1] if orientation in (2, 4, 5, 7) else stored
    exif = Image.Exif()
    exif[0x0112] = orientation
    return np.ascontiguousarray(stored), exif


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path, orientation):
    """Photos are shown upright; K for the upright grid stays, K for the stored grid turns along
    with picture and pose."""
    from PIL import Image, ImageOps

    truth = with_K(cx=17.0, cy=14.0, fy=37.0)[[1]]
    folder = files.nerfstudio(tmp_path / "upright", truth)
    upright = picture(0)
    stored, exif = stored_with_tag(upright, orientation)
    files.save(folder / "images" / "0000.png", stored, exif=exif)
    with Image.open(folder / "images" / "0000.png") as shown:
        np.testing.assert_array_equal(np.asarray(ImageOps.exif_transpose(shown)), upright)
    deep = _upright(stored, orientation)
    np.testing.assert_array_equal(deep, upright)
    scene = load_scene(folder)
    np.testing.assert_allclose(scene.images[0] * 255, upright, atol=1e-4)
    np.testing.assert_allclose(scene.cameras.K, truth.K)
    ignored = load_scene_ignoring(folder, stored)
    assert ignored.sizes == [stored.shape[:2]]

    if orientation in (6, 8):
        turns = {6: 1, 8: 3}[orientation]
        K, c2w = turn(truth.K[0], truth.c2w[0], turns, HEIGHT, WIDTH)
        other = files.nerfstudio(
            tmp_path / "stored", Cameras(K[None], c2w[None]), w=HEIGHT, h=WIDTH
        )
        files.save(other / "images" / "0000.png", stored, exif=exif)
        scene = load_scene(other)
        assert scene.sizes == [(HEIGHT, WIDTH)]  # before pixels are decoded
        np.testing.assert_allclose(scene.images[0] * 255, upright, atol=1e-4)
        np.testing.assert_allclose(scene.cameras.K, truth.K, atol=1e-9)
        np.testing.assert_allclose(scene.cameras.c2w, truth.c2w, atol=1e-9)


def load_scene_ignoring(folder, stored: np.ndarray) -> Scene:
    """The stored grid as it is, with a K for it."""
    content = json.loads((folder / "transforms.json").read_text())
    height, width = stored.shape[:2]
    content |= {"w": width, "h": height}
    content["frames"][0] |= {"cx": width / 2, "cy": height / 2}
    other = folder / "ignored.json"
    other.write_text(json.dumps(content))
    scene = load_scene(other, exif="ignore")
    np.testing.assert_allclose(scene.images[0] * 255, stored, atol=1e-4)
    return scene


@pytest.mark.parametrize("turns", range(4))
def test_turned_cameras_see_the_same_rays(turns):
    """np.rot90 on the picture and `turn` on the camera permute the rays, nothing else."""
    camera = with_K(cx=17.0, cy=14.0, fy=37.0)[[1]]
    before = plucker_float64(camera.K, camera.c2w, HEIGHT, WIDTH)[0]
    K, c2w = turn(camera.K[0], camera.c2w[0], turns, HEIGHT, WIDTH)
    size = (WIDTH, HEIGHT) if turns % 2 else (HEIGHT, WIDTH)
    after = plucker_float64(K[None], c2w[None], *size)[0]
    np.testing.assert_allclose(after, np.rot90(before, turns), atol=1e-12)
    assert not inspect(Cameras(K[None], c2w[None]), *size)[1]


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_transparent_photos(tmp_path, mode):
    """Composited once on white (or the colour asked for), with a warning."""
    from PIL import Image

    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    rgba[..., :3], rgba[: HEIGHT // 2, :, 3] = 100, 255
    rgba[0, 0, 3] = 51 if mode != "P" else 255
    image = Image.fromarray(rgba)
    file = tmp_path / "a.png"
    if mode == "P":
        flat = Image.fromarray((rgba[..., 3] == 0).astype(np.uint8), "L").convert("P")
        flat.putpalette([100, 100, 100] + [0, 0, 0] * 255)
        flat.save(file, transparency=1)
    else:
        image.convert(mode).save(file)
    pixels = read_image(file)
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(pixels[-1], 1.0)
    np.testing.assert_allclose(pixels[1], 100 / 255, atol=1e-6)
    if mode != "P":
        np.testing.assert_allclose(pixels[0, 0], 0.2 * 100 / 255 + 0.8, atol=1e-6)
    np.testing.assert_allclose(read_image(file, background=0.0)[-1], 0.0)
    folder = files.nerfstudio(tmp_path, with_K()[:1])
    file.rename(folder / "images" / "0000.png")
    with pytest.warns(CameraWarning, match="transparent"):
        load_scene(folder)


def test_sixteen_bits(tmp_path):
    """All 65536 levels survive; grey becomes three equal channels; alpha still counts."""
    import cv2

    ramp = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    colour = np.stack([ramp, ramp[::-1], ramp[:, ::-1]], -1)  # blue, green, red in OpenCV's order
    cv2.imwrite(str(tmp_path / "colour.png"), colour)
    cv2.imwrite(str(tmp_path / "grey.png"), ramp)
    cv2.imwrite(str(tmp_path / "colour.tif"), colour)
    for name in ("colour.png", "colour.tif"):
        expected = colour[..., ::-1].astype(np.float32) / np.float32(65535)
        np.testing.assert_array_equal(read_image(tmp_path / name), expected)
    grey = read_image(tmp_path / "grey.png")
    assert len(np.unique(grey)) == 65536 and grey.shape == (256, 256, 3)
    alpha = np.concatenate([colour, np.zeros_like(colour[..., :1])], -1)
    cv2.imwrite(str(tmp_path / "alpha.png"), alpha)
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), 1.0)
    (tmp_path / "hdr.exr").write_bytes(b"v/1\x01")
    with pytest.raises(UserError, match=r"hdr.exr: HDR .* tone-map"):
        read_image(tmp_path / "hdr.exr")
    cv2.imwrite(str(tmp_path / "float.tif"), ramp.astype(np.float32))
    with pytest.raises(UserError, match=r"float.tif: float32 pixels"):
        read_image(tmp_path / "float.tif")


def test_colour_modes(tmp_path):
    """Grey is repeated, CMYK without a profile refused, another colour space converted to sRGB."""
    from PIL import Image, ImageCms

    grey = Image.fromarray(picture(0)[..., 0])
    grey.save(tmp_path / "grey.jpg", quality=100)
    pixels = read_image(tmp_path / "grey.jpg")
    assert pixels.shape[-1] == 3 and np.ptp(pixels, axis=-1).max() == 0
    Image.fromarray(picture(0)).convert("CMYK").save(tmp_path / "cmyk.jpg")
    with pytest.raises(UserError, match=r"cmyk.jpg: CMYK without a colour profile"):
        read_image(tmp_path / "cmyk.jpg")
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(picture(0)).save(tmp_path / "srgb.png", icc_profile=srgb)
    np.testing.assert_allclose(read_image(tmp_path / "srgb.png") * 255, picture(0), atol=1e-4)
    corners = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]]], np.uint8)
    Image.fromarray(corners).save(tmp_path / "swap.png", icc_profile=swapped_profile())
    pixels = read_image(tmp_path / "swap.png") * 255
    np.testing.assert_allclose(pixels, corners[..., [1, 0, 2]], atol=12)


def test_large_and_rare_pictures(tmp_path, monkeypatch):
    """Above Pillow's soft limit: no warning. Above the hard one, CMYK or Lab in a TIFF: refused by name."""
    from PIL import Image

    photo = Image.fromarray(picture(0))
    photo.save(tmp_path / "large.png")
    for mode in ("CMYK", "LAB"):
        photo.convert(mode).save(tmp_path / f"{mode}.tif")
        with pytest.raises(UserError, match=rf"{mode}.tif: .*{mode}"):
            read_image(tmp_path / f"{mode}.tif")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", HEIGHT * WIDTH - 1)
    np.testing.assert_allclose(read_image(tmp_path / "large.png") * 255, picture(0), atol=1e-4)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", HEIGHT * WIDTH // 2 - 1)
    with pytest.raises(UserError, match=r"large.png: has more than 958 pixels: make it smaller"):
        read_image(tmp_path / "large.png")


def swapped_profile() -> bytes:
    """An ICC profile of sRGB's primaries with red and green exchanged (ICC.1:2001, matrix type)."""

    def fixed(*numbers: float) -> bytes:
        return struct.pack(f">{len(numbers)}i", *(round(n * 65536) for n in numbers))

    red, green, blue = (0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141)
    name = b"swapped\0"
    about = b"desc" + bytes(4) + struct.pack(">I", len(name)) + name + bytes(4 + 4 + 2 + 1 + 67)
    tags = {b"desc": about, b"cprt": b"text" + bytes(4) + b"none\0"}
    tags[b"wtpt"] = b"XYZ " + bytes(4) + fixed(0.9642, 1.0, 0.8249)
    for tag, primary in zip((b"rXYZ", b"gXYZ", b"bXYZ"), (green, red, blue), strict=True):
        tags[tag] = b"XYZ " + bytes(4) + fixed(*primary)
    for tag in (b"rTRC", b"gTRC", b"bTRC"):
        tags[tag] = b"curv" + bytes(4) + struct.pack(">IH", 1, round(2.2 * 256)) + bytes(2)
    at, table, body = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for tag, content in tags.items():
        table += tag + struct.pack(">II", at + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    header = struct.pack(
        ">I4sI4s4s4s", at + len(body), b"none", 0x02200000, b"mntr", b"RGB ", b"XYZ "
    )
    header += struct.pack(">6H", 2024, 1, 1, 0, 0, 0) + b"acsp"
    header = header.ljust(68, b"\0") + fixed(0.9642, 1.0, 0.8249)
    return header.ljust(128, b"\0") + table + body


def test_damaged_photos(tmp_path):
    """Cut off or foreign files are refused by name; no half picture comes out."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(picture(0, 200, 300)).save(stream, "JPEG")
    (tmp_path / "cut.jpg").write_bytes(stream.getvalue()[: len(stream.getvalue()) // 2])
    (tmp_path / "text.png").write_text("not a picture")
    (tmp_path / "empty.png").write_bytes(b"")
    with pytest.raises(UserError, match=r"cut.jpg: damaged or truncated"):
        read_image(tmp_path / "cut.jpg")
    for name in ("text.png", "empty.png"):
        with pytest.raises(UserError, match=rf"{name}: not a readable picture"):
            read_image(tmp_path / name)
    with pytest.raises(UserError, match=r"gone.png: there is no such picture"):
        read_image(tmp_path / "gone.png")


def test_resize_keeps_what_fits():
    image = picture(0)
    np.testing.assert_array_equal(resize(image, HEIGHT, WIDTH), image.astype(np.float32) / 255)


@pytest.mark.parametrize("filter_of", ["opencv", "jax"])
def test_shrinking_averages_what_it_leaves_out(monkeypatch, filter_of):
    """Stripes finer than the new pixels become grey, at any factor: no pattern that was not there."""
    if filter_of == "jax":
        monkeypatch.setitem(sys.modules, "cv2", None)
    y, x = np.mgrid[:60, :80] % 2
    for stripes in (x, y, x ^ y):
        image = np.repeat(stripes[..., None], 3, -1).astype(np.uint8) * 255
        for size in ((20, 27), (15, 20), (7, 16)):
            inner = resize(image, *size)[1:-1, 1:-1]
            assert np.abs(inner - 0.5).max() < 0.17


FORMATS = {
    "png": {},
    "jpg": {"quality": 100, "subsampling": 0},
    "webp": {"lossless": True},
    "tif": {},
    "tif lzw": {"compression": "tiff_lzw"},
    "tif deflate": {"compression": "tiff_adobe_deflate"},
    "tif big": {"big_tiff": True},
}


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", FORMATS)
def test_orientation_is_applied_once(tmp_path, name, orientation):
    """Every tag in every format, both ways of `exif`: the upright picture, or the stored grid; the header says its size."""
    from PIL import Image

    upright = np.repeat(np.repeat(picture(0, 6, 10), 8, 0), 8, 1)
    stored, exif = stored_with_tag(upright, orientation)
    file = tmp_path / f"a.{name.partition(' ')[0]}"
    tiff = name.startswith("tif")
    tags = {"tiffinfo": {274: orientation}} if tiff else {"exif": exif}
    Image.fromarray(stored).save(file, **tags, **FORMATS[name])
    tolerance = 0.03 if name == "jpg" else 1e-6
    np.testing.assert_allclose(read_image(file), upright / np.float32(255), atol=tolerance)
    np.testing.assert_allclose(
        read_image(file, exif=False), stored / np.float32(255), atol=tolerance
    )
    header = read_header(file)
    assert (header.stored, header.displayed) == (stored.shape[:2], upright.shape[:2])


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("order", ["<", ">"])
def test_orientation_of_sixteen_bits(tmp_path, orientation, order):
    """Deep TIFFs in both byte orders: other decoders turn eight bits and not sixteen."""
    import tifffile

    upright = picture(0).astype(np.uint16) * 257
    stored, _ = stored_with_tag(upright, orientation)
    file = tmp_path / "a.tif"
    tag = (274, "H", 1, orientation, True)
    tifffile.imwrite(file, stored, photometric="rgb", byteorder=order, extratags=[tag])
    np.testing.assert_allclose(read_image(file), upright / np.float32(65535), atol=1e-6)
    np.testing.assert_allclose(read_image(file, exif=False), stored / np.float32(65535), atol=1e-6)


def test_heic_by_an_extra(tmp_path, monkeypatch):
    """An iPhone's own format with pillow-heif, and one sentence without."""
    pillow_heif = pytest.importorskip("pillow_heif")
    from PIL import Image

    flat = np.full((48, 64, 3), (200, 60, 30), np.uint8)
    pillow_heif.from_pillow(Image.fromarray(flat)).save(tmp_path / "a.heic", quality=95)
    pixels = read_image(tmp_path / "a.heic")
    assert pixels.shape == (48, 64, 3)
    np.testing.assert_allclose(pixels * 255, flat, atol=6)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(UserError, match=r"a.heic: HEIC needs the package pillow-heif"):
        read_image(tmp_path / "a.heic")
