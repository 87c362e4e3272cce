"""An MCAP file on the timeline of a scenario, and Foxglove's messages from the devkit's own types.

`McapRecording` writes messages frame by frame; a `Moment` is a frame of the exported agents. Boxes
are scene entities, which consist of cubes and lines. rerun shows point clouds but no SceneUpdate,
so every rendering is repeated as coloured points, on a topic that ends in `/points`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from types import TracebackType
from typing import IO, Any, Final

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.mcap import EPOCH
from deepaccident_devkit.geometry import SE3, Boxes, quaternions
from deepaccident_devkit.render.boxes import EDGES, recorders_of
from deepaccident_devkit.support.arrays import AnyArray, ByteArray, FloatArray
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, LIDAR
from deepaccident_devkit.v2x.agents import Agents, agents_of, cooperating_agents

_FRAME_NANOSECONDS = 100_000_000
_SECOND_NANOSECONDS = 1_000_000_000
# A point of a rendering; viewers take the colour from the last four fields.
COLORED_POINT: Final = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("alpha", "u1"),
    ]
)
_NUMERIC_TYPES = {
    np.dtype("u1"): PackedElementField.UINT8,
    np.dtype("<i4"): PackedElementField.INT32,
    np.dtype("<f4"): PackedElementField.FLOAT32,
}
_NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])
_FACE_ALPHA = 0.4
_LINE_PIXELS = 2.0
_TEXT_PIXELS = 14.0
# Distance from a box's top to its text.
_TEXT_OFFSET_M = 0.6
# Largest distance between the points of a rendered line.
_POINT_SPACING_M = 0.25


def frame_nanoseconds(frame_number: int) -> int:
    """Return the time of a frame, by its number from 1, in nanoseconds since 1970."""
    elapsed = (frame_number - 1) * _FRAME_NANOSECONDS
    return EPOCH * _SECOND_NANOSECONDS + elapsed


def make_timestamp(frame_number: int) -> Any:
    """Return the time of a frame as a protobuf Timestamp."""
    seconds, nanos = divmod(frame_nanoseconds(frame_number), _SECOND_NANOSECONDS)
    return Timestamp(seconds=seconds, nanos=nanos)


class McapRecording:
    """A file to which messages are written frame by frame.

    The first message of a topic also adds the topic and its schema.

    Chunks are compressed (zstd), and chunks, messages and metadata are indexed, so that viewers can
    seek.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        """Begin a file in a binary stream."""
        self._writer = Writer(stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"deepaccident_devkit {__version__}")
        self._schemas: dict[str, int] = {}
        self._topics: dict[str, int] = {}
        self._sequence: dict[str, Iterator[int]] = defaultdict(count)

    def __enter__(self) -> McapRecording:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write the indexes and the summary, unless there was an error."""
        if error is None:
            self._writer.finish()

    def write(self, topic: str, message: Any, frame_number: int) -> None:
        """Add a protobuf message of a frame to a topic."""
        if topic not in self._topics:
            self._topics[topic] = self._writer.register_channel(
                topic=topic, message_encoding="protobuf", schema_id=self._register_schema(message)
            )
        time = frame_nanoseconds(frame_number)
        self._writer.add_message(
            channel_id=self._topics[topic],
            log_time=time,
            publish_time=time,
            sequence=next(self._sequence[topic]),
            data=message.SerializeToString(deterministic=True),
        )

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that have a message."""
        return tuple(self._topics)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Add a metadata record with these names and values."""
        self._writer.add_metadata(name, values)

    def _register_schema(self, message: Any) -> int:
        name = message.DESCRIPTOR.full_name
        if name not in self._schemas:
            descriptors = build_file_descriptor_set(type(message))
            self._schemas[name] = self._writer.register_schema(
                name=name,
                encoding="protobuf",
                data=descriptors.SerializeToString(deterministic=True),
            )
        return self._schemas[name]


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """A frame and its samples.

    Attributes:
        scenario: Token of the scenario.
        frame_number: Number of the frame, from 1.
        samples: Sample token of each agent, in the order of `taxonomy.AGENTS`.
    """

    scenario: str
    frame_number: int
    samples: Mapping[str, str]

    @property
    def first_sample(self) -> str:
        """Token of the first agent's sample."""
        return next(iter(self.samples.values()))


def make_moment(scenario: str, frame_number: int, agents: tuple[str, ...]) -> Moment:
    """Return a frame with the samples of these agents."""
    samples = {agent: sample_token(scenario, agent, frame_number) for agent in agents}
    return Moment(scenario=scenario, frame_number=frame_number, samples=samples)


