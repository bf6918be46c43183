"""Speed of the diffusion transformer on one CPU core, against PyTorch, and of the choices inside it.

    taskset -c 3 python -m experiments.speed.dit            (needs the extra `parity`; about seven minutes)

One process, one thread each, float32, the same weights in both: our `dit` and diffusers' `WanTransformer3DModel`, both
checked to give the same velocity first. Candidates take turns within a round, so drifts of a shared machine hit all of
them; times are CPU time of the process (wall time on a busy core measures the neighbours). Reported are the median over
rounds, the quartiles, and the median over rounds of the ratio within a round. The paper has no number for this.
Writes experiments/results/dit_speed.json.
"""

import functools
import math
import os
import time

from experiments import harness
from experiments.harness import compare

THREADS = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
ROUNDS = 11


def product_speed(tokens: int, width: int, ffn: int) -> dict:
    """A linear layer's three products beside PyTorch's: XLA's own speed, which no formulation of ours changes."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import torch

    # PyTorch keeps a kernel as [out, in], JAX as [in, out].
    products = {
        "output": (lambda x, w, g: x @ w.T, lambda x, w, g: x @ w),
        "gradient of the input": (lambda x, w, g: g @ w, lambda x, w, g: g @ w.T),
        "gradient of the kernel": (lambda x, w, g: g.T @ x, lambda x, w, g: x.T @ g),
    }
    rng = np.random.default_rng(0)
    result = {}
    for d_in, d_out in ((width, width), (width, ffn), (ffn, width)):
        shapes = (tokens, d_in), (d_in, d_out), (tokens, d_out)
        x, w, g = (rng.standard_normal(shape, np.float32) for shape in shapes)
        tensors = [torch.from_numpy(a) for a in (x, w.T.copy(), g)]
        for name, (theirs, ours) in products.items():
            run = jax.jit(ours).lower(x, w, g).compile()
            arrays = [jnp.asarray(a) for a in (x, w, g)]
            candidates = {
                "torch": functools.partial(theirs, *tensors),
                "XLA": lambda run=run, arrays=arrays: jax.block_until_ready(run(*arrays)),
            }
            print(f"product, {tokens} tokens, {d_in} to {d_out}: {name}")
            result[f"{d_in} to {d_out}, {name}"] = compare(candidates, 3 * ROUNDS)
    return result


def attention_variants():
    """Four formulations of softmax(q k^T / sqrt(e)) v for q, k, v [l, heads, e]."""
    import jax
    import jax.numpy as jnp

    from roge_jax.core.attention import attention, scores_limit

    def together(q, k, v):
        with scores_limit(math.inf):
            return attention(q, k, v)

    def naive(q, k, v):
        s = jnp.einsum("qhe,she->hqs", q, k) * q.shape[-1] ** -0.5
        return jnp.einsum("hqs,she->qhe", jax.nn.softmax(s, -1), v)

    def library(q, k, v):
        return jax.nn.dot_product_attention(q[None], k[None], v[None])[0]

    return {
        "head by head (ours)": attention,
        "all heads at once": together,
        "softmax first": naive,
        "dot_product_attention": library,
    }


def attention_speed(tokens: int, heads: int, head_dim: int) -> dict:
    import jax
    import jax.numpy as jnp
    import numpy as np
    import torch
    from torch.nn.functional import scaled_dot_product_attention as sdpa

    rng = np.random.default_rng(0)
    q, k, v = (
        jnp.asarray(rng.standard_normal((tokens, heads, head_dim), np.float32)) for _ in "qkv"
    )
    forward, backward = {}, {}
    for name, f in attention_variants().items():
        run = jax.jit(f)
        grad = jax.jit(jax.grad(lambda q, k, v, f=f: jnp.sum(jnp.sin(f(q, k, v))), (0, 1, 2)))
        forward[name] = lambda run=run: jax.block_until_ready(run(q, k, v))
        backward[name] = lambda grad=grad: jax.block_until_ready(grad(q, k, v))
    twins = [torch.from_numpy(np.asarray(a).swapaxes(0, 1)[None].copy()) for a in (q, k, v)]
    leaves = [a.clone().requires_grad_() for a in twins]

    def their_gradient():
        for leaf in leaves:
            leaf.grad = None
        sdpa(*leaves).sin().sum().backward()

    forward["torch"], backward["torch"] = lambda: sdpa(*twins), their_gradient
    print(f"attention, {tokens} tokens, {heads} heads of {head_dim}: forward")
    result = {"forward": compare(forward, ROUNDS)}
    print("attention: forward and backward")
    return result | {"forward_backward": compare(backward, ROUNDS)}


def torch_twin(cfg, params):
    """diffusers' transformer holding our parameters, ready for gradients of all of them."""
    import torch
    from diffusers import WanTransformer3DModel

    from experiments.speed.peer import wan_options
    from roge_jax.weights.mapping import to_theirs
    from roge_jax.weights.wan_dit import dit_entries

    model = WanTransformer3DModel(**wan_options(cfg))
    tensors = to_theirs(dit_entries(cfg, names="diffusers"), params)
    model.load_state_dict({key: torch.from_numpy(value.copy()) for key, value in tensors.items()})
    return model


