"""The reconstruction branch: equal to the published networks on stored cases, and properties that must hold."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parity import key_listing, load_case, rel_l2, rule_tensor, rule_weights, state_shapes

from roge_jax.config import EncoderConfig, RendererConfig, preset
from roge_jax.core import params
from roge_jax.errors import UserError
from roge_jax.geometry.rays import plucker
from roge_jax.recon import ray_scene, vggt
from roge_jax.recon.relative import relative_cameras
from roge_jax.weights import lagernvs, mapping

TOLERANCE = 1e-5  # relative L2, float32; see parity.py
TOLERANCE_REAL = 1e-4  # 24 + 48 + 12 blocks of the real width
DINO = ["lagernvs_dino_tiny", "lagernvs_dino_eps_tiny", "lagernvs_dino_native_grid_tiny"]
AGGREGATOR = ["lagernvs_aggregator_tiny", "lagernvs_aggregator_eps_tiny"]
RENDERER = [f"lagernvs_renderer_{kind}_tiny" for kind in ("bidirectional", "cross", "full")]


def compare(name, found, expected, tolerance=TOLERANCE):
    """Every named tensor of `expected`, by relative L2; all errors are shown when one is too large."""
    errors = {key: rel_l2(found[key], value) for key, value in expected.items()}
    print(name, {key: f"{value:.1e}" for key, value in errors.items()})
    assert all(value <= tolerance for value in errors.values()), errors


def outputs(case):
    return {key: value for key, value in case.tensors.items() if not key.startswith("in.")}


def channels_last(x):
    return np.ascontiguousarray(np.moveaxis(x, -3, -1))


def moment_last(rays):
    """Their rays [.., 6, h, w] = [o x d, d] as ours [.., h, w, 6] = [d, o x d]."""
    return np.roll(channels_last(rays), 3, axis=-1)


def dino_config(case):
    shapes = {f"patch_embed.{key}": shape for key, shape in state_shapes(case).items()}
    width = case.config["embed_dim"]
    known = {"camera_token": (1, 2, 1, width), "register_token": (1, 2, 4, width)}
    cfg = lagernvs.vggt_config(shapes | known, prefix="")
    assert (cfg.heads, cfg.dino_depth) == (case.config["num_heads"], case.config["depth"])
    assert cfg.position_grid == case.config["img_size"] // 14
    return cfg


@pytest.mark.parametrize("name", DINO)
def test_patch_encoder_equals_the_published_one(name):
    case = load_case(name)
    cfg = dino_config(case)
    p = mapping.to_ours(lagernvs.dino_entries(cfg), rule_weights(case))
    params.check(p, vggt.dino_specs(cfg))

    @jax.jit
    def trace(p, images):
        patches, out = vggt.dino(p, images, cfg=cfg)
        first = jax.tree.map(lambda leaf: leaf[0], p["blocks"])
        block0 = vggt.block(first, out["tokens_in"], cfg.heads, eps=vggt.DINO_EPS)
        return patches, out, block0

    found = {}
    for i in range(len(case.config["sizes"])):
        patches, out, block0 = trace(p, channels_last(case.tensors[f"in.image{i}"]))
        found |= {
            f"mid.pos_embed{i}": out["pos_embed"][None],
            f"mid.tokens_in{i}": out["tokens_in"],
            f"mid.block0_out{i}": block0,
            f"mid.prenorm{i}": out["prenorm"],
            f"out.patch_tokens{i}": patches,
            f"out.cls_and_registers{i}": out["specials"],
        }
    compare(name, found, outputs(case))


def test_the_rule_of_the_weights_is_implemented_as_stored():
    from safetensors.numpy import load_file

    case = load_case("lagernvs_dino_native_grid_tiny")
    stored = load_file(case.folder / "weights.safetensors")
    made = rule_weights(case)
    assert made.keys() == stored.keys()
    assert max(rel_l2(made[key], stored[key]) for key in stored) < 1e-6


@pytest.mark.parametrize("name", AGGREGATOR)
def test_aggregator_equals_the_published_one(name):
    case = load_case(name)
    cfg = lagernvs.vggt_config(state_shapes(case), prefix="")
    assert (cfg.heads, cfg.depth, cfg.dino_depth) == (6, case.config["depth"], 12)
    p = mapping.to_ours(lagernvs.aggregator_entries(cfg), rule_weights(case))
    images = channels_last(case.tensors["in.images"][0])
    add = case.tensors["in.camera_add"][0, :, 0]

    @jax.jit
    def trace(p, images, add):
        return vggt.aggregate(p, images, add, cfg=cfg, collect=True)

    tokens, out = trace(p, images, add)
    found = {
        "mid.dino_patch_tokens": out["patch_tokens"],
        "mid.frame_block0_out": out["frame_blocks"][0],
        "mid.global_block0_out": out["global_blocks"][0],
        "out.tokens": tokens,
        "out.tokens_without_camera": trace(p, images, None)[0],
        "out.tokens_view0_only": trace(p, images[:1], add[:1])[0],
    }
    compare(name, {key: value[None] for key, value in found.items()}, outputs(case))


@pytest.mark.parametrize("name", RENDERER)
def test_renderer_equals_the_published_one(name):
    case = load_case(name)
    cfg = lagernvs.renderer_config(state_shapes(case), prefix="")
    assert f"{cfg.attention}" in name
    assert (cfg.depth, cfg.heads) == (case.config["depth"], case.config["heads"])
    p = mapping.to_ours(lagernvs.renderer_entries(cfg), rule_weights(case))
    params.check(p, ray_scene.renderer_specs(cfg))

    @jax.jit
    def trace(p, z, rays):
        features, out = ray_scene.query_rays(p, z, rays, cfg=cfg, collect=True)
        flat = features.reshape(features.shape[0], -1, cfg.width)
        normed = ray_scene._norm(p["rgb_head"]["norm"], flat)
        return flat, normed, ray_scene.decode_rgb(p["rgb_head"], features, cfg=cfg), out

    rays = moment_last(case.tensors["in.rays"][0])
    flat, normed, rgb, out = trace(p, case.tensors["in.z"], rays)
    found = {
        "mid.ray_tokens": out["ray_tokens"],
        "mid.block0_x": out["x"][0],
        "out.phi_prenorm": flat,
        "out.phi_normed": normed,
        "out.rgb": np.moveaxis(np.asarray(rgb), -1, -3)[None],
    }
    if cfg.attention == "bidirectional":
        found["mid.block0_z"] = out["z"][0]
    compare(name, found, outputs(case))


def made_one_by_one(case, entries):
    """As `mapping.to_ours` of `rule_weights`, but holding one leaf's sources at a time."""
    shapes = state_shapes(case)
    rule, number = case.info["weights"]["rule"], {key: n for n, key in enumerate(shapes)}
    assert sorted(key for e in entries for key in e.keys) == list(shapes)

    class Made(dict):
        def __missing__(self, key):
            value = rule_tensor(number[key], key, shapes[key], rule)
            return value.astype(jnp.bfloat16) if key in lagernvs.BFLOAT16 else value

    leaves = {e.path: jnp.asarray(mapping.leaf_from(e, Made()), jnp.float32) for e in entries}
    return params.unflatten(leaves)


