"""Random checkpoints in the published names and formats, made through the reverse weight maps."""

import dataclasses
import json
import zipfile
import zlib
from pathlib import Path

import ml_dtypes
import numpy as np

from roge_jax import model
from roge_jax.config import (
    DiTConfig,
    EncoderConfig,
    FusionConfig,
    RendererConfig,
    RoGeConfig,
    VAEConfig,
)
from roge_jax.core.params import flatten, unflatten
from roge_jax.video.dit import dit_specs
from roge_jax.weights import lagernvs, mapping, wan_dit, wan_vae

# Head sizes as published (128 and 64), which the files do not tell.
CONFIG = RoGeConfig(
    name="test",
    encoder=EncoderConfig(width=64, heads=1, depth=2, dino_depth=1, position_grid=2),
    renderer=RendererConfig(width=64, heads=1, depth=3),
    vae=VAEConfig(base=4, latent=16),
    dit=DiTConfig(
        width=128, heads=1, depth=3, ffn=96, freq_dim=16, text_dim=8, text_len=6, clip_dim=12
    ),
    fusion=FusionConfig(geometry_channels=8),
)
T2V = dataclasses.replace(CONFIG.dit, in_channels=16, clip_dim=0)


def random_tree(specs, seed: int) -> dict[str, np.ndarray]:
    """Float32 values by path."""
    rng = np.random.default_rng(seed)
    return {p: rng.standard_normal(s.shape, np.float32) for p, s in flatten(specs).items()}


def dit_tensors(cfg: DiTConfig = CONFIG.dit, names="official", seed=1):
    """(our tree by path, their tensors)."""
    tree = random_tree(dit_specs(cfg), seed)
    return tree, mapping.to_theirs(wan_dit.dit_entries(cfg, names=names), unflatten(tree))


def vae_tensors(cfg: VAEConfig = CONFIG.vae, names="official", seed=2):
    tree = random_tree(model.specs(CONFIG)["vae"], seed)
    return tree, mapping.to_theirs(wan_vae.mapping(cfg, names), unflatten(tree))


def recon_tensors(config: RoGeConfig = CONFIG, seed=3):
    """LagerNVS: ({"encoder/..", "renderer/.."}, tensors with one in bfloat16)."""
    specs = {k: model.specs(config)[k] for k in ("encoder", "renderer")}
    tree = random_tree(specs, seed)
    key = (
        "renderer/registers"  # bfloat16 in the released file, so that it holds exactly these values
    )
    tree[key] = tree[key].astype(ml_dtypes.bfloat16).astype(np.float32)
    return tree, lagernvs.published(unflatten(tree), config.encoder, config.renderer)


def vggt_tensors(config: RoGeConfig = CONFIG, seed=4):
    """VGGT-1B with the beginning of one of its heads."""
    tree = random_tree({"encoder": model.specs(config)["encoder"]}, seed)
    entries = lagernvs.vggt_entries(config.encoder)
    tensors = mapping.to_theirs(entries, unflatten(tree))
    paths = {e.path for e in entries}
    head = {"camera_head.token_norm.weight": np.ones(4, np.float32)}
    return {p: x for p, x in tree.items() if p in paths}, tensors | head


def save(file: Path, tensors) -> Path:
    from safetensors.flax import save_file

    file.parent.mkdir(parents=True, exist_ok=True)
    save_file(dict(tensors), file)
    return file


def save_sharded(folder: Path, tensors, shards=3, stem="diffusion_pytorch_model") -> Path:
    """Shards with an index, keys dealt out in turn."""
    keys, files = sorted(tensors), {}
    for i in range(shards):
        name = f"{stem}-{i + 1:05d}-of-{shards:05d}.safetensors"
        save(folder / name, {k: tensors[k] for k in keys[i::shards]})
        files |= dict.fromkeys(keys[i::shards], name)
    index = {"metadata": {}, "weight_map": files}
    (folder / f"{stem}.safetensors.index.json").write_text(json.dumps(index))
    return folder


def save_headers(file: Path, shapes, dtype="F32", dtypes=None) -> Path:
    """A safetensors file of full size that takes no disk: true header, all values zero (a sparse file)."""
    sizes = {"F32": 4, "BF16": 2}
    entries, end = {}, 0
    for key, shape in shapes.items():
        kind = (dtypes or {}).get(key, dtype)
        begin, end = end, end + int(np.prod(shape)) * sizes[kind]
        entries[key] = {"dtype": kind, "shape": list(shape), "data_offsets": [begin, end]}
    header = json.dumps(entries).encode()
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("wb") as f:
        f.write(len(header).to_bytes(8, "little") + header)
        f.truncate(8 + len(header) + end)
    return file


def save_listing(file: Path, name: str, column="official key", prefix="") -> Path:
    """The headers of a released checkpoint from its listing in tests/fixtures/key_listings."""
    from parity import key_listing

    rows = key_listing(name)
    kinds = {"float32": "F32", "bfloat16": "BF16"}
    column_of_dtype = next((c for c in rows[0] if c.startswith("dtype")), None)
    dtypes = (
        {prefix + row[column]: kinds[row[column_of_dtype]] for row in rows}
        if column_of_dtype
        else {}
    )
    return save_headers(file, {prefix + row[column]: row["shape"] for row in rows}, dtypes=dtypes)