def select_agents(dataset: Dataset, scenario: str, agents: Agents) -> tuple[str, ...]:
    """Return the agents that an `agents=` argument selects, in their usual order.

    Raises ChoiceError and NotAvailableError, like `cooperating_agents`.
    """
    first_sample = sample_token(scenario, agents_of(dataset, scenario)[0], 1)
    names = cooperating_agents(dataset, first_sample, agents)
    return tuple(agent for agent in AGENTS if agent in names)


class Roles:
    """The colliding pair and the recording vehicles of a scenario, with words for their roles."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Read the roles of a scenario from its meta."""
        collision = dataset.get("scenario", scenario)["collision"]
        self.pair: frozenset[int] = frozenset()
        if collision is not None:
            self.pair = frozenset(collision["ids"])
        self.agents: Mapping[int, str] = recorders_of(dataset, scenario)

    def describe(self, actor: int) -> str:
        """Describe an actor's role, such as `ego_vehicle, collides`; empty if it has none."""
        words = []
        if actor in self.agents:
            words.append(self.agents[actor])
        if actor in self.pair:
            words.append("collides")
        return ", ".join(words)


def name_frame(agent: str, frame: str) -> str:
    """Name a coordinate frame of an agent's sample.

    The name is `world` for the world, the agent's name for `ego`, and `agent/channel` for a sensor.
    """
    if frame == "world":
        return frame
    if frame == "ego":
        return agent
    channel = LIDAR if frame == "lidar" else frame
    return f"{agent}/{channel}"


def make_transform(parent: str, child: str, parent_from_child: SE3, frame_number: int) -> Any:
    """Return a FrameTransform with the pose of the coordinate frame `child` in `parent`."""
    rotation = quaternions.single_from_matrix(parent_from_child.rotation)
    return FrameTransform(
        timestamp=make_timestamp(frame_number),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=make_vector(parent_from_child.translation),
        rotation=make_quaternion(np.array(rotation)),
    )


def make_pose(center: FloatArray, rotation: FloatArray) -> Any:
    """Make a Pose from a centre (3,) in metres and a unit quaternion (4,) w, x, y, z."""
    return Pose(position=make_vector(center), orientation=make_quaternion(rotation))


def make_vector(values: FloatArray) -> Any:
    """Convert an array (3,) to a Vector3."""
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def make_quaternion(rotation: FloatArray) -> Any:
    """Convert an array (4,) w, x, y, z to a Quaternion."""
    w, x, y, z = rotation.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def make_points(points: FloatArray) -> list[Any]:
    """Convert an array (N, 3) to a list of Point3."""
    messages = []
    for x, y, z in points.tolist():
        messages.append(Point3(x=x, y=y, z=z))
    return messages


def parse_color(color: str) -> ByteArray:
    """Parse a colour of `render.styles`, such as `#9a9a9a`, to an array (3,) uint8."""
    values = bytes.fromhex(color[1:])
    return np.frombuffer(values, dtype=np.uint8)


def make_color(color: str, alpha: float = 1.0) -> Any:
    """Convert a colour of `render.styles` to a Color."""
    values = parse_color(color) / 255
    red, green, blue = values.tolist()
    return Color(r=red, g=green, b=blue, a=alpha)


def make_cloud(points: AnyArray, frame: str, frame_number: int) -> Any:
    """Convert a structured array (N,) to a PointCloud.

    The message has a field for each field of the array (x, y, z and others).
    """
    columns: ReadOnlyValues = points.dtype.fields or {}
    fields = []
    for name in points.dtype.names or ():
        dtype, offset = columns[name][:2]
        fields.append(PackedElementField(name=name, offset=offset, type=_NUMERIC_TYPES[dtype]))
    return PointCloud(
        timestamp=make_timestamp(frame_number),
        frame_id=frame,
        pose=make_pose(np.zeros(3), _NO_ROTATION),
        point_stride=points.dtype.itemsize,
        fields=fields,
        data=points.tobytes(),
    )


def make_scene_update(entities: Sequence[Any], frame_number: int) -> Any:
    """Make a SceneUpdate that shows these entities and removes all others on its topic."""
    deletion = SceneEntityDeletion(
        timestamp=make_timestamp(frame_number), type=SceneEntityDeletion.ALL
    )
    return SceneUpdate(deletions=[deletion], entities=entities)


