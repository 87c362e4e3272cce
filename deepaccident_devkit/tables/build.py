"""Rows of every table from one scenario's files; row keys are relative to the scenario."""

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
"""Distance by which a sensor's position on its agent may jitter, metres.

The release computes positions in single precision; a few hundred metres from the world's origin,
the measured jitter is 2e-4.
"""
ROTATION_TOLERANCE: Final = 1e-5
"""Difference by which the entries of a sensor's rotation may jitter; 4e-7 was measured."""
_INTRINSIC_TOLERANCE = 1e-6
# Positions of the translation's entries in a flat 4 × 4 matrix.
_TRANSLATION_ENTRIES = [3, 7, 11]


def scenario_rows(files: ScenarioFiles) -> dict[str, ColumnArrays]:
    """Return table → its rows, for all tables except `sensor` and `category`, which are shared."""
    boxes = scenario_boxes(files)
    instance_rows, instance_of_box = box_rules.instances(boxes)
    centers = box_rules.world_centers(boxes)
    displacement = displacement_velocities(centers, boxes.agent, boxes.labels.actor_id, boxes.frame)
    velocity_frame = fit_velocities(boxes, displacement).best
    velocities = decoded_velocities(boxes, displacement, velocity_frame)
    annotations = _make_annotation_rows(files, boxes, instance_of_box, velocities)
    return {
        "scenario": _make_scenario_row(files, velocity_frame),
        "agent": _make_agent_rows(files, boxes),
        "frame": _make_frame_rows(files),
        "sample": _make_sample_rows(files),
        **sensor_tables(files.calibs, agents=len(files.scan.agents), frames=files.scan.num_frames),
        "instance": instance_rows,
        "annotation": annotations,
        "track": _make_track_rows(boxes, annotations, centers, velocities),
    }


def scenario_boxes(files: ScenarioFiles) -> ScenarioBoxes:
    """Return a scenario's boxes, with the sample in which each was recorded."""
    sample = np.repeat(np.flatnonzero(_mark_labelled_samples(files)), files.labels.num_boxes)
    agent, frame = np.divmod(sample, files.scan.num_frames)
    agent_ids = [_find_actor_id(files, name) for name in files.scan.agents]
    actor_of_agent = np.array(agent_ids, dtype=np.int64)
    label_id = files.labels.actor_id
    return ScenarioBoxes(
        labels=files.labels,
        sample=sample,
        agent=agent,
        frame=frame + 1,
        agent_order=_encode_agents(files)[agent],
        actor=np.where(label_id == OWN_ACTOR_ID, actor_of_agent[agent], label_id),
        world_from_lidar=files.calibs.world_from_ego @ files.calibs.ego_from_lidar,
    )


def _make_scenario_row(files: ScenarioFiles, velocity_frame: str | None) -> ColumnArrays:
    scenario = files.scenario
    meta = files.meta
    signalized = "_subtype1_" in f"{scenario.scenario_type}_"
    collision = asdict(meta.collision) if meta and meta.collision else None
    design = accident_type(meta, signalized=signalized)
    meta_fields = ("weather", "road_type", "spawn_side", "ego_direction", "other_direction")
    time_code = NULL_INTEGER
    if meta and meta.time_of_day:
        time_code = TIMES_OF_DAY.index(meta.time_of_day)
    velocity_code = NULL_INTEGER
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
        "time_of_day": [time_code],
        "collision": [collision],
        "accident_type": [NULL_INTEGER if design is None else design],
        "velocity_frame": [velocity_code],
        "num_frames": [files.scan.num_frames],
        "first_frame_row": [0],
        "last_frame_row": [files.scan.num_frames - 1],
        # Filled in when tables are joined: split files may change without the scenario.
        "split": [NULL_INTEGER],
    }


