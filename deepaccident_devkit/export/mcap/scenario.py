"""The messages of a scenario, moment by moment: log texts, poses, sensor files and actors."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.wrappers_pb2 import DoubleValue
from tqdm import tqdm

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.export.mcap import EXPORTED_CHANNELS, McapConfig, Predictions
from deepaccident_devkit.export.mcap.layouts import write_layouts
from deepaccident_devkit.export.mcap.messages import (
    McapRecording,
    Moment,
    Roles,
    color_points,
    compute_box_segments,
    compute_text_position,
    join_points,
    make_cloud,
    make_cube,
    make_entity,
    make_label,
    make_lines,
    make_moment,
    make_scene_update,
    make_strip,
    make_timestamp,
    make_transform,
    name_frame,
    sample_segments,
    sample_strip,
    select_agents,
)
from deepaccident_devkit.export.mcap.predicted import MotionMapMessages, PredictedScenes
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion.config import resolved_label_config
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.release.images import read_jpeg
from deepaccident_devkit.release.layout import MissingFiles
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.render.boxes import role_colors
from deepaccident_devkit.render.styles import AGENT_COLORS, MAP_COLORS
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.tokens import frame_token
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CATEGORIES,
    INFRASTRUCTURE,
    LIDAR,
    POLE_HEIGHT,
    UNTRACKED_ID,
)
from deepaccident_devkit.v2x import cooperative_view
from deepaccident_devkit.v2x.cooperation import visible_actors
from deepaccident_devkit.v2x.tracks import scenario_tracks

METADATA: Final = "deepaccident_devkit"
# Number of frames, of 0.1 s each, between two lines of the countdown.
_LOG_INTERVAL_FRAMES = 5
# Fields of a scenario in the log and the metadata.
_SCENARIO_FIELDS = ("town", "weather", "time_of_day", "road_type", "split", "accident_type")
LIDAR_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
# Number of steps in a metre of rounded LiDAR coordinates, and from 0 to 1 of rounded intensities.
_ROUNDING_STEPS = 32
# Number of BEV camera cells between points of the road.
_ROAD_STEP_CELLS = 5
TRAIL_FRAMES: Final = 20
"""How many frames an actor's trail goes back and its path goes ahead (2 s)."""
_PATH_ALPHA = 0.5


def write_poses(dataset: Dataset, moment: Moment, recording: McapRecording) -> None:
    """Write the transforms world → agent → sensors, and each agent's pose in another message."""
    frame_number = moment.frame_number
    transforms = []
    poses = {}
    for agent, sample in moment.samples.items():
        ego_frame = name_frame(agent, "ego")
        world_from_ego = dataset.world_from(sample, "ego")
        poses[agent] = make_transform("world", ego_frame, world_from_ego, frame_number)
        transforms.append(poses[agent])
        for channel in EXPORTED_CHANNELS:
            sensor_frame = name_frame(agent, channel)
            ego_from_sensor = dataset.ego_from(sample, channel)
            transforms.append(
                make_transform(ego_frame, sensor_frame, ego_from_sensor, frame_number)
            )
    recording.write("/tf", FrameTransforms(transforms=transforms), frame_number)
    for agent, transform in poses.items():
        message = PoseInFrame(timestamp=make_timestamp(frame_number), frame_id="world")
        message.pose.position.CopyFrom(transform.translation)
        message.pose.orientation.CopyFrom(transform.rotation)
        recording.write(f"/{agent}/pose", message, frame_number)


def write_road(dataset: Dataset, moment: Moment, recording: McapRecording) -> None:
    """Write the ground in the agents' BEV cameras at this moment as points in the world frame.

    The points are 0.5 m apart.
    """
    parts = []
    for agent, sample in moment.samples.items():
        if not dataset.sensor_path(f"{sample}/{BEV_CAMERA}").exists():
            continue
        image = dataset.load_bev(sample)
        height = -POLE_HEIGHT if agent == INFRASTRUCTURE else 0.0
        tags = image.semantic[::_ROAD_STEP_CELLS, ::_ROAD_STEP_CELLS]
        middle = (len(image.semantic) - 1) / 2
        for name, color in MAP_COLORS.items():
            cells = np.argwhere(tags == TAGS.get(name, -1)).T
            ahead, left = (middle - _ROAD_STEP_CELLS * cells) * image.resolution
            ground = np.column_stack([ahead, left, np.full(len(ahead), height)])
            in_world = dataset.world_from(sample, "ego").apply(ground)
            parts.append(color_points(in_world, color))
    if parts:
        cloud = make_cloud(join_points(parts), "world", moment.frame_number)
        recording.write("/road/points", cloud, moment.frame_number)


