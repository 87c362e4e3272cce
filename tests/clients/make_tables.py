"""A small release, its exports `out/tables` and `out/shards`, and what the clients in tables.py
must find there.

The first scenario lacks the images of the ego's front camera, another one its split, and the test
split all labels.
"""

import hashlib
import json
import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.format import SPLIT_NAMES
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.webdataset import WebDataset
from deepaccident_devkit.plugins.synth import SynthConfig, make_release


def main(folder: Path) -> None:
    dataset = release(folder / "release")
    export_release(dataset, folder / "out" / "tables", Parquet(shard_scenarios=2))
    export_release(dataset, folder / "out" / "shards", WebDataset(shard_size=20_000_000))
    expected = {"tables": tables(dataset), "queries": queries(dataset), "shards": shards(dataset)}
    (folder / "expected.json").write_text(json.dumps(expected))


def release(root: Path) -> DeepAccident:
    config = SynthConfig(
        scenarios=8,
        frames=4,
        image_size=(64, 36),
        unlabelled_test=True,
        unplanned=0,
        seed=3,
        designed=True,
    )
    make_release(root, config)
    dataset = DeepAccident("v1", root, verbose=False)
    first, *_, last = (record for record in dataset.scenario if record["split"] != "test")
    shutil.rmtree(
        dataset.get_sample_data_path(f"{first['token']}/ego_vehicle/001/Camera_Front").parent
    )
    for path in root.glob("*.txt"):
        path.write_text(
            "".join(
                line
                for line in path.open()
                if line.split() != [last["scenario_type"], last["name"]]
            )
        )
    return DeepAccident("v1", root, verbose=False)


def split_of(dataset: DeepAccident, record: dict[str, Any]) -> str:
    scenario = "/".join(record["token"].split("/")[:2])
    return SPLIT_NAMES[dataset.scenario.get(scenario)["split"]]


def tables(dataset: DeepAccident) -> dict[str, Any]:
    """Table → split → how many rows there are, and three of them by position."""
    found: dict[str, Any] = {}
    for name in dataset.table_names:
        by_split: dict[str, list[dict[str, Any]]] = {}
        for record in getattr(dataset, name):
            split = "train" if name in ("sensor", "category") else split_of(dataset, record)
            by_split.setdefault(split, []).append(dict(record))
        found[name] = {
            split: {
                "rows": len(rows),
                "some": {at: plain(rows[at]) for at in (0, len(rows) // 2, len(rows) - 1)},
            }
            for split, rows in by_split.items()
        }
    return found


def queries(dataset: DeepAccident) -> dict[str, Any]:
    """What the code in docs/exports.md must find."""
    boxes: Counter[tuple[str, str]] = Counter()
    for record in dataset.annotation:
        boxes[
            dataset.scenario.get("/".join(record["token"].split("/")[:2]))["town"],
            record["category"],
        ] += 1
    impacts = [record["token"] for record in dataset.sample if record["time_to_impact"] == 0]
    seen = {agent: set() for agent in ("infrastructure", "ego_vehicle")}
    for record in dataset.annotation:
        sample = dataset.sample.get(record["sample_token"])
        if sample["agent"] in seen and record["instance_token"] and record["num_lidar_pts"] > 0:
            seen[sample["agent"]].add((sample["frame_token"], record["instance_token"]))
    hidden = seen["infrastructure"] - seen["ego_vehicle"]
    return {
        "boxes": [[*key, count] for key, count in sorted(boxes.items())],
        "impacts": sorted(impacts),
        "hidden": sorted(map(list, hidden)),
    }


def shards(dataset: DeepAccident) -> dict[str, Any]:
    """Split → key of each sample → what its files hold; an image that is not there is null."""
    found: dict[str, Any] = {}
    for record in dataset.sample:
        points = dataset.load_point_cloud(record, "lidar").points.astype(np.float32)
        front, back = (
            dataset.get_sample_data_path(record, f"Camera_{side}") for side in ("Front", "BackLeft")
        )
        found.setdefault(split_of(dataset, record), {})[record["token"]] = {
            "front": digest(front.read_bytes()) if front.exists() else None,
            "back": digest(back.read_bytes()),
            "points": digest(points.tobytes()),
            "count": len(points),
            "world_from_lidar": dataset.world_from(record, "lidar").matrix.tolist(),
            "centers": dataset.boxes(record).center.tolist(),
            "velocities": plain(dataset.boxes(record, "lidar").velocity.tolist()),
            "intrinsic": dataset.camera(record, "Camera_BackLeft").intrinsic.tolist(),
            "time_to_impact": record["time_to_impact"],
        }
    return found


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def plain(value: Any) -> Any:
    """As JSON, which has no NaN."""
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, list):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and np.isnan(value) else value


if __name__ == "__main__":
    main(Path(sys.argv[1]))
