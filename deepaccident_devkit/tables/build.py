"""Converts one scenario's files into the rows of every table; keys count within the scenario."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Final

import numpy as np

from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.release import Calibs, Meta
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.tables import boxes as box_rules
from deepaccident_devkit.tables.arrow_files import ColumnArrays
from deepaccident_devkit.tables.boxes import (
    ScenarioBoxes,
    decoded_velocities,
    displacement_velocities,
    fit_velocities,
)
from deepaccident_devkit.tables.columns import NULL_INTEGER
from deepaccident_devkit.tables.scan import ScenarioFiles
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    BEV_SHAPE,
    CAMERAS,
    CHANNEL_FORMAT,
    CHANNEL_MODALITY,
    CHANNELS,
    FILE_FORMATS,
    INFRASTRUCTURE,
    LIDAR,
    MODALITIES,
    OWN_ACTOR_ID,
    TIMES_OF_DAY,
    UNTRACKED_ID,
    VEHICLE_AGENTS,
    VELOCITY_FRAMES,
    frame_timestamp,
)

TRANSLATION_TOLERANCE: Final = 1e-3
"""Metres by which a sensor's position on its agent jitters.

The release computes it in single precision; measured: 2e-4 a few hundred metres from the world's
origin.
"""
ROTATION_TOLERANCE: Final = 1e-5
"""The same for the entries of its rotation; measured: 4e-7."""
_INTRINSIC_TOLERANCE = 1e-6


def scenario_rows(files: ScenarioFiles) -> dict[str, ColumnArrays]:
    """Return the rows of all tables except `sensor` and `category`, which scenarios share."""
    boxes = scenario_boxes(files)
    instance_rows, instance_of_box = box_rules.instances(boxes)
    centers = box_rules.world_centers(boxes)
    displacement = displacement_velocities(centers, boxes.agent, boxes.labels.actor_id, boxes.frame)
    velocity_frame = fit_velocities(boxes, displacement).best
    velocities = decoded_velocities(boxes, displacement, velocity_frame)
    annotations = _annotation_rows(files, boxes, instance_of_box, velocities)
    return {
        "scenario": _scenario_row(files, velocity_frame),
        "agent": _agent_rows(files, boxes),
        "frame": _frame_rows(files),
        "sample": _sample_rows(files),
        **sensor_tables(files.calibs, agents=len(files.scan.agents), frames=files.scan.num_frames),
        "instance": instance_rows,
        "annotation": annotations,
        "track": _track_rows(boxes, annotations, centers, velocities),
    }


def scenario_boxes(files: ScenarioFiles) -> ScenarioBoxes:
    """Return a scenario's boxes, and where each was recorded."""
    sample = np.repeat(np.flatnonzero(_sample_labelled(files)), files.labels.num_boxes)
    agent, frame = np.divmod(sample, files.scan.num_frames)
    agent_ids = [_actor_id(files, name) for name in files.scan.agents]
    actor_of_agent = np.array(agent_ids, dtype=np.int64)
    label_id = files.labels.actor_id
    return ScenarioBoxes(
        labels=files.labels,
        sample=sample,
        agent=agent,
        frame=frame + 1,
        agent_order=_agent_codes(files)[agent],
        actor=np.where(label_id == OWN_ACTOR_ID, actor_of_agent[agent], label_id),
        world_from_lidar=files.calibs.world_from_ego @ files.calibs.ego_from_lidar,
    )


def _scenario_row(files: ScenarioFiles, velocity_frame: str | None) -> ColumnArrays:
    scenario = files.scenario
    meta = files.meta
    signalized = "_subtype1_" in f"{scenario.scenario_type}_"
    collision = asdict(meta.collision) if meta and meta.collision else None
    design = accident_type(meta, signalized=signalized)
    meta_fields = ("weather", "road_type", "spawn_side", "ego_direction", "other_direction")
    time_of_day = velocity_code = NULL_INTEGER
    if meta and meta.time_of_day:
        time_of_day = TIMES_OF_DAY.index(meta.time_of_day)
    if velocity_frame is not None:
        velocity_code = [*VELOCITY_FRAMES].index(velocity_frame)
    return {
        "name": [scenario.name],
        "scenario_type": [scenario.scenario_type],
        "folder": [scenario.folder],
        "signalized": [signalized],
        "designed_accident": [scenario.scenario_type.endswith("_accident")],
        "town": [scenario.name.split("_")[0]],
        **{name: [getattr(meta, name, None)] for name in meta_fields},
        "time_of_day": [time_of_day],
        "collision": [collision],
        "accident_type": [NULL_INTEGER if design is None else design],
        "velocity_frame": [velocity_code],
        "num_frames": [files.scan.num_frames],
        "first_frame_row": [0],
        "last_frame_row": [files.scan.num_frames - 1],
        # Split files may change without the scenario: joining the tables fills this in.
        "split": [NULL_INTEGER],
    }


