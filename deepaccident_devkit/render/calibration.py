"""Pictures that show whether the transforms are right."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.geometry import Boxes, LidarPointCloud
from deepaccident_devkit.render.axes import figure_or_new
from deepaccident_devkit.render.camera import draw_camera_boxes, draw_image, draw_points_in_image
from deepaccident_devkit.render.colors import AGENT_COLORS
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.legends import agent_handles, draw_legend
from deepaccident_devkit.render.missing import has_cloud, missing_clouds_text, write_missing
from deepaccident_devkit.render.moments import CAMERA_GRID
from deepaccident_devkit.render.roles import at_once, in_drawing_order
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_scene_title, set_title
from deepaccident_devkit.v2x import Agents, cooperating_agents, cooperative_boxes, project_to_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CALIBRATION_LAYERS: Final[tuple[Layer, ...]] = ("image", "points", "boxes", "ids")
_DEFAULT: Final[tuple[Layer, ...]] = ("image", "points", "boxes")
_FARTHEST: Final = 60.0
"""Metres from the camera up to which boxes are rendered: farther ones are as small as the errors to be found."""
_COLUMNS: Final = 3


@in_own_settings
def render_calibration(
    dataset: Dataset,
    frame_or_sample: RowArgument,
    *,
    agents: Agents = None,
    layers: Iterable[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render the LiDAR points of all agents and all agents' boxes in camera images, to prove the calibration.

    Each agent's points have its colour. If the transforms are right, they lie on the kerbs, walls and cars of the
    image. If an agent's pose or a sensor's place is wrong, all points of its colour are in wrong places. Points and
    boxes are rendered even if other things hide them.

    Args:
        dataset: the release.
        frame_or_sample: token or record: a sample shows its six cameras, a frame the front cameras of the agents.
        agents: whose points and boxes (and, for a frame, whose cameras); None for all that are there.
        layers: some of `image`, `points`, `boxes` (up to 60 m) and `ids`; by default all except ids.
        fig: an empty figure to render on; a new one if None.

    Returns:
        The figure, three panels in a row. An image that was not downloaded is a grey panel; words in the first panel
        name the agents whose points were not.

    Raises:
        TokenError: no such sample or frame.
        ChoiceError: no such layer, agent or configuration.
        NotAvailableError: an agent is not in this (partial) release.
    """
    chosen = layers_of(layers, _DEFAULT, CALIBRATION_LAYERS)
    sample, is_frame = _present(dataset, frame_or_sample)
    names = in_drawing_order(cooperating_agents(dataset, sample, agents))
    record = dataset.get("sample", sample)
    cameras = [f"{sample}/{channel}" for row in CAMERA_GRID for channel in row]
    if is_frame:
        cameras = [f"{at_once(record, agent)}/Camera_Front" for agent in names]
    lookers = names if "points" in chosen else []
    clouds = {
        agent: dataset.load_point_cloud(at_once(record, agent))
        for agent in lookers
        if has_cloud(dataset, at_once(record, agent))
    }
    boxes = cooperative_boxes(dataset, sample, agents=names)
    rows = -(-len(cameras) // _COLUMNS)
    fig = figure_or_new(fig, (15, 3.1 * rows + 0.8))
    axes = fig.subplots(rows, min(_COLUMNS, len(cameras)), squeeze=False)
    for ax in axes.flat[len(cameras) :]:
        ax.set_axis_off()
    for camera, ax in zip(cameras, axes.flat, strict=False):
        _draw_panel(dataset, camera, clouds, boxes, chosen, ax)
        if is_frame:
            set_title(ax, f"{camera.rsplit('/', 3)[1]}, Camera_Front")
    if clouds:
        draw_legend(fig, agent_handles(clouds), columns=len(clouds), loc="outside lower center", fontsize=9)
    whose = "each agent" if len(names) > 1 else names[0]
    where = record["frame_token"] if is_frame else record["token"]
    set_scene_title(fig, dataset, where, f"LiDAR of {whose}")
    write_missing(axes[0, 0], missing_clouds_text([agent for agent in lookers if agent not in clouds]))
    return fig


def _present(dataset: Dataset, row: RowArgument) -> tuple[str, bool]:
    """The token of a sample (of a frame's first one), and whether the row is a frame."""
    try:
        return dataset.get("sample", row)["token"], False
    except TokenError:
        return dataset.samples_of(row)[0]["token"], True


def _draw_panel(
    dataset: Dataset,
    camera: str,
    clouds: dict[str, LidarPointCloud],
    boxes: Boxes,
    layers: frozenset[Layer],
    ax: Axes,
) -> None:
    record = dataset.get("sample_data", camera)
    sample = dataset.get("sample", record["sample_token"])
    draw_image(dataset, record, ax, image="image" in layers)
    for agent, cloud in clouds.items():
        points = project_to_image(dataset, cloud, sample, record, colors=False)
        draw_points_in_image(points.pixels[points.mask], ax, size=1.2, color=AGENT_COLORS[agent])
    own = dataset.get("agent", sample["agent_token"])["actor_id"]
    optical = boxes.transform(dataset.world_from(sample, record["channel"]).inverse(), record["channel"])
    near = np.linalg.norm(optical.center, axis=1) < _FARTHEST
    draw_camera_boxes(dataset, record, optical.select(near & (optical.actor_id != own)), layers, ax)
