"""Speed of the video VAE on one CPU core: this package against PyTorch (diffusers) with the same weights.

    python -m experiments.speed.vae --core 3                      # writes experiments/results/vae_speed.json
    nice -n 15 python -m experiments.speed.vae --core 3 --repeats 7

Needs the extra `parity`. About a quarter of an hour, half of it compiling, and 4 GB. For every case (width, clip) and operation (encode, decode, gradient of the
reconstruction error with respect to all weights; ours and PyTorch only) it runs, in turn and in one process:
  ours       three 2-D convolutions per causal 3x3x3 convolution, over the frames that exist
  padded     the same after two zero frames (what those frames cost)
  conv3d     one 3-D convolution of XLA
  repeated   up-sampling by repetition and a 3x3 convolution (ours: four 2x2 convolutions of the small images)
  torch      diffusers' AutoencoderKLWan, which works in chunks of one latent frame
Times are CPU seconds of the process, pinned to one core with one thread each: unlike wall time they hardly depend on what
else the machine does. Reported: median, lowest and highest of the repeats, ratio of medians to PyTorch's, compile time, and
the largest relative L2 difference of any result, so that only equal computations are compared.

The published system reports no such number. Our numbers: see the JSON file, which names processor and versions; it holds
the first three clips (the full-width clip was not finished when it was written).
"""

import functools
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np

from experiments import harness


class Clip(NamedTuple):
    name: str
    base: int
    frames: int
    height: int
    width: int


CLIPS = (
    Clip("mini image", 16, 1, 64, 112),
    Clip("full-width image", 96, 1, 64, 112),
    Clip("mini clip", 16, 17, 64, 112),
    Clip("full-width clip", 96, 5, 64, 64),
)
OPERATIONS = ("encode", "decode", "gradient")


def padded_conv(p, x, past, *, causal_conv):
    """`causal_conv` with zero frames in place of missing history."""
    import jax.numpy as jnp

    history = jnp.zeros((2, *x.shape[1:]), x.dtype) if past is None else past
    return causal_conv(p, x, history)


def conv3d(p, x, past):
    """One 3-D convolution in place of `vae.causal_conv`, for whole clips: it remembers nothing."""
    import jax

    assert past is None
    y = jax.lax.conv_general_dilated(
        x[None],
        p["kernel"],
        (1, 1, 1),
        ((2, 0), (1, 1), (1, 1)),
        dimension_numbers=("NDHWC", "DHWIO", "NDHWC"),
    )
    return y[0] + p["bias"].reshape(1, 1, 1, -1), None


def repeated(x, kernel):
    """Repetition and one convolution in place of `vae.up_conv`."""
    import jax
    import jax.numpy as jnp

    t, h, w, c = x.shape
    x = jnp.broadcast_to(x[:, :, None, :, None], (t, h, 2, w, 2, c)).reshape(t, 2 * h, 2 * w, c)
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def random_params(cfg):
    """Weights for which every layer matters, as JAX arrays."""
    import jax.numpy as jnp

    from roge_jax.core.params import flatten, unflatten
    from roge_jax.video import vae

    rng = np.random.default_rng(0)
    params = {}
    for path, spec in flatten(vae.vae_specs(cfg)).items():
        x = rng.normal(size=spec.shape)
        if len(spec.shape) > 1:
            x /= np.sqrt(np.prod(spec.shape[:-1]))
        else:
            x = 0.1 * x + path.endswith("scale")
        params[path] = jnp.asarray(x, jnp.float32)
    return unflatten(params)


def jax_operations(cfg, params, video, latents, names):
    """{operation: (function without arguments, compile seconds)}; traces with the convolutions in force now."""
    import jax
    import jax.numpy as jnp

    from roge_jax.video import vae

    def error(p, x):
        z = vae.encode_moments(p, x, cfg=cfg)[..., : cfg.latent]
        return jnp.square(jnp.clip(vae.decode_raw(p, z, cfg=cfg), -1, 1) - x).mean()

    jobs = {
        "encode": (functools.partial(vae.encode_moments, cfg=cfg), video),
        "decode": (functools.partial(vae.decode_raw, cfg=cfg), latents),
        "gradient": (jax.grad(error), video),
    }
    operations = {}
    for name in names:
        f, x = jobs[name]
        start = time.perf_counter()
        compiled = jax.jit(f).lower(params, x).compile()
        operations[name] = (
            lambda compiled=compiled, x=x: jax.block_until_ready(compiled(params, x)),
            time.perf_counter() - start,
        )
    return operations


