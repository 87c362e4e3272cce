"""Where panels are rendered, on the caller's axes or on new ones that a notebook shows, and which layers they have."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Literal, get_args

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.colors import GRID_COLOR
from deepaccident_devkit.render.styles import size_in_style
from deepaccident_devkit.support.text import choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Layer = Literal[
    "image", "map", "bev", "points", "boxes", "ids", "velocities", "trajectories", "labels", "visibility", "grid"
]
"""`image` is the camera's picture, `map` the town's ground by all its recordings, `bev` the simulator's camera from
above, `labels` what the motion labels say."""
LAYERS: tuple[Layer, ...] = get_args(Layer)


def layers_of(
    given: Iterable[Layer] | None, default: Iterable[Layer], possible: Collection[Layer] = LAYERS
) -> frozenset[Layer]:
    """The layers to render.

    Args:
        given: the caller's layers, in a list or one alone. None stands for the default, an empty list for an empty
            picture.
        default: the layers rendered when the caller does not choose.
        possible: the layers that the picture has.

    Returns:
        The layers chosen.

    Raises:
        ChoiceError: the picture does not have a layer.
    """
    words = default if given is None else given
    return frozenset(choice("layers", layer, possible) for layer in ((words,) if isinstance(words, str) else words))


def axes_or_new(ax: Axes | None, size: tuple[float, float] = (8, 8)) -> Axes:
    """The axes given, or those of a new pyplot figure, which notebooks display, of a size in inches or its style's."""
    if ax is not None:
        return ax
    from matplotlib import pyplot as plt

    from deepaccident_devkit.render.own_figure import OwnFigure

    inches = size_in_style(size, panels="one")
    return plt.subplots(figsize=inches, layout="constrained", FigureClass=OwnFigure)[1]


def figure_or_new(fig: Figure | None, size: tuple[float, float]) -> Figure:
    """The figure given, or a new pyplot one, which notebooks display, of a size in inches or its style's."""
    if fig is not None:
        return fig
    from matplotlib import pyplot as plt

    from deepaccident_devkit.render.own_figure import OwnFigure

    return plt.figure(figsize=size_in_style(size, panels="several"), layout="constrained", FigureClass=OwnFigure)


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
    ax.set_title(title, fontsize=9)
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


def settled(fig: Figure, passes: int = 1) -> Figure:
    """The figure, laid out so many times.

    matplotlib measures the room for titles and legends before it makes the panels' scales equal, so the room is too
    small. When it lays the figure out again at rendering, it starts from panels that are nearly right.
    """
    engine = fig.get_layout_engine() if fig.figure is fig else None  # a part of a figure is laid out with it
    if engine is not None:
        with getattr(fig, "settings", nullcontext)():
            for _ in range(passes):
                engine.execute(fig)
    return fig
