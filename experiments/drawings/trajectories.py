"""Every ready-made camera path, drawn with its options: docs/media/trajectories.png. Cameras alone, no model; seconds on a CPU.

    python -m experiments.drawings.trajectories

Three photos (grey) look at one point, upwards from above and to the right from the side. A path starts dark and ends bright,
at the photo in the middle but for `interpolate`.
"""

import numpy as np

from experiments import harness
from roge_jax.geometry.cameras import Cameras
from roge_jax.geometry.trajectories import PRESETS, make_path, preset_options

FILE = harness.DOCS / "media" / "trajectories.png"
FRAMES, DRAWN = 49, 7  # of a path; of them with their camera
WIDE, HIGH = 336, 192  # of the pictures
LENGTH = 0.28  # of a drawn camera
# From above: x and depth. From the side: depth and height. From the front: x and height. Rows of a projection.
SEEN = {
    "above": ([1.0, 0, 0], [0, 0, 1.0]),
    "side": ([0, 0, 1.0], [0, -1.0, 0]),
    "front": ([1.0, 0, 0], [0, -1.0, 0]),
}
LIMITS = {
    "above": {"xlim": (-0.9, 0.9), "ylim": (-0.65, 0.95)},
    "side": {"xlim": (-0.5, 1.3), "ylim": (-0.8, 0.8)},
    "front": {"xlim": (-0.9, 0.9), "ylim": (-0.8, 0.8)},
}
FROM = {name: "side" for name in ("move-down", "move-up", "tilt-down", "tilt-up")}
FROM |= {"roll": "front", "lemniscate": "front", "spiral": "front"}


def photos() -> Cameras:
    """Three on an arc around a point two units away, which they look at; the middle one stands at the origin."""
    K = np.array([[330.0, 0, WIDE / 2], [0, 330.0, HIGH / 2], [0, 0, 1.0]])
    poses = []
    for angle in np.radians([-16.0, 0.0, 16.0]):
        pose = np.eye(4)
        sine, cosine = np.sin(angle), np.cos(angle)
        pose[:3, :3] = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
        pose[:3, 3] = [-2.0 * sine, 0.0, 2.0 - 2.0 * cosine]
        poses.append(pose)
    return Cameras(np.repeat(K[None], 3, 0), np.stack(poses))


def outline(K: np.ndarray, c2w: np.ndarray, rows) -> np.ndarray:
    """A camera as one line [., 2]: its corners, each joined with its centre."""
    corners = np.array([[0, 0, 1], [WIDE, 0, 1], [WIDE, HIGH, 1], [0, HIGH, 1.0]])
    rays = LENGTH * corners @ np.linalg.inv(K).T
    points = rays @ c2w[:3, :3].T + c2w[:3, 3]
    centre, (a, b, c, d) = c2w[:3, 3], points
    return np.stack([centre, a, b, centre, c, d, centre, a, d, c, b]) @ np.array(rows).T


def options(name: str) -> str:
    """Its options with their defaults, as they are written after the colon."""
    words = {k: "auto" if v is None else v for k, v in preset_options(name).items()}
    return ", ".join(f"{k}={v:g}" if isinstance(v, float) else f"{k}={v}" for k, v in words.items())


def draw(ax, name: str) -> None:
    """One path."""
    import matplotlib

    context, where = photos(), FROM.get(name, "above")
    rows, first = SEEN[where], 0 if name == "interpolate" else 1
    path = make_path(name, context, FRAMES, start=first)
    for K, c2w in zip(context.K, context.c2w, strict=True):
        ax.plot(*outline(K, c2w, rows).T, color="0.8", lw=0.8, zorder=1)
    colours = matplotlib.colormaps["plasma"](np.linspace(0.0, 0.85, FRAMES))
    line = path.centres @ np.array(rows).T
    for i in range(FRAMES - 1):
        ax.plot(*line[i : i + 2].T, color=colours[i], lw=2.5, zorder=3)
    for i in np.linspace(0, FRAMES - 1, DRAWN).round().astype(int):
        ax.plot(*outline(path.K[i], path.c2w[i], rows).T, color=colours[i], lw=0.9, zorder=2)
    seen = "" if where == "above" else f" (from the {where})"
    ax.set_title(f"{name}{seen}\n{options(name)}", fontsize=8)
    ax.set_aspect("equal")
    ax.axis("off")
    ax.set(**LIMITS[where])


def main() -> None:
    """Draw all of them."""
    plt, columns = harness.pyplot(), 6
    figure, axes = plt.subplots(-(-len(PRESETS) // columns), columns, figsize=(14, 10))
    for ax in axes.flat:
        ax.axis("off")
    for ax, name in zip(axes.flat, PRESETS):
        draw(ax, name)
    figure.tight_layout(h_pad=0.6, w_pad=0.2)
    harness.save(figure, FILE, dpi=100)
    print(f"wrote {FILE}")


if __name__ == "__main__":
    main()
