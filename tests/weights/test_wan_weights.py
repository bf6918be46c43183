"""Weight maps and LoRA export of the transformer: names and counts of the released models, and PyTorch as oracle."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parity import key_listing, rel_l2

from roge_jax.config import DiTConfig, LoraConfig, preset
from roge_jax.core import lora, params
from roge_jax.errors import UserError
from roge_jax.video import dit as net
from roge_jax.weights import lora_export, mapping, wan_dit

I2V, T2V_14B = DiTConfig(), DiTConfig(in_channels=16, clip_dim=0)
T2V_1_3B = DiTConfig(width=1536, heads=12, depth=30, ffn=8960, in_channels=16, clip_dim=0)
RELEASED = [
    ("wan21_i2v_14b_dit", I2V, 16_394_878_784),
    ("wan21_t2v_1_3b_dit", T2V_1_3B, 1_418_996_800),
    ("wan21_t2v_14b_dit", T2V_14B, 14_288_491_584),
]
# Heads of 24 channels: 8 for time, rows and columns each.
TINY = DiTConfig(
    width=48,
    heads=2,
    depth=2,
    ffn=64,
    freq_dim=16,
    text_dim=8,
    text_len=512,
    clip_dim=12,
    clip_rows=4,
)


@pytest.mark.parametrize(("listing", "cfg", "count"), RELEASED)
@pytest.mark.parametrize("names", ["official", "diffusers"])
def test_every_released_tensor_fills_one_leaf(listing, cfg, count, names):
    specs = net.dit_specs(cfg)
    assert params.count(specs) == count
    entries = wan_dit.dit_entries(cfg, names=names)
    assert [e.path for e in entries] == list(params.flatten(specs))
    column = f"{names} key"
    want = {row[column]: row["shape"] for row in key_listing(listing)}
    assert mapping.source_shapes(entries, specs) == want
    assert sum(len(e.keys) for e in entries) == len(want)
    assert wan_dit.dit_config(want) == cfg
    assert wan_dit.naming(want) == names


@pytest.mark.parametrize(("listing", "cfg"), [row[:2] for row in RELEASED])
def test_both_names_of_a_tensor_lead_to_the_same_leaf(listing, cfg):
    """Queries and keys, say, have one shape: only the listing tells which of their names belong together."""
    ours, theirs = (
        [
            (e.path, i, key)
            for e in wan_dit.dit_entries(cfg, names=names)
            for i, key in enumerate(e.keys)
        ]
        for names in ("official", "diffusers")
    )
    pairs = {row["official key"]: row["diffusers key"] for row in key_listing(listing)}
    assert len(pairs) == len(set(pairs.values())) == len(ours)
    assert [(path, i, pairs[key]) for path, i, key in ours] == theirs


def test_counts_of_the_presets_and_of_their_lora():
    paper, wan = preset("paper").dit, preset("wan1.3b").dit
    assert paper == I2V
    assert (
        params.count(net.dit_specs(wan)) == 1_418_996_800 + 4 * 20 * 1536
    )  # 20 more input channels
    specs = lora.lora_specs(net.dit_specs(paper), LoraConfig().dit_rank, LoraConfig().dit_match)
    assert params.count(specs) == 153_354_240
    assert (
        len(params.flatten(specs)) == 2 * 10
    )  # q, k, v, o twice, fc1, fc2; all 40 blocks in each leaf
    assert not [path for path in params.flatten(specs) if "_img" in path]


def random_source(cfg, names="official", seed=0):
    rng = np.random.default_rng(seed)
    shapes = mapping.source_shapes(wan_dit.dit_entries(cfg, names=names), net.dit_specs(cfg))
    return {
        key: (rng.standard_normal(s) / np.sqrt(np.prod(s[1:]))).astype(np.float32)
        + np.float32(len(s) == 1 and key.endswith("weight"))
        for key, s in shapes.items()
    }


def test_conversion_there_and_back_is_exact():
    entries, tensors = wan_dit.dit_entries(TINY), random_source(TINY)
    tree = mapping.to_ours(entries, tensors)
    params.check(tree, net.dit_specs(TINY))
    back = mapping.to_theirs(entries, tree)
    assert back.keys() == tensors.keys()
    for key, value in tensors.items():
        np.testing.assert_array_equal(back[key], value, err_msg=key)
    np.testing.assert_array_equal(
        tree["blocks"]["ffn"]["fc1"]["kernel"][1], tensors["blocks.1.ffn.0.weight"].T
    )


def test_prefixes_and_unread_keys_are_dropped():
    tensors = {f"model.diffusion_model.{k}": v for k, v in random_source(TINY).items()}
    assert wan_dit.source(tensors).keys() == random_source(TINY).keys()
    extra = {"blocks.3.attn2.norm_added_q.weight": np.ones(4), "proj_out.bias": np.ones(4)}
    assert wan_dit.source(extra).keys() == {"proj_out.bias"}


def test_what_is_not_this_network_is_named():
    with pytest.raises(UserError, match=r"not a Wan2\.1 transformer"):
        wan_dit.dit_config({"conv1.weight": (1, 2, 3)})
    with pytest.raises(UserError, match="cannot be narrowed to 16"):
        wan_dit.widen({"patch_embed": {"kernel": np.zeros((2, 2, 36, 8))}}, 16)
    tensors = random_source(TINY)
    del tensors["blocks.1.norm3.bias"]
    with pytest.raises(UserError, match=r"missing blocks\.1\.norm3\.bias"):
        mapping.to_ours(wan_dit.dit_entries(TINY), tensors)


def factors(cfg):
    specs = params.flatten(lora.lora_specs(net.dit_specs(cfg), 4, LoraConfig().dit_match))
    rng = np.random.default_rng(3)
    return params.unflatten(
        {path: 0.2 * rng.standard_normal(s.shape, np.float32) for path, s in specs.items()}
    )


@pytest.mark.parametrize("style", ["diffusers", "peft", "framecrafter", "comfyui"])
def test_lora_there_and_back_is_exact(style):
    tree = factors(TINY)
    tensors = lora_export.export_lora(tree, style=style)
    assert len(tensors) == 2 * 10 * TINY.depth
    back, rest = lora_export.import_lora(tensors, TINY)
    assert not rest
    back = params.flatten(back)
    assert back.keys() == params.flatten(tree).keys()
    for path, leaf in params.flatten(tree).items():
        np.testing.assert_array_equal(back[path], leaf)


def test_lora_names_as_published():
    names = {
        style: lora_export.export_lora(factors(TINY), style=style) for style in lora_export._STYLES
    }
    assert names["framecrafter"]["blocks.1.self_attn.q.lora_A.default.weight"].shape == (4, 48)
    assert names["framecrafter"]["blocks.0.ffn.0.lora_B.default.weight"].shape == (64, 4)
    assert "transformer.blocks.1.attn2.to_out.0.lora_B.weight" in names["diffusers"]
    assert "base_model.model.blocks.0.ffn.net.0.proj.lora_A.weight" in names["peft"]
    assert "diffusion_model.blocks.0.cross_attn.o.lora_A.weight" in names["comfyui"]


def test_lora_files_of_others():
    tensors = lora_export.export_lora(factors(TINY), style="framecrafter")
    tensors["patch_embedding.weight"] = np.ones((48, 420, 1, 2, 2))
    tree, rest = lora_export.import_lora(tensors, TINY)
    names = {"lora_A.default": "lora_down", "lora_B.default": "lora_up"}  # of older trainers
    for prefix in ("pipe.dit.", "diffusion_model.", "transformer."):
        other = {}
        for key, value in tensors.items():
            for name, old in names.items():
                key = key.replace(name, old)
            other[prefix + key] = value
        found, rest = lora_export.import_lora(other, TINY)
        assert rest.keys() == {"patch_embedding.weight"}
        for path, leaf in params.flatten(tree).items():
            np.testing.assert_array_equal(params.flatten(found)[path], leaf, err_msg=path)
    assert rest.keys() == {"patch_embedding.weight"}
    for block in range(TINY.depth):  # alpha / rank = 2 on one layer, which is missing from block 0
        tensors[f"blocks.{block}.ffn.0.alpha"] = np.full((1,) * block, 8.0, np.float32)
    for side in "AB":
        del tensors[f"blocks.0.ffn.0.lora_{side}.default.weight"]
    scaled, _ = lora_export.import_lora(tensors, TINY)
    fc1, before = scaled["blocks"]["ffn"]["fc1"], tree["blocks"]["ffn"]["fc1"]
    np.testing.assert_array_equal(fc1["lora_b"][1], 2 * before["lora_b"][1])
    assert not np.any(fc1["lora_a"][0]) and not np.any(fc1["lora_b"][0])
    with pytest.raises(UserError, match=r"no adaptable layer blocks\.2\.attn1\.to_k"):
        lora_export.import_lora(
            lora_export.export_lora(factors(dataclasses.replace(TINY, depth=3))), TINY
        )
    with pytest.raises(UserError, match="no lora_A"):
        lora_export.import_lora({"a.weight": np.ones(2)}, TINY)
    with pytest.raises(UserError, match="did you mean 'peft'"):
        lora_export.export_lora({}, style="pefft")


# The published PyTorch classes on random weights.


def torch_model(cfg, seed=0):
    """A diffusers transformer with every parameter random, in float32, and our parameters of the same values."""
    diffusers, torch = pytest.importorskip("diffusers"), pytest.importorskip("torch")
    clip = {"image_dim": cfg.clip_dim, "added_kv_proj_dim": cfg.width} if cfg.clip_dim else {}
    model = diffusers.WanTransformer3DModel(
        num_attention_heads=cfg.heads,
        attention_head_dim=cfg.width // cfg.heads,
        in_channels=cfg.in_channels,
        out_channels=cfg.out_channels,
        text_dim=cfg.text_dim,
        freq_dim=cfg.freq_dim,
        ffn_dim=cfg.ffn,
        num_layers=cfg.depth,
        **clip,
    )
    tensors = random_source(cfg, "diffusers", seed)
    model.load_state_dict({k: torch.from_numpy(v) for k, v in tensors.items()}, strict=False)
    missing = set(wan_dit.source(model.state_dict())) - set(tensors)
    assert not missing, missing
    return model.eval(), mapping.to_ours(wan_dit.dit_entries(cfg, names="diffusers"), tensors)


def scene(cfg):
    rng = np.random.default_rng(1)
    x = rng.standard_normal((3, 4, 6, cfg.in_channels), np.float32)
    # No zero padding here: 500 equal rows make a gradient of attention that is all cancellation, and pure rounding.
    text = rng.standard_normal((cfg.text_len, cfg.text_dim), np.float32)
    clip = rng.standard_normal((cfg.clip_rows, cfg.clip_dim), np.float32) if cfg.clip_dim else None
    return x, text, clip, net.rope_angles(range(3), 2, 3, cfg.width // cfg.heads)


def torch_velocity(model, x, text, clip, timestep):
    import torch

    kwargs = {} if clip is None else {"encoder_hidden_states_image": torch.from_numpy(clip)[None]}
    latents = torch.from_numpy(np.moveaxis(x, -1, 0).copy())[None].requires_grad_()
    out = model(
        latents, torch.tensor([timestep]), torch.from_numpy(text)[None], return_dict=False, **kwargs
    )[0]
    return latents, out


@functools.partial(jax.jit, static_argnames=("cfg",))
def our_velocity(p, x, text, clip, angles, timestep, cfg):
    rows = net.context_rows(p, text, clip, cfg=cfg)
    return net.dit(p, x, timestep, angles, cfg=cfg, rows=rows, split="text_last")


@pytest.mark.parity
@pytest.mark.parametrize("kind", ["i2v", "t2v"])
def test_velocity_and_gradients_equal_diffusers(kind):
    cfg = TINY if kind == "i2v" else dataclasses.replace(TINY, in_channels=16, clip_dim=0)
    model, p = torch_model(cfg)
    x, text, clip, angles = scene(cfg)
    latents, out = torch_velocity(model, x, text, clip, 317)
    out.sin().sum().backward()
    with jax.default_matmul_precision("highest"):
        ours = our_velocity(p, x, text, clip, angles, 317.0, cfg)

        def loss(p, x):
            return jnp.sum(jnp.sin(our_velocity(p, x, text, clip, angles, 317.0, cfg)))

        grad_p, grad_x = jax.jit(jax.grad(loss, (0, 1)))(p, x)
    assert rel_l2(jnp.moveaxis(ours, -1, 0), out[0].detach().numpy()) <= 1e-5
    # Gradients: twice the depth of operations, twice the tolerance.
    assert rel_l2(jnp.moveaxis(grad_x, -1, 0), latents.grad[0].numpy()) <= 2e-5
    theirs = {name: q.grad.numpy() for name, q in model.named_parameters() if q.grad is not None}
    ours = mapping.to_theirs(wan_dit.dit_entries(cfg, names="diffusers"), grad_p)
    assert ours.keys() == theirs.keys()
    whole = np.sqrt(sum(np.sum(np.float64(g) ** 2) for g in theirs.values()))
    for (
        name,
        g,
    ) in theirs.items():  # key biases nearly cancel, so rounding is that of the whole gradient
        assert np.linalg.norm(ours[name] - g) <= 2e-5 * max(np.linalg.norm(g), 1e-2 * whole), name


@pytest.mark.parity
@pytest.mark.parametrize("style", ["diffusers", "comfyui"])
def test_lora_loads_into_diffusers(style, tmp_path):
    pytest.importorskip("peft")
    import safetensors.numpy

    model, p = torch_model(TINY)
    x, text, clip, angles = scene(TINY)
    tree = factors(TINY)
    tensors = lora_export.export_lora(tree, style=style)
    safetensors.numpy.save_file(tensors, tmp_path / "pytorch_lora_weights.safetensors")
    if style == "diffusers":
        model.load_lora_adapter(str(tmp_path), weight_name="pytorch_lora_weights.safetensors")
    else:
        from diffusers import WanPipeline

        state = WanPipeline.lora_state_dict(
            str(tmp_path), weight_name="pytorch_lora_weights.safetensors"
        )
        state = state[0] if isinstance(state, tuple) else state
        model.load_lora_adapter(state, prefix="transformer")
    theirs = torch_velocity(model, x, text, clip, 100)[1][0].detach().numpy()
    with jax.default_matmul_precision("highest"):
        ours = our_velocity(lora.attach(p, tree), x, text, clip, angles, 100.0, TINY)
        base = our_velocity(p, x, text, clip, angles, 100.0, TINY)
    assert rel_l2(jnp.moveaxis(ours, -1, 0), theirs) <= 1e-5
    assert rel_l2(base, ours) > 1e-2


@pytest.mark.parity
def test_lora_loads_into_peft():
    peft, torch = pytest.importorskip("peft"), pytest.importorskip("torch")
    model, p = torch_model(TINY)
    x, text, clip, angles = scene(TINY)
    tree = factors(TINY)
    targets = r".*(attn[12]\.(to_q|to_k|to_v|to_out\.0)|ffn\.net\.(0\.proj|2))"
    wrapped = peft.get_peft_model(
        model, peft.LoraConfig(r=4, lora_alpha=4, target_modules=targets)
    ).eval()
    tensors = lora_export.export_lora(tree, style="peft")
    assert tensors.keys() == peft.get_peft_model_state_dict(wrapped).keys()
    peft.set_peft_model_state_dict(wrapped, {k: torch.from_numpy(v) for k, v in tensors.items()})
    theirs = torch_velocity(wrapped.base_model.model, x, text, clip, 100)[1][0].detach().numpy()
    with jax.default_matmul_precision("highest"):
        ours = our_velocity(lora.attach(p, tree), x, text, clip, angles, 100.0, TINY)
    assert rel_l2(jnp.moveaxis(ours, -1, 0), theirs) <= 1e-5
