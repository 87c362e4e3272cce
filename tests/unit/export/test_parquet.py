"""The rows of Parquet files are the records of the tables, in shards of any size."""

import math
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from support.command_calls import invoke_command

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.format import SPLIT_NAMES
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.tables.tables import table_names

RECORDING_TABLES = ("agent", "sample", "sample_data", "calibrated_sensor", "ego_pose", "annotation")
"""Tables whose rows belong to one agent's recording."""


def read_rows(folder: Path, table: str, split: str = "*") -> list[dict[str, Any]]:
    """Read the rows of a table in the order of its files."""
    rows = []
    for path in sorted((folder / table).glob(f"{split}-*.parquet")):
        rows += pq.read_table(path).to_pylist()
    return rows


def expected_rows(dataset: DeepAccident, table: str) -> dict[str, list[str]]:
    """List a table's records with the added column `split`, by split, as text in which NaN equals
    NaN.
    """
    splits = {record["token"]: record["split"] for record in dataset.scenario}
    rows: dict[str, list[str]] = {name: [] for name in SPLIT_NAMES.values()}
    for record in getattr(dataset, table):
        split = splits["/".join(record["token"].split("/")[:2])]
        rows[SPLIT_NAMES[split]].append(repr({**record, "split": split}))
    return rows


def export(dataset: DeepAccident, folder: Path, form: Parquet = Parquet()) -> Exported:  # noqa: B008 - frozen
    return export_release(dataset, folder, form, workers=1)


def assert_all_rows(dataset: DeepAccident, folder: Path) -> None:
    """Assert that every table has all records in order."""
    for table in table_names():
        if table in ("sensor", "category"):
            assert read_rows(folder, table) == [dict(record) for record in getattr(dataset, table)]
            continue
        for split, expected in expected_rows(dataset, table).items():
            assert list(map(repr, read_rows(folder, table, split))) == expected


@pytest.mark.slow
@pytest.mark.parametrize("shard_scenarios", [1, 2, 32])
def test_rows_are_the_records_in_shards_of_any_size(
    both_layouts: DeepAccident, tmp_path: Path, shard_scenarios: int
) -> None:
    done = export(
        both_layouts,
        tmp_path / "out",
        Parquet(shard_scenarios=shard_scenarios),
    )
    assert_all_rows(both_layouts, done.folder)
    for split, rows in expected_rows(both_layouts, "scenario").items():
        shards = list((done.folder / "scenario").glob(f"{split}-*"))
        assert len(shards) == math.ceil(len(rows) / shard_scenarios)
    assert done.tally.samples == len(both_layouts.sample)


def test_columns_are_plain(da: DeepAccident, tmp_path: Path) -> None:
    folder = export(da, tmp_path / "out").folder
    for table in table_names():
        for field in pq.read_schema(next((folder / table).iterdir())):
            assert not pa.types.is_dictionary(field.type), (table, field)
            assert not field.name.endswith("_row"), (table, field)


def test_only_rows_of_the_chosen_agents_are_written(da: DeepAccident, tmp_path: Path) -> None:
    agents = ("ego_vehicle", "infrastructure")
    done = export(
        da,
        tmp_path / "out",
        Parquet(agents=agents),
    )
    assert done.tally.left_out == {"samples of other agents": len(da.sample) * 3 // 5}

    for table in set(table_names()) - {"sensor", "category"}:
        tokens = {record["token"] for record in getattr(da, table)}
        if table in RECORDING_TABLES:
            tokens = {token for token in tokens if token.split("/")[2] in agents}
        assert {row["token"] for row in read_rows(done.folder, table)} == tokens


def test_a_partial_release_has_the_rows_that_are_there(
    da_partial: DeepAccident, tmp_path: Path
) -> None:
    done = export(da_partial, tmp_path / "out")
    assert_all_rows(da_partial, done.folder)
    num_missing = done.tally.left_out["agents of scenarios that are not in this release"]
    assert num_missing == len(da_partial.scenario)


def test_a_table_without_rows_has_no_file(unlabelled_dataset: DeepAccident, tmp_path: Path) -> None:
    empty_tables = {"annotation", "instance", "track"}
    folder = export(unlabelled_dataset, tmp_path / "out").folder
    assert not any((folder / table).exists() for table in empty_tables)
    assert_all_rows(unlabelled_dataset, folder)

    _, head, body = (folder / "README.md").read_text().split("---\n", maxsplit=2)
    configs = {config["config_name"] for config in yaml.safe_load(head)["configs"]}
    assert configs == set(table_names()) - empty_tables
    assert "Here: no rows." in body


def test_the_command_exports_a_split(da: DeepAccident, tmp_path: Path) -> None:
    invoke_command(
        *("export", "parquet", da.dataroot, "--out", tmp_path / "out"),
        *("--split", "train", "--workers", 1),
    )
    rows = list(map(repr, read_rows(tmp_path / "out", "annotation")))
    assert rows == expected_rows(da, "annotation")["train"]
