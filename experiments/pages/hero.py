"""The moving picture at the top of the README, docs/media/hero.webp: photos on the left, the video made of them.

        make sample && python -m experiments.pages.hero outputs/sample

Reads the folder of a run of `roge_jax.sample`. The video goes there and back, so that its ends meet. Seconds.
"""

import argparse
from pathlib import Path

import numpy as np

from experiments import harness
from roge_jax.files import video_io
from roge_jax.files.entry import run

OUT, MOST_BYTES, GAP = harness.DOCS / "media" / "hero.webp", 1_500_000, 6


def parser() -> argparse.ArgumentParser:
    p = harness.parser(__doc__)
    p.add_argument("folder", type=Path, help="a run of roge_jax.sample")
    p.add_argument("--out", type=Path, default=OUT)
    return p


def beside(photos: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Frames [n, h, w + .., 3] uint8 with at most four photos in a column on their left, on white."""
    from PIL import Image

    height, width = frames.shape[1:3]
    photos = photos[np.linspace(0, len(photos) - 1, min(4, len(photos))).astype(int)]
    tall = (height - GAP * (len(photos) - 1)) // len(photos)
    wide = min(round(tall * width / height), width // 2)
    tall = round(wide * height / width)
    canvas = np.full((len(frames), height, wide + 2 * GAP + width, 3), 255, np.uint8)
    for i, photo in enumerate(photos):
        small = Image.fromarray(photo).resize((wide, tall), Image.Resampling.LANCZOS)
        canvas[:, i * (tall + GAP) : i * (tall + GAP) + tall, :wide] = np.asarray(small)
    canvas[:, :, wide + 2 * GAP :] = frames
    return canvas


def main(args: argparse.Namespace) -> None:
    from PIL import Image

    import roge_jax as rj
    from roge_jax.scenes.scene import prepare

    record = harness.read(args.folder / "run.json")
    names = sorted((args.folder / "frames").glob("*.png"))
    frames = np.stack([np.asarray(Image.open(name).convert("RGB")) for name in names])
    scene = rj.load_scene(record["scene"]["source"])
    photos, _ = prepare(scene, record["scene"]["context"], *frames.shape[1:3])
    made = beside(video_io.to_uint8(photos), np.concatenate([frames, frames[-2:0:-1]]))
    for quality in (85, 75, 65, 50, 35):
        video_io.write_webp(args.out, made, fps=12, quality=quality)
        if args.out.stat().st_size < MOST_BYTES:
            break
    print(
        f"{args.out}: {len(made)} frames of {made.shape[2]} x {made.shape[1]}, {args.out.stat().st_size} bytes"
    )


if __name__ == "__main__":
    run(main, parser())
