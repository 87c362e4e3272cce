"""Predictions of the baselines for one sample, for each task.

Motion is rasterised exactly like labels, so that a perfect outlook scores 100. Labels are drawn at
each time in the ego frame of that time, then warped to t = 0. The expected boxes are therefore
transformed to the ego's expected future frames, and pass through the rasteriser and the warps of
the labels.
"""

import math
from dataclasses import replace
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput, Tracks
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

# Distance in metres between boxes below which actors collide. At the evaluation's 1 m, which allows
# for the size of cells, every car that passes a cyclist would raise an alarm.
DANGER_DISTANCE: Final = 0.25
# Shortest paths in seconds that the metrics for plans and forecasts accept.
PATH_HORIZON: Final = 3.0
# Seconds between successive positions on a path.
PATH_STEP: Final = 0.5
# Distance within which two alarms belong to the same accident; the higher-scoring one is kept.
_SITE_RADIUS_M = 10.0
# Distance that an actor must cover to count as moving.
_MIN_PROGRESS_M = 0.5
# Largest difference between the headings of two vehicles, one of which follows the other.
_MAX_HEADING_DIFFERENCE_RAD = np.radians(20)
# Largest lateral offset of a vehicle that is straight ahead of another one.
_MAX_LATERAL_OFFSET_M = 1.0
# Lowest score at which detected boxes are used.
_MIN_BOX_SCORE = 0.5
# Distance from the ego's centre within which a detected box is the ego itself.
_EGO_RADIUS_M = 2.0
_PEDESTRIAN = CATEGORIES.index("pedestrian")
# Number of LiDAR points that yields half of the score that points can add.
_HALF_SCORE_POINTS = 10.0


def predict_motion(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    config: MotionLabelConfig | None = None,
) -> MotionOutput:
    """Return the motion that some agents expect, as instance maps rasterised like labels.

    Args:
        dataset: The release.
        sample: Token or record of the sample; its agent is the ego, its frame is t = 0.
        agents: Agents that cooperate; see `v2x.cooperating_agents`.
        model: Motion model of the actors.
        link: Degradation of the partners' data; None for none.
        config: Config of the labels; None for the released labels. `agents` and `filter_invisible`
            are ignored.

    Raises:
        DeepAccidentError: For the reasons in `seen_actors`, or if `model` is not a motion model.
    """
    config = config or MotionLabelConfig()
    actors = outlook(dataset, sample, agents=agents, model=model, link=link)
    poses = actors.poses(label_times(config))
    return motion_prediction(actors.seen, poses, dataset.ego_from(sample, LIDAR), config)


def label_times(config: MotionLabelConfig) -> FloatArray:
    """Return the times of the labels' frames in seconds from t = 0, shape (T,)."""
    frames = np.arange(config.label_frames, dtype=np.float64)
    return frames * (config.step * FRAME_PERIOD)


def motion_prediction(
    actors: SeenActors, poses: FloatArray, ego_from_lidar: SE3, config: MotionLabelConfig
) -> MotionOutput:
    """Rasterise poses (T, N, 3) of N actors at `label_times` to one prediction of instance maps.

    Poses are x forward, y left (metres), yaw (radians), in the ego frame at t = 0. As in the
    released labels, the ego's own box is moved by `ego_from_lidar`.
    """
    ego_poses = _ego_poses(poses, has_own=actors.has_own)
    frames = []
    for frame_poses, present_from_ego in zip(poses, ego_poses, strict=True):
        lidar_from_present = (present_from_ego @ ego_from_lidar).inverse()
        frames.append(_frame_boxes(actors, frame_poses, lidar_from_present, ego_from_lidar))
    past_poses = [SE3.identity()] * (config.receptive_field - 1)
    egomotion = future_egomotion([*past_poses, *ego_poses, ego_poses[-1]])
    labels = motion_labels_from_boxes(frames, egomotion, config, is_vehicle=actors.has_own)
    return MotionOutput(grid=config.grid, instances=labels.to_present().instance[None])


def _ego_poses(poses: FloatArray, *, has_own: bool) -> list[SE3]:
    """Return `present_from_ego`, the ego's pose relative to t = 0, at each time.

    The ego frame moves with the ego's box, which is the first actor. The infrastructure does not
    move.
    """
    if not has_own:
        return [SE3.identity()] * len(poses)
    present_from_box = [SE3.from_yaw(yaw, (x, y, 0.0)) for x, y, yaw in poses[:, 0].tolist()]
    box_from_ego = present_from_box[0].inverse()
    return [pose @ box_from_ego for pose in present_from_box]