def write_scenario(
    dataset: Dataset,
    scenario: RowArgument,
    path: Path,
    config: McapConfig,
    *,
    prediction: Predictions | None,
    progress: bool,
) -> Path:
    """Write a scenario into an MCAP file, with the arguments and errors of `export_mcap`."""
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    token = record["token"]
    agents = select_agents(dataset, token, config.agents)
    moments = [
        make_moment(token, number, agents) for number in config.frame_numbers(record["num_frames"])
    ]
    sensors = _SensorMessages(dataset, config)
    writers: list[Callable[[Moment, McapRecording], None]]
    writers = [
        _StoryMessages(dataset, token).write,
        partial(write_poses, dataset),
        sensors.write,
        _ActorMessages(dataset, token).write,
    ]
    if config.motion_labels is not None:
        writers.append(
            MotionMapMessages(dataset, token, resolved_label_config(config.motion_labels)).write
        )
    if prediction is not None:
        scenes = PredictedScenes(dataset, prediction, config.task)
        _check_samples(scenes, moments, token)
        writers.append(scenes.write)
    with (
        replacing(path) as temporary,
        temporary.open("wb") as stream,
        McapRecording(stream) as recording,
    ):
        recording.add_metadata(METADATA, collect_metadata(dataset, token))
        write_road(dataset, moments[0], recording)
        for moment in tqdm(
            moments, desc=f"Writing {path.name}", disable=not progress, unit="frame"
        ):
            for write in writers:
                write(moment, recording)
    sensors.log_missing()
    write_layouts(path, recording.topics)
    return path


def _check_samples(scenes: PredictedScenes, moments: list[Moment], scenario: str) -> None:
    """Check that a sample of the moments has a prediction; raise NotAvailableError if none has."""
    samples: list[str] = []
    for moment in moments:
        samples += moment.samples.values()
    if not any(map(scenes.has, samples)):
        raise NotAvailableError(
            f"prediction: has no prediction for {scenario} at these agents and frames, such as "
            f"{moments[0].first_sample!r}"
        )


def collect_metadata(dataset: Dataset, scenario: str) -> dict[str, str]:
    """Return the metadata of the file.

    They are the version of the devkit, the scenario and its facts, and a hash of its label, meta
    and calib files.
    """
    record = dataset.get("scenario", scenario)
    hashes = scenario_hashes(dataset, [scenario], workers=1)
    metadata = {
        "devkit_version": __version__,
        "release_version": dataset.version,
        "scenario": scenario,
        "fingerprint": fingerprint(hashes),
        "collision": json.dumps(record["collision"], sort_keys=True),
    }
    for name in _SCENARIO_FIELDS:
        if record[name] is not None:
            metadata[name] = str(record[name])
    return metadata


class _StoryMessages:
    """Log texts about the events of a scenario and, if there is an impact, a countdown to it."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Read the record of a scenario."""
        self._dataset = dataset
        self._record: Any = dataset.get("scenario", scenario)
        self._has_begun = False

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the countdown at a moment, after the scenario's facts at the first moment."""
        if not self._has_begun:
            self._has_begun = True
            _write_log(self._describe_scenario(), moment.frame_number, recording)
        frame = self._dataset.get("frame", frame_token(moment.scenario, moment.frame_number))
        seconds = frame["time_to_impact"]
        if seconds is None:
            return
        recording.write("/time_to_impact", DoubleValue(value=seconds), moment.frame_number)
        if seconds == 0:
            _write_log(
                f"impact: {self._describe_pair()}", moment.frame_number, recording, Log.ERROR
            )
        elif round(seconds * 10) % _LOG_INTERVAL_FRAMES == 0:
            _write_log(f"{seconds:.1f} s to the impact", moment.frame_number, recording)

    def _describe_scenario(self) -> str:
        facts = []
        for name in _SCENARIO_FIELDS:
            if self._record[name] is not None:
                facts.append(f"{name} {self._record[name]}")
        ending = "no collision is known"
        if self._record["collision"]:
            ending = f"ends in an accident: {self._describe_pair()}"
        return f"{self._record['token']}: {', '.join(facts)}; {ending}"

    def _describe_pair(self) -> str:
        collision = self._record["collision"]
        pair = zip(collision["classes"], collision["ids"], strict=True)
        return " and ".join(f"{category} {actor}" for category, actor in pair)


