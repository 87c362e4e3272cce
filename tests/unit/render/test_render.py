"""The texts of every view are in the picture, apart from each other and large enough for print."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from support.expected_errors import assert_raises
from support.figure_texts import STYLES, find_text_faults, panel_area_ratio
from support.replay_page import normal_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    EvaluationError,
    NotAvailableError,
    TokenError,
)
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.accident import draw_countdown
from deepaccident_devkit.render.outcomes import (
    render_outcome_in_cameras,
)
from deepaccident_devkit.render.styles import current_style
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import Link

SENSORLESS_LAYERS = ("boxes", "trajectories", "grid")  # of releases without sensor files
"""Layers of releases without sensor files."""


def render_countdown(da: DeepAccident, scenario: Any) -> Any:
    figure = detached_figure((12.8, 7.2))
    draw_countdown(
        da, scenario["last_frame_token"], agents=AGENTS, layers=SENSORLESS_LAYERS, fig=figure
    )
    return figure


def ego_sample(scenario: Any) -> str:
    """Return the token of the ego's last sample but one."""
    return f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - 1:03d}"


def seconds_before() -> tuple[float, ...]:
    """Return as many moments before the impact as the current style has room for."""
    return (0.2, 0.0) if current_style().layout == "column" else (0.2, 0.1, 0.0)


VIEWS: dict[str, Callable[[DeepAccident, Any], Any]] = {
    "accident": lambda da, scenario: da.render_accident(
        scenario, seconds=seconds_before(), layers=SENSORLESS_LAYERS
    ),
    "annotation": lambda da, scenario: da.render_annotation(f"{ego_sample(scenario)}/1"),
    "calibration": lambda da, scenario: da.render_calibration(
        scenario["last_frame_token"], layers=["boxes"]
    ),
    "frame": lambda da, scenario: da.render_frame(scenario["last_frame_token"], layers=["boxes"]),
    "instance": lambda da, scenario: da.render_instance(
        f"{scenario['token']}/actor/{scenario['collision']['ids'][0]}"
    ),
    "labels": lambda da, scenario: da.render_motion_labels(ego_sample(scenario)),
    "labels maps": lambda da, scenario: da.render_motion_labels(ego_sample(scenario), style="maps"),
    "labels trail": lambda da, scenario: da.render_motion_labels(
        ego_sample(scenario), style="trail"
    ),
    "sample": lambda da, scenario: da.render_sample(ego_sample(scenario), layers=["boxes"]),
    "camera": lambda da, scenario: da.render_sample_data(
        f"{ego_sample(scenario)}/Camera_Front", layers=["boxes"]
    ),
    "bev": lambda da, scenario: da.render_bev(
        ego_sample(scenario), agents="all", layers=["boxes", "ids"]
    ),
    "link": lambda da, scenario: da.render_link(
        ego_sample(scenario), Link(latency=0.1, pose_noise=0.5), layers=["boxes"]
    ),
    "teaser": lambda da, scenario: da.render_teaser(
        scenario, seconds=seconds_before(), layers=SENSORLESS_LAYERS
    ),
    "visibility": lambda da, scenario: da.render_visibility(scenario["last_frame_token"]),
    "visibility matrix": lambda da, scenario: da.render_visibility_matrix(
        scenario["last_frame_token"]
    ),
    "lidar": lambda da, scenario: da.render_sample_data(
        f"{ego_sample(scenario)}/lidar01", layers=["boxes"]
    ),
}

LAST_MOMENT = ("frame", "visibility")
FROM_ABOVE = (*LAST_MOMENT, "bev", "sample", "link", "lidar", "labels trail")


def find_accidents(da: DeepAccident) -> list[Any]:
    return [scenario for scenario in da.scenario if scenario["collision"]]


@pytest.mark.slow
@pytest.mark.parametrize("medium", STYLES)
@pytest.mark.parametrize("view", VIEWS)
def test_texts_are_in_the_picture_and_apart_and_panels_are_large(
    da_b: DeepAccident, view: str, medium: Any
) -> None:
    """A square view in a wide figure is as high as it can be; views from above show the pair."""
    scenario = find_accidents(da_b)[0]
    with style(medium):
        figure = VIEWS[view](da_b, scenario).figure
        assert find_text_faults(figure) == []

    panels = [ax for ax in figure.axes if ax.axison]
    is_high_square = (
        medium in ("slide", "cvpr-page", "ieee-page")
        and len(panels) == 1
        and panels[0].bbox.height > 0.75 * figure.bbox.height
    )
    assert (
        panel_area_ratio(figure) >= 0.5
        or is_high_square
        or view == "labels maps"  # they have keys
        or medium is None
    )

    if view in FROM_ABOVE:
        frame = scenario["num_frames"] - (view in LAST_MOMENT)
        sample = f"{scenario['token']}/ego_vehicle/{frame:03d}"
        boxes = da_b.cooperative_boxes(sample, frame="world" if view == "frame" else "ego")
        is_in_pair = np.isin(boxes.actor_id, scenario["collision"]["ids"])
        pair_centers = boxes.select(is_in_pair).center[:, :2]
        above = next(ax for ax in panels if "(m)" in ax.get_xlabel())
        low, high = np.array([above.get_xlim(), above.get_ylim()]).T
        assert len(pair_centers) == 2
        assert ((low < pair_centers) & (pair_centers < high)).all()


Draw = Callable[[Any, str], object]


def scenario_of(sample: str) -> str:
    return sample.rsplit("/", 2)[0]


def refuse_layer(
    name: str, layer: str, *arguments: Any, **options: Any
) -> tuple[Draw, type[Exception], str]:
    """Return a case in which a method is asked for a layer that it lacks."""
    return (
        lambda da, sample: getattr(da, name)(sample, *arguments, layers=[layer], **options),
        ChoiceError,
        f"layers.*'{layer}'",
    )