def torch_operations(cfg, params, video, latents):
    import torch
    from diffusers import AutoencoderKLWan

    from roge_jax.weights import mapping, wan_vae

    entries = wan_vae.mapping(cfg, "diffusers")
    network = AutoencoderKLWan(base_dim=cfg.base).eval()
    state = mapping.to_theirs(entries, params)
    network.load_state_dict({key: torch.tensor(value) for key, value in state.items()})
    x, z = (
        torch.from_numpy(np.moveaxis(np.array(v), -1, 0)[None].copy()) for v in (video, latents)
    )

    def last(y):
        return np.moveaxis(y.detach().numpy()[0], 0, -1)

    def encode():
        with torch.no_grad():
            return last(network.encode(x).latent_dist.parameters)

    def decode():
        with torch.no_grad():
            return last(network.decode(z).sample)

    def gradient():
        network.zero_grad(set_to_none=True)
        y = network.decode(network.encode(x).latent_dist.mean).sample
        torch.square(y - x).mean().backward()
        return network

    def gradient_tree(network):
        """Gradients in our layout; weights that a single image never uses have none."""
        grads = {
            key: np.zeros(value.shape, np.float32) if value.grad is None else value.grad.numpy()
            for key, value in network.named_parameters()
        }
        return mapping.to_ours(entries, grads)

    return {"encode": encode, "decode": decode, "gradient": gradient}, gradient_tree


def flat(result) -> np.ndarray:
    import jax

    return np.concatenate([np.asarray(x, np.float64).ravel() for x in jax.tree.leaves(result)])


def difference(a, b) -> float:
    a, b = flat(a), flat(b)
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def measure(clip: Clip, repeats: int) -> Iterator[dict]:
    import jax

    from roge_jax.config import VAEConfig
    from roge_jax.video import vae

    cfg = VAEConfig(base=clip.base)
    params = random_params(cfg)
    rng = np.random.default_rng(1)
    shape = (clip.frames, clip.height, clip.width, 3)
    slots = 1 + (clip.frames - 1) // 4
    video = jax.numpy.asarray(rng.uniform(-1, 1, shape), jax.numpy.float32)
    latents = rng.normal(size=(slots, clip.height // 8, clip.width // 8, 16))
    latents = jax.numpy.asarray(latents, jax.numpy.float32)

    compiled = {"ours": jax_operations(cfg, params, video, latents, OPERATIONS)}
    padded = functools.partial(padded_conv, causal_conv=vae.causal_conv)
    forms = {
        "padded": ("causal_conv", padded),
        "conv3d": ("causal_conv", conv3d),
        "repeated": ("up_conv", repeated),
    }
    for name, (function, form) in forms.items():
        with mock.patch.object(vae, function, form):
            compiled[name] = jax_operations(cfg, params, video, latents, OPERATIONS[:2])
    theirs, gradient_tree = torch_operations(cfg, params, video, latents)

    for operation in OPERATIONS:
        runs = {name: ops[operation][0] for name, ops in compiled.items() if operation in ops}
        runs["torch"] = theirs[operation]
        results = {name: run() for name, run in runs.items()}  # warm
        if operation == "gradient":
            results["torch"] = gradient_tree(results["torch"])
        if operation == "decode":  # diffusers clamps
            results = {name: np.clip(np.asarray(y), -1, 1) for name, y in results.items()}
        gaps = {
            name: difference(results[name], results["torch"]) for name in runs if name != "torch"
        }
        del results
        found = harness.in_turn(runs, repeats).cpu
        taken = {name: harness.summary(values) for name, values in found.items()}
        for name, seconds in taken.items():
            ratio = seconds["median"] / taken["torch"]["median"]
            row = {
                "clip": clip._asdict(),
                "operation": operation,
                "form": name,
                "cpu_s": seconds,
                "ratio_to_torch": ratio,
            }
            if name != "torch":
                row |= {"compile_s": compiled[name][operation][1], "rel_l2_to_torch": gaps[name]}
            print(
                f"{clip.name:18s} {operation:9s} {name:7s} {seconds['median']:8.3f} s  "
                f"[{seconds['low']:.3f}, {seconds['high']:.3f}]  {ratio:5.2f} x torch",
                flush=True,
            )
            yield row


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--core", type=int, default=0, help="the CPU core to run on (default: 0)")
    p.add_argument("--repeats", type=int, default=7)
    p.add_argument("--clips", nargs="+", default=(), help="these clips (default: all)")
    p.add_argument("--out", type=Path, default=harness.RESULTS / "vae_speed.json")
    args = p.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {args.core})  # before JAX sizes its thread pool
    import diffusers
    import torch

    torch.set_num_threads(1)
    report = {
        "what": "Video VAE in float32, one core, CPU seconds; see experiments/speed/vae.py",
        "environment": harness.environment(),
        "peer": {"torch": torch.__version__, "diffusers": diffusers.__version__},
        "repeats": args.repeats,
        "rows": [],
    }
    for clip in CLIPS:
        if not args.clips or clip.name in args.clips:
            for row in measure(clip, args.repeats):
                report["rows"].append(row)
                harness.write(args.out, report)


if __name__ == "__main__":
    main()
