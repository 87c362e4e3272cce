"""Figures and axes, their layout and their files, and the layers of pictures."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.styles import GRID_COLOR, current_style, size_in_style, text_size
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.text import choice, path_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Layer = Literal[
    "image",
    "map",
    "bev",
    "points",
    "boxes",
    "ids",
    "velocities",
    "trajectories",
    "labels",
    "visibility",
    "grid",
]
"""`image` is the camera's picture, `map` the town's ground by all its recordings, `bev` the
simulator's camera from above, `labels` the cells of the motion labels."""
LAYERS: tuple[Layer, ...] = get_args(Layer)
# Suffix → metadata without a date.
_UNDATED_METADATA: Final[Mapping[str, dict[str, Any]]] = {
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
}
# Width by height of a view from above on a slide.
_SLIDE_ASPECT_RATIO: Final = 1.6
# Maximum number of layouts of a figure.
_MAX_LAYOUT_PASSES: Final = 4
# Share of the width or height of a figure within which a panel counts as not moving.
_LAYOUT_TOLERANCE: Final = 1e-5
PICTURE_SUFFIXES: Final = (".png", ".pdf", ".svg", ".jpg", ".webp")


def layers_of(
    layers: Iterable[Layer] | None, default: Iterable[Layer], possible: Collection[Layer] = LAYERS
) -> frozenset[Layer]:
    """Return the layers to render: by default (None) the default, for an empty list none.

    Raises ChoiceError.
    """
    names: Iterable[str] = default if layers is None else layers
    if isinstance(names, str):
        names = (names,)
    return frozenset(choice("layers", name, possible) for name in names)


def axes_or_new(ax: Axes | None, size: tuple[float, float] = (8, 8)) -> Axes:
    """Return the given axes, or new ones of a pyplot figure, which notebooks display.

    The size is in inches; a style may have its own.
    """
    if ax is not None:
        return ax
    from matplotlib import pyplot as plt

    from deepaccident_devkit.render.own_figure import OwnFigure

    inches = size_in_style(size, panels="one")
    _, new_ax = plt.subplots(figsize=inches, layout="constrained", FigureClass=OwnFigure)
    return new_ax


def figure_or_new(
    fig: Figure | None,
    size: tuple[float, float],
    *,
    panels: Literal["one", "several"] = "several",
    **heights: float,
) -> Figure:
    """Return the given figure, or a new pyplot one, which notebooks display.

    The size is in inches; a style may have its own. `heights` are the heights in `page` and
    `column`, in widths.
    """
    if fig is not None:
        return fig
    from matplotlib import pyplot as plt

    from deepaccident_devkit.render.own_figure import OwnFigure

    inches = size_in_style(size, panels=panels, heights=heights)
    return plt.figure(figsize=inches, layout="constrained", FigureClass=OwnFigure)


def widening(ax: Axes | None) -> float:
    """Return the width by height of a view from above on these axes, or on new ones (None).

    New axes fill a slide.
    """
    if ax is None and current_style().ratio is not None:
        return _SLIDE_ASPECT_RATIO
    return 1.0


def label_axes(ax: Axes, frame: str) -> None:
    """Label the axes of a view from above, in metres of `ego`, `lidar` or `world`."""
    if frame == "world":
        ax.set(xlabel="x, world (m)", ylabel="y, world (m)")
    else:
        ax.set(xlabel="x forward (m)", ylabel="y left (m)")


def show_square(ax: Axes, center: Iterable[float], half: float) -> None:
    """Limit axes to a square around a centre, with equal scales; `half` is half its side."""
    x, y = center
    ax.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")


def write_in_middle(ax: Axes, words: str, **style: Any) -> None:
    """Write words into the middle of axes."""
    ax.text(0.5, 0.5, words, ha="center", va="center", transform=ax.transAxes, **style)


def hide_axes(axes: Iterable[Axes]) -> None:
    """Hide the axes of unused panels."""
    for ax in axes:
        ax.set_axis_off()


def check_view_range(metres: float) -> None:
    """Raise ChoiceError unless a range of metres to each side can be shown."""
    if not (math.isfinite(metres) and metres > 0):
        raise ChoiceError(f"view_range: expected metres above 0, found {metres!r}")


def titled_from_above(ax: Axes, title: str, *, grid: bool) -> Axes:
    """Return the axes as a view from above in metres, with a small title."""
    ax.set_aspect("equal")
    label_axes(ax, "ego")
    ax.set_title(title, fontsize=text_size())
    if grid:
        with_light_grid(ax, "both")
    return ax


def detached_figure(size: tuple[float, float]) -> Figure:
    """Return a figure for files that pyplot does not know.

    Pyplot does not store it, and no display is needed.
    """
    from deepaccident_devkit.render.own_figure import OwnFigure

    return OwnFigure(figsize=size, layout="constrained")


