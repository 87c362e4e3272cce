"""LiDAR points of any agent in the image of any camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render.axes import axes_or_new
from deepaccident_devkit.render.camera import draw_image
from deepaccident_devkit.render.colors import AGENT_COLORS, DEPTH_COLORMAP, HEIGHT_COLORMAP
from deepaccident_devkit.render.legends import agent_handles, draw_legend
from deepaccident_devkit.render.points import DEPTH_RANGE, draw_points_in_image
from deepaccident_devkit.v2x import project_to_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from deepaccident_devkit.tables.records import SampleRecord

ColorBy = Literal["depth", "height", "agent"]
_HEIGHTS: Final = (-1.0, 6.0)
"""Metres above the origin of the camera's agent between which the colours of height go."""


def render_pointcloud_in_image(
    dataset: Dataset,
    camera: RowArgument,
    sample: RowArgument | None = None,
    *,
    color_by: ColorBy = "depth",
    ax: Axes | None = None,
) -> Axes:
    """Draw a camera's image and LiDAR points upon it, whatever may stand before them.

    Args:
        dataset: the release.
        camera: token or record of the image (sample data).
        sample: token or record: whose points, of any agent and moment of the scenario; by default the camera's own
            sample's, and of `color_by="agent"` those of all agents at its moment.
        color_by: `depth` along the camera's axis, up to 50 m; `height` above the ground that the camera's agent is on;
            or `agent`, a colour for each.
        ax: axes to draw on; new ones if None.

    Returns:
        The axes drawn on, in pixels.

    Raises:
        TokenError: no such sample or sensor file.
        ChoiceError: the sensor is no camera, the two are of two scenarios, or there is no such way to colour.
        MissingFileError: the image or a cloud was not downloaded.
    """
    if color_by not in get_args(ColorBy):
        raise ChoiceError(f"color_by: expected one of {', '.join(get_args(ColorBy))}, found {color_by!r}")
    record = dataset.get("sample_data", camera)
    own = dataset.sample.get(record["sample_token"])
    sources = [own if sample is None else dataset.sample[dataset.getind("sample", sample)]]
    if color_by == "agent" and sample is None:
        sources = dataset.samples_of(own["frame_token"])
    ax = axes_or_new(ax, (8, 5))
    draw_image(dataset, record, ax)
    if color_by == "agent":
        for source in sources:
            _draw_agent(dataset, source, record, ax)
        handles = agent_handles([source["agent"] for source in sources])
        draw_legend(ax, handles, columns=len(handles), loc="upper center", bbox_to_anchor=(0.5, 0))
    else:
        _draw_numbers(dataset, sources[0], record, color_by, ax)
    whose = sources[0]["token"] if len(sources) == 1 else "all agents"
    ax.set_title(f"{own['agent']}, {record['channel']}\nLiDAR of {whose}", fontsize="medium")
    return ax


def _draw_agent(dataset: Dataset, source: SampleRecord, camera: RowArgument, ax: Axes) -> None:
    cloud = dataset.load_point_cloud(source, "lidar")
    points = project_to_image(dataset, cloud, source, camera, colors=False)
    draw_points_in_image(points.pixels[points.mask], ax, color=AGENT_COLORS[source["agent"]])


def _draw_numbers(
    dataset: Dataset, source: SampleRecord, camera: RowArgument, color_by: Literal["depth", "height"], ax: Axes
) -> None:
    """Points coloured by a number of metres, the far ones first, and what the colours mean."""
    cloud = dataset.load_point_cloud(source, "world")
    points = project_to_image(dataset, cloud, source, camera, colors=False)
    values, limits, colormap = points.depth, DEPTH_RANGE, DEPTH_COLORMAP
    if color_by == "height":
        ego_from_world = dataset.world_from(dataset.get("sample_data", camera)["sample_token"], "ego").inverse()
        values, limits, colormap = ego_from_world.apply(cloud.xyz)[:, 2], _HEIGHTS, HEIGHT_COLORMAP
    shown = np.flatnonzero(points.mask)
    shown = shown[np.argsort(-points.depth[shown])]
    drawn = draw_points_in_image(
        points.pixels[shown], ax, c=values[shown], cmap=colormap, vmin=limits[0], vmax=limits[1]
    )
    ax.figure.colorbar(drawn, ax=ax, label=f"{color_by} (m)", fraction=0.03, pad=0.01)
