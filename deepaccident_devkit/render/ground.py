"""The ground beneath what is seen from above, in pale colours: a town's map, or what a BEV camera saw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.support.arrays import ByteArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Pixels of a BEV camera along a side, about: panels of a video have fewer, and more take time.
_MOST_PIXELS: Final = 400


def draw_underlay(image: BevImage, ax: Axes, *, target_from_ego: SE3, view_range: float) -> None:
    """Render a BEV camera's tags at their places in the frame of the axes, metres, up to `view_range` to each side.

    Args:
        image: of an agent.
        ax: axes to render on; its limits stay as they are.
        target_from_ego: from the agent's ego frame into the frame of the axes; its tilt is left out.
        view_range: metres around the agent; of a turned picture a larger square is taken, so that it fills the corners.
    """
    yaw, size = _yaw(target_from_ego), len(image.semantic)
    half = min(
        size // 2,
        int(np.ceil(view_range * (abs(np.cos(yaw)) + abs(np.sin(yaw))) / image.resolution)),
    )
    shown = slice(size // 2 - half, size // 2 + half)
    tags = image.semantic[::-1, ::-1].T[shown, shown]
    step = max(1, len(tags) // _MOST_PIXELS)
    reach = half * image.resolution
    extent = (-reach, reach, -reach, reach)
    draw_ground(
        tags[step // 2 :: step, step // 2 :: step],
        TAGS,
        ax,
        extent=extent,
        placed=target_from_ego,
        zorder=0,
    )


def draw_ground(
    cells: ByteArray,
    numbers: Mapping[str, int],
    ax: Axes,
    *,
    extent: tuple[float, float, float, float],
    placed: SE3,
    zorder: float,
    colors: Mapping[str, str] = BEV_COLORS,
) -> None:
    """Render numbers (H, W) in the colours of their names, white without one; the limits of the axes stay.

    Args:
        cells: the lowest row first.
        numbers: what lies there → its number.
        ax: axes to render on.
        extent: left, right, bottom and top of the cells, metres, before they are placed.
        placed: into the frame of the axes.
        zorder: of the picture.
        colors: what lies there → its colour; pale ones by default.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.transforms import Affine2D

    table = np.full((256, 3), 255, dtype=np.uint8)
    for name in numbers.keys() & colors.keys():
        table[numbers[name]] = np.rint(np.array(to_rgb(colors[name])) * 255)
    limits = ax.get_xlim(), ax.get_ylim()
    place = Affine2D().rotate(_yaw(placed)).translate(*placed.translation[:2]) + ax.transData
    how: Any = {"origin": "lower", "interpolation": "nearest", "zorder": zorder}
    ax.imshow(table[cells], extent=extent, transform=place, **how)
    ax.set(xlim=limits[0], ylim=limits[1])


def _yaw(placed: SE3) -> float:
    return float(np.arctan2(placed.rotation[1, 0], placed.rotation[0, 0]))