def make_entity(
    name: str, frame: str, frame_number: int, facts: Mapping[str, str], **primitives: Sequence[Any]
) -> Any:
    """Return a SceneEntity in a coordinate frame.

    Args:
        name: Id of the entity.
        frame: Id of the coordinate frame.
        frame_number: Number of the frame in time, from 1.
        facts: Facts that the viewer shows after a click on the entity.
        **primitives: Lists of the primitives of the entity, by their kind.
    """
    seconds = (frame_number - 1) * FRAME_PERIOD
    metadata = {**facts, "seconds": f"{seconds:.1f}"}
    return SceneEntity(
        timestamp=make_timestamp(frame_number),
        frame_id=frame,
        id=name,
        frame_locked=False,
        metadata=[KeyValuePair(key=key, value=value) for key, value in metadata.items()],
        **primitives,
    )


def make_cube(boxes: Boxes, row: int, color: str) -> Any:
    """Convert the box in one row of `boxes` to a transparent CubePrimitive."""
    return CubePrimitive(
        pose=make_pose(boxes.center[row], boxes.rotation[row]),
        size=make_vector(boxes.size[row]),
        color=make_color(color, _FACE_ALPHA),
    )


def make_lines(segments: FloatArray, color: str, alpha: float = 1.0) -> Any:
    """Convert segments (N, 2, 3) to a LinePrimitive that is equally thick at all distances."""
    points = segments.reshape(-1, 3)
    return _make_line(LinePrimitive.LINE_LIST, points, color, alpha)


def make_strip(points: FloatArray, color: str) -> Any:
    """Make a LinePrimitive through points (N, 3)."""
    return _make_line(LinePrimitive.LINE_STRIP, points, color)


def make_label(text: str, position: FloatArray, color: str) -> Any:
    """Make a TextPrimitive at a position (3,) that is equally large at all distances."""
    return TextPrimitive(
        pose=make_pose(position, _NO_ROTATION),
        billboard=True,
        font_size=_TEXT_PIXELS,
        scale_invariant=True,
        color=make_color(color),
        text=text,
    )


def compute_box_segments(boxes: Boxes) -> FloatArray:
    """Return the segments that show N boxes, shape (N, 13, 2, 3).

    They are the twelve edges of each box and a line on its floor, from the middle to the front.
    """
    edges = boxes.corners()[:, np.array(EDGES)]
    floor = boxes.bottom_corners()
    middle = floor.mean(axis=1)
    front = floor[:, :2].mean(axis=1)
    front_line = np.stack([middle, front], axis=1)
    return np.concatenate([edges, front_line[:, None]], axis=1)


def compute_text_position(boxes: Boxes, row: int) -> FloatArray:
    """Return the position (3,) of the text above the box in one row of `boxes`."""
    half_height = boxes.size[row, 2] / 2
    offset = np.array([0.0, 0.0, half_height + _TEXT_OFFSET_M])
    return np.asarray(boxes.center[row] + offset)


def sample_segments(segments: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Return `COLORED_POINT`s (M,) along segments (N, 2, 3), including their ends."""
    if not len(segments):
        return np.zeros(0, dtype=COLORED_POINT)
    starts = segments[:, 0]
    ends = segments[:, 1]
    lengths = np.linalg.norm(ends - starts, axis=1)
    counts = np.ceil(lengths / _POINT_SPACING_M).astype(np.int64) + 1
    rows = np.repeat(np.arange(len(segments)), counts)
    first_points = np.repeat(np.cumsum(counts) - counts, counts)
    steps = np.arange(len(rows)) - first_points
    max_steps = np.maximum(counts - 1, 1)
    shares = (steps / max_steps[rows])[:, None]
    xyz = starts[rows] * (1 - shares) + ends[rows] * shares
    return color_points(xyz, color, alpha)


def sample_strip(points: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Return `COLORED_POINT`s along a line through points (N, 3)."""
    segments = np.stack([points[:-1], points[1:]], axis=1)
    return sample_segments(segments, color, alpha)


def color_points(xyz: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Return points (N, 3) as `COLORED_POINT`s (N,) of one colour."""
    points = np.zeros(len(xyz), dtype=COLORED_POINT)
    points["x"], points["y"], points["z"] = xyz.T
    points["red"], points["green"], points["blue"] = parse_color(color).tolist()
    points["alpha"] = round(255 * alpha)
    return points


def join_points(point_arrays: Sequence[AnyArray]) -> AnyArray:
    """Return the `COLORED_POINT`s of several renderings in one array."""
    no_points = np.zeros(0, dtype=COLORED_POINT)
    return np.concatenate([no_points, *point_arrays])


def _make_line(kind: int, points: FloatArray, color: str, alpha: float = 1.0) -> Any:
    return LinePrimitive(
        type=kind,
        pose=make_pose(np.zeros(3), _NO_ROTATION),
        thickness=_LINE_PIXELS,
        scale_invariant=True,
        points=make_points(points),
        color=make_color(color, alpha),
    )
