"""The texts of every view: in the picture, not over each other, and large enough to be read in print."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from picture_texts import panels_share, text_faults
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError, NotAvailableError, TokenError
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.accident import draw_countdown
from deepaccident_devkit.render.outcomes import draw_outcome_in_camera, render_outcome_in_cameras, sample_verdict
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
    "calibration": lambda da, scenario: da.render_calibration(scenario["last_frame_token"], layers=["boxes"]),
    "frame": lambda da, scenario: da.render_frame(scenario["last_frame_token"], layers=["boxes"]),
    "instance": lambda da, scenario: da.render_instance(f"{scenario['token']}/actor/{scenario['collision']['ids'][0]}"),
    "labels": lambda da, scenario: da.render_motion_labels(ego(scenario)),
    "labels maps": lambda da, scenario: da.render_motion_labels(ego(scenario), style="maps"),
    "labels trail": lambda da, scenario: da.render_motion_labels(ego(scenario), style="trail"),
    "sample": lambda da, scenario: da.render_sample(ego(scenario), layers=["boxes"]),
    "camera": lambda da, scenario: da.render_sample_data(f"{ego(scenario)}/Camera_Front", layers=["boxes"]),
    "bev": lambda da, scenario: da.render_bev(ego(scenario), agents="all", layers=["boxes", "ids"]),
    "link": lambda da, scenario: da.render_link(ego(scenario), Link(latency=0.1, pose_noise=0.5), layers=["boxes"]),
    "visibility": lambda da, scenario: da.render_visibility(scenario["last_frame_token"]),
    "visibility matrix": lambda da, scenario: da.render_visibility_matrix(scenario["last_frame_token"]),
    "lidar": lambda da, scenario: da.render_sample_data(f"{ego(scenario)}/lidar01", layers=["boxes"]),
}

CAR = 4.5
"""Metres."""
AT_THE_END = ("frame", "visibility")
"""Views of the last moment, the first in world."""
WHOLE = (*AT_THE_END, "bev", "sample", "link", "lidar", "labels trail")
"""Views from above that show the pair wherever they are."""


def faults(da: DeepAccident, view: str, scenario: Any) -> list[str]:
    return text_faults(VIEWS[view](da, scenario).figure)


def accidents(da: DeepAccident) -> list[Any]:
    return [scenario for scenario in da.scenario if scenario["collision"]]


@pytest.mark.slow
@pytest.mark.parametrize("where", [None, "paper", "cvpr-column", "ieee-page", "slide"])
@pytest.mark.parametrize("view", VIEWS)
def test_texts_are_in_the_picture_and_apart_and_panels_are_large(da_b: DeepAccident, view: str, where: Any) -> None:
    """What is square on a slide is as high as it can be, and maps have keys; no mark is larger than a car."""
    scenario = accidents(da_b)[0]
    with style(where):
        figure = VIEWS[view](da_b, scenario).figure
        assert text_faults(figure) == []
    panels = [ax for ax in figure.axes if ax.axison]
    square = where == "slide" and len(panels) == 1 and panels[0].bbox.height > 0.75 * figure.bbox.height
    assert panels_share(figure) >= 0.5 or square or view == "labels maps" or where is None
    for ax in [ax for ax in panels if where and "(m)" in ax.get_xlabel()]:
        car = 72 / figure.dpi * CAR * ax.bbox.width / np.ptp(ax.get_xlim())
        assert max([line.get_markersize() for line in ax.lines if line.get_marker() != "None"], default=0) <= car
        marks = [path.vertices for each in ax.collections if each.get_zorder() == 3.5 for path in each.get_paths()]
        assert max([np.ptp(corners[:, 0]) for corners in marks], default=0) <= CAR
    if view in WHOLE:
        sample = f"{scenario['token']}/ego_vehicle/{scenario['num_frames'] - (view in AT_THE_END):03d}"
        boxes = da_b.cooperative_boxes(sample, frame="world" if view in AT_THE_END[:1] else "ego")
        pair = boxes.select(np.isin(boxes.actor_id, scenario["collision"]["ids"])).center[:, :2]
        above = next(ax for ax in panels if "(m)" in ax.get_xlabel())
        low, high = np.array([above.get_xlim(), above.get_ylim()]).T
        assert len(pair) == 2
        assert ((low < pair) & (pair < high)).all()


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


Draw = Callable[[Any, str], object]


def scenario_of(sample: str) -> str:
    return sample.rsplit("/", 2)[0]


def of_layers(name: str, layer: str, *rest: Any, **how: Any) -> tuple[Draw, type[Exception], str]:
    """A method that has no such layer."""
    sentence = rf"layers: expected one of .*, found '{layer}'"
    return lambda da, sample: getattr(da, name)(sample, *rest, layers=[layer], **how), ChoiceError, sentence


def of_range(name: str, metres: float, *rest: Any) -> tuple[Draw, type[Exception], str]:
    """A method that cannot show so many metres."""
    sentence = f"view_range: expected metres above 0, found {metres}"
    return lambda da, sample: getattr(da, name)(sample, *rest, view_range=metres), ChoiceError, sentence


REFUSED: list[tuple[Draw, type[Exception], str]] = [
    of_layers("render_bev", "image"),
    of_layers("render_visibility", "image"),
    of_layers("render_calibration", "bev"),
    of_layers("render_link", "image", Link()),
    of_layers("render_sample", "labels"),
    of_layers("render_evaluation", "labels", []),
    of_layers("render_motion_labels", "velocities", style="trail"),
    (lambda da, sample: da.render_accident(scenario_of(sample), layers=["labels"]), ChoiceError, "layers: .* 'labels'"),
    (lambda da, sample: da.render_sample_data(f"{sample}/Camera_Front", layers=["bev"]), ChoiceError, "found 'bev'"),
    (lambda da, sample: da.render_sample_data(f"{sample}/lidar01", layers=["image"]), ChoiceError, "found 'image'"),
    (lambda da, _: da.render_instance(da.instance[0], layers=["ids"]), ChoiceError, r"layers: .*, found 'ids'"),
    *(of_range("render_bev", metres) for metres in (0.0, -5.0, float("nan"), float("inf"))),
    of_range("render_visibility", 0.0),
    of_range("render_link", -5.0, Link()),
    (lambda da, sample: da.render_bev(sample, frame="Camera_Front"), ChoiceError, "frame: expected one of world, ego,"),
    (lambda da, sample: da.render_visibility(sample, frame="Camera_Front"), ChoiceError, "frame: expected one of"),
    (lambda da, sample: da.render_bev(sample, agents="ego"), ChoiceError, "agents: expected one of single"),
    (lambda da, sample: da.render_frame(sample.rsplit("/", 2)[0] + "/004", agents="pole"), ChoiceError, "agents: "),
    (lambda da, sample: da.render_visibility(sample, agents=["me"]), ChoiceError, "agents: expected one of"),
    (lambda da, sample: da.render_link(sample, Link(), agents="single"), ChoiceError, "agents: expected a partner of"),
    (lambda da, sample: da.render_link(sample, Link(latency=5.0)), ConfigError, "reaches back before the first frame"),
    (lambda da, _: da.render_visibility("nobody"), TokenError, "has no token 'nobody'"),
    (lambda da, _: da.render_calibration("nothing"), TokenError, "has no token"),
    (lambda da, _: da.render_instance("no/one/actor/9999"), TokenError, "has no token"),
    (
        lambda da, _: da.render_accident(next(each for each in da.scenario if not each["collision"])),
        NotAvailableError,
        "nobody collides in it, so there is nothing to count down to",
    ),
    (
        lambda da, sample: da.render_accident(scenario_of(sample), seconds=[7.0]),
        ChoiceError,
        r"seconds: expected some from 0 to 3\.4, as recorded",
    ),
    (
        lambda da, sample: da.render_pointcloud_in_image(f"{sample}/Camera_Front", color_by="time"),
        ChoiceError,
        "color_by: expected one of depth, height, agent, found 'time'",
    ),
    (
        lambda da, sample: da.render_motion_labels(sample, style="trail", at_present=False),
        ChoiceError,
        "trail: each frame is in its own ego frame; warp the labels",
    ),
    *(
        entry
        for draw in (DeepAccident.render_evaluation, render_outcome_in_cameras)
        for entry in (
            (
                lambda da, sample, draw=draw: draw(da, sample, [], task="motion"),
                ChoiceError,
                "task of this prediction: expected one of accident, found 'motion'",
            ),
            (
                lambda da, sample, draw=draw: draw(da, sample, [], protocol="released"),
                EvaluationError,
                "the released protocol compares motion",
            ),
        )
    ),
    (lambda da, sample: render_outcome_in_cameras(da, sample, [], frame=1), ChoiceError, "only motion has frames"),
    (lambda da, sample: render_outcome_in_cameras(da, f"{sample}0", []), TokenError, "table 'sample' has no token"),
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
    da_motion: DeepAccident, sample: str, labels: MotionLabels, camera: str, frame: int | None, sentence: str
) -> None:
    verdict = sample_verdict(da_motion, sample, instances_of(labels.instance, labels.config.grid), label=labels)
    assert_refused(
        (
            lambda: draw_outcome_in_camera(da_motion, verdict, camera, frame=frame),
            ChoiceError,
            sentence.format(last=int(labels.label_valid.sum()) - 1),
        )
    )
