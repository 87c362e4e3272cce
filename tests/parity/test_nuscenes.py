"""The nuScenes export against tables that nuscenes-devkit 1.2.0 opens, renders and evaluates
(golden/exports/nuscenes).

Tokens are arbitrary, so rows are compared by scene, channel and time since the scene's first
sample. Two things differ on purpose. Each golden scene has an hour of its own, whereas five of ours
share one, so the absolute times in the file names differ. And golden logs have a date but no file,
ours name the scenario and have no date.
"""

import itertools
import json
import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyquaternion import Quaternion
from support.nuscenes_reader import Tables, find_faults, read_tables, sample_channel

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes


@pytest.fixture(scope="module")
def golden(request: pytest.FixtureRequest) -> Path:
    folder: Path = request.config.getoption("--golden") / "exports"
    assert (folder / "nuscenes" / "sample.json").is_file(), f"{folder}: no golden tables"
    return folder


@pytest.fixture(scope="module")
def expected(golden: Path) -> Tables:
    return read_tables(golden / "nuscenes")


@pytest.fixture(scope="module")
def folder(golden: Path, expected: Tables, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export the golden release, in which most sensor files are missing."""
    root = tmp_path_factory.mktemp("golden")
    shutil.copytree(golden / "release", root / "release")
    dataset = DeepAccident("v1", root / "release", index_dir=root / "index", verbose=False)
    agents = tuple(dict.fromkeys(row["vehicle"] for row in expected["log"].values()))
    export = export_release(dataset, root / "out", NuScenes(agents=agents), workers=1)
    return export.folder / "v1.0-deepaccident"


@pytest.fixture(scope="module")
def exported(folder: Path) -> Tables:
    return read_tables(folder)


class Scenes:
    """Rows of tables by keys that do not depend on tokens.

    A moment is a scene's name and the microseconds since its first sample.
    """

    def __init__(self, tables: Tables) -> None:
        self.tables = tables
        self.start = {}
        for row in tables["scene"].values():
            self.start[row["name"]] = tables["sample"][row["first_sample_token"]]["timestamp"]
        self.moments = {}
        for token, row in tables["sample"].items():
            scene = tables["scene"][row["scene_token"]]["name"]
            self.moments[token] = (scene, row["timestamp"] - self.start[scene])

    def sensor_files(self) -> dict[tuple[str, int, str], dict[str, Any]]:
        """Return the facts about each file by scene, microseconds and channel."""
        keys: dict[str, Any] = {"": None}
        for token, row in self.tables["sample_data"].items():
            scene, _ = self.moments[row["sample_token"]]
            microseconds = row["timestamp"] - self.start[scene]
            keys[token] = (scene, microseconds, sample_channel(self.tables, row))

        files = {}
        for token, row in self.tables["sample_data"].items():
            pose = self.tables["ego_pose"][row["ego_pose_token"]]
            calibrated = self.tables["calibrated_sensor"][row["calibrated_sensor_token"]]
            folder, _, ending = row["filename"].partition("__")
            files[keys[token]] = {
                "sample": self.moments[row["sample_token"]],
                "chain": (keys[row["prev"]], keys[row["next"]]),
                "file": (folder, ending.split("__")[0], ending.partition(".")[2]),
                **{name: row[name] for name in ("fileformat", "is_key_frame", "height", "width")},
                "pose": make_matrix(pose),
                "pose time": pose["timestamp"] - row["timestamp"],
                "sensor": make_matrix(calibrated),
                "K": np.array(calibrated["camera_intrinsic"]),
            }
        return files

    def boxes(self) -> dict[tuple[Any, ...], dict[str, Any]]:
        """Return the facts about each box by scene, microseconds and position in centimetres."""
        tables = self.tables
        keys: dict[str, Any] = {"": None}
        for token, row in tables["sample_annotation"].items():
            moment = self.moments[row["sample_token"]]
            keys[token] = (*moment, *np.round(row["translation"], 2).tolist())

        boxes = {}
        for token, row in tables["sample_annotation"].items():
            instance = tables["instance"][row["instance_token"]]
            attributes = [tables["attribute"][attribute] for attribute in row["attribute_tokens"]]
            boxes[keys[token]] = {
                "chain": (keys[row["prev"]], keys[row["next"]]),
                "track": (
                    instance["nbr_annotations"],
                    keys[instance["first_annotation_token"]],
                    keys[instance["last_annotation_token"]],
                ),
                "category": tables["category"][instance["category_token"]]["name"],
                "attributes": [attribute["name"] for attribute in attributes],
                "visibility": tables["visibility"][row["visibility_token"]]["level"],
                "points": (row["num_lidar_pts"], row["num_radar_pts"]),
                "pose": make_matrix(row),
                "size": np.array(row["size"]),
            }
        return boxes

    def scenes(self) -> dict[str, dict[str, Any]]:
        """Return the facts about each scene by its name."""
        chains = defaultdict(dict)
        for token, row in self.tables["sample"].items():
            moment = self.moments[token]
            neighbours = (self.moments.get(row["prev"]), self.moments.get(row["next"]))
            chains[moment[0]][moment] = neighbours

        scenes = {}
        for row in self.tables["scene"].values():
            log = self.tables["log"][row["log_token"]]
            scenes[row["name"]] = {
                "samples": row["nbr_samples"],
                "first": self.moments[row["first_sample_token"]],
                "last": self.moments[row["last_sample_token"]],
                "log": (log["vehicle"], log["location"]),
                "chains": chains[row["name"]],
            }
        return scenes


def make_matrix(row: dict[str, Any]) -> np.ndarray:
    return np.column_stack([Quaternion(row["rotation"]).rotation_matrix, row["translation"]])


def assert_same(rows: dict[Any, dict[str, Any]], expected: dict[Any, dict[str, Any]]) -> None:
    assert expected
    assert rows.keys() == expected.keys()
    for key, facts in expected.items():
        for name, expected_value in facts.items():
            value = rows[key][name]
            if isinstance(expected_value, np.ndarray):
                np.testing.assert_allclose(
                    value, expected_value, rtol=0, atol=1e-6, err_msg=f"{key} {name}"
                )
            else:
                assert value == expected_value, (key, name)


def test_sensor_files(exported: Tables, expected: Tables) -> None:
    assert_same(Scenes(exported).sensor_files(), Scenes(expected).sensor_files())


def test_boxes(exported: Tables, expected: Tables) -> None:
    assert_same(Scenes(exported).boxes(), Scenes(expected).boxes())


def test_scenes(exported: Tables, expected: Tables) -> None:
    assert_same(Scenes(exported).scenes(), Scenes(expected).scenes())


@pytest.mark.parametrize("name", ["sensor", "category", "attribute", "visibility"])
def test_tables_of_names(exported: Tables, expected: Tables, name: str) -> None:
    assert rows_without_tokens(exported[name]) == rows_without_tokens(expected[name])


def rows_without_tokens(table: dict[str, dict[str, Any]]) -> list[list[tuple[str, Any]]]:
    return sorted(
        [(key, value) for key, value in row.items() if key != "token"] for row in table.values()
    )


def test_neither_has_faults(exported: Tables, expected: Tables) -> None:
    assert list(find_faults(exported)) == []
    assert list(find_faults(expected)) == []


def test_scenes_are_in_the_golden_split(golden: Path, folder: Path, expected: Tables) -> None:
    """Compare only scenes with tables: the golden release may be a part of the split release."""
    our_splits = json.loads((folder / "splits.json").read_text())
    golden_splits = json.loads((golden / "nuscenes" / "splits.json").read_text())
    scenes = {row["name"] for row in expected["scene"].values()}

    for split, names in our_splits.items():
        golden_names = golden_splits.get(split, [])
        assert names == [name for name in golden_names if name in scenes]
    assert set(itertools.chain(*our_splits.values())) == scenes
