"""Verdicts on a sample's prediction: whose rules decide, and with which truth."""

import numpy as np
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentEvaluator,
    DetectedBoxes,
    MotionEvaluator,
    accident_context,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.outcomes import sample_verdict
from deepaccident_devkit.render.outcomes.above import verdict_words
from deepaccident_devkit.render.outcomes.evaluation import AccidentVerdict, DetectionVerdict, MotionVerdict, judged_as


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
