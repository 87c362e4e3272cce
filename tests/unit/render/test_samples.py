"""Many panels of a moment: which, in which order, and of which size."""

from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, render_calibration, render_frame, render_sample
from deepaccident_devkit.render.samples import draw_shared_moment
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, short_name
from deepaccident_devkit.v2x import map_pointcloud_to_image


def images(axes: Any) -> list[Any]:
    return [np.asarray(ax.images[0].get_array()) for ax in axes]


def colors_from_above(ax: Any) -> set[str]:
    return {to_hex(color) for color in ax.collections[1].get_edgecolor()}


def colors_from_above_shared(ax: Any) -> set[str]:
    return {to_hex(color) for each in ax.collections for color in each.get_edgecolor()}


def clouds(fig: Any) -> dict[str, int]:
    """How many point clouds each panel has, by title."""
    return {ax.get_title(): sum(type(one) is PathCollection for one in ax.collections) for ax in fig.axes}


@pytest.mark.slow
def test_a_frame_shows_its_agents_in_their_order(da: DeepAccident, frame: str) -> None:
    fig = render_frame(da, frame, fig=detached_figure((16, 9)))
    cameras, above = fig.axes[:5], fig.axes[5:]
    assert [ax.get_title() for ax in cameras] == list(AGENTS)
    scenario = frame.rsplit("/", 1)[0]
    for agent, image in zip(AGENTS, images(cameras), strict=True):
        assert_array_equal(image, da.load_image(f"{scenario}/{agent}/004/Camera_Front"))
    for ax in above:
        assert {COLLIDER_COLOR, *(AGENT_COLORS[AGENTS[each]] for each in (1, 3))} <= colors_from_above(ax)
    assert "0.2 s to the impact" in fig._suptitle.get_text()
    legend = [one.get_text() for one in fig.legends[0].get_texts()]
    assert legend[:2] == ["colliding pair", "ego behind"]
    assert tuple(fig.get_size_inches()) == (16, 9)
    assert plt.get_fignums() == []


@pytest.mark.slow
@pytest.mark.parametrize(("size", "least"), [((12.8, 7.2), 290), ((12.8, 4.48), 235)])
def test_a_shared_moment_has_large_cameras_and_one_view_from_above_of_all_agents(
    da: DeepAccident, frame: str, size: tuple[float, float], least: float
) -> None:
    fig = detached_figure(size)
    draw_shared_moment(da, frame, agents=AGENTS, layers=None, fig=fig)
    fig.draw_without_rendering()
    *cameras, above = fig.axes
    assert [ax.get_title() for ax in cameras] == list(map(short_name, AGENTS))
    assert min(ax.get_window_extent().width for ax in cameras) > least
    (left, right), (low, high) = above.get_xlim(), above.get_ylim()
    scenario, number = frame.rsplit("/", 1)
    for agent in AGENTS:
        x, y = da.world_from(f"{scenario}/{agent}/{number}", "ego").translation[:2]
        assert left + 10 < x < right - 10
        assert low + 10 < y < high - 10
    assert {COLLIDER_COLOR, AGENT_COLORS["ego_vehicle_behind"]} <= colors_from_above_shared(above)


@pytest.mark.slow
def test_the_order_of_agents_is_fixed_and_who_is_left_out_leaves_no_hole(da: DeepAccident, frame: str) -> None:
    fig = render_frame(da, frame, agents=("infrastructure", "ego_vehicle_behind"), fig=detached_figure((8, 6)))
    assert [ax.get_title() for ax in fig.axes] == ["ego_vehicle_behind", "infrastructure", "", ""]
    assert all(ax.has_data() for ax in fig.axes)


@pytest.mark.slow
def test_the_columns_stand_side_by_side_with_camera_above_view_from_above(da: DeepAccident, frame: str) -> None:
    fig = render_frame(da, frame, fig=detached_figure((16, 9)))
    fig.draw_without_rendering()
    boxes = [ax.get_window_extent() for ax in fig.axes]
    for camera, above, ax in zip(boxes[:5], boxes[5:], fig.axes[5:], strict=True):
        assert above.y1 < camera.y0
        assert abs(camera.x0 - above.x0) < 2
        assert ax.get_xlim() == (-50, 50)
        assert above.height / np.ptp(ax.get_ylim()) == pytest.approx(above.width / 100, rel=0.01)
    assert (np.diff([box.x0 for box in boxes[:5]]) > boxes[0].width).all()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(18, 6.9), (16, 9), (12.8, 7.2)])
def test_panels_from_above_fill_a_tall_figure(da: DeepAccident, frame: str, size: tuple[float, float]) -> None:
    fig = render_frame(da, frame, fig=detached_figure(size))
    fig.draw_without_rendering()
    low = min(ax.get_window_extent().y0 for ax in fig.axes)
    high = max(ax.get_window_extent().y1 for ax in fig.axes)
    assert (high - low) / fig.bbox.height > 0.7
    half = fig.axes[-1].get_ylim()[1]
    wide = size[0] > 2.5 * size[1]
    assert half == pytest.approx(50, abs=1e-9) if wide else 50.1 < half <= 100


@pytest.mark.slow
def test_a_part_of_a_figure_is_drawn_on(da: DeepAccident, frame: str) -> None:
    left, right = detached_figure((24, 7)).subfigures(1, 2)
    assert render_frame(da, frame, fig=left) is left
    assert render_sample(da, da.samples_of(frame)[0], fig=right) is right
    left.figure.draw_without_rendering()
    assert [len(part.axes) for part in (left, right)] == [10, 7]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(16.0, 5.6), (12.8, 7.2)])
