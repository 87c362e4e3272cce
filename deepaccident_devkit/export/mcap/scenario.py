"""A scenario's messages, moment by moment: words, poses, sensor files and actors."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
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
    above,
    box_segments,
    cloud_message,
    colored_points,
    cube,
    entity,
    exported_agents,
    frame_id,
    joined,
    label,
    lines,
    moment_of,
    protobuf_timestamp,
    scene_update,
    segment_points,
    strip,
    strip_points,
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
# Frames (0.1 s) between two lines of the countdown.
_LOG_EVERY: Final = 5
_SHOWN: Final = ("town", "weather", "time_of_day", "road_type", "split", "accident_type")
LIDAR_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
# Into how many steps LiDAR coordinates are rounded in a metre, and intensities from 0 to 1.
_LIDAR_STEPS, _INTENSITIES = 32, 32
# Cells of a BEV camera from one point of the road to the next.
_ROAD_STEP: Final = 5
TRAIL_FRAMES: Final = 20
"""How many frames (2 s) an actor's trail goes back, and its path goes ahead."""
_PATH_ALPHA: Final = 0.5


def write_poses(dataset: Dataset, moment: Moment, recording: McapRecording) -> None:
    """Write world → agent → sensors in one message, and each agent's pose in a message of its own."""
    transforms, poses = [], []
    for agent, sample in moment.samples.items():
        own = frame_id(agent, "ego")
        there = transform_message("world", own, dataset.world_from(sample, "ego"), moment.index)
        transforms.append(there)
        transforms += [
            transform_message(
                own, frame_id(agent, channel), dataset.ego_from(sample, channel), moment.index
            )
            for channel in EXPORTED_CHANNELS
        ]
        poses.append((agent, there))
    recording.write("/tf", FrameTransforms(transforms=transforms), moment.index)
    for agent, there in poses:
        message = PoseInFrame(timestamp=protobuf_timestamp(moment.index), frame_id="world")
        message.pose.position.CopyFrom(there.translation)
        message.pose.orientation.CopyFrom(there.rotation)
        recording.write(f"/{agent}/pose", message, moment.index)


def write_road(dataset: Dataset, moment: Moment, recording: McapRecording) -> None:
    """Write what the agents' BEV cameras see of the ground at this moment as points in world, every 0.5 m."""
    parts = []
    for agent, sample in moment.samples.items():
        if not dataset.sensor_path(f"{sample}/{BEV_CAMERA}").exists():
            continue
        image, height = dataset.load_bev(sample), -POLE_HEIGHT if agent == INFRASTRUCTURE else 0.0
        tags, middle = image.semantic[::_ROAD_STEP, ::_ROAD_STEP], (len(image.semantic) - 1) / 2
        for name, color in MAP_COLORS.items():
            ahead, left = (
                middle - _ROAD_STEP * np.argwhere(tags == TAGS.get(name, -1)).T
            ) * image.resolution
            ground = np.column_stack([ahead, left, np.full(len(ahead), height)])
            parts.append(colored_points(dataset.world_from(sample, "ego").apply(ground), color))
    if parts:
        recording.write(
            "/road/points", cloud_message(joined(parts), "world", moment.index), moment.index
        )


def write_scenario(
    dataset: Dataset,
    scenario: RowArgument,
    path: Path,
    config: McapConfig,
    *,
    prediction: Predictions | None,
    progress: bool,
) -> Path:
    """The work of `export_mcap`, with the same arguments and errors."""
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    token = record["token"]
    agents = exported_agents(dataset, token, config.agents)
    moments = [
        moment_of(token, index, agents) for index in config.frame_numbers(record["num_frames"])
    ]
    sensors = _SensorMessages(dataset, config)
    parts: list[Callable[[Moment, McapRecording], None]]
    parts = [
        _StoryMessages(dataset, token).write,
        partial(write_poses, dataset),
        sensors.write,
        _ActorMessages(dataset, token).write,
    ]
    if config.motion_labels is not None:
        parts.append(
            MotionMapMessages(dataset, token, resolved_label_config(config.motion_labels)).write
        )
    if prediction is not None:
        parts.append(_predicted(prediction, moments, token).write)
    with (
        replacing(path) as temporary,
        temporary.open("wb") as stream,
        McapRecording(stream) as recording,
    ):
        recording.add_metadata(METADATA, scenario_metadata(dataset, token))
        write_road(dataset, moments[0], recording)
        for moment in tqdm(moments, desc=path.name, disable=not progress, unit="frame"):
            for write in parts:
                write(moment, recording)
    sensors.tell_missing()
    write_layouts(path, recording.topics)
    return path


