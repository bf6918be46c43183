"""The photo look-up on a CPU: its views all at once or one by one, and the gradient of its convolutions inside a loop.

    OPENBLAS_NUM_THREADS=1 NPROC=1 XLA_FLAGS=--xla_cpu_multi_thread_eigen=false taskset -c 0 \
        python -m experiments.speed.lookup          results/lookup_speed.json; about 4 minutes

`mini`'s look-up for the 20 views of a window with 3 photos: the picture, its gradient by the ray features (what LoRA
training needs) and by the look-up's weights (stage `lookup`). Processor seconds, the formulations in turn within every
repeat; temporary memory by XLA's own account. Described in docs/notes/making_mini.md.
"""

import jax
import jax.numpy as jnp
import numpy as np

import roge_jax as rj
from experiments import harness
from roge_jax.core.layers import conv2d, convolve
from roge_jax.recon import lookup

VIEWS, PHOTOS = 20, 3


def functions():
    """name -> (function, arguments) of the look-up."""
    params, config = rj.load("mini")
    weights, cfg = params["renderer"]["lookup"], config.renderer
    h, w, rng = config.recon_height, config.recon_width, np.random.default_rng(0)
    grid = (VIEWS, h // cfg.patch, w // cfg.patch, cfg.width)
    features = jnp.asarray(rng.standard_normal(grid), jnp.float32)
    head = jnp.asarray(rng.random((VIEWS, h, w, 3)), jnp.float32)
    photos = head[:PHOTOS]
    K = np.tile(np.array([[w, 0, w / 2], [0, w, h / 2], [0, 0, 1]], np.float32), (VIEWS, 1, 1))
    c2w = np.tile(np.eye(4, dtype=np.float32), (VIEWS, 1, 1))
    c2w[:, :3, 3] = 0.3 * rng.standard_normal((VIEWS, 3))
    of, seen_by = (K, c2w), (K[:PHOTOS], c2w[:PHOTOS])

    def picture(weights, features, head):
        return lookup.look_up(weights, features, head, photos, of, seen_by, cuts=cfg.lookup)

    def loss(*arguments):
        shown = picture(*arguments)
        return sum(jnp.square(x).mean() for x in (shown.rgb, shown.photos, shown.coarse))

    arguments = (weights, features, head)
    return {
        "picture": (picture, arguments),
        "gradient by ray features": (jax.grad(loss, argnums=(1, 2)), arguments),
        "gradient by weights": (jax.grad(loss), arguments),
    }


def compiled(function, arguments, *, at_once: bool):
    """The function with its views at once (as on a mesh that splits them) or one by one."""
    rule = lookup.ways
    lookup.ways = (lambda axis: 2) if at_once else rule
    try:
        return jax.jit(lambda *a: function(*a)).lower(*arguments).compile()
    finally:
        lookup.ways = rule


def convolutions(rounds: int) -> dict:
    """Gradients of a convolution over 48 maps of 16 x 28, 16 channels, for 4 views in a `lax.map`."""
    rng = np.random.default_rng(1)
    maps = jnp.asarray(rng.standard_normal((4, 48, 16, 28, 16)), jnp.float32)
    p = {
        "kernel": jnp.asarray(rng.standard_normal((3, 3, 16, 16)), jnp.float32),
        "bias": jnp.zeros(16),
    }
    plain = lambda p, x: convolve(x, p["kernel"]) + p["bias"].reshape(1, 1, 1, -1)  # noqa: E731

    def gradient(f):
        one = jax.checkpoint(lambda x, p: jnp.square(f(p, x)).sum())
        total = lambda p, maps: jax.lax.map(lambda x: one(x, p), maps).sum()  # noqa: E731
        return calling(jax.jit(jax.grad(total, argnums=(0, 1))), p, maps)

    return harness.compare({"XLA's": gradient(plain), "ours": gradient(conv2d)}, rounds)


def calling(function, *arguments):
    """A call that returns when the result is there."""
    return lambda: jax.block_until_ready(function(*arguments))


def main() -> None:
    p = harness.parser(__doc__)
    p.add_argument("--rounds", type=int, default=5)
    args = p.parse_args()
    rows = {}
    for name, (function, arguments) in functions().items():
        ways = {
            "at once": compiled(function, arguments, at_once=True),
            "one by one": compiled(function, arguments, at_once=False),
        }
        print(name)
        calls = {way: calling(f, *arguments) for way, f in ways.items()}
        rows[name] = harness.compare(calls, args.rounds)
        for way, run in ways.items():
            held = run.memory_analysis().temp_size_in_bytes
            rows[name][way]["temporary MB"] = round(held / 1e6, 1)
    print("gradient of a convolution in a loop")
    rows["gradient of a convolution in a loop"] = convolutions(args.rounds)
    content = {"views": VIEWS, "photos": PHOTOS, "rows": rows}
    harness.write("lookup_speed.json", {"environment": harness.environment()} | content)


if __name__ == "__main__":
    main()
