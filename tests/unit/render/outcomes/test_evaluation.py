"""Predictions beside labels, with the verdict of a protocol."""

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from drawing import title_of
from matplotlib import pyplot as plt
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.contour import ContourSet
from numpy.testing import assert_allclose
from picture_texts import text_faults
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentEvaluator,
    DetectedBoxes,
    MotionEvaluator,
    accident_context,
    box_truth,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.accident import PROTOCOLS, compared_accidents
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.boxes import collider_ids
from deepaccident_devkit.render.outcomes import sample_verdict
from deepaccident_devkit.render.outcomes.above import verdict_words
from deepaccident_devkit.render.outcomes.evaluation import (
    AccidentVerdict,
    DetectionVerdict,
    MotionVerdict,
    judged_as,
    render_evaluation,
)
from deepaccident_devkit.render.styles import COLLIDER_COLOR


def test_accidents_have_their_metres_and_verdict(da_motion: DeepAccident, sample: str) -> None:
    true = box_truth(da_motion, sample).accident
    assert true is not None
    near = Accident(positions=true.positions + np.array([3.0, 0.0]), time=true.time + 0.5, score=0.9)
    figure = render_evaluation(da_motion, sample, [near], fig=detached_figure((10, 6)))
    left, right = figure.axes
    assert title_of(figure).endswith("accident: 5 m: FP + FN, 10 m: TP, 15 m: TP")
    assert right.get_title() == f"an accident comes in {true.time:.1f} s;\nforeseen 6.0 m off in sum, +0.5 s"
    assert [text.get_text() for text in right.texts] == [f"in {near.time:.1f} s, score 0.9", "3.0 m", "3.0 m"]
    assert_allclose(left.lines[0].get_xydata(), true.positions)
    assert_allclose(right.lines[1].get_xydata(), near.positions)
    assert left.get_xlim() == right.get_xlim()
    assert not left.texts
    silent = render_evaluation(da_motion, sample, [], fig=detached_figure((10, 6)))
    assert title_of(silent).endswith("5 m: FN, 10 m: FN, 15 m: FN")
    assert silent.axes[1].get_title().endswith("none is foreseen")


@pytest.mark.parametrize("protocol", ["released", "paper", "boxes"])
def test_motion_is_seen_as_accidents_by_every_protocol(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, protocol: str
) -> None:
    instance = np.zeros_like(labels.instance)
    for frame, step in enumerate((0, 4, 8, 8, 8)):  # two that drive into each other
        instance[frame, 100:104, 110 + step : 118 + step] = 1
        instance[frame, 102:106, 139 - 2 * step : 147 - 2 * step] = 2
    output = instances_of(instance, labels.config.grid)
    figure = render_evaluation(
        da_motion, sample, output, task="accident", protocol=protocol, fig=detached_figure((9, 5))
    )
    context = accident_context(da_motion, sample, 2.0)
    rules = PROTOCOLS[protocol]
    evaluator = AccidentEvaluator(rules)
    evaluator.update(sample, output, labels, context)
    assert title_of(figure).endswith(verdict_words(evaluator.compute()))
    compared = compared_accidents(output, labels, context, rules)
    assert len(compared.predicted) == 1
    true, predicted = (2 * [compared.true.positions] if compared.true else []), compared.predicted[0].positions
    drawn = [line.get_xydata() for ax in figure.axes for line in ax.lines if line.get_marker() == "o"]
    assert_allclose(drawn, true)
    crosses = [line.get_xydata() for line in figure.axes[1].lines if line.get_marker() == "x"]
    assert_allclose(crosses, [predicted])