def transformer_speed(cfg, slots: int, rows: int, columns: int) -> dict:
    """Whole forward passes, and gradients of all parameters, of one video."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import torch

    from roge_jax.core import params as trees
    from roge_jax.core.attention import scores_limit
    from roge_jax.video import dit as net

    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    params = {
        path: leaf + 0.02 * rng.standard_normal(leaf.shape, np.float32)
        for path, leaf in trees.flatten(trees.init(jax.random.key(0), net.dit_specs(cfg))).items()
    }
    params = trees.unflatten(params)
    x = rng.standard_normal((slots, 2 * rows, 2 * columns, cfg.in_channels), np.float32)
    text = rng.standard_normal((cfg.text_len, cfg.text_dim), np.float32)
    angles = net.rope_angles(range(slots), rows, columns, cfg.width // cfg.heads)
    timestep = 500.0

    def velocity(params, **options):
        rows = net.context_rows(params, text, cfg=cfg)
        return net.dit(
            params, x, timestep, angles, cfg=cfg, rows=rows, split="text_last", **options
        )

    def ours(scores=None, **options):
        with scores_limit(scores):
            compiled = jax.jit(lambda p: velocity(p, **options)).lower(params).compile()
        return lambda: jax.block_until_ready(compiled(params))

    def our_gradient(name, scores=None, **options):
        start = time.process_time()
        grad = jax.grad(lambda p: jnp.sum(jnp.sin(velocity(p, **options))))
        with scores_limit(scores):
            compiled = jax.jit(grad).lower(params).compile()
        compile_seconds[name] = round(time.process_time() - start, 2)
        return lambda: jax.block_until_ready(compiled(params))

    model = torch_twin(cfg, params)
    latents = torch.from_numpy(np.moveaxis(x, -1, 0).copy())[None]
    context, steps = torch.from_numpy(text)[None], torch.tensor([timestep])

    def theirs():
        with torch.no_grad():
            return model(latents, steps, context, return_dict=False)[0]

    def their_gradient():
        model.zero_grad(set_to_none=True)
        model(latents, steps, context, return_dict=False)[0].sin().sum().backward()

    reference = np.moveaxis(theirs()[0].numpy(), 0, -1)
    forward = ours()
    error = float(np.linalg.norm(forward() - reference) / np.linalg.norm(reference))
    assert error < 1e-5, f"the two networks differ by {error:.1e}"
    compile_seconds: dict[str, float] = {}
    print(f"transformer, {angles.shape[0]} tokens, {cfg}: forward")
    candidates = {
        "torch": theirs,
        "scan": forward,
        "scan, all heads at once": ours(scores=math.inf),
        "unrolled": ours(unroll=cfg.depth),
    }
    result = {"relative_l2_between_frameworks": error, "forward": compare(candidates, ROUNDS)}
    print("transformer: forward and backward, all parameters")
    variants = {
        "scan": {},
        "unrolled": {"unroll": cfg.depth},
        "scan, recompute all": {"remat": "full"},
        "scan, keep dots": {"remat": "dots"},
        "scan, keep dots, all heads at once": {"remat": "dots", "scores": math.inf},
    }
    gradients = {"torch": their_gradient}
    gradients |= {name: our_gradient(name, **options) for name, options in variants.items()}
    result["forward_backward"] = compare(gradients, ROUNDS)
    return result | {"compile_seconds_forward_backward": compile_seconds}


def main() -> None:
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {THREADS}".strip()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    import dataclasses

    import diffusers
    import torch

    from roge_jax.config import DiTConfig

    # Six heads of 64 and four blocks; 1008 tokens are 8 latent slots of 144 x 224 pixels or so.
    cfg = DiTConfig(
        width=384, heads=6, depth=4, ffn=1536, in_channels=16, text_dim=64, text_len=512, clip_dim=0
    )
    grid = {"slots": 8, "rows": 9, "columns": 14}
    tokens = math.prod(grid.values())
    result = {
        "settings": {
            "transformer": dataclasses.asdict(cfg),
            "grid": grid,
            "rounds": ROUNDS,
            "threads": 1,
            "clock": "CPU time of the process",
            "dtype": "float32",
        },
        "environment": harness.environment(),
        "peer": {"torch": torch.__version__, "diffusers": diffusers.__version__},
        "transformer": transformer_speed(cfg, **grid),
        "attention": attention_speed(tokens, cfg.heads, cfg.width // cfg.heads),
        "products": product_speed(tokens, cfg.width, cfg.ffn),
    }
    harness.write("dit_speed.json", result)


if __name__ == "__main__":
    main()