@pytest.mark.slow
def test_the_whole_published_model_at_its_real_size():
    """1.1 billion made-up weights, about 5 GB: photos, cameras and rays to the picture of a new view."""
    case = load_case("lagernvs_end_to_end")
    encoder, renderer = lagernvs.lagernvs_config(state_shapes(case))
    paper = preset("paper")
    assert (encoder, dataclasses.replace(renderer, chunk=paper.renderer.chunk)) == (
        paper.encoder,
        paper.renderer,
    )
    p = made_one_by_one(case, lagernvs.lagernvs_entries(encoder, renderer))
    t, m, every = case.tensors, case.config["M"], case.config["token_stride"]
    h, w = case.config["H"], case.config["W"]
    K = np.zeros((len(t["in.c2w"]), 3, 3), np.float32)
    K[:, [0, 1, 0, 1], [0, 1, 2, 2]] = t["in.fxfycxcy"]
    K[:, 2, 2] = 1
    images = channels_last(t["in.images"][0])
    size = vggt.encoder_size(encoder, h, w)

    @jax.jit
    def encode(p, images, vectors):
        resized = jax.image.resize(images, (m, *size, 3), "bilinear", antialias=True)
        add = vggt.camera_tokens(p["camera_mlp"], vectors)
        tokens, out = vggt.aggregate(p, resized, add, cfg=encoder)
        none = jnp.zeros((m, h, w, 6))  # DINOv2 does not read rays
        z = vggt.encode_scene(p, images, vectors, none, K[:m], t["in.c2w"][:m], cfg=encoder)
        return resized, add, tokens, out["patch_tokens"], z

    @jax.jit
    def render(p, z, rays):
        phi, out = ray_scene.query_rays(p, z, rays, cfg=renderer, collect=True)
        return phi, out["z"][0], ray_scene.decode_rgb(p["rgb_head"], phi, cfg=renderer)

    resized, add, tokens, patches, z = encode(p["encoder"], images, t["in.cam11"])
    phi, z1, rgb = render(p["renderer"], z, moment_last(t["in.rays_target"]))
    first = vggt.SPECIALS + encoder.registers
    planes = np.moveaxis(np.asarray(resized), -1, -3)[None]
    found = {
        "mid.resized_sub": planes[..., ::7, ::14],
        "mid.camera_mlp": add[None],
        "mid.dino_patch_tokens_sub": patches[:, ::every],
        "mid.aggregator_special_tokens": tokens[:, :first],
        "mid.aggregator_patch_tokens_sub": tokens[:, first::every],
        "mid.z0_sub": z[:, ::every],
        "mid.z0_token_mean": z.mean(-1),
        "mid.z0_channel_mean": z.reshape(-1, renderer.width).mean(0),
        "mid.z0_channel_std": z.reshape(-1, renderer.width).std(0),
        "mid.renderer_block0_z_sub": z1.reshape(1, m, -1, renderer.width)[:, :, ::every],
        "out.phi_prenorm": phi.reshape(1, -1, renderer.width),
        "out.rgb": np.moveaxis(np.asarray(rgb), -1, -3),
    }
    compare("lagernvs_end_to_end", found, outputs(case), TOLERANCE_REAL)


