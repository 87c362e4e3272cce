"""A scenario's messages, moment by moment: log texts, poses, sensor files and actors."""

from __future__ import annotations

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
    box_segments,
    cloud_message,
    colored_points,
    cube,
    entity,
    exported_agents,
    frame_id,
    join_points,
    label,
    lines,
    moment_of,
    protobuf_timestamp,
    scene_update,
    segment_points,
    strip,
    strip_points,
    text_position,
    transform_message,
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
# Number of frames (0.1 s) between two lines of the countdown.
_LOG_INTERVAL_FRAMES: Final = 5
# Fields of a scenario in the log and the metadata.
_SCENARIO_FIELDS: Final = ("town", "weather", "time_of_day", "road_type", "split", "accident_type")
LIDAR_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
# Number of steps a metre for rounded LiDAR coordinates, and of rounded intensities from 0 to 1.
_LIDAR_STEPS, _INTENSITY_STEPS = 32, 32
# Number of BEV camera cells between points of the road.
_ROAD_STEP_CELLS: Final = 5
TRAIL_FRAMES: Final = 20
"""Number of frames (2 s) that an actor's trail goes back, and its path goes ahead."""
_PATH_ALPHA: Final = 0.5


def write_poses(dataset: Dataset, moment: Moment, recording: McapRecording) -> None:
    """Write world → agent → sensors in one message, and the pose of each agent in its own."""
    transforms = []
    poses = {}
    for agent, sample in moment.samples.items():
        ego_frame = frame_id(agent, "ego")
        poses[agent] = transform_message(
            "world", ego_frame, dataset.world_from(sample, "ego"), moment.index
        )
        transforms.append(poses[agent])
        for channel in EXPORTED_CHANNELS:
            sensor_frame = frame_id(agent, channel)
            transforms.append(
                transform_message(
                    ego_frame, sensor_frame, dataset.ego_from(sample, channel), moment.index
                )
            )
    recording.write("/tf", FrameTransforms(transforms=transforms), moment.index)
    for agent, transform in poses.items():
        message = PoseInFrame(timestamp=protobuf_timestamp(moment.index), frame_id="world")
        message.pose.position.CopyFrom(transform.translation)
        message.pose.orientation.CopyFrom(transform.rotation)
        recording.write(f"/{agent}/pose", message, moment.index)


def write_road(dataset: Dataset, moment: Moment, recording: McapRecording) -> None:
    """Write the ground in the agents' BEV cameras at this moment as points in the world frame.

    They are 0.5 m apart.
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
            parts.append(colored_points(in_world, color))
    if parts:
        cloud = cloud_message(join_points(parts), "world", moment.index)
        recording.write("/road/points", cloud, moment.index)


def write_scenario(
    dataset: Dataset,
    scenario: RowArgument,
    path: Path,
    config: McapConfig,
    *,
    prediction: Predictions | None,
    progress: bool,
) -> Path:
    """Do the work of `export_mcap`, with the same arguments and errors."""
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    token = record["token"]
    agents = exported_agents(dataset, token, config.agents)
    moments = [
        moment_of(token, number, agents) for number in config.frame_numbers(record["num_frames"])
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
        writers.append(_predicted_scenes(prediction, moments, token).write)
    with (
        replacing(path) as temporary,
        temporary.open("wb") as stream,
        McapRecording(stream) as recording,
    ):
        recording.add_metadata(METADATA, scenario_metadata(dataset, token))
        write_road(dataset, moments[0], recording)
        for moment in tqdm(moments, desc=path.name, disable=not progress, unit="frame"):
            for write in writers:
                write(moment, recording)
    sensors.tell_missing()
    write_layouts(path, recording.topics)
    return path


def _predicted_scenes(
    prediction: Predictions, moments: list[Moment], scenario: str
) -> PredictedScenes:
    """Return the renderer of predictions; raises NotAvailableError if no sample has one."""
    scenes = PredictedScenes(prediction)
    samples = [sample for moment in moments for sample in moment.samples.values()]
    if not any(map(scenes.has, samples)):
        raise NotAvailableError(
            f"prediction: has nothing of {scenario} at these agents and frames, such as "
            f"{moments[0].first_sample!r}"
        )
    return scenes


def scenario_metadata(dataset: Dataset, scenario: str) -> dict[str, str]:
    """Return the file's metadata.

    It has the devkit's version, the scenario, and a hash of its label, meta and calib files.
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
    """Writes events into a log, and, if there is an impact, a countdown to it."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Prepare the facts of a scenario."""
        self._dataset = dataset
        self._record: Any = dataset.get("scenario", scenario)
        self._has_begun = False

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the countdown of a moment; at the first moment, the scenario's facts before it."""
        if not self._has_begun:
            self._has_begun = True
            _log(self._facts(), moment.index, recording)
        frame = self._dataset.get("frame", frame_token(moment.scenario, moment.index))
        seconds = frame["time_to_impact"]
        if seconds is None:
            return
        recording.write("/time_to_impact", DoubleValue(value=seconds), moment.index)
        if seconds == 0:
            _log(f"impact: {self._pair()}", moment.index, recording, Log.ERROR)
        elif round(seconds * 10) % _LOG_INTERVAL_FRAMES == 0:
            _log(f"{seconds:.1f} s to the impact", moment.index, recording)

    def _facts(self) -> str:
        facts = []
        for name in _SCENARIO_FIELDS:
            if self._record[name] is not None:
                facts.append(f"{name} {self._record[name]}")
        ending = "no collision is known"
        if self._record["collision"]:
            ending = f"ends in an accident: {self._pair()}"
        return f"{self._record['token']}: {', '.join(facts)}; {ending}"

    def _pair(self) -> str:
        collision = self._record["collision"]
        pair = zip(collision["classes"], collision["ids"], strict=True)
        return " and ".join(f"{category} {actor}" for category, actor in pair)


