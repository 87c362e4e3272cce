"""What protocols say of single predictions."""

import numpy as np
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import (
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
from deepaccident_devkit.render.outcomes.verdicts import (
    AccidentVerdict,
    DetectionVerdict,
    MotionVerdict,
    judged_as,
)


def test_a_prediction_is_judged_in_its_own_task(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    motion, boxes = instances_of(labels.instance, labels.config.grid), da_motion.boxes(sample)
    detected = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
    for given, task, judged in (
        (motion, None, (motion, "motion")),
        (motion, "accident", (motion, "accident")),
        (iter([]), None, ([], "accident")),
        (detected, None, (detected, "detection")),
    ):
        assert judged_as(given, task) == judged
    assert_refused(
        (lambda: judged_as(detected, "motion"), ChoiceError, ("task", "detection", "'motion'")),
        (
            lambda: judged_as(boxes, None),
            EvaluationError,
            ("prediction", "a MotionOutput or a list of Accidents"),
        ),
    )


def test_motion_is_judged_by_the_released_rules(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    output, context = (
        instances_of(np.roll(labels.instance, 2, axis=-1), labels.config.grid),
        accident_context,
    )
    counted, alarms = MotionEvaluator("released"), AccidentEvaluator("released")
    counted.update(sample, output, da_motion.motion_labels(sample))
    alarms.update(sample, output, labels, context(da_motion, sample, 2.0))
    verdict, within = sample_verdict(da_motion, sample, output), counted.compute().ranges["100x100"]
    counts = f"{within.true_positive} TP, {within.false_positive} FP, {within.false_negative} FN"
    assert isinstance(verdict, MotionVerdict)
    assert verdict.words.split("; ")[1].endswith(f"PQ {within.pq:.1f} %, {counts}")
    assert len(verdict.outcome.matches) == within.true_positive
    how = {"task": "accident", "label": labels}
    seen, other = (
        sample_verdict(da_motion, sample, output, **how, **more)
        for more in ({}, {"protocol": "boxes"})
    )
    assert {type(seen), type(other)} == {AccidentVerdict}
    assert seen.words == f"accident: {verdict_words(alarms.compute())}"
    assert [each.compared.true.ids is not None for each in (seen, other)] == [False, True]


def test_detections_are_judged_in_the_frame_of_the_protocol(
    da_motion: DeepAccident, sample: str
) -> None:
    truth = detection_truth(da_motion, sample, "paper")
    world = truth.transform(da_motion.world_from(sample, truth.frame), "world")
    given = DetectedBoxes(boxes=world, scores=np.ones(len(world)))
    verdict = sample_verdict(da_motion, sample, given, protocol="paper")
    assert isinstance(verdict, DetectionVerdict)
    assert verdict.detected.boxes.frame == verdict.rules.frame == truth.frame
    np.testing.assert_allclose(verdict.detected.boxes.center, truth.center, atol=1e-6)
    assert verdict.matches.detection.tolist() == verdict.matches.truth.tolist()
    assert len(verdict.matches.truth) > 5
