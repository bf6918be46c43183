"""The peer of the transformer's rows: the same network in PyTorch, in a process of its own on the same device.

diffusers' `WanTransformer3DModel` where diffusers can be imported, else the same blocks written out below; the row says
which, and why. Compiled on a GPU (eager where compiling fails, which is said); attention by whichever of PyTorch's kernels is fastest there.
It computes the keys and values of the text in every call, which ours caches (1.5 % of the 192x336 forward).
"""

import os
from typing import Any

from experiments.speed.rows import Row, forward_flops
from experiments.speed.timing import measure
from roge_jax.config import DiTConfig


def run(row: Row, repeats: int, seconds: float) -> dict[str, Any]:
    try:
        import torch
    except ImportError:
        return {"status": "not measured", "why": "PyTorch is not installed"}
    import jax

    gpu = jax.default_backend() == "gpu"
    if gpu and not torch.cuda.is_available():
        return {"status": "not measured", "why": "this PyTorch sees no GPU"}
    if not gpu:
        torch.set_num_threads(len(os.sched_getaffinity(0)))
    found: dict[str, Any] = {"torch": torch.__version__, "network": "diffusers", "kernels": {}}
    try:
        net, arguments = diffusers_network(row, gpu)
    except torch.cuda.OutOfMemoryError as error:
        raise MemoryError(str(error).splitlines()[0][:300]) from error
    except (
        Exception
    ) as error:  # its imports are lazy: what does not fit together raises errors of many kinds
        found |= {"network": "plain PyTorch blocks", "why_not_diffusers": str(error)[:300]}
        net, arguments = plain_network(row, gpu)
    best: dict[str, Any] = {}
    for name, kernel in kernels(gpu).items():
        try:
            timed = time_network(net, arguments, kernel, gpu, repeats, seconds / 2)
        except torch.cuda.OutOfMemoryError as error:
            raise MemoryError(str(error).splitlines()[0][:300]) from error
        except RuntimeError as error:  # this kernel does not take these shapes
            found["kernels"][name] = str(error).splitlines()[0][:200]
            continue
        found["kernels"][name] = timed["seconds"]
        if not best or timed["seconds"] < best["seconds"]:
            best = timed
    if not best:
        return found | {"status": "not measured", "why": "no attention kernel ran"}
    return found | best | {"tflops": forward_flops(row) / best["seconds"] / 1e12}


def kernels(gpu: bool) -> dict[str, Any]:
    if not gpu:
        return {"default": None}
    from torch.nn.attention import SDPBackend

    return {"cudnn": SDPBackend.CUDNN_ATTENTION, "flash": SDPBackend.FLASH_ATTENTION}


def time_network(net, arguments: dict, kernel, gpu: bool, repeats: int, seconds: float) -> dict:
    import contextlib

    import torch
    from torch.nn.attention import sdpa_kernel

    def timed(function) -> dict[str, Any]:
        def call():
            with (
                torch.no_grad(),
                contextlib.nullcontext() if kernel is None else sdpa_kernel(kernel),
            ):
                function(**arguments)
            if gpu:
                torch.cuda.synchronize()

        return measure(call, repeats, seconds)

    if not gpu:
        return timed(net) | {"compiled": False}
    try:
        torch.compiler.reset()
        return timed(torch.compile(net)) | {"compiled": True}
    except torch.cuda.OutOfMemoryError:
        raise
    except Exception as error:  # no compiler on the host: PyTorch raises errors of many kinds
        eager = timed(net)
        return eager | {"compiled": False, "why_not_compiled": str(error).splitlines()[0][:200]}


def _fill(net, kind, device: str):
    import torch

    net = net.to(kind).to_empty(device=device).eval()
    with torch.no_grad():
        for leaf in net.parameters():
            leaf.normal_(0.0, 0.02)
    return net


def wan_options(d: DiTConfig) -> dict[str, Any]:
    """Our transformer in the words of diffusers' `WanTransformer3DModel`."""
    image = {"image_dim": d.clip_dim, "added_kv_proj_dim": d.width} if d.clip_dim else {}
    return image | {
        "num_attention_heads": d.heads,
        "attention_head_dim": d.width // d.heads,
        "in_channels": d.in_channels,
        "out_channels": d.out_channels,
        "text_dim": d.text_dim,
        "freq_dim": d.freq_dim,
        "ffn_dim": d.ffn,
        "num_layers": d.depth,
    }