def test_the_cameras_of_a_sample_fill_the_figure(da: DeepAccident, frame: str, size: tuple[float, float]) -> None:
    """Three a row in a wide figure, two in one of 16 to 9: front and back on top."""
    fig = render_sample(da, da.samples_of(frame)[0], fig=detached_figure(size))
    fig.draw_without_rendering()
    panels = {ax.get_title(): ax.get_window_extent() for ax in fig.axes}
    rows = {round(panel.y1) for title, panel in panels.items() if title}
    assert len(rows) == (2 if size[0] == 16 else 3)
    assert min(panel.y0 for panel in panels.values()) < 0.2 * fig.bbox.height


@pytest.mark.slow
def test_a_sample_shows_six_cameras_as_they_look_and_the_view_from_above(da: DeepAccident, frame: str) -> None:
    sample = da.samples_of(frame)[0]
    fig = render_sample(da, sample, fig=detached_figure((16, 6)))
    fig.draw_without_rendering()
    panels = {ax.get_title(): ax.get_window_extent() for ax in fig.axes}
    assert set(panels) == {*CAMERAS, ""}
    for row in ("Front", "Back"):
        left, middle, right = (panels[f"Camera_{row}{side}"] for side in ("Left", "", "Right"))
        assert left.x1 <= middle.x0 < middle.x1 <= right.x0
        assert right.x1 < panels[""].x0
    assert panels["Camera_Back"].y1 < panels["Camera_Front"].y0
    for ax in fig.axes:
        if ax.get_title():
            assert_array_equal(images([ax])[0], da.load_image(f"{sample['token']}/{ax.get_title()}"))


@pytest.mark.slow
def test_each_panel_draws_the_layers_that_it_has(da: DeepAccident, frame: str) -> None:
    sample = da.samples_of(frame)[0]
    fig = render_sample(da, sample, agents=None, layers=["points"], fig=detached_figure((16, 6)))
    assert clouds(fig) == {**dict.fromkeys(CAMERAS, 1), "": 5}
    assert not any(ax.images for ax in fig.axes)
    plain = render_sample(da, sample, fig=detached_figure((16, 6)))
    assert clouds(plain) == {**dict.fromkeys(CAMERAS, 0), "": 1}


def clouds_of(ax: Any) -> list[Any]:
    return [one for one in ax.collections if type(one) is PathCollection]


def test_of_a_sample_all_agents_points_are_in_its_six_cameras(da: DeepAccident) -> None:
    sample = da.sample[3]["token"]
    scenario, _, number = sample.rsplit("/", 2)
    fig = render_calibration(da, sample, fig=detached_figure((15, 7)))
    assert sorted(ax.get_title() for ax in fig.axes) == sorted(CAMERAS)
    for ax in fig.axes:
        for agent, drawn in zip(AGENTS, clouds_of(ax), strict=True):
            points = map_pointcloud_to_image(
                da, f"{sample}/{ax.get_title()}", f"{scenario}/{agent}/{number}", colors=False
            )
            offsets = np.asarray(drawn.get_offsets()).reshape(-1, 2)
            assert_allclose(offsets, points.pixels[points.mask], atol=1e-6)
            if len(offsets):
                assert to_hex(drawn.get_facecolor()[0]) == AGENT_COLORS[agent]
        assert len(ax.images) == 1
    assert [one.get_text() for one in fig.legends[0].get_texts()][::4] == ["ego", "infrastructure"]
    assert plt.get_fignums() == []


def test_of_a_frame_the_front_cameras_of_its_agents_are_shown(da: DeepAccident) -> None:
    frame = da.get("frame", da.sample[3]["frame_token"])
    fig = render_calibration(da, frame, agents=("infrastructure", "ego_vehicle"), fig=detached_figure((10, 4)))
    assert [ax.get_title() for ax in fig.axes] == ["ego_vehicle, Camera_Front", "infrastructure, Camera_Front"]
    assert [len(clouds_of(ax)) for ax in fig.axes] == [2, 2]
    everyone = render_calibration(da, frame["token"], layers=["image"], fig=detached_figure((15, 7)))
    shown = [ax for ax in everyone.axes if ax.images]
    assert [ax.get_title().split(",")[0] for ax in shown] == list(AGENTS)


def test_boxes_are_those_of_all_agents_but_the_camera_s_own_vehicle(da: DeepAccident) -> None:
    sample = da.sample[3]["token"]
    fig = render_calibration(da, sample, layers=["boxes"], fig=detached_figure((15, 7)))
    front = next(ax for ax in fig.axes if ax.get_title() == "Camera_Front")
    boxes = da.cooperative_boxes(sample, frame="Camera_Front")
    own = da.get("agent", sample.rsplit("/", 1)[0])["actor_id"]
    near = (np.linalg.norm(boxes.center, axis=1) < 60) & (boxes.actor_id != own)
    depth = boxes.corners()[near][..., 2]
    whole, partly = (depth >= 0.1).all(axis=1).sum(), (depth >= 0.1).any(axis=1).sum()
    edges = next(one for one in front.collections if type(one) is LineCollection)
    assert 0 < 12 * whole <= len(edges.get_segments()) <= 12 * partly
    assert clouds_of(front) == []
    assert not front.images
    assert not fig.legends