def _write_log(
    text: str, frame_number: int, recording: McapRecording, level: int = Log.INFO
) -> None:
    message = Log(timestamp=make_timestamp(frame_number), level=level, message=text, name=METADATA)
    recording.write("/log", message, frame_number)


class _SensorMessages:
    """Messages with the sensor files of moments; missing files are counted."""

    def __init__(self, dataset: Dataset, config: McapConfig) -> None:
        """Store the selection of sensors and points; nothing is read yet."""
        self._dataset = dataset
        self._channels = tuple(config.channels or ())
        self._step = config.points
        self._files = MissingFiles(dataset.dataroot, "skip")

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write a moment's files by agent; raise SensorFileError if one cannot be read."""
        for agent, sample in moment.samples.items():
            for channel in self._channels:
                path = self._dataset.sensor_path(f"{sample}/{channel}")
                if not self._files.has(path, channel):
                    continue
                if channel == LIDAR:
                    self._write_cloud(agent, sample, moment.frame_number, recording)
                else:
                    self._write_image(
                        agent, f"{sample}/{channel}", path, moment.frame_number, recording
                    )

    def log_missing(self) -> None:
        """Log how many files were left out, if any."""
        self._files.tell()

    def _write_image(
        self, agent: str, token: str, path: ReleasePath, frame_number: int, recording: McapRecording
    ) -> None:
        content, size = read_jpeg(path)
        channel = token.rsplit("/", 1)[1]
        frame = name_frame(agent, channel)
        calibration = _make_calibration(self._dataset, token, size, frame, frame_number)
        image = CompressedImage(
            timestamp=make_timestamp(frame_number), frame_id=frame, data=content, format="jpeg"
        )
        recording.write(f"/{frame}/calibration", calibration, frame_number)
        recording.write(f"/{frame}/image", image, frame_number)

    def _write_cloud(
        self, agent: str, sample: str, frame_number: int, recording: McapRecording
    ) -> None:
        cloud = self._dataset.load_point_cloud(sample, "lidar")
        xyz = cloud.xyz[:: self._step]
        intensity = cloud.intensity[:: self._step]
        points = np.zeros(len(xyz), dtype=LIDAR_POINT)
        # Clouds are most of a file, and values with few digits compress well.
        rounded = (xyz * _ROUNDING_STEPS).round().T / _ROUNDING_STEPS
        points["x"], points["y"], points["z"] = rounded
        points["intensity"] = (intensity * _ROUNDING_STEPS).round() / _ROUNDING_STEPS
        frame = name_frame(agent, "lidar")
        recording.write(f"/{frame}/points", make_cloud(points, frame, frame_number), frame_number)


def _make_calibration(
    dataset: Dataset, token: str, size: tuple[int, int], frame: str, frame_number: int
) -> Any:
    """Return the CameraCalibration of an image with a size of (width, height) pixels.

    The image may be smaller than the calib file states.
    """
    lens = dataset.camera(token).resized(*size)
    return CameraCalibration(
        timestamp=make_timestamp(frame_number),
        frame_id=frame,
        width=lens.width,
        height=lens.height,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=lens.intrinsic.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([lens.intrinsic, np.zeros(3)]).ravel().tolist(),
    )


