"""Programs compiled for GPUs that are not there. What a module's text says is read anywhere; the compiler itself is an
extra (`make test-accelerators`)."""

import math

import pytest

from roge_jax import config, cost
from roge_jax.core import aot, hlo, target
from roge_jax.errors import UserError

MODULE = """HloModule jit_f, is_scheduled=true

%region_0 (x: f32[], y: f32[]) -> f32[] {
  %x = f32[] parameter(0)
  %y = f32[] parameter(1)
  ROOT %add = f32[] add(%x, %y)
}

%fused (p0: bf16[16,8], p1: bf16[8,4]) -> f32[16,4] {
  %p0 = bf16[16,8]{1,0} parameter(0)
  %p1 = bf16[8,4]{1,0} parameter(1)
  ROOT %dot = f32[16,4]{1,0} dot(%p0, %p1), lhs_contracting_dims={1}, rhs_contracting_dims={0}
}

%body (c: (s32[], bf16[16,8], bf16[8,4])) -> (s32[], bf16[16,8], bf16[8,4]) {
  %c = (s32[], bf16[16,8]{1,0}, bf16[8,4]{1,0}) parameter(0)
  %a = bf16[16,8]{1,0} get-tuple-element(%c), index=1
  %b = bf16[8,4]{1,0} get-tuple-element(%c), index=2
  %g = (bf16[8,4]{1,0}, bf16[32,4]{1,0}) all-gather-start(%b), channel_id=1, dimensions={0}
  %gd = bf16[32,4]{1,0} all-gather-done(%g)
  %made = f32[16,4]{1,0} fusion(%a, %b), kind=kCustom, calls=%fused
  %k = (bf16[1,2,16,8]{3,2,1,0}, u8[0]{0}) custom-call(%a, %a, %a), custom_call_target="__cudnn$fmhaSoftmax", backend_config={"intermediate_tensor_shape": {"dimensions": ["1","2","16","24"]}}
  ROOT %t = (s32[], bf16[16,8]{1,0}, bf16[8,4]{1,0}) tuple(%c)
}

ENTRY %main (p: bf16[16,8], w: bf16[8,4]) -> f32[16,4] {
  %p = bf16[16,8]{1,0} parameter(0)
  %w = bf16[8,4]{1,0} parameter(1)
  %start = (s32[], bf16[16,8]{1,0}, bf16[8,4]{1,0}) tuple(%p, %w)
  %loop = (s32[], bf16[16,8]{1,0}, bf16[8,4]{1,0}) while(%start), condition=%region_0, body=%body, backend_config={"known_trip_count":{"n":"5"}}
  %lt = (f32[16,4]{1,0}, s8[4096]{0}) custom-call(%p, %w), custom_call_target="__cublas$lt$matmul", backend_config={"dot_dimension_numbers":{"lhs_contracting_dimensions":["1"]}}
  %image = f32[1,6,6,2]{3,2,1,0} parameter(2)
  %kernel = f32[3,3,2,5]{3,2,1,0} parameter(3)
  %conv = f32[1,6,6,5]{3,2,1,0} convolution(%image, %kernel), window={size=3x3 pad=1_1x1_1}, dim_labels=b01f_01io->b01f
  ROOT %sum = f32[16,4]{1,0} all-reduce(%made), to_apply=%region_0
}
"""


def test_a_module_is_read_with_its_loops():
    found = hlo.summary(MODULE)
    product = 2 * 16 * 4 * 8
    attention = 4 * 2 * 16 * 24 * 8
    assert found.flops == {
        "bf16": 5 * product + 5 * attention + product,
        "f32": 2 * 36 * 5 * 3 * 3 * 2,
    }
    assert found.kernels == {"__cudnn$fmhaSoftmax": 5, "__cublas$lt$matmul": 1}
    gathered = 32 * 4 * 2
    assert found.collectives == {"all-gather": 5 * gathered, "all-reduce": 16 * 4 * 4}
    assert found.largest_gather == gathered and not found.unknown_loops
    assert found.results[hlo.Array("f32", (16, 4))] == 5 + 1 + 1, "five turns, cuBLAS, the sum"
    assert hlo.summary(MODULE.replace("known_trip_count", "x")).unknown_loops == ["loop"]


@pytest.mark.parametrize("name", aot.CHIPS)
def test_gpus_are_described_whole(name):
    text = aot.gpu_description(name)
    assert text.count("{") == text.count("}") and target.TARGETS[name].platform == "gpu"
    assert f'name: "{target.TARGETS[name].title}"' in text
    assert f"device_memory_size: {target.TARGETS[name].memory:.0f}" in text


