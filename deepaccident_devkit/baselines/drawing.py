"""Instance maps of an outlook, rasterised as labels are, so that a perfect outlook scores 100.

Labels are rasterised at every moment in the ego frame of that moment and warped to the present. So the expected boxes
are put into the ego frames that the ego expects for itself, and go through the labels' own rasteriser and warps.
"""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.baselines.oracle import SeenActors
from deepaccident_devkit.evaluation import MotionOutput
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.motion import FrameBoxes, MotionLabelConfig, MotionLabels, motion_labels_from_boxes
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import future_egomotion


def label_times(config: MotionLabelConfig) -> FloatArray:
    """(T,) seconds from the present of the frames that labels show."""
    return np.arange(config.label_frames, dtype=np.float64) * (config.step * FRAME_PERIOD)


def motion_of(seen: SeenActors, poses: FloatArray, ego_from_lidar: SE3, config: MotionLabelConfig) -> MotionOutput:
    """One prediction as instance maps.

    Args:
        seen: N actors; boxes in the present frame `ego`.
        poses: (T, N, 3) where they are at `label_times`: x forward, y left (metres), yaw (radians), in the present
            ego frame.
        ego_from_lidar: of the sample: the released labels move the ego's own box by it.
        config: of the labels that are to be foretold.
    """
    present_from_ego = _ego_poses(poses, has_own=seen.has_own)
    frames = [
        _frame_boxes(seen, pose, (present @ ego_from_lidar).inverse(), ego_from_lidar)
        for pose, present in zip(poses, present_from_ego, strict=True)
    ]
    past = [SE3.identity()] * (config.receptive_field - 1)
    motion = future_egomotion([*past, *present_from_ego, present_from_ego[-1]])
    labels: MotionLabels = motion_labels_from_boxes(frames, motion, config, is_vehicle=seen.has_own).to_present()
    return MotionOutput(grid=config.grid, instances=labels.instance[None])


def _ego_poses(poses: FloatArray, *, has_own: bool) -> list[SE3]:
    """Where the ego frame is at each moment, as it moves with the ego's box, which is the first; the pole stands."""
    if not has_own:
        return [SE3.identity()] * len(poses)
    present_from_box = [SE3.from_yaw(yaw, (x, y, 0.0)) for x, y, yaw in poses[:, 0].tolist()]
    box_from_ego = present_from_box[0].inverse()
    return [pose @ box_from_ego for pose in present_from_box]


def _frame_boxes(seen: SeenActors, pose: FloatArray, lidar_from_present: SE3, ego_from_lidar: SE3) -> FrameBoxes:
    """The boxes that would be annotated at a moment, all of them seen."""
    boxes = seen.boxes
    center = np.column_stack([pose[:, :2], boxes.center[:, 2]])
    return FrameBoxes(
        center=lidar_from_present.apply(center),
        size=boxes.size,
        yaw=pose[:, 2] + lidar_from_present.yaw,
        actor_id=boxes.actor_id,
        category=boxes.category,
        visible=np.ones(len(boxes), dtype=bool),
        ego_from_lidar=ego_from_lidar.matrix,
    )
