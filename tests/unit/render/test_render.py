"""The texts of every view: in the picture, not over each other, and large enough to be read in
print.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from picture_texts import panels_share, text_faults
from refusals import assert_refused

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
    draw_outcome_in_camera,
    render_outcome_in_cameras,
    sample_verdict,
)
from deepaccident_devkit.render.styles import current_style
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


def moments() -> tuple[float, ...]:
    return (0.2, 0.0) if current_style().room == "column" else (0.2, 0.1, 0.0)


VIEWS: dict[str, Callable[[DeepAccident, Any], Any]] = {
    "accident": lambda da, scenario: da.render_accident(scenario, seconds=moments(), layers=DRAWN),
    "annotation": lambda da, scenario: da.render_annotation(f"{ego(scenario)}/1"),
    "calibration": lambda da, scenario: da.render_calibration(
        scenario["last_frame_token"], layers=["boxes"]
    ),
    "frame": lambda da, scenario: da.render_frame(scenario["last_frame_token"], layers=["boxes"]),
    "instance": lambda da, scenario: da.render_instance(
        f"{scenario['token']}/actor/{scenario['collision']['ids'][0]}"
    ),
    "labels": lambda da, scenario: da.render_motion_labels(ego(scenario)),
    "labels maps": lambda da, scenario: da.render_motion_labels(ego(scenario), style="maps"),
    "labels trail": lambda da, scenario: da.render_motion_labels(ego(scenario), style="trail"),
    "sample": lambda da, scenario: da.render_sample(ego(scenario), layers=["boxes"]),
    "camera": lambda da, scenario: da.render_sample_data(
        f"{ego(scenario)}/Camera_Front", layers=["boxes"]
    ),
    "bev": lambda da, scenario: da.render_bev(ego(scenario), agents="all", layers=["boxes", "ids"]),
    "link": lambda da, scenario: da.render_link(
        ego(scenario), Link(latency=0.1, pose_noise=0.5), layers=["boxes"]
    ),
    "visibility": lambda da, scenario: da.render_visibility(scenario["last_frame_token"]),
    "visibility matrix": lambda da, scenario: da.render_visibility_matrix(
        scenario["last_frame_token"]
    ),
    "lidar": lambda da, scenario: da.render_sample_data(
        f"{ego(scenario)}/lidar01", layers=["boxes"]
    ),
}

AT_THE_END = ("frame", "visibility")
"""Views of the last moment, the first in world."""
WHOLE = (*AT_THE_END, "bev", "sample", "link", "lidar", "labels trail")
"""Views from above that show the pair wherever they are."""


def accidents(da: DeepAccident) -> list[Any]:
    return [scenario for scenario in da.scenario if scenario["collision"]]


@pytest.mark.slow
@pytest.mark.parametrize("where", [None, "cvpr-column", "slide"])
@pytest.mark.parametrize("view", VIEWS)
def test_texts_are_in_the_picture_and_apart_and_panels_are_large(
    da_b: DeepAccident, view: str, where: Any
) -> None:
    """What is square on a slide is as high as it can be, and maps have keys; the pair is within the
    view.
    """
    scenario = accidents(da_b)[0]
    with style(where):
        figure = VIEWS[view](da_b, scenario).figure
        assert text_faults(figure) == []
    panels = [ax for ax in figure.axes if ax.axison]
    square = (
        where == "slide" and len(panels) == 1 and panels[0].bbox.height > 0.75 * figure.bbox.height
    )
    assert panels_share(figure) >= 0.5 or square or view == "labels maps" or where is None
    if view in WHOLE:
        sample = (
            f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - (view in AT_THE_END):03d}"
        )
        boxes = da_b.cooperative_boxes(sample, frame="world" if view in AT_THE_END[:1] else "ego")
        pair = boxes.select(np.isin(boxes.actor_id, scenario["collision"]["ids"])).center[:, :2]
        above = next(ax for ax in panels if "(m)" in ax.get_xlabel())
        low, high = np.array([above.get_xlim(), above.get_ylim()]).T
        assert len(pair) == 2
        assert ((low < pair) & (pair < high)).all()


Draw = Callable[[Any, str], object]


def scenario_of(sample: str) -> str:
    return sample.rsplit("/", 2)[0]


def of_layers(name: str, layer: str, *rest: Any, **how: Any) -> tuple[Draw, type[Exception], str]:
    """A method that has no such layer."""
    return (
        lambda da, sample: getattr(da, name)(sample, *rest, layers=[layer], **how),
        ChoiceError,
        f"layers.*'{layer}'",
    )


def of_range(name: str, metres: float, *rest: Any) -> tuple[Draw, type[Exception], str]:
    """A method that cannot show so many metres."""
    return (
        lambda da, sample: getattr(da, name)(sample, *rest, view_range=metres),
        ChoiceError,
        f"view_range.*{metres}",
    )


REFUSED: list[tuple[Draw, type[Exception], str]] = [
    of_layers("render_bev", "image"),
    of_layers("render_visibility", "image"),
    of_layers("render_calibration", "bev"),
    of_layers("render_link", "image", Link()),
    of_layers("render_sample", "labels"),
    of_layers("render_evaluation", "labels", []),
    of_layers("render_motion_labels", "velocities", style="trail"),
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
    *(of_range("render_bev", metres) for metres in (0.0, -5.0, float("nan"), float("inf"))),
    of_range("render_visibility", 0.0),
    of_range("render_link", -5.0, Link()),
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
        lambda da, sample: da.render_frame(sample.rsplit("/", 2)[0] + "/004", agents="pole"),
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
        lambda da, _: da.render_accident(
            next(each for each in da.scenario if not each["collision"])
        ),
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
                "task.*accident.*'motion'",
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
        "only motion has frames",
    ),
    (
        lambda da, sample: render_outcome_in_cameras(da, f"{sample}0", []),
        TokenError,
        "table 'sample' has no token",
    ),
]


@pytest.mark.parametrize(("draw", "error", "sentence"), REFUSED)
def test_what_cannot_be_rendered_is_refused(
    draw: Draw, error: type[Exception], sentence: str, da_motion: DeepAccident, sample: str
) -> None:
    assert_refused((lambda: draw(da_motion, sample), error, sentence))
    assert plt.get_fignums() == []


@pytest.mark.parametrize(
    ("camera", "frame", "sentence"),
    [
        ("Camera_Front", -1, "frame: expected a recorded one, from 0 to {last}, found -1"),
        ("Camera_Front", 99, "frame: expected a recorded one, from 0 to {last}, found 99"),
        ("lidar01", None, "camera: expected one of .*, found 'lidar01'"),
    ],
)
def test_a_panel_of_no_camera_or_frame_is_refused(
    da_motion: DeepAccident,
    sample: str,
    labels: MotionLabels,
    camera: str,
    frame: int | None,
    sentence: str,
) -> None:
    verdict = sample_verdict(
        da_motion, sample, instances_of(labels.instance, labels.config.grid), label=labels
    )
    assert_refused(
        (
            lambda: draw_outcome_in_camera(da_motion, verdict, camera, frame=frame),
            ChoiceError,
            sentence.format(last=int(labels.label_valid.sum()) - 1),
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("view", [*VIEWS, "countdown"])
def test_texts_of_other_scenes_are_apart(da_designs: DeepAccident, view: str) -> None:
    draw = {**VIEWS, "countdown": countdown}[view]
    scenes = accidents(da_designs)[::3]
    assert [
        fault for scene in scenes for fault in text_faults(draw(da_designs, scene).figure)
    ] == []
