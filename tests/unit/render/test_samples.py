"""Many panels of a moment: which, in which order, and of which size."""

from typing import Any

import numpy as np
import pytest
from drawing import of_kind, picture
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import (
    detached_figure,
    render_calibration,
    render_frame,
    render_sample,
)
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
    return {
        ax.get_title(): sum(type(one) is PathCollection for one in ax.collections)
        for ax in fig.axes
    }


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
        np.testing.assert_array_equal(
            picture(ax), da.load_image(f"{scenario}/{agent}/004/Camera_Front")
        )
    assert {COLLIDER_COLOR, *(AGENT_COLORS[AGENTS[each]] for each in (1, 3))} <= edges(fig.axes[5])


@pytest.mark.slow
def test_a_shared_moment_has_large_cameras_and_one_view_from_above_of_all_agents(
    da: DeepAccident, frame: str
) -> None:
    fig = detached_figure((12.8, 4.48))
    draw_shared_moment(da, frame, agents=AGENTS, layers=None, fig=fig)
    fig.draw_without_rendering()
    *cameras, above = fig.axes
    assert titles(fig)[:-1] == list(map(short_name, AGENTS))
    assert min(ax.get_window_extent().width for ax in cameras) > 235
    low, high = np.array([above.get_xlim(), above.get_ylim()]).T
    scenario, number = frame.rsplit("/", 1)
    places = np.array(
        [da.world_from(f"{scenario}/{agent}/{number}", "ego").translation[:2] for agent in AGENTS]
    )
    assert ((low + 10 < places) & (places < high - 10)).all()


@pytest.mark.slow
def test_the_order_of_agents_is_fixed_and_who_is_left_out_leaves_no_hole(
    da: DeepAccident, frame: str
) -> None:
    fig = render_frame(
        da, frame, agents=("infrastructure", "ego_vehicle_behind"), fig=detached_figure((8, 6))
    )
    assert titles(fig) == ["ego behind", "infrastructure", ""]
    assert [ax.has_data() for ax in fig.axes] == [True] * 3


@pytest.mark.slow
def test_a_sample_shows_six_cameras_as_they_look_and_the_view_from_above(
    da: DeepAccident, frame: str
) -> None:
    sample = da.samples_of(frame)[0]
    fig = drawn(render_sample, da, sample, size=(16, 6))
    panels = dict(zip(titles(fig), (ax.get_window_extent() for ax in fig.axes), strict=True))
    assert set(panels) == {*NAMED, ""}
    for row in ("front", "back"):
        left, middle, right = (panels[f"{row}{side}"] for side in (" left", "", " right"))
        assert left.x1 <= middle.x0 < middle.x1 <= right.x0 < right.x1 < panels[""].x0
    assert panels["back"].y1 < panels["front"].y0
    for ax in (ax for ax in fig.axes if ax.get_title()):
        np.testing.assert_array_equal(
            picture(ax), da.load_image(f"{sample['token']}/{NAMED[ax.get_title()]}")
        )


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


def test_of_a_sample_all_agents_points_are_in_its_six_cameras(
    da: DeepAccident, calibrated: str
) -> None:
    scenario, _, number = calibrated.rsplit("/", 2)
    fig = render_calibration(da, calibrated, fig=detached_figure((15, 7)))
    assert sorted(titles(fig)) == sorted(NAMED)
    for ax, (agent, cloud) in (
        (ax, each) for ax in fig.axes for each in zip(AGENTS, range(5), strict=True)
    ):
        camera, sample = f"{calibrated}/{NAMED[ax.get_title()]}", f"{scenario}/{agent}/{number}"
        points, shown = (
            map_pointcloud_to_image(da, camera, sample, colors=False),
            of_kind(ax, PathCollection)[cloud],
        )
        points = hiding(da, camera)(points)
        np.testing.assert_allclose(
            np.reshape(shown.get_offsets(), (-1, 2)), points.pixels[points.mask], atol=1e-6
        )
        assert {to_hex(color) for color in shown.get_facecolor()} <= {AGENT_COLORS[agent]}
    assert [len(ax.images) for ax in fig.axes] == [1] * 6


def test_of_a_frame_the_front_cameras_of_its_agents_are_shown(
    da: DeepAccident, calibrated: str
) -> None:
    frame = da.get("sample", calibrated)["frame_token"]
    fig = render_calibration(
        da, frame, agents=("infrastructure", "ego_vehicle"), fig=detached_figure((10, 4))
    )
    assert clouds(fig) == {"ego, front": 2, "infrastructure, front": 2}


def test_boxes_are_those_of_all_agents_but_the_camera_s_own_vehicle(
    da: DeepAccident, calibrated: str
) -> None:
    fig = render_calibration(da, calibrated, layers=["boxes"], fig=detached_figure((15, 7)))
    front = next(ax for ax in fig.axes if ax.get_title() == "front")
    boxes = da.cooperative_boxes(calibrated, frame="Camera_Front")
    own = da.get("agent", calibrated.rsplit("/", 1)[0])["actor_id"]
    near = (np.linalg.norm(boxes.center, axis=1) < 60) & (boxes.actor_id != own)
    before = boxes.corners()[near][..., 2] >= 0.1
    (segments,) = (one.get_segments() for one in of_kind(front, LineCollection)[:1])
    assert 0 < 12 * before.all(axis=1).sum() <= len(segments) <= 12 * before.any(axis=1).sum()
