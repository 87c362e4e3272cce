"""The baselines' predictions of one sample, for each task.

Motion is rasterised as labels are, so that a perfect outlook scores 100: at every moment in the ego frame of that
moment, and warped to the present. So the expected boxes are put into the ego frames that the ego expects for itself,
and go through the labels' own rasteriser and warps.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput
from deepaccident_devkit.evaluation.forecasting import Forecast
from deepaccident_devkit.evaluation.planning.scene import Plan
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.motion import FrameBoxes, MotionLabelConfig, motion_labels_from_boxes
from deepaccident_devkit.plugins.baselines.outlook import MotionModel, Outlook, outlook
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CATEGORIES,
    FRAME_PERIOD,
    LIDAR,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
)
from deepaccident_devkit.v2x import Agents, Link, future_egomotion
from deepaccident_devkit.v2x.cooperation import SeenActors, seen_actors

# Metres: actors that come nearer to each other collide. The evaluation's 1 m, which allows for cells, would be an
# alarm for every car that passes a cyclist.
DANGER_DISTANCE: Final = 0.25
# Seconds that paths go on, at least, as the metrics of plans and of forecasts need them.
PATH_HORIZON: Final = 3.0
# Seconds from one place of a path to the next.
PATH_STEP: Final = 0.5
# Metres within which two alarms are of one accident: the surer one is kept.
_SITE: Final = 10.0
# Metres that an actor must cover to count as moving.
_MOVES: Final = 0.5
# Between the headings of two that drive one behind the other.
_SAME_WAY: Final = np.radians(20)
# Metres to the side within which one is straight ahead of the other.
_SAME_LANE: Final = 1.0
# The least score of a detected box that counts.
_LIKELY: Final = 0.5
# Metres from the ego's centre within which a detected box is the ego.
_ON_IT: Final = 2.0
_PEDESTRIAN: Final = CATEGORIES.index("pedestrian")
# LiDAR points that add to a score half of what any number of them can add.
_ENOUGH_POINTS = 10.0


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
    return motion_prediction(
        ahead.seen, ahead.poses(label_times(chosen)), dataset.ego_from(sample, LIDAR), chosen
    )


def label_times(config: MotionLabelConfig) -> FloatArray:
    """(T,) seconds from the present of the frames that labels show."""
    return np.arange(config.label_frames, dtype=np.float64) * (config.step * FRAME_PERIOD)


def motion_prediction(
    seen: SeenActors, poses: FloatArray, ego_from_lidar: SE3, config: MotionLabelConfig
) -> MotionOutput:
    """One prediction as instance maps, where the N actors are at poses (T, N, 3) at `label_times`.

    Poses are x forward, y left (metres), yaw (radians), in the present ego frame. The released labels move the ego's
    own box by `ego_from_lidar`.
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


def _frame_boxes(
    seen: SeenActors, pose: FloatArray, lidar_from_present: SE3, ego_from_lidar: SE3
) -> FrameBoxes:
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


def detected_accidents(
    dataset: Dataset, sample: RowArgument, detected: DetectedBoxes, *, horizon: float = 2.0
) -> list[Accident]:
    """The accidents that a detector's boxes mean at constant velocity, the surest first, without actors' ids.

    Of the labels this reads the ego's own box, as a car knows itself; boxes on it are the ego, seen by partners.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego.
        detected: boxes of the sample, in any frame of it; those count that are more likely there than not.
        horizon: seconds to look ahead.

    Raises:
        DeepAccidentError: as of `seen_actors`.
    """
    alone = seen_actors(dataset, sample)
    own = alone.boxes.select(alone.boxes.actor_id == OWN_ACTOR_ID)
    found = detected.boxes.select(detected.scores >= _LIKELY)
    ego_from_source = dataset.world_from(sample, own.frame).inverse() @ dataset.world_from(
        sample, found.frame
    )
    found = found.transform(ego_from_source, own.frame)
    apart = np.linalg.norm(found.center[:, None, :2] - own.center[None, :, :2], axis=-1)
    boxes = concatenate([own, found.select((apart > _ON_IT).all(axis=1))], own.frame)
    seen = replace(alone, boxes=boxes, seen_by=np.zeros(len(boxes), dtype=np.uint8))
    return accidents_ahead(Outlook(seen=seen, turn_rate=np.zeros(len(boxes))), horizon)


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
    return DetectedBoxes(
        boxes=seen.boxes, scores=np.where(seen.boxes.actor_id == OWN_ACTOR_ID, 0.0, scores)
    )


