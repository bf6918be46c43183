"""The download and conversion commands of docs/start/published_weights.md, run on repositories of full-size sparse files.

`hf download` is played by a copy of the files that its patterns name. What is then opened by the printed conversions is
what was downloaded: nothing is missing, and nothing is fetched for nothing.
"""

import fnmatch
import json
import re
import shlex
import sys
from pathlib import Path

import published_files as made
import pytest
from parity import key_listing

from roge_jax import convert
from roge_jax.files.entry import parse
from roge_jax.weights import catalogue, sources, umt5

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/start/published_weights.md"
XXL = {"t": 256384, "d": 4096, "a": 4096, "f": 10240, "b": 32, "h": 64}


def lines() -> list[str]:
    blocks = re.findall(r"^```\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    return [line for block in blocks for line in block.splitlines()]


def download(line: str) -> tuple[str, list[str], Path]:
    """(repository, patterns, folder) of an `hf download`; every option takes one word, as in huggingface_hub 1 and later."""
    words = shlex.split(line)[2:]
    given: dict[str, list[str]] = {"--include": [], "--local-dir": []}
    repository, *options = words
    for name, value in zip(options[::2], options[1::2], strict=True):
        given[name].append(value)
    (folder,) = given["--local-dir"]
    return repository, given["--include"], Path(folder)


DOWNLOADS = [line for line in lines() if line.startswith("hf download")]
CONVERSIONS = [line for line in lines() if line.startswith("python -m roge_jax.convert")]


# ---- repositories of files that take no disk -----------------------------------------------------


def listed(name: str, column="official key") -> dict[str, tuple[int, ...]]:
    return {row[column]: row["shape"] for row in key_listing(name)}


def encoder(theirs: bool) -> dict[str, tuple[int, ...]]:
    found = {}
    for name, (there, axes) in umt5.ENDS.items():
        found[there if theirs else name] = tuple(XXL[a] for a in axes)
    for i in range(24):
        for name, (there, axes) in umt5.LAYER.items():
            key = f"encoder.block.{i}.{there}" if theirs else f"blocks.{i}.{name}"
            found[key] = tuple(XXL[a] for a in axes)
    return found


def sharded(folder: Path, stem: str, shapes, count: int) -> None:
    """Shards with their index, tensors in order."""
    keys, files = sorted(shapes), {}
    for i in range(count):
        name = f"{stem}-{i + 1:05d}-of-{count:05d}.safetensors"
        part = keys[i * len(keys) // count : (i + 1) * len(keys) // count]
        made.save_headers(folder / name, {key: shapes[key] for key in part})
        files |= dict.fromkeys(part, name)
    index = json.dumps({"metadata": {}, "weight_map": files})
    (folder / f"{stem}.safetensors.index.json").write_text(index)


def others(folder: Path, *names: str) -> None:
    """Files of a repository that nothing here reads."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"not read")


def official(folder: Path, listing: str, heads: int, shards: int) -> None:
    """A Wan-AI repository as the official code reads it."""
    folder.mkdir(parents=True)
    shapes = listed(listing)
    if shards:
        sharded(folder, "diffusion_pytorch_model", shapes, shards)
    else:
        made.save_headers(folder / "diffusion_pytorch_model.safetensors", shapes)
    width = shapes["patch_embedding.weight"][0]
    record = {"_class_name": "WanModel", "dim": width, "num_heads": heads, "text_len": 512}
    (folder / "config.json").write_text(json.dumps(record))
    made.save_torch_headers(folder / "Wan2.1_VAE.pth", listed("wan21_vae"))
    text = encoder(theirs=False)
    made.save_torch_headers(folder / umt5.FILE, text, dtypes=dict.fromkeys(text, "BF16"))
    others(folder, "README.md", "LICENSE.txt", "assets/logo.png", "google/umt5-xxl/spiece.model")
    clip = "models_clip_open-clip-xlm-roberta-large-vit-huge-14.pth"
    others(folder, clip, "google/umt5-xxl/tokenizer.json", "examples/i2v_input.JPG")


def diffusers(folder: Path) -> None:
    (folder / "transformer").mkdir(parents=True)
    shapes = listed("wan21_i2v_14b_dit", "diffusers key")
    sharded(folder / "transformer", "diffusion_pytorch_model", shapes, 14)
    record = {"_class_name": "WanTransformer3DModel", "num_attention_heads": 40}
    (folder / "transformer/config.json").write_text(json.dumps(record))
    vae = listed("wan21_vae", "diffusers key")
    made.save_headers(folder / "vae/diffusion_pytorch_model.safetensors", vae)
    (folder / "text_encoder").mkdir()
    sharded(folder / "text_encoder", "model", encoder(theirs=True), 5)
    others(folder, "model_index.json", "vae/config.json", "text_encoder/config.json", "README.md")
    others(
        folder, "image_encoder/model.safetensors", "tokenizer/tokenizer.json", "scheduler/a.json"
    )


def lagernvs(folder: Path, listing: str) -> None:
    folder.mkdir(parents=True)
    rows = key_listing(listing)
    dtype = next(column for column in rows[0] if column.startswith("dtype"))
    kinds = {row["official key"]: "BF16" for row in rows if row[dtype] == "bfloat16"}
    made.save_torch_headers(folder / "model.pt", listed(listing), "model", kinds)
    others(folder, "README.md", ".gitattributes")


@pytest.fixture(scope="module")
def hub(tmp_path_factory):
    """Every repository that the page names, with its other files; and how much disk they take."""
    root = tmp_path_factory.mktemp("hub")
    bidirectional, full = "lagernvs_encdec_vitb8", "lagernvs_encdec_vitb8_full_attention"
    lagernvs(root / "facebook/lagernvs_general_512", bidirectional)
    lagernvs(root / "facebook/lagernvs_dl3dv_2-6_v_256", bidirectional)
    lagernvs(root / "facebook/lagernvs_re10k_2v_256", full)
    vggt = root / "facebook/VGGT-1B"
    made.save_headers(vggt / "model.safetensors", listed("vggt_1b"))
    others(vggt, "model.pt", "config.json", "README.md")
    official(root / "Wan-AI/Wan2.1-T2V-1.3B", "wan21_t2v_1_3b_dit", 12, 0)
    official(root / "Wan-AI/Wan2.1-T2V-14B", "wan21_t2v_14b_dit", 40, 6)
    official(root / "Wan-AI/Wan2.1-I2V-14B-480P", "wan21_i2v_14b_dit", 40, 7)
    official(root / "Wan-AI/Wan2.1-I2V-14B-720P", "wan21_i2v_14b_dit", 40, 7)
    diffusers(root / "Wan-AI/Wan2.1-I2V-14B-480P-Diffusers")
    return root


def fetch(hub: Path, here: Path, line: str) -> list[Path]:
    """What `hf download` would do: the files that match, as links to the sparse ones."""
    repository, patterns, folder = download(line)
    source, got = hub / repository, []
    for file in sorted(p for p in source.rglob("*") if p.is_file()):
        name = file.relative_to(source).as_posix()
        if any(fnmatch.fnmatch(name, pattern) for pattern in patterns):
            target = here / folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.hardlink_to(file)
            got.append(target)
    assert got, line
    return got


@pytest.fixture(scope="module")
def here(hub, tmp_path_factory):
    """A working folder in which all downloads of the page were done."""
    folder = tmp_path_factory.mktemp("here")
    for line in DOWNLOADS:
        fetch(hub, folder, line)
    return folder


OPENED: list[str] | None = None


def _hook(event: str, arguments) -> None:
    if OPENED is not None and event == "open" and isinstance(arguments[0], str | Path):
        OPENED.append(str(arguments[0]))


sys.addaudithook(_hook)  # cannot be taken away again, and does nothing while OPENED is None


def opened(words: list[str]) -> set[Path]:
    """The files that a conversion opens before it writes."""
    global OPENED
    OPENED = []
    try:
        convert.main(parse(convert.parser(), [*words, "--dry-run"]))
    finally:
        found, OPENED = OPENED, None
    return {Path(name).absolute() for name in found}


# ---- the page ------------------------------------------------------------------------------------


def test_every_command_is_that_of_the_catalogue():
    """So that messages say what the page says; and all of the catalogue is on the page."""
    known = {one.command for one in catalogue.PUBLISHED}
    assert set(DOWNLOADS) <= known and len(DOWNLOADS) >= 7
    assert {one.name for one in catalogue.PUBLISHED} <= set(
        re.findall(r"[\w.-]+", PAGE.read_text())
    )
    assert not [line for line in lines() if "--include" in line and line not in DOWNLOADS]


def test_the_files_are_full_size_and_take_no_disk(hub):
    size = {p: p.stat() for p in hub.rglob("*") if p.is_file()}
    assert sum(one.st_size for one in size.values()) > 340e9
    taken = sum(512 * one.st_blocks for one in size.values())
    assert taken < 50e6, taken
    t2v = hub / "Wan-AI/Wan2.1-T2V-1.3B"
    for name, real in (  # bytes of the released files
        ("diffusion_pytorch_model.safetensors", 5_676_070_424),
        ("Wan2.1_VAE.pth", 507_609_880),
        (umt5.FILE, 11_361_920_418),
    ):
        assert (t2v / name).stat().st_size == pytest.approx(real, rel=2e-4), name


@pytest.mark.parametrize("one", catalogue.PUBLISHED, ids=lambda one: one.name)
def test_sizes_are_those_of_the_files(one, hub, tmp_path):
    got = fetch(hub, tmp_path, one.command)
    assert sum(p.stat().st_size for p in got) / 1e9 == pytest.approx(one.gigabytes, abs=0.02)


@pytest.mark.parametrize("line", [*DOWNLOADS], ids=lambda line: line.split()[2])
def test_pages_sizes_and_access(line):
    """Every download's size is said beside it, and whether access has to be granted."""
    found = next(one for one in catalogue.PUBLISHED if one.command == line)
    text = PAGE.read_text()
    assert re.search(rf"{found.gigabytes:.1f} GB", text)
    row = next((r for r in text.splitlines() if r.startswith("|") and f"[{found.name}]" in r), "")
    assert ("granted" in row) == found.gated
    assert found.licence.split()[0] in text


def test_printed_conversions_read_what_was_downloaded_and_no_more(hub, here, monkeypatch, capsys):
    """All of them, as printed, from headers; together they open every file of every download."""
    monkeypatch.chdir(here)
    every: set[Path] = set()
    for line in CONVERSIONS:
        words = [w for w in shlex.split(line)[3:] if w != "--dry-run"]
        files = {p for p in opened(words) if here in p.parents and p.is_file()}
        assert files, line
        every |= files
        said = capsys.readouterr().out
        alone = "--wan" not in words
        assert ("makes the reconstruction's own picture" in said) == alone
        assert ("no prompt embedding" in said) is False
    downloaded = {p.absolute() for p in here.rglob("*") if p.is_file()}
    assert downloaded == every, sorted(map(str, downloaded ^ every))


def test_what_a_conversion_makes_of_them(here, monkeypatch):
    monkeypatch.chdir(here)
    for line in CONVERSIONS:
        args = parse(convert.parser(), shlex.split(line)[3:])
        plan, filled = convert.make_plan(args)
        if not args.wan:
            assert plan.config.name == str(args.lagernvs) and not plan.initialised
            continue
        start = {path.partition("/")[0] for path in plan.initialised}
        assert start == ({"fusion", "encoder", "renderer"} if args.vggt else {"fusion"}), line
        assert "prompt/rows" in plan.given and plan.provenance["prompt"].startswith("umT5 of ''")
        big = "14B" in str(args.wan)
        assert plan.config.name == ("paper" if big else "wan1.3b")
        assert {part.role for part in filled} >= {"--wan", "--wan-vae"}


@pytest.mark.parametrize("name", ["Wan2.1-T2V-14B", "Wan2.1-I2V-14B-720P"])
def test_the_others_come_by_the_same_patterns(name, hub, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fetch(hub, tmp_path, catalogue.BY_NAME[name].command)
    got = {p.absolute() for p in tmp_path.rglob("*") if p.is_file()}
    assert opened(["--wan", name]) >= got
    assert sources.open_source(tmp_path / name).nbytes > 57e9


def test_the_check_sees_a_pattern_that_is_missing_and_one_too_many(hub, tmp_path, monkeypatch):
    """Against a test that cannot fail."""
    monkeypatch.chdir(tmp_path)
    line = catalogue.BY_NAME["Wan2.1-T2V-1.3B"].command
    more = line.replace("--local-dir", "--include LICENSE.txt --local-dir")
    fetch(hub, tmp_path, more)
    unread = tmp_path / "Wan2.1-T2V-1.3B/LICENSE.txt"
    assert unread.absolute() not in opened(["--wan", "Wan2.1-T2V-1.3B"])
    with pytest.raises(KeyError, match="y"):  # a second word would be the name of a file
        download("hf download a/b --include x y --local-dir z")
