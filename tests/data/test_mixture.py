"""Several datasets with weights: the same samples for every process and after every resume, bad sequences passed over."""

import json
import re
import time

import numpy as np
import pytest
from train_runs import run, write_dataset

from roge_jax.data.source import Given, Mixture, as_given, given, open_mixture, open_source
from roge_jax.data.views import ViewConfig, draw_batch
from roge_jax.errors import UserError
from roge_jax.training.loop import prefetched

VIEWS = ViewConfig(contexts=(2,), context_weights=(1.0,), targets=3, ordered=True)
SIZE = (4, 6)


def draw(pool, index, rows=None, batch=4):
    return draw_batch(pool, 0, index, batch, VIEWS, scale_rule="lagernvs", rows=rows)


def equal(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def spoil(folder, sequence):
    """A camera of this sequence that is not finite."""
    with np.load(folder / "shard_00000.npz") as stored:
        arrays = dict(stored)
    arrays["c2w"][sequence, :, 0, 3] = np.nan
    np.savez(folder / "shard_00000.npz", **arrays)


def test_words_name_datasets_and_weights(tmp_path):
    (tmp_path / "odd:3").mkdir()
    assert given("runs/a") == Given(given("runs/a").folder, 1.0)
    assert given("runs/a:0.25").weight == 0.25 and str(given("runs/a:0.25")) == "runs/a:0.25"
    assert given(tmp_path / "odd:3") == Given(tmp_path / "odd:3")
    assert given("C:folder").weight == 1.0 and as_given(None) == []
    for weight in ("0", "-1", "nan", "inf"):
        with pytest.raises(UserError, match=r"--data a:.*: the weight .* must be a number above 0"):
            given(f"a:{weight}")


def test_sequences_are_drawn_by_weight(tmp_path):
    """Three to one, whatever their sizes, and evenly within a dataset."""
    parts = [[{"i": i} for i in range(n)] for n in (2, 50)]
    mixture = Mixture(parts, [Given(tmp_path, 3.0), Given(tmp_path, 1.0)])
    drawn = [mixture.draw(np.random.default_rng([0, i])) for i in range(4000)]
    assert len(mixture) == 52 and [mixture[i]["i"] for i in (0, 1, 2, 51)] == [0, 1, 0, 49]
    share = np.mean(np.array(drawn) < 2)
    assert abs(share - 0.75) < 0.03  # four deviations
    assert abs(np.mean(np.array(drawn) == 0) - 0.375) < 0.03 and len(set(drawn)) == 52


def test_one_dataset_gives_the_samples_that_it_gave(tmp_path):
    folder = write_dataset(tmp_path / "a", SIZE)
    bare, mixed = open_source(folder, *SIZE, 3), open_mixture(as_given(folder), *SIZE, 3)
    assert all(equal(draw(bare, i), draw(mixed, i)) for i in range(5))


def test_rows_and_order_do_not_change_samples(tmp_path):
    """What two hosts draw, in any order, is what one draws; with a sequence that cannot be used among them."""
    folders = [write_dataset(tmp_path / name, SIZE, seed) for seed, name in enumerate("ab")]
    spoil(folders[0], 1)
    sources = as_given([f"{folders[0]}:3", folders[1]])
    one, two = (open_mixture(sources, *SIZE, 3) for _ in range(2))
    whole = [draw(one, i) for i in range(6)]
    assert one.bad == {(str(folders[0]), 1)}
    for i in reversed(range(6)):
        halves = [draw(two, i, rows) for rows in ((2, 3), (0, 1))]
        joined = {k: np.concatenate([halves[1][k], halves[0][k]]) for k in halves[0]}
        assert equal(whole[i], joined) and np.isfinite(joined["c2w"]).all()


def test_bad_sequences_are_listed_up_to_a_limit(tmp_path, capsys):
    folder, file = write_dataset(tmp_path / "a", SIZE), tmp_path / "run" / "passed_over.jsonl"
    spoil(folder, 1)
    for _ in range(2):  # the second is a run that goes on
        mixture = open_mixture(as_given(folder), *SIZE, 3, most=1, file=file)
        for i in range(6):
            draw(mixture, i)
    (row,) = [json.loads(line) for line in file.read_text().splitlines()]
    reason = row.pop("reason")
    assert row == {"data": str(folder), "sequence": 1}
    assert re.fullmatch(r"Sequence 1 of the data, frames [\d, ]+: their cameras .* NaN .*", reason)
    assert capsys.readouterr().err.count("passed over: ") == 1
    with pytest.raises(
        UserError, match=r"1 sequences of the data cannot be used, the last in .*a: Seq"
    ):
        [draw(open_mixture(as_given(folder), *SIZE, 3, most=0), i) for i in range(6)]
    spoil(folder, 0)
    with pytest.raises(UserError, match="50 sequences in a row cannot be used"):
        draw(open_mixture(as_given(folder), *SIZE, 3), 0)


def test_batches_of_many_threads_come_in_order():
    def slow(i):
        time.sleep(0.02 * (i % 3 == 0))
        return {"i": i}

    assert [x["i"] for x in prefetched(slow, 2, 20, loaders=4)] == list(range(2, 20))


def test_a_run_on_two_datasets_says_what_it_used(tmp_path, common, cheap):
    """And is not continued on others."""
    from roge_jax import config

    tiny = config.PRESETS["tiny"]()
    size = (tiny.height, tiny.width)
    folders = [write_dataset(tmp_path / n, size, k, 2 * tiny.frames) for k, n in enumerate("ab")]
    spoil(folders[0], [0, 1])
    words = [*common, "--data", f"{folders[0]}:2", "--data", folders[1], "--batch", 2]
    run(*words, "--steps", 2, "--out", tmp_path, "--loaders", 3)
    settings = json.loads((tmp_path / "lora" / "settings.json").read_text())
    assert settings["data"] == f"{folders[0]}:2, {folders[1]}"
    assert settings["data contents"].count(":") == 2
    assert (tmp_path / "lora" / "passed_over.jsonl").exists()
    rows = (tmp_path / "lora" / "log.jsonl").read_text().splitlines()
    assert len(rows) == 2 and all(0 <= json.loads(row)["waiting"] <= 1 for row in rows)
    words = [*common, "--data", folders[1], "--batch", 2, "--steps", 3, "--out", tmp_path]
    with pytest.raises(UserError, match="holds a run with data contents"):
        run(*words, "--resume")
