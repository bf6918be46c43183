"""RealEstate10K in .torch chunks: the same pixels and cameras as from its text and frames, and no code of a file runs."""

import io
import pickle
import struct
import zipfile

import numpy as np
import pytest
from scene_files import picture, save

from roge_jax.data.chunks import read_chunk, scene_of
from roge_jax.data.dataset import read_dataset
from roge_jax.data.pack import main, pack
from roge_jax.errors import UnsafeFile, UserError
from roge_jax.geometry.cameras import invert

SIZE = {"frames": 3, "height": 12, "width": 20}


class Tensor:
    """Pickled as PyTorch pickles one: a call of its rebuilding function on a storage beside the pickle."""

    def __init__(self, array):
        self.array = np.ascontiguousarray(array)


class Global:
    def __init__(self, module, name, argument=""):
        self.text, self.argument = f"c{module}\n{name}\n".encode(), argument


def chunk(file, content):
    """A file as `torch.save(content)` writes it, of dicts, lists, texts and tensors; opcodes by hand, without PyTorch."""
    storages, kinds = [], {"u1": "ByteStorage", "f4": "FloatStorage", "i8": "LongStorage"}

    def number(n):
        return b"J" + struct.pack("<i", n)

    def text(s):
        data = s.encode()
        return b"X" + struct.pack("<I", len(data)) + data

    def tuple_(items):
        return b"(" + b"".join(items) + b"t"

    def code(value):
        if isinstance(value, Tensor):
            array = value.array
            kind = Global("torch", kinds[array.dtype.str[1:]]).text
            pid = [text("storage"), kind, text(str(len(storages))), text("cpu"), number(array.size)]
            storages.append(array.tobytes())
            steps = [s // array.itemsize for s in array.strides]
            shape = [tuple_(map(number, part)) for part in (array.shape, steps)]
            hooks = Global("collections", "OrderedDict").text + b")R"
            made = [tuple_(pid) + b"Q", number(0), *shape, b"\x89", hooks]
            return Global("torch._utils", "_rebuild_tensor_v2").text + tuple_(made) + b"R"
        if isinstance(value, Global):
            return value.text + tuple_([text(value.argument)]) + b"R"
        if isinstance(value, dict):
            return b"}(" + b"".join(code(x) for pair in value.items() for x in pair) + b"u"
        if isinstance(value, list):
            return b"](" + b"".join(map(code, value)) + b"e"
        return text(value)

    data = b"\x80\x02" + code(content) + b"."
    file.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/byteorder", "little")
        for i, storage in enumerate(storages):
            archive.writestr(f"archive/data/{i}", storage)
    return file


def jpeg(view):
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(picture(view)).save(stream, "JPEG", quality=95)
    return np.frombuffer(stream.getvalue(), np.uint8)


def rows(views):
    """[n, 18]: a camera that moves sideways and turns a little."""
    found = []
    for view in range(views):
        angle = -0.1 * view  # towards what lies in the middle
        c2w = np.eye(4)
        c2w[:3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        c2w[:3, 3] = [0.3 * view, 0.1, 0.0]
        found.append([0.9, 1.4, 0.5, 0.5, 0, 0, *invert(c2w)[:3].ravel()])
    return np.array(found, np.float32)


def entry(key, views=4, **change):
    made = {"key": key, "url": "http", "timestamps": Tensor(np.arange(views))}
    made |= {"cameras": Tensor(rows(views)), "images": [Tensor(jpeg(i)) for i in range(views)]}
    return made | change


def test_a_chunk_is_packed_as_its_text_and_frames(tmp_path):
    file = chunk(tmp_path / "chunks" / "000000.torch", [entry("aa"), entry("bb", 3)])
    for i, row in enumerate(rows(4)):
        name = tmp_path / "frames" / "aa" / f"{i}.png"
        pixels = scene_of(read_chunk(file)[0], "aa").images[i]
        save(name, np.round(pixels * 255).astype(np.uint8))
        line = " ".join(repr(float(x)) for x in [i, *row])
        with (tmp_path / "aa.txt").open("a") as text:
            text.write(f"{line}\n" if i else f"http\n{line}\n")
    assert pack([tmp_path / "chunks"], tmp_path / "one", **SIZE) == 3
    assert pack([tmp_path / "aa.txt"], tmp_path / "two", **SIZE) == 2
    one, two = read_dataset(tmp_path / "one"), read_dataset(tmp_path / "two")
    for i in range(2):
        for name in ("K", "c2w"):
            np.testing.assert_allclose(one[i][name], two[i][name], rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(one[i]["rgb"], two[i]["rgb"])
    assert np.abs(one[2]["rgb"][1].astype(float).mean((0, 1))[2] - 60) < 4  # blue is 40 view + 20


def test_bad_scenes_of_a_chunk_cost_no_other(tmp_path, capsys):
    torn = [Tensor(jpeg(i)) for i in range(4)]
    torn[2] = Tensor(np.frombuffer(b"\xff\xd8 no picture", np.uint8))
    bad = [entry("torn", images=torn), entry("few", images=torn[:3]), entry("short", 2)]
    bad += [
        entry("no_cameras", cameras="?"),
        entry("nan", cameras=Tensor(rows(4) * np.float32(np.nan))),
    ]
    file = chunk(tmp_path / "0.torch", [*bad[:2], entry("good"), *bad[2:]])
    (tmp_path / "1.torch").write_bytes(file.read_bytes()[:-300])
    (tmp_path / "2.torch").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    chunk(tmp_path / "3.torch", {"weights": Tensor(rows(2))})
    words = [str(tmp_path), "--out", str(tmp_path / "out"), "--processes", "1", "--frames", "3"]
    assert main([*words, "--height", "12", "--width", "20"]) == 0
    said = capsys.readouterr()
    assert "2 sequences of 1 scenes; 8 left out" in said.out
    reasons = ["torn, view 2: not a readable picture", "few: has 3 'images' and 4 cameras"]
    reasons += ["short: has 2 views", "no_cameras: 'cameras' is str", "nan, view 0: 'cameras' has"]
    reasons += [
        "1.torch is truncated",
        "2.torch is a Git LFS pointer",
        "3.torch is no chunk of scenes",
    ]
    for reason in reasons:
        assert sum(reason in line for line in said.err.splitlines()) == 1, reason


def test_a_chunk_that_executes_code_stops_the_run_first(tmp_path, capsys):
    """The last of the chunks, before the first is packed; the file's own pickle would run."""
    call = Global("os", "mkdir", str(tmp_path / "made"))
    with zipfile.ZipFile(chunk(tmp_path / "call", call)) as archive:
        pickle.loads(archive.read("archive/data.pkl"))
    (tmp_path / "made").rmdir()  # so this is what it does where pickles are trusted
    chunk(tmp_path / "0.torch", [entry("aa")])
    evil = chunk(tmp_path / "1.torch", [entry("bb", url=call)])
    with pytest.raises(UnsafeFile, match=r"os\.mkdir"):
        read_chunk(evil)
    words = [str(tmp_path), "--out", str(tmp_path / "out"), "--processes", "1", "--frames", "3"]
    assert main(words) == 2
    said = capsys.readouterr()
    assert "1.torch tries to execute code: it asks for 'os.mkdir'" in said.err
    assert len(said.err.strip().splitlines()) == 1 and "aa" not in said.out
    assert not (tmp_path / "out").exists() and not (tmp_path / "made").exists()


def test_a_chunk_as_a_scene_names_the_program_that_reads_it(tmp_path):
    from roge_jax.scenes.scene import load_scene

    file = chunk(tmp_path / "0.torch", [entry("aa")])
    with pytest.raises(UserError, match=r"roge_jax.data.pack"):
        load_scene(file)
