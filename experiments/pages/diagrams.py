"""The drawings of the pages, docs/media/*.svg: axes, pixels, scale, the flow of the method, long paths.

        python -m experiments.pages.diagrams

Seconds. `make docs` runs it, and a test holds the committed drawings against it.
"""

import math

from experiments import harness
from experiments.pages.drawing import BLUE, GOLD, GREEN, GREY, INK, PALE, RED, Drawing

MEDIA = harness.DOCS / "media"


def flow() -> Drawing:
    """The method from left to right."""
    d = Drawing(860, 330, "RoGe: from photos and a path to the video")
    d.box(14, 40, 116, 50, "M photos\nwith cameras")
    d.box(14, 240, 116, 50, "camera path\nN frames")
    d.box(180, 40, 120, 50, "VGGT\nencoder", fill="#e3eef8", edge=BLUE)
    d.box(180, 240, 120, 50, "rays of all\nM + N views", fill="#fdf3e0", edge=GOLD)
    d.box(350, 40, 120, 50, "scene tokens\nZ", fill="#e3eef8", edge=BLUE)
    d.box(350, 140, 120, 50, "ray-scene\nattention", fill="#e3eef8", edge=BLUE)
    d.box(520, 140, 120, 50, "ray features\n\u03a6", fill="#e3eef8", edge=BLUE)
    d.box(520, 40, 120, 50, "RGB head:\npreview", fill="#e3eef8", edge=BLUE)
    d.box(520, 240, 120, 50, "video diffusion\ntransformer", fill="#e5f3ec", edge=GREEN)
    d.box(700, 240, 70, 50, "VAE\ndecoder", fill="#e5f3ec", edge=GREEN)
    d.box(700, 140, 140, 50, "video\nN frames")
    d.arrow((130, 65), (180, 65))
    d.arrow((300, 65), (350, 65))
    d.arrow((410, 90), (410, 140))
    d.arrow((130, 265), (180, 265))
    d.line([(70, 90), (70, 165), (240, 165), (240, 240)], arrow=True)
    d.arrow((300, 252), (330, 252), (330, 165), (350, 165))
    d.arrow((470, 165), (520, 165))
    d.arrow((580, 140), (580, 90))
    d.arrow((580, 190), (580, 240))
    d.arrow((300, 275), (520, 275))
    d.text(425, 263, "rays P", size=12, colour=GREY)
    d.text(608, 215, "G", size=12, colour=GREY)
    d.arrow((14, 65), (6, 65), (6, 316), (580, 316), (580, 290), colour=GREY, dashed=True)
    d.text(425, 304, "the photos' own latents Y", size=12, colour=GREY)
    d.arrow((640, 265), (700, 265))
    d.arrow((735, 240), (735, 190))
    d.text(295, 18, "reconstruction", size=13, colour=BLUE, style="bold")
    d.text(760, 310, "generation", size=13, colour=GREEN, style="bold")
    return d


def axes() -> Drawing:
    """The two conventions for the axes of a camera."""
    d = Drawing(700, 260, "OpenCV and OpenGL axes of a camera")
    for left, name, y, z, note in (
        (0, "OpenCV (used here)", "down", "ahead", "nerfstudio's times diag(1, -1, -1, 1)"),
        (350, "OpenGL (nerfstudio, Blender)", "up", "back", "what a transforms.json holds"),
    ):
        ox, oy = left + 150, 130
        d.text(left + 175, 22, name, style="bold")
        corners = [(ox + 95, oy - 62), (ox + 155, oy - 82), (ox + 155, oy + 2), (ox + 95, oy + 22)]
        for corner in corners:
            d.line([(ox, oy), corner], colour=GREY, width=1)
        d.shape(corners, fill=PALE, edge=GREY, opacity=0.8)
        d.text(ox + 158, oy + 16, "picture", size=12, colour=GREY, anchor="start")
        d.arrow((ox, oy), (ox + 58, oy + 40), colour=RED)
        d.text(ox + 72, oy + 50, "x right", colour=RED)
        end = oy + 70 if y == "down" else oy - 70
        d.arrow((ox, oy), (ox, end), colour=GREEN)
        d.text(ox, end + (16 if y == "down" else -14), f"y {y}", colour=GREEN)
        if z == "ahead":
            d.arrow((ox, oy), (ox + 78, oy - 20), colour=BLUE)
            d.text(ox + 60, oy - 36, "z ahead", colour=BLUE)
        else:
            d.arrow((ox, oy), (ox - 78, oy + 20), colour=BLUE)
            d.text(ox - 95, oy + 38, "z back", colour=BLUE)
        d.dot(ox, oy, 5)
        d.text(ox - 12, oy - 16, "o", style="italic")
        d.text(left + 175, 245, note, size=12, colour=GREY)
    d.line([(350, 40), (350, 230)], colour=GREY, width=1, dashed=True)
    return d


