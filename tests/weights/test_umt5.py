"""The empty prompt's row from umT5's own file: against the whole encoder written out, and against transformers."""

import json
import tracemalloc
from pathlib import Path

import ml_dtypes
import numpy as np
import published_files as made
import pytest
from parity import rel_l2

from roge_jax import convert
from roge_jax.config import DiTConfig, to_dict
from roge_jax.errors import UserError
from roge_jax.files.entry import parse
from roge_jax.weights import importer, sources, umt5
from roge_jax.weights.prompt import padded

WIDTH, FFN, HEADS, DEPTH, WORDS = 8, 24, 2, 3, 7
CFG = DiTConfig(text_dim=WIDTH, text_len=6)
FULL = {"t": 256384, "d": 4096, "a": 4096, "f": 10240, "b": 32, "h": 64}  # umT5-xxl


def shapes(sizes, depth: int, theirs: bool = False) -> dict[str, tuple[int, ...]]:
    """{name: shape} of an encoder under the official names, or those of transformers."""
    found = {}
    for name, (there, axes) in umt5.ENDS.items():
        found[there if theirs else name] = tuple(sizes[axis] for axis in axes)
    for i in range(depth):
        for name, (there, axes) in umt5.LAYER.items():
            key = f"encoder.block.{i}.{there}" if theirs else f"blocks.{i}.{name}"
            found[key] = tuple(sizes[axis] for axis in axes)
    return found


SMALL = {"t": WORDS, "d": WIDTH, "a": WIDTH, "f": FFN, "b": 4, "h": HEADS}


def tensors(seed=0, theirs=False, depth=DEPTH):
    rng = np.random.default_rng(seed)
    return {
        key: (rng.standard_normal(shape, np.float32) / 2).astype(ml_dtypes.bfloat16)
        for key, shape in shapes(SMALL, depth, theirs).items()
    }


def official(file: Path, values) -> Path:
    """As Wan publishes it."""
    kinds = dict.fromkeys(values, "BF16")
    file.parent.mkdir(parents=True, exist_ok=True)
    return made.save_torch(
        file, {k: v.shape for k, v in values.items()}, lambda key, _: values[key], dtypes=kinds
    )


def whole_encoder(values, ids):
    """umT5's encoder in float64 with all of its attention: queries, keys and position biases too."""
    w = {key: np.asarray(value, np.float64) for key, value in values.items()}

    def norm(x, gain):
        return x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-6) * gain

    x = w["token_embedding.weight"][ids]
    for i in range(DEPTH):
        p = f"blocks.{i}."
        h = norm(x, w[p + "norm1.weight"])
        q, k, v = (
            (h @ w[f"{p}attn.{n}.weight"].T).reshape(len(ids), HEADS, -1).swapaxes(0, 1)
            for n in "qkv"
        )
        distance = np.abs(np.arange(len(ids))[:, None] - np.arange(len(ids)))
        scores = q @ k.swapaxes(1, 2) + w[p + "pos_embedding.embedding.weight"].T[:, distance]
        weights = np.exp(scores) / np.exp(scores).sum(-1, keepdims=True)
        x = x + (weights @ v).swapaxes(0, 1).reshape(len(ids), -1) @ w[p + "attn.o.weight"].T
        h = norm(x, w[p + "norm2.weight"])
        gate = h @ w[p + "ffn.gate.0.weight"].T
        gate = 0.5 * gate * (1 + np.tanh(np.sqrt(2 / np.pi) * (gate + 0.044715 * gate**3)))
        x = x + (gate * (h @ w[p + "ffn.fc1.weight"].T)) @ w[p + "ffn.fc2.weight"].T
    return norm(x, w["norm.weight"])


