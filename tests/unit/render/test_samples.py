"""Many panels of a moment: which ones, in which order, and how large."""

from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex
from support.rendered_pixels import collections_of_kind, first_image

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import (
    detached_figure,
    render_calibration,
    render_frame,
    render_sample,
)
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.hidden import hidden_points_filter
from deepaccident_devkit.render.samples import draw_shared_moment
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, short_name
from deepaccident_devkit.v2x import map_pointcloud_to_image

CHANNEL_BY_NAME = {camera_name(channel): channel for channel in CAMERAS}


def read_titles(fig: Any) -> list[str]:
    return [ax.get_title() for ax in fig.axes]


def count_clouds(fig: Any) -> dict[str, int]:
    """Return the number of point clouds in each panel by the panel's title."""
    return {ax.get_title(): len(collections_of_kind(ax, PathCollection)) for ax in fig.axes}


@pytest.mark.slow
def test_a_frame_shows_its_agents_in_their_order(da: DeepAccident, frame: str) -> None:
    fig = render_frame(da, frame, fig=detached_figure((16, 9)))
    assert read_titles(fig)[:5] == [*map(short_name, AGENTS)]

    scenario = frame.rsplit("/", 1)[0]
    for ax, agent in zip(fig.axes, AGENTS, strict=False):
        image = da.load_image(f"{scenario}/{agent}/004/Camera_Front")
        np.testing.assert_array_equal(first_image(ax), image)

    above = fig.axes[5]
    edge_colors = {to_hex(color) for shape in above.collections for color in shape.get_edgecolor()}
    follower_colors = {AGENT_COLORS[AGENTS[1]], AGENT_COLORS[AGENTS[3]]}
    assert {COLLIDER_COLOR, *follower_colors} <= edge_colors


@pytest.mark.slow
def test_a_shared_moment_has_large_cameras_and_one_view_from_above_of_all_agents(
    da: DeepAccident, frame: str
) -> None:
    fig = detached_figure((12.8, 4.48))
    draw_shared_moment(da, frame, agents=AGENTS, layers=None, fig=fig)
    fig.draw_without_rendering()

    *cameras, above = fig.axes
    assert read_titles(fig)[:-1] == list(map(short_name, AGENTS))
    assert min(ax.get_window_extent().width for ax in cameras) > 235

    low, high = np.array([above.get_xlim(), above.get_ylim()]).T
    scenario, number = frame.rsplit("/", 1)
    for agent in AGENTS:
        position = da.world_from(f"{scenario}/{agent}/{number}", "ego").translation[:2]
        assert ((low + 10 < position) & (position < high - 10)).all()


@pytest.mark.slow
def test_the_order_of_agents_is_fixed_and_an_agent_left_out_leaves_no_hole(
    da: DeepAccident, frame: str
) -> None:
    agents = ("infrastructure", "ego_vehicle_behind")
    fig = render_frame(da, frame, agents=agents, fig=detached_figure((8, 6)))
    assert read_titles(fig) == ["ego behind", "infrastructure", ""]
    assert [ax.has_data() for ax in fig.axes] == [True] * 3


@pytest.mark.slow
def test_a_sample_shows_six_cameras_as_they_look_and_the_view_from_above(
    da: DeepAccident, frame: str
) -> None:
    sample = da.samples_of(frame)[0]
    fig = render_sample(da, sample, fig=detached_figure((16, 6)))
    fig.draw_without_rendering()

    panels = {ax.get_title(): ax.get_window_extent() for ax in fig.axes}
    assert sorted(read_titles(fig)) == sorted([*CHANNEL_BY_NAME, ""])
    for row in ("front", "back"):
        left, middle, right = (panels[f"{row}{side}"] for side in (" left", "", " right"))
        assert left.x1 <= middle.x0 < middle.x1 <= right.x0 < right.x1 < panels[""].x0
    assert panels["back"].y1 < panels["front"].y0

    for ax in fig.axes:
        if ax.get_title():
            channel = CHANNEL_BY_NAME[ax.get_title()]
            image = da.load_image(f"{sample['token']}/{channel}")
            np.testing.assert_array_equal(first_image(ax), image)


@pytest.mark.slow
def test_each_panel_draws_the_layers_that_it_has(da: DeepAccident, frame: str) -> None:
    sample = da.samples_of(frame)[0]
    points = render_sample(da, sample, agents=None, layers=["points"], fig=detached_figure((16, 6)))
    default = render_sample(da, sample, fig=detached_figure((16, 6)))
    assert count_clouds(points) == {**dict.fromkeys(CHANNEL_BY_NAME, 1), "": 5}
    assert not any(ax.images for ax in points.axes)
    assert count_clouds(default) == {**dict.fromkeys(CHANNEL_BY_NAME, 0), "": 1}


@pytest.fixture(scope="module")
def calibrated_sample(da: DeepAccident) -> str:
    return str(da.sample[3]["token"])


def test_the_six_cameras_of_a_sample_show_the_points_of_all_agents(
    da: DeepAccident, calibrated_sample: str
) -> None:
    scenario, _, number = calibrated_sample.rsplit("/", 2)
    fig = render_calibration(da, calibrated_sample, fig=detached_figure((15, 7)))
    assert sorted(read_titles(fig)) == sorted(CHANNEL_BY_NAME)

    for ax in fig.axes:
        camera = f"{calibrated_sample}/{CHANNEL_BY_NAME[ax.get_title()]}"
        hide = hidden_points_filter(da, camera)
        for agent, cloud in zip(AGENTS, collections_of_kind(ax, PathCollection)[:5], strict=True):
            sample = f"{scenario}/{agent}/{number}"
            points = hide(map_pointcloud_to_image(da, camera, sample, colors=False))
            np.testing.assert_allclose(
                np.reshape(cloud.get_offsets(), (-1, 2)),
                points.pixels[points.mask],
                atol=1e-6,
            )
            assert {to_hex(color) for color in cloud.get_facecolor()} <= {AGENT_COLORS[agent]}
    assert [len(ax.images) for ax in fig.axes] == [1] * 6


def test_a_frame_shows_the_front_cameras_of_its_agents(
    da: DeepAccident, calibrated_sample: str
) -> None:
    frame = da.get("sample", calibrated_sample)["frame_token"]
    agents = ("infrastructure", "ego_vehicle")
    fig = render_calibration(da, frame, agents=agents, fig=detached_figure((10, 4)))
    assert count_clouds(fig) == {"ego, front": 2, "infrastructure, front": 2}


def test_the_boxes_of_all_agents_are_drawn_except_the_camera_s_own_vehicle(
    da: DeepAccident, calibrated_sample: str
) -> None:
    fig = render_calibration(da, calibrated_sample, layers=["boxes"], fig=detached_figure((15, 7)))
    front = next(ax for ax in fig.axes if ax.get_title() == "front")
    num_edges = len(collections_of_kind(front, LineCollection)[0].get_segments())

    boxes = da.cooperative_boxes(calibrated_sample, frame="Camera_Front")
    own_id = da.get("agent", calibrated_sample.rsplit("/", 1)[0])["actor_id"]
    is_near = np.linalg.norm(boxes.center, axis=1) < 60
    depths = boxes.corners()[is_near & (boxes.actor_id != own_id)][..., 2]
    is_before_camera = depths >= 0.1
    num_whole = is_before_camera.all(axis=1).sum()
    num_visible = is_before_camera.any(axis=1).sum()
    assert 0 < 12 * num_whole <= num_edges <= 12 * num_visible
