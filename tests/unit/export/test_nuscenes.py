"""Read nuScenes' tables back by nuScenes' conventions, without the devkit."""

import json
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyquaternion import Quaternion
from support.command_calls import invoke_command
from support.nuscenes_reader import (
    TABLES,
    Tables,
    boxes_in_sensor,
    count_points,
    find_faults,
    read_points,
    read_tables,
    sample_channel,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.nuscenes.scenes import CHANNEL_NAMES
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, UNTRACKED_ID

pytestmark = pytest.mark.slow

VERSION = "v1.0-deepaccident"
KEYFRAMES = (1, 6)
NUM_FRAMES = 6
OUR_CHANNELS = {name: channel for channel, name in CHANNEL_NAMES.items()}


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    out = tmp_path_factory.mktemp("nuscenes") / "out"
    return export_release(da, out, NuScenes(), workers=1)


@pytest.fixture(scope="module")
def tables(exported: Exported) -> Tables:
    return read_tables(exported.folder / VERSION)


@pytest.fixture
def export_ego(da: DeepAccident, tmp_path: Path) -> Callable[..., tuple[Exported, Tables]]:
    """A function that exports the recording of the first accident's ego, with other settings."""

    def export(dataset: DeepAccident = da, **settings: Any) -> tuple[Exported, Tables]:
        defaults = {"where": ("designed_accident=true", "split=train"), "agents": ("ego_vehicle",)}
        done = export_release(
            dataset, tmp_path / "out", NuScenes(**{**defaults, **settings}), workers=1
        )
        return done, read_tables(done.folder / VERSION)

    return export


def select_rows(tables: Tables, table: str, **values: Any) -> list[dict[str, Any]]:
    """Select the rows that have all the values."""
    return [row for row in tables[table].values() if row.items() >= values.items()]


def find_frame(tables: Tables, data: dict[str, Any]) -> tuple[str, int]:
    """Return the scene's name and the frame number of a row of sample_data."""
    sample = tables["sample"][data["sample_token"]]
    scene = tables["scene"][sample["scene_token"]]
    last_sample = tables["sample"][scene["last_sample_token"]]
    frames_left = (last_sample["timestamp"] - data["timestamp"]) // 100_000
    return scene["name"], NUM_FRAMES - frames_left


def test_all_references_lead_to_rows(da: DeepAccident, tables: Tables) -> None:
    assert list(find_faults(tables)) == []
    num_samples = len(da.sample)
    assert len(tables["scene"]) == len(da.agent)
    assert len(tables["sample"]) == num_samples * len(KEYFRAMES) // NUM_FRAMES
    assert len(tables["ego_pose"]) == num_samples
    assert len(tables["sample_data"]) == num_samples * len(CHANNEL_NAMES)


def assert_boxes_hold_points(folder: Path, tables: Tables) -> None:
    """Assert that the boxes in the ego's scenes hold the points that their rows count."""
    num_seen = 0
    for data in select_rows(tables, "sample_data", is_key_frame=True, fileformat="pcd"):
        if not data["filename"].split("__")[0].endswith("ego_vehicle"):
            continue
        points = read_points(folder / data["filename"])
        for row, center, rotation in boxes_in_sensor(tables, data):
            expected = row["num_lidar_pts"]
            count = count_points(points, row["size"], center, rotation)
            assert abs(count - expected) <= 1 + 0.02 * expected
            num_seen += expected > 0

    assert num_seen > 50


def test_boxes_hold_the_points_that_their_rows_count(exported: Exported, tables: Tables) -> None:
    assert_boxes_hold_points(exported.folder, tables)


def test_boxes_are_where_ours_are_in_every_sensor(da: DeepAccident, tables: Tables) -> None:
    for data in select_rows(tables, "sample_data", is_key_frame=True)[::13]:
        token = tables["sample"][data["sample_token"]]["deepaccident_token"]
        boxes = da.boxes(token, OUR_CHANNELS[sample_channel(tables, data)])
        boxes = boxes[boxes.actor_id != OWN_ACTOR_ID]
        _, centers, rotations = zip(*boxes_in_sensor(tables, data), strict=True)
        assert np.allclose(centers, boxes.center, atol=1e-6)
        for rotation, ours in zip(rotations, boxes.rotation, strict=True):
            assert Quaternion.absolute_distance(rotation, Quaternion(ours)) < 1e-6


def test_files_equal_the_release(da: DeepAccident, exported: Exported, tables: Tables) -> None:
    paths = set()
    for data in select_rows(tables, "sample_data"):
        scene, number = find_frame(tables, data)
        scenario, agent = scene.rsplit("-", 1)
        sample = f"{scenario.replace('-', '/', 1)}/{agent}/{number:03d}"
        channel = sample_channel(tables, data)
        path = exported.folder / data["filename"]

        assert path.parent.name == channel
        assert path.parents[1].name == ("samples" if number in KEYFRAMES else "sweeps")

        paths.add(path)
        if channel != "LIDAR_TOP":
            assert path.samefile(da.get_sample_data_path(sample, OUR_CHANNELS[channel]))
            assert (data["width"], data["height"]) == (64, 36)
        elif number == 2:
            points = read_points(path)
            cloud = da.load_point_cloud(sample, "lidar")
            assert np.array_equal(points[:, :4], cloud.points.astype(np.float32))
            assert not points[:, 4].any()

    assert paths == {path for path in exported.folder.glob("s*/*/*") if path.is_file()}
    assert exported.tally.linked == {"hard": len(list(exported.folder.glob("s*/CAM*/*.jpg")))}


def test_sweeps_belong_to_the_keyframe_after_them(tables: Tables) -> None:
    times = {token: row["timestamp"] for token, row in tables["sample"].items()}
    sweeps = select_rows(tables, "sample_data", is_key_frame=False)
    delays = {times[row["sample_token"]] - row["timestamp"] for row in sweeps}
    assert delays == {100_000 * number for number in range(1, 5)}

    samples = tables["sample"].values()
    intervals = {times[row["next"]] - row["timestamp"] for row in samples if row["next"]}
    assert intervals == {500_000}


def test_every_recording_is_a_scene_in_its_split(
    da: DeepAccident, exported: Exported, tables: Tables
) -> None:
    expected = {"deepaccident_train": [], "deepaccident_val": [], "deepaccident_test": []}
    for record in da.scenario:
        prefix = record["token"].replace("/", "-")
        scenes = [f"{prefix}-{agent}" for agent in AGENTS]
        expected[f"deepaccident_{record['split']}"] += scenes
    assert json.loads((exported.folder / VERSION / "splits.json").read_text()) == expected

    scene_names = [row["name"] for row in tables["scene"].values()]
    assert sorted(scene_names) == sorted(chain(*expected.values()))
    for row in tables["map"].values():
        assert (exported.folder / row["filename"]).read_bytes().startswith(b"\x89PNG")


def test_own_boxes_are_left_out_and_untracked_ones_are_single_instances(
    da: DeepAccident, exported: Exported, tables: Tables
) -> None:
    samples = tables["sample"].values()
    actors = np.concatenate([da.boxes(row["deepaccident_token"]).actor_id for row in samples])
    num_own = int(np.sum(actors == OWN_ACTOR_ID))
    num_untracked = int(np.sum(actors == UNTRACKED_ID))

    assert min(num_own, num_untracked) > 0
    assert len(select_rows(tables, "instance", actor_id=UNTRACKED_ID)) == num_untracked
    assert len(tables["sample_annotation"]) == len(actors) - num_own

    expected = {
        "boxes of the recording agents themselves": num_own,
        "tracks of untracked boxes (each is an instance of its own)": num_untracked,
        "boxes between keyframes, which readers interpolate": len(da.annotation) - len(actors),
        "files of the BEV camera": len(da.sample),
    }

    assert exported.tally.left_out.items() >= expected.items()


def test_attributes_say_who_moves(da: DeepAccident, tables: Tables) -> None:
    annotations = tables["sample_annotation"]
    attributes = set()
    for row in annotations.values():
        (attribute_token,) = row["attribute_tokens"]
        attribute = tables["attribute"][attribute_token]["name"]
        attributes.add(attribute)
        if row["actor_id"] >= 20000:
            assert attribute == "vehicle.parked"
        elif row["prev"] and row["category_deepaccident"] == "car":
            previous = annotations[row["prev"]]["translation"]
            distance_m = np.hypot(*np.subtract(row["translation"], previous)[:2])
            assert distance_m < 0.5 if attribute == "vehicle.stopped" else distance_m > 0.02

    assert attributes >= {
        "vehicle.moving",
        "vehicle.stopped",
        "vehicle.parked",
        "cycle.with_rider",
        "pedestrian.moving",
    }


def test_an_id_that_is_twice_in_a_label_is_two_instances(
    own_release: Path, export_ego: Any
) -> None:
    label = next(own_release.glob("train/*accident/ego_vehicle/label/*/*_004.txt"))
    lines = label.read_text().splitlines()
    tracked = next(line for line in lines[1:] if int(line.split()[10]) > 0)
    label.write_text("\n".join([*lines, tracked, ""]))
    _, tables = export_ego(DeepAccident("v1", own_release, verbose=False))
    instances = select_rows(
        tables,
        "instance",
        actor_id=int(tracked.split()[10]),
    )

    assert [row["nbr_annotations"] for row in instances] == [1, 1]
    assert list(find_faults(tables)) == []


def test_nuscenes_axes_turn_points_and_calibration(da: DeepAccident, export_ego: Any) -> None:
    """Boxes hold the same points as before, because the calibration turns with the points."""
    done, tables = export_ego(lidar_axes="nuscenes", where=())
    assert_boxes_hold_points(done.folder, tables)

    data = select_rows(tables, "sample_data", is_key_frame=True, fileformat="pcd")[0]
    token = tables["sample"][data["sample_token"]]["deepaccident_token"]
    x, y, z = da.load_point_cloud(token, "lidar").xyz.T
    points = read_points(done.folder / data["filename"])
    assert np.allclose(points[:, :3], np.column_stack([-y, x, z]), atol=1e-4)


@pytest.mark.parametrize("van", ["car", "truck"])
def test_vans_become_cars_or_trucks(export_ego: Any, van: str) -> None:
    _, tables = export_ego(van=van, where=(), sweeps=False, agents=AGENTS)
    names = {}
    for row in tables["instance"].values():
        category = tables["category"][row["category_token"]]
        names[row["category_deepaccident"]] = category["name"]

    assert names["van"] == f"vehicle.{van}"
    assert names["car"] == "vehicle.car"
    assert names["cyclist"] == "vehicle.bicycle"


def test_a_partial_release_is_consistent(da_partial: DeepAccident, tmp_path: Path) -> None:
    done = export_release(da_partial, tmp_path / "out", NuScenes(), workers=1)
    tables = read_tables(done.folder / VERSION)
    assert list(find_faults(tables)) == []

    num_scenarios = len(da_partial.scenario)
    num_files = num_scenarios * NUM_FRAMES
    assert done.tally.left_out.items() >= {
        ("agents of scenarios that are not in this release", num_scenarios),
        ("images that are not in this release (the tables name them)", num_files),
        ("point clouds that are not in this release (the tables name them)", num_files),
    }

    for token in tables["sample"]:
        rows = select_rows(tables, "sample_data", sample_token=token, is_key_frame=True)
        assert {sample_channel(tables, row) for row in rows} == OUR_CHANNELS.keys()


def test_without_labels_there_are_sensors_and_poses(
    unlabelled_dataset: DeepAccident, export_ego: Any
) -> None:
    done, tables = export_ego(unlabelled_dataset)
    assert done.tally.left_out["labels that are not in this release"] == 1
    assert len(tables["instance"]) == len(tables["sample_annotation"]) == 0
    assert len(tables["ego_pose"]) == 4
    assert len(tables["sample"]) == 1
    assert list(find_faults(tables)) == []


def test_the_command_has_the_settings(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = invoke_command(
        *("export", "nuscenes", da.dataroot, "--out", out),
        *("--agents", "infrastructure", "--van", "truck"),
        *("--lidar-axes", "nuscenes", "--no-sweeps", "--where", "split=val", "--workers", 1),
    )

    assert "excluded: " in result.output

    settings = json.loads((out / "nuscenes.manifest.json").read_text())["settings"]
    expected = {"van": "truck", "lidar_axes": "nuscenes", "sweeps": False}
    assert settings.items() >= expected.items()
    assert all((out / VERSION / f"{name}.json").is_file() for name in TABLES)
