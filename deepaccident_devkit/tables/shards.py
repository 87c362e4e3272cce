"""A scenario's rows on disk, between reading its files and joining all scenarios; kept for resuming and refreshing.

A shard is a compressed Arrow stream a table, one after the other, and at its end a checksum of all of it.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.tables.arrow import Columns, arrow_schema, record_batch, unpacked, views
from deepaccident_devkit.tables.columns import TableSpec
from deepaccident_devkit.tables.specs import table_specs

SHARED_TABLES = ("sensor", "category")
"""Tables that are the same for every scenario and stand in no shard."""
_DIGEST = b"digest"
_CHECKSUM_SIZE = 16


def shard_path(folder: Path, scenario_token: str) -> Path:
    """Where a scenario's shard lies."""
    return folder / f"{scenario_token}.arrow"


def shard_specs() -> list[TableSpec]:
    """The tables of a shard, in its order."""
    return [spec for name, spec in table_specs().items() if name not in SHARED_TABLES]


def write_shard(path: Path, tables: Mapping[str, Columns], digest: str) -> None:
    """Write the rows of every table as compressed Arrow streams, one after the other."""
    import pyarrow as pa

    options = pa.ipc.IpcWriteOptions(compression="zstd")
    sink = pa.BufferOutputStream()
    for spec in shard_specs():
        schema = arrow_schema(spec).with_metadata({_DIGEST: digest})
        with pa.ipc.new_stream(sink, schema, options=options) as writer:
            writer.write_batch(record_batch(spec, tables[spec.name]))
    content = sink.getvalue().to_pybytes()
    write_bytes(path, content + _checksum(content))


def read_shard(path: Path) -> dict[str, dict[str, Any]]:
    """Table → stored column → its values, as `write_shard` took them."""
    import pyarrow as pa

    tables = {}
    with pa.OSFile(str(path), "rb") as source:
        for spec in shard_specs():
            (batch,) = list(pa.ipc.open_stream(source))  # to the stream's end, where the next one starts
            tables[spec.name] = {name: unpacked(view) for name, view in views(spec, batch).items()}
    return tables


def shard_digest(path: Path) -> str | None:
    """The digest a shard was written with, None if there is no whole shard."""
    import pyarrow as pa

    try:
        content = path.read_bytes()
    except OSError:
        return None
    if content[-_CHECKSUM_SIZE:] != _checksum(content[:-_CHECKSUM_SIZE]):
        return None
    metadata: Mapping[bytes, bytes] = pa.ipc.open_stream(content).schema.metadata
    return metadata[_DIGEST].decode()


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_CHECKSUM_SIZE).digest()
