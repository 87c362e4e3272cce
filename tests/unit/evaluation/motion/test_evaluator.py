"""MotionEvaluator on labels of a synthetic release and on maps with known answers."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, GeometryError
from deepaccident_devkit.evaluation.instances import instance_paths, match_trajectories, trajectory_errors, vpq_counts
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS, MotionEvaluator, MotionProtocol, motion_counts
from deepaccident_devkit.evaluation.predictions import MotionOutput, instances_of
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, to_orientation
from deepaccident_devkit.motion import MotionHeads, MotionLabelConfig, MotionLabels

CONFIG = MotionLabelConfig()
SCALES = ("iou", "pq", "sq", "rq")


@pytest.fixture(scope="module")
def labels(da_motion: DeepAccident) -> dict[str, MotionLabels]:
    """Of samples whose recording ends after 1 to 5 label frames, each frame in its own frame."""
    scenario = next(record["token"] for record in da_motion.scenario if record["designed_accident"])
    tokens = [
        f"{scenario}/{agent}/{index:03d}" for agent in ("ego_vehicle", "infrastructure") for index in (15, 25, 35)
    ]
    return {token: da_motion.motion_labels(token) for token in tokens}


def boxes_label(*frames: np.ndarray, config: MotionLabelConfig = CONFIG, recorded: int = 5) -> MotionLabels:
    """Labels at the present with these instance maps; the first `recorded` frames are in the recording."""
    instance = np.zeros((config.label_frames, *config.grid.shape), dtype=np.int32)
    instance[: len(frames)] = np.reshape(frames, (-1, *config.grid.shape))
    vectors = np.full((len(instance), 2, *config.grid.shape), 255, dtype=np.float32)
    return MotionLabels(
        config=config,
        segmentation=(instance > 0).astype(np.uint8),
        instance=instance,
        centerness=np.zeros((len(instance), 1, *config.grid.shape), dtype=np.float32),
        offset=vectors,
        flow=vectors,
        future_egomotion=np.zeros((config.frames, 6), dtype=np.float32),
        valid=np.arange(config.frames) < config.receptive_field - 1 + recorded,
        id_map={},
        at_present=True,
    )


def boxes(**columns: int) -> np.ndarray:
    """A map with boxes of 4 × 4 cells in row 100: `_7=50` is instance 7 from column 50 on."""
    result = np.zeros((200, 200), dtype=np.int32)
    for name, column in columns.items():
        result[100:104, column : column + 4] = int(name[1:])
    return result


def still(*maps: np.ndarray) -> MotionOutput:
    """Predictions in which nothing moves, one a map."""
    return MotionOutput(grid=CONFIG.grid, instances=np.stack([np.stack([each] * 5) for each in maps]))


def evaluated(prediction: MotionOutput, label: MotionLabels, protocol: str | MotionProtocol = "released"):
    evaluator = MotionEvaluator(protocol)
    evaluator.update("a", prediction, label)
    return evaluator.compute()


def test_instance_maps_are_told_and_recorded_frames_counted(labels: dict[str, MotionLabels]) -> None:
    evaluator = MotionEvaluator()
    for token, label in labels.items():
        evaluator.update(token, instances_of(label.to_present().instance, label.config.grid), label)
    result = evaluator.compute()
    assert all(each.true_positive > 0 for each in result.ranges.values())
    assert result.samples == len(labels)
    assert result.frames == 2 * (5 + 3 + 1)
    assert f"{len(labels)} of {len(labels)} predictions: given as instance maps" in result.notes[0]


def test_the_labels_as_heads_find_most(labels: dict[str, MotionLabels]) -> None:
    """What the grouping loses of the truth itself: some of it, as in the released evaluation."""
    evaluator = MotionEvaluator()
    for token, label in labels.items():
        heads = MotionHeads.from_labels(label.to_present(centerness="bilinear"))
        evaluator.update(token, MotionOutput(grid=label.config.grid, heads=(heads,)), label)
    result = evaluator.compute()
    assert result.ranges["100x100"].iou == 100.0
    assert result.ranges["100x100"].pq > 60
    assert (result.min_ade, result.path_accuracy) == (0.0, 1.0)
    assert result.notes == ()


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("as_heads", [False, True])
def test_the_orientation_of_a_prediction_makes_no_difference(labels, orientation, as_heads: bool) -> None:
    label, other = labels[next(iter(labels))], labels[list(labels)[3]]
    grid = CONFIG.grid.with_orientation(orientation)
    if as_heads:
        heads = MotionHeads.from_labels(other.to_present())
        first = MotionOutput(grid=CONFIG.grid, heads=(heads, heads))
        second = MotionOutput(grid=grid, heads=(heads.in_orientation(orientation),) * 2)
    else:
        maps = other.to_present().instance
        turned = to_orientation(maps, vectors=False, source=CONFIG.grid.orientation, target=orientation)
        first, second = instances_of(maps, CONFIG.grid), instances_of(turned, grid)
    assert motion_counts(second, label) == motion_counts(first, label)


@pytest.mark.parametrize(("protocol", "nothing"), [("released", 0.0), ("paper", math.nan)])
def test_nothing_to_count(protocol: str, nothing: float) -> None:
    empty = np.zeros((200, 200), dtype=np.int32)
    for result in (evaluated(still(empty), boxes_label(), protocol), MotionEvaluator(protocol).compute()):
        for each in result.ranges.values():
            np.testing.assert_array_equal([getattr(each, name) for name in SCALES], [nothing] * 4)
        assert math.isnan(result.path_accuracy)


def test_a_range_counts_what_is_in_it() -> None:
    """A box 45 m ahead is only within 100 m; one across the border of the 30 m counts with its part inside."""
    label = boxes_label(*[boxes(_1=190, _2=127)] * 5)
    result = evaluated(still(boxes(_2=128)), label)
    near, far = result.ranges["30x30"], result.ranges["100x100"]
    assert (near.true_positive, near.false_negative) == (5, 0)
    assert near.iou == pytest.approx(100 * 2 / 3)
    assert (far.true_positive, far.false_negative) == (5, 5)
    assert far.sq == pytest.approx(100 * 12 / 20)
    assert far.pq == pytest.approx(100 * (5 * 12 / 20) / 7.5)


def test_frames_beyond_the_recording_do_not_count() -> None:
    label = boxes_label(*[boxes(_1=100)] * 5, recorded=2)
    result = evaluated(instances_of(np.stack([boxes(_1=100)] * 2 + [boxes()] * 3), CONFIG.grid), label)
    assert result.frames == 2
    assert result.ranges["100x100"].pq == 100.0


def test_large_ids_are_numbered_anew() -> None:
    small = np.stack([boxes(_1=100, _2=60, _3=20)] * 3)
    large = np.array([0, 7, 10**9, 2 * 10**9])[small]
    assert vpq_counts(large, small).true_positive[:, 1].tolist() == [3, 3, 3]
    assert vpq_counts(large, large).iou[:, 1].tolist() == [3, 3, 3]


def test_an_id_that_changes_is_a_miss_and_a_false_alarm() -> None:
    label = boxes_label(*[boxes(_1=100)] * 5)
    maps = instances_of(np.stack([boxes(_1=100), boxes(_1=100), *[boxes(_2=100)] * 3]), CONFIG.grid)
    each = evaluated(maps, label).ranges["100x100"]
    assert (each.true_positive, each.false_positive, each.false_negative) == (4, 1, 1)
    assert each.rq == pytest.approx(80.0)


def test_paths_of_the_best_prediction() -> None:
    """1 m aside, 3 m aside: the nearer of the two counts, and no other's id matters."""
    label = boxes_label(*[boxes(_4=100)] * 5)
    result = evaluated(still(boxes(_1=106), boxes(_7=102)), label)
    assert (result.min_ade, result.min_fde, result.miss_rate, result.paths) == (1.0, 1.0, 0.0, 1)
    assert evaluated(still(boxes(_1=106)), label).min_fde == 3.0


