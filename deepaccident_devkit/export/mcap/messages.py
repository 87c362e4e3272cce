"""An MCAP file on the timeline of a scenario, and Foxglove's messages from the devkit's own types.

`McapRecording` writes messages frame by frame; a `Moment` is a frame of the exported agents. Boxes
are scene entities (cubes and lines), and coloured points for viewers without these: rerun shows
point clouds but no SceneUpdate, so every rendering is repeated as points, on a topic that ends in
`/points`.
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
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, LIDAR
from deepaccident_devkit.v2x.agents import Agents, agents_of, cooperating_agents

_FRAME_NANOSECONDS: Final = 100_000_000
_SECOND_NANOSECONDS: Final = 1_000_000_000
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
"""A point of a rendering; viewers take the colour from the last four fields."""
_NUMERIC_TYPES: Final = {
    np.dtype("u1"): PackedElementField.UINT8,
    np.dtype("<i4"): PackedElementField.INT32,
    np.dtype("<f4"): PackedElementField.FLOAT32,
}
_NO_ROTATION: Final = np.array([1.0, 0.0, 0.0, 0.0])
_FACE_ALPHA: Final = 0.4
_LINE_PIXELS: Final = 2.0
_TEXT_PIXELS: Final = 14.0
# Distance from a box's top to its text.
_TEXT_OFFSET_M: Final = 0.6
POINT_SPACING: Final = 0.25
"""Metres between the points of a rendered line."""


def frame_nanoseconds(index: int) -> int:
    """Return the time of frame number `index` (from 1) on the file's timeline, in nanoseconds."""
    return EPOCH * _SECOND_NANOSECONDS + (index - 1) * _FRAME_NANOSECONDS


def protobuf_timestamp(index: int) -> Any:
    """Return the same time as a protobuf Timestamp."""
    seconds, nanos = divmod(frame_nanoseconds(index), _SECOND_NANOSECONDS)
    return Timestamp(seconds=seconds, nanos=nanos)


class McapRecording:
    """Writes messages frame by frame; a topic and its schema are added with its first message.

    Chunks are compressed (zstd), and chunks, messages and metadata are indexed, so that viewers can
    seek.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        """Begin a file."""
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
        """Write the indexes and the summary, if there was no error."""
        if error is None:
            self._writer.finish()

    def write(self, topic: str, message: Any, index: int) -> None:
        """Add a protobuf message of frame number `index` to a topic."""
        if topic not in self._topics:
            self._topics[topic] = self._writer.register_channel(
                topic=topic, message_encoding="protobuf", schema_id=self._schema(message)
            )
        time = frame_nanoseconds(index)
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
        """Add a metadata record: names and their values."""
        self._writer.add_metadata(name, values)

    def _schema(self, message: Any) -> int:
        name = message.DESCRIPTOR.full_name
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(
                name=name,
                encoding="protobuf",
                data=build_file_descriptor_set(type(message)).SerializeToString(deterministic=True),
            )
        return self._schemas[name]


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """A frame and its samples.

    Attributes:
        scenario: Token of the scenario.
        index: Frame number from 1.
        samples: Agent → sample token, in the order of `taxonomy.AGENTS`.
    """

    scenario: str
    index: int
    samples: Mapping[str, str]

    @property
    def first_sample(self) -> str:
        """Token of the first agent's sample."""
        return next(iter(self.samples.values()))


def moment_of(scenario: str, index: int, agents: tuple[str, ...]) -> Moment:
    """Return frame number `index` of the agents."""
    samples = {agent: sample_token(scenario, agent, index) for agent in agents}
    return Moment(scenario=scenario, index=index, samples=samples)


def exported_agents(dataset: Dataset, scenario: str, agents: Agents) -> tuple[str, ...]:
    """Return the agents of an `agents=` argument, in usual order.

    Raises ChoiceError and NotAvailableError.
    """
    names = cooperating_agents(
        dataset, sample_token(scenario, agents_of(dataset, scenario)[0], 1), agents
    )
    return tuple(agent for agent in AGENTS if agent in names)


