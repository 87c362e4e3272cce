"""How the protocols judge single predictions."""

import numpy as np
from support.expected_errors import assert_raises

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
    check_judged_prediction,
)


def test_a_prediction_is_judged_in_its_own_task(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    motion = instances_of(labels.instance, labels.config.grid)
    boxes = da_motion.boxes(sample)
    detected = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))

    for prediction, task, expected in (
        (motion, None, (motion, "motion")),
        (motion, "accident", (motion, "accident")),
        (iter([]), None, ([], "accident")),
        (detected, None, (detected, "detection")),
    ):
        assert check_judged_prediction(prediction, task) == expected
    assert_raises(
        (
            lambda: check_judged_prediction(detected, "motion"),
            ChoiceError,
            ("task", "detection", "'motion'"),
        ),
        (
            lambda: check_judged_prediction(boxes, None),
            EvaluationError,
            ("prediction", "a MotionOutput or a list of Accidents"),
        ),
    )


def test_motion_is_judged_by_the_released_rules(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    output = instances_of(np.roll(labels.instance, 2, axis=-1), labels.config.grid)
    evaluator = MotionEvaluator("released")
    evaluator.update(sample, output, da_motion.motion_labels(sample))
    result = evaluator.compute().ranges["100x100"]

    verdict = sample_verdict(da_motion, sample, output)

    counts = f"{result.true_positive} TP, {result.false_positive} FP, {result.false_negative} FN"
    assert isinstance(verdict, MotionVerdict)
    assert verdict.words.split("; ")[1].endswith(f"PQ {result.pq:.1f} %, {counts}")
    assert len(verdict.outcome.matches) == result.true_positive

    alarms = AccidentEvaluator("released")
    alarms.update(sample, output, labels, accident_context(da_motion, sample, 2.0))
    released, boxes = (
        sample_verdict(da_motion, sample, output, task="accident", label=labels, **options)
        for options in ({}, {"protocol": "boxes"})
    )
    assert type(released) is type(boxes) is AccidentVerdict
    assert released.words == f"accident prediction: {verdict_words(alarms.compute())}"
    assert released.compared.true.ids is None
    assert boxes.compared.true.ids is not None


def test_detections_are_judged_in_the_frame_of_the_protocol(
    da_motion: DeepAccident, sample: str
) -> None:
    truth = detection_truth(da_motion, sample, "paper")
    boxes = truth.transform(da_motion.world_from(sample, truth.frame), "world")
    detected = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
    verdict = sample_verdict(da_motion, sample, detected, protocol="paper")

    assert isinstance(verdict, DetectionVerdict)
    assert verdict.detected.boxes.frame == verdict.rules.frame == truth.frame
    np.testing.assert_allclose(verdict.detected.boxes.center, truth.center, atol=1e-6)
    assert verdict.matches.detection.tolist() == verdict.matches.truth.tolist()
    assert len(verdict.matches.truth) > 5