def _log(text: str, index: int, recording: McapRecording, level: int = Log.INFO) -> None:
    message = Log(timestamp=protobuf_timestamp(index), level=level, message=text, name=METADATA)
    recording.write("/log", message, index)


class _SensorMessages:
    """Writes the sensor files of moments, and counts the missing ones."""

    def __init__(self, dataset: Dataset, config: McapConfig) -> None:
        """Prepare the sensor files of a release."""
        self._dataset = dataset
        self._channels = tuple(config.channels or ())
        self._step = config.points
        self._files = MissingFiles(dataset.dataroot, "skip")

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the files of a moment, agent by agent; raises SensorFileError."""
        for agent, sample in moment.samples.items():
            for channel in self._channels:
                path = self._dataset.sensor_path(f"{sample}/{channel}")
                if not self._files.has(path, channel):
                    continue
                if channel == LIDAR:
                    self._write_cloud(agent, sample, moment.index, recording)
                else:
                    self._write_image(agent, f"{sample}/{channel}", path, moment.index, recording)

    def tell_missing(self) -> None:
        """Log how many files were left out, if any."""
        self._files.tell()

    def _write_image(
        self, agent: str, token: str, path: ReleasePath, index: int, recording: McapRecording
    ) -> None:
        content, size = read_jpeg(path)
        channel = token.rsplit("/", 1)[1]
        frame = frame_id(agent, channel)
        calibration = _calibration(self._dataset, token, size, frame, index)
        image = CompressedImage(
            timestamp=protobuf_timestamp(index), frame_id=frame, data=content, format="jpeg"
        )
        recording.write(f"/{frame}/calibration", calibration, index)
        recording.write(f"/{frame}/image", image, index)

    def _write_cloud(self, agent: str, sample: str, index: int, recording: McapRecording) -> None:
        cloud = self._dataset.load_point_cloud(sample, "lidar")
        xyz, intensity = cloud.xyz[:: self._step], cloud.intensity[:: self._step]
        points = np.zeros(len(xyz), dtype=LIDAR_POINT)
        # values with few digits compress well: clouds are most of a file
        rounded = (xyz * _LIDAR_STEPS).round().T / _LIDAR_STEPS
        points["x"], points["y"], points["z"] = rounded
        points["intensity"] = (intensity * _INTENSITY_STEPS).round() / _INTENSITY_STEPS
        frame = frame_id(agent, "lidar")
        recording.write(f"/{frame}/points", cloud_message(points, frame, index), index)


def _calibration(
    dataset: Dataset, token: str, size: tuple[int, int], frame: str, index: int
) -> Any:
    """Return a CameraCalibration for an image of `size` (width, height).

    The image may be smaller than in the calib file.
    """
    lens = dataset.camera(token).resized(*size)
    return CameraCalibration(
        timestamp=protobuf_timestamp(index),
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
    """Renders the boxes of moments."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Prepare the boxes of a scenario."""
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
                self._write_annotations(agent, sample, moment.index, recording)

    def _write_actors(self, moment: Moment, recording: McapRecording) -> None:
        view = cooperative_view(self._dataset, moment.first_sample, agents=tuple(moment.samples))
        boxes, segments = view.boxes, box_segments(view.boxes)
        colors = role_colors(self._dataset, moment.first_sample, boxes)
        visible = {}
        for agent, sample in moment.samples.items():
            visible[agent] = set(visible_actors(self._dataset, sample, agents=(agent,)).tolist())
        entities, points = [], []
        for row, actor in enumerate(boxes.actor_id.tolist()):
            color = colors[row]
            trail, path = self._trail(actor, moment.index)
            annotators = [name for bit, name in enumerate(AGENTS) if view.seen_by[row] >> bit & 1]
            observers = [agent for agent, actors in visible.items() if actor in actors]
            facts = {
                **self._facts(boxes, row, actor),
                "annotated_by": ", ".join(annotators),
                "seen_by": ", ".join(observers),
            }
            name = str(actor)
            if actor == UNTRACKED_ID:
                name = f"untracked/{AGENTS[view.source[row]]}/{boxes.row[row]}"
            strips = [strip(part, color) for part in (trail, path) if len(part) > 1]
            entities.append(
                entity(
                    name,
                    "world",
                    moment.index,
                    facts,
                    cubes=[cube(boxes, row, color)],
                    lines=[lines(segments[row, -1:], color), *strips],
                    texts=[label(facts["text"], text_position(boxes, row), color)],
                )
            )
            points += [
                segment_points(segments[row], color),
                strip_points(trail, color),
                strip_points(path, color, _PATH_ALPHA),
            ]
        self._write_speeds(boxes, moment, recording)
        recording.write("/actors", scene_update(entities, moment.index), moment.index)
        cloud = cloud_message(join_points(points), "world", moment.index)
        recording.write("/actors/points", cloud, moment.index)

    def _write_speeds(self, boxes: Boxes, moment: Moment, recording: McapRecording) -> None:
        """Write the known speeds of the exported agents."""
        for row in np.flatnonzero(np.isfinite(boxes.velocity[:, 0])).tolist():
            agent = self._roles.agents.get(int(boxes.actor_id[row]))
            if agent in moment.samples:
                speed = float(np.linalg.norm(boxes.velocity[row]))
                recording.write(f"/{agent}/speed", DoubleValue(value=speed), moment.index)

    def _write_annotations(
        self, agent: str, sample: str, index: int, recording: McapRecording
    ) -> None:
        boxes = self._dataset.boxes(sample, "lidar")
        actors = self._dataset.actor_ids(sample).tolist()
        segments, color = box_segments(boxes), AGENT_COLORS[agent]
        frame = frame_id(agent, "lidar")
        entities = []
        for row, actor in enumerate(actors):
            facts = {**self._facts(boxes, row, actor), "label_id": str(boxes.actor_id[row])}
            name = f"{actor}/{boxes.row[row]}"
            entities.append(entity(name, frame, index, facts, lines=[lines(segments[row], color)]))
        recording.write(f"/{agent}/annotations", scene_update(entities, index), index)

    def _facts(self, boxes: Boxes, row: int, actor: int) -> dict[str, str]:
        category, velocity = CATEGORIES[boxes.category[row]], boxes.velocity[row]
        role = self._roles.role(actor)
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

    def _trail(self, actor: int, index: int) -> tuple[FloatArray, FloatArray]:
        """Return an actor's past and future positions, shape (n, 3) each, in the world frame.

        Both include the present.
        """
        frames, centers = self._paths.get(actor, (np.zeros(0, dtype=np.int64), np.zeros((0, 3))))
        past = (frames <= index) & (frames >= index - TRAIL_FRAMES)
        future = (frames >= index) & (frames <= index + TRAIL_FRAMES)
        return centers[past], centers[future]
