"""The ground beneath a view from above, in pale colours: a town map or a BEV camera's picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.styles import BEV_COLORS
from deepaccident_devkit.support.arrays import ByteArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Approximate number of pixels along a side of a BEV picture; more take time, and panels of a video
# have fewer.
_MAX_SIDE_PX = 400


def draw_underlay(
    image: BevImage,
    ax: Axes,
    *,
    target_from_ego: SE3,
    view_range: float,
    colors: Mapping[str, str] = BEV_COLORS,
) -> None:
    """Render a BEV camera's semantic tags in the frame of the axes, in metres.

    Args:
        image: Picture of an agent.
        ax: Axes to render on; its limits stay as they are.
        target_from_ego: Pose of the agent's ego frame in the frame of the axes; its tilt is
            ignored.
        view_range: Metres shown to each side of the agent. If the picture is rotated, a larger
            square is drawn, so that it fills the corners.
        colors: Colour by name of a tag.
    """
    yaw = target_from_ego.yaw
    turned_range = view_range * (abs(np.cos(yaw)) + abs(np.sin(yaw)))
    middle = len(image.semantic) // 2
    half = min(middle, int(np.ceil(turned_range / image.resolution)))
    shown = slice(middle - half, middle + half)
    # Rows of cells are along y, left, and columns along x, forward.
    tags = image.semantic[::-1, ::-1].T[shown, shown]
    step = max(1, len(tags) // _MAX_SIDE_PX)
    start = step // 2
    cells = tags[start::step, start::step]
    reach = half * image.resolution
    draw_ground(
        cells,
        TAGS,
        ax,
        extent=(-reach, reach, -reach, reach),
        target_from_cells=target_from_ego,
        zorder=-0.5,  # beneath the cells of labels, above a town map
        colors=colors,
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
    """Render ground cells in the colours of their classes, without changing the axes' limits.

    Classes without a colour are white.

    Args:
        cells: Class numbers, shape (H, W), lowest row first.
        numbers: Class number by class name.
        ax: Axes to render on.
        extent: Left, right, bottom and top of the cells, metres, in their own frame.
        target_from_cells: Pose of the cells' frame in the frame of the axes.
        zorder: Drawing order of the cells, as in matplotlib.
        colors: Colour by class name; pale ones by default.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.transforms import Affine2D

    rgb_of_numbers = np.full((256, 3), 255, dtype=np.uint8)
    for name in numbers.keys() & colors.keys():
        rgb = np.array(to_rgb(colors[name]))
        rgb_of_numbers[numbers[name]] = np.rint(rgb * 255)
    x_limits = ax.get_xlim()
    y_limits = ax.get_ylim()
    x, y, _ = target_from_cells.translation
    pose = Affine2D().rotate(target_from_cells.yaw).translate(x, y)
    ax.imshow(
        rgb_of_numbers[cells],
        extent=extent,
        transform=pose + ax.transData,
        origin="lower",
        interpolation="nearest",
        zorder=zorder,
    )
    ax.set(xlim=x_limits, ylim=y_limits)
