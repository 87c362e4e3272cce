"""The motion metrics on labels of a synthetic release and on maps with known answers."""

import json
import math
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

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


@pytest.fixture(scope="module")
def labels(da_motion: DeepAccident) -> dict[str, MotionLabels]:
    """Read labels near the end of the recording: 1, 3 or 5 frames, each in its own LiDAR frame."""
    scenario = next(record["token"] for record in da_motion.scenario if record["designed_accident"])
    labels = {}
    for agent in ("ego_vehicle", "infrastructure"):
        for frame in (15, 25, 35):
            token = f"{scenario}/{agent}/{frame:03d}"
            labels[token] = da_motion.motion_labels(token)

    return labels


def boxes_label(
    *maps: np.ndarray, config: MotionLabelConfig = CONFIG, recorded: int = 5
) -> MotionLabels:
    """Make labels with these instance maps, a map for each frame from the present on.

    The first `recorded` frames are in the recording.
    """
    instance = np.zeros((config.label_frames, *config.grid.shape), dtype=np.int32)
    instance[: len(maps)] = np.reshape(maps, (-1, *config.grid.shape))
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


def map_of_boxes(**columns: int) -> np.ndarray:
    """Draw boxes of 4 × 4 cells in row 100: `_7=50` is instance 7 from column 50 on."""
    instances = np.zeros((200, 200), dtype=np.int32)
    for name, column in columns.items():
        instances[100:104, column : column + 4] = int(name[1:])
    return instances


def still_output(*maps: np.ndarray) -> MotionOutput:
    """Make one prediction of each map, in which nothing moves."""
    frames = [np.stack([instances] * 5) for instances in maps]
    return MotionOutput(grid=CONFIG.grid, instances=np.stack(frames))


def moving_output(*maps: np.ndarray) -> MotionOutput:
    """Make one prediction with a map for each frame."""
    return instances_of(np.stack(maps), CONFIG.grid)


def evaluate(
    prediction: MotionOutput, label: MotionLabels, protocol: str | MotionProtocol = "released"
):
    evaluator = MotionEvaluator(protocol)
    evaluator.update("a", prediction, label)
    return evaluator.compute()


def qualities_of(part: Any) -> list[float]:
    return [part.iou, part.pq, part.sq, part.rq]


def test_instance_maps_are_noted_and_recorded_frames_are_counted(
    labels: dict[str, MotionLabels],
) -> None:
    evaluator = MotionEvaluator()
    for token, label in labels.items():
        evaluator.update(token, instances_of(label.to_present().instance, label.config.grid), label)

    result = evaluator.compute()

    for part in result.ranges.values():
        assert part.true_positive > 0

    assert (result.samples, result.frames) == (len(labels), 2 * (5 + 3 + 1))
    assert result.notes[0].startswith(
        f"given as instance maps: {len(labels)} of {len(labels)} predictions"
    )


@pytest.mark.parametrize(
    "shape", [(200, 200), (5, 100, 100), (1, 5, 200, 100), (1, 1, 5, 200, 200)]
)
def test_maps_of_another_shape_are_refused_with_their_shape(shape: tuple[int, ...]) -> None:
    maps = np.zeros(shape, dtype=int)
    message = ("(T, 200, 200)", "(K, T, 200, 200)", f"found {shape}")
    assert_raises((lambda: instances_of(maps, CONFIG.grid), GeometryError, message))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("as_heads", [False, True])
def test_the_orientation_of_a_prediction_makes_no_difference(
    labels, orientation, as_heads: bool
) -> None:
    label = labels[next(iter(labels))]
    predicted_label = labels[list(labels)[3]].to_present()
    grid = CONFIG.grid.with_orientation(orientation)
    if as_heads:
        heads = MotionHeads.from_labels(predicted_label)
        turned_heads = heads.in_orientation(orientation)
        output = MotionOutput(grid=CONFIG.grid, heads=(heads, heads))
        turned_output = MotionOutput(grid=grid, heads=(turned_heads, turned_heads))
    else:
        maps = predicted_label.instance
        turned_maps = to_orientation(
            maps, vectors=False, source=CONFIG.grid.orientation, target=orientation
        )
        output = instances_of(maps, CONFIG.grid)
        turned_output = instances_of(turned_maps, grid)

    assert motion_counts(turned_output, label) == motion_counts(output, label)


