"""MCAP files read back by the format's own library."""

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
    """A file's messages by topic, (record, decoded message) in the file's order, schemas' names,
    metadata, summary.
    """

    messages: dict[str, list[tuple[Message, Any]]]
    schemas: dict[str, str]
    metadata: dict[str, dict[str, str]]
    summary: Any
    log_times: list[int]

    def only(self, topic: str) -> list[Any]:
        return [message for _, message in self.messages[topic]]


def read_mcap(path: Path) -> McapFile:
    messages: dict[str, list[tuple[Message, Any]]] = defaultdict(list)
    schemas, log_times = {}, []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, record, decoded in reader.iter_decoded_messages(log_time_order=False):
            messages[channel.topic].append((record, decoded))
            schemas[channel.topic] = schema.name
            log_times.append(record.log_time)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        return McapFile(dict(messages), schemas, metadata, reader.get_summary(), log_times)


def cloud_of(message: Any) -> np.ndarray:
    """The points of a PointCloud, by its own fields."""
    kinds = [(field.name, _NUMPY_TYPES[field.type], field.offset) for field in message.fields]
    names, formats, offsets = zip(*kinds, strict=True)
    dtype = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_stride}
    )
    return np.frombuffer(message.data, dtype=dtype)


def xyz_of(cloud: np.ndarray) -> np.ndarray:
    return np.column_stack([cloud["x"], cloud["y"], cloud["z"]]).astype(np.float64)


def matrix_of(translation: Any, rotation: Any) -> np.ndarray:
    """(4, 4) of a Vector3 and a Quaternion, by a formula of its own."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = translation.x, translation.y, translation.z
    return matrix