def predict_forecasts(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    horizon: float = PATH_HORIZON,
) -> list[Forecast]:
    """Where the actors go that some agents see, the ego itself left out: one mode of probability 1 each.

    Args:
        dataset: the release.
        sample: as of `predict_motion`, and so are `agents`, `model` and `link`.
        agents: who cooperates.
        model: how actors go on.
        link: what happens to the partners' data.
        horizon: seconds to look ahead, in steps of 0.5.

    Raises:
        ConfigError: the horizon is no number of steps.
        DeepAccidentError: as of `predict_motion`.
    """
    ahead = outlook(dataset, sample, agents=agents, model=model, link=link)
    times = path_times(horizon)
    places, boxes = ahead.poses(times)[..., :2], ahead.seen.boxes
    return [
        Forecast(actor_id=actor, times=times, paths=places[None, :, row], probabilities=np.ones(1))
        for row, actor in enumerate(boxes.actor_id.tolist())
        if actor != OWN_ACTOR_ID
    ]


def predict_plan(
    dataset: Dataset,
    sample: RowArgument,
    *,
    model: MotionModel = "constant_velocity",
    horizon: float = PATH_HORIZON,
) -> Plan:
    """The ego's own path if it goes on as it does; arguments and errors as of `predict_forecasts`.

    Raises:
        NotAvailableError: the sample is of the infrastructure, which drives nowhere, or has no label.
    """
    ahead = outlook(dataset, sample, model=model)
    if not ahead.seen.has_own:
        token = dataset.get("sample", sample)["token"]
        raise NotAvailableError(
            f"{token}: has no own vehicle to plan for; choose a sample of a vehicle"
        )
    times = path_times(horizon)
    poses = _ego_poses(ahead.poses(np.append(0.0, times)), has_own=True)
    present_from_ego = [poses[0].inverse() @ pose for pose in poses[1:]]
    path = np.array([pose.translation[:2] for pose in present_from_ego])
    return Plan(times=times, path=path, yaw=np.array([pose.yaw for pose in present_from_ego]))


def path_times(horizon: float) -> FloatArray:
    """(T,) seconds after the present up to a horizon, in steps of 0.5, of 100 at most; raises ConfigError otherwise."""
    steps = horizon / PATH_STEP
    if not (0.5 <= horizon <= 100 and abs(steps - round(steps)) < 1e-6):
        raise ConfigError(
            f"horizon: {horizon!r} s is no number of steps of 0.5 s; choose 0.5, 1, 1.5, … up to 100"
        )
    return np.arange(1.0, round(steps) + 1) * PATH_STEP