# Names and counts of the released models.


@pytest.mark.parametrize(
    ("listing", "attention", "count"),
    [
        ("lagernvs_encdec_vitb8", "bidirectional", 1_103_348_352),
        ("lagernvs_encdec_vitb8_full_attention", "full", 997_150_208),
    ],
)
def test_every_released_tensor_fills_one_leaf(listing, attention, count):
    encoder, renderer = EncoderConfig(), RendererConfig(attention=attention)
    specs = {
        "encoder": vggt.encoder_specs(encoder, renderer.width),
        "renderer": ray_scene.renderer_specs(renderer),
    }
    assert params.count(specs) == count
    entries = lagernvs.lagernvs_entries(encoder, renderer)
    assert sorted(e.path for e in entries) == list(params.flatten(specs))
    rows = key_listing(listing)
    want = {row["official key"]: row["shape"] for row in rows}
    assert mapping.source_shapes(entries, specs) == want
    assert sum(len(e.keys) for e in entries) == len(want)
    assert lagernvs.lagernvs_config(want) == (encoder, renderer)
    half = [
        row["official key"] for row in rows if row["dtype when built by the class"] == "bfloat16"
    ]
    assert tuple(half) == lagernvs.BFLOAT16


def test_vggt_fills_the_encoder_but_for_what_lagernvs_added():
    want = {row["official key"]: row["shape"] for row in key_listing("vggt_1b")}
    kept = lagernvs.source(want)
    heads = {key.partition(".")[0] for key in want.keys() - kept.keys()}
    assert heads == {"camera_head", "depth_head", "point_head", "track_head"}
    cfg = lagernvs.vggt_config(kept)
    assert cfg == EncoderConfig()
    specs = {"encoder": vggt.encoder_specs(cfg, 768)}
    entries = lagernvs.vggt_entries(cfg)
    assert mapping.source_shapes(entries, specs) == kept
    left = set(params.flatten(specs)) - {e.path for e in entries}
    assert {path.split("/")[1] for path in left} == {"camera_mlp", "connector", "connector_norm"}


