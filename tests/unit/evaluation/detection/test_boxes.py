"""Protocols of detection, what they may be, and the true boxes of each."""

import math
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, GeometryError, NotAvailableError
from deepaccident_devkit.evaluation.detection import (
    DETECTION_PROTOCOLS,
    DetectedBoxes,
    DetectionEvaluator,
    detection_protocol,
    detection_truth,
)
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.taxonomy import CATEGORIES

# What a protocol chooses unless it states something else.
DEFAULTS: dict[str, Any] = {
    "classes": tuple((name, (name,)) for name in CATEGORIES),
    "frame": "lidar",
    "label_velocity": False,
    "single_precision": False,
    "unknown_velocity_is_zero": False,
    "area": None,
    "area_of": "center",
    "ranges": ((0.0, math.inf),),
    "range_from_x_alone": False,
    "bottom_taken_as_top": False,
    "small_thresholds": None,
    "threshold_included": False,
    "points": 101,
    "min_recall": 0.0,
    "min_precision": 0.0,
    "global_sort": True,
    "error_threshold": None,
    "error_of_bottoms": False,
    "scale_by_overlap": False,
    "orientation_unwrapped": False,
    "absent_class_is_zero": False,
}

RELEASED = {
    "truth": "label",
    "label_velocity": True,
    "own_box": True,
    "single_precision": True,
    "unknown_velocity_is_zero": True,
    "ranges": ((0.0, 120.0),),
    "range_from_x_alone": True,
    "measure": "distance_of_bottoms",
    "bottom_taken_as_top": True,
    "thresholds": (0.5, 1.0, 2.0, 4.0),
    "matching": "by_truth",
    "curve": "released",
    "points": 40,
    "min_recall": 0.1,
    "error_threshold": 2.0,
    "error_of_bottoms": True,
    "scale_by_overlap": True,
    "orientation_unwrapped": True,
    "absent_class_is_zero": True,
}
CHOICES: dict[str, dict[str, Any]] = {
    "released": RELEASED,
    "released_iou": RELEASED
    | {
        "ranges": ((0.0, 30.0), (30.0, 50.0), (50.0, 120.0)),
        "measure": "iou_3d",
        "thresholds": (0.3, 0.15),
        "small_thresholds": (0.2, 0.1),
        "error_threshold": None,
    },
    "paper": {
        "truth": "visible",
        "own_box": False,
        "area": (-51.2, 51.2, -51.2, 51.2),
        "measure": "distance_bev",
        "thresholds": (1.0, 2.0, 4.0),
        "matching": "by_score",
        "curve": "nuscenes",
        "min_recall": 0.1,
        "min_precision": 0.1,
        "error_threshold": 2.0,
    },
    "opencood": {
        "classes": (("vehicle", ("car", "truck", "van")),),
        "truth": "cooperative",
        "own_box": False,
        "area": (-140.0, 140.0, -40.0, 40.0),
        "area_of": "footprint",
        "measure": "iou_bev",
        "thresholds": (0.3, 0.5, 0.7),
        "threshold_included": True,
        "matching": "by_score",
        "curve": "voc",
    },
}


@pytest.mark.parametrize("name", DETECTION_PROTOCOLS)
def test_every_choice_of_the_published_procedures(name: str) -> None:
    assert asdict(detection_protocol(name)) == DEFAULTS | CHOICES[name]


ONE_CURVE = {
    "classes": [["car", ["car"]]],
    "thresholds": [2.0],
    "min_recall": 0,
    "min_precision": 0,
}
TWO_RINGS = {"ranges": [[0, 30], [30, 50]]}


