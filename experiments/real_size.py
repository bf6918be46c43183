"""Speed at the published sizes on one accelerator, with PyTorch beside it; a scaled-down ladder where there is none.

    python -m experiments.real_size                  what fits the device: real sizes on a GPU, the ladder on a CPU
    taskset -c 3 python -m experiments.real_size     on a CPU: one core, so that both frameworks use one thread
    python -m experiments.real_size --only dit,vae   some rows; --repeats 10 --small for the ladder on a GPU

Random weights, inputs of zeros and noise; bfloat16 matrices on a GPU, float32 on a CPU. Every row: compiled ahead, two
calls to warm up, then the median and quartiles of ten. FLOPs are those of `roge_jax.cost`. A row that was not run says
"not measured", one that did not fit "out of memory". Goals are for one H100 or H200 (seconds). The peer is diffusers'
`WanTransformer3DModel` in the same process (compiled on a GPU, scaled_dot_product_attention), if torch and diffusers
are there; it computes the keys and values of the text in every call, which ours caches (1.5 % of the 192x336 forward). The paper states no times. Writes experiments/results/real_size.json and prints a table.
"""

import argparse
import dataclasses
import functools
import json
import os
import time
from pathlib import Path

RESULT = Path(__file__).parent / "results" / "real_size.json"

# name: (group, goals "must" and "reach for" in seconds); the sizes are those of `cases`.
ROWS = {
    "DiT-14B forward, 192x336, M=6, N=81": ("dit", 0.38, 0.31),
    "DiT-14B forward, 480x832, M=6, N=81": ("dit", 4.6, 3.85),
    "LoRA joint step, 192x336, batch 1": ("train", 2.9, 1.9),
    "LoRA step, 480x832, reconstruction frozen": ("train", 19.0, 15.0),
    "VGGT-1B, 10 views at 336x518": ("vggt", 0.080, 0.055),
    "all 87 ray features, 288x504, M=6": ("rays", 0.50, 0.35),
    "VAE decode, 81 frames, 480x832": ("vae", 2.0, 1.0),
    "50 Euler steps and decoding, 192x336, M=6": ("sample", 20.0, 16.0),
    "ladder: DiT forward, width 128, 4 blocks": ("dit", None, None),
    "ladder: DiT forward, width 256, 6 blocks": ("dit", None, None),
    "ladder: DiT forward, width 384, 8 blocks": ("dit", None, None),
    "ladder: VGGT, 3 views, mini": ("vggt", None, None),
    "ladder: all ray features, mini, M=3": ("rays", None, None),
    "ladder: VAE decode, mini": ("vae", None, None),
}


def cases():
    """Row name -> (configuration, M)."""
    from roge_jax import config

    paper, mini = config.preset("paper"), config.preset("mini")
    large = dataclasses.replace(paper, height=480, width=832)
    ten = dataclasses.replace(paper, recon_height=336, recon_width=520)
    sizes = [
        (paper, 6),
        (large, 6),
        (paper, 6),
        (large, 6),
        (ten, 10),
        (paper, 6),
        (large, 6),
        (paper, 6),
    ]
    for width, depth in ((128, 4), (256, 6), (384, 8)):
        dit = dataclasses.replace(
            mini.dit,
            width=width,
            heads=width // 64,
            depth=depth,
            ffn=4 * width,
            text_dim=64,
            text_len=16,
        )
        sizes.append((dataclasses.replace(mini, dit=dit), 3))
    sizes += [(mini, 3)] * 3
    return dict(zip(ROWS, sizes, strict=True))


def weights(specs, dtype):
    """Random leaves made of one short random vector: no time is spent on drawing billions of numbers."""
    import jax
    import jax.numpy as jnp

    from roge_jax.core.params import flatten, unflatten
    from roge_jax.cost import keeps_float32

    base = 0.02 * jax.random.normal(jax.random.key(0), (1 << 16,))
    fill = jax.jit(lambda shape, kind: jnp.resize(base, shape).astype(kind), static_argnums=(0, 1))
    flat = flatten(specs)
    return unflatten(
        {p: fill(s.shape, jnp.float32 if keeps_float32(p) else dtype) for p, s in flat.items()}
    )


