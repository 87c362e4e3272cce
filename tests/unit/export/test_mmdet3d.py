"""Read the infos of mmdet3d by mmdet3d's conventions, without the devkit."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support.box_points import count_points_in_box
from support.command_calls import invoke_command
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, ExportError
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.mmdet3d import NUSCENES_CLASSES, Mmdet3d
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID

pytestmark = pytest.mark.slow

Info = dict[str, Any]


def export_both(da: DeepAccident, folder: Path, **choices: Any) -> Exported:
    """Export to nuScenes, and then to mmdet3d into the same folder."""
    export_release(da, folder, NuScenes(**choices), workers=1)
    return export_release(da, folder, Mmdet3d(**choices), workers=1)


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export_both(da, tmp_path_factory.mktemp("mmdet3d") / "out")


def read_infos(folder: Path, split: str = "val") -> list[Info]:
    content = pickle.loads((folder / f"deepaccident_infos_{split}.pkl").read_bytes())
    assert content["metainfo"]["categories"]["barrier"] == 9
    infos: list[Info] = content["data_list"]
    return infos


def assert_boxes_hold_points(folder: Path) -> None:
    """Assert that the seen boxes hold the points that their labels count."""
    num_seen = 0
    for info in read_infos(folder):
        cloud = info["lidar_points"]
        values = np.fromfile(folder / "samples" / "LIDAR_TOP" / cloud["lidar_path"], dtype="<f4")
        points = values.reshape(-1, cloud["num_pts_feats"])[:, :3]
        for instance in info["instances"]:
            expected = instance["num_lidar_pts"]
            if expected:
                box = np.array(instance["bbox_3d"])
                count = count_points_in_box(box, points, margin_m=1e-4)
                assert abs(count - expected) <= 1 + 0.02 * expected
                num_seen += 1

    assert num_seen > 50


def test_boxes_hold_the_points_that_their_labels_count(exported: Exported) -> None:
    assert_boxes_hold_points(exported.folder)


def test_an_info_is_a_sample_of_the_tables_with_its_files(
    da: DeepAccident, exported: Exported
) -> None:
    tables = exported.folder / "v1.0-deepaccident"
    samples = json.loads((tables / "sample.json").read_text())
    data_rows = json.loads((tables / "sample_data.json").read_text())
    filenames = {row["token"]: row["filename"] for row in data_rows}
    infos_by_token = {}
    for split in ("train", "val"):
        for index, info in enumerate(read_infos(exported.folder, split)):
            assert info["sample_idx"] == index
            infos_by_token[info["token"]] = info

    assert infos_by_token.keys() == {row["token"] for row in samples}

    for row in samples:
        info = infos_by_token[row["token"]]
        assert name_sample(info) == row["deepaccident_token"]
        assert info["timestamp"] == row["timestamp"] / 1e6
        for channel, image in info["images"].items():
            filename = f"samples/{channel}/{image['img_path']}"
            assert filenames[image["sample_data_token"]] == filename
            assert (exported.folder / filename).is_file()
        for sweep in info["lidar_sweeps"]:
            assert filenames[sweep["sample_data_token"]] == sweep["lidar_points"]["lidar_path"]

    assert exported.tally.samples == len(samples) == 2 * len(AGENTS) * len(da.scenario)


def name_sample(info: Info) -> str:
    return "{scenario}/{agent}/{frame:03d}".format(**info["deepaccident"])


def test_labels_are_nuscenes_own(da: DeepAccident, exported: Exported, tmp_path: Path) -> None:
    trucks = export_both(da, tmp_path / "trucks", agents=("ego_vehicle",), van="truck")
    for folder, van in ((exported.folder, "car"), (trucks.folder, "truck")):
        new_names = {"van": van, "cyclist": "bicycle"}
        categories = set()
        for info in read_infos(folder, "train") + read_infos(folder, "val"):
            for instance in info["instances"]:
                category = instance["category"]
                categories.add(category)
                expected = new_names.get(category, category)
                assert NUSCENES_CLASSES[instance["bbox_label_3d"]] == expected
                assert NUSCENES_CLASSES[instance["bbox_label"]] == expected

        assert categories > {"van"}


def test_velocities_are_of_the_positions(da: DeepAccident, exported: Exported) -> None:
    info = read_infos(exported.folder)[1]
    boxes = da.boxes(name_sample(info), "lidar", velocity="derived")
    other_boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    velocities = [instance["velocity"] for instance in info["instances"]]
    assert_allclose(velocities, other_boxes.velocity[:, :2])
    assert np.isfinite(other_boxes.velocity).all(axis=1).sum() > 3


def test_sweeps_are_the_clouds_before_newest_first(exported: Exported) -> None:
    infos = read_infos(exported.folder)
    first = next(info for info in infos if info["deepaccident"]["frame"] == 1)
    last = next(info for info in infos if info["deepaccident"]["frame"] == 6)
    assert first["lidar_sweeps"] == []

    sweeps = last["lidar_sweeps"]
    ages_s = [last["timestamp"] - sweep["timestamp"] for sweep in sweeps]
    assert_allclose(ages_s, [0.1, 0.2, 0.3, 0.4, 0.5], atol=1e-6)

    folders = [sweep["lidar_points"]["lidar_path"].split("/")[0] for sweep in sweeps]
    assert folders == ["sweeps"] * 4 + ["samples"]


def test_axes_of_nuscenes_turn_boxes_clouds_and_poses(
    da: DeepAccident, exported: Exported, tmp_path: Path
) -> None:
    choices = {"lidar_axes": "nuscenes", "split": "val", "agents": ("ego_vehicle",)}
    turned = export_both(da, tmp_path / "turned", **choices)
    assert_boxes_hold_points(turned.folder)

    info = read_infos(exported.folder)[1]
    turned_info = read_infos(turned.folder)[1]
    for instance, turned_instance in zip(info["instances"], turned_info["instances"], strict=True):
        center = center_in_world(info, instance)
        assert_allclose(center, center_in_world(turned_info, turned_instance), atol=1e-6)
        vx, vy = instance["velocity"]
        assert_allclose(
            turned_instance["velocity"],
            [-vy, vx],
            atol=1e-9,
        )


def center_in_world(info: Info, instance: dict[str, Any]) -> np.ndarray:
    world_from_lidar = np.array(info["ego2global"]) @ info["lidar_points"]["lidar2ego"]
    return world_from_lidar @ [*instance["bbox_3d"][:3], 1]


def test_a_partial_release_is_written_and_counted(da_partial: DeepAccident, tmp_path: Path) -> None:
    done = export_both(da_partial, tmp_path / "out")
    num_missing = done.tally.left_out["images that are not in this release"]
    assert num_missing == 2 * len(da_partial.scenario)

    agents = set()
    for info in read_infos(done.folder):
        agent = info["deepaccident"]["agent"]
        agents.add(agent)
        assert ("CAM_FRONT" in info["images"]) == (agent != "ego_vehicle")
        is_first = info["deepaccident"]["frame"] == 1
        assert (info["lidar_sweeps"] == []) == (agent == "infrastructure" or is_first)

    assert agents == set(AGENTS) - {"other_vehicle_behind"}


def test_without_labels_there_are_no_instances_and_without_a_split_another_file(
    own_release: Path, tmp_path: Path
) -> None:
    for path in own_release.glob("test/*/*/label/*/*.txt"):
        path.unlink()
    for path in own_release.glob("*.txt"):
        path.unlink()
    folder = own_release / "train" / "type1_subtype1_accident"
    folder.rename(own_release / folder.name)
    dataset = DeepAccident("v1", own_release, verbose=False)
    done = export_both(dataset, tmp_path / "out", agents=("ego_vehicle",))

    assert (done.folder / "deepaccident_infos_unknown.pkl").exists()
    assert [info["instances"] for info in read_infos(done.folder, "test")] == [[]] * 2


def test_a_folder_without_that_nuscenes_export_is_refused(da: DeepAccident, tmp_path: Path) -> None:
    new = tmp_path / "new"
    other = tmp_path / "other"
    ego = ("ego_vehicle",)
    export_release(da, other, NuScenes(agents=ego, sweeps=False))

    assert_raises(
        (
            lambda: export_release(da, new, Mmdet3d()),
            ExportError,
            "contains no complete nuscenes export",
        ),
        (
            lambda: export_release(da, other, Mmdet3d(agents=ego)),
            ConfigError,
            "nuscenes export with other settings",
        ),
    )
    assert not new.exists()


def test_the_command_makes_the_nuscenes_export_too(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ("--split", "val", "--agents", "ego_vehicle", "--workers", 1)
    for message in ("2 scenarios new", "0 scenarios new, 2 already there"):
        result = invoke_command("export", "mmdet3d", da.dataroot, "--out", out, *options)
        assert result.output.count(message) == 2

    assert len(read_infos(out)) == 4
    assert (out / "v1.0-deepaccident" / "sample.json").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--style", "released", "--van", "car"), "--van has no effect with --style released"),
        (("--style", "released", "--no-sweeps"), "--sweeps has no effect with --style released"),
        (("--drop-empty",), "--drop-empty has no effect without --style released"),
        (("--root-prefix", "./a/b"), "--root-prefix has no effect without --style released"),
    ],
)
def test_options_of_the_other_style_are_refused(
    tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    result = invoke_command(
        "export", "mmdet3d", tmp_path, "--out", tmp_path / "out", *options, status=2
    )
    assert message in result.output