def test_the_row_is_that_of_the_whole_encoder(tmp_path):
    values = tensors()
    source = sources.open_source(official(tmp_path / umt5.FILE, values))
    told = []
    row = umt5.end_token(source, CFG, progress=lambda done, total: told.append((done, total)))
    assert row.shape == (1, WIDTH) and row.dtype == np.float32
    assert rel_l2(row, whole_encoder(values, [umt5.END])) < 1e-6
    assert told == [(1, DEPTH), (2, DEPTH), (3, DEPTH)]
    two = whole_encoder(values, [umt5.END, 3])  # it matters that the token is alone
    assert rel_l2(row, two[:1]) > 1e-2
    values["blocks.1.attn.v.weight"][0, 0] += 1
    other = sources.open_source(official(tmp_path / "other.pth", values))
    assert rel_l2(umt5.end_token(other, CFG), row) > 1e-3


def test_names_of_transformers(tmp_path):
    values = tensors()
    theirs = dict(zip(shapes(SMALL, DEPTH), shapes(SMALL, DEPTH, theirs=True)))
    renamed = {theirs[key]: value for key, value in values.items()}
    made.save(tmp_path / "text_encoder/model.safetensors", renamed)
    source = sources.open_source(tmp_path / "text_encoder")
    want = umt5.end_token(sources.open_source(official(tmp_path / "a.pth", values)), CFG)
    np.testing.assert_array_equal(umt5.end_token(source, CFG), want)
    copied = renamed | {umt5.COPY: renamed["shared.weight"]}
    made.save(tmp_path / "both/model.safetensors", copied)
    np.testing.assert_array_equal(umt5.end_token(sources.open_source(tmp_path / "both"), CFG), want)
    del copied["shared.weight"]
    made.save(tmp_path / "copy/model.safetensors", copied)
    np.testing.assert_array_equal(umt5.end_token(sources.open_source(tmp_path / "copy"), CFG), want)


def test_memory_holds_rows_of_one_matrix(tmp_path, monkeypatch):
    """Not a layer, and not the file."""
    monkeypatch.setattr(umt5, "ROWS", 64)
    sizes = SMALL | {"d": 256, "a": 256, "f": 2048}
    want = shapes(sizes, 4)
    kinds = dict.fromkeys(want, "BF16")
    file = made.save_headers(tmp_path / "t5.safetensors", want, dtypes=kinds)
    source = sources.open_source(file)
    matrix = 4 * 256 * 2048  # bytes of one in float32; a layer has three of them and more
    tracemalloc.start()
    try:
        row = umt5.end_token(source, DiTConfig(text_dim=256))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert not row.any()  # a sparse file
    assert peak < matrix / 3, peak


def test_the_released_size_is_checked_from_headers(tmp_path):
    """The names and shapes of umT5-xxl: 5,680,910,336 parameters, in a file that takes no disk."""
    want = shapes(FULL, 24)
    assert sum(int(np.prod(shape)) for shape in want.values()) == 5_680_910_336
    kinds = dict.fromkeys(want, "BF16")
    source = sources.open_source(made.save_headers(tmp_path / "t5.safetensors", want, dtypes=kinds))
    umt5.check(source, DiTConfig())
    with pytest.raises(UserError, match=r"has shape \(256384, 4096\) instead of \(256384, 8\)"):
        umt5.check(source, CFG)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.pop("blocks.1.attn.k.weight"), "blocks.1.attn.k.weight is missing"),
        (lambda t: t.pop("norm.weight"), "norm.weight is missing"),
        (
            lambda t: t.update({"blocks.3.x.weight": np.ones(2)}),
            "blocks.3.x.weight is not expected",
        ),
        (
            lambda t: t.update({"blocks.2.ffn.fc2.weight": np.ones((8, 23), np.float32)}),
            r"blocks.2.ffn.fc2.weight has shape \(8, 23\) instead of \(8, 24\)",
        ),
        (
            lambda t: t.update({"blocks.0.norm1.weight": np.ones(8, np.int32)}),
            "blocks.0.norm1.weight has dtype int32",
        ),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, change, said):
    values = tensors()
    change(values)
    made.save(tmp_path / "t5.safetensors", values)
    with pytest.raises(UserError, match=said):
        umt5.check(sources.open_source(tmp_path / "t5.safetensors"), CFG)


