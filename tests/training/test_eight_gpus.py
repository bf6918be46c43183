"""The ten lines of docs/howto/gpus.md, with `tiny` on eight devices of this machine's CPU."""

import json
import re
import shlex
from pathlib import Path

import jax
import numpy as np
from scene_files import nerfstudio, truth
from test_chunks import chunk, entry
from train_runs import run

from roge_jax import config
from roge_jax.checkpoint import load_config
from roge_jax.data import pack

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "gpus.md"


def commands() -> list[list[str]]:
    """The words of the lines behind `python -m` of the page's first block."""
    block = re.search(r"```\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert block is not None
    found = [shlex.split(line) for line in block[1].splitlines()]
    return [words[2:] for words in found if words[:2] == ["python", "-m"]]


def test_the_ten_lines_run_on_eight_devices(tmp_path, monkeypatch, cheap, capsys):
    assert len(jax.devices()) == 8
    tiny = config.PRESETS["tiny"]()
    monkeypatch.chdir(tmp_path)
    views = 2 * tiny.frames
    chunk(tmp_path / "RealEstate10K" / "train" / "000000.torch", [entry("aa", views)])
    for name in ("1K/aa", "2K/bb"):
        nerfstudio(tmp_path / "DL3DV-10K" / name, truth(views))
    size, large = (tiny.height, tiny.width), (2 * tiny.height, 2 * tiny.width)
    smaller = {
        "paper": "tiny",
        "81": str(tiny.frames),
        **{"192": str(size[0]), "336": str(size[1]), "480": str(large[0]), "832": str(large[1])},
        "480x832": f"{large[0]}x{large[1]}",
    }
    lines = [[smaller.get(word, word) for word in words] for words in commands()]
    assert [words[0].removeprefix("roge_jax.") for words in lines] == [
        *("convert", "data.pack", "data.pack", "data.pack", "train", "train", "train")
    ]
    for program, *words in lines[1:]:
        assert "--mesh fsdp=8" in " ".join(words) or program == "roge_jax.data.pack"
        if program == "roge_jax.data.pack":
            assert pack.main([*words, "--processes", "1"]) == 0
            continue
        if "weights/paper" in words:  # which `convert` would have made
            at = words.index("weights/paper")
            words[at] = "scratch"
        run(*words, *([] if "--dry-run" in words else ["--steps", "1"]))
        if "--dry-run" in words:
            assert "fsdp=8" in capsys.readouterr().out
    first = [json.loads(x) for x in Path("runs/first/lora/log.jsonl").read_text().splitlines()]
    assert len(first) == 1 and np.isfinite(first[0]["loss"])
    assert json.loads(Path("runs/first/lora/settings.json").read_text())["batch"] == 8
    made = load_config(Path("runs/second/hires/model"))
    assert (made.height, made.width) == large
