"""Measure average precision and errors of a frame of 30 objects: with 40 detections, and with 300
as of an untrained model.
"""

import numpy as np

from benchmarks.measure import Figure, best_of, milliseconds, one_core
from deepaccident_devkit.evaluation.detection import DetectedBoxes, DetectionEvaluator
from deepaccident_devkit.geometry import Boxes

FRAMES, OBJECTS, REPEATS = 100, 30, 5
REFERENCE_MS = 7.7


def measure() -> list[Figure]:
    ordinary = [frame(seed, false_alarms=10) for seed in range(FRAMES)]
    crowded = [frame(seed, false_alarms=270) for seed in range(FRAMES)]
    with one_core():
        return [
            figure("detection_frame_ms", "released", ordinary, bound=1.0, reference=REFERENCE_MS),
            figure("detection_paper_frame_ms", "paper", ordinary),
            figure("detection_opencood_frame_ms", "opencood", ordinary),
            figure("detection_crowded_frame_ms", "released", crowded),
        ]


def figure(
    name: str,
    protocol: str,
    frames: list[tuple[DetectedBoxes, Boxes]],
    bound: float | None = None,
    reference: float | None = None,
) -> Figure:
    def evaluate() -> None:
        evaluator = DetectionEvaluator(protocol)
        for number, (prediction, truth) in enumerate(frames):
            evaluator.update(str(number), prediction, truth)
        evaluator.compute()

    seconds = best_of(REPEATS, evaluate)
    return milliseconds(name, seconds / len(frames), bound, reference)


def frame(seed: int, false_alarms: int) -> tuple[DetectedBoxes, Boxes]:
    """Return detections of all objects, about a metre off, with false alarms; and the truth."""
    source = np.random.default_rng(seed)
    count = OBJECTS + false_alarms
    center = np.column_stack([source.uniform(-60, 60, (count, 2)), source.uniform(-2, 0, count)])
    size = source.uniform((3, 1.5, 1.4), (6, 2.5, 2.5), (count, 3))
    yaw = source.uniform(-np.pi, np.pi, count)
    category = source.integers(0, 6, count)
    velocity = np.column_stack([source.normal(0, 5, (count, 2)), np.zeros(count)])
    truth = Boxes.from_arrays(
        center, size, yaw, frame="lidar", category=category, velocity=velocity
    )
    detected_center = center + source.normal(0, 0.6, center.shape)
    detected_yaw = yaw + source.normal(0, 0.2, count)
    detected = Boxes.from_arrays(
        detected_center,
        size * 1.05,
        detected_yaw,
        frame="lidar",
        category=category,
        velocity=velocity,
    )
    scores = np.concatenate([source.beta(4, 2, OBJECTS), source.beta(1, 4, false_alarms)])
    return DetectedBoxes(boxes=detected, scores=scores), truth.select(np.arange(OBJECTS))
