"""The baselines' predictions of one sample, for each task.

Motion is rasterised as labels are, so that a perfect outlook scores 100: at every moment in the ego frame of that
moment, and warped to the present. So the expected boxes are put into the ego frames that the ego expects for itself,
and go through the labels' own rasteriser and warps.
"""

from __future__ import annotations

import math

import numpy as np

from deepaccident_devkit.baselines.collisions import DANGER_DISTANCE, accidents_ahead
from deepaccident_devkit.baselines.outlook import MotionModel, outlook
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.motion import FrameBoxes, MotionLabelConfig, motion_labels_from_boxes
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.v2x import Agents, Link, future_egomotion
from deepaccident_devkit.v2x.cooperation import SeenActors, seen_actors

_ENOUGH_POINTS = 10.0
"""LiDAR points that add to a score half of what any number of them can add."""


def predict_motion(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    config: MotionLabelConfig | None = None,
) -> MotionOutput:
    """The instance maps that some agents expect, one prediction, rasterised as the labels that `config` describes.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: who cooperates, as of `v2x.cooperating_agents`.
        model: how actors go on.
        link: what happens to the partners' data; None for nothing.
        config: of the labels; None for the released ones. Its `agents` and `filter_invisible` have no effect.

    Raises:
        DeepAccidentError: as of `v2x.cooperation.seen_actors`; no such model.
    """
    chosen = config or MotionLabelConfig()
    ahead = outlook(dataset, sample, agents=agents, model=model, link=link)
    return motion_of(ahead.seen, ahead.poses(label_times(chosen)), dataset.ego_from(sample, LIDAR), chosen)


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
    labels = motion_labels_from_boxes(frames, motion, config, is_vehicle=seen.has_own).to_present()
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


def predict_accidents(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    horizon: float = 2.0,
    danger_distance: float = DANGER_DISTANCE,
) -> list[Accident]:
    """The accidents that some agents expect, the surest first; `collisions.accidents_ahead` says how.

    Args:
        dataset: the release.
        sample: as of `predict_motion`, and so are `agents`, `model` and `link`.
        agents: who cooperates.
        model: how actors go on.
        link: what happens to the partners' data.
        horizon: seconds to look ahead.
        danger_distance: metres; whose boxes come nearer to each other collide.

    Raises:
        ConfigError: an impossible horizon or distance.
        DeepAccidentError: as of `predict_motion`.
    """
    for name, value in (("horizon", horizon), ("danger_distance", danger_distance)):
        if not 0 < value < math.inf:
            raise ConfigError(f"{name}: expected a number above 0, found {value!r}")
    ahead = outlook(dataset, sample, agents=agents, model=model, link=link)
    return accidents_ahead(ahead, horizon, danger_distance)


def predict_detections(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> DetectedBoxes:
    """The boxes that some agents see, in world, and the ego's own.

    The score is (agents that see it + p / (p + 10)) / 6 with p the LiDAR points that they have on it: in (0, 1), and 0
    for the ego itself, which no detector sees and only the released protocol counts.

    Args:
        dataset: the release.
        sample: as of `predict_motion`, and so are `agents` and `link`.
        agents: who cooperates.
        link: what happens to the partners' data.

    Raises:
        DeepAccidentError: as of `v2x.cooperation.seen_actors`.
    """
    seen = seen_actors(dataset, sample, agents=agents, link=link, frame="world")
    watchers = np.unpackbits(seen.seen_by[:, None], axis=1).sum(axis=1)
    points = seen.boxes.num_lidar_pts
    scores = (watchers + points / (points + _ENOUGH_POINTS)) / (len(AGENTS) + 1)
    return DetectedBoxes(boxes=seen.boxes, scores=np.where(seen.boxes.actor_id == OWN_ACTOR_ID, 0.0, scores))
