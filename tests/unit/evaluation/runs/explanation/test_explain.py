"""`explain`: one pass says what an evaluation of its own by each protocol and each changed choice says."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from memory_results import MemoryResults

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import DetectionEvaluator, MotionEvaluator
from deepaccident_devkit.evaluation.metrics.accident import accident_context
from deepaccident_devkit.evaluation.metrics.detection import DETECTION_PROTOCOLS, DetectedBoxes, detection_truth
from deepaccident_devkit.evaluation.metrics.headlines import headline_numbers
from deepaccident_devkit.evaluation.metrics.motion import MOTION_PROTOCOLS
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput, instances_of
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs.explanation import Explanation, explain
from deepaccident_devkit.evaluation.runs.explanation.explain import ExplainedNumber, _change_text
from deepaccident_devkit.evaluation.runs.explanation.variants import Refusal, SideBySide
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionHeads, MotionLabelConfig, MotionLabels

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """One time of two agents."""
    return da_motion.samples("train", "evaluate")[:8:4]


def still(label: MotionLabels) -> MotionOutput:
    """Nobody moves."""
    return instances_of(label.instance[:1].repeat(5, axis=0), label.config.grid)


def aside(label: MotionLabels) -> MotionOutput:
    """Everybody 3 m to the side."""
    return instances_of(np.roll(label.instance, 6, axis=-1), label.config.grid)


def crowded(label: MotionLabels) -> MotionOutput:
    """Heads with 25 peaks that are higher than those of the label's instances."""
    heads = MotionHeads.from_labels(label)
    centerness = heads.centerness / 2
    centerness[..., 5:55:10, 5:55:10] = 1.0
    return MotionOutput(grid=label.config.grid, heads=(replace(heads, centerness=centerness),))


def motion(dataset: DeepAccident, tokens: list[str], predict: Callable[[MotionLabels], MotionOutput]) -> MemoryResults:
    return MemoryResults("motion", {token: predict(dataset.motion_labels(token).to_present()) for token in tokens})


def detections(dataset: DeepAccident, tokens: list[str]) -> MemoryResults:
    found = {}
    for token in tokens:
        boxes = dataset.boxes(token, "world")
        source = np.random.default_rng(len(boxes))
        off = replace(boxes, center=boxes.center + source.normal(0, 0.5, (len(boxes), 3)))
        found[token] = DetectedBoxes(boxes=off, scores=source.uniform(size=len(boxes)))
    return MemoryResults("detection", found)


def value(explanation: Explanation, choice: str, headline: str) -> float | None:
    (number,) = [each for each in explanation.numbers if (each.choice, each.headline) == (choice, headline)]
    before = explanation.chosen[headline]
    if number.value is not None and before is not None:
        assert number.change == number.value - before
    return number.value


def test_protocols_and_choices_are_those_of_evaluations_of_their_own(
    da_motion: DeepAccident, tokens: list[str]
) -> None:
    results, setup = motion(da_motion, tokens, aside), EvaluationSetup(task="motion")
    found = explain(da_motion, results, setup, tokens)
    assert found.samples == 2
    for name, values in found.protocols.items():
        alone = EvaluationSetup(task="motion", protocol=name)
        assert values == evaluated(alone.evaluator(), SampleLoader(da_motion, results, alone), tokens)
    assert found.chosen == found.protocols["released"]
    switched = replace(MOTION_PROTOCOLS["released"], gate=2.0)
    alone = evaluated(MotionEvaluator(switched), SampleLoader(da_motion, results, setup), tokens)
    assert value(found, "gate=2.0", "min_ade") == alone["min_ade"] != found.chosen["min_ade"]


def evaluated(evaluator: Any, loader: Callable[[str], tuple[Any, ...]], tokens: list[str]) -> dict[str, float | None]:
    for token in tokens:
        evaluator.update(token, *loader(token))
    return headline_numbers("motion", evaluator.compute())


def test_labels_are_a_choice(da_motion: DeepAccident, tokens: list[str]) -> None:
    results, setup = motion(da_motion, tokens, still), EvaluationSetup(task="motion")
    found = explain(da_motion, results, setup, tokens)
    config = MotionLabelConfig(protocol=replace(LABEL_PROTOCOLS["released"], half_cell_shift=False))
    evaluator = MotionEvaluator(replace(MOTION_PROTOCOLS["released"], labels=None))
    alone = evaluated(
        evaluator, lambda token: (results.prediction(token), da_motion.motion_labels(token, config)), tokens
    )
    assert value(found, "labels.half_cell_shift=False", "vpq 30x30") == alone["vpq 30x30"] != found.chosen["vpq 30x30"]
    assert not [each for each in found.numbers if "ids_kept_between_samples" in each.choice]


def test_of_heads_what_reads_them_is_a_choice_and_of_maps_it_changes_nothing(
    da_motion: DeepAccident, tokens: list[str]
) -> None:
    changed = {}
    for predict in (still, crowded):
        results = motion(da_motion, tokens[:1], predict)
        found = explain(da_motion, results, EvaluationSetup(task="motion"), tokens[:1])
        changed[predict] = {each.choice for each in found.numbers if each.changed}
    assert "instances.max_centers=20" in changed[crowded] - changed[still]


