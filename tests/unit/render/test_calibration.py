"""The calibration proof: every agent's points in every camera, where the transforms say."""

from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, render_calibration
from deepaccident_devkit.render.styles import AGENT_COLORS
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x import map_pointcloud_to_image


def clouds(ax: Any) -> list[Any]:
    return [one for one in ax.collections if type(one) is PathCollection]


def test_of_a_sample_all_agents_points_are_in_its_six_cameras(da: DeepAccident) -> None:
    sample = da.sample[3]["token"]
    scenario, _, number = sample.rsplit("/", 2)
    fig = render_calibration(da, sample, fig=detached_figure((15, 7)))
    assert sorted(ax.get_title() for ax in fig.axes) == sorted(CAMERAS)
    for ax in fig.axes:
        for agent, drawn in zip(AGENTS, clouds(ax), strict=True):
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
    assert [len(clouds(ax)) for ax in fig.axes] == [2, 2]
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
    assert clouds(front) == []
    assert not front.images
    assert not fig.legends
