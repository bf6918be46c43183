"""What the training program looks at before it begins, and what it writes of the model that it began with."""

import contextlib
import dataclasses
import json
from types import SimpleNamespace

import jax
import published_files as made
import pytest
from train_runs import run, write_dataset

from roge_jax import checkpoint, config, convert, export, model, train
from roge_jax.checkpoint import load_provenance
from roge_jax.config import to_dict
from roge_jax.core import memory, params, sharding, target
from roge_jax.errors import UserError
from roge_jax.files import entry, folders
from roge_jax.files.entry import parse
from roge_jax.training import estimate, room, stages
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
    pool = write_dataset(tmp_path / "pool", (32, 48))
    given = ["--init", base, "--data", pool, "--steps", 1, "--batch", 1]
    run("tiny", "--devices", 1, *given, "--out", out)
    for kind in ("model", "adapter"):
        assert load_provenance(out / "lora" / kind)["base_provenance"] == load_provenance(base)
    words = [out / "lora/adapter", "--merge", base, "--out", merged]
    export.main(parse(export.parser(), [str(word) for word in words]))
    with pytest.raises(UserError, match="has other weights than the model"):
        words = [out / "lora/adapter", "--merge", out / "lora/model", "--out", tmp_path / "twice"]
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
    for options, kind in (
        (["--wan", "--wan-vae"], "apache-2.0"),
        (["--wan", "--lagernvs"], "other"),
        (["--vggt"], "other"),
        (["--wan", "--framecrafter"], "other"),
        (["--wan", "--of-a-newer-version"], "other"),
    ):
        record = {"converted": [{"option": option, "tensors": 1} for option in options]}
        assert f"license: {kind}" in adapter_card({}, SMALL, {"base_provenance": record}), options


# What is refused before a weight is loaded, or a file written.


def refused(tmp_path, capsys, *words) -> str:
    arguments = [str(word) for word in (*words, "--out", tmp_path / "out")]
    assert entry.execute(train.main, train.parser(), arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and not any(tmp_path.iterdir())
    return said


@pytest.fixture
def nothing_is_loaded(monkeypatch):
    jax.devices()  # all of them, before a run asks for fewer
    monkeypatch.setattr(model, "init", None)
    monkeypatch.setattr(checkpoint, "open_model", None)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["tiny", "--mesh", "data=2", "--devices", 2, "--batch", 3], "batch of 3 cannot be split"),
        (["tiny", "--mesh", "fsdp=3", "--devices", 3], "cannot be split over fsdp=3"),
        (["mini", "--stage", "all", "--devices", 8, "--batch", 4], "batch of 4 cannot be split"),
        (["tiny", "--devices", 9], "--devices 9: 8 are here"),
    ],
)
def test_a_mesh_that_does_not_divide(words, says, nothing_is_loaded, tmp_path, capsys):
    assert says in refused(tmp_path, capsys, *words)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["tiny", "--devices", "6", "--mesh", "fsdp=4"], "does not make 6 devices"),
        (["paper", "--mesh", "seq=3"], "seq=3 does not divide 40 attention heads: use one of 1, 2"),
        (["wan1.3b", "--mesh", "seq=5"], "seq=5 does not divide 12 attention heads"),
    ],
)
def test_the_dry_run_refuses_the_mesh_that_the_run_refuses(words, says, tmp_path, capsys):
    jax.devices()
    assert says in refused(tmp_path, capsys, *words, "--dry-run")
    with pytest.raises(UserError, match=says.partition(":")[0]):
        sizes = sharding.parse_mesh(words[-1])
        if "--devices" in words:
            sharding.make_mesh(**sizes, devices=jax.devices()[:6])
        sharding.check_heads(config.preset(words[0]).dit.heads, sharding.abstract_mesh(**sizes))


def lora(cfg):
    return stages.lora_stage(10, frames=cfg.frames)