def _make_agent_rows(files: ScenarioFiles, boxes: ScenarioBoxes) -> ColumnArrays:
    count = len(files.scan.agents)
    category = np.full(count, NULL_INTEGER)
    size = np.full((count, 3), np.nan)
    # In reverse order, so that the first of an agent's several own rows overwrites the others.
    own_rows = np.flatnonzero(files.labels.actor_id == OWN_ACTOR_ID)[::-1]
    category[boxes.agent[own_rows]] = files.labels.category[own_rows]
    size[boxes.agent[own_rows]] = files.labels.size[own_rows]
    return {
        "scenario_row": np.zeros(count),
        "name": _encode_agents(files),
        "actor_id": [_find_actor_id(files, agent) for agent in files.scan.agents],
        "category": category,
        "size": size,
        "is_infrastructure": [agent == INFRASTRUCTURE for agent in files.scan.agents],
        "first_sample_row": np.arange(count) * files.scan.num_frames,
    }


def _make_frame_rows(files: ScenarioFiles) -> ColumnArrays:
    count = files.scan.num_frames
    previous, following = neighbour_rows(count, 1)
    return {
        "scenario_row": np.zeros(count),
        "index": np.arange(1, count + 1),
        "timestamp": timestamps(count),
        "time_to_impact": _compute_times_to_impact(files),
        "prev_row": previous,
        "next_row": following,
    }


def _make_sample_rows(files: ScenarioFiles) -> ColumnArrays:
    agents = len(files.scan.agents)
    frames = files.scan.num_frames
    labelled = _mark_labelled_samples(files)
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
        "agent": np.repeat(_encode_agents(files), frames),
        "timestamp": np.tile(timestamps(frames), agents),
        "velocity": velocity,
        "time_to_end": np.tile(_compute_times_to_end(frames), agents),
        "time_to_impact": np.tile(_compute_times_to_impact(files), agents),
        "labelled": labelled,
        "num_annotations": num_boxes,
        "first_annotation_row": first_box,
        "prev_row": previous,
        "next_row": following,
    }


def _make_annotation_rows(
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
        "is_collider": np.isin(boxes.actor, _list_collider_ids(files)),
        "time_to_impact": _compute_times_to_impact(files)[boxes.frame - 1],
        "prev_row": previous,
        "next_row": following,
    }