def test_what_cannot_be_compiled_is_one_sentence(monkeypatch):
    monkeypatch.setattr(aot, "PLUGINS", ("jax_plugins.not_there",))
    assert "roge_jax[aot]" in aot.missing("h100")
    for name, says in (("h100", "not installed"), ("v5p", "the targets are h100"), ("cpu", "cpu")):
        with pytest.raises(UserError, match=says), aot.compiling(name):
            pass


def test_the_answers_for_a_gpu_are_taken_back():
    fused = pytest.importorskip("jax._src.cudnn.fused_attention_stablehlo")
    names = ("check_cudnn_version", "check_compute_capability", "is_cuda_compute_capability_equal")
    own = [getattr(fused, name) for name in names]
    with pytest.raises(ZeroDivisionError), aot._answer_for_a_gpu((8, 9)):
        assert fused.check_cudnn_version() == aot.CUDNN
        assert fused.check_compute_capability("8.0") and not fused.check_compute_capability("9.0")
        assert fused.is_cuda_compute_capability_equal("8.9")
        1 / 0  # noqa: B018
    assert [getattr(fused, name) for name in names] == own


# ---- with the compiler ---------------------------------------------------------------------------

compiler = pytest.mark.skipif(
    bool(aot.missing("h100")),
    reason=f"{aot.missing('h100')}; `make test-accelerators` installs it in an environment of its own",
)


def compiled(program: str, size: str, *sizes: int) -> dict:
    """A row of the experiment for `paper` on H100, made in a process of its own: this one has XLA's flags for quick tests."""
    from experiments.scaling import compiled as experiment

    return experiment.child(experiment.Case("paper", size, program, "h100", sizes).name)


@compiler
def test_the_14b_transformer_on_an_h100():
    """FLOPs, memory and kernels of one forward pass at the paper's first size, as its compiler has them."""
    cfg = config.preset("paper")
    d, tokens = cfg.dit, cost.tokens_per_slot(cfg) * cfg.slots(6)
    row = compiled("velocity", "192x336", 1, 1, 1)
    assert not row["options"] and not row["unknown_loops"] and not row["collectives"]
    assert sum(row["flops"].values()) == pytest.approx(cost.velocity(d, tokens), rel=1e-3)
    assert row["flops"]["bf16"] > 0.999 * sum(row["flops"].values())
    assert row["kernels"]["__cudnn$fmhaSoftmax"] == 3 * d.depth
    with target.use("h100"):
        planned = cost.estimate(cfg, 6, 1, dtype="bfloat16").working_bytes["velocity"]
    features = 4 * (6 + cfg.frames) * 42 * 54 * cfg.renderer.width  # this program has none
    assert 0.5 < row["temporary"] / (planned - features) < 1.0
    results = [hlo.Array(dtype, tuple(shape)) for dtype, shape, _ in row["results"]]
    # The largest are the hidden layer's and one block's weights: no scores, of no piece of the queries.
    assert max(math.prod(x.shape) for x in results) == tokens * d.ffn
    matrices = {(d.width, d.width), (d.width, d.ffn), (d.ffn, d.width)}
    copies = [x for x in results if x.shape[-2:] in matrices and x.dtype == "f32"]
    assert results and not copies


@compiler
@pytest.mark.parametrize("sizes", [(8, 1, 1), (2, 2, 2), (1, 1, 8)], ids=str)
def test_a_step_on_eight_gpus(sizes):
    """The transformer of a LoRA step: the prompt is shared by all scenes. What is gathered is one block's at most."""
    row = compiled("transformer step", "192x336", *sizes)
    assert row["kernels"]["__cudnn$fmhaSoftmax"] and row["kernels"]["__cudnn$fmhaSoftmaxBackward"]
    assert not row["unknown_loops"]
    assert row["collectives"].keys() & {"all-reduce", "reduce-scatter"}
    assert row["largest_gather"] <= row["block"]
    assert row["flops"].get("f32", 0.0) < 0.02 * sum(row["flops"].values()), "products"


@compiler
def test_small_products_compile_without_tiles():
    """The compiler's default tiles do not fit some: then Triton's products are left out."""
    row = compiled("decode", "192x336", 1, 1, 1)
    assert row["options"] == aot.NO_TRITON and row["temporary"] > 0
