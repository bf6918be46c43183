"""Adapters: saving, loading, merging into a standalone model, and the transformer's LoRA for other programs."""

import dataclasses
import json
import stat
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from published_files import CONFIG, random_tree

from roge_jax import checkpoint, export, model
from roge_jax.config import LoraConfig
from roge_jax.core import lora, params
from roge_jax.errors import UserError
from roge_jax.files import folders
from roge_jax.files.entry import parse
from roge_jax.weights import lora_export

SMALL = dataclasses.replace(CONFIG, lora=LoraConfig(dit_rank=3, recon_rank=2))
PROVENANCE = {
    "base": "weights/test",
    "base_provenance": {
        "converted": [{"option": "--lagernvs", "tensors": 3}, {"option": "--wan", "tensors": 9}]
    },
    "stage": "lora",
    "steps": 20,
    "data": "procedural scenes",
    "data_license": "Apache-2.0",
}


@pytest.fixture(scope="module")
def base():
    return params.unflatten(random_tree(model.specs(SMALL), 1))


@pytest.fixture(scope="module")
def adapter():
    """What training changes: LoRA on both halves, E1 and the new embeddings."""
    full, _ = model.split(model.specs(SMALL), model.NEW_EMBEDDINGS)
    specs = params.flatten(full) | params.flatten(model.adapter_specs(SMALL))
    return params.unflatten(
        {p: 0.1 * x for p, x in random_tree(params.unflatten(specs), 2).items()}
    )


def run(*arguments):
    export.main(parse(export.parser(), [str(a) for a in arguments]))


def rights(file: Path) -> int:
    return stat.S_IMODE(file.stat().st_mode)


def usual(folder: Path) -> int:
    """The rights of a new file: others on a shared machine must be able to read what is handed on."""
    file = folder / "usual"
    file.touch()
    found = rights(file)
    file.unlink()
    return found


