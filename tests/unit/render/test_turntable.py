"""The turntable shows the fused cloud where it is, and goes around it once."""

import numpy as np
import pytest
from support.replay_page import accident_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.figures import figure_of_pixels
from deepaccident_devkit.render.turntable import draw_turntable
from deepaccident_devkit.taxonomy import AGENTS, short_name


@pytest.mark.parametrize("size", [(1280, 720), (640, 500)])
def test_the_camera_goes_around_once(da: DeepAccident, size: tuple[int, int]) -> None:
    scenario = accident_scenario(da)
    num_frames = da.get("scenario", scenario)["num_frames"]
    angles = []
    for number in (1, num_frames):
        fig = figure_of_pixels(*size, dpi=100)
        draw_turntable(da, f"{scenario}/{number:03d}", agents=AGENTS, fig=fig)
        (ax,) = fig.axes
        angles.append(ax.azim)
    assert angles == pytest.approx([360 / num_frames, 360])


def test_it_has_points_of_all_agents_and_twelve_edges_of_each_box(da: DeepAccident) -> None:
    frame = f"{accident_scenario(da)}/003"
    fig = figure_of_pixels(640, 360, dpi=100)
    draw_turntable(da, frame, agents=AGENTS, fig=fig)

    (ax,) = fig.axes
    points, lines, road = ax.collections
    assert len(np.unique(points.get_facecolor(), axis=0)) == len(AGENTS)
    assert len(lines._segments3d) % 12 == 0
    assert len(lines._segments3d) > 0

    (legend,) = fig.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert {short_name(agent) for agent in AGENTS} <= {*names}
    scenario, number = frame.rsplit("/", 1)
    positions = np.array(
        [da.world_from(f"{scenario}/{agent}/{number}", "ego").translation for agent in AGENTS]
    )
    x, y, z = road._offsets3d
    offsets = (positions - positions.mean(axis=0))[:4]  # the infrastructure is beside the road
    for offset in offsets:
        distances = np.hypot(x - offset[0], y - offset[1])
        assert distances.min() < 3
    np.testing.assert_allclose(z, offsets[0, 2], atol=0.1)
