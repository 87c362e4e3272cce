"""A nuScenes dataroot opens as a release that agrees with the nuScenes devkit."""

import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from nuscenes import NuScenes
from nuscenes.utils.splits import create_splits_scenes
from support.nuscenes_dataroots import write_dataroot
from support.nuscenes_mistakes import VERSION, copy_dataroot, read_rows

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
    folder = copy_dataroot(pair.folder, tmp_path / "road")
    assert open_nuscenes(folder).scenario[0] == pair.road.scenario[0]

    (folder / VERSION / "splits.json").unlink()
    with pytest.raises(
        MissingExtraError,
        match=r"numpy 1\.26.*pip install 'deepaccident_devkit\[nuscenes\]'.*splits\.json",
    ):
        open_nuscenes(folder)


def test_the_official_splits_are_the_nuscenes_devkits(tmp_path: Path) -> None:
    scenes_by_split = create_splits_scenes()
    dataroot = write_dataroot(tmp_path / "road", splits=("train", "val"))
    for row, split in zip(dataroot.tables["scene"], ("train", "val"), strict=True):
        row["name"] = scenes_by_split[split][0]
    dataroot.write()
    (dataroot.tables_folder / "splits.json").unlink()

    road = open_nuscenes(dataroot.folder)

    assert [record["split"] for record in road.scenario] == ["train", "val"]


@pytest.mark.parametrize("seed", range(3))
def test_a_handwritten_dataroot_agrees_with_the_nuscenes_devkit(tmp_path: Path, seed: int) -> None:
    """The dataroot has irregular keyframes, objects that miss some of them, sweeps, and classes
    that we lack.
    """
    dataroot = write_dataroot(tmp_path / "road", seed=seed)
    nusc = NuScenes(
        dataroot.version,
        str(dataroot.folder),
        verbose=False,
    )
    road = release_of(nusc)
    num_known_velocities = 0
    for record in road.with_ignored.sample:
        if not record["labelled"]:
            continue
        sample = nusc.get("sample", road.nuscenes_token(record["token"]))
        scene = nusc.get("scene", sample["scene_token"])
        first = nusc.get("sample", scene["first_sample_token"])
        time_s = (sample["timestamp"] - first["timestamp"]) * 1e-6

        assert record["timestamp"] == pytest.approx(time_s, abs=1e-6)

        data = nusc.get("sample_data", sample["data"]["LIDAR_TOP"])
        position = nusc.get("ego_pose", data["ego_pose_token"])["translation"]
        world_from_ego = road.world_from(record["token"], "ego")
        np.testing.assert_allclose(world_from_ego.translation, position, atol=1e-9)

        rows = [nusc.get("sample_annotation", token) for token in sample["anns"]]
        boxes = road.with_ignored.boxes(record["token"])
        np.testing.assert_allclose(
            boxes.center,
            [row["translation"] for row in rows],
            atol=1e-8,
        )
        np.testing.assert_allclose(boxes.size[:, [1, 0, 2]], [row["size"] for row in rows])

        velocity = np.array([nusc.box_velocity(row["token"])[:2] for row in rows])
        np.testing.assert_allclose(
            boxes.velocity[:, :2],
            velocity,
            atol=1e-8,
        )

        num_known_velocities += int(np.isfinite(velocity).all(axis=1).sum())

        num_points = [row["num_lidar_pts"] for row in rows if row["category_name"] in CLASSES]
        np.testing.assert_array_equal(road.boxes(record["token"]).num_lidar_pts, num_points)

    assert num_known_velocities > 100


def test_splits_and_names_are_the_exports(pair) -> None:
    for split in ("train", "val"):
        scenarios = set()
        for scene in pair.road.split_scenarios(split):
            sample = pair.ours[f"{scene}/ego_vehicle/001"]
            scenarios.add(sample.rsplit("/", 2)[0])
        assert scenarios == pair.release.split_scenarios(split)

    road_towns = {record["town"] for record in pair.road.scenario}

    assert road_towns == {record["town"] for record in pair.release.scenario}
    assert pair.road.layout == "nuScenes"
    assert pair.road.version == VERSION


