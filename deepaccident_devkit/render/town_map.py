"""Pictures of a town's map: alone, in pale colours beneath what is seen from above, and as a replay's road."""

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
from deepaccident_devkit.render.figures import axes_or_new, axis_words
from deepaccident_devkit.render.ground import draw_ground
from deepaccident_devkit.render.styles import BEV_COLORS, MAP_COLORS, MUTED_COLOR, in_own_settings
from deepaccident_devkit.support.arrays import ByteArray, FloatArray
from deepaccident_devkit.support.text import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Cells along a side, about; of a larger part every second, third, … is drawn.
_MOST_CELLS: Final = 800


@in_own_settings
def render_town_map(dataset: Dataset, town: str, *, ax: Axes | None = None) -> Axes:
    """Render the map of a town, which is made if none is kept: roads, their lines, sidewalks and other ground.

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
    """Render a map as far as it reaches, in metres of the world, with a title and a legend."""
    from matplotlib.patches import Patch

    left, right, bottom, top = drawn.extent
    x_words, y_words = axis_words("world")
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel=x_words, ylabel=y_words)
    draw_town_map(drawn, ax, target_from_world=SE3.identity(), colors=MAP_COLORS)
    handles = [
        Patch(facecolor=color, edgecolor=MUTED_COLOR, linewidth=0.5, label=name.replace("_", " "))
        for name, color in MAP_COLORS.items()
    ]
    draw_legend(ax, handles, loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=4.5)
    ax.set_title(
        f"{drawn.town}: {drawn.looks:,} pictures of {counted(drawn.scenarios, 'scenario')}"
    )
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


def draw_town_map(
    drawn: TownMap, ax: Axes, *, target_from_world: SE3, colors: Mapping[str, str] = BEV_COLORS
) -> None:
    """Render the part of a map that axes show, whose limits stay; what has no colour, or was not seen, is white."""
    part = _shown(drawn, (ax.get_xlim(), ax.get_ylim()), target_from_world)
    if not part.agents.size:
        return
    step = max(1, max(part.shape) // _MOST_CELLS)
    rows, columns = (size // step * step for size in part.shape)
    cells = part.classes()[step // 2 : rows : step, step // 2 : columns : step]
    (left, bottom), reach = part.origin.tolist(), part.resolution
    extent = (left, left + columns * reach, bottom, bottom + rows * reach)
    numbers = {name: number for number, name in enumerate(GROUND_CLASSES, 1)}
    draw_ground(
        cells, numbers, ax, extent=extent, placed=target_from_world, zorder=-1, colors=colors
    )


def ground_at(drawn: TownMap, points: FloatArray, names: Sequence[str]) -> ByteArray:
    """(N,) uint8: 1 + the position in names of what lies at points (N, 2), x and y in world; 0 for anything else."""
    numbers = np.array(
        [0, *(1 + names.index(name) if name in names else 0 for name in GROUND_CLASSES)]
    )
    return numbers.astype(np.uint8)[drawn.classes_at(points)]


def _shown(
    drawn: TownMap, limits: tuple[tuple[float, float], ...], target_from_world: SE3
) -> TownMap:
    """The part of a map around what the limits of axes show, however they are turned."""
    middle = np.array([np.mean(each) for each in limits])
    reach = float(np.hypot(*(np.diff(each)[0] for each in limits)) / 2)
    center = target_from_world.inverse().apply(
        np.array([[*middle, target_from_world.translation[2]]])
    )[0, :2]
    return drawn.around(center, reach)
