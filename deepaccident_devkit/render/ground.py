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
# Number of possible class numbers of cells.
_NUM_CLASSES = 256


def draw_underlay(
    image: BevImage,
    ax: Axes,
    *,
    target_from_ego: SE3,
    colors: Mapping[str, str] = BEV_COLORS,
) -> None:
    """Render the visible part of a BEV camera's semantic tags, in the frame of the axes, in metres.

    Args:
        image: Picture of an agent.
        ax: Axes to render on; its limits stay as they are.
        target_from_ego: Pose of the agent's ego frame in the frame of the axes; its tilt is
            ignored.
        colors: Colour by name of a tag.
    """
    # Rows of cells are along y, left, and columns along x, forward.
    tags = image.semantic[::-1, ::-1].T
    middle = len(tags) // 2
    flat_pose = SE3.from_yaw(target_from_ego.yaw, target_from_ego.translation)
    view_corners = np.column_stack([ax.viewLim.corners(), np.zeros(4)])
    corners = flat_pose.inverse().apply(view_corners)[:, :2] / image.resolution + middle
    first = np.floor(corners.min(axis=0)).clip(0, len(tags)).astype(int)
    end = np.ceil(corners.max(axis=0)).clip(0, len(tags)).astype(int)
    step = max(1, int((end - first).max()) // _MAX_SIDE_PX)
    # Each block of cells is drawn as the one in its middle.
    x_slice, y_slice = map(slice, first + step // 2, end + step, (step, step))
    cells = tags[y_slice, x_slice]
    if not cells.size:
        return
    left, bottom = (first - middle) * image.resolution
    height, width = step * image.resolution * np.array(cells.shape)
    draw_ground(
        cells,
        TAGS,
        ax,
        extent=(left, left + width, bottom, bottom + height),
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
    from matplotlib.colors import ListedColormap
    from matplotlib.transforms import Affine2D

    palette = ["white"] * _NUM_CLASSES
    for name in numbers.keys() & colors.keys():
        palette[numbers[name]] = colors[name]
    x_limits = ax.get_xlim()
    y_limits = ax.get_ylim()
    x, y, _ = target_from_cells.translation
    pose = Affine2D().rotate(target_from_cells.yaw).translate(x, y)
    ax.imshow(
        cells,
        cmap=ListedColormap(palette),
        vmin=-0.5,
        vmax=_NUM_CLASSES - 0.5,
        extent=extent,
        transform=pose + ax.transData,
        origin="lower",
        interpolation="nearest",
        interpolation_stage="data",  # an image of colours takes three times as long
        zorder=zorder,
    )
    ax.set(xlim=x_limits, ylim=y_limits)
