"""The diffusion transformer against the published one, and its properties."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from roge_jax.config import DiTConfig, LoraConfig, preset
from roge_jax.core import lora, params
from roge_jax.core.layers import patchify
from roge_jax.video import dit as net
from roge_jax.weights import mapping, wan_dit

from parity import key_listing, load_case, rel_l2, rule_weights

TOLERANCE = 1e-5
CASES = ["wan_dit_t2v_tiny", "wan_dit_i2v_tiny", "wan_dit_i2v_eps_tiny", "wan_dit_framecrafter_tiny"]


def case_config(case) -> DiTConfig:
    c, shapes = case.config, {row[0]: tuple(row[1]) for row in case.info["state_dict_keys"]}
    cfg = wan_dit.dit_config(shapes)
    assert (cfg.heads, cfg.depth, cfg.text_dim) == (c["num_heads"], c["num_layers"], c["text_dim"])
    return cfg


@pytest.mark.parametrize("name", CASES)
def test_equals_the_published_network(name):
    case = load_case(name)
    cfg, t = case_config(case), case.tensors
    p = mapping.to_ours(wan_dit.dit_entries(cfg), rule_weights(case))
    params.check(p, net.dit_specs(cfg))

    parts = [t[key][0] for key in ("in.latent", "in.y", "in.raymap") if key in t]
    x = np.moveaxis(np.concatenate(parts), 0, -1)  # [t, lh, lw, c]
    slots, lh, lw, _ = x.shape
    grid = (slots, lh // 2, lw // 2)
    crafter = "framecrafter" in name
    time = np.zeros(slots, int) if crafter else np.arange(slots)
    angles = net.rope_angles(time, *grid[1:], cfg.width // cfg.heads)
    split = "image_first" if crafter else "text_last"
    found = {}

    with jax.default_matmul_precision("highest"):
        tokens = net.patch_embed(p, x)
        e, e0 = net.time_embed(p, t["in.t"][0])
        found |= {"mid.patch_tokens": tokens, "mid.e": e, "mid.e0": e0}
        text = t["in.text"][0] if crafter else t["in.text0"]
        text_tokens = net.text_embed(p, text, text_len=cfg.text_len)
        rows_kept = case.info["config"]["text_rows"][0] + 1
        step = {"wan_dit_i2v_tiny": 4}.get(name, 1)
        kept = [0, 1, 2, 256, 257, 511] if crafter else np.arange(0, rows_kept, step)
        found["mid.text_tokens_sub"] = text_tokens[np.asarray(kept)]
        found["mid.text_tokens_last_row"] = text_tokens[-1]
        clip = t["in.clip"][0] if "in.clip" in t else None
        if clip is not None:
            found["mid.clip_tokens_sub"] = net.clip_embed(p, clip)[::16]
        rows = net.context_rows(p, text, clip, cfg=cfg)
        out = tokens
        for i in range(cfg.depth):
            layer = jax.tree.map(lambda leaf, i=i: leaf[i], p["blocks"])
            kv = net.cross_kv(layer, rows, cfg=cfg, split=split)
            out = net.block(layer, out, e0, angles, kv, heads=cfg.heads)
            found[f"mid.block{i}_out"] = out
        velocity = net.dit(p, x, t["in.t"][0], angles, cfg=cfg, rows=rows, split=split)
        features = patchify(net.head(p, out, e, grid=grid, patch=cfg.patch), cfg.patch)
        found["mid.head_out"] = features.reshape(-1, features.shape[-1])
        found["out.velocity"] = jnp.moveaxis(velocity, -1, 0)

    expected = [key for key in t if not key.startswith("in.")]
    assert set(expected) <= set(found), set(expected) - set(found)
    errors = {key: rel_l2(np.asarray(found[key]), t[key][0]) for key in expected}
    print(name, {key: f"{value:.1e}" for key, value in errors.items()})
    assert all(value <= TOLERANCE for value in errors.values()), errors
