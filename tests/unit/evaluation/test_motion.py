"""The motion metrics on labels of a synthetic release and on maps with known answers."""

import json
import math
from dataclasses import asdict

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, GeometryError
from deepaccident_devkit.evaluation.motion import (
    MOTION_PROTOCOLS,
    MotionEvaluator,
    MotionProtocol,
    motion_counts,
)
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
        f"{scenario}/{agent}/{index:03d}"
        for agent in ("ego_vehicle", "infrastructure")
        for index in (15, 25, 35)
    ]
    return {token: da_motion.motion_labels(token) for token in tokens}


def boxes_label(
    *frames: np.ndarray, config: MotionLabelConfig = CONFIG, recorded: int = 5
) -> MotionLabels:
    """Labels at the present with these instance maps; the first `recorded` frames are in the
    recording.
    """
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
    return MotionOutput(
        grid=CONFIG.grid, instances=np.stack([np.stack([each] * 5) for each in maps])
    )


def over(*maps: np.ndarray) -> MotionOutput:
    """One prediction, a map a frame."""
    return instances_of(np.stack(maps), CONFIG.grid)


def evaluated(
    prediction: MotionOutput, label: MotionLabels, protocol: str | MotionProtocol = "released"
):
    evaluator = MotionEvaluator(protocol)
    evaluator.update("a", prediction, label)
    return evaluator.compute()


def test_instance_maps_are_told_and_recorded_frames_counted(
    labels: dict[str, MotionLabels],
) -> None:
    evaluator = MotionEvaluator()
    for token, label in labels.items():
        evaluator.update(token, instances_of(label.to_present().instance, label.config.grid), label)
    result = evaluator.compute()
    assert all(each.true_positive > 0 for each in result.ranges.values())
    assert (result.samples, result.frames) == (len(labels), 2 * (5 + 3 + 1))
    assert result.notes[0].startswith(
        f"{len(labels)} of {len(labels)} predictions: given as instance maps"
    )


@pytest.mark.parametrize(
    "shape", [(200, 200), (5, 100, 100), (1, 5, 200, 100), (1, 1, 5, 200, 200)]
)
def test_maps_of_another_shape_are_refused_with_the_shape_that_was_given(
    shape: tuple[int, ...],
) -> None:
    names = ("(T, 200, 200)", "(K, T, 200, 200)", f"found {shape}")
    assert_refused(
        (lambda: instances_of(np.zeros(shape, dtype=int), CONFIG.grid), GeometryError, names)
    )


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("as_heads", [False, True])
def test_the_orientation_of_a_prediction_makes_no_difference(
    labels, orientation, as_heads: bool
) -> None:
    label, other = labels[next(iter(labels))], labels[list(labels)[3]]
    grid = CONFIG.grid.with_orientation(orientation)
    if as_heads:
        heads = MotionHeads.from_labels(other.to_present())
        first = MotionOutput(grid=CONFIG.grid, heads=(heads, heads))
        second = MotionOutput(grid=grid, heads=(heads.in_orientation(orientation),) * 2)
    else:
        maps = other.to_present().instance
        turned = to_orientation(
            maps, vectors=False, source=CONFIG.grid.orientation, target=orientation
        )
        first, second = instances_of(maps, CONFIG.grid), instances_of(turned, grid)
    assert motion_counts(second, label) == motion_counts(first, label)


@pytest.mark.parametrize(("protocol", "nothing"), [("released", 0.0), ("paper", math.nan)])
def test_nothing_to_count(protocol: str, nothing: float) -> None:
    for result in (
        evaluated(still(boxes()), boxes_label(), protocol),
        MotionEvaluator(protocol).compute(),
    ):
        for each in result.ranges.values():
            np.testing.assert_array_equal([getattr(each, name) for name in SCALES], [nothing] * 4)
        assert math.isnan(result.path_accuracy)
    missed = evaluated(still(boxes()), boxes_label(boxes(_1=100)), protocol).ranges["30x30"]
    assert [getattr(missed, name) for name in SCALES] == [0.0] * 4