def with_light_grid(ax: Axes, grid: Literal["x", "y", "both"]) -> Axes:
    """Return the axes with a light grid, and without lines at the top and right."""
    ax.grid(axis=grid, color=GRID_COLOR, linewidth=0.5)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def settled(fig: Figure) -> Figure:
    """Return the figure, laid out once.

    matplotlib measures the space for titles and legends before it makes the panels' scales equal,
    so the space is too small. When it lays the figure out again at rendering, it starts from panels
    that are nearly right.
    """
    if fig.figure is not fig:  # a part of a figure is laid out with it
        return fig
    engine = fig.get_layout_engine()
    if engine is not None:
        with getattr(fig, "settings", nullcontext)():
            engine.execute(fig)
    return fig


@contextmanager
def laid_out(fig: Figure, dpi: float) -> Iterator[None]:
    """Lay a figure out until its panels move no more, a few times at most.

    Within the block, matplotlib does not lay it out.
    """
    engine, usual_dpi, positions = fig.get_layout_engine(), fig.dpi, np.zeros(0)
    fig.set_dpi(dpi)  # letters are measured in pixels
    for number in range(_MAX_LAYOUT_PASSES):
        previous_positions = positions
        settled(fig)
        positions = np.array([ax.get_position(original=False).bounds for ax in fig.axes])
        if number > 1:  # the first two may be equal by chance
            if np.abs(positions - previous_positions).max(initial=0) < _LAYOUT_TOLERANCE:
                break
    fig.set_layout_engine(None)
    try:
        yield
    finally:
        fig.set_layout_engine(engine)
        fig.set_dpi(usual_dpi)


def check_picture_path(path: str | os.PathLike[str]) -> Path:
    """Return the path, if it has the suffix of a picture; raises ChoiceError."""
    path = path_of(path)
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise ChoiceError(
            f"path: expected a file that ends in {', '.join(PICTURE_SUFFIXES)}, found {str(path)!r}"
        )
    return path


def figure_of_pixels(width: int, height: int, *, dpi: float) -> Figure:
    """Return a figure that pyplot does not know, for a picture of this width and height."""
    margin = 1e-3  # a canvas drops fractions of pixels, and inches are rounded
    figure = detached_figure(((width + margin) / dpi, (height + margin) / dpi))
    figure.set_dpi(dpi)
    return figure


def save_picture(
    picture: Axes | Figure, path: str | os.PathLike[str], *, dpi: float | None = None
) -> Path:
    """Write a `render_…` result's figure atomically into a file, and close it in pyplot.

    `dpi` is pixels an inch; None for the style's value, in a notebook 100.

    Raises:
        ChoiceError: The suffix is none of `PICTURE_SUFFIXES`.
    """
    from matplotlib import pyplot as plt

    path = check_picture_path(path)
    figure: Any = picture.figure
    try:
        return write_figure(figure, path, dpi=dpi or current_style().dpi)
    finally:
        plt.close(figure)


def write_figure(
    figure: Figure, path: Path, *, dpi: float, words: dict[str, Any] | None = None
) -> Path:
    """Write a figure in the format of the path's suffix, atomically.

    There is no date in the file: the same picture makes the same bytes. `words` are the text
    entries of a PNG file. The figure is one from `detached_figure`; others stay open in pyplot.
    """
    suffix = path.suffix[1:].lower()
    metadata = _UNDATED_METADATA.get(suffix, words)
    with replacing(path) as temporary, laid_out(figure, dpi):
        figure.savefig(temporary, format=suffix, dpi=dpi, metadata=metadata)
    return path


def report_figure(
    size: tuple[float, float], *, panels: Literal["one", "several"] = "several", **heights: float
) -> Figure:
    """Return a figure that pyplot does not know, of a size in inches, or its style's.

    `heights` are as in `figure_or_new`.
    """
    return detached_figure(size_in_style(size, panels=panels, heights=heights))


def write_report_figure(
    figure: Figure, path: Path, *, dpi: float = 150, words: dict[str, Any] | None = None
) -> Path:
    """Write a figure of a report into a PNG file.

    For a paper or a slide a PDF file is also written beside it.
    """
    style = current_style()
    if style.few:
        write_figure(figure, path.with_suffix(".pdf"), dpi=style.dpi)
        dpi = style.dpi
    return write_figure(figure, path, dpi=dpi, words=words)


def figure_png(figure: Figure, *, dpi: float) -> bytes:
    """Return a figure from `detached_figure` as the bytes of a PNG file."""
    content = io.BytesIO()
    with laid_out(figure, dpi):
        figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()
