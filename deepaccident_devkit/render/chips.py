"""Words on white chips (labels), which cover neither each other nor the things that they name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
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

# Size of the smallest letters in a notebook, points; `text_size` returns the size in the current
# style.
SMALLEST_TEXT: Final = 9
# Margin in points around dots and thin lines that chips do not cover, as for `keep_free`.
DOT_MARGIN_PT: Final = (-4.0, -4.0, 4.0, 4.0)
# White margin around words, in points.
_PADDING_PT = 1.5
# Number of points on a line between two points that chips do not cover.
_STEPS_PER_LINE = 20
# Distances from an anchor to its chip in points, the nearest first.
_DISTANCES_PT = np.array([2.0, 5.0, 9.0, 14.0, 20.0, 28.0, 38.0, 50.0, 65.0, 85.0, 110.0])
# Minimum distance of a chip from its anchor, in points, at which a line connects them.
_MIN_LEADER_DISTANCE_PT = 16.0
_ANGLES_RAD = np.radians([60, 120, 0, 180, -60, -120, 90, -90, 30, 150, -30, -150])
# Directions from an anchor to its chip, the best first.
_DIRECTIONS = np.column_stack([np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)])


def place_chips(
    ax: Axes,
    chips: Iterable[tuple[str, Sequence[float]]],
    *,
    colors: Sequence[str] | None = None,
    avoid: ArrayLike | None = None,
) -> None:
    """Write words near anchors (x, y) in data coordinates, dark on white chips.

    Chips cover neither each other nor the shapes to avoid, even across several calls on the same
    axes. They are placed when the figure is rendered, so they fit its final size. A thin line
    connects a distant chip with its anchor. A chip is left out if its anchor is not shown, or if
    there is no space for it; pass the important ones first.

    Args:
        ax: Axes to write on.
        chips: Words and anchors.
        colors: Colours of the chips' edges; grey by default.
        avoid: Shapes that the chips must not cover, as for `keep_free`.
    """
    placer = _placer(ax)
    if avoid is not None:
        keep_free(ax, avoid)
    for number, (words, (x, y)) in enumerate(chips):
        box = {
            "facecolor": CASING_COLOR,
            "edgecolor": GRID_COLOR if colors is None else colors[number],
            "linewidth": 0.7,
            "boxstyle": f"square,pad={_PADDING_PT / text_size()}",
        }
        chip = ax.annotate(
            words,
            (x, y),
            xytext=(0, 0),
            textcoords="offset points",
            ha="center",
            va="center",
            color=OWN_COLOR,
            fontsize=text_size(),
            bbox=box,
            zorder=6,
            clip_on=True,
            in_layout=False,
        )
        placer.chips.append(chip)


def keep_free(
    ax: Axes, shapes: ArrayLike, *, margin: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
) -> None:
    """Prevent chips from covering shapes (N, corners, 2) in data coordinates, plus a margin.

    The margin is in points, added to a shape's left, lower, right and upper edge; to the left and
    down, a negative number enlarges the shape.
    """
    corners = np.asarray(shapes, dtype=np.float64)
    if not corners.size:
        return
    placer = _placer(ax)
    bounds = [corners.min(axis=1), corners.max(axis=1)]
    placer.shapes.append(np.stack(bounds, axis=1))
    placer.margins.append(np.tile(margin, (len(corners), 1)))


def keep_line_free(
    ax: Axes, points: FloatArray, *, margin: tuple[float, float, float, float]
) -> None:
    """Prevent chips from covering the line through points (N, 2), plus a margin, as `keep_free`."""
    keep_free(ax, points[:, None], margin=margin)
    for start, end in pairwise(points):
        steps = np.linspace(start, end, _STEPS_PER_LINE)
        keep_free(ax, steps[:, None], margin=margin)


@dataclass(slots=True, eq=False)
class _Placer:
    """The chips on one Axes, and the axis-aligned rectangles that they must not cover.

    They do not cover the legend of the axes either.

    Attributes:
        ax: The axes.
        chips: The chips, in order of importance.
        shapes: Corners of rectangles, shape (N, 2, 2), data coordinates.
        margins: Margins of rectangles, shape (N, 4), points.
    """

    ax: Axes
    chips: list[Annotation] = field(default_factory=list)
    shapes: list[FloatArray] = field(default_factory=list)
    margins: list[FloatArray] = field(default_factory=list)

    def place_all(self, renderer: Any) -> None:
        """Move the chips to free places, and draw the lines that connect them with their anchors.

        Rectangles are in pixels (left, bottom, right, top).
        """
        from matplotlib.collections import LineCollection
        from matplotlib.transforms import IdentityTransform

        if not self.chips:
            return
        point_px = renderer.points_to_pixels(1.0)
        low, high = self.ax.bbox.get_points()
        occupied = self._occupied(point_px)
        legend = self.ax.get_legend()
        if legend is not None:
            occupied = np.vstack([occupied, legend.get_window_extent(renderer).extents])
        anchors = self.ax.transData.transform([chip.xy for chip in self.chips])
        leaders = []
        for chip, anchor in zip(self.chips, anchors, strict=True):
            is_inside = ((anchor >= low) & (anchor <= high)).all()
            chip.set_visible(bool(is_inside))
            if not is_inside:
                continue
            bounds = chip.get_window_extent(renderer)
            half = np.array([bounds.width, bounds.height]) / 2 + (_PADDING_PT + 0.5) * point_px
            distances = _DISTANCES_PT[:, None, None] * point_px
            offsets = distances * _DIRECTIONS + np.sign(_DIRECTIONS.round(6)) * half
            centers = anchor + offsets.reshape(-1, 2)
            corners_low = centers - half
            corners_high = centers + half
            candidates = np.column_stack([corners_low, corners_high])
            fits = ((corners_low >= low) & (corners_high <= high)).all(axis=1)
            free = np.flatnonzero(fits & ~_overlaps(candidates, occupied))
            chip.set_visible(len(free) > 0)
            if not len(free):
                continue
            best = int(free[0])
            chip.set_position(tuple((centers[best] - anchor) / point_px))
            occupied = np.vstack([occupied, candidates[best]])
            distance = _DISTANCES_PT[best // len(_DIRECTIONS)]
            if distance >= _MIN_LEADER_DISTANCE_PT:
                nearest_point = np.clip(anchor, corners_low[best], corners_high[best])
                leaders.append([anchor, nearest_point])
        lines = LineCollection(
            leaders, colors=MUTED_COLOR, linewidths=0.6, transform=IdentityTransform()
        )
        lines.set_figure(self.ax.figure)
        lines.draw(renderer)

    def _occupied(self, point_px: float) -> FloatArray:
        """Return the rectangles around the shapes and their margins, shape (N, 4), pixels.

        `point_px` is the number of pixels in a point.
        """
        if not self.shapes:
            return np.zeros((0, 4))
        corners = np.concatenate(self.shapes).reshape(-1, 2)
        pixels = self.ax.transData.transform(corners).reshape(-1, 2, 2)
        rectangles = np.column_stack([pixels.min(axis=1), pixels.max(axis=1)])
        margins = np.concatenate(self.margins)
        return rectangles + margins * point_px


def _overlaps(rectangles: FloatArray, obstacles: FloatArray) -> Any:
    """Return whether each rectangle (N, 4) covers any of the obstacles (M, 4), shape (N,)."""
    low = rectangles[:, None, :2]
    high = rectangles[:, None, 2:]
    is_beyond = (low >= obstacles[:, 2:]) | (high <= obstacles[:, :2])
    is_apart = is_beyond.any(axis=-1)
    return (~is_apart).any(axis=-1)


def _placer(ax: Axes) -> _Placer:
    """Return the placer of the axes; make one if they have none yet."""
    artist_class = _placer_artist_class()
    for artist in ax.artists:
        if isinstance(artist, artist_class):
            existing: _Placer = artist.placer
            return existing
    placer = _Placer(ax)
    ax.add_artist(artist_class(placer))
    return placer


@cache
def _placer_artist_class() -> Any:
    from matplotlib.artist import Artist

    class ChipPlacer(Artist):
        """An invisible artist that places the chips when the axes are rendered, before them."""

        def __init__(self, placer: _Placer) -> None:
            super().__init__()
            self.placer = placer
            self.set(zorder=5.9, in_layout=False)

        def draw(self, renderer: Any) -> None:
            self.placer.place_all(renderer)

    return ChipPlacer
