"""The texts of every view: in the picture, not over each other, and large enough to be read in print."""

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import pytest
from matplotlib.figure import Figure
from picture_texts import text_faults

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.accident import draw_countdown
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import Link

DRAWN = ("boxes", "trajectories", "grid")
"""Layers of releases without sensor files."""


def countdown(da: DeepAccident, scenario: Any) -> Any:
    figure = detached_figure((12.8, 7.2))
    draw_countdown(da, scenario["last_frame_token"], agents=AGENTS, layers=DRAWN, fig=figure)
    return figure


def ego(scenario: Any) -> str:
    return f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - 1:03d}"


VIEWS: dict[str, Callable[[DeepAccident, Any], Any]] = {
    "accident": lambda da, scenario: da.render_accident(scenario, seconds=(0.2, 0.1, 0.0), layers=DRAWN),
    "annotation": lambda da, scenario: da.render_annotation(f"{ego(scenario)}/1"),
    "calibration": lambda da, scenario: da.render_calibration(scenario["last_frame_token"], layers=["boxes"]),
    "frame": lambda da, scenario: da.render_frame(scenario["last_frame_token"], layers=["boxes"]),
    "instance": lambda da, scenario: da.render_instance(f"{scenario['token']}/actor/{scenario['collision']['ids'][0]}"),
    "labels": lambda da, scenario: da.render_motion_labels(ego(scenario)),
    "labels trail": lambda da, scenario: da.render_motion_labels(ego(scenario), style="trail"),
    "sample": lambda da, scenario: da.render_sample(ego(scenario), layers=["boxes"]),
    "camera": lambda da, scenario: da.render_sample_data(f"{ego(scenario)}/Camera_Front", layers=["boxes"]),
    "bev": lambda da, scenario: da.render_bev(ego(scenario), agents="all", layers=["boxes", "ids"]),
    "link": lambda da, scenario: da.render_link(ego(scenario), Link(latency=0.1, pose_noise=0.5), layers=["boxes"]),
    "visibility": lambda da, scenario: da.render_visibility(scenario["last_frame_token"]),
    "visibility matrix": lambda da, scenario: da.render_visibility_matrix(scenario["last_frame_token"]),
    "lidar": lambda da, scenario: da.render_sample_data(f"{ego(scenario)}/lidar01", layers=["boxes"]),
}


def faults(da: DeepAccident, view: str, scenario: Any) -> list[str]:
    return text_faults(VIEWS[view](da, scenario).figure)


def accidents(da: DeepAccident) -> list[Any]:
    return [scenario for scenario in da.scenario if scenario["collision"]]


@pytest.mark.parametrize("where", [None, "paper"])
@pytest.mark.parametrize("view", VIEWS)
def test_texts_are_in_the_picture_and_apart(da_b: DeepAccident, view: str, where: Any) -> None:
    with style(where) if where else nullcontext():
        assert faults(da_b, view, accidents(da_b)[0]) == []


def test_texts_of_a_countdown_are_apart(da_b: DeepAccident) -> None:
    assert text_faults(countdown(da_b, accidents(da_b)[0])) == []


@pytest.mark.slow
@pytest.mark.parametrize("view", [*VIEWS, "countdown"])
def test_texts_of_twelve_scenes(da_designs: DeepAccident, view: str) -> None:
    draw = {**VIEWS, "countdown": countdown}[view]
    found = {scene["token"]: text_faults(draw(da_designs, scene).figure) for scene in accidents(da_designs)}
    assert len(found) == 12
    assert {scene: faults for scene, faults in found.items() if faults} == {}


def test_faults_are_found() -> None:
    figure = Figure((4, 4))
    figure.text(0.9, 0.5, "half outside")
    figure.text(0.3, 0.2, "one over")
    figure.text(0.32, 0.21, "the other")
    figure.text(0.3, 0.8, "tiny", fontsize=6)
    ax = figure.add_axes((0.2, 0.3, 0.4, 0.3))
    ax.text(3, 3, "clipped", clip_on=True)
    ax.set(xlim=(0, 1), ylim=(0, 1), xticks=[0.5], yticks=[])
    assert text_faults(figure) == ["'half outside': outside", "'tiny': 6.0 points", "'one over' over 'the other'"]
