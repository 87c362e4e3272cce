"""Accident predictions from above: positions, distances in metres and words."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgb
from support.rendered_pixels import collections_of_kind, first_image, new_axes, read_title
from support.replay_page import normal_scenario

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


def test_accidents_foreseen_where_none_comes(da_motion: DeepAccident) -> None:
    token = da_motion.get_sample(normal_scenario(da_motion), "ego_vehicle", 5)["token"]
    alarm = Accident(positions=np.array([[5.0, 0.0], [7.0, 0.0]]), time=1.0)
    figure = render_evaluation(da_motion, token, [alarm], fig=detached_figure((9, 5)))
    assert read_title(figure).endswith("FP within 5/10/15 m")
    assert [ax.get_title() for ax in figure.axes] == [
        "ego, front",
        "no collision within the horizon,\nbut predicted in 1.0 s",
    ]

    no_accident = ComparedAccidents(true=None, predicted=())
    assert difference_words(no_accident) == "no collision within the horizon"
    assert not draw_accident_outcome(no_accident, ax=new_axes()).lines


def test_the_verdict_names_several_of_a_kind(da_motion: DeepAccident, sample: str) -> None:
    far = Accident(positions=np.array([[40.0, 40.0], [42.0, 40.0]]), time=1.0)
    alarms = [far, replace(far, score=0.5)]
    context = AccidentContext(truth=box_truth(da_motion, sample))
    evaluator = AccidentEvaluator("boxes")
    evaluator.update(sample, alarms, None, context)
    assert verdict_words(evaluator.compute()) == "2 FP + FN within 5/10/15 m"


def test_detections_are_coloured_by_their_matches(da_motion: DeepAccident, sample: str) -> None:
    truth = detection_truth(da_motion, sample, "paper")
    is_near = (np.abs(truth.center[:, :2]) < 50).all(axis=1)  # well within the protocol's area
    truth = truth.select(is_near)
    matched = truth.select(np.arange(2, len(truth)))
    center = np.vstack([matched.center + np.array([0.3, 0.0, 0.0]), [[20.0, -45.0, 0.0]]])
    detected = DetectedBoxes.from_arrays(
        center,
        np.vstack([matched.size, [[4.0, 2.0, 1.5]]]),
        np.append(matched.yaw, 0.0),
        np.linspace(1, 0.5, len(center)),
        category=np.append(matched.category, 0),
        frame="lidar",
    )

    ax = draw_detection_outcome(detected, truth, "paper", ax=new_axes())

    centers = {}
    for shape in ax.collections:
        if isinstance(shape, PolyCollection) and len(shape.get_paths()):
            color = to_hex(shape.get_edgecolor()[0])
            centers[color] = [path.vertices[:4].mean(axis=0) for path in shape.get_paths()]
    np.testing.assert_allclose(centers[OUTCOME_COLORS["false"]], [(20, -45)])
    np.testing.assert_allclose(centers[OUTCOME_COLORS["missed"]], truth.center[:2, :2], atol=1e-6)
    assert len(centers[OUTCOME_COLORS["right"]]) == len(matched)


def damage_instances(labels: MotionLabels) -> MotionOutput:
    """Predict the labels without instance 3, with an extra instance 90, and with instance 4 off by
    four cells in later frames.
    """
    instance = np.where(labels.instance == 3, 0, labels.instance)
    instance[:, 2:8, 2:12] = 90
    is_moved = instance[1:] == 4
    instance[1:][is_moved] = 0
    instance[1:][np.roll(is_moved, 4, axis=-2)] = 4
    return instances_of(instance, labels.config.grid)


def test_motion_outcomes_agree_with_the_counts(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    output = damage_instances(labels)
    evaluator = MotionEvaluator("released")
    evaluator.update(sample, output, labels)
    counts = evaluator.compute().ranges["100x100"]

    outcome = motion_outcome(output, labels)

    assert len(outcome.matches) == counts.true_positive
    for side, instance, expected in (
        ("true", labels.instance, counts.false_negative),
        ("predicted", outcome.predicted.instance, counts.false_positive),
    ):
        num_wrong = 0
        for ids, kinds in zip(instance, outcome.outcomes(side), strict=False):  # type: ignore[arg-type]
            num_wrong += len(np.unique(ids[kinds == 2]))
        assert num_wrong == expected > 0

    figure = render_evaluation(da_motion, sample, output, fig=detached_figure((10, 6)))
    left, right = figure.axes
    missed_cells = first_image(left)[labels.instance[0] == 3]
    missed_color = to_rgb(OUTCOME_COLORS["missed"])
    np.testing.assert_allclose(missed_cells, np.tile(missed_color, (len(missed_cells), 1)))
    np.testing.assert_allclose(first_image(right)[4, 4], to_rgb(OUTCOME_COLORS["false"]))


def test_what_lies_beyond_the_range_is_not_judged(
    labels: MotionLabels, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deepaccident_devkit.render.outcomes.above.RANGES", {"30x30": 30.0})
    outcome = motion_outcome(instances_of(labels.instance, labels.config.grid), labels)
    kinds = outcome.outcomes("true")[0]
    assert set(np.unique(kinds[labels.instance[0] > 0]).tolist()) == {1, 3}


def test_actors_are_drawn_where_the_truth_has_them(da_motion: DeepAccident, sample: str) -> None:
    truth = box_truth(da_motion, sample)
    compared = ComparedAccidents(true=truth.accident, predicted=())
    ax = draw_accident_outcome(compared, truth, ax=new_axes())

    boxes = da_motion.boxes(sample, "ego")
    own_corners = boxes.bottom_corners()[boxes.actor_id == OWN_ACTOR_ID, :, :2]
    drawn_corners = []
    for shape in collections_of_kind(ax, PolyCollection):
        drawn_corners += [path.vertices[:4] for path in shape.get_paths()]
    assert np.abs(np.array(drawn_corners) - own_corners).max(axis=(1, 2)).min() < 0.3