def _predicted(prediction: Predictions, moments: list[Moment], scenario: str) -> PredictedScenes:
    scenes = PredictedScenes(prediction)
    if not any(scenes.has(sample) for moment in moments for sample in moment.samples.values()):
        raise NotAvailableError(
            f"prediction: has nothing of {scenario} at these agents and frames, such as {moments[0].first_sample!r}"
        )
    return scenes


def scenario_metadata(dataset: Dataset, scenario: str) -> dict[str, str]:
    """The file's metadata: the devkit's version, the scenario, a hash of its label, meta and calib files."""
    record = dataset.get("scenario", scenario)
    return {
        "devkit_version": __version__,
        "release_version": dataset.version,
        "scenario": scenario,
        "fingerprint": fingerprint(scenario_hashes(dataset, [scenario], workers=1)),
        "collision": json.dumps(record["collision"], sort_keys=True),
        **{name: str(record[name]) for name in _SHOWN if record[name] is not None},
    }


class _StoryMessages:
    """Writes into a log what happens, and, if there is an impact, a countdown to it."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Prepare the facts of a scenario."""
        self._dataset = dataset
        self._record: Any = dataset.get("scenario", scenario)
        self._told = False

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write the countdown of a moment; at the first moment, the scenario's facts before it."""
        if not self._told:
            self._told = True
            _log(self._facts(), moment.index, recording)
        left = self._dataset.get("frame", frame_token(moment.scenario, moment.index))[
            "time_to_impact"
        ]
        if left is None:
            return
        recording.write("/time_to_impact", DoubleValue(value=left), moment.index)
        if left == 0:
            _log(f"impact: {self._pair()}", moment.index, recording, Log.ERROR)
        elif round(left * 10) % _LOG_EVERY == 0:
            _log(f"{left:.1f} s to the impact", moment.index, recording)

    def _facts(self) -> str:
        told = ", ".join(
            f"{name} {self._record[name]}" for name in _SHOWN if self._record[name] is not None
        )
        ending = (
            f"ends in an accident: {self._pair()}"
            if self._record["collision"]
            else "no collision is known"
        )
        return f"{self._record['token']}: {told}; {ending}"

    def _pair(self) -> str:
        collision = self._record["collision"]
        return " and ".join(
            f"{kind} {actor}"
            for kind, actor in zip(collision["classes"], collision["ids"], strict=True)
        )


def _log(text: str, index: int, recording: McapRecording, level: int = Log.INFO) -> None:
    recording.write(
        "/log",
        Log(timestamp=protobuf_timestamp(index), level=level, message=text, name=METADATA),
        index,
    )


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
        (content, size), channel = read_jpeg(path), token.rsplit("/", 1)[1]
        frame = frame_id(agent, channel)
        image = CompressedImage(
            timestamp=protobuf_timestamp(index), frame_id=frame, data=content, format="jpeg"
        )
        recording.write(
            f"/{frame}/calibration", _calibration(self._dataset, token, size, frame, index), index
        )
        recording.write(f"/{frame}/image", image, index)

    def _write_cloud(self, agent: str, sample: str, index: int, recording: McapRecording) -> None:
        cloud = self._dataset.load_point_cloud(sample, "lidar")
        rows = slice(None, None, self._step)
        points = np.zeros(len(cloud.xyz[rows]), dtype=LIDAR_POINT)
        # few digits are small when compressed: clouds are most of a file
        points["x"], points["y"], points["z"] = (
            cloud.xyz[rows] * _LIDAR_STEPS
        ).round().T / _LIDAR_STEPS
        points["intensity"] = (cloud.intensity[rows] * _INTENSITIES).round() / _INTENSITIES
        frame = frame_id(agent, "lidar")
        recording.write(f"/{frame}/points", cloud_message(points, frame, index), index)


