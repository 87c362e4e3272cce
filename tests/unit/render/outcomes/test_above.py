"""Accidents foreseen: places, metres and words."""

from dataclasses import replace

import numpy as np
import pytest
from drawing import new_axes, of_kind, picture, title_of
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgb

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentContext,
    AccidentEvaluator,
    DetectedBoxes,
    MotionEvaluator,
    MotionOutput,
    box_truth,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.accident.scoring import ComparedAccidents
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.outcomes import (
    draw_accident_outcome,
    draw_detection_outcome,
    motion_outcome,
    render_evaluation,
)
from deepaccident_devkit.render.outcomes.above import difference_words, verdict_words
from deepaccident_devkit.render.styles import OUTCOME_COLORS
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID


def test_accidents_without_truth(da_motion: DeepAccident) -> None:
    normal = next(scenario for scenario in da_motion.scenario if not scenario["collision"])
    token = da_motion.get_sample(normal, "ego_vehicle", 5)["token"]
    alarm = Accident(positions=np.array([[5.0, 0.0], [7.0, 0.0]]), time=1.0)
    figure = render_evaluation(da_motion, token, [alarm], fig=detached_figure((9, 5)))
    assert title_of(figure).endswith("5 m: FP, 10 m: FP, 15 m: FP")
    assert [ax.get_title() for ax in figure.axes] == [
        "ego, front",
        "no accident comes, one is foreseen in 1.0 s",
    ]
    nothing = ComparedAccidents(true=None, predicted=())
    assert difference_words(nothing) == "no accident comes, none is foreseen"
    assert not draw_accident_outcome(nothing, ax=new_axes()).lines


def test_the_verdict_names_several_of_a_kind(da_motion: DeepAccident, sample: str) -> None:
    evaluator = AccidentEvaluator("boxes")
    far = Accident(positions=np.array([[40.0, 40.0], [42.0, 40.0]]), time=1.0)
    evaluator.update(
        sample,
        [far, replace(far, score=0.5)],
        None,
        AccidentContext(truth=box_truth(da_motion, sample)),
    )
    assert verdict_words(evaluator.compute()) == "5 m: 2 FP + FN, 10 m: 2 FP + FN, 15 m: 2 FP + FN"


def test_detections_are_coloured_by_their_matches(da_motion: DeepAccident, sample: str) -> None:
    truth = detection_truth(da_motion, sample, "paper")
    truth = truth.select(
        (np.abs(truth.center[:, :2]) < 50).all(axis=1)
    )  # well within the protocol's area
    some = np.arange(2, len(truth))
    center = np.vstack([truth.center[some] + (0.3, 0.0, 0.0), [[20.0, -45.0, 0.0]]])
    detected = DetectedBoxes.from_arrays(
        center,
        np.vstack([truth.size[some], [[4.0, 2.0, 1.5]]]),
        np.append(truth.yaw[some], 0.0),
        np.linspace(1, 0.5, len(center)),
        category=np.append(truth.category[some], 0),
        frame="lidar",
    )
    ax = draw_detection_outcome(detected, truth, "paper", ax=new_axes())
    shapes = [
        each
        for each in ax.collections
        if isinstance(each, PolyCollection) and len(each.get_paths())
    ]
    centers = {
        to_hex(each.get_edgecolor()[0]): [
            path.vertices[:4].mean(axis=0) for path in each.get_paths()
        ]
        for each in shapes
    }
    np.testing.assert_allclose(centers[OUTCOME_COLORS["false"]], [(20, -45)])
    np.testing.assert_allclose(centers[OUTCOME_COLORS["missed"]], truth.center[:2, :2], atol=1e-6)
    assert len(centers[OUTCOME_COLORS["right"]]) == len(some)


def damaged(labels: MotionLabels) -> MotionOutput:
    """The labels without one instance, with one too many, and with one that is four cells off in
    later frames.
    """
    instance = np.where(labels.instance == 3, 0, labels.instance)
    instance[:, 2:8, 2:12] = 90
    moved = instance[1:] == 4
    instance[1:][moved] = 0
    instance[1:][np.roll(moved, 4, axis=-2)] = 4
    return instances_of(instance, labels.config.grid)


def test_motion_outcomes_are_those_that_are_counted(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    output, evaluator = damaged(labels), MotionEvaluator("released")
    evaluator.update(sample, output, labels)
    outcome, counted = motion_outcome(output, labels), evaluator.compute().ranges["100x100"]
    assert len(outcome.matches) == counted.true_positive
    for side, instance, total in (
        ("true", labels.instance, counted.false_negative),
        ("predicted", outcome.predicted.instance, counted.false_positive),
    ):
        cells = outcome.outcomes(side)  # type: ignore[arg-type]
        wrong = [np.unique(here[kind == 2]) for here, kind in zip(instance, cells, strict=False)]
        assert sum(map(len, wrong)) == total > 0
    figure = render_evaluation(da_motion, sample, output, fig=detached_figure((10, 6)))
    left, right = figure.axes
    missed = picture(left)[labels.instance[0] == 3]
    np.testing.assert_allclose(missed, np.tile(to_rgb(OUTCOME_COLORS["missed"]), (len(missed), 1)))
    np.testing.assert_allclose(picture(right)[4, 4], to_rgb(OUTCOME_COLORS["false"]))


def test_what_lies_beyond_the_range_is_not_judged(
    labels: MotionLabels, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deepaccident_devkit.render.outcomes.above.RANGES", {"30x30": 30.0})
    cells = motion_outcome(instances_of(labels.instance, labels.config.grid), labels).outcomes(
        "true"
    )
    assert set(np.unique(cells[0][labels.instance[0] > 0]).tolist()) == {1, 3}


def test_actors_stand_where_the_truth_has_them(da_motion: DeepAccident, sample: str) -> None:
    truth = box_truth(da_motion, sample)
    ax = draw_accident_outcome(
        ComparedAccidents(true=truth.accident, predicted=()), truth, ax=new_axes()
    )
    pair = da_motion.boxes(sample, "ego").bottom_corners()[
        da_motion.boxes(sample).actor_id == OWN_ACTOR_ID, :, :2
    ]
    shapes = [
        path.vertices[:4] for each in of_kind(ax, PolyCollection) for path in each.get_paths()
    ]
    assert np.abs(np.array(shapes) - pair).max(axis=(1, 2)).min() < 0.3