def test_adapter_there_and_back(adapter, tmp_path):
    checkpoint.save_adapter(tmp_path / "a", adapter, SMALL, PROVENANCE)
    tree, config = checkpoint.load_adapter(tmp_path / "a")
    assert config == SMALL
    want = params.flatten(adapter)
    assert params.flatten(tree).keys() == want.keys()
    for path, value in params.flatten(tree).items():
        np.testing.assert_array_equal(value, want[path], err_msg=path)
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == [
        "README.md",
        "adapter.safetensors",
        "config.json",
    ]
    card = (tmp_path / "a" / "README.md").read_text()
    for words in (
        "license: other",
        "FAIR Noncommercial",
        "Apache-2.0",
        "procedural scenes",
        "Steps: 20",
        "rank 3",
    ):
        assert words in card, words
    assert rights(tmp_path / "a" / "adapter.safetensors") == usual(tmp_path)
    checkpoint.save_adapter(tmp_path / "a", adapter, SMALL)  # replaces it
    assert "not recorded" in (tmp_path / "a" / "README.md").read_text()
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_merged_model_stands_alone(base, adapter, tmp_path, dtype):
    origin = {"converted": [{"option": "--vggt", "tensors": 3}]}
    checkpoint.save_model(tmp_path / "base", base, SMALL, dtype=dtype, provenance=origin)
    checkpoint.save_adapter(tmp_path / "a", adapter, SMALL, PROVENANCE)
    run(tmp_path / "a", "--merge", tmp_path / "base", "--out", tmp_path / "m", "--shard-gb", 1e-3)
    got, config = checkpoint.load_model(tmp_path / "m", dtype=None)
    assert config == SMALL
    flat = params.flatten(adapter)
    factors = params.unflatten({p: jnp.asarray(x) for p, x in flat.items() if "lora_" in p})
    full = {p: x for p, x in flat.items() if "lora_" not in p}
    stored = jax.tree.map(lambda x: jnp.asarray(x, dtype), base)
    want = params.flatten(lora.merge(params.unflatten(params.flatten(stored) | full), factors))
    got = params.flatten(got)
    assert got.keys() == want.keys()
    rounding = 2.0 ** (
        -8 if dtype == jnp.bfloat16 else -21
    )  # half a unit of bfloat16; the order of float32 sums
    for path, value in want.items():
        a, b = np.asarray(got[path], np.float32), np.asarray(value, np.float32)
        if path in full or "/kernel" not in path:
            np.testing.assert_array_equal(a, b, err_msg=path)
        else:
            np.testing.assert_allclose(a, b, rtol=rounding, atol=rounding, err_msg=path)
    changed = np.abs(
        np.asarray(want["dit/blocks/self_attn/q/kernel"])
        - base["dit"]["blocks"]["self_attn"]["q"]["kernel"]
    )
    assert changed.max() > 0.05  # the comparison is not of two unmerged models
    provenance = json.loads((tmp_path / "m" / "config.json").read_text())["provenance"]
    assert provenance["merged"]["steps"] == 20
    assert provenance["base"] == origin  # whose licence holds on, whatever the adapter recorded


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_an_adapter_is_merged_into_its_own_base_and_once(
    base, adapter, tmp_path, dtype, monkeypatch
):
    monkeypatch.setattr(folders, "BLOCK_BYTES", 96)  # so that large leaves are read in blocks
    monkeypatch.setattr(folders, "BLOCKS", 5)
    checkpoint.save_model(tmp_path / "base", base, SMALL, dtype=dtype)
    loaded, _ = checkpoint.load_model(tmp_path / "base")
    record = {"base": "weights/test", "base_weights": checkpoint.weights_fingerprint(loaded)}
    checkpoint.save_adapter(tmp_path / "a", adapter, SMALL, record)
    run(tmp_path / "a", "--merge", tmp_path / "base", "--out", tmp_path / "once")
    with pytest.raises(UserError, match=r"other weights than .* weights/test: give that one"):
        run(tmp_path / "a", "--merge", tmp_path / "once", "--out", tmp_path / "twice")
    assert not list(tmp_path.glob("twice*"))


@pytest.mark.parametrize("style", export.STYLES)
def test_lora_of_the_transformer_for_other_programs(adapter, tmp_path, style, capsys):
    from safetensors.numpy import load_file

    checkpoint.save_adapter(tmp_path / "a", adapter, SMALL)
    (tmp_path / "out.part").mkdir()
    (tmp_path / "out.part/model-00001-of-00009.safetensors").write_bytes(b"of one that was killed")
    run(tmp_path / "a", "--style", style, "--out", tmp_path / "out")
    names = {export.FILES[style]} | ({"adapter_config.json"} if style == "peft" else set())
    assert {file.name for file in (tmp_path / "out").iterdir()} == names
    tensors = load_file(tmp_path / "out" / export.FILES[style])
    back, rest = lora_export.import_lora(tensors, SMALL.dit)
    assert not rest
    assert rights(tmp_path / "out" / export.FILES[style]) == usual(tmp_path)
    want = {p: x for p, x in params.flatten(adapter["dit"]).items() if "lora_" in p}
    back = params.flatten(back)
    assert back.keys() == want.keys()
    for path, value in want.items():
        np.testing.assert_array_equal(back[path], value, err_msg=path)
    assert "retrained first embedding" in capsys.readouterr().out
    if style == "peft":
        record = json.loads((tmp_path / "out" / "adapter_config.json").read_text())
        assert (
            record["r"] == record["lora_alpha"] == 3
            and "blocks.0.attn1.to_q" in record["target_modules"]
        )


