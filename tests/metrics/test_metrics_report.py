"""Results document, intervals, table and contact sheet."""

import math

import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.metrics import report


def entry(name, **methods):
    return {"scene": name, "context": [0, 9], "target": [3, 4]} | methods


def three_scenes():
    return [
        entry(f"s{i}", generated={"psnr": p, "gmsd": 0.1}, plane={"psnr": q, "gmsd": 0.2})
        for i, (p, q) in enumerate([(20.0, 18.0), (30.0, 27.0), (10.0, 11.0)])
    ]


def test_document_has_the_contracted_shape_and_plain_means():
    scenes = three_scenes()
    out = report.build({"context": 2}, scenes, resamples=200)
    assert out["settings"]["context"] == 2 and out["settings"]["bootstrap"]["resamples"] == 200
    assert out["scenes"] == scenes and out["missing"] == []
    assert set(out["means"]) == {"generated", "plane"}
    np.testing.assert_allclose(out["means"]["generated"]["psnr"], 20.0)
    np.testing.assert_allclose(out["means"]["plane"]["psnr"], 56 / 3)
    difference = out["differences"]["generated"]["plane"]
    np.testing.assert_allclose(difference["psnr"]["mean"], 4 / 3)
    np.testing.assert_allclose(difference["psnr"]["wins"], 2 / 3)
    assert difference["gmsd"]["wins"] == 1.0  # lower is better
    assert list(out["differences"]) == ["generated"]


def test_wins_know_what_better_means():
    scenes = [
        entry("a", generated={"sharpness_ratio": 0.9}, plane={"sharpness_ratio": 1.3}),
        entry("b", generated={"sharpness_ratio": 0.5}, plane={"sharpness_ratio": 0.8}),
    ]
    assert report.paired_difference(scenes, "generated", "plane", "sharpness_ratio")["wins"] == 0.5
    for error in (
        "gmsd",
        "lpips_vgg",
        "lpips_alex",
        "ape_t",
        "ape_r",
        "ape_r_rot",
        "rpe_t",
        "rpe_r",
    ):
        assert report.goodness(error, 0.1) > report.goodness(error, 0.2), error
    for good in ("psnr", "ssim", "ssim_zero_pad", "gradient_psnr", "tsed"):
        assert report.goodness(good, 0.1) < report.goodness(good, 0.2), good
    # a ratio: half the detail is as bad as twice as much, worse than 1.6 times
    assert report.goodness("sharpness_ratio", 0.5) == report.goodness("sharpness_ratio", 2.0)
    assert report.goodness("sharpness_ratio", 0.5) < report.goodness("sharpness_ratio", 1.6)


def test_bootstrap_covers_the_true_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for i in range(300):
        one = report.bootstrap(rng.normal(5.0, 2.0, 40).tolist(), seed=i, resamples=500)
        hits += one["low"] <= 5.0 <= one["high"]
    # the percentile interval at n = 40 covers about 93-94 %; 300 trials: sigma 1.4 %
    assert 0.89 < hits / 300 < 0.98


def test_bootstrap_is_seeded_and_has_no_interval_for_one_scene():
    x = np.random.default_rng(2).standard_normal(20).tolist()
    assert report.bootstrap(x, seed=3) == report.bootstrap(x, seed=3)
    assert report.bootstrap(x, seed=3)["low"] != report.bootstrap(x, seed=4)["low"]
    alone = report.bootstrap([7.0])
    assert alone["mean"] == 7.0 and math.isnan(alone["low"]) and alone["n"] == 1
    assert report.bootstrap([])["n"] == 0


def test_pairing_removes_the_difficulty_of_scenes():
    rng = np.random.default_rng(1)
    hard = rng.normal(20, 5, 30)
    scenes = [
        entry(str(i), generated={"psnr": h + 1 + 0.1 * rng.standard_normal()}, plane={"psnr": h})
        for i, h in enumerate(hard)
    ]
    paired = report.paired_difference(scenes, "generated", "plane", "psnr", resamples=500)
    single = report.bootstrap(
        list(report.values(scenes, "generated", "psnr").values()), resamples=500
    )
    assert 0.9 < paired["low"] < paired["high"] < 1.1
    assert single["high"] - single["low"] > 10 * (paired["high"] - paired["low"])