class Roles:
    """The colliding pair, the recording vehicles, and all other actors."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Read the roles of a scenario from its meta."""
        collision = dataset.get("scenario", scenario)["collision"]
        self.pair: frozenset[int] = frozenset()
        if collision is not None:
            self.pair = frozenset(collision["ids"])
        self.agents: Mapping[int, str] = recorders_of(dataset, scenario)

    def role(self, actor: int) -> str:
        """Return the role of an actor, such as `ego_vehicle, collides`; empty for most actors."""
        words = []
        if actor in self.agents:
            words.append(self.agents[actor])
        if actor in self.pair:
            words.append("collides")
        return ", ".join(words)


def frame_id(agent: str, frame: str) -> str:
    """Return the name of a sample's coordinate frame.

    It is `world`; the agent's name for `ego`; `agent/channel` for a sensor.
    """
    if frame == "world":
        return frame
    if frame == "ego":
        return agent
    return f"{agent}/{LIDAR if frame == 'lidar' else frame}"


def transform_message(parent: str, child: str, parent_from_child: SE3, index: int) -> Any:
    """Return a FrameTransform: the pose of one coordinate frame in another."""
    rotation = quaternions.single_from_matrix(parent_from_child.rotation)
    return FrameTransform(
        timestamp=protobuf_timestamp(index),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=vector(parent_from_child.translation),
        rotation=quaternion(np.array(rotation)),
    )


def pose(center: FloatArray, rotation: FloatArray) -> Any:
    """Return the Pose of a centre (3,), in metres, and a unit quaternion (4,) w, x, y, z."""
    return Pose(position=vector(center), orientation=quaternion(rotation))


def vector(values: FloatArray) -> Any:
    """Return the Vector3 of an array (3,)."""
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def quaternion(rotation: FloatArray) -> Any:
    """Return the Quaternion of an array (4,) w, x, y, z."""
    w, x, y, z = rotation.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def points3(points: FloatArray) -> list[Any]:
    """Return the Point3s of an array (N, 3)."""
    return [Point3(x=x, y=y, z=z) for x, y, z in points.tolist()]


def rgb(color: str) -> ByteArray:
    """Return a colour of `render.styles`, such as `#9a9a9a`, as (3,) uint8."""
    return np.frombuffer(bytes.fromhex(color[1:]), dtype=np.uint8)


def color_message(color: str, alpha: float = 1.0) -> Any:
    """Return a colour of `render.styles` as a `Color`."""
    red, green, blue = (rgb(color) / 255).tolist()
    return Color(r=red, g=green, b=blue, a=alpha)


def cloud_message(points: AnyArray, frame: str, index: int) -> Any:
    """Return the PointCloud of a structured array (N,).

    It has a message field for each field of the array (x, y, z and others).
    """
    columns: Mapping[str, Any] = points.dtype.fields or {}
    fields = []
    for name in points.dtype.names or ():
        dtype, offset = columns[name][:2]
        fields.append(PackedElementField(name=name, offset=offset, type=_NUMERIC_TYPES[dtype]))
    return PointCloud(
        timestamp=protobuf_timestamp(index),
        frame_id=frame,
        pose=pose(np.zeros(3), _NO_ROTATION),
        point_stride=points.dtype.itemsize,
        fields=fields,
        data=points.tobytes(),
    )


def scene_update(entities: Sequence[Any], index: int) -> Any:
    """Return a SceneUpdate that shows these entities and removes all others of its topic."""
    deletion = SceneEntityDeletion(
        timestamp=protobuf_timestamp(index), type=SceneEntityDeletion.ALL
    )
    return SceneUpdate(deletions=[deletion], entities=entities)


def entity(
    name: str, frame: str, index: int, facts: Mapping[str, str], **primitives: Sequence[Any]
) -> Any:
    """Return a SceneEntity in a coordinate frame.

    Args:
        name: Id of the entity.
        frame: Id of the coordinate frame.
        index: Frame number.
        facts: Facts that the viewer shows after a click on the entity.
        **primitives: Lists of its primitives.
    """
    seconds = (index - 1) * FRAME_PERIOD
    metadata = {**facts, "seconds": f"{seconds:.1f}"}
    return SceneEntity(
        timestamp=protobuf_timestamp(index),
        frame_id=frame,
        id=name,
        frame_locked=False,
        metadata=[KeyValuePair(key=key, value=value) for key, value in metadata.items()],
        **primitives,
    )


