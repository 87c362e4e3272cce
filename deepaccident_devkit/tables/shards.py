"""A scenario's rows on disk, between reading its files and joining all scenarios; kept for resuming and refreshing."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deepaccident_devkit.files import replacing
from deepaccident_devkit.tables.arrow import Columns, arrow_schema, record_batch, unpacked, views
from deepaccident_devkit.tables.columns import TableSpec
from deepaccident_devkit.tables.specs import table_specs

SHARED_TABLES = ("sensor", "category")
"""Tables that are the same for every scenario and stand in no shard."""
_DIGEST = b"digest"


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
    with replacing(path) as temporary, pa.OSFile(str(temporary), "wb") as sink:
        for spec in shard_specs():
            schema = arrow_schema(spec).with_metadata({_DIGEST: digest})
            with pa.ipc.new_stream(sink, schema, options=options) as writer:
                writer.write_batch(record_batch(spec, tables[spec.name]))


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
    """The digest a shard was written with, None if there is no readable shard."""
    import pyarrow as pa

    try:
        with pa.OSFile(str(path), "rb") as source:
            metadata: Mapping[bytes, bytes] = pa.ipc.open_stream(source).schema.metadata or {}
    except (OSError, pa.ArrowInvalid):
        return None
    return metadata.get(_DIGEST, b"").decode()