def test_the_pair_that_collides_is_red_in_every_task(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    ids = collider_ids(da_motion, sample)
    assert len(ids) == 2
    boxes = da_motion.boxes(sample)
    detected = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
    accident = box_truth(da_motion, sample).accident
    assert accident is not None
    for prediction in (detected, [accident], instances_of(labels.instance, labels.config.grid)):
        left = render_evaluation(da_motion, sample, prediction, fig=detached_figure((10, 6))).axes[0]
        edges = [each for each in left.collections if isinstance(each, (ContourSet, PolyCollection))]
        red = [color for each in edges for color in each.get_edgecolor() if to_hex(color) == COLLIDER_COLOR]
        assert len(red) == 2


def faults_of_predictions(dataset: DeepAccident, token: str) -> list[str]:
    """What is wrong with the words of detections, and of accidents that are foreseen exactly, nearly and not at all."""
    boxes, accident = dataset.boxes(token), box_truth(dataset, token).accident
    assert accident is not None
    near = Accident(positions=accident.positions + 1.5, time=accident.time, score=0.9)
    detected = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
    faults = []
    for given in (detected, [accident], [near], []):
        picture = render_evaluation(dataset, token, given)
        faults += text_faults(picture)
        plt.close(picture)
    return faults


@pytest.mark.slow
@pytest.mark.parametrize("where", [None, "paper"])
def test_words_are_in_the_picture_and_apart(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, where: Any
) -> None:
    with style(where) if where else nullcontext():
        assert faults_of_predictions(da_motion, sample) == []
        output = instances_of(labels.instance, labels.config.grid)
        assert text_faults(render_evaluation(da_motion, sample, output)) == []


@pytest.mark.slow
def test_words_of_twelve_scenes_are_apart(da_designs: DeepAccident) -> None:
    tokens = [f"{scenario['token']}/ego_vehicle/001" for scenario in da_designs.scenario if scenario["collision"]]
    assert len(tokens) == 12
    found = {token: faults_of_predictions(da_designs, token) for token in tokens}
    assert {token: faults for token, faults in found.items() if faults} == {}


def test_a_prediction_is_judged_in_its_own_task(da_motion: DeepAccident, sample: str, labels: MotionLabels) -> None:
    motion = instances_of(labels.instance, labels.config.grid)
    boxes = da_motion.boxes(sample)
    detected = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
    assert judged_as(motion, None) == (motion, "motion")
    assert judged_as(motion, "accident") == (motion, "accident")
    assert judged_as(iter([]), None) == ([], "accident")
    assert judged_as(detected, None) == (detected, "detection")
    assert_refused(
        (
            lambda: judged_as(detected, "motion"),
            ChoiceError,
            "task of this prediction: expected one of detection, found 'motion'",
        ),
        (lambda: judged_as(boxes, None), EvaluationError, "prediction: expected a MotionOutput or a list of Accidents"),
    )


def test_motion_is_judged_by_the_released_rules(da_motion: DeepAccident, sample: str, labels: MotionLabels) -> None:
    output = instances_of(np.roll(labels.instance, 2, axis=-1), labels.config.grid)
    counted = MotionEvaluator("released")
    counted.update(sample, output, da_motion.motion_labels(sample))
    verdict = sample_verdict(da_motion, sample, output)
    assert isinstance(verdict, MotionVerdict)
    within = counted.compute().ranges["100x100"]
    assert verdict.words.split("; ")[1].endswith(
        f"PQ {within.pq:.1f} %, {within.true_positive} TP, {within.false_positive} FP, {within.false_negative} FN"
    )
    assert len(verdict.outcome.matches) == within.true_positive
    alarms = AccidentEvaluator("released")
    alarms.update(sample, output, labels, accident_context(da_motion, sample, 2.0))
    seen = sample_verdict(da_motion, sample, output, task="accident", label=labels)
    assert isinstance(seen, AccidentVerdict)
    assert seen.words == f"accident: {verdict_words(alarms.compute())}"
    other = sample_verdict(da_motion, sample, output, task="accident", label=labels, protocol="boxes")
    assert isinstance(other, AccidentVerdict)
    true = [each.compared.true for each in (seen, other)]
    assert [each is not None and each.ids is not None for each in true] == [False, True]
    assert None not in true


def test_explicit_accidents_are_judged_by_boxes(da_motion: DeepAccident, sample: str) -> None:
    context = accident_context(da_motion, sample, 2.0)
    assert context.truth is not None
    assert context.truth.accident is not None
    near = Accident(positions=context.truth.accident.positions + 1.5, time=context.truth.accident.time)
    counted = AccidentEvaluator("boxes")
    counted.update(sample, [near], None, context)
    verdict = sample_verdict(da_motion, sample, [near])
    assert isinstance(verdict, AccidentVerdict)
    assert verdict.words == f"accident: {verdict_words(counted.compute())}"
    assert verdict.compared.true is not None


def test_detections_are_judged_in_the_frame_of_the_protocol(da_motion: DeepAccident, sample: str) -> None:
    truth = detection_truth(da_motion, sample, "paper")
    world = truth.transform(da_motion.world_from(sample, truth.frame), "world")
    verdict = sample_verdict(
        da_motion, sample, DetectedBoxes(boxes=world, scores=np.ones(len(world))), protocol="paper"
    )
    assert isinstance(verdict, DetectionVerdict)
    assert verdict.detected.boxes.frame == verdict.rules.frame == truth.frame
    np.testing.assert_allclose(verdict.detected.boxes.center, truth.center, atol=1e-6)
    np.testing.assert_array_equal(verdict.matches.detection, verdict.matches.truth)
    assert len(verdict.matches.truth) > 5
