"""A dataroot of nuScenes as a release: what is ignored counts nowhere, times are true, damaged
tables are refused.
"""

import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nuscenes_dataroots import COUNTED, Dataroot, Row, write_dataroot
from refusals import assert_refused

from deepaccident_devkit.errors import DatarootError, NotAvailableError
from deepaccident_devkit.evaluation import detection_truth
from deepaccident_devkit.evaluation.forecasting import forecasting_truth
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.baselines import predict_detections
from deepaccident_devkit.plugins.nuscenes import NuScenesRelease, open_nuscenes, release_of
from deepaccident_devkit.statistics import dataset_statistics
from deepaccident_devkit.statistics.overview import overview
from deepaccident_devkit.taxonomy import IGNORED_ID


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataroot:
    return write_dataroot(tmp_path_factory.mktemp("road") / "dataroot")


@pytest.fixture(scope="module")
def road(made: Dataroot) -> NuScenesRelease:
    return open_nuscenes(made.folder)


def keyframes(road: NuScenesRelease) -> list[str]:
    return [record["token"] for record in road.sample if record["labelled"]]


def rows(made: Dataroot, table: str, **fields: str) -> list[Row]:
    return [
        row
        for row in made.tables[table]
        if all(row[name] == value for name, value in fields.items())
    ]


# ---- what is ignored


def test_boxes_of_other_classes_are_in_no_table(made: Dataroot, road: NuScenesRelease) -> None:
    classes = {row["token"]: row["category_token"] for row in made.tables["instance"]}
    for token in keyframes(road):
        there = rows(made, "sample_annotation", sample_token=road.nuscenes_token(token))
        counted = [row for row in there if classes[row["instance_token"]] in COUNTED]
        assert 0 < len(counted) < len(there)
        np.testing.assert_allclose(
            road.boxes(token).center, [row["translation"] for row in counted]
        )
        np.testing.assert_allclose(
            road.with_ignored.boxes(token).center, [row["translation"] for row in there]
        )
    assert road.columns("annotation")["actor_id"].max() < IGNORED_ID
    ids = road.with_ignored.columns("annotation")["actor_id"]
    assert (ids >= IGNORED_ID).sum() == len(ids) - len(road.annotation)
    assert {*ids[ids < IGNORED_ID].tolist()} == {*road.columns("annotation")["actor_id"].tolist()}
    assert (
        pickle.loads(pickle.dumps(road.with_ignored)).annotation[0]
        == road.with_ignored.annotation[0]
    )


def test_what_is_ignored_is_nowhere_true(road: NuScenesRelease) -> None:
    for token in keyframes(road):
        ours = {*road.boxes(token).actor_id.tolist()}
        assert {*detection_truth(road, token, "paper").actor_id.tolist()} <= ours
        assert {*forecasting_truth(road, token).actor_id.tolist()} == ours
        assert {*predict_detections(road, token, agents="single").boxes.actor_id.tolist()} <= ours
        for protocol in ("clean", "released", "beverse"):
            config = MotionLabelConfig(protocol=protocol, filter_invisible=False)
            assert max(road.motion_labels(token, config).id_map, default=0) < IGNORED_ID


def test_statistics_and_interactions_count_what_is_ours(
    made: Dataroot, road: NuScenesRelease
) -> None:
    classes = {row["token"]: row["category_token"] for row in made.tables["instance"]}
    walkers = [
        row
        for row in made.tables["sample_annotation"]
        if classes[row["instance_token"]].startswith("human.pedestrian")
    ]
    table = next(
        block
        for block in dataset_statistics(road).to_text().split("\n\n")
        if block.startswith("category")
    )
    [words] = [line.split() for line in table.splitlines() if line.startswith("pedestrian")]
    assert words[2] == str(len(walkers))
    pairs = [road.interactions(each).pairs.actor_ids for each in road.scenario]
    assert 0 < np.concatenate(pairs).max() < IGNORED_ID


def test_a_vehicle_is_a_vehicle_in_fierys_labels(road: NuScenesRelease) -> None:
    """Buses are, barriers, cones and animals are not."""
    found = set()
    for token in keyframes(road):
        boxes = road.with_ignored.boxes(token)
        names = dict(zip(boxes.actor_id.tolist(), boxes.category_names, strict=True))
        found |= {
            names.get(actor)
            for actor in road.motion_labels(token, "fiery").id_map
            if actor >= IGNORED_ID
        }
    assert found - {None} == {"truck"}


# ---- times


