"""Many panels of a moment: which, in which order, and of which size."""

from typing import Any

import numpy as np
import pytest
from drawing import legend_words, of_kind, picture
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, render_calibration, render_frame, render_sample, style
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.hidden import hiding
from deepaccident_devkit.render.samples import draw_shared_moment
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, short_name
from deepaccident_devkit.v2x import map_pointcloud_to_image

NAMED = {camera_name(channel): channel for channel in CAMERAS}


def titles(fig: Any) -> list[str]:
    return [ax.get_title() for ax in fig.axes]


def edges(ax: Any) -> set[str]:
    return {to_hex(color) for each in ax.collections for color in each.get_edgecolor()}


def clouds(fig: Any) -> dict[str, int]:
    """How many point clouds each panel has, by title."""
    return {ax.get_title(): sum(type(one) is PathCollection for one in ax.collections) for ax in fig.axes}


def drawn(render: Any, *arguments: Any, size: tuple[float, float] = (16, 9), **how: Any) -> Any:
    """A figure with its layout."""
    fig = render(*arguments, fig=detached_figure(size), **how)
    fig.draw_without_rendering()
    return fig


@pytest.mark.slow
def test_a_frame_shows_its_agents_in_their_order(da: DeepAccident, frame: str) -> None:
    fig = render_frame(da, frame, fig=detached_figure((16, 9)))
    assert titles(fig)[:5] == [*map(short_name, AGENTS)]
    scenario = frame.rsplit("/", 1)[0]
    for ax, agent in zip(fig.axes, AGENTS, strict=False):
        np.testing.assert_array_equal(picture(ax), da.load_image(f"{scenario}/{agent}/004/Camera_Front"))
    assert {COLLIDER_COLOR, *(AGENT_COLORS[AGENTS[each]] for each in (1, 3))} <= edges(fig.axes[5])
    assert "0.2 s to the impact" in fig.get_suptitle()
    assert legend_words(fig)[:2] == ["colliding pair", "car"]
    assert (tuple(fig.get_size_inches()), plt.get_fignums()) == ((16, 9), [])


@pytest.mark.slow
@pytest.mark.parametrize(("size", "least"), [((12.8, 7.2), 290), ((12.8, 4.48), 235)])
def test_a_shared_moment_has_large_cameras_and_one_view_from_above_of_all_agents(
    da: DeepAccident, frame: str, size: tuple[float, float], least: float
) -> None:
    fig = detached_figure(size)
    draw_shared_moment(da, frame, agents=AGENTS, layers=None, fig=fig)
    fig.draw_without_rendering()
    *cameras, above = fig.axes
    assert titles(fig)[:-1] == list(map(short_name, AGENTS))
    assert min(ax.get_window_extent().width for ax in cameras) > least
    low, high = np.array([above.get_xlim(), above.get_ylim()]).T
    scenario, number = frame.rsplit("/", 1)
    places = np.array([da.world_from(f"{scenario}/{agent}/{number}", "ego").translation[:2] for agent in AGENTS])
    assert ((low + 10 < places) & (places < high - 10)).all()
    assert {COLLIDER_COLOR, AGENT_COLORS["ego_vehicle_behind"]} <= edges(above)


@pytest.mark.slow
def test_the_order_of_agents_is_fixed_and_who_is_left_out_leaves_no_hole(da: DeepAccident, frame: str) -> None:
    fig = render_frame(da, frame, agents=("infrastructure", "ego_vehicle_behind"), fig=detached_figure((8, 6)))
    assert titles(fig) == ["ego behind", "infrastructure", ""]
    assert [ax.has_data() for ax in fig.axes] == [True] * 3


@pytest.mark.slow
@pytest.mark.parametrize(("size", "wide"), [((3.25, 5), 1.1), ((7.16, 4.4), 1.3), ((12.8, 7.2), 1.0)])
def test_cameras_are_above_the_shared_view_in_a_high_figure(
    da: DeepAccident, frame: str, size: tuple[float, float], wide: float
) -> None:
    with style("ieee-page" if wide > 1 else None):
        fig = drawn(render_frame, da, frame, size=size)
    *cameras, above = (ax.get_window_extent() for ax in fig.axes)
    assert all((camera.y0 > above.y1) == (wide > 1) for camera in cameras)
    assert above.width / above.height >= wide - 1e-6


@pytest.mark.slow
def test_a_part_of_a_figure_is_drawn_on(da: DeepAccident, frame: str) -> None:
    left, right = detached_figure((24, 7)).subfigures(1, 2)
    assert render_frame(da, frame, fig=left) is left
    assert render_sample(da, da.samples_of(frame)[0], fig=right) is right
    left.figure.draw_without_rendering()
    assert [len(part.axes) for part in (left, right)] == [6, 7]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(16.0, 5.6), (12.8, 7.2)])
