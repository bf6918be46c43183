"""What is made, for other programs: videos and points of a finished run, and trained adapters.

    python -m roge_jax.export RUN --video gif,webm                       more kinds of video, from the frames that are there
    python -m roge_jax.export RUN --points                               points.ply, triangulated from the frames
    python -m roge_jax.export ADAPTER --merge BASE --out DIR             a whole model
    python -m roge_jax.export ADAPTER --style comfyui --out DIR          LoRA for another program

RUN is a folder that `sample` wrote, also the frames that a failed run left. ADAPTER is a folder that `checkpoint.save_adapter`
wrote; merging streams, so that memory stays at a few layers of the model.

    --merge BASE             a standalone model folder: the base with the LoRA merged and the new embeddings in place
    --style diffusers        the transformer's LoRA alone, under the names of diffusers' load_lora_adapter
    --style peft             ... with an adapter_config.json for peft around a diffusers transformer
    --style framecrafter     ... for FrameCrafter and DiffSynth-Studio
    --style comfyui          ... for ComfyUI
"""

import argparse
import functools
import json
import shutil
from pathlib import Path

from .files.entry import number, one_of
from .files.folders import put
from .files.video_io import video_kinds

STYLES = ("diffusers", "peft", "framecrafter", "comfyui")
FILES = {
    "diffusers": "pytorch_lora_weights.safetensors",
    "peft": "adapter_model.safetensors",
    "framecrafter": "lora.safetensors",
    "comfyui": "lora.safetensors",
}