TRUE = [boxes(_1=100)] * 5
HALVED = np.zeros((5, 2, 200, 200), dtype=np.float32)
HALVED[:, 1, 100:104, 100:102] = 1e-6
"""Logits of which half of a box's cells are as much background as actor."""
VECTORS = np.zeros_like(HALVED)
UNSURE = MotionHeads.from_arrays(HALVED, VECTORS[:, :1], VECTORS, VECTORS)
NOBODY = MotionHeads.from_arrays(VECTORS, VECTORS[:, :1], VECTORS, VECTORS)
COUNTS = ("true_positive", "false_positive", "false_negative")


@pytest.mark.parametrize(
    ("prediction", "label", "name", "expected"),
    [
        # a box 45 m ahead is only within 100 m; one across the border of the 30 m counts with its
        # part inside
        (
            still(boxes(_2=128)),
            [boxes(_1=190, _2=127)] * 5,
            "30x30",
            {"true_positive": 5, "false_negative": 0},
        ),
        (still(boxes(_2=128)), [boxes(_1=190, _2=127)] * 5, "30x30", {"iou": 100 * 2 / 3}),
        (
            still(boxes(_2=128)),
            [boxes(_1=190, _2=127)] * 5,
            "100x100",
            {"true_positive": 5, "false_negative": 5},
        ),
        (
            still(boxes(_2=128)),
            [boxes(_1=190, _2=127)] * 5,
            "100x100",
            {"sq": 60, "pq": 100 * 3 / 7.5},
        ),
        (over(*[boxes(_1=100)] * 2, *[boxes()] * 3), TRUE[:2], "100x100", {"pq": 100}),
        (
            over(
                *[boxes(_1=100)] * 2, *[boxes(_2=100)] * 3
            ),  # an id that changes is a miss and a false alarm
            TRUE,
            "100x100",
            {"true_positive": 4, "false_positive": 1, "false_negative": 1, "rq": 80},
        ),
        (still(boxes(_1=50), boxes(_7=100)), TRUE, "30x30", {"pq": 100}),  # of the last prediction
        (still(boxes(_7=100), boxes(_1=50)), TRUE, "30x30", {"pq": 0}),
        (MotionOutput(grid=CONFIG.grid, heads=(UNSURE,)), TRUE, "30x30", {"iou": 50}),
        (MotionOutput(grid=CONFIG.grid, heads=(UNSURE,)), TRUE, "100x100", {"iou": 50}),
        (
            MotionOutput(grid=CONFIG.grid, heads=(UNSURE, NOBODY)),
            TRUE,
            "100x100",
            {"iou": 0, "false_negative": 5},
        ),
        (MotionOutput(grid=CONFIG.grid, heads=(NOBODY, UNSURE)), TRUE, "100x100", {"iou": 50}),
    ],
)
def test_cells_and_instances_within_a_range(prediction, label, name, expected) -> None:
    """The label has as many recorded frames as there are maps."""
    result = evaluated(prediction, boxes_label(*label, recorded=len(label)))
    assert {each: getattr(result.ranges[name], each) for each in expected} == pytest.approx(
        expected
    )
    assert result.frames == len(label)


@pytest.mark.parametrize(
    ("prediction", "label", "expected"),
    [
        (
            still(boxes(_1=106), boxes(_7=102)),
            TRUE,
            {"min_ade": 1, "min_fde": 1, "miss_rate": 0, "paths": 1},
        ),  # the best
        (still(boxes(_1=106)), TRUE, {"min_fde": 3, "path_accuracy": 1}),
        (
            still(boxes(_1=109)),
            TRUE,
            {"paths": 0, "path_false_positive": 1, "path_false_negative": 1},
        ),  # too far away
        (
            still(boxes(), boxes(_1=100)),
            TRUE,
            {"paths": 0, "path_true_positive": 1},
        ),  # an empty first one ends it
        # two cells a frame, then gone: 2, 4, 6 cells a frame as released, where the truth keeps to
        # 2
        (
            over(boxes(_1=100), boxes(_1=102), *[boxes()] * 3),
            [boxes(_1=100 + 2 * frame) for frame in range(5)],
            {"min_fde": (2 + 4 + 6 - 6) * 0.5},
        ),
        (  # large errors are cut off
            over(*[boxes(_1=20)] * 4, boxes(_1=55)),
            [boxes(_1=20)] * 5,
            {"min_ade": 3.5, "min_fde": 10, "miss_rate": 1},
        ),
    ],
)
def test_paths(prediction, label, expected) -> None:
    result = evaluated(prediction, boxes_label(*label))
    assert {name: getattr(result, name) for name in expected} == pytest.approx(expected)


