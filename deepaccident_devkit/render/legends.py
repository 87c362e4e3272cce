"""What the colours of a picture mean."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.render.chips import SMALLEST_TEXT
from deepaccident_devkit.render.colors import AGENT_COLORS, CATEGORY_COLORS, CATEGORY_MARKERS, COLLIDER_COLOR
from deepaccident_devkit.render.roles import in_drawing_order
from deepaccident_devkit.render.titles import room_of, text_width
from deepaccident_devkit.taxonomy import short_name

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

INSIDE: Final[Mapping[str, Any]] = {"loc": "upper right", "frameon": True, "framealpha": 0.85}
"""A place in axes, so that nothing stands beside them."""
_HANDLE: Final = 0.4
"""Inches of a sign and the blanks around it."""


def box_handles(colors: Collection[str]) -> list[Artist]:
    """What these colours of boxes mean: a patch for each, or the mark of a class of small actors."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch

    agents = {short_name(agent): color for agent, color in AGENT_COLORS.items()}
    meanings = {"colliding pair": COLLIDER_COLOR, **agents, **CATEGORY_COLORS}
    return [
        _mark(name, CATEGORY_MARKERS[name], color)
        if name in CATEGORY_MARKERS
        else Patch(label=name, facecolor=to_rgba(color, 0.25), edgecolor=color)
        for name, color in meanings.items()
        if color in colors
    ]


def agent_handles(agents: Collection[str]) -> list[Artist]:
    """A dot for each agent, in the order of all pictures."""
    return [_mark(short_name(agent), "o", AGENT_COLORS[agent]) for agent in in_drawing_order(agents)]


def handles_from_above(colors: Collection[str], clouds: Collection[str]) -> list[Artist]:
    """What the colours of boxes and of agents' clouds mean; an agent with a cloud is named once."""
    known = {AGENT_COLORS[agent] for agent in clouds}
    return [*box_handles(set(colors) - known), *agent_handles(clouds)]


def _mark(label: str, marker: str, color: str) -> Artist:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle="none", marker=marker, color=color, label=label)


def draw_legend(where: Any, handles: Sequence[Artist], *, columns: int, **how: Any) -> None:
    """Render a legend below axes or a figure, with as many columns as have room; nothing if it would be empty."""
    from matplotlib.font_manager import FontProperties

    if handles:
        font = FontProperties(size=SMALLEST_TEXT)
        widest = max(text_width(str(handle.get_label()), font) for handle in handles) / 72 + _HANDLE
        columns = max(1, min(columns, int(room_of(where) / widest)))
        style = {"fontsize": SMALLEST_TEXT, "frameon": False, "handlelength": 1.2, "columnspacing": 1.0, **how}
        where.legend(handles=list(handles), ncols=columns, **style)


def draw_legend_of_fills(ax: Axes, colors: Mapping[str, str]) -> None:
    """Put a legend of filled shapes into the axes."""
    from matplotlib.patches import Patch

    handles = [Patch(label=name, facecolor=(color, 0.4), edgecolor=color) for name, color in colors.items()]
    draw_legend(ax, handles, columns=1, **INSIDE)
