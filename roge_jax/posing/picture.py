"""cameras.png: where the cameras stood and what they saw, from above and from the side."""

import numpy as np

from ..geometry.cameras import Cameras

PANEL, MARGIN, HEAD = 720, 24, 28  # pixels of a view, around it, above it
BACKGROUND, INK, FIRST, LAST = (250, 250, 248), (60, 60, 60), (214, 69, 65), (38, 92, 190)
REACH = (2.0, 98.0)  # percentiles of the points that a view shows; strays would shrink all else
FRUSTUM = 0.06  # of the view: how long a camera is drawn


def draw_cameras(cameras: Cameras, xyz: np.ndarray, rgb: np.ndarray | None) -> np.ndarray:
    """A picture [h, w, 3] uint8 of cameras and points xyz [p, 3] in a world whose z is up; rgb [p, 3] are their colours.

    Cameras go from red (the first) to blue (the last). Both views have one scale.
    """
    from PIL import Image, ImageDraw, ImageFont

    centres = np.asarray(cameras.centres, np.float64)
    low, high = _bounds(centres, xyz)
    size = float(max(high - low)) or 1.0
    middle = (low + high) / 2
    views = {"from above (x right, y up)": (0, 1), "from the side (x right, z up)": (0, 2)}
    sheet = Image.new("RGB", (2 * PANEL + 3 * MARGIN, PANEL + HEAD + 2 * MARGIN), (255, 255, 255))
    font = ImageFont.load_default(size=16)
    colours = _ramp(len(centres))
    for k, (title, axes) in enumerate(views.items()):
        panel = Image.new("RGB", (PANEL, PANEL), BACKGROUND)
        draw = ImageDraw.Draw(panel)
        scale = 0.92 * PANEL / size
        flip = np.array([1.0, -1.0]) * scale

        def place(points: np.ndarray, axes=axes, flip=flip) -> np.ndarray:
            return (points[..., list(axes)] - middle[list(axes)]) * flip + PANEL / 2

        _draw_points(panel, place(xyz), rgb, xyz[:, 3 - sum(axes)] if len(xyz) else None)
        path = [tuple(p) for p in place(centres)]
        if len(path) > 1:
            draw.line(path, fill=(190, 190, 190), width=1)
        for i in range(len(centres) - 1, -1, -1):
            corners = place(_frustum(cameras, i, FRUSTUM * size))
            apex = tuple(place(centres[i]))
            around = [tuple(c) for c in corners]
            draw.polygon(around, outline=colours[i])
            for corner in around:
                draw.line([apex, corner], fill=colours[i], width=2)
            x, y = apex
            draw.ellipse([x - 3, y - 3, x + 3, y + 3], fill=colours[i])
        left = MARGIN + k * (PANEL + MARGIN)
        sheet.paste(panel, (left, HEAD + MARGIN))
        ImageDraw.Draw(sheet).text((left, MARGIN // 2), title, fill=INK, font=font)
    text = f"{len(centres)} cameras, red first, blue last; {len(xyz)} points"
    foot = ImageDraw.Draw(sheet)
    foot.text(
        (sheet.width - MARGIN - foot.textlength(text, font=font), MARGIN // 2),
        text,
        fill=INK,
        font=font,
    )
    return np.asarray(sheet)


def _bounds(centres: np.ndarray, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The box of all cameras and of most points."""
    low, high = centres.min(0), centres.max(0)
    if len(xyz):
        points = np.percentile(xyz, REACH, axis=0)
        low, high = np.minimum(low, points[0]), np.maximum(high, points[1])
    return low, high


def _draw_points(panel, pixels: np.ndarray, rgb: np.ndarray | None, behind) -> None:
    """Points of 2 x 2 pixels, the nearest to the eye last."""
    if not len(pixels):
        return
    canvas = np.array(panel)
    order = np.argsort(behind, kind="stable")
    at = np.round(pixels[order]).astype(int)
    inside = ((at >= 0) & (at < PANEL - 1)).all(1)
    shown = np.full((len(pixels), 3), 120) if rgb is None else np.asarray(rgb)
    shown = shown[order][inside]
    for dx in (0, 1):
        for dy in (0, 1):
            canvas[at[inside, 1] + dy, at[inside, 0] + dx] = shown
    from PIL import Image

    panel.paste(Image.fromarray(canvas))


def _frustum(cameras: Cameras, i: int, length: float) -> np.ndarray:
    """The corners [4, 3] of a camera's picture, `length` in front of it."""
    K, pose = cameras.K[i], cameras.c2w[i]
    x, y = K[0, 2] / K[0, 0], K[1, 2] / K[1, 1]
    local = length * np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]])
    return local @ pose[:3, :3].T + pose[:3, 3]


def _ramp(count: int) -> list[tuple[int, int, int]]:
    t = np.linspace(0, 1, max(count, 2))[:count, None]
    mix = (1 - t) * np.array(FIRST) + t * np.array(LAST)
    return [(int(r), int(g), int(b)) for r, g, b in mix]