def measure(call, repeats: int) -> dict:
    """Seconds per call: median, quartiles. On a CPU these are CPU seconds: wall time measures the neighbours."""
    import jax
    import numpy as np

    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    for _ in range(2):
        call()
    seconds = []
    for _ in range(repeats):
        start = clock()
        call()
        seconds.append(clock() - start)
    low, median, high = np.percentile(seconds, [25, 50, 75])
    return {"seconds": float(median), "quartiles": [float(low), float(high)]}


def program(group: str, cfg, m: int, dtype):
    """(function, arguments, FLOPs) of a row, for inputs without a batch axis."""
    import jax
    import jax.numpy as jnp

    from roge_jax import cost, model
    from roge_jax.core.params import Tree
    from roge_jax.fusion import Condition
    from roge_jax.recon.vggt import encoder_grid

    specs = model.specs(cfg)
    lh, lw = cfg.latent_size
    slots, n = cfg.slots(m), cfg.frames
    tokens = cost.tokens_per_slot(cfg) * slots
    size = (cfg.recon_height, cfg.recon_width)
    eye = jnp.tile(jnp.eye(4), (m + n, 1, 1)).at[:, 0, 3].set(jnp.arange(m + n) / n)
    K = jnp.array([[cfg.width, 0, cfg.width / 2], [0, cfg.width, cfg.height / 2], [0, 0, 1.0]])
    views = {
        "K": jnp.tile(K, (m + n, 1, 1)),
        "c2w": eye,
        "vectors": jnp.zeros((m, 11)),
        "context_rgb": jnp.full((m, cfg.height, cfg.width, 3), 0.5),
        "context_recon": jnp.full((m, *size, 3), 0.5),
    }
    rows, columns = encoder_grid(cfg.encoder, *size)
    scene = m * rows * columns

    def pick(*names) -> Tree:
        return weights({k: specs[k] for k in names if k in specs}, dtype)

    if group in ("dit", "sample"):
        names = ("dit", "prompt") if group == "dit" else ("dit", "prompt", "vae")
        params = pick(*names)
        text = jax.jit(functools.partial(model.text_cache, config=cfg))(params)
        cond = Condition(jnp.zeros((slots, lh, lw, 20)), jnp.zeros((tokens, cfg.dit.width)))
        noise = jax.random.normal(jax.random.key(1), (slots, lh, lw, 16))
        flops = cost.velocity(cfg.dit, tokens)
        if group == "dit":

            def forward(params, x, cond, text):
                return model.velocity(
                    params, x, jnp.float32(0.5), cond, config=cfg, contexts=m, text=text
                )

            return forward, (params, noise, cond, text), flops

        from roge_jax.video import flow

        sigmas = flow.schedule("shift", 50, shift=cfg.flow.shift)

        def sample(params, noise, cond, text):
            ready = model.Prepared(noise[:m], jnp.zeros(()), cond, text)
            latents, _ = model.generate(params, ready, noise, config=cfg, sigmas=sigmas)
            return model.decode_video(params, latents, config=cfg)

        total = 50 * flops + cost.vae_decode(cfg.vae, n, cfg.height, cfg.width)
        return sample, (params, noise, cond, text), total
    if group == "vggt":
        params = pick("encoder")
        flops = cost.encoder(cfg.encoder, *size, m, cfg.renderer.width)
        return functools.partial(model.reconstruct, config=cfg), (params, views), flops
    if group == "rays":
        z = jax.random.normal(jax.random.key(1), (m, rows * columns, cfg.renderer.width))
        flops = cost.renderer(cfg.renderer, *size, scene, m, m + n)
        return functools.partial(model.query_rays, config=cfg), (pick("renderer"), z, views), flops
    if group == "vae":
        x = jax.random.normal(jax.random.key(1), (slots - m, lh, lw, 16))
        flops = cost.vae_decode(cfg.vae, n, cfg.height, cfg.width)
        return functools.partial(model.decode_video, config=cfg), (pick("vae"), x), flops
    raise AssertionError(group)


