"""Videos, frames and contact sheets, read back."""

import sys

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.files import video_io


def waves(n=6, height=48, width=80):
    """Slowly changing colours, float in [0, 1]: neither coding nor halved chroma costs them much."""
    t, y, x = np.mgrid[:n, :height, :width].astype(np.float32)
    phases = (x / width + t / n, y / height - t / n, (x + y) / (width + height) + 0.5 * t / n)
    return np.stack([0.5 + 0.45 * np.sin(np.pi * p) for p in phases], -1).astype(np.float32)


def psnr(a, b):
    return -10 * np.log10(np.mean((a / 255.0 - b / 255.0) ** 2))


class TestH264:
    def test_round_trip(self, tmp_path):
        frames = waves()
        file = video_io.write_video(tmp_path / "a.mp4", frames)
        assert file == tmp_path / "a.mp4"
        back = video_io.read_video(file)
        assert back.shape == frames.shape and back.dtype == np.uint8
        # A wrong colour matrix or range costs far more than coding at this quality.
        assert psnr(back, video_io.to_uint8(frames)) > 38

    def test_browsers_can_play_it(self, tmp_path):
        import av

        file = video_io.write_video(tmp_path / "a.mp4", waves(), fps=12.5)
        with av.open(str(file)) as container:
            stream = container.streams.video[0]
            assert stream.codec_context.name == "h264"
            assert stream.codec_context.pix_fmt == "yuv420p"
            assert stream.average_rate == 12.5
            assert stream.frames == 6
        content = file.read_bytes()
        assert 0 < content.find(b"moov") < content.find(b"mdat"), "the index must come first"

    def test_odd_sizes_are_padded_by_repetition(self, tmp_path):
        frames = waves(3, 31, 53)
        back = video_io.read_video(video_io.write_video(tmp_path / "a.mp4", frames))
        assert back.shape == (3, 32, 54, 3)
        assert psnr(back[:, :31, :53], video_io.to_uint8(frames)) > 36

    @pytest.mark.parametrize(("channel", "value"), [(0, 255), (1, 255), (2, 255), (0, 128)])
    def test_colours_and_channel_order(self, channel, value, tmp_path):
        frames = np.zeros((2, 32, 32, 3), np.uint8)
        frames[..., channel] = value
        back = video_io.read_video(video_io.write_video(tmp_path / "a.mp4", frames))
        assert np.abs(back.astype(int) - frames).max() <= 4

    def test_single_frame(self, tmp_path):
        assert len(video_io.read_video(video_io.write_video(tmp_path / "a.mp4", waves(1)))) == 1

    @pytest.mark.parametrize(
        ("frames", "fps", "said"),
        [
            (np.zeros((0, 8, 8, 3)), 16, "given shape"),
            (np.zeros((2, 8, 8)), 16, "given shape"),
            (np.zeros((2, 8, 8, 4)), 16, "given shape"),
            (np.zeros((2, 8, 8, 3)), 0, "frames per second"),
        ],
    )
    def test_what_is_no_video_is_named(self, frames, fps, said, tmp_path):
        with pytest.raises(UserError, match=said):
            video_io.write_video(tmp_path / "a.mp4", frames, fps)
        assert not any(tmp_path.iterdir())

    def test_nothing_half_written(self, tmp_path, monkeypatch):
        def torn(file, *rest):
            file.write_bytes(b"half")
            raise OSError("disk full")

        video_io.write_video(tmp_path / "a.mp4", waves(2))
        before = (tmp_path / "a.mp4").read_bytes()
        monkeypatch.setattr(video_io, "_write_h264", torn)
        with pytest.raises(OSError, match="disk full"):
            video_io.write_video(tmp_path / "a.mp4", waves(3))
        assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
        assert (tmp_path / "a.mp4").read_bytes() == before


