"""Figures and axes, their layout and their files, and the layers of pictures."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.styles import (
    GRID_COLOR,
    current_style,
    size_in_style,
    style,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.text import PathType, choice, path_of
from deepaccident_devkit.support.values import NamedValues

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
"""`image` is the camera's picture, `map` the town's ground combined from all recordings there,
`bev` the simulator's camera from above, `labels` the cells of the motion labels."""
Layers = tuple[Layer, ...]
LAYERS: tuple[Layer, ...] = get_args(Layer)
# Metadata without a date, by suffix.
_UNDATED_METADATA: Mapping[str, NamedValues] = {
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
}
# zlib's level. The default level takes up to twice as long, for files that are up to 6 % smaller.
_PNG_OPTIONS: Mapping[str, Any] = {"compress_level": 4}
# Whether new figures are for a file of a report, so that pyplot need not know them.
_draws_report: ContextVar[bool] = ContextVar("report", default=False)
# Width over height of a map on a slide and over a page's columns, and of a figure over a page's
# columns with a map.
_WIDE_MAP_RATIO = 1.6
_WIDE_FIGURE_RATIO = 1.9
# Maximum number of times that a figure is laid out.
_MAX_LAYOUT_PASSES = 4
# A panel that moves less than this share of the figure's width or height counts as not moving.
_LAYOUT_TOLERANCE = 1e-5
PICTURE_SUFFIXES: Final = (".png", ".pdf", ".svg", ".jpg", ".webp")


def layers_of(
    layers: Iterable[Layer] | None, default: Iterable[Layer], possible: Collection[Layer] = LAYERS
) -> frozenset[Layer]:
    """Return the layers to render: the default for None, no layers for an empty list.

    Raises ChoiceError if a layer is not in `possible`.
    """
    names: Iterable[str] = default
    if layers is not None:
        names = layers
    if isinstance(names, str):
        names = (names,)
    return frozenset(choice("layers", name, possible) for name in names)


def axes_or_new(
    ax: Axes | None,
    size: tuple[float, float] = (8, 8),
    *,
    is_map: bool = False,
    lines: float = 0,
) -> Axes:
    """Return `ax`, or if it is None new axes in a pyplot figure, which notebooks display.

    The size is in inches; a style may have its own. A map is wide in some styles, as
    `width_to_height` says. A new figure is at least as high as `lines` lines of letters.
    """
    if ax is not None:
        return ax
    from matplotlib import pyplot as plt

    from deepaccident_devkit.render.own_figure import OwnFigure

    if is_map and current_style().is_wide:
        size = (_WIDE_FIGURE_RATIO * size[1], size[1])
    inches = size_in_style(size, panels="one", lines=lines)
    _, new_ax = plt.subplots(figsize=inches, layout="constrained", FigureClass=OwnFigure)
    return new_ax


def figure_or_new(
    fig: Figure | None,
    size: tuple[float, float],
    *,
    panels: Literal["one", "several"] = "several",
    lines: float = 0,
    **heights: float,
) -> Figure:
    """Return `fig`, or if it is None a new pyplot figure, which notebooks display.

    The size is in inches; a style may have its own. `heights` are height-to-width ratios in the
    styles' `page` and `column`. A new figure is at least as high as `lines` lines of letters.
    """
    if fig is not None:
        return fig
    from matplotlib import pyplot as plt

    from deepaccident_devkit.render.own_figure import OwnFigure

    inches = size_in_style(size, panels=panels, heights=heights, lines=lines)
    if _draws_report.get():
        return detached_figure(inches)
    return plt.figure(figsize=inches, layout="constrained", FigureClass=OwnFigure)


def width_to_height(ax: Axes | None) -> float:
    """Return width over height of a view from above on axes, or on new ones if `ax` is None.

    It is 1, except for new axes on a slide or over a page's columns.
    """
    if ax is None and current_style().is_wide:
        return _WIDE_MAP_RATIO
    return 1.0


def label_axes(ax: Axes, frame: str) -> None:
    """Label the axes of a view from above, in metres, for the frame `ego`, `lidar` or `world`."""
    if frame == "world":
        ax.set(xlabel="x, world (m)", ylabel="y, world (m)")
    else:
        ax.set(xlabel="x forward (m)", ylabel="y left (m)")


def show_square(ax: Axes, center: Iterable[float], half: float) -> None:
    """Limit axes to a square around a centre, with equal scales; `half` is half its side length."""
    x, y = center
    x_limits = (x - half, x + half)
    y_limits = (y - half, y + half)
    ax.set(xlim=x_limits, ylim=y_limits, aspect="equal")


def square_around(points: FloatArray, margin: float) -> tuple[FloatArray, float]:
    """Return the centre (2,) of a square around points (P, 2), and half its side plus a margin."""
    low = points.min(axis=0)
    high = points.max(axis=0)
    center = (low + high) / 2
    extent = high - low
    half = float(extent.max()) / 2
    return center, half + margin


def write_in_middle(ax: Axes, words: str, **style: Any) -> None:
    """Write words into the middle of axes."""
    ax.text(0.5, 0.5, words, ha="center", va="center", transform=ax.transAxes, **style)


