"""Words on white chips, which cover neither each other nor what they name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.render.styles import (
    CASING_COLOR,
    GRID_COLOR,
    MUTED_COLOR,
    OWN_COLOR,
    text_size,
)
from deepaccident_devkit.support.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Annotation

# In points, in a notebook; `text_size` is that of the style.
SMALLEST_TEXT: Final = 9
# Points of white around words.
_PAD: Final = 1.5
# Points from a place to its chip, the nearest first.
_RINGS: Final = np.array([2.0, 5.0, 9.0, 14.0, 20.0, 28.0, 38.0, 50.0, 65.0, 85.0, 110.0])
# Points from a place from which a line leads to its chip.
_LEADER: Final = 16.0
_TURNS: Final = np.radians([60, 120, 0, 180, -60, -120, 90, -90, 30, 150, -30, -150])
# Directions from a place to its chip, the best first.
_WAYS: Final = np.column_stack([np.cos(_TURNS), np.sin(_TURNS)])


def place_chips(
    ax: Axes,
    chips: Iterable[tuple[str, Sequence[float]]],
    *,
    colors: Sequence[str] | None = None,
    avoid: ArrayLike | None = None,
) -> None:
    """Write words near places (x, y) in data coordinates, dark on white chips, where nothing of importance is covered.

    The chips find their places when the figure is rendered, so they fit its final size; a thin line leads to a chip
    that is farther away. A chip whose place is not shown, or that finds no room, is left out: give the important ones
    first. Several calls on the same axes know of each other. `colors` are those of the edges, grey by default; shapes
    to `avoid` are as in `keep_free`.
    """
    placer = _placer(ax)
    if avoid is not None:
        keep_free(ax, avoid)
    for number, (words, (x, y)) in enumerate(chips):
        placer.chips.append(
            ax.annotate(
                words,
                (x, y),
                xytext=(0, 0),
                textcoords="offset points",
                ha="center",
                va="center",
                color=OWN_COLOR,
                fontsize=text_size(),
                bbox={
                    "facecolor": CASING_COLOR,
                    "edgecolor": GRID_COLOR if colors is None else colors[number],
                    "linewidth": 0.7,
                    "boxstyle": f"square,pad={_PAD / text_size()}",
                },
                zorder=6,
                clip_on=True,
                in_layout=False,
            )
        )


def keep_free(
    ax: Axes, shapes: ArrayLike, *, margin: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
) -> None:
    """Let no chip cover shapes (N, corners, 2) in data coordinates, and a margin around them.

    The margin is points added to a shape's left, low, right and high side: to the left and down they are negative.
    """
    corners = np.asarray(shapes, dtype=np.float64)
    if corners.size:
        placer = _placer(ax)
        placer.shapes.append(np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1))
        placer.margins.append(np.tile(margin, (len(corners), 1)))


@dataclass(slots=True, eq=False)
class _Placer:
    """The chips of axes, and what they must not cover: corners (N, 2, 2) and margins (N, 4) of upright rectangles."""

    ax: Axes
    chips: list[Annotation] = field(default_factory=list)
    shapes: list[FloatArray] = field(default_factory=list)
    margins: list[FloatArray] = field(default_factory=list)

    def place(self, renderer: Any) -> None:
        """Move the chips, and render the lines that lead to them; rectangles are pixels (left, low, right, high)."""
        if not self.chips:
            return
        point = renderer.points_to_pixels(1.0)
        area, taken = np.array(self.ax.bbox.extents), self._taken(point)
        anchors = self.ax.transData.transform([chip.xy for chip in self.chips])
        leaders = []
        for chip, anchor in zip(self.chips, anchors, strict=True):
            chip.set_visible(bool((anchor >= area[:2]).all() and (anchor <= area[2:]).all()))
            if not chip.get_visible():
                continue
            bounds = chip.get_window_extent(renderer)
            half = np.array([bounds.width, bounds.height]) / 2 + (_PAD + 0.5) * point
            middle = anchor + (
                _RINGS[:, None, None] * point * _WAYS + np.sign(_WAYS.round(6)) * half
            ).reshape(-1, 2)
            found = np.column_stack([middle - half, middle + half])
            inside = (found[:, :2] >= area[:2]).all(axis=1) & (found[:, 2:] <= area[2:]).all(axis=1)
            free = np.flatnonzero(inside & ~_overlap(found, taken))
            chip.set_visible(len(free) > 0)
            if not len(free):
                continue
            best = int(free[0])
            chip.set_position(tuple((middle[best] - anchor) / point))
            taken = np.vstack([taken, found[best]])
            if _RINGS[best // len(_WAYS)] >= _LEADER:
                leaders.append([anchor, np.clip(anchor, found[best, :2], found[best, 2:])])
        self._draw_leaders(leaders, renderer)

    def _taken(self, point: float) -> FloatArray:
        """(N, 4) the pixels of the shapes, at so many pixels a point."""
        if not self.shapes:
            return np.zeros((0, 4))
        ends = self.ax.transData.transform(np.concatenate(self.shapes).reshape(-1, 2)).reshape(
            -1, 2, 2
        )
        return (
            np.column_stack([ends.min(axis=1), ends.max(axis=1)])
            + np.concatenate(self.margins) * point
        )

    def _draw_leaders(self, leaders: list[list[FloatArray]], renderer: Any) -> None:
        from matplotlib.collections import LineCollection
        from matplotlib.transforms import IdentityTransform

        lines = LineCollection(
            leaders, colors=MUTED_COLOR, linewidths=0.6, transform=IdentityTransform()
        )
        lines.set_figure(self.ax.figure)
        lines.draw(renderer)


def _overlap(first: FloatArray, second: FloatArray) -> Any:
    """(N,) whether rectangles (N, 4) cover any of others (M, 4)."""
    apart = (first[:, None, :2] >= second[:, 2:]) | (first[:, None, 2:] <= second[:, :2])
    return (~apart.any(axis=-1)).any(axis=-1)


def _placer(ax: Axes) -> _Placer:
    """The placer of axes, which works right before their chips are rendered."""
    kind = _kind_of_artist()
    for artist in ax.artists:
        if isinstance(artist, kind):
            there: _Placer = artist.placer
            return there
    placer = _Placer(ax)
    ax.add_artist(kind(placer))
    return placer


@cache
def _kind_of_artist() -> Any:
    from matplotlib.artist import Artist

    class ChipPlacer(Artist):
        """Nothing to see: places the chips when the axes are rendered, below them in order."""

        def __init__(self, placer: _Placer) -> None:
            super().__init__()
            self.placer = placer
            self.set(zorder=5.9, in_layout=False)

        def draw(self, renderer: Any) -> None:
            self.placer.place(renderer)

    return ChipPlacer
