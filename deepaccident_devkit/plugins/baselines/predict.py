"""The baselines' predictions of one sample, for each task.

Motion is rasterised in the same way as labels, so that a perfect outlook scores 100: at every
moment in the ego frame of that moment, and warped to the present. So the expected boxes are
transformed to the ego frames that the ego expects for itself, and go through the rasteriser and
warps of the labels.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Final

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

# Metres between boxes below which actors collide. The evaluation's 1 m, which allows for cells,
# would raise an alarm for every car that passes a cyclist.
DANGER_DISTANCE: Final = 0.25
# Minimum length of paths in seconds, which the metrics of plans and of forecasts need.
PATH_HORIZON: Final = 3.0
# Seconds between successive positions of a path.
PATH_STEP: Final = 0.5
# Distance within which two alarms belong to one accident; the surer alarm is retained.
_SITE_RADIUS_M: Final = 10.0
# Distance that an actor must cover to count as moving.
_MIN_PROGRESS_M: Final = 0.5
# Largest difference between the headings of two vehicles that drive one behind the other.
_MAX_HEADING_DIFFERENCE_RAD: Final = np.radians(20)
# Largest lateral offset of a vehicle that is straight ahead of another one.
_MAX_LATERAL_OFFSET_M: Final = 1.0
# Lowest score of detected boxes that are used.
_MIN_BOX_SCORE: Final = 0.5
# Distance from the ego's centre within which a detected box is the ego itself.
_EGO_RADIUS_M: Final = 2.0
_PEDESTRIAN: Final = CATEGORIES.index("pedestrian")
# Number of LiDAR points that gives half of the score which points can add.
_HALF_SCORE_POINTS: Final = 10.0


def predict_motion(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    config: MotionLabelConfig | None = None,
) -> MotionOutput:
    """Return the instance maps that some agents expect: one prediction, rasterised as labels.

    Args:
        dataset: The release.
        sample: Token or record; its agent is the ego, its frame the present.
        agents: The cooperating agents, as in `v2x.cooperating_agents`.
        model: Motion model of the actors.
        link: Degradation of the partners' data; None for none.
        config: Config of the labels; None for the released ones. Its `agents` and
            `filter_invisible` have no effect.

    Raises:
        DeepAccidentError: As in `v2x.cooperation.seen_actors`; or there is no such model.
    """
    config = config or MotionLabelConfig()
    actors = outlook(dataset, sample, agents=agents, model=model, link=link)
    poses = actors.poses(label_times(config))
    return motion_prediction(actors.seen, poses, dataset.ego_from(sample, LIDAR), config)


def label_times(config: MotionLabelConfig) -> FloatArray:
    """Return the times of the labels' frames, in seconds from the present, shape (T,)."""
    return np.arange(config.label_frames, dtype=np.float64) * (config.step * FRAME_PERIOD)


def motion_prediction(
    actors: SeenActors, poses: FloatArray, ego_from_lidar: SE3, config: MotionLabelConfig
) -> MotionOutput:
    """Return one prediction as instance maps, from poses (T, N, 3) of N actors at `label_times`.

    Poses are x forward, y left (metres), yaw (radians), in the present ego frame. The released
    labels move the ego's own box by `ego_from_lidar`.
    """
    present_from_ego = _ego_poses(poses, has_own=actors.has_own)
    frames = []
    for frame_poses, present in zip(poses, present_from_ego, strict=True):
        lidar_from_present = (present @ ego_from_lidar).inverse()
        frames.append(_frame_boxes(actors, frame_poses, lidar_from_present, ego_from_lidar))
    past = [SE3.identity()] * (config.receptive_field - 1)
    motion = future_egomotion([*past, *present_from_ego, present_from_ego[-1]])
    labels = motion_labels_from_boxes(
        frames, motion, config, is_vehicle=actors.has_own
    ).to_present()
    return MotionOutput(grid=config.grid, instances=labels.instance[None])


def _ego_poses(poses: FloatArray, *, has_own: bool) -> list[SE3]:
    """Return the pose of the ego frame at each moment, in the present ego frame.

    It moves with the ego's box, which is the first actor; the infrastructure stands still.
    """
    if not has_own:
        return [SE3.identity()] * len(poses)
    present_from_box = [SE3.from_yaw(yaw, (x, y, 0.0)) for x, y, yaw in poses[:, 0].tolist()]
    box_from_ego = present_from_box[0].inverse()
    return [pose @ box_from_ego for pose in present_from_box]


