"""Heads: read from a checkpoint where it tells, given where not, and DINOv2's apart from the alternating blocks'."""

import dataclasses
import json

import jax
import numpy as np
import published_files as made
import pytest

from roge_jax import convert
from roge_jax.config import EncoderConfig, from_dict, to_dict
from roge_jax.core import params
from roge_jax.errors import UserError
from roge_jax.files.entry import parse
from roge_jax.recon import vggt
from roge_jax.weights import heads

OTHER = dataclasses.replace(  # 32 channels a head where the released ones have 64
    made.CONFIG,
    encoder=dataclasses.replace(made.CONFIG.encoder, heads=2),
    renderer=dataclasses.replace(made.CONFIG.renderer, heads=2),
)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    root = tmp_path_factory.mktemp("heads")
    made.save(root / "lagernvs.safetensors", made.recon_tensors(OTHER)[1])
    made.save(root / "vggt.safetensors", made.vggt_tensors(OTHER)[1])
    made.save(root / "wan/diffusion_pytorch_model.safetensors", made.dit_tensors()[1])
    made.save(root / "other/diffusion_pytorch_model.safetensors", made.dit_tensors()[1])
    record = {"_class_name": "WanModel", "dim": 128, "num_heads": 4}
    (root / "other/config.json").write_text(json.dumps(record))
    return root


def planned(*words):
    return convert.make_plan(parse(convert.parser(), [str(word) for word in words]))[0].config


def fails(match, *words):
    with pytest.raises(UserError, match=match) as caught:
        planned(*words)
    assert "\n" not in str(caught.value)


def test_norms_of_queries_tell(files):
    cfg = planned("--lagernvs", files / "lagernvs.safetensors")
    assert (cfg.encoder.heads, cfg.renderer.heads) == (2, 2)
    assert cfg.encoder.dino_heads == 1  # which the file does not tell: the released width
    cfg = planned("--lagernvs", files / "lagernvs.safetensors", "--heads", "dino=2")
    assert cfg.encoder.dino_heads is None and heads.of(cfg)["dino"] == 2
    cfg = planned("--lagernvs", files / "lagernvs.safetensors", "--heads", "dino=4", "encoder=2")
    assert heads.of(cfg) == {"dit": 40, "encoder": 2, "dino": 4, "renderer": 2}
    rest = ["--wan", files / "wan", "--random", "vae"]
    cfg = planned("--vggt", files / "vggt.safetensors", *rest)
    assert (cfg.encoder.heads, cfg.renderer.heads, cfg.dit.heads) == (2, 12, 1)


def test_the_transformers_record_tells(files):
    rest = ["--random", "vae"]
    assert planned("--wan", files / "other", *rest).dit.heads == 4
    assert planned("--wan", files / "wan", *rest).dit.heads == 1  # 128 channels a head
    assert planned("--wan", files / "wan", *rest, "--heads", "dit=2").dit.heads == 2
    file = files / "other/diffusion_pytorch_model.safetensors"
    assert planned("--wan", file, *rest).dit.heads == 4


def test_released_files_are_presets_still(files, tmp_path):
    """A preset is found by its numbers, also where the record says what it would be anyway."""
    made.save_listing(tmp_path / "diffusion_pytorch_model.safetensors", "wan21_t2v_1_3b_dit")
    made.save_listing(tmp_path / "lagernvs.safetensors", "lagernvs_encdec_vitb8")
    both = ["--wan", tmp_path, "--lagernvs", tmp_path / "lagernvs.safetensors", "--random", "vae"]
    (tmp_path / "lagernvs").mkdir()
    (tmp_path / "lagernvs.safetensors").rename(tmp_path / "lagernvs/model.safetensors")
    both[3] = tmp_path / "lagernvs"
    record = {"_class_name": "WanModel", "dim": 1536, "num_heads": 12}
    for content in (
        {},
        record,
        {"_class_name": "WanTransformer3DModel", "num_attention_heads": 12},
    ):
        (tmp_path / "config.json").write_text(json.dumps(content))
        cfg = planned(*both)
        assert (cfg.name, cfg.dit.heads, cfg.encoder.dino_heads) == ("wan1.3b", 12, None)
    (tmp_path / "config.json").write_text(json.dumps(record | {"num_heads": 24}))
    cfg = planned(*both)
    assert (cfg.name, cfg.dit.heads) == ("custom", 24)
    fails(
        "has 24 heads in its transformer, and preset 'wan1.3b' has 12", *both, "--preset", "wan1.3b"
    )