def diffusers_network(row: Row, gpu: bool):
    import torch
    from diffusers import WanTransformer3DModel

    cfg, m = row.config, row.m
    d, (lh, lw), slots = cfg.dit, cfg.latent_size, cfg.slots(m)
    kind, device = (torch.bfloat16, "cuda") if gpu else (torch.float32, "cpu")
    with torch.device("meta"):
        net = WanTransformer3DModel(**wan_options(d))
    rope = type(net.rope)(d.width // d.heads, (1, d.patch, d.patch), 1024)
    net = _fill(net, kind, device)
    net.rope = rope.to(device)
    arguments = {
        "hidden_states": torch.randn(1, d.in_channels, slots, lh, lw, device=device, dtype=kind),
        "timestep": torch.tensor([500.0], device=device),
        "encoder_hidden_states": torch.randn(1, d.text_len, d.text_dim, device=device, dtype=kind),
        "return_dict": False,
    }
    if d.clip_dim:
        arguments["encoder_hidden_states_image"] = torch.randn(
            1, d.clip_rows, d.clip_dim, device=device, dtype=kind
        )
    return net, arguments


def plain_network(row: Row, gpu: bool):
    """The blocks alone (99 % of the work): self-attention with rotations, cross-attention, MLP, modulation."""
    import torch
    from torch import nn
    from torch.nn import functional as F

    cfg, m = row.config, row.m
    d, slots = cfg.dit, cfg.slots(m)
    lh, lw = cfg.latent_size
    tokens, e = slots * (lh // d.patch) * (lw // d.patch), d.width // d.heads
    kind, device = (torch.bfloat16, "cuda") if gpu else (torch.float32, "cpu")

    def attend(q, k, v):
        q, k, v = (x.unflatten(-1, (d.heads, e)).transpose(1, 2) for x in (q, k, v))
        return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)

    def turn(x, cos, sin):
        a, b = x.unflatten(-1, (d.heads, e // 2, 2)).unbind(-1)
        return torch.stack([a * cos - b * sin, a * sin + b * cos], -1).flatten(-3)

    class Block(nn.Module):
        def __init__(self):
            super().__init__()
            self.modulation = nn.Parameter(torch.empty(6, d.width))
            names = ["q", "k", "v", "o"] + (["cq", "ck", "cv", "co"] if d.text_len else [])
            self.linears = nn.ModuleDict({name: nn.Linear(d.width, d.width) for name in names})
            self.norms = nn.ModuleDict(
                {name: nn.RMSNorm(d.width) for name in ("q", "k", "cq", "ck")}
            )
            self.mlp = nn.Sequential(
                nn.Linear(d.width, d.ffn), nn.GELU("tanh"), nn.Linear(d.ffn, d.width)
            )

        def forward(self, x, text, cos, sin):
            s1, c1, g1, s2, c2, g2 = self.modulation.unbind(0)
            p, n = self.linears, self.norms
            y = F.layer_norm(x, (d.width,)) * (1 + c1) + s1
            q, k = turn(n["q"](p["q"](y)), cos, sin), turn(n["k"](p["k"](y)), cos, sin)
            x = x + g1 * p["o"](attend(q, k, p["v"](y)))
            if d.text_len:
                y = F.layer_norm(x, (d.width,))
                k, v = n["ck"](p["ck"](text)), p["cv"](text)
                x = x + p["co"](attend(n["cq"](p["cq"](y)), k, v))
            return x + g2 * self.mlp(F.layer_norm(x, (d.width,)) * (1 + c2) + s2)

    class Network(nn.Module):
        def __init__(self):
            super().__init__()
            self.blocks = nn.ModuleList(Block() for _ in range(d.depth))

        def forward(self, x, text, cos, sin):
            for block in self.blocks:
                x = block(x, text, cos, sin)
            return x

    with torch.device("meta"):
        net = Network()
    angles = torch.rand(1, tokens, 1, e // 2, device=device)
    arguments = {
        "x": torch.randn(1, tokens, d.width, device=device, dtype=kind),
        "text": torch.randn(1, max(d.text_len, 1), d.width, device=device, dtype=kind),
        "cos": angles.cos().to(kind),
        "sin": angles.sin().to(kind),
    }
    return _fill(net, kind, device), arguments
