"""Models by their name on the Hugging Face hub, against a stand-in for its client: nothing is fetched unless asked."""

import json
import shutil
import sys
import types
from pathlib import Path

import jax
import numpy as np
import pytest

import roge_jax as rj
from roge_jax import checkpoint, model
from roge_jax.config import preset
from roge_jax.core.params import flatten
from roge_jax.weights import hub

CONFIG = preset("tiny")


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A model folder as its owner uploaded it, with a file beside it that nobody needs."""
    folder = tmp_path_factory.mktemp("hub") / "model"
    params = model.init(jax.random.key(0), CONFIG)
    checkpoint.save_model(folder, params, CONFIG, dtype=np.float32)
    (folder / "training.bin").write_bytes(b"gigabytes")
    return folder, params


@pytest.fixture
def client(shared, tmp_path, monkeypatch):
    """In place of `huggingface_hub`: what was asked of it. It copies what the patterns match into a cache."""
    asked = types.SimpleNamespace(calls=[], error=None, folder=shared[0])
    errors = types.ModuleType("huggingface_hub.errors")
    for name, base in (
        ("HfHubHTTPError", OSError),
        ("LocalEntryNotFoundError", FileNotFoundError),
        ("RepositoryNotFoundError", OSError),
        ("RevisionNotFoundError", OSError),
    ):
        setattr(errors, name, type(name, (base,), {}))
    errors.GatedRepoError = type("GatedRepoError", (errors.RepositoryNotFoundError,), {})

    def snapshot_download(repository, *, revision=None, allow_patterns):
        asked.calls.append((repository, revision, tuple(allow_patterns)))
        if asked.error:
            raise getattr(errors, asked.error)("what the site said\nand more")
        place = tmp_path / "cache" / repository.replace("/", "--")
        place.mkdir(parents=True, exist_ok=True)
        for pattern in allow_patterns:
            for file in asked.folder.glob(pattern):
                shutil.copy(file, place)
        return str(place)

    stand_in = types.ModuleType("huggingface_hub")
    stand_in.errors, stand_in.snapshot_download = errors, snapshot_download
    monkeypatch.setitem(sys.modules, "huggingface_hub", stand_in)
    monkeypatch.setitem(sys.modules, "huggingface_hub.errors", errors)
    hub.fetch.cache_clear()
    yield asked
    hub.fetch.cache_clear()


def test_a_model_is_loaded_by_its_name_and_fetched_once(client, shared):
    params, config = rj.load("hub:somebody/rooms")
    assert config == CONFIG
    want = flatten(shared[1])
    for path, leaf in flatten(params).items():
        np.testing.assert_array_equal(leaf, want[path])
    whole = ("config.json", "*.safetensors")
    assert client.calls == [("somebody/rooms", None, whole[:1]), ("somebody/rooms", None, whole)]
    folder = checkpoint.find_model("hub:somebody/rooms")
    assert len(client.calls) == 2 and not (folder / "training.bin").exists()


def test_a_revision_is_asked_for(client):
    checkpoint.find_model("hub:somebody/rooms@v2")
    assert {call[1] for call in client.calls} == {"v2"}


def test_nothing_is_fetched_unless_it_is_asked_for(client):
    checkpoint.find_model("mini")
    with pytest.raises(rj.UserError, match="A model of the Hugging Face hub is hub:somebody/rooms"):
        rj.load("somebody/rooms")
    assert not client.calls


def test_weights_of_another_kind_do_not_come(client, tmp_path):
    client.folder = tmp_path / "other"
    client.folder.mkdir()
    (client.folder / "config.json").write_text(json.dumps({"model_type": "bert"}))
    with pytest.raises(rj.UserError, match="not a roge_jax model config"):
        rj.load("hub:somebody/bert")
    assert [call[2] for call in client.calls] == [("config.json",)]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        ("GatedRepoError", "ask for it on https://huggingface.co/somebody/rooms"),
        ("RepositoryNotFoundError", "no such model"),
        ("RevisionNotFoundError", "no revision 'v9'"),
        ("LocalEntryNotFoundError", r"cannot be fetched \(what the site said\): check the network"),
        ("HfHubHTTPError", "check the network"),
    ],
)
def test_refusals_are_one_sentence(client, error, said):
    client.error = error
    with pytest.raises(rj.UserError, match=said) as caught:
        rj.load("hub:somebody/rooms@v9")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["hub:", "hub:rooms", "hub:a/b/c", "hub:a/b@"])
def test_names_that_are_none(name):
    with pytest.raises(rj.UserError, match="hub:USER/NAME"):
        rj.load(name)


def test_without_the_client_one_is_told_what_to_install(monkeypatch):
    hub.fetch.cache_clear()
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(rj.UserError, match=r"pip install 'roge_jax\[hub\]'"):
        rj.load("hub:somebody/rooms")


def test_the_card_of_mini_has_what_the_site_reads_and_says_what_the_model_is():
    folder = checkpoint.find_model("mini")
    _, front, text = (folder / "README.md").read_text().split("---\n", 2)
    told = dict(line.split(": ") for line in front.splitlines() if ": " in line)
    record = json.loads((folder / "config.json").read_text())
    assert told["license"] == record["provenance"]["license"].lower()
    assert told["library_name"] == "roge_jax" and told["pipeline_tag"] == "image-to-video"
    tags = [line.removeprefix("- ") for line in front.splitlines() if line.startswith("- ")]
    assert {"novel-view-synthesis", "jax"} <= set(tags)
    tree, config = checkpoint.open_model("mini")
    count = sum(int(np.prod(leaf.shape)) for leaf in flatten(tree).values())
    height, width = config.output
    for number in (f"{count:,}", f"{height}x{width}", f"{config.height}x{config.width}"):
        assert number in text
    assert f"1 to {config.max_context}," in text and f"{config.frames} at a time" in text


def test_the_card_is_part_of_the_package():
    import tomllib

    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert "assets/**" in project["tool"]["setuptools"]["package-data"]["roge_jax"]
