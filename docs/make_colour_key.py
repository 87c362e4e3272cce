"""Render the key of the colours that all pictures share: `python docs/make_colour_key.py`."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render import detached_figure, styles
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.figures import save_picture
from deepaccident_devkit.render.motion_maps import direction_colors
from deepaccident_devkit.taxonomy import AGENTS, short_name

PICTURE = Path(__file__).parent / "images" / "colour_key.png"
SIZES = {
    "car": (4.6, 2.0),
    "truck": (8.0, 2.6),
    "van": (5.4, 2.2),
    "cyclist": (1.8, 0.7),
    "motorcycle": (2.2, 0.9),
    "pedestrian": (0.6, 0.6),
}
"""Metres."""
STEP, ROW = 15.0, 7.0
"""Metres from one column of the key to the next, and from row to row."""


def main() -> None:
    PICTURE.parent.mkdir(exist_ok=True)
    save_picture(draw_key(detached_figure((9, 3.0))), PICTURE, dpi=120)


def draw_key(fig: Figure) -> Figure:
    """A row for each rule of the grammar, and the colour maps to their right."""
    parts = fig.subplot_mosaic([["rows", "depth"], ["rows", "height"], ["rows", "flow"]], width_ratios=(5.2, 1))
    rows = parts["rows"]
    rows.set(xlim=(-22, 6 * STEP - 4), ylim=(-4.3 * ROW, 0.6 * ROW), aspect="equal")
    rows.set_axis_off()
    vehicles = [agent for agent in AGENTS if agent != "infrastructure"]
    hues = [styles.AGENT_COLORS[agent] for agent in vehicles]
    draw_row(rows, 0, "agents", [(short_name(agent), "car", hue) for agent, hue in zip(vehicles, hues, strict=True)])
    place = (len(vehicles) * STEP, 0.0)
    rows.plot(*place, "o", color=styles.AGENT_COLORS["infrastructure"], markersize=9)
    write(rows, "infrastructure", *place)
    red = styles.COLLIDER_COLOR
    draw_row(rows, 1, "colliding pair", [("a car", "car", red), ("a pedestrian", "pedestrian", red)])
    draw_row(rows, 2, "other actors", [(name, name, styles.CATEGORY_COLORS[name]) for name in SIZES])
    draw_patches(rows, 3, "predictions", {**styles.OUTCOME_COLORS, "no verdict": styles.PREDICTED_COLOR})
    draw_patches(
        rows, 4, "charts", dict(zip(("first", "second", "third", "fourth"), styles.SERIES_COLORS, strict=True))
    )
    for name, colormap in (("depth", styles.DEPTH_COLORMAP), ("height", styles.HEIGHT_COLORMAP)):
        parts[name].imshow(np.linspace(0, 1, 256)[None], cmap=colormap, aspect="auto", extent=(0, 1, 0, 1))
        parts[name].set(xticks=(0, 1), yticks=(), box_aspect=0.16)
        parts[name].set_xticks((0, 1), ("near", "far") if name == "depth" else ("low", "high"), fontsize=8)
        parts[name].set_title(f"points by {name}", fontsize=8)
    draw_wheel(parts["flow"])
    return fig


def draw_row(ax: Axes, row: int, title: str, entries: list[tuple[str, str, str]]) -> None:
    """Boxes of one rule: their words, classes and colours."""
    ax.text(-22, -row * ROW, title, va="center", fontsize=9, fontweight="bold")
    names = [name for _, name, _ in entries]
    center = [(number * STEP, -row * ROW, 0.0) for number in range(len(entries))]
    boxes = Boxes.from_arrays(
        center, [(*SIZES[name], 1.5) for name in names], [0.0] * len(names), frame="ego", category=names
    )
    draw_boxes_from_above(boxes, ax, [color for _, _, color in entries])
    for (words, _, _), (x, y, _) in zip(entries, center, strict=True):
        write(ax, words, x, y)


def draw_patches(ax: Axes, row: int, title: str, meanings: dict[str, str]) -> None:
    """Filled rectangles of one rule."""
    ax.text(-22, -row * ROW, title, va="center", fontsize=9, fontweight="bold")
    for number, (words, color) in enumerate(meanings.items()):
        x, y = number * STEP, -row * ROW
        ax.fill([x - 2.3, x + 2.3, x + 2.3, x - 2.3], [y - 1, y - 1, y + 1, y + 1], color=color)
        write(ax, words, x, y)


def write(ax: Axes, words: str, x: float, y: float) -> None:
    ax.annotate(words, (x, y), (0, -10), textcoords="offset points", ha="center", va="top", fontsize=8)


def draw_wheel(ax: Axes) -> None:
    """The colours of directions."""
    left, along = np.mgrid[-1:1:101j, -1:1:101j]
    inside = (np.hypot(left, along) <= 1)[..., None]
    ax.imshow(np.where(inside, direction_colors(left, along, longest=1.0), 1.0), origin="lower", extent=(-1, 1, -1, 1))
    ax.set_axis_off()
    ax.set_title("flow: forward to the right", fontsize=8)


if __name__ == "__main__":
    main()
