"""What the training program looks at before it begins, and what it writes of the model that it began with."""

import dataclasses
import json

import published_files as made
from train_runs import run, write_pool

from roge_jax import convert, export
from roge_jax.checkpoint import load_provenance
from roge_jax.config import to_dict
from roge_jax.entry import parse
from roge_jax.training.start import provenance
from roge_jax.weights.model_card import adapter_card

SMALL = dataclasses.replace(
    made.CONFIG, height=32, width=48, recon_height=32, recon_width=48, frames=5
)


def converted(folder, *options, recon="lagernvs"):
    """A small model folder as `roge_jax.convert` makes it of published files."""
    made.save_sharded(folder / "wan", made.dit_tensors(SMALL.dit)[1])
    made.save(folder / "wan/Wan2.1_VAE.safetensors", made.vae_tensors(SMALL.vae)[1])
    tensors = {"lagernvs": made.recon_tensors, "vggt": made.vggt_tensors}[recon](SMALL)[1]
    made.save(folder / f"{recon}.safetensors", tensors)
    (folder / "config").mkdir()
    record = {"format": 1, "config": to_dict(SMALL), "provenance": {}}
    (folder / "config/config.json").write_text(json.dumps(record))
    arguments = ["--wan", folder / "wan", f"--{recon}", folder / f"{recon}.safetensors"]
    arguments += ["--preset", folder / "config", "--out", folder / "model", *options]
    convert.main(parse(convert.parser(), [str(a) for a in arguments]))
    return folder / "model"


def test_licences_of_published_weights_reach_every_adapter_and_model(cheap, tmp_path):
    base, out, merged = converted(tmp_path), tmp_path / "out", tmp_path / "merged"
    pool = write_pool(tmp_path / "pool", (32, 48))
    given = ["--init", base, "--data", pool, "--steps", 1, "--batch", 1]
    run("tiny", "--devices", 1, *given, "--out", out)
    for kind in ("model", "adapter"):
        assert load_provenance(out / "lora" / kind)["base_provenance"] == load_provenance(base)
    words = [out / "lora/adapter", "--merge", base, "--out", merged]
    export.main(parse(export.parser(), [str(word) for word in words]))
    cards = [(out / "lora/adapter/README.md").read_text()]
    for start in (out / "lora/model", merged):  # and of what is trained on top of that
        cards.append(adapter_card({}, SMALL, {"base_provenance": provenance(str(start))}))
    for card in cards:
        assert "license: other" in card and "Licence of the data" in card
        assert "LagerNVS: FAIR Noncommercial" in card and "Wan2.1 VAE: Apache-2.0" in card


def test_an_adapter_of_free_weights_is_free():
    for start in ("mini", "scratch"):
        record = {"base": start, "base_provenance": provenance(start)}
        assert "license: apache-2.0" in adapter_card({}, SMALL, record)
    assert "license: other" in adapter_card({}, SMALL, {"base": "somewhere"})
