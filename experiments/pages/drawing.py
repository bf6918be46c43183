"""A few shapes as SVG text: what the drawings of the pages are made of. Nothing but strings, so they are the same everywhere."""

import math
from collections.abc import Sequence

INK, GREY, PALE = "#22313f", "#8795a1", "#eef2f5"
RED, GREEN, BLUE, GOLD = "#c0392b", "#27865a", "#2a6fb0", "#c98a1b"
Point = tuple[float, float]


class Drawing:
    """A picture of one size, shapes in pixels from the top left."""

    def __init__(self, width: int, height: int, title: str):
        self.width, self.height, self.title = width, height, title
        self.shapes: list[str] = []

    def add(self, shape: str) -> None:
        self.shapes.append(shape)

    def text(
        self,
        x: float,
        y: float,
        words: str,
        *,
        size: int = 14,
        colour: str = INK,
        anchor: str = "middle",
        style: str = "",
    ) -> None:
        """Lines of text, the first with its middle at y."""
        for i, line in enumerate(words.split("\n")):
            more = f' font-style="{style}"' if style in ("italic",) else ""
            more += ' font-weight="bold"' if style == "bold" else ""
            self.add(
                f'<text x="{x:g}" y="{y + i * 1.25 * size:g}" font-size="{size}" fill="{colour}" '
                f'text-anchor="{anchor}" dominant-baseline="middle"{more}>{line}</text>'
            )

    def box(
        self,
        x: float,
        y: float,
        w: float,
        h: float,
        words: str = "",
        *,
        fill: str = PALE,
        edge: str = GREY,
        size: int = 14,
        dashed: bool = False,
    ) -> None:
        """A rectangle with text in its middle."""
        dash = ' stroke-dasharray="5 4"' if dashed else ""
        self.add(
            f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="5" fill="{fill}" stroke="{edge}"{dash}/>'
        )
        lines = words.count("\n")
        if words:
            self.text(x + w / 2, y + h / 2 - lines * 0.625 * size, words, size=size)

    def line(
        self,
        points: Sequence[Point],
        *,
        colour: str = INK,
        width: float = 1.6,
        dashed: bool = False,
        arrow: bool = False,
    ) -> None:
        """Straight pieces, with a head at the end if asked for."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        dash = ' stroke-dasharray="5 4"' if dashed else ""
        self.add(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width:g}"{dash}/>'
        )
        if arrow:
            self.head(points[-2], points[-1], colour)

    def head(self, start: Point, end: Point, colour: str) -> None:
        angle = math.atan2(end[1] - start[1], end[0] - start[0])
        corners = [
            (end[0] - 10 * math.cos(angle + turn), end[1] - 10 * math.sin(angle + turn))
            for turn in (0.4, -0.4)
        ]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (end, *corners))
        self.add(f'<polygon points="{path}" fill="{colour}"/>')

    def arrow(self, *points: Point, colour: str = INK, dashed: bool = False) -> None:
        self.line(points, colour=colour, dashed=dashed, arrow=True)

    def dot(self, x: float, y: float, radius: float = 4, *, colour: str = INK) -> None:
        self.add(f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" fill="{colour}"/>')

    def shape(
        self, points: Sequence[Point], *, fill: str = "none", edge: str = INK, opacity: float = 1
    ) -> None:
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self.add(
            f'<polygon points="{path}" fill="{fill}" stroke="{edge}" fill-opacity="{opacity:g}"/>'
        )

    def camera(
        self,
        x: float,
        y: float,
        degrees: float,
        *,
        colour: str = INK,
        reach: float = 34,
        half: float = 22,
        fill: str = "white",
    ) -> None:
        """A camera from above: its centre and the cone that it sees, which points along `degrees` (0 right, 90 down)."""
        corners = [
            (
                x + reach * math.cos(math.radians(degrees + turn)),
                y + reach * math.sin(math.radians(degrees + turn)),
            )
            for turn in (-half, half)
        ]
        self.shape([(x, y), *corners], fill=fill, edge=colour)
        self.dot(x, y, 3, colour=colour)

    def svg(self) -> str:
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" '
            f'width="{self.width}" height="{self.height}" font-family="Helvetica, Arial, sans-serif">'
        )
        ground = f'<rect width="{self.width}" height="{self.height}" fill="white"/>'
        return "\n".join([head, f"<title>{self.title}</title>", ground, *self.shapes, "</svg>", ""])