def test_vp9_without_pyav(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    frames = waves(4, 47, 80)
    with pytest.warns(UserWarning, match=r"a\.webm \(VP9\) is written instead of a\.mp4"):
        file = video_io.write_video(tmp_path / "a.mp4", frames)
    assert [p.name for p in tmp_path.iterdir()] == ["a.webm"] and file.name == "a.webm"
    back = video_io.read_video(file)
    assert back.shape == (4, 48, 80, 3)
    # Its default bit rate is low; a swapped channel order would be below 15 dB.
    assert psnr(back[:, :47], video_io.to_uint8(frames)) > 25


def test_unreadable_videos_are_named(tmp_path):
    with pytest.raises(UserError, match=r"gone\.mp4: there is no such video"):
        video_io.read_video(tmp_path / "gone.mp4")
    (tmp_path / "torn.mp4").write_bytes(b"not a video at all")
    with pytest.raises(UserError, match=r"torn\.mp4: cannot be read"):
        video_io.read_video(tmp_path / "torn.mp4")


class TestPictures:
    def test_frames_are_lossless_and_replaced_whole(self, tmp_path):
        from PIL import Image

        frames = np.random.default_rng(0).integers(0, 256, (5, 9, 7, 3), np.uint8)
        names = video_io.write_frames(tmp_path / "frames", frames)
        assert names == [f"{i:04d}.png" for i in range(5)]
        for name, pixels in zip(names, frames, strict=True):
            np.testing.assert_array_equal(
                np.asarray(Image.open(tmp_path / "frames" / name)), pixels
            )
        video_io.write_frames(tmp_path / "frames", frames[:2])
        assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == names[:2]
        assert [p.name for p in tmp_path.iterdir()] == ["frames"]

    def test_equal_pixels_give_equal_bytes(self, tmp_path):
        pixels = waves(1)[0]
        a = video_io.write_png(tmp_path / "a.png", pixels).read_bytes()
        assert a == video_io.write_png(tmp_path / "b.png", pixels).read_bytes()

    def test_floats_are_rounded_and_clipped(self):
        values = np.array([-0.1, 0.0, 0.5 / 255, 0.51 / 255, 1.0, 1.2], np.float32)
        assert video_io.to_uint8(values).tolist() == [0, 0, 0, 1, 255, 255]

    def test_animated_webp(self, tmp_path):
        from PIL import Image

        frames = waves(5)
        picture = Image.open(video_io.write_webp(tmp_path / "a.webp", frames, fps=10))
        assert picture.n_frames == 5 and picture.info["loop"] == 0
        for i in range(5):
            picture.seek(i)
            picture.load()
            assert picture.info["duration"] == 100
            assert psnr(np.asarray(picture.convert("RGB")), video_io.to_uint8(frames)[i]) > 30

    def test_contact_sheet_shows_every_row_in_order(self):
        def plain(colour):
            return np.full((40, 60, 3), colour, np.uint8)

        photos = [plain((200, 0, 0)), plain((0, 200, 0))]
        frames = [plain((0, 0, i)) for i in range(20)]
        sheet = video_io.contact_sheet(
            {"photos": photos, "generated": frames}, columns=4, min_height=80
        )
        # 40 pixels are enlarged twice; 4 columns of 120 and five gaps of 4.
        assert sheet.shape == (2 * (20 + 80 + 4) + 4, 4 * 124 + 4, 3)
        assert sheet[60, 30].tolist() == [200, 0, 0] and sheet[60, 160].tolist() == [0, 200, 0]
        assert sheet[60, 300].tolist() == [255, 255, 255]
        blues = [int(sheet[170, 30 + 124 * i, 2]) for i in range(4)]
        assert blues == [0, 6, 13, 19]


def lacking(*codecs):
    """PyAV as built without these encoders."""
    import av

    opened = av.open

    class Without:
        def __init__(self, inner):
            self.inner = inner

        def __enter__(self):
            self.inner.__enter__()
            return self

        def __exit__(self, *error):
            return self.inner.__exit__(*error)

        def __getattr__(self, name):
            return getattr(self.inner, name)

        def add_stream(self, codec, *rest, **more):
            if codec in codecs:
                raise av.codec.codec.UnknownCodecError(codec)
            return self.inner.add_stream(codec, *rest, **more)

    return lambda *rest, **more: Without(opened(*rest, **more))


@pytest.mark.parametrize(
    ("codecs", "opencv", "name"),
    [
        (("libx264",), True, "a.webm"),
        (("libx264", "libvpx-vp9"), True, "a.webm"),
        (("libx264", "libvpx-vp9"), False, "a.webp"),
    ],
)
def test_a_missing_codec_costs_no_frames(tmp_path, monkeypatch, codecs, opencv, name):
    """The next encoder is taken, at last Pillow's; the warning names the file and the codec that is missing."""
    import av

    monkeypatch.setattr(av, "open", lacking(*codecs))
    if not opencv:
        monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.warns(UserWarning, match=rf"libx264.* {name} .* is written instead of a\.mp4"):
        file = video_io.write_video(tmp_path / "a.mp4", waves(4, 48, 80))
    assert [p.name for p in tmp_path.iterdir()] == [name] and file.name == name
    monkeypatch.undo()
    if name.endswith("webm"):
        assert video_io.read_video(file).shape == (4, 48, 80, 3)
