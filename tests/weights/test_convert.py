"""Import of published checkpoints: layouts, formats, mixtures, bad files and interruption."""

import dataclasses
import itertools
import json
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import zipfile
from pathlib import Path

import ml_dtypes
import numpy as np
import published_files as made
import pytest

from roge_jax import checkpoint, convert, model
from roge_jax.config import to_dict
from roge_jax.core import memory, params
from roge_jax.errors import UserError
from roge_jax.files.entry import parse
from roge_jax.weights import importer, lora_export, prompt, published, shards, sources, wan_dit
from roge_jax.weights.published import RAYS

CONFIG = made.CONFIG
BF16 = ml_dtypes.bfloat16


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """One set of checkpoints: a sharded official DiT with its VAE beside it, LagerNVS, the config as a folder."""
    root = tmp_path_factory.mktemp("published")
    wan = made.save_sharded(root / "wan", made.dit_tensors()[1])
    made.save(root / "wan" / "Wan2.1_VAE.safetensors", made.vae_tensors()[1])
    # The VAE beside the shards must not count as one of them: the index tells.
    made.save(root / "lagernvs.safetensors", made.recon_tensors()[1])
    np.save(root / "prompt.npy", np.ones((2, CONFIG.dit.text_dim), np.float32))
    (root / "config").mkdir()
    record = {"format": 1, "config": to_dict(CONFIG), "provenance": {}}
    (root / "config" / "config.json").write_text(json.dumps(record))
    return {
        "root": root,
        "wan": wan,
        "lagernvs": root / "lagernvs.safetensors",
        "config": root / "config",
    }


def run(*arguments):
    convert.main(parse(convert.parser(), [str(a) for a in arguments]))


def stored(folder: Path):
    """All leaves of a model folder as they are on disk."""
    flat = {}
    for file in sorted(Path(folder).glob("model-*.safetensors")):
        source = sources.open_source(file)
        flat |= {key: np.array(source.read(key)) for key in source.tensors}
    return flat


def everything(files):
    return [
        "--wan", files["wan"], "--lagernvs", files["lagernvs"], "--preset", files["config"],
        "--prompt-embedding", files["root"] / "prompt.npy",
    ]  # fmt: skip


def expected():
    tree = {f"dit/{p}": x for p, x in made.dit_tensors()[0].items()}
    tree |= {f"vae/{p}": x for p, x in made.vae_tensors()[0].items()}
    return tree | made.recon_tensors()[0]


# ---- what is converted ---------------------------------------------------------------------------


def test_official_files_fill_every_leaf_exactly(files, tmp_path, capsys):
    run(*everything(files), "--dtype", "float32", "--out", tmp_path / "m", "--shard-gb", 2e-4)
    got = stored(tmp_path / "m")
    want = expected()
    assert got.keys() == params.flatten(model.specs(CONFIG)).keys()
    for path, value in want.items():
        np.testing.assert_array_equal(got[path], value, err_msg=path)
    np.testing.assert_array_equal(got["prompt/rows"][:2], 1)
    assert not got["prompt/rows"][2:].any() and got["fusion/geometry_adapter/kernel"].std() > 0
    assert len(list((tmp_path / "m").glob("model-*"))) > 3
    assert sorted(p.name for p in (tmp_path / "m").iterdir() if "model-" not in p.name) == [
        "config.json"
    ]
    tree, config = checkpoint.load_model(tmp_path / "m")
    assert config == CONFIG
    np.testing.assert_array_equal(
        tree["dit"]["head"]["linear"]["kernel"], want["dit/head/linear/kernel"]
    )
    record = json.loads((tmp_path / "m" / "config.json").read_text())["provenance"]
    assert record["initialised"] == sorted(p for p in got if p.startswith("fusion/"))
    assert [part["option"] for part in record["converted"]] == ["--wan", "--wan-vae", "--lagernvs"]
    assert record["converted"][2]["notes"] == [
        "ray channels reordered from [o x d, d] to [d, o x d]"
    ]
    assert record["prompt"] == "read from prompt.npy"
    assert "official names" in capsys.readouterr().out


def test_bfloat16_is_for_large_frozen_matrices_alone(files, tmp_path):
    run(*everything(files), "--out", tmp_path / "m")
    want = expected()
    for path, value in stored(tmp_path / "m").items():
        half = path.endswith("/kernel") and path.startswith(
            ("encoder/", "renderer/", "dit/blocks/", "dit/text_embed", "dit/clip_embed")
        )
        assert value.dtype == (BF16 if half else np.float32), path
        if path in want:
            np.testing.assert_array_equal(value, want[path].astype(value.dtype), err_msg=path)
    tree, _ = checkpoint.load_model(tmp_path / "m", dtype=None)
    assert tree["dit"]["blocks"]["ffn"]["fc1"]["kernel"].dtype == BF16
    assert tree["vae"]["quant"]["kernel"].dtype == np.float32


@pytest.mark.parametrize("prefix", ["", "model.diffusion_model."])
def test_diffusers_layout_and_bfloat16_source(files, tmp_path, prefix):
    tree, tensors = made.dit_tensors(names="diffusers")
    tensors = {prefix + k: v.astype(BF16) for k, v in tensors.items()}
    tensors[f"{prefix}blocks.0.attn2.norm_added_q.weight"] = np.ones(
        128, np.float32
    )  # read by nobody
    made.save_sharded(tmp_path / "repo" / "transformer", tensors)
    made.save(
        tmp_path / "repo" / "vae" / "diffusion_pytorch_model.safetensors",
        made.vae_tensors(names="diffusers")[1],
    )
    for place in (tmp_path / "repo", tmp_path / "repo" / "transformer"):
        assert published.find_wan(place)[1] == tmp_path / "repo" / "vae"
    run("--wan", tmp_path / "repo", "--preset", files["config"], "--lagernvs", files["lagernvs"],
        "--dtype", "float32", "--out", tmp_path / "m")  # fmt: skip
    got = stored(tmp_path / "m")
    for path, value in tree.items():
        np.testing.assert_array_equal(
            got[f"dit/{path}"], value.astype(BF16).astype(np.float32), err_msg=path
        )
    for path, value in made.vae_tensors()[0].items():
        np.testing.assert_array_equal(got[f"vae/{path}"], value)