def training_step(cfg, m: int, dtype, remat: str, recon_trains: bool):
    """(function, arguments) of one LoRA step: loss, gradient, AdamW; the state is not donated, so that it can repeat."""
    import jax
    import jax.numpy as jnp

    from roge_jax import model
    from roge_jax.core.lora import attach
    from roge_jax.training.loop import initial_state, make_step
    from roge_jax.training.optim import OptimConfig, make_optimiser

    specs, frozen_specs = model.split(model.specs(cfg), model.NEW_EMBEDDINGS)
    adapters = model.adapter_specs(cfg)
    specs = attach(specs, adapters if recon_trains else {"dit": adapters["dit"]})
    trainable, frozen = weights(specs, jnp.float32), weights(frozen_specs, dtype)
    optim = OptimConfig()
    optimiser = make_optimiser(optim, specs, 100)
    n, size = cfg.frames, (cfg.recon_height, cfg.recon_width)
    K = jnp.array([[cfg.width, 0, cfg.width / 2], [0, cfg.width, cfg.height / 2], [0, 0, 1.0]])
    batch = {
        "K": jnp.tile(K, (1, m + n, 1, 1)),
        "c2w": jnp.tile(jnp.eye(4), (1, m + n, 1, 1)).at[0, :, 0, 3].set(jnp.arange(m + n) / n),
        "vectors": jnp.zeros((1, m, 11)),
        "context_rgb": jnp.full((1, m, cfg.height, cfg.width, 3), 0.5),
        "target_rgb": jnp.full((1, n, cfg.height, cfg.width, 3), 0.5),
        "context_recon": jnp.full((1, m, *size, 3), 0.5),
        "target_recon": jnp.full((1, n, *size, 3), 0.5),
    }
    step = make_step(functools.partial(model.loss, config=cfg, remat=remat), optimiser, optim)
    return step, (initial_state(trainable, optimiser, optim), frozen, batch, jax.random.key(2))


def ours(name: str, repeats: int, dtype) -> dict:
    """The measured row: seconds, compile seconds, TFLOP/s, peak memory; or the reason why there is none."""
    import jax

    group, (cfg, m) = ROWS[name][0], cases()[name]
    options = ("none", "dots", "full") if group == "train" else (None,)
    found: dict = {"status": "out of memory"}
    for remat in options:
        try:
            start = time.perf_counter()
            if group == "train":
                call, arguments = training_step(cfg, m, dtype, remat, recon_trains="joint" in name)
                flops = None
            else:
                call, arguments, flops = program(group, cfg, m, dtype)
            compiled = jax.jit(call).lower(*arguments).compile()
            compile_seconds = time.perf_counter() - start
            found = measure(lambda: jax.block_until_ready(compiled(*arguments)), repeats)  # noqa: B023
            found |= {"status": "measured", "compile_seconds": compile_seconds, "remat": remat}
            if flops:
                found |= {"flops": flops, "tflops": flops / found["seconds"] / 1e12}
            stats = jax.local_devices()[0].memory_stats() or {}
            if "peak_bytes_in_use" in stats:  # of the process so far
                found["peak_gb"] = stats["peak_bytes_in_use"] / 1e9
            return found
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
    return found