@pytest.mark.parametrize(("protocol", "value"), [("released", 0.0), ("paper", math.nan)])
def test_empty_maps_have_the_value_of_the_protocol(protocol: str, value: float) -> None:
    empty = still_output(map_of_boxes())
    for result in (
        evaluate(empty, boxes_label(), protocol),
        MotionEvaluator(protocol).compute(),
    ):
        for part in result.ranges.values():
            np.testing.assert_array_equal(qualities_of(part), [value] * 4)
        assert math.isnan(result.path_accuracy)

    missed = evaluate(empty, boxes_label(map_of_boxes(_1=100)), protocol).ranges["30x30"]
    assert qualities_of(missed) == [0.0] * 4


STILL_MAPS = [map_of_boxes(_1=100)] * 5
HALF_LOGITS = np.zeros((5, 2, 200, 200), dtype=np.float32)
HALF_LOGITS[:, 1, 100:104, 100:102] = 1e-6
"""Logits of two channels, where one half of a box is an actor."""
ZERO_VECTORS = np.zeros_like(HALF_LOGITS)
HALF_BOX_HEADS = MotionHeads.from_arrays(
    HALF_LOGITS, ZERO_VECTORS[:, :1], ZERO_VECTORS, ZERO_VECTORS
)
EMPTY_HEADS = MotionHeads.from_arrays(ZERO_VECTORS, ZERO_VECTORS[:, :1], ZERO_VECTORS, ZERO_VECTORS)


@pytest.mark.parametrize(
    ("prediction", "label", "name", "expected"),
    [
        # a box 45 m ahead is only within 100 m; one across the border of the 30 m counts with its
        # part inside
        (
            still_output(map_of_boxes(_2=128)),
            [map_of_boxes(_1=190, _2=127)] * 5,
            "30x30",
            {"true_positive": 5, "false_negative": 0},
        ),
        (
            still_output(map_of_boxes(_2=128)),
            [map_of_boxes(_1=190, _2=127)] * 5,
            "30x30",
            {"iou": 100 * 2 / 3},
        ),
        (
            still_output(map_of_boxes(_2=128)),
            [map_of_boxes(_1=190, _2=127)] * 5,
            "100x100",
            {"true_positive": 5, "false_negative": 5},
        ),
        (
            still_output(map_of_boxes(_2=128)),
            [map_of_boxes(_1=190, _2=127)] * 5,
            "100x100",
            {"sq": 60, "pq": 100 * 3 / 7.5},
        ),
        (
            moving_output(*[map_of_boxes(_1=100)] * 2, *[map_of_boxes()] * 3),
            STILL_MAPS[:2],
            "100x100",
            {"pq": 100},
        ),
        (
            moving_output(*[map_of_boxes(_1=100)] * 2, *[map_of_boxes(_2=100)] * 3),
            STILL_MAPS,
            "100x100",
            {"true_positive": 4, "false_positive": 1, "false_negative": 1, "rq": 80},
        ),
        # only the last prediction counts
        (
            still_output(map_of_boxes(_1=50), map_of_boxes(_7=100)),
            STILL_MAPS,
            "30x30",
            {"pq": 100},
        ),
        (still_output(map_of_boxes(_7=100), map_of_boxes(_1=50)), STILL_MAPS, "30x30", {"pq": 0}),
        (MotionOutput(grid=CONFIG.grid, heads=(HALF_BOX_HEADS,)), STILL_MAPS, "30x30", {"iou": 50}),
        (
            MotionOutput(grid=CONFIG.grid, heads=(HALF_BOX_HEADS,)),
            STILL_MAPS,
            "100x100",
            {"iou": 50},
        ),
        (
            MotionOutput(grid=CONFIG.grid, heads=(HALF_BOX_HEADS, EMPTY_HEADS)),
            STILL_MAPS,
            "100x100",
            {"iou": 0, "false_negative": 5},
        ),
        (
            MotionOutput(grid=CONFIG.grid, heads=(EMPTY_HEADS, HALF_BOX_HEADS)),
            STILL_MAPS,
            "100x100",
            {"iou": 50},
        ),
    ],
)
def test_cells_and_instances_within_a_range(prediction, label, name, expected) -> None:
    """The label has as many recorded frames as it has maps."""
    result = evaluate(prediction, boxes_label(*label, recorded=len(label)))
    part = result.ranges[name]

    assert {field: getattr(part, field) for field in expected} == pytest.approx(expected)
    assert result.frames == len(label)