def accidents_ahead(
    outlook: Outlook, horizon: float, danger_distance: float = DANGER_DISTANCE
) -> list[Accident]:
    """The accidents of an outlook within a horizon (seconds), the surest first, in the present ego frame.

    A pair is named at the first moment, in steps of 0.1 s, at which the gap between its boxes is below the danger
    distance. There is no danger for two that stand, for two that are already near and come no nearer, and for two
    pedestrians. A driver behind somebody straight ahead brakes: at constant velocity every queue would be an accident.
    The score is (1 − least gap / danger distance) / (1 + seconds to that moment): 1 for two that touch now. Later the
    place of an accident is no longer the same, so of alarms within 10 m the surest is kept. Ids are None for a pair
    with the ego where its own is not known.
    """
    times = np.arange(round(horizon / FRAME_PERIOD) + 1, dtype=np.float64) * FRAME_PERIOD
    poses = outlook.poses(times)
    first, second = _candidates(outlook, poses, danger_distance)
    if not len(first):
        return []
    gap = _gaps(outlook, poses, first, second)
    near = gap < danger_distance
    moment = np.argmax(near, axis=0)
    least = gap.min(axis=0)
    approaching = (moment > 0) | (least < gap[0])
    approaching = (approaching & ~_is_driving_up(poses[0], first, second)) | (gap[0] == 0)
    score = (1 - least / danger_distance) / (1 + times[moment])
    alarms = [
        _accident(
            outlook, poses, (int(first[row]), int(second[row])), int(moment[row]), float(score[row])
        )
        for row in np.flatnonzero(near.any(axis=0) & approaching)
    ]
    return _one_a_site(alarms)


def _candidates(
    outlook: Outlook, poses: FloatArray, danger_distance: float
) -> tuple[IntArray, IntArray]:
    """Pairs (rows of the boxes) whose circles meet at some moment, not both standing nor both on foot."""
    place, size = poses[..., :2], outlook.seen.boxes.size
    reach = np.hypot(size[:, 0], size[:, 1]) / 2
    apart = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1).min(axis=0, initial=np.inf)
    moves = np.linalg.norm(np.ptp(place, axis=0), axis=-1) >= _MOVES
    drives = outlook.seen.boxes.category != _PEDESTRIAN
    near = (
        (apart < reach[:, None] + reach + danger_distance)
        & (moves[:, None] | moves)
        & (drives[:, None] | drives)
    )
    first, second = np.nonzero(np.triu(near, 1))
    return first, second


def _is_driving_up(poses: FloatArray, first: IntArray, second: IntArray) -> BoolArray:
    """(P,) pairs of which one is straight ahead of the other and heads the same way; `poses` (N, 3) of the present."""
    way = poses[second] - poses[first]
    turn, yaw = np.arctan2(np.sin(way[:, 2]), np.cos(way[:, 2])), poses[first, 2]
    aside = np.cos(yaw) * way[:, 1] - np.sin(yaw) * way[:, 0]
    is_ahead: BoolArray = (np.abs(turn) < _SAME_WAY) & (np.abs(aside) < _SAME_LANE)
    return is_ahead


def _gaps(outlook: Outlook, poses: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """(T, P) metres between the boxes of P pairs."""
    size = np.broadcast_to(outlook.seen.boxes.size[:, :2], (*poses.shape[:2], 2))
    footprints = np.concatenate([poses[..., :2], size, poses[..., 2:]], axis=-1)
    return gaps_of_pairs(footprints[:, first], footprints[:, second])


def _accident(
    outlook: Outlook, poses: FloatArray, pair: tuple[int, int], moment: int, score: float
) -> Accident:
    one, other = (_actor_id(outlook, row) for row in pair)
    return Accident(
        positions=poses[moment, list(pair), :2],
        time=moment * FRAME_PERIOD,
        score=score,
        ids=None if one is None or other is None else (one, other),
    )


def _actor_id(outlook: Outlook, row: int) -> int | None:
    actor: int = outlook.seen.boxes.actor_id.item(row)
    return {OWN_ACTOR_ID: outlook.seen.own_actor_id, UNTRACKED_ID: None}.get(actor, actor)


def _one_a_site(alarms: list[Accident]) -> list[Accident]:
    """The surest alarm of each place; the earliest of equally sure ones, then by place and ids."""
    kept: list[Accident] = []
    for alarm in sorted(
        alarms, key=lambda each: (-each.score, each.time, each.positions.tolist(), each.ids or ())
    ):
        middle = alarm.positions.mean(axis=0)
        if all(np.linalg.norm(middle - other.positions.mean(axis=0)) >= _SITE for other in kept):
            kept.append(alarm)
    return kept
