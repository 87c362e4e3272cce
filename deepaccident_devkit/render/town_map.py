"""A town's map: in a picture of its own, beneath views from above, and as a replay's road."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.maps.counting import GROUND_CLASSES
from deepaccident_devkit.maps.making import kept_town_map, town_map
from deepaccident_devkit.maps.town_map import TownMap
from deepaccident_devkit.render.captions import draw_legend
from deepaccident_devkit.render.figures import axes_or_new, label_axes
from deepaccident_devkit.render.ground import draw_ground
from deepaccident_devkit.render.styles import BEV_COLORS, MAP_COLORS, MUTED_COLOR, in_own_settings
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.support.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Cells along a side, about; in a larger part every second, third, … cell is drawn.
_MAX_SIDE_CELLS: Final = 800


@in_own_settings
def render_town_map(dataset: Dataset, town: str, *, ax: Axes | None = None) -> Axes:
    """Render the map of a town: roads, their lines, sidewalks and other ground.

    The map is made if none is stored.

    Args:
        dataset: The release.
        town: Name, such as `Town03`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres of the world.

    Raises:
        ChoiceError: The release has no recording in this town.
        NotAvailableError: The town has no readable file of a BEV camera.
    """
    return draw_whole_map(town_map(dataset, town), axes_or_new(ax, (7, 7)))


@in_own_settings
def draw_whole_map(map_: TownMap, ax: Axes) -> Axes:
    """Render a map up to its borders, in metres of the world, with a title and a legend."""
    from matplotlib.patches import Patch

    left, right, bottom, top = map_.extent
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    label_axes(ax, "world")
    draw_town_map(map_, ax, target_from_world=SE3.identity(), colors=MAP_COLORS)
    handles = []
    for name, color in MAP_COLORS.items():
        label = name.replace("_", " ")
        handles.append(Patch(facecolor=color, edgecolor=MUTED_COLOR, linewidth=0.5, label=label))
    draw_legend(ax, handles, loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=4.5)
    scenarios = counted(map_.scenarios, "scenario")
    ax.set_title(f"{map_.town}: {map_.looks:,} pictures of {scenarios}")
    return ax


def map_beneath(dataset: Dataset, scenario: str, *, make: bool) -> TownMap | None:
    """Return the stored map of the town of a scenario (a token), without checking its files.

    If none is stored, `make` requests a new one. None if there is no map: none is stored and none
    requested, or there is no file to make it from.
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
    """Render the part of a map within the limits of axes, which stay.

    Cells without a colour, or that were not seen, are white.
    """
    part = _shown_part(map_, (ax.get_xlim(), ax.get_ylim()), target_from_world)
    if not part.agents.size:
        return
    step = max(1, max(part.shape) // _MAX_SIDE_CELLS)
    rows, columns = (size // step * step for size in part.shape)
    cells = part.classes()[step // 2 : rows : step, step // 2 : columns : step]
    (left, bottom), cell_size = part.origin.tolist(), part.resolution
    extent = (left, left + columns * cell_size, bottom, bottom + rows * cell_size)
    numbers = {name: number for number, name in enumerate(GROUND_CLASSES, 1)}
    draw_ground(
        cells,
        numbers,
        ax,
        extent=extent,
        target_from_cells=target_from_world,
        zorder=-1,
        colors=colors,
    )


def ground_at(map_: TownMap, points: FloatArray, names: Sequence[str]) -> ByteArray:
    """Return the ground at points (N, 2), x and y in world, as (N,) uint8.

    It is 1 + the position of its class in `names`; 0 for anything else.
    """
    numbers = [0]
    for name in GROUND_CLASSES:
        numbers.append(1 + names.index(name) if name in names else 0)
    return np.array(numbers).astype(np.uint8)[map_.classes_at(points)]


def _shown_part(
    map_: TownMap, limits: tuple[tuple[float, float], ...], target_from_world: SE3
) -> TownMap:
    """Return the part of a map around the limits of axes, however they are turned."""
    middle = np.array([np.mean(limit) for limit in limits])
    lengths = [np.diff(limit)[0] for limit in limits]
    reach = float(np.hypot(*lengths) / 2)
    point = np.array([[*middle, target_from_world.translation[2]]])
    center = target_from_world.inverse().apply(point)[0, :2]
    return map_.around(center, reach)
