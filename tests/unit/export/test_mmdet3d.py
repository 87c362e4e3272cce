"""The infos of mmdet3d, read by a reader that knows mmdet3d's conventions and not the devkit."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.export import export
from deepaccident_devkit.errors import ConfigError, ExportError
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.mmdet3d import NUSCENES_CLASSES, Mmdet3d
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID

pytestmark = pytest.mark.slow

Info = dict[str, Any]


def exported_to(da: DeepAccident, folder: Path, **choices: Any) -> Exported:
    export_release(da, folder, NuScenes(**choices), workers=1)
    return export_release(da, folder, Mmdet3d(**choices), workers=1)


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return exported_to(da, tmp_path_factory.mktemp("mmdet3d") / "out")


def infos(folder: Path, split: str = "val") -> list[Info]:
    content = pickle.loads((folder / f"deepaccident_infos_{split}.pkl").read_bytes())
    assert content["metainfo"]["categories"]["barrier"] == 9
    found: list[Info] = content["data_list"]
    return found


def points_of(folder: Path, info: Info) -> np.ndarray:
    path = folder / "samples" / "LIDAR_TOP" / info["lidar_points"]["lidar_path"]
    return np.fromfile(path, dtype="<f4").reshape(-1, info["lidar_points"]["num_pts_feats"])[:, :3]


def points_in(box: np.ndarray, points: np.ndarray) -> int:
    """As mmdet3d has boxes: y to the left, a heading of (cos yaw, sin yaw), full lengths,
    centres.
    """
    x, y, z = (points - box[:3]).T
    cos, sin = np.cos(box[6]), np.sin(box[6])
    length, width, height = box[3:6] / 2 + 1e-4
    along, across = x * cos + y * sin, y * cos - x * sin
    return int(
        ((np.abs(along) <= length) & (np.abs(across) <= width) & (np.abs(z) <= height)).sum()
    )


def disagreement(folder: Path) -> float:
    """The share of seen boxes that do not hold as many points as their labels say."""
    wrong = total = 0
    for info in infos(folder):
        points = points_of(folder, info)
        for instance in info["instances"]:
            box, count = np.array(instance["bbox_3d"]), instance["num_lidar_pts"]
            if count:
                wrong += abs(points_in(box, points) - count) > 1 + 0.02 * count
                total += 1
    assert total > 50
    return wrong / total


def test_boxes_hold_the_points_that_their_labels_count(exported: Exported) -> None:
    assert disagreement(exported.folder) == 0


def test_an_info_is_a_sample_of_the_tables_with_its_files(
    da: DeepAccident, exported: Exported
) -> None:
    rows = json.loads((exported.folder / "v1.0-deepaccident" / "sample.json").read_text())
    data = json.loads((exported.folder / "v1.0-deepaccident" / "sample_data.json").read_text())
    names = {row["token"]: Path(row["filename"]) for row in data}
    splits = [infos(exported.folder, split) for split in ("train", "val")]
    assert [[info["sample_idx"] for info in each] for each in splits] == [
        [*range(len(each))] for each in splits
    ]
    found = {info["token"]: info for each in splits for info in each}
    assert set(found) == {row["token"] for row in rows}
    for row in rows:
        info = found[row["token"]]
        told = "{scenario}/{agent}/{frame:03d}".format(**info["deepaccident"]), info["timestamp"]
        assert told == (row["deepaccident_token"], row["timestamp"] / 1e6)
        for channel, image in info["images"].items():
            path = Path("samples", channel, image["img_path"])
            assert (names[image["sample_data_token"]], (exported.folder / path).is_file()) == (
                path,
                True,
            )
        for sweep in info["lidar_sweeps"]:
            assert str(names[sweep["sample_data_token"]]) == sweep["lidar_points"]["lidar_path"]
    assert exported.tally.samples == len(rows) == 2 * len(AGENTS) * len(da.scenario)


def test_labels_are_nuscenes_own(da: DeepAccident, exported: Exported, tmp_path: Path) -> None:
    trucks = exported_to(da, tmp_path / "trucks", agents=("ego_vehicle",), van="truck")
    for folder, van in ((exported.folder, "car"), (trucks.folder, "truck")):
        instances = [
            each
            for split in ("train", "val")
            for info in infos(folder, split)
            for each in info["instances"]
        ]
        named = {
            (each["category"], NUSCENES_CLASSES[each[key]])
            for each in instances
            for key in ("bbox_label_3d", "bbox_label")
        }
        ours = {category for category, _ in named}
        assert (
            named
            == {(each, {"van": van, "cyclist": "bicycle"}.get(each, each)) for each in ours}
            > {("van", van)}
        )


def test_velocities_are_of_the_positions(da: DeepAccident, exported: Exported) -> None:
    info = infos(exported.folder)[1]
    boxes = da.boxes(
        "{scenario}/{agent}/{frame:03d}".format(**info["deepaccident"]), "lidar", velocity="derived"
    )
    others = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    assert_allclose([each["velocity"] for each in info["instances"]], others.velocity[:, :2])
    assert np.isfinite(others.velocity).all(axis=1).sum() > 3


def test_sweeps_are_the_clouds_before_newest_first(exported: Exported) -> None:
    first, last = (
        next(info for info in infos(exported.folder) if info["deepaccident"]["frame"] == n)
        for n in (1, 6)
    )
    assert first["lidar_sweeps"] == []
    ages = [last["timestamp"] - sweep["timestamp"] for sweep in last["lidar_sweeps"]]
    assert_allclose(ages, [0.1, 0.2, 0.3, 0.4, 0.5], atol=1e-6)
    folders = [sweep["lidar_points"]["lidar_path"].split("/")[0] for sweep in last["lidar_sweeps"]]
    assert folders == ["sweeps"] * 4 + ["samples"]


def test_axes_of_nuscenes_turn_boxes_clouds_and_poses(
    da: DeepAccident, exported: Exported, tmp_path: Path
) -> None:
    turned = exported_to(
        da, tmp_path / "turned", lidar_axes="nuscenes", split="val", agents=("ego_vehicle",)
    )
    assert disagreement(turned.folder) == 0
    ours, theirs = infos(exported.folder)[1], infos(turned.folder)[1]
    for one, other in zip(ours["instances"], theirs["instances"], strict=True):
        in_world, again = (
            np.array(info["ego2global"])
            @ info["lidar_points"]["lidar2ego"]
            @ [*instance["bbox_3d"][:3], 1]
            for info, instance in ((ours, one), (theirs, other))
        )
        assert_allclose(in_world, again, atol=1e-6)
        assert_allclose(other["velocity"], [-one["velocity"][1], one["velocity"][0]], atol=1e-9)


def test_a_partial_release_is_written_and_counted(da_partial: DeepAccident, tmp_path: Path) -> None:
    made = exported_to(da_partial, tmp_path / "out")
    assert made.tally.left_out["images that are not in this release"] == 2 * len(
        da_partial.scenario
    )
    found = infos(made.folder)
    assert {info["deepaccident"]["agent"] for info in found} == set(AGENTS) - {
        "other_vehicle_behind"
    }
    for info in found:
        agent, first = info["deepaccident"]["agent"], info["deepaccident"]["frame"] == 1
        there = "CAM_FRONT" in info["images"], info["lidar_sweeps"] == []
        assert there == (agent != "ego_vehicle", agent == "infrastructure" or first)


def test_without_labels_there_are_no_instances_and_without_a_split_another_file(
    own_release: Path, tmp_path: Path
) -> None:
    for path in own_release.glob("test/*/*/label/*/*.txt"):
        path.unlink()
    for path in own_release.glob("*.txt"):
        path.unlink()
    (own_release / "train" / "type1_subtype1_accident").rename(
        own_release / "type1_subtype1_accident"
    )
    made = exported_to(
        DeepAccident("v1", own_release, verbose=False), tmp_path / "out", agents=("ego_vehicle",)
    )
    assert "deepaccident_infos_unknown.pkl" in {path.name for path in made.folder.glob("*.pkl")}
    assert [info["instances"] for info in infos(made.folder, "test")] == [[]] * 2


def test_a_folder_without_that_nuscenes_export_is_refused(da: DeepAccident, tmp_path: Path) -> None:
    new, other, ego = tmp_path / "new", tmp_path / "other", ("ego_vehicle",)
    export_release(da, other, NuScenes(agents=ego, sweeps=False))
    assert_refused(
        (
            lambda: export_release(da, new, Mmdet3d()),
            ExportError,
            "holds no complete nuscenes export",
        ),
        (
            lambda: export_release(da, other, Mmdet3d(agents=ego)),
            ConfigError,
            "export to nuscenes with other settings",
        ),
    )
    assert not new.exists()


def test_the_command_makes_the_nuscenes_export_too(da: DeepAccident, tmp_path: Path) -> None:
    where = ("--out", str(tmp_path / "out"), "--split", "val", "--agents", "ego_vehicle")
    for told in ("2 scenarios written now", "0 scenarios written now, 2 were there already"):
        run = CliRunner().invoke(export, ["mmdet3d", str(da.dataroot), *where, "--workers", "1"])
        assert run.exit_code == 0, run.output
        assert run.output.count(told) == 2
    assert len(infos(tmp_path / "out")) == 4
    assert (tmp_path / "out" / "v1.0-deepaccident" / "sample.json").is_file()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--style", "released", "--van", "car"), "--van changes nothing with --style released"),
        (("--style", "released", "--no-sweeps"), "--sweeps changes nothing with --style released"),
        (("--drop-empty",), "--drop-empty changes nothing without --style released"),
        (("--root-prefix", "./a/b"), "--root-prefix changes nothing without --style released"),
    ],
)
def test_options_of_the_other_style_are_refused(
    tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    run = CliRunner().invoke(
        export, ["mmdet3d", str(tmp_path), "--out", str(tmp_path / "out"), *words]
    )
    assert (run.exit_code, sentence in run.output) == (2, True)