def refuse_range(
    name: str, view_range: float, *arguments: Any
) -> tuple[Draw, type[Exception], str]:
    """Return a case in which a method is asked for a range, in metres, that it cannot show."""
    return (
        lambda da, sample: getattr(da, name)(sample, *arguments, view_range=view_range),
        ChoiceError,
        f"view_range.*{view_range}",
    )


REFUSED_CASES: list[tuple[Draw, type[Exception], str]] = [
    refuse_layer("render_bev", "image"),
    refuse_layer("render_visibility", "image"),
    refuse_layer("render_calibration", "bev"),
    refuse_layer("render_link", "image", Link()),
    refuse_layer("render_sample", "labels"),
    refuse_layer("render_evaluation", "points", []),
    refuse_layer("render_motion_labels", "velocities", style="trail"),
    (
        lambda da, sample: da.render_accident(scenario_of(sample), layers=["labels"]),
        ChoiceError,
        "layers: .* 'labels'",
    ),
    (
        lambda da, sample: da.render_sample_data(f"{sample}/Camera_Front", layers=["bev"]),
        ChoiceError,
        "found 'bev'",
    ),
    (
        lambda da, sample: da.render_sample_data(f"{sample}/lidar01", layers=["image"]),
        ChoiceError,
        "found 'image'",
    ),
    (
        lambda da, _: da.render_instance(da.instance[0], layers=["ids"]),
        ChoiceError,
        r"layers: .*, found 'ids'",
    ),
    *(refuse_range("render_bev", metres) for metres in (0.0, -5.0, float("nan"), float("inf"))),
    refuse_range("render_visibility", 0.0),
    refuse_range("render_link", -5.0, Link()),
    (
        lambda da, sample: da.render_bev(sample, frame="Camera_Front"),
        ChoiceError,
        "frame.*world, ego",
    ),
    (
        lambda da, sample: da.render_visibility(sample, frame="Camera_Front"),
        ChoiceError,
        "frame.*world",
    ),
    (lambda da, sample: da.render_bev(sample, agents="ego"), ChoiceError, "agents.*single"),
    (
        lambda da, sample: da.render_frame(f"{scenario_of(sample)}/004", agents="pole"),
        ChoiceError,
        "agents: ",
    ),
    (lambda da, sample: da.render_visibility(sample, agents=["me"]), ChoiceError, "agents.*ego"),
    (
        lambda da, sample: da.render_link(sample, Link(), agents="single"),
        ChoiceError,
        "agents.*partner",
    ),
    (lambda da, sample: da.render_link(sample, Link(latency=5.0)), ConfigError, "first frame"),
    (lambda da, _: da.render_visibility("nobody"), TokenError, "has no token 'nobody'"),
    (lambda da, _: da.render_calibration("nothing"), TokenError, "has no token"),
    (lambda da, _: da.render_instance("no/one/actor/9999"), TokenError, "has no token"),
    (
        lambda da, _: da.render_accident(normal_scenario(da)),
        NotAvailableError,
        "nobody collides",
    ),
    (
        lambda da, _: da.render_teaser(normal_scenario(da)),
        NotAvailableError,
        "nobody collides",
    ),
    (
        lambda da, sample: da.render_accident(scenario_of(sample), seconds=[7.0]),
        ChoiceError,
        r"seconds.*3\.4",
    ),
    (
        lambda da, sample: da.render_pointcloud_in_image(f"{sample}/Camera_Front", color_by="time"),
        ChoiceError,
        "color_by.*depth, height, agent.*'time'",
    ),
    (
        lambda da, sample: da.render_motion_labels(sample, style="trail", at_present=False),
        ChoiceError,
        "trail",
    ),
    *(
        entry
        for draw in (DeepAccident.render_evaluation, render_outcome_in_cameras)
        for entry in (
            (
                lambda da, sample, draw=draw: draw(da, sample, [], task="motion"),
                ChoiceError,
                "task 'motion': .*found accident",
            ),
            (
                lambda da, sample, draw=draw: draw(da, sample, [], protocol="released"),
                EvaluationError,
                "released protocol",
            ),
        )
    ),
    (
        lambda da, sample: render_outcome_in_cameras(da, sample, [], frame=1),
        ChoiceError,
        "only predicted motion has frames",
    ),
    (
        lambda da, sample: render_outcome_in_cameras(da, f"{sample}0", []),
        TokenError,
        "table 'sample' has no token",
    ),
]


@pytest.mark.parametrize(("draw", "error", "sentence"), REFUSED_CASES)
def test_what_cannot_be_rendered_is_refused(
    draw: Draw, error: type[Exception], sentence: str, da_motion: DeepAccident, sample: str
) -> None:
    assert_raises((lambda: draw(da_motion, sample), error, sentence))
    assert plt.get_fignums() == []


@pytest.mark.parametrize("frame", [-1, 99])
def test_a_frame_that_is_not_recorded_is_refused(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, frame: int
) -> None:
    prediction = instances_of(labels.instance, labels.config.grid)
    last = int(labels.label_valid.sum()) - 1

    assert_raises(
        (
            lambda: render_outcome_in_cameras(da_motion, sample, prediction, frame=frame),
            ChoiceError,
            f"frame: expected a recorded frame, from 0 to {last}, found {frame}",
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("view", [*VIEWS, "countdown"])
def test_texts_of_other_scenes_are_apart(da_designs: DeepAccident, view: str) -> None:
    render = {**VIEWS, "countdown": render_countdown}[view]
    faults = []
    for scenario in find_accidents(da_designs)[::3]:
        faults += find_text_faults(render(da_designs, scenario).figure)
    assert faults == []
