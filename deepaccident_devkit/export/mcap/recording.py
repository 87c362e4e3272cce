"""`Recording`: an MCAP file being written, on the timeline of a scenario."""

from __future__ import annotations

from types import TracebackType
from typing import IO, Any, Final

from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from deepaccident_devkit._version import __version__
from deepaccident_devkit.export.mcap.config import EPOCH

_FRAME_NANOSECONDS: Final = 100_000_000
_SECOND_NANOSECONDS: Final = 1_000_000_000


def frame_nanoseconds(index: int) -> int:
    """The time of frame number `index` (from 1) on the file's timeline, nanoseconds."""
    return EPOCH * _SECOND_NANOSECONDS + (index - 1) * _FRAME_NANOSECONDS


def frame_timestamp(index: int) -> Any:
    """The same as a protobuf Timestamp."""
    seconds, nanos = divmod(frame_nanoseconds(index), _SECOND_NANOSECONDS)
    return Timestamp(seconds=seconds, nanos=nanos)


class Recording:
    """Writes messages frame by frame; a topic and its schema are added with the first message of the topic.

    Chunks are compressed (zstd), and chunks, messages and metadata are indexed, so that viewers can seek.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        """Begin a file."""
        self._writer = Writer(stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"deepaccident_devkit {__version__}")
        self._schemas: dict[str, int] = {}
        self._topics: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
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
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        time = frame_nanoseconds(index)
        self._writer.add_message(
            channel_id=self._topics[topic],
            log_time=time,
            publish_time=time,
            sequence=sequence,
            data=message.SerializeToString(deterministic=True),
        )

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
