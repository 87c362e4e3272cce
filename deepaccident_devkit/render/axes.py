"""Where panels are rendered: on the caller's axes, or on new ones that a notebook shows."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, Final, Literal

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.colors import GRID_COLOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.font_manager import FontProperties

_BREAKS: Final = re.compile(r"(?<=/)|(?<=, )")
"""Where a title may be broken."""
_TITLE_SHARE: Final = 0.92
"""Of a figure's width that a title may take."""
_LEAST_SHRINKING: Final = 0.85
"""How small letters may become, by size, before a title is broken into lines."""
_PANEL_SHARE: Final = 0.86
"""Of a panel's width: what is beside the axes moves their title to one side."""


def axes_or_new(ax: Axes | None, size: tuple[float, float] = (8, 8)) -> Axes:
    """The axes given, or those of a new pyplot figure (which a notebook displays) of a size in inches."""
    if ax is not None:
        return ax
    from matplotlib import pyplot as plt

    return plt.subplots(figsize=size, layout="constrained")[1]


def figure_or_new(fig: Figure | None, size: tuple[float, float]) -> Figure:
    """The figure given, or a new pyplot one (which a notebook displays) of a size in inches."""
    if fig is not None:
        return fig
    from matplotlib import pyplot as plt

    return plt.figure(figsize=size, layout="constrained")


def set_title(where: Axes | Figure, words: str, *, fontsize: float | str | None = None, **style: Any) -> None:
    """Give axes or a figure a title that its figure's width does not cut off.

    If a line is a little too long, the letters are smaller. If it is far too long, it is broken after `/` or a comma.
    """
    from matplotlib import rcParams
    from matplotlib.axes import Axes
    from matplotlib.font_manager import FontProperties

    font = FontProperties(
        size=fontsize or rcParams["axes.titlesize" if isinstance(where, Axes) else "figure.titlesize"]
    )
    room = 72 * _room(where)
    text, longest = words, _longest(words, font)
    if longest > room / _LEAST_SHRINKING:
        text = "\n".join(_broken(line, room, font) for line in words.split("\n"))
        longest = _longest(text, font)
    size = font.get_size_in_points() * min(1.0, room / max(longest, 1.0))
    if isinstance(where, Axes):
        where.set_title(text, fontsize=size, **style)
    else:
        where.suptitle(text, fontsize=size, **style)


def _room(where: Axes | Figure) -> float:
    """Inches of a figure's width, or of a panel's share of it, that a title may take."""
    from matplotlib.axes import Axes

    fig: Any = where.figure if isinstance(where, Axes) else where
    share, spec = _TITLE_SHARE, None
    if isinstance(where, Axes):
        share, spec = _PANEL_SHARE, where.get_subplotspec()
    if spec is not None:
        ratios: Any = spec.get_gridspec().get_width_ratios() or [1] * spec.get_gridspec().ncols
        share *= sum(ratios[spec.colspan.start : spec.colspan.stop]) / sum(ratios)
    return float(share * fig.bbox.width / fig.dpi)


def _broken(line: str, room: float, font: FontProperties) -> str:
    """A line, broken where it may be so that each part has room (points), if possible."""
    lines = [""]
    for part in _BREAKS.split(line):
        if lines[-1] and _text_width(lines[-1] + part.rstrip(), font) > room:
            lines.append("")
        lines[-1] += part
    return "\n".join(each.rstrip() for each in lines)


def _longest(text: str, font: FontProperties) -> float:
    """Points of the longest line."""
    return max(_text_width(line, font) for line in text.split("\n"))


def _text_width(text: str, font: FontProperties) -> float:
    """Points."""
    from matplotlib.textpath import text_to_path

    return float(text_to_path.get_text_width_height_descent(text, font, ismath=False)[0]) if text else 0.0


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
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


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
    engine = fig.get_layout_engine() if fig.figure is fig else None  # a part of a figure is laid out with it
    if engine is not None:
        engine.execute(fig)
    return fig