def test_the_cameras_of_a_sample_fill_the_figure(da: DeepAccident, frame: str, size: tuple[float, float]) -> None:
    """Three a row in a wide figure, two in one of 16 to 9: front and back on top."""
    fig = drawn(render_sample, da, da.samples_of(frame)[0], size=size)
    panels = [ax.get_window_extent() for ax in fig.axes]
    rows = {round(panel.y1) for title, panel in zip(titles(fig), panels, strict=True) if title}
    assert len(rows) == (2 if size[0] == 16 else 3)
    assert min(panel.y0 for panel in panels) < 0.2 * fig.bbox.height


@pytest.mark.slow
def test_a_sample_shows_six_cameras_as_they_look_and_the_view_from_above(da: DeepAccident, frame: str) -> None:
    sample = da.samples_of(frame)[0]
    fig = drawn(render_sample, da, sample, size=(16, 6))
    panels = dict(zip(titles(fig), (ax.get_window_extent() for ax in fig.axes), strict=True))
    assert set(panels) == {*NAMED, ""}
    for row in ("front", "back"):
        left, middle, right = (panels[f"{row}{side}"] for side in (" left", "", " right"))
        assert left.x1 <= middle.x0 < middle.x1 <= right.x0 < right.x1 < panels[""].x0
    assert panels["back"].y1 < panels["front"].y0
    for ax in (ax for ax in fig.axes if ax.get_title()):
        np.testing.assert_array_equal(picture(ax), da.load_image(f"{sample['token']}/{NAMED[ax.get_title()]}"))


@pytest.mark.slow
def test_each_panel_draws_the_layers_that_it_has(da: DeepAccident, frame: str) -> None:
    sample, fig = da.samples_of(frame)[0], detached_figure((16, 6))
    points = render_sample(da, sample, agents=None, layers=["points"], fig=fig)
    plain = render_sample(da, sample, fig=detached_figure((16, 6)))
    assert clouds(points) == {**dict.fromkeys(NAMED, 1), "": 5}
    assert not any(ax.images for ax in points.axes)
    assert clouds(plain) == {**dict.fromkeys(NAMED, 0), "": 1}


@pytest.fixture(scope="module")
def calibrated(da: DeepAccident) -> str:
    return str(da.sample[3]["token"])


def test_of_a_sample_all_agents_points_are_in_its_six_cameras(da: DeepAccident, calibrated: str) -> None:
    scenario, _, number = calibrated.rsplit("/", 2)
    fig = render_calibration(da, calibrated, fig=detached_figure((15, 7)))
    assert sorted(titles(fig)) == sorted(NAMED)
    for ax, (agent, cloud) in ((ax, each) for ax in fig.axes for each in zip(AGENTS, range(5), strict=True)):
        camera, sample = f"{calibrated}/{NAMED[ax.get_title()]}", f"{scenario}/{agent}/{number}"
        points, shown = map_pointcloud_to_image(da, camera, sample, colors=False), of_kind(ax, PathCollection)[cloud]
        points = hiding(da, camera)(points)
        np.testing.assert_allclose(np.reshape(shown.get_offsets(), (-1, 2)), points.pixels[points.mask], atol=1e-6)
        assert {to_hex(color) for color in shown.get_facecolor()} <= {AGENT_COLORS[agent]}
    assert [len(ax.images) for ax in fig.axes] == [1] * 6
    assert (legend_words(fig)[::4], plt.get_fignums()) == (["ego", "infrastructure"], [])


def test_of_a_frame_the_front_cameras_of_its_agents_are_shown(da: DeepAccident, calibrated: str) -> None:
    frame = da.get("sample", calibrated)["frame_token"]
    fig = render_calibration(da, frame, agents=("infrastructure", "ego_vehicle"), fig=detached_figure((10, 4)))
    assert clouds(fig) == {"ego, front": 2, "infrastructure, front": 2}
    everyone = render_calibration(da, da.get("frame", frame), layers=["image"], fig=detached_figure((15, 7)))
    assert [ax.get_title().split(",")[0] for ax in everyone.axes if ax.images] == [*map(short_name, AGENTS)]


def test_boxes_are_those_of_all_agents_but_the_camera_s_own_vehicle(da: DeepAccident, calibrated: str) -> None:
    fig = render_calibration(da, calibrated, layers=["boxes"], fig=detached_figure((15, 7)))
    front = next(ax for ax in fig.axes if ax.get_title() == "front")
    boxes = da.cooperative_boxes(calibrated, frame="Camera_Front")
    own = da.get("agent", calibrated.rsplit("/", 1)[0])["actor_id"]
    near = (np.linalg.norm(boxes.center, axis=1) < 60) & (boxes.actor_id != own)
    before = boxes.corners()[near][..., 2] >= 0.1
    (segments,) = (one.get_segments() for one in of_kind(front, LineCollection)[:1])
    assert 0 < 12 * before.all(axis=1).sum() <= len(segments) <= 12 * before.any(axis=1).sum()
    assert (of_kind(front, PathCollection), len(front.images), fig.legends) == ([], 0, [])