def test_cells_and_instances_are_of_the_last_prediction() -> None:
    label = boxes_label(*[boxes(_4=100)] * 5)
    assert evaluated(still(boxes(_1=50), boxes(_7=100)), label).ranges["30x30"].pq == 100
    assert evaluated(still(boxes(_7=100), boxes(_1=50)), label).ranges["30x30"].pq == 0


def test_a_cell_that_is_as_much_background_as_actor_is_background() -> None:
    logits = np.zeros((5, 2, 200, 200), dtype=np.float32)
    logits[:, 1, 100:104, 100:102] = 1e-6
    vectors = np.zeros_like(logits)
    heads = MotionHeads.from_arrays(logits, vectors[:, :1], vectors, vectors)
    result = evaluated(MotionOutput(grid=CONFIG.grid, heads=(heads,)), boxes_label(*[boxes(_1=100)] * 5))
    assert [each.iou for each in result.ranges.values()] == [50.0, 50.0]


def test_a_path_too_far_away_is_no_partner() -> None:
    label = boxes_label(*[boxes(_4=100)] * 5)
    result = evaluated(still(boxes(_1=109)), label)
    assert (result.paths, result.path_false_positive, result.path_false_negative) == (0, 1, 1)


def test_paths_that_are_matched_too_far_apart_are_told_by_their_own_ids() -> None:
    found = match_trajectories({5: np.zeros((3, 2))}, {8: np.full((3, 2), 99.0)})
    assert (found.pairs, found.unmatched_prediction, found.unmatched_truth) == ((), (5,), (8,))