def test_mistakes(files, tmp_path):
    lager = ["--lagernvs", files / "lagernvs.safetensors"]
    fails("--heads renderer=1, but .* has 2 heads in its renderer", *lager, "--heads", "renderer=1")
    fails("--heads dit=4: no file fills that network", *lager, "--heads", "dit=4")
    fails("3 heads do not divide the width 64 of the DINOv2", *lager, "--heads", "dino=3")
    fails("--heads dina=3: did you mean 'dino'", *lager, "--heads", "dina=3")
    for word in ("dino", "dino=", "dino=0", "dino=x"):
        fails("give a number of heads, e.g. dino=16", *lager, "--heads", word)
    wan = ["--wan", files / "other", "--random", "vae"]
    fails("--heads dit=2, but .*other has 4 heads in its transformer", *wan, "--heads", "dit=2")
    narrow = dataclasses.replace(made.CONFIG.dit, width=96, heads=3)
    made.save(tmp_path / "wan.safetensors", made.dit_tensors(narrow)[1])
    words = ["--wan", tmp_path / "wan.safetensors", "--random", "vae"]
    fails("does not say how many heads its transformer of width 96 has: give --heads dit=N", *words)
    assert planned(*words, "--heads", "dit=3").dit.heads == 3
    (tmp_path / "config.json").write_text('{"_class_name": "WanModel", "num_heads": 5}')
    fails("5 heads do not divide the width 96 of the transformer", *words)
    (tmp_path / "config.json").write_text("{")
    fails("config.json", *words)


def test_dinos_heads_are_its_own():
    """The patch encoder changes with its own number alone, and the blocks behind it with theirs alone."""
    base = EncoderConfig(width=64, heads=2, depth=1, dino_depth=1, position_grid=2, long_side=None)
    tree = params.init(jax.random.key(0), vggt.encoder_specs(base, 32))
    images = np.random.default_rng(0).random((1, 28, 28, 3), np.float32)

    def tokens(cfg):
        whole, out = jax.jit(lambda p, x: vggt.aggregate(p, x, None, cfg=cfg))(tree, images)
        return whole, out["patch_tokens"]

    whole, patches = tokens(base)
    same = tokens(dataclasses.replace(base, dino_heads=2))
    np.testing.assert_array_equal(same[0], whole)
    other = tokens(dataclasses.replace(base, dino_heads=4))
    assert np.abs(other[1] - patches).max() > 1e-4
    specs = params.flatten(vggt.encoder_specs(dataclasses.replace(base, dino_heads=4), 32))
    want = params.flatten(vggt.encoder_specs(base, 32))
    assert {p: s.shape for p, s in specs.items()} == {p: s.shape for p, s in want.items()}


def test_a_configuration_keeps_them_and_older_ones_have_none():
    cfg = heads.put(made.CONFIG, {"dino": 4, "encoder": 2})
    record = json.loads(json.dumps(to_dict(cfg)))
    assert from_dict(record) == cfg and cfg.encoder.dino_heads == 4
    del record["encoder"]["dino_heads"], record["parts"]
    older = from_dict(record)
    assert older.encoder.dino_heads is None and older.parts == "all"
    for count in (0, 3):
        record["encoder"]["dino_heads"] = count
        with pytest.raises(UserError, match=f"width 64 is not divisible by {count} heads"):
            from_dict(record)
