"""Convert published weights: `python -m roge_jax.convert --wan DIR --lagernvs FILE --out DIR`.

    --lagernvs lagernvs_general_512 --out weights/lagernvs      a reconstruction alone, which makes pictures at once
    --wan Wan2.1-I2V-14B-480P --lagernvs model.pt --prompt-embedding empty.safetensors --out weights/paper
    --wan Wan2.1-T2V-1.3B --lagernvs model.pt --t5 umt5-xxl --out weights/wan1.3b
    ... --dry-run                reads headers alone and prints what would fill what

Every tensor of every file is used once and every leaf filled once, or all that does not fit is listed in one error.
Memory stays at a few of the largest tensors. docs/start/published_weights.md says where the files come from and under which licence.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

from .config import Parts
from .files.entry import number, one_of

NETWORKS = ("encoder", "renderer", "vae", "dit")
MAKES = {
    "all": "makes video, once the link between its halves was trained (train --stage lora); --preview-only at once",
    "reconstruction": "makes the reconstruction's own picture of any view: sample, evaluate and view take it as it is",
    "generator": "makes no picture of a scene: it needs a reconstruction, --lagernvs, and training",
}
CONDITIONED = 36  # input channels of the conditioned transformer: noisy 16, mask 4, condition 16


def parser() -> argparse.ArgumentParser:
    """The options of `python -m roge_jax.convert`."""
    from .weights import catalogue

    p = argparse.ArgumentParser(
        prog="python -m roge_jax.convert",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    p.add_argument(
        "--wan",
        type=Path,
        help="Wan2.1 transformer: official or diffusers folder, or its file; alone it makes no pictures",
    )
    p.add_argument(
        "--wan-vae", type=Path, help="Wan2.1_VAE.pth or diffusers' vae (default: beside --wan)"
    )
    p.add_argument(
        "--lagernvs",
        type=Path,
        metavar="FILE|NAME",
        help="LagerNVS checkpoint, model.pt or its folder: encoder and renderer; without --wan a model that makes\n"
        f"the reconstruction's own picture; also by name: {', '.join(catalogue.LAGERNVS)}",
    )
    p.add_argument(
        "--vggt", type=Path, help="VGGT-1B, where LagerNVS is not at hand: the aggregator alone"
    )
    p.add_argument("--framecrafter", type=Path, help="FrameCrafter checkpoint, merged into --wan")
    p.add_argument(
        "--preset",
        help="paper, wan1.3b, ..., or a model folder whose config is taken\n(default: the sizes found in the files)",
    )
    p.add_argument(
        "--prompt-embedding", type=Path, help="umT5 rows [rows, 4096] as .npy or .safetensors"
    )
    p.add_argument(
        "--t5",
        type=Path,
        help="umT5 encoder to compute them with: models_t5_umt5-xxl-enc-bf16.pth, or a Hugging Face folder with its\n"
        "tokenizer (default: what lies beside --wan)",
    )
    p.add_argument(
        "--prompt",
        default="",
        help="the prompt for --t5 (default: the empty prompt); any other needs the extra 'convert'",
    )
    p.add_argument(
        "--random",
        nargs="+",
        default=[],
        metavar="NETWORK",
        type=one_of(NETWORKS),
        help="networks to initialise randomly instead: encoder renderer vae dit",
    )
    p.add_argument(
        "--heads",
        nargs="+",
        default=[],
        metavar="NETWORK=N",
        help="heads of dit, encoder, dino or renderer, where the files do not tell and they are not of the released\n"
        "width (128 channels a head in dit, 64 in the others)",
    )
    p.add_argument(
        "--seed", type=number(0), default=0, help="of everything that is initialised (default: 0)"
    )
    p.add_argument("--out", type=Path, help="new model folder")
    p.add_argument(
        "--dtype",
        default="bfloat16",
        type=one_of(("bfloat16", "float32")),
        help="of the large frozen matrices (default: bfloat16); all else is float32",
    )
    p.add_argument(
        "--shard-gb",
        type=number(1e-6, 1e6, whole=False),
        default=4.0,
        help="largest size of one file in GB (default: 4)",
    )
    p.add_argument(
        "--dry-run", action="store_true", help="print what would be done, from headers alone"
    )
    p.add_argument("--resume", action="store_true", help="continue a conversion that was cut off")
    p.add_argument("--debug", action="store_true", help="show tracebacks")
    return p


def main(args: argparse.Namespace) -> None:
    """Convert, or print what would be done. Raises: UserError with all mismatches, before anything is written."""
    from .errors import UserError
    from .files.folders import check_disk
    from .weights import importer

    if args.out is None and not args.dry_run:
        raise UserError("No --out given: name the model folder to write, or ask for a --dry-run.")
    if not args.shard_gb > 0:
        raise UserError(f"--shard-gb {args.shard_gb} is no size: give a positive number of GB.")
    if args.out is not None:
        importer.check_output(args.out)
    plan, filled = make_plan(args)
    layout = plan.layout(1e9 * args.shard_gb)
    print(summary(plan, filled, layout))
    if args.out is not None:
        part = importer.check_output(args.out)
        check_disk(sum(layout.sizes), part, held=[part])
    if args.dry_run:
        return
    from tqdm import tqdm

    with tqdm(
        total=sum(layout.sizes), unit="B", unit_scale=True, disable=not sys.stderr.isatty()
    ) as bar:

        def progress(done: int, _total: int) -> None:
            bar.update(done - bar.n)

        try:
            importer.write(
                plan,
                args.out,
                resume=args.resume,
                shard_bytes=1e9 * args.shard_gb,
                progress=progress,
            )
        except KeyboardInterrupt:
            print(
                f"{args.out}.part is kept: the same command with --resume continues it.",
                file=sys.stderr,
            )
            raise
    print(f"{args.out}: written")


def make_plan(args: argparse.Namespace):
    """(plan, what each file does), from headers alone. Raises: UserError with all mismatches."""
    from .core.params import flatten
    from .errors import UserError
    from .model import specs
    from .weights import catalogue, heads, importer, published, umt5
    from .weights.prompt import choose_rows
    from .weights.sources import open_source

    filled: list[Any] = []
    wan = vae_path = recon = framecrafter = None
    role = "--lagernvs" if args.lagernvs else "--vggt"
    if args.framecrafter and not args.wan:
        raise UserError(
            "--framecrafter holds changes to a Wan2.1 transformer: give that one with --wan."
        )
    if args.prompt and not args.t5:
        raise UserError(
            f"--prompt '{args.prompt}' needs an encoder to read it: give its folder with --t5, or the finished rows with "
            "--prompt-embedding alone."
        )
    if args.t5 and args.prompt_embedding:
        raise UserError("--t5 and --prompt-embedding both give the prompt: leave one of them away.")
    if args.wan:
        wan, vae_path = published.find_wan(args.wan)
    if args.lagernvs or args.vggt:
        recon = open_source(catalogue.locate(args.lagernvs or args.vggt))
        kind = ("lagernvs", "a LagerNVS checkpoint") if args.lagernvs else ("vggt", "VGGT-1B")
        published.expect(recon, kind[:1], role, kind[1])
    if args.lagernvs and args.vggt:
        unused = open_source(catalogue.locate(args.vggt))
        published.expect(unused, ("vggt",), "--vggt", "VGGT-1B")
        note = "not needed: LagerNVS brings its own, further trained aggregator"
        filled.append(published.Filled("--vggt", unused, "official", [], [], (note,)))
    if args.framecrafter:
        framecrafter = open_source(args.framecrafter)
        published.expect(framecrafter, ("lora",), "--framecrafter", "FrameCrafter's LoRA file")
    vae_path = args.wan_vae or vae_path
    vae = open_source(vae_path) if vae_path else None

    have = {"dit": wan, "vae": vae, "encoder": recon, "renderer": recon}
    parts = _parts(args, have)
    config = choose_config(args.preset, wan, recon, parts, heads.parse(args.heads))
    if wan is not None:
        filled += published.fill_dit(config.dit, wan, framecrafter)
    if vae is not None:
        filled.append(published.fill_vae(config.vae, vae, "--wan-vae"))
    if recon is not None:
        filled.append(published.fill_recon(config, recon, role))
    importer.report(fault for part in filled for fault in part.faults)

    given: dict[str, Any] = {}
    wanted = parts != "reconstruction" and config.dit.text_len > 0
    if not wanted and (args.prompt_embedding or args.t5):
        which = "A reconstruction alone" if parts == "reconstruction" else f"Preset '{config.name}'"
        raise UserError(f"{which} reads no text: leave --prompt-embedding and --t5 away.")
    said = "none"
    if wanted:
        beside = umt5.find(catalogue.locate(args.wan)) if args.wan else None
        how = {"embedding": args.prompt_embedding, "encoder": args.t5, "beside": beside}
        said, rows = choose_rows(config.dit, args.prompt, **how)
        given = {} if rows is None else {"prompt/rows": rows}
    fills = [fill for part in filled for fill in part.fills]
    tree = flatten(specs(config))
    importer.check_coverage(fills, tree)
    plan = importer.Plan(config, tree, fills, given, args.dtype == "bfloat16", {}, args.seed)
    provenance = {
        "converted": [
            {
                "option": part.role,
                "files": [{"name": f.name, "bytes": f.stat().st_size} for f in part.source.files],
                "names": part.layout,
                "tensors": len(part.fills),
                "notes": list(part.notes),
            }
            for part in filled
        ],
        "prompt": said,
        "initialised": plan.initialised,
        "seed": args.seed,
    }
    return plan._replace(provenance=provenance), filled


def choose_config(
    name: str | None, wan, recon, parts: Parts = "all", given: dict[str, int] | None = None
):
    """The configuration: a preset, that of a model folder, or the sizes found in the files; of `parts` of the model.

    `given`: heads of networks whose files do not tell.
    """
    from . import checkpoint, config
    from .weights import heads, published

    if name is not None:
        folder = name not in config.PRESETS and Path(name).is_dir()
        chosen = checkpoint.load_config(Path(name)) if folder else config.preset(name)
        chosen = _fitted(chosen, wan, parts)
    else:
        chosen = alone(recon) if parts == "reconstruction" else _found(wan, recon, parts)
    fits = chosen.encoder.dino_depth > 0  # or `fill_recon` says that it does not
    files = {"dit": wan} | dict.fromkeys(("encoder", "dino", "renderer"), recon if fits else None)
    known = {network: file for network, file in files.items() if file is not None}
    if recon is not None and published.family(recon)[0] == "vggt":
        known.pop("renderer", None)
    settled = heads.settle(chosen, known, given or {}, asked=name is not None)
    if settled != chosen and name is None and parts != "reconstruction":
        settled = dataclasses.replace(settled, name="custom")
    return settled


def _fitted(chosen, wan, parts: Parts):
    """A configuration that was asked for, if the transformer is of its size."""
    from . import config
    from .errors import UserError
    from .weights import published

    found = published.dit_config(wan) if wan is not None else None
    if found is not None and not _same_size(found, chosen.dit):
        fits = [p for p in config.PRESETS if _same_size(config.preset(p).dit, found)]
        raise UserError(
            f"{wan.path} holds a transformer of width {found.width} with {found.depth} blocks, and preset "
            f"'{chosen.name}' has {chosen.dit.width} and {chosen.dit.depth}: "
            f"use {'--preset ' + fits[0] if fits else 'no --preset to take the sizes of the file'}."
        )
    if parts != "reconstruction":
        return dataclasses.replace(chosen, parts=parts)
    height, width = chosen.recon_height, chosen.recon_width
    return dataclasses.replace(chosen, parts=parts, height=height, width=width, output=None)


def _found(wan, recon, parts: Parts):
    """The configuration of the files: a preset, if the transformer is that of one."""
    from . import config
    from .weights import published

    chosen = config.RoGeConfig(parts=parts)
    if wan is not None:
        dit = dataclasses.replace(published.dit_config(wan), in_channels=CONDITIONED)
        same = [p for p in config.PRESETS if config.preset(p).dit == dit]
        if same:
            chosen = dataclasses.replace(config.preset(same[0]), parts=parts)
        else:
            chosen = dataclasses.replace(chosen, name="custom", dit=dit)
    if recon is not None:
        encoder, renderer = published.recon_config(recon)
        renderer = renderer or chosen.renderer
        if (chosen.encoder, chosen.renderer) != (encoder, renderer):
            chosen = dataclasses.replace(chosen, name="custom", encoder=encoder, renderer=renderer)
    return chosen


def _same_size(a, b) -> bool:
    return (a.width, a.depth) == (b.width, b.depth)


def alone(recon):
    """The configuration of a LagerNVS file without a generator: pictures of the size that it was trained for."""
    from .config import RoGeConfig
    from .weights import catalogue, published

    encoder, renderer = published.recon_config(recon)
    name = catalogue.name_of(recon.path)
    known = name if name in catalogue.LAGERNVS else None
    like = known or "lagernvs_general_512"
    if known is None and renderer is not None and renderer.attention == "full":
        like = "lagernvs_re10k_2v_256"  # the one with full attention
    (height, width), views = catalogue.LAGERNVS[like]
    return RoGeConfig(
        name=known or "lagernvs",
        height=height,
        width=width,
        recon_height=height,
        recon_width=width,
        max_context=views,
        encoder=encoder,
        renderer=renderer,
        parts="reconstruction",
    )


def _parts(args, have: dict[str, Any]) -> Parts:
    """Which parts of the model there will be: all, or the half that anything was given for.

    Raises: UserError unless every network of it has a file or is declared random.
    """
    from .errors import UserError
    from .model import RECONSTRUCTION

    options = {
        "dit": "--wan",
        "vae": "--wan-vae",
        "encoder": "--lagernvs",
        "renderer": "--lagernvs",
    }
    both = [name for name in args.random if have[name] is not None]
    if both:
        raise UserError(
            f"--random {both[0]}, but a file fills it as well: leave one of the two away."
        )
    given = [name for name in NETWORKS if have[name] is not None or name in args.random]
    halves = {name in RECONSTRUCTION for name in given}
    if not any(have.values()):
        raise UserError(
            "No file to convert: give --lagernvs (a reconstruction, which makes pictures by itself), --wan (a generator), "
            "or both."
        )
    if halves == {True} and not args.lagernvs:
        raise UserError(
            "VGGT-1B alone makes no pictures: its camera MLP, its connector and the renderer are LagerNVS's: give --lagernvs "
            "instead, or --wan besides, to train what is missing."
        )
    lost = [n for n in NETWORKS if n not in given and (n in RECONSTRUCTION) in halves]
    if lost:
        wanted = " and ".join(dict.fromkeys(options[name] for name in lost))
        raise UserError(
            f"Nothing fills {', '.join(lost)}: give {wanted}, or --random {' '.join(lost)} to initialise them."
        )
    return "all" if len(halves) == 2 else "reconstruction" if halves == {True} else "generator"


def summary(plan, filled, layout) -> str:
    """What fills what, as text for people."""
    from .core.params import count
    from .weights import umt5

    lines = []
    for part in filled:
        files = part.source.files
        shards = f" in {len(files)} files" if len(files) > 1 else ""
        lines.append(
            f"{part.role} {part.source.path}: {part.layout} names, {len(part.source.tensors)} tensors, "
            f"{part.source.nbytes / 1e9:.2f} GB{shards}"
        )
        lines += [f"    {note}" for note in part.notes]
    lines.append(
        f"{'network':10}{'leaves':>8}{'tensors':>9}{'parameters':>16}{'GB':>8}{'initialised':>13}"
    )
    initial = set(plan.initialised)
    for network in dict.fromkeys(path.partition("/")[0] for path in plan.specs):
        specs = {path: s for path, s in plan.specs.items() if path.startswith(f"{network}/")}
        tensors = sum(fill.path in specs for fill in plan.fills)
        size = sum(count({p: s}) * plan.dtype(p).itemsize for p, s in specs.items())
        lines.append(
            f"{network:10}{len(specs):8}{tensors:9}{count(specs):16,}{size / 1e9:8.2f}{len(initial & set(specs)):13}"
        )
    lines.append(MAKES[plan.config.parts])
    lines.append(
        f"preset {plan.config.name}, {sum(layout.sizes) / 1e9:.2f} GB in {len(layout.sizes)} files, "
        f"large matrices in {'bfloat16' if plan.half else 'float32'}"
    )
    if initial:
        shown = [p for p in plan.initialised if not p.startswith(("vae/", "dit/", "renderer/"))]
        whole = [
            n for n in ("vae", "dit", "renderer") if any(p.startswith(f"{n}/") for p in initial)
        ]
        lines.append(f"not in the files, initialised: {', '.join(whole + shown)}")
    if "prompt/rows" in initial and plan.config.parts != "reconstruction":
        lines.append(
            f"no prompt embedding: its rows are zero, as no published transformer was trained; with {umt5.FILE} beside "
            "--wan they are made (or give --t5 or --prompt-embedding)"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    from .files.entry import run

    run(main, parser())
