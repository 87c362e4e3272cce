"""A nuScenes dataroot is opened as a release that says what the nuScenes devkit says, from tables
that are kept.
"""

import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from nuscenes import NuScenes
from nuscenes.utils.splits import create_splits_scenes
from nuscenes_dataroots import write_dataroot
from nuscenes_mistakes import VERSION, copied, rows_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ConfigError,
    DatarootError,
    MissingExtraError,
    MissingFileError,
    SensorFileError,
    VersionError,
)
from deepaccident_devkit.plugins.nuscenes import CLASSES, open_nuscenes, release_of
from deepaccident_devkit.taxonomy import IGNORED_ID
from deepaccident_devkit.training.torch import V2XConfig, V2XDataset


def test_tables_are_kept_and_need_no_nuscenes_devkit(pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nuscenes", None)
    again = open_nuscenes(pair.folder / VERSION)
    assert again.tables_folder == pair.road.tables_folder
    assert pickle.loads(pickle.dumps(again)).sample[3] == again.sample[3]


def test_only_the_official_splits_need_the_nuscenes_devkit(
    pair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("nuscenes", "nuscenes.utils.splits"):
        monkeypatch.setitem(sys.modules, name, None)
    folder = copied(pair.folder, tmp_path / "road")
    assert open_nuscenes(folder).scenario[0] == pair.road.scenario[0]
    (folder / VERSION / "splits.json").unlink()
    words = (r"numpy 1\.26", r"pip install 'deepaccident_devkit\[nuscenes\]'", r"splits\.json")
    with pytest.raises(MissingExtraError, match=".*".join(words)):
        open_nuscenes(folder)


def test_the_official_splits_are_the_nuscenes_devkits(tmp_path: Path) -> None:
    listed = create_splits_scenes()
    made = write_dataroot(tmp_path / "road", splits=("train", "val"))
    for row, split in zip(made.tables["scene"], ("train", "val"), strict=True):
        row["name"] = listed[split][0]
    made.write()
    (made.tables_folder / "splits.json").unlink()
    assert [record["split"] for record in open_nuscenes(made.folder).scenario] == ["train", "val"]


@pytest.mark.parametrize("seed", range(3))
def test_a_dataroot_written_by_hand_says_what_the_nuscenes_devkit_says(
    tmp_path: Path, seed: int
) -> None:
    """Keyframes at odd times, objects that are not at all of them, sweeps, classes that we lack."""
    made = write_dataroot(tmp_path / "road", seed=seed)
    nusc = NuScenes(made.version, str(made.folder), verbose=False)
    road = release_of(nusc)
    known = 0
    for record in road.with_ignored.sample:
        if not record["labelled"]:
            continue
        sample = nusc.get("sample", road.nuscenes_token(record["token"]))
        first = nusc.get("sample", nusc.get("scene", sample["scene_token"])["first_sample_token"])
        assert record["timestamp"] == pytest.approx(
            (sample["timestamp"] - first["timestamp"]) * 1e-6, abs=1e-6
        )
        pose = nusc.get(
            "ego_pose", nusc.get("sample_data", sample["data"]["LIDAR_TOP"])["ego_pose_token"]
        )
        np.testing.assert_allclose(
            road.world_from(record["token"], "ego").translation, pose["translation"], atol=1e-9
        )
        rows = [nusc.get("sample_annotation", token) for token in sample["anns"]]
        boxes = road.with_ignored.boxes(record["token"])
        np.testing.assert_allclose(boxes.center, [row["translation"] for row in rows], atol=1e-8)
        np.testing.assert_allclose(boxes.size[:, [1, 0, 2]], [row["size"] for row in rows])
        velocity = np.array([nusc.box_velocity(row["token"])[:2] for row in rows])
        np.testing.assert_allclose(boxes.velocity[:, :2], velocity, atol=1e-8)
        known += int(np.isfinite(velocity).all(axis=1).sum())
        counted = [row["num_lidar_pts"] for row in rows if row["category_name"] in CLASSES]
        np.testing.assert_array_equal(road.boxes(record["token"]).num_lidar_pts, counted)
    assert known > 100


def test_splits_and_names_are_the_exports(pair) -> None:
    for split in ("train", "val"):
        ours = {
            pair.ours[f"{scene}/ego_vehicle/001"].rsplit("/", 2)[0]
            for scene in pair.road.split_scenarios(split)
        }
        assert ours == pair.release.split_scenarios(split)
    assert {record["town"] for record in pair.road.scenario} == {
        record["town"] for record in pair.release.scenario
    }
    assert (pair.road.layout, pair.road.version) == ("nuScenes", VERSION)


def test_what_is_no_dataroot_of_nuscenes(pair, tmp_path: Path) -> None:
    with pytest.raises(DatarootError, match=r"has no tables of nuScenes"):
        open_nuscenes(tmp_path)
    with pytest.raises(
        DatarootError, match=r"is a dataroot of nuScenes; open it with nuscenes\.open_nuscenes"
    ):
        DeepAccident("v1", pair.folder)
    both = copied(pair.folder, tmp_path / "two")
    shutil.copytree(both / VERSION, both / "v1.0-other")
    with pytest.raises(VersionError, match=r"several versions"):
        open_nuscenes(both)
    assert open_nuscenes(both / "v1.0-other").version == "v1.0-other"


def test_classes_that_we_lack_are_ignored_and_not_background(pair, tmp_path: Path) -> None:
    folder = copied(pair.folder, tmp_path / "road")
    with rows_of(folder, "category") as categories:
        for row in categories:
            row["name"] = {"vehicle.truck": "vehicle.bus.rigid", "vehicle.bicycle": "animal"}.get(
                row["name"], row["name"]
            )
    road = open_nuscenes(folder)
    every = road.with_ignored.columns("annotation")
    ignored = every["actor_id"] >= IGNORED_ID
    before = pair.road.columns("annotation")["category"]
    np.testing.assert_array_equal(ignored, np.isin(before, [1, 3]))
    assert {*every["category"][ignored].tolist()} == {
        1,
        5,
    }  # a bus is most like a truck, an animal like a pedestrian
    assert {*road.columns("annotation")["category"].tolist()} == {0, 4, 5}
    config = V2XConfig(labels=None, visible=None)
    [item] = V2XDataset(road, [road.sample[0]["token"]], config)
    boxes = road.with_ignored.boxes(road.sample[0]["token"], "ego")
    expected = np.where(boxes.actor_id >= IGNORED_ID, -1, boxes.category)
    np.testing.assert_array_equal(item["categories"].numpy(), expected)
    assert -1 in expected


def test_intensities_of_nuscenes_become_shares(pair, tmp_path: Path) -> None:
    folder = copied(pair.folder, tmp_path / "road")
    token = pair.road.sample[0]["token"]
    file = pair.road.sensor_path(token, "lidar01").relative_to(pair.folder)
    content = np.fromfile(pair.folder / file, dtype="<f4").reshape(-1, 5)
    (folder / "samples").unlink()
    shutil.copytree(
        pair.folder / "samples", folder / "samples", symlinks=False, copy_function=shutil.copyfile
    )
    content[:, 3] = np.linspace(0, 255, len(content), dtype=np.float32)
    content.tofile(folder / file)
    road = open_nuscenes(folder)
    cloud = road.load_point_cloud(token, "ego")
    np.testing.assert_allclose(cloud.intensity, np.linspace(0, 1, len(content)), atol=1e-6)
    np.testing.assert_allclose(cloud.xyz, pair.road.load_point_cloud(token, "ego").xyz)
    (folder / file).write_bytes(b"1234" * 7)
    with pytest.raises(SensorFileError, match=r"expected points of five numbers"):
        road.load_point_cloud(token)


def test_moments_between_keyframes_have_poses_alone(pair) -> None:
    key = pair.road.sample[0]["token"]
    between = f"{key[:-3]}003"
    where = [pair.road.world_from(f"{key[:-3]}{frame:03d}", "ego") for frame in (1, 3, 6)]
    middle = 0.6 * where[0].translation + 0.4 * where[2].translation
    np.testing.assert_allclose(where[1].translation, middle, atol=1e-9)
    assert len(pair.road.boxes(between)) == 0
    with pytest.raises(MissingFileError, match=between.rsplit("/", 1)[1]):
        pair.road.load_point_cloud(between)
    with pytest.raises(ConfigError, match=r"between two keyframes"):
        pair.road.nuscenes_token(between)
