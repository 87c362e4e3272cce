"""Laws of every evaluator, on the labels of a synthetic release: order, parts, resumed runs, empty
and perfect predictions.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.evaluation import (
    AccidentEvaluator,
    DetectedBoxes,
    DetectionEvaluator,
    Evaluator,
    MotionEvaluator,
    MotionOutput,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.accident import accident_context
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS
from deepaccident_devkit.motion import MotionHeads

MOTION_EVALUATORS: dict[str, Callable[[], Evaluator[Any]]] = {
    "motion released": MotionEvaluator,
    "motion paper": lambda: MotionEvaluator("paper"),
}
ACCIDENT_EVALUATORS = {
    f"accident {name}": lambda name=name: AccidentEvaluator(name)
    for name in ("released", "paper", "boxes")
}
DETECTION_EVALUATORS = {
    **{
        f"detection {name}": lambda name=name: DetectionEvaluator(name)
        for name in DETECTION_PROTOCOLS
    },
    "detection opencood by sample": lambda: DetectionEvaluator("opencood", global_sort=False),
}
EVALUATORS = {**MOTION_EVALUATORS, **ACCIDENT_EVALUATORS, **DETECTION_EVALUATORS}
for_every_evaluator = pytest.mark.parametrize("name", EVALUATORS)


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """Select samples of two agents, from 2 s to 0.5 s before the accident."""
    return [
        token
        for token in da_motion.samples("train", "evaluate")
        if token.split("/")[-2] in ("ego_vehicle", "infrastructure")
    ]


class SampleArguments:
    """Arguments of each kind of evaluator, by sample, with predictions of a quality.

    The quality `perfect` is the truth itself (motion as instance maps), `empty` is nothing, and
    `some` is neither right nor wrong: of another sample, or all a little off.
    """

    def __init__(self, dataset: DeepAccident, tokens: Sequence[str]) -> None:
        self.dataset = dataset
        self.labels = {
            token: dataset.motion_labels(token).to_present("bilinear") for token in tokens
        }
        self.contexts = {token: accident_context(dataset, token, 2.0) for token in tokens}

    def arguments(self, quality: str, name: str, token: str) -> Sequence[Any]:
        """Return a prediction and its truth."""
        if name in DETECTION_EVALUATORS:
            return self.detection_arguments(quality, name, token)

        label = self.labels[token]
        grid = label.config.grid
        if quality == "some":
            other_label = self.labels[min(self.labels)]
            heads = tuple(map(MotionHeads.from_labels, (label, other_label)))
            output = MotionOutput(grid=grid, heads=heads)
        else:
            output = instances_of(label.instance * (quality == "perfect"), grid)
        if name in ACCIDENT_EVALUATORS:
            return output, label, self.contexts[token]
        return output, label

    def detection_arguments(self, quality: str, name: str, token: str) -> Sequence[Any]:
        truth = detection_truth(self.dataset, token, DETECTION_EVALUATORS[name]().protocol)
        if quality == "perfect":
            return DetectedBoxes(boxes=truth, scores=np.ones(len(truth))), truth
        if quality == "empty":
            boxes = truth.select(np.zeros(len(truth), dtype=bool))
            return DetectedBoxes(boxes=boxes, scores=np.ones(0)), truth

        generator = np.random.default_rng(int(token[-3:]))
        boxes = truth.select(generator.uniform(size=len(truth)) < 0.8)
        center = boxes.center + generator.normal(0, 0.5, (len(boxes), 3))
        scores = np.round(generator.uniform(size=len(boxes)), 1)
        return DetectedBoxes(boxes=replace(boxes, center=center), scores=scores), truth

    def evaluate(self, quality: str, name: str, tokens: Sequence[str]) -> Evaluator[Any]:
        evaluator = EVALUATORS[name]()
        for token in tokens:
            evaluator.update(token, *self.arguments(quality, name, token))
        return evaluator


@pytest.fixture(scope="module")
def samples(da_motion: DeepAccident, tokens: list[str]) -> SampleArguments:
    return SampleArguments(da_motion, tokens)


@pytest.mark.slow
@for_every_evaluator
def test_order_parts_and_resuming_change_no_bit(
    samples: SampleArguments, tokens: list[str], name: str, tmp_path: Path
) -> None:
    arguments = {token: samples.arguments("some", name, token) for token in tokens}
    whole = samples.evaluate("some", name, tokens)
    expected = bits_of(whole.compute())
    shuffled = np.random.default_rng(1).permutation(tokens).tolist()

    for parts in (1, 3):
        merged = EVALUATORS[name]()
        for part in range(parts):
            evaluator = EVALUATORS[name]()
            for token in shuffled[part::parts]:
                evaluator.update(token, *arguments[token])
            path = evaluator.save(tmp_path / f"{part}.json")
            if part % 2 == 0:
                evaluator = EVALUATORS[name]().resume(path)
            merged.merge(evaluator)
        assert bits_of(merged.compute()) == expected
        assert bits_of(merged.compute(tokens[:3])) == bits_of(whole.compute(tokens[:3]))
        assert not merged.repeated

    resumed = EVALUATORS[name]().resume(whole.save(tmp_path / "whole.json"))
    resumed.update(tokens[0], *arguments[tokens[0]])
    assert resumed.repeated == {tokens[0]}
    assert bits_of(resumed.compute()) == expected


@for_every_evaluator
def test_counts_are_json_and_pooled_counts_have_the_same_result(
    samples: SampleArguments, tokens: list[str], name: str
) -> None:
    evaluator = samples.evaluate("some", name, tokens[::3])
    counts = [evaluator.counts[token] for token in tokens[::3]]

    assert json.loads(json.dumps(counts, allow_nan=False)) == counts
    assert bits_of(evaluator.result_of(evaluator.pooled(counts))) == bits_of(evaluator.compute())


def qualities_of(result: Any) -> list[float]:
    """Return IoU and the three panoptic qualities of both ranges."""
    values = []
    for part in result.ranges.values():
        values += [part.iou, part.pq, part.sq, part.rq]
    return values


@for_every_evaluator
def test_empty_predictions_score_0(samples: SampleArguments, tokens: list[str], name: str) -> None:
    evaluator = samples.evaluate("empty", name, tokens)
    result = evaluator.compute()
    if name in MOTION_EVALUATORS:
        assert qualities_of(result) == [0] * 8
        assert (result.path_accuracy, result.paths) == (0, 0)
    elif name in ACCIDENT_EVALUATORS:
        assert result.positives > 0
        assert result.apa == 0
        cases = [(within.tp, within.fp, within.fn) for within in result.within.values()]
        assert cases == [(0, 0, result.positives)] * 3
    else:
        assert result.mean_average_precision == 0

    for some_tokens in ((), tokens[:1]):
        evaluator.compute(some_tokens)  # no samples have a result, too

    EVALUATORS[name]().compute()


@pytest.mark.parametrize("name", MOTION_EVALUATORS | DETECTION_EVALUATORS)
@pytest.mark.parametrize("other", [None, np.zeros((2, 5, 200, 200), dtype=int)])
def test_arguments_of_another_kind_are_refused(
    samples: SampleArguments, tokens: list[str], name: str, other: object
) -> None:
    prediction, truth = samples.arguments("perfect", name, tokens[0])
    update = EVALUATORS[name]().update
    if name in MOTION_EVALUATORS:
        prediction_kind, truth_kind = "a MotionOutput", "MotionLabels"
        error: type[Exception] = EvaluationError
    else:
        prediction_kind, truth_kind = "DetectedBoxes", "Boxes"
        error = GeometryError

    other_kind = type(other).__name__
    assert_raises(
        (
            lambda: update(tokens[0], other, truth),
            EvaluationError,
            (f"expected {prediction_kind}", "from_arrays(", other_kind),
        ),
        (
            lambda: update(tokens[0], prediction, other),
            error,
            (f"expected {truth_kind}", other_kind),
        ),
    )


@for_every_evaluator
def test_perfect_predictions(samples: SampleArguments, tokens: list[str], name: str) -> None:
    result = samples.evaluate("perfect", name, tokens).compute()
    if name in MOTION_EVALUATORS:
        assert qualities_of(result) == [100] * 8
        assert (result.min_ade, result.min_fde, result.miss_rate) == (0, 0, 0)
        assert result.path_accuracy == 1
    elif name == "accident paper":
        assert result.apa == 1
        assert (result.id_error, result.position_error, result.time_error) == (0, 0, 0)
        cases = [(within.tp > 0, within.fp, within.fn) for within in result.within.values()]
        assert cases == [(True, 0, 0)] * 3
    elif name.startswith("detection opencood"):
        assert result.mean_average_precision == pytest.approx(100, abs=1e-9)
    elif name in DETECTION_EVALUATORS:
        # The released curve scores a class without truth as 0, so the mean depends on the classes
        # of the scene. No recall exceeds the last of its 36 points, so a perfect class stays
        # below 100.
        assert result.average_precision[result.truths > 0].min() > 97


def bits_of(value: Any) -> Any:
    """Return a result to its last bit, whatever the order of its mappings."""
    if is_dataclass(value):
        field_values = [
            (field.name, bits_of(getattr(value, field.name))) for field in fields(value)
        ]
        return type(value).__name__, field_values
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, dict):
        return sorted((str(key), bits_of(item)) for key, item in value.items())
    if isinstance(value, list | tuple):
        return [bits_of(item) for item in value]
    if isinstance(value, float):
        return "nan" if math.isnan(value) else value.hex()
    return value
