"""All tables of a release as Parquet files by split, with tokens instead of row numbers.

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
from deepaccident_devkit.export.format import README, SPLIT_NAMES, divide_into_shards, format_readme
from deepaccident_devkit.support.arrays import IntArray
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.tables.columns import ColumnKind, Key, Number, Vector
from deepaccident_devkit.tables.record_tables import RecordTables
from deepaccident_devkit.tables.records import table_specs

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

ROW_GROUP_SIZE: Final = 50_000
"""Largest number of rows in a group, which are in memory at once."""
# Small tables that are the same for all splits.
_SHARED_TABLES = ("sensor", "category")
_SHARED_FILE = "all-00000-of-00001.parquet"
_FILE_ORDER = (*SPLIT_NAMES.values(), "all")
_NOTES = """\
The tables refer to each other by tokens. The column `split` is the split of the scenario: train, \
val, test, or null if
unknown; the files of val are called validation. Tracks and instances are merged from all \
agents of the release.
Sensor files are not included; `sample_data.filename` is the path below the folder of the release.
"""


@dataclass(frozen=True, kw_only=True)
class Parquet(Format):
    """Tables for `datasets`, DuckDB, Polars and pandas: `<table>/<split>-00000-of-0000N.parquet`.

    Columns are the fields of the records (schema/README.md), with a column `split` in addition.
    Rows are in the order of the tables. A shard has no file for a table without rows, since
    `datasets` cannot read an empty one. A README.md describes the tables.

    Attributes:
        shard_scenarios: Number of scenarios in a shard.

    Raises:
        ConfigError: If `shard_scenarios` is less than 1.
    """

    shard_scenarios: int = 32

    name: ClassVar[str] = "parquet"
    unit_word: ClassVar[str] = "shard"
    channels: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """Check the settings; raise ConfigError if `shard_scenarios` is less than 1."""
        super().__post_init__()
        if self.shard_scenarios < 1:
            raise ConfigError(
                f"shard_scenarios: expected a number from 1, found {self.shard_scenarios}"
            )

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """Return a unit for each shard."""
        units = []
        sizes = dict.fromkeys(scenarios, 1)
        shards = divide_into_shards(dataset, sizes, self.shard_scenarios)
        for split, split_shards in shards.items():
            for number, shard in enumerate(split_shards):
                name = f"{split}-{number:05d}-of-{len(split_shards):05d}"
                units.append(Unit(name=name, scenarios=shard))
        return units

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a shard of every table."""
        maker = RecordTables(dataset)
        split = dataset.scenario.get(unit.scenarios[0])["split"]
        rows_by_table = maker.rows(unit.scenarios, self.agents)
        for table, rows in rows_by_table.items():
            if len(rows):
                _write_file(
                    output,
                    f"{table}/{unit.name}.parquet",
                    _read_row_groups(maker, table, rows, split),
                )
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
        """Write the tables that all splits share, and README.md."""
        maker = RecordTables(dataset)
        for table in _SHARED_TABLES:
            rows = np.arange(len(dataset.arrow(table)))
            _write_file(output, f"{table}/{_SHARED_FILE}", iter([maker.table(table, rows)]))
        counts_by_table = {
            table: _count_rows(output.folder / table) for table in dataset.table_names
        }
        configs = []
        for table, counts in counts_by_table.items():
            files: Any = [
                {"split": split, "path": f"{table}/{split}-*.parquet"} for split in counts
            ]
            if table in _SHARED_TABLES:  # `datasets` calls their only part `train`.
                files = f"{table}/*.parquet"
            if counts:
                configs.append({"config_name": table, "data_files": files})
        title = f"DeepAccident {dataset.version}: tables"
        text = format_readme(
            self, dataset, title, {"configs": configs}, _describe_tables(counts_by_table)
        )
        output.write(README, text)


def _read_row_groups(
    maker: RecordTables, table: str, rows: IntArray, split: str | None
) -> Iterator[Any]:
    """Yield the rows of a table with their split, one group at a time."""
    import pyarrow as pa

    for start in range(0, len(rows), ROW_GROUP_SIZE):
        piece = maker.table(table, rows[start : start + ROW_GROUP_SIZE])
        if "split" not in piece.column_names:
            piece = piece.append_column("split", pa.array([split] * len(piece), type=pa.string()))
        yield piece


def _write_file(output: Output, path: str, pieces: Iterator[Any]) -> None:
    """Write a file with a group of rows for each piece; there must be at least one piece."""
    from pyarrow.parquet import ParquetWriter

    first_piece = next(pieces)
    with (
        output.file(path) as temporary,
        ParquetWriter(temporary, first_piece.schema, compression="zstd") as writer,
    ):
        for piece in chain([first_piece], pieces):
            writer.write_table(piece)


def _count_rows(folder: Path) -> dict[str, int]:
    """Count the rows in the files of a table.

    Returns:
        Number of rows by split; the split is the beginning of the files' names.
    """
    from pyarrow.parquet import read_metadata

    counts: dict[str, int] = {}
    for path in sorted(folder.glob("*.parquet")):
        split = path.name.split("-", maxsplit=1)[0]
        counts[split] = counts.get(split, 0) + read_metadata(path).num_rows
    return {split: counts[split] for split in _FILE_ORDER if split in counts}


def _describe_tables(counts_by_table: Mapping[str, Mapping[str, int]]) -> str:
    """Describe each table, with its number of rows and its columns."""
    lines = [_NOTES]
    for table, spec in table_specs().items():
        counts = counts_by_table[table]
        row_counts = [f"{counted(count, 'row')} in {split}" for split, count in counts.items()]
        lines += [
            f"## {table}",
            "",
            f"{spec.doc} Here: {', '.join(row_counts) or 'no rows'}.",
            "",
            "| column | what |",
            "|---|---|",
        ]
        lines += [
            f"| `{column.field}` | {_describe_column(column.kind)} |" for column in spec.columns
        ]
        lines.append("")
    return "\n".join(lines)


def _describe_column(kind: ColumnKind) -> str:
    """Describe a column, with its unit or the table that its tokens refer to."""
    if isinstance(kind, Key):
        return f"→ `{kind.table}`. {kind.doc}"
    unit = kind.unit if isinstance(kind, Number | Vector) else ""
    if unit:
        return f"{kind.doc} [{unit}]"
    return kind.doc
