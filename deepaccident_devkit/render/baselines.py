"""Figures of the study of V2X: bars by configuration, lines over noise and latency.

They take plain numbers: the study itself lies above this layer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.render.axes import axes_or_new, detached_figure, figure_or_new, with_light_grid
from deepaccident_devkit.render.colors import CONFIGURATION_COLORS, OWN_COLOR, PREDICTED_COLOR
from deepaccident_devkit.render.legends import draw_legend
from deepaccident_devkit.render.pictures import write_figure
from deepaccident_devkit.render.styles import in_own_settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL: Final = (4.2, 3.8)
_LEGEND: Final = 0.6
_DPI: Final = 120
_BARS_WIDE: Final = 0.84
_ABOVE: Final = 1.04
"""Room above the largest number, as a factor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Numbers to compare, one colour for each configuration.

    Attributes:
        values: configuration → group, or varied number → result; None where there is none.
        title: of the panel.
        ylabel: what the results are.
        top: the largest possible result.
        xlabel: the name of the varied number, for lines; None for bars in groups.
        intervals: configuration → group, or varied number → (low, high); rendered where there is one.
    """

    values: Mapping[str, Mapping[str | float, float | None]]
    title: str
    ylabel: str
    top: float
    xlabel: str | None = None
    intervals: Mapping[str, Mapping[str | float, tuple[float, float]]] = field(default_factory=dict)


@in_own_settings
def render_panel(panel: Panel, *, ax: Axes | None = None) -> Axes:
    """Render a panel.

    Args:
        panel: its numbers.
        ax: axes to render on; new ones if None.

    Returns:
        The axes.
    """
    ax = axes_or_new(ax, _PANEL)
    if panel.xlabel is None:
        _draw_bars(panel, ax)
    else:
        _draw_lines(panel, ax)
        ax.set_xlabel(panel.xlabel)
    ax.set(ylabel=panel.ylabel, title=panel.title, ylim=(0, _ABOVE * panel.top))
    return with_light_grid(ax, "y" if panel.xlabel is None else "both")


@in_own_settings
def render_panels(panels: Sequence[Sequence[Panel]], title: str, *, fig: Figure | None = None) -> Figure:
    """Render rows of panels under one title, with one legend.

    Args:
        panels: rows of equal length.
        title: of the figure.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure.
    """
    fig = figure_or_new(fig, _size(panels))
    axes = fig.subplots(len(panels), len(panels[0]), squeeze=False)
    for row, line in zip(panels, axes, strict=True):
        for panel, ax in zip(row, line, strict=True):
            render_panel(panel, ax=ax)
    handles, names = axes[0, 0].get_legend_handles_labels()
    draw_legend(fig, handles, columns=len(names), loc="outside lower center")
    fig.suptitle(title)
    return fig


def save_panels(panels: Sequence[Sequence[Panel]], title: str, path: Path) -> None:
    """Write `render_panels` into a PNG file, which it replaces. Raises OSError."""
    write_figure(render_panels(panels, title, fig=detached_figure(_size(panels))), path, dpi=_DPI)


def _size(panels: Sequence[Sequence[Panel]]) -> tuple[float, float]:
    return _PANEL[0] * len(panels[0]), _PANEL[1] * len(panels) + _LEGEND


def _draw_bars(panel: Panel, ax: Axes) -> None:
    groups = list(dict.fromkeys(group for bars in panel.values.values() for group in bars))
    width = _BARS_WIDE / max(1, len(panel.values))
    for place, (name, bars) in enumerate(panel.values.items()):
        known = [(index, value) for index, group in enumerate(groups) if (value := bars.get(group)) is not None]
        middle = [index + (place - (len(panel.values) - 1) / 2) * width for index, _ in known]
        color = CONFIGURATION_COLORS.get(name, PREDICTED_COLOR)
        ax.bar(middle, [value for _, value in known], width=width * 0.92, color=color, label=name)
        ends = panel.intervals.get(name, {})
        _draw_intervals(
            ax, [(x, ends[groups[at]]) for x, (at, _) in zip(middle, known, strict=True) if groups[at] in ends]
        )
    ax.set_xticks(range(len(groups)), [str(group) for group in groups])


def _draw_lines(panel: Panel, ax: Axes) -> None:
    for place, (name, line) in enumerate(panel.values.items()):
        known = [(x, y) for x, y in line.items() if y is not None]
        color = CONFIGURATION_COLORS.get(name, PREDICTED_COLOR)
        ax.plot(
            [x for x, _ in known],
            [y for _, y in known],
            color=color,
            label=name,
            linestyle=("-", "--")[place % 2],  # so that both of two equal lines are seen
            marker="so"[place % 2],
            markersize=6 - 2 * (place % 2),
        )
        _draw_intervals(ax, list(panel.intervals.get(name, {}).items()), color)


def _draw_intervals(ax: Axes, ends: Sequence[tuple[Any, tuple[float, float]]], color: str = OWN_COLOR) -> None:
    """Upright lines from low to high ends at places along x."""
    ax.vlines([x for x, _ in ends], [low for _, (low, _) in ends], [high for _, (_, high) in ends], color, linewidth=1)