def test_times_and_velocities_are_the_keyframes_own(made: Dataroot, road: NuScenesRelease) -> None:
    stamps = {row["token"]: row["timestamp"] for row in made.tables["sample"]}
    places = {row["token"]: np.array(row["translation"]) for row in made.tables["ego_pose"]}
    for scene in made.tables["scene"]:
        own = [row["token"] for row in rows(made, "sample", scene_token=scene["token"])]
        times = (np.array([stamps[token] for token in own]) - stamps[own[0]]) * 1e-6
        frames = road.field2token("frame", "scenario_token", f"nuscenes/{scene['name']}")
        found = np.array([road.get("frame", token)["timestamp"] for token in frames])
        np.testing.assert_allclose(found[::5], times, atol=1e-6)
        keys = [
            f"nuscenes/{scene['name']}/ego_vehicle/{frame:03d}"
            for frame in range(1, len(found) + 1, 5)
        ]
        left = [road.get("sample", key)["time_to_end"] for key in keys]
        np.testing.assert_allclose(left, times[-1] - times, atol=1e-6)
        ego = np.array([places[rows_of_lidar(made, token)] for token in own])[:, :2]
        velocity = [road.get("sample", key)["velocity"] for key in keys[:-1]]
        np.testing.assert_allclose(
            velocity, np.diff(ego, axis=0) / np.diff(times)[:, None], atol=1e-4
        )


def rows_of_lidar(made: Dataroot, sample: str) -> str:
    return next(
        row["ego_pose_token"]
        for row in rows(made, "sample_data", sample_token=sample)
        if row["is_key_frame"] and "/LIDAR_TOP/" in row["filename"]
    )


# ---- v1.0-test


def test_scenes_without_annotations_are_unlabelled(tmp_path: Path) -> None:
    made = write_dataroot(tmp_path / "road", version="v1.0-test", splits=("test", "test"), boxes=0)
    road = open_nuscenes(made.folder)
    assert not road.columns("sample")["labelled"][:].any()
    with pytest.raises(NotAvailableError, match=r"test: none of its samples here has labels"):
        road.samples("test", "all")
    seen = overview(road)
    assert (seen.agents["ego_vehicle"], seen.labelled["ego_vehicle"]) == (2, 0)
    assert seen.expected == {}


# ---- damaged tables

Change = Callable[[dict[str, list[Row]]], Any]


def every(table: str, **fields: Any) -> Change:
    return lambda tables: [row.update(fields) for row in tables[table]]


def first(table: str, **fields: Any) -> Change:
    return lambda tables: tables[table][0].update(fields)


def cycle(table: str, step: int) -> Change:
    """A row's `next` is itself, or a row before it."""

    def change(tables: dict[str, list[Row]]) -> None:
        row = tables[table][step]
        row["next"] = tables[table][0]["token"]

    return change


DAMAGES: dict[str, tuple[Change, tuple[str, ...]]] = {
    "next of itself": (cycle("sample", 0), ("sample.json: scene-0000-0", "next")),
    "a longer cycle": (cycle("sample", 2), ("sample.json: scene-0000-2", "next")),
    "no way to all samples": (
        first("sample", next=""),
        ("sample.json: scene-0000-0", "'scene-0000-1'"),
    ),
    "a cycle of all": (cycle("sample", 4), ("sample.json: scene-0000-4", "next")),
    "no first sample": (
        first("scene", first_sample_token=""),
        ("scene.json: scene-0000", "'scene-0000-0'"),
    ),
    "samples of no scene": (
        every("sample", scene_token="scene-0001"),  # noqa: S106
        ("scene.json: scene-0000", "found"),
    ),
    "an actor twice": (
        lambda tables: tables["sample_annotation"].append(
            {**tables["sample_annotation"][0], "token": "again"}
        ),
        ("sample_annotation.json: again", "instance_token"),
    ),
    "at the same time": (
        every("sample", timestamp=1_500_000_000_000_000),
        ("sample.json: scene-0000-0", "timestamp"),
    ),
    "next unknown": (first("sample", next="zz"), ("sample.json: scene-0000-0", "'zz'")),
    "log unknown": (first("scene", log_token="zz"), ("scene.json: scene-0000", "log_token")),  # noqa: S106
    "sample unknown": (
        first("sample_annotation", sample_token="zz"),  # noqa: S106
        ("sample_annotation.json: scene-0000-actor0-0", "sample_token", "'zz'"),
    ),
    "no intrinsic": (
        every("calibrated_sensor", camera_intrinsic=[]),
        ("calibrated_sensor.json: scene-0000-CAM",),
    ),
    "intrinsic of zeros": (
        every("calibrated_sensor", camera_intrinsic=[[0, 0, 0]] * 3),
        ("calibrated_sensor.json: scene-0000-CAM", "focal"),
    ),
    "rotation of 3": (every("ego_pose", rotation=[1, 0, 0]), ("ego_pose.json: ", "rotation")),
    "rotation of zeros": (
        every("ego_pose", rotation=[0, 0, 0, 0]),
        ("ego_pose.json: ", "rotation", "(0.0, 0.0, 0.0, 0.0)"),
    ),
    "points in words": (first("sample_annotation", num_lidar_pts="many"), ("num_lidar_pts",)),
    "no width": (every("sample_data", width=None), ("sample_data.json: ", "width")),
    "width of 0": (every("sample_data", width=0), ("sample_data.json: scene-0000-0-CAM", "width")),
    "translation NaN": (
        first("sample_annotation", translation=[float("nan")] * 3),
        ("sample_annotation.json: ", "$[0].translation"),
    ),
    "translation huge": (
        first("sample_annotation", translation=[1e308] * 3),
        ("sample_annotation.json: ", "$[0].translation"),
    ),
    "size below 0": (
        first("sample_annotation", size=[-1, -1, -1]),
        ("sample_annotation.json: ", "$[0].size"),
    ),
    "field missing": (
        lambda tables: tables["sample"][0].pop("timestamp"),
        ("sample.json: ", "`timestamp` - at `$[0]`"),
    ),
    "token twice": (
        lambda tables: tables["sample"].append(dict(tables["sample"][0])),
        ("sample.json: scene-0000-0", "two rows"),
    ),
    "name twice": (every("scene", name="scene-0000"), ("scene.json: scene-0001", "name")),
    "name of a path": (first("scene", name="../up"), ("scene.json: ", "$[0].name")),
    "file outside": (
        first("sample_data", filename="samples/../../secret.jpg"),
        ("sample_data.json: ", "$[0].filename"),
    ),
    "file outside, in lines": (
        first("sample_data", filename="a\n/../../secret"),
        ("$[0].filename",),
    ),
    "file of the root": (first("sample_data", filename="/etc/passwd"), ("$[0].filename",)),
    "no camera": (
        lambda tables: tables.update(
            sample_data=[
                row for row in tables["sample_data"] if "/CAM_BACK/" not in row["filename"]
            ]
        ),
        ("sample.json: scene-0000-0", "CAM_BACK"),
    ),
    "a row that is none": (lambda tables: tables["log"].append(7), ("log.json: ", "$[3]")),
    "a table that is none": (lambda tables: tables.update(category={}), ("category.json", "array")),
    "no scenes": (
        lambda tables: tables.update({name: [] for name in tables}),
        ("scene.json", "has no scenes"),
    ),
}


