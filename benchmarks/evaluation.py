"""Measure the evaluation of a sample: motion, accidents, detection."""

from benchmarks import evaluation_accident, evaluation_detection, evaluation_motion
from benchmarks.measure import Figure


def measure() -> list[Figure]:
    return [
        *evaluation_motion.measure(),
        *evaluation_accident.measure(),
        *evaluation_detection.measure(),
    ]
