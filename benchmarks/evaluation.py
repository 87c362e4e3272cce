"""Measure the evaluation of a sample: motion, accidents, detection and segmentation."""

from benchmarks import (
    evaluation_accident,
    evaluation_detection,
    evaluation_motion,
    evaluation_segmentation,
)
from benchmarks.measure import Figure


def measure() -> list[Figure]:
    return [
        *evaluation_motion.measure(),
        *evaluation_segmentation.measure(),
        *evaluation_accident.measure(),
        *evaluation_detection.measure(),
    ]
