"""A town's map beneath what is seen from above, in pale colours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import ByteArray, FloatArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.maps import GROUND_CLASSES, TownMap, kept_town_map, town_map
from deepaccident_devkit.render.axes import axes_or_new, axis_words
from deepaccident_devkit.render.colors import BEV_COLORS
from deepaccident_devkit.render.styles import in_own_settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_PIXELS: Final = 800
"""Cells along a side, about; of a larger part every second, third, … is drawn."""


@in_own_settings
def render_town_map(dataset: Dataset, town: str, *, ax: Axes | None = None) -> Axes:
    """Render the map of a town, which is made if none is kept: roads, their lines and sidewalks, in pale colours.

    Args:
        dataset: the release.
        town: such as `Town03`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of the world.

    Raises:
        ChoiceError: the release has no recording in this town.
        NotAvailableError: the town has no readable file of a BEV camera.
    """
    return draw_whole_map(town_map(dataset, town), axes_or_new(ax, (7, 7)))


@in_own_settings
def draw_whole_map(drawn: TownMap, ax: Axes) -> Axes:
    """Render a map as far as it reaches, in metres of the world, with a title."""
    left, right, bottom, top = drawn.extent
    words = axis_words("world")
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel=words[0], ylabel=words[1])
    draw_town_map(drawn, ax, target_from_world=SE3.identity())
    ax.set_title(f"{drawn.town}: {drawn.looks:,} pictures of {drawn.scenarios} scenarios")
    return ax


def map_beneath(dataset: Dataset, scenario: str, *, make: bool) -> TownMap | None:
    """The kept map of the town of a scenario (a token), without a look at its files; or else a new one, if asked for.

    None if there is none: nothing is kept and nothing to be made, or no file to make it from.
    """
    town = dataset.get("scenario", scenario)["town"]
    kept = kept_town_map(dataset, town)
    if kept is not None or not make:
        return kept
    try:
        return town_map(dataset, town)
    except NotAvailableError:
        return None


def draw_town_map(drawn: TownMap, ax: Axes, *, target_from_world: SE3) -> None:
    """Render the part of a map that axes show, whose limits stay; what is no road or sidewalk is white.

    Args:
        drawn: the map.
        ax: axes to render on.
        target_from_world: from the world to the frame of the axes; its tilt is left out.
    """
    from matplotlib.transforms import Affine2D

    limits = ax.get_xlim(), ax.get_ylim()
    part = _shown(drawn, limits, target_from_world)
    if not part.agents.size:
        return
    step = max(1, max(part.shape) // _MOST_PIXELS)
    yaw = float(np.arctan2(target_from_world.rotation[1, 0], target_from_world.rotation[0, 0]))
    rows, columns = (size // step * step for size in part.shape)
    (left, bottom), reach = part.origin.tolist(), part.resolution
    ax.imshow(
        _colored(part.classes()[step // 2 : rows : step, step // 2 : columns : step]),
        origin="lower",
        extent=(left, left + columns * reach, bottom, bottom + rows * reach),
        transform=Affine2D().rotate(yaw).translate(*target_from_world.translation[:2]) + ax.transData,
        interpolation="nearest",
        zorder=-1,
    )
    ax.set(xlim=limits[0], ylim=limits[1])


def _shown(drawn: TownMap, limits: tuple[tuple[float, float], ...], target_from_world: SE3) -> TownMap:
    """The part of a map around what the limits of axes show, however they are turned."""
    middle = np.array([np.mean(each) for each in limits])
    reach = float(np.hypot(*(np.diff(each)[0] for each in limits)) / 2)
    height = target_from_world.translation[2]
    center: FloatArray = target_from_world.inverse().apply(np.array([[*middle, height]]))[0, :2]
    return drawn.around(center, reach)


def _colored(classes: ByteArray) -> ByteArray:
    """Classes (H, W) of a map as RGB (H, W, 3)."""
    from matplotlib.colors import to_rgb

    colors = ["#ffffff", *(BEV_COLORS.get(name, "#ffffff") for name in GROUND_CLASSES)]
    table = np.rint(np.array([to_rgb(color) for color in colors]) * 255).astype(np.uint8)
    result: ByteArray = table[classes]
    return result
