"""Make a small release, its export `out/tables`, and `expected.json`, which the clients in
tables.py compare it with.

A scenario is in no split, and the test split has no labels.
"""

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.format import SPLIT_NAMES
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.plugins.synth import SynthConfig, make_release


def main(folder: Path) -> None:
    dataset = make_dataset(folder / "release")
    export_release(dataset, folder / "out" / "tables", Parquet(shard_scenarios=2))
    expected = {
        "tables": describe_tables(dataset),
        "queries": answer_queries(dataset),
    }
    (folder / "expected.json").write_text(json.dumps(expected))


def make_dataset(root: Path) -> DeepAccident:
    make_release(
        root,
        SynthConfig(
            scenarios=8,
            frames=4,
            image_size=(64, 36),
            unlabelled_test=True,
            unplanned=0,
            seed=3,
            designed=True,
        ),
    )
    dataset = DeepAccident("v1", root, verbose=False)
    *_, last = (record for record in dataset.scenario if record["split"] != "test")
    for path in root.glob("*.txt"):
        lines = path.read_text().splitlines(keepends=True)
        dropped = [last["scenario_type"], last["name"]]
        path.write_text("".join(line for line in lines if line.split() != dropped))
    return DeepAccident("v1", root, verbose=False)


def scenario_of(dataset: DeepAccident, record: dict[str, Any]) -> dict[str, Any]:
    token = "/".join(record["token"].split("/")[:2])
    return dataset.scenario.get(token)


def split_of(dataset: DeepAccident, record: dict[str, Any]) -> str:
    return SPLIT_NAMES[scenario_of(dataset, record)["split"]]


def describe_tables(dataset: DeepAccident) -> dict[str, Any]:
    """Return, by table and split, the number of rows and three of the rows by position."""
    tables: dict[str, Any] = {}
    for name in dataset.table_names:
        rows_by_split: dict[str, list[dict[str, Any]]] = {}
        for record in getattr(dataset, name):
            split = "train" if name in ("sensor", "category") else split_of(dataset, record)
            rows_by_split.setdefault(split, []).append(dict(record))
        tables[name] = {}
        for split, rows in rows_by_split.items():
            positions = (0, len(rows) // 2, len(rows) - 1)
            some_rows = {position: to_json(rows[position]) for position in positions}
            tables[name][split] = {"rows": len(rows), "some": some_rows}
    return tables


def answer_queries(dataset: DeepAccident) -> dict[str, Any]:
    """Compute the results that the code in docs/exports.md and the query with pandas must give."""
    num_boxes: Counter[tuple[str, str]] = Counter()
    seen = {agent: set() for agent in ("infrastructure", "ego_vehicle")}
    for record in dataset.annotation:
        num_boxes[scenario_of(dataset, record)["town"], record["category"]] += 1
        sample = dataset.sample.get(record["sample_token"])
        if sample["agent"] in seen and record["instance_token"] and record["num_lidar_pts"] > 0:
            seen[sample["agent"]].add((sample["frame_token"], record["instance_token"]))
    hidden = seen["infrastructure"] - seen["ego_vehicle"]
    impacts = [record["token"] for record in dataset.sample if record["time_to_impact"] == 0]
    return {
        "boxes": [[*key, count] for key, count in sorted(num_boxes.items())],
        "impacts": sorted(impacts),
        "hidden": sorted(map(list, hidden)),
    }


def to_json(value: Any) -> Any:
    """Replace NaN, which JSON lacks, by None."""
    if isinstance(value, dict):
        return {name: to_json(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [to_json(entry) for entry in value]
    return None if isinstance(value, float) and np.isnan(value) else value


if __name__ == "__main__":
    main(Path(sys.argv[1]))