@pytest.mark.parametrize("objective", sorted(stages.OBJECTIVES))
def test_a_gpu_refuses_heads_in_every_stage_that_runs_the_transformer(objective):
    """12 heads on five devices; stages of the other networks have no tokens to split by heads."""
    cfg, mesh = config.preset("wan1.3b"), sharding.abstract_mesh(seq=5)
    stage = dataclasses.replace(lora(cfg), objective=objective)
    for name, dtype in (("h100", "float32"), ("v5p", "bfloat16"), ("cpu", "bfloat16")):
        with target.use(name):
            room.check_layout(cfg, stage, mesh, dtype=dtype)
    transformer = objective in ("prior", "joint", "encoded")
    refused = pytest.raises(UserError, match="seq=5 does not divide 12 attention heads")
    with refused if transformer else contextlib.nullcontext(), target.use("h100"):
        room.check_layout(cfg, stage, mesh, dtype="bfloat16")


class TestRoom:
    """The published 14B transformer, of which nothing is loaded, against memory and disks that are made up."""

    def test_a_cpu_whose_memory_is_too_small(
        self, nothing_is_loaded, monkeypatch, tmp_path, capsys
    ):
        monkeypatch.setattr(room, "memory_available", lambda: 64e9)
        monkeypatch.setattr(room, "check_space", lambda *_, **__: None)
        said = refused(tmp_path, capsys, "paper", "--init", "scratch", "--steps", 1, "--devices", 1)
        # 17.6e9 parameters of 4 bytes, moments and gradients of what trains
        assert "Stage lora of 'paper' needs 7" in said and "of which there are 64 GB" in said

    def test_the_least_is_what_the_shapes_say(self, monkeypatch):
        cfg = config.preset("tiny")
        trained, frozen = stages.stage_specs(cfg, lora(cfg))
        # On one CPU device: what is frozen; of what trains as loaded, parameters, two moments and gradients.
        found = SimpleNamespace(bytes=1e12, fullest="transformer, backward")
        monkeypatch.setattr(estimate, "estimate", lambda *_, **__: found)
        least = 4 * (params.count(frozen) + 5 * params.count(trained))
        for free, fits in ((1.001 * least, True), (0.999 * least, False)):
            monkeypatch.setattr(room, "memory_available", lambda free=free: free)
            if fits:
                assert "is estimated to take" in room.check_room(
                    lora(cfg), cfg, None, dtype="float32"
                )
            else:
                with pytest.raises(UserError, match="for weights, optimiser and gradients alone"):
                    room.check_room(lora(cfg), cfg, None, dtype="float32")
        # Two CPU devices with copies of everything are in the same memory.
        mesh = sharding.make_mesh(2, devices=jax.devices()[:2])
        least = 4 * (2 * (params.count(frozen) + 4 * params.count(trained)) + params.count(trained))
        for free, fits in ((1.001 * least, True), (0.999 * least, False)):
            monkeypatch.setattr(room, "memory_available", lambda free=free: free)
            with contextlib.nullcontext() if fits else pytest.raises(UserError, match="alone"):
                said = room.check_room(lora(cfg), cfg, mesh, dtype="float32")
                assert "estimated to take 2e+03 GB of memory" in said  # 1e12 bytes on each
        monkeypatch.setattr(room, "memory_available", lambda: 1000 * least)
        monkeypatch.setattr(estimate, "estimate", None)  # a small model starts at once
        assert room.check_room(lora(cfg), cfg, None, dtype="float32") == ""

    def test_a_gpu_is_asked_for_its_own_memory(self, monkeypatch):
        cfg, mesh = config.preset("paper"), sharding.make_mesh(1, 2, devices=jax.devices()[:2])
        monkeypatch.setattr(room, "memory_available", lambda: 200e9)
        found = SimpleNamespace(bytes=30e9, fullest="transformer, backward")
        monkeypatch.setattr(estimate, "estimate", lambda *_, **__: found)
        stage = dataclasses.replace(lora(cfg), batch=2)
        said = {}
        for size in (16e9, 24e9, 80e9):
            monkeypatch.setattr(room, "own_memory", lambda devices, size=size: size)
            try:
                said[size] = room.check_room(stage, cfg, mesh, dtype="bfloat16")
            except UserError as error:
                said[size] = str(error)
        assert "GB on each device, which has 16 GB, for weights" in said[16e9]
        assert "estimated to take 30 GB on each device, which has 24 GB" in said[24e9]
        assert said[80e9] == ""
        # The host holds what trains (0.7 GB) and one leaf on its way, 40 x 5120 x 13824 in bfloat16 (5.7 GB).
        for free, fits in ((6.6e9, True), (6.5e9, False)):
            monkeypatch.setattr(room, "memory_available", lambda free=free: free)
            if fits:
                assert room.check_room(stage, cfg, mesh, dtype="bfloat16") == ""
            else:
                with pytest.raises(
                    UserError, match=r"needs 6\.58 GB of memory, of which there are 6\.5"
                ):
                    room.check_room(stage, cfg, mesh, dtype="bfloat16")

    def test_a_disk_without_room_for_checkpoints(
        self, nothing_is_loaded, monkeypatch, tmp_path, capsys
    ):
        usage = folders.shutil.disk_usage(tmp_path)
        monkeypatch.setattr(folders.shutil, "disk_usage", lambda _: usage._replace(free=10_000_000))
        words = ["tiny", "--devices", 1, "--save-every", 1]
        said = refused(tmp_path, capsys, *words, "--steps", 9)
        assert (
            "checkpoints, models, encoded samples) needs 0.0" in said
            and "where 0.01 GB are free" in said
        )
        cfg = config.preset("tiny")
        joint = stages.find_stage(stages.mini_stages(frames=cfg.frames), "joint")
        for stage in (lora(cfg), joint):
            one, found = estimate.state_bytes(cfg, stage), stages.stage_specs(cfg, stage)[0]
            written = 4 * params.count(model.specs(cfg)) + 4 * params.count(found) * stage.lora
            assert (one > written) == (stage is joint)
            if stage is not joint:  # AdamW: parameters, two moments, a few counters
                assert one == pytest.approx(12 * params.count(found), rel=1e-3)
            for times, steps, least in (
                (1, 1, one + written),
                (1, 3, 3 * one + written),
                (1, 9, max(4 * one, 3 * one + written)),  # the fourth is whole before one goes
                (2, 9, max(7 * one + written, 6 * one + 2 * written)),
            ):
                recipe = times * [(dataclasses.replace(stage, steps=steps), cfg)]
                for free, fits in ((least, True), (least - 1, False)):
                    room_left = usage._replace(free=free)
                    monkeypatch.setattr(folders.shutil, "disk_usage", lambda _, r=room_left: r)
                    if fits:
                        room.check_space(tmp_path, recipe, save_every=1)
                    else:
                        with pytest.raises(UserError, match="make room or give another --out"):
                            room.check_space(tmp_path, recipe, save_every=1)

    def test_linux_tells_its_memory(self, monkeypatch):
        found = room.memory_available()
        assert found is None or 1e7 < found < 1e14
        said = "MemTotal:  9000 kB\nMemFree:   10 kB\nMemAvailable:   700 kB\nBuffers:   5 kB\n"
        monkeypatch.setattr(memory.Path, "read_text", lambda file, encoding: said)
        assert memory.memory_available() == 700 * 1024
        monkeypatch.setattr(memory.Path, "read_text", lambda file, encoding: "nothing")
        assert memory.memory_available() is None

    def test_the_smallest_device_tells_the_memory_of_all(self):
        def device(**stats):
            return SimpleNamespace(memory_stats=lambda: stats or None)

        busy = {"bytes_in_use": 7, "peak_bytes_in_use": 8}
        devices = [device(bytes_limit=n, **busy) for n in (90, 60, 80)]
        assert memory.own_memory(devices) == 60
        assert memory.own_memory([device(), device(**busy)]) is None