@pytest.mark.parametrize(
    ("prediction", "label", "expected"),
    [
        # the best prediction counts
        (
            still_output(map_of_boxes(_1=106), map_of_boxes(_7=102)),
            STILL_MAPS,
            {"min_ade": 1, "min_fde": 1, "miss_rate": 0, "paths": 1},
        ),
        (still_output(map_of_boxes(_1=106)), STILL_MAPS, {"min_fde": 3, "path_accuracy": 1}),
        # too far away
        (
            still_output(map_of_boxes(_1=109)),
            STILL_MAPS,
            {"paths": 0, "path_false_positive": 1, "path_false_negative": 1},
        ),
        # an empty first prediction has no paths
        (
            still_output(map_of_boxes(), map_of_boxes(_1=100)),
            STILL_MAPS,
            {"paths": 0, "path_true_positive": 1},
        ),
        # two cells a frame, then gone: 2, 4, 6 cells a frame as released, where the truth keeps to
        # 2
        (
            moving_output(map_of_boxes(_1=100), map_of_boxes(_1=102), *[map_of_boxes()] * 3),
            [map_of_boxes(_1=100 + 2 * frame) for frame in range(5)],
            {"min_fde": (2 + 4 + 6 - 6) * 0.5},
        ),
        (  # large errors are cut off
            moving_output(*[map_of_boxes(_1=20)] * 4, map_of_boxes(_1=55)),
            [map_of_boxes(_1=20)] * 5,
            {"min_ade": 3.5, "min_fde": 10, "miss_rate": 1},
        ),
    ],
)
def test_errors_of_paths(prediction, label, expected) -> None:
    result = evaluate(prediction, boxes_label(*label))
    assert {name: getattr(result, name) for name in expected} == pytest.approx(expected)


def test_paths_can_be_left_out() -> None:
    evaluator = MotionEvaluator(trajectories=False)
    settings = json.loads(json.dumps(evaluator.settings))
    assert settings == MotionEvaluator().settings | {"trajectories": False}

    evaluator.update("a", still_output(map_of_boxes(_1=100)), boxes_label(*STILL_MAPS))
    assert evaluator.counts["a"]["paths"] is None

    result = evaluator.compute()
    assert result.ranges["30x30"].pq == 100.0
    assert math.isnan(result.min_ade)


def test_the_released_breakdown_takes_frames_of_other_samples() -> None:
    """Sample c is perfect, but frame 2 of the list of all frames is one of sample a, in which
    nothing is right.
    """
    label = boxes_label(*STILL_MAPS)
    evaluator = MotionEvaluator()
    evaluator.update("a", still_output(map_of_boxes()), label)
    evaluator.update("b", still_output(map_of_boxes(_1=100)), label)
    evaluator.update("c", still_output(map_of_boxes(_1=100)), label)

    released = evaluator.selected_as_released(["a", "b", "c"], {"c"}).ranges["100x100"]
    right = evaluator.compute({"c"}).ranges["100x100"]
    assert (right.pq, released.pq) == (100.0, 0.0)
    assert (right.iou, released.iou) == (100.0, 100.0)
    assert_raises(
        (
            lambda: evaluator.selected_as_released(["a", "d"], {"a"}),
            EvaluationError,
            ("1 samples", "d"),
        )
    )


