"""What the BEV camera saw, muted, as the ground of a picture from above."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import ByteArray
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.bev_camera import TAGS
from deepaccident_devkit.render.colors import BEV_COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_PIXELS: Final = 400
"""Along a side, in round numbers: panels of a video have less, and more takes time."""


def draw_underlay(image: BevImage, ax: Axes, *, target_from_ego: SE3, view_range: float) -> None:
    """Draw a BEV camera's tags at their places in the frame of the axes, metres, up to `view_range` to each side.

    Args:
        image: of an agent.
        ax: axes to draw on; its limits stay as they are.
        target_from_ego: from the agent's ego frame into the frame of the axes; its tilt is left out.
        view_range: metres about the agent; a turned picture is cut to a square that the corners reach.
    """
    from matplotlib.transforms import Affine2D

    yaw = float(np.arctan2(target_from_ego.rotation[1, 0], target_from_ego.rotation[0, 0]))
    place = Affine2D().rotate(yaw).translate(*target_from_ego.translation[:2])
    size = len(image.semantic)
    half = min(size // 2, int(np.ceil(view_range * (abs(np.cos(yaw)) + abs(np.sin(yaw))) / image.resolution)))
    shown = slice(size // 2 - half, size // 2 + half)
    tags = image.semantic[::-1, ::-1].T[shown, shown]
    step = max(1, len(tags) // _MOST_PIXELS)
    reach = half * image.resolution
    limits = ax.get_xlim(), ax.get_ylim()
    ax.imshow(
        _colored(tags[step // 2 :: step, step // 2 :: step]),
        origin="lower",
        extent=(-reach, reach, -reach, reach),
        transform=place + ax.transData,
        interpolation="nearest",
        zorder=0,
    )
    ax.set(xlim=limits[0], ylim=limits[1])


def _colored(tags: ByteArray) -> ByteArray:
    """CARLA's tags (H, W) as RGB (H, W, 3), white where a tag has no colour."""
    from matplotlib.colors import to_rgb

    table = np.full((256, 3), 255, dtype=np.uint8)
    for name, color in BEV_COLORS.items():
        table[TAGS[name]] = np.rint(np.array(to_rgb(color)) * 255)
    return table[tags]
