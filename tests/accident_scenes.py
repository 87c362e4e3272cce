"""Hand-made scenes for the accident metrics: cars of 4 m × 2 m that point ahead, at 2 Hz, in a
frame that stands.
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

Path = Sequence[tuple[float, float] | None]
"""Where a car is at each of the five label frames: x forward, y left; None where it is not."""
FRAMES = 5
STILL = np.zeros((7, 6))


def standing(x: float, y: float) -> Path:
    return [(x, y)] * FRAMES


def scene(cars: Mapping[int, Path], frames: int = FRAMES, **config) -> MotionLabels:
    """Labels, at the present, of cars by their actor ids; drawn in this order.

    The released rounding puts corners on half metres exactly where they are, so that cells span 4 m
    × 2 m, centre to centre.
    """
    there = [
        _frame({actor: path[t] for actor, path in cars.items() if path[t]}) for t in range(frames)
    ]
    settings = MotionLabelConfig(**{"draw_ego": False, **config})
    shown = [*there, *[None] * (settings.label_frames - frames)]
    valid = np.append(np.ones(2, dtype=bool), [frame is not None for frame in shown])
    return motion_labels_from_boxes(shown, STILL, settings, valid=valid).to_present("bilinear")


def as_maps(*labels: MotionLabels) -> MotionOutput:
    """The labels as predictions, given as instance maps."""
    return MotionOutput(
        grid=labels[0].config.grid, instances=np.stack([each.instance for each in labels])
    )


def as_heads(*labels: MotionLabels) -> MotionOutput:
    """The labels as predictions, given as heads."""
    return MotionOutput(
        grid=labels[0].config.grid, heads=tuple(MotionHeads.from_labels(each) for each in labels)
    )


def _frame(cars: Mapping[int, tuple[float, float]]) -> FrameBoxes:
    count = len(cars)
    return FrameBoxes(
        center=np.column_stack([np.reshape(list(cars.values()), (count, 2)), np.zeros(count)]),
        size=np.tile([4.0, 2.0, 1.5], (count, 1)),
        yaw=np.zeros(count),
        actor_id=np.array(list(cars), dtype=np.int64),
        category=np.zeros(count),
        visible=np.ones(count, dtype=bool),
        ego_from_lidar=np.eye(4),
    )