def pixels() -> Drawing:
    """Where pixels begin, and where their centres are."""
    d = Drawing(560, 270, "Edges of pixels at whole numbers, centres at one half")
    left, top, side = 90, 50, 52
    for i in range(7):
        d.line([(left + i * side, top), (left + i * side, top + 3 * side)], colour=GREY, width=1)
        d.text(left + i * side, top - 16, f"{i}" if i < 6 else "6 = W", size=13)
    for j in range(4):
        d.line([(left, top + j * side), (left + 6 * side, top + j * side)], colour=GREY, width=1)
        d.text(left - 24, top + j * side, f"{j}" if j < 3 else "3 = H", size=13)
    for i in range(6):
        for j in range(3):
            d.dot(left + (i + 0.5) * side, top + (j + 0.5) * side, 2.5, colour=GREY)
    d.dot(left + 0.5 * side, top + 0.5 * side, 5, colour=RED)
    d.text(left + 90, top + 3 * side + 24, "first pixel: centre (0.5, 0.5)", size=13, colour=RED)
    d.dot(left + 3 * side, top + 1.5 * side, 5, colour=BLUE)
    d.text(
        left + 160,
        top + 3 * side + 46,
        "middle of the picture: (W / 2, H / 2) = (3, 1.5), usually near cx, cy",
        size=13,
        colour=BLUE,
    )
    d.arrow((left + 6 * side + 14, top), (left + 6 * side + 54, top), colour=INK)
    d.text(left + 6 * side + 66, top, "u", style="italic")
    d.arrow((left - 54, top), (left - 54, top + 40), colour=INK)
    d.text(left - 54, top + 54, "v", style="italic")
    return d


def scale() -> Drawing:
    """The first photo is the world; one divisor scales all."""
    d = Drawing(640, 250, "World frame and scale")
    centres = [(150, 200), (250, 212), (340, 190), (420, 140)]
    for i, (x, y) in enumerate(centres):
        aim = math.degrees(math.atan2(60 - y, 260 - x))
        d.camera(x, y, aim, colour=BLUE if i else RED, fill="#e3eef8" if i else "#fbe6e3")
        d.text(x + 6, y + 20, f"photo {i}", size=12)
    path = [(180, 172), (260, 178), (330, 160), (400, 112), (440, 70)]
    d.line(path, colour=GREEN)
    for x, y in path:
        d.dot(x, y, 3, colour=GREEN)
    d.text(475, 66, "path", size=13, colour=GREEN)
    d.box(235, 34, 50, 34, "thing", size=12)
    d.line([centres[0], centres[3]], dashed=True, colour=GOLD)
    d.head(centres[0], centres[3], GOLD)
    d.text(310, 150, "r", colour=GOLD, style="italic")
    d.text(70, 196, "origin\nof the world", size=12, colour=RED)
    d.text(
        530,
        180,
        "r: the photo farthest\nfrom photo 0\nall positions are\ndivided by 1.35 r",
        size=13,
        colour=GOLD,
    )
    return d


def capture() -> Drawing:
    """How to walk around a thing with a camera."""
    d = Drawing(640, 250, "Photos of one thing: overlap, and walk sideways")
    for left, title, colour in ((0, "good: an arc", GREEN), (330, "bad: one spot, turning", RED)):
        d.text(left + 150, 20, title, colour=colour, style="bold")
        d.box(left + 125, 70, 50, 40, "thing", size=12)
    for i in range(7):
        angle = math.radians(20 + 140 * i / 6)
        x, y = 150 + 125 * math.cos(angle), 90 + 125 * math.sin(angle)
        d.camera(x, y, math.degrees(angle) + 180, colour=GREEN, fill="#e5f3ec", reach=40, half=18)
    for turn in (-115, -90, -65):
        d.camera(480, 205, turn, colour=RED, fill="#fbe6e3", reach=60, half=18)
    d.text(480, 234, "no distance can be told from one spot", size=12, colour=GREY)
    d.text(150, 240, "each photo shares two thirds with the next", size=12, colour=GREY)
    d.line([(320, 30), (320, 230)], colour=GREY, width=1, dashed=True)
    return d