def hide_axes(axes: Iterable[Axes]) -> None:
    """Hide the axes of unused panels."""
    for ax in axes:
        ax.set_axis_off()


def check_view_range(metres: float) -> None:
    """Raise ChoiceError unless a view range is finite and above 0."""
    if not (math.isfinite(metres) and metres > 0):
        raise ChoiceError(f"view_range: expected metres above 0, found {metres!r}")


def detached_figure(size: tuple[float, float]) -> Figure:
    """Make a figure for files, of a size in inches, that pyplot does not know.

    No display is needed.
    """
    from deepaccident_devkit.render.own_figure import OwnFigure

    return OwnFigure(figsize=size, layout="constrained")


def with_light_grid(ax: Axes, grid: Literal["x", "y", "both"]) -> Axes:
    """Give axes a light grid, remove the lines at their top and right, and return them."""
    ax.grid(axis=grid, color=GRID_COLOR, linewidth=0.5)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def lay_out_figure(fig: Figure) -> Figure:
    """Lay a figure out once, and return it.

    matplotlib measures the space for titles and legends before it makes the panels' scales equal,
    so that the space is too small. When it lays the figure out again for rendering, it starts from
    panels that are nearly right.
    """
    if fig.figure is not fig:  # a part of a figure is laid out with it
        return fig
    engine = fig.get_layout_engine()
    if engine is not None and fig.axes:
        with getattr(fig, "settings", nullcontext)():
            engine.execute(fig)
    return fig


@contextmanager
def laid_out(fig: Figure, dpi: float) -> Iterator[None]:
    """Lay a figure out until its panels do not move any more, a few times at most.

    Within the block, matplotlib does not lay it out again.
    """
    engine = fig.get_layout_engine()
    usual_dpi = fig.dpi
    positions = np.zeros(0)
    fig.set_dpi(dpi)  # letters are measured in pixels
    for number in range(_MAX_LAYOUT_PASSES):
        previous_positions = positions
        lay_out_figure(fig)
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


def check_picture_path(path: PathType) -> Path:
    """Return the path if its suffix is in `PICTURE_SUFFIXES`; otherwise raise ChoiceError."""
    path = path_of(path)
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise ChoiceError(
            f"path: expected a file that ends in {', '.join(PICTURE_SUFFIXES)}, found {str(path)!r}"
        )
    return path


def figure_of_pixels(width: int, height: int, *, dpi: float) -> Figure:
    """Make a figure that pyplot does not know, for a picture of this width and height in pixels."""
    margin_px = 1e-3  # a canvas drops fractions of pixels, and inches are rounded
    width_in = (width + margin_px) / dpi
    height_in = (height + margin_px) / dpi
    figure = detached_figure((width_in, height_in))
    figure.set_dpi(dpi)
    return figure


def save_picture(picture: Axes | Figure, path: PathType, *, dpi: float | None = None) -> Path:
    """Save the result of a `render_…` function atomically, and close its figure in pyplot.

    `dpi` is in pixels per inch; None means the style's value, 100 in a notebook.

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
    figure: Figure, path: Path, *, dpi: float, words: NamedValues | None = None
) -> Path:
    """Write a figure in the format of the path's suffix, atomically.

    The file contains no date, so the same picture makes the same bytes. `words` are the text
    entries of a PNG file. The figure should come from `detached_figure`; others stay open in
    pyplot.
    """
    suffix = path.suffix[1:].lower()
    metadata = _UNDATED_METADATA.get(suffix, words)
    options: dict[str, Any] = {}
    if suffix == "png":
        options["pil_kwargs"] = _PNG_OPTIONS
    with replacing(path) as temporary, laid_out(figure, dpi):
        figure.savefig(temporary, format=suffix, dpi=dpi, metadata=metadata, **options)
    return path


def write_report_figure(
    draw: Callable[[], Figure],
    path: Path,
    *,
    dpi: float = 150,
    words: NamedValues | None = None,
    needs_pdf: bool = False,
) -> Path:
    """Write a figure of a report into a PNG file in the size of a page on the screen.

    In the style of a paper or a slide, the figure is drawn a second time in the style's own size,
    and written into a PDF file next to the PNG file.

    Args:
        draw: Function that draws a new figure in the current style; pyplot will not know it.
        path: Path of the PNG file.
        dpi: Resolution of the PNG file, pixels per inch.
        words: Text entries of the PNG file.
        needs_pdf: Whether to write the PDF file in any style.

    Returns:
        Path of the PNG file.
    """
    selected = current_style()
    token = _draws_report.set(True)
    try:
        with style(title=selected.titled):
            figure = draw()
            write_figure(figure, path, dpi=dpi, words=words)
        if selected.shows_few_panels:
            figure = draw()
        if needs_pdf or selected.shows_few_panels:
            write_figure(figure, path.with_suffix(".pdf"), dpi=selected.dpi)
    finally:
        _draws_report.reset(token)
    return path


def figure_png(figure: Figure, *, dpi: float) -> bytes:
    """Encode a figure from `detached_figure` as the bytes of a PNG file."""
    content = io.BytesIO()
    with laid_out(figure, dpi):
        figure.savefig(content, format="png", dpi=dpi, pil_kwargs=_PNG_OPTIONS)
    return content.getvalue()