def _frame_boxes(
    actors: SeenActors, poses: FloatArray, lidar_from_present: SE3, ego_from_lidar: SE3
) -> FrameBoxes:
    """Return the boxes that would be annotated at one time; all are visible."""
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
    """Return the accidents that some agents expect, highest-scoring first; see `accidents_ahead`.

    Args:
        dataset: The release.
        sample: Token or record of the sample; see `predict_motion`.
        agents: Agents that cooperate; see `predict_motion`.
        model: Motion model of the actors; see `predict_motion`.
        link: Degradation of the partners' data; see `predict_motion`.
        horizon: Seconds to look ahead.
        danger_distance: Distance in metres between boxes below which actors collide.

    Raises:
        ConfigError: If the horizon or the distance is not allowed.
        DeepAccidentError: For the reasons in `predict_motion`.
    """
    for name, value in (("horizon", horizon), ("danger_distance", danger_distance)):
        if not 0 < value < math.inf:
            raise ConfigError(f"{name}: expected a number above 0, found {value!r}")
    actors = outlook(dataset, sample, agents=agents, model=model, link=link)
    return accidents_ahead(actors, horizon, danger_distance)


def detected_accidents(
    dataset: Dataset, sample: RowArgument, detected: DetectedBoxes, *, horizon: float = 2.0
) -> list[Accident]:
    """Return the accidents that a detector's boxes imply at constant velocity.

    The highest-scoring accident comes first. Accidents have no actor ids. Of the labels, only the
    ego's own box is read, because a car knows itself; detected boxes that overlap it are the ego as
    seen by partners.

    Args:
        dataset: The release.
        sample: Token or record of the sample; its agent is the ego.
        detected: Boxes detected in the sample, in any of its frames; boxes with a score below 0.5
            are ignored.
        horizon: Seconds to look ahead.

    Raises:
        DeepAccidentError: For the reasons in `seen_actors`.
    """
    seen = seen_actors(dataset, sample)
    ego_box = seen.boxes.select(seen.boxes.actor_id == OWN_ACTOR_ID)
    boxes = detected.boxes.select(detected.scores >= _MIN_BOX_SCORE)
    ego_from_world = dataset.world_from(sample, ego_box.frame).inverse()
    ego_from_source = ego_from_world @ dataset.world_from(sample, boxes.frame)
    boxes = boxes.transform(ego_from_source, ego_box.frame)
    offsets = boxes.center[:, None, :2] - ego_box.center[None, :, :2]
    distances = np.linalg.norm(offsets, axis=-1)
    is_other = (distances > _EGO_RADIUS_M).all(axis=1)
    boxes = concatenate([ego_box, boxes.select(is_other)], ego_box.frame)
    actors = replace(seen, boxes=boxes, seen_by=np.zeros(len(boxes), dtype=np.uint8))
    outlook_of_detections = Outlook(seen=actors, turn_rate=np.zeros(len(boxes)))
    return accidents_ahead(outlook_of_detections, horizon)