def test_of_several_predictions_that_with_the_least_error_at_the_end_counts() -> None:
    truth = {1: np.zeros((3, 2))}
    good_at_first, good_at_last = ({7: np.array([(0.0, y) for y in ys])} for ys in ((0, 0, 4), (3, 2, 1)))
    predictions = [good_at_first, good_at_last]
    found = trajectory_errors(predictions, truth, [match_trajectories(each, truth) for each in predictions])
    assert (found.ade, found.fde, found.missed, found.count) == (2, 1, 0, 1)


def test_a_path_that_ends_early_goes_on_ever_faster() -> None:
    """Two cells a frame, then gone: 2, 4, 6 cells a frame as released, where the truth keeps to 2."""
    label = boxes_label(*[boxes(_1=100 + 2 * frame) for frame in range(5)])
    lost = instances_of(np.stack([boxes(_1=100), boxes(_1=102), *[boxes()] * 3]), CONFIG.grid)
    assert evaluated(lost, label).min_fde == (2 + 4 + 6 - 6) * 0.5


def test_an_empty_first_prediction_ends_the_test() -> None:
    label, found = boxes_label(*[boxes(_1=100)] * 5), still(boxes(), boxes(_1=100))
    result = evaluated(found, label)
    assert (result.paths, result.path_true_positive) == (0, 1)


def test_large_errors_are_cut_off() -> None:
    label = boxes_label(*[boxes(_1=20)] * 5)
    far = instances_of(np.stack([boxes(_1=20), boxes(_1=20), boxes(_1=20), boxes(_1=20), boxes(_1=55)]), CONFIG.grid)
    result = evaluated(far, label)
    assert (result.min_ade, result.min_fde, result.miss_rate) == (3.5, 10.0, 1.0)


def test_paths_can_be_left_out() -> None:
    evaluator = MotionEvaluator(trajectories=False)
    assert evaluator.settings["trajectories"] is False
    assert json.loads(json.dumps(evaluator.settings)) == evaluator.settings
    assert evaluator.settings["protocol"] == MotionEvaluator().settings["protocol"]
    evaluator.update("a", still(boxes(_1=100)), boxes_label(*[boxes(_1=100)] * 5))
    assert evaluator.counts["a"]["paths"] is None
    result = evaluator.compute()
    assert result.ranges["30x30"].pq == 100.0
    assert math.isnan(result.min_ade)


def test_the_released_breakdown_takes_other_samples_frames() -> None:
    """Sample 2 is perfect, but frame 2 of the list of all frames is sample 0's, which has nothing right."""
    evaluator, label = MotionEvaluator(), boxes_label(*[boxes(_1=100)] * 5)
    for token, prediction in {"a": boxes(), "b": boxes(_1=100), "c": boxes(_1=100)}.items():
        evaluator.update(token, still(prediction), label)
    order = ["a", "b", "c"]
    wrong, right = evaluator.selected_as_released(order, {"c"}), evaluator.compute({"c"})
    assert (right.ranges["100x100"].pq, wrong.ranges["100x100"].pq) == (100.0, 0.0)
    assert (right.ranges["100x100"].iou, wrong.ranges["100x100"].iou) == (100.0, 100.0)
    with pytest.raises(EvaluationError, match="1 samples have no prediction, such as d"):
        evaluator.selected_as_released(["a", "d"], {"a"})


def test_what_cannot_be_compared_is_refused() -> None:
    label = boxes_label(*[boxes(_1=100)] * 5)
    for error, words, refused in (
        (
            EvaluationError,
            "grid",
            lambda: motion_counts(instances_of(np.zeros((5, 100, 100)), BevGrid((-50, 50, 1), (-50, 50, 1))), label),
        ),
        (EvaluationError, "frames", lambda: motion_counts(instances_of(np.zeros((4, 200, 200)), CONFIG.grid), label)),
        (EvaluationError, "present", lambda: motion_counts(still(boxes()), boxes_label(recorded=0))),
        (
            GeometryError,
            r"expected \(T, H, W\) as the label's",
            lambda: vpq_counts(np.zeros((2, 4, 4)), np.zeros((3, 4, 4))),
        ),
        (ChoiceError, "protocol: expected one of released, paper, found 'clean'", lambda: MotionEvaluator("clean")),
    ):
        with pytest.raises(error, match=words):
            refused()