def test_explicit_accidents_are_not_for_every_protocol(da_motion: DeepAccident, tokens: list[str]) -> None:
    known = {token: accident_context(da_motion, token, 2.0).truth for token in tokens}
    alarms = {token: [truth.accident] for token, truth in known.items() if truth is not None}
    setup = EvaluationSetup(task="accident", protocol="boxes")
    found = explain(da_motion, MemoryResults("accident", alarms), setup, tokens)
    assert set(found.protocols) == {"paper", "boxes"}
    assert "the protocol 'released' compares motion" in found.refused["released"]
    assert f"Cannot be counted: released: {found.refused['released']}" in found.to_text()
    assert found.chosen["apa"] == 1.0


def test_accidents_of_maps_by_released_have_labels_as_choices(da_motion: DeepAccident, tokens: list[str]) -> None:
    results = motion(da_motion, tokens, still)
    found = explain(da_motion, results, EvaluationSetup(task="accident"), tokens)
    assert {"redraw=False", "labels.warp=exact"} <= {each.choice for each in found.numbers}
    paper = EvaluationSetup(task="accident", protocol="paper")
    found = explain(da_motion, results, paper, tokens)
    assert {"reading.moment=last", "labels.warp=exact"} <= {each.choice for each in found.numbers}
    assert found.refused == {}


@pytest.mark.parametrize("protocol", DETECTION_PROTOCOLS)
def test_every_choice_of_detection_can_be_counted(da_motion: DeepAccident, tokens: list[str], protocol: str) -> None:
    results, setup = detections(da_motion, tokens), EvaluationSetup(task="detection", protocol=protocol)
    found = explain(da_motion, results, setup, tokens)
    assert found.refused == {}
    assert set(found.protocols) == set(DETECTION_PROTOCOLS)
    variants = DETECTION_PROTOCOLS[protocol].variants()
    assert {each.choice for each in found.numbers} == set(variants)
    rules = variants["own_box=False" if DETECTION_PROTOCOLS[protocol].own_box else "own_box=True"]
    evaluator = DetectionEvaluator(rules)
    for token in tokens:
        boxes = results.prediction(token).boxes.transform(
            da_motion.world_from(token, rules.frame).inverse(), rules.frame
        )
        given = DetectedBoxes(boxes=boxes, scores=results.prediction(token).scores)
        evaluator.update(token, given, detection_truth(da_motion, token, rules))
    choice = "own_box=False" if DETECTION_PROTOCOLS[protocol].own_box else "own_box=True"
    assert value(found, choice, "mAP") == evaluator.compute().mean_average_precision


def test_the_largest_change_comes_first_and_what_changes_nothing_in_one_line(
    da_motion: DeepAccident, tokens: list[str]
) -> None:
    found = explain(da_motion, detections(da_motion, tokens), EvaluationSetup(task="detection"), tokens)
    sizes = [abs(each.change or 0.0) for each in found.numbers if each.headline == "mAP"]
    assert sizes == sorted(sizes, reverse=True)
    *_, last = found.to_text().splitlines()
    assert last.startswith("No difference: ")
    same = last.removeprefix("No difference: ").split(", ")
    assert "bottom_taken_as_top=False" in same
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False))["chosen"]["mAP"] == found.chosen["mAP"]


def test_workers_and_pauses_give_the_same(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    with ResultsWriter(tmp_path / "boxes.json", "detection") as writer:
        for token, boxes in detections(da_motion, tokens).predictions.items():
            writer.add(token, boxes)
    results, setup = read_results(tmp_path / "boxes.json"), EvaluationSetup(task="detection", protocol="paper")
    saved = tmp_path / "explained.json"
    once = explain(da_motion, results, setup, tokens, checkpoint=saved)
    assert explain(da_motion, results, setup, tokens, workers=2) == once
    assert explain(da_motion, results, setup, tokens, checkpoint=saved) == once


def test_switches_are_part_of_what_is_explained(da_motion: DeepAccident, tokens: list[str]) -> None:
    setup = EvaluationSetup(task="detection", protocol="paper", switches={"points": 40})
    found = explain(da_motion, detections(da_motion, tokens), setup, tokens)
    assert found.protocol == "paper, points=40"
    assert value(found, "points=101", "mAP") == found.protocols["paper"]["mAP"] != found.chosen["mAP"]


def test_the_first_evaluator_says_what_is_an_error() -> None:
    side_by_side = SideBySide({"one": MotionEvaluator(), "other": MotionEvaluator("paper")})
    with pytest.raises(EvaluationError, match="prediction: expected a MotionOutput"):
        side_by_side.update("a", {"one": (None, None), "other": (None, None)})
    side_by_side.update("b", {"one": Refusal("not so"), "other": Refusal("nor so")})
    assert side_by_side.compute() == {"one": Refusal("not so"), "other": Refusal("nor so")}


def test_no_samples_cannot_be_explained(da_motion: DeepAccident, tokens: list[str]) -> None:
    with pytest.raises(EvaluationError, match="there is no sample to explain the numbers of"):
        explain(da_motion, motion(da_motion, tokens[:1], still), EvaluationSetup(task="motion"), [])


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (None, "="),
        (ExplainedNumber(choice="a=1", headline="apa", value=0.5, change=0.0, changed=False), "="),
        (ExplainedNumber(choice="a=1", headline="apa", value=0.5, change=0.25, changed=True), "+0.250"),
        (ExplainedNumber(choice="a=1", headline="apa", value=0.5, change=None, changed=True), "now 0.500"),
    ],
)
def test_a_change_is_told_with_its_sign(number: ExplainedNumber | None, text: str) -> None:
    assert _change_text(number, "share") == text
