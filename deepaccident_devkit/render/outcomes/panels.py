"""What the panels of outcomes share: a place from above, and what the colours mean."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.render.axes import with_light_grid
from deepaccident_devkit.render.layers import Layer
from deepaccident_devkit.render.legends import draw_legend

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BESIDE: Final[Mapping[str, Any]] = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "borderaxespad": 0.0}
"""Where a legend covers nothing."""


def outcome_panel(ax: Axes, title: str, shown: frozenset[Layer]) -> Axes:
    """The axes as a view from above in metres, with a small title."""
    ax.set(aspect="equal", xlabel="x forward (m)", ylabel="y left (m)")
    ax.set_title(title, fontsize=9)
    return with_light_grid(ax, "both") if "grid" in shown else ax


def outcome_legend(ax: Axes, colors: Mapping[str, str]) -> None:
    """What the colours of filled shapes mean, beside the axes."""
    from matplotlib.patches import Patch

    handles = [Patch(label=name, facecolor=(color, 0.4), edgecolor=color) for name, color in colors.items()]
    draw_legend(ax, handles, columns=1, **BESIDE)
