"""OpenEXR there and back: colours beyond 8 bits, depth, camera, remark."""

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.files import exr


@pytest.mark.parametrize("with_depth", [True, False])
def test_there_and_back(tmp_path, with_depth):
    rng = np.random.default_rng(0)
    rgb = rng.random((5, 7, 3), np.float32) * 1.2
    depth = np.where(rng.random((5, 7)) < 0.2, np.nan, 3.5).astype(np.float32)
    K, c2w = rng.random((3, 3)), rng.random((4, 4))
    picture = exr.Picture(rgb, depth if with_depth else None, K, c2w, '{"seed":7}')
    exr.write_exr(tmp_path / "a.exr", picture)
    back = exr.read_exr(tmp_path / "a.exr")
    np.testing.assert_allclose(back.rgb, rgb, atol=1e-6)
    np.testing.assert_array_equal(back.K, K)
    np.testing.assert_array_equal(back.c2w, c2w)
    assert back.about == '{"seed":7}'
    if with_depth:
        np.testing.assert_array_equal(back.depth, depth)
    else:
        assert back.depth is None
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


def test_light_is_linear(tmp_path):
    """Half of sRGB's range is a fifth of the light."""
    OpenEXR = pytest.importorskip("OpenEXR")
    exr.write_exr(tmp_path / "a.exr", exr.Picture(np.full((2, 2, 3), 0.5, np.float32)))
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as opened:
        assert opened.channels()["G"].pixels == pytest.approx(0.21404, abs=1e-4)


def test_what_cannot_be_is_one_sentence(tmp_path):
    (tmp_path / "a.exr").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"a\.exr: is no picture in OpenEXR"):
        exr.read_exr(tmp_path / "a.exr")
    with pytest.raises(UserError, match="cannot be written"):
        exr.write_exr(tmp_path / "none" / "b.exr", exr.Picture(np.zeros((2, 2, 3))))