def parser() -> argparse.ArgumentParser:
    """The options of `python -m roge_jax.export`."""
    p = argparse.ArgumentParser(
        prog="python -m roge_jax.export",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    p.add_argument("folder", type=Path, help="folder that sample wrote, or adapter of training")
    kinds = "of a run: write these kinds of video, with commas: mp4, webm, webp, gif"
    p.add_argument("--video", type=video_kinds, metavar="KINDS", help=kinds)
    points = "of a run: triangulate coloured points from its frames (points.ply, transforms.json, sparse/0)"
    p.add_argument("--points", action="store_true", help=points)
    fps = "with --video: frames per second (default: those of the run)"
    p.add_argument("--fps", type=number(1e-3, 1000, whole=False), help=fps)
    merge = "of an adapter: model folder or name to merge it into"
    p.add_argument("--merge", metavar="BASE", help=merge)
    p.add_argument(
        "--style",
        type=one_of(STYLES),
        help="of an adapter: names for other programs (the transformer's LoRA alone)",
    )
    p.add_argument("--out", type=Path, help="of an adapter: new folder (default: required)")
    p.add_argument(
        "--shard-gb",
        type=number(1e-6, 1e6, whole=False),
        default=4.0,
        help="with --merge: largest size of one file in GB",
    )
    p.add_argument("--debug", action="store_true", help="show tracebacks")
    return p


def main(args: argparse.Namespace) -> None:
    """Write what was asked for of a run or of an adapter."""
    from .errors import UserError

    of_a_run = bool(args.video or args.points)
    if sum(map(bool, (of_a_run, args.merge, args.style))) != 1:
        raise UserError(
            "Give --video or --points for a finished run; of an adapter one of --merge BASE for a whole model, and --style "
            "for other programs' LoRA files."
        )
    if of_a_run:
        return export_run(args)
    from .checkpoint import load_adapter
    from .weights.importer import check_output

    if args.out is None:
        raise UserError("No --out given: name the folder to write the adapter's export to.")
    check_output(args.out)
    tree, config = load_adapter(args.folder)
    if args.merge:
        merge_into(args.merge, tree, config, args.folder, args.out, shard_bytes=1e9 * args.shard_gb)
    else:
        write_lora(tree, config, args.style, args.out)
    print(f"{args.out}: written")


def export_run(args: argparse.Namespace) -> None:
    """More files into the folder of a run, made of its frames."""
    from .sampling import finished

    made = finished.read(args.folder)
    for file in finished.write_videos(made, args.video or (), args.fps):
        print(f"{file}: written, {len(made.names)} frames")
    if args.points:
        print(f"{args.folder / finished.POINTS}: {finished.write_points(made)}")


def merge_into(base: str, tree, config, adapter: Path, out: Path, *, shard_bytes: float) -> None:
    """Write the base with the adapter in it as a model folder, layer by layer.

    Kernels get a @ b in float32 and are rounded once to the base's dtype. Raises: UserError if the base has other
    networks or weights than the model that the adapter was trained on.
    """
    import numpy as np

    from . import checkpoint, model
    from .core.params import flatten
    from .errors import UserError
    from .weights import importer
    from .weights.sources import DTYPES, open_source

    folder = checkpoint.find_model(base)
    if (folder / checkpoint.ADAPTER).exists():
        raise UserError(
            f"--merge {base} is an adapter itself: give the model that it was trained on."
        )
    base_config = checkpoint.load_config(folder)
    for part in ("encoder", "renderer", "vae", "dit", "fusion"):
        if not _same_shapes(part, base_config, config):
            raise UserError(
                f"{adapter} was trained on another '{part}' than {folder} has (presets '{config.name}' and "
                f"'{base_config.name}'): merge it into its own base."
            )
    source, specs = open_source(folder), flatten(model.specs(config))
    lost = [path for path in specs if path not in source.tensors]
    if lost:
        raise UserError(
            f"{folder} is incomplete: {lost[0]} and {len(lost) - 1} more leaves are missing."
        )
    trained = checkpoint.load_provenance(adapter)
    if trained.get("base_weights") not in (None, _weights(source, specs)):
        raise UserError(
            f"--merge {base} has other weights than the model that {adapter} was trained on, {trained.get('base')}: give "
            "that one (a model that training wrote, or a merged one, holds the adapter already)."
        )
    changed = flatten(tree)
    fills = []
    for path, spec in specs.items():
        layer = path.rpartition("/")[0]
        if path in changed:
            continue
        factors = None
        if path.endswith("/kernel") and f"{layer}/lora_a" in changed:
            factors = tuple(np.asarray(changed[f"{layer}/lora_{side}"]) for side in "ab")
        for i in range(spec.shape[0]) if spec.axes[0] == "layers" else (None,):
            fills.append(
                importer.Fill(path, i, source, path, functools.partial(_merged, factors, i))
            )
    given = {p: np.asarray(x) for p, x in changed.items() if not p.endswith(("lora_a", "lora_b"))}
    half = any(t.dtype == DTYPES["BF16"] for t in source.tensors.values())
    provenance = {
        "merged": trained,
        "base": checkpoint.load_provenance(folder),
    }
    plan = importer.Plan(config, specs, fills, given, half, provenance)
    importer.check_coverage(fills, specs)
    importer.write(plan, out, shard_bytes=shard_bytes)


def _weights(source, specs) -> str:
    """`checkpoint.weights_fingerprint` of a model folder as training loads it, in float32."""
    from . import checkpoint
    from .core.params import unflatten

    mapped = {path: source.read(path) for path in specs}
    return checkpoint.weights_fingerprint(unflatten(mapped), dtype="float32")


def _merged(factors, layer, kernel):
    import numpy as np

    kernel = kernel if layer is None else kernel[layer]
    if factors is None:
        return kernel
    a, b = factors if layer is None else (factors[0][layer], factors[1][layer])
    total = np.matmul(a, b, dtype=np.float32).reshape(kernel.shape)
    total += kernel
    return total


def _same_shapes(part: str, a, b) -> bool:
    from . import model
    from .core.params import abstract, flatten

    shapes = [
        {p: s.shape for p, s in flatten(abstract(model.specs(config).get(part, {}))).items()}
        for config in (a, b)
    ]
    return shapes[0] == shapes[1]


def write_lora(tree, config, style: str, out: Path) -> None:
    """The transformer's LoRA under the names of `style` in a folder of its own."""
    import numpy as np
    from safetensors.numpy import save_file

    from .core.params import flatten, unflatten
    from .errors import UserError
    from .files.folders import share
    from .weights.importer import check_output
    from .weights.lora_export import export_lora

    flat = {
        p: np.asarray(x)
        for p, x in flatten(tree.get("dit", {})).items()
        if p.endswith(("lora_a", "lora_b"))
    }
    if not flat:
        raise UserError("The adapter holds no LoRA of the transformer: only --merge can export it.")
    tensors = export_lora(unflatten(flat), style=style)  # type: ignore[arg-type]
    part = check_output(out)
    shutil.rmtree(part, ignore_errors=True)  # of an export that was killed
    part.mkdir(parents=True)
    save_file(tensors, part / FILES[style], metadata={"format": "pt"})
    share(part / FILES[style])
    rank = next(x.shape[-1] for p, x in flat.items() if p.endswith("lora_a"))
    if style == "peft":
        names = sorted(
            {k.partition(".lora_")[0].removeprefix("base_model.model.") for k in tensors}
        )
        adapter = {
            "peft_type": "LORA",
            "r": rank,
            "lora_alpha": rank,
            "target_modules": names,
            "bias": "none",
        }
        (part / "adapter_config.json").write_text(
            json.dumps(adapter, indent=1) + "\n", encoding="utf-8"
        )
    put(part, out)
    left = sorted({p.partition("/")[0] for p in flatten(tree)} - {"dit"})
    full = any(p.startswith("dit/patch_embed") for p in flatten(tree))
    print(
        f"{len(tensors)} factors of rank {rank}. Not in this file, for other programs have no place for it: "
        f"{', '.join(left + ['the retrained first embedding'] * full) or 'nothing'}."
    )


if __name__ == "__main__":
    from .files.entry import run

    run(main, parser())
