"""Hand-made scenes for the accident metrics: cars of 4 m × 2 m that point ahead, at 2 Hz, seen from
an ego that stands still.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.motion import (
    FrameBoxes,
    MotionHeads,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_from_boxes,
)

# Where a car is at each of the five label frames, metres: x forward, y left; None where it is not.
VehiclePath = Sequence[tuple[float, float] | None]
FRAMES = 5
NO_EGO_MOTION = np.zeros((7, 6))


def parked_path(x: float, y: float) -> VehiclePath:
    return [(x, y)] * FRAMES


def shift_cars(
    cars: Mapping[int, VehiclePath], x: float = 0.0, y: float = 0.0
) -> dict[int, VehiclePath]:
    """Move the paths of all cars by the same offset, metres."""
    return {
        actor: [point and (point[0] + x, point[1] + y) for point in path]
        for actor, path in cars.items()
    }


def motion_labels_of(
    cars: Mapping[int, VehiclePath], frames: int = FRAMES, **config
) -> MotionLabels:
    """Make the labels, at the present, of cars by their actor ids; they are drawn in this order.

    The released rounding leaves corners on half metres exactly where they are, so that cells span
    4 m × 2 m, centre to centre.
    """
    settings = MotionLabelConfig(**{"draw_ego": False, **config})
    boxes: list[FrameBoxes | None] = [None] * settings.label_frames
    for frame in range(frames):
        boxes[frame] = _frame_boxes(
            {actor: path[frame] for actor, path in cars.items() if path[frame]}
        )
    valid = np.append(
        np.ones(2, dtype=bool),
        np.arange(settings.label_frames) < frames,
    )
    labels = motion_labels_from_boxes(boxes, NO_EGO_MOTION, settings, valid=valid)
    return labels.to_present("bilinear")


def to_instance_output(*labels: MotionLabels) -> MotionOutput:
    """Give the labels as predictions in instance maps."""
    return MotionOutput(
        grid=labels[0].config.grid, instances=np.stack([label.instance for label in labels])
    )


def to_heads_output(*labels: MotionLabels) -> MotionOutput:
    """Give the labels as predictions in heads."""
    return MotionOutput(
        grid=labels[0].config.grid, heads=tuple(MotionHeads.from_labels(label) for label in labels)
    )


def read_tallies(result) -> list[tuple[int, int, int]]:
    """Return true positives, false positives and missed accidents, by the distance allowed."""
    return [(cases.tp, cases.fp, cases.fn) for cases in result.within.values()]


def _frame_boxes(cars: Mapping[int, tuple[float, float]]) -> FrameBoxes:
    count = len(cars)
    positions = np.reshape(list(cars.values()), (count, 2))
    return FrameBoxes(
        center=np.column_stack([positions, np.zeros(count)]),
        size=np.tile([4.0, 2.0, 1.5], (count, 1)),
        yaw=np.zeros(count),
        actor_id=np.array(list(cars), dtype=np.int64),
        category=np.zeros(count),
        visible=np.ones(count, dtype=bool),
        ego_from_lidar=np.eye(4),
    )