def save_torch(file: Path, shapes, value, wrapper: str | None = None, dtypes=None) -> Path:
    """A PyTorch zip file, written tensor by tensor and without PyTorch.

    `value(key, shape)` gives an array; `wrapper` puts the tensors into {wrapper: tensors}. Opcodes are those that
    PyTorch writes, so that its weights-only loader reads the file too.
    """
    storages = {
        "F32": ("FloatStorage", np.float32),
        "BF16": ("BFloat16Storage", ml_dtypes.bfloat16),
    }

    def text(s: str) -> bytes:
        return b"X" + len(s.encode()).to_bytes(4, "little") + s.encode()

    def number(n: int) -> bytes:
        return b"J" + n.to_bytes(4, "little", signed=True)

    def sizes(shape) -> bytes:
        return b"(" + b"".join(map(number, shape)) + b"t"

    content = b"\x80\x02" + (b"}" + text(wrapper) if wrapper else b"") + b"}("
    for i, (key, shape) in enumerate(shapes.items()):
        kind = storages[(dtypes or {}).get(key, "F32")][0]
        count = int(np.prod(shape))
        strides = [int(np.prod(shape[j + 1 :])) for j in range(len(shape))]
        storage = b"(" + text("storage") + f"ctorch\n{kind}\n".encode() + text(str(i)) + text("cpu")
        content += (
            text(key) + b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + number(count) + b"tQ"
        )
        content += (
            number(0) + sizes(shape) + sizes(strides) + b"\x89ccollections\nOrderedDict\n)RtR"
        )
    content += b"u" + (b"s" if wrapper else b"") + b"."
    with zipfile.ZipFile(file, "w", allowZip64=True) as archive:
        archive.writestr("archive/data.pkl", content)
        archive.writestr("archive/byteorder", "little")
        for i, (key, shape) in enumerate(shapes.items()):
            dtype = storages[(dtypes or {}).get(key, "F32")][1]
            archive.writestr(
                f"archive/data/{i}", np.ascontiguousarray(value(key, shape), dtype).tobytes()
            )
        archive.writestr("archive/version", "3\n")
    return file


def save_torch_headers(file: Path, shapes, wrapper: str | None = None, dtypes=None) -> Path:
    """A PyTorch file of full size that takes no disk: all but the zeros of its tensors is written (a sparse file).

    The zip file is put together by hand, in its form for more than 4 GB: `zipfile` would write the zeros.
    """
    small = file.with_suffix(".pickle")
    save_torch(small, shapes, lambda key, shape: np.zeros(0, np.float32), wrapper, dtypes)
    with zipfile.ZipFile(small) as archive:
        content = archive.read("archive/data.pkl")
    small.unlink()
    width = {"F32": 4, "BF16": 2}
    sizes = [int(np.prod(s)) * width[(dtypes or {}).get(k, "F32")] for k, s in shapes.items()]
    members = [("archive/data.pkl", content, len(content)), ("archive/byteorder", b"little", 6)]
    members += [(f"archive/data/{i}", b"", size) for i, size in enumerate(sizes)]
    central, offset = b"", 0
    with file.open("wb") as f:
        for name, head, size in members:
            f.seek(offset)
            crc = (zlib.crc32(head) if head else 0).to_bytes(4, "little")
            fixed = b"\0\0" * 2 + b"\0" * 4 + crc + b"\xff" * 8  # stored; sizes are in the extra
            lengths = len(name).to_bytes(2, "little")
            wide = size.to_bytes(8, "little") * 2
            extra = b"\1\0" + len(wide).to_bytes(2, "little") + wide
            f.write(b"PK\3\4" + b"\x2d\0" + fixed + lengths + len(extra).to_bytes(2, "little"))
            f.write(name.encode() + extra + head)
            start, offset = offset, f.tell() - len(head) + size
            wide += start.to_bytes(8, "little")
            extra = b"\1\0" + len(wide).to_bytes(2, "little") + wide
            central += b"PK\1\2" + b"\x2d\0" * 2 + fixed + lengths
            central += len(extra).to_bytes(2, "little") + b"\0" * 10 + b"\xff" * 4
            central += name.encode() + extra
        count = len(members).to_bytes(8, "little")
        end = b"PK\6\6" + (44).to_bytes(8, "little") + b"\x2d\0" * 2 + b"\0" * 8 + count * 2
        end += len(central).to_bytes(8, "little") + offset.to_bytes(8, "little")
        place = (offset + len(central)).to_bytes(8, "little")
        f.seek(offset)
        f.write(central + end)
        f.write(b"PK\6\7" + b"\0" * 4 + place + b"\1\0\0\0")
        f.write(b"PK\5\6" + b"\0" * 4 + b"\xff" * 12 + b"\0\0")
    return file
