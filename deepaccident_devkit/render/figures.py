"""Figures and axes, made, laid out and written into files, and the layers that pictures have."""

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
"""`image` is the camera's picture, `map` the town's ground by all its recordings, `bev` the simulator's camera from
above, `labels` what the motion labels say."""
LAYERS: tuple[Layer, ...] = get_args(Layer)
_UNDATED: Final[Mapping[str, dict[str, Any]]] = {
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
}
# Width by height of a view from above on a slide.
_WIDE: Final = 1.6
# How often a figure is laid out at most; of its width or height, how far a panel that does not move may move.
_PASSES, _STILL = 4, 1e-5
PICTURE_SUFFIXES: Final = (".png", ".pdf", ".svg", ".jpg", ".webp")


def layers_of(
    given: Iterable[Layer] | None, default: Iterable[Layer], possible: Collection[Layer] = LAYERS
) -> frozenset[Layer]:
    """The layers to render of the possible ones: None is the default, an empty list none. Raises ChoiceError."""
    words = default if given is None else given
    return frozenset(
        choice("layers", layer, possible)
        for layer in ((words,) if isinstance(words, str) else words)
    )


def axes_or_new(ax: Axes | None, size: tuple[float, float] = (8, 8)) -> Axes:
    """The axes given, or those of a new pyplot figure, which notebooks display, of a size in inches or its style's."""
    if ax is not None:
        return ax
    from matplotlib import pyplot as plt

    from deepaccident_devkit.render.own_figure import OwnFigure

    return plt.subplots(
        figsize=size_in_style(size, panels="one"), layout="constrained", FigureClass=OwnFigure
    )[1]


def figure_or_new(
    fig: Figure | None,
    size: tuple[float, float],
    *,
    panels: Literal["one", "several"] = "several",
    **heights: float,
) -> Figure:
    """The figure given, or a new pyplot one, which notebooks display, of a size in inches or its style's.

    `heights` are those of `page` and `column`, in widths.
    """
    if fig is not None:
        return fig
    from matplotlib import pyplot as plt

    from deepaccident_devkit.render.own_figure import OwnFigure

    inches = size_in_style(size, panels=panels, heights=heights)
    return plt.figure(figsize=inches, layout="constrained", FigureClass=OwnFigure)


def widening(ax: Axes | None) -> float:
    """By how much a view from above, on these axes or new ones, is wider than high: on a slide it fills it."""
    return _WIDE if ax is None and current_style().ratio is not None else 1.0


def axis_words(frame: str) -> tuple[str, str]:
    """The labels of the axes of a view from above, in metres of `ego`, `lidar` or `world`."""
    return ("x, world (m)", "y, world (m)") if frame == "world" else ("x forward (m)", "y left (m)")


def check_view_range(metres: float) -> None:
    """Raise ChoiceError unless so many metres can be shown to each side."""
    if not (math.isfinite(metres) and metres > 0):
        raise ChoiceError(f"view_range: expected metres above 0, found {metres!r}")


def titled_from_above(ax: Axes, title: str, *, grid: bool) -> Axes:
    """The axes as a view from above in metres, with a small title."""
    ax.set(aspect="equal", xlabel="x forward (m)", ylabel="y left (m)")
    ax.set_title(title, fontsize=text_size())
    return with_light_grid(ax, "both") if grid else ax


def detached_figure(size: tuple[float, float]) -> Figure:
    """A figure that pyplot does not know, for files: pyplot does not keep it, and no display is needed."""
    from deepaccident_devkit.render.own_figure import OwnFigure

    return OwnFigure(figsize=size, layout="constrained")


def with_light_grid(ax: Axes, grid: Literal["x", "y", "both"]) -> Axes:
    """The axes, with a light grid in the background, and without lines at the top and right."""
    ax.grid(axis=grid, color=GRID_COLOR, linewidth=0.5)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def settled(fig: Figure) -> Figure:
    """The figure, laid out once.

    matplotlib measures the room for titles and legends before it makes the panels' scales equal, so the room is too
    small. When it lays the figure out again at rendering, it starts from panels that are nearly right.
    """
    engine = (
        fig.get_layout_engine() if fig.figure is fig else None
    )  # a part of a figure is laid out with it
    if engine is not None:
        with getattr(fig, "settings", nullcontext)():
            engine.execute(fig)
    return fig


