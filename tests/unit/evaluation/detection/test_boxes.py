"""Protocols of detection, what they may be, and the true boxes of each."""

import math
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

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

PLAIN: dict[str, Any] = {
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
"""What a protocol chooses that says nothing else."""
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
CHOSEN: dict[str, dict[str, Any]] = {
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
    assert asdict(detection_protocol(name)) == PLAIN | CHOSEN[name]


ONE = {"classes": [["car", ["car"]]], "thresholds": [2.0], "min_recall": 0, "min_precision": 0}
TWO_RINGS = {"ranges": [[0, 30], [30, 50]]}


def test_the_edges_of_what_can_be() -> None:
    """The last value that is taken, and the first one that is not."""
    assert detection_protocol("paper", **ONE, points=10_000_000).points == 10_000_000
    assert detection_protocol("paper", points=2, min_recall=0.99).points == 2
    assert detection_protocol("paper", thresholds=[1, 2, 4]).thresholds == (1, 2, 4)
    released_iou = DETECTION_PROTOCOLS["released_iou"]
    assert [released_iou.limits(name) for name in ("car", "cyclist")] == [(0.3, 0.15), (0.2, 0.1)]
    assert_refused(
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
                partial(detection_protocol, "paper", **{name: "other"}),
                ChoiceError,
                (f"{name}: expected one of", "other"),
            )
            for name in ("truth", "measure", "matching", "area_of", "curve")
        ),
        *(
            (partial(detection_protocol, "paper", **switches), ConfigError, words)
            for switches, words in (
                ({"thresholds": (1.0,)}, ("error_threshold", "one of the thresholds")),
                ({"thresholds": (), "error_threshold": None}, ("at least one",)),
                ({"ranges": []}, ("at least one of each",)),
                ({"frame": "world"}, ("frame", "lidar", "ego", "around the agent")),
                ({"classes": [["road", ["lane"]]]}, ("expected names with categories",)),
                ({"classes": [["car", ["car"]], ["all", ["car", "van"]]]}, ("each at most once",)),
                ({"classes": []}, ("expected names with categories",)),
                ({"small_thresholds": (1.0,)}, ("as many as thresholds",)),
                ({"global_sort": False}, ("curve='voc'",)),
                ({"curve": "voc"}, ("another curve than voc",)),
                (TWO_RINGS, ("a single range",)),
                ({"min_precision": 1.0}, ("below 1",)),
                ({"min_precision": -0.01}, ("shares from 0",)),
                ({"min_recall": 1.0}, ("below 1",)),
                ({"min_recall": -0.01}, ("shares from 0",)),
                ({"points": 1}, ("at least 2",)),
                (ONE | {"points": 10_000_001}, ("10000001", "threshold (1)", "10,000,000")),
                ({"points": 555_556}, ("threshold (18)",)),
                (TWO_RINGS | {"points": 300_000, "error_threshold": None}, ("threshold (36)",)),
            )
        ),
    )


def test_the_truth_of_each_protocol(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0]["token"], "ego_vehicle", 3)
    every = da.boxes(sample, "lidar")
    released = detection_truth(da, sample)
    assert released.actor_id.tolist() == every.actor_id.tolist()
    rows = da.annotation_rows(sample)
    np.testing.assert_array_equal(
        released.velocity[:, :2], da.columns("annotation")["velocity_label"][rows]
    )
    paper = detection_truth(da, sample, "paper")
    assert paper.actor_id.tolist() == da.boxes(sample, "lidar", "released").actor_id.tolist()
    cooperative = detection_truth(da, sample, "opencood")
    alone = detection_truth(da, sample, "opencood", agents="single")
    own = da.get("agent", sample["agent_token"])["actor_id"]
    assert own not in cooperative.actor_id
    assert own in detection_truth(da, sample, detection_protocol("opencood", own_box=True)).actor_id
    assert set(alone.actor_id.tolist()) <= set(cooperative.actor_id.tolist())
    assert {each.frame for each in (released, paper, cooperative)} == {"lidar"}
    velocities = detection_protocol("opencood", label_velocity=True)
    assert_refused(
        (
            lambda: detection_truth(da, sample, "paper", agents="single"),
            ConfigError,
            ("truth='cooperative'", "visible"),
        ),
        (
            lambda: detection_truth(da, sample, velocities),
            ConfigError,
            ("label_velocity", "choose False"),
        ),
    )


def test_detected_boxes_say_their_frame_and_change_it() -> None:
    arrays = [[1.0, 2.0, 3.0]], [[4.0, 2.0, 1.5]], [0.5], [0.9]
    moved = DetectedBoxes.from_arrays(*arrays, frame="lidar").transform(
        SE3.from_yaw(0, (10, 0, 0)), "world"
    )
    assert (moved.boxes.frame, moved.boxes.center.tolist(), moved.scores.tolist()) == (
        "world",
        [[11, 2, 3]],
        [0.9],
    )
    assert (len(moved), moved.scores.flags.writeable) == (1, False)
    for velocity in ([[3.0, 4.0]], [[3.0, 4.0, 0.0]], None):
        given = DetectedBoxes.from_arrays(*arrays, frame="lidar", velocity=velocity).boxes.velocity
        np.testing.assert_array_equal(given, [[math.nan] * 3] if velocity is None else [[3, 4, 0]])
    assert_refused(
        (lambda: DetectedBoxes(boxes=moved.boxes, scores=[0.5, 0.6]), GeometryError, ("scores",)),
        (
            lambda: DetectedBoxes(boxes=moved.boxes, scores=[math.nan]),
            GeometryError,
            ("not all numbers are finite",),
        ),
    )


def test_a_sample_without_label_has_no_truth(own_release: Path) -> None:
    for path in own_release.rglob("label"):
        for file in path.rglob("*.txt"):
            file.unlink()
    opened = DeepAccident("v1", own_release, verbose=False, on_error="skip")
    assert_refused(
        (lambda: detection_truth(opened, opened.sample[0]), NotAvailableError, ("has no label",))
    )
