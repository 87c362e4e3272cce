"""A town's map: as a separate picture, beneath views from above, and as the road of a replay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.maps.counting import GROUND_CLASSES
from deepaccident_devkit.maps.making import kept_town_map, town_map
from deepaccident_devkit.maps.town_map import TownMap
from deepaccident_devkit.render.captions import draw_legend_outside, is_callers
from deepaccident_devkit.render.figures import axes_or_new, label_axes
from deepaccident_devkit.render.ground import draw_ground
from deepaccident_devkit.render.styles import BEV_COLORS, MAP_COLORS, MUTED_COLOR, in_own_settings
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.support.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Approximate number of cells to draw along a side. In a larger part of a map, only every second,
# third, … cell is drawn.
_MAX_SIDE_CELLS = 800


@in_own_settings
def render_town_map(dataset: Dataset, town: str, *, ax: Axes | None = None) -> Axes:
    """Render the map of a town: roads, their lines, sidewalks and other ground.

    The map is made if none is stored.

    Args:
        dataset: The release.
        town: Name, such as `Town03`.
        ax: Axes to render on, new ones if None. In a figure of your own, the title is yours.

    Returns:
        The axes, in metres in the world frame.

    Raises:
        ChoiceError: The release has no recording in this town.
        NotAvailableError: No file of a BEV camera in this town can be read.
    """
    map_ = town_map(dataset, town)
    ax = axes_or_new(ax, (7, 7))
    return draw_whole_map(map_, ax)


@in_own_settings
def draw_whole_map(map_: TownMap, ax: Axes) -> Axes:
    """Render a map up to its borders, in metres in the world frame, with a title and a legend."""
    from matplotlib.patches import Patch

    left, right, bottom, top = map_.extent
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    label_axes(ax, "world")
    draw_town_map(map_, ax, target_from_world=SE3.identity(), colors=MAP_COLORS)
    handles = []
    for name, color in MAP_COLORS.items():
        label = name.replace("_", " ")
        handles.append(Patch(facecolor=color, edgecolor=MUTED_COLOR, linewidth=0.5, label=label))
    draw_legend_outside(ax, handles)
    scenarios = counted(map_.scenarios, "scenario")
    if not is_callers(ax):
        ax.set_title(f"{map_.town}: {map_.looks:,} pictures of {scenarios}")
    return ax


def map_beneath(dataset: Dataset, scenario: str, *, make: bool) -> TownMap | None:
    """Return the stored map of a scenario's town, without checking the files it was made from.

    If no map is stored, one is made if `make` is true. The result is None if there is still none.

    Args:
        dataset: The release.
        scenario: Token of the scenario.
        make: Whether to make a map if none is stored.
    """
    town = dataset.get("scenario", scenario)["town"]
    stored_map = kept_town_map(dataset, town)
    if stored_map is not None or not make:
        return stored_map
    try:
        return town_map(dataset, town)
    except NotAvailableError:
        return None


def draw_town_map(
    map_: TownMap, ax: Axes, *, target_from_world: SE3, colors: Mapping[str, str] = BEV_COLORS
) -> None:
    """Render the part of a map that is within the axes' limits, without changing the limits.

    Cells are white if no BEV image covers them, or if their class has no colour.
    """
    x_limits = ax.get_xlim()
    y_limits = ax.get_ylim()
    axes_center = [np.mean(x_limits), np.mean(y_limits), target_from_world.translation[2]]
    world_center = target_from_world.inverse().apply(np.array([axes_center]))[0, :2]
    diagonal = np.hypot(np.diff(x_limits)[0], np.diff(y_limits)[0])
    visible_map = map_.around(world_center, float(diagonal / 2))
    if not visible_map.agents.size:
        return
    step = max(1, max(visible_map.shape) // _MAX_SIDE_CELLS)
    num_rows, num_columns = (side // step * step for side in visible_map.shape)
    first = step // 2
    cells = visible_map.classes()[first:num_rows:step, first:num_columns:step]
    left, bottom = visible_map.origin.tolist()
    right = left + num_columns * visible_map.resolution
    top = bottom + num_rows * visible_map.resolution
    class_numbers = {name: number for number, name in enumerate(GROUND_CLASSES, 1)}
    draw_ground(
        cells,
        class_numbers,
        ax,
        extent=(left, right, bottom, top),
        target_from_cells=target_from_world,
        zorder=-1,
        colors=colors,
    )


def ground_at(map_: TownMap, points: FloatArray, names: Sequence[str]) -> ByteArray:
    """Look up the ground class at points (N, 2: x, y) in world, metres; returns (N,) uint8.

    A value is 1 + the index of the class in `names`, or 0 for any other class.
    """
    numbers = np.zeros(1 + len(GROUND_CLASSES), dtype=np.uint8)
    for code, name in enumerate(GROUND_CLASSES, 1):
        if name in names:
            numbers[code] = 1 + names.index(name)
    return numbers[map_.classes_at(points)]
