"""The ablation: what it changes is what it says, its rank arithmetic, its verdicts."""

import dataclasses
import re
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from experiments.ablation import (
    adaptation,
    common,
    generator,
    reconstruction,
    report,
    transformer,
)
from roge_jax import model
from roge_jax.config import preset
from roge_jax.core.layers import patch_conv
from roge_jax.core.params import abstract, flatten, init
from roge_jax.data.source import ProceduralSource

TINY = preset("tiny")
VARIANTS = reconstruction.VARIANTS
UNLIKE = ("bidirectional", "full attention", "no registers", "no rays in the encoder")


def factors(rank=6, d_in=10, d_out=8, layers=3, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((layers, d_in, rank)).astype(np.float32)
    b = rng.standard_normal((layers, rank, d_out)).astype(np.float32)
    return {"dit": {"blocks": {"ffn": {"fc1": {"lora_a": a, "lora_b": b}}}}}


def product(lora):
    leaf = lora["dit"]["blocks"]["ffn"]["fc1"]
    return np.asarray(leaf["lora_a"], np.float64) @ np.asarray(leaf["lora_b"], np.float64)


def test_factored_singular_values_are_those_of_the_product():
    lora = factors()
    u, s, vt = adaptation.factor_svd(*lora["dit"]["blocks"]["ffn"]["fc1"].values())
    want = np.linalg.svd(product(lora), compute_uv=False)
    np.testing.assert_allclose(s, want[:, :6], rtol=1e-10)
    np.testing.assert_allclose(u * s[:, None] @ vt, product(lora), atol=1e-10)


@pytest.mark.parametrize("rank", [0, 2, 6])
def test_a_truncated_update_is_the_best_of_its_rank(rank):
    lora = factors()
    cut = adaptation.truncated(lora, rank)
    shapes = [{p: x.shape for p, x in flatten(t).items()} for t in (cut, lora)]
    assert shapes[0] == shapes[1]
    full = np.linalg.svd(product(lora), compute_uv=False)
    left = np.linalg.norm(product(lora) - product(cut), axis=(1, 2))
    np.testing.assert_allclose(left, np.sqrt((full[:, rank:] ** 2).sum(1)), atol=1e-4)


def test_a_layer_narrower_than_the_rank_keeps_its_shapes():
    lora = factors(rank=12)
    cut = adaptation.truncated(lora, 12)
    np.testing.assert_allclose(product(cut), product(lora), atol=1e-4)


def test_spectrum_of_a_known_update():
    u = np.linalg.qr(np.random.default_rng(0).standard_normal((10, 4)))[0]
    a, b = u * np.array([4.0, 2.0, 0.0, 0.0]), np.eye(4, 8)
    lora = {"dit": {"blocks": {"ffn": {"fc1": {"lora_a": a[None], "lora_b": b[None]}}}}}
    found = adaptation.spectrum(lora)
    assert list(found) == ["generator MLP"]
    row = found["generator MLP"]
    np.testing.assert_allclose(row["relative"], [1, 0.5, 0, 0], atol=1e-12)
    assert row["stable_rank"] == pytest.approx(20 / 16)
    assert (row["rank_90"], row["rank_99"]) == (2, 2)  # 80 % of the energy is in the first


def test_every_adapted_layer_of_the_transformer_blocks_has_a_family():
    paths = [p for p in flatten(model.adapter_specs(preset("mini"))) if p.endswith("lora_a")]
    rules = adaptation.FAMILIES.values()
    blocks = [p for p in paths if "blocks/" in p]
    hits = [sum(bool(re.search(rule, p)) for rule in rules) for p in blocks]
    assert blocks and set(hits) == {1}


def test_every_variant_builds():
    """Shapes only: the objective of each variant is traced, nothing is compiled."""
    programs = {}
    for name, variant in VARIANTS.items():
        stage, _, specs, objective, _ = reconstruction.program(variant, TINY, 10)
        assert variant.reference in VARIANTS
        full = reconstruction.varied(preset("mini"), variant)
        programs[name] = (full.encoder, full.renderer, stage.optim, variant.hide, variant.seed)
        if name in UNLIKE:
            v, h, w = common.CONTEXTS + stage.views.targets, TINY.height, TINY.width
            shapes = {
                "context_rgb": (common.CONTEXTS, h, w, 3),
                "target_rgb": (stage.views.targets, h, w, 3),
                "K": (v, 3, 3),
                "c2w": (v, 4, 4),
                "vectors": (common.CONTEXTS, 11),
            }
            batch = {n: jax.ShapeDtypeStruct((2, *s), np.float32) for n, s in shapes.items()}
            loss, _ = jax.eval_shape(objective, abstract(specs), {}, batch, jax.random.key(0))
            assert loss.shape == ()
    assert len({str(p) for p in programs.values()}) == len(VARIANTS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["no registers", "full attention"])
def test_a_variant_trains_and_is_scored(name):
    source = ProceduralSource(TINY.height, TINY.width, 24)
    row = reconstruction.train(VARIANTS[name], TINY, source, 3, scenes=3)
    assert row["skipped"] == 0 and len(row["psnr"]) == 3
    assert all(5 < p < 40 for p in row["psnr"])
    budget = 3 * reconstruction.step_flops(VARIANTS["base"], TINY) / 1e12
    assert row["tera_flop"] == pytest.approx(budget, rel=0.5)  # whole steps


def test_budget_counts_what_a_variant_adds():
    flops = {n: reconstruction.step_flops(v, preset("mini")) for n, v in VARIANTS.items()}
    base = flops["base"]
    for part in ("encoder depth", "renderer depth", "width"):
        sizes = sorted((int(n.split()[-1]), f) for n, f in flops.items() if n.startswith(part))
        assert [f for _, f in sizes] == sorted(f for _, f in sizes)
        assert sizes[0][1] < base < sizes[-1][1]
    same = ("base, seed 1", "no rays in the encoder", "all cameras absolute")
    assert all(flops[n] == base for n in same)
    assert flops["no registers"] < base < flops["bidirectional"]
    assert flops["AdamW 1e-3"] < base  # no iterations of Newton and Schulz


def test_hidden_rays_change_nothing():
    specs, _ = model.split(model.specs(TINY), "^encoder/patch_encoder/")
    params = init(jax.random.key(0), specs)
    one = np.random.default_rng(0).standard_normal((2, 16, 24, 9)).astype(np.float32)
    other = one + np.array([0.0] * 3 + [1.0] * 6, np.float32)[None, None, None]

    def embed(p, x):
        return np.asarray(patch_conv(p["encoder"]["patch_encoder"]["patch_embed"], x))

    blind = reconstruction.blind(params, "rays")
    np.testing.assert_array_equal(embed(blind, one), embed(blind, other))
    assert not np.allclose(embed(params, one), embed(params, other))
    shared = one * np.array([1.0] * 3 + [0.0] * 6, np.float32)[None, None, None]
    np.testing.assert_allclose(embed(blind, one), embed(params, shared), atol=1e-5)


@pytest.mark.parametrize("preview", [False, True])
def test_altered_conditions_are_those_named(preview):
    rng = np.random.default_rng(0)
    shapes = {"x0": (3, 5, 4, 4, 2), "rays": (3, 6, 8), "features": (3, 6, 4)}
    shapes |= {"preview": (3, 3, 4, 4, 2)} if preview else {}
    clips = {n: rng.standard_normal(s) for n, s in shapes.items()}
    clips |= {"known": clips["x0"][:, :2], "seen": clips["x0"][:, :2]}
    assert len(generator.altered(clips)) == (11 if preview else 7)
    for name, case in generator.altered(clips).items():
        assert case["x0"] is clips["x0"]  # the truth that is asked for never changes
        changed = {n for n in clips if not np.array_equal(case[n], clips[n])}
        what, _, how = name.partition(": ")
        want = {
            "all conditions": set(),
            "rays": {"rays"},
            "ray features": {"features"},
            "preview": {"preview"},
            "ray features and preview": {"features", "preview"},
            "context latents": {"known", "seen"},
        }[what]
        assert changed == want
        for n in changed:
            if how == "zero":
                assert not case[n].any()
            else:
                np.testing.assert_array_equal(case[n][1], clips[n][0])


def made_up(psnr, question="depth", **more):
    return {"group": "reconstruction", "question": question, "reference": "base"} | {
        "psnr": list(psnr), "halfway": 15.0, "parameters": 1e6, "steps": 3, "core_seconds": 1.0
    } | more  # fmt: skip


def test_differences_are_paired_and_judged_against_the_seed():
    base = np.array([10.0, 20.0, 15.0, 30.0])
    rows = {
        "base": made_up(base, "seed"),
        "base, seed 1": made_up(base + 0.2, "seed"),
        "good": made_up(base + 1.1),
        "bad": made_up(base - 1.0 + np.array([0.1, -0.1, 0.0, 0.0])),
        "like a seed": made_up(base + 0.2),
        "orphan": made_up(base, reference="missing"),
    }
    assert report.seed_noise(rows) == pytest.approx(0.2)
    good = report.difference(rows, "good")
    assert (good["mean"], good["low"], good["high"]) == pytest.approx((1.0, 1.0, 1.0))
    words = {n: report.verdict(report.difference(rows, n), 0.2) for n in list(rows)[2:5]}
    assert words == {"good": "better", "bad": "worse", "like a seed": "undecided"}
    table = report.tables(report.ready(rows))
    assert "| good | 1.00 | 3 |" in table and "+1.00 [+1.00, +1.00]" in table
    assert "orphan" not in table


def test_the_preview_stands_beside_the_flow_errors():
    rows = {"base": made_up([10.0, 20.0], "seed"), "base, seed 1": made_up([10.0, 20.5], "seed")}
    errors = {"all conditions": np.full((2, 6), 0.5), "preview: zero": np.full((2, 6), 0.75)}
    row = {"group": "conditions", "errors": {n: e.tolist() for n, e in errors.items()}}
    with_preview = report.tables(rows | {"conditions": row | {"preview_itself": [0.1, 0.3]}})
    assert "taken for x0: 0.200." in with_preview
    assert "+0.250 [+0.250, +0.250]" in with_preview
    assert "taken for x0" not in report.tables(rows | {"conditions": row})


def test_the_look_up_stands_beside_the_rgb_head(monkeypatch):
    monkeypatch.setattr(reconstruction, "PHOTOS", (2,))
    config = dataclasses.replace(TINY, renderer=dataclasses.replace(TINY.renderer, lookup=8))
    params = model.init(jax.random.key(0), config)
    row = reconstruction.look_up(params, config, scenes=2)
    head, photos, both = np.array(row["psnr"][2])
    assert head.shape == (2,) and np.all((head > 5) & (head < 40))
    assert np.all(head != photos) and np.all(both != head)
    rows = {"base": made_up([10.0, 20.0], "seed"), "base, seed 1": made_up([10.0, 20.5], "seed")}
    made = {
        "group": "look-up",
        "parts": row["parts"],
        "psnr": {"3": [[10, 20], [11, 21], [12, 22]]},
    }
    table = report.tables(rows | {"look-up": made})
    assert "| 3 | 15.00 | 16.00 | 17.00 | +2.00 [+2.00, +2.00] |" in table


# TINY without a prompt, which `mini` has not either.
PLAIN = dataclasses.replace(TINY, dit=dataclasses.replace(TINY.dit, text_len=0))


def test_transformers_of_all_sizes_get_the_same_budget():
    mini = preset("mini")
    flops = {n: transformer.step_flops(v, mini) for n, v in transformer.VARIANTS.items()}
    base = flops["transformer"]
    assert flops["transformer, seed 1"] == base
    for part, middle in (("depth", mini.dit.depth), ("width", mini.dit.width)):
        names = [n for n in flops if part in n]
        for name in names:
            assert (flops[name] > base) == (int(name.split()[-1]) > middle)
        assert len(names) == 2
    assert 0.9 * base < flops["transformer without rays"] < base


def test_every_transformer_variant_differs_from_the_base_in_what_it_says():
    mini = preset("mini")
    base = dataclasses.asdict(mini.dit)
    whole = flatten(transformer.trained_specs(mini, transformer.VARIANTS["transformer"]))
    for name, variant in transformer.VARIANTS.items():
        dit = dataclasses.asdict(transformer.varied(mini, variant).dit)
        changed = {k for k in base if dit[k] != base[k]}
        assert changed == {"width": {"width", "heads", "ffn"}, "depth": {"depth"}}.get(
            variant.question, set()
        )
        assert dit["width"] // dit["heads"] == 64 and dit["ffn"] == 4 * dit["width"]
        gone = whole.keys() - flatten(transformer.trained_specs(mini, variant)).keys()
        assert {p.rpartition("/")[0] for p in gone} == (
            {"fusion/rays_embed"} if name == "transformer without rays" else set()
        )


@pytest.mark.slow
def test_a_transformer_learns_from_stored_clips_and_is_scored():
    params = model.init(jax.random.key(0), PLAIN)
    source = ProceduralSource(TINY.height, TINY.width, 24)
    frozen = transformer.Frozen(params, PLAIN, source, clips=3, scenes=2)
    row = transformer.train(transformer.VARIANTS["transformer"], frozen, 6)
    assert row["skipped"] == 0 and np.shape(row["errors"]) == (2, len(common.SIGMAS))
    assert np.mean(row["errors"]) < np.mean(row["untrained"])


def test_a_transformer_without_rays_never_sees_them():
    rng, m = np.random.default_rng(0), common.CONTEXTS
    slots, views = PLAIN.slots(m), m + PLAIN.frames
    shapes = {"x0": (slots, *PLAIN.latent_size, 16), "features": (views, 4, 6, 32)}
    clips = {n: rng.standard_normal((2, *s)).astype(np.float32) for n, s in shapes.items()}
    clips |= {"known": clips["x0"][:, :m], "seen": clips["x0"][:, :m]}
    clips["rays"] = np.full((2, views, PLAIN.height, PLAIN.width, 6), np.nan, np.float32)
    frozen = SimpleNamespace(config=PLAIN, clips=2, training=clips, heldout=clips)
    row = transformer.train(transformer.VARIANTS["transformer without rays"], frozen, 6)
    assert row["skipped"] == 0 and row["steps"] > 6  # the budget of six with rays
    assert np.mean(row["errors"]) < np.mean(row["untrained"])


def made_up_transformer(errors, question="depth"):
    return {"group": "transformer", "question": question, "reference": "transformer"} | {
        "errors": np.asarray(errors).tolist(), "untrained": [0.5, 0.7], "halfway": 0.4,
        "parameters": 1e6, "steps": 3, "core_seconds": 1.0,
    }  # fmt: skip


def test_a_lower_flow_error_is_better():
    base = np.array([[0.2, 0.4], [0.3, 0.5]])
    rows = {
        "transformer": made_up_transformer(base, "seed"),
        "transformer, seed 1": made_up_transformer(base + 0.002, "seed"),
        "transformer depth 4": made_up_transformer(base - 0.03),
        "transformer depth 12": made_up_transformer(base + 0.04),
    }
    assert report.seed_noise(rows) == pytest.approx(0.002)
    assert report.difference(rows, "transformer depth 4")["mean"] == pytest.approx(0.031)
    lines = report.tables(rows).splitlines()
    low, high = (next(x for x in lines if f"depth {d} " in x) for d in (4, 12))
    assert "-0.0310 [-0.0310, -0.0310]" in low and low.endswith("better |")
    assert "+0.0390 [+0.0390, +0.0390]" in high and high.endswith("worse |")
    assert "before any step: 0.6000." in report.tables(rows)


def test_runs_at_lower_ranks_stand_below_the_cuts():
    def losses(**flow):
        return {k: {"flow": v, "photometric": [0.001, 0.003]} for k, v in flow.items()}

    row = {"group": "adaptation", "steps": 3, "spectrum": {}, "rank": 4}
    row["losses"] = losses(**{"before": [0.5, 0.6], "0": [0.4, 0.5], "4": [0.2, 0.3]})
    row["elsewhere"] = losses(**{"before": [0.1, 0.2], "4": [0.15, 0.25]})
    low = row | {"rank": 2, "losses": losses(**{"2": [0.25, 0.35]})}
    table = report.tables({"adaptation": row, "adaptation, rank 2": low})
    assert "| untrained | 0.5500 | +0.3000 [+0.3000, +0.3000] | 2.000 |" in table
    assert "| 4 | 0.2500 |  | 2.000 |" in table
    assert "| 2, trained at 2 | 0.3000 | +0.0500 [+0.0500, +0.0500] | 2.000 |" in table
    assert "flow error 0.1500 before, 0.2000 after, +0.0500 [+0.0500, +0.0500]." in table


def test_frames_kept_back_lie_between_those_that_train(monkeypatch):
    def sequence(seed, *, frames, **_):
        return {"rgb": np.arange(frames), "K": np.arange(frames), "c2w": np.arange(frames)}

    monkeypatch.setattr(adaptation, "sample_sequence", sequence)
    learnt, kept = adaptation.one_scene(TINY)
    assert len(learnt["rgb"]) == len(kept["rgb"]) == adaptation.FRAMES >= adaptation.WINDOW
    for name in learnt:
        np.testing.assert_array_equal(kept[name], learnt[name] + 1)


@pytest.mark.slow
def test_an_adaptation_is_scored_here_and_elsewhere():
    params = model.init(jax.random.key(0), PLAIN)
    head = params["dit"]["head"]["linear"]  # zero at first: nothing that LoRA changes would show
    head["kernel"] = 0.1 * jax.random.normal(jax.random.key(1), head["kernel"].shape)
    row = adaptation.adapt(params, PLAIN, 3, rank=4, ranks=(2,), windows=2)
    assert list(row["losses"]) == ["before", "0", "2", "4"]
    assert list(row["elsewhere"]) == ["before", "4"]
    flow = {name: np.array(loss["flow"]) for name, loss in row["losses"].items()}
    assert all(f.shape == (2,) for f in flow.values())
    assert all(np.all(flow[n] != flow["4"]) for n in ("before", "0", "2"))
    assert report.tables({"adaptation": row})