def predict_detections(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> DetectedBoxes:
    """Return the boxes that some agents see, and the ego's own box, in the world frame.

    The score of a box is (a + p / (p + 10)) / 6, in (0, 1): a is the number of agents that see it,
    and p is the number of LiDAR points that they have on it. The ego's own box has the score 0: no
    detector sees it, and only the released protocol counts it.

    Args:
        dataset: The release.
        sample: Token or record of the sample; see `predict_motion`.
        agents: Agents that cooperate; see `predict_motion`.
        link: Degradation of the partners' data; see `predict_motion`.

    Raises:
        DeepAccidentError: For the reasons in `v2x.cooperation.seen_actors`.
    """
    actors = seen_actors(dataset, sample, agents=agents, link=link, frame="world")
    agent_counts = np.unpackbits(actors.seen_by[:, None], axis=1).sum(axis=1)
    point_counts = actors.boxes.num_lidar_pts
    point_shares = point_counts / (point_counts + _HALF_SCORE_POINTS)
    scores = (agent_counts + point_shares) / (len(AGENTS) + 1)
    is_ego = actors.boxes.actor_id == OWN_ACTOR_ID
    return DetectedBoxes(boxes=actors.boxes, scores=np.where(is_ego, 0.0, scores))


def predict_tracks(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> Tracks:
    """Return the boxes of `predict_detections` as tracks; their ids are exact.

    The ego's own box and untracked boxes have no track. Arguments and errors are as for
    `predict_detections`.
    """
    detected = predict_detections(dataset, sample, agents=agents, link=link)
    rows = ~np.isin(detected.boxes.actor_id, (OWN_ACTOR_ID, UNTRACKED_ID))
    boxes = detected.boxes.select(rows)
    return Tracks(boxes=boxes, scores=detected.scores[rows], ids=boxes.actor_id)


def predict_forecasts(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    horizon: float = PATH_HORIZON,
) -> list[Forecast]:
    """Return forecasts of the actors that some agents see, each with one mode of probability 1.

    The ego itself is not forecast.

    Args:
        dataset: The release.
        sample: Token or record of the sample; see `predict_motion`.
        agents: Agents that cooperate; see `predict_motion`.
        model: Motion model of the actors; see `predict_motion`.
        link: Degradation of the partners' data; see `predict_motion`.
        horizon: Seconds to look ahead, a multiple of 0.5.

    Raises:
        ConfigError: If the horizon is not a multiple of 0.5.
        DeepAccidentError: As in `predict_motion`.
    """
    actors = outlook(dataset, sample, agents=agents, model=model, link=link)
    times = path_times(horizon)
    positions = actors.poses(times)[..., :2]
    certain = np.ones(1)
    forecasts = []
    for row, actor_id in enumerate(actors.seen.boxes.actor_id.tolist()):
        if actor_id == OWN_ACTOR_ID:
            continue
        paths = positions[None, :, row]
        forecast = Forecast(actor_id=actor_id, times=times, paths=paths, probabilities=certain)
        forecasts.append(forecast)
    return forecasts


def predict_plan(
    dataset: Dataset,
    sample: RowArgument,
    *,
    model: MotionModel = "constant_velocity",
    horizon: float = PATH_HORIZON,
) -> Plan:
    """Return the path that the ego takes if it continues its motion.

    Arguments and errors are as in `predict_forecasts`.

    Raises:
        NotAvailableError: If the sample belongs to the infrastructure, which does not drive, or has
            no label.
    """
    actors = outlook(dataset, sample, model=model)
    if not actors.seen.has_own:
        token = dataset.get("sample", sample)["token"]
        raise NotAvailableError(
            f"{token}: is a sample of the infrastructure, which does not drive; choose "
            "a sample of a vehicle"
        )
    times = path_times(horizon)
    actor_poses = actors.poses(np.append(0.0, times))
    present, *later_poses = _ego_poses(actor_poses, has_own=True)
    present_from_ego = [present.inverse() @ pose for pose in later_poses]
    path = np.array([pose.translation[:2] for pose in present_from_ego])
    yaw = np.array([pose.yaw for pose in present_from_ego])
    return Plan(times=times, path=path, yaw=yaw)


def path_times(horizon: float) -> FloatArray:
    """Return the times from 0.5 s to a horizon, in steps of 0.5 s, shape (T,).

    Raises:
        ConfigError: If the horizon is not a multiple of 0.5, or above 100 s.
    """
    steps = horizon / PATH_STEP
    if not (0.5 <= horizon <= 100 and abs(steps - round(steps)) < 1e-6):
        raise ConfigError(
            f"horizon: {horizon!r} s is not a multiple of 0.5 s; choose 0.5, 1, 1.5, … up to 100"
        )
    return np.arange(1.0, round(steps) + 1) * PATH_STEP


def accidents_ahead(
    outlook: Outlook, horizon: float, danger_distance: float = DANGER_DISTANCE
) -> list[Accident]:
    """Return the accidents in an outlook within a horizon (seconds), in the ego frame at t = 0.

    The highest-scoring accident comes first. A pair is reported at the first time, in steps of
    0.1 s, at which the gap between its boxes is below the danger distance. Three kinds of pairs are
    not in danger: two actors that stand still, two that are already near and come no nearer, and
    two pedestrians. A driver straight behind another vehicle is assumed to brake; otherwise, every
    queue would be an accident at constant velocity. The score is
    (1 − smallest gap / danger distance) / (1 + seconds to that time), which is 1 for two actors
    that touch now. Because the predicted position of an accident varies over time, only the
    highest-scoring of the alarms within 10 m is kept. In a pair with the ego, ids are None if the
    ego's own id is unknown.
    """
    frame_count = round(horizon / FRAME_PERIOD) + 1
    times = np.arange(frame_count, dtype=np.float64) * FRAME_PERIOD
    poses = outlook.poses(times)
    rows, other_rows = _candidate_pairs(outlook, poses, danger_distance)
    if not len(rows):
        return []
    sizes = np.broadcast_to(outlook.seen.boxes.size[:, :2], (*poses.shape[:2], 2))
    footprints = np.concatenate([poses[..., :2], sizes, poses[..., 2:]], axis=-1)
    gaps = gaps_of_pairs(footprints[:, rows], footprints[:, other_rows])
    min_gaps = gaps.min(axis=0)
    is_near = gaps < danger_distance
    moments = np.argmax(is_near, axis=0)
    is_touching = gaps[0] == 0
    is_approaching = (moments > 0) | (min_gaps < gaps[0])
    brakes = _is_driving_up(poses[0], rows, other_rows)
    is_dangerous = (is_approaching & ~brakes) | is_touching
    scores = (1 - min_gaps / danger_distance) / (1 + times[moments])
    alarms = []
    for index in np.flatnonzero(is_near.any(axis=0) & is_dangerous):
        pair = (int(rows[index]), int(other_rows[index]))
        alarms.append(_accident(outlook, poses, pair, int(moments[index]), float(scores[index])))
    return _surest_of_each_site(alarms)


def _candidate_pairs(
    outlook: Outlook, poses: FloatArray, danger_distance: float
) -> tuple[IntArray, IntArray]:
    """Return the P pairs of actors that may come within the danger distance.

    The circles around their boxes come that near at some time. At least one actor moves, and at
    least one is not a pedestrian.

    Returns:
        Indices of the boxes of the first and of the second actors, shape (P,) each.
    """
    positions = poses[..., :2]
    length, width, _ = outlook.seen.boxes.size.T
    radii = np.hypot(length, width) / 2
    distances = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
    min_distances = distances.min(axis=0, initial=np.inf)
    is_near = min_distances < radii[:, None] + radii + danger_distance
    progress = np.linalg.norm(np.ptp(positions, axis=0), axis=-1)
    is_moving = progress >= _MIN_PROGRESS_M
    is_vehicle = outlook.seen.boxes.category != _PEDESTRIAN
    one_moves = is_moving[:, None] | is_moving
    one_is_vehicle = is_vehicle[:, None] | is_vehicle
    is_candidate = is_near & one_moves & one_is_vehicle
    rows, other_rows = np.nonzero(np.triu(is_candidate, 1))
    return rows, other_rows


def _is_driving_up(poses: FloatArray, rows: IntArray, other_rows: IntArray) -> BoolArray:
    """Return whether either actor of each pair drives straight behind the other, shape (P,).

    Args:
        poses: x, y, yaw at t = 0, shape (N, 3).
        rows: Indices of the first actors, shape (P,).
        other_rows: Indices of the second actors, shape (P,).
    """
    dx, dy, turn = (poses[other_rows] - poses[rows]).T
    heading_difference = np.arctan2(np.sin(turn), np.cos(turn))
    yaw = poses[rows, 2]
    lateral_offset = np.cos(yaw) * dy - np.sin(yaw) * dx
    has_same_heading = np.abs(heading_difference) < _MAX_HEADING_DIFFERENCE_RAD
    is_in_line = np.abs(lateral_offset) < _MAX_LATERAL_OFFSET_M
    is_driving_up: BoolArray = has_same_heading & is_in_line
    return is_driving_up


def _accident(
    outlook: Outlook, poses: FloatArray, pair: tuple[int, int], moment: int, score: float
) -> Accident:
    """Return the accident of a pair (indices of the boxes) at a time (index into the poses)."""
    row, other_row = pair
    actor_id = _actor_id(outlook, row)
    other_id = _actor_id(outlook, other_row)
    ids = None
    if actor_id is not None and other_id is not None:
        ids = (actor_id, other_id)
    positions = poses[moment, list(pair), :2]
    return Accident(positions=positions, time=moment * FRAME_PERIOD, score=score, ids=ids)


def _actor_id(outlook: Outlook, row: int) -> int | None:
    """Return the id of an actor; None if it is unknown."""
    actor_id: int = outlook.seen.boxes.actor_id.item(row)
    if actor_id == OWN_ACTOR_ID:
        return outlook.seen.own_actor_id
    return None if actor_id == UNTRACKED_ID else actor_id


def _surest_of_each_site(alarms: list[Accident]) -> list[Accident]:
    """Keep the highest-scoring alarm at each place.

    Of alarms with equal scores, the earliest is kept; ties are broken by position and ids.
    """

    def sort_key(alarm: Accident) -> tuple[Any, ...]:
        ids = alarm.ids or ()
        return -alarm.score, alarm.time, alarm.positions.tolist(), ids

    retained_alarms: list[Accident] = []
    sites: list[FloatArray] = []
    for alarm in sorted(alarms, key=sort_key):
        site = alarm.positions.mean(axis=0)
        distances = [np.linalg.norm(site - retained_site) for retained_site in sites]
        if min(distances, default=np.inf) >= _SITE_RADIUS_M:
            retained_alarms.append(alarm)
            sites.append(site)
    return retained_alarms
