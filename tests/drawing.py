"""What tests of pictures measure: pixels rendered on an Agg canvas, at places given in data
coordinates.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from deepaccident_devkit.render import detached_figure


def new_axes(size: tuple[float, float] = (5, 5)) -> Any:
    """Axes of a figure that pyplot does not know."""
    return detached_figure(size).add_subplot()


def rendered(ax: Axes, dpi: float = 80) -> Any:
    """The canvas (H, W, 3) in 0 to 255, row 0 at the top, after which `on_canvas` is right."""
    figure: Any = ax.figure
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(float)


def on_canvas(ax: Axes, places: Any) -> Any:
    """Data coordinates (N, 2) as places (N, 2) of the canvas, u to the right and v down."""
    u, v = ax.transData.transform(places).T
    return np.column_stack([u, ax.figure.bbox.height - v])


def has_color(
    picture: Any, place: Any, color: str, *, within: float = 2.0, tolerance: float = 60.0
) -> bool:
    """Whether a pixel whose centre is within some pixels of a place of the canvas has a colour,
    nearly.
    """
    height, width = picture.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    near = np.hypot(columns + 0.5 - place[0], rows + 0.5 - place[1]) <= within
    distance = np.abs(picture[near] - np.array(to_rgb(color)) * 255).max(axis=1)
    return bool((distance < tolerance).any())


def title_of(drawn: Axes | Figure) -> str:
    """The title of axes or of a figure on one line, and without the room for its token."""
    text = drawn.get_title() if isinstance(drawn, Axes) else drawn.get_suptitle()
    return " ".join(text.split())


def tokens_of(figure: Any) -> list[str]:
    """The tokens beneath the titles of a figure."""
    return [
        each.get_text().replace("\n", "") for each in figure.artists if each.get_gid() == "token"
    ]


def words(ax: Axes) -> str:
    """The title and the texts on the axes, a line each."""
    return "\n".join([ax.get_title(), *(text.get_text() for text in ax.texts)])


def picture(ax: Axes) -> Any:
    """The first image on the axes, as it was given."""
    return np.asarray(ax.images[0].get_array())


def of_kind(ax: Axes, kind: type) -> list[Any]:
    """The collections of a class, and of none that is derived from it."""
    return [each for each in ax.collections if type(each) is kind]


def texts(ax: Axes) -> list[str]:
    return [text.get_text() for text in ax.texts]


def legend_words(where: Any) -> list[str]:
    """Of axes or of a figure."""
    legend = where.legends[0] if isinstance(where, Figure) else where.get_legend()
    return [text.get_text() for text in legend.get_texts()]


def footprints(drawn: Any) -> set[tuple[float, ...]]:
    """The corners from above, to a micrometre, of boxes or of polygons on axes."""
    if hasattr(drawn, "get_paths"):
        return {tuple(np.round(path.vertices[:4].ravel(), 6)) for path in drawn.get_paths()}
    return {tuple(np.round(corners[:, :2].ravel(), 6)) for corners in drawn.bottom_corners()}