def test_text_to_video_is_widened_with_zeros(tmp_path, capsys):
    """Sizes come from the files here: no preset."""
    tree, tensors = made.dit_tensors(made.T2V)
    made.save(tmp_path / "wan" / "diffusion_pytorch_model.safetensors", tensors)
    run("--wan", tmp_path / "wan", "--random", "encoder", "renderer", "vae", "--dry-run")
    assert "E1 widened from 16 to 36 channels with zeros" in capsys.readouterr().out
    plan, _ = convert.make_plan(
        parse(
            convert.parser(),
            ["--wan", str(tmp_path / "wan"), "--random", "encoder", "renderer", "vae"],
        )
    )
    assert plan.config.dit.in_channels == 36 and not plan.config.dit.clip_dim
    (fill,) = [f for f in plan.fills if f.path == "dit/patch_embed/kernel"]
    kernel = fill.make(fill.source.read(fill.key))
    assert kernel.shape == plan.specs[fill.path].shape
    np.testing.assert_array_equal(kernel[:, :, :16], tree["patch_embed/kernel"])
    assert not kernel[:, :, 16:].any()


def test_vggt_alone_fills_the_aggregator(files, tmp_path):
    tree, tensors = made.vggt_tensors()
    made.save(tmp_path / "model.safetensors", tensors)
    run("--wan", files["wan"], "--vggt", tmp_path / "model.safetensors", "--preset", files["config"],
        "--dtype", "float32", "--out", tmp_path / "m")  # fmt: skip
    got = stored(tmp_path / "m")
    for path, value in tree.items():
        np.testing.assert_array_equal(got[path], value, err_msg=path)
    record = json.loads((tmp_path / "m" / "config.json").read_text())["provenance"]
    initialised = record["initialised"]
    assert record["prompt"] == "none: all rows are zero"
    assert {p for p in initialised if p.startswith("encoder/")} == {
        p for p in got if p.startswith(("encoder/camera_mlp", "encoder/connector"))
    }
    assert {p for p in got if p.startswith("renderer/")} <= set(initialised)
    assert "prompt/rows" in initialised


def test_initialised_leaves_are_those_of_a_fresh_model(files, monkeypatch):
    """One leaf of each kind: the values do not depend on which others there are."""
    import jax

    arguments = [
        "--lagernvs",
        files["lagernvs"],
        "--random",
        "dit",
        "vae",
        "--preset",
        files["config"],
        "--seed",
        5,
    ]
    plan, _ = convert.make_plan(parse(convert.parser(), [str(a) for a in arguments]))
    paths = [
        "dit/blocks/ffn/fc1/kernel",
        "fusion/geometry_adapter/kernel",
        "vae/decoder/conv_in/kernel",
    ]
    chosen = params.unflatten({path: plan.specs[path] for path in paths})
    monkeypatch.setattr(
        model, "specs", lambda config: chosen
    )  # or initialising takes a minute of compiling
    fresh = params.flatten(model.init(jax.random.key(5), CONFIG))
    for path in paths:
        np.testing.assert_array_equal(importer.initial_leaf(path, plan), fresh[path], err_msg=path)
        assert path in plan.initialised and np.std(fresh[path]) > 0


def framecrafter(cfg, seed=7, rank=2):
    rng = np.random.default_rng(seed)
    layers = ("self_attn/q", "ffn/fc1")
    specs = params.flatten(params.abstract(made.dit_specs(cfg)))
    lora = {}
    for layer in layers:
        _, d_in, d_out = specs[f"blocks/{layer}/kernel"].shape
        lora[f"blocks/{layer}/lora_a"] = rng.standard_normal((cfg.depth, d_in, rank), np.float32)
        lora[f"blocks/{layer}/lora_b"] = rng.standard_normal((cfg.depth, rank, d_out), np.float32)
    tensors = lora_export.export_lora(params.unflatten(lora), style="framecrafter")
    embed = rng.standard_normal((cfg.width, 36 + RAYS, 1, 2, 2), np.float32)
    return lora, tensors | {
        "patch_embedding.weight": embed,
        "patch_embedding.bias": np.ones(cfg.width, np.float32),
    }


