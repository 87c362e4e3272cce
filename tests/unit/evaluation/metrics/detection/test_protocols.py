"""What protocols of detection may be."""

import pytest

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.evaluation.metrics.detection import DetectionEvaluator, detection_protocol


def test_protocols_and_switches_that_cannot_be() -> None:
    with pytest.raises(ChoiceError, match="expected one of released"):
        DetectionEvaluator("kitti")
    with pytest.raises(ChoiceError, match="no switch 'treshold'"):
        DetectionEvaluator("paper", treshold=1)
    with pytest.raises(ChoiceError, match="curve: expected one of"):
        DetectionEvaluator("paper", curve="coco")
    for switches, said in (
        ({"thresholds": (1.0,)}, "error_threshold"),
        ({"thresholds": (), "error_threshold": None}, "at least one"),
        ({"frame": "world"}, "around the agent"),
        ({"classes": [["road", ["lane"]]]}, "expected names with categories"),
        ({"small_thresholds": (1.0,)}, "as many as thresholds"),
        ({"global_sort": False}, "curve='voc'"),
        ({"min_precision": 1.0}, "below 1"),
    ):
        with pytest.raises(ConfigError, match=said):
            detection_protocol("paper", **switches)
    assert detection_protocol("paper", thresholds=[1, 2, 4]).thresholds == (1, 2, 4)
