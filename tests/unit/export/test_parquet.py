"""The tables as Parquet files: their rows are the records, whatever the shards."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.format import SPLIT_NAMES
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.tables.tables import table_names

RECORDED = ("agent", "sample", "sample_data", "calibrated_sensor", "ego_pose", "annotation")
"""Tables of what agents recorded."""


def rows_of(folder: Path, table: str, split: str = "*") -> list[dict[str, Any]]:
    """The rows of a table, in the order of its files."""
    return [
        row
        for path in sorted((folder / table).glob(f"{split}-*.parquet"))
        for row in pq.read_table(path).to_pylist()
    ]


def told(dataset: DeepAccident, table: str) -> dict[str, list[str]]:
    """Name of a split → the table's records as text, in which NaN equals NaN, with the column that
    is added.
    """
    splits = {record["token"]: record["split"] for record in dataset.scenario}
    found: dict[str, list[str]] = {name: [] for name in SPLIT_NAMES.values()}
    for record in getattr(dataset, table):
        split = splits["/".join(record["token"].split("/")[:2])]
        found[SPLIT_NAMES[split]].append(repr({**record, "split": split}))
    return found


def export(dataset: DeepAccident, folder: Path, form: Parquet = Parquet()) -> Exported:  # noqa: B008 - frozen
    return export_release(dataset, folder, form, workers=1)


def assert_all_rows(dataset: DeepAccident, folder: Path) -> None:
    """Every table has all records, in order."""
    for table in table_names():
        if table in ("sensor", "category"):
            assert rows_of(folder, table) == [dict(record) for record in getattr(dataset, table)]
            continue
        expected = told(dataset, table)
        assert {
            split: list(map(repr, rows_of(folder, table, split))) for split in expected
        } == expected


@pytest.mark.slow
@pytest.mark.parametrize("shard_scenarios", [1, 2, 32])
def test_rows_are_the_records_in_shards_of_any_size(
    both_layouts: DeepAccident, tmp_path: Path, shard_scenarios: int
) -> None:
    made = export(both_layouts, tmp_path / "out", Parquet(shard_scenarios=shard_scenarios))
    assert_all_rows(both_layouts, made.folder)
    for split, rows in told(both_layouts, "scenario").items():
        assert len(list((made.folder / "scenario").glob(f"{split}-*"))) == -(
            -len(rows) // shard_scenarios
        )
    assert made.tally.samples == len(both_layouts.sample)


def test_columns_are_plain(da: DeepAccident, tmp_path: Path) -> None:
    folder = export(da, tmp_path / "out").folder
    for table in table_names():
        for field in pq.read_schema(next((folder / table).iterdir())):
            assert not pa.types.is_dictionary(field.type), (table, field)
            assert not field.name.endswith("_row"), (table, field)


def test_only_what_the_agents_recorded(da: DeepAccident, tmp_path: Path) -> None:
    chosen = ("ego_vehicle", "infrastructure")
    made = export(da, tmp_path / "out", Parquet(agents=chosen))
    assert made.tally.left_out == {"samples of other agents": len(da.sample) * 3 // 5}
    for table in set(table_names()) - {"sensor", "category"}:
        wanted = {record["token"] for record in getattr(da, table)}
        if table in RECORDED:
            wanted = {token for token in wanted if token.split("/")[2] in chosen}
        assert {row["token"] for row in rows_of(made.folder, table)} == wanted


def test_a_partial_release_has_the_rows_that_are_there(
    da_partial: DeepAccident, tmp_path: Path
) -> None:
    made = export(da_partial, tmp_path / "out")
    assert_all_rows(da_partial, made.folder)
    assert made.tally.left_out["agents of scenarios that are not in this release"] == len(
        da_partial.scenario
    )


def test_a_table_without_rows_has_no_file(unlabelled: DeepAccident, tmp_path: Path) -> None:
    folder = export(unlabelled, tmp_path / "out").folder
    assert not any((folder / table).exists() for table in ("annotation", "instance", "track"))
    assert_all_rows(unlabelled, folder)
    _, head, body = (folder / "README.md").read_text().split("---\n", maxsplit=2)
    named = {config["config_name"] for config in yaml.safe_load(head)["configs"]}
    assert (named, "Here: no rows." in body) == (
        set(table_names()) - {"annotation", "instance", "track"},
        True,
    )


def test_on_the_command_line(da: DeepAccident, tmp_path: Path) -> None:
    words = [
        "export",
        "parquet",
        str(da.dataroot),
        "--out",
        str(tmp_path / "out"),
        "--split",
        "train",
    ]
    CliRunner().invoke(deepaccident, [*words, "--workers", "1"], catch_exceptions=False)
    assert (
        list(map(repr, rows_of(tmp_path / "out", "annotation"))) == told(da, "annotation")["train"]
    )