def test_other_folders_are_refused_as_nuscenes_dataroots(pair, tmp_path: Path) -> None:
    with pytest.raises(DatarootError, match=r"has no tables of nuScenes"):
        open_nuscenes(tmp_path)

    with pytest.raises(
        DatarootError, match=r"is a nuScenes dataroot; open it with nuscenes\.open_nuscenes"
    ):
        DeepAccident("v1", pair.folder)

    both = copy_dataroot(pair.folder, tmp_path / "two")
    shutil.copytree(both / VERSION, both / "v1.0-other")
    with pytest.raises(VersionError, match=r"several versions"):
        open_nuscenes(both)
    assert open_nuscenes(both / "v1.0-other").version == "v1.0-other"


def test_classes_that_we_lack_are_ignored_and_not_background(pair, tmp_path: Path) -> None:
    folder = copy_dataroot(pair.folder, tmp_path / "road")
    new_names = {"vehicle.truck": "vehicle.bus.rigid", "vehicle.bicycle": "animal"}
    with read_rows(folder, "category") as categories:
        for row in categories:
            row["name"] = new_names.get(row["name"], row["name"])
    road = open_nuscenes(folder)
    annotations = road.with_ignored.columns("annotation")
    is_ignored = annotations["actor_id"] >= IGNORED_ID
    old_categories = pair.road.columns("annotation")["category"]

    np.testing.assert_array_equal(is_ignored, np.isin(old_categories, [1, 3]))
    # a bus is most like a truck, and an animal is most like a pedestrian
    assert set(annotations["category"][is_ignored].tolist()) == {1, 5}
    assert set(road.columns("annotation")["category"].tolist()) == {0, 4, 5}

    token = road.sample[0]["token"]
    [item] = V2XDataset(
        road,
        [token],
        V2XConfig(labels=None, visible=None),
    )
    boxes = road.with_ignored.boxes(token, "ego")
    expected = np.where(
        boxes.actor_id >= IGNORED_ID,
        -1,
        boxes.category,
    )

    np.testing.assert_array_equal(item["categories"].numpy(), expected)
    assert -1 in expected


def test_intensities_of_nuscenes_become_shares(pair, tmp_path: Path) -> None:
    folder = copy_dataroot(pair.folder, tmp_path / "road")
    token = pair.road.sample[0]["token"]
    file = pair.road.sensor_path(token, "lidar01").relative_to(pair.folder)
    points = np.fromfile(pair.folder / file, dtype="<f4").reshape(-1, 5)
    samples = folder / "samples"
    samples.unlink()
    shutil.copytree(
        pair.folder / "samples",
        samples,
        copy_function=shutil.copyfile,
    )
    points[:, 3] = np.linspace(
        0,
        255,
        len(points),
        dtype=np.float32,
    )
    points.tofile(folder / file)

    road = open_nuscenes(folder)
    cloud = road.load_point_cloud(token, "ego")

    np.testing.assert_allclose(
        cloud.intensity,
        np.linspace(0, 1, len(points)),
        atol=1e-6,
    )
    np.testing.assert_allclose(cloud.xyz, pair.road.load_point_cloud(token, "ego").xyz)

    (folder / file).write_bytes(b"1234" * 7)
    with pytest.raises(SensorFileError, match=r"expected points of five numbers"):
        road.load_point_cloud(token)


def test_moments_between_keyframes_have_only_poses(pair) -> None:
    prefix = pair.road.sample[0]["token"][:-3]
    between = f"{prefix}003"
    positions = [
        pair.road.world_from(f"{prefix}{frame:03d}", "ego").translation for frame in (1, 3, 6)
    ]
    interpolated = 0.6 * positions[0] + 0.4 * positions[2]

    np.testing.assert_allclose(positions[1], interpolated, atol=1e-9)
    assert len(pair.road.boxes(between)) == 0
    with pytest.raises(MissingFileError, match=between.rsplit("/", 1)[1]):
        pair.road.load_point_cloud(between)
    with pytest.raises(ConfigError, match=r"between two keyframes"):
        pair.road.nuscenes_token(between)
