"""The ground beneath what is seen from above, in pale colours: a town's map, or what a BEV camera saw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.maps import GROUND_CLASSES, TownMap, kept_town_map, town_map
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.figures import axes_or_new, axis_words
from deepaccident_devkit.render.styles import BEV_COLORS, in_own_settings
from deepaccident_devkit.support.arrays import ByteArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_PIXELS: Final = 400
"""Pixels of a BEV camera along a side, about: panels of a video have fewer, and more take time."""
_MOST_CELLS: Final = 800
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
    x_words, y_words = axis_words("world")
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel=x_words, ylabel=y_words)
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
    part = _shown(drawn, (ax.get_xlim(), ax.get_ylim()), target_from_world)
    if not part.agents.size:
        return
    step = max(1, max(part.shape) // _MOST_CELLS)
    rows, columns = (size // step * step for size in part.shape)
    cells = part.classes()[step // 2 : rows : step, step // 2 : columns : step]
    (left, bottom), reach = part.origin.tolist(), part.resolution
    extent = (left, left + columns * reach, bottom, bottom + rows * reach)
    numbers = {name: number for number, name in enumerate(GROUND_CLASSES, 1)}
    _draw_ground(cells, numbers, ax, extent=extent, placed=target_from_world, zorder=-1)


def draw_underlay(image: BevImage, ax: Axes, *, target_from_ego: SE3, view_range: float) -> None:
    """Render a BEV camera's tags at their places in the frame of the axes, metres, up to `view_range` to each side.

    Args:
        image: of an agent.
        ax: axes to render on; its limits stay as they are.
        target_from_ego: from the agent's ego frame into the frame of the axes; its tilt is left out.
        view_range: metres around the agent; of a turned picture a larger square is taken, so that it fills the corners.
    """
    yaw, size = _yaw(target_from_ego), len(image.semantic)
    half = min(size // 2, int(np.ceil(view_range * (abs(np.cos(yaw)) + abs(np.sin(yaw))) / image.resolution)))
    shown = slice(size // 2 - half, size // 2 + half)
    tags = image.semantic[::-1, ::-1].T[shown, shown]
    step = max(1, len(tags) // _MOST_PIXELS)
    reach = half * image.resolution
    extent = (-reach, reach, -reach, reach)
    _draw_ground(tags[step // 2 :: step, step // 2 :: step], TAGS, ax, extent=extent, placed=target_from_ego, zorder=0)


def _draw_ground(
    cells: ByteArray,
    numbers: Mapping[str, int],
    ax: Axes,
    *,
    extent: tuple[float, float, float, float],
    placed: SE3,
    zorder: float,
) -> None:
    """Render numbers (H, W) in the pale colours of their names, white without one; the limits of the axes stay.

    Args:
        cells: the lowest row first.
        numbers: what lies there → its number; those of `BEV_COLORS` alone have a colour.
        ax: axes to render on.
        extent: left, right, bottom and top of the cells, metres, before they are placed.
        placed: into the frame of the axes.
        zorder: of the picture.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.transforms import Affine2D

    table = np.full((256, 3), 255, dtype=np.uint8)
    for name in numbers.keys() & BEV_COLORS.keys():
        table[numbers[name]] = np.rint(np.array(to_rgb(BEV_COLORS[name])) * 255)
    limits = ax.get_xlim(), ax.get_ylim()
    place = Affine2D().rotate(_yaw(placed)).translate(*placed.translation[:2]) + ax.transData
    how: Any = {"origin": "lower", "interpolation": "nearest", "zorder": zorder}
    ax.imshow(table[cells], extent=extent, transform=place, **how)
    ax.set(xlim=limits[0], ylim=limits[1])


def _yaw(placed: SE3) -> float:
    return float(np.arctan2(placed.rotation[1, 0], placed.rotation[0, 0]))


def _shown(drawn: TownMap, limits: tuple[tuple[float, float], ...], target_from_world: SE3) -> TownMap:
    """The part of a map around what the limits of axes show, however they are turned."""
    middle = np.array([np.mean(each) for each in limits])
    reach = float(np.hypot(*(np.diff(each)[0] for each in limits)) / 2)
    height = target_from_world.translation[2]
    center: FloatArray = target_from_world.inverse().apply(np.array([[*middle, height]]))[0, :2]
    return drawn.around(center, reach)