@pytest.mark.parametrize("dtype", [np.float32, BF16], ids=["float32", "bfloat16"])
def test_framecrafter_is_merged_into_the_transformer(files, tmp_path, dtype):
    """Products of the factors are float32, whatever the file is in: only the factors themselves are rounded."""
    lora, tensors = framecrafter(CONFIG.dit)
    tensors = {key: value.astype(dtype) for key, value in tensors.items()}
    lora = {path: value.astype(dtype).astype(np.float32) for path, value in lora.items()}
    made.save(tmp_path / "fc.safetensors", tensors)
    run(
        *everything(files),
        "--framecrafter",
        tmp_path / "fc.safetensors",
        "--dtype",
        "float32",
        "--out",
        tmp_path / "m",
    )
    got, tree = stored(tmp_path / "m"), made.dit_tensors()[0]
    for layer in ("blocks/self_attn/q", "blocks/ffn/fc1"):
        want = tree[f"{layer}/kernel"] + lora[f"{layer}/lora_a"] @ lora[f"{layer}/lora_b"]
        np.testing.assert_allclose(got[f"dit/{layer}/kernel"], want, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(
        got["dit/blocks/self_attn/k/kernel"], tree["blocks/self_attn/k/kernel"]
    )
    whole = wan_dit.PATCH.to_ours(tensors["patch_embedding.weight"]).astype(np.float32)
    np.testing.assert_array_equal(got["dit/patch_embed/kernel"], whole[:, :, :36])
    np.testing.assert_array_equal(got["dit/patch_embed/bias"], 1)
    # One photo, repeated four times in its slot, is embedded as by FrameCrafter.
    rays = np.random.default_rng(0).standard_normal(RAYS)
    ours = np.einsum("c,hwcd->hwd", np.tile(rays, 4), got["fusion/rays_embed/kernel"])
    np.testing.assert_allclose(
        ours, np.einsum("c,hwcd->hwd", rays, whole[:, :, 36:]), rtol=0, atol=1e-5
    )


def test_a_whole_framecrafter_transformer(files, tmp_path):
    """420 input channels in one complete file, given with --wan."""
    cfg = dataclasses.replace(CONFIG.dit, in_channels=36 + RAYS)
    tree, tensors = made.dit_tensors(cfg)
    made.save(tmp_path / "full.safetensors", tensors)
    arguments = ["--wan", tmp_path / "full.safetensors", "--random", "encoder", "renderer", "vae"]
    plan, _ = convert.make_plan(
        parse(convert.parser(), [*map(str, arguments), "--preset", str(files["config"])])
    )
    values = {
        f.path: f.make(f.source.read(f.key))
        for f in plan.fills
        if "embed" in f.path and f.layer is None
    }
    np.testing.assert_array_equal(
        values["dit/patch_embed/kernel"], tree["patch_embed/kernel"][:, :, :36]
    )
    rays = np.split(values["fusion/rays_embed/kernel"], 4, axis=2)
    np.testing.assert_array_equal(rays[3], tree["patch_embed/kernel"][:, :, 36:] / 4)


def test_a_framecrafter_or_transformer_of_other_sizes_is_named(files, tmp_path):
    plain = ["--preset", files["config"], "--random", "encoder", "renderer", "vae"]
    other = framecrafter(dataclasses.replace(CONFIG.dit, ffn=64))[1]
    made.save(tmp_path / "fc.safetensors", other)
    fails(
        r"blocks\.ffn\.fc1\.lora_b has shape \(3, 2, 64\), which does not fit \(3, 128, 96\)",
        "--wan",
        files["wan"],
        *plain[:2],
        "--framecrafter",
        tmp_path / "fc.safetensors",
        *("--random", "encoder", "renderer"),
    )
    wide = made.dit_tensors(dataclasses.replace(CONFIG.dit, in_channels=40))[1]
    made.save(tmp_path / "wide.safetensors", wide)
    fails(
        "has 40 input channels, where 36 or fewer are needed",
        "--wan",
        tmp_path / "wide.safetensors",
        *plain,
    )


@pytest.mark.parity
@pytest.mark.filterwarnings("ignore")  # of the libraries under test
def test_prompt_rows_from_a_umt5_encoder(tmp_path):
    """A tiny random encoder in a diffusers folder: rows of the true length, zeros behind."""
    torch = pytest.importorskip("torch")
    transformers = pytest.importorskip("transformers")
    tokenizers = pytest.importorskip("tokenizers")
    from roge_jax.weights.prompt import encode_prompt

    words = tokenizers.Tokenizer(
        tokenizers.models.WordLevel({"<pad>": 0, "</s>": 1, "<unk>": 2, "a": 3, "room": 4}, "<unk>")
    )
    words.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    words.post_processor = tokenizers.processors.TemplateProcessing(
        single="$A </s>", special_tokens=[("</s>", 1)]
    )
    fast = transformers.PreTrainedTokenizerFast(
        tokenizer_object=words, eos_token="</s>", pad_token="<pad>", unk_token="<unk>"
    )
    fast.save_pretrained(tmp_path / "tokenizer")
    config = transformers.UMT5Config(
        vocab_size=8,
        d_model=8,
        d_kv=4,
        d_ff=16,
        num_layers=2,
        num_heads=2,
        feed_forward_proj="gated-gelu",
    )
    torch.manual_seed(0)
    net = transformers.UMT5EncoderModel(config).to(torch.bfloat16).float().eval()
    net.save_pretrained(tmp_path / "text_encoder")
    for text, ids in (("", [1]), ("  a\n room &amp;amp; ", [3, 4, 2, 1])):
        rows = encode_prompt(tmp_path, text, CONFIG.dit)
        want = net(input_ids=torch.tensor([ids])).last_hidden_state[0].detach().numpy()
        # The encoder runs in bfloat16 (2^-9 per rounding, a dozen in a row); the reference is float32.
        assert np.linalg.norm(rows[: len(ids)] - want) < 12 * 2.0**-9 * np.linalg.norm(want)
        assert rows.shape == (6, 8) and not rows[len(ids) :].any()
    with pytest.raises(UserError, match="no umT5 encoder and tokenizer there"):
        encode_prompt(tmp_path / "tokenizer", "", CONFIG.dit)


# ---- formats -------------------------------------------------------------------------------------


def test_pytorch_files(files, tmp_path):
    torch = pytest.importorskip("torch")
    tree, tensors = made.recon_tensors()
    state = {
        k: torch.from_numpy(v.view(np.uint16)).view(torch.bfloat16)
        if v.dtype == BF16
        else torch.from_numpy(v)
        for k, v in tensors.items()
    }
    key = "renderer.final_layer.linear.weight"
    state[key] = torch.nn.Parameter(
        state[key].t().contiguous().t()
    )  # a parameter, with other strides
    base = torch.zeros(3, *state["renderer.tgt_norm.weight"].shape)
    base[1] = state["renderer.tgt_norm.weight"]
    state["renderer.tgt_norm.weight"] = base[1]  # a view into a larger storage
    torch.save({"model": state, "step": 3}, tmp_path / "model.pt")
    vae = made.vae_tensors()[1]
    torch.save({k: torch.from_numpy(v) for k, v in vae.items()}, tmp_path / "Wan2.1_VAE.pth")
    run("--wan", files["wan"], "--wan-vae", tmp_path / "Wan2.1_VAE.pth", "--lagernvs", tmp_path / "model.pt",
        "--preset", files["config"], "--dtype", "float32", "--out", tmp_path / "m")  # fmt: skip
    got = stored(tmp_path / "m")
    for path, value in {
        **tree,
        **{f"vae/{p}": x for p, x in made.vae_tensors()[0].items()},
    }.items():
        np.testing.assert_array_equal(got[path], value, err_msg=path)
    torch.save(state, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(UserError, match=r"old\.pt is not a PyTorch zip file"):
        sources.open_source(tmp_path / "old.pt")
    cut = tmp_path / "cut.pt"
    cut.write_bytes((tmp_path / "model.pt").read_bytes()[:-1000])
    with pytest.raises(UserError, match=r"cut\.pt is truncated"):
        sources.open_source(cut)


def pytorch_zip(file: Path, content: bytes, storage: bytes = bytes(64)) -> Path:
    """As PyTorch writes it: storages begin at multiples of 64 bytes, padded in their local headers."""
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", content)
        info = zipfile.ZipInfo("archive/data/0")
        info.extra = b"FB" + (20).to_bytes(2, "little") + b"Z" * 20
        archive.writestr(info, storage)
    return file


@pytest.mark.parametrize("wrapper", [None, "model", "state_dict"])
def test_pytorch_files_without_pytorch(tmp_path, wrapper):
    tensors = made.recon_tensors()[1]
    kinds = {k: "BF16" for k, v in tensors.items() if v.dtype == BF16}
    shapes = {k: v.shape for k, v in tensors.items()}
    file = made.save_torch(tmp_path / "m.pt", shapes, lambda k, _: tensors[k], wrapper, kinds)
    source = sources.open_source(file)
    assert source.shapes == shapes
    for key, value in tensors.items():
        np.testing.assert_array_equal(source.read(key), value, err_msg=key)
        assert source.read(key).dtype == value.dtype


@pytest.mark.parity
def test_pytorch_reads_the_files_that_these_tests_write(tmp_path):
    torch = pytest.importorskip("torch")
    tensors = made.vae_tensors()[1]
    shapes = {k: v.shape for k, v in tensors.items()}
    file = made.save_torch(tmp_path / "m.pth", shapes, lambda k, _: tensors[k], "model")
    state = torch.load(file, weights_only=True)["model"]
    assert state.keys() == tensors.keys()
    for key, value in tensors.items():
        np.testing.assert_array_equal(state[key].numpy(), value, err_msg=key)


def tensor_pickle(shape: str, strides: str, start=0, kind="Float", count=16, typed="") -> bytes:
    """A PyTorch pickle of {"w": tensor of storage 0}, written opcode by opcode; `typed`: of a kind younger than typed
    storages, whose storage counts bytes."""
    storage = f"(Vstorage\nctorch\n{kind}Storage\nV0\nVcpu\nI{count}\ntQ".encode()
    arguments = b"(" + storage + f"I{start}\n{shape}{strides}".encode() + b"I00\n}"
    arguments += f"ctorch\n{typed}\n".encode() if typed else b""
    rebuild = "_rebuild_tensor_v3" if typed else "_rebuild_tensor_v2"
    return f"}}Vw\nctorch._utils\n{rebuild}\n".encode() + arguments + b"tRs."


KINDS = [  # name of the storage, the tensor's own if it is another, elements of 64 bytes as the storage counts them
    ("Double", "", np.float64, 8),
    ("Float", "", np.float32, 16),
    ("BFloat16", "", BF16, 32),
    ("Half", "", np.float16, 32),
    ("Untyped", "uint16", np.uint16, 64),
]


@pytest.mark.parametrize(("kind", "typed", "dtype", "count"), KINDS)
def test_pytorch_pickle_by_hand(tmp_path, kind, typed, dtype, count):
    """Values begin behind the padding, at an element of the tensor's own size, and none lies outside."""
    n = 64 // np.dtype(dtype).itemsize
    values = np.arange(n).astype(dtype)
    more = {"kind": kind, "typed": typed, "count": count}
    content = tensor_pickle("(I2\nI3\nt", "(I1\nI2\nt", 1, **more)
    source = sources.open_source(pytorch_zip(tmp_path / "a.pt", content, values.tobytes()))
    found = source.read("w")
    assert source.shapes == {"w": (2, 3)} and found.dtype == dtype
    np.testing.assert_array_equal(found, values[1:7].reshape(3, 2).T)
    for shape, strides, start in (
        ("(I2\nI9\nt", "(I9\nI1\nt", n - 17),
        ("(I4\nt", "(I1\nt", n - 3),
        ("(I4\nt", "(I-1\nt", n - 4),
    ):
        with pytest.raises(UserError, match="reaches outside its storage"):
            content = tensor_pickle(shape, strides, start, **more)
            sources.open_source(pytorch_zip(tmp_path / "b.pt", content, values.tobytes()))


@pytest.mark.parametrize(
    "call",
    [(os.system, ("touch {mark}",)), (eval, ("open('{mark}', 'w')",)), (getattr, (os, "sep"))],
)
def test_a_pickle_cannot_execute_code(tmp_path, call):
    mark = tmp_path / "executed"
    function, arguments = call

    class Attack:
        def __reduce__(self):
            return function, tuple(
                a.format(mark=mark) if isinstance(a, str) else a for a in arguments
            )

    try:
        content = pickle.dumps({"w": Attack()}, protocol=2)
    except TypeError:  # modules cannot be pickled: name the function alone
        content = pickle.dumps({"w": function}, protocol=2)
    file = pytorch_zip(tmp_path / "model.pt", content)
    with pytest.raises(UserError, match=r"model\.pt tries to execute code: it asks for"):
        sources.open_source(file)
    assert not mark.exists()
    with pytest.raises(UserError, match="cannot be read"):
        sources.open_source(pytorch_zip(tmp_path / "model.pt", b"nonsense"))


@pytest.mark.parametrize(
    "name", ["ComplexFloatStorage", "QInt8Storage", "float8_e5m2fnuz", "complex64"]
)
def test_other_kinds_of_numbers_are_no_attack(tmp_path, name):
    file = pytorch_zip(tmp_path / "model.pt", f"ctorch\n{name}\n.".encode())
    with pytest.raises(UserError, match=f"tensors of type {name.removesuffix('Storage')}, which"):
        sources.open_source(file)


# ---- writing -------------------------------------------------------------------------------------


def test_large_leaves_are_written_in_blocks_and_tiles(tmp_path, monkeypatch):
    """Layers in any order, transposed as the published matrices are, and none of the sizes divides another."""
    monkeypatch.setattr(shards, "BLOCK_BYTES", 1000)
    monkeypatch.setattr(shards, "TILE", 8)
    rng = np.random.default_rng(0)
    leaves = {
        "a/kernel": rng.standard_normal((3, 50, 37), np.float32).astype(BF16),
        "b/kernel": rng.standard_normal((41, 29), np.float32),
        "c/scale": rng.standard_normal(900, np.float32),
    }
    layout = shards.plan_shards({p: (x.shape, x.dtype) for p, x in leaves.items()}, 7000)
    files = shards.Shards(tmp_path, layout)
    for layer in (2, 0, 1):
        files.write("a/kernel", np.asfortranarray(leaves["a/kernel"][layer]), layer)
    files.write("b/kernel", np.asfortranarray(leaves["b/kernel"]))
    files.write("c/scale", leaves["c/scale"])
    bad = leaves["c/scale"].copy()
    bad[-1] = np.nan
    with pytest.raises(FloatingPointError):
        files.write("c/scale", bad)
    files.close()
    assert len(layout.sizes) > 1
    got = stored(tmp_path)
    for path, value in leaves.items():
        np.testing.assert_array_equal(got[path], value, err_msg=path)


# ---- bad input -----------------------------------------------------------------------------------


def fails(match, *arguments):
    with pytest.raises(UserError, match=match) as caught:
        run(*arguments, "--dry-run")
    assert "\n" not in str(caught.value)


def test_wrong_family(files, tmp_path):
    wan, lagernvs, preset = files["wan"], files["lagernvs"], ["--preset", files["config"]]
    fails(r"lagernvs\.safetensors holds LagerNVS .* but --wan takes", "--wan", lagernvs)
    fails(r"wan holds a Wan transformer .* but --lagernvs takes", "--lagernvs", wan)
    fails(r"holds LagerNVS .* but --vggt takes VGGT-1B", "--vggt", lagernvs)
    fails(
        r"holds LagerNVS .* --wan-vae takes the Wan2.1 VAE",
        "--wan",
        wan,
        "--wan-vae",
        lagernvs,
        "--lagernvs",
        lagernvs,
        *preset,
    )
    fails(r"--framecrafter takes FrameCrafter's LoRA", "--wan", wan, "--framecrafter", lagernvs)
    made.save(
        tmp_path / "t5.safetensors", {"encoder.embed_tokens.weight": np.ones((2, 2), np.float32)}
    )
    fails("holds a T5 text encoder", "--wan", tmp_path / "t5.safetensors")
    fails(
        "width 128 with 3 blocks, and preset 'wan1.3b' has 1536",
        "--wan",
        wan,
        "--preset",
        "wan1.3b",
    )
    fails("Unknown preset 'papr': did you mean 'paper'", "--wan", wan, "--preset", "papr")
    fails(
        "has no DINOv2 patch encoder",
        "--lagernvs",
        lagernvs,
        "--random",
        "dit",
        "vae",
        "--preset",
        "tiny",
    )


def test_missing_parts(files, tmp_path):
    wan = files["wan"]
    half = ["--wan", wan, "--random", "encoder"]
    fails("Nothing fills renderer: give --lagernvs", *half)
    fails(
        "--random dit, but a file fills it", "--wan", wan, "--random", "dit", "encoder", "renderer"
    )
    fails("--framecrafter holds changes", "--framecrafter", wan)
    fails("does not exist", "--wan", tmp_path / "nowhere.safetensors")
    (tmp_path / "empty").mkdir()
    fails(r"empty holds no weights \(it is empty\): give the folder", "--wan", tmp_path / "empty")
    with pytest.raises(UserError, match="No --out given"):
        run("--wan", wan)


POINTER = (
    "version https://git-lfs.github.com/spec/v1\n"
    "oid sha256:38071ab59bd94681c686fa51d75a1968f64e470262043be31f7a094e442fd981\nsize 507609880\n"
)


def test_downloads_that_are_not_whole(files, tmp_path):
    """What lies there in place of weights is named, with the command that gets them."""
    for name in ("diffusion_pytorch_model.safetensors", "model.pt"):
        option = "--lagernvs" if name == "model.pt" else "--wan"
        file = tmp_path / "pointers" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(POINTER)
        fails(rf"{name} is a Git LFS pointer and not the weights .*`git lfs pull`", option, file)
        file.write_text("<!DOCTYPE html>\n<html><body>Log in</body></html>" + " " * 100)
        fails(rf"{name} is a web page and no weights, .*`hf auth login`", option, file)
    folder = tmp_path / "Wan2.1-T2V-1.3B"
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    command = "hf download Wan-AI/Wan2.1-T2V-1.3B --include config.json --include "
    fails(rf"holds no weights \(only config.json\): download it with `{command}", "--wan", folder)
    unfinished = folder / ".cache/huggingface/download/abc.incomplete"
    unfinished.parent.mkdir(parents=True)
    unfinished.write_bytes(b"12")
    fails(f"download was not finished.: go on with it by `{command}", "--wan", folder)
    made.save_torch(folder / "Wan2.1_VAE.pth", {"a": (2,)}, lambda *_: np.zeros(2))
    fails(
        f"has Wan2.1_VAE.pth, but no transformer .*: download it with `{command}", "--wan", folder
    )
    lager = tmp_path / "lagernvs_general_512"
    lager.mkdir()
    (lager / "README.md").write_text("a card")
    said = "holds no weights .only README.md.: ask for access on https://huggingface.co/facebook/lagernvs_general_512"
    fails(said, "--lagernvs", lager)
    snapshot = tmp_path / "models--facebook--VGGT-1B/snapshots/12"
    snapshot.mkdir(parents=True)
    (tmp_path / "models--facebook--VGGT-1B/blobs").mkdir()
    (tmp_path / "models--facebook--VGGT-1B/blobs/34.incomplete").write_bytes(b"12")
    fails("not finished.: go on with it by `hf download facebook/VGGT-1B", "--vggt", snapshot)


def test_missing_shard_and_truncated_file(files, tmp_path):
    tensors = made.dit_tensors()[1]
    folder = made.save_sharded(tmp_path / "wan", tensors)
    second = folder / "diffusion_pytorch_model-00002-of-00003.safetensors"
    content = second.read_bytes()
    second.unlink()
    fails("diffusion_pytorch_model-00002-of-00003.safetensors missing", "--wan", folder)
    (folder / "diffusion_pytorch_model.safetensors.index.json").rename(tmp_path / "index")
    fails("shard 2 of 3 is missing", "--wan", folder)
    for other in ("other-00002-of-00003", "diffusion_pytorch_model-00002-of-00002"):
        made.save(folder / f"{other}.safetensors", {"a": np.ones(2, np.float32)})
        fails("holds more than one checkpoint", "--wan", folder)
        (folder / f"{other}.safetensors").unlink()
    made.save(tmp_path / "one/best-of-luck.safetensors", {"a": np.ones(2, np.float32)})
    assert sources.open_source(tmp_path / "one").shapes == {"a": (2,)}
    (tmp_path / "index").rename(folder / "diffusion_pytorch_model.safetensors.index.json")
    second.write_bytes(content[:-10])
    fails(r"00002-of-00003\.safetensors is truncated: .* tensor '.*' is cut off", "--wan", folder)
    second.write_bytes(content[:100])
    fails("truncated", "--wan", folder)
    second.write_bytes(b"")
    fails("not a safetensors file", "--wan", folder)
    second.write_bytes(content + bytes(12))
    fails("00002-of-00003.safetensors has 12 bytes behind its last tensor", "--wan", folder)
    made.save(second, {"patch_embedding.weight": np.ones(2, np.float32)})
    fails(r"00002-of-00003.safetensors lacks tensor", "--wan", folder)


def test_a_tensor_in_two_shards_is_that_of_the_index(tmp_path):
    """A shard of another version beside the right one: the index says which of the two files has the tensor."""
    for first in (True, False):
        folder = made.save_sharded(tmp_path / str(first), made.dit_tensors()[1])
        index = json.loads((folder / "diffusion_pytorch_model.safetensors.index.json").read_text())
        files = sorted(set(index["weight_map"].values()))
        right, wrong = (files[0], files[-1]) if first else (files[-1], files[0])
        key = next(key for key, file in index["weight_map"].items() if file == right)
        other = sources.open_source(folder / wrong)
        tensors = {k: np.array(other.read(k)) for k in other.tensors}
        made.save(folder / wrong, tensors | {key: np.full((2, 2), 7, np.float32)})
        found = sources.open_source(folder)
        assert found.tensors[key].file.name == right
        assert found.tensors.keys() == index["weight_map"].keys()


def test_all_mismatches_are_in_one_error(files, tmp_path):
    tensors = made.dit_tensors()[1]
    for i in range(3):
        del tensors[f"blocks.{i}.norm3.bias"]
    del tensors["blocks.1.ffn.2.weight"]
    tensors["vace_blocks.0.weight"] = np.ones(3, np.float32)
    tensors["head.head.bias"] = np.ones(5, np.float32)
    tensors["blocks.2.self_attn.q.weight"] = np.ones((128, 128), np.int32)
    tensors["blocks.2.self_attn.k.weight"] = np.ones((128, 128), ml_dtypes.float8_e4m3fn)  # scaled
    tensors["blocks.0.ffn.0.weight"] = np.ascontiguousarray(tensors["blocks.0.ffn.0.weight"].T)
    made.save(tmp_path / "wan.safetensors", tensors)
    recon = made.recon_tensors()[1]
    del recon["renderer.tgt_norm.weight"]
    made.save(tmp_path / "lagernvs.safetensors", recon)
    with pytest.raises(UserError) as caught:
        run("--wan", tmp_path / "wan.safetensors", "--lagernvs", tmp_path / "lagernvs.safetensors",
            "--random", "vae", "--preset", files["config"], "--dry-run")  # fmt: skip
    text = str(caught.value)
    assert text.startswith("10 tensors do not fit")
    for line in (
        "blocks.{0..2}.norm3.bias is missing",
        "blocks.1.ffn.2.weight is missing",
        "vace_blocks.0.weight is not expected",
        "head.head.bias has shape (5,) instead of (64,)",
        "blocks.2.self_attn.q.weight has dtype int32",
        "blocks.2.self_attn.k.weight has dtype float8_e4m3fn",
        "blocks.0.ffn.0.weight has shape (128, 96) instead of (96, 128)",
        "renderer.tgt_norm.weight is missing",
        "wan.safetensors: ",
        "lagernvs.safetensors: ",
    ):
        assert line in text, line


def test_output_and_disk(files, tmp_path, monkeypatch):
    (tmp_path / "m").mkdir()
    (tmp_path / "m" / "mine.txt").write_text("x")
    with pytest.raises(UserError, match="exists already"):
        run(*everything(files), "--out", tmp_path / "m")
    usage = importer.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(importer.shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(UserError, match=r"needs 0\.0\d GB at .*, where 0\.00 GB are free"):
        run(*everything(files), "--out", tmp_path / "new")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m"]


def test_a_full_disk_leaves_nothing(files, tmp_path, monkeypatch):
    def full(file, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shards, "_write_all", full)
    with pytest.raises(UserError, match="disk is full"):
        run(*everything(files), "--out", tmp_path / "m")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(2, 7), (7, 8), (0, 8)])
def test_prompt_embedding_of_wrong_shape(files, tmp_path, shape):
    np.save(tmp_path / "p.npy", np.ones(shape, np.float32))
    fails("prompt embedding of shape", *everything(files)[:-1], tmp_path / "p.npy")


def test_prompt_rows_and_words_that_are_no_use(files, tmp_path):
    rows = np.ones((2, CONFIG.dit.text_dim), np.float32)
    rows[1, 3] = np.inf
    np.save(tmp_path / "p.npy", rows)
    fails("the prompt embedding is not finite", *everything(files)[:-1], tmp_path / "p.npy")
    assert prompt.cleaned("  a\n\t room &amp;amp; &lt;more ") == "a room & <more"


def t5_folder(folder: Path, without: str = "") -> Path:
    """A diffusers folder that looks like umT5, of which nothing can be read."""
    parts = {
        "text_encoder/config.json": '{"model_type": "umt5"}',
        "text_encoder/model.safetensors": None,
        "tokenizer/tokenizer.json": "{}",
    }
    for name, content in parts.items():
        if name != without:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            if content is None:
                made.save_headers(folder / name, {"shared.weight": (1000, 2)})
            else:
                (folder / name).write_text(content)
    return folder


def test_a_text_encoder_that_memory_does_not_hold(files, tmp_path, monkeypatch):
    plain, t5 = everything(files)[:-2], t5_folder(tmp_path / "t5")
    asked = [*plain, "--t5", t5, "--prompt", "a cat"]
    for free, fits in ((4000.0, True), (3999.0, False)):  # 2000 values in bfloat16
        monkeypatch.setattr(memory, "memory_available", lambda free=free: free)
        if fits:
            run(*asked, "--dry-run")
        else:
            fails("for the text encoder alone: close other programs", *asked)
    (t5 / "text_encoder/model.safetensors").write_bytes(b"cut")
    fails(r"model\.safetensors is not a safetensors file", *asked)


def test_options_of_the_prompt_that_would_be_ignored(files, tmp_path, capsys):
    plain, t5 = everything(files)[:-2], t5_folder(tmp_path / "t5")
    cat = ["--prompt", "a cat"]
    fails("--prompt 'a cat' needs an encoder", *plain, *cat)
    fails("--prompt 'a cat' needs an encoder", *everything(files), *cat)
    fails("both give the prompt: leave one", *everything(files), "--t5", t5)
    fails("nowhere does not exist", *plain, "--t5", tmp_path / "nowhere")
    fails("no umT5 encoder and tokenizer there", *plain, "--t5", tmp_path / "nowhere", *cat)
    for i, lost in enumerate(("config.json", "model.safetensors", "tokenizer.json")):
        name = f"{'tokenizer' if 'tokenizer' in lost else 'text_encoder'}/{lost}"
        part = t5_folder(tmp_path / f"{i}", without=name)
        fails("no umT5 encoder and tokenizer there", *plain, "--t5", part, *cat)
    (t5 / "text_encoder/config.json").write_text('{"model_type": "bert"}')
    fails("is of model type bert", *plain, "--t5", t5, *cat)
    capsys.readouterr()
    run(*plain, "--t5", t5_folder(tmp_path / "good"), *cat, "--dry-run")
    assert "no prompt embedding" not in capsys.readouterr().out


@pytest.mark.parametrize("dtype", ["bfloat16", "float32"])
def test_values_that_are_not_finite_are_named_and_nothing_is_written(files, tmp_path, dtype):
    bad = [("blocks.1.ffn.0.weight", np.nan), ("blocks.2.norm3.bias", -np.inf)]
    if dtype == "bfloat16":  # finite as it is stored, and rounded to infinity
        bad.append(("blocks.1.ffn.0.weight", 3.4e38))
    for key, value in bad:
        tensors = made.dit_tensors()[1]
        tensors[key] = np.array(tensors[key])
        tensors[key].flat[-1] = value
        made.save(tmp_path / "wan/bad.safetensors", tensors)
        given = ["--wan", tmp_path / "wan/bad.safetensors", "--preset", files["config"]]
        given += ["--random", "vae", "encoder", "renderer", "--dtype", dtype]
        with pytest.raises(UserError, match=rf"bad\.safetensors: {key} holds NaN or infinity"):
            run(*given, "--out", tmp_path / "m")
    assert [p.name for p in tmp_path.iterdir()] == ["wan"]


# ---- interruption --------------------------------------------------------------------------------


KILLED = """
    import os, signal, sys
    from roge_jax import convert
    from roge_jax.files.entry import parse
    from roge_jax.weights import importer, shards

    importer.FLUSH_BYTES = 100_000
    write, count = shards.Shards.write, 0

    def counted(self, path, value, layer=None):
        global count
        count += 1
        if count == 60:
            os.kill(os.getpid(), signal.SIGKILL)
        write(self, path, value, layer)

    shards.Shards.write = counted
    convert.main(parse(convert.parser(), sys.argv[1:]))
"""


def test_a_killed_conversion_resumes_to_the_same_files(files, tmp_path, monkeypatch):
    arguments = [*everything(files), "--shard-gb", "0.0005"]
    run(*arguments, "--out", tmp_path / "whole")
    killed = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(KILLED), *map(str, arguments), "--out", str(tmp_path / "m")],
        cwd=tmp_path, env=os.environ | {"XLA_FLAGS": ""}, capture_output=True,
    )  # fmt: skip
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()[-2000:]
    assert not (tmp_path / "m").exists()
    done = int((tmp_path / "m.part" / importer.PROGRESS).read_text())
    assert 0 < done < 60
    with pytest.raises(UserError, match="was begun with another 'dtype'"):
        run(
            *arguments,
            "--out",
            tmp_path / "m",
            "--dtype",
            "float32",
            "--shard-gb",
            "0.0005",
            "--resume",
        )
    written = []
    write = shards.Shards.write

    def counted(self, path, value, layer=None):
        written.append(path)
        write(self, path, value, layer)

    monkeypatch.setattr(shards.Shards, "write", counted)
    run(*arguments, "--out", tmp_path / "m", "--resume")
    plan, _ = convert.make_plan(parse(convert.parser(), [str(a) for a in arguments]))
    assert len(written) == len(plan.fills) + len(plan.given) + len(plan.initialised) - done
    names = sorted(p.name for p in (tmp_path / "whole").iterdir())
    assert sorted(p.name for p in (tmp_path / "m").iterdir()) == names
    for name in names:
        assert (tmp_path / "m" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), (
            name
        )