@contextmanager
def laid_out(fig: Figure, dpi: float) -> Iterator[None]:
    """Lay a figure out until its panels move no more, a few times at most; in the block, matplotlib does not do it."""
    engine, usual, places = fig.get_layout_engine(), fig.dpi, np.zeros(0)
    fig.set_dpi(dpi)  # letters are measured in pixels
    for number in range(_PASSES):
        before, places = (
            places,
            np.array([ax.get_position(original=False).bounds for ax in settled(fig).axes]),
        )
        if (
            number > 1 and np.abs(places - before).max(initial=0) < _STILL
        ):  # the first two may be equal by chance
            break
    fig.set_layout_engine(None)
    try:
        yield
    finally:
        fig.set_layout_engine(engine)
        fig.set_dpi(usual)


def check_picture_path(path: str | os.PathLike[str]) -> Path:
    """The path, if it has the suffix of a picture; raises ChoiceError."""
    path = path_of(path)
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise ChoiceError(
            f"path: expected a file that ends in {', '.join(PICTURE_SUFFIXES)}, found {str(path)!r}"
        )
    return path


def figure_of_pixels(width: int, height: int, *, dpi: float) -> Figure:
    """A figure that pyplot does not know, whose picture has exactly this width and height."""
    whole = 1e-3  # a canvas drops fractions of pixels, and inches are rounded
    figure = detached_figure(((width + whole) / dpi, (height + whole) / dpi))
    figure.set_dpi(dpi)
    return figure


def save_picture(
    drawn: Axes | Figure, path: str | os.PathLike[str], *, dpi: float | None = None
) -> Path:
    """Write a `render_…` result's figure atomically into a file of one of `PICTURE_SUFFIXES`, and close it in pyplot.

    `dpi` is pixels an inch; None for those of the style, in a notebook's 100. Raises ChoiceError for another suffix.
    """
    from matplotlib import pyplot as plt

    path = check_picture_path(path)
    figure: Any = drawn.figure
    try:
        return write_figure(figure, path, dpi=dpi or current_style().dpi)
    finally:
        plt.close(figure)


def write_figure(
    figure: Figure, path: Path, *, dpi: float, words: dict[str, Any] | None = None
) -> Path:
    """Write a figure as the path's suffix says, atomically and without a date: the same picture makes the same bytes.

    `words` are the text entries of a PNG file. The figure is one from `detached_figure`; others stay open in pyplot.
    """
    kind = path.suffix[1:].lower()
    with replacing(path) as temporary, laid_out(figure, dpi):
        figure.savefig(temporary, format=kind, dpi=dpi, metadata=_UNDATED.get(kind, words))
    return path


def report_figure(
    size: tuple[float, float], *, panels: Literal["one", "several"] = "several", **heights: float
) -> Figure:
    """A figure that pyplot does not know, of a size in inches, or its style's; `heights` are as in `figure_or_new`."""
    return detached_figure(size_in_style(size, panels=panels, heights=heights))


def write_report_figure(
    figure: Figure, path: Path, *, dpi: float = 150, words: dict[str, Any] | None = None
) -> Path:
    """Write a figure of a report into a PNG file, and for a paper or a slide also into a PDF file beside it."""
    style = current_style()
    if style.few:
        write_figure(figure, path.with_suffix(".pdf"), dpi=style.dpi)
    return write_figure(figure, path, dpi=style.dpi if style.few else dpi, words=words)


def figure_png(figure: Figure, *, dpi: float) -> bytes:
    """A figure from `detached_figure` as the bytes of a PNG file."""
    written = io.BytesIO()
    with laid_out(figure, dpi):
        figure.savefig(written, format="png", dpi=dpi)
    return written.getvalue()