def test_the_paper_has_the_published_number_of_parameters():
    cfg = preset("paper")
    encoder = params.count(vggt.encoder_specs(cfg.encoder, cfg.renderer.width))
    renderer = params.count(ray_scene.renderer_specs(cfg.renderer))
    assert (encoder, renderer) == (911_748_608, 191_599_744)


TINY_ENCODER = EncoderConfig(
    patch=14, width=64, heads=1, depth=2, dino_depth=3, position_grid=3, long_side=42
)
TINY_RENDERER = RendererConfig(width=64, heads=1, depth=3)


@pytest.mark.parametrize("attention", ["bidirectional", "cross", "full"])
def test_conversion_there_and_back_is_exact(attention):
    renderer = dataclasses.replace(TINY_RENDERER, attention=attention)
    tree = made_up(
        {
            "encoder": vggt.encoder_specs(TINY_ENCODER, renderer.width),
            "renderer": ray_scene.renderer_specs(renderer),
        }
    )
    registers = tree["renderer"]["registers"].astype(jnp.bfloat16).astype(jnp.float32)
    tree["renderer"]["registers"] = registers  # the one tensor that the released file rounds
    tensors = lagernvs.published(tree, TINY_ENCODER, renderer)
    assert tensors["renderer.per_view_register_tokens"].dtype == jnp.bfloat16
    back = mapping.to_ours(lagernvs.lagernvs_entries(TINY_ENCODER, renderer), tensors)
    for path, leaf in params.flatten(tree).items():
        got = params.flatten(back)[path]
        np.testing.assert_array_equal(np.asarray(got, np.float32), leaf, err_msg=path)
    rays = tensors["renderer.tgt_embedder.proj.weight"]  # theirs reads moments first
    kernel = np.asarray(tree["renderer"]["ray_embed"]["kernel"])
    np.testing.assert_array_equal(rays[5, 0], kernel[:, :, 3, 5])
    np.testing.assert_array_equal(rays[5, 4], kernel[:, :, 1, 5])


def test_a_foreign_file_is_named():
    with pytest.raises(UserError, match="not a VGGT aggregator"):
        lagernvs.lagernvs_config({"conv1.weight": (1, 2, 3)})
    with pytest.raises(UserError, match="not a LagerNVS renderer"):
        lagernvs.renderer_config({"aggregator.camera_token": (1, 2, 1, 1024)})


# Properties.


def made_up(specs, seed=0):
    """Random values for every leaf (also those that start at zero or one): nothing is trivially equal."""
    rng = np.random.default_rng(seed)

    def leaf(path, spec):
        noise = rng.standard_normal(spec.shape, np.float32)
        if path.endswith("kernel"):
            lead = int(spec.axes[0] == "layers")
            return jnp.asarray(noise / np.sqrt(np.prod(spec.shape[lead:-1])))
        return jnp.asarray(0.2 * noise + path.endswith(("scale", "gamma")))

    return params.unflatten({path: leaf(path, s) for path, s in params.flatten(specs).items()})