def _make_track_rows(
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


def _mark_labelled_samples(files: ScenarioFiles) -> AnyArray:
    labelled = [agent in files.scan.labelled for agent in files.scan.agents]
    return np.repeat(labelled, files.scan.num_frames)


def _encode_agents(files: ScenarioFiles) -> IntArray:
    codes = [AGENTS.index(agent) for agent in files.scan.agents]
    return np.array(codes, dtype=np.int64)


def _find_actor_id(files: ScenarioFiles, agent: str) -> int:
    """Return an agent's actor id from meta; −1 if unknown."""
    if agent == INFRASTRUCTURE or files.meta is None or files.meta.agent_ids is None:
        return UNTRACKED_ID
    position = [*VEHICLE_AGENTS].index(agent)  # type: ignore[arg-type]
    return files.meta.agent_ids[position]


def _list_collider_ids(files: ScenarioFiles) -> Sequence[int]:
    if not files.meta or not files.meta.collision:
        return ()
    return files.meta.collision.ids


def _compute_times_to_end(frames: int) -> FloatArray:
    """Return the seconds from each of `frames` frames to the last one, shape (F,)."""
    frames_to_end = np.arange(frames - 1, -1, -1)
    return frames_to_end / 10


def _compute_times_to_impact(files: ScenarioFiles) -> FloatArray:
    """Return the seconds from each frame to the last, (F,); NaN unless meta names a collision."""
    frames = files.scan.num_frames
    if _list_collider_ids(files):
        return _compute_times_to_end(frames)
    return np.full(frames, np.nan)


def accident_type(meta: Meta | None, *, signalized: bool) -> int | None:
    """Return which of the paper's 12 accident designs an accident follows (docs/format.md).

    Designs 1 to 6 have traffic lights, 7 to 12 have none. The result is None if there is no
    accident, if a pedestrian or a third vehicle is involved, or if no design fits.
    """
    if meta is None or meta.collision is None or "pedestrian" in meta.collision.classes:
        return None
    if meta.agent_ids is None or not set(meta.collision.ids) <= set(meta.agent_ids):
        return None
    design = _find_signalized_design(meta)
    if design is None or signalized:
        return design
    return design + 6


def _find_signalized_design(meta: Meta) -> int | None:
    """Return the design, 1 to 6, that fits an accident's road and directions; None if none does."""
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
        designs = {frozenset({"straight"}): 1, frozenset({"straight", "left"}): 2}
    elif side.startswith("opposite"):
        designs = {frozenset({"straight", "left"}): 3, frozenset({"left", "right"}): 4}
    else:
        return None
    return designs.get(directions)


def sensor_tables(calibs: Calibs, *, agents: int, frames: int) -> dict[str, ColumnArrays]:
    """Return table → its rows, for the sensor tables of one scenario.

    Args:
        calibs: Calibration of all samples, agent by agent.
        agents: Number of agents.
        frames: Number of frames.
    """
    values = _collect_sensor_values(calibs)
    calibrated_sensors, calibrated_sensor_of = _make_calibrated_sensor_rows(values, agents, frames)
    return {
        "sample_data": {
            **_make_sample_data_rows(calibs, calibrated_sensor_of, agents, frames),
            "matrix": values[..., :12].reshape(-1, 12),
        },
        "calibrated_sensor": calibrated_sensors,
        "ego_pose": _make_ego_pose_rows(calibs, agents, frames),
    }


def sensor_rows() -> ColumnArrays:
    """Return the rows of the table `sensor`, which are the same for all scenarios."""
    return {"channel": np.arange(len(CHANNELS)), "modality": _encode_modalities()}


def neighbour_rows(frames: int, agents: int) -> tuple[IntArray, IntArray]:
    """Return the rows of the previous and the next frame for each row of each agent.

    They are −1 where an agent has no previous or no next frame.
    """
    rows = np.arange(agents * frames)
    previous = np.where(rows % frames == 0, NULL_INTEGER, rows - 1)
    following = np.where(rows % frames == frames - 1, NULL_INTEGER, rows + 1)
    return previous, following


def timestamps(frames: int) -> FloatArray:
    """Return the seconds from the first of `frames` frames to each, shape (F,)."""
    seconds = [frame_timestamp(frame) for frame in range(1, frames + 1)]
    return np.array(seconds)


def _make_sample_data_rows(
    calibs: Calibs, calibrated_sensor_of: IntArray, agents: int, frames: int
) -> ColumnArrays:
    """Return the rows of the table `sample_data`, ordered by sample and then by channel."""
    samples = len(calibs)
    channels = len(CHANNELS)
    previous, following = neighbour_rows(frames, agents)
    # Width and height of each file.
    size = np.full((samples, channels, 2), NULL_INTEGER, dtype=np.int64)
    principal_points = calibs.intrinsic[..., :2, 2]
    size[:, : len(CAMERAS)] = np.rint(2 * principal_points)
    size[:, CHANNELS.index(BEV_CAMERA)] = BEV_SHAPE[::-1]
    formats = [FILE_FORMATS.index(CHANNEL_FORMAT[channel]) for channel in CHANNELS]
    return {
        "sample_row": np.repeat(np.arange(samples), channels),
        "sensor_row": np.tile(np.arange(channels), samples),
        "calibrated_sensor_row": calibrated_sensor_of.reshape(-1),
        "ego_pose_row": np.repeat(np.arange(samples), channels),
        "channel": np.tile(np.arange(channels), samples),
        "modality": np.tile(_encode_modalities(), samples),
        "fileformat": np.tile(formats, samples),
        "width": size[..., 0].reshape(-1),
        "height": size[..., 1].reshape(-1),
        "prev_row": _expand_to_channels(previous),
        "next_row": _expand_to_channels(following),
    }


def _expand_to_channels(samples: IntArray) -> IntArray:
    """Return the sensor-file rows (S · channels,) of sample rows (S,); −1 stays −1."""
    sample_column = samples[:, None]
    rows = sample_column * len(CHANNELS) + np.arange(len(CHANNELS))
    return np.where(sample_column < 0, NULL_INTEGER, rows).reshape(-1)


def _make_calibrated_sensor_rows(
    values: FloatArray, agents: int, frames: int
) -> tuple[ColumnArrays, IntArray]:
    """Return the distinct setups of each agent's sensors, in order of first occurrence.

    Args:
        values: Setup of every file (`_collect_sensor_values`), shape (samples, channels, 25).
        agents: Number of agents.
        frames: Number of frames.

    Returns:
        Rows of table `calibrated_sensor`, and the row of each file, shape (samples, channels).
    """
    row_of_file = np.zeros(values.shape[:2], dtype=np.int64)
    distinct_setups = []
    keys: list[tuple[int, int, int]] = []
    for agent in range(agents):
        samples = slice(agent * frames, (agent + 1) * frames)
        for channel in range(len(CHANNELS)):
            setups, setup_of_file = _find_distinct(values[samples, channel])
            row_of_file[samples, channel] = len(keys) + setup_of_file
            distinct_setups.append(setups)
            keys += [(agent, channel, index + 1) for index in range(len(setups))]
    all_setups = np.concatenate(distinct_setups)
    agent_rows, channels, numbers = np.array(keys).T
    matrices = all_setups[:, :16]
    poses = matrices.reshape(-1, 4, 4)
    columns = {
        "sensor_row": channels,
        "agent_row": agent_rows,
        "number": numbers,
        "translation": poses[:, :3, 3],
        "rotation": quaternions.from_matrix(poses[:, :3, :3]),
        "camera_intrinsic": all_setups[:, 16:],
        "matrix": matrices,
    }
    return columns, row_of_file


def _collect_sensor_values(calibs: Calibs) -> FloatArray:
    """Return the setup of every sensor file, shape (samples, channels, 25).

    A setup is `ego_from_sensor` (16 numbers) and K (9 numbers, NaN if the sensor is not a camera).
    """
    samples = len(calibs)
    channels = len(CHANNELS)
    lidar_from_camera = np.linalg.inv(calibs.camera_from_lidar)
    matrix = np.tile(np.eye(4), (samples, channels, 1, 1))
    matrix[:, : len(CAMERAS)] = calibs.ego_from_lidar[:, None] @ lidar_from_camera
    matrix[:, CHANNELS.index(LIDAR)] = calibs.ego_from_lidar
    intrinsic = np.full((samples, channels, 3, 3), np.nan)
    intrinsic[:, : len(CAMERAS)] = calibs.intrinsic
    flat_matrix = matrix.reshape(samples, channels, 16)
    flat_intrinsic = intrinsic.reshape(samples, channels, 9)
    return np.concatenate([flat_matrix, flat_intrinsic], axis=-1)


def _make_ego_pose_rows(calibs: Calibs, agents: int, frames: int) -> ColumnArrays:
    pose = calibs.world_from_ego
    return {
        "translation": pose[:, :3, 3],
        "rotation": quaternions.from_matrix(pose[:, :3, :3]),
        "timestamp": np.tile(timestamps(frames), agents),
        "matrix": pose.reshape(-1, 16),
    }


def _find_distinct(rows: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct setups among rows (F, 25), and the index of each row's setup.

    Setups that differ only by rounding count as equal. Distinct setups are in order of occurrence.
    """
    tolerance = np.full(25, _INTRINSIC_TOLERANCE)
    tolerance[:16] = ROTATION_TOLERANCE
    tolerance[_TRANSLATION_ENTRIES] = TRANSLATION_TOLERANCE
    setup_of_row = np.full(len(rows), NULL_INTEGER)
    distinct_rows: list[int] = []
    unassigned = np.arange(len(rows))
    while unassigned.size:
        first_row = int(unassigned[0])
        change = np.abs(rows[unassigned] - rows[first_row])
        # NaN (no K) counts as equal to NaN.
        is_alike = (~(change > tolerance)).all(axis=1)
        setup_of_row[unassigned[is_alike]] = len(distinct_rows)
        distinct_rows.append(first_row)
        unassigned = np.flatnonzero(setup_of_row < 0)
    return rows[distinct_rows], setup_of_row


def _encode_modalities() -> AnyArray:
    codes = [MODALITIES.index(CHANNEL_MODALITY[channel]) for channel in CHANNELS]
    return np.array(codes)
