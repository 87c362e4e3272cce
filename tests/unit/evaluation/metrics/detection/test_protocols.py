"""What protocols of detection may be."""

import pytest

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.evaluation.metrics.detection import (
    DETECTION_PROTOCOLS,
    DetectionEvaluator,
    detection_protocol,
)


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


def test_the_numbers_of_published_procedures() -> None:
    paper, released_iou = DETECTION_PROTOCOLS["paper"], DETECTION_PROTOCOLS["released_iou"]
    assert (paper.min_recall, paper.min_precision, paper.error_threshold) == (0.1, 0.1, 2.0)
    assert (paper.thresholds, paper.points) == ((1.0, 2.0, 4.0), 101)
    assert released_iou.thresholds == (0.3, 0.15)
    assert DETECTION_PROTOCOLS["opencood"].thresholds == (0.3, 0.5, 0.7)
    assert DETECTION_PROTOCOLS["released"].points == 40