def cameras(v, size, seed=0):
    """Made-up cameras K [v, 3, 3], c2w [v, 4, 4] near the origin, the first at it."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(np.eye(3)[None] + 0.3 * rng.standard_normal((v, 3, 3)))
    q = q * np.sign(np.linalg.det(q))[:, None, None]
    c2w = np.broadcast_to(np.eye(4), (v, 4, 4)).copy()
    c2w[1:, :3, :3], c2w[1:, :3, 3] = q[1:], 0.5 * rng.standard_normal((v - 1, 3))
    f = size[1] * rng.uniform(0.8, 1.2, v)
    K = np.zeros((v, 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = f, 1.05 * f, 1
    K[:, 0, 2], K[:, 1, 2] = size[1] / 2 + 0.7, size[0] / 2 - 0.4
    return jnp.asarray(K, jnp.float32), jnp.asarray(c2w, jnp.float32)


SIZE, M, V = (16, 24), 2, 5  # picture, contexts, all views
RELATIVE = dict(patch=8, width=32, heads=2, relative_cameras=True)
ENCODER = EncoderConfig(depth=2, dino_depth=0, long_side=None, **RELATIVE)
KINDS = ["bidirectional", "cross", "full"]


def renderer_of(attention, **more):
    relative = attention != "full"
    return RendererConfig(
        depth=3, attention=attention, **RELATIVE | {"relative_cameras": relative} | more
    )


@functools.lru_cache
def scene(seed=0):
    rng = np.random.default_rng(seed)
    K, c2w = cameras(V, SIZE, seed)
    z = jnp.asarray(rng.standard_normal((M, 6, 32)), jnp.float32)
    images = jnp.asarray(rng.uniform(size=(M, *SIZE, 3)), jnp.float32)
    vectors = jnp.asarray(rng.standard_normal((M, 11)), jnp.float32)
    return K, c2w, z, images, vectors


@functools.partial(jax.jit, static_argnames="cfg")
def query(p, z, K, c2w, context_K, context_c2w, rays, *, cfg):
    """Features of views K, c2w; `rays` are given apart so that a test may move cameras but not rays."""
    grid = (SIZE[0] // 8, SIZE[1] // 8)
    head_dim = cfg.width // cfg.heads
    given = {}
    if cfg.relative_cameras:
        given["rays"] = relative_cameras(
            K, c2w, SIZE, grid=grid, specials=cfg.registers, head_dim=head_dim
        )
        given["cameras"] = relative_cameras(
            context_K, context_c2w, SIZE, grid=grid, specials=0, head_dim=head_dim
        )
    return ray_scene.query_rays(p, z, rays, cfg=cfg, contexts=M, **given)


def features(cfg, which=slice(None), p=None, order=None):
    """Features of some of the scene's views; `order` permutes the contexts that the scene tokens came from."""
    K, c2w, z, _, _ = scene()
    p = made_up(ray_scene.renderer_specs(cfg)) if p is None else p
    rays = plucker(K[which], c2w[which], *SIZE)
    seen = jnp.arange(M) if order is None else jnp.asarray(order)
    return query(p, z[seen], K[which], c2w[which], K[:M][seen], c2w[:M][seen], rays, cfg=cfg)


# Two float32 programs for the same formula; sums of at most a few hundred terms, three blocks deep.
ROUNDING = 2e-5


@pytest.mark.parametrize("attention", KINDS)
def test_views_in_chunks_equal_all_at_once(attention):
    whole = features(renderer_of(attention, chunk=8))
    chunked = features(renderer_of(attention, chunk=2))  # five views: the last chunk is padded
    assert rel_l2(chunked, whole) < ROUNDING


@pytest.mark.parametrize("attention", KINDS)
def test_a_view_alone_equals_itself_among_others(attention):
    cfg = renderer_of(attention)
    among = features(cfg)
    for view in (0, V - 1):
        assert rel_l2(features(cfg, slice(view, view + 1)), among[view : view + 1]) < ROUNDING


def test_shared_refinement_in_chunks_equals_all_at_once():
    whole = features(renderer_of("bidirectional", refinement="shared", chunk=8))
    chunked = features(renderer_of("bidirectional", refinement="shared", chunk=2))
    assert rel_l2(chunked, whole) < ROUNDING


def test_shared_refinement_is_an_approximation():
    """It is another function than the published one, equal only where nothing is refined."""
    cfg, shared = (renderer_of("bidirectional", refinement=r) for r in ("per_view", "shared"))
    p = made_up(ray_scene.renderer_specs(cfg))
    assert rel_l2(features(shared, p=p), features(cfg, p=p)) > 1e-2
    for layer in (p["blocks"]["scene_attn"]["proj"], p["blocks"]["scene_mlp"]["fc2"]):
        layer["kernel"] = jnp.zeros_like(layer["kernel"])
    assert rel_l2(features(shared, p=p), features(cfg, p=p)) < ROUNDING


