"""Average precision and errors of a frame of 30 objects and 40 detections; and of 300 detections,
untrained.
"""

import numpy as np

from benchmarks.measure import Figure, best_of, one_core
from deepaccident_devkit.evaluation.detection import DetectedBoxes, DetectionEvaluator
from deepaccident_devkit.geometry import Boxes

FRAMES, OBJECTS, REPEATS = 100, 30, 5
REFERENCE_MS = 7.7


def measure() -> list[Figure]:
    some, many = (
        [frame(seed, false_alarms) for seed in range(FRAMES)] for false_alarms in (10, 270)
    )
    with one_core():
        return [
            figure("detection_frame_ms", "released", some, bound=1.0, reference=REFERENCE_MS),
            figure("detection_paper_frame_ms", "paper", some),
            figure("detection_opencood_frame_ms", "opencood", some),
            figure("detection_crowded_frame_ms", "released", many),
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

    return Figure(
        name=name,
        value=1e3 / len(frames) * best_of(REPEATS, evaluate),
        unit="ms",
        bound=bound,
        reference=reference,
    )


def frame(seed: int, false_alarms: int) -> tuple[DetectedBoxes, Boxes]:
    """All objects found, about a metre off, and boxes where nothing is."""
    source = np.random.default_rng(seed)
    count = OBJECTS + false_alarms
    center = np.column_stack([source.uniform(-60, 60, (count, 2)), source.uniform(-2, 0, count)])
    size = source.uniform((3, 1.5, 1.4), (6, 2.5, 2.5), (count, 3))
    yaw, category = source.uniform(-np.pi, np.pi, count), source.integers(0, 6, count)
    velocity = np.column_stack([source.normal(0, 5, (count, 2)), np.zeros(count)])
    truth = Boxes.from_arrays(
        center, size, yaw, frame="lidar", category=category, velocity=velocity
    )
    off = center + source.normal(0, 0.6, center.shape)
    found = Boxes.from_arrays(
        off,
        size * 1.05,
        yaw + source.normal(0, 0.2, count),
        frame="lidar",
        category=category,
        velocity=velocity,
    )
    scores = np.concatenate([source.beta(4, 2, OBJECTS), source.beta(1, 4, false_alarms)])
    return DetectedBoxes(boxes=found, scores=scores), truth.select(np.arange(OBJECTS))