def test_what_is_no_encoder_and_what_is_not_finite(tmp_path):
    made.save(tmp_path / "wan.safetensors", {"patch_embedding.weight": np.ones(2, np.float32)})
    with pytest.raises(UserError, match="holds no umT5 encoder"):
        umt5.check(sources.open_source(tmp_path / "wan.safetensors"), CFG)
    values = tensors()
    values["blocks.1.ffn.fc1.weight"][2, 3] = np.inf
    source = sources.open_source(official(tmp_path / "t5.pth", values))
    with pytest.raises(UserError, match=r"t5\.pth: layer 1 holds NaN or infinity"):
        umt5.end_token(source, CFG)


# ---- converting ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The official folder: transformer, VAE, text encoder; and the configuration of these small networks."""
    root = tmp_path_factory.mktemp("wan")
    made.save_sharded(root / "wan", made.dit_tensors()[1])
    made.save(root / "wan" / "Wan2.1_VAE.safetensors", made.vae_tensors()[1])
    official(root / "wan" / umt5.FILE, tensors())
    (root / "config").mkdir()
    record = {"format": 1, "config": to_dict(made.CONFIG)}
    (root / "config" / "config.json").write_text(json.dumps(record))
    return root


def run(files, *more):
    words = ["--wan", files / "wan", "--preset", files / "config", *more]
    convert.main(parse(convert.parser(), [str(word) for word in words]))


def rows_of(folder: Path) -> np.ndarray:
    for file in folder.glob("*.safetensors"):
        source = sources.open_source(file)
        if "prompt/rows" in source.tensors:
            return np.array(source.read("prompt/rows"))
    raise AssertionError(folder)


def test_the_official_folder_makes_its_own_row(files, tmp_path, capsys):
    run(files, "--out", tmp_path / "m")
    want = umt5.end_token(sources.open_source(files / "wan" / umt5.FILE), made.CONFIG.dit)
    np.testing.assert_array_equal(rows_of(tmp_path / "m"), padded(want, made.CONFIG.dit, "x"))
    assert np.abs(want).max() > 0.1 and not rows_of(tmp_path / "m")[1:].any()
    record = json.loads((tmp_path / "m" / "config.json").read_text())["provenance"]
    assert record["prompt"] == f"umT5 of '', from {umt5.FILE}"
    assert "no prompt embedding" not in capsys.readouterr().out
    for given in (files / "wan" / umt5.FILE, files / "wan"):
        run(files, "--t5", given, "--out", tmp_path / given.name)
        np.testing.assert_array_equal(rows_of(tmp_path / given.name), rows_of(tmp_path / "m"))
    np.save(tmp_path / "rows.npy", np.ones((2, 8), np.float32))  # has precedence
    run(files, "--prompt-embedding", tmp_path / "rows.npy", "--out", tmp_path / "given")
    assert (rows_of(tmp_path / "given")[:2] == 1).all()


def test_a_diffusers_folder_makes_its_own_row(files, tmp_path):
    made.save_sharded(tmp_path / "repo/transformer", made.dit_tensors(names="diffusers")[1])
    vae = made.vae_tensors(names="diffusers")[1]
    made.save(tmp_path / "repo/vae/diffusion_pytorch_model.safetensors", vae)
    theirs = dict(zip(shapes(SMALL, DEPTH), shapes(SMALL, DEPTH, theirs=True)))
    values = {theirs[key]: value for key, value in tensors().items()}
    made.save_sharded(tmp_path / "repo/text_encoder", values, stem="model")
    want = padded(
        umt5.end_token(sources.open_source(files / "wan" / umt5.FILE), made.CONFIG.dit),
        made.CONFIG.dit,
        "x",
    )
    for i, given in enumerate(("repo", "repo/transformer")):
        words = [
            "--wan",
            tmp_path / given,
            "--preset",
            files / "config",
            "--out",
            tmp_path / f"{i}",
        ]
        convert.main(parse(convert.parser(), [str(word) for word in words]))
        np.testing.assert_array_equal(rows_of(tmp_path / f"{i}"), want)


