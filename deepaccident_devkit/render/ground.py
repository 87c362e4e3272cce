"""The ground beneath a view from above, in pale colours: a town map or a BEV camera's picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.support.arrays import ByteArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Pixels of a BEV camera along a side, about: panels of a video have fewer, and more take time.
_MAX_SIDE_PX: Final = 400


def draw_underlay(image: BevImage, ax: Axes, *, target_from_ego: SE3, view_range: float) -> None:
    """Render a BEV camera's tags in the frame of the axes, metres, up to a range to each side.

    Args:
        image: Picture of an agent.
        ax: Axes to render on; its limits stay as they are.
        target_from_ego: Pose of the agent's ego frame in the frame of the axes; its tilt is left
            out.
        view_range: Metres around the agent; for a turned picture the square is larger, so that it
            fills the corners.
    """
    yaw, size = _yaw(target_from_ego), len(image.semantic)
    turned_range = view_range * (abs(np.cos(yaw)) + abs(np.sin(yaw)))
    half = min(size // 2, int(np.ceil(turned_range / image.resolution)))
    part = slice(size // 2 - half, size // 2 + half)
    tags = image.semantic[::-1, ::-1].T[part, part]
    step = max(1, len(tags) // _MAX_SIDE_PX)
    cells = tags[step // 2 :: step, step // 2 :: step]
    reach = half * image.resolution
    draw_ground(
        cells,
        TAGS,
        ax,
        extent=(-reach, reach, -reach, reach),
        target_from_cells=target_from_ego,
        zorder=0,
    )


def draw_ground(
    cells: ByteArray,
    numbers: Mapping[str, int],
    ax: Axes,
    *,
    extent: tuple[float, float, float, float],
    target_from_cells: SE3,
    zorder: float,
    colors: Mapping[str, str] = BEV_COLORS,
) -> None:
    """Render class numbers (H, W) in the colours of their names; the limits of the axes stay.

    Numbers without a colour are white.

    Args:
        cells: Class numbers, shape (H, W), lowest row first.
        numbers: Name of a class → its number.
        ax: Axes to render on.
        extent: Left, right, bottom and top of the cells, metres, in their own frame.
        target_from_cells: Pose of the cells' frame in the frame of the axes.
        zorder: Order of the picture.
        colors: Name of a class → its colour; pale ones by default.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.transforms import Affine2D

    table = np.full((256, 3), 255, dtype=np.uint8)
    for name in numbers.keys() & colors.keys():
        table[numbers[name]] = np.rint(np.array(to_rgb(colors[name])) * 255)
    x_limits, y_limits = ax.get_xlim(), ax.get_ylim()
    pose = Affine2D().rotate(_yaw(target_from_cells)).translate(*target_from_cells.translation[:2])
    ax.imshow(
        table[cells],
        extent=extent,
        transform=pose + ax.transData,
        origin="lower",
        interpolation="nearest",
        zorder=zorder,
    )
    ax.set(xlim=x_limits, ylim=y_limits)


def _yaw(pose: SE3) -> float:
    return float(np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0]))
