"""Words on white chips, which cover neither each other nor the things that they name."""

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
_PADDING_PT: Final = 1.5
# Points from an anchor to its chip, the nearest first.
_DISTANCES_PT: Final = np.array([2.0, 5.0, 9.0, 14.0, 20.0, 28.0, 38.0, 50.0, 65.0, 85.0, 110.0])
# Points from an anchor above which a line leads to its chip.
_MIN_LEADER_DISTANCE_PT: Final = 16.0
_ANGLES_RAD: Final = np.radians([60, 120, 0, 180, -60, -120, 90, -90, 30, 150, -30, -150])
# Directions from an anchor to its chip, the best first.
_DIRECTIONS: Final = np.column_stack([np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)])


def place_chips(
    ax: Axes,
    chips: Iterable[tuple[str, Sequence[float]]],
    *,
    colors: Sequence[str] | None = None,
    avoid: ArrayLike | None = None,
) -> None:
    """Write words near anchors (x, y) in data coordinates, dark on white chips.

    Nothing of importance is covered. The chips get their positions when the figure is rendered, so
    they fit its final size; a thin line leads to a distant chip. A chip is left out if its anchor
    is not shown, or if there is no space for it: begin with the important ones. Several calls on
    the same axes know of each other.

    Args:
        ax: Axes to write on.
        chips: Words and anchors.
        colors: Colours of the edges, grey by default.
        avoid: Shapes to avoid, as in `keep_free`.
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
    """Prevent chips from covering shapes (N, corners, 2) in data coordinates and their margin.

    The margin is points added to a shape's left, low, right and high side: to the left and down
    they are negative.
    """
    corners = np.asarray(shapes, dtype=np.float64)
    if not corners.size:
        return
    placer = _placer(ax)
    bounds = [corners.min(axis=1), corners.max(axis=1)]
    placer.shapes.append(np.stack(bounds, axis=1))
    placer.margins.append(np.tile(margin, (len(corners), 1)))


@dataclass(slots=True, eq=False)
class _Placer:
    """The chips of axes, and the upright rectangles that they must not cover.

    Attributes:
        ax: Axes.
        chips: Chips in order of importance.
        shapes: Corners of rectangles, shape (N, 2, 2), data coordinates.
        margins: Margins of rectangles, shape (N, 4), points.
    """

    ax: Axes
    chips: list[Annotation] = field(default_factory=list)
    shapes: list[FloatArray] = field(default_factory=list)
    margins: list[FloatArray] = field(default_factory=list)

    def place_all(self, renderer: Any) -> None:
        """Move the chips, and render the lines that lead to them.

        Rectangles are pixels (left, low, right, high).
        """
        if not self.chips:
            return
        point_px = renderer.points_to_pixels(1.0)
        area, occupied = np.array(self.ax.bbox.extents), self._occupied(point_px)
        anchors = self.ax.transData.transform([chip.xy for chip in self.chips])
        leaders = []
        for chip, anchor in zip(self.chips, anchors, strict=True):
            is_inside = (anchor >= area[:2]).all() and (anchor <= area[2:]).all()
            chip.set_visible(bool(is_inside))
            if not chip.get_visible():
                continue
            bounds = chip.get_window_extent(renderer)
            half = np.array([bounds.width, bounds.height]) / 2 + (_PADDING_PT + 0.5) * point_px
            distances = _DISTANCES_PT[:, None, None] * point_px
            offsets = distances * _DIRECTIONS + np.sign(_DIRECTIONS.round(6)) * half
            centers = anchor + offsets.reshape(-1, 2)
            candidates = np.column_stack([centers - half, centers + half])
            fits_low = (candidates[:, :2] >= area[:2]).all(axis=1)
            fits_high = (candidates[:, 2:] <= area[2:]).all(axis=1)
            free = np.flatnonzero(fits_low & fits_high & ~_overlaps(candidates, occupied))
            chip.set_visible(len(free) > 0)
            if not len(free):
                continue
            best = int(free[0])
            rectangle = candidates[best]
            chip.set_position(tuple((centers[best] - anchor) / point_px))
            occupied = np.vstack([occupied, rectangle])
            if _DISTANCES_PT[best // len(_DIRECTIONS)] >= _MIN_LEADER_DISTANCE_PT:
                leaders.append([anchor, np.clip(anchor, rectangle[:2], rectangle[2:])])
        self._draw_leaders(leaders, renderer)

    def _occupied(self, point_px: float) -> FloatArray:
        """Return the rectangles of the shapes, shape (N, 4), pixels.

        A point has `point_px` pixels.
        """
        if not self.shapes:
            return np.zeros((0, 4))
        corners = np.concatenate(self.shapes).reshape(-1, 2)
        pixels = self.ax.transData.transform(corners).reshape(-1, 2, 2)
        rectangles = np.column_stack([pixels.min(axis=1), pixels.max(axis=1)])
        return rectangles + np.concatenate(self.margins) * point_px

    def _draw_leaders(self, leaders: list[list[FloatArray]], renderer: Any) -> None:
        from matplotlib.collections import LineCollection
        from matplotlib.transforms import IdentityTransform

        lines = LineCollection(
            leaders, colors=MUTED_COLOR, linewidths=0.6, transform=IdentityTransform()
        )
        lines.set_figure(self.ax.figure)
        lines.draw(renderer)


def _overlaps(rectangles: FloatArray, obstacles: FloatArray) -> Any:
    """Return whether rectangles (N, 4) cover any of others (M, 4), shape (N,)."""
    apart = (rectangles[:, None, :2] >= obstacles[:, 2:]) | (
        rectangles[:, None, 2:] <= obstacles[:, :2]
    )
    return (~apart.any(axis=-1)).any(axis=-1)


def _placer(ax: Axes) -> _Placer:
    """Return the placer of axes, which works right before their chips are rendered."""
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
