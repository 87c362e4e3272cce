"""Every table of a release as Parquet files by split, with tokens for row numbers.

docs/exports.md describes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.format import README, SPLIT_NAMES, readme, shards
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.tables.columns import ColumnKind, Key, Number, Vector
from deepaccident_devkit.tables.record_tables import RecordTables
from deepaccident_devkit.tables.records import table_specs

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

ROW_GROUP_SIZE: Final = 50_000
"""Largest number of rows of a group, which are in memory at once."""
# Small tables that are the same for all splits.
_SHARED_TABLES: Final = ("sensor", "category")
_SHARED_FILE: Final = "all-00000-of-00001.parquet"
_FILE_ORDER: Final = (*SPLIT_NAMES.values(), "all")
_NOTES: Final = """\
The tables refer to each other by tokens. The column `split` is that of the scenario: train, val, \
test, or null where
it is unknown; the files of val are called validation. Tracks and instances are merged from all \
agents of the release.
Sensor files are not in here: `sample_data.filename` is their path below the folder of the release.
"""


@dataclass(frozen=True, kw_only=True)
class Parquet(Format):
    """Tables for `datasets`, DuckDB, Polars and pandas: `<table>/<split>-00000-of-0000N.parquet`.

    Columns are the fields of the records (schema/README.md), with a column `split` in addition.
    Rows are in the order of the tables. A shard without any row of a table has no file of it:
    `datasets` cannot read an empty one. A README.md describes the tables.

    Attributes:
        shard_scenarios: Number of scenarios of a shard.

    Raises:
        ConfigError: `shard_scenarios` is less than 1.
    """

    shard_scenarios: int = 32

    name: ClassVar[str] = "parquet"
    unit_word: ClassVar[str] = "shard"
    channels: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """Check the choices and the size of shards."""
        super().__post_init__()
        if self.shard_scenarios < 1:
            raise ConfigError(
                f"shard_scenarios: expected a number from 1, found {self.shard_scenarios}"
            )

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """Return a unit for each shard."""
        units = []
        for split, groups in shards(
            dataset, dict.fromkeys(scenarios, 1), self.shard_scenarios
        ).items():
            for number, group in enumerate(groups):
                name = f"{split}-{number:05d}-of-{len(groups):05d}"
                units.append(Unit(name=name, scenarios=group))
        return units

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a shard of every table."""
        maker, split = RecordTables(dataset), dataset.scenario.get(unit.scenarios[0])["split"]
        rows_by_table = maker.rows(unit.scenarios, self.agents)
        for table, rows in rows_by_table.items():
            if len(rows):
                _write(output, f"{table}/{unit.name}.parquet", _pieces(maker, table, rows, split))
        sample_count = len(rows_by_table["sample"])
        output.tally.samples += sample_count
        absent = len(unit.scenarios) * len(self.agents) - len(rows_by_table["agent"])
        output.leave_out("agents of scenarios that are not in this release", absent)
        all_samples = len(maker.rows(unit.scenarios)["sample"])
        output.leave_out("samples of other agents", all_samples - sample_count)

    def finish(
        self,
        dataset: Dataset,
        units: Sequence[Unit],  # noqa: ARG002
        output: Output,
        parts: Callable[[Unit], Path],  # noqa: ARG002 - units are complete files
    ) -> None:
        """Write the tables that all splits share, and the README.md."""
        maker = RecordTables(dataset)
        for table in _SHARED_TABLES:
            rows = np.arange(len(dataset.arrow(table)))
            _write(output, f"{table}/{_SHARED_FILE}", iter([maker.table(table, rows)]))
        counts_by_table = {
            table: _rows_by_split(output.folder / table) for table in dataset.table_names
        }
        configs = []
        for table, counts in counts_by_table.items():
            if counts:
                configs.append({"config_name": table, "data_files": _data_files(table, counts)})
        title = f"DeepAccident {dataset.version}: tables"
        text = readme(self, dataset, title, {"configs": configs}, _body(counts_by_table))
        output.write(README, text)


def _pieces(maker: RecordTables, table: str, rows: IntArray, split: str | None) -> Iterator[Any]:
    """Yield the rows of a table, a group at a time, with their split."""
    import pyarrow as pa

    for start in range(0, len(rows), ROW_GROUP_SIZE):
        piece = maker.table(table, rows[start : start + ROW_GROUP_SIZE])
        if "split" not in piece.column_names:
            piece = piece.append_column("split", pa.array([split] * len(piece), type=pa.string()))
        yield piece


def _write(output: Output, path: str, pieces: Iterator[Any]) -> None:
    """Write a file, a group of rows for each piece; there must be at least one."""
    from pyarrow.parquet import ParquetWriter

    first_piece = next(pieces)
    with (
        output.file(path) as temporary,
        ParquetWriter(temporary, first_piece.schema, compression="zstd") as writer,
    ):
        for piece in chain([first_piece], pieces):
            writer.write_table(piece)


def _rows_by_split(folder: Path) -> dict[str, int]:
    """Return split, at the beginning of the names of a table's files → rows in the files."""
    from pyarrow.parquet import read_metadata

    counts: dict[str, int] = {}
    for path in sorted(folder.glob("*.parquet")):
        split = path.name.split("-", maxsplit=1)[0]
        counts[split] = counts.get(split, 0) + read_metadata(path).num_rows
    return {split: counts[split] for split in _FILE_ORDER if split in counts}


def _data_files(table: str, rows: Mapping[str, int]) -> Any:
    """Return where `datasets` finds a table.

    It calls the only part of a table without splits `train`.
    """
    if table in _SHARED_TABLES:
        return f"{table}/*.parquet"
    return [{"split": split, "path": f"{table}/{split}-*.parquet"} for split in rows]


def _body(counts_by_table: Mapping[str, Mapping[str, int]]) -> str:
    """Return the description of each table, with its number of rows and its columns."""
    lines = [_NOTES]
    for table, spec in table_specs().items():
        counts = counts_by_table[table]
        parts = [f"{count:,} rows in {split}" for split, count in counts.items()]
        lines += [
            f"## {table}",
            "",
            f"{spec.doc} Here: {', '.join(parts) or 'no rows'}.",
            "",
            "| column | what |",
            "|---|---|",
        ]
        lines += [f"| `{column.field}` | {_meaning(column.kind)} |" for column in spec.columns]
        lines.append("")
    return "\n".join(lines)


def _meaning(kind: ColumnKind) -> str:
    """Return a column's documentation, with its unit or the table that its tokens refer to."""
    if isinstance(kind, Key):
        return f"→ `{kind.table}`. {kind.doc}"
    unit = kind.unit if isinstance(kind, Number | Vector) else ""
    if unit:
        return f"{kind.doc} [{unit}]"
    return kind.doc
