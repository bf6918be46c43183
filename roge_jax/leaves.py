"""Every leaf of the model: declared once, drawn at random, adapted by LoRA."""

from collections.abc import Callable

import jax

from . import fusion
from .config import RoGeConfig
from .core.lora import lora_specs
from .core.params import Spec, Tree, zeros
from .core.params import init as init_specs
from .recon import ray_scene, vggt
from .video import dit, vae, vae_training

# What trains when pretrained networks are adapted (Sec. 3.3): the new embeddings and E1 fully, the rest by LoRA.
NEW_EMBEDDINGS = r"^fusion/|^dit/patch_embed/"


# The half that makes pictures by itself: its parts of the parameter tree.
RECONSTRUCTION = ("encoder", "renderer")


def specs(config: RoGeConfig) -> Tree:
    """Every leaf of the model, or of the half that `config.parts` names."""
    tree = {
        "encoder": vggt.encoder_specs(config.encoder, config.renderer.width),
        "renderer": ray_scene.renderer_specs(config.renderer),
        "vae": vae.vae_specs(config.vae),
        "dit": dit.dit_specs(config.dit),
        "fusion": fusion.fusion_specs(config),
    }
    if (
        config.dit.text_len
    ):  # the prompt's text embedding, zero-padded: text encoders are not needed afterwards
        shape = (config.dit.text_len, config.dit.text_dim)
        tree["prompt"] = {"rows": Spec(shape, (None, None), zeros)}
    if config.parts == "all":
        return tree
    half = config.parts == "reconstruction"
    return {name: part for name, part in tree.items() if (name in RECONSTRUCTION) == half}


def init(key: jax.Array, config: RoGeConfig, *, make: Callable = init_specs) -> Tree:
    """Random parameters (the VAE from its pass-through initialisation). With `make=params.drawn` all others are drawn
    when they are asked for.
    """
    want = specs(config)
    tree = make(key, {k: s for k, s in want.items() if k != "vae"})
    if "vae" not in want:
        return tree
    return tree | {"vae": vae_training.passthrough_init(jax.random.fold_in(key, 1), config.vae)}


def adapter_specs(config: RoGeConfig) -> Tree:
    """The sparse tree of LoRA factors of both halves."""
    tree, lora = specs(config), config.lora
    recon = lora_specs(
        {k: tree[k] for k in ("encoder", "renderer")}, lora.recon_rank, lora.recon_match
    )
    return {**recon, "dit": lora_specs(tree["dit"], lora.dit_rank, lora.dit_match)}
