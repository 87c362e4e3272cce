"""Every table of a release as Parquet files by split, with tokens in place of row numbers (docs/exports.md)."""

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
"""Rows of a group at most: what is in memory at once."""
# Tables that are the same for all splits, and small.
_ONCE: Final = ("sensor", "category")
_ONLY_FILE: Final = "all-00000-of-00001.parquet"
_ORDER: Final = (*SPLIT_NAMES.values(), "all")
_NOTES: Final = """\
The tables refer to each other by tokens. The column `split` is that of the scenario: train, val, test, or null where
it is unknown; the files of val are called validation. Tracks and instances are merged from all agents of the release.
Sensor files are not in here: `sample_data.filename` is their path below the folder of the release.
"""


@dataclass(frozen=True, kw_only=True)
class Parquet(Format):
    """Tables for `datasets`, DuckDB, Polars and pandas: `<table>/<split>-00000-of-0000N.parquet`, and a README.md.

    Columns are the fields of the records (schema/README.md), with a column `split` in addition. Rows are in the order
    of the tables. A shard in which a table has no row has no file of it: `datasets` cannot read an empty one.

    Attributes:
        shard_scenarios: scenarios of a shard.

    Raises:
        ConfigError: `shard_scenarios` is less than 1.
    """

    shard_scenarios: int = 32

    name: ClassVar[str] = "parquet"
    unit_word: ClassVar[str] = "shard"
    channels: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """Check the size of shards too."""
        super().__post_init__()
        if self.shard_scenarios < 1:
            raise ConfigError(
                f"shard_scenarios: expected a number from 1, found {self.shard_scenarios}"
            )

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """A shard each."""
        return [
            Unit(name=f"{split}-{number:05d}-of-{len(groups):05d}", scenarios=group)
            for split, groups in shards(
                dataset, dict.fromkeys(scenarios, 1), self.shard_scenarios
            ).items()
            for number, group in enumerate(groups)
        ]

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a shard of every table."""
        maker, split = RecordTables(dataset), dataset.scenario.get(unit.scenarios[0])["split"]
        rows = maker.rows(unit.scenarios, self.agents)
        for table, found in rows.items():
            if len(found):
                _write(output, f"{table}/{unit.name}.parquet", _pieces(maker, table, found, split))
        output.tally.samples += len(rows["sample"])
        absent = len(unit.scenarios) * len(self.agents) - len(rows["agent"])
        output.leave_out("agents of scenarios that are not in this release", absent)
        output.leave_out(
            "samples of other agents",
            len(maker.rows(unit.scenarios)["sample"]) - len(rows["sample"]),
        )

    def finish(
        self,
        dataset: Dataset,
        units: Sequence[Unit],  # noqa: ARG002
        output: Output,
        parts: Callable[[Unit], Path],  # noqa: ARG002 - units are whole files
    ) -> None:
        """Write the tables that all splits share, and the README.md."""
        maker = RecordTables(dataset)
        for table in _ONCE:
            _write(
                output,
                f"{table}/{_ONLY_FILE}",
                iter([maker.table(table, np.arange(len(dataset.arrow(table))))]),
            )
        rows = {table: _rows_by_split(output.folder / table) for table in dataset.table_names}
        configs = [
            {"config_name": table, "data_files": _data_files(table, found)}
            for table, found in rows.items()
            if found
        ]
        title = f"DeepAccident {dataset.version}: tables"
        output.write(README, readme(self, dataset, title, {"configs": configs}, _body(rows)))


def _pieces(maker: RecordTables, table: str, rows: IntArray, split: str | None) -> Iterator[Any]:
    """The rows of a table, some at a time, with their split."""
    import pyarrow as pa

    for start in range(0, len(rows), ROW_GROUP_SIZE):
        piece = maker.table(table, rows[start : start + ROW_GROUP_SIZE])
        if "split" not in piece.column_names:
            piece = piece.append_column("split", pa.array([split] * len(piece), type=pa.string()))
        yield piece


def _write(output: Output, path: str, pieces: Iterator[Any]) -> None:
    """Write a file, a group of rows for each piece; there must be one."""
    from pyarrow.parquet import ParquetWriter

    first = next(pieces)
    with (
        output.file(path) as temporary,
        ParquetWriter(temporary, first.schema, compression="zstd") as writer,
    ):
        for piece in chain([first], pieces):
            writer.write_table(piece)


def _rows_by_split(folder: Path) -> dict[str, int]:
    """Beginning of the names of a table's files → rows in them."""
    from pyarrow.parquet import read_metadata

    found: dict[str, int] = {}
    for path in sorted(folder.glob("*.parquet")):
        name = path.name.split("-", maxsplit=1)[0]
        found[name] = found.get(name, 0) + read_metadata(path).num_rows
    return {name: found[name] for name in _ORDER if name in found}


def _data_files(table: str, rows: Mapping[str, int]) -> Any:
    """Where `datasets` finds a table. It calls the only part of a table without splits `train`."""
    if table in _ONCE:
        return f"{table}/*.parquet"
    return [{"split": split, "path": f"{table}/{split}-*.parquet"} for split in rows]


def _body(rows: Mapping[str, Mapping[str, int]]) -> str:
    """What each table is, how many rows of it there are, and its columns."""
    lines = [_NOTES]
    for table, spec in table_specs().items():
        counts = (
            ", ".join(f"{count:,} rows in {split}" for split, count in rows[table].items())
            or "no rows"
        )
        lines += [
            f"## {table}",
            "",
            f"{spec.doc} Here: {counts}.",
            "",
            "| column | what |",
            "|---|---|",
        ]
        lines += [f"| `{column.field}` | {_meaning(column.kind)} |" for column in spec.columns]
        lines.append("")
    return "\n".join(lines)


def _meaning(kind: ColumnKind) -> str:
    """A column's documentation, with the unit or the table that its tokens are of."""
    if isinstance(kind, Key):
        return f"→ `{kind.table}`. {kind.doc}"
    unit = kind.unit if isinstance(kind, Number | Vector) else ""
    return f"{kind.doc} [{unit}]" if unit else kind.doc
