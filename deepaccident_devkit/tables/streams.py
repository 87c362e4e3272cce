"""Rows of some tables in one file: compressed Arrow streams, one after the other, and a checksum of all of it."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.tables.arrow import Columns, arrow_schema, fault_of, record_batch, unpacked, views
from deepaccident_devkit.tables.columns import TableSpec

_CHECKSUM_SIZE = 16


def write_streams(path: Path, tables: Sequence[tuple[TableSpec, Columns]], metadata: Mapping[str, str]) -> None:
    """Write the rows of each table, with words on what they were made from; the file is whole or not there."""
    content = streams(tables, metadata)
    write_bytes(path, content + _checksum(content))


def streams(tables: Sequence[tuple[TableSpec, Columns]], metadata: Mapping[str, str] | None = None) -> bytes:
    """The rows of each table, with or without words, as compressed Arrow streams one after the other."""
    import pyarrow as pa

    options = pa.ipc.IpcWriteOptions(compression="zstd")
    sink = pa.BufferOutputStream()
    for spec, columns in tables:
        with pa.ipc.new_stream(sink, arrow_schema(spec).with_metadata(dict(metadata or {})), options=options) as writer:
            writer.write_batch(record_batch(spec, columns))
    content: bytes = sink.getvalue().to_pybytes()
    return content


def whole_streams(path: Path) -> bytes | None:
    """The content of a file that `write_streams` wrote; None if there is none, or its checksum is wrong."""
    try:
        content = read_bytes(path, "index")
    except OSError:
        return None
    return content if content[-_CHECKSUM_SIZE:] == _checksum(content[:-_CHECKSUM_SIZE]) else None


def streams_metadata(content: bytes) -> dict[str, str]:
    """The words of `write_streams`; raises ValueError or an error of Arrow if the content is something else."""
    import pyarrow as pa

    metadata = pa.ipc.open_stream(content).schema.metadata or {}
    return {name.decode(): value.decode() for name, value in metadata.items()}


def read_streams(source: Any, specs: Sequence[TableSpec]) -> list[dict[str, Any]] | None:
    """Of each table stored column → its values, as `write_streams` took them; None if they are not of these tables.

    Args:
        source: an Arrow file or bytes in an Arrow reader, at the first stream.
        specs: the tables, in their order.
    """
    import pyarrow as pa

    tables = []
    for spec in specs:
        batches = list(pa.ipc.open_stream(source))  # to the stream's end, where the next one starts
        if len(batches) != 1 or fault_of(spec, batches[0]):
            return None
        tables.append({name: unpacked(view) for name, view in views(spec, batches[0]).items()})
    return tables


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_CHECKSUM_SIZE).digest()
