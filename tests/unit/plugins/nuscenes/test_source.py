"""A nuScenes dataroot as a release: ignored classes count nowhere, times are exact, and damaged
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
from support.expected_errors import assert_raises
from support.nuscenes_dataroots import POINT_COUNTS, Dataroot, Row, write_dataroot

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
def dataroot(tmp_path_factory: pytest.TempPathFactory) -> Dataroot:
    return write_dataroot(tmp_path_factory.mktemp("road") / "dataroot")


@pytest.fixture(scope="module")
def release(dataroot: Dataroot) -> NuScenesRelease:
    return open_nuscenes(dataroot.folder)


def keyframe_tokens(release: NuScenesRelease) -> list[str]:
    return [record["token"] for record in release.sample if record["labelled"]]


def select_rows(dataroot: Dataroot, table: str, field: str, value: str) -> list[Row]:
    return [row for row in dataroot.tables[table] if row[field] == value]


def category_by_instance(dataroot: Dataroot) -> dict[str, str]:
    return {row["token"]: row["category_token"] for row in dataroot.tables["instance"]}


# ---- ignored classes


def test_boxes_of_other_classes_are_in_no_table(
    dataroot: Dataroot, release: NuScenesRelease
) -> None:
    categories = category_by_instance(dataroot)
    for token in keyframe_tokens(release):
        nuscenes_token = release.nuscenes_token(token)
        rows = select_rows(dataroot, "sample_annotation", "sample_token", nuscenes_token)
        centers = [row["translation"] for row in rows]
        counted_centers = [
            row["translation"] for row in rows if categories[row["instance_token"]] in POINT_COUNTS
        ]
        assert 0 < len(counted_centers) < len(rows)
        np.testing.assert_allclose(release.boxes(token).center, counted_centers)
        np.testing.assert_allclose(release.with_ignored.boxes(token).center, centers)

    ids = release.columns("annotation")["actor_id"]
    ids_with_ignored = release.with_ignored.columns("annotation")["actor_id"]
    is_ignored = ids_with_ignored >= IGNORED_ID
    assert ids.max() < IGNORED_ID
    assert is_ignored.sum() == len(ids_with_ignored) - len(release.annotation)
    assert {*ids_with_ignored[~is_ignored].tolist()} == {*ids.tolist()}
    unpickled = pickle.loads(pickle.dumps(release.with_ignored))
    assert unpickled.annotation[0] == release.with_ignored.annotation[0]


def test_ignored_classes_are_in_no_truth(release: NuScenesRelease) -> None:
    for token in keyframe_tokens(release):
        ids = {*release.boxes(token).actor_id.tolist()}
        detections = predict_detections(release, token, agents="single")
        assert {*detection_truth(release, token, "paper").actor_id.tolist()} <= ids
        assert {*forecasting_truth(release, token).actor_id.tolist()} == ids
        assert {*detections.boxes.actor_id.tolist()} <= ids
        for protocol in ("clean", "released", "beverse"):
            config = MotionLabelConfig(protocol=protocol, filter_invisible=False)
            labels = release.motion_labels(token, config)
            assert max(labels.id_map, default=0) < IGNORED_ID


def test_statistics_and_interactions_count_only_known_classes(
    dataroot: Dataroot, release: NuScenesRelease
) -> None:
    categories = category_by_instance(dataroot)
    pedestrians = [
        row
        for row in dataroot.tables["sample_annotation"]
        if categories[row["instance_token"]].startswith("human.pedestrian")
    ]
    blocks = dataset_statistics(release).to_text().split("\n\n")
    table = next(block for block in blocks if block.startswith("category"))
    [words] = [line.split() for line in table.splitlines() if line.startswith("pedestrian")]
    assert words[2] == str(len(pedestrians))
    pairs = [release.interactions(scenario).pairs.actor_ids for scenario in release.scenario]
    assert 0 < np.concatenate(pairs).max() < IGNORED_ID


def test_fiery_labels_vehicles_of_ignored_classes(release: NuScenesRelease) -> None:
    """Among ignored classes, FIERY labels buses, but not barriers, cones and animals."""
    categories = set()
    for token in keyframe_tokens(release):
        boxes = release.with_ignored.boxes(token)
        category_by_id = dict(zip(boxes.actor_id.tolist(), boxes.category_names, strict=True))
        for actor_id in release.motion_labels(token, "fiery").id_map:
            if actor_id >= IGNORED_ID:
                categories.add(category_by_id.get(actor_id))
    assert categories - {None} == {"truck"}


# ---- times


def test_times_and_velocities_are_the_keyframes_own(
    dataroot: Dataroot, release: NuScenesRelease
) -> None:
    ego_positions = {row["token"]: row["translation"] for row in dataroot.tables["ego_pose"]}
    for scene in dataroot.tables["scene"]:
        rows = select_rows(dataroot, "sample", "scene_token", scene["token"])
        times_us = np.array([row["timestamp"] for row in rows])
        times_s = (times_us - times_us[0]) * 1e-6
        poses = [lidar_pose_token(dataroot, row["token"]) for row in rows]
        positions = np.array([ego_positions[pose] for pose in poses])[:, :2]
        velocities = np.diff(positions, axis=0) / np.diff(times_s)[:, None]

        scenario = f"nuscenes/{scene['name']}"
        frames = release.field2token("frame", "scenario_token", scenario)
        frame_times = [release.get("frame", token)["timestamp"] for token in frames]
        samples = [
            release.get("sample", f"{scenario}/ego_vehicle/{frame:03d}")
            for frame in range(1, len(frames) + 1, 5)
        ]
        times_to_end = [sample["time_to_end"] for sample in samples]
        sample_velocities = [sample["velocity"] for sample in samples[:-1]]
        np.testing.assert_allclose(frame_times[::5], times_s, atol=1e-6)
        np.testing.assert_allclose(times_to_end, times_s[-1] - times_s, atol=1e-6)
        np.testing.assert_allclose(sample_velocities, velocities, atol=1e-4)


def lidar_pose_token(dataroot: Dataroot, sample: str) -> str:
    return next(
        row["ego_pose_token"]
        for row in select_rows(dataroot, "sample_data", "sample_token", sample)
        if row["is_key_frame"] and "/LIDAR_TOP/" in row["filename"]
    )


# ---- v1.0-test


def test_scenes_without_annotations_are_unlabelled(tmp_path: Path) -> None:
    dataroot = write_dataroot(
        tmp_path / "road", version="v1.0-test", splits=("test", "test"), boxes=0
    )
    release = open_nuscenes(dataroot.folder)
    assert not release.columns("sample")["labelled"][:].any()
    with pytest.raises(NotAvailableError, match=r"test: no sample of this split has labels"):
        release.samples("test", "all")
    summary = overview(release)
    assert (summary.agents["ego_vehicle"], summary.labelled["ego_vehicle"]) == (2, 0)
    assert summary.expected == {}


# ---- damaged tables

Change = Callable[[dict[str, list[Row]]], Any]


def change_all(table: str, **fields: Any) -> Change:
    def change(tables: dict[str, list[Row]]) -> None:
        for row in tables[table]:
            row.update(fields)

    return change


def change_first(table: str, **fields: Any) -> Change:
    return lambda tables: tables[table][0].update(fields)


def link_back(table: str, number: int) -> Change:
    """Let the `next` of a row be the first row of its table."""

    def change(tables: dict[str, list[Row]]) -> None:
        rows = tables[table]
        rows[number]["next"] = rows[0]["token"]

    return change


DAMAGES: dict[str, tuple[Change, tuple[str, ...]]] = {
    "next of itself": (link_back("sample", 0), ("sample.json: scene-0000-0", "next")),
    "a longer cycle": (link_back("sample", 2), ("sample.json: scene-0000-2", "next")),
    "no way to all samples": (
        change_first("sample", next=""),
        ("sample.json: scene-0000-0", "'scene-0000-1'"),
    ),
    "a cycle of all": (link_back("sample", 4), ("sample.json: scene-0000-4", "next")),
    "no first sample": (
        change_first("scene", first_sample_token=""),
        ("scene.json: scene-0000", "'scene-0000-0'"),
    ),
    "samples of no scene": (
        change_all("sample", scene_token="scene-0001"),  # noqa: S106
        ("scene.json: scene-0000", "found"),
    ),
    "an actor twice": (
        lambda tables: tables["sample_annotation"].append(
            {**tables["sample_annotation"][0], "token": "again"}
        ),
        ("sample_annotation.json: again", "instance_token"),
    ),
    "at the same time": (
        change_all("sample", timestamp=1_500_000_000_000_000),
        ("sample.json: scene-0000-0", "timestamp"),
    ),
    "next unknown": (change_first("sample", next="zz"), ("sample.json: scene-0000-0", "'zz'")),
    "log unknown": (change_first("scene", log_token="zz"), ("scene.json: scene-0000", "log_token")),  # noqa: S106
    "sample unknown": (
        change_first("sample_annotation", sample_token="zz"),  # noqa: S106
        ("sample_annotation.json: scene-0000-actor0-0", "sample_token", "'zz'"),
    ),
    "no intrinsic": (
        change_all("calibrated_sensor", camera_intrinsic=[]),
        ("calibrated_sensor.json: scene-0000-CAM",),
    ),
    "intrinsic of zeros": (
        change_all("calibrated_sensor", camera_intrinsic=[[0, 0, 0]] * 3),
        ("calibrated_sensor.json: scene-0000-CAM", "focal"),
    ),
    "rotation of 3": (change_all("ego_pose", rotation=[1, 0, 0]), ("ego_pose.json: ", "rotation")),
    "rotation of zeros": (
        change_all("ego_pose", rotation=[0, 0, 0, 0]),
        ("ego_pose.json: ", "rotation", "(0.0, 0.0, 0.0, 0.0)"),
    ),
    "points in words": (
        change_first("sample_annotation", num_lidar_pts="many"),
        ("num_lidar_pts",),
    ),
    "no width": (change_all("sample_data", width=None), ("sample_data.json: ", "width")),
    "width of 0": (
        change_all("sample_data", width=0),
        ("sample_data.json: scene-0000-0-CAM", "width"),
    ),
    "translation NaN": (
        change_first("sample_annotation", translation=[float("nan")] * 3),
        ("sample_annotation.json: ", "$[0].translation"),
    ),
    "translation huge": (
        change_first("sample_annotation", translation=[1e308] * 3),
        ("sample_annotation.json: ", "$[0].translation"),
    ),
    "size below 0": (
        change_first("sample_annotation", size=[-1, -1, -1]),
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
    "name twice": (change_all("scene", name="scene-0000"), ("scene.json: scene-0001", "name")),
    "name of a path": (change_first("scene", name="../up"), ("scene.json: ", "$[0].name")),
    "file outside": (
        change_first("sample_data", filename="samples/../../secret.jpg"),
        ("sample_data.json: ", "$[0].filename"),
    ),
    "file outside, in lines": (
        change_first("sample_data", filename="a\n/../../secret"),
        ("$[0].filename",),
    ),
    "file of the root": (change_first("sample_data", filename="/etc/passwd"), ("$[0].filename",)),
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


def write_damaged(dataroot: Dataroot, folder: Path, name: str) -> Path:
    tables = json.loads(json.dumps(dataroot.tables))
    DAMAGES[name][0](tables)
    Dataroot(folder, dataroot.version, tables).write()
    (folder / dataroot.version / "splits.json").write_text("{}")
    return folder


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_tables_are_refused_by_file_row_and_field(
    dataroot: Dataroot, tmp_path: Path, name: str
) -> None:
    folder = write_damaged(dataroot, tmp_path / "road", name)
    message_parts = (*DAMAGES[name][1], str(folder), "unpack the tables again")
    assert_raises((lambda: open_nuscenes(folder), DatarootError, message_parts))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'[{"token": ', "is not JSON (line 1"),
        (b"\xff\xfe[]", "not UTF-8"),
        (b'[{"token": "a", "x": ' + b"[" * 10_000 + b"]" * 10_000 + b"}]", "nested"),
        (None, "No such file"),
    ],
)
def test_unreadable_tables_are_named(
    dataroot: Dataroot, tmp_path: Path, content: bytes | None, message: str
) -> None:
    folder = Dataroot(tmp_path / "road", dataroot.version, dataroot.tables).write()
    table = folder / dataroot.version / "category.json"
    table.unlink()
    if content is not None:
        table.write_bytes(content)
    message_parts = (str(table), message, "unpack the tables again")
    assert_raises((lambda: open_nuscenes(folder), DatarootError, message_parts))


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        ({"train": ["scene-0000"], "val": ["scene-0000"]}, "scene-0000 is in train and in val"),
        ({"train": "scene-0000"}, "array"),
        ([], "object"),
    ],
)
def test_contradictory_splits_are_refused(
    dataroot: Dataroot, tmp_path: Path, splits: Any, message: str
) -> None:
    folder = Dataroot(tmp_path / "road", dataroot.version, dataroot.tables).write()
    path = folder / dataroot.version / "splits.json"
    path.write_text(json.dumps(splits))
    assert_raises((lambda: open_nuscenes(folder), DatarootError, (str(path), message)))


def test_a_restored_table_is_read_again(dataroot: Dataroot, tmp_path: Path) -> None:
    """Size and modification time are as before; only the file system's change time differs."""
    folder = Dataroot(tmp_path / "road", dataroot.version, dataroot.tables).write()
    (folder / dataroot.version / "splits.json").write_text('{"train": ["scene-0000"]}')
    town_before = open_nuscenes(folder).scenario[0]["town"]

    table = folder / dataroot.version / "log.json"
    state = table.stat()
    table.write_text(table.read_text().replace("singapore-onenorth", "singapore-queenstn"))
    os.utime(table, ns=(state.st_atime_ns, state.st_mtime_ns))
    town_after = open_nuscenes(folder).scenario[0]["town"]

    assert town_before == "singapore-onenorth"
    assert town_after == "singapore-queenstn"


def test_a_dataroot_opened_by_the_nuscenes_devkit_is_accepted(
    dataroot: Dataroot, release: NuScenesRelease
) -> None:
    class Opened:
        table_root = str(dataroot.tables_folder)

    assert release_of(Opened()).scenario[0] == release.scenario[0]