def peer(name: str, repeats: int, gpu: bool) -> dict | None:
    """The same transformer in PyTorch; None without torch and diffusers, or where it is no peer."""
    if ROWS[name][0] != "dit":
        return None
    try:
        import torch
        from diffusers import WanTransformer3DModel
    except ImportError:
        return None
    if gpu and not torch.cuda.is_available():
        return None
    from roge_jax import cost

    if not gpu:
        torch.set_num_threads(len(os.sched_getaffinity(0)))
    cfg, m = cases()[name]
    d, (lh, lw), slots = cfg.dit, cfg.latent_size, cfg.slots(m)
    image = {"image_dim": d.clip_dim, "added_kv_proj_dim": d.width} if d.clip_dim else {}
    kind, device = (torch.bfloat16, "cuda") if gpu else (torch.float32, "cpu")
    with torch.device("meta"):
        net = WanTransformer3DModel(
            num_attention_heads=d.heads,
            attention_head_dim=d.width // d.heads,
            in_channels=d.in_channels,
            out_channels=d.out_channels,
            text_dim=d.text_dim,
            freq_dim=d.freq_dim,
            ffn_dim=d.ffn,
            num_layers=d.depth,
            **image,
        )
    net = net.to(kind).to_empty(device=device).eval()
    with torch.no_grad():
        for leaf in net.parameters():
            leaf.normal_(0.0, 0.02)
    net.rope = type(net.rope)(d.width // d.heads, (1, d.patch, d.patch), 1024).to(device)
    run = torch.compile(net) if gpu else net
    x = torch.randn(1, d.in_channels, slots, lh, lw, device=device, dtype=kind)
    text = torch.randn(1, d.text_len, d.text_dim, device=device, dtype=kind)
    extra = {}
    if d.clip_dim:
        extra["encoder_hidden_states_image"] = torch.randn(
            1, d.clip_rows, d.clip_dim, device=device, dtype=kind
        )
    step = torch.tensor([500.0], device=device)

    def call():
        with torch.no_grad():
            run(x, step, text, return_dict=False, **extra)
        if gpu:
            torch.cuda.synchronize()

    flops = cost.velocity(d, cost.tokens_per_slot(cfg) * slots)
    found = measure(call, repeats)
    return found | {"tflops": flops / found["seconds"] / 1e12, "torch": torch.__version__}


def table(rows: dict) -> str:
    lines = [
        "| | seconds (quartiles) | TFLOP/s | PyTorch, seconds | ours / PyTorch | must | reach for |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, (_, must, reach) in ROWS.items():
        x = rows[name]
        cells = [name, x["status"], "", "", "", str(must or ""), str(reach or "")]
        if x["status"] == "measured":
            cells[1] = f"{x['seconds']:.4g} ({x['quartiles'][0]:.4g} to {x['quartiles'][1]:.4g})"
            cells[2] = f"{x['tflops']:.3g}" if "tflops" in x else ""
            if x.get("peer"):
                cells[3] = f"{x['peer']['seconds']:.4g}"
                cells[4] = f"{x['seconds'] / x['peer']['seconds']:.2f}"
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    p.add_argument("--only", help="groups, comma-separated: dit, train, vggt, rays, vae, sample")
    p.add_argument("--repeats", type=int, default=10)
    p.add_argument("--small", action="store_true", help="the ladder also on a GPU")
    args = p.parse_args()
    import jax
    import jax.numpy as jnp

    from roge_jax.entry import environment

    gpu = jax.default_backend() == "gpu"
    dtype = jnp.bfloat16 if gpu else jnp.float32
    groups = set(args.only.split(",")) if args.only else {group for group, _, _ in ROWS.values()}
    rows: dict = {}
    for name, (group, _, _) in ROWS.items():
        ladder = name.startswith("ladder")
        if group not in groups or (ladder and gpu and not args.small) or (not ladder and not gpu):
            rows[name] = {"status": "not measured"}
            continue
        rows[name] = ours(name, args.repeats, dtype)
        if rows[name]["status"] == "measured":
            rows[name]["peer"] = peer(name, args.repeats, gpu)
        print(name, {k: v for k, v in rows[name].items() if k != "quartiles"}, flush=True)
        RESULT.write_text(json.dumps({"environment": environment(), "rows": rows}, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
