"""What holds of every evaluator, on the labels of a synthetic release: order, parts, pauses,
nothing and perfection.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

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

MOTION: dict[str, Callable[[], Evaluator[Any]]] = {
    "motion released": MotionEvaluator,
    "motion paper": lambda: MotionEvaluator("paper"),
}
ACCIDENT = {
    f"accident {name}": lambda name=name: AccidentEvaluator(name)
    for name in ("released", "paper", "boxes")
}
DETECTION = {
    **{
        f"detection {name}": lambda name=name: DetectionEvaluator(name)
        for name in DETECTION_PROTOCOLS
    },
    "detection opencood by sample": lambda: DetectionEvaluator("opencood", global_sort=False),
}
ALL = {**MOTION, **ACCIDENT, **DETECTION}
of_all = pytest.mark.parametrize("name", ALL)


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """Of two agents, from 2 s to 0.5 s before the accident."""
    return [
        token
        for token in da_motion.samples("train", "evaluate")
        if token.split("/")[-2] in ("ego_vehicle", "infrastructure")
    ]


class Samples:
    """What each kind of evaluator takes of a sample."""

    def __init__(self, dataset: DeepAccident, tokens: Sequence[str]) -> None:
        self.dataset = dataset
        self.labels = {
            token: dataset.motion_labels(token).to_present("bilinear") for token in tokens
        }
        self.contexts = {token: accident_context(dataset, token, 2.0) for token in tokens}

    def given(self, how: str, name: str, token: str) -> Sequence[Any]:
        """Predictions with their truth: the truth itself (`perfect`, motion as instance maps),
        nothing (`empty`), or `some` that are neither right nor wrong: of another sample, or all a
        little off."""
        if name in MOTION | ACCIDENT:
            label, other = self.labels[token], self.labels[min(self.labels)]
            output = instances_of(label.instance * (how == "perfect"), label.config.grid)
            if how == "some":
                output = MotionOutput(
                    grid=label.config.grid,
                    heads=tuple(map(MotionHeads.from_labels, (label, other))),
                )
            return (output, label, *([self.contexts[token]] if name in ACCIDENT else []))
        truth = detection_truth(self.dataset, token, DETECTION[name]().protocol)
        source, share = (
            np.random.default_rng(int(token[-3:])),
            {"perfect": 1.0, "empty": 0.0, "some": 0.8}[how],
        )
        boxes = truth.select(source.uniform(size=len(truth)) < share)
        off = source.normal(0, 0.5, (len(boxes), 3)) * (how == "some")
        scores = (
            np.round(source.uniform(size=len(boxes)), 1) if how == "some" else np.ones(len(boxes))
        )
        return DetectedBoxes(boxes=replace(boxes, center=boxes.center + off), scores=scores), truth

    def evaluated(self, how: str, name: str, tokens: Sequence[str]) -> Evaluator[Any]:
        evaluator = ALL[name]()
        for token in tokens:
            evaluator.update(token, *self.given(how, name, token))
        return evaluator


@pytest.fixture(scope="module")
def samples(da_motion: DeepAccident, tokens: list[str]) -> Samples:
    return Samples(da_motion, tokens)


@pytest.mark.slow
@of_all
def test_order_parts_and_pauses_change_no_bit(
    samples: Samples, tokens: list[str], name: str, tmp_path: Path
) -> None:
    arguments = {token: samples.given("some", name, token) for token in tokens}
    whole = samples.evaluated("some", name, tokens)
    expected = bits(whole.compute())
    shuffled = np.random.default_rng(1).permutation(tokens).tolist()
    for parts in (1, 3):
        merged = ALL[name]()
        for part in range(parts):
            evaluator = ALL[name]()
            for token in shuffled[part::parts]:
                evaluator.update(token, *arguments[token])
            path = evaluator.save(tmp_path / f"{part}.json")
            merged.merge(ALL[name]().resume(path) if part % 2 == 0 else evaluator)
        assert bits(merged.compute()) == expected
        assert bits(merged.compute(tokens[:3])) == bits(whole.compute(tokens[:3]))
        assert not merged.repeated
    resumed = ALL[name]().resume(whole.save(tmp_path / "whole.json"))
    resumed.update(tokens[0], *arguments[tokens[0]])
    assert resumed.repeated == {tokens[0]}
    assert bits(resumed.compute()) == expected


@of_all
def test_counts_are_json_and_pooled_they_have_the_same_result(
    samples: Samples, tokens: list[str], name: str
) -> None:
    evaluator = samples.evaluated("some", name, tokens[::3])
    counts = [evaluator.counts[token] for token in tokens[::3]]
    assert json.loads(json.dumps(counts, allow_nan=False)) == counts
    assert bits(evaluator.result_of(evaluator.pooled(counts))) == bits(evaluator.compute())


@of_all
def test_empty_predictions_score_0(samples: Samples, tokens: list[str], name: str) -> None:
    evaluator = samples.evaluated("empty", name, tokens)
    result = evaluator.compute()
    if name in MOTION:
        assert [
            value
            for each in result.ranges.values()
            for value in (each.iou, each.pq, each.sq, each.rq)
        ] == [0] * 8
        assert (result.path_accuracy, result.paths) == (0, 0)
    elif name in ACCIDENT:
        assert (result.positives > 0, result.apa) == (True, 0)
        assert [(each.tp, each.fp, each.fn) for each in result.within.values()] == [
            (0, 0, result.positives)
        ] * 3
    else:
        assert result.mean_average_precision == 0
    for some in ((), tokens[:1]):
        evaluator.compute(some)  # of nothing at all, too
    ALL[name]().compute()


@pytest.mark.parametrize("name", MOTION | DETECTION)
@pytest.mark.parametrize("given", [None, np.zeros((2, 5, 200, 200), dtype=int)])
def test_predictions_that_are_none(
    samples: Samples, tokens: list[str], name: str, given: object
) -> None:
    prediction, truth = samples.given("perfect", name, tokens[0])
    update, wrong = ALL[name]().update, type(given).__name__
    kind, of_truth = (
        ("a MotionOutput", "MotionLabels") if name in MOTION else ("DetectedBoxes", "Boxes")
    )
    error = EvaluationError if name in MOTION else GeometryError
    assert_refused(
        (
            lambda: update(tokens[0], given, truth),
            EvaluationError,
            (f"expected {kind}", "from_arrays(", wrong),
        ),
        (lambda: update(tokens[0], prediction, given), error, (f"expected {of_truth}", wrong)),
    )


@of_all
def test_perfect_predictions(samples: Samples, tokens: list[str], name: str) -> None:
    result = samples.evaluated("perfect", name, tokens).compute()
    if name in MOTION:
        assert [
            value
            for each in result.ranges.values()
            for value in (each.iou, each.pq, each.sq, each.rq)
        ] == [100] * 8
        assert (result.min_ade, result.min_fde, result.miss_rate, result.path_accuracy) == (
            0,
            0,
            0,
            1,
        )
    elif name == "accident paper":
        assert (result.apa, result.id_error, result.position_error, result.time_error) == (
            1,
            0,
            0,
            0,
        )
        assert [(each.tp > 0, each.fp, each.fn) for each in result.within.values()] == [
            (True, 0, 0)
        ] * 3
    elif name.startswith("detection opencood"):
        assert result.mean_average_precision == pytest.approx(100, abs=1e-9)
    elif name in DETECTION:
        # The released curve counts what has no truth as 0, and no recall exceeds the last of its 36
        # points. So the mean says how many classes a scene has; each class that it has says what is
        # lost.
        assert result.average_precision[result.truths > 0].min() > 97


def bits(value: Any) -> Any:
    """A result to its last bit, whatever the order of its mappings."""
    if is_dataclass(value):
        return type(value).__name__, [
            (field.name, bits(getattr(value, field.name))) for field in fields(value)
        ]
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, dict):
        return sorted((str(key), bits(each)) for key, each in value.items())
    if isinstance(value, list | tuple):
        return [bits(each) for each in value]
    if isinstance(value, float):
        return "nan" if math.isnan(value) else value.hex()
    return value