def test_labels_of_another_protocol_are_refused() -> None:
    config = MotionLabelConfig(protocol="clean")
    label = boxes_label(*[boxes(_1=100)] * 5, config=config)
    for protocol in MOTION_PROTOCOLS:
        with pytest.raises(
            EvaluationError, match=r"label protocol 'released'.*MotionLabelConfig\(protocol='released'\)"
        ):
            evaluated(still(boxes(_1=100)), label, protocol)
    for labels in ("clean", None):
        assert evaluated(still(boxes(_1=100)), label, MotionProtocol(labels=labels)).ranges["30x30"].pq == 100.0
    with pytest.raises(ChoiceError, match=r"labels: expected one of released, clean, .*or None, found 'dirty'"):
        MotionProtocol(labels="dirty")


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_paths_of_instances(orientation) -> None:
    """Those of the first frame alone, with a point for each frame that they are in."""
    grid = BevGrid()
    maps = np.stack([boxes(_1=100, _2=40), boxes(_2=42, _3=10), boxes(_1=104)])
    turned = to_orientation(maps, vectors=False, source="devkit", target=orientation)
    paths = instance_paths(turned, grid.with_orientation(orientation))
    assert {name: path.tolist() for name, path in paths.items()} == {
        1: [[1.0, 1.0], [3.0, 1.0]],
        2: [[-29.0, 1.0], [-28.0, 1.0]],
    }
    assert instance_paths(np.zeros((2, 200, 200), dtype=int), grid) == {}
    assert instance_paths(np.stack([boxes(), boxes(_1=100)]), grid) == {}


def row(*x: float) -> np.ndarray:
    return np.array([(each, 0.0) for each in x])


def test_the_gate_of_paths_is_a_mean_of_4_metres_over_the_frames() -> None:
    truth = {8: row(0, 0, 0)}
    for x, near in ((4.0, True), (4.001, False)):
        found = match_trajectories({5: row(x, x, x)}, truth)
        assert (found.pairs, found.unmatched_prediction) == ((((5, 8),), ()) if near else ((), (5,)))
    with pytest.raises(GeometryError, match="trajectories: expected 3 points each; see `padded`"):
        match_trajectories({5: row(0, 0)}, truth)


@pytest.mark.parametrize(
    ("end", "ade", "fde", "missed"),
    [(5.0, 2.5, 5.0, 0), (5.5, 2.75, 5.5, 1), (11.0, 5.5, 10.0, 1), (17.0, 8.0, 10.0, 1), (0.0, 0.0, 0.0, 0)],
)
def test_errors_at_the_end_and_their_limits(end: float, ade: float, fde: float, missed: int) -> None:
    truth, predicted = {1: row(0, 0)}, {4: row(0, end)}
    made = trajectory_errors([predicted], truth, [replace(match_trajectories(truth, truth), pairs=((4, 1),))])
    assert (made.ade, made.fde, made.missed, made.count) == (ade, fde, missed, 1)


def test_the_choices_of_the_protocols_and_what_counts_hold() -> None:
    released = {"labels": "released", "nothing_is_zero": True}
    assert {name: asdict(rules) for name, rules in MOTION_PROTOCOLS.items()} == {
        "released": released,
        "paper": released | {"nothing_is_zero": False},
    }
    assert (asdict(MotionProtocol()), MotionEvaluator().trajectories) == (released, True)
    label = boxes_label(*[boxes(_1=100, _2=190)] * 5)
    counts = motion_counts(still(boxes(_1=101), boxes(_1=100, _3=40)), label)
    alone, quality = [[1.0] * 5, [1] * 5], [[1.0] * 5, [1] * 5, [1] * 5, [1] * 5]
    assert counts == {
        "samples": 1,
        "frames": 5,
        "instance_maps": 1,
        "cells": [[80, 0, 0], [80, 80, 80]],
        "vpq": [[*alone, [0] * 5, [0] * 5], quality],
        "paths": {
            "ade": 0.0,
            "fde": 0.0,
            "missed": 0,
            "count": 1,
            "true_positive": 1,
            "false_positive": 1,
            "false_negative": 1,
        },
    }