def cube(boxes: Boxes, row: int, color: str) -> Any:
    """Return one of the boxes as a transparent CubePrimitive."""
    return CubePrimitive(
        pose=pose(boxes.center[row], boxes.rotation[row]),
        size=vector(boxes.size[row]),
        color=color_message(color, _FACE_ALPHA),
    )


def lines(segments: FloatArray, color: str) -> Any:
    """Return segments (N, 2, 3) as a LinePrimitive, equally thick at all distances."""
    return _line(LinePrimitive.LINE_LIST, segments.reshape(-1, 3), color)


def strip(points: FloatArray, color: str) -> Any:
    """Return a line through points (N, 3) as a LinePrimitive."""
    return _line(LinePrimitive.LINE_STRIP, points, color)


def label(text: str, position: FloatArray, color: str) -> Any:
    """Return a text at a position (3,) as a TextPrimitive, equally large at all distances."""
    return TextPrimitive(
        pose=pose(position, _NO_ROTATION),
        billboard=True,
        font_size=_TEXT_PIXELS,
        scale_invariant=True,
        color=color_message(color),
        text=text,
    )


def box_segments(boxes: Boxes) -> FloatArray:
    """Return the segments of N boxes, shape (N, 13, 2, 3).

    They are the twelve edges of each box and, on the floor, a line from its middle to its front.
    """
    corners, floor = boxes.corners(), boxes.bottom_corners()
    edges = corners[:, np.array(EDGES)]
    middle, front = floor.mean(axis=1), floor[:, :2].mean(axis=1)
    return np.concatenate([edges, np.stack([middle, front], axis=1)[:, None]], axis=1)


def text_position(boxes: Boxes, row: int) -> FloatArray:
    """Return the position (3,) of a box's text."""
    offset = np.array([0.0, 0.0, boxes.size[row, 2] / 2 + _TEXT_OFFSET_M])
    return np.asarray(boxes.center[row] + offset)


def segment_points(segments: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Return points (M,) of `COLORED_POINT` along segments (N, 2, 3), ends included."""
    if not len(segments):
        return np.zeros(0, dtype=COLORED_POINT)
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    counts = np.ceil(lengths / POINT_SPACING).astype(np.int64) + 1
    rows = np.repeat(np.arange(len(segments)), counts)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    step = np.arange(len(rows)) - starts
    share = (step / np.maximum(counts - 1, 1)[rows])[:, None]
    xyz = segments[rows, 0] * (1 - share) + segments[rows, 1] * share
    return colored_points(xyz, color, alpha)


def strip_points(points: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Return points of `COLORED_POINT` along a line through points (N, 3)."""
    return segment_points(np.stack([points[:-1], points[1:]], axis=1), color, alpha)


def colored_points(xyz: FloatArray, color: str, alpha: float = 1.0) -> AnyArray:
    """Return points (N, 3) as (N,) `COLORED_POINT` of one colour."""
    points = np.zeros(len(xyz), dtype=COLORED_POINT)
    points["x"], points["y"], points["z"] = xyz.T
    points["red"], points["green"], points["blue"] = rgb(color).tolist()
    points["alpha"] = round(255 * alpha)
    return points


def join_points(parts: Sequence[AnyArray]) -> AnyArray:
    """Return the points of several renderings in one array."""
    return np.concatenate([np.zeros(0, dtype=COLORED_POINT), *parts])


def _line(kind: int, points: FloatArray, color: str) -> Any:
    return LinePrimitive(
        type=kind,
        pose=pose(np.zeros(3), _NO_ROTATION),
        thickness=_LINE_PIXELS,
        scale_invariant=True,
        points=points3(points),
        color=color_message(color),
    )
