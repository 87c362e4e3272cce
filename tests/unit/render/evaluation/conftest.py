"""Results that several tests of reports draw."""

import math

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.detection.result import DetectionResult
from deepaccident_devkit.selection.samples import samples


@pytest.fixture(scope="session")
def tokens(da_motion: DeepAccident) -> list[str]:
    """The samples of two agents in an accident and its twin."""
    all_tokens = samples(da_motion, "train", "evaluate", "paper", scope="all")
    return [
        token for token in all_tokens if token.split("/")[-2] in ("ego_vehicle", "infrastructure")
    ]


@pytest.fixture
def detected() -> DetectionResult:
    """Detections of two classes at two thresholds; the truth has none of the third class."""
    precision = np.zeros((3, 1, 2, 4))
    precision[0] = [[[1, 0.5, 0.5, 0], [1, 1, 1, 0]]]
    precision[1] = 0.25
    recall = np.broadcast_to([0.25, 0.5, 0.75, 1.0], precision.shape)
    average = np.array([[[50.0, 75.0]], [[25.0, 25.0]], [[math.nan, math.nan]]])
    return DetectionResult(
        mean_average_precision=43.75,
        class_average_precision={"car": 62.5, "van": 25.0, "truck": math.nan},
        mean_errors={"ATE": 0.5},
        classes=("car", "van", "truck"),
        ranges=np.array([[0.0, 50.0]]),
        thresholds=np.tile([0.5, 2.0], (3, 1)),
        average_precision=average,
        precision=precision,
        recall=recall,
        errors=np.ones((3, 4)),
        truths=np.array([[8], [4], [0]]),
        detections=np.array([[9], [3], [2]]),
        samples=5,
    )