def test_what_does_not_fit_is_named(base, adapter, tmp_path):
    checkpoint.save_adapter(tmp_path / "a", adapter, SMALL)
    checkpoint.save_model(tmp_path / "base", base, SMALL)
    with pytest.raises(
        UserError,
        match="Give --video or --points for a finished run; of an adapter one of --merge BASE",
    ):
        run(tmp_path / "a", "--out", tmp_path / "m")
    with pytest.raises(UserError, match="unknown value 'diffuser': did you mean 'diffusers'"):
        run(tmp_path / "a", "--style", "diffuser", "--out", tmp_path / "m")
    with pytest.raises(UserError, match=r"holds no adapter\.safetensors"):
        run(tmp_path / "base", "--merge", tmp_path / "base", "--out", tmp_path / "m")
    with pytest.raises(UserError, match="is an adapter itself"):
        run(tmp_path / "a", "--merge", tmp_path / "a", "--out", tmp_path / "m")
    with pytest.raises(UserError, match=r"is an adapter: `python -m roge_jax\.export"):
        checkpoint.load_model(tmp_path / "a")
    with pytest.raises(UserError, match="exists already"):
        run(tmp_path / "a", "--merge", tmp_path / "base", "--out", tmp_path / "base")
    record = json.loads((tmp_path / "base" / "config.json").read_text())
    for part, name in (("fusion", "geometry_channels"), ("dit", "ffn")):
        record["config"][part][name] //= 2
        (tmp_path / "base" / "config.json").write_text(json.dumps(record))
        with pytest.raises(UserError, match=f"was trained on another '{part}'"):
            run(tmp_path / "a", "--merge", tmp_path / "base", "--out", tmp_path / "m")
    lone = params.flatten(adapter)
    del lone["dit/blocks/ffn/fc1/lora_b"]
    lone["dit/blocks/ffn/fc2/lora_a"] = lone["dit/blocks/ffn/fc2/lora_a"][..., :1]  # of rank 3 in b
    lone["dit/blocks/unknown/bias"] = np.ones(3)
    with pytest.raises(
        UserError,
        match=r"4 mismatches\): dit/blocks/ffn/fc1/lora_a .*fc2/lora_a .*fc2/lora_b .* dit/blocks/unknown/bias",
    ):
        checkpoint.save_adapter(tmp_path / "b", params.unflatten(lone), SMALL)
    content = (tmp_path / "a" / "adapter.safetensors").read_bytes()
    (tmp_path / "a" / "adapter.safetensors").write_bytes(content[:-5])
    with pytest.raises(UserError, match="is truncated or damaged"):
        checkpoint.load_adapter(tmp_path / "a")
    assert not list(tmp_path.glob("m*"))


@pytest.mark.parity
@pytest.mark.filterwarnings("ignore")  # of the libraries under test
def test_peft_loads_the_exported_folder(adapter, tmp_path):
    """peft around a diffusers transformer with the folder loaded equals our merged kernels, weight by weight."""
    diffusers = pytest.importorskip("diffusers")
    peft = pytest.importorskip("peft")
    checkpoint.save_adapter(tmp_path / "a", adapter, SMALL)
    run(tmp_path / "a", "--style", "peft", "--out", tmp_path / "out")
    cfg = SMALL.dit
    net = diffusers.WanTransformer3DModel(
        num_attention_heads=cfg.heads, attention_head_dim=128, in_channels=36, out_channels=16, text_dim=cfg.text_dim,
        freq_dim=cfg.freq_dim, ffn_dim=cfg.ffn, num_layers=cfg.depth, image_dim=cfg.clip_dim,
        added_kv_proj_dim=cfg.width, qk_norm="rms_norm_across_heads",
    )  # fmt: skip
    before = net.blocks[1].ffn.net[2].weight.detach().numpy().copy()
    merged = peft.PeftModel.from_pretrained(net, str(tmp_path / "out")).merge_and_unload()
    change = merged.blocks[1].ffn.net[2].weight.detach().numpy() - before
    factors = adapter["dit"]["blocks"]["ffn"]["fc2"]
    want = (factors["lora_a"][1] @ factors["lora_b"][1]).T
    np.testing.assert_allclose(change, want, rtol=0, atol=2e-7)