def _frame_boxes(
    actors: SeenActors, poses: FloatArray, lidar_from_present: SE3, ego_from_lidar: SE3
) -> FrameBoxes:
    """Return the boxes that would be annotated at a moment, all of them visible."""
    boxes = actors.boxes
    centers = np.column_stack([poses[:, :2], boxes.center[:, 2]])
    return FrameBoxes(
        center=lidar_from_present.apply(centers),
        size=boxes.size,
        yaw=poses[:, 2] + lidar_from_present.yaw,
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
    """Return the accidents that some agents expect, the surest first, as in `accidents_ahead`.

    Args:
        dataset: The release.
        sample: Token or record, as in `predict_motion`.
        agents: The cooperating agents, as in `predict_motion`.
        model: Motion model of the actors, as in `predict_motion`.
        link: Degradation of the partners' data, as in `predict_motion`.
        horizon: Seconds to look ahead.
        danger_distance: Metres; actors with boxes that come nearer to each other collide.

    Raises:
        ConfigError: An impossible horizon or distance.
        DeepAccidentError: As in `predict_motion`.
    """
    for name, value in (("horizon", horizon), ("danger_distance", danger_distance)):
        if not 0 < value < math.inf:
            raise ConfigError(f"{name}: expected a number above 0, found {value!r}")
    actors = outlook(dataset, sample, agents=agents, model=model, link=link)
    return accidents_ahead(actors, horizon, danger_distance)


def detected_accidents(
    dataset: Dataset, sample: RowArgument, detected: DetectedBoxes, *, horizon: float = 2.0
) -> list[Accident]:
    """Return the accidents that follow from a detector's boxes at constant velocity.

    The surest comes first; accidents have no actors' ids. The only label that this reads is the
    ego's own box, because a car knows itself; boxes on it are the ego, as seen by partners.

    Args:
        dataset: The release.
        sample: Token or record; its agent is the ego.
        detected: Boxes of the sample, in any of its frames; boxes with a score below a half are
            ignored.
        horizon: Seconds to look ahead.

    Raises:
        DeepAccidentError: As in `seen_actors`.
    """
    single = seen_actors(dataset, sample)
    ego_box = single.boxes.select(single.boxes.actor_id == OWN_ACTOR_ID)
    boxes = detected.boxes.select(detected.scores >= _MIN_BOX_SCORE)
    ego_from_world = dataset.world_from(sample, ego_box.frame).inverse()
    ego_from_source = ego_from_world @ dataset.world_from(sample, boxes.frame)
    boxes = boxes.transform(ego_from_source, ego_box.frame)
    offsets = boxes.center[:, None, :2] - ego_box.center[None, :, :2]
    distances = np.linalg.norm(offsets, axis=-1)
    other_boxes = boxes.select((distances > _EGO_RADIUS_M).all(axis=1))
    actor_boxes = concatenate([ego_box, other_boxes], ego_box.frame)
    actors = replace(single, boxes=actor_boxes, seen_by=np.zeros(len(actor_boxes), dtype=np.uint8))
    return accidents_ahead(Outlook(seen=actors, turn_rate=np.zeros(len(actor_boxes))), horizon)


def predict_detections(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> DetectedBoxes:
    """Return the boxes that some agents see, in the world frame, and the ego's own box.

    The score is (agents that see it + p / (p + 10)) / 6 with p the LiDAR points that they have on
    it: in (0, 1), and 0 for the ego itself, which no detector sees and only the released protocol
    counts.

    Args:
        dataset: The release.
        sample: Token or record, as in `predict_motion`.
        agents: The cooperating agents, as in `predict_motion`.
        link: Degradation of the partners' data, as in `predict_motion`.

    Raises:
        DeepAccidentError: As in `v2x.cooperation.seen_actors`.
    """
    actors = seen_actors(dataset, sample, agents=agents, link=link, frame="world")
    agent_counts = np.unpackbits(actors.seen_by[:, None], axis=1).sum(axis=1)
    points = actors.boxes.num_lidar_pts
    scores = (agent_counts + points / (points + _HALF_SCORE_POINTS)) / (len(AGENTS) + 1)
    is_ego = actors.boxes.actor_id == OWN_ACTOR_ID
    return DetectedBoxes(boxes=actors.boxes, scores=np.where(is_ego, 0.0, scores))


def predict_forecasts(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    horizon: float = PATH_HORIZON,
) -> list[Forecast]:
    """Return forecasts of the actors that some agents see, with one mode of probability 1 each.

    The ego itself is left out.

    Args:
        dataset: The release.
        sample: Token or record, as in `predict_motion`.
        agents: The cooperating agents, as in `predict_motion`.
        model: Motion model of the actors, as in `predict_motion`.
        link: Degradation of the partners' data, as in `predict_motion`.
        horizon: Seconds to look ahead, a multiple of 0.5.

    Raises:
        ConfigError: The horizon is no number of steps.
        DeepAccidentError: As in `predict_motion`.
    """
    actors = outlook(dataset, sample, agents=agents, model=model, link=link)
    times = path_times(horizon)
    positions = actors.poses(times)[..., :2]
    forecasts = []
    for row, actor_id in enumerate(actors.seen.boxes.actor_id.tolist()):
        if actor_id != OWN_ACTOR_ID:
            paths = positions[None, :, row]
            forecasts.append(
                Forecast(actor_id=actor_id, times=times, paths=paths, probabilities=np.ones(1))
            )
    return forecasts


def predict_plan(
    dataset: Dataset,
    sample: RowArgument,
    *,
    model: MotionModel = "constant_velocity",
    horizon: float = PATH_HORIZON,
) -> Plan:
    """Return the ego's own path if its motion continues.

    Arguments and errors are as in `predict_forecasts`.

    Raises:
        NotAvailableError: The sample is of the infrastructure, which drives nowhere, or has no
            label.
    """
    actors = outlook(dataset, sample, model=model)
    if not actors.seen.has_own:
        token = dataset.get("sample", sample)["token"]
        raise NotAvailableError(
            f"{token}: has no own vehicle to plan for; choose a sample of a vehicle"
        )
    times = path_times(horizon)
    poses = _ego_poses(actors.poses(np.append(0.0, times)), has_own=True)
    present_from_ego = [poses[0].inverse() @ pose for pose in poses[1:]]
    path = np.array([pose.translation[:2] for pose in present_from_ego])
    return Plan(times=times, path=path, yaw=np.array([pose.yaw for pose in present_from_ego]))


def path_times(horizon: float) -> FloatArray:
    """Return times up to a horizon of at most 100 s, in seconds after the present, shape (T,).

    Steps are of 0.5 s. Raises ConfigError for another horizon.
    """
    steps = horizon / PATH_STEP
    if not (0.5 <= horizon <= 100 and abs(steps - round(steps)) < 1e-6):
        raise ConfigError(
            f"horizon: {horizon!r} s is no number of steps of 0.5 s; choose 0.5, 1, 1.5, … up to "
            "100"
        )
    return np.arange(1.0, round(steps) + 1) * PATH_STEP


def accidents_ahead(
    outlook: Outlook, horizon: float, danger_distance: float = DANGER_DISTANCE
) -> list[Accident]:
    """Return the accidents of an outlook within a horizon (seconds), in the present ego frame.

    The surest accident comes first. A pair is reported at the first moment, in steps of 0.1 s, at
    which the gap between its boxes is below the danger distance. There is no danger for two actors
    that stand still, for two that are already near and come no nearer, and for two pedestrians. A
    driver behind another vehicle straight ahead brakes: at constant velocity every queue would be
    an accident. The score is (1 − least gap / danger distance) / (1 + seconds to that moment): 1
    for two actors that touch now. Predicted positions of the same accident vary with time, so only
    the surest of the alarms within 10 m is retained. Ids are None for a pair with the ego if the
    ego's own id is unknown.
    """
    times = np.arange(round(horizon / FRAME_PERIOD) + 1, dtype=np.float64) * FRAME_PERIOD
    poses = outlook.poses(times)
    rows, other_rows = _candidate_pairs(outlook, poses, danger_distance)
    if not len(rows):
        return []
    gaps = _gaps(outlook, poses, rows, other_rows)
    is_near = gaps < danger_distance
    moments = np.argmax(is_near, axis=0)
    min_gaps = gaps.min(axis=0)
    is_approaching = (moments > 0) | (min_gaps < gaps[0])
    is_touching = gaps[0] == 0
    is_dangerous = (is_approaching & ~_is_driving_up(poses[0], rows, other_rows)) | is_touching
    scores = (1 - min_gaps / danger_distance) / (1 + times[moments])
    alarms = []
    for index in np.flatnonzero(is_near.any(axis=0) & is_dangerous):
        pair = (int(rows[index]), int(other_rows[index]))
        alarms.append(_accident(outlook, poses, pair, int(moments[index]), float(scores[index])))
    return _surest_of_each_site(alarms)


def _candidate_pairs(
    outlook: Outlook, poses: FloatArray, danger_distance: float
) -> tuple[IntArray, IntArray]:
    """Return pairs of actors that may come within the danger distance, as rows of the boxes.

    Their circumscribed circles come that near at some moment. At least one of them moves, and at
    least one is no pedestrian.
    """
    positions, sizes = poses[..., :2], outlook.seen.boxes.size
    radii = np.hypot(sizes[:, 0], sizes[:, 1]) / 2
    distances = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
    min_distances = distances.min(axis=0, initial=np.inf)
    is_moving = np.linalg.norm(np.ptp(positions, axis=0), axis=-1) >= _MIN_PROGRESS_M
    is_vehicle = outlook.seen.boxes.category != _PEDESTRIAN
    is_candidate = (
        (min_distances < radii[:, None] + radii + danger_distance)
        & (is_moving[:, None] | is_moving)
        & (is_vehicle[:, None] | is_vehicle)
    )
    rows, other_rows = np.nonzero(np.triu(is_candidate, 1))
    return rows, other_rows


def _is_driving_up(poses: FloatArray, rows: IntArray, other_rows: IntArray) -> BoolArray:
    """Return the pairs with one actor straight ahead of the other, heading the same way, (P,).

    `poses` are of the present, shape (N, 3); pairs are given by the actors' rows, shape (P,) each.
    """
    differences = poses[other_rows] - poses[rows]
    yaw_differences = np.arctan2(np.sin(differences[:, 2]), np.cos(differences[:, 2]))
    yaws = poses[rows, 2]
    lateral_offsets = np.cos(yaws) * differences[:, 1] - np.sin(yaws) * differences[:, 0]
    is_ahead: BoolArray = (np.abs(yaw_differences) < _MAX_HEADING_DIFFERENCE_RAD) & (
        np.abs(lateral_offsets) < _MAX_LATERAL_OFFSET_M
    )
    return is_ahead


def _gaps(outlook: Outlook, poses: FloatArray, rows: IntArray, other_rows: IntArray) -> FloatArray:
    """Return the gaps between the boxes of P pairs, in metres, shape (T, P)."""
    sizes = np.broadcast_to(outlook.seen.boxes.size[:, :2], (*poses.shape[:2], 2))
    footprints = np.concatenate([poses[..., :2], sizes, poses[..., 2:]], axis=-1)
    return gaps_of_pairs(footprints[:, rows], footprints[:, other_rows])


def _accident(
    outlook: Outlook, poses: FloatArray, pair: tuple[int, int], moment: int, score: float
) -> Accident:
    """Return the accident of a pair at the index of a moment."""
    actor_id, other_id = (_actor_id(outlook, row) for row in pair)
    return Accident(
        positions=poses[moment, list(pair), :2],
        time=moment * FRAME_PERIOD,
        score=score,
        ids=None if actor_id is None or other_id is None else (actor_id, other_id),
    )


def _actor_id(outlook: Outlook, row: int) -> int | None:
    """Return the id of an actor; None if it is unknown."""
    actor_id: int = outlook.seen.boxes.actor_id.item(row)
    if actor_id == OWN_ACTOR_ID:
        return outlook.seen.own_actor_id
    return None if actor_id == UNTRACKED_ID else actor_id


def _surest_of_each_site(alarms: list[Accident]) -> list[Accident]:
    """Return the surest alarm of each site.

    Of equally sure alarms, the earliest is retained; ties are broken by position and ids.
    """

    def order(alarm: Accident) -> tuple[Any, ...]:
        return -alarm.score, alarm.time, alarm.positions.tolist(), alarm.ids or ()

    retained: list[Accident] = []
    for alarm in sorted(alarms, key=order):
        site = alarm.positions.mean(axis=0)
        distances = [np.linalg.norm(site - other.positions.mean(axis=0)) for other in retained]
        if all(distance >= _SITE_RADIUS_M for distance in distances):
            retained.append(alarm)
    return retained