def _calibration(
    dataset: Dataset, token: str, size: tuple[int, int], frame: str, index: int
) -> Any:
    """A CameraCalibration for an image of `size` (width, height), which may be smaller than calib says."""
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
        self._paths: Mapping[int, tuple[IntArray, FloatArray]] = {
            actor: (tracks.index[rows], tracks.boxes.center[rows])
            for actor in np.unique(tracks.actor_id).tolist()
            for rows in [np.flatnonzero(tracks.actor_id == actor)]
        }

    def write(self, moment: Moment, recording: McapRecording) -> None:
        """Write all actors of a moment in world, and the annotations of each agent in its LiDAR frame."""
        self._write_actors(moment, recording)
        for agent, sample in moment.samples.items():
            if self._dataset.get("sample", sample)["labelled"]:
                self._write_annotations(agent, sample, moment.index, recording)

    def _write_actors(self, moment: Moment, recording: McapRecording) -> None:
        view = cooperative_view(self._dataset, moment.first_sample, agents=tuple(moment.samples))
        boxes, segments = view.boxes, box_segments(view.boxes)
        colors = role_colors(self._dataset, moment.first_sample, boxes)
        seen = {
            agent: set(visible_actors(self._dataset, sample, agents=(agent,)).tolist())
            for agent, sample in moment.samples.items()
        }
        entities, points = [], []
        for row, actor in enumerate(boxes.actor_id.tolist()):
            color = colors[row]
            trail, path = self._trail(actor, moment.index)
            facts = {
                **self._facts(boxes, row, actor),
                "annotated_by": ", ".join(
                    [name for bit, name in enumerate(AGENTS) if view.seen_by[row] >> bit & 1]
                ),
                "seen_by": ", ".join(agent for agent, actors in seen.items() if actor in actors),
            }
            name = str(actor)
            if actor == UNTRACKED_ID:
                name = f"untracked/{AGENTS[view.source[row]]}/{boxes.row[row]}"
            entities.append(
                entity(
                    name,
                    "world",
                    moment.index,
                    facts,
                    cubes=[cube(boxes, row, color)],
                    lines=[
                        lines(segments[row, -1:], color),
                        *(strip(part, color) for part in (trail, path) if len(part) > 1),
                    ],
                    texts=[label(facts["text"], above(boxes, row), color)],
                )
            )
            points += [
                segment_points(segments[row], color),
                strip_points(trail, color),
                strip_points(path, color, _PATH_ALPHA),
            ]
        for row in np.flatnonzero(np.isfinite(boxes.velocity[:, 0])).tolist():
            agent = self._roles.agents.get(int(boxes.actor_id[row]))
            if agent in moment.samples:
                speed = DoubleValue(value=float(np.linalg.norm(boxes.velocity[row])))
                recording.write(f"/{agent}/speed", speed, moment.index)
        recording.write("/actors", scene_update(entities, moment.index), moment.index)
        recording.write(
            "/actors/points", cloud_message(joined(points), "world", moment.index), moment.index
        )

    def _write_annotations(
        self, agent: str, sample: str, index: int, recording: McapRecording
    ) -> None:
        boxes, actors = (
            self._dataset.boxes(sample, "lidar"),
            self._dataset.actor_ids(sample).tolist(),
        )
        segments, color = box_segments(boxes), AGENT_COLORS[agent]
        entities = []
        for row, actor in enumerate(actors):
            facts = {**self._facts(boxes, row, actor), "label_id": str(boxes.actor_id[row])}
            name = f"{actor}/{boxes.row[row]}"
            entities.append(
                entity(
                    name,
                    frame_id(agent, "lidar"),
                    index,
                    facts,
                    lines=[lines(segments[row], color)],
                )
            )
        recording.write(f"/{agent}/annotations", scene_update(entities, index), index)

    def _facts(self, boxes: Boxes, row: int, actor: int) -> dict[str, str]:
        category, velocity = CATEGORIES[boxes.category[row]], boxes.velocity[row]
        role = self._roles.role(actor)
        identity = "untracked" if actor == UNTRACKED_ID else str(actor)
        return {
            "text": f"{category} {identity}" + (f" ({role})" if role else ""),
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
        """Where an actor was and where it will be, (n, 3) each, in world; both include the present."""
        frames, centers = self._paths.get(actor, (np.zeros(0, dtype=np.int64), np.zeros((0, 3))))
        past = (frames <= index) & (frames >= index - TRAIL_FRAMES)
        future = (frames >= index) & (frames <= index + TRAIL_FRAMES)
        return centers[past], centers[future]
