"""nuScenes' tables, read back by a reader that knows nuScenes' conventions and not the devkit."""

import json
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from nuscenes_reader import (
    TABLES,
    Tables,
    boxes_in,
    channel_of,
    count_points,
    faults_of,
    points_of,
    tables_of,
)
from pyquaternion import Quaternion

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.nuscenes.scenes import CHANNEL_NAMES
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, UNTRACKED_ID

pytestmark = pytest.mark.slow

VERSION = "v1.0-deepaccident"
KEYS, FRAMES = (1, 6), 6


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export_release(da, tmp_path_factory.mktemp("nuscenes") / "out", NuScenes(), workers=1)


@pytest.fixture(scope="module")
def tables(exported: Exported) -> Tables:
    return tables_of(exported.folder / VERSION)


@pytest.fixture
def one(da: DeepAccident, tmp_path: Path) -> Callable[..., tuple[Exported, Tables]]:
    """Exports what the ego of the first accident recorded, with other settings."""

    def export(dataset: DeepAccident = da, **settings: Any) -> tuple[Exported, Tables]:
        chosen = {
            "where": ("designed_accident=true", "split=train"),
            "agents": ("ego_vehicle",),
            **settings,
        }
        made = export_release(dataset, tmp_path / "out", NuScenes(**chosen), workers=1)
        return made, tables_of(made.folder / VERSION)

    return export


def rows(tables: Tables, table: str, **values: Any) -> list[dict[str, Any]]:
    return [
        row
        for row in tables[table].values()
        if all(row[name] == value for name, value in values.items())
    ]


def frame_of(tables: Tables, data: dict[str, Any]) -> tuple[str, int]:
    """The scene's name and the number of the frame of a row of sample_data."""
    scene = tables["scene"][tables["sample"][data["sample_token"]]["scene_token"]]
    last = tables["sample"][scene["last_sample_token"]]["timestamp"]
    return scene["name"], FRAMES - (last - data["timestamp"]) // 100_000