def _agent_rows(files: ScenarioFiles, boxes: ScenarioBoxes) -> ColumnArrays:
    count = len(files.scan.agents)
    category = np.full(count, NULL_INTEGER)
    size = np.full((count, 3), np.nan)
    # In reverse order, so that the first of several own rows overwrites the others.
    own_rows = np.flatnonzero(files.labels.actor_id == OWN_ACTOR_ID)[::-1]
    category[boxes.agent[own_rows]] = files.labels.category[own_rows]
    size[boxes.agent[own_rows]] = files.labels.size[own_rows]
    return {
        "scenario_row": np.zeros(count),
        "name": _agent_codes(files),
        "actor_id": [_actor_id(files, agent) for agent in files.scan.agents],
        "category": category,
        "size": size,
        "is_infrastructure": [agent == INFRASTRUCTURE for agent in files.scan.agents],
        "first_sample_row": np.arange(count) * files.scan.num_frames,
    }


def _frame_rows(files: ScenarioFiles) -> ColumnArrays:
    count = files.scan.num_frames
    previous, following = neighbour_rows(count, 1)
    return {
        "scenario_row": np.zeros(count),
        "index": np.arange(1, count + 1),
        "timestamp": timestamps(count),
        "time_to_impact": _times_to_impact(files),
        "prev_row": previous,
        "next_row": following,
    }


def _sample_rows(files: ScenarioFiles) -> ColumnArrays:
    agents = len(files.scan.agents)
    frames = files.scan.num_frames
    labelled = _sample_labelled(files)
    velocity = np.full((files.num_samples, 2), np.nan)
    velocity[labelled] = files.labels.agent_velocity
    num_boxes = np.zeros(files.num_samples, dtype=np.int64)
    num_boxes[labelled] = files.labels.num_boxes
    first_box = np.where(num_boxes > 0, np.cumsum(num_boxes) - num_boxes, NULL_INTEGER)
    previous, following = neighbour_rows(frames, agents)
    return {
        "frame_row": np.tile(np.arange(frames), agents),
        "scenario_row": np.zeros(files.num_samples),
        "agent_row": np.repeat(np.arange(agents), frames),
        "agent": np.repeat(_agent_codes(files), frames),
        "timestamp": np.tile(timestamps(frames), agents),
        "velocity": velocity,
        "time_to_end": np.tile(_times_to_end(frames), agents),
        "time_to_impact": np.tile(_times_to_impact(files), agents),
        "labelled": labelled,
        "num_annotations": num_boxes,
        "first_annotation_row": first_box,
        "prev_row": previous,
        "next_row": following,
    }


def _annotation_rows(
    files: ScenarioFiles,
    boxes: ScenarioBoxes,
    instance_of_box: AnyArray,
    world_velocities: FloatArray,
) -> ColumnArrays:
    labels = files.labels
    previous, following = box_rules.chains(boxes)
    return {
        "sample_row": boxes.sample,
        "instance_row": instance_of_box,
        "category": labels.category,
        "translation": labels.center,
        "size": labels.size,
        "rotation": box_rules.box_rotation(boxes),
        "velocity": box_rules.to_lidar(boxes, world_velocities),
        "yaw": labels.yaw,
        "actor_id": labels.actor_id,
        "num_lidar_pts": labels.num_lidar_pts,
        "camera_visible": labels.camera_visible,
        "velocity_label": labels.velocity,
        "is_collider": np.isin(boxes.actor, _collider_ids(files)),
        "time_to_impact": _times_to_impact(files)[boxes.frame - 1],
        "prev_row": previous,
        "next_row": following,
    }


def _track_rows(
    boxes: ScenarioBoxes, annotations: ColumnArrays, centers: FloatArray, velocities: FloatArray
) -> ColumnArrays:
    instance_of_box = annotations["instance_row"]
    rows, agents = box_rules.tracks(boxes, instance_of_box)
    return {
        "frame_row": boxes.frame[rows] - 1,
        "instance_row": instance_of_box[rows],
        "scenario_row": np.zeros(len(rows)),
        "translation": centers[rows],
        "rotation": box_rules.world_rotations(boxes)[rows],
        "size": annotations["size"][rows],
        "velocity": velocities[rows],
        "category": annotations["category"][rows],
        "is_collider": annotations["is_collider"][rows],
        "agents": agents,
    }


def _sample_labelled(files: ScenarioFiles) -> AnyArray:
    labelled = [agent in files.scan.labelled for agent in files.scan.agents]
    return np.repeat(labelled, files.scan.num_frames)


