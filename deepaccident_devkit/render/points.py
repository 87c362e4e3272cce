"""Drawing LiDAR points: from above, and in camera images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.render.colors import DEPTH_COLORMAP, POINT_COLOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection

DEPTH_RANGE: Final = (0.0, 50.0)
"""Metres from the camera between which the colours of depth go."""


def draw_points_from_above(
    xyz: FloatArray, ax: Axes, *, center: FloatArray, view_range: float, color: str = POINT_COLOR
) -> None:
    """Draw the points (P, 3) within a square of ±`view_range` metres about `center` (2,), all in one colour."""
    near = (np.abs(xyz[:, :2] - center) < view_range).all(axis=1)
    ax.scatter(xyz[near, 0], xyz[near, 1], s=0.6, c=color, linewidths=0, rasterized=True, zorder=1)


def draw_points_in_image(pixels: FloatArray, ax: Axes, *, size: float = 2.0, **colors: Any) -> PathCollection:
    """Draw points at pixels (P, 2) of an image.

    Args:
        pixels: as (u, v), those in the image alone.
        ax: axes to draw on, in pixels.
        size: of a point, in points².
        colors: `color`, one for all; or `c`, a number a point, with `cmap`, `vmin` and `vmax`.

    Returns:
        What was drawn, for a colour bar.
    """
    return ax.scatter(pixels[:, 0], pixels[:, 1], s=size, linewidths=0, rasterized=True, **colors)


def draw_depths(pixels: FloatArray, depth: FloatArray, ax: Axes) -> PathCollection:
    """Draw points of an image coloured by their depth (P,), metres; the far ones first."""
    order = np.argsort(-depth)
    low, high = DEPTH_RANGE
    return draw_points_in_image(pixels[order], ax, c=depth[order], cmap=DEPTH_COLORMAP, vmin=low, vmax=high)