def test_nothing_leads_nowhere(da: DeepAccident, tables: Tables) -> None:
    assert list(faults_of(tables)) == []
    samples = len(da.sample)
    assert [len(tables[name]) for name in ("scene", "sample", "ego_pose", "sample_data")] == [
        *(len(da.agent), samples * len(KEYS) // FRAMES, samples, samples * len(CHANNEL_NAMES)),
    ]


def disagreement(folder: Path, tables: Tables) -> float:
    """The share of boxes that hold another number of points than their rows say, in the ego's
    scenes.
    """
    wrong, total = 0, 0
    for data in rows(tables, "sample_data", is_key_frame=True, fileformat="pcd"):
        if not data["filename"].split("__")[0].endswith("ego_vehicle"):
            continue
        points = points_of(folder / data["filename"])
        for row, center, rotation in boxes_in(tables, data):
            found = count_points(points, row["size"], center, rotation)
            wrong += abs(found - row["num_lidar_pts"]) > 1 + 0.02 * row["num_lidar_pts"]
            total += row["num_lidar_pts"] > 0
    assert total > 50
    return wrong / total


def test_boxes_hold_the_points_that_their_rows_count(exported: Exported, tables: Tables) -> None:
    assert disagreement(exported.folder, tables) == 0


def test_boxes_are_where_ours_are_in_every_sensor(da: DeepAccident, tables: Tables) -> None:
    ours = {name: channel for channel, name in CHANNEL_NAMES.items()}
    for data in rows(tables, "sample_data", is_key_frame=True)[::13]:
        boxes = da.boxes(
            tables["sample"][data["sample_token"]]["deepaccident_token"],
            ours[channel_of(tables, data)],
        )
        boxes = boxes[boxes.actor_id != OWN_ACTOR_ID]
        _, centers, turned = zip(*boxes_in(tables, data), strict=True)
        assert np.allclose(centers, boxes.center, atol=1e-6)
        assert (
            max(map(Quaternion.absolute_distance, turned, map(Quaternion, boxes.rotation))) < 1e-6
        )


def test_files_are_those_of_the_release(
    da: DeepAccident, exported: Exported, tables: Tables
) -> None:
    seen = set()
    for data in rows(tables, "sample_data"):
        scene, number = frame_of(tables, data)
        scenario, agent = scene.rsplit("-", 1)
        sample, channel = (
            f"{scenario.replace('-', '/', 1)}/{agent}/{number:03d}",
            channel_of(tables, data),
        )
        path = exported.folder / data["filename"]
        assert (path.parent.name, path.parents[1].name) == (
            channel,
            "samples" if number in KEYS else "sweeps",
        )
        seen.add(path)
        if channel != "LIDAR_TOP":
            ours = next(each for each, name in CHANNEL_NAMES.items() if name == channel)
            assert path.samefile(da.get_sample_data_path(sample, ours))
            assert (data["width"], data["height"]) == (64, 36)
        elif number == 2:
            cloud, points = da.load_point_cloud(sample, "lidar"), points_of(path)
            assert np.array_equal(points[:, :4], cloud.points.astype(np.float32))
            assert not points[:, 4].any()
    assert seen == {path for path in exported.folder.glob("s*/*/*") if path.is_file()}
    assert exported.tally.linked == {"hard": len(list(exported.folder.glob("s*/CAM*/*.jpg")))}


def test_sweeps_belong_to_the_keyframe_after_them(tables: Tables) -> None:
    times = {token: row["timestamp"] for token, row in tables["sample"].items()}
    waits = {
        times[each["sample_token"]] - each["timestamp"]
        for each in rows(tables, "sample_data", is_key_frame=False)
    }
    assert waits == {100_000 * number for number in range(1, 5)}
    assert {
        times[row["next"]] - times[token] for token, row in tables["sample"].items() if row["next"]
    } == {500_000}


def test_scenes_and_splits(da: DeepAccident, exported: Exported, tables: Tables) -> None:
    expected = {
        f"deepaccident_{split}": [
            f"{record['token'].replace('/', '-')}-{agent}"
            for record in da.scenario
            if record["split"] == split
            for agent in AGENTS
        ]
        for split in ("train", "val", "test")
    }
    assert json.loads((exported.folder / VERSION / "splits.json").read_text()) == expected
    assert sorted(row["name"] for row in tables["scene"].values()) == sorted(
        chain(*expected.values())
    )
    for row in tables["map"].values():
        assert (exported.folder / row["filename"]).read_bytes().startswith(b"\x89PNG")


def test_own_rows_are_left_out_and_untracked_ones_stand_alone(
    da: DeepAccident, exported: Exported, tables: Tables
) -> None:
    actors = np.concatenate(
        [da.boxes(row["deepaccident_token"]).actor_id for row in tables["sample"].values()]
    )
    own, untracked = (int(np.sum(actors == kind)) for kind in (OWN_ACTOR_ID, UNTRACKED_ID))
    assert min(own, untracked) > 0
    assert len(rows(tables, "instance", actor_id=UNTRACKED_ID)) == untracked
    assert len(tables["sample_annotation"]) == len(actors) - own
    expected = {
        "boxes of the recording agents themselves": own,
        "tracks of untracked boxes (each is an instance of its own)": untracked,
        "boxes between keyframes, which readers interpolate": len(da.annotation) - len(actors),
        "files of the BEV camera": len(da.sample),
    }
    assert {name: exported.tally.left_out[name] for name in expected} == expected


def test_attributes_say_who_moves(da: DeepAccident, tables: Tables) -> None:
    seen = set()
    for row in tables["sample_annotation"].values():
        (word,) = (tables["attribute"][each]["name"] for each in row["attribute_tokens"])
        seen.add(word)
        if row["actor_id"] >= 20000:
            assert word == "vehicle.parked"
        elif row["prev"] and row["category_deepaccident"] == "car":
            way = np.hypot(
                *np.subtract(
                    row["translation"], tables["sample_annotation"][row["prev"]]["translation"]
                )[:2]
            )
            assert way < 0.5 if word == "vehicle.stopped" else way > 0.02
    assert seen >= {
        "vehicle.moving",
        "vehicle.stopped",
        "vehicle.parked",
        "cycle.with_rider",
        "pedestrian.moving",
    }


def test_an_id_that_stands_twice_in_a_label_is_two_instances(own_release: Path, one: Any) -> None:
    label = next(own_release.glob("train/*accident/ego_vehicle/label/*/*_004.txt"))
    lines = label.read_text().splitlines()
    tracked = next(line for line in lines[1:] if int(line.split()[10]) > 0)
    label.write_text("\n".join([*lines, tracked, ""]))
    _, tables = one(DeepAccident("v1", own_release, verbose=False))
    assert [
        row["nbr_annotations"]
        for row in rows(tables, "instance", actor_id=int(tracked.split()[10]))
    ] == [1, 1]
    assert list(faults_of(tables)) == []


def test_axes_of_nuscenes(da: DeepAccident, one: Any) -> None:
    """Points turn with the calibration, so that boxes hold them as before."""
    made, tables = one(lidar_axes="nuscenes", where=())
    assert disagreement(made.folder, tables) == 0
    data = rows(tables, "sample_data", is_key_frame=True, fileformat="pcd")[0]
    x, y, z = da.load_point_cloud(
        tables["sample"][data["sample_token"]]["deepaccident_token"], "lidar"
    ).xyz.T
    assert np.allclose(
        points_of(made.folder / data["filename"])[:, :3], np.column_stack([-y, x, z]), atol=1e-4
    )


@pytest.mark.parametrize("van", ["car", "truck"])
def test_vans_become(one: Any, van: str) -> None:
    _, tables = one(van=van, where=(), sweeps=False, agents=AGENTS)
    names = {
        row["category_deepaccident"]: tables["category"][row["category_token"]]["name"]
        for row in tables["instance"].values()
    }
    assert [names[ours] for ours in ("van", "car", "cyclist")] == [
        f"vehicle.{van}",
        "vehicle.car",
        "vehicle.bicycle",
    ]


def test_a_partial_release(da_partial: DeepAccident, tmp_path: Path) -> None:
    made = export_release(da_partial, tmp_path / "out", NuScenes(), workers=1)
    tables = tables_of(made.folder / VERSION)
    assert list(faults_of(tables)) == []
    scenarios = len(da_partial.scenario)
    assert made.tally.left_out.items() >= {
        ("agents of scenarios that are not in this release", scenarios),
        ("images that are not in this release (the tables name them)", scenarios * FRAMES),
        ("point clouds that are not in this release (the tables name them)", scenarios * FRAMES),
    }
    for token in tables["sample"]:
        keys = rows(tables, "sample_data", sample_token=token, is_key_frame=True)
        assert {channel_of(tables, row) for row in keys} == set(CHANNEL_NAMES.values())


def test_without_labels_there_are_sensors_and_poses(unlabelled: DeepAccident, one: Any) -> None:
    made, tables = one(unlabelled)
    assert made.tally.left_out["labels that are not in this release"] == 1
    assert [
        len(tables[name]) for name in ("instance", "sample_annotation", "ego_pose", "sample")
    ] == [0, 0, 4, 1]
    assert list(faults_of(tables)) == []


def test_the_command_has_the_settings(da: DeepAccident, tmp_path: Path) -> None:
    words = [
        "export",
        "nuscenes",
        str(da.dataroot),
        "--out",
        str(tmp_path / "out"),
        "--agents",
        "infrastructure",
    ]
    more = [
        "--van",
        "truck",
        "--lidar-axes",
        "nuscenes",
        "--no-sweeps",
        "--where",
        "split=val",
        "--workers",
        "1",
    ]
    assert (
        "left out: "
        in CliRunner().invoke(deepaccident, [*words, *more], catch_exceptions=False).output
    )
    told = json.loads((tmp_path / "out" / "nuscenes.manifest.json").read_text())["settings"]
    assert [told[name] for name in ("van", "lidar_axes", "sweeps")] == ["truck", "nuscenes", False]
    assert all((tmp_path / "out" / VERSION / f"{name}.json").is_file() for name in TABLES)
