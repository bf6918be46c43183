"""Ray-map encoder, ray-scene transformer and RGB head (Sec. 3.1 of the paper, after LagerNVS).

Every view's camera rays, eight by eight pixels to a token, query the scene tokens. In the bidirectional form the
scene tokens are refined by the rays as well: `per_view` gives each queried view its own refinement (exact, what the
published weights compute); `shared` refines them once, by the rays of the context views, and lets every view read
that (an approximation that costs about half).
"""

import jax
import jax.numpy as jnp

from ..config import RendererConfig
from ..core import products
from ..core.attention import attention, merge_heads, split_heads
from ..core.layers import (
    layer_norm,
    linear,
    linear_specs,
    mlp,
    mlp_specs,
    norm_specs,
    patch_conv,
    patch_conv_specs,
    rms_norm,
    unpatchify,
)
from ..core.params import Spec, Tree, fan_in, normal, stack, zeros
from ..core.sharding import constrain, ways
from ..core.stepping import checkpoint
from .lookup import lookup_specs
from .relative import Relative, inside, to_key, to_output, to_query

EPS = 1e-5


def attention_specs(d: int, heads: int, *, depth: int) -> Tree:
    """Attention of width d without biases, q and k normalised per head; `depth` scales the output's initial
    values.
    """
    return {
        "q": linear_specs(d, d, ("embed", "heads"), bias=False),
        "k": linear_specs(d, d, ("embed", "heads"), bias=False),
        "v": linear_specs(d, d, ("embed", "heads"), bias=False),
        "proj": linear_specs(
            d, d, ("heads", "embed"), bias=False, init=fan_in((3 * depth) ** -0.5)
        ),
        "q_norm": norm_specs(d // heads, bias=False),
        "k_norm": norm_specs(d // heads, bias=False),
    }


def attend(
    p: Tree, x, context, heads: int, *, rq: Relative | None = None, rk: Relative | None = None
):
    """Queries x [v, l, d] on `context` [v, s, d], one per view, or [1, s, d], shared by all views.

    `rq` and `rk` are the cameras of the queries' and the keys' views; with them the context's tokens are
    [views of rk * tokens per view].
    """
    q = rms_norm(p["q_norm"], split_heads(linear(p["q"], x), heads), eps=EPS)
    k = rms_norm(p["k_norm"], split_heads(linear(p["k"], context), heads), eps=EPS)
    v = split_heads(linear(p["v"], context), heads)
    if rq is not None and rk is not None:
        q, k, v = to_query(rq, q), _keys(rk, k), _keys(rk, v)
    dtype = products.dtype_of(p["q"]["kernel"])
    # One matrix product for all views, unless they are on different devices.
    if context.shape[0] == 1 and x.shape[0] > 1 and ways("seq") == 1:
        y = attention(q.reshape(1, -1, *q.shape[2:]), k, v, dtype=dtype).reshape(q.shape)
    else:
        y = attention(q, k, v, dtype=dtype, over="views")
    y = to_output(rq, y) if rq is not None else y
    return linear(p["proj"], merge_heads(y))


def _keys(r: Relative, t: jax.Array) -> jax.Array:
    """Transform keys or values [u, m * s, k, e], whose tokens belong to the m views of `r`."""
    if r.project is None:
        return to_key(r, t)
    m = r.project.shape[0]
    u, s, k, e = t.shape
    t = jnp.moveaxis(t.reshape(u, m, s // m, k, e), 1, 0).reshape(m, u * (s // m), k, e)
    angles = jnp.tile(r.angles, (u, 1, 1))
    t = to_key(r._replace(angles=angles), t).reshape(m, u, s // m, k, e)
    return jnp.moveaxis(t, 0, 1).reshape(u, s, k, e)


# Blocks. `cross`: rays read the scene. `bidirectional`: the scene reads the rays too. `full`: one joint sequence.


def cross_block_specs(d: int, heads: int, depth: int) -> Tree:
    """Rays: self-attention, cross-attention to the scene, MLP."""
    return {
        "norm_self": norm_specs(d, bias=False),
        "self_attn": attention_specs(d, heads, depth=depth),
        "norm_cross": norm_specs(d, bias=False),
        "norm_scene": norm_specs(d, bias=False),
        "cross_attn": attention_specs(d, heads, depth=depth),
        "norm_mlp": norm_specs(d, bias=False),
        "mlp": mlp_specs(d, 4 * d, bias=False, init_out=fan_in((3 * depth) ** -0.5)),
    }


def bidirectional_block_specs(d: int, heads: int, depth: int) -> Tree:
    """A cross block in which the scene then reads the rays: the published form."""
    return cross_block_specs(d, heads, depth) | {
        "scene_attn": attention_specs(d, heads, depth=depth),
        "norm_scene_mlp": norm_specs(d, bias=False),
        "scene_mlp": mlp_specs(d, 4 * d, bias=False, init_out=fan_in((3 * depth) ** -0.5)),
    }


def full_block_specs(d: int, heads: int, depth: int) -> Tree:
    """One sequence of rays and scene: self-attention, MLP."""
    return {
        "norm_self": norm_specs(d, bias=False),
        "self_attn": attention_specs(d, heads, depth=depth),
        "norm_mlp": norm_specs(d, bias=False),
        "mlp": mlp_specs(d, 4 * d, bias=False, init_out=fan_in((3 * depth) ** -0.5)),
    }


def _norm(p, x):
    return layer_norm(p, x, eps=EPS)


def read_scene(p: Tree, x, scene, heads: int, rays: Relative | None, cameras: Relative | None):
    """Self-attention of the rays of each view, then cross-attention to the normalised scene tokens, then MLP.

    Returns the new rays and the normalised rays that a refinement of the scene attends to.
    """
    own = None if rays is None else inside(rays)
    y = _norm(p["norm_self"], x)
    x = x + attend(p["self_attn"], y, y, heads, rq=own, rk=own)
    xn = _norm(p["norm_cross"], x)
    x = x + attend(p["cross_attn"], xn, scene, heads, rq=rays, rk=cameras)
    return x + mlp(p["mlp"], _norm(p["norm_mlp"], x), exact=True), xn


def refine_scene(p: Tree, z, zn, xn, heads: int, rays: Relative | None, cameras: Relative | None):
    """Scene tokens z read the rays xn (both normalised), then their own MLP."""
    z = z + _scene_reads(p["scene_attn"], zn, xn, heads, rays, cameras)
    return z + mlp(p["scene_mlp"], _norm(p["norm_scene_mlp"], z), exact=True)


def _scene_reads(p, zn, xn, heads, rays, cameras):
    if rays is None:
        return attend(p, zn, xn, heads)
    u, s, d = zn.shape  # one copy of the scene per queried view (or a single one)
    m, v = cameras.project.shape[0], rays.project.shape[0]
    if u == 1:
        y = attend(p, zn.reshape(m, s // m, d), xn.reshape(1, -1, d), heads, rq=cameras, rk=rays)
        return y.reshape(u, s, d)

    def one(zn, xn, project, unproject):
        own = Relative(project[None], unproject[None], rays.angles)
        return attend(p, zn.reshape(m, s // m, d), xn[None], heads, rq=cameras, rk=own).reshape(
            s, d
        )

    assert u == v
    return jax.vmap(one)(zn, xn, rays.project, rays.unproject)


# Fewer scene tokens.

MERGES = {1: (1, 1), 2: (1, 2), 4: (2, 2)}  # `RendererConfig.merge`: rows, columns of a cell


def merge_scene(
    tokens: jax.Array, cameras: Relative | None, grid: tuple[int, int], merge: int
) -> tuple[jax.Array, Relative | None]:
    """Scene tokens [m, l, d] of a row-major `grid` per photo, averaged over cells of neighbours; cells at an odd
    border are smaller. Angles are linear in the position, so a cell's mean is the angle of its middle.
    """
    cell = (*MERGES[merge], 1)

    def sums(x):  # [l, c]
        x = jax.lax.reduce_window(
            x.reshape(*grid, x.shape[-1]), 0.0, jax.lax.add, cell, cell, "SAME"
        )
        return x.reshape(-1, x.shape[-1])

    def means(x):
        return sums(x) / sums(jnp.ones((x.shape[0], 1)))

    tokens = jax.vmap(means)(tokens)
    if cameras is None:
        return tokens, None
    angles = cameras.angles
    middles = means(angles.reshape(len(angles), -1)).reshape(-1, *angles.shape[1:])
    return tokens, cameras._replace(angles=middles)


# The whole ray query.


def renderer_specs(cfg: RendererConfig) -> Tree:
    """Leaves of ray embedding, registers, `cfg.depth` blocks of the form `cfg.attention`, RGB head, and photo look-up if there is one."""
    d, heads, depth = cfg.width, cfg.heads, cfg.depth
    specs = {
        "registers": Spec((cfg.registers, d), (None, "embed"), normal(0.02)),
        "ray_embed": patch_conv_specs(cfg.patch, 6, d, bias=False),
        "ray_norm": norm_specs(d, bias=False),
        "rgb_head": {
            "norm": norm_specs(d, bias=False),
            "linear": linear_specs(d, 3 * cfg.patch**2, ("embed", None), bias=False, init=zeros),
        },
    }
    if cfg.lookup:
        specs["lookup"] = lookup_specs(d, cfg.patch, cfg.lookup, cfg.matching)
    if cfg.attention == "bidirectional":
        specs["blocks"] = stack(bidirectional_block_specs(d, heads, depth), depth - 1)
        specs["last_block"] = cross_block_specs(d, heads, depth)
    elif cfg.attention == "cross":
        specs["blocks"] = stack(cross_block_specs(d, heads, depth), depth)
    else:
        specs["blocks"] = stack(full_block_specs(d, heads, depth), depth)
    return specs


def embed_rays(p: Tree, plucker: jax.Array) -> jax.Array:
    """Plücker maps [v, h, w, 6] = [d, o x d] -> ray tokens [v, l, d]."""
    return _norm(p["ray_norm"], patch_conv(p["ray_embed"], plucker))


def query_rays(
    p: Tree,
    scene_tokens: jax.Array,
    plucker: jax.Array,
    *,
    cfg: RendererConfig,
    rays: Relative | None = None,
    cameras: Relative | None = None,
    contexts: int | None = None,
    collect: bool = False,
):
    """Ray features Phi [v, h/8, w/8, d] of views with Plücker maps [v, h, w, 6], before the head's norm.

    scene_tokens [m, l, d]. `rays` and `cameras` (see `relative.relative_cameras`; registers are the specials of
    `rays`, the context's patch tokens have none) are given iff the config asks for relative cameras. `contexts`: how
    many leading views are the contexts, needed by the shared refinement. Views are processed `cfg.chunk` at a time
    under `lax.map`, so memory does not grow with their number. With `collect` (no chunks) returns also the outputs
    of all blocks.
    """
    z = scene_tokens.reshape(1, -1, scene_tokens.shape[-1])
    v, h, w, _ = plucker.shape
    levels = None
    if cfg.attention == "bidirectional" and cfg.refinement == "shared":
        lead = rays
        if rays is not None and rays.project is not None and rays.unproject is not None:
            lead = Relative(rays.project[:contexts], rays.unproject[:contexts], rays.angles)
        levels = shared_levels(p, z, plucker[:contexts], cfg=cfg, rays=lead, cameras=cameras)

    def some(plucker, project, unproject):
        plucker = constrain(plucker, ("views", None, None, None))
        own = None if rays is None else Relative(project, unproject, rays.angles)
        return _query(p, z, levels, plucker, cfg=cfg, rays=own, cameras=cameras, collect=collect)

    project = None if rays is None else rays.project
    unproject = None if rays is None else rays.unproject
    if collect or v <= cfg.chunk:
        x, out = some(plucker, project, unproject)
    else:
        chunks = -(-v // cfg.chunk)
        pad = chunks * cfg.chunk - v

        def split(t):
            if t is None:
                return None
            t = jnp.concatenate([t, jnp.repeat(t[-1:], pad, 0)])
            # A chunk takes every `chunks`-th view: devices that share chunks keep neighbouring views.
            return jnp.swapaxes(t.reshape(cfg.chunk, chunks, *t.shape[1:]), 0, 1)

        # Every block is checkpointed already; the outer one keeps a single chunk's blocks in memory at a time.
        x, out = jax.lax.map(
            checkpoint(lambda args: some(*args)),
            tuple(split(t) for t in (plucker, project, unproject)),
        )
        x = jnp.swapaxes(x, 0, 1).reshape(chunks * cfg.chunk, *x.shape[2:])[:v]
    features = x.reshape(v, h // cfg.patch, w // cfg.patch, -1)
    return (features, out) if collect else features


def _query(p, z, levels, plucker, *, cfg, rays, cameras, collect):
    v, heads = plucker.shape[0], cfg.heads
    x = embed_rays(p, plucker)
    out = {"ray_tokens": x}
    registers = p["registers"].astype(jnp.float32)
    x = jnp.concatenate([jnp.broadcast_to(registers[None], (v, *registers.shape)), x], 1)

    def checkpointed(step):
        def per_view(carry, p):
            y = jax.tree.map(lambda t: constrain(t, ("views", None, None)), step(carry, p))
            return y, y if collect else None

        return checkpoint(per_view)

    if cfg.attention == "full":

        def full(x, p):
            y = _norm(p["norm_self"], x)
            x = x + attend(p["self_attn"], y, y, heads)
            return x + mlp(p["mlp"], _norm(p["norm_mlp"], x), exact=True)

        x = jnp.concatenate([jnp.broadcast_to(z, (v, *z.shape[1:])), x], 1)
        x, out["x"] = jax.lax.scan(checkpointed(full), x, p["blocks"])
        return x[:, z.shape[1] + cfg.registers :], out

    if cfg.attention == "cross":

        def cross(x, p):
            return read_scene(p, x, _norm(p["norm_scene"], z), heads, rays, cameras)[0]

        x, out["x"] = jax.lax.scan(checkpointed(cross), x, p["blocks"])
        return x[:, cfg.registers :], out

    if levels is None:

        def bidirectional(carry, p):
            x, z = carry
            zn = _norm(p["norm_scene"], z)
            x, xn = read_scene(p, x, zn, heads, rays, cameras)
            return x, refine_scene(p, z, zn, xn, heads, rays, cameras)

        copies = jnp.broadcast_to(z, (v, *z.shape[1:]))
        (x, z), collected = jax.lax.scan(checkpointed(bidirectional), (x, copies), p["blocks"])
        out["x"], out["z"] = collected if collect else (None, None)
    else:

        def shared(x, p_and_z):
            p, zn = p_and_z
            return read_scene(p, x, zn, heads, rays, cameras)[0]

        x, out["x"] = jax.lax.scan(checkpointed(shared), x, (p["blocks"], levels[0]))
        z = levels[1]
    last = p["last_block"]
    x, _ = read_scene(last, x, _norm(last["norm_scene"], z), heads, rays, cameras)
    return x[:, cfg.registers :], out


def shared_levels(p, z, plucker, *, cfg, rays, cameras):
    """Scene tokens at every level, refined once by the rays of the context views: ([L-1, 1, s, d], [1, s, d])."""
    x = embed_rays(p, plucker)
    registers = p["registers"].astype(jnp.float32)
    x = jnp.concatenate([jnp.broadcast_to(registers[None], (x.shape[0], *registers.shape)), x], 1)

    @checkpoint
    def step(carry, p):
        x, z = carry
        zn = _norm(p["norm_scene"], z)
        x, xn = read_scene(p, x, zn, cfg.heads, rays, cameras)
        every = xn if rays is not None else xn.reshape(1, -1, xn.shape[-1])
        return (x, refine_scene(p, z, zn, every, cfg.heads, rays, cameras)), zn

    (_, z), levels = jax.lax.scan(step, (x, z), p["blocks"])
    return levels, z


@jax.named_scope("picture")
def decode_rgb(p: Tree, features: jax.Array, *, cfg: RendererConfig) -> jax.Array:
    """Ray features [v, gh, gw, d] -> RGB [v, h, w, 3] in (0, 1)."""
    v, gh, gw, d = features.shape
    y = linear(p["linear"], _norm(p["norm"], features.reshape(v, gh * gw, d)))
    return unpatchify(jax.nn.sigmoid(y), (gh, gw), cfg.patch)
