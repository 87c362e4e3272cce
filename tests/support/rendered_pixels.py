"""Measure pictures in tests: render axes on an Agg canvas and look at the pixels at positions given
in data coordinates.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from deepaccident_devkit.render import detached_figure


def new_axes(size: tuple[float, float] = (5, 5)) -> Any:
    """Make axes on a figure that pyplot does not know."""
    return detached_figure(size).add_subplot()


def render_canvas(ax: Axes, dpi: float = 80) -> Any:
    """Return the canvas (H, W, 3), values 0 to 255, top row first; `canvas_positions` needs it."""
    figure: Any = ax.figure
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(float)


def canvas_positions(ax: Axes, points: Any) -> Any:
    """Convert data coordinates (N, 2) to canvas pixels (N, 2), u to the right and v down."""
    u, v = ax.transData.transform(points).T
    return np.column_stack([u, ax.figure.bbox.height - v])


def has_color(
    canvas: Any, position: Any, color: str, *, within: float = 2.0, tolerance: float = 60.0
) -> bool:
    """Return whether a pixel at most `within` pixels from a position has nearly this colour."""
    height, width = canvas.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    x_distance = columns + 0.5 - position[0]
    y_distance = rows + 0.5 - position[1]
    is_near = np.hypot(x_distance, y_distance) <= within

    expected_rgb = np.array(to_rgb(color)) * 255
    color_distance = np.abs(canvas[is_near] - expected_rgb).max(axis=1)
    return bool((color_distance < tolerance).any())


def read_title(drawn: Axes | Figure) -> str:
    """Read the title of axes or of a figure as one line, without the space kept for its token."""
    text = drawn.get_title() if isinstance(drawn, Axes) else drawn.get_suptitle()
    return " ".join(text.split())


def read_tokens(figure: Any) -> list[str]:
    """Read the tokens beneath the titles of a figure."""
    return [
        text.get_text().replace("\n", "") for text in figure.artists if text.get_gid() == "token"
    ]


def read_words(ax: Axes) -> str:
    """Join the title and the texts on the axes, one a line."""
    return "\n".join([ax.get_title(), *read_texts(ax)])


def first_image(ax: Axes) -> Any:
    """Return the array of the first image on the axes."""
    return np.asarray(ax.images[0].get_array())


def ground_colors(image: Any) -> set[str]:
    """Return the colours of the cells of a picture of the ground."""
    numbers = np.unique(image.get_array())
    return {to_hex(color) for color in image.to_rgba(numbers)}


def collections_of_kind(ax: Axes, kind: type) -> list[Any]:
    """Return the collections of exactly this class, without its subclasses."""
    return [collection for collection in ax.collections if type(collection) is kind]


def read_texts(ax: Axes) -> list[str]:
    return [text.get_text() for text in ax.texts]


def read_legend(drawn: Any) -> list[str]:
    """Read the legend of axes or of a figure."""
    legend = drawn.legends[0] if isinstance(drawn, Figure) else drawn.get_legend()
    return [text.get_text() for text in legend.get_texts()]


def box_footprints(drawn: Any) -> set[tuple[float, ...]]:
    """Return the corners from above, rounded to a micrometre, of boxes or of drawn polygons."""
    if hasattr(drawn, "get_paths"):
        footprints = [path.vertices[:4] for path in drawn.get_paths()]
    else:
        footprints = drawn.bottom_corners()[..., :2]
    return {tuple(np.round(corners.ravel(), 6)) for corners in footprints}