def test_the_limits_of_what_a_protocol_may_choose() -> None:
    """The last value is accepted, the next one is refused."""
    paper = partial(detection_protocol, "paper")
    assert paper(**ONE_CURVE, points=10_000_000).points == 10_000_000
    assert paper(points=2, min_recall=0.99).points == 2
    assert paper(thresholds=[1, 2, 4]).thresholds == (1, 2, 4)
    released_iou = DETECTION_PROTOCOLS["released_iou"]
    assert released_iou.limits("car") == (0.3, 0.15)
    assert released_iou.limits("cyclist") == (0.2, 0.1)
    assert_raises(
        (
            lambda: DetectionEvaluator("kitti"),
            ChoiceError,
            ("protocol", "released, released_iou, paper", "kitti"),
        ),
        (
            lambda: DetectionEvaluator("paper", treshold=1),
            ChoiceError,
            ("no switch 'treshold'", "thresholds"),
        ),
        *(
            (
                partial(paper, **{name: "other"}),
                ChoiceError,
                (f"{name}: expected one of", "other"),
            )
            for name in ("truth", "measure", "matching", "area_of", "curve")
        ),
        *(
            (partial(paper, **switches), ConfigError, words)
            for switches, words in (
                ({"thresholds": (1.0,)}, ("error_threshold", "one of the thresholds")),
                ({"thresholds": (), "error_threshold": None}, ("at least one",)),
                ({"ranges": []}, ("at least one of each",)),
                ({"frame": "world"}, ("frame", "lidar", "ego", "distances from the agent")),
                ({"classes": [["road", ["lane"]]]}, ("expected names of classes with categories",)),
                (
                    {"classes": [["car", ["car"]], ["all", ["car", "van"]]]},
                    ("each category at most once",),
                ),
                ({"classes": []}, ("expected names of classes with categories",)),
                ({"small_thresholds": (1.0,)}, ("as many as thresholds",)),
                ({"global_sort": False}, ("curve='voc'",)),
                ({"curve": "voc"}, ("another curve than voc",)),
                (TWO_RINGS, ("a single range",)),
                ({"min_precision": 1.0}, ("below 1",)),
                ({"min_precision": -0.01}, ("shares from 0",)),
                ({"min_recall": 1.0}, ("below 1",)),
                ({"min_recall": -0.01}, ("shares from 0",)),
                ({"points": 1}, ("at least 2",)),
                (ONE_CURVE | {"points": 10_000_001}, ("10000001", "threshold (1)", "10,000,000")),
                ({"points": 555_556}, ("threshold (18)",)),
                (TWO_RINGS | {"points": 300_000, "error_threshold": None}, ("threshold (36)",)),
            )
        ),
    )


def test_the_truth_of_each_protocol(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0]["token"], "ego_vehicle", 3)
    own_id = da.get("agent", sample["agent_token"])["actor_id"]

    released = detection_truth(da, sample)
    assert released.frame == "lidar"
    assert released.actor_id.tolist() == da.boxes(sample, "lidar").actor_id.tolist()
    velocities = da.columns("annotation")["velocity_label"][da.annotation_rows(sample)]
    np.testing.assert_array_equal(released.velocity[:, :2], velocities)

    paper = detection_truth(da, sample, "paper")
    assert paper.frame == "lidar"
    assert paper.actor_id.tolist() == da.boxes(sample, "lidar", "released").actor_id.tolist()

    cooperative = detection_truth(da, sample, "opencood")
    single = detection_truth(da, sample, "opencood", agents="single")
    with_own_box = detection_truth(da, sample, detection_protocol("opencood", own_box=True))
    assert cooperative.frame == "lidar"
    assert own_id not in cooperative.actor_id
    assert own_id in with_own_box.actor_id
    assert set(single.actor_id.tolist()) <= set(cooperative.actor_id.tolist())

    label_velocities = detection_protocol("opencood", label_velocity=True)
    assert_raises(
        (
            lambda: detection_truth(da, sample, "paper", agents="single"),
            ConfigError,
            ("truth='cooperative'", "visible"),
        ),
        (
            lambda: detection_truth(da, sample, label_velocities),
            ConfigError,
            ("label_velocity", "choose False"),
        ),
    )


def test_detected_boxes_have_a_frame_and_change_it() -> None:
    from_arrays = partial(
        DetectedBoxes.from_arrays,
        [[1.0, 2.0, 3.0]],
        [[4.0, 2.0, 1.5]],
        [0.5],
        [0.9],
        frame="lidar",
    )
    moved = from_arrays().transform(SE3.from_yaw(0, (10, 0, 0)), "world")
    assert (len(moved), moved.boxes.frame) == (1, "world")
    assert moved.boxes.center.tolist() == [[11, 2, 3]]
    assert (moved.scores.tolist(), moved.scores.flags.writeable) == ([0.9], False)

    for velocity, expected in (
        ([[3.0, 4.0]], [[3, 4, 0]]),
        ([[3.0, 4.0, 0.0]], [[3, 4, 0]]),
        (None, [[math.nan] * 3]),
    ):
        np.testing.assert_array_equal(from_arrays(velocity=velocity).boxes.velocity, expected)
    assert_raises(
        (
            lambda: DetectedBoxes(boxes=moved.boxes, scores=[0.5, 0.6]),
            GeometryError,
            ("scores",),
        ),
        (
            lambda: DetectedBoxes(boxes=moved.boxes, scores=[math.nan]),
            GeometryError,
            ("not all numbers are finite",),
        ),
    )


def test_a_sample_without_label_has_no_truth(own_release: Path) -> None:
    for file in own_release.rglob("label/**/*.txt"):
        file.unlink()
    dataset = DeepAccident("v1", own_release, verbose=False, on_error="skip")
    assert_raises(
        (
            lambda: detection_truth(dataset, dataset.sample[0]),
            NotAvailableError,
            ("has no label",),
        )
    )