def test_what_a_note_says_is_done_is_on_the_disk(files, tmp_path, monkeypatch):
    """Or a loss of power leaves holes in a file that a resumed conversion takes for written."""
    plan, _ = convert.make_plan(parse(convert.parser(), [str(a) for a in everything(files)]))
    monkeypatch.setattr(importer, "FLUSH_BYTES", 300_000)
    order: list[str] = []

    def noted(name, call):
        def spy(*arguments, **more):
            order.append(name)
            return call(*arguments, **more)

        return spy

    monkeypatch.setattr(os, "fsync", noted("sync", os.fsync))
    monkeypatch.setattr(shards.Shards, "write", noted("write", shards.Shards.write))
    monkeypatch.setattr(os, "replace", noted("note", os.replace))
    importer.write(plan, tmp_path / "m", shard_bytes=500_000)
    files_of_it = len(plan.layout(500_000).sizes)
    notes = [i for i, what in enumerate(order) if what == "note"][:-1]  # the last names the folder
    assert len(notes) > 2 and files_of_it > 1
    for i in notes:
        assert order[i - files_of_it : i] == ["sync"] * files_of_it, order[:i]


def test_a_conversion_is_resumed_with_the_same_files_and_options_alone(files, tmp_path):
    """Also where all sizes are the same: half of one prompt, seed or file and half of another make no model."""
    plan, _ = convert.make_plan(parse(convert.parser(), [str(a) for a in everything(files)]))

    def interrupt(done, total):
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        importer.write(plan, tmp_path / "m", progress=interrupt)
    other = dataclasses.replace(CONFIG, flow=dataclasses.replace(CONFIG.flow, photometric=0.5))
    swapped = [plan.fills[0]._replace(key=plan.fills[1].key), *plan.fills[1:]]
    for name, changed in (
        ("seed", plan._replace(seed=1)),
        ("given", plan._replace(given={p: x + 1 for p, x in plan.given.items()})),
        ("dtype", plan._replace(half=False)),
        ("config", plan._replace(config=other)),
        ("pieces", plan._replace(fills=swapped)),
    ):
        with pytest.raises(UserError, match=f"was begun with another '{name}'"):
            importer.write(changed, tmp_path / "m", resume=True)
    file = plan.fills[-1].source.files[0]
    times = file.stat().st_atime_ns, file.stat().st_mtime_ns
    try:
        os.utime(file, ns=(times[0], times[1] + 1_000_000))  # written again, of the same size
        with pytest.raises(UserError, match="was begun with another 'files'"):
            importer.write(plan, tmp_path / "m", resume=True)
    finally:
        os.utime(file, ns=times)
    importer.write(plan, tmp_path / "m", resume=True)


