"""Read the released infos by the released code's conventions, without the devkit."""

import logging
import pickle
import shutil
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.box_points import count_points_in_box
from support.command_calls import invoke_command
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.taxonomy import AGENTS

pytestmark = pytest.mark.slow

Info = dict[str, Any]
ROOT_PREFIX = "./data/DeepAccident_data"


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    out = tmp_path_factory.mktemp("released") / "out"
    return export_release(da, out, ReleasedInfos(), workers=2)


def read_infos(folder: Path, name: str = "val") -> list[Info]:
    content = pickle.loads((folder / f"carla_infos_{name}.pkl").read_bytes())
    infos: list[Info] = content["infos"]
    return infos


def test_boxes_hold_the_points_that_their_labels_count(
    da: DeepAccident, exported: Exported
) -> None:
    """The released code has y to the right and a heading of (cos yaw, −sin yaw)."""
    num_seen = 0
    for info in read_infos(exported.folder):
        path = Path(info["lidar_path"]).relative_to("data/DeepAccident_data")
        with np.load(da.dataroot / path) as archive:
            points = next(iter(archive.values()))[:, :3]
        for box, expected in zip(info["gt_boxes"], info["num_lidar_pts"], strict=True):
            if expected > 0:
                right_handed_box = np.array([*box[:6], -box[6]])
                count = count_points_in_box(right_handed_box, points, margin_m=1e-6)
                assert abs(count - expected) <= 1 + 0.02 * expected
                num_seen += 1

    assert num_seen > 100


def test_every_agents_keyframes_are_there_in_order(da: DeepAccident, exported: Exported) -> None:
    for split in ("train", "val"):
        keyframes = []
        for info in read_infos(exported.folder, split):
            recording = f"{info['scenario_type']}/{info['vehicle_name']}"
            keyframes.append((recording, info["timestamp"]))
        expected = []
        for record, agent in product(da.scenario, AGENTS):
            if record["split"] == split:
                recording = f"{record['scenario_type']}/{agent}"
                expected += [(recording, 1), (recording, 6)]

        assert sorted(keyframes) == sorted(expected)

    assert exported.tally.samples == 2 * len(AGENTS) * len(da.scenario)


@pytest.mark.parametrize("split", ["train_mini", "val_mini"])
def test_mini_splits_have_files_of_their_own(
    da: DeepAccident, exported: Exported, split: str
) -> None:
    content = pickle.loads((exported.folder / f"carla_infos_{split}.pkl").read_bytes())
    assert content["metadata"] == {"version": "v1.0-mini"}
    expected = {token.split("/")[0] for token in da.split_scenarios(split)}
    assert {info["scenario_type"] for info in content["infos"]} == expected


def test_scenarios_of_no_split_or_without_labels_are_left_out_and_counted(
    own_release: Path, tmp_path: Path
) -> None:
    shutil.rmtree(next(own_release.glob("train/*_normal")) / "infrastructure" / "label")
    dataset = DeepAccident("v1", own_release, verbose=False)
    done = export_release(dataset, tmp_path / "out", ReleasedInfos(root_prefix="./DeepAccident"))

    assert done.tally.left_out == {
        "scenarios that are neither in train nor in val": 2,
        "scenarios without labels": 1,
    }

    train_types = {info["scenario_type"] for info in read_infos(done.folder, "train")}
    assert train_types == {"type1_subtype1_accident"}


def test_paths_lead_to_the_files_in_either_layout(
    da: DeepAccident, exported: Exported, da_b: DeepAccident, tmp_path: Path
) -> None:
    done = export_release(da_b, tmp_path / "out", ReleasedInfos(root_prefix="./DeepAccident/"))
    for dataset, folder, prefix in (
        (da, exported.folder, ROOT_PREFIX),
        (da_b, done.folder, "./DeepAccident"),
    ):
        info = read_infos(folder)[0]
        path = info["lidar_path"]
        assert path.startswith(prefix)
        assert path.split("/")[3] == info["scenario_type"]  # where the released code looks for it
        cloud_path = str(Path(path).relative_to(prefix))
        calib_path = cloud_path.replace("lidar01", "calib").replace(".npz", ".pkl")
        assert (dataset.dataroot / calib_path).is_file()


@pytest.mark.parametrize("drop", [False, True])
def test_infos_without_boxes_are_listed_or_dropped(
    own_release: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, *, drop: bool
) -> None:
    label = next(own_release.glob("val/*_accident/other_vehicle/label/*/*_004.txt"))
    label.write_text(label.read_text().splitlines()[0])
    dataset = DeepAccident("v1", own_release, verbose=False)
    form = ReleasedInfos(root_prefix="./DeepAccident", split="val", drop_empty=drop)
    with caplog.at_level(logging.WARNING):
        done = export_release(dataset, tmp_path / "out", form)

    infos = read_infos(done.folder)
    boxless = [info["lidar_prefix"] for info in infos if not len(info["gt_boxes"])]
    boxless_list = tmp_path / "out" / "carla_infos_without_boxes.txt"
    if drop:
        assert done.tally.left_out == {"infos without boxes": 1}
        assert boxless == []
        assert not boxless_list.exists()
    else:
        assert boxless == [f"type1_subtype2_accident_other_vehicle_{label.stem}"]
        assert boxless_list.read_text().splitlines() == boxless
        assert "1 infos have no boxes" in caplog.text
        assert done.tally.left_out == {}


def test_the_command_of_mmdet3d_has_the_style(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = invoke_command(
        *("export", "mmdet3d", da.dataroot, "--out", out, "--split", "val"),
        *("--style", "released", "--root-prefix", "./a/b", "--workers", 1),
    )

    assert "estimate for about 20 samples: a few files" in result.output
    assert read_infos(out)[0]["lidar_path"].startswith("./a/b/type1_")
    assert not (out / "v1.0-deepaccident").exists()


@pytest.mark.parametrize(
    ("fixture", "prefix", "suggestion"),
    [("da", "data/DeepAccident_data/", ROOT_PREFIX), ("da_b", ROOT_PREFIX, "./DeepAccident")],
)
def test_a_prefix_of_other_length_is_refused(
    request: pytest.FixtureRequest, tmp_path: Path, fixture: str, prefix: str, suggestion: str
) -> None:
    out = tmp_path / "out"
    form = ReleasedInfos(root_prefix=prefix)
    dataset = request.getfixturevalue(fixture)
    parts = ("three parts before the scenario type", f"give {suggestion}, or another")
    assert_raises((lambda: export_release(dataset, out, form), ChoiceError, parts))
    assert not out.exists()
