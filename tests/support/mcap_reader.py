"""Read MCAP files back with the official library."""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import Message
from mcap_protobuf.decoder import DecoderFactory

_NUMPY_TYPES = {1: "u1", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
"""PackedElementField's numeric types."""


@dataclass(frozen=True)
class McapFile:
    """The decoded contents of an MCAP file.

    Attributes:
        messages: Pairs of record and decoded message by topic, in the file's order.
        schemas: Name of the schema by topic.
        metadata: Metadata records by name.
        summary: The file's summary section.
        log_times: Log time of every message in nanoseconds, in the file's order.
    """

    messages: dict[str, list[tuple[Message, Any]]]
    schemas: dict[str, str]
    metadata: dict[str, dict[str, str]]
    summary: Any
    log_times: list[int]

    def decoded(self, topic: str) -> list[Any]:
        return [message for _, message in self.messages[topic]]


def read_mcap(path: Path) -> McapFile:
    messages: dict[str, list[tuple[Message, Any]]] = defaultdict(list)
    schemas: dict[str, str] = {}
    log_times: list[int] = []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, record, decoded in reader.iter_decoded_messages(log_time_order=False):
            messages[channel.topic].append((record, decoded))
            schemas[channel.topic] = schema.name
            log_times.append(record.log_time)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        summary = reader.get_summary()
    return McapFile(dict(messages), schemas, metadata, summary, log_times)


def read_cloud(message: Any) -> np.ndarray:
    """Read the points of a PointCloud message as records with the message's own fields."""
    layout = {
        "names": [field.name for field in message.fields],
        "formats": [_NUMPY_TYPES[field.type] for field in message.fields],
        "offsets": [field.offset for field in message.fields],
        "itemsize": message.point_stride,
    }
    return np.frombuffer(message.data, dtype=np.dtype(layout))


def read_positions(cloud: np.ndarray) -> np.ndarray:
    columns = [cloud[axis] for axis in ("x", "y", "z")]
    return np.column_stack(columns).astype(np.float64)


def read_matrix(translation: Any, rotation: Any) -> np.ndarray:
    """Return the (4, 4) pose of a Vector3 and a Quaternion, without the devkit's geometry."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation.x, translation.y, translation.z
    return matrix