def _agent_codes(files: ScenarioFiles) -> IntArray:
    codes = [AGENTS.index(agent) for agent in files.scan.agents]
    return np.array(codes, dtype=np.int64)


def _actor_id(files: ScenarioFiles, agent: str) -> int:
    if agent == INFRASTRUCTURE or files.meta is None or files.meta.agent_ids is None:
        return UNTRACKED_ID
    return files.meta.agent_ids[[*VEHICLE_AGENTS].index(agent)]  # type: ignore[arg-type]


def _collider_ids(files: ScenarioFiles) -> Sequence[int]:
    if not files.meta or not files.meta.collision:
        return ()
    return files.meta.collision.ids


def _times_to_end(frames: int) -> FloatArray:
    return np.arange(frames - 1, -1, -1) / 10


def _times_to_impact(files: ScenarioFiles) -> FloatArray:
    """Return seconds to the last frame, shape (F,); NaN unless meta names a collision.

    The recording ends at the collision.
    """
    frames = files.scan.num_frames
    if _collider_ids(files):
        return _times_to_end(frames)
    return np.full(frames, np.nan)


def accident_type(meta: Meta | None, *, signalized: bool) -> int | None:
    """Return the paper's design that an accident realises (docs/format.md).

    Designs 1 to 6 have traffic lights, 7 to 12 have none. None is returned for no accident, one
    with a pedestrian or a third vehicle, or of no design.
    """
    if meta is None or meta.collision is None or "pedestrian" in meta.collision.classes:
        return None
    if meta.agent_ids is None or not set(meta.collision.ids) <= set(meta.agent_ids):
        return None
    design = _signalized_design(meta)
    if design is None or signalized:
        return design
    return design + 6


def _signalized_design(meta: Meta) -> int | None:
    if meta.ego_direction is None or meta.other_direction is None:
        return None
    directions = frozenset({meta.ego_direction, meta.other_direction})
    road = meta.road_type or ""
    side = meta.spawn_side or ""
    if road.startswith("three-way"):
        return 6 if "straight" in directions else 5
    if not road.startswith("four-way"):
        return None
    if side in ("left", "right"):
        return {frozenset({"straight"}): 1, frozenset({"straight", "left"}): 2}.get(directions)
    if side.startswith("opposite"):
        return {frozenset({"straight", "left"}): 3, frozenset({"left", "right"}): 4}.get(directions)
    return None


def sensor_tables(calibs: Calibs, *, agents: int, frames: int) -> dict[str, ColumnArrays]:
    """Return the rows of one scenario's sensor tables; `calibs` holds its samples by agent."""
    values = _sensor_values(calibs)
    calibrated_sensors, calibrated_sensor_of = _calibrated_sensor_rows(values, agents, frames)
    return {
        "sample_data": {
            **_sample_data_rows(calibs, calibrated_sensor_of, agents, frames),
            "matrix": values[..., :12].reshape(-1, 12),
        },
        "calibrated_sensor": calibrated_sensors,
        "ego_pose": _ego_pose_rows(calibs, agents, frames),
    }


def sensor_rows() -> ColumnArrays:
    """Return the rows of table `sensor`, the same for all scenarios."""
    return {"channel": np.arange(len(CHANNELS)), "modality": _channel_modalities()}


def neighbour_rows(frames: int, agents: int) -> tuple[IntArray, IntArray]:
    """Return the rows before and after each row of `agents` runs of `frames` rows.

    They are −1 at a run's ends.
    """
    row = np.arange(agents * frames)
    previous = np.where(row % frames == 0, NULL_INTEGER, row - 1)
    following = np.where(row % frames == frames - 1, NULL_INTEGER, row + 1)
    return previous, following


def timestamps(frames: int) -> FloatArray:
    """Return seconds since the first of `frames` frames, shape (F,)."""
    seconds = [frame_timestamp(frame) for frame in range(1, frames + 1)]
    return np.array(seconds)


def _sample_data_rows(
    calibs: Calibs, calibrated_sensor_of: IntArray, agents: int, frames: int
) -> ColumnArrays:
    """Return columns in the order sample, channel."""
    samples = len(calibs)
    channels = len(CHANNELS)
    previous, following = neighbour_rows(frames, agents)
    size = np.full((samples, channels, 2), NULL_INTEGER, dtype=np.int64)
    size[:, : len(CAMERAS)] = np.rint(2 * calibs.intrinsic[..., :2, 2])
    size[:, CHANNELS.index(BEV_CAMERA)] = BEV_SHAPE[::-1]
    formats = [FILE_FORMATS.index(CHANNEL_FORMAT[channel]) for channel in CHANNELS]
    return {
        "sample_row": np.repeat(np.arange(samples), channels),
        "sensor_row": np.tile(np.arange(channels), samples),
        "calibrated_sensor_row": calibrated_sensor_of.reshape(-1),
        "ego_pose_row": np.repeat(np.arange(samples), channels),
        "channel": np.tile(np.arange(channels), samples),
        "modality": np.tile(_channel_modalities(), samples),
        "fileformat": np.tile(formats, samples),
        "width": size[..., 0].reshape(-1),
        "height": size[..., 1].reshape(-1),
        "prev_row": _channel_rows(previous),
        "next_row": _channel_rows(following),
    }


