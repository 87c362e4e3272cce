"""A nuScenes dataroot is opened as a release: once by the nuScenes devkit, then from tables that are kept."""

import json
import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
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
from deepaccident_devkit.nuscenes import open_nuscenes
from deepaccident_devkit.taxonomy import IGNORED_ID


def test_tables_are_kept_and_need_no_nuscenes_devkit(pair, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nuscenes", None)
    again = open_nuscenes(pair.folder / VERSION)
    assert again.tables_folder == pair.road.tables_folder
    assert pickle.loads(pickle.dumps(again)).sample[3] == again.sample[3]


def test_without_the_nuscenes_devkit_the_remedy_is_named(pair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nuscenes", None)
    with pytest.raises(MissingExtraError, match=r"numpy 1\.26.*pip install 'deepaccident_devkit\[nuscenes\]'"):
        open_nuscenes(pair.folder, tmp_path / "elsewhere")


def test_splits_and_names_are_the_exports(pair) -> None:
    for split in ("train", "val"):
        ours = {pair.ours[f"{scene}/ego_vehicle/001"].rsplit("/", 2)[0] for scene in pair.road.split_scenarios(split)}
        assert ours == pair.release.split_scenarios(split)
    assert {record["town"] for record in pair.road.scenario} == {record["town"] for record in pair.release.scenario}
    assert (pair.road.layout, pair.road.version) == ("nuScenes", VERSION)


def test_what_is_no_dataroot_of_nuscenes(pair, tmp_path: Path) -> None:
    with pytest.raises(DatarootError, match=r"has no tables of nuScenes"):
        open_nuscenes(tmp_path)
    with pytest.raises(DatarootError, match=r"is a dataroot of nuScenes; open it with nuscenes\.open_nuscenes"):
        DeepAccident("v1", pair.folder)
    both = copied(pair.folder, tmp_path / "two")
    shutil.copytree(both / VERSION, both / "v1.0-other")
    with pytest.raises(VersionError, match=r"several versions"):
        open_nuscenes(both)
    assert open_nuscenes(both / "v1.0-other").version == "v1.0-other"


@pytest.mark.parametrize("damage", ["no category.json", "half a category.json", "a category too few"])
def test_tables_that_cannot_be_read_are_named(pair, tmp_path: Path, damage: str) -> None:
    folder = copied(pair.folder, tmp_path / "road")
    table = folder / VERSION / "category.json"
    content = json.loads(table.read_text())
    table.unlink()
    if damage != "no category.json":
        table.write_text("[{" if damage == "half a category.json" else json.dumps(content[1:]))
    with pytest.raises(DatarootError, match=rf"{VERSION}: the nuScenes devkit cannot read.*unpack them again"):
        open_nuscenes(folder)


def test_a_sample_that_lacks_a_camera_is_named(pair, tmp_path: Path) -> None:
    folder = copied(pair.folder, tmp_path / "road")
    with rows_of(folder, "sample_data") as files:
        files[:] = [row for row in files if "/CAM_BACK/" not in row["filename"]]
    with pytest.raises(DatarootError, match=r"has no CAM_BACK"):
        open_nuscenes(folder)


@pytest.mark.parametrize("name", ["/etc/passwd", "samples/../../secret.jpg"])
def test_a_file_outside_of_the_dataroot_is_refused(pair, tmp_path: Path, name: str) -> None:
    folder = copied(pair.folder, tmp_path / "road")
    with rows_of(folder, "sample_data") as files:
        for row in files:
            row["filename"] = name if row["is_key_frame"] else row["filename"]
    with pytest.raises(DatarootError, match=r"leads out of the dataroot"):
        open_nuscenes(folder)


def test_classes_that_we_lack_are_ignored_and_not_background(pair, tmp_path: Path) -> None:
    folder = copied(pair.folder, tmp_path / "road")
    with rows_of(folder, "category") as categories:
        for row in categories:
            row["name"] = {"vehicle.truck": "vehicle.bus.rigid", "vehicle.bicycle": "animal"}.get(
                row["name"], row["name"]
            )
    road = open_nuscenes(folder)
    ids, category = road.columns("annotation")["actor_id"], road.columns("annotation")["category"]
    ignored = ids >= IGNORED_ID
    before = pair.road.columns("annotation")["category"]
    np.testing.assert_array_equal(ignored, np.isin(before, [1, 3]))
    assert {*category[ignored].tolist()} == {1, 5}  # a bus is most like a truck, an animal like a pedestrian
    assert {*category[~ignored].tolist()} == {0, 4, 5}


def test_intensities_of_nuscenes_become_shares(pair, tmp_path: Path) -> None:
    folder = copied(pair.folder, tmp_path / "road")
    token = pair.road.sample[0]["token"]
    file = pair.road.sensor_path(token, "lidar01").relative_to(pair.folder)
    content = np.fromfile(pair.folder / file, dtype="<f4").reshape(-1, 5)
    (folder / "samples").unlink()
    shutil.copytree(pair.folder / "samples", folder / "samples", symlinks=False, copy_function=shutil.copyfile)
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