class _ActorMessages:
    """Renderings of the boxes of moments."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Read the tracks of all actors of a scenario."""
        self._dataset = dataset
        self._roles = Roles(dataset, scenario)
        tracks = scenario_tracks(dataset, scenario)
        self._paths: dict[int, tuple[IntArray, FloatArray]] = {}
        for actor in np.unique(tracks.actor_id).tolist():
            rows = np.flatnonzero(tracks.actor_id == actor)
            self._paths[actor] = (tracks.index[rows], tracks.boxes.center[rows])

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write all actors of a moment in the world frame, and annotations in LiDAR frames."""
        self._write_actors(moment, recording)
        for agent, sample in moment.samples.items():
            if self._dataset.get("sample", sample)["labelled"]:
                self._write_annotations(agent, sample, moment.frame_number, recording)

    def _write_actors(self, moment: Moment, recording: McapRecording) -> None:
        view = cooperative_view(self._dataset, moment.first_sample, agents=tuple(moment.samples))
        boxes = view.boxes
        segments = compute_box_segments(boxes)
        colors = role_colors(self._dataset, moment.first_sample, boxes)
        visible = {}
        for agent, sample in moment.samples.items():
            visible[agent] = set(visible_actors(self._dataset, sample, agents=(agent,)).tolist())
        entities = []
        points = []
        for row, actor in enumerate(boxes.actor_id.tolist()):
            color = colors[row]
            trail, path = self._find_trail(actor, moment.frame_number)
            annotators = [name for bit, name in enumerate(AGENTS) if view.seen_by[row] >> bit & 1]
            observers = [agent for agent, actors in visible.items() if actor in actors]
            facts = {
                **self._describe_actor(boxes, row, actor),
                "annotated_by": ", ".join(annotators),
                "seen_by": ", ".join(observers),
            }
            name = str(actor)
            if actor == UNTRACKED_ID:
                name = f"untracked/{AGENTS[view.source[row]]}/{boxes.row[row]}"
            strips = [make_strip(line, color) for line in (trail, path) if len(line) > 1]
            entities.append(
                make_entity(
                    name,
                    "world",
                    moment.frame_number,
                    facts,
                    cubes=[make_cube(boxes, row, color)],
                    lines=[make_lines(segments[row, -1:], color), *strips],
                    texts=[make_label(facts["text"], compute_text_position(boxes, row), color)],
                )
            )
            points += [
                sample_segments(segments[row], color),
                sample_strip(trail, color),
                sample_strip(path, color, _PATH_ALPHA),
            ]
        self._write_speeds(boxes, moment, recording)
        recording.write(
            "/actors", make_scene_update(entities, moment.frame_number), moment.frame_number
        )
        cloud = make_cloud(join_points(points), "world", moment.frame_number)
        recording.write("/actors/points", cloud, moment.frame_number)

    def _write_speeds(self, boxes: Boxes, moment: Moment, recording: McapRecording) -> None:
        """Write the known speeds of the exported agents."""
        has_speed = np.isfinite(boxes.velocity[:, 0])
        for row in np.flatnonzero(has_speed).tolist():
            agent = self._roles.agents.get(int(boxes.actor_id[row]))
            if agent in moment.samples:
                speed = np.linalg.norm(boxes.velocity[row])
                message = DoubleValue(value=float(speed))
                recording.write(f"/{agent}/speed", message, moment.frame_number)

    def _write_annotations(
        self, agent: str, sample: str, frame_number: int, recording: McapRecording
    ) -> None:
        boxes = self._dataset.boxes(sample, "lidar")
        actors = self._dataset.actor_ids(sample).tolist()
        segments = compute_box_segments(boxes)
        color = AGENT_COLORS[agent]
        frame = name_frame(agent, "lidar")
        entities = []
        for row, actor in enumerate(actors):
            facts = {
                **self._describe_actor(boxes, row, actor),
                "label_id": str(boxes.actor_id[row]),
            }
            name = f"{actor}/{boxes.row[row]}"
            entities.append(
                make_entity(
                    name, frame, frame_number, facts, lines=[make_lines(segments[row], color)]
                )
            )
        recording.write(
            f"/{agent}/annotations", make_scene_update(entities, frame_number), frame_number
        )

    def _describe_actor(self, boxes: Boxes, row: int, actor: int) -> dict[str, str]:
        category = CATEGORIES[boxes.category[row]]
        velocity = boxes.velocity[row]
        role = self._roles.describe(actor)
        identity = "untracked" if actor == UNTRACKED_ID else str(actor)
        suffix = ""
        if role:
            suffix = f" ({role})"
        return {
            "text": f"{category} {identity}{suffix}",
            "actor_id": identity,
            "category": category,
            "role": role,
            "speed": f"{np.linalg.norm(velocity):.2f}",
            "velocity": " ".join(f"{value:.3f}" for value in velocity.tolist()),
            "size": " ".join(f"{value:.3f}" for value in boxes.size[row].tolist()),
            "num_lidar_pts": str(boxes.num_lidar_pts[row]),
            "camera_visible": str(bool(boxes.camera_visible[row])).lower(),
        }

    def _find_trail(self, actor: int, frame_number: int) -> tuple[FloatArray, FloatArray]:
        """Return an actor's past and future positions, shape (n, 3) each, in the world frame.

        Both include the position in the current frame.
        """
        no_path = (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
        frames, centers = self._paths.get(actor, no_path)
        first = frame_number - TRAIL_FRAMES
        last = frame_number + TRAIL_FRAMES
        is_past = (first <= frames) & (frames <= frame_number)
        is_future = (frame_number <= frames) & (frames <= last)
        return centers[is_past], centers[is_future]