def damaged(made: Dataroot, folder: Path, name: str) -> Path:
    tables = json.loads(json.dumps(made.tables))
    DAMAGES[name][0](tables)
    Dataroot(folder, made.version, tables).write()
    (folder / made.version / "splits.json").write_text("{}")
    return folder


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_tables_are_refused_by_file_row_and_field(
    made: Dataroot, tmp_path: Path, name: str
) -> None:
    folder = damaged(made, tmp_path / "road", name)
    named = (*DAMAGES[name][1], str(folder), "unpack the tables again")
    assert_refused((lambda: open_nuscenes(folder), DatarootError, named))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b'[{"token": ', "is no JSON (line 1"),
        (b"\xff\xfe[]", "not in UTF-8"),
        (b'[{"token": "a", "x": ' + b"[" * 10_000 + b"]" * 10_000 + b"}]", "nested"),
        (None, "No such file"),
    ],
)
def test_unreadable_tables_are_named(
    made: Dataroot, tmp_path: Path, content: bytes | None, words: str
) -> None:
    folder = Dataroot(tmp_path / "road", made.version, made.tables).write()
    table = folder / made.version / "category.json"
    table.unlink()
    if content is not None:
        table.write_bytes(content)
    assert_refused(
        (
            lambda: open_nuscenes(folder),
            DatarootError,
            (str(table), words, "unpack the tables again"),
        )
    )


@pytest.mark.parametrize(
    ("splits", "words"),
    [
        ({"train": ["scene-0000"], "val": ["scene-0000"]}, "scene-0000 is in train and in val"),
        ({"train": "scene-0000"}, "array"),
        ([], "object"),
    ],
)
def test_splits_that_contradict_are_refused(
    made: Dataroot, tmp_path: Path, splits: Any, words: str
) -> None:
    folder = Dataroot(tmp_path / "road", made.version, made.tables).write()
    path = folder / made.version / "splits.json"
    path.write_text(json.dumps(splits))
    assert_refused((lambda: open_nuscenes(folder), DatarootError, (str(path), words)))


def test_a_restored_table_is_read_again(made: Dataroot, tmp_path: Path) -> None:
    """Its size and time are as before, but another time of the file's system is not."""
    folder = Dataroot(tmp_path / "road", made.version, made.tables).write()
    (folder / made.version / "splits.json").write_text('{"train": ["scene-0000"]}')
    before = open_nuscenes(folder)
    table = folder / made.version / "log.json"
    state = table.stat()
    table.write_text(table.read_text().replace("singapore-onenorth", "singapore-queenstn"))
    os.utime(table, ns=(state.st_atime_ns, state.st_mtime_ns))
    after = open_nuscenes(folder)
    assert (before.scenario[0]["town"], after.scenario[0]["town"]) == (
        "singapore-onenorth",
        "singapore-queenstn",
    )


def test_what_the_nuscenes_devkit_opened(made: Dataroot, road: NuScenesRelease) -> None:
    class Opened:
        table_root = str(made.tables_folder)

    assert release_of(Opened()).scenario[0] == road.scenario[0]