def test_an_interrupt_keeps_what_is_done(files, tmp_path):
    plan, _ = convert.make_plan(parse(convert.parser(), [str(a) for a in everything(files)]))
    calls = []

    def interrupt(done, total):
        calls.append(done)
        if len(calls) == 30:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        importer.write(plan, tmp_path / "m", progress=interrupt)
    assert (tmp_path / "m.part" / importer.PROGRESS).read_text() == "29"
    calls.clear()
    importer.write(
        plan, tmp_path / "m", resume=True, progress=lambda done, total: calls.append((done, total))
    )
    assert (tmp_path / "m" / "config.json").exists() and not (
        tmp_path / "m" / importer.PLAN
    ).exists()
    assert all(a[0] < b[0] <= b[1] for a, b in itertools.pairwise(calls))


def test_a_mistake_is_one_line_and_code_two(files, tmp_path, capsys):
    from roge_jax.files.entry import execute

    code = execute(
        convert.main,
        convert.parser(),
        ["--wan", str(files["lagernvs"]), "--out", str(tmp_path / "m")],
    )
    printed = capsys.readouterr()
    assert code == 2 and printed.err.count("\n") == 1 and printed.err.startswith("error: ")
    assert "Traceback" not in printed.err and not list(tmp_path.iterdir())


def test_without_resume_it_starts_over(files, tmp_path):
    part = tmp_path / "m.part"
    part.mkdir()
    (part / "model-00009-of-00009.safetensors").write_bytes(b"left over")
    run(*everything(files), "--out", tmp_path / "m")
    assert not part.exists() and not (tmp_path / "m" / "model-00009-of-00009.safetensors").exists()
