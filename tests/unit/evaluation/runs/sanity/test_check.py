"""`check_sanity`: what is scored, what is said, of each task and each form of results."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from memory_results import MemoryResults

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.metrics.accident import accident_context
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes, detection_truth
from deepaccident_devkit.evaluation.metrics.predictions import Accident, MotionOutput, instances_of
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.evaluation.runs.sanity import SanityReport, check_sanity
from deepaccident_devkit.evaluation.runs.sanity.samples import telling_samples
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation
from deepaccident_devkit.motion import MotionHeads, MotionLabelConfig, MotionLabels
from deepaccident_devkit.taxonomy import CATEGORIES

Predict = Callable[[MotionLabels], MotionOutput]
MOTION = EvaluationSetup(task="motion")


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """Of the accident and its twin, all agents, the last 2 s."""
    return da_motion.samples("train", "evaluate", "paper", scope="all")


def motion(dataset: DeepAccident, tokens: list[str], predict: Predict, lies: Orientation = "devkit") -> MemoryResults:
    config = MotionLabelConfig(orientation=lies)
    return MemoryResults(
        "motion", {token: predict(dataset.motion_labels(token, config).to_present("bilinear")) for token in tokens}
    )


def as_maps(label: MotionLabels) -> MotionOutput:
    return instances_of(label.instance, label.config.grid)


def as_heads(label: MotionLabels) -> MotionOutput:
    return MotionOutput(grid=label.config.grid, heads=(MotionHeads.from_labels(label),))


def sanity(
    dataset: DeepAccident, results: Any, setup: EvaluationSetup, tokens: list[str], samples: int = 4
) -> SanityReport:
    return check_sanity(dataset, results, setup, tokens, samples=samples)


@pytest.mark.slow
@pytest.mark.parametrize("lies", ORIENTATIONS)
@pytest.mark.parametrize("predict", [as_maps, as_heads])
@pytest.mark.parametrize("task", ["motion", "accident"])
def test_labels_as_predictions_are_perfect_and_raise_no_alarm(
    da_motion: DeepAccident, tokens: list[str], lies: Orientation, predict: Predict, task: Any
) -> None:
    report = sanity(da_motion, motion(da_motion, tokens[::5], predict, lies), EvaluationSetup(task=task), tokens[::5])
    assert report.warnings == ()
    assert report.given == report.perfect
    assert report.perfect != report.empty
    assert report.samples == 4


@pytest.mark.slow
@pytest.mark.parametrize("meant", ORIENTATIONS)
@pytest.mark.parametrize("stated", ORIENTATIONS)
def test_the_orientation_that_would_be_right_is_named(
    da_motion: DeepAccident, tokens: list[str], stated: Orientation, meant: Orientation
) -> None:
    def mixed_up(label: MotionLabels) -> MotionOutput:
        return instances_of(label.instance, BevGrid(orientation=stated))

    report = sanity(da_motion, motion(da_motion, tokens[::5], mixed_up, meant), MOTION, tokens[::5])
    said = f"maps in the orientation '{meant}' look so where '{stated}' is stated: state orientation '{meant}'"
    assert [said in warning for warning in report.warnings] == ([] if meant == stated else [True])


def test_protocols_have_other_perfect_scores(da_motion: DeepAccident, tokens: list[str]) -> None:
    """The released curve has 36 points, of which one is never reached; a class that is nowhere counts as 0."""
    boxes = detections(da_motion, tokens)
    perfect = {
        name: sanity(da_motion, boxes, EvaluationSetup(task="detection", protocol=name), tokens).perfect["mAP"]
        for name in ("released", "paper", "opencood")
    }
    there = {each for token in tokens for each in detection_truth(da_motion, token, "released").category.tolist()}
    best = 100 * 35 / 36 * len(there) / len(CATEGORIES)
    assert perfect == {"released": pytest.approx(best), "paper": 100.0, "opencood": pytest.approx(100.0)}


def detections(dataset: DeepAccident, tokens: list[str], scores: float | None = None) -> MemoryResults:
    found = {}
    for token in tokens:
        boxes = dataset.boxes(token, "world")
        boxes = boxes.select(boxes.actor_id >= 0)
        sure = np.linspace(0.1, 0.9, len(boxes)) if scores is None else np.full(len(boxes), scores)
        found[token] = DetectedBoxes(boxes=boxes, scores=sure)
    return MemoryResults("detection", found)


def test_equal_scores_are_told(da_motion: DeepAccident, tokens: list[str]) -> None:
    setup = EvaluationSetup(task="detection", protocol="paper")
    assert sanity(da_motion, detections(da_motion, tokens), setup, tokens).warnings == ()
    (warning,) = sanity(da_motion, detections(da_motion, tokens, 0.5), setup, tokens).warnings
    assert (
        "scores are 0.5: numbers that depend on the order of scores, such as an average precision, then say little"
        in warning
    )


def test_a_mistake_of_detections_is_told_with_its_remedy(da_motion: DeepAccident, tokens: list[str]) -> None:
    found = {}
    for token in tokens:
        boxes = da_motion.boxes(token, "ego")
        found[token] = DetectedBoxes.from_arrays(
            boxes.center, boxes.size, boxes.yaw, np.linspace(0, 1, len(boxes)), frame="world"
        )
    report = sanity(da_motion, MemoryResults("detection", found), EvaluationSetup(task="detection"), tokens)
    (warning,) = report.warnings
    assert warning.startswith(
        "ego frame: it looks as if boxes are given in the agent's ego frame; remedy: translations"
    )
    assert report.to_text().endswith(f"WARNING: {warning}")


def test_random_headings_are_told_with_what_chance_gives(da_motion: DeepAccident, tokens: list[str]) -> None:
    found, source = {}, np.random.default_rng(0)
    for token, right in detections(da_motion, tokens).predictions.items():
        boxes = right.boxes
        turned = DetectedBoxes.from_arrays(
            *(boxes.center, boxes.size, source.uniform(-3, 3, len(boxes)), right.scores),
            category=boxes.category,
            frame="world",
        )
        found[token] = turned
    setup = EvaluationSetup(task="detection", protocol="paper")
    (warning,) = sanity(da_motion, MemoryResults("detection", found), setup, tokens).warnings
    assert warning.startswith(
        "heading in degrees, or at random: it looks as if headings are at random, which is also so"
    )
    assert re.search(r"in radians \(share of the headings that are wrong: 0\.\d\d, and 0\.50 is chance\)$", warning)


def changed_boxes(results: MemoryResults, change: Callable[[DetectedBoxes], DetectedBoxes]) -> MemoryResults:
    return MemoryResults("detection", {token: change(each) for token, each in results.predictions.items()})


def test_boxes_that_come_twice_are_told(da_motion: DeepAccident, tokens: list[str]) -> None:
    source = np.random.default_rng(0)

    def twice(found: DetectedBoxes, share: float) -> DetectedBoxes:
        again = np.flatnonzero(source.uniform(size=len(found)) < share)
        boxes = found.boxes.select(np.concatenate([np.arange(len(found)), again]))
        off = source.uniform(-0.05, 0.05, (len(boxes), 3))
        return DetectedBoxes(
            boxes=replace(boxes, center=boxes.center + off, size=boxes.size * (1 + off)),
            scores=np.linspace(0.1, 0.9, len(boxes)),
        )

    setup, right = EvaluationSetup(task="detection", protocol="paper"), detections(da_motion, tokens)
    (warning,) = sanity(da_motion, changed_boxes(right, lambda found: twice(found, 1.0)), setup, tokens).warnings
    twins, every = re.match(r"(\d+) of (\d+) boxes have a twin, ", warning).groups()  # type: ignore[union-attr]
    assert twins == every
    assert warning.endswith("(centres within 0.25 m): apply non-maximum suppression")
    assert sanity(da_motion, changed_boxes(right, lambda found: twice(found, 0.05)), setup, tokens).warnings == ()


def test_quaternions_in_scipys_order_are_told(da_motion: DeepAccident, tokens: list[str]) -> None:
    def shuffled(found: DetectedBoxes) -> DetectedBoxes:
        return replace(found, boxes=replace(found.boxes, rotation=found.boxes.rotation[:, [1, 2, 3, 0]]))

    setup = EvaluationSetup(task="detection", protocol="paper")
    warnings = sanity(da_motion, changed_boxes(detections(da_motion, tokens), shuffled), setup, tokens).warnings
    assert re.match(
        r"\d+ of \d+ boxes lie on their side or upside down: rotation is a quaternion w, x, y, z,", warnings[-1]
    )
    assert len(warnings) == 1


def test_swapped_classes_are_told_unless_the_boxes_are_elsewhere(da_motion: DeepAccident, tokens: list[str]) -> None:
    swapped, elsewhere = {}, {}
    for token, right in detections(da_motion, tokens).predictions.items():
        boxes = replace(right.boxes, category=np.array([1, 0, 2, 3, 4, 5])[right.boxes.category])
        swapped[token] = DetectedBoxes(boxes=boxes, scores=right.scores)
        there = replace(boxes, center=boxes.center * (1, -1, 1))
        elsewhere[token] = DetectedBoxes(boxes=there, scores=right.scores)
    setup = EvaluationSetup(task="detection", protocol="paper")
    (warning,) = sanity(da_motion, MemoryResults("detection", swapped), setup, tokens).warnings
    assert warning.startswith("classes swapped: car is called truck")
    assert "; the classes are, in this order, car, truck, van" in warning
    report = sanity(da_motion, MemoryResults("detection", elsewhere), setup, tokens)
    (warning,) = report.warnings
    assert warning.startswith("left-handed world: ")
    assert [each.name for each in report.candidates if each.suspected] == ["left-handed world"]


@pytest.mark.parametrize(("task", "protocol"), [("accident", "boxes"), ("accident", "paper"), ("warning", "clean")])
def test_explicit_accidents(da_motion: DeepAccident, tokens: list[str], task: Any, protocol: str) -> None:
    setup = EvaluationSetup(task=task, protocol=protocol)
    known = {token: accident_context(da_motion, token, 2.0).truth for token in tokens}
    right = {
        token: [] if truth is None or truth.accident is None else [scored(truth.accident, number)]
        for number, (token, truth) in enumerate(known.items())
    }
    report = sanity(da_motion, MemoryResults("accident", right), setup, tokens)
    assert report.warnings == ()
    name = "recall ego_involved" if task == "warning" else "apa"
    assert (report.perfect[name], report.empty[name]) == (1.0, 0.0)
    late = {token: [delayed(each) for each in alarms] for token, alarms in right.items()}
    (warning,) = sanity(da_motion, MemoryResults("accident", late), setup, tokens, samples=10).warnings
    assert warning.startswith("0.5 s late: it looks as if accidents are predicted 0.5 s later than they happen")


@pytest.mark.parametrize(("protocol", "told"), [("boxes", 1), ("paper", 0)])
def test_equal_scores_of_accidents_are_told_where_they_count(
    da_motion: DeepAccident, tokens: list[str], protocol: str, told: int
) -> None:
    known = {token: accident_context(da_motion, token, 2.0).truth for token in tokens}
    right = {
        token: [] if truth is None or truth.accident is None else [truth.accident] for token, truth in known.items()
    }
    setup = EvaluationSetup(task="accident", protocol=protocol)
    warnings = sanity(da_motion, MemoryResults("accident", right), setup, tokens).warnings
    assert ["scores are 1: numbers that depend on" in warning for warning in warnings] == [True] * told


def scored(accident: Accident, number: int) -> Accident:
    return Accident(positions=accident.positions, time=accident.time, score=1 / (1 + number))


def delayed(accident: Accident) -> Accident:
    return Accident(positions=accident.positions, time=accident.time + 0.5, score=accident.score)


def test_empty_predictions_are_told(da_motion: DeepAccident, tokens: list[str]) -> None:
    results = motion(da_motion, tokens[::5], lambda label: instances_of(label.instance * 0, label.config.grid))
    report = sanity(da_motion, results, MOTION, tokens[::5])
    assert report.warnings == ("all 4 predictions looked at are empty: nothing is predicted in them",)
    assert report.given == report.empty


def test_near_nothing_is_told_where_no_check_explains_it(da_motion: DeepAccident, tokens: list[str]) -> None:
    def elsewhere(label: MotionLabels) -> MotionOutput:
        return instances_of(np.roll(label.instance, (37, 61), (1, 2)), label.config.grid)

    report = sanity(da_motion, motion(da_motion, tokens[::5], elsewhere), MOTION, tokens[::5])
    assert report.warnings == ()
    assert report.verdict.startswith("Near nothing: iou 30x30 is ")
    assert report.verdict.endswith(f"to the truth; none of the {len(report.candidates)} checks explains it.")
    assert report.to_text().endswith(report.verdict)


def as_probabilities(label: MotionLabels) -> MotionOutput:
    heads = MotionHeads.from_labels(label)
    return MotionOutput(grid=label.config.grid, heads=(replace(heads, segmentation=heads.segmentation * 0.098 + 0.01),))


def as_low_logits(label: MotionLabels) -> MotionOutput:
    heads = MotionHeads.from_labels(label)
    return MotionOutput(grid=label.config.grid, heads=(replace(heads, segmentation=heads.segmentation - 11),))


def as_logits(label: MotionLabels) -> MotionOutput:
    heads = MotionHeads.from_labels(label)
    return MotionOutput(grid=label.config.grid, heads=(replace(heads, segmentation=heads.segmentation - 5),))


def test_probabilities_in_heads_are_told_where_sigmoid_is_taken(da_motion: DeepAccident, tokens: list[str]) -> None:
    wrong, right = (motion(da_motion, tokens[::5], predict) for predict in (as_probabilities, as_logits))
    accident = EvaluationSetup(task="accident")
    (warning,) = sanity(da_motion, wrong, accident, tokens[::5]).warnings
    assert warning.startswith("the rule by which accidents and paths are read off heads takes 100 % of the cells for")
    assert sanity(da_motion, wrong, MOTION, tokens[::5]).warnings == (warning,)
    for setup, predicted in (
        (accident, right),
        (MOTION, right),
        (EvaluationSetup(task="accident", protocol="paper"), wrong),
    ):
        assert sanity(da_motion, predicted, setup, tokens[::5]).warnings == ()


def test_a_score_of_0_is_explained_by_heads_that_sigmoid_reads_in_another_way(
    da_motion: DeepAccident, tokens: list[str]
) -> None:
    low = motion(da_motion, tokens[::5], as_low_logits)
    report = sanity(da_motion, low, EvaluationSetup(task="accident"), tokens[::5])
    assert report.given["apa"] == 0.0 < (report.perfect["apa"] or 0.0)
    (warning,) = report.warnings
    assert "off heads takes 0 % of the cells for actors, argmax " in warning
    assert report.verdict == ""
    told, lost = sanity(da_motion, low, MOTION, tokens[::5]).warnings
    assert told == warning
    assert lost.startswith("only 0 of ")


def test_past_frames_at_the_beginning_are_told(da_motion: DeepAccident, tokens: list[str]) -> None:
    """Of the infrastructure, which stands still: labels of 1 s earlier are the same with two frames before."""
    config, found = MotionLabelConfig(future_frames=6), {}
    for token in (each for each in tokens if "/infrastructure/" in each):
        recording, frame = token.rsplit("/", 1)
        label = da_motion.motion_labels(f"{recording}/{int(frame) - 10:03d}", config).to_present("bilinear")
        found[token] = instances_of(label.instance, label.config.grid)
    (warning,) = sanity(da_motion, MemoryResults("motion", found), MOTION, [*found]).warnings
    assert warning.startswith(
        "two steps late: it looks as if each frame shows the moment two steps before it; remedy: "
    )
    assert "the first frame must be the present: leave out the past frames (IoU in the cells" in warning


def test_what_maps_do_not_hold_is_said(da_motion: DeepAccident, tokens: list[str]) -> None:
    maps, heads = (
        sanity(da_motion, motion(da_motion, tokens[::5], predict), MOTION, tokens[::5])
        for predict in (as_maps, as_heads)
    )
    (said,) = maps.unchecked
    assert "offset, flow and the heads' channels, which instance maps do not hold" in said
    assert "store='heads'" in said
    assert f"Not looked at: {said}" in maps.to_text()
    assert heads.unchecked == ()
    assert maps.verdict == heads.verdict == "Nothing looks wrong with the predictions."


def test_ids_that_are_not_linked_are_told(da_motion: DeepAccident, tokens: list[str]) -> None:
    def unlinked(label: MotionLabels) -> MotionOutput:
        anew = 100 * np.arange(5)[:, None, None] * (label.instance > 0)
        return instances_of(label.instance + anew, label.config.grid)

    report = sanity(da_motion, motion(da_motion, tokens[::5], unlinked), MOTION, tokens[::5])
    (warning,) = report.warnings
    assert warning.startswith("ids are not linked over time: 0 of ")
    assert report.given["iou 100x100"] == 100.0


def test_of_a_file_by_two_workers_it_is_the_same(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    chosen = tokens[::5]
    with ResultsWriter(tmp_path / "motion", "motion") as writer:
        for token, prediction in motion(da_motion, chosen, as_maps).predictions.items():
            writer.add(token, prediction)
    results = read_results(tmp_path / "motion")
    one, two = (check_sanity(da_motion, results, MOTION, chosen, workers=workers) for workers in (1, 2))
    assert one == two
    assert json.loads(json.dumps(one.as_dict(), allow_nan=False))["warnings"] == []


def test_samples_are_spread_and_tell_most(da_motion: DeepAccident) -> None:
    every = [each["token"] for each in da_motion.sample[:]]
    chosen = telling_samples(da_motion, every, 10, 2.0)
    assert chosen == telling_samples(da_motion, every[::-1], 10, 2.0)
    assert len({token.rsplit("/", 1)[0] for token in chosen}) == 10  # two scenarios of five agents
    ends = [da_motion.get("sample", token)["time_to_impact"] for token in chosen]
    assert [each for each in ends if each is not None] == [2.0] * 5
    assert telling_samples(da_motion, every[:3], 10, 2.0) == every[:3]


def test_samples_with_an_alarm_are_looked_at_first(da_motion: DeepAccident, tokens: list[str]) -> None:
    """Of a model that foresees few accidents, these few have to be among them."""
    coming = [token for token in tokens if da_motion.get("sample", token)["time_to_impact"] is not None]
    alarmed = set(coming[1::4])
    chosen = telling_samples(da_motion, tokens, 10, 2.0, alarmed.__contains__)
    assert len(alarmed & set(chosen)) == len(alarmed) == 5
    assert len(alarmed & set(telling_samples(da_motion, tokens, 10, 2.0))) < 5


def test_nothing_to_look_at(da_motion: DeepAccident, tokens: list[str]) -> None:
    results = motion(da_motion, tokens[:1], as_maps)
    with pytest.raises(EvaluationError, match="there is no sample to look at"):
        check_sanity(da_motion, results, MOTION, [])
    with pytest.raises(ConfigError, match="samples: expected at least 1, found 0"):
        check_sanity(da_motion, results, MOTION, tokens[:1], samples=0)