@pytest.mark.parametrize("attention", KINDS)
def test_the_order_of_scene_tokens_does_not_matter_to_rays(attention):
    cfg = renderer_of(attention)
    assert rel_l2(features(cfg, order=[1, 0]), features(cfg)) < ROUNDING


def test_the_order_of_contexts_after_the_first_does_not_matter():
    """Encoder and renderer together; the first context is the reference and has tokens of its own."""
    cfg = ENCODER
    p = made_up(vggt.encoder_specs(cfg, 32))
    rng = np.random.default_rng(3)
    m = 4
    K, c2w = cameras(m, SIZE, 3)
    images = jnp.asarray(rng.uniform(size=(m, *SIZE, 3)), jnp.float32)
    vectors = jnp.asarray(rng.standard_normal((m, 11)), jnp.float32)
    encode = jax.jit(functools.partial(vggt.encode_scene, cfg=cfg))
    order = jnp.asarray([0, 3, 1, 2])
    rays = plucker(K, c2w, *SIZE)
    straight = encode(p, images, vectors, rays, K, c2w)
    permuted = encode(p, *(a[order] for a in (images, vectors, rays, K, c2w)))
    assert rel_l2(permuted, straight[order]) < ROUNDING
    swapped = jnp.asarray([1, 0, 2, 3])  # but the first is special
    other = encode(p, *(a[swapped] for a in (images, vectors, rays, K, c2w)))
    assert rel_l2(other, straight[swapped]) > 1e-2


def moved(c2w, seed=5):
    """All cameras moved rigidly."""
    _, motion = cameras(2, SIZE, seed)
    return motion[1][None] @ c2w


def test_cameras_may_be_numpy_arrays():
    K, c2w = (np.asarray(x) for x in cameras(3, SIZE, 5))
    options = {"grid": (4, 6), "specials": 2, "head_dim": 16}
    found = relative_cameras(K, c2w, SIZE, **options)
    expected = relative_cameras(jnp.asarray(K), jnp.asarray(c2w), SIZE, **options)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.parametrize("attention", ["bidirectional", "cross"])
def test_relative_cameras_do_not_see_a_rigid_motion_of_the_ray_query(attention):
    """The ray maps are held fixed (they are absolute); what is left depends on relative cameras only."""
    cfg = renderer_of(attention)
    p = made_up(ray_scene.renderer_specs(cfg))
    K, c2w, z, _, _ = scene()
    rays, there = plucker(K, c2w, *SIZE), moved(c2w)
    here = query(p, z, K, c2w, K[:M], c2w[:M], rays, cfg=cfg)
    away = query(p, z, K, there, K[:M], there[:M], rays, cfg=cfg)
    assert rel_l2(away, here) < 10 * ROUNDING  # products with the 4x4 matrices and their inverses
    half = query(
        p, z, K, there, K[:M], c2w[:M], rays, cfg=cfg
    )  # moving the targets alone does show
    assert rel_l2(half, here) > 1e-2


def test_relative_cameras_do_not_see_a_rigid_motion_of_the_encoder():
    p = made_up(vggt.encoder_specs(ENCODER, 32))
    K, c2w, _, images, vectors = scene()
    K, c2w = K[:M], c2w[:M]
    encode = jax.jit(functools.partial(vggt.encode_scene, cfg=ENCODER))
    rays = plucker(K, c2w, *SIZE)
    here = encode(p, images, vectors, rays, K, c2w)
    assert rel_l2(encode(p, images, vectors, rays, K, moved(c2w)), here) < 10 * ROUNDING
    apart = c2w.at[1, :3, 3].add(jnp.asarray([0.3, 0.0, -0.2]))
    assert rel_l2(encode(p, images, vectors, rays, K, apart), here) > 1e-3