def _channel_rows(samples: IntArray) -> IntArray:
    """Return the sensor file rows of sample rows (S,), shape (S · channels,); −1 for −1."""
    column = samples[:, None]
    rows = column * len(CHANNELS) + np.arange(len(CHANNELS))
    return np.where(column < 0, NULL_INTEGER, rows).reshape(-1)


def _calibrated_sensor_rows(
    values: FloatArray, agents: int, frames: int
) -> tuple[ColumnArrays, IntArray]:
    """Return the distinct setups of each agent's sensors, by first occurrence.

    Args:
        values: Setup of every file (`_sensor_values`), shape (samples, channels, 25).
        agents: Number of agents.
        frames: Number of frames.

    Returns:
        Rows of table `calibrated_sensor`, and the row of each file, shape (samples, channels).
    """
    row_of = np.zeros(values.shape[:2], dtype=np.int64)
    setups: list[FloatArray] = []
    keys: list[tuple[int, int, int]] = []
    for agent in range(agents):
        samples = slice(agent * frames, (agent + 1) * frames)
        for channel in range(len(CHANNELS)):
            distinct, number = _find_distinct(values[samples, channel])
            row_of[samples, channel] = len(keys) + number
            setups.append(distinct)
            keys += [(agent, channel, index + 1) for index in range(len(distinct))]
    table = np.concatenate(setups)
    key_table = np.array(keys)
    poses = table[:, :16].reshape(-1, 4, 4)
    columns = {
        "sensor_row": key_table[:, 1],
        "agent_row": key_table[:, 0],
        "number": key_table[:, 2],
        "translation": poses[:, :3, 3],
        "rotation": quaternions.from_matrix(poses[:, :3, :3]),
        "camera_intrinsic": table[:, 16:],
        "matrix": table[:, :16],
    }
    return columns, row_of


def _sensor_values(calibs: Calibs) -> FloatArray:
    """Return `ego_from_sensor` and K of every file, shape (samples, channels, 25); NaN if none."""
    samples = len(calibs)
    channels = len(CHANNELS)
    lidar_from_camera = np.linalg.inv(calibs.camera_from_lidar)
    matrix = np.tile(np.eye(4), (samples, channels, 1, 1))
    matrix[:, : len(CAMERAS)] = calibs.ego_from_lidar[:, None] @ lidar_from_camera
    matrix[:, CHANNELS.index(LIDAR)] = calibs.ego_from_lidar
    intrinsic = np.full((samples, channels, 3, 3), np.nan)
    intrinsic[:, : len(CAMERAS)] = calibs.intrinsic
    parts = [matrix.reshape(samples, channels, 16), intrinsic.reshape(samples, channels, 9)]
    return np.concatenate(parts, axis=-1)


def _ego_pose_rows(calibs: Calibs, agents: int, frames: int) -> ColumnArrays:
    pose = calibs.world_from_ego
    return {
        "translation": pose[:, :3, 3],
        "rotation": quaternions.from_matrix(pose[:, :3, :3]),
        "timestamp": np.tile(timestamps(frames), agents),
        "matrix": pose.reshape(-1, 16),
    }


def _find_distinct(rows: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the rows (F, 25) that differ by more than rounding, and the number of each row.

    Distinct rows are in order of occurrence.
    """
    tolerance = np.full(25, _INTRINSIC_TOLERANCE)
    tolerance[:16] = ROTATION_TOLERANCE
    tolerance[[3, 7, 11]] = TRANSLATION_TOLERANCE
    number = np.full(len(rows), NULL_INTEGER)
    distinct: list[int] = []
    unassigned = np.arange(len(rows))
    while unassigned.size:
        change = np.abs(rows[unassigned] - rows[unassigned[0]])
        # NaN, where a file has no K, counts as equal.
        alike = (~(change > tolerance)).all(axis=1)
        number[unassigned[alike]] = len(distinct)
        distinct.append(int(unassigned[0]))
        unassigned = np.flatnonzero(number < 0)
    return rows[distinct], number


def _channel_modalities() -> AnyArray:
    codes = [MODALITIES.index(CHANNEL_MODALITY[channel]) for channel in CHANNELS]
    return np.array(codes)
