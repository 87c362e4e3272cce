"""The nuScenes export against tables that nuscenes-devkit 1.2.0 opens, renders and evaluates
(golden/exports/nuscenes).

Tokens are arbitrary, so that rows are compared through scene, channel and time since the scene's
first sample. Two things differ on purpose. Golden scenes have an hour each and ours five the same;
so absolute times, which file names hold, differ. And golden logs name no file and a date, ours the
scenario and no date.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nuscenes_reader import Tables, channel_of, faults_of, tables_of
from pyquaternion import Quaternion

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
    return tables_of(golden / "nuscenes")


@pytest.fixture(scope="module")
def folder(golden: Path, expected: Tables, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tables of the golden release, in which most sensor files are missing."""
    root = tmp_path_factory.mktemp("golden")
    shutil.copytree(golden / "release", root / "release")
    dataset = DeepAccident("v1", root / "release", index_dir=root / "index", verbose=False)
    agents = tuple(dict.fromkeys(row["vehicle"] for row in expected["log"].values()))
    return (
        export_release(dataset, root / "out", NuScenes(agents=agents), workers=1).folder
        / "v1.0-deepaccident"
    )


@pytest.fixture(scope="module")
def found(folder: Path) -> Tables:
    return tables_of(folder)


class Scenes:
    """Tables by what their rows are: a scene's name, and microseconds since its first sample."""

    def __init__(self, tables: Tables) -> None:
        self.tables = tables
        first = {
            token: tables["sample"][row["first_sample_token"]]["timestamp"]
            for token, row in tables["scene"].items()
        }
        self.moments = {
            token: (
                tables["scene"][row["scene_token"]]["name"],
                row["timestamp"] - first[row["scene_token"]],
            )
            for token, row in tables["sample"].items()
        }
        self.start = {tables["scene"][token]["name"]: moment for token, moment in first.items()}

    def sensor_files(self) -> dict[tuple[str, int, str], dict[str, Any]]:
        """(Scene, moment, channel) → what is said of the file."""
        result, places = {}, {"": None}
        for token, row in self.tables["sample_data"].items():
            scene = self.moments[row["sample_token"]][0]
            places[token] = (
                scene,
                row["timestamp"] - self.start[scene],
                channel_of(self.tables, row),
            )
        for token, row in self.tables["sample_data"].items():
            pose = self.tables["ego_pose"][row["ego_pose_token"]]
            calibrated = self.tables["calibrated_sensor"][row["calibrated_sensor_token"]]
            folder, _, ending = row["filename"].partition("__")
            result[places[token]] = {
                "sample": self.moments[row["sample_token"]],
                "chain": (places[row["prev"]], places[row["next"]]),
                "file": (folder, ending.split("__")[0], ending.partition(".")[2]),
                **{name: row[name] for name in ("fileformat", "is_key_frame", "height", "width")},
                "pose": matrix_of(pose),
                "pose time": pose["timestamp"] - row["timestamp"],
                "sensor": matrix_of(calibrated),
                "K": np.array(calibrated["camera_intrinsic"]),
            }
        return result

    def boxes(self) -> dict[tuple[Any, ...], dict[str, Any]]:
        """(Scene, moment, place to the centimetre) → what is said of the box."""
        tables, result, places = self.tables, {}, {"": None}
        for token, row in tables["sample_annotation"].items():
            places[token] = (
                *self.moments[row["sample_token"]],
                *np.round(row["translation"], 2).tolist(),
            )
        for token, row in tables["sample_annotation"].items():
            instance = tables["instance"][row["instance_token"]]
            result[places[token]] = {
                "chain": (places[row["prev"]], places[row["next"]]),
                "track": (
                    instance["nbr_annotations"],
                    places[instance["first_annotation_token"]],
                    places[instance["last_annotation_token"]],
                ),
                "category": tables["category"][instance["category_token"]]["name"],
                "attributes": [
                    tables["attribute"][each]["name"] for each in row["attribute_tokens"]
                ],
                "visibility": tables["visibility"][row["visibility_token"]]["level"],
                "points": (row["num_lidar_pts"], row["num_radar_pts"]),
                "pose": matrix_of(row),
                "size": np.array(row["size"]),
            }
        return result

    def scenes(self) -> dict[str, dict[str, Any]]:
        """Name → what is said of the scene."""
        logs, samples = self.tables["log"], self.tables["sample"]
        chains = {
            self.moments[token]: [self.moments.get(row[way]) for way in ("prev", "next")]
            for token, row in samples.items()
        }
        return {
            row["name"]: {
                "samples": row["nbr_samples"],
                "ends": [self.moments[row[f"{end}_sample_token"]] for end in ("first", "last")],
                "log": [logs[row["log_token"]][name] for name in ("vehicle", "location")],
                "chains": {
                    place: chain for place, chain in chains.items() if place[0] == row["name"]
                },
            }
            for row in self.tables["scene"].values()
        }


def matrix_of(row: dict[str, Any]) -> np.ndarray:
    return np.column_stack([Quaternion(row["rotation"]).rotation_matrix, row["translation"]])


def assert_same(found: dict[Any, dict[str, Any]], expected: dict[Any, dict[str, Any]]) -> None:
    assert expected
    assert found.keys() == expected.keys()
    for place, facts in expected.items():
        for name, value in facts.items():
            if isinstance(value, np.ndarray):
                np.testing.assert_allclose(
                    found[place][name], value, rtol=0, atol=1e-6, err_msg=f"{place} {name}"
                )
            else:
                assert found[place][name] == value, (place, name)


def test_sensor_files(found: Tables, expected: Tables) -> None:
    assert_same(Scenes(found).sensor_files(), Scenes(expected).sensor_files())


def test_boxes(found: Tables, expected: Tables) -> None:
    assert_same(Scenes(found).boxes(), Scenes(expected).boxes())


def test_scenes(found: Tables, expected: Tables) -> None:
    assert_same(Scenes(found).scenes(), Scenes(expected).scenes())


@pytest.mark.parametrize("name", ["sensor", "category", "attribute", "visibility"])
def test_words(found: Tables, expected: Tables, name: str) -> None:
    words = [
        sorted(
            tuple((key, value) for key, value in row.items() if key != "token")
            for row in each[name].values()
        )
        for each in (found, expected)
    ]
    assert words[0] == words[1]


def test_neither_has_faults(found: Tables, expected: Tables) -> None:
    assert list(faults_of(found)) == list(faults_of(expected)) == []


def test_scenes_are_in_the_golden_split(golden: Path, folder: Path, expected: Tables) -> None:
    """The golden release may be a part of the one that the splits are of: then some scenes have no
    tables.
    """
    ours, theirs = (
        json.loads((each / "splits.json").read_text()) for each in (folder, golden / "nuscenes")
    )
    there = {row["name"] for row in expected["scene"].values()}
    assert ours == {
        split: [name for name in theirs.get(split, []) if name in there] for split in ours
    }
    assert {name for names in ours.values() for name in names} == there