def test_missing_numbers_are_listed_and_counted():
    scenes = three_scenes()
    del scenes[1]["plane"]
    scenes[2]["generated"]["psnr"] = float("nan")
    out = report.build({}, scenes, resamples=100)
    assert out["missing"] == ["s2: generated psnr", "s1: plane psnr", "s1: plane gmsd"]
    assert out["intervals"]["generated"]["psnr"]["n"] == 2
    assert out["differences"]["generated"]["plane"]["psnr"]["n"] == 1
    assert "(n=2)" in report.table(out) and "missing: s2: generated psnr" in report.table(out)
    with pytest.raises(UserError, match="'s0' occurs twice"):
        report.build({}, [scenes[0], scenes[0]])


def test_table_marks_the_best_and_shows_the_differences():
    scenes = three_scenes()
    for scene, ratio in zip(scenes, (3.0, 3.0, 3.0)):
        scene["generated"]["sharpness_ratio"] = ratio
        scene["plane"]["sharpness_ratio"] = 0.8
    lines = report.table(report.build({}, scenes, resamples=100)).splitlines()
    assert "n = 3 scenes" in lines[0] and lines[1].split() == [
        "method",
        "psnr",
        "gmsd",
        "sharpness_ratio",
    ]
    generated, plane = lines[2], lines[3]
    assert generated.startswith("generated") and "20.000 [10.000, 30.000]*" in generated
    assert "0.100 [0.100, 0.100]*" in generated  # lower is better
    assert plane.endswith("0.800 [0.800, 0.800]*")  # nearest to 1
    assert "generated minus" in lines[5] and "+1.333" in lines[6] and "wins 67 %" in lines[6]


def test_contact_sheet_places_pixels_and_labels():
    red, blue = np.zeros((10, 40, 3)), np.zeros((8, 30, 3), np.uint8)
    red[..., 0], blue[..., 2] = 1.0, 200
    sheet = report.contact_sheet(
        [[red, blue], [None, red]], ["first", "second"], row_labels=["a", "b"], scale=2
    )
    assert sheet.dtype == np.uint8 and sheet.ndim == 3
    is_red = (sheet == [255, 0, 0]).all(axis=2)
    is_blue = (sheet == [0, 0, 200]).all(axis=2)
    assert is_red.sum() == 2 * 20 * 80 and is_blue.sum() == 16 * 60
    rows, columns = np.nonzero(is_red)
    first = rows.min(), columns.min()
    assert is_red[first[0] : first[0] + 20, first[1] : first[1] + 80].all()
    assert (
        np.nonzero(is_blue)[1].min() == first[1] + 82 and np.nonzero(is_blue)[0].min() == first[0]
    )
    assert (sheet[: first[0], :, :] < 128).any() and (
        sheet[first[0] :, : first[1]] < 128
    ).any()  # text
    bare = report.contact_sheet([[red]], [""])
    assert bare.shape == (14, 44, 3)


def test_contact_sheet_refuses_what_it_cannot_place():
    image = np.zeros((4, 4, 3))
    with pytest.raises(UserError, match="1 rows and 2 columns got 1 labels"):
        report.contact_sheet([[image, image]], ["one"])
    with pytest.raises(UserError, match="at least one row"):
        report.contact_sheet([], [])
    with pytest.raises(UserError, match=r"images \[h, w, 3\], not \(4, 4\)"):
        report.contact_sheet([[image[..., 0]]], ["x"])


def test_psnr_never_stands_alone_in_a_table_and_where_the_error_lies_is_not_ranked():
    numbers = {"psnr": 20.0, "gradient_psnr": 22.0, "error_unseen": 0.3, "capped": 0}
    numbers |= {"ssim": 0.5, "lpips_alex": 0.2}
    other = {key: value * 1.1 for key, value in numbers.items()}
    scenes = [entry("a", generated=numbers, plane=other)]
    out = report.build({}, scenes, resamples=10)
    header = report.table(out, ["gmsd", "psnr"]).splitlines()[1].split()
    assert header == ["method", "gmsd", "psnr", "ssim", "lpips_alex"]
    header = report.table(out).splitlines()[1].split()
    assert header == ["method", "psnr", "ssim", "lpips_alex"]
    shown = report.table(out, ["error_unseen"])
    assert "*" not in "".join(shown.splitlines()[1:]) and "wins" not in shown
    assert math.isnan(out["differences"]["generated"]["plane"]["error_unseen"]["wins"])
    wins = out["differences"]["generated"]["plane"]["lpips_alex"]["wins"]
    assert wins == 1.0