def test_nothing_is_read_before_all_is_known(files, tmp_path, monkeypatch):
    """A dry run, and a disk that is too small, are done with before the encoder is."""
    monkeypatch.setattr(umt5, "end_token", lambda *_, **__: pytest.fail("read"))
    run(files, "--dry-run")
    room = importer.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(importer.shutil, "disk_usage", lambda _: room._replace(free=10))
    with pytest.raises(UserError, match="are free"):
        run(files, "--out", tmp_path / "m")
    assert not list(tmp_path.iterdir())


def test_a_prompt_needs_more_than_the_official_file(files, tmp_path, capsys):
    for more, said in (
        (["--prompt", "a cat"], "--prompt 'a cat' needs an encoder to read it"),
        (
            ["--prompt", "a cat", "--t5", files / "wan" / umt5.FILE],
            f"needs umT5's tokenizer beside the encoder: .* {umt5.FILE} alone gives the empty prompt",
        ),
        (["--t5", files / "wan/Wan2.1_VAE.safetensors"], "holds no umT5 encoder"),
    ):
        with pytest.raises(UserError, match=said):
            run(files, *more, "--dry-run")
    made.save(tmp_path / "wan/diffusion_pytorch_model.safetensors", made.dit_tensors()[1])
    vae = made.vae_tensors()[1]
    kept = {key: value.shape for key, value in vae.items()}
    made.save_torch(tmp_path / "wan/Wan2.1_VAE.pth", kept, lambda key, _: vae[key])
    words = ["--wan", tmp_path / "wan", "--preset", files / "config", "--dry-run"]
    convert.main(parse(convert.parser(), [str(word) for word in words]))
    assert f"with {umt5.FILE} beside --wan they are made" in capsys.readouterr().out


# ---- transformers --------------------------------------------------------------------------------


def theirs_and_ours(tmp_path, **sizes):
    """(the last hidden state of the end token by transformers, ours) of a random encoder, both in float32."""
    torch, transformers = pytest.importorskip("torch"), pytest.importorskip("transformers")
    config = transformers.UMT5Config(**sizes, feed_forward_proj="gated-gelu", dropout_rate=0.0)
    torch.manual_seed(0)
    net = transformers.UMT5EncoderModel(config)
    with torch.no_grad():  # its own start has equal gains, and biases that hardly matter
        for name, p in net.named_parameters():
            if p.ndim == 1:
                p.add_(0.3 * torch.randn_like(p))
            elif "relative" in name:
                p.normal_()
    net = net.to(torch.bfloat16).float().eval()
    net.save_pretrained(tmp_path / "text_encoder")
    ids = torch.tensor([[umt5.END] + [0] * 5])
    mask = torch.tensor([[1] + [0] * 5])
    with torch.no_grad():
        alone = net(input_ids=ids[:, :1]).last_hidden_state[0].numpy()
        among = net(input_ids=ids, attention_mask=mask).last_hidden_state[0, :1].numpy()
    assert rel_l2(among, alone) < 1e-6  # as Wan asks: padded, masked, cut to the true length
    source = sources.open_source(tmp_path / "text_encoder")
    return alone, umt5.end_token(source, DiTConfig(text_dim=sizes["d_model"]))


@pytest.mark.parity
@pytest.mark.filterwarnings("ignore")  # of the libraries under test
def test_a_tiny_encoder_equals_transformers(tmp_path):
    sizes = {"vocab_size": 9, "d_model": 32, "d_kv": 8, "num_heads": 4, "d_ff": 80, "num_layers": 3}
    want, ours = theirs_and_ours(tmp_path, **sizes)
    error = rel_l2(ours, want)
    print(f"relative L2 {error:.1e}")
    assert error < 1e-6


@pytest.mark.slow
@pytest.mark.parity
@pytest.mark.filterwarnings("ignore")
def test_a_layer_of_full_width_equals_transformers(tmp_path):
    sizes = {"vocab_size": 9, "d_model": 4096, "d_kv": 64, "num_heads": 64, "d_ff": 10240}
    want, ours = theirs_and_ours(tmp_path, **sizes, num_layers=1)
    error = rel_l2(ours, want)
    print(f"relative L2 {error:.1e}")
    assert error < 1e-5  # sums over 10240 numbers
