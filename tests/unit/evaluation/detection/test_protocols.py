"""What protocols of detection may be."""

import math
from dataclasses import asdict
from typing import Any

import pytest

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS, DetectionEvaluator, detection_protocol
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


def test_protocols_and_switches_that_cannot_be() -> None:
    for words, refused in (
        ("expected one of released", lambda: DetectionEvaluator("kitti")),
        ("no switch 'treshold'", lambda: DetectionEvaluator("paper", treshold=1)),
        ("curve: expected one of", lambda: DetectionEvaluator("paper", curve="coco")),
    ):
        with pytest.raises(ChoiceError, match=words):
            refused()
    for switches, said in (
        ({"thresholds": (1.0,)}, "error_threshold"),
        ({"thresholds": (), "error_threshold": None}, "at least one"),
        ({"frame": "world"}, "around the agent"),
        ({"classes": [["road", ["lane"]]]}, "expected names with categories"),
        ({"small_thresholds": (1.0,)}, "as many as thresholds"),
        ({"global_sort": False}, "curve='voc'"),
        ({"min_precision": 1.0}, "below 1"),
        ({"min_recall": 1.0}, "below 1"),
        ({"points": 1}, "at least 2"),
    ):
        with pytest.raises(ConfigError, match=said):
            detection_protocol("paper", **switches)
    assert detection_protocol("paper", thresholds=[1, 2, 4]).thresholds == (1, 2, 4)
    assert detection_protocol("paper", points=2, min_recall=0.99).points == 2


@pytest.mark.parametrize("name", DETECTION_PROTOCOLS)
def test_every_choice_of_the_published_procedures(name: str) -> None:
    assert asdict(detection_protocol(name)) == PLAIN | CHOSEN[name]


def test_the_edges_of_what_can_be() -> None:
    """The last value that is taken, and the first one that is not."""
    one = {"classes": [["car", ["car"]]], "thresholds": [2.0], "min_recall": 0, "min_precision": 0}
    assert detection_protocol("paper", **one, points=10_000_000).points == 10_000_000
    for switches, said in (
        (one | {"points": 10_000_001}, r"10000001 for each class, range and threshold \(1\) are more than 10,000,000"),
        ({"points": 555_556}, r"threshold \(18\) are more"),
        ({"ranges": [[0, 30], [30, 50]], "points": 300_000, "error_threshold": None}, r"threshold \(36\) are more"),
        ({"min_recall": -0.01}, "shares from 0"),
        ({"min_precision": -0.01}, "shares from 0"),
        ({"classes": [["car", ["car"]], ["all", ["car", "van"]]]}, "each at most once"),
        ({"classes": []}, "expected names with categories"),
        ({"ranges": []}, "at least one of each"),
        ({"ranges": [[0, 30], [30, 50]]}, "a single range"),
        ({"curve": "voc"}, "another curve than voc"),
    ):
        with pytest.raises(ConfigError, match=said):
            detection_protocol("paper", **switches)
    for name in ("truth", "measure", "matching", "area_of"):
        with pytest.raises(ChoiceError, match=f"{name}: expected one of"):
            detection_protocol("paper", **{name: "other"})