def test_paths_can_be_left_out() -> None:
    evaluator = MotionEvaluator(trajectories=False)
    assert json.loads(json.dumps(evaluator.settings)) == MotionEvaluator().settings | {
        "trajectories": False
    }
    evaluator.update("a", still(boxes(_1=100)), boxes_label(*TRUE))
    assert evaluator.counts["a"]["paths"] is None
    result = evaluator.compute()
    assert result.ranges["30x30"].pq == 100.0
    assert math.isnan(result.min_ade)


def test_the_released_breakdown_takes_other_samples_frames() -> None:
    """Sample 2 is perfect, but frame 2 of the list of all frames is sample 0's, which has nothing
    right.
    """
    evaluator, label = MotionEvaluator(), boxes_label(*TRUE)
    for token, prediction in {"a": boxes(), "b": boxes(_1=100), "c": boxes(_1=100)}.items():
        evaluator.update(token, still(prediction), label)
    order = ["a", "b", "c"]
    wrong, right = evaluator.selected_as_released(order, {"c"}), evaluator.compute({"c"})
    assert (right.ranges["100x100"].pq, wrong.ranges["100x100"].pq) == (100.0, 0.0)
    assert (right.ranges["100x100"].iou, wrong.ranges["100x100"].iou) == (100.0, 100.0)
    assert_refused(
        (
            lambda: evaluator.selected_as_released(["a", "d"], {"a"}),
            EvaluationError,
            ("1 samples", "d"),
        )
    )


def test_what_cannot_be_compared_is_refused() -> None:
    label, clean = (
        boxes_label(*TRUE),
        boxes_label(*TRUE, config=MotionLabelConfig(protocol="clean")),
    )
    coarse = instances_of(np.zeros((5, 100, 100)), BevGrid((-50, 50, 1), (-50, 50, 1)))
    few = instances_of(np.zeros((4, 200, 200)), CONFIG.grid)
    assert_refused(
        (lambda: motion_counts(coarse, label), EvaluationError, ("same grid", "(-50", "x (-50")),
        (lambda: motion_counts(few, label), EvaluationError, ("at least 5 frames", "found 4")),
        (
            lambda: motion_counts(still(boxes()), boxes_label(recorded=0)),
            EvaluationError,
            ("present frame",),
        ),
        (lambda: MotionEvaluator("clean"), ChoiceError, ("protocol", "released, paper", "clean")),
        (
            lambda: MotionProtocol(labels="dirty"),
            ChoiceError,
            ("labels", "released, clean", "or None", "dirty"),
        ),
        *(
            (
                lambda name=name: evaluated(still(boxes()), clean, name),
                EvaluationError,
                ("MotionLabelConfig(protocol=",),
            )
            for name in MOTION_PROTOCOLS
        ),
    )
    for labels in ("clean", None):
        assert (
            evaluated(still(boxes(_1=100)), clean, MotionProtocol(labels=labels)).ranges["30x30"].pq
            == 100.0
        )


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
    evaluator = MotionEvaluator("paper")
    evaluator.add("a", counts)
    ranges = {
        "iou": 100.0,
        "pq": 100.0,
        "sq": 100.0,
        "rq": 100.0,
        **dict(zip(COUNTS, (5, 0, 0), strict=True)),
    }
    far = {
        "iou": 100 / 3,
        "pq": 50.0,
        "sq": 100.0,
        "rq": 50.0,
        **dict(zip(COUNTS, (5, 5, 5), strict=True)),
    }
    result = evaluator.compute().as_dict()
    assert result.pop("notes")[0].startswith("1 of 1 prediction: given as instance maps")
    assert result == {
        "ranges": {"30x30": ranges, "100x100": pytest.approx(far)},
        "min_ade": 0.0,
        "min_fde": 0.0,
        "miss_rate": 0.0,
        "paths": 1,
        "path_accuracy": 0.5,
        "path_true_positive": 1,
        "path_false_positive": 1,
        "path_false_negative": 1,
        "samples": 1,
        "frames": 5,
    }