def test_predictions_that_do_not_fit_the_labels_are_refused() -> None:
    label = boxes_label(*STILL_MAPS)
    clean_label = boxes_label(*STILL_MAPS, config=MotionLabelConfig(protocol="clean"))
    coarse_grid = BevGrid((-50, 50, 1), (-50, 50, 1))
    coarse_output = instances_of(np.zeros((5, 100, 100)), coarse_grid)
    short_output = instances_of(np.zeros((4, 200, 200)), CONFIG.grid)
    empty_output = still_output(map_of_boxes())
    assert_raises(
        (
            lambda: motion_counts(coarse_output, label),
            EvaluationError,
            ("same grid", "(-50", "x (-50"),
        ),
        (
            lambda: motion_counts(short_output, label),
            EvaluationError,
            ("at least 5 frames", "found 4"),
        ),
        (
            lambda: motion_counts(empty_output, boxes_label(recorded=0)),
            EvaluationError,
            ("present frame",),
        ),
        (lambda: MotionEvaluator("clean"), ChoiceError, ("protocol", "released, paper", "clean")),
        (
            lambda: MotionProtocol(labels="dirty"),
            ChoiceError,
            # an id that changes is a miss and a false alarm
            ("labels", "released, clean", "or None", "dirty"),
        ),
    )
    for protocol in MOTION_PROTOCOLS:
        evaluate_clean = partial(evaluate, empty_output, clean_label, protocol)
        assert_raises((evaluate_clean, EvaluationError, ("MotionLabelConfig(protocol=",)))

    for labels in ("clean", None):
        right_output = still_output(map_of_boxes(_1=100))
        result = evaluate(right_output, clean_label, MotionProtocol(labels=labels))
        assert result.ranges["30x30"].pq == 100.0


def test_protocols_counts_and_results_written_out() -> None:
    released = {"labels": "released", "nothing_is_zero": True}
    assert {name: asdict(rules) for name, rules in MOTION_PROTOCOLS.items()} == {
        "released": released,
        "paper": {"labels": "released", "nothing_is_zero": False},
    }
    assert asdict(MotionProtocol()) == released
    assert MotionEvaluator().trajectories is True

    label = boxes_label(*[map_of_boxes(_1=100, _2=190)] * 5)
    output = still_output(map_of_boxes(_1=101), map_of_boxes(_1=100, _3=40))
    counts = motion_counts(output, label)
    zeros, ones = [0] * 5, [1] * 5
    assert counts == {
        "samples": 1,
        "frames": 5,
        "instance_maps": 1,
        "cells": [[80, 0, 0], [80, 80, 80]],
        "vpq": [[[1.0] * 5, ones, zeros, zeros], [[1.0] * 5, ones, ones, ones]],
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
    result = evaluator.compute().as_dict()
    assert result.pop("notes")[0].startswith("given as instance maps: 1 of 1 prediction")
    assert result == {
        "ranges": {
            "30x30": {
                "iou": 100.0,
                "pq": 100.0,
                "sq": 100.0,
                "rq": 100.0,
                "true_positive": 5,
                "false_positive": 0,
                "false_negative": 0,
            },
            "100x100": pytest.approx(
                {
                    "iou": 100 / 3,
                    "pq": 50.0,
                    "sq": 100.0,
                    "rq": 50.0,
                    "true_positive": 5,
                    "false_positive": 5,
                    "false_negative": 5,
                }
            ),
        },
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