def weights() -> Drawing:
    """Which published file fills which part."""
    d = Drawing(700, 250, "Which file fills which part of the model")
    rows = [
        (30, "LagerNVS\nmodel.pt", "scene encoder", BLUE, "#e3eef8"),
        (30, "", "renderer of rays", BLUE, "#e3eef8"),
        (90, "Wan2.1\ntransformer", "video transformer", GREEN, "#e5f3ec"),
        (150, "Wan2.1_VAE.pth", "VAE", GREEN, "#e5f3ec"),
        (200, "umT5 rows of\none prompt", "prompt", GREEN, "#e5f3ec"),
    ]
    d.text(95, 14, "published", size=13, colour=GREY)
    d.text(345, 14, "in the model folder", size=13, colour=GREY)
    tops = [30, 62, 102, 152, 202]
    for top, (_, file, part, edge, fill) in zip(tops, rows, strict=True):
        d.box(260, top, 170, 28, part, fill=fill, edge=edge, size=13)
        if file:
            height = 60 if file.startswith("Lager") else 40
            d.box(20, top - (0 if height == 60 else 6), 150, height, file, size=13)
    for y in (44, 76, 116, 166, 216):
        d.arrow((170, y), (260, y))
    d.box(510, 100, 170, 46, "rays and geometry\nembeddings", fill="#fdf3e0", edge=GOLD, size=13)
    d.text(595, 166, "new in RoGe: start at zero,\ntrained by stage lora", size=12, colour=GOLD)
    d.line([(510, 118), (430, 118)], colour=GOLD)
    d.head((510, 118), (430, 118), GOLD)
    return d


def sweep() -> Drawing:
    """Depths along a ray, and what two photos show there."""
    d = Drawing(700, 280, "Depths along a ray: where the photos agree is the surface")
    d.camera(60, 220, -18, colour=RED, fill="#fbe6e3", reach=40)
    d.text(66, 250, "target view", size=12, colour=RED)
    d.camera(200, 250, -48, colour=BLUE, fill="#e3eef8", reach=40)
    d.text(205, 270, "photo 0", size=12, colour=BLUE)
    d.camera(420, 250, -112, colour=BLUE, fill="#e3eef8", reach=40)
    d.text(425, 270, "photo 1", size=12, colour=BLUE)
    ray = lambda t: (60 + 560 * t, 220 - 180 * t)  # noqa: E731
    d.line([ray(0), ray(1.0)], colour=RED, dashed=True)
    for i, t in enumerate((0.3, 0.45, 0.6, 0.75, 0.9)):
        x, y = ray(t)
        d.dot(x, y, 6 if i == 2 else 4, colour=GREEN if i == 2 else GREY)
    x, y = ray(0.6)
    for start in ((200, 250), (420, 250)):
        d.line([start, (x, y)], colour=GREEN, width=1.2)
    x4, y4 = ray(0.9)
    for start in ((200, 250), (420, 250)):
        d.line([start, (x4, y4)], colour=GREY, width=1, dashed=True)
    d.line([(370, 62), (410, 112), (448, 160)], colour=INK, width=3)
    d.text(352, 48, "surface", size=13)
    d.text(372, 92, "here the photos agree", size=13, colour=GREEN, anchor="end")
    d.text(585, 78, "there they differ", size=13, colour=GREY, anchor="start")
    return d


def chunks() -> Drawing:
    """A long path, chunk by chunk."""
    d = Drawing(700, 230, "A long path is made chunk by chunk")
    d.box(20, 80, 110, 50, "photos", fill="#e3eef8", edge=BLUE)
    for i, left in enumerate((180, 370, 560)):
        d.box(left, 80, 120, 50, f"chunk {i + 1}\n17 frames", fill="#e5f3ec", edge=GREEN)
        if i:
            d.arrow((left - 70, 105), (left, 105), colour=GREEN)
            d.text(left - 36, 93, "last frame", size=11, colour=GREEN)
        d.line([(75, 80), (75, 40), (left + 60, 40), (left + 60, 80)], arrow=True, colour=BLUE)
    d.line([(240, 130), (240, 185), (620, 185), (620, 130)], colour=GOLD, arrow=True)
    d.text(430, 200, "the earlier frame that comes nearest to what is next", size=12, colour=GOLD)
    d.text(340, 24, "every chunk sees the photos", size=12, colour=BLUE)
    return d


DRAWINGS = {
    "axes": axes,
    "capture": capture,
    "chunks": chunks,
    "flow": flow,
    "pixels": pixels,
    "scale": scale,
    "sweep": sweep,
    "weights": weights,
}


if __name__ == "__main__":
    MEDIA.mkdir(parents=True, exist_ok=True)
    for name, draw in DRAWINGS.items():
        (MEDIA / f"{name}.svg").write_text(draw().svg())
    print(f"{MEDIA.relative_to(harness.ROOT)}: {', '.join(DRAWINGS)}")
